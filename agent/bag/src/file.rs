//! Writes one MCAP file: chunks, indexes, summary.
//!
//! Records have the same order as in rosbag2's files. A file grows by whole pieces only: an
//! incomplete write is truncated. Before a piece is written, space is reserved for it and for the
//! summary. A full disk is thus detected while the file can still be completed. This module knows
//! channels, but not the topics behind them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path, PathBuf};

use flate2::Crc;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::retry_on_intr;

use super::Compression;
use super::mcap::{
    self, Channel, Chunk, ChunkIndex, Footer, Message, Metadata, Opcode, Schema, Statistics,
};
use super::options::Storage;
use super::read::Scan;

/// Name of the writer in a file's header.
pub(super) const LIBRARY_NAME: &str = concat!("ros2probe ", env!("CARGO_PKG_VERSION"));
/// Name of the metadata records.
pub(super) const METADATA_NAME: &str = "rosbag2";
/// Size of the pieces in which records without chunks are written, in bytes.
const PIECE_BYTES: u64 = 256 << 10;
/// Space for metadata.yaml, its record, and the additions of the final report.
const SPARE_BYTES: u64 = 64 << 10;

/// A file that is being written.
#[derive(Debug)]
pub(super) struct FileWriter {
    path: PathBuf,
    file: File,
    storage: Storage,
    /// Length of the file in bytes; every record in it is complete.
    position: u64,
    /// Checksum of the file so far, if the options include it.
    data_crc: Option<Crc>,
    pending: Pending,
    schemas: BTreeMap<u16, Schema>,
    /// Channels with messages.
    channels: BTreeMap<u16, Channel>,
    chunk_indexes: Vec<u8>,
    /// Offset and length of each metadata record.
    metadata: Vec<(u64, u64)>,
    statistics: Statistics,
    /// Whether the file system can reserve space.
    reserves: bool,
    /// Whether an incomplete record may follow the complete ones.
    is_torn: bool,
}

/// Records that are not in the file yet: those of the current chunk, or records without chunks.
#[derive(Debug, Default)]
struct Pending {
    records: Vec<u8>,
    start: u64,
    end: u64,
    messages: u64,
    /// Log time and offset in the chunk of each message, per channel.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl FileWriter {
    /// Creates the file, which must not exist, and writes its first records.
    pub(super) fn create(path: &Path, storage: Storage, metadata: &Metadata) -> io::Result<Self> {
        let file = super::new_file(path)?;
        let mut writer = Self {
            path: path.to_owned(),
            file,
            storage,
            position: 0,
            data_crc: storage.data_crc.then(Crc::new),
            pending: Pending::default(),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            chunk_indexes: Vec::new(),
            metadata: Vec::new(),
            statistics: Statistics::default(),
            reserves: true,
            is_torn: false,
        };
        let mut begin = mcap::MAGIC.to_vec();
        mcap::header(&mut begin, "ros2", LIBRARY_NAME);
        writer.reserve(0)?;
        writer.append(&[&begin])?;
        writer.write_metadata(metadata)?;
        Ok(writer)
    }

    /// Creates `path` with the complete records of `source`, so that writing can continue.
    pub(super) fn resume(path: &Path, source: &mut File, scan: &Scan) -> io::Result<Self> {
        source.rewind()?;
        let mut file = super::new_file(path)?;
        let copied = io::copy(&mut source.take(scan.end), &mut file)?;
        if copied != scan.end {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let contents = &scan.contents;
        let (start, end) = contents.times.unwrap_or_default();
        let mut writer = Self {
            path: path.to_owned(),
            file,
            storage: Storage {
                chunked: !scan.chunks.is_empty() || contents.counts.is_empty(),
                compression: Compression::None,
                ..Storage::default()
            },
            position: copied,
            data_crc: None,
            pending: Pending::default(),
            schemas: contents.schemas.clone(),
            channels: contents.channels.clone(),
            chunk_indexes: Vec::new(),
            metadata: scan.metadata_places.clone(),
            statistics: Statistics {
                message_count: contents.counts.values().sum(),
                metadata_count: u32::try_from(scan.metadata_places.len()).unwrap_or(u32::MAX),
                chunk_count: u32::try_from(scan.chunks.len()).unwrap_or(u32::MAX),
                start,
                end,
                channel_message_counts: contents.counts.clone(),
                ..Statistics::default()
            },
            reserves: true,
            is_torn: false,
        };
        let (last, before) = match scan.chunks.split_last() {
            Some((last, before)) => (Some(last.clone()), before),
            None => (None, &[][..]),
        };
        before
            .iter()
            .for_each(|chunk| chunk.write(&mut writer.chunk_indexes));
        if let Some(mut last) = last {
            let mut indexes = Vec::new();
            for (channel, entries) in &scan.last_chunk_index {
                let offset = writer.position + indexes.len() as u64;
                last.message_indexes.insert(*channel, offset);
                mcap::message_index(&mut indexes, *channel, entries);
            }
            last.message_indexes_length += indexes.len() as u64;
            writer.append(&[&indexes])?;
            last.write(&mut writer.chunk_indexes);
        }
        Ok(writer)
    }

    /// Accepts one message. If it fails, the message was not accepted; earlier messages are in the
    /// file or still pending.
    pub(super) fn write(
        &mut self,
        message: &Message<'_>,
        channel: impl FnOnce() -> (Schema, Channel),
    ) -> io::Result<()> {
        // A large message is written directly, without another copy in memory.
        let is_large = self.storage.compression == Compression::None
            && message.data.len() as u64 >= self.piece_bytes();
        if self.pending.records.len() as u64 >= self.piece_bytes()
            || is_large && self.pending.messages > 0
        {
            self.write_pending(&[])?;
        }
        if !self.channels.contains_key(&message.channel_id) {
            let (schema, channel) = channel();
            if !self.schemas.contains_key(&schema.id) {
                schema.write(&mut self.pending.records);
                self.schemas.insert(schema.id, schema);
            }
            channel.write(&mut self.pending.records);
            self.channels.insert(channel.id, channel);
        }
        let pending = &mut self.pending;
        let offset = pending.records.len() as u64;
        if is_large {
            message.write_head(&mut pending.records);
        } else {
            message.write(&mut pending.records);
        }
        if pending.messages == 0 {
            (pending.start, pending.end) = (message.log_time, message.log_time);
        }
        pending.start = pending.start.min(message.log_time);
        pending.end = pending.end.max(message.log_time);
        pending.messages += 1;
        let index = pending.index.entry(message.channel_id).or_default();
        index.push((message.log_time, offset));
        if !is_large {
            return Ok(());
        }
        let written = self.write_pending(message.data);
        if written.is_err() {
            // The channel's record stays pending for the next attempt.
            let mut records = std::mem::take(&mut self.pending.records);
            records.truncate(usize::try_from(offset).unwrap_or(usize::MAX));
            self.pending = Pending {
                records,
                ..Pending::default()
            };
        }
        written
    }

    /// Writes all accepted messages to the system, where they survive the end of this process.
    pub(super) fn flush(&mut self) -> io::Result<()> {
        if self.pending.records.is_empty() {
            return Ok(());
        }
        self.write_pending(&[])
    }

    /// Waits until all flushed data is on disk, where it survives a loss of power.
    pub(super) fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// Appends a metadata record after all accepted messages.
    pub(super) fn write_metadata(&mut self, metadata: &Metadata) -> io::Result<()> {
        self.flush()?;
        let mut record = Vec::new();
        metadata.write(&mut record);
        let at = (self.position, record.len() as u64);
        self.append(&[&record])?;
        self.metadata.push(at);
        self.statistics.metadata_count += 1;
        Ok(())
    }

    /// Discards the pending messages, and returns their number and bytes per channel.
    pub(super) fn discard(&mut self) -> BTreeMap<u16, (u64, u64)> {
        let pending = std::mem::take(&mut self.pending);
        let length = |offset: u64| {
            let records = pending.records.get(usize::try_from(offset).ok()?..)?;
            let (_, content, _) = mcap::next_record(records)?;
            Some(Message::read(content)?.data.len() as u64)
        };
        let counts = pending.index.iter().map(|(channel, index)| {
            let lengths = index.iter().filter_map(|(_, offset)| length(*offset));
            (*channel, (index.len() as u64, lengths.sum()))
        });
        counts.collect()
    }

    /// Writes the summary and the footer. `channels` are all known channels, including those
    /// without messages.
    pub(super) fn finish(
        &mut self,
        channels: impl Iterator<Item = (Schema, Channel)>,
    ) -> io::Result<()> {
        self.flush()?;
        for (schema, channel) in channels {
            if !self.channels.contains_key(&channel.id) {
                self.schemas.entry(schema.id).or_insert(schema);
                self.channels.insert(channel.id, channel);
            }
        }
        let mut end = Vec::new();
        let data_crc = self.data_crc.as_ref().map_or(0, Crc::sum);
        mcap::data_end(&mut end, data_crc);
        let summary = self.summary(self.position + end.len() as u64);
        end.extend_from_slice(&summary);
        end.extend_from_slice(&mcap::MAGIC);
        self.append(&[&end])?;
        // Releases the space reserved after the end.
        self.file.set_len(self.position)
    }

    /// Returns the length of the file in bytes.
    pub(super) fn position(&self) -> u64 {
        self.position
    }

    /// Returns the length of the file, plus the pending bytes if their size in the file is known.
    pub(super) fn expected_bytes(&self) -> u64 {
        match self.storage.compression {
            Compression::None => self.position + self.pending.records.len() as u64,
            _ => self.position,
        }
    }

    /// Returns the size of the chunk index in memory, in bytes.
    pub(super) fn index_bytes(&self) -> u64 {
        self.chunk_indexes.len() as u64
    }

    /// Returns the number of accepted messages.
    pub(super) fn messages(&self) -> u64 {
        self.statistics.message_count + self.pending.messages
    }

    /// Returns the number of messages in the file, per channel.
    pub(super) fn counts(&self) -> &BTreeMap<u16, u64> {
        &self.statistics.channel_message_counts
    }

    /// Returns the earliest and latest log time, including pending messages; `None` without
    /// messages.
    pub(super) fn times(&self) -> Option<(u64, u64)> {
        let written = self.statistics.message_count > 0;
        let written = written.then_some((self.statistics.start, self.statistics.end));
        let waiting = self.pending.messages > 0;
        let waiting = waiting.then_some((self.pending.start, self.pending.end));
        match (written, waiting) {
            (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
            (one, other) => one.or(other),
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    fn piece_bytes(&self) -> u64 {
        if self.storage.chunked {
            self.storage.chunk_bytes
        } else {
            PIECE_BYTES
        }
    }

    /// Writes the pending records. `tail` is the data of the last message if the records lack it.
    fn write_pending(&mut self, tail: &[u8]) -> io::Result<()> {
        // The records are taken out for the write, and restored if it fails.
        let mut pending = std::mem::take(&mut self.pending);
        let written = if self.storage.chunked {
            self.write_chunk(&pending, tail)
        } else {
            let reserved = self.reserve((pending.records.len() + tail.len()) as u64);
            reserved.and_then(|()| self.append(&[&pending.records, tail]))
        };
        if let Err(error) = written {
            self.pending = pending;
            return Err(error);
        }
        let statistics = &mut self.statistics;
        if pending.messages > 0 {
            if statistics.message_count == 0 {
                (statistics.start, statistics.end) = (pending.start, pending.end);
            }
            statistics.start = statistics.start.min(pending.start);
            statistics.end = statistics.end.max(pending.end);
            statistics.message_count += pending.messages;
        }
        for (channel, index) in &pending.index {
            let count = statistics
                .channel_message_counts
                .entry(*channel)
                .or_default();
            *count += index.len() as u64;
        }
        // The buffer is reused, except for the memory of an unusually large message.
        pending.records.clear();
        let usual = usize::try_from(self.piece_bytes()).unwrap_or(usize::MAX);
        pending.records.shrink_to(usual.saturating_mul(2));
        self.pending.records = pending.records;
        Ok(())
    }

    fn write_chunk(&mut self, pending: &Pending, tail: &[u8]) -> io::Result<()> {
        let compressed = match tail {
            [] => self.storage.compression.compressed(&pending.records),
            _ => None,
        };
        let compression = match &compressed {
            Some(_) => self.storage.compression.name(),
            None => "",
        };
        let records = compressed.as_deref().unwrap_or(&pending.records);
        let mut uncompressed_crc = Crc::new();
        if self.storage.chunk_crc {
            uncompressed_crc.update(&pending.records);
            uncompressed_crc.update(tail);
        }
        let chunk = Chunk {
            start: pending.start,
            end: pending.end,
            uncompressed_size: (pending.records.len() + tail.len()) as u64,
            uncompressed_crc: uncompressed_crc.sum(),
            compression,
            records,
        };
        let mut head = Vec::with_capacity(64);
        chunk.write_head(&mut head, tail.len());
        let length = (head.len() + records.len() + tail.len()) as u64;
        let (mut indexes, mut offsets) = (Vec::new(), BTreeMap::new());
        for (channel, entries) in &pending.index {
            offsets.insert(*channel, self.position + length + indexes.len() as u64);
            mcap::message_index(&mut indexes, *channel, entries);
        }
        let index = ChunkIndex {
            start: chunk.start,
            end: chunk.end,
            offset: self.position,
            length,
            message_indexes: offsets,
            message_indexes_length: indexes.len() as u64,
            compression: compression.to_owned(),
            compressed_size: (records.len() + tail.len()) as u64,
            uncompressed_size: chunk.uncompressed_size,
        };
        self.reserve(length + index.message_indexes_length)?;
        self.append(&[&head, records, tail, &indexes])?;
        index.write(&mut self.chunk_indexes);
        self.statistics.chunk_count += 1;
        Ok(())
    }

    /// Appends all pieces or none.
    fn append(&mut self, pieces: &[&[u8]]) -> io::Result<()> {
        let length: u64 = pieces.iter().map(|piece| piece.len() as u64).sum();
        if self.is_torn {
            self.truncate()?;
        }
        for piece in pieces {
            if let Err(error) = self.file.write_all(piece) {
                // A failing disk may also refuse the truncation. The next write then repeats it.
                self.is_torn = true;
                let _ = self.truncate();
                return Err(error);
            }
        }
        if let Some(crc) = &mut self.data_crc {
            pieces.iter().for_each(|piece| crc.update(piece));
        }
        self.position += length;
        Ok(())
    }

    /// Truncates the file to the last complete record.
    fn truncate(&mut self) -> io::Result<()> {
        self.file.set_len(self.position)?;
        self.file.seek(io::SeekFrom::Start(self.position))?;
        self.is_torn = false;
        Ok(())
    }

    /// Reserves space for `length` more bytes and for the end of the file.
    fn reserve(&mut self, length: u64) -> io::Result<()> {
        if !self.reserves {
            return Ok(());
        }
        let definitions = self.schemas.values().map(|schema| schema.data.len() + 64);
        let channels = self.channels.values().map(|channel| {
            let metadata = channel.metadata.values().map(String::len);
            metadata.sum::<usize>() + channel.topic.len() + 128
        });
        // Channels are repeated in metadata.yaml and in its record.
        let channels = channels.sum::<usize>() * 3;
        let summary = definitions.sum::<usize>() + channels + self.chunk_indexes.len();
        match allocate(
            &self.file,
            self.position,
            length + summary as u64 + SPARE_BYTES,
        ) {
            Ok(()) => Ok(()),
            Err(error) => match error.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Err(error),
                _ => {
                    self.reserves = false;
                    Ok(())
                }
            },
        }
    }

    /// Returns the summary: schemas, channels, statistics, indexes, offsets of these groups,
    /// footer.
    fn summary(&self, start: u64) -> Vec<u8> {
        let mut out = Vec::new();
        let mut groups = Vec::new();
        let mut group = |out: &mut Vec<u8>, opcode: Opcode, write: &dyn Fn(&mut Vec<u8>)| {
            let from = out.len() as u64;
            write(out);
            let length = out.len() as u64 - from;
            if length > 0 {
                groups.push((opcode, start + from, length));
            }
        };
        group(&mut out, Opcode::SCHEMA, &|out| {
            self.schemas.values().for_each(|schema| schema.write(out));
        });
        group(&mut out, Opcode::CHANNEL, &|out| {
            self.channels
                .values()
                .for_each(|channel| channel.write(out));
        });
        group(&mut out, Opcode::STATISTICS, &|out| {
            self.statistics().write(out);
        });
        group(&mut out, Opcode::CHUNK_INDEX, &|out| {
            out.extend_from_slice(&self.chunk_indexes);
        });
        group(&mut out, Opcode::METADATA_INDEX, &|out| {
            for (offset, length) in &self.metadata {
                mcap::metadata_index(out, *offset, *length, METADATA_NAME);
            }
        });
        let summary_offset_start = start + out.len() as u64;
        for (opcode, start, length) in groups {
            mcap::summary_offset(&mut out, opcode, start, length);
        }
        let footer = Footer {
            summary_start: start,
            summary_offset_start,
            summary_crc: 0,
        };
        footer.write_without_crc(&mut out);
        let mut crc = Crc::new();
        if self.storage.summary_crc {
            crc.update(&out);
        }
        out.extend_from_slice(&crc.sum().to_le_bytes());
        out
    }

    fn statistics(&self) -> Statistics {
        let counts = &self.statistics.channel_message_counts;
        let used = counts.keys().filter_map(|id| self.channels.get(id));
        let mut schemas: Vec<u16> = used.map(|channel| channel.schema_id).collect();
        schemas.sort_unstable();
        schemas.dedup();
        Statistics {
            schema_count: u16::try_from(schemas.len()).unwrap_or(u16::MAX),
            channel_count: u32::try_from(counts.len()).unwrap_or(u32::MAX),
            ..self.statistics.clone()
        }
    }
}

/// Reserves space after `offset` without changing the file's length.
fn allocate(file: &File, offset: u64, length: u64) -> io::Result<()> {
    retry_on_intr(|| fallocate(file, FallocateFlags::KEEP_SIZE, offset, length))?;
    Ok(())
}
