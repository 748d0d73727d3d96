//! Writes log lines to standard error without blocking. If standard error accepts no more, lines
//! are dropped and counted. A hanging journal, a stopped terminal or a full disk must not stop the
//! capture.
//!
//! The descriptor may be shared with other processes, so it stays in blocking mode. It is polled
//! before each write of at most the size that a pipe accepts atomically.

use std::io::{self, Write};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// Bytes that a ready pipe accepts without blocking (`PIPE_BUF`).
const PIPE_BUF: usize = 4096;
/// Maximum time to wait for a reader that has kept up so far.
const READER_TIMEOUT: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 100_000_000,
};
const NO_WAIT: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 0,
};

/// Writer of lines.
#[derive(Debug)]
pub(super) struct Lines<W> {
    target: W,
    lost: Arc<AtomicU64>,
    /// Dropped lines that are not reported yet.
    unreported: u64,
    /// Whether the last line was dropped; the next one then does not wait.
    is_blocked: bool,
    /// Whether a line was written in part.
    is_truncated: bool,
}

impl<W: Write + AsFd> Lines<W> {
    pub(super) const fn new(target: W, lost: Arc<AtomicU64>) -> Self {
        Self {
            target,
            lost,
            unreported: 0,
            is_blocked: false,
            is_truncated: false,
        }
    }

    /// Writes a line as far as possible without blocking.
    fn line(&mut self, line: &[u8]) -> io::Result<()> {
        for piece in line.chunks(PIPE_BUF) {
            self.wait_writable()?;
            self.target.write_all(piece)?;
            self.is_truncated = !piece.ends_with(b"\n");
        }
        Ok(())
    }

    /// Ends a truncated line, and reports dropped lines before the next one.
    fn finish_truncated(&mut self) -> io::Result<()> {
        if self.unreported == 0 {
            return Ok(());
        }
        let begin = if self.is_truncated { "\n" } else { "" };
        let text = format!(
            "{begin}{} lines of the log were lost here\n",
            self.unreported
        );
        self.line(text.as_bytes())?;
        self.unreported = 0;
        Ok(())
    }

    fn wait_writable(&self) -> io::Result<()> {
        let timeout = if self.is_blocked {
            NO_WAIT
        } else {
            READER_TIMEOUT
        };
        let mut target = [PollFd::new(&self.target, PollFlags::OUT)];
        // A descriptor after a hangup is ready, too; the write then fails.
        match poll(&mut target, Some(&timeout)) {
            Ok(0) => Err(io::ErrorKind::WouldBlock.into()),
            Ok(_) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

impl<W: Write + AsFd> Write for Lines<W> {
    /// Writes a line. A dropped line is not an error.
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let written = self.finish_truncated().and_then(|()| self.line(line));
        self.is_blocked = written.is_err();
        if self.is_blocked {
            self.unreported += 1;
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{File, OpenOptions};
    use std::io::{PipeReader, Read as _};
    use std::time::{Duration, Instant};

    use super::*;

    fn lines<W: Write + AsFd>(target: W) -> (Lines<W>, Arc<AtomicU64>) {
        let lost = Arc::default();
        (Lines::new(target, Arc::clone(&lost)), lost)
    }

    fn read(reader: &mut PipeReader, bytes: usize) -> String {
        let mut text = vec![0; bytes];
        reader.read_exact(&mut text).unwrap();
        String::from_utf8(text).unwrap()
    }

    #[test]
    fn a_full_pipe_does_not_block_and_its_lost_lines_are_reported() {
        let (mut reader, writer) = io::pipe().unwrap();
        let (mut lines, lost) = lines(writer);
        let line = [&[b'x'; 999][..], b"\n"].concat();
        let began = Instant::now();
        for _ in 0..1000 {
            assert_eq!(lines.write(&line).unwrap(), line.len());
        }
        // Only the first line waits.
        assert!(
            began.elapsed() < Duration::from_secs(30),
            "{:?}",
            began.elapsed()
        );
        let missed = lost.load(Ordering::Relaxed);
        assert!((900..1000).contains(&missed), "{missed}");
        let taken = 1000 - usize::try_from(missed).unwrap();
        let text = read(&mut reader, taken * line.len());
        assert!(text.lines().all(|line| line.len() == 999));
        lines.write_all(b"here again\n").unwrap();
        drop(lines);
        let mut rest = String::new();
        reader.read_to_string(&mut rest).unwrap();
        assert_eq!(
            rest,
            format!("{missed} lines of the log were lost here\nhere again\n")
        );
        assert_eq!(lost.load(Ordering::Relaxed), missed);
    }

    #[test]
    fn a_truncated_line_is_ended_before_the_next_one() {
        let (mut reader, writer) = io::pipe().unwrap();
        let (mut lines, lost) = lines(writer);
        lines.write_all(&[b'x'; 1 << 20]).unwrap();
        assert_eq!(lost.load(Ordering::Relaxed), 1);
        let mut part = vec![0; 1 << 20];
        let length = reader.read(&mut part).unwrap();
        assert!(part[..length].iter().all(|byte| *byte == b'x'));
        lines.write_all(b"next\n").unwrap();
        drop(lines);
        let mut rest = String::new();
        reader.read_to_string(&mut rest).unwrap();
        assert_eq!(rest, "\n1 lines of the log were lost here\nnext\n");
    }

    #[test]
    fn lines_to_a_closed_pipe_or_a_full_disk_are_counted_as_lost() {
        let (reader, writer) = io::pipe().unwrap();
        drop(reader);
        let (mut lines, lost) = lines(writer);
        lines.write_all(b"to nobody\n").unwrap();
        assert_eq!(lost.load(Ordering::Relaxed), 1);

        let full: File = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let (mut lines, lost) = self::lines(full);
        lines.write_all(b"too much\n").unwrap();
        lines.write_all(b"too much\n").unwrap();
        assert_eq!(lost.load(Ordering::Relaxed), 2);
    }
}
