//! Messages by the stamp of their header, until all messages with the same stamp were seen.
//!
//! The messages of one stamp are evaluated together, some seconds after the last one. The order in
//! which sources deliver them is therefore irrelevant: messages in shared memory are polled and
//! arrive late.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, RtpsTime, SequenceNumber, Timestamp};

use super::graph::Output;
use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{
    ChainMessages, ChainStamps, RecentMessages, StampArrivals, StampMessages,
};

/// Time without a message after which the messages of a stamp are evaluated.
pub(super) const EVALUATION_SILENCE: Duration = Duration::from_secs(2);
/// Time after which the messages of a stamp are evaluated even if more may follow. Longer chains
/// are not recognized.
pub(super) const MAX_CHAIN_DURATION: Duration = Duration::from_secs(5);
/// Time for which later messages of an evaluated stamp are ignored.
const EVALUATED_STAMP_LIFETIME: Duration = Duration::from_secs(10);
/// Maximum nanoseconds from INFO_TS to the capture for which INFO_TS counts as the time of
/// publication.
const PLAUSIBLE_DELAY: i64 = 1_000_000_000;

/// Seconds and nanoseconds of a header.
pub(super) type Stamp = (i32, u32);
/// Domain and stamp.
pub(super) type Key = (DomainId, Stamp);

/// A message. Its times are wall time.
#[derive(Debug)]
pub(super) struct Published {
    pub(super) output: Arc<Output>,
    pub(super) writer: Guid,
    pub(super) number: SequenceNumber,
    /// Time of publication.
    pub(super) published: Timestamp,
    /// Time of its first datagram.
    pub(super) began: Timestamp,
    /// Time of the datagram that completed it.
    pub(super) at: Timestamp,
    /// Size of its payload in bytes.
    pub(super) size: u32,
    /// Whether it was sampled from shared memory, so its capture time is late.
    pub(super) sampled: bool,
    /// Whether its writer is on this host, or in the same capture.
    pub(super) is_local: bool,
    /// Times of arrival at participants of this host.
    pub(super) arrivals: Bounded<StampArrivals, Vec<(GuidPrefix, Timestamp)>>,
}

/// All messages with one stamp.
#[derive(Debug)]
pub(super) struct Group {
    pub(super) stamp: Stamp,
    pub(super) messages: Bounded<StampMessages, Vec<Published>>,
    /// Whether it had more messages than are kept.
    pub(super) is_crowded: bool,
}

/// The messages of a stamp, and the times of the first and the last one.
#[derive(Debug)]
struct Waiting {
    first: ModelTime,
    last: ModelTime,
    /// `None` once evaluated.
    group: Option<Group>,
}

/// Messages that wait for evaluation.
#[derive(Debug, Default)]
pub(super) struct Messages {
    stamps: Bounded<ChainStamps, HashMap<Key, Waiting>>,
    /// Stamps in the order of their first message.
    order: Bounded<ChainStamps, VecDeque<Key>>,
    /// The latest messages of each writer.
    recent: Bounded<ChainStamps, HashMap<Guid, RecentOfWriter>>,
    /// Number of messages in all groups.
    open: Sum<Counted<ChainMessages>>,
}

/// The latest messages of one writer, with their stamps.
type RecentOfWriter = Bounded<RecentMessages, VecDeque<(SequenceNumber, Key)>>;

impl Published {
    /// Returns the time at which it reached this participant, if that was observed.
    pub(super) fn arrival(&self, prefix: GuidPrefix) -> Option<Timestamp> {
        let mut arrivals = self.arrivals.iter();
        let own = arrivals.find(|(participant, _)| *participant == prefix);
        own.map(|(_, at)| *at)
    }

    /// Returns the time at which it reached the node that published `next`, if that was observed.
    pub(super) fn reached(&self, next: &Self) -> Option<Timestamp> {
        let own = self.arrival(next.output.node.prefix);
        let captured = (!self.sampled && self.at <= next.published).then_some(self.at);
        own.or(captured)
    }
}

impl Messages {
    /// Adds a message. Returns a group that must be evaluated now because the table is full.
    pub(super) fn add(&mut self, key: Key, message: Published, now: ModelTime) -> Option<Group> {
        let (writer, number) = (message.writer, message.number);
        let is_full = self.open.is_full() || self.stamps.is_full();
        let evicted = if is_full { self.evict(key) } else { None };
        let order = &mut self.order;
        let new = || {
            order.push_back(key);
            Waiting {
                first: now,
                last: now,
                group: Some(Group {
                    stamp: key.1,
                    messages: Bounded::default(),
                    is_crowded: false,
                }),
            }
        };
        let Some(waiting) = self.stamps.get_or_insert_with(key, new) else {
            return evicted;
        };
        waiting.last = waiting.last.max(now);
        if let Some(group) = &mut waiting.group {
            if group.messages.push(message).is_some() {
                group.is_crowded = true;
                return evicted;
            }
            self.open.add(1);
            self.recent(writer, number, key);
        }
        evicted
    }

    /// Removes the oldest stamp other than `keep`, and returns its messages.
    fn evict(&mut self, keep: Key) -> Option<Group> {
        while let Some(key) = self.order.pop_front() {
            if key == keep {
                self.order.push_back(key);
                if self.order.len() == 1 {
                    return None;
                }
                continue;
            }
            let waiting = self.stamps.remove(&key);
            if let Some(group) = waiting.and_then(|waiting| waiting.group) {
                self.open.sub(group.messages.len());
                self.open.refuse();
                return Some(group);
            }
            if !self.stamps.is_full() && !self.open.is_full() {
                return None;
            }
        }
        None
    }

    /// Notes the arrival of a message at a participant.
    pub(super) fn arrived(
        &mut self,
        (writer, number): (Guid, SequenceNumber),
        prefix: GuidPrefix,
        at: Timestamp,
    ) {
        let Some(recent) = self.recent.get(&writer) else {
            return;
        };
        let mut recent = recent.iter().rev();
        let Some((_, key)) = recent.find(|(known, _)| *known == number) else {
            return;
        };
        let waiting = self.stamps.get_mut(key);
        let Some(group) = waiting.and_then(|waiting| waiting.group.as_mut()) else {
            return;
        };
        let mut messages = group.messages.iter_mut();
        let message = messages.find(|each| each.writer == writer && each.number == number);
        if let Some(message) = message
            && message.arrival(prefix).is_none()
        {
            message.arrivals.push((prefix, at));
        }
    }

    /// Removes and returns the messages of all stamps that are old enough.
    pub(super) fn due(&mut self, now: ModelTime) -> Vec<Group> {
        let (stamps, open) = (&mut self.stamps, &mut self.open);
        let mut due: Vec<Group> = Vec::new();
        self.order.retain(|key| {
            let Some(waiting) = stamps.get_mut(key) else {
                return false;
            };
            if now - waiting.last >= EVALUATION_SILENCE || now - waiting.first >= MAX_CHAIN_DURATION
            {
                let group = waiting.group.take();
                open.sub(group.as_ref().map_or(0, |each| each.messages.len()));
                due.extend(group);
            }
            let is_kept = waiting.group.is_some() || now - waiting.last < EVALUATED_STAMP_LIFETIME;
            if !is_kept {
                stamps.remove(key);
            }
            is_kept
        });
        let stamps = &self.stamps;
        self.recent.retain(|_, recent| {
            recent
                .back()
                .is_some_and(|(_, key)| stamps.contains_key(key))
        });
        due
    }

    /// Removes and returns all messages at the end of the input.
    pub(super) fn settle(&mut self) -> Vec<Group> {
        let stamps = &mut self.stamps;
        self.open.clear();
        let groups = self
            .order
            .iter()
            .filter_map(|key| stamps.get_mut(key)?.group.take());
        groups.collect()
    }

    pub(super) fn table(&self) -> TableFacts {
        self.open.facts()
    }

    fn recent(&mut self, writer: Guid, number: SequenceNumber, key: Key) {
        let recent = self.recent.get_or_insert_with(writer, Bounded::default);
        recent.map(|recent| recent.push_back((number, key)));
    }
}

/// Returns the time of publication: INFO_TS if it is by the clock of the capture and plausible,
/// otherwise the time of the first datagram.
pub(super) fn publication(source: RtpsTime, began: Timestamp, is_local: bool) -> Timestamp {
    let source = source.timestamp().filter(|source| {
        let delay = began.nanoseconds_since(*source);
        is_local && (0..=PLAUSIBLE_DELAY).contains(&delay)
    });
    source.unwrap_or(began)
}
