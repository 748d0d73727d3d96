//! Lost samples, and where they were lost as far as this host can observe.
//!
//! Causes are mutually exclusive: a sample with several causes counts for the one nearest to the
//! reader. The counts of all causes therefore add up to the losses.

use std::net::SocketAddr;

use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber};

use crate::facts::model_time::ModelTime;
/// Where a sample was lost.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum LossCause {
    /// The sender dropped the sample before its TCP connection, which loses and reorders nothing.
    Sender,
    /// The sample did not reach this host: the network lost it, or it was sent elsewhere.
    BeforeHost,
    /// The kernel gave up reassembly, because some of its IP fragments did not arrive in time.
    Reassembly,
    /// The receive buffer of the subscriber's socket was full.
    SocketBuffer,
}

/// Consecutive samples that were settled as lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loss {
    /// Time at which they were settled.
    pub at: ModelTime,
    /// GUID of the writer.
    pub writer: Guid,
    /// First lost sequence number.
    pub first: SequenceNumber,
    /// Last lost sequence number.
    pub last: SequenceNumber,
}

/// Consecutive samples that one receiver lost, reported once the cause is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeliveryLoss {
    /// Time at which the cause was settled.
    pub at: ModelTime,
    /// GUID of the writer.
    pub writer: Guid,
    /// The participant that missed them, if known.
    pub participant: Option<GuidPrefix>,
    /// Cookie of the socket that receives the writer's new samples; 0 on a wire source.
    pub socket: u64,
    /// Destination address of the samples.
    pub destination: SocketAddr,
    /// Cause of the loss.
    pub cause: LossCause,
    /// First lost sequence number.
    pub first: SequenceNumber,
    /// Last lost sequence number.
    pub last: SequenceNumber,
}

impl LossCause {
    /// All causes, for exporting one series each.
    pub const ALL: [Self; 4] = [
        Self::Sender,
        Self::BeforeHost,
        Self::Reassembly,
        Self::SocketBuffer,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Sender => "sender",
            Self::BeforeHost => "before_host",
            Self::Reassembly => "reassembly",
            Self::SocketBuffer => "socket_buffer",
        }
    }
}
