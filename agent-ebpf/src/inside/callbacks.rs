//! Callbacks of rclcpp: how long they wait and run, and what they publish.

use core::ptr::{read_volatile, write_volatile};

use ros2probe_wire::inside::{
    Counter, Figures, HOPS_PER_SECOND, Handle, Hop, announced, distribution, kind, thread_state,
};

use crate::{
    accounting,
    instructions::add,
    late,
    maps::{ANNOUNCEMENTS, Current, Thread, calendar, count, now, observe, raw, read},
    messages, names,
};

const SECOND: u64 = 1_000_000_000;
/// Maximum plausible period of a timer, and maximum distance of its last call, in nanoseconds.
const LONGEST: u64 = 86_400 * SECOND;
const SHORTEST: u64 = 1_000;
/// Difference of clock readings that is treated as zero, in nanoseconds.
const IMPRECISION: u64 = 10_000_000;
/// First and last offset in `rcl_timer_impl_t` at which the period is searched. The times of the
/// last and the next call follow the period.
const FIRST_PLACE: u32 = 32;
const LAST_PLACE: u32 = 80;

/// Handles the start of the execution of a handle; 0 = the executor selects the next one.
#[inline(always)]
pub fn executed(handle: u64) {
    let Some(current) = Current::of_call() else {
        return;
    };
    if let Some(thread) = current.thread() {
        // SAFETY: a map value pointer checked against null, of the running thread.
        unsafe {
            (*thread).executed = handle;
            if handle != 0 {
                (*thread).input = current.handle(0, 0);
            }
        }
    }
}

/// Handles the start of a callback for a message of the same process.
#[inline(always)]
pub fn received(callback: u64) {
    let Some(current) = Current::of_call() else {
        return;
    };
    if let Some(figures) = current.figures(callback, kind::CALLBACK) {
        // SAFETY: a map value pointer checked against null.
        unsafe {
            add(&raw mut (*figures).within, 1);
            (*figures).trigger = current.handle(0, kind::BUFFER);
            write_volatile(&raw mut (*figures).last, now());
        }
    }
}

/// Handles the start of a callback.
#[inline(always)]
pub fn started(callback: u64, within: bool) {
    let Some(current) = Current::of_call() else {
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
        (*thread).is_accounted = accounting::read_into(&raw mut (*thread).accounting);
        let input = (*thread).input;
        let mut delay = 0;
        if within {
            add(&raw mut (*figures).within, 1);
            if input.kind == kind::BUFFER {
                (*figures).trigger = input;
                let entered = (*thread).entered;
                if entered != 0 && now > entered {
                    delay = now - entered;
                    observe(figures, distribution::DELAY, delay);
                }
            } else {
                (*figures).trigger = current.handle(0, kind::BUFFER);
            }
        } else if input.kind == kind::SUBSCRIPTION {
            (*figures).trigger = input;
            delay = waited_since_source(&current, figures, thread, now);
        } else if (*thread).executed != 0 {
            let executed = (*thread).executed;
            // The schedule of a known timer was read before.
            let is_timer = (*figures).period != 0;
            let rmw = if is_timer {
                0
            } else {
                names::rmw_handle(&current, executed)
            };
            if rmw == 0 {
                (*figures).trigger = current.handle(executed, kind::TIMER);
                delay = waited_since_due(&current, figures, executed, now);
            } else {
                // `rmw_fastrtps_cpp` takes messages of buffer topics without `rmw_take`.
                (*figures).trigger = current.handle(rmw, kind::SUBSCRIPTION);
                messages::taken_unseen(&current, rmw, now);
            }
        } else {
            (*figures).trigger = current.handle(0, 0);
        }
        late::began(&current, delay, now, thread);
    }
}

/// Adds the time since the message's source timestamp, less the minimum delay of the subscription's
/// takes. Returns that time; 0 if it is unknown.
#[inline(always)]
unsafe fn waited_since_source(
    current: &Current,
    figures: *mut Figures,
    thread: *const Thread,
    now: u64,
) -> u64 {
    // SAFETY: map values, by the caller.
    unsafe {
        let source = (*thread).source_timestamp;
        let calendar = calendar(now);
        if source == 0 || calendar <= source {
            return 0;
        }
        let input = (*thread).input;
        let Some(subscription) = current.known_figures(input.address, kind::SUBSCRIPTION) else {
            return 0;
        };
        let minima = (&raw const (*subscription).minima).cast::<u64>();
        let least = read_volatile(minima.add(distribution::DELAY));
        let delay = calendar - source;
        if least == 0 || delay < least - 1 {
            return 0;
        }
        observe(figures, distribution::DELAY, delay - (least - 1));
        delay - (least - 1)
    }
}

/// Adds the time since the timer was due. The timer's structure already has the time of the next
/// call. Returns that time; 0 if it is unknown.
#[inline(always)]
unsafe fn waited_since_due(current: &Current, figures: *mut Figures, timer: u64, now: u64) -> u64 {
    let structure = read::<u64>(timer);
    let place = match current.timer_period_at() {
        0 => find_period(structure, now),
        place => place,
    };
    if place == 0 {
        return 0;
    }
    let [period, last, next] = read::<[u64; 3]>(structure + u64::from(place));
    if !is_schedule(period, last, next, now) {
        return 0;
    }
    current.found_timer_period(place);
    // SAFETY: a map value, by the caller.
    unsafe {
        // The executor moves the next call by whole periods. Otherwise the timer was reset.
        let expected = (*figures).due;
        let (mut due, mut skipped) = (next - period, 0);
        let ahead = next.wrapping_sub(expected);
        if expected != 0 && next > expected && ahead.checked_rem(period) == Some(0) {
            due = expected;
            skipped = ahead.checked_div(period).unwrap_or(1) - 1;
        }
        (*figures).due = next;
        (*figures).period = period;
        if skipped != 0 {
            add(&raw mut (*figures).failed, skipped);
        }
        let clock = clock_of(last, now);
        if clock <= due {
            return 0;
        }
        observe(figures, distribution::DELAY, clock - due);
        clock - due
    }
}

/// Finds the offset of the period; 0 if no offset has a plausible one.
#[inline(always)]
fn find_period(structure: u64, now: u64) -> u32 {
    let mut place = FIRST_PLACE;
    while place <= LAST_PLACE {
        let [period, last, next] = read::<[u64; 3]>(structure + u64::from(place));
        if is_schedule(period, last, next, now) {
            return place;
        }
        place += 8;
    }
    0
}

/// Returns whether three numbers can be a period, the time of a call within the last second, and
/// the time of the next call.
#[inline(always)]
fn is_schedule(period: u64, last: u64, next: u64, now: u64) -> bool {
    let is_period = period >= SHORTEST && period <= LONGEST && next > last && next - last <= period;
    is_period && clock_of(last, now).wrapping_sub(last) < SECOND
}

/// Returns the current time of the clock from which `last` was read: the system's, or rcl's steady
/// clock, CLOCK_MONOTONIC_RAW in Humble and CLOCK_MONOTONIC in Jazzy. Of these two, it is the one that
/// passed `last` later. A result slightly before `last` becomes `last`, because the clock differences
/// that user space sets are imprecise.
#[inline(always)]
fn clock_of(last: u64, now: u64) -> u64 {
    let raw = raw(now);
    // A clock before `last` has the greatest age.
    let age = |clock: u64| clock.wrapping_add(IMPRECISION).wrapping_sub(last);
    let clock = if last >= now.wrapping_add(LONGEST) {
        calendar(now)
    } else if age(raw) < age(now) {
        raw
    } else {
        now
    };
    if clock < last && last - clock < IMPRECISION {
        last
    } else {
        clock
    }
}

/// Handles the end of a callback.
#[inline(always)]
pub fn ended(callback: u64) {
    let Some(current) = Current::of_call() else {
        return;
    };
    let (Some(figures), Some(thread)) = (
        current.figures(callback, kind::CALLBACK),
        current.known_thread(),
    ) else {
        return;
    };
    let now = now();
    // SAFETY: as in `started`.
    unsafe {
        add(&raw mut (*figures).count, 1);
        write_volatile(&raw mut (*figures).last, now);
        // A callback that runs an executor contains other callbacks, which overwrite its start.
        if (*thread).callback == callback && now > (*thread).started {
            let duration = now - (*thread).started;
            observe(figures, distribution::INTERVAL, duration);
            (*thread).is_accounted &= accounting::read_into(&raw mut (*thread).after);
            (*thread).states = [0; thread_state::COUNT];
            if (*thread).is_accounted != 0 {
                let before = &raw const (*thread).accounting;
                let states = accounting::states(before, &(*thread).after, duration);
                let sums = (&raw mut (*figures).states).cast::<u64>();
                let mut state = 0;
                while state < states.len() {
                    add(sums.add(state), states[state]);
                    state += 1;
                }
                add(&raw mut (*figures).states_known, 1);
                (*thread).states = states;
            }
            let trigger = (*figures).trigger;
            late::ended(&current, callback, trigger, thread, now);
        }
        (*thread).callback = 0;
        (*thread).executed = 0;
        (*thread).input = current.handle(0, 0);
    }
}

/// Reports a publication during a callback that handles a message.
#[inline(always)]
pub fn published(current: &Current, publisher: u64, within: bool, now: u64) {
    let Some(thread) = current.known_thread() else {
        return;
    };
    // SAFETY: a map value pointer checked against null, of the running thread.
    let (callback, input) = unsafe { ((*thread).callback, (*thread).input) };
    if callback == 0 || input.address == 0 {
        return;
    }
    let Some(figures) = current.known_figures(callback, kind::CALLBACK) else {
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
    unsafe { report(current, thread, publisher, within, input, now) };
}

#[inline(always)]
unsafe fn report(
    current: &Current,
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
