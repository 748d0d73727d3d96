//! Callbacks of rclcpp: how long they wait and run, and what they publish.

use core::ptr::{read_volatile, write_volatile};

use ros2probe_wire::inside::{
    Counter, Figures, HOPS_PER_SECOND, Handle, Hop, announced, base_delay, distribution, kind,
    thread_state,
};

use crate::{
    accounting,
    instructions::atomic_add,
    late,
    maps::{
        ANNOUNCEMENTS, CallContext, Thread, count, monotonic_raw_ns, now, read_user, realtime_ns,
        record_duration,
    },
    messages, names,
};

const SECOND: u64 = 1_000_000_000;
/// Maximum plausible period of a timer, and maximum distance of its last call, in nanoseconds.
const MAX_TIMER_PERIOD_NS: u64 = 86_400 * SECOND;
/// Minimum plausible period of a timer, in nanoseconds.
const MIN_TIMER_PERIOD_NS: u64 = 1_000;
/// Difference of clock readings that is treated as zero, in nanoseconds.
const CLOCK_TOLERANCE_NS: u64 = 10_000_000;
/// First and last offset in `rcl_timer_impl_t` at which the period is searched. The times of the
/// last and the next call follow the period.
const MIN_PERIOD_OFFSET: u32 = 32;
const MAX_PERIOD_OFFSET: u32 = 80;

/// Handles the start of the execution of a handle.
#[inline(always)]
pub fn on_executor_execute(handle: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    if let Some(thread) = current.thread() {
        // SAFETY: a map value pointer checked against null, of the running thread.
        unsafe {
            (*thread).executing_handle = handle;
            (*thread).input = current.handle(0, 0);
        }
    }
}

/// Handles the start of a callback for a message of the same process.
#[inline(always)]
pub fn count_intra_process_message(callback: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    if let Some(figures) = current.figures(callback, kind::CALLBACK) {
        // SAFETY: a map value pointer checked against null.
        unsafe {
            atomic_add(&raw mut (*figures).within, 1);
            (*figures).trigger = current.handle(0, kind::BUFFER);
            write_volatile(&raw mut (*figures).last, now());
        }
    }
}

/// Handles the start of a callback.
#[inline(always)]
pub fn on_callback_start(callback: u64, within: bool) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let (Some(figures), Some(thread)) =
        (current.figures(callback, kind::CALLBACK), current.thread())
    else {
        return;
    };
    let now = now();
    // SAFETY: map value pointers checked against null; the thread is the running one.
    unsafe {
        (*thread).callback = callback;
        (*thread).started = now;
        (*figures).thread = current.thread;
        (*thread).has_accounting =
            accounting::read_accounting(&raw mut (*thread).accounting_at_start);
        let input = (*thread).input;
        let mut delay = 0;
        if within {
            atomic_add(&raw mut (*figures).within, 1);
            if input.kind == kind::BUFFER {
                (*figures).trigger = input;
                let entered = (*thread).enqueued_ns;
                if entered != 0 && now > entered {
                    delay = now - entered;
                    record_duration(figures, distribution::DELAY, delay);
                }
            } else {
                (*figures).trigger = current.handle(0, kind::BUFFER);
            }
        } else if input.kind == kind::SUBSCRIPTION {
            (*figures).trigger = input;
            delay = record_wait_since_publication(&current, figures, thread, now);
        } else if (*thread).executing_handle != 0 {
            let executed = (*thread).executing_handle;
            // The schedule of a known timer was read before.
            let is_timer = (*figures).period != 0;
            let rmw = if is_timer {
                0
            } else {
                names::rmw_handle(&current, executed)
            };
            if rmw == 0 {
                (*figures).trigger = current.handle(executed, kind::TIMER);
                delay = record_timer_delay(&current, figures, executed, now);
            } else {
                // `rmw_fastrtps_cpp` takes messages of buffer topics without `rmw_take`.
                (*figures).trigger = current.handle(rmw, kind::SUBSCRIPTION);
                messages::count_untraced_take(&current, rmw, now);
            }
        } else {
            (*figures).trigger = current.handle(0, 0);
        }
        late::on_call_start(&current, delay, now, thread);
    }
}

/// Adds the time since the message's source timestamp, less the base delay of the subscription's
/// takes. Returns that time; 0 if it is unknown.
#[inline(always)]
unsafe fn record_wait_since_publication(
    current: &CallContext,
    figures: *mut Figures,
    thread: *const Thread,
    now: u64,
) -> u64 {
    // SAFETY: map values, by the caller.
    unsafe {
        let source = (*thread).source_timestamp;
        if source == 0 {
            return 0;
        }
        let input = (*thread).input;
        let Some(subscription) = current.existing_figures(input.address, kind::SUBSCRIPTION) else {
            return 0;
        };
        let base = read_volatile(&raw const (*subscription).base_delay);
        if base == 0 {
            return 0;
        }
        let wait = base_delay::wait(base, realtime_ns(now).wrapping_sub(source) as i64, now);
        record_duration(figures, distribution::DELAY, wait);
        wait
    }
}

/// Adds the time since the timer was due. The timer's structure already has the time of the next
/// call. Returns that time; 0 if it is unknown.
#[inline(always)]
unsafe fn record_timer_delay(
    current: &CallContext,
    figures: *mut Figures,
    timer: u64,
    now: u64,
) -> u64 {
    let structure = read_user::<u64>(timer);
    let offset = match current.timer_period_offset() {
        0 => find_period_offset(structure, now),
        offset => offset,
    };
    if offset == 0 {
        return 0;
    }
    let [period, last, next] = read_user::<[u64; 3]>(structure + u64::from(offset));
    if !is_timer_schedule(period, last, next, now) {
        return 0;
    }
    current.set_timer_period_offset(offset);
    // SAFETY: a map value, by the caller.
    unsafe {
        // The executor moves the next call by whole periods. Otherwise the timer was reset.
        let expected = (*figures).due;
        let (mut due, mut skipped) = (next - period, 0);
        let advance_ns = next.wrapping_sub(expected);
        if expected != 0 && next > expected && advance_ns.checked_rem(period) == Some(0) {
            due = expected;
            skipped = advance_ns.checked_div(period).unwrap_or(1) - 1;
        }
        (*figures).due = next;
        (*figures).period = period;
        if skipped != 0 {
            atomic_add(&raw mut (*figures).failed, skipped);
        }
        let clock = timer_clock_now(last, now);
        if clock <= due {
            return 0;
        }
        record_duration(figures, distribution::DELAY, clock - due);
        clock - due
    }
}

/// Finds the offset of the period; 0 if no offset has a plausible one.
#[inline(always)]
fn find_period_offset(structure: u64, now: u64) -> u32 {
    let mut offset = MIN_PERIOD_OFFSET;
    while offset <= MAX_PERIOD_OFFSET {
        let [period, last, next] = read_user::<[u64; 3]>(structure + u64::from(offset));
        if is_timer_schedule(period, last, next, now) {
            return offset;
        }
        offset += 8;
    }
    0
}

/// Returns whether three numbers can be a period, the time of a call within the last second, and
/// the time of the next call.
#[inline(always)]
fn is_timer_schedule(period: u64, last: u64, next: u64, now: u64) -> bool {
    let is_period = period >= MIN_TIMER_PERIOD_NS
        && period <= MAX_TIMER_PERIOD_NS
        && next > last
        && next - last <= period;
    is_period && timer_clock_now(last, now).wrapping_sub(last) < SECOND
}

/// Returns the current time of the clock from which `last` was read: the system's, or rcl's steady
/// clock, CLOCK_MONOTONIC_RAW in Humble and CLOCK_MONOTONIC in Jazzy. Of these two, it is the one
/// that passed `last` later. A result slightly before `last` becomes `last`, because the clock
/// differences that user space sets are imprecise.
#[inline(always)]
fn timer_clock_now(last: u64, now: u64) -> u64 {
    let raw = monotonic_raw_ns(now);
    // A clock before `last` has the greatest age.
    let age = |clock: u64| clock.wrapping_add(CLOCK_TOLERANCE_NS).wrapping_sub(last);
    let clock = if last >= now.wrapping_add(MAX_TIMER_PERIOD_NS) {
        realtime_ns(now)
    } else if age(raw) < age(now) {
        raw
    } else {
        now
    };
    if clock < last && last - clock < CLOCK_TOLERANCE_NS {
        last
    } else {
        clock
    }
}

/// Handles the end of a callback.
#[inline(always)]
pub fn on_callback_end(callback: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let (Some(figures), Some(thread)) = (
        current.figures(callback, kind::CALLBACK),
        current.existing_thread(),
    ) else {
        return;
    };
    let now = now();
    // SAFETY: as in `on_callback_start`.
    unsafe {
        atomic_add(&raw mut (*figures).count, 1);
        write_volatile(&raw mut (*figures).last, now);
        // A callback that runs an executor contains other callbacks, which overwrite its start.
        if (*thread).callback == callback && now > (*thread).started {
            let duration = now - (*thread).started;
            record_duration(figures, distribution::INTERVAL, duration);
            (*thread).has_accounting &=
                accounting::read_accounting(&raw mut (*thread).accounting_at_end);
            (*thread).states = [0; thread_state::COUNT];
            if (*thread).has_accounting != 0 {
                let before = &raw const (*thread).accounting_at_start;
                let states = accounting::states(before, &(*thread).accounting_at_end, duration);
                let sums = (&raw mut (*figures).states).cast::<u64>();
                let mut state = 0;
                while state < states.len() {
                    atomic_add(sums.add(state), states[state]);
                    state += 1;
                }
                atomic_add(&raw mut (*figures).states_known, 1);
                (*thread).states = states;
            }
            let trigger = (*figures).trigger;
            late::on_call_end(&current, callback, trigger, thread, now);
        }
        (*thread).callback = 0;
        (*thread).executing_handle = 0;
        (*thread).input = current.handle(0, 0);
    }
}

/// Reports a publication during a callback that handles a message.
#[inline(always)]
pub fn published(current: &CallContext, publisher: u64, within: bool, now: u64) {
    let Some(thread) = current.existing_thread() else {
        return;
    };
    // SAFETY: a map value pointer checked against null, of the running thread.
    let (callback, input) = unsafe { ((*thread).callback, (*thread).input) };
    if callback == 0 || input.address == 0 {
        return;
    }
    let Some(figures) = current.existing_figures(callback, kind::CALLBACK) else {
        return;
    };
    // SAFETY: as above.
    unsafe {
        if now.wrapping_sub((*figures).hops_since) >= SECOND {
            (*figures).hops_since = now;
            (*figures).hops = 0;
        }
        if (*figures).hops >= HOPS_PER_SECOND {
            count(Counter::HopsSkipped);
            return;
        }
        (*figures).hops += 1;
    }
    // SAFETY: as above.
    unsafe { send_hop(current, thread, publisher, within, input, now) };
}

#[inline(always)]
unsafe fn send_hop(
    current: &CallContext,
    thread: *const Thread,
    publisher: u64,
    within: bool,
    input: Handle,
    now: u64,
) {
    let Some(mut entry) = ANNOUNCEMENTS.reserve::<Hop>(0) else {
        count(Counter::HopsLost);
        return;
    };
    // SAFETY: a map value, by the caller.
    let hop = unsafe {
        Hop {
            kind: announced::HOP,
            process: current.process,
            thread: current.thread,
            within: u32::from(within),
            published: now,
            publisher,
            input,
            source_timestamp: (*thread).source_timestamp,
            taken: (*thread).taken,
            started: (*thread).started,
            callback: (*thread).callback,
        }
    };
    entry.write(hop);
    entry.submit(0);
}
