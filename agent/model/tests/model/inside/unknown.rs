//! Rates and sizes that cannot be observed are unknown, and topics with rare events are not silent.

use ros2probe_testing::model::host::{BOB, Host};

use super::*;

#[test]
fn a_topic_within_one_process_has_an_unknown_rate_and_is_not_silent() {
    let mut world = World::new();
    let prefix = world.participant(1, 70);
    let writer = Guid::new(prefix, EntityId([0, 0, 0x11, 0x03]));
    let reader = Guid::new(prefix, EntityId([0, 0, 0x13, 0x04]));
    world.announce(writer, "rt/inner", STRING);
    world.announce(reader, "rt/inner", STRING);
    for _ in 0..12 {
        world.second(Vec::new());
    }
    let topic = world.topic("/inner");
    assert!(topic.measurement.is_some());
    assert_eq!((topic.rate_hz(), topic.bandwidth()), (None, None));
    assert!(!topic.is_silent(world.snapshot().at));
    // Calls show the rate, but no sizes.
    for second in 1..=12 {
        let mut report = process(70);
        report.publishers = vec![publisher("/inner", 20 * second, world.now)];
        world.second(vec![report]);
    }
    let topic = world.topic("/inner");
    let rate = topic.rate_hz().unwrap();
    assert!((rate - 20.0).abs() < 0.01, "{rate}");
    assert_eq!(topic.bandwidth(), None);
}

#[test]
fn a_stopped_stream_is_silent_but_a_topic_with_rare_events_is_not() {
    let run = |messages: u64, every: u64, then: u64| {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        for number in 1..=messages {
            host.data(bob, number);
            host.wait(every);
        }
        host.wait(then);
        let topic = host.topic();
        assert_eq!(topic.rate_hz(), Some(0.0));
        topic.is_silent(host.snapshot().at)
    };
    assert!(!run(0, 100, 60_000), "it was never sent");
    assert!(!run(3, 2_000, 60_000), "a few transitions of a node");
    assert!(!run(20, 30_000, 60_000), "one in 30 s");
    assert!(run(20, 30_000, 200_000));
    assert!(run(50, 100, 15_000), "10 Hz, and then nothing");
}
