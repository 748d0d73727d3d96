//! The use of the directories: how full they are, what ended processes left, and which nodes are
//! apart although they seem to be on one host.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use super::directories::{Name, ShmDirectories, ShmDirectory};
use super::owner::{Locks, Owner};
use ros2probe_model::facts::shared_memory::MemoryUse;
use ros2probe_wire::DomainId;

/// Size of the blocks that a file's metadata counts, in bytes.
const FILE_BLOCK_BYTES: u64 = 512;

/// Inode of a network namespace, and a domain. Participants of Fast DDS that have both in common
/// use shared memory with each other.
type SharingGroup = (u64, u32);

impl ShmDirectories {
    /// Returns the use of the directories. Network namespaces of processes that this process may
    /// not inspect are unknown.
    #[must_use]
    pub fn memory_use(&self) -> MemoryUse {
        let locks = Locks::read();
        let mut memory = MemoryUse::default();
        let mut meetings: BTreeMap<SharingGroup, u64> = BTreeMap::new();
        for directory in self.directories.values() {
            let (stale, of_directory) = directory.owners(&locks);
            memory.stale_bytes += stale;
            if let Ok(space) = rustix::fs::statvfs(&directory.path) {
                let permille = |part: u64| part.saturating_mul(1000).checked_div(space.f_blocks);
                let used = permille(space.f_blocks.saturating_sub(space.f_bavail));
                let stale = permille(stale.checked_div(space.f_frsize).unwrap_or(0));
                memory.used_permille = memory.used_permille.max(used.unwrap_or(0));
                memory.stale_permille = memory.stale_permille.max(stale.unwrap_or(0));
            }
            for meeting in of_directory {
                *meetings.entry(meeting).or_default() += 1;
            }
        }
        let most = meetings.into_values().max();
        memory.split_directories = most.filter(|most| *most > 1).unwrap_or(0);
        memory
    }
}

impl ShmDirectory {
    /// Returns the bytes of files of ended processes, and where living processes with ports meet.
    fn owners(&self, locks: &Locks) -> (u64, BTreeSet<SharingGroup>) {
        let (mut stale, mut meetings) = (0, BTreeSet::new());
        for name in self.files.keys() {
            let path = self.path.join(name.file_name());
            match (locks.owner(&path), name) {
                (Owner::Dead, _) => {
                    let metadata = fs::symlink_metadata(&path);
                    stale += metadata.map_or(0, |metadata| metadata.blocks() * FILE_BLOCK_BYTES);
                }
                (Owner::Alive(process), Name::Port(_, number)) => {
                    let network = fs::metadata(Path::new(&format!("/proc/{process}/ns/net")));
                    let offset = number.checked_sub(DomainId::PORT_BASE.into());
                    let domain = offset.map(|offset| offset / u32::from(DomainId::PORT_GAIN));
                    if let (Ok(network), Some(domain)) = (network, domain) {
                        meetings.insert((network.ino(), domain));
                    }
                }
                (Owner::Alive(_) | Owner::Unknown, _) => {}
            }
        }
        (stale, meetings)
    }
}
