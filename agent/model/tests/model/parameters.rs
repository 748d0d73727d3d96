//! What the robot itself says: parameters of its nodes.

use std::sync::Arc;

use ros2probe_model::derive::robot::parameters::ExpectedParameter;
use ros2probe_model::derive::robot::{Parts, RobotExpectations};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_parameters::{
    EVENT, GET_REPLY, GET_REQUEST, Integers, REQUEST, boolean, event, names, request, values,
};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PLANNER: GuidPrefix = GuidPrefix([3; 12]);
const CLIENT: GuidPrefix = GuidPrefix([4; 12]);
const EVENTS: Guid = Guid::new(PLANNER, EntityId([0, 0, 1, 3]));
const ASKS: Guid = Guid::new(CLIENT, EntityId([0, 0, 3, 3]));
const REPLIES: Guid = Guid::new(PLANNER, EntityId([0, 0, 4, 3]));
const REQUESTS: Guid = Guid::new(CLIENT, EntityId([0, 0, 2, 3]));

/// A node with parameters, and a node that sets them.
struct Scene {
    domain: VirtualDomain,
    number: u64,
    /// Whether the client is of Cyclone DDS, whose requests have a header.
    is_cyclone: bool,
}

impl Scene {
    fn with(settings: Settings, is_cyclone: bool) -> Self {
        let mut domain = VirtualDomain::new(&[], settings);
        let mut scene = Self {
            number: 0,
            is_cyclone,
            domain: {
                domain.participant(PLANNER, 100_000);
                let payload = forge::endpoint(EVENTS, "rt/parameter_events", EVENT, true);
                domain.put(Message::from(PLANNER).data(SEDP_WRITERS, 1, &payload));
                domain.nodes(PLANNER, 1, &[("/", "planner", EVENTS)]);
                domain
            },
        };
        let participant = forge::participant(CLIENT, 100_000, Some(0));
        let spdp = scene
            .of_client()
            .data(EntityId::SPDP_WRITER, 1, &participant);
        scene.domain.put(spdp);
        let payload = forge::endpoint(REQUESTS, "rq/planner/set_parametersRequest", REQUEST, true);
        let sedp = scene.of_client().data(SEDP_WRITERS, 1, &payload);
        scene.domain.put(sedp);
        scene.domain.nodes(CLIENT, 1, &[("/", "tuner", REQUESTS)]);
        scene
    }

    fn new() -> Self {
        Self::with(Settings::default(), false)
    }

    fn of_client(&self) -> Message {
        match self.is_cyclone {
            true => Message::from(CLIENT),
            false => Message::from_fast(CLIENT),
        }
    }

    fn event(&mut self, new: Integers<'_>, changed: Integers<'_>, deleted: &[&str]) {
        self.number += 1;
        let payload = event("/planner", new, changed, deleted);
        let message = Message::from(PLANNER).data(EVENTS.entity, self.number, &payload);
        self.domain.put(message);
    }

    fn request(&mut self, integers: Integers<'_>) {
        self.number += 1;
        let payload = request(integers, self.is_cyclone);
        let message = self
            .of_client()
            .data(REQUESTS.entity, self.number, &payload);
        self.domain.put(message);
    }

    /// Returns names and values of the known parameters.
    fn known(&self) -> Vec<(String, String)> {
        let known = self.domain.snapshot().parameters.known;
        let known = known
            .iter()
            .inspect(|each| assert_eq!(&*each.node, "/planner"));
        known
            .map(|each| (each.name.to_string(), each.value.to_string()))
            .collect()
    }

    /// Returns name, old and new value, and node of the client of each change.
    fn changes(&self) -> Vec<[Option<String>; 4]> {
        let changes = self.domain.snapshot().parameters.changes;
        let changes = changes.iter().map(|change| {
            let client = change.requested_by.as_ref();
            [
                Some(change.name.to_string()),
                change.before.as_deref().map(str::to_owned),
                change.value.as_deref().map(str::to_owned),
                client.and_then(|client| client.node.as_deref().map(str::to_owned)),
            ]
        });
        changes.collect()
    }
}

fn owned<const N: usize>(texts: [Option<&str>; N]) -> [Option<String>; N] {
    texts.map(|text| text.map(str::to_owned))
}

#[test]
fn declared_parameters_are_known_and_no_changes() {
    let mut scene = Scene::new();
    scene.event(&[("speed", 5), ("retries", -1)], &[], &[]);
    let known = [("retries", "-1"), ("speed", "5")];
    assert_eq!(
        scene.known(),
        known.map(|(name, value)| (name.into(), value.into()))
    );
    assert!(scene.changes().is_empty());
}

#[test]
fn a_change_has_old_and_new_value_and_is_an_event() {
    let mut scene = Scene::new();
    scene.event(&[("speed", 5)], &[], &[]);
    scene.event(&[], &[("speed", 7)], &[]);
    scene.event(&[], &[("speed", 7)], &[]);
    scene.event(&[], &[("unknown before", 1)], &[]);
    scene.event(&[], &[], &["speed"]);
    assert_eq!(
        scene.changes(),
        [
            owned([Some("speed"), Some("5"), Some("7"), None]),
            owned([Some("unknown before"), None, Some("1"), None]),
            owned([Some("speed"), Some("7"), None, None]),
        ]
    );
    let events = scene.domain.observer.drain().events.events;
    let changes = events
        .iter()
        .filter(|event| matches!(event.kind, EventKind::Parameter(_)));
    assert_eq!(changes.count(), 3);
    let counts = scene.domain.snapshot().parameters.counts;
    assert_eq!((&*counts[0].1, counts[0].2), ("/planner", 3));
}

#[test]
fn the_requester_of_a_change_is_the_node_of_the_client() {
    for is_cyclone in [false, true] {
        let mut scene = Scene::with(Settings::default(), is_cyclone);
        scene.event(&[("speed", 5)], &[], &[]);
        scene.request(&[("other", 1), ("speed", 9)]);
        scene.domain.wait(20);
        scene.event(&[], &[("speed", 9)], &[]);
        let change = owned([Some("speed"), Some("5"), Some("9"), Some("/tuner")]);
        assert_eq!(scene.changes(), [change], "{is_cyclone}");
    }
}

/// Requests for values, and replies of the node.
struct Question {
    is_cyclone: bool,
    number: u64,
}

impl Question {
    /// Announces the writers of requests and replies.
    fn announce(scene: &mut Scene) -> Self {
        let is_cyclone = scene.is_cyclone;
        let requests = forge::endpoint(ASKS, "rq/planner/get_parametersRequest", GET_REQUEST, true);
        let requests = scene.of_client().data(SEDP_WRITERS, 2, &requests);
        scene.domain.put(requests);
        let replies = forge::endpoint(REPLIES, "rr/planner/get_parametersReply", GET_REPLY, true);
        let replies = Self::from(is_cyclone, PLANNER).data(SEDP_WRITERS, 2, &replies);
        scene.domain.put(replies);
        Self {
            is_cyclone,
            number: 0,
        }
    }

    fn from(is_cyclone: bool, prefix: GuidPrefix) -> Message {
        match is_cyclone {
            true => Message::from(prefix),
            false => Message::from_fast(prefix),
        }
    }

    fn message(&self, writer: Guid, of: u64, body: impl Fn(&[u8]) -> Vec<u8>) -> Message {
        let message = Self::from(self.is_cyclone, writer.prefix);
        if self.is_cyclone {
            let call = [&[5; 8][..], &of.to_le_bytes()].concat();
            return message.data(writer.entity, self.number, &body(&call));
        }
        let client = Guid::new(CLIENT, EntityId([0, 0, 3, 4])).to_bytes();
        // A request relates to a number that is unknown.
        let [high, low] = match writer == ASKS {
            true => [u32::MAX, 0],
            false => [(of >> 32) as u32, of as u32],
        };
        let related = [&client[..], &high.to_le_bytes(), &low.to_le_bytes()].concat();
        message.data_with(writer.entity, self.number, &[(0x800f, related)], &body(&[]))
    }

    fn send_get_request(&mut self, scene: &mut Scene, asked: &[&str]) -> u64 {
        self.number += 1;
        let message = self.message(ASKS, self.number, |call| names(asked, call));
        scene.domain.put(message);
        self.number
    }

    fn reply(&mut self, scene: &mut Scene, of: u64, replied: &[Option<i64>]) {
        self.number += 1;
        let message = self.message(REPLIES, of, |call| values(replied, call));
        scene.domain.put(message);
    }
}

#[test]
fn values_in_a_reply_are_known_and_no_changes() {
    for is_cyclone in [false, true] {
        let mut scene = Scene::with(Settings::default(), is_cyclone);
        let mut question = Question::announce(&mut scene);
        let first = question.send_get_request(&mut scene, &["speed", "absent", "retries"]);
        let second = question.send_get_request(&mut scene, &["depth"]);
        question.reply(&mut scene, second, &[Some(9)]);
        question.reply(&mut scene, first, &[Some(7), None, Some(3), Some(8)]);
        // A second reply, and one to a request that the agent did not see.
        question.reply(&mut scene, first, &[Some(1)]);
        question.reply(&mut scene, 77, &[Some(1)]);
        let known = [("depth", "9"), ("retries", "3"), ("speed", "7")];
        let known = known.map(|(name, value)| (name.to_owned(), value.to_owned()));
        assert_eq!(scene.known(), known, "{is_cyclone}");
        assert!(scene.changes().is_empty());
        scene.event(&[], &[("speed", 8)], &[]);
        let change = owned([Some("speed"), Some("7"), Some("8"), None]);
        assert_eq!(scene.changes(), [change], "the value before is known");
    }
}

#[test]
fn requests_beyond_the_cap_displace_the_oldest_requests() {
    let mut scene = Scene::new();
    let mut question = Question::announce(&mut scene);
    let first = question.send_get_request(&mut scene, &["first"]);
    let many: Vec<String> = (0..500).map(|number| format!("p{number}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    question.send_get_request(&mut scene, &many);
    let last = question.send_get_request(&mut scene, &many);
    question.send_get_request(&mut scene, &many);
    question.reply(&mut scene, first, &[Some(1)]);
    question.reply(&mut scene, last, &[Some(1), Some(2)]);
    let known = [("p0", "1"), ("p1", "2")];
    assert_eq!(
        scene.known(),
        known.map(|(name, value)| (name.into(), value.into()))
    );
}

#[test]
fn an_old_request_or_one_for_another_value_is_not_the_cause() {
    let mut scene = Scene::new();
    scene.request(&[("speed", 9)]);
    scene.event(&[], &[("speed", 8)], &[]);
    scene.domain.wait(6000);
    scene.event(&[], &[("speed", 9)], &[]);
    assert!(scene.changes().iter().all(|change| change[3].is_none()));
    assert_eq!(scene.changes().len(), 2);
}

#[test]
fn the_parameters_of_a_removed_node_are_forgotten_and_its_changes_are_kept() {
    let mut scene = Scene::new();
    scene.event(&[("speed", 5)], &[("speed", 6)], &[]);
    let gone = Message::from(PLANNER).dispose_by_hash(SEDP_WRITERS, 2, EVENTS);
    scene.domain.put(gone);
    assert!(scene.known().is_empty());
    assert_eq!(scene.changes().len(), 1);
}

#[test]
fn parameters_are_not_read_if_they_are_switched_off() {
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut scene = Scene::with(settings, false);
    scene.event(&[], &[("speed", 5)], &[]);
    let facts = scene.domain.snapshot().parameters;
    assert!(!facts.are_read && facts.known.is_empty() && facts.changes.is_empty());
}

#[test]
fn a_parameter_beyond_the_cap_displaces_the_oldest_value() {
    let mut scene = Scene::new();
    for number in 0..4200 {
        scene.event(&[(&format!("p{number}"), number)], &[], &[]);
        scene.domain.wait(5);
    }
    let known = scene.known();
    assert_eq!(known.len(), 4096);
    assert!(known.iter().all(|(name, _)| name != "p0"));
    assert!(known.iter().any(|(name, _)| name == "p4199"));
}

#[test]
fn nodes_beyond_the_cap_are_not_counted_and_the_oldest_changes_are_dropped() {
    let mut scene = Scene::new();
    for number in 0..1200 {
        scene.number += 1;
        let payload = event(&format!("/n{number}"), &[], &[("speed", number)], &[]);
        let message = Message::from(PLANNER).data(EVENTS.entity, scene.number, &payload);
        scene.domain.put(message);
        scene.domain.wait(20);
    }
    let facts = scene.domain.snapshot().parameters;
    assert_eq!((facts.counts.len(), facts.changes.len()), (512, 1000));
    assert_eq!(&*facts.changes[999].node, "/n1199");
}

#[test]
fn another_value_than_expected_is_a_finding_until_it_is_set_again() {
    let mut scene = Scene::new();
    let expected = ExpectedParameter {
        node: "/planner".into(),
        name: "speed".into(),
        value: "5".into(),
    };
    let expectations = RobotExpectations {
        parameters: Arc::new(vec![expected]),
        ..RobotExpectations::default()
    };
    let observer = &mut scene.domain.observer;
    observer.input(Input::RobotExpectations(expectations));
    let drifts = |scene: &mut Scene| -> Vec<String> {
        scene.domain.wait(1000);
        let diagnoses = scene.domain.snapshot().diagnoses;
        let found = diagnoses.list.iter().filter_map(|found| match found {
            Diagnosis::ParameterDrift { name, value, .. } => Some(format!("{name}: {value}")),
            _ => None,
        });
        found.collect()
    };
    scene.event(&[("speed", 5), ("width", 1)], &[], &[]);
    assert_eq!(drifts(&mut scene), [""; 0]);
    scene.event(&[], &[("speed", 7)], &[]);
    assert_eq!(drifts(&mut scene), ["speed: 7"]);
    scene.event(&[], &[("speed", 8), ("width", 3)], &[]);
    assert_eq!(drifts(&mut scene), ["speed: 8"]);
    scene.event(&[], &[("speed", 5)], &[]);
    assert_eq!(drifts(&mut scene), [""; 0]);
    scene.event(&[], &[("speed", 7)], &[]);
    scene.event(&[], &[], &["speed"]);
    assert_eq!(drifts(&mut scene), [""; 0]);
}

#[test]
fn nodes_with_and_without_simulated_time_are_a_finding_after_some_seconds() {
    let mut scene = Scene::new();
    let mixed = |scene: &mut Scene, milliseconds| -> Vec<(Vec<String>, Vec<String>)> {
        scene.domain.wait(milliseconds);
        let diagnoses = scene.domain.snapshot().diagnoses;
        let names = |nodes: &[_]| nodes.iter().map(ToString::to_string).collect();
        let found = diagnoses.list.iter().filter_map(|found| match found {
            Diagnosis::MixedTime {
                simulated, system, ..
            } => Some((names(simulated), names(system))),
            _ => None,
        });
        found.collect()
    };
    let declare = |scene: &mut Scene, node: &str, value: bool| {
        scene.number += 1;
        let payload = boolean(node, "use_sim_time", value);
        let message = Message::from(PLANNER).data(EVENTS.entity, scene.number, &payload);
        scene.domain.put(message);
    };
    declare(&mut scene, "/planner", true);
    declare(&mut scene, "/map", true);
    assert_eq!(mixed(&mut scene, 9000), []);
    declare(&mut scene, "/lidar", false);
    assert_eq!(mixed(&mut scene, 4000), []);
    let expected = (
        vec!["/map".to_owned(), "/planner".to_owned()],
        vec!["/lidar".to_owned()],
    );
    assert_eq!(mixed(&mut scene, 3000), [expected]);
    declare(&mut scene, "/lidar", true);
    assert_eq!(mixed(&mut scene, 1000), []);
}

#[test]
fn a_retransmitted_event_changes_only_parameters_without_a_later_event() {
    let mut scene = Scene::new();
    scene.event(&[("speed", 1), ("retries", 1)], &[], &[]);
    let late = |scene: &mut Scene, number, changed: Integers<'_>| {
        let payload = event("/planner", &[], changed, &[]);
        let message = Message::from(PLANNER).data(EVENTS.entity, number, &payload);
        scene.domain.put(message);
    };
    scene.number += 1;
    // The second event was lost, and arrives after the third one.
    scene.event(&[], &[("speed", 3)], &[]);
    late(&mut scene, 2, &[("speed", 2), ("retries", 2)]);
    let known = [("retries", "2"), ("speed", "3")];
    assert_eq!(
        scene.known(),
        known.map(|(name, value)| (name.into(), value.into()))
    );
    let changed: Vec<_> = scene.changes().into_iter().map(|[name, ..]| name).collect();
    assert_eq!(changed, owned([Some("speed"), Some("retries")]));
}
