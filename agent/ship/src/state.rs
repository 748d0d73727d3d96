//! Records of deliveries on disk, one file for each bag, and receipts of delivered bags.

use std::collections::BTreeMap;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::bags::{Fingerprint, MAX_BAGS};

/// Name of the directory of records, below the state directory of the agent.
pub const RECORDS_DIRECTORY: &str = "ship";
/// Endings of the names of records and receipts.
const RECORD_EXTENSION: &str = "json";
const RECEIPT_EXTENSION: &str = "receipt";
/// Directories of records and receipts, so that no bag's name is that of another file.
const BAGS_DIRECTORY: &str = "bags";
/// Maximum size of a record, in bytes.
const RECORD_BYTES: u64 = 16 << 20;

/// The delivery of one bag.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Delivery {
    /// Destination of its files. A delivery to another one begins again.
    #[serde(default)]
    pub(crate) destination: Destination,
    /// State of the bag's files. A bag with another one is delivered anew.
    pub(crate) fingerprint: Fingerprint,
    /// Name of the bag at the destination; `None` until it is chosen.
    pub(crate) remote: Option<String>,
    /// Whether its recording ended cleanly.
    pub(crate) is_complete: bool,
    pub(crate) files: Vec<FileDelivery>,
    /// Text of the manifest, once all files are delivered.
    pub(crate) manifest: Option<String>,
    /// Whether the destination has the manifest.
    pub(crate) is_delivered: bool,
}

/// What decides where a bag arrives.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Destination {
    pub(crate) url: String,
    pub(crate) endpoint: Option<String>,
    /// Name of this robot.
    pub(crate) instance: String,
}

/// The delivery of one file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct FileDelivery {
    /// Name of the file in the bag.
    pub(crate) name: String,
    pub(crate) bytes: u64,
    /// Checksum in hexadecimal digits; `None` until it is computed.
    pub(crate) sha256: Option<String>,
    pub(crate) upload: Option<Upload>,
    /// Whether the destination accepted all of it.
    pub(crate) is_sent: bool,
    /// Whether the destination has the file in its full size.
    pub(crate) is_delivered: bool,
}

/// An upload in parts.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Upload {
    pub(crate) id: String,
    pub(crate) part_bytes: u64,
    /// Ids of the delivered parts, in their order.
    pub(crate) parts: Vec<String>,
}

impl Delivery {
    /// Returns the size of the bag, and of the delivered part of it.
    pub(crate) fn progress(&self) -> (u64, u64) {
        let done = self.files.iter().map(|file| match &file.upload {
            _ if file.is_sent => file.bytes,
            Some(upload) => file
                .bytes
                .min(upload.part_bytes * upload.parts.len() as u64),
            None => 0,
        });
        (self.files.iter().map(|file| file.bytes).sum(), done.sum())
    }

    /// Forgets which sizes were compared: the destination may have changed in the meantime.
    pub(crate) fn forget_sizes(&mut self) {
        for file in &mut self.files {
            file.is_delivered = false;
        }
    }
}

/// All records. Those in memory count: without space on the disk, deliveries continue.
#[derive(Debug)]
pub(crate) struct Records {
    directory: PathBuf,
    deliveries: BTreeMap<String, Delivery>,
    /// Whether the last record could not be written.
    is_failing: bool,
    /// Lock of the directory, until this value is dropped.
    _lock: Option<File>,
}

/// Why records cannot be used.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RecordsError {
    #[error("cannot use {}", .0.display())]
    Directory(PathBuf, #[source] io::Error),
    #[error("another rp ship works with {}", .0.display())]
    Locked(PathBuf),
}

impl Records {
    /// Opens the records, and creates their directory.
    pub(crate) fn open(directory: &Path) -> Result<Self, RecordsError> {
        let wrong = |error| RecordsError::Directory(directory.to_owned(), error);
        let bags = directory.join(BAGS_DIRECTORY);
        let mut builder = DirBuilder::new();
        match builder.recursive(true).mode(0o750).create(&bags) {
            // Deliveries make space, so they begin without records.
            Err(error) if error.kind() == io::ErrorKind::StorageFull => {
                tracing::warn!(%error, "failed to record deliveries");
                return Ok(Self::empty(directory, None));
            }
            made => made.map_err(wrong)?,
        }
        let lock = File::open(directory).map_err(wrong)?;
        let operation = rustix::fs::FlockOperation::NonBlockingLockExclusive;
        // A file system may have no locks, which is another error.
        if rustix::fs::flock(&lock, operation) == Err(rustix::io::Errno::WOULDBLOCK) {
            return Err(RecordsError::Locked(directory.to_owned()));
        }
        let mut records = Self::empty(directory, Some(lock));
        for entry in fs::read_dir(&bags).map_err(wrong)?.take(2 * MAX_BAGS) {
            let path = entry.map_err(wrong)?.path();
            let is_record = path.extension().is_some_and(|end| end == RECORD_EXTENSION);
            let name = path.file_stem().and_then(|name| name.to_str());
            // A damaged record counts as missing: the bag is compared with the destination.
            if let Some(name) = name.filter(|_| is_record)
                && let Ok(mut delivery) = read_json::<Delivery>(&path)
            {
                if !delivery.is_delivered {
                    delivery.forget_sizes();
                }
                records.deliveries.insert(name.to_owned(), delivery);
            }
        }
        Ok(records)
    }

    fn empty(directory: &Path, lock: Option<File>) -> Self {
        Self {
            directory: directory.to_owned(),
            deliveries: BTreeMap::new(),
            is_failing: false,
            _lock: lock,
        }
    }

    pub(crate) fn get(&self, bag: &str) -> Option<&Delivery> {
        self.deliveries.get(bag)
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.deliveries.keys().map(String::as_str)
    }

    /// Keeps a record. If the disk is full, it is kept in memory.
    pub(crate) fn keep(&mut self, bag: &str, delivery: Delivery) {
        let written = write_json(&self.path(bag, RECORD_EXTENSION), &delivery).and_then(|()| {
            let receipt = self.path(bag, RECEIPT_EXTENSION);
            match delivery.is_delivered {
                true => write(&receipt, delivery.fingerprint.text().as_bytes()),
                false => remove(&receipt),
            }
        });
        if let (Err(error), false) = (&written, self.is_failing) {
            tracing::warn!(bag, %error, "failed to record a delivery: a restart may repeat parts of it");
        }
        self.is_failing = written.is_err();
        self.deliveries.insert(bag.to_owned(), delivery);
    }

    /// Forgets a bag, and returns its record.
    pub(crate) fn forget(&mut self, bag: &str) -> Option<Delivery> {
        for ending in [RECEIPT_EXTENSION, RECORD_EXTENSION] {
            let _ = remove(&self.path(bag, ending));
        }
        self.deliveries.remove(bag)
    }

    fn path(&self, bag: &str, ending: &str) -> PathBuf {
        self.directory
            .join(BAGS_DIRECTORY)
            .join(format!("{bag}.{ending}"))
    }
}

/// Returns whether the destination has a bag as it is now. `state` is the state directory of the
/// agent.
#[must_use]
pub fn is_delivered(state: &Path, bag: &Path) -> bool {
    let name = bag.file_name().and_then(|name| name.to_str());
    let receipt = name.and_then(|name| {
        let path = state.join(RECORDS_DIRECTORY).join(BAGS_DIRECTORY);
        fs::read_to_string(path.join(format!("{name}.{RECEIPT_EXTENSION}"))).ok()
    });
    let fingerprint = Fingerprint::of(bag).ok();
    let fingerprint = fingerprint.filter(|found| !found.is_empty());
    receipt
        .zip(fingerprint)
        .is_some_and(|(receipt, found)| receipt == found.text())
}

/// Reads a file of JSON. The error of a damaged file has the kind `InvalidData` or `UnexpectedEof`.
pub(crate) fn read_json<T: DeserializeOwned>(path: &Path) -> io::Result<T> {
    if fs::metadata(path)?.len() > RECORD_BYTES {
        return Err(io::ErrorKind::InvalidData.into());
    }
    Ok(serde_json::from_slice(&fs::read(path)?)?)
}

/// Replaces a file of JSON, which then survives a loss of power.
pub(crate) fn write_json<T: Serialize>(path: &Path, value: &T) -> io::Result<()> {
    write(path, &serde_json::to_vec_pretty(value)?)
}

/// Replaces a file of JSON. A loss of power may leave an empty one.
pub(crate) fn write_json_unsynced<T: Serialize>(path: &Path, value: &T) -> io::Result<()> {
    replace(path, &serde_json::to_vec_pretty(value)?, |_| Ok(()))
}

fn write(path: &Path, content: &[u8]) -> io::Result<()> {
    replace(path, content, File::sync_all)?;
    let directory = path.parent().unwrap_or(path);
    File::open(directory)?.sync_all()
}

fn replace(
    path: &Path,
    content: &[u8],
    finish: impl FnOnce(&File) -> io::Result<()>,
) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let written = || {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o640);
        let mut file = options.open(&part)?;
        file.write_all(content)?;
        finish(&file)?;
        fs::rename(&part, path)
    };
    written().inspect_err(|_| {
        let _ = fs::remove_file(&part);
    })
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bag(root: &Path, name: &str) -> PathBuf {
        let bag = root.join(name);
        fs::create_dir(&bag).unwrap();
        fs::write(bag.join("0.mcap"), "12345").unwrap();
        bag
    }

    #[test]
    fn a_bag_that_changed_after_its_delivery_is_not_delivered() {
        let root = tempfile::tempdir().unwrap();
        let state = root.path().join("state");
        let bag = bag(root.path(), "lap");
        assert!(!is_delivered(&state, &bag));
        let mut records = Records::open(&state.join(RECORDS_DIRECTORY)).unwrap();
        let mut delivery = Delivery {
            fingerprint: Fingerprint::of(&bag).unwrap(),
            ..Delivery::default()
        };
        records.keep("lap", delivery.clone());
        assert!(!is_delivered(&state, &bag));
        delivery.is_delivered = true;
        records.keep("lap", delivery.clone());
        assert!(is_delivered(&state, &bag));
        fs::write(bag.join("0.mcap"), "1234").unwrap();
        assert!(!is_delivered(&state, &bag), "another bag of the same name");
        drop(records);
        let mut records = Records::open(&state.join(RECORDS_DIRECTORY)).unwrap();
        assert_eq!(records.get("lap"), Some(&delivery));
        assert_eq!(records.forget("lap"), Some(delivery));
        assert!(!is_delivered(&state, &bag));
        drop(records);
        assert_eq!(
            Records::open(&state.join(RECORDS_DIRECTORY))
                .unwrap()
                .names()
                .count(),
            0
        );
    }

    #[test]
    fn a_damaged_record_is_ignored_and_a_second_process_is_locked_out() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join(BAGS_DIRECTORY)).unwrap();
        fs::write(
            root.path().join(BAGS_DIRECTORY).join("lap.json"),
            "{\"fingerp",
        )
        .unwrap();
        let records = Records::open(root.path()).unwrap();
        assert_eq!(records.get("lap"), None);
        let second = Records::open(root.path()).unwrap_err();
        assert!(matches!(second, RecordsError::Locked(_)), "{second}");
    }

    #[test]
    fn a_record_beyond_the_size_limit_is_ignored() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join(BAGS_DIRECTORY)).unwrap();
        let mut text = serde_json::to_string(&Delivery::default()).unwrap();
        let path = root.path().join(BAGS_DIRECTORY).join("lap.json");
        fs::write(&path, &text).unwrap();
        assert!(Records::open(root.path()).unwrap().get("lap").is_some());
        text.push_str(&" ".repeat(usize::try_from(RECORD_BYTES).unwrap()));
        fs::write(&path, &text).unwrap();
        assert!(Records::open(root.path()).unwrap().get("lap").is_none());
    }
}
