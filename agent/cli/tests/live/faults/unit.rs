//! The unit's limits for the agent, and control groups that enforce them on a process.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};

/// Period of `CPUQuota`, systemd's default.
const PERIOD: Duration = Duration::from_millis(100);

/// Limits of the packaged unit.
pub(super) struct Allowance {
    /// `MemoryMax`, in bytes.
    pub(super) memory: u64,
    /// `CPUQuota`, in percent of a CPU.
    pub(super) cpu_percent: u64,
}

impl Allowance {
    pub(super) fn of_the_unit() -> Result<Allowance> {
        let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../systemd/ros2probe.service");
        let text = fs::read_to_string(unit)?;
        let value = |key: &str, unit: char| -> Result<u64> {
            let value = text
                .lines()
                .find_map(|line| line.strip_prefix(key)?.strip_suffix(unit));
            Ok(value
                .with_context(|| format!("no {key} in the unit"))?
                .parse()?)
        };
        Ok(Allowance {
            memory: value("MemoryMax=", 'M')? << 20,
            cpu_percent: value("CPUQuota=", '%')?,
        })
    }
}

/// Control groups of a test: one of version 2, or one per controller of version 1.
pub(super) struct UnitCgroups {
    memory: PathBuf,
    cpu: Option<PathBuf>,
    is_second: bool,
}

impl UnitCgroups {
    /// Limits memory to this many bytes, without swap.
    pub(super) fn to_memory(limit: u64) -> Result<UnitCgroups> {
        UnitCgroups::create("memory", limit, None)
    }

    /// Limits memory and CPU time to those that the unit allows.
    pub(super) fn to(allowance: &Allowance) -> Result<UnitCgroups> {
        UnitCgroups::create("unit", allowance.memory, Some(allowance.cpu_percent))
    }

    fn create(name: &str, memory: u64, cpu_percent: Option<u64>) -> Result<UnitCgroups> {
        static CREATED: AtomicU32 = AtomicU32::new(0);
        let number = CREATED.fetch_add(1, Ordering::Relaxed);
        let name = format!("r2p-{}-{name}-{number}", std::process::id());
        let period = PERIOD.as_micros() as u64;
        let quota = cpu_percent.map(|percent| period * percent / 100);
        let make = |path: PathBuf| -> Result<PathBuf> {
            fs::create_dir(&path).with_context(|| format!("cannot create {}", path.display()))?;
            Ok(path)
        };
        if let Some(first) = mount("cgroup", "memory")? {
            let mut group = UnitCgroups {
                memory: make(first.join(&name))?,
                cpu: None,
                is_second: false,
            };
            write(&group.memory, "memory.limit_in_bytes", &memory)?;
            // The kernel counts the memory of sockets only if a limit is set.
            write(&group.memory, "memory.kmem.tcp.limit_in_bytes", &memory)?;
            if let Some(quota) = quota {
                let first = mount("cgroup", "cpu")?.context("no CPU controller is mounted")?;
                let cpu = make(first.join(&name))?;
                let cpu = group.cpu.insert(cpu);
                write(cpu, "cpu.cfs_period_us", &period)?;
                write(cpu, "cpu.cfs_quota_us", &quota)?;
            }
            return Ok(group);
        }
        let second = mount("cgroup2", "")?.context("no control groups are mounted")?;
        let controllers = fs::read_to_string(second.join("cgroup.controllers"))?;
        for controller in ["memory", "cpu"] {
            if !controllers.split_whitespace().any(|it| it == controller) {
                bail!(
                    "no {controller} controller in {}: boot with `cgroup_enable={controller}`, or mount it with \
                     `mount -t cgroup -o {controller} none /sys/fs/cgroup/{controller}`",
                    second.display()
                );
            }
            write(&second, "cgroup.subtree_control", &format!("+{controller}"))
                .context("controllers cannot be handed down: run as root on the host")?;
        }
        let path = make(second.join(name))?;
        let group = UnitCgroups {
            cpu: quota.map(|_| path.clone()),
            memory: path,
            is_second: true,
        };
        write(&group.memory, "memory.max", &memory)?;
        // This file is absent if the kernel has no swap.
        let _ = write(&group.memory, "memory.swap.max", &0);
        if let Some(quota) = quota {
            write(&group.memory, "cpu.max", &format!("{quota} {period}"))?;
        }
        Ok(group)
    }

    /// Returns a shell command that enters the group and runs its arguments there.
    pub(super) fn enter(&self) -> String {
        let groups = self.groups();
        let enter = groups.map(|path| format!("echo 0 >{}/cgroup.procs && ", path.display()));
        enter.chain(["exec \"$0\" \"$@\"".to_owned()]).collect()
    }

    /// Returns the bytes that cannot be reclaimed: all but the page cache and mapped files.
    pub(super) fn needed(&self) -> Result<u64> {
        let number = |file: &str| -> Result<u64> { Ok(read(&self.memory, file)?.trim().parse()?) };
        if self.is_second {
            let used = number("memory.current")?;
            return Ok(used.saturating_sub(value(&self.memory, "memory.stat", "file")?));
        }
        // Version 1 counts the memory of TCP separately, version 2 with the rest.
        let used = number("memory.usage_in_bytes")? + number("memory.kmem.tcp.usage_in_bytes")?;
        Ok(used.saturating_sub(value(&self.memory, "memory.stat", "cache")?))
    }

    pub(super) fn oom_kills(&self) -> Result<u64> {
        match self.is_second {
            true => value(&self.memory, "memory.events", "oom_kill"),
            false => value(&self.memory, "memory.oom_control", "oom_kill"),
        }
    }

    /// Returns the total time for which threads waited for their next share of a CPU.
    pub(super) fn throttled(&self) -> Result<Duration> {
        let cpu = self.cpu.as_ref().context("time on CPUs is not confined")?;
        Ok(match self.is_second {
            true => Duration::from_micros(value(cpu, "cpu.stat", "throttled_usec")?),
            false => Duration::from_nanos(value(cpu, "cpu.stat", "throttled_time")?),
        })
    }

    /// Iterates over the groups, each once.
    fn groups(&self) -> impl Iterator<Item = &Path> {
        let other = self.cpu.as_ref().filter(|cpu| **cpu != self.memory);
        std::iter::once(self.memory.as_path()).chain(other.map(PathBuf::as_path))
    }
}

impl Drop for UnitCgroups {
    fn drop(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(5);
        for path in self.groups() {
            while let Err(error) = fs::remove_dir(path) {
                if Instant::now() > deadline {
                    eprintln!("cannot remove {}: {error}", path.display());
                    break;
                }
                std::thread::sleep(Duration::from_millis(10));
            }
        }
    }
}

pub(super) fn mebibytes(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

/// Returns the mount point of control groups with this controller.
fn mount(kind: &str, controller: &str) -> Result<Option<PathBuf>> {
    let mounts = fs::read_to_string("/proc/self/mounts")?;
    let path = mounts.lines().find_map(|line| {
        let words: Vec<_> = line.split(' ').collect();
        let has = |option: &&str| controller.is_empty() || *option == controller;
        let fits = words.get(2) == Some(&kind) && words.get(3)?.split(',').any(|it| has(&it));
        fits.then(|| PathBuf::from(words[1]))
    });
    Ok(path)
}

fn write(group: &Path, file: &str, value: &impl ToString) -> Result<()> {
    let path = group.join(file);
    fs::write(&path, value.to_string()).with_context(|| format!("cannot write {}", path.display()))
}

fn read(group: &Path, file: &str) -> Result<String> {
    let path = group.join(file);
    fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
}

/// Returns a value of a file with a name and a number in each line.
fn value(group: &Path, file: &str, name: &str) -> Result<u64> {
    let text = read(group, file)?;
    let value = text.lines().find_map(|line| {
        let (key, value) = line.split_once(' ')?;
        (key == name).then(|| value.trim().parse().ok())?
    });
    value.with_context(|| format!("no {name} in {file}"))
}
