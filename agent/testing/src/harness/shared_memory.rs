//! A `/dev/shm` of a host's own, as a container has it: a network namespace does not bring one.

use std::time::Duration;

use anyhow::Result;

use super::network::Namespace;
use super::process::Process;

/// A mount namespace with an empty `/dev/shm`. It lasts as long as this value.
pub struct SharedMemory {
    keeper: Process,
}

impl SharedMemory {
    /// For the processes of `host`; `megabytes` is its size.
    pub fn of(host: &Namespace, megabytes: u32) -> Result<SharedMemory> {
        let mount = format!("mount -t tmpfs -o size={megabytes}m,mode=1777 shm /dev/shm");
        let script = format!("{mount} && echo ready && exec cat");
        let arguments = ["--mount", "sh", "-c", &script];
        let mut keeper = Process::start(&host.on_network(), "unshare", arguments)?;
        keeper.wait_for("ready", Duration::from_secs(10))?;
        Ok(SharedMemory { keeper })
    }

    /// The words that run a command of `host` with it.
    pub fn inside(&self, host: &Namespace) -> Vec<String> {
        let mut words = host.on_network();
        let mounts = format!("--mount=/proc/{}/ns/mnt", self.keeper.pid());
        words.extend(["nsenter".to_owned(), mounts]);
        words
    }
}
