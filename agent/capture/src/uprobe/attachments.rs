//! Probes in the libraries that processes use.
//!
//! A probe attached to a file is active in every process that maps the file, including later ones.
//! The probe of an unused library is removed only after a while, so that a restarted robot is seen
//! from its first message.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ros2probe_attach::client::{Broker, BrokerError};
use ros2probe_attach::functions::Library;
use ros2probe_attach::mapped::{LibraryId, Mapped};
use ros2probe_attach::open::installed;
use ros2probe_attach::request::Place;

use super::library_id::id_as_mapped;
use super::processes::Processes;
use crate::error_chain::Reason;
use crate::tables::Libraries;
use ros2probe_model::facts::bounded::Bounded;

/// How long an unused library stays attached.
pub const DETACH_DELAY: Duration = Duration::from_secs(60);
/// Pause before another attempt to attach to a library. It doubles with each refusal, up to
/// [`LONGEST_RETRY_DELAY`].
pub const RETRY_DELAY: Duration = Duration::from_secs(5);
const LONGEST_RETRY_DELAY: Duration = Duration::from_secs(320);
/// Time of failed attempts after which the other libraries wait for the next call. The broker may
/// need seconds for each refusal.
const FAILURE_TIME: Duration = Duration::from_secs(2);
/// Time without a change after which a file that changed gets a probe again.
const SETTLING_TIME: Duration = Duration::from_secs(1);
/// Time after a change in which installed libraries are searched again: a copy may take long, and
/// a package manager removes a library some seconds before it installs the next one.
const UPGRADE_TIME: Duration = Duration::from_secs(60);
/// Why a library has no probe in that time.
const CHANGED: &str = "the file of the library has changed";
/// All known libraries, with a probe `P` in each.
pub struct Attachments<P> {
    attach: Attach<P>,
    meaning: &'static str,
    libraries: Bounded<Libraries, BTreeMap<LibraryId, Known<P>>>,
    /// Time of the next search for installed libraries; `None` if all are attached.
    next_search: Option<Instant>,
    /// Time until which the search is repeated.
    searched_until: Instant,
}

/// Function that lets the broker attach a probe to a library.
pub type Attach<P> = Box<dyn FnMut(&mut Broker, Place) -> Result<P, Refusal> + Send>;

struct Known<P> {
    path: PathBuf,
    probe: Result<P, Reason>,
    processes: usize,
    used: Instant,
    /// Time after which another attempt is made, and the pause before it.
    retried: Instant,
    pause: Duration,
    /// Version of the file when the probe was attached; `None` if the path leads to another file
    /// here.
    version: Option<Version>,
    /// Whether the probe was attached before any process used the library, and is kept.
    is_installed: bool,
}

/// Attributes of a file that change when it is written, or replaced by another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Version {
    file: (u64, u64),
    bytes: u64,
    modified: (i64, i64),
    changed: (i64, i64),
}

impl Version {
    /// Returns the version of the file at a path; `None` without such a file.
    fn of(path: &Path) -> Option<Self> {
        let metadata = fs::metadata(path).ok()?;
        Some(Self {
            file: (metadata.dev(), metadata.ino()),
            bytes: metadata.size(),
            modified: (metadata.mtime(), metadata.mtime_nsec()),
            changed: (metadata.ctime(), metadata.ctime_nsec()),
        })
    }
}

/// Why a library has no probe.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// The broker refuses, or cannot be reached.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// A program is not loaded.
    #[error(transparent)]
    Program(Box<dyn std::error::Error + Send + Sync>),
}

/// State of one library.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LibraryFacts {
    /// Path of the library in the file system of a process that uses it.
    pub path: PathBuf,
    /// Number of processes that use it.
    pub processes: usize,
    /// Why the library has no probe; `None` if it has one.
    pub refused: Option<String>,
}

impl<P> Attachments<P> {
    /// Creates a table without libraries. `meaning` is the log text for an attached library.
    #[must_use]
    pub fn new(meaning: &'static str, attach: Attach<P>) -> Self {
        Self {
            attach,
            meaning,
            libraries: Bounded::default(),
            next_search: Some(Instant::now()),
            searched_until: Instant::now(),
        }
    }

    /// Returns the probe of a library, or why it has none; `None` if the library is not known.
    #[must_use]
    pub fn probe(&self, id: &LibraryId) -> Option<&Result<P, Reason>> {
        self.libraries.get(id).map(|library| &library.probe)
    }

    /// Detaches from all libraries.
    pub fn clear(&mut self) {
        self.libraries.clear();
        self.next_search = Some(Instant::now());
    }

    /// Returns whether installed libraries have been attached in advance.
    #[must_use]
    pub const fn is_installed(&self) -> bool {
        self.next_search.is_none()
    }

    /// Returns whether [`Self::install`] would search for installed libraries.
    #[must_use]
    pub fn is_search_due(&self, now: Instant) -> bool {
        self.next_search.is_some_and(|due| now >= due)
    }

    /// Detaches from libraries whose files have changed: their functions may have moved, and a
    /// breakpoint elsewhere can crash a process. [`Self::install`] and [`Self::follow`] attach again
    /// a second after the last change. Returns whether a probe was detached.
    pub fn detach_changed(&mut self, now: Instant) -> bool {
        let (mut detached, mut is_any_installed) = (false, false);
        for library in self.libraries.values_mut() {
            let Some(known) = library.version else {
                continue;
            };
            let version = Version::of(&library.path);
            if version == Some(known) {
                continue;
            }
            is_any_installed |= library.is_installed;
            library.version = version.filter(|version| version.file == known.file);
            if library.version.is_none() {
                // Processes may still use the old file, which does not change.
                library.is_installed = false;
                library.used = now;
                continue;
            }
            if library.probe.is_ok() {
                let path = library.path.display();
                tracing::warn!(library = %path, "uprobe detached: the library's file has changed");
                detached = true;
            }
            library.probe = Err(Reason(CHANGED.to_owned()));
            library.retried = now + SETTLING_TIME;
        }
        if is_any_installed || detached {
            self.next_search = Some(now + SETTLING_TIME);
            self.searched_until = now + UPGRADE_TIME;
        }
        detached
    }

    /// Attaches to installed libraries that no process uses yet: once after the creation and after
    /// each [`Self::clear`], and repeatedly after a change. Without an answer of the broker, the next
    /// call tries again.
    pub fn install(&mut self, library: Library, now: Instant, broker: &mut Broker) {
        if self.is_search_due(now) {
            self.attach_in_advance(installed(library), now, broker);
        }
    }

    fn attach_in_advance(&mut self, paths: Vec<PathBuf>, now: Instant, broker: &mut Broker) {
        self.next_search = (now < self.searched_until).then(|| now + RETRY_DELAY);
        for path in paths {
            // The version is read first, so that a change in the meantime is noticed.
            let (Some(version), Ok(id)) = (Version::of(&path), id_as_mapped(&path)) else {
                continue;
            };
            let is_full = self.libraries.is_full();
            match self.libraries.get_mut(&id) {
                Some(known) if known.probe.is_ok() => {
                    if !known.is_installed {
                        (known.path, known.version) = (path, Some(version));
                        known.is_installed = true;
                    }
                    continue;
                }
                // The process that uses it leads to the next attempt.
                Some(known) if known.processes > 0 => continue,
                Some(known) if now < known.retried => {
                    self.next_search = Some(known.retried);
                    continue;
                }
                None if is_full => continue,
                Some(_) | None => {}
            }
            match (self.attach)(broker, Place::Installed(path.clone())) {
                Ok(probe) => {
                    tracing::info!(library = %path.display(), "uprobe attached in advance");
                    let library = Known {
                        path,
                        probe: Ok(probe),
                        processes: 0,
                        used: now,
                        retried: now,
                        pause: RETRY_DELAY,
                        version: Some(version),
                        is_installed: true,
                    };
                    self.libraries.insert(id, library);
                }
                // The refusal is reported when a process uses the library.
                Err(Refusal::Broker(BrokerError::Refused(_)) | Refusal::Program(_)) => {}
                Err(Refusal::Broker(_)) => {
                    self.next_search = Some(now);
                    return;
                }
            }
        }
        for library in self.libraries.values_mut() {
            // The library was refused, or it is no longer among the installed ones.
            if library.is_installed && library.probe.is_err() && now >= library.retried {
                library.is_installed = false;
                library.used = now;
            }
        }
    }

    /// Returns whether no further library can be attached.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.libraries.is_full()
    }

    /// Attaches to new libraries, and detaches from libraries that have been unused for a while.
    /// After some seconds of failed attempts, the remaining libraries wait for the next call.
    pub fn follow(&mut self, processes: &Processes, now: Instant, broker: &mut Broker) {
        for library in self.libraries.values_mut() {
            library.processes = 0;
        }
        let began = Instant::now();
        let mut failed = Duration::ZERO;
        for (process, used) in processes.using() {
            for mapped in &used.libraries {
                let now = now + began.elapsed();
                if failed < FAILURE_TIME {
                    failed += self.try_attach(mapped, process, now, broker);
                }
                if let Some(library) = self.libraries.get_mut(&mapped.id) {
                    library.processes += 1;
                    library.used = now;
                }
            }
        }
        let now = now + began.elapsed();
        self.libraries.retain(|_, library| {
            let is_used = library.is_installed || now - library.used < DETACH_DELAY;
            if !is_used && library.probe.is_ok() {
                let library = library.path.display();
                tracing::info!(%library, "uprobe detached: the library is no longer in use");
            }
            is_used
        });
    }

    /// Attaches to a library if an attempt is due. Returns the time that a failed attempt took.
    fn try_attach(
        &mut self,
        mapped: &Mapped,
        process: u32,
        now: Instant,
        broker: &mut Broker,
    ) -> Duration {
        let Mapped { id, path, .. } = mapped;
        let known = self.libraries.get(id);
        let is_due = match known {
            Some(known) => known.probe.is_err() && now >= known.retried,
            None => !self.libraries.is_full(),
        };
        if !is_due {
            return Duration::ZERO;
        }
        let (earlier, processes) = known.map(|known| (known.pause, known.processes)).unzip();
        // In the process's file system, the path may lead to another file.
        let installed = known.filter(|known| known.is_installed);
        let is_installed = installed.is_some();
        let path = installed.map_or(path, |known| &known.path).clone();
        let version = Version::of(&path).filter(|version| version.file.1 == id.inode);
        let began = Instant::now();
        let place = Place::Mapped {
            process,
            id: id.clone(),
        };
        let probe = (self.attach)(broker, place);
        let spent = began.elapsed();
        let pause = match (&probe, earlier) {
            // Without a broker, nothing is known about the library.
            (Err(Refusal::Broker(BrokerError::Refused(_))), Some(earlier)) => {
                (earlier * 2).min(LONGEST_RETRY_DELAY)
            }
            _ => RETRY_DELAY,
        };
        let probe = probe.map_err(|refusal| Reason::of(&refusal));
        let library = path.display();
        match &probe {
            Ok(_) => tracing::info!(%library, "attached: {}", self.meaning),
            Err(reason) if earlier.is_none() => {
                tracing::warn!(%library, reason = reason.as_str(), "not attached");
            }
            Err(_) => {}
        }
        let failed = match probe {
            Ok(_) => Duration::ZERO,
            Err(_) => spent,
        };
        let library = Known {
            path,
            probe,
            processes: processes.unwrap_or_default(),
            used: now,
            retried: now + spent + pause,
            pause,
            version,
            is_installed,
        };
        self.libraries.insert(id.clone(), library);
        failed
    }

    /// Returns facts about the libraries in use.
    #[must_use]
    pub fn facts(&self) -> Vec<LibraryFacts> {
        let in_use = |library: &&Known<P>| library.processes > 0;
        let libraries = self.libraries.values().filter(in_use);
        let libraries = libraries.map(|library| LibraryFacts {
            path: library.path.clone(),
            processes: library.processes,
            refused: library.probe.as_ref().err().map(Reason::to_string),
        });
        libraries.collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use ros2probe_attach::mapped;

    use super::*;

    /// Attachments whose attempts take `time` each and are refused, and the number of attempts.
    fn refused(time: Duration) -> (Attachments<()>, Arc<AtomicU32>) {
        let attempts = Arc::<AtomicU32>::default();
        let counter = Arc::clone(&attempts);
        let attach: Attach<()> = Box::new(move |_, _| {
            std::thread::sleep(time);
            counter.fetch_add(1, Ordering::Relaxed);
            Err(BrokerError::Refused("blocked".to_owned()).into())
        });
        (Attachments::new("", attach), attempts)
    }

    fn id(inode: u64) -> LibraryId {
        LibraryId {
            device: "fe:00".to_owned(),
            inode,
        }
    }

    fn processes(libraries: u64) -> Processes {
        let libraries = (1..=libraries).map(|inode| Mapped {
            id: id(inode),
            path: "/libtracetools.so".into(),
            range: String::new(),
        });
        let used = mapped::Use {
            libraries: libraries.collect(),
            shares: false,
        };
        Processes::of(std::process::id(), used.into())
    }

    #[test]
    fn libraries_that_are_slow_to_refuse_delay_the_caller_for_seconds_only() {
        let (mut attachments, attempts) = refused(FAILURE_TIME * 11 / 20);
        let (processes, broker) = (processes(4), &mut Broker::here());
        attachments.follow(&processes, Instant::now(), broker);
        assert_eq!(attempts.load(Ordering::Relaxed), 2);
        // The first two have paused for less than their time since they were refused.
        attachments.follow(&processes, Instant::now(), broker);
        assert_eq!(attempts.load(Ordering::Relaxed), 4);
        assert_eq!(attachments.facts().len(), 4);
    }

    /// Attachments that count their attempts, with an installed library at `path`. Its probe is a
    /// second reference to the counter.
    fn with_installed(path: &Path) -> (Attachments<Arc<AtomicU32>>, Arc<AtomicU32>) {
        let attempts = Arc::<AtomicU32>::default();
        let counter = Arc::clone(&attempts);
        let attach: Attach<Arc<AtomicU32>> = Box::new(move |_, _| {
            counter.fetch_add(1, Ordering::Relaxed);
            Ok(Arc::clone(&counter))
        });
        let mut attachments = Attachments::new("", attach);
        let now = Instant::now();
        let library = Known {
            path: path.to_owned(),
            probe: Ok(Arc::clone(&attempts)),
            processes: 0,
            used: now,
            retried: now,
            pause: RETRY_DELAY,
            version: Version::of(path),
            is_installed: true,
        };
        attachments.libraries.insert(id(1), library);
        attachments.next_search = None;
        (attachments, attempts)
    }

    fn is_attached(attachments: &Attachments<Arc<AtomicU32>>) -> bool {
        attachments.probe(&id(1)).is_some_and(Result::is_ok)
    }

    #[test]
    fn an_installed_library_that_is_written_in_place_has_no_probe_until_it_is_complete() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("libtracetools.so");
        fs::write(&path, "first").unwrap();
        let (mut attachments, attempts) = with_installed(&path);
        let (processes, broker) = (processes(1), &mut Broker::here());
        let start = Instant::now();
        assert!(!attachments.detach_changed(start));
        assert!(is_attached(&attachments) && attachments.is_installed());

        let probes = Arc::strong_count(&attempts);
        for (text, tenths) in [("sec", 0), ("second", 5)] {
            fs::write(&path, text).unwrap();
            let now = start + Duration::from_millis(100 * tenths);
            assert_eq!(attachments.detach_changed(now), tenths == 0);
            assert!(!is_attached(&attachments) && !attachments.is_installed());
            assert_eq!(Arc::strong_count(&attempts), probes - 1, "detached");
            attachments.follow(&processes, now, broker);
        }
        let nearly = start + Duration::from_millis(1400);
        assert!(!attachments.detach_changed(nearly) && !attachments.is_search_due(nearly));
        attachments.follow(&processes, nearly, broker);
        assert_eq!(attempts.load(Ordering::Relaxed), 0);
        let [facts] = &attachments.facts()[..] else {
            panic!("one library");
        };
        assert_eq!(facts.refused.as_deref(), Some(CHANGED));

        let later = start + Duration::from_millis(1500);
        assert!(attachments.is_search_due(later));
        attachments.follow(&processes, later, broker);
        assert_eq!(attempts.load(Ordering::Relaxed), 1);
        assert!(is_attached(&attachments));
        // The library stays an installed one.
        assert!(attachments.libraries[&id(1)].is_installed);
    }

    #[test]
    fn an_installed_library_that_another_file_replaces_keeps_its_probe_for_a_while() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("libtracetools.so");
        fs::write(&path, "first").unwrap();
        let (mut attachments, _) = with_installed(&path);
        let new = path.with_extension("new");
        fs::write(&new, "second").unwrap();
        fs::rename(new, &path).unwrap();
        let start = Instant::now();
        assert!(!attachments.detach_changed(start));
        assert!(is_attached(&attachments) && !attachments.is_installed());
        assert!(attachments.is_search_due(start + SETTLING_TIME));
        let (no_processes, broker) = (processes(0), &mut Broker::here());
        attachments.follow(&no_processes, start, broker);
        assert!(is_attached(&attachments));
        attachments.follow(&no_processes, start + DETACH_DELAY, broker);
        assert!(attachments.probe(&id(1)).is_none());
    }

    #[test]
    fn a_changed_library_that_is_refused_is_tried_for_a_minute_and_then_forgotten() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("libtracetools.so");
        fs::write(&path, "half").unwrap();
        let (mut attachments, attempts) = refused(Duration::ZERO);
        let broker = &mut Broker::here();
        let start = Instant::now();
        attachments.attach_in_advance(vec![path.clone()], start, broker);
        assert_eq!(attempts.load(Ordering::Relaxed), 1);
        assert!(
            attachments.is_installed(),
            "a refusal at the start is final"
        );

        let library = Known {
            path: path.clone(),
            probe: Err(Reason(CHANGED.to_owned())),
            processes: 0,
            used: start,
            retried: start,
            pause: RETRY_DELAY,
            version: None,
            is_installed: true,
        };
        attachments
            .libraries
            .insert(id_as_mapped(&path).unwrap(), library);
        attachments.next_search = Some(start);
        attachments.searched_until = start + UPGRADE_TIME;
        let mut searches = 0;
        let before = attempts.load(Ordering::Relaxed);
        for second in 0..600 {
            let now = start + Duration::from_secs(second);
            if attachments.is_search_due(now) {
                attachments.attach_in_advance(vec![path.clone()], now, broker);
                searches += 1;
            }
            attachments.follow(&processes(0), now, broker);
        }
        assert_eq!(searches, 13);
        assert_eq!(attempts.load(Ordering::Relaxed) - before, searches);
        assert!(attachments.is_installed());
        assert!(attachments.libraries.is_empty());
    }

    #[test]
    fn a_library_in_use_is_left_when_its_file_changes_and_one_of_another_root_is_not_watched() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("libtracetools.so");
        fs::write(&path, "first").unwrap();
        let (mut attachments, _) = with_installed(&path);
        let inode = fs::metadata(&path).unwrap().ino();
        let of_process = |inode| {
            let library = Mapped {
                id: id(inode),
                path: path.clone(),
                range: String::new(),
            };
            let used = mapped::Use {
                libraries: vec![library],
                shares: false,
            };
            Processes::of(42, used.into())
        };
        let (start, broker) = (Instant::now(), &mut Broker::here());
        for id in [inode, inode + 1] {
            attachments.follow(&of_process(id), start, broker);
        }
        fs::write(&path, "second").unwrap();
        assert!(attachments.detach_changed(start));
        assert!(
            attachments.is_search_due(start + SETTLING_TIME),
            "attached again"
        );
        assert!(attachments.probe(&id(inode)).is_some_and(Result::is_err));
        assert!(attachments.probe(&id(inode + 1)).is_some_and(Result::is_ok));
    }

    #[test]
    fn the_pause_after_a_refusal_doubles_up_to_a_few_minutes() {
        let (mut attachments, attempts) = refused(Duration::ZERO);
        let (processes, broker, start) = (processes(1), &mut Broker::here(), Instant::now());
        let mut times = Vec::new();
        for second in 0..1200 {
            let before = attempts.load(Ordering::Relaxed);
            let now = start + Duration::from_millis(1000 * second);
            attachments.follow(&processes, now, broker);
            if attempts.load(Ordering::Relaxed) != before {
                times.push(second);
            }
        }
        let pauses: Vec<_> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let expected = [5, 10, 20, 40, 80, 160, 320, 320];
        let is_near = |(pause, expected): (&u64, &u64)| pause.abs_diff(*expected) <= 1;
        assert_eq!(pauses.len(), expected.len(), "{pauses:?}");
        assert!(pauses.iter().zip(&expected).all(is_near), "{pauses:?}");
    }
}
