//! Finds the control group hierarchy (v2) to which the host hook is attached.
//!
//! The module reads `/proc/self/mountinfo` (`man 5 proc_pid_mountinfo`), and mounts and creates
//! nothing.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::os::unix::ffi::OsStringExt as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use super::container::{CGROUP_OPTIONS, otherwise};

const MOUNTS_PATH: &str = "/proc/self/mountinfo";
/// Inode of the root group, which is its id and the same on every host.
const ROOT_INODE: u64 = 1;

/// Why a control group cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CgroupError {
    /// The list of mounts cannot be read.
    #[error("cannot read {MOUNTS_PATH}")]
    Mounts(#[source] io::Error),
    /// Only v1 is mounted, or no hierarchy at all.
    #[error(
        "no cgroup v2 hierarchy is mounted{}",
        otherwise(CGROUP_OPTIONS, " (`rp doctor` shows how)")
    )]
    NotMounted,
    /// The directory cannot be opened.
    #[error("cannot open the control group {}", path.display())]
    Open {
        /// Path of the control group.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The path is not a control group.
    #[error("{} is not a control group of the hierarchy v2", path.display())]
    Other {
        /// The path.
        path: PathBuf,
    },
}

/// One control group.
#[derive(Debug)]
pub struct Cgroup {
    path: PathBuf,
    directory: File,
    whole_host: bool,
}

impl Cgroup {
    /// Opens the topmost group that this process can see.
    ///
    /// # Errors
    /// Fails if no hierarchy is mounted.
    pub fn topmost() -> Result<Self, CgroupError> {
        Self::open(&mount_point()?)
    }

    /// Opens the group at `path`.
    ///
    /// # Errors
    /// Fails if the path does not exist or is not a control group.
    pub fn open(path: &Path) -> Result<Self, CgroupError> {
        let failed = |source| CgroupError::Open {
            path: path.to_path_buf(),
            source,
        };
        let directory = File::open(path).map_err(failed)?;
        let inode = directory.metadata().map_err(failed)?.ino();
        // Every group of v2 has this file, groups of v1 and plain directories do not; the kernel
        // would only report "bad file descriptor".
        if !path.join("cgroup.controllers").exists() {
            let path = path.to_path_buf();
            return Err(CgroupError::Other { path });
        }
        Ok(Self {
            path: path.to_path_buf(),
            directory,
            whole_host: inode == ROOT_INODE,
        })
    }

    /// Returns the path of the group.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the open directory, for attaching programs.
    #[must_use]
    pub const fn directory(&self) -> &File {
        &self.directory
    }

    /// Returns whether the group contains every process of the host: it is the root group, not that
    /// of a container.
    #[must_use]
    pub const fn is_whole_host(&self) -> bool {
        self.whole_host
    }
}

/// Returns the mount point that shows the largest part of the hierarchy.
///
/// # Errors
/// Fails if no hierarchy is mounted.
pub fn mount_point() -> Result<PathBuf, CgroupError> {
    let mounts = fs::read(MOUNTS_PATH).map_err(CgroupError::Mounts)?;
    topmost(&mounts).ok_or(CgroupError::NotMounted)
}

/// Returns the mount point whose root is closest to the root of the hierarchy.
#[must_use]
pub fn topmost(mounts: &[u8]) -> Option<PathBuf> {
    let found = mounts
        .split(|byte| *byte == b'\n')
        .filter_map(|line| mount(line, b"cgroup2"))
        .min_by_key(|mount| mount.root.len())?;
    Some(PathBuf::from(OsString::from_vec(found.point)))
}

/// Returns whether a hierarchy of version 1 is mounted.
#[must_use]
pub fn has_version_1(mounts: &[u8]) -> bool {
    let mut lines = mounts.split(|byte| *byte == b'\n');
    lines.any(|line| mount(line, b"cgroup").is_some())
}

struct Mount {
    /// Root of the mount within the hierarchy.
    root: Vec<u8>,
    /// Path of the mount point.
    point: Vec<u8>,
}

/// Parses a line about this type of file system. Its fields are number, parent, device, root, mount
/// point, options, optional fields, a dash, and type.
fn mount(line: &[u8], file_system: &[u8]) -> Option<Mount> {
    let mut fields = line.split(|byte| *byte == b' ');
    let root = unescape(fields.nth(3)?);
    let point = unescape(fields.next()?);
    fields.find(|field| *field == b"-")?;
    (fields.next()? == file_system).then_some(Mount { root, point })
}

/// Decodes space, tab, newline and backslash, which are written as three octal digits.
fn unescape(field: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(field.len());
    let mut rest = field;
    while let Some((byte, tail)) = rest.split_first() {
        let octal = tail.get(..3).filter(|_| *byte == b'\\').and_then(|digits| {
            let digits = std::str::from_utf8(digits).ok()?;
            u8::from_str_radix(digits, 8).ok()
        });
        bytes.push(octal.unwrap_or(*byte));
        rest = if octal.is_some() {
            tail.get(3..).unwrap_or_default()
        } else {
            tail
        };
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topmost_of(mounts: &str) -> Option<String> {
        topmost(mounts.as_bytes()).map(|path| path.display().to_string())
    }

    #[test]
    fn the_hierarchy_is_found_wherever_it_is_mounted() {
        let unified = "24 18 0:22 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw";
        assert_eq!(topmost_of(unified).unwrap(), "/sys/fs/cgroup");
        let hybrid = "\
30 23 0:25 / /sys/fs/cgroup ro shared:9 - tmpfs tmpfs ro,mode=755
31 30 0:26 / /sys/fs/cgroup/unified rw shared:10 master:3 - cgroup2 cgroup2 rw,nsdelegate
32 30 0:27 / /sys/fs/cgroup/systemd rw - cgroup cgroup rw,xattr,name=systemd
";
        assert_eq!(topmost_of(hybrid).unwrap(), "/sys/fs/cgroup/unified");
        let v1 = "32 30 0:27 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu";
        assert_eq!(topmost_of(v1), None);
        assert_eq!(topmost_of("\n - cgroup2\n1 2 3 4\n"), None);
    }

    #[test]
    fn the_mount_that_shows_most_of_the_hierarchy_is_preferred() {
        let mounts = "\
31 30 0:26 /docker/abc /sys/fs/cgroup ro - cgroup2 cgroup rw
40 30 0:26 / /host\\040sys/fs/cgroup ro - cgroup2 cgroup rw
";
        assert_eq!(topmost_of(mounts).unwrap(), "/host sys/fs/cgroup");
        // A backslash that starts no escape, and a truncated escape.
        assert_eq!(unescape(br"a\9990\04"), br"a\9990\04");
    }

    #[test]
    fn this_host_has_a_cgroup_and_a_plain_directory_is_rejected() {
        let topmost = Cgroup::topmost().unwrap();
        assert!(topmost.path().join("cgroup.procs").exists());
        let other = Cgroup::open(Path::new("/proc")).unwrap_err();
        assert_eq!(
            other.to_string(),
            "/proc is not a control group of the hierarchy v2"
        );
        let missing = Cgroup::open(Path::new("/sys/fs/cgroup/no such")).unwrap_err();
        assert!(missing.to_string().contains("no such"), "{missing}");
    }
}
