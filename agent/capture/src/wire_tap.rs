//! One network namespace observed on its interfaces: kernel filter, hook and ring, and the path of
//! their output to the model.
//!
//! The filter runs at tcx ([`super::tcx`]) where the kernel has it, otherwise at a packet socket.
//! Frames and records arrive through two rings, either of which may be faster; both are merged by
//! time. The tap sends nothing.

mod hook;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use ros2probe_wire::frame::{self, PacketType, Payload};
use ros2probe_wire::record::Body;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Reason, Record, Timestamp, WireError};

use super::border::observe;
use super::filter::{Filter, FilterError};
use super::interfaces::{Change, Interface, Interfaces, InterfacesError, Selection};
use super::reattach::{Identity, identity};
use super::reorder_buffer::{Next, ReorderBuffer, Segment as Waiting};
use super::ring::{RingError, RingFrame};
use super::streams::{Chunk, Streams, flow, flow_of};
use super::system::Clocks;
use super::tcx::{FollowError, TcxError};
use crate::ahead::{Ahead, ReadyItem};
use crate::reassembly::{FlowKey, Limits, Reassembled, Reassembly};
use crate::settings::WireChoice;
use crate::threads::Spawn;
use hook::{Hook, Taken};
use ros2probe_model::graph::zenoh::StreamId;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;

/// Records younger than this wait for frames captured before them: a frame waits up to 100 ms until
/// its block is full.
pub const SETTLE_NANOSECONDS: u64 = 120_000_000;
/// Fragments of one sample follow each other within microseconds; a longer pause ends the run.
const STALLED_NANOSECONDS: u64 = 60_000_000;

/// Why the interfaces of a namespace cannot be observed.
#[derive(Debug, thiserror::Error)]
pub enum WireTapError {
    /// The kernel filter failed.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// Programs at the interfaces are required but unavailable.
    #[error("the configuration requires tcx (capture.wire)")]
    Tcx(#[from] TcxError),
    /// The packet socket or its ring failed.
    #[error(transparent)]
    Ring(#[from] RingError),
    /// The interfaces cannot be listed.
    #[error(transparent)]
    Interfaces(#[from] InterfacesError),
}

/// The observed interfaces of a namespace, and the memory for them.
#[derive(Clone, Debug)]
pub struct WireTapSettings {
    /// How the interfaces are observed.
    pub wire: WireChoice,
    /// The observed interfaces.
    pub selection: Selection,
    /// Bytes of the packet ring.
    pub ring_bytes: usize,
    /// Bytes of the record ring.
    pub record_ring_bytes: usize,
    /// Limits of IP reassembly.
    pub reassembly: Limits,
    /// TCP ports of Zenoh.
    pub zenoh_ports: Vec<u16>,
}

/// The tap of one network namespace.
pub struct WireTap {
    path: Option<PathBuf>,
    /// Device and inode of the namespace at the path. The socket keeps the namespace alive, so no
    /// other namespace gets the same identity.
    identity: Option<Identity>,
    /// Whether the path is gone or names another namespace.
    is_gone: bool,
    hook: Hook,
    filter: Filter,
    interfaces: Interfaces,
    selection: Selection,
    /// Number of captured frames by interface index.
    packets: BTreeMap<u32, u64>,
    frames: FrameAssembly,
    refused_interfaces: u64,
    included: IncludedInterfaces,
}

impl WireTap {
    /// Opens a tap in the calling thread's namespace, which is the one at `path` or, without a
    /// path, the agent's own. `number` distinguishes the taps. Excluded interfaces are not read at any
    /// time.
    ///
    /// # Errors
    /// Fails if a capability is missing, or if the kernel refuses the socket, ring or filter.
    pub fn open(
        settings: &WireTapSettings,
        number: u32,
        path: Option<PathBuf>,
    ) -> Result<Self, WireTapError> {
        let selection = settings.selection.clone();
        let interfaces = Interfaces::open()?;
        let mut included = IncludedInterfaces::default();
        included.update(&selection, &interfaces);
        let (filter, hook) = hook::open(settings, &interfaces)?;
        Ok(Self {
            identity: path.as_deref().and_then(identity),
            is_gone: false,
            path,
            hook,
            filter,
            interfaces,
            selection,
            packets: BTreeMap::new(),
            frames: FrameAssembly {
                number,
                reassembly: Reassembly::new(settings.reassembly),
                ahead: Ahead::default(),
                order: ReorderBuffer::default(),
                streams: Streams::new(settings.zenoh_ports.clone()),
                copied_bytes: 0,
            },
            refused_interfaces: 0,
            included,
        })
    }

    /// Starts the thread that attaches the filter to interfaces that appear later, if it is needed.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> Result<(), FollowError> {
        self.hook.start(self.path.as_deref(), spawn)
    }

    /// Returns how the interfaces are observed; never [`WireChoice::Auto`].
    #[must_use]
    pub const fn hook(&self) -> WireChoice {
        self.hook.kind()
    }

    /// Returns why tcx is not used, as a sentence; `None` if it is used, or not configured.
    #[must_use]
    pub fn without_tcx(&self) -> Option<&str> {
        self.hook.without_tcx()
    }

    /// Returns the network namespace as configured; `None` = the agent's own.
    #[must_use]
    pub fn namespace(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Logs if the path is gone or names another namespace. Frames in the new namespace are not
    /// seen, because entering it would take privileges that were dropped. Logs again when the first
    /// namespace is back.
    pub fn check_namespace(&mut self) {
        let Some(path) = &self.path else { return };
        let is_gone = is_replaced(path, self.identity);
        if is_gone == self.is_gone {
            return;
        }
        self.is_gone = is_gone;
        let namespace = path.display();
        if is_gone {
            tracing::warn!(
                %namespace,
                "the network namespace was removed or replaced: restart to observe the current one"
            );
        } else {
            tracing::info!(%namespace, "the network namespace is back");
        }
    }

    /// Returns a sentence about an object that is gone: the namespace, or an interface that the
    /// configuration names. `None` if all exist.
    #[must_use]
    pub fn missing_object(&self) -> Option<String> {
        if let (Some(path), true) = (&self.path, self.is_gone) {
            let path = path.display();
            return Some(format!(
                "the network namespace {path} was removed or replaced: restart to observe the \
                 current one"
            ));
        }
        let interface = self.included.missing()?;
        Some(match &self.path {
            Some(path) => format!(
                "the interface {interface} of the network namespace {} is gone",
                path.display()
            ),
            None => format!("the interface {interface} is gone"),
        })
    }

    /// Iterates over the interfaces that the configuration names exactly.
    pub fn named_interfaces(&self) -> impl Iterator<Item = &str> {
        self.selection.exact_names()
    }

    /// Returns whether an interface that the configuration names exists here, or existed.
    #[must_use]
    pub fn has_known(&self, interface: &str) -> bool {
        self.included.0.contains_key(interface)
    }

    /// Returns descriptors that are readable when frames, records or interface changes wait.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        let ring = self.hook.descriptor().or_else(|| self.filter.piece_ring());
        ring.into_iter()
            .chain([self.filter.record_ring(), self.interfaces.as_fd()])
    }

    /// Reads everything available, and passes everything older than [`SETTLE_NANOSECONDS`] to the
    /// model. Zenoh connections in `at_sockets` are left out: the host tap reports them.
    ///
    /// # Errors
    /// Fails if the kernel refuses to continue.
    pub fn poll(
        &mut self,
        clocks: &Clocks,
        at_sockets: Option<&Streams>,
        observer: &mut Observer,
    ) -> Result<(), WireTapError> {
        self.follow_interfaces();
        self.take_frames(clocks, at_sockets, observer)?;
        let recorded = self.frames.take_records(&mut self.filter);
        let stalled = clocks.monotonic.saturating_sub(STALLED_NANOSECONDS);
        self.frames.take_stalled(&mut self.filter, stalled);
        let settled = clocks.monotonic.saturating_sub(SETTLE_NANOSECONDS);
        let settled = settled.min(recorded);
        self.frames.deliver(clocks, settled, at_sockets, observer);
        self.frames.advance(clocks, observer);
        Ok(())
    }

    /// Passes all buffered data to the model at the end.
    pub fn drain(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.frames.take_records(&mut self.filter);
        self.frames.take_stalled(&mut self.filter, clocks.monotonic);
        self.frames.deliver(clocks, u64::MAX, None, observer);
    }

    /// Returns the kernel filter.
    #[must_use]
    pub const fn filter(&self) -> &Filter {
        &self.filter
    }

    /// Returns the kernel filter, for setting interests.
    pub const fn filter_mut(&mut self) -> &mut Filter {
        &mut self.filter
    }

    /// Iterates over captured frames by interface name, or by index if the interface disappeared
    /// before its name was known.
    pub fn packets(&self) -> impl Iterator<Item = (String, u64)> + '_ {
        self.packets.iter().map(|(index, packets)| {
            let name = self
                .interfaces
                .by_index(*index)
                .map_or_else(|| index.to_string(), |interface| interface.name.clone());
            (name, *packets)
        })
    }

    /// Returns the number of frames dropped by the kernel because the ring was full.
    ///
    /// # Errors
    /// Fails if the kernel's statistics cannot be read.
    pub fn drops(&mut self) -> Result<u64, WireTapError> {
        self.hook.drops(&self.filter)
    }

    /// Returns the bytes read from the kernel: frames and records.
    #[must_use]
    pub const fn copied_bytes(&self) -> u64 {
        self.frames.copied_bytes
    }

    /// Returns the number of fragmented datagrams that never became complete, in the kernel filter
    /// or here.
    #[must_use]
    pub const fn incomplete_datagrams(&self) -> u64 {
        let reassembly = self.frames.reassembly.counters();
        let waiting = self.frames.ahead.discarded() + self.hook.incomplete_frames();
        waiting + reassembly.evicted + reassembly.timed_out
    }

    /// Returns the bytes held for reassembly.
    #[must_use]
    pub const fn reassembly_bytes(&self) -> usize {
        self.frames.reassembly.bytes()
    }

    /// Returns the number of datagrams discarded because of the caps.
    #[must_use]
    pub const fn reassembly_evicted(&self) -> u64 {
        self.frames.reassembly.counters().evicted
    }

    /// Returns the connections of Zenoh.
    #[must_use]
    pub const fn streams(&self) -> &Streams {
        &self.frames.streams
    }

    /// Returns the number of interfaces that did not fit the kernel filter's map, or to which the filter
    /// could not be attached.
    #[must_use]
    pub fn refused_interfaces(&self) -> u64 {
        self.refused_interfaces + self.hook.refused_interfaces()
    }

    /// Applies changes of interfaces. A failed listing is repeated at the next call. A removed
    /// interface leaves no state, because containers come and go for years.
    fn follow_interfaces(&mut self) {
        let changes = self.interfaces.changes();
        if !changes.is_empty() {
            self.included.update(&self.selection, &self.interfaces);
        }
        for change in changes {
            let result = match change {
                Change::Present(Interface { index, name, .. }) => {
                    let accept = self.selection.accepts(&name);
                    self.hook.accept(&mut self.filter, index, accept)
                }
                Change::Gone(Interface { index, .. }) => {
                    let interfaces = &self.interfaces;
                    self.packets
                        .retain(|index, _| interfaces.by_index(*index).is_some());
                    self.hook.forget(&mut self.filter, index)
                }
            };
            self.refused_interfaces += u64::from(result.is_err());
        }
    }

    /// Reads frames. Their announcements are passed to the model immediately, all other data in
    /// order of time. Older data precedes a frame, so a writer's last samples count before its
    /// disposal is read.
    fn take_frames(
        &mut self,
        clocks: &Clocks,
        at_sockets: Option<&Streams>,
        observer: &mut Observer,
    ) -> Result<(), WireTapError> {
        let (filter, assembly) = (&mut self.filter, &mut self.frames);
        let failed = |reason, observer: &mut Observer| {
            observer.input(Input::DecodeError {
                stage: "frame",
                reason,
            });
        };
        self.hook.take_frames(filter, clocks, |taken| match taken {
            Taken::Begin(filter) => {
                assembly.take_records(filter);
            }
            Taken::Frame(captured) => {
                *self.packets.entry(captured.interface).or_default() += 1;
                if let Err(error) = assembly.frame(clocks, captured, at_sockets, observer) {
                    failed(error.reason, observer);
                }
            }
            Taken::Damaged => failed(Reason::BadLength, observer),
        })
    }
}

/// Returns whether a path is gone or leads to another file than the one with this identity. A path
/// that cannot be read may still lead to it: that of a process takes privileges that were dropped.
fn is_replaced(path: &Path, identity: Option<Identity>) -> bool {
    match fs::metadata(path) {
        Ok(metadata) => Some((metadata.dev(), metadata.ino())) != identity,
        Err(error) => error.kind() == io::ErrorKind::NotFound,
    }
}

/// The interfaces that the configuration names and that existed, with whether they exist now.
#[derive(Debug, Default)]
struct IncludedInterfaces(BTreeMap<String, bool>);

impl IncludedInterfaces {
    fn update(&mut self, selection: &Selection, interfaces: &Interfaces) {
        let there: BTreeSet<_> = interfaces.iter().map(|it| it.name.as_str()).collect();
        for (name, was_there) in &mut self.0 {
            let is_there = there.contains(name.as_str());
            if *was_there && !is_there {
                tracing::warn!(interface = name, "the interface is gone");
            } else if is_there && !*was_there {
                tracing::info!(interface = name, "the interface is back");
            }
            *was_there = is_there;
        }
        for name in there.into_iter().filter(|name| selection.names(name)) {
            self.0.entry(name.to_owned()).or_insert(true);
        }
    }

    fn missing(&self) -> Option<&str> {
        let mut missing = self.0.iter().filter(|(_, is_there)| !**is_there);
        missing.next().map(|(name, _)| name.as_str())
    }
}

/// State of one tap's frames and records before they reach the model.
struct FrameAssembly {
    number: u32,
    reassembly: Reassembly,
    ahead: Ahead,
    /// Records that wait for older ones.
    order: ReorderBuffer,
    /// Connections of Zenoh.
    streams: Streams,
    copied_bytes: u64,
}

impl FrameAssembly {
    /// Reads one round of records. Returns the time of the latest one if the ring may have more,
    /// else `u64::MAX`. [`Self::deliver`] decides what is passed to the model.
    fn take_records(&mut self, filter: &mut Filter) -> u64 {
        self.order.take_records(filter, &mut self.copied_bytes)
    }

    /// Takes runs of fragments that have not grown since `before` in the filter's clock.
    fn take_stalled(&mut self, filter: &mut Filter, before: u64) {
        for record in filter.stalled_runs(before) {
            self.copied_bytes += size_of::<Record>() as u64;
            self.order.kernel(record);
        }
    }

    /// Passes the records and segments up to `until`, in the filter's clock, to the model.
    fn deliver(
        &mut self,
        clocks: &Clocks,
        until: u64,
        at_sockets: Option<&Streams>,
        observer: &mut Observer,
    ) {
        while let Some(next) = self.order.next(clocks, until) {
            let record = match next {
                Next::Kernel(record) => record,
                Next::Walked(record) | Next::Polled(record) => {
                    observe(observer, &record);
                    continue;
                }
                Next::Segment(segment) => {
                    self.read_segment(&segment, at_sockets, observer);
                    continue;
                }
            };
            if matches!(record.body(), Body::Handover) {
                let (at, key) = (
                    Timestamp(record.time),
                    FlowKey::of_handover(self.number, &record),
                );
                if let Some(rest) = self.reassembly.hand_over(at, key, &record) {
                    let ready = |each| deliver_ready(each, observer);
                    self.ahead.add_remainder(self.number, rest, ready);
                }
            }
            let ready = |each| deliver_ready(each, observer);
            self.ahead.record(self.number, record, ready);
        }
    }

    /// Discards datagrams and TCP segments that have waited too long for others.
    fn advance(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.ahead.advance(clocks.now);
        self.reassembly.advance(clocks.now);
        let now = Timestamp(clocks.now.0.saturating_sub(SETTLE_NANOSECONDS));
        self.streams
            .advance(now, |streamed| streamed.pass_to(observer));
    }

    /// Reads a segment of Zenoh, and passes the messages that it completes to the model.
    fn read_segment(
        &mut self,
        segment: &Waiting,
        at_sockets: Option<&Streams>,
        observer: &mut Observer,
    ) {
        let chunk = segment.chunk();
        if at_sockets.is_some_and(|streams| streams.follows_flow(&chunk.stream.flow)) {
            return;
        }
        self.streams
            .chunk(&chunk, |streamed| streamed.pass_to(observer));
    }

    fn frame(
        &mut self,
        clocks: &Clocks,
        captured: &RingFrame<'_>,
        at_sockets: Option<&Streams>,
        observer: &mut Observer,
    ) -> Result<(), WireError> {
        self.copied_bytes += captured.bytes.len() as u64;
        let time = clocks.stamped(captured.time);
        let since = time.nanoseconds_since(clocks.now);
        let at = clocks.monotonic.saturating_add_signed(since);
        self.deliver(clocks, at, at_sockets, observer);
        let packet = frame::parse_cooked(
            captured.protocol,
            captured.packet_type,
            captured.bytes,
            captured.length,
        )?;
        let Some(packet) = packet else { return Ok(()) };
        let outgoing = captured.packet_type == PacketType::OUTGOING;
        let mut envelope = Envelope {
            time: time.0,
            destination: packet.destination,
            interface: captured.interface,
            outgoing,
            ..Envelope::default()
        };
        match &packet.payload {
            Payload::Datagram(udp) => {
                let stream = StreamId {
                    flow: flow_of(&packet, udp.source_port, udp.destination_port),
                    ..StreamId::default()
                };
                let is_quic =
                    self.streams
                        .datagram((time, stream), udp.payload, udp.length, |streamed| {
                            streamed.pass_to(observer);
                        });
                if is_quic {
                    return Ok(());
                }
                (envelope.source_port, envelope.destination_port) =
                    (udp.source_port, udp.destination_port);
                decode_frame(&envelope, udp.payload, clocks, &mut self.order, observer);
            }
            Payload::Fragment(fragment) => {
                let key =
                    FlowKey::new(self.number, captured.interface, outgoing, &packet, fragment);
                let Some(whole) = self.reassembly.fragment(time, key, fragment) else {
                    return Ok(());
                };
                if whole.handover.is_some() {
                    let ready = |each| deliver_ready(each, observer);
                    self.ahead.add_remainder(self.number, whole, ready);
                } else {
                    (envelope.source_port, envelope.destination_port) =
                        (whole.source_port, whole.destination_port);
                    envelope.fragmented = true;
                    let payload = whole.payload();
                    decode_frame(&envelope, payload, clocks, &mut self.order, observer);
                }
            }
            Payload::Segment(segment) => {
                let stream = StreamId {
                    flow: flow(&packet, segment),
                    outgoing,
                    namespace: self.number,
                    interface: captured.interface,
                    ..StreamId::default()
                };
                if at_sockets.is_some_and(|streams| streams.follows_flow(&stream.flow)) {
                    return Ok(());
                }
                let chunk = Chunk::of_segment(segment, time, stream);
                self.order.segment(at, &chunk);
                while let Some(oldest) = self.order.take_excess_segment() {
                    self.read_segment(&oldest, at_sockets, observer);
                }
            }
            Payload::Other(_) => {}
        }
        Ok(())
    }
}

/// Decodes a captured frame.
fn decode_frame(
    envelope: &Envelope,
    payload: &[u8],
    clocks: &Clocks,
    order: &mut ReorderBuffer,
    observer: &mut Observer,
) {
    let at = clocks.monotonic_of(Timestamp(envelope.time));
    order.datagram(at, envelope, payload, |_| {}, observer);
}

/// Passes a complete item to the model.
fn deliver_ready(ready: ReadyItem, observer: &mut Observer) {
    match ready {
        ReadyItem::Record(record) => observe(observer, &record),
        ReadyItem::Remainder(rest) => decode_remainder(&rest, observer),
    }
}

fn decode_remainder(rest: &Reassembled, observer: &mut Observer) {
    let Some(record) = rest.handover else { return };
    let envelope = Envelope::of_handover(&record, rest.last_seen);
    observer.input(Input::Datagram {
        envelope: &envelope,
        payload: rest.payload(),
        handover: Some(&record.handover()),
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::netns::tests::{in_new_namespace, ip};

    #[test]
    fn a_path_that_cannot_be_read_is_not_gone() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("namespace");
        fs::write(&path, "").unwrap();
        let first = identity(&path);
        assert!(first.is_some() && !is_replaced(&path, first));
        let kept = directory.path().join("kept");
        fs::rename(&path, &kept).unwrap();
        assert!(is_replaced(&path, first));
        // The kernel refuses to follow a link to itself.
        std::os::unix::fs::symlink(&path, &path).unwrap();
        assert!(identity(&path).is_none() && !is_replaced(&path, first));
        fs::remove_file(&path).unwrap();
        fs::write(&path, "").unwrap();
        assert!(is_replaced(&path, first));
    }

    #[test]
    fn a_configured_interface_is_reported_as_gone_until_it_exists_again() {
        in_new_namespace(|| {
            let names = ["one", "never", "patt*"].map(str::to_owned);
            let selection = Selection::new(&names, &[]).unwrap();
            let mut interfaces = Interfaces::open().unwrap();
            let mut included = IncludedInterfaces::default();
            let mut update = |command: &str| {
                ip(command);
                interfaces.changes();
                included.update(&selection, &interfaces);
                included.missing().map(str::to_owned)
            };
            assert_eq!(update("link add one type veth peer name pattern"), None);
            let missing = Some("one".to_owned());
            assert_eq!(update("link set one name other"), missing);
            assert_eq!(update("link set other name one"), None);
            // Deleting one end of a veth pair deletes the other; a pattern names no interface.
            assert_eq!(update("link delete one"), missing);
            assert_eq!(update("link add one type veth peer name far"), None);
        });
    }
}
