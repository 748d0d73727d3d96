//! Probes in the libraries that processes use.
//!
//! Attached once to a file, a probe is in every process that maps it, including later ones. A
//! library that no process uses is detached only after a while, so that a restarted robot is seen
//! from its first message.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Component, Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::fs::{CWD, Mode, OFlags, openat};
use rustix::io::Errno;

use super::library::LibraryError;
use super::processes::{LibraryId, Mapped, Processes};
use crate::error_chain::in_words;
use crate::tables::Libraries;
use ros2probe_model::bounded::Bounded;

/// How long an unused library stays attached.
pub const LINGER: Duration = Duration::from_secs(60);
/// Pause before another attempt to attach to a library.
pub const RETRY: Duration = Duration::from_secs(5);
/// A file whose open blocks is not a library.
const UNBLOCKED: OFlags = OFlags::NONBLOCK.union(OFlags::NOCTTY);
/// Beginning of the names of file systems in user space.
const USER_SPACE: &str = "fuse";
/// Most bytes read of a process's mounts.
const MAX_MOUNTS: u64 = 1 << 20;
/// Directories of installed libraries and of ROS distributions.
const INSTALLED: [&str; 5] = [
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib",
    "/usr/lib64",
    "/usr/local/lib",
];
const DISTRIBUTIONS: &str = "/opt/ros";

/// All known libraries, with a probe `P` in each.
pub struct Attachments<P> {
    attach: Attach<P>,
    meaning: &'static str,
    libraries: Bounded<Libraries, BTreeMap<LibraryId, Library<P>>>,
}

/// Attaches to a library's file.
pub type Attach<P> = Box<dyn FnMut(&File) -> Result<P, Refusal> + Send>;

struct Library<P> {
    path: PathBuf,
    probe: Result<P, String>,
    processes: usize,
    used: Instant,
    tried: Instant,
    /// Attached before any process used it, and kept.
    is_installed: bool,
}

/// Why a library is not attached.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// Its file cannot be opened.
    #[error("it cannot be opened")]
    Open(#[source] io::Error),
    /// Its path is a directory or a device.
    #[error("not a file")]
    NoFile,
    /// Its file system is a program of a user, which may never answer.
    #[error(
        "it lies in a file system of {0}, which may never answer: copy it to a disk of this host"
    )]
    MayNotAnswer(String),
    /// Its path in the process's file system names another file by now.
    #[error("it was replaced while the process uses it: restart the process")]
    Replaced,
    /// It is malformed, or lacks the function.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The kernel refuses the probe.
    #[error(transparent)]
    Probe(Box<dyn std::error::Error + Send + Sync>),
}

/// State of one library.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LibraryFacts {
    /// Its path in the file system of a process that uses it.
    pub path: PathBuf,
    /// Number of processes that use it.
    pub processes: usize,
    /// Why it is not attached; `None` if it is.
    pub refused: Option<String>,
}

impl<P> Attachments<P> {
    /// Creates attachments of nothing. `meaning`: what it means that a library is attached.
    #[must_use]
    pub fn new(meaning: &'static str, attach: Attach<P>) -> Self {
        Self {
            attach,
            meaning,
            libraries: Bounded::default(),
        }
    }

    /// Returns the probe of a library, or why it has none; `None` if the library is not known.
    #[must_use]
    pub fn probe(&self, id: &LibraryId) -> Option<&Result<P, String>> {
        self.libraries.get(id).map(|library| &library.probe)
    }

    /// Detaches from all libraries.
    pub fn clear(&mut self) {
        self.libraries.clear();
    }

    /// Attaches to installed libraries that no process uses yet.
    pub fn install(&mut self, paths: &[PathBuf], now: Instant) {
        for path in paths {
            let Ok(metadata) = fs::metadata(path) else {
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
            // A failure is reported when a process uses the library.
            if let Ok(probe) = open(path).and_then(|file| (self.attach)(&file)) {
                tracing::info!(library = %path.display(), "uprobe attached in advance");
                let library = Library {
                    path: path.clone(),
                    probe: Ok(probe),
                    processes: 0,
                    used: now,
                    tried: now,
                    is_installed: true,
                };
                self.libraries.insert(id, library);
            }
        }
    }

    /// Attaches to new libraries, and detaches those that have been unused for a while.
    pub fn follow(&mut self, processes: &Processes, now: Instant) {
        for library in self.libraries.values_mut() {
            library.processes = 0;
        }
        for (process, used) in processes.using() {
            for mapped in &used.libraries {
                self.meet(mapped, process, now);
            }
        }
        self.libraries.retain(|_, library| {
            let is_used = library.is_installed || now - library.used < LINGER;
            if !is_used && library.probe.is_ok() {
                let library = library.path.display();
                tracing::info!(%library, "uprobe detached: the library is no longer in use");
            }
            is_used
        });
    }

    fn meet(&mut self, mapped: &Mapped, process: u32, now: Instant) {
        let Mapped { id, path, range } = mapped;
        let is_known = self
            .libraries
            .get(id)
            .is_some_and(|known| known.probe.is_ok() || now - known.tried < RETRY);
        if !is_known && (self.libraries.contains_key(id) || !self.libraries.is_full()) {
            // Refers to the file that the process maps, even if its path now names another one.
            let file = PathBuf::from(format!("/proc/{process}/map_files/{range}"));
            let opened = answers(process, id).and_then(|()| open_mapped(&file, process, mapped));
            let probe = opened.and_then(|file| (self.attach)(&file));
            let probe = probe.map_err(|refusal| in_words(&refusal));
            let (library, is_new) = (path.display(), !self.libraries.contains_key(id));
            match &probe {
                Ok(_) => tracing::info!(%library, "attached: {}", self.meaning),
                Err(reason) if is_new => tracing::warn!(%library, reason, "not attached"),
                Err(_) => {}
            }
            let library = Library {
                path: path.clone(),
                probe,
                processes: 0,
                used: now,
                tried: now,
                is_installed: false,
            };
            self.libraries.insert(id.clone(), library);
        }
        if let Some(library) = self.libraries.get_mut(id) {
            library.processes += 1;
            library.used = now;
        }
    }

    /// Returns the libraries in use.
    #[must_use]
    pub fn facts(&self) -> Vec<LibraryFacts> {
        let in_use = |library: &&Library<P>| library.processes > 0;
        let libraries = self.libraries.values().filter(in_use);
        let libraries = libraries.map(|library| LibraryFacts {
            path: library.path.clone(),
            processes: library.processes,
            refused: library.probe.as_ref().err().cloned(),
        });
        libraries.collect()
    }
}

/// Returns libraries in the usual directories of this host, not of containers. `is_library`: whether
/// a file of this name is one.
#[must_use]
pub fn installed(is_library: fn(&str) -> bool) -> Vec<PathBuf> {
    let mut directories: Vec<_> = INSTALLED.iter().map(PathBuf::from).collect();
    let distributions = fs::read_dir(DISTRIBUTIONS).into_iter().flatten().flatten();
    directories.extend(
        distributions
            .take(Libraries::CAP)
            .map(|entry| entry.path().join("lib")),
    );
    let entries = directories
        .iter()
        .flat_map(fs::read_dir)
        .flatten()
        .flatten();
    let libraries = entries.filter(|entry| {
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        is_file && entry.file_name().to_str().is_some_and(is_library)
    });
    libraries.map(|entry| entry.path()).collect()
}

/// Opens the file that a process maps. Only root may use `map_files` of another user's process: else
/// the path in the process's file system must still name that file.
fn open_mapped(file: &Path, process: u32, mapped: &Mapped) -> Result<File, Refusal> {
    match open(file) {
        Err(Refusal::Open(error)) if error.kind() == io::ErrorKind::PermissionDenied => {
            open_by_path(error, process, mapped)
        }
        opened => opened,
    }
}

/// Follows no link: the kernel has resolved the path, so a link was put there later. Behind
/// `/proc/<pid>/root` an absolute link would lead to files of the host.
fn open_by_path(refused: io::Error, process: u32, mapped: &Mapped) -> Result<File, Refusal> {
    let mut names = Vec::new();
    for component in mapped.path.components() {
        match component {
            Component::RootDir => {}
            Component::Normal(name) => names.push(name),
            _ => return Err(Refusal::Open(refused)),
        }
    }
    let Some((last, directories)) = names.split_last() else {
        return Err(Refusal::Open(refused));
    };
    let directory = OFlags::PATH | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let root = format!("/proc/{process}/root");
    let mut at = openat(CWD, &root, directory, Mode::empty()).map_err(not_opened)?;
    for name in directories {
        let plain = directory | OFlags::NOFOLLOW;
        at = openat(&at, *name, plain, Mode::empty()).map_err(not_opened)?;
    }
    let library = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NOFOLLOW | UNBLOCKED;
    let file = openat(&at, *last, library, Mode::empty()).map_err(not_opened)?;
    let file = regular(File::from(file))?;
    match file.metadata().map_err(Refusal::Open)?.ino() == mapped.id.inode {
        true => Ok(file),
        false => Err(Refusal::Replaced),
    }
}

/// A link, or a file in place of a directory, was put there after the library was mapped.
fn not_opened(error: Errno) -> Refusal {
    match error {
        Errno::LOOP | Errno::NOTDIR | Errno::NOENT => Refusal::Replaced,
        error => Refusal::Open(error.into()),
    }
}

/// Fails if a library lies in a file system in user space. A thread that reads such a file may wait
/// without end.
fn answers(process: u32, library: &LibraryId) -> Result<(), Refusal> {
    let mut text = Vec::new();
    // Without the list, the library is opened: it usually lies on a disk.
    if let Ok(file) = File::open(format!("/proc/{process}/mountinfo")) {
        let _ = file.take(MAX_MOUNTS).read_to_end(&mut text);
    }
    match file_system(&String::from_utf8_lossy(&text), &library.device) {
        Some(name) if name.starts_with(USER_SPACE) => Err(Refusal::MayNotAnswer(name.to_owned())),
        _ => Ok(()),
    }
}

/// Returns the type of the file system on a device, from the lines of `mountinfo`
/// (proc_pid_mountinfo(5)). `device` is in hexadecimal, as in a process's map.
fn file_system<'a>(mounts: &'a str, device: &str) -> Option<&'a str> {
    let (major, minor) = device.split_once(':')?;
    let number = |digits| u32::from_str_radix(digits, 16).ok();
    let device = format!("{}:{}", number(major)?, number(minor)?);
    let mut mounts = mounts.lines();
    mounts.find_map(|line| {
        let (place, system) = line.split_once(" - ")?;
        let is_it = place.split(' ').nth(2) == Some(&*device);
        system.split(' ').next().filter(|_| is_it)
    })
}

fn open(path: &Path) -> Result<File, Refusal> {
    let flags = OFlags::RDONLY | OFlags::CLOEXEC | UNBLOCKED;
    let file = openat(CWD, path, flags, Mode::empty());
    regular(File::from(
        file.map_err(|error| Refusal::Open(error.into()))?,
    ))
}

fn regular(file: File) -> Result<File, Refusal> {
    match file.metadata().map_err(Refusal::Open)?.is_file() {
        true => Ok(file),
        false => Err(Refusal::NoFile),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOUNTS: &str = "\
        22 1 254:0 / / rw,relatime shared:1 - ext4 /dev/vda rw\n\
        61 22 0:55 / /home/u/my\\040lib rw,nosuid - fuse.sshfs u@h:/ rw,user_id=1000\n\
        62 22 0:56 / /mnt rw - fuseblk /dev/sda1 rw\n";

    #[test]
    fn the_file_system_of_a_library_is_that_of_its_device() {
        for (device, name) in [
            ("fe:00", Some("ext4")),
            ("00:37", Some("fuse.sshfs")),
            ("00:38", Some("fuseblk")),
            ("00:39", None),
            ("zz:00", None),
            ("", None),
        ] {
            assert_eq!(file_system(MOUNTS, device), name, "{device}");
        }
    }

    #[test]
    fn a_library_whose_path_names_another_file_is_not_opened() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("libtracetools.so");
        fs::write(&path, "old").unwrap();
        let inode = fs::metadata(&path).unwrap().ino();
        let mapped = |inode| Mapped {
            id: LibraryId {
                device: String::new(),
                inode,
            },
            path: path.clone(),
            range: String::new(),
        };
        // As map_files of another user's process: it exists, and cannot be opened.
        let closed = Path::new("/proc/self/map_files-of-another-user");
        let own = std::process::id();
        let opened = open_mapped(closed, own, &mapped(inode));
        assert!(matches!(opened, Err(Refusal::Open(_))));
        let denied = io::Error::from(io::ErrorKind::PermissionDenied);
        let opened = open_by_path(denied, own, &mapped(inode));
        assert!(opened.is_ok());
        let denied = io::Error::from(io::ErrorKind::PermissionDenied);
        let opened = open_by_path(denied, own, &mapped(inode + 1));
        assert!(matches!(opened, Err(Refusal::Replaced)));
    }

    #[test]
    fn a_link_on_the_way_to_a_library_is_not_followed() {
        let directory = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        let name = "libtracetools.so";
        fs::write(elsewhere.path().join(name), "of the host").unwrap();
        let inode = fs::metadata(elsewhere.path().join(name)).unwrap().ino();
        let (way, end) = (directory.path().join("lib"), directory.path().join("end"));
        std::os::unix::fs::symlink(elsewhere.path(), &way).unwrap();
        std::os::unix::fs::symlink(elsewhere.path().join(name), &end).unwrap();
        for path in [
            way.join(name),
            end,
            directory.path().join("gone").join(name),
        ] {
            let mapped = Mapped {
                id: LibraryId {
                    device: String::new(),
                    inode,
                },
                path,
                range: String::new(),
            };
            let denied = io::Error::from(io::ErrorKind::PermissionDenied);
            let opened = open_by_path(denied, std::process::id(), &mapped);
            assert!(matches!(opened, Err(Refusal::Replaced)), "{opened:?}");
        }
    }
}
