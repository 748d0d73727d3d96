//! Reports of a source about calls inside processes: cumulative figures, once a second.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::{DomainId, Timestamp};

pub use super::durations::Durations;
use super::late::LateCall;
use crate::facts::names::{NodeName, TopicName};

/// A report about calls inside processes. Handles that have not changed since the last report are
/// left out.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Time at which the figures were read.
    pub at: Timestamp,
    /// Whether callbacks are observed, and not only messages.
    pub has_callbacks: bool,
    /// Processes with changes, and processes that have ended since the last report.
    pub processes: Vec<ProcessReport>,
    /// Lifecycle transitions since the last report.
    pub transitions: Vec<Transition>,
    /// Late calls since the last report, in the order of their end.
    pub late: Vec<LateCall>,
}

/// One process.
#[derive(Clone, Debug, Default)]
pub struct ProcessReport {
    /// Process id in the initial namespace.
    pub id: u32,
    /// Name of the process.
    pub name: Option<Arc<str>>,
    /// Its domain, from `ROS_DOMAIN_ID` of its environment.
    pub domain_id: DomainId,
    /// CPU time so far, user and system; `None` until it was read.
    pub cpu: Option<Duration>,
    /// Calls observed.
    pub hits: u64,
    /// Calls that were not counted because there were too many handles.
    pub refused: u64,
    /// Whether the process exceeds its budget, so that its calls are no longer counted.
    pub is_suspended: bool,
    /// Whether the process has ended. The figures are then its last ones.
    pub has_ended: bool,
    /// Whether its library reports every step of intra-process messages (rclcpp of Iron and later),
    /// not only their callbacks.
    pub shows_intra_process: bool,
    /// Nodes that it created while it was observed.
    pub nodes: Vec<NodeName>,
    /// Publishers.
    pub publishers: Vec<PublisherReport>,
    /// Subscriptions that take from the middleware.
    pub subscriptions: Vec<SubscriptionReport>,
    /// Ring buffers of intra-process subscriptions.
    pub buffers: Vec<BufferReport>,
    /// Callbacks.
    pub callbacks: Vec<CallbackReport>,
}

/// One publisher.
#[derive(Clone, Debug)]
pub struct PublisherReport {
    /// Its address, which identifies it in its process.
    pub handle: u64,
    /// Its node, if the process created it while it was observed.
    pub node: Option<NodeName>,
    /// ROS name of its topic.
    pub topic: TopicName,
    /// Identifier of its middleware, such as `rmw_fastrtps_cpp`.
    pub middleware: Option<Arc<str>>,
    /// Messages published.
    pub published: u64,
    /// Messages among them passed directly to subscriptions in the same process.
    pub within_process: u64,
    /// Time of the last publication.
    pub last: Timestamp,
    /// Time between consecutive publications.
    pub intervals: Durations,
}

/// One subscription.
#[derive(Clone, Debug)]
pub struct SubscriptionReport {
    /// Its address.
    pub handle: u64,
    /// Its node, if the process created it while it was observed.
    pub node: Option<NodeName>,
    /// ROS name of its topic.
    pub topic: TopicName,
    /// Identifier of its middleware.
    pub middleware: Option<Arc<str>>,
    /// Messages taken from the middleware.
    pub taken: u64,
    /// Attempts that returned no message.
    pub failed: u64,
    /// Time of the last message.
    pub last: Timestamp,
    /// Time between consecutive messages.
    pub intervals: Durations,
    /// Time from the source timestamp to the take.
    pub latency: Durations,
}

/// The ring buffer of one intra-process subscription.
#[derive(Clone, Debug)]
pub struct BufferReport {
    /// Its address.
    pub handle: u64,
    /// The subscription's node, if known.
    pub node: Option<NodeName>,
    /// ROS name of its topic; `None` until a publication shows it.
    pub topic: Option<TopicName>,
    /// Messages put into the buffer.
    pub enqueued: u64,
    /// Messages overwritten before they were taken: lost.
    pub overwritten: u64,
    /// Messages taken.
    pub dequeued: u64,
    /// Messages in the buffer after the last insertion.
    pub depth: u32,
    /// Maximum of `depth` so far.
    pub max_depth: u32,
    /// Capacity, if the process created the buffer while it was observed.
    pub capacity: Option<u32>,
    /// Time of the last insertion.
    pub last: Timestamp,
    /// Time that messages spent in the buffer.
    pub waiting: Durations,
}

/// One callback of rclcpp.
#[derive(Clone, Debug)]
pub struct CallbackReport {
    /// Its address.
    pub handle: u64,
    /// Its node, if known.
    pub node: Option<NodeName>,
    /// Trigger of the callback.
    pub trigger: Trigger,
    /// Thread of its last call.
    pub thread: u32,
    /// Completed calls.
    pub calls: u64,
    /// End of the last call.
    pub last: Timestamp,
    /// Duration of the calls.
    pub durations: Durations,
    /// Time from ready to start. A timer is ready when it is due, and an intra-process message when
    /// it enters the ring buffer. For other messages, it is the time since the source timestamp
    /// minus the smallest such time seen.
    pub waits: Durations,
    /// Periods in which a timer was not called.
    pub skipped: u64,
    /// What the time of its calls consisted of.
    pub states: ThreadStates,
}

/// What the threads of calls did, in nanoseconds, by the accounting of the kernel's scheduler.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadStates {
    /// Calls that this covers; 0 if the kernel does not show its accounting.
    pub calls: u64,
    /// They ran on a CPU.
    pub cpu: u64,
    /// They could run, but their control group had used up its CPU quota (`cpu.max`).
    pub throttled: u64,
    /// They could run, and other threads ran instead.
    pub runnable: u64,
    /// They waited for something else: a lock, a file, the end of a sleep.
    pub blocked: u64,
}

impl ThreadStates {
    /// Labels of the states, in the order of [`Self::nanoseconds`].
    pub const LABELS: [&str; 4] = ["cpu", "throttled", "runnable", "blocked"];

    /// Returns the time in each state.
    #[must_use]
    pub const fn nanoseconds(&self) -> [u64; 4] {
        [self.cpu, self.throttled, self.runnable, self.blocked]
    }

    /// Returns what was added since `earlier`; a smaller number of calls began anew.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Self {
        if self.calls < earlier.calls {
            return self;
        }
        Self {
            calls: self.calls - earlier.calls,
            cpu: self.cpu.saturating_sub(earlier.cpu),
            throttled: self.throttled.saturating_sub(earlier.throttled),
            runnable: self.runnable.saturating_sub(earlier.runnable),
            blocked: self.blocked.saturating_sub(earlier.blocked),
        }
    }

    /// Adds the times of other calls.
    pub const fn add(&mut self, other: Self) {
        self.calls += other.calls;
        self.cpu += other.cpu;
        self.throttled += other.throttled;
        self.runnable += other.runnable;
        self.blocked += other.blocked;
    }
}

/// Trigger of a callback.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trigger {
    /// Messages from the middleware.
    Subscription(TopicName),
    /// Messages from the same process; the topic is unknown if the process started before its
    /// observation.
    IntraProcess(Option<TopicName>),
    /// A timer; the period is unknown if its structure cannot be read.
    Timer(Option<Duration>),
    /// A service with its name, or another callback without one.
    Service(Option<Arc<str>>),
}

impl Trigger {
    /// Returns the label value.
    #[must_use]
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Subscription(_) => "subscription",
            Self::IntraProcess(_) => "intra_process",
            Self::Timer(_) => "timer",
            Self::Service(_) => "service",
        }
    }

    /// Returns the topic or service, if it is known.
    #[must_use]
    pub fn name(&self) -> Option<&str> {
        match self {
            Self::Subscription(topic) | Self::IntraProcess(Some(topic)) => Some(topic),
            Self::Service(name) => name.as_deref(),
            Self::IntraProcess(None) | Self::Timer(_) => None,
        }
    }

    /// Returns the timer's period, if it is known.
    #[must_use]
    pub const fn period(&self) -> Option<Duration> {
        match self {
            Self::Timer(period) => *period,
            _ => None,
        }
    }
}

/// Describes the trigger: `/scan`, `timer of 50 ms`, `service /reset`.
impl fmt::Display for Trigger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Subscription(topic) | Self::IntraProcess(Some(topic)) => f.write_str(topic),
            Self::IntraProcess(None) => f.write_str("messages of the same process"),
            Self::Timer(Some(period)) => write!(f, "timer of {period:?}"),
            Self::Timer(None) => f.write_str("timer"),
            Self::Service(Some(name)) => write!(f, "service {name}"),
            Self::Service(None) => f.write_str("service"),
        }
    }
}

/// A transition of a managed node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Transition {
    /// Process of the node.
    pub process: u32,
    /// The node, if the process created it while it was observed.
    pub node: Option<NodeName>,
    /// Label of the state before the transition.
    pub start: Arc<str>,
    /// Label of the state after the transition.
    pub goal: Arc<str>,
    /// Time of the transition.
    pub at: Timestamp,
}
