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

/// A process that holds a socket, as the iterator over open files writes it.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Owner {
    /// Cookie of the socket; never 0.
    pub socket: u64,
    /// Inode of the socket, as `/proc/<pid>/fd` shows it.
    pub inode: u64,
    /// Datagrams that the socket has dropped, as `/proc/net/udp` shows them.
    pub drops: u32,
    /// Zero where the kernel does not say where it counts `drops`.
    pub drops_known: u32,
    /// Process id as the host's first process sees it.
    pub process_id: u32,
    /// Process id as the process itself sees it: another one in a container.
    pub own_process_id: u32,
    /// Name of the process, filled up with zeros.
    pub name: [u8; 16],
}

const _: () = assert!(size_of::<Owner>() == 48 && align_of::<Owner>() == 8);

/// Places in the running kernel's types that the programs read, by index in their `LAYOUT` array:
/// offsets of members in bytes, enumerators. Filled in by the loader.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Layout {
    /// `sk_buff.head`, where a packet's bytes begin.
    BufferHead = 0,
    /// `sk_buff.tail`: bytes from the head to the end of the linear part.
    BufferTail,
    /// `sk_buff.network_header`: bytes from the head to the IP header.
    BufferNetworkHeader,
    /// `sk_buff.transport_header`: bytes from the head to the UDP header.
    BufferTransportHeader,
    /// `sk_buff.skb_iif`: the interface it came in on.
    BufferInterface,
    /// `SKB_DROP_REASON_SOCKET_RCVBUFF`.
    ReasonBufferFull,
    /// `SKB_DROP_REASON_PROTO_MEM`.
    ReasonMemory,
    /// `SKB_DROP_REASON_FRAG_REASM_TIMEOUT`.
    ReasonTimeout,
    /// `SKB_DROP_REASON_FRAG_TOO_FAR`.
    ReasonTooFar,
    /// `SKB_DROP_REASON_NOT_SPECIFIED`.
    ReasonNone,
    /// `sk_buff.dev`.
    BufferDevice,
    /// `net_device.nd_net`: its network namespace.
    DeviceNamespace,
    /// `net.ipv4.fqdir`: all fragments over IPv4 that wait in a network namespace.
    NamespaceFragments4,
    /// `net.ipv6.fqdir`.
    NamespaceFragments6,
    /// `fqdir.mem`: bytes that they take.
    FragmentsMemory,
    /// `fqdir.high_thresh`: bytes that they may take.
    FragmentsLimit,
    /// `sock.__sk_common.skc_cookie`.
    SocketCookie,
    /// `sock.sk_drops`.
    SocketDrops,
    /// `sock.sk_drop_counters`, instead of the former where it is not null (Linux 6.18).
    SocketDropCounters,
    /// Bytes between the two counters of `numa_drop_counters`.
    SecondDropCounter,
    /// `file.f_inode`.
    FileInode,
    /// `file.private_data`: of a socket's file, the `socket`.
    FilePrivate,
    /// `inode.i_mode`.
    InodeMode,
    /// `inode.i_ino`.
    InodeNumber,
    /// `socket.file`.
    SocketFile,
    /// `socket.sk`.
    SocketSock,
    /// `task_struct.group_leader`.
    TaskLeader,
    /// `task_struct.tgid`.
    TaskProcess,
    /// `task_struct.comm`.
    TaskName,
    /// `task_struct.thread_pid`.
    TaskPid,
    /// `pid.level`: how many process id namespaces lie above its own.
    PidLevel,
    /// `pid.numbers[0].nr`.
    PidNumbers,
    /// Bytes of one of `pid.numbers`.
    PidNumberSize,
}

impl Layout {
    /// How many places there are.
    pub const COUNT: usize = Self::PidNumberSize as usize + 1;
    /// What the running kernel does not have, or does not tell.
    pub const ABSENT: u32 = u32::MAX;
}
