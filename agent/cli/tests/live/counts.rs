//! The agent on either end of a link counts exactly the samples that passed there. The tests use
//! three DDS stacks, small samples with 0, 10 and 20 % loss, and point clouds of 644 KB and 2.72
//! MB.
//!
//! Datagrams are dropped before the packet taps of the publisher's host, so no agent sees them. The
//! references are the peers' logs, the count of dropped datagrams, and tshark on recordings of both
//! ends. At 54 MB/s subscribers lose whole samples in their socket buffers, and only a recording
//! shows what was on the wire.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::{PoisonError, RwLock};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, Scrape};
use ros2probe_testing::harness::bpf::wait_metered;
use ros2probe_testing::harness::capture::{self, Capture};
use ros2probe_testing::harness::dissection::{Dissection, Samples};
use ros2probe_testing::harness::event_log::EventLog;
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};

/// Samples of three seconds.
const SMALL_SAMPLES: u64 = 600;
const POINT_CLOUDS: u64 = 60;
/// Maximum mean difference in seconds between the clocks of a frame's two observers, the agent's
/// filter and tcpdump.
const CLOCK_TOLERANCE: f64 = 0.002;
const LATENCIES: [&str; 2] = [
    "ros2_topic_latency_seconds",
    "ros2_topic_header_latency_seconds",
];

/// Point clouds run alone on the machine, also if tests are threads of one process.
static MACHINE: RwLock<()> = RwLock::new(());

#[test]
fn fast_dds_small_samples_are_counted_and_counted_as_lost_at_10_and_20_percent() -> Result<()> {
    best_effort(Stack::Fast)
}

#[test]
fn fast_dds_reliable_samples_dropped_at_10_and_20_percent_count_as_recovered() -> Result<()> {
    reliable(Stack::Fast)
}

#[test]
fn fast_dds_point_clouds_of_644_kb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Fast, 644_000)
}

#[test]
fn fast_dds_point_clouds_of_2_72_mb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Fast, 2_720_000)
}

#[test]
fn cyclone_dds_small_samples_are_counted_and_counted_as_lost_at_10_and_20_percent() -> Result<()> {
    best_effort(Stack::Cyclone)
}

#[test]
fn cyclone_dds_reliable_samples_dropped_at_10_and_20_percent_count_as_recovered() -> Result<()> {
    reliable(Stack::Cyclone)
}

#[test]
fn cyclone_dds_point_clouds_of_644_kb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Cyclone, 644_000)
}

#[test]
fn cyclone_dds_point_clouds_of_2_72_mb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Cyclone, 2_720_000)
}

#[test]
fn rust_dds_small_samples_are_counted_and_counted_as_lost_at_10_and_20_percent() -> Result<()> {
    best_effort(Stack::Rust)
}

#[test]
fn rust_dds_reliable_samples_dropped_at_10_and_20_percent_count_as_recovered() -> Result<()> {
    reliable(Stack::Rust)
}

#[test]
fn rust_dds_point_clouds_of_644_kb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Rust, 644_000)
}

#[test]
fn rust_dds_point_clouds_of_2_72_mb_are_counted_as_recorded_on_the_wire() -> Result<()> {
    point_clouds(Stack::Rust, 2_720_000)
}

/// Streams without loss, with 10 and with 20 % loss.
fn best_effort(stack: Stack) -> Result<()> {
    let _shared = MACHINE.read().unwrap_or_else(PoisonError::into_inner);
    let streams = [0, 100, 200].map(|per_mille| lossy(&Stream::small(SMALL_SAMPLES), per_mille));
    for seen in Exchange::each(stack, &streams)? {
        assert_eq!(seen.sent.sequences("pub").len() as u64, SMALL_SAMPLES);
        let received: BTreeSet<u64> = seen.received.sequences("sub").into_iter().collect();
        assert_eq!(received.len() as u64, SMALL_SAMPLES - seen.dropped);
        for end in &seen.ends {
            let counted = end.counted();
            assert_eq!(end.wire.application_numbers(), received, "{}", end.name);
            assert_eq!(counted.messages, received.len() as u64, "{}", end.name);
            assert_eq!(counted.lost, seen.received.missing(), "{}", end.name);
            assert_eq!(counted.bytes, counted.messages * 320, "{}", end.name);
            assert_eq!(
                (counted.recovered, counted.incomplete),
                (0, 0),
                "{}",
                end.name
            );
            assert_eq!(counted.duplicates, end.wire.repeated, "{}", end.name);
            end.assert_delays(&seen.received)?;
        }
    }
    Ok(())
}

/// Streams with 10 and with 20 % loss.
fn reliable(stack: Stack) -> Result<()> {
    let _shared = MACHINE.read().unwrap_or_else(PoisonError::into_inner);
    let stream = Stream {
        reliable: true,
        depth: 1000,
        ..Stream::small(SMALL_SAMPLES)
    };
    let streams = [100, 200].map(|per_mille| lossy(&stream, per_mille));
    for seen in Exchange::each(stack, &streams)? {
        assert_eq!(seen.sent.sequences("pub").len() as u64, SMALL_SAMPLES);
        let received: BTreeSet<u64> = seen.received.sequences("sub").into_iter().collect();
        assert_eq!(received, (0..SMALL_SAMPLES).collect());
        assert!(seen.dropped > 0);
        for end in &seen.ends {
            let counted = end.counted();
            assert_eq!(end.wire.application_numbers(), received, "{}", end.name);
            assert_eq!(counted.messages, SMALL_SAMPLES, "{}", end.name);
            assert_eq!(counted.bytes, SMALL_SAMPLES * 320, "{}", end.name);
            assert_eq!((counted.lost, counted.incomplete), (0, 0), "{}", end.name);
            let early = end.wire.announced_early;
            let recovered = end.wire.retransmitted..=end.wire.retransmitted + early;
            assert!(recovered.contains(&counted.recovered), "{}", end.name);
            assert!(stack == Stack::Rust || early == 0, "{}", end.name);
            assert_eq!(counted.duplicates, end.wire.repeated, "{}", end.name);
        }
    }
    Ok(())
}

/// Returns a stream with this loss, on a topic of its own.
fn lossy(stream: &Stream, per_mille: u16) -> (Stream, u16) {
    let topic = format!("{}_{per_mille}", stream.topic);
    let stream = Stream {
        topic,
        ..stream.clone()
    };
    (stream, per_mille)
}

fn point_clouds(stack: Stack, size: usize) -> Result<()> {
    let _alone = MACHINE.write().unwrap_or_else(PoisonError::into_inner);
    let stream = Stream::point_cloud(size, POINT_CLOUDS);
    for seen in Exchange::each(stack, &[(stream, 0)])? {
        assert_eq!(seen.sent.sequences("pub").len() as u64, POINT_CLOUDS);
        for end in &seen.ends {
            let counted = end.counted();
            let passed = end.wire.whole.len() as u64;
            assert_eq!(counted.messages, passed, "{}", end.name);
            assert_eq!(counted.lost, end.wire.missing(), "{}", end.name);
            assert_eq!(counted.bytes, passed * size as u64, "{}", end.name);
            assert_eq!(counted.recovered, 0, "{}", end.name);
            // Every sample whose last datagram left the publisher was seen at least in part.
            assert!(passed + counted.lost >= POINT_CLOUDS - 1, "{}", end.name);
            // A sample is one record. Discovery and the stream's beginning are copied in addition.
            // So are the samples that are sent until the agent has read from a header which frame
            // it names. A busy machine lets it wait for a sample or two.
            let share = if size == 2_720_000 { 0.01 } else { 0.02 };
            let copied = end.scrape.sum("ros2probe_capture_copied_bytes_total", &[]);
            let traffic = counted.bytes as f64;
            assert!(
                copied < traffic * share + 3.0 * size as f64,
                "{}: copied {copied} of {traffic} bytes",
                end.name
            );
            end.assert_delays(&seen.received)?;
        }
    }
    Ok(())
}

/// One stream from one host to the other as its ends, the link and both agents saw it.
struct Exchange {
    sent: EventLog,
    received: EventLog,
    dropped: u64,
    ends: [End; 2],
}

/// One end of the link: its recording, and the counts of its agent.
struct End {
    name: &'static str,
    topic: String,
    wire: Samples,
    scrape: Scrape,
}

#[derive(Debug)]
struct Counted {
    messages: u64,
    bytes: u64,
    lost: u64,
    recovered: u64,
    duplicates: u64,
    incomplete: u64,
}

impl Exchange {
    /// Sends the streams one after the other, each with its loss, under one observation.
    fn each(stack: Stack, streams: &[(Stream, u16)]) -> Result<Vec<Exchange>> {
        let link = Link::new()?;
        let directory = tempfile::tempdir()?;
        let configuration = directory.path().join("ros2probe.yaml");
        std::fs::write(&configuration, format!("watch: [/**]\n{PACKETS_ALONE}"))?;
        let observers = [
            Observer::start("robot", &link.robot, &configuration)?,
            Observer::start("monitor", &link.monitor, &configuration)?,
        ];
        let passages = streams
            .iter()
            .map(|(stream, per_mille)| Passage::of(stack, stream, *per_mille, &link, &observers));
        let passages: Vec<Passage> = passages.collect::<Result<_>>()?;
        let [robot, monitor] = observers;
        let wires = [robot.finish()?, monitor.finish()?];
        let mut all = Vec::new();
        for (passage, (_, per_mille)) in passages.into_iter().zip(streams) {
            let seen = passage.compared_with(&wires);
            seen.print(stack, *per_mille);
            all.push(seen);
        }
        Ok(all)
    }

    fn print(&self, stack: Stack, per_mille: u16) {
        for end in &self.ends {
            println!(
                "{stack:?} {} at {per_mille}/1000 on {}: sent {}, dropped {}, on the wire {} (retransmitted {}, early {}, \
                 repeated {}, missing {}), received {}, {:?}",
                end.topic,
                end.name,
                self.sent.sequences("pub").len(),
                self.dropped,
                end.wire.whole.len(),
                end.wire.retransmitted,
                end.wire.announced_early,
                end.wire.repeated,
                end.wire.missing(),
                self.received.sequences("sub").len(),
                end.counted(),
            );
            println!("{}", end.scrape.suspicious_counters());
        }
    }
}

/// A stream as its peers logged it and both agents counted it.
struct Passage {
    topic: String,
    writer: String,
    sent: EventLog,
    received: EventLog,
    dropped: u64,
    scrapes: [(&'static str, Scrape); 2],
}

impl Passage {
    fn of(
        stack: Stack,
        stream: &Stream,
        per_mille: u16,
        link: &Link,
        observers: &[Observer<'_>; 2],
    ) -> Result<Passage> {
        let stream = Stream {
            linger: 60.0,
            ..stream.clone()
        };
        let (talker, listener) = (["/talker"], ["/listener"]);
        let mut subscriber =
            Peer::start(&link.monitor, stack, Role::Subscriber, &stream, &listener)?;
        let mut publisher = Peer::start(&link.robot, stack, Role::Publisher, &stream, &talker)?;
        subscriber.wait_matched()?;
        publisher.wait_matched()?;
        let loss = match per_mille {
            0 => None,
            _ => Some(Loss::of_samples(
                &link.robot,
                &link.monitor,
                &stream,
                per_mille,
            )?),
        };
        // Until the agent has classified both endpoints, it reads no ACKNACKs, and samples that are
        // repaired immediately count as reordered.
        for observer in observers {
            for endpoint in [publisher.guid()?, subscriber.guid()?] {
                wait_metered(observer.agent.process.pid(), endpoint)?;
            }
        }
        publisher.start_sending()?;
        publisher
            .wait_sent(Duration::from_secs(60))
            .context("the publisher sends")?;
        if stream.reliable {
            wait_received(&subscriber, stream.count)?;
        }
        std::thread::sleep(capture::SETTLE);
        let counts = loss.as_ref().map(Loss::counts).transpose()?;
        publisher.process.terminate().context("the publisher")?;
        // Once the writer is gone, all its losses have a cause.
        let sent = publisher.log()?;
        let writer = writer_of(&sent, &stream.topic)?;
        let [robot, monitor] = observers;
        let scrapes = [
            (robot.name, robot.scrape_after(stack, &stream.topic)?),
            (monitor.name, monitor.scrape_after(stack, &stream.topic)?),
        ];
        subscriber.process.terminate().context("the subscriber")?;
        Ok(Passage {
            topic: stream.topic,
            writer,
            sent,
            received: subscriber.log()?,
            dropped: counts.map_or(0, |counts| counts.dropped),
            scrapes,
        })
    }

    /// Returns the passage with its samples in the recordings of both ends.
    fn compared_with(self, wires: &[Dissection; 2]) -> Exchange {
        let [robot, monitor] = wires;
        let [of_robot, of_monitor] = self.scrapes;
        let ends = [(of_robot, robot), (of_monitor, monitor)];
        let ends = ends.map(|((name, scrape), wire)| End {
            name,
            topic: self.topic.clone(),
            wire: wire.samples_of(&self.writer),
            scrape,
        });
        Exchange {
            sent: self.sent,
            received: self.received,
            dropped: self.dropped,
            ends,
        }
    }
}

/// An agent and a recording on one host.
struct Observer<'a> {
    name: &'static str,
    agent: Agent<'a>,
    capture: Capture,
    _directory: tempfile::TempDir,
}

impl<'a> Observer<'a> {
    fn start(name: &'static str, host: &'a Namespace, configuration: &Path) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        Ok(Observer {
            name,
            agent: Agent::start(host, env!("CARGO_BIN_EXE_rp"), configuration)?,
            capture: Capture::start(host, &directory.path().join("link.pcap"))?,
            _directory: directory,
        })
    }

    /// Returns the page after the writer has left the agent's graph. On a busy machine, RustDDS may
    /// leave without a goodbye; its samples are settled nevertheless.
    fn scrape_after(&self, stack: Stack, topic: &str) -> Result<Scrape> {
        let gone =
            |page: &Scrape| page.value("ros2_topic_publishers", &[("topic", topic)]) == Some(0.0);
        let mut scrape = self.agent.settled_scrape(topic, 0)?;
        if !gone(&scrape) && stack != Stack::Rust {
            let what = format!("without a publisher of {topic}");
            scrape = self.agent.scrape_until(&what, gone)?;
        }
        for lossless in [
            "ros2probe_capture_dropped_packets_total",
            "ros2probe_records_dropped_total",
        ] {
            let dropped = scrape.sum(lossless, &[]);
            ensure!(dropped == 0.0, "{lossless} is {dropped} on {}", self.name);
        }
        Ok(scrape)
    }

    /// Ends the recording, and reads it.
    fn finish(self) -> Result<Dissection> {
        Dissection::read(&self.capture.finish()?)
    }
}

impl End {
    fn counted(&self) -> Counted {
        Counted {
            messages: self.count("ros2_topic_messages_total"),
            bytes: self.count("ros2_topic_bytes_total"),
            lost: self.count("ros2_topic_lost_messages_total"),
            recovered: self.count("ros2_topic_recovered_messages_total"),
            duplicates: self.count("ros2_topic_duplicate_messages_total"),
            incomplete: self.count("ros2_topic_incomplete_messages_total"),
        }
    }

    /// Checks that intervals and latencies fit the messages. Both hosts have one clock.
    fn assert_delays(&self, received: &EventLog) -> Result<()> {
        let messages = self.counted().messages;
        let name = self.name;
        let intervals = self.count("ros2_topic_interarrival_seconds_count");
        assert_eq!(intervals, messages - 1, "{name}");
        assert_eq!(
            self.count("ros2_topic_negative_latency_messages_total"),
            0,
            "{name}"
        );
        for latency in LATENCIES {
            assert_eq!(
                self.count(&format!("{latency}_count")),
                messages,
                "{name} {latency}"
            );
        }
        let latency = self.sum("ros2_topic_latency_seconds_sum");
        let header_latency = self.sum("ros2_topic_header_latency_seconds_sum");
        // The message is stamped before it is passed to the writer.
        assert!(latency > 0.0 && latency <= header_latency, "{name}");
        self.assert_header_latency(received)
    }

    /// Checks the mean time from `Header.stamp` to the capture, with the peers' stamps and
    /// tcpdump's times of the samples that the subscriber received.
    fn assert_header_latency(&self, received: &EventLog) -> Result<()> {
        let stamped = received
            .0
            .iter()
            .filter(|event| event.ev == "sub")
            .filter_map(|event| {
                let frame = self.wire.whole.get(&(event.seq? + 1))?;
                Some(frame - event.stamp_ns? as f64 / 1e9)
            });
        let delays: Vec<f64> = stamped.collect();
        let longest = delays.iter().copied().reduce(f64::max);
        let longest = longest.context("the subscriber was given nothing")?;
        // Both clocks are one, so that a larger delay shows a wrong epoch or unit.
        for latency in LATENCIES {
            let median = self.least_median(latency)?;
            let name = self.name;
            assert!(
                median <= longest,
                "{name}: {latency} {median} s, not {longest} s"
            );
        }
        if delays.len() as u64 == self.counted().messages {
            let messages = delays.len() as f64;
            let truth = delays.iter().sum::<f64>() / messages;
            let mean = self.sum("ros2_topic_header_latency_seconds_sum") / messages;
            let apart = (mean - truth).abs();
            assert!(
                apart < CLOCK_TOLERANCE,
                "{}: mean {mean} s, not {truth} s",
                self.name
            );
        }
        Ok(())
    }

    /// Returns the lower bound of the histogram's bucket that contains the median.
    fn least_median(&self, histogram: &str) -> Result<f64> {
        let half = self.sum(&format!("{histogram}_count")) / 2.0;
        let bucket = format!("{histogram}_bucket");
        let bounds = self.scrape.labels_of(&bucket, "le");
        ensure!(!bounds.is_empty(), "no {bucket}");
        let lower = bounds.iter().filter_map(|bound| {
            let labels = [("topic", self.topic.as_str()), ("le", bound)];
            let below = self.scrape.value(&bucket, &labels)?;
            (below < half).then(|| bound.parse::<f64>().ok())?
        });
        Ok(lower.fold(0.0, f64::max))
    }

    fn count(&self, name: &str) -> u64 {
        self.sum(name) as u64
    }

    fn sum(&self, name: &str) -> f64 {
        self.scrape.sum(name, &[("topic", &self.topic)])
    }
}

fn writer_of(log: &EventLog, topic: &str) -> Result<String> {
    let mut endpoints = log.endpoints();
    let endpoint = endpoints.find(|event| event.topic.as_deref() == Some(topic));
    endpoint
        .and_then(|event| event.guid.clone())
        .context("the publisher logged no GUID")
}

/// Waits until a reliable subscriber has received everything, and fails after a time limit.
fn wait_received(subscriber: &Peer, count: u64) -> Result<()> {
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        let received = subscriber.log()?.sequences("sub").len() as u64;
        if received >= count {
            return Ok(());
        }
        if Instant::now() > deadline {
            bail!("a reliable subscriber was given {received} of {count} samples");
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}
