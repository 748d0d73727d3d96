//! Writers that send but are never announced.

use std::time::Duration;

use ros2probe_model::measure::history::History;
use ros2probe_model::observe::input::Input;
use ros2probe_model::report::snapshot::SocketFacts;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, Timestamp};

use super::{ALICE, BOB, READER, WRITER, World, alice};

#[test]
fn a_writer_whose_announcement_was_missed_is_shown_and_moves_to_its_topic() {
    let mut world = World::new(&["/chatter"]);
    world.stream(alice(WRITER), 1..=250);
    assert!(world.snapshot().unknown_writers.is_empty());
    world.stream(alice(WRITER), 251..=400);
    let snapshot = world.snapshot();
    let unknown = &snapshot.unknown_writers[0];
    assert_eq!(
        (unknown.guid, unknown.measurement.messages),
        (alice(WRITER), 400)
    );
    assert!((unknown.measurement.rate_hz - 100.0).abs() < 1.0);
    let changes = world.observer.drain().interest;
    assert_eq!(changes, [(alice(WRITER), Some(Verdict::Meter))]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    assert!(world.snapshot().unknown_writers.is_empty());
    world.stream(alice(WRITER), 401..=500);
    assert_eq!(world.measurement("/chatter").messages, 500);
    assert!(world.observer.drain().interest.is_empty());
}

#[test]
fn messages_sent_before_the_announcement_cause_no_spike_of_the_rate() {
    let mut world = World::new(&["/chatter"]);
    world.spdp(ALICE, 100);
    world.sedp(alice(READER), "rt/chatter");
    let mut history = History::new(Duration::from_secs(60), 10);
    let mut rates = Vec::new();
    for second in 0..20 {
        if second == 14 {
            world.sedp(alice(WRITER), "rt/chatter");
        }
        for number in 1..=50 {
            world.sample(alice(WRITER), 50 * second + number);
            world.wait(20);
        }
        let now = Timestamp(world.now);
        history.take(now, world.observer.measured(now));
        rates.push(world.measurement("/chatter").rate_hz);
    }
    assert_eq!(world.measurement("/chatter").messages, 1000);
    // The second of the announcement is incomplete.
    assert_eq!(rates[..15], [0.0; 15]);
    assert_eq!(rates[15..], [50.0; 5]);
    let past = history.past();
    let seconds: Vec<_> = past.topic(DomainId(0), "rt/chatter").unwrap().collect();
    let rows = seconds.iter().map(|(_, reading)| reading.unwrap());
    for (second, reading) in rows.enumerate() {
        let row = reading.row;
        let expected = if second < 14 { 0 } else { 50 };
        assert_eq!((row.messages, row.lost), (expected, 0), "{second}");
        assert_eq!(row.bytes, 8.0 * f64::from(expected) as f32);
        assert!(
            reading.rate_hz.is_none_or(|rate| rate <= 50.0),
            "{reading:?}"
        );
        let interval = row.interarrival().map_or(0.02, |[median, _]| median);
        assert!((interval - 0.02).abs() < 0.004, "{interval}");
    }
}

#[test]
fn an_unknown_writer_is_reported_with_its_vendor_and_process() {
    const FAST: GuidPrefix = GuidPrefix(*b"\x01\x0fsome-robot");
    let mut world = World::new(&[]);
    let holder = SocketFacts {
        cookie: 77,
        process_id: Some(4242),
        process: Some("lidar_driver".into()),
        cgroup: Some("/robot.slice".into()),
        ..SocketFacts::default()
    };
    world.observer.input(Input::Socket(holder));
    let send = |world: &mut World, number| {
        for (prefix, socket) in [(FAST, 77), (ALICE, 78), (BOB, 77)] {
            let envelope = Envelope {
                host: true,
                outgoing: true,
                socket,
                ..forge::multicast(world.now, 0)
            };
            let sample = Message::from(prefix).data(WRITER, number, &[0, 1, 0, 0]);
            world.observer.input(Input::Datagram {
                envelope: &envelope,
                payload: &sample.bytes(),
                handover: None,
            });
        }
        world.wait(10);
    };
    (1..=400).for_each(|number| send(&mut world, number));
    world.spdp(BOB, 10);
    send(&mut world, 401);
    let reported = |prefix: GuidPrefix| {
        let snapshot = world.snapshot();
        let writers = snapshot.unknown_writers.into_iter();
        let mut writers = writers.filter(|writer| writer.guid == Guid::new(prefix, WRITER));
        let writer = writers.next().unwrap();
        (
            writer.vendor.map(|it| it.to_string()),
            writer.process.id,
            writer.process.name,
        )
    };
    let lidar = Some("lidar_driver".into());
    assert_eq!(
        reported(FAST),
        (
            Some("eProsima Fast DDS".to_owned()),
            Some(4242),
            lidar.clone()
        )
    );
    assert_eq!(reported(BOB).0.unwrap(), "Eclipse Cyclone DDS");
    assert_eq!((reported(BOB).1, reported(BOB).2), (Some(4242), lidar));
    assert_eq!((reported(ALICE).1, reported(ALICE).2), (None, None));
    let participant = world.snapshot().participants.remove(0);
    assert_eq!(participant.guid.prefix, BOB);
    assert_eq!(participant.process.id, Some(4242));
    assert_eq!(participant.process.cgroup.as_deref(), Some("/robot.slice"));
}

#[test]
fn samples_beyond_the_budget_for_unknown_writers_are_not_lost() {
    let mut world = World::new(&["/chatter"]);
    for number in [1, 2, 3, 40, 90, 91, 200] {
        world.sample(alice(WRITER), number);
        world.wait(400);
    }
    world.wait(1000);
    world.stream(alice(WRITER), 500..=700);
    world.stream(alice(WRITER), 711..=900);
    let unknown = world.snapshot().unknown_writers.remove(0).measurement;
    assert_eq!((unknown.messages, unknown.lost), (7 + 201 + 190, 10));
}

#[test]
fn a_sample_that_arrives_after_its_writer_left_adds_no_unknown_writer() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=10);
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    world.sample(alice(WRITER), 11);
    world.wait(10_000);
    assert!(world.snapshot().unknown_writers.is_empty());
}

#[test]
fn an_unknown_writer_with_a_message_every_forty_seconds_stays_until_it_is_silent() {
    let mut world = World::new(&["/chatter"]);
    world.spdp(ALICE, 1000);
    for number in 1..=5 {
        world.sample(alice(WRITER), number);
        (0..40).for_each(|_| world.wait(1000));
    }
    let unknown = world.snapshot().unknown_writers;
    assert_eq!(unknown.len(), 1);
    assert_eq!(unknown[0].measurement.messages, 5);
    (0..130).for_each(|_| world.wait(1000));
    assert!(world.snapshot().unknown_writers.is_empty());
}
