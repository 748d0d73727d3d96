//! The conversation with a router: INIT, OPEN, one INTEREST, its answer, CLOSE.
//!
//! A state machine without socket and clock: batches in, batches out. Everything in a batch is
//! hostile, so tokens, bytes and fragments have caps.

use std::collections::BTreeMap;

use ros2probe_wire::zenoh::{
    Batch, Close, Declaration, Declare, Fragment, Init, Lane, Mapping, Message, NetworkMessage,
    Resolution, VERSION, WireExpr, ZenohId,
};
use ros2probe_wire::{DomainId, WireError};

use super::graph::{DomainGraph, Tokens};
use super::message;

/// Maximum size of a router's answers, in bytes, with aliases written out.
pub const MOST_BYTES: usize = 16 << 20;
/// Maximum size of one message in FRAGMENTs, in bytes. A declaration has a key of at most 64 KiB.
pub const MOST_MESSAGE_BYTES: usize = 128 << 10;

/// A batch to send.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Purpose, for people.
    pub what: &'static str,
    /// Bytes with the length in front.
    pub bytes: Vec<u8>,
}

/// Why an answer cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unusable {
    /// A TLS record.
    #[error("it expects TLS")]
    Tls,
    /// Anything but Zenoh.
    #[error("it does not speak Zenoh")]
    NotZenoh,
    /// Zenoh with another wire format.
    #[error("it speaks version {0} of Zenoh's wire format, not {VERSION}")]
    Version(u8),
    /// The router refuses or ends the session, with this reason.
    #[error("it ended the session: {}", reason(*.0))]
    Closed(u8),
    /// The router accepted a feature that was not offered.
    #[error("it compresses batches or sends no frames, which was not offered")]
    Framing,
    /// A message cannot be read.
    #[error("its answer is malformed ({0})")]
    Malformed(#[from] WireError),
    /// Messages in the wrong order, or a missing fragment.
    #[error("its answer is malformed ({0})")]
    Unexpected(&'static str),
}

/// Returns the text of the reason of a CLOSE (`zenoh-protocol`, `transport/close.rs`).
const fn reason(reason: u8) -> &'static str {
    match reason {
        0 => "no reason given",
        1 => "unsupported",
        2 => "invalid message",
        3 => "too many sessions",
        4 => "too many links",
        5 => "expired",
        6 => "unresponsive",
        7 => "connection to itself",
        _ => "unknown reason",
    }
}

/// Progress of a conversation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// The introduction is sent.
    Introduction,
    /// The opening is sent.
    Opening,
    /// The request is sent.
    Request,
    /// All tokens have arrived.
    Complete,
    /// A cap is reached, so the graph is incomplete.
    Full,
}

/// One conversation.
#[derive(Debug)]
pub struct Session {
    step: Step,
    key: String,
    router: Option<ZenohId>,
    resolution: Resolution,
    has_priorities: bool,
    aliases: BTreeMap<u16, Box<str>>,
    chains: BTreeMap<Lane, Chain>,
    tokens: Tokens,
    /// Number of bytes left below the cap.
    bytes_left: usize,
}

/// The FRAGMENTs of a message.
#[derive(Debug)]
struct Chain {
    last: u32,
    bytes: Vec<u8>,
}

impl Session {
    /// Creates a session for the tokens of one domain, or of all. The introduction is sent first.
    #[must_use]
    pub fn new(domain_id: Option<u32>) -> Self {
        Self {
            step: Step::Introduction,
            key: key(domain_id),
            router: None,
            resolution: Resolution::DEFAULT,
            has_priorities: false,
            aliases: BTreeMap::new(),
            chains: BTreeMap::new(),
            tokens: Tokens::default(),
            bytes_left: MOST_BYTES,
        }
    }

    /// Checks the first bytes of the stream, which may be less than a batch.
    ///
    /// # Errors
    ///
    /// Fails if the bytes cannot be the beginning of an answer.
    pub fn beginning(&self, stream: &[u8]) -> Result<(), Unusable> {
        if self.step != Step::Introduction {
            return Ok(());
        }
        match stream {
            // Records of kind alert or handshake, of SSL 3.0 to TLS 1.3 (RFC 8446, 5.1).
            [0x15 | 0x16, 0x03, 0..=4, ..] => Err(Unusable::Tls),
            // The acknowledgement of INIT, or CLOSE.
            [_, _, header, ..] if !matches!(header & 0x3f, 0x21 | 0x03 | 0x23) => {
                Err(Unusable::NotZenoh)
            }
            _ => Ok(()),
        }
    }

    /// Processes a batch. Returns what to send next.
    ///
    /// # Errors
    ///
    /// Fails if the batch cannot be used. The conversation is then over.
    pub fn receive(&mut self, batch: &[u8]) -> Result<Vec<Outgoing>, Unusable> {
        let mut outgoing = Vec::new();
        if !self.take_bytes(batch.len()) {
            return Ok(outgoing);
        }
        for message in Batch::whole(batch) {
            if self.is_over() {
                break;
            }
            match message? {
                Message::Init(init) => outgoing.push(self.opening(&init)?),
                Message::Open(open) if open.is_ack && self.step == Step::Opening => {
                    self.step = Step::Request;
                    outgoing.push(self.request());
                }
                Message::Open(_) => return Err(Unusable::Unexpected("OPEN")),
                Message::Close(Close { reason, .. }) => return Err(Unusable::Closed(reason)),
                Message::Network(message) => self.network_message(&message)?,
                Message::Fragment(fragment) => self.fragment(&fragment)?,
                Message::Oam(_) | Message::KeepAlive | Message::Frame(_) | Message::Join(_) => {}
            }
        }
        Ok(outgoing)
    }

    /// Returns the progress.
    #[must_use]
    pub const fn step(&self) -> Step {
        self.step
    }

    /// Returns whether nothing more is expected.
    #[must_use]
    pub const fn is_over(&self) -> bool {
        matches!(self.step, Step::Complete | Step::Full)
    }

    /// Returns the id of the router, once it has introduced itself.
    #[must_use]
    pub const fn router(&self) -> Option<ZenohId> {
        self.router
    }

    /// Returns the graph of each domain.
    #[must_use]
    pub fn graphs(&self) -> BTreeMap<DomainId, DomainGraph> {
        self.tokens.graphs()
    }

    /// Returns the number of tokens of unknown form.
    #[must_use]
    pub const fn unreadable(&self) -> usize {
        self.tokens.unreadable()
    }

    fn opening(&mut self, init: &Init<'_>) -> Result<Outgoing, Unusable> {
        if self.step != Step::Introduction || !init.is_ack {
            return Err(Unusable::Unexpected("INIT"));
        }
        if init.version != VERSION {
            return Err(Unusable::Version(init.version));
        }
        if init.features.compression || init.features.low_latency {
            return Err(Unusable::Framing);
        }
        let what = "opening (OPEN)";
        let bytes = message::opening(init.cookie);
        if bytes.len() > usize::from(u16::MAX) {
            return Err(Unusable::Unexpected("cookie"));
        }
        self.router = Some(init.zid);
        self.resolution = init.resolution;
        self.has_priorities = init.features.qos;
        self.step = Step::Opening;
        Ok(Outgoing { what, bytes })
    }

    fn request(&self) -> Outgoing {
        Outgoing {
            what: "request (INTEREST)",
            bytes: message::request(&self.key, self.has_priorities),
        }
    }

    fn fragment(&mut self, fragment: &Fragment<'_>) -> Result<(), Unusable> {
        let bytes = fragment.bytes.captured;
        let lane = fragment.lane;
        let mut chain = self.chains.remove(&lane);
        if fragment.is_dropped {
            return Ok(());
        }
        if fragment.is_first {
            chain = None;
        }
        let mut chain = match chain {
            Some(chain) if self.resolution.next(chain.last) != fragment.sequence_number => {
                return Err(Unusable::Unexpected("missing FRAGMENT"));
            }
            Some(chain) => chain,
            None => Chain {
                last: 0,
                bytes: Vec::new(),
            },
        };
        chain.last = fragment.sequence_number;
        if chain.bytes.len() + bytes.len() > MOST_MESSAGE_BYTES {
            self.step = Step::Full;
            return Ok(());
        }
        chain.bytes.extend_from_slice(bytes);
        if fragment.has_more {
            self.chains.insert(lane, chain);
            return Ok(());
        }
        self.network_message(&NetworkMessage::whole(&chain.bytes)?)
    }

    fn network_message(&mut self, message: &NetworkMessage<'_>) -> Result<(), Unusable> {
        if self.step != Step::Request {
            return Err(Unusable::Unexpected("declaration before OPEN"));
        }
        let NetworkMessage::Declare(Declare {
            interest,
            declaration,
            ..
        }) = message
        else {
            return Ok(());
        };
        match declaration {
            Declaration::KeyExpr { id, key } => {
                if let Some(key) = self.resolve(key) {
                    self.aliases.insert(*id, key.into());
                }
            }
            Declaration::UndeclareKeyExpr { id } => drop(self.aliases.remove(id)),
            Declaration::Token { key, .. } => match self.resolve(key) {
                Some(token) => {
                    if !self.tokens.add(&token) {
                        self.step = Step::Full;
                    }
                }
                None => self.tokens.skip(),
            },
            Declaration::Final if *interest == Some(message::INTEREST.into()) => {
                self.step = Step::Complete;
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the key of an expression; `None` if its alias is unknown, or if the cap is reached.
    fn resolve(&mut self, expression: &WireExpr<'_>) -> Option<String> {
        if let Some(key) = expression.key() {
            return Some(key.to_owned());
        }
        // This side declares no alias.
        if expression.mapping == Mapping::Receiver {
            return None;
        }
        let prefix = self.aliases.get(&expression.scope)?;
        let key = [prefix, expression.suffix].concat();
        self.take_bytes(key.len()).then_some(key)
    }

    /// Subtracts bytes from those left below the cap. Returns `false` if the cap is reached.
    fn take_bytes(&mut self, bytes: usize) -> bool {
        match self.bytes_left.checked_sub(bytes) {
            Some(room) => self.bytes_left = room,
            None => self.step = Step::Full,
        }
        self.step != Step::Full
    }
}

/// Returns the key expression of the tokens of one domain, or of all.
#[must_use]
pub fn key(domain_id: Option<u32>) -> String {
    match domain_id {
        Some(domain_id) => format!("@ros2_lv/{domain_id}/**"),
        None => "@ros2_lv/**".to_owned(),
    }
}
