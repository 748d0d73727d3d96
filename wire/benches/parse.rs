//! Measures the parsers on real datagrams: the walk over all submessages of a datagram, the
//! announcements of a participant and of an endpoint, and a `ros_discovery_info` sample.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a benchmark may panic on its own input"
)]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_wire::discovery::{self, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::record::Sample;
use ros2probe_wire::rtps::{InlineQos, Payload, VendorId};
use ros2probe_wire::walk::{self, Envelope};

macro_rules! captured {
    ($file:literal) => {
        include_bytes!(concat!("../tests/data/datagrams/", $file, ".bin")).as_slice()
    };
}

/// Returns the vendor and the payload of a datagram's first DATA.
fn first_data(datagram: &[u8]) -> (VendorId, Payload<'_>) {
    let vendor = VendorId([datagram[6], datagram[7]]);
    let mut payload = None;
    walk::datagram(datagram, &Envelope::default(), None, |found| {
        if matches!(found.record.sample(), Some(Sample::Data(_))) {
            payload.get_or_insert(found.payload());
        }
    });
    (vendor, payload.unwrap())
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
                let mut count = 0;
                walk::datagram(black_box(datagram), &Envelope::default(), None, |found| {
                    black_box(found);
                    count += 1;
                });
                count
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
        let (vendor, payload) = first_data(datagram);
        group.bench_function(format!("participant {name}"), |bencher| {
            let payload = black_box(payload);
            bencher.iter(|| discovery::participant(vendor, payload, &InlineQos::default()));
        });
    }
    for (name, datagram) in [
        ("fast", captured!("fast-sedp-writer")),
        ("cyclone", captured!("jazzy-sedp")),
    ] {
        let (vendor, payload) = first_data(datagram);
        group.bench_function(format!("endpoint {name}"), |bencher| {
            let payload = black_box(payload);
            bencher
                .iter(|| discovery::endpoint(Role::Writer, vendor, payload, &InlineQos::default()));
        });
    }
    let (_, payload) = first_data(captured!("cyclone-entities"));
    group.bench_function("node of fifteen endpoints", |bencher| {
        bencher.iter(|| ParticipantEntities::parse(black_box(payload.bytes())));
    });
    let topic = DdsTopic::parse("rq/robot1/fibonacci/_action/send_goalRequest").unwrap();
    group.bench_function("kind of a topic", |bencher| {
        bencher.iter(|| black_box(&topic).demangle());
    });
    group.finish();
}

criterion_group!(benches, messages, announcements);
criterion_main!(benches);
