//! Maps of the programs, and the thread in which a program runs.

use core::{arch::asm, mem::MaybeUninit};

use aya_ebpf::{
    helpers::{bpf_get_current_pid_tgid, bpf_ktime_get_ns, generated::bpf_probe_read_user},
    macros::map,
    maps::{Array, HashMap, LruHashMap, PerCpuArray, RingBuf},
};
use ros2probe_wire::inside::{
    BUCKETS, Counter, Figures, HANDLE_CAPACITY, Handle, PROCESS_CAPACITY, Process, THREAD_CAPACITY,
    WAITING_CAPACITY, bucket, clock, distribution, state, thread_state,
};

use crate::{
    accounting::Accounting,
    instructions::{atomic_add, hide_bounds},
    settings::is_in_target_cgroup,
};

/// `BPF_NOEXIST`: the first of two threads with a new handle creates its figures.
const BPF_NOEXIST: u64 = 1;

/// Whether callbacks are observed. Set by the loader.
#[unsafe(no_mangle)]
pub static CALLBACKS: u32 = 0;

/// Observed processes by thread group id.
#[map]
static PROCESSES: HashMap<u32, Process> = HashMap::with_max_entries(PROCESS_CAPACITY, 0);
/// Figures by handle.
#[map]
static HANDLES: HashMap<Handle, Figures> = HashMap::with_max_entries(HANDLE_CAPACITY, 0);
/// The initial value of figures; never written.
#[map]
static NEW_FIGURES: Array<Figures> = Array::with_max_entries(1, 0);
/// The last calls of each thread, by thread id.
#[map]
static THREADS: LruHashMap<u32, Thread> = LruHashMap::with_max_entries(THREAD_CAPACITY, 0);
/// The initial value of a thread; never written.
#[map]
static NEW_THREAD: Array<Thread> = Array::with_max_entries(1, 0);
/// Times at which messages entered ring buffers.
#[map]
pub static WAITING: LruHashMap<Entry, u64> = LruHashMap::with_max_entries(WAITING_CAPACITY, 0);
/// Names and relations of handles, causal publications and late calls.
#[map]
pub static ANNOUNCEMENTS: RingBuf = RingBuf::with_byte_size(512 * 1024, 0);
/// Differences of other clocks to CLOCK_MONOTONIC in nanoseconds, by `inside::clock`. Set by user
/// space.
#[map]
static CLOCKS: Array<u64> = Array::with_max_entries(clock::COUNT, 0);
/// Counters by `inside::Counter`.
#[map]
static INSIDE_COUNTERS: PerCpuArray<[u64; Counter::ALL.len()]> =
    PerCpuArray::with_max_entries(1, 0);

/// The last calls of a thread, which explain its next events.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Thread {
    /// Handle that the executor executes; 0 = none.
    pub executing_handle: u64,
    /// Subscription or buffer from which the thread took a message last; kind 0 = none.
    pub input: Handle,
    /// Source timestamp of the message taken, nanoseconds since the Unix epoch.
    pub source_timestamp: u64,
    /// Time at which the message was taken.
    pub taken: u64,
    /// Time at which the message entered the ring buffer.
    pub enqueued_ns: u64,
    /// The running callback; 0 = none.
    pub callback: u64,
    /// Time at which the callback began.
    pub started: u64,
    /// Publisher whose message was passed within the process and may also go to the middleware.
    pub intra_process_publisher: u64,
    /// Whether the accounting of the thread was read when the callback began.
    pub has_accounting: u64,
    /// The accounting at that time.
    pub accounting_at_start: Accounting,
    /// The accounting at the end of the last callback, and what the thread did during it.
    pub accounting_at_end: Accounting,
    pub states: [u64; thread_state::COUNT],
}

/// A position in a ring buffer.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Entry {
    pub buffer: u64,
    pub process: u32,
    pub index: u32,
}

/// The running thread, and the state of its process.
pub struct CallContext {
    pub process: u32,
    pub thread: u32,
    state: *mut Process,
}

impl CallContext {
    /// Counts a call, and returns the thread that makes it; `None` if only the number of calls is
    /// counted.
    #[inline(always)]
    pub fn count_call() -> Option<Self> {
        let id = bpf_get_current_pid_tgid();
        let (process, thread) = ((id >> 32) as u32, id as u32);
        count(Counter::Hits);
        let state = match PROCESSES.get_ptr_mut(&process) {
            Some(state) => state,
            None => create_process(process)?,
        };
        // SAFETY: a map value pointer checked against null.
        atomic_add(unsafe { &raw mut (*state).hits }, 1);
        // SAFETY: as above.
        match unsafe { core::ptr::read_volatile(&raw const (*state).state) } {
            state::COUNTED => Some(Self {
                process,
                thread,
                state,
            }),
            state::SUSPENDED => {
                count(Counter::Suspended);
                None
            }
            _ => None,
        }
    }

    /// Returns the figures of a handle; creates them if necessary.
    #[inline(always)]
    pub fn figures(&self, address: u64, kind: u32) -> Option<*mut Figures> {
        let key = self.handle(address, kind);
        if let Some(figures) = HANDLES.get_ptr_mut(&key) {
            return Some(figures);
        }
        let new = NEW_FIGURES.get_ptr(0)?;
        // SAFETY: a map value pointer checked against null, of an element that is never written.
        let _ = HANDLES.insert(&key, unsafe { &*new }, BPF_NOEXIST);
        let figures = HANDLES.get_ptr_mut(&key);
        if figures.is_none() {
            count(Counter::HandlesFull);
            // SAFETY: as in `count_call`.
            atomic_add(unsafe { &raw mut (*self.state).refused }, 1);
        }
        figures
    }

    /// Returns the figures of a handle, if they exist.
    #[inline(always)]
    pub fn existing_figures(&self, address: u64, kind: u32) -> Option<*mut Figures> {
        HANDLES.get_ptr_mut(&self.handle(address, kind))
    }

    /// Removes the figures of a handle whose address belongs to a new object.
    #[inline(always)]
    pub fn remove_figures(&self, address: u64, kind: u32) {
        let _ = HANDLES.remove(&self.handle(address, kind));
    }

    /// Returns the last calls of this thread; creates an empty entry if necessary.
    #[inline(always)]
    pub fn thread(&self) -> Option<*mut Thread> {
        if let Some(thread) = THREADS.get_ptr_mut(&self.thread) {
            return Some(thread);
        }
        let new = NEW_THREAD.get_ptr(0)?;
        // SAFETY: as in `figures`.
        let _ = THREADS.insert(&self.thread, unsafe { &*new }, 0);
        THREADS.get_ptr_mut(&self.thread)
    }

    /// Returns the last calls of this thread, if any are remembered.
    #[inline(always)]
    pub fn existing_thread(&self) -> Option<*mut Thread> {
        THREADS.get_ptr_mut(&self.thread)
    }

    /// Returns the handle of an address in this process.
    #[inline(always)]
    pub fn handle(&self, address: u64, kind: u32) -> Handle {
        Handle {
            address,
            process: self.process,
            kind,
        }
    }

    /// Returns the offset of `rmw_handle` in this process's rcl structures; 0 = unknown.
    #[inline(always)]
    pub fn rmw_handle_offset(&self) -> u32 {
        // SAFETY: a map value pointer checked against null.
        unsafe { core::ptr::read_volatile(&raw const (*self.state).rmw_handle_at) }
    }

    /// Notes the offset of `rmw_handle` in this process.
    #[inline(always)]
    pub fn set_rmw_handle_offset(&self, offset: u32) {
        // SAFETY: as above; racing threads write the same value.
        unsafe { core::ptr::write_volatile(&raw mut (*self.state).rmw_handle_at, offset) }
    }

    /// Returns the offset of the period in this process's timers; 0 = unknown.
    #[inline(always)]
    pub fn timer_period_offset(&self) -> u32 {
        // SAFETY: as above.
        unsafe { core::ptr::read_volatile(&raw const (*self.state).timer_period_at) }
    }

    /// Notes the offset of the period in this process's timers.
    #[inline(always)]
    pub fn set_timer_period_offset(&self, offset: u32) {
        // SAFETY: as above; racing threads write the same value.
        unsafe { core::ptr::write_volatile(&raw mut (*self.state).timer_period_at, offset) }
    }
}

/// Creates the state of a process; `None` if the table is full.
#[inline(always)]
fn create_process(process: u32) -> Option<*mut Process> {
    let new = Process {
        hits: 0,
        refused: 0,
        state: if is_in_target_cgroup() {
            state::COUNTED
        } else {
            state::OUTSIDE
        },
        rmw_handle_at: 0,
        timer_period_at: 0,
        unused: 0,
    };
    let _ = PROCESSES.insert(&process, &new, BPF_NOEXIST);
    let state = PROCESSES.get_ptr_mut(&process);
    if state.is_none() {
        count(Counter::ProcessesFull);
    }
    state
}

/// Counts an event of a handle and adds the time since the last one to a distribution.
///
/// # Safety
/// `figures` is a map value.
#[inline(always)]
pub unsafe fn count_event(figures: *mut Figures, now: u64) {
    // SAFETY: as required of the caller.
    unsafe {
        atomic_add(&raw mut (*figures).count, 1);
        let last = core::ptr::read_volatile(&raw const (*figures).last);
        core::ptr::write_volatile(&raw mut (*figures).last, now);
        // Another thread may have read the clock in between.
        if last != 0 && now > last {
            record_duration(figures, distribution::INTERVAL, now - last);
        }
    }
}

/// Adds a duration to a distribution.
///
/// # Safety
/// `figures` is a map value.
#[inline(always)]
pub unsafe fn record_duration(figures: *mut Figures, which: usize, nanoseconds: u64) {
    // SAFETY: as required of the caller; `which` is one of two, and the bucket is masked below.
    unsafe {
        atomic_add(
            (&raw mut (*figures).sums).cast::<u64>().add(which),
            nanoseconds,
        );
        let maximum = (&raw mut (*figures).maxima).cast::<u64>().add(which);
        if core::ptr::read_volatile(maximum) < nanoseconds {
            core::ptr::write_volatile(maximum, nanoseconds);
        }
        let minimum = (&raw mut (*figures).minima).cast::<u64>().add(which);
        let minimum_plus_one = core::ptr::read_volatile(minimum);
        if minimum_plus_one == 0 || nanoseconds + 1 < minimum_plus_one {
            core::ptr::write_volatile(minimum, nanoseconds + 1);
        }
        let index = hide_bounds(bucket(nanoseconds) as u32) & 0x7f;
        if index < BUCKETS as u64 {
            let buckets = (&raw mut (*figures).buckets).cast::<u32>();
            atomic_increment(buckets.add(which * BUCKETS).add(index as usize));
        }
    }
}

/// Adds 1 to a field of a map value.
#[inline(always)]
fn atomic_increment(to: *mut u32) {
    let by = 1_u64;
    // SAFETY: as in `add`.
    unsafe {
        asm!(
            "lock *(u32 *)({to} + 0) += {by}",
            to = in(reg) to,
            by = in(reg) by,
            options(nostack),
        );
    }
}

/// Counts an event of the programs.
#[inline(always)]
pub fn count(counter: Counter) {
    if let Some(counters) = INSIDE_COUNTERS.get_ptr_mut(0) {
        // SAFETY: a map value pointer checked against null, and an index within the value.
        atomic_add(unsafe { counters.cast::<u64>().add(counter as usize) }, 1);
    }
}

/// Returns CLOCK_MONOTONIC in nanoseconds.
#[inline(always)]
pub fn now() -> u64 {
    // SAFETY: no preconditions.
    unsafe { bpf_ktime_get_ns() }
}

/// Converts CLOCK_MONOTONIC to nanoseconds since the Unix epoch; 0 before user space has set the
/// difference.
#[inline(always)]
pub fn realtime_ns(monotonic: u64) -> u64 {
    match clock_offset(clock::REALTIME) {
        0 => 0,
        difference => difference.wrapping_add(monotonic),
    }
}

/// Converts CLOCK_MONOTONIC to CLOCK_MONOTONIC_RAW.
#[inline(always)]
pub fn monotonic_raw_ns(monotonic: u64) -> u64 {
    clock_offset(clock::MONOTONIC_RAW).wrapping_add(monotonic)
}

#[inline(always)]
fn clock_offset(to: u32) -> u64 {
    match CLOCKS.get_ptr(to) {
        // SAFETY: a map value pointer checked against null.
        Some(difference) => unsafe { core::ptr::read_volatile(difference) },
        None => 0,
    }
}

/// Reads a plain value from the memory of the running process; zeros if it cannot be read.
///
/// The function returns no `Option`: LLVM would keep the value of a failed read on the stack,
/// uninitialized, and Linux 5.10 refuses a program that loads it.
#[inline(always)]
pub fn read_user<T: Copy>(address: u64) -> T {
    let mut value = MaybeUninit::<T>::uninit();
    // SAFETY: the destination has the size given; the kernel checks the address, and writes zeros
    // if it is wrong. Only integers and arrays of them are read.
    unsafe {
        bpf_probe_read_user(
            value.as_mut_ptr().cast(),
            size_of::<T>() as u32,
            address as *const _,
        );
        value.assume_init()
    }
}
