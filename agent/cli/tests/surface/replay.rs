//! Requests that change the pace of a replay.

use std::time::{Duration, Instant};

use crate::events::kept;
use crate::page::{data, get};
use crate::rp;
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, call_api};
use serde_json::{Value, json};

/// Returns the replay once it is as wanted.
pub(crate) fn wait_for(
    agent: &LocalAgent,
    what: &str,
    is_wanted: impl Fn(&Value) -> bool,
) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let replay = get(agent, "/replay");
        if is_wanted(&replay) {
            return replay;
        }
        assert!(Instant::now() < deadline, "not {what}: {replay}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Changes the pace of a replay. Returns the replay after the change.
pub(crate) fn change(agent: &LocalAgent, change: &Value) -> Value {
    let (status, body) = call_api(agent.api, "POST", "/replay", &change.to_string());
    assert_eq!(status, 200, "{change}: {body}");
    body
}

fn time(replay: &Value) -> f64 {
    replay["timestamp_seconds"].as_f64().unwrap()
}

/// Returns the second of the minute of each event other than those of participants and endpoints.
fn events(agent: &LocalAgent) -> Vec<f64> {
    let is_counted = |name: &str| !name.contains("participant") && !name.contains("endpoint");
    let events = kept(agent, "").into_iter();
    let events = events.filter(|event| is_counted(&event.event));
    events.map(|event| second(&event.json())).collect()
}

fn second(event: &Value) -> f64 {
    let time = event["time"].as_str().unwrap();
    time[17..26].parse().unwrap()
}

#[test]
fn a_replay_pauses_and_jumps_to_a_time_and_to_the_next_event() {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let arguments = ["--watch", "/**", "--speed", "0.1"];
    let agent = LocalAgent::replay(&mut rp(), &capture, &arguments);
    let begun = wait_for(&agent, "begun", |replay| {
        !replay["begin_timestamp_seconds"].is_null()
    });
    assert_eq!(
        (&begun["speed"], &begun["is_paused"]),
        (&json!(0.1), &json!(false))
    );

    assert_eq!(
        change(&agent, &json!({"is_paused": true}))["is_paused"],
        true
    );
    let deadline = Instant::now() + PATIENCE;
    let held = loop {
        let held = get(&agent, "/replay");
        std::thread::sleep(Duration::from_secs(1));
        if time(&get(&agent, "/replay")) == time(&held) {
            break held;
        }
        assert!(Instant::now() < deadline, "the replay goes on: {held}");
    };
    let begin = held["begin_timestamp_seconds"].as_f64().unwrap();
    let before = json!({"to_timestamp_seconds": begin - 1.0});
    let (status, _) = call_api(agent.api, "POST", "/replay", &before.to_string());
    assert_eq!(status, 422);

    // A jump ends exactly at its time, and the replay stands still again.
    let to = time(&held) + 1.5;
    let jumping = change(&agent, &json!({"to_timestamp_seconds": to, "speed": 2}));
    assert_eq!(
        (&jumping["is_jumping"], &jumping["speed"]),
        (&json!(true), &json!(2.0))
    );
    let arrived = wait_for(&agent, "arrived", |replay| replay["is_jumping"] == false);
    assert!((time(&arrived) - to).abs() < 0.001, "{arrived} {to}");
    assert_eq!(arrived["is_paused"], true);

    // Events after the begin are losses. The replay stops within a second of one.
    let before = events(&agent);
    change(&agent, &json!({"is_paused": false, "to_next_event": true}));
    let found = wait_for(&agent, "at an event", |replay| {
        replay["is_jumping"] == false
    });
    assert_eq!(
        (&found["is_paused"], &found["is_finished"]),
        (&json!(true), &json!(false))
    );
    let after = events(&agent);
    assert_eq!(after.len(), before.len() + 1, "{after:?}");
    let late = time(&found) % 60.0 - after.last().unwrap();
    assert!((0.0..=1.0).contains(&late), "{found} {after:?}");

    change(&agent, &json!({"is_paused": false, "speed": 0}));
    wait_for(&agent, "finished", |replay| replay["is_finished"] == true);
    // Nothing follows that it could jump to.
    let ended = change(&agent, &json!({"to_next_event": true}));
    assert_eq!(ended["is_jumping"], false);
}

/// Returns the counted messages of each topic.
fn counts(agent: &LocalAgent) -> Vec<(String, Value)> {
    let topics = get(agent, "/topics?hidden=true");
    let topics = topics["topics"].as_array().unwrap().iter();
    let mut counts: Vec<_> = topics
        .map(|topic| {
            let name = topic["name"].as_str().unwrap().to_owned();
            (name, topic["measurement"]["messages"].clone())
        })
        .collect();
    counts.sort_by(|a, b| a.0.cmp(&b.0));
    counts
}

#[test]
fn a_replay_goes_back_also_from_its_end_and_shows_the_same_again() {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "0.1"]);
    let begun = wait_for(&agent, "begun", |replay| {
        !replay["begin_timestamp_seconds"].is_null()
    });
    let begin = begun["begin_timestamp_seconds"].as_f64().unwrap();
    let go = |seconds: f64| {
        let to = begin + seconds;
        change(
            &agent,
            &json!({"to_timestamp_seconds": to, "is_paused": true}),
        );
        change(&agent, &json!({"to_timestamp_seconds": to}));
        let arrived = wait_for(&agent, "arrived", |replay| {
            replay["is_jumping"] == false && replay["is_paused"] == true
        });
        assert!((time(&arrived) - to).abs() < 0.001, "{arrived} {to}");
    };
    go(4.0);
    let at_four = counts(&agent);
    go(2.0);
    let at_two = counts(&agent);
    assert_ne!(at_two, at_four);
    // Events of the agent, such as its watches, are not of the capture.
    let is_robot = |event: &String| event.starts_with("ros2.");
    let names = || kept(&agent, "").into_iter().map(|event| event.event);
    let robot_events = || names().filter(is_robot).collect::<Vec<_>>();
    go(4.0);
    assert_eq!(counts(&agent), at_four);
    let events_at_four = robot_events();
    assert!(!events_at_four.is_empty());
    go(1.0);
    assert!(robot_events().len() < events_at_four.len());
    go(4.0);
    assert_eq!(robot_events(), events_at_four);
    change(&agent, &json!({"is_paused": false, "speed": 0}));
    wait_for(&agent, "finished", |replay| replay["is_finished"] == true);
    let at_end = counts(&agent);
    go(2.0);
    assert_eq!(counts(&agent), at_two);
    change(&agent, &json!({"is_paused": false}));
    wait_for(&agent, "finished again", |replay| {
        replay["is_finished"] == true
    });
    assert_eq!(counts(&agent), at_end);
}
