//! Calls of `libtracetools.so` inside observed processes, as the kernel programs aggregate them.
//!
//! The kernel programs share this binary layout. Words are in the host's byte order. Times are
//! CLOCK_MONOTONIC nanoseconds unless a field says otherwise. Handles are addresses in the observed
//! process, which are not trusted.

pub mod late;

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Maximum number of observed processes.
pub const PROCESS_CAPACITY: u32 = 1_024;
/// Maximum number of publishers, subscriptions, ring buffers and callbacks of all processes.
pub const HANDLE_CAPACITY: u32 = 4_096;
/// Maximum number of threads whose last calls are remembered. The least recently used ones are
/// forgotten.
pub const THREAD_CAPACITY: u32 = 8_192;
/// Maximum number of messages in ring buffers whose time of entry is remembered. The oldest are
/// forgotten.
pub const WAITING_CAPACITY: u32 = 8_192;
/// Maximum size of a name with its terminating zero, in bytes. A longer name is cut.
pub const NAME_BYTES: usize = 256;
/// Number of buckets of a distribution.
pub const BUCKETS: usize = 96;
/// Maximum number of causal publications reported per callback and second.
pub const HOPS_PER_SECOND: u32 = 128;

/// Durations below 5/4 of this number of nanoseconds share the first bucket.
const FLOOR: u64 = 1 << FLOOR_BITS;
const FLOOR_BITS: u32 = 10;
/// Each power of two is divided into this many buckets.
const STEPS: u64 = 4;

/// Returns the bucket of a duration in nanoseconds: four buckets for each power of two, from 1 µs
/// to 17 s. The bounds of a bucket differ by a quarter at most.
#[inline(always)]
#[must_use]
pub const fn bucket(nanoseconds: u64) -> usize {
    if nanoseconds < FLOOR {
        return 0;
    }
    // The instruction set of BPF cannot count leading zeros.
    let (mut bits, mut rest) = (0, nanoseconds);
    if rest >> 32 != 0 {
        (bits, rest) = (bits + 32, rest >> 32);
    }
    if rest >> 16 != 0 {
        (bits, rest) = (bits + 16, rest >> 16);
    }
    if rest >> 8 != 0 {
        (bits, rest) = (bits + 8, rest >> 8);
    }
    if rest >> 4 != 0 {
        (bits, rest) = (bits + 4, rest >> 4);
    }
    if rest >> 2 != 0 {
        (bits, rest) = (bits + 2, rest >> 2);
    }
    if rest >> 1 != 0 {
        bits += 1;
    }
    let step = nanoseconds >> (bits - 2) & (STEPS - 1);
    let index = (bits - FLOOR_BITS) as u64 * STEPS + step;
    if index < BUCKETS as u64 {
        index as usize
    } else {
        BUCKETS - 1
    }
}

/// Returns the lower bound of a bucket in nanoseconds; 0 for the first bucket.
#[must_use]
pub const fn bucket_start(index: usize) -> u64 {
    if index == 0 {
        return 0;
    }
    let (power, step) = (index as u64 / STEPS, index as u64 % STEPS);
    FLOOR << power | step << (FLOOR_BITS as u64 + power - 2)
}

/// Kinds of handles.
pub mod kind {
    /// `rcl_publisher_t`.
    pub const PUBLISHER: u32 = 1;
    /// `rmw_subscription_t`.
    pub const SUBSCRIPTION: u32 = 2;
    /// A ring buffer of intra-process messages (rclcpp of Iron and later).
    pub const BUFFER: u32 = 3;
    /// A callback of rclcpp.
    pub const CALLBACK: u32 = 4;
    /// `rcl_timer_t`; occurs only as a callback's trigger.
    pub const TIMER: u32 = 5;
}

/// A handle in a process.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Hash, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Handle {
    /// Address of the object in the process.
    pub address: u64,
    /// Thread group id of the process, in the initial namespace.
    pub process: u32,
    /// One of [`kind`].
    pub kind: u32,
}

/// Indices of the distributions in [`Figures`].
pub mod distribution {
    /// Time between consecutive publications, takes or entries into a buffer; duration of a
    /// callback.
    pub const INTERVAL: usize = 0;
    /// Time from the source timestamp to the take; time in the ring buffer; waiting time of a
    /// callback.
    pub const DELAY: usize = 1;
}

/// Cumulative figures of one handle.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Figures {
    /// Publications, messages taken, messages put into the buffer, completed calls.
    pub count: u64,
    /// Takes without a message, messages overwritten in the buffer, skipped periods of the timer.
    pub failed: u64,
    /// Publications to subscriptions in the same process, messages taken from the buffer, calls
    /// for intra-process messages.
    pub within: u64,
    /// Time of the last event.
    pub last: u64,
    /// Sums by [`distribution`], in nanoseconds.
    pub sums: [u64; 2],
    /// Largest values by [`distribution`].
    pub maxima: [u64; 2],
    /// Smallest values by [`distribution`], plus 1; 0 = no value.
    pub minima: [u64; 2],
    /// Publisher of a buffer, or trigger of a callback: a subscription, buffer or timer. Kind 0
    /// means unknown, or a service.
    pub trigger: Handle,
    /// Messages in the buffer after the last entry.
    pub depth: u32,
    /// Largest value of `depth`.
    pub max_depth: u32,
    /// Thread that made the last call.
    pub thread: u32,
    /// Number of attempts to announce the handle's name; the maximum number once it was announced.
    pub announced: u32,
    /// Start of the second in which `hops` are counted.
    pub hops_since: u64,
    /// Time at which the timer's last call was due.
    pub due: u64,
    /// Period of the timer in nanoseconds; 0 = unknown, or no timer.
    pub period: u64,
    /// Causal publications reported in the second that starts at `hops_since`.
    pub hops: u32,
    /// Unused.
    pub unused: u32,
    /// Base delay of the subscription's takes by [`base_delay`].
    pub base_delay: i64,
    /// Completed calls of the callback whose thread's states are known.
    pub states_known: u64,
    /// What these calls consisted of, by [`thread_state`], in nanoseconds.
    pub states: [u64; thread_state::COUNT],
    /// Counts by [`distribution`] and [`bucket`].
    pub buckets: [[u32; BUCKETS]; 2],
}

/// The base delay of a subscription (RFC 6817): the shortest delay from a source timestamp to the
/// take, from which waits are measured.
///
/// It may be negative, because the publisher's clock sets the timestamp. The clocks of two hosts
/// drift apart, so it grows by 122 µs per second until a take is earlier. The quartz clocks of two
/// hosts differ by less. The stored number is the base delay less its growth since the machine
/// started; 0 means that nothing was taken.
pub mod base_delay {
    /// The growth is the 2¹³th part of the time.
    const DRIFT_BITS: u32 = 13;
    /// A take later than this begins a new base delay, in nanoseconds: a clock was set, or the
    /// message was kept for late subscriptions.
    const MAX_WAIT_NS: u64 = 60_000_000_000;

    /// Returns the stored number after a take at the time `now`, `delay` nanoseconds after the
    /// source timestamp of its message.
    #[inline(always)]
    #[must_use]
    pub const fn after_take(base: i64, delay: i64, now: u64) -> i64 {
        let own = match delay.wrapping_sub(drift(now)) {
            0 => 1,
            own => own,
        };
        // The difference of two numbers in order fits into 64 bits without a sign.
        let is_later = own >= base && own.wrapping_sub(base) as u64 <= MAX_WAIT_NS;
        if base != 0 && is_later { base } else { own }
    }

    /// Returns the nanoseconds by which a delay at the time `now` exceeds the base delay.
    #[inline(always)]
    #[must_use]
    pub const fn wait(base: i64, delay: i64, now: u64) -> u64 {
        let wait = delay.wrapping_sub(drift(now)).wrapping_sub(base);
        if base == 0 || wait < 0 {
            0
        } else {
            wait as u64
        }
    }

    const fn drift(now: u64) -> i64 {
        (now >> DRIFT_BITS) as i64
    }
}

/// What the thread of a callback did, by the accounting of the scheduler.
pub mod thread_state {
    /// It ran on a CPU.
    pub const CPU: usize = 0;
    /// It could run, but its control group had used up its CPU quota (`cpu.max`).
    pub const THROTTLED: usize = 1;
    /// It could run, and other threads ran instead.
    pub const RUNNABLE: usize = 2;
    /// It waited for something else: a lock, a file, the end of a sleep.
    pub const BLOCKED: usize = 3;
    /// Number of these states.
    pub const COUNT: usize = 4;
}

/// Members of the kernel's structures from which the programs read the accounting of threads.
pub mod accounting {
    /// `task_struct.se.sum_exec_runtime`: CPU time, added up at each tick and context switch.
    pub const RUNTIME: usize = 0;
    /// `task_struct.sched_info.run_delay`: time in which the thread could run and did not.
    pub const RUN_DELAY: usize = 1;
    /// `task_struct.nvcsw`: voluntary context switches.
    pub const VOLUNTARY_SWITCHES: usize = 2;
    /// `task_struct.sched_task_group`, the control group of the thread.
    pub const GROUP: usize = 3;
    /// `task_group.parent`.
    pub const GROUP_PARENT: usize = 4;
    /// `task_group.cfs_bandwidth.throttled_time`: summed over all CPUs.
    pub const GROUP_THROTTLED: usize = 5;
    /// `task_struct.__state`, before Linux 5.14 `state`.
    pub const STATE: usize = 6;
    /// `task_struct.pid`, the id of the thread.
    pub const THREAD: usize = 7;
    /// `task_struct.prio`, the priority that the scheduler uses.
    pub const PRIORITY: usize = 8;
    /// Number of these members.
    pub const COUNT: usize = 9;
    /// A member that the running kernel does not have.
    pub const ABSENT: u32 = u32::MAX;
}

/// State of one process.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Process {
    /// Calls seen, including those that were not counted.
    pub hits: u64,
    /// Calls for handles beyond [`HANDLE_CAPACITY`].
    pub refused: u64,
    /// One of [`state`].
    pub state: u32,
    /// Offset of `rmw_handle` in the process's rcl structures; 0 = unknown.
    pub rmw_handle_at: u32,
    /// Offset of the period in `rcl_timer_impl_t`; 0 = unknown.
    pub timer_period_at: u32,
    /// Unused.
    pub unused: u32,
}

/// Clocks other than CLOCK_MONOTONIC.
pub mod clock {
    /// CLOCK_REALTIME.
    pub const REALTIME: u32 = 0;
    /// CLOCK_MONOTONIC_RAW.
    pub const MONOTONIC_RAW: u32 = 1;
    /// Number of these clocks.
    pub const COUNT: u32 = 2;
}

/// How the calls of a process are treated.
pub mod state {
    /// The calls are counted.
    pub const COUNTED: u32 = 0;
    /// The process exceeds its budget: only the number of its calls is counted.
    pub const SUSPENDED: u32 = 1;
    /// The process is outside of the observed control group.
    pub const OUTSIDE: u32 = 2;
}

/// Kinds of [`Announcement`], with the fields that each kind uses.
pub mod announced {
    /// A node (`address`, `text` = name, `second` = namespace).
    pub const NODE: u32 = 1;
    /// A publisher (`address`, `parent` = node or 0, `text` = topic, `second` = middleware).
    pub const PUBLISHER: u32 = 2;
    /// A subscription (`address` = rmw handle, `parent` = node or 0, `value` = rcl handle or 0,
    /// `text` = topic, `second` = middleware).
    pub const SUBSCRIPTION: u32 = 3;
    /// An rclcpp subscription (`address`, `parent` = rcl handle).
    pub const SUBSCRIPTION_OBJECT: u32 = 4;
    /// A callback (`address`, `parent` = rclcpp subscription).
    pub const SUBSCRIPTION_CALLBACK: u32 = 5;
    /// A timer (`address`, `value` = period in nanoseconds).
    pub const TIMER: u32 = 6;
    /// A timer's node (`address`, `parent`).
    pub const TIMER_NODE: u32 = 7;
    /// A callback (`address`, `parent` = timer).
    pub const TIMER_CALLBACK: u32 = 8;
    /// A service (`address`, `parent` = node, `text` = name).
    pub const SERVICE: u32 = 9;
    /// A callback (`address`, `parent` = service).
    pub const SERVICE_CALLBACK: u32 = 10;
    /// A state machine (`address`, `parent` = node).
    pub const STATE_MACHINE: u32 = 11;
    /// A transition (`address` = state machine, `text` = start state, `second` = goal state).
    pub const TRANSITION: u32 = 12;
    /// A ring buffer (`address`, `value` = capacity).
    pub const BUFFER: u32 = 13;
    /// An intra-process buffer (`address`, `parent` = ring buffer).
    pub const BUFFER_OWNER: u32 = 14;
    /// An intra-process buffer's subscription (`address` = buffer, `parent` = rclcpp subscription).
    pub const BUFFER_SUBSCRIPTION: u32 = 15;
    /// A causal publication: the item is a [`Hop`](super::Hop) instead.
    pub const HOP: u32 = 16;
    /// A late call: the item is a [`LateCall`](super::late::LateCall) instead.
    pub const LATE: u32 = 17;
}

/// The name or a relation of a handle, or a transition of a state machine.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Announcement {
    /// One of [`announced`].
    pub kind: u32,
    /// Thread group id of the process.
    pub process: u32,
    /// Id of the calling thread.
    pub thread: u32,
    /// Unused.
    pub unused: u32,
    /// Time of the call.
    pub time: u64,
    /// See [`announced`].
    pub address: u64,
    /// See [`announced`].
    pub parent: u64,
    /// See [`announced`].
    pub value: u64,
    /// See [`announced`]. Ends with a zero; empty if the kind has no text.
    pub text: [u8; NAME_BYTES],
    /// As `text`; also empty if it could not be read.
    pub second: [u8; NAME_BYTES],
}

/// A publication during a callback that handles a message.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Hop {
    /// [`announced::HOP`].
    pub kind: u32,
    /// Thread group id of the process.
    pub process: u32,
    /// Id of the calling thread.
    pub thread: u32,
    /// 1 = the publisher has subscriptions in the same process, which get the message directly.
    pub within: u32,
    /// Time of the publication.
    pub published: u64,
    /// The publisher.
    pub publisher: u64,
    /// Trigger of the callback: a subscription or buffer.
    pub input: Handle,
    /// Source timestamp of the handled message, nanoseconds since the Unix epoch; 0 = unknown.
    pub source_timestamp: u64,
    /// Time at which the handled message was taken.
    pub taken: u64,
    /// Time at which the callback began.
    pub started: u64,
    /// The callback.
    pub callback: u64,
}

/// Counters of the programs, per CPU; the value is the index.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Counter {
    /// Calls seen.
    Hits = 0,
    /// Calls of processes beyond their budget.
    Suspended,
    /// Calls of processes beyond [`PROCESS_CAPACITY`].
    ProcessesFull,
    /// Calls for handles beyond [`HANDLE_CAPACITY`].
    HandlesFull,
    /// Handles whose name could not be read.
    Unreadable,
    /// Announcements lost because the ring was full; those of endpoints are repeated.
    AnnouncementsLost,
    /// Causal publications lost because the ring was full.
    HopsLost,
    /// Causal publications beyond [`HOPS_PER_SECOND`], not reported.
    HopsSkipped,
    /// Late calls beyond [`late::PER_SECOND`], not reported.
    LateSkipped,
    /// Late calls lost because the ring was full.
    LateLost,
}

impl Counter {
    /// Every counter, in index order.
    pub const ALL: [Self; 10] = [
        Self::Hits,
        Self::Suspended,
        Self::ProcessesFull,
        Self::HandlesFull,
        Self::Unreadable,
        Self::AnnouncementsLost,
        Self::HopsLost,
        Self::HopsSkipped,
        Self::LateSkipped,
        Self::LateLost,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Hits => "hits",
            Self::Suspended => "suspended",
            Self::ProcessesFull => "processes_full",
            Self::HandlesFull => "handles_full",
            Self::Unreadable => "unreadable",
            Self::AnnouncementsLost => "announcements_lost",
            Self::HopsLost => "hops_lost",
            Self::HopsSkipped => "hops_skipped",
            Self::LateSkipped => "late_skipped",
            Self::LateLost => "late_lost",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_is_within_its_bucket() {
        let mut nanoseconds = 1;
        while nanoseconds < 1 << 34 {
            let index = bucket(nanoseconds);
            assert!(bucket_start(index) <= nanoseconds, "{nanoseconds}");
            assert!(nanoseconds < bucket_start(index + 1), "{nanoseconds}");
            nanoseconds += 1 + nanoseconds / 7;
        }
        assert_eq!(bucket(0), 0);
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
        assert_eq!(bucket_start(1), 1_280);
        for index in 0..BUCKETS {
            assert_eq!(bucket(bucket_start(index)), index);
        }
    }

    const MS: i64 = 1_000_000;

    /// Returns the last wait in nanoseconds, after takes each second with these delays in
    /// milliseconds.
    fn wait_after(delays: impl IntoIterator<Item = i64>) -> u64 {
        let (mut base, mut wait, mut now) = (0, 0, 1 << 50);
        for delay in delays {
            base = base_delay::after_take(base, delay * MS, now);
            wait = base_delay::wait(base, delay * MS, now);
            now += 1_000_000_000;
        }
        wait
    }

    #[test]
    fn a_wait_is_measured_from_the_shortest_delay() {
        let wait = wait_after([5, 3, 9]);
        assert!((5_870_000..6_000_000).contains(&wait), "{wait}");
        assert_eq!(wait_after([5, 3, 2]), 0);
        assert_eq!(base_delay::wait(0, 7 * MS, 1), 0);
    }

    #[test]
    fn a_publisher_whose_clock_is_ahead_has_waits() {
        let wait = wait_after([-30, -31, -11]);
        assert!((19_870_000..20_000_000).contains(&wait), "{wait}");
    }

    #[test]
    fn a_drift_of_a_hundred_microseconds_a_second_is_no_wait() {
        for direction in [1, -1] {
            let hour = (0..3_600).map(|second| direction * second / 10);
            let wait = wait_after(hour);
            assert!(wait < 1_000_000, "{wait}");
        }
    }

    #[test]
    fn a_lasting_wait_of_half_a_second_is_known_for_half_an_hour() {
        let backlog = (0..1_800).map(|second| if second < 10 { 1 } else { 501 });
        let wait = wait_after(backlog);
        assert!(wait > 250_000_000, "{wait}");
    }

    #[test]
    fn a_publisher_whose_clock_was_set_back_has_waits_from_its_new_time() {
        const HOUR: i64 = 3_600_000;
        assert_eq!(wait_after([-HOUR, -HOUR, 3]), 0);
        let wait = wait_after([-HOUR, -HOUR, 3, 9]);
        assert!((5_870_000..6_000_000).contains(&wait), "{wait}");
        // A message that was kept for an hour, between two new ones.
        let wait = wait_after([3, HOUR, 3, 9]);
        assert!((5_870_000..6_000_000).contains(&wait), "{wait}");
    }

    #[test]
    fn a_forged_timestamp_affects_only_its_own_message() {
        for forged in [i64::MIN, i64::MIN + 1, -1, 0, 1, i64::MAX] {
            let mut base = base_delay::after_take(0, 3 * MS, 1 << 50);
            base = base_delay::after_take(base, forged, 1 << 50);
            assert!(base_delay::wait(base, forged, 1 << 50) <= 60_000_000_000);
            for delay in [3, 3, 9] {
                base = base_delay::after_take(base, delay * MS, 1 << 50);
            }
            let wait = base_delay::wait(base, 9 * MS, 1 << 50);
            assert!(
                wait >= 6 * MS as u64 && wait < 10 * MS as u64,
                "{forged}: {wait}"
            );
        }
    }

    #[test]
    fn counters_are_listed_in_index_order() {
        for (index, counter) in Counter::ALL.into_iter().enumerate() {
            assert_eq!(counter as usize, index, "{}", counter.label());
        }
    }
}
