//! Metrics of deliveries to receivers: sums per topic in any case, and series per delivery if a
//! watch requests them.

use super::{Metric, TOPIC};

/// Labels of sent samples; received series have the same, so that PromQL can subtract them across
/// hosts.
const DESTINATION: &[&str] = &["domain_id", "topic", "writer", "destination"];
const SUBSCRIBER: &[&str] = &["domain_id", "topic", "writer", "destination", "subscriber"];
const SUBSCRIBER_CAUSE: &[&str] = &[
    "domain_id",
    "topic",
    "writer",
    "destination",
    "subscriber",
    "cause",
];
const READER: &[&str] = &["domain_id", "topic", "writer", "reader", "ros_node"];

// Sums over all receivers and destinations of a topic.
pub const TOPIC_SENT: Metric = Metric::counter(
    "ros2_topic_sent_messages_total",
    TOPIC,
    "Messages seen leaving this host, once per destination.",
);
pub const TOPIC_SENT_BYTES: Metric = Metric::counter(
    "ros2_topic_sent_bytes_total",
    TOPIC,
    "Payload bytes of those messages.",
)
.unit("bytes");
pub const TOPIC_DELIVERED: Metric = Metric::counter(
    "ros2_topic_delivered_messages_total",
    TOPIC,
    "Messages that reached a subscriber on this host whole, once per subscriber: a process with a \
     reader that matches the writer.",
);
pub const TOPIC_DELIVERED_BYTES: Metric = Metric::counter(
    "ros2_topic_delivered_bytes_total",
    TOPIC,
    "Payload bytes of those messages.",
)
.unit("bytes");
pub const TOPIC_DELIVERY_LOST: Metric = Metric::counter(
    "ros2_topic_delivery_lost_messages_total",
    &["domain_id", "topic", "cause"],
    "Messages that a subscriber on this host never received, by place of loss: sender (before its \
     TCP connection), before_host, reassembly or socket_buffer; and delivered ones that a process \
     never took: reader_queue, if capture.inside observes its calls.",
);
pub const TOPIC_DELIVERY_PENDING: Metric = Metric::gauge(
    "ros2_topic_delivery_pending_messages",
    TOPIC,
    "Missing messages that may still arrive, or whose place of loss the kernel reports only after \
     up to 35 s.",
);
pub const TOPIC_DELIVERY_RECOVERED: Metric = Metric::counter(
    "ros2_topic_delivery_recovered_messages_total",
    TOPIC,
    "Delivered messages that were missing at first and were repaired by retransmission.",
);
pub const TOPIC_DELIVERY_IRRELEVANT: Metric = Metric::counter(
    "ros2_topic_delivery_irrelevant_messages_total",
    TOPIC,
    "Messages that their writer declared irrelevant (GAP) or that the reader acknowledged unseen; not losses.",
);
pub const TOPIC_DELIVERY_UNMATCHED: Metric = Metric::counter(
    "ros2_topic_delivery_unmatched_messages_total",
    TOPIC,
    "Messages that arrived at a process without a known reader that matches the writer.",
);
pub const TOPIC_LAG: Metric = Metric::gauge(
    "ros2_topic_acknowledgement_lag_messages",
    TOPIC,
    "Messages that the slowest reliable reader has not acknowledged; some writers rarely request \
     acknowledgements while none is missing.",
);
pub const TOPIC_LAG_SECONDS: Metric = Metric::gauge(
    "ros2_topic_acknowledgement_lag_seconds",
    TOPIC,
    "Age of the oldest message that a reliable reader has not acknowledged; infinite beyond the \
     agent's history.",
)
.unit("seconds");
pub const TOPIC_SEND_DELAY: Metric = Metric::histogram(
    "ros2_topic_send_delay_seconds",
    TOPIC,
    "Time from the writer's timestamp to the message's first datagram leaving this host.",
)
.unit("seconds");
pub const TOPIC_TRANSIT: Metric = Metric::histogram(
    "ros2_topic_transit_seconds",
    TOPIC,
    "Time from sending to arrival, last datagram to last datagram, if both are on this host; one \
     value per receiver.",
)
.unit("seconds");
pub const TOPIC_TRANSFER: Metric = Metric::histogram(
    "ros2_topic_transfer_seconds",
    TOPIC,
    "Time from the first to the last datagram of a message of several datagrams.",
)
.unit("seconds");
pub const TOPIC_RETRANSMISSION: Metric = Metric::histogram(
    "ros2_topic_retransmission_delay_seconds",
    TOPIC,
    "Time from the detection of a missing message to its arrival by retransmission; one value \
     per receiver.",
)
.unit("seconds");

// Deliveries, on request.
pub const WRITER_SENT: Metric = Metric::counter(
    "ros2_writer_sent_messages_total",
    DESTINATION,
    "Messages of a writer seen leaving this host, by destination.",
)
.experimental();
pub const WRITER_SENT_BYTES: Metric = Metric::counter(
    "ros2_writer_sent_bytes_total",
    DESTINATION,
    "Payload bytes of those messages.",
)
.unit("bytes")
.experimental();
pub const SUBSCRIBER_INFO: Metric = Metric::info(
    "ros2_subscriber_info",
    &[
        "domain_id",
        "topic",
        "destination",
        "subscriber",
        "ros_node",
        "participant",
        "process",
        "pid",
        "cgroup",
    ],
    "Receivers: nodes with readers of the topic, participant, and process and control group of \
     the socket if known.",
)
.experimental();
pub const SUBSCRIBER_RECEIVED: Metric = Metric::counter(
    "ros2_subscriber_received_messages_total",
    SUBSCRIBER,
    "Messages of a writer that reached this receiver whole.",
)
.experimental();
pub const SUBSCRIBER_RECEIVED_BYTES: Metric = Metric::counter(
    "ros2_subscriber_received_bytes_total",
    SUBSCRIBER,
    "Payload bytes of those messages.",
)
.unit("bytes")
.experimental();
pub const SUBSCRIBER_LOST: Metric = Metric::counter(
    "ros2_subscriber_lost_messages_total",
    SUBSCRIBER_CAUSE,
    "Messages of a writer that this receiver never received, by place of loss.",
)
.experimental();
pub const SUBSCRIBER_PENDING: Metric = Metric::gauge(
    "ros2_subscriber_pending_messages",
    SUBSCRIBER,
    "Missing messages that may still arrive, or whose place of loss is not known yet.",
)
.experimental();
pub const SUBSCRIBER_RECOVERED: Metric = Metric::counter(
    "ros2_subscriber_recovered_messages_total",
    SUBSCRIBER,
    "Received messages that were retransmitted.",
)
.experimental();
pub const SUBSCRIBER_RECOVERY_SECONDS: Metric = Metric::counter(
    "ros2_subscriber_recovery_seconds_total",
    SUBSCRIBER,
    "Total time for which those messages were missing.",
)
.unit("seconds")
.experimental();
pub const SUBSCRIBER_IRRELEVANT: Metric = Metric::counter(
    "ros2_subscriber_irrelevant_messages_total",
    SUBSCRIBER,
    "Messages that the writer declared irrelevant (GAP), or that the reader acknowledged unseen.",
)
.experimental();
pub const SUBSCRIBER_UNMATCHED: Metric = Metric::counter(
    "ros2_subscriber_unmatched_messages_total",
    SUBSCRIBER,
    "Messages that arrived without a known reader that matches the writer; not counted as received.",
)
.experimental();
pub const READER_LAG: Metric = Metric::gauge(
    "ros2_reader_acknowledgement_lag_messages",
    READER,
    "Messages that this reliable reader has not acknowledged.",
)
.experimental();
pub const READER_LAG_SECONDS: Metric = Metric::gauge(
    "ros2_reader_acknowledgement_lag_seconds",
    READER,
    "Age of the oldest of those messages; infinite beyond the agent's history.",
)
.unit("seconds")
.experimental();
pub const READER_MISSING: Metric = Metric::gauge(
    "ros2_reader_missing_messages",
    READER,
    "Messages that the reader requested in its last ACKNACK.",
)
.experimental();
pub const READER_REQUESTED: Metric = Metric::counter(
    "ros2_reader_requested_messages_total",
    READER,
    "Messages that the reader requested again, every request counted.",
)
.experimental();
pub const SOCKET_DROPS: Metric = Metric::counter(
    "ros2_socket_unidentified_drops_total",
    &["socket", "process", "pid", "cgroup"],
    "Datagrams of unknown content dropped by a full socket buffer; for the first 64 sockets with \
     any.",
)
.experimental();
