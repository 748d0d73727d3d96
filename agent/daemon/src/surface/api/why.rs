//! `/why`: late calls of callbacks.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::chains::parts;
use super::inside::{owner, trigger};
use super::parameters::Parameters;
use super::problem::{Code, Problem};
use super::scope::Domain;
use crate::agent_facts::InsideSourceFacts;
use ros2probe_api::chains::{Chain, Hop};
use ros2probe_api::why::{
    Blocked, Cause, LateCall, LateCallSummary, LateCallback, OtherThread, Part, PreviousCall, Why,
};
use ros2probe_capture::inside::late::{BoundScope, RequestedBound};
use ros2probe_model::facts::calls::facts::{self, InsideFacts, LateExample};
use ros2probe_model::facts::calls::report::Trigger;
use ros2probe_model::facts::calls::{late, other_thread};
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;

/// Longest bound that a request may set, in milliseconds.
const LONGEST_MS: f64 = 3_600_000.0;

/// Longest time that a request may look back, in seconds.
const LONGEST_S: f64 = 1e9;

/// A cause with the thread that it names.
type Named = (late::Stage, late::Cause, Option<other_thread::ThreadLabel>);

/// Query parameters that select late calls.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// ROS name of a topic or node; by default all.
    name: Option<String>,
    /// ROS name of the first topic of chains, as for `/chains`. Then only callbacks of their nodes
    /// count: of the messages of the chain, and of timers.
    from: Option<String>,
    /// ROS name of the last topic of chains, as for `/chains`.
    to: Option<String>,
    /// Calls of these callbacks are late if they take or wait longer than this, until ten seconds
    /// after the last request. Without it, the bound is `max_latency_ms` of the topic. Without
    /// that, it is three times the 99th percentile of the callback's calls.
    #[param(minimum = 0, maximum = 3_600_000)]
    above_ms: Option<f64>,
    /// Only late calls of the last seconds; by default all that are known.
    #[param(minimum = 0, maximum = 1_000_000_000)]
    last_s: Option<f64>,
    /// Whether each callback also lists its last late calls.
    history: bool,
}

impl Of {
    /// Returns a text that differs for requests about other callbacks.
    fn key(&self) -> Option<String> {
        let domain = self.domain_id.map(|id| id.to_string());
        let parts = [&domain, &self.name, &self.from, &self.to];
        let is_any = parts.iter().any(|part| part.is_some());
        let parts = parts.map(|part| part.as_deref().unwrap_or_default());
        is_any.then(|| parts.join(" "))
    }

    /// Returns which callbacks have the requested bound. Those in `listed` are meant and known.
    fn scope(&self, listed: BTreeSet<(u32, u64)>) -> BoundScope {
        let listed = Arc::new(listed);
        match (&self.name, &self.from, &self.to, self.domain_id) {
            (None, None, None, None) => BoundScope::All,
            (Some(name), None, None, domain_id) => BoundScope::Named {
                name: Arc::from(name.as_str()),
                domain_id: domain_id.map(DomainId),
                listed,
            },
            _ => BoundScope::Listed(listed),
        }
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(show))
}

/// Late calls of callbacks, and what made them late
///
/// With `capture.late: auto`, the events of the scheduler are observed from the first request until
/// ten seconds after the last one. Late calls at other times have no thread that ran instead. The
/// callbacks must be observed, as for `/inside`.
#[utoipa::path(
    get,
    path = "/why",
    tag = "graph",
    params(Of),
    responses((status = 200, description = "Late calls.", body = Why<'static>))
)]
async fn show(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let above = of
        .above_ms
        .map(|above| number_in_range("above_ms", above, LONGEST_MS));
    let above = above.transpose()?;
    let above = above.map(|above| Duration::from_secs_f64(above / 1e3));
    let last = of
        .last_s
        .map(|last| number_in_range("last_s", last, LONGEST_S));
    let last = last.transpose()?.map(Duration::from_secs_f64);
    let key = of.key();
    context.latest.request_late_calls(key.as_deref(), None);
    let state = context.state().await;
    let snapshot = state.known();
    let source = state.agent.inside.as_ref();
    let ends = (of.from.as_deref(), of.to.as_deref());
    let chains =
        (ends != (None, None)).then(|| parts(snapshot.chains.chains.iter(), ends.0, ends.1));
    let is_meant = |owner: &facts::Owner, trigger: &Trigger| {
        let name = of.name.as_deref();
        domain.admits(owner.domain_id)
            && (chains.as_ref()).is_none_or(|chains| is_in_any(chains, owner, trigger))
            && (name.is_none() || name == trigger.name() || name == owner.node.as_deref())
    };
    if let Some(above) = above {
        let known = snapshot.inside.iter().flat_map(|inside| &inside.callbacks);
        let meant = known.filter(|callback| is_meant(&callback.owner, &callback.trigger));
        let listed = meant.map(|callback| (callback.owner.process, callback.owner.handle));
        let bound = RequestedBound {
            of: of.scope(listed.collect()),
            above,
        };
        (context.latest).request_late_calls(key.as_deref(), Some(bound));
    }
    let is_meant = |callback: &facts::LateCallback| is_meant(&callback.owner, &callback.trigger);
    let selection = Selection {
        last,
        has_history: of.history,
    };
    Ok(Json(why(snapshot, source, selection, is_meant)).into_response())
}

/// Returns whether a callback handles messages of one of these chains, or is a timer of one of their
/// nodes. A timer may publish what a callback has kept.
fn is_in_any(chains: &[Chain<'_>], owner: &facts::Owner, trigger: &Trigger) -> bool {
    let node = owner.node.as_deref();
    let is_in = |hop: &Hop<'_>| match trigger {
        Trigger::Subscription(topic) | Trigger::IntraProcess(Some(topic)) => {
            let is_other = |(one, other)| one != other;
            **topic == *hop.input && !node.zip(hop.node.as_deref()).is_some_and(is_other)
        }
        Trigger::Timer(_) => node.is_some() && node == hop.node.as_deref(),
        Trigger::IntraProcess(None) | Trigger::Service(_) => false,
    };
    chains
        .iter()
        .any(|chain| chain.domain_id == owner.domain_id.0 && chain.hops.iter().any(is_in))
}

/// Returns a number from 0 to `largest`, or the problem of another one.
fn number_in_range(name: &str, number: f64, largest: f64) -> Result<f64, Problem> {
    match (0.0..=largest).contains(&number) {
        true => Ok(number),
        false => {
            let text = format!("{name} must be from 0 to {largest}, not {number}");
            Err(Problem::new(Code::MalformedRequest, text))
        }
    }
}

/// Which late calls an answer has.
#[derive(Clone, Copy, Debug)]
struct Selection {
    /// Only those of this time until now.
    last: Option<Duration>,
    /// Whether each callback lists its last late calls.
    has_history: bool,
}

fn why<'a>(
    snapshot: &'a Snapshot,
    source: Option<&'a InsideSourceFacts>,
    selection: Selection,
    is_meant: impl Fn(&facts::LateCallback) -> bool,
) -> Why<'a> {
    let mut answer = Why {
        timestamp_seconds: snapshot.time().seconds(),
        observed: Cow::Borrowed(source.map_or("off", |source| source.late)),
        reason: source.and_then(|source| {
            let reason_off = source.reason_off.as_deref();
            reason_off
                .or_else(|| source.without_causes())
                .map(Cow::Borrowed)
        }),
        ..Why::default()
    };
    let Some(known) = snapshot.inside.as_deref() else {
        return answer;
    };
    let since = selection
        .last
        .map_or(ModelTime::ZERO, |last| snapshot.at - last);
    let clock = snapshot.wall_clock;
    let callbacks = known.late.iter().filter(|callback| is_meant(callback));
    let callbacks: Vec<_> = callbacks
        .filter(|callback| callback.last() >= since)
        .collect();
    answer.causes = causes(&callbacks, since);
    let callbacks = callbacks.into_iter();
    answer.callbacks = callbacks
        .map(|callback| {
            let mut shown = late_callback(callback, known, since, clock);
            if selection.has_history {
                let calls = callback.history.iter().filter(|entry| entry.at >= since);
                shown.history = calls.map(|entry| summary(entry, clock)).collect();
            }
            shown
        })
        .collect();
    answer
        .callbacks
        .sort_by_key(|callback| std::cmp::Reverse(callback.late_calls));
    answer
}

/// Returns the causes of the late calls since a time, the most frequent first.
fn causes(callbacks: &[&facts::LateCallback], since: ModelTime) -> Vec<Cause<'static>> {
    let mut sums: BTreeMap<Named, (u64, Duration)> = BTreeMap::new();
    for callback in callbacks {
        for entry in callback.history.iter().filter(|entry| entry.at >= since) {
            let key = (entry.stage, entry.cause, entry.other_thread.clone());
            let (calls, longest) = sums.entry(key).or_default();
            *calls += 1;
            *longest = (*longest).max(entry.total);
        }
    }
    let mut causes: Vec<_> = sums
        .into_iter()
        .map(|((stage, cause, by), (calls, longest))| Cause {
            stage: stage.label().into(),
            cause: cause.label().into(),
            words: cause.in_words(by.as_ref().map(|by| by as _)).into(),
            by: by.as_ref().map(|by| by.name.to_string().into()),
            by_unit: by.and_then(|by| Some(by.unit?.to_string().into())),
            late_calls: calls,
            longest_seconds: longest.as_secs_f64(),
            remedy: cause.remedy().into(),
        })
        .collect();
    causes.sort_by_key(|cause| std::cmp::Reverse(cause.late_calls));
    causes
}

fn late_callback<'a>(
    callback: &'a facts::LateCallback,
    known: &InsideFacts,
    since: ModelTime,
    clock: WallClock,
) -> LateCallback<'a> {
    let mut of = known.callbacks.iter();
    let of = of.find(|each| {
        let own = (each.owner.process, each.owner.handle);
        own == (callback.owner.process, callback.owner.handle)
    });
    let mut examples: Vec<&Arc<LateExample>> = Vec::new();
    for example in callback.longest.iter().chain(&callback.latest) {
        let is_known = examples.iter().any(|known| Arc::ptr_eq(known, example));
        if example.at >= since && !is_known {
            examples.push(example);
        }
    }
    examples.sort_by_key(|example| std::cmp::Reverse(example.call.total()));
    LateCallback {
        owner: owner(&callback.owner),
        trigger: trigger(&callback.trigger),
        // Its calls are counted anew after a rest.
        calls: of
            .map(|of| of.calls)
            .filter(|calls| *calls >= callback.calls),
        late_calls: callback.calls,
        parts: (callback.sums.iter())
            .map(|((stage, cause), sum)| part(*stage, *cause, *sum))
            .collect(),
        examples: examples
            .into_iter()
            .map(|each| late_call(each, clock))
            .collect(),
        history: Vec::new(),
    }
}

fn summary(entry: &facts::LateEntry, clock: WallClock) -> LateCallSummary<'_> {
    LateCallSummary {
        timestamp_seconds: clock.wall_time(entry.at).seconds(),
        total_seconds: entry.total.as_secs_f64(),
        stage: entry.stage.label().into(),
        cause: entry.cause.label().into(),
        words: entry
            .cause
            .in_words(entry.other_thread.as_ref().map(|by| by as _))
            .into(),
    }
}

fn late_call(example: &LateExample, clock: WallClock) -> LateCall<'_> {
    let call = &example.call;
    let main = example.main;
    let named = main.and_then(|part| call.named_by(part));
    let activities = [&call.activity_before, &call.activity];
    let others = activities.into_iter().flatten().flat_map(|it| &it.others);
    let of_receiver = call.handoff.iter().flat_map(|it| &it.others);
    LateCall {
        timestamp_seconds: clock.wall_time(example.at).seconds(),
        source_timestamp_seconds: call.source.map(|source| source.seconds()),
        duration_seconds: call.duration.as_secs_f64(),
        wait_seconds: call.wait.map(|wait| wait.as_secs_f64()),
        late_duration_seconds: call.bound.duration.as_secs_f64(),
        late_wait_seconds: (call.bound.wait.as_nanos() < u128::from(u64::MAX))
            .then_some(call.bound.wait.as_secs_f64()),
        thread_id: call.thread,
        receiver_thread_id: match (&call.delivery, &call.handoff) {
            (Some(delivery), _) => Some(delivery.receiver_thread),
            (None, handoff) => handoff.as_ref().map(|it| it.thread),
        },
        cpu: call.cpu,
        stage: main.map(|part| part.stage.label().into()),
        cause: main.map(|part| part.cause.label().into()),
        words: main
            .map_or(late::Cause::Unexplained, |part| part.cause)
            .in_words(named.map(|other| other as _))
            .into(),
        parts: (call.parts().iter())
            .map(|each| part(each.stage, each.cause, each.duration))
            .collect(),
        others: of_receiver.chain(others).map(other_thread).collect(),
        blocked: call.activity.as_ref().and_then(|activity| {
            let longest = activity.longest.as_ref()?;
            Some(Blocked {
                seconds: longest.duration.as_secs_f64(),
                cause: late::Cause::of_wait(longest.kind).label().into(),
                system_call: longest.call.as_deref().map(Cow::Borrowed),
                argument: format!("{:#x}", longest.argument).into(),
                ended_by: longest.waker.as_ref().map(other_thread),
            })
        }),
        cpu_limits: call
            .cpu_limits
            .iter()
            .map(|limit| limit.in_words().into())
            .collect(),
        previous: call.waited_for().map(|previous| PreviousCall {
            trigger: trigger(&previous.trigger),
            duration_seconds: previous.duration.as_secs_f64(),
            ended_before_seconds: previous.ended_before.as_secs_f64(),
        }),
    }
}

fn part(stage: late::Stage, cause: late::Cause, duration: Duration) -> Part<'static> {
    Part {
        stage: stage.label().into(),
        cause: cause.label().into(),
        seconds: duration.as_secs_f64(),
    }
}

fn other_thread(other: &other_thread::OtherThread) -> OtherThread<'_> {
    OtherThread {
        name: Cow::Borrowed(&other.name),
        thread_id: other.thread,
        process_id: other.process,
        unit: other.unit.as_deref().map(Cow::Borrowed),
        priority: other.priority.map(|priority| priority.to_string().into()),
        seconds: other.duration.as_secs_f64(),
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_testing::sample_robot;

    use super::*;

    #[test]
    fn the_last_late_calls_are_listed_on_request_within_the_selected_time() {
        let mut snapshot = sample_robot::snapshot(["/points"]);
        let listed = |snapshot: &Snapshot, last, has_history| -> Vec<(f64, String)> {
            let selection = Selection { last, has_history };
            let answer = why(snapshot, None, selection, |_| true);
            let callbacks = answer.callbacks.iter();
            let calls = callbacks.flat_map(|callback| &callback.history);
            calls
                .map(|call| (call.total_seconds, call.words.to_string()))
                .collect()
        };
        assert_eq!(listed(&snapshot, None, false), []);
        let call = (0.105, "chromium (kiosk.service) ran instead".to_owned());
        assert_eq!(listed(&snapshot, None, true), std::slice::from_ref(&call));
        let minute = Some(Duration::from_secs(60));
        assert_eq!(listed(&snapshot, minute, true), [call]);
        snapshot.at = snapshot.at + Duration::from_secs(61);
        assert_eq!(listed(&snapshot, minute, true), []);
    }

    #[test]
    fn the_answer_names_what_is_missing_for_causes() {
        let snapshot = sample_robot::snapshot(["/points"]);
        let reason = |source: &InsideSourceFacts| {
            let selection = Selection {
                last: None,
                has_history: false,
            };
            let answer = why(&snapshot, Some(source), selection, |_| true);
            answer.reason.map(Cow::into_owned)
        };
        let mut source = InsideSourceFacts {
            late: "off",
            without_deliveries: Some("no sockets".to_owned()),
            ..InsideSourceFacts::default()
        };
        assert_eq!(reason(&source), None, "no late calls are reported");
        source.late = "sums";
        assert_eq!(reason(&source).as_deref(), Some("no sockets"));
        source.without_events = Some("needs Linux 5.15".to_owned());
        assert_eq!(reason(&source).as_deref(), Some("needs Linux 5.15"));
        source.reason_off = Some("no broker".to_owned());
        assert_eq!(reason(&source).as_deref(), Some("no broker"));
    }

    #[test]
    fn callbacks_of_a_chain_are_those_of_its_messages_and_timers_of_its_nodes() {
        let snapshot = sample_robot::snapshot(["/points"]);
        let all = snapshot.chains.chains.iter();
        let chains = parts(all.clone(), Some("/points"), Some("/cmd_vel"));
        assert_eq!(chains[0].hops.len(), 2);
        let known = snapshot.inside.as_ref().unwrap();
        let is_in = |trigger: Trigger, node: Option<&str>| {
            let mut callback = known.late[0].clone();
            callback.owner.node = node.map(Into::into);
            callback.trigger = trigger;
            is_in_any(&chains, &callback.owner, &callback.trigger)
        };
        let points = || Trigger::Subscription("/points".into());
        let timer = || Trigger::Timer(None);
        assert!(is_in(points(), Some("/filter")));
        assert!(is_in(points(), None));
        assert!(!is_in(points(), Some("/recorder")));
        assert!(!is_in(Trigger::Subscription("/cmd_vel".into()), None));
        assert!(is_in(
            Trigger::IntraProcess(Some("/filtered".into())),
            Some("/controller")
        ));
        assert!(!is_in(Trigger::IntraProcess(None), Some("/filter")));
        assert!(is_in(timer(), Some("/controller")));
        assert!(!is_in(timer(), Some("/lidar")) && !is_in(timer(), None));
        // A chain of another domain, and the part that does not reach the node.
        let mut other = known.late[0].clone();
        other.owner.node = Some("/filter".into());
        let is_other_in =
            |other: &facts::LateCallback| is_in_any(&chains, &other.owner, &other.trigger);
        assert!(is_other_in(&other));
        other.owner.domain_id.0 += 1;
        assert!(!is_other_in(&other));
        let last = parts(all, Some("/filtered"), None);
        let late = &known.late[0];
        assert!(!is_in_any(&last, &late.owner, &late.trigger));
    }
}
