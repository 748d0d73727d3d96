//! Wakes a thread that waits for packets: a descriptor that is readable from a ring on until it is
//! silenced. It says that something waits, never what.

use std::io::{self, Read as _, Write as _};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;

/// One bell, rung and heard from any thread.
#[derive(Debug)]
pub struct Bell {
    ringer: UnixStream,
    listener: UnixStream,
}

impl Bell {
    /// A silent one.
    ///
    /// # Errors
    /// There can be no more descriptors.
    pub fn new() -> io::Result<Self> {
        let (ringer, listener) = UnixStream::pair()?;
        ringer.set_nonblocking(true)?;
        listener.set_nonblocking(true)?;
        Ok(Self { ringer, listener })
    }

    /// Readable while it rings.
    #[must_use]
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }

    /// Rings. One that was rung more often than its buffer holds rings already.
    pub fn ring(&self) {
        let _ = (&self.ringer).write(&[1]);
    }

    /// Takes back what it was rung, 64 times at most: after more it rings on.
    pub fn silence(&self) {
        let _ = (&self.listener).read(&mut [0; 64]);
    }
}
