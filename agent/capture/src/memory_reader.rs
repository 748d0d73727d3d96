//! Reads memory of other processes in a process of its own.
//!
//! Memory can lie in a file whose file system never answers. A read of it waits without end, and
//! neither a signal nor the end of its process interrupts the wait. The agent therefore reads no
//! such memory: a child of it forks for each read, and leaves a fork behind that does not answer.

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};

/// Name of the hidden command that runs [`serve`].
pub const COMMAND: &str = "memory-reader";
/// Most bytes of one read.
pub const MAX_READ: u32 = 256 << 10;
/// Time that a read may take.
const PATIENCE: Duration = Duration::from_millis(500);
/// Time in which the child answers.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);
/// Most forks that are left behind. Until one of them ends, nothing more is read.
const MAX_LEFT: usize = 8;
/// Length in an answer that stands for a failure.
const FAILED: u32 = u32::MAX;
/// Process, length and address of a request, in native byte order.
const REQUEST: usize = 16;

/// The child that reads memory.
#[derive(Debug)]
pub struct MemoryReader {
    child: Child,
    /// `None` after it did not answer.
    socket: Option<File>,
}

impl MemoryReader {
    /// Starts the child: this program with [`COMMAND`].
    ///
    /// # Errors
    /// Fails if no process can be started.
    pub fn start() -> io::Result<Self> {
        let (own, other) = UnixStream::pair()?;
        own.set_read_timeout(Some(ANSWERS_WITHIN))?;
        let child = Command::new("/proc/self/exe")
            .arg(COMMAND)
            .stdin(Stdio::from(OwnedFd::from(other)))
            .stdout(Stdio::null())
            .spawn()?;
        Ok(Self {
            child,
            // A file is read with `read`, as the filter of system calls requires.
            socket: Some(File::from(OwnedFd::from(own))),
        })
    }

    /// Returns up to `length` bytes of a process at an address; `None` if they cannot be read, or
    /// not in time. Needs `CAP_SYS_PTRACE` in the child.
    pub fn read(&mut self, process: u32, address: u64, length: u64) -> Option<Vec<u8>> {
        let length = u32::try_from(length).unwrap_or(u32::MAX).min(MAX_READ);
        let asked = self.ask(process, address, length);
        if asked.is_err() {
            self.socket = None;
        }
        asked.ok().flatten()
    }

    fn ask(&mut self, process: u32, address: u64, length: u32) -> io::Result<Option<Vec<u8>>> {
        let socket = self.socket.as_mut().ok_or(io::ErrorKind::NotConnected)?;
        let mut request = [0; REQUEST];
        let (words, long) = request.split_at_mut(8);
        let (one, two) = words.split_at_mut(4);
        one.copy_from_slice(&process.to_ne_bytes());
        two.copy_from_slice(&length.to_ne_bytes());
        long.copy_from_slice(&address.to_ne_bytes());
        socket.write_all(&request)?;
        let mut head = [0; 4];
        socket.read_exact(&mut head)?;
        let length = u32::from_ne_bytes(head);
        if length == FAILED {
            return Ok(None);
        }
        if length > MAX_READ {
            return Err(io::ErrorKind::InvalidData.into());
        }
        let mut bytes = vec![0; usize::try_from(length).unwrap_or_default()];
        socket.read_exact(&mut bytes)?;
        Ok(Some(bytes))
    }
}

impl Drop for MemoryReader {
    fn drop(&mut self) {
        // The child ends when its socket closes. It never waits for memory itself.
        self.socket = None;
        let _ = self.child.wait();
    }
}

/// Answers requests on standard input until it closes. The process must have one thread.
///
/// # Errors
/// Fails if standard input is not the socket of an agent.
pub fn serve() -> io::Result<()> {
    let mut socket = File::from(io::stdin().as_fd().try_clone_to_owned()?);
    let mut left = Vec::new();
    let mut request = [0; REQUEST];
    loop {
        match socket.read_exact(&mut request) {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
            read => read?,
        }
        let (words, long) = request.split_at(8);
        let (one, two) = words.split_at(4);
        let word = |bytes: &[u8]| bytes.try_into().map(u32::from_ne_bytes).unwrap_or_default();
        let address = long.try_into().map(u64::from_ne_bytes).unwrap_or_default();
        left.retain(|fork| matches!(waitpid(Some(*fork), WaitOptions::NOHANG), Ok(None)));
        let read = match left.len() < MAX_LEFT {
            true => read_in_fork((word(one), address, word(two)), &mut left)?,
            false => None,
        };
        let length = read
            .as_ref()
            .map_or(FAILED, |bytes| u32::try_from(bytes.len()).unwrap_or(FAILED));
        socket.write_all(&length.to_ne_bytes())?;
        socket.write_all(&read.unwrap_or_default())?;
    }
}

/// Reads memory in a fork, which is killed and joins `left` if it does not answer in time.
fn read_in_fork(
    (process, address, length): (u32, u64, u32),
    left: &mut Vec<Pid>,
) -> io::Result<Option<Vec<u8>>> {
    let (reader, writer) = pipe_with(PipeFlags::CLOEXEC)?;
    // SAFETY: this process has one thread, so the fork may do whatever it could.
    let fork = unsafe { libc::fork() };
    if fork < 0 {
        return Err(io::Error::last_os_error());
    }
    let Some(fork) = Pid::from_raw(fork) else {
        let bytes = read_memory(process, address, length.min(MAX_READ).into());
        if let Some(bytes) = bytes {
            let _ = File::from(writer).write_all(&[&[1], &bytes[..]].concat());
        }
        // SAFETY: ends the fork at once, without handlers of the process that it is a copy of.
        unsafe { libc::_exit(0) }
    };
    drop(writer);
    let answer = until_closed(File::from(reader), Instant::now() + PATIENCE)?;
    if answer.is_none() {
        let _ = kill_process(fork, Signal::KILL);
    }
    if answer.is_some() {
        let _ = waitpid(Some(fork), WaitOptions::empty());
    } else if matches!(waitpid(Some(fork), WaitOptions::NOHANG), Ok(None)) {
        left.push(fork);
    }
    // The first byte distinguishes an empty answer from a failure.
    let bytes = answer.unwrap_or_default();
    Ok(bytes.split_first().map(|(_, bytes)| bytes.to_vec()))
}

/// Reads a pipe until its writer closes it; `None` if that takes too long.
fn until_closed(mut pipe: File, end: Instant) -> io::Result<Option<Vec<u8>>> {
    let mut answer = Vec::new();
    let mut piece = vec![0; 64 << 10];
    loop {
        let rest = end.saturating_duration_since(Instant::now());
        let rest = Timespec::try_from(rest).unwrap_or_default();
        let ready = poll(&mut [PollFd::new(&pipe, PollFlags::IN)], Some(&rest));
        match ready {
            Ok(0) => return Ok(None),
            Ok(_) => {}
            Err(rustix::io::Errno::INTR) => continue,
            Err(error) => return Err(error.into()),
        }
        let count = pipe.read(&mut piece)?;
        let new = piece.get(..count).unwrap_or_default();
        if new.is_empty() {
            return Ok(Some(answer));
        }
        answer.extend_from_slice(new);
    }
}

/// Copies memory of another process; `None` if it cannot be read. May wait without end, so only a
/// process that can be left behind calls it.
#[must_use]
pub fn read_memory(process: u32, address: u64, length: u64) -> Option<Vec<u8>> {
    let mut bytes = vec![0; usize::try_from(length).ok()?];
    let local = libc::iovec {
        iov_base: bytes.as_mut_ptr().cast(),
        iov_len: bytes.len(),
    };
    let remote = libc::iovec {
        iov_base: std::ptr::with_exposed_provenance_mut(usize::try_from(address).ok()?),
        iov_len: bytes.len(),
    };
    // SAFETY: writes at most `iov_len` bytes to `bytes`, which outlives the call; the kernel checks
    // the remote address.
    let read = unsafe {
        libc::process_vm_readv(
            process.cast_signed(),
            &raw const local,
            1,
            &raw const remote,
            1,
            0,
        )
    };
    bytes.truncate(usize::try_from(read).ok()?);
    Some(bytes)
}
