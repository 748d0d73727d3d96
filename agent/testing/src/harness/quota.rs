//! A control group with a quota of CPU time, by either version of the hierarchy. With the second
//! version a process leaves its own group, because a group with processes has no groups below it.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result};

const PERIOD_US: u32 = 100_000;

/// The group. Dropping the value moves its processes to the root group.
pub struct Quota(PathBuf);

impl Quota {
    /// Lets a process run for this part of each 100 ms.
    pub fn limit(process: u32, percent: u32) -> Result<Self> {
        let name = format!("{}-{}-quota-{process}", super::PREFIX, std::process::id());
        let quota_us = PERIOD_US / 100 * percent;
        let first = Path::new("/sys/fs/cgroup/cpu");
        let (group, limits) = if first.join("cpu.cfs_quota_us").exists() {
            let limits = vec![
                ("cpu.cfs_period_us", PERIOD_US.to_string()),
                ("cpu.cfs_quota_us", quota_us.to_string()),
            ];
            (first.join(name), limits)
        } else {
            let limits = vec![("cpu.max", format!("{quota_us} {PERIOD_US}"))];
            let root = Path::new("/sys/fs/cgroup");
            let _ = fs::write(root.join("cgroup.subtree_control"), "+cpu");
            (root.join(name), limits)
        };
        fs::create_dir(&group).with_context(|| format!("cannot create {}", group.display()))?;
        let quota = Self(group);
        for (file, limit) in limits {
            let written = fs::write(quota.0.join(file), limit);
            written.context("this kernel has no CPU quotas (CONFIG_CFS_BANDWIDTH)")?;
        }
        quota.add(process)?;
        Ok(quota)
    }

    /// Adds another process.
    pub fn add(&self, process: u32) -> Result<()> {
        Ok(fs::write(self.0.join("cgroup.procs"), process.to_string())?)
    }

    /// Returns how long the kernel has throttled the group.
    pub fn throttled(&self) -> Result<Duration> {
        let text = fs::read_to_string(self.0.join("cpu.stat"))?;
        let of = |name| {
            let mut lines = text.lines().filter_map(|line| line.split_once(' '));
            let (_, value) = lines.find(|(field, _)| *field == name)?;
            value.parse::<u64>().ok()
        };
        let nanoseconds = of("throttled_time").map(Duration::from_nanos);
        let microseconds = || of("throttled_usec").map(Duration::from_micros);
        nanoseconds.or_else(microseconds).context(text.clone())
    }
}

impl Drop for Quota {
    fn drop(&mut self) {
        let processes = fs::read_to_string(self.0.join("cgroup.procs")).unwrap_or_default();
        for process in processes.split_whitespace() {
            let _ = fs::write(self.0.with_file_name("cgroup.procs"), process);
        }
        let _ = fs::remove_dir(&self.0);
    }
}
