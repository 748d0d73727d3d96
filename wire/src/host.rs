//! Output of the host hook besides records: captured datagrams in pieces, chunks of TCP
//! connections, and the sockets that receive and send them.
//!
//! The kernel program shares this binary layout. Words are in the host's byte order unless they
//! hold wire bytes (addresses).

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Maximum number of bytes in one piece of a datagram. The largest UDP payload (65,507 bytes) needs
/// four pieces.
pub const PIECE_BYTES: u32 = 16_384;
/// Maximum number of sockets that the hook remembers.
pub const SOCKET_CAPACITY: u32 = 4_096;

/// Bits of [`Piece::chunk`].
pub mod chunk {
    /// A batch begins with the first byte of the chunk.
    pub const BOUNDARY: u16 = 1;
    /// The bytes before the chunk were left out on purpose, because their samples are not needed.
    pub const SKIPPED: u16 = 1 << 1;
    /// Bytes before the chunk were seen but could not be passed on, or could not be parsed.
    pub const LOST: u16 = 1 << 2;
    /// The connection begins with the chunk.
    pub const SYN: u16 = 1 << 3;
    /// The sender sends no bytes after the chunk.
    pub const END: u16 = 1 << 4;
    /// The chunk is the beginning of a UDP datagram with an Initial packet of QUIC.
    pub const QUIC: u16 = 1 << 5;
    /// The connection is one of RTPS over TCP, not of Zenoh.
    pub const RTPS: u16 = 1 << 6;
    /// The bytes are not of the connection: they are a [`super::Link`] of it.
    pub const LINK: u16 = 1 << 7;
    /// With [`SKIPPED`]: the bytes have samples of publishers that are not known yet, and the budget
    /// for those was spent. The samples may be needed.
    pub const OVER_BUDGET: u16 = 1 << 8;
    /// The client of the connection begins a handshake of TLS. The chunk has no bytes.
    pub const CLIENT_HELLO: u16 = 1 << 9;
}

/// The sender's state of a TCP connection (`struct bpf_tcp_sock` in `linux/bpf.h`, and `unsent`).
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Link {
    /// Smoothed round trip time in microseconds (RFC 6298).
    pub smoothed_rtt: u32,
    /// Number of retransmitted segments since the connection began.
    pub retransmitted: u32,
    /// Number of sent segments with data since the connection began, retransmitted ones included.
    pub sent: u32,
    /// Number of bytes that were sent and are not acknowledged.
    pub unacknowledged: u32,
    /// Number of bytes that the application has written and the kernel has not sent yet.
    pub unsent: u32,
    /// Zero if the number of unsent bytes is unknown.
    pub unsent_known: u32,
}

/// Header of one piece of a captured datagram; the bytes follow. Pieces of one datagram arrive in
/// order of their offset with the same token, possibly between pieces of other datagrams. If the
/// last piece is missing, the ring was full, or the bytes could not be read.
///
/// With [`crate::record::flag::STREAM`] the piece is a chunk of a TCP connection, or the head of a
/// QUIC datagram.
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
    /// Destination address, in the same form.
    pub destination: [u32; 4],
    /// Source port.
    pub source_port: u16,
    /// Destination port.
    pub destination_port: u16,
    /// Interface index in the socket's network namespace.
    pub interface: u32,
    /// Token of the datagram, unique for some seconds, as in [`crate::Record::datagram`]. For a
    /// chunk: the TCP sequence number of its first byte.
    pub datagram: u32,
    /// Length of the whole UDP payload, or of the chunk.
    pub datagram_len: u32,
    /// Offset of this piece in the UDP payload; 0 for a chunk, of which possibly only the beginning
    /// follows.
    pub offset: u32,
    /// Number of bytes that follow, at most [`PIECE_BYTES`].
    pub len: u32,
    /// Bits of [`crate::record::flag`].
    pub flags: u16,
    /// Bits of [`chunk`].
    pub chunk: u16,
    /// Zero.
    pub unused: [u16; 2],
}

const _: () = assert!(size_of::<Piece>() == 80 && align_of::<Piece>() == 8);

/// State of a socket, by cookie.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Socket {
    /// Id of the cgroup in which the socket was created: the inode of that cgroup's directory.
    pub cgroup: u64,
    /// Datagrams dropped at the socket's full buffer, RTPS or not.
    pub rcvbuf_errors: u64,
    /// 1 = a TCP socket, whose drop counter counts no datagrams.
    pub is_stream: u64,
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
    /// Zero if the location of the kernel's drop counter is unknown.
    pub drops_known: u32,
    /// Process id in the initial PID namespace.
    pub process_id: u32,
    /// Process id in the process's own PID namespace, which differs in a container.
    pub own_process_id: u32,
    /// Name of the process, padded with zeros.
    pub name: [u8; 16],
}

const _: () = assert!(size_of::<Owner>() == 48 && align_of::<Owner>() == 8);

/// Members of the running kernel's types that the programs read. The value is the index in the
/// programs' `LAYOUT` array, which the loader fills with byte offsets and enumerators.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Layout {
    /// `sk_buff.head`, the start of a packet's bytes.
    BufferHead = 0,
    /// `sk_buff.tail`: bytes from the head to the end of the linear part.
    BufferTail,
    /// `sk_buff.network_header`: bytes from the head to the IP header.
    BufferNetworkHeader,
    /// `sk_buff.transport_header`: bytes from the head to the UDP header.
    BufferTransportHeader,
    /// `sk_buff.skb_iif`: the receiving interface.
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
    /// `net.ipv4.fqdir`: the incomplete IPv4 datagrams of a network namespace.
    NamespaceFragments4,
    /// `net.ipv6.fqdir`: the incomplete IPv6 datagrams of a network namespace.
    NamespaceFragments6,
    /// `fqdir.mem`: bytes in use for fragments.
    FragmentsMemory,
    /// `fqdir.high_thresh`: limit of `fqdir.mem`.
    FragmentsLimit,
    /// `sock.__sk_common.skc_cookie`.
    SocketCookie,
    /// `sock.sk_drops`.
    SocketDrops,
    /// `sock.sk_drop_counters`, used instead of `sk_drops` if it is not null (Linux 6.18).
    SocketDropCounters,
    /// Distance between the two counters of `numa_drop_counters`, in bytes.
    SecondDropCounter,
    /// `sock.sk_receive_queue.qlen`: datagrams in the receive buffer.
    SocketQueue,
    /// `udp_sock.reader_queue.qlen`: datagrams that readers have taken over from the receive buffer.
    ReaderQueue,
    /// `file.f_inode`.
    FileInode,
    /// `file.private_data`: the `socket` of a socket's file.
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
    /// `pid.level`: nesting depth of its PID namespace.
    PidLevel,
    /// `pid.numbers[0].nr`.
    PidNumbers,
    /// Size of an element of `pid.numbers`, in bytes.
    PidNumberSize,
    /// `tcp_sock.write_seq`: the sequence number after the last byte that the application wrote.
    TcpWritten,
}

impl Layout {
    /// Number of entries.
    pub const COUNT: usize = Self::TcpWritten as usize + 1;
    /// Marks a member that the running kernel does not have or does not describe.
    pub const ABSENT: u32 = u32::MAX;
}
