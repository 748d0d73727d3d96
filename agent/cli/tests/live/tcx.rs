//! The agent at tcx (Linux 6.6): however it ends, no interface keeps a program, and an interface
//! that appears later is observed without any capability.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::Path;
use std::time::Duration;

use anyhow::{Result, ensure};
use ros2probe_capture::netns;
use ros2probe_capture::tcx;
use ros2probe_testing::harness::agent::{Agent, ON_THE_WIRE, get};
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::run;
use ros2probe_testing::harness::tcx::{attached, wait_attached};
use ros2probe_testing::program_run;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const WRITER: Guid = Guid::new(GuidPrefix(*b"\x01\x0flatetcxwri"), EntityId([0, 0, 1, 3]));
/// Maximum wait for the kernel or the agent.
const PATIENCE: Duration = Duration::from_secs(60);
const HEALTH: &str = "http://127.0.0.1:17401/health";
const HOOK: &str = "ros2probe_capture_wire_info";

fn start<'a>(host: &'a Namespace, directory: &Path, configuration: &str) -> Result<Agent<'a>> {
    let file = directory.join("ros2probe.yaml");
    std::fs::write(&file, configuration)?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)
}

#[test]
fn a_killed_agent_leaves_no_program_at_an_interface() -> Result<()> {
    if tcx::check().is_err() {
        return Ok(());
    }
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start(&link.robot, directory.path(), ON_THE_WIRE)?;
    let page = agent.scrape()?;
    ensure!(
        page.value(HOOK, &[("hook", "tcx"), ("reason", "")]) == Some(1.0),
        "{:?}",
        page.labels_of(HOOK, "reason")
    );
    ensure!(attached(&link.robot, INTERFACE)? == [1, 1]);
    ensure!(attached(&link.robot, "lo")? == [1, 0]);
    agent.process.signal("KILL")?;
    wait_attached(&link.robot, INTERFACE, [0, 0], PATIENCE)?;
    wait_attached(&link.robot, "lo", [0, 0], PATIENCE)
}

#[test]
fn an_interface_that_appears_later_is_observed_and_one_that_leaves_is_not() -> Result<()> {
    if tcx::check().is_err() {
        return Ok(());
    }
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    // The agent enters the other namespace, and drops all capabilities before the interfaces appear.
    let configuration = format!(
        "capture: {{source: wire, network_namespaces: [{}]}}\n",
        link.monitor.network().display()
    );
    let agent = start(&link.robot, directory.path(), &configuration)?;
    for (host, octet) in [(&link.robot, 1), (&link.monitor, 2)] {
        let name = host.name();
        let address = Ipv4Addr::new(10, 98, octet, 1);
        for command in [
            format!("ip -n {name} link add late type veth peer name far"),
            format!("ip -n {name} addr add {address}/24 dev late"),
            format!("ip -n {name} link set late up"),
            format!("ip -n {name} link set far up"),
            format!("ip -n {name} neigh add 10.98.{octet}.9 lladdr 02:00:00:00:00:09 dev late"),
        ] {
            run(&command)?;
        }
        wait_attached(host, "late", [1, 1], PATIENCE)?;
        let sender = netns::within(&host.network(), || UdpSocket::bind((address, 0)))??;
        let payload = program_run::message(WRITER, u32::from(octet)..=u32::from(octet), 64);
        sender.send_to(&payload, (Ipv4Addr::new(10, 98, octet, 9), 7411))?;
    }
    // Of an unknown writer, the first messages are captured.
    agent.scrape_until("packets of both interfaces", |page| {
        let names = page.labels_of("ros2probe_capture_packets_total", "interface");
        let late = names.iter().filter(|name| name.ends_with("late")).count();
        late == 2
    })?;
    let (robot, monitor) = (&link.robot, &link.monitor);
    run(&format!("ip -n {} link set late name moved", robot.name()))?;
    run(&format!(
        "ip -n {} link set moved netns {}",
        robot.name(),
        monitor.name()
    ))?;
    // The other tap attaches its own programs.
    wait_attached(monitor, "moved", [1, 1], PATIENCE)
}

#[test]
fn packet_sockets_are_used_where_the_configuration_selects_them() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = "capture: {source: wire, wire: packet}\n";
    let agent = start(&link.robot, directory.path(), configuration)?;
    let page = agent.scrape()?;
    let labels = [("hook", "packet"), ("reason", "")];
    ensure!(page.value(HOOK, &labels) == Some(1.0));
    let health: serde_json::Value = serde_json::from_str(&get(agent.host, HEALTH)?)?;
    ensure!(
        health["wire"] == serde_json::json!({"hook": "packet"}),
        "{health}"
    );
    if tcx::check().is_ok() {
        ensure!(attached(&link.robot, INTERFACE)? == [0, 0]);
    }
    Ok(())
}
