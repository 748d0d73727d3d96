//! Examinations of this host for `rp doctor`, which use the code of the capture without an agent.

use std::error::Error;
use std::path::{Path, PathBuf};

use ros2probe_attach::functions::Library;
use ros2probe_capture::cgroup::{Cgroup, CgroupError, has_version_1, topmost};
use ros2probe_capture::error_chain::in_words;
pub use ros2probe_capture::system::ClockState;
use ros2probe_capture::system::clock_state;
use ros2probe_capture::uprobe;
use rustix::thread::CapabilitySet;

/// The cgroup v2 hierarchy as this process sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CgroupHierarchy {
    /// No hierarchy is mounted.
    NotMounted,
    /// The same, beside hierarchies of version 1.
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

/// Reads the state of the kernel's clock.
///
/// # Errors
///
/// Returns the kernel's error as text.
pub fn clock() -> Result<ClockState, String> {
    clock_state().map_err(|error| error.to_string())
}

/// Names of the capabilities that uprobes (`capture.shm.exact`, `capture.inside`) need and
/// `effective` lacks.
#[must_use]
pub fn uprobes_lack(effective: CapabilitySet) -> Vec<&'static str> {
    uprobe::lacking(effective)
}

/// Returns whether a file of this name is the library of Fast DDS.
#[must_use]
pub fn is_fast_dds(name: &str) -> bool {
    Library::FastDds.has_name(name)
}

/// Error and its causes in one line. Of a verifier log, only the first line.
#[must_use]
pub fn error_in_words(error: &dyn Error) -> String {
    in_words(error)
}
