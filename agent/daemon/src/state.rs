//! The state directory: what discovery knew, on disk for the next start. What clients watch lies
//! beside it (`watches`).
//!
//! JSON files, each replaced as a whole (new file, fsync, rename, fsync of the directory), so that a
//! power cut leaves the old or the new one. Writing happens on a thread of its own; the capture
//! hands over and never waits. Nothing here ends the agent: a file that cannot be read is kept
//! aside, a disk that is full is counted and said once. One agent to a directory.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, BufWriter, Read as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::file;
use ros2probe_model::discovery::Memory;

/// The form that is written. What was added to it so far may be lacking in a file and has a default
/// then. An agent that does not know a field must not take the file for its own: whatever is added
/// from now on, or means something else, is a new version with a reader of its own.
const VERSION: u32 = 1;
const FORM: Form<Document> = Form {
    file: FILE,
    readers: &[(VERSION, from_json)],
};
const FILE: &str = "discovery.json";
/// What a file is called while it is written.
const NEW_FILE: &str = "discovery.json.new";
/// A larger file was not written by this.
const MAX_BYTES: u64 = 64 << 20;
/// How often at most the file is written.
const PERIOD: Duration = Duration::from_secs(3);
/// How long after a failure the disk is tried again, if nothing has changed.
const AGAIN: Duration = Duration::from_secs(10);
const BOOT_ID: &str = "/proc/sys/kernel/random/boot_id";

/// Where state is kept, to this process alone.
#[derive(Debug)]
pub struct StateDirectory {
    path: PathBuf,
    /// Holds the lock, and is what a rename is made durable by.
    directory: File,
}

/// Why no state is kept.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// It cannot be used.
    #[error("cannot use the state directory {}", path.display())]
    Unusable {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Another agent uses it.
    #[error("the state directory {} is in use by another agent", path.display())]
    InUse {
        /// Which.
        path: PathBuf,
    },
}

/// What was found at the start.
#[derive(Debug, PartialEq, Eq)]
pub enum Loaded {
    /// No file.
    Nothing,
    /// Of another boot of this host. The participants of these GUIDs are gone or on another host, and
    /// process ids, which Fast DDS makes GUIDs of, come again.
    AnotherBoot,
    /// Everybody that was there.
    Known(Memory),
    /// A newer rp wrote it: it is left as it is, and nothing may be written in its place.
    Newer(Newer),
    /// It cannot be used, for this reason, and now lies there.
    Unusable {
        /// Why.
        reason: String,
        /// Where it lies, if it could be moved.
        moved_to: Option<PathBuf>,
    },
}

/// A file of the state directory, and every form it ever had.
pub(crate) struct Form<T: 'static> {
    /// Its name.
    pub(crate) file: &'static str,
    /// What reads each version, the oldest first; the last one is what is written.
    pub(crate) readers: &'static [(u32, Reader<T>)],
}

/// Reads a document of one version as what it means today.
pub(crate) type Reader<T> = fn(&[u8]) -> serde_json::Result<T>;

/// A file that only a newer rp can read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Newer {
    /// Where it lies.
    pub path: PathBuf,
    /// Its version.
    pub version: u32,
    /// The newest one that is known here.
    pub known: u32,
}

/// What was found in one file.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Found<T> {
    /// No file.
    Nothing,
    /// A document.
    This(T),
    /// One that only a newer rp can read; it is where it was.
    Newer(Newer),
    /// It cannot be used, for this reason, and now lies there.
    Unusable {
        /// Why.
        reason: String,
        /// Where it lies, if it could be moved.
        moved_to: Option<PathBuf>,
    },
}

/// What can be read of a file of any version.
#[derive(Deserialize)]
struct Version {
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct Document {
    version: u32,
    /// The kernel's name of the boot it was written in.
    boot: String,
    #[serde(flatten)]
    memory: Memory,
}

/// The thread that writes, and what it has done.
#[derive(Debug)]
pub struct StateWriter {
    inbox: SyncSender<Memory>,
    thread: JoinHandle<()>,
    done: Arc<Done>,
    /// The revision that was handed over last, and when.
    handed: Option<(u64, Instant)>,
}

#[derive(Debug, Default)]
struct Done {
    writes: AtomicU64,
    failures: AtomicU64,
    /// The last write was one of these.
    is_failing: AtomicBool,
}

/// How often state was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StateFacts {
    /// Written.
    pub writes: u64,
    /// Not written.
    pub failures: u64,
}

impl StateDirectory {
    /// Opens a directory that exists, for this process alone. Whether it can be written is seen when
    /// it is: what lies in one that is full or read-only is known all the same.
    ///
    /// # Errors
    /// It does not exist, cannot be entered, or another agent uses it.
    pub fn open(path: &Path) -> Result<Self, StateError> {
        let unusable = |source| StateError::Unusable {
            path: path.to_path_buf(),
            source,
        };
        let mut options = OpenOptions::new();
        let options = options.read(true).custom_flags(libc::O_DIRECTORY);
        let directory = options.open(path).map_err(unusable)?;
        match directory.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let path = path.to_path_buf();
                return Err(StateError::InUse { path });
            }
            Err(TryLockError::Error(error)) => return Err(unusable(error)),
        }
        // Nothing could be found in it otherwise, and nothing be written.
        fs::metadata(path.join(".")).map_err(unusable)?;
        // Of an agent that was killed while it wrote.
        let _ = fs::remove_file(path.join(NEW_FILE));
        Ok(Self {
            path: path.to_path_buf(),
            directory,
        })
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads what the last agent left. What is no state is moved aside.
    #[must_use]
    pub fn load(&self) -> Loaded {
        match self.read(&FORM) {
            Found::Nothing => Loaded::Nothing,
            Found::Newer(newer) => Loaded::Newer(newer),
            Found::This(document) if document.boot != boot() => Loaded::AnotherBoot,
            Found::This(document) => Loaded::Known(document.memory),
            Found::Unusable { reason, moved_to } => Loaded::Unusable { reason, moved_to },
        }
    }

    /// Reads a document of any version that is known. What is none is moved aside; what a newer rp
    /// wrote stays where that one will look for it.
    pub(crate) fn read<T>(&self, form: &Form<T>) -> Found<T> {
        let file = form.file;
        let path = self.path.join(file);
        let mut bytes = Vec::new();
        let read = file::open_no_link(&path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
        match read {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Found::Nothing,
            Err(error) => return self.set_aside(file, error.to_string()),
            Ok(_) => {}
        }
        let known = form.readers.last().map_or(0, |(version, _)| *version);
        let is_whole = bytes.len() as u64 <= MAX_BYTES;
        let version = match serde_json::from_slice::<Version>(&bytes) {
            Ok(Version { version }) => version,
            Err(error) => match begins_with_version(&bytes) {
                // Too large for us, or no JSON any more: that is for the newer one to judge.
                Some(version) if version > known => version,
                _ if is_whole => return self.set_aside(file, error.to_string()),
                _ => return self.set_aside(file, format!("it is larger than {MAX_BYTES} bytes")),
            },
        };
        if version > known {
            return Found::Newer(Newer {
                path,
                version,
                known,
            });
        }
        match form.readers.iter().find(|(reads, _)| *reads == version) {
            Some((_, read)) => match read(&bytes) {
                Ok(document) => Found::This(document),
                Err(error) => self.set_aside(file, error.to_string()),
            },
            None => self.set_aside(file, format!("version {version} is not supported")),
        }
    }

    /// Keeps a file that cannot be used out of the way.
    pub(crate) fn set_aside<T>(&self, file: &str, reason: String) -> Found<T> {
        let aside = self.path.join(format!("{file}.corrupt"));
        let moved = fs::rename(self.path.join(file), &aside);
        Found::Unusable {
            reason,
            moved_to: moved.is_ok().then_some(aside),
        }
    }

    /// Replaces a file as a whole.
    pub(crate) fn replace(&self, file: &str, document: &impl Serialize) -> io::Result<()> {
        let new = self.path.join(format!("{file}.new"));
        let written = write_new(&new, document).and_then(|()| {
            fs::rename(&new, self.path.join(file))?;
            self.directory.sync_all()
        });
        if written.is_err() {
            // Half a file is of no use, least of all on a full disk.
            let _ = fs::remove_file(&new);
        }
        written
    }

    fn write(&self, memory: Memory) -> io::Result<()> {
        let document = Document {
            version: VERSION,
            boot: boot(),
            memory,
        };
        self.replace(FILE, &document)
    }
}

/// The form that is written today.
pub(crate) fn from_json<T: DeserializeOwned>(bytes: &[u8]) -> serde_json::Result<T> {
    serde_json::from_slice(bytes)
}

/// What a file says first of itself, whatever follows: every version is written so.
fn begins_with_version(bytes: &[u8]) -> Option<u32> {
    let rest = bytes.strip_prefix(b"{\"version\":")?;
    let digits = rest.iter().take_while(|byte| byte.is_ascii_digit());
    let digits: Vec<u8> = digits.take(10).copied().collect();
    std::str::from_utf8(&digits).ok()?.parse().ok()
}

/// Makes the file anew: what lies there, of an agent that was killed or a link, goes first.
fn new_file(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = OpenOptions::new();
    let options = options.write(true).create_new(true).mode(0o600);
    options.open(path)
}

fn write_new(path: &Path, document: &impl Serialize) -> io::Result<()> {
    let mut file = BufWriter::new(new_file(path)?);
    serde_json::to_writer(&mut file, document)?;
    file.write_all(b"\n")?;
    let file = file.into_inner().map_err(io::IntoInnerError::into_error)?;
    file.sync_all()
}

/// Which boot this is; empty where the kernel does not tell.
fn boot() -> String {
    let boot = fs::read_to_string(BOOT_ID).unwrap_or_default();
    boot.trim().to_owned()
}

impl StateWriter {
    /// Starts the thread.
    ///
    /// # Errors
    /// No thread is to be had.
    pub fn start(directory: Arc<StateDirectory>) -> io::Result<Self> {
        let (inbox, outbox) = sync_channel(1);
        let done = Arc::<Done>::default();
        let own = Arc::clone(&done);
        let thread = std::thread::Builder::new()
            .name("state".to_owned())
            .spawn(move || keep(&directory, &outbox, &own))?;
        Ok(Self {
            inbox,
            thread,
            done,
            handed: None,
        })
    }

    /// Whether it is time to hand over what is known at `revision`.
    #[must_use]
    pub fn wants(&self, revision: u64, now: Instant) -> bool {
        let is_failing = self.done.is_failing.load(Ordering::Relaxed);
        self.handed.is_none_or(|(handed, at)| {
            let age = now.saturating_duration_since(at);
            age >= PERIOD && (handed != revision || is_failing && age >= AGAIN)
        })
    }

    /// Hands over; returns at once. While the disk keeps the thread busy, a later one will do.
    pub fn keep(&mut self, memory: Memory, revision: u64, now: Instant) {
        match self.inbox.try_send(memory) {
            Ok(()) => self.handed = Some((revision, now)),
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {}
        }
    }

    /// Writes the last state and waits until it is on disk.
    pub fn finish(self, memory: Memory) {
        let Self { inbox, thread, .. } = self;
        // The thread ends with its inbox alone; if it has panicked, that is in the log.
        let _ = inbox.send(memory);
        drop(inbox);
        let _ = thread.join();
    }

    /// What the thread has done.
    #[must_use]
    pub fn facts(&self) -> StateFacts {
        StateFacts {
            writes: self.done.writes.load(Ordering::Relaxed),
            failures: self.done.failures.load(Ordering::Relaxed),
        }
    }
}

fn keep(directory: &StateDirectory, inbox: &Receiver<Memory>, done: &Done) {
    while let Ok(memory) = inbox.recv() {
        let written = directory.write(memory);
        let failed_before = done.is_failing.swap(written.is_err(), Ordering::Relaxed);
        match written {
            Ok(()) => {
                done.writes.fetch_add(1, Ordering::Relaxed);
                if failed_before {
                    tracing::info!(path = %directory.path.display(), "state is written again");
                }
            }
            Err(error) => {
                done.failures.fetch_add(1, Ordering::Relaxed);
                if !failed_before {
                    let path = directory.path.display();
                    tracing::error!(%path, %error, "state cannot be written: names would be lost with a restart");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
