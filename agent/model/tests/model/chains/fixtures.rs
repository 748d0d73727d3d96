//! Nodes with stamped topics in virtual time.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2probe_model::derive::chain::expected::ExpectedChain;
use ros2probe_model::derive::chain::path::ChainFacts;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::model::domain::watchlist;
use ros2probe_testing::model::forge::{
    self, AnnouncedNode, Message, SEDP_READERS, SEDP_WRITERS, SPDP,
};
use ros2probe_testing::model::host::START;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};

pub const MICROSECOND: u64 = 1000;
/// Time from a publication to its capture.
pub const TRANSIT: u64 = 100 * MICROSECOND;
const SECOND: u64 = 1_000_000_000;
const STAMPED: &str = "sensor_msgs::msg::dds_::PointCloud2_";
const PLAIN: &str = "std_msgs::msg::dds_::String_";
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);

/// A robot whose publications are played in the order of their capture.
pub struct Robot {
    pub observer: Observer,
    now: u64,
    nodes: Vec<(String, Vec<String>, Vec<String>)>,
    /// Number of participants so far.
    participants: u16,
    /// Writers and numbers of their last messages, by topic.
    writers: BTreeMap<String, (Guid, u64)>,
    /// Time, topic and stamp.
    planned: Vec<(u64, String, u64)>,
}

impl Robot {
    pub fn new() -> Self {
        Self::watching(&["/**"])
    }

    pub fn watching(patterns: &[&str]) -> Self {
        Self::with(watchlist(patterns))
    }

    /// Returns a robot whose chains are traced with these shares of their first topics.
    pub fn tracing(shares: &[(&str, f64)]) -> Self {
        let watches = shares.iter().map(|(topic, share)| Watch {
            trace: *share,
            ..Watch::named(topic).unwrap()
        });
        Self::with(Watchlist::new(watches.collect()).unwrap())
    }

    fn with(watchlist: Watchlist) -> Self {
        let mut observer = Observer::new(Settings {
            directed: false,
            ..Settings::default()
        });
        observer.input(Input::Watchlist(Arc::new(watchlist)));
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
            nodes: Vec::new(),
            participants: 0,
            writers: BTreeMap::new(),
            planned: Vec::new(),
        }
    }

    /// Adds a node in a participant of its own. Topics without a header begin with `/plain`.
    pub fn node(&mut self, name: &str, inputs: &[&str], outputs: &[&str]) {
        let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        self.nodes
            .push((name.to_owned(), owned(inputs), owned(outputs)));
    }

    pub fn expect(&mut self, chains: Vec<ExpectedChain>) {
        self.observer.input(Input::ExpectedChains(Arc::new(chains)));
    }

    /// Announces all nodes, each in a new participant.
    pub fn start(&mut self) {
        for (name, inputs, outputs) in &self.nodes.clone() {
            let prefix = participant(self.participants);
            self.participants += 1;
            let payload = forge::participant(prefix, 1_000_000, None);
            self.put(Message::from(prefix).data(SPDP, 1, &payload));
            let mut endpoints = |topics: &[String], kind: u8, sedp| {
                let mut guids = Vec::new();
                for (number, topic) in topics.iter().enumerate() {
                    let number = u8::try_from(number).unwrap();
                    let guid = Guid::new(prefix, EntityId([0, number, 1, kind]));
                    let is_plain = topic.starts_with("/plain");
                    let message_type = if is_plain { PLAIN } else { STAMPED };
                    let payload = forge::endpoint(guid, &format!("rt{topic}"), message_type, true);
                    let message = Message::from(prefix);
                    self.put(message.data(sedp, u64::from(number) + 1, &payload));
                    if kind == 3 {
                        self.writers.insert(topic.clone(), (guid, 0));
                    }
                    guids.push(guid);
                }
                guids
            };
            let writers = endpoints(outputs, 3, SEDP_WRITERS);
            let readers = endpoints(inputs, 4, SEDP_READERS);
            let node = AnnouncedNode {
                namespace: "/",
                name: name.trim_start_matches('/'),
                readers,
                writers,
            };
            let payload = forge::entities_of(prefix, 24, &[node]);
            self.put(Message::from(prefix).data(NODES, 1, &payload));
        }
        self.wait(2 * SECOND);
    }

    /// Disposes of all participants.
    pub fn stop(&mut self) {
        for number in 0..self.participants {
            let prefix = participant(number);
            let guid = Guid::new(prefix, EntityId::PARTICIPANT);
            self.put(Message::from(prefix).dispose_by_hash(SPDP, 2, guid));
        }
    }

    /// Returns the time since the start.
    pub fn elapsed(&self) -> u64 {
        self.now - START
    }

    /// Returns a time after the start.
    pub fn after(&self, nanoseconds: u64) -> u64 {
        START + 3 * SECOND + nanoseconds
    }

    /// Plans a publication.
    pub fn publish(&mut self, topic: &str, at: u64, stamp: u64) {
        self.planned.push((at, topic.to_owned(), stamp));
    }

    /// Plays all planned publications and waits until they are evaluated.
    pub fn play(&mut self) {
        self.play_only();
        self.wait(8 * SECOND);
    }

    pub fn play_only(&mut self) {
        let mut planned = std::mem::take(&mut self.planned);
        planned.sort();
        for (at, topic, stamp) in planned {
            self.now = self.now.max(at + TRANSIT);
            self.observer.input(Input::Time(Timestamp(self.now)));
            let (guid, number) = {
                let writer = self.writers.get_mut(&topic).unwrap();
                writer.1 += 1;
                *writer
            };
            let seconds = u32::try_from(stamp / SECOND).unwrap();
            let nanoseconds = u32::try_from(stamp % SECOND).unwrap();
            let payload = [
                [0, 1, 0, 0],
                seconds.to_le_bytes(),
                nanoseconds.to_le_bytes(),
                1_u32.to_le_bytes(),
                [0; 4],
            ];
            let message = Message::from(guid.prefix).info_ts(at);
            self.put(message.data(guid.entity, number, &payload.concat()));
        }
    }

    pub fn wait(&mut self, nanoseconds: u64) {
        self.now += nanoseconds;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    /// Ends the input.
    pub fn end(&mut self) {
        self.observer.input(Input::End);
    }

    pub fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
    }

    pub fn chains(&self) -> Vec<ChainFacts> {
        self.snapshot().chains.chains
    }

    pub fn shown(&self) -> Vec<String> {
        self.chains().iter().map(shown).collect()
    }

    /// Returns the findings about chains.
    pub fn findings(&self) -> Vec<Diagnosis> {
        let snapshot = self.snapshot();
        let is_meant = |each: &&Diagnosis| matches!(each.kind(), "restamping_node" | "slow_chain");
        snapshot
            .diagnoses
            .list
            .iter()
            .filter(is_meant)
            .cloned()
            .collect()
    }

    fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, 0);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }
}

fn participant(number: u16) -> GuidPrefix {
    let mut bytes = *b"\x01\x10chain-node";
    bytes[10..].copy_from_slice(&number.to_be_bytes());
    GuidPrefix(bytes)
}

/// Returns the chain as text.
pub fn shown(chain: &ChainFacts) -> String {
    let mut topics = chain.path.topics.iter();
    let mut text = topics.next().unwrap().0.to_string();
    for (topic, node) in topics {
        text += &format!(" -[{}]-> {topic}", node.as_deref().unwrap_or("?"));
    }
    text
}

/// Returns all hops of all chains as text.
pub fn hops(chains: &[ChainFacts]) -> Vec<String> {
    let mut hops = Vec::new();
    for chain in chains {
        for ends in chain.path.topics.windows(2) {
            let node = ends[1].1.as_deref().unwrap_or("?");
            hops.push(format!("{} -[{node}]-> {}", ends[0].0, ends[1].0));
        }
    }
    hops.sort();
    hops.dedup();
    hops
}

/// Asserts that both durations differ by less than a microsecond.
pub fn near(seconds: f64, expected: f64) {
    assert!((seconds - expected).abs() < 1e-6, "{seconds} {expected}");
}
