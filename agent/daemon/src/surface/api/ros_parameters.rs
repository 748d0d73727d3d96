//! `/parameters`: parameters of nodes and their changes.

use std::borrow::Cow;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::parameters::Parameters;
use super::problem::{Problem, ProblemBody};
use super::scope::Domain;
use ros2probe_api::parameters as api;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{self, Snapshot};
use ros2probe_wire::DomainId;

/// The query of `/parameters`.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Only this node, by its fully qualified name.
    #[param(example = "/robot1/planner")]
    node: Option<String>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(parameters))
}

/// Parameters of nodes
///
/// The agent reads `/parameter_events` and requests of `set_parameters` as they pass. A parameter
/// that no node declared or changed since the agent started is unknown.
#[utoipa::path(
    get,
    path = "/parameters",
    tag = "robot",
    params(Of),
    responses(
        (status = 200, description = "Last known values, and the latest changes.",
            body = api::Parameters<'static>),
        (status = 422, description = "The domain is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn parameters(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let state = context.state().await;
    let answer = answer(state.known(), |domain_id, node| {
        domain.admits(domain_id) && of.node.as_deref().is_none_or(|wanted| wanted == node)
    });
    Ok(Json(answer).into_response())
}

/// Returns the answer with the parameters of the wanted nodes.
pub(super) fn answer(
    snapshot: &Snapshot,
    is_wanted: impl Fn(DomainId, &str) -> bool,
) -> api::Parameters<'_> {
    let clock = snapshot.wall_clock;
    let known = snapshot.parameters.known.iter();
    let known = known.filter(|each| is_wanted(each.domain_id, &each.node));
    let changes = snapshot.parameters.changes.iter();
    let changes = changes.filter(|each| is_wanted(each.domain_id, &each.node));
    api::Parameters {
        timestamp_seconds: snapshot.time().seconds(),
        is_on: snapshot.parameters.are_read,
        parameters: known.map(|parameter| view(parameter, clock)).collect(),
        changes: changes.map(|change| changed(change, clock)).collect(),
    }
}

fn view(parameter: &snapshot::ParameterFacts, clock: WallClock) -> api::Parameter<'_> {
    api::Parameter {
        domain_id: parameter.domain_id.0,
        ros_node: Cow::Borrowed(&parameter.node),
        name: Cow::Borrowed(&parameter.name),
        value: Cow::Borrowed(&parameter.value),
        timestamp_seconds: clock.wall_time(parameter.at).seconds(),
    }
}

fn changed(change: &snapshot::ParameterChange, clock: WallClock) -> api::ParameterChange<'_> {
    let client = change.requested_by.as_ref();
    api::ParameterChange {
        timestamp_seconds: clock.wall_time(change.at).seconds(),
        monotonic_ns: change.at.nanoseconds(),
        domain_id: change.domain_id.0,
        ros_node: Cow::Borrowed(&change.node),
        name: Cow::Borrowed(&change.name),
        before: change.before.as_deref().map(Cow::Borrowed),
        value: change.value.as_deref().map(Cow::Borrowed),
        requested_by: client.and_then(|client| client.node.as_deref().map(Cow::Borrowed)),
        requested_by_writer: client.map(|client| client.writer.to_string()),
    }
}
