//! `/recordings`: bags that the agent writes.

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::recording_report::Report;

/// All recordings.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingList {
    /// Where they lie; null where the agent has no place for them.
    pub directory: Option<String>,
    /// Those under way, and the last ones that ended.
    pub recordings: Vec<Recording>,
    /// What they may take of the disk.
    pub limits: RecordingLimits,
}

/// What recordings may take of the disk; one ends in order where it meets a limit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingLimits {
    /// Bytes of each; null = any.
    pub max_bytes: Option<u64>,
    /// Bytes of all bags in the directory; null = any.
    pub max_total_bytes: Option<u64>,
    /// Of the file system stays free: the larger one of these percent and those bytes.
    pub reserve_percent: u8,
    /// Likewise.
    pub reserve_bytes: u64,
}

/// One recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Recording {
    /// Its name, that of its directory.
    pub name: String,
    /// Where it lies on the robot.
    pub directory: String,
    /// Whose topics.
    pub domain_id: u32,
    /// `recording`, `paused` or `ended`.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub state: Open<RecordingState>,
    /// Unix time of its beginning.
    pub began_timestamp_seconds: f64,
    /// Bytes of its files.
    pub file_bytes: u64,
    /// Files begun.
    pub files: usize,
    /// Why it ended, if that was not asked for.
    pub error: Option<String>,
    /// What was asked for.
    pub topics: FilterOptions,
    /// What it has and has not.
    pub report: Report,
}

/// What is to be recorded. Without any topic, every topic is.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RecordingRequest {
    /// Name of the directory; the time when left out.
    #[cfg_attr(
        feature = "openapi",
        schema(max_length = 128, pattern = "^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")
    )]
    pub name: Option<String>,
    /// Which topics.
    pub topics: FilterOptions,
    /// Of which domain.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: u32,
    /// Split when a file reaches so many bytes; 0 = never.
    pub max_bag_size: u64,
    /// Split when a file reaches so many seconds; 0 = never.
    #[cfg_attr(feature = "openapi", schema(maximum = 31_536_000))]
    pub max_bag_duration_seconds: u64,
    /// `none`, `fastwrite`, `zstd_fast` or `zstd_small`.
    #[cfg_attr(feature = "openapi", schema(value_type = String, example = "zstd_fast"))]
    pub storage_preset_profile: String,
    /// `zstd` or `lz4`: compress whole files once they are complete.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub file_compression: String,
    /// For whom metadata.yaml is written: a distribution; for all of them when left out.
    #[cfg_attr(feature = "openapi", schema(value_type = String))]
    pub distro: String,
    /// Begin paused.
    pub paused: bool,
}

/// What a recording is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordingState {
    /// Taking what comes.
    #[default]
    Recording,
    /// Letting it go by.
    Paused,
    /// The bag is complete.
    Ended,
}

/// What was asked for; empty asks for nothing.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordedTopics))]
#[serde(deny_unknown_fields, default)]
pub struct FilterOptions {
    /// These topics, by ROS name.
    pub topics: Vec<String>,
    /// Every topic.
    pub all_topics: bool,
    /// Topics of these types, `pkg/msg/Type`.
    pub topic_types: Vec<String>,
    /// These services, by name: their event topics.
    pub services: Vec<String>,
    /// Every service's event topic.
    pub all_services: bool,
    /// Topics and services whose name contains this regular expression.
    pub regex: Option<String>,
    /// None whose name contains this regular expression.
    pub exclude_regex: Option<String>,
    /// Not these topics.
    pub exclude_topics: Vec<String>,
    /// No topics of these types.
    pub exclude_topic_types: Vec<String>,
    /// Not these services.
    pub exclude_services: Vec<String>,
    /// Also topics with a token that begins with `_`.
    pub include_hidden_topics: bool,
    /// Also topics that nobody publishes: declared in the bag, without a message.
    pub include_unpublished_topics: bool,
    /// Not topics that nobody subscribes to.
    pub ignore_leaf_topics: bool,
}

/// Files of a recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RecordingFiles {
    /// By name.
    pub files: Vec<RecordingFile>,
}

/// A file.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RecordingFile {
    /// Its name.
    #[cfg_attr(feature = "openapi", schema(example = "metadata.yaml"))]
    pub file: String,
    /// Its bytes so far.
    pub bytes: u64,
}

impl FilterOptions {
    /// Every topic, as `-a` of Humble.
    #[must_use]
    pub fn everything() -> Self {
        Self {
            all_topics: true,
            ..Self::default()
        }
    }
}
