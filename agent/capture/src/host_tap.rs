//! Observes this host's sockets through the host hook: every datagram sent or received, whole and
//! in all containers.
//!
//! One tap covers the host or one control group. Its kernel state vanishes with this value, however
//! the process ends. Nothing is sent, delayed or dropped.

use std::fs::File;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::cgroup::{self, Cgroup, CgroupError};
use super::error_chain::in_words;
use super::filter::{Filter, FilterError, FilterSettings, ports};
use super::filter_reader::FilterReader;
use super::reattach::{self, Reattach};
use super::reorder_buffer::ReorderBuffer;
use super::sockets::Sockets;
use super::system::Clocks;
use super::tracepoints::Abilities;
use crate::threads::Spawn;
use ros2probe_model::observe::observer::Observer;

/// Why the host hook cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum HostTapError {
    /// The control group cannot be used.
    #[error(transparent)]
    Hierarchy(#[from] CgroupError),
    /// The kernel programs cannot be loaded or attached.
    #[error(transparent)]
    Filter(#[from] FilterError),
}

/// Why the control group cannot be followed.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    /// The kernel programs have no links.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// The thread cannot be started.
    #[error("failed to spawn a thread")]
    Thread(#[from] std::io::Error),
}

/// The observed sockets, and the memory for them.
#[derive(Clone, Debug)]
pub struct HostTapSettings {
    /// Control group that is observed, with the groups below it; `None` = all sockets.
    pub cgroup: Option<PathBuf>,
    /// Bytes of the ring for captured datagrams.
    pub ring_bytes: usize,
    /// Bytes of the record ring.
    pub record_ring_bytes: usize,
    /// TCP ports of Zenoh.
    pub zenoh_ports: Vec<u16>,
    /// Whether deliveries of messages can be followed.
    pub deliveries: bool,
}

/// The host hook and the reader of its output.
pub struct HostTap {
    cgroup: Cgroup,
    reader: FilterReader,
    sockets: Sockets,
    /// Follows a control group that may be removed.
    reattach: Option<Reattach>,
}

impl HostTap {
    /// Attaches the hook. Every datagram after this call is seen.
    ///
    /// # Errors
    /// Fails if a capability is missing, or if the kernel or the machine lacks a requirement.
    pub fn open(settings: &HostTapSettings) -> Result<Self, HostTapError> {
        let cgroup = match &settings.cgroup {
            Some(path) => Cgroup::open(path)?,
            None => Cgroup::topmost()?,
        };
        let size = |bytes| u32::try_from(bytes).unwrap_or(u32::MAX >> 1);
        let mut filter = Filter::load_host(&FilterSettings {
            record_ring_bytes: size(settings.record_ring_bytes),
            piece_ring_bytes: size(settings.ring_bytes),
            zenoh_ports: ports(&settings.zenoh_ports),
            deliveries: settings.deliveries,
            ..FilterSettings::default()
        })?;
        if let Some(Err(error)) = filter.zenoh_programs() {
            let reason = in_words(error);
            tracing::warn!(reason, "connections of Zenoh are not observed");
        }
        // The tracepoints come first, so that no loss behind the hook is missed.
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
            reader: FilterReader::new(filter, &settings.zenoh_ports),
            reattach: None,
        })
    }

    /// Starts following the control group: the hook is attached again if the group is recreated.
    /// The topmost group is not followed, because it always exists.
    ///
    /// # Errors
    /// Fails if its thread cannot be started.
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

    /// Returns why the hook is not attached; `None` while it is.
    #[must_use]
    pub fn detached(&self) -> Option<String> {
        self.reattach.as_ref()?.detached()
    }

    /// Returns for how long the thread that follows the control group has made no progress; `None`
    /// if it makes progress.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.reattach.as_ref()?.stalled()
    }

    /// Returns the number of attachments to another control group since the start.
    #[must_use]
    pub fn reattachments(&self) -> u64 {
        self.reattach.as_ref().map_or(0, Reattach::reattachments)
    }

    /// Returns the observed control group.
    #[must_use]
    pub fn cgroup(&self) -> &Path {
        self.cgroup.path()
    }

    /// Returns the open directory of the observed control group.
    #[must_use]
    pub const fn directory(&self) -> &File {
        self.cgroup.directory()
    }

    /// Returns whether every socket of the host is observed, in any container.
    #[must_use]
    pub const fn is_whole_host(&self) -> bool {
        self.cgroup.is_whole_host()
    }

    /// Returns which losses behind the hook this kernel can attribute; `None` if no tracepoint
    /// program is attached.
    #[must_use]
    pub fn abilities(&self) -> Option<&Abilities> {
        Some(self.filter().tracepoints()?.abilities())
    }

    /// Returns descriptors that are readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.reader.descriptors()
    }

    /// Reads everything available; see [`FilterReader::poll`].
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.reader.poll(clocks, observer);
        self.sockets
            .follow(self.reader.filter(), clocks.monotonic, observer);
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

    /// Returns the buffer that restores the order of records.
    pub const fn order_mut(&mut self) -> &mut ReorderBuffer {
        self.reader.order_mut()
    }

    /// Returns the reader, for its counters.
    #[must_use]
    pub const fn reader(&self) -> &FilterReader {
        &self.reader
    }
}
