//! Two hosts that their routers connect, with an agent on each.

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Link;

use super::discover;
use crate::counting::{
    PATIENCE, WATCH, agrees, messages, publish, publisher, settled_log, subscription,
};
use crate::host::{Host, Middleware};

const QOS: [&str; 2] = ["2000", "RELIABLE"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn the_counts_of_each_host_equal_the_logs_of_its_subscriptions() -> Result<()> {
    let link = Link::new()?;
    let robot = Host::new(&link.robot, Middleware::Zenoh)?;
    let base = Host::new(&link.monitor, Middleware::Zenoh)?;
    let of_robot = robot.agent(WATCH)?;
    let of_base = base.agent(WATCH)?;
    let _router = robot.router("")?;
    let address = link.robot.address();
    let _other_router = base.router(&format!("connect/endpoints=[\"tcp/{address}:7447\"]"))?;
    let mut sensor = publisher(
        &robot,
        "sensor",
        "/imu",
        &[&["200", "300"][..], &QOS].concat(),
    )?;
    let mut near = subscription(&robot, "near", "/imu", &QOS)?;
    let mut far = subscription(&base, "far", "/imu", &QOS)?;
    sensor.wait_for("matched", PATIENCE)?;
    nodes(&of_robot, 3.0)?;
    nodes(&of_base, 3.0)?;
    std::thread::sleep(std::time::Duration::from_secs(2));

    publish(&mut sensor, 1000, 1000)?;
    let (log_near, log_far) = (settled_log(&mut near)?, settled_log(&mut far)?);
    println!("near {log_near:?}, far {log_far:?}");
    agrees(&of_robot, "/imu", "/near", log_near)?;
    agrees(&of_base, "/imu", "/far", log_far)?;
    for agent in [&of_robot, &of_base] {
        let counted = messages(agent, "/imu")?;
        ensure!(counted == 1000.0, "{counted}");
    }

    near.signal("KILL")?;
    nodes(&of_robot, 2.0)?;
    nodes(&of_base, 2.0)?;

    // This agent starts last, and requests the names.
    drop(of_base);
    std::fs::remove_file(base.file("discovery.json"))?;
    let of_base = base.agent(WATCH)?;
    publish(&mut sensor, 200, 1200)?;
    of_base.scrape_until("an unknown writer", |page| {
        page.sum("ros2_unknown_writer_messages_total", &[]) > 100.0
    })?;
    discover(&base)?;
    nodes(&of_base, 2.0)?;
    let before = messages(&of_base, "/imu")?;
    publish(&mut sensor, 500, 1700)?;
    settled_log(&mut far)?;
    let counted = messages(&of_base, "/imu")? - before;
    ensure!(counted == 500.0, "{counted}");
    Ok(())
}

fn nodes(agent: &Agent<'_>, count: f64) -> Result<()> {
    agent.scrape_until("the nodes of both hosts", |page| {
        page.sum("ros2_nodes", &[]) == count
    })?;
    Ok(())
}
