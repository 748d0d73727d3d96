//! `rp fleet` with engines that answer as they should not.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use ros2probe_testing::local_agent::{self, LocalAgent, call_api};
use serde_json::Value;

use crate::rp;

const PATIENCE: Duration = Duration::from_secs(60);

/// Starts an engine that answers each request with these bytes, and then ends the connection.
fn engine(
    answer: impl Fn(&mut dyn std::io::Write) -> std::io::Result<()> + Send + 'static,
) -> SocketAddr {
    engine_that_reads(move |_, out| answer(out))
}

/// The same, with an answer to the begin of the request.
fn engine_that_reads(
    answer: impl Fn(&str, &mut dyn std::io::Write) -> std::io::Result<()> + Send + 'static,
) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            stream
                .set_read_timeout(Some(Duration::from_secs(5)))
                .unwrap();
            let mut request = [0; 4096];
            let length = stream.read(&mut request).unwrap_or(0);
            let request = String::from_utf8_lossy(&request[..length]);
            // `rp` may have closed the connection.
            let _ = answer(&request, &mut stream);
        }
    });
    address
}

fn fleet(arguments: &[&str]) -> (Option<i32>, String) {
    let output = rp().arg("fleet").args(arguments).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    (output.status.code(), text)
}

#[test]
fn an_engine_without_a_usable_answer_is_one_error() {
    let status = engine(|out| {
        let text = "parse error";
        write!(
            out,
            "HTTP/1.1 400 Bad Request\r\nContent-Length: {}\r\n\r\n{text}",
            text.len()
        )
    });
    let page = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>"));
    let broken = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 60\r\n\r\n{{"));
    for (address, expected) in [
        (status, "the engine answers 400 Bad Request: parse error"),
        (page, "the answer is not one of Prometheus's query API"),
        (broken, "cannot receive the answer"),
    ] {
        let url = format!("http://{address}");
        let (code, text) = fleet(&["--engine", &url]);
        assert_eq!(code, Some(1), "{text}");
        assert!(
            text.contains(expected) && text.lines().count() == 1,
            "{text}"
        );
        assert!(text.contains(&url), "{text}");
    }
    let nowhere = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let (code, text) = fleet(&["--engine", &format!("http://{nowhere}")]);
    assert_eq!(code, Some(1));
    assert!(text.contains("the connection failed"), "{text}");
}

#[test]
fn an_engine_without_encryption_needs_no_certificate_authorities() {
    let directory = tempfile::tempdir().unwrap();
    let authorities = directory.path().join("none.pem");
    std::fs::write(&authorities, "").unwrap();
    let page = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>"));
    for (url, expected) in [
        (
            format!("http://{page}"),
            "the answer is not one of Prometheus's query API",
        ),
        (format!("https://{page}"), "cannot prepare the request"),
    ] {
        let mut command = rp();
        command.env("SSL_CERT_FILE", &authorities);
        command.env_remove("SSL_CERT_DIR");
        let output = command.args(["fleet", "--engine", &url]).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.contains(expected), "{url}: {text}");
    }
}

#[test]
fn an_answer_beyond_the_cap_is_refused() {
    let endless = engine(|out| {
        write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 9000000000\r\n\r\n")?;
        loop {
            out.write_all(&[b' '; 1 << 20])?;
        }
    });
    let (code, text) = fleet(&["--engine", &format!("http://{endless}")]);
    assert_eq!(code, Some(1));
    assert!(
        text.contains("the answer is longer than 67108864 bytes"),
        "{text}"
    );
}

#[test]
fn an_address_and_a_token_are_checked_before_a_request() {
    let (code, text) = fleet(&[]);
    assert_eq!(code, Some(1));
    assert!(
        text.contains("pass --engine URL, or set ROS2PROBE_ENGINE"),
        "{text}"
    );
    let (code, text) = fleet(&["--engine", "prometheus:9090"]);
    assert_eq!(code, Some(1));
    assert!(
        text.contains("`prometheus:9090` is not the URL of an engine"),
        "{text}"
    );
    let directory = tempfile::tempdir().unwrap();
    let token = directory.path().join("token");
    std::fs::write(&token, "x".repeat((64 << 10) + 1)).unwrap();
    let token = token.to_str().unwrap();
    let (code, text) = fleet(&["--engine", "http://127.0.0.1:9", "--token-file", token]);
    assert_eq!(code, Some(1));
    assert!(text.contains(&format!("cannot read {token}")), "{text}");
}

/// `rp fleet --listen`, with the address of its page.
struct Page {
    child: Child,
    address: SocketAddr,
}

impl Page {
    fn start(engine: &str) -> Self {
        let mut child = rp()
            .args(["fleet", "--engine", engine, "--listen", "127.0.0.1:0"])
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let mut errors = BufReader::new(child.stderr.take().unwrap());
        errors.read_line(&mut line).unwrap();
        let address = line.split("http://").nth(1).unwrap();
        let address = address.split('/').next().unwrap().parse().unwrap();
        Self { child, address }
    }

    /// Returns the answer to a request with this line and these headers.
    fn request(&self, text: &str) -> String {
        let mut stream = TcpStream::connect(self.address).unwrap();
        write!(stream, "{text}\r\n\r\n").unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    fn get(&self, path: &str) -> String {
        self.request(&format!("GET {path} HTTP/1.1\r\nHost: localhost"))
    }

    fn waits_for(&self, path: &str, part: &str) {
        let begun = Instant::now();
        loop {
            let answer = self.get(path);
            if answer.contains(part) {
                return;
            }
            assert!(begun.elapsed() < PATIENCE, "{part}: {answer}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

/// An engine that answers each query with an empty vector.
fn empty() -> SocketAddr {
    engine(|out| {
        let text = r#"{"status":"success","data":{"resultType":"vector","result":[]}}"#;
        let length = text.len();
        write!(
            out,
            "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{text}"
        )
    })
}

#[test]
fn the_page_shows_what_the_engine_answers_and_why_it_does_not() {
    let page = Page::start(&format!("http://{}", empty()));
    page.waits_for("/", "No robot delivers to the engine.");
    let answer = page.get("/?paused");
    for part in [
        "HTTP/1.1 200 OK",
        "cache-control: no-store",
        "x-content-type-options: nosniff",
        "default-src 'none'",
        "The page is paused.",
    ] {
        assert!(answer.contains(part), "{part}: {answer}");
    }
    page.waits_for("/fleet.json", "\"robots\": []");
    // An engine that does not run.
    let nowhere = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let page = Page::start(&format!("http://{nowhere}"));
    page.waits_for("/", "the connection failed");
    let answer = page.get("/fleet.json");
    assert!(answer.starts_with("HTTP/1.1 503 "), "{answer}");
}

#[test]
fn the_page_answers_only_requests_for_this_host() {
    let page = Page::start(&format!("http://{}", empty()));
    for (request, status) in [
        ("GET / HTTP/1.1\r\nHost: evil.example", "403"),
        ("GET / HTTP/1.1", "403"),
        (
            "POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0",
            "405",
        ),
        ("GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:80", "404"),
        ("nonsense", "400"),
    ] {
        let answer = page.request(request);
        let expected = format!("HTTP/1.1 {status} ");
        assert!(answer.starts_with(&expected), "{request}: {answer}");
    }
    let listen = |address: &str| fleet(&["--engine", "http://127.0.0.1:9", "--listen", address]);
    let (code, text) = listen("0.0.0.0:0");
    assert_eq!(code, Some(1));
    assert!(
        text.contains("0.0.0.0:0 is not a loopback address"),
        "{text}"
    );
    let (code, text) = listen(&page.address.to_string());
    assert_eq!(code, Some(1));
    assert!(text.contains("cannot listen on 127.0.0.1:"), "{text}");
    for wrong in ["http://robot/", "{robot}"] {
        let listen = ["--engine", "http://127.0.0.1:9", "--listen", "127.0.0.1:0"];
        let (code, text) = fleet(&[&listen[..], &["--link", wrong]].concat());
        assert_eq!(code, Some(2));
        assert!(text.contains("is no URL with {robot}"), "{text}");
    }
}

#[test]
fn connections_beyond_the_cap_wait_until_silent_ones_are_closed() {
    let page = Page::start(&format!("http://{}", empty()));
    let begun = Instant::now();
    let silent: Vec<_> = (0..64)
        .map(|_| TcpStream::connect(page.address).unwrap())
        .collect();
    // The silent ones are accepted first.
    let answer = page.get("/");
    assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
    assert!(begun.elapsed() > Duration::from_secs(1), "it did not wait");
    drop(silent);
}

/// Starts an agent with this section of the configuration.
fn agent(directory: &std::path::Path, fleet: &str) -> LocalAgent {
    let configuration = directory.join("ros2probe.yaml");
    std::fs::write(&configuration, fleet).unwrap();
    let configuration = configuration.to_str().unwrap();
    LocalAgent::start(&mut rp(), &["--config", configuration, "--speed", "max"])
}

/// Returns the answer of `GET /fleet` once it is as wanted.
fn fleet_of(agent: &LocalAgent, wanted: impl Fn(&Value) -> bool) -> Value {
    let begun = Instant::now();
    loop {
        let (status, answer) = call_api(agent.api, "GET", "/fleet", "");
        assert_eq!(status, 200, "{answer}");
        if wanted(&answer) {
            return answer;
        }
        assert!(begun.elapsed() < PATIENCE, "{answer}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn an_agent_queries_the_engine_only_on_demand() {
    let directory = tempfile::tempdir().unwrap();
    let count = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&count);
    let counting = engine(move |out| {
        counted.fetch_add(1, Ordering::Relaxed);
        let text = r#"{"status":"success","data":{"resultType":"vector","result":[]}}"#;
        let length = text.len();
        write!(
            out,
            "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{text}"
        )
    });
    let yaml = format!("fleet: {{engine: 'http://{counting}'}}\n");
    let mut agent = agent(directory.path(), &yaml);
    agent.wait_for_log("the capture has ended");
    let (status, _) = call_api(agent.api, "GET", "/health", "");
    assert_eq!((status, count.load(Ordering::Relaxed)), (200, 0));
    let answer = fleet_of(&agent, |answer| answer["at"].is_number());
    assert_eq!(answer["robots"], Value::Array(Vec::new()));
    assert_eq!(answer["problem"], Value::Null);
    assert!(count.load(Ordering::Relaxed) >= 10, "one query each");
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

#[test]
fn a_file_for_the_fleet_applies_instead_of_the_configured_section() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = directory.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let configuration = file("ros2probe.yaml", "fleet: {engine: 'http://127.0.0.1:9'}\n");
    let named = file(
        "fleet.yaml",
        &format!("fleet: {{engine: 'http://{}'}}\n", empty()),
    );
    let (configuration, named) = (configuration.as_str(), named.as_str());
    for more in [&[][..], &["--config", configuration][..]] {
        let arguments = [&["--fleet", named, "--speed", "max"][..], more].concat();
        let agent = LocalAgent::start(&mut rp(), &arguments);
        let answer = fleet_of(&agent, |answer| {
            answer["at"].is_number() || answer["problem"].is_string()
        });
        assert_eq!(answer["problem"], Value::Null, "{more:?}");
    }
    // A file without an engine would start an agent without the requested view.
    let nothing = file("nothing.yaml", "fleet: {job: robots}\n");
    let missing = directory.path().join("missing.yaml");
    for (path, expected) in [
        (&*nothing, "has no `fleet.engine`"),
        (missing.to_str().unwrap(), "cannot read the configuration"),
    ] {
        let mut command = rp();
        command.args(["run", "--metrics", "off", "--api", "off", "--fleet", path]);
        command.arg("--replay").arg(local_agent::capture());
        let output = command.output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(78), "{text}");
        assert!(text.contains(expected) && text.contains(path), "{text}");
    }
}

#[test]
fn an_agent_reports_why_the_engine_does_not_answer_or_that_it_has_none() {
    let directory = tempfile::tempdir().unwrap();
    let nowhere = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let yaml = format!("fleet: {{engine: 'http://{nowhere}'}}\n");
    let with_engine = agent(directory.path(), &yaml);
    let answer = fleet_of(&with_engine, |answer| answer["problem"].is_string());
    let problem = answer["problem"].as_str().unwrap();
    assert!(problem.contains("the connection failed"), "{problem}");
    assert_eq!(answer["at"], Value::Null);
    let without = agent(directory.path(), "{}\n");
    let (status, answer) = call_api(without.api, "GET", "/fleet", "");
    let kind = answer["type"].as_str().unwrap();
    assert!(status == 404 && kind.ends_with("no-fleet"), "{answer}");
}

#[test]
fn an_agent_refuses_an_answer_beyond_the_cap() {
    let directory = tempfile::tempdir().unwrap();
    // Blanks before the answer are valid JSON.
    let long = engine(|out| {
        let text = r#"{"status":"success","data":{"resultType":"vector","result":[]}}"#;
        let length = (4 << 20) + 1;
        write!(out, "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n")?;
        out.write_all(&vec![b' '; length - text.len()])?;
        out.write_all(text.as_bytes())
    });
    let yaml = format!("fleet: {{engine: 'http://{long}'}}\n");
    let agent = agent(directory.path(), &yaml);
    let answer = fleet_of(&agent, |answer| answer["problem"].is_string());
    let problem = answer["problem"].as_str().unwrap();
    assert!(problem.contains("longer than 4194304 bytes"), "{problem}");
}

#[test]
fn an_agent_refuses_answers_with_series_beyond_the_cap_in_all() {
    let directory = tempfile::tempdir().unwrap();
    // Each answer alone is below both caps.
    let many = engine(|out| {
        let series = vec![r#"{"metric":{},"value":[0,"0"]}"#; (4 << 20) / 40 / 2 + 1].join(",");
        let text = format!(
            r#"{{"status":"success","data":{{"resultType":"vector","result":[{series}]}}}}"#
        );
        write!(
            out,
            "HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{text}",
            text.len()
        )
    });
    let yaml = format!("fleet: {{engine: 'http://{many}'}}\n");
    let agent = agent(directory.path(), &yaml);
    let answer = fleet_of(&agent, |answer| answer["problem"].is_string());
    let problem = answer["problem"].as_str().unwrap();
    assert!(problem.contains("more than 104857 series"), "{problem}");
}

#[test]
fn a_token_of_the_engine_that_cannot_be_read_ends_the_start() {
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let token = directory.path().join("token");
    let yaml = format!(
        "fleet: {{engine: 'http://127.0.0.1:9', token_file: {}}}\n",
        token.display()
    );
    std::fs::write(&configuration, yaml).unwrap();
    let mut command = rp();
    command.args(["run", "--metrics", "off", "--api", "off", "--config"]);
    command.arg(&configuration).arg("--replay");
    let output = command.arg(local_agent::capture()).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success(), "{text}");
    assert!(text.contains("cannot use `fleet.token_file`"), "{text}");
    assert!(
        text.contains(&format!("cannot read {}", token.display())),
        "{text}"
    );
}

#[test]
fn a_replaced_token_of_the_engine_needs_no_restart() {
    let guarded = engine_that_reads(|request, out| {
        let (status, text) = match request.contains("authorization: Bearer second\r\n") {
            true => (
                "200 OK",
                r#"{"status":"success","data":{"resultType":"vector","result":[]}}"#,
            ),
            false => ("401 Unauthorized", "unknown token"),
        };
        let length = text.len();
        write!(
            out,
            "HTTP/1.1 {status}\r\nContent-Length: {length}\r\n\r\n{text}"
        )
    });
    let directory = tempfile::tempdir().unwrap();
    let token = directory.path().join("token");
    std::fs::write(&token, "first\n").unwrap();
    let yaml = format!(
        "fleet: {{engine: 'http://{guarded}', token_file: {}}}\n",
        token.display()
    );
    let agent = agent(directory.path(), &yaml);
    let problem_with = |part: &str| {
        let answer = fleet_of(&agent, |answer| {
            let problem = answer["problem"].as_str();
            problem.is_some_and(|problem| problem.contains(part))
        });
        assert_eq!(answer["at"], Value::Null);
    };
    problem_with("401 Unauthorized: unknown token");
    std::fs::remove_file(&token).unwrap();
    problem_with("cannot read ");
    std::fs::write(&token, "second\n").unwrap();
    let answer = fleet_of(&agent, |answer| answer["at"].is_number());
    assert_eq!(answer["problem"], Value::Null);
}
