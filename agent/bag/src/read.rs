//! Reads MCAP files by their summary, or record by record without one.
//!
//! A file that was never finished is read to its last record, including the truncated chunk. Memory
//! is bounded by the largest record, and by a factor of the file's size for compressed content.
//! Lengths are not trusted, and nothing is written.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek as _, SeekFrom};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use ros2probe_wire::{ExpandsTooFar, Expansion};

use super::mcap::{
    self, Channel, Chunk, ChunkIndex, Footer, Message, Metadata, Opcode, RECORD_HEADER, Schema,
    Statistics,
};
use super::{Compression, open_file};

/// Maximum length of a record, in bytes; a larger length is damage.
pub(super) const MAX_RECORD: u64 = 1 << 30;
/// Maximum factor by which a file may expand beyond [`Expansion::FREE_BYTES`]. Recordings stay far
/// below: a few megabytes of the same byte are rare.
const EXPANSION_FACTOR: u64 = 1024;
/// Maximum factor by which one chunk or record may expand, since all of it is in memory.
const EXPANSION_FACTOR_IN_MEMORY: u64 = 16;

/// Content of a file.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Contents {
    /// Profile: `ros2`.
    pub profile: String,
    /// Schemas by id.
    pub schemas: BTreeMap<u16, Schema>,
    /// Channels by id.
    pub channels: BTreeMap<u16, Channel>,
    /// Number of messages per channel.
    pub counts: BTreeMap<u16, u64>,
    /// Earliest and latest log time.
    pub times: Option<(u64, u64)>,
    /// Metadata records in order.
    pub metadata: Vec<Metadata>,
}

/// Result of reading a file record by record.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Scan {
    /// Content; messages of a truncated chunk are in [`Self::cut`] only.
    pub contents: Contents,
    /// Bytes of messages per channel.
    pub sizes: BTreeMap<u16, u64>,
    /// Whether the data section is complete.
    pub is_ended: bool,
    /// Whether the visitor ended the reading.
    pub(super) is_stopped: bool,
    /// End of the data section's last complete record.
    pub end: u64,
    /// Chunks of the data section, as in an index.
    pub chunks: Vec<ChunkIndex>,
    /// Offset and length of each metadata record.
    pub metadata_places: Vec<(u64, u64)>,
    /// All message indexes of the last chunk, if the file ends before one of them.
    pub last_chunk_index: BTreeMap<u16, Vec<(u64, u64)>>,
    /// Complete records at the beginning of a truncated chunk.
    pub cut: Vec<u8>,
    /// Number of chunks that cannot be decompressed or parsed.
    pub unreadable_chunks: u64,
}

/// Why a file cannot be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The file does not exist, or cannot be opened or read.
    #[error("cannot read {}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The file does not begin with MCAP's magic.
    #[error("{} is not an MCAP file", .0.display())]
    NotMcap(PathBuf),
}

impl Contents {
    /// Reads the summary at the file's end; `None` if it is missing or incomplete.
    pub fn of_summary(path: &Path) -> Result<Option<Self>, ReadError> {
        let wrong = |source| ReadError::Io {
            path: path.to_owned(),
            source,
        };
        let mut file = open_file(path).map_err(wrong)?;
        let mut magic = [0; mcap::MAGIC.len()];
        if file.read_exact(&mut magic).is_err() || magic != mcap::MAGIC {
            return Err(ReadError::NotMcap(path.to_owned()));
        }
        read_summary(&mut file).map_err(wrong)
    }

    /// Reads the summary, or all records of a file without a summary.
    pub fn of_file(path: &Path, expansion: Expansion) -> Result<Self, ReadError> {
        if compression(path) == Compression::None
            && let Some(contents) = Self::of_summary(path)?
        {
            return Ok(contents);
        }
        Ok(scan_with_cut(path, expansion, &mut |_, _| ControlFlow::Continue(()))?.contents)
    }

    /// Returns the number of messages of all channels, saturating: a summary may contain any
    /// numbers.
    pub(super) fn messages(&self) -> u64 {
        self.counts
            .values()
            .fold(0, |sum, count| sum.saturating_add(*count))
    }

    pub(super) fn take(&mut self, opcode: Opcode, content: &[u8]) {
        match opcode {
            Opcode::SCHEMA => {
                if let Some(schema) = Schema::read(content) {
                    self.schemas.insert(schema.id, schema);
                }
            }
            Opcode::CHANNEL => {
                if let Some(channel) = Channel::read(content) {
                    self.channels.insert(channel.id, channel);
                }
            }
            Opcode::METADATA => self.metadata.extend(Metadata::read(content)),
            _ => {}
        }
    }

    fn count(&mut self, message: &Message<'_>) {
        *self.counts.entry(message.channel_id).or_default() += 1;
        let at = message.log_time;
        let (start, end) = self.times.unwrap_or((at, at));
        self.times = Some((start.min(at), end.max(at)));
    }
}

fn read_summary(file: &mut File) -> io::Result<Option<Contents>> {
    let length = file.metadata()?.len();
    let tail = (Footer::LENGTH + mcap::MAGIC.len()) as u64;
    if length < tail {
        return Ok(None);
    }
    let bytes = read_at(file, length - tail, tail)?;
    let footer = match mcap::next_record(&bytes) {
        Some((Opcode::FOOTER, content, rest)) if rest == mcap::MAGIC => Footer::read(content),
        _ => None,
    };
    let Some(footer) = footer.filter(|footer| (1..=length - tail).contains(&footer.summary_start))
    else {
        return Ok(None);
    };
    let summary_length = length - tail - footer.summary_start;
    if summary_length > MAX_RECORD {
        return Ok(None);
    }
    let summary = read_at(file, footer.summary_start, summary_length)?;
    let mut contents = Contents::default();
    let mut statistics = None;
    let mut metadata = Vec::new();
    let mut rest = summary.as_slice();
    while let Some((opcode, content, after)) = mcap::next_record(rest) {
        rest = after;
        match opcode {
            Opcode::STATISTICS => statistics = Statistics::read(content),
            Opcode::METADATA_INDEX => metadata.extend(mcap::read_metadata_index(content)),
            _ => contents.take(opcode, content),
        }
    }
    let Some(statistics) = statistics.filter(|_| rest.is_empty()) else {
        return Ok(None);
    };
    let times = (statistics.start, statistics.end);
    contents.times = (statistics.message_count > 0).then_some(times);
    contents.counts = statistics.channel_message_counts;
    for (offset, record_length) in metadata {
        if offset
            .checked_add(record_length)
            .is_some_and(|end| end <= length)
            && record_length <= MAX_RECORD
            && let Some((Opcode::METADATA, content, _)) =
                mcap::next_record(&read_at(file, offset, record_length)?)
        {
            contents.take(Opcode::METADATA, content);
        }
    }
    Ok(Some(contents))
}

fn read_at(file: &mut File, offset: u64, length: u64) -> io::Result<Vec<u8>> {
    file.seek(SeekFrom::Start(offset))?;
    let mut bytes = Vec::new();
    file.take(length).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Called for every message, with the content read before it.
pub type Visitor<'a> = dyn FnMut(&Message<'_>, &Contents) + 'a;
/// A [`Visitor`] that may end the reading.
pub(super) type StoppingVisitor<'a> = dyn FnMut(&Message<'_>, &Contents) -> ControlFlow<()> + 'a;

/// Reads a file record by record, decompressing `.zstd` and `.lz4`.
pub fn scan(path: &Path, expansion: Expansion, each: &mut Visitor<'_>) -> Result<Scan, ReadError> {
    scan_until(path, expansion, &mut |message, contents| {
        each(message, contents);
        ControlFlow::Continue(())
    })
}

/// Does the same as [`scan`], until the visitor breaks.
fn scan_until(
    path: &Path,
    expansion: Expansion,
    each: &mut StoppingVisitor<'_>,
) -> Result<Scan, ReadError> {
    let wrong = |source| ReadError::Io {
        path: path.to_owned(),
        source,
    };
    let file = open_file(path).map_err(wrong)?;
    let length = file.metadata().map_err(wrong)?.len();
    let expands = expansion.limit(length, EXPANSION_FACTOR);
    let compression = compression(path);
    let reader = compression.reader(BufReader::with_capacity(1 << 16, file));
    let mut records = Records {
        reader: reader.map_err(wrong)?,
        position: 0,
        left: match compression {
            Compression::None => u64::MAX,
            Compression::Lz4 | Compression::Zstd => expands,
        },
        expands,
        expansion,
        in_memory: match compression {
            Compression::None => u64::MAX,
            Compression::Lz4 | Compression::Zstd => {
                expansion.limit(length, EXPANSION_FACTOR_IN_MEMORY)
            }
        },
    };
    let mut magic = Vec::new();
    records
        .read(mcap::MAGIC.len() as u64, &mut magic)
        .map_err(wrong)?;
    if magic != mcap::MAGIC {
        return Err(ReadError::NotMcap(path.to_owned()));
    }
    scan_records(&mut records, each).map_err(wrong)
}

/// Does the same as [`scan`] until the visitor breaks, but also visits the messages at the beginning
/// of a truncated chunk.
pub(super) fn scan_with_cut(
    path: &Path,
    expansion: Expansion,
    each: &mut StoppingVisitor<'_>,
) -> Result<Scan, ReadError> {
    let mut scan = scan_until(path, expansion, each)?;
    let cut = std::mem::take(&mut scan.cut);
    if !scan.is_stopped {
        take_chunk(&cut, &mut scan, each);
    }
    Ok(scan)
}

/// Returns the compression of the whole file, by its name.
pub(super) fn compression(path: &Path) -> Compression {
    let suffix = path.extension().and_then(|suffix| suffix.to_str());
    suffix.and_then(Compression::named).unwrap_or_default()
}

fn scan_records(records: &mut Records<'_>, each: &mut StoppingVisitor<'_>) -> io::Result<Scan> {
    let mut scan = Scan {
        end: records.position,
        ..Scan::default()
    };
    // Indexes of the last chunk, until the next record of another kind.
    let mut indexed: Option<IndexedChunk> = None;
    let mut content = Vec::new();
    loop {
        let start = records.position;
        let whole = records.next(&mut content)?;
        let opcode = match whole {
            Next::Whole(opcode) => opcode,
            Next::Cut(Opcode::CHUNK) => {
                finish_chunk(indexed.take(), &mut scan, false);
                let limit = records.in_memory(content.len()).min(records.expands);
                scan.cut = whole_records(&content, limit);
                return Ok(scan);
            }
            Next::Cut(_) | Next::End => {
                finish_chunk(indexed.take(), &mut scan, true);
                return Ok(scan);
            }
        };
        if opcode == Opcode::MESSAGE_INDEX
            && let Some(indexed) = &mut indexed
            && let Some(channel) = content.first_chunk().copied().map(u16::from_le_bytes)
        {
            indexed.offsets.insert(channel, start);
            indexed.length += records.position - start;
            scan.end = records.position;
            continue;
        }
        // After a loss of power, unwritten parts may be zeros.
        let at_end = matches!(opcode, Opcode(0) | Opcode::DATA_END | Opcode::FOOTER);
        finish_chunk(indexed.take(), &mut scan, at_end);
        match opcode {
            Opcode::CHUNK => {
                let Some(chunk) = Chunk::read(&content) else {
                    return Ok(scan);
                };
                let in_memory = records.in_memory(chunk.records.len());
                let left = &mut records.expands;
                let index = read_chunk(&chunk, in_memory, left, &mut scan, each)?;
                indexed = Some(IndexedChunk::new(&chunk, start, records.position, index));
            }
            Opcode::MESSAGE => {
                if let Some(message) = Message::read(&content) {
                    take_message(&message, &mut scan, each);
                }
            }
            Opcode::METADATA => {
                scan.metadata_places.push((start, records.position - start));
                scan.contents.take(opcode, &content);
            }
            Opcode::DATA_END => {
                scan.is_ended = true;
                return Ok(scan);
            }
            Opcode::HEADER => {
                scan.contents.profile = mcap::read_header(&content).unwrap_or_default();
            }
            // These records do not belong to a data section: no record follows.
            Opcode(0) | Opcode::FOOTER => return Ok(scan),
            _ => scan.contents.take(opcode, &content),
        }
        scan.end = records.position;
        if scan.is_stopped {
            return Ok(scan);
        }
    }
}

/// A chunk whose message indexes are being read.
struct IndexedChunk {
    chunk: ChunkIndex,
    offsets: BTreeMap<u16, u64>,
    length: u64,
    /// Expected content of its message indexes.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl IndexedChunk {
    /// Creates the entry of a chunk whose record extends from `start` to `end`, before its message
    /// indexes.
    fn new(chunk: &Chunk<'_>, start: u64, end: u64, index: BTreeMap<u16, Vec<(u64, u64)>>) -> Self {
        Self {
            chunk: ChunkIndex {
                start: chunk.start,
                end: chunk.end,
                offset: start,
                length: end - start,
                message_indexes: BTreeMap::new(),
                message_indexes_length: 0,
                compression: chunk.compression.to_owned(),
                compressed_size: chunk.records.len() as u64,
                uncompressed_size: chunk.uncompressed_size,
            },
            offsets: BTreeMap::new(),
            length: 0,
            index,
        }
    }
}

/// Completes the last chunk. If the file ends here (`at_end`), missing indexes can still be
/// written.
fn finish_chunk(indexed: Option<IndexedChunk>, scan: &mut Scan, at_end: bool) {
    let Some(mut indexed) = indexed else {
        return;
    };
    if at_end && indexed.offsets.len() < indexed.index.len() {
        // All indexes are written again after the chunk.
        scan.end = indexed.chunk.offset + indexed.chunk.length;
        scan.last_chunk_index = indexed.index;
    } else {
        indexed.chunk.message_indexes = indexed.offsets;
        indexed.chunk.message_indexes_length = indexed.length;
    }
    scan.chunks.push(indexed.chunk);
}

/// Reads a chunk and subtracts its expanded size from `left`. Fails if the chunk expands beyond
/// `left` or beyond `in_memory`.
fn read_chunk(
    chunk: &Chunk<'_>,
    in_memory: u64,
    left: &mut u64,
    scan: &mut Scan,
    each: &mut StoppingVisitor<'_>,
) -> io::Result<BTreeMap<u16, Vec<(u64, u64)>>> {
    let records = match Compression::named(chunk.compression) {
        Some(Compression::None) => return Ok(take_chunk(chunk.records, scan, each)),
        Some(compression) => {
            let limit = chunk.uncompressed_size.min(*left).min(in_memory);
            let records = compression.decompressed(chunk.records, limit);
            let expanded = records
                .as_ref()
                .map_or(limit, |records| records.len() as u64);
            *left = left.saturating_sub(expanded);
            if records.is_err() && limit < chunk.uncompressed_size {
                return Err(expands_too_far(match limit == in_memory {
                    true => EXPANSION_FACTOR_IN_MEMORY,
                    false => EXPANSION_FACTOR,
                }));
            }
            records
        }
        None => Err(io::ErrorKind::Unsupported.into()),
    };
    Ok(match records {
        Ok(records) => take_chunk(&records, scan, each),
        Err(_) => {
            scan.unreadable_chunks += 1;
            BTreeMap::new()
        }
    })
}

fn expands_too_far(factor: u64) -> io::Error {
    io::Error::new(io::ErrorKind::FileTooLarge, ExpandsTooFar(factor))
}

/// Adds a chunk's records, and returns its expected message indexes.
fn take_chunk(
    records: &[u8],
    scan: &mut Scan,
    each: &mut StoppingVisitor<'_>,
) -> BTreeMap<u16, Vec<(u64, u64)>> {
    let mut index: BTreeMap<u16, Vec<(u64, u64)>> = BTreeMap::new();
    let mut rest = records;
    while let Some((opcode, content, after)) = mcap::next_record(rest) {
        let offset = (records.len() - rest.len()) as u64;
        rest = after;
        if opcode != Opcode::MESSAGE {
            scan.contents.take(opcode, content);
        } else if let Some(message) = Message::read(content) {
            let entries = index.entry(message.channel_id).or_default();
            entries.push((message.log_time, offset));
            take_message(&message, scan, each);
            if scan.is_stopped {
                return index;
            }
        }
    }
    if !rest.is_empty() {
        scan.unreadable_chunks += 1;
    }
    index
}

fn take_message(message: &Message<'_>, scan: &mut Scan, each: &mut StoppingVisitor<'_>) {
    scan.contents.count(message);
    *scan.sizes.entry(message.channel_id).or_default() += message.data.len() as u64;
    scan.is_stopped |= each(message, &scan.contents).is_break();
}

/// Returns the complete records at the beginning of a truncated chunk's record.
fn whole_records(content: &[u8], limit: u64) -> Vec<u8> {
    let Some((compression, records)) = mcap::cut_chunk(content) else {
        return Vec::new();
    };
    let mut bytes = Vec::new();
    match Compression::named(compression) {
        Some(Compression::None) => bytes.extend_from_slice(records),
        Some(compression) => {
            if let Ok(reader) = compression.reader(records) {
                // Reads up to the truncation, which is an error here.
                let _ = reader.take(limit).read_to_end(&mut bytes);
            }
        }
        None => {}
    }
    let mut rest = bytes.as_slice();
    while let Some((Opcode::SCHEMA | Opcode::CHANNEL | Opcode::MESSAGE, _, after)) =
        mcap::next_record(rest)
    {
        rest = after;
    }
    let whole = bytes.len() - rest.len();
    bytes.truncate(whole);
    bytes
}

/// Reads records one after the other.
struct Records<'a> {
    reader: Box<dyn Read + 'a>,
    position: u64,
    /// Bytes that may still be read.
    left: u64,
    /// Bytes to which compressed chunks may still expand.
    expands: u64,
    expansion: Expansion,
    /// Maximum size of a record of a file that is compressed as a whole, in bytes.
    in_memory: u64,
}

enum Next {
    Whole(Opcode),
    /// The file ends within this record; the available content was read.
    Cut(Opcode),
    End,
}

impl Records<'_> {
    /// Returns the number of bytes to which a chunk of this length may expand in memory.
    const fn in_memory(&self, length: usize) -> u64 {
        self.expansion
            .limit(length as u64, EXPANSION_FACTOR_IN_MEMORY)
    }

    fn next(&mut self, content: &mut Vec<u8>) -> io::Result<Next> {
        content.clear();
        let mut head = Vec::new();
        self.read(RECORD_HEADER as u64, &mut head)?;
        let Some((opcode, length)) = head.split_first() else {
            return Ok(Next::End);
        };
        let opcode = Opcode(*opcode);
        let Some(length) = length.first_chunk().copied().map(u64::from_le_bytes) else {
            return Ok(Next::Cut(Opcode(0)));
        };
        if length > MAX_RECORD {
            return Ok(Next::Cut(Opcode(0)));
        }
        let read = self.read(length, content)?;
        Ok(if read == length {
            Next::Whole(opcode)
        } else {
            Next::Cut(opcode)
        })
    }

    /// Reads at most `length` bytes, allocating as they arrive. A truncated compressed stream is
    /// not an error.
    fn read(&mut self, length: u64, into: &mut Vec<u8>) -> io::Result<u64> {
        let before = into.len();
        let limit = length.min(self.left).min(self.in_memory);
        let result = (&mut self.reader).take(limit).read_to_end(into);
        let read = (into.len() - before) as u64;
        self.position += read;
        self.left -= read;
        if read < length && read == self.in_memory {
            return Err(expands_too_far(EXPANSION_FACTOR_IN_MEMORY));
        }
        if read < length && self.left == 0 {
            return Err(expands_too_far(EXPANSION_FACTOR));
        }
        match result {
            Err(error)
                if !matches!(
                    error.kind(),
                    io::ErrorKind::UnexpectedEof
                        | io::ErrorKind::Other
                        | io::ErrorKind::InvalidData
                ) =>
            {
                Err(error)
            }
            _ => Ok(read),
        }
    }
}
