//! Discovery is said once: whatever starts at the same moment, every node name and endpoint must
//! be known, with the agent up before them or started when half of them already run.

mod harness;

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use anyhow::Result;
use harness::agent::{Agent, Scrape};
use harness::network::{Link, Namespace};
use harness::peer::{Peer, Role, Stack, Stream};

/// Publishers on one host and as many subscribers on the other.
const PAIRS: usize = 8;
const STARTS: usize = 10;
const PATIENCE: Duration = Duration::from_secs(20);

#[test]
fn fast_dds_nodes_that_start_at_once_are_all_known() -> Result<()> {
    agent_first(Stack::Fast)
}

#[test]
fn cyclone_dds_nodes_that_start_at_once_are_all_known() -> Result<()> {
    agent_first(Stack::Cyclone)
}

#[test]
fn rust_dds_nodes_that_start_at_once_are_all_known() -> Result<()> {
    agent_first(Stack::Rust)
}

#[test]
fn fast_dds_nodes_are_all_known_when_the_agent_starts_after_half_of_them() -> Result<()> {
    agent_between(Stack::Fast)
}

#[test]
fn cyclone_dds_nodes_are_all_known_when_the_agent_starts_after_half_of_them() -> Result<()> {
    agent_between(Stack::Cyclone)
}

#[test]
fn rust_dds_nodes_are_all_known_when_the_agent_starts_after_half_of_them() -> Result<()> {
    agent_between(Stack::Rust)
}

fn agent_first(stack: Stack) -> Result<()> {
    for _ in 0..STARTS {
        let link = Link::new()?;
        let directory = tempfile::tempdir()?;
        let agent = start_agent(&link.robot, directory.path())?;
        let mut peers = launch(&link, stack, 0..PAIRS)?;
        expect_all(&agent, &mut peers)?;
    }
    Ok(())
}

fn agent_between(stack: Stack) -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let mut peers = launch(&link, stack, 0..PAIRS / 2)?;
    for peer in &mut peers {
        peer.wait_ready()?;
    }
    std::thread::sleep(Duration::from_secs(2));
    let agent = start_agent(&link.robot, directory.path())?;
    let mut later = launch(&link, stack, PAIRS / 2..PAIRS)?;
    expect_all(&agent, &mut later)
}

fn start_agent<'a>(host: &'a Namespace, directory: &std::path::Path) -> Result<Agent<'a>> {
    let configuration = directory.join("ros2probe.yaml");
    std::fs::write(&configuration, "watch:\n  - /**\n")?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}

fn launch(link: &Link, stack: Stack, pairs: std::ops::Range<usize>) -> Result<Vec<Peer>> {
    let mut peers = Vec::new();
    for pair in pairs {
        let stream = Stream {
            topic: topic(pair),
            ..Stream::small(0)
        };
        let (talker, listener) = (talker(pair), listener(pair));
        peers.push(Peer::launch(
            &link.robot,
            stack,
            Role::Publisher,
            &stream,
            &[&talker],
        )?);
        peers.push(Peer::launch(
            &link.monitor,
            stack,
            Role::Subscriber,
            &stream,
            &[&listener],
        )?);
    }
    Ok(peers)
}

/// Waits until the agent names every node and counts both ends of every topic.
fn expect_all(agent: &Agent<'_>, peers: &mut [Peer]) -> Result<()> {
    for peer in peers {
        peer.wait_ready()?;
    }
    let deadline = Instant::now() + PATIENCE;
    loop {
        let scrape = agent.scrape()?;
        let missing = missing(&scrape);
        if missing.is_empty() {
            return Ok(());
        }
        let doubts = scrape.doubts();
        assert!(
            Instant::now() < deadline,
            "not known after {PATIENCE:?}: {missing:?}; {doubts}"
        );
        std::thread::sleep(Duration::from_millis(250));
    }
}

fn missing(scrape: &Scrape) -> Vec<String> {
    let nodes: BTreeSet<String> = scrape.labels_of("ros2_node_info", "ros_node");
    let mut missing = Vec::new();
    for pair in 0..PAIRS {
        for node in [talker(pair), listener(pair)] {
            if !nodes.contains(&node) {
                missing.push(node);
            }
        }
        let topic = topic(pair);
        for ends in ["ros2_topic_publishers", "ros2_topic_subscriptions"] {
            if scrape.value(ends, &[("topic", &topic)]) != Some(1.0) {
                missing.push(format!("{ends} of {topic}"));
            }
        }
    }
    missing
}

fn topic(pair: usize) -> String {
    format!("/stream_{pair}")
}

fn talker(pair: usize) -> String {
    format!("/robot/talker_{pair}")
}

fn listener(pair: usize) -> String {
    format!("/operator/listener_{pair}")
}
