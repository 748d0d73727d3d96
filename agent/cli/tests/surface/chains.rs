//! `rp chain` over a capture of real nodes.

use std::path::{Path, PathBuf};

use ros2probe_api::chains::ChainList;

use crate::ros2::{run, stderr, stdout};

fn capture() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    root.join("../testing/data/fastrtps-udp/chain-1ns/capture.pcap.gz")
}

fn ask(arguments: &[&str]) -> std::process::Output {
    let capture = capture();
    let replay = ["--replay", capture.to_str().unwrap()];
    run(&[&["chain"], arguments, &replay].concat())
}

#[test]
fn the_hops_of_a_capture_are_printed_with_the_slowest_marked() {
    let output = ask(&[]);
    let text = stdout(&output);
    assert!(output.status.success(), "{}", stderr(&output));
    let lines: Vec<_> = text.lines().collect();
    assert!(lines[0].starts_with("/points to /cmd: "), "{text}");
    assert!(lines[0].ends_with(" messages, by stamps"), "{text}");
    assert_eq!(lines[1], "  published by /sensor");
    let hop = lines.iter().find(|line| line.contains("-> /filter ->"));
    assert!(hop.unwrap().ends_with("bottleneck"), "{text}");
    let end = lines.last().unwrap();
    assert!(end.starts_with("  end to end "), "{text}");
}

#[test]
fn a_part_of_a_chain_has_its_own_latency() {
    let part = |arguments: &[&str]| {
        let output = ask(arguments);
        let list: ChainList<'_> = serde_json::from_str(&stdout(&output)).unwrap();
        list
    };
    let whole = part(&["--json"]).chains[0].latency.p50_seconds;
    let first = part(&["/points", "/filtered", "--json"]).chains[0].clone();
    let second = part(&["/filtered", "--json"]).chains[0].clone();
    assert_eq!((first.hops.len(), second.hops.len()), (1, 1));
    assert_eq!((&*second.from, &*second.to), ("/filtered", "/cmd"));
    let sum = first.latency.p50_seconds + second.latency.p50_seconds;
    assert!((whole - sum).abs() < 0.001, "{whole} {sum}");
}

#[test]
fn a_missing_chain_is_reported_in_one_line() {
    let output = ask(&["/cmd", "/points"]);
    assert_eq!(output.status.code(), Some(1));
    let reason = "no chain from /cmd to /points: ";
    assert!(stderr(&output).starts_with(reason), "{}", stderr(&output));
    assert_eq!(stdout(&output), "");
}

#[test]
fn a_name_without_a_slash_is_absolute_and_an_invalid_name_is_refused() {
    let named = stdout(&ask(&["points", "cmd"]));
    assert_eq!(named, stdout(&ask(&["/points", "/cmd"])));
    for (name, reason) in [
        ("/points ", "character ` `"),
        ("/p*", "`*`"),
        ("", "letters"),
    ] {
        let output = ask(&[name]);
        assert_eq!(output.status.code(), Some(2), "{name}");
        assert!(stderr(&output).contains(reason), "{}", stderr(&output));
    }
}
