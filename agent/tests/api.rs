//! The control API of the real binary, on free ports of this host.
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test may panic"
)]

mod local_agent;

use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use local_agent::{Answer, LocalAgent, PATIENCE, exchange};
use serde_json::Value;

/// A request with headers (each line ended) and a body.
fn ask(agent: &LocalAgent, method: &str, path: &str, headers: &str, body: &str) -> Answer {
    let stream = TcpStream::connect(agent.api).unwrap();
    let host = agent.api;
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n{headers}"
    );
    exchange(stream, &head, body)
}

/// The status and the end of the problem's type, or nothing.
fn problem(answer: &Answer) -> (u16, String) {
    let body: Value = serde_json::from_str(&answer.body).unwrap_or_default();
    let code = body["type"].as_str().unwrap_or_default().to_owned();
    if !code.is_empty() {
        assert!(
            answer
                .headers
                .contains("content-type: application/problem+json")
        );
        assert_eq!(body["status"], answer.status);
    }
    (answer.status, code.replace("urn:ros2probe:problem:", ""))
}

/// Asks until the answer is as wanted.
fn wait_for(agent: &LocalAgent, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let answer = ask(agent, "GET", path, "", "");
        let body = serde_json::from_str(&answer.body).unwrap();
        if wanted(&body) {
            return body;
        }
        assert!(Instant::now() < deadline, "{path}: {}", answer.body);
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn the_checked_in_document_is_the_generated_one() {
    let generated = ros2probe::surface::api::document()
        .to_pretty_json()
        .unwrap()
        + "\n";
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/openapi.json");
    if std::env::var_os("UPDATE_OPENAPI").is_some() {
        std::fs::write(&path, &generated).unwrap();
    }
    assert_eq!(
        std::fs::read_to_string(path).unwrap(),
        generated,
        "run `UPDATE_OPENAPI=1 cargo test -p ros2probe --test api` and commit the result"
    );
}

#[test]
fn a_watch_is_added_shown_replaced_and_removed() {
    let mut agent = LocalAgent::start(&["--speed", "0.5"]);
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

    // Of a topic that is not there, in one domain.
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
