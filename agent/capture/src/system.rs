//! System calls of live capture besides its sockets: waiting, clocks, free memory.

use std::ffi::CString;
use std::fs::File;
use std::io::{self, Read as _};
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd, FromRawFd as _, OwnedFd};
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::ptr;
use std::time::Duration;

use ros2probe_wire::Timestamp;
use rustix::process::{DumpableBehavior, set_dumpable_behavior};

/// Maximum number of attempts to read the clocks.
const MAX_READINGS: usize = 8;
/// Maximum time between two clock readings that count as simultaneous, in nanoseconds.
const MAX_READING_NANOSECONDS: u64 = 5_000;

/// Waits until one of `descriptors` is readable or in error, a signal arrives, or the timeout
/// expires. Returns the index of the first such descriptor.
///
/// # Errors
/// Fails if `ppoll` itself fails.
pub fn wait(descriptors: &[BorrowedFd<'_>], timeout: Duration) -> io::Result<Option<usize>> {
    let mut poll: Vec<_> = descriptors
        .iter()
        .map(|descriptor| libc::pollfd {
            fd: descriptor.as_raw_fd(),
            events: libc::POLLIN,
            revents: 0,
        })
        .collect();
    let timeout = libc::timespec {
        tv_sec: timeout.as_secs().try_into().unwrap_or(i64::MAX),
        tv_nsec: timeout.subsec_nanos().into(),
    };
    let count = libc::nfds_t::try_from(poll.len()).unwrap_or(0);
    // SAFETY: `poll` holds `count` entries. `poll` and `timeout` outlive the call; no signal mask
    // is passed.
    let ready = unsafe { libc::ppoll(poll.as_mut_ptr(), count, &raw const timeout, ptr::null()) };
    if ready < 0 {
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
        return Ok(None);
    }
    Ok(poll.iter().position(|descriptor| descriptor.revents != 0))
}

/// Reports files created in some directories. It is passive: processes that create files cannot
/// detect it.
#[derive(Debug)]
pub struct DirectoryWatch {
    events: File,
}

impl DirectoryWatch {
    /// Creates a watch without directories.
    ///
    /// # Errors
    /// Fails if the kernel's limit of watches per user is reached.
    pub fn new() -> io::Result<Self> {
        // SAFETY: the call has no preconditions.
        let descriptor = unsafe { libc::inotify_init1(libc::IN_CLOEXEC | libc::IN_NONBLOCK) };
        if descriptor < 0 {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: the descriptor is new and has no other owner.
        let descriptor = unsafe { OwnedFd::from_raw_fd(descriptor) };
        Ok(Self {
            events: descriptor.into(),
        })
    }

    /// Adds a directory. Returns `false` if it does not exist or cannot be watched.
    pub fn add(&mut self, directory: &Path) -> bool {
        self.add_with(directory, libc::IN_CREATE)
    }

    /// Adds a directory whose removed files and directories are reported too.
    pub fn add_with_removals(&mut self, directory: &Path) -> bool {
        let renames = libc::IN_MOVED_FROM | libc::IN_MOVED_TO;
        self.add_with(directory, libc::IN_CREATE | libc::IN_DELETE | renames)
    }

    fn add_with(&mut self, directory: &Path, events: u32) -> bool {
        let Ok(path) = CString::new(directory.as_os_str().as_bytes()) else {
            return false;
        };
        let (descriptor, mask) = (self.events.as_raw_fd(), events | libc::IN_ONLYDIR);
        // SAFETY: `path` ends in a zero and outlives the call.
        unsafe { libc::inotify_add_watch(descriptor, path.as_ptr(), mask) >= 0 }
    }

    /// Takes the names reported since the last call. Returns whether `matters` accepts one of them.
    pub fn created(&mut self, matters: impl Fn(&str) -> bool) -> bool {
        let (mut any, mut events) = (false, [0; 4096]);
        while let Ok(read @ 1..) = self.events.read(&mut events) {
            any |= names(events.get(..read).unwrap_or_default()).any(&matters);
        }
        any
    }
}

impl AsFd for DirectoryWatch {
    /// Returns a descriptor that is readable when a watched directory has changed.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.events.as_fd()
    }
}

/// Returns the names in inotify(7) events. An event has 16 bytes, of which the last four are the
/// length of the name that follows. The name is padded with zeros.
fn names(mut events: &[u8]) -> impl Iterator<Item = &str> {
    std::iter::from_fn(move || {
        let (head, rest) = events.split_first_chunk::<16>()?;
        let length = u32::from_ne_bytes(*head.last_chunk()?);
        let (name, rest) = rest.split_at_checked(usize::try_from(length).ok()?)?;
        events = rest;
        let name = name.split(|byte| *byte == 0).next()?;
        Some(std::str::from_utf8(name).unwrap_or_default())
    })
}

/// Allows threads of this process to call [`run_first`] after privileges are dropped. Returns
/// whether the limit permits it: this process or the service manager has set the limit.
pub fn allow_running_first() -> bool {
    let mut limit = libc::rlimit {
        rlim_cur: 1,
        rlim_max: 1,
    };
    // SAFETY: `limit` outlives the call.
    if unsafe { libc::setrlimit(libc::RLIMIT_RTPRIO, &raw const limit) } == 0 {
        return true;
    }
    // SAFETY: `limit` is a live local and outlives the call.
    let result = unsafe { libc::getrlimit(libc::RLIMIT_RTPRIO, &raw mut limit) };
    result == 0 && limit.rlim_cur > 0
}

/// Sets or clears the lowest real-time priority of this thread, which lets it run before ordinary
/// threads when it wakes.
///
/// # Errors
/// Fails if the thread lacks the permission.
pub fn run_first(first: bool) -> io::Result<()> {
    let (policy, sched_priority) = match first {
        true => (libc::SCHED_FIFO, 1),
        false => (libc::SCHED_OTHER, 0),
    };
    // SAFETY: the struct has only integers, for which 0 is valid; musl has more of them than glibc.
    let mut parameter: libc::sched_param = unsafe { std::mem::zeroed() };
    parameter.sched_priority = sched_priority;
    // SAFETY: the call has no preconditions.
    let this_thread = unsafe { libc::pthread_self() };
    // SAFETY: the thread is the calling one; `parameter` outlives the call.
    match unsafe { libc::pthread_setschedparam(this_thread, policy, &raw const parameter) } {
        0 => Ok(()),
        error => Err(io::Error::from_raw_os_error(error)),
    }
}

/// Makes the memory of this process unreadable for processes without `CAP_SYS_PTRACE`, even of the
/// same user, and prevents core dumps. A later change of the user undoes this setting.
///
/// # Errors
/// Fails if the system call is refused.
pub fn hide_memory() -> io::Result<()> {
    Ok(set_dumpable_behavior(DumpableBehavior::NotDumpable)?)
}

/// Returns free memory to the system. Reading the kernel's types takes some 15 MB, which glibc's
/// allocator would keep while the agent runs. The allocator of musl returns large pieces by itself.
pub fn give_back_memory() {
    #[cfg(target_env = "gnu")]
    // SAFETY: the call has no preconditions and touches free memory only.
    unsafe {
        libc::malloc_trim(0);
    }
}

/// Maximum age of packets when they are read, unless this process was delayed.
const RECENT_NANOSECONDS: i64 = 1_000_000_000;

/// The kernel filter's clock and the wall clock, read at the same time.
#[derive(Clone, Copy, Debug)]
pub struct Clocks {
    /// CLOCK_REALTIME.
    pub now: Timestamp,
    /// CLOCK_MONOTONIC in nanoseconds.
    pub monotonic: u64,
    /// Nanoseconds by which the wall clock was recently set forward.
    pub step: i64,
}

impl Clocks {
    /// Reads both clocks. A thread that loses its CPU between the two readings would shift all
    /// capture times, so the closest of several readings counts.
    #[must_use]
    pub fn read() -> Self {
        let mut best = Self::read_once();
        for _ in 1..MAX_READINGS {
            if best.1 <= MAX_READING_NANOSECONDS {
                break;
            }
            let again = Self::read_once();
            if again.1 < best.1 {
                best = again;
            }
        }
        best.0
    }

    /// Reads both clocks once, and returns the nanoseconds between the readings.
    fn read_once() -> (Self, u64) {
        let before = nanoseconds(libc::CLOCK_MONOTONIC);
        let now = Timestamp(nanoseconds(libc::CLOCK_REALTIME));
        let after = nanoseconds(libc::CLOCK_MONOTONIC);
        let within = after.saturating_sub(before);
        let monotonic = before + within / 2;
        let clocks = Self {
            now,
            monotonic,
            step: 0,
        };
        (clocks, within)
    }

    /// Converts a monotonic time to a wall-clock time. The result is wrong by the step if the wall
    /// clock was set in between.
    #[must_use]
    pub const fn wall_time_of(&self, monotonic: u64) -> Timestamp {
        let ago = self.monotonic.wrapping_sub(monotonic);
        Timestamp(self.now.0.wrapping_sub(ago))
    }

    /// Returns the wall-clock time of an event with the timestamp `wall_time`. Just after the clock
    /// was set, a timestamp from before the step is corrected. A timestamp that is not recent
    /// becomes now.
    #[must_use]
    pub const fn stamped(&self, wall_time: Timestamp) -> Timestamp {
        if self.step == 0 || self.is_recent(wall_time) {
            return wall_time;
        }
        let moved = Timestamp(wall_time.0.saturating_add_signed(self.step));
        if self.is_recent(moved) {
            moved
        } else {
            self.now
        }
    }

    const fn is_recent(&self, wall_time: Timestamp) -> bool {
        let age = self.now.nanoseconds_since(wall_time);
        age > -RECENT_NANOSECONDS / 10 && age < RECENT_NANOSECONDS
    }

    /// Converts a past wall-clock time to a monotonic time; a future one becomes now.
    #[must_use]
    pub const fn monotonic_of(&self, wall_time: Timestamp) -> u64 {
        let ago = self.now.0.saturating_sub(wall_time.0);
        self.monotonic.saturating_sub(ago)
    }
}

/// Returns CLOCK_MONOTONIC_RAW minus CLOCK_MONOTONIC in nanoseconds, modulo 2^64. The closest of
/// several readings counts.
#[must_use]
pub fn raw_difference() -> u64 {
    let read = || {
        let before = nanoseconds(libc::CLOCK_MONOTONIC);
        let raw = nanoseconds(libc::CLOCK_MONOTONIC_RAW);
        let within = nanoseconds(libc::CLOCK_MONOTONIC).saturating_sub(before);
        (within, raw.wrapping_sub(before + within / 2))
    };
    let readings = std::iter::repeat_with(read).take(MAX_READINGS);
    readings.min().unwrap_or_default().1
}

/// Returns nanoseconds of the monotonic clock.
#[must_use]
pub fn monotonic() -> u64 {
    nanoseconds(libc::CLOCK_MONOTONIC)
}

/// Returns nanoseconds since the Unix epoch.
#[must_use]
pub fn wall_clock_nanoseconds() -> u64 {
    nanoseconds(libc::CLOCK_REALTIME)
}

/// Returns the CPU time of the calling thread, in nanoseconds.
#[must_use]
pub fn thread_cpu() -> u64 {
    nanoseconds(libc::CLOCK_THREAD_CPUTIME_ID)
}

/// The kernel's state of its clock, `adjtimex(2)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockState {
    /// Whether a program keeps the clock synchronised.
    pub synchronised: bool,
    /// Estimated error in microseconds.
    pub estimated_error: i64,
    /// Maximum error in microseconds.
    pub maximum_error: i64,
}

/// Reads the state of the kernel's clock without changing it.
///
/// # Errors
/// Fails if the kernel refuses the call.
pub fn clock_state() -> io::Result<ClockState> {
    // SAFETY: a `timex` is plain numbers, for which zero is a value; zero modes change nothing.
    let mut state: libc::timex = unsafe { std::mem::zeroed() };
    // SAFETY: `state` is a live local and outlives the call.
    let result = unsafe { libc::adjtimex(&raw mut state) };
    if result < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(ClockState {
        synchronised: result != libc::TIME_ERROR && state.status & libc::STA_UNSYNC == 0,
        estimated_error: state.esterror,
        maximum_error: state.maxerror,
    })
}

fn nanoseconds(clock: libc::clockid_t) -> u64 {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is a live local; each clock that callers pass always exists.
    unsafe { libc::clock_gettime(clock, &raw mut time) };
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    let nanoseconds = u64::try_from(time.tv_nsec).unwrap_or(0);
    seconds * 1_000_000_000 + nanoseconds
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsFd as _;
    use std::os::unix::net::UnixStream;
    use std::time::Instant;

    use super::*;

    #[test]
    fn waiting_ends_at_the_timeout_or_when_data_arrives() {
        let (mut one, two) = UnixStream::pair().unwrap();
        let descriptors = [one.as_fd(), two.as_fd()];
        let waited = wait(&descriptors, Duration::from_millis(1)).unwrap();
        assert_eq!(waited, None);
        io::Write::write_all(&mut one, b"x").unwrap();
        let start = Instant::now();
        let descriptors = [one.as_fd(), two.as_fd()];
        let waited = wait(&descriptors, Duration::from_secs(60)).unwrap();
        assert_eq!(waited, Some(1));
        assert!(start.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn a_created_file_ends_the_wait_and_is_reported_once() {
        let directory = tempfile::tempdir().unwrap();
        let mut watch = DirectoryWatch::new().unwrap();
        let is_created = |watch: &mut DirectoryWatch, timeout, name: &str| {
            wait(&[watch.as_fd()], timeout).unwrap() == Some(0)
                && watch.created(|created| name.is_empty() || created == name)
        };
        assert!(watch.add(directory.path()));
        assert!(!watch.add(Path::new("/nowhere")));
        let short = Duration::from_micros(100);
        assert!(!is_created(&mut watch, short, ""));
        for name in ["one", "two"] {
            std::fs::write(directory.path().join(name), "").unwrap();
        }
        assert!(is_created(&mut watch, Duration::from_secs(60), "two"));
        assert!(!is_created(&mut watch, short, ""));
        std::fs::write(directory.path().join("three"), "").unwrap();
        assert!(!is_created(&mut watch, Duration::from_secs(60), "two"));
    }

    #[test]
    fn a_removed_directory_ends_the_wait_if_removals_are_reported() {
        let directory = tempfile::tempdir().unwrap();
        let group = directory.path().join("group");
        std::fs::create_dir(&group).unwrap();
        let mut watch = DirectoryWatch::new().unwrap();
        assert!(watch.add_with_removals(directory.path()));
        std::fs::remove_dir(&group).unwrap();
        let ready = wait(&[watch.as_fd()], Duration::from_secs(60)).unwrap();
        assert!(ready == Some(0) && watch.created(|name| name == "group"));
    }

    #[test]
    fn a_closed_pipe_ends_the_wait() {
        let watch = DirectoryWatch::new().unwrap();
        let (ended, end) = io::pipe().unwrap();
        drop(end);
        let start = Instant::now();
        let ready = wait(&[watch.as_fd(), ended.as_fd()], Duration::from_secs(60));
        assert_eq!(ready.unwrap(), Some(1));
        assert!(start.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn a_monotonic_time_converts_to_the_calendar_time_of_the_same_moment() {
        let clocks = Clocks::read();
        let then = clocks.wall_time_of(clocks.monotonic - 1_000_000_000);
        assert_eq!(clocks.now.nanoseconds_since(then), 1_000_000_000);
    }
}
