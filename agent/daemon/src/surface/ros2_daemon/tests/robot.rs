//! A robot with a talker, a server of a service and of an action, and their clients.

use std::sync::Arc;

use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{
    EndpointFacts, NodeFacts, ParticipantFacts, Snapshot, TopicFacts,
};
use ros2probe_testing::sample_robot;
use ros2probe_wire::qos::{Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix};

/// GUID prefix of the participant in the answer of a real daemon.
const PREFIX: GuidPrefix = GuidPrefix([1, 15, 127, 1, 235, 111, 70, 136, 0, 0, 0, 0]);

/// Endpoints of a topic: entity and node.
type Ends = &'static [([u8; 4], Option<&'static str>)];

fn endpoint(
    (entity, node): ([u8; 4], Option<&str>),
    message_type: &str,
    role: Role,
) -> EndpointFacts {
    EndpointFacts {
        guid: Guid::new(PREFIX, EntityId(entity)),
        gid: Guid::new(PREFIX, EntityId(entity)).to_bytes(),
        node: node.map(Into::into),
        qos: Arc::new(Qos {
            reliability: Reliability::RELIABLE,
            ..Qos::defaults(role, VendorId::EPROSIMA)
        }),
        message_type: message_type.into(),
        type_hash: None,
        equivalence_hash: None,
        first_seen: ModelTime::ZERO,
        measurement: None,
        transports: 0,
        latched: None,
        backends: None,
        buffers: Box::default(),
    }
}

fn topic(name: &str, kind: TopicKind, message_type: &str, ends: [Ends; 2]) -> TopicFacts {
    let [publishers, subscriptions] = ends;
    let all = |ends: Ends, role| {
        ends.iter()
            .map(|end| endpoint(*end, message_type, role))
            .collect()
    };
    let mut snapshot = sample_robot::snapshot([name]);
    let mut topic = snapshot.topics.pop().unwrap();
    topic.kind = kind;
    topic.name = name.into();
    topic.message_types = vec![message_type.into()];
    topic.type_hashes = Vec::new();
    topic.publishers = all(publishers, Role::Writer);
    topic.subscriptions = all(subscriptions, Role::Reader);
    topic
}

/// Returns the robot.
pub(super) fn robot() -> Snapshot {
    use TopicKind::{ActionFeedback, ActionStatus, ServiceReply, ServiceRequest, Topic};
    const SERVER: &str = "/robot1/server";
    const CLIENT: &str = "/client";
    const STRING: &str = "std_msgs/msg/String";
    let fib = |part: &str| format!("/fib/_action/{part}");
    let mut topics = vec![
        topic(
            "/chatter",
            Topic,
            STRING,
            [&[([0, 0, 18, 3], Some("/talker"))], &[]],
        ),
        topic("/bare", Topic, STRING, [&[([0, 0, 19, 3], None)], &[]]),
        topic("/gone", Topic, STRING, [&[], &[]]),
        topic(
            &fib("feedback"),
            ActionFeedback,
            "a/action/Fib_FeedbackMessage",
            [
                &[([0, 0, 30, 3], Some(SERVER))],
                &[([0, 0, 30, 4], Some(CLIENT))],
            ],
        ),
        topic(
            &fib("status"),
            ActionStatus,
            "action_msgs/msg/GoalStatusArray",
            [
                &[([0, 0, 31, 3], Some(SERVER))],
                &[([0, 0, 31, 4], Some(CLIENT))],
            ],
        ),
    ];
    let services: [(&str, &str, [Ends; 4]); 4] = [
        (
            "/add",
            "a/srv/Add",
            [
                &[([0, 0, 40, 3], Some(CLIENT))],
                &[([0, 0, 40, 4], Some(SERVER))],
                &[([0, 0, 41, 3], Some(SERVER))],
                &[([0, 0, 41, 4], Some(CLIENT))],
            ],
        ),
        (
            "/fib/_action/send_goal",
            "a/action/Fib_SendGoal",
            [
                &[([0, 0, 50, 3], Some(CLIENT))],
                &[([0, 0, 50, 4], Some(SERVER))],
                &[([0, 0, 51, 3], Some(SERVER))],
                &[([0, 0, 51, 4], Some(CLIENT))],
            ],
        ),
        (
            "/fib/_action/cancel_goal",
            "action_msgs/srv/CancelGoal",
            [
                &[([0, 0, 52, 3], Some(CLIENT))],
                &[([0, 0, 52, 4], Some(SERVER))],
                &[([0, 0, 53, 3], Some(SERVER))],
                &[([0, 0, 53, 4], Some(CLIENT))],
            ],
        ),
        (
            "/fib/_action/get_result",
            "a/action/Fib_GetResult",
            [
                &[([0, 0, 54, 3], Some(CLIENT))],
                &[([0, 0, 54, 4], Some(SERVER))],
                &[([0, 0, 55, 3], Some(SERVER))],
                &[([0, 0, 55, 4], Some(CLIENT))],
            ],
        ),
    ];
    for (name, kind, [asks, asked, replies, replied]) in services {
        let (request, response) = (format!("{kind}_Request"), format!("{kind}_Response"));
        topics.push(topic(name, ServiceRequest, &request, [asks, asked]));
        topics.push(topic(name, ServiceReply, &response, [replies, replied]));
    }
    let mut snapshot = sample_robot::snapshot([]);
    let participant = Guid::new(PREFIX, EntityId::PARTICIPANT);
    snapshot.participants = vec![ParticipantFacts {
        guid: participant,
        ..snapshot.participants[0].clone()
    }];
    snapshot.nodes = nodes(participant, &topics);
    snapshot.topics = topics;
    snapshot
}

/// Returns the nodes with their endpoints. Two nodes have the name `/talker`.
fn nodes(participant: Guid, topics: &[TopicFacts]) -> Vec<NodeFacts> {
    let names = ["/client", "/robot1/server", "/talker", "/talker"];
    let nodes = names.map(|name| {
        let own = |ends: &[EndpointFacts]| -> Vec<Guid> {
            let own = ends.iter().filter(|end| end.node.as_deref() == Some(name));
            own.map(|end| end.guid).collect()
        };
        NodeFacts {
            domain_id: DomainId(0),
            name: name.into(),
            participant,
            writers: topics
                .iter()
                .flat_map(|topic| own(&topic.publishers))
                .collect(),
            readers: topics
                .iter()
                .flat_map(|topic| own(&topic.subscriptions))
                .collect(),
        }
    });
    nodes.into()
}
