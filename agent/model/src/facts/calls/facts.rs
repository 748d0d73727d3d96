//! Calls inside processes, as a snapshot shows them.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::{DomainId, Guid};

use super::late::{Cause, LateCall, Part, Stage};
use super::other_thread::ThreadLabel;
use super::report::{Durations, ThreadStates, Trigger};
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::tables::{LateHistory, WaitingLateCalls};

/// Facts from inside processes. Lists are sorted by process and handle.
#[derive(Clone, Debug, Default)]
pub struct InsideFacts {
    /// Time of the last report.
    pub at: ModelTime,
    /// Whether callbacks are observed, and not only messages.
    pub has_callbacks: bool,
    /// Observed processes.
    pub processes: Vec<ObservedProcess>,
    /// Publishers.
    pub publishers: Vec<Publisher>,
    /// Subscriptions that take from the middleware.
    pub subscriptions: Vec<Subscription>,
    /// Queues of subscriptions whose arrivals are known.
    pub reader_queues: Vec<ReaderQueue>,
    /// Ring buffers of intra-process subscriptions.
    pub buffers: Vec<Buffer>,
    /// Callbacks.
    pub callbacks: Vec<Callback>,
    /// Callbacks with late calls.
    pub late: Vec<LateCallback>,
    /// Last lifecycle state of each managed node.
    pub states: Vec<LifecycleState>,
}

/// An observed process.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ObservedProcess {
    /// Process id in the initial namespace.
    pub id: u32,
    /// Process name.
    pub name: Option<Arc<str>>,
    /// Domain of the process.
    pub domain_id: DomainId,
    /// CPU time per second over the last window; 1 is one CPU. `None` before the second report.
    pub cpu: Option<f64>,
    /// Observed calls per second over the same window.
    pub calls_hz: Option<f64>,
    /// Observed calls so far.
    pub calls: u64,
    /// Calls that were not counted because of too many handles.
    pub refused: u64,
    /// Whether its calls exceed the budget and are not counted.
    pub is_suspended: bool,
    /// Whether its library reports every step of intra-process messages.
    pub shows_intra_process: bool,
    /// Its nodes, as far as they are known.
    pub nodes: Vec<NodeName>,
}

/// Identity of a publisher, subscription, buffer or callback.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Owner {
    /// Process id.
    pub process: u32,
    /// Address in the process.
    pub handle: u64,
    /// Domain.
    pub domain_id: DomainId,
    /// Its node, if known.
    pub node: Option<NodeName>,
}

/// Durations of the last window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quantiles {
    /// Number of durations.
    pub count: u64,
    /// Median.
    pub p50: Duration,
    /// 99th percentile.
    pub p99: Duration,
    /// Largest duration; an upper bound if a longer one occurred before the window.
    pub maximum: Duration,
}

/// A publisher.
#[derive(Clone, Debug)]
pub struct Publisher {
    /// Identity and node.
    pub owner: Owner,
    /// Its topic.
    pub topic: TopicName,
    /// Identifier of its middleware.
    pub middleware: Option<Arc<str>>,
    /// Messages published.
    pub published: u64,
    /// Messages among them passed directly to subscriptions in the same process.
    pub within_process: u64,
    /// Publications per second over the last window.
    pub rate_hz: Option<f64>,
    /// Time of the last publication.
    pub last: ModelTime,
    /// Time between consecutive publications, over the last window.
    pub interval: Quantiles,
}

/// A subscription.
#[derive(Clone, Debug)]
pub struct Subscription {
    /// Identity and node.
    pub owner: Owner,
    /// Its topic.
    pub topic: TopicName,
    /// Identifier of its middleware.
    pub middleware: Option<Arc<str>>,
    /// Messages taken.
    pub taken: u64,
    /// Attempts that returned no message.
    pub failed: u64,
    /// Messages taken per second over the last window.
    pub rate_hz: Option<f64>,
    /// Time of the last message.
    pub last: ModelTime,
    /// Time from the source timestamp to the take, over the last window.
    pub latency: Quantiles,
}

/// The ring buffer of an intra-process subscription.
#[derive(Clone, Debug)]
pub struct Buffer {
    /// Identity and node.
    pub owner: Owner,
    /// Its topic, if known.
    pub topic: Option<TopicName>,
    /// Messages put into the buffer.
    pub enqueued: u64,
    /// Messages overwritten before they were taken.
    pub overwritten: u64,
    /// Messages taken.
    pub dequeued: u64,
    /// Share of the messages of the last window that were overwritten.
    pub overwritten_ratio: Option<f64>,
    /// Messages in the buffer after the last insertion.
    pub depth: u32,
    /// Maximum of `depth` so far.
    pub max_depth: u32,
    /// Capacity, if known.
    pub capacity: Option<u32>,
    /// Messages put into the buffer per second over the last window.
    pub rate_hz: Option<f64>,
    /// Time of the last insertion.
    pub last: ModelTime,
    /// Time that messages spent in the buffer, over the last window.
    pub waiting: Quantiles,
}

/// The queue of a process's subscriptions to one topic, between the network and the calls that take
/// messages.
#[derive(Clone, Debug)]
pub struct ReaderQueue {
    /// Process, handle of its first subscription, and node.
    pub owner: Owner,
    /// Its topic.
    pub topic: TopicName,
    /// The only writer whose messages arrive; `None` if there are several.
    pub writer: Option<Guid>,
    /// Maximum number of messages in the queue, if announced.
    pub depth: Option<u64>,
    /// Messages that arrived since the comparison with taken messages began.
    pub arrived: u64,
    /// Messages among them that were taken.
    pub taken: u64,
    /// Messages among them that were lost.
    pub lost: u64,
}

/// A callback.
#[derive(Clone, Debug)]
pub struct Callback {
    /// Identity and node.
    pub owner: Owner,
    /// Trigger of the callback.
    pub trigger: Trigger,
    /// Thread of its last call.
    pub thread: u32,
    /// Completed calls.
    pub calls: u64,
    /// Periods in which a timer was not called.
    pub skipped: u64,
    /// Calls per second over the last window.
    pub rate_hz: Option<f64>,
    /// Share of the last window that its calls took.
    pub busy: Option<f64>,
    /// End of the last call.
    pub last: ModelTime,
    /// Duration of calls, over the last window.
    pub duration: Quantiles,
    /// Time from ready to start of each call, over the last window.
    pub wait: Quantiles,
    /// Durations of all calls.
    pub durations: Arc<Durations>,
    /// Waits of all calls.
    pub waits: Arc<Durations>,
    /// What the time of all calls consisted of.
    pub states: ThreadStates,
    /// What the time of the calls that ended in the last window consisted of.
    pub recent_states: ThreadStates,
}

/// Late calls of a callback.
#[derive(Clone, Debug)]
pub struct LateCallback {
    /// Identity and node. The process may have ended.
    pub owner: Owner,
    /// Trigger of the callback.
    pub trigger: Trigger,
    /// Late calls.
    pub calls: u64,
    /// Time of all late calls, by stage and cause.
    pub sums: Vec<((Stage, Cause), Duration)>,
    /// Late calls by the cause that made them late.
    pub causes: Vec<((Stage, Cause), u64)>,
    /// The last late calls, oldest first.
    pub history: Arc<Bounded<LateHistory, VecDeque<LateEntry>>>,
    /// The longest late calls.
    pub longest: Vec<Arc<LateExample>>,
    /// The last late calls, oldest first.
    pub latest: Vec<Arc<LateExample>>,
}

/// A late call in a list of many.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LateEntry {
    /// Start of the call.
    pub at: ModelTime,
    /// Stage in which it became late.
    pub stage: Stage,
    /// What made it late.
    pub cause: Cause,
    /// Time from ready to the end of the call.
    pub total: Duration,
    /// Thread that ran instead for longest, released the lock, or continued the process.
    pub other_thread: Option<ThreadLabel>,
}

/// Late calls since the last output.
#[derive(Debug, Default)]
pub struct NewLateCalls {
    /// The calls with their domains, in the order of the reports.
    pub calls: Bounded<WaitingLateCalls, Vec<(DomainId, Arc<LateExample>)>>,
    /// Number of calls left out because the list was full.
    pub lost: u64,
}

/// A late call with all its parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LateExample {
    /// Start of the call.
    pub at: ModelTime,
    /// What made it late.
    pub main: Option<Part>,
    /// The call.
    pub call: LateCall,
}

/// The last lifecycle state of a managed node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LifecycleState {
    /// Process id.
    pub process: u32,
    /// Domain.
    pub domain_id: DomainId,
    /// The node, if known.
    pub node: Option<NodeName>,
    /// Label of the state.
    pub state: Arc<str>,
    /// Label of the previous state.
    pub before: Arc<str>,
    /// Time of the transition.
    pub at: ModelTime,
}

/// Sums of a topic over all processes, including ended ones. No count ever decreases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TopicCounts {
    /// Messages published. ROS 2 Humble does not report messages within a process. There, the count
    /// is at least the number of receptions of one callback.
    pub published: u64,
    /// Messages among them passed directly to subscriptions in the same process.
    pub within_process: u64,
    /// Messages taken from the middleware, by all subscriptions.
    pub taken: u64,
    /// Attempts to take that returned no message.
    pub failed: u64,
    /// Messages put into buffers of intra-process subscriptions.
    pub enqueued: u64,
    /// Messages among them overwritten before they were taken.
    pub overwritten: u64,
    /// Messages taken from buffers of intra-process subscriptions.
    pub dequeued: u64,
    /// Calls of callbacks for messages of the same process.
    pub receptions: u64,
}

/// Figures of a topic from inside processes.
#[derive(Clone, Debug, Default)]
pub struct TopicInside {
    /// Counts over all processes.
    pub counts: TopicCounts,
    /// Messages of the topic: those published in observed processes, or those that one subscription
    /// took if they are more.
    pub messages: u64,
    /// Rate of `messages` per second over the last window.
    pub rate_hz: f64,
    /// Time of the last message.
    pub last: Option<ModelTime>,
    /// Live publishers in observed processes.
    pub publishers: usize,
    /// Live subscriptions and buffers in observed processes.
    pub subscriptions: usize,
    /// Messages in the buffers after the last insertions.
    pub depth: u64,
    /// Time from the source timestamp to the take, of all messages.
    pub latency: Arc<Durations>,
    /// Time that messages spent in buffers.
    pub waiting: Arc<Durations>,
    /// Messages that arrived at observed processes and were never taken. `None` if no process
    /// allows a comparison of arrived and taken messages.
    pub lost_in_queues: Option<u64>,
}

impl LateCallback {
    /// Returns the time of the last late call.
    #[must_use]
    pub fn last(&self) -> ModelTime {
        let last = self.latest.last();
        last.map_or(ModelTime::ZERO, |example| example.at)
    }
}

impl Quantiles {
    /// Returns the quantiles of these durations.
    #[must_use]
    pub fn of(durations: &Durations) -> Self {
        let quantile = |part| durations.quantile(part).unwrap_or_default();
        let range = durations.range();
        Self {
            count: durations.count(),
            p50: quantile(0.5),
            p99: quantile(0.99),
            maximum: range.map_or(Duration::ZERO, |(_, largest)| largest),
        }
    }
}
