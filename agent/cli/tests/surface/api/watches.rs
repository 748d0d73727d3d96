//! Watches of clients, together with those of the configuration.

use super::*;
use crate::recordings::long_capture;

#[test]
fn a_watch_is_added_shown_replaced_and_removed() {
    let capture = long_capture();
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    agent.wait_for_log("ready");
    let json = "Content-Type: application/json\r\n";
    let added = ask(&agent, "POST", "/watch/chatter", "", "");
    assert_eq!(added.status, 201, "{}", added.body);
    assert!(added.headers.contains("location: /watch/chatter\r\n"));
    assert_eq!(ask(&agent, "POST", "/watch/chatter", "", "").status, 200);

    let other = ask(
        &agent,
        "POST",
        "/watch/chatter",
        json,
        "{\"max_silence_s\": 2}",
    );
    assert_eq!(problem(&other), (409, "watch-differs".to_owned()));
    let replaced = ask(
        &agent,
        "PUT",
        "/watch/chatter",
        json,
        "{\"max_silence_s\": 2}",
    );
    assert_eq!(replaced.status, 200);

    let shown = wait_for(&agent, "/watch/chatter", |shown| {
        shown["state"] == "measuring" && shown["topics"][0]["messages"] != 0
    });
    assert_eq!(shown["origin"], "api");
    assert_eq!(shown["max_silence_s"], 2.0);

    // A watch of a topic that does not exist yet, in one domain.
    let later = ask(
        &agent,
        "POST",
        "/watch/camera/front/image_raw?domain_id=5",
        "",
        "",
    );
    assert!(
        later
            .headers
            .contains("location: /watch/camera/front/image_raw?domain_id=5")
    );
    let encoded = "/watch/camera%2Ffront%2Fimage_raw?domain_id=5";
    let shown = ask(&agent, "GET", encoded, "", "");
    let shown: Value = serde_json::from_str(&shown.body).unwrap();
    assert_eq!(shown["state"], "waiting");
    let elsewhere = ask(&agent, "GET", "/watch/camera/front/image_raw", "", "");
    assert_eq!(problem(&elsewhere), (404, "no-such-watch".to_owned()));

    let list: Value = serde_json::from_str(&ask(&agent, "GET", "/watch", "", "").body).unwrap();
    assert_eq!(list["watches"].as_array().unwrap().len(), 2);
    assert_eq!(ask(&agent, "DELETE", encoded, "", "").status, 204);
    let gone = ask(&agent, "DELETE", encoded, "", "");
    assert_eq!(problem(&gone), (404, "no-such-watch".to_owned()));
}

/// Returns the topics and origins of the watches.
fn listed(agent: &LocalAgent) -> Vec<(String, String)> {
    let list: Value = serde_json::from_str(&ask(agent, "GET", "/watch", "", "").body).unwrap();
    let watches = list["watches"].as_array().unwrap().iter();
    let text = |watch: &Value, key: &str| watch[key].as_str().unwrap().to_owned();
    let pair = |watch| (text(watch, "topic"), text(watch, "origin"));
    watches.map(pair).collect()
}

#[test]
fn a_client_cannot_change_configured_watches_and_a_reload_keeps_watches_of_clients() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    let write = |text: &str| std::fs::write(&config, text).unwrap();
    write("watch: [/a]");
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--watch", "/b"],
    );
    agent.wait_for_log("ready");
    let entry = |topic: &str, origin: &str| (topic.to_owned(), origin.to_owned());

    for topic in ["c", "d", "e/**"] {
        let path = format!("/watch/{topic}");
        assert_eq!(ask(&agent, "POST", &path, "", "").status, 201);
    }
    assert_eq!(ask(&agent, "DELETE", "/watch/d", "", "").status, 204);
    for (topic, by) in [("a", "configuration file"), ("b", "command line")] {
        let given = ask(&agent, "DELETE", &format!("/watch/{topic}"), "", "");
        assert_eq!(problem(&given), (409, "watch-given".to_owned()));
        assert!(given.body.contains(by), "{}", given.body);
    }
    assert_eq!(ask(&agent, "POST", "/watch/a", "", "").status, 200);
    let json = "Content-Type: application/json\r\n";
    let other = ask(
        &agent,
        "PUT",
        "/watch/a",
        json,
        "{\"per_subscriber\": true, \"trace\": 0.5}",
    );
    assert_eq!(problem(&other), (409, "watch-given".to_owned()));

    // A watch that the configuration lists later belongs to the configuration as long as it is
    // listed.
    write("watch: [/a, /c]");
    let reloaded = ask(&agent, "POST", "/-/reload", "", "");
    assert_eq!(reloaded.status, 200, "{}", reloaded.body);
    assert!(reloaded.body.contains("\"watches\":4"), "{}", reloaded.body);
    assert_eq!(listed(&agent)[1], entry("/c", "config"));

    write("watch: [/a, c]");
    let wrong = ask(&agent, "POST", "/-/reload", "", "");
    assert_eq!(problem(&wrong), (422, "invalid-configuration".to_owned()));
    let body: Value = serde_json::from_str(&wrong.body).unwrap();
    let mistake = body["mistakes"][0].as_str().unwrap();
    let place = "config.yaml:1:13: watch[1]: must begin with a slash";
    assert!(mistake.contains(place), "{mistake}");

    write("watch: [/a]\nlimits: {topics: 7}\n");
    let reloaded = ask(&agent, "POST", "/-/reload", "", "");
    assert!(reloaded.body.contains("[\"limits\"]"), "{}", reloaded.body);
    let all = [
        entry("/a", "config"),
        entry("/b", "command_line"),
        entry("/c", "api"),
        entry("/e/**", "api"),
    ];
    assert_eq!(listed(&agent), all);

    let health: Value = serde_json::from_str(&ask(&agent, "GET", "/health", "", "").body).unwrap();
    assert_health(&health);
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

/// Checks the health of a replay with four watches.
fn assert_health(health: &Value) {
    assert_eq!(health["ready"], true);
    assert_eq!(health["watches"], 4);
    assert_eq!(health["watches_kept"], false);
    let abilities = health["abilities"].as_array().unwrap();
    let able = |name: &str| {
        let found = abilities.iter().find(|each| each["ability"] == name);
        found.map(|each| each["able"].as_bool().unwrap())
    };
    assert_eq!(able("forwarded"), Some(true), "{health}");
    assert_eq!(able("subscribers"), Some(false), "{health}");
    assert_eq!(health["interfaces"][0]["interface"], "replay");
    let tables = health["tables"].as_array().unwrap();
    let endpoints = tables.iter().find(|table| table["table"] == "endpoints");
    assert_eq!(endpoints.unwrap()["evictions"], 0, "{health}");
    assert_eq!(health["capabilities"].as_array().map(Vec::len), Some(0));
    let threads = health["threads"].as_array().unwrap();
    let named = |name: &str| threads.iter().any(|thread| thread["thread"] == name);
    assert!(named("rp") && named("capture"), "{health}");
    let is_confined = |thread: &Value| thread["filtered"] == true;
    assert!(threads.iter().all(is_confined), "{health}");
    assert_eq!(health["unfiltered_reason"], Value::Null);
    assert!(health["process_id"].as_u64().unwrap() > 1, "{health}");
    assert!(
        health["uptime_seconds"].as_f64().unwrap() < 3600.0,
        "{health}"
    );
}
