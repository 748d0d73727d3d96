//! Samples with their bytes from a running agent: a client receives exactly what real participants
//! sent, from any stack and any source. Clients that stop or die do not delay others. Needs root.

mod shared_memory;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::Write as _;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use ros2probe::client;
use ros2probe::client::{Lines, Next};
use ros2probe_api::samples::{Line, Missed, Sample};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{
    Agent, PACKETS_ALONE, Scrape, at_the_sockets_of, datagrams_alone_of,
};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, pair};
use ros2probe_testing::harness::shared_memory::SharedMemory;
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_until;
use tempfile::TempDir;

/// Sizes of point clouds, in bytes.
const SIZES: [usize; 2] = [644_000, 2_720_000];
const PATIENCE: Duration = Duration::from_secs(60);
/// Time after which no more of a publisher's samples arrive, even if the agent lost some of them.
const LAST_SAMPLE_TIMEOUT: Duration = Duration::from_secs(6);
/// Type as the peers announce it, in the style of ROS.
const CLOUD: &str = "sensor_msgs/msg/PointCloud2";
/// Offset of the points, after encapsulation, header, fields and sizes.
const DATA: usize = 52;

#[test]
fn payloads_of_fast_dds_equal_those_that_were_sent() -> Result<()> {
    check_payloads(Stack::Fast, &SIZES, datagrams_alone_of)
}

#[test]
fn payloads_of_cyclone_dds_equal_those_that_were_sent() -> Result<()> {
    check_payloads(Stack::Cyclone, &SIZES, datagrams_alone_of)
}

#[test]
fn payloads_of_rust_dds_equal_those_that_were_sent() -> Result<()> {
    check_payloads(Stack::Rust, &SIZES, datagrams_alone_of)
}

#[test]
fn payloads_on_the_wire_equal_those_that_were_sent() -> Result<()> {
    // Samples are in IP fragments, and larger ones in frames of 1.4 KB. A busy machine loses parts
    // of more.
    let on_the_wire = |_: &Namespace| PACKETS_ALONE.to_owned();
    check_payloads(Stack::Fast, &[60_000, 644_000], on_the_wire)?;
    check_payloads(Stack::Cyclone, &[644_000], on_the_wire)
}

#[test]
fn the_last_message_of_a_transient_local_publisher_is_delivered_first() -> Result<()> {
    let on_the_wire = |_: &Namespace| PACKETS_ALONE.to_owned();
    check_first(Stack::Fast, datagrams_alone_of)?;
    check_first(Stack::Cyclone, datagrams_alone_of)?;
    check_first(Stack::Cyclone, on_the_wire)
}

fn check_first(stack: Stack, source: impl Fn(&Namespace) -> String) -> Result<()> {
    let size = SIZES[0];
    let link = Link::new()?;
    let observed = Observed::start(&link.robot, &source(&link.robot))?;
    let stream = Stream {
        reliable: true,
        transient_local: true,
        // The last message is kept as long as the publisher exists.
        linger: 90.0,
        ..Stream::point_cloud(size, 3)
    };
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, stack, &stream)?;
    // The kernel already knows the publisher. No client requests its topic.
    publisher.start_sending()?;
    let bytes = f64::from(u32::try_from(size)?);
    let kept = |page: &Scrape| page.sum("ros2probe_retained_bytes", &[]) == bytes;
    observed
        .agent
        .scrape_until("the last message is kept", kept)?;
    let sent = || Ok(publisher.log()?.sequences("pub").len() == 3);
    wait_until("all are sent", sent)?;
    std::thread::sleep(Duration::from_secs(1));
    let topic = observed.topic("/points")?;
    ensure!(topic["measurement"].is_null(), "no watch: {topic}");
    ensure!(
        topic["publishers"][0]["latched"]["state"] == "kept",
        "{topic}"
    );

    let client = observed.client()?;
    let deadline = Instant::now() + PATIENCE;
    let (sample, payload) = loop {
        let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
        let Some(StreamItem::Sample(sample, payload)) = next(&mut lines)? else {
            bail!("no sample comes first");
        };
        // The agent of a busy machine may not have read the last message yet.
        if sample.sequence_number == 3 || Instant::now() > deadline {
            break (sample, payload);
        }
    };
    let pattern: Vec<u8> = (8..size).map(pattern).collect();
    ensure!(check(&payload, &pattern)? == 2, "the last of three");
    ensure!(sample.sequence_number == 3, "{sample:?}");
    Ok(())
}

/// Checks the payloads without a configured watch: one stream of samples suffices.
fn check_payloads(
    stack: Stack,
    sizes: &[usize],
    source: impl Fn(&Namespace) -> String,
) -> Result<()> {
    for size in sizes.iter().copied() {
        let link = Link::new()?;
        let source = source(&link.robot);
        // Frames that do not fit into a packet ring are not seen.
        let lossless_metering = source != PACKETS_ALONE;
        let observed = Observed::start(&link.robot, &source)?;
        let stream = Stream {
            reliable: true,
            ..Stream::point_cloud(size, 40)
        };
        let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, stack, &stream)?;
        // Payloads of a publisher that the agent does not know yet are not captured.
        wait_until("the agent knows the publisher", || {
            let topic = observed.topic("/points");
            Ok(topic.is_ok_and(|topic| topic["publishers"][0].is_object()))
        })?;
        let client = observed.client()?;
        let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
        let pattern: Vec<u8> = (8..size).map(pattern).collect();
        publisher.start_sending()?;
        let mut received = BTreeMap::new();
        let mut missed = 0;
        let mut last_item = Instant::now();
        while received.len() as u64 + missed < stream.count {
            let next = match next_within(&mut lines, LAST_SAMPLE_TIMEOUT) {
                // The agent may have seen neither the last samples nor a HEARTBEAT after them.
                Ok(Some(StreamItem::Nothing)) | Err(_)
                    if !lossless_metering
                        && publisher.log()?.sequences("pub").len() as u64 == stream.count
                        && dropped(&observed.agent.scrape()?) > 0.0 =>
                {
                    break;
                }
                Ok(Some(StreamItem::Nothing)) if last_item.elapsed() < PATIENCE => continue,
                Ok(Some(StreamItem::Nothing)) => Err(anyhow!("no sample")),
                next => next,
            };
            last_item = Instant::now();
            let next = next.with_context(|| match observed.agent.scrape() {
                Ok(page) => format!(
                    "{stack:?} {size}: after {:?} and {missed} missed: {}",
                    received.keys(),
                    page.suspicious_counters()
                ),
                Err(error) => error.to_string(),
            });
            let (sample, payload) = match next?.context("the stream ended")? {
                StreamItem::Sample(sample, payload) => (sample, payload),
                StreamItem::Missed(facts) => {
                    missed += facts.samples;
                    continue;
                }
                StreamItem::Nothing => continue,
            };
            ensure!(sample.message_type == CLOUD && sample.size as usize == payload.len());
            ensure!(payload.len() == size, "{} of {size} bytes", payload.len());
            let number = check(&payload, &pattern)?;
            ensure!(
                number + 1 == sample.sequence_number,
                "{number} in {sample:?}"
            );
            ensure!(received.insert(number, sample).is_none(), "{number} twice");
        }
        publisher.wait_sent(PATIENCE)?;
        let sent = publisher.log()?.sequences("pub");
        ensure!(
            received.keys().all(|number| sent.contains(number)),
            "{sent:?}"
        );
        check_all_or_counted(&observed, received.len(), missed, lossless_metering)?;
    }
    Ok(())
}

/// Checks that each sample is delivered or reported as missing.
fn check_all_or_counted(
    observed: &Observed<'_>,
    received: usize,
    missed: u64,
    lossless_metering: bool,
) -> Result<()> {
    let page = observed.agent.scrape()?;
    let dropped = dropped(&page);
    ensure!(
        missed == 0 || dropped > 0.0,
        "{missed} missed: {}",
        page.suspicious_counters()
    );
    ensure!(
        received >= 10,
        "{} of 40: {}",
        received,
        page.suspicious_counters()
    );
    let label = [("topic", "/points")];
    let counted = page.sum("ros2_topic_messages_total", &label);
    let lost = page.sum("ros2_topic_lost_messages_total", &label);
    let records_lost = page.sum("ros2probe_records_dropped_total", &[]);
    if lossless_metering && records_lost == 0.0 {
        ensure!(
            (counted, lost) == (40.0, 0.0),
            "{counted}, {lost}: {}",
            page.suspicious_counters()
        );
    }
    Ok(())
}

const LOSSLESS: [&str; 5] = [
    "ros2probe_missed_messages_total",
    "ros2probe_capture_dropped_packets_total",
    "ros2probe_records_dropped_total",
    "ros2probe_dropped_datagrams_total",
    "ros2probe_incomplete_datagrams_total",
];

/// Returns the number of messages that the agent reports as missing.
fn dropped(page: &Scrape) -> f64 {
    LOSSLESS.iter().map(|name| page.sum(name, &[])).sum()
}

/// Returns the byte that the peers write at this position of the points.
pub(crate) fn pattern(place: usize) -> u8 {
    let [low, ..] = (place * 7 + (place >> 8) * 13 + (place >> 16)).to_le_bytes();
    low
}

/// Returns the number in a point cloud. Fails if any byte differs from the sent one.
pub(crate) fn check(payload: &[u8], pattern: &[u8]) -> Result<u64> {
    ensure!(payload.starts_with(&[0, 1, 0, 0]), "{:?}", payload.get(..4));
    let (_, data) = payload.split_at(DATA);
    let (number, rest) = data.split_first_chunk().context("no data")?;
    // The field `is_dense` and padding follow the data.
    let len = rest.len() - 1 - rest.len() % 4;
    let is_as_sent = rest.get(..len) == pattern.get(..len);
    ensure!(is_as_sent, "sample {number:?} has other bytes");
    Ok(u64::from_le_bytes(*number))
}

/// Opens streams until one has this topic.
fn open<'a>(client: &'a client::Agent, query: &str, topic: &str) -> Result<Lines<'a>> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut lines = client.stream(&format!("/samples?{query}"))?;
        let first = lines.line()?.context("no line")?;
        let Line::Open(opened) = serde_json::from_slice(&first)? else {
            bail!("{first:?}");
        };
        if opened.topics.iter().any(|known| known.topic == topic) {
            return Ok(lines);
        }
        ensure!(
            Instant::now() < deadline,
            "{topic} does not appear: {opened:?}"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// An item of a stream.
enum StreamItem {
    Sample(Sample, Vec<u8>),
    Missed(Missed),
    /// Only the clock advanced.
    Nothing,
}

/// Returns the next sample with its payload, or the next report of missing ones; `None` at the end.
fn next(lines: &mut Lines<'_>) -> Result<Option<StreamItem>> {
    next_within(lines, PATIENCE)
}

fn next_within(lines: &mut Lines<'_>, patience: Duration) -> Result<Option<StreamItem>> {
    let deadline = Instant::now() + patience;
    loop {
        let line = match lines.line_within(PATIENCE)? {
            Next::Line(line) => line,
            Next::End => return Ok(None),
            Next::Nothing => bail!("not even a clock"),
        };
        match serde_json::from_slice(&line)? {
            Line::Sample(sample) => {
                let len = sample.payload_bytes.context("no payload")? as usize;
                return Ok(Some(StreamItem::Sample(sample, lines.bytes(len)?.to_vec())));
            }
            Line::Missed(missed) => return Ok(Some(StreamItem::Missed(missed))),
            Line::Clock(_) if Instant::now() < deadline => {}
            Line::Clock(_) => return Ok(Some(StreamItem::Nothing)),
            other => bail!("{other:?}"),
        }
    }
}

/// Returns the binary under test, or another build of it.
fn program() -> OsString {
    std::env::var_os("ROS2PROBE_TESTED").unwrap_or_else(|| env!("CARGO_BIN_EXE_rp").into())
}

struct Observed<'a> {
    agent: Agent<'a>,
    socket: PathBuf,
    _directory: TempDir,
}

impl<'a> Observed<'a> {
    fn start(host: &'a Namespace, source: &str) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        let socket = directory.path().join("api.sock");
        let configuration = directory.path().join("ros2probe.yaml");
        let text = format!("{source}watch: []\napi: {{socket: {}}}\n", socket.display());
        std::fs::write(&configuration, text)?;
        Ok(Self {
            agent: Agent::start(host, program(), &configuration)?,
            socket,
            _directory: directory,
        })
    }

    fn topic(&self, name: &str) -> Result<serde_json::Value> {
        let mut curl = Command::new("curl");
        curl.args(["--silent", "--unix-socket"]).arg(&self.socket);
        let answer = curl
            .arg(format!("http://localhost/topics{name}"))
            .output()?;
        Ok(serde_json::from_slice(&answer.stdout)?)
    }

    /// Waits until the agent has this view of shared memory.
    fn wait_for_view(&self, view: &str) -> Result<()> {
        wait_until(view, || {
            let topic = self.topic("/points")?;
            Ok(topic.pointer("/passages/0/view") == Some(&view.into()))
        })
    }

    fn client(&self) -> Result<client::Agent> {
        let target = client::Target {
            socket: Some(self.socket.clone()),
            ..client::Target::default()
        };
        Ok(client::Agent::reach_stream(&target)?)
    }
}

/// One of ten simultaneous clients never reads, and one is killed. The others receive everything,
/// the subscriptions of closed clients end, and memory stays bounded.
#[test]
fn stopped_and_killed_readers_delay_no_other_reader() -> Result<()> {
    let host = Namespace::isolated()?;
    let limits = "limits: {payload_bytes: 14680064, subscriptions: 12}\n";
    let observed = Observed::start(&host, &format!("{limits}{}", datagrams_alone_of(&host)))?;
    let stream = Stream {
        reliable: true,
        linger: 60.0,
        ..Stream::point_cloud(60_000, 160)
    };
    let (mut publisher, _subscriber) = pair(&host, &host, Stack::Cyclone, &stream)?;
    let client = observed.client()?;
    let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
    let query = "/samples?all=true&payload=true";
    let mut stalled = UnixStream::connect(&observed.socket)?;
    stalled.write_all(format!("GET {query} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes())?;
    let mut readers = Vec::new();
    for _ in 0..8 {
        readers.push(Reader::start(&observed.socket, query)?);
    }
    let open_are = |count: f64| {
        let shows = move |page: &Scrape| page.sum("ros2probe_subscriptions", &[]) == count;
        observed.agent.scrape_until("that many", shows)
    };
    open_are(10.0)?;
    publisher.start_sending()?;
    let mut readers = readers.into_iter();
    for number in 1..=160 {
        if number == 40 {
            let mut killed = readers.next().context("no reader")?;
            killed.0.kill()?;
        }
        match next(&mut lines)?.context("the stream ended")? {
            StreamItem::Sample(sample, _) => {
                ensure!(sample.sequence_number == number, "{sample:?}");
            }
            StreamItem::Missed(missed) => bail!("{number}: {missed:?}"),
            StreamItem::Nothing => bail!("{number}: no sample"),
        }
    }
    open_are(9.0)?;
    let (missed, label) = ([("reason", "queue_full")], [("topic", "/points")]);
    let are_counted = |page: &Scrape| {
        page.sum("ros2_topic_messages_total", &label) == 160.0
            && page.sum("ros2probe_missed_messages_total", &missed) > 20.0
    };
    let page = observed.agent.scrape_until("160 messages", are_counted)?;
    ensure!(page.sum("ros2_topic_lost_messages_total", &label) == 0.0);
    let queued = page.sum("ros2probe_queued_bytes", &[]);
    ensure!(queued > 0.0 && queued <= 7_340_032.0, "{queued} bytes wait");
    drop((readers, stalled, lines));
    drop(client);
    open_are(0.0)?;
    let page = observed.agent.scrape()?;
    ensure!(page.sum("ros2probe_queued_bytes", &[]) == 0.0);
    ensure!(page.samples("ros2_watch_state", &label).count() == 0);
    Ok(())
}

/// A client that reads as fast as it can, and is killed when its value is dropped.
struct Reader(Child);

impl Reader {
    fn start(socket: &Path, query: &str) -> Result<Self> {
        let mut curl = Command::new("curl");
        curl.args([
            "--silent",
            "--no-buffer",
            "--output",
            "/dev/null",
            "--unix-socket",
        ]);
        curl.arg(socket).arg(format!("http://localhost{query}"));
        Ok(Self(curl.spawn().context("cannot run curl")?))
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Measures the streams of `docs/benchmarks-parts.md`: `cargo test --release --test live samples::
/// -- --ignored --nocapture`.
#[test]
#[ignore = "takes two minutes and a quiet machine to mean anything"]
fn the_cost_of_a_stream_of_point_clouds_is_measured() -> Result<()> {
    const WINDOW: Duration = Duration::from_secs(20);
    for (stack, rate) in [
        (Stack::Cyclone, 20.0),
        (Stack::Fast, 20.0),
        (Stack::Cyclone, 37.0),
        (Stack::Fast, 37.0),
    ] {
        let link = Link::new()?;
        let observed = Observed::start(&link.robot, &at_the_sockets_of(&link.robot))?;
        let stream = Stream {
            rate,
            ..Stream::point_cloud(2_720_000, (rate * 24.0) as u64)
        };
        let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, stack, &stream)?;
        let client = observed.client()?;
        drop(open(&client, "topic=/points", "/points")?);
        let _reader = Reader::start(&observed.socket, "/samples?topic=/points&payload=true")?;
        publisher.start_sending()?;
        std::thread::sleep(Duration::from_secs(2));
        let before = Usage::of(observed.agent.process.pid())?;
        std::thread::sleep(WINDOW);
        let used = Usage::of(observed.agent.process.pid())?.since(&before);
        publisher.wait_sent(PATIENCE)?;
        let label = [("topic", "/points")];
        let page = observed.agent.settled_scrape("/points", stream.count)?;
        println!(
            "{stack:?} 2.72 MB @ {rate} Hz: agent {:.2} s CPU in {WINDOW:?}, {:.1} MB unreclaimable, counted {} of {}, {}",
            used.cpu.as_secs_f64(),
            used.memory.unreclaimable as f64 / 1e6,
            page.sum("ros2_topic_messages_total", &label),
            stream.count,
            page.suspicious_counters(),
        );
    }
    Ok(())
}
