//! A real Prometheus scrapes the agent beside the demo robot. PromQL returns the rates of the
//! robot's publishers, and `promtool` accepts the page.

use std::io::Write as _;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE};
use ros2probe_testing::harness::event_log::EventLog;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, robot};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::prometheus::{INSTALL, Prometheus};

/// Window of the rates.
const WINDOW: Duration = Duration::from_secs(6);
const PATIENCE: Duration = Duration::from_secs(80);

#[test]
fn prometheus_returns_the_rates_at_which_the_demo_robot_publishes() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, format!("watch: [/**]\n{PACKETS_ALONE}"))?;
    let agent = Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let prometheus = Prometheus::start(&link.robot, &["127.0.0.1:17400".to_owned()], &[])?;
    let mut roles = Vec::new();
    for (host, role) in [
        (&link.robot, "base"),
        (&link.robot, "lidar"),
        (&link.monitor, "monitor"),
    ] {
        roles.push(Process::start(&host.inside(), robot()?, ["--role", role])?);
    }
    // The reference is a publisher that logs every sample. On a busy machine, RustDDS would drop
    // some samples that it has logged.
    let stream = Stream {
        topic: "/truth".to_owned(),
        domain: 1,
        ..Stream::small(0)
    };
    let mut subscriber = Peer::start(
        &link.monitor,
        Stack::Cyclone,
        Role::Subscriber,
        &stream,
        &["/listener"],
    )?;
    let mut publisher = Peer::start(
        &link.robot,
        Stack::Cyclone,
        Role::Publisher,
        &stream,
        &["/sensor"],
    )?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    ensure!(prometheus.query("up")? > 0.5, "the scrape works");
    publisher.start_sending()?;
    let publisher_log = publisher.log_path();
    let sent = || -> Result<Vec<u64>> {
        let log = EventLog::read(&publisher_log)?;
        let sent = log.0.iter().filter(|event| event.ev == "pub");
        Ok(sent.map(|event| event.t).collect())
    };
    // The window is within the stream. On a busy machine, a scrape may be late, and the demo, which
    // keeps no log, may fall behind.
    std::thread::sleep(WINDOW + Duration::from_secs(2));
    let began = Instant::now();
    loop {
        let asked = SystemTime::now().duration_since(UNIX_EPOCH)?;
        let rate = |topic: &str| {
            let counter = format!("ros2_topic_messages_total{{topic=\"{topic}\"}}");
            prometheus.query(&format!("rate({counter}[{}s])", WINDOW.as_secs()))
        };
        let rates = [rate("/truth")?, rate("/imu")?, rate("/points")?];
        // The latest scrape is up to a second older than the query.
        let end = asked.saturating_sub(Duration::from_millis(500));
        let window = end.saturating_sub(WINDOW).as_nanos()..end.as_nanos();
        let sent = sent()?.into_iter();
        let in_window = sent.filter(|time| window.contains(&u128::from(*time)));
        let true_rate = in_window.count() as f64 / WINDOW.as_secs_f64();
        let published = [true_rate, 200.0, 20.0];
        let parts = [0, 1, 2].map(|index| rates[index] / published[index]);
        let [truth, demo @ ..] = parts.map(|part| (part - 1.0).abs() < 0.04);
        let is_busy = began.elapsed() > PATIENCE / 2;
        if truth && (demo == [true; 2] || is_busy && parts.iter().all(|part| *part < 1.04)) {
            break;
        }
        ensure!(began.elapsed() < PATIENCE, "{rates:?} Hz for {published:?}");
        std::thread::sleep(Duration::from_secs(1));
    }
    publisher.process.terminate()?;
    let total = "ros2_topic_messages_total{topic=\"/truth\"}";
    prometheus.wait_for(total, sent()?.len() as f64)?;
    promtool(&agent.scrape()?.0)
}

fn promtool(page: &str) -> Result<()> {
    let mut child = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .context(INSTALL)?;
    child
        .stdin
        .take()
        .context("no input")?
        .write_all(page.as_bytes())?;
    let output = child.wait_with_output()?;
    let printed = [output.stdout, output.stderr].concat();
    ensure!(
        output.status.success() && printed.is_empty(),
        "promtool: {}",
        String::from_utf8_lossy(&printed)
    );
    Ok(())
}
