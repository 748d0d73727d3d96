//! A segment: the memory of one participant that holds its messages.
//!
//! Reads BufferNode of Fast DDS 2.3 to 3.6. A participant reuses a buffer as soon as its last
//! listener has released it, and this reader is not a listener. The buffer's validity id is raised
//! before the buffer is freed. Therefore the id is read before and after the content. The content
//! counts only if both ids match the port's announcement.

use std::cell::RefCell;

use ros2probe_wire::walk::{Bytes, MAX_MESSAGE};

use super::cell::Descriptor;
use super::source::Source;

/// Fields of BufferNode after the status word.
const SIZE_OFFSET: u64 = 8;
const DATA_OFFSET: u64 = 12;
/// Bits of the status word that hold the validity id.
const VALIDITY_MASK: u64 = 0xff_ffff;
/// Size of one read, in bytes: an RTPS header, INFO_DST, INFO_TS and the head of a DATA or
/// DATA_FRAG fit.
const WINDOW_BYTES: usize = 256;

/// A message in a segment, valid at the time it was found.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Buffer {
    node: u64,
    validity: u32,
    data: u64,
    /// Length of the message in bytes.
    pub length: u32,
}

/// Why a message cannot be read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refusal {
    /// The buffer of the message has been reused.
    Expired,
    /// The descriptor is invalid: the message lies outside of the file, or is longer than the
    /// limit.
    Malformed,
}

impl Buffer {
    /// Finds the message that `descriptor` announces.
    ///
    /// # Errors
    /// Fails if the buffer was reused or is invalid.
    pub fn find<S: Source + ?Sized>(source: &S, descriptor: &Descriptor) -> Result<Self, Refusal> {
        let node = u64::from(descriptor.node);
        let mut bytes = [0; 16];
        if !source.read(node, &mut bytes) {
            return Err(Refusal::Malformed);
        }
        let mut buffer = Self {
            node,
            validity: descriptor.validity,
            data: 0,
            length: 0,
        };
        let word = |at: u64| bytes[..].word(at).ok_or(Refusal::Malformed);
        let (validity, size, data) = (word(0)?, word(SIZE_OFFSET)?, word(DATA_OFFSET)?);
        if u64::from(validity) & VALIDITY_MASK != u64::from(descriptor.validity) {
            return Err(Refusal::Expired);
        }
        // The other fields may belong to the next use of the buffer, if it has just begun.
        let refused = if buffer.is_valid(source) {
            Refusal::Malformed
        } else {
            Refusal::Expired
        };
        if size > MAX_MESSAGE {
            return Err(refused);
        }
        buffer.length = size;
        buffer.data = u64::from(data);
        Ok(buffer)
    }

    /// Returns whether the buffer still has the descriptor's validity id. If so, everything read so
    /// far is valid.
    #[must_use]
    pub fn is_valid<S: Source + ?Sized>(&self, source: &S) -> bool {
        let status = source.u64_at(self.node);
        status.is_some_and(|status| status & VALIDITY_MASK == u64::from(self.validity))
    }

    /// Reads the whole message; returns `false` if the file ends before the message. Allocates at
    /// most the size of the file. The caller must check [`Self::is_valid`] afterwards.
    pub fn read<S: Source + ?Sized>(&self, source: &S, into: &mut Vec<u8>) -> bool {
        let last = u64::from(self.length).saturating_sub(1);
        if !source.read(self.data.saturating_add(last), &mut [0]) {
            return false;
        }
        into.resize(usize::try_from(self.length).unwrap_or(0), 0);
        source.read(self.data, into)
    }
}

/// A message that is read only where the walk needs it; check [`Buffer::is_valid`] afterwards.
pub struct Message<'a, S: ?Sized> {
    source: &'a S,
    buffer: Buffer,
    window: RefCell<Window>,
}

/// The part that was read last.
struct Window {
    start: u32,
    length: usize,
    bytes: [u8; WINDOW_BYTES],
}

impl<'a, S: Source + ?Sized> Message<'a, S> {
    /// Reads the message in this buffer.
    #[must_use]
    pub const fn new(source: &'a S, buffer: Buffer) -> Self {
        Self {
            source,
            buffer,
            window: RefCell::new(Window {
                start: 0,
                length: 0,
                bytes: [0; WINDOW_BYTES],
            }),
        }
    }
}

impl<S: Source + ?Sized> Bytes for Message<'_, S> {
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]> {
        let window = &mut *self.window.borrow_mut();
        let within = |window: &Window| {
            let start = usize::try_from(offset.checked_sub(window.start)?).ok()?;
            let bytes = window.bytes.get(..window.length)?;
            let (words, _) = bytes
                .get(start..start.checked_add(4 * N)?)?
                .as_chunks::<4>();
            let mut read = [0; N];
            for (read, word) in read.iter_mut().zip(words) {
                // The walk expects words in memory order.
                *read = u32::from_ne_bytes(*word);
            }
            Some(read)
        };
        if let Some(words) = within(window) {
            return Some(words);
        }
        let left = self.buffer.length.checked_sub(offset)?;
        let length = usize::try_from(left).ok()?.min(WINDOW_BYTES);
        (window.start, window.length) = (offset, 0);
        let bytes = window.bytes.get_mut(..length)?;
        if self
            .source
            .read(self.buffer.data + u64::from(offset), bytes)
        {
            window.length = length;
        }
        within(window)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell as Counter;

    use proptest::prelude::*;

    use super::super::image::SegmentImage;
    use super::*;

    #[test]
    fn a_message_is_found_and_read_as_it_was_written() {
        let mut image = SegmentImage::new([1; 8], 1 << 16);
        let message: Vec<u8> = (0..=255).cycle().take(20_000).collect();
        let descriptor = image.put(&message);
        let buffer = Buffer::find(image.bytes(), &descriptor).unwrap();
        let mut read = Vec::new();
        assert!(buffer.read(image.bytes(), &mut read));
        assert!(buffer.is_valid(image.bytes()));
        assert_eq!(read, message);
        let lazily = Message::new(image.bytes(), buffer);
        for offset in [0, 4, 252, 256, 19_992, 8, 10_000] {
            let direct = message.as_slice().words::<2>(offset);
            assert_eq!(lazily.words::<2>(offset), direct, "{offset}");
        }
        assert_eq!(lazily.words::<2>(19_996), None);
        assert_eq!(lazily.words::<1>(u32::MAX), None);
    }

    #[test]
    fn a_reused_buffer_is_expired() {
        let mut image = SegmentImage::new([1; 8], 1 << 16);
        let old = image.put(b"old");
        let buffer = Buffer::find(image.bytes(), &old).unwrap();
        image.free(old);
        assert!(!buffer.is_valid(image.bytes()));
        assert_eq!(Buffer::find(image.bytes(), &old), Err(Refusal::Expired));
    }

    #[test]
    fn a_buffer_reused_during_a_read_is_expired_and_not_malformed() {
        /// Returns other bytes at each read after the first.
        struct Changing(Vec<u8>, Vec<u8>, Counter<u32>);
        impl Source for Changing {
            fn read(&self, offset: u64, into: &mut [u8]) -> bool {
                let reads = self.2.replace(self.2.get() + 1);
                let bytes = if reads == 0 { &self.0 } else { &self.1 };
                bytes.as_slice().read(offset, into)
            }
        }
        let mut image = SegmentImage::new([1; 8], 1 << 16);
        let descriptor = image.put(b"old");
        let mut torn = image.bytes().to_vec();
        let node = descriptor.node as usize;
        torn[node + 8..node + 12].copy_from_slice(&u32::MAX.to_le_bytes());
        let hostile = Buffer::find(torn.as_slice(), &descriptor);
        assert_eq!(hostile, Err(Refusal::Malformed));
        image.free(descriptor);
        let changing = Changing(torn, image.bytes().to_vec(), Counter::new(0));
        assert_eq!(Buffer::find(&changing, &descriptor), Err(Refusal::Expired));
    }

    #[test]
    fn descriptors_that_point_outside_the_file_are_not_followed() {
        let mut image = SegmentImage::new([1; 8], 1 << 16);
        let descriptor = image.put(&[7; 100]);
        let far = Descriptor {
            node: u32::MAX,
            ..descriptor
        };
        assert_eq!(Buffer::find(image.bytes(), &far), Err(Refusal::Malformed));
        let mut bytes = image.bytes().to_vec();
        let node = descriptor.node as usize;
        bytes[node + 12..node + 16].copy_from_slice(&u32::MAX.to_le_bytes());
        let buffer = Buffer::find(bytes.as_slice(), &descriptor).unwrap();
        assert!(!buffer.read(bytes.as_slice(), &mut Vec::new()));
        assert_eq!(Message::new(bytes.as_slice(), buffer).words::<1>(0), None);
    }

    proptest! {
        #[test]
        fn reading_an_arbitrary_segment_stays_within_its_bytes(
            bytes in proptest::collection::vec(any::<u8>(), 0..400),
            node in 0_u32..500,
            validity in 0_u32..4,
        ) {
            let descriptor = Descriptor { node, validity, ..Descriptor::default() };
            if let Ok(buffer) = Buffer::find(bytes.as_slice(), &descriptor) {
                let mut read = Vec::new();
                let whole = buffer.read(bytes.as_slice(), &mut read);
                prop_assert!(!whole || read.len() <= bytes.len());
                let message = Message::new(bytes.as_slice(), buffer);
                for offset in [0, 4, 200, 60_000] {
                    let lazily = message.words::<3>(offset);
                    if whole {
                        prop_assert_eq!(lazily, read.as_slice().words::<3>(offset));
                    }
                }
            }
        }
    }
}
