//! Metrics of what the robot itself says.

use super::Metric;

pub const CLOCK_OFFSET: Metric = Metric::gauge(
    "ros2_clock_offset_seconds",
    &["host", "peer"],
    "Time by which the peer's clock is ahead of the host's; absent without evidence for both bounds.",
)
.unit("seconds")
.experimental();
pub const CLOCK_UNCERTAINTY: Metric = Metric::gauge(
    "ros2_clock_offset_uncertainty_seconds",
    &["host", "peer"],
    "Distance from ros2_clock_offset_seconds to the bounds of the offset.",
)
.unit("seconds")
.experimental();
pub const CLOCK_STEPS: Metric = Metric::counter(
    "ros2_clock_steps_total",
    &["peer"],
    "Steps of a peer's clock, and contradictions in the evidence; both reset the bounds.",
)
.experimental();
pub const LOG_MESSAGES: Metric = Metric::counter(
    "ros2_log_messages_total",
    &["domain_id", "ros_node", "level"],
    "Messages of a node's log on /rosout, each counted once; only those that were sent and seen.",
)
.experimental();
