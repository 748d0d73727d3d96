//! Confines a thread to its role: capabilities, `no_new_privs`, and the filter of system calls.

use std::io;
use std::sync::OnceLock;
use std::sync::mpsc;
use std::thread::{Builder, JoinHandle};

use rustix::thread::CapabilitySet;

use super::calls::{self, FilterError};
use super::capabilities::{self, DropError};
use super::probe::map_updates_need_bpf;
use ros2probe_capture::system::allow_running_first;
use ros2probe_capture::threads::Task;
use ros2probe_capture::uprobe;

/// Whether filters are in force, as determined for the first confined thread. The result is the
/// same for all threads.
static SANDBOX: OnceLock<Sandbox> = OnceLock::new();

/// State of the system-call filter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sandbox {
    /// No thread of this process is confined, as in commands that replay.
    Never,
    /// Every thread has a filter.
    Filtered,
    /// No thread has a filter, for this reason.
    Unfiltered(String),
}

/// Role of a thread, which determines its privileges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The main thread and its children: signals, reloads, state, snapshots. No capability, and no
    /// outgoing connection except to the service manager.
    Service,
    /// HTTP, and recordings started by clients. Like [`Role::Service`], but without any outgoing
    /// connection. An accepted connection cannot be redirected.
    Serve,
    /// OTLP. Like [`Role::Service`], but with connections to the collector.
    Export,
    /// The ros2 daemon. No capability. It binds TCP ports, whose domains are known only later, and
    /// reads `/proc`. It creates no outgoing connection and no thread, and opens no file for
    /// writing.
    Ros2Daemon,
    /// Packets, the model and the kernel's maps. No capability if the kernel lets the owner of maps
    /// change them, otherwise `CAP_BPF`. It opens no socket, and no file for writing.
    Capture {
        /// Whether the kernel requires `CAP_BPF`, as [`Role::capture`] determines.
        needs_bpf: bool,
    },
    /// Reading shared memory. `CAP_SYS_PTRACE`, if granted, opens `/proc/<pid>/root` and hence the
    /// shared memory of containers. `CAP_SYS_NICE` is kept if no resource limit (`RLIMIT_RTPRIO`,
    /// `RLIMIT_NICE`) permits the priority.
    SharedMemory {
        /// Whether the priority requires `CAP_SYS_NICE`, as [`Role::shared_memory`] determines.
        needs_nice: bool,
    },
    /// Attaching the host hook to a recreated control group: `CAP_NET_ADMIN`, and `CAP_BPF` if the
    /// kernel requires it. It creates links, but opens no socket and no file for writing.
    Reattach {
        /// Whether the kernel requires `CAP_BPF`, as [`Role::reattach`] determines.
        needs_bpf: bool,
    },
    /// Attaching loaded programs to interfaces that appear. No capability. It creates links, but opens
    /// no socket and no file.
    Tcx,
    /// Requests to the broker, which attaches programs to libraries. No capability.
    Exact,
    /// Like [`Role::Exact`], but also uses the programs' maps, and runs loaded programs at
    /// tracepoints and receive calls. `CAP_BPF` where the kernel requires it.
    Inside {
        /// Whether the kernel requires `CAP_BPF`, as [`Role::inside`] determines.
        needs_bpf: bool,
    },
    /// The broker, a process of its own with the capabilities that [`uprobe::usable_capabilities`]
    /// returns. It forks, accepts connections, and opens files for reading, but creates no
    /// connection.
    Broker,
}

/// A thread could not be confined.
#[derive(Debug, thiserror::Error)]
pub enum ConfineError {
    /// Its capabilities could not be dropped.
    #[error(transparent)]
    Drop(#[from] DropError),
    /// `no_new_privs` could not be set.
    #[error("cannot set no_new_privs")]
    Gain(#[source] io::Error),
    /// The filter could not be built for this architecture.
    #[error("cannot build the system call filter")]
    Filter(#[source] FilterError),
}

/// A thread could not be started.
#[derive(Debug, thiserror::Error)]
pub enum SpawnError {
    /// The operating system refused the thread.
    #[error("failed to spawn a thread")]
    Thread(#[from] io::Error),
    /// The thread could not be confined, and ended.
    #[error(transparent)]
    Confine(#[from] ConfineError),
    /// The thread died before it began.
    #[error("the thread panicked")]
    Died,
}

impl Sandbox {
    /// Returns the label value.
    #[must_use]
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Never | Self::Unfiltered(_) => "all",
            Self::Filtered => "filtered",
        }
    }

    /// Returns the reason why system calls are not filtered; `None` if they are.
    #[must_use]
    pub const fn reason(&self) -> Option<&str> {
        match self {
            Self::Never => Some("part of a command"),
            Self::Filtered => None,
            Self::Unfiltered(reason) => Some(reason.as_str()),
        }
    }
}

impl Role {
    /// Returns the role of the capture thread on this kernel.
    #[must_use]
    pub fn capture() -> Self {
        let needs_bpf = map_updates_need_bpf();
        Self::Capture { needs_bpf }
    }

    /// Returns the role of the thread that attaches the host hook again, on this kernel.
    #[must_use]
    pub fn reattach() -> Self {
        let needs_bpf = map_updates_need_bpf();
        Self::Reattach { needs_bpf }
    }

    /// Returns the role of the thread that observes calls inside processes, on this kernel.
    #[must_use]
    pub fn inside() -> Self {
        let needs_bpf = map_updates_need_bpf();
        Self::Inside { needs_bpf }
    }

    /// Returns the role of the thread that reads shared memory. Raises a limit of the process.
    #[must_use]
    pub fn shared_memory() -> Self {
        let needs_nice = !allow_running_first();
        Self::SharedMemory { needs_nice }
    }

    fn capabilities(self) -> CapabilitySet {
        let nothing = CapabilitySet::empty();
        let bpf = |needs_bpf| {
            if needs_bpf {
                CapabilitySet::BPF
            } else {
                nothing
            }
        };
        match self {
            Self::Service
            | Self::Serve
            | Self::Export
            | Self::Ros2Daemon
            | Self::Tcx
            | Self::Exact => nothing,
            Self::Capture { needs_bpf } | Self::Inside { needs_bpf } => bpf(needs_bpf),
            Self::Reattach { needs_bpf } => CapabilitySet::NET_ADMIN | bpf(needs_bpf),
            Self::SharedMemory { needs_nice: false } => CapabilitySet::SYS_PTRACE,
            Self::SharedMemory { needs_nice: true } => {
                CapabilitySet::SYS_PTRACE | CapabilitySet::SYS_NICE
            }
            Self::Broker => uprobe::usable_capabilities(),
        }
    }
}

/// Confines the calling thread and its future children, permanently. If the kernel has no filters
/// (qemu's user mode, an old configuration), [`sandbox`] reports it.
///
/// # Errors
///
/// Fails if the kernel refuses to drop capabilities, which is not expected, or if the filter cannot
/// be built.
pub fn confine(role: Role) -> Result<(), ConfineError> {
    drop_capabilities(role)?;
    rustix::thread::set_no_new_privs(true).map_err(|error| ConfineError::Gain(error.into()))?;
    let sandbox = match calls::load(role) {
        Ok(()) => Sandbox::Filtered,
        Err(FilterError::Refused(reason)) => Sandbox::Unfiltered(reason),
        Err(error) => return Err(ConfineError::Filter(error)),
    };
    let _ = SANDBOX.set(sandbox);
    Ok(())
}

/// Drops only the calling thread's capabilities.
///
/// # Errors
///
/// Fails if the kernel refuses, which is not expected for capabilities that the thread has.
pub fn drop_capabilities(role: Role) -> Result<(), DropError> {
    capabilities::keep(role.capabilities())
}

/// Returns the state of the filter in this process.
#[must_use]
pub fn sandbox() -> Sandbox {
    SANDBOX.get().cloned().unwrap_or(Sandbox::Never)
}

/// Starts a thread that is confined before any other work, and returns once it is confined.
///
/// # Errors
///
/// Fails if the thread cannot be started or confined.
pub fn spawn(
    role: Role,
    thread: Builder,
    work: impl FnOnce() + Send + 'static,
) -> Result<JoinHandle<()>, SpawnError> {
    let (report, confined) = mpsc::channel();
    let thread = thread.spawn(move || {
        let confined = confine(role);
        let may_begin = confined.is_ok();
        let _ = report.send(confined);
        if may_begin {
            work();
        }
    })?;
    confined.recv().map_err(|_| SpawnError::Died)??;
    Ok(thread)
}

/// Starts the thread of exports, confined to its role.
///
/// # Errors
///
/// Fails like [`spawn`].
pub fn spawn_export(thread: Builder, work: Box<dyn FnOnce() + Send>) -> io::Result<JoinHandle<()>> {
    spawn(Role::Export, thread, work).map_err(io::Error::other)
}

/// Starts a thread of a source, confined to its task.
///
/// # Errors
///
/// Fails like [`spawn`].
pub fn spawn_source(
    task: Task,
    thread: Builder,
    work: Box<dyn FnOnce() + Send>,
) -> io::Result<JoinHandle<()>> {
    let role = match task {
        Task::SharedMemory => Role::shared_memory(),
        Task::Reattach => Role::reattach(),
        Task::Tcx => Role::Tcx,
        Task::Probes => Role::Exact,
        Task::Inside => Role::inside(),
    };
    spawn(role, thread, work).map_err(|error| match error {
        SpawnError::Thread(error) => error,
        error => io::Error::other(error),
    })
}
