//! The demo robot's faults reach a real OpenTelemetry receiver as events with names and attributes:
//! new participants, losses and silent publishers. The sums agree with the counters.

use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::robot;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::rotel::{Item, Rotel, exports};

const PATIENCE: Duration = Duration::from_secs(60);

/// Returns the records of one name that are printed whole.
fn records(receiver: &Rotel, name: &str) -> Vec<Item> {
    let text = receiver.text();
    let end = text.rfind("\nFlags: ").unwrap_or(0);
    let exports = exports(text.get(..end).unwrap_or_default());
    let records = exports.into_iter().flat_map(|export| export.items);
    let named = |record: &Item| record.fields.get("EventName").is_some_and(|it| it == name);
    records.filter(named).collect()
}

/// Waits for a record of this name with this attribute.
fn wait_for(receiver: &Rotel, name: &str, attribute: &str, value: &str) -> Result<Item> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let is = |record: &Item| {
            record
                .attributes
                .get(attribute)
                .is_some_and(|it| it == value)
        };
        if let Some(record) = records(receiver, name).into_iter().find(is) {
            return Ok(record);
        }
        ensure!(
            Instant::now() < deadline,
            "no {name} with {attribute} {value} in {}",
            receiver.text()
        );
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Returns how often a watched topic became silent after it was ok.
fn silences(receiver: &Rotel) -> usize {
    let is = |record: &Item, attribute: &str, value: &str| {
        let found = record.attributes.get(attribute);
        found.is_some_and(|found| found == value)
    };
    let changes = records(receiver, "ros2.topic.expectation_changed").into_iter();
    let silences = changes.filter(|it| is(it, "from", "ok") && is(it, "to", "silent"));
    silences.count()
}

#[test]
fn a_receiver_receives_events_of_new_nodes_losses_and_silence() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let [enter, words @ ..] = &link.monitor.outside();
    let mut command = Command::new(enter);
    command.args(words).arg(Rotel::binary());
    let receiver = Rotel::start(&mut command, directory.path(), None);
    let configuration = directory.path().join("ros2probe.yaml");
    let endpoint = receiver.address;
    std::fs::write(
        &configuration,
        format!(
            "watch: [{{topic: /imu, max_silence_s: 1}}]\n{PACKETS_ALONE}\
             otlp: {{endpoint: 'http://{endpoint}', metrics: false}}\n"
        ),
    )?;
    let mut agent = Agent::start(&link.monitor, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let mut monitor = Process::start(&link.monitor.inside(), robot()?, ["--role", "monitor"])?;
    let lidar = Process::start(&link.robot.inside(), robot()?, ["--role", "lidar"])?;
    for node in ["/lidar", "/imu_driver", "/operator/monitor"] {
        wait_for(&receiver, "ros2.node.discovered", "ros_node", node)?;
    }

    // Lost samples are best effort and not sent again.
    let samples = "udp dport != { 7400, 7410, 7412, 7414, 7416 } udp length 200-1000";
    let loss = Loss::of(&link.robot, samples, 300)?;
    let lost = wait_for(&receiver, "ros2.message.lost", "topic", "/imu")?;
    drop(loss);
    ensure!(
        lost.fields
            .get("SeverityText")
            .is_some_and(|it| it == "WARN")
    );
    ensure!(
        lost.attributes
            .get("ros_node")
            .is_some_and(|it| it == "/imu_driver"),
        "{lost:?}"
    );

    let is_ok = [("topic", "/imu"), ("state", "ok")];
    agent.scrape_until("/imu ok", |page| {
        page.sum("ros2_watch_state", &is_ok) == 1.0
    })?;
    let before = silences(&receiver);
    lidar.signal("KILL")?;
    let silent = wait_for(&receiver, "ros2.topic.silent", "topic", "/imu")?;
    ensure!(
        silent
            .attributes
            .get("watch")
            .is_some_and(|it| it == "/imu")
    );
    wait_until("/imu is silent after it was ok", || {
        Ok(silences(&receiver) > before)
    })?;
    let reported = || -> f64 {
        let losses = records(&receiver, "ros2.message.lost").into_iter();
        let counts = losses.filter_map(|loss| loss.attributes.get("count")?.parse::<f64>().ok());
        counts.sum()
    };
    agent.scrape_until("what was reported", |page| {
        let lost = page.sum("ros2_topic_lost_messages_total", &[("topic", "/imu")]);
        lost > 0.0 && (lost - reported()).abs() < 0.5
    })?;

    monitor.terminate()?;
    wait_for(&receiver, "ros2.participant.lost", "cause", "disposed")?;
    let begun = Instant::now();
    agent.process.terminate()?;
    ensure!(begun.elapsed() < PATIENCE, "{:?}", begun.elapsed());
    Ok(())
}
