//! Compares the memory of deliveries, all other entries and recordings with the table of limits.
//! The tests measure the resident memory of an otherwise idle process. nextest runs each test in
//! its own process; `cargo test` requires the filter `memory::`.

mod inside;

use std::fs;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use crate::allocator;
use ros2probe_bag::{Options, Storage, TopicDescription, Writer};
use ros2probe_capture::border::observe;
use ros2probe_daemon::agent_facts::{AgentFacts, SourceKind};
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_model::facts::limits::{Limit, Limits};
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_testing::model::host::{self, BOB, CapturePoint, Host};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

/// Locked while memory is measured, because tests may run concurrently in one process.
static MEASUREMENT_LOCK: Mutex<()> = Mutex::new(());

/// Returns the resident memory of this process in bytes.
fn resident() -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:"));
    let kibibytes = line.and_then(|line| line.split_whitespace().nth(1));
    1024 * kibibytes.unwrap().parse::<usize>().unwrap()
}

#[test]
fn an_idle_delivery_takes_less_than_1536_bytes() {
    const DELIVERIES: u64 = 500;
    const ROUNDS: u64 = 6;
    let mut worlds: Vec<_> = (0..ROUNDS).map(|_| Host::new()).collect();
    let address = worlds[0].reader(BOB, 7411);
    let at = |socket: u64| CapturePoint {
        socket,
        ..address.multicast(socket)
    };
    for world in &mut worlds {
        world.data(at(1), 1);
    }
    let before = allocator::held();
    for world in &mut worlds {
        // The writer is busy for longer than a gap stays open, then idle.
        for number in 2..=150 {
            (1..=DELIVERIES).for_each(|socket| world.data(at(socket), number));
            world.wait(100);
        }
        (0..20).for_each(|_| world.wait(1000));
        let tables = world.snapshot().tables;
        let row = tables.iter().find(|row| row.table == "deliveries");
        assert_eq!(row.unwrap().size, DELIVERIES);
    }
    let each = (allocator::held() - before) / usize::try_from(DELIVERIES * ROUNDS).unwrap();
    assert!((300..1536).contains(&each), "{each} bytes");
    println!("{each} bytes a delivery");
}

/// Returns the GUID prefix of a participant by its number.
fn prefix(number: usize) -> GuidPrefix {
    let [a, b, c, d] = u32::try_from(number).unwrap().to_be_bytes();
    GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, a, b, c, d])
}

/// Announces participants and endpoints up to their caps, with names of usual length. Returns the
/// writers.
fn announce_all(observer: &mut Observer, limits: &Limits, now: u64) -> Vec<Guid> {
    let mut put = |message: Message| {
        observer.input(Input::Datagram {
            envelope: &forge::multicast(now, 0),
            payload: &message.bytes(),
            handover: None,
        });
    };
    let each = limits.endpoints / limits.participants;
    let mut writers = Vec::new();
    for participant in 0..limits.participants {
        let payload = forge::participant(prefix(participant), 10_000, None);
        put(Message::from(prefix(participant)).data(SPDP, 1, &payload));
        for number in 0..each {
            let index = participant * each + number;
            let [_, _, high, low] = u32::try_from(number + 1).unwrap().to_be_bytes();
            let is_writer = index.is_multiple_of(2);
            let entity = EntityId([0, high, low, if is_writer { 3 } else { 4 }]);
            let guid = Guid::new(prefix(participant), entity);
            let topic = format!("rt/robot/sensor_{:04}/data_raw", index / 2 % limits.topics);
            let payload = forge::endpoint(guid, &topic, "sensor_msgs::msg::dds_::Imu_", true);
            let by = if is_writer {
                SEDP_WRITERS
            } else {
                SEDP_READERS
            };
            let number = number as u64 + 1;
            put(Message::from(prefix(participant)).data(by, number, &payload));
            writers.extend(is_writer.then_some(guid));
        }
    }
    writers
}

/// Sends 100 samples from each writer, ten per second, to separate sockets. Returns the time after
/// the last sample.
fn send_from_all(observer: &mut Observer, writers: &[Guid], mut now: u64) -> u64 {
    for number in 1..=100 {
        for (place, writer) in writers.iter().enumerate() {
            observe(
                observer,
                &Record {
                    kind: kind::DATA,
                    submessage_flags: 5,
                    writer: guid_words(*writer),
                    time: now,
                    sequence_number: number,
                    source_timestamp: now,
                    destination: [0, 0, u32::from_ne_bytes([0, 0, 0xff, 0xff]), 0x0100_000a],
                    destination_port: 7401,
                    datagram_len: 200,
                    payload_len: 100,
                    flags: flag::HOST,
                    socket: place as u64 + 1,
                    ..Record::default()
                },
            );
        }
        now += 100 * host::MILLISECOND;
        observer.input(Input::Time(Timestamp(now)));
    }
    now
}

/// Checks the table of limits for a robot at the caps of participants, endpoints, topics, unknown
/// writers and flows, with names of usual length. Two snapshots exist, and a metrics page is being
/// written.
#[test]
fn entries_take_at_most_the_documented_memory() {
    let _alone = MEASUREMENT_LOCK.lock().unwrap();
    let limits = Limits::default();
    let before = resident();
    let mut observer = Observer::new(Settings::default().with_limits(&limits));
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap(),
    )));
    observer.input(Input::Time(Timestamp(host::START)));
    let announced = announce_all(&mut observer, &limits, host::START);
    let mut writers: Vec<_> = (0..limits.unknown_writers)
        .map(|number| Guid::new(prefix(1 << 20 | number), EntityId([0, 0, 1, 3])))
        .collect();
    writers.extend(announced);
    let now = send_from_all(&mut observer, &writers, host::START);
    let modelled = resident() - before;
    let sources = MetricSources::new(
        SourceKind::Host,
        ros2probe_daemon::settings_cell::Settings {
            histograms: true,
            ..Default::default()
        },
    );
    let exposition = Exposition::new(sources.clone());
    let mut pages = Vec::new();
    let mut kept = Vec::new();
    for _ in 0..2 {
        let agent = AgentFacts::new(SourceKind::Host, Instant::now());
        let state = sources
            .latest
            .publish(observer.snapshot(Timestamp(now)), agent);
        sources.limits.note(&state);
        kept.push(sources.latest.state());
        pages.push(exposition.render(Format::Classic).unwrap());
    }
    let all = resident() - before;
    let mut reported = String::new();
    let mut expected = 0;
    for facts in sources.limits.facts(&sources.latest.state()) {
        let row = facts.limit.row();
        let is_modelled = matches!(
            facts.limit,
            Limit::Participants
                | Limit::Endpoints
                | Limit::Topics
                | Limit::UnknownWriters
                | Limit::Flows
        );
        if is_modelled {
            reported.push_str(&format!("{} {} of {}, ", row.key, facts.used, facts.cap));
            assert!(facts.used * 10 >= facts.cap * 9, "{reported}");
            expected += row.bytes * row.default;
        }
    }
    println!(
        "{reported}model {} KiB, with two snapshots and pages ({} KiB each) {} KiB, table {} KiB",
        modelled >> 10,
        pages[0].len() >> 10,
        all >> 10,
        expected >> 10
    );
    assert!(all <= expected, "{all} bytes, {expected} in the table");
    assert!(
        all * 3 >= expected,
        "the table says far too much: {all} of {expected}"
    );
}

/// Records as many topics as may be measured, with messages below and above a chunk's size,
/// compressed and not.
#[test]
fn a_recording_takes_at_most_the_documented_memory() {
    const BAGS: usize = 4;
    let _alone = MEASUREMENT_LOCK.lock().unwrap();
    let place = tempfile::tempdir().unwrap();
    let large: Vec<u8> = (0..3_000_000_u32).map(|at| (at / 7) as u8).collect();
    let before = resident();
    let mut most = before;
    let mut bags: Vec<_> = (0..BAGS)
        .map(|number| {
            let preset = ["", "zstd_fast", "fastwrite", ""][number];
            let mut options = Options {
                storage: Storage::preset(preset).unwrap(),
                max_index_bytes: Some(1 << 20),
                ..Options::default()
            };
            options.storage.chunk_bytes = 1 << 20;
            let path = place.path().join(format!("bag{number}"));
            let mut bag = Writer::create(&path, options).unwrap();
            let topics: Vec<_> = (0..Limits::default().topics)
                .map(|topic| {
                    let description = TopicDescription {
                        name: format!("/robot/sensor_{topic:04}/data_raw"),
                        type_name: "sensor_msgs/msg/Imu".to_owned(),
                        type_hash: None,
                        publishers: Vec::new(),
                        schema: None,
                    };
                    bag.topic(description).unwrap()
                })
                .collect();
            (bag, topics)
        })
        .collect();
    for round in 0..12_u64 {
        let at = Timestamp(host::START + round * 1_000_000_000);
        for (bag, topics) in &mut bags {
            for topic in topics.iter() {
                bag.write(*topic, at, at, round, &large[..2000]).unwrap();
            }
            bag.write(topics[0], at, at, round, &large).unwrap();
            bag.flush().unwrap();
            most = most.max(resident());
        }
    }
    let each = (most - before) / BAGS;
    let row = Limit::Recordings.row();
    println!("{} KiB each, {} in the table", each >> 10, row.bytes >> 10);
    assert!(
        each <= row.bytes,
        "{each} bytes, {} in the table",
        row.bytes
    );
    assert!(each * 8 >= row.bytes, "the table says far too much: {each}");
}

#[test]
fn all_limits_together_are_below_the_memory_limit_of_the_unit() {
    let unit = include_str!("../../../../systemd/ros2probe.service");
    let megabytes = unit
        .lines()
        .find_map(|line| line.strip_prefix("MemoryMax="));
    let allowed = megabytes.unwrap().strip_suffix('M').unwrap();
    let allowed = allowed.parse::<usize>().unwrap() << 20;
    let all = Limits::default().bytes()
        + Limits::CONSTANT_BYTES
        + Limits::ZENOH_BYTES
        + Limits::LATCHED_BYTES;
    let all = all
        + Limits::INSIDE_BYTES
        + Limits::TYPE_BYTES
        + Limits::ROBOT_BYTES
        + Limits::HISTORY_BYTES;
    assert!(all <= allowed, "{} of {} KiB", all >> 10, allowed >> 10);
}
