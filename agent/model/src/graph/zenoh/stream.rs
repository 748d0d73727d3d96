//! Reports of a source about a Zenoh connection: batches of bytes, gaps, the start and the end.

use ros2probe_wire::Timestamp;

use crate::facts::route::Destination;

/// One direction of a TCP connection: the sender's address, and the receiver's.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct Flow {
    /// Address of the sender.
    pub source: Destination,
    /// Address of the receiver.
    pub destination: Destination,
}

impl Flow {
    /// Returns the opposite direction.
    #[must_use]
    pub const fn reversed(self) -> Self {
        Self {
            source: self.destination,
            destination: self.source,
        }
    }

    /// Returns the flow that identifies the connection, which is the same for both directions.
    #[must_use]
    pub fn connection(self) -> Self {
        self.min(self.reversed())
    }
}

/// One direction of a TCP connection, as seen at a socket, on an interface or in a capture file. On
/// the loopback interface, it is seen at the socket of the sender.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct StreamId {
    /// The direction.
    pub flow: Flow,
    /// Cookie of the socket at which it was seen; 0 on an interface.
    pub socket: u64,
    /// Whether this host sent it; false in a capture.
    pub outgoing: bool,
    /// Number of the network namespace or capture that saw it.
    pub namespace: u32,
    /// Index of the interface; 0 = unknown.
    pub interface: u32,
}

impl StreamId {
    /// Returns whether the receiver is on the same host, by its address.
    #[must_use]
    pub fn is_loopback(&self) -> bool {
        let Flow {
            source,
            destination,
        } = self.flow;
        let is_own = source.address == destination.address;
        is_own || destination.socket_address().ip().is_loopback()
    }

    /// Returns the opposite direction at the same socket or interface. `outgoing` is a guess on an
    /// interface and in a capture file.
    #[must_use]
    pub const fn reversed(self) -> Self {
        Self {
            flow: self.flow.reversed(),
            outgoing: self.socket != 0 && !self.outgoing,
            ..self
        }
    }
}

/// Why messages or payloads of a connection cannot be read.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Unseen {
    /// The connection is encrypted.
    Tls,
    /// The link is QUIC. Connections between the same two addresses count as one, and its end is
    /// not seen.
    Quic,
    /// Another version of the wire format.
    Version,
    /// Batches are compressed.
    Compression,
    /// The transport has no sequence numbers and another framing.
    LowLatency,
    /// Payloads are in shared memory: they are counted, but their content is not seen.
    SharedMemory,
}

impl Unseen {
    /// All reasons.
    pub const ALL: [Self; 6] = [
        Self::Tls,
        Self::Quic,
        Self::Version,
        Self::Compression,
        Self::LowLatency,
        Self::SharedMemory,
    ];

    /// Returns the reason as words that follow "connections".
    #[must_use]
    pub const fn in_words(self) -> &'static str {
        match self {
            Self::Tls => "encrypted with TLS",
            Self::Quic => "encrypted with QUIC",
            Self::Version => "with another version of the wire format than 9",
            Self::Compression => "with compressed batches",
            Self::LowLatency => "with the low-latency transport",
            Self::SharedMemory => "with shared memory",
        }
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Tls => "tls",
            Self::Quic => "quic",
            Self::Version => "version",
            Self::Compression => "compression",
            Self::LowLatency => "low_latency",
            Self::SharedMemory => "shared_memory",
        }
    }
}

/// A report about one direction of a connection.
#[derive(Clone, Copy, Debug)]
pub struct StreamReport<'a> {
    /// Time of the TCP segment that completed it.
    pub time: Timestamp,
    /// The direction.
    pub stream: &'a StreamId,
    /// What happened.
    pub event: StreamEvent<'a>,
}

/// What happened in one direction of a connection.
#[derive(Clone, Copy, Debug)]
pub enum StreamEvent<'a> {
    /// A batch arrived whole.
    Batch {
        /// Its captured beginning, without the length prefix.
        bytes: &'a [u8],
        /// Its length.
        length: u16,
    },
    /// Captured bytes are missing. The next batch begins at a boundary that was found again.
    Gap,
    /// The connection begins. Earlier state of the same addresses belongs to another connection.
    Begin,
    /// The sender closed the connection, or its process ended.
    End,
    /// Its messages or payloads cannot be read.
    Unseen(Unseen),
}
