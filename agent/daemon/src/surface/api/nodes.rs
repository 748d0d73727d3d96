//! `/nodes`: ROS nodes with their publishers, subscriptions, services and actions, as `ros2 node
//! info` prints them.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::endpoint::{process, vendor};
use super::finding::diagnosis;
use super::index::{Ends, Index};
use super::inside;
use super::nearest::hint;
use super::parameters::{Name, Parameters};
use super::party::{Side, action, action_type, service_type};
use super::problem::{Code, Problem, ProblemBody};
use super::scope::{Scope, only};
use crate::surface::inside_nodes::NodeActivity;
use ros2probe_api::diagnosis::Finding;
use ros2probe_api::nodes::{Named, Node, NodeInstance, NodeList};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{NodeFacts, Snapshot};
use ros2probe_wire::DomainId;

/// Names with their types, sorted.
#[derive(Debug, Default)]
struct Names<'a>(BTreeMap<String, BTreeSet<&'a str>>);

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(show))
}

/// All nodes
#[utoipa::path(
    get,
    path = "/nodes",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Nodes.", body = NodeList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    Ok(Json(answer(state.known(), scope)).into_response())
}

/// Returns the answer with the nodes of a scope.
pub(super) fn answer(snapshot: &Snapshot, scope: Scope) -> NodeList<'_> {
    let answers = NodeAnswers::new(snapshot, scope);
    let nodes = nodes(snapshot).filter(|nodes| {
        let first = nodes.first();
        first.is_some_and(|node| {
            scope.includes(node.domain_id) && (scope.shows_hidden() || !is_hidden(&node.name))
        })
    });
    NodeList {
        timestamp_seconds: snapshot.time().seconds(),
        nodes: nodes.filter_map(|nodes| answers.node(nodes)).collect(),
    }
}

/// One node
#[utoipa::path(
    get,
    path = "/nodes/{*node}",
    tag = "graph",
    params(NodeParameter, Scope),
    responses(
        (status = 200, description = "The node.", body = Node<'static>),
        (status = 404, description = "The node does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The name exists in several domains; add `domain_id`.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(
    State(context): State<Context>,
    Name(name): Name,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    let snapshot = state.known();
    let admitted = || {
        let all = nodes(snapshot).filter_map(|nodes| Some((nodes.first()?, nodes)));
        all.filter(|(node, _)| scope.includes(node.domain_id))
    };
    let found = admitted().filter(|(node, _)| *node.name == *name);
    let found = found.map(|(node, nodes)| (node.domain_id, nodes)).collect();
    let missing = || {
        let hint = hint(&name, admitted().map(|(node, _)| node.name.as_str()));
        Problem::new(Code::NoSuchNode, format!("no node {name}{hint}"))
    };
    let nodes = only(found, &name, missing)?;
    let answers = NodeAnswers::new(snapshot, scope);
    Ok(Json(answers.node(nodes)).into_response())
}

/// The path parameter, declared for the OpenAPI document.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read by the document's generator alone")]
struct NodeParameter {
    /// Fully qualified name without its leading slash; inner slashes need not be encoded.
    #[param(min_length = 1, example = "robot1/lidar")]
    node: String,
}

/// Groups the nodes by domain and name.
fn nodes(snapshot: &Snapshot) -> impl Iterator<Item = &[NodeFacts]> {
    snapshot.nodes.chunk_by(|one, other| {
        (one.domain_id, one.name.as_str()) == (other.domain_id, other.name.as_str())
    })
}

fn is_hidden(name: &str) -> bool {
    name.split('/').any(|token| token.starts_with('_'))
}

/// Input of the answers.
struct NodeAnswers<'a> {
    snapshot: &'a Snapshot,
    index: Index<'a>,
    ends: Ends<'a>,
    activities: BTreeMap<(DomainId, &'a str), NodeActivity<'a>>,
    scope: Scope,
}

impl<'a> NodeAnswers<'a> {
    fn new(snapshot: &'a Snapshot, scope: Scope) -> Self {
        Self {
            snapshot,
            index: Index::new(snapshot),
            ends: Ends::new(snapshot),
            activities: NodeActivity::all(snapshot),
            scope,
        }
    }

    fn node(&self, nodes: &'a [NodeFacts]) -> Option<Node<'a>> {
        let first = nodes.first()?;
        let [mut publishers, mut subscriptions] = [Names::default(), Names::default()];
        let [mut services, mut clients] = [Names::default(), Names::default()];
        let [mut action_servers, mut action_clients] = [Names::default(), Names::default()];
        let writers = nodes.iter().flat_map(|node| &node.writers);
        let readers = nodes.iter().flat_map(|node| &node.readers);
        let ends = writers.map(|guid| (guid, true));
        for (guid, is_writer) in ends.chain(readers.map(|guid| (guid, false))) {
            let Some((topic, endpoint)) = self.ends.endpoint(*guid) else {
                continue;
            };
            // The type is the endpoint's, since other nodes may use another type on the topic.
            let message_type = endpoint.message_type.as_str();
            let side = Side::of(topic, is_writer);
            if let (Some(side), Some((name, _))) = (side, action(topic)) {
                let names = match side {
                    Side::Server => &mut action_servers,
                    Side::Client => &mut action_clients,
                };
                names.add(name.as_str(), action_type(message_type));
            }
            if topic.hidden && !self.scope.shows_hidden() {
                continue;
            }
            match (topic.kind, side) {
                (TopicKind::ServiceRequest | TopicKind::ServiceReply, Some(side)) => {
                    let names = match side {
                        Side::Server => &mut services,
                        Side::Client => &mut clients,
                    };
                    names.add(&topic.name, Some(service_type(message_type)));
                }
                _ if is_writer => publishers.add(&topic.name, Some(message_type)),
                _ => subscriptions.add(&topic.name, Some(message_type)),
            }
        }
        let activity = self.activities.get(&(first.domain_id, &*first.name));
        let activity = activity.copied().unwrap_or_default();
        Some(Node {
            domain_id: first.domain_id.0,
            name: Cow::Borrowed(&first.name),
            hidden: is_hidden(&first.name),
            instances: nodes.iter().map(|node| self.instance(node)).collect(),
            publishers: publishers.views(),
            subscriptions: subscriptions.views(),
            services: services.views(),
            clients: clients.views(),
            action_servers: action_servers.views(),
            action_clients: action_clients.views(),
            lifecycle_state: activity.state.map(Cow::Borrowed),
            diagnoses: self.findings(first),
            inside: inside::node((first.domain_id, &first.name), activity, self.snapshot),
        })
    }

    fn instance(&self, node: &'a NodeFacts) -> NodeInstance<'a> {
        let participant = self.index.participant(node.participant);
        NodeInstance {
            participant: node.participant.to_string(),
            vendor: participant.map(|participant| vendor(participant.vendor)),
            process: participant.map(|participant| process(&participant.process)),
        }
    }

    fn findings(&self, own: &NodeFacts) -> Vec<Finding<'a>> {
        let found = self.snapshot.diagnoses.list.iter();
        let about = found.filter(|finding| match finding {
            Diagnosis::DuplicateNode {
                domain_id, node, ..
            }
            | Diagnosis::LogErrors {
                domain_id, node, ..
            }
            | Diagnosis::NodeInactive {
                domain_id, node, ..
            }
            | Diagnosis::ParameterDrift {
                domain_id, node, ..
            } => *domain_id == own.domain_id && *node == own.name,
            Diagnosis::NodeInSeveralDomains { node, domains, .. } => {
                domains.contains(&own.domain_id) && *node == own.name
            }
            _ => finding.owner().is_some_and(|owner| {
                owner.domain_id == own.domain_id && owner.node.as_ref() == Some(&own.name)
            }),
        });
        about.map(diagnosis).collect()
    }
}

impl<'a> Names<'a> {
    fn add(&mut self, name: &str, message_type: Option<&'a str>) {
        match self.0.get_mut(name) {
            Some(known) => known.extend(message_type),
            None => drop(
                self.0
                    .insert(name.to_owned(), message_type.into_iter().collect()),
            ),
        }
    }

    fn views(self) -> Vec<Named<'a>> {
        let views = self.0.into_iter();
        views
            .map(|(name, types)| Named {
                name,
                types: types.into_iter().map(Cow::Borrowed).collect(),
            })
            .collect()
    }
}
