//! `/topics`: what is known of topics, and why nothing is known where it is nothing.

use std::time::Instant;

use axum::Json;
use axum::extract::{Extension, State};
use axum::http::Uri;
use axum::response::{IntoResponse, Response};
use ros2probe_wire::Guid;
use serde::Serialize;
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::{EndpointView, text, texts};
use super::finding::FindingView;
use super::history;
use super::index::{Index, Watching};
use super::measured::{BreakdownView, BucketView, DeliveredView, MeasurementView, buckets};
use super::messages;
use super::nearest::hint;
use super::parameters::{Name, Parameters};
use super::problem::{Code, Problem, ProblemBody};
use super::scope::{Domain, Scope, only};
use super::security::Granted;
use super::silence::{Circumstances, ReasonView};
use super::watch::ExpectationsView;
use crate::surface::Ability;
use crate::surface::board::State as BoardState;
use crate::watches::InForce;
use ros2probe_model::snapshot::{
    AcknowledgementFacts, DeliveryFacts, Snapshot, TopicFacts, Transport,
};
use ros2probe_model::topic_kind::TopicKind;

/// Topics.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = TopicList)]
struct TopicsView<'a> {
    /// Unix time of the facts.
    timestamp_seconds: f64,
    /// By domain and DDS name.
    topics: Vec<TopicView<'a>>,
}

/// One topic.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Topic)]
struct TopicView<'a> {
    /// Domain.
    domain_id: u32,
    /// ROS name; the DDS name where it follows no ROS convention.
    #[schema(example = "/points")]
    name: &'a str,
    /// DDS name.
    #[schema(example = "rt/points")]
    dds_name: &'a str,
    /// What it is to ROS: `topic`, `service_request`, `service_reply`, `service_event`,
    /// `action_feedback`, `action_status`, `discovery` or `dds`.
    kind: &'a str,
    /// Hidden by ROS convention.
    hidden: bool,
    /// Its last endpoint has gone; it is shown for some minutes more.
    vanished: bool,
    /// ROS types announced on it; more than one is a fault.
    message_types: &'a [String],
    /// RIHS01 hashes announced on it.
    type_hashes: &'a [String],
    /// Its writers.
    publishers: Vec<EndpointView<'a>>,
    /// Its readers.
    subscriptions: Vec<EndpointView<'a>>,
    /// Watches that cover it, and how it stands with what they expect.
    watches: Vec<WatchingView<'a>>,
    /// Sum over its writers; null while it is not watched.
    measurement: Option<MeasurementView>,
    /// What reached receivers on this host, each counted.
    received: Option<DeliveredView>,
    /// What was seen leaving this host, once for each destination.
    sent: Option<DeliveredView>,
    /// Where messages spent their time on this host.
    breakdown: Option<BreakdownView>,
    /// Pairs of its publishers and subscribers by how messages pass between them.
    passages: Vec<PassageView>,
    /// What is wrong with it.
    diagnoses: Vec<FindingView<'a>>,
    /// Why it is silent, or why nothing is counted; empty where messages are counted.
    reasons: Vec<ReasonView>,
}

/// One topic with every way its messages go.
#[derive(Debug, Serialize, ToSchema)]
struct TopicDetails<'a> {
    #[serde(flatten)]
    topic: TopicView<'a>,
    /// Times between consecutive messages of one writer, in buckets.
    interarrival_buckets: Vec<BucketView>,
    /// Times from the writer's timestamp to the capture, in buckets.
    latency_buckets: Vec<BucketView>,
    /// Every receiver and destination of its writers.
    deliveries: Vec<DeliveryView<'a>>,
    /// Every reliable reader that acknowledges.
    acknowledgements: Vec<AcknowledgementView<'a>>,
}

/// Pairs of publisher and subscriber between which messages pass in one way.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Passage)]
struct PassageView {
    /// `network`; `shared_memory`, of which samples are seen; `data_sharing`, `same_process` or
    /// `iceoryx`, which are not seen.
    #[schema(value_type = String)]
    passage: &'static str,
    /// How many pairs.
    pairs: usize,
    /// Of `shared_memory`, how it is seen just now: `exact`, every message in the process that sends
    /// it; `close`, by as many looks as `capture.shm.reading_cpu_percent` allows, because its samples
    /// are read; `sampled`, by fewer looks; `none`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    view: Option<&'static str>,
}

/// A watch that covers the topic.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Watching)]
struct WatchingView<'a> {
    /// Its name or glob.
    watch: &'a str,
    /// The domain it is for; null for every domain.
    watch_domain_id: Option<u32>,
    /// Who asked for it: `config`, `command_line` or `api`; null when it has just gone.
    origin: Option<&'static str>,
    /// How the topic stands: `ok`, `violated`, `silent`, `not_published` or `no_subscriber`.
    state: &'static str,
    /// Expectations that are broken.
    violations: &'a [&'static str],
    /// What it expects of the topic.
    #[serde(flatten)]
    expectations: ExpectationsView,
}

/// One writer's messages to one receiver, or to a destination where they leave.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Delivery)]
struct DeliveryView<'a> {
    /// Whose messages.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    writer: Guid,
    /// `sent` or `received`.
    direction: &'static str,
    /// Address and port.
    #[schema(value_type = String, example = "10.0.0.2:7411")]
    destination: std::net::SocketAddr,
    /// The receiver: participant, process or socket; empty where nothing tells receivers apart.
    subscriber: &'a str,
    /// Readers of the topic in that participant.
    #[serde(serialize_with = "texts")]
    #[schema(value_type = Vec<String>)]
    readers: &'a [Guid],
    /// Their nodes.
    nodes: &'a [String],
    /// Process of the socket.
    process_id: Option<u32>,
    /// Its name.
    process: Option<&'a str>,
    /// Its control group.
    cgroup: Option<&'a str>,
    /// What became of the messages.
    delivered: DeliveredView,
}

/// What one reliable reader acknowledged to one writer.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Acknowledgement)]
struct AcknowledgementView<'a> {
    /// To whom.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    writer: Guid,
    /// By whom.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    reader: Guid,
    /// The reader's node.
    node: Option<&'a str>,
    /// All messages up to this sequence number.
    acknowledged_sequence_number: u64,
    /// Messages it asked for in its last ACKNACK.
    missing_messages: u64,
    /// Messages it asked for again, every request counted.
    requested_messages: u64,
    /// Messages that exist and are not acknowledged.
    lag_messages: u64,
    /// Age of the oldest of them; null when it is too old to know.
    lag_seconds: Option<f64>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(show))
}

/// All topics
///
/// Also those that are not watched: with types, endpoints, quality of service and what is wrong.
#[utoipa::path(
    get,
    path = "/topics",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Topics.", body = TopicsView<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let (state, in_force) = (context.state().await, context.watches.in_force());
    let desk = Desk::new(&state, &in_force);
    let topics = desk.snapshot.topics.iter().filter(|topic| {
        let is_plain = matches!(topic.kind, TopicKind::Topic | TopicKind::Dds) && !topic.hidden;
        scope.admits(topic.domain_id) && (is_plain || scope.shows_hidden())
    });
    let answer = TopicsView {
        timestamp_seconds: desk.snapshot.at.seconds(),
        topics: topics.map(|topic| desk.topic(topic)).collect(),
    };
    Ok(Json(answer).into_response())
}

/// One topic
///
/// By its ROS name, or by its DDS name where it follows no ROS convention (`rq/addRequest`).
#[utoipa::path(
    get,
    path = "/topics/{*topic}",
    tag = "graph",
    params(TopicParameter, Domain),
    responses(
        (status = 200, description = "The topic.", body = TopicDetails<'static>),
        (status = 404, description = "No such topic.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It is in several domains.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(
    State(context): State<Context>,
    Extension(granted): Extension<Granted>,
    uri: Uri,
    Name(name): Name,
) -> Result<Response, Problem> {
    match aspect(&context, &uri, &name) {
        Some((topic, Aspect::History)) => {
            let Parameters(domain) = Parameters::of(&uri)?;
            return history::show(&context, topic, domain).await;
        }
        Some((topic, Aspect::Definition)) => {
            let Parameters(domain) = Parameters::of(&uri)?;
            return messages::definition(&context, topic, domain).await;
        }
        Some((topic, Aspect::Messages)) => {
            let Parameters(wanted) = Parameters::of(&uri)?;
            return messages::follow(context.clone(), &granted, topic, wanted).await;
        }
        None => {}
    }
    let Parameters(domain) = Parameters::<Domain>::of(&uri)?;
    let domain = domain.checked()?;
    let (state, in_force) = (context.state().await, context.watches.in_force());
    let desk = Desk::new(&state, &in_force);
    let topic = find(desk.snapshot, &name, domain)?;
    Ok(Json(desk.details(topic)).into_response())
}

/// The one topic of this name.
///
/// # Errors
/// There is none, or there are several.
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

/// What is asked for of a topic, besides the topic itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Aspect {
    /// Its last minutes.
    History,
    /// What its type consists of.
    Definition,
    /// What its messages say.
    Messages,
}

impl Aspect {
    const ALL: [(&'static str, Self); 3] = [
        ("/history", Self::History),
        ("/definition", Self::Definition),
        ("/messages", Self::Messages),
    ];
}

/// The topic and what is asked for of it. Names may end so, too: a topic of the whole name goes
/// first, unless slashes of the name are encoded.
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
        let state = context.board.state();
        let mut topics = state.known().topics.iter();
        // With its last slash encoded it is the name of a topic.
        !path.contains('/') || topics.any(|topic| is_called(topic, name))
    };
    (is_sure || !is_another()).then_some((topic, aspect))
}

/// The topic in a path, for the document.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read by the document's generator alone")]
pub(super) struct TopicParameter {
    /// ROS name without its leading slash; slashes within need not be encoded.
    #[param(min_length = 1, example = "camera/front/image_raw")]
    topic: String,
}

/// By the ROS name of a topic; services and what is not ROS by their DDS names.
fn is_called(topic: &TopicFacts, name: &str) -> bool {
    let is_ros_topic = topic.kind.is_ros_topic();
    is_ros_topic && topic.name == name || name.strip_prefix('/') == Some(topic.dds_name.as_str())
}

/// What answers are made of.
struct Desk<'a> {
    in_force: &'a InForce,
    snapshot: &'a Snapshot,
    /// Every message into shared memory is seen.
    is_exact: bool,
    circumstances: Circumstances<'a>,
}

impl<'a> Desk<'a> {
    fn new(state: &'a BoardState, in_force: &'a InForce) -> Self {
        let snapshot = state.known();
        let abilities = &state.agent.abilities;
        Self {
            in_force,
            snapshot,
            is_exact: abilities.contains(&Ability::SharedMemoryExact),
            circumstances: Circumstances {
                snapshot,
                index: Index::new(snapshot),
                watchlist: in_force.watchlist(),
                source: state.agent.source,
                looks_at_memory: state.agent.shared_memory.is_some(),
                unready: state.ready(Instant::now()).err(),
            },
        }
    }

    fn topic(&self, facts: &'a TopicFacts) -> TopicView<'a> {
        let index = &self.circumstances.index;
        let endpoint = |facts| EndpointView::new(facts, index);
        let findings = index.findings(facts).iter();
        let watches = index.watches(facts).iter();
        let passages = facts.transports.iter().map(|count| PassageView {
            passage: count.transport.label(),
            pairs: count.pairs,
            view: (count.transport == Transport::SharedMemory).then(|| self.view(facts)),
        });
        TopicView {
            domain_id: facts.domain_id.0,
            name: &facts.name,
            dds_name: &facts.dds_name,
            kind: facts.kind.label(),
            hidden: facts.hidden,
            vanished: facts.vanished,
            message_types: &facts.message_types,
            type_hashes: &facts.type_hashes,
            publishers: facts.publishers.iter().map(endpoint).collect(),
            subscriptions: facts.subscriptions.iter().map(endpoint).collect(),
            watches: watches.map(|watching| self.watching(*watching)).collect(),
            measurement: facts.measurement.as_deref().map(Into::into),
            received: facts.received.as_deref().map(Into::into),
            sent: facts.sent.as_deref().map(Into::into),
            breakdown: facts.breakdown.as_deref().map(Into::into),
            passages: passages.collect(),
            diagnoses: findings.map(|finding| (*finding).into()).collect(),
            reasons: self.circumstances.reasons(facts),
        }
    }

    /// How messages of this topic in shared memory are seen just now.
    fn view(&self, facts: &TopicFacts) -> &'static str {
        if self.is_exact {
            "exact"
        } else if !self.circumstances.looks_at_memory {
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
            topic: self.topic(facts),
            interarrival_buckets: measured.map_or_else(Vec::new, |it| buckets(&it.interarrival)),
            latency_buckets: measured.map_or_else(Vec::new, |it| buckets(&it.source_latency)),
            deliveries: facts.deliveries.iter().map(Into::into).collect(),
            acknowledgements: acknowledgements.map(Into::into).collect(),
        }
    }

    fn watching(&self, (watch, topic): Watching<'a>) -> WatchingView<'a> {
        let entry = self
            .in_force
            .find(&watch.pattern, watch.domain_id.map(|id| id.0));
        WatchingView {
            watch: &watch.pattern,
            watch_domain_id: watch.domain_id.map(|id| id.0),
            origin: entry.map(|entry| entry.origin.label()),
            state: topic.state.label(),
            violations: &topic.violations,
            expectations: entry
                .map_or_else(Default::default, |entry| (&entry.watch.expectations).into()),
        }
    }
}

impl<'a> From<&'a DeliveryFacts> for DeliveryView<'a> {
    fn from(facts: &'a DeliveryFacts) -> Self {
        Self {
            writer: facts.writer,
            direction: facts.direction.label(),
            destination: facts.destination,
            subscriber: &facts.subscriber,
            readers: &facts.readers,
            nodes: &facts.nodes,
            process_id: facts.process_id,
            process: facts.process.as_deref(),
            cgroup: facts.cgroup.as_deref(),
            delivered: (&facts.delivered).into(),
        }
    }
}

impl<'a> From<&'a AcknowledgementFacts> for AcknowledgementView<'a> {
    fn from(facts: &'a AcknowledgementFacts) -> Self {
        Self {
            writer: facts.writer,
            reader: facts.reader,
            node: facts.node.as_deref(),
            acknowledged_sequence_number: facts.acknowledged,
            missing_messages: facts.missing,
            requested_messages: facts.requested,
            lag_messages: facts.lag_samples,
            lag_seconds: facts.lag_seconds,
        }
    }
}
