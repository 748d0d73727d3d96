//! The daemon of the `ros2` command line: XML-RPC on loopback, answered from the snapshot.
//!
//! Commands such as `ros2 topic list` query the daemon of their domain. If no daemon answers, they
//! start one, which is a DDS participant. While the agent answers, they do not start a daemon, and
//! show the graph that the agent has observed. Only graph functions exist, for names, types and
//! QoS, but not for messages. The only function with an effect, `system.shutdown`, releases the
//! port for a minute.

pub mod call;
mod client;
mod connection;
mod endpoint_info;
pub mod figures;
mod function;
mod graph;
mod peer;
mod ports;
mod request;
#[cfg(test)]
mod tests;
mod value;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_message::Dialect;
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep};
use tokio_util::sync::CancellationToken;

use crate::privilege::{self, Role, SpawnError, Unprivileged};
use crate::snapshot_cell::SnapshotCell;
use crate::tables::Ros2DaemonClients;
use crate::watches::Watches;
use connection::{ConnectionState, Connections, Stream};
use figures::Refused;
pub use figures::{PortState, Ros2DaemonFigures, port};
use ports::{Accepted, Ports};
use request::Requests;

/// Interval of attempts to bind the ports of domains in use.
const TICK: Duration = Duration::from_secs(1);
/// Time for answers in progress when their port is released.
const LAST_ANSWERS: Duration = Duration::from_millis(200);

/// The thread that answers requests, while it waits for its task.
pub(crate) struct Ros2Daemon {
    begin: oneshot::Sender<Task>,
    ended: oneshot::Receiver<Result<()>>,
}

/// Input of the thread.
pub(crate) struct Task {
    /// State of the robot.
    pub(crate) latest: Arc<SnapshotCell>,
    /// Watches, whose domains have ports.
    pub(crate) watches: Arc<Watches>,
    /// Counters and port states.
    pub(crate) figures: Arc<Ros2DaemonFigures>,
    /// Distribution of clients, if it is configured.
    pub(crate) distro: Option<Dialect>,
    /// Notified after a reload of the configuration.
    pub(crate) reloaded: Arc<Notify>,
    /// Ends the thread.
    pub(crate) stop: CancellationToken,
}

/// A request to release the port of a domain.
#[derive(Debug)]
struct Release {
    domain_id: u32,
    /// Notified once the port is closed.
    done: oneshot::Sender<()>,
}

impl Ros2Daemon {
    /// Starts the thread, already confined to its role.
    pub(crate) fn start() -> Result<Self, SpawnError> {
        let (begin, begins) = oneshot::channel::<Task>();
        let (report, ended) = oneshot::channel();
        let thread = std::thread::Builder::new().name("ros2-daemon".to_owned());
        privilege::spawn(Role::Ros2Daemon, thread, move || {
            // If the agent fails to start, no task arrives.
            if let Ok(task) = begins.blocking_recv() {
                let _ = report.send(task.run());
            }
        })?;
        Ok(Self { begin, ended })
    }

    /// Begins to answer requests. The returned channel reports the end of the thread.
    pub(crate) fn begin(self, task: Task) -> oneshot::Receiver<Result<()>> {
        // If the thread has died, the returned channel reports it.
        let _ = self.begin.send(task);
        self.ended
    }
}

impl Task {
    fn run(self) -> Result<()> {
        // Capabilities belong to threads, so the capabilities of this thread are verified as well.
        let _: Unprivileged = Unprivileged::verify()?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot start the runtime of the ros2 daemon")?;
        let tasks = tokio::task::LocalSet::new();
        runtime.block_on(tasks.run_until(self.serve()));
        Ok(())
    }

    /// Accepts connections until the agent stops.
    async fn serve(self) {
        let (releases, mut released) = mpsc::channel(Ros2DaemonClients::CAP);
        let requests = Arc::new(Requests::new(&self, releases));
        let mut ports = Ports::new(Arc::clone(&self.figures));
        let mut connections = Connections::default();
        let mut tasks: JoinSet<Arc<ConnectionState>> = JoinSet::new();
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = self.stop.cancelled() => break,
                _ = ticks.tick() => ports.update(&self.domains(), Instant::now()),
                () = self.reloaded.notified() => {
                    ports.end_releases();
                    ports.update(&self.domains(), Instant::now());
                }
                Some(release) = released.recv() => {
                    let end = ports.release(release.domain_id, Instant::now());
                    if let Some(end) = end {
                        tokio::task::spawn_local(async move {
                            sleep(LAST_ANSWERS).await;
                            end.cancel();
                        });
                    }
                    // The client may have disconnected.
                    let _ = release.done.send(());
                }
                Some(ended) = tasks.join_next() => {
                    if let Ok(state) = ended {
                        connections.leave(&state);
                    }
                }
                accepted = ports.accept() => {
                    let state = Arc::new(ConnectionState::new(accepted.end.child_token()));
                    if !accepted.address.ip().is_loopback() || !connections.join(&state) {
                        self.figures.count_refusal(Refused::Full);
                        drop(Stream::new(accepted.stream, &state));
                        continue;
                    }
                    let requests = Arc::clone(&requests);
                    tasks.spawn_local(serve(accepted, state, requests));
                }
            }
        }
    }

    /// Returns the domains with a port: the domains of participants and watches, and domain 0.
    fn domains(&self) -> BTreeSet<u32> {
        let state = self.latest.state();
        let seen = state.known().participants.iter();
        let seen = seen.map(|participant| participant.domain_id.0);
        let in_force = self.watches.active();
        let watched = in_force.watchlist().watches().iter();
        let watched = watched.filter_map(|watch| Some(watch.domain_id?.0));
        let domains = [0].into_iter().chain(watched).chain(seen);
        domains
            .filter(|domain_id| port(*domain_id).is_some())
            .collect()
    }
}

/// Serves a connection, and returns its state at the end.
async fn serve(
    accepted: Accepted,
    state: Arc<ConnectionState>,
    requests: Arc<Requests>,
) -> Arc<ConnectionState> {
    let _counted = requests.join();
    let stream = Stream::new(accepted.stream, &state);
    tokio::select! {
        () = requests.serve(stream, (accepted.domain_id, accepted.address), &state) => {}
        () = state.ended() => {}
    }
    state
}
