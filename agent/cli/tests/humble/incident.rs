//! A snapshot of real nodes: a subscriber with incompatible QoS writes a bag, and `ros2 bag play`
//! publishes what is in it.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, at_the_sockets_of};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::shared_memory::SharedMemory;
use ros2probe_testing::harness::wait_until;
use serde_json::Value;
use tempfile::TempDir;

const RP: &str = env!("CARGO_BIN_EXE_rp");
const PATIENCE: Duration = Duration::from_secs(60);
const SECOND: i64 = 1_000_000_000;
/// Interval of the publisher's messages.
const INTERVAL: i64 = SECOND / 20;

struct Robot<'n> {
    network: &'n Namespace,
    shared_memory: SharedMemory,
    directory: TempDir,
}

impl Robot<'_> {
    /// Runs `ros2` with these arguments. Its output goes to a file of that name.
    fn ros2(&self, name: &str, arguments: &[&str]) -> Result<Process> {
        let mut enter = self.shared_memory.inside(self.network);
        let log = format!("ROS_LOG_DIR={}", self.directory.path().display());
        let variables = [
            "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp",
            "ROS_DOMAIN_ID=0",
            &log,
        ];
        enter.push("env".to_owned());
        enter.extend(variables.map(str::to_owned));
        let shell = r#". /opt/ros/humble/env.sh && out=$0 && exec ros2 "$@" >"$out""#;
        let output = self.file(name).display().to_string();
        let mut words = vec!["-c", shell, &output];
        words.extend(arguments);
        let errors = File::create(self.file(&format!("{name}.err")))?;
        Process::start_with(&enter, "bash", words, errors.into())
    }

    fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn output(&self, name: &str) -> String {
        fs::read_to_string(self.file(name)).unwrap_or_default()
    }
}

#[test]
#[ignore = "needs ROS 2 Humble: make test-ros2"]
fn a_finding_writes_a_bag_of_the_seconds_around_it_that_ros2_plays() -> Result<()> {
    let network = Namespace::alone()?;
    let robot = Robot {
        network: &network,
        shared_memory: SharedMemory::of(&network, 64)?,
        directory: tempfile::tempdir()?,
    };
    let bags = robot.file("bags");
    let text = format!(
        "{}state_directory: off\nrecordings:\n  directory: {}\n  snapshots:\n    - {{name: incident, \
         topics: [/chatter], seconds: 3, seconds_after: 2, trigger: [qos_incompatible]}}\n",
        at_the_sockets_of(&network),
        bags.display()
    );
    let configuration = robot.file("ros2probe.yaml");
    fs::write(&configuration, text)?;
    let agent = Agent::start(&network, RP, &configuration)?;

    let best_effort = ["--qos-reliability", "best_effort"];
    let publish = [
        "topic",
        "pub",
        "-r",
        "20",
        "/chatter",
        "std_msgs/msg/String",
        "data: hello",
    ];
    let mut publisher = robot.ros2("publisher", &[&publish[..], &best_effort].concat())?;
    let echo = [
        "topic",
        "echo",
        "/chatter",
        "std_msgs/msg/String",
        "--qos-reliability",
        "best_effort",
    ];
    let _subscriber = robot.ros2("subscriber", &echo)?;
    agent.scrape_until("messages in memory", |page| {
        page.sum("ros2probe_snapshot_messages", &[]) > 80.0
    })?;
    let reliable = [
        "topic",
        "echo",
        "/chatter",
        "std_msgs/msg/String",
        "--qos-reliability",
        "reliable",
    ];
    let _incompatible = robot.ros2("incompatible", &reliable)?;
    agent.scrape_until("a bag", |page| {
        page.sum("ros2probe_snapshots_written_total", &[]) == 1.0
    })?;
    publisher.terminate()?;

    let bag = fs::read_dir(&bags)?.next().context("no bag")??.path();
    let count = spans_the_finding(&bag)?;
    plays(&robot, &bag, count)
}

/// Returns the number of messages.
fn spans_the_finding(bag: &Path) -> Result<usize> {
    let metadata = fs::read_to_string(bag.join("metadata.yaml"))?;
    let metadata = ros2probe_bag::metadata::Metadata::read(&metadata)?;
    let trigger = metadata.custom_data.get("ros2probe_trigger");
    let trigger: Value = serde_json::from_str(trigger.context("no trigger")?)?;
    ensure!(trigger["event"] == "ros2.qos.incompatible", "{trigger}");
    ensure!(trigger["attributes"]["topic"] == "/chatter", "{trigger}");
    let time: jiff::Timestamp = trigger["time"].as_str().context("no time")?.parse()?;
    let time = i64::try_from(time.as_nanosecond())?;
    let (mut times, mut numbers) = (Vec::new(), Vec::new());
    for file in fs::read_dir(bag)? {
        let path = file?.path();
        if path.extension().is_none_or(|extension| extension != "mcap") {
            continue;
        }
        let bytes = fs::read(&path)?;
        for message in mcap::MessageStream::new(&bytes)? {
            let message = message?;
            times.push(i64::try_from(message.log_time)? - time);
            numbers.push(message.sequence);
        }
    }
    let (first, last) = (
        times.first().context("empty")?,
        times.last().context("empty")?,
    );
    println!(
        "{} messages from {first} to {last} ns around the event",
        times.len()
    );
    ensure!(
        (-3 * SECOND..-3 * SECOND + 3 * INTERVAL).contains(first),
        "{first}"
    );
    ensure!(
        (2 * SECOND - 3 * INTERVAL..=2 * SECOND).contains(last),
        "{last}"
    );
    let is_next = |pair: &[u32]| matches!(pair, [one, next] if one + 1 == *next);
    ensure!(numbers.windows(2).all(is_next), "{numbers:?}");
    Ok(times.len())
}

fn plays(robot: &Robot<'_>, bag: &Path, count: usize) -> Result<()> {
    let echo = [
        "topic",
        "echo",
        "/chatter",
        "std_msgs/msg/String",
        "--qos-reliability",
        "best_effort",
    ];
    let listener = robot.ros2("listener", &echo)?;
    let bag = bag.display().to_string();
    let mut player = robot.ros2("player", &["bag", "play", &bag, "--delay", "5"])?;
    player.wait(PATIENCE)?;
    let heard = || robot.output("listener").matches("data: hello").count();
    let heard_all = wait_until("the listener heard all messages", || Ok(heard() == count));
    drop(listener);
    heard_all.with_context(|| format!("{} of {count}: {}", heard(), robot.output("player.err")))
}
