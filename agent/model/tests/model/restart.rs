//! Restart of the agent on a running robot: saved state is restored, and stays only if it is still
//! valid.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Duration;

use proptest::prelude::*;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::watch::{Expectations, Watch, Watchlist};
use ros2probe_model::graph::discovery::Memory;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;
const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");
const LEASE: u32 = 10;

fn agent(settings: Settings) -> Observer {
    let mut observer = Observer::new(settings);
    let watch = Watch::named("/**").unwrap();
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![watch]).unwrap(),
    )));
    observer
}

fn put(observer: &mut Observer, at: u64, message: Message) {
    let envelope = forge::multicast(at, 3);
    observer.input(Input::Datagram {
        envelope: &envelope,
        payload: &message.bytes(),
        handover: None,
    });
}

fn spdp(prefix: GuidPrefix) -> Message {
    let address = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 8162);
    let payload = forge::participant_at(prefix, LEASE, None, &[address]);
    Message::from(prefix).data(SPDP, 1, &payload)
}

/// Announces a robot of two participants to an agent.
fn robot(observer: &mut Observer) {
    robot_at(observer, START);
}

fn robot_at(observer: &mut Observer, start: u64) {
    for (prefix, node) in [(ALICE, "lidar"), (BOB, "mapper")] {
        put(observer, start, spdp(prefix));
        let string = "std_msgs::msg::dds_::String_";
        let ends = [
            (WRITER, SEDP_WRITERS, "rt/points"),
            (READER, SEDP_READERS, "rt/cmd"),
            (NODES, SEDP_WRITERS, "ros_discovery_info"),
        ];
        for (entity, sedp, topic) in ends {
            let guid = Guid::new(prefix, entity);
            let payload = forge::endpoint(guid, topic, string, true);
            put(
                observer,
                start,
                Message::from(prefix).data(sedp, 7, &payload),
            );
        }
        let writer = Guid::new(prefix, WRITER);
        let payload = forge::entities(prefix, 24, &[("/", node, writer)]);
        put(
            observer,
            start,
            Message::from(prefix).data(NODES, 4, &payload),
        );
    }
    observer.input(Input::Time(Timestamp(start + SECOND)));
}

/// Returns the displayed state of the robot, without times and without the mark of restored
/// entries.
fn shown(observer: &Observer, at: u64) -> String {
    let Snapshot {
        mut participants,
        nodes,
        topics,
        ..
    } = observer.snapshot(Timestamp(at));
    for participant in &mut participants {
        (participant.first_seen, participant.last_seen) = (ModelTime::ZERO, ModelTime::ZERO);
        participant.restored = false;
    }
    let endpoints: Vec<_> = topics
        .iter()
        .flat_map(|topic| topic.publishers.iter().chain(&topic.subscriptions))
        .map(|end| {
            let mut end = end.clone();
            (end.first_seen, end.measurement) = (ModelTime::ZERO, None);
            end
        })
        .collect();
    let topics: Vec<_> = topics
        .iter()
        .map(|topic| {
            (
                topic.domain_id,
                &topic.name,
                &topic.message_types,
                topic.kind,
            )
        })
        .collect();
    format!("{participants:#?}{nodes:#?}{topics:#?}{endpoints:#?}")
}

fn unconfirmed(observer: &Observer) -> usize {
    let snapshot = observer.snapshot(Timestamp(START));
    let participants = snapshot.participants.iter();
    participants
        .filter(|participant| participant.restored)
        .count()
}

fn restarted(memory: &Memory, at: u64) -> Observer {
    let mut observer = agent(Settings::default());
    observer.input(Input::Restored {
        memory,
        now: Timestamp(at),
    });
    observer
}

#[test]
fn a_restart_restores_all_displayed_state_and_the_kernel_filter() {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let text = serde_json::to_string(&before.memory()).unwrap();
    let memory: Memory = serde_json::from_str(&text).unwrap();
    let at = START + 60 * SECOND;
    let mut after = restarted(&memory, at);
    assert_eq!(shown(&after, at), shown(&before, at));
    assert!(shown(&after, at).contains("10.0.0.1:8162"));
    assert_eq!(after.memory(), memory);
    assert_eq!(unconfirmed(&after), 2);
    let wanted = |guid| match guid {
        Guid { entity: NODES, .. } => Verdict::Capture,
        _ => Verdict::Meter,
    };
    let mut reported = after.drain().interest;
    reported.sort_unstable_by_key(|(guid, _)| *guid);
    let all = [ALICE, BOB].map(|prefix| [NODES, WRITER, READER].map(|it| Guid::new(prefix, it)));
    let all: Vec<_> = all
        .as_flattened()
        .iter()
        .map(|it| (*it, Some(wanted(*it))))
        .collect();
    assert_eq!(reported, all);
    let churn = after.snapshot(Timestamp(at)).churn;
    assert!(churn.is_empty(), "nothing happened to the robot: {churn:?}");
}

#[test]
fn a_restored_participant_stays_only_if_it_sends_within_its_lease() {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let at = START + 60 * SECOND;
    let mut after = restarted(&before.memory(), at);
    after.input(Input::Time(Timestamp(at + 9 * SECOND)));
    assert_eq!(after.snapshot(Timestamp(at)).participants.len(), 2);
    put(&mut after, at + 9 * SECOND, spdp(BOB));
    assert_eq!(unconfirmed(&after), 1);
    after.input(Input::Time(Timestamp(at + 11 * SECOND)));
    let snapshot = after.snapshot(Timestamp(at + 11 * SECOND));
    assert_eq!((snapshot.participants.len(), unconfirmed(&after)), (1, 0));
    assert_eq!(snapshot.participants[0].guid.prefix, BOB);
    assert_eq!(snapshot.nodes.len(), 1);
    assert_eq!(snapshot.nodes[0].name, "/mapper");
    assert!(snapshot.unknown_writers.is_empty());
}

/// Returns the states of `/points` after a restart. As in the daemon, watches follow the saved
/// state.
fn states_after_restart(expectations: Expectations, messages: impl Fn(u64) -> bool) -> Vec<String> {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let mut states = Vec::new();
    for delay in [0, 650, 935, 999] {
        let at = START + 60 * SECOND + delay * MILLISECOND;
        let mut after = Observer::new(Settings::default());
        after.input(Input::Restored {
            memory: &before.memory(),
            now: Timestamp(at),
        });
        let watch = Watch {
            expectations,
            ..Watch::named("/points").unwrap()
        };
        let watchlist = Watchlist::new(vec![watch]).unwrap();
        after.input(Input::Watchlist(Arc::new(watchlist)));
        let reader = forge::endpoint(
            Guid::new(BOB, EntityId([0, 0, 0x14, 0x04])),
            "rt/points",
            "std_msgs::msg::dds_::String_",
            true,
        );
        put(
            &mut after,
            at,
            Message::from(BOB).data(SEDP_READERS, 9, &reader),
        );
        for step in 1..150 {
            let now = at + step * 100 * MILLISECOND;
            for prefix in [ALICE, BOB] {
                put(&mut after, now, spdp(prefix));
            }
            if messages(step) {
                let sample = Message::from(ALICE).data(WRITER, 100 + step, &[0, 1, 0, 0]);
                put(&mut after, now, sample);
            }
            after.input(Input::Time(Timestamp(now)));
            for event in after.drain().events.events {
                if let EventKind::Expectation { to, violations, .. } = event.kind {
                    let elapsed = (event.at.0 - at) / SECOND;
                    states.push(format!("{} {violations:?} {elapsed}", to.label()));
                }
            }
        }
    }
    states
}

#[test]
fn a_restart_on_a_running_robot_reports_no_earlier_silence() {
    let silence = Expectations {
        max_silence: Some(Duration::from_millis(6250)),
        ..Expectations::default()
    };
    // A message each 4.9 s, the first one 3 s after the restart.
    let slow = states_after_restart(silence, |step| step % 49 == 30);
    assert_eq!(slow, Vec::<String>::new());
    // A publisher that stopped is silent as soon as the agent can know it.
    let stopped = states_after_restart(silence, |_| false);
    let silent: Vec<_> = stopped
        .iter()
        .filter(|it| it.starts_with("silent"))
        .collect();
    assert_eq!(silent.len(), 4, "{stopped:?}");
    assert!(
        silent
            .iter()
            .all(|it| it.ends_with(" 6") || it.ends_with(" 7"))
    );
}

/// Returns the number of seconds after which a topic of Fast DDS without messages counts as silent.
/// Its reader on the writer's host receives at locators of these kinds. `other_is_remote` adds a
/// reader on another host.
fn silent_after(reader_locators: &[u32], other_is_remote: bool) -> Option<u64> {
    let talker = GuidPrefix(*b"\x01\x0fHHpid10000");
    let listener = GuidPrefix(*b"\x01\x0fHHpid20000");
    let remote = GuidPrefix(*b"\x01\x0fRRpid30000");
    let mut observer = Observer::new(Settings::default());
    let watch = Watch {
        expectations: Expectations {
            max_silence: Some(Duration::from_secs(2)),
            ..Expectations::default()
        },
        ..Watch::named("/beat").unwrap()
    };
    let watchlist = Watchlist::new(vec![watch]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watchlist)));
    let locator = |kind: &u32| [&kind.to_le_bytes()[..], &[1; 20]].concat();
    let ends = [
        (talker, WRITER, SEDP_WRITERS, vec![16, 1]),
        (listener, READER, SEDP_READERS, reader_locators.to_vec()),
        (remote, READER, SEDP_READERS, vec![16, 1]),
    ];
    let there = if other_is_remote { 3 } else { 2 };
    for (prefix, entity, sedp, kinds) in ends.iter().take(there) {
        let guid = Guid::new(*prefix, *entity);
        let locators: Vec<_> = kinds.iter().map(locator).collect();
        let locators = locators.iter().map(|value| (0x2f, &value[..]));
        let reliable = [&2u32.to_le_bytes()[..], &[0; 8]].concat();
        let list: Vec<_> = locators.chain([(0x1a, &reliable[..])]).collect();
        let payload = forge::endpoint_with(guid, "rt/beat", "std_msgs::msg::dds_::Empty_", &list);
        let message = Message::from_fast(*prefix).data(*sedp, 7, &payload);
        put(&mut observer, START, message);
    }
    for second in 1..300 {
        let now = Timestamp(START + second * SECOND);
        for (prefix, ..) in ends.iter().take(there) {
            let mut payload = forge::participant(*prefix, LEASE, None);
            let vendor = payload
                .windows(6)
                .position(|six| six == [0x16, 0, 4, 0, 1, 0x10]);
            payload[vendor.unwrap() + 5] = 0x0f;
            let message = Message::from_fast(*prefix).data(SPDP, second, &payload);
            put(&mut observer, now.0, message);
        }
        observer.input(Input::Time(now));
        let events = observer.drain().events.events;
        let is_silent = |kind: &EventKind| matches!(kind, EventKind::Expectation { to, .. } if to.label() == "silent");
        if events.iter().any(|event| is_silent(&event.kind)) {
            return Some(second);
        }
    }
    None
}

#[test]
fn a_writer_that_polling_has_not_seen_yet_is_not_immediately_silent() {
    // 131 messages in a row, of which polling is assumed to see every tenth.
    let polled = silent_after(&[16, 1], false);
    assert!(
        polled.is_some_and(|after| (262..266).contains(&after)),
        "{polled:?}"
    );
    // The agent immediately sees messages on the network.
    for (locators, other_is_remote) in [(&[1][..], false), (&[16, 1], true)] {
        let seen = silent_after(locators, other_is_remote);
        assert!(seen.is_some_and(|after| after <= 5), "{seen:?}");
    }
}

#[test]
fn subscribers_have_time_to_be_announced_after_a_restart() {
    let three = Expectations {
        subscribers: Some(3),
        ..Expectations::default()
    };
    let states = states_after_restart(three, |_| true);
    assert_eq!(states.len(), 4, "{states:?}");
    assert!(
        states
            .iter()
            .all(|it| it.ends_with(" 10") || it.ends_with(" 11")),
        "{states:?}"
    );
}

#[test]
fn a_robot_whose_clock_begins_in_1970_appears_and_expires_as_usual() {
    // A Raspberry Pi has no battery-backed clock, and the agent starts before NTP.
    for start in [1, SECOND, 30 * SECOND] {
        let mut observer = agent(Settings::default());
        robot_at(&mut observer, start);
        let count = |observer: &Observer, at| {
            let snapshot = observer.snapshot(Timestamp(at));
            (snapshot.participants.len(), snapshot.nodes.len())
        };
        assert_eq!(count(&observer, start + SECOND), (2, 2), "{start}");
        let memory = observer.memory();
        observer.input(Input::Time(Timestamp(start + 9 * SECOND)));
        assert_eq!(count(&observer, start + 9 * SECOND), (2, 2), "{start}");
        observer.input(Input::Time(Timestamp(start + 11 * SECOND)));
        assert_eq!(count(&observer, start + 11 * SECOND), (0, 0), "{start}");
        // The agent restarts before the clock is set.
        let mut after = restarted(&memory, start);
        after.input(Input::Time(Timestamp(start + 9 * SECOND)));
        assert_eq!(count(&after, start + 9 * SECOND), (2, 2), "{start}");
        after.input(Input::Time(Timestamp(start + 11 * SECOND)));
        assert_eq!(count(&after, start + 11 * SECOND), (0, 0), "{start}");
    }
}

#[test]
fn only_messages_after_the_start_confirm_a_restored_participant() {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let at = START + 60 * SECOND;
    let mut after = restarted(&before.memory(), at);
    after.input(Input::ParticipantAlive(ALICE, Timestamp(at - SECOND)));
    assert_eq!(unconfirmed(&after), 2);
    after.input(Input::ParticipantAlive(ALICE, Timestamp(at + SECOND)));
    assert_eq!(unconfirmed(&after), 1);
    let sample = Message::from(BOB).data(WRITER, 9, &[0, 1, 0, 0]);
    put(&mut after, at + SECOND, sample);
    assert_eq!(unconfirmed(&after), 0);
}

#[test]
fn an_older_list_of_nodes_does_not_replace_the_restored_one() {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let at = START + 60 * SECOND;
    let mut after = restarted(&before.memory(), at);
    let names = |observer: &Observer| {
        let nodes = observer.snapshot(Timestamp(at)).nodes;
        nodes.into_iter().map(|node| node.name).collect::<Vec<_>>()
    };
    for (number, known) in [(3, "/lidar"), (5, "/changed")] {
        let payload = forge::entities(ALICE, 24, &[("/", "changed", Guid::new(ALICE, WRITER))]);
        put(
            &mut after,
            at,
            Message::from(ALICE).data(NODES, number, &payload),
        );
        assert_eq!(names(&after), [known, "/mapper"]);
    }
}

#[test]
fn restored_state_is_limited_by_the_caps() {
    let mut before = agent(Settings::default());
    robot(&mut before);
    let mut after = agent(Settings {
        participants: 1,
        endpoints: 2,
        nodes: 0,
        ..Settings::default()
    });
    after.input(Input::Restored {
        memory: &before.memory(),
        now: Timestamp(START),
    });
    let snapshot = after.snapshot(Timestamp(START));
    let evictions = |table| {
        let tables = snapshot.tables.iter();
        let mut tables = tables.filter(|facts| facts.table == table);
        tables.next().map(|facts| (facts.size, facts.evictions))
    };
    assert_eq!(evictions("participants"), Some((1, 1)));
    assert_eq!(evictions("endpoints"), Some((2, 1)));
    assert_eq!(evictions("nodes"), Some((0, 1)));
}

#[test]
fn the_saved_state_has_a_new_revision_only_after_a_change() {
    let mut observer = agent(Settings::default());
    robot(&mut observer);
    let revision = observer.memory_revision();
    put(&mut observer, START + 2 * SECOND, spdp(ALICE));
    assert_eq!(observer.memory_revision(), revision);
    let gone = Guid::new(ALICE, WRITER);
    put(
        &mut observer,
        START + 2 * SECOND,
        Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, gone),
    );
    assert!(observer.memory_revision() > revision);
}

proptest! {
    /// Changes one character of the file so that it is still JSON of the right shape.
    #[test]
    fn saved_state_with_a_wrong_character_is_restored_in_part_or_refused(
        place in any::<prop::sample::Index>(),
        character in "[0-9a-z/\"\\\\ \u{202e}-]",
    ) {
        let mut before = agent(Settings::default());
        robot(&mut before);
        let mut text = serde_json::to_string(&before.memory()).unwrap();
        let place = place.index(text.len());
        text.replace_range(place..=place, &character);
        if let Ok(memory) = serde_json::from_str::<Memory>(&text) {
            let mut after = restarted(&memory, START);
            let shown = shown(&after, START);
            let is_hostile = shown.contains('\u{202e}');
            prop_assert!(!is_hostile);
            after.input(Input::Time(Timestamp(START + 200 * SECOND)));
        }
    }
}
