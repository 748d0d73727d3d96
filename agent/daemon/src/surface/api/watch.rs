//! `/watch`: lists, adds and removes watches while the agent runs.
//!
//! A watch is identified by its domain and its topic, a name or a glob as in the configuration
//! file. POST adds without changing an existing watch; PUT adds or replaces.

use std::borrow::Cow;
use std::sync::Arc;

use axum::Json;
use axum::extract::{DefaultBodyLimit, State};
use axum::http::StatusCode;
use axum::http::header::LOCATION;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body::Body;
use super::parameters::{Name, Parameters};
use super::problem::{Code, Problem, ProblemBody};
use super::scope;
use super::security::MAX_BODY;
use crate::config::watch::{self, ExpectationValues, Watch, check_pattern, check_trace};
use crate::watches::{self, AddOutcome, Entry, Refused};
use ros2probe_api::watches::{
    Expectations, Origin, Retain, TopicState, WatchList, WatchRequest, WatchState, WatchedTopic,
};
use ros2probe_api::{Open, watches as answers};
use ros2probe_model::report::snapshot::{
    self, Snapshot, TopicFacts, WatchFacts, WatchedTopicFacts,
};
use ros2probe_wire::DomainId;

#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Domain {
    /// Domain id of the watch; by default the watch for every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
}

impl Domain {
    /// Returns the domain, or a problem if the domain id is invalid.
    fn checked(self) -> Result<Self, Problem> {
        scope::domain(self.domain_id, Code::MalformedRequest)?;
        Ok(self)
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(show, add, replace, remove))
        .layer(DefaultBodyLimit::max(MAX_BODY))
}

/// All watches
#[utoipa::path(
    get,
    path = "/watch",
    tag = "watch",
    responses((status = 200, description = "Watches of every origin.", body = WatchList))
)]
async fn list(State(context): State<Context>) -> Json<WatchList> {
    let (state, in_force) = (context.state().await, context.watches.active());
    let snapshot = state.snapshot.as_deref();
    let is_kept = context.watches.is_kept();
    let watches = in_force
        .entries()
        .iter()
        .map(|entry| view(entry, snapshot, is_kept));
    Json(WatchList {
        watches: watches.collect(),
    })
}

/// One watch
#[utoipa::path(
    get,
    path = "/watch/{*topic}",
    tag = "watch",
    params(TopicParameter, Domain),
    responses(
        (status = 200, description = "The watch.", body = answers::Watch),
        (status = 404, description = "The watch does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(
    State(context): State<Context>,
    Name(topic): Name,
    Parameters(domain): Parameters<Domain>,
) -> Result<Json<answers::Watch>, Problem> {
    let domain = domain.checked()?;
    let (state, in_force) = (context.state().await, context.watches.active());
    let entry = in_force.find(&topic, domain.domain_id);
    let entry = entry.ok_or_else(|| unknown(&topic, domain.domain_id))?;
    let is_kept = context.watches.is_kept();
    Ok(Json(view(entry, state.snapshot.as_deref(), is_kept)))
}

/// Watch a topic
///
/// The topic need not exist yet. The body is optional. Repeating the same request is not an error.
#[utoipa::path(
    post,
    path = "/watch/{*topic}",
    tag = "watch",
    params(TopicParameter, Domain),
    request_body = WatchRequest,
    responses(
        (status = 200, description = "The watch exists with the same settings.", body = answers::Watch),
        (status = 201, description = "The watch is added.", body = answers::Watch,
            headers(("location" = String, description = "Path of the watch."))),
        (status = 409, description = "The watch exists with other settings, or the limit of watches \
            is reached.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 415, description = "The content type is not JSON.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "Invalid topic name or settings.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn add(
    State(context): State<Context>,
    Name(topic): Name,
    Parameters(domain): Parameters<Domain>,
    Body(settings): Body<WatchRequest>,
) -> Result<Response, Problem> {
    let watch = watch(topic, domain, settings)?;
    let done = context.watches.add(watch.clone());
    answer(&context, &watch, done)
}

/// Add or replace a watch
#[utoipa::path(
    put,
    path = "/watch/{*topic}",
    tag = "watch",
    params(TopicParameter, Domain),
    request_body = WatchRequest,
    responses(
        (status = 200, description = "The watch exists with these settings.", body = answers::Watch),
        (status = 201, description = "The watch is added.", body = answers::Watch,
            headers(("location" = String, description = "Path of the watch."))),
        (status = 409, description = "The configuration lists the watch with other settings, or the \
            limit of watches is reached.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 415, description = "The content type is not JSON.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "Invalid topic name or settings.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn replace(
    State(context): State<Context>,
    Name(topic): Name,
    Parameters(domain): Parameters<Domain>,
    Body(settings): Body<WatchRequest>,
) -> Result<Response, Problem> {
    let watch = watch(topic, domain, settings)?;
    let done = context.watches.replace(watch.clone());
    answer(&context, &watch, done)
}

/// Remove a watch
///
/// Only watches of clients can be removed. Watches of the configuration are removed by changing the
/// configuration.
#[utoipa::path(
    delete,
    path = "/watch/{*topic}",
    tag = "watch",
    params(TopicParameter, Domain),
    responses(
        (status = 204, description = "The watch is removed."),
        (status = 404, description = "The watch does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The configuration or the command line lists the watch.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn remove(
    State(context): State<Context>,
    Name(topic): Name,
    Parameters(domain): Parameters<Domain>,
) -> Result<StatusCode, Problem> {
    let domain = domain.checked()?;
    let removed = context.watches.remove(&topic, domain.domain_id);
    removed.map_err(|refused| problem(&refused, &topic, domain.domain_id))?;
    Ok(StatusCode::NO_CONTENT)
}

/// The path parameter, declared for the OpenAPI document.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read by the document's generator alone")]
struct TopicParameter {
    /// ROS name or glob without its leading slash; inner slashes need not be encoded.
    #[param(
        max_length = 254,
        pattern = r"^(\*\*|\*|(\*?[A-Za-z_]|\*[0-9])(\*?[A-Za-z0-9_])*\*?)(/(\*\*|\*|(\*?[A-Za-z_]|\*[0-9])(\*?[A-Za-z0-9_])*\*?))*$",
        example = "camera/front/image_raw"
    )]
    topic: String,
}

/// Returns the requested watch after validation.
fn watch(topic: String, domain: Domain, settings: WatchRequest) -> Result<Watch, Problem> {
    let invalid = |detail: String| Err(Problem::new(Code::InvalidRequest, detail));
    if let Err(error) = check_pattern(&topic) {
        return invalid(format!("the topic `{topic}` {error}"));
    }
    let domain_id = match (domain.domain_id, settings.domain_id) {
        (Some(one), Some(other)) if one != other => {
            return invalid(format!(
                "domain_id is {one} in the query and {other} in the body"
            ));
        }
        (one, other) => one.or(other),
    };
    let domain_id = scope::domain(domain_id, Code::InvalidRequest)?;
    let values = ExpectationValues {
        min_rate_hz: settings.min_rate_hz,
        max_rate_hz: settings.max_rate_hz,
        window_s: settings.window_s,
        max_loss_ratio: settings.max_loss_ratio,
        max_latency_ms: settings.max_latency_ms,
        max_silence_s: settings.max_silence_s,
        publishers: settings.publishers,
        subscribers: settings.subscribers,
    };
    let trace = settings.trace;
    let expectations = watch::Expectations::try_from(values);
    match expectations.and_then(|expectations| check_trace(trace).map(|()| expectations)) {
        Ok(expectations) => Ok(Watch {
            pattern: topic,
            domain_id,
            expectations,
            per_subscriber: settings.per_subscriber,
            trace,
            retain: match settings.retain {
                Retain::None => watch::Retain::None,
                Retain::Last => watch::Retain::Last,
            },
        }),
        Err(mistake) => invalid(mistake.to_string()),
    }
}

fn answer(
    context: &Context,
    watch: &Watch,
    done: Result<AddOutcome, Refused>,
) -> Result<Response, Problem> {
    let done =
        done.map_err(|refused| problem(&refused, &watch.pattern, watch.domain_id.map(|id| id.0)))?;
    let in_force = context.watches.active();
    // Another client may have removed the watch already.
    let entry = in_force
        .find(&watch.pattern, watch.domain_id.map(|id| id.0))
        .cloned();
    let entry = entry.unwrap_or_else(|| Entry {
        watch: Arc::new(watch.clone()),
        origin: watches::Origin::Api,
    });
    let state = context.latest.state();
    // No snapshot contains the new watch yet. An entry with its name belongs to an earlier watch.
    let snapshot = state
        .snapshot
        .as_deref()
        .filter(|_| done == AddOutcome::Unchanged);
    let body = Json(view(&entry, snapshot, context.watches.is_kept()));
    Ok(match done {
        AddOutcome::Added => {
            let location = location(watch);
            (StatusCode::CREATED, [(LOCATION, location)], body).into_response()
        }
        AddOutcome::Replaced | AddOutcome::Unchanged => body.into_response(),
    })
}

/// Returns the path of a watch; names and globs contain only characters that a path allows.
fn location(watch: &Watch) -> String {
    match watch.domain_id {
        None => format!("/watch{}", watch.pattern),
        Some(domain_id) => format!("/watch{}?domain_id={domain_id}", watch.pattern),
    }
}

fn problem(refused: &Refused, topic: &str, domain_id: Option<u32>) -> Problem {
    let detail = match refused {
        Refused::DefinedElsewhere {
            by: watches::Origin::Config,
        } => {
            format!("{topic} is listed in the configuration file: change it there and reload")
        }
        Refused::DefinedElsewhere { by } => format!("{topic} is defined by {}", by.in_sentence()),
        Refused::Different => {
            format!("{topic} is watched with other settings: PUT replaces them")
        }
        Refused::Unknown => return unknown(topic, domain_id),
        refused => refused.to_string(),
    };
    let code = match refused {
        Refused::DefinedElsewhere { .. } => Code::WatchGiven,
        Refused::Different => Code::WatchDiffers,
        Refused::Full(_) => Code::TooManyWatches,
        Refused::Unknown | Refused::Globs(_) => Code::InvalidRequest,
    };
    Problem::new(code, detail)
}

fn unknown(topic: &str, domain_id: Option<u32>) -> Problem {
    let detail = match domain_id {
        None => format!("no watch {topic} for all domains"),
        Some(domain_id) => format!("no watch {topic} for domain {domain_id}"),
    };
    Problem::new(Code::NoSuchWatch, detail)
}

fn view(entry: &Entry, snapshot: Option<&Snapshot>, is_kept: bool) -> answers::Watch {
    let watch = &entry.watch;
    let facts = snapshot.and_then(|snapshot| {
        let mut all = snapshot.watches.iter();
        let same = |facts: &&WatchFacts| {
            (&facts.watch.pattern, facts.watch.domain_id) == (&watch.pattern, watch.domain_id)
        };
        Some((snapshot, all.find(same)?))
    });
    let topics = facts.map_or_else(Vec::new, |(snapshot, facts)| topics(snapshot, facts));
    let state = match facts {
        None => WatchState::Starting,
        Some((snapshot, facts)) => state(watch, snapshot, facts),
    };
    answers::Watch {
        topic: watch.pattern.clone(),
        domain_id: watch.domain_id.map(|id| id.0),
        origin: Open::Known(match entry.origin {
            watches::Origin::Config => Origin::Config,
            watches::Origin::CommandLine => Origin::CommandLine,
            watches::Origin::Api => Origin::Api,
        }),
        state: Open::Known(state),
        per_subscriber: watch.per_subscriber,
        trace: watch.trace,
        retain: match watch.retain {
            watch::Retain::None => Retain::None,
            watch::Retain::Last => Retain::Last,
        },
        expectations: expectations(&watch.expectations),
        kept: is_kept || entry.origin != watches::Origin::Api,
        topics,
    }
}

pub(super) fn expectations(expectations: &watch::Expectations) -> Expectations {
    let values = expectations.values();
    Expectations {
        min_rate_hz: values.min_rate_hz,
        max_rate_hz: values.max_rate_hz,
        window_s: values.window_s,
        max_loss_ratio: values.max_loss_ratio,
        max_latency_ms: values.max_latency_ms,
        max_silence_s: values.max_silence_s,
        publishers: values.publishers,
        subscribers: values.subscribers,
    }
}

fn state(watch: &Watch, snapshot: &Snapshot, facts: &WatchFacts) -> WatchState {
    let measured = |topic: &str, domain_id: DomainId| {
        let mut topics = snapshot.topics.iter();
        topics.any(|facts| facts.domain_id == domain_id && facts.name == topic)
    };
    let mut covered = facts.topics.iter();
    if covered.any(|topic| measured(&topic.topic, topic.domain_id)) {
        WatchState::Measuring
    } else if watch.is_literal() && facts.topics.is_empty() {
        WatchState::Rejected
    } else {
        WatchState::Waiting
    }
}

fn topics(snapshot: &Snapshot, facts: &WatchFacts) -> Vec<WatchedTopic> {
    let topic = |watched: &WatchedTopicFacts| {
        let same = |facts: &&TopicFacts| {
            facts.domain_id == watched.domain_id && facts.name == watched.topic
        };
        let mut all = snapshot.topics.iter().filter(same);
        let facts = all.find(|facts| facts.measurement.is_some());
        let measurement = facts.and_then(|facts| facts.measurement.as_deref());
        WatchedTopic {
            domain_id: watched.domain_id.0,
            topic: watched.topic.to_string(),
            state: Open::Known(match watched.state {
                snapshot::WatchState::Ok => TopicState::Ok,
                snapshot::WatchState::Violated => TopicState::Violated,
                snapshot::WatchState::Silent => TopicState::Silent,
                snapshot::WatchState::NotPublished => TopicState::NotPublished,
                snapshot::WatchState::NoSubscriber => TopicState::NoSubscriber,
            }),
            violations: watched
                .violations
                .iter()
                .copied()
                .map(Cow::Borrowed)
                .collect(),
            messages: measurement.map_or(0, |measured| measured.messages),
            rate_hertz: match measurement {
                Some(_) => facts.and_then(TopicFacts::rate_hz),
                None => Some(0.0),
            },
        }
    };
    facts.topics.iter().map(topic).collect()
}
