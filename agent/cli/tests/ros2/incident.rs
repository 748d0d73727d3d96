//! A snapshot of real nodes: a subscriber with incompatible QoS causes a bag, and `ros2 bag play`
//! publishes its messages.

use std::fs::{self, File};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::bag_messages::for_each_message;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use serde_json::Value;

use crate::host::{Host, Middleware};

const PATIENCE: Duration = Duration::from_secs(60);
const SECOND: i64 = 1_000_000_000;
/// Interval of the publisher's messages.
const INTERVAL: i64 = SECOND / 20;

/// Runs `ros2` with these arguments. Its output goes to the file `name`.
fn ros2(host: &Host<'_>, name: &str, arguments: &[&str]) -> Result<Process> {
    let line = format!("exec ros2 \"$@\" >{}", host.path(name));
    let errors = File::create(host.file(&format!("{name}.err")))?;
    host.run(&line, arguments, errors.into())
}

/// Prints the messages of the topic, received with this reliability.
fn echo(host: &Host<'_>, name: &str, reliability: &str) -> Result<Process> {
    let words = "topic echo /chatter std_msgs/msg/String --qos-reliability";
    let mut words: Vec<&str> = words.split(' ').collect();
    words.push(reliability);
    ros2(host, name, &words)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, ros2bag, rosbag2_storage_mcap: make test-ros2"]
fn a_finding_causes_a_bag_of_the_seconds_around_it_that_ros2_plays() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Cyclone)?;
    let bags = host.file("bags");
    let agent = host.agent(&format!(
        "recordings:\n  directory: {}\n  reserve_percent: 0\n  reserve_bytes: 0\n  snapshots:\n    \
         - {{name: incident, topics: [/chatter], seconds: 3, seconds_after: 2, \
         trigger: [qos_incompatible]}}\n",
        bags.display()
    ))?;

    let words = "topic pub -r 20 --qos-reliability best_effort /chatter std_msgs/msg/String";
    let mut words: Vec<&str> = words.split(' ').collect();
    words.push("data: hello");
    let mut publisher = ros2(&host, "publisher", &words)?;
    let _subscriber = echo(&host, "subscriber", "best_effort")?;
    agent.scrape_until("messages in memory", |page| {
        page.sum("ros2probe_snapshot_messages", &[]) > 80.0
    })?;
    let _incompatible = echo(&host, "incompatible", "reliable")?;
    agent.scrape_until("a bag", |page| {
        page.sum("ros2probe_snapshots_written_total", &[]) == 1.0
    })?;
    publisher.terminate()?;

    let bag = fs::read_dir(&bags)?.next().context("no bag")??.path();
    let count = spans_the_finding(&bag)?;
    plays(&host, &bag, count)
}

/// Checks that the bag covers the time of the finding. Returns the number of messages.
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
    for_each_message(bag, |message| {
        times.push(i64::try_from(message.log_time)? - time);
        numbers.push(message.sequence);
        Ok(())
    })?;
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

fn plays(host: &Host<'_>, bag: &Path, count: usize) -> Result<()> {
    let listener = echo(host, "listener", "best_effort")?;
    let bag = bag.display().to_string();
    let mut player = ros2(host, "player", &["bag", "play", &bag, "--delay", "5"])?;
    player.wait(PATIENCE)?;
    let output = |name| fs::read_to_string(host.file(name)).unwrap_or_default();
    let received_messages = || output("listener").matches("data: hello").count();
    let heard_all = wait_until("the listener heard all messages", || {
        Ok(received_messages() == count)
    });
    drop(listener);
    heard_all.with_context(|| {
        format!(
            "{} of {count}: {}",
            received_messages(),
            output("player.err")
        )
    })
}
