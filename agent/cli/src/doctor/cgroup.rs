//! The hierarchy of control groups, found in the same way as by the capture.

use std::path::{Path, PathBuf};

use ros2probe_capture::cgroup::{Cgroup, CgroupError, has_version_1, topmost};

/// The cgroup v2 hierarchy as this process sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CgroupHierarchy {
    /// No hierarchy is mounted.
    NotMounted,
    /// Only hierarchies of version 1 are mounted.
    Version1,
    /// The hierarchy of the whole host, at this mount point.
    WholeHost(PathBuf),
    /// A part of the hierarchy, as in containers, at this mount point.
    Part(PathBuf),
    /// The hierarchy at this mount point cannot be opened, for this reason.
    Unopened(PathBuf, String),
    /// The mount point is not a cgroup, for this reason.
    Invalid(PathBuf, String),
}

impl CgroupHierarchy {
    /// Finds the hierarchy in `mounts`, the content of `/proc/self/mountinfo`. `at` maps an
    /// absolute path to the file to open.
    #[must_use]
    pub fn find(mounts: &[u8], at: impl Fn(&Path) -> PathBuf) -> Self {
        let Some(point) = topmost(mounts) else {
            return match has_version_1(mounts) {
                true => Self::Version1,
                false => Self::NotMounted,
            };
        };
        match Cgroup::open(&at(&point)) {
            Ok(group) if group.is_whole_host() => Self::WholeHost(point),
            Ok(_) => Self::Part(point),
            Err(CgroupError::Open { source, .. }) => Self::Unopened(point, source.to_string()),
            Err(error) => Self::Invalid(point, error.to_string()),
        }
    }
}
