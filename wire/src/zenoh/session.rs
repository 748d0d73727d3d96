//! The parameters that a session negotiates in INIT and OPEN, and whether its traffic can be
//! observed (`zenoh-protocol`, `transport/init.rs`, `open.rs` and `join.rs`).

use core::fmt;
use core::time::Duration;

use crate::cursor::{Reason, WireError};
use crate::zenoh_stream::VERSION;

use super::batch::Priority;
use super::extension::Extensions;
use super::identity::ZenohId;
use super::reader::{Bytes, Reader};

/// Role of a session in the topology.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum WhatAmI {
    /// Forwards data between hosts: `rmw_zenohd`.
    Router,
    /// Connects to other peers: the session of a ROS process.
    Peer,
    /// Connects to one router.
    Client,
}

impl WhatAmI {
    fn of(flags: u8, error: WireError) -> Result<Self, WireError> {
        Ok(match flags & 0x03 {
            0 => Self::Router,
            1 => Self::Peer,
            2 => Self::Client,
            _ => return Err(error),
        })
    }
}

impl fmt::Display for WhatAmI {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Router => "router",
            Self::Peer => "peer",
            Self::Client => "client",
        })
    }
}

/// Sizes of a session's numbers, as encoded on the wire: bits 0 and 1 for the sequence numbers of
/// `FRAME`s, bits 2 and 3 for the ids of requests.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Resolution(pub u8);

impl Resolution {
    /// 32 bits each: the default.
    pub const DEFAULT: Self = Self(0x0a);

    /// Returns the mask of the bits of a sequence number. The number after the highest is zero.
    ///
    /// The encoding of a number must fit n bits on the wire, so the number has fewer bits: 28 with
    /// the default resolution of 32 (`io/zenoh-transport/src/common/seq_num.rs`).
    #[must_use]
    pub const fn sequence_number_mask(self) -> u32 {
        match self.0 & 0x03 {
            0 => (u8::MAX >> 1) as u32,
            1 => (u16::MAX >> 2) as u32,
            2 => u32::MAX >> 4,
            // Zenoh keeps sequence numbers in 32 bits.
            _ => u32::MAX,
        }
    }

    /// Returns the sequence number after `number`.
    #[must_use]
    pub const fn next(self, number: u32) -> u32 {
        number.wrapping_add(1) & self.sequence_number_mask()
    }

    fn min(self, other: Self) -> Self {
        let field = |mask: u8| (self.0 & mask).min(other.0 & mask);
        Self(field(0x03) | field(0x0c) | field(0x30))
    }
}

/// Optional features that INIT offers or accepts.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct Features {
    /// Lanes with priorities.
    pub qos: bool,
    /// Payloads in shared memory.
    pub shared_memory: bool,
    /// Authentication.
    pub auth: bool,
    /// Several links.
    pub multi_link: bool,
    /// Transport without `FRAME`s.
    pub low_latency: bool,
    /// Batches compressed with LZ4.
    pub compression: bool,
}

/// INIT: the sides introduce themselves.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Init<'a> {
    /// Whether this is the acceptor's answer, with the values that both sides support.
    pub is_ack: bool,
    /// Version of the wire format, see [`VERSION`].
    pub version: u8,
    /// Role of the sender.
    pub whatami: WhatAmI,
    /// Id of the sender.
    pub zid: ZenohId,
    /// Sizes of numbers.
    pub resolution: Resolution,
    /// Maximum size of a batch, in bytes.
    pub batch_size: u16,
    /// Cookie that the initiator's OPEN returns; empty unless [`Self::is_ack`].
    pub cookie: &'a [u8],
    /// Offered features; with [`Self::is_ack`], the accepted ones.
    pub features: Features,
    /// Patch level of the protocol. Since level 1, the first FRAGMENT of a chain is marked.
    pub patch: u64,
    /// Name of the sender's region, since Zenoh 1.10.
    pub region: Option<Bytes<'a>>,
}

impl<'a> Init<'a> {
    pub(super) fn read(header: u8, reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let hello = Hello::read(header, reader, u16::MAX)?;
        let is_ack = header & 0x20 != 0;
        let mut init = Self {
            is_ack,
            version: hello.version,
            whatami: hello.whatami,
            zid: hello.zid,
            resolution: hello.resolution,
            batch_size: hello.batch_size,
            cookie: if is_ack {
                reader.sized("cookie", u64::from(u16::MAX))?
            } else {
                &[]
            },
            features: Features::default(),
            patch: 0,
            region: None,
        };
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            match extension.id {
                0x01 | 0x21 => init.features.qos = true,
                0x42 => init.features.shared_memory = true,
                0x43 => init.features.auth = true,
                0x44 => init.features.multi_link = true,
                0x05 => init.features.low_latency = true,
                0x06 => init.features.compression = true,
                0x27 => init.patch = extension.number,
                0x48 => init.region = Some(extension.value.rest()),
                _ => extension.skip()?,
            }
        }
        Ok(init)
    }
}

/// OPEN: the session begins.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Open {
    /// Whether this is the acceptor's answer.
    pub is_ack: bool,
    /// Time without any message after which the session ends.
    pub lease: Duration,
    /// Sequence number of the first FRAME of each of the sender's lanes.
    pub initial_sequence_number: u32,
}

impl Open {
    pub(super) fn read(header: u8, reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let open = Self {
            is_ack: header & 0x20 != 0,
            lease: lease(header, reader)?,
            initial_sequence_number: reader.number("initial sequence number")?,
        };
        if !open.is_ack {
            reader.sized("cookie", u64::from(u16::MAX))?;
        }
        Extensions::of(header).skip_all(reader)?;
        Ok(open)
    }
}

/// Next sequence numbers of one priority's lanes.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct NextSequenceNumbers {
    /// Next number of the reliable lane.
    pub reliable: u32,
    /// Next number of the best-effort lane.
    pub best_effort: u32,
}

impl NextSequenceNumbers {
    fn read(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        Ok(Self {
            reliable: reader.number("next sequence number")?,
            best_effort: reader.number("next sequence number")?,
        })
    }
}

/// JOIN: a member of a multicast group introduces itself. rmw_zenoh sends none by default.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Join {
    /// Version of the wire format, see [`VERSION`].
    pub version: u8,
    /// Role of the sender.
    pub whatami: WhatAmI,
    /// Id of the sender.
    pub zid: ZenohId,
    /// Sizes of numbers.
    pub resolution: Resolution,
    /// Maximum size of a batch, in bytes.
    pub batch_size: u16,
    /// Time without any message after which the membership ends.
    pub lease: Duration,
    /// Next sequence numbers of the lanes without priorities.
    pub next: NextSequenceNumbers,
    /// Next sequence numbers by priority, if the sender has lanes with priorities.
    pub next_by_priority: Option<[NextSequenceNumbers; Priority::COUNT]>,
    /// Patch level of the protocol.
    pub patch: u64,
}

impl Join {
    pub(super) fn read(header: u8, reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let hello = Hello::read(header, reader, 8192)?;
        let mut join = Self {
            version: hello.version,
            whatami: hello.whatami,
            zid: hello.zid,
            resolution: hello.resolution,
            batch_size: hello.batch_size,
            // Flag T is the bit that marks the acknowledgement in INIT.
            lease: seconds_or_milliseconds(header & 0x20 != 0, reader)?,
            next: NextSequenceNumbers::read(reader)?,
            next_by_priority: None,
            patch: 0,
        };
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            match extension.id {
                0x51 => {
                    let mut value = extension.value;
                    let mut all = [NextSequenceNumbers::default(); Priority::COUNT];
                    for next in &mut all {
                        *next = NextSequenceNumbers::read(&mut value)?;
                    }
                    value.finish("sequence numbers by priority")?;
                    join.next_by_priority = Some(all);
                }
                // Shared memory.
                0x52 => {}
                0x27 => join.patch = extension.number,
                _ => extension.skip()?,
            }
        }
        Ok(join)
    }
}

/// The common beginning of INIT and JOIN.
struct Hello {
    version: u8,
    whatami: WhatAmI,
    zid: ZenohId,
    resolution: Resolution,
    batch_size: u16,
}

impl Hello {
    fn read(header: u8, reader: &mut Reader<'_>, batch_size: u16) -> Result<Self, WireError> {
        let version = reader.u8("version")?;
        let error = reader.error("role of a session", Reason::BadValue);
        let flags = reader.u8("role of a session")?;
        let whatami = WhatAmI::of(flags, error)?;
        let zid = ZenohId::behind(flags, reader)?;
        let has_sizes = header & 0x40 != 0;
        let (resolution, batch_size) = if has_sizes {
            let resolution = Resolution(reader.u8("resolution")? & 0x3f);
            (resolution, reader.u16("batch size")?)
        } else {
            (Resolution::DEFAULT, batch_size)
        };
        Ok(Self {
            version,
            whatami,
            zid,
            resolution,
            batch_size,
        })
    }
}

fn lease(header: u8, reader: &mut Reader<'_>) -> Result<Duration, WireError> {
    seconds_or_milliseconds(header & 0x40 != 0, reader)
}

fn seconds_or_milliseconds(
    is_seconds: bool,
    reader: &mut Reader<'_>,
) -> Result<Duration, WireError> {
    let lease = reader.z64("lease")?;
    Ok(if is_seconds {
        Duration::from_secs(lease)
    } else {
        Duration::from_millis(lease)
    })
}

/// One side of a session.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Side {
    /// Id of the session or router.
    pub zid: ZenohId,
    /// Role.
    pub whatami: WhatAmI,
}

/// The parameters of a session on which both sides agreed.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Session {
    /// Version of the wire format.
    pub version: u8,
    /// The side that opened the connection.
    pub initiator: Side,
    /// The side that accepted it.
    pub acceptor: Side,
    /// Sizes of numbers.
    pub resolution: Resolution,
    /// Maximum size of a batch, in bytes.
    pub batch_size: u16,
    /// Features that both sides have.
    pub features: Features,
    /// Patch level of the protocol that both sides have.
    pub patch: u64,
}

/// Why the traffic of a session cannot be decoded.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Unobservable {
    /// Another version of the wire format.
    Version(u8),
    /// Batches are compressed with LZ4.
    Compression,
    /// Messages have another framing, without sequence numbers.
    LowLatency,
}

impl fmt::Display for Unobservable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version(version) => write!(f, "unsupported Zenoh version {version}"),
            Self::Compression => f.write_str("compressed batches"),
            Self::LowLatency => f.write_str("low-latency transport"),
        }
    }
}

impl Session {
    /// Returns the session that an INIT and its acknowledgement establish, with the values that
    /// both sides support.
    #[must_use]
    pub fn agreed(init: &Init<'_>, ack: &Init<'_>) -> Self {
        let side = |init: &Init<'_>| Side {
            zid: init.zid,
            whatami: init.whatami,
        };
        let (ours, theirs) = (init.features, ack.features);
        Self {
            version: ack.version,
            initiator: side(init),
            acceptor: side(ack),
            resolution: init.resolution.min(ack.resolution),
            batch_size: init.batch_size.min(ack.batch_size),
            features: Features {
                qos: ours.qos && theirs.qos,
                shared_memory: ours.shared_memory && theirs.shared_memory,
                auth: ours.auth && theirs.auth,
                multi_link: ours.multi_link && theirs.multi_link,
                low_latency: ours.low_latency && theirs.low_latency,
                compression: ours.compression && theirs.compression,
            },
            patch: init.patch.min(ack.patch),
        }
    }

    /// Returns why the session cannot be observed; `None` if it can.
    ///
    /// Shared memory does not prevent observation: sizes, identities and sequence numbers still
    /// pass through the connection. With several links, each connection has gaps in its sequence
    /// numbers.
    #[must_use]
    pub const fn unobservable(&self) -> Option<Unobservable> {
        if self.version != VERSION {
            Some(Unobservable::Version(self.version))
        } else if self.features.low_latency {
            Some(Unobservable::LowLatency)
        } else if self.features.compression {
            Some(Unobservable::Compression)
        } else {
            None
        }
    }
}
