//! A viewer of the Foxglove protocol receives point clouds byte for byte.

use std::fmt::Write as _;
use std::fs;
use std::net::TcpStream;

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::viewer::{SUBPROTOCOLS, ServerMessage, open};
use sha2::{Digest as _, Sha256};

use crate::counting::{PATIENCE, publisher, subscription};
use crate::host::{Host, Middleware};

const TOPIC: &str = "/points";
const COUNT: usize = 20;
/// QoS that keeps all messages: the publisher waits while a connection is congested.
const QOS: [&str; 2] = ["0", "RELIABLE"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_viewer_receives_point_clouds_byte_for_byte() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent("watch: []\n")?;
    let _router = host.router("")?;
    let log = host.path("lidar.log");
    let arguments = [&["5", "2720000"][..], &QOS, &[&log]].concat();
    let mut lidar = publisher(&host, "lidar", TOPIC, &arguments)?;
    let _map = subscription(&host, "map", TOPIC, &QOS)?;
    lidar.wait_for("matched", PATIENCE)?;

    let stream = netns::within(&network.network(), || TcpStream::connect("127.0.0.1:8765"))??;
    let viewer = open(stream, "/", &SUBPROTOCOLS, &[])?;
    let mut viewer = viewer.map_err(|refused| anyhow::anyhow!("{refused:?}"))?;
    viewer.wait_for_topics(&[TOPIC])?;
    let id = viewer.subscribe(TOPIC)?;
    let channel = viewer.channel(TOPIC).context("no channel")?;
    ensure!(channel.schema_name == "std_msgs/msg/UInt8MultiArray");
    agent.scrape_until("the interest", |page| {
        page.sum("ros2probe_subscriptions", &[]) >= 1.0
    })?;
    lidar.write_line(&COUNT.to_string())?;
    let mut hashes = Vec::new();
    while hashes.len() < COUNT {
        match viewer.next_within(PATIENCE)?.context("no message")? {
            ServerMessage::Data(data) if data.subscription == id => {
                hashes.push(hash(&data.payload)?);
            }
            ServerMessage::Status(status) => anyhow::bail!("{}", status.message),
            _ => {}
        }
    }
    lidar.wait_for(&format!("published {COUNT}"), PATIENCE)?;
    let sent = fs::read_to_string(log)?;
    ensure!(sent.lines().eq(hashes.iter().map(String::as_str)));
    Ok(())
}

fn hash(bytes: &[u8]) -> Result<String> {
    let mut digits = String::new();
    for byte in Sha256::digest(bytes) {
        write!(digits, "{byte:02x}")?;
    }
    Ok(digits)
}
