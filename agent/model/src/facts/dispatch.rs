//! Samples, and reasons for missing ones, as subscriptions receive them.

use std::sync::Arc;

use bytes::Bytes;
use ros2probe_wire::discovery::{EquivalenceHash, TypeHash};
use ros2probe_wire::qos::Qos;
use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, TopicName, TypeName};
use crate::facts::wall_clock::WallClock;

/// The topic of a sample.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name, or the DDS name if it follows no ROS convention.
    pub name: TopicName,
    /// DDS name.
    pub dds_name: DdsName,
    /// ROS name of the type, as in `sensor_msgs/msg/PointCloud2`.
    pub message_type: TypeName,
    /// Properties that the writer announced.
    pub offered: Option<Arc<Offered>>,
}

/// Properties that a writer announced with its topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Offered {
    /// RIHS01 hash of its type; announced since Iron.
    pub type_hash: Option<TypeHash>,
    /// Hash of its complete type in XTypes.
    pub equivalence_hash: Option<EquivalenceHash>,
    /// Quality of service.
    pub qos: Arc<Qos>,
}

impl Offered {
    /// Returns the hash by which a definition of its type is found.
    #[must_use]
    pub fn definition_hash(&self) -> Option<String> {
        definition_hash(self.type_hash, self.equivalence_hash)
    }
}

/// Returns the announced hash by which a definition is found: RIHS01, otherwise that of XTypes.
pub(crate) fn definition_hash(
    type_hash: Option<TypeHash>,
    equivalence_hash: Option<EquivalenceHash>,
) -> Option<String> {
    let type_hash = type_hash.map(|hash| hash.to_string());
    type_hash.or_else(|| equivalence_hash.map(|hash| hash.to_string()))
}

/// A message. It is immutable and shared by all subscriptions. Its time is a [`ModelTime`] until it
/// is dispatched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample<T = Timestamp> {
    /// Its topic.
    pub topic: Arc<Topic>,
    /// Capture time of the datagram that completed the sample. If the sample waited for a lower
    /// number, it is the time at which that number arrived or was given up. It never decreases for
    /// one writer.
    pub time: T,
    /// GUID of its writer.
    pub writer: Guid,
    /// Its sequence number, assigned by the writer.
    pub sequence_number: SequenceNumber,
    /// INFO_TS: time of writing, by the writer's clock.
    pub source_timestamp: Option<Timestamp>,
    /// Seconds and nanoseconds of its header, if the type begins with one.
    pub header_stamp: Option<(i32, u32)>,
    /// Size of the serialized payload in bytes, including encapsulation and padding.
    pub size: u32,
    /// Whether it was sampled from shared memory. Missing numbers before it may then have been
    /// sent.
    pub sampled: bool,
    /// The payload, including encapsulation; `None` if the request excludes payloads.
    pub payload: Option<Bytes>,
}

impl Sample<ModelTime> {
    /// Returns the sample with the wall time.
    #[must_use]
    pub fn at_wall_time(self, clock: WallClock) -> Sample {
        Sample {
            topic: self.topic,
            time: clock.wall_time(self.time),
            writer: self.writer,
            sequence_number: self.sequence_number,
            source_timestamp: self.source_timestamp,
            header_stamp: self.header_stamp,
            size: self.size,
            sampled: self.sampled,
            payload: self.payload,
        }
    }
}

/// Samples that were sent but are missing from the subscription.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missed {
    /// Their topic.
    pub topic: Arc<Topic>,
    /// GUID of their writer.
    pub writer: Guid,
    /// First sequence number.
    pub first: SequenceNumber,
    /// Last sequence number.
    pub last: SequenceNumber,
    /// Number of missing samples in this range.
    pub samples: u64,
    /// Reason.
    pub reason: MissedReason,
}

/// Why a sample is missing from a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MissedReason {
    /// Some of its fragments were never seen.
    Incomplete,
    /// No part of it was seen, and it is lost.
    Lost,
    /// It arrived before its writer's announcement and was not sent again.
    Unannounced,
    /// It was counted, but its bytes were not captured or were dropped for lack of memory.
    NotCaptured,
    /// The subscription's reader was too slow.
    QueueFull,
}

impl MissedReason {
    /// All reasons.
    pub const ALL: [Self; 5] = [
        Self::Incomplete,
        Self::Lost,
        Self::Unannounced,
        Self::NotCaptured,
        Self::QueueFull,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Incomplete => "incomplete",
            Self::Lost => "lost",
            Self::Unannounced => "unannounced",
            Self::NotCaptured => "not_captured",
            Self::QueueFull => "queue_full",
        }
    }
}

/// An outcome and the subscriptions that receive it.
#[derive(Clone, Debug)]
pub struct Dispatch<S = Arc<Sample>> {
    /// Ids of the requests.
    pub to: Arc<[u64]>,
    /// The sample, or why it is missing.
    pub outcome: SampleOutcome<S>,
}

/// A dispatch within the model.
pub type QueuedDispatch = Dispatch<Sample<ModelTime>>;

impl QueuedDispatch {
    /// Returns the dispatch with the wall time.
    #[must_use]
    pub fn at_wall_time(self, clock: WallClock) -> Dispatch {
        let outcome = match self.outcome {
            SampleOutcome::Sample(sample) => {
                SampleOutcome::Sample(Arc::new(sample.at_wall_time(clock)))
            }
            SampleOutcome::Missed(missed) => SampleOutcome::Missed(missed),
        };
        Dispatch {
            to: self.to,
            outcome,
        }
    }
}

/// A sample, or the reason why it is missing.
#[derive(Clone, Debug)]
pub enum SampleOutcome<S = Arc<Sample>> {
    /// The sample was counted.
    Sample(S),
    /// The sample will not arrive.
    Missed(Missed),
}
