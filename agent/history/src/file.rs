//! One file of blocks.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::ops::Range;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

use crate::block::{Block, HEADER_LEN, Header, Kind};

/// Beginning of each file. The last byte is the version of the format.
const SIGNATURE: [u8; 8] = *b"ros2hst\x01";

/// Place of the first block in a file.
pub(crate) const FIRST_PLACE: u64 = SIGNATURE.len() as u64;

const NOFOLLOW: i32 = OFlags::NOFOLLOW.bits().cast_signed();

/// A file as far as it is valid.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Blocks {
    pub(crate) path: PathBuf,
    /// Earliest begin and latest end of its blocks.
    pub(crate) begin: u32,
    pub(crate) end: u32,
    /// Length up to the end of the last whole block, in bytes.
    pub(crate) length: u64,
}

impl Blocks {
    /// Creates a file, or truncates one that has no whole block.
    pub(crate) fn create(path: PathBuf, begin: u32) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let mut file = options.custom_flags(NOFOLLOW).open(&path)?;
        file.write_all(&SIGNATURE)?;
        Ok(Self {
            path,
            begin,
            end: begin,
            length: FIRST_PLACE,
        })
    }

    /// Reads the headers of an existing file; `None` if it has another format or no whole block.
    pub(crate) fn open(path: &Path) -> Option<Self> {
        let mut reader = Reader::open(path, u64::MAX).ok()?;
        let (first, _) = reader.next()?;
        let (mut begin, mut end, mut length) = (first.begin, first.end, reader.place);
        while let Some((header, _)) = reader.next() {
            begin = begin.min(header.begin);
            end = end.max(header.end);
            length = reader.place;
        }
        Some(Self {
            path: path.to_path_buf(),
            begin,
            end,
            length,
        })
    }

    /// Appends blocks as a whole. After a failure the file is as before.
    pub(crate) fn append(&mut self, blocks: &[Block]) -> io::Result<()> {
        self.write(blocks, |_| Ok(()))
    }

    /// Appends blocks as [`Self::append`] does, and returns the file.
    pub(crate) fn with(mut self, blocks: &[Block]) -> io::Result<Self> {
        self.append(blocks)?;
        Ok(self)
    }

    /// Appends blocks as [`Self::append`] does, and waits until they are on disk.
    pub(crate) fn append_durably(&mut self, blocks: &[Block]) -> io::Result<()> {
        self.write(blocks, File::sync_data)
    }

    fn write(
        &mut self,
        blocks: &[Block],
        finish: impl Fn(&File) -> io::Result<()>,
    ) -> io::Result<()> {
        let mut bytes = Vec::new();
        for block in blocks {
            bytes.append(&mut block.stored()?);
        }
        let mut file = OpenOptions::new().write(true).open(&self.path)?;
        // This also removes what a write that failed has left.
        file.set_len(self.length)?;
        file.seek(SeekFrom::Start(self.length))?;
        if let Err(error) = file.write_all(&bytes).and_then(|()| finish(&file)) {
            let _ = file.set_len(self.length);
            return Err(error);
        }
        self.length += bytes.len() as u64;
        for block in blocks {
            self.begin = self.begin.min(block.begin);
            self.end = self.end.max(block.end);
        }
        Ok(())
    }

    /// Returns whether a block of this file may overlap the times.
    pub(crate) const fn overlaps(&self, times: &Range<u32>) -> bool {
        self.begin < times.end && self.end > times.start
    }

    /// Visits the undamaged blocks of a kind that overlap the times.
    pub(crate) fn visit(&self, kind: Kind, times: &Range<u32>, each: &mut dyn FnMut(Block)) {
        // A file that was deleted in the meantime has nothing to visit.
        let Ok(mut reader) = Reader::open(&self.path, self.length) else {
            return;
        };
        while let Some((header, place)) = reader.next() {
            let is_wanted =
                header.kind == Some(kind) && header.begin < times.end && header.end > times.start;
            if let Some(block) = is_wanted.then(|| reader.block(&header, place)).flatten() {
                each(block);
            }
        }
    }

    /// Returns the header and the place of the latest undamaged block of a kind that ends at `time`
    /// or before. Reads what is stored, and does not decompress it.
    pub(crate) fn last(&self, kind: Kind, time: u32) -> Option<(Header, u64)> {
        let mut reader = Reader::open(&self.path, self.length).ok()?;
        let mut found = Vec::new();
        while let Some((header, place)) = reader.next() {
            if header.kind == Some(kind) && header.end <= time {
                found.push((header, place));
            }
        }
        found.sort_by_key(|(header, _)| header.end);
        let mut latest = found.into_iter().rev();
        latest.find(|(header, place)| {
            let stored = reader.stored(header, *place);
            stored.is_some_and(|stored| header.is_undamaged(&stored))
        })
    }

    /// Returns a block; `None` if it is damaged.
    pub(crate) fn block(&self, header: &Header, place: u64) -> Option<Block> {
        let mut reader = Reader::open(&self.path, self.length).ok()?;
        reader.block(header, place)
    }
}

/// Reads the headers of a file one after the other.
pub(crate) struct Reader {
    file: File,
    /// Place of the next header.
    pub(crate) place: u64,
    length: u64,
}

impl Reader {
    /// Opens a file, of which the bytes up to `length` are valid.
    pub(crate) fn open(path: &Path, length: u64) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        let mut file = options.read(true).custom_flags(NOFOLLOW).open(path)?;
        let length = length.min(file.metadata()?.len());
        let mut signature = [0; SIGNATURE.len()];
        file.read_exact(&mut signature)?;
        if signature != SIGNATURE {
            return Err(io::Error::from(io::ErrorKind::InvalidData));
        }
        let place = FIRST_PLACE;
        Ok(Self {
            file,
            place,
            length,
        })
    }

    /// Returns the next header of a whole block, with its place.
    pub(crate) fn next(&mut self) -> Option<(Header, u64)> {
        let mut bytes = [0; HEADER_LEN];
        self.file.seek(SeekFrom::Start(self.place)).ok()?;
        self.file.read_exact(&mut bytes).ok()?;
        let header = Header::read(&bytes)?;
        let end = self.place + HEADER_LEN as u64 + u64::from(header.stored);
        if end > self.length {
            return None;
        }
        let place = std::mem::replace(&mut self.place, end);
        Some((header, place))
    }

    /// Returns a block; `None` if it is damaged.
    pub(crate) fn block(&mut self, header: &Header, place: u64) -> Option<Block> {
        header.block(&self.stored(header, place)?)
    }

    /// Returns the bytes of a block as they are stored; `None` if they cannot be read.
    fn stored(&mut self, header: &Header, place: u64) -> Option<Vec<u8>> {
        self.file.seek(SeekFrom::Start(place)).ok()?;
        let mut bytes = Vec::new();
        let length = HEADER_LEN as u64 + u64::from(header.stored);
        (&mut self.file).take(length).read_to_end(&mut bytes).ok()?;
        Some(bytes)
    }
}
