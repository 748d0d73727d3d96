//! Findings about callbacks and queues, and their absence on a healthy robot.

use super::*;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;

/// A process whose callbacks are called at steady rates.
#[derive(Default)]
struct Robot {
    world: Option<World>,
    callbacks: Vec<Steady>,
    buffer: (u64, u64),
    seconds: u64,
}

/// A callback with steady calls.
struct Steady {
    report: CallbackReport,
    rate: u64,
    takes: u64,
    waits: u64,
}

impl Robot {
    fn with(callbacks: Vec<Steady>) -> Self {
        Self {
            world: Some(World::new()),
            callbacks,
            ..Self::default()
        }
    }

    fn world(&mut self) -> &mut World {
        self.world.as_mut().unwrap()
    }

    fn run(&mut self, seconds: u64) {
        for _ in 0..seconds {
            self.seconds += 1;
            let now = self.world().now;
            for each in &mut self.callbacks {
                each.report.calls += each.rate;
                each.report.last = Timestamp(now);
                each.report
                    .durations
                    .merge(&durations(each.rate, each.takes));
                each.report.waits.merge(&durations(each.rate, each.waits));
            }
            let (enqueued, overwritten) = self.buffer;
            let buffers = match enqueued {
                0 => Vec::new(),
                _ => vec![buffer("/points", enqueued, overwritten, now)],
            };
            let report = ProcessReport {
                callbacks: self
                    .callbacks
                    .iter()
                    .map(|each| each.report.clone())
                    .collect(),
                buffers,
                ..process(70)
            };
            self.world().second(vec![report]);
        }
    }

    fn found(&mut self) -> Vec<Diagnosis> {
        self.world().snapshot().diagnoses.list.clone()
    }

    /// Returns the numbers of events about findings that appeared and that were resolved.
    fn events(&mut self) -> (usize, usize) {
        let events = self.world().observer.drain().events.events;
        let resolved = events.iter().filter_map(|event| match &event.kind {
            EventKind::Diagnosis { resolved, .. } => Some(*resolved),
            _ => None,
        });
        let resolved: Vec<bool> = resolved.collect();
        let gone = resolved.iter().filter(|resolved| **resolved).count();
        (resolved.len() - gone, gone)
    }
}

fn steady(handle: u64, trigger: Trigger, thread: u32, rate: u64, takes: u64) -> Steady {
    Steady {
        report: CallbackReport {
            durations: Durations::default(),
            waits: Durations::default(),
            ..callback(handle, trigger, thread, 0, START)
        },
        rate,
        takes,
        waits: 1,
    }
}

fn scan() -> Trigger {
    Trigger::Subscription("/scan".into())
}

#[test]
fn a_healthy_robot_has_no_findings() {
    let mut robot = Robot::with(vec![
        steady(0x40, timer(50), 1, 20, 30),
        steady(0x41, scan(), 1, 10, 40),
        steady(0x42, Trigger::Service(Some("/plan".into())), 1, 1, 20),
        // A slow callback in another thread delays no timer.
        steady(0x43, Trigger::Subscription("/image".into()), 2, 4, 200),
    ]);
    robot.buffer = (0, 0);
    for _ in 0..60 {
        robot.buffer.0 += 100;
        robot.run(1);
        assert!(robot.found().is_empty(), "{:?}", robot.found());
    }
}

#[test]
fn a_slow_start_is_not_a_finding() {
    let mut robot = Robot::with(vec![
        steady(0x40, timer(50), 1, 20, 400),
        steady(0x41, scan(), 1, 10, 400),
    ]);
    robot.run(4);
    robot.callbacks.iter_mut().for_each(|each| each.takes = 5);
    for _ in 0..40 {
        robot.run(1);
        assert!(robot.found().is_empty(), "{:?}", robot.found());
    }
}

#[test]
fn a_callback_longer_than_a_timer_period_of_its_thread_is_a_finding() {
    let mut robot = Robot::with(vec![
        steady(0x40, timer(50), 1, 20, 2),
        steady(0x41, scan(), 1, 5, 120),
    ]);
    robot.run(30);
    let found = robot.found();
    let [
        Diagnosis::SlowCallback {
            topic,
            callback,
            trigger,
            duration,
            period,
            is_own_period,
        },
    ] = &found[..]
    else {
        panic!("{found:?}")
    };
    assert_eq!(topic.as_ref().unwrap().name, "/scan");
    assert_eq!((callback.node.clone(), trigger), (node("/nav"), &scan()));
    assert_eq!(duration.as_millis(), 120);
    assert_eq!((period.as_millis(), *is_own_period), (50, false));
    assert_eq!(robot.events(), (1, 0), "one event, not one per second");
    robot.callbacks[1].takes = 20;
    robot.run(30);
    assert!(robot.found().is_empty());
    assert_eq!(robot.events(), (0, 1));
}

#[test]
fn a_timer_callback_longer_than_its_period_is_a_finding() {
    let mut robot = Robot::with(vec![steady(0x40, timer(50), 1, 14, 70)]);
    robot.run(30);
    let found = robot.found();
    assert!(
        matches!(
            &found[..],
            [Diagnosis::SlowCallback {
                is_own_period: true,
                ..
            }]
        ),
        "{found:?}"
    );
}

#[test]
fn a_slow_callback_that_changes_threads_is_not_a_finding() {
    let mut robot = Robot::with(vec![
        steady(0x40, timer(50), 1, 20, 2),
        steady(0x41, scan(), 1, 5, 120),
    ]);
    for second in 0..40 {
        robot.callbacks[1].report.thread = 1 + second % 3;
        robot.run(1);
        assert!(robot.found().is_empty(), "{:?}", robot.found());
    }
}

#[test]
fn a_callback_that_waits_for_a_busy_executor_is_a_finding() {
    let mut robot = Robot::with(vec![
        steady(0x40, scan(), 1, 10, 10),
        steady(0x41, Trigger::Subscription("/image".into()), 1, 3, 290),
    ]);
    robot.callbacks[0].waits = 300;
    robot.run(30);
    let found = robot.found();
    let [Diagnosis::ExecutorWait { callback, wait, .. }] = &found[..] else {
        panic!("{found:?}")
    };
    assert_eq!((callback.handle, wait.as_millis()), (0x40, 300));
}

#[test]
fn a_long_transport_time_is_not_a_wait_for_the_executor() {
    let mut robot = Robot::with(vec![steady(0x40, scan(), 1, 10, 1)]);
    robot.callbacks[0].waits = 300;
    robot.run(30);
    assert!(robot.found().is_empty(), "{:?}", robot.found());
    // The wait of a timer contains no transport time.
    let mut robot = Robot::with(vec![steady(0x40, timer(100), 1, 10, 1)]);
    robot.callbacks[0].waits = 300;
    robot.run(30);
    assert_eq!(robot.found().len(), 1);
}

#[test]
fn a_queue_that_overwrites_messages_is_a_finding_with_its_topic() {
    let mut robot = Robot::with(Vec::new());
    for _ in 0..30 {
        robot.buffer.0 += 100;
        robot.buffer.1 += 14;
        robot.run(1);
    }
    let found = robot.found();
    let [
        Diagnosis::IntraProcessOverflow {
            topic,
            queue,
            overwritten_permille,
        },
    ] = &found[..]
    else {
        panic!("{found:?}")
    };
    assert_eq!(
        (topic.name.as_str(), queue.node.clone()),
        ("/points", node("/mapper"))
    );
    assert_eq!(*overwritten_permille, 140);
    for _ in 0..30 {
        robot.buffer.0 += 1000;
        robot.buffer.1 += 9;
        robot.run(1);
    }
    assert!(robot.found().is_empty(), "9 of 1000 are tolerated");
}

#[test]
fn a_process_that_exceeds_its_budget_is_a_finding() {
    let mut world = World::new();
    let report = ProcessReport {
        is_suspended: true,
        hits: 1_000_000,
        ..process(70)
    };
    world.second(vec![report]);
    let found = world.snapshot().diagnoses.list.clone();
    assert!(
        matches!(
            &found[..],
            [Diagnosis::ObservationSuspended { process: 70, .. }]
        ),
        "{found:?}"
    );
    world.second(vec![process(70)]);
    assert!(world.snapshot().diagnoses.list.is_empty());
}
