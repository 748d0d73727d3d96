//! `/topics`: topics with their measurements, and the reasons for missing measurements.

use std::borrow::Cow;
use std::time::Instant;

use axum::Json;
use axum::extract::{Extension, State};
use axum::http::Uri;
use axum::response::{IntoResponse, Response};
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::endpoint::{endpoint, printed, texts};
use super::finding::diagnosis;
use super::history;
use super::index::{Index, WatchedTopic};
use super::inside;
use super::live::is_shown;
use super::measured::{breakdown, buckets, delivered, topic_measurement};
use super::messages;
use super::nearest::hint;
use super::parameters::{Name, Parameters};
use super::past::{self, TopicRange};
use super::problem::{Code, Problem, ProblemBody};
use super::reasons::ReasonInputs;
use super::scope::{Domain, Scope, only};
use super::security::Rights;
use super::watch::expectations;
use super::{Context, in_turn};
use crate::agent_facts::{Ability, SourceKind};
use crate::snapshot_cell::State as AgentState;
use crate::watches::ActiveWatches;
use ros2probe_api::endpoints::WriterClock;
use ros2probe_api::topics::{
    self, Acknowledgement, Delivery, Topic, TopicDetails, TopicDetailsList, TopicList, Watching,
};
use ros2probe_model::derive::clocks::{PeerClock, seconds};
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{
    AcknowledgementFacts, DeliveryFacts, Snapshot, TopicFacts, Transport,
};

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// Returns the route of one topic and of its parts. Large answers take turns here, because some
/// parts wait for a storage, and others are streams.
pub(super) fn part_routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(show))
}

/// All topics
///
/// The list includes topics that are not watched, with types, endpoints, quality of service and
/// problems.
#[utoipa::path(
    get,
    path = "/topics",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Topics.", body = TopicList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let (state, in_force) = (context.state().await, context.watches.active());
    let answers = TopicAnswers::new(&state, &in_force);
    let topics = answers.snapshot.topics.iter().filter(|topic| {
        let is_plain = matches!(topic.kind, TopicKind::Topic | TopicKind::Dds) && !topic.hidden;
        scope.includes(topic.domain_id) && (is_plain || scope.shows_hidden())
    });
    let answer = TopicList {
        timestamp_seconds: answers.snapshot.time().seconds(),
        topics: topics.map(|topic| answers.topic(topic)).collect(),
    };
    Ok(Json(answer).into_response())
}

/// Returns the answer with the details of all topics, without the figures that change all the time
/// and that the history has.
pub(super) fn details_without_figures<'a>(
    state: &'a AgentState,
    in_force: &'a ActiveWatches,
) -> TopicDetailsList<'a> {
    let answers = TopicAnswers::new(state, in_force);
    // Each node has a dozen topics of services, which no view of the past shows.
    let topics = answers.snapshot.topics.iter();
    let topics = topics.filter(|topic| is_shown(topic));
    TopicDetailsList {
        timestamp_seconds: answers.snapshot.time().seconds(),
        topics: topics
            .map(|topic| answers.details(topic).without_figures())
            .collect(),
    }
}

/// One topic
///
/// The path contains the ROS name, or the DDS name if the topic follows no ROS convention
/// (`rq/addRequest`).
#[utoipa::path(
    get,
    path = "/topics/{*topic}",
    tag = "graph",
    params(TopicParameter, Domain),
    responses(
        (status = 200, description = "The topic.", body = TopicDetails<'static>),
        (status = 404, description = "The topic does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The name exists in several domains; add `domain_id`.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
    uri: Uri,
    Name(name): Name,
) -> Result<Response, Problem> {
    match aspect(&context, &uri, &name) {
        Some((topic, Aspect::History)) => {
            let Parameters(question) = Parameters::<TopicRange>::of(&uri)?;
            match question.parts() {
                (domain, None) => {
                    Ok(in_turn(&context, history::show(&context, topic, domain)).await)
                }
                (domain, Some(range)) => past::show_topic(&context, topic, domain, range).await,
            }
        }
        Some((topic, Aspect::Definition)) => {
            let Parameters(domain) = Parameters::of(&uri)?;
            messages::definition(&context, topic, domain).await
        }
        Some((topic, Aspect::Messages)) => {
            let Parameters(wanted) = Parameters::of(&uri)?;
            messages::follow(context.clone(), &granted, topic, wanted).await
        }
        None => {
            let Parameters(domain) = Parameters::of(&uri)?;
            Ok(in_turn(&context, details(&context, &name, domain)).await)
        }
    }
}

async fn details(context: &Context, name: &str, domain: Domain) -> Result<Response, Problem> {
    let domain = domain.checked()?;
    let (state, in_force) = (context.state().await, context.watches.active());
    let answers = TopicAnswers::new(&state, &in_force);
    let topic = find(answers.snapshot, name, domain)?;
    Ok(Json(answers.details(topic)).into_response())
}

/// Returns the topic of this name.
///
/// # Errors
/// Fails if the topic does not exist, or exists in several domains.
pub(super) fn find<'a>(
    snapshot: &'a Snapshot,
    name: &str,
    domain: Domain,
) -> Result<&'a TopicFacts, Problem> {
    let admitted = || {
        let topics = snapshot.topics.iter();
        topics.filter(|topic| domain.admits(topic.domain_id))
    };
    let found = admitted().filter(|topic| is_called(topic, name));
    let found = found.map(|topic| (topic.domain_id, topic)).collect();
    let missing = || {
        let names = admitted().map(|topic| topic.name.as_str());
        let hint = hint(name, names);
        Problem::new(Code::NoSuchTopic, format!("no endpoint on {name}{hint}"))
    };
    only(found, name, missing)
}

/// A part of the data about a topic that has its own path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Aspect {
    /// The history.
    History,
    /// The definition of the topic's type.
    Definition,
    /// The decoded messages.
    Messages,
}

impl Aspect {
    const ALL: [(&'static str, Self); 3] = [
        ("/history", Self::History),
        ("/definition", Self::Definition),
        ("/messages", Self::Messages),
    ];
}

/// Returns the topic and the requested part. The name of a topic may end like a part. A topic with
/// the whole name takes precedence, unless the name's slashes are encoded.
fn aspect<'a>(context: &Context, uri: &Uri, name: &'a str) -> Option<(&'a str, Aspect)> {
    let (topic, aspect) = Aspect::ALL
        .into_iter()
        .find_map(|(end, aspect)| Some((name.strip_suffix(end)?, aspect)))?;
    let path = uri.path().strip_prefix("/topics/").unwrap_or_default();
    let is_sure = path.rsplit_once('/').is_some_and(|(topic, _)| {
        let has_encoded = topic.contains("%2F") || topic.contains("%2f");
        has_encoded && !topic.contains('/')
    });
    let is_another = || {
        let state = context.latest.state();
        let mut topics = state.known().topics.iter();
        // If the last slash is encoded, the path is the name of a topic.
        !path.contains('/') || topics.any(|topic| is_called(topic, name))
    };
    (is_sure || !is_another()).then_some((topic, aspect))
}

/// The path parameter, declared for the OpenAPI document.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read by the document's generator alone")]
pub(super) struct TopicParameter {
    /// ROS name without its leading slash; inner slashes need not be encoded.
    #[param(min_length = 1, example = "camera/front/image_raw")]
    topic: String,
}

/// Returns whether `name` identifies the topic, by its ROS name or by its DDS name after a slash.
/// Topics of services, and topics without a ROS name, are identified only by their DDS names.
fn is_called(topic: &TopicFacts, name: &str) -> bool {
    let is_ros_topic = topic.kind.is_ros_topic();
    is_ros_topic && topic.name == name || name.strip_prefix('/') == Some(topic.dds_name.as_str())
}

/// Input of the answers.
struct TopicAnswers<'a> {
    in_force: &'a ActiveWatches,
    snapshot: &'a Snapshot,
    /// Whether uprobes observe every message to shared memory.
    is_exact: bool,
    circumstances: ReasonInputs<'a>,
}

impl<'a> TopicAnswers<'a> {
    fn new(state: &'a AgentState, in_force: &'a ActiveWatches) -> Self {
        let snapshot = state.known();
        let abilities = &state.agent.abilities;
        Self {
            in_force,
            snapshot,
            is_exact: abilities.contains(&Ability::SharedMemoryExact),
            circumstances: ReasonInputs {
                snapshot,
                index: Index::new(snapshot),
                watchlist: in_force.watchlist(),
                source: state.agent.source,
                samples_shared_memory: state.agent.shared_memory.is_some(),
                misses_inside_calls: state.agent.source != SourceKind::Replay
                    && !abilities.contains(&Ability::Inside),
                unready: state.ready(Instant::now()).err(),
            },
        }
    }

    fn topic(&self, facts: &'a TopicFacts) -> Topic<'a> {
        let index = &self.circumstances.index;
        let clock = self.snapshot.wall_clock;
        let endpoint = |facts| endpoint(facts, index, clock);
        let is_unseen = facts.measurement.is_some() && facts.rate_hz().is_none();
        let publisher = |publisher| {
            let mut shown = endpoint(publisher);
            let is_measured = publisher.measurement.is_some();
            let peer = index.clock(publisher.guid).filter(|_| is_measured);
            shown.clock = peer.map(writer_clock);
            if let Some(measured) = shown.measurement.as_mut().filter(|_| is_unseen) {
                (measured.rate_hertz, measured.bandwidth_bytes_per_second) = (None, None);
            }
            shown
        };
        let findings = index.findings(facts).iter();
        let watches = index.watches(facts).iter();
        let passages = facts.transports.iter().map(|count| topics::Passage {
            passage: count.transport.label().into(),
            pairs: count.pairs,
            observed_pairs: facts.observed_pairs(count.transport),
            view: (count.transport == Transport::SharedMemory).then(|| self.view(facts).into()),
        });
        Topic {
            domain_id: facts.domain_id.0,
            name: Cow::Borrowed(&facts.name),
            dds_name: Cow::Borrowed(&facts.dds_name),
            kind: Cow::Borrowed(facts.kind.label()),
            hidden: facts.hidden,
            vanished: facts.vanished,
            message_types: texts(&facts.message_types),
            type_hashes: printed(&facts.type_hashes)
                .into_iter()
                .map(Cow::Owned)
                .collect(),
            publishers: facts.publishers.iter().map(publisher).collect(),
            subscriptions: facts.subscriptions.iter().map(endpoint).collect(),
            watches: watches.map(|watching| self.watching(*watching)).collect(),
            measurement: topic_measurement(facts, clock),
            received: facts.received.as_deref().map(delivered),
            sent: facts.sent.as_deref().map(delivered),
            breakdown: facts.breakdown.as_deref().map(breakdown),
            passages: passages.collect(),
            diagnoses: findings.map(|finding| diagnosis(finding)).collect(),
            reasons: self.circumstances.reasons(facts),
            source: facts.source.label().into(),
            inside: inside::topic(facts, self.snapshot),
        }
    }

    /// Returns how messages of this topic in shared memory are observed at present.
    fn view(&self, facts: &TopicFacts) -> &'static str {
        if self.is_exact {
            "exact"
        } else if !self.circumstances.samples_shared_memory {
            "none"
        } else if facts.is_read {
            "close"
        } else {
            "sampled"
        }
    }

    fn details(&self, facts: &'a TopicFacts) -> TopicDetails<'a> {
        let acknowledgements = facts.acknowledgements.iter();
        let measured = facts.measurement.as_deref();
        TopicDetails {
            topic: Topic {
                inside: inside::topic_details(facts, self.snapshot),
                ..self.topic(facts)
            },
            interarrival_buckets: measured.map_or_else(Vec::new, |it| buckets(&it.interarrival)),
            latency_buckets: measured.map_or_else(Vec::new, |it| buckets(&it.source_latency)),
            deliveries: facts.deliveries.iter().map(delivery).collect(),
            acknowledgements: acknowledgements.map(acknowledgement).collect(),
        }
    }

    fn watching(&self, (watch, topic): WatchedTopic<'a>) -> Watching<'a> {
        let watch = &watch.watch;
        let entry = self
            .in_force
            .find(&watch.pattern, watch.domain_id.map(|id| id.0));
        Watching {
            watch: Cow::Borrowed(&watch.pattern),
            watch_domain_id: watch.domain_id.map(|id| id.0),
            origin: entry.map(|entry| entry.origin.label().into()),
            state: topic.state.label().into(),
            violations: texts(&topic.violations),
            expectations: entry.map_or_else(Default::default, |entry| {
                expectations(&entry.watch.expectations)
            }),
        }
    }
}

/// Returns how the agent corrects latencies from a host with this clock.
fn writer_clock(peer: &PeerClock) -> WriterClock<'_> {
    let correction = peer.correction();
    WriterClock {
        peer: Cow::Borrowed(&peer.peer),
        correction_seconds: correction.map(|(correction, _)| seconds(correction)),
        uncertainty_seconds: correction.map(|(_, error)| seconds(error)),
    }
}

fn delivery(facts: &DeliveryFacts) -> Delivery<'_> {
    Delivery {
        writer: facts.writer.to_string(),
        direction: facts.direction.label().into(),
        destination: facts.destination.to_string(),
        subscriber: Cow::Owned(facts.subscriber.to_string()),
        readers: printed(&facts.readers),
        nodes: texts(&facts.nodes),
        process_id: facts.process_id,
        process: facts.process.as_deref().map(Cow::Borrowed),
        cgroup: facts.cgroup.as_deref().map(Cow::Borrowed),
        delivered: delivered(&facts.delivered),
        lost_in_reader_queue_messages: facts.lost_in_reader_queue,
    }
}

fn acknowledgement(facts: &AcknowledgementFacts) -> Acknowledgement<'_> {
    Acknowledgement {
        writer: facts.writer.to_string(),
        reader: facts.reader.to_string(),
        node: facts.node.as_deref().map(Cow::Borrowed),
        acknowledged_sequence_number: facts.acknowledged.0,
        missing_messages: facts.missing,
        requested_messages: facts.requested,
        lag_messages: facts.lag_samples,
        lag_seconds: facts.lag_seconds,
    }
}
