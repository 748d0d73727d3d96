//! Metrics of links: the TCP connections that carry RTPS or Zenoh to another host.

use super::Metric;

const LINK: &[&str] = &["protocol", "source", "destination"];

pub const LINK_CONNECTIONS: Metric = Metric::gauge(
    "ros2_link_connections",
    LINK,
    "TCP connections from an address of this host to another host.",
)
.experimental();
pub const LINK_ROUND_TRIP: Metric = Metric::gauge(
    "ros2_link_round_trip_seconds",
    LINK,
    "Smoothed round trip time of TCP, the longest of the connections.",
)
.unit("seconds")
.experimental();
pub const LINK_SENT: Metric = Metric::counter(
    "ros2_link_sent_segments_total",
    LINK,
    "TCP segments with data that this host sent, retransmitted ones included.",
)
.experimental();
pub const LINK_RETRANSMITTED: Metric = Metric::counter(
    "ros2_link_retransmitted_segments_total",
    LINK,
    "TCP segments that this host sent again.",
)
.experimental();
pub const LINK_UNACKNOWLEDGED: Metric = Metric::gauge(
    "ros2_link_unacknowledged_bytes",
    LINK,
    "Bytes that were sent and are not acknowledged.",
)
.unit("bytes")
.experimental();
pub const LINK_UNSENT: Metric = Metric::gauge(
    "ros2_link_unsent_bytes",
    LINK,
    "Bytes that were written and that the kernel has not sent yet.",
)
.unit("bytes")
.experimental();
