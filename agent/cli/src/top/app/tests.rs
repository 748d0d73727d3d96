use serde_json::{Value, json};

use super::*;

fn topics(json: &Value) -> Fact {
    Fact::Topics(Box::new(
        serde_json::from_value(json!({"topics": json})).unwrap(),
    ))
}

fn app() -> App {
    let topic = |name: &str, rate: f64, state: &str| {
        let measured = json!({"messages": 9, "rate_hertz": rate});
        json!({
            "domain_id": 0, "name": name, "dds_name": format!("rt{name}"), "kind": "topic",
            "message_types": ["std_msgs/msg/String"],
            "publishers": [{"measurement": measured}], "subscriptions": [{}],
            "measurement": measured, "watches": [{"watch": "/**", "state": state}],
        })
    };
    let unwatched = json!({
        "domain_id": 0, "name": "/d", "dds_name": "rt/d", "kind": "topic",
        "message_types": ["sensor_msgs/msg/Imu"], "publishers": [{}], "subscriptions": [{}],
    });
    let all = json!([
        topic("/a", 1.0, "ok"),
        topic("/b", 3.0, "silent"),
        topic("/c", 2.0, "ok"),
        unwatched
    ]);
    let mut app = App::default();
    app.heights.topics = 10;
    assert_eq!(
        app.take(topics(&all), Instant::now()),
        [Command::Select(key("/a"))]
    );
    app
}

fn key(name: &str) -> Option<Key> {
    Some(Key {
        domain_id: 0,
        dds_name: format!("rt{name}"),
    })
}

fn press(app: &mut App, code: KeyCode) -> Vec<Command> {
    app.key(KeyEvent::new(code, KeyModifiers::NONE))
}

fn keys(app: &mut App, keys: &str) -> Vec<Command> {
    let commands = keys.chars().flat_map(|key| press(app, KeyCode::Char(key)));
    commands.collect()
}

fn names(app: &App) -> Vec<String> {
    app.shown().map(|row| row.name.clone()).collect()
}

#[test]
fn keys_select_the_column_and_the_direction_of_the_order() {
    let mut app = app();
    assert_eq!(names(&app), ["/a", "/b", "/c", "/d"]);
    keys(&mut app, "s");
    assert_eq!(
        (app.sort, names(&app)),
        (
            Column::Rate,
            vec!["/b", "/c", "/a", "/d"]
                .into_iter()
                .map(String::from)
                .collect()
        )
    );
    keys(&mut app, "r");
    assert_eq!(names(&app), ["/a", "/c", "/b", "/d"]);
    keys(&mut app, "8");
    assert_eq!((app.sort, app.reverse), (Column::State, false));
    assert_eq!(names(&app)[0], "/b");
    keys(&mut app, "9");
    assert_eq!(app.sort, Column::Late);
    keys(&mut app, "s");
    assert_eq!(app.sort, Column::Name);
    keys(&mut app, "<");
    assert_eq!(app.sort, Column::Late);
}

#[test]
fn the_filter_applies_while_it_is_typed_and_escape_reverts_it() {
    let mut app = app();
    keys(&mut app, "/IMU");
    assert_eq!(names(&app), ["/d"]);
    // During an edit, keys are text.
    assert_eq!(keys(&mut app, "q"), [Command::Select(None)]);
    press(&mut app, KeyCode::Backspace);
    press(&mut app, KeyCode::Enter);
    assert_eq!(
        (names(&app), app.editing.clone()),
        (vec!["/d".to_owned()], None)
    );
    keys(&mut app, "/xyz");
    assert!(names(&app).is_empty());
    assert_eq!(app.selected, None);
    press(&mut app, KeyCode::Esc);
    assert_eq!(
        (names(&app), app.filter.text.as_str()),
        (vec!["/d".to_owned()], "IMU")
    );
    press(&mut app, KeyCode::Esc);
    assert_eq!(names(&app).len(), 4);
    keys(&mut app, "p");
    assert_eq!(names(&app), ["/b"]);
    keys(&mut app, "pm");
    assert_eq!(names(&app), ["/a", "/b", "/c"]);
}

#[test]
fn the_selection_follows_its_topic_and_requests_details_once() {
    let mut app = app();
    assert_eq!(press(&mut app, KeyCode::Down), [Command::Select(key("/b"))]);
    assert_eq!(keys(&mut app, "s"), []);
    assert_eq!(
        (app.selected.clone(), app.selected_index()),
        (key("/b"), Some(0))
    );
    assert_eq!(press(&mut app, KeyCode::End), [Command::Select(key("/d"))]);
    assert_eq!(press(&mut app, KeyCode::Down), []);
    assert_eq!(press(&mut app, KeyCode::Home), [Command::Select(key("/b"))]);
    // After the selected topic is gone, the next topic at its position is selected.
    let left = json!([{"name": "/c", "dds_name": "rt/c"}]);
    assert_eq!(
        app.take(topics(&left), Instant::now()),
        [Command::Select(key("/c"))]
    );
    assert_eq!(
        app.take(topics(&json!([])), Instant::now()),
        [Command::Select(None)]
    );
}

#[test]
fn details_of_another_topic_are_not_shown() {
    let mut app = app();
    let details = |name: &str| Fact::Details(key(name).unwrap(), Some(Box::default()));
    app.take(details("/b"), Instant::now());
    assert!(app.details.is_none());
    app.take(details("/a"), Instant::now());
    assert!(app.details.is_some());
    press(&mut app, KeyCode::Down);
    assert!(app.details.is_none());
}

#[test]
fn the_keys_w_and_capital_w_measure_the_selected_topic() {
    let mut app = app();
    press(&mut app, KeyCode::End);
    let (key, name) = (key("/d").unwrap(), "/d".to_owned());
    assert_eq!(
        keys(&mut app, "w"),
        [Command::Toggle(key.clone(), name.clone())]
    );
    assert_eq!(keys(&mut app, "W"), [Command::Keep(key, name)]);
    app.take(topics(&json!([])), Instant::now());
    assert_eq!(keys(&mut app, "wW"), []);
}

#[test]
fn control_c_and_q_quit_in_every_state() {
    let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
    for state in ["", "?", "/text", "e", "d"] {
        let mut app = app();
        keys(&mut app, state);
        assert_eq!(app.key(control_c), [Command::Quit], "{state}");
    }
    for state in ["", "?", "e"] {
        let mut app = app();
        keys(&mut app, state);
        assert_eq!(keys(&mut app, "q"), [Command::Quit], "{state}");
    }
}

#[test]
fn arrow_keys_scroll_the_focused_pane_and_escape_leaves_it() {
    let mut app = app();
    app.heights = Heights {
        topics: 3,
        details: 4,
        details_needed: 10,
        events: 2,
    };
    press(&mut app, KeyCode::Enter);
    press(&mut app, KeyCode::Tab);
    assert_eq!(app.focus, Pane::Details);
    assert_eq!(keys(&mut app, "jj"), []);
    assert_eq!(app.details_scroll, 2);
    press(&mut app, KeyCode::End);
    assert_eq!(app.details_scroll, 6);
    keys(&mut app, "ze");
    assert_eq!((app.zoomed, app.focus), (true, Pane::Events));
    for _ in 0..3 {
        press(&mut app, KeyCode::Esc);
    }
    assert_eq!(
        (app.zoomed, app.focus, app.details_open),
        (false, Pane::Topics, false)
    );
}

#[test]
fn new_events_do_not_move_a_pane_that_shows_old_ones() {
    let mut app = app();
    app.heights.events = 2;
    let event = || Fact::Event(Box::default());
    for _ in 0..10 {
        app.take(event(), Instant::now());
    }
    keys(&mut app, "e\u{0}");
    app.focus = Pane::Events;
    press(&mut app, KeyCode::Up);
    assert_eq!(app.events_back, 1);
    app.take(event(), Instant::now());
    assert_eq!(app.events_back, 2);
    press(&mut app, KeyCode::End);
    assert_eq!(app.events_back, 0);
}
