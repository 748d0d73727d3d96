//! pcapng (draft-ietf-opsawg-pcapng): sections of blocks, each with its own byte order.
//!
//! Reads section headers, interface descriptions and the three packet blocks, and skips everything
//! else without holding it in memory.

use std::io::{self, Read};

use ros2probe_wire::frame::Link;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Cursor, Endianness, Timestamp, WireError};

use super::{Found, LONGEST_PACKET, PcapError, array, failed, fill, read_exactly};

/// Block type of a section header: the same in both byte orders.
pub(super) const MAGIC: [u8; 4] = [0x0a, 0x0d, 0x0d, 0x0a];

const INTERFACE_DESCRIPTION: u32 = 1;
const OBSOLETE_PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
const ENHANCED_PACKET: u32 = 6;

/// Maximum size of a block, in bytes: a packet with its options and comments.
const LONGEST_BLOCK: u32 = LONGEST_PACKET + 65_536;
const MOST_INTERFACES: usize = 4096;
const LONGEST_NAME: usize = 256;

/// State of a section, from its header and its interface descriptions.
pub(super) struct Section {
    endianness: Endianness,
    interfaces: Vec<Interface>,
    /// Time of the previous packet, which simple packets without a time inherit.
    last_time: Timestamp,
}

struct Interface {
    link: Link,
    snapshot_length: u32,
    units_per_second: u128,
    offset_seconds: i64,
    name: Option<String>,
}

impl Section {
    /// Reads the first section header, after the magic.
    pub(super) fn open(source: &mut dyn Read) -> Result<Self, PcapError> {
        let length = array(source, "section header", 0)?;
        let mut section = Self {
            endianness: Endianness::Big,
            interfaces: Vec::new(),
            last_time: Timestamp(0),
        };
        section.begin(length, source, 0)?;
        Ok(section)
    }

    pub(super) fn interface_name(&self, interface: u32) -> Option<&str> {
        self.interfaces
            .get(usize::try_from(interface).ok()?)?
            .name
            .as_deref()
    }

    /// Reads blocks up to the next packet.
    pub(super) fn next(
        &mut self,
        source: &mut dyn Read,
        buffer: &mut Vec<u8>,
        packets: u64,
    ) -> Result<Option<Found>, PcapError> {
        loop {
            let mut head = [0; 8];
            match fill(source, &mut head, "block header", packets)? {
                0 => return Ok(None),
                8 => {}
                _ => {
                    return Err(PcapError::Truncated {
                        packets,
                        what: "block header",
                    });
                }
            }
            let [a, b, c, d, length @ ..] = head;
            if [a, b, c, d] == MAGIC {
                self.begin(length, source, packets)?;
                continue;
            }
            let kind = self.number([a, b, c, d]);
            let total = self.number(length);
            let body = body_length(total, packets)?;
            if matches!(
                kind,
                INTERFACE_DESCRIPTION | OBSOLETE_PACKET | SIMPLE_PACKET | ENHANCED_PACKET
            ) {
                read_exactly(source, buffer, body, LONGEST_BLOCK, "block", packets)?;
            } else {
                skip(source, body, packets)?;
            }
            if self.number(array(source, "block", packets)?) != total {
                return Err(PcapError::Malformed {
                    packets,
                    what: "a block's two lengths differ",
                });
            }
            let malformed = |error: WireError| PcapError::Malformed {
                packets,
                what: error.what,
            };
            match kind {
                INTERFACE_DESCRIPTION => self.describe(buffer, packets)?,
                OBSOLETE_PACKET | SIMPLE_PACKET | ENHANCED_PACKET => {
                    let found = self.packet(kind, buffer).map_err(malformed)?;
                    let found = found.ok_or(PcapError::Malformed {
                        packets,
                        what: "a packet of an interface that was not described",
                    })?;
                    self.last_time = found.time;
                    return Ok(Some(found));
                }
                _ => {}
            }
        }
    }

    /// Reads the rest of a section header block. `length` precedes the byte order in the file.
    fn begin(
        &mut self,
        length: [u8; 4],
        source: &mut dyn Read,
        packets: u64,
    ) -> Result<(), PcapError> {
        self.endianness = match array(source, "section header", packets)? {
            [0x1a, 0x2b, 0x3c, 0x4d] => Endianness::Big,
            [0x4d, 0x3c, 0x2b, 0x1a] => Endianness::Little,
            _ => {
                let what = "a section header without a byte order";
                return Err(PcapError::Malformed { packets, what });
            }
        };
        let [major_and_minor @ .., _, _, _, _, _, _, _, _] =
            array::<12>(source, "section header", packets)?;
        let [a, b, _, _]: [u8; 4] = major_and_minor;
        if ![[0, 1], [1, 0]].contains(&[a, b]) {
            return Err(PcapError::Malformed {
                packets,
                what: "unknown version of pcapng",
            });
        }
        // Byte order, version and section length are read; options and the second length remain.
        let body = body_length(self.number(length), packets)?;
        let options = body.checked_sub(16).ok_or(PcapError::Malformed {
            packets,
            what: "a section header too short",
        })?;
        skip(source, options, packets)?;
        array::<4>(source, "section header", packets)?;
        self.interfaces.clear();
        Ok(())
    }

    fn describe(&mut self, body: &[u8], packets: u64) -> Result<(), PcapError> {
        let malformed = |what| PcapError::Malformed { packets, what };
        if self.interfaces.len() >= MOST_INTERFACES {
            return Err(malformed("too many interfaces"));
        }
        let interface = Interface::read(Cursor::new(body, self.endianness))
            .map_err(|error| malformed(error.what))?
            .ok_or(malformed("a time resolution beyond 10^-38 s"))?;
        self.interfaces.push(interface);
        Ok(())
    }

    fn packet(&self, kind: u32, body: &[u8]) -> Result<Option<Found>, WireError> {
        let mut cursor = Cursor::new(body, self.endianness);
        let interface = match kind {
            ENHANCED_PACKET => cursor.u32("packet's interface")?,
            OBSOLETE_PACKET => {
                let interface = u32::from(cursor.u16("packet's interface")?);
                cursor.u16("packet's drops")?;
                interface
            }
            _ => 0,
        };
        let Some(described) = usize::try_from(interface)
            .ok()
            .and_then(|index| self.interfaces.get(index))
        else {
            return Ok(None);
        };
        let (time, captured, length) = if kind == SIMPLE_PACKET {
            let length = cursor.u32("packet's original length")?;
            let captured = match described.snapshot_length {
                0 => length,
                limit => length.min(limit),
            };
            (self.last_time, captured, length)
        } else {
            let high = u64::from(cursor.u32("packet's time")?);
            let low = u64::from(cursor.u32("packet's time")?);
            let captured = cursor.u32("packet's captured length")?;
            let length = cursor.u32("packet's original length")?;
            (described.time(high << 32 | low), captured, length)
        };
        let start = cursor.offset();
        let captured = usize::try_from(captured).unwrap_or(usize::MAX);
        let bytes = cursor.take("packet's bytes", captured)?;
        let at_least = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        Ok(Some(Found {
            time,
            link: described.link,
            interface,
            start,
            captured,
            length: length.max(at_least),
        }))
    }

    fn number(&self, bytes: [u8; 4]) -> u32 {
        match self.endianness {
            Endianness::Big => u32::from_be_bytes(bytes),
            Endianness::Little => u32::from_le_bytes(bytes),
        }
    }
}

impl Interface {
    /// Returns `None` if the resolution of the interface's clock is too fine.
    fn read(mut cursor: Cursor<'_>) -> Result<Option<Self>, WireError> {
        let link = Link(cursor.u16("interface's link type")?);
        cursor.u16("interface's reserved field")?;
        let snapshot_length = cursor.u32("interface's snapshot length")?;
        let mut interface = Self {
            link,
            snapshot_length,
            units_per_second: 1_000_000,
            offset_seconds: 0,
            name: None,
        };
        while cursor.remaining() >= 4 {
            let code = cursor.u16("interface's option")?;
            let length = cursor.u16("interface's option")?;
            let mut value = cursor.sub("interface's option", usize::from(length))?;
            cursor.align(4);
            match code {
                0 => break,
                2 => {
                    let name = value.take("name", value.remaining().min(LONGEST_NAME))?;
                    interface.name = Some(String::from_utf8_lossy(name).into_owned());
                }
                9 => {
                    let resolution = value.u8("interface's time resolution")?;
                    let base = if resolution & 0x80 == 0 { 10_u128 } else { 2 };
                    let Some(units) = base.checked_pow(u32::from(resolution & 0x7f)) else {
                        return Ok(None);
                    };
                    interface.units_per_second = units;
                }
                14 => {
                    let seconds = value.u64("interface's time offset")?;
                    interface.offset_seconds = seconds.cast_signed();
                }
                _ => {}
            }
        }
        Ok(Some(interface))
    }

    fn time(&self, units: u64) -> Timestamp {
        let nanoseconds = u128::from(units) * u128::from(SECOND) / self.units_per_second;
        let nanoseconds = u64::try_from(nanoseconds).unwrap_or(u64::MAX);
        let offset = self.offset_seconds.saturating_mul(1_000_000_000);
        Timestamp(nanoseconds.saturating_add_signed(offset))
    }
}

/// Returns the number of bytes between a block's two lengths.
fn body_length(total: u32, packets: u64) -> Result<u32, PcapError> {
    total
        .checked_sub(12)
        .filter(|body| body.is_multiple_of(4))
        .ok_or(PcapError::Malformed {
            packets,
            what: "an impossible block length",
        })
}

fn skip(source: &mut dyn Read, count: u32, packets: u64) -> Result<(), PcapError> {
    let count = u64::from(count);
    let skipped = io::copy(&mut source.take(count), &mut io::sink())
        .map_err(|error| failed(error, "block", packets))?;
    if skipped == count {
        Ok(())
    } else {
        Err(PcapError::Truncated {
            packets,
            what: "block",
        })
    }
}
