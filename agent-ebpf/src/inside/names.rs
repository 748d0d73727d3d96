//! Names and relations of handles, each sent to user space once.
//!
//! A process that started before the programs has created its handles already. The names of such
//! handles are read from the process's structures, which are checked for plausibility first.

use aya_ebpf::helpers::generated::bpf_probe_read_user_str;
use ros2probe_wire::inside::{Announcement, Counter, Figures, NAME_BYTES, announced, kind};

use crate::maps::{ANNOUNCEMENTS, CallContext, count, now, read_user};

/// `"rmw_"`, with which every identifier of a middleware begins.
const RMW_PREFIX: u32 = u32::from_le_bytes(*b"rmw_");
/// Offsets of `rmw_handle` in `rcl_publisher_impl_s` and `rcl_subscription_impl_s`: in Humble, and
/// in Iron and later.
const RMW_HANDLE_OFFSETS: [u32; 2] = [240, 248];
/// Offset of the topic's name in `rmw_publisher_t` and `rmw_subscription_t`.
const TOPIC_NAME_OFFSET: u64 = 16;
/// Maximum number of attempts to read a name, whose page may not be resident.
const MAX_NAME_ATTEMPTS: u32 = 16;

/// What became of an announcement.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Sent,
    /// The ring is full.
    RingFull,
    /// The first name cannot be read.
    Unreadable,
}

/// Announces a publisher at its first publication.
#[inline(always)]
pub fn announce_publisher(current: &CallContext, figures: *mut Figures, publisher: u64) {
    if !needs_announcement(figures) {
        return;
    }
    let rmw = rmw_handle(current, publisher);
    if rmw == 0 {
        count(Counter::Unreadable);
        return;
    }
    announce_existing_endpoint(current, figures, announced::PUBLISHER, publisher, rmw);
}

/// Announces a subscription at its first take.
#[inline(always)]
pub fn announce_subscription(current: &CallContext, figures: *mut Figures, rmw: u64) {
    if !needs_announcement(figures) {
        return;
    }
    if !is_endpoint(rmw) {
        // Middlewares take from topics of their own, whose names do not begin with a slash.
        if is_internal(rmw) {
            // SAFETY: a map value, by the caller.
            unsafe { (*figures).announced = MAX_NAME_ATTEMPTS };
        } else {
            count(Counter::Unreadable);
        }
        return;
    }
    announce_existing_endpoint(current, figures, announced::SUBSCRIPTION, rmw, rmw);
}

/// Handles the creation of a publisher.
#[inline(always)]
pub fn publisher_created(publisher: u64, node: u64, rmw: u64, topic: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    current.remove_figures(publisher, kind::PUBLISHER);
    announce_new_endpoint(
        &current,
        announced::PUBLISHER,
        publisher,
        node,
        0,
        topic,
        rmw,
    );
}

/// Handles the creation of a subscription.
#[inline(always)]
pub fn subscription_created(subscription: u64, node: u64, rmw: u64, topic: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    current.remove_figures(rmw, kind::SUBSCRIPTION);
    announce_new_endpoint(
        &current,
        announced::SUBSCRIPTION,
        rmw,
        node,
        subscription,
        topic,
        rmw,
    );
}

/// Handles the creation of a callback.
#[inline(always)]
pub fn callback_created(announcement_kind: u32, callback: u64, parent: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    current.remove_figures(callback, kind::CALLBACK);
    send_announcement(&current, announcement_kind, callback, parent, 0, 0, 0);
}

/// Handles the creation of a ring buffer.
#[inline(always)]
pub fn buffer_created(buffer: u64, capacity: u64) {
    let Some(current) = CallContext::count_call() else {
        return;
    };
    current.remove_figures(buffer, kind::BUFFER);
    send_announcement(&current, announced::BUFFER, buffer, 0, capacity, 0, 0);
}

/// Announces another object or relation.
#[inline(always)]
pub fn announce(
    announcement_kind: u32,
    address: u64,
    parent: u64,
    value: u64,
    text: u64,
    second_text: u64,
) {
    if let Some(current) = CallContext::count_call() {
        send_announcement(
            &current,
            announcement_kind,
            address,
            parent,
            value,
            text,
            second_text,
        );
    }
}

/// Sends the names of a new endpoint, and notes that they are known.
#[inline(always)]
fn announce_new_endpoint(
    current: &CallContext,
    announcement_kind: u32,
    address: u64,
    node: u64,
    value: u64,
    topic: u64,
    rmw: u64,
) {
    let identifier = read_user::<u64>(rmw);
    let outcome = send_announcement(
        current,
        announcement_kind,
        address,
        node,
        value,
        topic,
        identifier,
    );
    let handle_kind = if announcement_kind == announced::PUBLISHER {
        kind::PUBLISHER
    } else {
        kind::SUBSCRIPTION
    };
    if outcome == Outcome::Sent
        && let Some(figures) = current.figures(address, handle_kind)
    {
        // SAFETY: a map value pointer checked against null.
        unsafe { (*figures).announced = MAX_NAME_ATTEMPTS };
    }
}

/// Sends the names of an endpoint that is older than the programs.
#[inline(always)]
fn announce_existing_endpoint(
    current: &CallContext,
    figures: *mut Figures,
    announcement_kind: u32,
    address: u64,
    rmw: u64,
) {
    let (identifier, topic) = (
        read_user::<u64>(rmw),
        read_user::<u64>(rmw + TOPIC_NAME_OFFSET),
    );
    let outcome = send_announcement(current, announcement_kind, address, 0, 0, topic, identifier);
    // SAFETY: a map value, by the caller.
    unsafe {
        if outcome == Outcome::Sent {
            (*figures).announced = MAX_NAME_ATTEMPTS;
        } else if outcome == Outcome::RingFull {
            // The name was not read, so the attempt does not count.
            (*figures).announced = (*figures).announced.saturating_sub(1);
        }
    }
}

/// Returns whether a handle's name still has to be read, and counts the attempt.
#[inline(always)]
fn needs_announcement(figures: *mut Figures) -> bool {
    // SAFETY: a map value, by the callers.
    unsafe {
        let attempts = (*figures).announced;
        if attempts >= MAX_NAME_ATTEMPTS {
            return false;
        }
        (*figures).announced = attempts + 1;
    }
    true
}

/// Returns the middleware's handle of a publisher or subscription; 0 if no plausible one is found.
#[inline(always)]
pub fn rmw_handle(current: &CallContext, endpoint: u64) -> u64 {
    let structure = read_user::<u64>(endpoint);
    let known = current.rmw_handle_offset();
    if known != 0 {
        let rmw = read_user::<u64>(structure + u64::from(known));
        return if is_endpoint(rmw) { rmw } else { 0 };
    }
    let mut index = 0;
    while index < RMW_HANDLE_OFFSETS.len() {
        let offset = RMW_HANDLE_OFFSETS[index];
        let rmw = read_user::<u64>(structure + u64::from(offset));
        if is_endpoint(rmw) {
            current.set_rmw_handle_offset(offset);
            return rmw;
        }
        index += 1;
    }
    0
}

/// Returns whether an address holds an endpoint of a middleware: an identifier that begins with
/// `rmw_`, and a name that begins with a slash.
#[inline(always)]
fn is_endpoint(rmw: u64) -> bool {
    read_user::<u32>(read_user(rmw)) == RMW_PREFIX
        && read_user::<u8>(read_user(rmw + TOPIC_NAME_OFFSET)) == b'/'
}

/// Returns whether an address holds an endpoint of a middleware with a name that is not empty. The
/// caller has excluded names that begin with a slash.
#[inline(always)]
fn is_internal(rmw: u64) -> bool {
    read_user::<u32>(read_user(rmw)) == RMW_PREFIX
        && read_user::<u8>(read_user(rmw + TOPIC_NAME_OFFSET)) != 0
}

/// Sends an announcement.
#[inline(always)]
fn send_announcement(
    current: &CallContext,
    announcement_kind: u32,
    address: u64,
    parent: u64,
    value: u64,
    text: u64,
    second_text: u64,
) -> Outcome {
    let Some(mut entry) = ANNOUNCEMENTS.reserve::<Announcement>(0) else {
        count(Counter::AnnouncementsLost);
        return Outcome::RingFull;
    };
    let announcement = entry.as_mut_ptr();
    // SAFETY: memory of the size of an announcement that this run has reserved; every field that
    // user space reads is written.
    let length = unsafe {
        (*announcement).kind = announcement_kind;
        (*announcement).process = current.process;
        (*announcement).thread = current.thread;
        (*announcement).unused = 0;
        (*announcement).time = now();
        (*announcement).address = address;
        (*announcement).parent = parent;
        (*announcement).value = value;
        (*announcement).text[0] = 0;
        (*announcement).second[0] = 0;
        let length = read_user_str((&raw mut (*announcement).text).cast(), text);
        read_user_str((&raw mut (*announcement).second).cast(), second_text);
        length
    };
    if text != 0 && length <= 0 {
        count(Counter::Unreadable);
        entry.discard(0);
        return Outcome::Unreadable;
    }
    entry.submit(0);
    Outcome::Sent
}

/// Copies a string of the running process; returns its length with the terminating zero, or a
/// negative error.
#[inline(always)]
unsafe fn read_user_str(to: *mut u8, address: u64) -> i64 {
    if address == 0 {
        return 0;
    }
    // SAFETY: `to` can hold a name, by the caller; the kernel checks the address.
    let length =
        unsafe { bpf_probe_read_user_str(to.cast(), NAME_BYTES as u32, address as *const _) };
    if length <= 0 {
        // SAFETY: as above.
        unsafe { *to = 0 };
    }
    length
}
