//! Confining a thread to what its role needs: capabilities, `no_new_privs`, the filter of system calls.

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

/// Whether filters are in force, as the kernel answered when the first thread was confined: its answer
/// is the same for all.
static FILTERED: OnceLock<Result<(), String>> = OnceLock::new();

/// What keeps system calls that the agent does not make from being made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sandbox {
    /// Nothing: no thread of this process was confined. A command that replays is no agent.
    Never,
    /// A filter in every thread.
    Filtered,
    /// Nothing, for this reason.
    Unfiltered(&'static str),
}

/// What a thread is for, which decides what it keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// `main` and whatever it starts: signals, reloads, state, snapshots. No capability; no
    /// connection of its own but to the service manager.
    Service,
    /// HTTP, and recordings that clients begin: as [`Role::Service`], and no connection of its own
    /// at all. A connection that was accepted cannot be led elsewhere.
    Serve,
    /// OTLP: as [`Role::Service`], and connections to the collector.
    Export,
    /// Packets, the model, the kernel's maps: no capability where the kernel lets the maps' owner
    /// change them, otherwise `CAP_BPF`. Opens nothing for writing, and no socket.
    Capture {
        /// As [`Role::capture`] found out.
        needs_bpf: bool,
    },
    /// Looks at shared memory: `CAP_SYS_PTRACE`, which opens `/proc/<pid>/root`, and so the shared
    /// memory of containers, if it was given; `CAP_SYS_NICE` where no limit allows it to run first.
    SharedMemory {
        /// As [`Role::shared_memory`] found out.
        needs_nice: bool,
    },
    /// Attaches the host hook to a control group that is made anew: `CAP_NET_ADMIN`, and `CAP_BPF`
    /// where the kernel wants it. Creates links, and opens nothing for writing, and no socket.
    Reattach {
        /// As [`Role::reattach`] found out.
        needs_bpf: bool,
    },
    /// Attaches to libraries: `CAP_SYS_ADMIN` and `CAP_SYS_PTRACE`.
    Exact,
}

/// Why a thread has more than it should.
#[derive(Debug, thiserror::Error)]
pub enum ConfineError {
    /// Capabilities.
    #[error(transparent)]
    Drop(#[from] DropError),
    /// Programs that it executes.
    #[error("cannot set no_new_privs")]
    Gain(#[source] io::Error),
    /// The filter is not to be had for this machine.
    #[error("cannot build the system call filter")]
    Filter(#[source] FilterError),
}

/// Why there is no thread.
#[derive(Debug, thiserror::Error)]
pub enum SpawnError {
    /// The system has none.
    #[error("failed to spawn a thread")]
    Thread(#[from] io::Error),
    /// It could not be confined, and ended.
    #[error(transparent)]
    Confine(#[from] ConfineError),
    /// It died before it had begun.
    #[error("the thread panicked")]
    Died,
}

impl Sandbox {
    /// Label value.
    #[must_use]
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Never | Self::Unfiltered(_) => "all",
            Self::Filtered => "filtered",
        }
    }

    /// Why system calls are not filtered.
    #[must_use]
    pub const fn reason(&self) -> Option<&'static str> {
        match self {
            Self::Never => Some("part of a command"),
            Self::Filtered => None,
            Self::Unfiltered(reason) => Some(reason),
        }
    }
}

impl Role {
    /// The capture thread's, on this kernel.
    #[must_use]
    pub fn capture() -> Self {
        let needs_bpf = map_updates_need_bpf();
        Self::Capture { needs_bpf }
    }

    /// That of the thread that attaches the host hook again, on this kernel.
    #[must_use]
    pub fn reattach() -> Self {
        let needs_bpf = map_updates_need_bpf();
        Self::Reattach { needs_bpf }
    }

    /// That of the thread that looks at shared memory. Raises a limit of the process.
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
            Self::Service | Self::Serve | Self::Export => nothing,
            Self::Capture { needs_bpf } => bpf(needs_bpf),
            Self::Reattach { needs_bpf } => CapabilitySet::NET_ADMIN | bpf(needs_bpf),
            Self::SharedMemory { needs_nice: false } => CapabilitySet::SYS_PTRACE,
            Self::SharedMemory { needs_nice: true } => {
                CapabilitySet::SYS_PTRACE | CapabilitySet::SYS_NICE
            }
            Self::Exact => uprobe::required(),
        }
    }
}

/// Confines the calling thread, for good, and all threads that it starts from now on. Where the
/// kernel has no filters (qemu's user mode, an old configuration) [`sandbox`] tells.
///
/// # Errors
/// When the kernel refuses to take capabilities away, which it does not.
pub fn confine(role: Role) -> Result<(), ConfineError> {
    give_up(role)?;
    rustix::thread::set_no_new_privs(true).map_err(|error| ConfineError::Gain(error.into()))?;
    let filtered = match calls::load(role) {
        Ok(()) => Ok(()),
        Err(FilterError::Refused(reason)) => Err(reason),
        Err(error) => return Err(ConfineError::Filter(error)),
    };
    let _ = FILTERED.set(filtered);
    Ok(())
}

/// Gives up the calling thread's capabilities alone.
///
/// # Errors
/// When the kernel refuses, which it does not for a thread that gives up what it has.
pub fn give_up(role: Role) -> Result<(), DropError> {
    capabilities::keep(role.capabilities())
}

/// What is in force in this process.
#[must_use]
pub fn sandbox() -> Sandbox {
    match FILTERED.get() {
        None => Sandbox::Never,
        Some(Ok(())) => Sandbox::Filtered,
        Some(Err(reason)) => Sandbox::Unfiltered(reason),
    }
}

/// Starts a thread that is confined before it does anything else; returns when it is.
///
/// # Errors
/// There can be no more threads, or it cannot be confined.
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

/// Starts a thread of a source, confined to its task.
///
/// # Errors
/// As [`spawn`].
pub fn spawn_source(
    task: Task,
    thread: Builder,
    work: Box<dyn FnOnce() + Send>,
) -> io::Result<JoinHandle<()>> {
    let role = match task {
        Task::SharedMemory => Role::shared_memory(),
        Task::Reattach => Role::reattach(),
        Task::Probes => Role::Exact,
    };
    spawn(role, thread, work).map_err(|error| match error {
        SpawnError::Thread(error) => error,
        error => io::Error::other(error),
    })
}
