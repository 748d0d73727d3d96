//! The agent beside a real publisher counts what was sent and what passed the link: three DDS
//! stacks, small samples with 0, 10 and 20 % loss, and point clouds of 644 KB and 2.72 MB.

mod harness;

use std::time::Duration;

use anyhow::{Context as _, Result};
use harness::agent::{Agent, Scrape};
use harness::loss::Loss;
use harness::network::Link;
use harness::peer::{Peer, Role, Stack, Stream};

const SMALL_SAMPLES: u64 = 1000;
const POINT_CLOUDS: u64 = 100;

#[test]
fn fast_dds_small_samples_are_all_counted() -> Result<()> {
    small_samples(Stack::Fast, 0)
}

#[test]
fn fast_dds_small_samples_lost_at_10_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Fast, 100)
}

#[test]
fn fast_dds_small_samples_lost_at_20_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Fast, 200)
}

#[test]
fn cyclone_dds_small_samples_are_all_counted() -> Result<()> {
    small_samples(Stack::Cyclone, 0)
}

#[test]
fn cyclone_dds_small_samples_lost_at_10_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Cyclone, 100)
}

#[test]
fn cyclone_dds_small_samples_lost_at_20_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Cyclone, 200)
}

#[test]
fn rust_dds_small_samples_are_all_counted() -> Result<()> {
    small_samples(Stack::Rust, 0)
}

#[test]
fn rust_dds_small_samples_lost_at_10_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Rust, 100)
}

#[test]
fn rust_dds_small_samples_lost_at_20_percent_are_counted_as_lost() -> Result<()> {
    small_samples(Stack::Rust, 200)
}

#[test]
fn fast_dds_point_clouds_of_644_kb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Fast, 644_000)
}

#[test]
fn fast_dds_point_clouds_of_2_72_mb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Fast, 2_720_000)
}

#[test]
fn cyclone_dds_point_clouds_of_644_kb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Cyclone, 644_000)
}

#[test]
fn cyclone_dds_point_clouds_of_2_72_mb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Cyclone, 2_720_000)
}

#[test]
fn rust_dds_point_clouds_of_644_kb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Rust, 644_000)
}

#[test]
fn rust_dds_point_clouds_of_2_72_mb_are_all_counted() -> Result<()> {
    point_clouds(Stack::Rust, 2_720_000)
}

fn small_samples(stack: Stack, per_mille: u16) -> Result<()> {
    let observed = Observed::stream(stack, &Stream::small(SMALL_SAMPLES), per_mille)?;
    let passed = SMALL_SAMPLES - observed.dropped;
    assert_eq!(observed.sent, SMALL_SAMPLES);
    assert_eq!(observed.received, passed, "the subscriber got what passed");
    assert_eq!(observed.count("ros2_topic_messages_total"), passed);
    assert_eq!(observed.count("ros2_topic_bytes_total"), passed * 320);
    assert_eq!(
        observed.count("ros2_topic_lost_messages_total"),
        observed.missing
    );
    assert_eq!(observed.count("ros2_topic_duplicate_messages_total"), 0);
    Ok(())
}

/// The subscriber may lose point clouds to its own socket buffer; the wire does not.
fn point_clouds(stack: Stack, size: usize) -> Result<()> {
    let observed = Observed::stream(stack, &Stream::point_cloud(size, POINT_CLOUDS), 0)?;
    assert_eq!(observed.sent, POINT_CLOUDS);
    let counted = observed.count("ros2_topic_messages_total");
    assert_eq!(
        counted,
        POINT_CLOUDS,
        "{} received; {}",
        observed.received,
        observed.scrape.doubts()
    );
    assert_eq!(
        observed.count("ros2_topic_bytes_total"),
        POINT_CLOUDS * size as u64
    );
    assert_eq!(observed.count("ros2_topic_lost_messages_total"), 0);
    // RustDDS sends 1280 bytes of sample a datagram, the others 13 KB and 65 KB: a record each.
    let share = match (stack, size) {
        (Stack::Rust, _) => 0.10,
        (_, 2_720_000) => 0.01,
        _ => 0.02,
    };
    let copied = observed
        .scrape
        .sum("ros2probe_capture_copied_bytes_total", &[]);
    let traffic = (POINT_CLOUDS * size as u64) as f64;
    assert!(
        copied < traffic * share,
        "copied {copied} of {traffic} bytes"
    );
    Ok(())
}

/// A best-effort stream from one host to the other as its ends, the link and the agent saw it.
struct Observed {
    topic: String,
    sent: u64,
    received: u64,
    /// Samples missing between the first and the last that passed.
    missing: u64,
    dropped: u64,
    scrape: Scrape,
}

impl Observed {
    fn stream(stack: Stack, stream: &Stream, per_mille: u16) -> Result<Observed> {
        let link = Link::new()?;
        let directory = tempfile::tempdir()?;
        let configuration = directory.path().join("ros2probe.yaml");
        std::fs::write(&configuration, "watch:\n  - /**\n")?;
        let agent = Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &configuration)?;
        let listener = ["/listener"];
        let mut subscriber =
            Peer::start(&link.monitor, stack, Role::Subscriber, stream, &listener)?;
        let mut publisher = Peer::start(&link.robot, stack, Role::Publisher, stream, &["/sensor"])?;
        subscriber.wait_matched()?;
        publisher.wait_matched()?;
        let loss = match per_mille {
            0 => None,
            _ => Some(Loss::of_samples(
                &link.robot,
                &link.monitor,
                stream,
                per_mille,
            )?),
        };
        publisher.go()?;
        publisher
            .wait_sent(Duration::from_secs(60))
            .context("the publisher sends")?;
        let scrape = agent.settled_scrape()?;
        let dropped = loss
            .map(|loss| loss.counts())
            .transpose()?
            .map_or(0, |counts| counts.dropped);
        subscriber.process.terminate()?;
        let received = subscriber.log()?;
        Ok(Observed {
            topic: stream.topic.clone(),
            sent: publisher.log()?.sequences("pub").len() as u64,
            received: received.sequences("sub").len() as u64,
            missing: received.missing(),
            dropped,
            scrape,
        })
    }

    /// A counter of the stream's topic.
    fn count(&self, name: &str) -> u64 {
        self.scrape.sum(name, &[("topic", &self.topic)]) as u64
    }
}
