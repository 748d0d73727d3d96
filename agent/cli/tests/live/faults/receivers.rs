//! Receivers that do not exist, hang, or send garbage; scrapers that do not read.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow, ensure};

use super::{API_PORT, Counted, FaultBench, METRICS_PORT};
use ros2probe_capture::netns;
use ros2probe_testing::harness::agent::ON_THE_WIRE;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::soak::{long, outcome};
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_until;

/// Maximum number of bytes that all of them together may add to the agent's memory.
const GROWTH: u64 = 24 << 20;
/// Number of slow scrapers, fewer than the listeners accept.
const SLOW: usize = 20;
/// Number of clients, more than the listeners accept. The kernel's queue has space for the others.
const CROWD: usize = 140;
/// Maximum number of additional descriptors: those of clients, and some of the agent's own.
const PLACES: usize = 32 + 64 + 8;

/// A receiver that listens where the agent exports to, and misbehaves.
struct Receiver {
    address: SocketAddr,
    met: Arc<AtomicUsize>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Receiver {
    /// Accepts connections and sends `answer` to each repeatedly, or nothing.
    fn start(host: &Namespace, answer: Option<Vec<u8>>) -> Result<Receiver> {
        let listener = netns::within(&host.network(), || TcpListener::bind("127.0.0.1:0"))??;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (met, stop) = (Arc::<AtomicUsize>::default(), Arc::<AtomicBool>::default());
        let (counter, stopped) = (Arc::clone(&met), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            let mut held = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                let Ok((mut stream, _)) = listener.accept() else {
                    std::thread::sleep(Duration::from_millis(20));
                    continue;
                };
                counter.fetch_add(1, Ordering::Relaxed);
                match &answer {
                    Some(answer) => {
                        // The client may have disconnected.
                        let _ = stream.set_nonblocking(false);
                        let _ = stream.read(&mut [0; 64]);
                        let _ = stream.write_all(answer);
                    }
                    None => held.push(stream),
                }
            }
        });
        Ok(Receiver {
            address,
            met,
            stop,
            thread,
        })
    }

    fn end(self) -> Result<usize> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread
            .join()
            .map_err(|_| anyhow!("the receiver died"))?;
        Ok(self.met.load(Ordering::Relaxed))
    }
}

#[test]
fn misbehaving_receivers_and_scrapers_are_counted_and_cause_no_loss() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let hanging = Receiver::start(&link.robot, None)?;
    let noise: Vec<u8> = (0..4096_u32).map(|it| (it * 167 % 251) as u8).collect();
    let babbling = Receiver::start(&link.robot, Some(noise))?;
    let configuration =
        format!("watch: [/**]\nlog: warn\notlp: {{interval_s: 1, timeout_s: 1}}\n{ON_THE_WIRE}");
    let variable =
        |signal: &str, to: String| format!("OTEL_EXPORTER_OTLP_{signal}_ENDPOINT=http://{to}");
    let variables = [
        variable("METRICS", hanging.address.to_string()),
        variable("LOGS", babbling.address.to_string()),
        // No name server is reachable from that host.
        variable("TRACES", "collector.example.com:4317".to_owned()),
    ];
    let mut words = vec!["env"];
    words.extend(variables.iter().map(String::as_str));
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &words)?;
    let mut counted = Counted::start(&link, 1, "talker")?;
    scene.node_is_known("/talker")?;
    let before = Usage::of(scene.pid())?;

    let slow = scrapers(&scene)?;
    let rounds = if long().is_some() { 600 } else { 6 };
    let mut most = 0;
    for _ in 0..rounds {
        counted.send_samples(320, 200)?;
        most = most.max(Usage::of(scene.pid())?.memory.unreclaimable);
    }
    counted.check(&scene.agent)?;
    let growth = most.saturating_sub(before.memory.unreclaimable);
    ensure!(growth < GROWTH, "{growth} bytes more");
    let page = scene.agent.scrape_until("all failures", |page| {
        ["metrics", "events"].iter().all(|signal| {
            let labels = [("signal", *signal)];
            let undelivered = ["retried", "failed"].iter().map(|outcome| {
                page.sum(
                    "ros2probe_otlp_exports_total",
                    &[labels[0], ("outcome", *outcome)],
                )
            });
            undelivered.sum::<f64>() >= 2.0
        })
    })?;
    let delivered = page.sum("ros2probe_otlp_exports_total", &[("outcome", "delivered")]);
    ensure!(delivered == 0.0, "{delivered} were taken by nobody");
    let printed = scene.log();
    let lines = printed.matches("refuses the export").count();
    ensure!((2..=3).contains(&lines), "{printed}");
    let took = scene.end()?;
    drop(slow);
    let connections = (hanging.end()?, babbling.end()?);
    outcome(
        "OTLP endpoints that never answer, answer garbage, have a name that does not resolve; scrapers and \
         clients of the API that do not finish their requests or do not read",
        &format!(
            "every message counted, {} KiB more memory, {} and {} connections, one line each in the log; ended \
             in {took:?} with all of them open",
            growth >> 10,
            connections.0,
            connections.1
        ),
    )
}

#[test]
fn many_scrapers_and_clients_are_bounded_and_leave_no_descriptor_open() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = format!("watch: [/**]\n{ON_THE_WIRE}");
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &[])?;
    let mut counted = Counted::start(&link, 1, "talker")?;
    scene.node_is_known("/talker")?;
    let before = Usage::of(scene.pid())?;
    let open =
        || -> Result<usize> { Ok(std::fs::read_dir(format!("/proc/{}/fd", scene.pid()))?.count()) };
    let descriptors = open()?;
    let mut crowd = Vec::new();
    for _ in 0..CROWD {
        for (port, request) in [
            (METRICS_PORT, "GET /metrics HTTP/1.1\r\nHo"),
            (API_PORT, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n"),
        ] {
            let mut stream = scene.connect(port)?;
            // The agent may answer and close a connection beyond its limit.
            let _ = stream.write_all(request.as_bytes());
            crowd.push(stream);
        }
    }
    counted.send_samples(320, 500)?;
    let (most, after) = (open()?, Usage::of(scene.pid())?);
    ensure!(
        most <= descriptors + PLACES,
        "{descriptors} descriptors became {most}"
    );
    ensure!(
        after.memory.unreclaimable < before.memory.unreclaimable + GROWTH,
        "{before:?} became {after:?}"
    );

    // A second agent finds its port in use.
    let [program, words @ ..] = &link.robot.outside();
    let second = Command::new(program)
        .args(words)
        .args([env!("CARGO_BIN_EXE_rp"), "run", "--config"])
        .arg(directory.path().join("ros2probe.yaml"))
        .output()?;
    let printed = String::from_utf8_lossy(&second.stderr);
    ensure!(
        second.status.code() == Some(1) && printed.contains("cannot listen on 127.0.0.1:17400"),
        "{:?} {printed}",
        second.status
    );

    drop(crowd);
    counted.check(&scene.agent)?;
    let (status, health) = scene.ask("GET", "/health", "")?;
    ensure!(status == 200, "{status} {health}");
    wait_until("descriptors closed", || Ok(open()? <= descriptors + 4))?;
    let took = scene.end()?;
    outcome(
        &format!(
            "{CROWD} scrapers that never finish a request and {CROWD} streams of events at once; a second agent"
        ),
        &format!(
            "{} connections held, {} KiB more memory, every message counted, all answered again when they go; the \
             second agent says which port is taken; ended in {took:?}",
            most - descriptors,
            after
                .memory
                .unreclaimable
                .saturating_sub(before.memory.unreclaimable)
                >> 10
        ),
    )
}

/// Opens slow connections of every kind.
fn scrapers(scene: &FaultBench<'_>) -> Result<Vec<TcpStream>> {
    let mut all = Vec::new();
    for number in 0..SLOW {
        for port in [METRICS_PORT, API_PORT] {
            let mut stream = scene.connect(port)?;
            let request = match number % 4 {
                // Sends half a request, as if a cable had been pulled.
                0 => "GET /metrics HTTP/1.1\r\nHo".to_owned(),
                // Sends nothing.
                1 => String::new(),
                // Sends many requests and reads no answer.
                2 => "GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(100),
                // Opens a stream that is not read.
                _ => "GET /events?after=0 HTTP/1.1\r\nHost: localhost\r\n\r\n".to_owned(),
            };
            stream.write_all(request.as_bytes())?;
            all.push(stream);
        }
    }
    Ok(all)
}
