//! A batch: consecutive transport messages, and the network messages of its `FRAME`s
//! (`zenoh-protocol`, `transport/`).

use crate::cursor::{Reason, WireError};
use crate::zenoh_stream::message;

use super::extension::Extensions;
use super::network::{NetworkMessage, Oam};
use super::reader::{Bytes, Reader};
use super::session::{Init, Join, Open};

/// Priority of a lane or message: 0 is the most urgent.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Priority(pub u8);

impl Priority {
    /// Priority of declarations.
    pub const CONTROL: Self = Self(0);
    /// Priority of data without another priority, such as all topics of ROS.
    pub const DATA: Self = Self(5);
    /// Number of priorities.
    pub const COUNT: usize = 8;

    pub(super) const fn of(qos: u64) -> Self {
        Self(qos.to_le_bytes()[0] & 0x07)
    }
}

/// A sequence of `FRAME`s and FRAGMENTs in one direction of a session. Each lane counts its own
/// sequence numbers, all from the OPEN's initial one.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Lane {
    /// Priority of all messages of the lane.
    pub priority: Priority,
    /// Whether the lane is the reliable one of the priority.
    pub is_reliable: bool,
}

/// Header of a FRAME; its network messages follow as messages of the batch.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Frame {
    /// The lane.
    pub lane: Lane,
    /// Sequence number in the lane.
    pub sequence_number: u32,
}

/// A part of one network message that is longer than a batch.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Fragment<'a> {
    /// The lane.
    pub lane: Lane,
    /// Sequence number in the lane; the parts of a message have consecutive numbers. The sender
    /// skips the number after the last part (all captures of Zenoh 1.8).
    pub sequence_number: u32,
    /// Whether another part follows.
    pub has_more: bool,
    /// Whether the part is marked as the first: only if both sides have [`Init::patch`] 1.
    pub is_first: bool,
    /// Whether the sender gave up the message: only if both sides have [`Init::patch`] 1.
    pub is_dropped: bool,
    /// Bytes of the part. [`NetworkMessage::beginning`] reads the first part,
    /// [`NetworkMessage::whole`] all parts together.
    pub bytes: Bytes<'a>,
}

/// The end of a link or session.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Close {
    /// Whether the session ends, not only this link.
    pub is_session: bool,
    /// Number of the reason; 0 for an ordinary end.
    pub reason: u8,
}

/// A transport message, or a network message of the FRAME before it.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Message<'a> {
    /// Operation, administration and maintenance of the transport.
    Oam(Oam<'a>),
    /// One of the first two messages of a session.
    Init(Init<'a>),
    /// One of the third and fourth messages of a session.
    Open(Open),
    /// The end of a link or session.
    Close(Close),
    /// The sender is alive.
    KeepAlive,
    /// The network messages that follow belong to this FRAME.
    Frame(Frame),
    /// A network message of the last FRAME.
    Network(NetworkMessage<'a>),
    /// A part of a network message.
    Fragment(Fragment<'a>),
    /// The sender is a member of a multicast group.
    Join(Join),
}

/// The messages of one batch. The iterator ends after the first error.
///
/// If the capture lacks the end of the batch, the iterator yields the complete messages, then an
/// error with [`Reason::Truncated`]. The payload of a message may lack its end, see [`Bytes`].
#[derive(Clone, Debug)]
pub struct Batch<'a> {
    reader: Reader<'a>,
    in_frame: bool,
    has_failed: bool,
}

impl<'a> Batch<'a> {
    /// Reads a batch, which had `length` bytes on the wire, from its captured beginning. The
    /// length prefix of a stream is not part of the batch.
    #[must_use]
    pub const fn new(captured: &'a [u8], length: usize) -> Self {
        Self {
            reader: Reader::new(captured, length),
            in_frame: false,
            has_failed: false,
        }
    }

    /// Reads a batch that was captured as a whole.
    #[must_use]
    pub const fn whole(bytes: &'a [u8]) -> Self {
        Self::new(bytes, bytes.len())
    }

    /// Splits the first batch off a stream, whose batches have a length prefix of two bytes.
    /// Returns the batch and the rest of the stream; `None` if the stream ends within the batch.
    #[must_use]
    pub fn split(stream: &'a [u8]) -> Option<(&'a [u8], &'a [u8])> {
        let (length, rest) = stream.split_first_chunk()?;
        rest.split_at_checked(usize::from(u16::from_le_bytes(*length)))
    }

    /// Returns how many bytes were read.
    #[must_use]
    pub const fn offset(&self) -> usize {
        self.reader.offset()
    }

    fn read(&mut self) -> Result<Message<'a>, WireError> {
        let reader = &mut self.reader;
        if self.in_frame
            && let Some(header) = reader.peek()
            && NetworkMessage::has(header)
        {
            return Ok(Message::Network(NetworkMessage::read(reader)?));
        }
        let start = *reader;
        let header = reader.u8("transport message")?;
        self.in_frame = header & message::ID == message::FRAME;
        Ok(match header & message::ID {
            message::OAM => Message::Oam(Oam::read(header, reader)?),
            message::INIT => Message::Init(Init::read(header, reader)?),
            message::OPEN => Message::Open(Open::read(header, reader)?),
            message::CLOSE => Message::Close(close(header, reader)?),
            message::KEEP_ALIVE => {
                Extensions::of(header).skip_all(reader)?;
                Message::KeepAlive
            }
            message::FRAME => Message::Frame(frame(header, reader)?),
            message::FRAGMENT => Message::Fragment(fragment(header, reader)?),
            message::JOIN => Message::Join(Join::read(header, reader)?),
            _ => return Err(start.error("transport message", Reason::BadMarker)),
        })
    }
}

impl<'a> Iterator for Batch<'a> {
    type Item = Result<Message<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.has_failed || self.reader.is_at_end() {
            return None;
        }
        let message = self.read();
        self.has_failed = message.is_err();
        Some(message)
    }
}

fn close(header: u8, reader: &mut Reader<'_>) -> Result<Close, WireError> {
    let reason = reader.u8("reason of a CLOSE")?;
    Extensions::of(header).skip_all(reader)?;
    Ok(Close {
        is_session: header & 0x20 != 0,
        reason,
    })
}

const fn lane(header: u8) -> Lane {
    Lane {
        priority: Priority::DATA,
        is_reliable: header & 0x20 != 0,
    }
}

fn frame(header: u8, reader: &mut Reader<'_>) -> Result<Frame, WireError> {
    let mut frame = Frame {
        lane: lane(header),
        sequence_number: reader.number("sequence number of a FRAME")?,
    };
    let mut extensions = Extensions::of(header);
    while let Some(extension) = extensions.next(reader)? {
        match extension.id {
            0x31 => frame.lane.priority = Priority::of(extension.number),
            _ => extension.skip()?,
        }
    }
    Ok(frame)
}

fn fragment<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Fragment<'a>, WireError> {
    let mut fragment = Fragment {
        lane: lane(header),
        sequence_number: reader.number("sequence number of a FRAGMENT")?,
        has_more: header & 0x40 != 0,
        is_first: false,
        is_dropped: false,
        bytes: Bytes::default(),
    };
    let mut extensions = Extensions::of(header);
    while let Some(extension) = extensions.next(reader)? {
        match extension.id {
            0x31 => fragment.lane.priority = Priority::of(extension.number),
            0x02 => fragment.is_first = true,
            0x03 => fragment.is_dropped = true,
            _ => extension.skip()?,
        }
    }
    let length = reader.rest().length;
    fragment.bytes = reader.split("FRAGMENT", length)?.rest();
    Ok(fragment)
}
