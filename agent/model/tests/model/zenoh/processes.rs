//! Identification of a session's process by its sockets, even on connections older than the agent.

use std::sync::Arc;

use ros2probe_model::graph::zenoh::{StreamEvent, StreamId};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::{Direction, SocketFacts};
use ros2probe_testing::zenoh::{
    Role, connection, declare_key, declare_token, frame, init, publisher, push, report, send,
};
use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::zenoh::{Gid, ZenohId};

use super::{
    KEEP_ALIVE, KEY, LATE, LISTENER, ROUTER, START, TALKER, chatter, messages, observer,
    participants, talking,
};

/// Returns the direction as seen at the socket of its sender.
fn at_socket(stream: StreamId, socket: u64) -> StreamId {
    StreamId {
        socket,
        outgoing: true,
        ..stream
    }
}

/// Reports the process that holds a socket.
pub(super) fn hold(observer: &mut Observer, cookie: u64, process: u32) {
    observer.input(Input::Socket(SocketFacts {
        cookie,
        process_id: Some(process),
        process: Some("talker".into()),
        cgroup: Some("/robot".into()),
        ..SocketFacts::default()
    }));
}

/// Returns process id, name and control group of the talker's session.
fn process(observer: &Observer) -> (Option<u32>, Option<String>, Option<String>) {
    let snapshot = observer.snapshot(Timestamp(START + 10 * SECOND));
    let prefix = ZenohId::from_le_bytes(&TALKER).unwrap().guid_prefix();
    let mut participants = snapshot.participants.iter();
    let process = &participants
        .find(|each| each.guid.prefix == prefix)
        .unwrap()
        .process;
    let text = |text: &Option<Arc<str>>| text.as_ref().map(ToString::to_string);
    (process.id, text(&process.name), text(&process.cgroup))
}

fn held(process: u32) -> (Option<u32>, Option<String>, Option<String>) {
    let (name, cgroup) = ("talker".to_owned(), "/robot".to_owned());
    (Some(process), Some(name), Some(cgroup))
}

#[test]
fn a_session_runs_in_the_process_that_sends_its_init() {
    let mut observer = observer();
    let [there, back] = connection(1000);
    let [there, back] = [at_socket(there, 8), at_socket(back, 9)];
    hold(&mut observer, 9, 900);
    send(
        &mut observer,
        &there,
        START,
        &init(TALKER, Role::Peer, None),
    );
    let ack = init(ROUTER, Role::Router, Some(&[]));
    send(&mut observer, &back, START, &ack);
    // The first node appears seconds later, and the process is found later still.
    let at = START + 5 * SECOND;
    let token = publisher(TALKER, 10, "/chatter");
    let declared = frame(7, &[declare_key(3, KEY), declare_token(1, &token)]);
    send(&mut observer, &there, at, &declared);
    // The router repeats the token.
    send(&mut observer, &back, at, &declared);
    assert_eq!(process(&observer), (None, None, None));
    hold(&mut observer, 8, 800);
    assert_eq!(process(&observer), held(800));
}

#[test]
fn a_session_whose_init_was_missed_runs_in_the_process_that_sends_its_messages() {
    let sending = |source: u16, outgoing| {
        let (mut observer, gid) = talking();
        let [mut there, _] = connection(source);
        there = at_socket(there, 8);
        there.outgoing = outgoing;
        hold(&mut observer, 8, 800);
        let batch = |number| frame(8, &[push(3, gid, number, b"\0\x01\0\0")]);
        for number in 1..=2 {
            send(&mut observer, &there, START, &batch(number));
        }
        assert_eq!(process(&observer).0, None);
        send(&mut observer, &there, START, &batch(3));
        (observer, there)
    };
    let (mut observer, there) = sending(1002, true);
    assert_eq!(process(&observer), held(800));
    // A publication of another source shows that the sender is a router.
    let token = publisher(LISTENER, 10, "/chatter");
    let declared = frame(9, &[declare_token(2, &token)]);
    send(&mut observer, &connection(1001)[1], START, &declared);
    let other = frame(10, &[push(3, Gid::of_token(&token).0, 1, b"\0\x01\0\0")]);
    send(&mut observer, &there, START, &other);
    assert_eq!(process(&observer).0, None);
    let (from_router, received) = (sending(7447, true).0, sending(1002, false).0);
    assert_eq!(process(&from_router).0, None, "a router passes messages on");
    assert_eq!(process(&received).0, None, "the receiver's process");
}

#[test]
fn a_process_stays_known_when_the_connection_that_identified_it_ends() {
    let (mut observer, _) = talking();
    let [short, _] = connection(1002);
    let [short, long] = [at_socket(short, 8), at_socket(connection(1003)[0], 9)];
    hold(&mut observer, 8, 800);
    hold(&mut observer, 9, 800);
    send(
        &mut observer,
        &short,
        START,
        &init(TALKER, Role::Peer, None),
    );
    send(&mut observer, &long, START, &[4]);
    report(&mut observer, &short, START, StreamEvent::End);
    observer.input(Input::SocketClosed(8));
    assert_eq!(process(&observer), held(800));
    observer.input(Input::SocketClosed(9));
    assert_eq!(process(&observer).0, None);
}

/// A connection between the sockets of two processes of this host, as seen by the sending sockets.
fn between(ports: [u16; 2], sockets: [u64; 2]) -> [StreamId; 2] {
    let [mut there, _] = connection(ports[0]);
    there.flow.destination.port = ports[1];
    let [one, other] = sockets;
    [at_socket(there, one), at_socket(there.reversed(), other)]
}

/// A robot that is older than the agent: the talker (process 800) publishes to the listener
/// (process 900), which sends nothing but KEEP_ALIVEs. Both are connected to a router (process
/// 700). Then another session joins. The new session receives the tokens from the router, and the
/// listener connects to the new session.
fn joined(routers: &[u16]) -> (Observer, [u8; 16]) {
    let mut observer = observer();
    let silent = [
        between([1000, 7447], [80, 70])[0],
        between([1001, 2000], [81, 90])[1],
    ];
    let to_routers = routers
        .iter()
        .zip(91..)
        .map(|(port, socket)| between([*port, 7447], [socket, socket - 20])[0]);
    for stream in silent.into_iter().chain(to_routers) {
        send(&mut observer, &stream, START, &[KEEP_ALIVE]);
        let process = u32::try_from(stream.socket).unwrap() / 10 * 100;
        hold(&mut observer, stream.socket, process);
    }
    let [there, back] = between([3000, 7447], [60, 79]);
    send(&mut observer, &there, START, &init(LATE, Role::Peer, None));
    let ack = init(ROUTER, Role::Router, Some(&[]));
    send(&mut observer, &back, START, &ack);
    let talker = publisher(TALKER, 10, "/chatter");
    let listener = publisher(LISTENER, 11, "/chatter").replace("/MP/", "/MS/");
    let declared = [declare_token(1, &talker), declare_token(2, &listener)];
    send(&mut observer, &back, START, &frame(7, &declared));
    let [from_listener, to_listener] = between([2001, 3001], [95, 61]);
    hold(&mut observer, 95, 900);
    let first = init(LISTENER, Role::Peer, None);
    send(&mut observer, &from_listener, START, &first);
    let ack = init(LATE, Role::Peer, Some(&[]));
    send(&mut observer, &to_listener, START, &ack);
    assert!(observer.awaits_holders());
    observer.input(Input::SocketsRead);
    assert!(!observer.awaits_holders());
    // The other session leaves.
    for stream in [there, back, to_listener, from_listener] {
        report(&mut observer, &stream, START + 2 * SECOND, StreamEvent::End);
    }
    (observer, Gid::of_token(&talker).0)
}

/// Publishes ten messages of the talker. Returns the number delivered to the listener's session.
fn delivered(observer: &mut Observer, gid: [u8; 16]) -> u64 {
    let [there, _] = between([1001, 2000], [81, 90]);
    for number in 1..=10 {
        let at = START + 3 * SECOND + number * SECOND / 100;
        let batch = frame(8, &[push(3, gid, number, b"\0\x01\0\0")]);
        send(observer, &there, at, &batch);
    }
    assert_eq!(messages(observer), 10);
    let snapshot = observer.snapshot(Timestamp(START + 4 * SECOND));
    let listener = ZenohId::from_le_bytes(&LISTENER).unwrap().guid_prefix();
    let deliveries = &chatter(&snapshot).unwrap().deliveries;
    let to_listener = deliveries.iter().filter(|delivery| {
        let receiver = delivery.participant.map(|guid| guid.prefix);
        delivery.direction == Direction::Received && receiver == Some(listener)
    });
    to_listener
        .inspect(|delivery| assert_eq!(delivery.process_id, Some(900)))
        .map(|delivery| delivery.delivered.messages)
        .sum()
}

#[test]
fn the_only_session_of_a_process_sends_on_its_older_connections() {
    let (mut observer, gid) = joined(&[2002]);
    assert_eq!(delivered(&mut observer, gid), 10);
    assert_eq!(participants(&observer, START + 4 * SECOND), 2);
    // The listener's process is killed.
    let at = START + 5 * SECOND;
    for stream in [
        between([1001, 2000], [81, 90])[1],
        between([2002, 7447], [91, 71])[0],
    ] {
        report(&mut observer, &stream, at, StreamEvent::End);
    }
    assert_eq!(participants(&observer, at), 1);
}

#[test]
fn connections_of_a_process_with_several_sessions_have_unknown_senders() {
    for routers in [&[2002, 2003][..], &[]] {
        let (mut observer, gid) = joined(routers);
        assert_eq!(delivered(&mut observer, gid), 0, "{routers:?}");
        assert_eq!(participants(&observer, START + 4 * SECOND), 2);
    }
}

#[test]
fn a_process_that_forwards_publications_has_no_single_session() {
    let (mut observer, gid) = joined(&[2002]);
    let [_, back] = between([1001, 2000], [81, 90]);
    let at = START + 3 * SECOND;
    send(
        &mut observer,
        &back,
        at,
        &frame(8, &[push(3, gid, 1, b"\0\x01\0\0")]),
    );
    observer.input(Input::Time(Timestamp(at + SECOND)));
    let listener = ZenohId::from_le_bytes(&LISTENER).unwrap();
    let snapshot = observer.snapshot(Timestamp(at));
    assert!(
        snapshot
            .participants
            .iter()
            .any(|each| each.guid.prefix == listener.guid_prefix())
    );
    assert_eq!(delivered(&mut observer, gid), 0);
}
