//! Chunks as the programs at the sockets write them, and as frames contain them.

use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::{Flow, StreamId};
use ros2probe_wire::Timestamp;
use ros2probe_wire::frame::{Packet, Segment};
use ros2probe_wire::host::{Piece, chunk};
use ros2probe_wire::record::flag;

use super::{Chunk, MissingBefore, Protocol};

/// Returns the direction to which a segment belongs.
#[must_use]
pub const fn flow(packet: &Packet<'_>, segment: &Segment<'_>) -> Flow {
    flow_of(packet, segment.source_port, segment.destination_port)
}

/// Returns the direction to which a packet with these ports belongs.
#[must_use]
pub const fn flow_of(packet: &Packet<'_>, source_port: u16, destination_port: u16) -> Flow {
    Flow {
        source: Destination {
            address: packet.source,
            port: source_port,
        },
        destination: Destination {
            address: packet.destination,
            port: destination_port,
        },
    }
}

impl<'a> Chunk<'a> {
    /// Returns a segment of a frame as a chunk.
    #[must_use]
    pub const fn of_segment(segment: &Segment<'a>, time: Timestamp, stream: StreamId) -> Self {
        Self {
            time,
            stream,
            sequence_number: segment.sequence_number,
            syn: segment.syn,
            end: segment.fin || segment.rst,
            boundary: None,
            before: MissingBefore::Unknown,
            bytes: segment.payload,
            length: segment.length,
        }
    }

    /// Reads a chunk and the bytes that follow it in the ring. `time` is its time in the wall
    /// clock.
    #[must_use]
    pub fn of_piece(piece: &Piece, bytes: &'a [u8], time: Timestamp) -> Self {
        let is = |bit| piece.chunk & bit != 0;
        let syn = is(chunk::SYN);
        let protocol = match is(chunk::RTPS) {
            true => Protocol::Rtps,
            false => Protocol::Zenoh,
        };
        let before = match (is(chunk::LOST), is(chunk::OVER_BUDGET), is(chunk::SKIPPED)) {
            (true, ..) => MissingBefore::Lost,
            (_, true, _) => MissingBefore::OverBudget,
            (.., true) => MissingBefore::Skipped,
            _ => MissingBefore::Unknown,
        };
        Self {
            time,
            stream: StreamId {
                flow: Flow {
                    source: Destination {
                        address: zerocopy::transmute!(piece.source),
                        port: piece.source_port,
                    },
                    destination: Destination {
                        address: zerocopy::transmute!(piece.destination),
                        port: piece.destination_port,
                    },
                },
                socket: piece.socket,
                outgoing: piece.flags & flag::OUTGOING != 0,
                ..StreamId::default()
            },
            // The programs do not pass on the SYN itself, but the first bytes after it.
            sequence_number: piece.datagram.wrapping_sub(u32::from(syn)),
            syn,
            end: is(chunk::END),
            boundary: is(chunk::BOUNDARY).then_some(protocol),
            before,
            bytes,
            length: piece
                .datagram_len
                .max(u32::try_from(bytes.len()).unwrap_or(u32::MAX)),
        }
    }
}
