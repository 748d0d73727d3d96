//! Forged traffic, and an agent with few privileges. Memory stays bounded, real messages are
//! counted exactly, and the agent reports what is wrong.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use ros2probe_testing::forged::frames::Wire;
use ros2probe_testing::forged::storm::{Dice, Storm, forgery};
use ros2probe_testing::forged::{
    self, Carrier, Pace, SAMPLES_WRITER, Sender, Talker, introduce, send_sizes,
};
use ros2probe_testing::harness::agent::{Agent, ON_THE_WIRE, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::bpf::wait_metered;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::local_agent;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};
use tempfile::TempDir;

/// A port without a socket on the robot: only the agent observes the storm.
const UNUSED_PORT: u16 = 7399;
const STORM: Duration = Duration::from_secs(6);
/// Maximum number of bytes that a storm may add to the agent's memory. With every table full, and
/// several snapshots and pages in flight, the agent stays within the unit's `MemoryMax`.
const GROWTH: u64 = 72 << 20;
/// Forged participants are removed after 5 s of silence, or when their lease ends if they sent for
/// longer than that.
const SILENCE: Duration = Duration::from_secs(6);
/// User and group of an agent, and of a file system that never answers.
const STUCK: u32 = 65_533;
/// Mounts a file system that never answers at `/dev/shm` of its own namespace, until its input
/// ends.
const STUCK_MOUNT: &str = r#"
import ctypes, os, sys
device = os.open("/dev/fuse", os.O_RDWR)
options = f"fd={device},rootmode=40000,user_id=USER,group_id=USER"
libc = ctypes.CDLL(None, use_errno=True)
if libc.mount(b"stuck", b"/dev/shm", b"fuse", 0, options.encode()) != 0:
    sys.exit(os.strerror(ctypes.get_errno()))
print("ready", flush=True)
sys.stdin.read()
"#;
/// Maximum time of recovery. Cyclone DDS repeats its announcement every 8 s.
const RECOVERY: Duration = Duration::from_secs(60);
/// Maximum wait on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn a_storm_of_forged_rtps_leaves_memory_bounded_and_a_real_topic_exact() -> Result<()> {
    let link = Link::new()?;
    let target = format!("{}:{UNUSED_PORT}", link.robot.address());
    let sender = Sender::new(
        &link.monitor,
        &format!("{}:0", link.monitor.address()),
        &target,
    )?;
    start_storm(&link, SILENCE, || Ok(Storm::start(sender, forgery)))
}

#[test]
fn a_storm_of_torn_ip_fragments_leaves_memory_bounded_and_a_real_topic_exact() -> Result<()> {
    let link = Link::new()?;
    let mut wire = Wire::new(&link.monitor, &link.robot, "eth0")?;
    wire.port = UNUSED_PORT;
    wire.shuffle = |packets| {
        // Different fragments are missing each time; some overlap or are out of order.
        let lot = packets
            .iter()
            .fold(0, |sum, packet| sum ^ packet[5] ^ packet[7]) as usize;
        let gone = lot % packets.len();
        packets.remove(gone);
        if let Some(packet) = packets.first_mut().filter(|_| lot.is_multiple_of(3)) {
            packet[7] = packet[7].wrapping_add(1);
        }
        if lot.is_multiple_of(2) {
            packets.reverse();
        }
    };
    let large = |dice: &mut Dice| {
        let mut bytes = forgery(dice);
        bytes.resize(3000 + dice.pick(50_000) as usize, 0x55);
        bytes
    };
    start_storm(&link, SILENCE, || Ok(Storm::start(wire, large)))
}

#[test]
fn a_flood_of_samples_of_a_watched_topic_does_not_affect_other_topics() -> Result<()> {
    let link = Link::new()?;
    let target = format!("{}:{UNUSED_PORT}", link.robot.address());
    let source = format!("{}:0", link.monitor.address());
    let sender = Sender::new(&link.monitor, &source, &target)?;
    start_storm(&link, SILENCE, || Storm::of_samples(sender, "/flood"))
}

#[test]
fn forgeries_that_fill_every_table_leave_memory_bounded_and_expire_with_their_leases() -> Result<()>
{
    let link = Link::new()?;
    let target = format!("{}:{UNUSED_PORT}", link.robot.address());
    let source = format!("{}:0", link.monitor.address());
    let sender = Sender::new(&link.monitor, &source, &target)?;
    let lease = Duration::from_secs(forged::FINITE_LEASE_SECONDS.into());
    start_storm(&link, lease + SILENCE, || {
        Ok(Storm::of_a_crowd(sender, 2000, 30))
    })
}

#[test]
fn a_robot_watched_by_name_that_starts_during_a_flood_is_counted_exactly() -> Result<()> {
    with_participant_flood(|_| ON_THE_WIRE.to_owned())
}

#[test]
fn a_robot_at_the_sockets_that_starts_during_a_flood_is_counted_exactly() -> Result<()> {
    with_participant_flood(|link| at_the_sockets_of(&link.robot))
}

#[test]
fn three_capabilities_suffice_for_an_unprivileged_user() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: [/**]\n{ON_THE_WIRE}"))?;
    let start = start_as(65_534, "-all,+net_raw,+bpf,+perfmon", &directory)?;
    let agent = Agent::start(&link.monitor, start, &file)?;
    let status = std::fs::read_to_string(format!("/proc/{}/status", agent.process.pid()))?;
    assert!(
        status.contains("\nUid:\t65534\t65534\t65534\t65534\n"),
        "{status}"
    );
    let mut sender = Sender::between(&link.robot, &link.monitor)?;
    let mut talker = Talker::new(1, "/unprivileged");
    introduce(&talker, &mut sender)?;
    let writer = Guid::new(GuidPrefix(talker.prefix), EntityId(SAMPLES_WRITER));
    wait_metered(agent.process.pid(), writer)?;
    send_sizes(&mut talker, &mut sender, [320; 500])?;
    let page = agent.settled_scrape("/unprivileged", 500)?;
    let counted = page.sum("ros2_topic_messages_total", &[("topic", "/unprivileged")]);
    assert_eq!(counted, 500.0, "{}", page.0);
    // The filter meters a classified writer, so the agent updates its map without further
    // privileges.
    let metered = page.sum("ros2probe_filter_events_total", &[("event", "metered")]);
    assert!(metered > 400.0, "{metered} of 500 metered");
    assert_eq!(page.sum("ros2probe_filter_refused_updates_total", &[]), 0.0);
    Ok(())
}

#[test]
fn hanging_shared_memory_is_reported_and_delays_no_other_part() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: [/**]\n{ON_THE_WIRE}"))?;
    // The mounted file system admits one user, so that it blocks the agent of no other test.
    let start = start_as(STUCK, "-all,+net_raw,+bpf,+perfmon,+sys_ptrace", &directory)?;
    let mut agent = Agent::start(&link.robot, start, &file)?;
    let is_able = |page: &Scrape| {
        let ability = [("ability", "shared_memory")];
        page.sum("ros2probe_capture_ability", &ability) == 1.0
    };
    agent.scrape_until("shared memory is seen", is_able)?;

    let mut enter = link.robot.on_network();
    enter.extend(["unshare", "--mount"].map(str::to_owned));
    let script = STUCK_MOUNT.replace("USER", &STUCK.to_string());
    let hold = || -> Result<Process> {
        let mut holder = Process::start(&enter, "python3", ["-c", &script])?;
        holder.wait_for("ready", PATIENCE)?;
        Ok(holder)
    };
    let holder = hold()?;
    let came = Instant::now();
    wait_hanging(&agent)?;
    eprintln!("it is noticed after {:?}", came.elapsed());

    // Everything else continues.
    let mut sender = Sender::between(&link.monitor, &link.robot)?;
    let mut talker = Talker::new(1, "/beside");
    introduce(&talker, &mut sender)?;
    send_sizes(&mut talker, &mut sender, [320; 500])?;
    let page = agent.settled_scrape("/beside", 500)?;
    let counted = page.sum("ros2_topic_messages_total", &[("topic", "/beside")]);
    assert_eq!(counted, 500.0, "{}", page.0);

    // The kernel ends the wait with the file system.
    drop(holder);
    agent.scrape_until("shared memory is seen again", is_able)?;
    agent.wait_ready(PATIENCE)?;
    let _holder = hold()?;
    wait_hanging(&agent)?;
    agent.process.signal("TERM")?;
    let began = Instant::now();
    let status = agent.process.wait(PATIENCE)?;
    assert!(status.success(), "{status}");
    eprintln!("it ends within {:?}", began.elapsed());
    Ok(())
}

/// Waits until the agent reports that the thread of shared memory hangs. A thread without CPU time
/// may be missed for a moment before.
fn wait_hanging(agent: &Agent<'_>) -> Result<()> {
    let printed = "capture.shm: its thread has made no progress for ";
    wait_until("the hanging thread is reported", || {
        let reason = agent
            .request("/readyz")
            .err()
            .map(|error| error.to_string());
        let is_able = agent
            .scrape()?
            .sum("ros2probe_capture_ability", &[("ability", "shared_memory")]);
        Ok(is_able == 0.0 && reason.is_some_and(|reason| reason.contains(printed)))
    })
}

/// Writes a program that starts `rp` as a user and group with these capabilities alone. The user
/// may be unable to read the build directory, so the program starts a copy.
pub fn start_as(user: u32, capabilities: &str, directory: &TempDir) -> Result<PathBuf> {
    let file = |name: &str| directory.path().join(name);
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), file("rp"))?;
    let script = format!(
        "#!/bin/sh\nexec setpriv --reuid {user} --regid {user} --clear-groups \
         --inh-caps {capabilities} --ambient-caps {capabilities} --bounding-set {capabilities} \
         {} \"$@\"\n",
        file("rp").display()
    );
    std::fs::write(file("start"), script)?;
    for open in ["", "start", "rp"] {
        std::fs::set_permissions(file(open), Permissions::from_mode(0o755))?;
    }
    Ok(file("start"))
}

/// Sends announcements of more participants than the table holds, each every other second as a real
/// participant does, and starts a robot during the flood.
fn with_participant_flood(capture: impl Fn(&Link) -> String) -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    let configuration = format!("watch: [/**, /real]\n{}", capture(&link));
    std::fs::write(&file, configuration)?;
    let agent = Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &file)?;
    // The socket hook sees datagrams only if a socket receives them.
    let to = format!("{}:{UNUSED_PORT}", link.robot.address());
    let _receiver = link.robot.hold(|| Sender::new(&link.robot, &to, &to))?;
    let from = format!("{}:0", link.monitor.address());
    let sender = Sender::new(&link.monitor, &from, &to)?;
    let pace = Pace::new(Duration::from_micros(500));
    let flood = Storm::of_a_crowd(Paced { sender, pace }, 1500, 4);
    let full = [("limit", "participants")];
    agent.scrape_until("the table is full", |page| {
        page.sum("ros2probe_at_limit", &full) == 1.0
    })?;

    let stream = Stream {
        topic: "/real".to_owned(),
        ..Stream::small(600)
    };
    let start = |host: &Namespace, role| Peer::start(host, Stack::Cyclone, role, &stream, &["/n"]);
    let came = Instant::now();
    let mut subscriber = start(&link.monitor, Role::Subscriber)?;
    let mut publisher = start(&link.robot, Role::Publisher)?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    let real = [("topic", "/real")];
    agent.scrape_until("/real is there", |page| {
        page.sum("ros2_topic_publishers", &real) == 1.0
    })?;
    eprintln!("the newcomer is seen after {:?}", came.elapsed());
    publisher.start_sending()?;
    publisher.wait_sent(Duration::from_secs(60))?;
    let page = agent.settled_scrape("/real", stream.count)?;
    let counted = page.sum("ros2_topic_messages_total", &real);
    assert_eq!(counted, stream.count as f64, "{}", agent.scrape()?.0);
    assert_eq!(page.sum("ros2_topic_lost_messages_total", &real), 0.0);

    let printed = "ready\ndegraded: at a limit: participants (1000 of 1000, ";
    wait_until("the limit is in the readiness", || {
        let readiness = agent.request("/readyz");
        Ok(readiness.is_ok_and(|text| text.starts_with(printed)))
    })?;
    let [program, arguments @ ..] = &link.robot.outside();
    let doctor = Command::new(program)
        .args(arguments)
        .arg(env!("CARGO_BIN_EXE_rp"))
        .args(["doctor", "--json", "--host", "127.0.0.1:17401"])
        .output()?;
    let report: serde_json::Value = serde_json::from_slice(&doctor.stdout)?;
    assert_eq!(report["verdict"], "problem", "{report:#}");
    let sent = flood.end()?;
    eprintln!("{sent} datagrams forged");
    Ok(())
}

/// A sender of some 2000 datagrams per second.
struct Paced {
    sender: Sender,
    pace: Pace,
}

impl Carrier for Paced {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        self.pace.wait();
        self.sender.send(payload)
    }
}

/// Runs a storm against an agent on the robot, and checks the agent during the storm and after a
/// silence.
fn start_storm(
    link: &Link,
    silence: Duration,
    storm: impl FnOnce() -> Result<Storm>,
) -> Result<()> {
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: [/**]\nlog: warn\n{ON_THE_WIRE}"))?;
    let log = directory.path().join("log");
    let rp = Path::new(env!("CARGO_BIN_EXE_rp"));
    let agent = Agent::start_logging(&link.robot, rp, &file, &log)?;
    let (ended, _pair) = check_real_topic(&agent, link, storm)?;
    std::thread::sleep(silence.saturating_sub(ended.elapsed()));
    check_new_participants(&agent, link)?;
    let log = std::fs::read_to_string(&log).context("the agent's log")?;
    assert!(log.lines().count() < 20, "{log}");
    Ok(())
}

/// Starts a subscriber on the monitor and its publisher on the robot, with these nodes.
fn matched_pair(link: &Link, stream: &Stream, nodes: [&str; 2]) -> Result<[Peer; 2]> {
    let start =
        |host: &Namespace, role, node| Peer::start(host, Stack::Cyclone, role, stream, &[node]);
    let mut subscriber = start(&link.monitor, Role::Subscriber, nodes[0])?;
    let mut publisher = start(&link.robot, Role::Publisher, nodes[1])?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    Ok([subscriber, publisher])
}

/// Runs the storm beside a real topic: memory stays bounded, the page complete and the count exact.
/// Returns when the storm ended, and the topic's endpoints.
fn check_real_topic(
    agent: &Agent<'_>,
    link: &Link,
    storm: impl FnOnce() -> Result<Storm>,
) -> Result<(Instant, [Peer; 2])> {
    let before = Usage::of(agent.process.pid())?;
    let stream = Stream {
        topic: "/real".to_owned(),
        ..Stream::small(STORM.as_secs() * 200)
    };
    let [subscriber, mut publisher] = matched_pair(link, &stream, ["/listener", "/driver"])?;

    publisher.start_sending()?;
    let storm = storm()?;
    let began = Instant::now();
    let (mut largest, mut oldest) = (0, 0_f64);
    while began.elapsed() < STORM {
        let page = agent.scrape()?;
        well_formed(&page);
        oldest = oldest.max(page.sum("ros2probe_snapshot_age_seconds", &[]));
        largest = largest.max(Usage::of(agent.process.pid())?.memory.unreclaimable);
        // The check of a page takes a tenth of a second of CPU.
        std::thread::sleep(Duration::from_secs(1));
    }
    publisher.wait_sent(Duration::from_secs(60))?;
    let cpu = Usage::of(agent.process.pid())?.since(&before).cpu;
    let sent = storm.end()?;
    let ended = Instant::now();
    let page = agent.settled_scrape("/real", stream.count)?;
    largest = largest.max(Usage::of(agent.process.pid())?.memory.unreclaimable);
    well_formed(&page);
    let growth = largest.saturating_sub(before.memory.unreclaimable);
    eprintln!(
        "{sent} datagrams forged, {cpu:?} of CPU, {} KiB more memory, oldest page {oldest} s, {} frames \
         and {} records dropped",
        growth >> 10,
        page.sum("ros2probe_capture_dropped_packets_total", &[]),
        page.sum("ros2probe_records_dropped_total", &[]),
    );
    assert!(sent > 5_000, "{sent} datagrams are no storm");
    assert!(growth < GROWTH, "{growth} bytes more");
    // An unoptimized agent falls behind beside other tests.
    assert!(oldest < 30.0, "a page was {oldest} s old");
    let real = |name| page.sum(name, &[("topic", "/real")]);
    // An agent without enough CPU counts what it drops.
    let unseen = page.sum("ros2probe_capture_dropped_packets_total", &[])
        + page.sum("ros2probe_records_dropped_total", &[]);
    let missing = stream.count as f64 - real("ros2_topic_messages_total");
    assert!((0.0..=unseen).contains(&missing), "{missing} of {unseen}");
    assert!(
        (0.0..=missing).contains(&real("ros2_topic_lost_messages_total")),
        "{}",
        page.0
    );
    Ok((ended, [subscriber, publisher]))
}

/// Checks that nodes that start after the storm are discovered, and their messages counted exactly.
fn check_new_participants(agent: &Agent<'_>, link: &Link) -> Result<()> {
    let stream = Stream {
        topic: "/after".to_owned(),
        ..Stream::small(200)
    };
    let both = ["/late_listener", "/late_driver"];
    let [_subscriber, mut publisher] = matched_pair(link, &stream, both)?;
    let came = Instant::now();
    loop {
        let page = agent.scrape()?;
        let nodes = page.labels_of("ros2_node_info", "ros_node");
        let publishers = page.sum("ros2_topic_publishers", &[("topic", "/after")]);
        if both.iter().all(|node| nodes.contains(*node)) && publishers == 1.0 {
            break;
        }
        assert!(
            came.elapsed() < RECOVERY,
            "newcomers are not seen: {nodes:?}"
        );
        std::thread::sleep(Duration::from_millis(200));
    }
    eprintln!("newcomers are seen after {:?}", came.elapsed());
    publisher.start_sending()?;
    publisher.wait_sent(Duration::from_secs(60))?;
    let page = agent.settled_scrape("/after", 200)?;
    let after = page.sum("ros2_topic_messages_total", &[("topic", "/after")]);
    assert_eq!(after, 200.0, "{}", page.0);
    Ok(())
}

fn well_formed(page: &Scrape) {
    let printed = local_agent::promtool(&page.0);
    assert_eq!(printed, "", "{}", page.0);
}
