//! Calls of services and goals of actions, in virtual time.

mod caps;
mod descriptions;
mod fixtures;
mod paths;

use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::names::TopicName;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{ActionFacts, GoalCounts, ServiceFacts};
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message};
use ros2probe_testing::model::host::MILLISECOND;
use ros2probe_wire::record::{Record, Verdict, flag, guid_words, kind};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const LEASE: u32 = 1_000_000;
const ADD: &str = "/add";

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Middleware {
    Fast,
    Cyclone,
}

/// A client or server: its participant, its writer, and the identity of a client.
#[derive(Clone, Copy)]
struct Party {
    writer: Guid,
    /// With Fast DDS, the client's reader for replies; with Cyclone DDS, the client id in the first
    /// bytes.
    identity: [u8; 16],
}

/// Services of one middleware in virtual time.
struct Robot {
    domain: VirtualDomain,
    middleware: Middleware,
    announced: u64,
}

impl Robot {
    fn new(middleware: Middleware) -> Self {
        Self {
            domain: VirtualDomain::new(&["/**"], Settings::default()),
            middleware,
            announced: 0,
        }
    }

    /// Adds a participant with the writer of a service's requests.
    fn client(&mut self, number: u8, service: &str) -> Party {
        let writer = self.party(number, &format!("rq{service}Request"), 3);
        let identity = match self.middleware {
            Middleware::Fast => Guid::new(writer.prefix, EntityId([0, 2, number, 4])).to_bytes(),
            Middleware::Cyclone => {
                let mut identity = [0; 16];
                identity[..8].copy_from_slice(&[number; 8]);
                identity
            }
        };
        Party { writer, identity }
    }

    /// Adds a participant with the writer of a service's replies.
    fn server(&mut self, number: u8, service: &str) -> Party {
        let writer = self.party(number, &format!("rr{service}Reply"), 3);
        Party {
            writer,
            identity: [0; 16],
        }
    }

    fn party(&mut self, number: u8, topic: &str, kind: u8) -> Guid {
        self.announced += 1;
        let writer = Guid::new(prefix(number), EntityId([0, self.announced as u8, 1, kind]));
        self.domain.participant(writer.prefix, LEASE);
        self.domain.endpoint(writer, self.announced, topic);
        writer
    }

    /// Returns a request or reply.
    fn message(&self, from: Party, number: u64, call: ([u8; 16], u64), body: &[u8]) -> Message {
        let (client, of) = call;
        match self.middleware {
            Middleware::Fast => {
                let is_request = from.identity == client;
                let [high, low] = match is_request {
                    // SEQUENCENUMBER_UNKNOWN.
                    true => [u32::MAX, 0],
                    false => [(of >> 32) as u32, of as u32],
                };
                let related = [&client[..], &high.to_le_bytes(), &low.to_le_bytes()].concat();
                let payload = [&[0, 1, 0, 0], body].concat();
                Message::from_fast(from.writer.prefix).data_with(
                    from.writer.entity,
                    number,
                    &[(0x800f, related)],
                    &payload,
                )
            }
            Middleware::Cyclone => {
                let payload = [&[0, 1, 0, 0], &client[..8], &of.to_le_bytes()[..], body].concat();
                Message::from(from.writer.prefix).data(from.writer.entity, number, &payload)
            }
        }
    }

    /// Sends a request on the wire.
    fn request(&mut self, client: Party, number: u64) {
        self.request_with(client, number, &[7; 20]);
    }

    fn request_with(&mut self, client: Party, number: u64, body: &[u8]) {
        let message = self.message(client, number, (client.identity, number), body);
        self.domain.put(message);
    }

    /// Sends the server's message `number`, the reply to a client's request `of`.
    fn reply(&mut self, server: Party, number: u64, client: Party, of: u64) {
        self.reply_with(server, number, client, of, &[1; 8]);
    }

    fn reply_with(&mut self, server: Party, number: u64, client: Party, of: u64, body: &[u8]) {
        let message = self.message(server, number, (client.identity, of), body);
        self.domain.put(message);
    }

    /// Sends a DATA_FRAG of Cyclone DDS' reply 1 to call 1, with fragments of `bytes` bytes.
    fn part_of_a_reply(&mut self, from: Party, to: Party, body: &[u8], start: u32, bytes: u16) {
        let payload = [
            &[0, 1, 0, 0],
            &to.identity[..8],
            &1_u64.to_le_bytes()[..],
            body,
        ];
        let message = Message::from(from.writer.prefix);
        let message = message.fragment(from.writer.entity, 1, start, bytes, &payload.concat());
        self.domain.put(message);
    }

    fn wait(&mut self, milliseconds: u64) {
        self.domain.wait(milliseconds);
    }

    fn service(&self, name: &str) -> Option<ServiceFacts> {
        let services = self.domain.snapshot().services;
        services.into_iter().find(|service| service.name == name)
    }

    /// Returns the numbers of all, answered, unanswered and hanging requests of `/add`.
    fn counts(&self) -> (u64, u64, u64, usize) {
        let service = self.service(ADD).expect("a call of /add");
        let ServiceFacts {
            requests,
            answered,
            unanswered,
            hanging,
            ..
        } = service;
        (requests, answered, unanswered, hanging)
    }

    fn action(&self, name: &str) -> Option<ActionFacts> {
        let actions = self.domain.snapshot().actions;
        actions.into_iter().find(|action| action.name == name)
    }

    /// Returns the topic and the writer of each finding about a hanging call.
    fn hanging(&self) -> Vec<(TopicName, Guid)> {
        let found = &self.domain.snapshot().diagnoses.list;
        let hanging = found.iter().filter_map(|finding| match finding {
            Diagnosis::HangingCall { topic, writer } => Some((topic.name.clone(), *writer)),
            _ => None,
        });
        hanging.collect()
    }
}

fn prefix(number: u8) -> GuidPrefix {
    GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 3, number])
}

/// Runs a test with each middleware.
fn with_each(test: impl Fn(Robot)) {
    for middleware in [Middleware::Fast, Middleware::Cyclone] {
        println!("{middleware:?}");
        test(Robot::new(middleware));
    }
}

#[test]
fn the_time_from_request_to_reply_is_exact() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        for number in 1..=100 {
            robot.request(client, number);
            robot.wait(number);
            robot.reply(server, number, client, number);
            robot.wait(7);
        }
        assert_eq!(robot.counts(), (100, 100, 0, 0));
        let latency = robot.service(ADD).unwrap().latency;
        assert_eq!((latency.p50, latency.p99), (Some(0.050), Some(0.099)));
        assert_eq!(latency.histogram.count(), 100);
        assert!((latency.histogram.sum() - 5.05).abs() < 1e-9);
    });
}

#[test]
fn writers_of_requests_and_replies_are_captured() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        let interest = robot.domain.observer.drain().interest;
        for party in [client, server] {
            assert!(interest.contains(&(party.writer, Some(Verdict::Capture))));
        }
    });
}

#[test]
fn copies_retransmissions_and_replies_of_a_second_server_count_once() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let [one, other] = [2, 3].map(|number| robot.server(number, ADD));
        for number in 1..=5 {
            for _ in 0..3 {
                robot.request(client, number);
                robot.wait(1);
            }
            robot.reply(one, number, client, number);
            robot.wait(5);
            robot.reply(one, number, client, number);
            robot.reply(other, number, client, number);
            robot.request(client, number);
        }
        assert_eq!(robot.counts(), (5, 5, 0, 0));
        let latency = robot.service(ADD).unwrap().latency;
        assert_eq!((latency.p50, latency.p99), (Some(0.003), Some(0.003)));
        robot.wait(20_000);
        assert_eq!(robot.counts(), (5, 5, 0, 0));
    });
}

#[test]
fn calls_of_clients_with_the_same_numbers_are_counted_separately() {
    with_each(|mut robot| {
        let [one, other] = [1, 2].map(|number| robot.client(number, ADD));
        let server = robot.server(3, ADD);
        robot.request(one, 1);
        robot.wait(10);
        robot.request(other, 1);
        robot.wait(10);
        robot.reply(server, 1, other, 1);
        assert_eq!(robot.counts(), (2, 1, 0, 0));
        assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(0.010));
        robot.wait(30);
        robot.reply(server, 2, one, 1);
        assert_eq!(robot.counts(), (2, 2, 0, 0));
        assert_eq!(robot.service(ADD).unwrap().latency.p99, Some(0.050));
    });
}

#[test]
fn a_call_without_a_reply_is_a_finding_until_it_is_answered() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        robot.request(client, 1);
        robot.wait(4_900);
        assert_eq!((robot.counts(), robot.hanging()), ((1, 0, 0, 0), vec![]));
        robot.domain.observer.drain();
        robot.wait(1_200);
        assert_eq!(robot.counts(), (1, 0, 1, 1));
        assert_eq!(robot.hanging(), [(ADD.into(), client.writer)]);
        robot.wait(3_900);
        robot.reply(server, 1, client, 1);
        robot.wait(1_000);
        assert_eq!((robot.counts(), robot.hanging()), ((1, 1, 1, 0), vec![]));
        assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(10.0));
        let events = robot.domain.observer.drain().events.events;
        let found = events.into_iter().filter_map(|event| match event.kind {
            EventKind::Diagnosis {
                resolved,
                finding: Diagnosis::HangingCall { writer, .. },
            } => Some((resolved, writer)),
            _ => None,
        });
        let found: Vec<_> = found.collect();
        assert_eq!(found, [(false, client.writer), (true, client.writer)]);
    });
}

#[test]
fn a_hanging_call_ends_with_its_client_or_after_ten_minutes() {
    with_each(|mut robot| {
        let [one, other] = [1, 2].map(|number| robot.client(number, ADD));
        robot.request(one, 1);
        robot.request(other, 1);
        robot.wait(7_000);
        assert_eq!(robot.hanging().len(), 2);
        let dispose = Message::from(one.writer.prefix);
        let dispose = dispose.dispose_by_hash(forge::SEDP_WRITERS, 9, one.writer);
        robot.domain.put(dispose);
        robot.wait(1_000);
        assert_eq!(robot.hanging(), [(ADD.into(), other.writer)]);
        robot.wait(600_000);
        assert_eq!((robot.counts(), robot.hanging()), ((2, 0, 2, 0), vec![]));
    });
}

#[test]
fn a_goal_lasts_from_its_request_to_its_result() {
    with_each(|mut robot| {
        let services = ["send_goal", "get_result"].map(|part| format!("/fib/_action/{part}"));
        let [sends, gets] = services.each_ref().map(|service| robot.client(1, service));
        let [accepts, results] = services.each_ref().map(|service| robot.server(2, service));
        let goal = |number: u8| [number; 16];
        for number in 1..=3 {
            robot.request_with(sends, number.into(), &goal(number));
            robot.wait(10);
            // The server rejects the second goal.
            let reply = [u8::from(number != 2), 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
            robot.reply_with(accepts, number.into(), sends, number.into(), &reply);
        }
        robot.request_with(gets, 1, &goal(1));
        robot.request_with(gets, 2, &goal(3));
        // A pending result is not a hanging call.
        robot.wait(19_970);
        assert_eq!(robot.hanging(), []);
        let expected = GoalCounts {
            accepted: 2,
            rejected: 1,
            ..GoalCounts::default()
        };
        let action = robot.action("/fib").unwrap();
        assert_eq!((action.goals, action.open), (expected, 2));
        robot.reply_with(results, 1, gets, 1, &[4, 0, 0, 0]);
        robot.wait(1_000);
        robot.reply_with(results, 2, gets, 2, &[6, 0, 0, 0]);
        let expected = GoalCounts {
            succeeded: 1,
            aborted: 1,
            ..expected
        };
        let action = robot.action("/fib").unwrap();
        assert_eq!((action.goals, action.open), (expected, 0));
        // 30 ms for three requests, then 19.97 s; the third goal began 20 ms after the first.
        assert_eq!(action.duration.p50, Some(20.0));
        assert_eq!(action.duration.p99, Some(20.98));
    });
}

#[test]
fn a_message_without_an_identity_increments_one_counter() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    let message = Message::from(client.writer.prefix);
    robot
        .domain
        .put(message.data(client.writer.entity, 1, &[0, 1, 0, 0, 9]));
    let snapshot = robot.domain.snapshot();
    let errors = snapshot.decode_errors.iter();
    let errors: Vec<_> = errors.map(|each| (each.stage, each.count)).collect();
    assert_eq!(errors, [("request", 1)]);
    assert!(snapshot.services.is_empty());
}
