//! This host's interfaces: packets and records of every configured network namespace, given to the
//! model in the order in which they were captured.
//!
//! Each namespace has a tap of its own: packet socket, ring, kernel filter. Nothing is ever sent.

use std::collections::BTreeMap;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::path::PathBuf;
use std::time::Duration;

use ros2probe_wire::filter::{Budget, Counter};
use ros2probe_wire::frame::{self, PacketType, Payload};
use ros2probe_wire::record::{Verdict, kind};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Guid, GuidPrefix, Reason, Record, Timestamp, WireError};

use super::filter::{Filter, FilterError, FilterSettings};
use super::interfaces::{Change, Interface, Interfaces, InterfacesError, Selection};
use super::netns::{self, NetnsError};
use super::order::{Next, Order};
use super::ring::{self, Ring, RingError, RingFrame};
use super::system::{Clocks, wait};
use crate::config::CaptureSettings;
use crate::model::ahead::{Ahead, Ready};
use crate::model::observer::Observer;
use crate::model::reassembly::{FlowKey, Limits, Reassembled, Reassembly};

/// Records younger than this wait, so that frames captured before them are taken in first: a frame
/// waits up to 100 ms for its block to fill.
const SETTLE_NANOSECONDS: u64 = 120_000_000;
/// Fragments of one sample follow each other within microseconds; after this they do not.
const STALLED_NANOSECONDS: u64 = 60_000_000;
/// What unclassified writers may cost each second, all together: a dozen nodes that start at once
/// stay far below, a storm of forged ones stays bounded.
const UNKNOWN_BYTES_PER_SECOND: u32 = 4 << 20;
/// Handed out in small portions, so that a storm that comes while we are held up leaves most of the
/// record ring to the writers we know.
const UNKNOWN_RECORDS_PER_TENTH: u32 = 410;
const SECOND: u64 = 1_000_000_000;
const TENTH: u64 = SECOND / 10;
/// Records taken in at a time: several rings of the built-in size.
const RECORDS_PER_ROUND: usize = 32_768;

/// Why capturing could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// The kernel filter.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// The packet socket or its ring.
    #[error(transparent)]
    Ring(#[from] RingError),
    /// The list of interfaces.
    #[error(transparent)]
    Interfaces(#[from] InterfacesError),
    /// Another network namespace.
    #[error(transparent)]
    Namespace(#[from] NetnsError),
    /// An interface glob.
    #[error("capture.interfaces")]
    Selection(#[from] globset::Error),
    /// Waiting for packets.
    #[error("waiting for packets")]
    Wait(#[source] std::io::Error),
}

/// All taps.
pub struct LiveSource {
    taps: Vec<Tap>,
    /// When unclassified writers last got bytes and records to spend.
    bytes_refilled: u64,
    records_refilled: u64,
    refused_updates: u64,
    clock: Timestamp,
}

/// What one interface delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Interface name, or its index if it went away before it was known.
    pub name: String,
    /// Frames that the filter let through.
    pub packets: u64,
}

/// What the kernel dropped for one namespace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DropCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Frames lost because the packet ring was full.
    pub dropped: u64,
}

impl LiveSource {
    /// Opens a tap in this network namespace and in each configured one. When this returns, every
    /// tap is capturing.
    ///
    /// # Errors
    /// A capability is missing, a namespace does not exist, the kernel refuses.
    pub fn open(settings: &CaptureSettings, limits: Limits) -> Result<Self, CaptureError> {
        let mut taps = vec![Tap::open(settings, limits, 0, None)?];
        for (number, path) in (1..).zip(&settings.network_namespaces) {
            let tap = netns::within(path, || {
                Tap::open(settings, limits, number, Some(path.clone()))
            })??;
            taps.push(tap);
        }
        let clocks = Clocks::read();
        let mut source = Self {
            taps,
            bytes_refilled: 0,
            records_refilled: 0,
            refused_updates: 0,
            clock: clocks.now,
        };
        source.refill(clocks.monotonic);
        Ok(source)
    }

    /// Waits for packets, up to `timeout` or until `bell` is readable, and gives the model all there
    /// is.
    ///
    /// # Errors
    /// The kernel refuses to go on.
    pub fn poll(
        &mut self,
        timeout: Duration,
        bell: Option<BorrowedFd<'_>>,
        observer: &mut Observer,
    ) -> Result<(), CaptureError> {
        let descriptors = self.taps.iter().flat_map(Tap::descriptors);
        let descriptors: Vec<_> = descriptors.chain(bell).collect();
        wait(&descriptors, timeout).map_err(CaptureError::Wait)?;
        let clocks = Clocks::read();
        self.refill(clocks.monotonic);
        for tap in &mut self.taps {
            tap.follow_interfaces();
            tap.take_frames(&clocks, observer)?;
            tap.intake.take_records(&mut tap.filter);
            let stalled = clocks.monotonic.saturating_sub(STALLED_NANOSECONDS);
            tap.intake.take_stalled(&mut tap.filter, stalled);
            let settled = clocks.monotonic.saturating_sub(SETTLE_NANOSECONDS);
            tap.intake.deliver(&clocks, settled, observer);
            tap.intake.advance(&clocks);
        }
        self.clock = Timestamp(clocks.now.0.saturating_sub(SETTLE_NANOSECONDS));
        Ok(())
    }

    /// Gives the model what still waits, at the end.
    pub fn drain(&mut self, observer: &mut Observer) {
        let clocks = Clocks::read();
        for tap in &mut self.taps {
            tap.intake.take_records(&mut tap.filter);
            tap.intake.take_stalled(&mut tap.filter, clocks.monotonic);
            tap.intake.deliver(&clocks, u64::MAX, observer);
        }
    }

    /// Tells the kernel filters what has become of interest. What they have no room for stays
    /// unknown to them, and is counted.
    pub fn apply(&mut self, changes: &[(Guid, Option<Verdict>)]) {
        for tap in &mut self.taps {
            for (endpoint, verdict) in changes {
                let told = tap.filter.set_interest(*endpoint, *verdict);
                self.refused_updates += u64::from(told.is_err());
            }
        }
    }

    /// Notes from now on, or no longer, when a participant last sent anything.
    pub fn follow(&mut self, participant: GuidPrefix, follow: bool) {
        for tap in &mut self.taps {
            let told = tap.filter.follow_participant(participant, follow);
            self.refused_updates += u64::from(told.is_err());
        }
    }

    /// Updates that a kernel map had no room for, or that the kernel refused.
    #[must_use]
    pub fn refused_updates(&self) -> u64 {
        let interfaces: u64 = self.taps.iter().map(|tap| tap.refused_interfaces).sum();
        self.refused_updates + interfaces
    }

    /// Time up to which everything captured has been given to the model.
    #[must_use]
    pub const fn clock(&self) -> Timestamp {
        self.clock
    }

    /// When each followed participant last sent anything.
    #[must_use]
    pub fn last_seen(&self) -> BTreeMap<GuidPrefix, Timestamp> {
        let clocks = Clocks::read();
        let mut seen = BTreeMap::new();
        for (participant, at) in self.taps.iter().flat_map(|tap| tap.filter.participants()) {
            let at = clocks.calendar(at);
            let latest = seen.entry(participant).or_insert(at);
            *latest = at.max(*latest);
        }
        seen
    }

    /// Captured frames by interface.
    pub fn packets(&self) -> impl Iterator<Item = InterfaceCount> + '_ {
        self.taps.iter().flat_map(|tap| {
            tap.packets.iter().map(|(index, packets)| InterfaceCount {
                namespace: tap.path.clone(),
                name: tap
                    .interfaces
                    .by_index(*index)
                    .map_or_else(|| index.to_string(), |interface| interface.name.clone()),
                packets: *packets,
            })
        })
    }

    /// Frames that the kernel dropped, by namespace.
    ///
    /// # Errors
    /// The kernel does not tell.
    pub fn drops(&mut self) -> Result<Vec<DropCount>, CaptureError> {
        self.taps
            .iter_mut()
            .map(|tap| {
                Ok(DropCount {
                    namespace: tap.path.clone(),
                    dropped: tap.ring.statistics()?.drops,
                })
            })
            .collect()
    }

    /// The kernel filters' counters, summed.
    ///
    /// # Errors
    /// The kernel does not tell.
    pub fn counters(&self) -> Result<Vec<(Counter, u64)>, CaptureError> {
        let mut sums: Vec<_> = Counter::ALL.map(|counter| (counter, 0)).into();
        for tap in &self.taps {
            for ((_, sum), (_, value)) in sums.iter_mut().zip(tap.filter.counters()?) {
                *sum += value;
            }
        }
        Ok(sums)
    }

    /// Bytes that came from the kernel: frames and records.
    #[must_use]
    pub fn copied_bytes(&self) -> u64 {
        self.taps.iter().map(|tap| tap.intake.copied_bytes).sum()
    }

    /// Fragmented datagrams that were begun and never became complete: the kernel filter's and
    /// those reassembled here.
    #[must_use]
    pub fn incomplete_datagrams(&self) -> u64 {
        self.taps
            .iter()
            .map(|tap| {
                let reassembly = tap.intake.reassembly.counters();
                tap.intake.ahead.given_up() + reassembly.evicted + reassembly.timed_out
            })
            .sum()
    }

    /// Bytes held for reassembly.
    #[must_use]
    pub fn reassembly_bytes(&self) -> usize {
        self.taps
            .iter()
            .map(|tap| tap.intake.reassembly.bytes())
            .sum()
    }

    fn refill(&mut self, monotonic: u64) {
        let mut set = |budget, amount| {
            for tap in &mut self.taps {
                let refilled = tap.filter.set_unknown_budget(budget, amount);
                self.refused_updates += u64::from(refilled.is_err());
            }
        };
        if monotonic.wrapping_sub(self.bytes_refilled) >= SECOND {
            self.bytes_refilled = monotonic;
            set(Budget::CaptureBytes, UNKNOWN_BYTES_PER_SECOND);
        }
        if monotonic.wrapping_sub(self.records_refilled) >= TENTH {
            self.records_refilled = monotonic;
            set(Budget::Records, UNKNOWN_RECORDS_PER_TENTH);
        }
    }
}

/// One network namespace.
struct Tap {
    path: Option<PathBuf>,
    ring: Ring,
    filter: Filter,
    interfaces: Interfaces,
    selection: Selection,
    /// Frames captured by interface index.
    packets: BTreeMap<u32, u64>,
    intake: Intake,
    refused_interfaces: u64,
}

impl Tap {
    /// In the calling thread's namespace. The filter knows the interfaces before the socket sees
    /// the first frame.
    fn open(
        settings: &CaptureSettings,
        limits: Limits,
        number: u32,
        path: Option<PathBuf>,
    ) -> Result<Self, CaptureError> {
        let selection = Selection::new(&settings.include_interfaces, &settings.exclude_interfaces)?;
        let mut filter = Filter::load(&FilterSettings {
            record_ring_bytes: u32::try_from(settings.record_ring_bytes).unwrap_or(u32::MAX >> 1),
            accept_new_interfaces: selection.accepts_unknown(),
        })?;
        let interfaces = Interfaces::open()?;
        for interface in interfaces.iter() {
            filter.accept_interface(interface.index, selection.accepts(&interface.name))?;
        }
        let ring = Ring::open(
            ring::Settings::with_memory(settings.ring_bytes),
            Some(filter.program()),
        )?;
        Ok(Self {
            path,
            ring,
            filter,
            interfaces,
            selection,
            packets: BTreeMap::new(),
            intake: Intake {
                number,
                reassembly: Reassembly::new(limits),
                ahead: Ahead::default(),
                order: Order::default(),
                copied_bytes: 0,
            },
            refused_interfaces: 0,
        })
    }

    fn descriptors(&self) -> [BorrowedFd<'_>; 3] {
        [
            self.ring.as_fd(),
            self.filter.record_ring(),
            self.interfaces.as_fd(),
        ]
    }

    /// A list that cannot be read now is read the next time. Of an interface that is gone nothing
    /// is kept: containers come and go for years.
    fn follow_interfaces(&mut self) {
        for change in self.interfaces.changes().unwrap_or_default() {
            let told = match change {
                Change::Present(Interface { index, name, .. }) => {
                    let accept = self.selection.accepts(&name);
                    self.filter.accept_interface(index, accept)
                }
                Change::Gone(Interface { index, .. }) => {
                    let interfaces = &self.interfaces;
                    self.packets
                        .retain(|index, _| interfaces.by_index(*index).is_some());
                    self.filter.forget_interface(index)
                }
            };
            self.refused_interfaces += u64::from(told.is_err());
        }
    }

    /// What frames announce the model gets at once, what they count for in its turn. Before each
    /// frame it gets what is older: a writer's last samples count before its farewell is read.
    fn take_frames(
        &mut self,
        clocks: &Clocks,
        observer: &mut Observer,
    ) -> Result<(), CaptureError> {
        // Clears what the socket reports when a link goes down; without, waiting would never wait.
        self.ring.wait(Duration::ZERO)?;
        // No more than the ring holds: a flood must not keep us from everything else.
        for _ in 0..self.ring.blocks() {
            let Some(block) = self.ring.block() else {
                break;
            };
            self.intake.take_records(&mut self.filter);
            let mut frames = block.frames();
            for captured in frames.by_ref() {
                *self.packets.entry(captured.interface).or_default() += 1;
                if let Err(error) = self.intake.frame(clocks, &captured, observer) {
                    observer.decode_error("frame", error.reason);
                }
            }
            if frames.damaged() {
                observer.decode_error("frame", Reason::BadLength);
            }
        }
        Ok(())
    }
}

/// One tap's frames and records on their way to the model.
struct Intake {
    number: u32,
    reassembly: Reassembly,
    ahead: Ahead,
    /// What is to be counted, waiting for its turn.
    order: Order,
    copied_bytes: u64,
}

impl Intake {
    /// Empties the kernel's record ring; what the model gets of it is decided by [`Self::deliver`].
    /// A flood may fill it as fast as it is emptied: what is left is taken the next time.
    fn take_records(&mut self, filter: &mut Filter) {
        for _ in 0..RECORDS_PER_ROUND {
            let Some(record) = filter.next_record() else {
                return;
            };
            self.copied_bytes += size_of::<Record>() as u64;
            self.order.kernel(record);
        }
    }

    /// Takes runs of fragments that nobody has continued since `before` in the filter's clock.
    fn take_stalled(&mut self, filter: &mut Filter, before: u64) {
        for record in filter.stalled_runs(before) {
            self.copied_bytes += size_of::<Record>() as u64;
            self.order.kernel(record);
        }
    }

    /// Gives the model the records up to a time of the filter's clock.
    fn deliver(&mut self, clocks: &Clocks, until: u64, observer: &mut Observer) {
        while let Some(next) = self.order.next(clocks, until) {
            let record = match next {
                Next::Kernel(record) => record,
                Next::Walked(record) => {
                    observer.record(&record);
                    continue;
                }
            };
            if record.kind == kind::HANDOVER {
                let (at, key) = (
                    Timestamp(record.time),
                    FlowKey::of_handover(self.number, &record),
                );
                if let Some(rest) = self.reassembly.hand_over(at, key, &record) {
                    let ready = |each| take_in(each, observer);
                    self.ahead.rest(self.number, rest, ready);
                }
            }
            let ready = |each| take_in(each, observer);
            self.ahead.record(self.number, record, ready);
        }
    }

    /// Gives up what has waited too long for its rest.
    fn advance(&mut self, clocks: &Clocks) {
        self.ahead.advance(clocks.now);
        self.reassembly.advance(clocks.now);
    }

    fn frame(
        &mut self,
        clocks: &Clocks,
        captured: &RingFrame<'_>,
        observer: &mut Observer,
    ) -> Result<(), WireError> {
        self.copied_bytes += captured.bytes.len() as u64;
        let since = captured.time.nanoseconds_since(clocks.now);
        let until = clocks.monotonic.saturating_add_signed(since);
        self.deliver(clocks, until, observer);
        let packet = frame::parse_cooked(
            captured.protocol,
            captured.packet_type,
            captured.bytes,
            captured.length,
        )?;
        let Some(packet) = packet else { return Ok(()) };
        let outgoing = captured.packet_type == PacketType::OUTGOING;
        let mut envelope = Envelope {
            time: captured.time.0,
            destination: packet.destination,
            interface: captured.interface,
            outgoing,
            ..Envelope::default()
        };
        match &packet.payload {
            Payload::Datagram(udp) => {
                (envelope.source_port, envelope.destination_port) =
                    (udp.source_port, udp.destination_port);
                take_in_frame(&envelope, udp.payload, clocks, &mut self.order, observer);
            }
            Payload::Fragment(fragment) => {
                let key =
                    FlowKey::new(self.number, captured.interface, outgoing, &packet, fragment);
                let Some(whole) = self.reassembly.fragment(captured.time, key, fragment) else {
                    return Ok(());
                };
                if whole.handover.is_some() {
                    let ready = |each| take_in(each, observer);
                    self.ahead.rest(self.number, whole, ready);
                } else {
                    (envelope.source_port, envelope.destination_port) =
                        (whole.source_port, whole.destination_port);
                    envelope.fragmented = true;
                    let payload = whole.payload();
                    take_in_frame(&envelope, payload, clocks, &mut self.order, observer);
                }
            }
            _ => {}
        }
        Ok(())
    }
}

/// A captured datagram.
fn take_in_frame(
    envelope: &Envelope,
    payload: &[u8],
    clocks: &Clocks,
    order: &mut Order,
    observer: &mut Observer,
) {
    observer.announcements(envelope, payload, |observer, record| {
        if let Some(record) = order.walked(clocks, record) {
            observer.record(&record);
        }
    });
}

/// What has become complete.
fn take_in(ready: Ready, observer: &mut Observer) {
    match ready {
        Ready::Record(record) => observer.record(&record),
        Ready::Rest(rest) => take_in_rest(&rest, observer),
    }
}

fn take_in_rest(rest: &Reassembled, observer: &mut Observer) {
    let Some(record) = rest.handover else { return };
    let envelope = Envelope::of_handover(&record, rest.last_seen);
    observer.datagram(&envelope, rest.payload(), Some(&record.handover()));
}
