//! `/logs`: what nodes log.

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
use super::problem::{Code, Problem, ProblemBody};
use super::scope::Domain;
use ros2probe_api::logs::{LevelLog, LogMessage, Logs, NodeLog};
use ros2probe_model::facts::tables::LogMessages;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{self, NodeLogFacts, Snapshot};
use ros2probe_wire::DomainId;
use ros2probe_wire::log::LogLevel;

/// Number of messages in an answer by default, and at most.
const DEFAULT_LIMIT: usize = 100;
const MAX_LIMIT: usize = LogMessages::CAP;

/// The query of `/logs`.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Only this node, by its fully qualified name.
    #[param(example = "/robot1/lidar")]
    node: Option<String>,
    /// Only messages of this level and more severe ones: `debug`, `info`, `warn`, `error` or
    /// `fatal`.
    #[param(example = "warn")]
    level: Option<String>,
    /// Maximum number of messages; by default 100. The agent keeps the latest 1000.
    #[param(minimum = 0, maximum = 1000)]
    limit: Option<usize>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(logs))
}

/// The logs of nodes
///
/// The agent reads `/rosout` as it passes. Messages that no subscription requests are not sent, and
/// so they are absent here.
#[utoipa::path(
    get,
    path = "/logs",
    tag = "robot",
    params(Of),
    responses(
        (status = 200, description = "Counts by node and level, and the latest messages.",
            body = Logs<'static>),
        (status = 422, description = "The level or the limit is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn logs(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let least = match of.level.as_deref() {
        None => LogLevel::Debug,
        Some(name) => labelled("level", name, &LogLevel::ALL, LogLevel::label)?,
    };
    let limit = of.limit.unwrap_or(DEFAULT_LIMIT);
    if limit > MAX_LIMIT {
        let detail = format!("the agent keeps {MAX_LIMIT} messages: `limit` is at most that");
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    let state = context.state().await;
    let is_wanted = |domain_id, name: &str| {
        domain.admits(domain_id) && of.node.as_deref().is_none_or(|wanted| wanted == name)
    };
    Ok(Json(answer(state.known(), limit, least, is_wanted)).into_response())
}

/// Returns the answer with all messages that the agent keeps.
pub(super) fn all(snapshot: &Snapshot) -> Logs<'_> {
    answer(snapshot, MAX_LIMIT, LogLevel::Debug, |_, _| true)
}

/// Returns the answer with the latest messages of the wanted nodes and of this level.
fn answer(
    snapshot: &Snapshot,
    limit: usize,
    least: LogLevel,
    is_wanted: impl Fn(DomainId, &str) -> bool,
) -> Logs<'_> {
    let clock = snapshot.wall_clock;
    let nodes = snapshot.logs.nodes.iter();
    let nodes = nodes.filter(|log| is_wanted(log.domain_id, &log.node));
    let latest = snapshot.logs.latest.iter().rev();
    let messages = latest
        .filter(|message| is_wanted(message.domain_id, &message.node) && message.level >= least);
    let mut messages: Vec<_> = messages
        .take(limit)
        .map(|message| view(message, clock))
        .collect();
    messages.reverse();
    Logs {
        timestamp_seconds: snapshot.time().seconds(),
        is_on: snapshot.logs.are_read,
        nodes: nodes.map(|log| node(log, clock)).collect(),
        messages,
    }
}

fn node(log: &NodeLogFacts, clock: WallClock) -> NodeLog<'_> {
    let levels = LogLevel::ALL.iter().zip(&log.levels);
    let levels = levels.filter_map(|(level, (messages, last))| {
        Some(LevelLog {
            level: level.label().into(),
            messages: *messages,
            last: view(last.as_ref()?, clock),
        })
    });
    NodeLog {
        domain_id: log.domain_id.0,
        ros_node: Cow::Borrowed(&log.node),
        levels: levels.collect(),
    }
}

fn view(message: &snapshot::LogMessage, clock: WallClock) -> LogMessage<'_> {
    LogMessage {
        timestamp_seconds: clock.wall_time(message.at).seconds(),
        stamp_sec: message.stamp.0,
        stamp_nanosec: message.stamp.1,
        domain_id: message.domain_id.0,
        ros_node: Cow::Borrowed(&message.node),
        level: message.level.label().into(),
        logger: Cow::Borrowed(&message.logger),
        text: Cow::Borrowed(&message.text),
        file: Cow::Borrowed(&message.file),
        function: Cow::Borrowed(&message.function),
        line: message.line,
        writer: message.writer.to_string(),
        sequence_number: message.number.0,
    }
}
