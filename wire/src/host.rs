//! What the host hook gives user space besides records: captured datagrams in pieces, and what it
//! knows of the sockets that receive and send them.
//!
//! Shared binary layout with the kernel program. Words are in the host's byte order except where
//! they hold wire bytes (addresses).

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Bytes of a datagram in one piece. The largest UDP payload (65,507) comes in four.
pub const PIECE_BYTES: u32 = 16_384;
/// Sockets that the hook remembers.
pub const SOCKET_CAPACITY: u32 = 4_096;

/// One piece of a captured datagram; the bytes follow. Pieces of one datagram come in order of
/// their offset and bear the same token; other datagrams' pieces may lie between them. A datagram
/// whose last piece does not come lacked room in the ring.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Piece {
    /// CLOCK_MONOTONIC nanoseconds.
    pub time: u64,
    /// Cookie of the receiving or sending socket.
    pub socket: u64,
    /// Source address, 16 wire bytes, IPv4-mapped for IPv4.
    pub source: [u32; 4],
    /// Destination address likewise.
    pub destination: [u32; 4],
    /// Source UDP port.
    pub source_port: u16,
    /// Destination UDP port.
    pub destination_port: u16,
    /// Interface index in the socket's network namespace.
    pub interface: u32,
    /// Names the datagram among those of the last seconds, as [`crate::Record::datagram`] does.
    pub datagram: u32,
    /// Length of the whole UDP payload.
    pub datagram_len: u32,
    /// Where in the UDP payload this piece belongs.
    pub offset: u32,
    /// Bytes that follow, at most [`PIECE_BYTES`].
    pub len: u32,
    /// Bits of [`crate::record::flag`].
    pub flags: u16,
    /// Zero.
    pub unused: [u16; 3],
}

const _: () = assert!(size_of::<Piece>() == 80 && align_of::<Piece>() == 8);

/// What the hook knows of a socket, by cookie.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Socket {
    /// Id of the cgroup it was created in: the inode of that cgroup's directory.
    pub cgroup: u64,
    /// Datagrams that it had no room for, RTPS or not.
    pub no_room: u64,
}
