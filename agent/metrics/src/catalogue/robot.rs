//! Metrics of what the robot itself says.

use super::Metric;

pub const LOG_MESSAGES: Metric = Metric::counter(
    "ros2_log_messages_total",
    &["domain_id", "ros_node", "level"],
    "Messages of a node's log on /rosout, each counted once; only those that were sent and seen.",
)
.experimental();
