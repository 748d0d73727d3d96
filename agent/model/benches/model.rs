//! Costs of the core: per datagram, kernel record, discovery announcement and tick, and for a whole
//! capture.
#![expect(clippy::unwrap_used, reason = "a benchmark may panic on its own input")]

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_capture::border::observe;
use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, Expansion, Guid, GuidPrefix, Record, Timestamp};

const START: u64 = 1_795_143_000_000_000_000;
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";

fn guid(index: u16) -> Guid {
    let [high, low] = index.to_be_bytes();
    Guid::new(ALICE, EntityId([0, high, low, 3]))
}

/// Returns an observer of one participant with this many measured writers, each of its own topic.
fn observer(writers: u16) -> Observer {
    sharing(writers, writers)
}

/// Returns an observer of one participant with this many measured writers of this many topics.
fn sharing(writers: u16, topics: u16) -> Observer {
    let mut observer = Observer::new(Settings::default());
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap(),
    )));
    observer.input(Input::Time(Timestamp(START)));
    let envelope = forge::multicast(START, 0);
    let spdp = forge::participant(ALICE, 1_000_000, Some(0));
    let spdp = Message::from(ALICE).data(SPDP, 1, &spdp).bytes();
    observer.input(Input::Datagram {
        envelope: &envelope,
        payload: &spdp,
        handover: None,
    });
    for index in 0..writers {
        observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &sedp(index, index % topics),
            handover: None,
        });
    }
    observer
}

fn sedp(index: u16, topic: u16) -> Vec<u8> {
    let payload = forge::endpoint(guid(index), &format!("rt/topic_{topic}"), IMAGE, true);
    Message::from(ALICE)
        .data(SEDP_WRITERS, index.into(), &payload)
        .bytes()
}

fn samples(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("model");
    group.throughput(Throughput::Elements(1));
    let mut world = observer(100);
    let mut number = 0;
    let template = Message::from(ALICE)
        .info_ts(START)
        .data(guid(7).entity, 0, &[0; 324])
        .bytes();
    group.bench_function("datagram to sample", |bencher| {
        bencher.iter(|| {
            number += 1;
            let mut datagram = template.clone();
            // The offset follows the header, INFO_TS, and the fixed fields of DATA before the low
            // number.
            if let Some(low) = datagram.get_mut(20 + 12 + 4 + 16..20 + 12 + 4 + 20) {
                low.copy_from_slice(&u32::try_from(number).unwrap().to_le_bytes());
            }
            let envelope = forge::multicast(START + number * 100_000, 0);
            world.input(Input::Datagram {
                envelope: black_box(&envelope),
                payload: black_box(&datagram),
                handover: None,
            });
        });
    });
    let mut world = observer(100);
    let mut number = 0;
    group.bench_function("record to sample", |bencher| {
        bencher.iter(|| {
            number += 1;
            let record = Record {
                kind: kind::DATA,
                submessage_flags: 5,
                writer: guid_words(guid(7)),
                time: START + number * 100_000,
                sequence_number: number,
                payload_len: 324,
                source_timestamp: 1_795_143_000 << 32,
                ..Record::default()
            };
            observe(&mut world, black_box(&record));
        });
    });
    let mut world = observer(100);
    let mut fragment = 0;
    group.bench_function("record of ten fragments", |bencher| {
        bencher.iter(|| {
            // A sample of 2.72 MB, in 203 datagrams of ten fragments each.
            let record = Record {
                kind: kind::DATA_FRAG,
                submessage_flags: 1,
                writer: guid_words(guid(7)),
                time: START + fragment * 10_000,
                sequence_number: 1 + fragment / 203,
                fragment_start: u32::try_from(fragment % 203).unwrap() * 10 + 1,
                fragments: 10 << 16 | 1344,
                sample_size: 203 * 10 * 1344,
                ..Record::default()
            };
            fragment += 1;
            observe(&mut world, black_box(&record));
        });
    });
    group.finish();
}

/// Records of the host hook for samples that one writer sends to four receivers.
fn deliveries(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("deliveries");
    group.throughput(Throughput::Elements(1));
    let at = |number: u64, socket: u64| Record {
        kind: kind::DATA,
        submessage_flags: 5,
        writer: guid_words(guid(7)),
        time: START + number * 100_000 + socket,
        sequence_number: number,
        payload_len: 324,
        source_timestamp: 1_795_143_000 << 32,
        destination: [
            0,
            0,
            u32::from_be(0xffff),
            u32::from_ne_bytes([10, 0, 0, 2]),
        ],
        destination_port: u16::try_from(7411 + socket).unwrap(),
        flags: flag::HOST,
        socket,
        ..Record::default()
    };
    for (name, lost) in [
        ("record to four receivers", u64::MAX),
        ("record to four receivers that lose a tenth", 10),
    ] {
        let mut world = observer(100);
        let mut count = 0;
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                count += 1;
                let (number, socket) = (count / 4 + 1, count % 4 + 1);
                let record = at(number, socket);
                if (number + socket) % lost != 0 {
                    observe(&mut world, black_box(&record));
                }
                if count % 4000 == 0 {
                    world.input(Input::Time(Timestamp(record.time)));
                }
            });
        });
    }
    let mut world = observer(100);
    let mut count = 0;
    group.bench_function("record that leaves and arrives", |bencher| {
        bencher.iter(|| {
            count += 1;
            let (number, leaves) = (count / 2 + 1, count % 2 == 0);
            let mut record = at(number, 1);
            if leaves {
                record.flags |= flag::OUTGOING;
            }
            observe(&mut world, black_box(&record));
        });
    });
    group.finish();
}

fn discovery(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("discovery");
    let envelope = forge::multicast(START, 0);
    group.bench_function("new endpoint", |bencher| {
        let announcements: Vec<_> = (0..1000).map(|index| sedp(index, index)).collect();
        bencher.iter_batched(
            || observer(0),
            |mut world| {
                for announcement in &announcements {
                    world.input(Input::Datagram {
                        envelope: &envelope,
                        payload: announcement,
                        handover: None,
                    });
                }
                world
            },
            BatchSize::LargeInput,
        );
    });
    let mut world = observer(1000);
    let again = sedp(500, 500);
    group.bench_function("known endpoint", |bencher| {
        bencher.iter(|| {
            world.input(Input::Datagram {
                envelope: black_box(&envelope),
                payload: black_box(&again),
                handover: None,
            });
        });
    });
    group.finish();
}

fn housekeeping(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("a thousand measured writers");
    let mut world = observer(1000);
    let mut now = START;
    group.bench_function("one second of ticks", |bencher| {
        bencher.iter(|| {
            now += 1_000_000_000;
            world.input(Input::Time(Timestamp(now)));
        });
    });
    group.bench_function("snapshot", |bencher| {
        bencher.iter(|| black_box(world.snapshot(Timestamp(now))));
    });
    group.finish();
}

/// One second of a robot with a thousand topics of five writers each, of which the first `sending`
/// writers send ten messages. The host hook reports each at one socket.
fn seconds(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("a second of a thousand topics");
    group.sample_size(20);
    for (name, sending) in [("idle", 0), ("1000 writers at 10 Hz", 1000)] {
        let mut world = sharing(5000, 1000);
        let (mut now, mut number) = (START, 0);
        let mut pass = |sending: u16| {
            for _ in 0..10 {
                number += 1;
                for writer in 0..sending {
                    let record = Record {
                        kind: kind::DATA,
                        submessage_flags: 5,
                        writer: guid_words(guid(writer)),
                        time: now + u64::from(writer) * 10_000,
                        sequence_number: number,
                        payload_len: 324,
                        source_timestamp: 1_795_143_000 << 32,
                        destination_port: 7411,
                        flags: flag::HOST,
                        socket: 1,
                        ..Record::default()
                    };
                    observe(&mut world, &record);
                }
                now += 100_000_000;
                world.input(Input::Time(Timestamp(now)));
            }
        };
        pass(5000);
        (0..20).for_each(|_| pass(sending));
        group.bench_function(name, |bencher| bencher.iter(|| pass(black_box(sending))));
    }
    group.finish();
}

fn captures(criterion: &mut Criterion) {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let mut group = criterion.benchmark_group("replay");
    group.sample_size(20);
    for name in [
        "cyclonedds/lifecycle-2ns",
        "cyclonedds/points-besteffort-lossy-2ns",
    ] {
        let path = data.join(name).join("capture.pcap.gz");
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let mut world = observer(0);
                let mut reader = PcapReader::open(&path, Expansion::Limited).unwrap();
                FrameDecoder::new(Limits::default())
                    .run(&mut reader, &mut world)
                    .unwrap();
                world
            });
        });
    }
    group.finish();
}

criterion_group!(
    benches,
    samples,
    deliveries,
    discovery,
    housekeeping,
    seconds,
    captures
);
criterion_main!(benches);
