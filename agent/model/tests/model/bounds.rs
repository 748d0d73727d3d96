//! Forged messages in which every field varies fill every table, but none beyond its cap.

mod calls;
mod chains;
mod inside;
mod links;
mod robot;
mod zenoh;

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::allocator;
use ros2probe_capture::border::observe;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::limits::Limits;
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::facts::tables;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::measure::history::History;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::SocketFacts;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

const START: u64 = 1_700_000_000_000_000_000;
/// The documented caps, each with the test that exceeds it.
const DRIVEN: &str = include_str!("../../../cli/tests/surface/limits/driven.txt");
/// Seconds of the history.
const SECONDS: usize = 20;
const DISCOVERY_INFO: EntityId = EntityId([0, 0, 2, 3]);
const ALICE: GuidPrefix = GuidPrefix([1; 12]);
const SAMPLES: EntityId = EntityId([0, 0, 3, 3]);

/// Reproducible random numbers (xorshift64).
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn pick(&mut self, sides: u64) -> u64 {
        (self.roll() >> 20) % sides
    }

    fn prefix(&mut self) -> GuidPrefix {
        // Half of the numbers repeat a few existing ones.
        let number = match self.pick(2) {
            0 => self.pick(40),
            _ => self.roll(),
        };
        let mut prefix = [7; 12];
        prefix[4..].copy_from_slice(&number.to_be_bytes());
        GuidPrefix(prefix)
    }

    fn locators(&mut self) -> Vec<SocketAddrV4> {
        let any = (0..20).map(|_| self.roll());
        any.map(|bits| SocketAddrV4::new(Ipv4Addr::from(bits as u32 | 1), (bits >> 40) as u16 | 1))
            .collect()
    }

    fn number(&mut self) -> u64 {
        match self.pick(4) {
            0 => self.roll() >> 2,
            1 => 1 << self.pick(62),
            _ => 1 + self.pick(5000),
        }
    }

    fn name(&mut self) -> String {
        format!(
            "rt/{:x}/{}",
            self.roll(),
            "x".repeat(self.pick(200) as usize)
        )
    }
}

fn words(number: u64) -> [u8; 8] {
    let high = ((number >> 32) as u32).to_le_bytes();
    let low = (number as u32).to_le_bytes();
    [high, low].concat().try_into().unwrap()
}

/// Returns a HEARTBEAT, GAP or ACKNACK with random numbers.
fn control(dice: &mut Dice, id: u8) -> Vec<u8> {
    let [_, a, b, c, ..] = dice.roll().to_ne_bytes();
    let reader = EntityId([a, b, c, 4]);
    let mut body = [reader.0, SAMPLES.0].concat();
    body.extend_from_slice(&words(dice.number()));
    if id != 0x06 {
        body.extend_from_slice(&words(dice.number()));
    }
    if id != 0x07 {
        body.extend_from_slice(&256_u32.to_le_bytes());
        body.extend((0..4).flat_map(|_| dice.roll().to_ne_bytes()));
    }
    body.extend_from_slice(&(dice.roll() as u32).to_le_bytes());
    body
}

fn forged(dice: &mut Dice) -> Vec<u8> {
    let prefix = dice.prefix();
    let message = Message::from(prefix);
    match dice.pick(14) {
        0 | 1 => {
            let payload =
                forge::participant_at(prefix, 100, Some(dice.roll() as u32), &dice.locators());
            message.data(SPDP, dice.number(), &payload)
        }
        kind @ (2 | 3) => {
            let (by, last) = [(SEDP_WRITERS, 3), (SEDP_READERS, 4)][kind as usize - 2];
            let [_, a, b, c, ..] = dice.roll().to_ne_bytes();
            let guid = Guid::new(prefix, EntityId([a, b, c, last]));
            let (topic, partition) = (dice.name(), "p".repeat(dice.pick(250) as usize));
            let text = [
                &(partition.len() as u32 + 1).to_le_bytes()[..],
                partition.as_bytes(),
                b"\0",
            ];
            let partitions = [&1_u32.to_le_bytes()[..], &text.concat()].concat();
            let others: [(u16, &[u8]); 1] = [(0x29, &partitions)];
            let payload = forge::endpoint_with(guid, &topic, &dice.name(), &others);
            message.data(by, dice.number(), &payload)
        }
        4 => {
            let guid = Guid::new(prefix, SAMPLES);
            let payload = forge::endpoint(guid, "rt/known", &dice.name(), true);
            message.data(SEDP_WRITERS, dice.number(), &payload)
        }
        5 => {
            let names: Vec<_> = (0..dice.pick(60))
                .map(|_| format!("n{:x}", dice.roll()))
                .collect();
            let mut guid = || Guid::new(prefix, EntityId([0, 0, dice.roll() as u8, 3]));
            let mut nodes = Vec::new();
            for name in &names {
                nodes.push(("/somewhere", name.as_str(), guid()));
            }
            let payload = forge::entities(prefix, 24, &nodes);
            message.data(DISCOVERY_INFO, dice.number(), &payload)
        }
        6 | 7 => {
            let number = dice.number();
            message.info_ts(START + dice.pick(1 << 60)).data(
                SAMPLES,
                number,
                &[0, 1, 0, 0, 5, 5, 5, 5],
            )
        }
        8 => {
            let size = 100 + dice.pick(60_000) as usize;
            let payload = vec![5; size];
            message.fragment(SAMPLES, dice.number(), 1, 64, &payload)
        }
        9 => message.submessage(0x07, 1, &control(dice, 0x07)),
        10 => message.submessage(0x08, 1, &control(dice, 0x08)),
        11 => {
            let guid = Guid::new(prefix, SAMPLES);
            message.dispose_by_hash(SEDP_WRITERS, dice.number(), guid)
        }
        12 => {
            // The announcements are never complete.
            let payload = vec![5; 100 + dice.pick(20_000) as usize];
            message.fragment(SEDP_WRITERS, dice.number(), 1, 64, &payload)
        }
        _ => message.submessage(0x06, 1, &control(dice, 0x06)),
    }
    .bytes()
}

fn observer() -> Observer {
    let mut observer = Observer::new(Settings::default());
    let mut watch = Watch::named("/**").unwrap();
    watch.trace = 1.0;
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![watch]).unwrap(),
    )));
    observer.input(Input::SampleRequests(Arc::new(vec![SampleRequest {
        id: 1,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth: Depth::Payloads,
    }])));
    observer.input(Input::Time(Timestamp(START)));
    observer
}

fn somewhere(dice: &mut Dice, time: u64) -> Envelope {
    let mut envelope = forge::multicast(time, dice.pick(300) as u16 % 200);
    if dice.pick(2) == 0 {
        envelope.destination[12..].copy_from_slice(&(dice.roll() as u32).to_be_bytes());
        envelope.destination_port = dice.roll() as u16;
    }
    envelope
}

/// One step of a test, with the model, random numbers and the time.
type Step<'a> = &'a mut dyn FnMut(&mut Observer, &mut Dice, u64);

/// Runs the model with a step every `pause` nanoseconds. Returns the growth of the heap.
fn drive(messages: u64, pause: u64, step: Step<'_>) -> usize {
    let begin = Instant::now();
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    let before = allocator::held();
    let mut observer = observer();
    let mut history = History::new(
        Duration::from_secs(SECONDS as u64),
        Limits::default().topics,
    );
    let (mut half, mut now) = (0, START);
    for turn in 0..messages {
        now += pause;
        step(&mut observer, &mut dice, now);
        if turn % 2_000 == 0 {
            observer.input(Input::Time(Timestamp(now)));
            history.take(Timestamp(now), observer.measured(Timestamp(now)));
            observer.drain();
        }
        if turn == messages / 2 {
            half = allocator::held().saturating_sub(before);
        }
    }
    let whole = allocator::held().saturating_sub(before);
    let time = begin.elapsed();
    println!("{half} bytes after half of it, {whole} at the end, in {time:?}");
    whole
}

/// Asserts that these tables were filled to at least nine tenths of their caps.
fn assert_filled(tables: &[&str]) {
    let ledger = ledger();
    let used = tables.iter().map(|table| (table, ledger[table]));
    let unfilled: Vec<_> = used
        .filter(|(_, used)| used.largest * 10 < used.cap * 9)
        .collect();
    assert!(unfilled.is_empty(), "{unfilled:?}");
}

fn any_datagram(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let mut message = forged(dice);
    if dice.pick(20) == 0 {
        let at = dice.pick(message.len() as u64) as usize;
        message[at] ^= 0x55;
    }
    let envelope = somewhere(dice, now);
    observer.input(Input::Datagram {
        envelope: &envelope,
        payload: &message,
        handover: None,
    });
}

fn readers_of(number: u64) -> GuidPrefix {
    let mut prefix = [2; 12];
    prefix[4..].copy_from_slice(&number.to_be_bytes());
    GuidPrefix(prefix)
}

/// Announces one reliable writer, and 600 participants with readers of its topic.
fn announce_one_writer(observer: &mut Observer) {
    let mut put = |message: Message| {
        let envelope = forge::multicast(START, 0);
        observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    };
    let string = "std_msgs::msg::dds_::String_";
    let payload = forge::participant(ALICE, 1_000_000, Some(0));
    put(Message::from(ALICE).data(SPDP, 1, &payload));
    let payload = forge::endpoint(Guid::new(ALICE, SAMPLES), "rt/known", string, true);
    put(Message::from(ALICE).data(SEDP_WRITERS, 1, &payload));
    for number in 0..600 {
        let prefix = readers_of(number);
        let payload = forge::participant(prefix, 1_000_000, Some(0));
        put(Message::from(prefix).data(SPDP, 1, &payload));
        let reader = Guid::new(prefix, EntityId([0, 0, 1, 4]));
        let payload = forge::endpoint(reader, "rt/known", string, true);
        put(Message::from(prefix).data(SEDP_READERS, 1, &payload));
    }
}

/// Returns a kernel record of one writer's samples in which every field varies, with numbers around
/// `newest`.
fn forged_record(dice: &mut Dice, newest: u64, now: u64) -> Record {
    const KINDS: [u8; 7] = [
        kind::DATA,
        kind::DATA,
        kind::DATA_FRAG,
        kind::DATA_FRAG,
        kind::ACKNACK,
        kind::HEARTBEAT,
        kind::GAP,
    ];
    let kind = KINDS[dice.pick(7) as usize];
    let is_sent = kind == kind::ACKNACK || dice.pick(4) == 0;
    let mut flags = flag::HOST * u16::from(dice.pick(8) != 0);
    if is_sent {
        flags |= flag::OUTGOING;
    } else if dice.pick(3) == 0 {
        flags |= [flag::SOCKET_FULL, flag::NOT_REASSEMBLED][dice.pick(2) as usize];
    }
    let directed = match dice.pick(3) {
        0 if kind != kind::ACKNACK => Guid::default(),
        _ => Guid::new(readers_of(dice.pick(600)), EntityId([0, 0, 1, 4])),
    };
    let number = newest.saturating_sub(dice.pick(3000)).max(1);
    let mut record = Record {
        kind,
        submessage_flags: 5,
        writer: guid_words(Guid::new(ALICE, SAMPLES)),
        reader: guid_words(directed),
        time: now,
        sequence_number: number,
        destination: [0, 0, u32::from_be(0xffff), dice.pick(700) as u32],
        destination_port: 7411,
        datagram_len: 60_000,
        payload_len: 100,
        flags,
        socket: u64::from(flags & flag::HOST) * (1 + dice.pick(700)),
        elapsed: 1_000_000,
        ..Record::default()
    };
    match kind {
        kind::DATA_FRAG => {
            record.fragment_start = 1 + dice.pick(65_000) as u32;
            record.fragments = 1 << 16 | 100;
            record.sample_size = 65_536 * 100;
        }
        kind::HEARTBEAT => {
            record.sequence_number = number.saturating_sub(4000).max(1);
            record.payload_len = 0;
            record.encapsulation = newest as u32;
        }
        kind::GAP => (record.payload_len, record.encapsulation) = (0, number as u32 + 1),
        _ => {}
    }
    record
}

fn one_writer(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    if step == 1 {
        announce_one_writer(observer);
    }
    let newest = 10_000 + 20 * step;
    match dice.pick(40) {
        0 => {
            let message = Message::from(ALICE).data(SAMPLES, newest, &[0, 1, 0, 0, 5, 5, 5, 5]);
            let envelope = forge::multicast(now, 0);
            observer.input(Input::SharedMemory {
                envelope: &envelope,
                payload: &message.bytes(),
            });
        }
        1 => observer.input(Input::SocketClosed(1 + dice.pick(5000))),
        2 | 3 => observer.input(Input::Socket(SocketFacts {
            cookie: 1 + dice.pick(5000),
            process_id: Some(dice.pick(5000) as u32),
            ..SocketFacts::default()
        })),
        _ => observe(observer, &forged_record(dice, newest, now)),
    }
}

/// Fills the tables of endpoints and nodes with groups of forty participants. Among them are
/// newcomers on a topic that is watched by exact name. The watchlist changes at intervals.
fn newcomers_in_a_crowd(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    if step % 4_000 == 1 {
        // With so many globs, matching all topics takes several rounds.
        let globs = (0..20).map(|number| format!("/g{number}/**"));
        let names = globs.chain(["/exact".to_owned()]);
        let watches = names.map(|name| Watch::named(&name).unwrap()).collect();
        observer.input(Input::Watchlist(Arc::new(Watchlist::new(watches).unwrap())));
    }
    let is_newcomer = dice.pick(20) == 0;
    let mut prefix = [if is_newcomer { 8 } else { 9 }; 12];
    prefix[11] = dice.pick(40) as u8;
    let prefix = GuidPrefix(prefix);
    let [_, a, b, c, ..] = dice.roll().to_ne_bytes();
    let guid = Guid::new(prefix, EntityId([a, b, c, 3]));
    let (number, message) = (1 + step, Message::from(prefix));
    let message = match (dice.pick(12), is_newcomer) {
        (0, _) => message.data(
            SPDP,
            number,
            &forge::participant(prefix, 1_000_000, Some(0)),
        ),
        (1, _) => {
            let names: Vec<_> = (0..60).map(|each| format!("n{step}_{each}")).collect();
            let nodes: Vec<_> = names
                .iter()
                .map(|name| ("/", name.as_str(), guid))
                .collect();
            let payload = forge::entities(prefix, 24, &nodes);
            message.data(DISCOVERY_INFO, number, &payload)
        }
        (_, true) => {
            let payload = forge::endpoint(guid, "rt/exact", "a::msg::dds_::B_", true);
            message.data(SEDP_WRITERS, number, &payload)
        }
        (_, false) => {
            let payload = forge::endpoint(guid, &dice.name(), "a::msg::dds_::B_", true);
            message.data(SEDP_WRITERS, number, &payload)
        }
    };
    observer.input(Input::Datagram {
        envelope: &forge::multicast(now, 0),
        payload: &message.bytes(),
        handover: None,
    });
}

#[test]
fn forged_input_fills_no_table_beyond_its_cap() {
    let whole = drive(40_000, 200_000, &mut any_datagram);
    assert_filled(&[
        "discovery.applicants",
        "participants",
        "discovery.pending_endpoints",
        "discovery.pending_nodes",
        "discovery_fragments.samples",
        "unknown_writers",
        "addresses",
    ]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(15_000, 1_000_000, &mut one_writer);
    assert_filled(&[
        "acknowledgements.readers",
        "sequence.gaps",
        "trace.finished",
        "routes.routes",
    ]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(24_000, 1_000_000, &mut newcomers_in_a_crowd);
    assert_filled(&["endpoints", "nodes"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(15_000, 1_000_000, &mut calls::calls);
    assert_filled(&["services.identities", "services.clients"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(4_000, 300_000_000, &mut inside::reports);
    assert_filled(&["inside.states"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(20_000, 1_000_000, &mut chains::messages);
    let filled = ["chains", "chains.publications", "chains.spans"];
    assert_filled(&filled);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(30_000, 1_000_000, &mut zenoh::batches);
    assert_filled(&["zenoh_directions"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(8_000, 1_000_000, &mut links::reports);
    assert_filled(&["links"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(12_000, 10_000_000, &mut robot::logs);
    assert_filled(&["robot_writers", "log_nodes", "log_messages"]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(12_000, 10_000_000, &mut robot::parts);
    assert_filled(&[
        "diagnostics.values",
        "parameter_requests",
        "transforms.broadcasters",
    ]);
    assert!(whole < 96 << 20, "{whole} bytes");

    let whole = drive(20_000, 10_000_000, &mut robot::states);
    assert_filled(&[
        "robot_managed_nodes",
        "robot_frames",
        "robot_fields",
        "robot_fields.bytes",
    ]);
    assert!(whole < 96 << 20, "{whole} bytes");

    inside::of_a_queue();

    let ledger = ledger();
    println!("{ledger:#?}");
    let test = "/bounds.rs forged_input_fills_no_table_beyond_its_cap";
    let claims = DRIVEN.lines().filter(|line| line.ends_with(test));
    let claimed: Vec<_> = claims.filter_map(|line| line.split(' ').next()).collect();
    assert!(claimed.len() > 40, "{claimed:?}");
    assert_filled(&claimed);
    let mut empty: Vec<_> = tables::ALL.iter().map(|table| table.name).collect();
    empty.retain(|table| ledger.get(table).is_none_or(|used| used.largest == 0));
    // Other tests fill these tables: `clocks`, `parameters`, `deliveries`, `event`,
    // `inside::repairs`, `latched` and `zenoh::routers`.
    let rare = [
        "clock_writers",
        "parameter_reads",
        "delivery.withheld",
        "events.losers",
        "retained_bytes",
        "retained_writers",
        "retransmissions",
        "zenoh.cut",
        "zenoh_passages",
    ];
    // Only saved state fills these tables.
    let restored = ["zenoh.relayed", "zenoh.remembered", "zenoh.restored"];
    empty.retain(|table| !rare.contains(table) && !restored.contains(table));
    assert!(empty.is_empty(), "nothing came into {empty:?}");
    let exceeded = ledger.iter().filter(|(_, used)| used.largest > used.cap);
    assert_eq!(exceeded.count(), 0);
}

#[test]
fn a_participant_with_ever_new_addresses_keeps_only_the_latest() {
    let prefix = GuidPrefix([9; 12]);
    let whole = drive(10_000, 120_000, &mut |observer, dice, now| {
        let payload = forge::participant_at(prefix, 100, None, &dice.locators());
        let message = Message::from(prefix).data(SPDP, 1, &payload).bytes();
        observer.input(Input::Datagram {
            envelope: &somewhere(dice, now),
            payload: &message,
            handover: None,
        });
    });
    assert_eq!(ledger()["addresses"].largest, 16);
    assert!(whole < 2 << 20, "{whole} bytes");
}
