//! Lists the processes that hold sockets. The program iterates over the open files of all processes
//! when user space reads the list.
//!
//! It writes one `host::Owner` for every file that is a socket with a cookie. A socket gets its
//! cookie when a program first reads the cookie. The programs at the sockets do so for RTPS
//! datagrams and for TCP segments with payload.

use aya_ebpf::helpers::generated::bpf_seq_write;
use ros2probe_wire::host::{Layout, Owner};

use crate::kernel_memory::{member, place, read};

/// `S_IFMT` and `S_IFSOCK`.
const KIND_OF_FILE: u16 = 0o170_000;
const SOCKET: u16 = 0o140_000;

/// `struct bpf_iter__task_file`.
#[repr(C)]
pub struct TaskFile {
    meta: *const Meta,
    task: u64,
    descriptor: u64,
    file: u64,
}

/// The head of `struct bpf_iter_meta`.
#[repr(C)]
struct Meta {
    seq: *mut aya_ebpf::bindings::seq_file,
}

#[unsafe(no_mangle)]
#[unsafe(link_section = "iter/task_file")]
pub extern "C" fn socket_owners(context: *mut TaskFile) -> i32 {
    let _ = entry(context);
    0
}

#[inline(always)]
fn entry(context: *mut TaskFile) -> Option<()> {
    // The pointers are read as plain numbers, because the verifier attaches its own types to them.
    let [_, task, _, file]: [u64; 4] = read(context as u64)?;
    if task == 0 || file == 0 {
        // The iteration is complete.
        return None;
    }
    let inode: u64 = member(file, Layout::FileInode)?;
    let mode: u16 = member(inode, Layout::InodeMode)?;
    if mode & KIND_OF_FILE != SOCKET {
        return None;
    }
    // The file of a socket that was opened with O_PATH does not refer to the socket.
    let socket: u64 = member(file, Layout::FilePrivate)?;
    if member::<u64>(socket, Layout::SocketFile)? != file {
        return None;
    }
    let sock: u64 = member(socket, Layout::SocketSock)?;
    let cookie: u64 = member(sock, Layout::SocketCookie)?;
    if cookie == 0 {
        return None;
    }
    let leader: u64 = member(task, Layout::TaskLeader)?;
    let pid: u64 = member(leader, Layout::TaskPid)?;
    let level: u32 = member(pid, Layout::PidLevel)?;
    let numbers = pid + u64::from(place(Layout::PidNumbers));
    let own = numbers + u64::from(level) * u64::from(place(Layout::PidNumberSize));
    let drops = drops(sock);
    let owner = Owner {
        socket: cookie,
        inode: member(inode, Layout::InodeNumber)?,
        drops: drops.unwrap_or(0),
        drops_known: u32::from(drops.is_some()),
        process_id: member(leader, Layout::TaskProcess)?,
        own_process_id: read(own)?,
        name: member(leader, Layout::TaskName)?,
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
fn drops(sock: u64) -> Option<u32> {
    if place(Layout::SocketDropCounters) != Layout::ABSENT {
        let counters: u64 = member(sock, Layout::SocketDropCounters)?;
        if counters != 0 {
            let first: u32 = read(counters)?;
            let second: u32 = member(counters, Layout::SecondDropCounter)?;
            return Some(first.wrapping_add(second));
        }
    }
    if place(Layout::SocketDrops) == Layout::ABSENT {
        return None;
    }
    member(sock, Layout::SocketDrops)
}
