//! Completeness of a recording: part of `/recordings`, and of each bag's metadata.
//!
//! `missing` counts messages of topics in the bag. Messages of unknown topics, and messages that
//! the agent cannot capture because they never pass its capture points, have fields of their own.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::latched::Latched;

/// The reason in [`Report::unobserved`] for a topic without a subscriber; such a topic is complete.
pub const NO_SUBSCRIBER: &str = "no_subscriber";

/// Counts of messages in a recording and of missing messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingReport))]
pub struct Report {
    /// Messages in the bag.
    pub messages: u64,
    /// Bytes of the messages in the bag.
    pub bytes: u64,
    /// Messages that were sent but are not in the bag.
    pub missing: u64,
    /// Messages of topics beyond the recording's limits on topics and their names; part of
    /// `missing`.
    #[serde(default)]
    pub no_room: u64,
    /// Counts of each topic, by name.
    pub topics: BTreeMap<String, TopicReport>,
    /// The first missing messages, by writer and sequence number.
    pub missing_runs: Vec<MissingRun>,
    /// Number of runs of missing messages that `missing_runs` does not list.
    pub missing_runs_unnamed: u64,
    /// Topics that keep samples for late joiners (transient local) and whose samples from before
    /// the recording are not in the bag.
    pub sent_before: Vec<String>,
    /// State of a publisher's last message, which the agent may keep, for topics in `sent_before`.
    #[serde(default)]
    pub latched: BTreeMap<String, Latched>,
    /// Topics that are not recorded because they have several types; a bag stores one type per
    /// topic.
    pub left_out: Vec<String>,
    /// Published topics without a message in the bag, with the reason if it is known.
    /// `no_subscriber`: the publisher sends nothing. `shared_memory`, `data_sharing`,
    /// `same_process`, `iceoryx`: all messages use that transport.
    #[serde(default)]
    pub unobserved: BTreeMap<String, String>,
    /// Active writers whose announcement was missed.
    #[serde(default)]
    pub unknown_writers: UnknownWriters,
    /// Published topics in other domains that the filter would select.
    #[serde(default)]
    pub other_domains: Vec<OtherDomain>,
    /// The limit that ended the recording; null if none did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_reached: Option<String>,
}

/// Writers whose topics are unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingUnknownWriters))]
pub struct UnknownWriters {
    /// Number of writers that sent messages.
    pub writers: u64,
    /// Messages that they sent during the recording.
    pub messages: u64,
}

/// Traffic in a domain that is not recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingOtherDomain))]
pub struct OtherDomain {
    /// Domain id.
    pub domain_id: u32,
    /// Number of published topics.
    pub topics: u64,
    /// Messages on the topics during the recording; null if no topic is measured.
    pub messages: Option<u64>,
}

/// Counts of a topic's messages in a recording and of missing messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TopicReport {
    /// Messages in the bag.
    pub messages: u64,
    /// Bytes of the messages in the bag.
    pub bytes: u64,
    /// Messages that never arrived whole: fragments were lost.
    pub incomplete: u64,
    /// Messages of which no part arrived.
    #[serde(default)]
    pub lost: u64,
    /// Messages that arrived before their writer's announcement and were not sent again.
    #[serde(default)]
    pub unannounced: u64,
    /// Messages that were on the network but that the agent could not capture.
    pub not_captured: u64,
    /// Messages dropped because the storage was too slow.
    pub dropped: u64,
    /// Messages accepted for writing but lost because the storage failed.
    pub unwritten: u64,
    /// Messages that arrived while the recording was paused.
    pub paused: u64,
}

/// Consecutive messages of one writer that are missing for the same reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MissingRun {
    /// Name of the topic.
    pub topic: String,
    /// GUID of the writer.
    pub writer: String,
    /// Sequence number of the first missing message.
    pub first_sequence_number: u64,
    /// Sequence number of the last missing message.
    pub last_sequence_number: u64,
    /// Number of missing messages in this range.
    pub samples: u64,
    /// `incomplete`, `lost`, `unannounced`, `not_captured` or `dropped`.
    pub reason: String,
}

impl Report {
    /// Returns the counts of a topic, adding it if it is new.
    pub fn topic(&mut self, name: &str) -> &mut TopicReport {
        if !self.topics.contains_key(name) {
            self.topics.insert(name.to_owned(), TopicReport::default());
        }
        self.topics.entry(name.to_owned()).or_default()
    }

    /// Returns whether every message that is known to have been sent is in the bag. Topics without
    /// a subscriber are complete: their publishers send nothing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.missing == 0
            && self.left_out.is_empty()
            && self.unknown_writers.writers == 0
            && self.other_domains.is_empty()
            && self.unobserved.values().all(|why| why == NO_SUBSCRIBER)
    }
}
