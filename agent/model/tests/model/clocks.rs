//! Offsets between the clocks of hosts, with forged stamps in virtual time.

use std::net::SocketAddrV4;

use ros2probe_capture::border::observe;
use ros2probe_model::derive::clocks::Source;
use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::tables::{ClockPeers, ClockWriters};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::{ClockOffset, PeerClock};
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::model::host::{ALICE, BOB, CapturePoint, Host, READER, START, WRITER};
use ros2probe_wire::record::{guid_words, kind};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

const MICROSECOND: u64 = 1_000;
const MILLISECOND: u64 = 1_000_000;
const SECOND: u64 = 1_000_000_000;
/// Fastest way of a datagram between the hosts.
const TRANSIT: u64 = 150 * MICROSECOND;

/// Alice's clock beside that of this host, on which Bob is.
#[derive(Clone, Copy)]
struct Clock {
    ahead: i64,
    parts_per_million: i64,
}

impl Clock {
    const fn ahead(ahead: i64) -> Self {
        Self {
            ahead,
            parts_per_million: 0,
        }
    }

    /// Returns the true offset at a time of this host.
    fn at(self, now: u64) -> i64 {
        let elapsed = i64::try_from(now - START).unwrap();
        self.ahead + elapsed / 1_000_000 * self.parts_per_million
    }
}

/// Two hosts: Alice's messages arrive here, and Bob's leave.
struct Pair {
    host: Host,
    bob: CapturePoint,
    alice: GuidPrefix,
    number: u64,
    dice: u64,
}

impl Pair {
    fn with(settings: Settings) -> Self {
        let mut host = Host::with(settings);
        let bob = host.reader(BOB, 7411);
        host.owner(bob, BOB);
        Self {
            host,
            bob,
            alice: ALICE,
            number: 0,
            dice: 1,
        }
    }

    fn new() -> Self {
        Self::with(Settings::default())
    }

    /// Returns nanoseconds below a limit, most of them far below.
    fn jitter(&mut self, below: u64) -> u64 {
        self.dice = self.dice.wrapping_mul(6_364_136_223_846_793_005) + 1;
        let part = (self.dice >> 40) as f64 / (1_u64 << 24) as f64;
        (part.powi(4) * below as f64) as u64
    }

    fn until(&mut self, now: u64) {
        self.host.now = now;
        self.host.observer.input(Input::Time(Timestamp(now)));
    }

    /// A message of Alice's leaves now by its stamp, and arrives.
    fn receive_from_alice(&mut self, clock: Clock) {
        let sent = self.host.now;
        self.number += 1;
        let stamp = sent.checked_add_signed(clock.at(sent)).unwrap();
        let late = TRANSIT + self.jitter(2 * MILLISECOND);
        let record = Record {
            writer: guid_words(Guid::new(self.alice, WRITER)),
            source_timestamp: wire_time(stamp),
            time: sent + late,
            ..self.host.record(self.bob, kind::DATA, self.number)
        };
        self.host.put(record);
    }

    /// Ten messages of Alice's arrive each second.
    fn listen(&mut self, clock: Clock, seconds: u64) {
        for _ in 0..10 * seconds {
            self.receive_from_alice(clock);
            self.until(self.host.now + SECOND / 10);
        }
    }

    /// A message of Bob's leaves, and Alice acknowledges it.
    fn send_from_bob(&mut self) {
        let sent = self.host.now;
        self.send(kind::DATA, sent);
        let later = 2 * TRANSIT + 20 * MICROSECOND + self.jitter(5 * MILLISECOND);
        self.acknowledge(sent + later);
    }

    /// A new message of Bob's leaves, or a HEARTBEAT that announces the last one.
    fn send(&mut self, kind: u8, time: u64) {
        self.number += u64::from(kind == kind::DATA);
        let mut record = (self.host).record(self.bob.leaving(), kind, self.number);
        if kind == kind::HEARTBEAT {
            (record.payload_len, record.encapsulation) = (0, self.number as u32);
        }
        self.host.put(Record {
            writer: guid_words(Guid::new(BOB, WRITER)),
            time,
            ..record
        });
    }

    /// Alice acknowledges the last message of Bob's.
    fn acknowledge(&mut self, time: u64) {
        let acknack = Record {
            writer: guid_words(Guid::new(BOB, WRITER)),
            reader: guid_words(Guid::new(self.alice, READER)),
            time,
            ..(self.host).record(self.bob, kind::ACKNACK, self.number + 1)
        };
        self.host.put(acknack);
    }

    /// Both speak for some seconds. At the end of each second after the fifth, `check` runs.
    fn talk(&mut self, clock: Clock, seconds: u64, mut check: impl FnMut(&Self)) {
        for second in 0..seconds {
            for _ in 0..50 {
                self.receive_from_alice(clock);
                self.send_from_bob();
                self.until(self.host.now + 20 * MILLISECOND);
            }
            if second >= 5 {
                check(self);
            }
        }
    }

    fn offsets(&self) -> Vec<ClockOffset> {
        self.host.snapshot().clocks.offsets
    }

    fn peer(&self) -> PeerClock {
        let peers = self.host.snapshot().clocks.peers;
        let [peer] = &peers[..] else {
            panic!("{peers:?}")
        };
        peer.clone()
    }

    /// Returns the offset and its uncertainty.
    fn offset(&self) -> (i64, i64) {
        let offsets = self.offsets();
        let [offset] = &offsets[..] else {
            panic!("{offsets:?}")
        };
        (offset.offset, offset.uncertainty)
    }

    fn check(&self, clock: Clock) {
        let (offset, uncertainty) = self.offset();
        let truth = clock.at(self.host.now);
        let wrong = offset.abs_diff(truth);
        assert!(
            wrong <= uncertainty.unsigned_abs(),
            "{offset} {uncertainty} {truth}"
        );
        assert!(uncertainty < MILLISECOND.cast_signed(), "{uncertainty}");
    }

    fn finding(&self) -> Option<i64> {
        let diagnoses = &self.host.snapshot().diagnoses;
        diagnoses.list.iter().find_map(|each| match each {
            Diagnosis::ClocksApart { offset, .. } => Some(*offset),
            _ => None,
        })
    }
}

fn wire_time(nanoseconds: u64) -> u64 {
    ((nanoseconds / SECOND) << 32) | (((nanoseconds % SECOND) << 32) / SECOND)
}

#[test]
fn an_offset_is_within_its_bound_while_clocks_drift() {
    for ahead in [0, 500_000, 20_000_000, 3_000_000_000, -20_000_000] {
        for parts_per_million in [0, 50, -50] {
            let clock = Clock {
                ahead,
                parts_per_million,
            };
            let mut pair = Pair::new();
            let mut checks = 0;
            pair.talk(clock, 90, |pair| {
                pair.check(clock);
                checks += 1;
            });
            let peer = pair.peer();
            assert_eq!((checks, peer.steps), (85, 0));
            assert_eq!(
                (&*peer.peer, peer.source),
                ("10.0.0.1", Some(Source::RoundTrip))
            );
        }
    }
}

#[test]
fn one_direction_yields_one_bound_and_no_offset() {
    let mut pair = Pair::new();
    let clock = Clock::ahead(20_000_000);
    for _ in 0..500 {
        pair.receive_from_alice(clock);
        pair.until(pair.host.now + 20 * MILLISECOND);
    }
    let peer = pair.peer();
    let least = peer.ahead.0.unwrap();
    assert!(
        (19_000_000..=20_000_000 - 150_000).contains(&least),
        "{least}"
    );
    assert_eq!((peer.ahead.1, peer.source), (None, None));
    assert!(pair.offsets().is_empty() && pair.finding().is_none());
    // Acknowledgements without stamps give none, either.
    let mut pair = Pair::new();
    (0..500).for_each(|_| pair.send_from_bob());
    assert_eq!(pair.host.snapshot().clocks.peers, []);
}

#[test]
fn few_or_repeated_messages_are_not_evidence_of_a_round_trip() {
    let mut pair = Pair::new();
    pair.send_from_bob();
    for _ in 0..10 {
        pair.receive_from_alice(Clock::ahead(0));
        pair.send_from_bob();
    }
    assert_eq!(
        pair.peer().ahead.1,
        None,
        "one of ten may not be as fast as a round trip"
    );
    (0..20).for_each(|_| pair.receive_from_alice(Clock::ahead(0)));
    let (_, uncertainty) = pair.offset();
    // The last message is sent again just before an acknowledgement of its first transmission.
    pair.number -= 1;
    pair.send_from_bob();
    pair.until(pair.host.now + SECOND);
    assert!(pair.offset().1 >= uncertainty);
}

#[test]
fn one_acknowledgement_bounds_the_clock_for_ten_minutes() {
    let mut pair = Pair::new();
    // Alice is unknown as a peer until her first message.
    pair.send_from_bob();
    let clock = Clock::ahead(3 * MILLISECOND as i64);
    let mut hear_for = |seconds: u64| {
        for _ in 0..seconds * 10 {
            pair.until(pair.host.now + SECOND / 10);
            pair.receive_from_alice(clock);
        }
        pair.offsets()
    };
    for _ in 0..2 {
        let offsets = hear_for(290);
        let error = (offsets[0].offset - 3 * MILLISECOND as i64).abs();
        assert!(error <= offsets[0].uncertainty && offsets[0].uncertainty < 1_000_000);
    }
    assert_eq!(hear_for(150), [], "the network may be another one");
}

#[test]
fn a_finding_outlives_its_evidence_until_the_clock_is_set_or_the_offset_is_known() {
    let ahead = Clock::ahead(1_000_000_000);
    let mut pair = Pair::new();
    pair.send_from_bob();
    pair.listen(ahead, 10);
    let begun = pair.finding();
    assert!(
        begun.is_some_and(|offset| offset > 990_000_000),
        "{begun:?}"
    );
    // The round trip expires after ten minutes.
    pair.listen(ahead, 15 * 60);
    assert!(pair.offsets().is_empty());
    assert_eq!(pair.finding(), begun);
    pair.talk(Clock::ahead(1_000_000_000), 10, |_| {});
    assert_eq!(pair.finding(), begun);
    pair.listen(Clock::ahead(0), 15);
    assert_eq!((pair.finding(), pair.peer().steps), (None, 1));
    // A finding also ends once the offset is known to be small.
    let mut pair = Pair::new();
    pair.talk(Clock::ahead(12_000_000), 10, |_| {});
    assert!(pair.finding().is_some());
    pair.talk(Clock::ahead(0), 60, |_| {});
    assert_eq!(pair.finding(), None);
}

/// A writer of Fast DDS announces its messages each 3 s, long after the last of them.
#[test]
fn the_heartbeat_that_requests_an_acknowledgement_begins_a_round_trip() {
    let clock = Clock::ahead(500_000);
    let mut pair = Pair::new();
    // The first ACKNACK answers no HEARTBEAT.
    pair.acknowledge(pair.host.now);
    for _ in 0..4 {
        let announced = pair.host.now + 190 * MILLISECOND;
        pair.send(kind::DATA, pair.host.now);
        // Two locators, two copies.
        for copy in 0..2 {
            pair.send(kind::HEARTBEAT, announced + copy * 50 * MICROSECOND);
        }
        pair.acknowledge(announced + 6 * MILLISECOND);
        // The reader repeats its answer once more, just after another HEARTBEAT.
        pair.send(kind::HEARTBEAT, announced + SECOND);
        pair.acknowledge(announced + SECOND + 10 * MICROSECOND);
        pair.listen(clock, 3);
    }
    let (offset, uncertainty) = pair.offset();
    assert!((offset - 500_000).abs() <= uncertainty, "{offset}");
    assert!(
        (3_000_000..3_600_000).contains(&uncertainty),
        "{uncertainty}"
    );
}

#[test]
fn a_burst_of_heartbeats_begins_a_round_trip_with_its_first() {
    let mut pair = Pair::new();
    pair.acknowledge(pair.host.now);
    pair.send(kind::DATA, pair.host.now);
    let began = pair.host.now + 400 * MILLISECOND;
    for heartbeat in 0..4 {
        pair.send(kind::HEARTBEAT, began + heartbeat * 100 * MILLISECOND);
    }
    // This answers the third one.
    pair.acknowledge(began + 301 * MILLISECOND);
    pair.listen(Clock::ahead(0), 3);
    let (_, uncertainty) = pair.offset();
    assert!(
        (150_000_000..152_000_000).contains(&uncertainty),
        "{uncertainty}"
    );
}

#[test]
fn the_bounds_widen_in_silence_and_expire() {
    let mut pair = Pair::new();
    pair.talk(Clock::ahead(0), 10, |_| {});
    let before = pair.offset().1;
    pair.until(pair.host.now + 50 * SECOND);
    let after = pair.offset().1;
    // 100 ppm of 50 s.
    assert!(
        (after - before - 5_000_000).abs() < 200_000,
        "{before} {after}"
    );
    for _ in 0..80 {
        pair.until(pair.host.now + SECOND);
    }
    assert!(pair.offsets().is_empty());
    assert_eq!(pair.host.snapshot().clocks.peers, []);
}

#[test]
fn a_step_of_the_peers_clock_is_noticed_within_ten_seconds() {
    for step in [3_000_000_000, -3_000_000_000, -200_000_000] {
        let mut pair = Pair::new();
        pair.talk(Clock::ahead(0), 20, |pair| pair.check(Clock::ahead(0)));
        assert_eq!(pair.finding(), None);
        let clock = Clock::ahead(step);
        pair.talk(clock, 30, |pair| pair.check(clock));
        assert_eq!(pair.finding().map(i64::signum), Some(step.signum()));
        let back = Clock::ahead(0);
        pair.talk(back, 30, |pair| pair.check(back));
        assert_eq!(pair.finding(), None);
        assert!(pair.peer().steps >= 1);
    }
}

#[test]
fn a_step_of_this_hosts_clock_moves_the_offset_at_once() {
    let mut pair = Pair::new();
    pair.talk(Clock::ahead(0), 10, |_| {});
    let (before, uncertainty) = pair.offset();
    let step = 2 * SECOND;
    pair.host
        .observer
        .input(Input::ClockSet(step.cast_signed()));
    pair.until(pair.host.now + step);
    assert_eq!(pair.offset(), (before - step.cast_signed(), uncertainty));
    pair.until(pair.host.now + 2 * SECOND);
    assert!(pair.finding().is_some_and(|offset| offset < -1_900_000_000));
}

#[test]
fn latencies_are_corrected_by_a_known_offset_and_only_by_that() {
    for ahead in [-3_000_000_000, -20_000_000, 20_000_000, 5_000_000_000_000] {
        let mut pair = Pair::new();
        pair.talk(Clock::ahead(ahead), 6, |_| {});
        let (correction, error) = pair.peer().correction().unwrap();
        assert!((correction - ahead).abs() <= error && error < 1_000_000);
        let before = pair.host.measurement();
        pair.talk(Clock::ahead(ahead), 10, |_| {});
        let after = pair.host.measurement();
        let counted = after.source_latency.count() - before.source_latency.count();
        assert_eq!(
            (counted, after.negative_latency),
            (500, before.negative_latency)
        );
        // The way takes 0.15 to 2.15 ms.
        let sum = after.source_latency.sum() - before.source_latency.sum();
        let mean = sum / 500.0;
        assert!((0.000_15..0.001_6).contains(&mean), "{mean} s, {ahead}");
    }
    // Clocks that may agree are not corrected.
    let mut pair = Pair::new();
    pair.talk(Clock::ahead(0), 10, |_| {});
    let (correction, error) = pair.peer().correction().unwrap();
    let (offset, uncertainty) = pair.offset();
    assert_eq!((correction, error), (0, offset.abs() + uncertainty));
    let measured = pair.host.measurement().source_latency;
    let (least, _) = measured.range().unwrap();
    assert!((least - 0.000_15).abs() < 0.000_01, "{least}");
}

#[test]
fn a_step_of_this_hosts_clock_corrects_latencies_at_once() {
    let mut pair = Pair::new();
    pair.talk(Clock::ahead(0), 10, |_| {});
    let before = pair.host.measurement();
    let step = 2 * SECOND.cast_signed();
    pair.host.observer.input(Input::ClockSet(step));
    // The stamps of Alice are behind from now on, and the receipt has the new time.
    let clock = Clock::ahead(-step);
    pair.talk(clock, 10, |_| {});
    let after = pair.host.measurement();
    assert_eq!(after.negative_latency, before.negative_latency);
    let (_, most) = after.source_latency.range().unwrap();
    assert!(most < 0.01, "{most}");
}

#[test]
fn pairs_of_peers_follow_from_differences() {
    let carol = GuidPrefix(*b"\x01\x10carol-host");
    let mut pair = Pair::new();
    pair.host
        .participant(carol, "10.0.0.3:7411".parse().unwrap());
    for (prefix, ahead) in [(ALICE, 20_000_000), (carol, -3_000_000)] {
        pair.alice = prefix;
        pair.talk(Clock::ahead(ahead), 8, |_| {});
    }
    let offsets = pair.offsets();
    let names: Vec<_> = offsets
        .iter()
        .map(|each| (each.host.as_deref(), &*each.peer))
        .collect();
    let expected = [
        (None, "10.0.0.1"),
        (None, "10.0.0.3"),
        (Some("10.0.0.1"), "10.0.0.3"),
    ];
    assert_eq!(names, expected);
    let last = &offsets[2];
    assert!(last.offset.abs_diff(-23_000_000) <= last.uncertainty.unsigned_abs());
    let sum = offsets[0].uncertainty + offsets[1].uncertainty;
    assert!(last.uncertainty.abs_diff(sum) <= 2, "{offsets:?}");
}

/// Alice's server replies to requests of Bob's client. The reply is stamped when it is written.
#[test]
fn replies_bound_the_offset_at_any_network_delay() {
    const REQUESTS: EntityId = EntityId([0, 0, 0x21, 0x03]);
    const REPLIES: EntityId = EntityId([0, 0, 0x22, 0x03]);
    const TYPE: &str = "example_interfaces::srv::dds_::AddTwoInts_Request_";
    let clock = Clock::ahead(20_000_000);
    let mut pair = Pair::new();
    for (prefix, entity, topic) in [
        (BOB, REQUESTS, "rq/addRequest"),
        (ALICE, REPLIES, "rr/addReply"),
    ] {
        let payload = forge::endpoint(Guid::new(prefix, entity), topic, TYPE, true);
        let message = Message::from(prefix).data(SEDP_WRITERS, 2, &payload);
        pair.host.announce(message);
    }
    let body = |number: u64| [&[0, 1, 0, 0][..], &[7; 8], &number.to_le_bytes(), &[1; 8]].concat();
    for number in 1..=30 {
        let mut send = |entity, outgoing, time, message: Message| {
            let envelope = Envelope {
                outgoing,
                host: true,
                socket: 9,
                ..forge::multicast(time, 0)
            };
            let message = message.data(entity, number, &body(number));
            pair.host.observer.input(Input::Datagram {
                envelope: &envelope,
                payload: &message.bytes(),
                handover: None,
            });
        };
        let sent = pair.host.now;
        let request = Message::from(BOB);
        send(REQUESTS, true, sent, request);
        // The way there is fast, the way back slow.
        let replied = sent + TRANSIT + 300 * MICROSECOND;
        let stamp = replied.checked_add_signed(clock.at(replied)).unwrap();
        let reply = Message::from(ALICE).info_ts(stamp);
        send(REPLIES, false, replied + 3 * MILLISECOND, reply);
        pair.until(pair.host.now + 100 * MILLISECOND);
    }
    assert_eq!(pair.peer().source, Some(Source::Reply));
    let (least, most) = pair.peer().ahead;
    assert!(least.unwrap() <= 20_000_000 && least.unwrap() > 16_900_000);
    assert!(
        (20_000_000..20_800_000).contains(&most.unwrap()),
        "{most:?}"
    );
}

#[test]
fn clocks_off_compares_nothing() {
    let mut pair = Pair::with(Settings {
        robot: Parts::default(),
        ..Settings::default()
    });
    pair.talk(Clock::ahead(SECOND.cast_signed()), 10, |_| {});
    let facts = pair.host.snapshot().clocks;
    assert!(!facts.are_compared && facts.peers.is_empty() && facts.offsets.is_empty());
}

#[test]
fn tables_of_peers_and_writers_are_bounded() {
    let mut pair = Pair::new();
    for number in 0..3 * ClockPeers::CAP as u8 {
        let mut prefix = *b"\x01\x10forged-host";
        prefix[2] = number;
        pair.alice = GuidPrefix(prefix[..12].try_into().unwrap());
        let address = SocketAddrV4::new([10, 0, 1, number].into(), 7411);
        pair.host.participant(pair.alice, address);
        pair.receive_from_alice(Clock::ahead(0));
    }
    assert_eq!(pair.host.snapshot().clocks.peers.len(), ClockPeers::CAP);
    for number in 0..2 * ClockWriters::CAP as u32 {
        let [a, b, c, _] = (number << 8).to_be_bytes();
        let acknack = Record {
            writer: guid_words(Guid::new(BOB, EntityId([a, b, c, 3]))),
            reader: guid_words(Guid::new(ALICE, READER)),
            ..pair.host.record(pair.bob, kind::ACKNACK, 1)
        };
        observe(&mut pair.host.observer, &acknack);
    }
    let snapshot = pair.host.snapshot();
    let table = |name| {
        snapshot
            .tables
            .iter()
            .find(|table| table.table == name)
            .unwrap()
    };
    assert_eq!(table("clock_peers").size, ClockPeers::CAP as u64);
    assert!(table("clock_peers").evictions > 0);
    assert_eq!(table("clock_writers").size, ClockWriters::CAP as u64);
    assert!(table("clock_writers").evictions > 0);
}
