//! Which process holds which socket.
//!
//! Asks the kernel for all open sockets of all processes at once (an iterator over open files, Linux
//! 5.8); nothing is read under `/proc`, and no process is entered. Only sockets with a cookie are
//! told, and kept only if they are asked for.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read as _};
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};

use aya::programs::{Iter, ProgramError};
use aya::{Btf, BtfError, Ebpf};
use ros2probe_wire::host;
use zerocopy::FromBytes;

use crate::bpf;

/// Bytes that one run may give: some 20,000 sockets.
const LIMIT: u64 = 1 << 20;
/// `BPF_TRACE_ITER` of `linux/bpf.h`.
const TRACE_ITER: u32 = 28;

/// Who holds a socket.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Owner {
    /// Inode of the socket.
    pub inode: u64,
    /// Process that holds it; of several (a parent and its child) the first found.
    pub process_id: u32,
    /// The same as the process itself sees it: another number in a container.
    pub own_process_id: u32,
    /// Name of that process.
    pub process_name: String,
    /// Datagrams that the socket has dropped for whatever reason, where the kernel tells.
    pub drops: Option<u32>,
}

/// Why owners are not known.
#[derive(Debug, thiserror::Error)]
pub enum OwnersError {
    /// The object has no such program.
    #[error("the kernel filter object has no program socket_owners")]
    Missing,
    /// The kernel does not describe its types.
    #[error("the kernel's types")]
    Types(#[from] BtfError),
    /// The kernel refuses the program.
    #[error("the kernel refuses the iterator over open files")]
    Program(#[from] ProgramError),
    /// The iterator cannot be run.
    #[error("cannot run the iterator over open files")]
    Run(#[source] io::Error),
}

/// The loaded iterator. Running it needs no more than CAP_BPF.
pub struct Owners {
    link: OwnedFd,
}

impl Owners {
    /// Loads the program of an object that was told the kernel's types.
    ///
    /// # Errors
    /// The kernel is too old, shows no types, or refuses the program.
    pub fn load(ebpf: &mut Ebpf) -> Result<Self, OwnersError> {
        let program = ebpf
            .program_mut("socket_owners")
            .ok_or(OwnersError::Missing)?;
        let program: &mut Iter = program.try_into()?;
        program.load("task_file", &Btf::from_sys_fs()?)?;
        // A link of aya's gives one run only.
        let program = program.fd()?.as_fd().as_raw_fd().cast_unsigned();
        let link = bpf::create_link(program, 0, TRACE_ITER).map_err(OwnersError::Run)?;
        Ok(Self { link })
    }

    /// The owners, as of now, of those of `sockets` (by cookie) that are still open.
    ///
    /// Goes through all open files of the host: a few times a minute, not more.
    ///
    /// # Errors
    /// The kernel refuses.
    pub fn refresh(&self, sockets: &BTreeSet<u64>) -> Result<BTreeMap<u64, Owner>, OwnersError> {
        let link = self.link.as_raw_fd().cast_unsigned();
        let run = bpf::create_iterator(link).map_err(OwnersError::Run)?;
        let mut bytes = Vec::new();
        File::from(run)
            .take(LIMIT)
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
    fn only_wanted_sockets_are_kept_and_the_first_holder_of_a_shared_one() {
        let found = [socket(1, 10), socket(2, 20), socket(2, 21), socket(3, 30)];
        let owners = read(found.as_bytes(), &BTreeSet::from([2, 3, 4]));
        let told: Vec<_> = owners
            .iter()
            .map(|(cookie, owner)| (*cookie, owner.process_id))
            .collect();
        assert_eq!(told, [(2, 20), (3, 30)]);
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
    fn drops_are_told_where_the_kernel_counts_them() {
        let known = host::Owner {
            drops: 7,
            drops_known: 1,
            ..socket(1, 1)
        };
        assert_eq!(Owner::from(&known).drops, Some(7));
    }

    #[test]
    fn an_entry_that_was_cut_is_left() {
        let found = [socket(1, 10), socket(2, 20)];
        let bytes = found.as_bytes();
        let cut = &bytes[..bytes.len() - 1];
        assert_eq!(read(cut, &BTreeSet::from([1, 2])).len(), 1);
    }
}
