//! Metrics of calls inside processes (`capture.inside`): topics, callbacks and nodes.

use super::{Metric, TOPIC};

const CALLBACK: &[&str] = &["domain_id", "ros_node", "trigger", "name"];
const CALLBACK_STATE: &[&str] = &["domain_id", "ros_node", "trigger", "name", "state"];
const CALLBACK_CAUSE: &[&str] = &["domain_id", "ros_node", "trigger", "name", "stage", "cause"];

pub const TOPIC_SOURCE: Metric = Metric::info(
    "ros2_topic_source_info",
    &["domain_id", "topic", "source"],
    "Where a topic's messages and rate come from, with capture.inside: wire, or inside where the \
     wire shows nothing.",
)
.experimental();
pub const INSIDE_PUBLISHED: Metric = Metric::counter(
    "ros2_topic_inside_published_messages_total",
    TOPIC,
    "Messages published in observed processes. In Humble, messages within a process count by \
     their receptions.",
)
.experimental();
pub const INSIDE_TAKEN: Metric = Metric::counter(
    "ros2_topic_inside_taken_messages_total",
    TOPIC,
    "Messages that subscriptions of observed processes took from the middleware.",
)
.experimental();
pub const INSIDE_FAILED: Metric = Metric::counter(
    "ros2_topic_inside_failed_takes_total",
    TOPIC,
    "Attempts to take a message that returned none.",
)
.experimental();
pub const INSIDE_LATENCY: Metric = Metric::histogram(
    "ros2_topic_inside_take_latency_seconds",
    TOPIC,
    "Time from the writer's timestamp to the take, one value per subscription; across hosts it \
     requires synchronised clocks.",
)
.unit("seconds")
.experimental();
pub const INTRA_RECEIVED: Metric = Metric::counter(
    "ros2_intra_process_received_messages_total",
    TOPIC,
    "Calls of callbacks for messages of the same process.",
)
.experimental();
pub const INTRA_ENQUEUED: Metric = Metric::counter(
    "ros2_intra_process_enqueued_messages_total",
    TOPIC,
    "Messages put into the buffers of subscriptions in the same process.",
)
.experimental();
pub const INTRA_OVERWRITTEN: Metric = Metric::counter(
    "ros2_intra_process_overwritten_messages_total",
    TOPIC,
    "Messages overwritten in these buffers before they were taken: lost.",
)
.experimental();
pub const INTRA_DEQUEUED: Metric = Metric::counter(
    "ros2_intra_process_dequeued_messages_total",
    TOPIC,
    "Messages taken from these buffers.",
)
.experimental();
pub const INTRA_DEPTH: Metric = Metric::gauge(
    "ros2_intra_process_buffered_messages",
    TOPIC,
    "Messages in these buffers after the last entry.",
)
.experimental();
pub const INTRA_WAITING: Metric = Metric::histogram(
    "ros2_intra_process_buffer_seconds",
    TOPIC,
    "Time that messages spent in these buffers.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_DURATION: Metric = Metric::histogram(
    "ros2_callback_duration_seconds",
    CALLBACK,
    "Duration of calls. The name is the topic, the service or the timer's period.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_P99: Metric = Metric::gauge(
    "ros2_callback_duration_p99_seconds",
    CALLBACK,
    "99th percentile of the duration of calls in the last 5 to 10 s.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_MAX: Metric = Metric::gauge(
    "ros2_callback_duration_max_seconds",
    CALLBACK,
    "Longest call in the last 5 to 10 s.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_WAIT: Metric = Metric::histogram(
    "ros2_callback_wait_seconds",
    CALLBACK,
    "Time from being ready to the start of a call.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_WAIT_P99: Metric = Metric::gauge(
    "ros2_callback_wait_p99_seconds",
    CALLBACK,
    "99th percentile of that time in the last 5 to 10 s.",
)
.unit("seconds")
.experimental();
pub const CALLBACK_BUSY: Metric = Metric::gauge(
    "ros2_callback_busy_ratio",
    CALLBACK,
    "Share of the last 5 to 10 s that calls took.",
)
.unit("ratio")
.experimental();
pub const CALLBACK_TIME: Metric = Metric::counter(
    "ros2_callback_time_seconds_total",
    CALLBACK_STATE,
    "Time of completed calls by the state of their thread: on a CPU, able to run but throttled by the \
     CPU quota of its control group, able to run while others ran, or blocked.",
)
.unit("seconds")
.experimental();
pub const LATE_TIME: Metric = Metric::counter(
    "ros2_late_seconds_total",
    CALLBACK_CAUSE,
    "Time of late calls by stage and cause: where their messages were, and what the threads did.",
)
.unit("seconds")
.experimental();
pub const LATE_CALLS: Metric = Metric::counter(
    "ros2_late_calls_total",
    CALLBACK_CAUSE,
    "Late calls by the stage and the cause that made them late.",
)
.experimental();
pub const TIMER_SKIPPED: Metric = Metric::counter(
    "ros2_timer_skipped_periods_total",
    CALLBACK,
    "Periods in which a timer was not called.",
)
.experimental();
pub const NODE_BUSY: Metric = Metric::gauge(
    "ros2_node_callback_busy_ratio",
    &["domain_id", "ros_node"],
    "Share of the last 5 to 10 s that calls of a node's callbacks took; above 1 with several \
     threads.",
)
.unit("ratio")
.experimental();
pub const NODE_LIFECYCLE: Metric = Metric::gauge(
    "ros2_node_lifecycle_state",
    &["domain_id", "ros_node", "state"],
    "1 for the state of a managed node after its last transition.",
)
.experimental();
pub const INSIDE_INFO: Metric = Metric::info(
    "ros2probe_inside_info",
    &["mode", "reason"],
    "With capture.inside: the mode, and why nothing is observed.",
)
.experimental();
pub const INSIDE_LIBRARY: Metric = Metric::info(
    "ros2probe_inside_library_info",
    &["library", "state", "reason"],
    "With capture.inside: libraries in use, attached or refused with the reason.",
)
.experimental();
pub const INSIDE_EVENTS: Metric = Metric::counter(
    "ros2probe_inside_events_total",
    &["event"],
    "Calls seen inside processes, and calls and names that were not counted, by reason.",
)
.experimental();
pub const INSIDE_PROCESSES: Metric = Metric::gauge(
    "ros2probe_inside_processes",
    &["state"],
    "Observed processes: counted, or suspended because their calls exceed the budget.",
)
.experimental();
pub const CALLBACKS_NOT_SHOWN: Metric = Metric::gauge(
    "ros2probe_callbacks_not_shown",
    &[],
    "Callbacks without series because there are too many.",
)
.experimental();
