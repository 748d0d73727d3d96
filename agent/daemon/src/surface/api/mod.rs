//! The control API: REST over a loopback address and a unix socket, described by an OpenAPI
//! document. The API reads snapshots and changes the watches. The capture never waits for it.
//!
//! Each noun of the API has a module with its routes; `security` contains the checks of every
//! request.

mod actions;
mod body;
mod body_stream;
pub mod chains;
mod clocks;
mod diagnostics;
mod doctor;
mod downloads;
mod endpoint;
mod events;
mod finding;
mod fleet;
mod graph;
mod health;
mod history;
mod index;
mod inside;
mod kept;
pub mod live;
mod logs;
mod measured;
mod messages;
mod names;
mod nearest;
mod nodes;
mod openapi;
pub mod page;
mod parameters;
mod participants;
mod party;
mod past;
mod pipe;
pub mod problem;
mod processes;
mod reasons;
mod recordings;
pub mod reload;
mod replay;
mod ros_parameters;
mod samples;
mod scope;
pub(in crate::surface) mod security;
mod server;
mod services;
mod snapshots;
mod topics;
mod transforms;
mod turns;
mod watch;
mod why;

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::to_bytes;
use axum::extract::{Request, State as Extract};
use axum::http::header::CONTENT_LENGTH;
use axum::http::{Method, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use tokio_util::sync::CancellationToken;
use utoipa_axum::router::OpenApiRouter;

use super::foxglove::Viewers;
use super::large_responses::LargeResponses;
use super::ros2_daemon::Ros2DaemonFigures;
use crate::config::{Access, Limit};
use crate::disk_history::DiskHistory;
use crate::events::EventLog;
use crate::fleet::Reader;
use crate::limit_facts::LimitFigures;
use crate::recording::RecordingFigures;
use crate::recording::{Recordings, Snapshots};
use crate::snapshot_cell::{SnapshotCell, State};
use crate::subscriptions::Subscriptions;
use crate::watches::Watches;
pub use doctor::{Doctor, OwnAnswers};
pub use live::Live;
pub use openapi::document;
pub use page::Page;
pub use past::HistoryWriter;
pub use pipe::serve as serve_in_process;
use problem::{Code, Problem};
use reload::Reloader;
use ros2probe_message::Library;
use security::{AccessRules, RequiredRights};
pub use server::{OpenError, Server};

/// Maximum time that a request waits for a fresh snapshot, which shows the effects of earlier
/// requests.
const FRESH_STATE_TIMEOUT: Duration = Duration::from_millis(600);
/// Maximum time that a request waits until calls inside processes are observed.
const CALL_OBSERVATION_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval at which the request checks for the observation.
const CALL_POLL_INTERVAL: Duration = Duration::from_millis(250);

/// State that the routes share.
#[derive(Clone)]
pub struct Context {
    /// The latest snapshot.
    pub latest: Arc<SnapshotCell>,
    /// The event log.
    pub events: Arc<EventLog>,
    /// The limits and their use.
    pub limits: Arc<LimitFigures>,
    /// Counters of recordings.
    pub recording_figures: Arc<RecordingFigures>,
    /// The watches.
    pub watches: Arc<Watches>,
    /// The subscriptions.
    pub subscriptions: Arc<Subscriptions>,
    /// Bags that the agent writes.
    pub recordings: Arc<Recordings>,
    /// Snapshots: the last seconds of some topics.
    pub snapshots: Arc<Snapshots>,
    /// State that all streams of the web page share.
    pub live: Arc<Live>,
    /// History on disk.
    pub disk_history: Arc<DiskHistory>,
    /// Message definitions.
    pub library: Arc<Library>,
    /// The viewers.
    pub viewers: Arc<Viewers>,
    /// Ports of the ros2 daemon.
    pub ros2_daemon: Arc<Ros2DaemonFigures>,
    /// The web page.
    pub page: Arc<Page>,
    /// Examines this host.
    pub doctor: Doctor,
    /// The robots of a fleet; `None` without an engine.
    pub fleet: Option<Arc<Reader>>,
    /// Reloads the configuration.
    pub reloader: Reloader,
    /// Ends the streams when the agent stops.
    pub stop: CancellationToken,
}

impl Context {
    /// Requests the observation of calls inside processes, and waits at most five seconds until
    /// their rates are known.
    async fn observe_calls(&self) {
        self.latest.request_calls();
        let is_known = async {
            loop {
                self.latest.refresh(FRESH_STATE_TIMEOUT).await;
                let state = self.latest.own_state();
                let source = state.agent.inside.as_ref();
                // Only the mode `auto` needs a wait. In other modes, calls are always observed or
                // never.
                if source.is_none_or(|source| source.mode != "auto" || source.shows_rates) {
                    return;
                }
                tokio::time::sleep(CALL_POLL_INTERVAL).await;
            }
        };
        let _ = tokio::time::timeout(CALL_OBSERVATION_TIMEOUT, is_known).await;
    }

    /// Returns the current state, or a slightly older one if the capture is busy.
    async fn state(&self) -> Arc<State> {
        self.latest.refresh(FRESH_STATE_TIMEOUT).await;
        self.latest.state()
    }
}

/// Returns the name of this host.
pub(super) fn host() -> Option<String> {
    health::HOST_NAME.clone()
}

/// Returns the routes of all nouns with their part of the document.
fn nouns(context: Option<&Context>) -> OpenApiRouter<Context> {
    let turns = |views: OpenApiRouter<Context>| match context {
        Some(context) => views.layer(middleware::from_fn_with_state(context.clone(), take_turns)),
        None => views,
    };
    // These requests wait before they take a permit for a large response.
    let calls = |views: OpenApiRouter<Context>| match context {
        Some(context) => views.layer(middleware::from_fn_with_state(
            context.clone(),
            observe_calls,
        )),
        None => views,
    };
    let needs = |read, change, routes: OpenApiRouter<Context>| {
        let needs = RequiredRights { read, change };
        routes.layer(middleware::from_fn_with_state(
            needs,
            security::require_rights,
        ))
    };
    OpenApiRouter::with_openapi(openapi::head())
        .merge(needs(Access::Read, Access::Watch, watch::routes()))
        .merge(events::routes())
        .merge(live::routes())
        .merge(needs(Access::Watch, Access::Watch, samples::routes()))
        .merge(needs(Access::All, Access::All, recordings::routes()))
        .merge(needs(Access::All, Access::All, downloads::routes()))
        .merge(needs(Access::All, Access::All, snapshots::routes()))
        .merge(turns(views()))
        .merge(topics::part_routes())
        .merge(past::routes())
        .merge(calls(turns(inside::routes())))
        .merge(calls(turns(why::routes())))
        .merge(processes::routes())
        .merge(needs(Access::All, Access::All, logs::routes()))
        .merge(needs(Access::All, Access::All, diagnostics::routes()))
        .merge(needs(Access::All, Access::All, ros_parameters::routes()))
        .merge(transforms::routes())
        .merge(turns(fleet::routes()))
        .merge(health::routes())
        .merge(needs(Access::All, Access::All, reload::routes()))
        .merge(needs(Access::Read, Access::All, replay::routes()))
        .merge(needs(Access::All, Access::All, doctor::routes()))
        .merge(needs(Access::All, Access::All, page::routes()))
        .merge(openapi::routes())
}

/// Returns the routes of large answers.
fn views() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .merge(topics::routes())
        .merge(nodes::routes())
        .merge(services::routes())
        .merge(actions::routes())
        .merge(chains::routes())
        .merge(participants::routes())
        .merge(graph::routes())
        .merge(names::routes())
        .merge(clocks::routes())
}

/// Starts the on-demand observation of calls inside processes before the answer.
async fn observe_calls(
    Extract(context): Extract<Context>,
    request: Request,
    next: Next,
) -> Response {
    context.observe_calls().await;
    next.run(request).await
}

/// Large answers that are being created and read.
static VIEW_RESPONSES: LargeResponses = LargeResponses::new();

/// Creates the answers of some routes as [`in_turn`] does.
async fn take_turns(Extract(context): Extract<Context>, request: Request, next: Next) -> Response {
    in_turn(&context, next.run(request)).await
}

/// Limits the number of large answers, as [`super::large_responses`] describes. A route that waits
/// for a storage calls this when it has read: a slow storage must not delay other answers.
async fn in_turn(context: &Context, answer: impl Future<Output = impl IntoResponse>) -> Response {
    let Some(turn) = VIEW_RESPONSES.permit().await else {
        context.limits.reached(Limit::ApiClients, 1);
        let detail = "memory for responses is used up by slow readers";
        return Problem::new(Code::TooManyClients, detail).into_response();
    };
    let (mut head, body) = answer.await.into_response().into_parts();
    match to_bytes(body, usize::MAX).await {
        Ok(bytes) => {
            head.headers.insert(CONTENT_LENGTH, bytes.len().into());
            Response::from_parts(head, turn.body(bytes))
        }
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Returns the routes with the access checks of `door`.
fn router(context: &Context, door: Arc<AccessRules>) -> Router {
    let (router, _) = nouns(Some(context)).split_for_parts();
    let files = (door.is_for_browsers() && context.page.is_served()).then(|| {
        let guard = middleware::from_fn_with_state(Arc::clone(&door), security::guard_files);
        page::files().layer(guard)
    });
    let router = router
        .fallback(async || Problem::new(Code::NotFound, "the paths are listed in /openapi.json"))
        .method_not_allowed_fallback(async |method: Method| {
            Problem::new(
                Code::MethodNotAllowed,
                format!("{method} is not allowed on this path"),
            )
        })
        .layer(middleware::from_fn_with_state(door, security::guard));
    let router = match files {
        Some(files) => router.merge(files),
        None => router,
    };
    router.with_state(context.clone())
}
