//! The thread that finds the libraries in use and attaches to them.
//!
//! Attached once to a file, a probe is in every process that maps it, including later ones. A
//! library that no process uses is detached only after a while, so that a restarted robot is seen
//! from its first message. The thread reads `/proc` and library files, and writes nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, OpenOptions};
use std::io;
use std::os::fd::AsFd as _;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::library::{self, LibraryError};
use super::processes::{LibraryId, Mapped, Processes, is_library};
use crate::error_chain::in_words;
use crate::filter::{FilterError, Probe, Probes};
use crate::shm::directories::{Name, Scope, ShmDirectories};
use crate::system::{DirectoryWatch, wait};
use crate::threads::{Spawn, Task};

/// Interval of visiting processes if nothing happens.
const EVERY: Duration = Duration::from_secs(1);
/// How long to collect events: a starting participant creates several files at once.
const GATHER: Duration = Duration::from_millis(20);
/// How long an unused library stays attached.
const LINGER: Duration = Duration::from_secs(60);
/// Pause before another attempt to attach to a library.
const RETRY: Duration = Duration::from_secs(5);
/// Time between resuming the polls of shared memory and detaching the probes.
const OVERLAP: Duration = Duration::from_millis(400);
/// Why nothing is attached on demand.
const RESTING: &str =
    "capture.shm.exact is auto, and no client reads samples of a topic in shared memory";
/// Most libraries with a probe: images of containers on one host.
const MAX_LIBRARIES: usize = 64;

/// Directories of installed libraries and of ROS distributions.
const INSTALLED: [&str; 5] = [
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib",
    "/usr/lib64",
    "/usr/local/lib",
];
const DISTRIBUTIONS: &str = "/opt/ros";

/// Handle of the thread.
pub struct LibrarySearch {
    shared: Arc<Shared>,
    /// State passed to the thread when it starts.
    waiting: Option<(Attachments, Scope)>,
    thread: Option<JoinHandle<()>>,
}

/// The attached libraries, and which processes are not covered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Facts {
    /// Libraries in use.
    pub libraries: Vec<LibraryFacts>,
    /// Why some process may send without being seen; `None` = all are covered.
    pub uncovered: Option<String>,
}

/// State of one library.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LibraryFacts {
    /// Its path in the file system of a process that uses it.
    pub path: PathBuf,
    /// Number of processes that use it.
    pub processes: usize,
    /// Why it is not attached; `None` if it is.
    pub refused: Option<String>,
}

struct Shared {
    facts: Mutex<Facts>,
    /// Also set until the first search ends: that takes a moment, and installed libraries are
    /// attached.
    covers_all: AtomicBool,
    /// Whether the probes are needed.
    wanted: AtomicBool,
    /// Whether any probe may be attached.
    attached: AtomicBool,
    /// Whether probes are attached only while they are needed.
    on_demand: bool,
    stop: AtomicBool,
}

/// All known libraries.
struct Attachments {
    probes: Probes,
    libraries: BTreeMap<LibraryId, Library>,
}

struct Library {
    path: PathBuf,
    probe: Result<Probe, String>,
    processes: usize,
    used: Instant,
    tried: Instant,
    /// Attached before any process used it, and kept.
    is_installed: bool,
}

/// Why a library is not attached.
#[derive(Debug, thiserror::Error)]
enum Refusal {
    #[error("it cannot be opened")]
    Open(#[source] io::Error),
    #[error("not a file")]
    NoFile,
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error(transparent)]
    Probe(#[from] FilterError),
}

impl Facts {
    /// Returns the facts while probes are attached on demand and not needed.
    fn resting() -> Self {
        Self {
            libraries: Vec::new(),
            uncovered: Some(RESTING.to_owned()),
        }
    }
}

/// Returns the facts before the first search.
impl Default for Facts {
    fn default() -> Self {
        Self {
            libraries: Vec::new(),
            uncovered: Some("processes have not been inspected yet".to_owned()),
        }
    }
}

impl LibrarySearch {
    /// Attaches to installed libraries before the thread starts; with `on_demand` to none until
    /// they are needed.
    #[must_use]
    pub fn new(probes: Probes, scope: Scope, on_demand: bool) -> Self {
        let mut attachments = Attachments {
            probes,
            libraries: BTreeMap::new(),
        };
        // A participant announces its names once, within a tenth of a second: installed libraries
        // are attached in advance.
        if !on_demand {
            attachments.install(&installed(), Instant::now());
        }
        let facts = match on_demand {
            true => Facts::resting(),
            false => Facts::default(),
        };
        let shared = Arc::new(Shared {
            facts: Mutex::new(facts),
            covers_all: AtomicBool::new(!on_demand),
            wanted: AtomicBool::new(!on_demand),
            attached: AtomicBool::new(!on_demand),
            on_demand,
            stop: AtomicBool::new(false),
        });
        Self {
            shared,
            waiting: Some((attachments, scope)),
            thread: None,
        }
    }

    /// Starts the search, once, in a thread that drops the privileges it does not need; the caller
    /// may drop all of its own afterwards.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        let Some((attachments, scope)) = self.waiting.take() else {
            return Ok(());
        };
        let thread = std::thread::Builder::new().name("exact".to_owned());
        let shared = Arc::clone(&self.shared);
        let work = Box::new(move || follow(&shared, attachments, scope));
        self.thread = Some(spawn(Task::Probes, thread, work)?);
        Ok(())
    }

    /// Attaches or detaches all probes, if they are attached on demand.
    pub fn want(&self, wanted: bool) {
        let shared = &self.shared;
        if !shared.on_demand || shared.wanted.swap(wanted, Ordering::AcqRel) == wanted {
            return;
        }
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }

    /// Returns whether any probe may be attached.
    #[must_use]
    pub fn is_attached(&self) -> bool {
        self.shared.attached.load(Ordering::Acquire)
    }

    /// Returns the attached libraries, and which processes are not covered.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let facts = self.shared.facts.lock();
        facts.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns whether every process that uses Fast DDS's shared memory is covered.
    #[must_use]
    pub fn covers_all(&self) -> bool {
        self.shared.covers_all.load(Ordering::Acquire)
    }
}

impl Drop for LibrarySearch {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // Otherwise it wakes within a second, too long for a shutdown.
            thread.thread().unpark();
            drop(thread);
        }
    }
}

/// The thread's main function.
fn follow(shared: &Shared, mut attachments: Attachments, scope: Scope) {
    let mut processes = Processes::new(scope.clone());
    let mut shared_memory = ShmDirectories::new(scope);
    // Without inotify, a starting participant is noticed within a second.
    let mut watch = DirectoryWatch::new().ok();
    let mut watched = BTreeSet::new();
    let (mut somebody_came, mut asked_all) = (true, None::<Instant>);
    while !shared.stop.load(Ordering::Acquire) {
        if !shared.wanted.load(Ordering::Acquire) {
            if shared.attached.load(Ordering::Acquire) {
                // Polling of shared memory resumes before the probes are detached.
                shared.report(Facts::resting());
                std::thread::sleep(OVERLAP);
                attachments.libraries.clear();
                shared.attached.store(false, Ordering::Release);
                tracing::info!("no longer attached: no samples are read");
            }
            somebody_came = true;
            asked_all = None;
            std::thread::park_timeout(EVERY);
            continue;
        }
        shared.attached.store(true, Ordering::Release);
        let now = Instant::now();
        let all = somebody_came && asked_all.is_none_or(|at| now - at >= EVERY);
        if all {
            asked_all = Some(now);
        }
        // New processes come first.
        processes.find(false);
        attachments.follow(&processes, now);
        if all {
            processes.find(true);
            attachments.follow(&processes, now);
        }
        shared.report(attachments.facts(&processes));
        let Some(watch) = &mut watch else {
            std::thread::park_timeout(EVERY);
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
        std::thread::sleep(GATHER);
        somebody_came = matches!(wait(&[watch.as_fd()], EVERY), Ok(Some(0)))
            && watch.created(|name| Name::parse(name).is_some());
    }
}

impl Shared {
    fn report(&self, facts: Facts) {
        self.covers_all
            .store(facts.uncovered.is_none(), Ordering::Release);
        let mut known = self.facts.lock().unwrap_or_else(PoisonError::into_inner);
        if known.uncovered != facts.uncovered {
            match &facts.uncovered {
                Some(reason) if reason == RESTING => {}
                Some(reason) => tracing::warn!(reason, "shared memory is sampled"),
                None => tracing::info!("every message into shared memory is seen"),
            }
        }
        *known = facts;
    }
}

impl Attachments {
    /// Attaches to installed libraries that no process uses yet.
    fn install(&mut self, paths: &[PathBuf], now: Instant) {
        for path in paths {
            let Ok(metadata) = fs::metadata(path) else {
                continue;
            };
            let device = metadata.dev();
            let id = LibraryId {
                device: format!("{:02x}:{:02x}", libc::major(device), libc::minor(device)),
                inode: metadata.ino(),
            };
            if self.libraries.contains_key(&id) || self.libraries.len() >= MAX_LIBRARIES {
                continue;
            }
            // A failure is reported when a process uses the library.
            if let Ok(probe) = attach(&mut self.probes, path) {
                tracing::info!(library = %path.display(), "uprobe attached in advance");
                let library = Library {
                    path: path.clone(),
                    probe: Ok(probe),
                    processes: 0,
                    used: now,
                    tried: now,
                    is_installed: true,
                };
                self.libraries.insert(id, library);
            }
        }
    }

    /// Attaches to new libraries, and detaches those that have been unused for a while.
    fn follow(&mut self, processes: &Processes, now: Instant) {
        for library in self.libraries.values_mut() {
            library.processes = 0;
        }
        for (process, used) in processes.using() {
            for mapped in &used.libraries {
                self.meet(mapped, process, now);
            }
        }
        self.libraries.retain(|_, library| {
            let is_used = library.is_installed || now - library.used < LINGER;
            if !is_used && library.probe.is_ok() {
                let library = library.path.display();
                tracing::info!(%library, "uprobe detached: the library is no longer in use");
            }
            is_used
        });
    }

    fn meet(&mut self, mapped: &Mapped, process: u32, now: Instant) {
        let Mapped { id, path, range } = mapped;
        let is_known = self
            .libraries
            .get(id)
            .is_some_and(|known| known.probe.is_ok() || now - known.tried < RETRY);
        if !is_known && (self.libraries.contains_key(id) || self.libraries.len() < MAX_LIBRARIES) {
            // Refers to the file that the process maps, even if its path now names another one.
            let file = PathBuf::from(format!("/proc/{process}/map_files/{range}"));
            let probe = attach(&mut self.probes, &file);
            let probe = probe.map_err(|refusal| in_words(&refusal));
            let (library, is_new) = (path.display(), !self.libraries.contains_key(id));
            match &probe {
                Ok(_) => tracing::info!(%library, "attached: every message is seen"),
                Err(reason) if is_new => tracing::warn!(%library, reason, "not attached"),
                Err(_) => {}
            }
            let library = Library {
                path: path.clone(),
                probe,
                processes: 0,
                used: now,
                tried: now,
                is_installed: false,
            };
            self.libraries.insert(id.clone(), library);
        }
        if let Some(library) = self.libraries.get_mut(id) {
            library.processes += 1;
            library.used = now;
        }
    }

    fn facts(&self, processes: &Processes) -> Facts {
        let in_use = |library: &&Library| library.processes > 0;
        let libraries = self.libraries.values().filter(in_use);
        let libraries = libraries.map(|library| LibraryFacts {
            path: library.path.clone(),
            processes: library.processes,
            refused: library.probe.as_ref().err().cloned(),
        });
        Facts {
            libraries: libraries.collect(),
            uncovered: self.uncovered(processes),
        }
    }

    fn uncovered(&self, processes: &Processes) -> Option<String> {
        for (process, used) in processes.using() {
            if used.libraries.is_empty() {
                return Some(format!(
                    "process {process} has Fast DDS linked statically: there is no library to \
                     attach to"
                ));
            }
            for Mapped { id, path, .. } in &used.libraries {
                let path = path.display();
                match self.libraries.get(id).map(|library| &library.probe) {
                    Some(Ok(_)) => {}
                    Some(Err(reason)) => return Some(format!("{path}: {reason}")),
                    None => return Some(format!("{path}: too many libraries are in use")),
                }
            }
        }
        let closed = processes.closed();
        closed.map(|process| format!("process {process} cannot be inspected"))
    }
}

/// Returns Fast DDS's libraries in the usual directories of this host, not of containers.
fn installed() -> Vec<PathBuf> {
    let mut directories: Vec<_> = INSTALLED.iter().map(PathBuf::from).collect();
    let distributions = fs::read_dir(DISTRIBUTIONS).into_iter().flatten().flatten();
    directories.extend(
        distributions
            .take(MAX_LIBRARIES)
            .map(|entry| entry.path().join("lib")),
    );
    let entries = directories
        .iter()
        .flat_map(fs::read_dir)
        .flatten()
        .flatten();
    let libraries = entries.filter(|entry| {
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        is_file && entry.file_name().to_str().is_some_and(is_library)
    });
    libraries.map(|entry| entry.path()).collect()
}

fn attach(probes: &mut Probes, path: &Path) -> Result<Probe, Refusal> {
    // A file whose open blocks is not a library.
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY)
        .open(path)
        .map_err(Refusal::Open)?;
    if !file.metadata().map_err(Refusal::Open)?.is_file() {
        return Err(Refusal::NoFile);
    }
    let entry = library::find(&file)?;
    Ok(probes.attach(&file, entry.offset, entry.form)?)
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd as _;

    use super::super::processes::Use;
    use super::*;
    use crate::filter::{Filter, FilterSettings};

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

    #[test]
    fn a_library_beyond_the_cap_is_reported_as_uncovered_until_another_is_no_longer_used() {
        let directory = tempfile::tempdir().unwrap();
        for number in 0..=MAX_LIBRARIES {
            let path = directory.path().join(format!("library.{number}"));
            fs::write(&path, library::tests::library()).unwrap();
            map(&fs::File::open(&path).unwrap());
        }
        // Other tests expect this process not to use Fast DDS.
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let mut used = Use::parse(&maps.replace("/library.", "/libfastdds.so."));
        assert_eq!(used.libraries.len(), MAX_LIBRARIES + 1);
        let process = std::process::id();
        let all = Processes::of(process, used.clone());
        let (_filter, probes) = Filter::load_uprobe(&FilterSettings::default(), None)
            .expect("loading the kernel filter needs root: run the tests with sudo");
        let mut attachments = Attachments {
            probes,
            libraries: BTreeMap::new(),
        };
        let start = Instant::now();
        attachments.follow(&all, start);
        attachments.follow(&all, start + RETRY);
        let facts = attachments.facts(&all);
        assert_eq!(facts.libraries.len(), MAX_LIBRARIES);
        let refused = facts.libraries.iter().find_map(|each| each.refused.clone());
        assert_eq!(refused, None);
        let uncovered = facts.uncovered.unwrap();
        assert!(
            uncovered.ends_with(": too many libraries are in use"),
            "{uncovered}"
        );

        // The last one has no probe; the first is detached, and its place is used.
        used.libraries.remove(0);
        let fewer = Processes::of(process, used);
        let later = start + RETRY + LINGER + EVERY;
        attachments.follow(&fewer, later);
        attachments.follow(&fewer, later + EVERY);
        let facts = attachments.facts(&fewer);
        assert_eq!(facts.libraries.len(), MAX_LIBRARIES);
        assert_eq!(facts.uncovered, None);
    }
}
