//! rclpy's objects in answers: endpoints of topics, services and actions with their QoS.
//!
//! A client knows only the classes of its own distribution. Humble refuses a type hash and has GIDs
//! of 24 bytes, and Lyrical renamed the module of the classes.

use ros2probe_message::Dialect;
use ros2probe_model::report::snapshot::EndpointFacts;
use ros2probe_wire::RtpsDuration;
use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::qos::{Durability, HistoryKind, Liveliness, Qos, Reliability};

use super::graph::{ActionEnds, Graph, ServiceEnds, Side, parts, service_type};
use super::value::Value;

/// Bytes of a GID in Humble; a GUID has 16.
const LONG_GID: usize = 24;
/// Namespace and name that rmw returns for an endpoint whose participant has not announced its
/// nodes yet.
const UNKNOWN_NODE: (&str, &str) = ("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_");
/// Namespace and name that rmw returns for an endpoint of a participant without ROS.
const BARE_DDS_NODE: (&str, &str) = ("_CREATED_BY_BARE_DDS_APP_", "_CREATED_BY_BARE_DDS_APP_");

/// rclpy's `EndpointTypeEnum`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum EndpointType {
    Publisher,
    Subscription,
    Client,
    Server,
}

/// Creates objects of the classes of a distribution.
#[derive(Clone, Copy, Debug)]
pub(super) struct Classes<'a> {
    pub(super) graph: Graph<'a>,
    pub(super) dialect: Dialect,
}

impl Classes<'_> {
    /// Returns the object for a writer or reader of a topic.
    pub(super) fn topic(self, endpoint: &EndpointFacts, kind: EndpointType) -> Value {
        let (namespace, name) = self.node(endpoint);
        let mut members = vec![
            ("node_name", Value::text(name)),
            ("node_namespace", Value::text(namespace)),
            ("topic_type", Value::text(&endpoint.message_type)),
        ];
        if self.dialect > Dialect::Humble {
            members.push(("topic_type_hash", type_hash(endpoint.type_hash)));
        }
        members.extend([
            ("endpoint_type", self.kind(kind)),
            ("endpoint_gid", self.gid(endpoint)),
            ("qos_profile", qos_profile(&endpoint.qos)),
        ]);
        let class = match self.dialect {
            Dialect::Rolling => "rclpy.endpoint_info.TopicEndpointInfo",
            _ => "rclpy.topic_endpoint_info.TopicEndpointInfo",
        };
        Value::Object(class, members)
    }

    /// Returns the object for a server or client of a service.
    pub(super) fn service(self, ends: ServiceEnds<'_>, side: Side) -> Value {
        let (namespace, name) = self.node(ends.reader);
        // The endpoint of requests comes first.
        let (kind, both) = match side {
            Side::Server => (EndpointType::Server, [ends.reader, ends.writer]),
            Side::Client => (EndpointType::Client, [ends.writer, ends.reader]),
        };
        // rmw_zenoh has one endpoint for both directions.
        let count = match ends.reader.guid.prefix.is_zenoh() {
            true => 1,
            false => both.len(),
        };
        let endpoints = || both.into_iter().take(count);
        let members = vec![
            ("node_name", Value::text(name)),
            ("node_namespace", Value::text(namespace)),
            (
                "service_type",
                Value::text(service_type(&ends.reader.message_type)),
            ),
            ("service_type_hash", type_hash(ends.reader.type_hash)),
            (
                "qos_profiles",
                Value::array(endpoints().map(|endpoint| qos_profile(&endpoint.qos))),
            ),
            (
                "endpoint_gids",
                Value::array(endpoints().map(|endpoint| self.gid(endpoint))),
            ),
            ("endpoint_type", self.kind(kind)),
            ("endpoint_count", Value::count(count)),
        ];
        Value::Object("rclpy.endpoint_info.ServiceEndpointInfo", members)
    }

    /// Returns the object for a server or client of an action.
    pub(super) fn action(self, ends: ActionEnds<'_>, side: Side) -> Value {
        let kind = match side {
            Side::Server => EndpointType::Publisher,
            Side::Client => EndpointType::Subscription,
        };
        let members = vec![
            ("goal_service_info", self.service(ends.goal, side)),
            ("cancel_service_info", self.service(ends.cancel, side)),
            ("result_service_info", self.service(ends.result, side)),
            ("feedback_topic_info", self.topic(ends.feedback, kind)),
            ("status_topic_info", self.topic(ends.status, kind)),
        ];
        Value::Object("rclpy.endpoint_info.ActionEndpointInfo", members)
    }

    /// Returns the namespace and the name of the endpoint's node.
    fn node(self, endpoint: &EndpointFacts) -> (&str, &str) {
        match (&endpoint.node, self.graph.enclave(endpoint.guid.prefix)) {
            (Some(node), _) => parts(node),
            (None, Some(_)) => UNKNOWN_NODE,
            (None, None) => BARE_DDS_NODE,
        }
    }

    fn kind(self, kind: EndpointType) -> Value {
        let class = match self.dialect {
            Dialect::Rolling => "rclpy.endpoint_info.EndpointTypeEnum",
            _ => "rclpy.topic_endpoint_info.TopicEndpointTypeEnum",
        };
        let number = match kind {
            EndpointType::Publisher => 1,
            EndpointType::Subscription => 2,
            EndpointType::Client => 3,
            EndpointType::Server => 4,
        };
        Value::Number(class, number)
    }

    fn gid(self, endpoint: &EndpointFacts) -> Value {
        let mut bytes = endpoint.gid.to_vec();
        if self.dialect == Dialect::Humble {
            bytes.resize(LONG_GID, 0);
        }
        Value::array(bytes.into_iter().map(|byte| Value::Integer(byte.into())))
    }
}

/// Returns the object for a type hash. Version 0 is "unknown", which a client prints as `INVALID`.
fn type_hash(hash: Option<TypeHash>) -> Value {
    let (version, bytes) = hash.map_or((0, [0; 32]), |hash| (1, hash.0));
    let members = vec![
        ("version", Value::Integer(version)),
        ("value", Value::Bytes(bytes.to_vec())),
    ];
    Value::Object("rclpy.type_hash.TypeHash", members)
}

fn qos_profile(qos: &Qos) -> Value {
    let (history, depth) = history(qos);
    let members = vec![
        ("history", Value::Number("rclpy.qos.HistoryPolicy", history)),
        ("depth", Value::Integer(depth)),
        (
            "reliability",
            Value::Number("rclpy.qos.ReliabilityPolicy", reliability(qos)),
        ),
        (
            "durability",
            Value::Number("rclpy.qos.DurabilityPolicy", durability(qos)),
        ),
        ("lifespan", duration(qos.lifespan)),
        ("deadline", duration(qos.deadline)),
        (
            "liveliness",
            Value::Number("rclpy.qos.LivelinessPolicy", liveliness(qos)),
        ),
        ("liveliness_lease_duration", duration(qos.liveliness_lease)),
        ("avoid_ros_namespace_conventions", Value::Boolean(false)),
    ];
    Value::Object("rclpy.qos.QoSProfile", members)
}

/// Returns rclpy's history policy and depth. Fast DDS before 3.2 does not announce them.
fn history(qos: &Qos) -> (i64, i32) {
    match qos.history {
        Some(history) if history.kind == HistoryKind::KEEP_LAST => (1, history.depth),
        Some(history) if history.kind == HistoryKind::KEEP_ALL => (2, 0),
        _ => (3, 0),
    }
}

const fn reliability(qos: &Qos) -> i64 {
    match qos.reliability {
        Reliability::RELIABLE => 1,
        Reliability::BEST_EFFORT => 2,
        _ => 3,
    }
}

const fn durability(qos: &Qos) -> i64 {
    match qos.durability {
        Durability::TRANSIENT_LOCAL => 1,
        Durability::VOLATILE => 2,
        _ => 3,
    }
}

const fn liveliness(qos: &Qos) -> i64 {
    match qos.liveliness {
        Liveliness::AUTOMATIC => 1,
        Liveliness::MANUAL_BY_TOPIC => 3,
        _ => 4,
    }
}

/// Returns the object for a duration in nanoseconds. The maximum number is infinite.
fn duration(duration: RtpsDuration) -> Value {
    let nanoseconds = match duration {
        RtpsDuration::Finite(finite) => i64::try_from(finite.as_nanos()).unwrap_or(i64::MAX),
        RtpsDuration::Infinite => i64::MAX,
    };
    Value::Number("rclpy.duration.Duration", nanoseconds)
}
