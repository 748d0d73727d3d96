//! Slow robots: seconds, hours and days between calls.

use std::time::Duration;

use ros2probe_model::facts::calls::facts::{Callback, Quantiles};

use super::*;

const HOUR: Duration = Duration::from_secs(3_600);
const DAY: Duration = Duration::from_secs(86_400);

/// Adds a duration to a cumulative distribution, and returns a copy.
fn add(to: &mut Durations, duration: Duration) -> Durations {
    to.observe(duration);
    to.clone()
}

fn only_callback(world: &World) -> Callback {
    world.snapshot().inside.unwrap().callbacks[0].clone()
}

fn check(quantiles: Quantiles, count: u64, expected: Duration) {
    assert_eq!(quantiles.count, count);
    for value in [quantiles.p50, quantiles.p99, quantiles.maximum] {
        assert_eq!(value, expected, "{quantiles:?}");
    }
}

#[test]
fn a_topic_with_one_message_per_40_s_has_exact_intervals() {
    let mut world = World::new();
    let mut intervals = Durations::default();
    for second in 0..200 {
        let mut reports = Vec::new();
        if second % 40 == 0 {
            let published = second / 40 + 1;
            if published > 1 {
                intervals.observe(Duration::from_secs(40));
            }
            reports.push(ProcessReport {
                publishers: vec![PublisherReport {
                    intervals: intervals.clone(),
                    ..publisher("/slow", published, world.now)
                }],
                ..process(70)
            });
        }
        world.second(reports);
        let interval = world.snapshot().inside.unwrap().publishers[0].interval;
        if interval.count > 0 {
            check(interval, 1, Duration::from_secs(40));
        }
        match second % 40 {
            0..4 => assert_eq!(interval.count, u64::from(second >= 40), "{second}"),
            4..10 => assert!(interval.count <= 1, "{second}"),
            _ => assert_eq!(interval.count, 0, "{second}"),
        }
    }
    assert_eq!(world.inside("/slow").counts.published, 5);
}

#[test]
fn a_callback_of_one_hour_has_its_exact_duration() {
    let mut world = World::new();
    let mut report = callback(0x40, timer(50), 71, 0, world.now);
    let mut calls = Durations::default();
    for _ in 0..20 {
        report.calls += 1;
        report.durations = add(&mut calls, Duration::from_millis(1));
        world.second(vec![ProcessReport {
            callbacks: vec![report.clone()],
            ..process(70)
        }]);
    }
    let is_short = |it: Quantiles| it.maximum <= Duration::from_millis(2);
    assert!(is_short(only_callback(&world).duration));
    // The callback runs for an hour, and nothing is reported until it ends.
    for _ in 0..HOUR.as_secs() {
        world.second(Vec::new());
    }
    let mut ends = |world: &mut World, duration: Duration| {
        report.calls += 1;
        report.durations = add(&mut calls, duration);
        report.last = Timestamp(world.now);
        world.second(vec![ProcessReport {
            callbacks: vec![report.clone()],
            ..process(70)
        }]);
        only_callback(world)
    };
    let ended = ends(&mut world, HOUR);
    check(ended.duration, 1, HOUR);
    assert_eq!(ended.busy, Some(1.0), "it took the whole window");
    // A later call of 30 s has its own duration, not the longest so far.
    for _ in 0..30 {
        world.second(Vec::new());
    }
    check(only_callback(&world).duration, 0, Duration::ZERO);
    check(
        ends(&mut world, Duration::from_secs(30)).duration,
        1,
        Duration::from_secs(30),
    );
    assert_eq!(
        only_callback(&world).durations.range(),
        Some((Duration::from_millis(1), HOUR))
    );
}

#[test]
fn a_latched_message_from_yesterday_yields_ordered_quantiles() {
    let mut world = World::new();
    let mut latency = Durations::default();
    for (taken, age) in [DAY, Duration::from_millis(3), DAY + HOUR]
        .into_iter()
        .enumerate()
    {
        world.second(vec![ProcessReport {
            subscriptions: vec![SubscriptionReport {
                latency: add(&mut latency, age),
                ..subscription("/map", taken as u64 + 1, world.now)
            }],
            ..process(70)
        }]);
        let shown = world.snapshot().inside.unwrap().subscriptions[0].latency;
        let known = world.inside("/map").latency;
        assert_eq!(known.count(), taken as u64 + 1);
        assert!(
            shown.p50 <= shown.p99 && shown.p99 <= shown.maximum,
            "{shown:?}"
        );
        for _ in 0..15 {
            world.second(Vec::new());
        }
    }
    let range = world.inside("/map").latency.range();
    assert_eq!(range, Some((Duration::from_millis(3), DAY + HOUR)));
}

/// The kernel's figures are read while other threads change them: extremes and counts may belong to
/// different moments.
#[test]
fn contradictory_figures_of_the_kernel_yield_ordered_quantiles() {
    use ros2probe_wire::inside::{BUCKETS, bucket};
    let mut world = World::new();
    let mut counts = [0; BUCKETS];
    for (minimum, maximum) in [(40, 2), (u64::MAX, 0), (0, u64::MAX), (17, 1 << 40)] {
        counts[bucket(20 * SECOND)] += 1;
        counts[bucket(maximum)] += 1;
        let durations = Durations::new(&counts, 7, minimum, maximum);
        let calls = counts.iter().copied().map(u64::from).sum();
        let mut report = callback(0x40, timer(50), 71, calls, world.now);
        (report.waits, report.durations) = (durations.clone(), durations);
        world.second(vec![ProcessReport {
            callbacks: vec![report],
            ..process(70)
        }]);
        let shown = only_callback(&world).duration;
        assert!(
            shown.p50 <= shown.p99 && shown.p99 <= shown.maximum,
            "{shown:?}"
        );
    }
}
