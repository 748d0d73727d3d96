//! Reads Zenoh 1.x (wire version 9) as rmw_zenoh_cpp uses it, without joining a session.
//!
//! A stream is a sequence of batches with a length prefix ([`Batch::split`]). A [`Batch`] yields
//! transport messages and the [`NetworkMessage`]s of its `FRAME`s; all borrow from the input. A
//! message longer than a batch comes in [`Fragment`]s. The kernel may copy only the head of a
//! batch: each message that is complete up to its payload is read, and the payload has its length
//! on the wire ([`Bytes`]).
//!
//! [`TopicKey`], [`Token`] and [`Attachment`] are conventions of rmw_zenoh on top of Zenoh: names
//! and types of publications, the graph of nodes and endpoints, and the identity of each sample.
//! [`Gid`]s are hashes of tokens, so the attachment of a publication identifies its topic without
//! any alias.
//!
//! The decoder keeps no state. Its caller keeps the tables of aliases, one per connection and
//! direction, and the chains of fragments, one per lane. Unknown extensions are skipped, so later
//! 1.x versions stay readable. Numbers that exceed their field and extensions with a wrong length
//! are errors here. Zenoh cuts off such a number, and reads on after such an extension.
//!
//! Zenoh has no specification of the wire, so the comments name files of its crate `zenoh-protocol`
//! 1.10 and of rmw_zenoh. The tests compare this decoder with Zenoh's own, `zenoh-codec`.

mod attachment;
mod batch;
mod body;
mod declare;
mod expression;
mod extension;
mod identity;
mod key;
mod network;
mod reader;
mod session;
mod token;
mod token_qos;
#[cfg(test)]
mod vectors;

/// TCP port of routers: the default of `rmw_zenohd`.
pub const PORT: u16 = 7447;
pub use crate::zenoh_stream::VERSION;
pub use attachment::{Attachment, Gid};
pub use batch::{Batch, Close, Fragment, Frame, Lane, Message, Priority};
pub use body::{Del, Encoding, Put, Query, Response as ResponseBody, Sample};
pub use declare::Declaration;
pub use expression::{Mapping, WireExpr};
pub use identity::{EntityGlobalId, HlcTimestamp, SourceInfo, ZenohId};
pub use key::{Buffer, Key, TopicKey};
pub use network::{
    Common, Declare, Interest, MessageQos, NetworkMessage, Oam, Push, Request, Response,
    ResponseFinal,
};
pub use reader::{Bytes, vle};
pub use session::{
    Features, Init, Join, NextSequenceNumbers, Open, Resolution, Session, Side, Unobservable,
    WhatAmI,
};
pub use token::{BridgeToken, EndpointKind, EndpointToken, NodeToken, Token};
