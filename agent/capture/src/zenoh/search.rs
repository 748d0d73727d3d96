//! Searches for the boundary of a batch, at the beginning of a connection or inside it.
//!
//! Segments of small messages begin with a batch. From such a place on, bytes are collected as long
//! as they can be read as batches. Two messages that continue the numbers of a lane are proof. A
//! KEEP_ALIVE alone in its batch, or an INIT, needs no other one.

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::zenoh::{Batch, Lane, Message, Resolution, VERSION};

use crate::tables::SearchedBytes;

/// Messages of a lane that continue its numbers and so make a boundary certain.
const CERTAIN: u32 = 2;
/// Largest version that is another version of Zenoh rather than something else.
const PLAUSIBLE_VERSION: u8 = 0x3f;

/// What the bytes look like.
pub enum Looks {
    /// Batches, from the first of these bytes on.
    Zenoh(Vec<u8>),
    /// More bytes are needed.
    Undecided,
    /// Something else.
    Other,
}

/// Bytes from a place where a batch may begin.
#[derive(Debug, Default)]
pub struct Search {
    held: Bounded<SearchedBytes, Vec<u8>>,
}

impl Search {
    /// Returns the number of bytes collected.
    pub fn held(&self) -> usize {
        self.held.capacity()
    }

    /// Returns whether nothing is collected.
    pub fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Adds the bytes of a segment. If `begins`, the connection begins with the first of them all.
    pub fn add(&mut self, bytes: &[u8], length: usize, begins: bool) -> Looks {
        let was_empty = self.held.is_empty();
        if bytes.len() < length || !self.held.extend_from_slice(bytes) {
            // Without all bytes no boundary can be found.
            self.held.take();
            return if begins {
                Looks::Other
            } else {
                Looks::Undecided
            };
        }
        let looks = self.judge(begins);
        if begins || was_empty || !matches!(looks, Looks::Other) {
            return self.settled(looks);
        }
        // The collected bytes began within a batch: this segment may begin with one.
        self.held.take();
        self.held.extend_from_slice(bytes);
        let looks = self.judge(false);
        self.settled(looks)
    }

    fn settled(&mut self, looks: Looks) -> Looks {
        if matches!(looks, Looks::Other) {
            self.held.take();
        }
        looks
    }

    fn judge(&mut self, begins: bool) -> Looks {
        let mut rest = &self.held[..];
        let mut lanes = Lanes::default();
        let mut is_first = begins;
        while rest.len() > 2 {
            let Some((batch, after)) = Batch::split(rest) else {
                return match plausible_start(rest, is_first) {
                    true => Looks::Undecided,
                    false => Looks::Other,
                };
            };
            let plausible = match is_first {
                true => lanes.is_beginning(batch),
                false => lanes.continues(batch),
            };
            if !plausible {
                return Looks::Other;
            }
            if lanes.certain >= CERTAIN {
                return Looks::Zenoh(self.held.take());
            }
            (rest, is_first) = (after, false);
        }
        Looks::Undecided
    }
}

/// Numbers of the lanes in some batches.
#[derive(Default)]
struct Lanes {
    next: Vec<(Lane, u32)>,
    certain: u32,
}

impl Lanes {
    /// Returns whether a connection may begin with this batch, which is certain then.
    fn is_beginning(&mut self, batch: &[u8]) -> bool {
        self.certain = CERTAIN;
        let is_init = matches!(Batch::whole(batch).next(), Some(Ok(Message::Init(_))));
        // Another version may have another INIT.
        let is_other_version = matches!(batch, [header, version, ..] if header & 0x1f == 1
            && *version != VERSION
            && *version <= PLAUSIBLE_VERSION);
        is_init || is_other_version
    }

    /// Returns whether this batch may follow those before.
    fn continues(&mut self, batch: &[u8]) -> bool {
        let mut is_empty = true;
        for message in Batch::whole(batch) {
            is_empty = false;
            let (lane, number) = match message {
                Err(_) => return false,
                Ok(Message::Init(init)) if init.version == VERSION => {
                    self.certain = CERTAIN;
                    continue;
                }
                Ok(Message::KeepAlive) if batch.len() == 1 => {
                    self.certain = CERTAIN;
                    continue;
                }
                Ok(Message::Frame(frame)) => (frame.lane, frame.sequence_number),
                Ok(Message::Fragment(fragment)) => (fragment.lane, fragment.sequence_number),
                Ok(_) => continue,
            };
            let following = Resolution::DEFAULT.next(number);
            match self.next.iter_mut().find(|(other, _)| *other == lane) {
                Some((_, expected)) if follows(*expected, number) => {
                    *expected = following;
                    self.certain += 1;
                }
                Some(_) => return false,
                None => self.next.push((lane, following)),
            }
        }
        !is_empty
    }
}

/// Returns whether a lane may use these numbers. One number is left out after fragments.
fn follows(expected: u32, number: u32) -> bool {
    number == expected || number == Resolution::DEFAULT.next(expected)
}

/// Returns whether a segment begins as TLS does: a record with a handshake.
pub fn begins_tls(bytes: &[u8]) -> bool {
    matches!(bytes, [0x16, 0x03, 0..=4, ..])
}

/// Returns whether an unfinished batch may be one of Zenoh, by its first bytes.
fn plausible_start(bytes: &[u8], begins: bool) -> bool {
    let [low, high, header, rest @ ..] = bytes else {
        return true;
    };
    let is_empty = *low == 0 && *high == 0;
    let is_known = match header & 0x1f {
        _ if begins => header & 0x1f == 1 && rest.first().is_none_or(|it| *it <= PLAUSIBLE_VERSION),
        1..=6 => true,
        _ => false,
    };
    !is_empty && is_known
}
