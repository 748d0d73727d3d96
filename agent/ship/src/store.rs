//! Destinations: object stores with parts that outlive this process, and folders.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::list::{PaginatedListOptions, PaginatedListResult, PaginatedListStore};
use object_store::local::LocalFileSystem;
use object_store::multipart::{MultipartStore, PartId};
use object_store::path::Path;
use object_store::{
    Error, MultipartUpload as _, ObjectMeta, ObjectStore, ObjectStoreExt as _, ObjectStoreScheme,
    PutPayload, RetryConfig,
};
use tokio::time::sleep_until;

use crate::credentials::{Credentials, Entry};
use crate::http::Connections;
use crate::link::{Link, PIECE_BYTES};
use crate::settings::{SettingsError, StoreSettings, destination};

/// Number of objects in one page of a listing: the most that S3 returns.
const PAGE_OBJECTS: usize = 1_000;

/// The destination with its current credentials.
pub(crate) struct Store {
    settings: StoreSettings,
    link: Arc<Link>,
    credentials: Credentials,
    client: Client,
}

enum Client {
    Parts(Arc<dyn Parts>),
    Folder(Arc<LocalFileSystem>, Folder),
}

/// The folder of a destination.
#[derive(Clone)]
pub(crate) struct Folder {
    pub(crate) path: PathBuf,
    /// Directory above it, or itself, at which another file system was mounted.
    mount_point: Option<PathBuf>,
}

impl Folder {
    pub(crate) fn open(path: PathBuf) -> Result<Self, SettingsError> {
        if !path.is_dir() {
            return Err(SettingsError::Folder(path));
        }
        Ok(Self {
            mount_point: path
                .ancestors()
                .find(|it| is_mount_point(it))
                .map(Into::into),
            path,
        })
    }

    /// Fails if the folder is gone. Files would otherwise create it again: on the robot's own disk,
    /// if a disk was removed.
    pub(crate) fn check(&self) -> Result<(), StoreError> {
        let is_mounted = self.mount_point.as_deref().is_none_or(is_mount_point);
        if self.path.is_dir() && is_mounted {
            return Ok(());
        }
        let gone = SettingsError::Folder(self.path.clone());
        Err(StoreError::Unusable(gone.to_string()))
    }
}

/// Returns whether a directory is on another file system than the one above it. The root is none.
fn is_mount_point(path: &std::path::Path) -> bool {
    let device = |path: &std::path::Path| fs::metadata(path).ok().map(|it| it.dev());
    path.parent()
        .is_some_and(|above| device(path) != device(above))
}

/// A store whose parts can be sent by one process and completed by another, and whose objects are
/// listed in pages.
trait Parts: ObjectStore + MultipartStore + PaginatedListStore {}

impl<S: ObjectStore + MultipartStore + PaginatedListStore> Parts for S {}

/// A request failed. The texts name neither addresses nor credentials.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum StoreError {
    /// The store has no such object or upload.
    #[error("the store has no such object, upload or bucket (404)")]
    Missing(Option<Duration>),
    /// The store refuses the request.
    #[error("the store answers {status}{code}")]
    Refused {
        status: hyper::StatusCode,
        /// Code of the store, in brackets.
        code: String,
        /// Pause that the store demands.
        pause: Option<Duration>,
    },
    /// The store is out of reach.
    #[error("the store is out of reach: {0}")]
    Unreachable(String),
    /// The destination's files or credentials cannot be used.
    #[error("{0}")]
    Unusable(String),
}

impl StoreError {
    /// Returns the pause that the store demands.
    pub(crate) const fn pause(&self) -> Option<Duration> {
        match self {
            Self::Missing(pause) | Self::Refused { pause, .. } => *pause,
            Self::Unreachable(_) | Self::Unusable(_) => None,
        }
    }
}

impl Store {
    /// Opens the destination without a request.
    pub(crate) fn open(settings: &StoreSettings) -> Result<Self, SettingsError> {
        let link = Arc::new(Link::new(settings.max_bytes_per_second));
        let credentials = read(settings)?;
        Ok(Self {
            client: client(settings, &credentials, &link)?,
            settings: settings.clone(),
            link,
            credentials,
        })
    }

    /// Uses replaced credentials from now on.
    ///
    /// Fails if they cannot be used.
    pub(crate) fn reload_credentials(&mut self) -> Result<(), SettingsError> {
        let credentials = read(&self.settings)?;
        if credentials != self.credentials {
            self.reopen(credentials)?;
        }
        Ok(())
    }

    /// Reads all files again, also those that the file with credentials names.
    pub(crate) fn reopen_all(&mut self) -> Result<(), SettingsError> {
        let credentials = read(&self.settings)?;
        self.reopen(credentials)
    }

    fn reopen(&mut self, credentials: Credentials) -> Result<(), SettingsError> {
        let mut client = client(&self.settings, &credentials, &self.link)?;
        if let (Client::Folder(_, new), Client::Folder(_, known)) = (&mut client, &self.client) {
            // A disk that was removed and comes again is mounted, as before.
            new.mount_point = known.mount_point.clone().or(new.mount_point.take());
        }
        self.client = client;
        self.credentials = credentials;
        Ok(())
    }

    /// Returns whether an upload of parts outlives this process.
    pub(crate) const fn is_resumable(&self) -> bool {
        matches!(self.client, Client::Parts(_))
    }

    /// Returns the content of an object; `None` if it does not exist.
    pub(crate) async fn get(&self, path: &Path) -> Result<Option<Bytes>, StoreError> {
        let got = match self.object_store().get(path).await {
            Ok(got) => got.bytes().await,
            Err(Error::NotFound { .. }) => return Ok(None),
            Err(error) => Err(error),
        };
        got.map(Some).map_err(|error| self.failed(&error))
    }

    /// Returns a page of the objects whose names begin with a text, and the token of the next page.
    /// A folder has no pages.
    pub(crate) async fn page(
        &self,
        begin: &str,
        token: Option<String>,
    ) -> Result<(Vec<ObjectMeta>, Option<String>), StoreError> {
        let options = PaginatedListOptions {
            max_keys: Some(PAGE_OBJECTS),
            page_token: token,
            ..PaginatedListOptions::default()
        };
        let page = self.parts()?.list_paginated(Some(begin), options).await;
        let PaginatedListResult { result, page_token } = page.map_err(|it| self.failed(&it))?;
        Ok((result.objects, page_token))
    }

    /// Returns the size of an object in bytes; `None` if it does not exist.
    pub(crate) async fn size(&self, path: &Path) -> Result<Option<u64>, StoreError> {
        match self.object_store().head(path).await {
            Ok(object) => Ok(Some(object.size)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// Writes an object at once. It replaces an earlier one.
    pub(crate) async fn put(&self, path: &Path, content: Bytes) -> Result<(), StoreError> {
        if let Client::Folder(_, folder) = &self.client {
            sleep_until(self.link.reserve(content.len())).await;
            folder.check()?;
        }
        let put = self.object_store().put(path, content.into()).await;
        put.map(drop).map_err(|error| self.failed(&error))
    }

    /// Begins an upload in parts, and returns its id.
    pub(crate) async fn begin(&self, path: &Path) -> Result<String, StoreError> {
        let begun = self.parts()?.create_multipart(path).await;
        begun.map_err(|error| self.failed(&error))
    }

    /// Writes one part, numbered from 0, and returns its id.
    pub(crate) async fn put_part(
        &self,
        path: &Path,
        upload: &str,
        number: usize,
        content: Bytes,
    ) -> Result<String, StoreError> {
        let upload = upload.to_owned();
        let content = PutPayload::from(content);
        let put = self.parts()?.put_part(path, &upload, number, content).await;
        put.map(|part| part.content_id)
            .map_err(|error| self.failed(&error))
    }

    /// Completes an upload. The object exists as a whole from then on.
    pub(crate) async fn complete(
        &self,
        path: &Path,
        upload: &str,
        parts: &[String],
    ) -> Result<(), StoreError> {
        let parts = parts.iter().map(|id| PartId {
            content_id: id.clone(),
        });
        let (store, upload) = (self.parts()?, upload.to_owned());
        let completed = store
            .complete_multipart(path, &upload, parts.collect())
            .await;
        completed.map(drop).map_err(|error| self.failed(&error))
    }

    /// Ends an upload that nothing continues. A failure is ignored: stores remove such uploads by
    /// their own rules.
    pub(crate) async fn abort(&self, path: &Path, upload: &str) {
        if let Client::Parts(store) = &self.client {
            let _ = store.abort_multipart(path, &upload.to_owned()).await;
        }
    }

    /// Begins a file in a folder. Files of earlier attempts are removed.
    pub(crate) async fn begin_file(&self, path: &Path) -> Result<FolderFile, StoreError> {
        let Client::Folder(folder, place) = &self.client else {
            return Err(unsupported());
        };
        place.check()?;
        let file = folder.path_to_filesystem(path);
        remove_attempts(&file.map_err(|error| self.failed(&error))?);
        let upload = folder.put_multipart(path).await;
        Ok(FolderFile {
            upload: upload.map_err(|error| self.failed(&error))?,
            link: Arc::clone(&self.link),
        })
    }

    fn object_store(&self) -> &dyn ObjectStore {
        match &self.client {
            Client::Parts(store) => store,
            Client::Folder(folder, _) => folder,
        }
    }

    fn parts(&self) -> Result<&dyn Parts, StoreError> {
        match &self.client {
            Client::Parts(store) => Ok(&**store),
            Client::Folder(..) => Err(unsupported()),
        }
    }

    fn failed(&self, error: &Error) -> StoreError {
        if matches!(self.client, Client::Folder(..)) {
            return unusable(error);
        }
        match self.link.refusal() {
            Some(refusal) if refusal.status == hyper::StatusCode::NOT_FOUND => {
                StoreError::Missing(refusal.pause)
            }
            Some(refusal) => StoreError::Refused {
                status: refusal.status,
                code: code(&error.to_string()),
                pause: refusal.pause,
            },
            None => StoreError::Unreachable(innermost(error)),
        }
    }
}

/// A file in a folder. It gets its final name once it is complete.
pub(crate) struct FolderFile {
    upload: Box<dyn object_store::MultipartUpload>,
    link: Arc<Link>,
}

impl FolderFile {
    /// Appends bytes.
    pub(crate) async fn write(&mut self, content: Bytes) -> Result<(), StoreError> {
        let mut rest = content;
        while !rest.is_empty() {
            let piece = rest.split_to(rest.len().min(PIECE_BYTES * 16));
            sleep_until(self.link.reserve(piece.len())).await;
            let put = self.upload.put_part(piece.into()).await;
            put.map_err(|error| unusable(&error))?;
        }
        Ok(())
    }

    /// Completes the file, which is then on disk.
    pub(crate) async fn complete(mut self) -> Result<(), StoreError> {
        let completed = self.upload.complete().await;
        completed.map(drop).map_err(|error| unusable(&error))
    }

    /// Removes the unfinished file.
    pub(crate) async fn abort(mut self) {
        let _ = self.upload.abort().await;
    }
}

/// Removes unfinished files of killed processes: the library names them `NAME#NUMBER`.
fn remove_attempts(file: &std::path::Path) {
    let (Some(directory), Some(name)) = (file.parent(), file.file_name()) else {
        return;
    };
    let begin = format!("{}#", name.to_string_lossy());
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let found = entry.file_name();
        let number = found.to_str().and_then(|found| found.strip_prefix(&begin));
        if number.is_some_and(|number| number.bytes().all(|digit| digit.is_ascii_digit())) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

fn unusable(error: &Error) -> StoreError {
    StoreError::Unusable(innermost(error))
}

fn unsupported() -> StoreError {
    StoreError::Unusable("the destination has no such operation".to_owned())
}

/// Returns the last cause of an error, without addresses of requests.
fn innermost(error: &Error) -> String {
    let mut cause: &dyn std::error::Error = error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    cause.to_string()
}

/// Returns the code of an answer in XML or JSON, in brackets; an empty text without one.
fn code(answer: &str) -> String {
    let element = |name: &str| answer.split(&format!("<{name}>")).nth(1)?.split('<').next();
    let code = element("Code").unwrap_or_default();
    let is_plain = code.bytes().all(|letter| letter.is_ascii_alphanumeric());
    match (1..=64).contains(&code.len()) && is_plain {
        true => format!(" ({code})"),
        false => String::new(),
    }
}

fn read(settings: &StoreSettings) -> Result<Credentials, SettingsError> {
    let file = settings.credentials_file.as_deref();
    file.map_or_else(|| Ok(Credentials::default()), Credentials::read)
}

/// Creates a client from the environment, then the configuration, then the file with credentials.
fn client(
    settings: &StoreSettings,
    credentials: &Credentials,
    link: &Arc<Link>,
) -> Result<Client, SettingsError> {
    let wrong = || SettingsError::Url(settings.url.clone());
    let (scheme, url) = destination(&settings.url).ok_or_else(wrong)?;
    if scheme == ObjectStoreScheme::Local {
        let folder = url.to_file_path().map_err(|()| wrong())?;
        return open_folder(folder);
    }
    let is_secure = settings
        .endpoint
        .as_deref()
        .is_none_or(|endpoint| !endpoint.starts_with("http://"));
    let ca_file = settings.ca_file.as_deref();
    let connections = Connections::new(ca_file, is_secure, Arc::clone(link))?;
    // The shipper itself repeats failed requests.
    let retry = RetryConfig {
        max_retries: 0,
        ..RetryConfig::default()
    };
    // The URL of the bucket, without the prefix.
    let bucket = format!("{}://{}", url.scheme(), url.host_str().unwrap_or_default());
    let key = |entry: &Entry| SettingsError::Credentials {
        path: settings.credentials_file.clone().unwrap_or_default(),
        line: entry.line,
    };
    let store: Arc<dyn Parts> = match scheme {
        ObjectStoreScheme::AmazonS3 => {
            let mut builder = AmazonS3Builder::from_env().with_url(bucket);
            if let Some(endpoint) = &settings.endpoint {
                builder = builder.with_endpoint(endpoint);
            }
            if let Some(region) = &settings.region {
                builder = builder.with_region(region);
            }
            for entry in &credentials.0 {
                builder = builder.with_config(parsed(entry, key)?, &entry.value);
            }
            let builder = builder.with_retry(retry).with_http_connector(connections);
            Arc::new(builder.build().map_err(SettingsError::Store)?)
        }
        ObjectStoreScheme::GoogleCloudStorage => {
            let mut builder = GoogleCloudStorageBuilder::from_env().with_url(bucket);
            if let Some(endpoint) = &settings.endpoint {
                builder = builder.with_base_url(endpoint);
            }
            for entry in &credentials.0 {
                builder = builder.with_config(parsed(entry, key)?, &entry.value);
            }
            let builder = builder.with_retry(retry).with_http_connector(connections);
            Arc::new(builder.build().map_err(SettingsError::Store)?)
        }
        ObjectStoreScheme::MicrosoftAzure => {
            let mut builder = MicrosoftAzureBuilder::from_env().with_url(bucket);
            if let Some(endpoint) = &settings.endpoint {
                builder = builder.with_endpoint(endpoint.clone());
            }
            for entry in &credentials.0 {
                builder = builder.with_config(parsed(entry, key)?, &entry.value);
            }
            let builder = builder.with_retry(retry).with_http_connector(connections);
            Arc::new(builder.build().map_err(SettingsError::Store)?)
        }
        _ => return Err(wrong()),
    };
    Ok(Client::Parts(store))
}

fn parsed<K: FromStr>(
    entry: &Entry,
    wrong: impl Fn(&Entry) -> SettingsError,
) -> Result<K, SettingsError> {
    entry.name.parse().map_err(|_| wrong(entry))
}

/// Opens a folder, which must exist: the path of a disk that is not mounted is not created.
fn open_folder(folder: PathBuf) -> Result<Client, SettingsError> {
    let place = Folder::open(folder)?;
    let store = LocalFileSystem::new_with_prefix(&place.path).map_err(SettingsError::Store)?;
    Ok(Client::Folder(Arc::new(store.with_fsync(true)), place))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_gone_or_no_longer_mounted_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bags");
        assert!(Folder::open(path.clone()).is_err());
        fs::create_dir(&path).unwrap();
        let folder = Folder::open(path.clone()).unwrap();
        assert_eq!(folder.check(), Ok(()));
        fs::remove_dir(&path).unwrap();
        let Err(StoreError::Unusable(reason)) = folder.check() else {
            panic!("it is gone");
        };
        assert!(reason.contains(&path.display().to_string()), "{reason}");
        // A disk that was mounted at the directory above it is gone.
        fs::create_dir(&path).unwrap();
        let folder = Folder {
            mount_point: Some(directory.path().to_owned()),
            path,
        };
        assert!(folder.check().is_err());
        let proc = Folder::open(PathBuf::from("/proc/self")).unwrap();
        assert_eq!(
            proc.mount_point.as_deref(),
            Some(std::path::Path::new("/proc"))
        );
        assert_eq!(proc.check(), Ok(()));
    }

    #[test]
    fn only_the_error_code_of_a_response_is_printed() {
        let answer =
            "403 <Error><Code>InvalidAccessKeyId</Code><AWSAccessKeyId>AK</AWSAccessKeyId>";
        assert_eq!(code(answer), " (InvalidAccessKeyId)");
        assert_eq!(code("<Code>a b</Code>"), "");
        assert_eq!(code("<Code></Code>"), "");
        assert_eq!(code("no XML"), "");
    }

    #[test]
    fn files_of_killed_attempts_are_removed_and_others_are_kept() {
        let directory = tempfile::tempdir().unwrap();
        for name in ["a.mcap#1", "a.mcap#22", "a.mcap", "a.mcap#x", "b.mcap#1"] {
            fs::write(directory.path().join(name), "1").unwrap();
        }
        remove_attempts(&directory.path().join("a.mcap"));
        let mut left: Vec<_> = fs::read_dir(directory.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        left.sort();
        assert_eq!(left, ["a.mcap", "a.mcap#x", "b.mcap#1"]);
    }
}
