//! `GET /live`: the data of the web page, first the whole state, then the changes of each second.
//!
//! A slow client does not delay others. Each stream stores the last state that it has sent, and
//! sends the changes since then when the client reads further. States in between are skipped.
//! Without an open stream, no work is done.

mod findings;
mod inside;
mod measured;
pub(super) mod rate_steps;
mod robot;
mod shared_lines;
mod structure;
mod values;

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Extension, State};
use axum::response::Response;
use bytes::Bytes;
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::{Instant, sleep_until};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body_stream::{Pieces, lines_of, stream_of, write_line};
use super::events::event;
use super::health::HOST_NAME;
use super::problem::{Code, Problem, ProblemBody};
use super::security::Rights;
use crate::agent_facts::SourceKind;
use crate::events::Reader;
use crate::snapshot_cell::State as Known;
use crate::surface::places::Places;
use ros2probe_api::live::{End, Events, Line, Open, Replay};
use ros2probe_model::report::snapshot::Transport;
use shared_lines::SharedLines;
pub(super) use structure::is_shown;

/// Maximum number of streams of all listeners. The maximum is lower than that of connections, so
/// that other requests still get a connection.
const MAX_TABS: usize = 16;
/// Time between two batches; the agent publishes its state once per second.
const BATCH_INTERVAL: Duration = Duration::from_secs(1);
/// The stream begins to wait for the next state this long before it is due.
const EARLY_WAIT: Duration = Duration::from_millis(100);
/// Maximum number of events in one batch.
const MAX_EVENTS: usize = 64;

/// State that all streams share. The shared lines exist only while a stream is open.
#[derive(Debug)]
pub struct Live {
    /// Time for which measurements are kept.
    history: Duration,
    places: Places,
    shared: Mutex<Option<SharedLines>>,
}

/// The stream of one client.
struct Stream {
    context: Context,
    access: String,
    /// The round of the last state that was sent; `None` before the first state.
    last_sent_round: Option<u64>,
    sent: Instant,
    /// Number of the last event that was processed.
    place: u64,
    /// The run of the agent that was sent.
    run: String,
    ended: bool,
    permit: Option<OwnedSemaphorePermit>,
}

impl Live {
    /// Creates the state of an agent that keeps measurements for the time `history`.
    #[must_use]
    pub fn new(history: Duration) -> Self {
        Self {
            history,
            places: Places::new(MAX_TABS),
            shared: Mutex::new(None),
        }
    }

    fn shared(&self) -> MutexGuard<'_, Option<SharedLines>> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(live))
}

/// The robot's state and its changes
///
/// Each line is a JSON object with one member. The stream begins with `open`, `graph`, `agent`,
/// `findings`, `history` and `values` with every row. Then each second, the stream sends the lines
/// that changed, and always `values` with the changed rows. A client that reads slowly gets fewer
/// batches, each complete. Numbers of topics, nodes and participants are valid within one stream.
#[utoipa::path(
    get,
    path = "/live",
    tag = "graph",
    responses(
        (status = 200, description = "Lines, until the client disconnects or the agent stops.",
            body = ros2probe_api::live::Line<'static>, content_type = "application/x-ndjson"),
        (status = 503, description = "Too many streams, or the agent is shutting down.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn live(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
) -> Result<Response, Problem> {
    let (places, has_token) = (&context.live.places, granted.has_token());
    let permit = places
        .take(has_token)
        .ok_or_else(|| Problem::new(Code::TooManyStreams, places.refusal("pages", has_token)))?;
    let stream = Stream {
        access: granted.access().to_string(),
        last_sent_round: None,
        sent: Instant::now(),
        place: context.events.last(),
        run: context.events.run(),
        ended: false,
        permit: Some(permit),
        context,
    };
    Ok(lines_of(Body::from_stream(stream_of(stream))))
}

/// Returns the lines that describe the whole state, as at the beginning of a stream, without rates
/// of earlier minutes and events.
pub(super) fn initial_lines(context: &Context) -> Vec<u8> {
    let (state, past) = (context.latest.state(), context.latest.past());
    let mut shared = SharedLines::default();
    shared.update(&state, &past, &context.watches.active());
    let mut lines = Vec::new();
    write_line(
        &mut lines,
        &Line::Open(open(context, &state, "watch".into())),
    );
    for part in shared.parts(0) {
        lines.extend_from_slice(part);
    }
    write_line(&mut lines, &Line::Values(shared.values(0)));
    lines
}

/// Returns the first line of a stream.
fn open(context: &Context, state: &Known, access: String) -> Open {
    let replay = (state.agent.source == SourceKind::Replay).then(|| Replay {
        begin: state.agent.capture_begin.map(|begin| begin.seconds()),
        incident: state.agent.replay_incident.clone(),
    });
    Open {
        run: context.events.run(),
        host: HOST_NAME.clone(),
        version: env!("CARGO_PKG_VERSION").into(),
        source: state.agent.source.label().into(),
        access,
        interval_seconds: 1,
        history_seconds: context.live.history.as_secs(),
        keeps_history: context.disk_history.is_kept(),
        has_fleet: context.fleet.is_some(),
        flags: values::FLAG_MEANINGS.map(Into::into).into(),
        passages: Transport::ALL.map(|each| each.label().into()).into(),
        replay,
    }
}

impl Pieces for Stream {
    type Piece = Bytes;

    /// Returns the next batch; `None` at the end of the stream.
    async fn next(&mut self) -> Option<Bytes> {
        if self.ended {
            return None;
        }
        let mut lines = Vec::new();
        if self.last_sent_round.is_none() {
            self.context.state().await;
        } else if !self.wait_next_state().await {
            self.ended = true;
            let reason = "the agent ends".into();
            write_line(&mut lines, &Line::End(End { reason }));
            return Some(lines.into());
        }
        self.sent = Instant::now();
        self.batch(&mut lines);
        Some(lines.into())
    }
}

impl Stream {
    /// Waits for the next state. Returns `false` if the agent stops.
    async fn wait_next_state(&self) -> bool {
        let latest = &self.context.latest;
        let next = async {
            sleep_until(self.sent + BATCH_INTERVAL - EARLY_WAIT).await;
            tokio::select! {
                () = latest.published() => {}
                // A finished capture publishes no further state.
                () = sleep_until(self.sent + BATCH_INTERVAL + EARLY_WAIT * 3) => {}
            }
        };
        tokio::select! {
            () = self.context.stop.cancelled() => false,
            () = next => true,
        }
    }

    fn batch(&mut self, lines: &mut Vec<u8>) {
        let context = &self.context;
        let run = context.events.run();
        if run != self.run {
            // A replay went back. The page begins again, too.
            (self.last_sent_round, self.run) = (None, run.clone());
        }
        let (state, past) = (context.latest.state(), context.latest.past());
        let mut shared = context.live.shared();
        let shared = shared.get_or_insert_default();
        shared.begin_run(run);
        shared.update(&state, &past, &context.watches.active());
        let seen = self.last_sent_round.unwrap_or(0);
        if self.last_sent_round.is_none() {
            let open = open(context, &state, self.access.clone());
            write_line(lines, &Line::Open(open));
        }
        for part in shared.parts(seen) {
            lines.extend_from_slice(part);
        }
        if self.last_sent_round.is_none() {
            let history = values::history(state.known(), &past, &shared.ids);
            write_line(lines, &Line::History(history));
        }
        let log = &context.events;
        let batch = log.read(self.place, MAX_EVENTS);
        self.place = batch.last;
        if batch.lagged > 0 || !batch.records.is_empty() {
            log.count_overwritten(Reader::Stream, batch.lagged);
            let events = Events {
                missed: batch.lagged,
                list: batch
                    .records
                    .iter()
                    .map(|record| event(log, record))
                    .collect(),
            };
            write_line(lines, &Line::Events(events));
        }
        write_line(lines, &Line::Values(shared.values(seen)));
        self.last_sent_round = Some(shared.round());
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        self.permit = None;
        let live = &self.context.live;
        if live.places.is_unused() {
            *live.shared() = None;
        }
    }
}
