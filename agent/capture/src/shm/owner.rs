//! Detects whether the process that created a file of shared memory is alive.
//!
//! Fast DDS holds an flock on `<file>_el` (exclusive) or `<file>_sl` (shared) while it uses the
//! file. Participants take these locks themselves to find files of dead processes, so this module
//! opens and locks nothing. It reads `/proc/locks`, where the kernel lists locks by device and
//! inode.

use std::collections::HashMap;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

/// Suffixes of the lock files.
pub(super) const LOCK_SUFFIXES: [&str; 2] = ["_el", "_sl"];
/// The inode of the initial PID namespace (`PROC_PID_INIT_INO`). In other namespaces, `/proc/locks`
/// omits the locks of processes outside of them.
const HOST_PROCESSES: u64 = 0xefff_fffc;

/// Device and inode of a file.
type FileId = (u32, u32, u64);

/// A snapshot of this host's locks.
#[derive(Debug, Default)]
pub struct Locks {
    /// The locked files with the process of one lock; `None` if the list cannot be read completely.
    held: Option<HashMap<FileId, u32>>,
}

/// The process that uses a file of shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// It is certainly dead: the lock file exists, and its lock is free.
    Dead,
    /// It holds the lock.
    Alive(u32),
    /// The file has no lock file, or the locks cannot be read.
    Unknown,
}

impl Locks {
    /// Reads the current locks.
    #[must_use]
    pub fn read() -> Self {
        let namespace = fs::metadata("/proc/self/ns/pid");
        let sees_all = namespace.is_ok_and(|namespace| namespace.ino() == HOST_PROCESSES);
        let list = fs::read_to_string("/proc/locks").ok().filter(|_| sees_all);
        Self {
            held: list.map(|list| list.lines().filter_map(lock_of).collect()),
        }
    }

    /// Returns whether a process holds the lock of the file with this device and inode; `None` if
    /// that is unknown.
    #[must_use]
    pub fn is_held(&self, device: u64, inode: u64) -> Option<bool> {
        self.held.as_ref()?;
        Some(self.holder(device, inode).is_some())
    }

    fn holder(&self, device: u64, inode: u64) -> Option<u32> {
        let file = (libc::major(device), libc::minor(device), inode);
        self.held.as_ref()?.get(&file).copied()
    }

    /// Returns whether the process that created this file is certainly dead.
    #[must_use]
    pub fn is_abandoned(&self, path: &Path) -> bool {
        self.owner(path) == Owner::Dead
    }

    /// Returns the process that uses this file.
    #[must_use]
    pub fn owner(&self, path: &Path) -> Owner {
        if self.held.is_none() {
            return Owner::Unknown;
        }
        let mut owner = Owner::Unknown;
        for suffix in LOCK_SUFFIXES {
            let mut name = path.as_os_str().to_owned();
            name.push(suffix);
            let Ok(metadata) = fs::symlink_metadata(&name) else {
                continue;
            };
            if let Some(process) = self.holder(metadata.dev(), metadata.ino()) {
                return Owner::Alive(process);
            }
            owner = Owner::Dead;
        }
        owner
    }
}

/// Returns the file and the process of a line such as
/// `1: FLOCK  ADVISORY  WRITE 1234 00:1a:5678 0 EOF`. A process that waits for a lock
/// (`1: -> FLOCK ...`) holds no lock.
fn lock_of(line: &str) -> Option<(FileId, u32)> {
    let mut words = line.split_whitespace().skip(1);
    if words.next() != Some("FLOCK") {
        return None;
    }
    let process = words.nth(2)?.parse().ok()?;
    let mut file = words.next()?.split(':');
    let major = u32::from_str_radix(file.next()?, 16).ok()?;
    let minor = u32::from_str_radix(file.next()?, 16).ok()?;
    Some(((major, minor, file.next()?.parse().ok()?), process))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_lock_list_identifies_the_locked_file() {
        let line = "12: FLOCK  ADVISORY  WRITE 1234 00:1a:5678 0 EOF";
        assert_eq!(lock_of(line), Some(((0, 0x1a, 5678), 1234)));
        for other in [
            "12: -> FLOCK  ADVISORY  WRITE 1234 00:1a:5678 0 EOF",
            "3: POSIX  ADVISORY  READ  9 fd:00:5678 0 EOF",
            "12: FLOCK  ADVISORY  WRITE 1234 00:1a",
            "12: FLOCK",
            "",
        ] {
            assert_eq!(lock_of(other), None, "{other}");
        }
    }

    #[test]
    fn a_file_is_abandoned_when_no_process_holds_the_lock_beside_it() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("fastrtps_port7411");
        fs::write(&path, "x").unwrap();
        // Without a lock file the state is unknown.
        assert!(!Locks::read().is_abandoned(&path));
        for suffix in LOCK_SUFFIXES {
            let name = directory.path().join(format!("fastrtps_port7411{suffix}"));
            let file = fs::File::create(&name).unwrap();
            assert!(Locks::read().is_abandoned(&path));
            file.try_lock_shared().unwrap();
            assert!(!Locks::read().is_abandoned(&path));
            drop(file);
            assert!(Locks::read().is_abandoned(&path));
        }
        assert!(!Locks::default().is_abandoned(&path));
    }
}
