use std::path::Path;
use std::time::Duration;

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use ratatui::style::Color;
use serde_json::{Value, json};

use super::super::app::Fact;
use super::super::row::{Column, Key};
use super::*;
use ros2probe_api::health::Health;
use ros2probe_api::topics::{TopicDetails, TopicList};

const ASCII: Theme = Theme {
    unicode: false,
    colours: false,
};

/// Returns a robot with a topic in each state.
pub(in crate::top) fn robot() -> TopicList<'static> {
    serde_json::from_value(robot_answer()).unwrap()
}

/// Returns the details of one of the robot's topics.
fn details(number: usize) -> TopicDetails<'static> {
    serde_json::from_value(robot_answer()["topics"][number].clone()).unwrap()
}

/// Returns the topic list as JSON, with a topic in each state.
fn robot_answer() -> Value {
    let measured = |rate: f64, size: f64, lost: u64| {
        json!({
            "messages": 1905, "bytes": 609_600, "lost_messages": lost, "rate_hertz": rate,
            "subscriber_expected_messages": 1905 + lost, "subscriber_lost_messages": lost,
            "bandwidth_bytes_per_second": rate * size,
            "interarrival": {"count": 1904, "p50_seconds": 0.0049, "p99_seconds": 0.0091,
                "minimum_seconds": 0.0041, "maximum_seconds": 0.012},
            "latency": {"count": 1905, "p50_seconds": 0.00031, "p99_seconds": 0.0024,
                "minimum_seconds": 0.0001, "maximum_seconds": 0.0031},
        })
    };
    let endpoint = |guid: &str, node: &str, measurement: Value| {
        json!({
            "guid": guid, "node": node, "vendor": "Eclipse Cyclone DDS",
            "qos": {"reliability": "RELIABLE", "durability": "VOLATILE", "history": "KEEP_LAST (10)"},
            "measurement": measurement,
        })
    };
    let imu = measured(200.0, 320.0, 3);
    let points = measured(19.98, 2_720_000.0, 0);
    let camera = measured(4.2, 921_600.0, 0);
    let quiet = measured(0.0, 0.0, 0);
    json!({"topics": [
        {"domain_id": 0, "name": "/robot1/imu/data", "dds_name": "rt/robot1/imu/data",
            "kind": "topic", "message_types": ["sensor_msgs/msg/Imu"],
            "publishers": [endpoint("01.1", "/robot1/imu_driver", imu.clone())],
            "subscriptions": [endpoint("02.1", "/robot1/ekf", Value::Null),
                endpoint("02.2", "/robot1/recorder", Value::Null)],
            "watches": [{"watch": "/**", "origin": "config", "state": "ok"},
                {"watch": "/robot1/imu/data", "origin": "config", "state": "ok",
                "min_rate_hz": 190.0, "max_rate_hz": 210.0}],
            "measurement": imu,
            "received": {"messages": 3807, "lost_messages": 3, "lost_in_socket_buffer_messages": 3},
            "interarrival_buckets": [{"upper_seconds": 0.002, "count": 0},
                {"upper_seconds": 0.005, "count": 1520}, {"upper_seconds": 0.01, "count": 380},
                {"upper_seconds": 0.02, "count": 4}, {"upper_seconds": null, "count": 0}],
            "latency_buckets": [{"upper_seconds": 0.0005, "count": 1800},
                {"upper_seconds": 0.001, "count": 0}, {"upper_seconds": 0.002, "count": 80},
                {"upper_seconds": 0.005, "count": 25}, {"upper_seconds": null, "count": 0}],
            "deliveries": [
                {"writer": "01.1", "direction": "received", "destination": "10.0.0.1:7411",
                    "subscriber": "p", "readers": ["02.1"], "delivered": {"messages": 1905}},
                {"writer": "01.1", "direction": "received", "destination": "10.0.0.1:7413",
                    "subscriber": "q", "readers": ["02.2"],
                    "delivered": {"messages": 1902, "lost_messages": 3,
                        "lost_in_socket_buffer_messages": 3}},
                {"writer": "01.1", "direction": "sent", "destination": "10.0.0.2:7411",
                    "subscriber": "", "readers": [], "delivered": {"messages": 1905}}],
            "acknowledgements": [{"reader": "02.1", "missing_messages": 0, "lag_messages": 4}]},
        {"domain_id": 0, "name": "/robot1/points", "dds_name": "rt/robot1/points", "kind": "topic",
            "message_types": ["sensor_msgs/msg/PointCloud2"],
            "publishers": [endpoint("03.1", "/robot1/lidar", points.clone())],
            "subscriptions": [endpoint("02.3", "/robot1/ekf", Value::Null)],
            "watches": [{"watch": "/**", "state": "ok"}], "measurement": points},
        {"domain_id": 0, "name": "/robot1/camera/front/left/image_raw/compressed",
            "dds_name": "rt/camera", "kind": "topic",
            "message_types": ["sensor_msgs/msg/CompressedImage"],
            "publishers": [endpoint("04.1", "/robot1/camera", camera.clone())],
            "subscriptions": [endpoint("02.4", "/robot1/viewer", Value::Null)],
            "watches": [{"watch": "/robot1/camera/**", "origin": "api", "state": "violated",
                "min_rate_hz": 9.0, "violations": ["min_rate_hz"]}],
            "measurement": camera,
            "diagnoses": [{"kind": "qos_incompatible", "writer": "04.1", "reader": "02.4",
                "policies": ["reliability"]}],
            "reasons": [{"code": "no_matched_subscriber",
                "detail": "no subscription matches: qos (reliability)"}]},
        {"domain_id": 0, "name": "/tf_static", "dds_name": "rt/tf_static", "kind": "topic",
            "message_types": ["tf2_msgs/msg/TFMessage"],
            "publishers": [endpoint("05.1", "/robot1/tf", quiet.clone())],
            "subscriptions": [endpoint("02.5", "/robot1/ekf", Value::Null)],
            "watches": [{"watch": "/**", "state": "ok"}], "measurement": quiet,
            "reasons": [{"code": "quiet", "detail": "the last message was seen 12.0 s ago"}]},
        {"domain_id": 0, "name": "/map", "dds_name": "rt/map", "kind": "topic",
            "message_types": ["nav_msgs/msg/OccupancyGrid"],
            "publishers": [endpoint("06.1", "/robot1/map_server", quiet.clone())],
            "subscriptions": [endpoint("02.6", "/robot1/planner", Value::Null)],
            "watches": [{"watch": "/**", "state": "ok"}], "measurement": quiet,
            "passages": [{"passage": "same_process", "pairs": 1}],
            "reasons": [{"code": "same_process",
                "detail": "publisher and subscriber share one process; nothing crosses the network"}]},
        {"domain_id": 0, "name": "/diagnostics", "dds_name": "rt/diagnostics", "kind": "topic",
            "message_types": ["diagnostic_msgs/msg/DiagnosticArray"],
            "publishers": [endpoint("07.1", "/robot1/base", Value::Null)], "subscriptions": [],
            "measurement": null,
            "reasons": [{"code": "not_watched", "detail": "nothing is counted: POST /watch/diagnostics"}]},
        {"domain_id": 0, "name": "rt/\u{1b}[2J\u{1b}[31mevil\u{202e}\r\n",
            "dds_name": "rt/\u{1b}[2J\u{1b}[31mevil\u{202e}\r\n", "kind": "dds",
            "message_types": ["\u{1b}]0;owned\u{7}"], "publishers": [],
            "subscriptions": [{"guid": "08.1", "node": "\u{9b}31m"}], "measurement": null},
    ]})
}

fn health(more: &Value) -> Fact {
    let mut health = json!({
        "ready": true, "host": "robot1", "version": "0.1.0", "source": "host", "age_seconds": 0.2,
    });
    let more = more.as_object().unwrap().clone();
    health.as_object_mut().unwrap().extend(more);
    let health: Health = serde_json::from_value(health).unwrap();
    Fact::Health(Box::new(health))
}

fn event(time: &str, name: &str, severity: &str, attributes: &Value) -> Fact {
    let event = json!({
        "time": format!("2026-11-20T{time}.000000000Z"), "name": name, "severity": severity,
        "attributes": attributes,
    });
    Fact::Event(Box::new(serde_json::from_value(event).unwrap()))
}

fn app(start: Instant) -> App {
    let mut app = App::default();
    app.take(health(&json!({})), start);
    app.take(Fact::Topics(Box::new(robot())), start);
    for fact in [
        event(
            "14:02:07",
            "ros2.node.discovered",
            "INFO",
            &json!({"domain_id": 0, "ros_node": "/robot1/viewer", "participant": "02.0"}),
        ),
        event(
            "14:02:09",
            "ros2.qos.incompatible",
            "WARN",
            &json!({"topic": "/robot1/camera/front/left/image_raw/compressed",
                "policies": ["reliability"]}),
        ),
        event(
            "14:02:11",
            "ros2.message.lost",
            "WARN",
            &json!({"topic": "rt/\u{1b}[2J", "count": 3}),
        ),
    ] {
        app.take(fact, start);
    }
    app
}

fn press(app: &mut App, keys: &str) {
    for key in keys.chars() {
        let code = match key {
            '\n' => KeyCode::Enter,
            '\t' => KeyCode::Tab,
            key => KeyCode::Char(key),
        };
        app.key(KeyEvent::new(code, KeyModifiers::NONE));
    }
}

/// Returns the screen as text, without trailing spaces.
fn screen(app: &mut App, size: (u16, u16), theme: Theme, now: Instant) -> String {
    let mut terminal = Terminal::new(TestBackend::new(size.0, size.1)).unwrap();
    // The screen is drawn twice, since the first drawing determines the sizes of the panes.
    for _ in 0..2 {
        terminal.draw(|frame| draw(app, frame, theme, now)).unwrap();
    }
    let buffer = terminal.backend().buffer();
    let mut text = String::new();
    for line in buffer.content().chunks(usize::from(size.0)) {
        let line: String = line.iter().map(|cell| cell.symbol()).collect();
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

fn compare(name: &str, shown: &str) {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/top/view/screens");
    let path = directory.join(format!("{name}.txt"));
    if std::env::var_os("UPDATE_SCREENS").is_some() {
        std::fs::create_dir_all(&directory).unwrap();
        std::fs::write(&path, shown).unwrap();
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        expected == shown,
        "{name} is\n{shown}\nand should be\n{expected}\nrun with UPDATE_SCREENS=1 and look"
    );
}

#[test]
fn the_screens_match_the_reviewed_texts() {
    let start = Instant::now();
    let now = start + Duration::from_millis(300);
    let mut shown = app(start);
    compare("table-80x24", &screen(&mut shown, (80, 24), ASCII, now));
    compare("table-120x40", &screen(&mut shown, (120, 40), ASCII, now));
    compare("table-50x12", &screen(&mut shown, (50, 12), ASCII, now));
    compare("small", &screen(&mut shown, (30, 5), ASCII, now));
    press(&mut shown, "?");
    compare("help-80x24", &screen(&mut shown, (80, 24), ASCII, now));
    press(&mut shown, "?");

    let key = Key {
        domain_id: 0,
        dds_name: "rt/robot1/imu/data".to_owned(),
    };
    let imu = details(0);
    shown.selected = Some(key.clone());
    shown
        .measured_topics
        .insert(key.clone(), MeasuredBy::Session);
    press(&mut shown, "\ne");
    shown.take(Fact::Details(key, Some(Box::new(imu))), now);
    compare("details-80x24", &screen(&mut shown, (80, 24), ASCII, now));
    let theme = Theme {
        unicode: true,
        colours: true,
    };
    compare("details-120x40", &screen(&mut shown, (120, 40), theme, now));
    press(&mut shown, "\tz");
    compare("zoomed-80x24", &screen(&mut shown, (80, 24), ASCII, now));
}

#[test]
fn a_blind_or_unreachable_agent_never_appears_healthy() {
    let start = Instant::now();
    let at = |seconds: u64| start + Duration::from_secs(seconds);
    let mut shown = app(start);
    let text = screen(&mut shown, (80, 24), ASCII, at(1));
    assert!(text.contains("agent sees the host's sockets"), "{text}");
    assert!(text.contains("! 1 topic not visible"), "{text}");

    shown.take(health(&json!({"dropped_records": 7})), at(1));
    let text = screen(&mut shown, (80, 24), ASCII, at(1));
    assert!(text.contains("! dropping now: 7 records"), "{text}");
    let text = screen(&mut shown, (80, 24), ASCII, at(60));
    assert!(text.contains("! dropped: 7 records"), "{text}");
    assert!(text.contains("! the data shown is 60 s old"), "{text}");

    let blind = json!({"ready": false, "reason": "the capture has made no progress for 9 s"});
    shown.take(health(&blind), at(1));
    let text = screen(&mut shown, (80, 24), ASCII, at(1));
    assert!(text.contains("AGENT NOT READY"), "{text}");
    assert!(text.contains("no progress for 9 s"), "{text}");
    assert!(!text.contains("agent sees"), "{text}");

    shown.take(Fact::Gone("connection \u{1b}[31mrefused".to_owned()), at(2));
    shown.take(Fact::Gone("connection refused".to_owned()), at(9));
    let text = screen(&mut shown, (80, 24), ASCII, at(12));
    assert!(text.contains("AGENT GONE"), "{text}");
    assert!(
        text.contains("! agent unreachable for 10 s, retrying: connection refused"),
        "{text}"
    );
    shown.take(Fact::Topics(Box::new(robot())), at(13));
    assert!(!screen(&mut shown, (80, 24), ASCII, at(13)).contains("GONE"));
}

#[test]
fn nothing_from_the_network_reaches_the_terminal_unescaped() {
    let now = Instant::now();
    let mut shown = app(now);
    let place = robot().topics.len() - 1;
    let hostile = details(place);
    let key = Key {
        domain_id: 0,
        dds_name: hostile.topic.dds_name.to_string(),
    };
    shown.selected = Some(key.clone());
    press(&mut shown, "\ne");
    shown.take(Fact::Details(key, Some(Box::new(hostile))), now);
    shown.take(Fact::Status("\u{1b}[5m".to_owned()), now);
    for size in [(80, 24), (200, 60)] {
        let text = screen(&mut shown, size, ASCII, now);
        let is_plain = |each: char| (' '..='~').contains(&each) || each == '\n';
        assert!(text.chars().all(is_plain), "{text}");
        assert!(text.contains(r"evil\u{202e}\r\n"), "{text}");
        assert!(text.contains(r"\u{9b}31m"), "{text}");
    }
}

#[test]
fn every_size_can_be_drawn_in_every_state() {
    let now = Instant::now();
    let mut shown = app(now);
    for keys in ["", "\n", "e", "\t", "z", "\t", "/x", "\n", "?"] {
        press(&mut shown, keys);
        for width in [1, 2, 39, 40, 57, 80, 133] {
            for height in [1, 2, 7, 8, 9, 11, 24, 50] {
                screen(&mut shown, (width, height), ASCII, now);
            }
        }
    }
}

#[test]
fn colours_are_used_only_if_they_are_enabled() {
    let now = Instant::now();
    let mut shown = app(now);
    press(&mut shown, "e");
    for (colours, is_coloured) in [(false, false), (true, true)] {
        let theme = Theme { colours, ..ASCII };
        let mut terminal = Terminal::new(TestBackend::new(80, 24)).unwrap();
        terminal
            .draw(|frame| draw(&mut shown, frame, theme, now))
            .unwrap();
        let cells = terminal.backend().buffer().content().iter();
        let is_plain = |color: Color| color == Color::Reset;
        let all_plain = cells
            .clone()
            .all(|cell| is_plain(cell.fg) && is_plain(cell.bg));
        assert_eq!(all_plain, !is_coloured);
    }
}

#[test]
fn the_selected_topic_stays_on_the_screen() {
    let now = Instant::now();
    let mut shown = App::default();
    let topics: Vec<_> = (0..100)
        .map(|number| json!({"name": format!("/t{number:02}"), "dds_name": format!("rt/t{number:02}")}))
        .collect();
    let topics: TopicList<'_> = serde_json::from_value(json!({"topics": topics})).unwrap();
    shown.take(Fact::Topics(Box::new(topics)), now);
    screen(&mut shown, (80, 24), ASCII, now);
    for (keys, name) in [
        ("G", "/t99"),
        ("kkk", "/t96"),
        ("g", "/t00"),
        (" ", "/t19"),
        ("jj", "/t21"),
    ] {
        press(&mut shown, keys);
        let text = screen(&mut shown, (80, 24), ASCII, now);
        assert!(text.contains(&format!("\n> {name} ")), "{name}\n{text}");
    }
    shown.sort = Column::Name;
    press(&mut shown, "r");
    assert!(screen(&mut shown, (80, 24), ASCII, now).contains("\n> /t21 "));
}
