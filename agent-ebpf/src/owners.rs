//! Lists the processes that hold sockets. The program iterates over the open files of all processes
//! when user space reads the list.
//!
//! It writes one `host::Owner` for every file that is a socket with a cookie. A socket gets its
//! cookie when a program first reads the cookie. The programs at the sockets do so for RTPS
//! datagrams and for TCP segments with payload.

use aya_ebpf::helpers::generated::bpf_seq_write;
use ros2probe_wire::host::{Layout, Owner};

use crate::kernel_memory::{layout_entry, read_kernel, read_member};

/// Type bits of the mode of a file, and their value for a socket (`linux/stat.h`).
const S_IFMT: u16 = 0o170_000;
const S_IFSOCK: u16 = 0o140_000;

/// `struct bpf_iter__task_file`.
#[repr(C)]
pub struct BpfIterTaskFile {
    meta: *const BpfIterMeta,
    task: u64,
    fd: u64,
    file: u64,
}

/// The head of `struct bpf_iter_meta`.
#[repr(C)]
struct BpfIterMeta {
    seq: *mut aya_ebpf::bindings::seq_file,
}

#[unsafe(no_mangle)]
#[unsafe(link_section = "iter/task_file")]
pub extern "C" fn socket_owners(context: *mut BpfIterTaskFile) -> i32 {
    let _ = write_owner(context);
    0
}

#[inline(always)]
fn write_owner(context: *mut BpfIterTaskFile) -> Option<()> {
    // The pointers are read as plain numbers, because the verifier attaches its own types to them.
    let [_, task, _, file]: [u64; 4] = read_kernel(context as u64)?;
    if task == 0 || file == 0 {
        // The iteration is complete.
        return None;
    }
    let inode: u64 = read_member(file, Layout::FileInode)?;
    let mode: u16 = read_member(inode, Layout::InodeMode)?;
    if mode & S_IFMT != S_IFSOCK {
        return None;
    }
    // The file of a socket that was opened with O_PATH does not refer to the socket.
    let socket: u64 = read_member(file, Layout::FilePrivate)?;
    if read_member::<u64>(socket, Layout::SocketFile)? != file {
        return None;
    }
    let sock: u64 = read_member(socket, Layout::SocketSock)?;
    let cookie: u64 = read_member(sock, Layout::SocketCookie)?;
    if cookie == 0 {
        return None;
    }
    let leader: u64 = read_member(task, Layout::TaskLeader)?;
    let pid: u64 = read_member(leader, Layout::TaskPid)?;
    let level: u32 = read_member(pid, Layout::PidLevel)?;
    let upids_address = pid + u64::from(layout_entry(Layout::PidNumbers));
    let namespace_pid_address =
        upids_address + u64::from(level) * u64::from(layout_entry(Layout::PidNumberSize));
    let drops = read_drops(sock);
    let owner = Owner {
        socket: cookie,
        inode: read_member(inode, Layout::InodeNumber)?,
        drops: drops.unwrap_or(0),
        drops_known: u32::from(drops.is_some()),
        process_id: read_member(leader, Layout::TaskProcess)?,
        own_process_id: read_kernel(namespace_pid_address)?,
        name: read_member(leader, Layout::TaskName)?,
    };
    // SAFETY: the context of this kind of program, whose first member the verifier knows.
    let meta = unsafe { (*context).meta };
    // SAFETY: as above.
    let seq = unsafe { (*meta).seq };
    // SAFETY: the size is that of the value.
    unsafe { bpf_seq_write(seq, (&raw const owner).cast(), size_of::<Owner>() as u32) };
    Some(())
}

/// Reads a socket's drop counter. Linux 6.18 and later count the drops of some kinds of sockets
/// elsewhere, in two counters.
#[inline(always)]
fn read_drops(sock: u64) -> Option<u32> {
    if layout_entry(Layout::SocketDropCounters) != Layout::ABSENT {
        let counters: u64 = read_member(sock, Layout::SocketDropCounters)?;
        if counters != 0 {
            let first: u32 = read_kernel(counters)?;
            let second: u32 = read_member(counters, Layout::SecondDropCounter)?;
            return Some(first.wrapping_add(second));
        }
    }
    if layout_entry(Layout::SocketDrops) == Layout::ABSENT {
        return None;
    }
    read_member(sock, Layout::SocketDrops)
}
