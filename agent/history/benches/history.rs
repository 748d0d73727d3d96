//! Bytes and time of a minute of 200 topics, and of a query over a day.
#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a benchmark may panic"
)]

use criterion::{Criterion, criterion_group, criterion_main};
use ros2probe_history::{Block, Series, Store, Tier, TopicName, TopicRow};

const TOPICS: u32 = 200;

/// Returns a number that looks random.
fn noise(seed: u32) -> u32 {
    let mut value = seed.wrapping_mul(0x9e37_79b9) ^ 0x85eb_ca6b;
    value ^= value >> 15;
    value = value.wrapping_mul(0x2c1b_3c6d);
    value ^ value >> 12
}

/// Returns the rows of a minute of a robot: rates of 1 to 1000 Hz with jitter, most topics with
/// messages of one size, latencies that vary by a third.
fn minute(begin: u32) -> Block {
    let rates = [1_u32, 10, 30, 50, 100, 200, 1000];
    let series: Vec<_> = (0..TOPICS)
        .map(|topic| {
            let rate = rates[topic as usize % rates.len()];
            let rows = (begin + 1..=begin + 60).map(|at| {
                let noise = |part: u32| noise(at.wrapping_mul(977) ^ topic << 20 ^ part << 29);
                let messages = rate + noise(0) % 3 - 1.min(rate);
                let size = 320 + u64::from(topic % 5 / 4 * (noise(1) % 900));
                let part = |part: u32| 1.0 + (noise(part) % 1000) as f32 / 3000.0;
                TopicRow {
                    at,
                    seconds: 1,
                    messages,
                    lost: u32::from(noise(2) % 5000 == 0),
                    bytes: u64::from(messages) * size,
                    latency: Some([3e-4 * part(3), 9e-4 * part(4)]),
                    interarrival: Some([part(5) / rate as f32, 1.3 * part(6) / rate as f32]),
                }
            });
            let name = TopicName {
                domain_id: 0,
                dds_name: format!("rt/robot/part_{topic}/state"),
            };
            Series {
                of: name,
                rows: rows.collect(),
            }
        })
        .collect();
    Block::of_topics(begin, begin + 60, &series)
}

fn history(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), 1 << 30).unwrap();
    let hours = 24;
    for begin in (0..hours * 3600).step_by(60) {
        store.append(Tier::Seconds, &[minute(begin)]).unwrap();
        store.condense(begin + 60).unwrap();
    }
    let rows = f64::from(TOPICS) * 60.0 * 60.0 * f64::from(hours);
    let bytes = store.facts().bytes as f64;
    println!(
        "{:.2} bytes for each topic and second, {:.1} MB a day",
        bytes / rows,
        bytes / 1e6
    );
    let mut begin = hours * 3600;
    criterion.bench_function("a minute of 200 topics is written", |bencher| {
        bencher.iter(|| {
            store.append(Tier::Seconds, &[minute(begin)]).unwrap();
            begin += 60;
        });
    });
    let one = |name: &TopicName| name.dds_name == "rt/robot/part_7/state";
    for (name, times, step) in [
        ("an hour of one topic at 1 s is read", 3600..7200, 1),
        ("a day of one topic at 60 s is read", 0..86_400, 60),
    ] {
        criterion.bench_function(name, |bencher| {
            bencher.iter(|| {
                let mut count = 0;
                store.topics(times.clone(), step, &one, &mut |_, _| count += 1);
                count
            });
        });
    }
}

criterion_group!(benches, history);
criterion_main!(benches);
