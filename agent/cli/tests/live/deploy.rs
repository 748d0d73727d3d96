//! Claims of `deploy/` about running systems that need no container engine. An agent confined as in
//! the DaemonSet sees its whole node. A robot's Prometheus delivers the samples of an outage.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, at_the_sockets_of};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::prometheus::{Kind, Prometheus};
use serde::Deserialize as _;
use serde_yaml::Value;

/// An empty capability set, as /proc shows it.
const NO_CAPABILITIES: &str = "0000000000000000";
const OUTAGE: Duration = Duration::from_secs(8);
/// Maximum gap between samples of a scrape per second, in seconds, on a busy machine.
const GAP: f64 = 7.5;

/// The runtime's seccomp filter and its own setup of the confinement are not covered.
#[test]
fn an_agent_confined_by_the_daemon_set_sees_the_whole_node() -> Result<()> {
    let node = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let file = |name: &str| -> PathBuf { directory.path().join(name) };
    let manifest = std::fs::read_to_string(deploy().join("kubernetes/ros2probe.yaml"))?;
    let documents: Vec<Value> = serde_yaml::Deserializer::from_str(&manifest)
        .map(Value::deserialize)
        .collect::<Result<_, _>>()?;
    let of_kind = |kind: &str| documents.iter().find(|each| each["kind"] == kind);
    let map = of_kind("ConfigMap").context("no ConfigMap")?;
    let set = of_kind("DaemonSet").context("no DaemonSet")?;
    let text = map["data"]["ros2probe.yaml"].as_str().context("no file")?;
    let cgroup = file("cgroup").display().to_string();
    ensure!(text.contains("/host/cgroup"), "{text}");
    std::fs::write(
        file("ros2probe.yaml"),
        text.replace("/host/cgroup", &cgroup),
    )?;
    let container = &set["spec"]["template"]["spec"]["containers"][0];
    let added = container["securityContext"]["capabilities"]["add"].as_sequence();
    let added = added
        .context("no capabilities")?
        .iter()
        .filter_map(Value::as_str);
    let only: String = added
        .map(|name| format!(",+{}", name.to_lowercase()))
        .collect();

    // The script confines the agent as a container runtime does. The agent has its own view of
    // control groups, beside a mount of the node's hierarchy, and can write only its state.
    let own = harness::cgroup::hierarchy()?;
    let own = own.display();
    let script = format!(
        "#!/bin/sh\nset -e\n\
         [ \"$1\" = inside ] || exec unshare --mount --cgroup \"$0\" inside \"$@\"\nshift\n\
         mount --bind -o ro {own} {cgroup}\nmount -o remount,bind,ro {cgroup}\n\
         umount --lazy {own}\nmount -t cgroup2 -o ro none {own}\n\
         mount -t tmpfs tmpfs {state}\nexport STATE_DIRECTORY={state}\n\
         mount -o remount,bind,ro /\n\
         exec setpriv --no-new-privs --inh-caps -all{only} --bounding-set -all{only} {rp} \"$@\"\n",
        state = file("state").display(),
        rp = env!("CARGO_BIN_EXE_rp"),
    );
    std::fs::write(file("start"), script)?;
    std::fs::set_permissions(file("start"), Permissions::from_mode(0o755))?;
    std::fs::create_dir(file("cgroup"))?;
    std::fs::create_dir(file("state"))?;
    let agent = Agent::start(&node, file("start"), &file("ros2probe.yaml"))?;

    let page = agent.scrape()?;
    for ability in ["containers", "owners", "sent", "socket_losses"] {
        let able = page.value("ros2probe_capture_ability", &[("ability", ability)]);
        ensure!(able == Some(1.0), "{ability}: {able:?}");
    }
    let failed = page.value("ros2probe_state_writes_total", &[("outcome", "failed")]);
    ensure!(failed == Some(0.0), "{failed:?}");
    let status = std::fs::read_to_string(format!("/proc/{}/status", agent.process.pid()))?;
    for line in [
        format!("CapEff:\t{NO_CAPABILITIES}"),
        format!("CapPrm:\t{NO_CAPABILITIES}"),
        "NoNewPrivs:\t1".to_owned(),
    ] {
        ensure!(
            status.lines().any(|other| other == line),
            "{line} in\n{status}"
        );
    }
    Ok(())
}

#[test]
fn samples_of_an_outage_arrive_when_the_link_returns() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, at_the_sockets_of(&link.robot))?;
    let agent = Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    // The configurations are the shipped ones, with other addresses and shorter scrape intervals.
    let server = std::fs::read_to_string(deploy().join("prometheus/prometheus.yaml"))?;
    let rules = deploy().join("../dashboards/rules");
    let server = server.replace("/etc/ros2probe/rules", &rules.display().to_string());
    let server = Prometheus::run(&link.monitor, Kind::Server, &server)?;
    let token = directory.path().join("token");
    std::fs::write(&token, "secret")?;
    let pushing = std::fs::read_to_string(deploy().join("fleet/prometheus-agent.yaml"))?;
    let pushing = [
        (
            "https://metrics.example",
            format!("http://{}:9090", link.monitor.address()),
        ),
        ("/etc/prometheus/token", token.display().to_string()),
        ("scrape_interval: 5s", "scrape_interval: 1s".to_owned()),
    ]
    .into_iter()
    .try_fold(pushing, |text, (shipped, here)| {
        ensure!(text.contains(shipped), "{shipped} is not in it");
        Ok(text.replace(shipped, &here))
    })?;
    let pushing = Prometheus::run(&link.robot, Kind::Agent, &pushing)?;

    let series = "ros2probe_ready{job=\"ros2probe\",instance=\"robot1\"}";
    server.query(series)?;
    let began = Instant::now();
    let outage = Loss::of(
        &link.robot,
        &format!("ip daddr {}", link.monitor.address()),
        1000,
    )?;
    std::thread::sleep(OUTAGE);
    let age = server.query(&format!("time() - timestamp({series})"))?;
    ensure!(age > OUTAGE.as_secs_f64() - 3.0, "not cut off: {age} s old");
    drop(outage);
    let back = SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64();
    harness::wait_until("a sample of the link that is back", || {
        Ok(server.query(&format!("timestamp({series})"))? >= back)
    })?;
    let window = began.elapsed().as_secs() + 1;
    let times = server.times(&format!("{series}[{window}s]"))?;
    let gaps = times.windows(2).map(|pair| pair[1] - pair[0]);
    let widest = gaps.fold(0.0, f64::max);
    ensure!(
        times.len() > 5 && widest < GAP,
        "{widest} s without a sample in {times:?}"
    );
    drop((agent, pushing));
    Ok(())
}

fn deploy() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy")
}
