//! Blocks, the units of a file: a header with a checksum, and compressed content.

use std::io::{self, Read as _, Write as _};

use flate2::Crc;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;

use crate::columns::{self, Name, Row};
use crate::rows::{ProcessName, ProcessRow, Series, TopicName, TopicRow};

/// Length of a header, in bytes.
pub(crate) const HEADER_LEN: usize = 17;
/// Maximum length of a block on disk, without its header, in bytes.
pub(crate) const MAX_STORED: u32 = 16 << 20;
/// Maximum length of its content, in bytes. A damaged block cannot take more memory.
const MAX_CONTENT: u64 = 64 << 20;

/// Kind of a block's content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Rows of topics.
    Topics,
    /// Rows of processes.
    Processes,
    /// State of the robot at the block's end, as text.
    State,
    /// Events, one on each line.
    Events,
    /// A record of a queue.
    Queued,
    /// Documents, or what changed in them.
    Documents,
}

/// A block with its content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Kind of the content.
    pub kind: Kind,
    /// Unix time after which the content begins.
    pub begin: u32,
    /// Unix time at which the content ends.
    pub end: u32,
    /// Content.
    pub content: Vec<u8>,
}

/// A header without its checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) stored: u32,
    checksum: u32,
    /// `None` for a kind of a later version.
    pub(crate) kind: Option<Kind>,
    pub(crate) begin: u32,
    pub(crate) end: u32,
}

impl Kind {
    const ALL: [Self; 6] = [
        Self::Topics,
        Self::Processes,
        Self::State,
        Self::Events,
        Self::Queued,
        Self::Documents,
    ];
}

impl Block {
    /// Creates a block of topics' rows.
    #[must_use]
    pub fn of_topics(begin: u32, end: u32, all: &[Series<TopicName, TopicRow>]) -> Self {
        Self::of(Kind::Topics, begin, end, all)
    }

    /// Creates a block of processes' rows.
    #[must_use]
    pub fn of_processes(begin: u32, end: u32, all: &[Series<ProcessName, ProcessRow>]) -> Self {
        Self::of(Kind::Processes, begin, end, all)
    }

    fn of<N: Name, R: Row>(kind: Kind, begin: u32, end: u32, all: &[Series<N, R>]) -> Self {
        let mut content = Vec::new();
        columns::write(all, &mut content);
        Self {
            kind,
            begin,
            end,
            content,
        }
    }

    /// Returns the block as it is stored.
    pub(crate) fn stored(&self) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; HEADER_LEN];
        let mut encoder = DeflateEncoder::new(&mut bytes, flate2::Compression::default());
        encoder.write_all(&self.content)?;
        encoder.finish()?;
        let stored = u32::try_from(bytes.len().saturating_sub(HEADER_LEN));
        let stored = stored.ok().filter(|stored| *stored <= MAX_STORED);
        let stored =
            stored.ok_or_else(|| io::Error::other("a block of the history is too long"))?;
        let mut header = Vec::with_capacity(HEADER_LEN);
        header.extend_from_slice(&stored.to_le_bytes());
        header.extend_from_slice(&[0; 4]);
        header.push(self.kind as u8);
        header.extend_from_slice(&self.begin.to_le_bytes());
        header.extend_from_slice(&self.end.to_le_bytes());
        if let Some(place) = bytes.first_chunk_mut::<HEADER_LEN>() {
            place.copy_from_slice(&header);
        }
        let checksum = checksum(&bytes).to_le_bytes();
        if let Some(place) = bytes.get_mut(4..8) {
            place.copy_from_slice(&checksum);
        }
        Ok(bytes)
    }
}

impl Header {
    /// Reads a header. `None` if no header can look like this.
    pub(crate) fn read(bytes: &[u8; HEADER_LEN]) -> Option<Self> {
        let word = |at: usize| {
            let word = bytes.get(at..)?.first_chunk::<4>()?;
            Some(u32::from_le_bytes(*word))
        };
        let header = Self {
            stored: word(0)?,
            checksum: word(4)?,
            kind: Kind::ALL.get(usize::from(*bytes.get(8)?)).copied(),
            begin: word(9)?,
            end: word(13)?,
        };
        // A power cut may leave zeros, and no content is stored as nothing.
        let is_possible = (1..=MAX_STORED).contains(&header.stored) && header.begin <= header.end;
        is_possible.then_some(header)
    }

    /// Returns whether the checksum matches. `bytes` begin with the header.
    pub(crate) fn is_undamaged(&self, bytes: &[u8]) -> bool {
        checksum(bytes) == self.checksum
    }

    /// Returns the block of this header and what is stored behind it; `None` if it is damaged.
    /// `bytes` begin with the header.
    pub(crate) fn block(&self, bytes: &[u8]) -> Option<Block> {
        if !self.is_undamaged(bytes) {
            return None;
        }
        let mut content = Vec::new();
        let decoder = DeflateDecoder::new(bytes.get(HEADER_LEN..)?);
        decoder.take(MAX_CONTENT).read_to_end(&mut content).ok()?;
        Some(Block {
            kind: self.kind?,
            begin: self.begin,
            end: self.end,
            content,
        })
    }
}

/// Returns the checksum of a stored block, without the checksum itself.
fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes.get(..4).unwrap_or_default());
    crc.update(bytes.get(8..).unwrap_or_default());
    crc.sum()
}
