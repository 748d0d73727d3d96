//! Every message into Fast DDS's shared memory, read in the process that sends it.
//!
//! A breakpoint in the code of other processes costs them some microseconds per message. By default
//! it exists while processes start, because they announce their names once, and while a client
//! reads messages. In these times nothing is sampled, because the kernel program reads a message
//! before it is copied. Names, samples and losses are as exact as at a socket. The program sees
//! every message passed to the transport, even if a full port or segment then refuses it.

pub mod attachments;
pub mod library_id;
pub mod processes;
pub mod search;

use std::fs::File;
use std::io;
use std::os::fd::BorrowedFd;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use self::search::{Facts, LibrarySearch};
use super::breakpoints::AttachMethod;
use super::filter::{Filter, FilterError, FilterSettings};
use super::filter_reader::FilterReader;
use super::reorder_buffer::ReorderBuffer;
use super::shm::directories::Scope;
use super::system::Clocks;
use crate::container::{add, is_service};
use crate::threads::Spawn;
use ros2probe_attach::client::{Broker, is_listening};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use rustix::thread::{CapabilitySet, capabilities};

/// Factor of the rings' sizes. A process can write a hundred thousand messages per second, ten
/// times the rate of a socket. It writes a whole image at the speed of memory.
const RING_FACTOR: usize = 4;
/// Maximum size to which the ring of captured messages is enlarged, in bytes.
const LARGE_RING: usize = 16 << 20;

/// Why messages cannot be read in the processes that send them.
#[derive(Debug, thiserror::Error)]
pub enum UprobeError {
    /// The broker, a child of this process, cannot be started.
    #[error("the broker that attaches breakpoints cannot be started")]
    Start(#[source] io::Error),
    /// The control group cannot be inspected.
    #[error("the cgroup {} cannot be inspected", path.display())]
    Cgroup {
        /// Path of its directory.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        source: io::Error,
    },
    /// The kernel programs identify processes by other ids than this process.
    #[error("process ids are not the host's{}", add("--pid host"))]
    OwnProcesses,
    /// The kernel does not expose a process's control group to programs.
    #[error("uprobes limited to one control group (capture.cgroup) need Linux 5.16")]
    Scope(#[source] FilterError),
    /// The kernel does not expose a process's control group to the programs inside processes.
    #[error("observing the processes of one control group (capture.cgroup) needs Linux 5.16")]
    InsideScope(#[source] FilterError),
    /// The kernel programs cannot be loaded.
    #[error(transparent)]
    Filter(#[from] FilterError),
}

/// Returns the capabilities that the broker needs, apart from those that load programs. They are
/// for events of mapped files, and for reading mapped files of other users' processes. Perf events
/// need the wider CAP_SYS_ADMIN on recent kernels.
fn required_capabilities() -> [(CapabilitySet, &'static str); 2] {
    let events = match AttachMethod::of_this_kernel() {
        AttachMethod::Links => (CapabilitySet::PERFMON, "CAP_PERFMON"),
        AttachMethod::PerfEvents => (CapabilitySet::SYS_ADMIN, "CAP_SYS_ADMIN"),
    };
    [events, (CapabilitySet::SYS_PTRACE, "CAP_SYS_PTRACE")]
}

/// Returns the capabilities that the broker can use: the required ones, and two for opening a
/// mapped file that was replaced, or that only its user may read.
#[must_use]
pub fn usable_capabilities() -> CapabilitySet {
    let required: CapabilitySet = required_capabilities()
        .iter()
        .map(|(one, _)| *one)
        .collect();
    required | CapabilitySet::CHECKPOINT_RESTORE | CapabilitySet::DAC_READ_SEARCH
}

/// Returns a client of the broker at `socket`. Without a listener there, a process with the
/// required capabilities starts the broker as a child. A service does so only as root: where an operator has
/// masked the socket, capabilities that other sources need permit no breakpoints.
///
/// # Errors
/// Fails if the child cannot be started.
pub(crate) fn broker(socket: &Path) -> Result<Broker, UprobeError> {
    let may_start = !is_service() || rustix::process::geteuid().is_root();
    match may_start && missing().is_empty() && !is_listening(socket) {
        true => Broker::start().map_err(UprobeError::Start),
        false => Ok(Broker::at(socket)),
    }
}

/// Returns the names of required capabilities that `effective` lacks.
#[must_use]
pub fn missing_capabilities(effective: CapabilitySet) -> Vec<&'static str> {
    // CAP_SYS_ADMIN includes CAP_PERFMON.
    let inherited = match effective.contains(CapabilitySet::SYS_ADMIN) {
        true => CapabilitySet::PERFMON,
        false => CapabilitySet::empty(),
    };
    let needed = required_capabilities();
    let lacking = needed
        .iter()
        .filter(|(one, _)| !(effective | inherited).contains(*one));
    lacking.map(|(_, name)| *name).collect()
}

/// Returns the missing capabilities of the calling thread; empty if its capabilities cannot be
/// read.
pub(crate) fn missing() -> Vec<&'static str> {
    capabilities(None).map_or_else(|_| Vec::new(), |sets| missing_capabilities(sets.effective))
}

/// The kernel programs and the thread that attaches them.
pub struct Uprobe {
    reader: FilterReader,
    search: LibrarySearch,
    was_attached: bool,
}

impl Uprobe {
    /// Loads the programs, and attaches them to installed libraries. With `on_demand`, they are
    /// detached while no process starts and [`Self::set_demand`] does not need them. `cgroup`
    /// restricts them to processes of this control group. `broker` is the socket of the process
    /// that attaches them.
    ///
    /// # Errors
    /// Fails if the programs may not be loaded, or if the kernel has no uprobes.
    pub fn open(
        cgroup: Option<&Path>,
        broker: &Path,
        ring_bytes: usize,
        record_ring_bytes: usize,
        on_demand: bool,
    ) -> Result<Self, UprobeError> {
        let within = cgroup.map(inode).transpose()?;
        let size = |bytes| u32::try_from(bytes).unwrap_or(u32::MAX >> 1);
        let settings = FilterSettings {
            record_ring_bytes: size(record_ring_bytes.saturating_mul(RING_FACTOR)),
            piece_ring_bytes: size(
                (ring_bytes.saturating_mul(RING_FACTOR)).min(ring_bytes.max(LARGE_RING)),
            ),
            ..FilterSettings::default()
        };
        let loaded = Filter::load_uprobe(&settings, within, AttachMethod::of_this_kernel());
        let (filter, probes) = loaded.map_err(|error| match error {
            FilterError::Program(_) if within.is_some() => UprobeError::Scope(error),
            error => error.into(),
        })?;
        let scope = cgroup.map_or(Scope::AllProcesses, |path| {
            Scope::Cgroup(path.to_path_buf())
        });
        Ok(Self {
            reader: FilterReader::new(filter, &[]),
            search: LibrarySearch::new(probes, scope, self::broker(broker)?, on_demand),
            was_attached: false,
        })
    }

    /// Starts a thread that finds further libraries and lets the broker attach to them.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(&mut self, spawn: Spawn) -> io::Result<()> {
        self.search.start(spawn)
    }

    /// Returns descriptors that are readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.reader.descriptors()
    }

    /// Sets whether every sample of a writer that may use shared memory is needed. The setting
    /// matters only if programs are attached on demand.
    pub fn set_demand(&self, wanted: bool) {
        self.search.set_demand(wanted);
    }

    /// Returns whether the programs are needed, but not yet attached in all processes that can have
    /// them.
    #[must_use]
    pub fn is_attaching(&self) -> bool {
        self.search.is_attaching()
    }

    /// Returns the buffer that orders records from polling; `None` while no process is observed.
    pub fn order_mut(&mut self) -> Option<&mut ReorderBuffer> {
        let is_attached = self.was_attached || self.search.is_attached();
        is_attached.then(|| self.reader.order_mut())
    }

    /// Passes the messages found to the model. After the programs are detached, also reports that
    /// no more will be found.
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        let is_attached = self.search.is_attached();
        self.reader.poll(clocks, observer);
        if self.was_attached && !is_attached {
            self.reader.drain(clocks, observer);
            observer.input(Input::ProbesDetached);
        }
        self.was_attached = is_attached;
    }

    /// Passes all buffered data to the model at the end.
    pub fn drain(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.reader.drain(clocks, observer);
    }

    /// Returns the kernel programs' maps.
    #[must_use]
    pub const fn filter(&self) -> &Filter {
        self.reader.filter()
    }

    /// Returns the kernel programs' maps, for setting interests.
    pub const fn filter_mut(&mut self) -> &mut Filter {
        self.reader.filter_mut()
    }

    /// Returns the reader, for its counters.
    #[must_use]
    pub const fn reader(&self) -> &FilterReader {
        &self.reader
    }

    /// Returns facts about the attached libraries, and about processes that are not covered.
    #[must_use]
    pub fn facts(&self) -> Facts {
        self.search.facts()
    }

    /// Returns for how long the thread that attaches probes has made no progress; `None` if it
    /// makes progress.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.search.stalled()
    }

    /// Returns whether every process that uses Fast DDS's shared memory is covered.
    #[must_use]
    pub fn covers_all(&self) -> bool {
        self.search.covers_all()
    }
}

/// Returns a control group's id: the inode of its directory.
pub(crate) fn inode(path: &Path) -> Result<u64, UprobeError> {
    let metadata = File::open(path).and_then(|directory| directory.metadata());
    let metadata = metadata.map_err(|source| UprobeError::Cgroup {
        path: path.to_path_buf(),
        source,
    })?;
    Ok(metadata.ino())
}
