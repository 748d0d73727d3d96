//! Parsers for RTPS as ROS 2 uses it, for an observer that does not join a domain. They are bounded
//! and copy nothing. The crate also holds the walk that decides what the kernel filter keeps, and
//! the binary layouts shared by kernel and user space. [`zenoh`] reads Zenoh, the other protocol of
//! ROS 2.
//!
//! The crate does no I/O, reads no clock, writes no log and has no `unsafe` code. Bytes and the
//! caller's time go in, typed values come out. The kernel program builds this crate without
//! `alloc`.

#![no_std]
#![forbid(unsafe_code)]

#[cfg(feature = "alloc")]
extern crate alloc;
#[cfg(test)]
extern crate std;
// The oracle is also included by tests of other crates, so it refers to this crate by name.
#[cfg(test)]
extern crate self as ros2probe_wire;

#[cfg(feature = "alloc")]
pub mod backends;
pub mod cursor;
pub mod delivery;
#[cfg(feature = "alloc")]
pub mod diagnostics;
#[cfg(feature = "alloc")]
pub mod discovery;
mod domain;
#[cfg(feature = "alloc")]
pub mod encode;
#[cfg(feature = "alloc")]
pub mod entities;
mod expansion;
pub mod filter;
pub mod frame;
pub mod guid;
#[cfg(feature = "alloc")]
pub mod header;
pub mod host;
pub mod inside;
#[cfg(feature = "alloc")]
pub mod lifecycle;
#[cfg(feature = "alloc")]
pub mod log;
#[cfg(feature = "alloc")]
pub mod names;
pub mod parameters;
#[cfg(feature = "alloc")]
mod plain;
#[cfg(feature = "alloc")]
pub mod qos;
pub mod quic;
pub mod record;
#[cfg(feature = "alloc")]
pub mod ros_parameters;
pub mod rtps;
pub mod rtps_tcp;
#[cfg(test)]
mod testing;
#[cfg(feature = "alloc")]
mod text;
pub mod time;
#[cfg(feature = "alloc")]
pub mod transforms;
pub mod walk;
#[cfg(feature = "alloc")]
pub mod xcdr2;
#[cfg(feature = "alloc")]
pub mod zenoh;
pub mod zenoh_stream;

pub use cursor::{Cursor, Endianness, Reason, WireError};
pub use domain::{DomainId, InvalidDomainId};
pub use expansion::{ExpandsTooFar, Expansion};
pub use guid::{EntityId, Guid, GuidPrefix};
pub use record::Record;
pub use rtps::SequenceNumber;
pub use time::{RtpsDuration, RtpsTime, Timestamp};
