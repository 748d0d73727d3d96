//! What the robot itself says: logs in metrics, API, findings and `rp log`, without a watch. Needs
//! root.

use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Result, ensure};
use ros2probe_api::logs::Logs;
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::robot_log::{DDS_TYPE, log};

use crate::robot_parts::Node;

const PATIENCE: Duration = Duration::from_secs(60);

/// Starts a node on another host that logs.
fn start(link: &Link) -> Result<Node> {
    Node::start(link, 1, "lidar", ("rt/rosout", DDS_TYPE))
}

/// Sends a message of its log.
fn say(node: &mut Node, level: u8, text: &str) -> Result<()> {
    node.send(&log(level, "lidar.driver", text.as_bytes()))
}

fn logs(link: &Link, query: &str) -> Result<Logs<'static>> {
    let url = format!("http://127.0.0.1:17401/logs{query}");
    Ok(serde_json::from_str(&get(&link.monitor, &url)?)?)
}

#[test]
fn logs_are_counted_kept_printed_and_diagnosed_without_a_watch() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let file = config.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: []\n{PACKETS_ALONE}"))?;
    let rp = env!("CARGO_BIN_EXE_rp");
    let agent = Agent::start(&link.monitor, rp, &file)?;
    let mut node = start(&link)?;
    agent.scrape_until("the writer", |page| {
        page.sum("ros2_topic_publishers", &[("topic", "/rosout")]) == 1.0
    })?;
    say(&mut node, 20, "started")?;
    say(&mut node, 30, "no scan for 1 s")?;
    for number in 1..=10 {
        say(&mut node, 40, &format!("read failed {number}"))?;
    }
    let page = agent.scrape_until("the errors", |page| {
        page.sum("ros2_log_messages_total", &[("level", "error")]) == 10.0
    })?;
    for (level, count) in [("info", 1.0), ("warn", 1.0), ("fatal", 0.0)] {
        let labels = [("ros_node", "/lidar"), ("level", level), ("domain_id", "0")];
        assert_eq!(
            page.sum("ros2_log_messages_total", &labels),
            count,
            "{level}"
        );
    }
    assert_eq!(page.sum("ros2_topic_messages_total", &[]), 0.0, "no watch");
    agent.scrape_until("the finding", |page| {
        page.sum("ros2_diagnoses", &[("kind", "log_errors")]) == 1.0
    })?;

    let all = logs(&link, "?limit=1000")?;
    let [lidar] = &all.nodes[..] else {
        anyhow::bail!("{all:?}")
    };
    let levels: Vec<_> = lidar
        .levels
        .iter()
        .map(|level| (&*level.level, level.messages, &*level.last.text))
        .collect();
    assert_eq!(
        levels,
        [
            ("info", 1, "started"),
            ("warn", 1, "no scan for 1 s"),
            ("error", 10, "read failed 10")
        ]
    );
    assert_eq!((all.is_on, all.messages.len()), (true, 12));
    assert_eq!(logs(&link, "?level=warn&limit=3")?.messages.len(), 3);
    assert!(logs(&link, "?node=/absent")?.messages.is_empty());
    ensure!(get(&link.monitor, "http://127.0.0.1:17401/logs?level=loud").is_err());

    let [enter, words @ ..] = &link.monitor.outside()[..] else {
        anyhow::bail!("no way into the host")
    };
    let arguments = [
        "log",
        "--no-follow",
        "-l",
        "warn",
        "-g",
        "scan|10$",
        "/lidar",
    ];
    let printed = Command::new(enter)
        .args(words)
        .arg(rp)
        .args(arguments)
        .output()?;
    assert_eq!(
        String::from_utf8(printed.stdout)?,
        "[WARN] [1700000000.500000000] [lidar.driver]: no scan for 1 s\n\
         [ERROR] [1700000000.500000000] [lidar.driver]: read failed 10\n"
    );

    let arguments = ["log", "-n", "1", "--verbose"];
    let mut following = Process::start_with(&link.monitor.inside(), rp, arguments, Stdio::null())?;
    let place = "(read() at src/lidar.cpp:81)";
    let begin = "[1700000000.500000000] [lidar.driver]:";
    following.wait_for(&format!("[ERROR] {begin} read failed 10 {place}"), PATIENCE)?;
    say(&mut node, 20, "recovered")?;
    following.wait_for(&format!("[INFO] {begin} recovered {place}"), PATIENCE)?;
    wait_until("the message that a reader requested", || {
        Ok(logs(&link, "")?.messages.len() == 13)
    })
}

#[test]
fn logs_are_not_read_if_the_configuration_disables_them() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let file = config.path().join("ros2probe.yaml");
    let text = format!("watch: [/rosout]\nrobot: {{logs: off}}\n{PACKETS_ALONE}");
    std::fs::write(&file, text)?;
    let agent = Agent::start(&link.monitor, env!("CARGO_BIN_EXE_rp"), &file)?;
    let mut node = start(&link)?;
    agent.scrape_until("the writer", |page| {
        page.sum("ros2_topic_publishers", &[("topic", "/rosout")]) == 1.0
    })?;
    for _ in 0..5 {
        say(&mut node, 40, "read failed")?;
    }
    let page = agent.scrape_until("the messages as those of a topic", |page| {
        page.sum("ros2_topic_messages_total", &[]) == 5.0
    })?;
    assert_eq!(page.sum("ros2_log_messages_total", &[]), 0.0);
    let none = logs(&link, "")?;
    assert!(!none.is_on && none.nodes.is_empty(), "{none:?}");
    Ok(())
}
