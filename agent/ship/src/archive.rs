//! The bags of all robots at a destination, for views of a fleet. It only reads.
//!
//! A destination that does not answer delays only its own reading: each request has a time limit,
//! and a folder that hangs holds one thread.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path as FilePath, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreScheme};
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio::time::timeout;

use crate::manifest::{FILE_NAME, Manifest};
use crate::settings::{SettingsError, StoreSettings, destination};
use crate::store::{Folder, Store, StoreError};

/// Maximum number of objects that one listing reads.
const MAX_OBJECTS: usize = 50_000;
/// Maximum size of a manifest in bytes.
const MANIFEST_BYTES: u64 = 4 << 20;
/// Maximum wait for one answer of the destination.
const TIMEOUT: Duration = Duration::from_secs(30);

/// The bags at a destination.
pub struct Archive {
    settings: StoreSettings,
    prefix: Path,
    place: Place,
    /// Maximum number of objects that one listing reads.
    max_objects: usize,
}

enum Place {
    /// Opened by the first request, and again after a failure.
    Store(Option<Box<Store>>),
    Folder(Arc<FolderPlace>),
}

/// A folder, of which one thread reads at a time.
struct FolderPlace {
    path: PathBuf,
    /// As it was first found.
    opened: Mutex<Option<Folder>>,
    turn: Arc<Semaphore>,
}

/// A bag at a destination.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredBag {
    /// Name of the robot's directory.
    pub robot: String,
    /// Name of the bag's directory.
    pub name: String,
    /// Time at which it was complete there.
    pub delivered: Timestamp,
    /// Size of its manifest in bytes.
    manifest_bytes: u64,
    /// Path of its manifest, below the bucket or the folder.
    manifest: String,
}

/// The bags of a destination.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Listing {
    /// Complete bags, in no particular order.
    pub bags: Vec<StoredBag>,
    /// Number of bags that have no manifest yet.
    pub unfinished: u64,
    /// Whether the destination has more objects than a listing reads.
    pub is_cut: bool,
}

/// The bags of a destination cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// The destination, its credentials or its certificate authorities are unusable.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A request failed.
    #[error("{0}")]
    Request(String),
    /// The folder cannot be read.
    #[error("cannot read the folder")]
    Folder(#[source] io::Error),
    /// No answer came in time.
    #[error("the store does not answer within {} s", TIMEOUT.as_secs())]
    Slow,
}

impl From<StoreError> for ArchiveError {
    fn from(error: StoreError) -> Self {
        Self::Request(error.to_string())
    }
}

impl std::fmt::Debug for Archive {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let url = &self.settings.url;
        f.debug_struct("Archive")
            .field("url", url)
            .finish_non_exhaustive()
    }
}

impl Archive {
    /// Creates a reader of a destination, without a request.
    ///
    /// # Errors
    /// Fails if the settings name no destination.
    pub fn new(settings: StoreSettings) -> Result<Self, SettingsError> {
        let wrong = || SettingsError::Url(settings.url.clone());
        let (scheme, url) = destination(&settings.url).ok_or_else(wrong)?;
        let place = match scheme {
            ObjectStoreScheme::Local => Place::Folder(Arc::new(FolderPlace {
                path: url.to_file_path().map_err(|()| wrong())?,
                opened: Mutex::default(),
                turn: Arc::new(Semaphore::new(1)),
            })),
            _ => Place::Store(None),
        };
        Ok(Self {
            prefix: settings.prefix()?,
            settings,
            place,
            max_objects: MAX_OBJECTS,
        })
    }

    /// Lists the bags of a robot, or of all robots.
    ///
    /// # Errors
    /// Fails if the destination cannot be read.
    pub async fn bags(&mut self, robot: Option<&str>) -> Result<Listing, ArchiveError> {
        let listed = self.list(robot).await;
        if let (Err(_), Place::Store(store)) = (&listed, &mut self.place) {
            *store = None;
        }
        listed
    }

    async fn list(&mut self, robot: Option<&str>) -> Result<Listing, ArchiveError> {
        let store = match &mut self.place {
            Place::Folder(folder) => {
                let robot = robot.map(|robot| Path::ROOT.join(robot).to_string());
                let max = self.max_objects;
                let work = move |folder: &Folder| list(&folder.path, robot.as_deref(), max);
                return in_folder(folder, work).await;
            }
            Place::Store(Some(store)) => {
                store.reload_credentials()?;
                store
            }
            Place::Store(none) => none.insert(Box::new(Store::open(&self.settings)?)),
        };
        let begin = match robot {
            Some(robot) => self.prefix.clone().join(robot),
            None => self.prefix.clone(),
        };
        // Without the slash, the objects of `robot-70` would be those of `robot-7`, too.
        let begin = match begin.as_ref() {
            "" => String::new(),
            begin => format!("{begin}/"),
        };
        let (mut found, mut count, mut token) = (Found::new(), 0, None);
        loop {
            let page = timeout(TIMEOUT, store.page(&begin, token)).await;
            let (objects, next) = page.map_err(|_| ArchiveError::Slow)??;
            count += objects.len();
            for object in objects {
                add(&mut found, &self.prefix, &object);
            }
            token = next;
            if token.is_none() || count >= self.max_objects {
                return Ok(listing(found, token.is_some()));
            }
        }
    }

    /// Returns the manifest of a bag; `None` if it is gone, too large or damaged.
    ///
    /// # Errors
    /// Fails if the destination cannot be read.
    pub async fn manifest(&self, bag: &StoredBag) -> Result<Option<Manifest>, ArchiveError> {
        if bag.manifest_bytes > MANIFEST_BYTES {
            return Ok(None);
        }
        let text = match &self.place {
            Place::Folder(folder) => {
                let file = bag.manifest.clone();
                in_folder(folder, move |folder| read(&folder.path.join(file))).await?
            }
            Place::Store(Some(store)) => {
                let Ok(path) = Path::parse(&bag.manifest) else {
                    return Ok(None);
                };
                let content = timeout(TIMEOUT, store.get(&path)).await;
                let content = content.map_err(|_| ArchiveError::Slow)??;
                content.map(|content| content.to_vec())
            }
            Place::Store(None) => None,
        };
        Ok(text.and_then(|text| serde_json::from_slice(&text).ok()))
    }
}

/// Bags by the names of robot and bag; `None` without a manifest.
type Found = BTreeMap<(String, String), Option<StoredBag>>;

/// Adds the bag to which an object belongs: `ROBOT/BAG/FILE` below the prefix.
fn add(found: &mut Found, prefix: &Path, object: &ObjectMeta) {
    let Some(parts) = object.location.prefix_match(prefix) else {
        return;
    };
    let parts: Vec<_> = parts.map(|part| part.as_ref().to_owned()).collect();
    let [robot, name, file] = &parts[..] else {
        return;
    };
    let known = found.entry((robot.clone(), name.clone())).or_default();
    if file == FILE_NAME {
        *known = Some(StoredBag {
            robot: robot.clone(),
            name: name.clone(),
            delivered: Timestamp::from_second(object.last_modified.timestamp()).unwrap_or_default(),
            manifest_bytes: object.size,
            manifest: object.location.to_string(),
        });
    }
}

fn listing(found: Found, is_cut: bool) -> Listing {
    let unfinished = found.values().filter(|bag| bag.is_none()).count() as u64;
    Listing {
        bags: found.into_values().flatten().collect(),
        unfinished,
        is_cut,
    }
}

/// Runs `work` on a thread for files. While an earlier one hangs, no further one begins.
async fn in_folder<T: Send + 'static>(
    place: &Arc<FolderPlace>,
    work: impl FnOnce(&Folder) -> io::Result<T> + Send + 'static,
) -> Result<T, ArchiveError> {
    let place = Arc::clone(place);
    let worked = async {
        // The semaphore is never closed.
        let turn = Arc::clone(&place.turn).acquire_owned().await;
        let worked = spawn_blocking(move || {
            let _turn = turn;
            let folder = place.folder()?;
            folder.check()?;
            work(&folder).map_err(ArchiveError::Folder)
        });
        worked
            .await
            .map_err(|error| ArchiveError::Folder(io::Error::other(error)))?
    };
    let worked = timeout(TIMEOUT, worked).await;
    worked.unwrap_or(Err(ArchiveError::Slow))
}

impl FolderPlace {
    /// Returns the folder as it was first found: a disk that was mounted then must be mounted.
    fn folder(&self) -> Result<Folder, SettingsError> {
        let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
        match &*opened {
            Some(folder) => Ok(folder.clone()),
            None => Ok(opened.insert(Folder::open(self.path.clone())?).clone()),
        }
    }
}

/// Lists at most `max` bags in a folder.
fn list(root: &FilePath, robot: Option<&str>, max: usize) -> io::Result<Listing> {
    let mut found = Found::new();
    let mut count = 0;
    for robot_entry in names(root, max)? {
        if robot.is_some_and(|robot| robot != robot_entry) {
            continue;
        }
        // A robot's directory may vanish, and a file beside them is none.
        let Ok(bags) = names(&root.join(&robot_entry), max) else {
            continue;
        };
        for bag in bags {
            count += 1;
            if count > max {
                return Ok(listing(found, true));
            }
            let directory = root.join(&robot_entry).join(&bag);
            if let Ok(stored) = stored(&directory, &robot_entry, &bag) {
                found.insert((robot_entry.clone(), bag), stored);
            }
        }
    }
    Ok(listing(found, false))
}

/// Returns the bag in a directory; `None` without a manifest.
fn stored(directory: &FilePath, robot: &str, name: &str) -> io::Result<Option<StoredBag>> {
    if !directory.is_dir() {
        return Err(io::ErrorKind::NotADirectory.into());
    }
    let manifest = match fs::metadata(directory.join(FILE_NAME)) {
        Ok(manifest) => manifest,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    if !manifest.is_file() {
        return Ok(None);
    }
    Ok(Some(StoredBag {
        robot: robot.to_owned(),
        name: name.to_owned(),
        delivered: manifest.modified()?.try_into().map_err(io::Error::other)?,
        manifest_bytes: manifest.len(),
        manifest: format!("{robot}/{name}/{FILE_NAME}"),
    }))
}

/// Returns the names of a directory's entries: at most one more than `max`, which shows that there
/// are more.
fn names(directory: &FilePath, max: usize) -> io::Result<Vec<String>> {
    let entries = fs::read_dir(directory)?.take(max + 1);
    let names = entries.map(|entry| Ok(entry?.file_name().into_string().ok()));
    let names: io::Result<Vec<_>> = names.collect();
    Ok(names?.into_iter().flatten().collect())
}

/// Returns the content of a manifest; `None` if it is gone.
fn read(path: &FilePath) -> io::Result<Option<Vec<u8>>> {
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let mut text = Vec::new();
    file.take(MANIFEST_BYTES).read_to_end(&mut text)?;
    Ok(Some(text))
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixListener;

    use super::*;

    /// A folder with bags.
    struct Robots(tempfile::TempDir);

    impl Robots {
        fn new() -> Self {
            Self(tempfile::tempdir().unwrap())
        }

        fn archive(&self) -> Archive {
            Archive::new(StoreSettings {
                url: format!("file://{}", self.0.path().display()),
                ..StoreSettings::default()
            })
            .unwrap()
        }

        fn write(&self, path: &str, content: &str) {
            let path = self.0.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        }
    }

    const MANIFEST: &str = r#"{"version":1,"robot":"r","bag":"b","is_complete":true,"trigger":null,
        "findings":null,"start":null,"end":null,"messages":3,"topics":[],"files":[],"program":"p"}"#;

    #[tokio::test]
    async fn a_folder_has_the_bags_of_all_robots_or_of_one() {
        let robots = Robots::new();
        robots.write("r-1/a/manifest.json", MANIFEST);
        robots.write("r-1/b/b_0.mcap", "");
        robots.write("r-10/a/manifest.json", "damaged");
        robots.write("r-10/file", "");
        robots.write("file", "");
        let mut archive = robots.archive();
        let all = archive.bags(None).await.unwrap();
        let names: Vec<_> = all
            .bags
            .iter()
            .map(|bag| (&*bag.robot, &*bag.name))
            .collect();
        assert_eq!(names, [("r-1", "a"), ("r-10", "a")]);
        assert_eq!((all.unfinished, all.is_cut), (1, false));
        let manifest = archive.manifest(&all.bags[0]).await.unwrap();
        assert_eq!(manifest.unwrap().messages, 3);
        assert_eq!(archive.manifest(&all.bags[1]).await.unwrap(), None);
        let one = archive.bags(Some("r-1")).await.unwrap();
        assert_eq!(one.bags, all.bags[..1]);
        fs::remove_dir_all(robots.0.path().join("r-1/a")).unwrap();
        assert_eq!(
            archive.manifest(&all.bags[0]).await.unwrap(),
            None,
            "it is gone"
        );
    }

    #[tokio::test]
    async fn a_folder_that_is_gone_is_an_error_and_no_empty_list() {
        let robots = Robots::new();
        let mut archive = robots.archive();
        assert_eq!(archive.bags(None).await.unwrap(), Listing::default());
        fs::remove_dir_all(robots.0.path()).unwrap();
        let error = archive.bags(None).await.unwrap_err().to_string();
        assert!(error.contains("does not exist"), "{error}");
        let error = robots.archive().bags(None).await.unwrap_err().to_string();
        assert!(error.contains("does not exist"), "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_folder_that_hangs_holds_one_thread_and_delays_no_other_work() {
        let robots = Robots::new();
        let mut archive = robots.archive();
        archive.bags(None).await.unwrap();
        let Place::Folder(place) = &archive.place else {
            panic!("a folder");
        };
        // Another thread of the pool would be in a call that hangs.
        let turn = Arc::clone(&place.turn).try_acquire_owned().unwrap();
        for _ in 0..3 {
            let error = archive.bags(None).await.unwrap_err();
            assert!(matches!(error, ArchiveError::Slow), "{error}");
        }
        drop(turn);
        assert!(archive.bags(None).await.is_ok());
    }

    #[tokio::test]
    async fn manifests_beyond_the_cap_and_those_that_are_no_files_are_not_read() {
        let robots = Robots::new();
        let blanks = " ".repeat(usize::try_from(MANIFEST_BYTES).unwrap() - MANIFEST.len());
        robots.write("r/a/manifest.json", &format!("{blanks}{MANIFEST}"));
        robots.write("r/b/manifest.json", &format!("{blanks} {MANIFEST}"));
        robots.write("r/c/file", "");
        let _socket = UnixListener::bind(robots.0.path().join("r/c/manifest.json")).unwrap();
        let mut archive = robots.archive();
        let listing = archive.bags(None).await.unwrap();
        assert_eq!((listing.bags.len(), listing.unfinished), (2, 1));
        assert!(archive.manifest(&listing.bags[0]).await.unwrap().is_some());
        assert!(archive.manifest(&listing.bags[1]).await.unwrap().is_none());
    }

    #[tokio::test]
    async fn objects_beyond_the_cap_are_not_listed() {
        const MAX: usize = 3;
        let robots = Robots::new();
        let create = |bag: &str| fs::create_dir_all(robots.0.path().join(bag)).unwrap();
        let mut archive = robots.archive();
        assert_eq!(archive.max_objects, MAX_OBJECTS);
        archive.max_objects = MAX;
        for number in 0..MAX {
            create(&format!("r/{number}"));
        }
        let listing = archive.bags(None).await.unwrap();
        assert_eq!((listing.unfinished, listing.is_cut), (MAX as u64, false));
        create("s/1");
        let listing = archive.bags(None).await.unwrap();
        assert_eq!((listing.unfinished, listing.is_cut), (MAX as u64, true));
        let listing = archive.bags(Some("r")).await.unwrap();
        assert_eq!((listing.unfinished, listing.is_cut), (MAX as u64, false));
        create("r/more");
        let listing = archive.bags(Some("r")).await.unwrap();
        assert_eq!((listing.unfinished, listing.is_cut), (MAX as u64, true));
    }
}
