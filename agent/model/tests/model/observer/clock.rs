//! Steps of the wall clock, jumps, and reproducible results.

use ros2probe_model::facts::churn;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::input::Input;
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{Guid, GuidPrefix, Timestamp};

use super::{ALICE, BOB, Dice, START, WRITER, World, alice};

#[test]
fn a_clock_step_of_an_hour_neither_ends_nor_delays_a_lease() {
    const HOUR: u64 = 3600 * SECOND;
    for (forward, step) in [(true, HOUR.cast_signed()), (false, -HOUR.cast_signed())] {
        let mut world = World::new(&["/chatter"]);
        world.spdp(ALICE, 10);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.stream(alice(WRITER), 1..=500);
        world.observer.drain();
        let before = world.now;

        // The writer uses the same clock.
        world.now = world.now.saturating_add_signed(step);
        world.observer.input(Input::ClockSet(step));
        world.stream(alice(WRITER), 501..=700);
        // A gap settles after ten seconds, as without the step.
        world.stream(alice(WRITER), 702..=1000);
        let snapshot = world.snapshot();
        assert_eq!(snapshot.time().0, world.now);
        let seen = &snapshot.participants[0];
        let age = |at| Timestamp(world.now).nanoseconds_since(snapshot.wall_time(at));
        assert_eq!(age(seen.first_seen), 9_990 * MILLISECOND.cast_signed());
        assert_eq!(age(seen.last_seen), 10 * MILLISECOND.cast_signed());
        let chatter = world.measurement("/chatter");
        assert_eq!(age(chatter.last_message.unwrap()), age(seen.last_seen));
        assert_eq!(chatter.messages, 999, "{forward}");
        assert!((chatter.rate_hz - 100.0).abs() < 2.0, "{}", chatter.rate_hz);
        assert_eq!(chatter.negative_latency, 0);
        assert!(chatter.source_latency.sum() < 1e-6, "{forward}");
        assert!(chatter.interarrival.sum() < 10.0, "{forward}");
        assert_eq!(world.churn("participant", "expired"), 0);
        assert_eq!(world.node_names(), ["/talker"]);
        for event in world.observer.drain().events.events {
            assert!(world.now.abs_diff(event.at.0) < 10 * SECOND, "{event:?}");
        }

        // A lease expires after its usual duration.
        assert_eq!(world.measurement("/chatter").lost, 0);
        world.wait(9_900);
        assert_eq!(world.snapshot().participants.len(), 1, "{forward}");
        assert_eq!(world.measurement("/chatter").lost, 1, "{forward}");
        world.wait(200);
        assert_eq!(world.snapshot().participants.len(), 0, "{forward}");
        let events = world.observer.drain().events.events;
        let expired = events.iter().find(|event| {
            let EventKind::Participant { change, .. } = &event.kind else {
                return false;
            };
            *change == churn::Event::Expired
        });
        assert_eq!(expired.unwrap().at.0 + 110 * MILLISECOND, world.now);
        assert!(world.now.abs_diff(before) > HOUR / 2);
    }
}

#[test]
fn jumps_of_the_source_clock_by_years_do_not_stop_the_model() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.wait(1000 * 3600 * 24 * 365);
    assert!(world.snapshot().participants.is_empty());
    world.observer.input(Input::Time(Timestamp(START)));
    world.observer.input(Input::Time(Timestamp(u64::MAX)));
}

#[test]
fn the_same_input_yields_the_same_facts() {
    let replay = || {
        let mut world = World::new(&["/**"]);
        let mut dice = Dice(3);
        for _ in 0..50 {
            let prefix = dice.prefix();
            world.spdp(prefix, 10);
            world.sedp(
                Guid::new(prefix, WRITER),
                &format!("rt/t{}", dice.roll() % 20),
            );
            (1..50).for_each(|number| world.sample(Guid::new(prefix, WRITER), number));
            world.wait(dice.roll() % 2000);
        }
        format!(
            "{:?} {:?}",
            world.snapshot(),
            world.observer.drain().interest
        )
    };
    assert_eq!(replay(), replay());
}

#[test]
fn an_agent_that_sleeps_until_the_next_decision_reports_every_event_in_time() {
    // Events with their times, the time at which each was reported, and the number of rounds.
    let silence = |sleep: &dyn Fn(&World) -> u64| {
        let mut world = World::new(&["/chatter"]);
        for (prefix, lease_seconds) in [(ALICE, 3), (BOB, 2)] {
            world.spdp(prefix, lease_seconds);
        }
        world.wait(0);
        // A lease that has ended when it begins does not keep the agent awake.
        world.spdp(GuidPrefix(*b"\x01\x0fhastyhasty"), 0);
        assert!(world.observer.next_decision().0 >= world.now + 90 * MILLISECOND);
        world.sedp(alice(WRITER), "rt/chatter");
        world.stream(alice(WRITER), 1..=97);
        // Number 98 is lost, and nothing follows the last one.
        world.stream(alice(WRITER), 99..=120);
        world.observer.drain();
        let (end, mut rounds) = (world.now + 15 * SECOND, 0);
        let mut events = Vec::new();
        while world.now < end {
            world.now = sleep(&world).min(end);
            let now = world.now;
            world.observer.input(Input::Time(Timestamp(now)));
            rounds += 1;
            let new_events = world.observer.drain().events.events.into_iter();
            events.extend(new_events.map(|event| (event.at, format!("{:?}", event.kind), now)));
        }
        (events, rounds)
    };
    let (careful, _) = silence(&|world| world.now + MILLISECOND);
    let (lazy, rounds) = silence(&|world| world.observer.next_decision().0);
    assert!(careful.len() >= 4, "{careful:#?}");
    for what in ["Loss", "Expired"] {
        assert!(careful.iter().any(|(_, kind, _)| kind.contains(what)));
    }
    assert_eq!(lazy.len(), careful.len());
    for (lazy, careful) in lazy.iter().zip(&careful) {
        assert_eq!((lazy.0, &lazy.1), (careful.0, &careful.1));
        assert!(lazy.2 <= careful.2, "{lazy:?} {careful:?}");
    }
    // One round for each second, and one for each lease.
    assert!(rounds <= 15 + 2 + 1, "{rounds}");
}
