//! Wakes a thread that waits for packets: a descriptor that is readable after [`Bell::ring`] until
//! [`Bell::silence`]. It signals that something waits, not what.

use std::io::{self, Read as _, Write as _};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;

/// A bell that any thread may ring or wait for.
#[derive(Debug)]
pub struct Bell {
    ringer: UnixStream,
    listener: UnixStream,
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
        Ok(Self { ringer, listener })
    }

    /// Returns a descriptor that is readable while the bell rings.
    #[must_use]
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }

    /// Rings. If its buffer is full, it rings already.
    pub fn ring(&self) {
        let _ = (&self.ringer).write(&[1]);
    }

    /// Silences the bell after at most 64 rings; after more it keeps ringing.
    pub fn silence(&self) {
        let _ = (&self.listener).read(&mut [0; 64]);
    }
}
