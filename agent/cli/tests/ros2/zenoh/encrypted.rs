//! Sessions over TLS and QUIC: the agent reports unreadable connections, and counts inside the
//! processes.

use std::process::{Command, Stdio};

use anyhow::{Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;

use crate::counting::{PATIENCE, WATCH, publish, settled_log};
use crate::host::{Host, Middleware};
use crate::installed;

const UNSEEN: &str = "ros2probe_zenoh_unseen_connections";
const TOPIC: [(&str, &str); 1] = [("topic", "/imu")];

/// A router, a publisher and a subscription that encrypt.
struct Robot {
    _router: Process,
    sensor: Process,
    one: Process,
}

impl Robot {
    fn start(host: &Host<'_>, protocol: &str) -> Result<Self> {
        let (key, certificate) = (host.path("key.pem"), host.path("certificate.pem"));
        let made = Command::new("openssl")
            .args("req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=robot".split(' '))
            .args(["-addext", "subjectAltName=DNS:localhost"])
            .args(["-addext", "basicConstraints=critical,CA:FALSE"])
            .args(["-keyout", &key, "-out", &certificate])
            .output()?;
        ensure!(made.status.success(), "{made:?}");
        let identity = format!(
            r#"transport/link/tls={{"root_ca_certificate":"{certificate}","listen_private_key":"{key}","listen_certificate":"{certificate}"}}"#
        );
        let router = host.router(&format!(
            r#"{identity};listen/endpoints=["{protocol}/[::]:7447"]"#
        ))?;
        let settings = format!(
            r#"{identity};connect/endpoints=["{protocol}/localhost:7447"];listen/endpoints=["{protocol}/localhost:0"]"#
        );
        let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2");
        let python = installed::python();
        let line = format!(
            "export ZENOH_CONFIG_OVERRIDE='{settings}'; exec {python} {directory}/counting.py \"$@\""
        );
        let publish = "publish sensor /imu 1000 300 2000 RELIABLE";
        let subscribe = "subscribe one /imu 2000 RELIABLE";
        let start = |words: &str| {
            let words: Vec<&str> = words.split(' ').collect();
            host.run(&line, &words, Stdio::inherit())
        };
        let mut one = start(subscribe)?;
        one.wait_for("ready", PATIENCE)?;
        let mut sensor = start(publish)?;
        sensor.wait_for("matched", PATIENCE)?;
        Ok(Self {
            _router: router,
            sensor,
            one,
        })
    }
}

// Coverage: Zenoh over TLS, with `capture.inside` | rmw_zenoh | installed | counted
#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn connections_over_tls_are_reported_and_their_messages_counted_inside() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent_inside(WATCH)?;
    let mut robot = Robot::start(&host, "tls")?;
    // Only the connections to port 7447 are recognized.
    agent.scrape_until("both connections to the router", |page| {
        page.sum(UNSEEN, &[("reason", "tls")]) == 2.0
    })?;
    publish(&mut robot.sensor, 5000, 5000)?;
    let log = settled_log(&mut robot.one)?;
    let inside = [TOPIC[0], ("source", "inside")];
    let page = agent.scrape_until("the messages are counted inside", |page| {
        page.sum("ros2_topic_messages_total", &TOPIC) >= 5000.0
            && page.sum("ros2_topic_source_info", &inside) == 1.0
    })?;
    let counted = |what: &str| page.sum(&format!("ros2_topic_inside_{what}_total"), &TOPIC);
    let counted = (counted("published_messages"), counted("taken_messages"));
    ensure!(counted == (5000.0, log.received as f64), "{counted:?}");
    ensure!(page.sum("ros2_topic_messages_total", &TOPIC) == 5000.0);
    let printed = host.rp(&["doctor", "--json"])?;
    let sentence = "2 connections of Zenoh encrypted with TLS cannot be read; messages are";
    ensure!(printed.contains(sentence), "{printed}");
    drop(robot);
    agent.scrape_until("the connections have ended", |page| {
        page.sum(UNSEEN, &[]) == 0.0
    })?;
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn connections_over_quic_are_reported() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = host.agent(WATCH)?;
    let mut robot = Robot::start(&host, "quic")?;
    publish(&mut robot.sensor, 100, 100)?;
    ensure!(settled_log(&mut robot.one)?.received == 100);
    // Connections between two addresses count as one, because their ends are not visible.
    let page = agent.scrape_until("the connections", |page| {
        page.sum(UNSEEN, &[("reason", "quic")]) == 1.0
    })?;
    ensure!(page.sum("ros2_topic_messages_total", &TOPIC) == 0.0);
    let printed = host.rp(&["doctor", "--json"])?;
    ensure!(printed.contains("encrypted with QUIC"), "{printed}");
    Ok(())
}
