//! Peers that send images as Lyrical does: on topics of their own, which the nodes do not announce.
//! Needs root.

use crate::browser::PAGE;
use crate::browser::player::watch;
use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape, datagrams_alone_of, get};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{self, Peer, Role, Stack, Stream};
use ros2probe_testing::harness::wait_until;
use serde_json::Value;
use tempfile::TempDir;

const TOPIC: &str = "/points";

fn start<'a>(host: &'a Namespace, directory: &TempDir) -> Result<Agent<'a>> {
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: [/**]\n{}", datagrams_alone_of(host)))?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)
}

/// Point clouds whose endpoints accept this backend; `None` for endpoints without buffers.
fn stream(buffers: Option<&'static str>) -> Stream {
    Stream {
        reliable: true,
        stretch: 40,
        linger: 60.0,
        buffers,
        ..Stream::point_cloud(70_000, 80)
    }
}

fn subscriber(host: &Namespace, stack: Stack, node: &str, stream: &Stream) -> Result<Peer> {
    let mut peer = Peer::start(host, stack, Role::Subscriber, stream, &[node])?;
    peer.wait_matched()?;
    Ok(peer)
}

/// Returns messages, delivered and lost ones.
fn counts(page: &Scrape) -> [u64; 3] {
    ["messages", "delivered_messages", "lost_messages"].map(|what| {
        let name = format!("ros2_topic_{what}_total");
        page.sum(&name, &[("topic", TOPIC)]) as u64
    })
}

fn topic(host: &Namespace) -> Result<Value> {
    let text = get(host, &format!("http://127.0.0.1:17401/topics{TOPIC}"))?;
    Ok(serde_json::from_str(&text)?)
}

/// Lets the publisher send a stretch, and waits until this subscriber has all of it.
fn send(publisher: &mut Peer, subscriber: &Peer, all: usize) -> Result<()> {
    publisher.start_sending()?;
    received(subscriber, all)
}

/// Waits until a subscriber has this many messages or references.
fn received(subscriber: &Peer, all: usize) -> Result<()> {
    wait_until("all messages arrived", || {
        Ok(subscriber.log()?.sequences("sub").len() == all)
    })
}

// Coverage: buffer topics, cpu | Fast DDS 2.9 | as Lyrical | exact
#[test]
fn messages_of_a_cpu_topic_of_fast_dds_have_publisher_node_and_receiver() -> Result<()> {
    let (host, directory) = (Namespace::isolated()?, tempfile::tempdir()?);
    let agent = start(&host, &directory)?;
    let stream = stream(Some("cpu"));
    let mut publisher = Peer::start(&host, Stack::Fast, Role::Publisher, &stream, &["/camera"])?;
    let receiver = subscriber(&host, Stack::Fast, "/detector", &stream)?;
    publisher.wait_matched()?;
    send(&mut publisher, &receiver, 40)?;
    send(&mut publisher, &receiver, 80)?;
    let page = agent.settled_scrape(TOPIC, 80)?;
    assert_eq!(counts(&page), [80, 80, 0]);
    let topic = topic(&host)?;
    let endpoints = |side: &str| topic[side].as_array().cloned().context("no endpoints");
    let (publishers, subscriptions) = (endpoints("publishers")?, endpoints("subscriptions")?);
    ensure!(publishers.len() == 1 && subscriptions.len() == 1, "{topic}");
    assert_eq!(publishers[0]["node"], "/camera");
    assert_eq!(publishers[0]["measurement"]["messages"], 80);
    assert_eq!(publishers[0]["backends"], serde_json::json!(["cpu"]));
    let deliveries = endpoints("deliveries")?;
    ensure!(
        deliveries
            .iter()
            .any(|each| each["nodes"][0] == "/detector"),
        "{topic}"
    );
    Ok(())
}

/// Starts a publisher of Zenoh with buffers of the backend `cuda`.
fn camera(host: &Namespace) -> Result<Peer> {
    let stream = stream(Some("cuda"));
    Peer::start(host, Stack::Zenoh, Role::Publisher, &stream, &["/camera"])
}

// Coverage: buffer topics, cpu | Zenoh 1.10 | as Lyrical | exact
#[test]
fn zenoh_messages_with_buffers_count_once_for_all_subscriptions() -> Result<()> {
    let (host, directory) = (Namespace::isolated()?, tempfile::tempdir()?);
    let agent = start(&host, &directory)?;
    let _router = peer::router(&host, &[])?;
    let mut publisher = camera(&host)?;
    let receiver = subscriber(&host, Stack::Zenoh, "/detector", &stream(Some("cpu")))?;
    publisher.wait_matched()?;
    send(&mut publisher, &receiver, 40)?;
    let page = agent.settled_scrape(TOPIC, 40)?;
    assert_eq!(counts(&page), [40, 40, 0]);
    // A second subscription gets references to buffers beside the messages.
    let accelerated = subscriber(&host, Stack::Zenoh, "/tracker", &stream(Some("cuda")))?;
    let knows =
        |page: &Scrape| page.value("ros2_topic_subscriptions", &[("topic", TOPIC)]) == Some(2.0);
    agent.scrape_until("both subscriptions", knows)?;
    send(&mut publisher, &receiver, 80)?;
    received(&accelerated, 40)?;
    let page = agent.settled_scrape(TOPIC, 80)?;
    assert_eq!(counts(&page), [80, 80, 0]);
    assert_eq!(topic(&host)?["publishers"][0]["node"], "/camera");
    watch(&host.outside(), "buffers", &[PAGE])
}

// Coverage: buffer topics, references | Zenoh 1.10 | as Lyrical | counted
#[test]
fn references_alone_count_and_a_subscription_without_buffers_is_named() -> Result<()> {
    let (host, directory) = (Namespace::isolated()?, tempfile::tempdir()?);
    let agent = start(&host, &directory)?;
    let _router = peer::router(&host, &[])?;
    let mut publisher = camera(&host)?;
    let accelerated = subscriber(&host, Stack::Zenoh, "/tracker", &stream(Some("cuda")))?;
    publisher.wait_matched()?;
    send(&mut publisher, &accelerated, 40)?;
    let page = agent.settled_scrape(TOPIC, 40)?;
    assert_eq!(counts(&page), [40, 40, 0]);
    let plain = subscriber(&host, Stack::Zenoh, "/viewer", &stream(None))?;
    let found = |page: &Scrape| page.sum("ros2_diagnoses", &[("kind", "buffers_by_cpu")]) == 1.0;
    agent.scrape_until("the finding", found)?;
    send(&mut publisher, &accelerated, 80)?;
    received(&plain, 40)?;
    let page = agent.settled_scrape(TOPIC, 80)?;
    assert_eq!(counts(&page), [80, 120, 0]);
    Ok(())
}
