//! `rp doctor`: the real binary as root and as an unprivileged user, without an agent and with an
//! agent that replays a capture.

use std::fs::Permissions;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;
use std::process::{Command, Output};
use std::time::Instant;

use crate::rp;
use ros2probe_testing::local_agent::{self, LocalAgent, PATIENCE};
use serde_json::Value;

/// A socket that does not exist.
const UNUSED_ADDRESS: &str = "/nonexistent/api.sock";

fn report(output: &Output) -> Value {
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(printed, "");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    // The exit code agrees with the report.
    let is_problem = report["verdict"] == "problem";
    assert_eq!(
        output.status.code(),
        Some(i32::from(is_problem)),
        "{report:#}"
    );
    report
}

fn verdict<'a>(report: &'a Value, area: &str, check: &str) -> &'a str {
    let findings = report["findings"].as_array().unwrap();
    let found = findings
        .iter()
        .find(|finding| finding["area"] == area && finding["check"] == check);
    found.map_or("absent", |finding| finding["verdict"].as_str().unwrap())
}

fn is_root() -> bool {
    std::fs::metadata("/proc/self").unwrap().uid() == 0
}

#[test]
fn without_an_agent_doctor_examines_the_host_and_tries_permitted_sources() {
    let output = rp()
        .args(["doctor", "--json", "--socket", UNUSED_ADDRESS])
        .env("ROS_DISTRO", "jazzy")
        .env("ROS_DOMAIN_ID", "150")
        .env("SECRET", "hunter2")
        .output()
        .unwrap();
    assert!(!String::from_utf8_lossy(&output.stdout).contains("hunter2"));
    let report = report(&output);
    assert_eq!(verdict(&report, "agent", "reachable"), "warning");
    assert_eq!(verdict(&report, "kernel", "version"), "ok");
    assert_eq!(verdict(&report, "shell", "domain"), "warning");
    assert_eq!(verdict(&report, "graph", "participants"), "absent");
    if is_root() {
        assert_eq!(verdict(&report, "privileges", "capabilities"), "ok");
        let source = verdict(&report, "sight", "source");
        assert!(["ok", "warning"].contains(&source), "{report:#}");
        assert_ne!(verdict(&report, "sight", "abilities"), "absent");
    }
}

#[test]
fn an_unprivileged_user_sees_which_checks_need_root() {
    let directory = tempfile::tempdir().unwrap();
    // The build directory may not be readable for other users.
    let program = directory.path().join("rp");
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), &program).unwrap();
    for path in [directory.path(), &program] {
        std::fs::set_permissions(path, Permissions::from_mode(0o755)).unwrap();
    }
    let mut command = Command::new("setpriv");
    if is_root() {
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
    }
    let doctor = |command: &mut Command, arguments: &[&str]| {
        command
            .args(["--inh-caps=-all"])
            .arg(&program)
            .args(["doctor", "--socket", UNUSED_ADDRESS])
            .args(arguments)
            .env_remove("NO_COLOR")
            .output()
            .unwrap()
    };
    let text = doctor(&mut command, &[]);
    let text = String::from_utf8(text.stdout).unwrap();
    let unknown = "  unknown  kernel support was not tested\n";
    assert!(text.contains(unknown), "{text}");
    assert!(text.contains("\n           > sudo rp doctor\n"), "{text}");
    assert!(text.contains("> sudo setcap cap_net_admin,"), "{text}");
    // Without a terminal, the text has no colours. Only commands and paths are wider than a
    // terminal.
    assert!(!text.contains('\x1b'), "{text}");
    let wide = |line: &&str| line.chars().count() > 80 && !line.trim_start().starts_with("> ");
    assert_eq!(text.lines().find(wide), None, "{text}");
}

#[test]
fn doctor_reads_an_agent_on_a_replay_through_its_socket_and_its_address() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let config = directory.path().join("c.yaml");
    let text = format!(
        "watch: [/chatter, /nobody]\napi: {{socket: {}}}\n",
        socket.display()
    );
    std::fs::write(&config, text).unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--speed", "max", "--config", config.to_str().unwrap()],
    );
    agent.wait_for_log("ready");
    let here = asked(&["--socket", socket.to_str().unwrap()]);
    assert_eq!(verdict(&here, "kernel", "version"), "ok");
    assert_eq!(verdict(&here, "agent", "watches"), "note", "{here:#}");
    assert_eq!(verdict(&here, "agent", "version"), "ok");
    let there = asked(&["--host", &agent.api.to_string()]);
    assert_eq!(verdict(&there, "kernel", "version"), "absent");
    assert_eq!(verdict(&there, "agent", "losses"), "ok", "{there:#}");
    assert_eq!(there["subject"], agent.api.to_string());
}

#[test]
fn doctor_reports_only_the_graph_of_a_capture() {
    let capture = local_agent::capture();
    let capture = capture.to_str().unwrap();
    let report = asked(&["--replay", capture, "--until", "+8"]);
    assert_eq!(report["subject"], capture);
    let findings = report["findings"].as_array().unwrap();
    assert!(
        findings.iter().all(|finding| finding["area"] == "graph"),
        "{report:#}"
    );
    let nobody = ["doctor", "--json", "--replay", capture, "--domain", "7"];
    let nobody = rp().args(nobody).output().unwrap();
    let report = self::report(&nobody);
    assert_eq!(
        verdict(&report, "graph", "participants"),
        "note",
        "{report:#}"
    );
}

/// Repeats the command until the graph is known, and returns the report.
fn asked(arguments: &[&str]) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let output = rp()
            .args(["doctor", "--json"])
            .args(arguments)
            .output()
            .unwrap();
        let report = report(&output);
        if verdict(&report, "graph", "participants") == "ok" {
            return report;
        }
        assert!(Instant::now() < deadline, "{report:#}");
    }
}

#[test]
fn a_missing_agent_or_configuration_is_reported_in_one_line() {
    for arguments in [
        &["--host", "127.0.0.1:1"][..],
        &["--config", "/nowhere.yaml"],
    ] {
        let output = rp().arg("doctor").args(arguments).output().unwrap();
        let printed = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success());
        assert_eq!(printed.lines().count(), 1, "{printed}");
        assert!(output.stdout.is_empty());
    }
    let wrong = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
    let output = rp()
        .args(["doctor", "--json", "--socket", UNUSED_ADDRESS, "--config"])
        .arg(wrong)
        .output()
        .unwrap();
    let report = report(&output);
    assert_eq!(
        verdict(&report, "agent", "configuration"),
        "problem",
        "{report:#}"
    );
}
