//! An agent that runs as a user with only the capabilities of its source. It sees all that this
//! source can see, keeps only the privileges that it needs, and reports missing ones. An agent that
//! root starts changes its user before it serves anything.

mod ros2_daemon;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::Permissions;
use std::io;
use std::net::{TcpListener, UdpSocket};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, chown};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::{netns, tcx};
use ros2probe_daemon::agent_facts::{Ability, SourceKind};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use seccompiler::{BpfProgram, SeccompAction, SeccompFilter};

const SAMPLES: u64 = 400;
/// The empty capability set and `CAP_BPF` alone, as /proc shows them.
const NO_CAPABILITIES: &str = "0000000000000000";
const BPF_ALONE: &str = "0000008000000000";
/// `CAP_NET_ADMIN` alone, and with `CAP_BPF`.
const NET_ADMIN_ALONE: &str = "0000000000001000";
const NET_ADMIN_AND_BPF: &str = "0000008000001000";
/// Id that represents the package's user and group.
const USER: u32 = 64_123;

#[test]
fn three_capabilities_suffice_at_the_sockets() -> Result<()> {
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
    // The control group is read after all capabilities were dropped.
    let cgroup = page.labels_of("ros2_subscriber_info", "cgroup");
    let own = link.monitor.cgroup().file_name().context("no name")?;
    let own = own.to_string_lossy();
    assert!(
        cgroup.iter().any(|path| path.ends_with(&*own)),
        "{cgroup:?}"
    );
    let processes = page.labels_of("ros2_subscriber_info", "process");
    assert!(processes.contains("cyclonedds"), "{processes:?}");
    let writes = |page: &Scrape, outcome| {
        page.value("ros2probe_state_writes_total", &[("outcome", outcome)])
    };
    let page = agent.scrape_until("a written state", |page| {
        writes(page, "written").is_some_and(|count| count > 0.0)
    })?;
    assert_eq!(writes(&page, "failed"), Some(0.0));
    Ok(())
}

#[test]
fn an_agent_with_capabilities_for_the_wire_only_reports_it() -> Result<()> {
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

#[test]
fn the_capabilities_of_the_host_source_suffice_at_tcx() -> Result<()> {
    if tcx::check().is_err() {
        return Ok(());
    }
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let capabilities = "+net_admin,+bpf,+perfmon";
    let capture = "capture: {source: wire}\n";
    let agent = start(&link.monitor, directory.path(), capabilities, capture)?;
    let hooks = agent
        .scrape()?
        .labels_of("ros2probe_capture_wire_info", "hook");
    ensure!(hooks == BTreeSet::from(["tcx".to_owned()]), "{hooks:?}");
    let names = confined(agent.process.pid(), 65534)?;
    ensure!(names.contains("tcx"), "no tcx in {names:?}");
    Ok(())
}

/// Prepares a host with the package's user and the files that package and service manager create.
fn installed(host: &Namespace, file: &impl Fn(&str) -> PathBuf) -> Result<()> {
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), file("rp"))?;
    for (name, line) in [
        (
            "passwd",
            format!("ros2probe:x:{USER}:{USER}::/:/bin/false\n"),
        ),
        ("group", format!("ros2probe:x:{USER}:\n")),
    ] {
        let text = std::fs::read_to_string(Path::new("/etc").join(name))?;
        std::fs::write(file(name), format!("{text}{line}"))?;
    }
    // The package and the service manager create these directories.
    for name in ["state", "run"] {
        std::fs::create_dir(file(name))?;
        chown(file(name), Some(USER), Some(USER))?;
    }
    let socket = file("run").join("api.sock");
    let capture = at_the_sockets_of(host);
    let configuration = format!(
        "{capture}state_directory: {}\napi: {{socket: {}}}\n",
        file("state").display(),
        socket.display()
    );
    std::fs::write(file("ros2probe.yaml"), configuration)?;
    let script = format!(
        "#!/bin/sh\nset -e\n[ \"$1\" = inside ] || exec unshare --mount \"$0\" inside \"$@\"\nshift\n\
         mount --bind {} /etc/passwd\nmount --bind {} /etc/group\nexec {} \"$@\"\n",
        file("passwd").display(),
        file("group").display(),
        file("rp").display()
    );
    std::fs::write(file("start"), script)?;
    for open in ["", "start", "rp"] {
        std::fs::set_permissions(file(open), Permissions::from_mode(0o755))?;
    }
    Ok(())
}

#[test]
fn an_agent_started_by_root_changes_its_user_and_writes_no_file_of_root() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let file = |name: &str| -> PathBuf { directory.path().join(name) };
    let socket = file("run").join("api.sock");
    installed(&host, &file)?;
    let log = file("log");
    let mut agent = Agent::start_logging(&host, file("start"), &file("ros2probe.yaml"), &log)?;
    // The thread for shared memory keeps capabilities that depend on root's own here. Other threads
    // keep none.
    let main = std::fs::read_to_string(format!("/proc/{}/status", agent.process.pid()))?;
    for line in [
        format!("Uid:\t{USER}\t{USER}\t{USER}\t{USER}"),
        format!("Gid:\t{USER}\t{USER}\t{USER}\t{USER}"),
        format!("CapPrm:\t{NO_CAPABILITIES}"),
        format!("CapBnd:\t{NO_CAPABILITIES}"),
        "Seccomp:\t2".to_owned(),
    ] {
        ensure!(main.lines().any(|other| other == line), "{line} in\n{main}");
    }
    let made = std::fs::metadata(&socket)?;
    ensure!(made.mode() & 0o777 == 0o660 && made.gid() == USER);
    agent.process.terminate()?;
    let mut files = Vec::new();
    for name in ["state", "run"] {
        for entry in std::fs::read_dir(file(name))? {
            let entry = entry?;
            let about = entry.metadata()?;
            let (owner, mode) = (about.uid(), about.mode() & 0o777);
            ensure!(owner == USER, "{:?} is {owner}'s", entry.path());
            let expected = if about.is_dir() { 0o700 } else { 0o600 };
            ensure!(mode == expected, "{:?} is {mode:o}", entry.path());
            files.push(entry.file_name());
        }
    }
    ensure!(
        files.iter().any(|name| name == "discovery.json"),
        "{files:?}"
    );
    ensure!(
        files.iter().any(|name| name == "api.sock.lock"),
        "{files:?}"
    );
    let log = std::fs::read_to_string(log)?;
    ensure!(
        log.contains("switched from root to user ros2probe"),
        "{log}"
    );
    Ok(())
}

#[test]
fn an_agent_that_cannot_drop_its_capabilities_serves_nothing() -> Result<()> {
    // This filter simulates a kernel that reports success and does nothing, which only reading back
    // shows.
    let capset = BTreeMap::from([(libc::SYS_capset, Vec::new())]);
    let lie = SeccompFilter::new(
        capset,
        SeccompAction::Allow,
        SeccompAction::Errno(0),
        std::env::consts::ARCH.try_into()?,
    )?;
    let lie = BpfProgram::try_from(lie)?;
    let capture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../wire/tests/data/cyclonedds-samehost-any.pcap.gz");
    let mut command = Command::new(env!("CARGO_BIN_EXE_rp"));
    let listeners = ["--metrics", "127.0.0.1:0", "--api", "127.0.0.1:0"];
    command
        .args(["run", "--replay"])
        .arg(capture)
        .args(listeners);
    // SAFETY: between fork and exec are only two system calls, on memory allocated before.
    unsafe {
        command.pre_exec(move || seccompiler::apply_filter(&lie).map_err(io::Error::other));
    }
    let output = command.output()?;
    let printed = String::from_utf8_lossy(&output.stderr);
    ensure!(
        output.status.code() == Some(77),
        "{:?}: {printed}",
        output.status
    );
    ensure!(printed.contains("refusing to serve: CAP_"), "{printed}");
    ensure!(!printed.contains("serving"), "{printed}");
    Ok(())
}

#[test]
fn an_agent_resolves_the_name_of_a_collector_and_connects_to_it() -> Result<()> {
    let host = Namespace::isolated()?;
    let network = host.network();
    let (names, collector) = netns::within(&network, || -> Result<_> {
        let names = UdpSocket::bind("127.0.0.1:53")?;
        names.set_read_timeout(Some(Duration::from_millis(100)))?;
        Ok((names, TcpListener::bind("127.0.0.1:4317")?))
    })??;
    let directory = tempfile::tempdir()?;
    let file = |name: &str| -> PathBuf { directory.path().join(name) };
    std::fs::write(file("resolv.conf"), "nameserver 127.0.0.1\n")?;
    let capture = at_the_sockets_of(&host);
    let endpoint = "otlp: {endpoint: 'http://collector.test:4317', interval_s: 1}\n";
    std::fs::write(file("ros2probe.yaml"), format!("{endpoint}{capture}"))?;
    let script = format!(
        "#!/bin/sh\nset -e\n[ \"$1\" = inside ] || exec unshare --mount \"$0\" inside \"$@\"\nshift\n\
         mount --bind {} /etc/resolv.conf\nexec {} \"$@\"\n",
        file("resolv.conf").display(),
        env!("CARGO_BIN_EXE_rp"),
    );
    std::fs::write(file("start"), script)?;
    std::fs::set_permissions(file("start"), Permissions::from_mode(0o755))?;
    let agent = Agent::start(&host, file("start"), &file("ros2probe.yaml"))?;
    let (tell, connected) = mpsc::channel();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut question = [0; 512];
            while !stop.load(Ordering::Relaxed) {
                if let Ok((length, from)) = names.recv_from(&mut question)
                    && let Some(answer) = answer(question.get(..length).unwrap_or_default())
                {
                    let _ = names.send_to(&answer, from);
                }
            }
        });
        scope.spawn(|| {
            collector.set_nonblocking(true)?;
            while !stop.load(Ordering::Relaxed) {
                match collector.accept() {
                    Ok((_, from)) => drop(tell.send(from)),
                    Err(_) => std::thread::sleep(Duration::from_millis(20)),
                }
            }
            io::Result::Ok(())
        });
        let from = connected.recv_timeout(Duration::from_secs(60));
        stop.store(true, Ordering::Relaxed);
        ensure!(from?.ip().is_loopback());
        let page = agent.scrape()?;
        let filtered = [("system_calls", "filtered"), ("reason", "")];
        ensure!(page.value("ros2probe_sandbox_info", &filtered) == Some(1.0));
        Ok(())
    })
}

/// Returns a name server's answer: every name has the address 127.0.0.1, and no other.
fn answer(question: &[u8]) -> Option<Vec<u8>> {
    let (header, rest) = question.split_first_chunk::<12>()?;
    let name = rest.iter().position(|byte| *byte == 0)? + 1;
    let asked = rest.get(..name + 4)?;
    let is_address = asked.get(name..name + 2)? == [0, 1];
    let mut answer = header.get(..2)?.to_vec();
    answer.extend([0x81, 0x80, 0, 1, 0, u8::from(is_address), 0, 0, 0, 0]);
    answer.extend(asked);
    if is_address {
        // A pointer to the name above, and a record of 4 octets that is valid for a minute.
        answer.extend([0xc0, 12, 0, 1, 0, 1, 0, 0, 0, 60, 0, 4, 127, 0, 0, 1]);
    }
    Some(answer)
}

/// Starts an agent as an unprivileged user with these capabilities.
fn start<'a>(
    host: &'a Namespace,
    directory: &Path,
    capabilities: &str,
    capture: &str,
) -> Result<Agent<'a>> {
    let file = |name: &str| -> PathBuf { directory.join(name) };
    // The unprivileged user may be unable to read the build directory.
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), file("rp"))?;
    let watch = "watch: [{topic: /imu, per_subscriber: true}]\n";
    std::fs::write(file("ros2probe.yaml"), format!("{watch}{capture}"))?;
    let only = format!("-all,{capabilities}");
    // `StateDirectory=ros2probe` of the unit creates this directory.
    std::fs::create_dir(file("state"))?;
    chown(file("state"), Some(65534), Some(65534))?;
    let groups = harness::cgroup::hierarchy()?;
    let groups = groups.display();
    // `ProtectControlGroups=yes` and `ProtectProc=invisible` of the unit have this effect.
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
    let names = confined(agent.process.pid(), 65534)?;
    for name in ["rp", "http", "capture", "shm", "state", "watches"] {
        ensure!(names.contains(name), "no {name} in {names:?}");
    }
    Ok(agent)
}

/// Returns the names of a process's threads. Fails if a thread has a capability, can gain one, or
/// may make every system call.
fn confined(process: u32, user: u32) -> Result<BTreeSet<String>> {
    let mut names = BTreeSet::new();
    for task in std::fs::read_dir(format!("/proc/{process}/task"))? {
        // A thread that resolves a name may end.
        let Ok(status) = std::fs::read_to_string(task?.path().join("status")) else {
            continue;
        };
        let value = |name: &str| {
            let mut lines = status.lines();
            let found = lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(":\t"));
            found.with_context(|| format!("no {name} in\n{status}"))
        };
        ensure!(
            value("Uid")?
                .split('\t')
                .all(|each| each == user.to_string())
        );
        ensure!(value("NoNewPrivs")? == "1", "{status}");
        ensure!(value("Seccomp")? == "2", "{status}");
        let name = value("Name")?;
        for set in ["CapInh", "CapPrm", "CapEff", "CapAmb"] {
            let left = value(set)?;
            let may_keep = matches!(set, "CapPrm" | "CapEff");
            let kept: &[&str] = match name {
                // Before Linux 5.19, changing maps needs this capability.
                "capture" if may_keep => &[NO_CAPABILITIES, BPF_ALONE],
                // The thread attaches to a control group that is created again.
                "cgroup" if may_keep => &[NET_ADMIN_ALONE, NET_ADMIN_AND_BPF],
                _ => &[NO_CAPABILITIES],
            };
            ensure!(kept.contains(&left), "{status}");
        }
        names.insert(name.to_owned());
    }
    Ok(names)
}

/// Sends a stream to the monitor, and returns the page after it. Fails if a sample was lost.
fn watch_a_stream(link: &Link, agent: &Agent<'_>) -> Result<Scrape> {
    let stream = Stream {
        linger: 120.0,
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
    publisher.start_sending()?;
    publisher.wait_sent(Duration::from_secs(60))?;
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
