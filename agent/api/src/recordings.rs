//! `/recordings`: bags that the agent writes.

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::recording_report::Report;

/// All recordings.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingList {
    /// Directory of the recordings; null if none is configured or writable.
    pub directory: Option<String>,
    /// Running recordings, and the most recently ended recordings.
    pub recordings: Vec<Recording>,
    /// Bags in the directory that this run of the agent did not begin: those of earlier runs, and
    /// snapshots. The latest 200, the last one first. Empty if the storage does not answer within 2 s.
    pub kept: Vec<KeptBag>,
    /// Limits of the disk space that recordings use.
    pub limits: RecordingLimits,
}

/// A bag in the directory of recordings. `GET /recordings/{name}/files` lists its files.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct KeptBag {
    /// Name of its directory.
    pub name: String,
    /// Path of the bag on the robot.
    pub directory: String,
    /// Unix time of the last change of its directory.
    pub modified_timestamp_seconds: f64,
    /// Total size of its files of messages, in bytes.
    pub file_bytes: u64,
    /// Number of files of messages.
    pub files: usize,
    /// Whether it has metadata. `rp bag reindex` writes those of a bag that was cut off.
    pub is_complete: bool,
    /// Event that triggered the snapshot; null for other bags.
    pub trigger: Option<BagTrigger>,
}

/// An event that triggered a snapshot.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct BagTrigger {
    /// Name of the trigger in the configuration.
    pub trigger: String,
    /// Name of the event.
    pub event: String,
    /// Time of the event, RFC 3339.
    #[cfg_attr(feature = "openapi", schema(format = DateTime))]
    pub time: String,
    /// ROS name of the topic of the event; null if it has none.
    pub topic: Option<String>,
    /// Domain id of the topic.
    pub domain_id: Option<u16>,
}

/// Limits of the disk space that recordings use. A recording that reaches a limit ends with a
/// complete bag.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingLimits {
    /// Maximum size of one recording, in bytes; null is unlimited.
    pub max_bytes: Option<u64>,
    /// Maximum size of all bags in the directory, in bytes; null is unlimited.
    pub max_total_bytes: Option<u64>,
    /// Share of the file system that stays free, in percent. The larger of this share and
    /// `reserve_bytes` applies.
    pub reserve_percent: u8,
    /// Bytes of the file system that stay free.
    pub reserve_bytes: u64,
}

/// A recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Recording {
    /// Name of the recording and of its directory.
    pub name: String,
    /// Path of the bag on the robot.
    pub directory: String,
    /// Domain id of the recorded topics.
    pub domain_id: u32,
    /// `recording`, `paused` or `ended`.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub state: Open<RecordingState>,
    /// Unix time at which the recording began.
    pub began_timestamp_seconds: f64,
    /// Total size of the bag's files, in bytes.
    pub file_bytes: u64,
    /// Number of files, including the file that is being written.
    pub files: usize,
    /// Why the recording ended; null if it still runs or a client ended it.
    pub error: Option<String>,
    /// The filter that selects topics.
    pub topics: FilterOptions,
    /// Counts of messages in the recording and of missing messages.
    pub report: Report,
}

/// A recording to start. Without a topic filter it records every topic.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RecordingRequest {
    /// Name of the bag's directory; by default the current time.
    #[cfg_attr(
        feature = "openapi",
        schema(max_length = 128, pattern = "^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")
    )]
    pub name: Option<String>,
    /// The filter that selects topics.
    pub topics: FilterOptions,
    /// Domain id of the topics.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: u32,
    /// Size in bytes at which a new file begins; 0 disables splitting.
    pub max_bag_size: u64,
    /// Duration in seconds after which a new file begins; 0 disables splitting.
    #[cfg_attr(feature = "openapi", schema(maximum = 31_536_000))]
    pub max_bag_duration_seconds: u64,
    /// Preset of the MCAP storage: `none`, `fastwrite`, `zstd_fast` or `zstd_small`.
    #[cfg_attr(feature = "openapi", schema(value_type = String, example = "zstd_fast"))]
    pub storage_preset_profile: String,
    /// Compression of complete files: `zstd` or `lz4`; empty disables it.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub file_compression: String,
    /// ROS distribution whose format of metadata.yaml is written; by default a format that all
    /// distributions read.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub distro: String,
    /// Whether the recording starts paused.
    pub paused: bool,
}

/// State of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordingState {
    /// Messages are written to the bag.
    #[default]
    Recording,
    /// Messages are discarded until the recording resumes.
    Paused,
    /// The recording has ended and the bag is complete.
    Ended,
}

/// Filter of topics and services. An empty filter selects nothing.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordedTopics))]
#[serde(deny_unknown_fields, default)]
pub struct FilterOptions {
    /// Topics to record, by ROS name.
    pub topics: Vec<String>,
    /// Whether to record every topic.
    pub all_topics: bool,
    /// Types whose topics are recorded, as `pkg/msg/Type`.
    pub topic_types: Vec<String>,
    /// Services whose event topics are recorded, by name.
    pub services: Vec<String>,
    /// Whether to record the event topics of every service.
    pub all_services: bool,
    /// Topics and services are recorded if this regular expression matches a part of their name.
    pub regex: Option<String>,
    /// Topics and services are excluded if this regular expression matches a part of their name.
    pub exclude_regex: Option<String>,
    /// Topics to exclude, by ROS name.
    pub exclude_topics: Vec<String>,
    /// Types whose topics are excluded.
    pub exclude_topic_types: Vec<String>,
    /// Services to exclude, by name.
    pub exclude_services: Vec<String>,
    /// Whether to record hidden topics, which have a name token that begins with `_`.
    pub include_hidden_topics: bool,
    /// Whether to declare topics without a publisher in the bag; they contain no message.
    pub include_unpublished_topics: bool,
    /// Whether to exclude topics without a subscriber.
    pub ignore_leaf_topics: bool,
}

/// The files of a recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingFiles {
    /// Files, sorted by name.
    pub files: Vec<RecordingFile>,
}

/// A file of a recording.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RecordingFile {
    /// Name of the file.
    #[cfg_attr(feature = "openapi", schema(example = "metadata.yaml"))]
    pub file: String,
    /// Current size in bytes.
    pub bytes: u64,
}

impl FilterOptions {
    /// Returns the filter of `ros2 bag record -a` in Humble, which selects every topic.
    #[must_use]
    pub fn everything() -> Self {
        Self {
            all_topics: true,
            ..Self::default()
        }
    }
}
