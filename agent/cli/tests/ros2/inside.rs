//! Real processes of ROS 2, counted from inside: as many messages as the nodes count themselves,
//! over each middleware and within a process.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_api::inside::Inside;
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::{run, wait_until};

use crate::host::{Host, Middleware, RP};

const PATIENCE: Duration = Duration::from_secs(60);
const PUBLISHED: &str = "ros2_topic_inside_published_messages_total";
const TAKEN: &str = "ros2_topic_inside_taken_messages_total";
const TOPIC: [(&str, &str); 1] = [("topic", "/counted")];
/// Callbacks of the demo, by node and trigger.
const CALLBACKS: [(&str, &str); 2] = [("/talker", "timer"), ("/listener", "/chatter")];
/// Number of messages at 1 kHz before and after a change.
const MESSAGES: u64 = 3000;

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn messages_over_fast_dds_equal_the_counts_of_the_nodes() -> Result<()> {
    agrees_with_the_nodes(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn messages_over_cyclone_dds_equal_the_counts_of_the_nodes() -> Result<()> {
    agrees_with_the_nodes(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn messages_over_zenoh_equal_the_counts_of_the_nodes() -> Result<()> {
    agrees_with_the_nodes(Middleware::Zenoh)
}

/// Compares the counts with those of the nodes. The subscription runs before the agent, and the
/// publisher starts after it. Then the publisher is killed and replaced, and finally the agent is
/// killed.
fn agrees_with_the_nodes(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let router = (middleware == Middleware::Zenoh).then(|| host.router(""));
    let router = router.transpose()?;
    let mut subscription = host.python("inside.py", &["subscribe"])?;
    subscription.wait_for("ready", PATIENCE)?;
    let mut agent = agent(&host)?;
    let mut sent = 0;
    for _ in 0..2 {
        let mut publisher = publisher(&host)?;
        publish(&mut publisher, MESSAGES)?;
        sent += MESSAGES;
        received(&mut subscription, sent)?;
        publisher.signal("KILL")?;
        let page = agent.scrape_until("all messages are counted", |page| {
            page.sum(PUBLISHED, &TOPIC) >= sent as f64 && page.sum(TAKEN, &TOPIC) >= sent as f64
        })?;
        let counted = (page.sum(PUBLISHED, &TOPIC), page.sum(TAKEN, &TOPIC));
        ensure!(
            counted == (sent as f64, sent as f64),
            "{counted:?} of {sent}"
        );
        publisher.wait(PATIENCE)?;
    }
    if middleware == Middleware::Zenoh {
        let page = agent.scrape()?;
        let wire = [("topic", "/counted"), ("source", "wire")];
        ensure!(page.sum("ros2_topic_source_info", &wire) == 1.0);
        ensure!(page.sum("ros2_topic_messages_total", &TOPIC) == sent as f64);
    }
    let mut publisher = publisher(&host)?;
    agent.process.signal("KILL")?;
    agent.process.wait(PATIENCE)?;
    publish(&mut publisher, 500)?;
    received(&mut subscription, sent + 500)?;
    drop(router);
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, intra_process_demo: make test-ros2"]
fn receptions_within_a_process_equal_the_number_that_the_demo_prints() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::FastExact("auto"))?;
    let agent = agent(&host)?;
    let line = "exec timeout -s INT 12 ros2 run intra_process_demo two_node_pipeline > $1 2>&1";
    let log = host.path("demo.log");
    let mut demo = host.run(line, &[&log], Stdio::inherit())?;
    demo.wait(PATIENCE)?;
    let log = std::fs::read_to_string(host.file("demo.log"))?;
    let printed = log.matches("Received message with value").count();
    ensure!(printed >= 8, "{log}");
    let number = [("topic", "/number")];
    let name = "ros2_intra_process_received_messages_total";
    let page = agent.scrape_until("the receptions are counted", |page| {
        page.sum(name, &number) >= printed as f64
    })?;
    ensure!(
        page.sum(name, &number) == printed as f64,
        "{printed} printed"
    );
    // None of it is on the network. A reception counts as a message one report later.
    let messages = "ros2_topic_messages_total";
    let page = agent.scrape_until("the messages are counted", |page| {
        page.sum(messages, &number) >= printed as f64
    })?;
    ensure!(page.sum(messages, &number) == printed as f64);
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, demo_nodes_cpp: make test-ros2"]
fn callbacks_have_the_period_of_their_timer_and_the_name_of_their_node() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Cyclone)?;
    // The talker runs before the agent, the listener starts after it.
    let talk = "exec ros2 run demo_nodes_cpp talker > $1 2>&1";
    let _talker = host.run(talk, &[&host.path("talker.log")], Stdio::inherit())?;
    let talks = || {
        let log = std::fs::read_to_string(host.file("talker.log")).unwrap_or_default();
        Ok(log.contains("Publishing"))
    };
    wait_until("the talker publishes", talks)?;
    let agent = agent(&host)?;
    let listen = "exec ros2 run demo_nodes_cpp listener > $1 2>&1";
    let _listener = host.run(listen, &[&host.path("listener.log")], Stdio::inherit())?;
    let mut found = Vec::new();
    wait_until("both callbacks are shown", || {
        let text = run(&format!("{RP} inside --json --socket {}", host.socket()))?;
        let inside: Inside<'_> = serde_json::from_str(&text)?;
        let callbacks = inside
            .callbacks
            .iter()
            .filter(|callback| callback.calls >= 3);
        found = callbacks
            .map(|callback| {
                let node = callback.owner.node.as_deref().unwrap_or_default();
                let wait = callback.wait.map_or(f64::MAX, |wait| wait.p50_seconds);
                (node.to_owned(), callback.trigger.words(), wait)
            })
            .collect();
        let is_found = |(node, trigger): &(&str, &str)| {
            let mut found = found.iter();
            found.any(|(of, what, _): &(String, String, f64)| of == node && what.contains(trigger))
        };
        Ok(CALLBACKS.iter().all(is_found))
    })?;
    for (node, trigger) in CALLBACKS {
        let callback = found
            .iter()
            .find(|(of, what, _)| of == node && what.contains(trigger));
        let (_, what, wait) = callback.with_context(|| format!("{node}: {found:?}"))?;
        ensure!(node != "/talker" || what.contains("1"), "{what}");
        // The clocks of kernel and process are compared, since a wrong one leads to a long wait.
        ensure!(*wait < 0.05, "{node}: {wait}");
    }
    drop(agent);
    Ok(())
}

fn agent<'n>(host: &Host<'n>) -> Result<Agent<'n>> {
    let lines = "watch: [/counted, /number]\n";
    host.agent_inside(lines)
}

fn publisher(host: &Host<'_>) -> Result<Process> {
    let mut publisher = host.python("inside.py", &["publish"])?;
    publisher.wait_for("matched", PATIENCE)?;
    Ok(publisher)
}

fn publish(publisher: &mut Process, messages: u64) -> Result<()> {
    publisher.write_line(&messages.to_string())?;
    publisher.wait_for(&format!("published {messages}"), PATIENCE)
}

/// Waits until the subscription has this many messages.
fn received(subscription: &mut Process, messages: u64) -> Result<()> {
    for _ in 0..100 {
        subscription.write_line("count")?;
        let wait = Duration::from_millis(200);
        if subscription
            .wait_for(&format!("received {messages}"), wait)
            .is_ok()
        {
            return Ok(());
        }
    }
    bail!("the subscription has not received {messages} messages")
}
