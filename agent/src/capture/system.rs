//! The system calls that live capture needs beside its sockets: waiting, the clocks, free memory.

use std::io;
use std::os::fd::{AsRawFd as _, BorrowedFd};
use std::time::Duration;

use libc::c_int;
use ros2probe_wire::Timestamp;

/// Clock readings that are tried.
const READINGS: usize = 8;
/// Nanoseconds between two clocks that are read at one moment.
const CLOSE: u64 = 5_000;

/// Waits until one of `descriptors` is readable or in error, a signal comes, or the time is over.
/// Which of them it was, the first if several.
///
/// # Errors
/// `poll` itself fails.
pub fn wait(descriptors: &[BorrowedFd<'_>], timeout: Duration) -> io::Result<Option<usize>> {
    let mut poll: Vec<_> = descriptors
        .iter()
        .map(|descriptor| libc::pollfd {
            fd: descriptor.as_raw_fd(),
            events: libc::POLLIN,
            revents: 0,
        })
        .collect();
    let milliseconds = c_int::try_from(timeout.as_millis()).unwrap_or(c_int::MAX);
    let count = libc::nfds_t::try_from(poll.len()).unwrap_or(0);
    // SAFETY: `poll` holds `count` entries and outlives the call.
    let ready = unsafe { libc::poll(poll.as_mut_ptr(), count, milliseconds) };
    if ready < 0 {
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
        return Ok(None);
    }
    Ok(poll.iter().position(|descriptor| descriptor.revents != 0))
}

/// Gives free memory back to the system. Reading the kernel's types takes some 15 MB that nobody needs
/// afterwards, and the allocator would keep them for as long as the agent lives.
pub fn give_back_memory() {
    #[cfg(target_env = "gnu")]
    // SAFETY: has no preconditions and touches free memory only.
    unsafe {
        libc::malloc_trim(0);
    }
}

/// The kernel filter's clock beside the calendar's, read at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Clocks {
    /// CLOCK_REALTIME.
    pub now: Timestamp,
    /// CLOCK_MONOTONIC in nanoseconds.
    pub monotonic: u64,
}

impl Clocks {
    /// Both clocks now. A thread that loses its CPU between the two would set all captured times
    /// off by as long, so the closest of a few readings counts.
    #[must_use]
    pub fn read() -> Self {
        let mut best = Self::read_once();
        for _ in 1..READINGS {
            if best.1 <= CLOSE {
                break;
            }
            let again = Self::read_once();
            if again.1 < best.1 {
                best = again;
            }
        }
        best.0
    }

    /// One reading, and within how many nanoseconds it was taken.
    fn read_once() -> (Self, u64) {
        let before = nanoseconds(libc::CLOCK_MONOTONIC);
        let now = Timestamp(nanoseconds(libc::CLOCK_REALTIME));
        let after = nanoseconds(libc::CLOCK_MONOTONIC);
        let within = after.saturating_sub(before);
        let monotonic = before + within / 2;
        (Self { now, monotonic }, within)
    }

    /// A monotonic time as a calendar time. Wrong by the step if the calendar clock was set between.
    #[must_use]
    pub const fn calendar(&self, monotonic: u64) -> Timestamp {
        let ago = self.monotonic.wrapping_sub(monotonic);
        Timestamp(self.now.0.wrapping_sub(ago))
    }

    /// A calendar time of the past as a monotonic time; one of the future is now.
    #[must_use]
    pub const fn monotonic_of(&self, calendar: Timestamp) -> u64 {
        let ago = self.now.0.saturating_sub(calendar.0);
        self.monotonic.saturating_sub(ago)
    }
}

/// CPU time that the calling thread has used, in nanoseconds.
#[must_use]
pub fn thread_cpu() -> u64 {
    nanoseconds(libc::CLOCK_THREAD_CPUTIME_ID)
}

fn nanoseconds(clock: libc::clockid_t) -> u64 {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is ours; all three clocks always exist.
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
    fn waiting_ends_with_the_time_and_with_data() {
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
    fn a_monotonic_time_a_second_ago_is_a_calendar_time_a_second_ago() {
        let clocks = Clocks::read();
        let then = clocks.calendar(clocks.monotonic - 1_000_000_000);
        assert_eq!(clocks.now.nanoseconds_since(then), 1_000_000_000);
    }
}
