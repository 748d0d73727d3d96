//! Space for the bags of one snapshot on disk. The oldest triggered bags are removed for new ones;
//! requested bags are kept.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::bag::TriggeredBag;
use crate::config::SnapshotSettings;

/// Space for a new bag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Space {
    /// Maximum size of the new bag, in bytes.
    pub(super) bytes: u64,
    /// Number of bags that were removed for the new one.
    pub(super) removed: u64,
    /// Number of the new bag. That of each earlier one is lower, whatever the clock was.
    pub(super) number: u64,
}

struct KeptBag {
    path: PathBuf,
    bytes: u64,
    number: u64,
    modified: SystemTime,
}

/// Removes the oldest triggered bags of the snapshot until the bag at `new` may have `needed`
/// bytes. At most `others` triggered bags remain beside it. Bags that may not be removed stay, and
/// count only by their bytes.
pub(super) fn make_space(
    new: &Path,
    settings: &SnapshotSettings,
    others: usize,
    needed: u64,
    may_remove: impl Fn(&Path) -> bool,
) -> Space {
    let limit = settings.max_total_bytes;
    let (mut triggered, mut used) = kept(new, settings);
    let last = triggered.iter().map(|bag| bag.number).max();
    triggered.retain(|bag| may_remove(&bag.path));
    // Bags of earlier versions have no number.
    triggered.sort_by_key(|bag| (bag.number, bag.modified));
    let mut count = triggered.len();
    let mut removed = 0;
    // Nothing is removed for a bag that cannot fit.
    if needed <= limit {
        for bag in triggered {
            if count <= others && used.saturating_add(needed) <= limit {
                break;
            }
            match fs::remove_dir_all(&bag.path) {
                Ok(()) => {
                    removed += 1;
                    used = used.saturating_sub(bag.bytes);
                }
                Err(error) => {
                    let bag = bag.path.display();
                    tracing::warn!(%bag, %error, "failed to remove the oldest bag of a snapshot");
                }
            }
            count -= 1;
        }
    }
    Space {
        bytes: limit.saturating_sub(used),
        removed,
        number: last.unwrap_or(0).saturating_add(1),
    }
}

/// Returns the triggered bags of the snapshot, and the bytes of all its bags, each except `new`.
fn kept(new: &Path, settings: &SnapshotSettings) -> (Vec<KeptBag>, u64) {
    let directory = new.parent().unwrap_or(new);
    let prefix = format!("{}_rosbag2_", settings.name);
    let (mut triggered, mut used) = (Vec::new(), 0_u64);
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let is_ours = entry.file_name().to_string_lossy().starts_with(&prefix);
        // A link may lead to files that are not the agent's.
        let is_directory = entry.file_type().is_ok_and(|kind| kind.is_dir());
        let path = entry.path();
        if !is_ours || !is_directory || path == new {
            continue;
        }
        let bytes = bytes_of(&path);
        used = used.saturating_add(bytes);
        let bag = TriggeredBag::read(&path).filter(|bag| bag.snapshot == settings.name);
        if let Some(bag) = bag {
            let modified = entry.metadata().and_then(|entry| entry.modified());
            triggered.push(KeptBag {
                path,
                bytes,
                number: bag.number,
                modified: modified.unwrap_or(SystemTime::UNIX_EPOCH),
            });
        }
    }
    (triggered, used)
}

fn bytes_of(bag: &Path) -> u64 {
    let files = fs::read_dir(bag).into_iter().flatten().flatten();
    let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
    sizes.fold(0, u64::saturating_add)
}
