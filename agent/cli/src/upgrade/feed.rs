//! The feed: the file `release.json` of a release, on disk or at an address.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read as _};
use std::path::PathBuf;
use std::str::FromStr;

use hyper::Uri;
use hyper::http::uri::InvalidUri;
use serde::{Deserialize, Serialize};

use super::fetch::{self, FetchError};

/// Maximum size of a feed, in bytes.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// A release has no usable feed.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// The file of the feed cannot be read.
    #[error("cannot read the feed {}", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Why it cannot be read.
        source: io::Error,
    },
    /// The address has no feed.
    #[error("no feed at {place}")]
    Fetch {
        /// The address.
        place: Uri,
        /// Why the request failed.
        source: Box<FetchError>,
    },
    /// The content is not a feed.
    #[error("{place} is not a feed of ros2probe")]
    Content {
        /// Path or address.
        place: Location,
        /// The first mistake.
        source: ContentError,
    },
}

/// The first mistake in a feed.
#[derive(Debug, thiserror::Error)]
pub enum ContentError {
    /// It is larger than any feed.
    #[error("it has more than {MAX_BYTES} bytes")]
    Size,
    /// It is not JSON, or not of this form.
    #[error(transparent)]
    Form(#[from] serde_json::Error),
    /// A name could be part of another command.
    #[error("{0:?} is not the name of a file of a release")]
    Name(String),
    /// A file has no checksum.
    #[error("{0} has no checksum")]
    Checksum(String),
}

/// A text is not a version.
#[derive(Debug, thiserror::Error)]
#[error("{0:?} is not a version, as in 0.2.0")]
pub struct InvalidVersion(String);

/// A text is neither a path nor an address.
#[derive(Debug, thiserror::Error)]
pub enum InvalidLocation {
    /// The address has another scheme.
    #[error("must be a path, or begin with https:// or http://")]
    Scheme,
    /// The address has a mistake.
    #[error(transparent)]
    Address(#[from] InvalidUri),
    /// The path has a mistake.
    #[error(transparent)]
    Path(#[from] io::Error),
}

/// The newest release.
#[derive(Debug, Deserialize)]
pub struct Feed {
    /// Its version.
    pub version: Version,
    /// Address of its notes.
    pub notes: String,
    /// Checksums (SHA-256) by name of the files beside the feed.
    pub files: BTreeMap<String, String>,
}

/// A version of ros2probe, as in `0.2.0`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(try_from = "String", into = "String")]
pub struct Version([u32; 3]);

/// Path or address of a feed, or of a file beside it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Location {
    /// A path.
    Path(PathBuf),
    /// An address of HTTP or HTTPS.
    Address(Uri),
}

impl Feed {
    /// Reads the feed at this location.
    ///
    /// # Errors
    ///
    /// Fails if nothing can be read there within 20 s, or if the content is not a feed.
    pub fn read(location: &Location) -> Result<Self, FeedError> {
        let bytes = match location {
            Location::Path(path) => {
                let read = || {
                    let mut bytes = Vec::new();
                    let file = std::fs::File::open(path)?;
                    file.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
                    Ok(bytes)
                };
                read().map_err(|source| FeedError::Read {
                    path: path.clone(),
                    source,
                })?
            }
            Location::Address(address) => {
                fetch::fetch(address).map_err(|source| FeedError::Fetch {
                    place: address.clone(),
                    source: Box::new(source),
                })?
            }
        };
        Self::parse(&bytes).map_err(|source| FeedError::Content {
            place: location.clone(),
            source,
        })
    }

    fn parse(bytes: &[u8]) -> Result<Self, ContentError> {
        if bytes.len() > MAX_BYTES {
            return Err(ContentError::Size);
        }
        let feed: Self = serde_json::from_slice(bytes)?;
        for (name, sum) in &feed.files {
            // Commands contain the name.
            let fits = |c: char| c.is_ascii_alphanumeric() || "._+-".contains(c);
            if !name.starts_with(|c: char| c.is_ascii_alphanumeric()) || !name.chars().all(fits) {
                return Err(ContentError::Name(name.clone()));
            }
            if sum.len() != 64 || !sum.bytes().all(|byte| byte.is_ascii_hexdigit()) {
                return Err(ContentError::Checksum(name.clone()));
            }
        }
        Ok(feed)
    }
}

impl FromStr for Version {
    type Err = InvalidVersion;

    fn from_str(text: &str) -> Result<Self, InvalidVersion> {
        let wrong = || InvalidVersion(text.to_owned());
        let mut numbers = [0; 3];
        let mut parts = text.split('.');
        for number in &mut numbers {
            let part = parts.next().ok_or_else(wrong)?;
            let is_number = !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
            let parsed = part.parse().ok().filter(|_| is_number);
            *number = parsed.ok_or_else(wrong)?;
        }
        match parts.next() {
            None => Ok(Self(numbers)),
            Some(_) => Err(wrong()),
        }
    }
}

impl TryFrom<String> for Version {
    type Error = InvalidVersion;

    fn try_from(text: String) -> Result<Self, InvalidVersion> {
        text.parse()
    }
}

impl From<Version> for String {
    fn from(version: Version) -> Self {
        version.to_string()
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [major, minor, patch] = self.0;
        write!(f, "{major}.{minor}.{patch}")
    }
}

impl Location {
    /// Returns the location of a file in the same directory.
    #[must_use]
    pub(super) fn sibling(&self, name: &str) -> Self {
        match self {
            Self::Path(path) => Self::Path(path.with_file_name(name)),
            Self::Address(address) => {
                let directory = address.path().rsplit_once('/').map_or("", |(head, _)| head);
                let mut parts = address.clone().into_parts();
                parts.path_and_query = format!("{directory}/{name}").parse().ok();
                Self::Address(Uri::from_parts(parts).unwrap_or_default())
            }
        }
    }
}

impl FromStr for Location {
    type Err = InvalidLocation;

    fn from_str(text: &str) -> Result<Self, InvalidLocation> {
        if !text.contains("://") {
            return Ok(Self::Path(std::path::absolute(text)?));
        }
        let address: Uri = text.parse()?;
        match address.scheme_str() {
            Some("http" | "https") => Ok(Self::Address(address)),
            _ => Err(InvalidLocation::Scheme),
        }
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path(path) => write!(f, "{}", path.display()),
            Self::Address(address) => write!(f, "{address}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_compared_by_their_numbers() {
        let version = |text: &str| text.parse::<Version>().unwrap();
        assert!(version("0.10.0") > version("0.9.9"));
        assert!(version("1.0.0") > version("0.99.99"));
        assert_eq!(version("0.1.0").to_string(), "0.1.0");
        for wrong in [
            "", "1", "1.2", "1.2.3.4", "1.2.x", "1.2.+3", "1..3", "v1.2.3",
        ] {
            assert!(wrong.parse::<Version>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn files_are_beside_the_feed() {
        for (feed, file) in [
            ("/srv/release.json", "/srv/rp"),
            ("https://a.org/release.json", "https://a.org/rp"),
            ("https://a.org:8/x/y.json?z=/1", "https://a.org:8/x/rp"),
            ("http://[::1]:80", "http://[::1]:80/rp"),
        ] {
            let location: Location = feed.parse().unwrap();
            assert_eq!(location.sibling("rp").to_string(), file);
        }
        for wrong in ["ftp://a.org/x", "file:///x", "https://", "https:// a"] {
            assert!(wrong.parse::<Location>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn names_that_could_be_other_commands_are_refused() {
        let sum = "a".repeat(64);
        let feed = |name: &str, sum: &str| {
            let files = BTreeMap::from([(name, sum)]);
            let feed = serde_json::json!({"version": "1.0.0", "notes": "", "files": files});
            Feed::parse(feed.to_string().as_bytes())
        };
        assert!(feed("ros2probe_1.0.0_amd64.deb", &sum).is_ok());
        for name in ["", "../x", "a b", "-x", ".x", "a;b", "a\u{1b}", "$(x)"] {
            assert!(feed(name, &sum).is_err(), "{name}");
        }
        assert!(feed("x", "abc").is_err());
        assert!(feed("x", &"g".repeat(64)).is_err());
    }
}
