//! Items of late calls: from the kernel programs' layout to the model's.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::calls::late::{
    Activity, Blocked, BusyTime, CpuLimit, Handoff, LateBound, LateCall, MessageDelivery,
    PreviousCall, Repairs, Stop, WaitingStates,
};
use ros2probe_model::facts::calls::other_thread::{OtherThread, Priority};
use ros2probe_model::facts::calls::report::{ThreadStates, Trigger};
use ros2probe_model::facts::names::NodeName;
use ros2probe_wire::Timestamp;
use ros2probe_wire::inside::late::{self, mode, wait};
use ros2probe_wire::inside::thread_state;

use crate::system::Clocks;

/// Maximum number of threads that are named for a span of a late call.
const MAX_NAMED_THREADS: usize = 4;
/// Values of `LateCall::accounted`.
const ACCOUNTED_DURING: u32 = 1;
const ACCOUNTED_BEFORE: u32 = 2;

/// Returns the unit of a control group, by the inode of its directory.
pub(super) type UnitOf<'a> = &'a dyn Fn(u64) -> Option<Arc<str>>;

/// Returns the control groups of the threads that these calls name, by the inodes of their
/// directories.
pub(in crate::inside) fn cgroup_ids(calls: &[late::LateCall]) -> BTreeSet<u64> {
    let of_call = |call: &late::LateCall| {
        let activities = [call.during, call.before];
        let waker = |blocked: &late::Blocked| match has_waker(blocked) {
            true => blocked.waker_cgroup_id,
            false => 0,
        };
        let of_others = |others: [late::Other; late::OTHERS]| others.map(|other| other.cgroup_id);
        let others = activities.map(|activity| of_others(activity.others));
        let others = others.into_iter().chain([of_others(call.handoff.others)]);
        let wakers = activities.map(|activity| waker(&activity.longest));
        let groups = others.flatten().chain(wakers);
        groups.chain([waker(&call.stop), waker(&call.handoff.wait)])
    };
    calls
        .iter()
        .flat_map(of_call)
        .filter(|group| *group != 0)
        .collect()
}

/// Converts one item. `name` returns the trigger and node of a callback of the same process.
pub(in crate::inside) fn convert(
    call: &late::LateCall,
    clocks: &Clocks,
    delivery: Option<MessageDelivery>,
    cpu_limits: &Arc<[CpuLimit]>,
    unit_of: UnitOf<'_>,
    mut name: impl FnMut(u64) -> (Trigger, Option<NodeName>),
) -> LateCall {
    let (trigger, node) = name(call.callback);
    let between = |from: u64, to: u64| Duration::from_nanos(to.saturating_sub(from));
    let mut earlier = |earlier: &late::Call| {
        let (trigger, node) = name(earlier.callback);
        let earlier = PreviousCall {
            handle: earlier.callback,
            trigger,
            duration: between(earlier.started, earlier.ended),
            ended_before: between(earlier.ended, call.started),
        };
        (earlier, node)
    };
    let previous = (call.previous.ended != 0).then(|| earlier(&call.previous).0);
    let busy = (call.longest_call.ended != 0).then(|| BusyTime {
        began_before: between(call.busy_since, call.started),
        in_callbacks: Duration::from_nanos(call.in_calls),
        states: WaitingStates {
            runnable: Duration::from_nanos(call.busy_runnable),
            throttled: Duration::from_nanos(call.busy_throttled),
        },
        longest: earlier(&call.longest_call).0,
    });
    // A callback group belongs to one node, and the thread began soon after it had a CPU.
    let released_by = (call.released_by.ended != 0).then(|| earlier(&call.released_by));
    let soon = Duration::from_nanos(late::RELEASE + call.before.runnable);
    let released_by =
        released_by.filter(|(call, of)| of.is_some() && *of == node && call.ended_before <= soon);
    let states = |bit, states: &_| (call.accounted & bit != 0).then(|| thread_states(states));
    let has_events = call.mode == mode::EVENTS;
    let is_message = matches!(trigger, Trigger::Subscription(_));
    let [duration, wait] = call.bounds.map(Duration::from_nanos);
    LateCall {
        process: call.process,
        handle: call.callback,
        node,
        trigger,
        thread: call.thread,
        cpu: call.cpu,
        delivery,
        handoff: (has_events && is_message && call.handoff.at != 0).then(|| handoff(call, unit_of)),
        repairs: Repairs::default(),
        cpu_limits: Arc::clone(cpu_limits),
        stop: (call.stop_ended != 0 && call.stop_ended <= call.started).then(|| Stop {
            ended_before: between(call.stop_ended, call.started),
            wait: blocked(&call.stop, unit_of),
        }),
        source: (call.source_timestamp != 0).then_some(Timestamp(call.source_timestamp)),
        started: clocks.wall_time_of(call.started),
        duration: between(call.started, call.ended),
        wait: (call.delay != 0).then(|| Duration::from_nanos(call.delay)),
        bound: LateBound { duration, wait },
        previous,
        busy,
        released_by: released_by.map(|(call, _)| call),
        states: states(ACCOUNTED_DURING, &call.states),
        states_before: states(ACCOUNTED_BEFORE, &call.states_before),
        activity: has_events.then(|| activity(&call.during, unit_of)),
        activity_before: has_events.then(|| activity(&call.before, unit_of)),
    }
}

fn thread_states(states: &[u64; thread_state::COUNT]) -> ThreadStates {
    let [cpu, throttled, runnable, blocked] = *states;
    ThreadStates {
        calls: 1,
        cpu,
        throttled,
        runnable,
        blocked,
    }
}

fn handoff(call: &late::LateCall, unit_of: UnitOf<'_>) -> Handoff {
    let handoff = &call.handoff;
    let before = |time| Duration::from_nanos(call.started.saturating_sub(time));
    let throttled = Duration::from_nanos(handoff.throttled);
    let sender = blocked(&handoff.wait, unit_of).waker;
    Handoff {
        thread: handoff.thread as u32,
        woken_before: before(handoff.at),
        runnable_before: Duration::from_nanos(handoff.runnable_before),
        received_before: (handoff.woken != 0).then(|| before(handoff.woken)),
        receiver: WaitingStates {
            runnable: Duration::from_nanos(handoff.runnable).saturating_sub(throttled),
            throttled,
        },
        others: match handoff.runnable {
            late::STALL.. => others(&handoff.others, unit_of),
            _ => Vec::new(),
        },
        sender: sender.filter(|_| handoff.woken != 0),
    }
}

/// Returns the threads that ran for longest, with the longest time first.
fn others(others: &[late::Other], unit_of: UnitOf<'_>) -> Vec<OtherThread> {
    let others = others.iter().filter(|other| other.nanoseconds != 0);
    let mut others: Vec<_> = others
        .map(|other| OtherThread {
            duration: Duration::from_nanos(other.nanoseconds),
            thread: other.thread,
            process: other.process,
            name: name(&other.name),
            unit: unit_of(other.cgroup_id),
            priority: Priority::of_kernel(other.priority),
        })
        .collect();
    others.sort_by(|one, other| other.cmp(one));
    others.truncate(MAX_NAMED_THREADS);
    others.shrink_to_fit();
    others
}

fn activity(activity: &late::Activity, unit_of: UnitOf<'_>) -> Activity {
    let longest = &activity.longest;
    Activity {
        cpu: Duration::from_nanos(activity.cpu),
        missed_events: activity.missed,
        runnable: Duration::from_nanos(activity.runnable),
        stolen: Duration::from_nanos(activity.stolen),
        blocked: activity.blocked.map(Duration::from_nanos),
        longest: (longest.nanoseconds != 0).then(|| blocked(longest, unit_of)),
        others: others(&activity.others, unit_of),
    }
}

fn blocked(blocked: &late::Blocked, unit_of: UnitOf<'_>) -> Blocked {
    Blocked {
        duration: Duration::from_nanos(blocked.nanoseconds),
        kind: blocked.kind as usize,
        call: (blocked.call != u32::MAX).then(|| system_call(blocked.call)),
        argument: blocked.argument,
        waker: has_waker(blocked).then(|| OtherThread {
            duration: Duration::ZERO,
            thread: blocked.waker,
            process: blocked.waker_process,
            name: name(&blocked.waker_name),
            unit: unit_of(blocked.waker_cgroup_id),
            priority: None,
        }),
    }
}

/// Returns whether the thread that ended a wait is known. An interrupt ends any other wait,
/// whatever thread it interrupts.
const fn has_waker(blocked: &late::Blocked) -> bool {
    matches!(blocked.kind as usize, wait::LOCK | wait::STOPPED) && blocked.waker != 0
}

fn name(bytes: &[u8; late::NAME_BYTES]) -> Arc<str> {
    let end = bytes.iter().position(|byte| *byte == 0);
    let name = bytes.get(..end.unwrap_or(bytes.len())).unwrap_or_default();
    String::from_utf8_lossy(name).into()
}

/// Returns the name of a system call in which threads wait, otherwise its number.
fn system_call(number: u32) -> Arc<str> {
    macro_rules! names {
        ($($name:ident = $call:ident),* $(,)?) => {
            [$((libc::$call, stringify!($name))),*]
        };
    }
    let names = names![
        accept4 = SYS_accept4,
        clock_nanosleep = SYS_clock_nanosleep,
        close = SYS_close,
        connect = SYS_connect,
        epoll_pwait = SYS_epoll_pwait,
        fallocate = SYS_fallocate,
        fdatasync = SYS_fdatasync,
        flock = SYS_flock,
        fsync = SYS_fsync,
        ftruncate = SYS_ftruncate,
        futex = SYS_futex,
        getdents64 = SYS_getdents64,
        io_uring_enter = SYS_io_uring_enter,
        ioctl = SYS_ioctl,
        madvise = SYS_madvise,
        mmap = SYS_mmap,
        mprotect = SYS_mprotect,
        msync = SYS_msync,
        munmap = SYS_munmap,
        nanosleep = SYS_nanosleep,
        openat = SYS_openat,
        ppoll = SYS_ppoll,
        pread64 = SYS_pread64,
        pselect6 = SYS_pselect6,
        pwrite64 = SYS_pwrite64,
        read = SYS_read,
        readv = SYS_readv,
        recvfrom = SYS_recvfrom,
        recvmmsg = SYS_recvmmsg,
        recvmsg = SYS_recvmsg,
        sendmmsg = SYS_sendmmsg,
        sendmsg = SYS_sendmsg,
        sendto = SYS_sendto,
        sync_file_range = SYS_sync_file_range,
        unlinkat = SYS_unlinkat,
        wait4 = SYS_wait4,
        waitid = SYS_waitid,
        write = SYS_write,
        writev = SYS_writev,
    ];
    #[cfg(target_arch = "x86_64")]
    let old = names![
        epoll_wait = SYS_epoll_wait,
        open = SYS_open,
        poll = SYS_poll,
        select = SYS_select,
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let old: [(i64, &str); 0] = [];
    let mut all = names.iter().chain(&old);
    let known = all.find(|(known, _)| *known == i64::from(number));
    known.map_or_else(
        || format!("system call {number}").into(),
        |(_, name)| Arc::from(*name),
    )
}
