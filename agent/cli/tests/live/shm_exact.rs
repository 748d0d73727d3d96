//! Exact mode: every message that Fast DDS puts into shared memory, seen in the process that sends
//! it. Needs root and a kernel with uprobes.
//!
//! The references are the peers' logs, and the code in their memory, which shows a breakpoint.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, Scrape, get};
use ros2probe_testing::harness::code::{self, Code};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use tempfile::TempDir;

use crate::hostile::start_as;

/// User of the agent without rights.
const UNPRIVILEGED: u32 = 65_534;
const PATIENCE: Duration = Duration::from_secs(60);
const SAMPLES: u64 = 600;
/// Size of the ring, and number of samples at full speed. The ring holds all of them, since the
/// agent may get no CPU during the burst.
const RING: u64 = 4 << 20;
const BURST: u64 = 50_000;
const UNREACHABLE_RATE: f64 = 1e6;

// Coverage: shared memory, with uprobes | Fast DDS 2.9 | - | exact
#[test]
fn every_message_is_seen_and_breakpoints_end_with_a_killed_agent() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&host.network, directory.path(), &[])?;
    let _first = host.attached(&agent)?;
    let stream = Stream {
        count: SAMPLES,
        linger: 60.0,
        ..shared("/imu")
    };
    let (mut publisher, mut subscriber) = host.pair(&stream)?;
    known(&agent, "/imu")?;
    let library = library_of(&publisher)?;
    let code = |peer: &Peer| code::at_function(&peer.process, &library);
    for peer in [&publisher, &subscriber] {
        let Code { in_memory, in_file } = code(peer)?;
        assert_ne!(in_memory, in_file);
    }
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let page = counted(&agent, "/imu", SAMPLES)?;
    assert_eq!(received(&mut subscriber, 0, SAMPLES)?, SAMPLES);
    let topic = [("topic", "/imu")];
    assert_eq!(page.sum("ros2_topic_lost_messages_total", &topic), 0.0);
    let bytes = page.sum("ros2_topic_bytes_total", &topic);
    assert!((bytes - 320.0 * SAMPLES as f64).abs() <= 4.0 * SAMPLES as f64);
    let latencies = page.sum("ros2_topic_latency_seconds_count", &topic);
    assert_eq!(latencies, SAMPLES as f64);
    publisher.process.terminate()?;
    subscriber.process.terminate()?;

    let burst = Stream {
        rate: UNREACHABLE_RATE,
        count: BURST + SAMPLES,
        stretch: BURST,
        depth: 1000,
        ..shared("/burst")
    };
    let burst = Stream {
        linger: 60.0,
        ..burst
    };
    let (mut publisher, mut subscriber) = host.pair(&burst)?;
    known(&agent, "/burst")?;
    publisher.start_sending()?;
    let page = counted(&agent, "/burst", BURST)?;
    assert_eq!(page.sum("ros2_topic_lost_messages_total", &[]), 0.0);
    // Shared memory was not polled, and no message was sampled.
    let read = [("event", "read")];
    assert_eq!(page.sum("ros2probe_shm_events_total", &read), 0.0);
    assert_eq!(page.sum("ros2_topic_sampled_messages_total", &[]), 0.0);
    let ability = [("ability", "shared_memory_exact")];
    assert_eq!(page.sum("ros2probe_capture_ability", &ability), 1.0);

    agent.process.signal("KILL")?;
    for peer in [&publisher, &subscriber] {
        wait_until("the breakpoint is taken out", || {
            let Code { in_memory, in_file } = code(peer)?;
            Ok(in_memory == in_file)
        })?;
    }
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    // During the burst Fast DDS overwrites unread samples, with or without an agent.
    assert_eq!(received(&mut subscriber, BURST, SAMPLES)?, SAMPLES);
    Ok(())
}

/// The agent has no right over other processes, as packaged.
#[test]
fn with_a_broker_an_agent_without_rights_sees_every_message_in_every_start_order() -> Result<()> {
    for is_broker_first in [true, false] {
        let host = Host::new()?;
        let directory = tempfile::tempdir()?;
        let mut broker = match is_broker_first {
            true => Some(start_broker(directory.path())?),
            false => None,
        };
        let capabilities = "-all,+net_admin,+bpf,+perfmon";
        let start = start_as(UNPRIVILEGED, capabilities, &directory)?;
        let configuration = configured(host.network.cgroup(), directory.path())?;
        let agent = Agent::start(&host.network, start, &configuration)?;
        let is_able = || -> Result<bool> {
            let ability = [("ability", "shared_memory_exact")];
            Ok(agent.scrape()?.sum("ros2probe_capture_ability", &ability) == 1.0)
        };
        if broker.is_none() {
            ensure!(!is_able()?, "there is no broker");
            broker = Some(start_broker(directory.path())?);
        }
        wait_until("the broker attaches", is_able)?;
        wait_until("calls inside processes only wait for a client", || {
            let reasons = agent.scrape()?.labels_of("ros2probe_inside_info", "reason");
            let mut reasons = reasons.iter();
            Ok(reasons.any(|reason| reason.contains("no client needs calls")))
        })?;
        let _first = host.attached(&agent)?;
        let stream = Stream {
            count: SAMPLES,
            stretch: SAMPLES / 2,
            linger: 60.0,
            ..shared("/imu")
        };
        let (mut publisher, mut subscriber) = host.pair(&stream)?;
        known(&agent, "/imu")?;
        publisher.start_sending()?;
        counted(&agent, "/imu", SAMPLES / 2)?;

        // The breakpoints belong to the agent, and a new broker continues.
        let library = library_of(&publisher)?;
        let is_attached = |peer: &Peer| -> Result<bool> {
            let Code { in_memory, in_file } = code::at_function(&peer.process, &library)?;
            Ok(in_memory != in_file)
        };
        ensure!(is_attached(&publisher)?, "attached");
        if let Some(mut broker) = broker.take() {
            broker.signal("KILL")?;
            broker.wait(PATIENCE)?;
        }
        wait_until("the lost broker is reported", || Ok(!is_able()?))?;
        ensure!(
            is_attached(&publisher)?,
            "the breakpoints end with the agent, not with the broker"
        );
        let _broker = start_broker(directory.path())?;
        wait_until("the new broker attaches", is_able)?;
        publisher.start_sending()?;
        counted(&agent, "/imu", SAMPLES)?;
        ensure!(
            received(&mut subscriber, 0, SAMPLES)? == SAMPLES,
            "received"
        );

        for thread in threads(agent.process.pid())? {
            // The thread attaches to a recreated control group.
            let is_allowed = thread.capabilities == 0 || thread.name == "cgroup";
            ensure!(is_allowed, "{thread:?}");
        }
        agent.process.signal("KILL")?;
        wait_until("the breakpoint is taken out", || {
            Ok(!is_attached(&publisher)?)
        })?;
    }
    Ok(())
}

#[derive(Debug)]
struct Thread {
    name: String,
    capabilities: u64,
}

fn threads(process: u32) -> Result<Vec<Thread>> {
    let mut threads = Vec::new();
    for entry in fs::read_dir(format!("/proc/{process}/task"))? {
        let status = fs::read_to_string(entry?.path().join("status"))?;
        let value = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            line.map(|value| value.trim().to_owned())
                .context("no such line")
        };
        threads.push(Thread {
            name: value("Name:")?,
            capabilities: u64::from_str_radix(&value("CapEff:")?, 16)?,
        });
    }
    ensure!(threads.len() > 3, "{threads:?}");
    Ok(threads)
}

#[test]
fn without_uprobes_shared_memory_is_sampled_and_the_reason_is_reported() -> Result<()> {
    let host = Host::new()?;
    let directory = tempfile::tempdir()?;
    let lacking = ["setpriv", "--bounding-set", "-sys_ptrace"].map(str::to_owned);
    let agent = start_agent(&host.network, directory.path(), &lacking)?;
    let page = agent.scrape()?;
    let reasons = page.labels_of("ros2probe_shm_exact_info", "reason");
    let [reason] = &reasons.into_iter().collect::<Vec<_>>()[..] else {
        panic!("{}", page.0);
    };
    assert!(reason.contains("cannot connect to the broker"), "{reason}");
    let able = |name: &str| page.sum("ros2probe_capture_ability", &[("ability", name)]);
    assert_eq!(able("shared_memory_exact"), 0.0);
    assert_eq!(able("shared_memory"), 1.0);
    drop(agent);

    // A process has a library without the function, and a pair has one with it.
    let fake = directory.path().join("libfastdds.so.3.9");
    fs::copy(any_library()?, &fake)?;
    let agent = start_agent(&host.network, directory.path(), &[])?;
    let looks = || -> Result<f64> { Ok(agent.scrape()?.sum("ros2probe_shm_looks_total", &[])) };
    let is_able = || -> Result<bool> {
        let ability = [("ability", "shared_memory_exact")];
        Ok(agent.scrape()?.sum("ros2probe_capture_ability", &ability) == 1.0)
    };
    wait_until("everything is covered", is_able)?;
    let preload = format!("LD_PRELOAD={}", fake.display());
    let mut enter = host.network.on_network();
    enter.extend(["env".to_owned(), preload]);
    let mut stranger = Process::start(&enter, "sleep", ["60"])?;
    wait_until("it is not covered", || Ok(!is_able()?))?;
    // The agent may find a process that executes another program, and then tries again.
    wait_until("the reason is that the library lacks the function", || {
        let reasons = (agent.scrape()?).labels_of("ros2probe_shm_exact_info", "reason");
        Ok(reasons.iter().all(|reason| reason.contains("no symbol")))
    })?;
    let before = looks()?;
    wait_until(
        "shared memory is looked at",
        || Ok(looks()? > before + 10.0),
    )?;
    stranger.signal("KILL")?;
    stranger.wait(PATIENCE)?;
    wait_until("everything is covered again", is_able)
}

#[test]
fn a_recreated_cgroup_is_sampled_and_the_reason_is_reported() -> Result<()> {
    let mut host = Host::new()?;
    let observed = host.network.cgroup().join("observed");
    fs::create_dir(&observed)?;
    host.cgroup.clone_from(&observed);
    let directory = tempfile::tempdir()?;
    let mut agent = start_agent_at(&host.network, &observed, directory.path(), &[])?;
    let able = |agent: &Agent<'_>, name: &str| -> Result<bool> {
        let ability = [("ability", name)];
        Ok(agent.scrape()?.sum("ros2probe_capture_ability", &ability) == 1.0)
    };
    wait_until("it is exact", || able(&agent, "shared_memory_exact"))?;
    fs::remove_dir(&observed)?;
    fs::create_dir(&observed)?;
    wait_until("it is exact no longer", || {
        Ok(!able(&agent, "shared_memory_exact")?)
    })?;
    agent.wait_ready(PATIENCE)?;
    wait_until("it is sampled for a reason", || {
        let health = get(&host.network, "http://127.0.0.1:17401/health")?;
        Ok(able(&agent, "shared_memory")? && health.contains("the cgroup was recreated"))
    })?;

    // Polling finds the participants of the new control group, and no loss is reported.
    let stream = Stream {
        count: SAMPLES,
        linger: 60.0,
        ..shared("/imu")
    };
    let is_there = || -> Result<bool> {
        let page = agent.scrape()?;
        Ok(page.sum("ros2_topic_publishers", &[("topic", "/imu")]) == 1.0)
    };
    // Polling may miss an announcement, which other nodes of the same names repeat.
    let (mut publisher, mut subscriber) = host.pair(&stream)?;
    let began = Instant::now();
    while !is_there()? {
        ensure!(began.elapsed() < 3 * PATIENCE, "the publisher is not known");
        std::thread::sleep(Duration::from_secs(3));
        if !is_there()? {
            drop((publisher, subscriber));
            (publisher, subscriber) = host.pair(&stream)?;
        }
    }
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    assert_eq!(received(&mut subscriber, 0, SAMPLES)?, SAMPLES);
    let page = agent.settled_scrape("/imu", SAMPLES)?;
    let topic = [("topic", "/imu")];
    let counted = page.sum("ros2_topic_messages_total", &topic);
    let lost = page.sum("ros2_topic_lost_messages_total", &topic);
    // Samples of the beginning and the end may have been overwritten before they were read.
    ensure!(
        (0.7..=1.0).contains(&(counted / SAMPLES as f64)) && lost == 0.0,
        "{counted} of {SAMPLES}, {lost} lost: {}",
        shared_memory_metrics(&page)
    );
    drop(publisher);
    drop(subscriber);
    agent.process.terminate()?;
    fs::remove_dir(&observed).context("the observed cgroup")
}

/// A host with its own `/dev/shm`.
struct Host {
    network: Namespace,
    /// Control group of the host's nodes.
    cgroup: PathBuf,
    /// The process that keeps the mount namespace.
    keeper: Process,
    /// Directory with a copy of Fast DDS, since agents of other tests may have breakpoints in the
    /// installed one.
    libraries: TempDir,
}

impl Host {
    fn new() -> Result<Host> {
        let network = Namespace::isolated()?;
        let script = "mount -t tmpfs -o size=64m,mode=1777 shm /dev/shm && echo ready && exec cat";
        let arguments = ["--mount", "sh", "-c", script];
        let mut keeper = Process::start(&network.on_network(), "unshare", arguments)?;
        keeper.wait_for("ready", PATIENCE)?;
        let library = Stack::Fast.library("libfastrtps.so")?;
        let libraries = tempfile::tempdir()?;
        let name = library.file_name().context("a library without a name")?;
        fs::copy(&library, libraries.path().join(name))?;
        Ok(Host {
            libraries,
            cgroup: network.cgroup().to_owned(),
            network,
            keeper,
        })
    }

    /// Starts a process whose library gets breakpoints, so that later processes have them from the
    /// beginning.
    fn attached(&self, agent: &Agent<'_>) -> Result<Peer> {
        let peer = self.launch(Role::Subscriber, &shared("/first"))?;
        let place = self.libraries.path().display().to_string();
        agent.scrape_until("the library is attached", |page| {
            let libraries = page.labels_of("ros2probe_shm_exact_info", "library");
            libraries.iter().any(|library| library.starts_with(&place))
        })?;
        Ok(peer)
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

    fn launch(&self, role: Role, stream: &Stream) -> Result<Peer> {
        let mut enter = self.network.on_network();
        let mounts = format!("--mount=/proc/{}/ns/mnt", self.keeper.pid());
        let inside = format!("echo 0 >{}/cgroup.procs", self.cgroup.display());
        let inside = format!("{inside} && exec \"$0\" \"$@\"");
        let path = format!("LD_LIBRARY_PATH={}", self.libraries.path().display());
        let words = ["sh", "-c", &inside, "nsenter", &mounts, "env", &path];
        enter.extend(words.map(str::to_owned));
        let node = match role {
            Role::Publisher => "/talker",
            Role::Subscriber => "/listener",
        };
        Peer::launch_behind(&enter, Stack::Fast, role, stream, &[node])
    }
}

/// Returns a reliable stream as `rmw_fastrtps_cpp` publishes it by default.
fn shared(topic: &str) -> Stream {
    Stream {
        topic: topic.to_owned(),
        reliable: true,
        shares_memory: true,
        ..Stream::small(0)
    }
}

/// Starts an agent with `words` as the beginning of its command.
fn start_agent<'a>(host: &'a Namespace, directory: &Path, words: &[String]) -> Result<Agent<'a>> {
    start_agent_at(host, host.cgroup(), directory, words)
}

/// Starts an agent as [`start_agent`] does, for the processes in a cgroup.
fn start_agent_at<'a>(
    host: &'a Namespace,
    cgroup: &Path,
    directory: &Path,
    words: &[String],
) -> Result<Agent<'a>> {
    let configuration = configured(cgroup, directory)?;
    let program = env!("CARGO_BIN_EXE_rp");
    if words.is_empty() {
        return Agent::start(host, program, &configuration);
    }
    let script = directory.join("start");
    let text = format!("#!/bin/sh\nexec {} {program} \"$@\"\n", words.join(" "));
    fs::write(&script, text)?;
    harness::run(&format!("chmod 755 {}", script.display()))?;
    Agent::start(host, script, &configuration)
}

/// Writes a configuration with exact mode.
fn configured(cgroup: &Path, directory: &Path) -> Result<PathBuf> {
    let configuration = directory.join("ros2probe.yaml");
    let cgroup = cgroup.display();
    let text = format!(
        "watch: [/imu, /burst]\n\
         capture: {{source: host, cgroup: {cgroup}, record_ring_bytes: {RING}, broker: {}, \
         shm: {{exact: uprobe}}}}\n",
        socket_of(directory).display()
    );
    fs::write(&configuration, text)?;
    Ok(configuration)
}

/// Returns the socket of the broker, if one is started.
fn socket_of(directory: &Path) -> PathBuf {
    directory.join("attach.sock")
}

/// Starts a broker for agents of [`UNPRIVILEGED`].
fn start_broker(directory: &Path) -> Result<Process> {
    let socket = socket_of(directory).display().to_string();
    let arguments = ["attach", "--user", "nobody", "--listen", &socket];
    Process::start(&["env".to_owned()], env!("CARGO_BIN_EXE_rp"), arguments)
}

/// Returns whether a topic's writer and reader and both nodes are known, all from shared memory.
fn is_known(agent: &Agent<'_>, topic: &str) -> Result<bool> {
    let page = agent.scrape()?;
    let nodes = page.labels_of("ros2_node_info", "ros_node");
    let endpoints = ["ros2_topic_publishers", "ros2_topic_subscriptions"];
    Ok(nodes.contains("/talker")
        && nodes.contains("/listener")
        && endpoints.map(|name| page.sum(name, &[("topic", topic)])) == [1.0; 2])
}

/// Waits until the topic is known.
fn known(agent: &Agent<'_>, topic: &str) -> Result<()> {
    let result = wait_until(topic, || is_known(agent, topic));
    result.with_context(|| {
        agent
            .scrape()
            .map(|page| shared_memory_metrics(&page))
            .unwrap_or_default()
    })
}

/// Returns the page that counts this many messages of a topic, after which no more are counted.
fn counted(agent: &Agent<'_>, topic: &str, count: u64) -> Result<Scrape> {
    let page = agent.settled_scrape(topic, count)?;
    println!("{}", shared_memory_metrics(&page));
    let seen = page.sum("ros2_topic_messages_total", &[("topic", topic)]);
    ensure!(seen == count as f64, "{seen} of {count}");
    Ok(page)
}

/// Waits for `count` samples since `first` at a subscriber, and returns their number.
fn received(subscriber: &mut Peer, first: u64, count: u64) -> Result<u64> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut numbers = subscriber.log()?.sequences("sub");
        numbers.retain(|number| *number >= first);
        let received = numbers.len() as u64;
        if received >= count || Instant::now() > deadline {
            return Ok(received);
        }
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Returns the file of a peer's Fast DDS.
fn library_of(peer: &Peer) -> Result<PathBuf> {
    mapped(peer.process.pid(), "/libfastrtps.so")
}

/// Returns a library that is not Fast DDS.
fn any_library() -> Result<PathBuf> {
    mapped(std::process::id(), "/libgcc_s.so")
}

fn mapped(process: u32, name: &str) -> Result<PathBuf> {
    let maps = fs::read_to_string(format!("/proc/{process}/maps"))?;
    let line = maps.lines().find(|line| line.contains(name));
    let path = line.and_then(|line| line.find('/').and_then(|at| line.get(at..)));
    Ok(PathBuf::from(path.with_context(|| format!("no {name}"))?))
}

/// Returns the agent's metrics of shared memory.
fn shared_memory_metrics(page: &Scrape) -> String {
    let lines = page.0.lines().filter(|line| {
        !line.starts_with('#') && (line.contains("_shm_") || line.contains("_sampled_"))
            || line.starts_with("ros2_topic_messages_total")
            || line.starts_with("ros2_node_info")
            || line.starts_with("ros2_topic_publishers")
            || line.starts_with("ros2_topic_subscriptions")
            || line.starts_with("ros2_participants")
            || line.starts_with("ros2probe_decode")
            || line.starts_with("ros2probe_datagrams")
            || line.starts_with("ros2_topic_info")
            || line.starts_with("ros2_unknown")
            || line.starts_with("ros2probe_filter_events")
    });
    lines.collect::<Vec<_>>().join("; ")
}
