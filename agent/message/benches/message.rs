//! Time of decoding: an Imu, published 200 times per second, and a point cloud of 644 KB, of which
//! `echo` shows 128 octets.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_message::yaml::{self, Style};
use ros2probe_message::{Library, Limits, Sources, Truncation, decode};

const IMU: usize = 324;
const CLOUD: usize = 644_000;

/// Returns zeros after the encapsulation, which decode as an Imu with an empty frame.
fn imu() -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    payload.resize(IMU, 0);
    payload
}

fn cloud() -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    // Stamp, frame, height, width, no fields, endianness, steps.
    payload.extend([0; 8]);
    payload.extend(b"\x02\0\0\0l\0\0\0\x01\0\0\0\x9d\x4e\0\0\0\0\0\0\0\0\0\0");
    payload.extend(32_u32.to_le_bytes());
    let length = u32::try_from(CLOUD).unwrap_or(u32::MAX).to_le_bytes();
    payload.extend(length);
    payload.extend(length);
    payload.extend((0..CLOUD).map(|index| (index % 251) as u8));
    payload.push(1);
    payload
}

fn message(criterion: &mut Criterion) {
    let library = Library::new(Sources::default());
    let echo = Truncation {
        truncate: Some(128),
        ..Truncation::default()
    };
    let kept = Limits {
        kept: 128,
        ..Limits::default()
    };
    let mut group = criterion.benchmark_group("message");
    for (name, payload) in [
        ("sensor_msgs/msg/Imu", imu()),
        ("sensor_msgs/msg/PointCloud2", cloud()),
    ] {
        let Ok(message_type) = library.find(name, None) else {
            continue;
        };
        group.throughput(Throughput::Elements(1));
        group.bench_function(format!("decode_{name}"), |bencher| {
            bencher.iter(|| decode(&message_type, black_box(&payload), &kept).is_ok());
        });
        let Ok(decoded) = decode(&message_type, &payload, &kept) else {
            continue;
        };
        for (shown_name, shown) in [("echo", echo), ("full", Truncation::default())] {
            group.bench_function(format!("{shown_name}_{name}"), |bencher| {
                bencher.iter(|| yaml::document(&decoded.message, &shown, Style::Block).len());
            });
        }
    }
    group.finish();
}

criterion_group!(benches, message);
criterion_main!(benches);
