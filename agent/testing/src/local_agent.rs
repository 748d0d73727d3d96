//! The real binary replays a capture on free ports of this host, without privileges or namespaces.
use std::io::{BufRead as _, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use crate::repository;
use serde_json::Value;

/// Maximum wait for a log line, a response, a metric or the end.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// Returns a small capture of the repository.
pub fn capture() -> PathBuf {
    let data = repository("wire/tests/data");
    data.join("cyclonedds-samehost-any.pcap.gz")
}

/// Returns a command for `program` with a clean environment. A test names `rp` by
/// `env!("CARGO_BIN_EXE_rp")`, which cargo sets for integration tests only.
pub fn rp(program: &str) -> Command {
    let mut command = Command::new(program);
    command
        .env_remove("RUST_LOG")
        .env_remove("NOTIFY_SOCKET")
        .env_remove("RUNTIME_DIRECTORY")
        .env("RUST_BACKTRACE", "1");
    command
}

/// A running agent; dropping the value kills it.
pub struct LocalAgent {
    child: Child,
    log: Receiver<String>,
    seen: Vec<String>,
    /// Address of the metrics listener.
    pub address: SocketAddr,
    /// Address of the control API.
    pub api: SocketAddr,
}

/// An HTTP response.
pub struct Answer {
    pub status: u16,
    pub headers: String,
    pub body: String,
}

impl LocalAgent {
    /// Starts `rp run` on [`capture`], with further arguments, and waits for its listeners.
    pub fn start(rp: &mut Command, arguments: &[&str]) -> Self {
        Self::replay(rp, &capture(), arguments)
    }

    /// Starts as [`Self::start`] does, on another capture.
    pub fn replay(rp: &mut Command, capture: &Path, arguments: &[&str]) -> Self {
        // Agents of other tests use the default port.
        if !arguments.contains(&"--foxglove") {
            rp.args(["run", "--foxglove", "off"]);
        } else {
            rp.arg("run");
        }
        let mut child = rp
            .args(["--metrics", "127.0.0.1:0", "--api", "127.0.0.1:0"])
            // Each test treats this host as its own.
            .args(["--api-loopback", "all", "--replay"])
            .arg(capture)
            .args(arguments)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        let (lines, log) = channel();
        std::thread::spawn(move || {
            stderr
                .lines()
                .map_while(Result::ok)
                .all(|line| lines.send(line).is_ok())
        });
        let address = SocketAddr::from(([127, 0, 0, 1], 0));
        let mut agent = Self {
            child,
            log,
            seen: Vec::new(),
            address,
            api: address,
        };
        agent.address = agent.wait_for_address("serving metrics");
        agent.api = agent.wait_for_address("serving the control API");
        agent
    }

    /// Waits for the line of a listener and returns its address.
    pub fn wait_for_address(&mut self, text: &str) -> SocketAddr {
        let line = self.wait_for_log(text);
        let address = line.split("address=").nth(1);
        let address = address.and_then(|rest| rest.split(' ').next());
        address.unwrap().trim_matches('"').parse().unwrap()
    }

    /// Returns its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the next line of the log that contains `text`.
    pub fn wait_for_log(&mut self, text: &str) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self.log.recv_timeout(left).unwrap_or_else(|error| {
                panic!(
                    "no `{text}` in the log ({error}):\n{}",
                    self.seen.join("\n")
                )
            });
            self.seen.push(line.clone());
            if line.contains(text) {
                return line;
            }
        }
    }

    /// Returns the log so far; the whole log after the agent has ended.
    pub fn log(&mut self) -> String {
        if matches!(self.child.try_wait(), Ok(Some(_))) {
            self.seen.extend(self.log.iter());
        }
        self.seen.extend(self.log.try_iter());
        self.seen.join("\n")
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, name: &str) {
        let status = Command::new("kill")
            .args([name, &self.child.id().to_string()])
            .status()
            .unwrap();
        assert!(status.success());
    }

    pub fn get(&self, path: &str) -> Answer {
        self.request("GET", path, "")
    }

    pub fn request(&self, method: &str, path: &str, headers: &str) -> Answer {
        request(self.address, method, path, headers)
    }

    /// Scrapes until `wanted` accepts the value of a series; panics with the last page otherwise.
    pub fn wait_for_metric(&self, series: &str, wanted: impl Fn(f64) -> bool) -> f64 {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let page = self.get("/metrics").body;
            match metric(&page, series) {
                Some(value) if wanted(value) => return value,
                _ if Instant::now() > deadline => panic!("no such {series} in\n{page}"),
                _ => std::thread::sleep(Duration::from_millis(50)),
            }
        }
    }

    /// Waits for the end of the process.
    pub fn wait(&mut self) -> ExitStatus {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(Instant::now() < deadline, "still running:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for LocalAgent {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends one request on a new connection.
pub fn request(address: SocketAddr, method: &str, path: &str, headers: &str) -> Answer {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\n{headers}");
    exchange(stream, &head, "")
}

/// Sends a request to the control API; returns the status, and the body's JSON or null if it is
/// empty.
pub fn call_api(api: SocketAddr, method: &str, path: &str, body: &str) -> (u16, Value) {
    let stream = TcpStream::connect(api).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {api}\r\nContent-Type: application/json\r\n\
         Content-Length: {length}\r\n"
    );
    let Answer { status, body, .. } = exchange(stream, &head, body);
    if body.is_empty() {
        return (status, Value::Null);
    }
    let body = serde_json::from_str(&body).unwrap_or_else(|error| panic!("{error}: {body}"));
    (status, body)
}

/// Sends a request with this head, followed by `Connection: close`, and this body. Returns the
/// response.
pub fn exchange(mut stream: impl Read + Write, head: &str, body: &str) -> Answer {
    let request = format!("{head}Connection: close\r\n\r\n{body}");
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (headers, body) = answer.split_once("\r\n\r\n").unwrap();
    let status = headers.split(' ').nth(1).unwrap().parse().unwrap();
    Answer {
        status,
        headers: headers.to_lowercase(),
        body: body.to_owned(),
    }
}

/// Returns the value of a series, named as on the page.
pub fn metric(page: &str, series: &str) -> Option<f64> {
    page.lines()
        .find_map(|line| line.strip_prefix(series)?.strip_prefix(' ')?.parse().ok())
}

/// Returns the output of promtool's check of a page in classic format.
pub fn promtool(page: &str) -> String {
    let mut promtool = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("promtool: {error}; `apt-get install prometheus`"));
    promtool
        .stdin
        .take()
        .unwrap()
        .write_all(page.as_bytes())
        .unwrap();
    let output = promtool.wait_with_output().unwrap();
    let printed = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    let end = if output.status.success() {
        ""
    } else {
        "(failed)"
    };
    format!("{printed}{end}")
}
