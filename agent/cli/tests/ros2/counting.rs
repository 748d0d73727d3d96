//! Publishers and subscriptions of `ros2/counting.py`. The counts of an agent equal their logs.

use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_api::measurement::Delivered;
use ros2probe_api::topics::TopicDetails;
use ros2probe_testing::harness::agent::{Agent, get};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::Host;

pub const PATIENCE: Duration = Duration::from_secs(60);
pub const WATCH: &str = "watch:\n- {topic: '/**', per_subscriber: true}\n";

/// Counts in the log of a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Log {
    pub received: u64,
    /// Number of messages between the first and the last that the subscription did not receive.
    pub missing: u64,
}

pub fn publisher(host: &Host<'_>, name: &str, topic: &str, rest: &[&str]) -> Result<Process> {
    let arguments = [&["publish", name, topic], rest].concat();
    let mut publisher = host.python("counting.py", &arguments)?;
    publisher.wait_for("ready", PATIENCE)?;
    Ok(publisher)
}

pub fn subscription(host: &Host<'_>, name: &str, topic: &str, rest: &[&str]) -> Result<Process> {
    let arguments = [&["subscribe", name, topic], rest].concat();
    let mut subscription = host.python("counting.py", &arguments)?;
    subscription.wait_for("ready", PATIENCE)?;
    Ok(subscription)
}

pub fn publish(publisher: &mut Process, messages: u64, total: u64) -> Result<()> {
    publisher.write_line(&messages.to_string())?;
    publisher.wait_for(&format!("published {total}"), PATIENCE)
}

pub fn log(subscription: &mut Process) -> Result<Log> {
    subscription.write_line("count")?;
    let line = subscription.line_with_end("", PATIENCE)?;
    let words: Vec<&str> = line.split_whitespace().collect();
    let [_, received, _, first, _, last] = words[..] else {
        anyhow::bail!("{line}");
    };
    let [received, first, last]: [u64; 3] = [received.parse()?, first.parse()?, last.parse()?];
    let span = if received == 0 { 0 } else { last - first + 1 };
    Ok(Log {
        received,
        missing: span - received,
    })
}

/// Returns the log once it has not changed for a second.
pub fn settled_log(subscription: &mut Process) -> Result<Log> {
    let mut before = log(subscription)?;
    loop {
        std::thread::sleep(Duration::from_secs(1));
        let now = log(subscription)?;
        if now == before {
            return Ok(now);
        }
        before = now;
    }
}

/// Returns what arrived at the node and what was lost, as the agent counts it.
pub fn delivered(agent: &Agent<'_>, topic: &str, node: &str) -> Result<Log> {
    let mut log = Log {
        received: 0,
        missing: 0,
    };
    for (_, delivered) in deliveries(agent, topic, node)? {
        log.received += delivered.messages;
        log.missing += delivered.lost_messages;
    }
    Ok(log)
}

/// Returns the receiving process of each delivery to the node, and the counts of its messages.
pub fn deliveries(
    agent: &Agent<'_>,
    topic: &str,
    node: &str,
) -> Result<Vec<(Option<u32>, Delivered)>> {
    let text = get(agent.host, &format!("http://127.0.0.1:17401/topics{topic}"))?;
    let details: TopicDetails<'_> = serde_json::from_str(&text).with_context(|| text.clone())?;
    let arrived = details.deliveries.into_iter().filter(|delivery| {
        delivery.direction == "received" && delivery.nodes.iter().any(|other| *other == node)
    });
    Ok(arrived
        .map(|delivery| (delivery.process_id, delivery.delivered))
        .collect())
}

pub fn agrees(agent: &Agent<'_>, topic: &str, node: &str, log: Log) -> Result<()> {
    let mut last = None;
    let settled = wait_until("the agent agrees with the subscription's log", || {
        let now = delivered(agent, topic, node)?;
        last = Some(now);
        Ok(now == log)
    });
    let figures = |page: &str| -> String {
        let is_shown = |line: &&str| {
            (line.contains("zenoh") || line.contains("filter_events")) && !line.starts_with("#")
        };
        let lines: Vec<_> = page.lines().filter(is_shown).collect();
        lines.join("\n")
    };
    let page = agent.scrape()?.0;
    settled.with_context(|| {
        let figures = figures(&page);
        format!("{topic} at {node}: logged {log:?}, delivered {last:?}\n{figures}")
    })
}

pub fn messages(agent: &Agent<'_>, topic: &str) -> Result<f64> {
    Ok(agent
        .scrape()?
        .sum("ros2_topic_messages_total", &[("topic", topic)]))
}

/// Checks that the agent names the process in which the node of a session runs.
pub fn runs_in(agent: &Agent<'_>, node: &str, process: &Process) -> Result<()> {
    let process_id = process.pid().to_string();
    let cgroup = agent.host.cgroup();
    let cgroup = format!("/{}", cgroup.file_name().context("no name")?.display());
    let expected = [
        ("process", "python3"),
        ("pid", &process_id),
        ("cgroup", &cgroup),
    ];
    let mut last = String::new();
    let is_named = wait_until("the process is known", || {
        let page = agent.scrape()?;
        let is_shown = |line: &&str| {
            line.starts_with("ros2_participant_info{") || line.starts_with("ros2_node_info{")
        };
        last = page
            .0
            .lines()
            .filter(is_shown)
            .collect::<Vec<_>>()
            .join("\n");
        let mut named = page.samples("ros2_participant_info", &expected);
        Ok(named.next().is_some())
    });
    is_named.with_context(|| format!("{node}: {expected:?}\n{last}"))
}
