//! metadata.yaml: a bag directory's description of its files.
//!
//! The text is byte for byte that of rosbag2 (yaml-cpp's layout, no newline at the end). Every
//! version can be read. This module does not know MCAP, whose metadata records hold the same text.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use saphyr_parser::{Event, Parser};
use serde::Deserialize;

/// Name of the file in every bag directory.
pub const FILE_NAME: &str = "metadata.yaml";
/// Maximum size of the file, in bytes: more than a bag with thousands of files and topics needs.
pub const MAX_BYTES: u64 = 64 << 20;
/// Maximum depth of nesting; a real file has 8 levels.
const MAX_DEPTH: usize = 32;
/// Maximum number of YAML events: a topic has some 40, a file 15.
const MAX_EVENTS: usize = 1_000_000;
/// `starting_time` of a bag without messages.
pub const NO_START: u64 = i64::MAX.cast_unsigned();

/// Why a text is not a metadata.yaml.
#[derive(Debug, thiserror::Error)]
pub enum MetadataError {
    /// The YAML has another structure.
    #[error(transparent)]
    Yaml(#[from] serde_yaml::Error),
    /// The text is not YAML.
    #[error(transparent)]
    Scan(#[from] saphyr_parser::ScanError),
    /// The text is too long.
    #[error("it is larger than {MAX_BYTES} bytes")]
    TooLarge,
    /// The text is nested too deeply.
    #[error("it is nested more than {MAX_DEPTH} levels deep")]
    TooDeep,
    /// The text has too many keys and values.
    #[error("it has more than {MAX_EVENTS} keys and values")]
    TooMany,
}

/// Content of metadata.yaml.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Metadata {
    /// Version: 5 in Humble, 9 in Jazzy and later.
    pub version: u32,
    /// Storage: `mcap` or `sqlite3`.
    pub storage_identifier: String,
    /// Time from the first to the last message, in nanoseconds.
    pub duration: u64,
    /// Time of the first message; [`NO_START`] without messages.
    pub starting_time: u64,
    /// Number of messages of all topics.
    pub message_count: u64,
    /// Topics, including those without messages.
    pub topics: Vec<Topic>,
    /// Compression format: empty or `zstd`.
    pub compression_format: String,
    /// Compression mode: empty, `FILE` or `MESSAGE`.
    pub compression_mode: String,
    /// Paths of the files within the directory.
    pub relative_file_paths: Vec<String>,
    /// One entry per file.
    pub files: Vec<File>,
    /// Additional entries of the recorder.
    pub custom_data: BTreeMap<String, String>,
    /// Distribution of ROS; empty if unknown.
    pub ros_distro: String,
}

/// One topic.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Topic {
    /// Name, with leading `/`.
    pub name: String,
    /// Type: `pkg/msg/Type`.
    pub type_name: String,
    /// Serialization: `cdr`.
    pub serialization_format: String,
    /// QoS of the publishers, as `super::qos::profiles` formats it. Version 9 stores a YAML list,
    /// which is read as the same text; without publishers the text is empty.
    pub offered_qos_profiles: String,
    /// Type hash: `RIHS01_...` or empty.
    pub type_description_hash: String,
    /// Number of messages of this topic.
    pub message_count: u64,
}

/// One file.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct File {
    /// Path within the directory; without the suffix of a compressed file, as rosbag2 writes it.
    pub path: String,
    /// Time of its first message.
    pub starting_time: u64,
    /// Time from its first to its last message.
    pub duration: u64,
    /// Number of its messages.
    pub message_count: u64,
}

impl Metadata {
    /// Returns the file's text.
    #[must_use]
    pub fn file_text(&self) -> String {
        let mut text = "rosbag2_bagfile_information:".to_owned();
        self.lines(|line| {
            let _ = write!(text, "\n  {line}");
        });
        text
    }

    /// Returns the same map without its outer key, as in an MCAP metadata record.
    #[must_use]
    pub fn record_text(&self) -> String {
        let mut text = String::new();
        self.lines(|line| {
            if !text.is_empty() {
                text.push('\n');
            }
            text.push_str(line);
        });
        text
    }

    fn lines(&self, mut line: impl FnMut(&str)) {
        line(&format!("version: {}", self.version));
        line(&format!(
            "storage_identifier: {}",
            scalar(&self.storage_identifier)
        ));
        line("duration:");
        line(&format!("  nanoseconds: {}", self.duration));
        line("starting_time:");
        line(&format!(
            "  nanoseconds_since_epoch: {}",
            self.starting_time
        ));
        line(&format!("message_count: {}", self.message_count));
        sequence("topics_with_message_count", &self.topics, &mut line);
        for topic in &self.topics {
            self.topic(topic, &mut line);
        }
        line(&format!(
            "compression_format: {}",
            scalar(&self.compression_format)
        ));
        line(&format!(
            "compression_mode: {}",
            scalar(&self.compression_mode)
        ));
        sequence("relative_file_paths", &self.relative_file_paths, &mut line);
        for path in &self.relative_file_paths {
            line(&format!("  - {}", scalar(path)));
        }
        sequence("files", &self.files, &mut line);
        for file in &self.files {
            line(&format!("  - path: {}", scalar(&file.path)));
            line("    starting_time:");
            line(&format!(
                "      nanoseconds_since_epoch: {}",
                file.starting_time
            ));
            line("    duration:");
            line(&format!("      nanoseconds: {}", file.duration));
            line(&format!("    message_count: {}", file.message_count));
        }
        if self.custom_data.is_empty() {
            if self.version >= 6 {
                line("custom_data: ~");
            }
        } else {
            line("custom_data:");
            for (key, value) in &self.custom_data {
                line(&format!("  {}: {}", scalar(key), scalar(value)));
            }
        }
        if self.version >= 8 || !self.ros_distro.is_empty() {
            line(&format!("ros_distro: {}", scalar(&self.ros_distro)));
        }
    }

    fn topic(&self, topic: &Topic, line: &mut impl FnMut(&str)) {
        line("  - topic_metadata:");
        line(&format!("      name: {}", scalar(&topic.name)));
        line(&format!("      type: {}", scalar(&topic.type_name)));
        line(&format!(
            "      serialization_format: {}",
            scalar(&topic.serialization_format)
        ));
        let profiles = &topic.offered_qos_profiles;
        if self.version < 9 {
            line(&format!("      offered_qos_profiles: {}", scalar(profiles)));
        } else if profiles.starts_with("- ") {
            line("      offered_qos_profiles:");
            for profile in profiles.lines() {
                line(&format!("        {profile}"));
            }
        } else {
            line("      offered_qos_profiles: []");
        }
        if self.version >= 7 || !topic.type_description_hash.is_empty() {
            let hash = scalar(&topic.type_description_hash);
            line(&format!("      type_description_hash: {hash}"));
        }
        line(&format!("    message_count: {}", topic.message_count));
    }

    /// Parses the file's text.
    pub fn read(text: &str) -> Result<Self, MetadataError> {
        check(text)?;
        let file: shape::File = serde_yaml::from_str(text)?;
        Ok(file.rosbag2_bagfile_information.into())
    }

    /// Parses the text of a metadata record.
    pub fn read_record(text: &str) -> Result<Self, MetadataError> {
        check(text)?;
        let information: shape::Information = serde_yaml::from_str(text)?;
        Ok(information.into())
    }
}

/// Checks the bounds of a text event by event, before it is parsed as a whole. The parser's time
/// grows with the square of the depth, and its memory with the number of events.
fn check(text: &str) -> Result<(), MetadataError> {
    if text.len() as u64 > MAX_BYTES {
        return Err(MetadataError::TooLarge);
    }
    let mut depth = 0_usize;
    for (number, event) in Parser::new_from_str(text).enumerate() {
        if number >= MAX_EVENTS {
            return Err(MetadataError::TooMany);
        }
        match event?.0 {
            Event::SequenceStart(..) | Event::MappingStart(..) => depth += 1,
            Event::SequenceEnd | Event::MappingEnd => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err(MetadataError::TooDeep);
        }
    }
    Ok(())
}

/// Writes the name of a sequence, and `[]` for an empty one, because the player of Jazzy rejects null.
fn sequence<T>(name: &str, items: &[T], line: &mut impl FnMut(&str)) {
    line(&format!("{name}:"));
    if items.is_empty() {
        line("  []");
    }
}

/// Formats a YAML scalar: plain if it is unambiguous, else in double quotes.
fn scalar(text: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"/_-.".contains(&byte);
    let begins = |byte: u8| byte.is_ascii_alphabetic() || b"/_".contains(&byte);
    let word = matches!(
        text.to_ascii_lowercase().as_str(),
        "true" | "false" | "null" | "yes" | "no" | "on" | "off" | "y" | "n"
    );
    if !word && text.bytes().next().is_some_and(begins) && text.bytes().all(plain) {
        return text.to_owned();
    }
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for character in text.chars() {
        match character {
            '"' => quoted.push_str("\\\""),
            '\\' => quoted.push_str("\\\\"),
            '\n' => quoted.push_str("\\n"),
            '\t' => quoted.push_str("\\t"),
            '\r' => quoted.push_str("\\r"),
            // Control characters, line ends of YAML, and characters that YAML does not print.
            '\0'..='\u{1f}'
            | '\u{7f}'..='\u{a0}'
            | '\u{2028}'
            | '\u{2029}'
            | '\u{feff}'
            | '\u{fffe}'
            | '\u{ffff}' => {
                let _ = write!(quoted, "\\u{:04x}", u32::from(character));
            }
            other => quoted.push(other),
        }
    }
    quoted.push('"');
    quoted
}

/// The structure of the file, key by key.
mod shape {
    use serde_yaml::Value;

    use super::{BTreeMap, Deserialize};

    #[derive(Deserialize)]
    pub(super) struct File {
        pub(super) rosbag2_bagfile_information: Information,
    }

    #[derive(Deserialize)]
    pub(super) struct Information {
        version: u32,
        storage_identifier: String,
        duration: Nanoseconds,
        starting_time: SinceEpoch,
        message_count: u64,
        topics_with_message_count: Option<Vec<Topic>>,
        #[serde(default)]
        compression_format: Option<String>,
        #[serde(default)]
        compression_mode: Option<String>,
        relative_file_paths: Option<Vec<String>>,
        #[serde(default)]
        files: Option<Vec<Piece>>,
        #[serde(default)]
        custom_data: Option<BTreeMap<String, String>>,
        #[serde(default)]
        ros_distro: Option<String>,
    }

    #[derive(Deserialize)]
    struct Nanoseconds {
        nanoseconds: i64,
    }

    #[derive(Deserialize)]
    struct SinceEpoch {
        nanoseconds_since_epoch: u64,
    }

    #[derive(Deserialize)]
    struct Topic {
        topic_metadata: TopicMetadata,
        message_count: u64,
    }

    #[derive(Deserialize)]
    struct TopicMetadata {
        name: String,
        #[serde(rename = "type")]
        type_name: String,
        serialization_format: String,
        #[serde(default)]
        offered_qos_profiles: Option<Value>,
        #[serde(default)]
        type_description_hash: Option<String>,
    }

    #[derive(Deserialize)]
    struct Piece {
        path: String,
        starting_time: SinceEpoch,
        duration: Nanoseconds,
        message_count: u64,
    }

    impl From<Information> for super::Metadata {
        fn from(from: Information) -> Self {
            Self {
                version: from.version,
                storage_identifier: from.storage_identifier,
                duration: u64::try_from(from.duration.nanoseconds).unwrap_or(0),
                starting_time: from.starting_time.nanoseconds_since_epoch,
                message_count: from.message_count,
                topics: from
                    .topics_with_message_count
                    .into_iter()
                    .flatten()
                    .map(topic)
                    .collect(),
                compression_format: from.compression_format.unwrap_or_default(),
                compression_mode: from.compression_mode.unwrap_or_default(),
                relative_file_paths: from.relative_file_paths.unwrap_or_default(),
                files: from.files.into_iter().flatten().map(piece).collect(),
                custom_data: from.custom_data.unwrap_or_default(),
                ros_distro: from.ros_distro.unwrap_or_default(),
            }
        }
    }

    fn topic(from: Topic) -> super::Topic {
        let metadata = from.topic_metadata;
        super::Topic {
            name: metadata.name,
            type_name: metadata.type_name,
            serialization_format: metadata.serialization_format,
            offered_qos_profiles: metadata
                .offered_qos_profiles
                .map(profiles)
                .unwrap_or_default(),
            type_description_hash: metadata.type_description_hash.unwrap_or_default(),
            message_count: from.message_count,
        }
    }

    /// Returns the text of the profiles: before version 9 a string, since then a list.
    fn profiles(from: Value) -> String {
        match from {
            Value::String(text) => text,
            Value::Sequence(list) if !list.is_empty() => {
                let text = serde_yaml::to_string(&list).unwrap_or_default();
                text.trim_end().to_owned()
            }
            _ => String::new(),
        }
    }

    fn piece(from: Piece) -> super::File {
        super::File {
            path: from.path,
            starting_time: from.starting_time.nanoseconds_since_epoch,
            duration: u64::try_from(from.duration.nanoseconds).unwrap_or(0),
            message_count: from.message_count,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn metadata(version: u32) -> Metadata {
        Metadata {
            version,
            storage_identifier: "mcap".into(),
            duration: 4_500_000_000,
            starting_time: 1_699_345_836_270_074_454,
            message_count: 10,
            topics: vec![Topic {
                name: "/chatter".into(),
                type_name: "std_msgs/msg/String".into(),
                serialization_format: "cdr".into(),
                offered_qos_profiles: "- history: unknown\n  depth: 0\n  deadline:\n    sec: 1"
                    .into(),
                type_description_hash: "RIHS01_df66".into(),
                message_count: 10,
            }],
            compression_format: String::new(),
            compression_mode: String::new(),
            relative_file_paths: vec!["mybag_0.mcap".into()],
            files: vec![File {
                path: "mybag_0.mcap".into(),
                starting_time: 1_699_345_836_270_074_454,
                duration: 4_500_000_000,
                message_count: 10,
            }],
            custom_data: BTreeMap::new(),
            ros_distro: "jazzy".into(),
        }
    }

    #[test]
    fn version_9_has_the_layout_of_the_serializer_of_jazzy() {
        let text = "rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: 4500000000
  starting_time:
    nanoseconds_since_epoch: 1699345836270074454
  message_count: 10
  topics_with_message_count:
    - topic_metadata:
        name: /chatter
        type: std_msgs/msg/String
        serialization_format: cdr
        offered_qos_profiles:
          - history: unknown
            depth: 0
            deadline:
              sec: 1
        type_description_hash: RIHS01_df66
      message_count: 10
  compression_format: \"\"
  compression_mode: \"\"
  relative_file_paths:
    - mybag_0.mcap
  files:
    - path: mybag_0.mcap
      starting_time:
        nanoseconds_since_epoch: 1699345836270074454
      duration:
        nanoseconds: 4500000000
      message_count: 10
  custom_data: ~
  ros_distro: jazzy";
        assert_eq!(metadata(9).file_text(), text);
        assert_eq!(Metadata::read(text).unwrap(), metadata(9));
        let without = text.replace(
            "
          - history: unknown
            depth: 0
            deadline:
              sec: 1",
            " []",
        );
        let mut expected = metadata(9);
        expected.topics[0].offered_qos_profiles.clear();
        assert_eq!(expected.file_text(), without);
        assert_eq!(Metadata::read(&without).unwrap(), expected);
    }

    #[test]
    fn the_record_of_an_empty_bag_has_the_layout_of_the_serializer_of_jazzy() {
        let empty = Metadata {
            relative_file_paths: Vec::new(),
            starting_time: NO_START,
            duration: 0,
            message_count: 0,
            topics: Vec::new(),
            files: Vec::new(),
            ..metadata(9)
        };
        assert_eq!(
            empty.record_text(),
            "version: 9
storage_identifier: mcap
duration:
  nanoseconds: 0
starting_time:
  nanoseconds_since_epoch: 9223372036854775807
message_count: 0
topics_with_message_count:
  []
compression_format: \"\"
compression_mode: \"\"
relative_file_paths:
  []
files:
  []
custom_data: ~
ros_distro: jazzy"
        );
    }

    #[test]
    fn version_5_stores_qos_as_a_string_and_is_read_back_unchanged() {
        let mut written = metadata(5);
        written
            .custom_data
            .insert("ros2probe.dropped: /a".into(), "3\nof \"7\"".into());
        let text = written.file_text();
        let qos = "        offered_qos_profiles: \"- history: unknown\\n  depth: 0\\n  deadline:\\n    sec: 1\"\n";
        assert!(text.contains(qos), "{text}");
        assert_eq!(Metadata::read(&text).unwrap(), written);
        assert_eq!(
            Metadata::read_record(&written.record_text()).unwrap(),
            written
        );
    }

    #[test]
    fn a_text_that_is_too_deep_or_too_large_is_refused_before_it_is_parsed() {
        let deep = [
            "[".repeat(100_000),
            "{a: ".repeat(100_000),
            "- ".repeat(100_000),
            format!("rosbag2_bagfile_information: {}", "[".repeat(100_000)),
        ];
        for text in deep {
            let error = Metadata::read(&text).unwrap_err();
            let too_deep = matches!(error, MetadataError::TooDeep | MetadataError::Scan(_));
            assert!(too_deep, "{error}");
            assert!(Metadata::read_record(&text).is_err());
        }
        let error = Metadata::read(&format!("[{}", "1,".repeat(MAX_EVENTS))).unwrap_err();
        assert!(matches!(error, MetadataError::TooMany), "{error}");
        let mut written = metadata(5);
        written.files = vec![written.files[0].clone(); 10_000];
        assert_eq!(Metadata::read(&written.file_text()).unwrap(), written);
    }

    #[test]
    fn metadata_without_topics_is_valid_yaml() {
        let mut written = metadata(5);
        written.topics.clear();
        assert_eq!(Metadata::read(&written.file_text()).unwrap(), written);
        assert_eq!(
            Metadata::read_record(&written.record_text()).unwrap(),
            written
        );
    }

    proptest! {
        #[test]
        fn any_name_is_read_back_as_it_was_written(name in any::<String>(), value in ".*") {
            let mut written = metadata(5);
            written.topics[0].name = name.clone();
            written.topics[0].type_name = value.clone();
            written.relative_file_paths[0] = name.clone();
            written.custom_data.insert(name, value);
            let text = written.file_text();
            prop_assert_eq!(Metadata::read(&text).unwrap(), written);
        }
    }
}
