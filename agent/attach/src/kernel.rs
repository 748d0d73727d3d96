//! System calls that rustix does not have: breakpoints, perf events, and forks.

use std::ffi::CStr;
use std::io;
use std::os::fd::{AsRawFd as _, BorrowedFd, FromRawFd as _, OwnedFd};

use rustix::process::Pid;

/// Command, attach type and flags of `linux/bpf.h` and `linux/perf_event.h`.
const LINK_CREATE: libc::c_int = 28;
/// Attach type of programs that one link attaches to many functions.
pub const TRACE_UPROBE_MULTI: u32 = 48;
const PERF_SET_BPF: libc::c_ulong = 0x4004_2408;
const PERF_ENABLE: libc::c_ulong = 0x2400;
/// `PERF_FLAG_FD_CLOEXEC`.
const CLOSE_ON_EXEC: libc::c_ulong = 1 << 3;
/// `PERF_TYPE_SOFTWARE` and `PERF_COUNT_SW_DUMMY`: an event that never occurs.
const SOFTWARE: u64 = 1;
const DUMMY: u64 = 9;
/// Bits of `struct perf_event_attr`: records of executable mappings, and a wake-up after some
/// bytes.
const RECORD_MAPPINGS: u64 = 1 << 8;
const WAKE_BY_BYTES: u64 = 1 << 14;
/// Sizes of `struct perf_event_attr`, PERF_ATTR_SIZE_VER0 and PERF_ATTR_SIZE_VER1.
const FIRST_SIZE: u64 = 64;
const SECOND_SIZE: u64 = 72;

/// Attributes of `BPF_LINK_CREATE` for functions of a file.
#[repr(C)]
#[derive(Default)]
struct FunctionsAttributes {
    program: u32,
    target: u32,
    attach_type: u32,
    flags: u32,
    path: u64,
    offsets: u64,
    reference_counters: u64,
    cookies: u64,
    count: u32,
    function_flags: u32,
    process: u32,
    unused: u32,
}

/// Attaches a program to instructions of a file in all processes, with one cookie for each
/// instruction (Linux 6.6). Closing the descriptor removes all of the breakpoints.
///
/// # Errors
/// Fails if the kernel has no such links, if the program has another attach type, or if an offset
/// is not an instruction.
pub fn link_functions(
    program: BorrowedFd<'_>,
    path: &CStr,
    offsets: &[u64],
    cookies: &[u64],
) -> io::Result<OwnedFd> {
    if offsets.len() != cookies.len() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    let count = u32::try_from(offsets.len()).map_err(io::Error::other)?;
    let attributes = FunctionsAttributes {
        program: program.as_raw_fd().cast_unsigned(),
        attach_type: TRACE_UPROBE_MULTI,
        path: address(path.as_ptr()),
        offsets: address(offsets.as_ptr()),
        cookies: address(cookies.as_ptr()),
        count,
        ..FunctionsAttributes::default()
    };
    // SAFETY: path, offsets and cookies outlive the call; the attributes' size is passed.
    let link = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            LINK_CREATE,
            &raw const attributes,
            size_of::<FunctionsAttributes>(),
        )
    };
    descriptor(link)
}

/// Attaches a program to one instruction of a file in all processes, by a perf event of type
/// `kind`. Closing the descriptor removes the breakpoint.
///
/// # Errors
/// Fails if the privilege is missing, or if the offset is not an instruction.
pub fn probe_function(
    program: BorrowedFd<'_>,
    kind: u32,
    path: &CStr,
    offset: u64,
) -> io::Result<OwnedFd> {
    let attributes: [u64; 9] = [
        u64::from(kind) | SECOND_SIZE << 32,
        0,
        0,
        0,
        0,
        0,
        0,
        address(path.as_ptr()),
        offset,
    ];
    let event = perf_event(&attributes, 0)?;
    // SAFETY: both requests take a number and access no memory.
    let set = unsafe { libc::ioctl(event.as_raw_fd(), PERF_SET_BPF as _, program.as_raw_fd()) };
    // SAFETY: the request takes a number and accesses no memory.
    if set < 0 || unsafe { libc::ioctl(event.as_raw_fd(), PERF_ENABLE as _, 0) } < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(event)
}

/// Opens an event that writes a record for each executable mapping on a CPU.
///
/// # Errors
/// Fails without CAP_PERFMON, or if the kernel has no such events.
pub fn mapping_event(cpu: i32) -> io::Result<OwnedFd> {
    // The values are type and size, config, period, types of samples and of reads, flags, and bytes
    // before a wake-up.
    let attributes: [u64; 9] = [
        SOFTWARE | FIRST_SIZE << 32,
        DUMMY,
        0,
        0,
        0,
        RECORD_MAPPINGS | WAKE_BY_BYTES,
        1,
        0,
        0,
    ];
    perf_event(&attributes, cpu)
}

/// Opens a perf event of all processes on a CPU.
fn perf_event(attributes: &[u64; 9], cpu: i32) -> io::Result<OwnedFd> {
    let (every_process, no_group): (libc::pid_t, libc::c_int) = (-1, -1);
    // SAFETY: the attributes are as long as they state, or longer, and outlive the call. A path in
    // them outlives it, too.
    let event = unsafe {
        libc::syscall(
            libc::SYS_perf_event_open,
            attributes.as_ptr(),
            every_process,
            cpu,
            no_group,
            CLOSE_ON_EXEC,
        )
    };
    descriptor(event)
}

/// Returns process and user of a socket's peer (SO_PEERCRED, unix(7)). The process is 0 if it is in
/// another PID namespace.
///
/// # Errors
/// Fails if the socket is not a connected unix socket.
pub(crate) fn peer(socket: BorrowedFd<'_>) -> io::Result<(u32, u32)> {
    let mut credentials = libc::ucred {
        pid: 0,
        uid: 0,
        gid: 0,
    };
    let mut length =
        libc::socklen_t::try_from(size_of::<libc::ucred>()).map_err(io::Error::other)?;
    // SAFETY: the kernel writes at most `length` bytes to the credentials, which are plain numbers.
    let got = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_PEERCRED,
            (&raw mut credentials).cast(),
            &raw mut length,
        )
    };
    match got {
        0 => Ok((credentials.pid.cast_unsigned(), credentials.uid)),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Forks. Returns the child's id in the parent, and `None` in the child.
///
/// # Errors
/// Fails if no process can be created.
///
/// # Safety
/// The process must have one thread, so that the child may run any code.
pub(crate) unsafe fn fork() -> io::Result<Option<Pid>> {
    // SAFETY: the caller ensures that the process has one thread.
    match unsafe { libc::fork() } {
        child if child < 0 => Err(io::Error::last_os_error()),
        child => Ok(Pid::from_raw(child)),
    }
}

/// Ends the forked child at once, without the exit handlers inherited from its parent.
pub(crate) fn end_fork(code: i32) -> ! {
    // SAFETY: the call runs no code of this process.
    unsafe { libc::_exit(code) }
}

/// Returns the major and minor number of the running Linux.
pub(crate) fn release() -> Option<(u32, u32)> {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").ok()?;
    let mut parts = release.split(['.', '-', '+']);
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

/// Returns the number of clock ticks of `/proc` per second (`_SC_CLK_TCK`).
pub(crate) fn ticks_per_second() -> u64 {
    // SAFETY: sysconf has no preconditions.
    let ticks = unsafe { libc::sysconf(libc::_SC_CLK_TCK) };
    u64::try_from(ticks).unwrap_or(100)
}

fn address<T>(pointer: *const T) -> u64 {
    pointer.expose_provenance() as u64
}

fn descriptor(result: libc::c_long) -> io::Result<OwnedFd> {
    match libc::c_int::try_from(result) {
        // SAFETY: the call returns a new descriptor, which nothing else owns.
        Ok(descriptor @ 0..) => Ok(unsafe { OwnedFd::from_raw_fd(descriptor) }),
        _ => Err(io::Error::last_os_error()),
    }
}
