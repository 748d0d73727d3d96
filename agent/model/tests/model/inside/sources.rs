//! The source of a topic's counts: either the network or the observed processes.

use super::*;
use ros2probe_model::report::snapshot::{Source, Transport, WatchState};

/// A world with a writer and a reader of `/scan` in participants of two processes.
fn pair(writer_process: u16, reader_process: u16) -> (World, Guid) {
    let mut world = World::new();
    let one = world.participant(1, writer_process);
    let other = world.participant(2, reader_process);
    let writer = Guid::new(one, EntityId([0, 1, 1, 3]));
    let reader = Guid::new(other, EntityId([0, 1, 1, 4]));
    world.announce(writer, "rt/scan", STRING);
    world.announce(reader, "rt/scan", STRING);
    (world, writer)
}

/// Sends samples with these numbers over the network.
fn samples(world: &mut World, writer: Guid, numbers: std::ops::RangeInclusive<u64>) {
    for number in numbers {
        let message = Message::from_fast(writer.prefix);
        world.put(message.data(writer.entity, number, &[0, 1, 0, 0, 1, 2, 3, 4]));
    }
}

fn report(world: &World, published: u64) -> Vec<ProcessReport> {
    vec![ProcessReport {
        publishers: vec![publisher("/scan", published, world.now)],
        ..process(70)
    }]
}

#[test]
fn counts_of_the_network_are_not_added_to_those_from_inside() {
    let (mut world, writer) = pair(70, 71);
    for second in 1..=10 {
        samples(&mut world, writer, 10 * second - 9..=10 * second);
        let reports = report(&world, 10 * second + 7);
        world.second(reports);
        let topic = world.topic("/scan");
        assert_eq!(topic.source, Source::Wire);
        assert_eq!(topic.measurement.unwrap().messages, 10 * second);
    }
    assert_eq!(world.inside("/scan").counts.published, 107);
}

#[test]
fn without_datagrams_calls_inside_processes_are_counted() {
    let (mut world, _) = pair(70, 70);
    for second in 1..=10 {
        let reports = report(&world, 10 * second);
        world.second(reports);
    }
    let topic = world.topic("/scan");
    assert_eq!(topic.source, Source::Inside);
    let measured = topic.measurement.unwrap();
    assert_eq!((measured.messages, measured.bytes), (100, 0));
    assert!((measured.rate_hz - 10.0).abs() < 0.01);
}

// Coverage: one process, with `capture.inside` | - | - | counted
#[test]
fn a_pair_in_one_observed_process_counts_as_observed() {
    let mut world = World::new();
    let prefix = world.participant(1, 70);
    world.announce(Guid::new(prefix, EntityId([0, 1, 1, 3])), "rt/scan", STRING);
    world.announce(Guid::new(prefix, EntityId([0, 1, 1, 4])), "rt/scan", STRING);
    assert_eq!(
        world.topic("/scan").observed_pairs(Transport::SameProcess),
        0
    );
    let reports = report(&world, 1);
    world.second(reports);
    let topic = world.topic("/scan");
    assert_eq!(topic.observed_pairs(Transport::SameProcess), 1);
    assert_eq!(topic.observed_pairs(Transport::Network), 0);
}

/// Announces a pair of two processes with this transport. The calls of the first `observed`
/// processes are counted for ten seconds.
fn counted_inside(transport: Transport, observed: usize) -> TopicFacts {
    // A locator of iceoryx, or of a PSMX plugin such as `psmx_iox2`.
    let locator = [&16u32.to_le_bytes()[..], &7411u32.to_le_bytes(), &[0; 16]].concat();
    let announced: (u16, &[u8]) = match transport {
        Transport::Iceoryx => (0x2f, &locator),
        _ => (0x8006, &[0; 4]),
    };
    let from: fn(GuidPrefix) -> Message = match transport {
        Transport::Iceoryx => Message::from,
        _ => Message::from_fast,
    };
    let mut world = World::new();
    let (one, other) = (world.participant(1, 70), world.participant(2, 71));
    for (prefix, entity, announcer) in [
        (one, EntityId([0, 1, 1, 3]), SEDP_WRITERS),
        (other, EntityId([0, 1, 1, 4]), SEDP_READERS),
    ] {
        let guid = Guid::new(prefix, entity);
        let payload = forge::endpoint_with(guid, "rt/scan", STRING, &[announced]);
        world.put(from(prefix).data(announcer, 9, &payload));
    }
    for second in 1..=10 {
        let mut reports = report(&world, 10 * second);
        reports.push(ProcessReport {
            subscriptions: vec![subscription("/scan", 10 * second, world.now)],
            ..process(71)
        });
        reports.truncate(observed);
        world.second(reports);
    }
    world.topic("/scan")
}

// Coverage: data sharing, with `capture.inside` | Fast DDS | - | counted
// Coverage: iceoryx and PSMX, with `capture.inside` | Cyclone DDS | - | counted
#[test]
fn messages_in_memory_that_is_not_read_are_counted_inside_processes() {
    for transport in [Transport::Iceoryx, Transport::DataSharing] {
        let topic = counted_inside(transport, 0);
        assert_eq!(topic.transports[0].transport, transport);
        assert_eq!((topic.source, topic.rate_hz()), (Source::Wire, None));
        let topic = counted_inside(transport, 1);
        assert_eq!(topic.observed_pairs(transport), 0);
        let topic = counted_inside(transport, 2);
        assert_eq!(topic.observed_pairs(transport), 1);
        assert_eq!(topic.source, Source::Inside);
        assert_eq!(topic.measurement.as_ref().unwrap().messages, 100);
        assert!((topic.rate_hz().unwrap() - 10.0).abs() < 0.01);
        assert_eq!(topic.inside.unwrap().counts.taken, 100);
    }
}

#[test]
fn a_total_continues_when_the_last_remote_subscriber_leaves() {
    let (mut world, writer) = pair(70, 71);
    let mut last = 0;
    for second in 1..=20 {
        if second <= 8 || second > 16 {
            samples(&mut world, writer, 10 * second - 9..=10 * second);
        }
        let reports = report(&world, 10 * second);
        world.second(reports);
        let topic = world.topic("/scan");
        let measured = topic.measurement.unwrap();
        assert!(measured.messages >= last, "{second}");
        last = measured.messages;
        if (12..=16).contains(&second) {
            assert_eq!(topic.source, Source::Inside, "{second}");
            assert!((measured.rate_hz - 10.0).abs() < 0.1);
        }
    }
    assert_eq!(world.topic("/scan").source, Source::Wire);
    // The seconds before the source changes are not counted twice.
    assert!((165..=200).contains(&last), "{last}");
}

#[test]
fn expectations_are_evaluated_on_topics_seen_only_inside_processes() {
    let mut world = World::new();
    let watch = |expectations: &str| {
        let mut watch = Watch::named("/scan").unwrap();
        watch.expectations.min_rate_hz = Some(expectations.parse().unwrap());
        Input::Watchlist(Arc::new(Watchlist::new(vec![watch]).unwrap()))
    };
    world.observer.input(watch("15"));
    let mut published = 0;
    let mut step = |world: &mut World, rate: u64, seconds: u64| {
        for _ in 0..seconds {
            published += rate;
            let report = ProcessReport {
                publishers: vec![publisher("/scan", published, world.now)],
                subscriptions: vec![subscription("/scan", published, world.now)],
                ..process(70)
            };
            world.second(vec![report]);
        }
        let watches = &world.snapshot().watches;
        (
            watches[0].topics[0].state,
            watches[0].topics[0].violations.clone(),
        )
    };
    assert_eq!(step(&mut world, 20, 15), (WatchState::Ok, Vec::new()));
    let violated = (WatchState::Violated, vec!["min_rate_hz"]);
    assert_eq!(step(&mut world, 5, 15), violated);
    assert_eq!(step(&mut world, 20, 15).0, WatchState::Ok);
}

#[test]
fn a_topic_without_a_watch_is_listed_without_a_measurement() {
    let mut world = World::new();
    world.watch("/other");
    let reports = report(&world, 5);
    world.second(reports);
    let topic = world.topic("/scan");
    assert!(topic.measurement.is_none());
    assert_eq!(topic.source, Source::Inside);
    assert_eq!(topic.inside.unwrap().counts.published, 5);
}

#[test]
fn times_follow_the_wall_clock_when_it_is_set() {
    let mut world = World::new();
    let reports = report(&world, 5);
    world.second(reports);
    let hour = 3_600 * SECOND;
    world
        .observer
        .input(Input::ClockSet(i64::try_from(hour).unwrap()));
    world.now += hour;
    world.observer.input(Input::Time(Timestamp(world.now)));
    let reports = report(&world, 9);
    let at = world.now;
    world.second(reports);
    let snapshot = world.snapshot();
    let last = world.topic("/scan").measurement.unwrap().last_message;
    assert_eq!(snapshot.wall_time(last.unwrap()), Timestamp(at));
    let facts = snapshot.inside.as_deref().unwrap();
    let last = facts.publishers[0].last;
    assert_eq!(snapshot.wall_time(last), Timestamp(at));
    let reported = Timestamp(at + 500 * MILLISECOND);
    assert_eq!(snapshot.wall_time(facts.at), reported);
}
