//! Memory of the figures from inside processes, at the caps of their tables.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_daemon::agent_facts::InsideSourceFacts;
use ros2probe_model::facts::calls::late::{
    Activity, Blocked, LateBound, LateCall, PreviousCall, Repairs,
};
use ros2probe_model::facts::calls::other_thread::{OtherThread, Priority};
use ros2probe_model::facts::calls::report::{
    CallbackReport, Durations, ProcessReport, PublisherReport, Report, ThreadStates, Transition,
    Trigger,
};
use ros2probe_wire::DomainId;
use ros2probe_wire::time::SECOND;

use super::*;

const PROCESSES: u32 = 1024;
const HANDLES: u64 = 4;

/// Returns a process with two callbacks and two publishers, each with its own topic, after some
/// seconds.
fn process(id: u32, second: u64, now: u64) -> ProcessReport {
    let mut durations = Durations::default();
    for bit in 10..30 {
        (0..second).for_each(|_| durations.observe(Duration::from_nanos(1 << bit)));
    }
    let topic = |handle: u64| format!("/robot/sensor_{id:04}_{handle}/data_raw");
    let callback = |handle: u64| CallbackReport {
        handle,
        node: Some(format!("/robot/driver_{id:04}").into()),
        trigger: Trigger::Subscription(topic(handle).as_str().into()),
        thread: id,
        calls: 20 * second,
        last: Timestamp(now),
        durations: durations.clone(),
        waits: durations.clone(),
        skipped: 0,
        states: ThreadStates {
            calls: 20 * second,
            cpu: second << 24,
            throttled: second << 20,
            runnable: second << 22,
            blocked: second << 26,
        },
    };
    let publisher = |handle: u64| PublisherReport {
        handle,
        node: Some(format!("/robot/driver_{id:04}").into()),
        topic: topic(handle).as_str().into(),
        middleware: Some("rmw_fastrtps_cpp".into()),
        published: 20 * second,
        within_process: 0,
        last: Timestamp(now),
        intervals: durations.clone(),
    };
    ProcessReport {
        id,
        name: Some(format!("driver_{id:04}").into()),
        domain_id: DomainId(0),
        nodes: vec![format!("/robot/driver_{id:04}").into()],
        shows_intra_process: true,
        callbacks: (0..HANDLES / 2).map(callback).collect(),
        publishers: (HANDLES / 2..HANDLES).map(publisher).collect(),
        ..ProcessReport::default()
    }
}

/// Processes with late calls: a report has at most 1024 of these.
const LATE: u32 = 128;

/// Returns late calls of a process, with all that one can have.
fn late(process: u32, now: u64) -> impl Iterator<Item = LateCall> {
    let other = move |number: u32| OtherThread {
        duration: Duration::from_millis(number.into()),
        thread: number,
        process: number,
        name: format!("thread_{number:08}").into(),
        unit: Some(format!("a-unit-with-a-long-name-{number:08}.service").into()),
        priority: Some(Priority::Nice(0)),
    };
    let activity = move || Activity {
        longest: Some(Blocked {
            duration: Duration::from_millis(5),
            kind: 0,
            call: Some("clock_nanosleep".into()),
            argument: 0,
            waker: Some(other(process)),
        }),
        others: (1..=4).map(other).collect(),
        ..Activity::default()
    };
    let topic = move || format!("/robot/sensor_{process:04}/data_raw");
    let states = Some(ThreadStates::default());
    (0..8).map(move |number| LateCall {
        process,
        handle: 1,
        node: Some(format!("/robot/driver_{process:04}").into()),
        trigger: Trigger::Subscription(topic().as_str().into()),
        thread: process,
        cpu: 0,
        source: Some(Timestamp(now)),
        started: Timestamp(now),
        duration: Duration::from_millis(20 + number),
        wait: Some(Duration::from_millis(5)),
        bound: LateBound {
            duration: Duration::from_millis(5),
            wait: Duration::from_millis(5),
        },
        delivery: None,
        handoff: None,
        repairs: Repairs::default(),
        cpu_limits: Arc::new([]),
        stop: None,
        released_by: None,
        busy: None,
        previous: Some(PreviousCall {
            handle: 2,
            trigger: Trigger::Subscription(topic().as_str().into()),
            duration: Duration::from_millis(5),
            ended_before: Duration::from_millis(5),
        }),
        states,
        states_before: states,
        activity: Some(activity()),
        activity_before: Some(activity()),
    })
}

/// Compares the memory of the tables at their caps, with two snapshots and pages, to
/// [`Limits::INSIDE_BYTES`].
#[test]
fn figures_from_inside_processes_are_below_their_share_of_the_memory_limit() {
    let _alone = MEASUREMENT_LOCK.lock().unwrap();
    let before = resident();
    let mut observer = Observer::new(Settings::default());
    let watches = Watchlist::new(vec![Watch::named("/none").unwrap()]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watches)));
    observer.input(Input::Time(Timestamp(host::START)));
    let mut now = host::START;
    for second in 1..=12 {
        now += SECOND;
        let transition = |id: u32| Transition {
            process: id,
            node: Some(format!("/robot/driver_{id:04}").into()),
            start: "activating".into(),
            goal: "active".into(),
            at: Timestamp(now),
        };
        observer.input(Input::Inside(Report {
            at: Timestamp(now),
            has_callbacks: true,
            processes: (1..=PROCESSES).map(|id| process(id, second, now)).collect(),
            transitions: (1..=PROCESSES).map(transition).collect(),
            late: (1..=LATE).flat_map(|id| late(id, now)).collect(),
        }));
        observer.input(Input::Time(Timestamp(now)));
        observer.drain();
    }
    let modelled = resident() - before;
    let facts = observer.snapshot(Timestamp(now)).inside.unwrap();
    assert_eq!(facts.processes.len(), 1024);
    assert_eq!(facts.callbacks.len() + facts.publishers.len(), 4096);
    assert_eq!(facts.states.len(), 1024);
    drop(facts);
    let sources = MetricSources::new(
        SourceKind::Host,
        ros2probe_daemon::settings_cell::Settings {
            histograms: true,
            ..Default::default()
        },
    );
    let exposition = Exposition::new(sources.clone());
    let (mut pages, mut kept) = (Vec::new(), Vec::new());
    for _ in 0..2 {
        let agent = AgentFacts {
            inside: Some(InsideSourceFacts {
                mode: "full",
                ..InsideSourceFacts::default()
            }),
            ..AgentFacts::new(SourceKind::Host, Instant::now())
        };
        sources
            .latest
            .publish(observer.snapshot(Timestamp(now)), agent);
        kept.push(sources.latest.state());
        pages.push(exposition.render(Format::Classic).unwrap());
    }
    let all = resident() - before;
    let kernel = 9 << 20;
    println!(
        "model {} KiB, with two snapshots and pages ({} KiB each) {} KiB",
        modelled >> 10,
        pages[0].len() >> 10,
        all >> 10,
    );
    let part = Limits::INSIDE_BYTES;
    assert!(all + kernel <= part, "{all} bytes and {kernel} of {part}");
    assert!(
        (all + kernel) * 3 >= part,
        "the part is far too large: {all} and {kernel} of {part}"
    );
}
