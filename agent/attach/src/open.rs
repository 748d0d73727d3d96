//! Opens a library's file without trusting its path, its file system or the process that maps it.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Component, Path, PathBuf};

use rustix::fs::{AtFlags, CWD, Mode, OFlags, StatxFlags, fstatfs, openat, statx};
use rustix::io::Errno;

use crate::functions::Library;
use crate::mapped::{Mapped, Use};
use crate::request::Place;

/// Flags that keep an open from blocking: a file whose open blocks is not a library.
const NONBLOCKING_FLAGS: OFlags = OFlags::NONBLOCK.union(OFlags::NOCTTY);
/// Prefix of the names of file systems in user space.
const USER_SPACE: &str = "fuse";
/// Maximum number of bytes read of a process's mounts.
const MAX_MOUNTS: u64 = 1 << 20;
/// Types of file systems that answer without another process or host (`linux/magic.h`, statfs(2)):
/// ext4, xfs, btrfs, f2fs, tmpfs, ramfs, squashfs, erofs, ZFS. While the kernel attaches to a file
/// that never answers, no process of the host can fork.
const LOCAL_FILE_SYSTEMS: [u32; 9] = [
    0xef53,
    0x5846_5342,
    0x9123_683e,
    0xf2f5_2010,
    0x0102_1994,
    0x8584_58f6,
    0x7371_7368,
    0xe0f5_e1e2,
    0x2fc1_2fc1,
];
/// overlayfs, whose layers may be of any type.
const OVERLAYFS_MAGIC: u32 = 0x794c_7630;
/// Directories of installed libraries and of ROS distributions.
const LIBRARY_DIRECTORIES: [&str; 5] = [
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib",
    "/usr/lib64",
    "/usr/local/lib",
];
const DISTRIBUTIONS_PATH: &str = "/opt/ros";
/// Maximum number of ROS distributions whose libraries are listed.
const MAX_DISTRIBUTIONS: usize = 64;

/// Why a library's file is not used.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The file cannot be opened.
    #[error("cannot open the library")]
    Open(#[source] io::Error),
    /// The path is a directory or a device.
    #[error("not a file")]
    NoFile,
    /// The process does not map this file as the library.
    #[error("process {0} does not map it")]
    NotMapped(u32),
    /// The path is in none of the usual directories, or has another name than the library.
    #[error("not a library in one of the usual directories: {}", .0.display())]
    NotInstalled(PathBuf),
    /// The file system of the library may never answer.
    #[error("the library is on a file system ({0}) that may hang: install it on a local disk")]
    MayNotAnswer(String),
    /// The path in the process's file system now names another file.
    #[error("the library file was replaced: restart the process")]
    Replaced,
}

/// Opens a library's file, and returns its path for the log.
///
/// # Errors
/// Fails if the place is not a file of the library, or if the file cannot be opened.
pub fn open(place: &Place, library: Library) -> Result<(File, PathBuf), OpenError> {
    match place {
        Place::Installed(path) => {
            let file = open_installed(path, library)?;
            check_file_system(&file, None)?;
            Ok((file, path.clone()))
        }
        Place::Mapped { process, id } => {
            // The mapping is read again, so nothing that the request names is trusted.
            let used = Use::read(*process, library).map_err(OpenError::Open)?;
            let mut mapped = used.libraries.into_iter();
            let mapped = mapped.find(|mapped| mapped.id == *id);
            let mapped = mapped.ok_or(OpenError::NotMapped(*process))?;
            check_mount(*process, &mapped.id.device)?;
            let file = open_mapped(*process, &mapped)?;
            check_file_system(&file, Some(*process))?;
            // The process may have mapped another file at this address in between.
            let now = Use::read(*process, library).map_err(OpenError::Open)?;
            match now.libraries.contains(&mapped) {
                true => Ok((file, mapped.path)),
                false => Err(OpenError::NotMapped(*process)),
            }
        }
    }
}

/// Returns libraries in the usual directories of this host, not of containers.
#[must_use]
pub fn installed(library: Library) -> Vec<PathBuf> {
    let entries = directories().into_iter().flat_map(fs::read_dir);
    let libraries = entries.flatten().flatten().filter(|entry| {
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        let name = entry.file_name();
        is_file && name.to_str().is_some_and(|name| library.has_name(name))
    });
    libraries.map(|entry| entry.path()).collect()
}

fn directories() -> Vec<PathBuf> {
    let distributions = fs::read_dir(DISTRIBUTIONS_PATH)
        .into_iter()
        .flatten()
        .flatten();
    let distributions = distributions.take(MAX_DISTRIBUTIONS);
    let distributions = distributions.map(|entry| entry.path().join("lib"));
    LIBRARY_DIRECTORIES
        .iter()
        .map(PathBuf::from)
        .chain(distributions)
        .collect()
}

fn open_installed(path: &Path, library: Library) -> Result<File, OpenError> {
    let name = path.file_name().and_then(|name| name.to_str());
    let is_library = name.is_some_and(|name| library.has_name(name));
    let is_there = || {
        directories()
            .iter()
            .any(|each| Some(&**each) == path.parent())
    };
    if !is_library || !is_there() {
        return Err(OpenError::NotInstalled(path.to_path_buf()));
    }
    plain(openat(CWD, path, flags() | OFlags::NOFOLLOW, Mode::empty()))
}

/// Opens the file that a process maps, even if its path now names another one. `map_files` of
/// another user's process needs CAP_CHECKPOINT_RESTORE and CAP_DAC_READ_SEARCH. Without them, the
/// path in the process's file system must be readable, and still name that file.
fn open_mapped(process: u32, mapped: &Mapped) -> Result<File, OpenError> {
    let file = format!("/proc/{process}/map_files/{}", mapped.range);
    match plain(openat(CWD, &file, flags(), Mode::empty())) {
        Err(OpenError::Open(error)) if error.kind() == io::ErrorKind::PermissionDenied => {
            open_by_path(error, process, mapped)
        }
        opened => opened,
    }
}

/// Opens a mapped file by its path, and follows no link. The kernel has resolved the path, so a
/// link was created later. Behind `/proc/<pid>/root`, an absolute link would lead to files of the
/// host.
fn open_by_path(refused: io::Error, process: u32, mapped: &Mapped) -> Result<File, OpenError> {
    let mut names = Vec::new();
    for component in mapped.path.components() {
        match component {
            Component::RootDir => {}
            Component::Normal(name) => names.push(name),
            _ => return Err(OpenError::Open(refused)),
        }
    }
    let Some((last, directories)) = names.split_last() else {
        return Err(OpenError::Open(refused));
    };
    let directory = OFlags::PATH | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let root = format!("/proc/{process}/root");
    let mut at = openat(CWD, &root, directory, Mode::empty()).map_err(not_opened)?;
    for name in directories {
        let plain = directory | OFlags::NOFOLLOW;
        at = openat(&at, *name, plain, Mode::empty()).map_err(not_opened)?;
    }
    let file = openat(&at, *last, flags() | OFlags::NOFOLLOW, Mode::empty()).map_err(not_opened)?;
    let file = regular(File::from(file))?;
    match file.metadata().map_err(OpenError::Open)?.ino() == mapped.id.inode {
        true => Ok(file),
        false => Err(OpenError::Replaced),
    }
}

/// Maps an error of `openat`. A link, or a file in place of a directory, appeared after the library
/// was mapped.
fn not_opened(error: Errno) -> OpenError {
    match error {
        Errno::LOOP | Errno::NOTDIR | Errno::NOENT => OpenError::Replaced,
        error => OpenError::Open(error.into()),
    }
}

/// Fails unless the file is on a local file system. An overlay counts as local if only root can
/// have mounted it: `process`, which maps the file, then sees this mount. It is also in the
/// broker's user namespace. A user's overlay in a user namespace may lie on FUSE, and another process can
/// open its files through `/proc/<pid>/root`.
fn check_file_system(file: &File, process: Option<u32>) -> Result<(), OpenError> {
    let kind = fstatfs(file)
        .map_err(|error| OpenError::Open(error.into()))?
        .f_type;
    let kind = u32::try_from(kind & 0xffff_ffff).unwrap_or_default();
    let by_root = || {
        let has_mount = |process| has_mount_of_root(process, file).unwrap_or(false);
        process.is_none_or(has_mount)
    };
    match LOCAL_FILE_SYSTEMS.contains(&kind) || kind == OVERLAYFS_MAGIC && by_root() {
        true => Ok(()),
        false => Err(OpenError::MayNotAnswer(format!("{kind:#x}"))),
    }
}

/// Returns whether a process sees the mount of a file, and is in the broker's user namespace.
fn has_mount_of_root(process: u32, file: &File) -> io::Result<bool> {
    // The descriptor refers to the same process even if another one receives its id.
    let directory = File::open(format!("/proc/{process}"))?;
    let of_it = format!("/proc/self/fd/{}", directory.as_raw_fd());
    let status = statx(file, "", AtFlags::EMPTY_PATH, StatxFlags::MNT_ID)?;
    let mut mounts = Vec::new();
    let listed = File::open(format!("{of_it}/mountinfo"))?;
    listed.take(MAX_MOUNTS).read_to_end(&mut mounts)?;
    let has_mount = has_mount(&String::from_utf8_lossy(&mounts), status.stx_mnt_id);
    // A process that leaves the namespace cannot return, so it was there when the mounts were read.
    let is_in_own = || {
        let own = fs::read_link("/proc/self/ns/user")?;
        io::Result::Ok(fs::read_link(format!("{of_it}/ns/user"))? == own)
    };
    Ok(has_mount && is_in_own()?)
}

/// Returns whether a mount is in the lines of `mountinfo` (proc_pid_mountinfo(5)).
fn has_mount(mounts: &str, id: u64) -> bool {
    let mut ids = mounts.lines().filter_map(|line| line.split(' ').next());
    ids.any(|each| each.parse() == Ok(id))
}

/// Fails if a library is on a file system in user space. Opening such a file may block forever.
fn check_mount(process: u32, device: &str) -> Result<(), OpenError> {
    let mut text = Vec::new();
    // Without the list, the library is opened: it usually lies on a disk.
    if let Ok(file) = File::open(format!("/proc/{process}/mountinfo")) {
        let _ = file.take(MAX_MOUNTS).read_to_end(&mut text);
    }
    match file_system(&String::from_utf8_lossy(&text), device) {
        Some(name) if name.starts_with(USER_SPACE) => Err(OpenError::MayNotAnswer(name.to_owned())),
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

fn flags() -> OFlags {
    OFlags::RDONLY | OFlags::CLOEXEC | NONBLOCKING_FLAGS
}

fn plain(opened: rustix::io::Result<rustix::fd::OwnedFd>) -> Result<File, OpenError> {
    let file = opened.map_err(|error| match error {
        Errno::LOOP => OpenError::NoFile,
        error => OpenError::Open(error.into()),
    });
    regular(File::from(file?))
}

fn regular(file: File) -> Result<File, OpenError> {
    match file.metadata().map_err(OpenError::Open)?.is_file() {
        true => Ok(file),
        false => Err(OpenError::NoFile),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapped::LibraryId;

    const MOUNTS: &str = "\
        22 1 254:0 / / rw,relatime shared:1 - ext4 /dev/vda rw\n\
        61 22 0:55 / /home/u/my\\040lib rw,nosuid - fuse.sshfs u@h:/ rw,user_id=1000\n\
        62 22 0:56 / /mnt rw - fuseblk /dev/sda1 rw\n";

    #[test]
    fn the_file_system_of_a_library_is_found_by_its_device() {
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
    fn a_mount_is_found_by_its_id_alone() {
        assert!(has_mount(MOUNTS, 22) && has_mount(MOUNTS, 62));
        for other in [1, 2, 55, 254, u64::MAX] {
            assert!(!has_mount(MOUNTS, other), "{other}");
        }
        let file = File::open("/proc/self/exe").unwrap();
        assert!(has_mount_of_root(std::process::id(), &file).unwrap());
        assert!(has_mount_of_root(u32::MAX, &file).is_err());
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
        let own = std::process::id();
        let denied = io::Error::from(io::ErrorKind::PermissionDenied);
        let opened = open_by_path(denied, own, &mapped(inode));
        assert!(opened.is_ok());
        let denied = io::Error::from(io::ErrorKind::PermissionDenied);
        let opened = open_by_path(denied, own, &mapped(inode + 1));
        assert!(matches!(opened, Err(OpenError::Replaced)));
    }

    #[test]
    fn a_link_in_the_path_of_a_library_is_not_followed() {
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
            assert!(matches!(opened, Err(OpenError::Replaced)), "{opened:?}");
        }
    }

    #[test]
    fn a_library_outside_of_the_usual_directories_is_not_opened_by_its_path() {
        let directory = tempfile::tempdir().unwrap();
        let own = directory.path().join("libtracetools.so");
        fs::write(&own, "x").unwrap();
        for path in [
            own.to_str().unwrap(),
            "/etc/shadow",
            "/usr/lib/../../etc/shadow",
            "/usr/lib/../../tmp/libtracetools.so",
            "/opt/ros/humble/lib/../libtracetools.so",
            "/usr/lib/libc.so.6",
            "libtracetools.so",
            "",
        ] {
            let place = Place::Installed(PathBuf::from(path));
            let opened = open(&place, Library::Tracing);
            assert!(matches!(opened, Err(OpenError::NotInstalled(_))), "{path}");
        }
    }

    #[test]
    fn a_file_that_the_process_does_not_map_as_the_library_is_not_opened() {
        let file = fs::metadata("/etc/passwd").unwrap();
        for inode in [file.ino(), 0, u64::MAX] {
            let place = Place::Mapped {
                process: std::process::id(),
                id: LibraryId {
                    device: "fe:00".to_owned(),
                    inode,
                },
            };
            let opened = open(&place, Library::Tracing);
            assert!(matches!(opened, Err(OpenError::NotMapped(_))));
        }
        let place = Place::Mapped {
            process: u32::MAX,
            id: LibraryId {
                device: String::new(),
                inode: 1,
            },
        };
        assert!(matches!(
            open(&place, Library::FastDds),
            Err(OpenError::Open(_))
        ));
    }
}
