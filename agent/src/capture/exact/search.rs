//! The thread that follows which libraries are in use, and attaches to them.
//!
//! Attached once to a file, a probe is in every process that maps it, also in those that come later.
//! A library that nobody uses any more is let go after a while: a robot that is started again is
//! seen from its first message on. It reads `/proc` and library files, and writes nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::library::{self, LibraryError};
use super::processes::{LibraryId, Mapped, Processes};
use crate::capture::filter::{FilterError, Probe, Probes};
use crate::capture::live::in_words;
use crate::capture::shm::scan::{Name, Places, Scope};
use crate::capture::system::DirectoryWatch;
use crate::privilege;

/// How often processes are gone through when nothing happens.
const EVERY: Duration = Duration::from_secs(1);
/// A participant that starts creates several files at once.
const GATHER: Duration = Duration::from_millis(20);
/// How long a library that nobody uses stays attached.
const LINGER: Duration = Duration::from_secs(60);
/// How long one that could not be attached to is not tried again.
const RETRY: Duration = Duration::from_secs(5);
/// Libraries with a probe of their own: images of containers on one host.
const MAX_LIBRARIES: usize = 64;

/// The thread, from the outside.
pub struct Search {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// What is attached, and what is not covered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Facts {
    /// Libraries in use.
    pub libraries: Vec<LibraryFacts>,
    /// Why some process may send what is not seen this way; `None` = none does.
    pub uncovered: Option<String>,
}

/// One library.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LibraryFacts {
    /// Its name in the file system of a process that uses it.
    pub path: PathBuf,
    /// Processes that use it.
    pub processes: usize,
    /// Why it is not attached to.
    pub refused: Option<String>,
}

#[derive(Default)]
struct Shared {
    facts: Mutex<Facts>,
    covers_all: AtomicBool,
    stop: AtomicBool,
}

/// All libraries that were met.
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
}

/// Why a library is not attached to.
#[derive(Debug, thiserror::Error)]
enum Refusal {
    #[error("it cannot be opened")]
    Open(#[source] io::Error),
    #[error("it is no file")]
    NoFile,
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error(transparent)]
    Probe(#[from] FilterError),
}

/// Nobody has looked yet.
impl Default for Facts {
    fn default() -> Self {
        Self {
            libraries: Vec::new(),
            uncovered: Some("processes have not been looked at yet".to_owned()),
        }
    }
}

impl Search {
    /// Starts looking. The thread has the capabilities of the caller, and gives up all it does not
    /// need; the caller may give up all of them.
    ///
    /// # Errors
    /// There can be no more threads.
    pub fn start(probes: Probes, scope: Scope) -> io::Result<Self> {
        let shared = Arc::<Shared>::default();
        let thread = std::thread::Builder::new()
            .name("exact".to_owned())
            .spawn({
                let shared = Arc::clone(&shared);
                move || follow(&shared, probes, scope)
            })?;
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    /// What is attached, and what is not covered.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let facts = self.shared.facts.lock();
        facts.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Whether every process that uses Fast DDS's shared memory is seen.
    #[must_use]
    pub fn covers_all(&self) -> bool {
        self.shared.covers_all.load(Ordering::Acquire)
    }
}

impl Drop for Search {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // It wakes within a second otherwise, and nobody waits for that long at the end.
            thread.thread().unpark();
            drop(thread);
        }
    }
}

/// The thread.
fn follow(shared: &Shared, probes: Probes, scope: Scope) {
    if let Err(error) = privilege::keep_for_probes() {
        tracing::warn!(%error, "looking at processes with more privileges than that takes");
    }
    let mut attachments = Attachments {
        probes,
        libraries: BTreeMap::new(),
    };
    let mut processes = Processes::new(scope.clone());
    let mut places = Places::new(scope);
    // Without it, a participant that starts is noticed within a second.
    let mut watch = DirectoryWatch::new().ok();
    let mut watched = BTreeSet::new();
    let (mut somebody_came, mut asked_all) = (true, None::<Instant>);
    while !shared.stop.load(Ordering::Acquire) {
        let now = Instant::now();
        let all = somebody_came && asked_all.is_none_or(|at| now - at >= EVERY);
        if all {
            asked_all = Some(now);
        }
        processes.find(all);
        attachments.follow(&processes, now);
        shared.tell(attachments.facts(&processes));
        let Some(watch) = &mut watch else {
            std::thread::park_timeout(EVERY);
            continue;
        };
        places.find();
        let directories = places.places.values().map(|place| place.path.clone());
        let directories: BTreeSet<_> = directories.collect();
        for new in directories.difference(&watched) {
            watch.add(new);
        }
        watched = directories;
        somebody_came = watch.wait(EVERY, |name| Name::parse(name).is_some());
        std::thread::sleep(GATHER);
    }
}

impl Shared {
    fn tell(&self, facts: Facts) {
        self.covers_all
            .store(facts.uncovered.is_none(), Ordering::Release);
        let mut known = self.facts.lock().unwrap_or_else(PoisonError::into_inner);
        if known.uncovered != facts.uncovered {
            match &facts.uncovered {
                Some(reason) => tracing::warn!(reason, "shared memory is sampled"),
                None => tracing::info!("every message into shared memory is seen"),
            }
        }
        *known = facts;
    }
}

impl Attachments {
    /// Attaches to what is new, and lets go of what nobody has used for a while.
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
            let is_used = now - library.used < LINGER;
            if !is_used && library.probe.is_ok() {
                let library = library.path.display();
                tracing::info!(%library, "no longer attached: nobody uses it");
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
            let probe = attach(&mut self.probes, process, range);
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
            };
            self.libraries.insert(id.clone(), library);
        }
        if let Some(library) = self.libraries.get_mut(id) {
            library.processes += 1;
            library.used = now;
        }
    }

    fn facts(&self, processes: &Processes) -> Facts {
        let libraries = self.libraries.values().map(|library| LibraryFacts {
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
                    "process {process} uses Fast DDS's shared memory without a library: it is \
                     linked into it"
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
        closed.map(|process| format!("process {process} may not be looked at"))
    }
}

fn attach(probes: &mut Probes, process: u32, range: &str) -> Result<Probe, Refusal> {
    // The very file that the process maps, whatever its name means by now. One that would keep us
    // waiting is none of a library.
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY)
        .open(format!("/proc/{process}/map_files/{range}"))
        .map_err(Refusal::Open)?;
    if !file.metadata().map_err(Refusal::Open)?.is_file() {
        return Err(Refusal::NoFile);
    }
    let entry = library::find(&file)?;
    Ok(probes.attach(&file, entry.offset, entry.form)?)
}
