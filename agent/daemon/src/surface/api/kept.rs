//! Bags in the directory of recordings that this run of the agent did not begin: those of earlier
//! runs, and snapshots.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use super::downloads::files;
use crate::recording::TriggeredBag;
use ros2probe_api::recordings::KeptBag;
use ros2probe_bag::metadata;

/// Maximum number of bags listed, the latest ones.
const MAX_KEPT: usize = 200;
/// Maximum number of entries of the directory that are read.
const MAX_ENTRIES: usize = 10_000;

/// The latest list. The metadata of a bag is read once, until the bag changes.
static LISTED_BAGS: Mutex<Vec<KeptBag>> = Mutex::new(Vec::new());

/// Returns the bags in a directory without those of these names, the latest first. It reads the
/// directory, and so it blocks.
pub(super) fn kept(root: &Path, known: &BTreeSet<String>) -> Vec<KeptBag> {
    let mut listed = LISTED_BAGS.lock().unwrap_or_else(PoisonError::into_inner);
    *listed = bags_among(root, known, MAX_ENTRIES, &listed);
    listed.clone()
}

/// Returns the bags among this number of entries. `before` is an earlier list.
fn bags_among(
    root: &Path,
    known: &BTreeSet<String>,
    most: usize,
    before: &[KeptBag],
) -> Vec<KeptBag> {
    let entries = fs::read_dir(root).into_iter().flatten();
    let bags = entries.take(most).filter_map(|entry| {
        let entry = entry.ok()?;
        let name = entry.file_name().into_string().ok()?;
        // The metadata describe the entry itself, so links are not followed.
        let metadata = entry.metadata().ok().filter(fs::Metadata::is_dir)?;
        (!known.contains(&name)).then_some((metadata.modified().ok()?, name))
    });
    let mut bags: Vec<(SystemTime, String)> = bags.collect();
    bags.sort_unstable_by(|one, other| other.cmp(one));
    let bags = bags.into_iter().filter_map(|(modified, name)| {
        let directory = root.join(&name);
        let files = files(&directory);
        let is_complete = files.iter().any(|each| each.file == metadata::FILE_NAME);
        let is_storage = |file: &str| file.contains(".mcap") || file.contains(".db3");
        let storage: Vec<_> = files.iter().filter(|each| is_storage(&each.file)).collect();
        let since = modified.duration_since(UNIX_EPOCH).unwrap_or_default();
        if storage.is_empty() {
            return None;
        }
        let bag = KeptBag {
            name,
            directory: directory.display().to_string(),
            modified_timestamp_seconds: since.as_secs_f64(),
            file_bytes: storage.iter().map(|each| each.bytes).sum(),
            files: storage.len(),
            is_complete,
            trigger: None,
        };
        let same = before.iter().find(|same| same.directory == bag.directory);
        let trigger = same.and_then(|same| same.trigger.clone());
        let unchanged = KeptBag { trigger, ..bag };
        if same == Some(&unchanged) {
            return Some(unchanged);
        }
        let trigger = TriggeredBag::read(&directory).map(|bag| bag.trigger);
        Some(KeptBag {
            trigger,
            ..unchanged
        })
    });
    bags.take(MAX_KEPT).collect()
}

/// Returns the directory of a bag by its name; `None` without a directory of this name.
pub(super) fn directory_of(root: &Path, name: &str) -> Option<PathBuf> {
    let mut parts = Path::new(name).components();
    let is_plain = matches!(parts.next(), Some(Component::Normal(_))) && parts.next().is_none();
    let directory = root.join(name);
    let is_directory = || fs::symlink_metadata(&directory).is_ok_and(|found| found.is_dir());
    (is_plain && is_directory()).then_some(directory)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bag(root: &Path, name: &str, file: &str) {
        fs::create_dir(root.join(name)).unwrap();
        fs::write(root.join(name).join(file), "12345").unwrap();
    }

    #[test]
    fn bags_of_earlier_runs_are_listed_without_links_and_other_directories() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        bag(root, "lap", "lap_0.mcap");
        fs::write(root.join("lap").join(metadata::FILE_NAME), "rosbag2").unwrap();
        bag(root, "cut_off", "cut_off_0.db3");
        bag(root, "running", "running_0.mcap");
        bag(root, "notes", "notes.txt");
        fs::write(root.join("file.mcap"), "1").unwrap();
        std::os::unix::fs::symlink(root.join("lap"), root.join("link")).unwrap();
        let mut found = kept(root, &BTreeSet::from(["running".to_owned()]));
        found.sort_by(|one, other| one.name.cmp(&other.name));
        let shown = found
            .iter()
            .map(|each| (&*each.name, each.files, each.file_bytes, each.is_complete));
        assert_eq!(
            shown.collect::<Vec<_>>(),
            [("cut_off", 1, 5, false), ("lap", 1, 5, true)]
        );
        assert!(
            found
                .iter()
                .all(|each| each.modified_timestamp_seconds > 1e9)
        );
        assert_eq!(directory_of(root, "lap"), Some(root.join("lap")));
        for name in [
            "", ".", "..", "link", "none", "lap/..", "/etc", "../lap", "lap/",
        ] {
            let found = directory_of(root, name);
            assert!(found.is_none() || name == "lap/", "{name}: {found:?}");
        }
        assert!(kept(&root.join("nowhere"), &BTreeSet::new()).is_empty());
    }

    #[test]
    fn bags_and_entries_beyond_the_caps_are_left_out() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        for number in 0..MAX_KEPT + 5 {
            bag(root, &format!("bag_{number}"), "bag_0.mcap");
        }
        assert_eq!(kept(root, &BTreeSet::new()).len(), MAX_KEPT);
        assert_eq!(bags_among(root, &BTreeSet::new(), 3, &[]).len(), 3);
    }
}
