//! The control API of the real binary, on free ports of this host.

mod document;
mod watches;

use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_daemon::config::Expectations;
use ros2probe_daemon::config::watch::ExpectationValues;
use ros2probe_testing::local_agent::{self, Answer, LocalAgent, PATIENCE, capture, exchange};
use serde_json::Value;

/// Sends a request with these headers (each line ended) and this body.
fn ask(agent: &LocalAgent, method: &str, path: &str, headers: &str, body: &str) -> Answer {
    let stream = TcpStream::connect(agent.api).unwrap();
    let host = agent.api;
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n{headers}"
    );
    exchange(stream, &head, body)
}

/// Returns the status and the last part of the problem's type, which is empty without a problem.
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

/// Repeats the request until the answer has the wanted content.
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

const JSON: &str = "Content-Type: application/json\r\n";
const FORM: &str = "Content-Type: application/x-www-form-urlencoded\r\n";

/// Method, path, headers and body of a request; then the status, the code and words of its answer.
type Refused = (
    &'static str,
    &'static str,
    &'static str,
    &'static str,
    u16,
    &'static str,
    &'static str,
);

const REFUSED: [Refused; 18] = [
    ("GET", "/watches", "", "", 404, "not-found", "/openapi.json"),
    ("GET", "/watch/", "", "", 404, "not-found", ""),
    (
        "PATCH",
        "/watch/a",
        "",
        "",
        405,
        "method-not-allowed",
        "PATCH",
    ),
    ("POST", "/watch/2d", "", "", 422, "invalid-request", "digit"),
    ("POST", "/watch/a/", "", "", 422, "invalid-request", "token"),
    (
        "POST",
        "/watch/a%20b",
        "",
        "",
        422,
        "invalid-request",
        "letters",
    ),
    (
        "POST",
        "/watch/a%ff",
        "",
        "",
        400,
        "malformed-request",
        "UTF-8",
    ),
    (
        "POST",
        "/watch/a?domain=5",
        "",
        "",
        400,
        "malformed-request",
        "domain",
    ),
    (
        "POST",
        "/watch/a?domain_id=300",
        "",
        "",
        422,
        "invalid-request",
        "232",
    ),
    (
        "POST",
        "/watch/a",
        "",
        "{}",
        415,
        "unsupported-media-type",
        "application/json",
    ),
    (
        "POST",
        "/watch/a",
        FORM,
        "{}",
        415,
        "unsupported-media-type",
        "application/json",
    ),
    (
        "POST",
        "/watch/a",
        JSON,
        "{",
        400,
        "malformed-request",
        "EOF",
    ),
    ("POST", "/watch/a", JSON, "[]", 422, "invalid-request", ""),
    (
        "POST",
        "/watch/a",
        JSON,
        "{\"max_loss\": 1}",
        422,
        "invalid-request",
        "max_loss_ratio",
    ),
    (
        "POST",
        "/watch/a",
        JSON,
        "{\"max_loss_ratio\": 2}",
        422,
        "invalid-request",
        "1",
    ),
    (
        "PUT",
        "/watch/a",
        JSON,
        "{\"domain_id\": 233}",
        422,
        "invalid-request",
        "232",
    ),
    (
        "PUT",
        "/watch/a?domain_id=1",
        JSON,
        "{\"domain_id\": 2}",
        422,
        "invalid-request",
        "query",
    ),
    (
        "POST",
        "/-/reload",
        "",
        "",
        409,
        "nothing-to-reload",
        "without a configuration file",
    ),
];

#[test]
fn impossible_requests_are_answered_with_a_problem_and_its_reason() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    for (method, path, headers, body, status, code, says) in REFUSED {
        let answer = ask(&agent, method, path, headers, body);
        let case = format!("{method} {path} {body}: {}", answer.body);
        assert_eq!(problem(&answer), (status, code.to_owned()), "{case}");
        assert!(answer.body.contains(says), "{case}");
    }
    let refused = ask(&agent, "PATCH", "/watch/a", "", "");
    assert!(refused.headers.contains("allow: "), "{}", refused.headers);
    // A request without a body may have any content type. A name may contain slashes.
    assert_eq!(ask(&agent, "POST", "/watch/%2Fa", FORM, "").status, 201);
    assert_eq!(ask(&agent, "GET", "/watch/a", "", "").status, 200);
    let document: Value =
        serde_json::from_str(&ask(&agent, "GET", "/openapi.json", "", "").body).unwrap();
    assert_eq!(document["openapi"], "3.1.0");
}

/// Starts `rp run` with this `api:` section and returns the error that it prints instead of
/// running.
fn refused(section: &str) -> String {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, format!("api: {section}\n")).unwrap();
    let output = rp()
        .args(["run", "--metrics", "off", "--replay"])
        .args([
            capture().to_str().unwrap(),
            "--config",
            config.to_str().unwrap(),
        ])
        .output()
        .unwrap();
    assert!(!output.status.success(), "{section}");
    let printed = String::from_utf8(output.stderr).unwrap();
    let printed = printed.lines().filter(|line| !line.contains(" INFO "));
    let printed: Vec<&str> = printed.collect();
    assert_eq!(printed.len(), 1, "{printed:?}");
    printed[0].to_owned()
}

#[test]
fn an_open_api_without_a_token_or_an_api_that_cannot_be_served_prevents_the_start() {
    let open = refused("{listen: '0.0.0.0:17401'}");
    assert!(
        open.contains("config.yaml:1:15: api.listen: is 0.0.0.0:17401"),
        "{open}"
    );
    assert!(open.contains("set `token_file`"), "{open}");
    let missing = refused("{listen: 'off', token_file: /nowhere/token}");
    assert!(missing.contains("/nowhere/token"), "{missing}");
    let missing = refused("{listen: 'off', socket: /nowhere/api.sock}");
    assert!(
        missing.contains("cannot serve the socket /nowhere/api.sock"),
        "{missing}"
    );
}

#[test]
fn a_second_agent_does_not_take_the_socket_in_the_directory_of_the_service_manager() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let start = || {
        let mut agent = rp();
        agent.env("RUNTIME_DIRECTORY", directory.path());
        LocalAgent::start(&mut agent, &["--watch", "/a"])
    };
    let asked = || {
        let stream = UnixStream::connect(&socket).unwrap();
        exchange(stream, "GET /watch/a HTTP/1.1\r\nHost: rp\r\n", "").status
    };
    let mut first = start();
    first.wait_for_log("ready");
    assert_eq!(asked(), 200);
    let mut second = start();
    second.wait_for_log("ready");
    assert!(second.log().contains("another agent serves the socket"));
    assert_eq!(ask(&second, "GET", "/watch/a", "", "").status, 200);
    drop(second);
    assert_eq!(asked(), 200);
    // A killed agent leaves its socket file. The next agent replaces it.
    first.signal("-KILL");
    first.wait();
    assert!(socket.exists());
    let mut third = start();
    third.wait_for_log("ready");
    assert_eq!(asked(), 200);
}

#[test]
fn a_wrong_token_a_foreign_host_and_a_foreign_origin_are_refused_with_separate_codes() {
    let directory = tempfile::tempdir().unwrap();
    let (config, token) = (
        directory.path().join("config.yaml"),
        directory.path().join("token"),
    );
    std::fs::write(&token, "0123456789abcdef\n").unwrap();
    let socket = directory.path().join("api.sock");
    let api = format!(
        "{{token_file: {}, socket: {}}}",
        token.display(),
        socket.display()
    );
    std::fs::write(&config, format!("api: {api}\n")).unwrap();
    let mut agent = LocalAgent::start(&mut rp(), &["--config", config.to_str().unwrap()]);
    agent.wait_for_log("ready");
    let local = format!("Host: {}\r\n", agent.api);
    let right = "Authorization: Bearer 0123456789abcdef\r\n";
    let wrong = "Authorization: Bearer 0123456789abcdee\r\n";
    let code = |headers: &str, body: &str| {
        let stream = TcpStream::connect(agent.api).unwrap();
        let head = format!("POST /watch/a HTTP/1.1\r\n{headers}");
        let answer = exchange(stream, &head, body);
        if answer.status == 401 {
            assert!(answer.headers.contains("www-authenticate: bearer"));
        }
        problem(&answer)
    };
    let case = |status, code: &str| (status, code.to_owned());
    assert_eq!(code(&local, ""), case(401, "unauthorized"));
    assert_eq!(
        code(&format!("{local}{wrong}"), ""),
        case(401, "unauthorized")
    );
    assert_eq!(code(&format!("{local}{right}"), ""), case(201, ""));
    let rebound = format!("Host: evil.example\r\n{right}");
    assert_eq!(code(&rebound, ""), case(403, "foreign-host"));
    let page = format!("{local}{right}Origin: http://evil.example\r\n");
    assert_eq!(code(&page, ""), case(403, "foreign-origin"));
    let long = "x".repeat(20_000);
    let printed = format!("{local}{right}Content-Length: 20000\r\n");
    assert_eq!(code(&printed, &long), case(413, "body-too-large"));
    let chunked = format!("{local}{right}Transfer-Encoding: chunked\r\n");
    let chunks = format!("4e20\r\n{long}\r\n0\r\n\r\n");
    assert_eq!(code(&chunked, &chunks), case(413, "body-too-large"));

    // A process that can open the socket file needs no token. The metrics listener grants no access
    // to the API.
    let mode = std::fs::metadata(&socket).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
    let stream = UnixStream::connect(&socket).unwrap();
    let answer = exchange(stream, "GET /watch/a HTTP/1.1\r\nHost: rp\r\n", "");
    assert_eq!(answer.status, 200);
    let answer = agent.request("POST", "/watch/b", right);
    assert_eq!(answer.status, 404);

    // An idle connection does not delay the end.
    let _idle = TcpStream::connect(agent.api).unwrap();
    agent.signal("-TERM");
    assert!(agent.wait().success());
    assert!(!socket.exists());
}

/// Returns the commands of a section of `docs/api.md` with the output that the section shows.
fn commands(section: &str) -> Vec<(String, String)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/api.md");
    let page = std::fs::read_to_string(path).unwrap();
    let (_, section) = page.split_once(&format!("\n## {section}\n")).unwrap();
    let (_, block) = section.split_once("```console\n$ ").unwrap();
    let (block, _) = block.split_once("\n```").unwrap();
    let commands = block.split("\n$ ").map(|command| {
        let (command, output) = command.split_once('\n').unwrap_or((command, ""));
        (command.to_owned(), output.to_owned())
    });
    commands.collect()
}

/// Replaces values that differ each time.
fn masked(text: &str) -> String {
    let mut masked = text.to_owned();
    for key in ["\"messages\":", "\"rate_hertz\":", "topic=\"/chatter\"} "] {
        if let Some((before, after)) = masked.split_once(key) {
            let rest = after.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.');
            masked = format!("{before}{key}N{rest}");
        }
    }
    masked
}

#[test]
fn output_in_the_book_is_current() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "0.3"]);
    agent.wait_for_log("ready");
    for (command, expected) in commands("Measure a topic at run time") {
        let here = command.replace("localhost:17401", &agent.api.to_string());
        let here = here.replace("localhost:17400", &agent.address.to_string());
        let deadline = Instant::now() + PATIENCE;
        loop {
            let output = Command::new("sh").args(["-c", &here]).output().unwrap();
            let printed = String::from_utf8(output.stdout).unwrap();
            let counts = !printed.contains("\"messages\":0,") && !printed.ends_with("\"} 0\n");
            if counts && masked(printed.trim_end()) == masked(&expected) {
                break;
            }
            // Only a request without side effects can be repeated until the replay has gone far
            // enough.
            let may_repeat = !command.contains("-X") && Instant::now() < deadline;
            assert!(
                may_repeat,
                "{command}\n{printed}\nbut docs/api.md has\n{expected}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}
