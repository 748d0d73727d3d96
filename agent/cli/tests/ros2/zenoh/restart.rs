//! An agent that restarts beside a running robot.

use anyhow::{Result, ensure};
use ros2probe_testing::harness::network::Namespace;

use crate::counting::{
    PATIENCE, WATCH, agrees, delivered, messages, publish, publisher, settled_log, subscription,
};
use crate::host::{Host, Middleware};

const QOS: [&str; 2] = ["2000", "RELIABLE"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_restarted_agent_has_the_names_and_counts_of_each_node() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let mut agent = host.agent(WATCH)?;
    let _router = host.router("")?;
    let mut sensor = publisher(
        &host,
        "sensor",
        "/imu",
        &[&["200", "300"][..], &QOS].concat(),
    )?;
    let mut one = subscription(&host, "one", "/imu", &QOS)?;
    sensor.wait_for("matched", PATIENCE)?;
    publish(&mut sensor, 100, 100)?;
    agent.scrape_until("both nodes", |page| page.sum("ros2_nodes", &[]) == 2.0)?;
    let all = || -> Result<[String; 3]> {
        Ok([
            host.rp(&["topic", "list", "-t"])?,
            host.rp(&["topic", "info", "-v", "/imu"])?,
            host.rp(&["node", "info", "/one"])?,
        ])
    };
    let before = all()?;
    ensure!(before[1].contains("Node name: one"), "{}", before[1]);
    agent.process.terminate()?;
    publish(&mut sensor, 100, 200)?;

    let agent = host.agent(WATCH)?;
    ensure!(all()? == before, "{:#?}", all()?);
    // The agent recognizes a connection that is older than itself after some batches.
    publish(&mut sensor, 50, 250)?;
    let logged = settled_log(&mut one)?.received;
    let delivered_before = delivered(&agent, "/imu", "/one")?.received;
    let counted_before = messages(&agent, "/imu")?;
    ensure!(delivered_before >= 40, "{delivered_before}");
    publish(&mut sensor, 1000, 1250)?;
    let mut log = settled_log(&mut one)?;
    ensure!(log.received - logged == 1000, "{log:?}");
    log.received = delivered_before + 1000;
    agrees(&agent, "/imu", "/one", log)?;
    let counted = messages(&agent, "/imu")? - counted_before;
    ensure!(counted == 1000.0, "{counted}");
    let page = agent.scrape()?;
    ensure!(page.sum("ros2_unknown_writer_messages_total", &[]) == 0.0);
    ensure!(page.sum("ros2probe_zenoh_routers", &[]) <= 1.0);
    Ok(())
}
