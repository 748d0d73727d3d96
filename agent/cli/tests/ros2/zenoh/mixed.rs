//! A robot with nodes of DDS and of Zenoh on one topic: both are in one graph, and their messages
//! are counted separately.

use std::collections::BTreeMap;

use anyhow::{Result, ensure};
use ros2probe_api::topics::TopicDetails;
use ros2probe_testing::harness::agent::get;
use ros2probe_testing::harness::network::Namespace;

use crate::counting::{
    PATIENCE, WATCH, agrees, messages, publish, publisher, settled_log, subscription,
};
use crate::host::{Host, Middleware};

const TOPIC: &str = "/imu";
const RATE: [&str; 4] = ["200", "300", "2000", "BEST_EFFORT"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp, rmw_cyclonedds_cpp: make test-ros2"]
fn nodes_of_dds_and_zenoh_are_in_one_graph_and_counted_separately() -> Result<()> {
    let network = Namespace::isolated()?;
    let zenoh = Host::new(&network, Middleware::Zenoh)?;
    let dds = Host::new(&network, Middleware::Cyclone)?;
    let agent = zenoh.agent(WATCH)?;
    let _router = zenoh.router("")?;
    let mut robots = Vec::new();
    for (host, name, reliability, count) in [
        // Zenoh also delivers to a reliable subscription.
        (&zenoh, "zenoh", "RELIABLE", 700),
        (&dds, "dds", "BEST_EFFORT", 400),
    ] {
        let listener = format!("{name}_listener");
        let listener = subscription(host, &listener, TOPIC, &["2000", reliability])?;
        let mut talker = publisher(host, &format!("{name}_talker"), TOPIC, &RATE)?;
        talker.wait_for("matched", PATIENCE)?;
        robots.push((name, talker, listener, count));
    }
    agent.scrape_until("all nodes", |page| page.sum("ros2_nodes", &[]) == 4.0)?;
    std::thread::sleep(std::time::Duration::from_secs(2));
    for (_, talker, _, count) in &mut robots {
        publish(talker, *count, *count)?;
    }
    for (name, _, listener, count) in &mut robots {
        let log = settled_log(listener)?;
        ensure!(log.received == *count, "{name}: {log:?}");
        agrees(&agent, TOPIC, &format!("/{name}_listener"), log)?;
    }
    let counted = messages(&agent, TOPIC)?;
    ensure!(counted == 1100.0, "{counted}");

    let text = get(&network, &format!("http://127.0.0.1:17401/topics{TOPIC}"))?;
    let details: TopicDetails<'_> = serde_json::from_str(&text)?;
    let topic = &details.topic;
    let publishers = topic.publishers.iter().map(|each| {
        let node = each.node.as_deref().unwrap_or_default();
        let count = each.measurement.as_ref().map_or(0, |it| it.messages);
        (node, (each.vendor.as_deref().unwrap_or_default(), count))
    });
    let expected = [
        ("/dds_talker", ("Eclipse Cyclone DDS", 400)),
        ("/zenoh_talker", ("Eclipse Zenoh", 700)),
    ];
    let publishers: BTreeMap<_, _> = publishers.collect();
    ensure!(publishers == BTreeMap::from(expected), "{publishers:?}");
    let pairs: usize = topic.passages.iter().map(|passage| passage.pairs).sum();
    ensure!(pairs == 2, "{:?}", topic.passages);
    ensure!(topic.diagnoses.is_empty(), "{:?}", topic.diagnoses);
    let delivered = topic.received.as_ref().map_or(0, |it| it.messages);
    ensure!(delivered == 1100, "{:?}", topic.received);
    Ok(())
}
