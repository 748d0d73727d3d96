//! Lost samples: whose, and where they died, as far as this host can tell.
//!
//! The causes exclude each other: a sample of which anything died nearest to the reader bears that
//! cause, so the counts of all causes add up to the losses.

use std::net::SocketAddr;

use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber, Timestamp};

/// Where a sample died that never arrived whole.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum LossCause {
    /// It did not reach this host: lost on the network, or never sent to here.
    BeforeHost,
    /// Some of its IP fragments reached this host, and the kernel gave up waiting for the others.
    Reassembly,
    /// It reached the subscriber's socket, whose receive buffer was full.
    SocketBuffer,
}

/// Consecutive samples that were settled as lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loss {
    /// When it was settled.
    pub at: Timestamp,
    /// Whose.
    pub writer: Guid,
    /// First lost sequence number.
    pub first: SequenceNumber,
    /// Last lost sequence number.
    pub last: SequenceNumber,
}

/// Consecutive samples that one receiver lost, told once the cause is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeliveryLoss {
    /// When the cause was settled.
    pub at: Timestamp,
    /// Whose samples.
    pub writer: Guid,
    /// The participant that missed them, where it was known.
    pub participant: Option<GuidPrefix>,
    /// Cookie of the socket by which the writer's new samples come; 0 on a wire source.
    pub socket: u64,
    /// Where they come to.
    pub destination: SocketAddr,
    /// Where they died.
    pub cause: LossCause,
    /// First lost sequence number.
    pub first: SequenceNumber,
    /// Last lost sequence number.
    pub last: SequenceNumber,
}

impl LossCause {
    /// All causes, for exporting one series each.
    pub const ALL: [Self; 3] = [Self::BeforeHost, Self::Reassembly, Self::SocketBuffer];

    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::BeforeHost => "before_host",
            Self::Reassembly => "reassembly",
            Self::SocketBuffer => "socket_buffer",
        }
    }
}
