//! Log of events under bursts, slow readers and restarts.

use ros2probe_wire::{DomainId, Guid, SequenceNumber};

use super::*;
use ros2probe_model::facts::churn;
use ros2probe_model::facts::event::{Event, EventKind, LossBurst};
use ros2probe_model::report::snapshot::WatchState;

fn node(at: u64) -> Event {
    Event {
        at: Timestamp(at),
        kind: EventKind::Node {
            change: churn::Event::Appeared,
            domain_id: DomainId(7),
            participant: Guid::from_bytes([1; 16]),
            name: "/lidar".into(),
        },
    }
}

fn taken(events: Vec<Event>) -> Taken {
    let overflow = Vec::new();
    Taken { events, overflow }
}

/// Returns the time at the start of a second of the clock.
const fn second(number: u64) -> Timestamp {
    Timestamp(number * SECOND)
}

impl EventLog {
    /// Records that messages were lost, when the source's time is `clock`.
    pub(crate) fn lose_messages(&self, count: u64, at: Timestamp, clock: Timestamp) {
        let kind = EventKind::Loss(LossBurst {
            writer: Guid::default(),
            topic: None,
            node: None,
            count,
            first: SequenceNumber(1),
            last: SequenceNumber(count),
        });
        self.add(taken(vec![Event { at, kind }]), clock);
    }
}

fn names(batch: &Batch) -> Vec<&'static str> {
    let records = batch.records.iter();
    records.map(|record| record.definition.name).collect()
}

#[test]
fn numbers_grow_by_one_and_a_reader_continues_after_its_position() {
    let log = EventLog::new();
    assert_eq!((log.last(), log.read(0, 10).records.len()), (0, 0));
    log.add(taken((1..=3).map(node).collect()), second(0));
    let first = log.read(0, 2);
    let numbers: Vec<_> = first.records.iter().map(|record| record.number).collect();
    assert_eq!((first.lagged, first.last, numbers), (0, 2, vec![1, 2]));
    let second = log.read(first.last, 10);
    let record = &second.records[0];
    assert_eq!(
        (second.last, record.number, record.at),
        (3, 3, Timestamp(3))
    );
    assert_eq!(record.definition.name, "ros2.node.discovered");
    assert_eq!(
        record.attributes,
        [
            ("domain_id", Value::Number(7)),
            ("ros_node", Value::Text("/lidar".to_owned())),
            (
                "participant",
                Value::Text("010101010101010101010101.01010101".to_owned())
            ),
        ]
    );
    let nothing = log.read(second.last, 10);
    assert_eq!((nothing.last, nothing.records.len()), (3, 0));
}

#[test]
fn a_lifecycle_transition_is_a_warning_only_on_an_error() {
    let log = EventLog::new();
    let transition = |name: Option<&str>, from: &str, to: &str| Event {
        kind: EventKind::Lifecycle {
            process: Some(70),
            domain_id: DomainId(7),
            node: name.map(Into::into),
            to: to.into(),
            from: from.into(),
        },
        ..node(1)
    };
    let transitions = vec![
        transition(Some("/lidar"), "activating", "active"),
        transition(None, "active", "errorprocessing"),
    ];
    log.add(taken(transitions), second(0));
    let batch = log.read(0, 2);
    let name = "ros2.node.lifecycle_transition";
    assert_eq!(names(&batch), [name, name]);
    let severities: Vec<_> = batch.records.iter().map(|each| each.severity).collect();
    assert_eq!(severities, [Severity::Info, Severity::Warn]);
    let text = |text: &str| Value::Text(text.to_owned());
    assert_eq!(
        batch.records[0].attributes,
        [
            ("domain_id", Value::Number(7)),
            ("ros_node", text("/lidar")),
            ("process_id", Value::Number(70)),
            ("from", text("activating")),
            ("to", text("active")),
        ]
    );
    assert_eq!(batch.records[1].attribute("ros_node"), None);
}

#[test]
fn a_topic_that_loses_its_only_subscriber_is_no_problem_and_no_trigger() {
    let log = EventLog::new();
    let changed = |from, to| Event {
        kind: EventKind::Expectation {
            domain_id: DomainId(7),
            topic: "/scan".into(),
            watch: "/scan".into(),
            from: Some(from),
            to,
            violations: Vec::new(),
        },
        ..node(1)
    };
    let (ok, alone) = (WatchState::Ok, WatchState::NoSubscriber);
    let states = [
        (ok, alone),
        (alone, ok),
        (ok, WatchState::Silent),
        (ok, WatchState::NotPublished),
        (ok, WatchState::Violated),
    ];
    let events = states.map(|(from, to)| changed(from, to));
    log.add(taken(events.into()), second(0));
    let records = log.read(0, 10).records;
    let severities: Vec<_> = records.iter().map(|each| each.severity).collect();
    let (info, warn) = (Severity::Info, Severity::Warn);
    assert_eq!(severities, [info, info, warn, warn, warn]);
    let trigger = Trigger::parse("expectation").unwrap();
    let triggers = records.iter().map(|record| trigger.matches(record, 7));
    assert!(triggers.eq([false, false, true, true, true]));
}

#[test]
fn a_burst_is_limited_each_second_and_summarized_in_one_event() {
    let log = EventLog::new();
    let storm = u64::from(MAX_EVENTS_PER_SECOND) + 50;
    log.add(taken((0..storm).map(node).collect()), second(0));
    let other = Event {
        kind: EventKind::Silence {
            domain_id: DomainId(0),
            topic: "/imu".into(),
            watch: "/imu".into(),
            last_message: None,
        },
        ..node(1)
    };
    let mut more = taken(vec![node(1), other]);
    more.overflow = vec![(Class::Endpoint, 9)];
    log.add(more, second(1));
    let batch = log.read(0, KeptEvents::CAP);
    assert_eq!(
        batch.records.len() as u64,
        u64::from(MAX_EVENTS_PER_SECOND) + 1
    );
    assert_eq!(names(&batch).last(), Some(&"ros2.topic.silent"));
    log.add(Taken::default(), second(1));
    assert_eq!(log.last(), batch.last);

    log.add(taken(vec![node(2 * SECOND)]), second(2));
    let rest = log.read(batch.last, KeptEvents::CAP);
    let suppressed = "ros2probe.events.suppressed";
    assert_eq!(
        names(&rest),
        [suppressed, suppressed, "ros2.node.discovered"]
    );
    let recorded: Vec<_> = rest.records[..2]
        .iter()
        .map(|record| record.attributes.clone())
        .collect();
    let text = |text: &str| Value::Text(text.to_owned());
    assert_eq!(
        recorded,
        [
            [
                ("event", text("ros2.endpoint.*")),
                ("count", Value::Number(9))
            ],
            [
                ("event", text("ros2.node.discovered")),
                ("count", Value::Number(51))
            ]
        ]
    );
    assert_eq!(log.dropped()[0], ("storm", 60));
    let recorded: BTreeMap<_, _> = log.recorded().into_iter().collect();
    assert_eq!(
        recorded["ros2.node.discovered"],
        u64::from(MAX_EVENTS_PER_SECOND) + 1
    );
    assert_eq!(
        (recorded[suppressed], recorded["ros2.message.lost"]),
        (2, 0)
    );
}

#[test]
fn a_burst_of_agent_events_is_limited_by_the_clock_of_the_agent() {
    let log = EventLog::new();
    let at = |seconds| log.started + Duration::from_secs(seconds);
    for _ in 0..MAX_EVENTS_PER_SECOND + 3 {
        log.record_at(AgentEvent::Reloaded { watches: 1 }, at(1));
    }
    assert_eq!(log.last(), u64::from(MAX_EVENTS_PER_SECOND));
    log.record_at(AgentEvent::Reloaded { watches: 1 }, at(2));
    let rest = log.read(MAX_EVENTS_PER_SECOND.into(), 10);
    assert_eq!(names(&rest)[0], "ros2probe.events.suppressed");
    assert_eq!(rest.records.len(), 2);
}

#[test]
fn replays_at_full_and_at_capture_speed_record_the_same_events() {
    let events: Vec<_> = (0..430).map(|number| node(number * SECOND / 100)).collect();
    let (at_once, paced) = (EventLog::new(), EventLog::new());
    at_once.add(taken(events.clone()), second(5));
    for event in events {
        let clock = event.at;
        paced.add(taken(vec![event]), clock);
    }
    let recorded = |log: &EventLog| {
        log.settle();
        let records = log.read(0, KeptEvents::CAP).records;
        let recorded = records
            .iter()
            .map(|record| (record.at, record.definition.name));
        recorded.collect::<Vec<_>>()
    };
    let told_at_once = recorded(&at_once);
    assert_eq!(told_at_once.len(), 430);
    assert_eq!(told_at_once, recorded(&paced));
}

#[test]
fn another_run_has_no_earlier_events_and_no_reader_misses_them() {
    let log = EventLog::new();
    log.add(taken((1..=3).map(node).collect()), second(0));
    let (run, id) = (log.run(), log.id(3));
    assert_eq!(log.position(&id), Some(Position::After(3)));
    log.begin_run();
    assert_ne!(log.run(), run);
    assert_eq!(log.position(&id), Some(Position::Unknown));
    // The second of the burst limit begins again, too.
    log.add(taken(vec![node(1)]), second(0));
    for after in [0, 2, 3] {
        let batch = log.read(after, 10);
        assert_eq!((batch.lagged, batch.records.len(), batch.last), (0, 1, 4));
    }
}

#[test]
fn overwritten_events_are_reported_to_the_reader_that_missed_them() {
    let log = EventLog::new();
    for number in 0..25 {
        // The events are two seconds apart, since a late event counts in the current second.
        let at = second(2 * number);
        log.add(taken((0..200).map(|each| node(at.0 + each)).collect()), at);
    }
    assert_eq!(log.last(), 5000);
    let batch = log.read(100, KeptEvents::CAP);
    let lost = 5000 - KeptEvents::CAP as u64 - 100;
    assert_eq!((batch.lagged, batch.last), (lost, 5000));
    assert_eq!(batch.records.len(), KeptEvents::CAP);
    crate::tables::tests::assert_driven::<KeptEvents>();
    assert_eq!(log.read(4000, 1).lagged, 0);
    log.count_overwritten(Reader::Otlp, lost);
    assert!(log.dropped().contains(&("otlp_lagged", lost)));
    // An impossible position returns no events.
    assert_eq!(log.read(u64::MAX, 1).records.len(), 0);
}

#[test]
fn an_event_id_of_another_run_is_an_unknown_position() {
    let log = EventLog::new();
    log.add(taken(vec![node(1), node(2)]), second(0));
    assert_eq!(log.position(&log.id(1)), Some(Position::After(1)));
    let before = EventLog::new();
    let Run(run) = log.number_of_run();
    before.run.store(run - 1, Ordering::Release);
    before.add(taken(vec![node(1), node(2), node(3)]), second(0));
    assert_eq!(log.position(&before.id(1)), Some(Position::Unknown));
    assert_eq!(log.position(&log.id(3)), Some(Position::Unknown));
    for nonsense in ["", "1", "-", "x-1", "1-x", "1--1", "1-1-1"] {
        assert_eq!(log.position(nonsense), None, "{nonsense}");
    }
}

#[tokio::test]
async fn a_waiting_reader_is_woken_by_the_next_event() {
    let log = Arc::new(EventLog::new());
    log.wait(0).await_soon(false).await;
    log.record(AgentEvent::Reloaded { watches: 3 });
    log.wait(0).await_soon(true).await;
    let waiting = Arc::clone(&log);
    let woken = tokio::spawn(async move { waiting.wait(1).await });
    tokio::task::yield_now().await;
    log.add(taken(vec![node(1)]), second(0));
    woken.await_soon(true).await;
}

/// Waits briefly for a future.
trait AwaitSoon: Future + Sized {
    async fn await_soon(self, expected: bool) {
        let timeout = Duration::from_millis(if expected { 10_000 } else { 20 });
        let came = tokio::time::timeout(timeout, self).await.is_ok();
        assert_eq!(came, expected);
    }
}

impl<F: Future> AwaitSoon for F {}
