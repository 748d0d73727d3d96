//! tshark's dissection of a recording: a reference that shares no code with the agent.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, bail, ensure};

const ACKNACK: &str = "0x06";
const HEARTBEAT: &str = "0x07";
const GAP: &str = "0x08";
const NACK_FRAG: &str = "0x12";
const HEARTBEAT_FRAG: &str = "0x13";
const DATA: &str = "0x15";
const DATA_FRAG: &str = "0x16";

/// Columns requested from tshark, in this order.
const COLUMNS: [&str; 15] = [
    "frame.time_epoch",
    "frame.protocols",
    "eth.src",
    "ip.src",
    "udp.srcport",
    "rtps.guidPrefix.src",
    "rtps.sm.id",
    "rtps.sm.wrEntityId",
    "rtps.sm.rdEntityId",
    "rtps.sm.seqNumber",
    "rtps.bitmap.num_bits",
    "rtps.data_frag.number",
    "rtps.data_frag.num_fragments",
    "rtps.data_frag.sample_size",
    "rtps.data_frag.size",
];

/// Every frame of a recording.
pub struct Dissection {
    pub frames: Vec<Frame>,
}

/// One frame. A datagram that arrived in IP fragments is in the frame of its last fragment.
pub struct Frame {
    /// Seconds since the Unix epoch.
    pub time: f64,
    /// Protocols, such as `eth:ethertype:ip:udp:rtps`.
    pub protocols: String,
    pub ethernet_source: String,
    pub ip_source: String,
    pub source_port: Option<u16>,
    /// The sender's GUID prefix, 24 hexadecimal digits.
    pub prefix: String,
    pub submessages: Vec<Submessage>,
}

/// One submessage that names a writer.
#[derive(Clone, Debug)]
pub struct Submessage {
    /// The writer's entity id, eight hexadecimal digits.
    pub writer: String,
    pub reader: String,
    pub content: Content,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    Data(u64),
    /// Fragments of a sample that has `of` fragments, starting with `first` (counted from 1).
    Fragments {
        number: u64,
        first: u32,
        count: u32,
        of: u32,
    },
    Heartbeat {
        last: u64,
    },
    /// An ACKNACK: a reader requests some of the numbers `first..end` again.
    Request {
        first: u64,
        end: u64,
    },
    Other,
}

/// The received samples of one writer.
#[derive(Debug, Default)]
pub struct Samples {
    /// Time of each complete sample, by sequence number.
    pub whole: BTreeMap<u64, f64>,
    /// Lowest and highest number of any received sample or fragment.
    pub span: Option<(u64, u64)>,
    /// Number of samples whose first DATA was dropped: a later sample arrived first, or a reader
    /// had requested the sample. Samples before the very first DATA do not count.
    pub retransmitted: u64,
    /// Number of samples that a HEARTBEAT announced first, without a request: RustDDS announces
    /// samples before it sends them.
    pub announced_early: u64,
    /// Number of DATA submessages beyond the first of each sample.
    pub repeated: u64,
}

impl Dissection {
    pub fn read(recording: &Path) -> Result<Dissection> {
        let mut tshark = Command::new("tshark");
        // A participant may send from a port that another protocol has registered.
        tshark.args(["-n", "-o", "udp.try_heuristic_first:TRUE"]);
        tshark.args(["-T", "fields", "-r"]).arg(recording);
        for column in COLUMNS {
            tshark.args(["-e", column]);
        }
        let output = tshark
            .output()
            .context("cannot run tshark: `apt-get install tshark`")?;
        if !output.status.success() {
            bail!("tshark: {}", String::from_utf8_lossy(&output.stderr));
        }
        let text = String::from_utf8_lossy(&output.stdout);
        let frames = text
            .lines()
            .map(|line| Frame::parse(line).with_context(|| format!("tshark printed `{line}`")));
        Ok(Dissection {
            frames: frames.collect::<Result<_>>()?,
        })
    }

    /// Returns the samples of the writer with this GUID (32 hexadecimal digits).
    pub fn samples_of(&self, writer: &str) -> Samples {
        let (prefix, entity) = writer.split_at(24);
        let mut samples = Samples::default();
        let mut fragments: BTreeMap<u64, BTreeSet<u32>> = BTreeMap::new();
        let (mut began, mut newest, mut announced) = (None, 0, 0);
        let mut requested = BTreeSet::new();
        let mut present = false;
        for frame in &self.frames {
            let own = frame.prefix == prefix;
            present |= own;
            for submessage in &frame.submessages {
                if submessage.writer != entity {
                    continue;
                }
                match submessage.content {
                    // Only two participants exist at a time, so the other one's request is for
                    // this writer. Before it, the number may be that of an earlier writer.
                    Content::Request { first, end } if !own && present => {
                        requested.extend(first..end);
                    }
                    _ if !own => {}
                    Content::Data(number) => {
                        if samples.whole.contains_key(&number) {
                            samples.repeated += 1;
                            continue;
                        }
                        let counts = number > *began.get_or_insert(number);
                        let missed = number < newest || requested.contains(&number);
                        samples.retransmitted += u64::from(counts && missed);
                        samples.announced_early +=
                            u64::from(counts && !missed && number <= announced);
                        samples.whole.insert(number, frame.time);
                        samples.extend(number);
                        newest = newest.max(number);
                    }
                    Content::Fragments {
                        number,
                        first,
                        count,
                        of,
                    } => {
                        let seen = fragments.entry(number).or_default();
                        seen.extend(first..first + count);
                        if seen.len() as u64 >= u64::from(of) {
                            samples.whole.entry(number).or_insert(frame.time);
                        }
                        samples.extend(number);
                    }
                    Content::Heartbeat { last } => announced = announced.max(last),
                    Content::Request { .. } | Content::Other => {}
                }
            }
        }
        samples
    }
}

impl Samples {
    /// Returns how many samples between the first and the last did not arrive completely.
    pub fn missing(&self) -> u64 {
        self.span.map_or(0, |(first, last)| {
            last - first + 1 - self.whole.range(first..=last).count() as u64
        })
    }

    /// Returns the application's numbers, which count from 0; sequence numbers count from 1.
    pub fn application_numbers(&self) -> BTreeSet<u64> {
        self.whole.keys().map(|number| number - 1).collect()
    }

    fn extend(&mut self, number: u64) {
        let (first, last) = self.span.unwrap_or((number, number));
        self.span = Some((first.min(number), last.max(number)));
    }
}

impl Frame {
    fn parse(line: &str) -> Result<Frame> {
        let cells: Vec<&str> = line.split('\t').collect();
        let Ok(
            [
                time,
                protocols,
                ethernet_source,
                ip_source,
                source_port,
                prefix,
                kinds,
                writers,
                readers,
                numbers,
                bits,
                starts,
                counts,
                sizes,
                fragment_sizes,
            ],
        ) = <[&str; COLUMNS.len()]>::try_from(cells)
        else {
            bail!("not {} columns", COLUMNS.len());
        };
        let mut cells = Cells {
            writers: values(writers),
            readers: values(readers),
            numbers: values(numbers),
            bits: values(bits),
            starts: values(starts),
            counts: values(counts),
            sizes: values(sizes),
            fragment_sizes: values(fragment_sizes),
        };
        let mut submessages = Vec::new();
        for kind in values(kinds) {
            submessages.extend(cells.submessage(kind)?);
        }
        // If values are left over, some values were assigned to the wrong submessage.
        ensure!(
            cells.writers.next().is_none()
                && cells.numbers.next().is_none()
                && cells.bits.next().is_none()
                && cells.starts.next().is_none(),
            "values are left over"
        );
        Ok(Frame {
            time: time.parse().context("frame.time_epoch")?,
            protocols: protocols.to_owned(),
            ethernet_source: ethernet_source.to_owned(),
            ip_source: ip_source.to_owned(),
            source_port: source_port.parse().ok(),
            prefix: prefix.to_owned(),
            submessages,
        })
    }
}

/// The remaining values of columns that have one per submessage with that field.
struct Cells<'a> {
    writers: Values<'a>,
    readers: Values<'a>,
    numbers: Values<'a>,
    bits: Values<'a>,
    starts: Values<'a>,
    counts: Values<'a>,
    sizes: Values<'a>,
    fragment_sizes: Values<'a>,
}

type Values<'a> = std::vec::IntoIter<&'a str>;

impl Cells<'_> {
    /// Returns the next submessage, if its kind names a writer.
    fn submessage(&mut self, kind: &str) -> Result<Option<Submessage>> {
        let Some(content) = self.content(kind)? else {
            return Ok(None);
        };
        let entity = |id: Option<&str>| -> Result<String> {
            let id = id.context("an entity id is missing")?;
            Ok(id.trim_start_matches("0x").to_owned())
        };
        Ok(Some(Submessage {
            writer: entity(self.writers.next())?,
            reader: entity(self.readers.next())?,
            content,
        }))
    }

    fn content(&mut self, kind: &str) -> Result<Option<Content>> {
        let mut number = || next(&mut self.numbers);
        Ok(Some(match kind {
            DATA => Content::Data(number()?),
            DATA_FRAG => {
                let size: u32 = next(&mut self.sizes)?;
                let fragment_size: u32 = next(&mut self.fragment_sizes)?;
                Content::Fragments {
                    number: number()?,
                    first: next(&mut self.starts)?,
                    count: next(&mut self.counts)?,
                    of: size.div_ceil(fragment_size),
                }
            }
            HEARTBEAT => {
                number()?;
                Content::Heartbeat { last: number()? }
            }
            ACKNACK => {
                let (first, bits) = (number()?, next::<u64>(&mut self.bits)?);
                Content::Request {
                    first,
                    end: first + bits,
                }
            }
            NACK_FRAG | HEARTBEAT_FRAG => {
                number()?;
                Content::Other
            }
            GAP => {
                number()?;
                number()?;
                next::<u64>(&mut self.bits)?;
                Content::Other
            }
            _ => return Ok(None),
        }))
    }
}

fn values(cell: &str) -> Values<'_> {
    let values = cell.split(',').filter(|value| !value.is_empty());
    values.collect::<Vec<_>>().into_iter()
}

fn next<'a, T: std::str::FromStr>(values: &mut impl Iterator<Item = &'a str>) -> Result<T> {
    let value = values.next().context("a value is missing")?;
    value
        .parse()
        .ok()
        .with_context(|| format!("{value} is not a number"))
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use flate2::read::MultiGzDecoder;

    use super::*;

    /// Lengths of the header of a pcap file, and of the header of each of its packets.
    const FILE_HEADER: usize = 24;
    const PACKET_HEADER: usize = 16;
    /// Places of the UDP source port and checksum, after Ethernet and IPv4 without options.
    const SOURCE_PORT: usize = 34;
    const CHECKSUM: usize = 40;

    #[test]
    fn a_sender_with_the_port_of_another_protocol_is_dissected() -> Result<()> {
        // EtherNet/IP and TZSP have these ports, which Linux also gives to participants.
        for port in [44_818, 37_008] {
            let dissection = sent_from(port)?;
            let rtps = dissection
                .frames
                .iter()
                .filter(|frame| !frame.prefix.is_empty());
            assert_eq!(rtps.count(), sent_from(40_000)?.frames.len(), "port {port}");
        }
        Ok(())
    }

    /// Dissects a recording of Cyclone DDS whose datagrams have this source port.
    fn sent_from(port: u16) -> Result<Dissection> {
        let compressed = include_bytes!("../../data/cyclonedds11/type-lookup.pcap.gz");
        let mut recording = Vec::new();
        MultiGzDecoder::new(&compressed[..]).read_to_end(&mut recording)?;
        let mut at = FILE_HEADER;
        while let Some(header) = recording.get(at..at + PACKET_HEADER) {
            let length = <[u8; 4]>::try_from(&header[8..12]).map(u32::from_le_bytes)?;
            at += PACKET_HEADER;
            let packet = &mut recording[at..at + length as usize];
            packet[SOURCE_PORT..SOURCE_PORT + 2].copy_from_slice(&port.to_be_bytes());
            packet[CHECKSUM..CHECKSUM + 2].fill(0);
            at += length as usize;
        }
        let file = tempfile::NamedTempFile::new()?;
        std::fs::write(file.path(), recording)?;
        Dissection::read(file.path())
    }
}
