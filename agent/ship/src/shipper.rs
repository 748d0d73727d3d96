//! The loop that delivers bags: which is next, pauses after failures, windows, and space.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Zoned;
use object_store::path::Path;
use serde_json::Value;
use tokio::time::sleep;

use crate::bags::{Bag, Fingerprint, Found, Scanner};
use crate::delivery::{DeliveryError, PartialChecksum, Step};
use crate::settings::{Settings, SettingsError};
use crate::space;
use crate::state::{Delivery, Records, RecordsError};
use crate::status::{Delivered, Failure, MAX_LISTED, Status, Uploading, now};
use crate::store::Store;

/// Time between two scans of the directory.
const SCAN_INTERVAL: Duration = Duration::from_secs(2);
/// Time after which the status is written again even if only its times have changed.
const STATUS_INTERVAL: Duration = Duration::from_mins(1);
/// Pauses after a failure.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_mins(1);
/// Number of failures in a row after which a single pass ends.
const MAX_FAILURES: u32 = 3;
/// Beginning of the name of a bag that is being deleted.
const DELETED_PREFIX: &str = ".delivered-";

/// Returns warnings and errors of the agent between two times in nanoseconds since 1970; `None` if
/// the agent cannot be queried.
pub type Findings = Arc<dyn Fn(u64, u64) -> Option<Vec<Value>> + Send + Sync>;

/// Receives the progress of a delivery.
pub type Observer = Box<dyn FnMut(&Uploading)>;

/// Delivers bags.
pub struct Shipper {
    pub(crate) settings: Settings,
    /// Path below the bucket or folder.
    pub(crate) prefix: Path,
    pub(crate) records: Records,
    pub(crate) findings: Option<Findings>,
    /// Checksum whose computation was interrupted.
    pub(crate) partial_checksum: Option<PartialChecksum>,
    observer: Option<Observer>,
    store: Option<Store>,
    scanner: Scanner,
    status: Status,
    /// The status on disk, and when it was written.
    written: Option<(Instant, Status)>,
    /// Time of the next attempt to make space, after a failed one.
    space_attempt: Option<Instant>,
    /// Failures that concern one bag, until its delivery. A bag with more of them waits behind
    /// others.
    failures: BTreeMap<String, u32>,
    /// Failures in a row, of all bags.
    failures_in_row: u32,
    /// Reason of the last failure that was logged; `None` after a success.
    logged: Option<String>,
    /// Whether windows are ignored.
    ignores_windows: bool,
    last_scan: Option<Instant>,
    found: Found,
}

/// Why a shipper ends.
#[derive(Debug, thiserror::Error)]
pub enum ShipError {
    /// The settings name no destination.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The directory of records cannot be used, or another process uses it.
    #[error("cannot record deliveries")]
    Records(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// A single pass could not deliver all bags.
    #[error("{bag}: {reason} (waiting bags: {waiting})")]
    Undelivered {
        /// Number of bags that wait.
        waiting: usize,
        /// Bag whose delivery failed last.
        bag: String,
        /// Reason of the failure.
        reason: String,
    },
    /// The directory of the bags cannot be read.
    #[error("cannot read {}", .0.display())]
    Directory(PathBuf, #[source] io::Error),
}

impl From<RecordsError> for ShipError {
    fn from(error: RecordsError) -> Self {
        Self::Records(Box::new(error))
    }
}

impl Shipper {
    /// Opens the records of deliveries, without a request.
    ///
    /// # Errors
    /// Fails if the settings name no destination, or the records cannot be used.
    pub fn new(
        settings: Settings,
        findings: Option<Findings>,
        observer: Option<Observer>,
    ) -> Result<Self, ShipError> {
        let prefix = settings.store.prefix()?;
        let records = Records::open(&settings.state)?;
        let mut status = Status::read(&settings.state).unwrap_or_default();
        status.uploading = None;
        Ok(Self {
            records,
            status,
            prefix,
            findings,
            partial_checksum: None,
            observer,
            store: None,
            scanner: Scanner::default(),
            written: None,
            space_attempt: None,
            failures: BTreeMap::new(),
            failures_in_row: 0,
            logged: None,
            ignores_windows: false,
            last_scan: None,
            found: Found::default(),
            settings,
        })
    }

    /// Delivers bags until the future is dropped, which is safe at any time.
    ///
    /// # Errors
    /// Never fails: failures are logged, and the delivery is repeated.
    pub async fn run(&mut self) -> Result<(), ShipError> {
        loop {
            let wait = match self.deliver_step().await {
                Ok(wait) => wait,
                Err(error) => {
                    self.log_failure("", &describe(&error));
                    Some(SCAN_INTERVAL)
                }
            };
            if let Some(wait) = wait {
                sleep(wait).await;
            }
        }
    }

    /// Delivers the finished bags once, without regard to windows. Waits for bags that ended just
    /// now.
    ///
    /// # Errors
    /// Fails if a bag waits after some attempts, or if the directory cannot be read.
    pub async fn run_once(&mut self) -> Result<Status, ShipError> {
        self.ignores_windows = true;
        self.scan()?;
        loop {
            let wait = self.deliver_step().await?;
            let waiting = self.waiting().len();
            // A bag that ended just now is finished after a moment.
            if waiting == 0 && !self.found.is_settling {
                return Ok(self.status.clone());
            }
            if waiting > 0 && self.failures_in_row >= MAX_FAILURES {
                let failure = self.status.last_failure.clone().unwrap_or_default();
                return Err(ShipError::Undelivered {
                    waiting,
                    bag: failure.bag,
                    reason: failure.reason,
                });
            }
            if let Some(wait) = wait {
                sleep(wait).await;
            }
        }
    }

    /// Delivers one bag as far as possible. Returns a time to wait, if there is a reason.
    async fn deliver_step(&mut self) -> Result<Option<Duration>, ShipError> {
        self.scan()?;
        self.drop_vanished().await;
        self.make_space().await;
        let Some(bag) = self.next() else {
            self.show_status();
            return Ok(Some(SCAN_INTERVAL));
        };
        let delivered = self.deliver(&bag).await;
        self.status.uploading = None;
        let wait = match delivered {
            Ok(Step::Delivered) => {
                self.delivered(&bag);
                None
            }
            Ok(Step::Interrupted) => None,
            Err(error) => Some(self.failed(&bag, &error).await),
        };
        self.show_status();
        Ok(wait)
    }

    /// Returns the opened destination.
    pub(crate) fn store(&mut self) -> Result<&mut Store, SettingsError> {
        match &mut self.store {
            Some(store) => Ok(store),
            none => Ok(none.insert(Store::open(&self.settings.store)?)),
        }
    }

    fn scan(&mut self) -> Result<(), ShipError> {
        let directory = &self.settings.recordings;
        match self.scanner.scan(directory) {
            Ok(found) => self.found = found,
            // The agent creates the directory with the first bag.
            Err(error) if error.kind() == io::ErrorKind::NotFound => self.found = Found::default(),
            Err(error) => return Err(ShipError::Directory(directory.clone(), error)),
        }
        self.last_scan = Some(Instant::now());
        Ok(())
    }

    /// Returns the bags that the destination does not have, in the order of their delivery.
    fn waiting(&self) -> Vec<&Bag> {
        let is_waiting = |bag: &&Bag| {
            let record = self.records.get(&bag.name);
            record
                .is_none_or(|record| !record.is_delivered || record.fingerprint != bag.fingerprint)
        };
        let mut bags: Vec<_> = self.found.bags.iter().filter(is_waiting).collect();
        // The sort keeps the order of the bags that failed equally often.
        bags.sort_by_key(|bag| self.failures.get(&bag.name).copied().unwrap_or(0));
        bags
    }

    /// Returns the bag to deliver now.
    fn next(&self) -> Option<Bag> {
        let mut waiting = self.waiting().into_iter();
        waiting.find(|bag| self.is_permitted(bag)).cloned()
    }

    /// Returns whether the bag may be delivered at this time.
    fn is_permitted(&self, bag: &Bag) -> bool {
        let is_urgent = bag.is_triggered() && self.settings.triggered_always;
        self.ignores_windows || is_urgent || self.time_to_window().is_zero()
    }

    fn time_to_window(&self) -> Duration {
        self.settings.windows.time_to_opening(Zoned::now().time())
    }

    /// Returns whether the delivery of a bag ends for now: the window closed, or a triggered bag
    /// waits behind one that is not.
    pub(crate) fn is_interrupted(&mut self, bag: &Bag) -> bool {
        !self.is_permitted(bag) || self.is_overtaken(bag)
    }

    /// Returns whether a triggered bag waits behind this bag, which is not triggered.
    pub(crate) fn is_overtaken(&mut self, bag: &Bag) -> bool {
        let is_due = self
            .last_scan
            .is_none_or(|scan| scan.elapsed() >= SCAN_INTERVAL);
        if bag.is_triggered() || !is_due || self.scan().is_err() {
            return false;
        }
        let next = self.next();
        next.is_some_and(|next| next.is_triggered() && next.name != bag.name)
    }

    /// Forgets bags that were deleted by others.
    async fn drop_vanished(&mut self) {
        if !self.settings.recordings.is_dir() {
            return;
        }
        let vanished = |name: &&str| {
            let path = self.settings.recordings.join(name);
            fs::symlink_metadata(path).is_err_and(|error| error.kind() == io::ErrorKind::NotFound)
        };
        let vanished: Vec<_> = self
            .records
            .names()
            .filter(vanished)
            .map(str::to_owned)
            .collect();
        for name in vanished {
            self.failures.remove(&name);
            // Its unfinished uploads stay at the destination if that is out of reach.
            let _ = self.drop_record(&name).await;
        }
    }

    /// Deletes delivered bags while space is needed, the oldest first. Each is confirmed first.
    async fn make_space(&mut self) {
        self.remove_deleted();
        if self.space_attempt.is_some_and(|at| at > Instant::now()) {
            return;
        }
        while space::is_needed(&self.settings.recordings, self.settings.space) {
            let is_delivered = |bag: &&Bag| {
                let record = self.records.get(&bag.name);
                let is_delivered = record.is_some_and(|record| {
                    record.is_delivered && record.fingerprint == bag.fingerprint
                });
                // Windows also apply to the requests that confirm a bag.
                is_delivered && self.is_permitted(bag) && !self.aside(&bag.name).exists()
            };
            let bags = self.found.bags.iter().filter(is_delivered);
            let Some(bag) = bags.min_by_key(|bag| bag.began()).cloned() else {
                return;
            };
            let Some(mut delivery) = self.records.get(&bag.name).cloned() else {
                return;
            };
            match self.is_confirmed(&delivery).await {
                Ok(true) => {}
                Ok(false) => {
                    let name = &bag.name;
                    tracing::warn!(bag = %name, "the destination no longer has a delivered bag: it is delivered again");
                    restart_delivery(&mut delivery);
                    self.records.keep(&bag.name, delivery);
                    return;
                }
                Err(error) => {
                    let pause = self.failed(&bag, &error).await;
                    self.space_attempt = Some(Instant::now() + pause);
                    return;
                }
            }
            // The bag may have changed during the requests.
            if Fingerprint::of(&bag.path).ok().as_ref() != Some(&bag.fingerprint) {
                return;
            }
            let aside = self.aside(&bag.name);
            // After a loss of power, all files of a bag are there, or none.
            let removed = fs::rename(&bag.path, &aside)
                .and_then(|()| remove_files(&aside, &bag.path, &bag.fingerprint));
            match removed {
                Ok(Removal::Whole) => {
                    tracing::info!(bag = %bag.name, "deleted a delivered bag for space");
                }
                Ok(Removal::Files) => {
                    tracing::warn!(bag = %bag.name, "deleted the files of a delivered bag for space: other entries of it stay");
                }
                Err(error) => {
                    tracing::warn!(bag = %bag.name, %error, "failed to delete a delivered bag");
                    return;
                }
            }
            self.status.deleted_bags += 1;
            self.records.forget(&bag.name);
            self.found.bags.retain(|other| other.name != bag.name);
        }
    }

    /// Returns the path of a bag that is being deleted.
    fn aside(&self, bag: &str) -> PathBuf {
        let name = format!("{DELETED_PREFIX}{bag}");
        self.settings.recordings.join(name)
    }

    /// Removes the rest of bags whose deletion was interrupted.
    fn remove_deleted(&self) {
        let entries = fs::read_dir(&self.settings.recordings)
            .into_iter()
            .flatten();
        for entry in entries.flatten() {
            let name = entry.file_name();
            let bag = name
                .to_str()
                .and_then(|name| name.strip_prefix(DELETED_PREFIX));
            let aside = entry.path();
            // Only the files of a delivered bag have such a path.
            if let Some(bag) = bag
                && entry.file_type().is_ok_and(|kind| kind.is_dir())
                && let Ok(files) = Fingerprint::of(&aside)
            {
                let _ = remove_files(&aside, &self.settings.recordings.join(bag), &files);
            }
        }
    }

    fn delivered(&mut self, bag: &Bag) {
        let remote = self.records.get(&bag.name);
        let remote = remote
            .and_then(|record| record.remote.clone())
            .unwrap_or_default();
        let path = format!("{}/{remote}", self.settings.instance);
        tracing::info!(bag = %bag.name, path, bytes = bag.bytes(), "delivered");
        self.status.delivered_bags += 1;
        self.status.delivered_bytes += bag.bytes();
        self.status.last_delivered = Some(Delivered {
            bag: bag.name.clone(),
            path,
            at: now(),
        });
        self.failures.remove(&bag.name);
        self.failures_in_row = 0;
        self.logged = None;
    }

    /// Records a failure, and returns the pause after it.
    async fn failed(&mut self, bag: &Bag, error: &DeliveryError) -> Duration {
        // While the link is down, triggered bags stay first.
        if error.is_of_bag() {
            let failures = self.failures.entry(bag.name.clone()).or_default();
            *failures = failures.saturating_add(1);
        }
        self.failures_in_row = self.failures_in_row.saturating_add(1);
        self.log_failure(&bag.name, &describe(error));
        if matches!(error, DeliveryError::Changed) {
            let _ = self.drop_record(&bag.name).await;
        }
        // Files that the file with credentials names may have been replaced.
        if let Some(store) = &mut self.store {
            let _ = store.reopen_all();
        }
        let demanded = match error {
            DeliveryError::Store(error) => error.pause(),
            _ => None,
        };
        let doublings = self.failures_in_row.saturating_sub(1).min(10);
        let pause = FIRST_PAUSE
            .saturating_mul(1 << doublings)
            .min(LONGEST_PAUSE);
        pause.max(demanded.unwrap_or_default())
    }

    /// Keeps a failure, and logs it unless it is the same as before.
    fn log_failure(&mut self, bag: &str, reason: &str) {
        if self.logged.as_deref() != Some(reason) {
            tracing::warn!(bag, reason, "failed to deliver; it is repeated");
            self.logged = Some(reason.to_owned());
        }
        self.status.last_failure = Some(Failure {
            bag: bag.to_owned(),
            reason: reason.to_owned(),
            at: now(),
        });
    }

    /// Shows a delivery after a successful step of it.
    pub(crate) fn show_progress(&mut self, bag: &Bag, delivery: &Delivery) {
        let (bytes, done_bytes) = delivery.progress();
        let uploading = Uploading {
            bag: bag.name.clone(),
            bytes,
            done_bytes,
        };
        self.failures_in_row = 0;
        if let Some(observer) = &mut self.observer {
            observer(&uploading);
        }
        self.status.uploading = Some(uploading);
        self.show_status();
    }

    fn show_status(&mut self) {
        let waiting = self.waiting();
        let names = waiting.iter().take(MAX_LISTED);
        let names: Vec<_> = names.map(|bag| bag.name.clone()).collect();
        let (bags, bytes) = (
            waiting.len() as u64,
            waiting.iter().map(|bag| bag.bytes()).sum(),
        );
        self.status.waiting = names;
        self.status.waiting_bags = bags;
        self.status.waiting_bytes = bytes;
        self.status.unfinished_bags = self.found.unfinished.len() as u64;
        self.status.opens_in_seconds = self.time_to_window().as_secs();
        let is_written = self.written.as_ref().is_some_and(|(at, written)| {
            at.elapsed() < STATUS_INTERVAL && written.is_same(&self.status)
        });
        if !is_written && self.status.write(&self.settings.state).is_ok() {
            self.written = Some((Instant::now(), self.status.clone()));
        }
    }
}

/// What a deletion removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Removal {
    /// The directory of the bag.
    Whole,
    /// The files of the bag. Its directory has other entries, which were not delivered.
    Files,
}

/// Removes the files of a bag, and its directory `aside`. A directory with other entries gets the
/// path `bag` again.
fn remove_files(aside: &FilePath, bag: &FilePath, files: &Fingerprint) -> io::Result<Removal> {
    for (name, _) in files.files() {
        match fs::remove_file(aside.join(name)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    match fs::remove_dir(aside) {
        Err(error) if error.kind() == io::ErrorKind::DirectoryNotEmpty => {
            fs::rename(aside, bag)?;
            Ok(Removal::Files)
        }
        removed => removed.map(|()| Removal::Whole),
    }
}

/// Makes a delivery begin again.
fn restart_delivery(delivery: &mut Delivery) {
    delivery.is_delivered = false;
    for file in &mut delivery.files {
        file.is_sent = false;
        file.is_delivered = false;
        file.upload = None;
    }
}

/// Returns an error with its causes.
fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(deeper) = cause {
        text.push_str(": ");
        text.push_str(&deeper.to_string());
        cause = deeper.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use ros2probe_bag::{Options, Writer};
    use sha2::{Digest as _, Sha256};

    use super::*;
    use crate::manifest::Manifest;
    use crate::settings::{SpaceLimits, StoreSettings};
    use crate::windows::Windows;

    /// Writes a bag that ended some time ago.
    fn record(root: &FilePath, name: &str, options: Options) {
        let bag = root.join(name);
        let writer = Writer::create(&bag, options).unwrap();
        writer.close(BTreeMap::new()).unwrap();
        let then = SystemTime::now() - Duration::from_secs(60);
        for entry in fs::read_dir(&bag).unwrap() {
            let file = fs::File::open(entry.unwrap().path()).unwrap();
            file.set_modified(then).unwrap();
        }
    }

    #[tokio::test]
    async fn a_triggered_bag_does_not_wait_for_the_checksums_of_another_one() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        for name in ["bags", "folder"] {
            fs::create_dir(path(name)).unwrap();
        }
        let settings = Settings {
            store: StoreSettings {
                url: format!("file://{}", path("folder").display()),
                ..StoreSettings::default()
            },
            instance: "robot".to_owned(),
            windows: Windows::default(),
            triggered_always: false,
            recordings: path("bags"),
            state: path("state"),
            space: SpaceLimits::default(),
        };
        let mut shipper = Shipper::new(settings, None, None).unwrap();
        record(&path("bags"), "drive", Options::default());
        shipper.scan().unwrap();
        let drive = shipper.next().unwrap();
        let mut options = Options::default();
        let trigger = "{\"snapshot\":\"incident\"}".to_owned();
        let key = "ros2probe_trigger".to_owned();
        options.custom_data.insert(key, trigger);
        record(&path("bags"), "incident", options);
        shipper.last_scan = None;
        let step = shipper.deliver(&drive).await.unwrap();
        assert_eq!(step, Step::Interrupted);
        assert_eq!(shipper.records.get("drive"), None, "no checksum is known");
        let incident = shipper.next().unwrap();
        assert_eq!(incident.name, "incident");
        let step = shipper.deliver(&incident).await.unwrap();
        assert_eq!(step, Step::Delivered);
        assert!(
            shipper.partial_checksum.is_some(),
            "the other one continues"
        );
        let step = shipper.deliver(&drive).await.unwrap();
        assert_eq!(step, Step::Delivered);
        let text = fs::read(path("folder/robot/drive/manifest.json")).unwrap();
        let manifest: Manifest = serde_json::from_slice(&text).unwrap();
        for file in manifest.files {
            let content = fs::read(path("bags/drive").join(&file.name)).unwrap();
            let digest = Sha256::digest(&content);
            let expected: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(file.sha256, expected);
        }
    }

    fn names(directory: &FilePath) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn a_deletion_removes_the_delivered_files_and_keeps_other_entries() {
        let directory = tempfile::tempdir().unwrap();
        let (aside, bag) = (directory.path().join("aside"), directory.path().join("bag"));
        fs::create_dir(&aside).unwrap();
        fs::write(aside.join("0.mcap"), "1").unwrap();
        let files = Fingerprint::of(&aside).unwrap();
        // A file that is gone is no failure: an earlier deletion was interrupted.
        fs::remove_file(aside.join("0.mcap")).unwrap();
        let removed = remove_files(&aside, &bag, &files).unwrap();
        assert_eq!(removed, Removal::Whole);
        assert_eq!(names(directory.path()), [""; 0]);
        fs::create_dir_all(aside.join("camera")).unwrap();
        fs::write(aside.join("0.mcap"), "1").unwrap();
        fs::write(aside.join("later.txt"), "2").unwrap();
        let removed = remove_files(&aside, &bag, &files).unwrap();
        assert_eq!(removed, Removal::Files);
        assert_eq!(names(directory.path()), ["bag"]);
        assert_eq!(names(&bag), ["camera", "later.txt"]);
    }
}
