//! `GET /health`: whether the agent sees the robot, and how well.

use std::time::Instant;

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;

/// How the agent is.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Health {
    /// Packets are captured and what is known is fresh.
    ready: bool,
    /// Why it is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    reason: Option<String>,
    /// Version of the agent.
    version: &'static str,
    /// Where it looks: `host`, `wire` or `replay`.
    source: &'static str,
    /// Watches in force, of every origin.
    watches: usize,
    /// Watches that clients add outlive the agent: there is a state directory that can be written.
    watches_kept: bool,
    /// Packets lost because a ring was full: above 0, counts are lower bounds.
    dropped_packets: u64,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(health))
}

/// Whether the agent sees the robot
#[utoipa::path(
    get,
    path = "/health",
    tag = "agent",
    responses((status = 200, description = "How it is, also when it is not well.", body = Health))
)]
async fn health(State(context): State<Context>) -> Json<Health> {
    let state = context.board.state();
    let ready = state.ready(Instant::now());
    let interfaces = state.agent.interfaces.iter();
    Json(Health {
        ready: ready.is_ok(),
        reason: ready.err(),
        version: env!("CARGO_PKG_VERSION"),
        source: state.agent.source.label(),
        watches: context.watches.in_force().entries().len(),
        watches_kept: context.watches.is_kept(),
        dropped_packets: interfaces.filter_map(|interface| interface.dropped).sum(),
    })
}
