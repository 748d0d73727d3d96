//! A host in virtual time: a remote or local writer, and receivers at its sockets.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use ros2probe_capture::border::observe;
use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{
    DeliveryFacts, Direction, Measurement, Snapshot, SocketFacts, TopicFacts,
};
use ros2probe_wire::record::{flag, guid_words, kind};
pub use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

use super::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};

pub const START: u64 = 1_795_143_000_000 * MILLISECOND;
pub const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
pub const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);
pub const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
pub const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");
pub const CAROL: GuidPrefix = GuidPrefix(*b"\x01\x10carol-host");
/// Destination of multicast samples.
pub const GROUP: &str = "239.255.0.1:7401";
pub const STRING: &str = "std_msgs::msg::dds_::String_";

/// A point at which records are captured.
#[derive(Clone, Copy)]
pub struct CapturePoint {
    pub socket: u64,
    pub address: SocketAddrV4,
    pub directed: Option<GuidPrefix>,
    pub flags: u16,
}

impl CapturePoint {
    /// Returns the same receiver's multicast socket.
    pub fn multicast(self, socket: u64) -> Self {
        Self {
            socket,
            address: GROUP.parse().unwrap(),
            directed: None,
            ..self
        }
    }

    /// Returns the point at which a datagram leaves this host for this address.
    pub fn leaving(self) -> Self {
        Self {
            socket: 9,
            flags: flag::HOST | flag::OUTGOING,
            ..self
        }
    }

    /// Returns the point on a wire for this address.
    pub fn wire(self) -> Self {
        Self {
            socket: 0,
            flags: 0,
            ..self
        }
    }

    pub fn directed(self, prefix: GuidPrefix) -> Self {
        Self {
            directed: Some(prefix),
            ..self
        }
    }
}

/// The observer of one host.
pub struct Host {
    pub observer: Observer,
    pub now: u64,
}

impl Default for Host {
    fn default() -> Self {
        Self::with(Settings::default())
    }
}

impl Host {
    pub fn new() -> Self {
        Self::default()
    }

    /// Creates a host with a reliable writer of Alice's on `/chatter`.
    pub fn with(settings: Settings) -> Self {
        let mut host = Self::unannounced_with(settings);
        host.writer(true);
        host
    }

    /// Creates a host with Alice's participant, which has not announced its writer.
    pub fn unannounced() -> Self {
        Self::unannounced_with(Settings::default())
    }

    fn unannounced_with(settings: Settings) -> Self {
        let mut observer = Observer::new(settings);
        observer.input(Input::Watchlist(Arc::new(
            Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap(),
        )));
        observer.input(Input::Time(Timestamp(START)));
        let mut host = Self {
            observer,
            now: START,
        };
        host.participant(ALICE, "10.0.0.1:7411".parse().unwrap());
        host
    }

    /// Announces Alice's writer, with this reliability.
    pub fn writer(&mut self, reliable: bool) {
        let payload = forge::endpoint(Guid::new(ALICE, WRITER), "rt/chatter", STRING, reliable);
        self.announce(Message::from(ALICE).data(SEDP_WRITERS, 1, &payload));
    }

    pub fn participant(&mut self, prefix: GuidPrefix, unicast: SocketAddrV4) {
        let payload = forge::participant_at(prefix, 1_000_000, Some(0), &[unicast]);
        self.announce(Message::from(prefix).data(SPDP, 1, &payload));
    }

    /// Adds a participant with one reader, at this unicast port.
    pub fn reader(&mut self, prefix: GuidPrefix, port: u16) -> CapturePoint {
        let address = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), port);
        self.participant(prefix, address);
        self.subscribe(prefix, 1);
        CapturePoint {
            socket: port.into(),
            address,
            directed: None,
            flags: flag::HOST,
        }
    }

    /// Announces a reader; `number` is the announcement's sequence number.
    pub fn subscribe(&mut self, prefix: GuidPrefix, number: u64) {
        self.subscribe_with(prefix, number, true);
    }

    /// Announces a reader with this reliability.
    pub fn subscribe_with(&mut self, prefix: GuidPrefix, number: u64, reliable: bool) {
        let guid = Guid::new(prefix, READER);
        let payload = forge::endpoint(guid, "rt/chatter", STRING, reliable);
        self.announce(Message::from(prefix).data(SEDP_READERS, number, &payload));
    }

    pub fn unsubscribe(&mut self, prefix: GuidPrefix, number: u64) {
        let guid = Guid::new(prefix, READER);
        self.announce(Message::from(prefix).dispose_by_hash(SEDP_READERS, number, guid));
    }

    /// Adds a participant with a reader of another topic only.
    pub fn bystander(&mut self, prefix: GuidPrefix, port: u16) -> CapturePoint {
        let address = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), port);
        self.participant(prefix, address);
        let payload = forge::endpoint(Guid::new(prefix, READER), "rt/other", STRING, true);
        self.announce(Message::from(prefix).data(SEDP_READERS, 1, &payload));
        CapturePoint {
            socket: port.into(),
            address,
            directed: None,
            flags: flag::HOST,
        }
    }

    /// Reports that the participant's process owns the socket, as its own packets show.
    pub fn owner(&mut self, seen: CapturePoint, prefix: GuidPrefix) {
        let process_id = u32::from(prefix.0[2]);
        let sending = 1000 + u64::from(process_id);
        for cookie in [sending, seen.socket] {
            self.observer.input(Input::Socket(SocketFacts {
                cookie,
                process_id: Some(process_id),
                process: Some("listener".into()),
                ..SocketFacts::default()
            }));
        }
        let out = Record {
            kind: kind::ACKNACK,
            reader: guid_words(Guid::new(prefix, READER)),
            writer: guid_words(Guid::new(ALICE, WRITER)),
            flags: flag::HOST | flag::OUTGOING,
            socket: sending,
            sequence_number: 1,
            time: self.now,
            ..Record::default()
        };
        observe(&mut self.observer, &out);
    }

    pub fn announce(&mut self, message: Message) {
        let envelope = Envelope {
            ..forge::multicast(self.now, 0)
        };
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    pub fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * MILLISECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    /// Returns a record of Alice's writer.
    pub fn record(&self, seen: CapturePoint, kind: u8, number: u64) -> Record {
        let [a, b, c, d] = seen.address.ip().octets();
        let directed = seen
            .directed
            .map_or_else(Guid::default, |prefix| Guid::new(prefix, EntityId::UNKNOWN));
        let seconds = self.now / 1_000_000_000;
        let fraction = ((self.now % 1_000_000_000) << 32) / 1_000_000_000;
        Record {
            kind,
            submessage_flags: 5,
            writer: guid_words(Guid::new(ALICE, WRITER)),
            reader: guid_words(directed),
            time: self.now,
            sequence_number: number,
            source_timestamp: seconds << 32 | fraction,
            destination: [
                0,
                0,
                u32::from_ne_bytes([0, 0, 0xff, 0xff]),
                u32::from_ne_bytes([a, b, c, d]),
            ],
            destination_port: seen.address.port(),
            datagram_len: 200,
            payload_len: 100,
            flags: seen.flags,
            socket: seen.socket,
            ..Record::default()
        }
    }

    pub fn put(&mut self, record: Record) {
        observe(&mut self.observer, &record);
    }

    pub fn data(&mut self, seen: CapturePoint, number: u64) {
        self.put(self.record(seen, kind::DATA, number));
    }

    /// Reports that the socket's buffer was full for this sample.
    pub fn socket_full(&mut self, seen: CapturePoint, number: u64) {
        let arrival = self.record(seen, kind::DATA, number);
        self.put(Record {
            flags: seen.flags | flag::SOCKET_FULL,
            ..arrival
        });
        self.put(arrival);
    }

    /// Returns a record of `count` fragments of a sample that has ten.
    pub fn fragments(&self, seen: CapturePoint, number: u64, start: u32, count: u32) -> Record {
        Record {
            fragment_start: start,
            fragments: count << 16 | 1000,
            sample_size: 9500,
            payload_len: count * 1000,
            submessage_flags: 1,
            datagram_len: 1100,
            ..self.record(seen, kind::DATA_FRAG, number)
        }
    }

    pub fn heartbeat(&mut self, seen: CapturePoint, first: u64, last: u64) {
        self.put(Record {
            payload_len: u32::try_from(last >> 32).unwrap(),
            encapsulation: last as u32,
            ..self.record(seen, kind::HEARTBEAT, first)
        });
    }

    /// Sends an ACKNACK of Bob's reader for all samples below `base`.
    pub fn acknack(&mut self, bob: CapturePoint, base: u64) {
        self.request(bob, base, 0, 0);
    }

    /// Sends an ACKNACK of Bob's reader that also requests some of the next `bits` samples.
    pub fn request(&mut self, bob: CapturePoint, base: u64, bits: u32, bitmap: u32) {
        self.put(Record {
            reader: guid_words(Guid::new(BOB, READER)),
            stamp_seconds: bits,
            stamp_nanoseconds: bitmap,
            ..self.record(bob.leaving(), kind::ACKNACK, base)
        });
    }

    /// Announces that this sample will not be sent.
    pub fn gap(&mut self, seen: CapturePoint, number: u64) {
        self.put(Record {
            payload_len: 0,
            encapsulation: u32::try_from(number).unwrap() + 1,
            ..self.record(seen, kind::GAP, number)
        });
    }

    pub fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
    }

    pub fn topic(&self) -> TopicFacts {
        let mut topics = self.snapshot().topics.into_iter();
        topics.find(|topic| topic.name == "/chatter").unwrap()
    }

    pub fn measurement(&self) -> Measurement {
        *self.topic().measurement.unwrap()
    }

    /// Returns the deliveries at receivers.
    pub fn deliveries(&self) -> Vec<DeliveryFacts> {
        let mut deliveries = self.topic().deliveries;
        deliveries.retain(|each| each.direction == Direction::Received);
        deliveries
    }

    /// Returns the sequence numbers that any receiver lost by this cause.
    pub fn losses(&self, cause: LossCause) -> Vec<u64> {
        let losses = self.observer.journal().delivery_losses();
        let mut lost: Vec<_> = losses
            .filter(|loss| loss.cause == cause)
            .flat_map(|loss| loss.first.0..=loss.last.0)
            .collect();
        lost.sort_unstable();
        lost
    }
}
