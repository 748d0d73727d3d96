//! A sample, or the reason why it is missing, as subscriptions get it.

use std::sync::Arc;

use bytes::Bytes;
use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::qos::Qos;
use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use super::names::{DdsName, TopicName, TypeName};

/// The topic of a sample.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name, or the DDS name where it follows no ROS convention.
    pub name: TopicName,
    /// DDS name.
    pub dds_name: DdsName,
    /// ROS name of the type, as in `sensor_msgs/msg/PointCloud2`.
    pub message_type: TypeName,
    /// What the writer announced.
    pub offered: Option<Arc<Offered>>,
}

/// What a writer announced with its topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Offered {
    /// RIHS01 hash of its type; not before Iron.
    pub type_hash: Option<TypeHash>,
    /// Quality of service.
    pub qos: Arc<Qos>,
}

/// One message. Immutable, shared by all who want it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Its topic.
    pub topic: Arc<Topic>,
    /// Of the datagram that completed it, or, where it waited for a lower number, of the moment in
    /// which that came or was given up. Never goes back for one writer.
    pub time: Timestamp,
    /// Who wrote it.
    pub writer: Guid,
    /// Its number among those of this writer.
    pub sequence_number: SequenceNumber,
    /// INFO_TS: when it was written, by the writer's clock.
    pub source_timestamp: Option<Timestamp>,
    /// Seconds and nanoseconds of its header, where the type begins with one.
    pub header_stamp: Option<(i32, u32)>,
    /// Bytes of the serialized payload, encapsulation and padding included.
    pub size: u32,
    /// Seen in shared memory, where not every message is seen: the numbers before it that were not
    /// given may have been sent all the same.
    pub sampled: bool,
    /// Those bytes, encapsulation included; `None` where only arrivals were asked for.
    pub payload: Option<Bytes>,
}

/// Samples that were sent and are not given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missed {
    /// Their topic.
    pub topic: Arc<Topic>,
    /// Who wrote them.
    pub writer: Guid,
    /// Number of the first.
    pub first: SequenceNumber,
    /// Number of the last.
    pub last: SequenceNumber,
    /// How many those are.
    pub samples: u64,
    /// Why.
    pub reason: MissedReason,
}

/// Why a sample is not given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MissedReason {
    /// Some of its fragments were never seen.
    Incomplete,
    /// Nothing of it was seen, and it is lost.
    Lost,
    /// It came before its writer was announced, and not again.
    Unannounced,
    /// It was counted, but its bytes were lost on the way to the agent or found no room.
    NotCaptured,
    /// Its reader was too slow.
    QueueFull,
}

impl MissedReason {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Incomplete,
        Self::Lost,
        Self::Unannounced,
        Self::NotCaptured,
        Self::QueueFull,
    ];

    /// Label value.
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

/// What is to be given, and to which subscriptions.
#[derive(Clone, Debug)]
pub struct Dispatch {
    /// Ids of the requests.
    pub to: Arc<[u64]>,
    /// What.
    pub outcome: SampleOutcome,
}

/// A sample, or that there is none.
#[derive(Clone, Debug)]
pub enum SampleOutcome {
    /// It was counted.
    Sample(Arc<Sample>),
    /// It will not come.
    Missed(Missed),
}
