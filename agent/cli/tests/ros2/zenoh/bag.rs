//! A bag of small messages at 1 kHz and of point clouds has each message byte for byte. `ros2 bag
//! play` publishes the messages again.

use std::fs::{self, File};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::counting::{PATIENCE, publisher, subscription};
use crate::host::{Host, Middleware, RP};
use crate::installed;

/// Name of the publisher, topic, messages per second, bytes, and number of messages.
const STREAMS: [(&str, &str, &str, &str, usize); 2] = [
    ("sensor", "/imu", "1000", "300", 5000),
    ("lidar", "/points", "20", "2720000", 100),
];
/// QoS that keeps all messages: the publisher waits while a connection is congested, instead of
/// dropping messages.
const RELIABLE: [&str; 2] = ["0", "RELIABLE"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp, ros2bag, rosbag2_storage_mcap: make test-ros2"]
fn a_bag_has_each_message_byte_for_byte_and_ros2_plays_it() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent("watch: []\n")?;
    let _router = host.router("")?;
    let (mut publishers, mut subscriptions) = (Vec::new(), Vec::new());
    for (name, topic, rate, bytes, _) in STREAMS {
        let log = host.path(&format!("{name}.log"));
        let arguments = [&[rate, bytes][..], &RELIABLE, &[&log]].concat();
        publishers.push(publisher(&host, name, topic, &arguments)?);
        subscriptions.push(subscription(&host, &format!("{name}_s"), topic, &RELIABLE)?);
    }
    for each in &mut publishers {
        each.wait_for("matched", PATIENCE)?;
    }
    let bag = host.path("bag");
    let mut recorder = record(&host, &bag)?;
    agent.scrape_until("interest in both topics", |page| {
        page.sum("ros2probe_subscriptions", &[]) >= 1.0
    })?;
    for (each, (.., count)) in publishers.iter_mut().zip(STREAMS) {
        each.write_line(&count.to_string())?;
    }
    for (each, (.., count)) in publishers.iter_mut().zip(STREAMS) {
        each.wait_for(&format!("published {count}"), PATIENCE)?;
    }
    std::thread::sleep(Duration::from_secs(1));
    recorder.signal("INT")?;
    let status = recorder.wait(PATIENCE)?;
    let printed = fs::read_to_string(host.file("recorder.err"))?;
    ensure!(status.code() == Some(0), "{printed}");
    drop((publishers, subscriptions));

    let recorded = hashes(&host, &bag)?;
    for (name, topic, .., count) in STREAMS {
        let sent = log_of(&host, name)?;
        ensure!(sent.len() == count, "{name}: {}", sent.len());
        let marked = format!("{topic} ");
        let in_bag = recorded.lines().filter_map(|it| it.strip_prefix(&marked));
        same(topic, &sent, &in_bag.map(str::to_owned).collect::<Vec<_>>())?;
    }
    plays(&host, &bag)
}

/// Plays the bag to two subscriptions, and checks their logs.
fn plays(host: &Host<'_>, bag: &str) -> Result<()> {
    let mut listeners = Vec::new();
    for (name, topic, ..) in STREAMS {
        let log = host.path(&format!("played-{name}.log"));
        let name = format!("listener_{name}");
        let arguments = [&["log", &name, topic][..], &RELIABLE, &[&log]].concat();
        let mut listener = host.python("counting.py", &arguments)?;
        listener.wait_for("ready", PATIENCE)?;
        listeners.push(listener);
    }
    // By default, the player keeps ten messages, and Zenoh drops those of a congested connection.
    let qos = "{history: keep_all, depth: 0, reliability: reliable, durability: volatile}";
    let overrides = STREAMS.map(|(_, topic, ..)| format!("{topic}: {qos}\n"));
    fs::write(host.file("qos.yaml"), overrides.concat())?;
    let errors = File::create(host.file("player.err"))?;
    let line = "exec ros2 bag play \"$1\" --delay 3 --qos-profile-overrides-path \"$2\" >/dev/null";
    let mut player = host.run(line, &[bag, &host.path("qos.yaml")], errors.into())?;
    player.wait(PATIENCE)?;
    for (name, topic, ..) in STREAMS {
        let sent = log_of(host, name)?;
        let played = format!("played-{name}");
        wait_until("all messages are played", || {
            Ok(log_of(host, &played)?.len() >= sent.len())
        })
        .or_else(|_| same(topic, &sent, &log_of(host, &played)?))?;
        same(topic, &sent, &log_of(host, &played)?)?;
    }
    Ok(())
}

/// Fails if the hashes differ or have another order.
fn same(topic: &str, sent: &[String], other: &[String]) -> Result<()> {
    let differs = sent.iter().zip(other).position(|(one, other)| one != other);
    ensure!(
        sent == other,
        "{topic}: {} of {}, first difference at {differs:?}",
        other.len(),
        sent.len()
    );
    Ok(())
}

/// Starts `rp bag record` and waits until it records both topics.
fn record(host: &Host<'_>, bag: &str) -> Result<Process> {
    let errors = host.file("recorder.err");
    let mut words = vec!["bag", "record", "-o", bag];
    words.extend(STREAMS.map(|(_, topic, ..)| topic));
    let socket = host.socket();
    words.extend(["--socket", &socket]);
    let mut enter = host.network.on_network();
    enter.extend(["env", "-u", "ROS_DOMAIN_ID"].map(str::to_owned));
    enter.push(format!("ROS_DISTRO={}", installed::distro()));
    let recorder = Process::start_with(&enter, RP, words, File::create(&errors)?.into())?;
    wait_until("it records both topics", || {
        let printed = fs::read_to_string(&errors)?;
        let is_subscribed =
            |(_, topic, ..): &(_, &str, _, _, _)| printed.contains(&format!("'{topic}'"));
        Ok(printed.contains("Recording...") && STREAMS.iter().all(is_subscribed))
    })?;
    Ok(recorder)
}

/// Returns a line with topic and hash for each message that rosbag2 reads.
fn hashes(host: &Host<'_>, bag: &str) -> Result<String> {
    let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2");
    let python = installed::python();
    let line = format!("exec {python} {directory}/counting.py bag \"$1\" >\"$2\"");
    let output = host.path("bag.txt");
    let mut reader = host.run(&line, &[bag, &output], Stdio::inherit())?;
    ensure!(reader.wait(PATIENCE)?.success(), "rosbag2 reads the bag");
    Ok(fs::read_to_string(output)?)
}

fn log_of(host: &Host<'_>, name: &str) -> Result<Vec<String>> {
    let path = host.file(&format!("{name}.log"));
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    Ok(text.lines().map(str::to_owned).collect())
}
