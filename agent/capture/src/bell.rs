//! Wakes a thread that waits for packets: a descriptor that is readable after [`Bell::ring`] until
//! [`Bell::drain`]. It signals that an event occurred, not which one.
//!
//! It uses `read` and `write`, which the system call filter of each thread allows. The standard
//! library reads sockets by `recvfrom`, which most filters refuse.

use std::io;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};

/// Maximum number of rings that one call of [`Bell::drain`] takes.
const MAX_RINGS: usize = 64;

/// A bell that any thread may ring or wait for.
#[derive(Debug)]
pub struct Bell {
    ringer: UnixStream,
    listener: UnixStream,
    /// Set after each ring is written, so that a bell that rings is never taken for a silent one.
    rung: AtomicBool,
}

impl Bell {
    /// Creates a silent bell.
    ///
    /// # Errors
    /// Fails if no more descriptors are available.
    pub fn new() -> io::Result<Self> {
        let (ringer, listener) = UnixStream::pair()?;
        ringer.set_nonblocking(true)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            ringer,
            listener,
            rung: AtomicBool::new(false),
        })
    }

    /// Returns a descriptor that is readable while the bell rings.
    #[must_use]
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }

    /// Rings the bell. If its buffer is full, it rings already.
    pub fn ring(&self) {
        let _ = rustix::io::write(&self.ringer, &[1]);
        self.rung.store(true, Ordering::Release);
    }

    /// Silences the bell if it rang at most 64 times; otherwise it keeps ringing.
    pub fn drain(&self) {
        if !self.rung.swap(false, Ordering::AcqRel) {
            return;
        }
        let read = rustix::io::read(&self.listener, &mut [0; MAX_RINGS]);
        if read.is_ok_and(|rings| rings == MAX_RINGS) {
            self.rung.store(true, Ordering::Release);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::system::wait;
    use std::time::Duration;

    #[test]
    fn a_bell_with_many_rings_is_silent_after_several_calls_and_can_ring_again() {
        let bell = Bell::new().unwrap();
        let rings = || wait(&[bell.descriptor()], Duration::ZERO).unwrap() == Some(0);
        bell.drain();
        assert!(!rings());
        for _ in 0..3 * MAX_RINGS {
            bell.ring();
        }
        for _ in 0..3 {
            assert!(rings());
            bell.drain();
        }
        assert!(!rings());
        bell.drain();
        bell.ring();
        assert!(rings());
    }
}
