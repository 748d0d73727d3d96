//! The history of a topic over the last minutes.

use super::*;

#[test]
fn the_sum_of_the_history_of_a_topic_agrees_with_its_counters() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let mut lost = 0;
    let mut seen = 0;
    for topic in rows(&get(&agent, "/topics")["topics"]) {
        let name = topic["name"].as_str().unwrap();
        let measured = &topic["measurement"];
        if measured.is_null() || measured["messages"] == 0 {
            continue;
        }
        let path = format!("/topics/{}/history", name.replace('/', "%2F"));
        let history = get(&agent, &path);
        assert_eq!(history["topic"], name);
        let columns: Vec<_> = history.as_object().unwrap().iter().collect();
        let columns = columns.into_iter().filter(|(_, column)| column.is_array());
        let times = rows(&history["times"]);
        assert!(columns.clone().count() >= 8);
        for (key, column) in columns {
            assert_eq!(rows(column).len(), times.len(), "{name}: {key}");
        }
        let numbers = times.iter().map(|time| time.as_f64().unwrap());
        let numbers: Vec<_> = numbers.collect();
        assert!(numbers.is_sorted_by(|one, next| one < next), "{numbers:?}");
        let sum = |key: &str| -> u64 {
            let column = rows(&history[key]).iter();
            column.filter_map(Value::as_u64).sum()
        };
        // No row contains the last, unfinished second.
        let counted = measured["messages"].as_u64().unwrap();
        let rate = measured["rate_hertz"].as_f64().unwrap().max(1.0);
        let reported = sum("messages");
        assert!(
            reported <= counted && counted - reported <= 3 * rate as u64 + 3,
            "{name}: {reported} of {counted}"
        );
        let lost_ever = measured["subscriber_lost_messages"].as_u64().unwrap();
        assert!(sum("lost_messages") <= lost_ever);
        lost += sum("lost_messages");
        seen += reported;
    }
    assert!(seen > 0 && lost > 0, "{seen} messages, {lost} lost");
}

#[test]
fn the_history_of_a_topic_is_found_by_every_spelling_of_its_name() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let topics = get(&agent, "/topics");
    let mut topics = rows(&topics["topics"]).iter();
    let topic = topics
        .find(|topic| !topic["measurement"].is_null())
        .unwrap();
    let name = topic["name"].as_str().unwrap().trim_start_matches('/');
    for path in [
        format!("/topics/{name}/history"),
        format!("/topics/%2F{name}/history"),
        format!("/topics/%2F{name}/history?domain_id={}", topic["domain_id"]),
    ] {
        assert_eq!(get(&agent, &path)["topic"], format!("/{name}"), "{path}");
    }
    assert!(get(&agent, &format!("/topics/{name}"))["publishers"].is_array());
    for (path, expected) in [
        ("/topics/history".to_owned(), (404, "no-such-topic")),
        ("/topics/nowhere/history".to_owned(), (404, "no-such-topic")),
        (format!("/topics/{name}%2Fhistory"), (404, "no-such-topic")),
        (
            format!("/topics/{name}/history?domain_id=233"),
            (400, "malformed-request"),
        ),
        (
            format!("/topics/{name}/history?x=1"),
            (400, "malformed-request"),
        ),
    ] {
        let answer = request(agent.api, "GET", &path, "");
        let found = (answer.status, code(&answer));
        assert_eq!(found, (expected.0, expected.1.to_owned()), "{path}");
    }
}

#[test]
fn a_history_of_0_seconds_keeps_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, "page: {history_s: 0}\n").unwrap();
    let agent = ended(
        "cyclonedds/points-besteffort-lossy-2ns",
        &["--config", config.to_str().unwrap()],
    );
    let topics = get(&agent, "/topics");
    let name = topics["topics"][0]["name"].as_str().unwrap().to_owned();
    let history = get(&agent, &format!("/topics{name}/history"));
    assert_eq!(rows(&history["times"]).len(), 0);
    let tables = get(&agent, "/health");
    assert!(
        rows(&tables["tables"])
            .iter()
            .all(|table| table["table"] != "history")
    );
}
