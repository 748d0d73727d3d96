//! The scheduler's accounting of the running thread.

use core::mem::MaybeUninit;

use aya_ebpf::helpers::{bpf_get_current_task, generated::bpf_probe_read_kernel};
use ros2probe_wire::inside::{
    accounting::{
        ABSENT, COUNT, GROUP, GROUP_PARENT, GROUP_THROTTLED, RUN_DELAY, RUNTIME, VOLUNTARY_SWITCHES,
    },
    thread_state,
};

/// Control groups whose throttling is added up: that of the thread, and those around it.
const MAX_CGROUP_LEVELS: u32 = 4;

/// Offsets of members by `accounting`. Set by the loader.
#[unsafe(no_mangle)]
pub static ACCOUNTING: [u32; COUNT] = [ABSENT; COUNT];

/// Accounting of a thread, in nanoseconds but for the switches. Only differences have a meaning.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Accounting {
    /// CPU time up to the last tick or context switch.
    pub cpu: u64,
    pub runnable: u64,
    pub throttled: u64,
    /// Context switches at which the thread was blocked.
    pub voluntary_switches: u64,
}

/// Reads the accounting of the running thread into a map value. Returns 1, or 0 if the kernel does
/// not keep it, or does not allow the read. An `Option` would stay on the stack, partly unwritten.
/// Linux before 6.3 refuses a program that may read such a place.
///
/// # Safety
/// `to` is in a map value.
#[inline(always)]
pub unsafe fn read_accounting(to: *mut Accounting) -> u64 {
    if offset(RUNTIME) == ABSENT
        || offset(RUN_DELAY) == ABSENT
        || offset(VOLUNTARY_SWITCHES) == ABSENT
    {
        return 0;
    }
    // SAFETY: no preconditions; `to` is as required of the caller.
    unsafe {
        let task = bpf_get_current_task();
        (*to).throttled = throttled(task);
        let error = read_u64_into(task, RUNTIME, &raw mut (*to).cpu)
            | read_u64_into(task, RUN_DELAY, &raw mut (*to).runnable)
            | read_u64_into(task, VOLUNTARY_SWITCHES, &raw mut (*to).voluntary_switches);
        u64::from(error == 0)
    }
}

/// Returns what the running thread did in the last `duration` nanoseconds, which began with
/// `before`, by [`thread_state`].
///
/// # Safety
/// `before` is in a map value.
#[inline(always)]
pub unsafe fn states(
    before: *const Accounting,
    after: &Accounting,
    duration: u64,
) -> [u64; thread_state::COUNT] {
    // SAFETY: as required of the caller.
    let before = unsafe { &*before };
    // Waiting is exact. A thread without a voluntary switch was never blocked, so it ran for the
    // rest. Otherwise the CPU time may lack a tick, and may have one from before the span. No part
    // can be larger than what the others leave: groups are throttled on several CPUs.
    let run_delay = min(after.runnable.wrapping_sub(before.runnable), duration);
    let cpu = if after.voluntary_switches == before.voluntary_switches {
        duration - run_delay
    } else {
        min(after.cpu.wrapping_sub(before.cpu), duration - run_delay)
    };
    let throttled = min(after.throttled.wrapping_sub(before.throttled), run_delay);
    // In the order of `thread_state`.
    [
        cpu,
        throttled,
        run_delay - throttled,
        duration - cpu - run_delay,
    ]
}

#[inline(always)]
pub const fn min(one: u64, other: u64) -> u64 {
    if one < other { one } else { other }
}

/// Returns how long the quotas of the thread's control groups have stopped them.
#[inline(always)]
pub fn throttled(task: u64) -> u64 {
    let has_quotas = offset(GROUP) != ABSENT && offset(GROUP_PARENT) != ABSENT;
    if !has_quotas || offset(GROUP_THROTTLED) == ABSENT {
        return 0;
    }
    let (mut sum, mut level) = (0_u64, 0);
    let mut group = read_u64(task, GROUP).unwrap_or(0);
    while level < MAX_CGROUP_LEVELS {
        if group == 0 {
            break;
        }
        sum = sum.wrapping_add(read_u64(group, GROUP_THROTTLED).unwrap_or(0));
        group = read_u64(group, GROUP_PARENT).unwrap_or(0);
        level += 1;
    }
    sum
}

#[inline(always)]
pub fn offset(of: usize) -> u32 {
    // SAFETY: an index below the array's length.
    let offset = unsafe { (&raw const ACCOUNTING).cast::<u32>().add(of) };
    // SAFETY: a constant of the loaded object, never written while the program runs.
    unsafe { core::ptr::read_volatile(offset) }
}

/// Reads a member of the structure at `address`.
#[inline(always)]
pub fn read_u64(address: u64, of: usize) -> Option<u64> {
    let mut value = MaybeUninit::<u64>::zeroed();
    // SAFETY: the destination has the size of the member.
    let result = unsafe { read_u64_into(address, of, value.as_mut_ptr()) };
    // SAFETY: every bit pattern is a valid `u64`.
    (result == 0).then(|| unsafe { value.assume_init() })
}

/// Copies a member of the structure at `address`. Returns 0, or an error; `to` is then 0.
#[inline(always)]
unsafe fn read_u64_into(address: u64, of: usize, to: *mut u64) -> i64 {
    let address = address.wrapping_add(u64::from(offset(of)));
    // SAFETY: `to` is writable, by the caller; the kernel checks the address.
    unsafe { bpf_probe_read_kernel(to.cast(), size_of::<u64>() as u32, address as *const _) }
}
