//! Maps sockets to the processes that hold them.
//!
//! One run of a kernel iterator over open files (Linux 5.8) reports the open sockets of all
//! processes. It reads nothing under `/proc` and enters no process. The iterator reports only
//! sockets with a cookie, and only requested ones are kept.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read as _};
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};

use aya::programs::{Iter, ProgramError};
use aya::{Btf, BtfError, Ebpf};
use ros2probe_wire::host;
use zerocopy::FromBytes;

use crate::bpf;

/// Maximum size of the output of one run, in bytes: some 20,000 sockets.
const MAX_OUTPUT: u64 = 1 << 20;
/// `BPF_TRACE_ITER` of `linux/bpf.h`.
const TRACE_ITER: u32 = 28;

/// The process that holds a socket.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Owner {
    /// Inode of the socket.
    pub inode: u64,
    /// Process id of the holder; if several hold it (a parent and its child), the first one found.
    pub process_id: u32,
    /// Process id in the process's own PID namespace, which differs in a container.
    pub own_process_id: u32,
    /// Name of that process.
    pub process_name: String,
    /// Datagrams dropped by the socket for any reason; `None` if the kernel does not count them.
    pub drops: Option<u32>,
}

/// Why owners are unknown.
#[derive(Debug, thiserror::Error)]
pub enum OwnersError {
    /// The object lacks the program.
    #[error("the kernel filter object has no program socket_owners")]
    Missing,
    /// The kernel's types are unavailable.
    #[error("cannot list the processes that hold sockets")]
    Types(#[from] BtfError),
    /// The kernel refuses the program.
    #[error("the kernel refuses the iterator over open files")]
    Program(#[from] ProgramError),
    /// The iterator cannot be run.
    #[error("cannot run the iterator over open files")]
    Run(#[source] io::Error),
}

/// The loaded iterator. Running it needs only CAP_BPF.
pub struct Owners {
    link: OwnedFd,
}

impl Owners {
    /// Loads the program of an object whose layout globals are set.
    ///
    /// # Errors
    /// Fails if the kernel is too old, has no types, or refuses the program.
    pub fn load(ebpf: &mut Ebpf) -> Result<Self, OwnersError> {
        let program = ebpf
            .program_mut("socket_owners")
            .ok_or(OwnersError::Missing)?;
        let program: &mut Iter = program.try_into()?;
        program.load("task_file", &Btf::from_sys_fs()?)?;
        // A link created by aya allows only one run.
        let program = program.fd()?.as_fd().as_raw_fd().cast_unsigned();
        let link = bpf::create_link(program, 0, TRACE_ITER).map_err(OwnersError::Run)?;
        Ok(Self { link })
    }

    /// Returns the current owners of the open sockets in `sockets` (by cookie).
    ///
    /// Visits all open files of the host: call it a few times a minute at most.
    ///
    /// # Errors
    /// Fails if the kernel refuses the iterator.
    pub fn refresh(&self, sockets: &BTreeSet<u64>) -> Result<BTreeMap<u64, Owner>, OwnersError> {
        let link = self.link.as_raw_fd().cast_unsigned();
        let run = bpf::create_iterator(link).map_err(OwnersError::Run)?;
        let mut bytes = Vec::new();
        File::from(run)
            .take(MAX_OUTPUT)
            .read_to_end(&mut bytes)
            .map_err(OwnersError::Run)?;
        Ok(read(&bytes, sockets))
    }
}

fn read(bytes: &[u8], sockets: &BTreeSet<u64>) -> BTreeMap<u64, Owner> {
    let mut owners = BTreeMap::new();
    for each in bytes.chunks_exact(size_of::<host::Owner>()) {
        let Ok(found) = host::Owner::read_from_bytes(each) else {
            break;
        };
        if sockets.contains(&found.socket) {
            owners
                .entry(found.socket)
                .or_insert_with(|| Owner::from(&found));
        }
    }
    owners
}

impl From<&host::Owner> for Owner {
    fn from(found: &host::Owner) -> Self {
        let name = found.name.split(|byte| *byte == 0).next();
        Self {
            inode: found.inode,
            process_id: found.process_id,
            own_process_id: found.own_process_id,
            process_name: String::from_utf8_lossy(name.unwrap_or_default()).into_owned(),
            drops: (found.drops_known != 0).then_some(found.drops),
        }
    }
}

#[cfg(test)]
mod tests {
    use zerocopy::IntoBytes as _;

    use super::*;

    fn socket(cookie: u64, process_id: u32) -> host::Owner {
        host::Owner {
            socket: cookie,
            inode: cookie + 100,
            process_id,
            own_process_id: 1,
            name: *b"talker\0\0\0\0\0\0\0\0\0\0",
            ..host::Owner::default()
        }
    }

    #[test]
    fn only_requested_sockets_are_kept_with_the_first_holder_of_each() {
        let found = [socket(1, 10), socket(2, 20), socket(2, 21), socket(3, 30)];
        let owners = read(found.as_bytes(), &BTreeSet::from([2, 3, 4]));
        let listed: Vec<_> = owners
            .iter()
            .map(|(cookie, owner)| (*cookie, owner.process_id))
            .collect();
        assert_eq!(listed, [(2, 20), (3, 30)]);
        let expected = Owner {
            inode: 102,
            process_id: 20,
            own_process_id: 1,
            process_name: "talker".to_owned(),
            drops: None,
        };
        assert_eq!(owners.get(&2), Some(&expected));
    }

    #[test]
    fn drops_are_reported_if_the_kernel_counts_them() {
        let known = host::Owner {
            drops: 7,
            drops_known: 1,
            ..socket(1, 1)
        };
        assert_eq!(Owner::from(&known).drops, Some(7));
    }

    #[test]
    fn a_truncated_entry_is_ignored() {
        let found = [socket(1, 10), socket(2, 20)];
        let bytes = found.as_bytes();
        let cut = &bytes[..bytes.len() - 1];
        assert_eq!(read(cut, &BTreeSet::from([1, 2])).len(), 1);
    }
}
