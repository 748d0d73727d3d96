//! Captures on disk as a source of frames: pcap (both byte orders, micro- and nanoseconds) and
//! pcapng, plain or gzipped.
//!
//! A capture is as untrusted as its network. Lengths in the file are checked against a cap, and
//! memory grows with the bytes read, never with a length in the file. If the rest of a file is
//! damaged, the packets before it are delivered and counted. The crate `pcap-file` is not used
//! because it allocates by block length.
//!
//! The reader has no clock; [`Pacer`] computes the waits of a replay.

mod gunzip;
mod next_generation;
mod pace;

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use ros2probe_wire::frame::Link;
use ros2probe_wire::{Cursor, Endianness, Expansion, Timestamp, WireError};

use gunzip::Gunzip;
use next_generation::Section;
pub use pace::{Pacer, Speed};

/// Maximum size of a packet, in bytes: tcpdump's largest snapshot length. No network frame is
/// longer.
const LONGEST_PACKET: u32 = 262_144;
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Reads a capture packet by packet.
pub struct PcapReader {
    source: Box<dyn Read + Send>,
    format: Format,
    /// The current packet or block; its capacity is reused.
    buffer: Vec<u8>,
    packets: u64,
    /// Bytes of the file that were read, and its size.
    progress: Option<(Arc<AtomicU64>, u64)>,
    ended: bool,
}

/// A file that counts the bytes read.
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
    /// Capture time.
    pub time: Timestamp,
    /// Link layer of the bytes.
    pub link: Link,
    /// Number of the interface within the capture: always 0 in pcap, the index of its description
    /// in pcapng. It is not an interface index of the capturing host.
    pub interface: u32,
    /// The captured bytes.
    pub bytes: &'a [u8],
    /// Length of the packet on the wire.
    pub length: u32,
}

/// Why a capture could not be read to its end.
#[derive(Debug, thiserror::Error)]
pub enum PcapError {
    /// The file cannot be opened.
    #[error("cannot open capture {}", path.display())]
    Open {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The link layer is not supported, so no packet can be read.
    #[error(
        "unsupported link type {}: capture Ethernet, loopback or the interface `any`",
        link_name(*link)
    )]
    UnsupportedLink {
        /// Link layer of the packets.
        link: Link,
    },
    /// The file is neither pcap nor pcapng. Its first bytes, at most 4.
    #[error(
        "not a capture: it begins with {0:02x?}, as neither pcap nor pcapng does; bags are read \
         from their directory, or from a file that ends in .mcap or .db3"
    )]
    NotACapture(Vec<u8>),
    /// Reading failed (disk, damaged gzip stream).
    #[error("cannot read the capture beyond packet {packets}")]
    Read {
        /// Number of packets delivered before the error.
        packets: u64,
        /// Error of the system or the decompressor.
        source: io::Error,
    },
    /// The file ends inside a header or a packet.
    #[error("the capture is cut off: it ends inside a {what} after packet {packets}")]
    Truncated {
        /// Number of packets delivered before the error.
        packets: u64,
        /// The item that was being read.
        what: &'static str,
    },
    /// A length exceeds its limit.
    #[error("a {what} of {length} bytes after packet {packets} exceeds the limit of {limit}")]
    TooLong {
        /// Number of packets delivered before the error.
        packets: u64,
        /// The item that was being read.
        what: &'static str,
        /// Length in the file.
        length: u32,
        /// Maximum accepted length.
        limit: u32,
    },
    /// The file contradicts itself.
    #[error("the capture is damaged after packet {packets}: {what}")]
    Malformed {
        /// Number of packets delivered before the error.
        packets: u64,
        /// Description of the contradiction.
        what: &'static str,
    },
}

enum Format {
    Classic(Classic),
    NextGeneration(Section),
}

/// Properties of all packets, from the header of a pcap file.
struct Classic {
    endianness: Endianness,
    nanoseconds_per_unit: u64,
    link: Link,
}

/// Position of a packet's bytes in the buffer, and its metadata.
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
    /// Fails if the file cannot be opened or does not begin like a capture.
    pub fn open(path: &Path, expansion: Expansion) -> Result<Self, PcapError> {
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
            ..Self::new(counted, expansion)?
        })
    }

    /// Returns the fraction of the file that was read, 0 to 1; `None` if its length is unknown.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a part for people")]
    pub fn part_read(&self) -> Option<f64> {
        let (read, length) = self.progress.as_ref()?;
        Some((read.load(Ordering::Relaxed) as f64 / *length as f64).min(1.0))
    }

    /// Reads from any stream of bytes.
    ///
    /// # Errors
    /// Fails if the stream does not begin like a capture.
    pub fn new(
        source: impl Read + Send + 'static,
        expansion: Expansion,
    ) -> Result<Self, PcapError> {
        let mut source: Box<dyn Read + Send> = Box::new(BufReader::new(source));
        let mut magic = magic_of(&mut source)?;
        if magic.starts_with(&GZIP_MAGIC) {
            let whole = io::Cursor::new(magic).chain(source);
            source = Box::new(BufReader::new(Gunzip::new(whole, expansion)));
            magic = magic_of(&mut source)?;
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

    /// Returns the number of packets delivered so far.
    #[must_use]
    pub const fn packets(&self) -> u64 {
        self.packets
    }

    /// Returns the link layer of all packets; `None` in pcapng, where each interface has its own.
    #[must_use]
    pub const fn link(&self) -> Option<Link> {
        match &self.format {
            Format::Classic(classic) => Some(classic.link),
            Format::NextGeneration(_) => None,
        }
    }

    /// Returns the name of the interface with this number, if the capture contains it (pcapng
    /// only).
    #[must_use]
    pub fn interface_name(&self, interface: u32) -> Option<&str> {
        match &self.format {
            Format::Classic(_) => None,
            Format::NextGeneration(section) => section.interface_name(interface),
        }
    }

    /// Returns the next packet, or `None` at the end. The reader is not an iterator, because
    /// packets borrow the buffer.
    ///
    /// # Errors
    /// Fails if the rest of the file cannot be read. After an error the reader is at its end.
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
    /// The first bytes of a file, their byte order, and the nanoseconds of a unit of time.
    const MAGIC: [([u8; 4], Endianness, u64); 4] = [
        ([0xa1, 0xb2, 0xc3, 0xd4], Endianness::Big, 1000),
        ([0xd4, 0xc3, 0xb2, 0xa1], Endianness::Little, 1000),
        ([0xa1, 0xb2, 0x3c, 0x4d], Endianness::Big, 1),
        ([0x4d, 0x3c, 0xb2, 0xa1], Endianness::Little, 1),
    ];

    fn open(magic: [u8; 4], source: &mut dyn Read) -> Result<Self, PcapError> {
        let form = Self::MAGIC.iter().find(|form| form.0 == magic);
        let Some(&(_, endianness, nanoseconds_per_unit)) = form else {
            return Err(PcapError::NotACapture(magic.to_vec()));
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

/// Formats the number of a link layer, and its name if captures of it are common.
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

/// Returns the link layer without the upper half of the field, which describes frame check
/// sequences: the length in the IP header excludes them.
fn link_of(field: u32) -> Link {
    let [.., high, low] = field.to_be_bytes();
    Link(u16::from_be_bytes([high, low]))
}

/// Fills as much of `target` as the source has, and returns the number of bytes.
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

/// Reads the first bytes of a file. A shorter file is cut off if it begins like a capture.
fn magic_of(mut source: &mut dyn Read) -> Result<[u8; 4], PcapError> {
    const WHAT: &str = "file header";
    let mut magic = [0; 4];
    let length = fill(&mut source, &mut magic, WHAT, 0)?;
    if length == magic.len() {
        return Ok(magic);
    }
    let read = magic.get(..length).unwrap_or_default();
    let classic = Classic::MAGIC.map(|(magic, ..)| magic);
    let mut magics = classic.iter().chain([&next_generation::MAGIC]);
    let is_gzip = read
        .iter()
        .zip(&GZIP_MAGIC)
        .all(|(one, other)| one == other);
    let is_capture = is_gzip || magics.any(|one| one.starts_with(read));
    Err(match is_capture {
        true => PcapError::Truncated {
            packets: 0,
            what: WHAT,
        },
        false => PcapError::NotACapture(read.to_vec()),
    })
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

/// Maps a read error. A truncated gzip stream has its own kind of error, but counts as an early end
/// like any other.
fn failed(source: io::Error, what: &'static str, packets: u64) -> PcapError {
    if source.kind() == io::ErrorKind::UnexpectedEof {
        PcapError::Truncated { packets, what }
    } else {
        PcapError::Read { packets, source }
    }
}

#[cfg(test)]
mod tests;
