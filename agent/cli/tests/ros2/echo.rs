//! Compares the output with that of `ros2 topic echo` of ROS 2 byte for byte, for messages
//! of every installed type and each option (`ros2/oracle.py`).

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::thread;

use crate::installed;
use ros2probe::ros2::echo::{Echo, Options};
use ros2probe_api::samples::Sample;
use ros2probe_message::yaml::Style;
use ros2probe_message::{Library, Sources};
use serde::Deserialize;

/// Number of processes of the oracle at a time.
const PARTS: usize = 2;
/// Maximum number of differences that are shown in full.
const SHOWN: usize = 12;

#[test]
#[ignore = "needs ROS 2: make test-ros2"]
fn every_installed_message_type_prints_as_in_ros2() {
    assert_prints_equal("rmw_fastrtps_cpp");
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn samples_of_cyclone_dds_print_as_in_ros2() {
    assert_prints_equal("rmw_cyclonedds_cpp");
}

fn assert_prints_equal(middleware: &'static str) {
    let parts: Vec<_> = (0..PARTS)
        .map(|part| thread::spawn(move || compare(middleware, part)))
        .collect();
    let mut all = Compared::default();
    for part in parts {
        let part = part.join().unwrap();
        all.types.extend(part.types);
        all.prints += part.prints;
        all.differing += part.differing;
        all.examples.extend(part.examples);
    }
    let installed = installed_types();
    assert!(installed.len() >= 100, "{} types", installed.len());
    assert_eq!(all.types, installed);
    assert!(all.prints > 100 * installed.len(), "{} prints", all.prints);
    let shown: Vec<String> = all.examples.into_values().take(SHOWN).collect();
    assert_eq!(
        all.differing,
        0,
        "of {} prints differ:\n{}",
        all.prints,
        shown.join("\n")
    );
    eprintln!("{} types, {} prints equal", all.types.len(), all.prints);
}

#[derive(Default)]
struct Compared {
    types: BTreeSet<String>,
    prints: usize,
    differing: usize,
    /// One example of each type that differs.
    examples: BTreeMap<String, String>,
}

/// One message, and the output of `ros2 topic echo` for it.
#[derive(Deserialize)]
struct Line {
    r#type: String,
    case: usize,
    payload: String,
    /// Options, and their output.
    prints: Vec<(Vec<String>, String)>,
}

/// Compares every `PARTS`-th type.
fn compare(middleware: &str, part: usize) -> Compared {
    let oracle = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros2/oracle.py");
    let mut child = installed::shell(&format!("exec {} \"$0\" \"$@\"", installed::python()))
        .arg(oracle)
        .args([part.to_string(), PARTS.to_string()])
        .env("RMW_IMPLEMENTATION", middleware)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let library = Library::new(Sources {
        directories: Vec::new(),
        prefixes: vec![installed::prefix()],
        dialect: installed::dialect(),
    });
    let mut compared = Compared::default();
    for line in BufReader::new(child.stdout.take().unwrap()).lines() {
        let line: Line = serde_json::from_str(&line.unwrap()).unwrap();
        let message_type = library
            .find(&line.r#type, None)
            .unwrap_or_else(|error| panic!("{}: {error}", line.r#type));
        let payload = bytes(&line.payload);
        for (options, expected) in &line.prints {
            let mut echo = Echo::new(parse(options));
            let printed = echo.message(&sample(&line.r#type), Some(&message_type), &payload);
            let printed = printed.unwrap();
            // Fast DDS estimates the length if it serializes into a buffer, but not if it sends.
            let is_estimated = printed.err.contains("bytes after its last field");
            let is_plain = printed.err.is_empty();
            assert!(
                is_plain || is_estimated && middleware == "rmw_fastrtps_cpp",
                "{} {}: {}",
                line.r#type,
                line.case,
                printed.err
            );
            compared.prints += 1;
            let printed = printed.out.unwrap();
            if printed != *expected {
                let (expected, printed) = first_difference(expected, &printed);
                let case = format!("{} {} {options:?}", line.r#type, line.case);
                let example = format!("{case}\n  ros2 {expected:?}\n  rp   {printed:?}");
                compared.differing += 1;
                compared
                    .examples
                    .entry(line.r#type.clone())
                    .or_insert(example);
            }
        }
        compared.types.insert(line.r#type);
    }
    assert!(child.wait().unwrap().success(), "the oracle failed");
    compared
}

/// Converts the options of `ros2 topic echo` to those of `rp topic echo`.
fn parse(words: &[String]) -> Options {
    let mut options = Options {
        dialect: installed::dialect(),
        ..Options::default()
    };
    let mut words = words.iter();
    let shown = &mut options.shown;
    while let Some(word) = words.next() {
        match word.as_str() {
            "--full-length" => shown.truncate = None,
            "--truncate-length" => shown.truncate = Some(words.next().unwrap().parse().unwrap()),
            "--no-arr" => shown.no_arrays = true,
            "--no-str" => shown.no_strings = true,
            "--flow-style" => options.style = Style::Flow,
            "--csv" => options.csv = true,
            "--raw" => options.raw = true,
            "--field" => options.fields.push(words.next().unwrap().parse().unwrap()),
            other => panic!("{other}"),
        }
    }
    options
}

fn sample(message_type: &str) -> Sample {
    Sample {
        topic: "/topic".to_owned(),
        domain_id: 0,
        message_type: message_type.to_owned(),
        time_ns: 2,
        writer: "01.02".to_owned(),
        sequence_number: 1,
        source_timestamp_ns: Some(1),
        header_stamp_ns: None,
        size: 0,
        sampled: false,
        payload_bytes: None,
        offered: None,
    }
}

/// Returns both texts since the line in which they first differ.
fn first_difference<'a>(expected: &'a str, printed: &'a str) -> (&'a str, &'a str) {
    let same = expected.bytes().zip(printed.bytes());
    let same = same.take_while(|(one, other)| one == other).count();
    let start = expected.as_bytes()[..same]
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |end| end + 1);
    let start = start.max(same.saturating_sub(60));
    let from = |text: &'a str| {
        let start = (0..=start)
            .rev()
            .find(|start| text.is_char_boundary(*start))
            .unwrap();
        let end = (same + 60).min(text.len());
        let end = (end..=text.len())
            .find(|end| text.is_char_boundary(*end))
            .unwrap();
        &text[start..end]
    };
    (from(expected), from(printed))
}

fn bytes(hex: &str) -> Vec<u8> {
    let digit = |digit: u8| u8::try_from(char::from(digit).to_digit(16).unwrap()).unwrap();
    hex.as_bytes()
        .chunks_exact(2)
        .map(|pair| digit(pair[0]) << 4 | digit(pair[1]))
        .collect()
}

/// Returns the names of all messages below the prefix. Code was generated from files with an `.idl`
/// beside them.
fn installed_types() -> BTreeSet<String> {
    let share = installed::prefix().join("share");
    let entries = |directory: PathBuf| {
        let entries = std::fs::read_dir(directory).into_iter().flatten();
        entries.map(|entry| entry.unwrap().path())
    };
    let stem = |path: &Path| path.file_stem().unwrap().to_str().unwrap().to_owned();
    entries(share)
        .flat_map(|package| entries(package.join("msg")))
        .filter(|path| path.extension().is_some_and(|extension| extension == "msg"))
        .filter(|path| path.with_extension("idl").exists())
        .map(|path| {
            let package = path.parent().unwrap().parent().unwrap();
            format!("{}/msg/{}", stem(package), stem(&path))
        })
        .collect()
}
