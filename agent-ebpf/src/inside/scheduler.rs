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
    accounting::{min, read_u64, throttled},
    instructions::hide_bounds,
    late::{
        Followed, add_runnable, copy, follow, followed, forget, is_any_runnable, is_followed,
        reset_activity, role, state,
    },
    maps::now,
    registers::is_aarch64,
};

/// Runs of threads that a CPU remembers; a power of two.
const RUN_HISTORY_LEN: usize = 64;
/// Threads whose properties a CPU remembers; a power of two.
const KNOWN_THREADS: usize = 64;
/// Time for which the properties of a thread are not read again, in nanoseconds.
const PROPERTIES_AGE_NS: u64 = 100_000_000;
/// Waits below this time are not divided among other threads, in nanoseconds.
const MIN_ATTRIBUTED_WAIT_NS: u64 = 20_000;

/// Minimum of a wait that is not one for a lock of the middleware, in nanoseconds.
const MIN_MESSAGE_WAIT_NS: u64 = 1_000_000;

/// States of `task_struct.__state` (include/linux/sched.h).
mod task_state {
    pub const UNINTERRUPTIBLE: u64 = 2;
    pub const STOPPED_OR_TRACED: u64 = 4 | 8;
    pub const DEAD: u64 = 0x80;
    pub const WAKING: u64 = 0x200;
}

/// What is known of a thread.
#[repr(C)]
#[derive(Clone, Copy)]
struct ThreadIdentity {
    /// Thread id in the low half, process id in the high half.
    id: u64,
    name: [u64; NAME_BYTES / 8],
    /// As in [`Other`].
    cgroup_id: u64,
    priority: i64,
}

/// A run of a thread on a CPU.
#[repr(C)]
#[derive(Clone, Copy)]
struct ThreadRun {
    end_ns: u64,
    thread: ThreadIdentity,
}

/// A thread that ran on a CPU, and when its properties were read.
#[repr(C)]
#[derive(Clone, Copy)]
struct KnownThread {
    read_ns: u64,
    thread: ThreadIdentity,
}

/// The last runs of a CPU. Only those are present during which a followed thread could run.
#[repr(C)]
#[derive(Clone, Copy)]
struct RunHistory {
    /// Number of runs so far.
    count: u64,
    runs: [ThreadRun; RUN_HISTORY_LEN],
    /// Threads of these runs, by the low bits of their ids: to read a thread's properties takes
    /// longer than all the rest.
    known: [KnownThread; KNOWN_THREADS],
}

#[map]
static CPU_RUNS: PerCpuArray<RunHistory> = PerCpuArray::with_max_entries(1, 0);

/// `sched_switch(preempt, prev, next)`, in the context of `prev`.
#[inline(always)]
pub fn on_sched_switch(context: &RawTracePointContext) {
    let id = bpf_get_current_pid_tgid();
    let (prev_tid, next): (u32, u64) = (tid(id), context.arg(2));
    let next_tid = read_task_u32(next, THREAD);
    let (is_prev_followed, is_next_followed) = (is_followed(prev_tid), is_followed(next_tid));
    let is_any_runnable = is_any_runnable();
    if !is_prev_followed && !is_next_followed && !is_any_runnable {
        return;
    }
    let now = now();
    let Some(runs) = CPU_RUNS.get_ptr_mut(0) else {
        return;
    };
    if is_any_runnable {
        // SAFETY: a map value pointer checked against null.
        unsafe { record_run(runs, id, now) };
    }
    if is_prev_followed && let Some(followed) = followed(prev_tid) {
        let is_preempted: u64 = context.arg(0);
        // SAFETY: as above.
        unsafe { on_switch_out(followed, prev_tid, is_preempted as u8 != 0, now) };
    }
    if is_next_followed && let Some(followed) = followed(next_tid) {
        // SAFETY: as above.
        unsafe { on_switch_in(followed, runs, next, now) };
    }
}

/// `sched_waking(task)`, in the context of the thread or interrupt that wakes it.
#[inline(always)]
pub fn on_sched_waking(context: &RawTracePointContext) {
    let thread = read_task_u32(context.arg(0), THREAD);
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
        (*followed).current_wait.waker = tid(id);
        (*followed).current_wait.waker_process = (id >> 32) as u32;
        let name = (&raw mut (*followed).current_wait.waker_name).cast();
        bpf_get_current_comm(name, NAME_BYTES as u32);
        (*followed).current_wait.waker_cgroup_id = bpf_get_current_cgroup_id();
        end_wait(followed, now);
        let role = (*followed).role;
        if role == role::RECEIVER {
            on_receiver_wakeup(followed, context.arg(0), now);
        } else if role == role::EXECUTOR {
            on_executor_wakeup(followed, id, now);
        }
        (*followed).state = state::RUNNABLE;
        (*followed).state_since_ns = now;
        (*followed).last_wakeup_ns = now;
        add_runnable(1);
    }
}

/// Handles that a thread of the middleware is woken. Messages come through a system call, or from
/// another process that wakes it in shared memory. Another thread of its own process may have
/// received one. All other waits delay the message.
#[inline(always)]
unsafe fn on_receiver_wakeup(receiver: *mut Followed, task: u64, now: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        let kind = (*receiver).current_wait.kind;
        let is_own = u64::from((*receiver).current_wait.waker_process) == (*receiver).process;
        let is_shared = kind == wait::LOCK as u32 && !is_own;
        if kind != wait::OTHER as u32 && !is_shared {
            if kind == wait::LOCK as u32
                && (*receiver).current_wait.nanoseconds > MIN_MESSAGE_WAIT_NS
            {
                (*receiver).handoff.woken = 0;
                reset_activity(receiver);
            }
            return;
        }
        reset_activity(receiver);
        copy(
            &raw const (*receiver).current_wait,
            &raw mut (*receiver).handoff.wait,
        );
        (*receiver).handoff.woken = now;
        (*receiver).throttled = throttled(task);
    }
}

/// Handles that the running thread ends a wait of a thread that calls callbacks. A long wait is
/// that for a message, and short ones for locks of the middleware may follow it. An executor's
/// thread wakes others after each call, because the callback group of that call may have further
/// ones.
#[inline(always)]
unsafe fn on_executor_wakeup(executor: *mut Followed, id: u64, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        if (*executor).current_wait.kind != wait::LOCK as u32 || id >> 32 != (*executor).process {
            return;
        }
        let Some(receiver) = follow(tid(id)) else {
            return;
        };
        let role = (*receiver).role;
        if role == role::NONE {
            (*receiver).role = role::RECEIVER;
            (*receiver).process = id >> 32;
            (*receiver).state_since_ns = now;
        } else if role != role::RECEIVER {
            if role == role::EXECUTOR {
                note_release(executor, receiver, now);
            }
            return;
        }
        let waited = (*executor).current_wait.nanoseconds;
        if waited <= (*executor).wait_before_handoff_ns && waited <= MIN_MESSAGE_WAIT_NS {
            return;
        }
        (*executor).wait_before_handoff_ns = waited;
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
            (*handoff).throttled = min(throttled, runnable);
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
unsafe fn note_release(woken: *mut Followed, waker: *const Followed, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        let is_recent = |call: *const Call| now - read_volatile(&raw const (*call).ended) < RELEASE;
        let mut call = &raw const (*waker).previous_call;
        if !is_recent(call) {
            call = &raw const (*waker).released_by;
        }
        if is_recent(call) {
            copy(call, &raw mut (*woken).released_by);
        }
    }
}

/// Ends the present wait.
#[inline(always)]
unsafe fn end_wait(followed: *mut Followed, now: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        let since = (*followed).state_since_ns;
        // The clocks of two CPUs may differ by nanoseconds.
        let waited = if now > since { now - since } else { 0 };
        (*followed).current_wait.nanoseconds = waited;
        add_blocked_time(followed, waited);
        if waited > (*followed).activity.longest.nanoseconds {
            copy(
                &raw const (*followed).current_wait,
                &raw mut (*followed).activity.longest,
            );
        }
        if (*followed).current_wait.kind == wait::STOPPED as u32 {
            copy(
                &raw const (*followed).current_wait,
                &raw mut (*followed).last_stop,
            );
            (*followed).last_stop_end_ns = now;
        }
    }
}

/// Adds a time to the waits of the present kind.
#[inline(always)]
unsafe fn add_blocked_time(followed: *mut Followed, nanoseconds: u64) {
    let blocked = (unsafe { &raw mut (*followed).activity.blocked }).cast::<u64>();
    let kind = hide_bounds(unsafe { (*followed).current_wait.kind }) & 7;
    if kind < wait::COUNT as u64 {
        // SAFETY: a map value, by the caller, and an index within the array.
        unsafe { *blocked.add(kind as usize) += nanoseconds };
    }
}

/// Handles that a followed thread leaves its CPU.
#[inline(always)]
unsafe fn on_switch_out(followed: *mut Followed, thread: u32, is_preempted: bool, now: u64) {
    let task = unsafe { bpf_get_current_task() };
    let charged = read_u64(task, RUNTIME).unwrap_or(0);
    let run_delay = read_u64(task, RUN_DELAY).unwrap_or(0);
    // SAFETY: a map value, by the caller.
    unsafe {
        let since = (*followed).state_since_ns;
        let span = now - since;
        let previous_state = (*followed).state;
        if previous_state == state::RUNNING {
            (*followed).activity.cpu += span;
            let entered = (*followed).on_cpu_since_ns;
            if entered != 0 {
                let ran_ns = now - entered;
                let charged_ns = charged.wrapping_sub((*followed).sum_exec_runtime_ns);
                (*followed).activity.stolen += ran_ns - min(charged_ns, ran_ns);
            }
        } else {
            // It entered the CPU without an event.
            let waited = min(run_delay.wrapping_sub((*followed).run_delay), span);
            let remaining_ns = span - waited;
            let ran_ns = min(
                charged.wrapping_sub((*followed).sum_exec_runtime_ns),
                remaining_ns,
            );
            (*followed).activity.runnable += waited;
            (*followed).activity.missed += 1;
            if previous_state == state::RUNNABLE {
                (*followed).activity.cpu += remaining_ns;
                add_runnable(-1);
            } else {
                (*followed).activity.cpu += ran_ns;
                add_blocked_time(followed, remaining_ns - ran_ns);
            }
        }
        (*followed).sum_exec_runtime_ns = charged;
        (*followed).run_delay = run_delay;
        (*followed).state_since_ns = now;
        (*followed).on_cpu_since_ns = 0;
        let state = u64::from(read_task_u32(task, STATE));
        if state & task_state::DEAD != 0 {
            forget(thread);
        } else if is_preempted || state == 0 || state == task_state::WAKING {
            (*followed).state = state::RUNNABLE;
            add_runnable(1);
        } else {
            (*followed).state = state::BLOCKED;
            start_wait(&raw mut (*followed).current_wait, state);
        }
    }
}

/// Handles that a followed thread enters a CPU.
#[inline(always)]
unsafe fn on_switch_in(followed: *mut Followed, runs: *const RunHistory, task: u64, now: u64) {
    // SAFETY: map values, by the caller.
    unsafe {
        let since = (*followed).state_since_ns;
        let previous_state = (*followed).state;
        if previous_state == state::RUNNABLE {
            let waited = now - since;
            (*followed).activity.runnable += waited;
            if waited > MIN_ATTRIBUTED_WAIT_NS {
                attribute_wait(&raw mut (*followed).activity, runs, since);
            }
            add_runnable(-1);
        } else if previous_state == state::BLOCKED {
            (*followed).activity.missed += 1;
            end_wait(followed, now);
        }
        (*followed).state = state::RUNNING;
        (*followed).state_since_ns = now;
        (*followed).on_cpu_since_ns = now;
        (*followed).sum_exec_runtime_ns = read_u64(task, RUNTIME).unwrap_or(0);
    }
}

/// Remembers that the running thread leaves its CPU.
#[inline(always)]
unsafe fn record_run(runs: *mut RunHistory, id: u64, now: u64) {
    // SAFETY: a map value, by the caller, and an index within the array.
    unsafe {
        let count = (*runs).count;
        (*runs).count = count + 1;
        let index = hide_bounds(count as u32) & (RUN_HISTORY_LEN as u64 - 1);
        let run = (&raw mut (*runs).runs)
            .cast::<ThreadRun>()
            .add(index as usize);
        (*run).end_ns = now;
        let slot = hide_bounds(id as u32) & (KNOWN_THREADS as u64 - 1);
        let known = (&raw mut (*runs).known)
            .cast::<KnownThread>()
            .add(slot as usize);
        if (*known).thread.id != id || now - (*known).read_ns > PROPERTIES_AGE_NS {
            (*known).read_ns = now;
            read_properties(&raw mut (*known).thread, id);
        }
        copy(&raw const (*known).thread, &raw mut (*run).thread);
    }
}

/// Reads the properties of the running thread.
#[inline(always)]
unsafe fn read_properties(thread: *mut ThreadIdentity, id: u64) {
    // SAFETY: a map value, by the caller.
    unsafe {
        (*thread).id = id;
        bpf_get_current_comm((&raw mut (*thread).name).cast(), NAME_BYTES as u32);
        (*thread).cgroup_id = bpf_get_current_cgroup_id();
        let task = bpf_get_current_task();
        let priority = read::<i32>(task_member_address(task, PRIORITY));
        (*thread).priority = priority.map_or(UNKNOWN_PRIORITY, i64::from);
    }
}

/// Adds the runs of this CPU since `since` to those that ran instead. Threads whose ids end with
/// the same bits share a place: a thread takes it from another one if its run is longer than the
/// time of that one so far.
///
/// The body has no branch but the end of the loop, because the verifier would follow each
/// combination of branches.
#[inline(always)]
unsafe fn attribute_wait(activity: *mut Activity, runs: *const RunHistory, since: u64) {
    // SAFETY: map values, by the caller, and indices within the arrays.
    unsafe {
        let count = read_volatile(&raw const (*runs).count);
        let all = (&raw const (*runs).runs).cast::<ThreadRun>();
        let mut age = 1;
        while age < RUN_HISTORY_LEN as u64 {
            let index = hide_bounds(count.wrapping_sub(age) as u32) & (RUN_HISTORY_LEN as u64 - 1);
            let previous_index =
                hide_bounds(count.wrapping_sub(age + 1) as u32) & (RUN_HISTORY_LEN as u64 - 1);
            let run = all.add(index as usize);
            let end_ns = read_volatile(&raw const (*run).end_ns);
            if end_ns <= since {
                break;
            }
            let start_ns = read_volatile(&raw const (*all.add(previous_index as usize)).end_ns);
            let start_ns = select(less_mask(start_ns, since), since, start_ns);
            let ran_ns = end_ns.wrapping_sub(start_ns);
            let id = read_volatile(&raw const (*run).thread.id);
            let slot = hide_bounds(id as u32) & (OTHERS as u64 - 1);
            let others = (&raw mut (*activity).others).cast::<Other>();
            let other = others.add(slot as usize).cast::<u64>();
            let known_ns = read_volatile(other);
            let known_id = read_volatile(other.add(1));
            let same_mask = !less_mask(0, id ^ known_id);
            let new_mask = less_mask(known_ns, ran_ns) & !same_mask;
            write_volatile(
                other,
                select(new_mask, ran_ns, known_ns + (ran_ns & same_mask)),
            );
            write_volatile(other.add(1), select(new_mask, id, known_id));
            let update_mask = new_mask | same_mask;
            let name = (&raw const (*run).thread.name).cast::<u64>();
            let (low, high) = (read_volatile(name), read_volatile(name.add(1)));
            let (known_low, known_high) =
                (read_volatile(other.add(2)), read_volatile(other.add(3)));
            write_volatile(other.add(2), select(update_mask, low, known_low));
            write_volatile(other.add(3), select(update_mask, high, known_high));
            let (cgroup_id, priority) = (
                read_volatile(&raw const (*run).thread.cgroup_id),
                read_volatile(&raw const (*run).thread.priority) as u64,
            );
            let (known_cgroup_id, known_priority) =
                (read_volatile(other.add(4)), read_volatile(other.add(5)));
            write_volatile(
                other.add(4),
                select(update_mask, cgroup_id, known_cgroup_id),
            );
            write_volatile(other.add(5), select(update_mask, priority, known_priority));
            age += 1;
        }
    }
}

/// Returns all ones if `one` is less than `other`, otherwise 0. Both are below 2^63.
#[inline(always)]
fn less_mask(one: u64, other: u64) -> u64 {
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
unsafe fn start_wait(wait: *mut Blocked, state: u64) {
    let (syscall_number, argument) = current_syscall();
    // SAFETY: a map value, by the caller.
    unsafe {
        (*wait).kind = wait_kind(state, syscall_number) as u32;
        (*wait).call = syscall_number;
        (*wait).argument = argument;
        (*wait).waker = 0;
    }
}

/// Returns the number of the running thread's system call, and its first argument.
#[inline(always)]
fn current_syscall() -> (u32, u64) {
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
fn wait_kind(state: u64, syscall_number: u32) -> usize {
    if state & task_state::STOPPED_OR_TRACED != 0 {
        return wait::STOPPED;
    }
    if syscall_number == u32::MAX {
        return wait::PAGE_FAULT;
    }
    if state & task_state::UNINTERRUPTIBLE != 0 {
        return wait::DISK;
    }
    let (futex, sleep, clock_sleep) = match is_aarch64() {
        true => (98, 101, 115),
        false => (202, 35, 230),
    };
    if syscall_number == futex {
        wait::LOCK
    } else if syscall_number == sleep || syscall_number == clock_sleep {
        wait::SLEEP
    } else {
        wait::OTHER
    }
}

/// Returns a member of 32 bits of a task; 0 if it cannot be read.
#[inline(always)]
fn read_task_u32(task: u64, of: usize) -> u32 {
    read(task_member_address(task, of)).unwrap_or(0)
}

/// Returns the address of a member of a task, by `accounting`.
#[inline(always)]
fn task_member_address(task: u64, of: usize) -> u64 {
    task.wrapping_add(u64::from(crate::accounting::offset(of)))
}

#[inline(always)]
fn read<T: Copy>(address: u64) -> Option<T> {
    // SAFETY: the kernel checks the address; only integers are read.
    unsafe { bpf_probe_read_kernel(address as *const T) }.ok()
}

#[inline(always)]
const fn tid(id: u64) -> u32 {
    id as u32
}
