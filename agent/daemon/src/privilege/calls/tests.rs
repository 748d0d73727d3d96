//! Refused and allowed calls of each filter, in a thread of its own.

use std::io::{Read as _, Write as _};
use std::net::ToSocketAddrs as _;
use std::os::fd::{AsRawFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;

use ros2probe_capture::bell::Bell;
use seccompiler::TargetArch;

use super::super::{Unprivileged, confine};
use super::*;

const ROLES: [Role; 9] = [
    Role::Service,
    Role::Serve,
    Role::Export,
    Role::Ros2Daemon,
    Role::Capture { needs_bpf: false },
    Role::Reattach { needs_bpf: false },
    Role::SharedMemory { needs_nice: false },
    Role::Exact,
    Role::Inside { needs_bpf: false },
];

/// Makes a system call. Returns its error, if it fails.
fn call(number: c_long, arguments: [c_long; 6]) -> Option<i32> {
    let [one, two, three, four, five, six] = arguments;
    // SAFETY: callers pass only numbers and null. The kernel refuses them, or they change nothing
    // in this process.
    let result = unsafe { libc::syscall(number, one, two, three, four, five, six) };
    (result < 0).then(|| std::io::Error::last_os_error().raw_os_error().unwrap_or(0))
}

/// Runs `work` in a thread confined to `role`. Panics if the kernel has no filters.
fn confined<T: Send + 'static>(role: Role, work: impl FnOnce() -> T + Send + 'static) -> T {
    let thread = std::thread::spawn(move || {
        confine(role).unwrap();
        let sandbox = super::super::sandbox();
        assert_eq!(
            sandbox,
            super::super::Sandbox::Filtered,
            "these tests need a kernel with seccomp filters"
        );
        work()
    });
    thread.join().unwrap()
}

const SELF: c_long = -100;
const PRIVATE: c_long = (libc::MAP_PRIVATE | libc::MAP_ANONYMOUS) as c_long;
const READ_WRITE: c_long = (libc::PROT_READ | libc::PROT_WRITE) as c_long;
const READ_EXEC: c_long = (libc::PROT_READ | libc::PROT_EXEC) as c_long;
const RAW: c_long = libc::SOCK_RAW as c_long;
const STREAM: c_long = libc::SOCK_STREAM as c_long;
const DATAGRAM: c_long = libc::SOCK_DGRAM as c_long;

/// Calls that no role allows, with arguments that would be harmless.
const REFUSED_TO_ALL: [(&str, c_long, [c_long; 6]); 23] = [
    ("execve", libc::SYS_execve, [0; 6]),
    ("execveat", libc::SYS_execveat, [SELF, 0, 0, 0, 0, 0]),
    ("ptrace", libc::SYS_ptrace, [16, 0, 0, 0, 0, 0]),
    (
        "process_vm_writev",
        libc::SYS_process_vm_writev,
        [1, 0, 0, 0, 0, 0],
    ),
    ("pidfd_getfd", libc::SYS_pidfd_getfd, [-1, 0, 0, 0, 0, 0]),
    ("mount", libc::SYS_mount, [0; 6]),
    ("umount2", libc::SYS_umount2, [0; 6]),
    ("pivot_root", libc::SYS_pivot_root, [0; 6]),
    ("chroot", libc::SYS_chroot, [0; 6]),
    ("setns", libc::SYS_setns, [-1, 0, 0, 0, 0, 0]),
    ("unshare", libc::SYS_unshare, [0; 6]),
    ("init_module", libc::SYS_init_module, [0; 6]),
    ("finit_module", libc::SYS_finit_module, [-1, 0, 0, 0, 0, 0]),
    ("kexec_load", libc::SYS_kexec_load, [0, 0, 0, -1, 0, 0]),
    ("keyctl", libc::SYS_keyctl, [-1, 0, 0, 0, 0, 0]),
    ("add_key", libc::SYS_add_key, [0; 6]),
    ("kill", libc::SYS_kill, [i32::MAX as c_long, 0, 0, 0, 0, 0]),
    ("setuid", libc::SYS_setuid, [-1, 0, 0, 0, 0, 0]),
    ("capset", libc::SYS_capset, [0; 6]),
    ("io_uring_setup", libc::SYS_io_uring_setup, [0; 6]),
    ("userfaultfd", libc::SYS_userfaultfd, [-1, 0, 0, 0, 0, 0]),
    (
        "open_by_handle_at",
        libc::SYS_open_by_handle_at,
        [-1, 0, 0, 0, 0, 0],
    ),
    ("BPF_PROG_LOAD", libc::SYS_bpf, [5, 0, 0, 0, 0, 0]),
];

const MAPPED: (c_long, [c_long; 6]) = (libc::SYS_mmap, [0, 4096, READ_EXEC, PRIVATE, -1, 0]);
const PROTECTED: (c_long, [c_long; 6]) = (libc::SYS_mprotect, [0, 0, READ_EXEC, 0, 0, 0]);
const LOOK_UP_MAP: c_long = 1;

fn socket(family: i32, kind: c_long) -> Option<i32> {
    call(libc::SYS_socket, [family.into(), kind, 0, 0, 0, 0])
}

#[test]
fn each_thread_can_silence_a_bell_that_woke_it() {
    for role in ROLES {
        let bell = Bell::new().unwrap();
        let rings = confined(role, move || {
            [(); 2].map(|()| {
                bell.ring();
                let rang = is_readable(bell.descriptor());
                bell.drain();
                (rang, is_readable(bell.descriptor()))
            })
        });
        assert_eq!(rings, [(true, false); 2], "{role:?}");
    }
}

/// Returns whether a descriptor is readable now.
fn is_readable(descriptor: BorrowedFd<'_>) -> bool {
    let mut poll = libc::pollfd {
        fd: descriptor.as_raw_fd(),
        events: libc::POLLIN,
        revents: 0,
    };
    // SAFETY: `poll` is one entry, and outlives the call.
    unsafe { libc::poll(&raw mut poll, 1, 0) == 1 }
}

#[test]
fn no_thread_can_execute_trace_mount_or_make_memory_executable() {
    for role in ROLES {
        confined(role, move || {
            for (name, number, arguments) in REFUSED_TO_ALL {
                assert_eq!(
                    call(number, arguments),
                    Some(libc::EPERM),
                    "{role:?}: {name}"
                );
            }
            for (number, arguments) in [MAPPED, PROTECTED] {
                assert_eq!(call(number, arguments), Some(libc::EPERM), "{role:?}");
            }
            let writable = [0, 4096, READ_WRITE, PRIVATE, -1, 0];
            assert_eq!(call(libc::SYS_mmap, writable), None, "{role:?}");
            // If the call succeeded, the child would exit immediately.
            let fork = [libc::SIGCHLD.into(), 0, 0, 0, 0, 0];
            assert_eq!(call(libc::SYS_clone, fork), Some(libc::EPERM), "{role:?}");
            assert_eq!(
                call(libc::SYS_clone3, [0; 6]),
                Some(libc::ENOSYS),
                "{role:?}"
            );
        });
    }
}

#[test]
fn only_threads_with_connections_create_sockets_of_the_allowed_kinds() {
    let refused = Some(libc::EPERM);
    for role in ROLES {
        confined(role, move || {
            for (family, kind) in [
                (libc::AF_PACKET, RAW),
                (libc::AF_NETLINK, RAW),
                (libc::AF_INET, RAW),
                (libc::AF_INET6, RAW),
                (libc::AF_VSOCK, STREAM),
                (libc::AF_ALG, libc::SOCK_SEQPACKET.into()),
            ] {
                assert_eq!(socket(family, kind), refused, "{role:?}: {family}");
            }
            let connects = role == Role::Export;
            let speaks = connects || role == Role::Service;
            for kind in [STREAM, DATAGRAM] {
                assert_eq!(socket(libc::AF_UNIX, kind).is_none(), speaks, "{role:?}");
                let binds = role == Role::Ros2Daemon && kind == STREAM;
                let has_socket = socket(libc::AF_INET, kind) != refused;
                assert_eq!(has_socket, connects || binds, "{role:?}");
                assert_eq!(
                    socket(libc::AF_INET6, kind) != refused,
                    connects,
                    "{role:?}"
                );
            }
            let listen = call(libc::SYS_listen, [-1, 0, 0, 0, 0, 0]);
            assert_eq!(listen != refused, role == Role::Ros2Daemon, "{role:?}");
        });
    }
}

/// Ways to redirect a connection: `connect` after a disconnect, and messages with an address.
#[test]
fn an_accepted_connection_cannot_be_redirected() {
    for role in [Role::Serve, Role::Ros2Daemon] {
        check_connections_refused(role);
    }
}

fn check_connections_refused(role: Role) {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let elsewhere = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let _client = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (accepted, _) = listener.accept().unwrap();
    let port = elsewhere.local_addr().unwrap().port();
    let led = confined(role, move || {
        let socket = c_long::from(accepted.as_raw_fd());
        let family = |family: i32| u16::try_from(family).unwrap().to_ne_bytes();
        let mut nowhere = [0_u8; 16];
        nowhere[..2].copy_from_slice(&family(libc::AF_UNSPEC));
        let mut there = [0_u8; 16];
        there[..2].copy_from_slice(&family(libc::AF_INET));
        there[2..4].copy_from_slice(&port.to_be_bytes());
        there[4..8].copy_from_slice(&[127, 0, 0, 1]);
        let connect = |address: &[u8; 16]| {
            // SAFETY: the address lives until the call returns.
            let result = unsafe {
                libc::syscall(libc::SYS_connect, socket, address.as_ptr(), address.len())
            };
            (result < 0).then(|| std::io::Error::last_os_error().raw_os_error().unwrap_or(0))
        };
        let fast_open = c_long::from(libc::MSG_FASTOPEN);
        // SAFETY: the address lives until the call returns; nothing is sent.
        let sent = unsafe {
            let (none, length) = (std::ptr::null::<u8>(), there.len());
            libc::syscall(
                libc::SYS_sendto,
                socket,
                none,
                0,
                fast_open,
                there.as_ptr(),
                length,
            )
        };
        let message = call(libc::SYS_sendmsg, [socket, 0, fast_open, 0, 0, 0]);
        let answered = (&accepted).write_all(b"answer").is_ok();
        (
            connect(&nowhere),
            connect(&there),
            sent < 0,
            message,
            answered,
        )
    });
    let refused = Some(libc::EPERM);
    assert_eq!(led, (refused, refused, true, refused, true), "{role:?}");
    elsewhere.set_nonblocking(true).unwrap();
    assert!(elsewhere.accept().is_err());
}

#[test]
fn only_threads_that_need_kernel_maps_can_read_them_and_no_thread_can_probe() {
    let lookup = [LOOK_UP_MAP, 0, 0, 0, 0, 0];
    let may = call(libc::SYS_bpf, lookup);
    for role in ROLES {
        let is_capture = matches!(role, Role::Capture { .. });
        let is_inside = matches!(role, Role::Inside { .. });
        let role = match role {
            Role::Capture { .. } => Role::capture(),
            Role::Inside { .. } => Role::inside(),
            role => role,
        };
        confined(role, move || {
            let looked_up = call(libc::SYS_bpf, lookup);
            let reads = is_capture || is_inside;
            let expected = if reads { may } else { Some(libc::EPERM) };
            assert_eq!(looked_up, expected, "{role:?}");
            let open = call(libc::SYS_perf_event_open, [0, 0, -1, -1, 0, 0]);
            assert_eq!(open, Some(libc::EPERM), "{role:?}");
            let memory = call(libc::SYS_process_vm_readv, [0; 6]);
            assert_eq!(memory, Some(libc::EPERM), "{role:?}");
        });
    }
}

#[test]
fn the_broker_attaches_probes_but_creates_no_socket_file_or_namespace() {
    confined(Role::Broker, || {
        let probe = call(libc::SYS_perf_event_open, [0, 0, -1, -1, 0, 0]);
        assert_ne!(probe, Some(libc::EPERM));
        let memory = call(libc::SYS_process_vm_readv, [0; 6]);
        assert_eq!(memory, Some(libc::EPERM));
        let namespace = c_long::from(libc::CLONE_NEWUSER | libc::SIGCHLD);
        let fork = call(libc::SYS_clone, [namespace, 0, 0, 0, 0, 0]);
        assert_eq!(fork, Some(libc::EPERM));
        assert!(std::fs::read("/proc/self/stat").is_ok());
        // The broker walks to a library by its path, with O_PATH of asm-generic/fcntl.h.
        let (directory, path_only) = (c"/".as_ptr() as c_long, 0o10_000_000);
        let walk = call(libc::SYS_openat, [SELF, directory, path_only, 0, 0, 0]);
        assert_eq!(walk, None);
        assert!(std::fs::write("/tmp/ros2probe-broker", "x").is_err());
        for kind in [libc::SOCK_STREAM, libc::SOCK_SEQPACKET] {
            let socket = [libc::AF_UNIX.into(), kind.into(), 0, 0, 0, 0];
            assert_eq!(call(libc::SYS_socket, socket), Some(libc::EPERM));
        }
        let lookup = call(libc::SYS_bpf, [1, 0, 0, 0, 0, 0]);
        assert_eq!(lookup, Some(libc::EPERM));
    });
}

#[test]
fn capture_threads_cannot_open_a_file_for_writing() {
    let directory = tempfile::tempdir().unwrap();
    for role in ROLES {
        let file = directory.path().join(format!("{role:?}"));
        confined(role, move || {
            let reads = std::fs::read("/proc/self/stat");
            assert!(reads.is_ok(), "{role:?}");
            let writes = matches!(role, Role::Service | Role::Serve | Role::Export);
            assert_eq!(std::fs::write(&file, "x").is_ok(), writes, "{role:?}");
            assert_eq!(std::fs::remove_file(&file).is_ok(), writes, "{role:?}");
        });
    }
}

/// Privileges of single threads: links, file notifications, their own scheduling.
#[test]
fn only_threads_that_need_links_inotify_or_scheduling_can_use_them() {
    // The link has no program, and the scheduling call has no parameters.
    let link = [command::LINK_CREATE.into(), 0, 0, 0, 0, 0];
    let running_first = [0, libc::SCHED_FIFO.into(), 0, 0, 0, 0];
    let when_idle = [0, libc::SCHED_IDLE.into(), 0, 0, 0, 0];
    let refused = Some(libc::EPERM);
    for role in ROLES {
        let role = match role {
            Role::Reattach { .. } => Role::reattach(),
            Role::Inside { .. } => Role::inside(),
            other => other,
        };
        confined(role, move || {
            let attaches = matches!(role, Role::Reattach { .. });
            let schedules = matches!(role, Role::SharedMemory { .. });
            let links = attaches || matches!(role, Role::Inside { .. });
            assert_eq!(call(libc::SYS_bpf, link) != refused, links, "{role:?}");
            let notices = call(libc::SYS_inotify_init1, [0; 6]) != refused;
            let is_noticed = attaches || role == Role::Exact;
            assert_eq!(notices, is_noticed || schedules, "{role:?}");
            let scheduled = call(libc::SYS_sched_setscheduler, running_first) != refused;
            assert_eq!(scheduled, schedules, "{role:?}");
            let idle = call(libc::SYS_sched_setscheduler, when_idle);
            assert_eq!(idle, refused, "{role:?}");
        });
    }
}

#[test]
fn a_confined_thread_can_start_threads_resolve_names_and_allocate() {
    confined(Role::Export, || {
        let named = std::thread::Builder::new().name("another".to_owned());
        let thread = named.spawn(|| vec![1_u8; 64 << 20].len()).unwrap();
        assert_eq!(thread.join().unwrap(), 64 << 20);
        assert!(("localhost", 80).to_socket_addrs().unwrap().count() > 0);
    });
}

/// A signal handler writes to a socket, in a thread that the kernel chooses.
#[test]
fn every_thread_can_forward_a_signal() {
    for role in ROLES {
        let (one, mut other) = UnixStream::pair().unwrap();
        let passed = confined(role, move || (&one).write_all(&[1]).is_ok());
        let mut byte = [0];
        assert_eq!(
            (passed, other.read(&mut byte).unwrap()),
            (true, 1),
            "{role:?}"
        );
    }
}

#[test]
fn a_confined_thread_has_no_capability_and_an_unconfined_one_is_refused() {
    let has_none = rustix::thread::capabilities(None)
        .unwrap()
        .permitted
        .is_empty();
    if !has_none {
        let error = Unprivileged::verify().unwrap_err().to_string();
        assert!(error.starts_with("refusing to serve: CAP_"), "{error}");
    }
    confined(Role::Service, || {
        assert!(Unprivileged::verify().is_ok());
    });
}

#[test]
fn a_filter_is_below_the_kernel_limit_and_builds_for_both_architectures() {
    for role in ROLES {
        let calls = Allowed::for_role(role).unwrap().0.len();
        let length = program(role).unwrap().len();
        eprintln!("{role:?}: {calls} system calls, {length} instructions");
        // The kernel's limit is 4096.
        assert!((100..1200).contains(&length), "{role:?}: {length}");
        for architecture in [TargetArch::x86_64, TargetArch::aarch64] {
            let filter = SeccompFilter::new(
                Allowed::for_role(role).unwrap().0,
                SeccompAction::Errno(1),
                SeccompAction::Allow,
                architecture,
            );
            assert!(BpfProgram::try_from(filter.unwrap()).is_ok());
        }
    }
}
