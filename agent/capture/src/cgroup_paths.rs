//! Paths of control groups by number: a socket's cgroup is identified by the inode of its
//! directory.
//!
//! The table walks the version 2 hierarchy for new numbers, and remembers the results, including
//! numbers without a directory. A walk is bounded in directories and depth, and opens no file.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::DirEntryExt as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// Maximum number of directories per walk.
const MAX_DIRECTORIES: usize = 16_384;
/// Maximum number of levels per walk.
const MAX_DEPTH: usize = 24;
/// Number of hex digits of a container's id, and of those that tools show.
const CONTAINER_ID: usize = 64;
const CONTAINER_ID_SHOWN: usize = 12;

/// The control groups below a directory.
#[derive(Debug)]
pub struct CgroupPaths {
    root: PathBuf,
    /// `None`: no directory has this number.
    known: BTreeMap<u64, Option<String>>,
}

impl CgroupPaths {
    /// Creates an empty table for the mount point of the version 2 hierarchy.
    #[must_use]
    pub const fn new(root: PathBuf) -> Self {
        Self {
            root,
            known: BTreeMap::new(),
        }
    }

    /// Finds the paths of new numbers in `wanted`, and forgets numbers that are no longer in it.
    pub fn refresh(&mut self, wanted: &BTreeSet<u64>) {
        self.known.retain(|id, _| wanted.contains(id));
        let mut missing: BTreeSet<u64> = wanted.iter().copied().collect();
        missing.retain(|id| !self.known.contains_key(id));
        if missing.is_empty() {
            return;
        }
        let found = walk(&self.root, &mut missing);
        self.known.extend(found);
        self.known.extend(missing.iter().map(|id| (*id, None)));
    }

    /// Returns the path below the root, `/` for the root itself; `None` if the group is gone or was
    /// not in `wanted`.
    #[must_use]
    pub fn path(&self, id: u64) -> Option<&str> {
        self.known.get(&id)?.as_deref()
    }
}

/// Returns a readable name: the first digits of a container's id, else the systemd unit, else the
/// last part of the path.
#[must_use]
pub fn short_name(path: &str) -> &str {
    let parts = || path.rsplit('/').filter(|part| !part.is_empty());
    parts()
        .find_map(container)
        .or_else(|| parts().find(|part| part.ends_with(".service") || part.ends_with(".scope")))
        .or_else(|| parts().next())
        .unwrap_or("/")
}

/// Returns the container or the systemd service of a path: `container 0123456789ab`, or
/// `robot.service`; `None` for other groups.
#[must_use]
pub fn container_or_service(path: &str) -> Option<Cow<'_, str>> {
    let parts = || path.rsplit('/');
    let service = || parts().find(|part| part.ends_with(".service"));
    match parts().find_map(container) {
        Some(id) => Some(Cow::Owned(format!("container {id}"))),
        None => service().map(Cow::Borrowed),
    }
}

/// Returns the shortened id of `docker-<id>.scope`, `cri-containerd-<id>.scope` or `<id>`; `None`
/// for other names.
fn container(part: &str) -> Option<&str> {
    let name = part.strip_suffix(".scope").unwrap_or(part);
    let id = name.rsplit(['-', ':']).next()?;
    let is_id = id.len() == CONTAINER_ID && id.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_id.then(|| id.get(..CONTAINER_ID_SHOWN)).flatten()
}

/// Returns the paths of groups in `missing`, and removes them from it. Ends when `missing` is
/// empty.
fn walk(root: &Path, missing: &mut BTreeSet<u64>) -> Vec<(u64, Option<String>)> {
    let mut found = Vec::new();
    if let Ok(metadata) = fs::metadata(root)
        && missing.remove(&metadata.ino())
    {
        found.push((metadata.ino(), Some("/".to_owned())));
    }
    let mut directories = vec![(String::new(), 0)];
    let mut looked_at = 0;
    while let Some((path, depth)) = directories.pop() {
        looked_at += 1;
        if missing.is_empty() || looked_at > MAX_DIRECTORIES {
            break;
        }
        let Ok(entries) = fs::read_dir(root.join(path.trim_start_matches('/'))) else {
            continue;
        };
        for entry in entries.flatten() {
            if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                continue;
            }
            let below = format!("{path}/{}", entry.file_name().to_string_lossy());
            if missing.remove(&entry.ino()) {
                found.push((entry.ino(), Some(below.clone())));
            }
            if depth < MAX_DEPTH {
                directories.push((below, depth + 1));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_resolves_to_a_path_and_a_missing_one_is_not_searched_again() {
        let root = tempfile::tempdir().unwrap();
        let service = root.path().join("system.slice/robot.service");
        fs::create_dir_all(&service).unwrap();
        fs::write(root.path().join("system.slice/cgroup.procs"), "").unwrap();
        let inode = |path: &Path| fs::metadata(path).unwrap().ino();
        let (top, below) = (inode(root.path()), inode(&service));
        let gone = 1;
        let mut groups = CgroupPaths::new(root.path().to_path_buf());
        assert_eq!(groups.path(below), None);
        groups.refresh(&BTreeSet::from([top, below, gone]));
        assert_eq!(groups.path(top), Some("/"));
        assert_eq!(groups.path(below), Some("/system.slice/robot.service"));
        assert_eq!(groups.path(gone), None);
        // No number is new, so no walk takes place: the old path stays.
        fs::rename(&service, root.path().join("system.slice/other.service")).unwrap();
        groups.refresh(&BTreeSet::from([below, gone]));
        assert_eq!(groups.path(below), Some("/system.slice/robot.service"));
        assert_eq!(groups.path(top), None);
        groups.refresh(&BTreeSet::new());
        groups.refresh(&BTreeSet::from([below]));
        assert_eq!(groups.path(below), Some("/system.slice/other.service"));
    }

    #[test]
    fn a_missing_hierarchy_yields_no_path() {
        let mut groups = CgroupPaths::new(PathBuf::from("/nonexistent"));
        groups.refresh(&BTreeSet::from([1]));
        assert_eq!(groups.path(1), None);
    }

    #[test]
    fn a_short_name_is_a_container_id_or_a_systemd_unit() {
        let id = "0123456789abcdef".repeat(4);
        let short = "0123456789ab";
        for path in [
            format!("/system.slice/docker-{id}.scope"),
            format!("/docker/{id}"),
            format!("/docker/{id}/system.slice/inside.service"),
            format!("/kubepods.slice/kubepods-pod7.slice/cri-containerd-{id}.scope"),
            format!("/kubepods/besteffort/pod7/{id}"),
            format!("/machine.slice/libpod-{id}.scope/container"),
        ] {
            assert_eq!(short_name(&path), short, "{path}");
            let shown = container_or_service(&path);
            assert_eq!(shown.as_deref(), Some("container 0123456789ab"), "{path}");
        }
        for (path, name) in [
            ("/", "/"),
            ("/system.slice/robot.service", "robot.service"),
            ("/system.slice/robot.service/nodes", "robot.service"),
            (
                "/user.slice/user-0.slice/session-3.scope",
                "session-3.scope",
            ),
            ("/robots/arm", "arm"),
            ("/robots/0123456789abcdef", "0123456789abcdef"),
        ] {
            assert_eq!(short_name(path), name);
            let service = Some(name).filter(|name| name.ends_with(".service"));
            assert_eq!(container_or_service(path).as_deref(), service, "{path}");
        }
    }
}
