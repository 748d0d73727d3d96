//! Searches for the boundary of a batch or frame, at the beginning of a connection or inside it.
//!
//! Segments of small messages begin with a batch. From the start of such a segment, bytes are
//! collected as long as they can be read as batches. The rules are those of the kernel programs
//! ([`ros2probe_wire::zenoh_stream`]).

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::rtps_tcp::{self, FrameHeader};
use ros2probe_wire::zenoh::{Batch, Lane, Message};
use ros2probe_wire::zenoh_stream::{Beginning, Lanes, message};

use crate::tables::SearchedBytes;

/// Assessment of the collected bytes.
pub enum Assessment {
    /// The bytes are batches, beginning with the first byte.
    Zenoh(Vec<u8>),
    /// The bytes are frames of RTPS, beginning with the first byte.
    Rtps(Vec<u8>),
    /// More bytes are needed.
    Undecided,
    /// A TLS handshake on a port of Zenoh.
    Tls,
    /// A client's TLS handshake on another port.
    ClientHello,
    /// Something else.
    Other,
}

/// Bytes collected from a position where a batch may begin.
#[derive(Debug, Default)]
pub struct Search {
    held: Bounded<SearchedBytes, Vec<u8>>,
}

impl Search {
    /// Returns the capacity for collected bytes, in bytes.
    pub fn held_bytes(&self) -> usize {
        self.held.capacity()
    }

    /// Adds the bytes of a segment. With `begins`, the first collected byte is the first of the
    /// connection.
    pub fn add(&mut self, bytes: &[u8], length: usize, begins: bool, is_port: bool) -> Assessment {
        let was_empty = self.held.is_empty();
        let is_whole = bytes.len() >= length;
        if begins {
            // The first bytes suffice to recognize TLS, and the programs pass on no more of it.
            let looks = match self.held.extend_from_slice(bytes) {
                true => self.begin(is_port),
                false => Assessment::Other,
            };
            return self.after_search(match looks {
                Assessment::Zenoh(_) | Assessment::Rtps(_) | Assessment::Undecided if !is_whole => {
                    Assessment::Other
                }
                looks => looks,
            });
        }
        if !is_whole || !self.held.extend_from_slice(bytes) {
            // Without all bytes no boundary can be found.
            self.held.take();
            return Assessment::Undecided;
        }
        let looks = self.assess(is_port);
        if was_empty || !matches!(looks, Assessment::Other) {
            return self.after_search(looks);
        }
        // The collected bytes began within a batch: this segment may begin with one.
        self.held.take();
        self.held.extend_from_slice(bytes);
        let looks = self.assess(is_port);
        self.after_search(looks)
    }

    fn after_search(&mut self, looks: Assessment) -> Assessment {
        if matches!(looks, Assessment::Other) {
            self.held.take();
        }
        looks
    }

    /// Assesses the first bytes of a connection.
    fn begin(&mut self, is_port: bool) -> Assessment {
        if self.held.starts_with(&rtps_tcp::MAGIC) {
            return match self.held.first_chunk() {
                Some(head) if FrameHeader::recognize(*head).is_some() => {
                    Assessment::Rtps(self.held.take())
                }
                Some(_) => Assessment::Other,
                None => Assessment::Undecided,
            };
        }
        let Some(head) = self.held.first_chunk() else {
            return match self.held.get(2) {
                Some(header) if header & message::ID != message::INIT => Assessment::Other,
                _ => Assessment::Undecided,
            };
        };
        // The rest of an INIT may be in later segments.
        match Beginning::of(*head, u32::MAX, is_port) {
            Beginning::Init | Beginning::OtherVersion => Assessment::Zenoh(self.held.take()),
            Beginning::Tls => Assessment::Tls,
            Beginning::ClientHello => Assessment::ClientHello,
            _ => Assessment::Other,
        }
    }

    fn assess(&mut self, is_port: bool) -> Assessment {
        let mut rest = &self.held[..];
        let beginning = match (rest.first_chunk(), rest.as_array()) {
            (Some(head), _) => Beginning::of(
                *head,
                u32::try_from(rest.len()).unwrap_or(u32::MAX),
                is_port,
            ),
            (None, Some(three)) => Beginning::of_three(*three),
            (None, None) => Beginning::Other,
        };
        if matches!(beginning, Beginning::Init | Beginning::KeepAlive) {
            return Assessment::Zenoh(self.held.take());
        }
        let mut lanes = Lanes::new();
        while rest.len() > 2 {
            let Some((batch, after)) = Batch::split(rest) else {
                return match may_be_batch(rest) {
                    true => Assessment::Undecided,
                    false => Assessment::Other,
                };
            };
            if !continues(&mut lanes, batch) {
                return Assessment::Other;
            }
            if lanes.are_certain() {
                return Assessment::Zenoh(self.held.take());
            }
            rest = after;
        }
        Assessment::Undecided
    }
}

/// Returns where the first frame of RTPS begins whose first bytes are in this segment.
pub fn frame(bytes: &[u8]) -> Option<usize> {
    let mut windows = bytes.array_windows::<{ rtps_tcp::RECOGNIZED }>();
    windows.position(|head| {
        head.starts_with(&rtps_tcp::MAGIC) && FrameHeader::recognize(*head).is_some()
    })
}

/// Returns whether this batch may follow the earlier ones.
fn continues(lanes: &mut Lanes, batch: &[u8]) -> bool {
    let mut is_empty = true;
    let mut follows = |lane: Lane, number| {
        let key = Lanes::key(lane.priority.0.into(), lane.is_reliable.into());
        lanes.continues(key, number)
    };
    for message in Batch::whole(batch) {
        is_empty = false;
        let is_plausible = match message {
            Err(_) => false,
            Ok(Message::Frame(frame)) => follows(frame.lane, frame.sequence_number),
            Ok(Message::Fragment(fragment)) => follows(fragment.lane, fragment.sequence_number),
            Ok(_) => true,
        };
        if !is_plausible {
            return false;
        }
    }
    if batch == [message::KEEP_ALIVE] {
        lanes.keep_alive();
    }
    !is_empty
}

/// Returns whether an unfinished batch may be one of Zenoh, by its first bytes.
fn may_be_batch(bytes: &[u8]) -> bool {
    let [low, high, header, ..] = bytes else {
        return true;
    };
    let is_empty = *low == 0 && *high == 0;
    !is_empty && matches!(header & message::ID, message::INIT..=message::FRAGMENT)
}
