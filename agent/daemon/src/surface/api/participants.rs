//! `/participants`: DDS participants, where they live, and who sends without having been announced.

use std::collections::HashMap;
use std::net::SocketAddr;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use ros2probe_wire::{Guid, GuidPrefix};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::{ProcessView, seconds, text};
use super::measured::MeasurementView;
use super::parameters::Parameters;
use super::problem::Problem;
use super::scope::Domain;
use ros2probe_model::snapshot::{ParticipantFacts, Snapshot, UnknownWriterFacts};

/// Participants.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ParticipantList)]
struct ParticipantsView<'a> {
    /// Unix time of the facts.
    timestamp_seconds: f64,
    /// By domain and GUID.
    participants: Vec<ParticipantView<'a>>,
    /// Writers that send although their announcement was not seen; of no known domain.
    unknown_writers: Vec<UnknownWriterView<'a>>,
}

/// One participant.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Participant)]
struct ParticipantView<'a> {
    /// GUID, as the metrics show it.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    guid: Guid,
    /// Domain.
    domain_id: u32,
    /// Implementation.
    #[schema(example = "eProsima Fast DDS")]
    vendor: &'a str,
    /// ROS enclave; null means it is no ROS participant.
    enclave: Option<&'a str>,
    /// Where it lives.
    #[serde(flatten)]
    process: ProcessView<'a>,
    /// Its nodes.
    nodes: Vec<&'a str>,
    /// How many writers it has.
    writers: usize,
    /// How many readers it has.
    readers: usize,
    /// Where its discovery endpoints are reached over UDP.
    #[schema(value_type = Vec<String>)]
    metatraffic_addresses: &'a [SocketAddr],
    /// Where its other endpoints are reached over UDP.
    #[schema(value_type = Vec<String>)]
    default_addresses: &'a [SocketAddr],
    /// Lease; null is infinite.
    lease_seconds: Option<f64>,
    /// Unix time of its first announcement.
    first_seen_timestamp_seconds: f64,
    /// Unix time of its last sign of life.
    last_seen_timestamp_seconds: f64,
    /// It announces DDS security: its messages may be encrypted.
    secured: bool,
    /// Known from before the agent's start and not heard since.
    restored: bool,
}

/// A writer whose announcement was not seen.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = UnknownWriter)]
struct UnknownWriterView<'a> {
    /// GUID.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    guid: Guid,
    /// Implementation; empty where nothing tells.
    vendor: &'a str,
    /// Where it lives.
    #[serde(flatten)]
    process: ProcessView<'a>,
    /// Unix time of its first message.
    first_seen_timestamp_seconds: f64,
    /// What was counted of it.
    measurement: MeasurementView,
}

/// What participants have.
type Counts<'a> = HashMap<GuidPrefix, (Vec<&'a str>, usize, usize)>;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// All participants
#[utoipa::path(
    get,
    path = "/participants",
    tag = "graph",
    params(Domain),
    responses((status = 200, description = "Participants.", body = ParticipantsView<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(domain): Parameters<Domain>,
) -> Result<Response, Problem> {
    let domain = domain.checked()?;
    let state = context.state().await;
    let snapshot = state.known();
    let counts = counts(snapshot);
    let participants = snapshot.participants.iter();
    let participants = participants.filter(|each| domain.admits(each.domain_id));
    let unknown_writers = snapshot.unknown_writers.iter();
    let answer = ParticipantsView {
        timestamp_seconds: snapshot.at.seconds(),
        participants: participants.map(|each| view(each, &counts)).collect(),
        unknown_writers: unknown_writers.map(Into::into).collect(),
    };
    Ok(Json(answer).into_response())
}

fn counts(snapshot: &Snapshot) -> Counts<'_> {
    let mut counts = Counts::new();
    for node in &snapshot.nodes {
        let own = counts.entry(node.participant.prefix).or_default();
        own.0.push(&node.name);
    }
    for topic in &snapshot.topics {
        for publisher in &topic.publishers {
            counts.entry(publisher.guid.prefix).or_default().1 += 1;
        }
        for subscription in &topic.subscriptions {
            counts.entry(subscription.guid.prefix).or_default().2 += 1;
        }
    }
    counts
}

fn view<'a>(facts: &'a ParticipantFacts, counts: &Counts<'a>) -> ParticipantView<'a> {
    let counts = counts.get(&facts.guid.prefix);
    ParticipantView {
        guid: facts.guid,
        domain_id: facts.domain_id.0,
        vendor: &facts.vendor,
        enclave: facts.enclave.as_deref(),
        process: (&facts.process).into(),
        nodes: counts.map_or_else(Vec::new, |(nodes, ..)| nodes.clone()),
        writers: counts.map_or(0, |(_, writers, _)| *writers),
        readers: counts.map_or(0, |(.., readers)| *readers),
        metatraffic_addresses: &facts.addresses.metatraffic,
        default_addresses: &facts.addresses.default,
        lease_seconds: seconds(facts.lease_nanoseconds),
        first_seen_timestamp_seconds: facts.first_seen.seconds(),
        last_seen_timestamp_seconds: facts.last_seen.seconds(),
        secured: facts.secured,
        restored: facts.restored,
    }
}

impl<'a> From<&'a UnknownWriterFacts> for UnknownWriterView<'a> {
    fn from(facts: &'a UnknownWriterFacts) -> Self {
        Self {
            guid: facts.guid,
            vendor: &facts.vendor,
            process: (&facts.process).into(),
            first_seen_timestamp_seconds: facts.first_seen.seconds(),
            measurement: (&facts.measurement).into(),
        }
    }
}
