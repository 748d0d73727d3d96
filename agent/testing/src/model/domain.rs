//! A DDS domain in virtual time: forged participants, and the model that observes them.

use std::sync::Arc;

use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::{Captured, Input};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::record::flag;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp, walk};

use super::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use super::host::{MILLISECOND, START};

const STRING: &str = "std_msgs::msg::dds_::String_";
/// The writer of `ros_discovery_info`.
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);

/// The observer of one domain.
pub struct VirtualDomain {
    pub observer: Observer,
    /// Nanoseconds since the Unix epoch.
    pub now: u64,
    /// Domain whose multicast port receives all messages.
    pub domain_id: u16,
}

impl VirtualDomain {
    /// Creates a domain at [`START`] that watches these names and globs.
    pub fn new(patterns: &[&str], settings: Settings) -> Self {
        let mut observer = Observer::new(settings);
        observer.input(Input::Watchlist(Arc::new(watchlist(patterns))));
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
            domain_id: 0,
        }
    }

    pub fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, self.domain_id);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    /// Passes a message that polling saw in shared memory.
    pub fn put_polled(&mut self, message: Message) {
        self.observer.input(Input::SharedMemory {
            envelope: &forge::multicast(self.now, self.domain_id),
            payload: &message.bytes(),
        });
    }

    /// Passes a message that a probe saw on its way to shared memory.
    pub fn put_exact(&mut self, message: Message) {
        let (envelope, bytes) = (forge::multicast(self.now, self.domain_id), message.bytes());
        let captured = Captured::new(&envelope, &bytes, false);
        let outcome = walk::datagram(&bytes, &envelope, None, |mut found| {
            found.record.flags |= flag::SHM | flag::EXACT;
            self.observer.input(Input::Submessage {
                captured,
                found: &found,
            });
        });
        self.observer.input(Input::DatagramEnd(outcome));
    }

    pub fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * MILLISECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    pub fn participant(&mut self, prefix: GuidPrefix, lease_seconds: u32) {
        let payload = forge::participant(prefix, lease_seconds, None);
        self.put(Message::from(prefix).data(SPDP, 1, &payload));
    }

    /// Announces a reliable endpoint; `number` is the announcement's sequence number.
    pub fn endpoint(&mut self, guid: Guid, number: u64, topic: &str) {
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let payload = forge::endpoint(guid, topic, STRING, true);
        self.put(Message::from(guid.prefix).data(sedp, number, &payload));
    }

    /// Announces nodes, each with its namespace, its name and a writer.
    pub fn nodes(&mut self, prefix: GuidPrefix, number: u64, nodes: &[(&str, &str, Guid)]) {
        let payload = forge::entities(prefix, 24, nodes);
        self.put(Message::from(prefix).data(NODES, number, &payload));
    }

    /// Sends a sample without a timestamp.
    pub fn sample(&mut self, guid: Guid, number: u64) {
        let payload = [0, 1, 0, 0, 9, 9, 9, 9];
        self.put(Message::from(guid.prefix).data(guid.entity, number, &payload));
    }

    pub fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
    }
}

/// Returns a watchlist of these names and globs.
pub fn watchlist(patterns: &[&str]) -> Watchlist {
    let watch = |pattern: &&str| Watch::named(pattern).unwrap();
    Watchlist::new(patterns.iter().map(watch).collect()).unwrap()
}
