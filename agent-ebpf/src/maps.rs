//! The filter's maps and per-CPU state.

use aya_ebpf::{
    macros::map,
    maps::{Array, HashMap, LruHashMap, PerCpuArray, RingBuf},
};
use ros2probe_wire::{
    Record,
    filter::{
        Counter, FLOW_CAPACITY, INTEREST_CAPACITY, INTERFACE_CAPACITY, PARTICIPANT_CAPACITY,
        RUN_CAPACITY, UNKNOWN_CAPACITY,
    },
    walk::Walk,
};

/// `BPF_F_NO_PREALLOC`: these maps are filled from user space only, and mostly empty.
const NO_PREALLOC: u32 = 1;

/// Records of one datagram that the filter writes itself; more make it capture the datagram.
pub const RECORDS_PER_DATAGRAM: u32 = 32;

/// Whether frames of an interface that is not in [`INTERFACES`] are looked at. Set by the loader.
#[unsafe(no_mangle)]
pub static NEW_INTERFACES: u32 = 1;
/// Ring bytes from which on a record wakes user space; below, user space polls. Set by the loader.
#[unsafe(no_mangle)]
pub static WAKE_BYTES: u64 = 128 * 1024;

/// Reads a setting that the loader may have changed.
macro_rules! setting {
    ($name:ident) => {{
        // SAFETY: a constant of the loaded object, never written while the program runs.
        unsafe { core::ptr::read_volatile(&raw const $crate::maps::$name) }
    }};
}
pub(crate) use setting;

/// Writers and readers that user space has classified: GUID to `Verdict`.
#[map]
pub static INTEREST: HashMap<[u32; 4], u32> =
    HashMap::with_max_entries(INTEREST_CAPACITY, NO_PREALLOC);
/// Participants that user space knows: GUID prefix to the time of their last message.
#[map]
pub static PARTICIPANTS: HashMap<[u32; 3], u64> =
    HashMap::with_max_entries(PARTICIPANT_CAPACITY, NO_PREALLOC);
/// Unclassified writers: bytes captured so far.
#[map]
pub static UNKNOWN: LruHashMap<[u32; 4], u32> = LruHashMap::with_max_entries(UNKNOWN_CAPACITY, 0);
/// What unclassified writers may still cost, by `filter::Budget`.
#[map]
pub static BUDGET: Array<i64> = Array::with_max_entries(2, 0);
/// Interfaces by index: 1 = look, 0 = leave out.
#[map]
pub static INTERFACES: HashMap<u32, u32> =
    HashMap::with_max_entries(INTERFACE_CAPACITY, NO_PREALLOC);
/// Fragmented datagrams in flight.
#[map]
pub static FLOWS: LruHashMap<FlowKey, Flow> = LruHashMap::with_max_entries(FLOW_CAPACITY, 0);
/// A flow that has seen nothing; never written.
#[map]
pub static NEW_FLOW: PerCpuArray<Flow> = PerCpuArray::with_max_entries(1, 0);
/// DATA_FRAGs of samples that are not complete yet, one after the other so far.
#[map]
pub static RUNS: HashMap<RunKey, Record> = HashMap::with_max_entries(RUN_CAPACITY, 0);
/// The CPU that last added to a run of a stream: a sender that moves on leaves its run behind.
#[map]
pub static RUN_CPUS: LruHashMap<Stream, u32> = LruHashMap::with_max_entries(RUN_CAPACITY, 0);
/// What user space reads a few times a second, or when it is half full.
#[map]
pub static RECORDS: RingBuf = RingBuf::with_byte_size(256 * 1024, 0);
/// By `filter::Counter`.
#[map]
pub static COUNTERS: PerCpuArray<u64> = PerCpuArray::with_max_entries(Counter::ALL.len() as u32, 0);
/// Keys that are too large for the stack.
#[map]
static RUN_KEYS: PerCpuArray<RunKeys> = PerCpuArray::with_max_entries(1, 0);
/// The frame at hand.
#[map]
static SCRATCH: PerCpuArray<Scratch> = PerCpuArray::with_max_entries(1, 0);

/// Names one fragmented datagram (RFC 791, RFC 8200 4.5), per interface and direction.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct FlowKey {
    pub source: [u32; 4],
    pub destination: [u32; 4],
    pub identification: u32,
    /// Interface index, and the highest bit for frames on their way out.
    pub interface: u32,
}

/// A writer's fragments to one destination.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Stream {
    pub writer: [u32; 4],
    pub destination: [u32; 4],
    pub destination_port: u32,
    /// Interface index, and the highest bit for frames on their way out.
    pub interface: u32,
    /// Cookie of the receiving or sending socket, where it is known.
    pub socket: [u32; 2],
}

/// A stream as one CPU sees it, so that no two CPUs ever add to the same run.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct RunKey {
    pub stream: Stream,
    pub cpu: u32,
}

/// Where [`RunKey`]s are put together.
#[repr(C)]
pub struct RunKeys {
    pub here: RunKey,
    pub elsewhere: RunKey,
}

/// What is known of a fragmented datagram so far.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Flow {
    pub walk: Walk,
    /// The last record found, written once the datagram is complete.
    pub pending: Record,
    pub born: u64,
    /// IP payload bytes seen.
    pub seen: u32,
    /// IP payload bytes in all, 0 until the last fragment has come.
    pub expected: u32,
    /// Starts of fragments seen, in cells of 512 bytes.
    pub cells: [u64; 2],
    pub state: u32,
    pub has_pending: u32,
    /// Records were sent ahead, so user space waits to hear that the datagram is complete.
    pub ahead: u32,
    pub token: u32,
}

/// The IP packet at hand.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Packet {
    pub source: [u32; 4],
    pub destination: [u32; 4],
    /// Offset of the IP payload in the socket buffer.
    pub body: u32,
    /// IP payload bytes in this frame.
    pub len: u32,
    /// Where they belong in the whole IP payload.
    pub offset: u32,
    /// More fragments follow.
    pub more: u32,
    pub identification: u32,
    pub fragmented: u32,
    pub ipv6: u32,
    pub outgoing: u32,
    pub interface: u32,
    pub unused: u32,
    pub now: u64,
}

/// Per-CPU working memory: too large for the 512 bytes of BPF stack.
#[repr(C)]
pub struct Scratch {
    pub walk: Walk,
    pub packet: Packet,
    pub records: [Record; RECORDS_PER_DATAGRAM as usize],
    /// How many of `records` are filled.
    pub count: u32,
    /// The capture is owed to an unclassified writer.
    pub unknown: u32,
}

/// This CPU's working memory.
#[inline(always)]
pub fn scratch() -> Option<&'static mut Scratch> {
    // SAFETY: one program run at a time uses a CPU's entry: packet taps run with bottom halves
    // disabled and do not nest.
    SCRATCH
        .get_ptr_mut(0)
        .map(|scratch| unsafe { &mut *scratch })
}

/// This CPU's keys.
#[inline(always)]
pub fn run_keys() -> Option<&'static mut RunKeys> {
    // SAFETY: as for `scratch`.
    RUN_KEYS.get_ptr_mut(0).map(|keys| unsafe { &mut *keys })
}

/// Adds to a counter of this CPU.
#[inline(always)]
pub fn count(counter: Counter, by: u64) {
    if let Some(value) = COUNTERS.get_ptr_mut(counter as u32) {
        // SAFETY: this CPU's own entry, see `scratch`.
        unsafe { *value += by }
    }
}

/// Copies a whole value from one map to another. Plain assignment would become a call of `memmove`,
/// a loop over bytes which some verifiers refuse.
#[inline(always)]
pub fn copy<T: Copy>(from: &T, to: &mut T) {
    // SAFETY: two references, one of them exclusive: valid, aligned and not overlapping.
    unsafe { core::ptr::copy_nonoverlapping(from, to, 1) }
}
