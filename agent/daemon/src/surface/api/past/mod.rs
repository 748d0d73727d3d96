//! `/history`: what the agent keeps on disk of the last days, and the robot as it was at a moment.

mod answers;
mod event_range;
mod latest;
mod query;
mod rates;
mod selection;
#[cfg(test)]
mod tests;
mod topic;
mod writer;

use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::HeaderValue;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::Response;
use axum::{Extension, Json};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::body_stream::lines_of;
use super::parameters::{Parameters, labelled};
use super::problem::{Code, Problem, ProblemBody};
use super::security::Rights;
use super::{Context, in_turn};
use latest::{LatestEvents, LatestProcesses};
use ros2probe_api::history::{
    DiskHistory, HistorySpan, KeptNoun, ProcessColumns, ProcessHistory, TRUNCATED_HEADER,
};
use ros2probe_history::{ProcessRow, Span, Store};

use event_range::EventRange;
pub(super) use query::TopicRange;
use query::{TimeRange, read_store};
use selection::Named;
pub(super) use topic::show as show_topic;
pub use writer::HistoryWriter;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(get_history))
        .routes(routes!(get_moment))
        .routes(routes!(get_answer))
        .routes(routes!(processes))
        .routes(routes!(events))
}

/// Maximum age of an answer at a moment, in seconds: if some minutes could not be written, an earlier
/// answer must not pass for one of them.
const MAX_AGE_S: u32 = 150;

/// The moment of a question.
#[derive(Clone, Copy, Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct MomentQuery {
    /// Unix time.
    #[param(minimum = 0, example = 1_790_000_000)]
    at: f64,
}

/// The moment of a question about an answer, and the part of it that is wanted.
#[derive(Clone, Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct AnswerQuery {
    /// Unix time.
    #[param(minimum = 0, example = 1_790_000_000)]
    at: f64,
    /// Only the topics or nodes of this name, as in `/topics/{topic}` and `/nodes/{node}`.
    #[param(example = "points")]
    name: Option<String>,
    /// Domain id of the topics or nodes; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
}

/// Size and reach of the history on disk
///
/// The agent writes it each minute (`page.history_bytes`): the figures of each measured topic and
/// of the robot's processes, the events, and the state of the robot.
#[utoipa::path(
    get,
    path = "/history",
    tag = "graph",
    responses((status = 200, description = "The history.", body = DiskHistory))
)]
async fn get_history(State(context): State<Context>) -> Json<DiskHistory> {
    let history = &context.disk_history;
    let [writes, failed_writes] = history.writes();
    let span = |span: Option<Span>| {
        span.map(|span| HistorySpan {
            begin_timestamp_seconds: span.begin.into(),
            end_timestamp_seconds: span.end.into(),
        })
    };
    let facts = read_store(&context, Store::facts).await;
    let facts = facts.map(|(facts, _)| facts).unwrap_or_default();
    Json(DiskHistory {
        is_kept: history.is_kept(),
        bytes: facts.bytes,
        limit_bytes: facts.limit,
        seconds: span(facts.seconds),
        tens: span(facts.tens),
        answers: span(facts.documents),
        writes,
        failed_writes,
    })
}

/// The robot as it was
///
/// The lines are those at the beginning of `/live`. They describe the last state that was written
/// before `at`: one a minute, and one per ten minutes further back. The line with the rates of the
/// minutes before ends at `at`.
#[utoipa::path(
    get,
    path = "/history/moment",
    tag = "graph",
    params(MomentQuery),
    responses(
        (status = 200, description = "The lines of the state.",
            body = ros2probe_api::live::Line<'static>, content_type = "application/x-ndjson"),
        (status = 404, description = "No state of that time is kept.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "A time or the step is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn get_moment(
    State(context): State<Context>,
    Parameters(moment): Parameters<MomentQuery>,
) -> Result<Response, Problem> {
    let at = query::second(moment.at)?;
    let lines = read_store(&context, move |store| {
        let state = store.state(at)?;
        Some(rates::with_rates(&state.content, store, at))
    });
    let (lines, _permit) = lines.await?;
    let lines = lines.ok_or_else(|| {
        Problem::new(
            Code::NoHistory,
            "no state of that time or before is in the history",
        )
    })?;
    Ok(in_turn(&context, async { lines_of(lines) }).await)
}

/// An answer of the API as it was
///
/// The answer is that of `/parameters`, `/chains` and so on without a query, with hidden names. It is
/// the last one that was written before `at`: one a minute, and one every ten minutes in the part of
/// the history without seconds. Topics have the form of `/topics/{topic}`, without measurements and
/// histograms, and with the acknowledgements of readers that lag; those of services and discovery are
/// left out. Each measured publisher has `past_figures`. With `name` or `domain_id`, the list of
/// topics or nodes has only those, or none. Parameters, diagnostics and logs need the same rights as in
/// the present.
#[utoipa::path(
    get,
    path = "/history/moment/{noun}",
    tag = "graph",
    params(("noun" = KeptNoun, Path, description = "The noun."), AnswerQuery),
    responses(
        (status = 200, description = "The answer of that time.",
            body = answers::KeptAnswer<'static>),
        (status = 403, description = "The listener does not grant this answer.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 404, description = "No such answer of that time is kept.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "The noun or the time is invalid, or the noun has no names.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn get_answer(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
    Path(noun): Path<String>,
    Parameters(question): Parameters<AnswerQuery>,
) -> Result<Response, Problem> {
    let noun = labelled("noun", &noun, &KeptNoun::ALL, KeptNoun::label)?;
    granted.require(answers::required_rights(noun))?;
    let at = query::second(question.at)?;
    let wanted = Named::of(noun, question.name, question.domain_id)?;
    let read = read_store(&context, move |store| {
        // Graph and tables of the moment are those of this time.
        let time = store.state_end(at).unwrap_or(at);
        let version = store.document(noun.label(), time)?;
        let is_recent = time.saturating_sub(version.at) <= MAX_AGE_S;
        let whole = is_recent.then_some(version.content)?;
        match wanted {
            Some(wanted) => wanted.part_of(&whole),
            None => Some(whole),
        }
    });
    let (answer, _permit) = read.await?;
    let answer = answer.ok_or_else(|| {
        let detail = format!("no answer of /{} of that time is kept", noun.label());
        Problem::new(Code::NoHistory, detail)
    })?;
    let headers = [
        (CACHE_CONTROL, "no-store"),
        (CONTENT_TYPE, "application/json"),
    ];
    Ok(in_turn(&context, async { (headers, answer) }).await)
}

/// CPU time and memory of the robot's processes
///
/// A process is named by its id and its script or program. An answer has at most 512 processes, the
/// latest ones.
#[utoipa::path(
    get,
    path = "/history/processes",
    tag = "graph",
    params(TimeRange),
    responses(
        (status = 200, description = "The processes of that time.", body = ProcessHistory),
        (status = 404, description = "No history is kept.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "A time or the step is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn processes(
    State(context): State<Context>,
    Parameters(range): Parameters<TimeRange>,
) -> Result<Response, Problem> {
    let range = range.checked(query::now(&context))?;
    let read = read_store(&context, move |store| {
        let mut latest = LatestProcesses::default();
        store.processes(range.times(), range.step, &|_| true, &mut |name, row| {
            latest.add(name, row, range.step);
        });
        latest
    });
    let (latest, _permit) = read.await?;
    let answer = async {
        Json(ProcessHistory {
            interval_seconds: range.step,
            is_truncated: latest.is_truncated(),
            processes: columns(latest),
        })
    };
    Ok(in_turn(&context, answer).await)
}

fn columns(latest: LatestProcesses) -> Vec<ProcessColumns> {
    let columns = latest.into_rows().map(|(process, rows)| {
        let cpu = |row: &ProcessRow| {
            let seconds = f64::from(row.seconds.max(1));
            super::history::thousandths(f64::from(row.cpu_ms) / 1e3 / seconds)
        };
        ProcessColumns {
            process_id: process.id,
            process: process.name,
            times: rows.iter().map(|row| row.at.into()).collect(),
            cpu_cores: rows.iter().map(cpu).collect(),
            memory_bytes: rows.iter().map(|row| row.memory_kib << 10).collect(),
        }
    });
    columns.collect()
}

/// The events of a time
///
/// Each line is an event, as in `/events`, also one that is not on disk yet. If they are more than
/// 8 MiB, the oldest are missing.
#[utoipa::path(
    get,
    path = "/history/events",
    tag = "events",
    params(TimeRange),
    responses(
        (status = 200, description = "The events, the oldest first.",
            body = ros2probe_api::events::Event<'static>, content_type = "application/x-ndjson",
            headers(("ros2probe-truncated" = String,
                description = "`true` if the oldest events are missing, else absent."))),
        (status = 404, description = "No history is kept.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "A time or the step is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn events(
    State(context): State<Context>,
    Parameters(range): Parameters<TimeRange>,
) -> Result<Response, Problem> {
    let range = range.checked(query::now(&context))?;
    let log = Arc::clone(&context.events);
    let read = read_store(&context, move |store| {
        let mut latest = LatestEvents::default();
        let mut selected = EventRange::new(&log, range);
        store.events(range.times(), &mut |lines| {
            latest.add(selected.of_block(lines));
        });
        latest.add(selected.unwritten());
        latest
    });
    let (latest, _permit) = read.await?;
    let answer = async {
        let is_truncated = latest.is_truncated();
        let mut response = lines_of(latest.into_lines());
        if is_truncated {
            let headers = response.headers_mut();
            headers.insert(TRUNCATED_HEADER, HeaderValue::from_static("true"));
        }
        response
    };
    Ok(in_turn(&context, answer).await)
}
