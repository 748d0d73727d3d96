//! Tests discovery, interest and measurement with forged traffic in virtual time. Each test is
//! named after an earlier defect.

mod announcements;
mod clock;
mod events;
mod interest;
mod lifecycle;
mod storms;
mod unknown_writers;

use std::sync::Arc;

use ros2probe_model::event::EventKind;
use ros2probe_model::input::Input;
use ros2probe_model::observer::{Observer, Settings};
use ros2probe_model::snapshot::{Measurement, Snapshot, TopicFacts};
use ros2probe_model::watch::{Expectations, Watch, Watchlist};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;

const STRING: &str = "std_msgs::msg::dds_::String_";

const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);

const OTHER: EntityId = EntityId([0, 0, 0x12, 0x03]);

const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);

const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);

const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");

const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");

/// An observer in virtual time.
struct World {
    observer: Observer,
    now: u64,
    /// Domain whose multicast port receives everything.
    domain_id: u16,
}

impl World {
    fn new(patterns: &[&str]) -> Self {
        Self::with(patterns, Settings::default())
    }

    fn with(patterns: &[&str], settings: Settings) -> Self {
        let mut observer = Observer::new(settings);
        observer.input(Input::Watchlist(Arc::new(watchlist(patterns))));
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
            domain_id: 0,
        }
    }

    fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, self.domain_id);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * MILLISECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    fn spdp(&mut self, prefix: GuidPrefix, lease_seconds: u32) {
        let payload = forge::participant(prefix, lease_seconds, None);
        self.put(Message::from(prefix).data(SPDP, 1, &payload));
    }

    fn sedp(&mut self, guid: Guid, topic: &str) {
        let (sedp, number) = match guid.entity.is_writer() {
            true => (SEDP_WRITERS, u64::from(guid.entity.0[2])),
            false => (SEDP_READERS, u64::from(guid.entity.0[2])),
        };
        let payload = forge::endpoint(guid, topic, STRING, true);
        self.put(Message::from(guid.prefix).data(sedp, number, &payload));
    }

    fn nodes(&mut self, prefix: GuidPrefix, number: u64, nodes: &[(&str, &str, Guid)]) {
        let payload = forge::entities(prefix, 24, nodes);
        self.put(Message::from(prefix).data(NODES, number, &payload));
    }

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

    fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
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

fn watchlist(patterns: &[&str]) -> Watchlist {
    let watch = |pattern: &&str| Watch {
        pattern: (*pattern).to_owned(),
        domain_id: None,
        expectations: Expectations::default(),
        per_subscriber: false,
        trace: 0.0,
        retain: ros2probe_model::watch::Retain::None,
    };
    Watchlist::new(patterns.iter().map(watch).collect()).unwrap()
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
