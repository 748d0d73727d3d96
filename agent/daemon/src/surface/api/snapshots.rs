//! `/snapshots`: the last seconds of topics, written to a bag on request.

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::problem::{Code, Problem, ProblemBody};
use crate::events::Trigger;
use crate::recording::SnapshotFigures;
use ros2probe_api::snapshots::{Snapshot, SnapshotList, WrittenSnapshot};

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(write))
}

/// All snapshots
#[utoipa::path(
    get,
    path = "/snapshots",
    tag = "recordings",
    responses((status = 200, description = "The snapshots of the configuration.", body = SnapshotList))
)]
async fn list(State(context): State<Context>) -> Json<SnapshotList> {
    let figures = context.recording_figures.snapshots();
    let snapshots = context.snapshots.settings().map(|settings| {
        let known = figures.iter().find(|(name, _)| *name == settings.name);
        let SnapshotFigures {
            messages,
            bytes,
            evicted: crowded_out,
            written,
            failed,
            suppressed,
            removed,
        } = known.map_or_else(SnapshotFigures::default, |(_, figures)| *figures);
        let triggers: Vec<_> = settings.triggers.iter().map(Trigger::name).collect();
        Snapshot {
            name: settings.name.clone(),
            topics: settings.topics.clone(),
            domain_id: settings.domain_id,
            seconds: settings.before.as_secs(),
            seconds_after: settings.after.as_secs(),
            max_bytes: settings.max_bytes,
            on_violation: triggers.contains(&"expectation"),
            trigger: triggers.into_iter().map(str::to_owned).collect(),
            min_interval_s: settings.min_interval.as_secs(),
            max_count: settings.max_count,
            max_total_bytes: settings.max_total_bytes,
            messages,
            bytes,
            crowded_out,
            written,
            failed,
            suppressed,
            removed,
        }
    });
    Json(SnapshotList {
        snapshots: snapshots.collect(),
    })
}

/// Write a snapshot to a bag
///
/// The answer follows once the messages in memory are in a bag. The messages also stay in memory.
/// The bag is never removed to free space for other bags.
#[utoipa::path(
    post,
    path = "/snapshots/{name}",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the snapshot.")),
    responses(
        (status = 201, description = "The bag.", body = WrittenSnapshot),
        (status = 404, description = "The configuration has no snapshot of that name.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 507, description = "The bag could not be written; the messages stay in memory.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn write(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    let Some(written) = context.snapshots.write(&name).await else {
        let name: String = name.chars().take(64).collect();
        let detail = format!("no snapshot `{name}`; GET /snapshots lists them");
        return Err(Problem::new(Code::NoSuchSnapshot, detail));
    };
    let written = written.map_err(|error| Problem::new(Code::StorageRefuses, error.to_string()))?;
    let view = WrittenSnapshot {
        name: written.name,
        directory: written.directory.display().to_string(),
        messages: written.messages,
    };
    Ok((StatusCode::CREATED, Json(view)).into_response())
}
