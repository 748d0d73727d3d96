//! Answers to the web page for replays of real robots: files, the stream of changes, history,
//! decoded messages, tokens and downloads.

mod doctor;
mod history;
mod messages;
mod past;
mod stream;

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_testing::local_agent::{Answer, LocalAgent, PATIENCE, call_api, exchange, request};
use serde_json::{Value, json};

/// Returns the path of a capture of `agent/testing/data`.
pub(crate) fn data(name: &str) -> PathBuf {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    data.join(name).join("capture.pcap.gz")
}

/// Returns an agent that has replayed a capture to its end and measured every topic.
fn ended(name: &str, arguments: &[&str]) -> LocalAgent {
    let mut all = vec!["--speed", "max", "--watch", "/**"];
    all.extend(arguments);
    let mut agent = LocalAgent::replay(&mut rp(), &data(name), &all);
    agent.wait_for_log("the capture has ended");
    agent
}

pub(crate) fn get(agent: &LocalAgent, path: &str) -> Value {
    let (status, body) = call_api(agent.api, "GET", path, "");
    assert_eq!(status, 200, "{path}: {body}");
    body
}

/// Returns the last part of the problem's type.
fn code(answer: &Answer) -> String {
    let body: Value = serde_json::from_str(&answer.body).unwrap_or_default();
    let code = body["type"].as_str().unwrap_or_default();
    code.replace("urn:ros2probe:problem:", "")
}

/// A stream of lines over HTTP/1.0, which has no chunks.
pub(crate) struct Lines {
    reader: BufReader<TcpStream>,
}

impl Lines {
    pub(crate) fn open(api: SocketAddr, path: &str, headers: &str) -> Result<Self, Answer> {
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

    /// Returns the name and the value of the only member of the next line, or `None` at the end.
    pub(crate) fn next(&mut self) -> Option<(String, Value)> {
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

    /// Returns all lines up to the next line with figures, which is the last.
    pub(crate) fn batch(&mut self) -> Vec<(String, Value)> {
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
fn requests_of_the_own_page_are_permitted_and_those_of_foreign_pages_are_refused() {
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
    // A link may lead to the page, but a foreign page may not load parts of the page.
    let link =
        "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: document\r\n";
    assert_eq!(request(agent.api, "GET", "/", link).status, 200);
    let part = "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: no-cors\r\n";
    let answer = request(agent.api, "GET", "/page/icon.svg", part);
    assert_eq!(code(&answer), "foreign-origin");
    // A link may not lead to a route of the API.
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
    let health = get(&agent, "/health");
    assert_eq!(
        (&health["ready"], &health["page"]),
        (&Value::Bool(true), &Value::Null)
    );
    let (status, token) = call_api(agent.api, "POST", "/page/token", "");
    assert_eq!((status, &token["address"]), (200, &Value::Null));
}

#[test]
fn a_token_from_the_socket_grants_the_page_more_access_than_loopback() {
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
    let output_text = String::from_utf8(printed.stderr).unwrap();
    let address = String::from_utf8(printed.stdout).unwrap();
    assert!(printed.status.success(), "{output_text}");
    let (page, token) = address.trim().split_once("#token=").unwrap();
    assert_eq!(page, format!("http://localhost:{}/", agent.api.port()));
    assert_eq!(get(&agent, "/health")["page"], page);
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
    // A wrong token grants no right, and a foreign page is refused.
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
fn a_listener_that_requires_a_token_serves_files_without_one() {
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
fn the_page_of_another_robot_is_reached_through_a_tunnel() {
    let printed = rp().args(["page", "--host", "robot1"]).output().unwrap();
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(printed.status.success());
    assert!(
        text.starts_with("ssh -L 17401:127.0.0.1:17401 robot1\n"),
        "{text}"
    );
}

#[test]
fn the_page_of_an_agent_on_this_host_is_reached_at_its_address() {
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

/// Sends a GET request. Returns the status, the head, and the body as bytes.
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
