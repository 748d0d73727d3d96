//! Threads of sources, and the privileges that each needs.

use std::io;
use std::thread::{Builder, JoinHandle};

/// Task of a thread, which determines the privileges that it keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Task {
    /// Reads shared memory of other processes, with priority over ordinary threads.
    SharedMemory,
    /// Attaches the host hook to a recreated control group.
    Reattach,
    /// Attaches uprobes to libraries.
    Probes,
    /// Attaches uprobes inside processes, and reads their tables.
    Inside,
}

/// Starts a thread with only the privileges of its task, and returns after the others are dropped.
///
/// Fails if the system has no thread left, or if the thread cannot be confined.
pub type Spawn = fn(Task, Builder, Box<dyn FnOnce() + Send>) -> io::Result<JoinHandle<()>>;
