//! Fast DDS with its default transports on one host. User data, endpoints and node names go through
//! shared memory, and only participants are announced on the network. The agent reads shared memory
//! without a trace.
//!
//! Each host has its own `/dev/shm`, in a mount namespace as a container has it, which the
//! agent reaches through `/proc`. The references are the peers' logs, and the agent's system calls
//! as strace prints them.

mod files;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

const PATIENCE: Duration = Duration::from_secs(60);
/// Minimum share of samples seen that a test requires, on a machine with other load.
const COVERAGE: f64 = 0.1;
/// Maximum number of attempts to start a pair before the agent has its names.
const MAX_START_ATTEMPTS: u32 = 12;

// Coverage: shared memory, sampled | Fast DDS 2.9 | - | counted
#[test]
fn four_streams_in_shared_memory_are_counted_as_they_were_sent() -> Result<()> {
    let streams = [
        ("/imu", 320, 200.0, 4800),
        ("/image", 644_000, 20.0, 400),
        ("/points", 2_720_000, 20.0, 400),
        ("/odom", 900, 50.0, 1000),
    ]
    .map(|(topic, size, rate, count)| Stream {
        topic: topic.to_owned(),
        size,
        rate,
        count,
        stretch: count / 2,
        linger: 60.0,
        ..shared()
    });
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let mut pairs = host.known_pairs(&agent, &streams)?;
    let cpu = |page: &Scrape| page.sum("ros2probe_shm_cpu_seconds_total", &[]);
    let (before, began) = (cpu(&agent.scrape()?), Instant::now());
    for (publisher, _) in &mut pairs {
        publisher.start_sending()?;
    }
    wait_for_true_rate(&agent, &pairs[0].0, "/imu")?;
    let count = |page: &Scrape, stream: &Stream| {
        page.sum("ros2_topic_messages_total", &[("topic", &stream.topic)])
    };
    let half = agent.scrape_until("as many messages as were sent first", |page| {
        // The messages before the first one that the agent saw cannot be counted.
        streams
            .iter()
            .all(|stream| count(page, stream) >= 0.9 * stream.stretch as f64)
    })?;
    let share = 100.0 * (cpu(&half) - before) / began.elapsed().as_secs_f64();
    println!("{share:.2} % of a CPU; {}", shared_memory_metrics(&half));
    // The publishers send no more until the next `go`.
    let half = agent.settled_scrape("/imu", 0)?;
    let began = Instant::now();
    for (publisher, _) in &mut pairs {
        publisher.start_sending()?;
    }
    for ((publisher, _), stream) in pairs.iter_mut().zip(&streams) {
        publisher.wait_sent(PATIENCE)?;
        let sent = publisher.log()?.sequences("pub").len() as u64;
        ensure!(sent == stream.count, "{sent} of {stream:?}");
    }
    let page = agent.settled_scrape("/imu", 0)?;
    let share = 100.0 * (cpu(&page) - cpu(&half)) / began.elapsed().as_secs_f64();
    println!("{share:.2} % of a CPU once nobody is new");
    for stream in &streams {
        assert_counted(stream, &half, &page);
    }
    Ok(())
}

/// Waits until the agent shows the publisher's rate so far, up to a twentieth of it.
fn wait_for_true_rate(agent: &Agent<'_>, publisher: &Peer, topic: &str) -> Result<()> {
    wait_until("the publisher's rate", || {
        let shown = agent.scrape()?;
        let shown = shown.sum("ros2_topic_rate_hertz", &[("topic", topic)]);
        let log = publisher.log()?.0;
        let sent: Vec<u64> = log
            .iter()
            .filter(|event| event.ev == "pub")
            .map(|event| event.t)
            .collect();
        let (Some(first), Some(last)) = (sent.first(), sent.last()) else {
            return Ok(false);
        };
        let rate = (sent.len() - 1) as f64 / ((last - first) as f64 / 1e9);
        Ok((shown - rate).abs() < rate / 20.0)
    })
}

/// Checks the counts of a stream that sent its second stretch between the two pages.
fn assert_counted(stream: &Stream, half: &Scrape, page: &Scrape) {
    let count = |page: &Scrape| page.sum("ros2_topic_messages_total", &[("topic", &stream.topic)]);
    let topic = [("topic", stream.topic.as_str())];
    let sum = |name: &str| page.sum(name, &topic);
    let info = [
        ("topic", stream.topic.as_str()),
        ("message_type", "sensor_msgs/msg/PointCloud2"),
        ("reliability", "RELIABLE"),
        ("durability", "VOLATILE"),
    ];
    assert_eq!(page.sum("ros2_topic_info", &info), 1.0, "{}", page.0);
    let passage = [topic[0], ("passage", "shared_memory")];
    assert_eq!(page.sum("ros2_topic_pairs", &passage), 1.0);
    assert_eq!(sum("ros2_topic_pairs"), 1.0);
    let second = count(page) - count(half);
    assert_eq!(
        second,
        stream.stretch as f64,
        "{}",
        shared_memory_metrics(page)
    );
    // A DATA is padded to four bytes if another submessage follows it.
    let bytes = count(page) * stream.size as f64;
    assert!((sum("ros2_topic_bytes_total") - bytes).abs() <= 4.0 * stream.count as f64);
    assert_eq!(sum("ros2_topic_lost_messages_total"), 0.0);
    let coverage = sum("ros2_topic_sampled_coverage_ratio");
    assert!(coverage > COVERAGE && coverage <= 1.0, "{coverage}");
    let latencies = sum("ros2_topic_latency_seconds_count");
    let seen = sum("ros2_topic_sampled_seen_messages_total");
    assert!(
        latencies > 0.0 && latencies <= seen,
        "{latencies} of {seen}"
    );
}

#[test]
fn a_topic_of_two_middlewares_with_a_remote_subscriber_has_all_its_sources() -> Result<()> {
    let link = Link::new()?;
    let host = Host::new(&link.robot)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&link.robot, directory.path())?;
    let streams = Streams::of_two_middlewares();
    let peers = streams.start_until_known(&host, &link.monitor, &agent)?;
    // The subscribers live until the end, too.
    let [mut publisher, mut talker, _near, _listener, _far] = peers;
    for _ in 0..2 {
        publisher.start_sending()?;
        talker.start_sending()?;
        std::thread::sleep(Duration::from_secs(1));
    }
    for peer in [&publisher, &talker] {
        wait_until("two stretches are sent", || {
            Ok(peer.log()?.sequences("pub").len() >= 400)
        })?;
    }
    // The messages before the first one that the agent saw cannot be counted.
    agent.settled_scrape("/points", 400)?;
    let before = agent.settled_scrape("/imu", 0)?;
    publisher.start_sending()?;
    talker.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    talker.wait_sent(PATIENCE)?;
    agent.settled_scrape("/points", streams.one.count)?;
    let page = agent.settled_scrape("/imu", 0)?;
    let more = |topic| {
        let count = |page: &Scrape| page.sum("ros2_topic_messages_total", &[("topic", topic)]);
        count(&page) - count(&before)
    };
    println!("{}", shared_memory_metrics(&page));
    assert_eq!(more("/imu"), 200.0, "{}", shared_memory_metrics(&page));
    assert_eq!(more("/points"), 200.0);
    assert!(shows_all_pairs(&page), "{}", page.0);
    for topic in ["/imu", "/points"] {
        assert_eq!(page.sum("ros2_topic_publishers", &[("topic", topic)]), 1.0);
    }
    let sampled = |topic| page.sum("ros2_topic_sampled_messages_total", &[("topic", topic)]);
    assert!(sampled("/imu") > 0.0);
    assert_eq!(sampled("/points"), 0.0);
    let lost = page.sum("ros2_topic_lost_messages_total", &[]);
    assert_eq!(lost, 0.0);
    Ok(())
}

/// Streams of a host of two middlewares with a remote subscriber.
struct Streams {
    /// Stream of Fast DDS to two subscribers, through shared memory and the network.
    both: Stream,
    /// The same stream with one peer, for the local subscriber.
    one: Stream,
    /// The same stream for the remote subscriber.
    far: Stream,
    cyclone: Stream,
}

impl Streams {
    fn of_two_middlewares() -> Streams {
        let both = Stream {
            count: 600,
            stretch: 200,
            peers: 2,
            linger: 60.0,
            ..shared()
        };
        let one = Stream {
            peers: 1,
            ..both.clone()
        };
        let cyclone = Stream {
            topic: "/points".to_owned(),
            shares_memory: false,
            ..one.clone()
        };
        let far = Stream {
            shares_memory: false,
            ..one.clone()
        };
        Streams {
            both,
            one,
            far,
            cyclone,
        }
    }

    /// Starts the peers, publishers first, and repeats this until the agent has all endpoints.
    fn start_until_known(
        &self,
        host: &Host<'_>,
        remote: &Namespace,
        agent: &Agent<'_>,
    ) -> Result<[Peer; 5]> {
        for _ in 0..MAX_START_ATTEMPTS {
            let mut peers = [
                host.launch(Role::Publisher, &self.both)?,
                host.launch_stack(Stack::Cyclone, Role::Publisher, &self.cyclone)?,
                host.launch(Role::Subscriber, &self.one)?,
                host.launch_stack(Stack::Cyclone, Role::Subscriber, &self.cyclone)?,
                Peer::launch(remote, Stack::Fast, Role::Subscriber, &self.far, &["/far"])?,
            ];
            for peer in &mut peers {
                peer.wait_ready()?;
            }
            for peer in &mut peers {
                peer.wait_matched()?;
            }
            let deadline = Instant::now() + Duration::from_secs(4);
            while Instant::now() < deadline {
                if shows_all_pairs(&agent.scrape()?) {
                    return Ok(peers);
                }
                std::thread::sleep(Duration::from_millis(200));
            }
            for mut peer in peers {
                peer.process.terminate()?;
            }
            std::thread::sleep(Duration::from_secs(1));
        }
        bail!("endpoints were never all heard")
    }
}

fn shows_all_pairs(page: &Scrape) -> bool {
    let pairs = |topic, passage| {
        let labels = [("topic", topic), ("passage", passage)];
        page.sum("ros2_topic_pairs", &labels)
    };
    pairs("/imu", "shared_memory") == 1.0
        && pairs("/imu", "network") == 1.0
        && pairs("/points", "network") == 1.0
}

// Coverage: data sharing | Fast DDS 2.9 | - | named
#[test]
fn messages_in_shared_histories_are_not_seen_and_the_agent_reports_it() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = Stream {
        shares_history: true,
        count: 200,
        linger: 60.0,
        ..shared()
    };
    let (publisher, _subscriber) = host.known_pair(&agent, &stream)?;
    let page = run(&agent, publisher, &stream)?;
    let pairs = [("topic", "/imu"), ("passage", "data_sharing")];
    assert_eq!(page.sum("ros2_topic_pairs", &pairs), 1.0, "{}", page.0);
    Ok(())
}

#[test]
fn an_agent_without_shared_memory_to_read_takes_almost_no_cpu() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let spent = |what: &str| -> Result<f64> {
        let cpu =
            || -> Result<f64> { Ok(agent.scrape()?.sum("ros2probe_shm_cpu_seconds_total", &[])) };
        let (before, began) = (cpu()?, Instant::now());
        std::thread::sleep(Duration::from_secs(8));
        let share = (cpu()? - before) / began.elapsed().as_secs_f64();
        println!("{what}: {:.2} % of a CPU", 100.0 * share);
        Ok(share)
    };
    assert!(spent("nobody there")? < 0.01);
    let (_publisher, _subscriber) = host.pair(&shared())?;
    std::thread::sleep(Duration::from_secs(4));
    assert!(spent("a pair that is silent")? < 0.04);
    Ok(())
}

/// Measures the names of `docs/benchmarks-parts.md`: `cargo test --test live shm:: -- --ignored
/// --nocapture`.
#[test]
#[ignore = "takes two minutes and prints a figure"]
fn the_ratio_of_starts_after_which_all_names_are_known_is_measured() -> Result<()> {
    const STARTS: usize = 20;
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let mut known = 0;
    for _ in 0..STARTS {
        let (mut publisher, mut subscriber) = host.pair(&shared())?;
        std::thread::sleep(Duration::from_millis(1500));
        known += usize::from(is_known(&agent.scrape()?, &shared()));
        publisher.process.terminate()?;
        subscriber.process.terminate()?;
        std::thread::sleep(Duration::from_secs(1));
    }
    let page = agent.scrape()?;
    let cpu = page.sum("ros2probe_shm_cpu_seconds_total", &[]);
    println!("all known after {known} of {STARTS} starts, for {cpu:.1} s of CPU time");
    ensure!(known * 2 > STARTS, "{known} of {STARTS}");
    Ok(())
}

/// Measures the peers of `docs/benchmarks-parts.md`: `cargo test --test live shm:: -- --ignored
/// --nocapture`.
#[test]
#[ignore = "takes two minutes and a quiet machine to mean anything"]
fn losses_and_delays_of_peers_are_measured_with_and_without_an_agent() -> Result<()> {
    const PAIRS: usize = 10;
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let stream = Stream {
        count: 600,
        reliable: false,
        linger: 60.0,
        ..shared()
    };
    let mut runs = [Vec::new(), Vec::new()];
    for pair in 0..2 * PAIRS {
        // The order is without, with, with, without, and so on, so that a drift affects both.
        let with = usize::from(matches!(pair % 4, 1 | 2));
        let agent = match with {
            1 => Some(start_agent(&network, directory.path())?),
            _ => None,
        };
        let (mut publisher, mut subscriber) = host.pair(&stream)?;
        publisher.start_sending()?;
        publisher.wait_sent(PATIENCE)?;
        subscriber
            .process
            .wait_for("done", Duration::from_secs(2))
            .ok();
        let log = subscriber.log()?;
        let received = log.sequences("sub").len() as u64;
        let mut latencies: Vec<u64> = log
            .0
            .iter()
            .filter_map(|event| Some(event.t.saturating_sub(event.stamp_ns?)))
            .collect();
        latencies.sort_unstable();
        let at = |share: usize| latencies.get(latencies.len() * share / 100).copied();
        let missing = stream.count.saturating_sub(received);
        runs[with].push([
            missing,
            at(50).unwrap_or(0) / 1000,
            at(99).unwrap_or(0) / 1000,
        ]);
        drop(agent);
    }
    for (name, mut runs) in ["without", "with"].iter().zip(runs) {
        let mut median = |column: usize| {
            runs.sort_unstable_by_key(|run| run[column]);
            runs[runs.len() / 2][column]
        };
        let [missing, typical, worst] = [0, 1, 2].map(&mut median);
        println!(
            "{name} an agent, medians of {PAIRS}: {missing} of {} lost, latency {typical} us, \
             99th percentile {worst} us",
            stream.count
        );
    }
    Ok(())
}

#[test]
fn a_nearly_full_directory_is_a_finding_until_space_is_free() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let file = host.shared_memory().join("of_another_program");
    let write = |megabytes: usize| fs::write(&file, vec![1; megabytes << 20]);
    write(50)?;
    std::thread::sleep(Duration::from_secs(6));
    assert_eq!(faults(&agent.scrape()?), 0.0);
    write(60)?;
    wait_for_faults(&agent, 1.0)?;
    fs::remove_file(&file)?;
    wait_for_faults(&agent, 0.0)
}

#[test]
fn files_of_killed_nodes_are_a_finding_until_they_are_removed() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = Stream {
        // The segment of a participant holds two of its messages: 8 % of the directory each.
        size: 2_720_000,
        rate: 10.0,
        ..shared()
    };
    let (mut publisher, mut subscriber) = host.pair(&stream)?;
    publisher.start_sending()?;
    std::thread::sleep(Duration::from_secs(6));
    assert_eq!(faults(&agent.scrape()?), 0.0);
    for peer in [&mut publisher, &mut subscriber] {
        peer.process.signal("KILL")?;
    }
    // What a node that crashes again and again leaves.
    let left = host.shared_memory().join("fastrtps_0123456789abcdef");
    fs::write(&left, vec![1; 8 << 20])?;
    fs::write(left.with_file_name("fastrtps_0123456789abcdef_el"), "")?;
    wait_for_faults(&agent, 1.0)?;
    host.remove_shared_memory()?;
    wait_for_faults(&agent, 0.0)
}

#[test]
fn nodes_with_different_directories_in_one_network_are_a_finding() -> Result<()> {
    let network = Namespace::isolated()?;
    let hosts = [Host::new(&network)?, Host::new(&network)?];
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = shared();
    let mut peers = Vec::new();
    for (host, role) in hosts.iter().zip([Role::Subscriber, Role::Publisher]) {
        assert_eq!(faults(&agent.scrape()?), 0.0);
        let mut peer = host.launch(role, &stream)?;
        peer.wait_ready()?;
        peers.push(peer);
    }
    wait_for_faults(&agent, 1.0)?;
    for peer in &mut peers {
        peer.process.terminate()?;
    }
    wait_for_faults(&agent, 0.0)
}

/// Waits until this number of findings about shared memory exists.
fn wait_for_faults(agent: &Agent<'_>, number: f64) -> Result<()> {
    agent.scrape_until("the finding, or its end", |page| faults(page) == number)?;
    Ok(())
}

fn faults(page: &Scrape) -> f64 {
    page.sum("ros2_diagnoses", &[("kind", "shared_memory_fault")])
}

/// A host with its own `/dev/shm`.
struct Host<'n> {
    network: &'n Namespace,
    /// The process that keeps the mount namespace.
    keeper: Process,
}

impl<'n> Host<'n> {
    fn new(network: &'n Namespace) -> Result<Host<'n>> {
        let script = "mount -t tmpfs -o size=64m,mode=1777 shm /dev/shm && echo ready && exec cat";
        let arguments = ["--mount", "sh", "-c", script];
        let mut keeper = Process::start(&network.on_network(), "unshare", arguments)?;
        keeper.wait_for("ready", PATIENCE)?;
        Ok(Host { network, keeper })
    }

    fn launch(&self, role: Role, stream: &Stream) -> Result<Peer> {
        self.launch_stack(Stack::Fast, role, stream)
    }

    fn launch_stack(&self, stack: Stack, role: Role, stream: &Stream) -> Result<Peer> {
        let mut enter = self.network.on_network();
        let mounts = format!("--mount=/proc/{}/ns/mnt", self.keeper.pid());
        enter.extend(["nsenter".to_owned(), mounts]);
        Peer::launch_behind(&enter, stack, role, stream, &[&node_of(role, stream)])
    }

    /// Starts a publisher and a matched subscriber.
    fn pair(&self, stream: &Stream) -> Result<(Peer, Peer)> {
        let mut subscriber = self.launch(Role::Subscriber, stream)?;
        subscriber.wait_ready()?;
        let mut publisher = self.launch(Role::Publisher, stream)?;
        publisher.wait_ready()?;
        publisher.wait_matched()?;
        subscriber.wait_matched()?;
        Ok((publisher, subscriber))
    }

    /// Starts one pair as [`Self::known_pairs`] does.
    fn known_pair(&self, agent: &Agent<'_>, stream: &Stream) -> Result<(Peer, Peer)> {
        let mut pairs = self.known_pairs(agent, std::slice::from_ref(stream))?;
        pairs.pop().context("no pair")
    }

    /// Starts a pair for each stream as [`Self::pair`] does, until the agent has all names. Names
    /// are announced once, and their memory is reused within a moment. A tap without CPU time in
    /// that moment misses them.
    fn known_pairs(&self, agent: &Agent<'_>, streams: &[Stream]) -> Result<Vec<(Peer, Peer)>> {
        for attempt in 1..=MAX_START_ATTEMPTS {
            let pairs: Result<Vec<_>> = streams.iter().map(|stream| self.pair(stream)).collect();
            let pairs = pairs?;
            let deadline = Instant::now() + Duration::from_secs(3);
            while Instant::now() < deadline {
                let page = agent.scrape()?;
                if streams.iter().all(|stream| is_known(&page, stream)) {
                    println!("{} known at attempt {attempt}", streams.len());
                    return Ok(pairs);
                }
                std::thread::sleep(Duration::from_millis(200));
            }
            for (mut publisher, mut subscriber) in pairs {
                publisher.process.terminate()?;
                subscriber.process.terminate()?;
            }
            std::thread::sleep(Duration::from_secs(1));
        }
        bail!("their names did not become known in {MAX_START_ATTEMPTS} attempts")
    }

    /// Returns the files of this host's shared memory that the agent has open.
    fn files_open_in(&self, agent: &Agent<'_>) -> Result<Vec<String>> {
        let open = fs::read_dir(format!("/proc/{}/fd", agent.process.pid()))?;
        let links = open
            .flatten()
            .filter_map(|entry| fs::read_link(entry.path()).ok());
        let names = links.map(|link| link.to_string_lossy().into_owned());
        Ok(names.filter(|name| name.contains("fastrtps_")).collect())
    }

    /// Returns the path of the shared memory from outside.
    fn shared_memory(&self) -> PathBuf {
        PathBuf::from(format!("/proc/{}/root/dev/shm", self.keeper.pid()))
    }

    /// Removes the files as `fastdds shm clean` would.
    fn remove_shared_memory(&self) -> Result<()> {
        for entry in fs::read_dir(self.shared_memory())? {
            fs::remove_file(entry?.path())?;
        }
        Ok(())
    }
}

/// Returns a reliable stream as `rmw_fastrtps_cpp` publishes it by default.
fn shared() -> Stream {
    Stream {
        reliable: true,
        shares_memory: true,
        // Some of these streams have large samples, of which a history keeps all.
        depth: 100,
        ..Stream::small(0)
    }
}

fn node_of(role: Role, stream: &Stream) -> String {
    let name = stream.topic.trim_start_matches('/');
    match role {
        Role::Publisher => format!("/{name}_talker"),
        Role::Subscriber => format!("/{name}_listener"),
    }
}

/// Returns whether the agent has both nodes and both endpoints of the stream's topic.
fn is_known(page: &Scrape, stream: &Stream) -> bool {
    let nodes = page.labels_of("ros2_node_info", "ros_node");
    let roles = [Role::Publisher, Role::Subscriber];
    let endpoints = ["ros2_topic_publishers", "ros2_topic_subscriptions"];
    roles
        .iter()
        .all(|role| nodes.contains(&node_of(*role, stream)))
        && endpoints
            .iter()
            .all(|name| page.sum(name, &[("topic", &stream.topic)]) == 1.0)
}

/// Returns the names of ports and of segments.
fn files_of(memory: &Path) -> Result<(Vec<String>, Vec<String>)> {
    let mut names: Vec<_> = fs::read_dir(memory)?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<Result<_>>()?;
    names.retain(|name| name.starts_with("fastrtps_") && !name.ends_with("l"));
    Ok(names.into_iter().partition(|name| name.contains("_port")))
}

fn start_agent<'a>(host: &'a Namespace, directory: &Path) -> Result<Agent<'a>> {
    let configuration = directory.join("ros2probe.yaml");
    // These tests cover polling only.
    let cgroup = host.cgroup().display();
    let capture = format!("capture: {{source: host, cgroup: {cgroup}, shm: {{exact: off}}}}");
    fs::write(&configuration, format!("watch: [/**]\n{capture}\n"))?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}

/// Lets the publisher send everything, and returns the page.
fn run(agent: &Agent<'_>, mut publisher: Peer, stream: &Stream) -> Result<Scrape> {
    // Waits until names and endpoints have settled.
    std::thread::sleep(Duration::from_secs(1));
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let sent = publisher.log()?.sequences("pub").len() as u64;
    ensure!(
        sent == stream.count,
        "{sent} of {} were accepted",
        stream.count
    );
    agent.settled_scrape(&stream.topic, 0)
}

/// Returns the agent's metrics of shared memory.
fn shared_memory_metrics(page: &Scrape) -> String {
    let lines = page.0.lines().filter(|line| {
        !line.starts_with('#') && (line.contains("_shm_") || line.contains("_sampled_"))
            || line.starts_with("ros2_topic_messages_total")
    });
    lines.collect::<Vec<_>>().join("; ")
}
