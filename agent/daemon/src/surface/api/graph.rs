//! `/graph`: nodes, topics, services and actions as vertices and edges.

use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use ros2probe_wire::{EntityId, Guid};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::actions::{actions, parties};
use super::parameters::Parameters;
use super::party::Parties;
use super::problem::Problem;
use super::scope::Scope;
use super::services::services;
use ros2probe_api::Open;
use ros2probe_api::graph::{Edge, EdgeKind, Graph, Vertex, VertexKind};
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};

/// The graph under construction.
#[derive(Debug, Default)]
struct GraphBuilder {
    vertices: BTreeMap<String, (VertexKind, u32, String)>,
    edges: BTreeMap<(String, String, EdgeKind), Option<f64>>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(show))
}

/// The graph
#[utoipa::path(
    get,
    path = "/graph",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Vertices and edges.", body = Graph))
)]
async fn show(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    let snapshot = state.known();
    Ok(Json(graph(snapshot, scope)).into_response())
}

/// Returns the answer with the graph of a scope.
pub(super) fn graph(snapshot: &Snapshot, scope: Scope) -> Graph {
    let mut drawing = GraphBuilder::default();
    for node in &snapshot.nodes {
        let is_hidden = node.name.split('/').any(|token| token.starts_with('_'));
        if scope.includes(node.domain_id) && (scope.shows_hidden() || !is_hidden) {
            drawing.vertex(VertexKind::Node, node.domain_id.0, &node.name);
        }
    }
    for topic in &snapshot.topics {
        let is_topic = !matches!(
            topic.kind,
            TopicKind::ServiceRequest | TopicKind::ServiceReply | TopicKind::Discovery
        );
        let is_shown = scope.includes(topic.domain_id) && (scope.shows_hidden() || !topic.hidden);
        if is_topic && is_shown && !topic.vanished {
            drawing.topic(topic);
        }
    }
    for ((domain_id, name), halves) in services(snapshot, scope) {
        drawing.add_service_or_action(VertexKind::Service, domain_id.0, name, &halves.parties());
    }
    for ((domain_id, name), parts) in actions(snapshot, scope) {
        drawing.add_service_or_action(VertexKind::Action, domain_id.0, &name, &parties(&parts));
    }
    drawing.view(snapshot)
}

impl GraphBuilder {
    fn vertex(&mut self, kind: VertexKind, domain_id: u32, name: &str) -> String {
        let word = match kind {
            VertexKind::Node => "node",
            VertexKind::Participant => "participant",
            VertexKind::Topic => "topic",
            VertexKind::Service => "service",
            VertexKind::Action => "action",
        };
        let id = format!("{word}:{domain_id}:{name}");
        if !self.vertices.contains_key(&id) {
            let vertex = (kind, domain_id, name.to_owned());
            self.vertices.insert(id.clone(), vertex);
        }
        id
    }

    /// Adds a node, or its participant if the node is unknown. Returns the id of the vertex.
    fn add_party(&mut self, domain_id: u32, (node, participant): (Option<&str>, Guid)) -> String {
        match node {
            Some(node) => self.vertex(VertexKind::Node, domain_id, node),
            None => {
                let guid = participant.to_string();
                self.vertex(VertexKind::Participant, domain_id, &guid)
            }
        }
    }

    fn topic(&mut self, facts: &TopicFacts) {
        let domain_id = facts.domain_id.0;
        let topic = self.vertex(VertexKind::Topic, domain_id, &facts.name);
        let participant = |guid: Guid| Guid::new(guid.prefix, EntityId::PARTICIPANT);
        for publisher in &facts.publishers {
            let party = (publisher.node.as_deref(), participant(publisher.guid));
            let node = self.add_party(domain_id, party);
            let rate = publisher.measurement.as_ref().map(|it| it.rate_hz);
            let rate = rate.filter(|rate| *rate > 0.0 || facts.rate_hz().is_some());
            let key = (node, topic.clone(), EdgeKind::Publishes);
            let sum = self.edges.entry(key).or_default();
            if let Some(rate) = rate {
                *sum = Some(sum.unwrap_or(0.0) + rate);
            }
        }
        for subscription in &facts.subscriptions {
            let party = (subscription.node.as_deref(), participant(subscription.guid));
            let node = self.add_party(domain_id, party);
            let key = (topic.clone(), node, EdgeKind::Feeds);
            self.edges.insert(key, None);
        }
    }

    /// Adds a service or action with its edges, unless it has no endpoints.
    fn add_service_or_action(
        &mut self,
        kind: VertexKind,
        domain_id: u32,
        name: &str,
        parties: &Parties<'_>,
    ) {
        if parties.is_empty() {
            return;
        }
        let joint = self.vertex(kind, domain_id, name);
        for server in parties.servers.keys() {
            let node = self.add_party(domain_id, *server);
            let key = (joint.clone(), node, EdgeKind::ServedBy);
            self.edges.insert(key, None);
        }
        for client in parties.clients.keys() {
            let node = self.add_party(domain_id, *client);
            let key = (node, joint.clone(), EdgeKind::Calls);
            self.edges.insert(key, None);
        }
    }

    fn view(self, snapshot: &Snapshot) -> Graph {
        let vertices = self.vertices.into_iter();
        let edges = self.edges.into_iter();
        Graph {
            timestamp_seconds: snapshot.time().seconds(),
            nodes: vertices
                .map(|(id, (kind, domain_id, name))| Vertex {
                    id,
                    kind: Open::Known(kind),
                    domain_id,
                    name,
                })
                .collect(),
            edges: edges
                .map(|((source, target, kind), rate_hertz)| Edge {
                    source,
                    target,
                    kind: Open::Known(kind),
                    rate_hertz,
                })
                .collect(),
        }
    }
}
