//! Calls inside the processes of the sample robot.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_daemon::agent_facts::{InsideLibrary, InsideSourceFacts};
use ros2probe_model::facts::calls::facts::{
    Buffer, Callback, InsideFacts, LateCallback, LateEntry, LateExample, LifecycleState,
    ObservedProcess, Owner, Publisher, Quantiles, ReaderQueue, Subscription, TopicCounts,
    TopicInside,
};
use ros2probe_model::facts::calls::late::{Activity, Cause, LateBound, LateCall, Repairs, Stage};
use ros2probe_model::facts::calls::other_thread::{OtherThread, Priority, ThreadLabel};
use ros2probe_model::facts::calls::report::{Durations, ThreadStates, Trigger};
use ros2probe_model::facts::diagnosis::{Diagnosis, TopicKey};
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::names::TopicName;
use ros2probe_wire::{DomainId, Timestamp};

const LAST: ModelTime = ModelTime::from_nanoseconds(1_700_000_000_000_000_000);

/// Returns the facts of one process with a publisher, a subscription, a buffer and two callbacks of
/// `/points`.
pub fn inside() -> InsideFacts {
    let topic = TopicName::from("/points");
    InsideFacts {
        at: LAST,
        has_callbacks: true,
        processes: vec![ObservedProcess {
            id: 42,
            name: Some("mapper".into()),
            domain_id: DomainId(0),
            cpu: Some(0.25),
            calls_hz: Some(120.0),
            calls: 36_000,
            refused: 3,
            is_suspended: false,
            shows_intra_process: true,
            nodes: vec!["/lidar".into()],
        }],
        publishers: vec![Publisher {
            owner: owner(0x10),
            topic: topic.clone(),
            middleware: Some("rmw_fastrtps_cpp".into()),
            published: 1_000,
            within_process: 900,
            rate_hz: Some(10.0),
            last: LAST,
            interval: quantiles(),
        }],
        subscriptions: vec![Subscription {
            owner: owner(0x20),
            topic: topic.clone(),
            middleware: Some("rmw_fastrtps_cpp".into()),
            taken: 990,
            failed: 4,
            rate_hz: Some(9.9),
            last: LAST,
            latency: quantiles(),
        }],
        reader_queues: vec![ReaderQueue {
            owner: owner(0x20),
            topic: topic.clone(),
            writer: None,
            depth: Some(10),
            arrived: 1_000,
            taken: 990,
            lost: 7,
        }],
        buffers: vec![Buffer {
            owner: owner(0x30),
            topic: Some(topic.clone()),
            enqueued: 900,
            overwritten: 126,
            dequeued: 770,
            overwritten_ratio: Some(0.14),
            depth: 4,
            max_depth: 5,
            capacity: Some(5),
            rate_hz: Some(9.0),
            last: LAST,
            waiting: quantiles(),
        }],
        callbacks: vec![
            callback(0x40, Trigger::Subscription(topic.clone())),
            callback(0x50, Trigger::Timer(Some(Duration::from_millis(50)))),
        ],
        late: vec![late(topic)],
        states: vec![LifecycleState {
            process: 42,
            domain_id: DomainId(0),
            node: Some("/lidar".into()),
            state: "active".into(),
            before: "activating".into(),
            at: LAST,
        }],
    }
}

/// Returns the figures of these processes about a topic.
pub fn topic() -> TopicInside {
    TopicInside {
        counts: TopicCounts {
            published: 1_000,
            within_process: 900,
            taken: 990,
            failed: 4,
            enqueued: 900,
            overwritten: 126,
            dequeued: 770,
            receptions: 770,
        },
        messages: 1_000,
        rate_hz: 10.0,
        last: Some(LAST),
        publishers: 1,
        subscriptions: 2,
        depth: 4,
        latency: durations(),
        waiting: durations(),
        lost_in_queues: Some(7),
    }
}

/// Returns the state of the source.
pub fn source() -> InsideSourceFacts {
    InsideSourceFacts {
        mode: "full",
        is_idle: false,
        shows_rates: true,
        libraries: vec![
            InsideLibrary {
                path: "/opt/ros/jazzy/lib/libtracetools.so".to_owned(),
                processes: 7,
                refused: None,
            },
            InsideLibrary {
                path: "/ws/libtracetools.so".to_owned(),
                processes: 1,
                refused: Some("it has no function ros_trace_rcl_publish".to_owned()),
            },
        ],
        counters: vec![("hits", 36_000), ("suspended", 0)],
        late: "events",
        without_events: None,
        without_deliveries: None,
        reason_off: None,
    }
}

fn chromium() -> ThreadLabel {
    ThreadLabel {
        name: "chromium".into(),
        unit: Some("kiosk.service".into()),
    }
}

/// Returns a callback with one late call, beside which another thread ran.
fn late(topic: TopicName) -> LateCallback {
    let trigger = Trigger::Subscription(topic);
    let other = OtherThread {
        duration: Duration::from_millis(70),
        thread: 3_122,
        process: 3_121,
        name: "chromium".into(),
        unit: Some("kiosk.service".into()),
        priority: Some(Priority::Nice(-5)),
    };
    let bound = Duration::from_millis(30);
    let states = |cpu: u64, runnable: u64| ThreadStates {
        calls: 1,
        cpu: cpu * 1_000_000,
        runnable: runnable * 1_000_000,
        ..ThreadStates::default()
    };
    let call = LateCall {
        process: 42,
        handle: 0x40,
        node: Some("/lidar".into()),
        trigger: trigger.clone(),
        thread: 43,
        cpu: 2,
        source: Some(Timestamp(LAST.nanoseconds() - 30_000_000)),
        started: Timestamp(LAST.nanoseconds()),
        duration: Duration::from_millis(95),
        wait: Some(Duration::from_millis(10)),
        bound: LateBound {
            duration: bound,
            wait: bound,
        },
        delivery: None,
        handoff: None,
        repairs: Repairs::default(),
        cpu_limits: Arc::new([]),
        stop: None,
        released_by: None,
        busy: None,
        previous: None,
        states: Some(states(25, 70)),
        states_before: Some(states(0, 4)),
        activity: Some(Activity {
            runnable: Duration::from_millis(70),
            others: vec![other],
            ..Activity::default()
        }),
        activity_before: Some(Activity::default()),
    };
    let main = call.main_part(ThreadStates::default());
    let parts = call.parts().into_iter();
    let example = Arc::new(LateExample {
        at: LAST,
        main,
        call: call.clone(),
    });
    let history = LateEntry {
        at: LAST,
        stage: Stage::Callback,
        cause: Cause::Runnable,
        total: call.total(),
        other_thread: Some(chromium()),
    };
    LateCallback {
        owner: owner(0x40),
        trigger,
        calls: 1,
        sums: parts
            .map(|part| ((part.stage, part.cause), part.duration))
            .collect(),
        causes: vec![((Stage::Callback, Cause::Runnable), 1)],
        history: Arc::new([history].into_iter().collect()),
        longest: vec![Arc::clone(&example)],
        latest: vec![example],
    }
}

/// Returns a finding of each kind that only calls inside processes show.
pub fn findings(topic: &TopicKey) -> [Diagnosis; 6] {
    [
        Diagnosis::SlowCallback {
            topic: Some(topic.clone()),
            callback: owner(0x40),
            trigger: Trigger::Subscription(topic.name.clone()),
            duration: Duration::from_millis(120),
            period: Duration::from_millis(50),
            is_own_period: false,
        },
        Diagnosis::ExecutorWait {
            topic: None,
            callback: owner(0x50),
            trigger: Trigger::Timer(Some(Duration::from_millis(50))),
            wait: Duration::from_millis(300),
        },
        Diagnosis::LateCallback {
            topic: Some(topic.clone()),
            callback: owner(0x40),
            trigger: Trigger::Subscription(topic.name.clone()),
            calls: 34,
            stage: Stage::Callback,
            cause: Cause::Runnable,
            by: Some(chromium()),
            longest: Duration::from_millis(105),
        },
        Diagnosis::IntraProcessOverflow {
            topic: topic.clone(),
            queue: owner(0x30),
            overwritten_permille: 140,
        },
        Diagnosis::ReaderQueueOverflow {
            topic: topic.clone(),
            queue: owner(0x20),
            lost_permille: 70,
            depth: Some(10),
        },
        Diagnosis::ObservationSuspended {
            domain_id: DomainId(0),
            process: 42,
            name: Some("mapper".into()),
        },
    ]
}

fn owner(handle: u64) -> Owner {
    Owner {
        process: 42,
        handle,
        domain_id: DomainId(0),
        node: Some("/lidar".into()),
    }
}

fn callback(handle: u64, trigger: Trigger) -> Callback {
    Callback {
        owner: owner(handle),
        trigger,
        thread: 43,
        calls: 990,
        skipped: 6,
        rate_hz: Some(9.9),
        busy: Some(0.4),
        last: LAST,
        duration: quantiles(),
        wait: quantiles(),
        durations: durations(),
        waits: durations(),
        states: states(),
        recent_states: states(),
    }
}

fn states() -> ThreadStates {
    ThreadStates {
        calls: 990,
        cpu: 8_000_000_000,
        throttled: 0,
        runnable: 3_000_000_000,
        blocked: 1_000_000_000,
    }
}

fn quantiles() -> Quantiles {
    Quantiles {
        count: 90,
        p50: Duration::from_millis(12),
        p99: Duration::from_millis(40),
        maximum: Duration::from_millis(44),
    }
}

fn durations() -> Arc<Durations> {
    let mut durations = Durations::default();
    for milliseconds in [1, 12, 40] {
        durations.observe(Duration::from_millis(milliseconds));
    }
    durations.into()
}
