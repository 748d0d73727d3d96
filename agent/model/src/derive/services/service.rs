//! The calls of one service: each request counts once, and the first reply that reaches the client
//! ends the call.

use std::collections::BTreeMap;
use std::time::Duration;

use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber};

use super::latency::Latencies;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, Sample};
use crate::facts::tables::{ReplyRuns, ServiceClients};

/// Number of request numbers that are remembered per client, to recognise late duplicates.
const WINDOW: u64 = 64;
/// A number further ahead does not move a client's highest number, since it may be forged.
const MAX_SEQUENCE_JUMP: u64 = 1 << 20;
/// Time after which an unanswered call is no longer followed.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(600);

/// Identity of a call, which request and reply share.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CallId {
    /// Fast DDS: GUID of the client's reader for replies. Cyclone DDS: the client id.
    pub client: [u8; 16],
    /// Number of the request.
    pub number: SequenceNumber,
}

/// Where and when a request or reply was seen.
#[derive(Clone, Copy, Debug)]
pub struct Capture {
    /// Time.
    pub at: ModelTime,
    /// Cookie of the socket; 0 = not seen at a socket.
    pub socket: u64,
    /// Position relative to this host's sockets.
    pub position: Position,
    /// Participant that receives there, if known.
    pub receiver: Option<GuidPrefix>,
}

/// Position of a sighting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Position {
    /// On a wire, in a capture, or in the sender's memory.
    Elsewhere,
    /// At the socket that sends it.
    Leaving,
    /// At the socket that receives it.
    Arriving,
    /// At a socket whose full buffer drops it.
    Dropped,
}

/// A service.
#[derive(Debug, Default)]
pub struct Service {
    clients: Bounded<ServiceClients, BTreeMap<[u8; 16], Client>>,
    calls: BTreeMap<CallId, Call>,
    /// Requests, each counted once.
    pub requests: u64,
    /// Requests with a reply.
    pub answered: u64,
    /// Requests without a reply within the timeout; some of them may have been answered later.
    pub unanswered: u64,
    /// Times from request to reply.
    pub latencies: Latencies,
    /// End of the time in which requests are not followed, because one of its writers is not
    /// captured.
    pub suspended: Option<ModelTime>,
    /// Time of the last request.
    pub last_request: ModelTime,
    /// Whether some of its messages were read in their senders' memory.
    pub is_exact: bool,
}

/// A call that has ended.
#[derive(Clone, Copy, Debug)]
pub struct Answered {
    /// Time of the request.
    pub sent: ModelTime,
    /// Writer of the request.
    pub client: Guid,
    /// Goal that the request names.
    pub goal: Option<[u8; 16]>,
    /// Whether it was reported as hanging.
    pub was_hanging: bool,
}

/// A call without a reply so far.
#[derive(Debug)]
struct Call {
    /// Writer of the request.
    writer: Guid,
    sent: ModelTime,
    /// Whether the request was seen leaving a socket of this host, so the reply must arrive at one.
    is_local: bool,
    is_hanging: bool,
    goal: Option<[u8; 16]>,
    /// Time and socket at which a copy of the reply was dropped.
    dropped: Option<(ModelTime, u64)>,
    received: Received,
}

/// Fragments of a reply that arrived.
#[derive(Debug, Default)]
struct Received {
    /// Writer and number of the reply.
    reply: Option<(Guid, SequenceNumber)>,
    /// Sorted half-open ranges of fragment numbers.
    runs: Bounded<ReplyRuns, Vec<(u32, u32)>>,
}

/// Request numbers of a client that were seen.
#[derive(Debug, Default)]
struct Client {
    highest: u64,
    /// Bit n: the number `highest - n` was seen.
    seen: u64,
    last: ModelTime,
}

impl Service {
    /// Records a request. Returns whether it is the first copy of a new one.
    pub fn request(
        &mut self,
        id: CallId,
        writer: Guid,
        sighting: Capture,
        goal: Option<[u8; 16]>,
    ) -> bool {
        let is_local = sighting.position == Position::Leaving;
        if let Some(call) = self.calls.get_mut(&id) {
            call.sent = call.sent.min(sighting.at);
            call.is_local |= is_local;
            return false;
        }
        if sighting.position == Position::Dropped
            || self.suspended.is_some_and(|until| sighting.at < until)
            || !self.is_new(id, sighting.at)
        {
            return false;
        }
        self.requests += 1;
        self.last_request = sighting.at;
        let call = Call {
            writer,
            sent: sighting.at,
            is_local,
            is_hanging: false,
            goal,
            dropped: None,
            received: Received::default(),
        };
        self.calls.insert(id, call);
        true
    }

    /// Records a reply. Returns the call if the reply is whole and has reached its client, as far
    /// as that is visible.
    pub fn reply(
        &mut self,
        id: CallId,
        writer: Guid,
        sample: &Sample,
        sighting: Capture,
    ) -> Option<Answered> {
        let call = self.calls.get_mut(&id)?;
        match sighting.position {
            Position::Dropped => {
                call.dropped = Some((sighting.at, sighting.socket));
                return None;
            }
            Position::Leaving if call.is_local => return None,
            Position::Arriving if call.is_local => {
                let client = call.writer.prefix;
                let is_other = sighting.receiver.is_some_and(|it| it != client);
                if is_other || call.dropped == Some((sighting.at, sighting.socket)) {
                    return None;
                }
            }
            Position::Leaving | Position::Arriving | Position::Elsewhere => {}
        }
        if !call.received.put(writer, sample) {
            return None;
        }
        let call = self.calls.remove(&id)?;
        self.answered += 1;
        self.latencies.observe(sighting.at - call.sent);
        Some(Answered {
            sent: call.sent,
            client: call.writer,
            goal: call.goal,
            was_hanging: call.is_hanging,
        })
    }

    /// Marks calls without a reply for `timeout` as hanging; drops very old ones. Returns whether
    /// that changes the hanging calls.
    pub fn advance(&mut self, timeout: Duration, now: ModelTime) -> bool {
        let mut changed = false;
        let unanswered = &mut self.unanswered;
        self.calls.retain(|_, call| {
            if !call.is_hanging && call.sent + timeout <= now {
                (call.is_hanging, changed) = (true, true);
                *unanswered += 1;
            }
            let is_kept = call.sent + timeout.max(FORGOTTEN_AFTER) > now;
            changed |= !is_kept;
            is_kept
        });
        changed
    }

    /// Drops the calls of a client that is gone. Returns whether one of them was hanging.
    pub fn forget_client(&mut self, writer: Guid) -> bool {
        let before = self.hanging();
        self.calls.retain(|_, call| call.writer != writer);
        before != self.hanging()
    }

    /// Drops all calls: their replies may be missed. Returns whether one of them was hanging.
    pub fn forget_calls(&mut self) -> bool {
        let was_hanging = self.hanging() > 0;
        self.calls.clear();
        was_hanging
    }

    /// Drops the oldest call of one client, because the search for the oldest call of all is too
    /// expensive in a flood of requests. Returns whether there was a call.
    pub fn drop_oldest_call(&mut self) -> bool {
        self.calls.pop_first().is_some()
    }

    /// Returns the number of calls without a reply so far.
    #[must_use]
    pub fn open(&self) -> usize {
        self.calls.len()
    }

    /// Returns the number of calls without a reply for longer than the timeout.
    #[must_use]
    pub fn hanging(&self) -> usize {
        self.calls.values().filter(|call| call.is_hanging).count()
    }

    /// Returns the request writer of each hanging call.
    pub fn hanging_clients(&self) -> impl Iterator<Item = Guid> {
        let hanging = self.calls.values().filter(|call| call.is_hanging);
        hanging.map(|call| call.writer)
    }

    /// Returns whether the client has not sent this number before.
    fn is_new(&mut self, id: CallId, at: ModelTime) -> bool {
        self.clients.make_room(&id.client, |client| client.last);
        let client = self.clients.get_or_insert_with(id.client, Client::default);
        client.is_none_or(|client| {
            client.last = at;
            client.note(id.number.0)
        })
    }
}

impl Client {
    /// Returns whether the number is new, and remembers it.
    const fn note(&mut self, number: u64) -> bool {
        if self.seen == 0 {
            (self.highest, self.seen) = (number, 1);
            return true;
        }
        if number > self.highest {
            let ahead = number - self.highest;
            if ahead > MAX_SEQUENCE_JUMP {
                return true;
            }
            self.seen = if ahead >= WINDOW {
                0
            } else {
                self.seen << ahead
            };
            self.seen |= 1;
            self.highest = number;
            return true;
        }
        let behind = self.highest - number;
        if behind >= WINDOW || self.seen & (1 << behind) != 0 {
            return false;
        }
        self.seen |= 1 << behind;
        true
    }
}

impl Received {
    /// Adds a reply or some of its fragments. Returns whether the reply is complete.
    fn put(&mut self, writer: Guid, sample: &Sample) -> bool {
        let Content::DataFrag(fragments) = sample.content else {
            return true;
        };
        let of = Some((writer, sample.sequence_number));
        if self.reply != of {
            (self.reply, self.runs) = (of, Bounded::default());
        }
        let total = fragments.total();
        if total == 0 {
            return false;
        }
        let start = fragments.starting;
        let mut run = (start, start.saturating_add(fragments.count));
        self.runs.retain(|other| {
            let touches = other.0 <= run.1 && run.0 <= other.1;
            if touches {
                run = (other.0.min(run.0), other.1.max(run.1));
            }
            !touches
        });
        let place = self.runs.partition_point(|other| *other < run);
        self.runs.insert(place, run);
        matches!(self.runs.as_slice(), [(1, end)] if *end > total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_number_is_new_only_once_in_any_order() {
        let mut client = Client::default();
        let new = |client: &mut Client, numbers: &[u64]| -> Vec<bool> {
            numbers.iter().map(|number| client.note(*number)).collect()
        };
        assert_eq!(
            new(&mut client, &[5, 5, 7, 6, 6, 7]),
            [true, false, true, true, false, false]
        );
        assert_eq!(
            new(&mut client, &[100, 7, 37, 37]),
            [true, false, true, false]
        );
        // A forged number does not hide the following ones.
        assert_eq!(new(&mut client, &[u64::MAX, 101, 101]), [true, true, false]);
    }
}
