//! Real nodes of rmw_zenoh that the agent observes. The counts of each receiver equal the log of
//! each subscription.
//!
//! Needs root and ROS 2: `make test-ros2`.

mod bag;
mod encrypted;
mod hosts;
mod late;
mod mixed;
mod restart;
mod viewer;

use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;

use crate::counting::{
    Log, PATIENCE, WATCH, agrees, deliveries, messages, publish, publisher, runs_in, settled_log,
    subscription,
};
use crate::host::{Host, Middleware, RP};

fn discover(host: &Host<'_>) -> Result<()> {
    let enter = host.enter();
    let (program, arguments) = enter.split_first().context("no prefix")?;
    let status = Command::new(program)
        .args(arguments)
        .args([RP, "discover", "--router"])
        .status()?;
    ensure!(status.success(), "rp discover --router");
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn counts_of_small_messages_and_point_clouds_equal_the_log_of_each_subscription() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent(WATCH)?;
    let _router = host.router("")?;
    let mut sensor = publisher(
        &host,
        "sensor",
        "/imu",
        &["1000", "300", "2000", "RELIABLE"],
    )?;
    let mut one = subscription(&host, "one", "/imu", &["2000", "RELIABLE"])?;
    let mut two = subscription(&host, "two", "/imu", &["2000", "RELIABLE"])?;
    let mut lidar = publisher(
        &host,
        "lidar",
        "/points",
        &["20", "2720000", "10", "RELIABLE"],
    )?;
    let mut map = subscription(&host, "map", "/points", &["10", "RELIABLE"])?;
    for each in [&mut sensor, &mut lidar] {
        each.wait_for("matched", PATIENCE)?;
    }
    for (process, node) in [(&sensor, "/sensor"), (&two, "/two"), (&map, "/map")] {
        runs_in(&agent, node, process)?;
    }
    // Waits until both subscriptions of the topic are matched.
    std::thread::sleep(Duration::from_secs(2));
    publish(&mut sensor, 5000, 5000)?;
    publish(&mut lidar, 60, 60)?;
    let mut received = Vec::new();
    for (process, topic, node) in [
        (&mut one, "/imu", "/one"),
        (&mut two, "/imu", "/two"),
        (&mut map, "/points", "/map"),
    ] {
        let log = settled_log(process)?;
        println!("{node} logged {log:?}");
        agrees(&agent, topic, node, log)?;
        let named = deliveries(&agent, topic, node)?[0].0;
        ensure!(named == Some(process.pid()), "{node}: {named:?}");
        received.push(log.received as f64);
    }
    // On a busy machine, Zenoh drops messages before they are on any connection.
    let any = received[0].max(received[1])..=5000.0;
    ensure!(any.contains(&messages(&agent, "/imu")?), "{any:?}");
    ensure!(messages(&agent, "/points")? == received[2]);
    let page = agent.scrape()?;
    ensure!(
        page.sum("ros2probe_zenoh_gaps_total", &[]) == 0.0,
        "{}",
        page.0
    );
    ensure!(page.sum("ros2probe_zenoh_routers", &[]) == 1.0);
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn messages_that_zenoh_drops_for_a_stopped_subscription_count_as_its_losses() -> Result<()> {
    let logs = with_stopped_subscription("20", "2720000", [10, 60, 20])?;
    ensure!(logs[0].missing > 0, "nothing was dropped: {logs:?}");
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn small_messages_that_wait_for_a_stopped_subscription_arrive_in_large_packets() -> Result<()> {
    let logs = with_stopped_subscription("1000", "300", [1000, 5000, 1000])?;
    ensure!(logs[1].received == 7000, "{logs:?}");
    Ok(())
}

/// Publishes some messages, further ones while one of two subscriptions is stopped, and some more.
/// Checks that the agent agrees with both, and returns the logs of the stopped one and the other.
fn with_stopped_subscription(rate: &str, bytes: &str, counts: [u64; 3]) -> Result<[Log; 2]> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent(WATCH)?;
    let _router = host.router("")?;
    let qos = ["10000", "BEST_EFFORT"];
    let mut slow = subscription(&host, "slow", "/data", &qos)?;
    let mut fast = subscription(&host, "fast", "/data", &qos)?;
    let arguments = [&[rate, bytes][..], &qos].concat();
    let mut sensor = publisher(&host, "sensor", "/data", &arguments)?;
    sensor.wait_for("matched", PATIENCE)?;
    std::thread::sleep(Duration::from_secs(2));
    let [before, stopped, after] = counts;
    publish(&mut sensor, before, before)?;
    slow.signal("STOP")?;
    publish(&mut sensor, stopped, before + stopped)?;
    slow.signal("CONT")?;
    std::thread::sleep(Duration::from_secs(3));
    publish(&mut sensor, after, before + stopped + after)?;
    let logs = [settled_log(&mut slow)?, settled_log(&mut fast)?];
    println!("stopped and not stopped: {logs:?}");
    agrees(&agent, "/data", "/fast", logs[1])?;
    agrees(&agent, "/data", "/slow", logs[0])?;
    let gaps = agent.scrape()?.sum("ros2probe_zenoh_gaps_total", &[]);
    ensure!(gaps == 0.0, "{gaps} gaps");
    Ok(logs)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_restarted_router_removes_no_node_from_the_graph() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent(WATCH)?;
    let mut router = host.router("")?;
    let mut sensor = publisher(&host, "sensor", "/imu", &["100", "300", "100", "RELIABLE"])?;
    let mut one = subscription(&host, "one", "/imu", &["100", "RELIABLE"])?;
    sensor.wait_for("matched", PATIENCE)?;
    publish(&mut sensor, 100, 100)?;
    router.terminate()?;
    publish(&mut sensor, 200, 300)?;
    let nodes = |agent: &Agent<'_>| -> Result<f64> { Ok(agent.scrape()?.sum("ros2_nodes", &[])) };
    ensure!(nodes(&agent)? == 2.0);
    let _router = host.router("")?;
    publish(&mut sensor, 300, 600)?;
    ensure!(nodes(&agent)? == 2.0);
    let log = settled_log(&mut one)?;
    agrees(&agent, "/imu", "/one", log)?;
    ensure!(messages(&agent, "/imu")? == 600.0);
    one.signal("KILL")?;
    agent.scrape_until("the node is gone", |page| {
        page.sum("ros2_nodes", &[]) == 1.0
    })?;
    Ok(())
}
