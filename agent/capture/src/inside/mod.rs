//! Observes messages and callbacks inside ROS processes, with any middleware. This includes
//! messages that never leave a process.
//!
//! The source puts breakpoints into the code of other processes, which costs them some microseconds
//! for each call. By default, breakpoints for each message or callback exist only while a client
//! needs calls. Breakpoints at the creation of nodes and endpoints stay. The kernel programs
//! aggregate. A thread reads their tables once a second, resolves names, and leaves a report for
//! the model. Apart from the breakpoints, it changes nothing in the processes, and it never waits
//! for them.

pub mod cpu_limits;
pub mod late;
pub mod names;
mod observation;
pub mod process;
pub mod programs;
pub mod table;

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe_attach::client::Broker;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::Timestamp;

use self::late::{LateDemand, LateObservation};
use self::observation::Probes;
use self::programs::Tables;
use self::table::Round;
use crate::bell::Bell;
use crate::breakpoints::AttachMethod;
use crate::container::has_own_processes;
use crate::filter::{Deliveries, FilterError};
use crate::settings::{InsideChoice, LateChoice};
use crate::shm::directories::Scope;
use crate::system::Clocks;
use crate::tables::WaitingRounds;
use crate::threads::{Progress, Spawn, Task};
use crate::uprobe::attachments::LibraryFacts;
use crate::uprobe::{self, UprobeError};

/// Maximum calls per second of all processes. Above it, the programs are detached.
pub const MAX_HITS: u64 = 200_000;

/// The kernel programs, and the thread that attaches and reads them.
pub struct Inside {
    shared: Arc<Shared>,
    /// State passed to the thread when it starts.
    waiting: Option<Work>,
}

/// State of the source.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Facts {
    /// Whether callbacks are observed, and not only messages.
    pub has_callbacks: bool,
    /// Whether calls are observed only while a client needs them.
    pub is_on_demand: bool,
    /// Libraries in use.
    pub libraries: Vec<LibraryFacts>,
    /// Whether the processes that ran before this source have been inspected.
    pub has_inspected: bool,
    /// Why nothing is attached at present; `None` = the libraries in use have probes.
    pub detached: Option<String>,
    /// Whether calls are observed on demand, and no client needs them.
    pub is_idle: bool,
    /// Whether calls have been observed for long enough to show rates.
    pub shows_rates: bool,
    /// What is observed about late calls: `off`, `sums` or `events`.
    pub late: &'static str,
    /// Why the scheduler's events are not observed when they are needed.
    pub without_events: Option<String>,
    /// Why deliveries of messages are not followed although they are needed.
    pub without_deliveries: Option<String>,
    /// Counters of the programs.
    pub counters: Vec<(&'static str, u64)>,
}

struct Shared {
    rounds: Mutex<Bounded<WaitingRounds, Vec<Round>>>,
    facts: Mutex<Facts>,
    /// Whether a client needs calls, if they are observed on demand.
    wanted: AtomicBool,
    /// What clients want to know about late calls.
    late: Mutex<LateDemand>,
    /// Rings when `wanted` changes. Without the bell, the thread notices a change within a second.
    bell: Option<Bell>,
    progress: Arc<Progress>,
    stop: AtomicBool,
}

struct Work {
    probes: Probes,
    tables: Tables,
    scope: Scope,
    has_callbacks: bool,
    late: LateObservation,
    broker: Broker,
}

impl Inside {
    /// Loads the programs, and attaches them to installed libraries. `cgroup` restricts them to
    /// processes of this control group. `deliveries` are programs of the host hook, with its
    /// control group.
    ///
    /// # Errors
    /// Fails if a capability is missing, if the kernel has no uprobes, or if this process has a PID
    /// namespace of its own.
    pub fn open(
        (choice, late): (InsideChoice, LateChoice),
        cgroup: Option<&Path>,
        broker: &Path,
        deliveries: Option<(Deliveries, File)>,
    ) -> Result<Self, UprobeError> {
        // Every observed process would seem to have ended, or would have another one's name.
        if has_own_processes() {
            return Err(UprobeError::OwnProcesses);
        }
        let mut broker = uprobe::broker(broker)?;
        let within = cgroup.map(uprobe::inode).transpose()?;
        let has_callbacks = matches!(choice, InsideChoice::Full | InsideChoice::Auto);
        let loaded = programs::load(has_callbacks, within, AttachMethod::of_this_kernel());
        let (programs, mut tables) = loaded.map_err(|error| match error {
            FilterError::Program(_) if within.is_some() => UprobeError::InsideScope(error),
            error => error.into(),
        })?;
        // The thread repeats this call every round, and logs its errors.
        let _ = tables.set_clocks(&Clocks::read());
        let progress = Arc::new(Progress::default());
        let is_on_demand = choice == InsideChoice::Auto;
        let programs = Arc::new(programs);
        let late = LateObservation::new(Arc::clone(&programs), late, deliveries);
        let mut probes = Probes::new(&programs, is_on_demand, &progress);
        // A node announces its publishers only once, so the probes are attached to installed
        // libraries in advance.
        probes.install(true, Instant::now(), &mut broker);
        progress.set_idle();
        let scope = cgroup.map_or(Scope::AllProcesses, |path| {
            Scope::Cgroup(path.to_path_buf())
        });
        let facts = Facts {
            has_callbacks,
            is_on_demand,
            is_idle: is_on_demand,
            ..Facts::default()
        };
        Ok(Self {
            shared: Arc::new(Shared {
                rounds: Mutex::default(),
                facts: Mutex::new(facts),
                wanted: AtomicBool::new(!is_on_demand),
                late: Mutex::default(),
                bell: Bell::new().ok(),
                progress,
                stop: AtomicBool::new(false),
            }),
            waiting: Some(Work {
                probes,
                tables,
                scope,
                has_callbacks,
                late,
                broker,
            }),
        })
    }

    /// Starts the thread with only the privileges that it needs. Later calls have no effect.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        let Some(work) = self.waiting.take() else {
            return Ok(());
        };
        let thread = std::thread::Builder::new().name("inside".to_owned());
        let shared = Arc::clone(&self.shared);
        let work = Box::new(move || observation::follow(&shared, work));
        spawn(Task::Inside, thread, work).map(drop)
    }

    /// Takes the rounds that have not been taken, up to the time `until`, oldest first.
    #[must_use]
    pub fn take(&self, until: Timestamp) -> Vec<Round> {
        let rounds = self.shared.rounds.lock();
        let mut rounds = rounds.unwrap_or_else(PoisonError::into_inner);
        let mut due = rounds.take();
        let number = due.iter().take_while(|round| round.report.at <= until);
        for later in due.split_off(number.count()) {
            rounds.push(later);
        }
        due
    }

    /// Sets whether a client needs calls. The setting matters only if calls are observed on demand.
    pub fn set_calls_requested(&self, wanted: bool) {
        let shared = &self.shared;
        let is_on_demand = shared.facts().is_on_demand;
        if is_on_demand && shared.wanted.swap(wanted, Ordering::AcqRel) != wanted {
            shared.bell.iter().for_each(Bell::ring);
        }
    }

    /// Sets what clients want to know about late calls.
    pub fn set_late_demand(&self, demand: &LateDemand) {
        let mut known = self.shared.late();
        if *known != *demand {
            let is_first = demand.has_question && !known.has_question;
            known.clone_from(demand);
            if is_first {
                self.shared.bell.iter().for_each(Bell::ring);
            }
        }
    }

    /// Returns the state of the source.
    #[must_use]
    pub fn facts(&self) -> Facts {
        self.shared.facts().clone()
    }

    /// Returns for how long the thread has made no progress; `None` if it makes progress.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.shared.progress.stalled()
    }
}

impl Drop for Inside {
    /// Lets the thread end within a second. A shutdown does not wait for it: the kernel removes the
    /// probes with the process.
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
    }
}

impl Shared {
    fn is_wanted(&self) -> bool {
        self.wanted.load(Ordering::Acquire)
    }

    /// Returns whether earlier reports still wait for the model. Figures are cumulative, so
    /// skipping a round loses nothing.
    fn is_late(&self) -> bool {
        let rounds = self.rounds.lock();
        rounds.unwrap_or_else(PoisonError::into_inner).is_full()
    }

    fn store_round(&self, round: Round) {
        let rounds = self.rounds.lock();
        let mut rounds = rounds.unwrap_or_else(PoisonError::into_inner);
        rounds.push(round);
    }

    fn late(&self) -> MutexGuard<'_, LateDemand> {
        self.late.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn facts(&self) -> MutexGuard<'_, Facts> {
        self.facts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn report(&self, facts: Facts) {
        *self.facts() = facts;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;
    use ros2probe_model::facts::calls::report::Report;

    #[test]
    fn reports_beyond_the_cap_of_waiting_reports_are_dropped() {
        let shared = Shared {
            rounds: Mutex::default(),
            facts: Mutex::default(),
            progress: Arc::default(),
            wanted: AtomicBool::new(true),
            late: Mutex::default(),
            bell: None,
            stop: AtomicBool::new(false),
        };
        for _ in 0..10 {
            shared.store_round(Round {
                report: Report::default(),
                publications: Vec::new(),
                hits: 0,
                is_last: false,
            });
        }
        assert!(shared.is_late());
        assert_driven::<WaitingRounds>();
    }
}
