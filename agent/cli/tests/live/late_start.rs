//! A robot that started before the agent. The agent restores the announcements from before its own
//! restart, and `rp discover` requests the others. Until then, writers appear without names.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context as _, Result};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::capture::{Capture, SETTLE};
use ros2probe_testing::harness::event_log::EventLog;
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum time until a restarted agent has all names, on a busy machine. Endpoints are announced
/// only once.
const AT_ONCE: Duration = Duration::from_secs(30);
/// Time after which the agent has written its state: 3 s after a change, with a margin.
const WRITTEN_AFTER: Duration = Duration::from_secs(4);
/// Maximum duration of a write that began before a change.
const WRITE_TIME: Duration = Duration::from_millis(500);
/// Time for two announcements of each participant.
const TWO_ANNOUNCEMENTS_TIME: Duration = Duration::from_secs(7);
/// Seconds in which each participant announces itself at least once.
const LISTEN: &str = "5";
/// Makes Cyclone DDS announce itself every 3 s, as Fast DDS does, instead of every 8 s.
const FREQUENT_SPDP: &str = "CYCLONEDDS_URI=<Discovery><SPDPInterval>3s</SPDPInterval></Discovery>";
const NODES: [&str; 3] = ["/camera", "/listener", "/talker"];

#[test]
fn an_agent_restarted_on_a_running_fast_dds_robot_has_all_names() -> Result<()> {
    restarted_on_a_running_robot(Stack::Fast)
}

#[test]
fn an_agent_restarted_on_a_running_cyclone_dds_robot_has_all_names() -> Result<()> {
    restarted_on_a_running_robot(Stack::Cyclone)
}

#[test]
fn a_running_fast_dds_robot_repeats_all_names_on_request() -> Result<()> {
    asked(Stack::Fast)
}

#[test]
fn a_running_cyclone_dds_robot_repeats_all_names_on_request() -> Result<()> {
    asked(Stack::Cyclone)
}

#[test]
fn a_full_disk_loses_only_the_state_and_logs_one_line() -> Result<()> {
    let scene = Scene::new()?;
    let state = scene.file("state");
    let _disk = Disk::mount(&state)?;
    fs::write(state.join("something-else"), [7; 44 << 10])?;
    let log = scene.file("log");
    let program = env!("CARGO_BIN_EXE_rp");
    let agent = Agent::start_logging(&scene.place, program, &scene.configuration()?, &log)?;
    let _robot = scene.robot(Stack::Cyclone)?;
    let written = |outcome: &'static str, least: f64| {
        let labels = [("outcome", outcome)];
        move |page: &Scrape| {
            let count = page.value("ros2probe_state_writes_total", &labels);
            count.is_some_and(|count| count >= least)
        }
    };
    // A state without participants still fits.
    wait(&agent, written("failed", 1.0), PATIENCE, "a failure")?;
    let known = |page: &Scrape| nodes(page).len() == NODES.len() && has_names(page);
    let page = wait(&agent, known, PATIENCE, "all names")?;
    let before = page.value("ros2probe_state_writes_total", &[("outcome", "written")]);
    // A thread of its own writes the log.
    let warning = "cannot save state";
    harness::wait_until(warning, || Ok(fs::read_to_string(&log)?.contains(warning)))?;
    let lines = fs::read_to_string(&log)?;
    assert_eq!(lines.matches(warning).count(), 1, "{lines}");
    fs::remove_file(state.join("something-else"))?;
    // The next change writes the state again.
    let stream = Stream::small(1);
    let host = &scene.link.robot;
    let _more = Peer::start(host, Stack::Cyclone, Role::Subscriber, &stream, &["/more"])?;
    let again = written("written", before.unwrap_or(0.0) + 1.0);
    wait(&agent, again, PATIENCE, "a state that is written again")?;
    // It may be written before the new node is announced, and then once more.
    harness::wait_until("the state with the new node", || {
        let state = fs::read_to_string(state.join("discovery.json"))?;
        Ok(state.contains("/talker") && state.contains("/more"))
    })
}

/// A very small disk.
struct Disk(PathBuf);

impl Disk {
    fn mount(place: &Path) -> Result<Disk> {
        harness::run(&format!(
            "mount -t tmpfs -o size=48k tmpfs {}",
            place.display()
        ))?;
        Ok(Disk(place.to_path_buf()))
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = harness::run(&format!("umount -l {}", self.0.display()));
    }
}

fn restarted_on_a_running_robot(stack: Stack) -> Result<()> {
    let scene = Scene::new()?;
    let agent = scene.agent()?;
    let robot = scene.robot(stack)?;
    let known = |page: &Scrape| nodes(page).len() == NODES.len() && has_names(page);
    let before = wait(&agent, known, PATIENCE, "all names")?;
    scene.wait_saved()?;
    agent.process.signal("KILL")?;
    drop(agent);
    let recording = Capture::start(&scene.place, &scene.file("agent.pcap"))?;
    let started = Instant::now();
    let mut agent = scene.agent()?;
    let after = wait(&agent, known, AT_ONCE, "all names after the restart")?;
    println!(
        "{stack:?}: all names {:?} after the start",
        started.elapsed()
    );
    for name in ["ros2_node_info", "ros2_topic_info", "ros2_participants"] {
        assert_eq!(lines(&after, name), lines(&before, name), "{name}");
    }
    assert_eq!(after.sum("ros2_discovery_events_total", &[]), 0.0);
    let confirmed = |page: &Scrape| page.value("ros2probe_restored_participants", &[]) == Some(0.0);
    let page = wait(&agent, confirmed, PATIENCE, "everybody confirmed")?;
    assert_eq!(nodes(&page).len(), NODES.len());
    assert_eq!(page.sum("ros2_unknown_writers", &[]), 0.0);
    assert!(page.sum("ros2_topic_messages_total", &[("topic", "/imu")]) > 0.0);
    assert!(agent.process.udp_ports()?.is_empty());
    agent.process.terminate()?;
    std::thread::sleep(SETTLE);
    assert_eq!(
        count(&recording.finish()?, "udp or igmp")?,
        0,
        "the agent sent"
    );

    // A participant that leaves while the agent is stopped is removed after one lease.
    drop(robot);
    let agent = scene.agent()?;
    wait(&agent, known, AT_ONCE, "names of the dead")?;
    let gone = |page: &Scrape| page.sum("ros2_participants", &[]) == 0.0;
    let page = wait(&agent, gone, PATIENCE, "nobody")?;
    assert!(nodes(&page).is_empty());
    assert_eq!(
        page.value("ros2probe_restored_participants", &[]),
        Some(0.0)
    );
    Ok(())
}

fn asked(stack: Stack) -> Result<()> {
    let scene = Scene::new()?;
    let robot = scene.robot(stack)?;
    std::thread::sleep(Duration::from_secs(1));
    let agent = scene.agent()?;
    let page = shows_an_unknown_writer(&agent, &robot)?;
    check_dry_run(&scene, &page)?;

    let path = scene.file("asked.pcap");
    let recording = Capture::start(&scene.link.monitor, &path)?;
    let log_before = robot.log()?;
    let printed = discovers_all_names(&scene, &agent)?;
    std::thread::sleep(TWO_ANNOUNCEMENTS_TIME);
    std::thread::sleep(SETTLE);
    check_printed_packets(&scene, &recording.finish()?, &printed)?;
    check_robot_counts(&robot, &log_before)?;
    let participants = |page: &Scrape| page.sum("ros2_participants", &[]) == 2.0;
    wait(&agent, participants, AT_ONCE, "the two that were there")?;
    Ok(())
}

/// Waits for the writer's rate and process, and returns that page, which has no name yet.
fn shows_an_unknown_writer(agent: &Agent<'_>, robot: &Robot) -> Result<Scrape> {
    let unknown = |page: &Scrape| {
        let rate = page.value("ros2_unknown_writer_rate_hertz", &[]);
        let processes = page.labels_of("ros2_unknown_writer_info", "process");
        let has_participants = page.sum("ros2_participants", &[]) == 2.0;
        has_participants
            && rate.is_some_and(|rate| (80.0..120.0).contains(&rate))
            && processes.len() == 1
    };
    let page = wait(agent, unknown, PATIENCE, "an unknown writer with its rate")?;
    let values = |label| page.labels_of("ros2_unknown_writer_info", label);
    let one = |text: &str| BTreeSet::from([text.to_owned()]);
    assert_eq!(
        values("pid"),
        one(&robot.publisher.process.pid().to_string())
    );
    assert!(values("process").iter().all(|name| !name.is_empty()));
    assert!(
        values("vendor").iter().all(|name| name.contains("DDS")),
        "{}",
        page.0
    );
    assert!(nodes(&page).is_empty() && !has_names(&page));
    Ok(page)
}

/// Checks `rp discover --dry-run` for all participants and for one.
fn check_dry_run(scene: &Scene, page: &Scrape) -> Result<()> {
    let recording = Capture::start(&scene.link.monitor, &scene.file("dry.pcap"))?;
    let output = scene.discover(&["--all", "--dry-run", "--interface", INTERFACE])?;
    let output_text = String::from_utf8(output.stdout)?;
    assert!(
        output.status.success() && output_text.starts_with("2 participants"),
        "{output_text}"
    );
    let guids = page.labels_of("ros2_participant_info", "participant");
    let one = guids.first().context("no participant")?;
    let output = scene.discover(&["--participant", one, "--dry-run", "--no-nodes"])?;
    let output_text = String::from_utf8(output.stdout)?;
    assert!(
        output.status.success() && output_text.starts_with("1 participant "),
        "{output_text}"
    );
    let plan = ["introduction", "request", "goodbye"];
    let planned = output_text
        .lines()
        .filter(|line| line.contains(", at most "));
    let planned = planned.map(|line| line.trim().split(',').next().unwrap_or_default());
    assert_eq!(planned.collect::<Vec<_>>(), plan, "{output_text}");
    std::thread::sleep(SETTLE);
    let sent = count(&recording.finish()?, &scene.packets_of_discover())?;
    assert_eq!(sent, 0, "a dry run sent");
    Ok(())
}

/// Runs `rp discover --all`, and returns its output.
fn discovers_all_names(scene: &Scene, agent: &Agent<'_>) -> Result<String> {
    let output = scene.discover(&["--all"])?;
    let output_text = String::from_utf8(output.stdout)?;
    println!("{output_text}");
    assert!(output.status.success(), "{output_text}");
    for node in NODES {
        assert!(
            output_text.contains(&format!("node   {node}\n")),
            "{output_text}"
        );
    }
    assert!(
        output_text.contains("writer /imu sensor_msgs/msg/PointCloud2\n"),
        "{output_text}"
    );
    let known = |page: &Scrape| nodes(page) == NODES.map(str::to_owned).into() && has_names(page);
    let page = wait(agent, known, AT_ONCE * 2, "all names after asking")?;
    assert_eq!(page.sum("ros2_unknown_writers", &[]), 0.0);
    Ok(output_text)
}

/// Checks that only the robot receives packets, as many as `rp discover` printed. Each conversation
/// begins with the introduction and ends with the goodbye.
fn check_printed_packets(scene: &Scene, recording: &Path, printed: &str) -> Result<()> {
    let monitor = scene.link.monitor.address();
    let ours = scene.packets_of_discover();
    let sent = printed
        .lines()
        .filter_map(|line| line.trim().strip_prefix("sent "));
    let sent = sent.map(|line| line.split_once(' ').map_or("", |(count, _)| count).parse());
    let sent: Vec<usize> = sent.collect::<Result<_, _>>()?;
    assert_eq!(sent.len(), 2, "{printed}");
    assert!(
        sent.iter().all(|packets| (4..=20).contains(packets)),
        "{printed}"
    );
    assert_eq!(count(recording, &ours)?, sent.iter().sum::<usize>());
    let to_others = format!("{ours} and not dst host {}", scene.link.robot.address());
    assert_eq!(count(recording, &to_others)?, 0);
    let refusals = format!("icmp and host {monitor}");
    assert_eq!(
        count(recording, &refusals)?,
        0,
        "a port was closed too early"
    );
    let conversations = ports(recording, &ours)?;
    assert_eq!(conversations.len(), 2);
    for port in conversations {
        let own = format!("{ours} and src port {port}");
        let packets = payloads(recording, &own)?;
        let is = |packet: &str, mark: &str| packet.contains(mark);
        // The patterns are PID_BUILTIN_ENDPOINT_SET, and PID_STATUS_INFO of a goodbye.
        assert!(is(&packets[0], "5800040039000000"), "{packets:?}");
        let last = packets.last().context("no packet")?;
        assert!(is(last, "7100040000000003"), "{packets:?}");
        // A participant that still knew the port would send an announcement each three seconds.
        let answers = format!("udp and dst port {port}");
        let last = |filter: &str| -> Result<f64> {
            Ok(times(recording, filter)?.last().copied().unwrap_or(0.0))
        };
        let late = last(&answers)? - last(&own)?;
        assert!(late < 7.0, "packets to a port that is gone, {late} s later");
    }
    Ok(())
}

/// Checks that the robot's logs show no other endpoints and no missing sample.
fn check_robot_counts(robot: &Robot, log_before: &[EventLog; 2]) -> Result<()> {
    let log_after = robot.log()?;
    assert_eq!(endpoints(log_before), endpoints(&log_after));
    let received = log_after[1].sequences("sub");
    assert!(
        received.windows(2).all(|pair| pair[1] == pair[0] + 1),
        "{received:?}"
    );
    assert!(received.len() > log_before[1].sequences("sub").len() + 100);
    Ok(())
}

/// A link with a robot on one end, and a host for the agent that is on neither end.
struct Scene {
    link: Link,
    place: Namespace,
    directory: TempDir,
}

struct Robot {
    publisher: Peer,
    subscriber: Peer,
}

impl Scene {
    fn new() -> Result<Scene> {
        let directory = tempfile::tempdir()?;
        fs::create_dir(directory.path().join("state"))?;
        Ok(Scene {
            link: Link::new()?,
            place: Namespace::isolated()?,
            directory,
        })
    }

    fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Waits until the agent has written its present state, so that a crash keeps it.
    fn wait_saved(&self) -> Result<()> {
        let file = self.file("state").join("discovery.json");
        let (known, since) = (SystemTime::now() + WRITE_TIME, Instant::now());
        harness::wait_until("the state is saved", || {
            let saved = fs::read_to_string(&file).unwrap_or_default();
            let written = fs::metadata(&file).and_then(|file| file.modified());
            let is_new = written.is_ok_and(|at| at > known) || since.elapsed() > WRITTEN_AFTER;
            Ok(is_new && NODES.iter().all(|node| saved.contains(node)))
        })
    }

    fn configuration(&self) -> Result<PathBuf> {
        let file = self.file("ros2probe.yaml");
        let cgroup = self.link.cgroup().display();
        let state = self.file("state");
        let text = format!(
            "watch: [/**]\nlog: warn\nstate_directory: {}\ncapture: {{source: host, cgroup: {cgroup}}}\n",
            state.display()
        );
        fs::write(&file, text)?;
        Ok(file)
    }

    fn agent(&self) -> Result<Agent<'_>> {
        let program = env!("CARGO_BIN_EXE_rp");
        Agent::start(&self.place, program, &self.configuration()?)
    }

    /// Starts a publisher with two nodes and its subscriber, on one host.
    fn robot(&self, stack: Stack) -> Result<Robot> {
        let stream = Stream {
            rate: 100.0,
            reliable: true,
            // The agent observes every domain.
            domain: if stack == Stack::Fast { 3 } else { 0 },
            ..Stream::small(100_000)
        };
        let mut host = self.link.robot.inside();
        host.extend(["env", FREQUENT_SPDP].map(str::to_owned));
        let start = |role, nodes: &[&str]| Peer::launch_behind(&host, stack, role, &stream, nodes);
        let mut subscriber = start(Role::Subscriber, &["/listener"])?;
        subscriber.wait_ready()?;
        let mut publisher = start(Role::Publisher, &["/talker", "/camera"])?;
        publisher.wait_ready()?;
        subscriber.wait_matched()?;
        publisher.wait_matched()?;
        publisher.start_sending()?;
        Ok(Robot {
            publisher,
            subscriber,
        })
    }

    /// Returns the filter for the packets that `rp discover` sends.
    fn packets_of_discover(&self) -> String {
        format!("udp and src host {}", self.link.monitor.address())
    }

    /// Runs `rp discover` on the other end of the link.
    fn discover(&self, arguments: &[&str]) -> Result<Output> {
        let words = self.link.monitor.on_network();
        let [enter, words @ ..] = &words[..] else {
            anyhow::bail!("no host");
        };
        let output = Command::new(enter)
            .args(words)
            .arg(Path::new(env!("CARGO_BIN_EXE_rp")))
            .args(["discover", "--listen", LISTEN])
            .args(arguments)
            .arg("--config")
            .arg(self.configuration()?)
            .output()?;
        Ok(output)
    }
}

impl Robot {
    fn log(&self) -> Result<[EventLog; 2]> {
        Ok([self.publisher.log()?, self.subscriber.log()?])
    }
}

fn endpoints(logs: &[EventLog]) -> Vec<String> {
    let events = logs.iter().flat_map(|log| &log.0);
    let other = events.filter(|event| !matches!(event.ev.as_str(), "pub" | "sub"));
    other.map(|event| format!("{event:?}")).collect()
}

fn nodes(page: &Scrape) -> BTreeSet<String> {
    page.labels_of("ros2_node_info", "ros_node")
}

fn has_names(page: &Scrape) -> bool {
    let ends = ["ros2_topic_publishers", "ros2_topic_subscriptions"];
    let one = |name: &&str| page.value(name, &[("topic", "/imu")]) == Some(1.0);
    let typed = page.labels_of("ros2_topic_info", "message_type");
    ends.iter().all(one) && typed.contains("sensor_msgs/msg/PointCloud2")
}

fn lines<'a>(page: &'a Scrape, name: &str) -> BTreeSet<&'a str> {
    let lines = page.0.lines();
    lines.filter(|line| line.starts_with(name)).collect()
}

/// Scrapes until the page shows `what`.
fn wait(
    agent: &Agent<'_>,
    shows: impl Fn(&Scrape) -> bool,
    limit: Duration,
    what: &str,
) -> Result<Scrape> {
    let deadline = Instant::now() + limit;
    loop {
        let page = agent.scrape()?;
        if shows(&page) {
            return Ok(page);
        }
        let in_time = Instant::now() < deadline;
        assert!(in_time, "not {what} within {limit:?}: {}", page.0);
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// Returns tcpdump's output for the packets of a recording that match this filter.
fn read(recording: &Path, options: &str, filter: &str) -> Result<String> {
    let file = recording.display();
    harness::run(&format!("tcpdump -nn -tt {options} -r {file} {filter}"))
}

fn count(recording: &Path, filter: &str) -> Result<usize> {
    Ok(read(recording, "", filter)?.lines().count())
}

fn times(recording: &Path, filter: &str) -> Result<Vec<f64>> {
    let text = read(recording, "", filter)?;
    let times = text.lines().filter_map(|line| line.split(' ').next());
    times.map(|time| time.parse().context("no time")).collect()
}

/// Returns the source ports.
fn ports(recording: &Path, filter: &str) -> Result<BTreeSet<u16>> {
    let text = read(recording, "", filter)?;
    // 1795143000.123 IP 10.99.0.2.40123 > 10.99.0.1.7412: UDP, length 208
    let sources = text.lines().filter_map(|line| line.split(' ').nth(2));
    let ports = sources.filter_map(|source| source.rsplit('.').next());
    ports.map(|port| port.parse().context("no port")).collect()
}

/// Returns the hexadecimal digits of each packet.
fn payloads(recording: &Path, filter: &str) -> Result<Vec<String>> {
    let text = read(recording, "-x", filter)?;
    let mut packets: Vec<String> = Vec::new();
    for line in text.lines() {
        match line.trim_start().split_once(":  ") {
            Some((offset, digits)) if offset.starts_with("0x") => {
                let packet = packets.last_mut().context("digits of no packet")?;
                packet.extend(digits.chars().filter(char::is_ascii_hexdigit));
            }
            _ => packets.push(String::new()),
        }
    }
    Ok(packets)
}
