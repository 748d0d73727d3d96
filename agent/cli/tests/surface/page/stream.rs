//! The stream of figures for the web page.

use super::*;

#[test]
fn a_stream_begins_with_the_whole_state_and_continues_with_changes() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let opened = Instant::now();
    let mut live = Lines::open(agent.api, "/live", "").unwrap_or_else(|_| panic!());
    let first = live.batch();
    let names: Vec<_> = first.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(
        names,
        ["open", "graph", "agent", "findings", "history", "values"]
    );
    let open = line(&first, "open");
    assert_eq!(
        (&open["source"], &open["access"]),
        (&json!("replay"), &json!("all"))
    );
    assert_eq!(open["history_seconds"], 600);
    assert!(open["replay"]["begin"].as_f64().unwrap() > 1e9);

    assert_graph(&agent, &first, open);
    let history = line(&first, "history");
    assert!(!rows(&history["topics"]).is_empty());
    assert_eq!(
        rows(&history["topics"][0][1]).len(),
        rows(&history["t"]).len()
    );
    let findings = rows(line(&first, "findings"));
    let mut notes = findings.iter().filter(|each| each["kind"] == "ability");
    assert!(
        notes.any(|note| note["text"]
            .as_str()
            .unwrap()
            .starts_with("A capture file contains")),
        "{findings:?}"
    );
    let loss = findings.iter().find(|each| each["kind"] == "loss").unwrap();
    assert!(
        loss["topic"].is_u64() && loss["since"].as_f64().unwrap() > 1e9,
        "{loss}"
    );

    // After the end of the capture nothing changes, and the stream continues.
    for number in 2_u32..=3 {
        let batch = live.batch();
        assert_eq!(batch.len(), 1, "{batch:?}");
        assert_eq!(rows(&batch[0].1["topics"]).len(), 0, "{batch:?}");
        assert_eq!(batch[0].1["replay"][1], 1);
        // A batch of a second, even if this test reads it late.
        let most = 2.2 + opened.elapsed().as_secs_f64();
        assert!(f64::from(number) <= most, "batch {number} of {most}");
    }
    // A watch changes the structure, but not the figures.
    assert_eq!(call_api(agent.api, "POST", "/watch/another", "").0, 201);
    let batch = live.batch();
    assert!(
        line(&batch, "agent")["watches"].as_u64().unwrap() == 2,
        "{batch:?}"
    );
}

/// Asserts that the graph and its figures agree with the other answers of the API.
fn assert_graph(agent: &LocalAgent, first: &[(String, Value)], open: &Value) {
    let graph = line(first, "graph");
    let topics = get(agent, "/topics?hidden=true");
    let is_plain = |topic: &&Value| {
        let kind = topic["kind"].as_str().unwrap();
        !["service_request", "service_reply", "discovery"].contains(&kind)
    };
    let expected: Vec<_> = rows(&topics["topics"]).iter().filter(is_plain).collect();
    assert_eq!(rows(&graph["topics"]).len(), expected.len());
    let mut endpoints = 0;
    let flags = rows(&open["flags"]);
    for topic in expected {
        let mut own = rows(&graph["topics"]).iter();
        let row = own.find(|row| row[3] == topic["dds_name"] && row[1] == topic["domain_id"]);
        let row = row.unwrap();
        assert_eq!((&row[2], &row[4]), (&topic["name"], &topic["kind"]));
        assert_eq!(row[5], topic["message_types"]);
        for (side, list) in [
            ("publishers", "publishers"),
            ("subscriptions", "subscriptions"),
        ] {
            let ends = rows(&graph[side]).iter().filter(|end| end[0] == row[0]);
            let guids: Vec<_> = ends.clone().map(|end| end[3].clone()).collect();
            let known = rows(&topic[list]).iter();
            let known: Vec<_> = known.map(|end| end["guid"].clone()).collect();
            assert_eq!(guids, known, "{topic}");
            endpoints += guids.len();
            for (end, known) in ends.zip(rows(&topic[list])) {
                assert_eq!(end[5], known["qos"]["reliability"]);
                let mut nodes = rows(&graph["nodes"]).iter();
                let node = nodes.find(|node| node[0] == end[1]);
                assert_eq!(node.map_or(&Value::Null, |node| &node[2]), &known["node"]);
            }
        }
        // The figures of the topic agree, too.
        let values = line(first, "values");
        let mut figures = rows(&values["topics"]).iter();
        let figures = figures.find(|figures| figures[0] == row[0]);
        if !topic["measurement"].is_null() {
            let figures = figures.unwrap();
            assert_eq!(figures[3], topic["measurement"]["messages"], "{topic}");
            assert_eq!(figures[4], topic["measurement"]["subscriber_lost_messages"]);
            let bits = figures[8].as_u64().unwrap();
            let marked = |name: &str| {
                let place = flags.iter().position(|flag| flag == name).unwrap();
                bits >> place & 1 == 1
            };
            let is_lossy = figures[4].as_u64().unwrap() > 0;
            assert_eq!(marked("loss"), is_lossy, "{topic}");
        }
    }
    assert!(endpoints > 0);
}

#[test]
fn the_figures_of_a_replay_have_the_times_of_its_capture() {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "0.5"]);
    agent.wait_for_log("ready");
    let mut live = Lines::open(agent.api, "/live", "").unwrap_or_else(|_| panic!());
    let first = live.batch();
    let begin = line(&first, "open")["replay"]["begin"].as_f64();
    let mut times = Vec::new();
    let mut messages = 0;
    let counted = |values: &Value| -> u64 {
        let counts = rows(&values["topics"]).iter().map(|row| row[3].as_u64());
        counts.flatten().sum()
    };
    for _ in 0..4 {
        let batch = live.batch();
        let values = line(&batch, "values");
        times.push(values["t"].as_f64().unwrap());
        let part = values["replay"][0].as_f64().unwrap();
        assert!((0.0..=1.0).contains(&part), "{part}");
        messages += counted(values);
    }
    let begin = begin.unwrap_or(times[0]);
    assert!(times.is_sorted() && times[3] - times[0] > 0.7, "{times:?}");
    assert!(times[0] - begin < 30.0, "{begin} {times:?}");
    messages += counted(line(&first, "values"));
    let deadline = Instant::now() + PATIENCE;
    while messages == 0 {
        assert!(Instant::now() < deadline, "no message is counted");
        messages += counted(line(&live.batch(), "values"));
    }
}

#[test]
fn streams_beyond_the_cap_are_refused_until_one_is_closed() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let open = || Lines::open(agent.api, "/live", "");
    // A quarter of the 16 streams is reserved for clients with a token.
    let mut all: Vec<_> = (0..12)
        .map(|_| open().unwrap_or_else(|_| panic!()))
        .collect();
    for live in &mut all {
        live.batch();
    }
    let refused = open().err().unwrap();
    assert_eq!(
        (refused.status, code(&refused)),
        (503, "too-many-streams".to_owned())
    );
    all.truncate(11);
    let deadline = Instant::now() + PATIENCE;
    while open().is_err() {
        assert!(Instant::now() < deadline, "a closed stream keeps its place");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_client_that_reads_late_gets_all_changes() {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "4"]);
    agent.wait_for_log("ready");
    let mut slow = Lines::open(agent.api, "/live", "").unwrap_or_else(|_| panic!());
    agent.wait_for_log("the capture has ended");
    // A client that has applied all changes has the same state as a new client after its first
    // batch.
    let mut state = std::collections::BTreeMap::new();
    let mut graph = Value::Null;
    let deadline = Instant::now() + PATIENCE;
    // Two batches without a change after the end of the capture are enough.
    let mut unchanged = 0;
    while unchanged < 2 {
        assert!(Instant::now() < deadline, "the figures still change");
        for (name, value) in slow.batch() {
            match name.as_str() {
                "graph" => graph = value,
                "values" => {
                    let is_still = value["replay"][1] == 1 && rows(&value["topics"]).is_empty();
                    unchanged = if is_still { unchanged + 1 } else { 0 };
                    for row in rows(&value["topics"]) {
                        state.insert(row[0].as_u64().unwrap(), row.clone());
                    }
                }
                _ => {}
            }
        }
    }
    let mut fresh = Lines::open(agent.api, "/live", "").unwrap_or_else(|_| panic!());
    let first = fresh.batch();
    let by_name = |graph: &Value, rows: Vec<Value>| -> Vec<(Value, Value)> {
        let topics = graph["topics"].as_array().unwrap();
        let mut named: Vec<_> = rows
            .into_iter()
            .filter_map(|row| {
                let topic = topics.iter().find(|topic| topic[0] == row[0])?;
                let figures = row.as_array().unwrap().get(1..).unwrap().to_vec();
                Some((topic[3].clone(), Value::from(figures)))
            })
            .collect();
        named.sort_by_key(|(name, _)| name.to_string());
        named
    };
    let known = by_name(&graph, state.into_values().collect());
    let reported = by_name(
        line(&first, "graph"),
        rows(&line(&first, "values")["topics"]).clone(),
    );
    assert!(!reported.is_empty());
    assert_eq!(known, reported);
}
