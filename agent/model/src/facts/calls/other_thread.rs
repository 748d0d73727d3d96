//! Threads that make calls late: they run instead, hold a lock, or stop a process.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// Another thread.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct OtherThread {
    /// Time for which it ran instead.
    pub duration: Duration,
    /// Thread id; 0 = the CPU was idle.
    pub thread: u32,
    /// Its process.
    pub process: u32,
    /// Name of the thread.
    pub name: Arc<str>,
    /// First digits of its container's id, else its systemd unit, else the last part of its control
    /// group's path; `None` for the root group, or if the path is not found.
    pub unit: Option<Arc<str>>,
    /// Its priority when it last left the CPU, if known.
    pub priority: Option<Priority>,
}

/// The priority that the scheduler uses for a thread (sched(7)).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Priority {
    /// `SCHED_DEADLINE`.
    Deadline,
    /// `SCHED_FIFO` or `SCHED_RR`, from 1 to 99, or a thread that holds a lock for such a thread.
    RealTime(u8),
    /// A nice value, from -20 to 19.
    Nice(i8),
}

/// A thread by name, where its id does not matter: it made calls late repeatedly.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ThreadLabel {
    /// Name of the thread.
    pub name: Arc<str>,
    /// As in [`OtherThread`].
    pub unit: Option<Arc<str>>,
}

impl OtherThread {
    /// Returns the thread without its ids.
    #[must_use]
    pub fn label(&self) -> ThreadLabel {
        ThreadLabel {
            name: Arc::clone(&self.name),
            unit: self.unit.clone(),
        }
    }
}

/// The name, with the process, the unit, and a priority other than the usual one.
impl fmt::Display for OtherThread {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} ({}", self.name, self.process)?;
        if let Some(unit) = &self.unit {
            write!(out, ", {unit}")?;
        }
        if let Some(priority) = self.priority.filter(|it| *it != Priority::Nice(0)) {
            write!(out, ", {priority}")?;
        }
        out.write_str(")")
    }
}

impl fmt::Display for ThreadLabel {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.unit {
            Some(unit) => write!(out, "{} ({unit})", self.name),
            None => out.write_str(&self.name),
        }
    }
}

impl Priority {
    /// Returns the priority for `task_struct.prio` of the kernel; `None` for other numbers.
    #[must_use]
    pub fn of_kernel(number: i64) -> Option<Self> {
        match number {
            -1 => Some(Self::Deadline),
            0..=98 => u8::try_from(99 - number).ok().map(Self::RealTime),
            100..=139 => i8::try_from(number - 120).ok().map(Self::Nice),
            _ => None,
        }
    }
}

impl fmt::Display for Priority {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Deadline => out.write_str("deadline"),
            Self::RealTime(priority) => write!(out, "real-time {priority}"),
            Self::Nice(value) => write!(out, "nice {value}"),
        }
    }
}
