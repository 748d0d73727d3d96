//! Requests that change the pace of a replay.

use std::time::{Duration, Instant};

use crate::events::kept;
use crate::page::{data, get};
use crate::rp;
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, call_api};
use serde_json::{Value, json};

/// Returns the replay once it is as wanted.
fn wait_for(agent: &LocalAgent, what: &str, is_wanted: impl Fn(&Value) -> bool) -> Value {
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

fn change(agent: &LocalAgent, change: &Value) -> Value {
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
    std::thread::sleep(Duration::from_millis(300));
    let held = get(&agent, "/replay");
    std::thread::sleep(Duration::from_millis(1_500));
    assert_eq!(time(&get(&agent, "/replay")), time(&held));
    let past = json!({"to_timestamp_seconds": time(&held) - 1.0});
    let (status, _) = call_api(agent.api, "POST", "/replay", &past.to_string());
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
