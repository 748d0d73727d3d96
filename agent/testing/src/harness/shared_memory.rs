//! A private `/dev/shm` for a host, as containers have: a network namespace does not include one.

use std::time::Duration;

use anyhow::Result;

use super::network::Namespace;
use super::process::Process;

/// A mount namespace with an empty `/dev/shm`. It exists as long as this value.
pub struct SharedMemory {
    keeper: Process,
}

impl SharedMemory {
    /// Creates a `/dev/shm` of `megabytes` for the processes of `host`.
    pub fn of(host: &Namespace, megabytes: u32) -> Result<SharedMemory> {
        let mount = format!("mount -t tmpfs -o size={megabytes}m,mode=1777 shm /dev/shm");
        let script = format!("{mount} && echo ready && exec cat");
        let arguments = ["--mount", "sh", "-c", &script];
        let mut keeper = Process::start(&host.on_network(), "unshare", arguments)?;
        keeper.wait_for("ready", Duration::from_secs(60))?;
        Ok(SharedMemory { keeper })
    }

    /// Returns the command prefix that runs a program of `host` with this `/dev/shm`.
    pub fn inside(&self, host: &Namespace) -> Vec<String> {
        let mut words = host.on_network();
        let mounts = format!("--mount=/proc/{}/ns/mnt", self.keeper.pid());
        words.extend(["nsenter".to_owned(), mounts]);
        words
    }
}
