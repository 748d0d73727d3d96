//! Answers of the API that the history keeps, for views of a moment in the past.

use std::io;

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

/// Returns the answers of all nouns about a state, each when it is needed: at most `room` bytes
/// together. An answer without room is left out. Before the first snapshot, no answer is returned.
pub(super) fn of_state<'a>(
    context: &'a Context,
    state: &'a State,
    mut room: usize,
) -> impl Iterator<Item = Document> + use<'a> {
    let all = KeptNoun::ALL.into_iter();
    let all = all.filter(|_| state.snapshot.is_some());
    all.filter_map(move |noun| {
        let content = answer(noun, context, state, room)?;
        room = room.saturating_sub(content.len());
        let name = noun.label().to_owned();
        Some(Document { name, content })
    })
}

fn answer(noun: KeptNoun, context: &Context, state: &State, room: usize) -> Option<Vec<u8>> {
    let snapshot = state.known();
    let (scope, domain) = (Scope::EVERYTHING, Domain::default());
    match noun {
        KeptNoun::Parameters => json(&ros_parameters::answer(snapshot, |_, _| true), room),
        KeptNoun::Diagnostics => json(&diagnostics::answer(snapshot, |_| true), room),
        KeptNoun::Transforms => json(&transforms::answer(snapshot, domain), room),
        KeptNoun::Clocks => json(&clocks::answer(snapshot), room),
        KeptNoun::Chains => json(&chains::all(snapshot), room),
        KeptNoun::Actions => json(&actions::answer(snapshot, scope), room),
        KeptNoun::Services => json(&services::answer(snapshot, scope), room),
        KeptNoun::Health => json(&health::answer(context), room),
        KeptNoun::Logs => json(&logs::all(snapshot), room),
        KeptNoun::Participants => json(&participants::answer(snapshot, domain), room),
        KeptNoun::Nodes => json(&nodes::answer(snapshot, scope), room),
        KeptNoun::Graph => json(&graph::graph(snapshot, scope), room),
        KeptNoun::Topics => {
            let in_force = context.watches.active();
            let mut all = topics::details_without_figures(state, &in_force);
            // Some topics say more than none.
            loop {
                let json = json(&all, room);
                if json.is_some() || all.topics.is_empty() {
                    return json;
                }
                if !all.remove_past_figures() {
                    all.topics.truncate(all.topics.len() / 2);
                }
            }
        }
    }
}

/// Returns an answer of at most `room` bytes; `None` for a larger one.
fn json(answer: &impl Serialize, room: usize) -> Option<Vec<u8>> {
    let mut limited = Limited {
        bytes: Vec::new(),
        room,
    };
    serde_json::to_writer(&mut limited, answer).ok()?;
    Some(limited.bytes)
}

/// Bytes up to a length. A longer answer takes no memory beyond it.
struct Limited {
    bytes: Vec<u8>,
    room: usize,
}

impl io::Write for Limited {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.bytes.len() + bytes.len() > self.room {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
