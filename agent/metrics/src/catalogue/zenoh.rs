//! Metrics of Zenoh: connections, and the parts of them that cannot be read.

use super::Metric;

pub const ZENOH_CONNECTIONS: Metric = Metric::gauge(
    "ros2probe_zenoh_connections",
    &[],
    "TCP connections of Zenoh that are followed, each counted once.",
)
.experimental();
pub const ZENOH_ROUTERS: Metric = Metric::gauge(
    "ros2probe_zenoh_routers",
    &[],
    "Zenoh routers with a connection whose beginning was seen.",
)
.experimental();
pub const ZENOH_BATCHES: Metric = Metric::counter(
    "ros2probe_zenoh_batches_total",
    &[],
    "Batches of Zenoh read; a batch has one message or several.",
)
.experimental();
pub const ZENOH_GAPS: Metric = Metric::counter(
    "ros2probe_zenoh_gaps_total",
    &[],
    "Times that bytes of a connection of Zenoh were not captured.",
)
.experimental();
pub const ZENOH_FOREIGN: Metric = Metric::counter(
    "ros2probe_zenoh_foreign_messages_total",
    &[],
    "Messages on topics of ROS without the attachment of rmw_zenoh; they count for no topic.",
)
.experimental();
pub const ZENOH_INCOMPLETE: Metric = Metric::counter(
    "ros2probe_zenoh_incomplete_messages_total",
    &[],
    "Messages of Zenoh of which some FRAGMENTs were missing or withdrawn.",
)
.experimental();
pub const ZENOH_UNSEEN: Metric = Metric::gauge(
    "ros2probe_zenoh_unseen_connections",
    &["reason"],
    "Connections of Zenoh that cannot be read; for shared_memory, only their payloads cannot.",
)
.experimental();
