//! Deliveries of messages: when a message left its publisher's socket, and when its last datagram
//! arrived at a subscriber's socket and was received there.
//!
//! The kernel programs and user space share this binary layout. Times are CLOCK_MONOTONIC
//! nanoseconds. A message is identified by its source timestamp.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Maximum number of sockets whose datagrams are numbered.
pub const QUEUE_CAPACITY: u32 = 1_024;
/// Maximum number of sent messages, of datagrams in receive buffers, and of received messages that
/// are remembered.
pub const DELIVERY_CAPACITY: u32 = 8_192;

/// One message in one subscribing process.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct DeliveryKey {
    /// Source timestamp, nanoseconds since the Unix epoch.
    pub source_timestamp: u64,
    /// Process id in the initial namespace.
    pub process: u64,
}

/// How a message came into a process.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Delivery {
    /// Time at which the message's last datagram was about to enter the socket's receive buffer.
    pub arrived: u64,
    /// Time at which a thread had received that datagram.
    pub received: u64,
    /// Time for which the receiving thread could run and did not, between the two.
    pub runnable: u64,
    /// Part of that time in which its control group had used up its CPU quota.
    pub throttled: u64,
    /// The receiving thread.
    pub thread: u32,
    /// 1 = `runnable` and `throttled` are known.
    pub accounted: u32,
}
