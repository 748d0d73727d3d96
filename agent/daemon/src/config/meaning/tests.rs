use std::fmt::Write as _;

use ros2probe_message::Dialect;

use super::*;

fn report(source: &str) -> String {
    parse(source.as_bytes()).map_or_else(|mistakes| mistakes.report("f"), |_| String::new())
}

#[test]
fn an_empty_file_yields_the_defaults() {
    for empty in [
        "",
        "# nothing\n",
        "---\n",
        "watch:\nlimits:\ncapture:\nmetrics:\n",
        "{}",
    ] {
        assert_eq!(parse(empty.as_bytes()), Ok(Config::default()), "{empty:?}");
    }
    assert!(Config::default().watches.is_empty());
    assert_eq!(
        Config::default().metrics.listen.unwrap().to_string(),
        "127.0.0.1:17400"
    );
}

#[test]
fn ros2_daemon_accepts_a_word_or_a_map() {
    let read = |text: &str| parse(text.as_bytes()).unwrap().ros2_daemon;
    let setting = |is_on, distro| Ros2DaemonSettings { is_on, distro };
    for (text, expected) in [
        ("{}", setting(false, None)),
        ("ros2_daemon:\n", setting(false, None)),
        ("ros2_daemon: off", setting(false, None)),
        ("ros2_daemon: on", setting(true, None)),
        ("ros2_daemon: {}", setting(true, None)),
        ("ros2_daemon: {enabled: off}", setting(false, None)),
        (
            "ros2_daemon: {distro: lyrical}",
            setting(true, Some(Dialect::Rolling)),
        ),
        (
            "ros2_daemon: {enabled: on, distro: iron}",
            setting(true, Some(Dialect::Jazzy)),
        ),
    ] {
        assert_eq!(read(text), expected, "{text}");
    }
    assert_eq!(
        report("ros2_daemon: yes"),
        "f:1:14: ros2_daemon: is the text `yes`, must be one of on, off"
    );
    assert_eq!(
        report("ros2_daemon: 3"),
        "f:1:14: ros2_daemon: is `3`, must be one of on, off or a map of keys"
    );
    assert_eq!(
        report("ros2_daemon: {enabled: true}"),
        "f:1:24: ros2_daemon.enabled: is `true`, must be one of on, off"
    );
    assert_eq!(
        report("ros2_daemon: {distro: noetic}"),
        "f:1:23: ros2_daemon.distro: is the text `noetic`, must be one of humble, iron, jazzy, \
         kilted, lyrical, rolling"
    );
}

#[test]
fn every_mistake_is_reported_with_its_position() {
    let source = "\
watch:
  - /points
  - topic: /imu
    min_rate: 5
    max_loss_ratio: 3
  - topik: /scan
  - scan
metrics:
  listen: 17400
  per_writer: maybe
log: loud
limtis: {}
lgo: 1
";
    assert_eq!(
        report(source),
        "f:4:5: watch[1].min_rate: unknown key; did you mean `min_rate_hz`?\n\
             f:5:21: watch[1].max_loss_ratio: is 3, must be between 0 and 1\n\
             f:6:5: watch[2]: the key `topic` is missing\n\
             f:6:5: watch[2].topik: unknown key; did you mean `topic`?\n\
             f:7:5: watch[3]: must begin with a slash, as in `/points`\n\
             f:9:11: metrics.listen: is `17400`, must be text\n\
             f:10:15: metrics.per_writer: is the text `maybe`, must be true or false\n\
             f:11:6: log: is the text `loud`, must be one of error, warn, info, debug, trace\n\
             f:12:1: limtis: unknown key; did you mean `limits`?\n\
             f:13:1: lgo: unknown key; did you mean `log`?"
    );
}

#[test]
fn conditions_beyond_types_and_ranges_are_checked() {
    let source = "\
watch:
  - points
  - {topic: /a b}
capture:
  interfaces: {include: ['eth[']}
  network_namespaces: [robot]
metrics: {listen: localhost}
";
    assert_eq!(
        report(source),
        "f:2:5: watch[0]: must begin with a slash, as in `/points`\n\
             f:3:13: watch[1].topic: has the character ` `: ROS names have letters, digits and \
             `_`, globs also `*`\n\
             f:5:26: capture.interfaces.include[0]: unclosed character class; missing ']'\n\
             f:6:24: capture.network_namespaces[0]: must be an absolute path, as in \
             `/run/netns/robot`\n\
             f:7:19: metrics.listen: is `localhost`, must be an IP address and port, as in \
             `127.0.0.1:17400` or `[::1]:17400`, or `off`"
    );
}

#[test]
fn snapshot_triggers_accept_known_names_and_the_earlier_form() {
    let triggers = |keys: &str| {
        let source = format!("recordings: {{snapshots: [{{name: a, topics: [/a]{keys}}}]}}");
        let config = parse(source.as_bytes()).unwrap();
        let snapshot = &config.recordings.snapshots[0];
        let names = snapshot.triggers.iter().map(Trigger::name);
        (names.collect::<Vec<_>>(), snapshot.min_interval.as_secs())
    };
    assert_eq!(triggers(""), (vec!["expectation"], 10));
    assert_eq!(triggers(", on_violation: false"), (vec![], 10));
    assert_eq!(triggers(", trigger: [], seconds_after: 5"), (vec![], 15));
    let more = ", trigger: [duplicate_node, ros2.node.lost], min_interval_s: 0";
    let (expected, none) = (vec!["duplicate_node", "ros2.node.lost"], 0);
    assert_eq!(triggers(more), (expected, none));
    let snapshots = "recordings:\n  snapshots:\n    - name: a\n      topics: [/a]\n";
    let report = report(&format!(
        "{snapshots}      trigger: [violation]\n      on_violation: true\n"
    ));
    assert!(
        report.starts_with(
            "f:5:17: recordings.snapshots[0].trigger[0]: must be one of expectation, message_lost,"
        ),
        "{report}"
    );
}

#[test]
fn contradicting_and_repeated_watch_entries_are_reported() {
    let source = "\
watch:
  - {topic: /a, min_rate_hz: 5, max_rate_hz: 1}
  - /x
  - {topic: /x, domain: 3}
  - /x
";
    assert_eq!(
        report(source),
        "f:2:46: watch[0].max_rate_hz: is 1, below min_rate_hz, which is 5\n\
             f:5:5: watch[3]: repeats watch[1]"
    );
}

#[test]
fn what_the_robot_should_be_is_checked() {
    let source = "\
robot:
  active: [/nav/*, lidar]
  parameters_expected:
    - {node: /planner, name: speed, value: '0.5'}
    - {node: planner, name: '', value: '0.5'}
  extract:
    - {topic: /battery, field: 'cells[0].voltage', metric: robot_cell_volts}
    - {topic: /b*, field: 'percentage +', metric: ros2_battery}
    - {topic: /battery, field: percentage, metric: robot_cells_total}
";
    let report = report(source);
    let wrong: Vec<_> = report
        .lines()
        .map(|line| line.trim().split(": ").nth(1).unwrap_or_default())
        .collect();
    let expected = [
        "robot.active[1]",
        "robot.parameters_expected[1].node",
        "robot.parameters_expected[1].name",
        "robot.extract[1].topic",
        "robot.extract[1].field",
        "robot.extract[1].metric",
        "robot.extract[2].metric",
    ];
    assert_eq!(wrong, expected, "{report}");
    let config = Config::parse(b"robot:\n  extract: [{topic: /a, field: b.c, metric: d}]\n");
    let expectations = config.unwrap().expectations();
    assert_eq!(*expectations.fields, ["/a"]);
}

#[test]
fn a_setting_of_the_other_source_is_a_mistake() {
    let source = "\
capture:
  source: host
  cgroup: robot.slice
  interfaces: {include: [eth0], exclude: []}
";
    assert_eq!(
        report(source),
        "f:3:11: capture.cgroup: must be an absolute path, as in `/sys/fs/cgroup/robot.slice`"
    );
    let source = source.replace("robot.slice", "/cg");
    assert_eq!(
        report(&source),
        "f:4:25: capture.interfaces.include: selects interfaces, which `source: host` \
             does not capture; use mirror_interfaces or `source: wire`"
    );
    assert_eq!(
        report(&source.replace("host", "auto")),
        "f:4:25: capture.interfaces.include: selects `source: wire`, to which cgroup does \
             not apply"
    );
    assert_eq!(
        report("capture: {source: wire, mirror_interfaces: [mirror0], cgroup: /cg}"),
        "f:1:44: capture.mirror_interfaces: does not apply to `source: wire`\n\
             f:1:63: capture.cgroup: does not apply to `source: wire`"
    );
    assert_eq!(
        report("capture: {source: both, mirror_interfaces: ['a b']}"),
        "f:1:19: capture.source: is the text `both`, must be one of auto, host, wire\n\
             f:1:45: capture.mirror_interfaces[0]: must be an interface name or glob, as in `eth*`"
    );
    for good in [
        "capture: {source: host, mirror_interfaces: [mirror*], cgroup: /sys/fs/cgroup/robot}",
        "capture: {source: wire, interfaces: {include: [eth0]}}",
        "capture: {interfaces: {exclude: [docker*]}}",
        "capture: {mirror_interfaces: [eth1]}",
        "capture: {source: wire, mirror_interfaces: [], cgroup: }",
    ] {
        assert_eq!(report(good), "", "{good}");
    }
}

#[test]
fn an_otlp_section_is_checked_down_to_its_headers_and_attributes() {
    let source = "\
otlp:
  endpoint: collector:4317
  headers: {a: b, c: 3}
  headers_file: secret
  compression: zip
  attributes: {site: roof, floor: [2]}
";
    assert_eq!(
        report(source),
        "f:2:13: otlp.endpoint: must be the URL of a receiver, as in \
             `http://collector:4317`, or `off`\n\
             f:3:22: otlp.headers.c: is `3`, must be text\n\
             f:4:17: otlp.headers_file: must be an absolute path, as in \
             `/etc/ros2probe/otlp.headers`\n\
             f:5:16: otlp.compression: is the text `zip`, must be one of none, gzip\n\
             f:6:35: otlp.attributes.floor: is a list, must be text"
    );
    assert_eq!(report("otlp: {endpoint: 'off', headers: }"), "");
}

#[test]
fn a_supported_or_missing_version_changes_nothing() {
    for same in [
        "version: 1\nlog: debug\n",
        "log: debug\n",
        "log: debug\nversion: 1",
    ] {
        assert_eq!(
            parse(same.as_bytes()).unwrap().log.label(),
            "debug",
            "{same}"
        );
    }
    assert_eq!(
        report("version: 0"),
        "f:1:10: version: is 0, must be between 1 and 1"
    );
    assert_eq!(
        report("version: '1'\nlgo: x"),
        "f:1:10: version: is the text `1`, must be a whole number\n\
             f:2:1: lgo: unknown key; did you mean `log`?"
    );
}

#[test]
fn a_newer_version_is_refused_with_one_line_and_its_remedy() {
    let newer = "watch: {points: {colour: red}}\nversion: 2\nclouds: 7\n";
    let version = env!("CARGO_PKG_VERSION");
    assert_eq!(
        report(newer),
        format!(
            "f:2:10: version: is 2, this rp {version} reads up to 1: upgrade rp, or write the \
                 file for version 1"
        )
    );
}

#[test]
fn a_commonly_mistaken_key_is_reported_with_the_correct_name() {
    assert_eq!(
        report("watchlist: []"),
        "f:1:1: watchlist: unknown key; use `watch`"
    );
    let source = "watch: [{topic: /a, max_delay_ms: 3}]";
    assert!(report(source).ends_with("unknown key; use `max_latency_ms`"));
}

#[test]
fn a_key_written_twice_is_reported() {
    assert_eq!(
        report("log: info\nlog: warn"),
        "f:2:1: log: duplicate key, first at 1:6"
    );
}

#[test]
fn invalid_yaml_is_reported_with_its_position() {
    for (source, place) in [
        ("watch: [", "f:2:1:"),
        ("watch:\n\t- /a", "f:2:2:"),
        ("a: 'x", "f:1:"),
        ("--- 1\n--- 2\n", "f:2:1:"),
        ("- 1", "f:1:1: is a list, must be a map of keys"),
        ("? [a]\n: 1", "f:1:3:"),
    ] {
        let report = report(source);
        assert!(report.starts_with(place), "{source:?}: {report}");
        assert!(!report.contains('\n'), "{source:?}: {report}");
    }
    assert!(
        parse(b"log: \xff")
            .unwrap_err()
            .report("f")
            .starts_with("f:1:6: not UTF-8")
    );
}

#[test]
fn yaml_bombs_are_refused_quickly() {
    let aliases = "a: &a [x,x]\nb: &b [*a,*a]\nc: [*b,*b]\n";
    assert!(report(aliases).contains("aliases are not supported"));
    assert!(report(&"[".repeat(200)).contains("nested too deep"));
    assert!(report(&"[".repeat(100_000)).contains("recursion limit"));
    let steps: String = (0..1000)
        .map(|depth| format!("{}a:\n", " ".repeat(depth)))
        .collect();
    assert!(report(&steps).contains("nested too deep"));
    let mut long = "watch:\n".to_owned();
    (0..100_000)
        .try_for_each(|i| writeln!(long, "  - /t{i}"))
        .unwrap();
    assert!(report(&long).contains("too many values"));
    let mut many = "watch:\n".to_owned();
    (0..2_000)
        .try_for_each(|i| writeln!(many, "  - /t{i}"))
        .unwrap();
    assert!(report(&many).contains("f:2:3: watch: has 2000 entries"));
    let mut wrong = "watch:\n".to_owned();
    (0..500)
        .try_for_each(|i| writeln!(wrong, "  - t{i}"))
        .unwrap();
    assert!(report(&wrong).ends_with("f: and 450 more"));
}

#[test]
fn a_file_with_many_sections_is_parsed() {
    let source = "\
watch:
  - /tf
  - {topic: /points, domain: 5, min_rate_hz: 18, max_rate_hz: 22.5, max_loss_ratio: 0.01,
     max_latency_ms: 50, max_silence_s: 1, publishers: 1, subscribers: 2, per_subscriber: true, trace: 0.25}
limits: {topics: 5, participants: 6, endpoints: 7, unknown_writers: 8, reassembly_bytes: 65536}
capture:
  source: wire
  interfaces: {include: [eth*], exclude: [docker0]}
  network_namespaces: [/run/netns/a]
  ring_bytes: 4194304
  record_ring_bytes: 65536
metrics: {listen: 'off', histograms: false, per_writer: true}
topic_grace_s: 60
log: debug
";
    let config = parse(source.as_bytes()).unwrap();
    let points = config.watches.get(1).unwrap();
    assert_eq!(
        (points.pattern.as_str(), points.domain_id),
        ("/points", Some(DomainId(5)))
    );
    assert_eq!(points.expectations.max_rate_hz, Some(22.5));
    let counts = (
        points.expectations.publishers,
        points.expectations.subscribers,
    );
    assert_eq!(counts, (Some(1), Some(2)));
    assert!((points.trace - 0.25).abs() < 1e-9);
    assert!(points.per_subscriber && !config.watches.first().unwrap().per_subscriber);
    assert_eq!(config.capture.source, SourceChoice::Wire);
    assert_eq!(config.limits.unknown_writers, 8);
    assert_eq!(config.capture.exclude_interfaces, ["docker0"]);
    assert_eq!(config.metrics.listen, None);
    assert_eq!(
        (config.topic_grace, config.log.label()),
        (Duration::from_mins(1), "debug")
    );
    assert_eq!(
        Config::default().needs_restart(&config),
        ["limits", "capture", "metrics.listen", "topic_grace_s"]
    );
}

#[test]
fn parsing_a_truncated_file_never_panics() {
    let source = include_bytes!("../../../../../config/ros2probe.yaml");
    for end in 0..source.len() {
        let _ = parse(source.get(..end).unwrap());
    }
}

#[test]
fn chains_with_equal_ends_globs_or_duplicates_are_rejected() {
    let mistakes = |yaml: &str| Config::parse(yaml.as_bytes()).unwrap_err().report("file");
    let same = mistakes("chains: [{from: /a, to: /a}]");
    assert!(
        same.contains("chains[0].to: is the same topic as `from`"),
        "{same}"
    );
    let glob = mistakes("chains: [{from: /a, to: /b/*}]");
    assert!(glob.contains("must be the name of one topic"), "{glob}");
    let twice = mistakes("chains: [{from: /a, to: /b}, {from: /a, to: /b, max_latency_ms: 5}]");
    assert!(twice.contains("repeats chains[0]"), "{twice}");
    let config = Config::parse(b"chains: [{from: /a, to: /b, domain: 3, max_latency_ms: 1.5}]");
    let chains = config.unwrap().chains;
    assert_eq!(chains[0].max_latency, Some(Duration::from_micros(1500)));
    assert_eq!(
        (&*chains[0].from, chains[0].domain_id),
        ("/a", Some(DomainId(3)))
    );
}

#[test]
fn too_many_and_invalid_ports_of_zenoh_are_reported() {
    let ports = |source: &str| parse(source.as_bytes()).unwrap().capture.zenoh_ports;
    assert_eq!(
        ports("capture: {zenoh: {ports: [7447, 17447]}}"),
        [7447, 17447]
    );
    assert_eq!(ports("capture: {zenoh: {ports: []}}"), [0_u16; 0]);
    assert_eq!(ports(""), [7447]);
    assert_eq!(
        report("capture: {zenoh: {ports: [1, 2, 3, 4, 5, 6, 7, 8, 9]}}"),
        "f:1:26: capture.zenoh.ports: has more than 8 ports"
    );
    assert_eq!(
        report("capture: {zenoh: {ports: [0, 65536]}}"),
        "f:1:27: capture.zenoh.ports[0]: is 0, must be between 1 and 65535\n\
         f:1:30: capture.zenoh.ports[1]: is 65536, must be between 1 and 65535"
    );
}

#[test]
fn the_history_on_disk_needs_two_minutes_in_memory() {
    let seconds = |source: &str| parse(source.as_bytes()).unwrap().history.as_secs();
    assert_eq!(seconds("page: {history_s: 30}"), 120);
    assert_eq!(seconds("page: {history_s: 30, history_bytes: 0}"), 30);
    assert_eq!(seconds("page: {history_s: 0}"), 0);
    assert_eq!(seconds("page: {history_s: 900}"), 900);
}

#[test]
fn the_engine_of_a_fleet_and_its_robots_are_checked() {
    for (yaml, expected) in [
        ("engine: 'prometheus:9090'", "the URL of an engine"),
        ("engine: 'http://a/?b'", "the URL of an engine"),
        ("token_file: token", "/etc/ros2probe/engine.token"),
        ("job: ''", "the value of a label"),
        ("link: 'http://robot/'", "a URL with `{robot}`"),
        ("link: 'javascript:{robot}'", "a URL with `{robot}`"),
        ("reach_s: 0", "reach_s"),
        ("since_h: 721", "since_h"),
        ("store: {url: bags}", "a destination"),
        (
            "store: {url: 's3://b', endpoint: minio}",
            "the URL of a store",
        ),
        (
            "store: {url: 's3://b', ca_file: pem}",
            "must be an absolute path",
        ),
        ("store: {url: 's3://b', windows: []}", "windows"),
    ] {
        let text = report(&format!("fleet: {{{yaml}}}\n"));
        assert!(text.contains(expected), "{yaml}: {text}");
    }
    let yaml = "fleet: {engine: 'http://a:9090/prometheus', link: 'http://{robot}/', reach_s: 5}\n";
    let fleet = Config::parse(yaml.as_bytes()).unwrap().fleet;
    assert_eq!(fleet.engine.as_deref(), Some("http://a:9090/prometheus"));
    assert_eq!(fleet.question.job, "ros2probe");
    assert_eq!((fleet.question.hours, fleet.question.reach), (24, 5));
    assert_eq!(fleet.link.unwrap().of("r"), "http://r/");
    assert_eq!(fleet.store, None);
    let yaml = "fleet: {store: {url: 's3://bags/fleet', region: eu, ca_file: /a.pem}}\n";
    let fleet = Config::parse(yaml.as_bytes()).unwrap().fleet;
    let store = fleet.store.unwrap();
    assert_eq!(store.url, "s3://bags/fleet");
    assert_eq!(store.region.as_deref(), Some("eu"));
    assert_eq!(
        store.ca_file.as_deref(),
        Some(std::path::Path::new("/a.pem"))
    );
    assert_eq!(Config::default().fleet.engine, None);
}
