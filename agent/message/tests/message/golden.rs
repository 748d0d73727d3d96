//! The golden cases: payloads written by real middleware, and the output of `ros2 topic echo`.

use std::fmt;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use flate2::read::MultiGzDecoder;
use ros2probe_message::{Dialect, Library, Sources};
use serde::Deserialize;

const FILES: [&str; 2] = [
    "cdr_golden.rmw_cyclonedds_cpp.jsonl.gz",
    "cdr_golden.rmw_fastrtps_cpp.jsonl.gz",
];

/// One payload.
pub struct Case {
    pub message_type: String,
    pub label: String,
    pub payload: Vec<u8>,
    /// Output of `echo`, and of `echo --full-length`.
    pub yaml_echo: String,
    pub yaml_full: String,
    pub csv: String,
}

impl fmt::Display for Case {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.message_type, self.label)
    }
}

#[derive(Deserialize)]
struct Line {
    r#type: String,
    label: String,
    cdr_hex: String,
    yaml_echo: String,
    yaml_full: String,
    csv: String,
}

pub fn data() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data")
}

pub fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for name in FILES {
        let file = File::open(data().join("cdr-golden").join(name)).unwrap();
        let mut text = String::new();
        MultiGzDecoder::new(file).read_to_string(&mut text).unwrap();
        for line in text.lines() {
            let line: Line = serde_json::from_str(line).unwrap();
            cases.push(Case {
                message_type: line.r#type,
                label: line.label,
                payload: bytes(&line.cdr_hex),
                yaml_echo: line.yaml_echo,
                yaml_full: line.yaml_full,
                csv: line.csv,
            });
        }
    }
    cases
}

pub fn bytes(hex: &str) -> Vec<u8> {
    let digit = |digit: u8| u8::try_from(char::from(digit).to_digit(16).unwrap()).unwrap();
    hex.as_bytes()
        .chunks_exact(2)
        .map(|pair| digit(pair[0]) << 4 | digit(pair[1]))
        .collect()
}

/// Returns a library with the types of `test_msgs` in the test data; the others are embedded.
pub fn library() -> Library {
    Library::new(Sources {
        directories: vec![data().join("definitions")],
        prefixes: Vec::new(),
        dialect: Dialect::Humble,
    })
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns rosbags' output for lines of types and payloads.
pub fn rosbags(lines: &str) -> String {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = here.join("../../target/tools/bags/bin/python");
    let mut child = Command::new(&python)
        .arg(here.join("tests/message/read.py"))
        .arg(data().join("definitions"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make prerequisites`", python.display()));
    let mut input = child.stdin.take().unwrap();
    let lines = lines.to_owned();
    let writer = std::thread::spawn(move || input.write_all(lines.as_bytes()));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap()
}
