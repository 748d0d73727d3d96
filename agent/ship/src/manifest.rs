//! The manifest of a delivered bag: `manifest.json` beside its files, written last.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::bags::Bag;
use crate::state::Delivery;

/// Name of the manifest at the destination.
pub(crate) const FILE_NAME: &str = "manifest.json";

/// The manifest of a delivered bag.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of this form: 1.
    pub version: u32,
    /// Name of the robot.
    pub robot: String,
    /// Name of the bag on the robot.
    pub bag: String,
    /// Whether the recording ended cleanly. If not, `rp bag reindex` completes the files.
    pub is_complete: bool,
    /// Event, request or signal that triggered a snapshot, as in the custom data of the bag.
    pub trigger: Option<Value>,
    /// Warnings and errors of the agent in the time of the bag; `None` if it could not be queried.
    pub findings: Option<Vec<Value>>,
    /// Time of the earliest message, RFC 3339; `None` without messages.
    pub start: Option<String>,
    /// Time of the latest message, RFC 3339; `None` without messages.
    pub end: Option<String>,
    /// Number of messages according to metadata.yaml.
    pub messages: u64,
    /// Topics according to metadata.yaml.
    pub topics: Vec<ManifestTopic>,
    /// All files of the bag.
    pub files: Vec<ManifestFile>,
    /// Version of the program that delivered it.
    pub program: String,
}

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ManifestTopic {
    /// Name of the topic.
    pub name: String,
    /// Type of its messages.
    pub message_type: String,
    /// Number of its messages.
    pub messages: u64,
}

/// A file of a bag.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ManifestFile {
    /// Name of the file, beside the manifest.
    pub name: String,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal digits.
    pub sha256: String,
}

impl Manifest {
    /// Creates the manifest of a bag.
    pub(crate) fn new(
        robot: &str,
        bag: &Bag,
        delivery: &Delivery,
        findings: Option<Vec<Value>>,
    ) -> Self {
        let content = &bag.content;
        Self {
            version: 1,
            robot: robot.to_owned(),
            bag: bag.name.clone(),
            is_complete: content.is_complete,
            trigger: content.trigger.clone(),
            findings,
            start: content.times.and_then(|(start, _)| time(start)),
            end: content.times.and_then(|(_, end)| time(end)),
            messages: content.messages,
            topics: content
                .topics
                .iter()
                .map(|(name, message_type, messages)| ManifestTopic {
                    name: name.clone(),
                    message_type: message_type.clone(),
                    messages: *messages,
                })
                .collect(),
            files: files(delivery),
            program: concat!("ros2probe ", env!("CARGO_PKG_VERSION")).to_owned(),
        }
    }
}

/// Returns the files of a bag, as the manifest lists them.
pub(crate) fn files(delivery: &Delivery) -> Vec<ManifestFile> {
    let files = delivery.files.iter().map(|file| ManifestFile {
        name: file.name.clone(),
        bytes: file.bytes,
        sha256: file.sha256.clone().unwrap_or_default(),
    });
    files.collect()
}

/// Returns a time in RFC 3339; `None` if it is out of range.
fn time(nanoseconds: u64) -> Option<String> {
    let time = Timestamp::from_nanosecond(nanoseconds.into()).ok()?;
    Some(time.to_string())
}
