//! Tests discovery, interest and measurement with forged traffic in virtual time. Each test is
//! named after an earlier defect.

mod announcements;
mod clock;
mod events;
mod interest;
mod lifecycle;
mod storms;
mod unknown_writers;

use std::ops::{Deref, DerefMut};

use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::{Measurement, TopicFacts};
use ros2probe_testing::model::domain::{VirtualDomain, watchlist};
use ros2probe_testing::model::forge::Message;
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix};

const START: u64 = 1_795_143_000 * SECOND;

const STRING: &str = "std_msgs::msg::dds_::String_";

const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);

const OTHER: EntityId = EntityId([0, 0, 0x12, 0x03]);

const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);

const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);

const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");

const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");

/// A domain in virtual time.
struct World {
    domain: VirtualDomain,
}

impl Deref for World {
    type Target = VirtualDomain;

    fn deref(&self) -> &VirtualDomain {
        &self.domain
    }
}

impl DerefMut for World {
    fn deref_mut(&mut self) -> &mut VirtualDomain {
        &mut self.domain
    }
}

impl World {
    fn new(patterns: &[&str]) -> Self {
        Self::with(patterns, Settings::default())
    }

    fn with(patterns: &[&str], settings: Settings) -> Self {
        Self {
            domain: VirtualDomain::new(patterns, settings),
        }
    }

    fn spdp(&mut self, prefix: GuidPrefix, lease_seconds: u32) {
        self.participant(prefix, lease_seconds);
    }

    fn sedp(&mut self, guid: Guid, topic: &str) {
        self.endpoint(guid, guid.entity.0[2].into(), topic);
    }

    /// Sends a sample with the current time as its timestamp.
    fn sample(&mut self, guid: Guid, number: u64) {
        let message = Message::from(guid.prefix).info_ts(self.now);
        self.put(message.data(guid.entity, number, &[0, 1, 0, 0, 9, 9, 9, 9]));
    }

    /// Sends 100 samples per second.
    fn stream(&mut self, guid: Guid, numbers: std::ops::RangeInclusive<u64>) {
        for number in numbers {
            self.sample(guid, number);
            self.wait(10);
        }
    }

    fn topic(&self, domain_id: u32, name: &str) -> Option<TopicFacts> {
        let mut topics = self.snapshot().topics.into_iter();
        topics.find(|topic| topic.domain_id == DomainId(domain_id) && topic.name == name)
    }

    fn measurement(&self, name: &str) -> Measurement {
        self.topic(0, name)
            .and_then(|topic| topic.measurement)
            .map(|measurement| *measurement)
            .unwrap_or_default()
    }

    fn churn(&self, entity: &str, event: &str) -> u64 {
        let churn = self.snapshot().churn;
        let counts = churn
            .iter()
            .filter(|count| (count.entity, count.event) == (entity, event));
        counts.map(|count| count.count).sum()
    }

    /// Returns the events since the last call, with their times since the start.
    fn events(&mut self) -> Vec<(u64, EventKind)> {
        let events = self.observer.drain().events.events.into_iter();
        let reported = events.map(|event| ((event.at.0 - START) / MILLISECOND, event.kind));
        reported.collect()
    }

    fn node_names(&self) -> Vec<String> {
        self.snapshot()
            .nodes
            .into_iter()
            .map(|node| node.name.to_string())
            .collect()
    }
}

fn alice(entity: EntityId) -> Guid {
    Guid::new(ALICE, entity)
}

fn bob(entity: EntityId) -> Guid {
    Guid::new(BOB, entity)
}

/// Reproducible random bytes.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        self.0 ^ self.0 >> 29
    }

    fn prefix(&mut self) -> GuidPrefix {
        let mut bytes = [0; 12];
        bytes[..8].copy_from_slice(&self.roll().to_le_bytes());
        bytes[8..].copy_from_slice(&self.roll().to_le_bytes()[..4]);
        GuidPrefix(bytes)
    }
}
