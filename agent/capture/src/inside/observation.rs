//! The thread that lets the broker attach the programs, and reads their tables.

use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use ros2probe_attach::client::{Broker, BrokerError};
use ros2probe_attach::functions::{Calls, Library};
use ros2probe_wire::inside::{Counter, PROCESS_CAPACITY};

use super::late::LateObservation;
use super::programs::{Attached, Programs, Tables};
use super::table::ProcessTable;
use super::{Facts, MAX_HITS, Shared, Work};
use crate::bell::Bell;
use crate::error_chain::{Reason, in_words};
use crate::mappings::{MappingEvents, NewMappings, UNRELATED_DELAY};
use crate::system::{Clocks, wait};
use crate::threads::Progress;
use crate::uprobe::attachments::{Attachments, LibraryFacts, RETRY_DELAY};
use crate::uprobe::processes::Processes;

/// Interval of reports.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// Time for which announcements accumulate before they are read.
const ANNOUNCEMENT_DELAY: Duration = Duration::from_millis(250);
/// Time for which the programs stay detached after all calls exceeded their budget.
const SUSPENSION_TIME: Duration = Duration::from_secs(60);
/// Intervals between checks for ended processes while no calls are observed. Each check needs the
/// broker, which otherwise ends.
const REVIEW_INTERVAL: Duration = Duration::from_secs(600);
const SHORT_REVIEW_INTERVAL: Duration = Duration::from_secs(60);
/// Number of known processes for the shorter interval: half of those that the programs can have.
const MANY_PROCESSES: usize = PROCESS_CAPACITY as usize / 2;
/// Number of rounds after which rates are known: two reports that each cover a second of calls.
const RATE_ROUNDS: u32 = 3;

/// The breakpoints in all libraries.
pub(super) struct Probes {
    /// Probes that stay: at all functions, or only at functions of initialization.
    lasting: Attachments<Attached>,
    /// Probes at functions of runtime, if calls are observed on demand.
    on_demand: Option<Attachments<Attached>>,
}

impl Probes {
    /// Creates probes that are attached to no library.
    pub(super) fn new(
        programs: &Arc<Programs>,
        is_on_demand: bool,
        progress: &Arc<Progress>,
    ) -> Self {
        let at = |meaning, part| {
            let (programs, progress) = (Arc::clone(programs), Arc::clone(progress));
            Attachments::new(
                meaning,
                Box::new(move |broker, place| {
                    progress.step();
                    programs.attach(broker, part, place)
                }),
            )
        };
        if !is_on_demand {
            return Self {
                lasting: at("calls are observed", None),
                on_demand: None,
            };
        }
        let creation = "the creation of nodes and endpoints is observed";
        Self {
            lasting: at(creation, Some(Calls::Initialization)),
            on_demand: Some(at("calls are observed", Some(Calls::Runtime))),
        }
    }

    /// Attaches the lasting probes to installed libraries. Without `to_calls`, they stay detached if
    /// they are also at calls.
    pub(super) fn install(&mut self, to_calls: bool, now: Instant, broker: &mut Broker) {
        if self.needs_lasting(to_calls) {
            self.lasting.install(Library::Tracing, now, broker);
        }
    }

    /// Detaches from libraries whose files have changed. Returns whether a probe was detached, or
    /// waits for its installed library.
    fn detach_changed(&mut self, now: Instant) -> bool {
        let all = [Some(&mut self.lasting), self.on_demand.as_mut()];
        let all = all.into_iter().flatten();
        let changed = all.filter_map(|probes| probes.detach_changed(now).then_some(()));
        let is_any = changed.count() > 0;
        is_any || self.lasting.is_search_due(now)
    }

    /// Returns whether the lasting probes are attached, which are also at calls if none is on demand.
    const fn needs_lasting(&self, to_calls: bool) -> bool {
        to_calls || self.on_demand.is_some()
    }

    /// Attaches the lasting probes to the libraries in use, as [`Self::install`] does; with
    /// `to_calls`, also the on-demand probes.
    fn follow(&mut self, processes: &Processes, to_calls: bool, now: Instant, broker: &mut Broker) {
        if self.needs_lasting(to_calls) {
            self.lasting.follow(processes, now, broker);
        }
        if let Some(on_demand) = self.on_demand.as_mut().filter(|_| to_calls) {
            on_demand.install(Library::Tracing, now, broker);
            on_demand.follow(processes, now, broker);
        }
    }

    /// Detaches the probes at calls.
    fn detach(&mut self) {
        self.call_probes_mut().clear();
    }

    fn call_probes_mut(&mut self) -> &mut Attachments<Attached> {
        self.on_demand.as_mut().unwrap_or(&mut self.lasting)
    }

    /// Returns the probes at calls.
    fn call_probes(&self) -> &Attachments<Attached> {
        self.on_demand.as_ref().unwrap_or(&self.lasting)
    }

    /// Returns facts about the libraries in use.
    fn facts(&self, is_resting: bool) -> Vec<LibraryFacts> {
        match is_resting {
            true => self.lasting.facts(),
            false => self.call_probes().facts(),
        }
    }
}

/// The thread's main function.
pub(super) fn follow(shared: &Shared, work: Work) {
    let mut observation = Observation::new(work);
    while !shared.stop.load(Ordering::Acquire) {
        shared.progress.step();
        if observation.is_resting && !shared.is_wanted() {
            observation.wait_idle(shared);
        } else {
            observation.run_round(shared);
        }
    }
    shared.progress.set_idle();
}

/// State of the thread.
struct Observation {
    probes: Probes,
    tables: Tables,
    has_callbacks: bool,
    late: LateObservation,
    broker: Broker,
    processes: Processes,
    table: ProcessTable,
    mappings: Option<MappingEvents>,
    /// The last logged reason why `mappings` is empty.
    without_mappings: Option<Reason>,
    /// Time when the programs were detached because of the budget of all calls.
    suspended_at: Option<Instant>,
    /// Whether calls are observed on demand, and no client needs them.
    is_resting: bool,
    /// Number of rounds since the observation of calls began.
    rounds: u32,
    last_round: Instant,
    last_review: Instant,
    /// Whether the broker did not answer the last request: it may start later than this process.
    is_broker_unavailable: bool,
    /// Whether processes may have started unnoticed, until all were inspected and events are open.
    has_lost_events: bool,
}

impl Observation {
    fn new(work: Work) -> Self {
        let now = Instant::now();
        Self {
            probes: work.probes,
            tables: work.tables,
            has_callbacks: work.has_callbacks,
            late: work.late,
            broker: work.broker,
            processes: Processes::new(work.scope, Library::Tracing),
            table: ProcessTable::new(work.has_callbacks),
            mappings: None,
            without_mappings: None,
            suspended_at: None,
            is_resting: false,
            rounds: 0,
            last_round: now,
            last_review: now,
            is_broker_unavailable: false,
            has_lost_events: true,
        }
    }

    /// Attaches to libraries in use, and reads the tables. Then waits for the next round, or
    /// becomes idle.
    fn run_round(&mut self, shared: &Shared) {
        let now = Instant::now();
        if std::mem::take(&mut self.is_resting) {
            self.last_round = now;
            tracing::info!("observing calls: a client needs them");
        }
        if self
            .suspended_at
            .is_some_and(|at| now - at >= SUSPENSION_TIME)
        {
            self.suspended_at = None;
            if let Err(error) = self.tables.forget_times(None) {
                let reason = in_words(&error);
                tracing::warn!(
                    reason,
                    "the next calls may seem to have lasted for the pause"
                );
            }
            tracing::info!("attached again inside processes");
        }
        // A late round is skipped, so the observation ends only when its last round can be
        // reported.
        let ends = !shared.is_wanted() && !shared.is_late();
        self.probes.detach_changed(now);
        self.has_lost_events |= MappingEvents::drop_stale(&mut self.mappings);
        let to_calls = !ends && self.suspended_at.is_none();
        let failed = self.find(now, to_calls);
        if ends {
            self.probes.detach();
        }
        let demand = shared.late().clone();
        (self.late).follow(!ends && self.has_callbacks, &demand, &mut self.tables);
        let clocks = self.set_clocks();
        if !shared.is_late() {
            self.read_round(shared, &clocks, ends);
        }
        if ends {
            self.become_idle(shared, failed);
            return;
        }
        self.rounds = self.rounds.saturating_add(1);
        let over = || format!("all processes made more than {MAX_HITS} calls per second");
        let detached = failed.or_else(|| self.suspended_at.map(|_| over()));
        self.report(shared, detached);
        self.wait(shared, now + REPORT_INTERVAL);
    }

    /// Finds processes and attaches to their libraries. Returns the error if the broker did not
    /// answer.
    fn find(&mut self, now: Instant, to_calls: bool) -> Option<String> {
        let broker = &mut self.broker;
        // Processes may have started while events were lost.
        let found = self.processes.find(self.has_lost_events, broker);
        let failed = found.err().map(|error| in_words(&error));
        if failed.is_none() {
            let were_open = self.mappings.is_some();
            if !were_open {
                self.mappings = MappingEvents::open_or_warn(
                    "capture.inside",
                    broker,
                    &mut self.without_mappings,
                );
            }
            // A process may have mapped a library before the events were open.
            self.has_lost_events = !were_open && self.mappings.is_some();
            self.probes.install(to_calls, now, broker);
        }
        self.probes.follow(&self.processes, to_calls, now, broker);
        self.is_broker_unavailable = failed.is_some();
        failed
    }

    fn read_round(&mut self, shared: &Shared, clocks: &Clocks, is_last: bool) {
        let elapsed = self.last_round.elapsed();
        self.last_round += elapsed;
        let showing = self.processes_showing_intra_process();
        let (tables, broker) = (&mut self.tables, &mut self.broker);
        let is_showing = |process| showing.contains(&process);
        let late = &self.late;
        let delivery = |call: &_| late.delivery(call);
        let mut round = (self.table).round(tables, clocks, elapsed, broker, is_showing, delivery);
        self.late.set_bounds(&self.table, &mut self.tables);
        round.is_last = is_last;
        let hits = round.hits;
        shared.store_round(round);
        if self.suspended_at.is_none() && !is_last && hits > MAX_HITS {
            tracing::warn!(
                calls_per_second = hits,
                "detached inside processes for a minute: together they exceed the budget"
            );
            self.probes.detach();
            self.suspended_at = Some(Instant::now());
        }
    }

    /// Becomes idle: forgets the calls so far, so that later calls are counted from zero.
    fn become_idle(&mut self, shared: &Shared, failed: Option<String>) {
        if let Err(error) = self.tables.forget_calls() {
            let reason = in_words(&error);
            tracing::warn!(
                reason,
                "calls are still counted from their first observation"
            );
        }
        self.table.forget_reports();
        self.broker.disconnect();
        self.is_resting = true;
        self.rounds = 0;
        self.last_review = Instant::now();
        self.report(shared, failed);
    }

    /// Waits at most one round for a client to need calls, and reads announcements of new
    /// processes.
    fn wait_idle(&mut self, shared: &Shared) {
        let now = Instant::now();
        let interval = match self.is_broker_unavailable {
            true => RETRY_DELAY,
            false if self.has_lost_events => RETRY_DELAY,
            false if self.table.len() >= MANY_PROCESSES => SHORT_REVIEW_INTERVAL,
            false => REVIEW_INTERVAL,
        };
        let is_due = now - self.last_review >= interval;
        let has_stale_events = MappingEvents::drop_stale(&mut self.mappings);
        self.has_lost_events |= has_stale_events;
        if self.probes.detach_changed(now) || has_stale_events || is_due {
            self.last_review = now;
            let failed = self.find(now, false);
            let clocks = Clocks::read();
            (self.table).forget_ended(&mut self.tables, &clocks, &mut self.broker);
            self.report(shared, failed);
        }
        self.wait(shared, now + REPORT_INTERVAL);
        self.set_clocks();
        let elapsed = self.last_round.elapsed();
        self.last_round += elapsed;
        (self.table).apply_budgets(&mut self.tables, elapsed, &mut self.broker);
        (self.table).drain(&mut self.tables, &Clocks::read(), &mut self.broker);
        self.broker.disconnect();
    }

    /// Waits until `end`, or until the demand changes. Reads announcements during the wait, because
    /// their ring could overflow.
    fn wait(&mut self, shared: &Shared, end: Instant) {
        let mut gathers_until = Instant::now();
        while let Some(event) = self.next_event(shared, gathers_until, end) {
            shared.progress.step();
            match event {
                Event::Announced => {
                    (self.table).drain(&mut self.tables, &Clocks::read(), &mut self.broker);
                    gathers_until = Instant::now() + ANNOUNCEMENT_DELAY;
                }
                Event::Mapped => self.attach_mapped(),
                Event::Demanded => {
                    shared.bell.iter().for_each(Bell::drain);
                    return;
                }
            }
        }
    }

    /// Attaches probes to a library that a process has just mapped.
    fn attach_mapped(&mut self) {
        let new = self.take_mapped();
        if !new.is_incomplete && new.processes.is_empty() {
            std::thread::sleep(UNRELATED_DELAY);
            return;
        }
        let met: Result<(), BrokerError> = self.processes.inspect_mapped(&new, &mut self.broker);
        if met.is_err() {
            // A broker that does not answer is reported in the next round.
            self.has_lost_events = true;
            return;
        }
        let to_calls = !self.is_resting && self.suspended_at.is_none();
        let now = Instant::now();
        (self.probes).follow(&self.processes, to_calls, now, &mut self.broker);
    }

    fn take_mapped(&mut self) -> NewMappings {
        let is_library = |name: &str| Library::Tracing.has_name(name);
        let new = self.mappings.as_mut().map(|all| all.take(is_library));
        new.unwrap_or_default()
    }

    /// Waits until `end` for the next event, and returns `None` at the end. Announcements count as
    /// an event only after `gathers_until`.
    fn next_event(&self, shared: &Shared, gathers_until: Instant, end: Instant) -> Option<Event> {
        loop {
            let now = Instant::now();
            let is_gathering = now < gathers_until;
            let until = match is_gathering {
                true => end.min(gathers_until),
                false => end,
            };
            let timeout = until.saturating_duration_since(now);
            if timeout.is_zero() {
                return None;
            }
            let bell = shared
                .bell
                .iter()
                .map(|bell| (Event::Demanded, bell.descriptor()));
            let announced = (!is_gathering).then(|| (Event::Announced, self.tables.descriptor()));
            let mapped = self.mappings.iter().flat_map(MappingEvents::descriptors);
            let mapped = mapped.map(|ring| (Event::Mapped, ring));
            let (events, descriptors): (Vec<_>, Vec<_>) =
                bell.chain(announced).chain(mapped).unzip();
            match wait(&descriptors, timeout) {
                Ok(Some(first)) => return events.get(first).copied(),
                Ok(None) if is_gathering => {}
                Ok(None) | Err(_) => return None,
            }
        }
    }

    /// Returns the processes whose library reports every step of messages within them.
    fn processes_showing_intra_process(&self) -> HashSet<u32> {
        let at_calls = self.probes.call_probes();
        let attached = |id| at_calls.probe(id)?.as_ref().ok();
        let shows = |id| attached(id).is_some_and(|attached| attached.shows_intra_process);
        let using = self.processes.using();
        let showing =
            using.filter(|(_, used)| used.libraries.iter().any(|library| shows(&library.id)));
        showing.map(|(process, _)| process).collect()
    }

    /// Sets the clock differences for the programs, and returns the readings.
    fn set_clocks(&mut self) -> Clocks {
        let clocks = Clocks::read();
        if let Err(error) = self.tables.set_clocks(&clocks) {
            let reason = in_words(&error);
            tracing::debug!(
                reason,
                "latencies inside processes use an older clock reading"
            );
        }
        clocks
    }

    fn report(&self, shared: &Shared, detached: Option<String>) {
        let values = self.tables.counters().unwrap_or_default();
        let labels = Counter::ALL.iter().map(|counter| counter.label());
        shared.report(Facts {
            has_callbacks: self.has_callbacks,
            is_on_demand: self.probes.on_demand.is_some(),
            has_inspected: true,
            libraries: self.probes.facts(self.is_resting),
            detached,
            is_idle: self.is_resting,
            shows_rates: self.rounds >= RATE_ROUNDS,
            late: self.late.observed(),
            without_events: self.late.without_events(),
            without_deliveries: self.late.without_deliveries().map(str::to_owned),
            counters: labels.zip(values).collect(),
        });
    }
}

/// What ends a wait between two rounds.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Event {
    /// A process mapped a file.
    Mapped,
    /// Many announcements wait.
    Announced,
    /// The first client needs calls, or the last one no longer needs them.
    Demanded,
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU32;

    use ros2probe_attach::mapped::{self, LibraryId, Mapped};

    use super::*;
    use crate::uprobe::attachments::Refusal;

    /// Probes whose attempts to attach are counted and refused.
    fn counted(attempts: &Arc<AtomicU32>) -> Attachments<Attached> {
        let attempts = Arc::clone(attempts);
        Attachments::new(
            "",
            Box::new(move |_, _| {
                attempts.fetch_add(1, Ordering::Relaxed);
                Err(Refusal::Program("no program".into()))
            }),
        )
    }

    #[test]
    fn probes_at_calls_stay_detached_for_the_pause_and_the_others_do_not() {
        let used = mapped::Use {
            libraries: vec![Mapped {
                id: LibraryId {
                    device: "fe:00".to_owned(),
                    inode: 7,
                },
                path: "/libtracetools.so".into(),
                range: String::new(),
            }],
            shares: false,
        };
        let processes = Processes::of(std::process::id(), used.into());
        for is_on_demand in [false, true] {
            let [lasting, on_demand] = [const { AtomicU32::new(0) }; 2].map(Arc::new);
            let mut probes = Probes {
                lasting: counted(&lasting),
                on_demand: is_on_demand.then(|| counted(&on_demand)),
            };
            let at_calls = if is_on_demand { &on_demand } else { &lasting };
            let attempts = |of: &Arc<AtomicU32>| of.load(Ordering::Relaxed);
            let (mut now, broker) = (Instant::now(), &mut Broker::here());
            let mut follow = |probes: &mut Probes, to_calls| {
                now += 2 * RETRY_DELAY;
                probes.install(to_calls, now, broker);
                probes.follow(&processes, to_calls, now, broker);
            };
            follow(&mut probes, true);
            let before = attempts(at_calls);
            assert!(before > 0);
            probes.detach();
            let before_lasting = attempts(&lasting);
            follow(&mut probes, false);
            assert_eq!(attempts(at_calls), before, "they are detached");
            assert_eq!(attempts(&lasting) > before_lasting, is_on_demand);
            follow(&mut probes, true);
            assert!(attempts(at_calls) > before, "the pause is over");
        }
    }
}
