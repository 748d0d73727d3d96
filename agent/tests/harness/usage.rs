//! What a process and the whole machine have spent, from `/proc`.

use std::fs;
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
            let Ok(statistics) = fs::read_to_string(task.path().join("schedstat")) else {
                continue;
            };
            let run = statistics
                .split_whitespace()
                .next()
                .and_then(|run| run.parse().ok());
            cpu += Duration::from_nanos(run.unwrap_or(0));
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

/// Time that all CPUs of the machine have spent on anything, interrupts included.
pub(crate) fn machine_cpu() -> Result<Duration> {
    let statistics = fs::read_to_string("/proc/stat").context("cannot read /proc/stat")?;
    let times = statistics.lines().next().context("/proc/stat is empty")?;
    let ticks: Vec<u32> = times
        .split_whitespace()
        .skip(1)
        .filter_map(|ticks| ticks.parse().ok())
        .collect();
    // user nice system idle iowait irq softirq steal guest guest_nice; guests are in user already.
    let busy = ticks
        .iter()
        .take(8)
        .enumerate()
        .filter(|(at, _)| *at != 3 && *at != 4);
    Ok(busy.map(|(_, ticks)| TICK * *ticks).sum())
}
