//! How long a scrape of a large robot takes: the capture thread never waits for it, but a core does.

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use ros2probe_daemon::surface::{Board, Exposition, Format, Settings, SourceKind};
use ros2probe_testing::sample_robot;

fn scrape(criterion: &mut Criterion) {
    let names: Vec<String> = (0..1_000)
        .map(|index| format!("/robot/sensor_{index:04}"))
        .collect();
    let mut group = criterion.benchmark_group("scrape_1000_topics");
    group.sample_size(20);
    for (name, histograms) in [("counters", false), ("histograms", true)] {
        let settings = Settings {
            histograms,
            ..Settings::default()
        };
        let board = Arc::new(Board::new(SourceKind::Wire, settings));
        let snapshot = sample_robot::snapshot(names.iter().map(String::as_str));
        board.publish(snapshot, sample_robot::agent());
        let exposition = Exposition::new(board);
        for format in [Format::OpenMetrics, Format::Classic] {
            group.bench_function(format!("{name}_{format:?}"), |bencher| {
                bencher.iter(|| exposition.render(format));
            });
        }
    }
    group.finish();
}

criterion_group!(benches, scrape);
criterion_main!(benches);
