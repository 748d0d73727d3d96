//! The metrics page after reports about calls inside processes, and `rp inside` without reports.

use std::sync::Arc;
use std::time::Duration;

use crate::rp;
use ros2probe_daemon::agent_facts::{AgentFacts, InsideSourceFacts, SourceKind};
use ros2probe_daemon::config::{Limits, Watch, Watchlist};
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_model::facts::calls::report::{
    BufferReport, CallbackReport, Durations, ProcessReport, PublisherReport, Report, ThreadStates,
    Transition, Trigger,
};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{self, Observer};
use ros2probe_testing::local_agent;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;

/// Returns an observer that has received a report in each of ten seconds. A managed node, whose
/// timer takes 4 ms, publishes `/scan` at 20 Hz.
fn observed() -> Observer {
    let mut observer = Observer::new(observer::Settings::default());
    observer.input(Input::Time(Timestamp(START)));
    let watches = Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watches)));
    for second in 1..=10 {
        let now = START + second * SECOND;
        let mut durations = Durations::default();
        for _ in 0..20 * second {
            durations.observe(Duration::from_millis(4));
        }
        let process = ProcessReport {
            id: 70,
            name: Some("lidar".into()),
            domain_id: DomainId(3),
            nodes: vec!["/lidar".into()],
            shows_intra_process: true,
            publishers: vec![PublisherReport {
                handle: 1,
                node: None,
                topic: "/scan".into(),
                middleware: Some("rmw_zenoh_cpp".into()),
                published: 20 * second,
                within_process: 0,
                last: Timestamp(now - SECOND / 2),
                intervals: Durations::default(),
            }],
            buffers: vec![BufferReport {
                handle: 2,
                node: None,
                topic: Some("/scan".into()),
                enqueued: 20 * second,
                overwritten: second,
                dequeued: 19 * second,
                depth: 2,
                max_depth: 3,
                capacity: None,
                last: Timestamp(now - SECOND / 2),
                waiting: durations.clone(),
            }],
            callbacks: vec![CallbackReport {
                handle: 3,
                node: None,
                trigger: Trigger::Timer(Some(Duration::from_millis(50))),
                thread: 71,
                calls: 20 * second,
                last: Timestamp(now - SECOND / 2),
                durations,
                waits: Durations::default(),
                skipped: 2,
                states: ThreadStates::default(),
            }],
            ..ProcessReport::default()
        };
        let transition = Transition {
            process: 70,
            node: None,
            start: "activating".into(),
            goal: "active".into(),
            at: Timestamp(now - SECOND / 2),
        };
        observer.input(Input::Inside(Report {
            at: Timestamp(now - SECOND / 2),
            has_callbacks: true,
            processes: vec![process],
            transitions: vec![transition],
            late: Vec::new(),
        }));
        observer.input(Input::Time(Timestamp(now)));
    }
    observer
}

fn page(observer: &Observer, source: Option<InsideSourceFacts>) -> String {
    let settings = Settings {
        watches: vec![Arc::new(Watch::named("/**").unwrap())],
        histograms: true,
        per_writer: false,
        diagnostic_values: Vec::new(),
        limits: Limits::default(),
    };
    let sources = MetricSources::new(SourceKind::Host, settings);
    let agent = AgentFacts {
        inside: source,
        ..AgentFacts::new(SourceKind::Host, std::time::Instant::now())
    };
    let snapshot = observer.snapshot(Timestamp(START + 10 * SECOND));
    sources.latest.publish(snapshot, agent);
    Exposition::new(sources)
        .render(Format::OpenMetrics)
        .unwrap()
}

#[test]
fn reports_of_calls_become_series() {
    let source = InsideSourceFacts {
        mode: "full",
        counters: vec![("hits", 777)],
        ..InsideSourceFacts::default()
    };
    let page = page(&observed(), Some(source));
    let topic = "domain_id=\"3\",topic=\"/scan\"";
    let callback = "domain_id=\"3\",ros_node=\"/lidar\",trigger=\"timer\",name=\"50ms\"";
    let node = "domain_id=\"3\",ros_node=\"/lidar\"";
    for expected in [
        format!("ros2_topic_messages_total{{{topic}}} 200"),
        format!("ros2_topic_source_info{{{topic},source=\"inside\"}} 1"),
        format!("ros2_topic_inside_published_messages_total{{{topic}}} 200"),
        format!("ros2_intra_process_enqueued_messages_total{{{topic}}} 200"),
        format!("ros2_intra_process_overwritten_messages_total{{{topic}}} 10"),
        format!("ros2_intra_process_buffered_messages{{{topic}}} 2"),
        format!("ros2_callback_duration_seconds_count{{{callback}}} 200"),
        format!("ros2_callback_duration_seconds_bucket{{le=\"0.005\",{callback}}} 200"),
        format!("ros2_callback_duration_seconds_bucket{{le=\"0.002\",{callback}}} 0"),
        format!("ros2_callback_duration_max_seconds{{{callback}}} 0.004"),
        format!("ros2_timer_skipped_periods_total{{{callback}}} 2"),
        format!("ros2_node_lifecycle_state{{{node},state=\"active\"}} 1"),
        "ros2probe_inside_info{mode=\"full\",reason=\"\"} 1".to_owned(),
        "ros2probe_inside_events_total{event=\"hits\"} 777".to_owned(),
        "ros2probe_inside_processes{state=\"counted\"} 1".to_owned(),
        "ros2probe_callbacks_not_shown 0".to_owned(),
    ] {
        assert!(
            page.lines().any(|line| line == expected),
            "{expected}\n{page}"
        );
    }
    let value = |series: &str| {
        let mut lines = page.lines();
        let line = lines.find_map(|line| line.strip_prefix(&format!("{series} ")));
        line.unwrap_or_else(|| panic!("no {series}"))
            .parse::<f64>()
            .unwrap()
    };
    let rate = value(&format!("ros2_topic_rate_hertz{{{topic}}}"));
    assert!((rate - 20.0).abs() < 0.1, "{rate}");
    let busy = value(&format!("ros2_node_callback_busy_ratio{{{node}}}"));
    assert!((busy - 0.08).abs() < 0.001, "{busy}");
    // Reports of calls contain no sizes.
    assert!(!page.contains(&format!("ros2_topic_bytes_total{{{topic}}}")));
    assert!(!page.contains(&format!("ros2_topic_bandwidth_bytes_per_second{{{topic}}}")));
}

#[test]
fn long_durations_become_series_with_their_length() {
    let mut observer = Observer::new(observer::Settings::default());
    observer.input(Input::Time(Timestamp(START)));
    let watches = Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watches)));
    let mut calls = Durations::default();
    let mut waits = Durations::default();
    for second in 1..=10 {
        let now = START + second * SECOND;
        if second == 9 {
            calls.observe(Duration::from_secs(3_600));
            waits.observe(Duration::from_secs(86_400));
        }
        observer.input(Input::Inside(Report {
            at: Timestamp(now),
            has_callbacks: true,
            processes: vec![ProcessReport {
                id: 70,
                nodes: vec!["/slow".into()],
                callbacks: vec![CallbackReport {
                    handle: 3,
                    node: None,
                    trigger: Trigger::Timer(None),
                    thread: 71,
                    calls: calls.count(),
                    last: Timestamp(now),
                    durations: calls.clone(),
                    waits: waits.clone(),
                    skipped: 0,
                    states: ThreadStates::default(),
                }],
                ..ProcessReport::default()
            }],
            transitions: Vec::new(),
            late: Vec::new(),
        }));
        observer.input(Input::Time(Timestamp(now)));
    }
    let page = page(&observer, None);
    let callback = "domain_id=\"0\",ros_node=\"/slow\",trigger=\"timer\",name=\"\"";
    for expected in [
        format!("ros2_callback_duration_max_seconds{{{callback}}} 3600.0"),
        format!("ros2_callback_duration_p99_seconds{{{callback}}} 3600.0"),
        format!("ros2_callback_wait_p99_seconds{{{callback}}} 86400.0"),
        format!("ros2_callback_busy_ratio{{{callback}}} 1.0"),
        format!("ros2_callback_duration_seconds_bucket{{le=\"10.0\",{callback}}} 0"),
        format!("ros2_callback_duration_seconds_sum{{{callback}}} 3600.0"),
    ] {
        assert!(
            page.lines().any(|line| line == expected),
            "{expected}\n{page}"
        );
    }
}

#[test]
fn without_reports_the_page_has_no_series_of_calls() {
    let observer = Observer::new(observer::Settings::default());
    let page = page(&observer, None);
    for name in [
        "ros2_topic_source_info{",
        "ros2_callback_",
        "ros2probe_inside_",
    ] {
        let has_any = page
            .lines()
            .any(|line| line.starts_with(name) && !line.starts_with('#'));
        assert!(!has_any, "{name}");
    }
}

#[test]
fn without_the_source_the_command_prints_how_to_enable_it() {
    let capture = local_agent::capture();
    let run = |arguments: &[&str]| {
        let mut command = rp();
        command.arg("inside").args(arguments).arg("--replay");
        command.arg(&capture).output().unwrap()
    };
    let output = run(&[]);
    assert_eq!(output.status.code(), Some(1));
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("capture.inside is off"), "{error}");
    let output = run(&["--json"]);
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["mode"], "off");
    assert_eq!(answer["callbacks"], serde_json::json!([]));
}

#[test]
fn without_the_source_no_call_is_late_and_the_command_prints_the_reason() {
    let capture = local_agent::capture();
    let run = |arguments: &[&str]| {
        let mut command = rp();
        command.arg("why").args(arguments).arg("--replay");
        command.arg(&capture).output().unwrap()
    };
    let output = run(&[]);
    assert_eq!(output.status.code(), Some(1));
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(
        error.contains("capture.inside or capture.late is off"),
        "{error}"
    );
    let output = run(&["--json", "--above", "5", "--last", "10m"]);
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["observed"], "off");
    assert_eq!(answer["callbacks"], serde_json::json!([]));
    let output = run(&["--json", "--chain", "/a", "/b"]);
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["callbacks"], serde_json::json!([]));
    assert_eq!(run(&["/a", "--chain", "/b", "/c"]).status.code(), Some(2));
    assert_eq!(run(&["--at", "12:36:04"]).status.code(), Some(1));
    for wrong in [
        ["--above", "-1"],
        ["--above", "x"],
        ["--last", "soon"],
        ["--at", "noon"],
    ] {
        let output = run(&[&format!("{}={}", wrong[0], wrong[1])]);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
    }
}
