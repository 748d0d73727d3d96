//! State of one direction of a connection: its sender and the messages in FRAGMENTs.
//!
//! The aliases of keys and the declarations belong to the transport between two sessions. A
//! transport has two connections if both sessions open one at the same time: declarations and the
//! messages that use them may then be on different connections. The directions of a transport with
//! the same sender share one [`DirectionNumber`].

use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::zenoh::{
    Buffer, Fragment, Gid, Key, Lane, PORT, Resolution, Side, WhatAmI, WireExpr, ZenohId,
};

use super::stream::StreamId;
use crate::facts::bounded::{Bounded, ByOwner, HeapBytes};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{ZenohAliases, ZenohChains};

/// Maximum length of a key in bytes. A token of ROS with the longest names has 1.4 KiB.
pub(super) const MAX_KEY: usize = 2048;
/// Maximum size of one message in FRAGMENTs, in bytes.
const MAX_MESSAGE: usize = 32 << 20;
/// Bytes kept of a message whose payload is not requested: everything before the payload.
const MAX_HEAD: usize = 8192;
/// Number of publications of one source after which it is considered the sender.
const MIN_PUBLICATIONS_OF_SENDER: u32 = 3;

/// Number of a direction of a transport, never reused.
pub(super) type DirectionNumber = u64;
/// Aliases by direction and number.
pub(super) type Aliases = ByOwner<ZenohAliases, DirectionNumber, u16, Alias>;

/// A key with its meaning.
#[derive(Clone, Debug)]
pub(super) struct Alias {
    pub(super) key: Arc<str>,
    pub(super) channel: Channel,
}

/// The samples with a key.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Channel {
    /// Messages of a topic or service of ROS.
    Messages,
    /// References to buffers for the subscription with this gid.
    References(Gid),
    /// Samples that do not belong to a topic.
    Other,
}

/// A message of which some FRAGMENTs have arrived.
#[derive(Debug)]
pub(super) struct Chain {
    lane: Lane,
    /// Number of the last FRAGMENT.
    number: u32,
    /// Time of the first FRAGMENT.
    pub(super) began: ModelTime,
    /// Time of the last FRAGMENT.
    last: ModelTime,
    /// The beginning of the message, or all of it.
    pub(super) bytes: Vec<u8>,
    /// Bytes that have arrived.
    pub(super) length: usize,
    is_wanted: bool,
}

/// One direction of a connection.
#[derive(Debug, Default)]
pub(super) struct StreamState {
    pub(super) number: DirectionNumber,
    /// Whether the INITs of both ends were seen.
    pub(super) is_begun: bool,
    /// Whether another connection of the transport has the same number, or had it.
    pub(super) is_shared: bool,
    /// The sender, from its INIT.
    pub(super) sender: Option<Side>,
    /// The session of the process that sends, if the INIT was missed.
    pub(super) linked: Option<ZenohId>,
    /// Source of all publications so far, and their number, if the INIT was missed.
    presumed: Option<(ZenohId, u32)>,
    is_ambiguous: bool,
    /// Whether the ports suggest a router, which forwards publications of others.
    may_be_router: bool,
    /// Whether the sender is a router, if the INIT was missed and its id is unknown.
    pub(super) is_router: bool,
    /// Whether a router holds the receiving socket.
    pub(super) is_for_router: bool,
    /// The receiving router, if its id is known.
    pub(super) receiver: Option<Side>,
    /// Number and domain of the sender's last INTEREST in the graph of a domain.
    pub(super) requested_interest: Option<(u32, DomainId)>,
    pub(super) lease: Option<Duration>,
    pub(super) chains: Bounded<ZenohChains, Vec<Chain>>,
    /// Whether the sender has sent CLOSE, or closed the connection.
    pub(super) has_left: bool,
    /// Whether the sender has closed the connection.
    pub(super) has_ended: bool,
    /// Time of the last batch.
    pub(super) last_seen: ModelTime,
}

impl Chain {
    /// Returns the bytes that it holds.
    pub(super) fn held(&self) -> usize {
        // The destructuring makes a new list fail to compile until it is listed here.
        let Self {
            lane: _,
            number: _,
            began: _,
            last: _,
            bytes,
            length: _,
            is_wanted: _,
        } = self;
        bytes.capacity()
    }
}

impl Chain {
    /// Adds bytes to the message, as far as `room` bytes of further memory suffice.
    fn append(&mut self, bytes: &[u8], room: usize) {
        let (length, capacity) = (self.bytes.len(), self.bytes.capacity());
        let bytes = bytes.get(..capacity - length + room).unwrap_or(bytes);
        let needed = length + bytes.len();
        if needed > capacity {
            let larger = needed.max(2 * capacity).min(capacity + room);
            self.bytes.reserve_exact(larger - length);
        }
        self.bytes.extend_from_slice(bytes);
    }
}

impl HeapBytes for Alias {
    fn heap_bytes(&self) -> usize {
        self.key.heap_bytes()
    }
}

impl Alias {
    fn new(key: &str) -> Self {
        let channel = match Key::parse(key) {
            Ok(Key::Topic(topic)) => match topic.buffer {
                Some(Buffer::Subscriber(gid)) => Channel::References(gid),
                Some(Buffer::Cpu) | None => Channel::Messages,
            },
            _ => Channel::Other,
        };
        Self {
            key: key.into(),
            channel,
        }
    }
}

impl StreamState {
    /// Creates the state of a new direction; `sender` is from saved state.
    pub(super) fn new(number: DirectionNumber, stream: &StreamId, sender: Option<Side>) -> Self {
        let (from, to) = (stream.flow.source.port, stream.flow.destination.port);
        Self {
            number,
            sender,
            may_be_router: from == PORT || to == PORT && !stream.is_loopback(),
            ..Self::default()
        }
    }

    /// Returns the session that sends, as far as is known.
    pub(super) fn session(&self) -> Option<ZenohId> {
        let presumed = self
            .presumed
            .filter(|(_, count)| *count >= MIN_PUBLICATIONS_OF_SENDER);
        let is_certain = !self.is_ambiguous && !self.may_be_router && !self.is_router;
        let presumed = presumed.filter(|_| is_certain);
        self.sender
            .map(|side| side.zid)
            .or(self.linked)
            .or(presumed.map(|(zid, _)| zid))
    }

    /// Returns whether the sender is a router, as far as the direction shows.
    pub(super) fn is_of_router(&self, stream: &StreamId) -> bool {
        match (self.sender, self.linked) {
            (Some(side), _) => side.whatami == WhatAmI::Router,
            (None, Some(_)) => false,
            (None, None) => self.is_router || self.is_ambiguous || stream.flow.source.port == PORT,
        }
    }

    /// Returns the source of the first publication, if the INIT was missed.
    pub(super) fn source(&self) -> Option<ZenohId> {
        self.presumed.map(|(source, _)| source)
    }

    /// Returns whether no publication of another session was seen.
    pub(super) fn sends_only_for(&self, session: ZenohId) -> bool {
        !self.is_ambiguous && self.presumed.is_none_or(|(zid, _)| zid == session)
    }

    /// Returns the session that owns the socket at which the direction was seen, if it sends there
    /// and its process is on this host.
    pub(super) fn owner(&self, stream: &StreamId) -> Option<ZenohId> {
        if stream.socket == 0 || !stream.outgoing {
            return None;
        }
        // A router that forwards publications of one session looks like that session. It sends from
        // its port to the sessions of its host, and to other hosts.
        let is_certain = self.sender.is_some()
            || self.linked.is_some()
            || stream.is_loopback() && stream.flow.source.port != PORT;
        self.session().filter(|_| is_certain)
    }

    /// Records the source of a publication. A sender of publications from several sources is a
    /// router.
    pub(super) fn note_source(&mut self, source: ZenohId) {
        match &mut self.presumed {
            Some((known, count)) if *known == source => *count = count.saturating_add(1),
            Some(_) => self.is_ambiguous = true,
            None => self.presumed = Some((source, 1)),
        }
    }

    /// Adds a FRAGMENT. Returns the message if it is complete; its bytes may be only the beginning.
    pub(super) fn fragment(
        &mut self,
        fragment: &Fragment<'_>,
        time: ModelTime,
        begins: impl FnOnce(&[u8]) -> Option<bool>,
        room: usize,
    ) -> Option<Chain> {
        let place = self
            .chains
            .iter()
            .position(|chain| chain.lane == fragment.lane);
        let number = fragment.sequence_number;
        let known = place.map(|place| self.chains.swap_remove(place));
        if fragment.is_dropped {
            return None;
        }
        let known = known.filter(|known| !fragment.is_first && is_followed(known.number, number));
        let mut chain = match known {
            Some(chain) => chain,
            None => {
                let is_wanted = begins(fragment.bytes.captured)?;
                Chain {
                    lane: fragment.lane,
                    number,
                    began: time,
                    last: time,
                    bytes: Vec::new(),
                    length: 0,
                    is_wanted,
                }
            }
        };
        let captured = fragment.bytes.captured;
        let is_whole_so_far = chain.bytes.len() == chain.length;
        chain.length += fragment.bytes.length;
        let most = if chain.is_wanted {
            MAX_MESSAGE
        } else {
            MAX_HEAD
        };
        if is_whole_so_far {
            let kept = most.saturating_sub(chain.bytes.len());
            chain.append(captured.get(..kept).unwrap_or(captured), room);
        }
        chain.last = time;
        chain.number = number;
        if !fragment.has_more {
            return Some(chain);
        }
        self.chains.push(chain);
        None
    }

    /// Gives up messages without a FRAGMENT since `before`, and returns their number.
    pub(super) fn drop_message(&mut self, before: ModelTime) -> usize {
        let all = self.chains.len();
        self.chains.retain(|chain| chain.last >= before);
        all - self.chains.len()
    }

    /// Drops the unfinished messages, because bytes are missing.
    pub(super) fn interrupt(&mut self) {
        self.chains.clear();
    }

    /// Returns the bytes of unfinished messages.
    pub(super) fn held(&self) -> usize {
        self.chains.iter().map(Chain::held).sum()
    }
}

/// Returns whether the number `next` follows `number`. The INIT with the agreed size of numbers may
/// have been missed, so zero follows the highest number of any size.
fn is_followed(number: u32, next: u32) -> bool {
    let mut sizes = (0..4).map(Resolution);
    let is_highest = |size: Resolution| size.sequence_number_mask() == number;
    number.wrapping_add(1) == next || next == 0 && sizes.any(is_highest)
}

/// Returns the key of an expression, through its alias if it has one.
pub(super) fn resolve(
    expression: WireExpr<'_>,
    aliases: &Aliases,
    direction: Option<DirectionNumber>,
) -> Option<Alias> {
    if let Some(key) = expression.key() {
        return (key.len() <= MAX_KEY).then(|| Alias::new(key));
    }
    let alias = aliases.get(direction?, &expression.scope)?;
    if expression.suffix.is_empty() {
        return Some(alias.clone());
    }
    if alias.key.len() + expression.suffix.len() > MAX_KEY {
        return None;
    }
    Some(Alias::new(&format!("{}{}", alias.key, expression.suffix)))
}
