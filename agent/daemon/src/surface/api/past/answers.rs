//! Answers of the API that the history keeps, for views of a moment in the past.

use ros2probe_api::chains::ChainList;
use ros2probe_api::clocks::Clocks;
use ros2probe_api::diagnostics::Diagnostics;
use ros2probe_api::graph::Graph;
use ros2probe_api::health::Health;
use ros2probe_api::history::KeptNoun;
use ros2probe_api::logs::Logs;
use ros2probe_api::nodes::NodeList;
use ros2probe_api::parameters::Parameters;
use ros2probe_api::participants::ParticipantList;
use ros2probe_api::services::{ActionList, ServiceList};
use ros2probe_api::topics::TopicDetailsList;
use ros2probe_api::transforms::Transforms;
use ros2probe_history::Document;
use serde::Serialize;
use utoipa::ToSchema;

use super::super::Context;
use super::super::scope::{Domain, Scope};
use super::super::{
    actions, chains, clocks, diagnostics, graph, health, logs, nodes, participants, ros_parameters,
    services, topics, transforms,
};
use crate::config::Access;
use crate::snapshot_cell::State;

/// The answer of a noun, declared for the OpenAPI document.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "read by the document's generator alone")]
pub(super) enum KeptAnswer<'a> {
    Parameters(Parameters<'a>),
    Diagnostics(Diagnostics<'a>),
    Transforms(Transforms<'a>),
    Clocks(Clocks<'a>),
    Chains(ChainList<'a>),
    Actions(ActionList<'a>),
    Services(ServiceList<'a>),
    Health(Box<Health>),
    Logs(Logs<'a>),
    Participants(ParticipantList<'a>),
    Nodes(NodeList<'a>),
    Graph(Graph),
    Topics(TopicDetailsList<'a>),
}

/// Returns the rights that an answer needs: the same as in the present.
pub(super) const fn required_rights(noun: KeptNoun) -> Access {
    match noun {
        KeptNoun::Parameters | KeptNoun::Diagnostics | KeptNoun::Logs => Access::All,
        KeptNoun::Transforms
        | KeptNoun::Clocks
        | KeptNoun::Chains
        | KeptNoun::Actions
        | KeptNoun::Services
        | KeptNoun::Health
        | KeptNoun::Participants
        | KeptNoun::Nodes
        | KeptNoun::Graph
        | KeptNoun::Topics => Access::Read,
    }
}

/// Returns the present answers of all nouns, each when it is needed.
pub(super) fn present(context: &Context) -> impl Iterator<Item = Document> {
    let state = context.latest.state();
    let all = KeptNoun::ALL.into_iter();
    all.map(move |noun| Document {
        name: noun.label().to_owned(),
        content: answer(noun, context, &state),
    })
}

fn answer(noun: KeptNoun, context: &Context, state: &State) -> Vec<u8> {
    let snapshot = state.known();
    let (scope, domain) = (Scope::EVERYTHING, Domain::default());
    match noun {
        KeptNoun::Parameters => json(&ros_parameters::answer(snapshot, |_, _| true)),
        KeptNoun::Diagnostics => json(&diagnostics::answer(snapshot, |_| true)),
        KeptNoun::Transforms => json(&transforms::answer(snapshot, domain)),
        KeptNoun::Clocks => json(&clocks::answer(snapshot)),
        KeptNoun::Chains => json(&chains::all(snapshot)),
        KeptNoun::Actions => json(&actions::answer(snapshot, scope)),
        KeptNoun::Services => json(&services::answer(snapshot, scope)),
        KeptNoun::Health => json(&health::answer(context)),
        KeptNoun::Logs => json(&logs::all(snapshot)),
        KeptNoun::Participants => json(&participants::answer(snapshot, domain)),
        KeptNoun::Nodes => json(&nodes::answer(snapshot, scope)),
        KeptNoun::Graph => json(&graph::graph(snapshot, scope)),
        KeptNoun::Topics => {
            let in_force = context.watches.active();
            json(&topics::details_without_figures(state, &in_force))
        }
    }
}

fn json(answer: &impl Serialize) -> Vec<u8> {
    // Serializing plain numbers and strings into memory cannot fail.
    serde_json::to_vec(answer).unwrap_or_default()
}
