//! An agent that starts after the robot.

use std::process::Stdio;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use super::discover;
use crate::counting::{
    PATIENCE, WATCH, agrees, delivered, messages, publish, publisher, runs_in, settled_log,
    subscription,
};
use crate::host::{Host, Middleware};

/// Starts a router, a publisher and its subscription.
fn robot(host: &Host<'_>) -> Result<[Process; 3]> {
    let router = host.router("")?;
    let mut sensor = publisher(host, "sensor", "/imu", &["200", "300", "2000", "RELIABLE"])?;
    let one = subscription(host, "one", "/imu", &["2000", "RELIABLE"])?;
    sensor.wait_for("matched", PATIENCE)?;
    Ok([router, sensor, one])
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_late_agent_counts_and_reads_the_names_from_the_router() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let [_router, mut sensor, mut one] = robot(&host)?;
    publish(&mut sensor, 200, 200)?;
    let agent = host.agent(WATCH)?;
    publish(&mut sensor, 1000, 1200)?;
    let page = agent.scrape_until("an unknown writer", |page| {
        page.sum("ros2_unknown_writer_messages_total", &[]) >= 900.0
    })?;
    println!("{}", page.sum("ros2_unknown_writer_messages_total", &[]));
    discover(&host)?;
    agent.scrape_until("names", |page| {
        page.samples("ros2_node_info", &[("ros_node", "/sensor")])
            .count()
            == 1
    })?;
    let before = messages(&agent, "/imu")?;
    publish(&mut sensor, 1000, 2200)?;
    wait_until("the messages count", || {
        Ok(messages(&agent, "/imu")? == before + 1000.0)
    })
    .with_context(|| format!("{before}"))?;
    let log = settled_log(&mut one)?;
    ensure!(log.missing == 0, "{log:?}");
    runs_in(&agent, "/sensor", &sensor)?;
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_ros2_command_reveals_the_receivers_of_connections_older_than_the_agent() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let [_router, mut sensor, mut one] = robot(&host)?;
    let agent = host.agent(WATCH)?;
    let mut command = host.run("exec ros2 node list --no-daemon", &[], Stdio::inherit())?;
    command.wait_for("/sensor", PATIENCE)?;
    runs_in(&agent, "/one", &one)?;
    // The subscription sends only KEEP_ALIVEs, every 30 s.
    let (mut published, mut before) = (0, 0);
    wait_until("deliveries have a node", || {
        published += 10;
        publish(&mut sensor, 10, published)?;
        before = delivered(&agent, "/imu", "/one")?.received;
        Ok(before > 0)
    })?;
    let unknown = settled_log(&mut one)?.received - delivered(&agent, "/imu", "/one")?.received;
    publish(&mut sensor, 1000, published + 1000)?;
    let mut log = settled_log(&mut one)?;
    ensure!(log.received == published + 1000, "{log:?}");
    log.received -= unknown;
    agrees(&agent, "/imu", "/one", log)?;
    one.signal("KILL")?;
    agent.scrape_until("the node is gone", |page| {
        page.sum("ros2_nodes", &[]) == 1.0
    })?;
    Ok(())
}
