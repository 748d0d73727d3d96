//! The golden cases: payloads that real middleware wrote, and what `ros2 topic echo` printed.

use std::fmt;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use flate2::read::MultiGzDecoder;
use ros2probe::message::MessageType;
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
    /// Both as `echo` prints it and with `--full-length`.
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
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data")
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
pub fn definitions(name: &str) -> Arc<MessageType> {
    let dir = data().join("definitions");
    let mut text = String::new();
    let short = |n: &str| n.replace("/msg/", "/");
    text.push_str(&std::fs::read_to_string(dir.join(format!("{name}.msg"))).unwrap());
    let mut done = vec![short(name)];
    let mut i = 0;
    let mut wanted: Vec<String> = Vec::new();
    let mut last = text.clone();
    loop {
        let pkg = if i == 0 {
            short(name)
        } else {
            wanted[i - 1].clone()
        };
        let pkg = pkg.split('/').next().unwrap().to_owned();
        for l in last.lines() {
            let l = l.split('#').next().unwrap();
            let Some(t) = l.split_whitespace().next() else {
                continue;
            };
            let t = t.split('[').next().unwrap();
            let t = if t.contains('/') {
                t.to_owned()
            } else if t.starts_with(|c: char| c.is_uppercase()) {
                format!("{pkg}/{t}")
            } else {
                continue;
            };
            if !done.contains(&t) {
                done.push(t.clone());
                wanted.push(t);
            }
        }
        if i == wanted.len() {
            break;
        }
        let (p, n) = wanted[i].split_once('/').unwrap();
        last = std::fs::read_to_string(dir.join(p).join("msg").join(format!("{n}.msg")))
            .unwrap_or_else(|_| panic!("no {p}/{n}"));
        text.push_str(&format!("\n{}\nMSG: {p}/{n}\n{last}", "=".repeat(80)));
        i += 1;
    }
    Arc::new(MessageType::parse(&name.parse().unwrap(), &text).unwrap())
}
