//! Reports of endpoints that do not match, and checks that they really do not: Fast DDS and Cyclone
//! DDS, each alone and with the other.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, Scrape};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};

/// Maximum wait for discovery and its consequences on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn a_reliable_subscriber_of_a_best_effort_publisher_is_reported_and_gets_nothing() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: [/**]\nlog: warn\n{PACKETS_ALONE}"))?;
    let agent = Agent::start(&link.monitor, Path::new(env!("CARGO_BIN_EXE_rp")), &file)?;
    for (publishes, subscribes) in [
        (Stack::Fast, Stack::Fast),
        (Stack::Cyclone, Stack::Cyclone),
        (Stack::Fast, Stack::Cyclone),
        (Stack::Cyclone, Stack::Fast),
    ] {
        let topic = format!("/{publishes:?}_to_{subscribes:?}").to_lowercase();
        let offered = Stream {
            topic: topic.clone(),
            ..Stream::small(200)
        };
        let requested = Stream {
            reliable: true,
            ..offered.clone()
        };
        let subscriber = |stream, node| {
            let nodes = [node];
            Peer::start(&link.monitor, subscribes, Role::Subscriber, stream, &nodes)
        };
        let deaf = subscriber(&requested, "/deaf")?;
        let mut listener = subscriber(&offered, "/listener")?;
        let nodes = ["/talker"];
        let mut talker = Peer::start(&link.robot, publishes, Role::Publisher, &offered, &nodes)?;
        listener.wait_matched()?;
        talker.wait_matched()?;

        let labels = [("topic", topic.as_str())];
        let pairs = |page: &Scrape| page.sum("ros2_qos_incompatible_pairs", &labels);
        let by_reliability = |page: &Scrape| {
            let labels = [("topic", topic.as_str()), ("policy", "reliability")];
            page.sum("ros2_qos_incompatible_pairs", &labels)
        };
        // Only one of the two subscribers is reported, and for no other reason.
        wait(&agent, &topic, |page| {
            by_reliability(page) == 1.0 && pairs(page) == 1.0
        })?;

        talker.start_sending()?;
        talker.wait_sent(PATIENCE)?;
        let deadline = Instant::now() + PATIENCE;
        while listener.log()?.sequences("sub").is_empty() {
            ensure!(
                Instant::now() < deadline,
                "{topic}: the listener hears nothing"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
        assert_eq!(deaf.log()?.sequences("sub"), [0; 0], "{topic}");

        talker.process.terminate()?;
        wait(&agent, &topic, |page| pairs(page) == 0.0)?;
    }
    Ok(())
}

fn wait(agent: &Agent<'_>, topic: &str, shows: impl Fn(&Scrape) -> bool) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let page = agent.scrape()?;
        if shows(&page) {
            return Ok(());
        }
        let late = Instant::now() > deadline;
        ensure!(!late, "{topic}: {}", page.0);
        std::thread::sleep(Duration::from_millis(200));
    }
}
