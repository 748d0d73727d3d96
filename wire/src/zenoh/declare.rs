//! Declarations: aliases, subscribers, queryables and liveliness tokens (`zenoh-protocol`,
//! `network/declare.rs`).

use crate::cursor::{Reason, WireError};

use super::expression::{Mapping, WireExpr};
use super::extension::Extensions;
use super::reader::Reader;

/// Content of a DECLARE: a declaration or its end. Ids are unique per kind and sender.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Declaration<'a> {
    /// An alias of the sender for a key.
    KeyExpr {
        /// The alias, as in [`WireExpr::scope`].
        id: u16,
        /// The key, which may begin with an earlier alias of the sender.
        key: WireExpr<'a>,
    },
    /// The end of an alias.
    UndeclareKeyExpr {
        /// The alias.
        id: u16,
    },
    /// A subscriber.
    Subscriber {
        /// Id of the subscriber.
        id: u32,
        /// Keys that it subscribes to.
        key: WireExpr<'a>,
    },
    /// The end of a subscriber.
    UndeclareSubscriber {
        /// Id of the subscriber.
        id: u32,
        /// Its key, if repeated.
        key: Option<WireExpr<'a>>,
    },
    /// A queryable: with ROS, the server of a service.
    Queryable {
        /// Id of the queryable.
        id: u32,
        /// Keys that it answers for.
        key: WireExpr<'a>,
        /// Whether it is complete: it has all data of its keys.
        is_complete: bool,
        /// Distance in hops.
        distance: u16,
    },
    /// The end of a queryable.
    UndeclareQueryable {
        /// Id of the queryable.
        id: u32,
        /// Its key, if repeated.
        key: Option<WireExpr<'a>>,
    },
    /// A liveliness token.
    Token {
        /// Id of the token.
        id: u32,
        /// The token, see [`super::Token`].
        key: WireExpr<'a>,
    },
    /// The end of a liveliness token.
    UndeclareToken {
        /// Id of the token.
        id: u32,
        /// The token, if repeated.
        key: Option<WireExpr<'a>>,
    },
    /// The end of the current declarations that answer an INTEREST.
    Final,
}

impl<'a> Declaration<'a> {
    const D_KEYEXPR: u8 = 0x00;
    const U_KEYEXPR: u8 = 0x01;
    const D_SUBSCRIBER: u8 = 0x02;
    const U_SUBSCRIBER: u8 = 0x03;
    const D_QUERYABLE: u8 = 0x04;
    const U_QUERYABLE: u8 = 0x05;
    const D_TOKEN: u8 = 0x06;
    const U_TOKEN: u8 = 0x07;
    const D_FINAL: u8 = 0x1a;

    pub(super) fn read(reader: &mut Reader<'a>) -> Result<Self, WireError> {
        let start = *reader;
        let header = reader.u8("declaration")?;
        Ok(match header & 0x1f {
            Self::D_KEYEXPR => {
                let id = reader.number("id of an alias")?;
                let mut key = WireExpr::behind(header, reader)?;
                // Flag M is not set, yet an alias in the key is the sender's.
                key.mapping = Mapping::Sender;
                Extensions::of(header).skip_all(reader)?;
                Self::KeyExpr { id, key }
            }
            Self::U_KEYEXPR => {
                let id = reader.number("id of an alias")?;
                Extensions::of(header).skip_all(reader)?;
                Self::UndeclareKeyExpr { id }
            }
            Self::D_SUBSCRIBER => {
                let (id, key) = declared(header, reader)?;
                Extensions::of(header).skip_all(reader)?;
                Self::Subscriber { id, key }
            }
            Self::U_SUBSCRIBER => {
                let (id, key) = undeclared(header, reader)?;
                Self::UndeclareSubscriber { id, key }
            }
            Self::D_QUERYABLE => queryable(header, reader)?,
            Self::U_QUERYABLE => {
                let (id, key) = undeclared(header, reader)?;
                Self::UndeclareQueryable { id, key }
            }
            Self::D_TOKEN => {
                let (id, key) = declared(header, reader)?;
                Extensions::of(header).skip_all(reader)?;
                Self::Token { id, key }
            }
            Self::U_TOKEN => {
                let (id, key) = undeclared(header, reader)?;
                Self::UndeclareToken { id, key }
            }
            Self::D_FINAL => {
                Extensions::of(header).skip_all(reader)?;
                Self::Final
            }
            _ => return Err(start.error("declaration", Reason::BadMarker)),
        })
    }
}

fn declared<'a>(header: u8, reader: &mut Reader<'a>) -> Result<(u32, WireExpr<'a>), WireError> {
    let id = reader.number("id of a declaration")?;
    Ok((id, WireExpr::behind(header, reader)?))
}

fn undeclared<'a>(
    header: u8,
    reader: &mut Reader<'a>,
) -> Result<(u32, Option<WireExpr<'a>>), WireError> {
    let id = reader.number("id of a declaration")?;
    let mut key = None;
    let mut extensions = Extensions::of(header);
    while let Some(extension) = extensions.next(reader)? {
        match extension.id {
            0x5f => key = Some(WireExpr::extension(extension.value)?),
            _ => extension.skip()?,
        }
    }
    Ok((id, key))
}

fn queryable<'a>(header: u8, reader: &mut Reader<'a>) -> Result<Declaration<'a>, WireError> {
    let (id, key) = declared(header, reader)?;
    let (mut is_complete, mut distance) = (false, 0);
    let mut extensions = Extensions::of(header);
    while let Some(extension) = extensions.next(reader)? {
        match extension.id {
            0x21 => {
                let [flags, low, high, ..] = extension.number.to_le_bytes();
                is_complete = flags & 1 != 0;
                distance = u16::from_le_bytes([low, high]);
            }
            _ => extension.skip()?,
        }
    }
    Ok(Declaration::Queryable {
        id,
        key,
        is_complete,
        distance,
    })
}
