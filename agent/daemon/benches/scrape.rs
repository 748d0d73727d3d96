//! Duration of a scrape of a large robot. The capture thread never waits for it, but it occupies a
//! core.

use criterion::{Criterion, criterion_group, criterion_main};
use ros2probe_daemon::agent_facts::SourceKind;
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_testing::sample_robot;

fn scrape(criterion: &mut Criterion) {
    for count in [200, 1_000] {
        let names: Vec<String> = (0..count)
            .map(|index| format!("/robot/sensor_{index:04}"))
            .collect();
        let mut group = criterion.benchmark_group(format!("scrape_{count}_topics"));
        group.sample_size(20);
        for (name, histograms) in [("counters", false), ("histograms", true)] {
            let settings = Settings {
                histograms,
                ..Settings::default()
            };
            let sources = MetricSources::new(SourceKind::Wire, settings);
            let snapshot = sample_robot::snapshot(names.iter().map(String::as_str));
            let state = sources.latest.publish(snapshot, sample_robot::agent());
            sources.limits.note(&state);
            let exposition = Exposition::new(sources);
            for format in [Format::OpenMetrics, Format::Classic] {
                group.bench_function(format!("{name}_{format:?}"), |bencher| {
                    bencher.iter(|| exposition.render(format));
                });
            }
        }
        group.finish();
    }
}

criterion_group!(benches, scrape);
criterion_main!(benches);
