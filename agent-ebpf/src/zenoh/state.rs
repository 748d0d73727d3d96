//! Maps of the TCP connections of Zenoh and RTPS, and the working memory of a run.

use aya_ebpf::{
    helpers::generated::bpf_jiffies64,
    macros::map,
    maps::{Array, LruHashMap, PerCpuArray},
};
use ros2probe_wire::{
    filter::{CANDIDATE_CAPACITY, CONNECTION_CAPACITY, PORT_CAPACITY},
    zenoh_stream::Lanes,
};

use crate::{
    instructions::hide_bounds,
    maps::{SCRATCH_SLOTS, ScratchRef, Shared, piece_buffer},
};

/// Maximum number of bytes of a batch that are read: enough for all headers of a sample, and a
/// power of two.
pub const WINDOW: u32 = 512;

/// TCP ports of Zenoh; 0 = unused. Set by the loader.
#[unsafe(no_mangle)]
pub static ZENOH_PORTS: [u16; PORT_CAPACITY] = [7447, 0, 0, 0, 0, 0, 0, 0];

/// Directions of recognized TCP connections: of Zenoh, of RTPS, and of TLS on a port of Zenoh.
#[map]
pub static CONNECTIONS: LruHashMap<Key, Direction> =
    LruHashMap::with_max_entries(CONNECTION_CAPACITY, 0);
/// Directions of other connections that may be of Zenoh.
#[map]
pub static CANDIDATES: LruHashMap<Key, Direction> =
    LruHashMap::with_max_entries(CANDIDATE_CAPACITY, 0);
/// Time at which a socket was last in one of the tables, by hash of its cookie. Most sockets are in
/// neither table, and this array is faster to look up.
#[map]
static NOTED: Array<Shared<u32>> = Array::with_max_entries(NOTED_ENTRIES, 0);
/// Number of entries of [`NOTED`], a power of two.
const NOTED_ENTRIES: u32 = 16_384;
/// Lifetime of an entry in jiffies, of which a second has 100 to 1000: longer than the pause
/// between two KEEP_ALIVEs.
const NOTED_JIFFIES: u32 = 600_000;
/// Whether a connection of RTPS was found on this host.
#[map]
static ANY_RTPS: Array<Shared<u32>> = Array::with_max_entries(1, 0);
/// The current segment, by slot.
#[map]
static SEGMENT: PerCpuArray<Segment> = PerCpuArray::with_max_entries(SCRATCH_SLOTS, 0);

/// How a direction is read.
pub mod mode {
    /// The boundaries of batches are known.
    pub const SYNCHRONIZED: u32 = 0;
    /// A boundary was lost: all bytes are passed on until it is found again.
    pub const RESYNCHRONIZING: u32 = 1;
    /// No batch of the direction can be read.
    pub const UNREADABLE: u32 = 2;
}

/// Protocols of a direction.
pub mod protocol {
    pub const ZENOH: u32 = 0;
    /// The batches are frames of RTPS.
    pub const RTPS: u32 = 1;
}

/// The part of a batch that is passed on.
pub mod body {
    /// The beginning only.
    pub const HEAD: u32 = 0;
    /// Everything.
    pub const WHOLE: u32 = 1;
    /// No byte.
    pub const SKIPPED: u32 = 2;
}

/// Bits of [`Direction::fragment_state`].
pub mod fragment_state {
    /// The last FRAGMENT has a successor.
    pub const OPEN: u32 = 1;
    /// All fragments of the message are passed on whole.
    pub const WHOLE: u32 = 2;
    /// No fragment of the message is passed on.
    pub const SKIPPED: u32 = 4;
    /// With `SKIPPED`: because the budget of unknown publishers was spent.
    pub const OVER_BUDGET: u32 = 8;
}

/// Identifies a direction of a connection at a socket.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Key {
    /// Cookie of the socket; on an interface a hash of the addresses.
    pub socket: u64,
    /// Source port and destination port.
    pub ports: u32,
    /// 1 = the socket sends in this direction, 0 = the socket receives, 2 = seen on an interface.
    pub outgoing: u32,
}

/// The supposed batches of a direction that may be of Zenoh.
// Aligned, so that it is copied in few steps: the stack is small.
#[repr(C, align(8))]
#[derive(Clone, Copy)]
pub struct SyncCandidate {
    /// Sequence number of the next batch.
    pub next_batch_seq: u32,
    /// Sequence number of the next byte.
    pub next_seq: u32,
    /// Whether the other fields are valid.
    pub is_valid: u32,
    /// Sequence numbers of the lanes of the batches.
    pub lanes: Lanes,
}

/// State of one direction.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Direction {
    /// Time at which a chunk was last written.
    pub last_chunk_ns: u64,
    /// One of [`mode`].
    pub mode: u32,
    /// Sequence number of the next byte.
    pub next_seq: u32,
    /// Sequence number of the next batch.
    pub next_batch_seq: u32,
    /// Sequence number after the last byte that a chunk covers.
    pub forwarded_seq: u32,
    /// The part of the current batch that is passed on, one of [`body`].
    pub body: u32,
    /// Bits of [`fragment_state`].
    pub fragment_state: u32,
    /// Of Zenoh the first byte of a length, with bit 8 set, if the last segment ended after it. Of
    /// RTPS the number of bytes of a header at whose middle the last segment ended.
    pub split_prefix: u32,
    /// Flags of the next chunk.
    pub pending_flags: u32,
    /// Bytes passed on since a boundary was lost.
    pub gap_bytes: u32,
    /// Sequence number of the first byte that was missing when the boundary was lost.
    pub gap_start_seq: u32,
    /// Number of missing bytes that begin at `gap_start_seq`, which TCP may retransmit.
    pub gap_len: u32,
    /// One of [`protocol`].
    pub protocol: u32,
    /// Of RTPS, the bytes of a frame's length that the last segment had, if `split_prefix` is set.
    /// Otherwise the number of bytes of the frame's head that it did not have.
    pub partial_length: u32,
    /// Time at which the connection's state was last passed on, in units of 2^30 nanoseconds.
    pub last_link_report: u32,
    pub candidate: SyncCandidate,
}

/// The current TCP segment, and the values read from its current batch.
#[repr(C)]
pub struct Segment {
    pub key: Key,
    pub state: Direction,
    pub source: [u32; 4],
    pub destination: [u32; 4],
    pub now: u64,
    pub source_port: u32,
    pub destination_port: u32,
    pub interface: u32,
    /// Sequence number of the first byte.
    pub sequence_number: u32,
    /// Offset of the payload in the socket buffer.
    pub body: u32,
    /// Length of the payload.
    pub len: u32,
    /// Position of the reader in the window.
    pub position: u32,
    /// Bytes in the window.
    pub window_len: u32,
    /// Offset in the payload of the window's first byte.
    pub window: u32,
    /// The number that was read last.
    pub varint: u32,
    /// Position after the header of a FRAME or FRAGMENT.
    pub message: u32,
    /// Values of the extensions.
    pub priority: u32,
    pub is_first: u32,
    pub is_shared: u32,
    /// Whether the message is a sample, even if its header cannot be read.
    pub is_sample: u32,
    /// Offset of the attachment in the window; 0 = none.
    pub attachment: u32,
    pub attachment_len: u32,
    /// Offset of the sample's payload in the window; 0 = the message is not a sample, or is
    /// unreadable.
    pub payload: u32,
    /// Length of that payload.
    pub payload_len: u32,
    /// Length of the current batch with its prefix.
    pub batch_len: u32,
    /// Whether the batch is only examined, so that its sample does not matter.
    pub is_probe: u32,
    /// Whether user space should read the batch soon.
    pub wakes_reader: u32,
    /// Number of bytes of the batch to pass on; `u32::MAX` = all.
    pub forward_len: u32,
    /// Whether no byte is wanted because the budget of unknown publishers was spent.
    pub is_over_budget: u32,
    /// Key of the batch's lane; 0 = the batch has no lane.
    pub lane: u32,
    /// Sequence number in the lane.
    pub lane_sequence_number: u32,
    /// Address of the sending socket, while its state is read.
    pub socket_address: u64,
}

/// Returns whether a connection of RTPS was found on this host.
#[inline(always)]
pub fn is_any_rtps() -> bool {
    match ANY_RTPS.get(0) {
        Some(found) => found.get() != 0,
        None => false,
    }
}

/// Records that a connection of RTPS was found on this host.
#[inline(always)]
pub fn found_rtps() {
    if let Some(found) = ANY_RTPS.get(0) {
        found.set(1);
    }
}

/// Returns whether a socket may be in one of the tables.
#[inline(always)]
pub fn is_tracked_socket(socket: u64) -> bool {
    let Some(at) = NOTED.get(tracked_socket_index(socket)) else {
        return false;
    };
    // SAFETY: no preconditions.
    let now = unsafe { bpf_jiffies64() } as u32 | 1;
    at.get() != 0 && now.wrapping_sub(at.get()) < NOTED_JIFFIES
}

/// Notes that a socket is in one of the tables.
#[inline(always)]
pub fn track_socket(socket: u64) {
    if let Some(at) = NOTED.get(tracked_socket_index(socket)) {
        // SAFETY: no preconditions.
        at.set(unsafe { bpf_jiffies64() } as u32 | 1);
    }
}

#[inline(always)]
fn tracked_socket_index(socket: u64) -> u32 {
    (socket ^ socket >> 14 ^ socket >> 28) as u32 & (NOTED_ENTRIES - 1)
}

/// Returns the working memory of a slot.
#[inline(always)]
pub fn segment(slot: u32) -> Option<ScratchRef<Segment>> {
    ScratchRef::lookup(&SEGMENT, slot)
}

/// The first bytes of the current batch, in a piece's buffer.
#[derive(Clone, Copy)]
pub struct Window(*const u8);

impl Window {
    /// Returns the window of a slot.
    #[inline(always)]
    pub fn of(slot: u32) -> Option<Self> {
        piece_buffer(slot).map(|buffer| Self(buffer.bytes.as_ptr()))
    }

    /// Returns the byte at `at`; `None` if `at` is not below `end`.
    #[inline(always)]
    pub fn byte(self, at: u32, end: u32) -> Option<u32> {
        if at >= end || at >= WINDOW {
            return None;
        }
        let at = hide_bounds(at) as usize & (WINDOW as usize - 1);
        // SAFETY: the buffer is longer than the window.
        Some(u32::from(unsafe { *self.0.add(at) }))
    }

    /// Returns the four words at `at`.
    #[inline(always)]
    pub fn words(self, at: u32) -> [u32; 4] {
        let at = hide_bounds(at) as usize & (WINDOW as usize - 1);
        // SAFETY: the buffer is longer than the window and these words; this machine reads words at
        // any address.
        unsafe { *self.0.add(at).cast() }
    }
}
