//! Late callbacks: what a callback's thread did before and during one call.
//!
//! The programs at the functions of rclcpp report each call that exceeds a [`Bound`]. Programs at
//! the events of the scheduler add who ran while the thread could run, and for what it waited.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::{Handle, thread_state};

/// Maximum number of threads that the programs follow. The least recently used ones are forgotten.
pub const THREAD_CAPACITY: u32 = 1_024;
/// Maximum number of callbacks with a bound.
pub const BOUND_CAPACITY: u32 = 2_048;
/// Maximum number of late calls reported per callback and second.
pub const PER_SECOND: u64 = 16;
/// Number of thread ids, `PID_MAX_LIMIT` of the kernel.
pub const THREAD_IDS: u32 = 4 << 20;
/// Number of threads in an [`Activity`] that ran instead.
pub const OTHERS: usize = 8;
/// Size of a thread's name with its terminating zero, `TASK_COMM_LEN` of the kernel.
pub const NAME_BYTES: usize = 16;

/// Maximum time from the end of a call until a thread that waited for it is woken, in nanoseconds. The
/// next call begins within this time, too.
pub const RELEASE: u64 = 5_000_000;
/// Minimum of [`Handoff::runnable`] for which other threads are named, in nanoseconds.
pub const STALL: u64 = 500_000;

/// The priority of a thread whose priority cannot be read.
pub const UNKNOWN_PRIORITY: i64 = i64::MIN;

/// What the programs observe.
pub mod mode {
    /// No late calls.
    pub const OFF: u32 = 0;
    /// Late calls, with the sums of the scheduler's accounting.
    pub const SUMS: u32 = 1;
    /// The same, and the events of the scheduler.
    pub const EVENTS: u32 = 2;
}

/// For what a blocked thread waits.
pub mod wait {
    /// A lock of user space: `futex(2)`.
    pub const LOCK: usize = 0;
    /// The end of a sleep: `nanosleep(2)`, `clock_nanosleep(2)`.
    pub const SLEEP: usize = 1;
    /// A disk or another part of the kernel that no signal interrupts, in a system call.
    pub const DISK: usize = 2;
    /// A page of its memory, outside of a system call.
    pub const PAGE_FAULT: usize = 3;
    /// SIGCONT, or its debugger.
    pub const STOPPED: usize = 4;
    /// Another system call.
    pub const OTHER: usize = 5;
    /// Number of these waits.
    pub const COUNT: usize = 6;
}

/// Bounds of one callback. A call beyond one of them is late.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Bound {
    /// Duration of a call, in nanoseconds.
    pub duration: u64,
    /// Time from ready to start of a call, in nanoseconds.
    pub delay: u64,
    /// Start of the second in which `reported` are counted.
    pub since: u64,
    /// Late calls reported in that second.
    pub reported: u64,
}

/// A thread that ran while a followed thread could run.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Other {
    /// Time for which it ran instead.
    pub nanoseconds: u64,
    /// Thread id in the initial namespace; 0 = the CPU was idle.
    pub thread: u32,
    /// Id of its process.
    pub process: u32,
    /// Name of the thread.
    pub name: [u8; NAME_BYTES],
    /// Its control group: the inode of its directory.
    pub cgroup_id: u64,
    /// Its priority as in `task_struct.prio`: -1 = deadline, 0 to 98 = real time, 100 to 139 = a nice
    /// value. [`UNKNOWN_PRIORITY`] = unknown.
    pub priority: i64,
}

/// A time in which a thread was blocked.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Blocked {
    /// Its length.
    pub nanoseconds: u64,
    /// Number of the system call; `u32::MAX` = none.
    pub call: u32,
    /// One of [`wait`].
    pub kind: u32,
    /// First argument of the system call.
    pub argument: u64,
    /// Thread that ended the wait. It means nothing if an interrupt did.
    pub waker: u32,
    /// Process of that thread.
    pub waker_process: u32,
    /// Name of that thread.
    pub waker_name: [u8; NAME_BYTES],
    /// Control group of that thread, as in [`Other`].
    pub waker_cgroup_id: u64,
}

/// What a thread did in a span of time, by the events of the scheduler, in nanoseconds.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Activity {
    /// It ran on a CPU.
    pub cpu: u64,
    /// It could run, and did not.
    pub runnable: u64,
    /// Part of `cpu` that the scheduler did not charge: interrupts, or the hypervisor.
    pub stolen: u64,
    /// Changes of its state that had no event. They are divided by the scheduler's accounting.
    pub missed: u64,
    /// It was blocked, by [`wait`].
    pub blocked: [u64; wait::COUNT],
    /// The longest of these times.
    pub longest: Blocked,
    /// Threads that ran instead. One with a short time may be missing.
    pub others: [Other; OTHERS],
}

/// How a thread of the middleware passed a message to the thread that calls callbacks.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Handoff {
    /// Time at which it woke that thread; 0 = it did not.
    pub at: u64,
    /// The thread of the middleware.
    pub thread: u64,
    /// Time for which the woken thread could run and did not since its last call, before `at`, in
    /// nanoseconds.
    pub runnable_before: u64,
    /// Time at which it was itself woken for the message; 0 = unknown.
    pub woken: u64,
    /// Time since then for which it could run and did not, in nanoseconds.
    pub runnable: u64,
    /// Part of `runnable` for which its control groups were throttled.
    pub throttled: u64,
    /// For what it waited before, and the thread that woke it.
    pub wait: Blocked,
    /// Threads that ran instead. They mean nothing if `runnable` is less than [`STALL`].
    pub others: [Other; OTHERS],
}

/// A call of a callback.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Call {
    /// The callback.
    pub callback: u64,
    /// Start of the call.
    pub started: u64,
    /// End of the call; 0 = no call is known.
    pub ended: u64,
}

/// One late call: an item of the ring of announcements.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct LateCall {
    /// [`announced::LATE`](super::announced::LATE).
    pub kind: u32,
    /// Process of the callback.
    pub process: u32,
    /// Thread that made the call.
    pub thread: u32,
    /// The [`mode`] during the whole call.
    pub mode: u32,
    /// CPU on which the call ended.
    pub cpu: u32,
    /// Whether the accounting of the thread is known during the call (1), and before it (2).
    pub accounted: u32,
    /// The callback.
    pub callback: u64,
    /// Its trigger, as in [`Figures`](super::Figures).
    pub trigger: Handle,
    /// Source timestamp of the message, nanoseconds since the Unix epoch; 0 = unknown.
    pub source_timestamp: u64,
    /// Time at which the message was taken; 0 without a message.
    pub taken: u64,
    /// Start of the call.
    pub started: u64,
    /// End of the call.
    pub ended: u64,
    /// Time from ready to start, in nanoseconds; 0 = unknown.
    pub delay: u64,
    /// The bounds that the call was compared with, in nanoseconds: of its duration and its delay.
    pub bounds: [u64; 2],
    /// The call before, in the same thread.
    pub previous: Call,
    /// The last call since then after which another thread woke this one.
    pub released_by: Call,
    /// Since when the thread makes one call after the other: it was woken for the first one.
    pub busy_since: u64,
    /// Time in calls since then, in nanoseconds.
    pub in_calls: u64,
    /// Time between these calls for which it could run and did not.
    pub busy_runnable: u64,
    /// Time between them for which its control groups were throttled.
    pub busy_throttled: u64,
    /// The longest of these calls.
    pub longest_call: Call,
    /// The last time in which the thread was stopped.
    pub stop: Blocked,
    /// End of that time; 0 = never.
    pub stop_ended: u64,
    /// How a thread of its process woke the thread after its wait for work.
    pub handoff: Handoff,
    /// The thread during the call, by [`thread_state`], in nanoseconds.
    pub states: [u64; thread_state::COUNT],
    /// The thread between the call before and this one.
    pub states_before: [u64; thread_state::COUNT],
    /// The thread during the call, by events.
    pub during: Activity,
    /// The thread between the call before and this one, by events.
    pub before: Activity,
}
