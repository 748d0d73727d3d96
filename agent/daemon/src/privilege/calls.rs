//! System calls of each thread role, and the filter that refuses all others.
//!
//! A refused call fails with `EPERM`, as without a privilege. Newer calls fail with `ENOSYS`, so
//! that C libraries use an older, allowed one instead. Some calls are restricted by their
//! arguments: memory never becomes executable, and only the broker creates processes. Threads that
//! read the network or other processes open no file for writing.

use std::collections::BTreeMap;

use libc::c_long;
use seccompiler::{
    BackendError, BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition,
    SeccompFilter, SeccompRule, apply_filter, sock_filter,
};

use super::Role;

/// Why a filter is not in force.
#[derive(Debug, thiserror::Error)]
pub enum FilterError {
    /// The filter cannot be built.
    #[error(transparent)]
    Build(#[from] BackendError),
    /// The kernel does not support filters, or not for this process.
    #[error("{0}")]
    Refused(String),
}

/// Loads the filter of a role into the calling thread, permanently.
pub(super) fn load(role: Role) -> Result<(), FilterError> {
    let program = program(role)?;
    apply_filter(&program).map_err(|error| FilterError::Refused(error.to_string()))
}

/// Builds the program of a role's filter.
fn program(role: Role) -> Result<BpfProgram, BackendError> {
    let filter = SeccompFilter::new(
        Allowed::for_role(role)?.0,
        SeccompAction::Errno(libc::EPERM.cast_unsigned()),
        SeccompAction::Allow,
        std::env::consts::ARCH.try_into()?,
    )?;
    let mut program = absent();
    program.extend(BpfProgram::try_from(filter)?);
    Ok(program)
}

/// Newer calls, for which C libraries use an older alternative.
const ABSENT: [c_long; 3] = [libc::SYS_clone3, libc::SYS_epoll_pwait2, FCHMODAT2];
/// `fchmodat2`, which the libc crate does not define for every architecture.
const FCHMODAT2: c_long = 452;
#[cfg(target_arch = "aarch64")]
const RENAMEAT: c_long = 38;
#[cfg(not(target_arch = "aarch64"))]
const RENAMEAT: c_long = libc::SYS_renameat;

/// Returns the first part of a filter's program, which refuses [`ABSENT`] calls with `ENOSYS`. The
/// other part has a single result for refused calls. Each call of [`ABSENT`] has the same number on
/// all architectures.
fn absent() -> BpfProgram {
    let step = |code: u32, jt, jf, k| sock_filter {
        code: u16::try_from(code).unwrap_or_default(),
        jt,
        jf,
        k,
    };
    let load_number = step(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, 0);
    let refuse = libc::SECCOMP_RET_ERRNO | libc::ENOSYS.cast_unsigned();
    let mut program = vec![load_number];
    for number in ABSENT {
        let number = u32::try_from(number).unwrap_or(u32::MAX);
        let is_it = libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K;
        program.push(step(is_it, 0, 1, number));
        program.push(step(libc::BPF_RET | libc::BPF_K, 0, 0, refuse));
    }
    program
}

/// Calls of every thread: memory, locks, time, I/O on open files, exit.
const BASIC_CALLS: &[c_long] = &[
    libc::SYS_brk,
    libc::SYS_capget,
    libc::SYS_clock_getres,
    libc::SYS_clock_gettime,
    libc::SYS_clock_nanosleep,
    libc::SYS_close,
    libc::SYS_exit,
    libc::SYS_exit_group,
    libc::SYS_fcntl,
    libc::SYS_fstat,
    libc::SYS_futex,
    libc::SYS_getcwd,
    libc::SYS_getegid,
    libc::SYS_geteuid,
    libc::SYS_getgid,
    libc::SYS_getpid,
    libc::SYS_getppid,
    libc::SYS_getrandom,
    libc::SYS_gettid,
    libc::SYS_gettimeofday,
    libc::SYS_getuid,
    libc::SYS_lseek,
    libc::SYS_madvise,
    libc::SYS_mremap,
    libc::SYS_munmap,
    libc::SYS_nanosleep,
    libc::SYS_ppoll,
    libc::SYS_pread64,
    libc::SYS_read,
    libc::SYS_readv,
    libc::SYS_restart_syscall,
    libc::SYS_rseq,
    libc::SYS_rt_sigaction,
    libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn,
    libc::SYS_sched_getaffinity,
    libc::SYS_sched_yield,
    libc::SYS_set_robust_list,
    libc::SYS_sigaltstack,
    libc::SYS_sysinfo,
    libc::SYS_uname,
    libc::SYS_write,
    libc::SYS_writev,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_poll,
];

/// Calls that read file metadata and directories; opening files is allowed separately.
const READ_METADATA: &[c_long] = &[
    libc::SYS_faccessat,
    libc::SYS_faccessat2,
    libc::SYS_fadvise64,
    libc::SYS_fstatfs,
    libc::SYS_getdents64,
    libc::SYS_newfstatat,
    libc::SYS_readlinkat,
    libc::SYS_statfs,
    libc::SYS_statx,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_access,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_lstat,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_readlink,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_stat,
];

/// Calls that change files, for state and recordings.
const CHANGE_FILES: &[c_long] = &[
    libc::SYS_copy_file_range,
    libc::SYS_fallocate,
    libc::SYS_fchmod,
    libc::SYS_fchmodat,
    libc::SYS_fdatasync,
    libc::SYS_flock,
    libc::SYS_fsync,
    libc::SYS_ftruncate,
    libc::SYS_mkdirat,
    libc::SYS_openat,
    libc::SYS_pwrite64,
    RENAMEAT,
    libc::SYS_renameat2,
    libc::SYS_sendfile,
    libc::SYS_splice,
    libc::SYS_unlinkat,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_chmod,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_mkdir,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_open,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_rename,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_rmdir,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_unlink,
];

/// Calls of a tokio runtime and of its connections.
const SERVE: &[c_long] = &[
    libc::SYS_accept4,
    libc::SYS_epoll_create1,
    libc::SYS_epoll_ctl,
    libc::SYS_epoll_pwait,
    libc::SYS_eventfd2,
    libc::SYS_getpeername,
    libc::SYS_getsockname,
    libc::SYS_getsockopt,
    libc::SYS_pipe2,
    libc::SYS_recvfrom,
    libc::SYS_recvmsg,
    libc::SYS_setsockopt,
    libc::SYS_shutdown,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_epoll_wait,
];

/// Calls that can connect. A message with an address does so with TCP Fast Open.
const CONNECT: &[c_long] = &[libc::SYS_connect, libc::SYS_sendmsg, libc::SYS_sendto];

/// Calls for DNS queries: one call sends several questions, and musl binds before it sends.
const RESOLVE: &[c_long] = &[libc::SYS_bind, libc::SYS_recvmmsg, libc::SYS_sendmmsg];

/// Calls that listen for connections.
const LISTEN: &[c_long] = &[libc::SYS_bind, libc::SYS_listen];

/// Calls of inotify.
const INOTIFY_CALLS: &[c_long] = &[
    libc::SYS_inotify_add_watch,
    libc::SYS_inotify_init1,
    libc::SYS_inotify_rm_watch,
];

/// `bpf` commands of linux/bpf.h: lookup, update, delete and next key of maps.
mod command {
    pub(super) const MAPS: [libc::c_int; 4] = [1, 2, 3, 4];
    pub(super) const RAW_TRACEPOINT_OPEN: libc::c_int = 17;
    pub(super) const LINK_CREATE: libc::c_int = 28;
    pub(super) const ITERATOR_CREATE: libc::c_int = 33;
}

/// `ioctl` requests of linux/perf_event.h and asm-generic/ioctls.h, the same on both architectures.
mod request {
    pub(super) const PERF_ENABLE: i32 = 0x2400;
    pub(super) const PERF_DISABLE: i32 = 0x2401;
    pub(super) const PERF_SET_BPF: i32 = 0x4004_2408;
    /// Non-blocking and close-on-exec flags, a terminal check, and the number of readable bytes,
    /// which glibc requests after a DNS query.
    pub(super) const ORDINARY: [i32; 4] = [0x5421, 0x5451, 0x5401, 0x541b];
}

/// System calls by number, each with alternative conditions. A call without conditions is always
/// allowed.
#[derive(Default)]
struct Allowed(BTreeMap<c_long, Vec<SeccompRule>>);

impl Allowed {
    fn for_role(role: Role) -> Result<Self, BackendError> {
        let mut allowed = Self::default();
        allowed.allow(BASIC_CALLS).everywhere()?;
        match role {
            Role::Serve => allowed.serve()?,
            Role::Service => allowed.service()?,
            Role::Export => {
                allowed.service()?;
                for family in [libc::AF_INET, libc::AF_INET6] {
                    for kind in [libc::SOCK_STREAM, libc::SOCK_DGRAM] {
                        allowed.socket(family, kind)?;
                    }
                }
                allowed.allow(RESOLVE);
            }
            Role::Ros2Daemon => {
                allowed.allow(READ_METADATA).open_for_reading()?;
                allowed.allow(SERVE).allow(LISTEN).connections()?;
                allowed.socket(libc::AF_INET, libc::SOCK_STREAM)?;
            }
            Role::Capture { .. } => {
                allowed.allow(READ_METADATA).open_for_reading()?;
                allowed.allow(&[libc::SYS_getsockopt, libc::SYS_recvmsg, libc::SYS_recvfrom]);
                let commands = command::MAPS.into_iter();
                allowed.bpf(commands.chain([command::ITERATOR_CREATE]))?;
                allowed.end_perf_events()?;
            }
            Role::Reattach { .. } => {
                allowed
                    .allow(READ_METADATA)
                    .allow(INOTIFY_CALLS)
                    .open_for_reading()?;
                allowed.bpf([command::LINK_CREATE].into_iter())?;
            }
            Role::Tcx => allowed.bpf([command::LINK_CREATE].into_iter())?,
            Role::SharedMemory { .. } => {
                allowed
                    .allow(READ_METADATA)
                    .allow(INOTIFY_CALLS)
                    .open_for_reading()?;
                for policy in [libc::SCHED_FIFO, libc::SCHED_OTHER] {
                    allowed
                        .allow_if(libc::SYS_sched_setscheduler, &[argument_equals(1, policy)?])?;
                }
            }
            Role::Exact => {
                allowed.allow(INOTIFY_CALLS);
                allowed.ask_broker()?;
            }
            Role::Inside { .. } => {
                allowed.ask_broker()?;
                let commands = command::MAPS.into_iter();
                let attaching = [command::RAW_TRACEPOINT_OPEN, command::LINK_CREATE];
                allowed.bpf(commands.chain(attaching))?;
            }
            Role::Broker => allowed.answer_agents()?,
        }
        Ok(allowed)
    }

    /// Allows requests to the broker over a unix socket, and reading libraries' directories.
    fn ask_broker(&mut self) -> Result<(), BackendError> {
        self.allow(READ_METADATA).open_for_reading()?;
        self.allow(&[libc::SYS_connect, libc::SYS_recvmsg, libc::SYS_sendmsg]);
        self.allow(&[libc::SYS_setsockopt]);
        self.socket(libc::AF_UNIX, libc::SOCK_SEQPACKET)
    }

    /// Allows the calls of the broker, which answers each request in a fork and attaches programs
    /// there.
    fn answer_agents(&mut self) -> Result<(), BackendError> {
        self.allow(READ_METADATA).open_for_reading()?;
        let spaces = [
            libc::CLONE_NEWUSER,
            libc::CLONE_NEWNS,
            libc::CLONE_NEWNET,
            libc::CLONE_NEWPID,
            libc::CLONE_NEWIPC,
            libc::CLONE_NEWUTS,
            libc::CLONE_NEWCGROUP,
        ];
        let spaces = spaces.into_iter().fold(0, |all, one| all | one);
        let plain = condition(0, SeccompCmpOp::MaskedEq(sign_extended(spaces)), 0)?;
        self.allow_if(libc::SYS_clone, &[plain])?;
        self.allow(&[
            libc::SYS_accept4,
            libc::SYS_getsockopt,
            libc::SYS_kill,
            libc::SYS_perf_event_open,
            libc::SYS_pidfd_open,
            libc::SYS_recvmsg,
            libc::SYS_sendmsg,
            libc::SYS_wait4,
            #[cfg(target_arch = "x86_64")]
            libc::SYS_fork,
        ]);
        self.bpf([command::LINK_CREATE].into_iter())?;
        self.allow_if(
            libc::SYS_prctl,
            &[argument_equals(0, libc::PR_SET_PDEATHSIG)?],
        )?;
        for request in [request::PERF_ENABLE, request::PERF_SET_BPF] {
            self.allow_if(libc::SYS_ioctl, &[argument_equals(1, request)?])?;
        }
        Ok(())
    }

    fn allow(&mut self, calls: &[c_long]) -> &mut Self {
        for call in calls {
            self.0.insert(*call, Vec::new());
        }
        self
    }

    /// Allows `call` if all `conditions` hold.
    fn allow_if(
        &mut self,
        call: c_long,
        conditions: &[SeccompCondition],
    ) -> Result<(), BackendError> {
        let rule = SeccompRule::new(conditions.to_vec())?;
        self.0.entry(call).or_default().push(rule);
        Ok(())
    }

    fn everywhere(&mut self) -> Result<(), BackendError> {
        let process = i32::try_from(std::process::id()).unwrap_or(i32::MAX);
        for call in [libc::SYS_mmap, libc::SYS_mprotect] {
            self.allow_if(call, &[argument_lacks(2, libc::PROT_EXEC)?])?;
        }
        // abort() sends a signal to its own process.
        self.allow_if(libc::SYS_tgkill, &[argument_equals(0, process)?])?;
        let named_or_read = [
            libc::PR_SET_NAME,
            libc::PR_GET_NO_NEW_PRIVS,
            libc::PR_CAPBSET_READ,
        ];
        for option in named_or_read {
            self.allow_if(libc::SYS_prctl, &[argument_equals(0, option)?])?;
        }
        let is_set = argument_equals(1, libc::PR_CAP_AMBIENT_IS_SET)?;
        self.allow_if(
            libc::SYS_prctl,
            &[argument_equals(0, libc::PR_CAP_AMBIENT)?, is_set],
        )?;
        // Any thread may handle a signal, and notifies the runtime through an open socket.
        self.allow_if(libc::SYS_sendto, &[condition(4, SeccompCmpOp::Eq, 0)?])?;
        // Resource limits are only read.
        self.allow_if(libc::SYS_prlimit64, &[condition(2, SeccompCmpOp::Eq, 0)?])
    }

    fn service(&mut self) -> Result<(), BackendError> {
        self.serve()?;
        self.allow(CONNECT);
        for kind in [libc::SOCK_STREAM, libc::SOCK_DGRAM] {
            self.socket(libc::AF_UNIX, kind)?;
        }
        Ok(())
    }

    fn serve(&mut self) -> Result<(), BackendError> {
        self.allow(READ_METADATA).allow(CHANGE_FILES).allow(SERVE);
        // Only threads may be created, without new processes or namespaces.
        let kinds =
            libc::CLONE_THREAD | libc::CLONE_NEWUSER | libc::CLONE_NEWNS | libc::CLONE_NEWNET;
        let thread = SeccompCmpOp::MaskedEq(sign_extended(kinds));
        let thread = condition(0, thread, sign_extended(libc::CLONE_THREAD))?;
        self.allow_if(libc::SYS_clone, &[thread])?;
        self.connections()
    }

    /// Allows the calls that a runtime uses for its signals and connections.
    fn connections(&mut self) -> Result<(), BackendError> {
        self.allow_if(libc::SYS_socketpair, &[argument_equals(0, libc::AF_UNIX)?])?;
        for request in request::ORDINARY {
            self.allow_if(libc::SYS_ioctl, &[argument_equals(1, request)?])?;
        }
        Ok(())
    }

    fn socket(&mut self, family: i32, kind: i32) -> Result<(), BackendError> {
        let flags = libc::SOCK_CLOEXEC | libc::SOCK_NONBLOCK;
        let of_kind = SeccompCmpOp::MaskedEq(!sign_extended(flags) & u64::from(u32::MAX));
        let of_kind =
            SeccompCondition::new(1, SeccompCmpArgLen::Dword, of_kind, sign_extended(kind))?;
        self.allow_if(libc::SYS_socket, &[argument_equals(0, family)?, of_kind])
    }

    fn open_for_reading(&mut self) -> Result<(), BackendError> {
        // musl's O_ACCMODE contains O_PATH, which reads nothing.
        let changing = libc::O_WRONLY | libc::O_RDWR | libc::O_CREAT | libc::O_TRUNC;
        #[cfg(target_arch = "x86_64")]
        self.allow_if(libc::SYS_open, &[argument_lacks(1, changing)?])?;
        self.allow_if(libc::SYS_openat, &[argument_lacks(2, changing)?])
    }

    fn bpf(&mut self, commands: impl Iterator<Item = libc::c_int>) -> Result<(), BackendError> {
        for command in commands {
            self.allow_if(libc::SYS_bpf, &[argument_equals(0, command)?])?;
        }
        Ok(())
    }

    /// Allows detaching tracepoints and probes.
    fn end_perf_events(&mut self) -> Result<(), BackendError> {
        self.allow_if(
            libc::SYS_ioctl,
            &[argument_equals(1, request::PERF_DISABLE)?],
        )
    }
}

/// Returns the condition that a 32-bit argument has this value.
fn argument_equals(argument: u8, value: i32) -> Result<SeccompCondition, BackendError> {
    let value = u64::from(value.cast_unsigned());
    SeccompCondition::new(argument, SeccompCmpArgLen::Dword, SeccompCmpOp::Eq, value)
}

/// Returns the condition that an argument has none of these bits.
fn argument_lacks(argument: u8, bits: i32) -> Result<SeccompCondition, BackendError> {
    condition(argument, SeccompCmpOp::MaskedEq(sign_extended(bits)), 0)
}

fn condition(
    argument: u8,
    comparison: SeccompCmpOp,
    value: u64,
) -> Result<SeccompCondition, BackendError> {
    SeccompCondition::new(argument, SeccompCmpArgLen::Qword, comparison, value)
}

fn sign_extended(bits: i32) -> u64 {
    u64::from(bits.cast_unsigned())
}

#[cfg(test)]
mod tests;
