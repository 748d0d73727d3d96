//! CPU time and memory of a process and of the whole machine, from `/proc`.

use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};

/// Length of the kernel's clock tick, fixed by the user-space ABI.
const TICK: Duration = Duration::from_millis(10);

#[derive(Clone, Copy, Debug)]
pub struct Usage {
    /// CPU time of all its threads, to the nanosecond.
    pub cpu: Duration,
    pub memory: Memory,
}

/// Memory of a process, in bytes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Memory {
    /// Memory that the kernel cannot reclaim while the process exists: its own pages (anonymous,
    /// changed, swapped) and the rings that it shares with the kernel. All other memory is pages of
    /// files, such as those of the program.
    pub unreclaimable: u64,
    /// The part of `unreclaimable` in the rings.
    pub rings: u64,
    /// The part of `unreclaimable` in pages of the program that changed at start or run time.
    pub program: u64,
    /// All pages in memory.
    pub rss: u64,
    /// All pages in memory, with shared pages divided among their users.
    pub pss: u64,
}

impl Usage {
    /// Reads the usage of a process. Threads that have ended no longer count.
    pub fn of(pid: u32) -> Result<Usage> {
        let mut cpu = Duration::ZERO;
        let tasks = fs::read_dir(format!("/proc/{pid}/task"))
            .with_context(|| format!("process {pid} is gone"))?;
        for task in tasks.flatten() {
            cpu += run_time(&task.path());
        }
        let memory = Memory::of(pid)?;
        Ok(Usage { cpu, memory })
    }

    /// Returns the CPU time since `earlier`, and the current memory.
    pub fn since(&self, earlier: &Usage) -> Usage {
        Usage {
            cpu: self.cpu.saturating_sub(earlier.cpu),
            memory: self.memory,
        }
    }
}

impl Memory {
    /// Returns the maximum of each figure.
    pub fn max(self, other: Memory) -> Memory {
        self.with(other, u64::max)
    }

    /// Returns the sum of each figure of two processes.
    pub fn plus(self, other: Memory) -> Memory {
        self.with(other, u64::saturating_add)
    }

    /// Formats unreclaimable, RSS and PSS in MB (10^6).
    pub fn megabytes(&self) -> String {
        let megabytes = |bytes: u64| bytes as f64 / 1e6;
        let (own, rss, pss) = (self.unreclaimable, self.rss, self.pss);
        format!(
            "{:.1} / {:.1} / {:.1}",
            megabytes(own),
            megabytes(rss),
            megabytes(pss)
        )
    }

    fn with(self, other: Memory, both: fn(u64, u64) -> u64) -> Memory {
        Memory {
            unreclaimable: both(self.unreclaimable, other.unreclaimable),
            rings: both(self.rings, other.rings),
            program: both(self.program, other.program),
            rss: both(self.rss, other.rss),
            pss: both(self.pss, other.pss),
        }
    }

    /// Reads the current memory of a process.
    pub fn of(pid: u32) -> Result<Memory> {
        let maps = fs::read_to_string(format!("/proc/{pid}/smaps"))
            .with_context(|| format!("cannot read the memory of process {pid}"))?;
        let memory = Memory::parse(&maps);
        ensure!(memory.rss > 0, "process {pid} has no memory");
        Ok(memory)
    }

    fn parse(maps: &str) -> Memory {
        let mut memory = Memory::default();
        let mut mapping = Mapping::default();
        for line in maps.lines() {
            let mut words = line.split_whitespace();
            let first = words.next().unwrap_or_default();
            let value = words.next().and_then(|word| word.parse::<u64>().ok());
            let bytes = value.unwrap_or(0) * 1024;
            match first {
                "Rss:" => mapping.rss = bytes,
                "Pss:" => mapping.pss = bytes,
                "Shared_Dirty:" | "Private_Dirty:" => mapping.dirty += bytes,
                "Anonymous:" => mapping.anonymous = bytes,
                "Swap:" => mapping.swapped = bytes,
                address if address.contains('-') => {
                    mapping.add_to(&mut memory);
                    let name = words.nth(3).unwrap_or_default();
                    mapping = Mapping {
                        is_ring: name.starts_with("anon_inode:bpf") || name.starts_with("socket:"),
                        is_file: name.starts_with('/'),
                        ..Mapping::default()
                    };
                }
                _ => {}
            }
        }
        mapping.add_to(&mut memory);
        memory
    }
}

#[derive(Default)]
struct Mapping {
    is_ring: bool,
    is_file: bool,
    rss: u64,
    pss: u64,
    dirty: u64,
    anonymous: u64,
    swapped: u64,
}

impl Mapping {
    fn add_to(&self, memory: &mut Memory) {
        memory.rss += self.rss;
        memory.pss += self.pss;
        let own = if self.is_ring {
            // The kernel's rings are mapped twice in succession: RSS counts them twice.
            memory.rings += self.pss;
            self.pss
        } else {
            self.anonymous.max(self.dirty) + self.swapped
        };
        memory.unreclaimable += own;
        if self.is_file {
            memory.program += own;
        }
    }
}

/// Returns the idle time of all CPUs of the machine; the remaining time is work. The kernel samples
/// its counters of work at clock ticks, and misses work that a timer starts just after a tick.
pub fn machine_idle() -> Result<Duration> {
    let statistics = fs::read_to_string("/proc/stat").context("cannot read /proc/stat")?;
    let times = statistics.lines().next().context("/proc/stat is empty")?;
    // cpu user nice system idle iowait ...
    let idle = times.split_whitespace().skip(4).take(2);
    let ticks = idle.filter_map(|ticks| ticks.parse::<u32>().ok());
    Ok(ticks.map(|ticks| TICK * ticks).sum())
}

/// Returns the CPU time of the threads to which the kernel defers packets.
pub fn softirq_cpu() -> Result<Duration> {
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

/// Returns the first number of `schedstat`: nanoseconds on a CPU.
fn run_time(task: &Path) -> Duration {
    let statistics = fs::read_to_string(task.join("schedstat")).unwrap_or_default();
    let run = statistics
        .split_whitespace()
        .next()
        .and_then(|run| run.parse().ok());
    Duration::from_nanos(run.unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_of_files_are_reclaimable_and_rings_are_not() {
        let maps = "00400000-00e00000 r-xp 00000000 fe:00 12 /usr/bin/rp
Rss:               10000 kB
Pss:                5000 kB
Shared_Dirty:          0 kB
Private_Dirty:         0 kB
Anonymous:             0 kB
00e00000-00e80000 rw-p 00a00000 fe:00 12 /usr/bin/rp
Rss:                 500 kB
Pss:                 500 kB
Private_Dirty:       400 kB
Anonymous:           400 kB
7f0000000000-7f0000400000 r--s 00000000 00:09 7 anon_inode:bpf-map
Rss:                8192 kB
Pss:                4096 kB
Private_Dirty:         0 kB
Anonymous:             0 kB
7f1000000000-7f1000100000 rw-p 00000000 00:00 0
Rss:                 900 kB
Pss:                 900 kB
Private_Dirty:       900 kB
Anonymous:           900 kB
Swap:                100 kB
VmFlags: rd wr mr mw me ac
";
        let memory = Memory::parse(maps);
        let kilobytes = [
            memory.unreclaimable,
            memory.rings,
            memory.program,
            memory.rss,
            memory.pss,
        ]
        .map(|bytes| bytes >> 10);
        assert_eq!(kilobytes, [400 + 4096 + 1000, 4096, 400, 19_592, 10_496]);
    }
}
