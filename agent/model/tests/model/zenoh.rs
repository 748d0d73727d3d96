//! Sessions of Zenoh: how they appear and end, and what hostile senders cannot do.

mod buffers;
mod processes;
mod robot;
mod routers;

use std::ops::Range;

use crate::allocator;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::watch::{Expectations, Retain, Watch, Watchlist};
use ros2probe_model::graph::discovery::Memory;
use ros2probe_model::graph::zenoh::{StreamEvent, Unseen, ZenohFacts};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot, TableFacts, TopicFacts};
use ros2probe_testing::zenoh::{
    Role, connection, declare_key, declare_token, fragment, frame, init, open, publisher, push,
    report, response, send, undeclare_token,
};
use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::zenoh::{Gid, ZenohId};

const START: u64 = 1_800_000_000 * SECOND;
const TALKER: [u8; 16] = [0x11; 16];
const ROUTER: [u8; 16] = [0x22; 16];
const LISTENER: [u8; 16] = [0x33; 16];
const LATE: [u8; 16] = [0x44; 16];
const KEEP_ALIVE: u8 = 0x04;
const KEY: &str = "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported";

fn observer() -> Observer {
    let mut observer = Observer::new(Settings::default());
    let watch = Watch {
        pattern: "/**".to_owned(),
        domain_id: None,
        expectations: Expectations::default(),
        per_subscriber: false,
        trace: 0.0,
        retain: Retain::None,
    };
    let watchlist = Watchlist::new(vec![watch]).unwrap();
    observer.input(Input::Watchlist(watchlist.into()));
    observer
}

/// Opens a connection from `one`, a peer, to `other`.
fn connect(observer: &mut Observer, port: u16, one: [u8; 16], (other, role): ([u8; 16], Role)) {
    let [there, back] = connection(port);
    report(observer, &there, START, StreamEvent::Begin);
    send(observer, &there, START, &init(one, Role::Peer, None));
    send(observer, &back, START, &init(other, role, Some(&[])));
    send(observer, &there, START, &open(60));
    send(observer, &back, START, &open(60));
}

/// A talker with a connection to a router and one to a listener, which it publishes to.
fn talking() -> (Observer, [u8; 16]) {
    let mut observer = observer();
    connect(&mut observer, 1000, TALKER, (ROUTER, Role::Router));
    connect(&mut observer, 1001, TALKER, (LISTENER, Role::Peer));
    let token = publisher(TALKER, 10, "/chatter");
    for port in [1000, 1001] {
        let [there, _] = connection(port);
        let declared = [declare_key(3, KEY), declare_token(1, &token)];
        send(&mut observer, &there, START, &frame(7, &declared));
    }
    (observer, Gid::of_token(&token).0)
}

/// Announces a subscription of the session that accepted this connection.
fn subscribe(observer: &mut Observer, port: u16, session: [u8; 16]) {
    let token = publisher(session, 11, "/chatter").replace("/MP/", "/MS/");
    let [_, back] = connection(port);
    let declared = [declare_token(1, &token)];
    send(observer, &back, START, &frame(7, &declared));
}

fn chatter(snapshot: &Snapshot) -> Option<&TopicFacts> {
    let mut topics = snapshot.topics.iter();
    topics.find(|topic| *topic.name == *"/chatter")
}

fn messages(observer: &Observer) -> u64 {
    let snapshot = observer.snapshot(Timestamp(START + SECOND));
    let measurement = chatter(&snapshot).and_then(|topic| topic.measurement.as_deref());
    measurement.map_or(0, |measurement| measurement.messages)
}

fn participants(observer: &Observer, at: u64) -> usize {
    observer.snapshot(Timestamp(at)).participants.len()
}

#[test]
fn a_message_on_two_connections_counts_once_and_reaches_only_the_peer() {
    let (mut observer, gid) = talking();
    subscribe(&mut observer, 1001, LISTENER);
    for number in 1..=10 {
        let batch = frame(8, &[push(3, gid, number, b"\0\x01\0\0\x06\0\0\0hello\0")]);
        for port in [1000, 1001] {
            let [there, _] = connection(port);
            send(&mut observer, &there, START + number, &batch);
        }
    }
    assert_eq!(messages(&observer), 10);
    let snapshot = observer.snapshot(Timestamp(START + SECOND));
    let received = chatter(&snapshot).unwrap().received.as_deref().unwrap();
    assert_eq!((received.messages, received.duplicates), (10, 0));
    // The router is not a subscriber.
    assert_eq!(received.unmatched, 0);
    assert_eq!(snapshot.participants.len(), 2);
}

#[test]
fn messages_before_the_token_of_their_writer_count_for_its_subscriber() {
    let mut observer = observer();
    connect(&mut observer, 1001, TALKER, (LISTENER, Role::Peer));
    subscribe(&mut observer, 1001, LISTENER);
    let token = publisher(TALKER, 10, "/chatter");
    let gid = Gid::of_token(&token).0;
    let [there, _] = connection(1001);
    let named = frame(7, &[declare_key(3, KEY)]);
    send(&mut observer, &there, START, &named);
    for number in 1..=20 {
        if number == 11 {
            let declared = frame(8, &[declare_token(1, &token)]);
            send(&mut observer, &there, START + number, &declared);
        }
        let batch = frame(9, &[push(3, gid, number, b"\0\x01\0\0")]);
        send(&mut observer, &there, START + number, &batch);
    }
    assert_eq!(messages(&observer), 20);
    let snapshot = observer.snapshot(Timestamp(START + SECOND));
    let received = chatter(&snapshot).unwrap().received.as_deref().unwrap();
    assert_eq!((received.messages, received.lost()), (20, 0));
}

/// The talker and a listener open a connection to each other at the same time. They keep both.
fn twice_connected() -> (Observer, [u8; 16]) {
    let mut observer = observer();
    connect(&mut observer, 1001, TALKER, (LISTENER, Role::Peer));
    connect(&mut observer, 1002, LISTENER, (TALKER, Role::Peer));
    subscribe(&mut observer, 1001, LISTENER);
    let token = publisher(TALKER, 10, "/chatter");
    let [there, _] = connection(1001);
    let declared = [declare_key(3, KEY), declare_token(1, &token)];
    send(&mut observer, &there, START, &frame(7, &declared));
    (observer, Gid::of_token(&token).0)
}

#[test]
fn aliases_apply_to_both_connections_of_two_sessions() {
    let (mut observer, gid) = twice_connected();
    // Samples with an unknown alias count as messages.
    let [there, _] = connection(1001);
    send(
        &mut observer,
        &there,
        START,
        &frame(8, &[declare_key(5, "not/of/ros")]),
    );
    let [_, there] = connection(1002);
    for number in 1..=10 {
        let pushes = [
            push(3, gid, number, b"\0\x01\0\0"),
            push(5, gid, 100 + number, b"\0\x01\0\0"),
        ];
        send(&mut observer, &there, START + number, &frame(9, &pushes));
    }
    assert_eq!(messages(&observer), 10);
}

#[test]
fn declarations_outlive_one_of_two_connections() {
    for (ending, rest) in [(1001, 1002), (1002, 1001)] {
        let (mut observer, gid) = twice_connected();
        for stream in connection(ending) {
            report(&mut observer, &stream, START, StreamEvent::End);
        }
        assert_eq!(participants(&observer, START), 2);
        assert!(chatter(&observer.snapshot(Timestamp(START))).is_some());
        let [one, other] = connection(rest);
        let there = if rest == 1001 { one } else { other };
        let batch = frame(8, &[push(3, gid, 1, b"\0\x01\0\0")]);
        send(&mut observer, &there, START + 1, &batch);
        assert_eq!(messages(&observer), 1);
        for stream in connection(rest) {
            report(&mut observer, &stream, START + 2, StreamEvent::End);
        }
        // The end that leaves the last connection first has ended.
        assert_eq!(participants(&observer, START + 2), 1);
    }
}

#[test]
fn declarations_outlive_a_new_session_on_one_of_two_connections() {
    let (mut observer, gid) = twice_connected();
    let [there, _] = connection(1001);
    let foreign = declare_key(5, "not/of/ros");
    send(&mut observer, &there, START, &frame(8, &[foreign]));
    send(&mut observer, &there, START, &init(LATE, Role::Peer, None));
    let [_, other] = connection(1002);
    for number in 1..=10 {
        let pushes = [3, 5].map(|alias| push(alias, gid, number, b"\0\x01\0\0"));
        send(&mut observer, &other, START + number, &frame(9, &pushes));
        // The new session has declared no alias, so its samples count as messages.
        let pushes = [push(5, gid, 20 + number, b"\0\x01\0\0")];
        send(&mut observer, &there, START + number, &frame(9, &pushes));
    }
    assert_eq!(messages(&observer), 20);
}

/// Returns the losses of the topic and of its receivers, after the talker has sent ten messages per
/// second. Messages with a `missing` number did not arrive. `gap` precedes the message after them.
fn lost(missing: Range<u64>, gap: Option<StreamEvent<'_>>) -> (u64, u64) {
    let (mut observer, gid) = talking();
    subscribe(&mut observer, 1001, LISTENER);
    let [there, _] = connection(1001);
    for number in (1..=30).filter(|number| !missing.contains(number)) {
        let at = START + number * SECOND / 10;
        if number == missing.end
            && let Some(gap) = gap
        {
            report(&mut observer, &there, at, gap);
        }
        let batch = frame(8, &[push(3, gid, number, b"\0\x01\0\0")]);
        send(&mut observer, &there, at, &batch);
    }
    observer.input(Input::Time(Timestamp(START + 20 * SECOND)));
    let snapshot = observer.snapshot(Timestamp(START + 20 * SECOND));
    let topic = chatter(&snapshot).unwrap();
    (
        topic.measurement.as_deref().unwrap().lost,
        topic.received.as_deref().unwrap().lost(),
    )
}

#[test]
fn a_number_that_a_congested_publisher_skipped_is_lost() {
    assert_eq!(lost(12..13, None), (1, 1));
}

#[test]
fn messages_in_a_gap_of_the_capture_are_not_lost() {
    assert_eq!(lost(12..15, Some(StreamEvent::Gap)), (0, 0));
}

#[test]
fn the_history_that_a_late_subscription_requests_is_delivered_to_it_only() {
    let (mut observer, gid) = talking();
    subscribe(&mut observer, 1001, LISTENER);
    let [there, _] = connection(1001);
    let payload = b"\0\x01\0\0";
    for number in 1..=5 {
        let at = START + number * SECOND / 10;
        send(
            &mut observer,
            &there,
            at,
            &frame(8, &[push(3, gid, number, payload)]),
        );
    }
    connect(&mut observer, 1002, TALKER, (LATE, Role::Peer));
    subscribe(&mut observer, 1002, LATE);
    let [there, _] = connection(1002);
    for number in 1..=5 {
        let at = START + 2 * SECOND + number;
        send(
            &mut observer,
            &there,
            at,
            &frame(8, &[response(KEY, gid, number, payload)]),
        );
    }
    let snapshot = observer.snapshot(Timestamp(START + 3 * SECOND));
    let topic = chatter(&snapshot).unwrap();
    let measurement = topic.measurement.as_deref().unwrap();
    assert_eq!((measurement.messages, measurement.duplicates), (5, 0));
    let received = topic.received.as_deref().unwrap();
    assert_eq!((received.messages, received.duplicates), (10, 0));
}

#[test]
fn a_session_ends_with_its_last_connection_and_not_with_the_router() {
    let (mut observer, _) = talking();
    let [to_router, from_router] = connection(1000);
    let [to_peer, from_peer] = connection(1001);
    let at = START + SECOND;
    // The router is restarted: it closes first, and the talker after it.
    report(&mut observer, &from_router, at, StreamEvent::End);
    report(&mut observer, &to_router, at, StreamEvent::End);
    assert_eq!(participants(&observer, at), 1);
    report(&mut observer, &to_peer, at + SECOND, StreamEvent::End);
    report(&mut observer, &from_peer, at + SECOND, StreamEvent::End);
    assert_eq!(participants(&observer, at + SECOND), 0);
}

#[test]
fn a_connection_whose_ends_were_both_silent_ends_once() {
    for first in [0, 1] {
        let (mut observer, _) = talking();
        // The host was asleep, or the agent without CPU time: no keep-alive arrived for its lease.
        let at = START + 58 * SECOND;
        let ends = connection(1001);
        report(&mut observer, &ends[first], at, StreamEvent::End);
        report(&mut observer, &ends[1 - first], at, StreamEvent::End);
        assert_eq!(participants(&observer, at), 1, "{first}");
    }
}

#[test]
fn a_restarted_agent_restores_the_senders_and_detects_the_end() {
    let (mut before, gid) = talking();
    subscribe(&mut before, 1001, LISTENER);
    let token = publisher(LISTENER, 10, "/status");
    // The listener is silent, and announced by the router only.
    let [_, from_router] = connection(1000);
    let declared = [declare_token(2, &token)];
    send(&mut before, &from_router, START, &frame(7, &declared));
    let remote = publisher([0x44; 16], 10, "/status");
    let declared = [declare_token(3, &remote)];
    send(&mut before, &from_router, START, &frame(8, &declared));
    let memory = before.memory();
    let text = serde_json::to_string(&memory).unwrap();
    let memory: Memory = serde_json::from_str(&text).unwrap();

    let mut after = observer();
    let start = START + 10 * SECOND;
    after.input(Input::Restored {
        memory: &memory,
        now: Timestamp(start),
    });
    assert_eq!(after.memory().zenoh, memory.zenoh);
    assert_eq!(participants(&after, start), 3);
    let [there, back] = connection(1001);
    let [to_router, from_router] = connection(1000);
    for number in 1..=5 {
        let at = start + number * 25 * SECOND;
        let batch = frame(9, &[push(3, gid, number, b"\0\x01\0\0")]);
        send(&mut after, &there, at, &batch);
        for silent in [&back, &to_router, &from_router] {
            send(&mut after, silent, at, &[KEEP_ALIVE]);
        }
    }
    let at = start + 150 * SECOND;
    let snapshot = after.snapshot(Timestamp(at));
    assert_eq!(snapshot.participants.len(), 3);
    assert_eq!(snapshot.zenoh.as_ref().unwrap().routers, 1);
    let topics = &snapshot.topics;
    let topic = topics.iter().find(|topic| *topic.name == *"/chatter");
    let deliveries = &topic.unwrap().deliveries;
    let listener = ZenohId::from_le_bytes(&LISTENER).unwrap().guid_prefix();
    assert_eq!(deliveries.len(), 1, "{deliveries:?}");
    assert!(format!("{deliveries:?}").contains(&listener.to_string()));

    // The listener's process is killed.
    report(&mut after, &back, at, StreamEvent::End);
    report(&mut after, &there, at, StreamEvent::End);
    assert_eq!(participants(&after, at), 2);
}

#[test]
fn restored_connections_without_traffic_keep_no_session() {
    let (before, _) = talking();
    let memory = before.memory();
    let mut after = observer();
    after.input(Input::Restored {
        memory: &memory,
        now: Timestamp(START),
    });
    // Another session has the address of the talker.
    connect(&mut after, 1000, [0x55; 16], (ROUTER, Role::Router));
    let at = START + 100 * SECOND;
    after.input(Input::Time(Timestamp(at)));
    assert_eq!(participants(&after, at), 0);
}

#[test]
fn an_undeclared_token_removes_its_endpoint_and_the_last_one_its_session() {
    let (mut observer, _) = talking();
    let [there, _] = connection(1000);
    let at = START + SECOND;
    send(&mut observer, &there, at, &frame(9, &[undeclare_token(1)]));
    let snapshot = observer.snapshot(Timestamp(at));
    assert_eq!((snapshot.participants.len(), snapshot.nodes.len()), (0, 0));
}

#[test]
fn fragments_become_one_message_unless_one_is_missing() {
    let (mut observer, gid) = talking();
    let [there, _] = connection(1001);
    let payload = vec![7; 100_000];
    for (number, missing) in [(1, None), (2, Some(1)), (3, None)] {
        let message = push(3, gid, number, &payload);
        let parts: Vec<_> = message.chunks(40_000).collect();
        for (index, part) in parts.iter().enumerate() {
            if missing == Some(index) {
                continue;
            }
            let sequence = u32::try_from(index).unwrap();
            let batch = fragment(sequence, index == 0, index + 1 < parts.len(), part);
            send(&mut observer, &there, START + number, &batch);
        }
    }
    assert_eq!(messages(&observer), 2);
    let snapshot = observer.snapshot(Timestamp(START + SECOND));
    assert!(snapshot.zenoh.as_ref().unwrap().counters.incomplete > 0);
    let measurement = chatter(&snapshot).unwrap().measurement.as_deref();
    assert_eq!(measurement.unwrap().bytes, 200_000);
}

#[test]
fn a_message_in_fragments_continues_after_the_highest_number_of_any_size() {
    // Sequence numbers have 7, 14 or 28 bits.
    for highest in [127, 16_383, (1 << 28) - 1] {
        let (mut observer, gid) = talking();
        let [there, _] = connection(1001);
        let message = push(3, gid, 1, &[7; 100_000]);
        let parts: Vec<_> = message.chunks(40_000).collect();
        for (index, part) in parts.iter().enumerate() {
            let number = [highest - 1, highest, 0][index];
            let batch = fragment(number, index == 0, index + 1 < parts.len(), part);
            send(&mut observer, &there, START + 1, &batch);
        }
        assert_eq!(messages(&observer), 1, "{highest}");
    }
}

// Coverage: Zenoh with compression | - | - | named
// Coverage: Zenoh, low-latency transport | - | - | named
#[test]
fn features_that_hide_messages_are_reported() {
    let mut observer = observer();
    for (port, extension, reason) in [
        (1, 0x06, Unseen::Compression),
        (2, 0x05, Unseen::LowLatency),
    ] {
        let [there, back] = connection(port);
        send(
            &mut observer,
            &there,
            START,
            &init(TALKER, Role::Peer, None),
        );
        send(
            &mut observer,
            &back,
            START,
            &init(ROUTER, Role::Router, Some(&[extension])),
        );
        let facts = observer.snapshot(Timestamp(START)).zenoh.unwrap();
        assert_eq!(unseen(&facts, reason), 1);
    }
    let mut other = init(TALKER, Role::Peer, None);
    other[1] = 8;
    let [there, _] = connection(3);
    send(&mut observer, &there, START, &other);
    report(
        &mut observer,
        &there,
        START,
        StreamEvent::Unseen(Unseen::Tls),
    );
    let facts = observer.snapshot(Timestamp(START)).zenoh.unwrap();
    assert_eq!(unseen(&facts, Unseen::Version), 1);
    assert_eq!(unseen(&facts, Unseen::Tls), 1);
    report(&mut observer, &there, START, StreamEvent::End);
    let facts = observer.snapshot(Timestamp(START)).zenoh.unwrap();
    assert_eq!(unseen(&facts, Unseen::Tls), 0);
}

#[test]
fn an_encrypted_connection_counts_until_it_ends() {
    let mut observer = observer();
    let [there, _] = connection(3);
    for (event, count) in [(StreamEvent::Unseen(Unseen::Tls), 1), (StreamEvent::End, 0)] {
        report(&mut observer, &there, START, event);
        let facts = observer.snapshot(Timestamp(START)).zenoh;
        assert_eq!(facts.map_or(0, |facts| unseen(&facts, Unseen::Tls)), count);
    }
}

fn unseen(facts: &ZenohFacts, reason: Unseen) -> u64 {
    let known = facts.unseen().find(|(other, _)| *other == reason);
    known.map_or(0, |(_, connections)| connections)
}

/// Asserts that every table stays within its cap.
fn assert_bounded(observer: &Observer) {
    let tables = observer.snapshot(Timestamp(START)).tables;
    assert!(tables.iter().all(|table| table.size <= table.limit));
    let ledger = ledger();
    let chains = ledger.get("zenoh.chains.bytes");
    assert!(chains.is_none_or(|used| used.largest <= used.cap));
}

/// Returns the size of a table in the snapshot.
fn table(observer: &Observer, name: &str) -> TableFacts {
    let tables = observer.snapshot(Timestamp(START)).tables;
    let mut tables = tables.into_iter();
    tables.find(|table| table.table == name).unwrap()
}

#[test]
fn new_connections_replace_those_with_the_longest_silence() {
    let mut observer = observer();
    for number in 0..6000_u32 {
        let [mut there, _] = connection(1);
        there.interface = number;
        send(
            &mut observer,
            &there,
            START + u64::from(number),
            &init(TALKER, Role::Peer, None),
        );
    }
    assert_bounded(&observer);
    let directions = table(&observer, "zenoh_directions");
    assert!(directions.evictions >= 1900, "{directions:?}");
}

#[test]
fn aliases_tokens_and_keys_beyond_their_caps_are_left_out() {
    let mut observer = observer();
    connect(&mut observer, 1000, TALKER, (ROUTER, Role::Router));
    let [there, _] = connection(1000);
    for port in 2000..2003 {
        let [there, _] = connection(port);
        for id in 0..17_000_u16 {
            send(
                &mut observer,
                &there,
                START,
                &frame(1, &[declare_key(id + 1, KEY)]),
            );
        }
    }
    let long = format!("0/{}/t/TypeHashNotSupported", "a".repeat(60_000));
    send(
        &mut observer,
        &there,
        START,
        &frame(1, &[declare_key(60_000, &long)]),
    );
    for entity in 0..40_000 {
        let token = publisher(TALKER, entity, "/chatter");
        send(
            &mut observer,
            &there,
            START,
            &frame(1, &[declare_token(entity + 1, &token)]),
        );
    }
    assert_bounded(&observer);
    let aliases = table(&observer, "zenoh_aliases");
    assert!(aliases.evictions > 7000, "{aliases:?}");
    let tokens = table(&observer, "zenoh_tokens");
    assert!(tokens.evictions > 20_000, "{tokens:?}");
}

#[test]
fn a_token_declared_on_many_connections_is_one_session() {
    let mut observer = observer();
    let token = publisher(TALKER, 10, "/chatter");
    for port in 0..100 {
        let [there, _] = connection(port);
        send(
            &mut observer,
            &there,
            START,
            &frame(1, &[declare_token(1, &token)]),
        );
    }
    assert_bounded(&observer);
    assert_eq!(participants(&observer, START), 1);
}

/// Returns the bytes that the model holds after `attack` on each of 4096 connections. `attack` gets
/// the model and the number of the connection.
fn bytes_after(attack: impl Fn(&mut Observer, u16)) -> usize {
    let before = allocator::held();
    let mut observer = observer();
    for port in 0..4096 {
        attack(&mut observer, port);
    }
    assert_bounded(&observer);
    observer.input(Input::Time(Timestamp(START + SECOND)));
    let held = allocator::held() - before;
    let mut tables = observer.snapshot(Timestamp(START)).tables.into_iter();
    assert!(tables.all(|table| table.bytes.is_none_or(|(bytes, cap)| bytes <= cap)));
    held
}

#[test]
fn long_aliases_on_all_connections_take_a_few_megabytes() {
    let held = bytes_after(|observer, port| {
        let [there, _] = connection(port);
        for id in 1..100 {
            let key = format!("0/{id}{}/t/TypeHashNotSupported", "a".repeat(2000));
            send(observer, &there, START, &frame(1, &[declare_key(id, &key)]));
        }
    });
    println!("{held} bytes");
    assert!(held < 16 << 20, "{held} bytes");
}

#[test]
fn long_tokens_of_forged_sessions_on_all_connections_take_a_few_megabytes() {
    let held = bytes_after(|observer, port| {
        let [there, _] = connection(port);
        for id in 1..10 {
            let mut session = TALKER;
            session[..2].copy_from_slice(&port.to_le_bytes());
            session[2] = u8::try_from(id).unwrap();
            let topic = format!("/t{}", "a".repeat(200));
            let token = publisher(session, id, &topic);
            let token = token.replace("/talker/", &format!("/{}/", "n".repeat(1400)));
            send(
                observer,
                &there,
                START,
                &frame(1, &[declare_token(id, &token)]),
            );
        }
    });
    println!("{held} bytes");
    // Discovery and its changes hold the announcements, too.
    assert!(held < 40 << 20, "{held} bytes");
}

#[test]
fn stale_fragments_are_dropped_for_a_large_message() {
    let (mut observer, gid) = talking();
    let part = vec![7; 60_000];
    for port in 100..140 {
        let [there, _] = connection(port);
        // Requests are kept whole.
        let mut first = vec![0x1c, 1, 0, 0x03];
        first.extend_from_slice(&part[..50_000]);
        send(
            &mut observer,
            &there,
            START,
            &fragment(0, true, true, &first),
        );
        for number in 1..20 {
            send(
                &mut observer,
                &there,
                START,
                &fragment(number, false, true, &part),
            );
        }
    }
    assert_bounded(&observer);
    let incomplete = |observer: &Observer| {
        let facts = observer.snapshot(Timestamp(START)).zenoh;
        facts.map_or(0, |facts| facts.counters.incomplete)
    };
    assert!(ledger()["zenoh.chains.bytes"].largest > 19 << 20);
    let before = incomplete(&observer);
    let [there, _] = connection(1000);
    let message = push(3, gid, 1, &part);
    send(
        &mut observer,
        &there,
        START + 11 * SECOND,
        &fragment(0, true, true, &message),
    );
    // The messages that wait are given up.
    assert!(incomplete(&observer) > before);
}

#[test]
fn the_number_of_routers_that_forward_tokens_is_bounded() {
    let mut observer = observer();
    for number in 0..400_u16 {
        let mut router = ROUTER;
        router[..2].copy_from_slice(&number.to_le_bytes());
        connect(&mut observer, number, TALKER, (router, Role::Router));
        let [_, back] = connection(number);
        let token = publisher(LATE, 10, "/chatter");
        let declared = [declare_token(1, &token)];
        send(&mut observer, &back, START, &frame(1, &declared));
        for stream in connection(number) {
            report(&mut observer, &stream, START, StreamEvent::End);
        }
        assert_bounded(&observer);
    }
    assert_eq!(table(&observer, "zenoh_passages").size, 256);
}

#[test]
fn messages_with_endless_fragments_are_bounded() {
    let (mut observer, gid) = talking();
    let requests = Vec::new();
    observer.input(Input::SampleRequests(std::sync::Arc::new(requests)));
    let part = vec![7; 60_000];
    for port in 0..8 {
        let [there, _] = connection(port);
        // A request that never ends is kept whole up to its maximum size.
        let mut first = vec![0x1c, 1, 0, 0x03];
        first.extend_from_slice(&part[..50_000]);
        let message = push(3, gid, 1, &part);
        let begin = if port % 2 == 0 { &message } else { &first };
        send(
            &mut observer,
            &there,
            START,
            &fragment(0, true, true, begin),
        );
        for number in 1..700 {
            send(
                &mut observer,
                &there,
                START,
                &fragment(number, false, true, &part),
            );
        }
    }
    assert_bounded(&observer);
}

#[test]
fn the_number_of_unseen_connections_is_bounded() {
    let mut observer = observer();
    for number in 0..2000_u32 {
        let [mut there, _] = connection(1);
        there.flow.source.address[0] = u8::try_from(number % 256).unwrap();
        there.flow.source.address[1] = u8::try_from(number / 256).unwrap();
        report(
            &mut observer,
            &there,
            START,
            StreamEvent::Unseen(Unseen::Tls),
        );
    }
    assert_bounded(&observer);
    let facts = observer.snapshot(Timestamp(START)).zenoh.unwrap();
    assert_eq!(unseen(&facts, Unseen::Tls), 1024);
}

proptest::proptest! {
    #[test]
    fn arbitrary_batches_keep_all_tables_within_their_caps(
        batches in proptest::collection::vec(
            (0..4_u16, proptest::bool::ANY, proptest::collection::vec(proptest::num::u8::ANY, 0..120)),
            0..100,
        )
    ) {
        let (mut observer, _) = talking();
        for (port, is_back, batch) in &batches {
            let [there, back] = connection(999 + port);
            let stream = if *is_back { back } else { there };
            send(&mut observer, &stream, START, batch);
            let message = frame(1, std::slice::from_ref(batch));
            send(&mut observer, &stream, START, &message);
        }
        assert_bounded(&observer);
    }
}
