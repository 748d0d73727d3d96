//! Hostile clients. Each kind repeats its action until it is ended.

use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use ros2probe_capture::netns;

use super::{API_PORT, METRICS_PORT};
use ros2probe_testing::harness::network::Namespace;

/// Maximum time of an answer or of a refusal.
const PATIENCE: Duration = Duration::from_secs(60);

/// The agent's addresses, and the token.
#[derive(Clone)]
pub(super) struct AgentAddresses {
    network: PathBuf,
    address: Ipv4Addr,
    pub(super) socket: PathBuf,
    token: &'static str,
}

/// Threads of clients.
pub(super) struct Clients {
    stop: Arc<AtomicBool>,
    threads: Vec<(JoinHandle<()>, Arc<AtomicU64>, &'static str)>,
}

/// Sends requests repeatedly, and keeps the longest time until an answer.
pub(super) struct RequestLoop {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Answers>,
    what: &'static str,
}

#[derive(Default)]
pub(super) struct Answers {
    pub(super) count: u64,
    pub(super) longest: Duration,
    /// Answers with another status than 200.
    pub(super) refused: Vec<String>,
}

impl AgentAddresses {
    /// Returns the addresses of an agent on a host. Clients connect on that host.
    pub(super) fn new(host: &Namespace, socket: &Path, token: &'static str) -> AgentAddresses {
        AgentAddresses {
            network: host.network(),
            address: host.address(),
            socket: socket.to_owned(),
            token,
        }
    }

    pub(super) fn metrics(&self) -> Result<TcpStream> {
        self.connect(Ipv4Addr::LOCALHOST, METRICS_PORT)
    }

    pub(super) fn api(&self) -> Result<TcpStream> {
        self.connect(self.address, API_PORT)
    }

    fn connect(&self, address: Ipv4Addr, port: u16) -> Result<TcpStream> {
        let stream = netns::within(&self.network, || TcpStream::connect((address, port)))??;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        Ok(stream)
    }

    /// Returns a request to the API with the token.
    pub(super) fn request(&self, path: &str) -> String {
        let AgentAddresses { address, token, .. } = self;
        format!(
            "GET {path} HTTP/1.1\r\nHost: {address}:{API_PORT}\r\nAuthorization: Bearer {token}\r\n\r\n"
        )
    }
}

impl Clients {
    /// Starts some clients of every kind.
    pub(super) fn start(doors: &AgentAddresses) -> Clients {
        let mut clients = Clients {
            stop: Arc::default(),
            threads: Vec::new(),
        };
        clients.add("unfinished requests", doors, unfinished());
        clients.add("idle connections", doors, idle());
        clients.add("slow readers", doors, slow());
        clients.add("compressed pages", doors, compressed);
        clients.add("costly subscriptions", doors, costly_subscription);
        clients.add("costly watches", doors, costly_watch());
        for _ in 0..2 {
            clients.add("requests without the token", doors, without_token);
        }
        clients
    }

    /// Ends the clients, and returns how often each kind repeated its action.
    pub(super) fn end(self) -> Result<String> {
        self.stop.store(true, Ordering::Relaxed);
        let mut done = Vec::new();
        for (thread, count, what) in self.threads {
            thread.join().map_err(|_| anyhow!("{what} died"))?;
            done.push(format!("{} {what}", count.load(Ordering::Relaxed)));
        }
        Ok(done.join(", "))
    }

    fn add(
        &mut self,
        what: &'static str,
        doors: &AgentAddresses,
        mut act: impl FnMut(&AgentAddresses) -> Result<()> + Send + 'static,
    ) {
        let (doors, stop) = (doors.clone(), Arc::clone(&self.stop));
        let count = Arc::<AtomicU64>::default();
        let counter = Arc::clone(&count);
        let thread = std::thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                // A client continues after a refused or closed connection.
                if act(&doors).is_ok() {
                    counter.fetch_add(1, Ordering::Relaxed);
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        self.threads.push((thread, count, what));
    }
}

impl RequestLoop {
    /// Sends a request once per `period`, each time on a new connection.
    pub(super) fn start(
        what: &'static str,
        period: Duration,
        mut ask: impl FnMut() -> Result<String> + Send + 'static,
    ) -> RequestLoop {
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let mut answers = Answers::default();
            while !stopped.load(Ordering::Relaxed) {
                let began = Instant::now();
                let answer = ask().unwrap_or_else(|error| format!("{error:#}"));
                answers.count += 1;
                answers.longest = answers.longest.max(began.elapsed());
                if !answer.starts_with("HTTP/1.1 200 ") {
                    let head = answer.chars().take(600).collect();
                    answers.refused.push(head);
                }
                std::thread::sleep(period.saturating_sub(began.elapsed()));
            }
            answers
        });
        RequestLoop { stop, thread, what }
    }

    pub(super) fn end(self) -> Result<(&'static str, Answers)> {
        self.stop.store(true, Ordering::Relaxed);
        let answers = self.thread.join();
        Ok((
            self.what,
            answers.map_err(|_| anyhow!("{} died", self.what))?,
        ))
    }
}

/// Sends a request that closes the connection, and reads the answer.
pub(super) fn answer(
    mut stream: impl std::io::Read + std::io::Write,
    head: &str,
) -> Result<String> {
    let head = head.trim_end();
    stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes())?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    Ok(String::from_utf8_lossy(&answer).into_owned())
}

/// Sends heads of 38 KB that never end, on as many connections as both listeners accept.
fn unfinished() -> impl FnMut(&AgentAddresses) -> Result<()> {
    let field = format!("x: {}\r\n", "x".repeat(9_500));
    let (mut open, mut number) = (Vec::new(), 0_usize);
    move |doors| {
        number += 1;
        if open.len() > 96 {
            open.remove(0);
        }
        let mut stream = match number % 2 {
            0 => doors.metrics()?,
            _ => doors.api()?,
        };
        stream.set_write_timeout(Some(Duration::from_millis(50)))?;
        let head = format!(
            "GET /topics HTTP/1.1\r\nHost: localhost\r\n{}",
            field.repeat(4)
        );
        stream.write_all(head.as_bytes())?;
        open.push(stream);
        Ok(())
    }
}

/// Sends one request per connection, and keeps the connection open.
fn idle() -> impl FnMut(&AgentAddresses) -> Result<()> {
    let mut open = Vec::new();
    move |doors| {
        if open.len() > 40 {
            open.remove(0);
            std::thread::sleep(Duration::from_millis(50));
        }
        let mut stream = doors.metrics()?;
        stream.write_all(b"HEAD /healthz HTTP/1.1\r\nHost: localhost:17400\r\n\r\n")?;
        stream.read_exact(&mut [0; 12])?;
        open.push(stream);
        Ok(())
    }
}

/// Reads 5 KB of a page per second.
fn slow() -> impl FnMut(&AgentAddresses) -> Result<()> {
    let mut open = Vec::new();
    move |doors| {
        while open.len() < 4 {
            let mut stream = doors.metrics()?;
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost:17400\r\n\r\n")?;
            open.push(stream);
        }
        std::thread::sleep(Duration::from_millis(200));
        open.retain_mut(|stream| matches!(stream.read(&mut [0; 1024]), Ok(1..)));
        Ok(())
    }
}

fn compressed(doors: &AgentAddresses) -> Result<()> {
    let head = "GET /metrics HTTP/1.1\r\nHost: localhost:17400\r\nAccept-Encoding: gzip";
    answer(doors.metrics()?, head)?;
    std::thread::sleep(Duration::from_millis(200));
    Ok(())
}

/// Subscribes to as many globs as fit, each with the maximum number of stars.
fn costly_subscription(doors: &AgentAddresses) -> Result<()> {
    let glob = format!("/{}*", "*a".repeat(15));
    let list = vec![glob; 250].join(",");
    let mut stream = UnixStream::connect(&doors.socket)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let head = format!("GET /samples?topic={list}&hidden=true HTTP/1.1\r\nHost: rp\r\n\r\n");
    stream.write_all(head.as_bytes())?;
    stream.read_exact(&mut [0; 12])?;
    std::thread::sleep(Duration::from_millis(500));
    Ok(())
}

/// Adds a watch with a costly glob each time, and never removes it.
fn costly_watch() -> impl FnMut(&AgentAddresses) -> Result<()> {
    let mut number = 0;
    move |doors| {
        number += 1;
        let glob = format!("{}{number}", "*a".repeat(15));
        let stream = UnixStream::connect(&doors.socket)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        let head = format!("POST /watch/{glob} HTTP/1.1\r\nHost: rp\r\nContent-Length: 0");
        answer(stream, &head)?;
        std::thread::sleep(Duration::from_millis(50));
        Ok(())
    }
}

fn without_token(doors: &AgentAddresses) -> Result<()> {
    for _ in 0..10 {
        let head = format!("GET /topics HTTP/1.1\r\nHost: {}:{API_PORT}", doors.address);
        answer(doors.api()?, &head)?;
    }
    Ok(())
}
