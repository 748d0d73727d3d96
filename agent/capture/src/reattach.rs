//! Follows the control group at the configured path. The kernel detaches the host hook from a group
//! that is removed; a group that is made anew at the path gets the hook again.
//!
//! A thread of its own: attaching takes `CAP_NET_ADMIN`, which no other thread keeps. Its filter of
//! system calls allows no use of it but creating links. It makes and changes no control group.

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
use crate::threads::{Spawn, Task};

/// How often the path is looked at. A group that appears in an existing directory is noticed at once.
const EVERY: Duration = Duration::from_secs(1);

/// Device and inode of a directory. The kernel gives no two control groups the same.
pub type Identity = (u64, u64);

/// The thread, from the outside. It ends when this is dropped.
pub struct Reattach {
    shared: Arc<Shared>,
    /// Closed to end the thread.
    end: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// Why the hook is attached to nothing.
    detached: Mutex<Option<String>>,
    /// How often the hook was attached again.
    attached_anew: AtomicU64,
}

/// What the thread works with.
struct Follow {
    path: PathBuf,
    /// The group that the hook is attached to; `None` = none.
    attached: Option<Identity>,
    links: Links,
    /// Detached when it is dropped.
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
    /// Follows the group at `path`, whose directory `attached` is the hook's now.
    ///
    /// # Errors
    /// There can be no more threads.
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

    /// Why the hook is attached to nothing; `None` while it is.
    #[must_use]
    pub fn detached(&self) -> Option<String> {
        let detached = self.shared.detached.lock();
        detached.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How often the hook was attached to another group since the start.
    #[must_use]
    pub fn attached_anew(&self) -> u64 {
        self.shared.attached_anew.load(Ordering::Acquire)
    }
}

impl Drop for Reattach {
    fn drop(&mut self) {
        self.end = None;
        if let Some(thread) = self.thread.take() {
            // It can only have ended; how does not matter any more.
            let _ = thread.join();
        }
    }
}

impl Follow {
    fn run(&mut self, ended: &PipeReader) {
        // Without it, a group that is made anew is noticed within a second.
        let mut watch = DirectoryWatch::new().ok();
        loop {
            if let (Some(watch), Some(above)) = (&mut watch, self.path.parent()) {
                watch.add(above);
            }
            self.check();
            let ended = ended.as_fd();
            let is_over = match &watch {
                Some(watch) => wait(&[ended, watch.as_fd()], EVERY),
                None => wait(&[ended], EVERY),
            };
            if !matches!(is_over, Ok(None | Some(1))) {
                return;
            }
            if let Some(watch) = &mut watch {
                watch.wait(Duration::ZERO, |_| true);
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
            tracing::warn!("{reason}: its sockets are not seen until it is there again");
            self.detach(reason);
        }
        if there.is_none() {
            return;
        }
        match self.attach() {
            Ok(()) => {
                self.shared.attached_anew.fetch_add(1, Ordering::Release);
                *self.detached() = None;
                tracing::info!(
                    cgroup = %self.path.display(),
                    "the cgroup is there again: its sockets are seen"
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

/// Of an open directory.
#[must_use]
pub fn of(directory: &File) -> Option<Identity> {
    let metadata = directory.metadata().ok()?;
    Some((metadata.dev(), metadata.ino()))
}

/// Of what is at a path now.
#[must_use]
pub fn identity(path: &Path) -> Option<Identity> {
    let metadata = fs::metadata(path).ok()?;
    Some((metadata.dev(), metadata.ino()))
}
