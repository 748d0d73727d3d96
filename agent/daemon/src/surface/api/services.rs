//! `/services`: each service combines its request and reply topics.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::finding::diagnosis;
use super::index::Index;
use super::measured::measurement;
use super::parameters::Parameters;
use super::party::{Parties, service_type};
use super::problem::Problem;
use super::scope::Scope;
use ros2probe_api::services::{Calls, Service, ServiceList};
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{ServiceFacts, Snapshot, TopicFacts, Transport};
use ros2probe_wire::DomainId;

/// The known topics of a service.
#[derive(Debug, Default)]
pub(super) struct Halves<'a> {
    pub(super) requests: Option<&'a TopicFacts>,
    pub(super) replies: Option<&'a TopicFacts>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// All services
#[utoipa::path(
    get,
    path = "/services",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Services.", body = ServiceList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    Ok(Json(answer(state.known(), scope)).into_response())
}

/// Returns the answer with the services of a scope.
pub(super) fn answer(snapshot: &Snapshot, scope: Scope) -> ServiceList<'_> {
    let (index, clock) = (Index::new(snapshot), snapshot.wall_clock);
    ServiceList {
        timestamp_seconds: snapshot.time().seconds(),
        services: services(snapshot, scope)
            .into_iter()
            .filter_map(|((domain_id, name), halves)| {
                let service = view(domain_id.0, name, &halves, &index, clock)?;
                Some(with_calls(
                    service,
                    &halves,
                    facts(snapshot, domain_id, name),
                ))
            })
            .collect(),
    }
}

/// Groups services by domain and name.
pub(super) fn services(
    snapshot: &Snapshot,
    scope: Scope,
) -> BTreeMap<(DomainId, &str), Halves<'_>> {
    let mut services: BTreeMap<_, Halves<'_>> = BTreeMap::new();
    for topic in &snapshot.topics {
        let is_shown = scope.includes(topic.domain_id) && (!topic.hidden || scope.shows_hidden());
        let key = (topic.domain_id, topic.name.as_str());
        match topic.kind {
            TopicKind::ServiceRequest if is_shown => {
                services.entry(key).or_default().requests = Some(topic);
            }
            TopicKind::ServiceReply if is_shown => {
                services.entry(key).or_default().replies = Some(topic);
            }
            _ => {}
        }
    }
    services
}

impl<'a> Halves<'a> {
    pub(super) fn topics(&self) -> impl Iterator<Item = &'a TopicFacts> {
        self.requests.into_iter().chain(self.replies)
    }

    pub(super) fn parties(&self) -> Parties<'a> {
        let mut parties = Parties::default();
        self.topics().for_each(|topic| parties.add(topic));
        parties
    }
}

/// Returns the types, sorted and without duplicates.
pub(super) fn sorted<'a>(types: impl Iterator<Item = &'a str>) -> Vec<Cow<'a, str>> {
    let types: BTreeSet<_> = types.collect();
    types.into_iter().map(Cow::Borrowed).collect()
}

/// Returns the calls of a service, if a call was seen.
fn facts<'a>(snapshot: &'a Snapshot, domain_id: DomainId, name: &str) -> Option<&'a ServiceFacts> {
    let place = snapshot
        .services
        .binary_search_by(|each| (each.domain_id, &*each.name).cmp(&(domain_id, name)));
    snapshot.services.get(place.ok()?)
}

fn with_calls<'a>(
    service: Service<'a>,
    halves: &Halves<'_>,
    facts: Option<&ServiceFacts>,
) -> Service<'a> {
    let exact = facts.is_some_and(|facts| facts.exact);
    let transports = halves.topics().flat_map(|topic| &topic.transports);
    let is_unseen = |transport: &Transport| match transport {
        Transport::Network | Transport::Tcp => false,
        Transport::SharedMemory => !exact,
        Transport::DataSharing | Transport::SameProcess | Transport::Iceoryx => true,
    };
    let unseen = transports.map(|count| count.transport).filter(is_unseen);
    let unseen: BTreeSet<_> = unseen.map(Transport::label).collect();
    Service {
        calls: facts.map(calls),
        unseen: unseen.into_iter().map(Cow::Borrowed).collect(),
        ..service
    }
}

fn calls(facts: &ServiceFacts) -> Calls {
    Calls {
        requests: facts.requests,
        answered: facts.answered,
        unanswered: facts.unanswered,
        hanging: facts.hanging as u64,
        open: facts.open as u64,
        latency_p50_seconds: facts.latency.p50,
        latency_p99_seconds: facts.latency.p99,
        suspended: facts.suspended,
    }
}

/// Returns the API representation of a service, or `None` if the service has no endpoints.
fn view<'a>(
    domain_id: u32,
    name: &'a str,
    halves: &Halves<'a>,
    index: &Index<'a>,
    clock: WallClock,
) -> Option<Service<'a>> {
    let parties = halves.parties();
    if parties.is_empty() {
        return None;
    }
    let [servers, clients] = parties.views();
    let types = halves.topics().flat_map(|topic| &topic.message_types);
    let findings = halves.topics().flat_map(|topic| index.findings(topic));
    let measured =
        |topic: Option<&'a TopicFacts>| Some(measurement(topic?.measurement.as_deref()?, clock));
    Some(Service {
        domain_id,
        name: Cow::Borrowed(name),
        hidden: halves.topics().any(|topic| topic.hidden),
        types: sorted(types.map(|each| service_type(each))),
        servers,
        clients,
        requests: measured(halves.requests),
        replies: measured(halves.replies),
        calls: None,
        unseen: Vec::new(),
        diagnoses: findings.map(|finding| diagnosis(finding)).collect(),
    })
}
