//! Metrics of services and actions: calls, replies, goals, and their times.

use super::Metric;

const SERVICE: &[&str] = &["domain_id", "ros_service"];
const ACTION: &[&str] = &["domain_id", "ros_action"];

pub const SERVICE_REQUESTS: Metric = Metric::counter(
    "ros2_service_requests_total",
    SERVICE,
    "Requests, each counted once regardless of copies and servers.",
);
pub const SERVICE_ANSWERED: Metric = Metric::counter(
    "ros2_service_answered_requests_total",
    SERVICE,
    "Requests with a reply that reached the client, as far as the source shows that.",
);
pub const SERVICE_UNANSWERED: Metric = Metric::counter(
    "ros2_service_unanswered_requests_total",
    SERVICE,
    "Requests without a reply within service_timeout_s; some may have been answered later.",
);
pub const SERVICE_HANGING: Metric = Metric::gauge(
    "ros2_service_hanging_requests",
    SERVICE,
    "Requests that have had no reply for longer than service_timeout_s.",
);
pub const SERVICE_LATENCY: Metric = Metric::histogram(
    "ros2_service_latency_seconds",
    SERVICE,
    "Time from a request to its reply, at the client's socket if that is on this host.",
)
.unit("seconds");
pub const SERVICE_P50: Metric = Metric::gauge(
    "ros2_service_latency_p50_seconds",
    SERVICE,
    "Median of the latest 1024 times from a request to its reply.",
)
.unit("seconds");
pub const SERVICE_P99: Metric = Metric::gauge(
    "ros2_service_latency_p99_seconds",
    SERVICE,
    "99th percentile of the latest 1024 times from a request to its reply.",
)
.unit("seconds");
pub const SERVICE_SUSPENDED: Metric = Metric::gauge(
    "ros2_service_suspended",
    SERVICE,
    "1 while the calls of a service are not measured because its messages exceed 4 MiB/s.",
);
pub const ACTION_GOALS: Metric = Metric::counter(
    "ros2_action_goals_total",
    &["domain_id", "ros_action", "state"],
    "Goals accepted or rejected, and results that clients received: succeeded, canceled, aborted.",
);
pub const ACTION_OPEN: Metric = Metric::gauge(
    "ros2_action_open_goals",
    ACTION,
    "Accepted goals whose result no client has received so far.",
);
pub const ACTION_P50: Metric = Metric::gauge(
    "ros2_action_goal_duration_p50_seconds",
    ACTION,
    "Median of the latest 1024 times from a goal's request to its result.",
)
.unit("seconds");
pub const ACTION_P99: Metric = Metric::gauge(
    "ros2_action_goal_duration_p99_seconds",
    ACTION,
    "99th percentile of the latest 1024 times from a goal's request to its result.",
)
.unit("seconds");
