//! How long the parsers take over real datagrams: all submessages of one, a participant's and an
//! endpoint's announcement, and a `ros_discovery_info` sample.

#![expect(clippy::unwrap_used, reason = "a benchmark may panic on its own input")]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_wire::discovery::{self, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::rtps::{Body, Data, InlineQos, Message, VendorId};

macro_rules! captured {
    ($file:literal) => {
        include_bytes!(concat!("../tests/data/datagrams/", $file, ".bin")).as_slice()
    };
}

fn first_data(datagram: &[u8]) -> (VendorId, Data<'_>) {
    Message::parse(datagram)
        .unwrap()
        .find_map(|submessage| {
            let submessage = submessage.unwrap();
            match submessage.body {
                Body::Data(data) => Some((submessage.receiver.vendor, data)),
                _ => None,
            }
        })
        .unwrap()
}

fn messages(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("message");
    for (name, datagram) in [
        ("gap and heartbeat", captured!("fast-gap")),
        ("eleven submessages", captured!("cyclone-sedp")),
        ("ten fragments", captured!("cyclone-data-frag")),
    ] {
        group.throughput(Throughput::Elements(1));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                Message::parse(black_box(datagram))
                    .unwrap()
                    .flatten()
                    .count()
            });
        });
    }
    group.finish();
}

fn announcements(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("discovery");
    for (name, datagram) in [
        ("fast", captured!("fast-spdp")),
        ("cyclone", captured!("jazzy-spdp")),
    ] {
        let (vendor, data) = first_data(datagram);
        group.bench_function(format!("participant {name}"), |bencher| {
            let payload = black_box(data.payload);
            bencher.iter(|| discovery::participant(vendor, payload, &InlineQos::default()));
        });
    }
    for (name, datagram) in [
        ("fast", captured!("fast-sedp-writer")),
        ("cyclone", captured!("jazzy-sedp")),
    ] {
        let (vendor, data) = first_data(datagram);
        group.bench_function(format!("endpoint {name}"), |bencher| {
            let payload = black_box(data.payload);
            bencher
                .iter(|| discovery::endpoint(Role::Writer, vendor, payload, &InlineQos::default()));
        });
    }
    let (_, data) = first_data(captured!("cyclone-entities"));
    group.bench_function("node of fifteen endpoints", |bencher| {
        bencher.iter(|| ParticipantEntities::parse(black_box(data.payload.bytes())));
    });
    let topic = DdsTopic::parse("rq/robot1/fibonacci/_action/send_goalRequest").unwrap();
    group.bench_function("kind of a topic", |bencher| {
        bencher.iter(|| black_box(&topic).kind());
    });
    group.finish();
}

criterion_group!(benches, messages, announcements);
criterion_main!(benches);
