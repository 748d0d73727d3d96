//! All loads of the other tests together, within two thirds of the unit's memory: forged
//! announcements of every kind, full tables, recordings, and hostile clients. The long variants,
//! which need an optimized agent, also stay within the unit's CPU.

use std::fs;
use std::io::Write as _;
use std::net::UdpSocket;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;
use serde_json::Value;

use super::clients::{AgentAddresses, Clients, RequestLoop, answer};
use super::memory::{PausingSender, UNUSED_PORT};
use super::unit::{Allowance, UnitCgroups, mebibytes};
use super::zenoh_storm::ZenohStorm;
use super::{FaultBench, ask};
use ros2probe_testing::forged::storm::{Storm, forgery};
use ros2probe_testing::harness::agent::{ON_THE_WIRE, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::soak::{dropped, long, outcome};
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_within;

/// Variable with another length of the attack, in seconds.
const SECONDS: &str = "ROS2PROBE_ATTACK_SECONDS";
const TOKEN: &str = "0123456789abcdef0123456789abcdef";
/// Maximum time of an answer for an optimized and an unoptimized agent. A scraper waits for 10 s by
/// default. An unoptimized agent takes several times the CPU of the shipped one.
const LONGEST: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(60)];
const SENT: Duration = Duration::from_secs(60);
/// Minimum number of datagrams, and of declarations, of a storm.
const STORM: u64 = 5_000;
const RECORDINGS: [(&str, &str); 4] = [
    ("real", r#", "topics": {"topics": ["/real", "/cloud"]}"#),
    ("all", ""),
    ("more", ""),
    ("most", ""),
];

#[test]
fn all_loads_together_on_the_wire_stay_within_the_limits_of_the_unit() -> Result<()> {
    everything("on the wire", |_| ON_THE_WIRE.to_owned())
}

#[test]
fn all_loads_together_at_the_sockets_stay_within_the_limits_of_the_unit() -> Result<()> {
    everything("at the sockets", |link| at_the_sockets_of(&link.robot))
}

fn everything(place: &str, capture: impl Fn(&Link) -> String) -> Result<()> {
    let seconds = std::env::var(SECONDS).ok();
    let seconds = seconds.map(|text| text.parse()).transpose()?;
    let usual = if long().is_some() { 120 } else { 5 };
    let span = Duration::from_secs(seconds.unwrap_or(usual));
    let mut allowance = Allowance::of_the_unit()?;
    if seconds.is_none() && long().is_none() {
        // An unoptimized agent takes several times the CPU of the shipped one.
        allowance.cpu_percent *= 2;
    }
    let group = UnitCgroups::to(&allowance)?;
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let socket = directory.path().join("api.sock");
    let configuration = configuration(directory.path(), &capture(&link))?;
    let enter = group.enter();
    let words = ["sh", "-c", &enter];
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &words)?;
    let doors = AgentAddresses::new(&link.robot, &socket, TOKEN);
    let idle = group.needed()?;
    let mut real = RealTraffic::start(&link, span)?;
    scene.node_is_known("/driver")?;
    scene.node_is_known("/camera")?;
    let silent = recordings_and_silent_readers(&doors)?;
    // The socket hook sees datagrams only if a socket receives them. The test never reads it.
    let _sink = link.robot.hold(|| storm_receiver(&link.robot))??;

    let (before, throttled) = (Usage::of(scene.pid())?, group.throttled()?);
    let began = Instant::now();
    let storms = storms(&link)?;
    let rest = Duration::from_millis(if long().is_some() { 2 } else { 10 });
    let zenoh = ZenohStorm::start(&link, rest)?;
    let clients = Clients::start(&doors);
    let askers = well_behaved_clients(&doors);
    real.start_publishers()?;
    let PeakUsage {
        mut peak,
        participants,
        endpoints,
        zenoh_aliases,
    } = observe(span, &group, &doors, &mut real)?;
    wait_for_storms(&storms, &zenoh)?;
    let took = began.elapsed();
    let cpu = Usage::of(scene.pid())?.since(&before).cpu;
    let waited = group.throttled()?.saturating_sub(throttled);
    let answered = answers(askers)?;
    let done = clients.end()?;
    let mut sent = 0;
    for storm in storms {
        sent += storm.end()?;
    }
    let declared = zenoh.end()?;
    drop(silent);
    let page = real.final_page(&scene).with_context(|| scene.log())?;
    peak = peak.max(group.needed()?);
    ensure!(group.oom_kills()? == 0, "killed at the end");
    ensure!(
        peak < allowance.memory / 3 * 2,
        "{peak} bytes with what sockets take"
    );
    ensure!(sent > STORM, "{sent} datagrams are no storm");
    ensure!(declared > STORM, "{declared} declarations are no storm");
    refusals_have_names(&page)?;
    let counted = real.check(&page)?;
    let mut recorded = 0;
    for (name, _) in RECORDINGS {
        recorded += end_recording(&doors, name, &real, dropped(&page) == 0.0)?;
    }
    let ended = scene.end()?;
    outcome(
        &format!(
            "everything at once {place}, in {} MiB and {} % of a CPU",
            mebibytes(allowance.memory),
            allowance.cpu_percent
        ),
        &format!(
            "{sent} forged datagrams and {declared} declarations of Zenoh in {took:.0?}, participants {:.0} % and endpoints {:.0} % \
             and aliases of Zenoh {:.0} % full; {done}: {:.1} MiB \
             at most ({:.1} MiB before), not killed; {:.1} s of CPU, {:.1} s waited for more; {}; {counted}; \
             {recorded} messages of real topics in 4 recordings, all others accounted for; ended in {ended:.1?}",
            participants * 100.0,
            endpoints * 100.0,
            zenoh_aliases * 100.0,
            mebibytes(peak),
            mebibytes(idle),
            cpu.as_secs_f64(),
            waited.as_secs_f64(),
            answered.join(", "),
        ),
    )
}

/// Waits until enough is sent and declared. Senders of a busy machine need longer.
fn wait_for_storms(storms: &[Storm], zenoh: &ZenohStorm) -> Result<()> {
    wait_within(SENT, "the storms are storms", || {
        let sent: u64 = storms.iter().map(Storm::sent).sum();
        Ok(sent > STORM && zenoh.declared() > STORM)
    })
}

/// Makes the state directory and the token of a configuration with every kind of client, and
/// returns its text.
fn configuration(directory: &Path, capture: &str) -> Result<String> {
    fs::create_dir(directory.join("state"))?;
    fs::write(directory.join("token"), TOKEN)?;
    let home = directory.display();
    Ok(format!(
        "watch: [/real, /cloud, {{topic: /**, per_subscriber: true}}]\nlog: warn\n\
         state_directory: {home}/state\n\
         recordings: {{directory: {home}/bags, reserve_percent: 0, reserve_bytes: 0}}\n\
         api: {{listen: '0.0.0.0:17401', token_file: {home}/token, socket: {home}/api.sock}}\n{capture}"
    ))
}

/// The highest values of a span.
struct PeakUsage {
    /// Memory that the group needed, in bytes.
    peak: u64,
    /// Used shares of these tables, from 0 to 1.
    participants: f64,
    endpoints: f64,
    zenoh_aliases: f64,
}

/// Reads the values until everything is sent and the agent has refused some of it, and once more.
fn observe(
    span: Duration,
    group: &UnitCgroups,
    doors: &AgentAddresses,
    real: &mut RealTraffic,
) -> Result<PeakUsage> {
    let began = Instant::now();
    let mut peak = 0;
    let (mut participants, mut endpoints, mut zenoh_aliases) = (0.0_f64, 0.0_f64, 0.0_f64);
    let (mut is_sent, mut is_refused) = (false, false);
    while !is_sent {
        let longest = if is_refused { span } else { span + SENT };
        is_sent = began.elapsed() >= longest;
        if is_sent {
            real.wait_sent()?;
        }
        ensure!(
            group.oom_kills()? == 0,
            "killed after {:?}",
            began.elapsed()
        );
        peak = peak.max(group.needed()?);
        let page = page(doors)?;
        participants = participants.max(table_usage(&page, "participants"));
        endpoints = endpoints.max(table_usage(&page, "endpoints"));
        zenoh_aliases = zenoh_aliases.max(filled_bytes(&page, "zenoh_aliases"));
        is_refused = refusals_have_names(&page).is_ok();
        std::thread::sleep(Duration::from_millis(200));
    }
    Ok(PeakUsage {
        peak,
        participants,
        endpoints,
        zenoh_aliases,
    })
}

/// Begins all recordings, and streams of samples that are never read.
fn recordings_and_silent_readers(doors: &AgentAddresses) -> Result<Vec<std::net::TcpStream>> {
    for (name, topics) in RECORDINGS {
        let body = format!(r#"{{"name": "{name}"{topics}}}"#);
        let (status, begun) = socket_request(doors, "POST", "/recordings", &body)?;
        ensure!(status == 201, "{status} {begun}");
    }
    let mut silent = Vec::new();
    for _ in 0..12 {
        let mut stream = doors.api()?;
        let path = "/samples?all=true&hidden=true&payload=true&queue_bytes=16777216";
        stream.write_all(doors.request(path).as_bytes())?;
        silent.push(stream);
    }
    Ok(silent)
}

/// Returns the number of answers of each client and its longest wait. Fails if an answer was
/// refused or late.
fn answers(askers: Vec<RequestLoop>) -> Result<Vec<String>> {
    let mut answered = Vec::new();
    for asker in askers {
        let (what, answers) = asker.end()?;
        // An unoptimized agent may fall behind, and reports it.
        let (may, not): (Vec<_>, Vec<_>) = answers
            .refused
            .into_iter()
            .partition(|answer| long().is_none() && is_busy(answer));
        ensure!(not.is_empty(), "{what}: {}", not.join("; "));
        let answered_once = answers.count > may.len() as u64 || what == "/readyz";
        ensure!(answered_once, "{what}: {}", may.join("; "));
        let longest = answers.longest;
        ensure!(
            longest < LONGEST[usize::from(long().is_none())],
            "{what}: {longest:?}"
        );
        answered.push(format!("{} {what} in {longest:.1?} at most", answers.count));
    }
    Ok(answered)
}

fn refusals_have_names(page: &Scrape) -> Result<()> {
    for limit in [
        "ros2probe_limit_reached_total",
        "ros2probe_table_evictions_total",
    ] {
        ensure!(page.sum(limit, &[]) > 0.0, "{limit}: nothing was refused");
    }
    Ok(())
}

/// Starts storms of announcements of every kind with new fields each time, and of large messages.
fn storms(link: &Link) -> Result<[Storm; 4]> {
    // An unoptimized agent processes fewer messages.
    let (pace, rest) = if long().is_some() { (2, 50) } else { (1, 200) };
    let breathing =
        |count: u32| PausingSender::with_pauses(link, count * pace, Duration::from_millis(4));
    let slow = PausingSender::with_pauses(link, 1, Duration::from_millis(rest))?;
    Ok([
        Storm::of_a_crowd(breathing(4)?, 1200, 12),
        Storm::of_addresses(breathing(1)?),
        Storm::start(breathing(1)?, forgery),
        Storm::of_large_samples(slow)?,
    ])
}

/// Returns whether an answer says that the agent cannot process the request now.
fn is_busy(answer: &str) -> bool {
    answer.starts_with("HTTP/1.1 503 ")
}

/// Reads the metrics without a scraper's timeout. Repeats the request, as a scraper does, while an
/// unoptimized agent refuses it.
fn page(doors: &AgentAddresses) -> Result<Scrape> {
    let head = "GET /metrics HTTP/1.1\r\nHost: localhost:17400";
    let deadline = Instant::now() + SENT;
    let answer = loop {
        let answer = answer(doors.metrics()?, head)?;
        if !is_busy(&answer) || long().is_some() || Instant::now() > deadline {
            break answer;
        }
        std::thread::sleep(Duration::from_millis(500));
    };
    ensure!(answer.starts_with("HTTP/1.1 200 "), "{answer:.600}");
    Ok(Scrape(answer))
}

/// Returns the used share of a table, from 0 to 1.
fn table_usage(page: &Scrape, table: &str) -> f64 {
    let label = [("table", table)];
    page.sum("ros2probe_table_entries", &label) / page.sum("ros2probe_table_limit", &label)
}

/// Returns the used share of a table's cap in bytes, from 0 to 1.
fn filled_bytes(page: &Scrape, table: &str) -> f64 {
    let label = [("table", table)];
    page.sum("ros2probe_table_bytes", &label) / page.sum("ros2probe_table_bytes_limit", &label)
}

/// Ends a recording, and returns its number of messages of real topics. The report counts each
/// other sent message with the reason, except those dropped before the agent knew their topic.
fn end_recording(
    doors: &AgentAddresses,
    name: &str,
    real: &RealTraffic,
    is_all: bool,
) -> Result<u64> {
    let path = format!("/recordings/{name}");
    let (status, ended) = socket_request(doors, "DELETE", &path, "")?;
    ensure!(status == 200, "{status} {ended}");
    let mut recorded = 0;
    for (topic, sent) in real.sent()? {
        let report = &ended["report"]["topics"][topic];
        let parts = report.as_object().context("not in the report")?;
        let messages = report["messages"].as_u64().context("no count")?;
        let counts = parts.iter().filter(|(key, _)| *key != "bytes");
        let known: u64 = counts.filter_map(|(_, count)| count.as_u64()).sum();
        let fits = if is_all { known == sent } else { known <= sent };
        ensure!(messages <= sent && fits, "{topic}: {sent} sent, {report}");
        recorded += messages;
    }
    Ok(recorded)
}

/// Two publishers on the robot, and their subscribers on the other host.
struct RealTraffic {
    publishers: Vec<(Peer, &'static str)>,
    _subscribers: Vec<Peer>,
}

impl RealTraffic {
    fn start(link: &Link, span: Duration) -> Result<RealTraffic> {
        let seconds = span.as_secs();
        let small = Stream {
            topic: "/real".to_owned(),
            // The publisher stays, because a vanished topic would leave its entry to new ones.
            linger: 600.0,
            ..Stream::small(200 * seconds)
        };
        let cloud = Stream {
            topic: "/cloud".to_owned(),
            rate: 10.0,
            linger: 600.0,
            ..Stream::point_cloud(64_000, 10 * seconds)
        };
        let mut real = RealTraffic {
            publishers: Vec::new(),
            _subscribers: Vec::new(),
        };
        for (stack, stream, topic, nodes) in [
            (Stack::Cyclone, small, "/real", ["/driver", "/listener"]),
            (Stack::Fast, cloud, "/cloud", ["/camera", "/viewer"]),
        ] {
            let mut subscriber =
                Peer::start(&link.monitor, stack, Role::Subscriber, &stream, &nodes[1..])?;
            let mut publisher =
                Peer::start(&link.robot, stack, Role::Publisher, &stream, &nodes[..1])?;
            subscriber.wait_matched()?;
            publisher.wait_matched()?;
            real.publishers.push((publisher, topic));
            real._subscribers.push(subscriber);
        }
        Ok(real)
    }

    fn start_publishers(&mut self) -> Result<()> {
        self.publishers
            .iter_mut()
            .try_for_each(|(publisher, _)| publisher.start_sending())
    }

    fn wait_sent(&mut self) -> Result<()> {
        self.publishers
            .iter_mut()
            .try_for_each(|(publisher, _)| publisher.wait_sent(SENT))
    }

    /// Returns the counts of the publishers' own logs.
    fn sent(&self) -> Result<Vec<(&'static str, u64)>> {
        let sent = self.publishers.iter().map(|(publisher, topic)| {
            let numbers = publisher.log()?.writer_numbers("pub")?;
            Ok((*topic, numbers.len() as u64))
        });
        sent.collect()
    }

    /// Returns a page with the final counts of each stream.
    fn final_page(&self, scene: &FaultBench<'_>) -> Result<Scrape> {
        let mut page = None;
        for (topic, sent) in self.sent()? {
            page = Some(scene.agent.settled_scrape(topic, sent)?);
        }
        page.context("no streams")
    }

    /// Fails unless the agent has counted each message, or dropped it with a count. The robot
    /// itself loses no message.
    fn check(&self, page: &Scrape) -> Result<String> {
        let dropped = dropped(page);
        let mut printed = Vec::new();
        for (topic, sent) in self.sent()? {
            let label = [("topic", topic)];
            let counted = page.sum("ros2_topic_messages_total", &label);
            let lost = page.sum("ros2_topic_lost_messages_total", &label);
            let missing = sent as f64 - counted;
            ensure!(
                (0.0..=dropped).contains(&missing) && (0.0..=missing).contains(&lost),
                "{topic}: {counted} of {sent}, {lost} lost, {dropped} dropped: {}",
                page.suspicious_counters()
            );
            printed.push(format!("{counted} of {sent} messages of {topic}"));
        }
        let events = page.sum(
            "ros2probe_events_total",
            &[("name", "ros2probe.capture.dropped")],
        );
        let datagrams = page.sum("ros2probe_dropped_datagrams_total", &[]);
        ensure!(
            (events > 0.0) == (dropped + datagrams > 0.0),
            "{dropped} records or frames and {datagrams} datagrams dropped, {events} events"
        );
        Ok(format!(
            "{} counted, {dropped} records or frames dropped",
            printed.join(" and ")
        ))
    }
}

/// Starts the well-behaved clients: a scraper, a service manager that reads the readiness, a client
/// with the token, and one on the socket.
fn well_behaved_clients(doors: &AgentAddresses) -> Vec<RequestLoop> {
    let period = Duration::from_millis(500);
    let scrape = |path: &'static str| {
        let doors = doors.clone();
        move || {
            answer(
                doors.metrics()?,
                &format!("GET {path} HTTP/1.1\r\nHost: localhost:17400"),
            )
        }
    };
    let (with_token, local) = (doors.clone(), doors.clone());
    vec![
        RequestLoop::start("/metrics", period, scrape("/metrics")),
        RequestLoop::start("/readyz", period, scrape("/readyz")),
        RequestLoop::start("token", period, move || {
            answer(with_token.api()?, &with_token.request("/health"))
        }),
        RequestLoop::start("socket", period, move || {
            answer(
                UnixStream::connect(&local.socket)?,
                "GET /health HTTP/1.1\r\nHost: rp",
            )
        }),
    ]
}

/// Sends a request on the Unix socket, and returns the status and the answer.
fn socket_request(
    doors: &AgentAddresses,
    method: &str,
    path: &str,
    body: &str,
) -> Result<(u16, Value)> {
    let stream = UnixStream::connect(&doors.socket)?;
    stream.set_read_timeout(Some(SENT))?;
    ask(&mut { stream }, method, path, body)
}

/// Binds the socket that receives the storm.
fn storm_receiver(host: &Namespace) -> Result<UdpSocket> {
    let address = (host.address(), UNUSED_PORT);
    Ok(netns::within(&host.network(), || {
        UdpSocket::bind(address)
    })??)
}
