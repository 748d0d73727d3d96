//! Standard output, flushed after each line also in a pipe. If its reader closes it, the program
//! ends silently.

use std::io::{self, Write as _};

/// An error that is printed on stderr without a prefix, as ros2cli prints its errors. The exit code
/// is 1. If a value's parser returns this error, clap prints it with the argument.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct UserError(pub(crate) String);

/// Standard output.
#[derive(Debug)]
pub(crate) struct Output {
    stdout: io::Stdout,
}

impl Output {
    pub(crate) fn new() -> Self {
        Self {
            stdout: io::stdout(),
        }
    }

    /// Writes text and flushes whole lines; text without a line end is flushed entirely.
    ///
    /// # Errors
    ///
    /// Fails if the reader has closed the output, or if the disk is full.
    pub(crate) fn write(&mut self, text: &str) -> io::Result<()> {
        self.write_bytes(text.as_bytes())
    }

    /// Writes bytes as [`Self::write`] writes text.
    ///
    /// # Errors
    /// Fails as [`Self::write`] does.
    pub(crate) fn write_bytes(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut stdout = self.stdout.lock();
        stdout.write_all(bytes)?;
        stdout.flush()
    }
}

/// Returns whether the error is a closed standard output.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        let cause = cause.downcast_ref::<io::Error>();
        cause.is_some_and(|cause| cause.kind() == io::ErrorKind::BrokenPipe)
    })
}
