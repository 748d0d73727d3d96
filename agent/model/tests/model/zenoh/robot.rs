//! What the robot itself says, over Zenoh.

use super::*;
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_log::{self, log};
use ros2probe_testing::robot_parameters::{self, event};
use ros2probe_testing::robot_states::{self, transition};
use ros2probe_testing::robot_transforms::{self, Transform, transforms};
use ros2probe_wire::lifecycle::LifecycleState;

/// Declares a publisher of the node `/talker`, and sends these messages with it.
fn say(observer: &mut Observer, entity: u32, topic: &str, dds_type: &str, payloads: &[Vec<u8>]) {
    let string = "std_msgs::msg::dds_::String_";
    let token = publisher(TALKER, entity, topic).replace(string, dds_type);
    let key = KEY.replace("chatter", topic.trim_start_matches('/'));
    let key = key.replace(string, dds_type);
    let alias = u16::try_from(entity).unwrap();
    let [there, _] = connection(1001);
    let declared = [declare_key(alias, &key), declare_token(entity, &token)];
    send(observer, &there, START, &frame(entity, &declared));
    let gid = Gid::of_token(&token).0;
    for (number, payload) in (1..).zip(payloads) {
        let batch = frame(9, &[push(alias, gid, number, payload)]);
        send(observer, &there, START + number, &batch);
    }
}

#[test]
fn what_a_node_says_over_zenoh_is_read_without_a_watch() {
    let mut observer = Observer::new(Settings::default());
    connect(&mut observer, 1001, TALKER, (LISTENER, Role::Peer));
    let logged = [log(40, "talker", b"no scan"), log(40, "talker", b"again")];
    say(&mut observer, 20, "/rosout", robot_log::DDS_TYPE, &logged);
    let status = Status {
        level: 2,
        name: "lidar",
        message: "no data",
        values: &[],
    };
    let dds_type = robot_diagnostics::DDS_TYPE;
    let said = [diagnostics(&[status])];
    say(&mut observer, 21, "/diagnostics", dds_type, &said);
    let transform = Transform {
        parent: "odom",
        child: "base_link",
        stamp: 1,
        x: 7.0,
        yaw: 0.0,
    };
    let dds_type = robot_transforms::DDS_TYPE;
    say(
        &mut observer,
        22,
        "/tf",
        dds_type,
        &[transforms(&[transform])],
    );
    let events = [
        event("/talker", &[("speed", 5)], &[], &[]),
        event("/talker", &[], &[("speed", 7)], &[]),
    ];
    let topic = "/parameter_events";
    say(&mut observer, 23, topic, robot_parameters::EVENT, &events);
    let topic = "/talker/transition_event";
    let changed = [transition(2, 3)];
    say(&mut observer, 24, topic, robot_states::TRANSITION, &changed);

    let snapshot = observer.snapshot(Timestamp(START + SECOND));
    let [node] = &snapshot.logs.nodes[..] else {
        panic!("{:?}", snapshot.logs)
    };
    let counts = node.levels.each_ref().map(|(messages, _)| *messages);
    assert_eq!((&*node.node, counts), ("/talker", [0, 0, 0, 2, 0]));
    let [status] = &snapshot.diagnostics.statuses[..] else {
        panic!("{:?}", snapshot.diagnostics)
    };
    assert_eq!((&*status.name, &*status.message), ("lidar", "no data"));
    let [tree] = &snapshot.transforms.trees[..] else {
        panic!("{:?}", snapshot.transforms)
    };
    assert_eq!(tree.edges[0].pose.translation, [7.0, 0.0, 0.0]);
    let [change] = &snapshot.parameters.changes[..] else {
        panic!("{:?}", snapshot.parameters)
    };
    let values = (change.before.as_deref(), change.value.as_deref());
    assert_eq!(values, (Some("5"), Some("7")));
    let [managed] = &snapshot.lifecycle.nodes[..] else {
        panic!("{:?}", snapshot.lifecycle)
    };
    assert_eq!(
        (&*managed.node, managed.state),
        ("/talker", LifecycleState::Active)
    );
}
