//! Bodies of network messages: PUT, DEL, QUERY, REPLY and ERR (`zenoh-protocol`, `zenoh/`).

use crate::cursor::{Reason, WireError};

use super::extension::Extensions;
use super::identity::{HlcTimestamp, SourceInfo};
use super::reader::{Bytes, Reader};

/// Encoding of a payload; ROS sends none.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct Encoding<'a> {
    /// Number of the encoding; 0 is "bytes". Zenoh keeps the lower 16 of the 31 bits.
    pub id: u32,
    /// Schema within the encoding.
    pub schema: Option<&'a [u8]>,
}

impl<'a> Encoding<'a> {
    fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let id: u32 = reader.number("encoding")?;
        let has_schema = id & 1 != 0;
        Ok(Self {
            id: id >> 1,
            schema: if has_schema {
                Some(reader.sized("schema of an encoding", u64::from(u8::MAX))?)
            } else {
                None
            },
        })
    }
}

/// A published sample, or the sample of a reply.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Put<'a> {
    /// Time of the source's hybrid logical clock.
    pub timestamp: Option<HlcTimestamp>,
    /// Encoding of the payload.
    pub encoding: Encoding<'a>,
    /// Source, if an AdvancedPublisher sent the sample.
    pub source: Option<SourceInfo>,
    /// Attachment; see [`super::Attachment`].
    pub attachment: Option<Bytes<'a>>,
    /// Whether slices of the payload are in shared memory. Such a payload has no captured bytes.
    pub is_shared: bool,
    /// The payload.
    pub payload: Bytes<'a>,
}

impl<'a> Put<'a> {
    const ID: u8 = 0x01;

    fn read(header: u8, reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let mut put = Self {
            timestamp: timestamp(header, reader)?,
            encoding: encoding(header, reader)?,
            source: None,
            attachment: None,
            is_shared: false,
            payload: Bytes::default(),
        };
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            match extension.id {
                0x41 => put.source = Some(SourceInfo::extension(extension.value)?),
                0x12 => put.is_shared = true,
                0x43 => put.attachment = Some(extension.value.rest()),
                _ => extension.skip()?,
            }
        }
        put.payload = payload(put.is_shared, reader)?;
        Ok(put)
    }
}

/// A deleted sample; ROS sends none.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Del<'a> {
    /// Time of the source's hybrid logical clock.
    pub timestamp: Option<HlcTimestamp>,
    /// Source, if an AdvancedPublisher sent the sample.
    pub source: Option<SourceInfo>,
    /// Attachment.
    pub attachment: Option<Bytes<'a>>,
}

impl<'a> Del<'a> {
    const ID: u8 = 0x02;

    fn read(header: u8, reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let mut del = Self {
            timestamp: timestamp(header, reader)?,
            source: None,
            attachment: None,
        };
        let mut extensions = Extensions::of(header);
        while let Some(extension) = extensions.next(reader)? {
            match extension.id {
                0x41 => del.source = Some(SourceInfo::extension(extension.value)?),
                0x42 => del.attachment = Some(extension.value.rest()),
                _ => extension.skip()?,
            }
        }
        Ok(del)
    }
}

/// Content of a PUSH or a REPLY.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Sample<'a> {
    /// A sample.
    Put(Put<'a>),
    /// A deletion.
    Del(Del<'a>),
}

impl<'a> Sample<'a> {
    pub(super) fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let header = reader.u8("body of a sample")?;
        match header & 0x1f {
            Put::ID => Ok(Self::Put(Put::read(header, reader)?)),
            Del::ID => Ok(Self::Del(Del::read(header, reader)?)),
            _ => Err(start.error("body of a sample", Reason::BadMarker)),
        }
    }
}

/// The body of a request: a call of a service, or a query for old samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Query<'a> {
    /// How replies are consolidated: 0 automatic, 1 none, 2 monotonic, 3 latest.
    pub consolidation: u64,
    /// Parameters of the selector.
    pub parameters: &'a str,
    /// Source, if announced.
    pub source: Option<SourceInfo>,
    /// Encoding and payload: the request of a service.
    pub body: Option<(Encoding<'a>, Bytes<'a>)>,
    /// Attachment; see [`super::Attachment`]. It follows the payload, so a cut capture may lack it.
    pub attachment: Option<Bytes<'a>>,
    /// Whether the capture ends before the extensions after the payload.
    pub is_cut: bool,
}

impl<'a> Query<'a> {
    const ID: u8 = 0x03;

    pub(super) fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let header = reader.u8("QUERY")?;
        if header & 0x1f != Self::ID {
            return Err(start.error("QUERY", Reason::BadMarker));
        }
        let mut query = Self {
            consolidation: consolidation(header, reader)?,
            parameters: if header & 0x40 == 0 {
                ""
            } else {
                reader.text("parameters of a QUERY", u64::from(u32::MAX))?
            },
            source: None,
            body: None,
            attachment: None,
            is_cut: false,
        };
        let mut extensions = Extensions::of(header);
        loop {
            let extension = match extensions.next(reader) {
                Ok(Some(extension)) => extension,
                Ok(None) => break,
                Err(error) if error.reason == Reason::Truncated && query.body.is_some() => {
                    query.is_cut = true;
                    break;
                }
                Err(error) => return Err(error),
            };
            match extension.id {
                0x41 => query.source = Some(SourceInfo::extension(extension.value)?),
                0x43 => {
                    let mut value = extension.value;
                    query.body = Some((Encoding::read(&mut value)?, value.rest()));
                }
                0x45 => query.attachment = Some(extension.value.rest()),
                _ => extension.skip()?,
            }
        }
        Ok(query)
    }
}

/// The body of a response.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Response<'a> {
    /// A reply.
    Reply {
        /// How the replies are consolidated, as in [`Query::consolidation`].
        consolidation: u64,
        /// The reply's sample: the response of a service.
        sample: Sample<'a>,
    },
    /// An error; rmw_zenoh sends none.
    Error {
        /// Encoding of the payload.
        encoding: Encoding<'a>,
        /// Source, if announced.
        source: Option<SourceInfo>,
        /// The payload.
        payload: Bytes<'a>,
    },
}

impl<'a> Response<'a> {
    const REPLY: u8 = 0x04;
    const ERR: u8 = 0x05;

    pub(super) fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let header = reader.u8("body of a RESPONSE")?;
        match header & 0x1f {
            Self::REPLY => {
                let consolidation = consolidation(header, reader)?;
                Extensions::of(header).skip_all(reader)?;
                let sample = Sample::read(reader)?;
                Ok(Self::Reply {
                    consolidation,
                    sample,
                })
            }
            Self::ERR => {
                let encoding = encoding(header, reader)?;
                let (mut source, mut is_shared) = (None, false);
                let mut extensions = Extensions::of(header);
                while let Some(extension) = extensions.next(reader)? {
                    match extension.id {
                        0x41 => source = Some(SourceInfo::extension(extension.value)?),
                        0x12 => is_shared = true,
                        _ => extension.skip()?,
                    }
                }
                Ok(Self::Error {
                    encoding,
                    source,
                    payload: payload(is_shared, reader)?,
                })
            }
            _ => Err(start.error("body of a RESPONSE", Reason::BadMarker)),
        }
    }
}

/// Reads the timestamp that flag T announces.
fn timestamp(header: u8, reader: &mut Reader<'_>) -> Result<Option<HlcTimestamp>, WireError> {
    (header & 0x20 != 0)
        .then(|| HlcTimestamp::read(reader))
        .transpose()
}

/// Reads the encoding that flag E announces.
fn encoding<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Encoding<'a>, WireError> {
    if header & 0x40 == 0 {
        return Ok(Encoding::default());
    }
    Encoding::read(reader)
}

/// Reads the consolidation that flag C announces; Zenoh treats an unknown one as automatic.
fn consolidation(header: u8, reader: &mut Reader<'_>) -> Result<u64, WireError> {
    if header & 0x20 == 0 {
        return Ok(0);
    }
    reader.z64("consolidation")
}

/// Reads a payload. A payload with slices in shared memory has the length of all slices together.
fn payload<'a>(is_shared: bool, reader: &mut Reader<'a>) -> Result<Bytes<'a>, WireError> {
    if !is_shared {
        return reader.bytes("payload");
    }
    let count: u32 = reader.number("count of slices")?;
    let mut length = 0_usize;
    // Each slice takes at least two bytes of the input, so the input bounds the loop.
    for _ in 0..count {
        let start = *reader;
        let kind = reader.u8("kind of a slice")?;
        let mut slice = reader.nested("slice")?;
        let size = match kind {
            0 => slice.rest().length,
            // A descriptor begins with the length of the slice in shared memory.
            1 => slice.number("length of a shared slice")?,
            _ => return Err(start.error("kind of a slice", Reason::BadMarker)),
        };
        length = length.saturating_add(size);
    }
    Ok(Bytes {
        captured: &[],
        length,
    })
}
