//! An agent that is a user with the few capabilities of its source and nothing else: it sees all
//! that this source can see, keeps only what it goes on needing, and says what it lacks for more.

mod harness;

use std::fs::Permissions;
use std::os::unix::fs::{PermissionsExt as _, chown};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use harness::agent::{Agent, Scrape, at_the_sockets_of};
use harness::network::{Link, Namespace};
use harness::peer::{Peer, Role, Stack, Stream};
use ros2probe::surface::{Ability, SourceKind};

const SAMPLES: u64 = 400;
/// `CAP_BPF`'s bit, as /proc shows it.
const BPF_ALONE: &str = "0000008000000000";

#[test]
fn three_capabilities_are_enough_at_the_sockets() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let capture = at_the_sockets_of(&link.monitor);
    let agent = start(
        &link.monitor,
        directory.path(),
        "+net_admin,+bpf,+perfmon",
        &capture,
    )?;
    let page = watch_a_stream(&link, &agent)?;
    let source = [("source", "host"), ("reason", "")];
    assert_eq!(
        page.sum("ros2probe_capture_source_info", &source),
        1.0,
        "{}",
        page.0
    );
    for ability in [
        Ability::Subscribers,
        Ability::Sent,
        Ability::SocketLosses,
        Ability::ReassemblyLosses,
        Ability::Owners,
    ] {
        let label = [("ability", ability.label())];
        assert_eq!(
            page.sum("ros2probe_capture_ability", &label),
            1.0,
            "{ability:?}"
        );
    }
    // Read after everything but CAP_BPF was given up.
    let cgroup = page.labels_of("ros2_subscriber_info", "cgroup");
    let own = link.monitor.cgroup().file_name().context("no name")?;
    let own = own.to_string_lossy();
    assert!(
        cgroup.iter().any(|path| path.ends_with(&*own)),
        "{cgroup:?}"
    );
    let processes = page.labels_of("ros2_subscriber_info", "process");
    assert!(processes.contains("cyclonedds"), "{processes:?}");
    let writes = |outcome| page.value("ros2probe_state_writes_total", &[("outcome", outcome)]);
    assert!(writes("written").is_some_and(|count| count > 0.0));
    assert_eq!(writes("failed"), Some(0.0));
    Ok(())
}

#[test]
fn an_agent_that_may_only_look_at_the_wire_says_so() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start(
        &link.monitor,
        directory.path(),
        "+net_raw,+bpf,+perfmon",
        "",
    )?;
    let page = watch_a_stream(&link, &agent)?;
    let sources = page.labels_of("ros2probe_capture_source_info", "source");
    assert!(sources.contains(SourceKind::Wire.label()), "{sources:?}");
    let reasons = page.labels_of("ros2probe_capture_source_info", "reason");
    assert!(
        reasons
            .iter()
            .all(|reason| reason.contains("CAP_NET_ADMIN")),
        "{reasons:?}"
    );
    let label = [("ability", Ability::SocketLosses.label())];
    assert_eq!(page.sum("ros2probe_capture_ability", &label), 0.0);
    Ok(())
}

/// An agent that is nobody and has these capabilities.
fn start<'a>(
    host: &'a Namespace,
    directory: &Path,
    capabilities: &str,
    capture: &str,
) -> Result<Agent<'a>> {
    let file = |name: &str| -> PathBuf { directory.join(name) };
    // The build directory need not be open to everybody.
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), file("rp"))?;
    let watch = "watch: [{topic: /imu, per_subscriber: true}]\n";
    std::fs::write(file("ros2probe.yaml"), format!("{watch}{capture}"))?;
    let only = format!("-all,{capabilities}");
    // As StateDirectory=ros2probe of the unit would have it.
    std::fs::create_dir(file("state"))?;
    chown(file("state"), Some(65534), Some(65534))?;
    let groups = harness::cgroup::hierarchy()?;
    let groups = groups.display();
    // As ProtectControlGroups=yes and ProtectProc=invisible of the unit would have it.
    let sandbox = format!(
        "mount --bind {groups} {groups} && mount -o remount,bind,ro {groups} && \
         mount -t proc -o hidepid=invisible proc /proc"
    );
    let script = format!(
        "#!/bin/sh\nset -e\n[ \"$1\" = inside ] || exec unshare --mount \"$0\" inside \"$@\"\nshift\n\
         {sandbox}\nexport STATE_DIRECTORY={}\nexec setpriv --reuid 65534 --regid 65534 --clear-groups --inh-caps {only} \
         --ambient-caps {only} --bounding-set {only} {} \"$@\"\n",
        file("state").display(),
        file("rp").display()
    );
    std::fs::write(file("start"), script)?;
    for open in ["", "start", "rp"] {
        std::fs::set_permissions(file(open), Permissions::from_mode(0o755))?;
    }
    let agent = Agent::start(host, file("start"), &file("ros2probe.yaml"))?;
    let status = std::fs::read_to_string(format!("/proc/{}/status", agent.process.pid()))?;
    for line in [
        "Uid:\t65534\t65534\t65534\t65534".to_owned(),
        format!("CapEff:\t{BPF_ALONE}"),
        format!("CapPrm:\t{BPF_ALONE}"),
    ] {
        ensure!(
            status.lines().any(|other| other == line),
            "{line} in\n{status}"
        );
    }
    Ok(agent)
}

/// The page after a stream to the monitor of which nothing was lost.
fn watch_a_stream(link: &Link, agent: &Agent<'_>) -> Result<Scrape> {
    let stream = Stream {
        linger: 30.0,
        ..Stream::small(SAMPLES)
    };
    let mut subscriber = Peer::start(
        &link.monitor,
        Stack::Cyclone,
        Role::Subscriber,
        &stream,
        &["/listener"],
    )?;
    let mut publisher = Peer::start(
        &link.robot,
        Stack::Cyclone,
        Role::Publisher,
        &stream,
        &["/talker"],
    )?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    publisher.go()?;
    publisher.wait_sent(Duration::from_secs(30))?;
    let page = agent.settled_scrape("/imu", SAMPLES)?;
    let received = page.sum(
        "ros2_subscriber_received_messages_total",
        &[("topic", "/imu")],
    );
    ensure!(
        received == SAMPLES as f64,
        "{received} of {SAMPLES}\n{}",
        page.0
    );
    Ok(page)
}
