//! Frames of every interface of a network namespace, through a ring shared with the kernel:
//! `AF_PACKET` with TPACKET_V3.
//!
//! The socket is created without a protocol, so that nothing arrives before the filter is attached.
//! It is bound to no interface, so that it also sees interfaces that appear later. It never sends.
//! The filter decides which frames are kept, and how much of each.
//!
//! Only this module and `turns` access memory shared with the kernel. A [`Block`] is lent to its
//! reader and returns to the kernel when it is dropped. [`block`] reads a block as plain bytes.

pub mod block;
mod turns;

use std::ffi::c_void;
use std::io;
use std::mem::{size_of, size_of_val};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::ptr::NonNull;
use std::time::Duration;

use libc::{c_int, socklen_t};

use turns::BlockReader;

use super::container::add;

pub use block::{Frames, RingFrame};
pub use turns::Block;

/// Frame size for TPACKET_V3, which requires one but packs frames tightly.
const NOMINAL_FRAME: usize = 2048;
/// Size of a block, in bytes. The largest frame, a 64 KiB datagram on loopback, fits with its
/// header and the block's. The kernel releases a block when it is full or [`Settings::retire`] old,
/// so the number of blocks limits the delay of the reader. Many small blocks are therefore better.
const BLOCK_BYTES: usize = 128 << 10;
/// Default size of a ring, in bytes.
const DEFAULT_RING_BYTES: usize = 4 << 20;
/// Pause between polls of a socket that repeatedly reports an error.
const ERROR_PAUSE: Duration = Duration::from_millis(10);

/// Size and pace of a ring.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Settings {
    /// Bytes of a block; rounded up to whole pages.
    pub block_size: usize,
    /// Number of blocks. One is being filled, the others wait for the reader.
    pub blocks: usize,
    /// How long a frame may wait in a block that does not fill up.
    pub retire: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        Self::with_memory(DEFAULT_RING_BYTES)
    }
}

impl Settings {
    /// Returns settings for a ring of about this much memory, in blocks that hold the largest frame
    /// (64 KiB on `lo`).
    #[must_use]
    pub fn with_memory(bytes: usize) -> Self {
        Self {
            block_size: BLOCK_BYTES,
            blocks: (bytes / BLOCK_BYTES).max(2),
            retire: Duration::from_millis(100),
        }
    }
}

/// The kernel's counters of this socket.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Statistics {
    /// Frames that passed the filter, including those dropped for lack of space.
    pub packets: u64,
    /// Frames dropped because every block waited for the reader.
    pub drops: u64,
    /// Number of times that the ring filled up.
    pub freezes: u64,
    /// Errors reported by the socket, such as a link going down. Capturing continues.
    pub socket_errors: u64,
}

/// Why the ring cannot be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum RingError {
    /// The process lacks a capability.
    #[error(
        "not permitted to capture ({call}): CAP_NET_RAW is missing{}",
        add("--cap-add NET_RAW")
    )]
    NotPermitted {
        /// Name of the system call.
        call: &'static str,
        /// Error of the system call.
        source: io::Error,
    },
    /// A system call failed.
    #[error("{call} failed")]
    System {
        /// Name of the system call.
        call: &'static str,
        /// Error of the system call.
        source: io::Error,
    },
    /// The ring cannot have this size.
    #[error("a ring of {blocks} blocks of {block_size} bytes is empty or too large")]
    Size {
        /// Requested number of blocks.
        blocks: usize,
        /// Requested bytes per block.
        block_size: usize,
    },
}

/// A packet socket and its ring.
#[derive(Debug)]
pub struct Ring {
    // Fields are dropped in this order: the memory is released before the socket is closed.
    turns: BlockReader,
    _memory: Mapping,
    socket: OwnedFd,
    statistics: Statistics,
}

impl Ring {
    /// Captures in the calling thread's network namespace, on all its interfaces. `filter` is a
    /// loaded BPF program of type socket filter; without one every frame is kept.
    ///
    /// # Errors
    /// Fails if a capability is missing, or if the kernel refuses the filter or the ring's size.
    pub fn open(settings: Settings, filter: Option<BorrowedFd<'_>>) -> Result<Self, RingError> {
        Self::open_on(settings, filter, 0)
    }

    fn open_on(
        settings: Settings,
        filter: Option<BorrowedFd<'_>>,
        interface: i32,
    ) -> Result<Self, RingError> {
        let wrong = RingError::Size {
            blocks: settings.blocks,
            block_size: settings.block_size,
        };
        let Some((request, block_size)) = page_bytes().and_then(|page| request(settings, page))
        else {
            return Err(wrong);
        };
        let socket = create()?;
        let version = libc::tpacket_versions::TPACKET_V3 as c_int;
        set(
            &socket,
            libc::SOL_PACKET,
            libc::PACKET_VERSION,
            &version,
            "PACKET_VERSION",
        )?;
        if let Some(filter) = filter {
            let program = filter.as_raw_fd();
            set(
                &socket,
                libc::SOL_SOCKET,
                libc::SO_ATTACH_BPF,
                &program,
                "SO_ATTACH_BPF",
            )?;
        }
        set(
            &socket,
            libc::SOL_PACKET,
            libc::PACKET_RX_RING,
            &request,
            "PACKET_RX_RING",
        )?;
        let memory = Mapping::new(&socket, block_size * settings.blocks)?;
        // SAFETY: the mapping holds `settings.blocks` blocks of whole pages, and starts at a page.
        // `turns` is dropped before the mapping. The other side is the kernel, which follows the
        // TPACKET_V3 protocol.
        let turns = unsafe { BlockReader::new(memory.start.cast(), block_size, settings.blocks) };
        let ring = Self {
            turns,
            _memory: memory,
            socket,
            statistics: Statistics::default(),
        };
        bind(&ring.socket, interface)?;
        Ok(ring)
    }

    /// Returns the number of blocks.
    #[must_use]
    pub const fn blocks(&self) -> usize {
        self.turns.blocks()
    }

    /// Returns the next block if the kernel has released it.
    pub fn block(&mut self) -> Option<Block<'_>> {
        self.turns.block()
    }

    /// Waits until a block is ready; returns `false` on a timeout or signal.
    ///
    /// Clears and counts an error reported by the socket, and continues. A link that goes down
    /// reports one to each socket bound to it.
    ///
    /// # Errors
    /// Fails if `poll` itself fails.
    pub fn wait(&mut self, timeout: Duration) -> Result<bool, RingError> {
        let mut poll = libc::pollfd {
            fd: self.socket.as_raw_fd(),
            events: libc::POLLIN,
            revents: 0,
        };
        let milliseconds = c_int::try_from(timeout.as_millis()).unwrap_or(c_int::MAX);
        // SAFETY: `poll` is one live pollfd, and the count is 1.
        let count = unsafe { libc::poll(&raw mut poll, 1, milliseconds) };
        if count < 0 {
            let source = io::Error::last_os_error();
            if source.kind() == io::ErrorKind::Interrupted {
                return Ok(false);
            }
            return Err(RingError::System {
                call: "poll",
                source,
            });
        }
        if poll.revents & !libc::POLLIN != 0 {
            self.statistics.socket_errors += 1;
            let mut pending: c_int = 0;
            // Reading the error clears it; otherwise every poll would return immediately.
            get(
                &self.socket,
                libc::SOL_SOCKET,
                libc::SO_ERROR,
                &mut pending,
                "SO_ERROR",
            )?;
            if poll.revents & libc::POLLIN == 0 {
                std::thread::sleep(ERROR_PAUSE.min(timeout));
            }
        }
        Ok(poll.revents & libc::POLLIN != 0)
    }

    /// Returns the counters since the ring was opened.
    ///
    /// # Errors
    /// Fails if the kernel's statistics cannot be read.
    pub fn statistics(&mut self) -> Result<Statistics, RingError> {
        let mut fresh = libc::tpacket_stats_v3 {
            tp_packets: 0,
            tp_drops: 0,
            tp_freeze_q_cnt: 0,
        };
        // The kernel resets its counters on each read.
        get(
            &self.socket,
            libc::SOL_PACKET,
            libc::PACKET_STATISTICS,
            &mut fresh,
            "PACKET_STATISTICS",
        )?;
        self.statistics.packets += u64::from(fresh.tp_packets);
        self.statistics.drops += u64::from(fresh.tp_drops);
        self.statistics.freezes += u64::from(fresh.tp_freeze_q_cnt);
        Ok(self.statistics)
    }
}

impl AsFd for Ring {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Memory shared with the kernel.
#[derive(Debug)]
struct Mapping {
    start: NonNull<c_void>,
    length: usize,
}

// SAFETY: the mapping is owned, and accessed only through the ring that owns it; it belongs to no
// thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(socket: &OwnedFd, length: usize) -> Result<Self, RingError> {
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory in use.
        let start = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                length,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED,
                socket.as_raw_fd(),
                0,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(last("mmap"));
        }
        NonNull::new(start)
            .map(|start| Self { start, length })
            .ok_or(last("mmap"))
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: `new` mapped this length, and no borrow of the mapping is left.
        unsafe { libc::munmap(self.start.as_ptr(), self.length) };
    }
}

/// Returns the page size in bytes: 4 KiB, but 16 KiB on a Raspberry Pi 5 and 64 KiB on some
/// servers.
fn page_bytes() -> Option<usize> {
    // SAFETY: sysconf accesses no memory of this process.
    usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).ok()
}

/// Returns the request to the kernel for a ring in blocks of whole pages, and the size of a block.
/// Returns `None` if the numbers overflow.
fn request(settings: Settings, page: usize) -> Option<(libc::tpacket_req3, usize)> {
    let block_size = settings.block_size.max(1).checked_next_multiple_of(page)?;
    let length = block_size.checked_mul(settings.blocks)?;
    if length == 0 || length > 1 << 30 {
        return None;
    }
    let frames = (block_size / NOMINAL_FRAME).checked_mul(settings.blocks)?;
    let request = libc::tpacket_req3 {
        tp_block_size: u32::try_from(block_size).ok()?,
        tp_block_nr: u32::try_from(settings.blocks).ok()?,
        tp_frame_size: u32::try_from(NOMINAL_FRAME).ok()?,
        tp_frame_nr: u32::try_from(frames).ok()?,
        // 0 would select a default computed from the link's speed.
        tp_retire_blk_tov: u32::try_from(settings.retire.as_millis().max(1)).ok()?,
        tp_sizeof_priv: 0,
        tp_feature_req_word: 0,
    };
    Some((request, block_size))
}

/// Creates a socket with protocol 0, which receives nothing until it is bound.
fn create() -> Result<OwnedFd, RingError> {
    let kind = libc::SOCK_DGRAM | libc::SOCK_CLOEXEC | libc::SOCK_NONBLOCK;
    // SAFETY: the call takes no pointers.
    let fd = unsafe { libc::socket(libc::AF_PACKET, kind, 0) };
    if fd < 0 {
        return Err(last("socket(AF_PACKET)"));
    }
    // SAFETY: the descriptor is new and has no other owner.
    Ok(unsafe { OwnedFd::from_raw_fd(fd) })
}

fn bind(socket: &OwnedFd, interface: i32) -> Result<(), RingError> {
    let address = libc::sockaddr_ll {
        sll_family: libc::AF_PACKET as u16,
        sll_protocol: (libc::ETH_P_ALL as u16).to_be(),
        sll_ifindex: interface,
        sll_hatype: 0,
        sll_pkttype: 0,
        sll_halen: 0,
        sll_addr: [0; 8],
    };
    let length = size_of_val(&address) as socklen_t;
    // SAFETY: `address` is a whole sockaddr_ll and `length` its size.
    let result = unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), length) };
    if result < 0 {
        Err(last("bind(ETH_P_ALL)"))
    } else {
        Ok(())
    }
}

fn set<T>(
    socket: &OwnedFd,
    level: c_int,
    option: c_int,
    value: &T,
    name: &'static str,
) -> Result<(), RingError> {
    let length = size_of::<T>() as socklen_t;
    // SAFETY: `value` is a live `T`, and the kernel reads `length` bytes of it.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            level,
            option,
            (&raw const *value).cast(),
            length,
        )
    };
    if result < 0 { Err(last(name)) } else { Ok(()) }
}

/// Reads a socket option. `T` must be a plain integer or a `repr(C)` struct of integers.
fn get<T: Copy>(
    socket: &OwnedFd,
    level: c_int,
    option: c_int,
    value: &mut T,
    name: &'static str,
) -> Result<(), RingError> {
    let mut length = size_of::<T>() as socklen_t;
    // SAFETY: `value` is a live `T` of integers, the kernel writes at most `length` bytes into it,
    // and whatever it writes is a valid `T`.
    let result = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            level,
            option,
            (&raw mut *value).cast(),
            &raw mut length,
        )
    };
    if result < 0 { Err(last(name)) } else { Ok(()) }
}

fn last(call: &'static str) -> RingError {
    let source = io::Error::last_os_error();
    if source.kind() == io::ErrorKind::PermissionDenied {
        RingError::NotPermitted { call, source }
    } else {
        RingError::System { call, source }
    }
}

#[cfg(test)]
mod tests;
