//! A tick visits only writers with something due. The decisions equal those of a model that visits
//! every writer at each tick, and of one that sleeps until the next due time.

use std::sync::Arc;

use proptest::prelude::*;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS};
use ros2probe_testing::model::host::{
    ALICE, BOB, CAROL, CapturePoint, Host, MILLISECOND, READER, START, WRITER,
};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, SequenceNumber, Timestamp};

use super::*;
use crate::facts::observation::Observation;
use crate::facts::route::Destination;
use crate::facts::selection::{Depth, SampleRequest, Selection};
use crate::facts::watch::{Watch, Watchlist};
use crate::observe::input::Input;
use crate::observe::observer::Settings;

const DORA: GuidPrefix = GuidPrefix(*b"\x01\x10dora-sends");
const EVE: GuidPrefix = GuidPrefix(*b"\x01\x10eve-hears!");

/// When a model processes the time, and which writers it visits.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Visits {
    /// At each tick, what is due.
    Due,
    /// At each tick, every writer.
    All,
    /// When something is due.
    Asleep,
}

/// Three writers and the receivers of a host.
struct World {
    observer: Observer,
    /// Forges the records.
    host: Host,
    bob: CapturePoint,
    carol: CapturePoint,
    eve: CapturePoint,
    visits: Visits,
    now: u64,
    /// The next number of each writer.
    next: [u64; 3],
    announcements: u64,
    is_requested: bool,
    /// The output, and the time at which it was ready.
    output: Vec<(u64, Vec<String>)>,
}

/// One step: what happens, at which writer and point, and milliseconds until the next step.
type Step = (u8, usize, u8, u64);

impl World {
    fn new(visits: Visits) -> Self {
        let mut observer = Observer::new(Settings::default());
        let everything = Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap();
        observer.input(Input::Watchlist(Arc::new(everything)));
        observer.input(Input::Time(Timestamp(START)));
        let point = |port: u16| CapturePoint {
            socket: port.into(),
            address: format!("10.0.0.2:{port}").parse().unwrap(),
            directed: None,
            flags: flag::HOST,
        };
        let mut world = Self {
            observer,
            host: Host::new(),
            bob: point(7411),
            carol: point(7412),
            eve: point(7413),
            visits,
            now: START,
            next: [1; 3],
            announcements: 0,
            is_requested: false,
            output: Vec::new(),
        };
        let announced = [
            (ALICE, "10.0.0.1:7411"),
            (BOB, "10.0.0.2:7411"),
            (CAROL, "10.0.0.2:7412"),
            (DORA, "10.0.0.3:7411"),
            (EVE, "10.0.0.2:7413"),
        ];
        for (prefix, address) in announced {
            let address = address.parse().unwrap();
            let payload = forge::participant_at(prefix, 1_000_000, Some(0), &[address]);
            world.announce(prefix, |message, number| {
                message.data(forge::SPDP, number, &payload)
            });
        }
        world.endpoint(Self::writer(0), true);
        world.endpoint(Self::writer(1), false);
        for (prefix, reliable) in [(BOB, true), (CAROL, true), (EVE, false)] {
            world.endpoint(Guid::new(prefix, READER), reliable);
        }
        world
    }

    fn writer(index: usize) -> Guid {
        match index {
            0 => Guid::new(ALICE, WRITER),
            1 => Guid::new(ALICE, EntityId([0, 0, 0x12, 3])),
            // Its announcement was missed.
            _ => Guid::new(DORA, WRITER),
        }
    }

    fn announce(&mut self, by: GuidPrefix, of: impl FnOnce(Message, u64) -> Message) {
        self.announcements += 1;
        let message = of(Message::from(by), self.announcements).bytes();
        self.observer.input(Input::Datagram {
            envelope: &forge::multicast(self.now, 0),
            payload: &message,
            handover: None,
        });
    }

    /// Announces an endpoint. The second writer and Eve have a topic of their own.
    fn endpoint(&mut self, guid: Guid, reliable: bool) {
        let is_other = guid == Self::writer(1) || guid.prefix == EVE;
        let topic = if is_other { "rt/other" } else { "rt/chatter" };
        let payload = forge::endpoint(guid, topic, "std_msgs::msg::dds_::String_", reliable);
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        self.announce(guid.prefix, |message, number| {
            message.data(sedp, number, &payload)
        });
    }

    fn dispose(&mut self, guid: Guid) {
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        self.announce(guid.prefix, |message, number| {
            message.dispose_by_hash(sedp, number, guid)
        });
    }

    fn point(&self, index: usize, point: u8) -> CapturePoint {
        let reader = if index == 1 { self.eve } else { self.bob };
        match point {
            0..3 => reader,
            3 => self.carol,
            4 => reader.leaving(),
            5 => reader.multicast(77),
            6 => reader.wire(),
            _ => CapturePoint {
                socket: 0,
                flags: flag::SHM | if point == 7 { flag::EXACT } else { 0 },
                ..reader
            },
        }
    }

    /// Passes a record to the model; that of an ACKNACK names its writer already.
    fn put(&mut self, record: &Record) {
        let clock = self.observer.wall_clock();
        Observation::each(record, clock, |observation| {
            self.observer.input(Input::Observation(observation));
        });
    }

    fn record(&self, index: usize, point: u8, kind: u8, number: u64) -> Record {
        Record {
            writer: guid_words(Self::writer(index)),
            ..self.host.record(self.point(index, point), kind, number)
        }
    }

    fn data(&mut self, index: usize, point: u8, number: u64) {
        self.put(&self.record(index, point, kind::DATA, number));
        self.next[index] = self.next[index].max(number + 1);
    }

    /// Passes an ACKNACK of Bob's reader.
    fn acknack(&mut self, base: u64, bits: u32) {
        let record = Record {
            reader: guid_words(Guid::new(BOB, READER)),
            stamp_seconds: bits,
            stamp_nanoseconds: bits << 31,
            ..self.record(0, 4, kind::ACKNACK, base)
        };
        self.put(&record);
    }

    fn happen(&mut self, what: u8, index: usize, point: u8) {
        let next = self.next[index];
        let before = next.saturating_sub(1 + u64::from(point)).max(1);
        match what {
            0..10 => self.data(index, point, next),
            10 | 11 => self.data(index, point, next + 1 + u64::from(point)),
            12 => self.data(index, point, before),
            13 | 14 => {
                let start = 1 + u32::from(point) % 8;
                let seen = self.point(index, point);
                let fragments = self.host.fragments(seen, next, start, 3);
                let writer = guid_words(Self::writer(index));
                self.put(&Record {
                    writer,
                    ..fragments
                });
                self.next[index] += u64::from(what == 13);
            }
            15 | 16 => {
                let last = next - 1 + u64::from(what == 16);
                let heartbeat = self.record(index, point, kind::HEARTBEAT, before);
                let encapsulation = u32::try_from(last).unwrap();
                self.put(&Record {
                    payload_len: 0,
                    encapsulation,
                    ..heartbeat
                });
            }
            17 => {
                let gap = self.record(index, point, kind::GAP, next);
                let encapsulation = u32::try_from(next).unwrap() + 1;
                self.put(&Record {
                    payload_len: 0,
                    encapsulation,
                    ..gap
                });
                self.next[index] += 1;
            }
            18 => self.acknack(self.next[0], 0),
            19 => self.acknack(self.next[0].saturating_sub(1).max(1), 1),
            20 => {
                let arrival = self.record(index, 0, kind::DATA, next);
                let flags = arrival.flags | flag::SOCKET_FULL;
                self.put(&Record { flags, ..arrival });
                self.next[index] += 1;
            }
            21 => {
                let record = self.record(index, 6, kind::DATA, before);
                let flags = flag::NOT_REASSEMBLED;
                self.put(&Record { flags, ..record });
            }
            22 => self.next[index] = 1,
            23 if point.is_multiple_of(2) => self.endpoint(Guid::new(CAROL, READER), true),
            23 => self.dispose(Guid::new(CAROL, READER)),
            24 => self.endpoint(Self::writer(index.min(1)), point.is_multiple_of(2)),
            25 => self.dispose(Self::writer(index)),
            26 => {
                self.is_requested = !self.is_requested;
                let request = SampleRequest {
                    id: 1,
                    selection: Arc::new(Selection::all()),
                    domain_id: None,
                    depth: Depth::Arrivals,
                };
                let requests = self.is_requested.then_some(request).into_iter().collect();
                let requests = Input::SampleRequests(Arc::new(requests));
                self.observer.input(requests);
            }
            27 => {
                let destination = Destination {
                    address: self.bob.address.ip().to_ipv6_mapped().octets(),
                    port: self.bob.address.port(),
                };
                let at = Timestamp(self.now);
                self.observer.input(Input::StreamGap(destination, at));
            }
            28 => self.observer.input(Input::ProbesDetached),
            _ => {
                let alive = Input::ParticipantAlive(BOB, Timestamp(self.now));
                self.observer.input(alive);
            }
        }
    }

    fn step(&mut self, (what, index, point, pause): Step) {
        self.host.now = self.now;
        self.happen(what, index, point);
        self.drain();
        let end = self.now + pause * MILLISECOND;
        while self.now < end {
            if self.visits == Visits::All {
                self.observer.measure.profiler.visit_all();
            }
            self.now = match self.visits {
                Visits::Asleep => self.observer.next_due().0.max(self.now + 1).min(end),
                _ => (self.now / TENTH * TENTH + TENTH).min(end),
            };
            self.observer.input(Input::Time(Timestamp(self.now)));
            self.drain();
        }
    }

    /// Keeps new output as lines. Writers that are due at the same tick have no order.
    fn drain(&mut self) {
        let output = self.observer.drain();
        let events = output.events.events.iter();
        let mut lines: Vec<_> = events.map(|event| format!("{event:?}")).collect();
        lines.extend(output.samples.iter().map(|each| format!("{each:?}")));
        lines.extend(output.interest.iter().map(|each| format!("{each:?}")));
        lines.sort();
        if !lines.is_empty() {
            self.output.push((self.now, lines));
        }
    }

    /// Returns all facts and losses as text. The journal joins losses that follow each other, so
    /// the order of the writers determines its entries.
    fn facts(&self) -> String {
        let journal = self.observer.journal();
        let each = |first: SequenceNumber, last: SequenceNumber| first.until(last.next());
        let of_writers = journal.losses().flat_map(|loss| {
            let numbers = each(loss.first, loss.last);
            numbers.map(move |number| format!("{} {number:?}", loss.writer))
        });
        let of_receivers = journal.delivery_losses().flat_map(|loss| {
            let receiver = (loss.writer, loss.participant, loss.socket, loss.cause);
            let numbers = each(loss.first, loss.last);
            numbers.map(move |number| format!("{receiver:?} {number:?}"))
        });
        let mut losses: Vec<_> = of_writers.chain(of_receivers).collect();
        losses.sort();
        format!(
            "{:?} {losses:?}",
            self.observer.snapshot(Timestamp(self.now))
        )
    }
}

const TENTH: u64 = SECOND / 10;

/// Returns the surroundings of the first difference, if there is one.
fn difference<'a>(found: &'a str, expected: &'a str) -> Option<(&'a str, &'a str)> {
    let mut pairs = found.bytes().zip(expected.bytes());
    let place = pairs.position(|(one, other)| one != other);
    let place = place.or((found.len() != expected.len()).then_some(0))?;
    let part = |text: &'a str| {
        let end = text.len().min(place + 200);
        text.get(place.saturating_sub(400)..end).unwrap_or(text)
    };
    Some((part(found), part(expected)))
}

/// Returns a pause in milliseconds: often none, and sometimes one after which everything is
/// decided.
fn pause() -> impl Strategy<Value = u64> {
    prop_oneof![
        8 => Just(0),
        8 => 1..120_u64,
        4 => 100..2000_u64,
        1 => 5000..70_000_u64,
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn visits_of_writers_with_something_due_decide_the_same_as_visits_of_all(
        steps in prop::collection::vec((0..30_u8, 0..3_usize, 0..9_u8, pause()), 1..120),
    ) {
        let mut worlds = [Visits::All, Visits::Due, Visits::Asleep].map(World::new);
        for (place, step) in steps.iter().enumerate() {
            worlds.iter_mut().for_each(|world| world.step(*step));
            let [all, others @ ..] = &worlds;
            let expected = all.facts();
            for world in others {
                prop_assert_eq!(&world.output, &all.output, "{:?} {}", world.visits, place);
                let found = world.facts();
                let difference = difference(&found, &expected);
                prop_assert_eq!(difference, None, "{:?} {}", world.visits, place);
            }
        }
    }
}

#[test]
fn only_the_end_of_a_second_is_due_while_nothing_happens() {
    let mut world = World::new(Visits::Due);
    for _ in 0..50 {
        for step in [(0, 0, 0, 30), (0, 1, 4, 0), (0, 1, 3, 10)] {
            world.step(step);
        }
    }
    // Several gaps, fragments of an unfinished sample, and an unknown writer.
    for (what, index) in [(10, 0), (10, 1), (14, 0), (0, 2)] {
        world.step((what, index, 0, 50));
    }
    let soon = world.observer.next_due().0 - world.now;
    assert!(soon <= TENTH, "{soon}");
    world.step((18, 0, 0, 75_000));
    for _ in 0..30 {
        world.step((29, 0, 0, 100));
        let next = world.observer.next_due().0;
        assert_eq!(next, (world.now / SECOND + 1) * SECOND);
    }
}
