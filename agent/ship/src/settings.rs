//! Settings of a delivery.

use std::io;
use std::path::{Path, PathBuf};

use object_store::ObjectStoreScheme;
use url::Url;

use crate::windows::Windows;

/// Settings of a delivery.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Destination: `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`, `az://CONTAINER/PREFIX`, or
    /// `file:///DIRECTORY`.
    pub url: String,
    /// Address of a store other than that of the provider.
    pub endpoint: Option<String>,
    /// Region of the bucket.
    pub region: Option<String>,
    /// Name of this robot.
    pub instance: String,
    /// File with credentials: lines `NAME=value`.
    pub credentials_file: Option<PathBuf>,
    /// File with the certificate authorities that may sign the store's certificate.
    pub ca_file: Option<PathBuf>,
    /// Maximum number of bytes of requests per second.
    pub max_bytes_per_second: Option<u64>,
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
    #[error("ship.url: `{0}` is no destination, as in `s3://bucket/prefix` or `file:///mnt/bags`")]
    Url(String),
    /// A file cannot be read.
    #[error("ship.{key}: cannot read {}", path.display())]
    File {
        /// Key of the configuration.
        key: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A line of the credentials file is not `NAME=value` with a name of this store.
    #[error("ship.credentials_file: line {line} of {} is not NAME=value with a name of this store", path.display())]
    Credentials {
        /// Path of the file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
    },
    /// A file has no certificates.
    #[error("ship.ca_file: {} has no certificates in PEM", .0.display())]
    Authorities(PathBuf),
    /// The certificate authorities of the system cannot be read.
    #[error("the certificate authorities of this system cannot be read (ship.ca_file)")]
    SystemAuthorities(#[source] io::Error),
    /// The folder does not exist.
    #[error("ship.url: the folder {} does not exist", .0.display())]
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
