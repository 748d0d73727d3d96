//! Captures on disk as a source of frames: pcap (both byte orders, micro- and nanoseconds) and
//! pcapng, plain or gzipped.
//!
//! A capture is as untrusted as the network it was taken from. Lengths in the file are checked
//! against a cap before they are believed, memory grows with bytes read and never with bytes
//! announced, and whatever is wrong with the rest of a file, the packets before it are delivered
//! and counted. Own code rather than the crate `pcap-file` for exactly that: there a block length
//! decides how much is allocated.
//!
//! The reader knows no clock; following the capture's pace is [`Pacer`]'s business.

mod next_generation;
mod pace;

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use flate2::read::MultiGzDecoder;
use ros2probe_wire::frame::Link;
use ros2probe_wire::{Cursor, Endianness, Timestamp, WireError};

use next_generation::Section;
pub use pace::{Pacer, Speed};

/// tcpdump's largest snapshot length; no frame of a network is longer.
const LONGEST_PACKET: u32 = 262_144;
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Reads a capture packet by packet.
pub struct PcapReader {
    source: Box<dyn Read + Send>,
    format: Format,
    /// The packet or block being read; its capacity is reused.
    buffer: Vec<u8>,
    packets: u64,
    /// Bytes of the file that were read, and how many it has.
    progress: Option<(Arc<AtomicU64>, u64)>,
    ended: bool,
}

/// A file of which is counted how much was read.
struct Counted {
    file: File,
    read: Arc<AtomicU64>,
}

impl Read for Counted {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read(buffer)?;
        self.read.fetch_add(read as u64, Ordering::Relaxed);
        Ok(read)
    }
}

/// One packet of a capture.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Captured<'a> {
    /// When it was captured.
    pub time: Timestamp,
    /// What the bytes begin with.
    pub link: Link,
    /// Number of the interface within the capture: always 0 in pcap, the n-th description in
    /// pcapng. Not an interface index of the capturing host.
    pub interface: u32,
    /// The bytes kept.
    pub bytes: &'a [u8],
    /// How many there were on the wire.
    pub length: u32,
}

/// Why a capture could not be read, or not to its end.
#[derive(Debug, thiserror::Error)]
pub enum PcapError {
    /// The file cannot be opened.
    #[error("cannot open capture {}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// None of its packets can be read.
    #[error(
        "its link type is {}, which rp cannot read: capture Ethernet, loopback or the interface `any`",
        link_name(*link)
    )]
    UnsupportedLink {
        /// The link layer of its packets.
        link: Link,
    },
    /// Neither pcap nor pcapng.
    #[error("not a capture: it begins with {0:02x?}, which is neither pcap nor pcapng")]
    NotACapture([u8; 4]),
    /// Reading failed (disk, damaged gzip stream).
    #[error("cannot read the capture beyond packet {packets}")]
    Read {
        /// Packets delivered before.
        packets: u64,
        /// The system's or the decompressor's reason.
        source: io::Error,
    },
    /// The file ends inside a header or a packet.
    #[error("the capture is cut off: it ends inside a {what} after packet {packets}")]
    Truncated {
        /// Packets delivered before.
        packets: u64,
        /// What was being read.
        what: &'static str,
    },
    /// A length beyond anything reasonable.
    #[error("a {what} of {length} bytes after packet {packets} is over the limit of {limit}")]
    TooLong {
        /// Packets delivered before.
        packets: u64,
        /// What was being read.
        what: &'static str,
        /// What the file claims.
        length: u32,
        /// What we accept.
        limit: u32,
    },
    /// The file contradicts itself.
    #[error("the capture is damaged after packet {packets}: {what}")]
    Malformed {
        /// Packets delivered before.
        packets: u64,
        /// What is wrong.
        what: &'static str,
    },
}

enum Format {
    Classic(Classic),
    NextGeneration(Section),
}

/// What the header of a pcap file says about all its packets.
struct Classic {
    endianness: Endianness,
    nanoseconds_per_unit: u64,
    link: Link,
}

/// Where in the buffer a packet's bytes are, and what is known about them.
struct Found {
    time: Timestamp,
    link: Link,
    interface: u32,
    start: usize,
    captured: usize,
    length: u32,
}

impl PcapReader {
    /// Opens a capture file; gzip is recognised by its magic, not by its name.
    ///
    /// # Errors
    /// The file cannot be opened, or does not begin like a capture.
    pub fn open(path: &Path) -> Result<Self, PcapError> {
        let file = File::open(path).map_err(|source| PcapError::Open {
            path: path.to_path_buf(),
            source,
        })?;
        let length = file.metadata().ok().map(|metadata| metadata.len());
        let read = Arc::default();
        let counted = Counted {
            file,
            read: Arc::clone(&read),
        };
        let length = length.filter(|length| *length > 0);
        Ok(Self {
            progress: length.map(|length| (read, length)),
            ..Self::new(counted)?
        })
    }

    /// Which part of the file was read, 0 to 1; `None` where its length is not known.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a part for people")]
    pub fn part_read(&self) -> Option<f64> {
        let (read, length) = self.progress.as_ref()?;
        Some((read.load(Ordering::Relaxed) as f64 / *length as f64).min(1.0))
    }

    /// Reads from any stream of bytes.
    ///
    /// # Errors
    /// The stream does not begin like a capture.
    pub fn new(source: impl Read + Send + 'static) -> Result<Self, PcapError> {
        let mut source: Box<dyn Read + Send> = Box::new(BufReader::new(source));
        let mut magic: [u8; 4] = array(&mut source, "file header", 0)?;
        if magic.starts_with(&GZIP_MAGIC) {
            let whole = io::Cursor::new(magic).chain(source);
            source = Box::new(BufReader::new(MultiGzDecoder::new(whole)));
            magic = array(&mut source, "file header", 0)?;
        }
        let format = if magic == next_generation::MAGIC {
            Format::NextGeneration(Section::open(&mut source)?)
        } else {
            Format::Classic(Classic::open(magic, &mut source)?)
        };
        Ok(Self {
            source,
            format,
            buffer: Vec::new(),
            packets: 0,
            progress: None,
            ended: false,
        })
    }

    /// Packets delivered so far.
    #[must_use]
    pub const fn packets(&self) -> u64 {
        self.packets
    }

    /// The link layer of all packets, where the file has one for all (pcap only).
    #[must_use]
    pub const fn link(&self) -> Option<Link> {
        match &self.format {
            Format::Classic(classic) => Some(classic.link),
            Format::NextGeneration(_) => None,
        }
    }

    /// Name of the interface with this number, where the capture tells (pcapng only).
    #[must_use]
    pub fn interface_name(&self, interface: u32) -> Option<&str> {
        match &self.format {
            Format::Classic(_) => None,
            Format::NextGeneration(section) => section.interface_name(interface),
        }
    }

    /// The next packet, or `None` at the end. Not an iterator, because packets borrow the buffer.
    ///
    /// # Errors
    /// The rest of the file cannot be read. After an error the reader is at its end.
    pub fn next_packet(&mut self) -> Result<Option<Captured<'_>>, PcapError> {
        if self.ended {
            return Ok(None);
        }
        let found = match &mut self.format {
            Format::Classic(classic) => {
                classic.next(&mut self.source, &mut self.buffer, self.packets)
            }
            Format::NextGeneration(section) => {
                section.next(&mut self.source, &mut self.buffer, self.packets)
            }
        };
        self.ended = !matches!(found, Ok(Some(_)));
        let Some(found) = found? else { return Ok(None) };
        self.packets += 1;
        let bytes = self
            .buffer
            .get(found.start..)
            .and_then(|rest| rest.get(..found.captured))
            .unwrap_or_default();
        Ok(Some(Captured {
            time: found.time,
            link: found.link,
            interface: found.interface,
            bytes,
            length: found.length,
        }))
    }
}

impl Classic {
    fn open(magic: [u8; 4], source: &mut dyn Read) -> Result<Self, PcapError> {
        let (endianness, nanoseconds_per_unit) = match magic {
            [0xa1, 0xb2, 0xc3, 0xd4] => (Endianness::Big, 1000),
            [0xd4, 0xc3, 0xb2, 0xa1] => (Endianness::Little, 1000),
            [0xa1, 0xb2, 0x3c, 0x4d] => (Endianness::Big, 1),
            [0x4d, 0x3c, 0xb2, 0xa1] => (Endianness::Little, 1),
            _ => return Err(PcapError::NotACapture(magic)),
        };
        let header: [u8; 20] = array(source, "file header", 0)?;
        let mut cursor = Cursor::new(&header, endianness);
        let damaged = |error: WireError| PcapError::Malformed {
            packets: 0,
            what: error.what,
        };
        cursor
            .take("version, time zone, accuracy, snapshot length", 16)
            .map_err(damaged)?;
        let link = cursor.u32("link type").map_err(damaged)?;
        Ok(Self {
            endianness,
            nanoseconds_per_unit,
            link: link_of(link),
        })
    }

    fn next(
        &self,
        source: &mut dyn Read,
        buffer: &mut Vec<u8>,
        packets: u64,
    ) -> Result<Option<Found>, PcapError> {
        let mut header = [0; 16];
        match fill(source, &mut header, "packet header", packets)? {
            0 => return Ok(None),
            16 => {}
            _ => {
                return Err(PcapError::Truncated {
                    packets,
                    what: "packet header",
                });
            }
        }
        let mut cursor = Cursor::new(&header, self.endianness);
        let damaged = |error: WireError| PcapError::Malformed {
            packets,
            what: error.what,
        };
        let seconds = u64::from(cursor.u32("seconds").map_err(damaged)?);
        let units = u64::from(cursor.u32("fraction of a second").map_err(damaged)?);
        let captured = cursor.u32("captured length").map_err(damaged)?;
        let length = cursor.u32("original length").map_err(damaged)?;
        read_exactly(source, buffer, captured, LONGEST_PACKET, "packet", packets)?;
        Ok(Some(Found {
            time: Timestamp(seconds * 1_000_000_000 + units * self.nanoseconds_per_unit),
            link: self.link,
            interface: 0,
            start: 0,
            captured: buffer.len(),
            length: length.max(captured),
        }))
    }
}

/// The number of a link layer, and what it is where captures of it are common.
#[must_use]
pub fn link_name(link: Link) -> String {
    let name = match link.0 {
        9 => "PPP",
        105 => "802.11",
        119 => "802.11 with Prism header",
        127 => "802.11 with radiotap header",
        187 | 201 => "Bluetooth",
        189 | 220 => "USB",
        192 => "PPI",
        195 | 230 => "802.15.4",
        227 => "CAN",
        _ => return link.0.to_string(),
    };
    format!("{} ({name})", link.0)
}

/// The upper half of the field tells about frame check sequences: the IP length cuts those off.
fn link_of(field: u32) -> Link {
    let [.., high, low] = field.to_be_bytes();
    Link(u16::from_be_bytes([high, low]))
}

/// Fills as much of `target` as the source has, and says how much.
fn fill(
    source: &mut dyn Read,
    target: &mut [u8],
    what: &'static str,
    packets: u64,
) -> Result<usize, PcapError> {
    let mut filled = 0;
    while let Some(rest) = target.get_mut(filled..).filter(|rest| !rest.is_empty()) {
        match source.read(rest) {
            Ok(0) => break,
            Ok(count) => filled += count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(failed(error, what, packets)),
        }
    }
    Ok(filled)
}

fn array<const N: usize>(
    mut source: &mut dyn Read,
    what: &'static str,
    packets: u64,
) -> Result<[u8; N], PcapError> {
    let mut bytes = [0; N];
    if fill(&mut source, &mut bytes, what, packets)? == N {
        Ok(bytes)
    } else {
        Err(PcapError::Truncated { packets, what })
    }
}

/// Reads `length` bytes into the buffer, which grows as they arrive.
fn read_exactly(
    source: &mut dyn Read,
    buffer: &mut Vec<u8>,
    length: u32,
    limit: u32,
    what: &'static str,
    packets: u64,
) -> Result<(), PcapError> {
    if length > limit {
        return Err(PcapError::TooLong {
            packets,
            what,
            length,
            limit,
        });
    }
    buffer.clear();
    let read = source.take(u64::from(length)).read_to_end(buffer);
    if read.map_err(|error| failed(error, what, packets))? < usize::try_from(length).unwrap_or(0) {
        return Err(PcapError::Truncated { packets, what });
    }
    Ok(())
}

/// A gzip stream that is cut off is an error of its own kind; for the reader it is the same end.
fn failed(source: io::Error, what: &'static str, packets: u64) -> PcapError {
    if source.kind() == io::ErrorKind::UnexpectedEof {
        PcapError::Truncated { packets, what }
    } else {
        PcapError::Read { packets, source }
    }
}

#[cfg(test)]
mod tests;
