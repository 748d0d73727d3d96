//! Disk usage of recordings: limits per bag and in total, and space that must stay free.
//!
//! The limits are checked before each message, so that a recording ends in order before the disk is
//! full. The file system is checked every few megabytes and every second; several recordings may
//! exceed a limit by that amount.

use std::io;
use std::path::{Path, PathBuf};

use crate::config::RecordingLimits;
use ros2probe_bag::Error;

/// Bytes of messages between two checks of the file system.
const CHECK_INTERVAL_BYTES: u64 = 8 << 20;

/// Quota of one recording.
#[derive(Clone, Debug)]
pub struct DiskQuota {
    /// Parent directory of all bags.
    directory: PathBuf,
    limits: RecordingLimits,
    /// Bytes taken since the last check.
    unseen: u64,
}

/// A limit was reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
enum QuotaExceeded {
    #[error("the recording would be larger than {0} bytes (recordings.max_bytes)")]
    Bag(u64),
    #[error("all recordings use {used} of {limit} bytes (recordings.max_total_bytes)")]
    Total { used: u64, limit: u64 },
    #[error(
        "the file system has {free} free bytes, and {reserve} must stay free \
         (recordings.reserve_percent, recordings.reserve_bytes)"
    )]
    Reserve { free: u64, reserve: u64 },
}

impl DiskQuota {
    /// Creates a quota for bags below `directory`, which may not exist yet.
    #[must_use]
    pub fn new(directory: &Path, limits: RecordingLimits) -> Self {
        Self {
            directory: directory.to_owned(),
            limits,
            unseen: 0,
        }
    }

    /// Takes quota for `more` bytes in a bag of `bag` bytes.
    ///
    /// # Errors
    ///
    /// Fails if a limit would be exceeded.
    pub fn take(&mut self, bag: u64, more: u64) -> Result<(), Error> {
        if let Some(limit) = self.limits.max_bytes
            && bag.saturating_add(more) > limit
        {
            return Err(QuotaExceeded::Bag(limit).into());
        }
        self.unseen = self.unseen.saturating_add(more);
        if self.unseen >= CHECK_INTERVAL_BYTES {
            self.unseen = 0;
            self.check()?;
        }
        Ok(())
    }

    /// Checks the file system.
    ///
    /// # Errors
    ///
    /// Fails if a limit is exceeded.
    pub fn check(&self) -> Result<(), Error> {
        if let Some(limit) = self.limits.max_total_bytes {
            let used = used(&self.directory);
            if used >= limit {
                return Err(QuotaExceeded::Total { used, limit }.into());
            }
        }
        // If the query fails, writing reports the error.
        let Ok(space) = space(&self.directory) else {
            return Ok(());
        };
        let percent = u64::from(self.limits.reserve_percent);
        let reserve = (space.size / 100 * percent).max(self.limits.reserve_bytes);
        // Without a reserve, the storage itself reports a full disk.
        if reserve > 0 && space.free <= reserve {
            let free = space.free;
            return Err(QuotaExceeded::Reserve { free, reserve }.into());
        }
        Ok(())
    }
}

impl From<QuotaExceeded> for Error {
    fn from(full: QuotaExceeded) -> Self {
        Self::Limit(full.to_string())
    }
}

/// Returns the size of all files in the subdirectories of `directory`, in bytes.
fn used(directory: &Path) -> u64 {
    let entries = |path: &Path| std::fs::read_dir(path).into_iter().flatten().flatten();
    let bags = entries(directory);
    let files = bags.flat_map(|bag| entries(&bag.path()).collect::<Vec<_>>());
    let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
    sizes.fold(0, u64::saturating_add)
}

/// Space of a file system, in bytes.
struct FilesystemSpace {
    size: u64,
    /// Free space available to users without privileges.
    free: u64,
}

/// Returns the space of the file system of an existing or future directory.
fn space(directory: &Path) -> io::Result<FilesystemSpace> {
    let existing = directory.ancestors().find(|path| path.exists());
    let path = existing.unwrap_or(directory);
    let statistics = rustix::fs::statvfs(path)?;
    let bytes = |blocks: u64| blocks.saturating_mul(statistics.f_frsize);
    Ok(FilesystemSpace {
        size: bytes(statistics.f_blocks),
        free: bytes(statistics.f_bavail),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quota(directory: &Path, limits: RecordingLimits) -> DiskQuota {
        DiskQuota::new(directory, limits)
    }

    fn refused(result: Result<(), Error>) -> String {
        result.unwrap_err().to_string()
    }

    #[test]
    fn the_limits_of_a_bag_of_all_bags_and_of_the_reserve_are_enforced() {
        let directory = tempfile::tempdir().unwrap();
        let bags = directory.path().join("bags");
        let none = RecordingLimits {
            reserve_percent: 0,
            reserve_bytes: 0,
            ..RecordingLimits::default()
        };
        let mut each = quota(
            &bags,
            RecordingLimits {
                max_bytes: Some(1000),
                ..none
            },
        );
        each.take(900, 100).unwrap();
        assert!(refused(each.take(900, 101)).contains("recordings.max_bytes"));

        let all = RecordingLimits {
            max_total_bytes: Some(100),
            ..none
        };
        quota(&bags, all).check().unwrap();
        std::fs::create_dir_all(bags.join("before")).unwrap();
        std::fs::write(bags.join("before/before_0.mcap"), [0; 100]).unwrap();
        assert!(refused(quota(&bags, all).check()).contains("recordings.max_total_bytes"));
        let mut stepping = quota(&bags, all);
        stepping.take(0, CHECK_INTERVAL_BYTES - 1).unwrap();
        assert!(stepping.take(0, 1).is_err(), "after every few megabytes");

        let free = space(&bags).unwrap().free;
        let reserve = RecordingLimits {
            reserve_bytes: free * 2,
            ..none
        };
        assert!(refused(quota(&bags, reserve).check()).contains("recordings.reserve_bytes"));
        let percent = RecordingLimits {
            reserve_percent: 100,
            ..none
        };
        assert!(refused(quota(&bags, percent).check()).contains("recordings.reserve_percent"));
        quota(&bags, none).check().unwrap();
    }
}
