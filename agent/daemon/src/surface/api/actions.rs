//! `/actions`: each action combines its three services and two topics.

use std::borrow::Cow;
use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::finding::diagnosis;
use super::index::Index;
use super::parameters::Parameters;
use super::party::{Parties, action, action_type};
use super::problem::Problem;
use super::scope::Scope;
use super::services::sorted;
use ros2probe_api::services::{Action, ActionList, Goals};
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};
use ros2probe_wire::DomainId;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// All actions
#[utoipa::path(
    get,
    path = "/actions",
    tag = "graph",
    params(Scope),
    responses((status = 200, description = "Actions.", body = ActionList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(scope): Parameters<Scope>,
) -> Result<Response, Problem> {
    let scope = scope.checked()?;
    let state = context.state().await;
    Ok(Json(answer(state.known(), scope)).into_response())
}

/// Returns the answer with the actions of a scope.
pub(super) fn answer(snapshot: &Snapshot, scope: Scope) -> ActionList<'_> {
    let index = Index::new(snapshot);
    let actions = actions(snapshot, scope).into_iter();
    ActionList {
        timestamp_seconds: snapshot.time().seconds(),
        actions: actions
            .filter_map(|((domain_id, name), parts)| {
                let goals = goals(snapshot, domain_id, &name);
                let action = view(domain_id.0, name, &parts, &index)?;
                Some(Action { goals, ..action })
            })
            .collect(),
    }
}

/// Groups the topics of actions by domain and name. The topics are always hidden, but an action is
/// hidden only if its own name is hidden.
pub(super) fn actions(
    snapshot: &Snapshot,
    scope: Scope,
) -> BTreeMap<(DomainId, String), Vec<&TopicFacts>> {
    let mut actions: BTreeMap<_, Vec<_>> = BTreeMap::new();
    let admitted = snapshot.topics.iter();
    for topic in admitted.filter(|topic| scope.includes(topic.domain_id)) {
        if let Some((name, _)) = action(topic)
            && (!name.is_hidden() || scope.shows_hidden())
        {
            let key = (topic.domain_id, name.as_str().to_owned());
            actions.entry(key).or_default().push(topic);
        }
    }
    actions
}

/// Returns the servers and clients of an action.
pub(super) fn parties<'a>(parts: &[&'a TopicFacts]) -> Parties<'a> {
    let mut parties = Parties::default();
    parts.iter().for_each(|part| parties.add(part));
    parties
}

/// Returns the goals of an action, if a goal was seen.
fn goals(snapshot: &Snapshot, domain_id: DomainId, name: &str) -> Option<Goals> {
    let mut actions = snapshot.actions.iter();
    let facts = actions.find(|each| each.domain_id == domain_id && each.name == name)?;
    Some(Goals {
        accepted: facts.goals.accepted,
        rejected: facts.goals.rejected,
        succeeded: facts.goals.succeeded,
        canceled: facts.goals.canceled,
        aborted: facts.goals.aborted,
        open: facts.open as u64,
        duration_p50_seconds: facts.duration.p50,
        duration_p99_seconds: facts.duration.p99,
    })
}

/// Returns the API representation of an action, or `None` if the action has no endpoints.
fn view<'a>(
    domain_id: u32,
    name: String,
    parts: &[&'a TopicFacts],
    index: &Index<'a>,
) -> Option<Action<'a>> {
    let parties = parties(parts);
    if parties.is_empty() {
        return None;
    }
    let [servers, clients] = parties.views();
    let types = parts.iter().flat_map(|part| &part.message_types);
    let findings = parts.iter().flat_map(|part| index.findings(part));
    Some(Action {
        domain_id,
        name,
        types: sorted(types.filter_map(|each| action_type(each))),
        servers,
        clients,
        goals: None,
        parts: parts
            .iter()
            .map(|part| Cow::Borrowed(&*part.dds_name))
            .collect(),
        diagnoses: findings.map(|finding| diagnosis(finding)).collect(),
    })
}
