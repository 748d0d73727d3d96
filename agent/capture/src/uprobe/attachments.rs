//! Probes in the libraries that processes use.
//!
//! A probe attached to a file is active in every process that maps the file, including later ones.
//! The probe of an unused library is removed only after a while, so that a restarted robot is seen
//! from its first message.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use ros2probe_attach::client::{Broker, BrokerError};
use ros2probe_attach::functions::Library;
use ros2probe_attach::mapped::{LibraryId, Mapped};
use ros2probe_attach::open::installed;
use ros2probe_attach::request::Place;

use super::processes::Processes;
use crate::error_chain::Reason;
use crate::tables::Libraries;
use ros2probe_model::facts::bounded::Bounded;

/// How long an unused library stays attached.
pub const DETACH_DELAY: Duration = Duration::from_secs(60);
/// Pause before another attempt to attach to a library.
pub const RETRY_DELAY: Duration = Duration::from_secs(5);
/// All known libraries, with a probe `P` in each.
pub struct Attachments<P> {
    attach: Attach<P>,
    meaning: &'static str,
    libraries: Bounded<Libraries, BTreeMap<LibraryId, Known<P>>>,
    /// Whether installed libraries have been attached in advance.
    is_installed: bool,
}

/// Function that lets the broker attach a probe to a library.
pub type Attach<P> = Box<dyn FnMut(&mut Broker, Place) -> Result<P, Refusal> + Send>;

struct Known<P> {
    path: PathBuf,
    probe: Result<P, Reason>,
    processes: usize,
    used: Instant,
    tried: Instant,
    /// Whether the probe was attached before any process used the library, and is kept.
    is_installed: bool,
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
            is_installed: false,
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
        self.is_installed = false;
    }

    /// Attaches to installed libraries that no process uses yet, once after the creation and after
    /// each [`Self::clear`]. Without an answer of the broker, the next call tries again.
    pub fn install(&mut self, library: Library, now: Instant, broker: &mut Broker) {
        if self.is_installed {
            return;
        }
        self.is_installed = true;
        for path in installed(library) {
            let Ok(metadata) = fs::metadata(&path) else {
                continue;
            };
            let device = metadata.dev();
            let id = LibraryId {
                device: format!("{:02x}:{:02x}", libc::major(device), libc::minor(device)),
                inode: metadata.ino(),
            };
            if self.libraries.contains_key(&id) || self.libraries.is_full() {
                continue;
            }
            match (self.attach)(broker, Place::Installed(path.clone())) {
                Ok(probe) => {
                    tracing::info!(library = %path.display(), "uprobe attached in advance");
                    let library = Known {
                        path,
                        probe: Ok(probe),
                        processes: 0,
                        used: now,
                        tried: now,
                        is_installed: true,
                    };
                    self.libraries.insert(id, library);
                }
                // The refusal is reported when a process uses the library.
                Err(Refusal::Broker(BrokerError::Refused(_)) | Refusal::Program(_)) => {}
                Err(Refusal::Broker(_)) => {
                    self.is_installed = false;
                    return;
                }
            }
        }
    }

    /// Attaches to new libraries, and detaches from libraries that have been unused for a while.
    pub fn follow(&mut self, processes: &Processes, now: Instant, broker: &mut Broker) {
        for library in self.libraries.values_mut() {
            library.processes = 0;
        }
        for (process, used) in processes.using() {
            for mapped in &used.libraries {
                self.attach_mapped(mapped, process, now, broker);
            }
        }
        self.libraries.retain(|_, library| {
            let is_used = library.is_installed || now - library.used < DETACH_DELAY;
            if !is_used && library.probe.is_ok() {
                let library = library.path.display();
                tracing::info!(%library, "uprobe detached: the library is no longer in use");
            }
            is_used
        });
    }

    fn attach_mapped(&mut self, mapped: &Mapped, process: u32, now: Instant, broker: &mut Broker) {
        let Mapped { id, path, .. } = mapped;
        let is_known = self
            .libraries
            .get(id)
            .is_some_and(|known| known.probe.is_ok() || now - known.tried < RETRY_DELAY);
        if !is_known && (self.libraries.contains_key(id) || !self.libraries.is_full()) {
            let id = id.clone();
            let probe = (self.attach)(broker, Place::Mapped { process, id });
            let probe = probe.map_err(|refusal| Reason::of(&refusal));
            let (library, is_new) = (path.display(), !self.libraries.contains_key(&mapped.id));
            match &probe {
                Ok(_) => tracing::info!(%library, "attached: {}", self.meaning),
                Err(reason) if is_new => {
                    tracing::warn!(%library, reason = reason.as_str(), "not attached");
                }
                Err(_) => {}
            }
            let library = Known {
                path: path.clone(),
                probe,
                processes: 0,
                used: now,
                tried: now,
                is_installed: false,
            };
            self.libraries.insert(mapped.id.clone(), library);
        }
        if let Some(library) = self.libraries.get_mut(&mapped.id) {
            library.processes += 1;
            library.used = now;
        }
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
