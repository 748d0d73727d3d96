//! The shipped unit: hardened, and free of what systemd would complain about.
#![expect(clippy::panic, reason = "a test may panic")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn unit() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../systemd/ros2probe.service")
}

fn systemd_analyze(arguments: &[&str], unit: &Path) -> Output {
    Command::new("systemd-analyze")
        .args(arguments)
        .arg(unit)
        .output()
        .unwrap_or_else(|error| panic!("systemd-analyze: {error}; `apt-get install systemd`"))
}

/// Ubuntu 22.04 has 249, which cannot score a unit that is not installed, and nothing newer.
fn can_score_offline() -> bool {
    let output = systemd_analyze(&["--version"], Path::new("."));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let version = said.split_whitespace().nth(1).map(str::parse::<u32>);
    matches!(version, Some(Ok(250..)))
}

#[test]
fn the_exposure_level_is_at_most_2() {
    if !can_score_offline() {
        eprintln!("not checked: scoring a unit offline needs systemd 250");
        return;
    }
    let output = systemd_analyze(&["security", "--offline=true", "--no-pager"], &unit());
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let level = said.lines().find_map(|line| {
        let (_, level) = line.split_once("Overall exposure level for ros2probe.service: ")?;
        level.split_whitespace().next()?.parse::<f64>().ok()
    });
    assert!(
        level.unwrap_or_else(|| panic!("no level in\n{said}")) <= 2.0,
        "{said}"
    );
}

#[test]
fn systemd_understands_every_line() {
    let directory = tempfile::tempdir().unwrap();
    let copy = directory.path().join("ros2probe.service");
    let text = std::fs::read_to_string(unit()).unwrap();
    std::fs::write(&copy, text.replace("/usr/bin/rp", env!("CARGO_BIN_EXE_rp"))).unwrap();
    let output = systemd_analyze(&["verify", "--man=no"], &copy);
    let said = String::from_utf8_lossy(&output.stderr);
    // What systemd says of other units on the machine is not ours.
    let ours: Vec<&str> = said
        .lines()
        .filter(|line| line.contains("ros2probe"))
        .collect();
    assert!(ours.is_empty(), "{said}");
}

#[test]
fn every_test_that_the_threat_model_names_is_there() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut sources = String::new();
    for directory in ["agent/src", "agent/tests", "wire/src", "wire/tests"] {
        read_sources(&root.join(directory), &mut sources).unwrap();
    }
    let model = std::fs::read_to_string(root.join("SECURITY.md")).unwrap();
    let quoted = model.split('`').skip(1).step_by(2);
    let is_test = |name: &&str| {
        let letters = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        name.matches('_').count() >= 2 && name.chars().all(letters)
    };
    let not_tests = ["no_new_privs", "ros2probe_sandbox_info"];
    let named: Vec<&str> = quoted
        .filter(is_test)
        .filter(|name| !not_tests.contains(name))
        .chain(["captures_survive"])
        .collect();
    assert!(named.len() > 40, "{named:?}");
    for name in named {
        let function = sources.find(&format!("fn {name}("));
        let before = function.map(|at| sources.get(..at).unwrap_or_default());
        let attribute = before.is_some_and(|before| {
            let lines = before.lines().rev().take(4);
            lines
                .map(str::trim)
                .any(|line| line.starts_with("#[test]") || line.starts_with("#[tokio::test"))
        });
        assert!(attribute, "SECURITY.md names {name}, which is no test");
    }
}

fn read_sources(directory: &Path, into: &mut String) -> std::io::Result<()> {
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if path.is_dir() {
            read_sources(&path, into)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push_str(&std::fs::read_to_string(path)?);
        }
    }
    Ok(())
}

#[test]
fn the_agent_may_do_what_it_needs_and_nothing_else() {
    let text = std::fs::read_to_string(unit()).unwrap();
    for set in ["CapabilityBoundingSet", "AmbientCapabilities"] {
        let line = format!("\n{set}=CAP_NET_ADMIN CAP_NET_RAW CAP_BPF CAP_PERFMON\n");
        assert!(text.contains(&line), "{set}");
    }
    for line in [
        "Type=notify",
        "LimitMEMLOCK=infinity",
        "Before=network.target",
        "Restart=always",
        "StartLimitIntervalSec=0",
        "User=ros2probe",
        "Group=ros2probe",
        "LimitRTPRIO=1",
    ] {
        assert!(text.lines().any(|other| other == line), "{line}");
    }
}
