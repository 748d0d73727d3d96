//! `/inside`: observations from inside processes, and their parts in other answers.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Observations from inside processes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Inside<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Mode of the source: `off`, `topics`, `full` or `auto`.
    pub mode: Cow<'a, str>,
    /// Why an enabled source observes nothing; null if the source works or is `off`.
    pub reason: Option<Cow<'a, str>>,
    /// Observed libraries.
    pub libraries: Vec<Library<'a>>,
    /// Counters of the source, by name.
    pub counters: Vec<Counter<'a>>,
    /// Observed processes.
    pub processes: Vec<Process<'a>>,
    /// Publishers.
    pub publishers: Vec<Publisher<'a>>,
    /// Subscriptions that take messages from the middleware.
    pub subscriptions: Vec<Subscription<'a>>,
    /// Queues that the middleware fills for the subscriptions, as far as arrivals are known.
    pub reader_queues: Vec<ReaderQueue<'a>>,
    /// Buffers for intra-process messages, in Iron and later.
    pub buffers: Vec<Buffer<'a>>,
    /// Callbacks, in the modes `full` and `auto`.
    pub callbacks: Vec<Callback<'a>>,
    /// Last known lifecycle state of each managed node.
    pub lifecycle_states: Vec<LifecycleState<'a>>,
}

/// An observed library.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Library<'a> {
    /// Path of the library, as the processes that use it see it.
    pub path: Cow<'a, str>,
    /// Number of processes that use the library.
    pub processes: u64,
    /// Why calls of the library are not observed; null if they are observed.
    pub refused: Option<Cow<'a, str>>,
}

/// A counter of the source.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Counter<'a> {
    /// Name of the counter.
    pub name: Cow<'a, str>,
    /// Count since the agent started.
    pub count: u64,
}

/// An observed process.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Process<'a> {
    /// Process id, in the host's PID namespace.
    pub process_id: u32,
    /// Name of the process.
    pub process: Option<Cow<'a, str>>,
    /// Domain id.
    pub domain_id: u32,
    /// Known nodes of the process.
    pub nodes: Vec<Cow<'a, str>>,
    /// CPU time per second over the last window; 1 is one CPU.
    pub cpu_ratio: Option<f64>,
    /// Observed calls per second over the last window.
    pub calls_per_second: Option<f64>,
    /// Observed calls.
    pub calls: u64,
    /// Calls that were not counted because the process has too many publishers, subscriptions and
    /// callbacks.
    pub refused_calls: u64,
    /// The calls of the process exceed the budget, so the agent no longer counts them.
    pub suspended: bool,
    /// The library reports every step of intra-process messages (Iron and later).
    pub shows_intra_process: bool,
}

/// Process and node of a publisher, subscription, buffer or callback.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Owner<'a> {
    /// Process id.
    pub process_id: u32,
    /// Address of the entity in the process; it identifies the entity while the process runs.
    #[cfg_attr(feature = "openapi", schema(example = "0x5581c0de0010"))]
    pub handle: Cow<'a, str>,
    /// Domain id.
    pub domain_id: u32,
    /// Node; null when unknown.
    pub node: Option<Cow<'a, str>>,
}

/// Durations of the last 5 to 10 s. Percentiles are estimated from a histogram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Durations {
    /// Number of values.
    pub count: u64,
    /// Median.
    pub p50_seconds: f64,
    /// 99th percentile.
    pub p99_seconds: f64,
    /// Maximum. It may be only an upper bound if a value before the window was larger.
    pub maximum_seconds: f64,
}

/// A publisher.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the owner where it is declared"
)]
pub struct Publisher<'a> {
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// ROS name of the topic.
    pub topic: Cow<'a, str>,
    /// Identifier of the middleware.
    #[cfg_attr(feature = "openapi", schema(example = "rmw_fastrtps_cpp"))]
    pub middleware: Option<Cow<'a, str>>,
    /// Messages published.
    pub published_messages: u64,
    /// Published messages that were passed directly to subscriptions in the same process.
    pub within_process_messages: u64,
    /// Publications per second over the last window.
    pub rate_hertz: Option<f64>,
    /// Unix time of the last publication.
    pub last_message_timestamp_seconds: f64,
    /// Time between publications; null without a value.
    pub interval: Option<Durations>,
}

/// A subscription.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the owner where it is declared"
)]
pub struct Subscription<'a> {
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// ROS name of the topic.
    pub topic: Cow<'a, str>,
    /// Identifier of the middleware.
    pub middleware: Option<Cow<'a, str>>,
    /// Messages taken from the middleware.
    pub taken_messages: u64,
    /// Attempts to take that returned no message.
    pub failed_takes: u64,
    /// Messages taken per second over the last window.
    pub rate_hertz: Option<f64>,
    /// Unix time of the last message.
    pub last_message_timestamp_seconds: f64,
    /// Time from the source timestamp to the take; null without a value.
    pub latency: Option<Durations>,
}

/// The queue that the middleware fills for a process's subscriptions to one topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the owner where it is declared"
)]
pub struct ReaderQueue<'a> {
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// ROS name of the topic.
    pub topic: Cow<'a, str>,
    /// GUID of the only writer whose messages arrive; null if several writers send messages.
    pub writer: Option<String>,
    /// Maximum number of messages in the queue; null if the reader does not announce it.
    pub depth: Option<u64>,
    /// Messages that arrived since the agent began to observe the calls.
    pub arrived_messages: u64,
    /// Arrived messages that were taken.
    pub taken_messages: u64,
    /// Arrived messages that were dropped from the queue before they were taken.
    pub lost_messages: u64,
}

/// The buffer of a subscription for intra-process messages.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the owner where it is declared"
)]
pub struct Buffer<'a> {
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// ROS name of the topic; null until a publication shows it.
    pub topic: Option<Cow<'a, str>>,
    /// Messages put into the buffer.
    pub enqueued_messages: u64,
    /// Messages overwritten before they were taken.
    pub overwritten_messages: u64,
    /// Messages taken from the buffer.
    pub dequeued_messages: u64,
    /// Share of the messages of the last window that were overwritten.
    pub overwritten_ratio: Option<f64>,
    /// Number of messages in the buffer after the last message was added.
    pub depth: u32,
    /// Maximum number of messages in the buffer so far.
    pub maximum_depth: u32,
    /// Capacity; null if the process created the buffer before it was observed.
    pub capacity: Option<u32>,
    /// Messages put into the buffer per second over the last window.
    pub rate_hertz: Option<f64>,
    /// Unix time at which the last message was added.
    pub last_message_timestamp_seconds: f64,
    /// Time that messages spent in the buffer; null without a value.
    pub waiting: Option<Durations>,
}

/// The trigger of a callback.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Trigger<'a> {
    /// `subscription`, `intra_process`, `timer` or `service`.
    pub kind: Cow<'a, str>,
    /// Name of the topic or service; null when unknown and for timers.
    pub name: Option<Cow<'a, str>>,
    /// Period of the timer, if known.
    pub period_seconds: Option<f64>,
}

/// A callback.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the owner where it is declared"
)]
pub struct Callback<'a> {
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// Trigger of the callback.
    pub trigger: Trigger<'a>,
    /// Id of the thread that ran the last call.
    pub thread_id: u32,
    /// Completed calls.
    pub calls: u64,
    /// Timer periods in which the callback was not called.
    pub skipped_periods: u64,
    /// Calls per second over the last window.
    pub rate_hertz: Option<f64>,
    /// Share of the last window in which the callback ran.
    pub busy_ratio: Option<f64>,
    /// Unix time at which the last call ended.
    pub last_call_timestamp_seconds: f64,
    /// Duration of the calls; null without a value.
    pub duration: Option<Durations>,
    /// Time from when the callback is ready to when it starts; null without a value.
    pub wait: Option<Durations>,
    /// What the time of its calls consisted of, in seconds; null if the kernel does not show it.
    pub states_seconds: Option<ThreadStates>,
    /// The same of the last window, as shares of the duration of its calls; null without any.
    pub states_ratio: Option<ThreadStates>,
}

/// What threads did during calls, by the accounting of the kernel's scheduler. The parts add up to
/// the duration of the calls.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ThreadStates {
    /// On a CPU.
    pub cpu: f64,
    /// Able to run, but the control group had used up its CPU quota (`cpu.max`).
    pub throttled: f64,
    /// Able to run, while other threads ran instead.
    pub runnable: f64,
    /// Waiting for something else: a lock, a file, the end of a sleep.
    pub blocked: f64,
}

/// The last known lifecycle state of a managed node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LifecycleState<'a> {
    /// Process id.
    pub process_id: u32,
    /// Domain id.
    pub domain_id: u32,
    /// Node; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// Label of the state.
    #[cfg_attr(feature = "openapi", schema(example = "active"))]
    pub state: Cow<'a, str>,
    /// Label of the previous state.
    pub previous_state: Cow<'a, str>,
    /// Unix time of the transition.
    pub timestamp_seconds: f64,
}

/// Late calls of the callbacks of a topic in the last minute. `/why` has more about each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecentLateCalls<'a> {
    /// Number of late calls; counts at most the last 128 of each callback.
    pub calls: u64,
    /// Time from ready to the end of the longest one.
    pub longest_seconds: f64,
    /// The most frequent cause, as in the answer of `/why`.
    pub cause: Cow<'a, str>,
    /// That cause in words.
    pub words: Cow<'a, str>,
}

/// Data about a topic from inside processes. Counts cover all processes since the agent started.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicInside<'a> {
    /// Messages published. In Humble, intra-process messages are counted by their receptions.
    pub published_messages: u64,
    /// Published messages that were passed directly to subscriptions in the same process.
    pub within_process_messages: u64,
    /// Messages taken from the middleware, by all subscriptions.
    pub taken_messages: u64,
    /// Attempts to take that returned no message.
    pub failed_takes: u64,
    /// Messages put into intra-process buffers.
    pub enqueued_messages: u64,
    /// Messages overwritten in the buffers before they were taken.
    pub overwritten_messages: u64,
    /// Messages taken from intra-process buffers.
    pub dequeued_messages: u64,
    /// Callback calls for intra-process messages.
    pub intra_process_receptions: u64,
    /// Messages that arrived at observed processes and were dropped from the queue of a
    /// subscription before they were taken. Null if arrivals and takes cannot be compared in any
    /// process.
    pub lost_in_reader_queue_messages: Option<u64>,
    /// Messages per second over the last window.
    pub rate_hertz: f64,
    /// Unix time of the last message.
    pub last_message_timestamp_seconds: Option<f64>,
    /// Publishers in observed processes.
    pub observed_publishers: usize,
    /// Subscriptions in observed processes.
    pub observed_subscriptions: usize,
    /// Late calls of callbacks that its messages triggered, in the last minute; null without any.
    pub late: Option<RecentLateCalls<'a>>,
    /// Publishers; only in the answer about one topic.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub publishers: Vec<Publisher<'a>>,
    /// Subscriptions; only in the answer about one topic.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub subscriptions: Vec<Subscription<'a>>,
    /// Queues that the middleware fills for the subscriptions; only in the answer about one topic.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub reader_queues: Vec<ReaderQueue<'a>>,
    /// Buffers; only in the answer about one topic.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub buffers: Vec<Buffer<'a>>,
    /// Callbacks; only in the answer about one topic.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub callbacks: Vec<Callback<'a>>,
}

/// Data about a node from inside its processes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeInside<'a> {
    /// Share of the last window in which the node's callbacks ran; above 1 with several threads.
    pub busy_ratio: Option<f64>,
    /// Last known lifecycle state; null for an ordinary node and before the first transition.
    pub lifecycle_state: Option<Cow<'a, str>>,
    /// Publishers.
    pub publishers: Vec<Publisher<'a>>,
    /// Subscriptions.
    pub subscriptions: Vec<Subscription<'a>>,
    /// Queues that the middleware fills for the subscriptions.
    pub reader_queues: Vec<ReaderQueue<'a>>,
    /// Buffers.
    pub buffers: Vec<Buffer<'a>>,
    /// Callbacks.
    pub callbacks: Vec<Callback<'a>>,
}

impl Trigger<'_> {
    /// Describes the trigger in a few words, for example `/scan`, `timer 50 ms`, `service /reset`.
    #[must_use]
    pub fn words(&self) -> String {
        match (
            self.kind.as_ref(),
            self.name.as_deref(),
            self.period_seconds,
        ) {
            ("timer", _, Some(period)) => format!("timer {} ms", period * 1e3),
            ("timer", _, None) => "timer".to_owned(),
            ("service", Some(name), _) => format!("service {name}"),
            ("service", None, _) => "service".to_owned(),
            (_, Some(name), _) => name.to_owned(),
            (kind, None, _) => kind.to_owned(),
        }
    }
}
