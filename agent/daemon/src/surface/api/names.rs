//! `/names`: names, types and numbers of endpoints, without the details of each endpoint. The
//! answer is about a tenth as large as that of `/topics`.

use std::borrow::Cow;
use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::texts;
use super::parameters::Parameters;
use super::party::service_type;
use super::problem::Problem;
use super::scope::Scope;
use super::services::{Halves, services, sorted};
use crate::missed_announcements;
use ros2probe_api::names::{Names, NodeName, ServiceName, TopicName};
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};
use ros2probe_wire::DomainId;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// All names
#[utoipa::path(
    get,
    path = "/names",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Names.", body = Names<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    Ok(Json(names(state.known(), scope)).into_response())
}

fn names(snapshot: &Snapshot, scope: Scope) -> Names<'_> {
    let participants = snapshot.participants.iter();
    let mut nodes: BTreeMap<(DomainId, &str), usize> = BTreeMap::new();
    for node in &snapshot.nodes {
        *nodes.entry((node.domain_id, &node.name)).or_default() += 1;
    }
    let nodes = nodes.into_iter().map(|((domain_id, name), instances)| {
        let hidden = name.split('/').any(|token| token.starts_with('_'));
        NodeName {
            domain_id: domain_id.0,
            name: Cow::Borrowed(name),
            hidden,
            instances,
        }
    });
    let is_shown =
        |domain_id, hidden: bool| scope.includes(domain_id) && (!hidden || scope.shows_hidden());
    let topics = snapshot.topics.iter().filter_map(topic);
    let has_topics = topics
        .clone()
        .any(|topic| scope.includes(DomainId(topic.domain_id)));
    let mut topics: Vec<_> = topics
        .filter(|topic| is_shown(DomainId(topic.domain_id), topic.hidden))
        .collect();
    topics.sort_unstable_by(|one, other| {
        (one.domain_id, &one.name).cmp(&(other.domain_id, &other.name))
    });
    let selected: Vec<_> = participants
        .clone()
        .filter(|each| scope.includes(each.domain_id))
        .collect();
    let remedy = missed_announcements::remedy(snapshot).or_else(|| match has_topics {
        true => None,
        false => missed_announcements::remedy_for_participants(&selected),
    });
    let services = services(snapshot, scope).into_iter();
    let services =
        services.filter_map(|((domain_id, name), halves)| service(domain_id.0, name, &halves));
    Names {
        timestamp_seconds: snapshot.time().seconds(),
        participants: selected.len(),
        unknown_writers: snapshot.unknown_writers.len(),
        remedy: remedy.map(Cow::Borrowed),
        domains: participants.map(|each| each.domain_id.0).collect(),
        nodes: nodes
            .filter(|node| is_shown(DomainId(node.domain_id), node.hidden))
            .collect(),
        topics,
        services: services.collect(),
    }
}

/// Returns the topic if it has endpoints and `ros2` lists it as a topic.
fn topic(facts: &TopicFacts) -> Option<TopicName<'_>> {
    let is_topic = facts.kind.is_ros_topic();
    let (publishers, subscriptions) = (facts.publishers.len(), facts.subscriptions.len());
    (is_topic && publishers + subscriptions > 0).then_some(TopicName {
        domain_id: facts.domain_id.0,
        name: Cow::Borrowed(&facts.name),
        hidden: facts.hidden,
        types: texts(&facts.message_types),
        publishers,
        subscriptions,
    })
}

/// Returns the API representation of a service, or `None` if the service has no endpoints.
fn service<'a>(domain_id: u32, name: &'a str, halves: &Halves<'a>) -> Option<ServiceName<'a>> {
    let ends = |topic: Option<&TopicFacts>| {
        topic.map_or((0, 0), |topic| {
            (topic.publishers.len(), topic.subscriptions.len())
        })
    };
    let (request_writers, request_readers) = ends(halves.requests);
    let (reply_writers, reply_readers) = ends(halves.replies);
    if request_writers + request_readers + reply_writers + reply_readers == 0 {
        return None;
    }
    let types = halves.topics().flat_map(|topic| &topic.message_types);
    Some(ServiceName {
        domain_id,
        name: Cow::Borrowed(name),
        hidden: halves.topics().any(|topic| topic.hidden),
        types: sorted(types.map(|each| service_type(each))),
        request_readers,
        reply_writers,
        request_writers,
        reply_readers,
    })
}
