//! What happens inside ROS processes, whatever their middleware: messages, also those that never
//! leave a process, and callbacks.
//!
//! Opt-in, because it puts breakpoints into code of other processes, which cost them some
//! microseconds each. The kernel programs aggregate; a thread with the privileges reads their
//! tables once a second, resolves names, and leaves a report for the model. It changes nothing in
//! the processes and never waits for them.

pub mod names;
pub mod process;
pub mod programs;
pub mod table;

use std::collections::HashSet;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe_model::bounded::Bounded;
use ros2probe_wire::inside::Counter;

use self::process::ReadMemory;
use self::programs::{Attached, Programs, Tables};
use self::table::{ProcessTable, Round};
use crate::breakpoints::Means;
use crate::error_chain::in_words;
use crate::filter::FilterError;
use crate::mappings::{MappingEvents, UNCONCERNED};
use crate::memory_reader::MemoryReader;
use crate::settings::InsideChoice;
use crate::shm::directories::Scope;
use crate::system::{Clocks, wait};
use crate::tables::WaitingRounds;
use crate::threads::{Progress, Spawn, Task};
use crate::uprobe::attachments::{Attachments, LibraryFacts, Refusal, installed};
use crate::uprobe::processes::{Processes, is_version_of};
use crate::uprobe::{self, UprobeError};

/// Interval of reports.
const EVERY: Duration = Duration::from_secs(1);
/// How long to collect announcements before they are read.
const GATHER: Duration = Duration::from_millis(250);
/// Calls per second of all processes above which the programs are detached.
pub const MAX_HITS: u64 = 200_000;
/// Time for which they then stay detached.
const PAUSE: Duration = Duration::from_secs(60);
/// Name of the library; a version may follow.
const LIBRARY: &str = "libtracetools.so";

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
    /// Libraries in use.
    pub libraries: Vec<LibraryFacts>,
    /// Whether the processes that ran before this source have been inspected.
    pub has_inspected: bool,
    /// Why nothing is attached at present; `None` = the libraries in use are.
    pub detached: Option<String>,
    /// Counters of the programs.
    pub counters: Vec<(&'static str, u64)>,
}

struct Shared {
    rounds: Mutex<Bounded<WaitingRounds, Vec<Round>>>,
    facts: Mutex<Facts>,
    progress: Arc<Progress>,
    stop: AtomicBool,
}

struct Work {
    attachments: Attachments<Attached>,
    tables: Tables,
    scope: Scope,
    has_callbacks: bool,
    read: ReadMemory,
}

impl Inside {
    /// Loads the programs, and attaches them to installed libraries. `cgroup`: only for processes of
    /// this control group.
    ///
    /// # Errors
    /// Fails if a capability is missing, or if the kernel has no uprobes.
    pub fn open(choice: InsideChoice, cgroup: Option<&Path>) -> Result<Self, UprobeError> {
        let missing = uprobe::missing();
        if !missing.is_empty() {
            return Err(UprobeError::Missing(missing.join(" and ")));
        }
        let within = cgroup.map(uprobe::inode).transpose()?;
        let has_callbacks = choice == InsideChoice::Full;
        let loaded = programs::load(has_callbacks, within, Means::of_this_kernel());
        let (programs, mut tables) = loaded.map_err(|error| match error {
            FilterError::Program(_) if within.is_some() => UprobeError::InsideScope(error),
            error => error.into(),
        })?;
        set_clocks(&mut tables, &Clocks::read());
        let progress = Arc::new(Progress::default());
        let mut attachments = attachments(programs, Arc::clone(&progress));
        // A node announces its publishers once: installed libraries are attached in advance.
        attachments.install(&installed(is_library), Instant::now());
        progress.rest();
        let scope = cgroup.map_or(Scope::AllProcesses, |path| {
            Scope::Cgroup(path.to_path_buf())
        });
        let facts = Facts {
            has_callbacks,
            ..Facts::default()
        };
        Ok(Self {
            shared: Arc::new(Shared {
                rounds: Mutex::default(),
                facts: Mutex::new(facts),
                progress,
                stop: AtomicBool::new(false),
            }),
            waiting: Some(Work {
                attachments,
                tables,
                scope,
                has_callbacks,
                read: memory(),
            }),
        })
    }

    /// Starts the thread, once, with only the privileges that it needs.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        let Some(work) = self.waiting.take() else {
            return Ok(());
        };
        let thread = std::thread::Builder::new().name("inside".to_owned());
        let shared = Arc::clone(&self.shared);
        let work = Box::new(move || follow(&shared, work));
        spawn(Task::Inside, thread, work).map(drop)
    }

    /// Takes the rounds since the last call, oldest first.
    #[must_use]
    pub fn take(&self) -> Vec<Round> {
        let rounds = self.shared.rounds.lock();
        let mut rounds = rounds.unwrap_or_else(PoisonError::into_inner);
        rounds.take()
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
    /// Returns whether the model has not taken earlier reports. Figures are cumulative, so a round
    /// that is left out loses nothing.
    fn is_late(&self) -> bool {
        let rounds = self.rounds.lock();
        rounds.unwrap_or_else(PoisonError::into_inner).is_full()
    }

    fn put(&self, round: Round) {
        let rounds = self.rounds.lock();
        let mut rounds = rounds.unwrap_or_else(PoisonError::into_inner);
        rounds.push(round);
    }

    fn facts(&self) -> MutexGuard<'_, Facts> {
        self.facts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn report(&self, facts: Facts) {
        *self.facts() = facts;
    }
}

/// The thread's main function.
fn follow(shared: &Shared, mut work: Work) {
    let mut processes = Processes::new(work.scope.clone(), is_library);
    let mut table = ProcessTable::new(work.has_callbacks, work.read);
    let mut mappings = MappingEvents::open_or_warn("capture.inside");
    let mut detached_at = None::<Instant>;
    let mut last = Instant::now();
    while !shared.stop.load(Ordering::Acquire) {
        shared.progress.step();
        let now = Instant::now();
        if detached_at.is_some_and(|at| now - at >= PAUSE) {
            detached_at = None;
            work.attachments.install(&installed(is_library), now);
            tracing::info!("attached again inside processes");
        }
        processes.find(false);
        if detached_at.is_none() {
            work.attachments.follow(&processes, now);
        }
        let clocks = Clocks::read();
        set_clocks(&mut work.tables, &clocks);
        if !shared.is_late() {
            let elapsed = last.elapsed();
            last += elapsed;
            let showing = showing_intra_process(&processes, &work.attachments);
            let round = table.round(&mut work.tables, &clocks, elapsed, |process| {
                showing.contains(&process)
            });
            let hits = round.hits;
            shared.put(round);
            if detached_at.is_none() && hits > MAX_HITS {
                tracing::warn!(
                    calls_per_second = hits,
                    "detached inside processes for a minute: together they exceed the budget"
                );
                work.attachments.clear();
                detached_at = Some(now);
            }
        }
        shared.report(Facts {
            has_callbacks: work.has_callbacks,
            has_inspected: true,
            libraries: work.attachments.facts(),
            detached: detached_at.map(|_| {
                format!("all processes together made more than {MAX_HITS} calls per second")
            }),
            counters: counters(&work.tables),
        });
        let end = now + EVERY;
        // Announcements are read in between: their ring could overflow before the next round.
        let mut gathers_until = now;
        while let Some(event) = next_event(&mappings, &work.tables, gathers_until, end) {
            if event == Event::Announced {
                table.drain(&mut work.tables, &Clocks::read());
                gathers_until = Instant::now() + GATHER;
                continue;
            }
            let new = mappings.as_mut().map(|mappings| mappings.take(is_library));
            let new = new.unwrap_or_default();
            if new.is_incomplete {
                processes.find(true);
            } else if new.processes.is_empty() {
                std::thread::sleep(UNCONCERNED);
                continue;
            }
            processes.inspect(&new.processes);
            if detached_at.is_none() {
                work.attachments.follow(&processes, Instant::now());
            }
        }
    }
    shared.progress.rest();
}

/// What ends a wait between two rounds.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Event {
    /// A process mapped a file.
    Mapped,
    /// Many announcements wait.
    Announced,
}

/// Waits until `end` for the next event, for announcements only from `gathers_until` on; returns
/// `None` at the end.
fn next_event(
    mappings: &Option<MappingEvents>,
    tables: &Tables,
    gathers_until: Instant,
    end: Instant,
) -> Option<Event> {
    loop {
        let now = Instant::now();
        let is_gathering = now < gathers_until;
        let until = if is_gathering {
            end.min(gathers_until)
        } else {
            end
        };
        let timeout = until.saturating_duration_since(now);
        if timeout.is_zero() {
            return None;
        }
        let announced = (!is_gathering).then(|| tables.descriptor());
        let mapped = mappings.iter().flat_map(MappingEvents::descriptors);
        let descriptors: Vec<_> = announced.into_iter().chain(mapped).collect();
        match wait(&descriptors, timeout) {
            Ok(Some(0)) if !is_gathering => return Some(Event::Announced),
            Ok(Some(_)) => return Some(Event::Mapped),
            Ok(None) if is_gathering => {}
            Ok(None) | Err(_) => return None,
        }
    }
}

/// Returns attachments of the functions of `libtracetools.so`.
fn attachments(mut programs: Programs, progress: Arc<Progress>) -> Attachments<Attached> {
    Attachments::new(
        "calls are observed",
        Box::new(move |file| {
            progress.step();
            let attached = programs.attach(file);
            attached.map_err(|error| Refusal::Probe(error.into()))
        }),
    )
}

/// Returns the processes whose library reports every step of messages within them.
fn showing_intra_process(
    processes: &Processes,
    attachments: &Attachments<Attached>,
) -> HashSet<u32> {
    let attached = |id| attachments.probe(id)?.as_ref().ok();
    let shows = |id| attached(id).is_some_and(|attached| attached.shows_intra_process);
    let using = processes.using();
    let showing = using.filter(|(_, used)| used.libraries.iter().any(|library| shows(&library.id)));
    showing.map(|(process, _)| process).collect()
}

/// Starts the process that reads memory of observed processes.
fn memory() -> ReadMemory {
    match MemoryReader::start() {
        Ok(mut reader) => {
            Box::new(move |process, address, length| reader.read(process, address, length))
        }
        Err(error) => {
            tracing::warn!(%error, "the domains of observed processes are taken for 0");
            Box::new(|_, _, _| None)
        }
    }
}

fn set_clocks(tables: &mut Tables, clocks: &Clocks) {
    if let Err(error) = tables.set_clocks(clocks) {
        let reason = in_words(&error);
        tracing::debug!(
            reason,
            "latencies inside processes use an older clock reading"
        );
    }
}

fn counters(tables: &Tables) -> Vec<(&'static str, u64)> {
    let values = tables.counters().unwrap_or_default();
    let labels = Counter::ALL.iter().map(|counter| counter.label());
    labels.zip(values).collect()
}

/// Returns whether a file of this name is the library.
fn is_library(name: &str) -> bool {
    is_version_of(LIBRARY, name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;
    use ros2probe_model::inside::report::Report;

    #[test]
    fn reports_beyond_those_that_may_wait_are_left_out() {
        let shared = Shared {
            rounds: Mutex::default(),
            facts: Mutex::default(),
            progress: Arc::default(),
            stop: AtomicBool::new(false),
        };
        for _ in 0..10 {
            shared.put(Round {
                report: Report::default(),
                publications: Vec::new(),
                hits: 0,
            });
        }
        assert!(shared.is_late());
        assert_driven::<WaitingRounds>();
    }
}
