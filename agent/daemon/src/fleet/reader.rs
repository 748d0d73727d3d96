//! The last answers of an engine and a store, and the queries for them while clients ask.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use ros2probe_api::fleet::{Comparison, Fleet, FleetAnswer, Incidents, Robot};
use ros2probe_capture::error_chain::in_words;
use ros2probe_metrics::export_thread::{ExportThread, Spawn};
use tokio::runtime::Builder;
use tokio::sync::Notify;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use super::engine::Engine;
use super::incidents::IncidentReader;
use super::link::Link;
use super::robot::{Question, read};

/// Pause between two readings of the engine.
pub const POLL_INTERVAL: Duration = Duration::from_secs(10);
/// Time after a request in which the engine is read.
const DEMAND_LIFETIME: Duration = Duration::from_secs(30);

/// Pause between two readings of the store: a listing of a large one takes many requests.
const STORE_INTERVAL: Duration = Duration::from_mins(1);

/// Reads an engine, and a store of bags, on demand.
#[derive(Debug, Default)]
pub struct Reader {
    known: Mutex<Known>,
    engine_asked: Notify,
    store_asked: Notify,
    link: Option<Link>,
    has_store: bool,
}

/// Where a fleet is read.
#[derive(Debug)]
pub struct Sources {
    /// The engine.
    pub engine: Engine,
    /// The robots.
    pub question: Question,
    /// The store of their bags.
    pub incidents: Option<IncidentReader>,
}

/// What the engine answered last.
#[derive(Clone, Debug, Default)]
pub struct Known {
    /// The fleet and when it was read; `None` before the first answer.
    pub fleet: Option<(Arc<Fleet>, Timestamp)>,
    /// Why the last request failed.
    pub problem: Option<Arc<str>>,
    /// Incidents of the robots; `None` without a store.
    pub incidents: Option<Arc<Incidents>>,
    asked: Option<Instant>,
}

impl Reader {
    /// Creates a reader of these sources. With `link`, robots have the addresses of their pages.
    #[must_use]
    pub fn new(link: Option<Link>, sources: &Sources) -> Self {
        Self {
            link,
            has_store: sources.incidents.is_some(),
            ..Self::default()
        }
    }

    /// Returns what is known, and lets the sources be read.
    pub fn ask(&self) -> Known {
        let mut known = self.known();
        let asked = known.asked.replace(Instant::now());
        if asked.is_some_and(|asked| asked.elapsed() >= DEMAND_LIFETIME) {
            // The sources were not read since then.
            (known.fleet, known.problem, known.incidents) = (None, None, None);
        }
        if self.has_store {
            known.incidents.get_or_insert_default();
        }
        self.engine_asked.notify_one();
        self.store_asked.notify_one();
        known.clone()
    }

    /// Reads the sources while clients ask for the fleet. Never returns.
    pub async fn poll(&self, sources: Sources) {
        let engine = self.poll_engine(&sources.engine, &sources.question);
        let Some(incidents) = sources.incidents else {
            return engine.await;
        };
        tokio::join!(engine, self.poll_store(incidents));
    }

    /// Reads the store while clients ask for the fleet. Never returns.
    async fn poll_store(&self, mut reader: IncidentReader) {
        loop {
            while !self.is_wanted() {
                self.store_asked.notified().await;
            }
            let show = |found| self.known().incidents = Some(Arc::new(found));
            let pause = match reader.read(None, show).await {
                Ok(()) => STORE_INTERVAL,
                Err(error) => {
                    // The last known ones stay visible.
                    let mut known = self.known();
                    let incidents = known.incidents.get_or_insert_default();
                    Arc::make_mut(incidents).problem = Some(in_words(&error));
                    POLL_INTERVAL
                }
            };
            sleep(pause).await;
        }
    }

    /// Queries the engine while clients ask for the fleet. Never returns.
    async fn poll_engine(&self, engine: &Engine, question: &Question) {
        loop {
            while !self.is_wanted() {
                self.engine_asked.notified().await;
            }
            let answer = read(engine, question).await;
            {
                let mut known = self.known();
                match answer {
                    Ok(mut fleet) => {
                        for robot in &mut fleet.robots {
                            robot.page = self.link.as_ref().map(|link| link.of(&robot.name));
                        }
                        known.fleet = Some((Arc::new(fleet), Timestamp::now()));
                        known.problem = None;
                    }
                    Err(error) => known.problem = Some(in_words(&error).into()),
                }
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Returns whether a client asked lately.
    fn is_wanted(&self) -> bool {
        let asked = self.known().asked;
        asked.is_some_and(|asked| asked.elapsed() < DEMAND_LIFETIME)
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Known {
    /// Returns the answer of the API.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "milliseconds are exact for ages"
    )]
    pub fn answer(&self) -> FleetAnswer {
        let fleet = self.fleet.as_ref();
        FleetAnswer {
            at: fleet.map(|(_, at)| at.as_millisecond() as f64 / 1_000.0),
            problem: self.problem.as_deref().map(str::to_owned),
            robots: fleet.map_or_else(Vec::<Robot>::new, |(fleet, _)| fleet.robots.clone()),
            comparison: fleet.map_or_else(Comparison::default, |(fleet, _)| fleet.comparison),
            incidents: self.incidents.as_deref().cloned(),
        }
    }
}

/// Starts a thread that reads the sources on demand.
pub(super) fn start(
    reader: Arc<Reader>,
    sources: Sources,
    spawn: Spawn,
) -> io::Result<ExportThread> {
    // Blocking threads resolve the names of engine and store, or read a folder.
    let runtime = Builder::new_current_thread()
        .max_blocking_threads(2)
        .enable_all()
        .build()?;
    let stop = CancellationToken::new();
    let stopped = stop.clone();
    ExportThread::start("fleet", stop, spawn, move || {
        runtime.block_on(async {
            tokio::select! {
                () = reader.poll(sources) => {}
                () = stopped.cancelled() => {}
            }
        });
        // A pending name resolution must not delay the end.
        runtime.shutdown_background();
    })
}
