//! Triggered bags in virtual time: their span, their names, and the disk that they use.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant, SystemTime};

use ros2probe_bag::metadata::{self, Metadata};
use ros2probe_model::facts::calls::facts::Owner;
use ros2probe_model::facts::calls::report as inside;
use ros2probe_model::facts::calls::{late, other_thread};
use ros2probe_model::facts::churn;
use ros2probe_model::facts::diagnosis::{Diagnosis, TopicKey};
use ros2probe_model::facts::dispatch::{Dispatch, Sample, SampleOutcome};
use ros2probe_model::facts::event::{Event, EventKind, Taken};
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, Expansion, Guid, SequenceNumber, Timestamp};
use tempfile::TempDir;

use super::bag::{Cause, TriggeredBag};
use super::task::SnapshotTask;
use crate::config::SnapshotSettings;
use crate::events::{EventLog, Trigger};
use crate::recording::service::{Components, Recordings};
use crate::recording::{RecordingFigures, SnapshotFigures};
use crate::subscriptions::{Item, Missed, MissedReason, Selection, Subscriptions, Topic};

const TENTH: u64 = SECOND / 10;

/// A snapshot of one topic with ten messages a second, whose numbers are tenths of seconds.
struct Robot {
    directory: TempDir,
    events: Arc<EventLog>,
    figures: Arc<RecordingFigures>,
    recordings: Arc<Recordings>,
    subscriptions: Arc<Subscriptions>,
    task: SnapshotTask,
    topic: Arc<Topic>,
    now: u64,
    payload: usize,
}

fn settings(triggers: &[&str], before: u64, after: u64) -> SnapshotSettings {
    SnapshotSettings {
        name: "incident".to_owned(),
        topics: vec!["/imu".to_owned()],
        domain_id: 0,
        before: Duration::from_secs(before),
        after: Duration::from_secs(after),
        max_bytes: 1 << 20,
        triggers: triggers
            .iter()
            .map(|name| Trigger::parse(name).unwrap())
            .collect(),
        min_interval: Duration::ZERO,
        max_count: 20,
        max_total_bytes: 1 << 30,
    }
}

impl Robot {
    fn new(settings: SnapshotSettings) -> Self {
        Self::with_receipts(settings, None)
    }

    fn with_receipts(settings: SnapshotSettings, receipts: Option<&Path>) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let components = Components {
            receipts: receipts.map(Path::to_owned),
            ..Components::in_directory(directory.path())
        };
        let (events, figures) = (
            Arc::clone(&components.events),
            Arc::clone(&components.figures),
        );
        let subscriptions = Arc::clone(&components.subscriptions);
        let recordings = Arc::new(Recordings::new(components));
        let topic = Topic {
            domain_id: DomainId(0),
            name: "/imu".into(),
            dds_name: "rt/imu".into(),
            message_type: "std_msgs/msg/String".into(),
            offered: None,
        };
        Self {
            directory,
            events,
            figures,
            task: SnapshotTask::new(settings, Arc::clone(&recordings)),
            recordings,
            subscriptions,
            topic: Arc::new(topic),
            now: 100 * SECOND / TENTH,
            payload: 64,
        }
    }

    /// Publishes for some tenths of a second.
    fn run(&mut self, tenths: u64) {
        for _ in 0..tenths {
            let sample = self.next_sample();
            self.task.take(Item::Sample(sample));
            self.pass();
        }
    }

    fn next_sample(&mut self) -> Arc<Sample> {
        self.now += 1;
        Arc::new(Sample {
            topic: Arc::clone(&self.topic),
            time: self.time(),
            writer: Guid::default(),
            sequence_number: SequenceNumber(self.now),
            source_timestamp: None,
            header_stamp: None,
            size: 64,
            sampled: false,
            payload: Some(vec![0; self.payload].into()),
        })
    }

    fn pass(&mut self) {
        self.task.take(Item::Clock(self.time()));
        self.task.read_events();
    }

    fn time(&self) -> Timestamp {
        Timestamp(self.now * TENTH)
    }

    /// Records an event at the current time.
    fn event(&self, kind: EventKind) {
        let at = self.time();
        let events = vec![Event { at, kind }];
        let overflow = Vec::new();
        self.events.add(Taken { events, overflow }, at);
    }

    fn lose_messages(&self) {
        self.events.lose_messages(3, self.time(), self.time());
    }

    fn lose_participant(&self, change: churn::Event, domain: u32) {
        self.event(EventKind::Participant {
            change,
            domain_id: DomainId(domain),
            guid: Guid::default(),
            vendor: VendorId([1, 15]),
            host: None,
            process: Some("driver".into()),
        });
    }

    /// Returns the sequence numbers in each bag, by the bag's name.
    fn bags(&self) -> BTreeMap<String, Vec<u64>> {
        let bags = std::fs::read_dir(self.directory.path()).unwrap();
        let bags = bags.map(|bag| bag.unwrap());
        bags.map(|bag| {
            let name = bag.file_name().into_string().unwrap();
            (name, numbers(&bag.path()))
        })
        .collect()
    }

    fn only_bag(&self) -> Vec<u64> {
        let bags: Vec<_> = self.bags().into_values().collect();
        let [bag] = bags.as_slice() else {
            panic!("{bags:?}");
        };
        bag.clone()
    }

    fn bytes(&self) -> u64 {
        let bags = std::fs::read_dir(self.directory.path()).unwrap();
        let files = bags.flat_map(|bag| std::fs::read_dir(bag.unwrap().path()).unwrap());
        files
            .map(|file| file.unwrap().metadata().unwrap().len())
            .sum()
    }

    /// Reports messages as lost at the current time.
    fn miss(&mut self, first: u64, last: u64) {
        self.task.take(Item::Missed(Missed {
            topic: Arc::clone(&self.topic),
            writer: Guid::default(),
            first: SequenceNumber(first),
            last: SequenceNumber(last),
            samples: last - first + 1,
            reason: MissedReason::Lost,
        }));
    }

    /// Returns first and last number of the runs that the report of the only bag names as missing.
    fn missing(&self) -> Vec<(u64, u64)> {
        let bag = std::fs::read_dir(self.directory.path()).unwrap().next();
        let file = bag.unwrap().unwrap().path().join(metadata::FILE_NAME);
        let metadata = Metadata::read(&std::fs::read_to_string(file).unwrap()).unwrap();
        let report = &metadata.custom_data[crate::recording::report::CUSTOM_DATA];
        let report: serde_json::Value = serde_json::from_str(report).unwrap();
        let runs = report["missing_runs"].as_array().unwrap().iter();
        let number = |run: &serde_json::Value, end: &str| run[end].as_u64().unwrap();
        runs.map(|run| {
            (
                number(run, "first_sequence_number"),
                number(run, "last_sequence_number"),
            )
        })
        .collect()
    }

    fn shown(&mut self) -> SnapshotFigures {
        self.task.publish_figures();
        self.figures.snapshots()[0].1
    }

    fn trigger_of(&self, bag: &str) -> serde_json::Value {
        let file = self.directory.path().join(bag).join(metadata::FILE_NAME);
        let metadata = Metadata::read(&std::fs::read_to_string(file).unwrap()).unwrap();
        serde_json::from_str(&metadata.custom_data["ros2probe_trigger"]).unwrap()
    }
}

/// Returns the sequence numbers of all messages of a bag.
fn numbers(bag: &Path) -> Vec<u64> {
    let mut numbers = Vec::new();
    let files = std::fs::read_dir(bag)
        .unwrap()
        .map(|file| file.unwrap().path());
    for file in files.filter(|file| file.extension().is_some_and(|it| it == "mcap")) {
        ros2probe_bag::read::scan(&file, Expansion::Limited, &mut |message, _| {
            numbers.push(u64::from(message.sequence));
        })
        .unwrap();
    }
    numbers.sort_unstable();
    numbers
}

#[test]
fn a_bag_has_the_seconds_around_its_event_and_names_the_event() {
    let mut robot = Robot::new(settings(&["message_lost"], 3, 2));
    robot.run(100);
    let incident = robot.now;
    robot.lose_messages();
    robot.run(10);
    assert_eq!(robot.figures.snapshots().len(), 0, "the bag is still open");
    robot.run(30);
    let expected: Vec<u64> = (incident - 30..=incident + 20).collect();
    assert_eq!(robot.only_bag(), expected);
    let bags = robot.bags();
    let trigger = robot.trigger_of(bags.keys().next().unwrap());
    assert_eq!(trigger["snapshot"], "incident");
    assert_eq!(trigger["trigger"], "message_lost");
    assert_eq!(trigger["event"], "ros2.message.lost");
    assert_eq!(trigger["attributes"]["count"], 3, "{trigger}");
    let bag = TriggeredBag::read(&robot.directory.path().join(bags.keys().next().unwrap()));
    let bag = bag.unwrap();
    assert_eq!(bag.snapshot, "incident");
    assert_eq!(bag.trigger.event, "ros2.message.lost");
    assert_eq!(trigger["time"], bag.trigger.time);
    assert_eq!(
        bag.trigger.topic.as_deref(),
        trigger["attributes"]["topic"].as_str()
    );
    let taken = robot.events.read(0, 10).records.pop().unwrap();
    assert_eq!(taken.definition.name, "ros2probe.snapshot.taken");
    let attribute = |name| serde_json::to_value(taken.attribute(name).unwrap()).unwrap();
    assert_eq!(attribute("trigger"), "message_lost");
    assert_eq!(attribute("trigger_event_id"), trigger["event_id"]);
    assert_eq!(attribute("messages"), 51);
}

#[test]
fn a_bag_names_the_messages_that_were_missing_before_its_event() {
    let mut robot = Robot::new(settings(&["message_lost"], 3, 2));
    robot.run(50);
    robot.miss(10, 12);
    robot.run(50);
    robot.miss(70, 71);
    robot.run(10);
    robot.miss(80, 82);
    robot.lose_messages();
    robot.run(10);
    robot.miss(90, 90);
    robot.run(20);
    assert_eq!(robot.missing(), [(70, 71), (80, 82), (90, 90)]);
}

#[test]
fn reports_of_missing_messages_beyond_their_cap_are_counted() {
    let mut robot = Robot::new(settings(&["message_lost"], 3, 2));
    robot.run(30);
    for number in 0..1034 {
        robot.miss(2 * number + 1, 2 * number + 1);
    }
    assert_eq!(robot.shown().evicted, 10);
}

#[test]
fn a_clock_that_is_set_back_does_not_end_the_collection_of_messages() {
    let mut robot = Robot::new(settings(&[], 3, 0));
    robot.run(100);
    robot.now -= 900;
    robot.run(50);
    let (last, expected) = (robot.now, (robot.now - 30..=robot.now).collect::<Vec<_>>());
    robot.task.write_memory(Cause::Request).unwrap();
    assert_eq!(robot.only_bag(), expected);
    assert!(
        robot.shown().messages <= 60,
        "{last}: those of before are evicted"
    );
}

/// An event arrives up to two seconds after the incident; the bag reaches back from the incident.
#[test]
fn a_late_event_does_not_shorten_the_time_before_the_incident() {
    let mut robot = Robot::new(settings(&["message_lost"], 3, 2));
    robot.run(100);
    let incident = robot.time();
    let number = robot.now;
    robot.run(15);
    robot.events.lose_messages(1, incident, robot.time());
    robot.run(30);
    let expected: Vec<u64> = (number - 30..=number + 20).collect();
    assert_eq!(robot.only_bag(), expected);
}

/// In a replay, the log of events may be ahead of the messages.
#[test]
fn an_event_ahead_of_the_messages_selects_the_same_messages() {
    let mut robot = Robot::new(settings(&["message_lost"], 3, 2));
    robot.run(20);
    let early = robot.now;
    robot.now += 100;
    let incident = robot.now;
    robot.lose_messages();
    robot.now = early;
    robot.run(150);
    let expected: Vec<u64> = (incident - 30..=incident + 20).collect();
    assert_eq!(robot.only_bag(), expected);
}

#[test]
fn a_short_name_matches_problems_of_the_domain_and_a_full_name_every_event() {
    let mut robot = Robot::new(settings(&["participant_lost"], 1, 0));
    robot.run(20);
    robot.lose_participant(churn::Event::Disposed, 0);
    robot.lose_participant(churn::Event::Expired, 1);
    robot.run(20);
    assert!(robot.bags().is_empty());
    robot.lose_participant(churn::Event::Expired, 0);
    robot.run(1);
    assert_eq!(robot.bags().len(), 1);

    let mut robot = Robot::new(settings(&["ros2.participant.lost"], 1, 0));
    robot.run(20);
    robot.lose_participant(churn::Event::Disposed, 0);
    robot.run(1);
    assert_eq!(robot.bags().len(), 1);
}

#[test]
fn a_new_finding_triggers_the_snapshots_of_its_kind() {
    let topic = TopicKey {
        domain_id: DomainId(0),
        dds_name: "rq/addRequest".into(),
        name: "/add".into(),
        kind: TopicKind::ServiceRequest,
    };
    let writer = Guid::default();
    let hanging = Diagnosis::HangingCall { topic, writer };
    let duplicate = Diagnosis::DuplicateNode {
        domain_id: DomainId(0),
        node: "/driver".into(),
        participants: Vec::new(),
    };
    let topic = TopicKey {
        domain_id: DomainId(0),
        dds_name: "rt/cmd".into(),
        name: "/cmd".into(),
        kind: TopicKind::Topic,
    };
    let owner = Owner {
        process: 70,
        handle: 1,
        domain_id: DomainId(0),
        node: Some("/driver".into()),
    };
    let period = Duration::from_millis(50);
    let of_inside_and_chains = [
        Diagnosis::SlowCallback {
            topic: None,
            callback: owner.clone(),
            trigger: inside::Trigger::Timer(Some(period)),
            duration: period * 2,
            period,
            is_own_period: true,
        },
        Diagnosis::ExecutorWait {
            topic: None,
            callback: owner.clone(),
            trigger: inside::Trigger::Timer(Some(period)),
            wait: period * 2,
        },
        Diagnosis::LateCallback {
            topic: None,
            callback: owner.clone(),
            trigger: inside::Trigger::Timer(Some(period)),
            calls: 3,
            stage: late::Stage::Callback,
            cause: late::Cause::Runnable,
            by: Some(other_thread::ThreadLabel {
                name: "chromium".into(),
                unit: Some("kiosk.service".into()),
            }),
            longest: period * 2,
        },
        Diagnosis::IntraProcessOverflow {
            topic: topic.clone(),
            queue: owner.clone(),
            overwritten_permille: 10,
        },
        Diagnosis::ReaderQueueOverflow {
            topic: topic.clone(),
            queue: owner,
            lost_permille: 10,
            depth: None,
        },
        Diagnosis::ObservationSuspended {
            domain_id: DomainId(0),
            process: 70,
            name: None,
        },
        Diagnosis::RestampingNode {
            topic: topic.clone(),
            node: "/driver".into(),
            input: "/scan".into(),
        },
        Diagnosis::SlowChain {
            topic,
            from: "/scan".into(),
            max_latency: period,
        },
    ];
    for finding in of_inside_and_chains.into_iter().chain([hanging, duplicate]) {
        let mut robot = Robot::new(settings(&[finding.kind()], 1, 0));
        robot.run(20);
        let mut change = |resolved| {
            let finding = finding.clone();
            robot.event(EventKind::Diagnosis { resolved, finding });
            robot.run(1);
            robot.bags().len()
        };
        assert_eq!((change(true), change(false)), (0, 1), "{finding:?}");
    }
}

#[test]
fn a_thousand_triggers_in_a_minute_use_bounded_disk_space() {
    let limit = 200_000;
    let mut robot = Robot::new(SnapshotSettings {
        max_count: 3,
        max_total_bytes: limit,
        ..settings(&["message_lost"], 1, 1)
    });
    robot.payload = 2000;
    robot.run(20);
    for _ in 0..600 {
        robot.lose_messages();
        robot.lose_messages();
        robot.run(1);
        assert!(robot.bags().len() <= 4 && robot.bytes() <= limit);
    }
    robot.run(20);
    let figures = robot.shown();
    // Each bag takes a second. The other triggers do not begin a bag.
    assert!((50..=60).contains(&figures.written), "{figures:?}");
    assert_eq!(figures.suppressed + figures.written, 1200, "{figures:?}");
    let bags = robot.bags();
    assert!((1..=3).contains(&bags.len()), "{:?}", bags.keys());
    assert_eq!(figures.removed + bags.len() as u64, figures.written);
    // The newest bags remain.
    let last = bags.values().filter_map(|numbers| numbers.last()).max();
    assert!(last.is_some_and(|last| *last + 40 > robot.now));
    assert!(robot.bytes() <= limit, "{}", robot.bytes());
}

#[test]
fn triggers_within_the_minimum_interval_begin_no_bag() {
    let mut robot = Robot::new(SnapshotSettings {
        min_interval: Duration::from_secs(20),
        ..settings(&["message_lost"], 1, 0)
    });
    robot.run(20);
    for _ in 0..60 {
        robot.lose_messages();
        robot.run(10);
    }
    assert_eq!(robot.shown().written, 3);
    assert_eq!(robot.shown().suppressed, 57);
}

#[test]
fn a_requested_bag_is_never_removed_for_others() {
    let mut robot = Robot::new(SnapshotSettings {
        max_count: 1,
        max_total_bytes: 100_000,
        ..settings(&["message_lost"], 1, 0)
    });
    robot.run(20);
    let requested = robot.task.write_memory(Cause::Request).unwrap().name;
    for _ in 0..5 {
        robot.lose_messages();
        robot.run(1);
    }
    let bags = robot.bags();
    assert!(bags.len() == 2 && bags.contains_key(&requested), "{bags:?}");
    // Requested bags that use up the space are kept, too, and the error names the limit.
    robot.payload = 4000;
    robot.run(20);
    let mut results = (0..5).map(|_| robot.task.write_memory(Cause::Request));
    let refused = results.find_map(Result::err).unwrap().to_string();
    assert!(refused.contains("max_total_bytes"), "{refused}");
    assert!(robot.bags().contains_key(&requested));
    assert!(robot.shown().failed >= 1);
}

/// Writes the receipt of `rp ship` for a bag.
fn deliver(state: &Path, bag: &Path) {
    let mut files: Vec<_> = std::fs::read_dir(bag)
        .unwrap()
        .map(|entry| {
            let entry = entry.unwrap();
            let about = entry.metadata().unwrap();
            let changed = about.modified().unwrap();
            let changed = changed.duration_since(SystemTime::UNIX_EPOCH).unwrap();
            let name = entry.file_name().into_string().unwrap();
            (name, about.len(), changed.as_nanos())
        })
        .collect();
    files.sort();
    let lines = files
        .iter()
        .map(|(name, bytes, changed)| format!("{bytes} {changed} {name}\n"));
    let directory = state.join("ship/bags");
    std::fs::create_dir_all(&directory).unwrap();
    let name = bag.file_name().unwrap().to_str().unwrap();
    let receipt = directory.join(format!("{name}.receipt"));
    std::fs::write(receipt, lines.collect::<String>()).unwrap();
}

#[test]
fn a_bag_that_was_not_delivered_is_never_removed_for_others() {
    let state = tempfile::tempdir().unwrap();
    let few = SnapshotSettings {
        max_count: 1,
        ..settings(&["message_lost"], 1, 0)
    };
    let mut robot = Robot::with_receipts(few, Some(state.path()));
    robot.run(20);
    for _ in 0..3 {
        robot.lose_messages();
        robot.run(1);
    }
    let before: Vec<_> = robot.bags().into_keys().collect();
    assert_eq!(before.len(), 3);
    deliver(state.path(), &robot.directory.path().join(&before[1]));
    robot.lose_messages();
    robot.run(1);
    let after: Vec<_> = robot.bags().into_keys().collect();
    assert!(!after.contains(&before[1]), "{after:?}");
    assert!(after.contains(&before[0]) && after.contains(&before[2]));
    assert_eq!(after.len(), 3);
}

#[test]
fn bags_of_a_clock_that_was_ahead_are_the_oldest_ones() {
    let mut robot = Robot::new(SnapshotSettings {
        max_count: 2,
        ..settings(&["message_lost"], 1, 0)
    });
    robot.run(20);
    let incident = |robot: &mut Robot| {
        let before = robot.bags();
        robot.lose_messages();
        robot.run(1);
        let mut bags = robot.bags().into_keys();
        bags.find(|bag| !before.contains_key(bag)).unwrap()
    };
    let ahead = [incident(&mut robot), incident(&mut robot)];
    let future = SystemTime::now() + Duration::from_secs(86_400);
    for bag in &ahead {
        let bag = std::fs::File::open(robot.directory.path().join(bag)).unwrap();
        bag.set_modified(future).unwrap();
    }
    let third = incident(&mut robot);
    let fourth = incident(&mut robot);
    let mut expected = vec![third, fourth];
    expected.sort();
    assert!(robot.bags().into_keys().eq(expected));
}

#[test]
fn a_bag_with_an_oversized_metadata_file_is_kept() {
    let mut robot = Robot::new(SnapshotSettings {
        max_count: 1,
        ..settings(&["message_lost"], 1, 0)
    });
    robot.run(20);
    robot.lose_messages();
    robot.run(1);
    let first = robot.bags().into_keys().next().unwrap();
    let file = robot
        .directory
        .path()
        .join(&first)
        .join(metadata::FILE_NAME);
    let mut text = std::fs::read_to_string(&file).unwrap();
    text.push_str(&"# a comment\n".repeat(100_000));
    std::fs::write(&file, text).unwrap();
    for _ in 0..3 {
        robot.lose_messages();
        robot.run(1);
    }
    let bags = robot.bags();
    assert!(bags.len() == 2 && bags.contains_key(&first), "{bags:?}");
}

#[test]
fn a_bag_that_reaches_its_limit_after_the_event_keeps_its_messages() {
    let mut robot = Robot::new(SnapshotSettings {
        max_total_bytes: 100_000,
        ..settings(&["message_lost"], 1, 60)
    });
    robot.payload = 4000;
    robot.run(20);
    let incident = robot.now;
    robot.lose_messages();
    robot.run(100);
    let bag = robot.only_bag();
    assert!(
        bag.contains(&(incident - 10)) && bag.contains(&incident),
        "{bag:?}"
    );
    let bytes = robot.bytes();
    assert!(bag.len() < 30 && bytes <= 100_000, "{} {bytes}", bag.len());
    assert_eq!((robot.shown().failed, robot.shown().written), (1, 0));
}

#[test]
fn an_agent_that_stops_completes_the_open_bag() {
    let mut robot = Robot::new(settings(&["message_lost"], 1, 600));
    robot.run(20);
    robot.lose_messages();
    robot.run(5);
    robot.task.complete(None);
    assert_eq!(robot.only_bag().len(), 16);
    assert_eq!(robot.shown().written, 1);
}

/// Returns the processor time of this thread in ticks, of which a second has 100.
fn ticks_of_this_thread() -> u64 {
    let text = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
    let (_, fields) = text.rsplit_once(") ").unwrap();
    let ticks = fields.split(' ').skip(11).take(2);
    ticks.map(|ticks| ticks.parse::<u64>().unwrap()).sum()
}

/// Earlier, the thread used a whole processor from the end of a replay on, and recorded nothing
/// after the replay had gone back.
#[test]
fn a_snapshot_sleeps_at_the_end_of_a_replay_and_continues_when_it_goes_back() {
    let mut robot = Robot::new(settings(&[], 3, 0));
    let [first, second, third] = [(); 3].map(|()| Dispatch {
        to: [1].into(),
        outcome: SampleOutcome::Sample(robot.next_sample()),
    });
    let Robot {
        directory,
        figures,
        recordings,
        subscriptions,
        task,
        ..
    } = robot;
    let selection = Selection::named(["/imu"]).unwrap();
    let subscription = recordings.open(selection, 0, "incident").unwrap();
    let (_clients, waiting) = sync_channel(1);
    let stop = Arc::new(AtomicBool::new(false));
    let stopping = Arc::clone(&stop);
    let thread = std::thread::spawn(move || {
        task.run(subscription, &waiting, &AtomicBool::new(false), &stopping);
        ticks_of_this_thread()
    });
    let wait_for = |messages| {
        let deadline = Instant::now() + Duration::from_secs(60);
        let is_reached = || {
            let snapshots = figures.snapshots();
            snapshots
                .iter()
                .any(|(_, shown)| shown.messages == messages)
        };
        while !is_reached() {
            assert!(Instant::now() < deadline, "{messages} messages");
            std::thread::sleep(Duration::from_millis(10));
        }
    };
    subscriptions.deliver(vec![first, second], None);
    subscriptions.end("end of capture");
    wait_for(2);
    std::thread::sleep(Duration::from_secs(1));
    subscriptions.begin_again();
    subscriptions.deliver(vec![third], None);
    // The messages of the first pass are not of the same time.
    wait_for(1);
    stop.store(true, Ordering::Relaxed);
    let ticks = thread.join().unwrap();
    assert!(ticks < 50, "{ticks}");
    drop(directory);
}

#[test]
fn every_name_of_a_trigger_parses_and_snapshots_do_not_trigger_themselves() {
    let names: Vec<_> = Trigger::names().collect();
    assert!(names.len() > 30);
    for name in names {
        assert_eq!(Trigger::parse(name).unwrap().name(), name);
    }
    for name in ["ros2probe.snapshot.taken", "violation", ""] {
        assert_eq!(Trigger::parse(name), None);
    }
}
