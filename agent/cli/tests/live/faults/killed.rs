//! `kill -9` at any moment.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, ensure};
use ros2probe_capture::netns;
use serde_json::Value;

use super::{Counted, FaultBench, PATIENCE, ask, launch};
use ros2probe_testing::forged::storm::Dice;
use ros2probe_testing::forged::{Carrier as _, Sender, Talker};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::bpf::{self, Direction, Object};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::soak::{long, outcome};
use ros2probe_testing::harness::wait_until;

/// Variable with the seed of another run, to repeat it.
const SEED: &str = "ROS2PROBE_SOAK_SEED";

/// The agent's activity when it is killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CaptureTime {
    Starting,
    Measuring,
    Recording,
    Keeping,
    Reloading,
    Ending,
    TakingASnapshot,
    Watching,
}

impl CaptureTime {
    const ALL: [CaptureTime; 8] = [
        CaptureTime::Starting,
        CaptureTime::Measuring,
        CaptureTime::Recording,
        CaptureTime::Keeping,
        CaptureTime::Reloading,
        CaptureTime::Ending,
        CaptureTime::TakingASnapshot,
        CaptureTime::Watching,
    ];

    /// Returns how long this activity lasts.
    const fn span(self, start: Duration) -> Duration {
        match self {
            CaptureTime::Starting => start,
            CaptureTime::Ending | CaptureTime::Reloading => Duration::from_millis(60),
            CaptureTime::Keeping => Duration::from_millis(3_200),
            CaptureTime::Measuring
            | CaptureTime::Recording
            | CaptureTime::TakingASnapshot
            | CaptureTime::Watching => Duration::from_millis(400),
        }
    }
}

/// A robot that runs through all kills: a node with a stream, and others that join.
struct Robot {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<()>>,
}

impl Robot {
    fn start(link: &Link) -> Result<Robot> {
        let mut counted = Counted::start(link, 1, "robot")?;
        let mut sender = Sender::between(&link.monitor, &link.robot)?;
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let mut round = 0;
            while !stopped.load(Ordering::Relaxed) {
                counted.send_samples(320, 20)?;
                if round % 20 == 0 {
                    // Only SPDP is repeated, because endpoints are announced once.
                    sender.send(&counted.talker.participant())?;
                    // A new node gives the agent something to save each time.
                    let passer_by = Talker::new(1000 + round % 400, "/passing");
                    for message in passer_by.introduction("passer_by") {
                        sender.send(&message)?;
                    }
                }
                round += 1;
            }
            Ok(())
        });
        Ok(Robot { stop, thread })
    }

    fn end(self) -> Result<()> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().map_err(|_| anyhow!("the robot died"))?
    }
}

struct Places {
    configuration: PathBuf,
    state: PathBuf,
    bags: PathBuf,
    runtime: PathBuf,
}

impl Places {
    fn below(directory: &Path) -> Result<Places> {
        let place = |name: &str| directory.join(name);
        let places = Places {
            configuration: place("ros2probe.yaml"),
            state: place("state"),
            bags: place("bags"),
            runtime: place("run"),
        };
        for made in [&places.state, &places.runtime] {
            fs::create_dir(made)?;
        }
        Ok(places)
    }

    /// Returns a configuration with everything that attaches to the kernel or writes to the disk.
    fn configuration_text(&self, link: &Link) -> String {
        format!(
            "capture: {{source: host, cgroup: {}, mirror_interfaces: [eth0], shm: {{exact: uprobe}}}}\n\
             watch: [/**]\nlog: warn\nstate_directory: {}\napi: {{socket: {}/api.sock}}\nrecordings:\n  \
             directory: {}\n  reserve_percent: 0\n  reserve_bytes: 0\n  snapshots: [{{name: incident, topics: [/counted_1], seconds: 2}}]\n",
            link.robot.cgroup().display(),
            self.state.display(),
            self.runtime.display(),
            self.bags.display()
        )
    }

    /// Returns the number of bags without metadata, whose beginning or end a kill interrupted.
    fn bags_without_metadata(&self) -> usize {
        let bags = fs::read_dir(&self.bags).into_iter().flatten().flatten();
        bags.filter(|bag| !bag.path().join("metadata.yaml").exists())
            .count()
    }
}

#[test]
fn an_agent_killed_at_any_moment_restarts_without_leftovers() -> Result<()> {
    let seed = std::env::var(SEED).ok().and_then(|text| text.parse().ok());
    let random = || {
        std::time::UNIX_EPOCH
            .elapsed()
            .map(|it| it.as_nanos() as u64)
    };
    let seed: u64 = seed.map_or_else(random, Ok)? | 1;
    eprintln!("{SEED}={seed}");
    let mut dice = Dice::new(seed);
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let places = Places::below(directory.path())?;
    let configuration = places.configuration_text(&link);
    // The first agent saves the robot's names, and measures a start.
    let began = Instant::now();
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &[])?;
    let start = began.elapsed();
    let robot = Robot::start(&link)?;
    scene.node_is_known("/robot")?;
    scene.agent.scrape_until("probes in place", |page| {
        let ability = [("ability", "shared_memory_exact")];
        page.sum("ros2probe_capture_ability", &ability) > 0.0
    })?;
    wait_until("a state", || {
        let text = fs::read_to_string(places.state.join("discovery.json"));
        Ok(text.unwrap_or_default().contains("/robot"))
    })?;
    let Agent { process, .. } = scene.agent;
    kill(process, &link)?;

    let rounds = if long().is_some() {
        200
    } else {
        CaptureTime::ALL.len()
    };
    let (mut slowest, mut objects) = (Duration::ZERO, 0);
    for round in 0..rounds {
        let moment = CaptureTime::ALL[round % CaptureTime::ALL.len()];
        let span = moment.span(start);
        let after = Duration::from_micros(dice.pick(span.as_micros() as u64 + 1));
        let began = Instant::now();
        let (held, ready) = until(&link, &places, round, moment, after)
            .with_context(|| format!("round {round}: {moment:?}, {after:?}"))?;
        slowest = slowest.max(ready.unwrap_or_default());
        objects += held;
        clean(&places).with_context(|| format!("after round {round}: {moment:?}, {after:?}"))?;
        eprintln!(
            "{round}: {moment:?} {after:?}: {held} objects went, {:?}",
            began.elapsed()
        );
    }

    // The last agent starts with the names, and ends on request.
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &[])?;
    scene.node_is_known("/robot")?;
    let broken = places.bags_without_metadata();
    scene.end()?;
    robot.end()?;
    ensure!(names(&places.runtime) == ["api.sock.lock"]);
    ensure!(broken <= rounds / 8, "{broken} bags without metadata.yaml");
    outcome(
        &format!(
            "kill -9, {rounds} times (seed {seed}), while starting, measuring, recording, saving state, \
                  reloading, ending, taking snapshots, adding watches"
        ),
        &format!(
            "every start clean (the slowest ready after {slowest:?}), names back from the state each time; none \
             of {objects} BPF programs, maps and links, no attachment, packet socket, half a file or lock left"
        ),
    )
}

/// Starts an agent and kills it at this moment. Returns the number of its objects in the kernel,
/// all removed by then, and the duration of its start.
fn until(
    link: &Link,
    places: &Places,
    round: usize,
    moment: CaptureTime,
    after: Duration,
) -> Result<(usize, Option<Duration>)> {
    let began = Instant::now();
    let enter = link.robot.on_network();
    let process = launch(&enter, &places.configuration, Stdio::inherit())?;
    if moment == CaptureTime::Starting {
        std::thread::sleep(after);
        return Ok((kill(process, link)?, None));
    }
    let host = &link.robot;
    let mut agent = Agent { process, host };
    agent.wait_ready(PATIENCE)?;
    let ready = began.elapsed();
    // Names come immediately from the saved state.
    let page = agent.scrape()?;
    let nodes = page.labels_of("ros2_node_info", "ros_node");
    ensure!(nodes.contains("/robot"), "names are lost: {nodes:?}");
    let ask = |method: &str, path: &str, body: &str| -> Result<(u16, Value)> {
        let mut stream = netns::within(&host.network(), || {
            std::net::TcpStream::connect(("127.0.0.1", super::API_PORT))
        })??;
        ask(&mut stream, method, path, body)
    };
    match moment {
        CaptureTime::Starting | CaptureTime::Measuring | CaptureTime::Keeping => {}
        CaptureTime::Recording => {
            let (status, begun) =
                ask("POST", "/recordings", &format!(r#"{{"name": "r{round}"}}"#))?;
            ensure!(status == 201, "{status} {begun}");
        }
        CaptureTime::Watching => {
            let (status, added) = ask("POST", &format!("/watch/added_{}", round % 16), "")?;
            ensure!(status == 201 || status == 200, "{status} {added}");
        }
        CaptureTime::Reloading => agent.process.signal("HUP")?,
        CaptureTime::Ending => agent.process.signal("TERM")?,
        CaptureTime::TakingASnapshot => agent.process.signal("USR1")?,
    }
    std::thread::sleep(after);
    Ok((kill(agent.process, link)?, Some(ready)))
}

/// Kills the process, and waits until the kernel has none of its objects.
fn kill(mut process: Process, link: &Link) -> Result<usize> {
    let pid = process.pid();
    // A stopped process cannot create further objects before its end.
    process.signal("STOP")?;
    let stood = || -> Result<bool> {
        let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
        Ok(status.lines().any(|line| {
            line.strip_prefix("State:")
                .is_some_and(|state| state.trim_start().starts_with(['T', 't', 'Z']))
        }))
    };
    wait_until("it stands still", stood)?;
    let objects = bpf::objects_of(pid).unwrap_or_default();
    process.signal("KILL")?;
    process.wait(PATIENCE)?;
    let mut left: BTreeSet<Object> = objects.clone();
    let gone = wait_until("BPF objects gone", || {
        let still: Result<Vec<(Object, bool)>> = left
            .iter()
            .map(|object| Ok((*object, bpf::is_there(*object)?)))
            .collect();
        let still = still?.into_iter().filter(|(_, is_there)| *is_there);
        left = still.map(|(object, _)| object).collect();
        Ok(left.is_empty())
    });
    gone.with_context(|| format!("{left:?} are left"))?;
    for host in [link.cgroup(), link.robot.cgroup()] {
        for direction in [Direction::Ingress, Direction::Egress] {
            let attached = bpf::attached(host, direction)?;
            ensure!(attached == 0, "{attached} programs stay attached");
        }
    }
    wait_until("no packet socket", || {
        let table = netns::within(&link.robot.network(), || {
            fs::read_to_string("/proc/thread-self/net/packet")
        })??;
        Ok(table.lines().count() == 1)
    })?;
    Ok(objects.len())
}

/// Checks that the next agent can read the files, and that their number does not grow.
fn clean(places: &Places) -> Result<()> {
    let text = fs::read_to_string(places.state.join("discovery.json"))?;
    serde_json::from_str::<Value>(&text).context("half a state")?;
    let known = [
        "discovery.json",
        "discovery.json.new",
        "history",
        "watches.json",
        "watches.json.new",
    ];
    for name in names(&places.state) {
        ensure!(known.contains(&name.as_str()), "{name} is left");
    }
    for name in names(&places.runtime) {
        ensure!(
            ["api.sock", "api.sock.lock"].contains(&name.as_str()),
            "{name} is left"
        );
    }
    Ok(())
}

fn names(directory: &Path) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let mut names: Vec<_> = names.collect();
    names.sort();
    names
}
