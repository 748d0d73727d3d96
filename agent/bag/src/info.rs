//! Content of a bag: the facts that `ros2 bag info` prints.
//!
//! Of a directory, only metadata.yaml is read, as rosbag2 does, so bags of other storages are
//! supported as well. Only [`Bag::details`] reads its files. Nothing is written.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use ros2probe_wire::Expansion;

use super::mcap::{Channel, Message};
use super::metadata::{self, File, Metadata, Topic};
use super::open_file;
use super::read::{self, Contents, ReadError};

/// A bag.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Bag {
    path: PathBuf,
    /// Content of metadata.yaml, or the equivalent for a single file.
    pub metadata: Metadata,
    /// Size of all files in the directory, in bytes.
    pub bytes: u64,
    expansion: Expansion,
}

/// Why a bag cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum InfoError {
    /// A directory that is not a bag, or a recording that never started.
    #[error(
        "Could not find metadata in bag directory {}: `rp bag reindex` makes it from the files",
        .0.display()
    )]
    NoMetadata(PathBuf),
    /// metadata.yaml is invalid.
    #[error("Exception on parsing info file: {0}")]
    Metadata(#[from] metadata::MetadataError),
    /// The bag uses another storage.
    #[error(
        "{} is in the sqlite3 storage, which rp does not read: `ros2 bag convert` makes an MCAP bag of it",
        .0.display()
    )]
    Sqlite3(PathBuf),
    /// The path is not a bag.
    #[error("No plugin detected that could open file {}", .0.display())]
    Unknown(PathBuf),
    /// A file of the bag cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
}

/// First bytes of a file of the sqlite3 storage.
pub(super) const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";

/// Suffix of a topic with service events.
pub const SERVICE_EVENT: &str = "/_service_event";

/// Facts that are in the files of a bag but not in its metadata.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Details {
    /// Bytes of messages, per topic.
    sizes: BTreeMap<String, u64>,
    /// Calls per topic with service events.
    calls: BTreeMap<String, Calls>,
}

/// Client and sequence number of each request and each response that was read.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
struct Calls {
    requests: BTreeSet<([u8; 16], i64)>,
    responses: BTreeSet<([u8; 16], i64)>,
}

impl Bag {
    /// Opens a directory with metadata.yaml, or one file.
    ///
    /// # Errors
    /// Fails if the path cannot be read or is not a bag.
    pub fn open(path: &Path, expansion: Expansion) -> Result<Self, InfoError> {
        let wrong = |source| ReadError::Io {
            path: path.to_owned(),
            source,
        };
        if !path.is_dir() {
            return Self::open_file(path, expansion);
        }
        let file = path.join(metadata::FILE_NAME);
        let text = match read_text(&file) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                return Err(InfoError::NoMetadata(path.to_owned()));
            }
            Err(source) => return Err(ReadError::Io { path: file, source }.into()),
        };
        let mut bytes = 0;
        for entry in fs::read_dir(path).map_err(wrong)? {
            let about = entry.and_then(|entry| entry.metadata()).map_err(wrong)?;
            if about.is_file() {
                bytes += about.len();
            }
        }
        Ok(Self {
            path: path.to_owned(),
            metadata: Metadata::read(&text)?,
            bytes,
            expansion,
        })
    }

    fn open_file(path: &Path, expansion: Expansion) -> Result<Self, InfoError> {
        let wrong = |source| ReadError::Io {
            path: path.to_owned(),
            source,
        };
        let mut begin = Vec::new();
        let mut file = open_file(path).map_err(wrong)?;
        (&mut file)
            .take(16)
            .read_to_end(&mut begin)
            .map_err(wrong)?;
        if begin == SQLITE_MAGIC {
            return Err(InfoError::Sqlite3(path.to_owned()));
        }
        let contents = match Contents::of_file(path, expansion) {
            Err(ReadError::NotMcap(path)) => return Err(InfoError::Unknown(path)),
            contents => contents?,
        };
        Ok(Self {
            path: path.to_owned(),
            metadata: of_contents(&contents, &path.display().to_string()),
            bytes: file.metadata().map_err(wrong)?.len(),
            expansion,
        })
    }

    /// Reads all messages, as `ros2 bag info -v` does.
    ///
    /// # Errors
    /// Fails if the bag uses another storage, or if a file cannot be read.
    pub fn details(&self) -> Result<Details, InfoError> {
        if self.metadata.storage_identifier != "mcap" {
            return Err(InfoError::Sqlite3(self.path.clone()));
        }
        let mut details = Details::default();
        for file in &self.metadata.relative_file_paths {
            let path = if self.path.is_dir() {
                self.path.join(file)
            } else {
                self.path.clone()
            };
            let mut calls = BTreeMap::new();
            let scan = read::scan(&path, self.expansion, &mut |message, contents| {
                let channel = contents.channels.get(&message.channel_id);
                if let Some(channel) = channel
                    && channel.topic.ends_with(SERVICE_EVENT)
                {
                    note_call(calls.entry(channel.topic.clone()).or_default(), message);
                }
            })?;
            for (id, size) in &scan.sizes {
                if let Some(channel) = scan.contents.channels.get(id) {
                    *details.sizes.entry(channel.topic.clone()).or_default() += size;
                }
            }
            for (topic, found) in calls {
                let calls: &mut Calls = details.calls.entry(topic).or_default();
                calls.requests.extend(found.requests);
                calls.responses.extend(found.responses);
            }
        }
        Ok(details)
    }
}

/// Returns the text of metadata.yaml. A file that is too large is cut one byte beyond the limit.
pub(super) fn read_text(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    let file = open_file(path)?;
    file.take(metadata::MAX_BYTES + 1)
        .read_to_string(&mut text)?;
    Ok(text)
}

/// Returns the equivalent of metadata.yaml for a single file.
pub(super) fn of_contents(contents: &Contents, path: &str) -> Metadata {
    let mut stored = None;
    let mut ros_distro = String::new();
    for record in &contents.metadata {
        if let Some(text) = record.entries.get("serialized_metadata") {
            stored = Metadata::read_record(text).ok().or(stored);
        }
        if let Some(distro) = record.entries.get("ROS_DISTRO") {
            ros_distro.clone_from(distro);
        }
    }
    let (start, end) = contents
        .times
        .unwrap_or((metadata::NO_START, metadata::NO_START));
    let message_count = contents.messages();
    let topics = contents.channels.values();
    let topics = topics.map(|channel| topic(contents, channel));
    let file = File {
        path: path.to_owned(),
        starting_time: start,
        duration: end.saturating_sub(start),
        message_count,
    };
    Metadata {
        version: stored.as_ref().map_or(5, |stored| stored.version),
        storage_identifier: "mcap".to_owned(),
        duration: file.duration,
        starting_time: start,
        message_count,
        topics: topics.collect(),
        compression_format: String::new(),
        compression_mode: String::new(),
        relative_file_paths: vec![path.to_owned()],
        files: vec![file],
        custom_data: stored
            .as_ref()
            .map(|stored| stored.custom_data.clone())
            .unwrap_or_default(),
        ros_distro: match stored {
            Some(stored) if !stored.ros_distro.is_empty() => stored.ros_distro,
            _ => ros_distro,
        },
    }
}

/// Returns what a file says of a channel's topic.
pub(super) fn topic(contents: &Contents, channel: &Channel) -> Topic {
    let of_channel = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
    let schema = contents.schemas.get(&channel.schema_id);
    Topic {
        name: channel.topic.clone(),
        type_name: schema.map(|schema| schema.name.clone()).unwrap_or_default(),
        serialization_format: channel.message_encoding.clone(),
        offered_qos_profiles: of_channel("offered_qos_profiles"),
        type_description_hash: of_channel("topic_type_hash"),
        message_count: contents.counts.get(&channel.id).copied().unwrap_or(0),
    }
}

impl Details {
    /// Returns the bytes of a topic's messages; 0 for an unknown topic.
    #[must_use]
    pub fn size(&self, topic: &str) -> u64 {
        self.sizes.get(topic).copied().unwrap_or(0)
    }

    /// Returns the numbers of requests and responses of a service, by the name of its event topic.
    #[must_use]
    pub fn calls(&self, topic: &str) -> (usize, usize) {
        let calls = self.calls.get(topic);
        calls.map_or((0, 0), |calls| {
            (calls.requests.len(), calls.responses.len())
        })
    }
}

/// Records a service event, which begins with `service_msgs/msg/ServiceEventInfo`: kind, time,
/// client, sequence number.
fn note_call(calls: &mut Calls, message: &Message<'_>) {
    let Some((header, body)) = message.data.split_first_chunk::<4>() else {
        return;
    };
    let kind = body.first().copied();
    let client = body
        .get(12..28)
        .and_then(|client| client.first_chunk::<16>())
        .copied();
    let number = body
        .get(32..40)
        .and_then(|number| number.first_chunk::<8>())
        .copied();
    let (Some(kind), Some(client), Some(number)) = (kind, client, number) else {
        return;
    };
    let is_little = header
        .get(1)
        .is_some_and(|encapsulation| encapsulation & 1 == 1);
    let number = if is_little {
        i64::from_le_bytes(number)
    } else {
        i64::from_be_bytes(number)
    };
    match kind {
        0 | 1 => calls.requests.insert((client, number)),
        2 | 3 => calls.responses.insert((client, number)),
        _ => false,
    };
}
