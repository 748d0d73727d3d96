//! Facts about an observed process: start, name and CPU time.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_attach::request::Activity;

/// One reading of a process's state.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stat {
    /// Name of the process.
    pub name: Arc<str>,
    /// CPU time so far, user and system.
    pub cpu: Duration,
    /// Start in clock ticks since boot, which differs for processes with the same id.
    pub started: u64,
}

impl From<Activity> for Stat {
    fn from(activity: Activity) -> Self {
        Self {
            name: activity.name.into(),
            cpu: Duration::from_nanos(activity.cpu_nanoseconds),
            started: activity.started,
        }
    }
}
