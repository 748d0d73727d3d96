//! The cgroup of a host: separates its sockets from those of other tests, which the agent's host
//! source would see as well.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsRawFd as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};

use super::remove_leftovers;

/// Maximum wait for killed processes to exit.
const PATIENCE: Duration = Duration::from_secs(5);

/// Locked while this process is in the cgroup of one of its tests.
static MOVED: Mutex<()> = Mutex::new(());

pub struct Cgroup {
    path: PathBuf,
}

impl Cgroup {
    pub fn create(name: &str) -> Result<Cgroup> {
        let path = hierarchy()?.join(name);
        fs::create_dir(&path).with_context(|| format!("cannot create {}", path.display()))?;
        Ok(Cgroup { path })
    }

    /// Creates a cgroup below this one. The new cgroup must be removed before this one.
    pub fn create_below(&self, name: &str) -> Result<Cgroup> {
        let path = self.path.join(name);
        fs::create_dir(&path).with_context(|| format!("cannot create {}", path.display()))?;
        Ok(Cgroup { path })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the command prefix that runs a program in this cgroup.
    pub fn inside(&self) -> Vec<String> {
        let enter = r#"echo 0 >"$0/cgroup.procs" && exec "$@""#;
        let path = self.path.display().to_string();
        vec!["sh".to_owned(), "-c".to_owned(), enter.to_owned(), path]
    }

    /// Runs `make` with this process in the cgroup, and moves the process back: a socket belongs to
    /// the cgroup in which it was created. Tests of one process do so one after another.
    pub fn hold<T>(&self, make: impl FnOnce() -> T) -> Result<T> {
        let turn = MOVED.lock();
        let own = fs::read_to_string("/proc/self/cgroup").context("cannot read /proc")?;
        let own = own.lines().find_map(|line| line.strip_prefix("0::/"));
        let back = hierarchy()?.join(own.unwrap_or_default());
        enter(&self.path)?;
        let made = make();
        enter(&back)?;
        drop(turn);
        Ok(made)
    }
}

impl Drop for Cgroup {
    fn drop(&mut self) {
        let deadline = Instant::now() + PATIENCE;
        // This file exists in Linux 5.14 and newer. On older kernels, the processes have been ended
        // one by one.
        let _ = fs::write(self.path.join("cgroup.kill"), "1");
        while let Err(error) = fs::remove_dir(&self.path) {
            if Instant::now() > deadline {
                eprintln!("cannot remove {}: {error}", self.path.display());
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Moves this process to a cgroup.
fn enter(cgroup: &Path) -> Result<()> {
    fs::write(cgroup.join("cgroup.procs"), "0")
        .with_context(|| format!("cannot move to {}", cgroup.display()))
}

/// Returns the mount point of the cgroup v2 hierarchy.
pub fn hierarchy() -> Result<PathBuf> {
    let mounts = fs::read_to_string("/proc/self/mounts").context("cannot read the mounts")?;
    let path = mounts.lines().find_map(|line| {
        let mut words = line.split(' ').skip(1);
        let path = words.next()?;
        (words.next() == Some("cgroup2")).then(|| PathBuf::from(path))
    });
    path.context("no cgroup2 is mounted: `mount -t cgroup2 none /sys/fs/cgroup/unified`")
}

/// Returns the number of programs attached for received and sent datagrams, without programs
/// attached to its ancestors.
pub fn attached(cgroup: &Path) -> Result<[u32; 2]> {
    /// The part of `union bpf_attr` for BPF_PROG_QUERY (linux/bpf.h).
    #[repr(C)]
    #[derive(Default)]
    struct Query {
        target_fd: u32,
        attach_type: u32,
        query_flags: u32,
        attach_flags: u32,
        prog_ids: u64,
        prog_cnt: u32,
        unused: u32,
    }
    const BPF_PROG_QUERY: libc::c_int = 16;
    const INGRESS_AND_EGRESS: [u32; 2] = [0, 1];
    let directory = File::open(cgroup)?;
    let mut counts = [0; 2];
    for (count, attach_type) in counts.iter_mut().zip(INGRESS_AND_EGRESS) {
        let mut query = Query {
            target_fd: directory.as_raw_fd().cast_unsigned(),
            attach_type,
            ..Query::default()
        };
        // SAFETY: the attribute's size is passed; without room for ids the kernel writes none.
        let result = unsafe {
            libc::syscall(
                libc::SYS_bpf,
                BPF_PROG_QUERY,
                &raw mut query,
                size_of::<Query>(),
            )
        };
        if result < 0 {
            return Err(io::Error::last_os_error()).context("BPF_PROG_QUERY");
        }
        *count = query.prog_cnt;
    }
    Ok(counts)
}

/// Removes the cgroups of processes that were killed before they could remove them.
pub fn sweep() {
    if let Ok(hierarchy) = hierarchy() {
        remove_leftovers(&hierarchy, |name| {
            remove(&hierarchy.join(name));
        });
    }
}

fn remove(path: &Path) {
    for below in fs::read_dir(path).into_iter().flatten().flatten() {
        if below.file_type().is_ok_and(|kind| kind.is_dir()) {
            remove(&below.path());
        }
    }
    let _ = fs::remove_dir(path);
}
