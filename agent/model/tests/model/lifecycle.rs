//! What the robot itself says: the states of its managed nodes.

use std::sync::Arc;

use ros2probe_model::derive::robot::{Parts, RobotExpectations};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_states::{STATE_REPLY, TRANSITION, state_reply, transition};
use ros2probe_wire::lifecycle::LifecycleState;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const EVENTS: Guid = Guid::new(PREFIX, EntityId([0, 0, 1, 3]));
const REPLIES: Guid = Guid::new(PREFIX, EntityId([0, 0, 2, 3]));
const UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;
const ACTIVE: u8 = 3;
const CONFIGURING: u8 = 10;
const ACTIVATING: u8 = 13;
const DEACTIVATING: u8 = 14;
const ERROR: u8 = 15;

/// A managed node.
struct Node {
    domain: VirtualDomain,
    number: u64,
}

impl Node {
    fn with(settings: Settings, active: &[&str]) -> Self {
        let mut domain = VirtualDomain::new(&[], settings);
        let active = active.iter().map(|name| (*name).into()).collect();
        let expectations = RobotExpectations {
            active: Arc::new(active),
            ..RobotExpectations::default()
        };
        let observer = &mut domain.observer;
        observer.input(Input::RobotExpectations(expectations));
        domain.participant(PREFIX, 100_000);
        for (number, guid, topic, type_name) in [
            (1, EVENTS, "rt/nav/planner/transition_event", TRANSITION),
            (2, REPLIES, "rr/nav/planner/get_stateReply", STATE_REPLY),
        ] {
            let payload = forge::endpoint(guid, topic, type_name, true);
            domain.put(Message::from(PREFIX).data(SEDP_WRITERS, number, &payload));
        }
        domain.nodes(PREFIX, 1, &[("/nav", "planner", EVENTS)]);
        Self { domain, number: 0 }
    }

    fn new() -> Self {
        Self::with(Settings::default(), &[])
    }

    fn transit(&mut self, from: u8, to: u8) {
        self.number += 1;
        let message = Message::from(PREFIX).data(EVENTS.entity, self.number, &transition(from, to));
        self.domain.put(message);
    }

    /// Returns the state of the only node.
    fn state(&self) -> Option<LifecycleState> {
        let nodes = self.domain.snapshot().lifecycle.nodes;
        assert!(nodes.iter().all(|each| &*each.node == "/nav/planner"));
        nodes.first().map(|node| node.state)
    }

    /// Returns state and reason of the findings after some time.
    fn findings(&mut self, milliseconds: u64) -> Vec<(LifecycleState, bool)> {
        self.domain.wait(milliseconds);
        let diagnoses = self.domain.snapshot().diagnoses;
        let found = diagnoses.list.iter().filter_map(|found| match found {
            Diagnosis::NodeInactive {
                node,
                state,
                has_failed,
                ..
            } => {
                assert_eq!(&**node, "/nav/planner");
                Some((*state, *has_failed))
            }
            _ => None,
        });
        found.collect()
    }

    fn events(&mut self) -> Vec<String> {
        let events = self.domain.observer.drain().events.events;
        let changes = events.iter().filter_map(|event| match &event.kind {
            EventKind::Lifecycle {
                node,
                from,
                to,
                process,
                ..
            } => {
                assert_eq!((node.as_deref(), process), (Some("/nav/planner"), &None));
                Some(format!("{from} -> {to}"))
            }
            _ => None,
        });
        changes.collect()
    }
}

#[test]
fn the_state_after_the_last_transition_is_known_and_each_transition_is_an_event() {
    let mut node = Node::new();
    assert_eq!(node.state(), None);
    node.transit(UNCONFIGURED, CONFIGURING);
    node.transit(CONFIGURING, INACTIVE);
    assert_eq!(node.state(), Some(LifecycleState::Inactive));
    assert_eq!(
        node.events(),
        ["unconfigured -> configuring", "configuring -> inactive"]
    );
    assert_eq!(node.findings(20_000), [], "nothing expects it to be active");
}

#[test]
fn a_late_agent_reads_the_lifecycle_state_from_a_reply_to_a_client() {
    for is_cyclone in [false, true] {
        let mut node = Node::new();
        let (message, payload) = match is_cyclone {
            true => (Message::from(PREFIX), state_reply(ACTIVE, true)),
            false => (Message::from_fast(PREFIX), state_reply(ACTIVE, false)),
        };
        if !is_cyclone {
            let participant = forge::participant(PREFIX, 100_000, Some(0));
            let spdp = Message::from_fast(PREFIX).data(EntityId::SPDP_WRITER, 2, &participant);
            node.domain.put(spdp);
        }
        node.domain.put(message.data(REPLIES.entity, 1, &payload));
        assert_eq!(node.state(), Some(LifecycleState::Active), "{is_cyclone}");
        assert_eq!(node.events(), [""; 0], "it changed nothing");
    }
}

#[test]
fn an_expected_node_that_is_not_active_for_some_seconds_is_a_finding() {
    let mut node = Node::with(Settings::default(), &["/lidar", "/nav/*"]);
    assert_eq!(node.findings(20_000), [], "its state is unknown");
    node.transit(CONFIGURING, INACTIVE);
    assert_eq!(node.findings(4000), []);
    node.transit(INACTIVE, ACTIVATING);
    node.transit(ACTIVATING, ACTIVE);
    assert_eq!(node.findings(20_000), []);
    node.transit(ACTIVE, DEACTIVATING);
    node.transit(DEACTIVATING, INACTIVE);
    assert_eq!(node.findings(4000), []);
    assert_eq!(node.findings(3000), [(LifecycleState::Inactive, false)]);
    node.transit(ACTIVATING, ACTIVE);
    assert_eq!(node.findings(1000), []);
}

#[test]
fn a_failed_transition_is_a_finding_without_an_expectation() {
    for (from, to, state) in [
        (CONFIGURING, UNCONFIGURED, LifecycleState::Unconfigured),
        (ACTIVATING, INACTIVE, LifecycleState::Inactive),
        (ACTIVATING, ERROR, LifecycleState::ErrorProcessing),
        (ERROR, UNCONFIGURED, LifecycleState::Unconfigured),
    ] {
        let mut node = Node::new();
        node.transit(from, to);
        assert_eq!(node.findings(4000), []);
        assert_eq!(node.findings(3000), [(state, true)], "{from} {to}");
        node.transit(CONFIGURING, INACTIVE);
        assert_eq!(node.findings(1000), [], "it was configured again");
    }
}

#[test]
fn a_departed_node_has_no_state_and_no_finding() {
    let mut node = Node::new();
    node.transit(CONFIGURING, UNCONFIGURED);
    assert_eq!(node.findings(7000).len(), 1);
    let disposal = Message::from(PREFIX).dispose_by_hash(SEDP_WRITERS, 3, EVENTS);
    node.domain.put(disposal);
    assert_eq!(node.findings(1000), []);
    assert_eq!(node.state(), None);
}

#[test]
fn a_malformed_transition_is_counted_and_the_part_can_be_switched_off() {
    let mut node = Node::new();
    node.number += 1;
    let bytes = &transition(CONFIGURING, INACTIVE)[..20];
    let message = Message::from(PREFIX).data(EVENTS.entity, node.number, bytes);
    node.domain.put(message);
    let errors = node.domain.snapshot().decode_errors;
    assert!(
        errors.iter().any(|error| error.stage == "transition_event"),
        "{errors:?}"
    );
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut node = Node::with(settings, &["/nav/*"]);
    node.transit(ACTIVATING, INACTIVE);
    assert_eq!(node.findings(20_000), []);
    let facts = node.domain.snapshot().lifecycle;
    assert!(!facts.are_read && facts.nodes.is_empty());
}
