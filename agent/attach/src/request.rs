//! Requests to the broker, and its answers: one JSON object in each packet.
//!
//! Answers that exceed a packet come in parts, and [`Answer::End`] follows the last one.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::functions::{Calls, Library};
use crate::kernel;
use crate::mapped::{LibraryId, Use};

/// Socket of the packaged broker.
pub const SOCKET: &str = "/run/ros2probe-attach.sock";
/// First release of Linux with links of many functions.
const HAS_LINKS: (u32, u32) = (6, 6);
/// Maximum size of a packet, in bytes.
pub const MAX_PACKET: usize = 64 << 10;
/// Maximum number of processes that one request names.
pub const MAX_PROCESSES: usize = 1024;
/// Maximum number of descriptors in one packet, `SCM_MAX_FD` of the kernel.
pub const MAX_DESCRIPTORS: usize = 253;
/// Time in which a request is answered. A fork that needs longer is killed.
pub const REQUEST_TIMEOUT: Duration = Duration::from_secs(4);
/// Timeout of a request for a process's environment, which is short.
const ENVIRONMENT_TIMEOUT: Duration = Duration::from_millis(500);

/// A request with its number, which its answers repeat.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Numbered<T> {
    /// Number of the request.
    pub number: u64,
    /// The request, or a part of its answer.
    pub content: T,
}

/// The requests that the broker accepts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Ids of all processes of this host, in parts of [`Answer::Processes`].
    Processes,
    /// Processes among the given ones that use a library, in parts of [`Answer::Uses`]. Processes
    /// that do not use it are left out.
    Uses {
        /// The library.
        library: Library,
        /// At most [`MAX_PROCESSES`] process ids.
        processes: Vec<u32>,
    },
    /// Name, start and CPU time of processes, in parts of [`Answer::Activities`].
    Activities {
        /// At most [`MAX_PROCESSES`] process ids.
        processes: Vec<u32>,
    },
    /// Domain in the environment of a process that uses one of the libraries: [`Answer::Domain`].
    Domain {
        /// Id of the process.
        process: u32,
    },
    /// Attaches the programs of the request to functions of a library:
    /// [`Answer::Attached`].
    Attach {
        /// The functions.
        calls: Calls,
        /// The file.
        place: Place,
        /// Means of attaching.
        means: AttachMethod,
    },
    /// Perf events that report which process maps a file, one for each CPU: [`Answer::Mappings`].
    Mappings,
}

impl Request {
    /// Returns the time in which the request is answered.
    #[must_use]
    pub const fn timeout(&self) -> Duration {
        match self {
            Self::Domain { .. } => ENVIRONMENT_TIMEOUT,
            _ => REQUEST_TIMEOUT,
        }
    }
}

/// A library's file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Place {
    /// A file in one of the [usual directories](crate::open::installed) of this host.
    Installed(PathBuf),
    /// A file that a process maps.
    Mapped {
        /// The process.
        process: u32,
        /// The file.
        id: LibraryId,
    },
}

/// Means of attaching programs to functions.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttachMethod {
    /// One link for all functions of a library, since Linux 6.6. The cookie of a function is its
    /// index in [`Calls::programs`].
    Links,
    /// One perf event for each function.
    PerfEvents,
}

impl AttachMethod {
    /// Returns the best means that this kernel has.
    #[must_use]
    pub fn of_this_kernel() -> Self {
        match kernel::release() {
            Some(release) if release >= HAS_LINKS => Self::Links,
            _ => Self::PerfEvents,
        }
    }
}

/// The broker's answer, or a part of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Answer {
    /// Process ids.
    Processes(Vec<u32>),
    /// Processes that use a library, and processes whose mappings cannot be read.
    Uses {
        /// Processes with their use of the library.
        used: Vec<(u32, Use)>,
        /// Processes that the broker may not read.
        closed: Vec<u32>,
    },
    /// State of processes; those that ended are left out.
    Activities(Vec<Activity>),
    /// `ROS_DOMAIN_ID`, 0 without one; `None` if the environment cannot be read.
    Domain(Option<u32>),
    /// The descriptors of the breakpoints come with this answer. Closing them removes the
    /// breakpoints.
    Attached {
        /// The functions that the library has, by their names in [`Calls::programs`].
        functions: Vec<String>,
    },
    /// The descriptors of the perf events come with this answer.
    Mappings,
    /// No more parts follow.
    End,
    /// The broker refuses the request, for this reason.
    Refused(String),
}

impl Answer {
    /// Returns whether no further part follows.
    #[must_use]
    pub const fn is_last(&self) -> bool {
        !matches!(
            self,
            Self::Processes(_) | Self::Uses { .. } | Self::Activities(_)
        )
    }
}

/// State of a process, from `/proc/<pid>/stat` (proc_pid_stat(5)).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Activity {
    /// Id of the process.
    pub process: u32,
    /// Name of the process.
    pub name: String,
    /// CPU time so far, user and system, in nanoseconds.
    pub cpu_nanoseconds: u64,
    /// Start in clock ticks since boot, which differs for processes with the same id.
    pub started: u64,
}
