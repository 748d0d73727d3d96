//! Samples for those who want them one by one: each once for its writer and sequence number, at the
//! moment in which the profiler counts it, in that order.
//!
//! What waits to be taken is bounded; what finds no room is counted and told. It measures nothing:
//! whether somebody wants samples changes no number.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use ros2probe_wire::{Guid, Timestamp};

use super::topic::Wished;
use super::writer::Counted;

/// Entries that wait to be taken: a round of the capture thread has far fewer.
const WAITING: usize = 65_536;

/// The topic of a sample.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Domain.
    pub domain_id: u32,
    /// ROS name, or the DDS name where it follows no ROS convention.
    pub name: Arc<str>,
    /// DDS name.
    pub dds_name: Arc<str>,
    /// ROS name of the type, as in `sensor_msgs/msg/PointCloud2`.
    pub message_type: Arc<str>,
}

/// One message. Immutable, shared by all who want it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Its topic.
    pub topic: Arc<Topic>,
    /// Of the datagram that completed it.
    pub time: Timestamp,
    /// Who wrote it.
    pub writer: Guid,
    /// Its number among those of this writer.
    pub sequence_number: u64,
    /// INFO_TS: when it was written, by the writer's clock.
    pub source_timestamp: Option<Timestamp>,
    /// Seconds and nanoseconds of its header, where the type begins with one.
    pub header_stamp: Option<(i32, u32)>,
    /// Bytes of the serialized payload, encapsulation and padding included.
    pub size: u32,
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
    pub first: u64,
    /// Number of the last.
    pub last: u64,
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
    /// It was counted, but its bytes were lost on the way to the agent or found no room.
    NotCaptured,
    /// Its reader was too slow.
    QueueFull,
}

/// What is to be given, and to which subscriptions.
#[derive(Clone, Debug)]
pub struct Given {
    /// Ids of the wishes.
    pub to: Arc<[u64]>,
    /// What.
    pub news: News,
}

/// A sample, or that there is none.
#[derive(Clone, Debug)]
pub enum News {
    /// It was counted.
    Sample(Arc<Sample>),
    /// It will not come.
    Missed(Missed),
}

/// What somebody wants of one writer.
#[derive(Debug)]
struct Interested {
    topic: Arc<Topic>,
    to: Arc<[u64]>,
}

/// The wanted writers and what waits to be taken.
#[derive(Debug, Default)]
pub struct Payloads {
    writers: HashMap<Guid, Interested>,
    given: Vec<Given>,
    refused: u64,
}

impl MissedReason {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Incomplete, Self::NotCaptured, Self::QueueFull];

    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Incomplete => "incomplete",
            Self::NotCaptured => "not_captured",
            Self::QueueFull => "queue_full",
        }
    }
}

impl Payloads {
    /// Nobody wants anything.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.writers.is_empty()
    }

    /// Gives the samples of this writer from now on.
    pub fn want(&mut self, writer: Guid, topic: Topic, wished: &Wished) {
        let known = self.writers.get(&writer).map(|known| &known.topic);
        let topic = match known {
            Some(known) if **known == topic => Arc::clone(known),
            _ => Arc::new(topic),
        };
        let interested = Interested {
            topic,
            to: Arc::clone(&wished.ids),
        };
        self.writers.insert(writer, interested);
    }

    /// No longer.
    pub fn release(&mut self, writer: Guid) {
        self.writers.remove(&writer);
    }

    /// A sample of this writer was counted.
    pub fn counted(&mut self, writer: Guid, counted: &Counted) {
        let Some(interested) = self.writers.get(&writer) else {
            return;
        };
        let sample = Sample {
            topic: Arc::clone(&interested.topic),
            time: counted.at,
            writer,
            sequence_number: counted.number,
            source_timestamp: counted.source.timestamp(),
            header_stamp: counted.stamp,
            size: u32::try_from(counted.bytes).unwrap_or(u32::MAX),
            payload: None,
        };
        let given = Given {
            to: Arc::clone(&interested.to),
            news: News::Sample(Arc::new(sample)),
        };
        self.give(given);
    }

    /// Takes what is to be given.
    pub fn take(&mut self) -> Vec<Given> {
        std::mem::take(&mut self.given)
    }

    /// So much waits that whoever feeds the model should let it be taken first.
    #[must_use]
    pub const fn is_full(&self) -> bool {
        self.given.len() >= WAITING / 2
    }

    fn give(&mut self, given: Given) {
        if self.given.len() < WAITING {
            self.given.push(given);
        } else {
            self.refused += 1;
        }
    }
}
