//! Metrics of problems in the graph: a series exists as long as its problem.

use super::{Metric, TOPIC};

pub const DIAGNOSES: Metric = Metric::gauge(
    "ros2_diagnoses",
    &["kind"],
    "Findings about the graph by kind, 0 included; /topics lists them.",
);
pub const QOS_INCOMPATIBLE_PAIRS: Metric = Metric::gauge(
    "ros2_qos_incompatible_pairs",
    &["domain_id", "topic", "policy"],
    "Pairs of publisher and subscriber that cannot communicate because of this policy.",
);
pub const TOPIC_CONFLICTING_TYPES: Metric = Metric::gauge(
    "ros2_topic_conflicting_types",
    TOPIC,
    "Types of a topic that has several: endpoints of different types cannot communicate.",
);
pub const TOPIC_CONFLICTING_TYPE_HASHES: Metric = Metric::gauge(
    "ros2_topic_conflicting_type_hashes",
    TOPIC,
    "Definitions of one type on a topic that has several: its nodes misread each other.",
);
pub const UNHEARD_PUBLISHERS: Metric = Metric::gauge(
    "ros2_topic_unmatched_publishers",
    TOPIC,
    "Publishers without a matching subscriber for 5 s, except on /rosout and similar topics.",
);
pub const UNFED_SUBSCRIPTIONS: Metric = Metric::gauge(
    "ros2_topic_unmatched_subscriptions",
    TOPIC,
    "Subscriptions without a matching publisher for 5 s, except on /rosout and similar topics.",
);
pub const DUPLICATE_NODES: Metric = Metric::gauge(
    "ros2_duplicate_nodes",
    &["domain_id", "ros_node"],
    "Nodes that share one name in one domain.",
);
pub const NODE_DOMAINS: Metric = Metric::gauge(
    "ros2_node_domains",
    &["ros_node", "participant"],
    "Domains of a node that is in several on one machine.",
);
