//! CPU time of the kernel filter per datagram, by verdict, and of the same walk in user space. The
//! kernel measures the time (BPF_PROG_TEST_RUN). A datagram of many IP fragments runs the program
//! once per fragment, as on a link of MTU 1500. Every measured run is about 25 ns too long. The
//! benchmark needs root.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a benchmark may panic on its own input"
)]

use std::collections::BTreeMap;
use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_testing::program_run::{self, Hook, Kernel};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

/// IP payload of a frame at MTU 1500.
const FRAME: usize = 1480;
/// Number of runs before the record ring is emptied: the ring must not fill up.
const BATCH: u32 = 1000;
const WRITER: Guid = Guid::new(
    GuidPrefix(*b"\x01\x0fbenchbench"),
    EntityId([0, 0, 0x11, 3]),
);

/// Returns datagrams as the DDS implementations send them.
fn datagrams() -> [(&'static str, Vec<u8>); 3] {
    [
        ("320 B DATA", program_run::message(WRITER, 1..=1, 320)),
        ("13.4 KB, 10 fragments, as Cyclone DDS", fragments(10, 1344)),
        ("65 KB, 1 fragment, as Fast DDS", fragments(1, 65_000)),
    ]
}

/// Returns an RTPS message of INFO_TS and the first fragments, each of `size` bytes, of a large
/// sample.
fn fragments(count: u16, size: u16) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
    bytes.extend_from_slice(&WRITER.prefix.0);
    bytes.extend_from_slice(&[0x09, 1, 8, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
    bytes.extend_from_slice(&[0x16, 1]);
    bytes.extend_from_slice(&(32 + count * size).to_le_bytes());
    bytes.extend_from_slice(&[0, 0, 28, 0, 0, 0, 0, 0]);
    bytes.extend_from_slice(&WRITER.entity.0);
    bytes.extend_from_slice(&[0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
    bytes.extend_from_slice(&count.to_le_bytes());
    bytes.extend_from_slice(&size.to_le_bytes());
    bytes.extend_from_slice(&2_720_000_u32.to_le_bytes());
    let payload = [0, 1, 0, 0].into_iter().cycle();
    bytes.extend(payload.take((count * size).into()));
    bytes
}

fn in_the_kernel(criterion: &mut Criterion) {
    let mut kernel = Kernel::load();
    for verdict in [Verdict::Ignore, Verdict::Meter, Verdict::Capture] {
        let mut group = criterion.benchmark_group(format!("kernel {verdict:?}"));
        group
            .sample_size(20)
            .measurement_time(Duration::from_secs(1));
        for (name, payload) in datagrams() {
            kernel.set_interest(&BTreeMap::from([(WRITER, verdict)]));
            let mut frames = program_run::fragments(&payload, FRAME, false, 0);
            let mut identification = 0_u16;
            group.throughput(Throughput::Elements(1));
            group.bench_function(name, |bencher| {
                bencher.iter_custom(|iterations| {
                    time(&mut kernel, &mut frames, &mut identification, iterations)
                });
            });
        }
        group.finish();
    }
}

/// Compares the hooks on the most frequent traffic: a datagram in one frame, and packets that are
/// not RTPS.
fn by_hook(criterion: &mut Criterion) {
    let writer = program_run::message(WRITER, 1..=1, 320);
    let mut tcp = program_run::datagram(&[0; 400]);
    tcp[9] = 6;
    let packets = [
        ("TCP", Verdict::Ignore, tcp),
        (
            "other UDP",
            Verdict::Ignore,
            program_run::datagram(&[0; 400]),
        ),
        (
            "DATA, ignored",
            Verdict::Ignore,
            program_run::datagram(&writer),
        ),
        (
            "DATA, metered",
            Verdict::Meter,
            program_run::datagram(&writer),
        ),
    ];
    for (name, verdict, packet) in packets {
        let mut group = criterion.benchmark_group(name);
        group
            .sample_size(20)
            .measurement_time(Duration::from_secs(1));
        for hook in [Hook::Wire, Hook::Ingress, Hook::Egress] {
            let mut kernel = Kernel::load_hook(hook);
            kernel.set_interest(&BTreeMap::from([(WRITER, verdict)]));
            let mut frames = [packet.clone()];
            group.throughput(Throughput::Elements(1));
            group.bench_function(format!("{hook:?}"), |bencher| {
                bencher
                    .iter_custom(|iterations| time(&mut kernel, &mut frames, &mut 0, iterations));
            });
        }
        group.finish();
    }
}

/// Returns the time of `iterations` datagrams, without the pauses between them.
fn time(
    kernel: &mut Kernel,
    frames: &mut [Vec<u8>],
    identification: &mut u16,
    iterations: u64,
) -> Duration {
    let mut total = Duration::ZERO;
    let mut left = u32::try_from(iterations).unwrap();
    while left > 0 {
        let repeat = match frames {
            [frame] => {
                let repeat = left.min(BATCH);
                total += kernel.time(frame, repeat);
                repeat
            }
            _ => {
                *identification = identification.wrapping_add(1);
                for frame in frames.iter_mut() {
                    frame[4..6].copy_from_slice(&identification.to_be_bytes());
                    total += kernel.time(frame, 1);
                }
                1
            }
        };
        left -= repeat;
        kernel.drain();
    }
    total
}

fn in_user_space(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("user-space walk");
    for (name, payload) in datagrams() {
        group.throughput(Throughput::Elements(1));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let mut of_writers = 0_u32;
                let envelope = Envelope::default();
                walk::datagram(black_box(&payload), &envelope, None, |found| {
                    of_writers += u32::from(walk::fate(&found.record) == walk::Fate::Writer);
                });
                of_writers
            });
        });
    }
    group.finish();
}

criterion_group!(benches, in_the_kernel, by_hook, in_user_space);
criterion_main!(benches);
