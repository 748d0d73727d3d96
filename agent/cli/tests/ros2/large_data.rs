//! Nodes of Fast DDS with `LARGE_DATA` on two hosts: topics are announced by TCP, and messages pass
//! by TCP.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::process::Process;

use crate::counting::{
    Log, PATIENCE, WATCH, agrees, delivered, messages, publish, publisher, settled_log,
    subscription,
};
use crate::host::{Host, Middleware, RP};

/// What `rp doctor` advises for announcements by TCP that the agent missed.
const COMMAND: &str =
    "FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA ros2 node list --no-daemon --spin-time 5";
const SMALL: [&str; 4] = ["200", "300", "2000", "RELIABLE"];
const CLOUD: [&str; 4] = ["5", "2720000", "50", "RELIABLE"];

/// Starts a publisher on one host and its subscription on the other.
fn pair(
    from: &Host<'_>,
    to: &Host<'_>,
    [publisher_name, topic, subscription_name]: [&str; 3],
    stream: [&str; 4],
) -> Result<[Process; 2]> {
    let mut sensor = publisher(from, publisher_name, topic, &stream)?;
    let [.., depth, reliability] = stream;
    let far = subscription(to, subscription_name, topic, &[depth, reliability])?;
    sensor.wait_for("matched", PATIENCE)?;
    Ok([sensor, far])
}

fn knows(page: &Scrape, topic: &str) -> bool {
    page.sum("ros2_topic_publishers", &[("topic", topic)]) == 1.0
        && page.sum("ros2_topic_subscriptions", &[("topic", topic)]) == 1.0
}

/// Returns what `rp doctor` prints about the agent of this host.
fn doctor(host: &Host<'_>) -> Result<String> {
    let enter = host.enter();
    let (program, arguments) = enter.split_first().context("no prefix")?;
    let output = Command::new(program)
        .args(arguments)
        .args([RP, "doctor", "--socket", &host.socket()])
        .output()?;
    Ok(String::from_utf8(output.stdout)?)
}

fn check_no_drops(agent: &Agent<'_>) -> Result<()> {
    let page = agent.scrape()?;
    for event in ["rtps_tcp_chunks_lost", "rtps_tcp_read_gaps"] {
        let count = page.sum("ros2probe_filter_events_total", &[("event", event)]);
        ensure!(count == 0.0, "{count} {event}");
    }
    Ok(())
}

// Coverage: TCP, with `LARGE_DATA` | rmw_fastrtps | installed | exact
#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, type_description_interfaces: make test-ros2"]
fn counts_on_both_hosts_equal_the_log_of_the_subscription() -> Result<()> {
    let link = Link::new()?;
    let robot = Host::new(&link.robot, Middleware::FastLargeData)?;
    let base = Host::new(&link.monitor, Middleware::FastLargeData)?;
    let agents = [robot.agent(WATCH)?, base.agent(WATCH)?];
    let [mut sensor, mut far] = pair(&robot, &base, ["sensor", "/imu", "far"], SMALL)?;
    let [mut lidar, mut map] = pair(&robot, &base, ["lidar", "/points", "map"], CLOUD)?;
    for agent in &agents {
        agent.scrape_until("both topics, by TCP", |page| {
            let by_tcp = |topic| [("topic", topic), ("passage", "tcp")];
            let is_by_tcp = |topic| page.sum("ros2_topic_pairs", &by_tcp(topic)) == 1.0;
            ["/imu", "/points"].into_iter().all(is_by_tcp)
        })?;
    }
    publish(&mut sensor, 1000, 1000)?;
    publish(&mut lidar, 20, 20)?;
    for (subscription, topic, node, count) in [
        (&mut far, "/imu", "/far", 1000),
        (&mut map, "/points", "/map", 20),
    ] {
        let log = settled_log(subscription)?;
        println!("{node} logged {log:?}");
        ensure!(log.received == count, "{node}: {log:?}");
        agrees(&agents[1], topic, node, log)?;
        for agent in &agents {
            let counted = messages(agent, topic)?;
            ensure!(counted == count as f64, "{topic}: {counted}");
            check_no_drops(agent)?;
        }
    }
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, type_description_interfaces: make test-ros2"]
fn a_late_agent_discovers_the_topics_through_a_command() -> Result<()> {
    let link = Link::new()?;
    let robot = Host::new(&link.robot, Middleware::FastLargeData)?;
    let base = Host::new(&link.monitor, Middleware::FastLargeData)?;
    let [mut sensor, mut far] = pair(&robot, &base, ["sensor", "/imu", "far"], SMALL)?;
    publish(&mut sensor, 100, 100)?;
    let agent = base.agent(WATCH)?;
    publish(&mut sensor, 200, 300)?;
    agent.scrape_until("an unknown writer", |page| {
        page.sum("ros2_unknown_writer_messages_total", &[]) > 100.0
    })?;
    let doctor = doctor(&base)?;
    ensure!(doctor.contains(COMMAND), "{doctor}");
    let mut command = base.run(COMMAND, &[], Stdio::inherit())?;
    command.wait_for("/sensor", PATIENCE)?;
    agent.scrape_until("the topic", |page| knows(page, "/imu"))?;
    counts_the_next(&agent, &mut sensor, &mut far, 300)?;

    // The saved state has the topics.
    std::thread::sleep(std::time::Duration::from_secs(8));
    agent.process.signal("KILL")?;
    drop(agent);
    publish(&mut sensor, 100, 1400)?;
    let agent = base.agent(WATCH)?;
    publish(&mut sensor, 100, 1500)?;
    agent.scrape_until("the topic", |page| knows(page, "/imu"))?;
    counts_the_next(&agent, &mut sensor, &mut far, 1500)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, type_description_interfaces: make test-ros2"]
fn a_restarted_subscription_counts_from_its_start() -> Result<()> {
    let link = Link::new()?;
    let robot = Host::new(&link.robot, Middleware::FastLargeData)?;
    let base = Host::new(&link.monitor, Middleware::FastLargeData)?;
    let agent = base.agent(WATCH)?;
    let [mut sensor, mut far] = pair(&robot, &base, ["sensor", "/imu", "far"], SMALL)?;
    publish(&mut sensor, 200, 200)?;
    let log = settled_log(&mut far)?;
    agrees(&agent, "/imu", "/far", log)?;
    far.signal("KILL")?;
    drop(far);
    publish(&mut sensor, 200, 400)?;
    let mut far = subscription(&base, "again", "/imu", &["2000", "RELIABLE"])?;
    agent.scrape_until("the new subscription", |page| {
        let node = [("ros_node", "/again")];
        page.samples("ros2_node_info", &node).next().is_some()
    })?;
    // Fast DDS sends nothing to a participant before it has matched.
    let mut published = 400;
    while settled_log(&mut far)?.received == 0 {
        published += 10;
        publish(&mut sensor, 10, published)?;
    }
    publish(&mut sensor, 1000, published + 1000)?;
    let log = settled_log(&mut far)?;
    println!("logged {log:?}");
    ensure!(log.received >= 1000 && log.missing == 0, "{log:?}");
    agrees(&agent, "/imu", "/again", log)?;
    check_no_drops(&agent)
}

/// Publishes 1000 messages after `published` ones, and checks that the agent counts what arrives.
fn counts_the_next(
    agent: &Agent<'_>,
    sensor: &mut Process,
    far: &mut Process,
    published: u64,
) -> Result<()> {
    let logged = settled_log(far)?;
    let arrived = delivered(agent, "/imu", "/far")?;
    let counted = messages(agent, "/imu")?;
    publish(sensor, 1000, published + 1000)?;
    let log = settled_log(far)?;
    ensure!(log.received == logged.received + 1000, "{log:?}");
    let expected = Log {
        received: arrived.received + 1000,
        missing: arrived.missing,
    };
    agrees(agent, "/imu", "/far", expected)?;
    let counted = messages(agent, "/imu")? - counted;
    ensure!(counted == 1000.0, "{counted}");
    check_no_drops(agent)
}
