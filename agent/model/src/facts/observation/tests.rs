//! Observations from records, for the tests of higher layers, and tests of the conversion.

use ros2probe_wire::Record;
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::rtps::SubmessageFlags;
use ros2probe_wire::{EntityId, Timestamp};

use super::*;
use crate::facts::wall_clock::WallClock;

/// Returns the observation of a record, whose time is used as model time.
pub(crate) fn observed(record: &Record) -> Observation {
    Observation::of(record, WallClock::default())
}

/// Returns the sample of a record, whose time is used as model time.
pub(crate) fn sample(record: &Record) -> Sample {
    *observed(record).sample().unwrap()
}

/// Returns the fragments of a record's sample.
pub(crate) fn fragments(sample: &Sample) -> DataFrag {
    let Content::DataFrag(fragments) = sample.content else {
        panic!("{sample:?}")
    };
    fragments
}

const WRITER: Guid = Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3]));
const READER: Guid = Guid::new(GuidPrefix([2; 12]), EntityId([0, 0, 1, 4]));

fn of_kind(kind: u8) -> Record {
    Record {
        kind,
        writer: guid_words(WRITER),
        reader: guid_words(READER),
        sequence_number: 7,
        payload_len: 2,
        encapsulation: 9,
        stamp_seconds: 3,
        stamp_nanoseconds: 0b101 << 29,
        fragment_start: 3,
        fragments: 2 << 16 | 1000,
        sample_size: 3001,
        ..Record::default()
    }
}

fn of_data(flags: u16) -> Record {
    Record {
        flags,
        submessage_flags: SubmessageFlags::DATA.0,
        ..of_kind(kind::DATA)
    }
}

#[test]
fn each_kind_of_record_converts_to_its_own_fields() {
    let data = sample(&of_data(flag::STAMP));
    assert_eq!(data.content, Content::Data { size: 2 });
    assert!(data.is_message() && data.is_start() && data.is_end() && data.is_delivered());
    assert_eq!(data.header_stamp, None, "too many nanoseconds");
    let part = sample(&of_kind(kind::DATA_FRAG));
    let (shown, size) = (fragments(&part), part.size());
    assert_eq!((shown.starting, shown.count, shown.total()), (3, 2, 4));
    assert_eq!((size, part.is_start(), part.is_end()), (3001, false, true));
    let Observation::Heartbeat(heartbeat) = observed(&of_kind(kind::HEARTBEAT)) else {
        panic!("a HEARTBEAT")
    };
    assert_eq!((heartbeat.first.0, heartbeat.last.0), (7, 2 << 32 | 9));
    let Observation::Gap(gap) = observed(&of_kind(kind::GAP)) else {
        panic!("a GAP")
    };
    assert_eq!((gap.start.0, gap.list.base.0), (7, 2 << 32 | 9));
    let Observation::AckNack(acknack) = observed(&of_kind(kind::ACKNACK)) else {
        panic!("an ACKNACK")
    };
    let missing: Vec<_> = acknack.missing.iter().map(|number| number.0).collect();
    assert_eq!((acknack.base().0, missing), (7, vec![7, 9]));
    for kind in [
        kind::DATA_BATCH,
        kind::HANDOVER,
        kind::UNDELIVERED,
        kind::COMPLETE,
        0,
    ] {
        let presence = observed(&of_kind(kind));
        assert!(matches!(presence, Observation::Presence(_)), "{kind}");
    }
}

#[test]
fn a_batch_becomes_its_samples_and_a_gap_of_the_numbers_between_them() {
    let each = |count, last, size| {
        let record = Record {
            fragment_start: count,
            sample_size: last,
            payload_len: size,
            ..of_kind(kind::DATA_BATCH)
        };
        let mut seen = Vec::new();
        Observation::each(&record, WallClock::default(), |each| {
            seen.push(match each {
                Observation::Sample(sample) => {
                    assert!(sample.is_message() && sample.is_delivered());
                    (sample.sequence_number.0, u64::from(sample.size()))
                }
                Observation::Gap(gap) => {
                    assert_eq!(gap.list.iter().count(), 0);
                    (gap.start.0, gap.list.base.0)
                }
                other => panic!("{other:?}"),
            });
        });
        seen
    };
    assert_eq!(each(3, 2, 32), [(7, 10), (8, 10), (9, 12)]);
    assert_eq!(each(2, 5, 8), [(7, 4), (12, 4), (8, 12)]);
    assert_eq!(each(1, 0, 8), [(7, 8)]);
    assert_eq!(each(0, 0, 8), []);
}

#[test]
fn the_sender_of_an_acknack_is_the_reader_and_otherwise_the_writer() {
    for kind in [kind::DATA, kind::HEARTBEAT, kind::GAP, kind::ACKNACK] {
        let shown = observed(&of_kind(kind));
        let (sender, addressee) = match kind {
            kind::ACKNACK => (READER, WRITER),
            _ => (WRITER, READER),
        };
        assert_eq!(shown.sender(), sender.prefix, "{kind}");
        assert_eq!(shown.addressee(), addressee.prefix, "{kind}");
    }
}

#[test]
fn flags_of_a_record_determine_one_path_and_one_fate() {
    let stream = |relayed, at_socket| Path::Stream { relayed, at_socket };
    for (flags, path) in [
        (0, Path::Wire),
        (flag::HOST, Path::Socket),
        (flag::SHM, Path::SharedMemory { exact: false }),
        (flag::SHM | flag::EXACT, Path::SharedMemory { exact: true }),
        (flag::STREAM, stream(false, false)),
        (flag::STREAM | flag::HOST, stream(false, true)),
        (flag::STREAM | flag::RELAYED, stream(true, false)),
    ] {
        assert_eq!(sample(&of_data(flags)).head.path, path, "{flags:#x}");
    }
    Observation::for_each_polled(&of_data(0), WallClock::default(), |polled| {
        assert!(polled.head().is_polled());
    });
    for (flags, fate) in [
        (flag::HOST, DatagramFate::Passed),
        (flag::HOST | flag::SOCKET_FULL, DatagramFate::SocketFull),
        (flag::NOT_REASSEMBLED, DatagramFate::NotReassembled),
    ] {
        assert_eq!(sample(&of_data(flags)).fate, fate, "{flags:#x}");
    }
}

#[test]
fn some_paths_prove_that_the_sender_is_on_this_host() {
    for (flags, interface, leaves) in [
        (0, 2, false),
        (0, LOOPBACK, true),
        (flag::OUTGOING, 2, true),
        (flag::HOST, LOOPBACK, false),
        (flag::HOST | flag::OUTGOING, 2, true),
        (flag::SHM, 0, true),
    ] {
        let record = Record {
            interface,
            ..of_data(flags)
        };
        assert_eq!(sample(&record).head.is_outgoing(), leaves, "{flags:#x}");
    }
}

#[test]
fn a_socket_is_part_of_a_route_only_if_it_receives() {
    let address = "10.0.0.2:7411".parse::<std::net::SocketAddr>().unwrap();
    let route = |flags| {
        let record = Record {
            destination: [
                0,
                0,
                u32::from_be(0xffff),
                u32::from_ne_bytes([10, 0, 0, 2]),
            ],
            destination_port: 7411,
            socket: 77,
            ..of_data(flags)
        };
        sample(&record).head.route()
    };
    let received = route(flag::HOST);
    assert_eq!(
        (received.direction, received.socket),
        (Direction::Received, 77)
    );
    assert_eq!(received.destination, Destination::from(address));
    let sent = route(flag::HOST | flag::OUTGOING);
    assert_eq!((sent.direction, sent.socket), (Direction::Sent, 0));
    assert_eq!(route(0).socket, 0);
}

#[test]
fn began_returns_the_model_time_of_the_first_datagram() {
    let record = Record {
        time: 50,
        elapsed: 30,
        ..of_data(0)
    };
    let mut clock = WallClock::default();
    clock.set(10);
    let head = *Observation::of(&record, clock).head();
    assert_eq!(head.at, clock.model_time(Timestamp(50)));
    assert_eq!(head.began(), ModelTime::from_nanoseconds(10));
    let early = Record { time: 10, ..record };
    assert_eq!(sample(&early).head.began(), ModelTime::ZERO);
}
