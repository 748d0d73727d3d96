//! Messages that are published, taken, and passed within a process.

use core::ptr::{read_volatile, write_volatile};

use ros2probe_wire::inside::{base_delay, distribution, kind};

use crate::{
    callbacks,
    instructions::atomic_add,
    maps::{
        CALLBACKS, CallContext, Entry, WAITING, count_event, now, realtime_ns, record_duration,
    },
    names,
    settings::read_global,
};

/// Handles a publication to the middleware, or the preceding one `within` the process.
#[inline(always)]
pub fn published(publisher: u64, within: bool) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let now = now();
    let thread = current.existing_thread();
    if !within {
        // This may be the second call for a message that was also passed within the process.
        if let Some(thread) = thread {
            // SAFETY: a map value pointer checked against null, of the running thread.
            let is_counted = unsafe { (*thread).intra_process_publisher } == publisher;
            if is_counted {
                // SAFETY: as above.
                unsafe { (*thread).intra_process_publisher = 0 };
                return;
            }
        }
    }
    let Some(figures) = current.figures(publisher, kind::PUBLISHER) else {
        return;
    };
    // SAFETY: a map value pointer checked against null.
    unsafe { count_event(figures, now) };
    names::announce_publisher(&current, figures, publisher);
    if within {
        // SAFETY: as above.
        atomic_add(unsafe { &raw mut (*figures).within }, 1);
        if let Some(thread) = current.thread() {
            // SAFETY: as above.
            unsafe { (*thread).intra_process_publisher = publisher };
        }
    }
    if read_global(&CALLBACKS) != 0 {
        callbacks::published(&current, publisher, within, now);
    }
}

/// Handles a take from the middleware, or an attempt.
#[inline(always)]
pub fn taken(subscription: u64, source_timestamp: u64, has_message: bool) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let Some(figures) = current.figures(subscription, kind::SUBSCRIPTION) else {
        return;
    };
    names::announce_subscription(&current, figures, subscription);
    if !has_message {
        // SAFETY: a map value pointer checked against null.
        atomic_add(unsafe { &raw mut (*figures).failed }, 1);
        // No callback follows. The next one may be that of a service, which has no execution.
        if let Some(thread) = current.existing_thread() {
            // SAFETY: as above, of the running thread.
            unsafe { (*thread).executing_handle = 0 };
        }
        return;
    }
    let now = now();
    // SAFETY: as above.
    unsafe { count_event(figures, now) };
    if source_timestamp != 0 {
        let delay = realtime_ns(now).wrapping_sub(source_timestamp) as i64;
        // SAFETY: as above.
        unsafe {
            if delay > 0 {
                record_duration(figures, distribution::DELAY, delay as u64);
            }
            let base = &raw mut (*figures).base_delay;
            let new = base_delay::after_take(read_volatile(base), delay, now);
            write_volatile(base, new);
        }
    }
    if read_global(&CALLBACKS) == 0 {
        return;
    }
    if let Some(thread) = current.thread() {
        // SAFETY: as above, of the running thread.
        unsafe {
            (*thread).input = current.handle(subscription, kind::SUBSCRIPTION);
            (*thread).source_timestamp = source_timestamp;
            (*thread).taken = now;
        }
    }
}

/// Counts a message that was taken without `rmw_take`, at the start of its callback. Its source
/// timestamp is unknown.
#[inline(always)]
pub fn count_untraced_take(current: &CallContext, subscription: u64, now: u64) {
    let Some(figures) = current.figures(subscription, kind::SUBSCRIPTION) else {
        return;
    };
    names::announce_subscription(current, figures, subscription);
    // SAFETY: a map value pointer checked against null.
    unsafe { count_event(figures, now) };
}

/// Handles a message that enters a ring buffer. `size` is the number of messages in the buffer
/// afterwards, one too many if a message is overwritten.
#[inline(always)]
pub fn enqueued(buffer: u64, index: u64, size: u32, overwritten: bool) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let Some(figures) = current.figures(buffer, kind::BUFFER) else {
        return;
    };
    let now = now();
    let depth = size.wrapping_sub(u32::from(overwritten));
    // SAFETY: a map value pointer checked against null.
    unsafe {
        count_event(figures, now);
        if overwritten {
            atomic_add(&raw mut (*figures).failed, 1);
        }
        write_volatile(&raw mut (*figures).depth, depth);
        if read_volatile(&raw const (*figures).max_depth) < depth {
            write_volatile(&raw mut (*figures).max_depth, depth);
        }
    }
    if let Some(thread) = current.existing_thread() {
        // SAFETY: as above. The publication that fills the buffers precedes this call in the same
        // thread.
        unsafe {
            let publisher = (*thread).intra_process_publisher;
            if publisher != 0 {
                (*figures).trigger = current.handle(publisher, kind::PUBLISHER);
            }
        }
    }
    let _ = WAITING.insert(&buffer_slot(&current, buffer, index), &now, 0);
}

/// Handles a message that leaves a ring buffer.
#[inline(always)]
pub fn dequeued(buffer: u64, index: u64, size: u32) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    let Some(figures) = current.figures(buffer, kind::BUFFER) else {
        return;
    };
    let now = now();
    let key = buffer_slot(&current, buffer, index);
    let entered = match WAITING.get_ptr(&key) {
        // SAFETY: a map value pointer checked against null.
        Some(entered) => unsafe { *entered },
        None => 0,
    };
    // SAFETY: as above.
    unsafe {
        atomic_add(&raw mut (*figures).within, 1);
        write_volatile(&raw mut (*figures).depth, size);
        if entered != 0 && now > entered {
            record_duration(figures, distribution::DELAY, now - entered);
        }
    }
    if entered != 0 {
        let _ = WAITING.remove(&key);
    }
    if read_global(&CALLBACKS) == 0 {
        return;
    }
    if let Some(thread) = current.thread() {
        let source_timestamp = if entered == 0 {
            0
        } else {
            realtime_ns(entered)
        };
        // SAFETY: as above, of the running thread.
        unsafe {
            (*thread).input = current.handle(buffer, kind::BUFFER);
            (*thread).source_timestamp = source_timestamp;
            (*thread).taken = now;
            (*thread).enqueued_ns = entered;
        }
    }
}

/// Records that a ring buffer was emptied.
#[inline(always)]
pub fn cleared(buffer: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    if let Some(figures) = current.existing_figures(buffer, kind::BUFFER) {
        // SAFETY: a map value pointer checked against null.
        unsafe { write_volatile(&raw mut (*figures).depth, 0) };
    }
}

#[inline(always)]
fn buffer_slot(current: &CallContext, buffer: u64, index: u64) -> Entry {
    Entry {
        buffer,
        process: current.process,
        index: index as u32,
    }
}
