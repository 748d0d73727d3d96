//! What `rp ship --status` prints, and the file in which a running shipper leaves it.

use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::state::{read_json, write_json_unsynced};

/// Name of the file.
const FILE: &str = "status.json";

/// State of a delivery.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Time of this state, RFC 3339.
    pub at: String,
    /// Process id of the shipper.
    pub process_id: u32,
    /// Bags that wait, the next one first: at most 100 of them.
    pub waiting: Vec<String>,
    /// Number of all bags that wait.
    pub waiting_bags: u64,
    /// Bytes of all bags that wait.
    pub waiting_bytes: u64,
    /// Number of bags that are still being recorded, or have just changed.
    pub unfinished_bags: u64,
    /// Bag that is being delivered.
    pub uploading: Option<Uploading>,
    /// Number of bags that were delivered since the first start.
    pub delivered_bags: u64,
    /// Bytes of these bags.
    pub delivered_bytes: u64,
    /// Number of delivered bags that were deleted on the robot.
    pub deleted_bags: u64,
    /// The latest delivered bag.
    pub last_delivered: Option<Delivered>,
    /// The latest failure.
    pub last_failure: Option<Failure>,
    /// Seconds until a window opens; zero if one is open.
    pub opens_in_seconds: u64,
}

/// A bag that is being delivered.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Uploading {
    /// Name of the bag.
    pub bag: String,
    /// Its size in bytes.
    pub bytes: u64,
    /// Bytes of it that the destination has.
    pub done_bytes: u64,
}

/// A delivered bag.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Delivered {
    /// Name of the bag.
    pub bag: String,
    /// Name of its directory at the destination, with that of the robot.
    pub path: String,
    /// Time of the delivery, RFC 3339.
    pub at: String,
}

/// A failure.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Name of the bag.
    pub bag: String,
    /// What failed.
    pub reason: String,
    /// Time of the failure, RFC 3339.
    pub at: String,
}

/// Why the state of a delivery cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum StatusError {
    /// No shipper has left a state.
    #[error("no delivery has begun: {} has no {FILE}", .0.display())]
    Missing(PathBuf),
    /// This user may not read it.
    #[error("cannot read {}: use sudo, or join the group ros2probe", .0.display())]
    Denied(PathBuf),
    /// A loss of power can leave an empty file.
    #[error("{} is damaged: `rp ship` replaces it", .0.display())]
    Damaged(PathBuf),
    /// The disk refuses.
    #[error("cannot read {}", .0.display())]
    Read(PathBuf, #[source] io::Error),
}

/// Maximum number of bags that are listed.
pub(crate) const MAX_LISTED: usize = 100;

impl Status {
    /// Reads the state that a shipper left in its directory.
    ///
    /// # Errors
    ///
    /// Fails if no shipper has left one, or if it cannot be read.
    pub fn read(directory: &Path) -> Result<Self, StatusError> {
        let path = path(directory);
        read_json(&path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => StatusError::Missing(directory.to_owned()),
            io::ErrorKind::PermissionDenied => StatusError::Denied(path),
            io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof => StatusError::Damaged(path),
            _ => StatusError::Read(path, error),
        })
    }

    /// Writes the state. It is not forced to the disk: no delivery depends on it.
    pub(crate) fn write(&mut self, directory: &Path) -> io::Result<()> {
        self.at = now();
        self.process_id = std::process::id();
        write_json_unsynced(&path(directory), self)
    }

    /// Returns whether only times differ.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        let without_times = |status: &Self| Self {
            at: String::new(),
            opens_in_seconds: u64::from(status.opens_in_seconds > 0),
            ..status.clone()
        };
        without_times(self) == without_times(other)
    }
}

/// Returns the time in RFC 3339, to the second.
pub(crate) fn now() -> String {
    let now = Timestamp::now();
    Timestamp::from_second(now.as_second())
        .unwrap_or(now)
        .to_string()
}

fn path(directory: &Path) -> PathBuf {
    directory.join(FILE)
}
