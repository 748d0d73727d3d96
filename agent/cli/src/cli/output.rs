//! Standard output that is passed on line by line, also in a pipe, and that ends without a word
//! when its reader has gone; and what goes to standard error bare.

use std::io::{self, Write as _};

/// A line for stderr as it is, as the original prints its errors; the exit code is 1.
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

    /// Writes and passes on what are whole lines, or everything where it ends with none.
    ///
    /// # Errors
    /// The reader has gone, or the disk is full.
    pub(crate) fn write(&mut self, text: &str) -> io::Result<()> {
        self.write_bytes(text.as_bytes())
    }

    /// As [`Self::write`].
    ///
    /// # Errors
    /// As [`Self::write`].
    pub(crate) fn write_bytes(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut stdout = self.stdout.lock();
        stdout.write_all(bytes)?;
        stdout.flush()
    }
}

/// The reader of standard output has gone: there is no output left to write.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        let cause = cause.downcast_ref::<io::Error>();
        cause.is_some_and(|cause| cause.kind() == io::ErrorKind::BrokenPipe)
    })
}
