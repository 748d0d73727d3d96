//! Events of the scheduler: for what a followed thread waits, and who runs while it could run.
//!
//! Nearly all events concern other threads, so the programs first read one bit of a thread's id.
//! While a followed thread can run and does not, the programs store who runs on each CPU. When the
//! thread runs again, they add up who ran on its CPU instead.
//!
//! The programs take no lock that sleeps, and write no ring: on real-time kernels they run where
//! nothing may sleep.

use core::{
    arch::asm,
    ptr::{read_volatile, write_volatile},
};

use aya_ebpf::{
    helpers::{
        bpf_get_current_pid_tgid, bpf_get_current_task, bpf_probe_read_kernel,
        generated::{
            bpf_get_current_cgroup_id, bpf_get_current_comm, bpf_get_current_task_btf,
            bpf_task_pt_regs,
        },
    },
    macros::map,
    maps::PerCpuArray,
    programs::RawTracePointContext,
};
use ros2probe_wire::inside::{
    accounting::{PRIORITY, RUN_DELAY, RUNTIME, STATE, THREAD},
    late::{
        Activity, Blocked, Call, NAME_BYTES, OTHERS, Other, RELEASE, STALL, UNKNOWN_PRIORITY, wait,
    },
};

use crate::{
    accounting::{least, throttled, word},
    instructions::opaque,
    late::{
        Followed, add_runnable, clear, copy, follow, followed, forget, is_any_runnable,
        is_followed, role, state,
    },
    maps::now,
    registers::is_aarch64,
};

/// Runs of threads that a CPU remembers; a power of two.
const RUNS: usize = 64;
/// Waits below this time are not divided among other threads, in nanoseconds.
const SHORT: u64 = 20_000;

/// Minimum of a wait that is not one for a lock of the middleware, in nanoseconds.
const LONG: u64 = 1_000_000;

/// States of `task_struct.__state` (include/linux/sched.h).
mod task {
    pub const UNINTERRUPTIBLE: u64 = 2;
    pub const STOPPED_OR_TRACED: u64 = 4 | 8;
    pub const DEAD: u64 = 0x80;
    pub const WAKING: u64 = 0x200;
}

/// A run of a thread on a CPU.
#[repr(C)]
#[derive(Clone, Copy)]
struct Run {
    until: u64,
    /// Thread id in the low half, process id in the high half.
    id: u64,
    name: [u64; NAME_BYTES / 8],
    /// As in [`Other`].
    cgroup_id: u64,
    priority: i64,
}

/// The last runs of a CPU. Only those are present during which a followed thread could run.
#[repr(C)]
#[derive(Clone, Copy)]
struct Runs {
    /// Number of runs so far.
    count: u64,
    runs: [Run; RUNS],
}

#[map]
static CPU_RUNS: PerCpuArray<Runs> = PerCpuArray::with_max_entries(1, 0);

/// `sched_switch(preempt, prev, next)`, in the context of `prev`.
#[inline(always)]
pub fn switched(context: &RawTracePointContext) {
    let id = bpf_get_current_pid_tgid();
    let (leaving, next): (u32, u64) = (thread_of(id), context.arg(2));
    let entering = number(next, THREAD);
    let (leaves, enters) = (is_followed(leaving), is_followed(entering));
    let is_any_runnable = is_any_runnable();
    if !leaves && !enters && !is_any_runnable {
        return;
    }
    let now = now();
    let Some(runs) = CPU_RUNS.get_ptr_mut(0) else {
        return;
    };
    if is_any_runnable {
        // SAFETY: a map value pointer checked against null.
        unsafe { remember(runs, id, now) };
    }
    if leaves && let Some(followed) = followed(leaving) {
        let is_preempted: u64 = context.arg(0);
        // SAFETY: as above.
        unsafe { left(followed, leaving, is_preempted as u8 != 0, now) };
    }
    if enters && let Some(followed) = followed(entering) {
        // SAFETY: as above.
        unsafe { entered(followed, runs, next, now) };
    }
}

/// `sched_waking(task)`, in the context of the thread or interrupt that wakes it.
#[inline(always)]
pub fn woken(context: &RawTracePointContext) {
    let thread = number(context.arg(0), THREAD);
    if !is_followed(thread) {
        return;
    }
    let Some(followed) = followed(thread) else {
        return;
    };
    // SAFETY: a map value pointer checked against null.
    unsafe {
        if (*followed).state != state::BLOCKED {
            return;
        }
        let now = now();
        let id = bpf_get_current_pid_tgid();
        (*followed).wait.waker = thread_of(id);
        (*followed).wait.waker_process = (id >> 32) as u32;
        let name = (&raw mut (*followed).wait.waker_name).cast();
        bpf_get_current_comm(name, NAME_BYTES as u32);
        (*followed).wait.waker_cgroup_id = bpf_get_current_cgroup_id();
        unblocked(followed, now);
        let role = (*followed).role;
        if role == role::RECEIVER {
            receiver_woken(followed, context.arg(0), now);
        } else if role == role::EXECUTOR {
            executor_woken(followed, id, now);
        }
        (*followed).state = state::RUNNABLE;
        (*followed).since = now;
        (*followed).woken = now;
        add_runnable(1);
    }
}

/// Handles that a thread of the middleware is woken. Messages come through a system call, or from
/// another process that wakes it in shared memory. Another thread of its own process may have
/// received one. All other waits delay the message.
#[inline(always)]
unsafe fn receiver_woken(receiver: *mut Followed, task: u64, now: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        let kind = (*receiver).wait.kind;
        let is_own = u64::from((*receiver).wait.waker_process) == (*receiver).process;
        let is_shared = kind == wait::LOCK as u32 && !is_own;
        if kind != wait::OTHER as u32 && !is_shared {
            if kind == wait::LOCK as u32 && (*receiver).wait.nanoseconds > LONG {
                (*receiver).handoff.woken = 0;
                clear(receiver);
            }
            return;
        }
        clear(receiver);
        copy(
            &raw const (*receiver).wait,
            &raw mut (*receiver).handoff.wait,
        );
        (*receiver).handoff.woken = now;
        (*receiver).throttled = throttled(task);
    }
}

/// Handles that the running thread ends a wait of a thread that calls callbacks. A long wait is that
/// for a message, and short ones for locks of the middleware may follow it. An executor's thread
/// wakes others after each call, because the callback group of that call may have further ones.
#[inline(always)]
unsafe fn executor_woken(executor: *mut Followed, id: u64, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        if (*executor).wait.kind != wait::LOCK as u32 || id >> 32 != (*executor).process {
            return;
        }
        let Some(receiver) = follow(thread_of(id)) else {
            return;
        };
        let role = (*receiver).role;
        if role == role::NONE {
            (*receiver).role = role::RECEIVER;
            (*receiver).process = id >> 32;
            (*receiver).since = now;
        } else if role != role::RECEIVER {
            if role == role::EXECUTOR {
                released(executor, receiver, now);
            }
            return;
        }
        let waited = (*executor).wait.nanoseconds;
        if waited <= (*executor).handoff_wait && waited <= LONG {
            return;
        }
        (*executor).handoff_wait = waited;
        let handoff = &raw mut (*executor).handoff;
        let woken = (*receiver).handoff.woken;
        (*handoff).at = now;
        (*handoff).thread = id & 0xffff_ffff;
        (*handoff).runnable_before = (*executor).activity.runnable;
        (*handoff).woken = woken;
        let runnable = (*receiver).activity.runnable;
        (*handoff).runnable = runnable;
        (*handoff).throttled = 0;
        if woken == 0 {
            return;
        }
        copy(
            &raw const (*receiver).handoff.wait,
            &raw mut (*handoff).wait,
        );
        if runnable >= STALL {
            let throttled = throttled(bpf_get_current_task());
            let throttled = throttled.wrapping_sub((*receiver).throttled);
            (*handoff).throttled = least(throttled, runnable);
            copy(
                &raw const (*receiver).activity.others,
                &raw mut (*handoff).others,
            );
        }
    }
}

/// Handles that one thread of an executor wakes another one: it has just ended a call, or it was
/// itself woken after one, and passes on the right to wait for work.
#[inline(always)]
unsafe fn released(woken: *mut Followed, waker: *const Followed, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        let of = |call: *const Call| now - read_volatile(&raw const (*call).ended) < RELEASE;
        let mut call = &raw const (*waker).previous;
        if !of(call) {
            call = &raw const (*waker).released_by;
        }
        if of(call) {
            copy(call, &raw mut (*woken).released_by);
        }
    }
}

/// Ends the present wait.
#[inline(always)]
unsafe fn unblocked(followed: *mut Followed, now: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        let since = (*followed).since;
        // The clocks of two CPUs may differ by nanoseconds.
        let waited = if now > since { now - since } else { 0 };
        (*followed).wait.nanoseconds = waited;
        block(followed, waited);
        if waited > (*followed).activity.longest.nanoseconds {
            copy(
                &raw const (*followed).wait,
                &raw mut (*followed).activity.longest,
            );
        }
        if (*followed).wait.kind == wait::STOPPED as u32 {
            copy(&raw const (*followed).wait, &raw mut (*followed).stop);
            (*followed).stop_ended = now;
        }
    }
}

/// Adds a time to the waits of the present kind.
#[inline(always)]
unsafe fn block(followed: *mut Followed, nanoseconds: u64) {
    let blocked = (unsafe { &raw mut (*followed).activity.blocked }).cast::<u64>();
    let kind = opaque(unsafe { (*followed).wait.kind }) & 7;
    if kind < wait::COUNT as u64 {
        // SAFETY: a map value, by the caller, and an index within the array.
        unsafe { *blocked.add(kind as usize) += nanoseconds };
    }
}

/// Handles that a followed thread leaves its CPU.
#[inline(always)]
unsafe fn left(followed: *mut Followed, thread: u32, is_preempted: bool, now: u64) {
    let task = unsafe { bpf_get_current_task() };
    let charged = word(task, RUNTIME).unwrap_or(0);
    let run_delay = word(task, RUN_DELAY).unwrap_or(0);
    // SAFETY: a map value, by the caller.
    unsafe {
        let since = (*followed).since;
        let span = now - since;
        let was = (*followed).state;
        if was == state::RUNNING {
            (*followed).activity.cpu += span;
            let entered = (*followed).entered;
            if entered != 0 {
                let ran = now - entered;
                let counted = charged.wrapping_sub((*followed).charged);
                (*followed).activity.stolen += ran - least(counted, ran);
            }
        } else {
            // It entered the CPU without an event.
            let waited = least(run_delay.wrapping_sub((*followed).run_delay), span);
            let rest = span - waited;
            let ran = least(charged.wrapping_sub((*followed).charged), rest);
            (*followed).activity.runnable += waited;
            (*followed).activity.missed += 1;
            if was == state::RUNNABLE {
                (*followed).activity.cpu += rest;
                add_runnable(-1);
            } else {
                (*followed).activity.cpu += ran;
                block(followed, rest - ran);
            }
        }
        (*followed).charged = charged;
        (*followed).run_delay = run_delay;
        (*followed).since = now;
        (*followed).entered = 0;
        let state = u64::from(number(task, STATE));
        if state & task::DEAD != 0 {
            forget(thread);
        } else if is_preempted || state == 0 || state == task::WAKING {
            (*followed).state = state::RUNNABLE;
            add_runnable(1);
        } else {
            (*followed).state = state::BLOCKED;
            begin_wait(&raw mut (*followed).wait, state);
        }
    }
}

/// Handles that a followed thread enters a CPU.
#[inline(always)]
unsafe fn entered(followed: *mut Followed, runs: *const Runs, task: u64, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        let since = (*followed).since;
        let was = (*followed).state;
        if was == state::RUNNABLE {
            let waited = now - since;
            (*followed).activity.runnable += waited;
            if waited > SHORT {
                attribute(&raw mut (*followed).activity, runs, since);
            }
            add_runnable(-1);
        } else if was == state::BLOCKED {
            (*followed).activity.missed += 1;
            unblocked(followed, now);
        }
        (*followed).state = state::RUNNING;
        (*followed).since = now;
        (*followed).entered = now;
        (*followed).charged = word(task, RUNTIME).unwrap_or(0);
    }
}

/// Remembers that the running thread leaves its CPU.
#[inline(always)]
unsafe fn remember(runs: *mut Runs, id: u64, now: u64) {
    // SAFETY: a map value, by the caller, and an index within the array.
    unsafe {
        let count = (*runs).count;
        (*runs).count = count + 1;
        let index = opaque(count as u32) & (RUNS as u64 - 1);
        let run = (&raw mut (*runs).runs).cast::<Run>().add(index as usize);
        (*run).until = now;
        (*run).id = id;
        bpf_get_current_comm((&raw mut (*run).name).cast(), NAME_BYTES as u32);
        (*run).cgroup_id = bpf_get_current_cgroup_id();
        let task = bpf_get_current_task();
        let priority = read::<i32>(member(task, PRIORITY));
        (*run).priority = priority.map_or(UNKNOWN_PRIORITY, i64::from);
    }
}

/// Adds the runs of this CPU since `since` to those that ran instead. Threads whose ids end with the
/// same bits share a place: a thread takes it from another one if its run is longer than the time of
/// that one so far.
///
/// The body has no branch but the end of the loop, because the verifier would follow each
/// combination of branches.
#[inline(always)]
unsafe fn attribute(activity: *mut Activity, runs: *const Runs, since: u64) {
    // SAFETY: map values, by the caller, and indices within the arrays.
    unsafe {
        let count = read_volatile(&raw const (*runs).count);
        let all = (&raw const (*runs).runs).cast::<Run>();
        let mut back = 1;
        while back < RUNS as u64 {
            let index = opaque(count.wrapping_sub(back) as u32) & (RUNS as u64 - 1);
            let earlier = opaque(count.wrapping_sub(back + 1) as u32) & (RUNS as u64 - 1);
            let run = all.add(index as usize);
            let until = read_volatile(&raw const (*run).until);
            if until <= since {
                break;
            }
            let from = read_volatile(&raw const (*all.add(earlier as usize)).until);
            let from = select(is_less(from, since), since, from);
            let ran = until.wrapping_sub(from);
            let id = read_volatile(&raw const (*run).id);
            let place = opaque(id as u32) & (OTHERS as u64 - 1);
            let others = (&raw mut (*activity).others).cast::<Other>();
            let other = others.add(place as usize).cast::<u64>();
            let known = read_volatile(other);
            let known_id = read_volatile(other.add(1));
            let is_same = !is_less(0, id ^ known_id);
            let is_new = is_less(known, ran) & !is_same;
            write_volatile(other, select(is_new, ran, known + (ran & is_same)));
            write_volatile(other.add(1), select(is_new, id, known_id));
            let is_named = is_new | is_same;
            let name = (&raw const (*run).name).cast::<u64>();
            let (low, high) = (read_volatile(name), read_volatile(name.add(1)));
            let (known_low, known_high) =
                (read_volatile(other.add(2)), read_volatile(other.add(3)));
            write_volatile(other.add(2), select(is_named, low, known_low));
            write_volatile(other.add(3), select(is_named, high, known_high));
            let (cgroup_id, priority) = (
                read_volatile(&raw const (*run).cgroup_id),
                read_volatile(&raw const (*run).priority) as u64,
            );
            let (known_cgroup_id, known_priority) =
                (read_volatile(other.add(4)), read_volatile(other.add(5)));
            write_volatile(other.add(4), select(is_named, cgroup_id, known_cgroup_id));
            write_volatile(other.add(5), select(is_named, priority, known_priority));
            back += 1;
        }
    }
}

/// Returns all ones if `one` is less than `other`, otherwise 0. Both are below 2^63.
#[inline(always)]
fn is_less(one: u64, other: u64) -> u64 {
    let mut difference = one.wrapping_sub(other);
    // SAFETY: changes only its operand.
    unsafe {
        asm!("{0} s>>= 63", inout(reg) difference, options(pure, nomem, nostack, preserves_flags));
    }
    difference
}

/// Returns the first number where `mask` has ones, and the second where it has zeros.
#[inline(always)]
const fn select(mask: u64, first: u64, second: u64) -> u64 {
    second ^ ((first ^ second) & mask)
}

/// Notes for what the running thread begins to wait.
#[inline(always)]
unsafe fn begin_wait(wait: *mut Blocked, state: u64) {
    let (number, argument) = system_call();
    // SAFETY: a map value, by the caller.
    unsafe {
        (*wait).kind = kind_of(state, number) as u32;
        (*wait).call = number;
        (*wait).argument = argument;
        (*wait).waker = 0;
    }
}

/// Returns the number of the running thread's system call, and its first argument.
#[inline(always)]
fn system_call() -> (u32, u64) {
    // SAFETY: no preconditions; the registers are those of the running thread.
    let registers = unsafe { bpf_task_pt_regs(bpf_get_current_task_btf()) } as u64;
    // `orig_ax` and `di` of x86; `syscallno` and `orig_x0` of AArch64.
    let (number, argument) = match is_aarch64() {
        true => (280, 272),
        false => (120, 112),
    };
    (
        read::<u32>(registers + number).unwrap_or(u32::MAX),
        read::<u64>(registers + argument).unwrap_or(0),
    )
}

/// Returns one of [`wait`].
#[inline(always)]
fn kind_of(state: u64, number: u32) -> usize {
    if state & task::STOPPED_OR_TRACED != 0 {
        return wait::STOPPED;
    }
    if number == u32::MAX {
        return wait::PAGE_FAULT;
    }
    if state & task::UNINTERRUPTIBLE != 0 {
        return wait::DISK;
    }
    let (futex, sleep, clock_sleep) = match is_aarch64() {
        true => (98, 101, 115),
        false => (202, 35, 230),
    };
    if number == futex {
        wait::LOCK
    } else if number == sleep || number == clock_sleep {
        wait::SLEEP
    } else {
        wait::OTHER
    }
}

/// Returns a member of 32 bits of a task; 0 if it cannot be read.
#[inline(always)]
fn number(task: u64, of: usize) -> u32 {
    read(member(task, of)).unwrap_or(0)
}

/// Returns the address of a member of a task, by `accounting`.
#[inline(always)]
fn member(task: u64, of: usize) -> u64 {
    task.wrapping_add(u64::from(crate::accounting::offset(of)))
}

#[inline(always)]
fn read<T: Copy>(address: u64) -> Option<T> {
    // SAFETY: the kernel checks the address; only integers are read.
    unsafe { bpf_probe_read_kernel(address as *const T) }.ok()
}

#[inline(always)]
const fn thread_of(id: u64) -> u32 {
    id as u32
}
