//! What a recording has and what it has not: part of `/recordings`, and in each bag's metadata.
//!
//! `missing` counts messages of topics of the bag. What belongs to no topic, or never passes where it
//! can be observed, is listed beside it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// No subscriber: the one reason in [`Report::unobserved`] by which nothing is missing.
pub const NO_SUBSCRIBER: &str = "no_subscriber";

/// What became of what was to be recorded.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingReport))]
pub struct Report {
    /// Messages in the bag.
    pub messages: u64,
    /// Bytes of those messages.
    pub bytes: u64,
    /// Messages that were sent and are not in the bag.
    pub missing: u64,
    /// By topic.
    pub topics: BTreeMap<String, TopicReport>,
    /// Which messages are missing, by writer and sequence number: the first ones.
    pub missing_runs: Vec<MissingRun>,
    /// Further runs that are counted but not named.
    pub missing_runs_unnamed: u64,
    /// Topics that late joiners are given samples of, which were sent before the recording began and
    /// are not in the bag.
    pub sent_before: Vec<String>,
    /// Topics that are left out because they have several types; a bag holds one.
    pub left_out: Vec<String>,
    /// Published topics without a message in the bag, where the reason is known: `no_subscriber`, or
    /// how all messages pass: `shared_memory`, `data_sharing`, `same_process`, `iceoryx`.
    #[serde(default)]
    pub unobserved: BTreeMap<String, String>,
    /// Writers that sent and were never announced.
    #[serde(default)]
    pub unknown_writers: UnknownWriters,
    /// Topics that the choice would take, in other domains.
    #[serde(default)]
    pub other_domains: Vec<OtherDomain>,
    /// Which limit ended it, if one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_reached: Option<String>,
}

/// Writers whose topics are unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingUnknownWriters))]
pub struct UnknownWriters {
    /// How many sent.
    pub writers: u64,
    /// Messages they sent while it was recorded.
    pub messages: u64,
}

/// What passed in a domain that is not recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = RecordingOtherDomain))]
pub struct OtherDomain {
    /// Which one.
    pub domain_id: u32,
    /// Published topics.
    pub topics: u64,
    /// Their messages while it was recorded; null where none of them is measured.
    pub messages: Option<u64>,
}

/// What became of one topic's messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TopicReport {
    /// In the bag.
    pub messages: u64,
    /// Bytes of those.
    pub bytes: u64,
    /// Never complete on the wire: fragments were lost.
    pub incomplete: u64,
    /// Lost on the way: nothing of them was seen.
    #[serde(default)]
    pub lost: u64,
    /// Came before their writer was announced, and not again.
    #[serde(default)]
    pub unannounced: u64,
    /// On the wire, but lost on the way to the agent.
    pub not_captured: u64,
    /// Dropped because the storage was too slow.
    pub dropped: u64,
    /// Taken, and lost because the storage took no more.
    pub unwritten: u64,
    /// Came while the recording was paused.
    pub paused: u64,
}

/// Consecutive samples of one writer that are missing for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MissingRun {
    /// Topic.
    pub topic: String,
    /// GUID of the writer.
    pub writer: String,
    /// Number of the first.
    pub first_sequence_number: u64,
    /// Number of the last.
    pub last_sequence_number: u64,
    /// How many of those in between.
    pub samples: u64,
    /// `incomplete`, `lost`, `unannounced`, `not_captured` or `dropped`.
    pub reason: String,
}

impl Report {
    /// The row of a topic, which is added if it is new.
    pub fn topic(&mut self, name: &str) -> &mut TopicReport {
        if !self.topics.contains_key(name) {
            self.topics.insert(name.to_owned(), TopicReport::default());
        }
        self.topics.entry(name.to_owned()).or_default()
    }

    /// Whether everything that was sent is in the bag, as far as that is known. Topics without a
    /// subscriber are complete: their publishers send nothing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.missing == 0
            && self.left_out.is_empty()
            && self.unknown_writers.writers == 0
            && self.other_domains.is_empty()
            && self.unobserved.values().all(|why| why == NO_SUBSCRIBER)
    }
}
