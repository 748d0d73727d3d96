//! A stream with one fault after the other, observed by its subscribers and by the agent.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_model::facts::loss::DeliveryLoss;
use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::report::snapshot::{Delivered, Direction, Snapshot};
use ros2probe_wire::{EntityId, Guid};

use super::cell::Cell;
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::loss::{Loss, Part};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::run;
use ros2probe_testing::harness::snmp::Snmp;
use ros2probe_testing::harness::witness::Witness;

/// Maximum duration of the whole stream, with all pauses.
const PATIENCE: Duration = Duration::from_secs(90);
/// Ports of the first participants of domain 0 that carry no samples.
pub(crate) const DISCOVERY: &str = "7400, 7410, 7412, 7414, 7416";
/// Size of the ring. RustDDS sends 2125 datagrams per sample, also to its own socket, and a smaller
/// ring overflows on a busy machine.
const RECORD_RING: u32 = 16 << 20;
/// Time until gaps are settled. Gaps of best-effort streams are settled sooner.
const SETTLED: Duration = Duration::from_secs(60);
/// Interval of checks for silence. RustDDS sends somewhat later than it logs, and announcements
/// never cease.
const SILENCE_CHECK_INTERVAL: Duration = Duration::from_millis(400);
const PAUSE: Duration = Duration::from_millis(20);
const ANNOUNCEMENTS: u64 = 10;
/// Maximum number of incomplete datagrams without a report (`docs/limitations.md`).
const MAX_UNREPORTED: u64 = 1;
/// The kernel's timeout for IP fragments on the subscribers' host, with a margin.
const REASSEMBLY: Duration = Duration::from_millis(1500);

/// The fault during one stretch of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InjectedFault {
    Nothing,
    /// This percentage of the samples loses a datagram.
    Datagrams(u64),
    /// This percentage of the samples loses a datagram only on the path to the last subscriber.
    DatagramsToTheLast(u64),
    /// This percentage of the samples loses all IP fragments of a datagram except the first.
    Fragments(u64),
    /// The first subscriber is stopped and continued repeatedly.
    Stops,
}

/// Sizes of the measured samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Size {
    B320,
    KB644,
    MB2_72,
}

pub(crate) struct Experiment {
    pub(crate) stack: Stack,
    pub(crate) size: Size,
    pub(crate) subscribers: usize,
    pub(crate) troubles: Vec<InjectedFault>,
}

/// One stretch with its fault, as it was observed.
struct Span {
    trouble: InjectedFault,
    overflown: bool,
}

impl Size {
    fn stream(self) -> Stream {
        let stream = match self {
            // The receive buffer holds a third of a second of samples.
            Size::B320 => Stream {
                rate: 400.0,
                receive_buffer: 64 << 10,
                ..Stream::small(0)
            },
            // The receive buffer holds two samples.
            Size::KB644 => Stream {
                receive_buffer: 1 << 20,
                ..Stream::point_cloud(644_000, 0)
            },
            Size::MB2_72 => Stream {
                rate: 10.0,
                ..Stream::point_cloud(2_720_000, 0)
            },
        };
        Stream {
            depth: 1000,
            linger: 60.0,
            ..stream
        }
    }

    const fn samples(self) -> u64 {
        match self {
            Size::B320 => 800,
            Size::KB644 | Size::MB2_72 => 30,
        }
    }

    /// Returns the number of datagrams per sample; 0 for Zenoh, which sends over TCP.
    const fn datagrams(self, stack: Stack) -> u64 {
        match (self, stack) {
            (_, Stack::Zenoh) => 0,
            (Size::B320, _) => 1,
            (Size::KB644, Stack::Fast) => 10,
            (Size::KB644, Stack::Cyclone) => 48,
            (Size::KB644, Stack::Rust) => 504,
            (Size::MB2_72, Stack::Fast) => 42,
            (Size::MB2_72, Stack::Cyclone) => 203,
            (Size::MB2_72, Stack::Rust) => 2125,
        }
    }

    /// Returns for how long a subscriber is stopped, and for how long it then runs.
    const fn stop(self) -> (Duration, Duration) {
        match self {
            Size::B320 => (Duration::from_millis(800), Duration::from_millis(300)),
            _ => (Duration::from_millis(400), Duration::from_millis(300)),
        }
    }
}

impl InjectedFault {
    /// Returns whether the fault affects this one of so many subscribers.
    fn affects(self, subscriber: usize, subscribers: usize) -> bool {
        match self {
            InjectedFault::Nothing => false,
            InjectedFault::Datagrams(_) | InjectedFault::Fragments(_) => true,
            InjectedFault::DatagramsToTheLast(_) => subscriber + 1 == subscribers,
            InjectedFault::Stops => subscriber == 0,
        }
    }

    const fn cause(self) -> LossCause {
        match self {
            InjectedFault::Fragments(_) => LossCause::Reassembly,
            InjectedFault::Stops => LossCause::SocketBuffer,
            _ => LossCause::BeforeHost,
        }
    }
}

impl Experiment {
    /// Runs the experiment, and returns cells by subscriber and fault.
    pub(crate) fn run(&self) -> Result<Vec<Cell>> {
        let link = Link::new()?;
        run(&format!(
            "ip netns exec {} sysctl -qw net.ipv4.ipfrag_time=1",
            link.monitor.name()
        ))?;
        let mut witness = Witness::start(&format!(
            "watch: [/**]\n\
             capture: {{source: host, record_ring_bytes: {RECORD_RING}, cgroup: {}}}\n",
            link.cgroup().display()
        ))?;
        let directory = tempfile::tempdir()?;
        let agent = self.agent(&link, directory.path())?;
        let mut peers = self.peers(&link)?;
        witness.wait_for("the endpoints", PATIENCE, |seen| {
            let mut topics = seen.topics.iter();
            let topic = topics.find(|topic| topic.name == self.size.stream().topic)?;
            let known = (topic.publishers.len(), topic.subscriptions.len());
            (known == (1, self.subscribers)).then_some(())
        })?;

        let mut spans = Vec::new();
        for (trouble, due) in self.troubles.iter().zip(1..) {
            spans.push(self.span(*trouble, due * self.size.samples(), &link, &mut peers)?);
        }
        peers.publisher.wait_sent(PATIENCE)?;
        std::thread::sleep(REASSEMBLY);
        peers.wait_quiet()?;
        let sent = Truth::of(&peers.publisher, "pub")?;
        let received = peers.subscribers.iter().map(|peer| Truth::of(peer, "sub"));
        let received: Vec<Truth> = received.collect::<Result<_>>()?;
        ensure!(
            sent.numbers.len() as u64 == self.samples(),
            "not all was sent"
        );
        // The sums settle while the peers run, and the lists once the peers have ended.
        let doubts = differing_sums(&mut witness, &sent, &received)?;
        let seen = witness.latest().context("no snapshot")?;
        let topic = self.size.stream().topic;
        let page = agent.as_ref().map(|agent| agent.settled_scrape(&topic, 0));
        let page = page.transpose()?;
        let incomplete = Snmp::of(peers.host()?)?.reassembly_failures()?;
        peers.terminate()?;
        let testimony = witness.finish()?;
        testimony.ensure_complete()?;
        if testimony.skipped_runs > 0 {
            println!("the kernel left out {} runs", testimony.skipped_runs);
        }

        let mut cells = Vec::new();
        for (subscriber, truth) in received.iter().enumerate() {
            let losses = reported(&testimony.delivery_losses, &seen, &sent.guid, &truth.guid)?;
            if let Some(page) = &page {
                truth.check_page(page, &losses)?;
            }
            let missing = truth.missing(&sent.numbers);
            for (span, due) in spans.iter().zip(1..) {
                let mut cell = self.cell(subscriber, (span, due), &missing, &losses);
                if let InjectedFault::Fragments(_) = span.trouble {
                    let reported = cell.losses_by(LossCause::Reassembly);
                    let unreported = incomplete.checked_sub(reported as u64);
                    ensure!(
                        unreported.is_some_and(|unreported| unreported <= MAX_UNREPORTED),
                        "{cell}: the kernel had {incomplete} incomplete datagrams, and counted{}: {:?}",
                        testimony.counted(),
                        testimony.delivery_losses
                    );
                    // A busy machine may drop a first fragment, too: nothing is incomplete then.
                    let is_less = reported < cell.lost.len();
                    cell.possible_causes
                        .extend(is_less.then_some(LossCause::BeforeHost));
                }
                cells.push(cell);
            }
            let beyond: Vec<_> = losses.range(self.samples() + 1..).collect();
            ensure!(beyond.is_empty(), "never sent: {beyond:?}");
        }
        if !doubts.is_empty() {
            for cell in &cells {
                println!("{cell} {:?}", cell.faults());
            }
            bail!("{}", doubts.join("; "));
        }
        Ok(cells)
    }

    /// Returns the losses of a subscriber in the stretch that ends with `due` times the samples of
    /// one stretch.
    fn cell(
        &self,
        subscriber: usize,
        (span, due): (&Span, u64),
        missing: &BTreeSet<u64>,
        losses: &BTreeMap<u64, LossCause>,
    ) -> Cell {
        let numbers = (due - 1) * self.size.samples() + 1..=due * self.size.samples();
        let trouble = span.trouble;
        let strikes = trouble.affects(subscriber, self.subscribers);
        let mut possible = BTreeSet::new();
        possible.extend(strikes.then_some(trouble.cause()));
        possible.extend(span.overflown.then_some(LossCause::SocketBuffer));
        Cell {
            name: format!(
                "{:?} {:?} {trouble:?} subscriber {subscriber}",
                self.stack, self.size
            ),
            sent: numbers.clone().collect(),
            lost: missing.range(numbers.clone()).copied().collect(),
            reported: losses.range(numbers).map(|(at, why)| (*at, *why)).collect(),
            possible_causes: possible,
            drops_samples: strikes,
        }
    }

    /// Starts the agent itself beside the witness. The agent's page must show the same losses.
    fn agent<'a>(&self, link: &'a Link, directory: &Path) -> Result<Option<Agent<'a>>> {
        if self.subscribers < 2 {
            return Ok(None);
        }
        let file = directory.join("ros2probe.yaml");
        let configuration = format!(
            "watch: [{{topic: /**, per_subscriber: true}}]\n\
             capture: {{source: host, cgroup: {}}}\n",
            link.cgroup().display()
        );
        std::fs::write(&file, configuration)?;
        Agent::start(&link.monitor, env!("CARGO_BIN_EXE_rp"), &file).map(Some)
    }

    const fn samples(&self) -> u64 {
        self.size.samples() * self.troubles.len() as u64
    }

    fn peers(&self, link: &Link) -> Result<Peers> {
        let stream = Stream {
            count: self.samples(),
            ..self.size.stream()
        };
        let names = ["/first", "/second"].into_iter().take(self.subscribers);
        let subscribers = names.map(|name| {
            let host = &link.monitor;
            Peer::start(host, self.stack, Role::Subscriber, &stream, &[name])
        });
        let mut subscribers: Vec<Peer> = subscribers.collect::<Result<_>>()?;
        // Cyclone DDS sends to a multicast address as soon as there are two subscribers.
        let unicast = "CYCLONEDDS_URI=<General><AllowMulticast>spdp</AllowMulticast></General>";
        let mut enter = link.robot.inside();
        enter.extend(["env", unicast].map(str::to_owned));
        let stream = Stream {
            peers: self.subscribers,
            stretch: self.size.samples(),
            ..stream
        };
        let role = Role::Publisher;
        let mut publisher = Peer::launch_behind(&enter, self.stack, role, &stream, &["/talker"])?;
        publisher.wait_ready()?;
        publisher.wait_matched()?;
        subscribers.iter_mut().try_for_each(Peer::wait_matched)?;
        Ok(Peers {
            publisher,
            subscribers,
        })
    }

    /// Applies one fault while the next stretch is sent, until `due` samples are sent in total.
    fn span(
        &self,
        trouble: InjectedFault,
        due: u64,
        link: &Link,
        peers: &mut Peers,
    ) -> Result<Span> {
        let host = peers.host()?;
        let overflows = || Snmp::of(host)?.receive_buffer_errors();
        let before = overflows()?;
        let _loss = self.loss(trouble, link, peers)?;
        peers.publisher.start_sending()?;
        if trouble == InjectedFault::Stops {
            // A busy publisher may send little while its subscriber is stopped for a short time.
            self.stop(peers, || Ok(overflows()? > before))?;
        }
        while (peers.publisher.log()?.sequences("pub").len() as u64) < due {
            match trouble {
                InjectedFault::Stops => self.stop(peers, || Ok(true))?,
                _ => std::thread::sleep(PAUSE),
            }
        }
        peers.wait_quiet()?;
        Ok(Span {
            trouble,
            overflown: overflows()? > before,
        })
    }

    /// Stops the first subscriber for a while, and until `is_enough` is true.
    fn stop(&self, peers: &Peers, is_enough: impl Fn() -> Result<bool>) -> Result<()> {
        let (stands, runs) = self.size.stop();
        let slow = &peers.subscribers.first().context("no subscriber")?.process;
        slow.signal("STOP")?;
        std::thread::sleep(stands);
        let deadline = Instant::now() + PATIENCE;
        while !is_enough()? && Instant::now() < deadline {
            std::thread::sleep(PAUSE);
        }
        slow.signal("CONT")?;
        std::thread::sleep(runs);
        Ok(())
    }

    fn loss<'a>(
        &self,
        trouble: InjectedFault,
        link: &'a Link,
        peers: &Peers,
    ) -> Result<Option<Loss<'a>>> {
        let (per_cent, part, to) = match trouble {
            InjectedFault::Nothing | InjectedFault::Stops => return Ok(None),
            InjectedFault::Datagrams(per_cent) => (per_cent, Part::Whole, None),
            InjectedFault::Fragments(per_cent) => (per_cent, Part::Trailing, None),
            InjectedFault::DatagramsToTheLast(per_cent) => {
                (per_cent, Part::Whole, Some(peers.last_ports()?))
            }
        };
        let length = match self.size {
            Size::B320 => "380-500",
            _ => "1000-65535",
        };
        let to = to.map_or_else(String::new, |ports| {
            format!("udp dport {{ {} }}", ports.join(", "))
        });
        let datagrams = format!("udp length {length} udp dport != {{ {DISCOVERY} }} {to}");
        // Another datagram of a sample is dropped each time.
        let nth = match self.size.datagrams(self.stack) {
            1 => 100 / per_cent,
            several => 100 * several / per_cent - 1,
        };
        Loss::of_datagrams(&link.robot, &datagrams, nth, part).map(Some)
    }
}

/// Waits until the agent has counted what each subscriber logged, and returns where the counts
/// differ. A loss after the last received sample may be open until the writer ends, because a
/// stopped subscriber may miss the last sample.
fn differing_sums(witness: &mut Witness, sent: &Truth, received: &[Truth]) -> Result<Vec<String>> {
    let mut doubts = Vec::new();
    for truth in received {
        let missing = truth.missing(&sent.numbers);
        let open = missing
            .iter()
            .rev()
            .take_while(|number| truth.numbers.last() < Some(number))
            .count() as u64;
        let logged = (truth.numbers.len() as u64, missing.len() as u64);
        let (mut counted, mut rows) = (None, String::new());
        let agreed = witness.wait_for("the counts of the log", SETTLED, |seen| {
            let sums = sums(seen, &sent.guid, &truth.guid);
            // The deliveries of peers vanish when the peers leave.
            if sums.messages > 0 {
                counted = Some(sums);
                let all = seen.topics.iter().flat_map(|topic| &topic.deliveries);
                rows = all.map(|row| format!("\n{row:?}")).collect();
                let received = seen
                    .topics
                    .iter()
                    .filter_map(|topic| topic.received.as_ref());
                rows.extend(received.map(|sum| format!("\nin all {sum:?}")));
            }
            let is_lost = (logged.1 - open..=logged.1).contains(&sums.lost());
            (sums.messages == logged.0 && is_lost).then_some(())
        });
        if agreed.is_err() {
            doubts.push(format!(
                "received and lost {logged:?} by the log, but {counted:?} in {rows}"
            ));
        }
    }
    Ok(doubts)
}

struct Peers {
    publisher: Peer,
    subscribers: Vec<Peer>,
}

impl Peers {
    /// Returns a process on the subscribers' host.
    fn host(&self) -> Result<u32> {
        let subscriber = self.subscribers.first().context("no subscriber")?;
        Ok(subscriber.process.pid())
    }

    /// Returns the ports that only the last subscriber has.
    fn last_ports(&self) -> Result<Vec<String>> {
        let mut sockets = self
            .subscribers
            .iter()
            .rev()
            .map(|peer| peer.process.udp_ports());
        let mut ports = sockets.next().context("no subscriber")??;
        for others in sockets {
            let others = others?;
            ports.retain(|port| !others.contains(port));
        }
        Ok(ports.iter().map(u16::to_string).collect())
    }

    /// Waits until all samples have left, and have arrived if they can.
    fn wait_quiet(&self) -> Result<()> {
        let state = || {
            let logs = self.subscribers.iter().map(|peer| Ok(peer.log()?.0.len()));
            let received: Vec<usize> = logs.collect::<Result<_>>()?;
            let sent = Snmp::of(self.publisher.process.pid())?.sent()?;
            anyhow::Ok((sent, received))
        };
        let mut before = state()?;
        loop {
            std::thread::sleep(SILENCE_CHECK_INTERVAL);
            let now = state()?;
            if now.1 == before.1 && now.0 < before.0 + ANNOUNCEMENTS {
                return Ok(());
            }
            before = now;
        }
    }

    fn terminate(&mut self) -> Result<()> {
        for peer in self.subscribers.iter_mut().chain([&mut self.publisher]) {
            peer.process.terminate()?;
        }
        Ok(())
    }
}

/// A peer's log of its stream.
pub(crate) struct Truth {
    pub(crate) guid: String,
    pub(crate) numbers: BTreeSet<u64>,
}

impl Truth {
    pub(crate) fn of(peer: &Peer, kind: &str) -> Result<Truth> {
        let log = peer.log()?;
        let endpoint = log
            .endpoints()
            .find(|event| event.kind.as_deref() == Some(kind));
        let guid = endpoint
            .and_then(|event| event.guid.clone())
            .context("no endpoint is logged")?;
        Ok(Truth {
            guid,
            numbers: log.writer_numbers(kind)?,
        })
    }

    /// Checks that an agent's page has the same counts for this reader.
    fn check_page(&self, page: &Scrape, losses: &BTreeMap<u64, LossCause>) -> Result<()> {
        let prefix = self.guid.get(..24).context("a short GUID")?;
        let subscriber = format!("participant {prefix}.000001c1");
        let reader_label = ("subscriber", subscriber.as_str());
        let received = page.sum("ros2_subscriber_received_messages_total", &[reader_label]);
        ensure!(
            received == self.numbers.len() as f64,
            "{received} on the page"
        );
        for cause in LossCause::ALL {
            let name = "ros2_subscriber_lost_messages_total";
            let lost = page.sum(name, &[reader_label, ("cause", cause.label())]);
            let reported = losses.values().filter(|each| **each == cause).count();
            ensure!(
                lost == reported as f64,
                "{lost} of {} on the page",
                cause.label()
            );
        }
        Ok(())
    }

    /// Returns the numbers after the first received one that were sent and not received.
    pub(crate) fn missing(&self, sent: &BTreeSet<u64>) -> BTreeSet<u64> {
        let first = self.numbers.first().copied().unwrap_or(u64::MAX);
        sent.range(first..)
            .filter(|number| !self.numbers.contains(number))
            .copied()
            .collect()
    }
}

/// Returns the sums of one reader. They include samples that arrived before the socket's owner was
/// known.
pub(crate) fn sums(seen: &Snapshot, writer: &str, reader: &str) -> Delivered {
    let sockets = sockets_of(seen, reader);
    let mut sums = Delivered::default();
    for delivery in seen.topics.iter().flat_map(|topic| &topic.deliveries) {
        let of_reader = delivery
            .readers
            .iter()
            .any(|guid| is_same_cause(*guid, reader))
            || delivery.readers.is_empty()
                && delivery
                    .sockets
                    .iter()
                    .any(|socket| sockets.contains(socket));
        if delivery.direction == Direction::Received
            && of_reader
            && is_same_cause(delivery.writer, writer)
        {
            sums.add(&delivery.delivered);
        }
    }
    sums
}

/// Returns the sockets at which a reader is known to receive.
fn sockets_of(seen: &Snapshot, reader: &str) -> BTreeSet<u64> {
    let deliveries = seen.topics.iter().flat_map(|topic| &topic.deliveries);
    let of_reader =
        deliveries.filter(|each| each.readers.iter().any(|guid| is_same_cause(*guid, reader)));
    of_reader.flat_map(|each| each.sockets.clone()).collect()
}

/// Returns the lost numbers of one reader with their cause, each once. A loss that was settled
/// before the socket's owner was known belongs to the reader that owns the socket.
pub(crate) fn reported(
    losses: &[DeliveryLoss],
    seen: &Snapshot,
    writer: &str,
    reader: &str,
) -> Result<BTreeMap<u64, LossCause>> {
    let sockets = sockets_of(seen, reader);
    let is_prefix = |prefix| {
        let participant = Guid::new(prefix, EntityId::PARTICIPANT).to_string();
        participant.get(..24) == reader.get(..24)
    };
    let mut reported = BTreeMap::new();
    for loss in losses {
        let socket = sockets.contains(&loss.socket);
        if loss.participant.map_or(socket, is_prefix) && is_same_cause(loss.writer, writer) {
            for number in loss.first.0..=loss.last.0 {
                let before = reported.insert(number, loss.cause);
                ensure!(before.is_none(), "{number} was lost twice: {loss:?}");
            }
        }
    }
    Ok(reported)
}

/// Compares a GUID with one of a log, which has no point.
pub(crate) fn is_same_cause(guid: Guid, logged: &str) -> bool {
    guid.to_string().replace('.', "") == logged
}
