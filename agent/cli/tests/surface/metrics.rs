//! The metrics page is complete, bounded, and well-formed in both formats, whatever the network
//! sends.

mod markdown;

use ros2probe_model::report::snapshot::ChainsFacts;
use ros2probe_wire::DomainId;
use std::collections::BTreeSet;
use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::Arc;

use ros2probe_daemon::agent_facts::{Ability, AgentFacts, SourceKind};
use ros2probe_daemon::config::{Expectations, Limits, Watch};
use ros2probe_daemon::recording::SnapshotFigures;
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::ros2_daemon::PortState;
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_metrics::catalogue::{CATALOGUE, Kind};
use ros2probe_metrics::otlp::Signal;
use ros2probe_model::facts::bounded::Table;
use ros2probe_model::facts::tables::ALL;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{
    DeliveryFacts, Direction, Snapshot, WatchFacts, WatchState, WatchedTopicFacts,
};
use ros2probe_testing::local_agent::promtool;
use ros2probe_testing::sample_robot;

fn settings() -> Settings {
    let expectations = Expectations {
        min_rate_hz: Some(10.0),
        ..Expectations::default()
    };
    Settings {
        watches: vec![Arc::new(Watch {
            expectations,
            per_subscriber: true,
            ..Watch::named("/**").unwrap()
        })],
        histograms: true,
        per_writer: true,
        diagnostic_values: vec!["lidar*/packet rate*".to_owned()],
        limits: Limits::default(),
    }
}

fn page(snapshot: Snapshot, settings: Settings, format: Format) -> String {
    let sources = MetricSources::new(SourceKind::Wire, settings);
    let state = sources.latest.publish(snapshot, sample_robot::agent());
    sources.limits.note(&state);
    sources.exports.enable(Signal::Metrics);
    sources.exports.enable(Signal::Events);
    sources.remote_write.enable();
    sources.ros2_daemon.set_port(0, PortState::Listening);
    let state = tempfile::tempdir().unwrap();
    sources.disk_history.keep_in(state.path(), 1 << 20);
    assert!(sources.disk_history.open());
    sources
        .recordings
        .snapshot("incident", SnapshotFigures::default());
    Exposition::new(sources).render(format).unwrap()
}

fn sample<'a>(page: &'a str, series: &str) -> Option<&'a str> {
    page.lines()
        .find_map(|line| line.strip_prefix(series)?.strip_prefix(' '))
}

#[test]
fn the_page_has_exactly_the_metrics_of_the_catalogue() {
    let page = page(
        sample_robot::snapshot(["/points"]),
        settings(),
        Format::Classic,
    );
    let kind = |kind: Kind| {
        if kind == Kind::Info {
            "gauge"
        } else {
            kind.label()
        }
    };
    let wanted: Vec<String> = CATALOGUE
        .iter()
        .map(|metric| format!("# TYPE {} {}", metric.name, kind(metric.kind)))
        .collect();
    let shown: Vec<&str> = page
        .lines()
        .filter(|line| line.starts_with("# TYPE"))
        .collect();
    assert_eq!(shown, wanted);
    for metric in CATALOGUE {
        let bucket = |line: &&str| line.starts_with(metric.name) && !line.starts_with('#');
        assert!(
            page.lines().any(|line| bucket(&line)),
            "{} has no sample",
            metric.name
        );
        assert!(page.contains(&format!("# HELP {} {}\n", metric.name, metric.help)));
    }
}

/// Returns the page of `docs/` that lists a metric.
fn page_of(metric: &str) -> &'static str {
    let begins = |prefixes: &[&str]| prefixes.iter().any(|prefix| metric.starts_with(prefix));
    if begins(&["ros2probe_zenoh_"]) {
        "zenoh.md"
    } else if begins(&["ros2probe_otlp_", "ros2probe_remote_write_"]) {
        "metrics-exports.md"
    } else if begins(&["ros2probe_", "process_"]) {
        "metrics-agent.md"
    } else if begins(&["ros2_topic_"]) {
        "metrics-topics.md"
    } else if begins(&[
        "ros2_writer_",
        "ros2_subscriber_",
        "ros2_reader_",
        "ros2_socket_",
    ]) {
        "metrics-endpoints.md"
    } else {
        "metrics-graph.md"
    }
}

/// Returns the rows of the catalogue that a page lists, with the head of the table.
fn metrics_on(page: &str) -> String {
    let table = markdown::metrics();
    let is_shown = |(number, line): &(usize, &str)| match line.split('`').nth(1) {
        Some(metric) if *number > 1 => page_of(metric) == page,
        _ => true,
    };
    let shown = table.split_inclusive('\n').enumerate().filter(is_shown);
    shown.map(|(_, line)| line).collect()
}

#[test]
fn the_tables_in_the_book_equal_those_of_the_sources() {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    let hint = "run `UPDATE_DOCS=1 cargo test -p ros2probe --test surface metrics::` and commit";
    let metrics = |page| {
        (
            page,
            "catalogue.rs -->\n",
            "<!-- metrics: end",
            metrics_on(page),
        )
    };
    let is_derived = |table: &Table| {
        let derived = [
            "calls",
            "chain",
            "client_hellos",
            "inside",
            "links",
            "references",
            "services",
            "spans",
            "trace",
            "zenoh",
        ];
        derived.iter().any(|name| table.name.starts_with(name))
    };
    let is_of_robot = |table: &Table| {
        let of_robot = [
            "robot_",
            "log_",
            "diagnostics",
            "parameter",
            "changed_",
            "transform",
            "clock",
        ];
        of_robot.iter().any(|name| table.name.starts_with(name))
    };
    let declared = |page, tables: &[Table]| {
        let (begin, end) = ("/tables.rs -->\n", "<!-- tables: end");
        (page, begin, end, markdown::tables(tables))
    };
    let tables = |page, derived| {
        let tables = ALL.iter().filter(|table| !is_of_robot(table));
        let tables = tables.filter(|table| is_derived(table) == derived);
        declared(page, &tables.copied().collect::<Vec<_>>())
    };
    let of_robot: Vec<_> = (ALL.iter().copied()).filter(is_of_robot).collect();
    let agent = [
        ros2probe_daemon::tables::ALL,
        ros2probe_metrics::tables::ALL,
        ros2probe::tables::ALL,
    ]
    .concat();
    for (page, begin, end, wanted) in [
        metrics("metrics-graph.md"),
        metrics("metrics-topics.md"),
        metrics("metrics-endpoints.md"),
        metrics("metrics-agent.md"),
        metrics("metrics-exports.md"),
        metrics("zenoh.md"),
        (
            "events.md",
            "events/table.rs -->\n",
            "<!-- events: end",
            markdown::events(),
        ),
        (
            "limits.md",
            "model/src/facts/limits.rs -->\n",
            "<!-- limits: end",
            markdown::limits(),
        ),
        tables("limits-model.md", false),
        tables("limits-tables.md", true),
        declared("limits-robot.md", &of_robot),
        declared("limits-capture.md", ros2probe_capture::tables::ALL),
        (
            "limits-tables.md",
            "agent/cli/src/tables.rs -->\n",
            "<!-- tables: end",
            markdown::tables(&agent),
        ),
    ] {
        let path = docs.join(page);
        let text = std::fs::read_to_string(&path).unwrap();
        let (before, rest) = text.split_once(begin).unwrap();
        let (table, after) = rest.split_once(end).unwrap();
        assert!(wanted.lines().count() > 3, "{page} lists nothing");
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(path, format!("{before}{begin}{wanted}{end}{after}")).unwrap();
        } else {
            assert_eq!(table, wanted, "{page}: {hint}");
        }
    }
}

#[test]
fn metric_values_equal_the_snapshot() {
    let page = page(
        sample_robot::snapshot(["/points"]),
        settings(),
        Format::Classic,
    );
    let topic = "{domain_id=\"0\",topic=\"/points\"}";
    let late = "{domain_id=\"0\",ros_node=\"/lidar\",trigger=\"subscription\",name=\"/points\",\
                stage=\"callback\",cause=\"runnable\"}";
    for (name, value) in [("calls", "1"), ("seconds", "0.07")] {
        let series = format!("ros2_late_{name}_total{late}");
        assert_eq!(sample(&page, &series), Some(value), "{series}");
    }
    for (series, value) in [
        ("ros2_topic_messages_total", "123456"),
        ("ros2_topic_bytes_total", "79504384000"),
        ("ros2_topic_lost_messages_total", "12"),
        ("ros2_topic_publishers", "1"),
        ("ros2_topic_rate_hertz", "19.98"),
        (
            "ros2_topic_last_message_timestamp_seconds",
            // The shortest form of 1700000000.1234567 as the encoder writes it.
            "1700000000.1234568",
        ),
        ("ros2_topic_interarrival_seconds_count", "1000"),
    ] {
        assert_eq!(
            sample(&page, &format!("{series}{topic}")),
            Some(value),
            "{series}\n{page}"
        );
    }
    let bucket = |le: &str| {
        let labels = format!("{{domain_id=\"0\",topic=\"/points\",le=\"{le}\"}}");
        sample(
            &page,
            &format!("ros2_topic_interarrival_seconds_bucket{labels}"),
        )
    };
    assert_eq!(
        (bucket("0.02"), bucket("+Inf")),
        (Some("540"), Some("1000"))
    );
    let watch = "domain_id=\"0\",topic=\"/points\",watch=\"/**\"";
    for (series, value) in [
        (
            format!("ros2_watch_state{{{watch},state=\"violated\"}}"),
            "1",
        ),
        (format!("ros2_watch_state{{{watch},state=\"ok\"}}"), "0"),
        (
            format!("ros2_watch_expectation_violated{{{watch},expectation=\"min_rate_hz\"}}"),
            "1",
        ),
    ] {
        assert_eq!(sample(&page, &series), Some(value), "{series}");
    }
}

/// Name, cause and value of the sums by topic.
const SUMS: [(&str, &str, &str); 14] = [
    ("ros2_topic_sent_messages_total", "", "1000"),
    ("ros2_topic_delivered_messages_total", "", "900"),
    ("ros2_topic_delivery_lost_messages_total", "sender", "25"),
    (
        "ros2_topic_delivery_lost_messages_total",
        "before_host",
        "60",
    ),
    (
        "ros2_topic_delivery_lost_messages_total",
        "reassembly",
        "20",
    ),
    (
        "ros2_topic_delivery_lost_messages_total",
        "socket_buffer",
        "15",
    ),
    (
        "ros2_topic_delivery_lost_messages_total",
        "reader_queue",
        "7",
    ),
    ("ros2_topic_delivery_pending_messages", "", "1"),
    ("ros2_topic_delivery_recovered_messages_total", "", "3"),
    ("ros2_topic_delivery_irrelevant_messages_total", "", "5"),
    ("ros2_topic_delivery_unmatched_messages_total", "", "4"),
    ("ros2_topic_acknowledgement_lag_messages", "", "56"),
    ("ros2_topic_acknowledgement_lag_seconds", "", "2.75"),
    ("ros2_topic_transit_seconds_count", "", "1000"),
];

#[test]
fn deliveries_are_summed_by_topic_and_shown_separately_if_a_watch_enables_it() {
    let snapshot = sample_robot::snapshot(["/points"]);
    let asked = page(snapshot.clone(), settings(), Format::Classic);
    let topic = "domain_id=\"0\",topic=\"/points\"";
    let prefix = "01".repeat(12);
    let sent = format!("{topic},writer=\"{prefix}.00000103\",destination=\"10.0.0.2:7411\"");
    let received = format!("{sent},subscriber=\"participant {prefix}.000001c1\"");
    let reader = format!(
        "{topic},writer=\"{prefix}.00000103\",reader=\"{prefix}.00000203\",ros_node=\"/mapper\""
    );
    let details = format!(
        "{topic},destination=\"10.0.0.2:7411\",subscriber=\"participant {prefix}.000001c1\",\
         ros_node=\"/mapper\",participant=\"{prefix}.000001c1\",process=\"mapper\",pid=\"42\",\
         cgroup=\"/robot.slice\""
    );
    let each = [
        ("ros2_writer_sent_messages_total", &sent, "", "1000"),
        (
            "ros2_subscriber_received_messages_total",
            &received,
            "",
            "900",
        ),
        (
            "ros2_subscriber_lost_messages_total",
            &received,
            "sender",
            "25",
        ),
        (
            "ros2_subscriber_lost_messages_total",
            &received,
            "reassembly",
            "20",
        ),
        (
            "ros2_subscriber_lost_messages_total",
            &received,
            "socket_buffer",
            "15",
        ),
        (
            "ros2_subscriber_lost_messages_total",
            &received,
            "reader_queue",
            "7",
        ),
        ("ros2_subscriber_pending_messages", &received, "", "1"),
        (
            "ros2_subscriber_recovery_seconds_total",
            &received,
            "",
            "0.25",
        ),
        (
            "ros2_reader_acknowledgement_lag_messages",
            &reader,
            "",
            "56",
        ),
        ("ros2_reader_requested_messages_total", &reader, "", "9"),
        ("ros2_subscriber_info", &details, "", "1"),
    ];
    let series = |name: &str, labels: &str, cause: &str| match cause {
        "" => format!("{name}{{{labels}}}"),
        cause => format!("{name}{{{labels},cause=\"{cause}\"}}"),
    };
    for (name, cause, value) in SUMS {
        let series = series(name, topic, cause);
        assert_eq!(sample(&asked, &series), Some(value), "{series}\n{asked}");
    }
    for (name, labels, cause, value) in each {
        let series = series(name, labels, cause);
        assert_eq!(sample(&asked, &series), Some(value), "{series}\n{asked}");
    }
    let drops = "socket=\"77\",process=\"mapper\",pid=\"42\",cgroup=\"/robot.slice\"";
    let drops = format!("ros2_socket_unidentified_drops_total{{{drops}}}");
    assert_eq!(sample(&asked, &drops), Some("5"));

    let mut plain = settings();
    Arc::make_mut(&mut plain.watches[0]).per_subscriber = false;
    let plain = page(snapshot, plain, Format::Classic);
    for (name, cause, value) in SUMS {
        let series = series(name, topic, cause);
        assert_eq!(sample(&plain, &series), Some(value), "{series}");
    }
    for (name, ..) in each {
        assert!(!plain.contains(&format!("\n{name}{{")), "{name}");
    }
}

#[test]
fn series_of_deliveries_are_capped_and_unique() {
    let mut snapshot = sample_robot::snapshot(["/points"]);
    let topic = &mut snapshot.topics[0];
    // The oldest unacknowledged message of this reader is older than the remembered messages.
    topic.acknowledgements[0].lag_seconds = None;
    let one = sample_robot::delivery(Direction::Received);
    topic.deliveries = (0..2_000_u16)
        .flat_map(|host| {
            let destination = (Ipv4Addr::from(0x0a00_0000 + u32::from(host)), 7411).into();
            let delivery = DeliveryFacts {
                destination,
                process: Some("\"}\n\\".into()),
                ..one.clone()
            };
            // Two sockets with equal labels are one series.
            [delivery.clone(), delivery]
        })
        .collect();
    let page = page(snapshot, settings(), Format::Classic);
    let shown = |line: &&str| line.starts_with("ros2_subscriber_received_messages_total{");
    assert_eq!(page.lines().filter(shown).count(), 1_000);
    assert!(
        page.lines()
            .filter(shown)
            .all(|line| line.ends_with(" 1800"))
    );
    assert_eq!(
        sample(&page, "ros2probe_deliveries_not_shown"),
        Some("2000")
    );
    let lag = "ros2_topic_acknowledgement_lag_seconds{domain_id=\"0\",topic=\"/points\"}";
    assert_eq!(sample(&page, lag), Some("+Inf"));
    assert_eq!(promtool(&page), "");
}

#[test]
fn promtool_accepts_the_page() {
    let sources = MetricSources::new(SourceKind::Wire, settings());
    let starting = Exposition::new(sources).render(Format::Classic).unwrap();
    assert_eq!(promtool(&starting), "");
    let page = page(
        sample_robot::snapshot(["/points", "/imu"]),
        settings(),
        Format::Classic,
    );
    assert_eq!(promtool(&page), "");
}

#[test]
fn hostile_names_are_escaped_in_their_label() {
    let long = format!("/{}", "\u{e9}".repeat(10_000));
    let longer = format!("{long}x");
    let names = [
        "/a\"} 1\nros2_topic_messages_total{topic=\"forged",
        "/back\\slash",
        "/tab\tand\rreturn",
        "/\u{1F916}",
        "",
        &long,
        &longer,
    ];
    let page = page(sample_robot::snapshot(names), settings(), Format::Classic);
    assert_eq!(promtool(&page), "");
    assert!(page.lines().all(|line| line.len() < 1_000));
    let messages = |line: &&str| line.starts_with("ros2_topic_messages_total{");
    let series: Vec<&str> = page.lines().filter(messages).collect();
    assert_eq!(series.len(), names.len());
    assert_eq!(series.iter().collect::<BTreeSet<_>>().len(), names.len());
}

#[test]
fn no_series_appears_twice() {
    let mut snapshot = sample_robot::snapshot(["/points", "/points"]);
    let mut dds = sample_robot::topic("/points");
    (dds.kind, dds.dds_name) = (TopicKind::Dds, "/points".into());
    snapshot.topics.push(dds);
    let mut request = sample_robot::topic("/points");
    (request.kind, request.dds_name) = (TopicKind::ServiceRequest, "rq/pointsRequest".into());
    snapshot.topics.push(request);
    let nodes = snapshot.nodes.clone();
    snapshot.nodes.extend(nodes);
    snapshot.watches.clear();
    let page = page(snapshot, settings(), Format::Classic);
    let series: Vec<&str> = page
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.rsplit_once(' ').unwrap().0)
        .collect();
    assert_eq!(series.iter().collect::<BTreeSet<_>>().len(), series.len());
    assert_eq!(sample(&page, "ros2probe_topics_not_shown"), Some("1"));
    for name in ["/points", "dds:/points", "rq/pointsRequest"] {
        let series = format!("ros2_topic_publishers{{domain_id=\"0\",topic=\"{name}\"}}");
        assert_eq!(sample(&page, &series), Some("1"), "{name}");
    }
}

#[test]
fn a_watched_topic_without_endpoints_begins_at_zero() {
    let missing = WatchedTopicFacts {
        domain_id: DomainId(0),
        topic: "/cmd_vel".into(),
        state: WatchState::NotPublished,
        violations: Vec::new(),
    };
    let watch = WatchFacts {
        watch: Arc::new(Watch {
            domain_id: Some(DomainId(0)),
            ..Watch::named("/cmd_vel").unwrap()
        }),
        topics: vec![missing],
    };
    let snapshot = Snapshot {
        watches: vec![watch],
        ..Snapshot::default()
    };
    let page = page(snapshot, settings(), Format::Classic);
    for name in [
        "publishers",
        "messages_total",
        "bytes_total",
        "lost_messages_total",
    ] {
        let series = format!("ros2_topic_{name}{{domain_id=\"0\",topic=\"/cmd_vel\"}}");
        assert_eq!(sample(&page, &series), Some("0"), "{name}");
    }
    let labels = "domain_id=\"0\",topic=\"/cmd_vel\",watch=\"/cmd_vel@0\",state=\"not_published\"";
    assert_eq!(
        sample(&page, &format!("ros2_watch_state{{{labels}}}")),
        Some("1")
    );
}

#[test]
fn measured_topics_have_priority_at_the_cap() {
    let mut snapshot = sample_robot::snapshot(["/z_measured"]);
    snapshot.watches.clear();
    for index in 0..2_000 {
        let mut topic = sample_robot::topic(&format!("/forged{index:04}"));
        topic.measurement = None;
        snapshot.topics.push(topic);
    }
    let page = page(snapshot, settings(), Format::Classic);
    let series = |line: &&str| line.starts_with("ros2_topic_publishers{");
    assert_eq!(page.lines().filter(series).count(), 1_000);
    assert!(page.contains("topic=\"/z_measured\""));
    assert_eq!(sample(&page, "ros2probe_topics_not_shown"), Some("1001"));
    assert_eq!(sample(&page, "ros2probe_tracked_topics"), Some("1"));
}

#[test]
fn the_source_with_its_abilities_and_its_reason_is_exported() {
    let facts = AgentFacts {
        source_reason: Some("no cgroup v2 hierarchy".to_owned()),
        ..sample_robot::agent()
    };
    let sources = MetricSources::new(SourceKind::Wire, settings());
    let state = sources.latest.publish(Snapshot::default(), facts);
    sources.limits.note(&state);
    let wire = Exposition::new(sources).render(Format::Classic).unwrap();
    let info = "source=\"wire\",reason=\"no cgroup v2 hierarchy\"";
    let info = format!("ros2probe_capture_source_info{{{info}}}");
    assert_eq!(sample(&wire, &info), Some("1"), "{wire}");
    for ability in Ability::ALL {
        let series = format!(
            "ros2probe_capture_ability{{ability=\"{}\"}}",
            ability.label()
        );
        let able = [Ability::Sent, Ability::Forwarded].contains(&ability);
        let value = if able { "1" } else { "0" };
        assert_eq!(sample(&wire, &series), Some(value), "{series}");
    }
}

#[test]
fn both_formats_have_the_same_samples() {
    let sources = MetricSources::new(SourceKind::Wire, settings());
    let state = sources.latest.publish(
        sample_robot::snapshot(["/points", "/imu"]),
        sample_robot::agent(),
    );
    sources.limits.note(&state);
    let exposition = Exposition::new(sources);
    let (open, classic) = (
        exposition.render(Format::OpenMetrics).unwrap(),
        exposition.render(Format::Classic).unwrap(),
    );
    assert!(open.ends_with("# EOF\n"));
    assert!(open.contains("# TYPE ros2_topic_messages counter\n"));
    assert!(open.contains("# TYPE ros2_topic info\n"));
    assert!(open.contains("# UNIT ros2_topic_interarrival_seconds seconds\n"));
    assert!(open.contains("_bucket{le=\"0.00001\",") && classic.contains(",le=\"1e-05\"}"));
    // Values that change between scrapes are omitted.
    let samples = |page: &str| -> BTreeSet<String> {
        let steady = |line: &&str| {
            ![
                "#",
                "process_",
                "ros2probe_scrape",
                "ros2probe_snapshot_age",
            ]
            .iter()
            .any(|prefix| line.starts_with(prefix))
        };
        page.lines().filter(steady).map(normalised).collect()
    };
    assert_eq!(samples(&open), samples(&classic));
}

/// Returns the sample with the bound of its bucket at the end, and with numbers as Rust writes
/// them. The formats differ in both respects.
fn normalised(sample: &str) -> String {
    let number = |text: &str| text.parse::<f64>().unwrap();
    let (series, value) = sample.rsplit_once(' ').unwrap();
    let value = number(value);
    let bound = ["{le=\"", ",le=\""]
        .iter()
        .find_map(|label| series.split_once(label));
    let Some((before, after)) = bound else {
        return format!("{series} {value:?}");
    };
    let (bound, after) = after.split_once('"').unwrap();
    let labels = after.trim_start_matches(',').trim_end_matches('}');
    let separator = if before.contains('{') { ',' } else { '{' };
    let series = format!("{before}{separator}{labels}")
        .trim_end_matches(',')
        .to_owned();
    format!("{series}}} le={:?} {value:?}", number(bound))
}

#[test]
fn the_format_follows_the_accept_header() {
    for (accept, format) in [
        ("", Format::Classic),
        ("*/*", Format::Classic),
        ("text/html,application/xhtml+xml,*/*;q=0.8", Format::Classic),
        ("application/openmetrics-text", Format::OpenMetrics),
        (
            "application/openmetrics-text;version=1.0.0,application/openmetrics-text;\
             version=0.0.1;q=0.75,text/plain;version=0.0.4;q=0.5,*/*;q=0.1",
            Format::OpenMetrics,
        ),
        (
            "application/openmetrics-text; version=1.0.0; q=0.2, text/plain; q=0.9",
            Format::Classic,
        ),
        (
            "application/openmetrics-text;version=2.0.0",
            Format::Classic,
        ),
        ("application/openmetrics-text;q=0", Format::Classic),
    ] {
        assert_eq!(Format::negotiate(accept), format, "{accept}");
    }
}

#[test]
fn buckets_of_chains_have_exemplars_while_traces_are_exported() {
    let sources = MetricSources::new(SourceKind::Wire, settings());
    let snapshot = sample_robot::snapshot(["/points"]);
    sources.latest.publish(snapshot, sample_robot::agent());
    let exposition = Exposition::new(sources.clone());
    let render = |format| exposition.render(format).unwrap();
    let exemplars = |page: &str| page.matches(" # {trace_id=").count();
    assert_eq!(exemplars(&render(Format::OpenMetrics)), 0);
    sources.exports.enable(Signal::Traces);
    assert_eq!(exemplars(&render(Format::Classic)), 0);
    let page = render(Format::OpenMetrics);
    let lines: Vec<_> = page
        .lines()
        .filter(|line| line.contains("trace_id"))
        .collect();
    let [line] = lines[..] else {
        panic!("{lines:#?}")
    };
    // The exemplar is the newest of 100 durations of 16 ms, each of which has its own trace.
    assert!(line.starts_with("ros2_chain_latency_seconds_bucket{le=\"0.02\","));
    let wanted = " 100 # {trace_id=\"00000000000000000000000000000064\"} 0.016";
    assert!(line.contains(wanted), "{line}");
    assert_eq!(promtool(&render(Format::Classic)), "");
}

#[test]
fn a_page_of_a_thousand_measured_topics_stays_below_16_kb_a_topic() {
    let names: Vec<String> = (0..1_000)
        .map(|index| format!("/robot/sensor_{index:04}"))
        .collect();
    let mut snapshot = sample_robot::snapshot(names.iter().map(String::as_str));
    // The page is rendered without `capture.inside`, as by default.
    snapshot.inside = None;
    for topic in &mut snapshot.topics {
        topic.inside = None;
    }
    // The number of series of chains and of Zenoh does not depend on the number of topics.
    snapshot.chains = ChainsFacts::default();
    snapshot.zenoh = None;
    let mut settings = Settings {
        per_writer: false,
        ..settings()
    };
    Arc::make_mut(&mut settings.watches[0]).per_subscriber = false;
    let mut nothing = snapshot.clone();
    nothing.topics.clear();
    let own = page(nothing, settings.clone(), Format::Classic).len();
    let all = page(snapshot.clone(), settings.clone(), Format::Classic).len() - own;
    assert!(all < 16_000_000, "{all} bytes");
    let lean = page(
        snapshot,
        Settings {
            histograms: false,
            ..settings
        },
        Format::Classic,
    )
    .len();
    assert!(lean < 4_000_000, "{lean} bytes");
}
