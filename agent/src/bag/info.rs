//! What `ros2 bag info` says about a bag, by dialect.
//!
//! From metadata.yaml alone where there is one, as the original does, so that bags of another
//! storage are shown as well; only `-v` reads the files. Writes nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use jiff::tz::TimeZone;

use super::mcap::Message;
use super::metadata::{self, File, Metadata, Topic};
use super::read::{self, Contents, ReadError};
use crate::ros2::Dialect;
use crate::visible::visible;

/// A bag to be told about.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Bag {
    path: PathBuf,
    /// As metadata.yaml has it, or as a single file would.
    pub metadata: Metadata,
    /// Of all files in the directory.
    pub bytes: u64,
}

/// Why nothing can be told.
#[derive(Debug, thiserror::Error)]
pub enum InfoError {
    /// A directory that is no bag, or a recording that never began.
    #[error(
        "Could not find metadata in bag directory {}: `rp bag reindex` makes it from the files",
        .0.display()
    )]
    NoMetadata(PathBuf),
    /// metadata.yaml is none.
    #[error("Exception on parsing info file: {0}")]
    Metadata(#[from] metadata::MetadataError),
    /// Another storage.
    #[error(
        "{} is in the sqlite3 storage, which rp does not read: `ros2 bag convert` makes an MCAP bag of it",
        .0.display()
    )]
    Sqlite3(PathBuf),
    /// No bag at all.
    #[error("No plugin detected that could open file {}", .0.display())]
    Unknown(PathBuf),
    /// A file of it.
    #[error(transparent)]
    Read(#[from] ReadError),
}

/// In which order topics are told.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum Sort {
    /// By name.
    #[default]
    Name,
    /// By type.
    Type,
    /// By number of messages.
    Count,
}

/// What only the files tell.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Details {
    /// Bytes of each topic's messages.
    sizes: BTreeMap<String, u64>,
    /// Of each topic with service events.
    calls: BTreeMap<String, Calls>,
}

/// Client and sequence number of each request and each response seen.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
struct Calls {
    requests: BTreeSet<([u8; 16], i64)>,
    responses: BTreeSet<([u8; 16], i64)>,
}

impl Bag {
    /// Opens a directory with metadata.yaml, or one file.
    pub fn open(path: &Path) -> Result<Self, InfoError> {
        let wrong = |source| ReadError::Io {
            path: path.to_owned(),
            source,
        };
        if !path.is_dir() {
            return Self::open_file(path);
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
        })
    }

    fn open_file(path: &Path) -> Result<Self, InfoError> {
        let wrong = |source| ReadError::Io {
            path: path.to_owned(),
            source,
        };
        let mut begin = Vec::new();
        let mut file = crate::file::open(path).map_err(wrong)?;
        (&mut file)
            .take(16)
            .read_to_end(&mut begin)
            .map_err(wrong)?;
        if begin == b"SQLite format 3\0" {
            return Err(InfoError::Sqlite3(path.to_owned()));
        }
        let contents = match Contents::of_file(path) {
            Err(ReadError::NotMcap(path)) => return Err(InfoError::Unknown(path)),
            contents => contents?,
        };
        Ok(Self {
            path: path.to_owned(),
            metadata: of_contents(&contents, &path.display().to_string()),
            bytes: file.metadata().map_err(wrong)?.len(),
        })
    }

    /// Reads all messages for `-v`.
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
            let scan = read::scan(&path, &mut |message, contents| {
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

    /// Everything, in the time zone of this host; with details as `-v` tells it.
    #[must_use]
    pub fn text(&self, dialect: Dialect, sort: Sort, details: Option<&Details>) -> String {
        self.text_in(&TimeZone::system(), dialect, sort, details)
    }

    /// As [`Self::text`], in this time zone.
    #[must_use]
    pub fn text_in(
        &self,
        zone: &TimeZone,
        dialect: Dialect,
        sort: Sort,
        details: Option<&Details>,
    ) -> String {
        let metadata = &self.metadata;
        let parts = Parts::of(&metadata.topics, dialect, sort);
        let mut text = "\n".to_owned();
        let mut line = |label: &str, value: &dyn std::fmt::Display| {
            let _ = writeln!(text, "{label:<LABEL$}{value}");
        };
        let files = metadata.relative_file_paths.iter();
        let files: Vec<String> = files.map(|file| visible(file).into_owned()).collect();
        line("Files:", &lines_of(&files));
        line("Bag size:", &size(self.bytes));
        line("Storage id:", &visible(&metadata.storage_identifier));
        if dialect > Dialect::Humble {
            let distro = visible(&metadata.ros_distro);
            line(
                "ROS Distro:",
                &if distro.is_empty() {
                    "unknown"
                } else {
                    &distro
                },
            );
        }
        let end = metadata.starting_time.saturating_add(metadata.duration);
        line(
            "Duration:",
            &format_args!("{}s", seconds(metadata.duration)),
        );
        line("Start:", &moment(metadata.starting_time, zone));
        line("End:", &moment(end, zone));
        line(
            "Messages:",
            &metadata.message_count.saturating_sub(parts.apart),
        );
        let topics: Vec<String> = parts
            .topics
            .iter()
            .map(|topic| topic_line(topic, details))
            .collect();
        line("Topic information:", &lines_of(&topics));
        if dialect > Dialect::Humble {
            let label = if dialect == Dialect::Jazzy {
                "Service:"
            } else {
                "Services:"
            };
            line(label, &parts.services.len());
            text.push_str("Service information: ");
            parts.write_services(&mut text, details);
        }
        if dialect > Dialect::Jazzy {
            // Lines of services end, and `-v` adds one.
            if parts.services.is_empty() || details.is_some() {
                text.push('\n');
            }
            let _ = writeln!(text, "{:<LABEL$}{}", "Actions:", parts.actions.len());
            text.push_str("Action information: ");
            parts.write_actions(&mut text, details);
        }
        text.push('\n');
        text
    }

    /// As `-t` tells it: names alone, without those of services and actions.
    #[must_use]
    pub fn names(&self, dialect: Dialect, sort: Sort) -> String {
        let parts = Parts::of(&self.metadata.topics, dialect, sort);
        parts
            .topics
            .iter()
            .map(|topic| format!("{}\n", visible(&topic.name)))
            .collect()
    }
}

/// The text of metadata.yaml; of one that is too large, enough to see that.
pub(super) fn read_text(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    let file = crate::file::open(path)?;
    file.take(metadata::MAX_BYTES + 1)
        .read_to_string(&mut text)?;
    Ok(text)
}

/// A single file's, as metadata.yaml would have it.
pub(super) fn of_contents(contents: &Contents, path: &str) -> Metadata {
    let mut said = None;
    let mut ros_distro = String::new();
    for record in &contents.metadata {
        if let Some(text) = record.entries.get("serialized_metadata") {
            said = Metadata::read_record(text).ok().or(said);
        }
        if let Some(distro) = record.entries.get("ROS_DISTRO") {
            ros_distro.clone_from(distro);
        }
    }
    let (start, end) = contents
        .times
        .unwrap_or((metadata::NO_START, metadata::NO_START));
    let message_count = contents.messages();
    let topics = contents.channels.values().map(|channel| {
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
    });
    let file = File {
        path: path.to_owned(),
        starting_time: start,
        duration: end.saturating_sub(start),
        message_count,
    };
    Metadata {
        version: said.as_ref().map_or(5, |said| said.version),
        storage_identifier: "mcap".to_owned(),
        duration: file.duration,
        starting_time: start,
        message_count,
        topics: topics.collect(),
        compression_format: String::new(),
        compression_mode: String::new(),
        relative_file_paths: vec![path.to_owned()],
        files: vec![file],
        custom_data: said
            .as_ref()
            .map(|said| said.custom_data.clone())
            .unwrap_or_default(),
        ros_distro: match said {
            Some(said) if !said.ros_distro.is_empty() => said.ros_distro,
            _ => ros_distro,
        },
    }
}

/// Where values begin.
const LABEL: usize = 19;
const SERVICE_EVENT: &str = "/_service_event";
/// The topics of an action, and how the type of each is made of the action's.
const ACTION: [(&str, &str); 5] = [
    ("/_action/feedback", "_FeedbackMessage"),
    ("/_action/status", ""),
    ("/_action/send_goal/_service_event", "_SendGoal_Event"),
    ("/_action/cancel_goal/_service_event", ""),
    ("/_action/get_result/_service_event", "_GetResult_Event"),
];

/// Topics, services and actions apart, each sorted.
struct Parts<'a> {
    topics: Vec<&'a Topic>,
    services: Vec<&'a Topic>,
    actions: Vec<Action<'a>>,
    /// Messages that are not of topics.
    apart: u64,
}

struct Action<'a> {
    name: &'a str,
    type_name: String,
    format: &'a str,
    /// By the order of [`ACTION`].
    counts: [u64; ACTION.len()],
}

impl<'a> Parts<'a> {
    fn of(all: &'a [Topic], dialect: Dialect, sort: Sort) -> Self {
        let mut parts = Parts {
            topics: Vec::new(),
            services: Vec::new(),
            actions: Vec::new(),
            apart: 0,
        };
        for topic in all {
            let is_event = topic.name.ends_with(SERVICE_EVENT)
                && topic.type_name.contains("/srv/")
                && topic.type_name.ends_with("_Event");
            let of_action = || {
                ACTION
                    .iter()
                    .position(|(suffix, _)| topic.name.ends_with(suffix))
                    .filter(|_| {
                        topic.type_name.contains("/action/")
                            || topic.type_name.starts_with("action_msgs/")
                    })
            };
            if dialect > Dialect::Jazzy
                && let Some(part) = of_action()
            {
                parts.apart = parts.apart.saturating_add(topic.message_count);
                parts.action(topic, part);
            } else if dialect > Dialect::Humble && is_event {
                parts.apart = parts.apart.saturating_add(topic.message_count);
                parts.services.push(topic);
            } else {
                parts.topics.push(topic);
            }
        }
        if dialect > Dialect::Humble {
            let sorted = |topics: &mut Vec<&Topic>| match sort {
                Sort::Name => topics.sort_by(|a, b| a.name.cmp(&b.name)),
                Sort::Type => topics.sort_by(|a, b| a.type_name.cmp(&b.type_name)),
                Sort::Count => topics.sort_by_key(|topic| topic.message_count),
            };
            sorted(&mut parts.topics);
            sorted(&mut parts.services);
            match sort {
                Sort::Name => parts.actions.sort_by(|a, b| a.name.cmp(b.name)),
                Sort::Type => parts.actions.sort_by(|a, b| a.type_name.cmp(&b.type_name)),
                Sort::Count => parts
                    .actions
                    .sort_by_key(|action| action.counts.map(u128::from).iter().sum::<u128>()),
            }
        }
        parts
    }

    fn action(&mut self, topic: &'a Topic, part: usize) {
        let Some((suffix, type_suffix)) = ACTION.get(part) else {
            return;
        };
        let name = topic.name.strip_suffix(suffix).unwrap_or(&topic.name);
        let known = self.actions.iter().position(|action| action.name == name);
        let at = known.unwrap_or_else(|| {
            self.actions.push(Action {
                name,
                type_name: String::new(),
                format: &topic.serialization_format,
                counts: [0; ACTION.len()],
            });
            self.actions.len() - 1
        });
        if let Some(action) = self.actions.get_mut(at) {
            if let Some(count) = action.counts.get_mut(part) {
                *count = count.saturating_add(topic.message_count);
            }
            if !type_suffix.is_empty()
                && let Some(type_name) = topic.type_name.strip_suffix(type_suffix)
            {
                action.type_name = type_name.to_owned();
            }
        }
    }

    fn write_services(&self, text: &mut String, details: Option<&Details>) {
        for (index, topic) in self.services.iter().enumerate() {
            if index > 0 {
                let _ = write!(text, "{:width$}", "", width = LABEL + 2);
            }
            let service = topic
                .name
                .strip_suffix(SERVICE_EVENT)
                .unwrap_or(&topic.name);
            let type_name = topic
                .type_name
                .strip_suffix("_Event")
                .unwrap_or(&topic.type_name);
            let counts = match details {
                None => format!("Event Count: {} | ", topic.message_count),
                Some(details) => {
                    let (requests, responses) = details.calls(&topic.name);
                    format!(
                        "Request Count: {requests} | Response Count: {responses} | \
                        Size Contribution: {} | ",
                        size(details.size(&topic.name))
                    )
                }
            };
            let [service, type_name, format] =
                [service, type_name, &topic.serialization_format].map(visible);
            let _ = writeln!(
                text,
                "Service: {service} | Type: {type_name} | {counts}Serialization Format: {format}"
            );
        }
    }

    fn write_actions(&self, text: &mut String, details: Option<&Details>) {
        for action in &self.actions {
            let topics = ACTION.map(|(suffix, _)| format!("{}{suffix}", action.name));
            let contribution = details.map(|details| {
                let bytes = topics.iter().map(|topic| details.size(topic)).sum();
                format!("Size Contribution: {} | ", size(bytes))
            });
            let _ = write!(
                text,
                "\n  Action: {} | Type: {} | Topics: 2 | Service: 3 | {}Serialization Format: {}",
                visible(action.name),
                visible(&action.type_name),
                contribution.unwrap_or_default(),
                visible(action.format)
            );
            let [feedback, status, events @ ..] = action.counts;
            let _ = write!(text, "\n    Topic: feedback | Count: {feedback}");
            let _ = write!(text, "\n    Topic: status | Count: {status}");
            let [_, _, names @ ..] = &topics;
            let services = ["send_goal", "cancel_goal", "get_result"];
            for ((service, events), topic) in services.iter().zip(events).zip(names) {
                let counts = match details {
                    None => format!("Event Count: {events}"),
                    Some(details) => {
                        let (requests, responses) = details.calls(topic);
                        format!("Request Count: {requests} | Response Count: {responses}")
                    }
                };
                let _ = write!(text, "\n    Service: {service} | {counts}");
            }
        }
    }
}

impl Details {
    fn size(&self, topic: &str) -> u64 {
        self.sizes.get(topic).copied().unwrap_or(0)
    }

    fn calls(&self, topic: &str) -> (usize, usize) {
        let calls = self.calls.get(topic);
        calls.map_or((0, 0), |calls| {
            (calls.requests.len(), calls.responses.len())
        })
    }
}

/// A service event begins with `service_msgs/msg/ServiceEventInfo`: kind, time, client, number.
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

fn topic_line(topic: &Topic, details: Option<&Details>) -> String {
    let contribution = details
        .map(|details| format!("Size Contribution: {} | ", size(details.size(&topic.name))))
        .unwrap_or_default();
    format!(
        "Topic: {} | Type: {} | Count: {} | {contribution}Serialization Format: {}",
        visible(&topic.name),
        visible(&topic.type_name),
        topic.message_count,
        visible(&topic.serialization_format)
    )
}

/// One below the other, where values begin.
fn lines_of(lines: &[String]) -> String {
    lines.join(&format!("\n{:LABEL$}", ""))
}

/// Bytes in the unit that makes the number less than 1024.
#[expect(clippy::cast_precision_loss, reason = "one decimal is printed")]
fn size(bytes: u64) -> String {
    if bytes < 1024 {
        return format!("{bytes} B");
    }
    let mut size = bytes as f64 / 1024.0;
    let mut units = ["KiB", "MiB", "GiB"].into_iter();
    let mut unit = units.next().unwrap_or_default();
    while size >= 1024.0 {
        size /= 1024.0;
        match units.next() {
            Some(next) => unit = next,
            None => return format!("{size:.1} TiB"),
        }
    }
    format!("{size:.1} {unit}")
}

fn seconds(nanoseconds: u64) -> String {
    format!(
        "{}.{:09}",
        nanoseconds / 1_000_000_000,
        nanoseconds % 1_000_000_000
    )
}

fn moment(time: u64, zone: &TimeZone) -> String {
    let whole = i64::try_from(time / 1_000_000_000).unwrap_or(i64::MAX);
    let local = jiff::Timestamp::new(whole, 0).map(|time| time.to_zoned(zone.clone()));
    let local = local.map(|time| time.strftime("%b %e %Y %H:%M:%S").to_string());
    let fraction = time % 1_000_000_000;
    format!(
        "{}.{fraction:09} ({})",
        local.unwrap_or_default(),
        seconds(time)
    )
}
