//! Network messages: publications, declarations, requests and interests (`zenoh-protocol`,
//! `network/`).

use crate::cursor::{Reason, WireError};

use super::batch::Priority;
use super::body::{self, Query, Sample};
use super::declare::Declaration;
use super::expression::WireExpr;
use super::extension::{Extension, Extensions};
use super::identity::{EntityGlobalId, HlcTimestamp};
use super::reader::{Bytes, Reader};

/// Quality of service of one message.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct MessageQos(pub u8);

impl MessageQos {
    /// Priority DATA; a congested sender drops the message rather than waiting.
    pub const DEFAULT: Self = Self(Priority::DATA.0);

    /// Returns the priority.
    #[must_use]
    pub const fn priority(self) -> Priority {
        Priority(self.0 & 0x07)
    }

    /// Returns whether a congested sender waits rather than dropping the message.
    #[must_use]
    pub const fn is_blocking(self) -> bool {
        self.0 & 0x08 != 0
    }

    /// Returns whether the message is sent without waiting for others to share its batch.
    #[must_use]
    pub const fn is_express(self) -> bool {
        self.0 & 0x10 != 0
    }
}

/// Extensions that most network messages have.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Common {
    /// Quality of service.
    pub qos: MessageQos,
    /// Time of a hybrid logical clock; rmw_zenoh sends it in the PUT instead.
    pub timestamp: Option<HlcTimestamp>,
    /// Node of the routing tree from which the message comes; 0 unless routers forward it.
    pub node: u16,
}

impl Common {
    const DEFAULT: Self = Self {
        qos: MessageQos::DEFAULT,
        timestamp: None,
        node: 0,
    };

    /// Applies an extension if it is a common one; returns whether it is.
    fn take(&mut self, extension: &Extension<'_>) -> Result<bool, WireError> {
        match extension.id {
            0x21 => {
                let [qos, ..] = extension.number.to_le_bytes();
                self.qos = MessageQos(qos);
            }
            0x42 => self.timestamp = Some(HlcTimestamp::extension(extension.value)?),
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Applies an extension if it is a common one or the node; returns whether it is.
    fn take_with_node(&mut self, extension: &Extension<'_>) -> Result<bool, WireError> {
        if extension.id == 0x33 {
            let [low, high, ..] = extension.number.to_le_bytes();
            self.node = u16::from_le_bytes([low, high]);
            return Ok(true);
        }
        self.take(extension)
    }

    /// Reads the extensions of a message that has only a node and the common ones.
    fn read(header: u8, reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let mut common = Self::DEFAULT;
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            if !common.take_with_node(&extension)? {
                extension.skip()?;
            }
        }
        Ok(common)
    }

    /// Reads the extensions of a message that has only the common ones.
    fn read_without_node(header: u8, reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let mut common = Self::DEFAULT;
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            if !common.take(&extension)? {
                extension.skip()?;
            }
        }
        Ok(common)
    }
}

/// A publication.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Push<'a> {
    /// Key of the publication.
    pub key: WireExpr<'a>,
    /// Common extensions.
    pub common: Common,
    /// The sample.
    pub sample: Sample<'a>,
}

/// A declaration.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Declare<'a> {
    /// Number of the INTEREST that the declaration answers.
    pub interest: Option<u32>,
    /// Common extensions.
    pub common: Common,
    /// The declaration itself.
    pub declaration: Declaration<'a>,
}

/// A request: with ROS, a call of a service.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Request<'a> {
    /// Number of the request in this direction of the connection.
    pub id: u32,
    /// Key of the request.
    pub key: WireExpr<'a>,
    /// Common extensions.
    pub common: Common,
    /// Which queryables answer: 0 the best, 1 all, 2 all complete ones.
    pub target: u8,
    /// Maximum number of replies.
    pub budget: Option<u64>,
    /// Time until the request ends, in milliseconds.
    pub timeout: Option<u64>,
    /// The query.
    pub query: Query<'a>,
}

/// An answer to a request.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Response<'a> {
    /// Number of the request.
    pub id: u32,
    /// Key of the answer.
    pub key: WireExpr<'a>,
    /// Common extensions.
    pub common: Common,
    /// The entity that answers.
    pub responder: Option<EntityGlobalId>,
    /// The answer.
    pub body: body::Response<'a>,
}

/// The end of the answers to a request.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct ResponseFinal {
    /// Number of the request.
    pub id: u32,
    /// Common extensions.
    pub common: Common,
}

/// A request for declarations.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Interest<'a> {
    /// Number of the interest.
    pub id: u32,
    /// Whether current declarations are requested.
    pub is_current: bool,
    /// Whether future declarations are requested. An interest in neither current nor future
    /// declarations ends an earlier interest.
    pub is_future: bool,
    /// Requested kinds: bits 0 to 3 are aliases, subscribers, queryables and tokens. Bit 7 requests
    /// an aggregated answer.
    pub options: u8,
    /// Keys of interest; `None` for all.
    pub key: Option<WireExpr<'a>>,
    /// Common extensions.
    pub common: Common,
}

/// Operation, administration and maintenance. Kind 1 is the gossip of locators.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Oam<'a> {
    /// Number of the kind.
    pub id: u16,
    /// Body, if it is a number.
    pub number: Option<u64>,
    /// Body, if it consists of bytes.
    pub bytes: Option<Bytes<'a>>,
}

impl<'a> Oam<'a> {
    pub(super) fn read(header: u8, reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let id = reader.number("OAM")?;
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            match extension.id {
                // Quality of service. The extension is mandatory in transport messages, not in
                // network messages.
                0x21 | 0x31 => {}
                0x42 => drop(HlcTimestamp::extension(extension.value)?),
                _ => extension.skip()?,
            }
        }
        let (mut number, mut bytes) = (None, None);
        match header & 0x60 {
            0x00 => {}
            0x20 => number = Some(reader.z64("OAM")?),
            0x40 => bytes = Some(reader.bytes("OAM")?),
            _ => return Err(start.error("encoding of an OAM", Reason::BadMarker)),
        }
        Ok(Self { id, number, bytes })
    }
}

/// A message between applications.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum NetworkMessage<'a> {
    /// A publication.
    Push(Push<'a>),
    /// A declaration.
    Declare(Declare<'a>),
    /// A request.
    Request(Request<'a>),
    /// An answer to a request.
    Response(Response<'a>),
    /// The end of the answers to a request.
    ResponseFinal(ResponseFinal),
    /// A request for declarations.
    Interest(Interest<'a>),
    /// Operation, administration and maintenance.
    Oam(Oam<'a>),
}

impl<'a> NetworkMessage<'a> {
    const INTEREST: u8 = 0x19;
    const RESPONSE_FINAL: u8 = 0x1a;
    const RESPONSE: u8 = 0x1b;
    const REQUEST: u8 = 0x1c;
    const PUSH: u8 = 0x1d;
    const DECLARE: u8 = 0x1e;
    const OAM: u8 = 0x1f;

    /// Returns whether a header is that of a network message.
    pub(super) const fn has(header: u8) -> bool {
        header & 0x1f >= Self::INTEREST
    }

    /// Reads a message from the joined bytes of all its FRAGMENTs.
    ///
    /// # Errors
    /// Fails if the bytes are not exactly one message.
    pub fn whole(bytes: &'a [u8]) -> Result<Self, WireError> {
        let mut reader = Reader::whole(bytes);
        let message = Self::read(&mut reader)?;
        reader.finish("network message of FRAGMENTs")?;
        Ok(message)
    }

    /// Reads the beginning of a message from its first FRAGMENT: all but the end of the payload.
    ///
    /// # Errors
    /// Fails if the bytes are malformed or end before the payload.
    pub fn beginning(bytes: &'a [u8]) -> Result<Self, WireError> {
        Self::read(&mut Reader::beginning(bytes))
    }

    pub(super) fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let header = reader.u8("network message")?;
        Ok(match header & 0x1f {
            Self::PUSH => Self::Push(push(header, reader)?),
            Self::DECLARE => Self::Declare(declare(header, reader)?),
            Self::REQUEST => Self::Request(request(header, reader)?),
            Self::RESPONSE => Self::Response(response(header, reader)?),
            Self::RESPONSE_FINAL => Self::ResponseFinal(ResponseFinal {
                id: reader.number("id of a RESPONSE_FINAL")?,
                common: Common::read_without_node(header, reader)?,
            }),
            Self::INTEREST => Self::Interest(interest(header, reader)?),
            Self::OAM => Self::Oam(Oam::read(header, reader)?),
            _ => return Err(start.error("network message", Reason::BadMarker)),
        })
    }
}

fn push<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Push<'a>, WireError> {
    Ok(Push {
        key: WireExpr::behind(header, reader)?,
        common: Common::read(header, reader)?,
        sample: Sample::read(reader)?,
    })
}

fn declare<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Declare<'a>, WireError> {
    let has_interest = header & 0x20 != 0;
    Ok(Declare {
        interest: if has_interest {
            Some(reader.number("id of an INTEREST")?)
        } else {
            None
        },
        common: Common::read(header, reader)?,
        declaration: Declaration::read(reader)?,
    })
}

fn request<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Request<'a>, WireError> {
    let id = reader.number("id of a REQUEST")?;
    let key = WireExpr::behind(header, reader)?;
    let mut common = Common::DEFAULT;
    let (mut target, mut budget, mut timeout) = (0, None, None);
    let mut extensions = Extensions::of(header);
    loop {
        let start = *reader;
        let Some(extension) = extensions.next(reader)? else {
            break;
        };
        match extension.id {
            0x34 => {
                target = u8::try_from(extension.number)
                    .ok()
                    .filter(|target| *target <= 2)
                    .ok_or(start.error("target of a REQUEST", Reason::BadValue))?;
            }
            0x25 => budget = Some(extension.number),
            0x26 => timeout = Some(extension.number),
            _ => {
                if !common.take_with_node(&extension)? {
                    extension.skip()?;
                }
            }
        }
    }
    Ok(Request {
        id,
        key,
        common,
        target,
        budget,
        timeout,
        query: Query::read(reader)?,
    })
}

fn response<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Response<'a>, WireError> {
    let id = reader.number("id of a RESPONSE")?;
    let key = WireExpr::behind(header, reader)?;
    let (mut common, mut responder) = (Common::DEFAULT, None);
    let mut extensions = Extensions::of(header);
    while let Some(extension) = extensions.next(reader)? {
        if extension.id == 0x43 {
            responder = Some(EntityGlobalId::extension(extension.value)?);
        } else if !common.take(&extension)? {
            extension.skip()?;
        }
    }
    Ok(Response {
        id,
        key,
        common,
        responder,
        body: body::Response::read(reader)?,
    })
}

fn interest<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Interest<'a>, WireError> {
    let id = reader.number("id of an INTEREST")?;
    let (is_current, is_future) = (header & 0x20 != 0, header & 0x40 != 0);
    let (mut options, mut key) = (0, None);
    if is_current || is_future {
        options = reader.u8("options of an INTEREST")?;
        if options & 0x10 != 0 {
            key = Some(WireExpr::behind(options, reader)?);
        }
    }
    Ok(Interest {
        id,
        is_current,
        is_future,
        options,
        key,
        common: Common::read(header, reader)?,
    })
}
