//! Observing leaves the robot as it was: no participant of the agent's own, no packet sent.

mod harness;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Result, bail};
use harness::agent::Agent;
use harness::capture::Capture;
use harness::network::{Link, Namespace};
use harness::peer::{Peer, Role, Stack, Stream};

#[test]
fn a_host_that_runs_only_the_agent_sends_nothing() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("link.pcap");
    let agent = start_agent(&link.robot, directory.path())?;
    let capture = Capture::start(&link.monitor, &file)?;
    for stack in Stack::ALL {
        stream_on(&link.monitor, &link.monitor, stack)?;
    }
    let appeared = [("entity", "participant"), ("event", "appeared")];
    let known = agent
        .settled_scrape()?
        .sum("ros2_discovery_events_total", &appeared);
    let file = capture.finish()?;
    assert!(known > 0.0, "the agent saw no participant on the link");
    let sent = tshark(
        &file,
        &format!("ip.src == {}", link.robot.address()),
        "frame.protocols",
    )?;
    assert_eq!(sent, Vec::<String>::new());
    Ok(())
}

#[test]
fn the_link_carries_the_participants_and_endpoints_of_the_nodes_alone() -> Result<()> {
    let mut seen = Vec::new();
    for observed in [false, true] {
        let link = Link::new()?;
        let directory = tempfile::tempdir()?;
        let agent = match observed {
            true => Some(start_agent(&link.robot, directory.path())?),
            false => None,
        };
        let file = directory.path().join("link.pcap");
        let capture = Capture::start(&link.robot, &file)?;
        let prefixes = stream_on(&link.robot, &link.monitor, Stack::Cyclone)?;
        let file = capture.finish()?;
        drop(agent);
        let sources: BTreeSet<String> = tshark(&file, "rtps", "rtps.guidPrefix.src")?
            .into_iter()
            .collect();
        assert_eq!(
            sources, prefixes,
            "participants on the link, agent running: {observed}"
        );
        let announced: BTreeSet<String> =
            tshark(&file, "rtps.param.topicName", "rtps.param.topicName")?
                .into_iter()
                .collect();
        seen.push(announced);
    }
    let [without, with] = &seen[..] else {
        bail!("two captures");
    };
    assert!(!without.is_empty());
    assert_eq!(
        with, without,
        "endpoints announced with and without the agent"
    );
    Ok(())
}

/// Runs a short stream and returns the GUID prefixes of its two participants.
fn stream_on(from: &Namespace, to: &Namespace, stack: Stack) -> Result<BTreeSet<String>> {
    let stream = Stream::small(200);
    let mut subscriber = Peer::start(to, stack, Role::Subscriber, &stream, &["/listener"])?;
    let mut publisher = Peer::start(from, stack, Role::Publisher, &stream, &["/talker"])?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    publisher.go()?;
    publisher.wait_sent(Duration::from_secs(20))?;
    publisher.process.wait(Duration::from_secs(10))?;
    subscriber.process.terminate()?;
    let logs = [publisher.log()?, subscriber.log()?];
    let guids = logs
        .iter()
        .flat_map(|log| log.endpoints())
        .filter_map(|event| event.guid.clone());
    Ok(guids.map(|guid| guid.chars().take(24).collect()).collect())
}

fn start_agent<'a>(host: &'a Namespace, directory: &Path) -> Result<Agent<'a>> {
    let configuration = directory.join("ros2probe.yaml");
    std::fs::write(&configuration, "watch:\n  - /**\n")?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}

/// One field of every packet that a display filter keeps, as the independent dissector reads it.
fn tshark(file: &Path, keep: &str, field: &str) -> Result<Vec<String>> {
    let output = Command::new("tshark")
        .arg("-r")
        .arg(file)
        .args([
            "-Y",
            keep,
            "-T",
            "fields",
            "-E",
            "occurrence=f",
            "-e",
            field,
        ])
        .output()?;
    if !output.status.success() {
        bail!("tshark: {}", String::from_utf8_lossy(&output.stderr));
    }
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    Ok(text
        .lines()
        .filter(|line| !line.is_empty())
        .map(str::to_owned)
        .collect())
}
