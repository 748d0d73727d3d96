//! A real Prometheus scrapes the agent beside the demo robot, and PromQL answers what the robot's
//! publishers really did; `promtool` finds nothing wrong with the page.

mod harness;

use std::io::Write as _;
use std::process::{Command, Stdio};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use harness::agent::{Agent, ON_THE_WIRE};
use harness::network::Link;
use harness::peer::{Peer, Role, Stack, Stream, robot};
use harness::process::Process;
use harness::prometheus::{INSTALL, Prometheus};

#[test]
fn prometheus_answers_the_rates_at_which_the_demo_robot_publishes() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, format!("watch: [/**]\n{ON_THE_WIRE}"))?;
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
    // A publisher that logs every sample: the truth to compare with.
    let stream = Stream {
        topic: "/truth".to_owned(),
        ..Stream::small(2600)
    };
    let mut subscriber = Peer::start(
        &link.monitor,
        Stack::Rust,
        Role::Subscriber,
        &stream,
        &["/listener"],
    )?;
    let mut publisher = Peer::start(
        &link.robot,
        Stack::Rust,
        Role::Publisher,
        &stream,
        &["/sensor"],
    )?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    ensure!(prometheus.query("up")? > 0.5, "the scrape works");
    publisher.go()?;
    // Well into the 13 seconds of the stream, so that the window asked for lies in it.
    std::thread::sleep(Duration::from_secs(11));
    let rate = |topic: &str| {
        let counter = format!("ros2_topic_messages_total{{topic=\"{topic}\"}}");
        prometheus.query(&format!("rate({counter}[8s])"))
    };
    let asked = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
    let rates = [rate("/truth")?, rate("/imu")?, rate("/points")?];
    publisher.wait_sent(Duration::from_secs(60))?;

    let log = publisher.log()?;
    let sent = log.0.iter().filter(|event| event.ev == "pub");
    let times: Vec<_> = sent.map(|event| event.t).collect();
    // The latest scrape is up to a second older than the question.
    let window = asked - 8_500_000_000..asked - 500_000_000;
    let in_window = times.iter().filter(|time| window.contains(time)).count();
    let true_rate = in_window as f64 / 8.0;
    // The robot of the demo keeps no log, and a busy machine keeps it from its pace.
    let expected = [(true_rate, 0.05), (200.0, 0.2), (20.0, 0.2)];
    for (answer, (published, tolerance)) in rates.into_iter().zip(expected) {
        let difference = (answer / published - 1.0).abs();
        ensure!(difference < tolerance, "{answer} Hz for {published} Hz");
    }
    let total = "ros2_topic_messages_total{topic=\"/truth\"}";
    prometheus.wait_for(total, times.len() as f64)?;
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
    let said = [output.stdout, output.stderr].concat();
    ensure!(
        output.status.success() && said.is_empty(),
        "promtool: {}",
        String::from_utf8_lossy(&said)
    );
    Ok(())
}
