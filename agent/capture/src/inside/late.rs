//! Late calls: from when on a call is late, whether the scheduler's events are observed, and the
//! items that the kernel programs report.
//!
//! Without a bound from a client or an expectation, the bound is learnt. It is three times the 99th
//! percentile of the callback's calls in the last minutes, and [`MIN_BOUND`] or more.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs::File;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::calls::late::{
    Activity, Blocked, BusyTime, CpuLimit, Handoff, LateBound, LateCall, MessageDelivery,
    PreviousCall, Repairs, Stop, WaitingStates,
};
use ros2probe_model::facts::calls::other_thread::{OtherThread, Priority};
use ros2probe_model::facts::calls::report::{ThreadStates, Trigger};
use ros2probe_model::facts::glob;
use ros2probe_model::facts::names::NodeName;
use ros2probe_wire::inside::late::{self, Bound, mode, wait};
use ros2probe_wire::inside::{BUCKETS, Handle, bucket_start, kind, thread_state};
use ros2probe_wire::{DomainId, Timestamp};

use super::programs::{Events, Programs, Tables};
use super::table::ProcessTable;
use crate::error_chain::{Reason, in_words};
use crate::filter::Deliveries;
use crate::settings::LateChoice;
use crate::system::Clocks;
use crate::tables::CallbackBounds;

/// Minimum of a learnt bound.
pub const MIN_BOUND: Duration = Duration::from_millis(5);
/// Ratio of a learnt bound to the 99th percentile.
const BOUND_FACTOR: u64 = 3;
/// Minimum number of calls from which a bound is learnt, however rare they are.
const MIN_LEARNT_CALLS: u64 = 50;
/// Minimum weight of recent calls from which a bound changes: that of one call two minutes ago.
const MIN_RECENT_WEIGHT: f32 = 0.5;
/// Part of the calls so far that is forgotten in each round: a round is a second, so that the
/// bound describes the last minutes.
const DECAY: f32 = 1.0 / 180.0;

/// Part of a bound by which it rises in a round at most, as a divisor: it doubles in 70 s.
const RISE_DIVISOR: u64 = 100;

/// Maximum number of threads that are named for a span of a late call.
const MAX_NAMED_THREADS: usize = 4;

/// What clients want to know about late calls.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LateDemand {
    /// Whether a client requests causes.
    pub has_question: bool,
    /// Bounds of clients and expectations. The first one that applies to a callback counts.
    pub bounds: Vec<RequestedBound>,
}

/// From when on calls of a callback are late.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RequestedBound {
    /// Callbacks that have it.
    pub of: BoundScope,
    /// Maximum time of a call, and maximum time from ready to start.
    pub above: Duration,
}

/// Which callbacks have a bound.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BoundScope {
    /// Any callback.
    All,
    /// Callbacks of topics that the pattern of a watch covers.
    Topics {
        /// ROS name or glob.
        pattern: Arc<str>,
        /// Domain; `None` = any.
        domain_id: Option<DomainId>,
    },
    /// Callbacks of a topic, service or node with this ROS name, and those that are known to belong
    /// to the node.
    Named {
        /// ROS name.
        name: Arc<str>,
        /// Domain; `None` = any.
        domain_id: Option<DomainId>,
        /// Process and address of callbacks.
        listed: Arc<BTreeSet<(u32, u64)>>,
    },
    /// These callbacks, by process and address.
    Listed(Arc<BTreeSet<(u32, u64)>>),
}

/// What is known about a callback.
struct CallbackNames {
    handle: Handle,
    domain_id: DomainId,
    trigger: Trigger,
    node: Option<NodeName>,
}

impl BoundScope {
    fn has(&self, callback: &CallbackNames) -> bool {
        let id = (callback.handle.process, callback.handle.address);
        let is_in = |domain_id: &Option<DomainId>| {
            domain_id.is_none_or(|domain_id| domain_id == callback.domain_id)
        };
        match self {
            Self::All => true,
            Self::Topics { pattern, domain_id } => {
                let topic = match &callback.trigger {
                    Trigger::Subscription(topic) | Trigger::IntraProcess(Some(topic)) => topic,
                    _ => return false,
                };
                is_in(domain_id) && glob::covers(pattern, topic)
            }
            Self::Named {
                name,
                domain_id,
                listed,
            } => {
                let name = Some(&**name);
                let is_named = name == callback.trigger.name() || name == callback.node.as_deref();
                listed.contains(&id) || is_named && is_in(domain_id)
            }
            Self::Listed(listed) => listed.contains(&id),
        }
    }
}

/// What the programs observe about late calls.
pub(super) struct LateObservation {
    programs: Arc<Programs>,
    choice: LateChoice,
    /// The mode that the programs have.
    mode: u32,
    events: Option<Events>,
    without_events: Option<Reason>,
    /// Programs that follow deliveries of messages, with the control group of the host hook.
    deliveries: Option<(Deliveries, File)>,
    without_deliveries: Option<Reason>,
    requested: Vec<RequestedBound>,
    bounds: Bounded<CallbackBounds, HashMap<Handle, Learnt>>,
}

/// What is known about the durations of one callback.
struct Learnt {
    /// Counts at the last round, as in `Figures::buckets`.
    known: [[u32; BUCKETS]; 2],
    /// Calls of the last minutes.
    recent: [[f32; BUCKETS]; 2],
    /// All calls so far.
    calls: [u64; 2],
    /// The learnt bounds.
    learnt: Option<[u64; 2]>,
    /// The bounds that the programs have.
    set: Option<[u64; 2]>,
}

impl LateObservation {
    pub(super) fn new(
        programs: Arc<Programs>,
        choice: LateChoice,
        deliveries: Option<(Deliveries, File)>,
    ) -> Self {
        let without_deliveries = match deliveries {
            Some(_) => None,
            None => Some(Reason(
                "the sockets of this host are not observed".to_owned(),
            )),
        };
        Self {
            programs,
            choice,
            mode: mode::OFF,
            events: None,
            without_events: None,
            deliveries,
            without_deliveries,
            requested: Vec::new(),
            bounds: Bounded::default(),
        }
    }

    /// Returns what is observed: `off`, `sums` or `events`.
    pub(super) const fn observed(&self) -> &'static str {
        match self.mode {
            mode::EVENTS => "events",
            mode::SUMS => "sums",
            _ => "off",
        }
    }

    /// Returns why the scheduler's events are not observed when they are needed. A refusal of the
    /// kernel is known before that.
    pub(super) fn without_events(&self) -> Option<String> {
        let refused = || match self.choice {
            LateChoice::Off => None,
            LateChoice::Auto | LateChoice::On => self.programs.without_scheduler(),
        };
        let reason = self.without_events.clone().or_else(refused);
        reason.map(|reason| reason.0)
    }

    /// Returns why deliveries of messages are not followed although they are needed.
    pub(super) fn without_deliveries(&self) -> Option<&str> {
        self.without_deliveries.as_ref().map(Reason::as_str)
    }

    /// Returns the delivery of the message that triggered a call.
    pub(super) fn delivery(&self, call: &late::LateCall) -> Option<MessageDelivery> {
        self.deliveries.as_ref()?.0.of(call)
    }

    /// Begins or ends the observation of the scheduler's events. `at_calls`: whether callbacks are
    /// observed.
    pub(super) fn follow(&mut self, at_calls: bool, demand: &LateDemand, tables: &mut Tables) {
        self.requested.clone_from(&demand.bounds);
        let needs_events = match self.choice {
            LateChoice::Off => false,
            LateChoice::On => true,
            LateChoice::Auto => demand.has_question,
        };
        let mode = match self.choice {
            _ if !at_calls => mode::OFF,
            LateChoice::Off => mode::OFF,
            _ if needs_events => mode::EVENTS,
            _ => mode::SUMS,
        };
        // These need an older kernel than the events.
        self.follow_deliveries(mode == mode::EVENTS);
        if mode == mode::EVENTS && self.events.is_none() && self.without_events.is_none() {
            match self.programs.observe_scheduler() {
                Ok(events) => self.events = Some(events),
                Err(reason) => {
                    tracing::warn!(
                        reason = reason.as_str(),
                        "late callbacks are reported without who ran instead"
                    );
                    self.without_events = Some(reason);
                }
            }
        }
        if mode != mode::EVENTS {
            self.events = None;
        }
        let mode = match mode == mode::EVENTS && self.events.is_none() {
            true => mode::SUMS,
            false => mode,
        };
        if mode == self.mode {
            return;
        }
        match tables.set_late_mode(mode) {
            Ok(()) => self.mode = mode,
            Err(error) => {
                let reason = in_words(&error);
                tracing::warn!(reason, "late callbacks are not reported");
            }
        }
    }

    /// Begins or ends following deliveries of messages.
    fn follow_deliveries(&mut self, wanted: bool) {
        let Some((deliveries, cgroup)) = &mut self.deliveries else {
            return;
        };
        if !wanted {
            deliveries.leave();
            return;
        }
        if let Err(reason) = deliveries.follow(cgroup) {
            tracing::warn!(
                reason = reason.as_str(),
                "late callbacks are reported without the way of their messages"
            );
            self.without_deliveries = Some(reason);
            self.deliveries = None;
        }
    }

    /// Learns from the calls of the last round, and sets the bounds of callbacks.
    pub(super) fn set_bounds(&mut self, table: &ProcessTable, tables: &mut Tables) {
        if self.mode == mode::OFF {
            return;
        }
        if self.mode == mode::EVENTS
            && let Err(error) = tables.correct_runnable()
        {
            let reason = in_words(&error);
            tracing::debug!(reason, "the number of threads that could run may be wrong");
        }
        let callbacks = tables.figures();
        let callbacks: Vec<_> = callbacks
            .filter(|(handle, _)| handle.kind == kind::CALLBACK)
            .collect();
        let present: HashSet<_> = callbacks.iter().map(|(handle, _)| *handle).collect();
        let gone = |handle: &Handle| !present.contains(handle);
        let gone: Vec<_> = self.bounds.keys().copied().filter(gone).collect();
        for handle in gone {
            self.bounds.remove(&handle);
            let _ = tables.remove_bound(handle);
        }
        for (handle, figures) in &callbacks {
            let requested = match &self.requested[..] {
                [] => None,
                requested => {
                    let (trigger, node) = table.name_callback(*handle, figures);
                    let callback = CallbackNames {
                        handle: *handle,
                        domain_id: table.domain_of(handle.process),
                        trigger,
                        node,
                    };
                    bound_of(requested, &callback)
                }
            };
            let learnt = self.bounds.get_or_insert_with(*handle, Learnt::default);
            let Some(learnt) = learnt else {
                continue;
            };
            learnt.add(&figures.buckets);
            let bounds = match requested {
                Some(above) => Some([above; 2]),
                None => learnt.learnt,
            };
            if learnt.differs(bounds, requested.is_some()) {
                let set = match bounds {
                    Some([duration, delay]) => {
                        let bound = Bound {
                            duration,
                            delay,
                            ..Bound::default()
                        };
                        tables.set_bound(*handle, bound)
                    }
                    None => tables.remove_bound(*handle),
                };
                if set.is_ok() {
                    learnt.set = bounds;
                }
            }
        }
    }
}

/// Returns the bound of a callback, in nanoseconds, if one applies.
fn bound_of(requested: &[RequestedBound], callback: &CallbackNames) -> Option<u64> {
    let mut requested = requested.iter();
    let above = requested.find(|bound| bound.of.has(callback))?.above;
    Some(u64::try_from(above.as_nanos()).unwrap_or(u64::MAX))
}

impl Default for Learnt {
    fn default() -> Self {
        Self {
            known: [[0; BUCKETS]; 2],
            recent: [[0.0; BUCKETS]; 2],
            calls: [0; 2],
            learnt: None,
            set: None,
        }
    }
}

impl Learnt {
    /// Adds the calls since the last round, and learns the bounds. They rise slowly, so that a
    /// callback that becomes slow is late for minutes before that is usual.
    #[expect(clippy::cast_precision_loss, reason = "calls of a second are few")]
    fn add(&mut self, counts: &[[u32; BUCKETS]; 2]) {
        let all = self.recent.iter_mut().zip(&mut self.known).zip(counts);
        for (((recent, known), counts), calls) in all.zip(&mut self.calls) {
            for ((recent, known), count) in recent.iter_mut().zip(known.iter_mut()).zip(counts) {
                // Smaller counts began anew.
                let new = count.checked_sub(*known).unwrap_or(*count);
                *recent = *recent * (1.0 - DECAY) + new as f32;
                *calls += u64::from(new);
                *known = *count;
            }
        }
        let Some(bounds) = self.bounds() else {
            return;
        };
        let [duration, delay] = bounds;
        let slowly = |known: u64, new: u64| new.min(known.saturating_add(known / RISE_DIVISOR));
        self.learnt = Some(match self.learnt {
            Some([known_duration, known_delay]) => {
                [slowly(known_duration, duration), slowly(known_delay, delay)]
            }
            None => bounds,
        });
    }

    /// Returns bounds of duration and delay for the calls of the last minutes, in nanoseconds;
    /// `None` before enough calls.
    fn bounds(&self) -> Option<[u64; 2]> {
        let [duration, delay] = &self.recent;
        let [durations, delays] = self.calls;
        let bound = |counts: &[f32; BUCKETS], calls: u64| {
            let least = u64::try_from(MIN_BOUND.as_nanos()).unwrap_or(u64::MAX);
            let p99 = (calls >= MIN_LEARNT_CALLS).then(|| p99(counts)).flatten()?;
            Some(p99.saturating_mul(BOUND_FACTOR).max(least))
        };
        // Some callbacks have no delay, for example those of services.
        let delay = bound(delay, delays).unwrap_or(u64::MAX);
        Some([bound(duration, durations)?, delay])
    }

    /// Returns whether bounds differ from those that the programs have: learnt ones by more than a
    /// step of the distribution.
    fn differs(&self, bounds: Option<[u64; 2]>, is_requested: bool) -> bool {
        match (self.set, bounds) {
            (Some(set), Some(bounds)) if is_requested => set != bounds,
            (Some(set), Some(bounds)) => {
                let both = set.iter().zip(&bounds);
                both.clone()
                    .any(|(set, bound)| set.abs_diff(*bound) > set / 10)
            }
            (set, bounds) => set.is_some() != bounds.is_some(),
        }
    }
}

/// Returns the upper end of the bucket with the 99th percentile, in nanoseconds; `None` without
/// recent values.
fn p99(counts: &[f32; BUCKETS]) -> Option<u64> {
    let all: f32 = counts.iter().sum();
    if all < MIN_RECENT_WEIGHT {
        return None;
    }
    let mut below = 0.0;
    let index = counts.iter().position(|count| {
        below += count;
        below >= all * 0.99
    })?;
    Some(bucket_start(index + 1))
}

/// Values of `LateCall::accounted`.
const ACCOUNTED_DURING: u32 = 1;
const ACCOUNTED_BEFORE: u32 = 2;

/// Returns the unit of a control group, by the inode of its directory.
pub(super) type UnitOf<'a> = &'a dyn Fn(u64) -> Option<Arc<str>>;

/// Returns the control groups of the threads that these calls name, by the inodes of their
/// directories.
pub(super) fn cgroup_ids(calls: &[late::LateCall]) -> BTreeSet<u64> {
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
pub(super) fn convert(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;
    use ros2probe_wire::inside::bucket;

    fn counts(of: &[(u64, u32)]) -> [[u32; BUCKETS]; 2] {
        let mut counts = [[0; BUCKETS]; 2];
        for (milliseconds, calls) in of {
            counts[0][bucket(milliseconds * 1_000_000)] += calls;
        }
        counts
    }

    #[test]
    fn a_bound_is_three_times_the_99th_percentile() {
        let mut learnt = Learnt::default();
        learnt.add(&counts(&[(20, 49)]));
        assert_eq!(learnt.learnt, None, "too few calls");
        learnt.add(&counts(&[(20, 999), (500, 1)]));
        let [duration, delay] = learnt.learnt.unwrap();
        assert!((60_000_000..=84_000_000).contains(&duration), "{duration}");
        assert_eq!(delay, u64::MAX, "no call waited");
    }

    #[test]
    fn a_bound_of_rare_calls_is_learnt_from_50_of_them() {
        let mut learnt = Learnt::default();
        for second in 0..1000 {
            let calls = second / 20;
            learnt.add(&counts(&[(400, calls)]));
            assert_eq!(learnt.learnt.is_some(), calls >= 50, "{calls} calls");
        }
        learnt.add(&counts(&[(400, 50)]));
        let usual = learnt.learnt.unwrap();
        // Without calls, the bound stays.
        for _ in 0..100_000 {
            learnt.add(&counts(&[(400, 50)]));
        }
        assert_eq!(learnt.learnt, Some(usual));
    }

    #[test]
    fn a_bound_has_a_minimum() {
        let mut learnt = Learnt::default();
        learnt.add(&counts(&[(0, 1000)]));
        let [duration, _] = learnt.learnt.unwrap();
        assert_eq!(u128::from(duration), MIN_BOUND.as_nanos());
    }

    #[test]
    fn a_callback_that_becomes_slower_has_another_bound_within_minutes() {
        let mut learnt = Learnt::default();
        let mut calls = 0;
        for _ in 0..600 {
            calls += 10;
            learnt.add(&counts(&[(5, calls)]));
        }
        let usual = learnt.learnt.unwrap()[0];
        for round in 1..=600 {
            learnt.add(&counts(&[(5, calls), (50, round * 10)]));
            let [duration, _] = learnt.learnt.unwrap();
            match round {
                ..=60 => assert!(duration < usual * 2, "{duration} after {round} s"),
                300.. => assert!(duration >= 150_000_000, "{duration} after {round} s"),
                _ => {}
            }
        }
    }

    #[test]
    fn the_first_bound_that_applies_to_a_callback_counts() {
        let bound = |of: BoundScope, milliseconds| RequestedBound {
            of,
            above: Duration::from_millis(milliseconds),
        };
        let named = |name: &str, listed: &[(u32, u64)]| BoundScope::Named {
            name: name.into(),
            domain_id: None,
            listed: Arc::new(listed.iter().copied().collect()),
        };
        let topics = |pattern: &str, domain_id| BoundScope::Topics {
            pattern: pattern.into(),
            domain_id: Some(DomainId(domain_id)),
        };
        let requested = [
            bound(named("/scan", &[]), 1),
            bound(named("/nav", &[(2, 7)]), 2),
            bound(named("/scan", &[]), 3),
            bound(topics("/camera/**", 0), 4),
            bound(topics("/camera/**", 5), 5),
            bound(BoundScope::Listed(Arc::new([(2, 8)].into())), 6),
        ];
        let callback = |address, domain_id, topic: &str, node: &str| CallbackNames {
            handle: Handle {
                address,
                process: 2,
                kind: kind::CALLBACK,
            },
            domain_id: DomainId(domain_id),
            trigger: Trigger::Subscription(topic.into()),
            node: Some(node.into()),
        };
        let of = |callback| bound_of(&requested, &callback).map(|bound| bound / 1_000_000);
        assert_eq!(of(callback(1, 0, "/scan", "/nav")), Some(1));
        assert_eq!(of(callback(1, 0, "/map", "/nav")), Some(2));
        assert_eq!(of(callback(1, 0, "/map", "/other")), None);
        // The graph knows the node of this one.
        assert_eq!(of(callback(7, 0, "/map", "/other")), Some(2));
        assert_eq!(of(callback(8, 0, "/map", "/other")), Some(6));
        assert_eq!(of(callback(1, 0, "/camera/front/image", "/other")), Some(4));
        assert_eq!(of(callback(1, 5, "/camera/front/image", "/other")), Some(5));
        assert_eq!(of(callback(1, 6, "/camera/front/image", "/other")), None);
        let timer = CallbackNames {
            trigger: Trigger::Timer(None),
            ..callback(1, 0, "", "/other")
        };
        let all = [bound(BoundScope::All, 4)];
        assert_eq!(bound_of(&all, &timer), Some(4_000_000));
    }

    #[test]
    fn a_requested_bound_is_exact_and_a_learnt_one_changes_by_a_step() {
        let learnt = Learnt {
            set: Some([5_400_000; 2]),
            ..Learnt::default()
        };
        let new = Some([5_000_000; 2]);
        assert!(learnt.differs(new, true) && !learnt.differs(new, false));
        assert!(!learnt.differs(learnt.set, true));
        assert!(learnt.differs(None, false));
    }

    #[test]
    fn callbacks_beyond_the_cap_have_no_bound() {
        let mut bounds: Bounded<CallbackBounds, HashMap<Handle, Learnt>> = Bounded::default();
        for address in 0..10_000 {
            let handle = Handle {
                address,
                process: 1,
                kind: kind::CALLBACK,
            };
            bounds.get_or_insert_with(handle, Learnt::default);
        }
        assert_driven::<CallbackBounds>();
        assert_eq!(bounds.len(), CallbackBounds::CAP);
    }
}
