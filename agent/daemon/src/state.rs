//! State directory: the discovery state, saved for the next start. Watches of clients are saved in
//! the same directory (`watches`).
//!
//! JSON files are replaced as a whole: new file, fsync, rename, fsync of the directory. A power
//! failure therefore leaves the old or the new file. A separate thread writes, so that the capture
//! never waits. No failure here ends the agent: an unreadable file is moved aside, and a full disk
//! is counted and logged once. Each agent needs its own directory.

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
use ros2probe_capture::threads::Progress;
use ros2probe_model::graph::discovery::Memory;

/// Version of the written format. Fields added so far may be missing in a file and then have
/// defaults. An agent that does not know a field must not accept the file. Every further change
/// therefore needs a new version with its own reader.
const VERSION: u32 = 1;
const STATE_FORM: Form<Document> = Form {
    file: STATE_FILE,
    readers: &[(VERSION, from_json)],
};
const STATE_FILE: &str = "discovery.json";
/// Name of the file while it is written.
const NEW_STATE_FILE: &str = "discovery.json.new";
/// Maximum size of the file, in bytes.
const MAX_BYTES: u64 = 64 << 20;
/// Minimum time between two writes.
const WRITE_INTERVAL: Duration = Duration::from_secs(3);
/// Time after a failure until the next attempt, if nothing has changed.
const RETRY_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum time to wait for the file system when the agent ends. An fsync on an SD card that also
/// stores a recording takes more than ten seconds.
pub(crate) const END_TIMEOUT: Duration = Duration::from_secs(30);
const POLL_INTERVAL: Duration = Duration::from_millis(5);
const BOOT_ID: &str = "/proc/sys/kernel/random/boot_id";

/// State directory, locked by this process.
#[derive(Debug)]
pub struct StateDirectory {
    path: PathBuf,
    /// Descriptor that holds the lock; its fsync makes renames durable.
    directory: File,
    writes: AtomicU64,
    failures: AtomicU64,
}

/// Why the state directory cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// The directory is unusable.
    #[error("cannot use the state directory {}", path.display())]
    Unusable {
        /// Path of the directory.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// Another agent uses the directory.
    #[error("the state directory {} is in use by another agent", path.display())]
    InUse {
        /// Path of the directory.
        path: PathBuf,
    },
}

/// Discovery state at the start.
#[derive(Debug, PartialEq, Eq)]
pub enum Loaded {
    /// No file exists.
    Nothing,
    /// The file belongs to another boot of this host. Its participants have ended or are on another
    /// host, and process ids, from which Fast DDS derives GUIDs, are reused.
    AnotherBoot,
    /// State of the previous agent.
    Known(Memory),
    /// A newer version wrote the file; it must not be overwritten.
    Newer(Newer),
    /// The file is unusable and was moved aside.
    Unusable {
        /// Reason why it is unusable.
        reason: String,
        /// New path of the file, if it could be moved.
        moved_to: Option<PathBuf>,
    },
}

/// A file of the state directory with all versions of its format.
pub(crate) struct Form<T: 'static> {
    /// Name of the file.
    pub(crate) file: &'static str,
    /// Readers of each version, the oldest first; the last one is the written version.
    pub(crate) readers: &'static [(u32, Reader<T>)],
}

/// Reads a document of one version into the current form.
pub(crate) type Reader<T> = fn(&[u8]) -> serde_json::Result<T>;

/// A file that only a newer version can read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Newer {
    /// Path of the file.
    pub path: PathBuf,
    /// Version of the file.
    pub version: u32,
    /// Newest version known here.
    pub known: u32,
}

/// Content of one file.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Found<T> {
    /// No file exists.
    Nothing,
    /// A document.
    This(T),
    /// A document that only a newer version can read, left in place.
    Newer(Newer),
    /// The file is unusable and was moved aside.
    Unusable {
        /// Reason why it is unusable.
        reason: String,
        /// New path of the file, if it could be moved.
        moved_to: Option<PathBuf>,
    },
}

/// Part that files of all versions share.
#[derive(Deserialize)]
struct Version {
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct Document {
    version: u32,
    /// Boot id of the kernel at the time of writing.
    boot: String,
    #[serde(flatten)]
    memory: Memory,
}

/// The writing thread and its counters.
#[derive(Debug)]
pub struct StateWriter {
    directory: Arc<StateDirectory>,
    inbox: SyncSender<Memory>,
    thread: JoinHandle<()>,
    done: Arc<Done>,
    /// Last revision passed to the thread, and its time.
    handed: Option<(u64, Instant)>,
}

#[derive(Debug, Default)]
struct Done {
    /// Whether the last write failed.
    is_failing: AtomicBool,
    progress: Progress,
}

/// Counters of writes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StateFacts {
    /// Successful writes.
    pub writes: u64,
    /// Failed writes.
    pub failures: u64,
    /// Time for which the file system has not answered, if it is unusually long.
    pub stalled: Option<Duration>,
}

impl StateDirectory {
    /// Opens and locks an existing directory. The directory need not be writable: state in a full
    /// or read-only directory is still read.
    ///
    /// # Errors
    ///
    /// Fails if the directory does not exist, cannot be entered, or is used by another agent.
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
        // This fails for a directory that cannot be entered, where nothing could be read or
        // written.
        fs::metadata(path.join(".")).map_err(unusable)?;
        // An agent that was killed during a write leaves this file.
        let _ = fs::remove_file(path.join(NEW_STATE_FILE));
        Ok(Self {
            path: path.to_path_buf(),
            directory,
            writes: AtomicU64::new(0),
            failures: AtomicU64::new(0),
        })
    }

    /// Returns the path of the directory.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the state of the previous agent. Invalid files are moved aside.
    #[must_use]
    pub fn load(&self) -> Loaded {
        match self.read(&STATE_FORM) {
            Found::Nothing => Loaded::Nothing,
            Found::Newer(newer) => Loaded::Newer(newer),
            Found::This(document) if document.boot != boot() => Loaded::AnotherBoot,
            Found::This(document) => Loaded::Known(document.memory),
            Found::Unusable { reason, moved_to } => Loaded::Unusable { reason, moved_to },
        }
    }

    /// Reads a document of any known version. An invalid file is moved aside; the file of a newer
    /// version stays in place for that version.
    pub(crate) fn read<T>(&self, form: &Form<T>) -> Found<T> {
        let file = form.file;
        let path = self.path.join(file);
        let mut bytes = Vec::new();
        let read = file::open_no_link(&path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
        match read {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Found::Nothing,
            Err(error) => return self.move_aside(file, error.to_string()),
            Ok(_) => {}
        }
        let known = form.readers.last().map_or(0, |(version, _)| *version);
        let is_whole = bytes.len() as u64 <= MAX_BYTES;
        let version = match serde_json::from_slice::<Version>(&bytes) {
            Ok(Version { version }) => version,
            Err(error) => match begins_with_version(&bytes) {
                // The file is too large or not JSON, but a newer version may be able to read it.
                Some(version) if version > known => version,
                _ if is_whole => return self.move_aside(file, error.to_string()),
                _ => return self.move_aside(file, format!("it is larger than {MAX_BYTES} bytes")),
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
                Err(error) => self.move_aside(file, error.to_string()),
            },
            None => self.move_aside(file, format!("version {version} is not supported")),
        }
    }

    /// Moves an unusable file aside.
    pub(crate) fn move_aside<T>(&self, file: &str, reason: String) -> Found<T> {
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
            // A partial file is useless, and takes space on a full disk.
            let _ = fs::remove_file(&new);
        }
        let count = match written {
            Ok(()) => &self.writes,
            Err(_) => &self.failures,
        };
        count.fetch_add(1, Ordering::Relaxed);
        written
    }

    fn write(&self, memory: Memory) -> io::Result<()> {
        let document = Document {
            version: VERSION,
            boot: boot(),
            memory,
        };
        self.replace(STATE_FILE, &document)
    }
}

/// Reads the current format.
pub(crate) fn from_json<T: DeserializeOwned>(bytes: &[u8]) -> serde_json::Result<T> {
    serde_json::from_slice(bytes)
}

/// Returns the version at the start of a file, which is there in all versions; `None` if it is
/// unreadable.
fn begins_with_version(bytes: &[u8]) -> Option<u32> {
    let rest = bytes.strip_prefix(b"{\"version\":")?;
    let digits = rest.iter().take_while(|byte| byte.is_ascii_digit());
    let digits: Vec<u8> = digits.take(10).copied().collect();
    std::str::from_utf8(&digits).ok()?.parse().ok()
}

/// Creates the file. An existing file or link, as from a killed agent, is removed first.
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

/// Returns the boot id of the kernel; empty if it is unavailable.
fn boot() -> String {
    let boot = fs::read_to_string(BOOT_ID).unwrap_or_default();
    boot.trim().to_owned()
}

impl StateWriter {
    /// Starts the thread.
    ///
    /// # Errors
    ///
    /// Fails if the thread cannot be started.
    pub fn start(directory: Arc<StateDirectory>) -> io::Result<Self> {
        let target = Arc::clone(&directory);
        Self::start_with(directory, move |memory| target.write(memory))
    }

    fn start_with(
        directory: Arc<StateDirectory>,
        write: impl Fn(Memory) -> io::Result<()> + Send + 'static,
    ) -> io::Result<Self> {
        let (inbox, outbox) = sync_channel(1);
        let done = Arc::<Done>::default();
        let own = Arc::clone(&done);
        let path = directory.path.clone();
        let thread = std::thread::Builder::new()
            .name("state".to_owned())
            .spawn(move || keep(&path, write, &outbox, &own))?;
        Ok(Self {
            directory,
            inbox,
            thread,
            done,
            handed: None,
        })
    }

    /// Returns whether the state at `revision` should be passed to [`Self::keep`] now.
    #[must_use]
    pub fn is_write_due(&self, revision: u64, now: Instant) -> bool {
        let is_failing = self.done.is_failing.load(Ordering::Relaxed);
        self.handed.is_none_or(|(handed, at)| {
            let age = now.saturating_duration_since(at);
            age >= WRITE_INTERVAL && (handed != revision || is_failing && age >= RETRY_INTERVAL)
        })
    }

    /// Passes the state to the thread without blocking. If an earlier state still waits, this one
    /// is dropped, and a later call passes a newer state.
    pub fn keep(&mut self, memory: Memory, revision: u64, now: Instant) {
        match self.inbox.try_send(memory) {
            Ok(()) => self.handed = Some((revision, now)),
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {}
        }
    }

    /// Writes the last state and waits until it is on disk, for at most [`END_TIMEOUT`].
    pub fn finish(self, memory: Memory) {
        let path = self.directory.path.clone();
        if !self.finish_until(memory, Instant::now() + END_TIMEOUT) {
            let path = path.display();
            tracing::error!(%path, "the file system does not answer: the last state is not saved");
        }
    }

    /// Returns whether the thread has ended.
    fn finish_until(self, memory: Memory, deadline: Instant) -> bool {
        let Self { inbox, thread, .. } = self;
        let mut last = Some(memory);
        while let Some(memory) = last.take() {
            // Any other error means that the thread has panicked, which is in the log.
            if let Err(TrySendError::Full(memory)) = inbox.try_send(memory)
                && Instant::now() < deadline
            {
                last = Some(memory);
                std::thread::sleep(POLL_INTERVAL);
            }
        }
        drop(inbox);
        join_until(thread, deadline)
    }

    /// Returns the counters of all writes to the directory, including the watches of clients.
    #[must_use]
    pub fn facts(&self) -> StateFacts {
        StateFacts {
            writes: self.directory.writes.load(Ordering::Relaxed),
            failures: self.directory.failures.load(Ordering::Relaxed),
            stalled: self.done.progress.stalled(),
        }
    }
}

/// Waits until the thread has ended, but at most until `deadline`. Returns whether it has ended. If
/// it has panicked, the panic is in the log.
pub(crate) fn join_until(thread: JoinHandle<()>, deadline: Instant) -> bool {
    while !thread.is_finished() {
        if Instant::now() >= deadline {
            return false;
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    let _ = thread.join();
    true
}

fn keep(
    path: &Path,
    write: impl Fn(Memory) -> io::Result<()>,
    inbox: &Receiver<Memory>,
    done: &Done,
) {
    while let Ok(memory) = inbox.recv() {
        done.progress.step();
        let written = write(memory);
        done.progress.set_idle();
        let failed_before = done.is_failing.swap(written.is_err(), Ordering::Relaxed);
        match written {
            Ok(()) => {
                if failed_before {
                    tracing::info!(path = %path.display(), "state is saved again");
                }
            }
            Err(error) => {
                if !failed_before {
                    let path = path.display();
                    tracing::error!(%path, %error, "cannot save state: a restart would lose names");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
