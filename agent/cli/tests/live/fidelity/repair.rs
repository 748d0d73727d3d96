//! A reliable stream that the agent sees only on the receiving host. Lost datagrams are sent again,
//! and lost last samples, which no sample follows, are still counted as lost.

use ros2probe_wire::SequenceNumber;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::report::snapshot::{AcknowledgementFacts, Delivered, Snapshot};

use super::experiment::{DISCOVERY, Truth, is_same_cause, reported, sums};
use ros2probe_testing::harness::loss::{Loss, Part};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::witness::Witness;

const PATIENCE: Duration = Duration::from_secs(60);
/// Number of first samples, some of which are dropped, in a stream of seven seconds.
const LOSSY_SAMPLES: u64 = 100;
const SAMPLES: u64 = 220;
/// Number of last samples, which the publisher sends when all samples are dropped.
const TAIL: u64 = 40;
/// One of this many datagrams with samples is dropped.
const LOSS_PERIOD: u64 = 5;

/// Counts of the agent on the receiving host.
pub(crate) struct Repair {
    sent: Truth,
    received: Truth,
    /// Sums after the repair.
    repaired: Delivered,
    dropped: u64,
    /// The reader's state while the tail is missing.
    waiting: AcknowledgementFacts,
    /// Losses reported after the writer's end.
    lost: Vec<(u64, LossCause)>,
}

impl Repair {
    pub(crate) fn of(stack: Stack) -> Result<Repair> {
        let link = Link::new()?;
        let mut witness = Witness::start(&format!(
            "watch: [/**]\ncapture: {{source: host, cgroup: {}}}\n",
            link.monitor.cgroup().display()
        ))?;
        let (mut publisher, subscriber) = delivered_pair(&link, stack, &mut witness)?;
        // The rule also matches repaired samples, alone or several in one datagram. A HEARTBEAT is
        // shorter.
        let samples = format!("udp length 380-65535 udp dport != {{ {DISCOVERY} }}");
        let loss = Loss::of_datagrams(&link.robot, &samples, LOSS_PERIOD, Part::Whole)?;
        wait_until(|| Ok(publisher.log()?.sequences("pub").len() as u64 >= LOSSY_SAMPLES))?;
        let dropped = loss.counts()?.dropped;
        drop(loss);
        // Fast DDS repeats its request within three seconds. A reader delivers samples in order, so
        // the latest sample comes after all others.
        wait_until(|| {
            let received = subscriber.log()?.sequences("sub").len();
            Ok(received + 2 > publisher.log()?.sequences("pub").len())
        })?;
        let _all = Loss::of_datagrams(&link.robot, &samples, 1, Part::Whole)?;
        publisher.start_sending()?;
        let (sent, reader) = (
            Truth::of(&publisher, "pub")?,
            Truth::of(&subscriber, "sub")?.guid,
        );
        publisher.wait_sent(PATIENCE)?;
        let sent = Truth {
            numbers: publisher.log()?.writer_numbers("pub")?,
            ..sent
        };
        let newest = *sent.numbers.last().context("nothing was sent")?;
        // The agent sees the HEARTBEAT for the tail some milliseconds before the ACKNACK that
        // answers it. Until then, the previous request is current, although the reader has received
        // all its samples.
        let waiting = witness.wait_for("what is missing", PATIENCE, |seen| {
            let facts = acknowledgement(seen, &sent.guid, &reader)?;
            let received = Truth::of(&subscriber, "sub").ok()?;
            let first = *received.missing(&sent.numbers).first()?;
            let reported = facts.acknowledged == SequenceNumber(first - 1) && facts.missing > 0;
            (reported && facts.acknowledged + facts.lag_samples == SequenceNumber(newest))
                .then_some(facts)
        })?;
        let seen = witness.latest().context("no snapshot")?;
        let repaired = sums(&seen, &sent.guid, &reader);
        let received = Truth::of(&subscriber, "sub")?;
        publisher.process.signal("KILL")?;
        publisher.process.wait(PATIENCE)?;
        // The agent waits for announced samples as long as the reader exists.
        let testimony = witness.finish()?;
        testimony.ensure_complete()?;
        let lost = reported(
            &testimony.delivery_losses,
            &seen,
            &sent.guid,
            &received.guid,
        )?;
        Ok(Repair {
            sent,
            received,
            repaired,
            dropped,
            waiting,
            lost: lost.into_iter().collect(),
        })
    }

    pub(crate) fn ensure_reported(&self) -> Result<()> {
        let Repair {
            sent,
            received,
            repaired,
            dropped,
            waiting,
            lost,
        } = self;
        println!(
            "{} sent, {dropped} datagrams dropped, {} received; {repaired:?}; {waiting:?}; {} lost",
            sent.numbers.len(),
            received.numbers.len(),
            lost.len()
        );
        let missing = received.missing(&sent.numbers);
        ensure!(!missing.is_empty() && *dropped > 0);
        ensure!(
            repaired.messages == received.numbers.len() as u64,
            "{repaired:?}"
        );
        ensure!(
            repaired.recovered > 0 && repaired.lost() == 0,
            "{repaired:?}"
        );
        ensure!(repaired.recovery_seconds > 0.0, "{repaired:?}");
        // The reader acknowledges all samples before the first that it misses.
        let first = *missing.first().context("nothing is missing")?;
        ensure!(
            waiting.acknowledged == SequenceNumber(first - 1),
            "{waiting:?}, {first} is missing"
        );
        let expected: Vec<_> = missing
            .iter()
            .map(|each| (*each, LossCause::BeforeHost))
            .collect();
        ensure!(*lost == expected, "{lost:?} are lost, not {missing:?}");
        Ok(())
    }
}

/// Starts a reliable stream, and waits until the agent has identified the socket that receives its
/// samples.
fn delivered_pair(link: &Link, stack: Stack, witness: &mut Witness) -> Result<(Peer, Peer)> {
    let stream = Stream {
        reliable: true,
        depth: 1000,
        rate: 30.0,
        stretch: SAMPLES - TAIL,
        linger: 120.0,
        ..Stream::small(SAMPLES)
    };
    let host = &link.monitor;
    let mut subscriber = Peer::start(host, stack, Role::Subscriber, &stream, &["/listener"])?;
    let host = &link.robot;
    let mut publisher = Peer::start(host, stack, Role::Publisher, &stream, &["/talker"])?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    witness.wait_for("the endpoints", PATIENCE, |seen| {
        let mut topics = seen.topics.iter();
        let topic = topics.find(|topic| topic.name == stream.topic)?;
        let known = (topic.publishers.len(), topic.subscriptions.len());
        (known == (1, 1)).then_some(())
    })?;

    publisher.start_sending()?;
    // RustDDS sends to a multicast address, so the agent learns only later which socket receives
    // it.
    witness.wait_for("the socket that receives samples", PATIENCE, |seen| {
        let mut deliveries = seen.topics.iter().flat_map(|topic| &topic.deliveries);
        let known = deliveries.any(|each| !each.readers.is_empty() && each.delivered.messages > 0);
        known.then_some(())
    })?;
    Ok((publisher, subscriber))
}

fn acknowledgement(seen: &Snapshot, writer: &str, reader: &str) -> Option<AcknowledgementFacts> {
    let mut facts = seen.topics.iter().flat_map(|topic| &topic.acknowledgements);
    facts
        .find(|each| is_same_cause(each.writer, writer) && is_same_cause(each.reader, reader))
        .cloned()
}

fn wait_until(what: impl Fn() -> Result<bool>) -> Result<()> {
    let deadline = std::time::Instant::now() + PATIENCE;
    while !what()? {
        ensure!(
            std::time::Instant::now() < deadline,
            "not within {PATIENCE:?}"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}
