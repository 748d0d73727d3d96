//! Late calls of callbacks: calls beyond the bounds that user space has set.

use core::ptr::{copy_nonoverlapping, read_volatile, write_volatile};

use aya_ebpf::{
    helpers::bpf_get_smp_processor_id,
    macros::map,
    maps::{Array, HashMap, LruHashMap},
};
use ros2probe_wire::inside::{
    Counter, Handle, announced, kind,
    late::{
        Activity, BOUND_CAPACITY, Blocked, Bound, Call, Handoff, LateCall, PER_SECOND,
        THREAD_CAPACITY, THREAD_IDS, mode,
    },
    thread_state,
};

use crate::{
    accounting::{self, Accounting},
    instructions::{atomic_add, hide_bounds},
    maps::{ANNOUNCEMENTS, CallContext, Thread, count},
};

const SECOND: u64 = 1_000_000_000;
/// Minimum time for which a thread that waits for work is blocked between two calls, in
/// nanoseconds.
const MIN_IDLE_NS: u64 = 100_000;
/// Numbers of 64 bits in [`FOLLOWED`].
const BITMAP_WORDS: u32 = THREAD_IDS / 64;

/// One of [`mode`]. Set by user space.
#[map]
static LATE_MODE: Array<u32> = Array::with_max_entries(1, 0);
/// Bounds of callbacks. Set by user space.
#[map]
static BOUNDS: HashMap<Handle, Bound> = HashMap::with_max_entries(BOUND_CAPACITY, 0);
/// Threads that call callbacks, and those of the middleware that wake them, by thread id.
#[map]
static FOLLOWED_THREADS: LruHashMap<u32, Followed> =
    LruHashMap::with_max_entries(THREAD_CAPACITY, 0);
/// The initial value of a followed thread; never written.
#[map]
static NEW_FOLLOWED: Array<Followed> = Array::with_max_entries(1, 0);
/// One bit for each thread id: the thread is followed.
#[map]
static FOLLOWED: Array<u64> = Array::with_max_entries(BITMAP_WORDS, 0);
/// Number of followed threads that can run and do not.
#[map]
static RUNNABLE_THREADS: Array<i64> = Array::with_max_entries(1, 0);

/// States of a followed thread.
pub mod state {
    pub const RUNNING: u64 = 0;
    pub const RUNNABLE: u64 = 1;
    pub const BLOCKED: u64 = 2;
}

/// What a followed thread does for callbacks.
pub mod role {
    /// Unknown until it calls a callback, or wakes a thread that does.
    pub const NONE: u64 = 0;
    /// It calls callbacks, and waits at present.
    pub const EXECUTOR: u64 = 1;
    /// It is in a callback.
    pub const IN_CALLBACK: u64 = 2;
    /// It passes messages on to threads that call callbacks.
    pub const RECEIVER: u64 = 3;
}

/// A thread that calls callbacks, or passes messages on to such a thread.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Followed {
    /// One of [`state`].
    pub state: u64,
    /// Start of that state, or of the present span if that is later.
    pub state_since_ns: u64,
    /// Time at which the thread began to run; 0 = unknown.
    pub on_cpu_since_ns: u64,
    /// The scheduler's CPU time of the thread at its last switch.
    pub sum_exec_runtime_ns: u64,
    /// The scheduler's waiting time of the thread when it last left a CPU.
    pub run_delay: u64,
    /// Its process.
    pub process: u64,
    /// One of [`role`].
    pub role: u64,
    /// The present wait, if the thread is blocked.
    pub current_wait: Blocked,
    /// Of an executor's thread, how a thread of its process woke it after its wait for work. Of a
    /// receiver, how it was itself woken for a message.
    pub handoff: Handoff,
    /// That wait.
    pub wait_before_handoff_ns: u64,
    /// The last call of another thread at whose end that thread woke this one, since the last call
    /// of this one.
    pub released_by: Call,
    /// How long the control groups of a receiver had been throttled at that wake-up.
    pub throttled: u64,
    /// What the thread did since the last start or end of a callback.
    pub activity: Activity,
    /// The last time in which the thread was stopped, and its end; 0 = never.
    pub last_stop: Blocked,
    pub last_stop_end_ns: u64,
    /// What it did between the call before and the present one.
    activity_before: Activity,
    /// The mode when the present call began.
    mode_at_start: u64,
    /// Time from ready to start of the present call.
    start_delay_ns: u64,
    /// Accounting at the last start or end of a callback.
    accounting: Accounting,
    is_accounted: u64,
    states_before: [u64; thread_state::COUNT],
    is_accounted_before: u64,
    /// The call that ends.
    current_call: Call,
    /// The call before.
    pub previous_call: Call,
    /// Time at which it was last woken.
    pub last_wakeup_ns: u64,
    /// Since when it makes one call after the other: it was woken for the first one.
    busy_since_ns: u64,
    /// Time in calls since then.
    busy_call_ns: u64,
    /// Time between these calls, for which it could run and did not, and was throttled.
    busy_runnable: u64,
    busy_throttled: u64,
    /// The longest of these calls.
    longest_call: Call,
}

/// Returns the present mode.
#[inline(always)]
pub fn current_mode() -> u32 {
    match LATE_MODE.get_ptr(0) {
        // SAFETY: a map value pointer checked against null.
        Some(mode) => unsafe { read_volatile(mode) },
        None => mode::OFF,
    }
}

/// Returns a followed thread.
#[inline(always)]
pub fn followed(thread: u32) -> Option<*mut Followed> {
    FOLLOWED_THREADS.get_ptr_mut(&thread)
}

/// Returns whether a thread is followed.
#[inline(always)]
pub fn is_followed(thread: u32) -> bool {
    match FOLLOWED.get_ptr(thread >> 6) {
        // SAFETY: a map value pointer checked against null.
        Some(word) => unsafe { read_volatile(word) >> (thread & 63) & 1 != 0 },
        None => false,
    }
}

/// Follows a thread from now on.
#[inline(always)]
pub fn follow(thread: u32) -> Option<*mut Followed> {
    if !is_followed(thread)
        && let Some(word) = FOLLOWED.get_ptr_mut(thread >> 6)
    {
        // Another thread with the same word may undo this at the same time. The next call repeats
        // it.
        // SAFETY: a map value pointer checked against null.
        unsafe { write_volatile(word, read_volatile(word) | 1 << (thread & 63)) };
    }
    if let Some(known) = followed(thread) {
        return Some(known);
    }
    let new = NEW_FOLLOWED.get_ptr(0)?;
    // SAFETY: a map value pointer checked against null, of an element that is never written.
    let _ = FOLLOWED_THREADS.insert(&thread, unsafe { &*new }, 0);
    followed(thread)
}

/// Follows a thread no longer, because it ends.
#[inline(always)]
pub fn forget(thread: u32) {
    let _ = FOLLOWED_THREADS.remove(&thread);
    if let Some(word) = FOLLOWED.get_ptr_mut(thread >> 6) {
        // SAFETY: as in `follow`.
        unsafe { write_volatile(word, read_volatile(word) & !(1 << (thread & 63))) };
    }
}

/// Returns whether a followed thread can run and does not.
#[inline(always)]
pub fn is_any_runnable() -> bool {
    match RUNNABLE_THREADS.get_ptr(0) {
        // SAFETY: a map value pointer checked against null.
        Some(count) => unsafe { read_volatile(count) > 0 },
        None => false,
    }
}

/// Changes the number of followed threads that can run and do not.
#[inline(always)]
pub fn add_runnable(by: i64) {
    if let Some(count) = RUNNABLE_THREADS.get_ptr_mut(0) {
        atomic_add(count.cast(), by as u64);
    }
}

/// Begins a new span of time of the running thread.
#[inline(always)]
unsafe fn start_interval(followed: *mut Followed, now: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        let since = (*followed).state_since_ns;
        if (*followed).state == state::RUNNING {
            if since != 0 && now > since {
                (*followed).activity.cpu += now - since;
            }
        } else {
            // The thread runs, so it entered a CPU without an event.
            if (*followed).state == state::RUNNABLE {
                add_runnable(-1);
            }
            (*followed).state = state::RUNNING;
            (*followed).activity.missed += 1;
        }
        (*followed).state_since_ns = now;
    }
}

/// Copies a plain value of map memory, or of the ring, word by word.
#[inline(always)]
pub unsafe fn copy<T: Copy>(from: *const T, to: *mut T) {
    // SAFETY: both have this size, by the caller.
    unsafe { copy_nonoverlapping(from.cast::<u64>(), to.cast::<u64>(), size_of::<T>() / 8) };
}

/// Empties what a thread did.
#[inline(always)]
pub unsafe fn reset_activity(followed: *mut Followed) {
    if let Some(new) = NEW_FOLLOWED.get_ptr(0) {
        // SAFETY: map values checked against null.
        unsafe { copy(&raw const (*new).activity, &raw mut (*followed).activity) };
    }
}

/// Forgets what an earlier thread of the same id did.
#[inline(always)]
unsafe fn reset_thread(followed: *mut Followed) {
    // SAFETY: a map value, by the caller.
    unsafe {
        reset_activity(followed);
        if (*followed).state == state::RUNNABLE {
            add_runnable(-1);
        }
        (*followed).state = state::RUNNING;
        (*followed).state_since_ns = 0;
        (*followed).on_cpu_since_ns = 0;
        (*followed).role = role::NONE;
        (*followed).handoff.at = 0;
        (*followed).wait_before_handoff_ns = 0;
        (*followed).released_by.ended = 0;
        (*followed).last_stop_end_ns = 0;
        (*followed).is_accounted = 0;
        (*followed).previous_call.ended = 0;
    }
}

/// Handles the start of a callback.
#[inline(always)]
pub fn on_call_start(current: &CallContext, delay: u64, now: u64, thread: *const Thread) {
    if current_mode() == mode::OFF {
        return;
    }
    let Some(followed) = follow(current.thread) else {
        return;
    };
    // SAFETY: a map value pointer checked against null, of the running thread.
    unsafe {
        let process = read_volatile(&raw const (*followed).process);
        if process != 0 && process != u64::from(current.process) {
            // Another thread had the id, and its end was not observed.
            reset_thread(followed);
        }
        start_interval(followed, now);
        copy(
            &raw const (*followed).activity,
            &raw mut (*followed).activity_before,
        );
        reset_activity(followed);
        (*followed).process = u64::from(current.process);
        if (*followed).role == role::RECEIVER {
            // That was how it was woken itself.
            (*followed).handoff.at = 0;
        }
        (*followed).role = role::IN_CALLBACK;
        (*followed).start_delay_ns = delay;
        (*followed).is_accounted_before = 0;
        (*followed).states_before = [0; thread_state::COUNT];
        let previous_ended = (*followed).previous_call.ended;
        let is_accounted = (*thread).has_accounting & (*followed).is_accounted;
        if is_accounted != 0 && previous_ended != 0 && now > previous_ended {
            (*followed).states_before = accounting::states(
                &raw const (*followed).accounting,
                &(*thread).accounting_at_start,
                now - previous_ended,
            );
            (*followed).is_accounted_before = 1;
        }
        if was_idle(followed) {
            let woken = read_volatile(&raw const (*followed).last_wakeup_ns);
            let is_later = woken > read_volatile(&raw const (*followed).previous_call.ended);
            (*followed).busy_since_ns = if is_later { woken } else { now };
            (*followed).busy_call_ns = 0;
            (*followed).busy_runnable = 0;
            (*followed).busy_throttled = 0;
            (*followed).longest_call.ended = 0;
            (*followed).longest_call.started = 0;
        }
        // Of a wait for a CPU before the thread was woken, no part is longer than the busy time.
        let states = (&raw const (*followed).states_before).cast::<u64>();
        let busy = now - read_volatile(&raw const (*followed).busy_since_ns);
        let runnable = read_volatile(states.add(thread_state::RUNNABLE));
        let throttled = read_volatile(states.add(thread_state::THROTTLED));
        (*followed).busy_runnable += accounting::min(runnable, busy);
        (*followed).busy_throttled += accounting::min(throttled, busy);
        (*followed).mode_at_start = u64::from(current_mode());
    }
}

/// Returns whether a thread waited for work before the call that begins.
#[inline(always)]
unsafe fn was_idle(followed: *const Followed) -> bool {
    // SAFETY: a map value, by the caller.
    unsafe {
        if read_volatile(&raw const (*followed).previous_call.ended) == 0 {
            return true;
        }
        // The mode is that of the call before.
        let had_scheduler_events =
            read_volatile(&raw const (*followed).mode_at_start) == u64::from(mode::EVENTS);
        if had_scheduler_events
            && current_mode() == mode::EVENTS
            && (*followed).activity_before.missed == 0
        {
            let [lock, sleep, disk, page_fault, stopped, other] =
                (*followed).activity_before.blocked;
            if lock + sleep + disk + page_fault + stopped + other <= MIN_IDLE_NS {
                return false;
            }
        }
        if read_volatile(&raw const (*followed).is_accounted_before) == 0 {
            return true;
        }
        let blocked = (&raw const (*followed).states_before).cast::<u64>();
        read_volatile(blocked.add(thread_state::BLOCKED)) > MIN_IDLE_NS
    }
}

/// Handles the end of a callback that began at the thread's `started`.
#[inline(always)]
pub fn on_call_end(
    current: &CallContext,
    callback: u64,
    trigger: Handle,
    thread: *const Thread,
    now: u64,
) {
    let mode = current_mode();
    if mode == mode::OFF {
        return;
    }
    let Some(followed) = followed(current.thread) else {
        return;
    };
    // SAFETY: map value pointers checked against null, of the running thread.
    unsafe {
        start_interval(followed, now);
        let started = (*thread).started;
        // What is needed after the report is stored before it: the verifier of Linux 6.18 fails at
        // numbers that stay on the stack.
        (*followed).current_call.callback = callback;
        (*followed).current_call.started = started;
        (*followed).current_call.ended = now;
        (*followed).is_accounted = (*thread).has_accounting;
        copy(
            &raw const (*thread).accounting_at_end,
            &raw mut (*followed).accounting,
        );
        let key = current.handle(callback, kind::CALLBACK);
        if let Some(bound) = BOUNDS.get_ptr_mut(&key)
            && (now - started > (*bound).duration || (*followed).start_delay_ns > (*bound).delay)
            && take_report_quota(bound, now)
        {
            let bounds = [(*bound).duration, (*bound).delay];
            send_late_call(
                current, callback, trigger, thread, followed, now, mode, bounds,
            );
        }
        reset_activity(followed);
        (*followed).role = role::EXECUTOR;
        (*followed).handoff.at = 0;
        (*followed).wait_before_handoff_ns = 0;
        (*followed).released_by.ended = 0;
        let present = &raw const (*followed).current_call;
        copy(present, &raw mut (*followed).previous_call);
        (*followed).busy_call_ns += duration(present);
        let longest = &raw mut (*followed).longest_call;
        let is_old = now - read_volatile(&raw const (*longest).ended) > SECOND;
        if is_old || duration(present) > duration(longest) {
            copy(present, longest);
        }
        // Of a thread that never waits, the last seconds count.
        if now - read_volatile(&raw const (*followed).busy_since_ns) > 8 * SECOND {
            (*followed).busy_since_ns += (now - (*followed).busy_since_ns) / 2;
            (*followed).busy_call_ns /= 2;
            (*followed).busy_runnable /= 2;
            (*followed).busy_throttled /= 2;
        }
    }
}

/// Returns the duration of a call.
#[inline(always)]
unsafe fn duration(call: *const Call) -> u64 {
    // SAFETY: a map value, by the caller.
    unsafe { read_volatile(&raw const (*call).ended) - read_volatile(&raw const (*call).started) }
}

/// Counts a report; returns `false` beyond the number of a second.
#[inline(always)]
unsafe fn take_report_quota(bound: *mut Bound, now: u64) -> bool {
    // SAFETY: a map value, by the caller.
    unsafe {
        if now.wrapping_sub((*bound).since) >= SECOND {
            (*bound).since = now;
            (*bound).reported = 0;
        }
        if (*bound).reported >= PER_SECOND {
            count(Counter::LateSkipped);
            return false;
        }
        (*bound).reported += 1;
    }
    true
}

#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "each is a part of the report")]
unsafe fn send_late_call(
    current: &CallContext,
    callback: u64,
    trigger: Handle,
    thread: *const Thread,
    followed: *const Followed,
    now: u64,
    mode: u32,
    bounds: [u64; 2],
) {
    let Some(mut entry) = ANNOUNCEMENTS.reserve::<LateCall>(0) else {
        count(Counter::LateLost);
        return;
    };
    let late: *mut LateCall = entry.as_mut_ptr();
    // SAFETY: reserved memory of this size, all of which is written; map values, by the caller.
    unsafe {
        let mode_at_start = (*followed).mode_at_start as u32;
        let is_accounted = (*thread).has_accounting as u32;
        let is_accounted_before = (*followed).is_accounted_before as u32;
        (*late).kind = announced::LATE;
        (*late).process = current.process;
        (*late).thread = current.thread;
        (*late).mode = if mode_at_start < mode {
            mode_at_start
        } else {
            mode
        };
        (*late).cpu = bpf_get_smp_processor_id();
        (*late).accounted = (hide_bounds(is_accounted) as u32 & 1)
            | (hide_bounds(is_accounted_before) as u32 & 1) << 1;
        (*late).callback = callback;
        (*late).trigger = trigger;
        (*late).source_timestamp = (*thread).source_timestamp;
        (*late).taken = (*thread).taken;
        (*late).started = (*thread).started;
        (*late).ended = now;
        (*late).delay = (*followed).start_delay_ns;
        (*late).bounds = bounds;
        copy(
            &raw const (*followed).previous_call,
            &raw mut (*late).previous,
        );
        copy(
            &raw const (*followed).released_by,
            &raw mut (*late).released_by,
        );
        (*late).busy_since = (*followed).busy_since_ns;
        (*late).in_calls = (*followed).busy_call_ns;
        (*late).busy_runnable = (*followed).busy_runnable;
        (*late).busy_throttled = (*followed).busy_throttled;
        copy(
            &raw const (*followed).longest_call,
            &raw mut (*late).longest_call,
        );
        (*late).states = (*thread).states;
        (*late).states_before = (*followed).states_before;
        copy(&raw const (*followed).handoff, &raw mut (*late).handoff);
        (*late).stop = (*followed).last_stop;
        (*late).stop_ended = (*followed).last_stop_end_ns;
        copy(&raw const (*followed).activity, &raw mut (*late).during);
        copy(
            &raw const (*followed).activity_before,
            &raw mut (*late).before,
        );
    }
    entry.submit(0);
}
