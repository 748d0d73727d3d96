//! Reassembles UDP datagrams from IP fragments.
//!
//! Memory is allocated for bytes that have arrived, never for a length in a header. Flows and bytes
//! are capped, and the oldest flow is evicted first. A finished datagram is remembered for a while,
//! so that a duplicate fragment does not open it again. By default, fragments wait 30 s, as those
//! of IPv4 do in the receiving kernel (`ipfrag_time`). It keeps fragments of IPv6 for 60 s.
//!
//! The kernel filter walks fragmented datagrams itself. If it cannot continue, it hands the
//! datagram over: it reports the next submessage and captures only the remaining fragments. Such a
//! datagram is complete when everything from that submessage to the end has arrived.

mod flow;

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};

use ros2probe_model::facts::bounded::{Bounded, Counted, Sum};
use ros2probe_wire::frame::{Fragment, Packet};
use ros2probe_wire::record::{Record, flag};
use ros2probe_wire::{Cursor, Endianness, Timestamp};

use flow::{Flow, Placement};

use crate::tables::{FinishedFlows, FlowBytes, Flows};

const UDP_HEADER: u32 = 8;

/// Limits of memory and time.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Limits {
    /// Maximum bytes of all unfinished datagrams together, bookkeeping included.
    pub bytes: usize,
    /// Maximum number of unfinished datagrams.
    pub flows: usize,
    /// Nanoseconds for which an unfinished datagram is kept. Linux keeps it for 30 s with IPv4
    /// (`ipfrag_time`), and for 60 s with IPv6 (`ip6frag_time`).
    pub timeout: u64,
    /// Maximum number of finished datagrams that are remembered.
    pub max_finished: usize,
    /// Nanoseconds for which a finished datagram is remembered. Duplicates arrive within
    /// milliseconds, while a busy sender reuses an IPv4 identification after seconds.
    pub finished_lifetime: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            bytes: 4 << 20,
            flows: Flows::CAP,
            timeout: 30_000_000_000,
            max_finished: FinishedFlows::CAP,
            finished_lifetime: 1_000_000_000,
        }
    }
}

/// Key shared by the fragments of one datagram. All of them take the same path, so a copy on
/// another interface or in the other direction belongs to another flow.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct FlowKey {
    /// Number of the source (network namespace, capture) that saw the fragments.
    pub namespace: u32,
    /// Index of the interface; 0 when unknown.
    pub interface: u32,
    /// Whether this host sent the datagram.
    pub outgoing: bool,
    /// Source address, IPv4-mapped for IPv4.
    pub source: [u8; 16],
    /// Destination address, IPv4-mapped for IPv4.
    pub destination: [u8; 16],
    /// IP identification.
    pub id: u32,
}

/// A reassembled datagram.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Reassembled {
    /// UDP header and payload; zeros before `start`.
    transport: Vec<u8>,
    /// The kernel filter's [`ros2probe_wire::record::kind::HANDOVER`] record, if the walk begins
    /// inside the payload.
    pub handover: Option<Record>,
    /// Offset in the payload at which to begin: 0 unless handed over. The bytes before it are
    /// zeros.
    pub start: u32,
    /// True length of the payload; more than [`Self::payload`] holds if the capture was cut short.
    pub length: u32,
    /// Capture time of the first fragment.
    pub first_seen: Timestamp,
    /// Capture time of the fragment that completed it.
    pub last_seen: Timestamp,
    /// Source port; 0 if handed over.
    pub source_port: u16,
    /// Destination port.
    pub destination_port: u16,
}

impl Reassembled {
    /// Returns the bytes held.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        // A new field does not compile until this pattern names it.
        let Self {
            transport,
            handover: _,
            start: _,
            length: _,
            first_seen: _,
            last_seen: _,
            source_port: _,
            destination_port: _,
        } = self;
        transport.capacity()
    }

    /// Returns the payload up to the first byte that is missing in the capture.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.transport
            .get(UDP_HEADER as usize..)
            .unwrap_or_default()
    }
}

/// Counters of the reassembly.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Counters {
    /// Datagrams completed.
    pub completed: u64,
    /// Unfinished datagrams discarded because of the caps.
    pub evicted: u64,
    /// Unfinished datagrams discarded because of their age.
    pub timed_out: u64,
    /// Fragments without new bytes.
    pub duplicate: u64,
    /// Fragments that contradict earlier ones: different bytes at the same offset, or bytes beyond
    /// the datagram's end.
    pub contradictory: u64,
    /// Datagrams with an invalid UDP header.
    pub malformed: u64,
}

/// All unfinished datagrams.
#[derive(Debug)]
pub struct Reassembly {
    limits: Limits,
    flows: Bounded<Counted<Flows>, HashMap<FlowKey, Flow>>,
    /// Flows by order of creation.
    order: BTreeMap<u64, FlowKey>,
    opened: u64,
    bytes: Sum<Counted<FlowBytes>>,
    finished: HashSet<FlowKey>,
    finished_order: Bounded<Counted<FinishedFlows>, VecDeque<(Timestamp, FlowKey)>>,
    counters: Counters,
}

impl FlowKey {
    /// Returns the key of a captured fragment.
    #[must_use]
    pub const fn new(
        namespace: u32,
        interface: u32,
        outgoing: bool,
        packet: &Packet<'_>,
        fragment: &Fragment<'_>,
    ) -> Self {
        Self {
            namespace,
            interface,
            outgoing,
            source: packet.source,
            destination: packet.destination,
            id: fragment.id,
        }
    }

    /// Returns the key of the datagram in a HANDOVER record.
    #[must_use]
    pub fn of_handover(namespace: u32, record: &Record) -> Self {
        let handover = record.handover();
        let mut destination = [0; 16];
        for (target, word) in destination.chunks_exact_mut(4).zip(record.destination) {
            target.copy_from_slice(&word.to_ne_bytes());
        }
        Self {
            namespace,
            interface: record.interface,
            outgoing: record.flags & flag::OUTGOING != 0,
            source: handover.source_address,
            destination,
            id: handover.identification,
        }
    }
}

impl Reassembly {
    /// Creates an empty reassembly.
    #[must_use]
    pub fn new(limits: Limits) -> Self {
        Self {
            limits,
            flows: Bounded::capped(limits.flows),
            order: BTreeMap::new(),
            opened: 0,
            bytes: Sum::capped(limits.bytes),
            finished: HashSet::new(),
            finished_order: Bounded::capped(limits.max_finished),
            counters: Counters::default(),
        }
    }

    /// Accepts a fragment; returns the datagram if this fragment completes it.
    pub fn fragment(
        &mut self,
        at: Timestamp,
        key: FlowKey,
        fragment: &Fragment<'_>,
    ) -> Option<Reassembled> {
        self.advance(at);
        if self.finished.contains(&key) {
            self.counters.duplicate += 1;
            return None;
        }
        let flow = self.open(at, key)?;
        let before = flow.memory();
        let placed = flow.place(at, fragment);
        let after = flow.memory();
        let handed_over = flow.handover.is_some();
        self.bytes.sub(before);
        self.bytes.add(after);
        match placed {
            Placement::New => {}
            Placement::Duplicate => self.counters.duplicate += 1,
            Placement::Contradiction => {
                self.counters.contradictory += 1;
                // The identification is reused, and the remaining fragments of the old datagram are
                // lost. A handed-over datagram stays, because the kernel filter has just seen it.
                if !handed_over {
                    self.close(&key);
                    let flow = self.open(at, key)?;
                    let before = flow.memory();
                    flow.place(at, fragment);
                    let after = flow.memory();
                    self.bytes.sub(before);
                    self.bytes.add(after);
                }
            }
        }
        self.finish(key)
    }

    /// Accepts a HANDOVER record, before or after the fragments of its datagram; returns the
    /// datagram if all of them have arrived.
    pub fn hand_over(
        &mut self,
        at: Timestamp,
        key: FlowKey,
        record: &Record,
    ) -> Option<Reassembled> {
        self.advance(at);
        if self.finished.contains(&key) {
            self.counters.duplicate += 1;
            return None;
        }
        if record.handover().offset >= u32::from(record.datagram_len) {
            self.counters.malformed += 1;
            return None;
        }
        self.open(at, key)?.handover.get_or_insert(*record);
        self.finish(key)
    }

    /// Discards datagrams that have waited too long at the time `now`. If they began long after it,
    /// the clock was set back.
    pub fn advance(&mut self, now: Timestamp) {
        while let Some(key) = self.oldest() {
            let fresh = self
                .flows
                .get(&key)
                .is_some_and(|flow| now.0.abs_diff(flow.first_seen.0) <= self.limits.timeout);
            if fresh {
                break;
            }
            self.close(&key);
            self.counters.timed_out += 1;
        }
        let remember = self.limits.finished_lifetime;
        let is_old = |(at, _): &mut (Timestamp, _)| now.0.abs_diff(at.0) > remember;
        while let Some((_, key)) = self.finished_order.pop_front_if(is_old) {
            self.finished.remove(&key);
        }
    }

    /// Returns the counters since the start.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// Returns the bytes currently held.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes.used()
    }

    /// Returns the number of unfinished datagrams.
    #[must_use]
    pub fn flows(&self) -> usize {
        self.flows.len()
    }

    fn oldest(&self) -> Option<FlowKey> {
        self.order.first_key_value().map(|(_, key)| *key)
    }

    /// Returns the flow of this key, and creates it if needed. At the cap, the oldest flow is
    /// evicted.
    fn open(&mut self, at: Timestamp, key: FlowKey) -> Option<&mut Flow> {
        if !self.flows.contains_key(&key) {
            if self.flows.is_full()
                && let Some(oldest) = self.oldest()
            {
                self.close(&oldest);
                self.counters.evicted += 1;
            }
            let flow = Flow::new(self.opened, at);
            self.bytes.add(flow.memory());
            self.order.insert(self.opened, key);
            self.opened += 1;
            self.flows.insert(key, flow);
        }
        self.flows.get_mut(&key)
    }

    fn close(&mut self, key: &FlowKey) -> Option<Flow> {
        let flow = self.flows.remove(key)?;
        self.order.remove(&flow.order);
        self.bytes.sub(flow.memory());
        Some(flow)
    }

    /// Returns the datagram of the flow if it is complete. Otherwise evicts the oldest flows until
    /// the bytes are within the cap.
    fn finish(&mut self, key: FlowKey) -> Option<Reassembled> {
        let complete = self.flows.get(&key)?.complete();
        if complete.is_none() {
            while self.bytes.is_exceeded()
                && let Some(oldest) = self.oldest()
            {
                self.close(&oldest);
                self.counters.evicted += 1;
            }
        }
        let (from, to) = complete?;
        let mut flow = self.close(&key)?;
        self.finished.insert(key);
        if let Some((_, oldest)) = self.finished_order.push_back((flow.last_seen, key)) {
            self.finished.remove(&oldest);
        }
        let transport = flow.take(from, to);
        let reassembled = match flow.handover {
            Some(record) => Some(handed_over(&flow, transport, &record)),
            None => whole(&flow, transport, to),
        };
        if reassembled.is_some() {
            self.counters.completed += 1;
        } else {
            self.counters.malformed += 1;
        }
        reassembled
    }
}

fn handed_over(flow: &Flow, transport: Vec<u8>, record: &Record) -> Reassembled {
    Reassembled {
        transport,
        handover: Some(*record),
        start: record.handover().offset,
        length: u32::from(record.datagram_len),
        first_seen: flow.first_seen,
        last_seen: flow.last_seen,
        source_port: record.source_port,
        destination_port: record.destination_port,
    }
}

/// Returns `None` if the UDP header is unreadable or its length exceeds the bytes that exist: no
/// socket received such a datagram.
fn whole(flow: &Flow, mut transport: Vec<u8>, total: u32) -> Option<Reassembled> {
    let mut cursor = Cursor::new(&transport, Endianness::Big);
    let source_port = cursor.u16("UDP source port").ok()?;
    let destination_port = cursor.u16("UDP destination port").ok()?;
    let udp_length = u32::from(cursor.u16("UDP length").ok()?);
    cursor.u16("UDP checksum").ok()?;
    if udp_length > total {
        return None;
    }
    let length = udp_length.checked_sub(UDP_HEADER)?;
    transport.truncate(usize::try_from(udp_length).ok()?);
    Some(Reassembled {
        transport,
        handover: None,
        start: 0,
        length,
        first_seen: flow.first_seen,
        last_seen: flow.last_seen,
        source_port,
        destination_port,
    })
}

#[cfg(test)]
mod tests;
