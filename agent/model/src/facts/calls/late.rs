//! Late calls of callbacks, and what the time of each consisted of.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::Timestamp;
use ros2probe_wire::inside::late::wait;

use super::other_thread::OtherThread;
use super::report::{ThreadStates, Trigger};
use crate::facts::names::NodeName;

/// A call that exceeded a bound of its callback, as a source reports it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LateCall {
    /// Process of the callback.
    pub process: u32,
    /// Address of the callback in its process.
    pub handle: u64,
    /// Its node, if known.
    pub node: Option<NodeName>,
    /// Trigger of the callback.
    pub trigger: Trigger,
    /// Thread of the call.
    pub thread: u32,
    /// CPU on which the call ended.
    pub cpu: u32,
    /// Source timestamp of the message.
    pub source: Option<Timestamp>,
    /// Start of the call.
    pub started: Timestamp,
    /// Duration of the call.
    pub duration: Duration,
    /// Time from ready to start; `None` if it is unknown.
    pub wait: Option<Duration>,
    /// The bounds that the call is compared with.
    pub bound: LateBound,
    /// How the message came into the process; `None` without a message through a UDP socket.
    pub delivery: Option<MessageDelivery>,
    /// How the executor's thread was woken, if a thread of the middleware did that.
    pub handoff: Option<Handoff>,
    /// Limits on the speed of CPUs, at most a second after the call.
    pub cpu_limits: Arc<[CpuLimit]>,
    /// The last time before the call in which the thread was stopped.
    pub stop: Option<Stop>,
    /// The call before in the same thread.
    pub previous: Option<PreviousCall>,
    /// The time in which that thread made one call after the other until this one.
    pub busy: Option<BusyTime>,
    /// A call of the same node in another thread, which woke this one at its end, after `previous`.
    pub released_by: Option<PreviousCall>,
    /// What the thread did during the call, by the scheduler's accounting.
    pub states: Option<ThreadStates>,
    /// What it did between the call before and this one.
    pub states_before: Option<ThreadStates>,
    /// What it did during the call, by the scheduler's events.
    pub activity: Option<Activity>,
    /// What it did between the call before and this one, by events.
    pub activity_before: Option<Activity>,
}

/// A time in which a thread was stopped, by SIGSTOP or a debugger.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stop {
    /// Time from its end to the start of the call.
    pub ended_before: Duration,
    /// Its length, and the thread that ended it.
    pub wait: Blocked,
}

/// Why CPUs are slower than they can be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CpuLimit {
    /// Their maximum frequency is set to less.
    Frequency {
        /// The CPUs, as the kernel lists them.
        cpus: Arc<str>,
        /// Maximum frequency at present.
        allowed_mhz: u32,
        /// Maximum frequency of these CPUs.
        maximum_mhz: u32,
    },
    /// The kernel slows them down because of heat.
    Cooling {
        /// Type of the cooling device.
        device: Arc<str>,
        /// Its state; 0 = it does not slow them down.
        state: u32,
        /// Its maximum state.
        maximum: u32,
    },
    /// Raspberry Pi: the voltage is too low.
    UnderVoltage,
    /// Raspberry Pi: the frequency is capped.
    FrequencyCapped,
    /// Raspberry Pi: the firmware slows the CPUs down.
    Throttled,
    /// Raspberry Pi: the soft temperature limit is reached.
    SoftTemperatureLimit,
}

impl CpuLimit {
    /// Returns a sentence without a period.
    #[must_use]
    pub fn in_words(&self) -> String {
        match self {
            Self::Frequency {
                cpus,
                allowed_mhz,
                maximum_mhz,
            } => format!("CPUs {cpus} run at {allowed_mhz} of {maximum_mhz} MHz at most"),
            Self::Cooling {
                device,
                state,
                maximum,
            } => format!("heat: {device} slows CPUs down ({state} of {maximum})"),
            Self::UnderVoltage => "the power supply is too weak: the voltage is low".to_owned(),
            Self::FrequencyCapped => "the firmware caps the frequency of CPUs".to_owned(),
            Self::Throttled => "the firmware slows the CPUs down".to_owned(),
            Self::SoftTemperatureLimit => "heat: the soft temperature limit is reached".to_owned(),
        }
    }
}

/// From when on a call is late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LateBound {
    /// Maximum duration of a call.
    pub duration: Duration,
    /// Maximum time from ready to start.
    pub wait: Duration,
}

/// A time in which a thread did not wait for work.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusyTime {
    /// Time from its begin to the start of the present call.
    pub began_before: Duration,
    /// Its part in callbacks.
    pub in_callbacks: Duration,
    /// What the thread did between them.
    pub states: WaitingStates,
    /// The longest of these calls.
    pub longest: PreviousCall,
}

/// An earlier call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PreviousCall {
    /// Address of its callback.
    pub handle: u64,
    /// Trigger of that callback.
    pub trigger: Trigger,
    /// Its duration.
    pub duration: Duration,
    /// Time from its end to the start of the next call.
    pub ended_before: Duration,
}

/// How a message came into a process: times before the start of its call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MessageDelivery {
    /// A socket of this host sent the first datagram; `None` if the publisher is on another host.
    pub sent_before: Option<Duration>,
    /// The last datagram arrived at the subscriber's socket.
    pub arrived_before: Duration,
    /// A thread of the process received that datagram.
    pub received_before: Duration,
    /// That thread.
    pub receiver_thread: u32,
    /// States of that thread between the two, if they are known.
    pub receiver: Option<WaitingStates>,
}

/// How a thread of the middleware passed a message to the executor's thread: times before the start
/// of the call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Handoff {
    /// The middleware's thread.
    pub thread: u32,
    /// It woke the executor's thread.
    pub woken_before: Duration,
    /// For how long the executor's thread could run and did not before that, since the call before.
    pub runnable_before: Duration,
    /// It was woken for the message; `None` if that is not known.
    pub received_before: Option<Duration>,
    /// What it did between the two.
    pub receiver: WaitingStates,
    /// Threads that ran instead of it, with the longest time first.
    pub others: Vec<OtherThread>,
    /// Thread of a publisher's process that woke it: it put the message into shared memory.
    pub sender: Option<OtherThread>,
}

/// Why a thread did not run although it could.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WaitingStates {
    /// It could run, and did not. This does not include `throttled`.
    pub runnable: Duration,
    /// The CPU quota of its control group was used up.
    pub throttled: Duration,
}

/// What a thread did in a span of time, by the events of the scheduler.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Activity {
    /// It was on a CPU.
    pub cpu: Duration,
    /// Changes of its state that had no event.
    pub missed_events: u64,
    /// It could run, and did not.
    pub runnable: Duration,
    /// It was on a CPU without being charged for it: interrupts, or the hypervisor.
    pub stolen: Duration,
    /// It was blocked, in the order of [`wait`].
    pub blocked: [Duration; wait::COUNT],
    /// The longest of these times.
    pub longest: Option<Blocked>,
    /// Threads that ran instead, with the longest time first. Idle CPUs are among them.
    pub others: Vec<OtherThread>,
}

/// A time in which a thread was blocked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Blocked {
    /// Its length.
    pub duration: Duration,
    /// One of [`wait`].
    pub kind: usize,
    /// The system call: its name, or its number.
    pub call: Option<Arc<str>>,
    /// First argument of the system call: the address of a lock, or a file descriptor.
    pub argument: u64,
    /// Thread that ended the wait, where that means something: it released the lock, or sent
    /// SIGCONT.
    pub waker: Option<OtherThread>,
}

/// Where a late call lost its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stage {
    /// From the call that publishes the message until its first datagram is sent, or until it is in
    /// shared memory.
    Publish,
    /// Until its last datagram arrives at the subscriber's socket. If the publisher is on another
    /// host, this includes [`Self::Publish`].
    Network,
    /// In the receive buffer of that socket.
    Socket,
    /// Until a thread of the middleware passed it to the executor. Known without a socket.
    Receive,
    /// Until the callback started, since it was ready. If the way of the message is not known, this
    /// includes the other stages.
    Wait,
    /// In the callback.
    Callback,
}

/// For what a late call needed its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Cause {
    /// The thread ran on a CPU.
    Cpu,
    /// The CPU served interrupts, or the hypervisor ran another guest.
    Stolen,
    /// The CPU quota of its control group was used up.
    Throttled,
    /// The thread could run, and others ran instead.
    Runnable,
    /// It waited for a lock.
    Lock,
    /// It slept.
    Sleep,
    /// It waited for a disk, or for the kernel.
    Disk,
    /// It waited for a page of its memory.
    PageFault,
    /// It was stopped.
    Stopped,
    /// It waited in another system call.
    SystemCall,
    /// It was blocked. Without the scheduler's events, the reason is unknown.
    Blocked,
    /// The executor's thread was in another callback.
    OtherCallback,
    /// The message came late: the executor's thread waited for it too.
    Arrival,
    /// The publisher took long to send the message.
    Send,
    /// The message was long on its way.
    Transit,
    /// No thread received the message from its socket.
    Queue,
    /// The middleware had received the message, and the executor's thread waited for it.
    Middleware,
    /// Unknown.
    Unexplained,
}

impl Stage {
    /// Every stage, in the order of time.
    pub const ALL: [Self; 6] = [
        Self::Publish,
        Self::Network,
        Self::Socket,
        Self::Receive,
        Self::Wait,
        Self::Callback,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Network => "network",
            Self::Socket => "socket",
            Self::Receive => "receive",
            Self::Wait => "wait",
            Self::Callback => "callback",
        }
    }
}

impl Cause {
    /// Every cause.
    pub const ALL: [Self; 18] = [
        Self::Cpu,
        Self::Stolen,
        Self::Throttled,
        Self::Runnable,
        Self::Lock,
        Self::Sleep,
        Self::Disk,
        Self::PageFault,
        Self::Stopped,
        Self::SystemCall,
        Self::Blocked,
        Self::OtherCallback,
        Self::Arrival,
        Self::Send,
        Self::Transit,
        Self::Queue,
        Self::Middleware,
        Self::Unexplained,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Stolen => "stolen",
            Self::Throttled => "throttled",
            Self::Runnable => "runnable",
            Self::Lock => "lock",
            Self::Sleep => "sleep",
            Self::Disk => "disk",
            Self::PageFault => "page_fault",
            Self::Stopped => "stopped",
            Self::SystemCall => "system_call",
            Self::Blocked => "blocked",
            Self::OtherCallback => "other_callback",
            Self::Arrival => "arrival",
            Self::Send => "send",
            Self::Transit => "transit",
            Self::Queue => "queue",
            Self::Middleware => "middleware",
            Self::Unexplained => "unexplained",
        }
    }

    /// Returns what the cause did to a call, for the end of a sentence. `by` is the thread that ran
    /// instead, held the lock, continued the process, or sent the message.
    #[must_use]
    pub fn in_words(self, by: Option<&dyn fmt::Display>) -> String {
        let other = by.unwrap_or(&"another thread");
        match self {
            Self::Cpu => "it computed".to_owned(),
            Self::Stolen => "interrupts or the hypervisor took the CPU".to_owned(),
            Self::Throttled => "its control group had used up its CPU quota".to_owned(),
            Self::Runnable => format!("{other} ran instead"),
            Self::Lock => format!("it waited for a lock that {other} released"),
            Self::Sleep => "it slept".to_owned(),
            Self::Disk => "it waited for the disk or the kernel".to_owned(),
            Self::PageFault => "it waited for a page of its memory".to_owned(),
            Self::Stopped => format!("it was stopped until {other} continued it"),
            Self::SystemCall => "it waited in a system call".to_owned(),
            Self::Blocked => "it was blocked".to_owned(),
            Self::OtherCallback => "its thread was in another callback".to_owned(),
            Self::Arrival => "the message came late: the executor waited for it".to_owned(),
            Self::Send => match by {
                Some(by) => format!("{by} published it and took long to send it"),
                None => "its publisher took long to send it".to_owned(),
            },
            Self::Transit => "the message was long on its way to the socket".to_owned(),
            Self::Queue => "the message waited in the socket's receive buffer".to_owned(),
            Self::Middleware => "the middleware passed the message on late".to_owned(),
            Self::Unexplained => "the cause is unknown".to_owned(),
        }
    }

    /// Returns what helps against the cause.
    #[must_use]
    pub const fn remedy(self) -> &'static str {
        match self {
            Self::Cpu => "shorten the callback, or divide its work",
            Self::Stolen => "move interrupts to another CPU, or give the guest more of the host",
            Self::Throttled => "raise CPUQuota of its unit, or cpu.max of its control group",
            Self::Runnable => {
                "give the node a higher priority or a CPU of its own, or limit the other process"
            }
            Self::Lock => "hold the lock for a shorter time, or copy the data first",
            Self::Sleep => "use a timer instead of a sleep in the callback",
            Self::Disk => "write files in another thread, or without fsync",
            Self::PageFault => "lock the memory of the process (mlockall), or read files earlier",
            Self::Stopped => "look for who sends SIGSTOP, or for a debugger",
            Self::SystemCall | Self::Blocked => "move calls that block to another thread",
            Self::OtherCallback => {
                "shorten the other callback, or give this one a callback group and thread of its own"
            }
            Self::Arrival => "look at the topic's network path and at its publisher",
            Self::Send => "look at the publisher's process: it is busy, or its CPU is",
            Self::Transit => "look at the link between the hosts, and at losses on it",
            Self::Queue => "find what keeps the process from running: a busy CPU, a quota, SIGSTOP",
            Self::Middleware => {
                "send smaller messages, or give the middleware's threads a free CPU"
            }
            Self::Unexplained => "set capture.late: on, and look at rp doctor",
        }
    }

    /// Returns the cause of a blocked time, one of [`wait`].
    #[must_use]
    pub const fn of_wait(kind: usize) -> Self {
        match kind {
            wait::LOCK => Self::Lock,
            wait::SLEEP => Self::Sleep,
            wait::DISK => Self::Disk,
            wait::PAGE_FAULT => Self::PageFault,
            wait::STOPPED => Self::Stopped,
            _ => Self::SystemCall,
        }
    }

    /// Returns the state of the thread that includes this cause: the index of
    /// [`ThreadStates::nanoseconds`].
    const fn state(self) -> Option<usize> {
        match self {
            Self::Cpu | Self::Stolen => Some(0),
            Self::Throttled => Some(1),
            Self::Runnable => Some(2),
            Self::Lock
            | Self::Sleep
            | Self::Disk
            | Self::PageFault
            | Self::Stopped
            | Self::SystemCall
            | Self::Blocked => Some(3),
            Self::OtherCallback
            | Self::Arrival
            | Self::Send
            | Self::Transit
            | Self::Queue
            | Self::Middleware
            | Self::Unexplained => None,
        }
    }
}

/// A part of the time of a late call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Stage of the call.
    pub stage: Stage,
    /// Cause of the part.
    pub cause: Cause,
    /// Its length.
    pub duration: Duration,
}

impl LateCall {
    /// Returns the time from ready to the end of the call.
    #[must_use]
    pub fn total(&self) -> Duration {
        self.wait.unwrap_or_default() + self.duration
    }

    /// Returns the parts of the time of the call, in the order of their time. They add up to
    /// [`Self::total`].
    ///
    /// The sums are those of the scheduler's accounting. The events divide them: events can get
    /// lost, and the accounting cannot. Only the CPU time is that of the events, if none is missing:
    /// the accounting counts it by ticks.
    #[must_use]
    pub fn parts(&self) -> Vec<Part> {
        let mut parts = self.wait_parts();
        parts.extend(self.callback_parts());
        parts.retain(|part| !part.duration.is_zero());
        parts
    }

    /// Divides the wait from its end to its begin: what happened last on the way of the message
    /// explains the latest time.
    fn wait_parts(&self) -> Vec<Part> {
        let Some(wait) = self.wait else {
            return Vec::new();
        };
        let Some(delivery) = &self.delivery else {
            return match &self.handoff {
                // The thread ran already when the message was published.
                Some(handoff) if handoff.woken_before <= wait => self.handoff_parts(handoff, wait),
                _ => self.executor_parts(wait, Cause::Arrival),
            };
        };
        let in_process = wait.min(delivery.received_before);
        let since_arrival = wait.min(delivery.arrived_before);
        let since_sent = match delivery.sent_before {
            Some(sent_before) => wait.min(sent_before),
            None => wait,
        };
        let mut parts = Rest::new(Stage::Publish, wait - since_sent).finish(Cause::Send);
        let network = Rest::new(Stage::Network, since_sent - since_arrival);
        parts.extend(network.finish(Cause::Transit));
        let mut socket = Rest::new(Stage::Socket, since_arrival - in_process);
        if let Some(receiver) = &delivery.receiver {
            socket.take(Cause::Throttled, receiver.throttled);
            socket.take(Cause::Runnable, receiver.runnable);
        }
        socket.take(Cause::Stopped, self.stopped(in_process, since_arrival));
        parts.extend(socket.finish(Cause::Queue));
        parts.extend(self.executor_parts(in_process, Cause::Middleware));
        parts
    }

    /// Divides the wait for a message that came through no socket, or whose way is not known.
    fn handoff_parts(&self, handoff: &Handoff, wait: Duration) -> Vec<Part> {
        let since_woken = handoff.woken_before;
        let Some(received_before) = handoff.received_before else {
            let mut before = Rest::new(Stage::Wait, wait - since_woken);
            before.take(Cause::Stopped, self.stopped(since_woken, wait));
            let mut parts = before.finish(Cause::Arrival);
            parts.extend(self.woken_parts(handoff));
            return parts;
        };
        let since_received = wait.min(received_before);
        let (stage, cause) = match handoff.sender {
            Some(_) => (Stage::Publish, Cause::Send),
            None => (Stage::Wait, Cause::Arrival),
        };
        let mut parts = Rest::new(stage, wait - since_received).finish(cause);
        let mut receive = Rest::new(Stage::Receive, since_received - since_woken);
        // The thread may have been awake before the message was published.
        let awake = received_before.saturating_sub(since_woken);
        let share = |of| share(receive.rest, of, awake);
        let throttled = share(handoff.receiver.throttled);
        let runnable = share(handoff.receiver.runnable);
        receive.take(Cause::Throttled, throttled);
        receive.take(Cause::Runnable, runnable);
        receive.take(Cause::Stopped, self.stopped(since_woken, since_received));
        parts.extend(receive.finish(Cause::Middleware));
        parts.extend(self.woken_parts(handoff));
        parts
    }

    /// Divides the time since the executor's thread was woken.
    fn woken_parts(&self, handoff: &Handoff) -> Vec<Part> {
        let states = self.states_before.map(|states| {
            let before = u64::try_from(handoff.runnable_before.as_nanos()).unwrap_or(u64::MAX);
            ThreadStates {
                runnable: states.runnable.saturating_sub(before),
                ..states
            }
        });
        self.parts_by(states, handoff.woken_before, Cause::Middleware)
    }

    /// Returns for how long the process was stopped between two times before the call. A signal
    /// stops all threads of a process.
    fn stopped(&self, until_before: Duration, from_before: Duration) -> Duration {
        let span = Span {
            began_before: from_before,
            ended_before: until_before,
        };
        let stop = self.stop.as_ref();
        stop.map_or(Duration::ZERO, |stop| span.common(stop.span()))
    }

    /// Divides the last `wait` before the call by what the executor's thread did. `waiting` is the
    /// cause of the time in which that thread waited too.
    fn executor_parts(&self, wait: Duration, waiting: Cause) -> Vec<Part> {
        self.parts_by(self.states_before, wait, waiting)
    }

    /// The same, with what that thread did since the call before.
    fn parts_by(&self, states: Option<ThreadStates>, wait: Duration, waiting: Cause) -> Vec<Part> {
        let mut rest = Rest::new(Stage::Wait, wait);
        let stop = self.stop.as_ref().map_or(Span::default(), Stop::span);
        let stop = stop.within(wait);
        rest.take(Cause::Stopped, stop.duration());
        // The thread made one call, and waited during another one of the same callback group.
        let mut until = Duration::ZERO;
        for call in [&self.released_by, &self.previous].into_iter().flatten() {
            let span = call.span().within(wait).before(until);
            rest.take(Cause::OtherCallback, span.duration() - span.common(stop));
            until = until.max(span.began_before);
        }
        if let (Some(busy), Some(previous)) = (&self.busy, &self.previous) {
            // Earlier calls, between which the thread did not wait.
            let earlier = Span {
                began_before: busy.began_before,
                ended_before: previous.span().began_before,
            };
            let span = earlier.within(wait).before(until);
            let share = |of| share(span.duration(), of, earlier.duration());
            let in_callbacks = share(busy.in_callbacks.saturating_sub(previous.duration));
            let stopped = span.common(stop);
            rest.take(Cause::OtherCallback, in_callbacks.saturating_sub(stopped));
            let last = self.states_before.unwrap_or_default();
            let between = |all: Duration, last| share(all.saturating_sub(nanoseconds(last)));
            let throttled = between(busy.states.throttled, last.throttled);
            rest.take(Cause::Throttled, throttled);
            rest.take(
                Cause::Runnable,
                between(busy.states.runnable, last.runnable),
            );
        }
        // The thread was between two calls for the remaining time.
        match states {
            Some(states) => {
                rest.take(Cause::Throttled, nanoseconds(states.throttled));
                rest.take(Cause::Runnable, nanoseconds(states.runnable));
                rest.finish(waiting)
            }
            None => rest.finish(Cause::Unexplained),
        }
    }

    fn callback_parts(&self) -> Vec<Part> {
        let mut rest = Rest::new(Stage::Callback, self.duration);
        let Some(states) = self.states else {
            return rest.finish(Cause::Unexplained);
        };
        let activity = self.activity.as_ref();
        // The CPU time of the accounting may lack a tick, or have one that precedes the call.
        let exact = activity.and_then(|activity| activity.cpu_of(self.duration));
        let cpu = exact.unwrap_or(nanoseconds(states.cpu));
        let stolen = activity.map_or(Duration::ZERO, |activity| activity.stolen.min(cpu));
        rest.take(Cause::Cpu, cpu - stolen);
        rest.take(Cause::Stolen, stolen);
        rest.take(Cause::Throttled, nanoseconds(states.throttled));
        rest.take(Cause::Runnable, nanoseconds(states.runnable));
        let Some(activity) = activity else {
            return rest.finish(Cause::Blocked);
        };
        // With a tick too many, the events show more blocked time.
        let all: Duration = activity.blocked.iter().sum();
        let blocked = rest.rest;
        for (kind, duration) in activity.blocked.iter().enumerate() {
            let share = match all > blocked {
                true => share(blocked, *duration, all),
                false => *duration,
            };
            rest.take(Cause::of_wait(kind), share);
        }
        rest.finish(Cause::Unexplained)
    }

    /// Returns the main part: what made the call late. `usual` is what the time of all calls of the
    /// callback consisted of. A part that each call has explains nothing, unless it exceeds the
    /// bound by itself.
    #[must_use]
    pub fn main_part(&self, usual: ThreadStates) -> Option<Part> {
        let excess = |time: Duration, bound: Duration| time.saturating_sub(bound);
        let in_callback = excess(self.duration, self.bound.duration);
        let in_wait = excess(self.wait.unwrap_or_default(), self.bound.wait);
        let is_wait = in_wait > in_callback;
        let parts = self.parts();
        let parts = || {
            let of_wait = |part: &&Part| (part.stage != Stage::Callback) == is_wait;
            parts.iter().filter(of_wait)
        };
        let largest = parts().max_by_key(|part| part.duration).copied();
        if is_wait || usual.calls == 0 {
            return largest;
        }
        let beyond = |part: &&Part| {
            let mean = |state: usize| {
                let sums = usual.nanoseconds();
                nanoseconds(sums.get(state).copied().unwrap_or_default() / usual.calls)
            };
            let usual = part.cause.state().map_or(Duration::ZERO, mean);
            part.duration.saturating_sub(usual)
        };
        let unusual = parts().max_by_key(beyond);
        let is_large = |part: &&Part| beyond(part) * 4 >= self.duration;
        unusual.filter(is_large).copied().or(largest)
    }

    /// Returns the thread that a cause names: the one that ran instead for longest, released the
    /// lock, continued the process, or sent the message.
    #[must_use]
    pub fn named_by(&self, part: Part) -> Option<&OtherThread> {
        match part.cause {
            Cause::Runnable if part.stage == Stage::Wait => {
                // The rest precedes an earlier call, and has no events.
                let runnable = self.activity_before.as_ref()?.runnable;
                let is_most = runnable * 2 >= part.duration;
                is_most.then(|| self.culprit(part.stage)).flatten()
            }
            Cause::Runnable => self.culprit(part.stage),
            Cause::Stopped if part.stage != Stage::Callback => {
                self.stop.as_ref()?.wait.waker.as_ref()
            }
            Cause::Send if self.delivery.is_none() => self.handoff.as_ref()?.sender.as_ref(),
            Cause::Lock | Cause::Stopped => {
                let longest = self.activity(part.stage)?.longest.as_ref()?;
                longest.waker.as_ref()
            }
            _ => None,
        }
    }

    /// Returns the call for which this one waited longest, otherwise the call before in the same
    /// thread.
    #[must_use]
    pub fn waited_for(&self) -> Option<&PreviousCall> {
        let wait = self.wait.unwrap_or_default();
        let longest = self.busy.as_ref().map(|busy| &busy.longest);
        let earlier = [longest, self.released_by.as_ref(), self.previous.as_ref()];
        let earlier = earlier.into_iter().flatten();
        earlier.max_by_key(|call| call.span().within(wait).duration())
    }

    /// Returns the thread that ran instead for longest in this stage. Idle CPUs are left out.
    #[must_use]
    pub fn culprit(&self, stage: Stage) -> Option<&OtherThread> {
        let others = match (stage, &self.handoff, &self.delivery) {
            // Otherwise they may have run before the message was published. A wait is shorter than
            // the time since then, by that of the fastest message.
            (Stage::Receive, Some(handoff), _)
                if handoff.received_before? <= self.wait? * 9 / 8 =>
            {
                &handoff.others
            }
            // Another thread may have read the socket.
            (Stage::Socket, Some(handoff), Some(delivery))
                if handoff.thread == delivery.receiver_thread =>
            {
                &handoff.others
            }
            (Stage::Receive | Stage::Socket, _, _) => return None,
            _ => &self.activity(stage)?.others,
        };
        let others = others.iter();
        others
            .filter(|other| other.thread != 0)
            .max_by_key(|other| other.duration)
    }

    /// Returns what the executor's thread did in a stage, by events.
    fn activity(&self, stage: Stage) -> Option<&Activity> {
        match stage {
            Stage::Callback => self.activity.as_ref(),
            _ => self.activity_before.as_ref(),
        }
    }
}

impl PreviousCall {
    const fn span(&self) -> Span {
        Span::ending(self.ended_before, self.duration)
    }
}

impl Stop {
    const fn span(&self) -> Span {
        Span::ending(self.ended_before, self.wait.duration)
    }
}

/// A span of time before a call: its begin is the longer time.
#[derive(Clone, Copy, Default)]
struct Span {
    began_before: Duration,
    ended_before: Duration,
}

impl Span {
    const fn ending(ended_before: Duration, duration: Duration) -> Self {
        Self {
            began_before: ended_before.saturating_add(duration),
            ended_before,
        }
    }

    /// Returns the part in the last `time` before the call.
    fn within(self, time: Duration) -> Self {
        Self {
            began_before: self.began_before.min(time),
            ended_before: self.ended_before.min(time),
        }
    }

    /// Returns the part that is earlier than `time` before the call.
    fn before(self, time: Duration) -> Self {
        Self {
            began_before: self.began_before.max(time),
            ended_before: self.ended_before.max(time),
        }
    }

    fn duration(self) -> Duration {
        self.began_before.saturating_sub(self.ended_before)
    }

    /// Returns the time that both have.
    fn common(self, other: Self) -> Duration {
        let began_before = self.began_before.min(other.began_before);
        began_before.saturating_sub(self.ended_before.max(other.ended_before))
    }
}

impl Activity {
    /// Returns the CPU time if the events cover the whole `duration`.
    fn cpu_of(&self, duration: Duration) -> Option<Duration> {
        let blocked: Duration = self.blocked.iter().sum();
        let covered = self.cpu + self.runnable + blocked;
        let is_whole = covered.abs_diff(duration) * 100 <= duration;
        (self.missed_events == 0 && is_whole).then_some(self.cpu)
    }
}

/// The time of a stage that no part has yet.
struct Rest {
    stage: Stage,
    rest: Duration,
    parts: Vec<Part>,
}

impl Rest {
    const fn new(stage: Stage, rest: Duration) -> Self {
        Self {
            stage,
            rest,
            parts: Vec::new(),
        }
    }

    fn take(&mut self, cause: Cause, duration: Duration) {
        let duration = duration.min(self.rest);
        self.rest -= duration;
        match self.parts.iter_mut().find(|part| part.cause == cause) {
            Some(part) => part.duration += duration,
            None => self.parts.push(Part {
                stage: self.stage,
                cause,
                duration,
            }),
        }
    }

    fn finish(mut self, cause: Cause) -> Vec<Part> {
        self.take(cause, self.rest);
        self.parts
    }
}

const fn nanoseconds(nanoseconds: u64) -> Duration {
    Duration::from_nanos(nanoseconds)
}

/// Returns `part / all` of a duration.
fn share(of: Duration, part: Duration, all: Duration) -> Duration {
    let nanoseconds = of.as_nanos() * part.as_nanos() / all.as_nanos().max(1);
    Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
