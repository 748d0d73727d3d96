//! `/diagnostics`: the states of the robot's parts.

use std::borrow::Cow;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::parameters::{Parameters, labelled};
use super::problem::{Problem, ProblemBody};
use super::scope::Domain;
use ros2probe_api::diagnostics::{DiagnosticStatus, DiagnosticValue, Diagnostics};
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{self, Snapshot};
use ros2probe_wire::diagnostics::DiagnosticLevel;

/// The query of `/diagnostics`.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Only this topic.
    #[param(example = "/diagnostics")]
    topic: Option<String>,
    /// Only this level and more severe ones: `ok`, `warn`, `error` or `stale`.
    #[param(example = "warn")]
    level: Option<String>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(diagnostics))
}

/// The states of the robot's parts
///
/// The agent reads `/diagnostics` and `/diagnostics_agg` as they pass. Messages that no
/// subscription requests are not sent, and so they are absent here.
#[utoipa::path(
    get,
    path = "/diagnostics",
    tag = "robot",
    params(Of),
    responses(
        (status = 200, description = "The last status of each part.", body = Diagnostics<'static>),
        (status = 422, description = "The level is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn diagnostics(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let least = match of.level.as_deref() {
        None => DiagnosticLevel::Ok,
        Some(name) => labelled("level", name, &DiagnosticLevel::ALL, DiagnosticLevel::label)?,
    };
    let state = context.state().await;
    let is_of_topic = |topic: &str| of.topic.as_deref().is_none_or(|wanted| wanted == topic);
    let answer = answer(state.known(), |status| {
        domain.admits(status.domain_id) && is_of_topic(&status.topic) && status.level >= least
    });
    Ok(Json(answer).into_response())
}

/// Returns the answer with the wanted statuses.
pub(super) fn answer(
    snapshot: &Snapshot,
    is_wanted: impl Fn(&snapshot::DiagnosticStatus) -> bool,
) -> Diagnostics<'_> {
    let statuses = snapshot.diagnostics.statuses.iter();
    let statuses = statuses.filter(|status| is_wanted(status));
    Diagnostics {
        timestamp_seconds: snapshot.time().seconds(),
        is_on: snapshot.diagnostics.are_read,
        statuses: statuses
            .map(|status| view(status, snapshot.wall_clock))
            .collect(),
    }
}

fn view(status: &snapshot::DiagnosticStatus, clock: WallClock) -> DiagnosticStatus<'_> {
    let values = status.values.iter().map(|(key, value)| DiagnosticValue {
        key: Cow::Borrowed(key),
        value: Cow::Borrowed(value),
    });
    DiagnosticStatus {
        domain_id: status.domain_id.0,
        topic: Cow::Borrowed(&status.topic),
        name: Cow::Borrowed(&status.name),
        hardware_id: Cow::Borrowed(&status.hardware_id),
        ros_node: status.node.as_deref().map(Cow::Borrowed),
        level: status.level.label().into(),
        message: Cow::Borrowed(&status.message),
        timestamp_seconds: clock.wall_time(status.at).seconds(),
        since_seconds: clock.wall_time(status.since).seconds(),
        values: values.collect(),
    }
}
