//! Follows the control group at the configured path. The kernel detaches the host hook from a
//! removed group; a group recreated at the path gets the hook again.
//!
//! The work runs in a separate thread: attaching takes `CAP_NET_ADMIN`, which no other thread
//! keeps. The thread's system call filter allows the creation of links as the only use of that
//! capability. The thread creates and changes no control group.

use std::fs::{self, File};
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use super::cgroup::{Cgroup, CgroupError};
use super::error_chain::in_words;
use super::filter::{FilterError, Links};
use super::system::{DirectoryWatch, wait};
use crate::threads::{Progress, Spawn, Task};

/// Interval of checks while the directory above the group is not watched.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Interval of checks while it is watched: inotify reports a group that appears there or is
/// removed. Only the removal or the mount of a directory further up waits for a check.
const WATCHED_POLL_INTERVAL: Duration = Duration::from_secs(10);

/// Device and inode of a directory, unique per control group.
pub type Identity = (u64, u64);

/// Handle of the thread, which ends when the handle is dropped.
pub struct Reattach {
    shared: Arc<Shared>,
    /// Closed to end the thread.
    end: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// Why the hook is not attached.
    detached: Mutex<Option<String>>,
    /// Number of times that the hook was attached again.
    reattachments: AtomicU64,
    progress: Progress,
}

/// State of the thread.
struct Follow {
    path: PathBuf,
    /// The group with the hook; `None` = the hook is not attached.
    attached: Option<Identity>,
    links: Links,
    /// The links; dropping them detaches the hook.
    held: Vec<OwnedFd>,
    shared: Arc<Shared>,
}

/// Why a group does not get the hook.
#[derive(Debug, thiserror::Error)]
enum ReattachError {
    #[error(transparent)]
    Hierarchy(#[from] CgroupError),
    #[error(transparent)]
    Filter(#[from] FilterError),
}

impl Reattach {
    /// Follows the group at `path`; the hook is attached to the directory `attached`.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(path: &Path, attached: Identity, links: Links, spawn: Spawn) -> io::Result<Self> {
        let (ended, end) = io::pipe()?;
        let shared = Arc::new(Shared::default());
        let mut follow = Follow {
            path: path.to_path_buf(),
            attached: Some(attached),
            links,
            held: Vec::new(),
            shared: Arc::clone(&shared),
        };
        let thread = Builder::new()
            .name("cgroup".to_owned())
            .stack_size(256 << 10);
        let thread = spawn(Task::Reattach, thread, Box::new(move || follow.run(&ended)))?;
        Ok(Self {
            shared,
            end: Some(end),
            thread: Some(thread),
        })
    }

    /// Returns why the hook is not attached; `None` while it is.
    #[must_use]
    pub fn detached(&self) -> Option<String> {
        let detached = self.shared.detached.lock();
        detached.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns how long the current step has taken if the thread is stalled; otherwise `None`.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.shared.progress.stalled()
    }

    /// Returns the number of attachments to another group since the start.
    #[must_use]
    pub fn reattachments(&self) -> u64 {
        self.shared.reattachments.load(Ordering::Acquire)
    }
}

impl Drop for Reattach {
    fn drop(&mut self) {
        self.end = None;
        // A stalled thread is not joined: it ends with the process.
        if let Some(thread) = self.thread.take()
            && self.shared.progress.stalled().is_none()
        {
            // The result of the thread is not needed.
            let _ = thread.join();
        }
    }
}

impl Follow {
    fn run(&mut self, ended: &PipeReader) {
        // Without inotify, a recreated group is noticed within a second.
        let mut watch = DirectoryWatch::new().ok();
        loop {
            self.shared.progress.step();
            let watches_above = match (&mut watch, self.path.parent()) {
                (Some(watch), Some(above)) => watch.add_with_removals(above),
                _ => false,
            };
            self.check();
            let ended = ended.as_fd();
            let every = match watches_above && self.attached.is_some() {
                true => WATCHED_POLL_INTERVAL,
                false => POLL_INTERVAL,
            };
            self.shared.progress.set_idle();
            let is_over = match &watch {
                Some(watch) => wait(&[ended, watch.as_fd()], every),
                None => wait(&[ended], every),
            };
            if !matches!(is_over, Ok(None | Some(1))) {
                return;
            }
            self.shared.progress.step();
            if let Some(watch) = &mut watch {
                watch.created(|_| true);
            }
        }
    }

    fn check(&mut self) {
        let there = identity(&self.path);
        if self.attached.is_some() && there == self.attached {
            return;
        }
        if self.attached.take().is_some() {
            self.held.clear();
            let reason = format!("the cgroup {} was removed", self.path.display());
            tracing::warn!("{reason}: its sockets are not observed until it is recreated");
            self.detach(reason);
        }
        if there.is_none() {
            return;
        }
        match self.attach() {
            Ok(()) => {
                self.shared.reattachments.fetch_add(1, Ordering::Release);
                *self.detached() = None;
                tracing::info!(
                    cgroup = %self.path.display(),
                    "the cgroup was recreated: its sockets are observed"
                );
            }
            Err(error) => {
                let reason = in_words(&error);
                if self.detached().as_ref() != Some(&reason) {
                    tracing::warn!(reason, "the host hook is not attached again");
                }
                self.detach(reason);
            }
        }
    }

    fn attach(&mut self) -> Result<(), ReattachError> {
        let cgroup = Cgroup::open(&self.path)?;
        self.held = self.links.create(cgroup.directory())?;
        self.attached = of(cgroup.directory());
        Ok(())
    }

    fn detach(&self, reason: String) {
        *self.detached() = Some(reason);
    }

    fn detached(&self) -> std::sync::MutexGuard<'_, Option<String>> {
        let detached = self.shared.detached.lock();
        detached.unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the identity of an open directory; `None` if the kernel refuses to read it.
#[must_use]
pub fn of(directory: &File) -> Option<Identity> {
    let metadata = directory.metadata().ok()?;
    Some((metadata.dev(), metadata.ino()))
}

/// Returns the current identity of the directory at a path; `None` if it does not exist.
#[must_use]
pub fn identity(path: &Path) -> Option<Identity> {
    let metadata = fs::metadata(path).ok()?;
    Some((metadata.dev(), metadata.ino()))
}
