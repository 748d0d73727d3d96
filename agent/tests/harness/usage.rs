//! What a process and the whole machine have spent, from `/proc`.

use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result};

/// Length of the kernel's clock tick, fixed by the user-space ABI.
const TICK: Duration = Duration::from_millis(10);

#[derive(Clone, Copy, Debug)]
pub(crate) struct Usage {
    /// Time on a CPU of all its threads, to the nanosecond.
    pub(crate) cpu: Duration,
    /// Its memory, shared pages divided among their users.
    pub(crate) pss: u64,
}

impl Usage {
    /// Threads that have ended are not counted any more.
    pub(crate) fn of(pid: u32) -> Result<Usage> {
        let mut cpu = Duration::ZERO;
        let tasks = fs::read_dir(format!("/proc/{pid}/task"))
            .with_context(|| format!("process {pid} is gone"))?;
        for task in tasks.flatten() {
            cpu += run_time(&task.path());
        }
        let memory = fs::read_to_string(format!("/proc/{pid}/smaps_rollup"))
            .with_context(|| format!("cannot read the memory of process {pid}"))?;
        let kilobytes: u64 = memory
            .lines()
            .find_map(|line| {
                line.strip_prefix("Pss:")?
                    .split_whitespace()
                    .next()?
                    .parse()
                    .ok()
            })
            .context("no Pss in smaps_rollup")?;
        Ok(Usage {
            cpu,
            pss: kilobytes * 1024,
        })
    }

    /// The CPU time between two looks, and the memory at the later one.
    pub(crate) fn since(&self, earlier: &Usage) -> Usage {
        Usage {
            cpu: self.cpu.saturating_sub(earlier.cpu),
            pss: self.pss,
        }
    }
}

/// Time that all CPUs of the machine have been idle. What they worked is the rest of the time: the
/// kernel's counters of work are sampled at its ticks, and miss what a timer starts just after one.
pub(crate) fn machine_idle() -> Result<Duration> {
    let statistics = fs::read_to_string("/proc/stat").context("cannot read /proc/stat")?;
    let times = statistics.lines().next().context("/proc/stat is empty")?;
    // cpu user nice system idle iowait ...
    let idle = times.split_whitespace().skip(4).take(2);
    let ticks = idle.filter_map(|ticks| ticks.parse::<u32>().ok());
    Ok(ticks.map(|ticks| TICK * ticks).sum())
}

/// Time on a CPU of the threads to which the kernel puts off packets that it has no time for.
pub(crate) fn softirq_cpu() -> Result<Duration> {
    let mut cpu = Duration::ZERO;
    for entry in fs::read_dir("/proc")
        .context("cannot read /proc")?
        .flatten()
    {
        let name = fs::read_to_string(entry.path().join("comm"));
        if name.is_ok_and(|name| name.starts_with("ksoftirqd/")) {
            cpu += run_time(&entry.path());
        }
    }
    Ok(cpu)
}

/// The first number of `schedstat`: nanoseconds on a CPU.
fn run_time(task: &Path) -> Duration {
    let statistics = fs::read_to_string(task.join("schedstat")).unwrap_or_default();
    let run = statistics
        .split_whitespace()
        .next()
        .and_then(|run| run.parse().ok());
    Duration::from_nanos(run.unwrap_or(0))
}
