//! `rp log` beside the console of a real node, and `rp diag` beside `ros2 topic echo`.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::{Host, Middleware};
use crate::installed;

const PATIENCE: Duration = Duration::from_secs(60);
/// Messages of `said.py`: each text at each level.
const MESSAGES: usize = 25;

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn with_fast_dds_logs_and_diagnostics_print_as_the_node_said_them() -> Result<()> {
    print_as_said(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn with_cyclone_dds_logs_and_diagnostics_print_as_the_node_said_them() -> Result<()> {
    print_as_said(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn with_zenoh_logs_and_diagnostics_print_as_the_node_said_them() -> Result<()> {
    print_as_said(Middleware::Zenoh)
}

fn print_as_said(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let agent = host.agent("")?;
    let _router = host.router_if_any()?;
    let _logs = echo(&host, "/rosout", "rcl_interfaces/msg/Log")?;
    let _diagnostics = echo(&host, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")?;
    let console = host.file("console");
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2/said.py");
    let line = format!("exec {} {script}", installed::python());
    let mut node = host.run(&line, &[], Stdio::from(File::create(&console)?))?;
    node.wait_for("matched", PATIENCE)?;
    let ability = [("ability", "shared_memory_exact")];
    if middleware == Middleware::FastExact("auto") {
        agent.scrape_until("the uprobe is attached", |page| {
            page.sum("ros2probe_capture_ability", &ability) == 1.0
        })?;
    }
    node.write_line("go")?;
    node.wait_for("done", PATIENCE)?;

    let said = |text: &str| -> Vec<String> {
        let lines = text.lines().filter(|line| line.contains("[front.lidar]: "));
        lines.map(str::to_owned).collect()
    };
    let mut printed = String::new();
    wait_until("all messages of the log have come", || {
        printed = host.rp(&["log", "--no-follow", "-n", "1000"])?;
        Ok(said(&printed).len() >= MESSAGES)
    })
    .with_context(|| printed.clone())?;
    let on_console = said(&fs::read_to_string(&console)?);
    ensure!(on_console.len() == MESSAGES, "{on_console:#?}");
    ensure!(said(&printed) == on_console, "{printed}\n{on_console:#?}");
    let errors = host.rp(&[
        "log",
        "/front/lidar",
        "-l",
        "error",
        "--no-follow",
        "-n",
        "1000",
    ])?;
    let severe = on_console
        .iter()
        .filter(|line| line.starts_with("[ERROR]") || line.starts_with("[FATAL]"));
    ensure!(said(&errors).iter().eq(severe), "{errors}");

    let mut echoed = String::new();
    wait_until("the diagnostics are echoed", || {
        echoed = fs::read_to_string(host.file("diagnostics"))?;
        Ok(echoed.contains("\n---"))
    })?;
    let printed = host.rp(&["diag"])?;
    let expected = statuses(&echoed)?;
    let lines: BTreeSet<String> = printed.lines().map(str::to_owned).collect();
    ensure!(expected.len() == 5, "one line of two: {expected:?}");
    ensure!(lines == expected, "{printed}\n{expected:?}");
    ensure!(printed.lines().count() == 6, "{printed}");
    Ok(())
}

/// Starts `ros2 topic echo`, with the text in a file that has the topic's name.
fn echo(host: &Host<'_>, topic: &str, message_type: &str) -> Result<Process> {
    let log = host.path(topic.trim_start_matches('/'));
    fs::write(&log, "")?;
    let line = "exec ros2 topic echo --no-daemon --full-length --qos-reliability reliable \
                --qos-durability volatile $2 $3 > $1";
    host.run(line, &[&log, topic, message_type], Stdio::inherit())
}

/// Returns the lines of `rp diag` for the statuses in the text of `ros2 topic echo`.
fn statuses(echoed: &str) -> Result<BTreeSet<String>> {
    let mut lines = BTreeSet::new();
    let (mut level, mut name) = ("", "");
    for line in echoed.lines() {
        let line = line.trim_start_matches([' ', '-']);
        if let Some(value) = line.strip_prefix("level: ") {
            level = match value.trim_matches('"') {
                r"\0" | r"\x00" => "OK",
                r"\x01" => "WARN",
                r"\x02" => "ERROR",
                r"\x03" => "STALE",
                other => anyhow::bail!("level {other}"),
            };
        } else if let Some(value) = line.strip_prefix("name: ") {
            name = value.trim_matches('\'');
        } else if let Some(value) = line.strip_prefix("message: ") {
            let message = value.trim_matches('\'');
            lines.insert(format!("{level:<6} {name}: {message}"));
        }
    }
    Ok(lines)
}
