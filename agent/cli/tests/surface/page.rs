//! What the real binary serves to the page: files, the stream of what changes, history,
//! decoded messages, tokens, downloads. Captures of real robots are replayed.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_testing::local_agent::{Answer, LocalAgent, PATIENCE, ask, exchange, request};
use serde_json::{Value, json};

/// A capture of `agent/testing/data`.
fn data(name: &str) -> PathBuf {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    data.join(name).join("capture.pcap.gz")
}

/// An agent that has come to the end of a capture of which it measured everything.
fn ended(name: &str, arguments: &[&str]) -> LocalAgent {
    let mut all = vec!["--speed", "max", "--watch", "/**"];
    all.extend(arguments);
    let mut agent = LocalAgent::replay(&mut rp(), &data(name), &all);
    agent.wait_for_log("the capture has ended");
    agent
}

fn get(agent: &LocalAgent, path: &str) -> Value {
    let (status, body) = ask(agent.api, "GET", path, "");
    assert_eq!(status, 200, "{path}: {body}");
    body
}

/// The end of the problem's type.
fn code(answer: &Answer) -> String {
    let body: Value = serde_json::from_str(&answer.body).unwrap_or_default();
    let code = body["type"].as_str().unwrap_or_default();
    code.replace("urn:ros2probe:problem:", "")
}

/// A stream of lines. HTTP/1.0: nothing stands between them.
struct Lines {
    reader: BufReader<TcpStream>,
}

impl Lines {
    fn open(api: SocketAddr, path: &str, headers: &str) -> Result<Self, Answer> {
        let mut stream = TcpStream::connect(api).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("GET {path} HTTP/1.0\r\nHost: {api}\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        let mut head = String::new();
        while !head.ends_with("\r\n\r\n") {
            assert!(reader.read_line(&mut head).unwrap() > 0, "{head}");
        }
        let status: u16 = head.split(' ').nth(1).unwrap().parse().unwrap();
        if status == 200 {
            assert!(
                head.to_lowercase()
                    .contains("content-type: application/x-ndjson"),
                "{head}"
            );
            return Ok(Self { reader });
        }
        let mut body = String::new();
        reader.read_to_string(&mut body).unwrap();
        Err(Answer {
            status,
            headers: head,
            body,
        })
    }

    /// The next line: its one member's name and value; `None` at the end.
    fn next(&mut self) -> Option<(String, Value)> {
        let mut line = String::new();
        if self.reader.read_line(&mut line).unwrap() == 0 {
            return None;
        }
        let line: Value = serde_json::from_str(&line).unwrap_or_else(|_| panic!("{line}"));
        let members = line.as_object().unwrap();
        assert_eq!(members.len(), 1, "{line}");
        let (name, value) = members.iter().next().unwrap();
        Some((name.clone(), value.clone()))
    }

    /// Lines up to the next one of figures.
    fn batch(&mut self) -> Vec<(String, Value)> {
        let mut lines = Vec::new();
        loop {
            let line = self.next().unwrap();
            let is_last = line.0 == "values";
            lines.push(line);
            if is_last {
                return lines;
            }
        }
    }
}

fn line<'a>(lines: &'a [(String, Value)], name: &str) -> &'a Value {
    let found = lines.iter().find(|(each, _)| each == name);
    &found.unwrap_or_else(|| panic!("no {name} in {lines:?}")).1
}

fn rows(list: &Value) -> &Vec<Value> {
    list.as_array().unwrap()
}

#[test]
fn the_history_of_a_topic_adds_up_to_what_was_counted() {
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
        // The last, unfinished second is in no row.
        let counted = measured["messages"].as_u64().unwrap();
        let rate = measured["rate_hertz"].as_f64().unwrap().max(1.0);
        let told = sum("messages");
        assert!(
            told <= counted && counted - told <= 3 * rate as u64 + 3,
            "{name}: {told} of {counted}"
        );
        assert!(sum("lost_messages") <= measured["lost_messages"].as_u64().unwrap());
        lost += sum("lost_messages");
        seen += told;
    }
    assert!(seen > 0 && lost > 0, "{seen} messages, {lost} lost");
}

#[test]
fn the_history_of_a_topic_is_found_by_every_way_to_write_its_name() {
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
fn without_seconds_nothing_is_kept() {
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

#[test]
fn a_stream_begins_with_everything_and_goes_on_with_what_changes() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
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

    // The graph is that of the other answers.
    let graph = line(&first, "graph");
    let topics = get(&agent, "/topics?hidden=true");
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
        // Its figures, too.
        let values = line(&first, "values");
        let mut figures = rows(&values["topics"]).iter();
        let figures = figures.find(|figures| figures[0] == row[0]);
        if !topic["measurement"].is_null() {
            let figures = figures.unwrap();
            assert_eq!(figures[3], topic["measurement"]["messages"], "{topic}");
            assert_eq!(figures[4], topic["measurement"]["lost_messages"]);
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
            .starts_with("A capture holds")),
        "{findings:?}"
    );
    let loss = findings.iter().find(|each| each["kind"] == "loss").unwrap();
    assert!(
        loss["topic"].is_u64() && loss["since"].as_f64().unwrap() > 1e9,
        "{loss}"
    );

    // The capture has ended: nothing changes, and the stream goes on.
    let began = Instant::now();
    for _ in 0..2 {
        let batch = live.batch();
        assert_eq!(batch.len(), 1, "{batch:?}");
        assert_eq!(rows(&batch[0].1["topics"]).len(), 0, "{batch:?}");
        assert_eq!(batch[0].1["replay"][1], 1);
    }
    assert!(
        (1.0..6.0).contains(&began.elapsed().as_secs_f64()),
        "{began:?}"
    );
    // A watch changes the structure; the figures stay.
    assert_eq!(ask(agent.api, "POST", "/watch/another", "").0, 201);
    let batch = live.batch();
    assert!(
        line(&batch, "agent")["watches"].as_u64().unwrap() == 2,
        "{batch:?}"
    );
}

#[test]
fn a_replay_tells_figures_in_the_time_of_its_capture() {
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
fn streams_are_limited_and_a_closed_one_is_noticed() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let open = || Lines::open(agent.api, "/live", "");
    let mut all: Vec<_> = (0..16)
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
    all.truncate(15);
    let deadline = Instant::now() + Duration::from_secs(5);
    while open().is_err() {
        assert!(Instant::now() < deadline, "a closed stream keeps its place");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_client_that_does_not_read_costs_nothing_and_misses_no_change() {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "4"]);
    agent.wait_for_log("ready");
    let mut slow = Lines::open(agent.api, "/live", "").unwrap_or_else(|_| panic!());
    agent.wait_for_log("the capture has ended");
    // What it knows after all that has come is what another one is told at once.
    let mut state = std::collections::BTreeMap::new();
    let mut graph = Value::Null;
    let until = Instant::now() + Duration::from_secs(3);
    while Instant::now() < until {
        for (name, value) in slow.batch() {
            match name.as_str() {
                "graph" => graph = value,
                "values" => {
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
    let told = by_name(
        line(&first, "graph"),
        rows(&line(&first, "values")["topics"]).clone(),
    );
    assert!(!told.is_empty());
    assert_eq!(known, told);
}

/// The same, with the bytes of the body.
fn bytes_of(api: SocketAddr, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(api).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let head = format!("GET {path} HTTP/1.1\r\nHost: {api}\r\nConnection: close\r\n{headers}\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer
        .windows(4)
        .position(|bytes| bytes == b"\r\n\r\n")
        .unwrap();
    let body = answer.split_off(end + 4);
    let head = String::from_utf8(answer).unwrap().to_lowercase();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    (status, head, body)
}

#[test]
fn the_page_is_served_with_a_strict_policy_and_revalidated() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../page");
    let index = std::fs::read(folder.join("index.html")).unwrap();
    let (status, head, body) = bytes_of(agent.api, "/", "");
    assert_eq!((status, &body), (200, &index), "{head}");
    for header in [
        "content-type: text/html; charset=utf-8",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "cross-origin-opener-policy: same-origin",
        "cross-origin-resource-policy: same-origin",
        "cache-control: no-cache",
        "vary: accept-encoding",
    ] {
        assert!(head.contains(header), "{header} is not in {head}");
    }
    let policy = head
        .lines()
        .find(|line| line.starts_with("content-security-policy:"))
        .unwrap();
    for part in [
        "default-src 'none'",
        "script-src 'self'",
        "frame-ancestors 'none'",
    ] {
        assert!(policy.contains(part), "{policy}");
    }
    assert!(
        !policy.contains("unsafe") && !policy.contains("http"),
        "{policy}"
    );
    let tag = head
        .lines()
        .find_map(|line| line.strip_prefix("etag: "))
        .unwrap()
        .to_owned();
    let (status, head, body) = bytes_of(agent.api, "/", &format!("If-None-Match: {tag}\r\n"));
    assert_eq!((status, body.len()), (304, 0), "{head}");
    let (_, head, packed) = bytes_of(agent.api, "/", "Accept-Encoding: gzip\r\n");
    assert!(
        head.contains("content-encoding: gzip") && packed.len() < index.len(),
        "{head}"
    );
    let mut unpacked = Vec::new();
    flate2::read::GzDecoder::new(&packed[..])
        .read_to_end(&mut unpacked)
        .unwrap();
    assert_eq!(unpacked, index);
    let (status, head, body) = bytes_of(agent.api, "/page/vendor/preact.mjs", "");
    assert_eq!(status, 200);
    assert!(head.contains("content-type: text/javascript"), "{head}");
    assert_eq!(
        body,
        std::fs::read(folder.join("vendor/preact.mjs")).unwrap()
    );
    for path in [
        "/page/nowhere.js",
        "/page/../Cargo.toml",
        "/page/test/robot.js",
        "/page/",
    ] {
        assert_eq!(request(agent.api, "GET", path, "").status, 404, "{path}");
    }
    assert_eq!(request(agent.api, "POST", "/", "").status, 405);
}

#[test]
fn the_page_of_this_listener_may_ask_and_others_may_not() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let own = format!(
        "Origin: http://{}\r\nSec-Fetch-Site: same-origin\r\n",
        agent.api
    );
    assert_eq!(
        request(agent.api, "POST", "/watch/points", &own).status,
        201
    );
    let foreign = "Origin: http://evil.example\r\nSec-Fetch-Site: cross-site\r\n";
    for (method, path) in [
        ("POST", "/watch/b"),
        ("GET", "/live"),
        ("POST", "/page/token"),
    ] {
        let answer = request(agent.api, method, path, foreign);
        assert_eq!(
            (answer.status, code(&answer)),
            (403, "foreign-origin".to_owned())
        );
    }
    // A link may lead to the page; a foreign page may not load its parts.
    let link =
        "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: document\r\n";
    assert_eq!(request(agent.api, "GET", "/", link).status, 200);
    let part = "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: no-cors\r\n";
    let answer = request(agent.api, "GET", "/page/icon.svg", part);
    assert_eq!(code(&answer), "foreign-origin");
    // A link reaches no route of the API.
    assert_eq!(
        code(&request(agent.api, "GET", "/topics", link)),
        "foreign-origin"
    );
    let stream = TcpStream::connect(agent.api).unwrap();
    let answer = exchange(stream, "GET / HTTP/1.1\r\nHost: evil.example\r\n", "");
    assert_eq!(
        (answer.status, code(&answer)),
        (403, "foreign-host".to_owned())
    );
}

#[test]
fn the_page_can_be_switched_off() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, "api: {page: off}\n").unwrap();
    let agent = ended(
        "cyclonedds/points-besteffort-lossy-2ns",
        &["--config", config.to_str().unwrap()],
    );
    for path in ["/", "/page/icon.svg"] {
        let answer = request(agent.api, "GET", path, "");
        assert_eq!(
            (answer.status, code(&answer)),
            (404, "not-found".to_owned()),
            "{path}"
        );
    }
    assert_eq!(get(&agent, "/health")["ready"], true);
    let (status, token) = ask(agent.api, "POST", "/page/token", "");
    assert_eq!((status, &token["address"]), (200, &Value::Null));
}

#[test]
fn a_token_of_the_socket_lets_the_page_do_what_loopback_may_not() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, format!("api: {{socket: {}}}\n", socket.display())).unwrap();
    let agent = ended(
        "cyclonedds/points-besteffort-lossy-2ns",
        &[
            "--config",
            config.to_str().unwrap(),
            "--api-loopback",
            "read",
        ],
    );
    let refused = request(agent.api, "POST", "/page/token", "");
    assert_eq!(
        (refused.status, code(&refused)),
        (403, "needs-socket".to_owned())
    );
    assert!(refused.body.contains("rp page"), "{}", refused.body);
    assert_eq!(request(agent.api, "GET", "/recordings", "").status, 403);
    assert_eq!(request(agent.api, "POST", "/watch/a", "").status, 403);

    let printed = rp()
        .args(["page", "--socket"])
        .arg(&socket)
        .output()
        .unwrap();
    let said = String::from_utf8(printed.stderr).unwrap();
    let address = String::from_utf8(printed.stdout).unwrap();
    assert!(printed.status.success(), "{said}");
    let (page, token) = address.trim().split_once("#token=").unwrap();
    assert_eq!(page, format!("http://localhost:{}/", agent.api.port()));
    let bearer = format!("Authorization: Bearer {token}\r\n");
    assert_eq!(
        request(agent.api, "GET", "/recordings", &bearer).status,
        200
    );
    assert_eq!(request(agent.api, "POST", "/watch/a", &bearer).status, 201);
    let open = |headers: &str| {
        let mut live = Lines::open(agent.api, "/live", headers).unwrap_or_else(|_| panic!());
        line(&live.batch(), "open")["access"].clone()
    };
    assert_eq!((open(""), open(&bearer)), (json!("read"), json!("all")));
    // A wrong one grants nothing more, and a foreign page nothing at all.
    let wrong = format!("Authorization: Bearer {}\r\n", "0".repeat(64));
    assert_eq!(request(agent.api, "GET", "/recordings", &wrong).status, 403);
    let foreign = format!("{bearer}Origin: http://evil.example\r\n");
    let answer = request(agent.api, "GET", "/recordings", &foreign);
    assert_eq!(code(&answer), "foreign-origin");
    let stream = UnixStream::connect(&socket).unwrap();
    let by_socket = exchange(stream, "GET / HTTP/1.1\r\nHost: rp\r\n", "");
    assert_eq!(by_socket.status, 404, "no browser comes by the socket");
}

#[test]
fn a_listener_that_wants_a_token_serves_files_without_one() {
    let directory = tempfile::tempdir().unwrap();
    let token = directory.path().join("token");
    std::fs::write(&token, "0123456789abcdef0123\n").unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(
        &config,
        format!("api: {{token_file: {}}}\n", token.display()),
    )
    .unwrap();
    let agent = ended(
        "cyclonedds/points-besteffort-lossy-2ns",
        &["--config", config.to_str().unwrap()],
    );
    assert_eq!(request(agent.api, "GET", "/", "").status, 200);
    assert_eq!(request(agent.api, "GET", "/topics", "").status, 401);
    let own = "Authorization: Bearer 0123456789abcdef0123\r\n";
    let given = request(agent.api, "POST", "/page/token", own);
    assert_eq!(given.status, 200, "{}", given.body);
    let given: Value = serde_json::from_str(&given.body).unwrap();
    let bearer = format!(
        "Authorization: Bearer {}\r\n",
        given["token"].as_str().unwrap()
    );
    assert_eq!(request(agent.api, "GET", "/topics", &bearer).status, 200);
}

#[test]
fn another_robot_s_page_comes_by_a_tunnel() {
    let printed = rp().args(["page", "--host", "robot1"]).output().unwrap();
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(printed.status.success());
    assert!(
        text.starts_with("ssh -L 17401:127.0.0.1:17401 robot1\n"),
        "{text}"
    );
}

#[test]
fn an_agent_of_this_host_is_reached_by_its_address() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let host = agent.api.to_string();
    let printed = rp().args(["page", "--host", &host]).output().unwrap();
    let text = String::from_utf8(printed.stdout).unwrap();
    let (page, token) = text.trim().split_once("#token=").unwrap();
    assert_eq!(page, format!("http://{host}/"));
    let bearer = format!("Authorization: Bearer {token}\r\n");
    let mut live = Lines::open(agent.api, "/live", &bearer).unwrap_or_else(|_| panic!());
    assert_eq!(line(&live.batch(), "open")["access"], "all");
}

#[test]
fn messages_are_decoded_five_a_second_at_most() {
    let capture = data("cyclonedds/lifecycle-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "0.5"]);
    agent.wait_for_log("ready");
    // The robot of the capture publishes it from some moment on.
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
    let (mut told, mut known) = (Vec::new(), Value::Null);
    while told.len() < 3 {
        match lines.next().unwrap() {
            (name, value) if name == "type" => known = value,
            (name, value) if name == "message" => told.push(value),
            (name, value) if name == "end" => panic!("{value} after {told:?}"),
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
    for message in &told {
        assert!(
            message["value"]["data"]
                .as_str()
                .is_some_and(|text| !text.is_empty()),
            "{message}"
        );
        assert!(message["error"].is_null() && message["bytes"].as_u64().unwrap() > 4);
        assert!(message["time"].as_f64().unwrap() > 1e9);
    }
    // However late this program reads them.
    let most = 1.0 + 5.0 * opened.elapsed().as_secs_f64();
    assert!(told.len() as f64 <= most, "{told:?}");
    for pair in told.windows(2) {
        let [time, next] = [&pair[0], &pair[1]].map(|message| message["time"].as_f64().unwrap());
        assert!(next > time, "{told:?}");
        let number = |message: &Value| message["sequence_number"].as_u64().unwrap();
        let skipped = pair[1]["skipped"].as_u64().unwrap();
        assert_eq!(number(&pair[1]) - number(&pair[0]), skipped + 1, "{told:?}");
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
fn topics_whose_messages_are_decoded_are_limited() {
    // So slow that no stream ends by itself meanwhile.
    let capture = data("cyclonedds/lifecycle-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "0.2"]);
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
    // Streams take no turn of other answers.
    assert!(!rows(&get(&agent, "/topics")["topics"]).is_empty());
    let refused = open().err().unwrap();
    assert_eq!(
        (refused.status, code(&refused)),
        (503, "too-many-streams".to_owned())
    );
    all.pop();
    let deadline = Instant::now() + Duration::from_secs(5);
    while open().is_err() {
        assert!(Instant::now() < deadline, "a closed stream keeps its place");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_bag_can_be_taken_away_whole() {
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
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
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
    let (status, begun) = ask(agent.api, "POST", "/recordings", r#"{"name": "one"}"#);
    assert_eq!(status, 201, "{begun}");
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(ask(agent.api, "DELETE", "/recordings/one", "").0, 200);
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
