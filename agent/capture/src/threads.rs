//! Threads of sources, and the privileges that each needs.

use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use crate::system::monotonic;

/// Time without progress after which a thread counts as stalled. Readiness then changes within 5 s.
const STALLED_AFTER: Duration = Duration::from_secs(4);

/// Task of a thread, which determines the privileges that it keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Task {
    /// Reads shared memory of other processes, with priority over ordinary threads.
    SharedMemory,
    /// Attaches the host hook to a recreated control group.
    Reattach,
    /// Attaches programs to interfaces that appear.
    Tcx,
    /// Attaches uprobes to libraries.
    Probes,
    /// Attaches uprobes inside processes, and reads their tables.
    Inside,
}

/// Starts a thread with only the privileges of its task, and returns when it has dropped the
/// others.
///
/// Fails if the thread cannot be spawned or confined.
pub type Spawn = fn(Task, Builder, Box<dyn FnOnce() + Send>) -> io::Result<JoinHandle<()>>;

/// Progress of a thread, for other threads that watch it. A thread is stalled if one step takes too
/// long because a file or a system call does not return. A thread that waits for work is not
/// stalled.
#[derive(Debug, Default)]
pub struct Progress {
    /// Start of the current step, in nanoseconds of the monotonic clock; 0 = the thread waits, or
    /// has not started.
    step: AtomicU64,
}

impl Progress {
    /// Records that the thread begins its next step.
    pub fn step(&self) {
        self.step.store(monotonic().max(1), Ordering::Release);
    }

    /// Records that the thread waits for work, or ends.
    pub fn set_idle(&self) {
        self.step.store(0, Ordering::Release);
    }

    /// Returns how long the current step has taken if the thread is stalled; otherwise `None`.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.stalled_at(monotonic())
    }

    fn stalled_at(&self, now: u64) -> Option<Duration> {
        let step = self.step.load(Ordering::Acquire);
        let long = Duration::from_nanos(now.saturating_sub(step));
        (step != 0 && long > STALLED_AFTER).then_some(long)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_is_stalled_in_a_long_step_and_not_while_it_waits() {
        let progress = Progress::default();
        let later = |seconds: u64| progress.step.load(Ordering::Acquire) + seconds * 1_000_000_000;
        assert_eq!(progress.stalled_at(later(3600)), None, "not started");
        progress.step();
        assert_eq!(progress.stalled_at(later(3)), None);
        let long = progress.stalled_at(later(5)).unwrap();
        assert!(long > STALLED_AFTER && long < Duration::from_secs(6));
        progress.set_idle();
        assert_eq!(progress.stalled_at(later(3600)), None, "waits");
        progress.step();
        assert_eq!(progress.stalled(), None, "the next step");
    }
}
