//! The WebSocket server for viewers: Foxglove, Lichtblick and PlotJuggler show topics, messages,
//! statistics and the graph live, without a subscription on the robot.
//!
//! The server is read-only. A viewer's subscription raises the interest in its topics, as a
//! recording does, and ends with the connection.

mod channels;
mod client;
mod figures;
mod graph;
mod handshake;
mod names;
pub mod protocol;
mod statistics;
#[cfg(test)]
mod tests;

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::HeaderValue;
use axum::http::header::CONNECTION;
use axum::response::{IntoResponse as _, Response};
use hyper_util::rt::TokioIo;
use ros2probe_message::Library;
use tokio::sync::{Notify, watch};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::api;
use super::api::page::Page;
use super::api::problem::{Code, Problem};
use super::api::security::{AccessRules, Kind, Rights, Token, TokenError};
use super::connection::{Connection, ConnectionState};
use super::limited_listener::{LimitedListener, Refusal};
use super::listen::listen;
use super::places::Places;
use super::serving::{self, Plain};
use crate::agent_facts::SourceKind;
use crate::config::{Access, ApiSettings, FoxgloveSettings, Limit};
use crate::limit_facts::LimitFigures;
use crate::snapshot_cell::SnapshotCell;
use crate::subscriptions::Subscriptions;
use channels::{Registry, Table};
use client::Client;
pub use figures::{ViewerFacts, ViewerListener, ViewerTotals, Viewers};

/// Interval at which channels, graph and statistics are updated.
const TICK: Duration = Duration::from_secs(1);
/// Maximum time that a new viewer waits for a fresh snapshot.
const TIMEOUT: Duration = Duration::from_millis(600);

/// A bound listener that is not served yet.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    token: Option<Token>,
    loopback: Access,
    origins: Arc<[String]>,
}

/// State that all viewers share.
struct Shared {
    latest: Arc<SnapshotCell>,
    subscriptions: Arc<Subscriptions>,
    viewers: Arc<Viewers>,
    tables: watch::Sender<Option<Arc<Table>>>,
    /// Wakes the task that updates the tables from the snapshots.
    changed: Notify,
    /// Number of viewers that show the graph.
    graphs: AtomicUsize,
    is_replay: bool,
    name: String,
    session: String,
    stop: CancellationToken,
}

/// State of the listener.
#[derive(Clone)]
struct ListenerState {
    shared: Arc<Shared>,
    access_rules: Arc<AccessRules>,
    origins: Arc<[String]>,
    places: Arc<Places>,
    tasks: TaskTracker,
}

/// Facts about the connection of a request.
#[derive(Clone)]
struct Place {
    address: Option<SocketAddr>,
    state: Arc<ConnectionState>,
}

impl Server {
    /// Binds the configured address. A busy port is a warning, because other servers for these
    /// viewers use the same port, and the agent works without the server.
    ///
    /// # Errors
    /// Fails if the token cannot be loaded.
    pub fn open(
        settings: &FoxgloveSettings,
        api: &ApiSettings,
        viewers: &Viewers,
    ) -> Result<Option<Self>, TokenError> {
        let Some(address) = settings.listen else {
            return Ok(None);
        };
        let token = api.token_file.as_deref().map(Token::load).transpose()?;
        let failed = |reason: String| {
            tracing::warn!(%address, reason, "no viewer can connect: change `foxglove.listen`");
            viewers.set_listener(ViewerListener::Failed(address, reason));
        };
        if !address.ip().is_loopback() && token.is_none() {
            failed("other hosts can reach it, which needs `api.token_file`".to_owned());
            return Ok(None);
        }
        let listener = match listen(address) {
            Ok(listener) => listener,
            Err(error) => {
                failed(error.to_string());
                return Ok(None);
            }
        };
        let bound = listener.local_addr().unwrap_or(address);
        let access = token.is_none().then_some(api.loopback);
        viewers.set_listener(ViewerListener::At(bound, access));
        Ok(Some(Self {
            listener,
            token,
            loopback: api.loopback,
            origins: settings.origins.as_slice().into(),
        }))
    }

    /// Returns the address, with the port that the kernel chose for port 0.
    #[must_use]
    pub fn address(&self) -> Option<SocketAddr> {
        self.listener.local_addr().ok()
    }

    /// Serves viewers until `context` stops.
    ///
    /// # Errors
    /// Fails if the runtime cannot take over the listener.
    pub async fn serve(self, context: api::Context) -> io::Result<()> {
        let is_local = self.listener.local_addr()?.ip().is_loopback();
        let kind = match self.token {
            Some(token) if !is_local => Kind::Network(token),
            token => Kind::Loopback(token),
        };
        let granted = Rights::new(kind.access(self.loopback), None);
        let door = AccessRules::new(kind, granted).with(Arc::<Page>::clone(&context.page));
        let shared = Arc::new(Shared::new(&context));
        let gate = ListenerState {
            shared: Arc::clone(&shared),
            access_rules: Arc::new(door),
            origins: self.origins,
            places: Arc::new(Places::new(
                context.limits.caps().get(Limit::FoxgloveClients),
            )),
            tasks: TaskTracker::new(),
        };
        let tasks = gate.tasks.clone();
        let router = Router::new().fallback(open).with_state(gate);
        let listener = tokio::net::TcpListener::from_std(self.listener)?;
        let full = too_many_viewers(&context.limits);
        let limits = Arc::clone(&context.limits);
        let listener = LimitedListener::new(listener, limits, Limit::FoxgloveClients, Some(full));
        let place = |connection: &Connection<tokio::net::TcpStream>| Place {
            address: connection.stream().peer_addr().ok(),
            state: Arc::clone(connection.state()),
        };
        let stop = context.stop.clone();
        let serving = serving::serve(listener, Plain, router, place, stop.clone());
        let following = follow(Arc::clone(&shared), Arc::clone(&context.library));
        drop(context);
        tokio::join!(serving, async {
            tokio::select! {
                () = following => {}
                () = stop.cancelled() => {}
            }
        });
        tasks.close();
        tasks.wait().await;
        Ok(())
    }
}

impl Shared {
    fn new(context: &api::Context) -> Self {
        let host = api::host().unwrap_or_default();
        let started = SystemTime::now().duration_since(UNIX_EPOCH);
        let version = env!("CARGO_PKG_VERSION");
        Self {
            latest: Arc::clone(&context.latest),
            subscriptions: Arc::clone(&context.subscriptions),
            viewers: Arc::clone(&context.viewers),
            tables: watch::Sender::new(None),
            changed: Notify::new(),
            graphs: AtomicUsize::new(0),
            is_replay: context.latest.state().agent.source == SourceKind::Replay,
            name: format!("ros2probe {version} {host}").trim_end().to_owned(),
            session: started.unwrap_or_default().as_nanos().to_string(),
            stop: context.stop.clone(),
        }
    }

    /// Records that a viewer shows the graph, or no longer shows it.
    fn change_graphs(&self, more: isize) {
        if more > 0 {
            self.graphs.fetch_add(1, Ordering::Relaxed);
            self.changed.notify_one();
        } else {
            self.graphs.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

/// Updates the tables from the snapshots while a viewer is connected.
async fn follow(shared: Arc<Shared>, library: Arc<Library>) {
    let mut registry = Registry::new(Arc::clone(&library));
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let is_any = shared.viewers.is_any();
        if !is_any {
            registry.clear();
            shared.tables.send_replace(None);
        }
        tokio::select! {
            () = shared.changed.notified() => shared.latest.refresh(TIMEOUT).await,
            _ = ticks.tick(), if is_any => {}
        }
        let state = shared.latest.state();
        let with_graph = shared.graphs.load(Ordering::Relaxed) > 0;
        let table = registry.update(state.known(), with_graph).await;
        shared.tables.send_replace(Some(Arc::new(table)));
    }
}

/// Opens a WebSocket, or refuses the request with a reason.
async fn open(State(gate): State<ListenerState>, request: Request) -> Response {
    let place = request.extensions().get::<Place>().cloned();
    let (token, mut request) = handshake::token(request).await;
    let refused = |response: Response| {
        gate.shared.viewers.count_refusal();
        response
    };
    let offered = token.as_deref().map(str::as_bytes);
    let granted =
        gate.access_rules
            .check_viewer(request.headers(), offered, &gate.origins, Instant::now());
    let granted = match granted {
        Ok(granted) => granted,
        Err(problem) => return refused(refusal(problem)),
    };
    let response = match handshake::accept(&request) {
        Ok(response) => response,
        Err(unfit) => return refused(unfit.into_response()),
    };
    let Some(taken) = gate.places.take(granted.has_token()) else {
        let detail = "all places for viewers without a token are taken, a quarter of \
                      limits.foxglove_clients is for others: add `?token=TOKEN` to the address, as \
                      `rp foxglove` prints it";
        return refused(refusal(Problem::new(Code::TooManyClients, detail)));
    };
    let upgrade = hyper::upgrade::on(&mut request);
    let ListenerState { shared, tasks, .. } = gate;
    tasks.spawn(async move {
        let _taken = taken;
        let Ok(stream) = upgrade.await else {
            return;
        };
        let address = place.as_ref().and_then(|place| place.address);
        if let Some(place) = place {
            // A viewer need not send data while it reads.
            place.state.begin_answer(false);
        }
        let access = granted.access();
        let viewer = shared.viewers.join(address, access);
        let client = Client::new(TokioIo::new(stream), shared, access, viewer).await;
        client.run().await;
    });
    response
}

fn refusal(problem: Problem) -> Response {
    let close = [(CONNECTION, HeaderValue::from_static("close"))];
    (close, problem).into_response()
}

/// Returns the answer to a viewer beyond the limit of connections.
fn too_many_viewers(limits: &LimitFigures) -> Refusal {
    let most = limits.caps().get(Limit::FoxgloveClients);
    let text =
        format!("{most} viewers are connected, which is the limit (limits.foxglove_clients)\n");
    Refusal::new("text/plain; charset=utf-8", &text)
}
