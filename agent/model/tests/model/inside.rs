//! Figures from inside processes: sums, nodes and domains, the source of a topic's counts, and
//! findings, from reports built by hand in virtual time.

mod findings;
mod late;
mod queues;
mod repairs;
mod slow;
mod sources;
mod sums;
mod unknown;

use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::calls::facts::TopicInside;
use ros2probe_model::facts::calls::report::{
    BufferReport, CallbackReport, Durations, ProcessReport, PublisherReport, Report,
    SubscriptionReport, ThreadStates, Transition, Trigger,
};
use ros2probe_model::facts::names::NodeName;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);
const STRING: &str = "std_msgs::msg::dds_::String_";

/// An observer in virtual time, whose source reports once a second.
struct World {
    observer: Observer,
    now: u64,
    announced: u64,
}

impl World {
    fn new() -> Self {
        let mut observer = Observer::new(Settings::default());
        observer.input(Input::Time(Timestamp(START)));
        let mut world = Self {
            observer,
            now: START,
            announced: 0,
        };
        world.watch("/**");
        world
    }

    fn watch(&mut self, pattern: &str) {
        let watchlist = Watchlist::new(vec![Watch::named(pattern).unwrap()]).unwrap();
        let watchlist = Arc::new(watchlist);
        self.observer.input(Input::Watchlist(watchlist));
    }

    /// Lets a second pass, in the middle of which the source reports these processes.
    fn second(&mut self, processes: Vec<ProcessReport>) {
        self.now += SECOND / 2;
        self.observer.input(Input::Inside(Report {
            at: Timestamp(self.now),
            has_callbacks: true,
            processes,
            transitions: Vec::new(),
            late: Vec::new(),
        }));
        self.now += SECOND / 2;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    fn transit(&mut self, transition: Transition) {
        self.observer.input(Input::Inside(Report {
            at: Timestamp(self.now),
            has_callbacks: true,
            processes: Vec::new(),
            transitions: vec![transition],
            late: Vec::new(),
        }));
    }

    fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, 0);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    /// Announces a participant of this process; Fast DDS stores the id's low 16 bits in the GUID.
    fn participant(&mut self, number: u8, process: u16) -> GuidPrefix {
        let [low, high] = process.to_le_bytes();
        let prefix = GuidPrefix([1, 0x0f, 9, 9, low, high, 0, 0, number, 0, 0, 0]);
        let payload = forge::participant_at(prefix, 1_000_000, None, &[]);
        self.put(Message::from_fast(prefix).data(SPDP, 1, &payload));
        let info = Guid::new(prefix, NODES);
        let type_name = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
        self.announce(info, "ros_discovery_info", type_name);
        prefix
    }

    fn announce(&mut self, guid: Guid, topic: &str, type_name: &str) {
        self.announced += 1;
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let payload = forge::endpoint_with(guid, topic, type_name, &[]);
        self.put(Message::from_fast(guid.prefix).data(sedp, self.announced, &payload));
    }

    fn nodes(&mut self, prefix: GuidPrefix, nodes: &[(&str, &str, Guid)]) {
        let payload = forge::entities(prefix, 24, nodes);
        self.put(Message::from_fast(prefix).data(NODES, 1, &payload));
    }

    fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
    }

    fn topic(&self, name: &str) -> TopicFacts {
        let topics = self.snapshot().topics;
        let found = topics.into_iter().find(|topic| topic.name == *name);
        found.unwrap_or_else(|| panic!("no topic {name}"))
    }

    fn inside(&self, name: &str) -> TopicInside {
        *self.topic(name).inside.expect("the topic is not observed")
    }
}

/// Returns a report of a process with this id.
fn process(id: u32) -> ProcessReport {
    ProcessReport {
        id,
        name: Some("component_container".into()),
        shows_intra_process: true,
        ..ProcessReport::default()
    }
}

fn publisher(topic: &str, published: u64, at: u64) -> PublisherReport {
    PublisherReport {
        handle: 0x10,
        node: None,
        topic: topic.into(),
        middleware: Some("rmw_zenoh_cpp".into()),
        published,
        within_process: 0,
        last: Timestamp(at),
        intervals: Durations::default(),
    }
}

fn subscription(topic: &str, taken: u64, at: u64) -> SubscriptionReport {
    SubscriptionReport {
        handle: 0x20,
        node: None,
        topic: topic.into(),
        middleware: None,
        taken,
        failed: 1,
        last: Timestamp(at),
        intervals: Durations::default(),
        latency: durations(taken, 2),
    }
}

fn buffer(topic: &str, enqueued: u64, overwritten: u64, at: u64) -> BufferReport {
    BufferReport {
        handle: 0x30,
        node: Some("/mapper".into()),
        topic: Some(topic.into()),
        enqueued,
        overwritten,
        dequeued: enqueued - overwritten,
        depth: 1,
        max_depth: 2,
        capacity: Some(2),
        last: Timestamp(at),
        waiting: durations(enqueued - overwritten, 1),
    }
}

fn callback(handle: u64, trigger: Trigger, thread: u32, calls: u64, at: u64) -> CallbackReport {
    CallbackReport {
        handle,
        node: Some("/nav".into()),
        trigger,
        thread,
        calls,
        last: Timestamp(at),
        durations: durations(calls, 1),
        waits: durations(calls, 1),
        skipped: 0,
        states: ThreadStates::default(),
    }
}

fn timer(milliseconds: u64) -> Trigger {
    Trigger::Timer(Some(Duration::from_millis(milliseconds)))
}

/// Returns `count` durations of this length.
fn durations(count: u64, milliseconds: u64) -> Durations {
    let mut durations = Durations::default();
    for _ in 0..count {
        durations.observe(Duration::from_millis(milliseconds));
    }
    durations
}

fn node(name: &str) -> Option<NodeName> {
    Some(name.into())
}
