//! This host's sockets: what any of them sends or receives, whole and in all containers, as the
//! host hook tells it.
//!
//! One tap for the host, or for one control group. Everything in the kernel vanishes with this
//! value, however the process ends. Nothing is sent, delayed or dropped.

use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};

use super::cgroup::{self, Cgroup, CgroupError};
use super::filter::{Filter, FilterError, FilterSettings};
use super::filter_reader::FilterReader;
use super::reattach::{self, Reattach};
use super::sockets::Sockets;
use super::system::Clocks;
use super::tracepoints::Abilities;
use crate::threads::Spawn;
use ros2probe_model::observer::Observer;

/// Why the host hook is not in place.
#[derive(Debug, thiserror::Error)]
pub enum HostTapError {
    /// The control group.
    #[error(transparent)]
    Hierarchy(#[from] CgroupError),
    /// The kernel programs.
    #[error(transparent)]
    Filter(#[from] FilterError),
}

/// Why the control group is not followed.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    /// The kernel programs.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// The thread.
    #[error("failed to spawn a thread")]
    Thread(#[from] std::io::Error),
}

/// Which sockets are looked at, and with how much memory.
#[derive(Clone, Debug)]
pub struct HostTapSettings {
    /// Only those of this control group and below; `None` = all.
    pub cgroup: Option<PathBuf>,
    /// Bytes of the ring for captured datagrams.
    pub ring_bytes: usize,
    /// Bytes of the record ring.
    pub record_ring_bytes: usize,
}

/// The host hook and what it found on its way to the model.
pub struct HostTap {
    cgroup: Cgroup,
    reader: FilterReader,
    sockets: Sockets,
    /// For a control group that can be removed.
    reattach: Option<Reattach>,
}

impl HostTap {
    /// Attaches the hook. When this returns, every datagram is seen.
    ///
    /// # Errors
    /// A capability is missing, or the kernel or the machine does not have what it takes.
    pub fn open(settings: &HostTapSettings) -> Result<Self, HostTapError> {
        let cgroup = match &settings.cgroup {
            Some(path) => Cgroup::open(path)?,
            None => Cgroup::topmost()?,
        };
        let size = |bytes| u32::try_from(bytes).unwrap_or(u32::MAX >> 1);
        let mut filter = Filter::load_host(&FilterSettings {
            record_ring_bytes: size(settings.record_ring_bytes),
            piece_ring_bytes: size(settings.ring_bytes),
            ..FilterSettings::default()
        })?;
        // First, so that nothing dies unseen behind the hook.
        filter.attach_tracepoints(cgroup.is_whole_host());
        filter.attach(cgroup.directory())?;
        filter.settle();
        let hierarchy = match &settings.cgroup {
            Some(path) => cgroup::mount_point().unwrap_or_else(|_| path.clone()),
            None => cgroup.path().to_path_buf(),
        };
        Ok(Self {
            sockets: Sockets::new(hierarchy),
            cgroup,
            reader: FilterReader::new(filter),
            reattach: None,
        })
    }

    /// Follows the control group from now on: the hook is attached again when the group is made
    /// anew. The topmost one stays.
    ///
    /// # Errors
    /// There can be no thread for it.
    pub fn start(&mut self, spawn: Spawn) -> Result<(), FollowError> {
        let Some(attached) = reattach::of(self.cgroup.directory()) else {
            return Ok(());
        };
        if !self.is_whole_host() {
            let links = self.filter().links()?;
            self.reattach = Some(Reattach::start(self.cgroup.path(), attached, links, spawn)?);
        }
        Ok(())
    }

    /// Why the hook is attached to nothing.
    #[must_use]
    pub fn detached(&self) -> Option<String> {
        self.reattach.as_ref()?.detached()
    }

    /// How often the hook was attached to another control group since the start.
    #[must_use]
    pub fn attached_anew(&self) -> u64 {
        self.reattach.as_ref().map_or(0, Reattach::attached_anew)
    }

    /// The control group whose sockets are looked at.
    #[must_use]
    pub fn cgroup(&self) -> &Path {
        self.cgroup.path()
    }

    /// Every socket of the host is looked at, in whatever container.
    #[must_use]
    pub const fn is_whole_host(&self) -> bool {
        self.cgroup.is_whole_host()
    }

    /// What can be told of what happens behind the hook.
    #[must_use]
    pub fn abilities(&self) -> Option<&Abilities> {
        Some(self.filter().tracepoints()?.abilities())
    }

    /// Readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.reader.descriptors()
    }

    /// Takes in all there is; see [`FilterReader::poll`].
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.reader.poll(clocks, observer);
        self.sockets
            .follow(self.reader.filter(), clocks.monotonic, observer);
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
}
