//! A pipeline of real nodes of ROS 2: a sensor, a filter that sleeps, a controller, and a node that
//! re-stamps. The hops agree with the nodes' logs, live and in a capture of the same run.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::collections::HashMap;
use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_api::chains::{Chain, ChainList};
use ros2probe_testing::harness::capture::{Capture, SETTLE};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::wait_until;
use serde::Deserialize;

use crate::host::{Host, Middleware, RP};

const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum difference between the agent's and the nodes' median of a hop, in seconds.
const CLOSE: f64 = 0.000_2;
/// Number of messages that have to pass the pipeline.
const MESSAGES: u64 = 200;
/// Name of a node, its input and output, its duration in milliseconds, and its stamps. The last two
/// nodes only subscribe, because a message without a subscription is not sent.
const STAGES: [[&str; 5]; 5] = [
    ["filter", "/points", "/filtered", "12", "keep"],
    ["controller", "/filtered", "/cmd", "3", "keep"],
    ["restamper", "/points", "/fresh", "6", "now"],
    ["motor", "/cmd", "/motor", "0", "keep"],
    ["viewer", "/fresh", "/picture", "0", "keep"],
];

/// A line of a node's log, in nanoseconds.
#[derive(Deserialize)]
struct Logged {
    stamp: [i64; 2],
    /// Beginning of the callback.
    #[serde(default)]
    started: i64,
    /// Times before and after the call that publishes, between which a message leaves.
    published: i64,
    after: i64,
}

type Log = HashMap<[i64; 2], Logged>;

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn hops_over_cyclone_dds_have_the_durations_that_the_nodes_log() -> Result<()> {
    agrees_with_the_nodes(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn hops_over_fast_dds_and_udp_have_the_durations_that_the_nodes_log() -> Result<()> {
    agrees_with_the_nodes(Middleware::FastUdp)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn hops_over_shared_memory_with_the_uprobe_have_the_durations_that_the_nodes_log() -> Result<()> {
    agrees_with_the_nodes(Middleware::FastExact("uprobe"))
}

fn agrees_with_the_nodes(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let capture = host.file("chain.pcap");
    let recorded = matches!(middleware, Middleware::Cyclone | Middleware::FastUdp);
    let tcpdump = recorded
        .then(|| Capture::start_on(&network, "any", &capture))
        .transpose()?;
    let agent =
        host.agent("watch: [/fresh]\nchains: [{from: /points, to: /cmd, max_latency_ms: 10}]\n")?;
    let mut nodes = Vec::new();
    for [name, input, output, milliseconds, stamps] in STAGES {
        let log = host.path(&format!("{name}.jsonl"));
        let arguments = ["node", name, input, output, milliseconds, stamps, &log];
        let mut node = host.python("chains.py", &arguments)?;
        node.wait_for("ready", PATIENCE)?;
        nodes.push(node);
    }
    let log = host.path("sensor.jsonl");
    let mut sensor = host.python("chains.py", &["sensor", "/points", "20", &log])?;
    sensor.wait_for("ready", PATIENCE)?;
    let socket = host.socket();
    let ask = |arguments: &[&str]| chains(arguments, &["--socket", &socket]);
    let mut live = ChainList::default();
    let waited = wait_until("the chain has enough messages", || {
        live = ask(&["/points", "/cmd"])?;
        Ok(live
            .chains
            .first()
            .is_some_and(|chain| chain.messages >= MESSAGES))
    });
    waited.with_context(|| format!("{live:?}"))?;
    let page = agent.scrape_until("the slow chain and the new stamps are found", |page| {
        ["slow_chain", "restamping_node"]
            .iter()
            .all(|kind| page.sum("ros2_diagnoses", &[("kind", kind)]) == 1.0)
    })?;
    ensure!(page.sum("ros2_chain_state", &[("state", "slow")]) == 1.0);
    drop(sensor);
    drop(nodes);
    compare(&host, &live, "live")?;
    let all = ask(&[])?;
    ensure!(all.chains.len() == 1, "{:?}", all.chains);
    if let Some(tcpdump) = tcpdump {
        std::thread::sleep(SETTLE);
        let file = tcpdump.finish()?;
        if let Some(keep) = std::env::var_os("ROS2PROBE_KEEP_CAPTURE") {
            keep_run(&host, &file, Path::new(&keep))?;
        }
        let replayed = chains(
            &["/points", "/cmd"],
            &["--replay", &host.path("chain.pcap")],
        )?;
        compare(&host, &replayed, "replayed")?;
    }
    Ok(())
}

/// Copies the capture and the logs, to use them as test data.
fn keep_run(host: &Host<'_>, capture: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to)?;
    fs::copy(capture, to.join("capture.pcap"))?;
    for name in ["sensor", "filter", "controller", "restamper"] {
        let log = format!("{name}.jsonl");
        fs::copy(host.file(&log), to.join(&log))?;
    }
    Ok(())
}

/// Returns the answer of `rp chain --json`.
fn chains(arguments: &[&str], target: &[&str]) -> Result<ChainList<'static>> {
    let output = std::process::Command::new(RP)
        .arg("chain")
        .args(arguments)
        .arg("--json")
        .args(target)
        .env_remove("ROS_DOMAIN_ID")
        .output()?;
    let text = String::from_utf8(output.stdout)?;
    serde_json::from_str(&text)
        .with_context(|| String::from_utf8_lossy(&output.stderr).into_owned())
}

/// Compares the medians of each hop and of the chain with the nodes' logs.
fn compare(host: &Host<'_>, list: &ChainList<'_>, what: &str) -> Result<()> {
    let [chain] = &list.chains[..] else {
        anyhow::bail!("{what}: {:?}", list.chains);
    };
    let nodes: Vec<_> = chain.hops.iter().map(|hop| hop.node.as_deref()).collect();
    ensure!(nodes == [Some("/filter"), Some("/controller")], "{nodes:?}");
    ensure!(chain.source.as_deref() == Some("/sensor"));
    ensure!(chain.bottleneck == Some(0), "{:?}", chain.bottleneck);
    let names = ["sensor", "filter", "controller"];
    let logs = names.map(|name| log(&host.file(&format!("{name}.jsonl"))));
    let [sensor, filter, controller] = logs;
    let (sensor, filter, controller) = (sensor?, filter?, controller?);
    let published = |each: &Logged| each.published;
    let after = |each: &Logged| each.after;
    let started = |each: &Logged| each.started;
    let ends = [
        (
            "filter",
            &sensor,
            &filter,
            chain.hops[0].latency.p50_seconds,
        ),
        (
            "controller",
            &filter,
            &controller,
            chain.hops[1].latency.p50_seconds,
        ),
        ("whole", &sensor, &controller, chain.latency.p50_seconds),
    ];
    for (name, input, output, agent) in ends {
        let logged = median(input, published, output, published)?;
        let least = median(input, after, output, published)?;
        let most = median(input, published, output, after)?;
        println!(
            "{what}, {name}: agent {agent:.6} s, nodes {logged:.6} s ({least:.6} to {most:.6} s)"
        );
        // A message leaves at any time within the call that publishes, which is long on a busy
        // machine.
        let close = CLOSE.max((most - least) / 2.0);
        ensure!(
            (least..most).contains(&agent) && (agent - logged).abs() < close,
            "{what}, {name}: {agent}, not {logged} ({least} to {most})"
        );
    }
    for (place, log) in [(0, &filter), (1, &controller)] {
        parts(chain, place, median(log, started, log, published)?, what)?;
    }
    Ok(())
}

/// Checks that the node's part contains its callback, and the wait before the callback.
fn parts(chain: &Chain<'_>, place: usize, callback: f64, what: &str) -> Result<()> {
    let hop = &chain.hops[place];
    let (Some(transit), Some(node)) = (hop.transit, hop.processing) else {
        println!("{what}, hop {place}: no parts, callback {callback:.6} s");
        return Ok(());
    };
    let (transit, node) = (transit.p50_seconds, node.p50_seconds);
    println!("{what}, hop {place}: transit {transit:.6}, node {node:.6}, callback {callback:.6}");
    ensure!(
        node > callback - CLOSE && node < callback + 0.005,
        "{node} {callback}"
    );
    ensure!(transit < 0.005, "{transit}");
    Ok(())
}

fn log(path: &Path) -> Result<Log> {
    let text = fs::read_to_string(path)?;
    let lines = text
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok());
    Ok(lines.map(|line: Logged| (line.stamp, line)).collect())
}

/// Returns the median time between two moments of the same measurement, in seconds.
fn median(
    input: &Log,
    from: fn(&Logged) -> i64,
    output: &Log,
    to: fn(&Logged) -> i64,
) -> Result<f64> {
    let both = output
        .iter()
        .filter_map(|(stamp, line)| Some((input.get(stamp)?, line)));
    let times = both.map(|(input, output)| to(output) - from(input));
    let mut times: Vec<_> = times.collect();
    times.sort_unstable();
    let middle = times.get(times.len() / 2).context("no common stamp")?;
    Ok(*middle as f64 / 1e9)
}
