//! Bags in the directory of recordings: which of them are finished, and which are urgent.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ros2probe_bag::lock;
use ros2probe_bag::mcap::MAGIC;
use ros2probe_bag::metadata::{self, Metadata};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Maximum number of bags of the directory that are known at a time.
pub(crate) const MAX_BAGS: usize = 10_000;
/// Maximum number of files of a bag.
const MAX_FILES: usize = 10_000;
/// Time for which a bag without a lock must be unchanged, if its files are complete.
const QUIET_TIME: Duration = Duration::from_secs(2);
/// Like [`QUIET_TIME`], for an incomplete bag: other recorders hold no lock while they write.
const INCOMPLETE_QUIET_TIME: Duration = Duration::from_mins(1);
/// Key of a snapshot's trigger in the custom data of a bag.
const TRIGGER_KEY: &str = "ros2probe_trigger";

/// State of the files of a bag: names, sizes, and times of the last change.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct Fingerprint(BTreeMap<String, (u64, u64)>);

/// A bag without a writer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bag {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    pub(crate) fingerprint: Fingerprint,
    pub(crate) content: Content,
}

/// What metadata.yaml and the ends of the files contain.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Content {
    /// Whether the recording ended cleanly: all files are complete, and metadata.yaml lists them.
    pub(crate) is_complete: bool,
    /// Event, request or signal that triggered a snapshot.
    pub(crate) trigger: Option<Value>,
    /// Earliest and latest time of its messages, in nanoseconds since 1970.
    pub(crate) times: Option<(u64, u64)>,
    pub(crate) messages: u64,
    /// Names and types of its topics, with their numbers of messages.
    pub(crate) topics: Vec<(String, String, u64)>,
}

/// Knowledge of earlier scans.
#[derive(Debug, Default)]
pub(crate) struct Scanner {
    seen: BTreeMap<String, Seen>,
}

#[derive(Debug)]
struct Seen {
    fingerprint: Fingerprint,
    since: Instant,
    content: Content,
}

/// Result of a scan.
#[derive(Debug, Default)]
pub(crate) struct Found {
    /// Bags without a writer, the urgent ones first, then the oldest ones.
    pub(crate) bags: Vec<Bag>,
    /// Names of bags that are written or were changed just now.
    pub(crate) unfinished: Vec<String>,
    /// Whether a complete bag without a writer only waits until its files are old enough.
    pub(crate) is_settling: bool,
}

impl Fingerprint {
    /// Reads the state of a bag. Files that a killed writer left beside others are ignored.
    pub(crate) fn of(bag: &Path) -> io::Result<Self> {
        let mut files = BTreeMap::new();
        for entry in fs::read_dir(bag)? {
            let entry = entry?;
            let Ok(name) = entry.file_name().into_string() else {
                continue;
            };
            // The metadata describe the entry itself, so links are not followed.
            let about = match entry.metadata() {
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                about => about?,
            };
            if about.is_file() && !name.ends_with(".part") && !name.contains('\n') {
                let changed = about.modified()?.duration_since(UNIX_EPOCH);
                let changed = changed.unwrap_or_default().as_nanos();
                files.insert(name, (about.len(), u64::try_from(changed).unwrap_or(0)));
            }
            if files.len() > MAX_FILES {
                return Err(io::Error::other("the bag has too many files"));
            }
        }
        Ok(Self(files))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns names and sizes of the files, metadata.yaml last.
    pub(crate) fn files(&self) -> Vec<(&str, u64)> {
        let files = self.0.iter().map(|(name, (bytes, _))| (&**name, *bytes));
        let mut files: Vec<_> = files.collect();
        files.sort_by_key(|(name, _)| *name == metadata::FILE_NAME);
        files
    }

    /// Returns the text of a receipt.
    pub(crate) fn text(&self) -> String {
        let lines = self.0.iter();
        lines
            .map(|(name, (bytes, changed))| format!("{bytes} {changed} {name}\n"))
            .collect()
    }

    fn changed(&self) -> u64 {
        let changed = self.0.values().map(|(_, changed)| *changed);
        changed.max().unwrap_or(0)
    }
}

impl Bag {
    /// Returns the size of all files, in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        self.fingerprint
            .files()
            .iter()
            .map(|(_, bytes)| bytes)
            .sum()
    }

    /// Returns whether a snapshot wrote it.
    pub(crate) const fn is_triggered(&self) -> bool {
        self.content.trigger.is_some()
    }

    /// Returns the time by which bags are ordered, in nanoseconds since 1970.
    pub(crate) fn began(&self) -> u64 {
        let start = self.content.times.map(|(start, _)| start);
        start.unwrap_or_else(|| self.fingerprint.changed())
    }
}

impl Scanner {
    /// Reads a directory.
    ///
    /// Fails if the directory cannot be read.
    pub(crate) fn scan(&mut self, directory: &Path) -> io::Result<Found> {
        let mut found = Found::default();
        let mut seen = BTreeMap::new();
        for entry in fs::read_dir(directory)?.take(MAX_BAGS) {
            let entry = entry?;
            let Ok(name) = entry.file_name().into_string() else {
                continue;
            };
            let is_directory = entry.file_type().is_ok_and(|kind| kind.is_dir());
            if !is_directory || name.starts_with('.') {
                continue;
            }
            let path = entry.path();
            // A directory that is removed at this moment has no files.
            let fingerprint = Fingerprint::of(&path).unwrap_or_default();
            if !fingerprint.files().iter().any(|(name, _)| is_storage(name)) {
                continue;
            }
            let before = self.seen.remove(&name);
            let now = before.filter(|seen| seen.fingerprint == fingerprint);
            let now = now.unwrap_or_else(|| Seen {
                content: Content::read(&path, &fingerprint),
                fingerprint: fingerprint.clone(),
                since: Instant::now(),
            });
            let quiet = match now.content.is_complete {
                true => QUIET_TIME,
                false => INCOMPLETE_QUIET_TIME,
            };
            let is_written = lock::is_held(&path);
            if is_written || !is_quiet(&now, quiet) {
                found.unfinished.push(name.clone());
                found.is_settling |= !is_written && now.content.is_complete;
            } else {
                found.bags.push(Bag {
                    name: name.clone(),
                    path,
                    fingerprint,
                    content: now.content.clone(),
                });
            }
            seen.insert(name, now);
        }
        self.seen = seen;
        found.bags.sort_by(|one, other| {
            let key = |bag: &Bag| (Reverse(bag.is_triggered()), bag.began());
            key(one).cmp(&key(other)).then(one.name.cmp(&other.name))
        });
        Ok(found)
    }
}

/// Returns whether the files have been unchanged for this time. A robot's clock may have been set
/// back, so the time since the first scan counts as well.
fn is_quiet(seen: &Seen, time: Duration) -> bool {
    let changed = UNIX_EPOCH + Duration::from_nanos(seen.fingerprint.changed());
    let age = SystemTime::now()
        .duration_since(changed)
        .unwrap_or_default();
    age >= time || seen.since.elapsed() >= time
}

fn is_storage(name: &str) -> bool {
    name.contains(".mcap") || name.contains(".db3")
}

impl Content {
    fn read(bag: &Path, fingerprint: &Fingerprint) -> Self {
        let text = fs::read_to_string(bag.join(metadata::FILE_NAME));
        let Some(metadata) = text.ok().and_then(|text| Metadata::read(&text).ok()) else {
            return Self::default();
        };
        let files = fingerprint.files();
        let listed = |name: &str| metadata.relative_file_paths.iter().any(|path| path == name);
        let are_there = metadata
            .relative_file_paths
            .iter()
            .all(|path| files.iter().any(|(name, _)| name == path));
        let are_whole = files.iter().all(|(name, _)| {
            let is_plain = name.ends_with(".mcap");
            !is_plain || listed(name) && is_ended(&bag.join(name))
        });
        let trigger = metadata.custom_data.get(TRIGGER_KEY);
        let start = metadata.starting_time;
        let has_times = metadata.message_count > 0 && start != metadata::NO_START;
        Self {
            is_complete: are_there && are_whole,
            trigger: trigger.and_then(|text| serde_json::from_str(text).ok()),
            times: has_times.then(|| (start, start.saturating_add(metadata.duration))),
            messages: metadata.message_count,
            topics: metadata
                .topics
                .into_iter()
                .map(|topic| (topic.name, topic.type_name, topic.message_count))
                .collect(),
        }
    }
}

/// Returns whether a file of MCAP has its end.
fn is_ended(path: &Path) -> bool {
    let end = || -> io::Result<[u8; MAGIC.len()]> {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::End(-i64::try_from(MAGIC.len()).unwrap_or(0)))?;
        let mut end = [0; MAGIC.len()];
        file.read_exact(&mut end)?;
        Ok(end)
    };
    end().is_ok_and(|end| end == MAGIC)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::FileTimes;

    use ros2probe_bag::{Options, Writer};

    use super::*;

    fn write(root: &Path, name: &str, trigger: bool) -> Writer {
        let mut options = Options::default();
        if trigger {
            let data = "{\"snapshot\":\"s\",\"trigger\":\"request\"}".to_owned();
            options.custom_data.insert(TRIGGER_KEY.to_owned(), data);
        }
        Writer::create(&root.join(name), options).unwrap()
    }

    /// Sets the times of all files of a bag back.
    fn age(bag: &Path, seconds: u64) {
        let then = SystemTime::now() - Duration::from_secs(seconds);
        for entry in fs::read_dir(bag).unwrap() {
            let file = File::open(entry.unwrap().path()).unwrap();
            file.set_times(FileTimes::new().set_modified(then)).unwrap();
        }
    }

    fn names(found: &Found) -> Vec<&str> {
        found.bags.iter().map(|bag| &*bag.name).collect()
    }

    #[test]
    fn triggered_bags_are_sorted_before_the_oldest_bags() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        for (name, trigger, seconds) in [
            ("newer", false, 10),
            ("older", false, 20),
            ("snap_new", true, 5),
            ("snap_old", true, 15),
        ] {
            write(root, name, trigger).close(BTreeMap::new()).unwrap();
            age(&root.join(name), seconds);
        }
        fs::create_dir(root.join("notes")).unwrap();
        fs::create_dir(root.join(".delivered-x")).unwrap();
        fs::write(root.join(".delivered-x/x.mcap"), "1").unwrap();
        let found = Scanner::default().scan(root).unwrap();
        assert_eq!(names(&found), ["snap_old", "snap_new", "older", "newer"]);
        assert!(found.bags.iter().all(|bag| bag.content.is_complete));
    }

    #[test]
    fn a_bag_with_a_writer_is_unfinished_and_a_killed_one_incomplete() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        let writer = write(root, "drive", false);
        age(&root.join("drive"), 1_000);
        let mut scanner = Scanner::default();
        let found = scanner.scan(root).unwrap();
        assert_eq!(
            (names(&found), &*found.unfinished),
            (vec![], &["drive".to_owned()][..])
        );
        assert!(!found.is_settling, "it has a writer");
        drop(writer);
        let found = scanner.scan(root).unwrap();
        assert_eq!(names(&found), ["drive"]);
        assert!(!found.bags[0].content.is_complete);
        // Another recorder may still be writing.
        age(&root.join("drive"), 10);
        let found = Scanner::default().scan(root).unwrap();
        assert_eq!(found.unfinished, ["drive"]);
        assert!(!found.is_settling);
    }

    #[test]
    fn a_bag_that_just_changed_or_misses_a_file_is_incomplete() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        write(root, "lap", false).close(BTreeMap::new()).unwrap();
        // A busy disk may have taken longer than a bag has to be quiet.
        age(&root.join("lap"), 0);
        let found = Scanner::default().scan(root).unwrap();
        assert_eq!(found.unfinished, ["lap"]);
        assert!(found.is_settling);
        fs::copy(root.join("lap/lap_0.mcap"), root.join("lap/lap_1.mcap")).unwrap();
        age(&root.join("lap"), 100);
        let found = Scanner::default().scan(root).unwrap();
        assert!(
            !found.bags[0].content.is_complete,
            "a file that is not listed"
        );
        fs::remove_file(root.join("lap/lap_0.mcap")).unwrap();
        fs::remove_file(root.join("lap/metadata.yaml")).unwrap();
        let found = Scanner::default().scan(root).unwrap();
        assert!(!found.bags[0].content.is_complete, "no metadata.yaml");
    }

    #[test]
    fn bags_and_files_beyond_the_caps_are_left_out() {
        // A disk would need a minute for so many files.
        let directory = tempfile::tempdir_in("/dev/shm").unwrap();
        let root = directory.path();
        let bag = root.join("many");
        fs::create_dir(&bag).unwrap();
        for number in 0..=MAX_FILES {
            File::create(bag.join(format!("{number}.mcap"))).unwrap();
        }
        assert!(Fingerprint::of(&bag).is_err());
        fs::remove_file(bag.join("0.mcap")).unwrap();
        for number in 0..=MAX_BAGS {
            let bag = root.join(format!("bag_{number}"));
            fs::create_dir(&bag).unwrap();
            File::create(bag.join("0.mcap")).unwrap();
        }
        let found = Scanner::default().scan(root).unwrap();
        assert_eq!(found.bags.len() + found.unfinished.len(), MAX_BAGS);
        assert_eq!(Fingerprint::of(&bag).unwrap().files().len(), MAX_FILES);
    }
}
