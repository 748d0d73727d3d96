//! `/services`: each put together from its topics of requests and replies.

use std::collections::{BTreeMap, BTreeSet};

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::finding::FindingView;
use super::index::Index;
use super::measured::MeasurementView;
use super::parameters::Parameters;
use super::party::{Parties, PartyView, service_type};
use super::problem::Problem;
use super::scope::Scope;
use ros2probe_model::snapshot::{Snapshot, TopicFacts};
use ros2probe_model::topic_kind::TopicKind;
use ros2probe_wire::DomainId;

/// Services.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ServiceList)]
struct ServicesView<'a> {
    /// Unix time of the facts.
    timestamp_seconds: f64,
    /// By domain and name.
    services: Vec<ServiceView<'a>>,
}

/// One service.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Service)]
struct ServiceView<'a> {
    /// Domain.
    domain_id: u32,
    /// ROS name.
    #[schema(example = "/add_two_ints")]
    name: &'a str,
    /// Hidden by ROS convention: those of actions are.
    hidden: bool,
    /// ROS types; more than one is a fault.
    #[schema(value_type = Vec<String>, example = json!(["example_interfaces/srv/AddTwoInts"]))]
    types: BTreeSet<&'a str>,
    /// Who serves.
    servers: Vec<PartyView<'a>>,
    /// Who calls.
    clients: Vec<PartyView<'a>>,
    /// What was counted of its requests, where their DDS topic is watched.
    requests: Option<MeasurementView>,
    /// Likewise of its replies.
    replies: Option<MeasurementView>,
    /// What is wrong with its topics.
    diagnoses: Vec<FindingView<'a>>,
}

/// A service's topics, as far as they are there.
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
    responses((status = 200, description = "Services.", body = ServicesView<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    let snapshot = state.known();
    let index = Index::new(snapshot);
    let answer = ServicesView {
        timestamp_seconds: snapshot.at.seconds(),
        services: services(snapshot, scope)
            .into_iter()
            .filter_map(|((domain_id, name), halves)| view(domain_id.0, name, &halves, &index))
            .collect(),
    };
    Ok(Json(answer).into_response())
}

/// Services by domain and name.
pub(super) fn services(
    snapshot: &Snapshot,
    scope: Scope,
) -> BTreeMap<(DomainId, &str), Halves<'_>> {
    let mut services: BTreeMap<_, Halves<'_>> = BTreeMap::new();
    for topic in &snapshot.topics {
        let is_shown = scope.admits(topic.domain_id) && (!topic.hidden || scope.shows_hidden());
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

/// `None` once nobody is there any more.
fn view<'a>(
    domain_id: u32,
    name: &'a str,
    halves: &Halves<'a>,
    index: &Index<'a>,
) -> Option<ServiceView<'a>> {
    let parties = halves.parties();
    if parties.is_empty() {
        return None;
    }
    let [servers, clients] = parties.views();
    let types = halves.topics().flat_map(|topic| &topic.message_types);
    let findings = halves.topics().flat_map(|topic| index.findings(topic));
    let measured = |topic: Option<&'a TopicFacts>| {
        let measurement = topic?.measurement.as_deref()?;
        Some(measurement.into())
    };
    Some(ServiceView {
        domain_id,
        name,
        hidden: halves.topics().any(|topic| topic.hidden),
        types: types.map(|each| service_type(each)).collect(),
        servers,
        clients,
        requests: measured(halves.requests),
        replies: measured(halves.replies),
        diagnoses: findings.map(|finding| (*finding).into()).collect(),
    })
}
