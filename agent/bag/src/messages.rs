//! Reads all messages of a bag, in either storage of rosbag2.
//!
//! A bag that is damaged or was never completed is read as far as possible: [`Read::faults`] lists
//! the missing parts. Nothing is written.

use std::collections::BTreeMap;
use std::error::Error as _;
use std::ffi::OsStr;
use std::fmt;
use std::fs;
use std::io::{self, Read as _};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use ros2probe_wire::Expansion;

use super::info::{self, SQLITE_MAGIC, read_text};
use super::mcap;
use super::metadata::{self, Metadata, MetadataError};
use super::open_file;
use super::read::{self, Contents, ReadError};
use super::sqlite3;

/// One message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Message<'a> {
    /// Name of its topic.
    pub topic: &'a str,
    /// ROS type of its topic.
    pub type_name: &'a str,
    /// Definition of the type as `.msg` text; empty if the bag has none in this form.
    pub definition: &'a str,
    /// Time of reception, in nanoseconds since the epoch.
    pub log_time: u64,
    /// Time of sending; `None` if the storage has none.
    pub publish_time: Option<u64>,
    /// Start of the payload with its encapsulation header: at least 64 bytes, or all of a shorter
    /// payload. [`read_whole`] has all of it.
    pub begin: &'a [u8],
}

/// Result of reading a bag.
#[derive(Debug, Default)]
pub struct Read {
    /// Messages that were read.
    pub messages: u64,
    /// Parts that were not read.
    pub faults: Vec<Fault>,
}

/// A part of a bag that was not read.
#[derive(Debug)]
pub enum Fault {
    /// The recorder did not complete the file, or its end is missing.
    Unfinished(PathBuf),
    /// Parts of the file are damaged.
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// Number of chunks or pages.
        parts: u64,
    },
    /// A file cannot be read, or only in part.
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        error: MessagesError,
    },
    /// The latest messages are in a write-ahead log, which is not read.
    WriteAheadLog(PathBuf),
}

/// Why a bag cannot be read at all.
#[derive(Debug, thiserror::Error)]
pub enum MessagesError {
    /// The directory or file cannot be read.
    #[error("cannot read {}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// metadata.yaml is invalid.
    #[error("cannot read metadata.yaml of {}", path.display())]
    Metadata {
        /// Path of the bag.
        path: PathBuf,
        /// Cause of the failure.
        source: MetadataError,
    },
    /// A directory without files of a bag.
    #[error("{} holds no file of a bag", .0.display())]
    Empty(PathBuf),
    /// The file belongs to neither storage.
    #[error("{} is neither an MCAP file nor a sqlite3 bag", .0.display())]
    Unknown(PathBuf),
    /// Each message is compressed on its own.
    #[error("{}: rp does not read bags whose messages are compressed one by one", .0.display())]
    CompressedMessages(PathBuf),
}

/// Returns whether the path is a directory, or a file in a storage of rosbag2.
#[must_use]
pub fn is_bag(path: &Path) -> bool {
    path.is_dir() || begin_of(path).is_ok_and(|begin| storage(path, &begin).is_some())
}

/// Checks that a file of the bag exists and belongs to a storage of rosbag2. Messages are not read.
///
/// # Errors
/// Fails with the error of the first file if this holds for no file.
pub fn check(path: &Path) -> Result<(), MessagesError> {
    let mut first = None;
    for file in files_of(path)?.0 {
        match storage_of(&file) {
            Ok(_) => return Ok(()),
            Err(error) => first = first.or(Some(error)),
        }
    }
    first.map_or(Ok(()), Err)
}

/// A topic of a bag, as far as the bag describes it apart from its messages.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Topic {
    /// Name of the topic.
    pub name: String,
    /// Its ROS type.
    pub type_name: String,
    /// Definition of the type as `.msg` text; empty if it is not known.
    pub definition: String,
    /// QoS of its publishers ([`super::qos`]).
    pub offered_qos_profiles: String,
    /// RIHS01 hash of the type; empty if it is not known.
    pub type_description_hash: String,
}

impl From<metadata::Topic> for Topic {
    fn from(topic: metadata::Topic) -> Self {
        Self {
            name: topic.name,
            type_name: topic.type_name,
            definition: String::new(),
            offered_qos_profiles: topic.offered_qos_profiles,
            type_description_hash: topic.type_description_hash,
        }
    }
}

/// Returns the topics of a bag that metadata.yaml and the summaries of its files describe, by name.
/// A bag that was never completed describes none.
#[must_use]
pub fn topics(path: &Path) -> Vec<Topic> {
    let mut topics = BTreeMap::new();
    let metadata = read_text(&path.join(metadata::FILE_NAME)).ok();
    let metadata = metadata.and_then(|text| Metadata::read(&text).ok());
    for topic in metadata.into_iter().flat_map(|metadata| metadata.topics) {
        topics.insert(topic.name.clone(), Topic::from(topic));
    }
    let files = files_of(path).map_or_else(|_| Vec::new(), |(files, _)| files);
    for file in files {
        let Ok(Some(contents)) = Contents::of_summary(&file) else {
            continue;
        };
        for channel in contents.channels.values() {
            let described = topics
                .entry(channel.topic.clone())
                .or_insert_with(|| info::topic(&contents, channel).into());
            if described.definition.is_empty() {
                let schema = contents.schemas.get(&channel.schema_id);
                let definition = schema.and_then(definition_of);
                described.definition = definition.unwrap_or_default().to_owned();
            }
        }
    }
    topics.into_values().collect()
}

/// Returns the definition of a type as `.msg` text.
fn definition_of(schema: &mcap::Schema) -> Option<&str> {
    let definition = Some(schema).filter(|schema| schema.encoding == "ros2msg");
    definition.and_then(|schema| std::str::from_utf8(&schema.data).ok())
}

/// Called for each message, with the number of messages in the bag, if metadata.yaml has it.
type Visitor<'a> = dyn FnMut(&Message<'_>, Option<u64>) -> ControlFlow<()> + 'a;

/// How much of each payload is read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Extent {
    /// Its start.
    Begin,
    /// All of it.
    Whole,
}

/// Reads the messages of a bag, file by file, in the order in which a file stores them. `each` also
/// receives the number of messages in the bag, if metadata.yaml has it.
///
/// # Errors
/// Fails if nothing can be read.
pub fn read(
    path: &Path,
    expansion: Expansion,
    each: &mut dyn FnMut(&Message<'_>, Option<u64>),
) -> Result<Read, MessagesError> {
    read_until(path, expansion, Extent::Begin, &mut |message, total| {
        each(message, total);
        ControlFlow::Continue(())
    })
}

/// Does the same as [`read`], with whole payloads, until `each` breaks.
///
/// # Errors
/// Fails if nothing can be read.
pub fn read_whole(
    path: &Path,
    expansion: Expansion,
    each: &mut Visitor<'_>,
) -> Result<Read, MessagesError> {
    read_until(path, expansion, Extent::Whole, each)
}

fn read_until(
    path: &Path,
    expansion: Expansion,
    extent: Extent,
    each: &mut Visitor<'_>,
) -> Result<Read, MessagesError> {
    let (files, total) = files_of(path)?;
    let mut result = Read::default();
    let mut failed = None;
    let mut is_any_read = false;
    let mut is_stopped = false;
    for file in files {
        if is_stopped {
            break;
        }
        let before = result.messages;
        let read = read_file(&file, expansion, extent, &mut |message| {
            result.messages += 1;
            let flow = each(message, total);
            is_stopped = flow.is_break();
            flow
        });
        is_any_read |= read.is_ok() || result.messages > before;
        match read {
            // The rest of a file was not read if the visitor ended the reading.
            Ok(faults) if !is_stopped => result.faults.extend(faults),
            Ok(_) => {}
            Err(error) => failed = Some((file, error)),
        }
        // If messages of other files were read, the error concerns one file and not the whole bag.
        if is_any_read && let Some((path, error)) = failed.take() {
            result.faults.push(Fault::Unreadable { path, error });
        }
    }
    match failed {
        Some((_, error)) => Err(error),
        None => Ok(result),
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unfinished(path) => write!(
                f,
                "{} was not completed: messages up to its last complete record were read",
                path.display()
            ),
            Self::Damaged { path, parts } => {
                let (number, noun) = (parts, if *parts == 1 { "part" } else { "parts" });
                write!(f, "{}: {number} damaged {noun} skipped", path.display())
            }
            Self::Unreadable { path, error } => {
                write!(f, "{} was not read", path.display())?;
                match error.source() {
                    Some(source) => write!(f, ": {source}"),
                    None => write!(f, ": {error}"),
                }
            }
            Self::WriteAheadLog(path) => write!(
                f,
                "{} was not read: it holds the latest messages, until sqlite3 opens the bag",
                path.display()
            ),
        }
    }
}

#[derive(Clone, Copy)]
enum Storage {
    Mcap,
    Sqlite3,
}

fn storage(path: &Path, begin: &[u8]) -> Option<Storage> {
    if begin.starts_with(SQLITE_MAGIC) {
        return Some(Storage::Sqlite3);
    }
    // A compressed file is recognised by its name.
    let inner = path.file_stem().map(Path::new);
    let is_inner = inner.is_some_and(|inner| has_suffix(inner, "mcap"));
    let is_compressed = read::compression(path) != super::Compression::None && is_inner;
    (begin.starts_with(&mcap::MAGIC) || is_compressed).then_some(Storage::Mcap)
}

fn has_suffix(path: &Path, suffix: &str) -> bool {
    path.extension() == Some(OsStr::new(suffix))
}

fn begin_of(path: &Path) -> io::Result<Vec<u8>> {
    let mut begin = Vec::new();
    open_file(path)?.take(16).read_to_end(&mut begin)?;
    Ok(begin)
}

/// Returns the files of a bag in order, and its number of messages, if metadata.yaml has it.
fn files_of(path: &Path) -> Result<(Vec<PathBuf>, Option<u64>), MessagesError> {
    match path.is_dir() {
        true => files_in(path),
        false => Ok((vec![path.to_owned()], None)),
    }
}

fn files_in(directory: &Path) -> Result<(Vec<PathBuf>, Option<u64>), MessagesError> {
    let wrong = |source| MessagesError::Io {
        path: directory.to_owned(),
        source,
    };
    match read_text(&directory.join(metadata::FILE_NAME)) {
        Ok(text) => {
            let metadata = Metadata::read(&text).map_err(|source| MessagesError::Metadata {
                path: directory.to_owned(),
                source,
            })?;
            if metadata.compression_mode.eq_ignore_ascii_case("message") {
                return Err(MessagesError::CompressedMessages(directory.to_owned()));
            }
            // Old versions prefix the name of the directory; all files of a bag are in it.
            let names = metadata.relative_file_paths.iter();
            let names = names.filter_map(|path| Path::new(path).file_name());
            let files: Vec<_> = names.map(|name| directory.join(name)).collect();
            if files.is_empty() {
                return Err(MessagesError::Empty(directory.to_owned()));
            }
            return Ok((files, Some(metadata.message_count)));
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(source) => {
            return Err(MessagesError::Io {
                path: directory.join(metadata::FILE_NAME),
                source,
            });
        }
    }
    // The recorder was killed before it wrote metadata.yaml.
    let mut files = Vec::new();
    for entry in fs::read_dir(directory).map_err(wrong)? {
        let path = entry.map_err(wrong)?.path();
        if begin_of(&path).is_ok_and(|begin| storage(&path, &begin).is_some()) {
            files.push(path);
        }
    }
    // Files are sorted by number: `bag_10` follows `bag_9`.
    files.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    match files.is_empty() {
        true => Err(MessagesError::Empty(directory.to_owned())),
        false => Ok((files, None)),
    }
}

fn read_file(
    path: &Path,
    expansion: Expansion,
    extent: Extent,
    each: &mut dyn FnMut(&Message<'_>) -> ControlFlow<()>,
) -> Result<Vec<Fault>, MessagesError> {
    match storage_of(path)? {
        Storage::Mcap => read_mcap(path, expansion, each).map_err(|error| match error {
            ReadError::Io { path, source } => MessagesError::Io { path, source },
            ReadError::NotMcap(path) => MessagesError::Unknown(path),
        }),
        Storage::Sqlite3 => read_sqlite3(path, extent, each),
    }
}

/// Returns the storage of a file.
fn storage_of(path: &Path) -> Result<Storage, MessagesError> {
    let begin = begin_of(path).map_err(|source| MessagesError::Io {
        path: path.to_owned(),
        source,
    })?;
    storage(path, &begin).ok_or_else(|| MessagesError::Unknown(path.to_owned()))
}

fn read_mcap(
    path: &Path,
    expansion: Expansion,
    each: &mut dyn FnMut(&Message<'_>) -> ControlFlow<()>,
) -> Result<Vec<Fault>, ReadError> {
    let scan = read::scan_with_cut(path, expansion, &mut |message, contents| {
        let Some(channel) = contents.channels.get(&message.channel_id) else {
            return ControlFlow::Continue(());
        };
        let schema = contents.schemas.get(&channel.schema_id);
        let text = schema.and_then(definition_of);
        each(&Message {
            topic: &channel.topic,
            type_name: schema.map_or("", |schema| &schema.name),
            definition: text.unwrap_or_default(),
            log_time: message.log_time,
            publish_time: Some(message.publish_time),
            begin: message.data,
        })
    })?;
    let mut faults = Vec::new();
    if scan.unreadable_chunks > 0 {
        faults.push(Fault::Damaged {
            path: path.to_owned(),
            parts: scan.unreadable_chunks,
        });
    }
    if !scan.is_ended {
        faults.push(Fault::Unfinished(path.to_owned()));
    }
    Ok(faults)
}

fn read_sqlite3(
    path: &Path,
    extent: Extent,
    each: &mut dyn FnMut(&Message<'_>) -> ControlFlow<()>,
) -> Result<Vec<Fault>, MessagesError> {
    let longest = match extent {
        Extent::Begin => sqlite3::PREFIX,
        Extent::Whole => usize::try_from(read::MAX_RECORD).unwrap_or(usize::MAX),
    };
    let damaged = sqlite3::read(path, longest, each).map_err(|source| MessagesError::Io {
        path: path.to_owned(),
        source,
    })?;
    let mut faults = Vec::new();
    if damaged > 0 {
        faults.push(Fault::Damaged {
            path: path.to_owned(),
            parts: damaged,
        });
    }
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    let log = PathBuf::from(log);
    if fs::metadata(&log).is_ok_and(|log| log.len() > 0) {
        faults.push(Fault::WriteAheadLog(log));
    }
    Ok(faults)
}
