//! Compression of chunks and of whole files, in pure Rust.
//!
//! Zstd has one level, the fastest: `ruzstd` implements no other. Zstd frames carry their content
//! size; rosbag2 refuses to decompress a file without it.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use ruzstd::encoding::CompressionLevel;

/// Compression of a chunk or a file.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Compression {
    /// No compression.
    #[default]
    None,
    /// LZ4 frames.
    Lz4,
    /// Zstandard frames.
    Zstd,
}

/// Progress of compressing a file, and a flag to cancel it: shared between the compressing thread
/// and the waiting one.
#[derive(Debug, Default)]
pub struct Progress {
    read: AtomicU64,
    cancelled: AtomicBool,
}

impl Progress {
    /// Returns the number of bytes of the file that were read so far.
    #[must_use]
    pub fn read(&self) -> u64 {
        self.read.load(Ordering::Relaxed)
    }

    /// Cancels the compression at its next read; the file stays as it is.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }

    /// Returns whether [`Self::cancel`] was called.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

impl Compression {
    /// Returns the name in MCAP, metadata.yaml and file names.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Lz4 => "lz4",
            Self::Zstd => "zstd",
        }
    }

    /// Parses the name of a compression; `None` for an unknown one.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let all = [Self::None, Self::Lz4, Self::Zstd];
        all.into_iter()
            .find(|compression| compression.name() == name)
    }

    /// Returns `bytes` compressed; `None` without compression, or if the result is not smaller.
    #[must_use]
    pub fn compressed(self, bytes: &[u8]) -> Option<Vec<u8>> {
        let compressed = match self {
            Self::None => return None,
            Self::Lz4 => {
                let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
                encoder.write_all(bytes).ok()?;
                encoder.finish().ok()?
            }
            Self::Zstd => {
                let mut drain = SizedFrame::new(Vec::new(), bytes.len() as u64);
                ruzstd::encoding::compress(bytes, &mut drain, CompressionLevel::Fastest);
                drain.finish().ok()?
            }
        };
        (compressed.len() < bytes.len()).then_some(compressed)
    }

    /// Decompresses `bytes`; fails if the result exceeds `limit` bytes.
    pub fn decompressed(self, bytes: &[u8], limit: u64) -> io::Result<Vec<u8>> {
        let mut out = Vec::new();
        self.reader(bytes)?.take(limit + 1).read_to_end(&mut out)?;
        if out.len() as u64 > limit {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "decompresses to more than its declared size",
            ));
        }
        Ok(out)
    }

    /// Returns a reader that decompresses `source`.
    pub fn reader<'a>(self, source: impl Read + 'a) -> io::Result<Box<dyn Read + 'a>> {
        Ok(match self {
            Self::None => Box::new(source),
            Self::Lz4 => Box::new(lz4_flex::frame::FrameDecoder::new(source)),
            Self::Zstd => {
                Box::new(ruzstd::decoding::StreamingDecoder::new(source).map_err(io::Error::other)?)
            }
        })
    }

    /// Compresses one file into another, as one frame. Fails if `progress` is cancelled.
    pub fn compress_file(self, source: &File, into: &File, progress: &Progress) -> io::Result<()> {
        let size = source.metadata()?.len();
        let source = BufReader::with_capacity(1 << 17, source);
        let mut source = ProgressReader::new(source, progress);
        match self {
            Self::None => {
                io::copy(&mut source, &mut &*into)?;
            }
            Self::Lz4 => {
                let info = lz4_flex::frame::FrameInfo::new().content_size(Some(size));
                let mut encoder = lz4_flex::frame::FrameEncoder::with_frame_info(info, into);
                io::copy(&mut source, &mut encoder)?;
                source.failed.take().map_or(Ok(()), Err)?;
                encoder.finish().map_err(io::Error::other)?;
            }
            Self::Zstd => {
                let mut drain = SizedFrame::new(into, size);
                ruzstd::encoding::compress(&mut source, &mut drain, CompressionLevel::Fastest);
                drain.finish()?;
                source.failed.take().map_or(Ok(()), Err)?;
                if source.read != size {
                    return Err(io::Error::other("the file changed while it was compressed"));
                }
            }
        }
        source.failed.map_or(Ok(()), Err)
    }
}

/// Stores an error and ends the stream, because `ruzstd` panics on an error.
struct ProgressReader<'a, R> {
    inner: R,
    progress: &'a Progress,
    read: u64,
    failed: Option<io::Error>,
}

impl<'a, R: Read> ProgressReader<'a, R> {
    fn new(inner: R, progress: &'a Progress) -> Self {
        Self {
            inner,
            progress,
            read: 0,
            failed: None,
        }
    }
}

impl<R: Read> Read for ProgressReader<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.failed.is_some() {
            return Ok(0);
        }
        if self.progress.is_cancelled() {
            self.failed = Some(io::Error::other("abandoned"));
            return Ok(0);
        }
        loop {
            match self.inner.read(buffer) {
                Ok(read) => {
                    self.read += read as u64;
                    self.progress.read.store(self.read, Ordering::Relaxed);
                    return Ok(read);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => {
                    self.failed = Some(error);
                    return Ok(0);
                }
            }
        }
    }
}

/// Adds the content size to a zstd frame that lacks it (RFC 8878, 3.1.1.1). It stores an error,
/// because `ruzstd` panics on an error.
struct SizedFrame<W> {
    inner: W,
    size: u64,
    /// Bytes before the size: magic number, descriptor and window.
    head: Vec<u8>,
    failed: Option<io::Error>,
}

impl<W: Write> SizedFrame<W> {
    const HEAD_LEN: usize = 6;
    /// Descriptor flag: a size of 8 bytes follows.
    const SIZE_FLAG: u8 = 0b1100_0000;
    /// Descriptor flags that `ruzstd` does not set: a size, a dictionary or no window.
    const UNUSED_FLAGS: u8 = 0b1110_0011;

    fn new(inner: W, size: u64) -> Self {
        Self {
            inner,
            size,
            head: Vec::with_capacity(Self::HEAD_LEN + 8),
            failed: None,
        }
    }

    fn take(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        if let Some(missing) = Self::HEAD_LEN.checked_sub(self.head.len())
            && missing > 0
        {
            let (head, rest) = bytes.split_at(missing.min(bytes.len()));
            self.head.extend_from_slice(head);
            bytes = rest;
            if self.head.len() < Self::HEAD_LEN {
                return Ok(());
            }
            match self.head.get_mut(4) {
                Some(descriptor) if *descriptor & Self::UNUSED_FLAGS == 0 => {
                    *descriptor |= Self::SIZE_FLAG;
                }
                _ => return Err(io::Error::other("zstd wrote an unexpected frame header")),
            }
            self.inner.write_all(&self.head)?;
            self.inner.write_all(&self.size.to_le_bytes())?;
        }
        self.inner.write_all(bytes)
    }

    fn finish(self) -> io::Result<W> {
        self.failed.map_or(Ok(self.inner), Err)
    }
}

impl<W: Write> Write for &mut SizedFrame<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.failed.is_none()
            && let Err(error) = self.take(bytes)
        {
            self.failed = Some(error);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compressed_data_is_restored_and_a_zstd_frame_states_its_size() {
        let bytes = b"ros2probe ".repeat(40_000);
        for compression in [Compression::Lz4, Compression::Zstd] {
            let compressed = compression.compressed(&bytes).unwrap();
            assert!(compressed.len() < bytes.len() / 20, "{}", compressed.len());
            let size = bytes.len() as u64;
            assert_eq!(compression.decompressed(&compressed, size).unwrap(), bytes);
            assert!(compression.decompressed(&compressed, size - 1).is_err());
            assert!(compression.decompressed(&compressed[..100], size).is_err());
            assert_eq!(compression.compressed(&[1, 2, 3]), None, "does not shrink");
            if compression == Compression::Zstd {
                assert_eq!(&compressed[6..14], &size.to_le_bytes());
            }
        }
        assert_eq!(Compression::None.compressed(&bytes), None);
    }

    #[test]
    fn a_full_disk_returns_an_error_instead_of_a_panic() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("source");
        std::fs::write(&path, b"0123456789".repeat(100_000)).unwrap();
        let full = File::options().write(true).open("/dev/full").unwrap();
        for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let error = compression
                .compress_file(&File::open(&path).unwrap(), &full, &Progress::default())
                .unwrap_err();
            assert!(error.to_string().contains("No space left"), "{error}");
        }
    }

    #[test]
    fn a_cancelled_compression_fails() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("source");
        std::fs::write(&path, b"0123456789".repeat(100_000)).unwrap();
        let into = File::create(directory.path().join("into")).unwrap();
        let progress = Progress::default();
        for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let source = File::open(&path).unwrap();
            compression
                .compress_file(&source, &into, &progress)
                .unwrap();
            assert_eq!(progress.read(), 1_000_000);
        }
        progress.cancel();
        for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let source = File::open(&path).unwrap();
            let error = compression.compress_file(&source, &into, &progress);
            assert_eq!(error.unwrap_err().to_string(), "abandoned");
        }
    }
}
