//! The agent's library inside a test: it exposes each loss, while the agent's metrics have only
//! sums. It works as the agent does, and observes sockets of the whole machine unless a cgroup is
//! configured.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use ros2probe_capture::live::LiveSource;
use ros2probe_capture::netns;
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::config::{Config, Watchlist};
use ros2probe_model::facts::loss::{DeliveryLoss, Loss};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{self, Observer};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::Timestamp;
use ros2probe_wire::filter::Counter;

use super::bpf;
use super::network::Namespace;

const SLICE: Duration = Duration::from_millis(100);
/// Nanoseconds after which every cause is settled: longer than the kernel waits for IP fragments.
const UNTIL_ALL_IS_SETTLED: u64 = 60_000_000_000;

pub struct Witness {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<Result<WitnessReport>>>,
}

/// State of the witness at the end.
pub struct WitnessReport {
    /// Snapshot after the peers left and all open samples were settled.
    pub end: Snapshot,
    pub losses: Vec<Loss>,
    pub delivery_losses: Vec<DeliveryLoss>,
    /// The kernel programs' own counters.
    pub counters: Vec<(Counter, u64)>,
    /// Runs of the programs that the kernel skipped.
    pub skipped_runs: u64,
}

impl WitnessReport {
    /// Fails if the kernel programs had to omit records.
    pub fn ensure_complete(&self) -> Result<()> {
        for (counter, value) in &self.counters {
            let blind = ["records_lost", "contended"].contains(&counter.label());
            ensure!(!blind || *value == 0, "{}: {value}", counter.label());
        }
        Ok(())
    }

    /// Returns the counters that are not zero, for the message of a failed test.
    #[must_use]
    pub fn counted(&self) -> String {
        let counters = self.counters.iter().filter(|(_, count)| *count > 0);
        let counters = counters.map(|(counter, count)| format!(" {} {count}", counter.label()));
        counters.collect()
    }
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    latest: Mutex<Option<Arc<Snapshot>>>,
}

impl Witness {
    /// Starts a witness, and returns once it observes all traffic.
    pub fn start(configuration: &str) -> Result<Witness> {
        Witness::start_in(None, configuration)
    }

    /// Starts as [`Witness::start`] does, on a host's network.
    pub fn start_on(host: &Namespace, configuration: &str) -> Result<Witness> {
        let network = host.network();
        Witness::start_in(Some(network), configuration)
    }

    fn start_in(network: Option<PathBuf>, configuration: &str) -> Result<Witness> {
        let config = Config::parse(configuration.as_bytes())
            .map_err(|mistakes| anyhow!("{}", mistakes.report("the witness")))?;
        let shared = Arc::new(Shared::default());
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("witness".to_owned())
            .spawn(move || watch(network.as_deref(), &config, &theirs))?;
        let mut witness = Witness {
            shared,
            thread: Some(thread),
        };
        let deadline = Instant::now() + Duration::from_secs(60);
        while witness.latest().is_none() {
            if witness.thread.as_ref().is_none_or(JoinHandle::is_finished) {
                witness.finish()?;
                bail!("the witness ended before it began");
            }
            if Instant::now() > deadline {
                bail!("the witness does not begin");
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(witness)
    }

    pub fn latest(&self) -> Option<Arc<Snapshot>> {
        let latest = self.shared.latest.lock();
        latest.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits until `question` returns `Some` for the current state.
    pub fn wait_for<T>(
        &self,
        what: &str,
        limit: Duration,
        mut question: impl FnMut(&Snapshot) -> Option<T>,
    ) -> Result<T> {
        let deadline = Instant::now() + limit;
        loop {
            let latest = self.latest().context("the witness has not begun")?;
            if let Some(answer) = question(&latest) {
                return Ok(answer);
            }
            if Instant::now() > deadline {
                bail!("the witness does not see {what} within {limit:?}");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Reads the remaining records of the kernel, and settles all samples.
    pub fn finish(&mut self) -> Result<WitnessReport> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let thread = self.thread.take().context("the witness has ended")?;
        thread
            .join()
            .map_err(|_| anyhow!("the witness panicked"))?
            .context("the witness")
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn watch(network: Option<&Path>, config: &Config, shared: &Shared) -> Result<WitnessReport> {
    let open = || LiveSource::open(&config.capture, Limits::default());
    let mut source = match network {
        Some(network) => netns::within(network, open)??,
        None => open()?,
    };
    source.start(ros2probe_daemon::privilege::spawn_source);
    let mut observer = Observer::new(observer::Settings::default());
    observer.input(Input::Watchlist(Arc::new(Watchlist::new(
        config.watches.clone(),
    )?)));
    let publish = |snapshot: Snapshot| {
        let mut latest = shared.latest.lock().unwrap_or_else(PoisonError::into_inner);
        *latest = Some(Arc::new(snapshot));
    };
    while !shared.stop.load(Ordering::Relaxed) {
        publish(observer.snapshot(source.clock()));
        source.poll(SLICE, None, &mut observer)?;
        observer.input(Input::Time(source.clock()));
        source.apply(&observer.drain().interest);
    }
    source.drain(&mut observer);
    let counters = source.counters()?;
    let skipped_runs = bpf::skipped_runs()?;
    let end = Timestamp(source.clock().0.saturating_add(UNTIL_ALL_IS_SETTLED));
    observer.input(Input::Time(end));
    observer.input(Input::End);
    Ok(WitnessReport {
        end: observer.snapshot(end),
        losses: observer.journal().losses().copied().collect(),
        delivery_losses: observer.journal().delivery_losses().copied().collect(),
        counters,
        skipped_runs,
    })
}
