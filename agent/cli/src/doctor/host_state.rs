//! Inputs of the checks on this host: files below a root, and values of system calls.
//!
//! Every file is read through [`Files`] with a size limit, so that a test can substitute a
//! directory. Nothing is written or sent over a network.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use ros2probe_capture::system::{ClockState, clock_state};
use ros2probe_daemon::privilege::raise;
use rustix::param::page_size;
use rustix::process::{Gid, getegid, geteuid, getgroups};
use rustix::thread::CapabilitySet;

/// Default maximum size of one file, in bytes.
const MAX_FILE: u64 = 256 << 10;
/// Maximum number of names read from one directory.
const MAX_NAMES: usize = 1 << 16;

/// State of a host.
#[derive(Debug)]
pub struct HostState {
    /// Files of `/proc`, `/sys`, `/etc` and `/run`.
    pub files: Files,
    /// Size of a memory page in bytes.
    pub page_bytes: u64,
    /// Effective capabilities of this process, which are all that it may have.
    pub capabilities: CapabilitySet,
    /// Effective user of this process.
    pub user_id: u32,
    /// Groups of this process.
    pub group_ids: Vec<u32>,
    /// Environment variables of this shell.
    pub environment: BTreeMap<String, String>,
    /// Clock state of the kernel.
    pub clock: Result<ClockState, ReadFailure>,
}

/// Files below a root directory.
#[derive(Debug)]
pub struct Files {
    root: PathBuf,
}

/// Reason why a file could not be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReadFailure {
    /// The file does not exist.
    #[error("not there")]
    Missing,
    /// This user has no permission.
    #[error("not permitted")]
    NotPermitted,
    /// Another error of the operating system.
    #[error("{0}")]
    Other(String),
}

impl HostState {
    /// Reads the state of this host.
    #[must_use]
    pub fn read() -> Self {
        Self {
            files: Files::below("/"),
            page_bytes: page_size() as u64,
            capabilities: raise().unwrap_or(CapabilitySet::empty()),
            user_id: geteuid().as_raw(),
            group_ids: group_ids(),
            environment: environment(),
            clock: clock_state().map_err(|error| ReadFailure::Other(error.to_string())),
        }
    }

    /// Returns whether this process runs as root.
    #[must_use]
    pub const fn is_root(&self) -> bool {
        self.user_id == 0
    }
}

impl Files {
    /// Returns the files below `root`.
    #[must_use]
    pub fn below(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// Maps an absolute path to the path below the root.
    #[must_use]
    pub fn path(&self, path: &str) -> PathBuf {
        self.root.join(path.trim_start_matches('/'))
    }

    /// Reads a text file without its last newline. Invalid UTF-8 is replaced.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read.
    pub fn text(&self, path: &str) -> Result<String, ReadFailure> {
        let bytes = self.bytes(path, MAX_FILE)?;
        Ok(String::from_utf8_lossy(&bytes).trim_end().to_owned())
    }

    /// Reads up to `most` bytes of a file.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read.
    pub fn bytes(&self, path: &str, most: u64) -> Result<Vec<u8>, ReadFailure> {
        let mut bytes = Vec::new();
        let file = File::open(self.path(path))?;
        file.take(most).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    /// Reads a file that contains one number.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read, or if it does not contain a number.
    pub fn number<T: FromStr>(&self, path: &str) -> Result<T, ReadFailure> {
        let text = self.text(path)?;
        let number = text.parse();
        number.map_err(|_| ReadFailure::Other(format!("`{text}` is not a number")))
    }

    /// Returns the target of a symbolic link.
    ///
    /// # Errors
    ///
    /// Fails if the link cannot be read.
    pub fn link(&self, path: &str) -> Result<String, ReadFailure> {
        let target = fs::read_link(self.path(path))?;
        Ok(target.to_string_lossy().into_owned())
    }

    /// Returns the sorted names in a directory.
    ///
    /// # Errors
    ///
    /// Fails if the directory cannot be read.
    pub fn names(&self, path: &str) -> Result<Vec<String>, ReadFailure> {
        let entries = fs::read_dir(self.path(path))?;
        let entries = entries.flatten().take(MAX_NAMES);
        let mut names: Vec<_> = entries
            .filter_map(|entry| entry.file_name().into_string().ok())
            .collect();
        names.sort();
        Ok(names)
    }

    /// Returns whether the path exists.
    #[must_use]
    pub fn exists(&self, path: &str) -> bool {
        self.path(path).exists()
    }

    /// Returns the sorted process ids.
    #[must_use]
    pub fn processes(&self) -> Vec<u32> {
        let names = self.names("/proc").unwrap_or_default();
        let mut processes: Vec<u32> = names.iter().filter_map(|name| name.parse().ok()).collect();
        processes.sort_unstable();
        processes
    }
}

impl From<io::Error> for ReadFailure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Self::Missing,
            io::ErrorKind::PermissionDenied => Self::NotPermitted,
            _ => Self::Other(error.to_string()),
        }
    }
}

/// Returns the last component of a path.
#[must_use]
pub fn base_name(path: &str) -> &str {
    Path::new(path)
        .file_name()
        .and_then(|name| name.to_str())
        .unwrap_or(path)
}

fn group_ids() -> Vec<u32> {
    let groups = getgroups().unwrap_or_default();
    let groups = groups.into_iter().chain([getegid()]);
    groups.map(Gid::as_raw).collect()
}

fn environment() -> BTreeMap<String, String> {
    let variables = std::env::vars_os();
    variables
        .map(|(name, value)| {
            let text = |text: std::ffi::OsString| text.to_string_lossy().into_owned();
            (text(name), text(value))
        })
        .collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Creates a host with only these files, no variables and no privileges.
    pub(in crate::doctor) fn host(files: &[(&str, &str)]) -> (tempfile::TempDir, HostState) {
        let directory = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = directory.path().join(path.trim_start_matches('/'));
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let host = HostState {
            files: Files::below(directory.path()),
            page_bytes: 4096,
            capabilities: CapabilitySet::empty(),
            user_id: 1000,
            group_ids: vec![1000],
            environment: BTreeMap::new(),
            clock: Err(ReadFailure::Missing),
        };
        (directory, host)
    }

    #[test]
    fn files_are_read_below_the_root_and_up_to_the_size_limit() {
        let long = "x".repeat(300 << 10);
        let (_directory, host) =
            host(&[("/proc/a", "12\n"), ("/proc/b", &long), ("/proc/7/c", "")]);
        assert_eq!(host.files.number::<u64>("/proc/a"), Ok(12));
        assert_eq!(host.files.text("/proc/b").unwrap().len(), 256 << 10);
        assert_eq!(host.files.bytes("/proc/b", 3).unwrap(), b"xxx");
        assert_eq!(host.files.text("/proc/none"), Err(ReadFailure::Missing));
        let error = host.files.number::<u64>("/proc/b").unwrap_err();
        assert!(matches!(error, ReadFailure::Other(_)), "{error}");
        assert_eq!(host.files.processes(), [7]);
        assert!(host.files.exists("/proc/a") && !host.files.exists("/etc/passwd"));
    }

    #[test]
    fn the_state_of_this_host_can_be_read() {
        let host = HostState::read();
        assert!(host.files.processes().contains(&std::process::id()));
        assert!(host.page_bytes >= 4096);
        assert!(!host.environment.is_empty());
        assert!(!host.group_ids.is_empty());
    }
}
