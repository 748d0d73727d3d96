//! Settings of a delivery.

use std::io;
use std::path::{Path, PathBuf};

use object_store::ObjectStoreScheme;
use object_store::path::Path as StorePath;
use url::Url;

use crate::windows::Windows;

/// Settings of a delivery.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The destination.
    pub store: StoreSettings,
    /// Name of this robot.
    pub instance: String,
    /// Times of the day in which bags are delivered.
    pub windows: Windows,
    /// Whether triggered snapshots are delivered outside the windows too.
    pub triggered_always: bool,
    /// Directory of the bags.
    pub recordings: PathBuf,
    /// Directory of the records of deliveries.
    pub state: PathBuf,
    /// Limits of the space for bags.
    pub space: SpaceLimits,
}

/// A destination of bags.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoreSettings {
    /// `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`, `az://CONTAINER/PREFIX`, or
    /// `file:///DIRECTORY`.
    pub url: String,
    /// Address of a store other than that of the provider.
    pub endpoint: Option<String>,
    /// Region of the bucket.
    pub region: Option<String>,
    /// File with credentials: lines `NAME=value`.
    pub credentials_file: Option<PathBuf>,
    /// File with the certificate authorities that may sign the store's certificate.
    pub ca_file: Option<PathBuf>,
    /// Maximum number of bytes of requests per second.
    pub max_bytes_per_second: Option<u64>,
}

/// Limits of the agent for the space of bags.
#[derive(Clone, Copy, Debug, Default)]
pub struct SpaceLimits {
    /// Part of the file system that recordings leave free, in percent.
    pub reserve_percent: u8,
    /// Bytes that recordings leave free.
    pub reserve_bytes: u64,
    /// Maximum size of all bags, in bytes.
    pub max_total_bytes: Option<u64>,
}

/// Why a destination cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The URL names no destination.
    #[error("`{0}` is no destination, as in `s3://bucket/prefix` or `file:///mnt/bags`")]
    Url(String),
    /// A file cannot be read.
    #[error("cannot read {} (`{key}`)", path.display())]
    File {
        /// Key of the configuration.
        key: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A line of the credentials file is not `NAME=value` with a name of this store.
    #[error("line {line} of {} is not NAME=value with a name of this store", path.display())]
    Credentials {
        /// Path of the file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
    },
    /// A file has no certificates.
    #[error("{} has no certificates in PEM (`ca_file`)", .0.display())]
    Authorities(PathBuf),
    /// The certificate authorities of the system cannot be read.
    #[error("the certificate authorities of this system cannot be read: name others in `ca_file`")]
    SystemAuthorities(#[source] io::Error),
    /// The folder does not exist.
    #[error("the folder {} does not exist", .0.display())]
    Folder(PathBuf),
    /// The settings of the store are incomplete or contradict each other.
    #[error("the store cannot be used")]
    Store(#[source] object_store::Error),
}

/// Returns whether the text names a destination.
#[must_use]
pub fn is_destination(text: &str) -> bool {
    destination(text).is_some()
}

impl StoreSettings {
    /// Returns the path of the robots' directories, in the bucket or in the folder.
    pub(crate) fn prefix(&self) -> Result<StorePath, SettingsError> {
        let wrong = || SettingsError::Url(self.url.clone());
        let (_, url) = destination(&self.url).ok_or_else(wrong)?;
        match url.scheme() {
            "file" => Ok(StorePath::ROOT),
            _ => StorePath::from_url_path(url.path()).map_err(|_| wrong()),
        }
    }
}

/// Returns the kind of a destination and its URL.
pub(crate) fn destination(text: &str) -> Option<(ObjectStoreScheme, Url)> {
    let url = Url::parse(text).ok()?;
    let (scheme, _) = ObjectStoreScheme::parse(&url).ok()?;
    let is_known = match url.scheme() {
        "file" => url.to_file_path().is_ok_and(|path| path != Path::new("/")),
        "s3" | "gs" | "az" => url.username().is_empty() && url.password().is_none(),
        _ => false,
    };
    (is_known && url.query().is_none() && url.fragment().is_none()).then_some((scheme, url))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_destination_is_a_bucket_a_container_or_a_folder() {
        for text in [
            "s3://bags",
            "s3://bags/fleet/north",
            "gs://bags/fleet",
            "az://bags/fleet",
            "file:///mnt/bags",
        ] {
            assert!(is_destination(text), "{text}");
        }
        for text in [
            "",
            "bags",
            "/mnt/bags",
            "file:///",
            "file://host/mnt",
            "s3://",
            "s3://key:secret@bags",
            "s3://bags?x=1",
            "https://example.org/bags",
            "memory:///",
        ] {
            assert!(!is_destination(text), "{text}");
        }
    }
}
