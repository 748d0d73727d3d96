//! `rp run` at the sockets of a host. Real participants and containers that start later are seen
//! completely, the source is chosen as documented, and nothing stays behind. Needs root.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_testing::forged::{Renewal, Sender, Talker, introduce, send_sizes};
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::bpf::wait_metered;
use ros2probe_testing::harness::cgroup;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Stack, Stream, pair, robot};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn the_demo_robot_is_seen_completely_at_its_sockets() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(&link.robot, &at_the_sockets_of(&link.robot))?;
    let mut roles = Vec::new();
    for (host, role) in [
        (&link.robot, "base"),
        (&link.robot, "lidar"),
        (&link.monitor, "monitor"),
    ] {
        roles.push(Process::start(&host.inside(), robot()?, ["--role", role])?);
    }
    // The robot sends the topics that the monitor subscribes to, and receives the monitor's
    // announcements.
    let page = observed.wait(|page| {
        page.sum("ros2_participants", &[]) == 3.0
            && ["/points", "/imu", "/scan", "/cmd_vel"]
                .iter()
                .all(|topic| count(page, "messages", topic) > 20)
    })?;
    let source = [("source", "host"), ("reason", "")];
    assert_eq!(
        page.value("ros2probe_capture_source_info", &source),
        Some(1.0),
        "{}",
        page.0
    );
    assert_eq!(page.sum("ros2_unknown_writers", &[]), 0.0, "{}", page.0);
    check_no_drops(&page)
}

// Coverage: UDP | Fast DDS 2.9 | - | exact
#[test]
fn counts_of_fast_dds_equal_its_logs_at_either_end() -> Result<()> {
    counted_as_logged(Stack::Fast)
}

// Coverage: UDP | Cyclone DDS 0.10 | - | exact
#[test]
fn counts_of_cyclone_dds_equal_its_logs_at_either_end() -> Result<()> {
    counted_as_logged(Stack::Cyclone)
}

// Coverage: UDP | RustDDS 0.15 | - | exact
#[test]
fn counts_of_rust_dds_equal_its_logs_at_either_end() -> Result<()> {
    counted_as_logged(Stack::Rust)
}

fn counted_as_logged(stack: Stack) -> Result<()> {
    for stream in [
        Stream::small(400),
        Stream {
            reliable: true,
            ..Stream::point_cloud(644_000, 40)
        },
    ] {
        let link = Link::new()?;
        let robot = Observed::start(&link.robot, &at_the_sockets_of(&link.robot))?;
        let monitor = Observed::start(&link.monitor, &at_the_sockets_of(&link.monitor))?;
        let (mut publisher, mut subscriber) = pair(&link.robot, &link.monitor, stack, &stream)?;
        // Of an unknown writer, the agent reads less than a point cloud.
        for observed in [&robot, &monitor] {
            observed.wait(|page| publishers(page, &stream.topic) == Some(1.0))?;
        }
        publisher.start_sending()?;
        publisher.wait_sent(PATIENCE)?;
        for observed in [&robot, &monitor] {
            // On a busy machine, RustDDS may leave without a goodbye.
            match stack {
                Stack::Rust => observed.agent.settled_scrape(&stream.topic, stream.count)?,
                _ => observed.wait(|page| wait_removed(page, &stream.topic))?,
            };
        }
        let sent = publisher.log()?.sequences("pub").len() as u64;
        subscriber.process.terminate()?;
        let received = subscriber.log()?.sequences("sub").len() as u64;
        ensure!(received > 0 && sent == stream.count, "{received} of {sent}");
        for (observed, expected) in [(&robot, sent), (&monitor, sent)] {
            let page = observed.agent.scrape()?;
            let counted = count(&page, "messages", &stream.topic);
            let lost = count(&page, "lost_messages", &stream.topic);
            assert_eq!(
                (counted, lost),
                (expected, 0),
                "{stack:?} {} B on {}, {received} received: {}",
                stream.size,
                observed.agent.host.name(),
                page.suspicious_counters()
            );
            check_no_drops(&page)?;
        }
    }
    Ok(())
}

#[test]
fn a_receiver_is_named_by_process_and_control_group() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let socket = directory.path().join("api.sock");
    let configuration = format!(
        "watch: [{{topic: /imu, per_subscriber: true}}]\napi: {{socket: {}}}\n{}",
        socket.display(),
        at_the_sockets_of(&host)
    );
    let observed = Observed::start(&host, &configuration)?;
    let stream = Stream {
        // Both nodes stay until `rp doctor` has seen them.
        linger: 120.0,
        ..Stream::small(2000)
    };
    let (mut publisher, subscriber) = pair(&host, &host, Stack::Cyclone, &stream)?;
    publisher.start_sending()?;
    let cgroup = host.cgroup().file_name().context("no name")?;
    let cgroup = format!("/{}", cgroup.display());
    let process_id = subscriber.process.pid().to_string();
    let expected = [
        ("topic", "/imu"),
        ("ros_node", "/listener"),
        ("process", "cyclonedds"),
        ("pid", &process_id),
        ("cgroup", &cgroup),
    ];
    observed.wait(|page| page.value("ros2_subscriber_info", &expected) == Some(1.0))?;
    check_doctor(&host, &socket, subscriber.process.pid())
}

/// Checks the report of `rp doctor` for a host with an agent and two nodes.
fn check_doctor(host: &Namespace, socket: &Path, subscriber: u32) -> Result<()> {
    let [program, arguments @ ..] = &host.outside();
    let output = Command::new(program)
        .args(arguments)
        .args([env!("CARGO_BIN_EXE_rp"), "doctor", "--json", "--socket"])
        .arg(socket)
        .output()?;
    let report: serde_json::Value = serde_json::from_slice(&output.stdout)
        .with_context(|| String::from_utf8_lossy(&output.stderr).into_owned())?;
    let find = |area: &str, check: &str| {
        let mut findings = report["findings"].as_array().into_iter().flatten();
        let found = findings.find(|each| each["area"] == area && each["check"] == check);
        found.with_context(|| format!("no {area} {check} in {report:#}"))
    };
    for (area, check) in [
        ("agent", "ready"),
        ("sight", "source"),
        ("kernel", "version"),
        ("graph", "participants"),
    ] {
        assert_eq!(find(area, check)?["verdict"], "ok", "{report:#}");
    }
    let participants = find("graph", "participants")?["sentence"].as_str();
    // Other participants of this machine may be seen in shared memory.
    let seen =
        participants.is_some_and(|printed| printed.contains("domain 0: 2 Eclipse Cyclone DDS"));
    assert!(seen, "{participants:?}");
    // Other processes of this machine may be among them.
    let processes = find("processes", "processes")?.to_string();
    assert!(
        processes.contains(&format!("({subscriber}): domain 0, Cyclone DDS")),
        "{processes}"
    );
    Ok(())
}

#[test]
fn a_mirrored_interface_shows_forwarded_messages_once() -> Result<()> {
    let link = Link::new()?;
    let cgroup = link.monitor.cgroup().display();
    let configuration =
        format!("capture: {{source: host, cgroup: {cgroup}, mirror_interfaces: [eth*]}}\n");
    let observed = Observed::start(&link.monitor, &configuration)?;
    // The port has no socket, as for forwarded or mirrored traffic.
    let mut sender = Sender::between(&link.robot, &link.monitor)?;
    let mut talker = Talker::new(1, "/forwarded");
    introduce(&talker, &mut sender)?;
    let repeater = Sender::between(&link.robot, &link.monitor)?;
    let _renewal = Renewal::start(repeater, talker.participant());
    send_sizes(&mut talker, &mut sender, [320; 200])?;
    let stream = Stream {
        topic: "/received".to_owned(),
        ..Stream::small(400)
    };
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, Stack::Cyclone, &stream)?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let page = observed.wait(|page| wait_removed(page, "/received"))?;
    assert_eq!(count(&page, "messages", "/forwarded"), 200);
    assert_eq!(count(&page, "messages", "/received"), 400);
    assert_eq!(
        page.sum(
            "ros2_topic_delivered_messages_total",
            &[("topic", "/received")]
        ),
        400.0,
        "{}",
        page.0
    );
    let forwarded = [("ability", "forwarded")];
    assert_eq!(page.sum("ros2probe_capture_ability", &forwarded), 1.0);
    assert!(
        page.sum("ros2probe_capture_packets_total", &[("interface", "eth0")]) > 0.0
            && page.sum("ros2probe_capture_packets_total", &[("interface", "lo")]) == 0.0,
        "{}",
        page.0
    );
    check_no_drops(&page)
}

#[test]
fn by_default_the_agent_captures_at_the_sockets_and_reports_it() -> Result<()> {
    let host = Namespace::isolated()?;
    let cgroup = host.cgroup().display();
    let observed = Observed::start(&host, &format!("capture: {{cgroup: {cgroup}}}\n"))?;
    let log = observed.log()?;
    assert!(log.contains("source=\"host\""), "{log}");
    assert!(log.contains(&format!("cgroup=\"{cgroup}\"")), "{log}");
    assert!(!log.contains("not used"), "{log}");
    Ok(())
}

#[test]
fn named_interfaces_select_the_wire_and_the_log_has_the_reason() -> Result<()> {
    let host = Namespace::isolated()?;
    let observed = Observed::start(&host, "capture: {interfaces: {exclude: [wlan0]}}\n")?;
    let log = observed.log()?;
    assert!(
        log.contains("host hook not used: the configuration names interfaces"),
        "{log}"
    );
    assert!(log.contains("source=\"wire\""), "{log}");
    Ok(())
}

#[test]
fn without_the_capability_to_attach_the_wire_is_selected_and_the_log_has_the_reason() -> Result<()>
{
    let host = Namespace::isolated()?;
    let cgroup = host.cgroup().display();
    let configuration = format!("capture: {{cgroup: {cgroup}}}\n");
    let only = "net_raw,bpf,perfmon";
    let observed = Observed::start_with(&host, &configuration, Some(only))?;
    let log = observed.log()?;
    let line = log.lines().find(|line| line.contains("host hook not used"));
    let line = line.with_context(|| format!("no reason in {log}"))?;
    assert!(
        line.contains("CAP_NET_ADMIN") && line.contains("observing interfaces"),
        "{line}"
    );
    let source = [("source", "wire")];
    let page = observed.agent.scrape()?;
    let reasons = page.labels_of("ros2probe_capture_source_info", "reason");
    assert_eq!(
        page.value("ros2probe_capture_source_info", &source),
        Some(1.0)
    );
    assert!(
        reasons
            .iter()
            .any(|reason| reason.contains("CAP_NET_ADMIN"))
    );
    Ok(())
}

#[test]
fn three_capabilities_suffice_at_the_sockets_and_all_are_dropped_later() -> Result<()> {
    let link = Link::new()?;
    let only = "net_admin,bpf,perfmon";
    let configuration = at_the_sockets_of(&link.monitor);
    let observed = Observed::start_with(&link.monitor, &configuration, Some(only))?;
    let status = std::fs::read_to_string(format!("/proc/{}/status", observed.agent.process.pid()))?;
    assert!(status.contains("\nCapPrm:\t0000000000000000\n"), "{status}");
    let stream = Stream::small(600);
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, Stack::Cyclone, &stream)?;
    wait_metered(observed.agent.process.pid(), publisher.guid()?)?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let page = observed.wait(|page| wait_removed(page, &stream.topic))?;
    assert_eq!(count(&page, "messages", &stream.topic), stream.count);
    // The agent updates the interest map without privilege, so the kernel metered most samples.
    let metered = page.sum("ros2probe_filter_events_total", &[("event", "metered")]);
    assert!(metered > 300.0, "{metered} metered");
    assert_eq!(page.sum("ros2probe_filter_refused_updates_total", &[]), 0.0);
    check_no_drops(&page)
}

#[test]
fn a_configured_source_that_is_unavailable_is_an_error() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, "capture: {source: host, cgroup: /proc}\n")?;
    let [enter, network] = host.outside();
    let output = std::process::Command::new(enter)
        .args([&network, env!("CARGO_BIN_EXE_rp"), "run", "--config"])
        .arg(&file)
        .output()?;
    let printed = String::from_utf8_lossy(&output.stderr);
    assert!(
        !output.status.success()
            && printed.contains("/proc is not a control group of the hierarchy v2"),
        "{printed}"
    );
    Ok(())
}

#[test]
fn a_container_that_starts_later_is_seen_with_the_default_configuration() -> Result<()> {
    let host = Namespace::isolated()?;
    let topic = format!("/container_{}", std::process::id());
    let observed = Observed::start(&host, &format!("watch: [{topic}]\n"))?;
    let stream = Stream {
        topic: topic.clone(),
        reliable: true,
        ..Stream::small(200)
    };
    // The container has another network namespace and another control group.
    let container = Namespace::isolated()?;
    let (mut publisher, _subscriber) = pair(&container, &container, Stack::Cyclone, &stream)?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    observed.wait(|page| count(page, "messages", &topic) == stream.count)?;
    let log = observed.log()?;
    let hierarchy = cgroup::hierarchy()?;
    assert!(
        log.contains(&format!("cgroup=\"{}\"", hierarchy.display())),
        "{log}"
    );
    assert!(log.contains("containers"), "{log}");
    Ok(())
}

#[test]
fn two_agents_count_the_same_and_a_killed_one_leaves_no_programs_behind() -> Result<()> {
    let link = Link::new()?;
    let configuration = at_the_sockets_of(&link.robot);
    let first = Observed::start(&link.robot, &configuration)?;
    // On the network of the first agent, the address of the metrics listener is in use.
    let mut second = Observed::start(&link.monitor, &configuration)?;
    assert_eq!(cgroup::attached(link.robot.cgroup())?, [4, 4]);
    let stream = Stream::small(400);
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, Stack::Fast, &stream)?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    for observed in [&first, &second] {
        let page = observed.wait(|page| wait_removed(page, &stream.topic))?;
        assert_eq!(count(&page, "messages", &stream.topic), stream.count);
        check_no_drops(&page)?;
    }
    second.agent.process.signal("KILL")?;
    second.agent.process.wait(PATIENCE)?;
    // The kernel releases the descriptors of a killed process asynchronously.
    let attached = || cgroup::attached(link.robot.cgroup());
    wait_until("no program of the killed agent", || {
        Ok(attached()? == [2, 2])
    })?;
    let Observed { mut agent, .. } = first;
    assert!(agent.process.terminate()?.success());
    wait_until("no program", || Ok(attached()? == [0, 0]))
}

/// A host with an agent on it.
struct Observed<'a> {
    agent: Agent<'a>,
    log: PathBuf,
    _directory: TempDir,
}

impl<'a> Observed<'a> {
    /// Starts an agent that watches everything unless the configuration lists watches.
    fn start(host: &'a Namespace, configuration: &str) -> Result<Observed<'a>> {
        Self::start_with(host, configuration, None)
    }

    /// Starts an agent as a user with only these capabilities.
    fn start_with(
        host: &'a Namespace,
        configuration: &str,
        capabilities: Option<&str>,
    ) -> Result<Observed<'a>> {
        let directory = tempfile::tempdir()?;
        let file = |name: &str| directory.path().join(name);
        let all = if configuration.contains("watch:") {
            ""
        } else {
            "watch: [/**]\n"
        };
        std::fs::write(file("ros2probe.yaml"), format!("{all}{configuration}"))?;
        let program = match capabilities {
            None => PathBuf::from(env!("CARGO_BIN_EXE_rp")),
            Some(capabilities) => {
                write_start(&directory, capabilities)?;
                file("start")
            }
        };
        let log = file("log");
        let agent = Agent::start_logging(host, program, &file("ros2probe.yaml"), &log)
            .with_context(|| std::fs::read_to_string(&log).unwrap_or_default())?;
        Ok(Observed {
            agent,
            log,
            _directory: directory,
        })
    }

    fn log(&self) -> Result<String> {
        // Removes the colours.
        let log = std::fs::read_to_string(&self.log)?;
        Ok(log
            .replace("\u{1b}[0m", "")
            .replace("\u{1b}[2m", "")
            .replace("\u{1b}[3m", ""))
    }

    fn wait(&self, wanted: impl Fn(&Scrape) -> bool) -> Result<Scrape> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let page = self.agent.scrape()?;
            if wanted(&page) {
                return Ok(page);
            }
            if Instant::now() > deadline {
                bail!("not within {PATIENCE:?}:\n{}\n{}", page.0, self.log()?);
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }
}

/// Writes a program that starts `rp` with only these capabilities.
fn write_start(directory: &TempDir, capabilities: &str) -> Result<()> {
    let file = |name: &str| directory.path().join(name);
    // The unprivileged user may be unable to read the build directory.
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), file("rp"))?;
    let only: String = capabilities
        .split(',')
        .map(|capability| format!(",+{capability}"))
        .collect();
    let script = format!(
        "#!/bin/sh\nexec setpriv --reuid 65534 --regid 65534 --clear-groups --inh-caps -all{only} \
         --ambient-caps -all{only} --bounding-set -all{only} {} \"$@\"\n",
        file("rp").display()
    );
    std::fs::write(file("start"), script)?;
    for open in ["", "start", "rp"] {
        std::fs::set_permissions(file(open), Permissions::from_mode(0o755))?;
    }
    Ok(())
}

fn count(page: &Scrape, what: &str, topic: &str) -> u64 {
    let name = format!("ros2_topic_{what}_total");
    page.sum(&name, &[("topic", topic)]) as u64
}

/// Returns whether the topic's publisher appeared and left.
fn wait_removed(page: &Scrape, topic: &str) -> bool {
    publishers(page, topic) == Some(0.0)
}

fn publishers(page: &Scrape, topic: &str) -> Option<f64> {
    page.value("ros2_topic_publishers", &[("topic", topic)])
}

fn check_no_drops(page: &Scrape) -> Result<()> {
    for lossless in [
        "ros2probe_capture_dropped_packets_total",
        "ros2probe_records_dropped_total",
        "ros2probe_dropped_datagrams_total",
        "ros2probe_contended_datagrams_total",
        "ros2probe_incomplete_datagrams_total",
        "ros2probe_decode_errors_total",
    ] {
        let dropped = page.sum(lossless, &[]);
        ensure!(dropped == 0.0, "{lossless} is {dropped}");
    }
    Ok(())
}
