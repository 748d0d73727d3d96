//! Speed of writing bags: bytes of messages per second, for each preset.
#![expect(clippy::unwrap_used, reason = "a benchmark may panic")]

use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_bag::{Compression, Options, Storage, TopicDescription, TopicId, Writer};
use ros2probe_wire::Timestamp;

const CLOUDS: usize = 24;

/// Points of a lidar: x, y, z, intensity as floats, noisy in their low bits.
fn cloud() -> Vec<u8> {
    let mut data = vec![0, 1, 0, 0];
    let mut noise = 0x1234_5678_u32;
    for index in 0..170_000_u32 {
        noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let angle = f64::from(index) * 0.003;
        let range = 10.0 + f64::from(noise >> 16) * 1e-6;
        let point = [
            angle.cos() * range,
            angle.sin() * range,
            f64::from(index / 1800) * 0.1,
            40.0,
        ];
        for value in point {
            #[expect(clippy::cast_possible_truncation, reason = "as a lidar's driver does")]
            data.extend_from_slice(&(value as f32).to_le_bytes());
        }
    }
    data
}

fn create(directory: &Path, storage: Storage) -> (Writer, TopicId) {
    let options = Options {
        storage,
        ..Options::default()
    };
    let mut writer = Writer::create(&directory.join("bag"), options).unwrap();
    let topic = writer.topic(TopicDescription {
        name: "/points".into(),
        type_name: "sensor_msgs/msg/PointCloud2".into(),
        type_hash: None,
        publishers: Vec::new(),
        schema: None,
    });
    (writer, topic.unwrap())
}

fn write(c: &mut Criterion) {
    let clouds = (cloud(), CLOUDS);
    let imu: Vec<u8> = cloud().into_iter().take(324).collect();
    let small = (imu, 100_000);
    let lz4 = Storage {
        compression: Compression::Lz4,
        ..Storage::default()
    };
    let presets = [
        ("none", Storage::default()),
        ("fastwrite", Storage::preset("fastwrite").unwrap()),
        ("lz4", lz4),
        ("zstd_fast", Storage::preset("zstd_fast").unwrap()),
        ("zstd_small", Storage::preset("zstd_small").unwrap()),
    ];
    for (size, (message, count)) in [("2.7 MB", clouds), ("324 B", small)] {
        let mut group = c.benchmark_group(format!("bag of {size} messages"));
        group.throughput(Throughput::Bytes((message.len() * count) as u64));
        group.sample_size(10);
        for (name, storage) in presets {
            group.bench_function(name, |b| {
                b.iter_batched(
                    || tempfile::tempdir_in("/dev/shm").unwrap(),
                    |directory| {
                        let (mut writer, topic) = create(directory.path(), storage);
                        for index in 0..count as u64 {
                            let time = Timestamp(1_795_142_331_000_000_000 + index * 50_000_000);
                            writer.write(topic, time, time, index, &message).unwrap();
                        }
                        black_box(writer.close(BTreeMap::new()).unwrap());
                        directory
                    },
                    BatchSize::PerIteration,
                );
            });
        }
        group.finish();
    }
}

criterion_group!(benches, write);
criterion_main!(benches);
