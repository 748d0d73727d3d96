//! Events of the graph, of losses and of expectations.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::churn;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::watch::{Expectations, Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::report::snapshot::WatchState;
use ros2probe_testing::model::forge::{Message, SEDP_WRITERS};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, Timestamp};

use super::{ALICE, BOB, READER, WRITER, World, alice, bob};

/// Watches topics of this name with these expectations.
fn expect(world: &mut World, pattern: &str, expectations: Expectations) {
    let watch = Watch {
        expectations,
        ..Watch::named(pattern).unwrap()
    };
    let watchlist = Watchlist::new(vec![watch]).unwrap();
    world.observer.input(Input::Watchlist(Arc::new(watchlist)));
}

/// Returns the new states of watched topics, each with its violations.
fn changes(world: &mut World) -> Vec<(WatchState, Vec<&'static str>)> {
    let reported = world.events().into_iter();
    let changes = reported.filter_map(|(_, kind)| match kind {
        EventKind::Expectation { to, violations, .. } => Some((to, violations)),
        _ => None,
    });
    changes.collect()
}

#[test]
fn joining_and_leaving_raise_events_with_the_known_attributes() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
    let reported = world.events();
    let changes = |reported: &[(u64, EventKind)], wanted: churn::Event| {
        let kinds = reported.iter().map(|(_, kind)| match kind {
            EventKind::Participant { change, guid, .. } => {
                assert_eq!(guid.prefix, ALICE);
                ("participant", *change)
            }
            EventKind::Endpoint {
                change,
                guid,
                topic,
                message_type,
                ..
            } => {
                assert_eq!((*guid, &**topic), (alice(WRITER), "rt/chatter"));
                assert_eq!(&**message_type, "std_msgs/msg/String");
                ("endpoint", *change)
            }
            EventKind::Node { change, name, .. } => {
                assert_eq!(&**name, "/talker");
                ("node", *change)
            }
            other => panic!("{other:?}"),
        });
        let kinds: Vec<_> = kinds.collect();
        kinds.iter().filter(|(_, change)| *change == wanted).count()
    };
    assert_eq!(
        (reported.len(), changes(&reported, churn::Event::Appeared)),
        (3, 3)
    );
    assert!(world.events().is_empty());
    world.wait(11_000);
    let mut reported = world.events();
    // The missing subscriber is a finding for as long as the publisher exists.
    reported.retain(|(_, kind)| !matches!(kind, EventKind::Diagnosis { .. }));
    assert_eq!(reported.len(), 3);
    assert_eq!(changes(&reported, churn::Event::Expired), 1);
    assert_eq!(changes(&reported, churn::Event::Cascaded), 2);
    assert!(reported.iter().all(|(at, _)| *at == 10_000));
}

#[test]
fn losses_raise_one_event_per_second_even_after_their_writer_left() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
    world.sample(alice(WRITER), 1);
    world.events();
    // Three gaps occur within a second: 2, 4 to 5, 7.
    for number in [3, 6, 8] {
        world.wait(100);
        world.sample(alice(WRITER), number);
    }
    let losses = |world: &mut World| -> Vec<_> {
        let reported = world.events().into_iter();
        let losses = reported.filter_map(|(_, kind)| match kind {
            EventKind::Loss(burst) => Some(burst),
            _ => None,
        });
        losses.collect()
    };
    // The writer is reliable: it may retransmit for ten seconds.
    world.wait(9_000);
    assert_eq!(losses(&mut world), []);
    world.wait(4_000);
    let reported = losses(&mut world);
    assert!((1..=2).contains(&reported.len()), "{reported:?}");
    assert_eq!(reported.iter().map(|burst| burst.count).sum::<u64>(), 4);
    assert_eq!(
        (reported[0].first.0, reported.last().unwrap().last.0),
        (2, 7)
    );
    for burst in &reported {
        assert_eq!(burst.writer, alice(WRITER));
        assert_eq!(burst.topic, Some((DomainId(0), "rt/chatter".into())));
        assert_eq!(burst.node.as_deref(), Some("/talker"));
    }

    world.sample(alice(WRITER), 10);
    let dispose = Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 200, alice(WRITER));
    world.put(dispose);
    world.wait(1_000);
    let reported = losses(&mut world);
    assert_eq!(reported.len(), 1);
    assert_eq!(
        (reported[0].first.0, reported[0].last.0, reported[0].count),
        (9, 9, 1)
    );
    assert_eq!(reported[0].topic, Some((DomainId(0), "rt/chatter".into())));
}

#[test]
fn a_changed_state_raises_one_event_and_an_unchanged_watch_no_event() {
    let expects = |pattern: &str, max_silence| Watch {
        expectations: Expectations {
            max_silence,
            ..Expectations::default()
        },
        ..Watch::named(pattern).unwrap()
    };
    let chatter = expects("/chatter", Some(Duration::from_secs(2)));
    let mut world = World::new(&[]);
    let watch = |world: &mut World, watches: Vec<Watch>| {
        let watchlist = Watchlist::new(watches).unwrap();
        world.observer.input(Input::Watchlist(Arc::new(watchlist)));
    };
    watch(&mut world, vec![chatter.clone()]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.spdp(BOB, 100);
    world.sedp(bob(READER), "rt/chatter");
    world.stream(alice(WRITER), 1..=150);
    let states = |world: &mut World| -> Vec<_> {
        let reported = world.events().into_iter();
        let states = reported.filter_map(|(_, kind)| match kind {
            EventKind::Expectation {
                from,
                to,
                violations,
                ..
            } => Some((from, to, violations)),
            EventKind::Silence { last_message, .. } => {
                assert!(last_message.is_some());
                Some((None, WatchState::Silent, vec!["silence"]))
            }
            _ => None,
        });
        states.collect()
    };
    assert_eq!(states(&mut world), []);
    world.wait(5_000);
    let silent = (
        Some(WatchState::Ok),
        WatchState::Silent,
        vec!["max_silence_s"],
    );
    let silence = (None, WatchState::Silent, vec!["silence"]);
    assert_eq!(states(&mut world), [silent, silence]);

    // A new entry before it changes its index in the list.
    watch(&mut world, vec![expects("/other", None), chatter.clone()]);
    world.wait(2_000);
    assert_eq!(states(&mut world), []);
    world.stream(alice(WRITER), 151..=300);
    let good = (Some(WatchState::Silent), WatchState::Ok, Vec::new());
    assert_eq!(states(&mut world), [good]);
    let dispose = Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 200, alice(WRITER));
    world.put(dispose);
    world.wait(2_000);
    let gone = (Some(WatchState::Ok), WatchState::NotPublished, Vec::new());
    assert_eq!(states(&mut world), [gone]);
}

#[test]
fn a_gap_of_a_third_of_a_second_between_messages_violates_the_maximum_silence() {
    let mut world = World::new(&[]);
    let expectations = Expectations {
        max_silence: Some(Duration::from_millis(200)),
        ..Expectations::default()
    };
    expect(&mut world, "/joint_states", expectations);
    world.spdp(ALICE, 1000);
    world.sedp(alice(READER), "rt/joint_states");
    world.sedp(alice(WRITER), "rt/joint_states");
    world.stream(alice(WRITER), 1..=500);
    assert_eq!(changes(&mut world), []);
    world.wait(330);
    world.stream(alice(WRITER), 501..=800);
    let violated = (WatchState::Violated, vec!["max_silence_s"]);
    assert_eq!(changes(&mut world), [violated]);
    world.stream(alice(WRITER), 801..=1000);
    assert_eq!(changes(&mut world), [(WatchState::Ok, Vec::new())]);

    // A second publisher fills the gaps of the first one.
    world.spdp(BOB, 1000);
    world.sedp(bob(WRITER), "rt/joint_states");
    world.stream(bob(WRITER), 1..=300);
    world.stream(alice(WRITER), 1001..=1200);
    assert_eq!(changes(&mut world), []);
}

#[test]
fn time_in_which_the_source_was_blind_is_not_silence() {
    let mut world = World::new(&[]);
    let expectations = Expectations {
        max_silence: Some(Duration::from_secs(3)),
        min_rate_hz: Some(5.0),
        ..Expectations::default()
    };
    expect(&mut world, "/chatter", expectations);
    world.spdp(ALICE, 1000);
    world.sedp(alice(READER), "rt/chatter");
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=500);
    let state = |world: &World| world.snapshot().watches[0].topics[0].state;
    assert_eq!(state(&world), WatchState::Ok);
    world.events();
    // The agent was stopped for a minute.
    world.now += 60 * SECOND;
    let now = Timestamp(world.now);
    world.observer.input(Input::ViewBegan(now));
    world.wait(500);
    world.stream(alice(WRITER), 6_500..=7_000);
    let states = |world: &mut World| -> Vec<_> {
        let changes = changes(world).into_iter();
        changes.map(|(state, _)| state).collect()
    };
    assert_eq!(states(&mut world), []);
    // A publisher that stopped in that minute is silent 3 s later.
    world.now += 60 * SECOND;
    let now = Timestamp(world.now);
    world.observer.input(Input::ViewBegan(now));
    world.wait(2_900);
    assert_eq!(states(&mut world), [WatchState::Violated]);
    world.wait(1_200);
    assert_eq!(states(&mut world), [WatchState::Silent]);
}

#[test]
fn a_returning_subscriber_has_time_for_its_first_message() {
    let mut world = World::new(&[]);
    let expectations = Expectations {
        max_silence: Some(Duration::from_secs(3)),
        min_rate_hz: Some(1.0),
        ..Expectations::default()
    };
    expect(&mut world, "/chatter", expectations);
    world.spdp(ALICE, 1000);
    world.sedp(alice(WRITER), "rt/chatter");
    world.sample(alice(WRITER), 1);
    // Without a subscriber, the publisher sends nothing.
    world.wait(20_950);
    world.sedp(alice(READER), "rt/chatter");
    world.events();
    world.wait(900);
    world.stream(alice(WRITER), 2..=500);
    let violated = world.events().into_iter().any(|(_, kind)| {
        matches!(
            kind,
            EventKind::Expectation {
                to: WatchState::Silent | WatchState::Violated,
                ..
            }
        )
    });
    assert!(!violated);
}

#[test]
fn expectations_are_evaluated_in_the_time_of_the_source() {
    let mut world = World::new(&[]);
    let expectations = Expectations {
        min_rate_hz: Some(50.0),
        max_silence: Some(Duration::from_secs(3)),
        ..Expectations::default()
    };
    let watch = Watch {
        pattern: "/chatter".to_owned(),
        domain_id: None,
        expectations,
        per_subscriber: false,
        trace: 0.0,
        retain: ros2probe_model::facts::watch::Retain::None,
    };
    world.observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![watch]).unwrap(),
    )));
    let state = |world: &World| {
        let facts = world.snapshot().watches.remove(0);
        (facts.topics[0].topic.clone(), facts.topics[0].state)
    };
    let at = |state| ("/chatter".into(), state);
    assert_eq!(state(&world), at(WatchState::NotPublished));
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.wait(1000);
    assert_eq!(state(&world), at(WatchState::NoSubscriber));
    world.sedp(alice(READER), "rt/chatter");
    world.stream(alice(WRITER), 1..=500);
    assert_eq!(state(&world), at(WatchState::Ok));
    for number in 501..=540 {
        world.sample(alice(WRITER), number);
        world.wait(100);
    }
    assert_eq!(state(&world), at(WatchState::Violated));
    world.wait(5000);
    assert_eq!(state(&world), at(WatchState::Silent));
    world.stream(alice(WRITER), 541..=1040);
    assert_eq!(state(&world), at(WatchState::Ok));
}
