//! The filter's maps and per-CPU state.

use core::cell::UnsafeCell;
use core::ops::{Deref, DerefMut};

use aya_ebpf::{
    macros::map,
    maps::{Array, HashMap, LruHashMap, PerCpuArray, ProgramArray, RingBuf},
};
use ros2probe_wire::{
    Record,
    filter::{
        COUNTER_SLOTS, Counter, FLOW_CAPACITY, INTEREST_CAPACITY, INTERFACE_CAPACITY,
        PARTICIPANT_CAPACITY, RUN_CAPACITY, UNKNOWN_CAPACITY,
    },
    host::{PIECE_BYTES, Piece, SOCKET_CAPACITY, Socket},
    walk::Walk,
};

use crate::{
    instructions::{atomic_add, hide_bounds},
    settings::read_global,
};

/// `BPF_F_NO_PREALLOC`, for a map that only user space fills and that is mostly empty. No map of a
/// tracepoint or uprobe has the flag: before Linux 6.1 the kernel warns of it, and with PREEMPT_RT
/// the kernel refuses the program.
const NO_PREALLOC: u32 = 1;

/// Maximum number of records that the filter writes for one frame, or for one datagram at a
/// socket. A datagram with more is captured, if the ring has room for it.
pub const RECORDS_PER_DATAGRAM: u32 = 32;
const _: () = assert!(RECORDS_PER_DATAGRAM.is_power_of_two());

/// Number of slots: the maximum number of runs of programs that are active on one CPU, see
/// [`claim_egress_slot`]. Received datagrams and frames use the slots below [`FIRST_EGRESS_SLOT`],
/// sent datagrams the others.
pub const SCRATCH_SLOTS: u32 = 6;
const _: () = assert!((SCRATCH_SLOTS as usize) < COUNTER_SLOTS && COUNTER_SLOTS.is_power_of_two());
/// First slot for sent datagrams.
pub const FIRST_EGRESS_SLOT: u32 = 2;
/// Number of captures remembered per CPU, a power of two.
const RECENT_CAPACITY: u32 = 16;

/// Whether to read frames of an interface that is not in [`INTERFACES`]. Set by the loader.
#[unsafe(no_mangle)]
pub static NEW_INTERFACES: u32 = 1;
/// Fill level of [`RECORDS`], in bytes, above which a record wakes user space; below it user space
/// polls. Set by the loader.
#[unsafe(no_mangle)]
pub static WAKE_BYTES: u64 = 128 * 1024;
/// Fill level of [`PIECES`], in bytes, above which a piece wakes user space. Set by the loader.
#[unsafe(no_mangle)]
pub static WAKE_PIECE_BYTES: u64 = 512 * 1024;

/// Whether the kernel preempts code that runs with bottom halves disabled (PREEMPT_RT). Set by the
/// loader.
#[unsafe(no_mangle)]
pub static PREEMPTED: u32 = 1;

/// Whether programs may read packets in place: programs of packet sockets may not, others may. Set by
/// the loader.
#[unsafe(no_mangle)]
pub static IN_PLACE: u32 = 1;

/// The wire hook's program, which the short socket filter tail-calls. Set by the loader.
#[map]
pub static WIRE: ProgramArray = ProgramArray::with_max_entries(1, 0);
/// Writers and readers that user space has classified: GUID to `Verdict`.
#[map]
pub static INTEREST: HashMap<[u32; 4], u32> = HashMap::with_max_entries(INTEREST_CAPACITY, 0);
/// Participants that user space knows: GUID prefix to the time of their last message.
#[map]
pub static PARTICIPANTS: HashMap<[u32; 3], u64> =
    HashMap::with_max_entries(PARTICIPANT_CAPACITY, 0);
/// Unclassified writers: bytes captured so far.
#[map]
pub static UNKNOWN: LruHashMap<[u32; 4], Shared<u32>> =
    LruHashMap::with_max_entries(UNKNOWN_CAPACITY, 0);
/// Remaining budget of unclassified writers, by `filter::Budget`.
#[map]
pub static BUDGET: Array<Shared<i64>> = Array::with_max_entries(2, 0);
/// Interfaces by index: 1 = read, 0 = exclude.
#[map]
pub static INTERFACES: HashMap<u32, u32> =
    HashMap::with_max_entries(INTERFACE_CAPACITY, NO_PREALLOC);
/// Fragmented datagrams in flight.
#[map]
pub static FLOWS: LruHashMap<FlowKey, Flow> = LruHashMap::with_max_entries(FLOW_CAPACITY, 0);
/// The initial value of a flow; never written.
#[map]
pub static NEW_FLOW: PerCpuArray<Flow> = PerCpuArray::with_max_entries(1, 0);
/// Consecutive DATA_FRAGs of incomplete samples.
#[map]
pub static RUNS: HashMap<RunKey, Record> = HashMap::with_max_entries(RUN_CAPACITY, 0);
/// The CPU that last extended a stream's run, because a sender that moves to another CPU leaves its
/// run behind.
#[map]
pub static RUN_CPUS: LruHashMap<Stream, u32> = LruHashMap::with_max_entries(RUN_CAPACITY, 0);
/// Records for user space, read once a second or when the ring is half full.
#[map]
pub static RECORDS: RingBuf = RingBuf::with_byte_size(256 * 1024, 0);
/// Counters by slot and `filter::Counter`, read in one system call.
#[map]
pub static COUNTERS: PerCpuArray<[[u64; Counter::ALL.len()]; COUNTER_SLOTS]> =
    PerCpuArray::with_max_entries(1, 0);
/// Captured datagrams and messages in pieces, and chunks of TCP connections: [`PieceBuffer`]s cut
/// to their length.
#[map]
pub static PIECES: RingBuf = RingBuf::with_byte_size(1024 * 1024, 0);
/// Sockets with captured or metered datagrams, and sockets of recognized TCP connections, by
/// cookie.
#[map]
pub static SOCKETS: LruHashMap<u64, Socket> = LruHashMap::with_max_entries(SOCKET_CAPACITY, 0);
/// Keys that are too large for the stack, by slot.
#[map]
static RUN_KEYS: PerCpuArray<RunKeys> = PerCpuArray::with_max_entries(SCRATCH_SLOTS, 0);
/// Buffers for building pieces, by slot.
#[map]
static PIECE: PerCpuArray<PieceBuffer> = PerCpuArray::with_max_entries(SCRATCH_SLOTS, 0);
/// The current frame or datagram, by slot.
#[map]
static SCRATCH: PerCpuArray<Scratch> = PerCpuArray::with_max_entries(SCRATCH_SLOTS, 0);
/// Recent captures of this CPU, by hash.
#[map]
static RECENT: PerCpuArray<RecentCapture> = PerCpuArray::with_max_entries(RECENT_CAPACITY, 0);
/// The last datagram that a socket of this host received on this CPU.
#[map]
static LAST: PerCpuArray<LastReceived> = PerCpuArray::with_max_entries(1, 0);

/// A value that other runs read and write concurrently, on this CPU or others. No reference to the
/// value exists; it is only copied in and out.
#[repr(transparent)]
pub struct Shared<T>(UnsafeCell<T>);

// SAFETY: map values live in the kernel's memory, initialized to zero or by a copy. Runs that race
// may see each other's values or lose their own; each use states the effect.
unsafe impl<T> Sync for Shared<T> {}

impl<T: Copy> Shared<T> {
    /// Wraps a value for a map.
    #[inline(always)]
    pub const fn new(value: T) -> Self {
        Self(UnsafeCell::new(value))
    }

    /// Returns the value.
    #[inline(always)]
    pub fn get(&self) -> T {
        // SAFETY: valid and aligned, as `self` is.
        unsafe { self.0.get().read_volatile() }
    }

    /// Replaces the value.
    #[inline(always)]
    pub fn set(&self, value: T) {
        // SAFETY: as above.
        unsafe { self.0.get().write_volatile(value) }
    }

    /// Returns the address of the value.
    #[inline(always)]
    pub const fn as_ptr(&self) -> *mut T {
        self.0.get()
    }

    /// Copies a whole value out.
    #[inline(always)]
    pub fn load(&self, to: &mut T) {
        // SAFETY: as above; `to` is exclusive and does not overlap a map value.
        unsafe { core::ptr::copy_nonoverlapping(self.0.get(), to, 1) }
    }

    /// Copies a whole value in.
    #[inline(always)]
    pub fn store(&self, from: &T) {
        // SAFETY: as above; `from` is immutable and does not overlap a map value.
        unsafe { core::ptr::copy_nonoverlapping(from, self.0.get(), 1) }
    }
}

/// Identifies one fragmented datagram (RFC 791, RFC 8200 4.5), per interface and direction.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct FlowKey {
    pub source: [u32; 4],
    pub destination: [u32; 4],
    pub identification: u32,
    /// Interface index; the highest bit marks sent frames.
    pub interface: u32,
}

/// Identifies a writer's fragments to one destination.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Stream {
    pub writer: [u32; 4],
    pub destination: [u32; 4],
    pub destination_port: u32,
    /// Interface index; the highest bit marks sent frames.
    pub interface: u32,
    /// Cookie of the receiving or sending socket; 0 = unknown.
    pub socket: [u32; 2],
}

/// A stream as one CPU sees it, so that two CPUs never extend the same run.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct RunKey {
    pub stream: Stream,
    pub cpu: u32,
}

/// Buffers for building [`RunKey`]s, and the current run.
#[repr(C)]
pub struct RunKeys {
    pub this_cpu: RunKey,
    pub other_cpu: RunKey,
    pub run: Record,
}

/// State of a fragmented datagram.
#[repr(C)]
pub struct Flow {
    pub walk: Shared<Walk>,
    /// The last record found, written when the datagram is complete.
    pub pending_record: Shared<Record>,
    pub created_ns: Shared<u64>,
    /// IP payload bytes seen.
    pub received_bytes: Shared<u32>,
    /// Total IP payload bytes, 0 until the last fragment arrives.
    pub total_bytes: Shared<u32>,
    /// Start offsets of the fragments seen, one bit per 8 bytes (RFC 791): a link with a small MTU
    /// may cut fragments to this length.
    pub seen_offsets: [Shared<u64>; 128],
    pub state: Shared<u32>,
    pub has_pending_record: Shared<u32>,
    /// Whether records were written ahead, for which user space waits for the completion record.
    pub ahead: Shared<u32>,
    pub token: Shared<u32>,
    /// Offset in the UDP payload at which the walk continues; `u32::MAX` = the walk is over.
    pub walk_offset: Shared<u32>,
    /// Whether `pending_record` may be extended by the next submessage, see `walk::may_continue`.
    pub may_continue: Shared<u32>,
}

/// The current IP packet.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Packet {
    pub source: [u32; 4],
    pub destination: [u32; 4],
    /// Offset of the IP payload in the socket buffer.
    pub payload_offset: u32,
    /// IP payload bytes in this frame.
    pub len: u32,
    /// Offset of these bytes in the whole IP payload.
    pub fragment_offset: u32,
    /// 1 = more fragments follow.
    pub more_fragments: u32,
    pub identification: u32,
    pub is_fragment: u32,
    pub is_ipv6: u32,
    pub is_outgoing: u32,
    pub interface: u32,
    /// 1 = seen at a socket, 0 = seen on an interface.
    pub is_at_socket: u32,
    pub time_ns: u64,
}

/// Working memory of one run of a program, which is too large for the 512 bytes of the BPF stack.
#[repr(C)]
pub struct Scratch {
    pub walk: Walk,
    pub packet: Packet,
    pub records: [Record; RECORDS_PER_DATAGRAM as usize],
    /// The record of a fragmented datagram that is written next.
    pub pending_record: Record,
    /// Number of filled elements of `records`.
    pub record_count: u32,
    /// Whether user space has classified the endpoint that was looked up last.
    pub last_endpoint_is_classified: u32,
    /// Whether the capture is needed only for an unclassified writer.
    pub is_unknown_writer: u32,
    /// Host hook: whether a copy of the datagram was captured just before.
    pub is_duplicate: u32,
    /// The participant whose message was seen last, and the time of its last note in
    /// [`PARTICIPANTS`].
    pub last_participant: [u32; 3],
    pub last_participant_ns: u64,
    /// Host hook: the socket last looked up in [`SOCKETS`], and the time of the lookup.
    pub last_socket: u64,
    pub last_socket_lookup_ns: u64,
    /// Number of tokens issued for this slot.
    pub token_count: u32,
    /// Number of runs that hold this slot, or have failed to claim it and not withdrawn yet.
    claim_count: u64,
}

/// Identifies a captured datagram by the submessage that required the capture.
#[repr(C)]
pub struct RecentCapture {
    pub time: Shared<u64>,
    pub sequence_number: Shared<u64>,
    pub writer: [Shared<u32>; 4],
    pub fragment_start: Shared<u32>,
    pub datagram_len: Shared<u32>,
}

/// State that the host hook leaves for a program that runs directly afterwards on the same CPU, if
/// the datagram is not delivered. The datagram's records are still in the slot, because only
/// received datagrams use these slots, one after the other.
#[repr(C)]
pub struct LastReceived {
    /// The receiving socket; 0 = the datagram was not RTPS.
    pub socket: Shared<u64>,
    /// The datagram's token: equal to `scratch(slot).walk.record.datagram` unless the slot was
    /// reused.
    pub token: Shared<u32>,
    /// Slot of the working memory with the datagram's records, see `Scratch::record_count`.
    pub slot: Shared<u32>,
    /// 1 = captured: the slot holds no records.
    pub was_captured: Shared<u32>,
    pub unused: u32,
    /// Address of the kernel's packet, by which a drop of the packet is recognized.
    pub skb_address: Shared<u64>,
    /// The socket whose full buffer was already counted for this datagram.
    pub counted_socket: Shared<u64>,
}

/// A buffer for one piece of the maximum length.
#[repr(C)]
pub struct PieceBuffer {
    pub piece: Piece,
    pub bytes: [u8; PIECE_BYTES as usize],
}

/// Claims one of the slots for sent datagrams for this run of a program, until [`release_slot`].
///
/// Tasks send such datagrams, and other sending tasks may preempt them (the kernel only keeps a
/// task on its CPU). Atomics that return a value need Linux 5.12, so each run adds 1 to the slot's
/// claims and then reads them. All runs share a CPU and see the additions in one order, so at most
/// one run reads 1.
#[inline(always)]
pub fn claim_egress_slot() -> Option<u32> {
    claim_slot(FIRST_EGRESS_SLOT, SCRATCH_SLOTS)
}

/// Returns whether the kernel preempts code that runs with bottom halves disabled.
#[inline(always)]
pub fn is_preempted() -> bool {
    read_global(&PREEMPTED) != 0
}

/// Claims a slot as [`claim_egress_slot`] does, for frames and received datagrams. Programs for
/// these run with bottom halves disabled, one after the other, except on kernels that preempt such
/// code.
#[inline(always)]
pub fn claim_ingress_slot() -> Option<u32> {
    if read_global(&PREEMPTED) == 0 {
        return Some(0);
    }
    claim_slot(0, FIRST_EGRESS_SLOT)
}

#[inline(always)]
fn claim_slot(first: u32, end: u32) -> Option<u32> {
    let mut slot = first;
    while slot < end {
        if let Some(scratch) = SCRATCH.get_ptr_mut(slot) {
            // SAFETY: a map value pointer checked against null; only this function and
            // `release_slot` access `claim_count`, by its address.
            let claim_count = unsafe { &raw mut (*scratch).claim_count };
            atomic_add(claim_count, 1);
            // SAFETY: as above.
            if unsafe { core::ptr::read_volatile(claim_count) } == 1 {
                return Some(slot);
            }
            atomic_add(claim_count, u64::MAX);
        }
        slot += 1;
    }
    count_without_slot(Counter::Contended, 1);
    None
}

/// Releases a slot.
#[inline(always)]
pub fn release_slot(slot: u32) {
    if read_global(&PREEMPTED) == 0 && slot < FIRST_EGRESS_SLOT {
        return;
    }
    if let Some(scratch) = SCRATCH.get_ptr_mut(slot) {
        // SAFETY: a map value pointer checked against null.
        atomic_add(unsafe { &raw mut (*scratch).claim_count }, u64::MAX);
    }
}

/// Working memory of a run, in a map. A reference to it lasts for one access, and a called function
/// looks the memory up itself.
pub struct ScratchRef<T>(*mut T);

impl<T> Clone for ScratchRef<T> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for ScratchRef<T> {}

impl<T> ScratchRef<T> {
    /// Returns the value of an entry of a map, which the caller has claimed.
    #[inline(always)]
    pub fn lookup(map: &PerCpuArray<T>, index: u32) -> Option<Self> {
        map.get_ptr_mut(index).map(Self)
    }

    /// Returns the working memory.
    #[inline(always)]
    pub fn get(&mut self) -> &mut T {
        self
    }
}

impl<T> Deref for ScratchRef<T> {
    type Target = T;

    #[inline(always)]
    fn deref(&self) -> &T {
        // SAFETY: a map value pointer checked against null; the run that has claimed the entry uses
        // it alone.
        unsafe { &*self.0 }
    }
}

impl<T> DerefMut for ScratchRef<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as above.
        unsafe { &mut *self.0 }
    }
}

/// Returns the working memory of a slot.
#[inline(always)]
pub fn scratch(slot: u32) -> Option<ScratchRef<Scratch>> {
    ScratchRef::lookup(&SCRATCH, slot)
}

/// Returns the keys of a slot.
#[inline(always)]
pub fn run_keys(slot: u32) -> Option<ScratchRef<RunKeys>> {
    ScratchRef::lookup(&RUN_KEYS, slot)
}

/// Returns the piece buffer of a slot.
#[inline(always)]
pub fn piece_buffer(slot: u32) -> Option<ScratchRef<PieceBuffer>> {
    ScratchRef::lookup(&PIECE, slot)
}

/// Returns the run with this key, if it exists.
#[inline(always)]
pub fn fragment_run(key: &RunKey) -> Option<&'static Shared<Record>> {
    // SAFETY: a map value pointer checked against null; a `Shared<Record>` is laid out as a
    // `Record`.
    RUNS.get_ptr_mut(key).map(|run| unsafe { &*run.cast() })
}

/// Returns the entry for captures with this hash. Runs that interrupt each other here may capture
/// one more copy. They may also store a mixture of two captures, which matches no datagram.
#[inline(always)]
pub fn recent_capture(hash: u32) -> Option<&'static RecentCapture> {
    RECENT.get(hash & (RECENT_CAPACITY - 1))
}

/// Returns this CPU's last received datagram. A CPU handles received datagrams one after the other.
/// A program for a dropped packet may read the value between two of them.
#[inline(always)]
pub fn last_received() -> Option<&'static LastReceived> {
    LAST.get(0)
}

/// Adds to a counter of this CPU and slot.
#[inline(always)]
pub fn count(slot: u32, counter: Counter, by: u64) {
    if let Some(counter) = counter_ptr(slot, counter) {
        // SAFETY: in a map value, of a slot that this run holds.
        unsafe { *counter += by }
    }
}

/// Adds to a counter of this CPU outside of slots.
#[inline(always)]
pub fn count_without_slot(counter: Counter, by: u64) {
    if let Some(counter) = counter_ptr(SCRATCH_SLOTS, counter) {
        atomic_add(counter, by);
    }
}

#[inline(always)]
fn counter_ptr(slot: u32, counter: Counter) -> Option<*mut u64> {
    let counters = COUNTERS.get_ptr_mut(0)?;
    let slot = hide_bounds(slot) as usize & (COUNTER_SLOTS - 1);
    let index = slot * Counter::ALL.len() + counter as usize;
    // SAFETY: a map value pointer checked against null, and an index within the value.
    Some(unsafe { counters.cast::<u64>().add(index) })
}

/// Copies a whole value from one map to another. Plain assignment would become a call of `memmove`,
/// which is a loop over bytes that some verifiers refuse.
#[inline(always)]
pub fn copy<T: Copy>(from: &T, to: &mut T) {
    // SAFETY: two references, one of them exclusive: valid, aligned and not overlapping.
    unsafe { core::ptr::copy_nonoverlapping(from, to, 1) }
}
