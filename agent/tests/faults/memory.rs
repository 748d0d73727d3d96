//! Everything at its cap at once, in the memory that the unit allows.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};

use super::{API_PORT, Counted, PATIENCE, Scene};
use crate::forged::storm::{Storm, forgery};
use crate::forged::{Carrier, Sender};
use crate::harness::agent::ON_THE_WIRE;
use crate::harness::network::Link;
use crate::harness::soak::{long, outcome};

/// What nobody on the robot listens to.
const NOBODY: u16 = 7399;

/// A control group that holds memory to a limit, of whichever version is there.
struct Bounded {
    path: PathBuf,
    is_second: bool,
}

impl Bounded {
    fn create(limit: u64) -> Result<Bounded> {
        let name = format!("r2p-{}-memory", std::process::id());
        let mounts = fs::read_to_string("/proc/self/mounts")?;
        let mount = |kind: &str, option: &str| {
            mounts.lines().find_map(|line| {
                let words: Vec<_> = line.split(' ').collect();
                let fits = words.get(2) == Some(&kind)
                    && words
                        .get(3)?
                        .split(',')
                        .any(|it| option.is_empty() || it == option);
                fits.then(|| PathBuf::from(words[1]))
            })
        };
        if let Some(first) = mount("cgroup", "memory") {
            let path = first.join(name);
            fs::create_dir(&path).with_context(|| format!("cannot create {}", path.display()))?;
            let group = Bounded {
                path,
                is_second: false,
            };
            group.set("memory.limit_in_bytes", limit)?;
            // Nothing of sockets is counted where no limit is set.
            group.set("memory.kmem.tcp.limit_in_bytes", limit)?;
            return Ok(group);
        }
        let second = mount("cgroup2", "").context("no control groups are mounted")?;
        let controllers = fs::read_to_string(second.join("cgroup.controllers"))?;
        if !controllers.split_whitespace().any(|it| it == "memory") {
            bail!(
                "no memory controller in {}: boot with `cgroup_enable=memory`, or mount it with `mount -t cgroup \
                 -o memory none /sys/fs/cgroup/memory`",
                second.display()
            );
        }
        fs::write(second.join("cgroup.subtree_control"), "+memory")
            .context("the memory controller cannot be handed down: run as root on the host")?;
        let path = second.join(name);
        fs::create_dir(&path)?;
        let group = Bounded {
            path,
            is_second: true,
        };
        group.set("memory.max", limit)?;
        // Absent where the kernel has no swap.
        let _ = group.set("memory.swap.max", 0);
        Ok(group)
    }

    fn set(&self, file: &str, value: u64) -> Result<()> {
        let path = self.path.join(file);
        fs::write(&path, value.to_string())
            .with_context(|| format!("cannot write {}", path.display()))
    }

    fn read(&self, file: &str) -> Result<String> {
        let path = self.path.join(file);
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
    }

    /// A value of a file with a name and a number in each line.
    fn value(&self, file: &str, name: &str) -> Result<u64> {
        let text = self.read(file)?;
        let value = text.lines().find_map(|line| {
            let (key, value) = line.split_once(' ')?;
            (key == name).then(|| value.trim().parse().ok())?
        });
        value.with_context(|| format!("no {name} in {file}"))
    }

    /// What cannot be taken back: neither the page cache nor what is mapped from files.
    fn needed(&self) -> Result<u64> {
        if self.is_second {
            let used: u64 = self.read("memory.current")?.trim().parse()?;
            return Ok(used.saturating_sub(self.value("memory.stat", "file")?));
        }
        let used: u64 = self.read("memory.usage_in_bytes")?.trim().parse()?;
        // Counted apart there, and with the rest in the second version.
        let sockets: u64 = self
            .read("memory.kmem.tcp.usage_in_bytes")?
            .trim()
            .parse()?;
        Ok((used + sockets).saturating_sub(self.value("memory.stat", "cache")?))
    }

    fn kills(&self) -> Result<u64> {
        match self.is_second {
            true => self.value("memory.events", "oom_kill"),
            false => self.value("memory.oom_control", "oom_kill"),
        }
    }
}

impl Drop for Bounded {
    fn drop(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(5);
        while let Err(error) = fs::remove_dir(&self.path) {
            if Instant::now() > deadline {
                return eprintln!("cannot remove {}: {error}", self.path.display());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Leaves other tests some of the machine.
struct Breathing {
    sender: Sender,
    carried: u32,
    /// How many a millisecond.
    pace: u32,
}

impl Breathing {
    fn start(link: &Link, pace: u32) -> Result<Breathing> {
        let source = format!("{}:0", link.monitor.address());
        let target = format!("{}:{NOBODY}", link.robot.address());
        Ok(Breathing {
            sender: Sender::new(&link.monitor, &source, &target)?,
            carried: 0,
            pace,
        })
    }
}

impl Carrier for Breathing {
    fn carry(&mut self, payload: &[u8]) -> Result<()> {
        self.carried += 1;
        if self.carried.is_multiple_of(self.pace) {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.sender.carry(payload)
    }
}

#[test]
fn every_cap_reached_at_once_stays_within_the_unit_s_memory() -> Result<()> {
    let limit = unit_limit()?;
    let group = Bounded::create(limit)?;
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let place = directory.path().display();
    fs::create_dir(directory.path().join("state"))?;
    let configuration = format!(
        "watch: [{{topic: /**, per_subscriber: true}}]\nlog: warn\nstate_directory: {place}/state\n\
         recordings: {{directory: {place}/bags}}\n{ON_THE_WIRE}"
    );
    let enter = format!(
        "echo 0 >{}/cgroup.procs && exec \"$0\" \"$@\"",
        group.path.display()
    );
    let words = ["sh", "-c", &enter];
    let scene = Scene::start(&link.robot, &directory, &configuration, &words)?;
    let idle = group.needed()?;
    let mut real = Counted::start(&link, 900_000, "real")?;
    real.talk(320, 50)?;
    let span = Duration::from_secs(if long().is_some() { 120 } else { 8 });
    let (sent, peak) = storm(&scene, &group, &link, span, 0.9)?;
    ensure!(peak < limit, "{peak} bytes with what sockets take");
    let took = scene.end()?;

    // What was kept of it kills the next one neither at its start nor later.
    let state = fs::metadata(directory.path().join("state/discovery.json"))?.len();
    let scene = Scene::start(&link.robot, &directory, &configuration, &words)?;
    let restarted = group.needed()?;
    let (more, again) = storm(&scene, &group, &link, span / 2, 0.0)?;
    ensure!(again < limit, "{again} bytes with what sockets take");
    scene.end()?;
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    outcome(
        &format!(
            "every cap at once in {} MiB (MemoryMax, no swap)",
            mib(limit)
        ),
        &format!(
            "{} hostile datagrams, 12 readers that do not read, 4 recordings: {:.1} MiB at most ({:.1} MiB \
             before), not killed; ended in {took:?}; started again with a state of {:.1} MiB: {:.1} MiB, {:.1} MiB \
             at most",
            sent + more,
            mib(peak),
            mib(idle),
            mib(state),
            mib(restarted),
            mib(again)
        ),
    )
}

/// Everything at once, for so long and until so much of the tables is used: the datagrams sent, and
/// the most memory needed.
fn storm(
    scene: &Scene<'_>,
    group: &Bounded,
    link: &Link,
    span: Duration,
    filled: f64,
) -> Result<(u64, u64)> {
    // Whoever wants all messages and does not read them.
    let mut readers = Vec::new();
    for _ in 0..12 {
        let mut stream = scene.connect(API_PORT)?;
        let path = "/samples?all=true&hidden=true&payload=true&queue_bytes=16777216";
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        stream.write_all(request.as_bytes())?;
        readers.push(stream);
    }
    for number in 0..4 {
        let body = format!(r#"{{"name": "all_{number}_{}"}}"#, scene.pid());
        let (status, begun) = scene.ask("POST", "/recordings", &body)?;
        ensure!(status == 201, "{status} {begun}");
    }
    let storms = [
        Storm::of_a_crowd(Breathing::start(link, 64)?, 1200, 12),
        Storm::start(Breathing::start(link, 8)?, forgery),
        Storm::of_large_samples(Breathing::start(link, 4)?)?,
    ];
    let began = Instant::now();
    let (mut peak, mut is_full) = (0, false);
    while began.elapsed() < span || !is_full {
        ensure!(group.kills()? == 0, "killed after {:?}", began.elapsed());
        peak = peak.max(group.needed()?);
        // A page of all of it is memory, too.
        let page = scene.agent.scrape()?;
        is_full = ["participants", "endpoints"].into_iter().all(|table| {
            let label = [("table", table)];
            let entries = page.sum("ros2probe_table_entries", &label);
            entries >= filled * page.sum("ros2probe_table_limit", &label)
        });
        ensure!(
            is_full || began.elapsed() < span + PATIENCE,
            "the tables are not full"
        );
        std::thread::sleep(Duration::from_millis(200));
    }
    let mut sent = 0;
    for storm in storms {
        sent += storm.end()?;
    }
    ensure!(group.kills()? == 0, "killed at the end");
    Ok((sent, peak))
}

/// `MemoryMax` of the unit.
fn unit_limit() -> Result<u64> {
    let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join("../systemd/ros2probe.service");
    let text = fs::read_to_string(unit)?;
    let limit = text.lines().find_map(|line| {
        let value = line.strip_prefix("MemoryMax=")?.strip_suffix('M')?;
        value.parse::<u64>().ok()
    });
    Ok(limit.context("no MemoryMax in the unit")? << 20)
}
