//! Two robots with an agent each, and packets lost between them. A real Prometheus scrapes both
//! agents and subtracts received from sent messages. The difference is exactly the number of lost
//! messages.
//!
//! The references are the logs of publisher and subscriber, and the count of dropped datagrams.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, datagrams_alone_of};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::prometheus::Prometheus;
use ros2probe_testing::harness::switch::Switched;

/// Samples of six seconds.
const SAMPLES: u64 = 1_200;
const SAMPLES_PER_STRETCH: u64 = 40;
/// Maximum time for repairs, scrapes and rules on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
/// Gaps are settled after a second. Scrapes and rules take another second each.
const SETTLE_TIME: Duration = Duration::from_millis(3500);
const PER_MILLE: u16 = 200;
/// Ratio of dropped frames, of which a point cloud takes some 450.
const FRAMES_PER_MILLE: u16 = 1;

#[derive(Clone, Copy)]
enum Source {
    Host,
    Wire,
}

/// Counts of one writer's samples from one robot to the other.
#[derive(Clone, Copy, Debug, PartialEq)]
struct TransferCounts {
    published: u64,
    received: u64,
    dropped: u64,
    /// Results of the rules.
    difference: f64,
    ratio: f64,
    before_host: f64,
    socket_buffer: f64,
}

#[test]
fn fast_dds_losses_between_hosts_equal_the_difference_of_counts_on_the_wire() -> Result<()> {
    best_effort(Source::Wire, Stack::Fast)
}

#[test]
fn cyclone_dds_losses_between_hosts_equal_the_difference_of_counts_on_the_wire() -> Result<()> {
    best_effort(Source::Wire, Stack::Cyclone)
}

#[test]
fn rust_dds_losses_between_hosts_equal_the_difference_of_counts_on_the_wire() -> Result<()> {
    best_effort(Source::Wire, Stack::Rust)
}

#[test]
fn fast_dds_losses_between_hosts_equal_the_difference_of_counts_at_the_sockets() -> Result<()> {
    best_effort(Source::Host, Stack::Fast)
}

#[test]
fn cyclone_dds_losses_between_hosts_equal_the_difference_of_counts_at_the_sockets() -> Result<()> {
    best_effort(Source::Host, Stack::Cyclone)
}

#[test]
fn rust_dds_losses_between_hosts_equal_the_difference_of_counts_at_the_sockets() -> Result<()> {
    best_effort(Source::Host, Stack::Rust)
}

#[test]
fn repaired_samples_do_not_count_as_lost_between_hosts_on_the_wire() -> Result<()> {
    reliable(Source::Wire, Stack::Cyclone)
}

#[test]
fn repaired_samples_do_not_count_as_lost_between_hosts_at_the_sockets() -> Result<()> {
    reliable(Source::Host, Stack::Fast)
}

#[test]
fn fast_dds_point_clouds_with_a_lost_frame_equal_the_difference_of_counts() -> Result<()> {
    point_clouds(Stack::Fast)
}

#[test]
fn cyclone_dds_point_clouds_with_a_lost_frame_equal_the_difference_of_counts() -> Result<()> {
    point_clouds(Stack::Cyclone)
}

fn best_effort(source: Source, stack: Stack) -> Result<()> {
    let seen = TransferCounts::of(source, stack, &stream())?;
    let lost = seen.lost();
    ensure!(seen.published == SAMPLES, "{} published", seen.published);
    ensure!(
        lost == seen.dropped && lost > SAMPLES / 10,
        "{lost} lost, {} dropped",
        seen.dropped
    );
    ensure!(
        seen.difference == lost as f64,
        "{} by the rule, {lost} lost",
        seen.difference
    );
    // The receiver's agent alone cannot count losses after the last sample that arrived.
    ensure!(
        seen.before_host <= lost as f64 && seen.before_host >= lost as f64 - 20.0,
        "{} of {lost} noticed by the receiver",
        seen.before_host
    );
    // Each rate starts with the first scrape, during the first stretch.
    let lost_of = |received: u64, published: u64| 1.0 - received as f64 / published as f64;
    let least = lost_of(seen.received, seen.published - SAMPLES_PER_STRETCH);
    let most = lost_of(seen.received - SAMPLES_PER_STRETCH, seen.published);
    let expected = least - 0.05..most + 0.05;
    ensure!(
        expected.contains(&seen.ratio),
        "{} by the rule, not {expected:?}",
        seen.ratio
    );
    Ok(())
}

fn reliable(source: Source, stack: Stack) -> Result<()> {
    let stream = Stream {
        reliable: true,
        ..stream()
    };
    let seen = TransferCounts::of(source, stack, &stream)?;
    ensure!(seen.dropped > SAMPLES / 10, "{} dropped", seen.dropped);
    // Some samples are overwritten in the writer's history before they can be sent again.
    let lost = seen.lost();
    ensure!(lost < seen.dropped / 2, "{lost} lost");
    ensure!(
        seen.difference == lost as f64 && seen.before_host <= lost as f64,
        "{} by the rule, {} by the receiver, {lost} lost",
        seen.difference,
        seen.before_host
    );
    Ok(())
}

/// A point cloud has hundreds of frames. If one frame is lost, so is the point cloud, in the
/// reassembly of the receiver's kernel or library. A point cloud that a full socket buffer dropped
/// did arrive at the host.
fn point_clouds(stack: Stack) -> Result<()> {
    let stream = Stream {
        linger: 120.0,
        stretch: 10,
        ..Stream::point_cloud(644_000, 120)
    };
    let seen = TransferCounts::of(Source::Host, stack, &stream)?;
    ensure!(seen.dropped > 10, "{} dropped", seen.dropped);
    ensure!(
        seen.is_explained() && seen.difference > 5.0,
        "{} by the rule, {} in the socket buffer, {} lost",
        seen.difference,
        seen.socket_buffer,
        seen.lost()
    );
    Ok(())
}

/// Returns a stream whose publisher stays until its counts are read.
fn stream() -> Stream {
    Stream {
        linger: 120.0,
        stretch: SAMPLES_PER_STRETCH,
        ..Stream::small(SAMPLES)
    }
}

impl TransferCounts {
    fn of(source: Source, stack: Stack, stream: &Stream) -> Result<TransferCounts> {
        let Switched { link, switch } = Switched::new()?;
        let directory = tempfile::tempdir()?;
        let robot = start(&link.robot, source, stream, directory.path())?;
        let monitor = start(&link.monitor, source, stream, directory.path())?;
        let targets = [&link.robot, &link.monitor].map(|host| format!("{}:17400", host.address()));
        let rules = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dashboards/rules");
        let rules: [PathBuf; 1] = [rules.join("ros2probe.rules.yaml")];
        let prometheus = Prometheus::start(&link.monitor, &targets, &rules)?;

        let mut subscriber = Peer::start(
            &link.monitor,
            stack,
            Role::Subscriber,
            stream,
            &["/listener"],
        )?;
        let mut publisher = Peer::start(&link.robot, stack, Role::Publisher, stream, &["/talker"])?;
        subscriber.wait_matched()?;
        publisher.wait_matched()?;
        prometheus.wait_for("sum(up)", 2.0)?;
        // Rates begin with the second scrape of a series, so losses begin only after the first.
        publisher.start_sending()?;
        let topic = format!("topic=\"{}\"", stream.topic);
        let sent = format!("max(ros2_writer_sent_messages_total{{{topic}}})");
        prometheus.wait_for(&sent, stream.stretch as f64)?;
        let received = format!("sum(ros2_subscriber_received_messages_total{{{topic}}})");
        prometheus.wait_for(&format!("{received} > bool 0"), 1.0)?;
        let loss = if stream.size > 1_000 {
            let frames = format!("ip daddr {} ip length > 1000", link.monitor.address());
            Loss::of(&switch, &frames, FRAMES_PER_MILLE)?
        } else {
            Loss::of_samples(&switch, &link.monitor, stream, PER_MILLE)?
        };
        while publisher.log()?.sequences("pub").len() as u64 + stream.stretch <= stream.count {
            let due = publisher.log()?.sequences("pub").len() as u64 + stream.stretch;
            publisher.start_sending()?;
            let deadline = Instant::now() + PATIENCE;
            while (publisher.log()?.sequences("pub").len() as u64) < due {
                ensure!(Instant::now() < deadline, "{due} samples are not sent");
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        publisher.wait_sent(PATIENCE)?;
        // The counts settle and are scraped and evaluated while publisher and subscriber still
        // exist.
        let deadline = Instant::now() + PATIENCE;
        let (mut before, mut since) = (None, Instant::now());
        let mut journey = loop {
            // The rules are evaluated one after the other, and a series may be new or old.
            let numbers = TransferCounts::ask(&prometheus, &publisher, &subscriber, stream);
            if numbers.is_err() && Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(500));
                continue;
            }
            let numbers = numbers?;
            // The ratio changes with time.
            let counted = TransferCounts {
                ratio: 0.0,
                ..numbers
            };
            if before.replace(counted) != Some(counted) {
                since = Instant::now();
            }
            let is_still = since.elapsed() >= SETTLE_TIME;
            if is_still && numbers.is_explained() || Instant::now() > deadline {
                break numbers;
            }
            std::thread::sleep(Duration::from_millis(500));
        };
        journey.dropped = loss.counts()?.dropped;
        drop((robot, monitor));
        Ok(journey)
    }

    /// Reads the present counts. The number of dropped datagrams is not known here.
    fn ask(
        prometheus: &Prometheus<'_>,
        publisher: &Peer,
        subscriber: &Peer,
        stream: &Stream,
    ) -> Result<TransferCounts> {
        let labels = format!("topic=\"{}\"", stream.topic);
        let rule = |name: &str| {
            let series = format!("subscriber:ros2_between_hosts_lost_messages:{name}{{{labels}}}");
            let value = prometheus.query(&series)?;
            let several = prometheus.series(&series)?;
            ensure!(several == 1, "{several} series of {series}");
            Ok(value)
        };
        let cause = |cause: &str| {
            let cause = format!("{labels},cause=\"{cause}\"");
            prometheus.query(&format!(
                "sum(ros2_subscriber_lost_messages_total{{{cause}}})"
            ))
        };
        let published: BTreeSet<u64> = publisher.log()?.sequences("pub").into_iter().collect();
        let received: BTreeSet<u64> = subscriber.log()?.sequences("sub").into_iter().collect();
        Ok(TransferCounts {
            published: published.len() as u64,
            received: received.len() as u64,
            dropped: 0,
            difference: rule("difference")?,
            ratio: rule("ratio_rate5m")?,
            before_host: cause("before_host")?,
            socket_buffer: cause("socket_buffer")?,
        })
    }

    fn lost(&self) -> u64 {
        self.published - self.received
    }

    fn is_explained(&self) -> bool {
        self.difference + self.socket_buffer == self.lost() as f64
    }
}

fn start<'a>(
    host: &'a Namespace,
    source: Source,
    stream: &Stream,
    directory: &Path,
) -> Result<Agent<'a>> {
    let source = match source {
        // Both robots are on one machine, so each agent observes only its own robot.
        Source::Host => datagrams_alone_of(host),
        Source::Wire => PACKETS_ALONE.to_owned(),
    };
    let configuration = directory.join(format!("{}.yaml", host.name()));
    let text = format!(
        "watch: [{{topic: {}, per_subscriber: true}}]\n\
         {source}\
         metrics: {{listen: '0.0.0.0:17400'}}\n",
        stream.topic
    );
    std::fs::write(&configuration, text)?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}
