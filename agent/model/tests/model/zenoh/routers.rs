//! Two hosts with a router each: deliveries and ends of sessions in every order of starts.
//!
//! The agent observes one host. The sequence of all messages is fixed. An agent that starts late
//! sees only its end, and then the messages that a joining session receives.

use ros2probe_model::graph::discovery::Memory;
use ros2probe_model::graph::zenoh::{StreamEvent, StreamId};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::Direction;
use ros2probe_testing::zenoh::{
    Role, answer_end, connection, declare_token, frame, init, interest, open, publisher, push,
    report, send, undeclare_token,
};
use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::zenoh::{Gid, ZenohId};

use super::processes::hold;
use super::{KEEP_ALIVE, LATE, LISTENER, ROUTER, START, TALKER, chatter, observer};

const OTHER_ROUTER: [u8; 16] = [0x66; 16];
const THIRD_ROUTER: [u8; 16] = [0x77; 16];
const FAR_LISTENER: [u8; 16] = [0x88; 16];
/// Addresses of the hosts.
const HERE: u8 = 2;
const THERE: u8 = 1;
const THIRD: u8 = 3;

/// A step of the sequence at the host of the listener and the router [`ROUTER`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// The local router connects to the router of the talker's host.
    Routers,
    /// The listener opens a session.
    Listener,
    /// The talker of the other host declares its tokens.
    Talker,
}

/// The host, as an agent at its sockets sees it.
struct Host {
    observer: Observer,
    now: u64,
    sent: u64,
}

/// Returns the direction from a socket of this host to another host, and back, both at that socket.
fn on_other_host(host: u8, ports: [u16; 2], socket: u64) -> [StreamId; 2] {
    let [mut there, _] = connection(ports[0]);
    there.flow.source.address[12..].copy_from_slice(&[10, 0, 0, HERE]);
    there.flow.destination.address[12..].copy_from_slice(&[10, 0, 0, host]);
    there.flow.destination.port = ports[1];
    (there.socket, there.outgoing) = (socket, true);
    [there, there.reversed()]
}

/// Returns both directions of a connection within the host, each at the socket of its sender.
fn within(ports: [u16; 2], sockets: [u64; 2]) -> [StreamId; 2] {
    let [mut there, _] = connection(ports[0]);
    there.flow.destination.port = ports[1];
    let at = |stream: StreamId, socket| StreamId {
        socket,
        outgoing: true,
        ..stream
    };
    [at(there, sockets[0]), at(there.reversed(), sockets[1])]
}

fn to_other_router() -> [StreamId; 2] {
    on_other_host(THERE, [5000, 7447], 70)
}

fn to_third_router() -> [StreamId; 2] {
    on_other_host(THIRD, [5001, 7447], 73)
}

fn of_listener() -> [StreamId; 2] {
    within([1000, 7447], [90, 71])
}

fn talker() -> String {
    publisher(TALKER, 10, "/chatter")
}

fn far_listener() -> String {
    publisher(FAR_LISTENER, 12, "/chatter").replace("/MP/", "/MS/")
}

fn listener() -> String {
    publisher(LISTENER, 11, "/chatter").replace("/MP/", "/MS/")
}

impl Host {
    /// Starts an agent.
    fn observed(now: u64) -> Self {
        let mut observer = observer();
        for (socket, process) in [
            (70, 700),
            (71, 700),
            (72, 700),
            (73, 700),
            (90, 900),
            (91, 900),
        ] {
            hold(&mut observer, socket, process);
        }
        Self {
            observer,
            now,
            sent: 0,
        }
    }

    /// Restarts the agent with saved state.
    fn restart(&mut self) {
        let memory = serde_json::to_string(&self.observer.memory()).unwrap();
        let memory: Memory = serde_json::from_str(&memory).unwrap();
        let mut after = Self::observed(self.now);
        let now = Timestamp(self.now);
        after.observer.input(Input::Restored {
            memory: &memory,
            now,
        });
        self.observer = after.observer;
    }

    fn send(&mut self, stream: &StreamId, batch: &[u8]) {
        self.now += SECOND / 1000;
        send(&mut self.observer, stream, self.now, batch);
    }

    fn declare(&mut self, stream: &StreamId, id: u32, token: &str) {
        let declared = [declare_token(id, token)];
        self.send(stream, &frame(7, &declared));
    }

    fn connect(&mut self, [there, back]: [StreamId; 2], one: Side, other: Side) {
        report(&mut self.observer, &there, self.now, StreamEvent::Begin);
        self.send(&there, &init(one.0, one.1, None));
        self.send(&back, &init(other.0, other.1, Some(&[])));
        self.send(&there, &open(60));
        self.send(&back, &open(60));
    }

    /// Takes a step in view of the agent.
    fn step(&mut self, step: Step, after: &[Step]) {
        let [to_router, from_router] = of_listener();
        let [_, from_other] = to_other_router();
        match step {
            Step::Routers => {
                let other = (OTHER_ROUTER, Role::Router);
                self.connect(to_other_router(), (ROUTER, Role::Router), other);
                if after.contains(&Step::Talker) {
                    self.pass_on(&from_other, 0);
                }
            }
            Step::Listener => {
                self.connect(
                    of_listener(),
                    (LISTENER, Role::Peer),
                    (ROUTER, Role::Router),
                );
                self.declare(&to_router, 1, &listener());
            }
            Step::Talker if after.contains(&Step::Routers) => self.pass_on(&from_other, 0),
            Step::Talker => {}
        }
        let has = |one| step == one || after.contains(&one);
        if has(Step::Routers) && has(Step::Listener) && has(Step::Talker) {
            self.pass_on(&from_router, 1);
        }
    }

    /// Forwards the tokens of the other host from a router.
    fn pass_on(&mut self, stream: &StreamId, id: u32) {
        self.declare(stream, id, &talker());
        self.declare(stream, 2 * id, &far_listener());
    }

    /// Lets a session join this host, receive all tokens and leave, like a `ros2` command.
    fn command(&mut self) {
        let [there, back] = within([3000, 7447], [60, 72]);
        self.connect([there, back], (LATE, Role::Peer), (ROUTER, Role::Router));
        self.send(&there, &frame(8, &[interest(1, "@ros2_lv/0/**")]));
        self.pass_on(&back, 1);
        self.send(&back, &frame(9, &[answer_end(1)]));
        let [from_listener, to_listener] = within([2001, 3001], [91, 61]);
        let connected = [from_listener, to_listener];
        self.connect(connected, (LISTENER, Role::Peer), (LATE, Role::Peer));
        self.declare(&from_listener, 1, &listener());
        self.wait(1);
        for stream in [there, back, to_listener, from_listener] {
            report(&mut self.observer, &stream, self.now, StreamEvent::End);
        }
    }

    /// Lets seconds pass, in which both ends of each connection send KEEP_ALIVEs.
    fn wait(&mut self, seconds: u64) {
        for _ in 0..seconds {
            let streams = [to_other_router(), of_listener()];
            for stream in streams.as_flattened() {
                send(&mut self.observer, stream, self.now, &[KEEP_ALIVE]);
            }
            self.pass(1);
        }
    }

    fn pass(&mut self, seconds: u64) {
        self.now += seconds * SECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    /// Publishes messages of the talker, of which both routers forward copies.
    fn publish(&mut self, count: u64) {
        let gid = Gid::of_token(&talker()).0;
        for _ in 0..count {
            self.sent += 1;
            let batch = frame(8, &[push(3, gid, self.sent, b"\0\x01\0\0")]);
            self.send(&to_other_router()[1], &batch);
            self.send(&of_listener()[1], &batch);
        }
    }

    /// Returns the messages of the topic, and those that arrived at each receiver.
    fn counts(&self) -> (u64, Vec<u64>) {
        let snapshot = self.observer.snapshot(Timestamp(self.now));
        let topic = chatter(&snapshot).unwrap();
        let measurement = topic.measurement.as_deref();
        let received = topic.deliveries.iter();
        let received = received.filter(|each| each.direction == Direction::Received);
        let mut counts: Vec<_> = received
            .map(|each| &each.delivered)
            .map(|each| each.messages + each.duplicates + each.lost())
            .collect();
        counts.sort_unstable();
        (measurement.map_or(0, |each| each.messages), counts)
    }

    fn has(&self, session: [u8; 16]) -> bool {
        let prefix = ZenohId::from_le_bytes(&session).unwrap().guid_prefix();
        let snapshot = self.observer.snapshot(Timestamp(self.now));
        let mut participants = snapshot.participants.iter();
        participants.any(|each| each.guid.prefix == prefix)
    }

    /// Returns whether both sessions of the other host and that of this host are listed.
    fn listed(&self) -> [bool; 3] {
        [TALKER, FAR_LISTENER, LISTENER].map(|session| self.has(session))
    }
}

type Side = ([u8; 16], Role);

/// All orders of the steps, each with the agent before, between or after them.
fn orders() -> Vec<(Vec<Step>, usize)> {
    let [routers, listener, talker] = [Step::Routers, Step::Listener, Step::Talker];
    let orders = [
        [routers, listener, talker],
        [routers, talker, listener],
        [listener, routers, talker],
        [listener, talker, routers],
        [talker, routers, listener],
        [talker, listener, routers],
    ];
    let orders = orders.into_iter();
    let with_agent = orders.flat_map(|order| (0..=3).map(move |at| (order.to_vec(), at)));
    with_agent.collect()
}

/// Takes all steps in an order, with a new agent at step `agent`, and lets a command join.
fn started(order: &[Step], agent: usize) -> Host {
    let mut host = Host::observed(START);
    for (index, step) in order.iter().enumerate() {
        if index == agent {
            host = Host::observed(host.now);
        }
        host.step(*step, &order[..index]);
        host.pass(2);
    }
    if agent == order.len() {
        host = Host::observed(host.now);
    }
    host.wait(2);
    host.command();
    host.wait(2);
    host
}

#[test]
fn a_router_is_not_a_receiver_in_any_order_of_starts() {
    for (order, agent) in orders() {
        let mut host = started(&order, agent);
        host.publish(100);
        assert_eq!(host.counts(), (100, vec![100]), "{order:?} {agent}");
        host.wait(1);
        host.restart();
        host.wait(2);
        host.publish(100);
        assert_eq!(
            host.counts(),
            (100, vec![100]),
            "{order:?} {agent} restarted"
        );
    }
}

#[test]
fn a_router_that_forwards_only_one_session_is_not_mistaken_for_it() {
    // No session joins, so the agent sees no INIT.
    let mut host = Host::observed(START);
    let [to_router, _] = of_listener();
    let [to_other, _] = to_other_router();
    host.declare(&to_router, 1, &listener());
    host.declare(&to_other_router()[1], 0, &talker());
    let status = publisher(LISTENER, 13, "/status");
    host.declare(&to_router, 2, &status);
    let gid = Gid::of_token(&status).0;
    for number in 1..=10 {
        let batch = frame(8, &[push(3, gid, number, b"\0\x01\0\0")]);
        host.send(&to_router, &batch);
        host.send(&to_other, &batch);
    }
    host.wait(2);
    host.publish(50);
    assert_eq!(host.counts(), (50, vec![50]));
}

#[test]
fn sessions_behind_a_killed_router_end_in_any_order_of_starts() {
    for (order, agent) in orders() {
        for restarts in [false, true] {
            let mut host = started(&order, agent);
            host.publish(5);
            host.wait(40);
            if restarts {
                host.restart();
                host.wait(40);
            }
            assert_eq!(host.listed(), [true; 3], "{order:?} {agent} {restarts}");
            let [to_other, from_other] = to_other_router();
            report(&mut host.observer, &from_other, host.now, StreamEvent::End);
            report(&mut host.observer, &to_other, host.now, StreamEvent::End);
            // The router undeclares by numbers, which a late agent does not know.
            let gone = [undeclare_token(1), undeclare_token(2)];
            host.send(&of_listener()[1], &frame(9, &gone));
            host.pass(3);
            let ended = [false, false, true];
            assert_eq!(host.listed(), ended, "{order:?} {agent} {restarts}");
        }
    }
}

#[test]
fn sessions_behind_a_host_without_power_end_with_the_lease() {
    for (order, agent) in orders() {
        let mut host = started(&order, agent);
        host.wait(40);
        let [to_other, _] = to_other_router();
        for _ in 0..2 {
            host.pass(30);
            host.send(&to_other, &[KEEP_ALIVE]);
            for stream in of_listener() {
                host.send(&stream, &[KEEP_ALIVE]);
            }
            assert_eq!(host.listed(), [true; 3], "{order:?} {agent}");
        }
        // The local router closes the connection, and the other end does not answer.
        host.send(&to_other, &[0x03, 0x00]);
        report(&mut host.observer, &to_other, host.now, StreamEvent::End);
        let gone = [undeclare_token(1), undeclare_token(2)];
        host.send(&of_listener()[1], &frame(9, &gone));
        host.pass(3);
        assert_eq!(host.listed(), [false, false, true], "{order:?} {agent}");
    }
}

#[test]
fn a_session_with_another_path_outlives_one_of_three_routers() {
    for agent in [0, 3] {
        let order = [Step::Routers, Step::Listener, Step::Talker];
        let mut host = started(&order, agent);
        let third = (THIRD_ROUTER, Role::Router);
        match agent {
            0 => host.connect(to_third_router(), (ROUTER, Role::Router), third),
            _ => host.send(&to_third_router()[0], &[KEEP_ALIVE]),
        }
        host.send(&to_third_router()[1], &[KEEP_ALIVE]);
        host.wait(40);
        let [to_other, from_other] = to_other_router();
        report(&mut host.observer, &from_other, host.now, StreamEvent::End);
        report(&mut host.observer, &to_other, host.now, StreamEvent::End);
        host.pass(3);
        assert_eq!(host.listed(), [true; 3], "{agent}");
        // The last path ends.
        for stream in to_third_router() {
            report(&mut host.observer, &stream, host.now, StreamEvent::End);
        }
        let gone = [undeclare_token(1), undeclare_token(2)];
        host.send(&of_listener()[1], &frame(9, &gone));
        host.pass(3);
        assert_eq!(host.listed(), [false, false, true], "{agent}");
    }
}

#[test]
fn tokens_that_a_router_no_longer_lists_end_with_the_next_command() {
    let order = [Step::Routers, Step::Listener, Step::Talker];
    let mut host = started(&order, 3);
    assert_eq!(host.listed(), [true; 3]);
    // The far listener leaves, and the router undeclares its token by a number.
    host.send(&of_listener()[1], &frame(9, &[undeclare_token(2)]));
    let [there, back] = within([3005, 7447], [62, 72]);
    host.connect(
        [there, back],
        ([0x45; 16], Role::Peer),
        (ROUTER, Role::Router),
    );
    host.send(&there, &frame(8, &[interest(1, "@ros2_lv/0/**")]));
    host.declare(&back, 1, &talker());
    assert_eq!(host.listed(), [true; 3]);
    host.send(&back, &frame(9, &[answer_end(1)]));
    assert_eq!(host.listed(), [true, false, true]);
}

#[test]
fn sessions_whose_connections_others_closed_leave_no_tokens_after_their_lease() {
    let mut host = Host::observed(START);
    let tokens = |host: &Host| {
        let tables = host.observer.snapshot(Timestamp(host.now)).tables;
        let mut tables = tables.into_iter();
        tables
            .find(|table| table.table == "zenoh_tokens")
            .unwrap()
            .size
    };
    for restart in 1..=5_u8 {
        let session = [0x90 + restart; 16];
        let port = 1000 + u16::from(restart);
        let [to_router, from_router] = within([port, 7447], [200 + u64::from(restart), 71]);
        let router = (ROUTER, Role::Router);
        host.connect([to_router, from_router], (session, Role::Peer), router);
        host.declare(&to_router, 1, &publisher(session, 10, "/chatter"));
        host.declare(&to_router, 2, &publisher(session, 11, "/other"));
        for stream in [from_router, to_router] {
            report(&mut host.observer, &stream, host.now, StreamEvent::End);
        }
        host.pass(55);
        assert_eq!((tokens(&host), host.has(session)), (2, true), "{restart}");
        host.pass(6);
        assert_eq!((tokens(&host), host.has(session)), (0, false), "{restart}");
    }
}

#[test]
fn tokens_of_a_silent_session_stay_while_a_connection_declares_them() {
    let mut host = Host::observed(START);
    host.step(Step::Listener, &[]);
    host.pass(120);
    assert!(!host.has(LISTENER));
    // Its connection is open, so its next sign of life brings it back.
    host.send(&of_listener()[0], &[KEEP_ALIVE]);
    assert!(host.has(LISTENER));
}
