//! The thread that finds the libraries in use and attaches probes to them.
//!
//! A probe attached to a file is active in every process that maps the file, including later ones.
//! The probe of an unused library is removed only after a while, so that a restarted robot is seen
//! from its first message. The broker reads other processes for the thread.

use std::collections::BTreeSet;
use std::io;
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ros2probe_attach::client::Broker;
use ros2probe_attach::functions::Library;
use ros2probe_attach::mapped::Mapped;

use super::attachments::{Attachments, LibraryFacts, RETRY_DELAY};
use super::processes::Processes;
use crate::bell::Bell;
use crate::breakpoints::Attached;
use crate::error_chain::{Reason, in_words};
use crate::filter::Probes;
use crate::mappings::{MappingEvents, NewMappings, UNRELATED_DELAY};
use crate::shm::directories::{Name, Scope, ShmDirectories};
use crate::system::{DirectoryWatch, wait};
use crate::threads::{Progress, Spawn, Task};

/// Interval of inspecting processes without an event.
const INSPECTION_INTERVAL: Duration = Duration::from_secs(1);
/// Time for which events accumulate: a starting participant creates several files together.
const EVENT_DELAY: Duration = Duration::from_millis(20);
/// Time after the start of a process in which its names are announced, each once.
const STARTUP_TIME: Duration = Duration::from_secs(10);
/// Time between resuming the polls of shared memory and detaching the probes.
const DETACH_OVERLAP: Duration = Duration::from_millis(400);
/// Why nothing is attached on demand.
const IDLE_REASON: &str =
    "capture.shm.exact is auto, and no client reads samples of a topic in shared memory";
/// Handle of the thread.
pub struct LibrarySearch {
    shared: Arc<Shared>,
    /// State passed to the thread when it starts.
    waiting: Option<(Attachments<Attached>, Scope, Broker)>,
    thread: Option<JoinHandle<()>>,
}

/// The attached libraries, and the reason why processes are not covered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Facts {
    /// Libraries in use.
    pub libraries: Vec<LibraryFacts>,
    /// Why messages of some process may be missed; `None` = every process is covered.
    pub uncovered: Option<String>,
    /// Whether the running processes have been inspected, or need not be.
    pub has_inspected: bool,
    /// Whether probes are attached on demand and not needed.
    pub is_resting: bool,
}

struct Shared {
    facts: Mutex<Facts>,
    /// Whether all processes are covered. Until the first search ends, also set if installed
    /// libraries have probes.
    covers_all: AtomicBool,
    /// Whether every message is needed.
    wanted: AtomicBool,
    /// Rings when `wanted` changes. Without the bell, the thread notices a change within a second.
    bell: Option<Bell>,
    /// Whether any probe may be attached.
    attached: AtomicBool,
    /// Whether all processes have been inspected since the probes were last requested.
    has_inspected_all: AtomicBool,
    /// Whether probes are attached only while processes start, and while every message is needed.
    on_demand: bool,
    progress: Arc<Progress>,
    stop: AtomicBool,
}

impl Facts {
    /// Returns the facts while probes are attached on demand and not needed. `failed` is the reason
    /// why the broker does not answer: without it, a demand would attach nothing.
    fn idle(failed: Option<String>) -> Self {
        Self {
            libraries: Vec::new(),
            is_resting: failed.is_none(),
            uncovered: failed.or_else(|| Some(IDLE_REASON.to_owned())),
            has_inspected: true,
        }
    }
}

/// Returns the facts before the first search.
impl Default for Facts {
    fn default() -> Self {
        Self {
            libraries: Vec::new(),
            uncovered: Some("processes have not been inspected yet".to_owned()),
            has_inspected: false,
            is_resting: false,
        }
    }
}

impl LibrarySearch {
    /// Attaches to installed libraries before the thread starts. With `on_demand`, the thread
    /// detaches when no process has started for a while and not every message is needed.
    #[must_use]
    pub fn new(probes: Probes, scope: Scope, mut broker: Broker, on_demand: bool) -> Self {
        let progress = Arc::new(Progress::default());
        let mut attachments = attachments(probes, Arc::clone(&progress));
        // A participant announces its names once, within a tenth of a second, so probes are
        // attached to installed libraries in advance.
        attachments.install(Library::FastDds, Instant::now(), &mut broker);
        progress.set_idle();
        let shared = Arc::new(Shared {
            facts: Mutex::default(),
            progress,
            covers_all: AtomicBool::new(attachments.is_installed()),
            wanted: AtomicBool::new(!on_demand),
            bell: Bell::new().ok(),
            attached: AtomicBool::new(true),
            has_inspected_all: AtomicBool::default(),
            on_demand,
            stop: AtomicBool::new(false),
        });
        Self {
            shared,
            waiting: Some((attachments, scope, broker)),
            thread: None,
        }
    }

    /// Starts the search in a thread without privileges. Later calls have no effect.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        let Some((attachments, scope, broker)) = self.waiting.take() else {
            return Ok(());
        };
        let thread = std::thread::Builder::new().name("exact".to_owned());
        let shared = Arc::clone(&self.shared);
        let work = Box::new(move || follow(&shared, attachments, scope, broker));
        let spawned = spawn(Task::Probes, thread, work);
        if spawned.is_err() {
            self.shared.covers_all.store(false, Ordering::Release);
            let facts = self.shared.facts.lock();
            // No process will be inspected, so readiness must not wait for it.
            facts.unwrap_or_else(PoisonError::into_inner).has_inspected = true;
        }
        self.thread = Some(spawned?);
        Ok(())
    }

    /// Sets whether every message is needed. The setting matters only if probes are attached on
    /// demand.
    pub fn set_demand(&self, wanted: bool) {
        let shared = &self.shared;
        if !shared.on_demand || shared.wanted.swap(wanted, Ordering::AcqRel) == wanted {
            return;
        }
        shared.has_inspected_all.store(false, Ordering::Release);
        shared.ring();
    }

    /// Returns whether the probes are needed, but not yet attached in all processes that can have
    /// them.
    #[must_use]
    pub fn is_attaching(&self) -> bool {
        let shared = &self.shared;
        shared.wanted.load(Ordering::Acquire) && !shared.has_inspected_all.load(Ordering::Acquire)
    }

    /// Returns whether any probe may be attached.
    #[must_use]
    pub fn is_attached(&self) -> bool {
        self.shared.attached.load(Ordering::Acquire)
    }

    /// Returns facts about the attached libraries, and about processes that are not covered.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let facts = self.shared.facts.lock();
        facts.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns for how long the thread has made no progress; `None` if it makes progress.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.shared.progress.stalled()
    }

    /// Returns whether every process that uses Fast DDS's shared memory is covered. A stalled
    /// thread finds no new processes, so the result is then `false`.
    #[must_use]
    pub fn covers_all(&self) -> bool {
        self.shared.covers_all.load(Ordering::Acquire) && self.stalled().is_none()
    }
}

impl Drop for LibrarySearch {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        // Without the bell, the thread wakes within a second, which is too long for a shutdown.
        self.shared.ring();
        drop(self.thread.take());
    }
}

/// The thread's main function.
fn follow(shared: &Shared, attachments: Attachments<Attached>, scope: Scope, broker: Broker) {
    let mut followed = Followed {
        processes: Processes::new(scope.clone(), Library::FastDds),
        attachments,
        broker,
        failed: None,
        mappings: None,
        without_mappings: None,
        asked: Instant::now(),
        starting_until: Instant::now() + STARTUP_TIME,
    };
    let mut shared_memory = ShmDirectories::new(scope);
    // Without inotify, a starting participant is noticed within a second.
    let mut watch = DirectoryWatch::new().ok();
    let mut watched = BTreeSet::new();
    let (mut somebody_came, mut asked_all) = (true, None::<Instant>);
    while !shared.stop.load(Ordering::Acquire) {
        shared.progress.step();
        let is_starting = Instant::now() < followed.starting_until;
        if !shared.wanted.load(Ordering::Acquire) && !is_starting {
            somebody_came = true;
            asked_all = None;
            if shared.attached.load(Ordering::Acquire) {
                // Polling of shared memory resumes before the probes are detached.
                shared.report(Facts::idle(followed.failed.clone()));
                if followed.has_start_within(DETACH_OVERLAP) {
                    continue;
                }
                followed.detach_all();
                shared.attached.store(false, Ordering::Release);
                tracing::info!("no longer attached: no samples are read");
            }
            followed.wait_for_demand(shared);
            continue;
        }
        shared.attached.store(true, Ordering::Release);
        let now = Instant::now();
        let all = somebody_came && asked_all.is_none_or(|at| now - at >= INSPECTION_INTERVAL);
        if all {
            asked_all = Some(now);
        }
        // New processes come first.
        followed.find(shared, false, now);
        if all {
            followed.find(shared, true, now);
        }
        shared.report(followed.facts());
        shared.has_inspected_all.store(true, Ordering::Release);
        let Some(watch) = &mut watch else {
            followed.wait_and_attach(None, INSPECTION_INTERVAL, shared);
            continue;
        };
        shared_memory.find();
        let directories = shared_memory
            .directories
            .values()
            .map(|directory| directory.path.clone());
        let directories: BTreeSet<_> = directories.collect();
        for new in directories.difference(&watched) {
            watch.add(new);
        }
        watched = directories;
        followed.wait_and_attach(None, EVENT_DELAY, shared);
        let is_created = followed.wait_and_attach(Some(watch), INSPECTION_INTERVAL, shared);
        somebody_came = is_created && watch.created(|name| Name::parse(name).is_some());
    }
    shared.progress.set_idle();
}

/// The processes, and the libraries that they use.
struct Followed {
    processes: Processes,
    attachments: Attachments<Attached>,
    broker: Broker,
    /// Why the broker did not answer the last request.
    failed: Option<String>,
    mappings: Option<MappingEvents>,
    /// The last logged reason why `mappings` is empty.
    without_mappings: Option<Reason>,
    /// Time of the last request for all processes.
    asked: Instant,
    /// End of the time in which a process that has started announces its names.
    starting_until: Instant,
}

impl Followed {
    fn find(&mut self, shared: &Shared, all: bool, now: Instant) {
        if self.attachments.detach_changed(now) {
            // Polling of shared memory resumes before the broker answers.
            shared.covers_all.store(false, Ordering::Release);
        }
        // Processes may have started while the events were lost.
        let all = MappingEvents::drop_stale(&mut self.mappings) || all;
        // Installed libraries come first: a process that starts announces its names immediately.
        self.install(now);
        let found = self.processes.find(all, &mut self.broker);
        self.failed = found.err().map(|error| in_words(&error));
        self.asked = Instant::now();
        // The broker may have started after the agent.
        self.install(now);
        self.attachments
            .follow(&self.processes, now, &mut self.broker);
    }

    fn facts(&self) -> Facts {
        facts(&self.attachments, &self.processes, self.failed.clone())
    }

    /// Attaches to installed libraries, and opens the events of mapped files.
    fn install(&mut self, now: Instant) {
        if self.failed.is_some() {
            return;
        }
        let broker = &mut self.broker;
        self.attachments.install(Library::FastDds, now, broker);
        if self.mappings.is_none() {
            self.mappings = MappingEvents::open_or_warn(
                "capture.shm.exact",
                &mut self.broker,
                &mut self.without_mappings,
            );
        }
    }

    /// Detaches from all libraries, so that the broker may end.
    fn detach_all(&mut self) {
        self.attachments.clear();
        self.broker.disconnect();
    }

    /// Waits until a process maps a library, or every message is needed.
    fn wait_for_demand(&mut self, shared: &Shared) {
        let bell = shared.bell.iter().map(Bell::descriptor);
        let mapped = self.mappings.iter().flat_map(MappingEvents::descriptors);
        let descriptors: Vec<_> = bell.chain(mapped).collect();
        shared.progress.set_idle();
        let ready = wait(&descriptors, INSPECTION_INTERVAL);
        shared.progress.step();
        shared.bell.iter().for_each(Bell::drain);
        if !self.note_start() && matches!(ready, Ok(Some(_))) {
            std::thread::sleep(UNRELATED_DELAY);
        }
        self.ask_again(shared);
    }

    /// Repeats the request to a broker that did not answer: it may have started after the agent.
    fn ask_again(&mut self, shared: &Shared) {
        if self.failed.is_none() || self.asked.elapsed() < RETRY_DELAY {
            return;
        }
        let found = self.processes.find(true, &mut self.broker);
        self.asked = Instant::now();
        self.failed = found.err().map(|error| in_words(&error));
        if self.failed.is_none() {
            // Processes may have started in the meantime.
            self.starting_until = self.asked + STARTUP_TIME;
            return;
        }
        self.broker.disconnect();
        shared.report(Facts::idle(self.failed.clone()));
    }

    /// Waits, and returns whether a process starts in this time. The rings are read all the while:
    /// on a machine that starts many programs they would overflow.
    fn has_start_within(&mut self, limit: Duration) -> bool {
        let end = Instant::now() + limit;
        while Instant::now() < end {
            std::thread::sleep(EVENT_DELAY);
            if self.note_start() {
                return true;
            }
        }
        false
    }

    /// Reads the rings, and returns whether a process in scope may have mapped a library. Its
    /// names are announced from now on.
    fn note_start(&mut self) -> bool {
        let new = self.take_mapped();
        let has_lost_events = MappingEvents::drop_stale(&mut self.mappings) || new.is_incomplete;
        let is_start = has_lost_events || self.processes.are_in_scope(&new.processes);
        if is_start {
            self.starting_until = Instant::now() + STARTUP_TIME;
        }
        is_start
    }

    fn take_mapped(&mut self) -> NewMappings {
        let is_library = |name: &str| Library::FastDds.has_name(name);
        let new = self
            .mappings
            .as_mut()
            .map(|mappings| mappings.take(is_library));
        new.unwrap_or_default()
    }

    /// Waits at most `limit` for a created file, and returns whether one was created. Attaches to
    /// libraries that processes map in that time.
    fn wait_and_attach(
        &mut self,
        watch: Option<&DirectoryWatch>,
        limit: Duration,
        shared: &Shared,
    ) -> bool {
        let end = Instant::now() + limit;
        loop {
            let rest = end.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                return false;
            }
            let created = watch.map(AsFd::as_fd);
            let mapped = self.mappings.iter().flat_map(MappingEvents::descriptors);
            let descriptors: Vec<_> = created.into_iter().chain(mapped).collect();
            shared.progress.set_idle();
            let ready = wait(&descriptors, rest);
            shared.progress.step();
            match ready {
                Ok(Some(0)) if watch.is_some() => return true,
                Ok(Some(_)) => self.attach_mapped(shared),
                Ok(None) | Err(_) => return false,
            }
        }
    }

    fn attach_mapped(&mut self, shared: &Shared) {
        let new = self.take_mapped();
        if self.processes.are_in_scope(&new.processes) {
            self.starting_until = Instant::now() + STARTUP_TIME;
        }
        if let Err(error) = self.processes.inspect_mapped(&new, &mut self.broker) {
            self.failed = Some(in_words(&error));
        } else if !new.is_incomplete && new.processes.is_empty() {
            std::thread::sleep(UNRELATED_DELAY);
            return;
        }
        let now = Instant::now();
        self.attachments
            .follow(&self.processes, now, &mut self.broker);
        shared.report(self.facts());
    }
}

impl Shared {
    fn ring(&self) {
        self.bell.iter().for_each(Bell::ring);
    }

    fn report(&self, facts: Facts) {
        self.covers_all
            .store(facts.uncovered.is_none(), Ordering::Release);
        let mut known = self.facts.lock().unwrap_or_else(PoisonError::into_inner);
        if known.uncovered != facts.uncovered {
            match &facts.uncovered {
                Some(reason) if reason == IDLE_REASON => {}
                Some(reason) => tracing::warn!(reason, "shared memory is sampled"),
                None => tracing::info!("every message into shared memory is seen"),
            }
        }
        *known = facts;
    }
}

/// Returns attachments of the function that copies a message into shared memory.
fn attachments(probes: Probes, progress: Arc<Progress>) -> Attachments<Attached> {
    Attachments::new(
        "every message is seen",
        Box::new(move |broker, place| {
            progress.step();
            probes.attach(broker, place)
        }),
    )
}

/// Returns the facts of a search. `failed` is the reason why the broker does not answer.
fn facts(
    attachments: &Attachments<Attached>,
    processes: &Processes,
    failed: Option<String>,
) -> Facts {
    Facts {
        libraries: attachments.facts(),
        uncovered: failed.or_else(|| uncovered(attachments, processes)),
        has_inspected: true,
        is_resting: false,
    }
}

fn uncovered(attachments: &Attachments<Attached>, processes: &Processes) -> Option<String> {
    for (process, used) in processes.using() {
        if used.libraries.is_empty() {
            return Some(format!(
                "process {process} has Fast DDS linked statically: there is no library to attach to"
            ));
        }
        for Mapped { id, path, .. } in &used.libraries {
            let path = path.display();
            match attachments.probe(id) {
                Some(Ok(_)) => {}
                Some(Err(reason)) => return Some(format!("{path}: {reason}")),
                None if attachments.is_full() => {
                    return Some(format!("{path}: too many libraries are in use"));
                }
                None => return Some(format!("{path}: not attached yet")),
            }
        }
    }
    let closed = processes.closed();
    closed.map(|process| format!("process {process} cannot be inspected"))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::fd::AsRawFd as _;
    use std::path::Path;

    use super::super::attachments::{DETACH_DELAY, Refusal};
    use super::super::processes::Use;
    use super::*;
    use crate::breakpoints::AttachMethod;
    use crate::filter::{Filter, FilterSettings};
    use crate::tables::tests::assert_driven;
    use crate::tables::{Libraries, MappedLibraries};
    use ros2probe_attach::mapped;

    /// Maps a file into this process permanently.
    fn map(file: &fs::File) {
        // SAFETY: a new private mapping at an address of the kernel's choice; nothing refers to it.
        let mapped = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                1,
                libc::PROT_READ,
                libc::MAP_PRIVATE,
                file.as_raw_fd(),
                0,
            )
        };
        assert_ne!(mapped, libc::MAP_FAILED, "{}", io::Error::last_os_error());
    }

    /// A thread's state with events of mapped files, and without probes.
    fn followed() -> Followed {
        let mut broker = Broker::here();
        let mappings = MappingEvents::open(&mut broker)
            .expect("records of all processes need root: run the tests with sudo");
        let refuse = |_: &mut _, _| Err(Refusal::Program("no program".into()));
        Followed {
            processes: Processes::new(Scope::Directories(Vec::new()), Library::FastDds),
            attachments: Attachments::new("", Box::new(refuse)),
            broker,
            failed: None,
            mappings: Some(mappings),
            without_mappings: None,
            asked: Instant::now(),
            starting_until: Instant::now(),
        }
    }

    #[test]
    fn many_started_programs_of_other_kinds_do_not_delay_the_detachment() {
        let mut followed = followed();
        let is_over = Arc::new(AtomicBool::default());
        let is_asked_to_end = Arc::clone(&is_over);
        let others = std::thread::spawn(move || {
            let program = fs::File::open("/proc/self/exe").unwrap();
            let kind = libc::PROT_READ | libc::PROT_EXEC;
            while !is_asked_to_end.load(Ordering::Acquire) {
                for _ in 0..3 {
                    let (any, private) = (std::ptr::null_mut(), libc::MAP_PRIVATE);
                    // SAFETY: a new mapping at an address of the kernel's choice.
                    let mapped =
                        unsafe { libc::mmap(any, 1, kind, private, program.as_raw_fd(), 0) };
                    assert_ne!(mapped, libc::MAP_FAILED);
                    // SAFETY: the mapping was created above, and nothing refers to it.
                    unsafe { libc::munmap(mapped, 1) };
                }
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        // A busy machine reads the rings late, and they lose records, but not each time.
        let begun = Instant::now();
        let mut has_start = true;
        while has_start && begun.elapsed() < Duration::from_secs(60) {
            followed.starting_until = Instant::now();
            has_start = followed.has_start_within(2 * DETACH_OVERLAP);
        }
        is_over.store(true, Ordering::Release);
        others.join().unwrap();
        assert!(!has_start, "the rings lost records");
        assert!(followed.starting_until <= Instant::now());
    }

    #[test]
    fn a_broker_that_starts_later_is_asked_at_rest() {
        let mut followed = followed();
        followed.processes = Processes::new(Scope::AllProcesses, Library::FastDds);
        let shared = Shared {
            facts: Mutex::default(),
            progress: Arc::default(),
            covers_all: AtomicBool::new(false),
            wanted: AtomicBool::new(false),
            bell: None,
            attached: AtomicBool::new(false),
            has_inspected_all: AtomicBool::default(),
            on_demand: true,
            stop: AtomicBool::new(false),
        };
        let reason = || Some("no broker listens".to_owned());
        followed.failed = reason();
        followed.ask_again(&shared);
        assert_eq!(followed.failed, reason(), "the pause is not over");
        followed.asked -= RETRY_DELAY;
        followed.ask_again(&shared);
        assert_eq!(followed.failed, None);
        assert!(followed.starting_until > Instant::now(), "it attaches");

        followed.broker = Broker::at(Path::new("/nonexistent/broker.sock"));
        followed.failed = reason();
        followed.asked -= RETRY_DELAY;
        followed.ask_again(&shared);
        let facts = shared.facts.lock().unwrap().clone();
        let uncovered = facts.uncovered.unwrap();
        assert!(
            uncovered.contains("cannot connect to the broker"),
            "{uncovered}"
        );
        assert!(!facts.is_resting);
        assert!(Facts::idle(None).is_resting);
    }

    #[test]
    fn a_library_beyond_the_cap_gets_no_probe_until_another_is_detached() {
        let directory = tempfile::tempdir().unwrap();
        let program = ros2probe_testing::harness::peer::built("handed").unwrap();
        for number in 0..=Libraries::CAP {
            let path = directory.path().join(format!("libfastdds.so.{number}"));
            fs::copy(&program, &path).unwrap();
            map(&fs::File::open(&path).unwrap());
        }
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let mut used = Use::from(mapped::Use::parse(&maps, Library::FastDds));
        assert_driven::<MappedLibraries>();
        let process = std::process::id();
        let all = Processes::of(process, used.clone());
        let (_filter, probes) = Filter::load_uprobe(
            &FilterSettings::default(),
            None,
            AttachMethod::of_this_kernel(),
        )
        .expect("loading the kernel filter needs root: run the tests with sudo");
        let mut attachments = attachments(probes, Arc::default());
        let (start, broker) = (Instant::now(), &mut Broker::here());
        attachments.follow(&all, start, broker);
        attachments.follow(&all, start + RETRY_DELAY, broker);
        let facts = super::facts(&attachments, &all, None);
        assert_driven::<Libraries>();
        let refused = facts.libraries.iter().find_map(|each| each.refused.clone());
        assert_eq!(refused, None);
        let uncovered = facts.uncovered.unwrap();
        assert!(
            uncovered.ends_with(": too many libraries are in use"),
            "{uncovered}"
        );

        // The last library has no probe. It gets one after the first library is detached.
        used.libraries.remove(0);
        let fewer = Processes::of(process, used);
        let later = start + RETRY_DELAY + DETACH_DELAY + INSPECTION_INTERVAL;
        attachments.follow(&fewer, later, broker);
        attachments.follow(&fewer, later + INSPECTION_INTERVAL, broker);
        let facts = super::facts(&attachments, &fewer, None);
        assert_eq!(facts.libraries.len(), Libraries::CAP);
        assert_eq!(facts.uncovered, None);
    }
}
