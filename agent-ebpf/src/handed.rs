//! Reads messages that a process writes to the shared memory of Fast DDS, in that process.
//!
//! A uprobe runs where the library is about to copy a message: once per message, however many
//! readers it has. It reads the sender's memory at the addresses passed to the call. It never
//! writes and never waits: a message on a page that is not resident counts as unreadable. Fast DDS
//! 2.x passes the message in one piece, 3.x in a list of buffers.

use aya_ebpf::{
    helpers::{
        bpf_ktime_get_ns,
        generated::{bpf_get_smp_processor_id, bpf_probe_read_user},
    },
    macros::map,
    maps::PerCpuArray,
};
use core::mem::MaybeUninit;
use ros2probe_wire::{
    filter::Counter,
    host::PIECE_BYTES,
    record::flag,
    walk::{self, Bytes, MAGIC, Step},
};

use crate::{
    instructions::hide_bounds,
    maps::{
        SCRATCH_SLOTS, Scratch, ScratchRef, claim_egress_slot, count, piece_buffer, release_slot,
        scratch,
    },
    pieces,
    registers::{is_aarch64, register},
    settings::is_in_target_cgroup,
    verdict::{self, progress},
};

/// Maximum number of submessages read per message; a message with more is captured.
const MAX_SUBMESSAGES: u32 = 64;
/// Size of a buffer's description in a list, in bytes: an address and a length.
const BUFFER_DESCRIPTOR_LEN: u64 = 16;
/// Maximum number of buffers that one search visits, and of buffers in a list.
const MAX_BUFFERS_PER_SEARCH: u32 = 64;
const MAX_BUFFERS: u64 = 4096;
/// Maximum number of pieces of one captured message.
const MAX_PIECES: u32 = 256;
/// Maximum length of a captured message, in bytes. Longer messages are metered, because user space
/// reads messages as datagrams of at most 64 KiB.
const MAX_CAPTURED_LEN: u32 = 0xffff;
/// Maximum length of a message or buffer, in bytes: larger than any real one.
const MAX_LEN: u32 = 1 << 28;
/// Maximum number of words in one read of the walk, and length of [`ShmMessage::bridge`].
const MAX_READ_WORDS: usize = 8;

/// The current message, by slot.
#[map]
static HANDED: PerCpuArray<ShmMessage> = PerCpuArray::with_max_entries(SCRATCH_SLOTS, 0);

/// One message in its sender's memory.
#[repr(C)]
struct ShmMessage {
    /// Address of the list of buffers; 0 = the message lies in one piece.
    list: u64,
    /// Number of buffers in the list.
    buffers: u32,
    /// Index of the next buffer to read.
    next: u32,
    /// Address of the current buffer.
    address: u64,
    /// Offsets in the message at which the current buffer begins and ends.
    start: u32,
    end: u32,
    /// Words that span two buffers.
    bridge: [u32; MAX_READ_WORDS],
}

/// The message as the walk reads it.
struct MessageBytes {
    slot: u32,
}

impl Bytes for MessageBytes {
    #[inline(always)]
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]> {
        let len = 4 * N as u32;
        let mut handed = handed(self.slot)?;
        if offset < handed.start || offset + len > handed.end {
            let found = seek_buffer(self.slot, offset, len);
            handed = self::handed(self.slot)?;
            match found {
                buffer_search::IN_BUFFER => {}
                buffer_search::SPANS_BUFFERS => {
                    let mut words = [core::hint::black_box(0); N];
                    let mut index = 0;
                    while index < N {
                        words[index] = handed.bridge[index];
                        index += 1;
                    }
                    return Some(words);
                }
                _ => return None,
            }
        }
        read(handed.address + u64::from(offset.wrapping_sub(handed.start)))
    }
}

/// Results of [`seek_buffer`]. The values are `u32` because they cross a function boundary.
mod buffer_search {
    pub const NOT_FOUND: u32 = 0;
    /// The bytes are in the current buffer.
    pub const IN_BUFFER: u32 = 1;
    /// The bytes are in the bridge.
    pub const SPANS_BUFFERS: u32 = 2;
}

/// Handles a call that writes a message, from its saved registers. With `is_buffer_list`, the call
/// passes the message as a list of buffers.
#[inline(always)]
pub fn process_send(registers: *const u64, is_buffer_list: bool) {
    // The caller allocates the object that the call returns. On x86-64 its address is the first
    // argument, before `this`; on AArch64 it has its own register, so the arguments are x1 and x2.
    let (message, len) = if is_aarch64() {
        (register!(registers, 8), register!(registers, 16))
    } else {
        // rdx and rcx.
        (register!(registers, 96), register!(registers, 88))
    };
    if !is_in_target_cgroup() {
        return;
    }
    let Some(slot) = claim_egress_slot() else {
        return;
    };
    shm_message(slot, message, len as u32, u32::from(is_buffer_list));
    release_slot(slot);
}

/// Handles one message of `len` bytes at `address`.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn shm_message(slot: u32, address: u64, len: u32, is_buffer_list: u32) -> u32 {
    let (Some(mut working), Some(mut handed)) = (scratch(slot), handed(slot)) else {
        return 0;
    };
    if let Err(reason) = locate_buffers(&mut handed, address, len, is_buffer_list) {
        count(slot, reason, 1);
        return 0;
    }
    let message = MessageBytes { slot };
    let Some([magic, _version, source @ ..]) = message.words::<5>(0) else {
        count(slot, Counter::Unreadable, 1);
        return 0;
    };
    if magic != MAGIC {
        count(slot, Counter::Malformed, 1);
        return 0;
    }
    count(slot, Counter::Messages, 1);
    // SAFETY: no preconditions.
    let now = unsafe { bpf_ktime_get_ns() };
    let scratch = working.get();
    let token = reset_scratch(scratch, slot, now);
    begin_walk(scratch, source, len);
    verdict::note_participant_seen(scratch, source, now);
    if shm_walk(slot, len) == progress::CAPTURE {
        if len <= MAX_CAPTURED_LEN {
            verdict::count_capture(slot, working.get());
            if shm_capture(slot, len, token) != 0 {
                return 1;
            }
        } else {
            count(slot, Counter::PiecesLost, 1);
        }
        // The walk is repeated as if a copy had been captured: submessages of interest become
        // records.
        let scratch = working.get();
        scratch.record_count = core::hint::black_box(0);
        scratch.is_unknown_writer = core::hint::black_box(0);
        scratch.is_duplicate = core::hint::black_box(1);
        begin_walk(scratch, source, len);
        shm_walk(slot, len);
    }
    let records = working.get().record_count;
    count(
        slot,
        if records == 0 {
            Counter::Ignored
        } else {
            Counter::Metered
        },
        1,
    );
    verdict::write_records(records, u32::from(flag::SHM | flag::EXACT), slot);
    1
}

/// Stores the location of the message's bytes. Returns the counter to increment if the message
/// cannot be read.
#[inline(always)]
fn locate_buffers(
    handed: &mut ShmMessage,
    address: u64,
    len: u32,
    is_buffer_list: u32,
) -> Result<(), Counter> {
    let zero = core::hint::black_box(0);
    if len < walk::HEADER_LEN || len > MAX_LEN {
        return Err(Counter::Malformed);
    }
    handed.next = zero;
    handed.start = zero;
    if is_buffer_list == 0 {
        (handed.list, handed.buffers) = (u64::from(zero), zero);
        (handed.address, handed.end) = (address, len);
        return Ok(());
    }
    // A std::vector: the addresses at which its contents begin and end.
    let [begin, end] = read::<[u64; 2]>(address).ok_or(Counter::Unreadable)?;
    let buffers = end.wrapping_sub(begin) / BUFFER_DESCRIPTOR_LEN;
    if buffers == 0 || buffers > MAX_BUFFERS {
        return Err(Counter::Malformed);
    }
    (handed.list, handed.buffers) = (begin, buffers as u32);
    (handed.address, handed.end) = (u64::from(zero), zero);
    Ok(())
}

/// Clears the working memory for a message without network addresses; returns the message's token.
#[inline(always)]
fn reset_scratch(scratch: &mut Scratch, slot: u32, now: u64) -> u32 {
    let zero = core::hint::black_box(0);
    scratch.packet.time_ns = now;
    scratch.packet.is_at_socket = zero;
    scratch.record_count = zero;
    scratch.is_unknown_writer = zero;
    scratch.is_duplicate = zero;
    scratch.token_count = scratch.token_count.wrapping_add(1);
    let record = &mut scratch.walk.record;
    record.time = now;
    record.destination = [zero; 4];
    record.destination_port = zero as u16;
    record.source_port = zero as u16;
    record.interface = zero;
    record.datagram = zero;
    record.socket = u64::from(zero);
    record.elapsed = zero;
    record.unused = zero as u16;
    record.flags = zero as u16;
    // SAFETY: no preconditions.
    let cpu = unsafe { bpf_get_smp_processor_id() } as u32;
    // The token has the form of those of `host::assign_token`.
    scratch.token_count << 12 | (slot + 1) << 8 | (cpu & 0xff)
}

/// Starts a walk over the message.
#[inline(always)]
fn begin_walk(scratch: &mut Scratch, source: [u32; 3], len: u32) {
    scratch.walk.begin(source, len);
    if len > MAX_CAPTURED_LEN {
        scratch.walk.record.datagram_len = MAX_CAPTURED_LEN as u16;
    }
}

/// Walks the submessages; returns the [`progress`] of the last one.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn shm_walk(slot: u32, len: u32) -> u32 {
    let mut submessages = 0;
    while submessages < MAX_SUBMESSAGES {
        let result = walk_shm_submessage(slot, len);
        if result != progress::CONTINUE {
            return result;
        }
        submessages += 1;
    }
    progress::CAPTURE
}

/// Walks one submessage. Unlike in `verdict::walk_submessage`, a split submessage ends the walk.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn walk_shm_submessage(slot: u32, len: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return progress::FRAME_DONE;
    };
    let scratch = scratch.get();
    match walk::step(&mut scratch.walk, &MessageBytes { slot }, len) {
        Step::End | Step::Later | Step::Split => progress::FRAME_DONE,
        Step::Passed => progress::CONTINUE,
        Step::Malformed => {
            count(slot, Counter::Malformed, 1);
            progress::FRAME_DONE
        }
        Step::Endpoint => verdict::apply_verdict(slot, scratch, false),
        Step::LongGap => verdict::apply_verdict(slot, scratch, true),
    }
}

/// Writes the whole message to the ring; returns 1 if every piece fit.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn shm_capture(slot: u32, len: u32, token: u32) -> u32 {
    let (Some(mut scratch), Some(mut buffer)) = (scratch(slot), piece_buffer(slot)) else {
        return 0;
    };
    let zero = core::hint::black_box(0);
    let piece = &mut buffer.piece;
    piece.time = scratch.get().packet.time_ns;
    piece.socket = u64::from(zero);
    piece.source = [zero; 4];
    piece.destination = [zero; 4];
    piece.source_port = zero as u16;
    piece.destination_port = zero as u16;
    piece.interface = zero;
    piece.datagram = token;
    piece.datagram_len = len;
    piece.flags = flag::SHM | flag::EXACT;
    let (mut offset, mut number) = (0, 0);
    while number < MAX_PIECES {
        if offset >= len {
            count(slot, Counter::CapturedBytes, u64::from(len));
            return 1;
        }
        let piece_len = write_shm_piece(slot, offset);
        if piece_len == 0 {
            break;
        }
        offset += piece_len;
        number += 1;
    }
    count(slot, Counter::PiecesLost, 1);
    0
}

/// Writes one piece, which begins at `offset` of the message and lies in one buffer. Returns the
/// length of the piece, or 0 if the piece could not be read or did not fit.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_shm_piece(slot: u32, offset: u32) -> u32 {
    if seek_buffer(slot, offset, 1) != buffer_search::IN_BUFFER {
        return 0;
    }
    let (Some(handed), Some(mut buffer)) = (handed(slot), piece_buffer(slot)) else {
        return 0;
    };
    let left_in_buffer = handed.end.wrapping_sub(offset);
    let remaining = buffer.piece.datagram_len.wrapping_sub(offset);
    let len = if left_in_buffer < remaining {
        left_in_buffer
    } else {
        remaining
    };
    let len = if len > PIECE_BYTES { PIECE_BYTES } else { len };
    if len == 0 {
        return 0;
    }
    buffer.piece.offset = offset;
    buffer.piece.len = len;
    let from = handed.address + u64::from(offset.wrapping_sub(handed.start));
    // SAFETY: the buffer can hold the longest piece; the kernel checks the address.
    let status = unsafe {
        bpf_probe_read_user(
            buffer.bytes.as_mut_ptr().cast(),
            pieces::bounded_piece_len(len) as u32,
            from as *const _,
        )
    };
    if status != 0 || pieces::push_piece(slot, &mut buffer) == 0 {
        return 0;
    }
    len
}

/// Finds the buffer with `len` bytes at `offset` of the message and makes it the current one.
/// Copies bytes that span several buffers to the bridge.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn seek_buffer(slot: u32, offset: u32, len: u32) -> u32 {
    let Some(mut message) = handed(slot) else {
        return buffer_search::NOT_FOUND;
    };
    if offset < message.start {
        // The search restarts from the first buffer. A capture causes only one restart.
        let zero = core::hint::black_box(0);
        (message.next, message.start, message.end) = (zero, zero, zero);
    }
    if advance_to_buffer(slot, offset) == 0 {
        return buffer_search::NOT_FOUND;
    }
    // The message is looked up again, because `advance_to_buffer` has held a reference of its own.
    if handed(slot).is_some_and(|message| offset + len <= message.end) {
        return buffer_search::IN_BUFFER;
    }
    let mut index = 0;
    while index < 4 * MAX_READ_WORDS as u32 {
        if index >= len {
            break;
        }
        if copy_spanning_byte(slot, offset + index, index) == 0 {
            return buffer_search::NOT_FOUND;
        }
        index += 1;
    }
    buffer_search::SPANS_BUFFERS
}

/// Copies one byte of the message to the bridge.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn copy_spanning_byte(slot: u32, offset: u32, index: u32) -> u32 {
    if advance_to_buffer(slot, offset) == 0 {
        return 0;
    }
    let Some(mut handed) = handed(slot) else {
        return 0;
    };
    let from = handed.address + u64::from(offset.wrapping_sub(handed.start));
    let Some([byte]) = read::<[u8; 1]>(from) else {
        return 0;
    };
    let index = hide_bounds(index) as usize & (4 * MAX_READ_WORDS - 1);
    // SAFETY: an index below the array's length.
    unsafe {
        *(&raw mut handed.bridge).cast::<u8>().add(index) = byte;
    }
    1
}

/// Moves along the list to the buffer with the byte at `offset`; returns 0 if no buffer holds it.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn advance_to_buffer(slot: u32, offset: u32) -> u32 {
    let Some(mut handed) = handed(slot) else {
        return 0;
    };
    let mut steps = 0;
    while steps < MAX_BUFFERS_PER_SEARCH {
        if offset < handed.end {
            return u32::from(offset >= handed.start);
        }
        if handed.next >= handed.buffers {
            return 0;
        }
        let at = handed.list + u64::from(handed.next) * BUFFER_DESCRIPTOR_LEN;
        let Some([address, len]) = read::<[u64; 2]>(at) else {
            return 0;
        };
        // The length is a `uint32_t` followed by padding.
        let len = len as u32;
        if len > MAX_LEN || handed.end > MAX_LEN {
            return 0;
        }
        handed.address = address;
        handed.start = handed.end;
        handed.end += len;
        handed.next += 1;
        steps += 1;
    }
    0
}

#[inline(always)]
fn handed(slot: u32) -> Option<ScratchRef<ShmMessage>> {
    ScratchRef::lookup(&HANDED, slot)
}

/// Reads a plain value from the memory of the running process.
#[inline(always)]
fn read<T: Copy>(address: u64) -> Option<T> {
    let mut value = MaybeUninit::<T>::uninit();
    // SAFETY: the destination has the size given; the kernel checks the address.
    let result = unsafe {
        bpf_probe_read_user(
            value.as_mut_ptr().cast(),
            size_of::<T>() as u32,
            address as *const _,
        )
    };
    if result != 0 {
        return None;
    }
    // SAFETY: the helper has filled all of it; only arrays of integers are read.
    Some(unsafe { value.assume_init() })
}
