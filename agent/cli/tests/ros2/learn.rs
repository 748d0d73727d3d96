//! `rp learn` beside the talker and the listener of ROS 2. They meet the watchlist, and without the
//! listener, they only lack its endpoints.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::Scrape;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::{run, wait_until};

use crate::host::{Host, Middleware, RP};
use crate::installed;

const VIOLATED: &str = "ros2_watch_expectation_violated";
/// Time to learn: more than the 20 s with a publisher that the numbers of endpoints need.
const LEARNS: Duration = Duration::from_secs(40);

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, demo_nodes_cpp: make test-ros2"]
fn fast_dds_with_shared_memory_violates_no_expectation_learnt_from_it() -> Result<()> {
    check_learnt(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp, demo_nodes_cpp: make test-ros2"]
fn cyclone_dds_violates_no_expectation_learnt_from_it() -> Result<()> {
    check_learnt(Middleware::Cyclone)
}

fn check_learnt(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let agent = host.agent("")?;
    let node = |name: &str| {
        let prefix = installed::prefix();
        let line = format!("exec {}/lib/demo_nodes_cpp/{name}", prefix.display());
        host.run(&line, &[], Stdio::null())
    };
    let mut listener = node("listener")?;
    let _talker = node("talker")?;
    agent.scrape_until("talking", |page| {
        let endpoints = |kind| page.sum(kind, &[("topic", "/chatter")]);
        endpoints("ros2_topic_publishers") == 1.0 && endpoints("ros2_topic_subscriptions") == 1.0
    })?;

    let learning = Command::new(RP)
        .env_remove("ROS_DOMAIN_ID")
        .args(["learn", "--socket"])
        .arg(host.socket())
        .arg("-o")
        .arg(host.file("watchlist.yaml"))
        .stdin(Stdio::null())
        .spawn()?;
    std::thread::sleep(LEARNS);
    run(&format!("kill -INT {}", learning.id()))?;
    ensure!(learning.wait_with_output()?.status.success());
    let learnt = fs::read_to_string(host.file("watchlist.yaml"))?;
    fs::write(host.file("ros2probe.yaml"), host.settings(&learnt))?;
    agent.process.signal("HUP")?;
    let is_violated = |page: &Scrape, topic: &str, expectation: &str| {
        page.value(VIOLATED, &[("topic", topic), ("expectation", expectation)])
    };
    agent.scrape_until("the watchlist", |page| {
        let keys = ["min_rate_hz", "max_silence_s", "publishers", "subscribers"];
        let mut keys = keys.into_iter();
        keys.all(|key| is_violated(page, "/chatter", key).is_some())
    })?;
    std::thread::sleep(Duration::from_secs(15));
    let violated = agent.scrape()?.sum(VIOLATED, &[]);
    ensure!(violated == 0.0, "{violated} of {learnt}");

    listener.signal("INT")?;
    listener.wait(Duration::from_secs(30))?;
    wait_until("the listener is missed", || {
        let page = agent.scrape()?;
        let is_missed = |topic, key| is_violated(&page, topic, key) == Some(1.0);
        Ok(is_missed("/chatter", "subscribers") && is_missed("/rosout", "publishers"))
    })?;
    std::thread::sleep(Duration::from_secs(10));
    let page = agent.scrape()?;
    let of_chatter = page.sum(VIOLATED, &[("topic", "/chatter")]);
    ensure!(of_chatter == 1.0, "{of_chatter} of {learnt}");
    Ok(())
}
