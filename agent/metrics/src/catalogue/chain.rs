//! Metrics of chains: the latency of chains and of their hops.

use super::Metric;

const CHAIN: &[&str] = &["domain_id", "from", "to", "method"];
const HOP: &[&str] = &["domain_id", "from", "to", "method", "topic", "ros_node"];

pub const CHAIN_LATENCY: Metric = Metric::histogram(
    "ros2_chain_latency_seconds",
    CHAIN,
    "Time from the publication on the first topic of a chain to that on the last one.",
)
.unit("seconds")
.experimental();
pub const CHAIN_P50: Metric = Metric::gauge(
    "ros2_chain_latency_p50_seconds",
    CHAIN,
    "Median of the latest 256 times from the first publication of a chain to the last.",
)
.unit("seconds")
.experimental();
pub const CHAIN_P99: Metric = Metric::gauge(
    "ros2_chain_latency_p99_seconds",
    CHAIN,
    "99th percentile of the latest 256 times from the first publication of a chain to the last.",
)
.unit("seconds")
.experimental();
pub const CHAIN_STATE: Metric = Metric::gauge(
    "ros2_chain_state",
    &["domain_id", "from", "to", "state"],
    "1 for the state of a configured chain: idle, ok or slow.",
)
.experimental();
pub const HOP_LATENCY: Metric = Metric::histogram(
    "ros2_chain_hop_latency_seconds",
    HOP,
    "Time from the publication of a node's input to that of its output on this topic.",
)
.unit("seconds")
.experimental();
pub const HOP_P50: Metric = Metric::gauge(
    "ros2_chain_hop_latency_p50_seconds",
    HOP,
    "Median of the latest 256 times of a hop.",
)
.unit("seconds")
.experimental();
pub const HOP_P99: Metric = Metric::gauge(
    "ros2_chain_hop_latency_p99_seconds",
    HOP,
    "99th percentile of the latest 256 times of a hop.",
)
.unit("seconds")
.experimental();
