//! Decoded messages, and downloads of bags.

use super::*;
use crate::recordings::long_capture;

#[test]
fn at_most_five_messages_per_second_are_decoded() {
    let capture = long_capture();
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "1"]);
    agent.wait_for_log("ready");
    let deadline = Instant::now() + PATIENCE;
    let topic = loop {
        let topics = get(&agent, "/topics");
        let chatty = rows(&topics["topics"]).iter().find(|topic| {
            topic["measurement"]["messages"]
                .as_u64()
                .is_some_and(|count| count > 3)
                && rows(&topic["message_types"])
                    .iter()
                    .any(|each| each == "std_msgs/msg/String")
        });
        if let Some(topic) = chatty {
            break topic["name"].as_str().unwrap().to_owned();
        }
        assert!(Instant::now() < deadline, "{topics}");
        std::thread::sleep(Duration::from_millis(100));
    };
    let path = format!("/topics/{}/messages", topic.replace('/', "%2F"));
    let opened = Instant::now();
    let mut lines = Lines::open(agent.api, &path, "").unwrap_or_else(|_| panic!("{path}"));
    let (mut reported, mut known) = (Vec::new(), Value::Null);
    while reported.len() < 3 {
        match lines.next().unwrap() {
            (name, value) if name == "type" => known = value,
            (name, value) if name == "message" => reported.push(value),
            (name, value) if name == "end" => panic!("{value} after {reported:?}"),
            _ => {}
        }
    }
    assert_eq!(
        (&known["name"], &known["known"]),
        (&json!("std_msgs/msg/String"), &json!(true))
    );
    assert!(
        known["definition"]
            .as_str()
            .unwrap()
            .contains("string data"),
        "{known}"
    );
    for message in &reported {
        assert!(
            message["value"]["data"]
                .as_str()
                .is_some_and(|text| !text.is_empty()),
            "{message}"
        );
        assert!(message["error"].is_null() && message["bytes"].as_u64().unwrap() > 4);
        assert!(message["time"].as_f64().unwrap() > 1e9);
    }
    // The maximum rate holds even if this test reads the messages late.
    let most = 1.0 + 5.0 * opened.elapsed().as_secs_f64();
    assert!(reported.len() as f64 <= most, "{reported:?}");
    for pair in reported.windows(2) {
        let [time, next] = [&pair[0], &pair[1]].map(|message| message["time"].as_f64().unwrap());
        assert!(next > time, "{reported:?}");
        let number = |message: &Value| message["sequence_number"].as_u64().unwrap();
        let skipped = pair[1]["skipped"].as_u64().unwrap();
        assert_eq!(
            number(&pair[1]) - number(&pair[0]),
            skipped + 1,
            "{reported:?}"
        );
    }
    for (query, status) in [
        ("?max_hertz=6", 422),
        ("?max_hertz=x", 400),
        ("?domain_id=5", 404),
    ] {
        let answer = Lines::open(agent.api, &format!("{path}{query}"), "")
            .err()
            .unwrap();
        assert_eq!(answer.status, status, "{query}: {}", answer.body);
    }
}

#[test]
fn the_number_of_topics_with_decoded_messages_is_limited() {
    // The capture is long enough that no stream ends during the test.
    let capture = long_capture();
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "1"]);
    agent.wait_for_log("ready");
    let deadline = Instant::now() + PATIENCE;
    let topic = loop {
        let topics = get(&agent, "/topics");
        if let Some(topic) = rows(&topics["topics"]).first() {
            break topic["name"].as_str().unwrap().to_owned();
        }
        assert!(Instant::now() < deadline, "{topics}");
        std::thread::sleep(Duration::from_millis(100));
    };
    let path = format!("/topics/{}/messages", topic.replace('/', "%2F"));
    let open = || Lines::open(agent.api, &path, "");
    let mut all: Vec<_> = (0..8)
        .map(|_| open().unwrap_or_else(|answer| panic!("{}", answer.body)))
        .collect();
    // Open streams do not block other answers.
    assert!(!rows(&get(&agent, "/topics")["topics"]).is_empty());
    let refused = open().err().unwrap();
    assert_eq!(
        (refused.status, code(&refused)),
        (503, "too-many-streams".to_owned())
    );
    all.pop();
    let deadline = Instant::now() + PATIENCE;
    while open().is_err() {
        assert!(Instant::now() < deadline, "a closed stream keeps its place");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn all_files_of_a_bag_can_be_downloaded() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    let bags = directory.path().join("bags");
    std::fs::write(
        &config,
        format!(
            "recordings: {{directory: {}, reserve_percent: 0, reserve_bytes: 0}}\n",
            bags.display()
        ),
    )
    .unwrap();
    std::fs::create_dir(&bags).unwrap();
    let capture = long_capture();
    let mut agent = LocalAgent::replay(
        &mut rp(),
        &capture,
        &[
            "--config",
            config.to_str().unwrap(),
            "--watch",
            "/**",
            "--speed",
            "1",
        ],
    );
    agent.wait_for_log("ready");
    let (status, begun) = call_api(agent.api, "POST", "/recordings", r#"{"name": "one"}"#);
    assert_eq!(status, 201, "{begun}");
    let deadline = Instant::now() + PATIENCE;
    while get(&agent, "/recordings/one")["report"]["messages"].as_u64() < Some(1) {
        assert!(Instant::now() < deadline, "nothing was recorded");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(call_api(agent.api, "DELETE", "/recordings/one", "").0, 200);
    let files = get(&agent, "/recordings/one/files");
    let files = rows(&files["files"]);
    assert!(files.len() >= 2, "{files:?}");
    for file in files {
        let name = file["file"].as_str().unwrap();
        let (status, head, body) =
            bytes_of(agent.api, &format!("/recordings/one/files/{name}"), "");
        assert_eq!(status, 200, "{head}");
        assert_eq!(
            body,
            std::fs::read(bags.join("one").join(name)).unwrap(),
            "{name}"
        );
        assert_eq!(body.len() as u64, file["bytes"].as_u64().unwrap());
        assert!(head.contains("content-disposition: attachment"), "{head}");
    }
    for path in [
        "one/files/..%2F..%2Fconfig.yaml",
        "one/files/nothing",
        "two/files",
    ] {
        let answer = request(agent.api, "GET", &format!("/recordings/{path}"), "");
        assert_eq!(
            (answer.status, code(&answer)),
            (404, "no-such-recording".to_owned()),
            "{path}"
        );
    }
}
