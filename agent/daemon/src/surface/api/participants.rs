//! `/participants`: DDS participants with their processes, and active writers whose announcement
//! was missed.

use std::borrow::Cow;
use std::collections::HashMap;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use ros2probe_wire::GuidPrefix;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::{process, vendor};
use super::measured::measurement;
use super::parameters::Parameters;
use super::problem::Problem;
use super::scope::Domain;
use ros2probe_api::participants::{Link, Participant, ParticipantList, UnknownWriter};
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::measure::links::LinkFacts;
use ros2probe_model::report::snapshot::{ParticipantFacts, Snapshot, UnknownWriterFacts};

/// Nodes, writers and readers of each participant.
type Counts<'a> = HashMap<GuidPrefix, (Vec<Cow<'a, str>>, usize, usize)>;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// All participants
#[utoipa::path(
    get,
    path = "/participants",
    tag = "graph",
    params(Domain),
    responses((status = 200, description = "Participants.", body = ParticipantList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(domain): Parameters<Domain>,
) -> Result<Response, Problem> {
    let domain = domain.checked()?;
    let state = context.state().await;
    Ok(Json(answer(state.known(), domain)).into_response())
}

/// Returns the answer with the participants of a domain.
pub(super) fn answer(snapshot: &Snapshot, domain: Domain) -> ParticipantList<'_> {
    let (counts, clock) = (counts(snapshot), snapshot.wall_clock);
    let participants = snapshot.participants.iter();
    let participants = participants.filter(|each| domain.admits(each.domain_id));
    let unknown_writers = snapshot.unknown_writers.iter();
    ParticipantList {
        timestamp_seconds: snapshot.time().seconds(),
        participants: participants
            .map(|each| view(each, &counts, clock))
            .collect(),
        unknown_writers: unknown_writers
            .map(|each| unknown_writer(each, clock))
            .collect(),
        links: snapshot.links.iter().map(link).collect(),
        tls_connections: snapshot.tls_connections,
    }
}

fn link(facts: &LinkFacts) -> Link<'static> {
    Link {
        protocol: Cow::Borrowed(facts.key.protocol.label()),
        source: facts.key.source.to_string(),
        destination: facts.key.destination.to_string(),
        connections: facts.connections,
        round_trip_seconds: facts.round_trip.map(|time| time.as_secs_f64()),
        sent_segments: facts.sent,
        retransmitted_segments: facts.retransmitted,
        unacknowledged_bytes: facts.unacknowledged,
        unsent_bytes: facts.unsent,
    }
}

fn counts(snapshot: &Snapshot) -> Counts<'_> {
    let mut counts = Counts::new();
    for node in &snapshot.nodes {
        let own = counts.entry(node.participant.prefix).or_default();
        own.0.push(Cow::Borrowed(&node.name));
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

fn view<'a>(facts: &'a ParticipantFacts, counts: &Counts<'a>, clock: WallClock) -> Participant<'a> {
    let counts = counts.get(&facts.guid.prefix);
    Participant {
        guid: facts.guid.to_string(),
        domain_id: facts.domain_id.0,
        vendor: vendor(facts.vendor),
        product_version: facts.product_version.as_deref().map(Cow::Borrowed),
        enclave: facts.enclave.as_deref().map(Cow::Borrowed),
        process: process(&facts.process),
        nodes: counts.map_or_else(Vec::new, |(nodes, ..)| nodes.clone()),
        writers: counts.map_or(0, |(_, writers, _)| *writers),
        readers: counts.map_or(0, |(.., readers)| *readers),
        metatraffic_addresses: Cow::Borrowed(&facts.addresses.metatraffic),
        default_addresses: Cow::Borrowed(&facts.addresses.default),
        lease_seconds: facts.lease.seconds(),
        first_seen_timestamp_seconds: clock.wall_time(facts.first_seen).seconds(),
        last_seen_timestamp_seconds: clock.wall_time(facts.last_seen).seconds(),
        secured: facts.secured,
        announces_by_tcp: facts.announces_by_tcp,
        announces_unseen: facts.announces_unseen,
        discovery_server: facts.discovery_server,
        restored: facts.restored,
    }
}

fn unknown_writer(facts: &UnknownWriterFacts, clock: WallClock) -> UnknownWriter<'_> {
    UnknownWriter {
        guid: facts.guid.to_string(),
        vendor: facts.vendor.map_or_else(Cow::default, vendor),
        process: process(&facts.process),
        first_seen_timestamp_seconds: clock.wall_time(facts.first_seen).seconds(),
        measurement: measurement(&facts.measurement, clock),
    }
}
