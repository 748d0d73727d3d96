//! Ownership of a ring's blocks. One word passes each block between the kernel and its reader.
//!
//! The module uses no socket and no system call. It behaves the same over plain memory with a
//! thread in place of the kernel, which is how the tests run it under Miri.

use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, Ordering};

use super::block::{Frames, STATUS_OFFSET};

/// The blocks, and the index of the next one.
#[derive(Debug)]
pub(super) struct BlockReader {
    start: NonNull<u8>,
    block_size: usize,
    blocks: usize,
    /// Index of the block that the kernel hands over next.
    next: usize,
}

/// A block of frames that user space owns until it is dropped. The kernel drops frames while all
/// blocks wait for the reader, so a block should not be held for long.
#[derive(Debug)]
pub struct Block<'a> {
    turns: &'a mut BlockReader,
}

// SAFETY: the caller of `new` guarantees that the memory outlives this value. It is accessed only
// through this value and belongs to no thread.
unsafe impl Send for BlockReader {}

impl BlockReader {
    /// Creates a ring over adjacent blocks at `start`.
    ///
    /// # Safety
    /// `start` is aligned to 8. `block_size` is a multiple of 8 and at least the size of a block's
    /// header. `blocks` is not 0, and `blocks` times `block_size` bytes are mapped while the value
    /// lives. Only the other side accesses them besides this value. The other side writes into a
    /// block only while the block's status does not have `TP_STATUS_USER`. It does so after reading
    /// the status with acquire, and before setting the flag with release.
    pub(super) const unsafe fn new(start: NonNull<u8>, block_size: usize, blocks: usize) -> Self {
        Self {
            start,
            block_size,
            blocks,
            next: 0,
        }
    }

    /// Returns the number of blocks.
    pub(super) const fn blocks(&self) -> usize {
        self.blocks
    }

    /// Returns the index of the next block.
    #[cfg(test)]
    pub(super) const fn next(&self) -> usize {
        self.next
    }

    /// Returns the next block if the kernel has released it.
    pub(super) fn block(&mut self) -> Option<Block<'_>> {
        // Acquire: pairs with the write barrier between the kernel's last write to the block and
        // its status (net/packet/af_packet.c, prb_flush_block).
        let status = self.status().load(Ordering::Acquire);
        if status & libc::TP_STATUS_USER == 0 {
            return None;
        }
        Some(Block { turns: self })
    }

    /// Returns the start of the next block.
    fn start(&self) -> NonNull<u8> {
        // SAFETY: `next < blocks`, so the block lies within the memory passed to `new`.
        unsafe { self.start.byte_add(self.next * self.block_size) }
    }

    /// Returns the status word of the next block.
    fn status(&self) -> &AtomicU32 {
        // SAFETY: a block is longer than its header, which has the word (STATUS, a multiple of 4).
        let word = unsafe { self.start().byte_add(STATUS_OFFSET) };
        // SAFETY: the caller of `new` guarantees that the word is aligned and mapped while `self`
        // lives. Kernel and user space access it as one 32-bit word. The kernel does not write it
        // while user space owns the block.
        unsafe { AtomicU32::from_ptr(word.cast().as_ptr()) }
    }
}

impl Block<'_> {
    /// Returns the frames of the block.
    #[must_use]
    pub fn frames(&self) -> Frames<'_> {
        Frames::new(self.bytes())
    }

    fn bytes(&self) -> &[u8] {
        let start = self.turns.start();
        // SAFETY: the block is mapped while the ring lives, and `self` borrows the ring. The block
        // belongs to user space since `BlockReader::block` saw TP_STATUS_USER. Until the drop,
        // neither the kernel nor this process writes to it. Any bytes are valid `u8`.
        unsafe { std::slice::from_raw_parts(start.as_ptr(), self.turns.block_size) }
    }
}

impl Drop for Block<'_> {
    fn drop(&mut self) {
        // Release: our reads of the block come before the kernel's writes. Pairs with the read
        // barrier after the status in net/packet/af_packet.c, prb_dispatch_next_block.
        self.turns
            .status()
            .store(libc::TP_STATUS_KERNEL, Ordering::Release);
        self.turns.next = (self.turns.next + 1) % self.turns.blocks;
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use crate::ring::block::tests::block_of;

    const BLOCK: usize = 512;
    const BLOCKS: usize = 3;

    /// Memory of a ring, in words for alignment.
    struct Memory(NonNull<u8>);

    // SAFETY: plain memory; the tests exercise its synchronization.
    unsafe impl Send for Memory {}

    impl Memory {
        const WORDS: usize = BLOCK * BLOCKS / 8;

        fn new() -> Self {
            let words = vec![0_u64; Self::WORDS].into_boxed_slice();
            Self(NonNull::new(Box::into_raw(words).cast()).unwrap())
        }

        fn turns(&self) -> BlockReader {
            // SAFETY: length and alignment are as required, and every test frees the memory last.
            unsafe { BlockReader::new(self.0, BLOCK, BLOCKS) }
        }

        /// Acts as the kernel: waits until the block is free, fills it, and releases it.
        fn fill(&self, index: usize, bytes: &[u8]) {
            // SAFETY: the block is within the memory.
            let block = unsafe { self.0.byte_add(index * BLOCK) };
            // SAFETY: the word is within the block, after its start.
            let word = unsafe { block.byte_add(STATUS_OFFSET) };
            // SAFETY: the word is aligned, and both sides access it as an atomic.
            let status = unsafe { AtomicU32::from_ptr(word.cast().as_ptr()) };
            while status.load(Ordering::Acquire) & libc::TP_STATUS_USER != 0 {
                thread::yield_now();
            }
            let (head, tail) = (&bytes[..STATUS_OFFSET], &bytes[STATUS_OFFSET + 4..]);
            // SAFETY: the kernel's side owns the block, since the reader has released it.
            unsafe { block.copy_from_nonoverlapping(NonNull::from(head).cast(), head.len()) };
            // SAFETY: the address is within the block, after the status.
            let behind = unsafe { word.byte_add(4) };
            // SAFETY: the kernel's side still owns the block.
            unsafe { behind.copy_from_nonoverlapping(NonNull::from(tail).cast(), tail.len()) };
            status.store(libc::TP_STATUS_USER, Ordering::Release);
        }

        /// Frees the memory after every use of it.
        fn free(self) {
            let words = std::ptr::slice_from_raw_parts_mut(self.0.cast().as_ptr(), Self::WORDS);
            // SAFETY: the memory is from `new`, and no longer used.
            drop(unsafe { Box::<[u64]>::from_raw(words) });
        }
    }

    fn payload(number: u8) -> Vec<u8> {
        vec![number; usize::from(number % 7) * 9 + 1]
    }

    /// Waits for the next block and returns its frames.
    fn next(turns: &mut BlockReader) -> Vec<Vec<u8>> {
        loop {
            if let Some(block) = turns.block() {
                return block.frames().map(|frame| frame.bytes.to_vec()).collect();
            }
            thread::yield_now();
        }
    }

    #[test]
    fn the_reader_owns_a_block_until_it_is_dropped_and_then_gets_the_next_one() {
        let memory = Memory::new();
        let mut turns = memory.turns();
        assert!(turns.block().is_none());
        memory.fill(0, &block_of(&[b"first"]));
        memory.fill(1, &block_of(&[b"second", b"third"]));
        assert_eq!(next(&mut turns), [b"first"]);
        assert_eq!(next(&mut turns), [&b"second"[..], b"third"]);
        assert!(turns.block().is_none());
        // The reader does not return to the first block: the third block is next.
        memory.fill(0, &block_of(&[b"again"]));
        assert!(turns.block().is_none());
        memory.fill(2, &block_of(&[]));
        assert!(next(&mut turns).is_empty());
        assert_eq!(next(&mut turns), [b"again"]);
        memory.free();
    }

    #[test]
    fn frames_read_while_another_thread_fills_the_ring_are_intact() {
        const NUMBERS: u8 = if cfg!(miri) { 12 } else { 240 };
        let memory = Memory::new();
        let mut turns = memory.turns();
        thread::scope(|scope| {
            let kernel = Memory(memory.0);
            scope.spawn(move || {
                // This moves the whole value, not only the pointer in it.
                let kernel = kernel;
                for number in 0..NUMBERS {
                    let bytes = block_of(&[&payload(number), b"", &payload(number ^ 1)]);
                    kernel.fill(usize::from(number) % BLOCKS, &bytes);
                }
            });
            for number in 0..NUMBERS {
                let expected = [payload(number), Vec::new(), payload(number ^ 1)];
                assert_eq!(next(&mut turns), expected);
            }
        });
        memory.free();
    }
}
