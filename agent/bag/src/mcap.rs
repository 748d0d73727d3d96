//! Encoding and decoding of MCAP records (MCAP specification, "Records").
//!
//! This module exists because chunks must be compressed without C, ended when a recording is
//! flushed, and read from unfinished files. It knows neither files nor ROS. Decoding is bounded: a
//! length is accepted only if its bytes exist.

mod fields;

use std::collections::BTreeMap;

use fields::{Cursor, length, numbers, text, texts};

/// Bytes at the start and at the end of a file.
pub const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Length of a record's header: its opcode and its length.
pub const RECORD_HEADER: usize = 9;

/// Kind of a record.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub struct Opcode(pub u8);

#[expect(missing_docs, reason = "the names are those of the specification")]
impl Opcode {
    pub const HEADER: Self = Self(0x01);
    pub const FOOTER: Self = Self(0x02);
    pub const SCHEMA: Self = Self(0x03);
    pub const CHANNEL: Self = Self(0x04);
    pub const MESSAGE: Self = Self(0x05);
    pub const CHUNK: Self = Self(0x06);
    pub const MESSAGE_INDEX: Self = Self(0x07);
    pub const CHUNK_INDEX: Self = Self(0x08);
    pub const STATISTICS: Self = Self(0x0b);
    pub const METADATA: Self = Self(0x0c);
    pub const METADATA_INDEX: Self = Self(0x0d);
    pub const SUMMARY_OFFSET: Self = Self(0x0e);
    pub const DATA_END: Self = Self(0x0f);
}

/// Writes one record: its header, then the output of `content`.
pub fn record(out: &mut Vec<u8>, opcode: Opcode, content: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode.0);
    let length_at = out.len();
    out.extend_from_slice(&[0; 8]);
    let start = out.len();
    content(out);
    let length = (out.len() - start) as u64;
    if let Some(place) = out.get_mut(length_at..start) {
        place.copy_from_slice(&length.to_le_bytes());
    }
}

/// Definition of a message type.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Schema {
    /// Id in this file; never 0.
    pub id: u16,
    /// Name of the type: `pkg/msg/Type`.
    pub name: String,
    /// Encoding of the definition: `ros2msg`; empty if the definition is unknown (rosbag2 also
    /// writes `unknown`).
    pub encoding: String,
    /// Text of the definition.
    pub data: Vec<u8>,
}

/// A topic.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Channel {
    /// Id in this file.
    pub id: u16,
    /// Id of its schema; 0 for none.
    pub schema_id: u16,
    /// Name of the topic, with leading `/`.
    pub topic: String,
    /// Encoding of its messages: `cdr`.
    pub message_encoding: String,
    /// Metadata, sorted so that a channel always has the same bytes.
    pub metadata: BTreeMap<String, String>,
}

/// One message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Message<'a> {
    /// Id of its channel.
    pub channel_id: u16,
    /// The publisher's sequence number.
    pub sequence: u32,
    /// Time of reception, in nanoseconds since the epoch.
    pub log_time: u64,
    /// Time of sending, in nanoseconds since the epoch.
    pub publish_time: u64,
    /// Payload, including the encapsulation header.
    pub data: &'a [u8],
}

/// Header of a chunk, and its records.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Chunk<'a> {
    /// Earliest log time.
    pub start: u64,
    /// Latest log time.
    pub end: u64,
    /// Length of the records before compression.
    pub uncompressed_size: u64,
    /// Checksum of the records before compression; 0 for none.
    pub uncompressed_crc: u32,
    /// Compression: empty, `lz4` or `zstd`.
    pub compression: &'a str,
    /// The records, compressed.
    pub records: &'a [u8],
}

/// Position, time range and sizes of a chunk.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ChunkIndex {
    /// Earliest log time.
    pub start: u64,
    /// Latest log time.
    pub end: u64,
    /// Offset of the chunk's record.
    pub offset: u64,
    /// Length of the chunk's record, including its header.
    pub length: u64,
    /// Offset of each channel's message index.
    pub message_indexes: BTreeMap<u16, u64>,
    /// Length of all message indexes, including their headers.
    pub message_indexes_length: u64,
    /// Compression, as in the chunk.
    pub compression: String,
    /// Length of the compressed records.
    pub compressed_size: u64,
    /// Length of the records before compression.
    pub uncompressed_size: u64,
}

/// Statistics of a file.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Statistics {
    /// Number of messages.
    pub message_count: u64,
    /// Number of schemas.
    pub schema_count: u16,
    /// Number of channels with messages.
    pub channel_count: u32,
    /// Number of attachments; this crate writes none.
    pub attachment_count: u32,
    /// Number of metadata records.
    pub metadata_count: u32,
    /// Number of chunks.
    pub chunk_count: u32,
    /// Earliest log time, 0 without messages.
    pub start: u64,
    /// Latest log time, 0 without messages.
    pub end: u64,
    /// Number of messages, per channel with messages.
    pub channel_message_counts: BTreeMap<u16, u64>,
}

/// A named map.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Metadata {
    /// Name of the map: `rosbag2`.
    pub name: String,
    /// Entries of the map.
    pub entries: BTreeMap<String, String>,
}

/// Position of the summary.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Footer {
    /// Offset of the summary; 0 for none.
    pub summary_start: u64,
    /// Offset of the summary offsets; 0 for none.
    pub summary_offset_start: u64,
    /// Checksum of the summary; 0 for none.
    pub summary_crc: u32,
}

/// Appends the header, which is the first record of a file.
pub fn header(out: &mut Vec<u8>, profile: &str, library: &str) {
    record(out, Opcode::HEADER, |out| {
        text(out, profile);
        text(out, library);
    });
}

impl Schema {
    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        record(out, Opcode::SCHEMA, |out| {
            out.extend_from_slice(&self.id.to_le_bytes());
            text(out, &self.name);
            text(out, &self.encoding);
            length(out, self.data.len());
            out.extend_from_slice(&self.data);
        });
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            id: cursor.u16()?,
            name: cursor.text()?.to_owned(),
            encoding: cursor.text()?.to_owned(),
            data: cursor.sized()?.to_vec(),
        })
    }
}

impl Channel {
    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        record(out, Opcode::CHANNEL, |out| {
            out.extend_from_slice(&self.id.to_le_bytes());
            out.extend_from_slice(&self.schema_id.to_le_bytes());
            text(out, &self.topic);
            text(out, &self.message_encoding);
            texts(out, &self.metadata);
        });
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            id: cursor.u16()?,
            schema_id: cursor.u16()?,
            topic: cursor.text()?.to_owned(),
            message_encoding: cursor.text()?.to_owned(),
            metadata: cursor.texts()?,
        })
    }
}

impl<'a> Message<'a> {
    /// Bytes of a message's record in addition to its data.
    pub const OVERHEAD: usize = RECORD_HEADER + 22;

    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        out.reserve(Self::OVERHEAD + self.data.len());
        self.write_head(out);
        out.extend_from_slice(self.data);
    }

    /// Appends the record up to [`Self::data`], which the caller appends.
    pub fn write_head(&self, out: &mut Vec<u8>) {
        out.push(Opcode::MESSAGE.0);
        let content = Self::OVERHEAD - RECORD_HEADER + self.data.len();
        out.extend_from_slice(&(content as u64).to_le_bytes());
        out.extend_from_slice(&self.channel_id.to_le_bytes());
        out.extend_from_slice(&self.sequence.to_le_bytes());
        out.extend_from_slice(&self.log_time.to_le_bytes());
        out.extend_from_slice(&self.publish_time.to_le_bytes());
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &'a [u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            channel_id: cursor.u16()?,
            sequence: cursor.u32()?,
            log_time: cursor.u64()?,
            publish_time: cursor.u64()?,
            data: cursor.0,
        })
    }
}

impl<'a> Chunk<'a> {
    /// Appends the record up to [`Self::records`]. The caller appends the records and `more` bytes
    /// of further records.
    pub fn write_head(&self, out: &mut Vec<u8>, more: usize) {
        out.push(Opcode::CHUNK.0);
        let records = self.records.len() + more;
        let content = 8 * 3 + 4 + 4 + self.compression.len() + 8 + records;
        out.extend_from_slice(&(content as u64).to_le_bytes());
        out.extend_from_slice(&self.start.to_le_bytes());
        out.extend_from_slice(&self.end.to_le_bytes());
        out.extend_from_slice(&self.uncompressed_size.to_le_bytes());
        out.extend_from_slice(&self.uncompressed_crc.to_le_bytes());
        text(out, self.compression);
        out.extend_from_slice(&(records as u64).to_le_bytes());
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &'a [u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            start: cursor.u64()?,
            end: cursor.u64()?,
            uncompressed_size: cursor.u64()?,
            uncompressed_crc: cursor.u32()?,
            compression: cursor.text()?,
            records: {
                let length = cursor.u64()?;
                cursor.take(usize::try_from(length).ok()?)?
            },
        })
    }
}

/// Appends the index of one channel's messages in a chunk: log time and offset in the chunk.
pub fn message_index(out: &mut Vec<u8>, channel_id: u16, entries: &[(u64, u64)]) {
    record(out, Opcode::MESSAGE_INDEX, |out| {
        out.extend_from_slice(&channel_id.to_le_bytes());
        length(out, entries.len() * 16);
        for (log_time, offset) in entries {
            out.extend_from_slice(&log_time.to_le_bytes());
            out.extend_from_slice(&offset.to_le_bytes());
        }
    });
}

impl ChunkIndex {
    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        record(out, Opcode::CHUNK_INDEX, |out| {
            for value in [self.start, self.end, self.offset, self.length] {
                out.extend_from_slice(&value.to_le_bytes());
            }
            numbers(out, &self.message_indexes);
            out.extend_from_slice(&self.message_indexes_length.to_le_bytes());
            text(out, &self.compression);
            out.extend_from_slice(&self.compressed_size.to_le_bytes());
            out.extend_from_slice(&self.uncompressed_size.to_le_bytes());
        });
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            start: cursor.u64()?,
            end: cursor.u64()?,
            offset: cursor.u64()?,
            length: cursor.u64()?,
            message_indexes: cursor.numbers()?,
            message_indexes_length: cursor.u64()?,
            compression: cursor.text()?.to_owned(),
            compressed_size: cursor.u64()?,
            uncompressed_size: cursor.u64()?,
        })
    }
}

impl Statistics {
    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        record(out, Opcode::STATISTICS, |out| {
            out.extend_from_slice(&self.message_count.to_le_bytes());
            out.extend_from_slice(&self.schema_count.to_le_bytes());
            let counts = [
                self.channel_count,
                self.attachment_count,
                self.metadata_count,
                self.chunk_count,
            ];
            for count in counts {
                out.extend_from_slice(&count.to_le_bytes());
            }
            out.extend_from_slice(&self.start.to_le_bytes());
            out.extend_from_slice(&self.end.to_le_bytes());
            numbers(out, &self.channel_message_counts);
        });
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            message_count: cursor.u64()?,
            schema_count: cursor.u16()?,
            channel_count: cursor.u32()?,
            attachment_count: cursor.u32()?,
            metadata_count: cursor.u32()?,
            chunk_count: cursor.u32()?,
            start: cursor.u64()?,
            end: cursor.u64()?,
            channel_message_counts: cursor.numbers()?,
        })
    }
}

impl Metadata {
    /// Appends the record.
    pub fn write(&self, out: &mut Vec<u8>) {
        record(out, Opcode::METADATA, |out| {
            text(out, &self.name);
            texts(out, &self.entries);
        });
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            name: cursor.text()?.to_owned(),
            entries: cursor.texts()?,
        })
    }
}

/// Appends the index entry of a metadata record; `length` includes its header.
pub fn metadata_index(out: &mut Vec<u8>, offset: u64, length: u64, name: &str) {
    record(out, Opcode::METADATA_INDEX, |out| {
        out.extend_from_slice(&offset.to_le_bytes());
        out.extend_from_slice(&length.to_le_bytes());
        text(out, name);
    });
}

/// Parses a metadata index: offset and length of the record. `None` if it is malformed.
#[must_use]
pub fn read_metadata_index(content: &[u8]) -> Option<(u64, u64)> {
    let mut cursor = Cursor(content);
    Some((cursor.u64()?, cursor.u64()?))
}

/// Parses the header and returns its profile. `None` if it is malformed.
#[must_use]
pub fn read_header(content: &[u8]) -> Option<String> {
    Cursor(content).text().map(str::to_owned)
}

/// Parses a truncated chunk: its compression and the available records. `None` if it ends before
/// the records.
#[must_use]
pub fn cut_chunk(content: &[u8]) -> Option<(&str, &[u8])> {
    let mut cursor = Cursor(content);
    cursor.take(8 * 3 + 4)?;
    let compression = cursor.text()?;
    cursor.u64()?;
    Some((compression, cursor.0))
}

/// Appends the position of the summary's records of one kind.
pub fn summary_offset(out: &mut Vec<u8>, group: Opcode, start: u64, length: u64) {
    record(out, Opcode::SUMMARY_OFFSET, |out| {
        out.push(group.0);
        out.extend_from_slice(&start.to_le_bytes());
        out.extend_from_slice(&length.to_le_bytes());
    });
}

/// Appends the end of the data section.
pub fn data_end(out: &mut Vec<u8>, data_crc: u32) {
    record(out, Opcode::DATA_END, |out| {
        out.extend_from_slice(&data_crc.to_le_bytes());
    });
}

impl Footer {
    /// Length of its record.
    pub const LENGTH: usize = RECORD_HEADER + 20;

    /// Appends the record without its last field: the checksum of everything before it.
    pub fn write_without_crc(&self, out: &mut Vec<u8>) {
        out.push(Opcode::FOOTER.0);
        out.extend_from_slice(&20_u64.to_le_bytes());
        out.extend_from_slice(&self.summary_start.to_le_bytes());
        out.extend_from_slice(&self.summary_offset_start.to_le_bytes());
    }

    /// Parses a record's content; `None` if it is malformed.
    #[must_use]
    pub fn read(content: &[u8]) -> Option<Self> {
        let mut cursor = Cursor(content);
        Some(Self {
            summary_start: cursor.u64()?,
            summary_offset_start: cursor.u64()?,
            summary_crc: cursor.u32()?,
        })
    }
}

/// Returns the next record of `bytes`: opcode, content, and the bytes after it. `None` if it is
/// incomplete.
#[must_use]
pub fn next_record(bytes: &[u8]) -> Option<(Opcode, &[u8], &[u8])> {
    let mut cursor = Cursor(bytes);
    let opcode = Opcode(cursor.take(1)?.first().copied()?);
    let length = usize::try_from(cursor.u64()?).ok()?;
    let content = cursor.take(length)?;
    Some((opcode, content, cursor.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content(bytes: &[u8], opcode: Opcode) -> &[u8] {
        let (found, content, rest) = next_record(bytes).unwrap();
        assert_eq!((found, rest), (opcode, &[][..]));
        content
    }

    #[test]
    fn a_written_channel_is_read_back_and_a_truncated_one_is_rejected() {
        let channel = Channel {
            id: 7,
            schema_id: 3,
            topic: "/robot1/imu/data".into(),
            message_encoding: "cdr".into(),
            metadata: [
                ("a".to_owned(), "b\n".to_owned()),
                (String::new(), "ü".into()),
            ]
            .into(),
        };
        let mut bytes = Vec::new();
        channel.write(&mut bytes);
        let whole = content(&bytes, Opcode::CHANNEL);
        assert_eq!(Channel::read(whole).as_ref(), Some(&channel));
        for end in 0..whole.len() {
            assert_eq!(Channel::read(&whole[..end]), None, "{end}");
            assert_eq!(next_record(&bytes[..RECORD_HEADER + end]), None, "{end}");
        }
    }

    #[test]
    fn a_message_has_the_layout_of_the_specification() {
        let message = Message {
            channel_id: 2,
            sequence: 3,
            log_time: 4,
            publish_time: 5,
            data: &[0, 1, 0, 0, 9],
        };
        let mut bytes = Vec::new();
        message.write(&mut bytes);
        assert_eq!(bytes.len(), Message::OVERHEAD + 5);
        assert_eq!(
            bytes,
            [
                &[5, 27, 0, 0, 0, 0, 0, 0, 0, 2, 0, 3, 0, 0, 0][..],
                &[4, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0],
                &[0, 1, 0, 0, 9]
            ]
            .concat()
        );
        assert_eq!(
            Message::read(content(&bytes, Opcode::MESSAGE)),
            Some(message)
        );
    }

    #[test]
    fn a_length_beyond_the_available_bytes_is_rejected() {
        let mut bytes = vec![Opcode::SCHEMA.0];
        bytes.extend_from_slice(&u64::MAX.to_le_bytes());
        assert_eq!(next_record(&bytes), None);
        let content = [[1, 0].as_slice(), &u32::MAX.to_le_bytes(), b"abc"].concat();
        assert_eq!(Schema::read(&content), None);
    }
}
