//! Threads of sources, and the privileges that each needs while it runs.

use std::io;
use std::thread::{Builder, JoinHandle};

/// Task of a thread, which decides what privileges it keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Task {
    /// Reads shared memory of other processes, before ordinary threads run.
    SharedMemory,
    /// Attaches the host hook to a control group that is made anew.
    Reattach,
    /// Attaches uprobes to libraries.
    Probes,
}

/// Starts a thread that holds no more than what its task needs, and returns once that is so.
///
/// Fails when the system has no thread left, or when the thread cannot be confined.
pub type Spawn = fn(Task, Builder, Box<dyn FnOnce() + Send>) -> io::Result<JoinHandle<()>>;
