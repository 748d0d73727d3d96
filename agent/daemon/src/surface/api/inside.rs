//! `/inside`: observations from inside processes, also for answers about topics and nodes.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::texts;
use super::parameters::Parameters;
use super::problem::Problem;
use super::scope::Domain;
use crate::agent_facts::InsideSourceFacts;
use crate::surface::inside_nodes::NodeActivity;
use ros2probe_api::inside::{
    Buffer, Callback, Counter, Durations, Inside, Library, LifecycleState, NodeInside, Owner,
    Process, Publisher, ReaderQueue, RecentLateCalls, Subscription, ThreadStates, TopicInside,
    Trigger,
};
use ros2probe_model::facts::calls::facts::{self, Quantiles};
use ros2probe_model::facts::calls::report;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};
use ros2probe_wire::DomainId;

/// Time span of late calls in the answer about a topic.
const LATE_WINDOW: Duration = Duration::from_secs(60);

/// Query parameters that select the facts of an answer.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// ROS name of a node or topic; by default all.
    name: Option<String>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(show))
}

/// Calls inside processes
///
/// Publications, takes, messages within processes and callbacks, observed with uprobes on
/// `libtracetools.so`. With `capture.inside: auto`, the observation begins with the first request
/// and ends ten seconds after the last one. The first answer takes up to five seconds. The lists
/// are empty with `off`.
#[utoipa::path(
    get,
    path = "/inside",
    tag = "graph",
    params(Of),
    responses((status = 200, description = "What processes show.", body = Inside<'static>))
)]
async fn show(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let state = context.state().await;
    let snapshot = state.known();
    let source = state.agent.inside.as_ref();
    let mut answer = inside(snapshot, source, |domain_id| domain.admits(domain_id));
    if let Some(name) = of.name {
        select(&mut answer, &name);
    }
    Ok(Json(answer).into_response())
}

fn inside<'a>(
    snapshot: &'a Snapshot,
    source: Option<&'a InsideSourceFacts>,
    admits: impl Fn(DomainId) -> bool,
) -> Inside<'a> {
    let mut answer = Inside {
        timestamp_seconds: snapshot.time().seconds(),
        mode: Cow::Borrowed(source.map_or("off", |source| source.mode)),
        reason: source.and_then(|source| source.reason_off.as_deref().map(Cow::Borrowed)),
        ..Inside::default()
    };
    if let Some(source) = source {
        let libraries = source.libraries.iter().map(|library| Library {
            path: Cow::Borrowed(&library.path),
            processes: library.processes,
            refused: library.refused.as_deref().map(Cow::Borrowed),
        });
        answer.libraries = libraries.collect();
        let counters = source.counters.iter().map(|(name, count)| Counter {
            name: Cow::Borrowed(name),
            count: *count,
        });
        answer.counters = counters.collect();
    }
    let Some(known) = snapshot.inside.as_deref() else {
        return answer;
    };
    let clock = snapshot.wall_clock;
    let is_here = |owner: &facts::Owner| admits(owner.domain_id);
    let processes = known.processes.iter();
    let processes = processes.filter(|each| admits(each.domain_id));
    answer.processes = processes.map(process).collect();
    let publishers = known.publishers.iter().filter(|each| is_here(&each.owner));
    answer.publishers = publishers.map(|each| publisher(each, clock)).collect();
    let subscriptions = known.subscriptions.iter();
    let subscriptions = subscriptions.filter(|each| is_here(&each.owner));
    answer.subscriptions = subscriptions
        .map(|each| subscription(each, clock))
        .collect();
    let queues = known.reader_queues.iter();
    let queues = queues.filter(|each| is_here(&each.owner));
    answer.reader_queues = queues.map(reader_queue).collect();
    let buffers = known.buffers.iter().filter(|each| is_here(&each.owner));
    answer.buffers = buffers.map(|each| buffer(each, clock)).collect();
    let callbacks = known.callbacks.iter().filter(|each| is_here(&each.owner));
    answer.callbacks = callbacks.map(|each| callback(each, clock)).collect();
    let states = known.states.iter().filter(|each| admits(each.domain_id));
    answer.lifecycle_states = states.map(|each| lifecycle_state(each, clock)).collect();
    answer
}

/// Keeps only the entries of the node or topic `name`.
fn select(inside: &mut Inside<'_>, name: &str) {
    let is_own = |owner: &Owner<'_>| owner.node.as_deref() == Some(name);
    let is_topic = |topic: Option<&str>| topic == Some(name);
    inside
        .publishers
        .retain(|each| is_own(&each.owner) || each.topic == name);
    inside
        .subscriptions
        .retain(|each| is_own(&each.owner) || each.topic == name);
    inside
        .reader_queues
        .retain(|each| is_own(&each.owner) || each.topic == name);
    inside
        .buffers
        .retain(|each| is_own(&each.owner) || is_topic(each.topic.as_deref()));
    inside
        .callbacks
        .retain(|each| is_own(&each.owner) || is_topic(each.trigger.name.as_deref()));
    inside
        .lifecycle_states
        .retain(|each| each.node.as_deref() == Some(name));
    let publishers = inside.publishers.iter().map(|each| &each.owner);
    let subscriptions = inside.subscriptions.iter().map(|each| &each.owner);
    let buffers = inside.buffers.iter().map(|each| &each.owner);
    let callbacks = inside.callbacks.iter().map(|each| &each.owner);
    let owners = publishers.chain(subscriptions).chain(buffers);
    let owners = owners.chain(callbacks);
    let own: Vec<u32> = owners.map(|owner| owner.process_id).collect();
    inside.processes.retain(|each| {
        own.contains(&each.process_id) || each.nodes.iter().any(|node| node == name)
    });
}

/// Returns the observations of a topic, without the lists.
pub(super) fn topic<'a>(facts: &'a TopicFacts, snapshot: &Snapshot) -> Option<TopicInside<'a>> {
    let inside = facts.inside.as_deref()?;
    let clock = snapshot.wall_clock;
    let counts = inside.counts;
    Some(TopicInside {
        published_messages: counts.published,
        within_process_messages: counts.within_process,
        taken_messages: counts.taken,
        failed_takes: counts.failed,
        enqueued_messages: counts.enqueued,
        overwritten_messages: counts.overwritten,
        dequeued_messages: counts.dequeued,
        intra_process_receptions: counts.receptions,
        lost_in_reader_queue_messages: inside.lost_in_queues,
        rate_hertz: inside.rate_hz,
        last_message_timestamp_seconds: inside.last.map(|last| clock.wall_time(last).seconds()),
        observed_publishers: inside.publishers,
        observed_subscriptions: inside.subscriptions,
        late: late(facts, snapshot),
        ..TopicInside::default()
    })
}

/// Returns the late calls of the callbacks of a topic in the last minute.
fn late(facts: &TopicFacts, snapshot: &Snapshot) -> Option<RecentLateCalls<'static>> {
    let callbacks = snapshot.inside.as_deref()?.late.iter();
    let own = callbacks.filter(|callback| {
        callback.owner.domain_id == facts.domain_id && is_triggered_by(&callback.trigger, facts)
    });
    let recent = own.flat_map(|callback| {
        let entries = callback.history.iter();
        entries.filter(|entry| snapshot.at - entry.at < LATE_WINDOW)
    });
    let (mut calls, mut longest, mut causes) = (0, Duration::ZERO, BTreeMap::new());
    for entry in recent {
        calls += 1;
        longest = longest.max(entry.total);
        *causes
            .entry((entry.cause, &entry.other_thread))
            .or_insert(0) += 1;
    }
    let ((cause, by_thread), _) = causes.into_iter().max_by_key(|(_, calls)| *calls)?;
    Some(RecentLateCalls {
        calls,
        longest_seconds: longest.as_secs_f64(),
        cause: cause.label().into(),
        words: cause.in_words(by_thread.as_ref().map(|by| by as _)).into(),
    })
}

/// Returns whether messages of the topic trigger a callback.
fn is_triggered_by(trigger: &report::Trigger, facts: &TopicFacts) -> bool {
    !matches!(trigger, report::Trigger::Service(_)) && trigger.name() == Some(facts.name.as_str())
}

/// Returns the observations of a topic, with its publishers, subscriptions, buffers and callbacks.
pub(super) fn topic_details<'a>(
    facts: &'a TopicFacts,
    snapshot: &'a Snapshot,
) -> Option<TopicInside<'a>> {
    let clock = snapshot.wall_clock;
    let (mut shown, known) = (topic(facts, snapshot)?, snapshot.inside.as_deref()?);
    let name = &facts.name;
    let is_here = |owner: &facts::Owner| owner.domain_id == facts.domain_id;
    let own =
        |owner, topic: &ros2probe_model::facts::names::TopicName| is_here(owner) && topic == name;
    let publishers = known.publishers.iter();
    let publishers = publishers.filter(|each| own(&each.owner, &each.topic));
    shown.publishers = publishers.map(|each| publisher(each, clock)).collect();
    let subscriptions = known.subscriptions.iter();
    let subscriptions = subscriptions.filter(|each| own(&each.owner, &each.topic));
    shown.subscriptions = subscriptions
        .map(|each| subscription(each, clock))
        .collect();
    let queues = known.reader_queues.iter();
    let queues = queues.filter(|each| own(&each.owner, &each.topic));
    shown.reader_queues = queues.map(reader_queue).collect();
    let buffers = known.buffers.iter();
    let buffers = buffers.filter(|each| is_here(&each.owner) && each.topic.as_ref() == Some(name));
    shown.buffers = buffers.map(|each| buffer(each, clock)).collect();
    let callbacks = known.callbacks.iter();
    let callbacks =
        callbacks.filter(|each| is_here(&each.owner) && is_triggered_by(&each.trigger, facts));
    shown.callbacks = callbacks.map(|each| callback(each, clock)).collect();
    Some(shown)
}

/// Returns the observations of a node, or `None` without observations.
pub(super) fn node<'a>(
    (domain_id, name): (DomainId, &str),
    activity: NodeActivity<'a>,
    snapshot: &'a Snapshot,
) -> Option<NodeInside<'a>> {
    let (known, clock) = (snapshot.inside.as_deref()?, snapshot.wall_clock);
    let is_own = |owner: &facts::Owner| {
        owner.domain_id == domain_id && owner.node.as_ref().is_some_and(|node| *node == *name)
    };
    let publishers = known.publishers.iter().filter(|each| is_own(&each.owner));
    let subscriptions = known.subscriptions.iter();
    let subscriptions = subscriptions.filter(|each| is_own(&each.owner));
    let queues = known.reader_queues.iter();
    let queues = queues.filter(|each| is_own(&each.owner));
    let buffers = known.buffers.iter().filter(|each| is_own(&each.owner));
    let callbacks = known.callbacks.iter().filter(|each| is_own(&each.owner));
    let node = NodeInside {
        busy_ratio: activity.busy,
        lifecycle_state: activity.state.map(Cow::Borrowed),
        publishers: publishers.map(|each| publisher(each, clock)).collect(),
        subscriptions: subscriptions
            .map(|each| subscription(each, clock))
            .collect(),
        reader_queues: queues.map(reader_queue).collect(),
        buffers: buffers.map(|each| buffer(each, clock)).collect(),
        callbacks: callbacks.map(|each| callback(each, clock)).collect(),
    };
    (node != NodeInside::default()).then_some(node)
}

/// Returns the API representation of a trigger.
pub(super) fn trigger(trigger: &report::Trigger) -> Trigger<'_> {
    Trigger {
        kind: Cow::Borrowed(trigger.label()),
        name: trigger.name().map(Cow::Borrowed),
        period_seconds: trigger.period().map(|period| period.as_secs_f64()),
    }
}

fn process(facts: &facts::ObservedProcess) -> Process<'_> {
    Process {
        process_id: facts.id,
        process: facts.name.as_deref().map(Cow::Borrowed),
        domain_id: facts.domain_id.0,
        nodes: texts(&facts.nodes),
        cpu_ratio: facts.cpu,
        calls_per_second: facts.calls_hz,
        calls: facts.calls,
        refused_calls: facts.refused,
        suspended: facts.is_suspended,
        shows_intra_process: facts.shows_intra_process,
    }
}

pub(super) fn owner(owner: &facts::Owner) -> Owner<'_> {
    Owner {
        process_id: owner.process,
        handle: Cow::Owned(format!("{:#x}", owner.handle)),
        domain_id: owner.domain_id.0,
        node: owner.node.as_deref().map(Cow::Borrowed),
    }
}

fn durations(quantiles: &Quantiles) -> Option<Durations> {
    (quantiles.count > 0).then_some(Durations {
        count: quantiles.count,
        p50_seconds: quantiles.p50.as_secs_f64(),
        p99_seconds: quantiles.p99.as_secs_f64(),
        maximum_seconds: quantiles.maximum.as_secs_f64(),
    })
}

fn publisher(facts: &facts::Publisher, clock: WallClock) -> Publisher<'_> {
    Publisher {
        owner: owner(&facts.owner),
        topic: Cow::Borrowed(&facts.topic),
        middleware: facts.middleware.as_deref().map(Cow::Borrowed),
        published_messages: facts.published,
        within_process_messages: facts.within_process,
        rate_hertz: facts.rate_hz,
        last_message_timestamp_seconds: clock.wall_time(facts.last).seconds(),
        interval: durations(&facts.interval),
    }
}

fn subscription(facts: &facts::Subscription, clock: WallClock) -> Subscription<'_> {
    Subscription {
        owner: owner(&facts.owner),
        topic: Cow::Borrowed(&facts.topic),
        middleware: facts.middleware.as_deref().map(Cow::Borrowed),
        taken_messages: facts.taken,
        failed_takes: facts.failed,
        rate_hertz: facts.rate_hz,
        last_message_timestamp_seconds: clock.wall_time(facts.last).seconds(),
        latency: durations(&facts.latency),
    }
}

fn reader_queue(facts: &facts::ReaderQueue) -> ReaderQueue<'_> {
    ReaderQueue {
        owner: owner(&facts.owner),
        topic: Cow::Borrowed(&facts.topic),
        writer: facts.writer.map(|writer| writer.to_string()),
        depth: facts.depth,
        arrived_messages: facts.arrived,
        taken_messages: facts.taken,
        lost_messages: facts.lost,
    }
}

fn buffer(facts: &facts::Buffer, clock: WallClock) -> Buffer<'_> {
    Buffer {
        owner: owner(&facts.owner),
        topic: facts.topic.as_deref().map(Cow::Borrowed),
        enqueued_messages: facts.enqueued,
        overwritten_messages: facts.overwritten,
        dequeued_messages: facts.dequeued,
        overwritten_ratio: facts.overwritten_ratio,
        depth: facts.depth,
        maximum_depth: facts.max_depth,
        capacity: facts.capacity,
        rate_hertz: facts.rate_hz,
        last_message_timestamp_seconds: clock.wall_time(facts.last).seconds(),
        waiting: durations(&facts.waiting),
    }
}

fn callback(facts: &facts::Callback, clock: WallClock) -> Callback<'_> {
    Callback {
        owner: owner(&facts.owner),
        trigger: trigger(&facts.trigger),
        thread_id: facts.thread,
        calls: facts.calls,
        skipped_periods: facts.skipped,
        rate_hertz: facts.rate_hz,
        busy_ratio: facts.busy,
        last_call_timestamp_seconds: clock.wall_time(facts.last).seconds(),
        duration: durations(&facts.duration),
        wait: durations(&facts.wait),
        states_seconds: thread_states(&facts.states, 1e9),
        states_ratio: {
            let sum: u64 = facts.recent_states.nanoseconds().iter().sum();
            thread_states(&facts.recent_states, sum.max(1) as f64)
        },
    }
}

/// Returns times in units of `unit` nanoseconds; `None` if they cover no call.
#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of some months are below 2^53"
)]
fn thread_states(states: &report::ThreadStates, unit: f64) -> Option<ThreadStates> {
    let [cpu, throttled, runnable, blocked] = states.nanoseconds().map(|time| time as f64 / unit);
    (states.calls > 0).then_some(ThreadStates {
        cpu,
        throttled,
        runnable,
        blocked,
    })
}

fn lifecycle_state(facts: &facts::LifecycleState, clock: WallClock) -> LifecycleState<'_> {
    LifecycleState {
        process_id: facts.process,
        domain_id: facts.domain_id.0,
        node: facts.node.as_deref().map(Cow::Borrowed),
        state: Cow::Borrowed(&facts.state),
        previous_state: Cow::Borrowed(&facts.before),
        timestamp_seconds: clock.wall_time(facts.at).seconds(),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros2probe_model::facts::calls::report::{
        CallbackReport, ProcessReport, PublisherReport, Report, Trigger,
    };
    use ros2probe_model::observe::input::Input;
    use ros2probe_model::observe::observer::{Observer, Settings};
    use ros2probe_testing::sample_robot;
    use ros2probe_wire::Timestamp;
    use ros2probe_wire::time::SECOND;

    use super::*;

    /// A robot whose `/lidar` publishes `/scan` ten times a second.
    fn robot() -> Snapshot {
        let mut observer = Observer::new(Settings::default());
        let start = 1_795_143_000 * SECOND;
        observer.input(Input::Time(Timestamp(start)));
        for second in 1..=3 {
            let at = Timestamp(start + second * SECOND);
            let mut durations = report::Durations::default();
            durations.observe(Duration::from_millis(second));
            let process = ProcessReport {
                id: 70,
                nodes: vec!["/lidar".into()],
                publishers: vec![PublisherReport {
                    handle: 0x10,
                    node: None,
                    topic: "/scan".into(),
                    middleware: None,
                    published: 10 * second,
                    within_process: 0,
                    last: at,
                    intervals: report::Durations::default(),
                }],
                callbacks: vec![CallbackReport {
                    handle: 0x20,
                    node: None,
                    trigger: Trigger::Timer(Some(Duration::from_millis(100))),
                    thread: 1,
                    calls: 10 * second,
                    last: at,
                    durations,
                    waits: report::Durations::default(),
                    skipped: 0,
                    states: report::ThreadStates {
                        calls: 10 * second,
                        cpu: 3 * second * 1_000_000_000,
                        blocked: second * 1_000_000_000,
                        ..report::ThreadStates::default()
                    },
                }],
                ..ProcessReport::default()
            };
            observer.input(Input::Inside(Report {
                at,
                has_callbacks: true,
                processes: vec![process],
                transitions: Vec::new(),
                late: Vec::new(),
            }));
            observer.input(Input::Time(at));
        }
        observer.snapshot(Timestamp(start + 3 * SECOND))
    }

    #[test]
    fn a_report_appears_in_the_answers_about_its_topic_and_node() {
        let snapshot = robot();
        let answer = inside(&snapshot, None, |_| true);
        let publisher = &answer.publishers[0];
        assert_eq!(publisher.owner.node.as_deref(), Some("/lidar"));
        assert_eq!(
            (publisher.published_messages, &*publisher.owner.handle),
            (30, "0x10")
        );
        assert!((publisher.rate_hertz.unwrap() - 10.0).abs() < 0.01);
        let elsewhere = inside(&snapshot, None, |_| false);
        assert!(elsewhere.publishers.is_empty() && elsewhere.processes.is_empty());

        let facts = snapshot.topics.iter().find(|topic| topic.name == "/scan");
        let topic = topic_details(facts.unwrap(), &snapshot).unwrap();
        assert_eq!((topic.published_messages, topic.publishers.len()), (30, 1));
        assert!(topic.callbacks.is_empty(), "its timer has no topic");

        let key = (DomainId(0), "/lidar");
        let activity = NodeActivity::all(&snapshot)[&key];
        let node = node(key, activity, &snapshot).unwrap();
        assert_eq!((node.callbacks.len(), node.publishers.len()), (1, 1));
        let callback = &node.callbacks[0];
        assert_eq!(callback.trigger.words(), "timer 100 ms");
        let states = callback.states_seconds.unwrap();
        assert_eq!(
            [states.cpu, states.blocked, states.runnable],
            [9.0, 3.0, 0.0]
        );
        let shares = callback.states_ratio.unwrap();
        assert_eq!(
            [shares.cpu, shares.blocked, shares.throttled],
            [0.75, 0.25, 0.0]
        );
        assert!(
            super::node((DomainId(0), "/camera"), NodeActivity::default(), &snapshot).is_none()
        );
    }

    #[test]
    fn a_name_selects_a_node_or_a_topic_with_its_processes() {
        let snapshot = robot();
        let selected = |name| {
            let mut answer = inside(&snapshot, None, |_| true);
            select(&mut answer, name);
            let counts = (answer.publishers.len(), answer.callbacks.len());
            (counts, answer.processes.len())
        };
        assert_eq!(selected("/lidar"), ((1, 1), 1));
        assert_eq!(selected("/scan"), ((1, 0), 1));
        assert_eq!(selected("/imu"), ((0, 0), 0));
    }

    #[test]
    fn a_missing_source_has_the_mode_off_and_a_failed_one_its_reason() {
        let snapshot = Snapshot::default();
        assert_eq!(inside(&snapshot, None, |_| true).mode, "off");
        let source = InsideSourceFacts {
            mode: "full",
            reason_off: Some("CAP_BPF is missing".to_owned()),
            ..InsideSourceFacts::default()
        };
        let answer = inside(&snapshot, Some(&source), |_| true);
        assert_eq!(answer.reason.as_deref(), Some("CAP_BPF is missing"));
    }

    #[test]
    fn a_topic_has_the_late_calls_of_its_own_callbacks_in_the_last_minute() {
        let mut snapshot = sample_robot::snapshot(["/points"]);
        let facts = sample_robot::topic("/points");
        let found = late(&facts, &snapshot).unwrap();
        assert_eq!((found.calls, &*found.cause), (1, "runnable"));
        assert_eq!(found.words, "chromium (kiosk.service) ran instead");
        assert_eq!(late(&sample_robot::topic("/other"), &snapshot), None);
        let elsewhere = TopicFacts {
            domain_id: DomainId(9),
            ..sample_robot::topic("/points")
        };
        assert_eq!(late(&elsewhere, &snapshot), None);
        let mut of_service = snapshot.clone();
        let inside = Arc::make_mut(of_service.inside.as_mut().unwrap());
        inside.late[0].trigger = report::Trigger::Service(Some("/points".into()));
        assert_eq!(late(&facts, &of_service), None);
        snapshot.at = snapshot.at + Duration::from_secs(60);
        assert_eq!(late(&facts, &snapshot), None, "a minute ago");
    }
}
