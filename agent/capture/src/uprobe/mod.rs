//! Every message into Fast DDS's shared memory, seen in the process that sends it.
//!
//! On request only: it puts a breakpoint into code that other processes run. They notice nothing but
//! a microsecond for each message. In return nothing is sampled: the kernel program sees a message
//! before it is copied, so names, samples and losses are as exact as at a socket. It sees what is
//! handed over; what a full port or a full segment refuses afterwards it does not tell.

pub mod library;
pub mod processes;
pub mod search;

use std::fs::File;
use std::io;
use std::os::fd::BorrowedFd;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use self::search::{Facts, LibrarySearch};
use super::filter::{Filter, FilterError, FilterSettings};
use super::filter_reader::FilterReader;
use super::shm::directories::Scope;
use super::system::Clocks;
use crate::threads::Spawn;
use ros2probe_model::input::Input;
use ros2probe_model::observer::Observer;
use rustix::thread::{CapabilitySet, capabilities};

/// A process hands over a hundred thousand messages a second if it can, ten times what a socket
/// takes: its ring is larger by this.
const RECORD_RINGS: usize = 4;

/// Why messages are not seen in the processes that send them.
#[derive(Debug, thiserror::Error)]
pub enum UprobeError {
    /// Breakpoints in other processes, and looking which processes there are.
    #[error("it needs {0}")]
    Missing(String),
    /// The control group.
    #[error("the cgroup {} cannot be inspected", path.display())]
    Cgroup {
        /// Its directory.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The kernel does not tell a program which control group a process is in.
    #[error("for one control group (capture.cgroup) it takes Linux 5.16")]
    Scope(#[source] FilterError),
    /// The kernel programs.
    #[error(transparent)]
    Filter(#[from] FilterError),
}

/// Capabilities that uprobes in other processes need. `CAP_PERFMON` alone sufficed from Linux 5.8 on,
/// and later kernels refuse it. Reading which files the processes of other users map needs both.
const REQUIRED: [(CapabilitySet, &str); 2] = [
    (CapabilitySet::SYS_ADMIN, "CAP_SYS_ADMIN"),
    (CapabilitySet::SYS_PTRACE, "CAP_SYS_PTRACE"),
];

/// Capabilities that attaching uprobes needs.
#[must_use]
pub fn required() -> CapabilitySet {
    REQUIRED.iter().map(|(one, _)| *one).collect()
}

/// Names of the capabilities that attaching uprobes needs and `effective` lacks.
#[must_use]
pub fn lacking(effective: CapabilitySet) -> Vec<&'static str> {
    let lacking = REQUIRED.iter().filter(|(one, _)| !effective.contains(*one));
    lacking.map(|(_, name)| *name).collect()
}

/// What the calling thread lacks; nothing when its capabilities cannot be read.
fn missing() -> Vec<&'static str> {
    capabilities(None).map_or_else(|_| Vec::new(), |sets| lacking(sets.effective))
}

/// The kernel programs and the thread that attaches them.
pub struct Uprobe {
    reader: FilterReader,
    search: LibrarySearch,
    was_attached: bool,
}

impl Uprobe {
    /// Loads the programs. Attaches them to installed libraries, or with `on_demand` to none before
    /// [`Self::want`]. `cgroup`: only for processes of this control group.
    ///
    /// # Errors
    /// A capability is missing, or the kernel has no uprobes.
    pub fn open(
        cgroup: Option<&Path>,
        ring_bytes: usize,
        record_ring_bytes: usize,
        on_demand: bool,
    ) -> Result<Self, UprobeError> {
        let missing = missing();
        if !missing.is_empty() {
            return Err(UprobeError::Missing(missing.join(" and ")));
        }
        let within = cgroup.map(inode).transpose()?;
        let size = |bytes| u32::try_from(bytes).unwrap_or(u32::MAX >> 1);
        let settings = FilterSettings {
            record_ring_bytes: size(record_ring_bytes.saturating_mul(RECORD_RINGS)),
            piece_ring_bytes: size(ring_bytes),
            ..FilterSettings::default()
        };
        let loaded = Filter::load_uprobe(&settings, within);
        let (filter, probes) = loaded.map_err(|error| match error {
            FilterError::Program(_) if within.is_some() => UprobeError::Scope(error),
            error => error.into(),
        })?;
        let scope = cgroup.map_or(Scope::AllProcesses, |path| {
            Scope::Cgroup(path.to_path_buf())
        });
        Ok(Self {
            reader: FilterReader::new(filter),
            search: LibrarySearch::new(probes, scope, on_demand),
            was_attached: false,
        })
    }

    /// Looks for more libraries to attach them to from now on, in a thread that keeps the privileges
    /// for that.
    ///
    /// # Errors
    /// There can be no more threads.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        self.search.start(spawn)
    }

    /// Readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.reader.descriptors()
    }

    /// Whether every sample is wanted of a writer that may send into shared memory. Matters where
    /// the programs are attached on demand alone.
    pub fn want(&self, wanted: bool) {
        self.search.want(wanted);
    }

    /// Gives the model what was found, and once the programs are no longer attached, that nothing
    /// more is found.
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        let is_attached = self.search.is_attached();
        self.reader.poll(clocks, observer);
        if self.was_attached && !is_attached {
            self.reader.drain(clocks, observer);
            observer.input(Input::ProbesDetached);
        }
        self.was_attached = is_attached;
    }

    /// Gives the model what still waits, at the end.
    pub fn drain(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.reader.drain(clocks, observer);
    }

    /// The kernel programs' maps.
    #[must_use]
    pub const fn filter(&self) -> &Filter {
        self.reader.filter()
    }

    /// The kernel programs' maps, to tell them what is of interest.
    pub const fn filter_mut(&mut self) -> &mut Filter {
        self.reader.filter_mut()
    }

    /// What was taken in so far.
    #[must_use]
    pub const fn reader(&self) -> &FilterReader {
        &self.reader
    }

    /// What is attached, and what is not covered.
    #[must_use]
    pub fn facts(&self) -> Facts {
        self.search.facts()
    }

    /// Whether every process that uses Fast DDS's shared memory is seen this way.
    #[must_use]
    pub fn covers_all(&self) -> bool {
        self.search.covers_all()
    }
}

/// A control group's number: the inode of its directory.
fn inode(path: &Path) -> Result<u64, UprobeError> {
    let metadata = File::open(path).and_then(|directory| directory.metadata());
    let metadata = metadata.map_err(|source| UprobeError::Cgroup {
        path: path.to_path_buf(),
        source,
    })?;
    Ok(metadata.ino())
}
