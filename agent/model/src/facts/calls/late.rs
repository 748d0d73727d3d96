//! Late calls of callbacks: what a source reports of each, and the causes of its parts.

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
    /// Retransmissions for which the call waited. The model adds them.
    pub repairs: Repairs,
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

/// Repairs for which a call waited: times from the arrival to the start of the call.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Repairs {
    /// The message itself was lost at first.
    pub of_message: Option<Duration>,
    /// An earlier message of the same publisher was lost at first. The middleware kept the later ones
    /// until it arrived, or until the publisher gave it up (GAP, or firstSN of a HEARTBEAT).
    pub of_earlier: Option<Duration>,
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
    /// How long before the call it was woken for the message; `None` if that is unknown.
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
    /// Until a thread of the middleware passed it to the executor. Known without a socket, and of a
    /// message that waited for an earlier one.
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
    /// The message, or an earlier one of its publisher, was lost and sent again, or given up.
    Repaired,
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
    pub const ALL: [Self; 19] = [
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
        Self::Repaired,
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
            Self::Repaired => "repaired",
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
            Self::Repaired => {
                "the message or one before it was lost and sent again, or given up".to_owned()
            }
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
            Self::Repaired => {
                "look where messages of the topic get lost: on the link, or at a full buffer"
            }
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
    pub(super) const fn state(self) -> Option<usize> {
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
            | Self::Repaired
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
