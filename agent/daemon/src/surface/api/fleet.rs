//! `GET /fleet`: the robots that deliver to the configured engine.

use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::problem::{Code, Problem, ProblemBody};
use ros2probe_api::fleet::FleetAnswer;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(fleet))
}

/// The robots of a fleet, and what differs from the others
///
/// They come from the engine of the configuration (`fleet.engine`). The agent queries it every 10 s
/// while this is requested at least each 30 s, and answers with the last result.
#[utoipa::path(
    get,
    path = "/fleet",
    tag = "agent",
    responses(
        (status = 200, description = "The robots, and why the last query failed.",
            body = FleetAnswer),
        (status = 404, description = "The configuration has no engine.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn fleet(State(context): State<Context>) -> Result<Json<FleetAnswer>, Problem> {
    let Some(reader) = &context.fleet else {
        return Err(Problem::new(
            Code::NoFleet,
            "set `fleet.engine` in the configuration to the address of an engine",
        ));
    };
    Ok(Json(reader.ask().answer()))
}
