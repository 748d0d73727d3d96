//! Last messages of transient-local writers, in virtual time: which are kept, for how long, and
//! what they may cost.

use std::sync::Arc;

use ros2probe_capture::border::observe;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::dispatch::SampleOutcome;
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::facts::tables::{RetainedBytes, RetainedWriters};
use ros2probe_model::facts::watch::{Retain, Watch, Watchlist};
use ros2probe_model::measure::latched::MESSAGE_BYTES;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::LatchedFacts;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS, SPDP};
use ros2probe_testing::model::host::START;
use ros2probe_testing::zenoh::{
    Role, connection, declare_key, declare_token, frame, init, open, publisher, push, report, send,
};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::zenoh::Gid;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};

const MAP: &str = "rt/map";
const FRAGMENT: u16 = 60_000;
const VOLATILE: u8 = 0;
const TRANSIENT_LOCAL: u8 = 1;

/// A robot that no watch covers.
struct Robot {
    domain: VirtualDomain,
    announced: u64,
}

fn prefix(number: u8) -> GuidPrefix {
    GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 9, number])
}

fn writer(participant: u8, number: u16) -> Guid {
    let [high, low] = number.to_be_bytes();
    Guid::new(prefix(participant), EntityId([1, high, low, 3]))
}

impl Robot {
    fn new() -> Self {
        Self::with(Settings::default())
    }

    fn with(settings: Settings) -> Self {
        Self {
            domain: VirtualDomain::new(&[], settings),
            announced: 0,
        }
    }

    /// Announces a writer with this durability, and a lifespan in seconds unless it is 0.
    fn announce(&mut self, guid: Guid, topic: &str, durability: u8, lifespan: u8) {
        self.domain.participant(guid.prefix, 10_000);
        self.announced += 1;
        let reliable = [2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        let durability = [durability, 0, 0, 0];
        let seconds = [lifespan, 0, 0, 0, 0, 0, 0, 0];
        let mut others: Vec<(u16, &[u8])> = vec![(0x1a, &reliable), (0x1d, &durability)];
        if lifespan > 0 {
            others.push((0x2b, &seconds));
        }
        let payload = forge::endpoint_with(guid, topic, "a::msg::dds_::Map_", &others);
        let message = Message::from(guid.prefix).data(SEDP_WRITERS, self.announced, &payload);
        self.domain.put(message);
    }

    /// A robot with a publisher of `/map` like that of `map_server`.
    fn map_server(participant: u8) -> (Self, Guid) {
        let mut robot = Self::new();
        let guid = writer(participant, 1);
        robot.announce(guid, MAP, TRANSIENT_LOCAL, 0);
        (robot, guid)
    }

    /// Sends a message whose bytes are its number, written now.
    fn send(&mut self, guid: Guid, number: u64, bytes: usize) {
        self.send_written(guid, number, bytes, self.domain.now);
    }

    fn send_written(&mut self, guid: Guid, number: u64, bytes: usize, written: u64) {
        let payload = payload(number, bytes);
        let message = || Message::from(guid.prefix).info_ts(written);
        if bytes <= usize::from(FRAGMENT) {
            self.domain
                .put(message().data(guid.entity, number, &payload));
            return;
        }
        for (place, _) in payload.chunks(FRAGMENT.into()).enumerate() {
            let first = u32::try_from(place).unwrap() + 1;
            let fragment = message().fragment(guid.entity, number, first, FRAGMENT, &payload);
            self.domain.put(fragment);
        }
    }

    /// Passes one record of a metered message to the model.
    fn meter(&mut self, guid: Guid, number: u64) {
        let payload = payload(number, 100);
        let message = Message::from(guid.prefix).data(guid.entity, number, &payload);
        let envelope = forge::multicast(self.domain.now, 0);
        let bytes = message.bytes();
        let mut records = Vec::new();
        ros2probe_wire::walk::datagram(&bytes, &envelope, None, |found| records.push(found.record));
        for record in &records {
            observe(&mut self.domain.observer, record);
        }
    }

    fn facts(&self, guid: Guid) -> Option<LatchedFacts> {
        let topics = self.domain.snapshot().topics;
        let publishers = topics.iter().flat_map(|topic| &topic.publishers);
        let mut own = publishers.filter(|publisher| publisher.guid == guid);
        own.next().and_then(|publisher| publisher.latched)
    }

    fn verdict(&mut self, guid: Guid) -> Option<Verdict> {
        let changes = self.domain.observer.drain().interest;
        let mut own = changes.iter().filter(|(changed, _)| *changed == guid);
        own.next_back().and_then(|(_, verdict)| *verdict)
    }

    /// Opens a subscription to all topics. Returns the messages that it receives first.
    fn subscribe(&mut self, id: u64) -> Vec<(u64, usize)> {
        subscribe(&mut self.domain.observer, id)
    }

    /// Numbers of the messages that subscriptions received.
    fn received(&mut self) -> Vec<u64> {
        let samples = self.domain.observer.drain().samples;
        let numbers = samples.iter().filter_map(|each| match &each.outcome {
            SampleOutcome::Sample(sample) if !each.to.is_empty() => Some(sample.sequence_number.0),
            _ => None,
        });
        numbers.collect()
    }
}

fn payload(number: u64, bytes: usize) -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    payload.resize(bytes, u8::try_from(number % 256).unwrap());
    payload
}

/// Returns a request for the payloads of all topics.
fn request(id: u64) -> SampleRequest {
    SampleRequest {
        id,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth: Depth::Payloads,
    }
}

fn subscribe(observer: &mut Observer, id: u64) -> Vec<(u64, usize)> {
    let request = request(id);
    // The agent drains the output before each change, too.
    observer.drain();
    observer.input(Input::SampleRequests(Arc::new(vec![request.clone()])));
    let samples = observer.latched(&request);
    let about = samples.iter().map(|sample| {
        let payload = sample.payload.as_ref().unwrap();
        let number = sample.sequence_number.0;
        assert_eq!(payload, &self::payload(number, payload.len()));
        (number, payload.len())
    });
    about.collect()
}

#[test]
fn a_later_subscription_receives_the_last_message_of_an_unwatched_topic() {
    let (mut robot, guid) = Robot::map_server(1);
    assert_eq!(robot.verdict(guid), Some(Verdict::Capture));
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Unseen));
    robot.send(guid, 1, 500);
    robot.send(guid, 2, 200_000);
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(200_000)));
    robot.domain.wait(60_000);
    assert_eq!(robot.subscribe(7), [(2, 200_000)]);
    // Later messages arrive as usual. The repetition of the last message for a late joiner is not
    // another message.
    robot.domain.wait(1_000);
    robot.send(guid, 2, 200_000);
    robot.send(guid, 3, 300);
    assert_eq!(robot.received(), [3]);
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(300)));
    assert_eq!(robot.subscribe(8), [(3, 300)]);
}

#[test]
fn kept_and_received_messages_have_the_wall_time_after_a_clock_step() {
    for step in [3_600 * SECOND.cast_signed(), -3_600 * SECOND.cast_signed()] {
        let (mut robot, guid) = Robot::map_server(1);
        robot.send(guid, 1, 500);
        let sent = robot.domain.now.saturating_add_signed(step);
        robot.domain.observer.input(Input::ClockSet(step));
        robot.domain.now = sent;
        robot.domain.wait(1_000);
        let first = request(7);
        let requests = Arc::new(vec![first.clone()]);
        robot.domain.observer.input(Input::SampleRequests(requests));
        let kept = robot.domain.observer.latched(&first);
        assert_eq!(kept[0].time, Timestamp(sent));
        robot.domain.wait(1_000);
        robot.send(guid, 2, 500);
        let samples = robot.domain.observer.drain().samples;
        let SampleOutcome::Sample(sample) = &samples[0].outcome else {
            panic!("{samples:?}")
        };
        assert_eq!(sample.time, Timestamp(robot.domain.now));
        // A message that a client received is kept, too.
        let (later, observer) = (request(8), &mut robot.domain.observer);
        observer.input(Input::SampleRequests(Arc::new(vec![first, later.clone()])));
        let kept = observer.latched(&later);
        assert_eq!(kept.last().unwrap().time, sample.time);
    }
}

#[test]
fn keeping_the_last_messages_changes_no_figure() {
    let figures = |keeps_latched| {
        let mut robot = Robot::with(Settings {
            keeps_latched,
            ..Settings::default()
        });
        let watched = Arc::new(Watchlist::new(vec![Watch::named("/map").unwrap()]).unwrap());
        robot.domain.observer.input(Input::Watchlist(watched));
        for (number, topic) in [(1, MAP), (2, "rt/other")] {
            let guid = writer(1, number);
            robot.announce(guid, topic, TRANSIENT_LOCAL, 0);
            (1..=3).for_each(|number| robot.send(guid, number, 90_000));
        }
        robot.domain.wait(2_000);
        let mut snapshot = robot.domain.snapshot();
        let publishers = snapshot
            .topics
            .iter_mut()
            .flat_map(|topic| &mut topic.publishers);
        publishers.for_each(|publisher| publisher.latched = None);
        snapshot
            .tables
            .retain(|table| !table.table.starts_with("retained_"));
        format!("{snapshot:?}")
    };
    assert_eq!(figures(true), figures(false));
}

#[test]
fn messages_from_before_the_agent_are_kept_once_they_are_repeated() {
    let (mut robot, guid) = Robot::map_server(1);
    robot.domain.wait(5_000);
    assert!(robot.subscribe(7).is_empty());
    robot
        .domain
        .observer
        .input(Input::SampleRequests(Arc::default()));
    // A late joiner requests the history.
    robot.send_written(guid, 4, 100, START - SECOND);
    robot.send_written(guid, 3, 100, START - 2 * SECOND);
    assert_eq!(robot.subscribe(8), [(4, 100)]);
}

#[test]
fn a_restarted_writer_replaces_its_message_and_a_removed_writer_loses_it() {
    let (mut robot, guid) = Robot::map_server(1);
    robot.send(guid, 7, 700);
    robot.domain.wait(1_000);
    // The GUID is the same, as from a vendor that derives it from the process.
    robot.send(guid, 1, 100);
    assert_eq!(robot.subscribe(7), [(1, 100)]);
    let gone = Message::from(guid.prefix).dispose_by_hash(SEDP_WRITERS, 90, guid);
    robot.domain.put(gone);
    assert!(robot.subscribe(8).is_empty());
    assert_eq!(robot.domain.observer.latched_bytes(), 0);
    // Its process starts again, with another GUID.
    let next = writer(2, 1);
    robot.announce(next, MAP, TRANSIENT_LOCAL, 0);
    robot.send(next, 1, 252);
    assert_eq!(robot.subscribe(9), [(1, 252)]);
    let participant = Guid::new(next.prefix, EntityId::PARTICIPANT);
    let gone = Message::from(next.prefix).dispose_by_hash(SPDP, 91, participant);
    robot.domain.put(gone);
    assert!(robot.subscribe(10).is_empty());
}

#[test]
fn no_message_is_kept_if_it_is_volatile_or_expires_or_keeping_is_disabled() {
    let mut robot = Robot::new();
    let mut off = Robot::with(Settings {
        keeps_latched: false,
        ..Settings::default()
    });
    let writers = [(1, MAP, VOLATILE, 0), (2, "rt/rosout", TRANSIENT_LOCAL, 10)];
    for (number, topic, durability, lifespan) in writers {
        let guid = writer(1, number);
        robot.announce(guid, topic, durability, lifespan);
        robot.send(guid, 1, 100);
        assert_eq!(robot.facts(guid), None);
        assert_eq!(robot.verdict(guid), Some(Verdict::Ignore));
    }
    let guid = writer(1, 1);
    off.announce(guid, MAP, TRANSIENT_LOCAL, 0);
    off.send(guid, 1, 100);
    assert_eq!(
        (off.facts(guid), off.verdict(guid)),
        (None, Some(Verdict::Ignore))
    );
    assert!(robot.subscribe(7).is_empty() && off.subscribe(7).is_empty());
}

#[test]
fn a_message_above_the_cap_is_kept_only_for_a_watch_that_requests_it() {
    let (mut robot, guid) = Robot::map_server(1);
    let large = 3 * MESSAGE_BYTES + 1;
    robot.send(guid, 1, 100);
    assert_eq!(robot.verdict(guid), Some(Verdict::Capture));
    robot.send(guid, 2, large);
    let size = u32::try_from(large).unwrap();
    assert_eq!(robot.facts(guid), Some(LatchedFacts::TooLarge(size)));
    // Further messages are not captured.
    assert_eq!(robot.verdict(guid), Some(Verdict::Meter));
    assert!(robot.subscribe(7).is_empty());

    let asking = Watch {
        retain: Retain::Last,
        ..Watch::named("/map").unwrap()
    };
    let (mut robot, guid) = Robot::map_server(1);
    let watchlist = Watchlist::new(vec![asking]).unwrap();
    robot
        .domain
        .observer
        .input(Input::Watchlist(watchlist.into()));
    // The agent requests all messages for such a watch.
    let request = SampleRequest {
        id: 1 << 63,
        selection: Arc::new(Selection::named(["/map"]).unwrap()),
        domain_id: None,
        depth: Depth::Payloads,
    };
    robot
        .domain
        .observer
        .input(Input::SampleRequests(Arc::new(vec![request])));
    robot.send(guid, 1, large);
    robot.domain.observer.drain();
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(size)));
    assert_eq!(robot.subscribe(7), [(1, large)]);
}

#[test]
fn a_writer_above_its_budget_is_only_metered_until_it_pauses() {
    let (mut robot, guid) = Robot::map_server(1);
    let mut number = 0;
    let mut captured = 0;
    while robot.verdict(guid) != Some(Verdict::Meter) {
        number += 1;
        captured += 500_000;
        robot.send(guid, number, 500_000);
        robot.domain.wait(33);
        assert!(captured < 10 << 20, "{captured} bytes are captured");
    }
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Paused));
    assert!(robot.subscribe(7).is_empty());
    robot
        .domain
        .observer
        .input(Input::SampleRequests(Arc::default()));
    // After a minute, a whole message is allowed again.
    robot.domain.wait(90_000);
    assert_eq!(robot.verdict(guid), Some(Verdict::Capture));
    robot.send(guid, number + 1, 500_000);
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(500_000)));
}

#[test]
fn a_message_that_is_repeated_often_is_kept_until_another_one_follows() {
    let (mut robot, guid) = Robot::map_server(1);
    // Forty subscribers start at the same time.
    (0..40).for_each(|_| robot.send_written(guid, 1, 900_000, START));
    assert_eq!(robot.verdict(guid), Some(Verdict::Meter));
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(900_000)));
    robot.meter(guid, 1);
    assert_eq!(robot.subscribe(7), [(1, 900_000)]);
    robot
        .domain
        .observer
        .input(Input::SampleRequests(Arc::default()));
    robot.meter(guid, 2);
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Paused));
}

#[test]
fn a_fragmented_message_displaces_the_previous_one_and_is_kept_when_complete() {
    let (mut robot, guid) = Robot::map_server(1);
    robot.send(guid, 1, 100);
    let payload = payload(2, 150_000);
    let piece =
        |first| Message::from(guid.prefix).fragment(guid.entity, 2, first, FRAGMENT, &payload);
    robot.domain.put(piece(1));
    robot.domain.put(piece(3));
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Unseen));
    assert!(robot.subscribe(7).is_empty());
    robot
        .domain
        .observer
        .input(Input::SampleRequests(Arc::default()));
    robot.domain.put(piece(2));
    assert_eq!(robot.facts(guid), Some(LatchedFacts::Kept(150_000)));
}

#[test]
fn at_the_cap_in_bytes_the_largest_participant_loses_its_oldest_message() {
    let mut robot = Robot::new();
    let own = writer(1, 1);
    robot.announce(own, "rt/tf_static", TRANSIENT_LOCAL, 0);
    robot.send(own, 1, 1_000);
    let size = MESSAGE_BYTES - 100;
    for number in 1..=20 {
        let guid = writer(2, number);
        robot.announce(guid, &format!("rt/map_{number}"), TRANSIENT_LOCAL, 0);
        robot.send(guid, 1, size);
        robot.domain.wait(10_000);
        assert!(robot.domain.observer.latched_bytes() <= RetainedBytes::CAP);
    }
    let dropped = Some(LatchedFacts::NoRoom(u32::try_from(size).unwrap()));
    assert_eq!(robot.facts(own), Some(LatchedFacts::Kept(1_000)));
    assert!((1..=4).all(|number| robot.facts(writer(2, number)) == dropped));
    assert_eq!(robot.subscribe(7).len(), 1 + 16);
    let tables = robot.domain.snapshot().tables;
    let bytes = tables.iter().find(|table| table.table == "retained_bytes");
    assert_eq!(bytes.unwrap().evictions, 4);
    assert!(ledger()["retained_bytes"].is_driven());
}

#[test]
fn writers_beyond_the_cap_are_not_followed() {
    let mut robot = Robot::new();
    let cap = u16::try_from(RetainedWriters::CAP).unwrap();
    for number in 0..cap + 3 {
        robot.announce(writer(1, number), "rt/tf_static", TRANSIENT_LOCAL, 0);
    }
    assert_eq!(robot.facts(writer(1, cap - 1)), Some(LatchedFacts::Unseen));
    assert_eq!(robot.facts(writer(1, cap)), None);
    assert!(ledger()["retained_writers"].is_driven());
}

#[test]
fn the_last_message_of_a_zenoh_publisher_is_kept() {
    const TALKER: [u8; 16] = [0x11; 16];
    const KEY: &str = "0/map/std_msgs::msg::dds_::String_/TypeHashNotSupported";
    let now = 1_800_000_000 * SECOND;
    let mut observer = Observer::new(Settings::default());
    let [there, back] = connection(1000);
    report(
        &mut observer,
        &there,
        now,
        ros2probe_model::graph::zenoh::StreamEvent::Begin,
    );
    send(&mut observer, &there, now, &init(TALKER, Role::Peer, None));
    send(
        &mut observer,
        &back,
        now,
        &init([0x22; 16], Role::Router, Some(&[])),
    );
    send(&mut observer, &there, now, &open(60));
    send(&mut observer, &back, now, &open(60));
    // The token omits the default, reliable; 1 is transient local.
    let token = publisher(TALKER, 10, "/map").replace("/::,7:", "/:1:,7:");
    let declared = [declare_key(3, KEY), declare_token(1, &token)];
    send(&mut observer, &there, now, &frame(7, &declared));
    let gid = Gid::of_token(&token).0;
    for number in 1..=2 {
        let batch = frame(8, &[push(3, gid, number, &payload(number, 60))]);
        send(&mut observer, &there, now + number, &batch);
    }
    observer.input(Input::Time(Timestamp(now + SECOND)));
    assert_eq!(subscribe(&mut observer, 7), [(2, 60)]);
}
