//! What the robot itself says: logs in metrics, API, findings and `rp log`, without a watch. Needs
//! root.

use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Result, ensure};
use ros2probe_api::logs::Logs;
use ros2probe_testing::forged::{Carrier as _, SAMPLES_WRITER, Sender, Talker};
use ros2probe_testing::harness::agent::{Agent, ON_THE_WIRE, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::robot_log::{DDS_TYPE, log};

const PATIENCE: Duration = Duration::from_secs(30);

/// A node on another host that logs.
struct Node {
    talker: Talker,
    sender: Sender,
    number: u32,
}

impl Node {
    fn start(link: &Link) -> Result<Self> {
        let talker = Talker::new(1, "/rosout");
        let mut sender = Sender::between(&link.robot, &link.monitor)?;
        sender.carry(&talker.participant())?;
        let writer = talker.publication(SAMPLES_WRITER, "rt/rosout", DDS_TYPE, 1);
        sender.carry(&writer)?;
        sender.carry(&talker.entities("lidar"))?;
        Ok(Self {
            talker,
            sender,
            number: 0,
        })
    }

    fn log(&mut self, level: u8, text: &str) -> Result<()> {
        self.number += 1;
        let payload = log(level, "lidar.driver", text.as_bytes());
        let message = (self.talker).message(SAMPLES_WRITER, self.number, &payload);
        self.sender.carry(&message)
    }
}

fn logs(link: &Link, query: &str) -> Result<Logs<'static>> {
    let url = format!("http://127.0.0.1:17401/logs{query}");
    Ok(serde_json::from_str(&get(&link.monitor, &url)?)?)
}

#[test]
fn logs_are_counted_kept_printed_and_judged_without_a_watch() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let file = config.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: []\n{ON_THE_WIRE}"))?;
    let rp = env!("CARGO_BIN_EXE_rp");
    let agent = Agent::start(&link.monitor, rp, &file)?;
    let mut node = Node::start(&link)?;
    agent.scrape_until("the writer", |page| {
        page.sum("ros2_topic_publishers", &[("topic", "/rosout")]) == 1.0
    })?;
    node.log(20, "started")?;
    node.log(30, "no scan for 1 s")?;
    for number in 1..=10 {
        node.log(40, &format!("read failed {number}"))?;
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
    node.log(20, "recovered")?;
    following.wait_for(&format!("[INFO] {begin} recovered {place}"), PATIENCE)?;
    wait_until("the message that a reader requested", || {
        Ok(logs(&link, "")?.messages.len() == 13)
    })
}

#[test]
fn logs_are_not_read_if_the_configuration_says_so() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let file = config.path().join("ros2probe.yaml");
    let text = format!("watch: [/rosout]\nrobot: {{logs: off}}\n{ON_THE_WIRE}");
    std::fs::write(&file, text)?;
    let agent = Agent::start(&link.monitor, env!("CARGO_BIN_EXE_rp"), &file)?;
    let mut node = Node::start(&link)?;
    agent.scrape_until("the writer", |page| {
        page.sum("ros2_topic_publishers", &[("topic", "/rosout")]) == 1.0
    })?;
    for _ in 0..5 {
        node.log(40, "read failed")?;
    }
    let page = agent.scrape_until("the messages as those of a topic", |page| {
        page.sum("ros2_topic_messages_total", &[]) == 5.0
    })?;
    assert_eq!(page.sum("ros2_log_messages_total", &[]), 0.0);
    let none = logs(&link, "")?;
    assert!(!none.is_on && none.nodes.is_empty(), "{none:?}");
    Ok(())
}
