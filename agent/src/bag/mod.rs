//! Bags: recordings in rosbag2's MCAP form, on disk.
//!
//! A directory with metadata.yaml and files that `ros2 bag play`, Foxglove and the PyPI readers
//! open. Written without thread, clock or signal: whoever records calls from a thread of its own
//! and passes times in. Nothing here subscribes, decodes or chooses topics, and sqlite3 bags are
//! neither written nor read.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

pub mod compression;
mod file;
pub mod info;
pub mod mcap;
pub mod metadata;
pub mod options;
pub mod qos;
pub mod read;
pub mod reindex;
mod writer;

pub use compression::{Compression, Progress};
pub use options::{Form, Options, Storage};
pub use writer::{
    Compressed, FileCompression, Schema, Summary, TopicDescription, TopicId, TopicSummary, Writer,
};

/// Why a bag cannot be written. After an error a file is valid up to its last flushed chunk.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Nothing is written into what exists.
    #[error("Output folder '{}' already exists.", .0.display())]
    Exists(PathBuf),
    /// File names are made of the directory's, and metadata.yaml is text.
    #[error("the bag's name must be text: {}", .0.display())]
    Name(PathBuf),
    /// The directory or a file in it cannot be made.
    #[error("cannot create {}", path.display())]
    Create {
        /// What.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The file system is full, or the quota is used up.
    #[error("no space left to write {}", path.display())]
    DiskFull {
        /// What.
        path: PathBuf,
        /// As the system says it.
        source: io::Error,
    },
    /// The file system or a limit of the process allows no larger file: splitting helps.
    #[error("{} has the largest size allowed", path.display())]
    FileTooLarge {
        /// What.
        path: PathBuf,
        /// As the system says it.
        source: io::Error,
    },
    /// What a recording may take is used up.
    #[error("{0}")]
    Limit(String),
    /// Anything else that writing can meet.
    #[error("cannot write {}", path.display())]
    Write {
        /// What.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// MCAP counts channels with 16 bits.
    #[error("a bag holds at most 65535 topics and types")]
    TooManyTopics,
    /// A topic has one type in a bag.
    #[error("{topic} has the types {first} and {second}: a bag holds one of them")]
    TypeConflict {
        /// Its name.
        topic: String,
        /// The one in the bag.
        first: String,
        /// The one refused.
        second: String,
    },
}

/// Makes a file of a bag, which must not exist: for its owner, and for the group to read.
fn new_file(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o640).open(path)
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
