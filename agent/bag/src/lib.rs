//! Bags: recordings in rosbag2's MCAP form, on disk.
//!
//! A bag is a directory with metadata.yaml and files that `ros2 bag play`, Foxglove and the PyPI
//! readers open.
//!
//! - [`Writer`] writes a bag; [`Options`] selects form, compression and the size of files.
//! - [`info::Bag`] opens a bag and describes its content; [`read`] visits the records of a file.
//! - [`messages::read`] visits the messages of a bag, also in the sqlite3 storage.
//! - [`reindex::reindex`] completes the files of a bag whose writer was killed.
//! - [`lock::is_held`] returns whether a bag still has a writer.
//!
//! This crate starts no thread, reads no clock, and neither subscribes, decodes nor selects topics:
//! callers pass times, payloads and the text of schemas. sqlite3 bags are never written.
//!
//! ```
//! use std::collections::BTreeMap;
//!
//! use ros2probe_bag::info::Bag;
//! use ros2probe_bag::{Options, Schema, TopicDescription, Writer};
//! use ros2probe_wire::{Expansion, Timestamp};
//!
//! let directory = tempfile::tempdir()?;
//! let path = directory.path().join("run");
//! let mut writer = Writer::create(&path, Options::default())?;
//! let chatter = writer.topic(TopicDescription {
//!     name: "/chatter".into(),
//!     type_name: "std_msgs/msg/String".into(),
//!     type_hash: None,
//!     publishers: Vec::new(),
//!     schema: Some(Schema {
//!         encoding: "ros2msg".into(),
//!         text: "string data\n".into(),
//!     }),
//! })?;
//! let (received, sent) = (Timestamp(1_795_142_331_000_000_100), Timestamp(1_795_142_331_000_000_000));
//! writer.write(chatter, received, sent, 1, b"\0\x01\0\0\x06\0\0\0hello\0")?;
//! writer.close(BTreeMap::new())?;
//!
//! let bag = Bag::open(&path, Expansion::Limited)?;
//! assert_eq!(bag.metadata.message_count, 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![forbid(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

pub mod compression;
mod file;
mod file_compression;
pub mod info;
pub mod lock;
pub mod mcap;
pub mod messages;
pub mod metadata;
mod metadata_file;
pub mod options;
pub mod qos;
pub mod read;
pub mod reindex;
mod sqlite3;
mod writer;

pub use compression::{Compression, Progress};
pub use file_compression::{Compressed, FileCompression};
pub use options::{Form, Options, Storage};
pub use writer::{Schema, Summary, TopicDescription, TopicId, TopicSummary, Writer};

/// Why a bag cannot be written. After an error a file is valid up to its last flushed chunk.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The directory already exists. A writer never writes into an existing one.
    #[error("Output folder '{}' already exists.", .0.display())]
    Exists(PathBuf),
    /// The name is not UTF-8, but names of files and metadata.yaml derive from it.
    #[error("the bag's name must be text: {}", .0.display())]
    Name(PathBuf),
    /// The directory or a file in it cannot be created.
    #[error("cannot create {}", path.display())]
    Create {
        /// Path of the file or directory.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The file system is full, or the quota is used up.
    #[error("no space left to write {}", path.display())]
    DiskFull {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The file has the largest size that the file system or a process limit allows; a smaller
    /// `max_file_bytes` avoids this.
    #[error("{} has the largest size allowed", path.display())]
    FileTooLarge {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The recording's quota is used up.
    #[error("{0}")]
    Limit(String),
    /// Any other write error.
    #[error("cannot write {}", path.display())]
    Write {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// MCAP identifies channels and schemas by 16 bits.
    #[error("a bag holds at most 65535 topics and types")]
    TooManyTopics,
    /// A topic was described with two types, but a bag stores one.
    #[error("{topic} has the types {first} and {second}: a bag holds one of them")]
    TypeConflict {
        /// Name of the topic.
        topic: String,
        /// Type in the bag.
        first: String,
        /// Rejected type.
        second: String,
    },
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(suffix);
    PathBuf::from(name)
}

/// Creates a file of a bag, which must not exist: writable by its owner, readable by the group.
fn new_file(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o640).open(path)
}

/// Opens a regular file for reading. The open does not block on a pipe without a writer. The check
/// uses the open file, so the path cannot be swapped in between.
fn open_file(path: &Path) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    let flags = flags.bits().cast_signed();
    let mut options = OpenOptions::new();
    let file = options.read(true).custom_flags(flags).open(path)?;
    match file.metadata()?.is_file() {
        true => Ok(file),
        false => Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            "not a regular file",
        )),
    }
}

impl Error {
    fn writing(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                Self::DiskFull { path, source }
            }
            io::ErrorKind::FileTooLarge => Self::FileTooLarge { path, source },
            _ => Self::Write { path, source },
        }
    }

    fn creating(path: &Path, source: io::Error) -> Self {
        match Self::writing(path, source) {
            Self::Write { path, source } => Self::Create { path, source },
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn a_file_that_is_not_regular_is_refused_without_waiting() {
        let directory = tempfile::tempdir().unwrap();
        let pipe = directory.path().join("pipe");
        let status = Command::new("mkfifo").arg(&pipe).status();
        assert!(status.unwrap().success());
        for path in [pipe.as_path(), directory.path(), Path::new("/dev/zero")] {
            let refused = open_file(path).unwrap_err();
            assert_eq!(refused.to_string(), "not a regular file");
        }
    }
}
