//! Fast DDS with its default transports on one host: user data, endpoints and node names go through
//! shared memory, and nothing but participants shows on the network. The agent reads it, and nobody
//! can tell.
//!
//! Each host has a `/dev/shm` of its own, in a mount namespace as a container has it, which the agent
//! reaches through `/proc`. The judges are the peers' logs, and what strace says of the agent.

mod harness;

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use harness::agent::{Agent, Scrape, at_the_sockets_of};
use harness::network::Namespace;
use harness::peer::{Peer, Role, Stack, Stream};
use harness::process::Process;

const PATIENCE: Duration = Duration::from_secs(60);
/// Of the samples that there were, those that were seen: what is asked for on a machine that does
/// other things, too.
const COVERAGE: f64 = 0.1;
/// How often a pair may meet before its names are known.
const MEETINGS: u32 = 12;

#[test]
fn what_goes_through_shared_memory_is_counted_as_it_was_sent() -> Result<()> {
    for (size, rate, count) in [
        (320, 200.0, 2000),
        (644_000, 20.0, 200),
        (2_720_000, 20.0, 200),
    ] {
        let host = Host::new()?;
        let directory = tempfile::tempdir()?;
        let agent = start_agent(&host.network, directory.path(), "")?;
        let stream = Stream {
            topic: "/points".to_owned(),
            size,
            rate,
            count,
            stretch: count / 2,
            linger: 60.0,
            ..shared()
        };
        let (mut publisher, _subscriber) = host.known_pair(&agent, &stream)?;
        let cpu = |page: &Scrape| page.sum("ros2probe_shm_cpu_seconds_total", &[]);
        let (before, began) = (cpu(&agent.scrape()?), Instant::now());
        publisher.go()?;
        std::thread::sleep(Duration::from_secs_f64(count as f64 / 2.0 / rate + 0.5));
        let half = agent.settled_scrape(&stream.topic, 0)?;
        let page = run(&agent, publisher, &stream)?;
        let share = 100.0 * (cpu(&page) - before) / began.elapsed().as_secs_f64();
        println!(
            "{size} B at {rate} Hz: {share:.2} % of a CPU; {}",
            telling(&page)
        );
        let topic = [("topic", "/points")];
        let sum = |name: &str| page.sum(name, &topic);
        let info = [
            ("topic", "/points"),
            ("message_type", "sensor_msgs/msg/PointCloud2"),
            ("reliability", "RELIABLE"),
            ("durability", "VOLATILE"),
        ];
        assert_eq!(page.sum("ros2_topic_info", &info), 1.0, "{}", page.0);
        assert_eq!(sum("ros2_topic_publishers"), 1.0);
        assert_eq!(sum("ros2_topic_subscriptions"), 1.0);
        let pairs = [("topic", "/points"), ("passage", "shared_memory")];
        assert_eq!(page.sum("ros2_topic_pairs", &pairs), 1.0);
        assert_eq!(sum("ros2_topic_pairs"), 1.0);

        // What was sent before the first one that was seen, nobody can count.
        let sent = (count / 2) as f64;
        let first = half.sum("ros2_topic_messages_total", &topic);
        assert!((sent - 3.0..=sent).contains(&first), "{first} of {sent}");
        let second = sum("ros2_topic_messages_total") - first;
        assert_eq!(second, sent, "{}", telling(&page));
        // A DATA is padded to four bytes where another submessage follows it.
        let bytes = sum("ros2_topic_messages_total") * size as f64;
        assert!((sum("ros2_topic_bytes_total") - bytes).abs() <= 4.0 * count as f64);
        assert_eq!(sum("ros2_topic_lost_messages_total"), 0.0);
        let coverage = sum("ros2_topic_sampled_coverage_ratio");
        assert!(coverage > COVERAGE && coverage <= 1.0, "{coverage}");
    }
    Ok(())
}

#[test]
fn the_rate_is_that_of_the_publisher() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), "")?;
    let stream = Stream {
        count: 100_000,
        ..shared()
    };
    let (mut publisher, _subscriber) = host.known_pair(&agent, &stream)?;
    publisher.go()?;
    std::thread::sleep(Duration::from_secs(13));
    let page = agent.scrape()?;
    let rate = page.sum("ros2_topic_rate_hertz", &[("topic", "/imu")]);
    assert!((rate - stream.rate).abs() < 0.02 * stream.rate, "{rate}");
    let latencies = page.sum("ros2_topic_latency_seconds_count", &[("topic", "/imu")]);
    let seen = page.sum("ros2_topic_sampled_seen_messages_total", &[]);
    assert!(
        latencies > 0.0 && latencies <= seen,
        "{latencies} of {seen}"
    );
    Ok(())
}

#[test]
fn after_either_side_was_killed_everything_is_right_again_and_nothing_is_left_open() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), "")?;
    let stream = Stream {
        count: 1_000_000,
        ..shared()
    };
    let (mut publisher, mut subscriber) = host.known_pair(&agent, &stream)?;
    publisher.go()?;
    let flows = || -> Result<bool> {
        let sum = |page: Scrape| page.sum("ros2_topic_messages_total", &[("topic", "/imu")]);
        let before = sum(agent.scrape()?);
        std::thread::sleep(Duration::from_secs(1));
        Ok(sum(agent.scrape()?) - before > 100.0)
    };
    wait_until("messages flow", flows)?;
    let mut most = 0;
    for round in 0..4 {
        let role = match round % 2 {
            0 => Role::Subscriber,
            _ => Role::Publisher,
        };
        // Endpoints are announced in shared memory, too: a new publisher may go unnoticed.
        let mut is_right_again = |attempt: u32| -> Result<bool> {
            println!("{role:?} killed, attempt {attempt}");
            let peer = match role {
                Role::Subscriber => &mut subscriber,
                Role::Publisher => &mut publisher,
            };
            peer.process.signal("KILL")?;
            peer.process.wait(Duration::from_secs(5))?;
            *peer = host.launch(role, &stream)?;
            peer.wait_ready()?;
            if role == Role::Publisher {
                peer.go()?;
            }
            std::thread::sleep(Duration::from_secs(2));
            most = most.max(host.files_open_in(&agent)?);
            Ok(flows()? || flows()?)
        };
        let mut attempts = 1..=MEETINGS;
        loop {
            let attempt = attempts
                .next()
                .context("a peer that was killed is not found again")?;
            if is_right_again(attempt)? {
                break;
            }
        }
    }
    // A port and a segment of each of two peers, and of some that were killed and are not tidied up.
    assert!((4..=64).contains(&most), "{most} files");
    for peer in [&mut publisher, &mut subscriber] {
        peer.process.terminate()?;
    }
    host.remove_shared_memory()?;
    wait_until("everything is let go", || {
        Ok(host.files_open_in(&agent)? == 0)
    })?;
    let page = agent.settled_scrape(&stream.topic, 0)?;
    assert_eq!(page.sum("ros2_topic_lost_messages_total", &[]), 0.0);
    assert_eq!(page.sum("ros2probe_shm_open", &[("kind", "port")]), 0.0);
    Ok(())
}

#[test]
fn nothing_below_dev_shm_is_opened_but_for_reading_and_nothing_is_mapped() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), "")?;
    let trace = directory.path().join("trace");
    let pid = agent.process.pid().to_string();
    let mut strace = Command::new("strace")
        .args(["-f", "-y", "-qq", "-p", &pid, "-o"])
        .arg(&trace)
        .spawn()
        .context("cannot run strace: apt-get install strace")?;
    std::thread::sleep(Duration::from_secs(1));
    let stream = Stream {
        count: 400,
        linger: 60.0,
        ..shared()
    };
    let (publisher, _subscriber) = host.known_pair(&agent, &stream)?;
    let page = run(&agent, publisher, &stream)?;
    let _ = Command::new("kill")
        .args(["-INT", &strace.id().to_string()])
        .status();
    strace.wait()?;
    assert!(
        page.sum("ros2_topic_sampled_seen_messages_total", &[]) > 0.0,
        "{}",
        telling(&page)
    );

    let trace = fs::read_to_string(&trace)?;
    let of_shared_memory: Vec<&str> = trace
        .lines()
        .filter(|line| line.contains("dev/shm"))
        .collect();
    assert!(
        of_shared_memory
            .iter()
            .any(|line| line.contains("pread64("))
    );
    for line in of_shared_memory {
        let (_, call) = line.trim().split_once(' ').unwrap_or_default();
        let name = call.trim().split('(').next().unwrap_or_default();
        let is_harmless = match name {
            "openat" => {
                let writes = ["O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC"];
                line.contains("O_RDONLY") && !writes.iter().any(|flag| line.contains(flag))
            }
            // The standard library's own check of a descriptor that it closes.
            "fcntl" => line.contains("F_GETFD"),
            "pread64" | "inotify_add_watch" | "statx" | "fstat" | "newfstatat" | "getdents64"
            | "close" | "lseek" | "readlink" => true,
            // What strace cut in two was looked at where it began.
            _ => call.starts_with("<...") || call.trim().starts_with("<..."),
        };
        assert!(is_harmless, "{line}");
    }
    // Futexes of its own threads apart, the agent waits on nothing and locks nothing.
    for call in ["flock(", "F_SETLK", "PROT_WRITE, MAP_SHARED, 3<"] {
        let wrong = trace
            .lines()
            .find(|line| line.contains(call) && line.contains("shm"));
        assert_eq!(wrong, None);
    }
    Ok(())
}

#[test]
fn where_histories_are_shared_nothing_is_seen_and_the_agent_says_so() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), "")?;
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
fn an_agent_with_nothing_to_see_costs_next_to_nothing() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), "")?;
    let spent = |what: &str| -> Result<f64> {
        let cpu =
            || -> Result<f64> { Ok(agent.scrape()?.sum("ros2probe_shm_cpu_seconds_total", &[])) };
        let before = cpu()?;
        std::thread::sleep(Duration::from_secs(8));
        let share = (cpu()? - before) / 8.0;
        println!("{what}: {:.2} % of a CPU", 100.0 * share);
        Ok(share)
    };
    assert!(spent("nobody there")? < 0.01);
    let (_publisher, _subscriber) = host.pair(&shared())?;
    std::thread::sleep(Duration::from_secs(4));
    assert!(spent("a pair that is silent")? < 0.02);
    Ok(())
}

/// A host with a `/dev/shm` of its own.
struct Host {
    network: Namespace,
    /// Keeps the mount namespace.
    keeper: Process,
}

impl Host {
    fn new() -> Result<Host> {
        let network = Namespace::alone()?;
        let script = "mount -t tmpfs -o size=64m,mode=1777 shm /dev/shm && echo ready && exec cat";
        let arguments = ["--mount", "sh", "-c", script];
        let mut keeper = Process::start(&network.on_network(), "unshare", arguments)?;
        keeper.wait_for("ready", Duration::from_secs(10))?;
        Ok(Host { network, keeper })
    }

    fn launch(&self, role: Role, stream: &Stream) -> Result<Peer> {
        let mut enter = self.network.on_network();
        let mounts = format!("--mount=/proc/{}/ns/mnt", self.keeper.pid());
        enter.extend(["nsenter".to_owned(), mounts]);
        let node = match role {
            Role::Publisher => "/talker",
            Role::Subscriber => "/listener",
        };
        Peer::launch_behind(&enter, Stack::Fast, role, stream, &[node])
    }

    /// A publisher and its subscriber that know each other.
    fn pair(&self, stream: &Stream) -> Result<(Peer, Peer)> {
        let mut subscriber = self.launch(Role::Subscriber, stream)?;
        subscriber.wait_ready()?;
        let mut publisher = self.launch(Role::Publisher, stream)?;
        publisher.wait_ready()?;
        publisher.wait_matched()?;
        subscriber.wait_matched()?;
        Ok((publisher, subscriber))
    }

    /// As [`Self::pair`], until the agent knows both by name. Names are said once, and the memory
    /// that they are said in is used again within a moment: a tap that finds no CPU in that moment
    /// misses them.
    fn known_pair(&self, agent: &Agent<'_>, stream: &Stream) -> Result<(Peer, Peer)> {
        for attempt in 1..=MEETINGS {
            let (mut publisher, mut subscriber) = self.pair(stream)?;
            let deadline = Instant::now() + Duration::from_secs(3);
            while Instant::now() < deadline {
                if is_known(&agent.scrape()?, &stream.topic) {
                    println!("{}: known at attempt {attempt}", stream.topic);
                    return Ok((publisher, subscriber));
                }
                std::thread::sleep(Duration::from_millis(200));
            }
            publisher.process.terminate()?;
            subscriber.process.terminate()?;
            std::thread::sleep(Duration::from_secs(1));
        }
        bail!("their names did not become known in {MEETINGS} attempts")
    }

    /// Files of this host's shared memory that the agent has open.
    fn files_open_in(&self, agent: &Agent<'_>) -> Result<usize> {
        let open = fs::read_dir(format!("/proc/{}/fd", agent.process.pid()))?;
        let links = open
            .flatten()
            .filter_map(|entry| fs::read_link(entry.path()).ok());
        let names = links.map(|link| link.to_string_lossy().into_owned());
        Ok(names.filter(|name| name.contains("fastrtps_")).count())
    }

    /// As `fastdds shm clean` would.
    fn remove_shared_memory(&self) -> Result<()> {
        let directory = format!("/proc/{}/root/dev/shm", self.keeper.pid());
        for entry in fs::read_dir(directory)? {
            fs::remove_file(entry?.path())?;
        }
        Ok(())
    }
}

/// A reliable stream as `rmw_fastrtps_cpp` publishes it by default.
fn shared() -> Stream {
    Stream {
        reliable: true,
        shares_memory: true,
        ..Stream::small(0)
    }
}

/// Whether both nodes and both endpoints of the topic are known.
fn is_known(page: &Scrape, topic: &str) -> bool {
    let nodes = page.labels_of("ros2_node_info", "ros_node");
    let endpoints = ["ros2_topic_publishers", "ros2_topic_subscriptions"];
    nodes.contains("/talker")
        && nodes.contains("/listener")
        && endpoints
            .iter()
            .all(|name| page.sum(name, &[("topic", topic)]) == 1.0)
}

fn start_agent<'a>(host: &'a Namespace, directory: &Path, more: &str) -> Result<Agent<'a>> {
    let configuration = directory.join("ros2probe.yaml");
    let text = format!("watch: [/imu, /points]\n{}{more}", at_the_sockets_of(host));
    fs::write(&configuration, text)?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}

/// Lets the publisher send everything, and looks.
fn run(agent: &Agent<'_>, mut publisher: Peer, stream: &Stream) -> Result<Scrape> {
    // Names and endpoints have settled.
    std::thread::sleep(Duration::from_secs(1));
    publisher.go()?;
    publisher.wait_sent(PATIENCE)?;
    let sent = publisher.log()?.sequences("pub").len() as u64;
    ensure!(
        sent == stream.count,
        "{sent} of {} were accepted",
        stream.count
    );
    agent.settled_scrape(&stream.topic, 0)
}

fn wait_until(what: &str, mut holds: impl FnMut() -> Result<bool>) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    while !holds()? {
        ensure!(Instant::now() < deadline, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}

/// What the agent says of its look at shared memory.
fn telling(page: &Scrape) -> String {
    let lines = page.0.lines().filter(|line| {
        !line.starts_with('#') && (line.contains("_shm_") || line.contains("_sampled_"))
            || line.starts_with("ros2_topic_messages_total")
    });
    lines.collect::<Vec<_>>().join("; ")
}
