//! Decompresses gzip up to a limit: a few megabytes can contain hours of empty packets.

use std::io::{self, Read};

use flate2::read::MultiGzDecoder;
use ros2probe_wire::{ExpandsTooFar, Expansion};

/// Maximum factor of expansion beyond [`Expansion::FREE_BYTES`]. Captures of images of one colour
/// stay below it; gzip reaches 1032.
const EXPANSION_FACTOR: u64 = 100;

/// A decompressor that fails when its output exceeds the limit for the compressed bytes so far.
pub(super) struct Gunzip<R: Read> {
    decoder: MultiGzDecoder<Compressed<R>>,
    expanded: u64,
    expansion: Expansion,
}

/// Counts the compressed bytes.
struct Compressed<R> {
    source: R,
    read: u64,
}

impl<R: Read> Read for Compressed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(buffer)?;
        self.read += read as u64;
        Ok(read)
    }
}

impl<R: Read> Gunzip<R> {
    pub(super) fn new(source: R, expansion: Expansion) -> Self {
        let source = Compressed { source, read: 0 };
        Self {
            decoder: MultiGzDecoder::new(source),
            expanded: 0,
            expansion,
        }
    }
}

impl<R: Read> Read for Gunzip<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.decoder.read(buffer)?;
        self.expanded += read as u64;
        let compressed = self.decoder.get_ref().read;
        if self.expanded > self.expansion.limit(compressed, EXPANSION_FACTOR) {
            let error = ExpandsTooFar(EXPANSION_FACTOR);
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, error));
        }
        Ok(read)
    }
}
