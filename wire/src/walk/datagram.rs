//! The walk over a whole datagram in user space, where all of its bytes are available.

use super::{
    Bytes as _, EXTRA_LEN, MAGIC, MAX_MESSAGE, Order, Step, Walk, octets_to_inline_qos, step,
};
use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::GuidPrefix;
use crate::parameters::ParameterList;
use crate::record::{Handover, Record, flag, kind};
use crate::rtps::{InlineQos, Payload, SubmessageFlags, VendorId};
use crate::time::Timestamp;

/// Context of a datagram besides its bytes.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Envelope {
    /// Time of the frame that completed the datagram, in nanoseconds since the Unix epoch.
    pub time: u64,
    /// Destination address, IPv4-mapped for IPv4.
    pub destination: [u8; 16],
    /// Destination UDP port.
    pub destination_port: u16,
    /// Interface index, 0 = unknown.
    pub interface: u32,
    /// Whether this host sent the datagram.
    pub outgoing: bool,
    /// Whether the datagram came in several IP fragments.
    pub fragmented: bool,
    /// Source UDP port, 0 = unknown.
    pub source_port: u16,
    /// Cookie of the socket at which the datagram was seen; 0 = unknown.
    pub socket: u64,
    /// Whether the datagram was seen at a socket, not on an interface.
    pub host: bool,
    /// The participant that receives the message; unknown for datagrams. The receiver's state
    /// begins with it (RTPS 2.5, 8.3.4).
    pub receiver: GuidPrefix,
    /// The port that a datagram with this message would have (RTPS 2.5, 9.6.2.3), if the message came
    /// by TCP; otherwise 0.
    pub logical_port: u16,
}

impl Envelope {
    /// Returns the context of a datagram that the kernel filter handed over with `record` and that
    /// is complete at `time`.
    #[must_use]
    pub fn of_handover(record: &Record, time: Timestamp) -> Self {
        Self {
            time: time.0,
            destination: zerocopy::transmute!(record.destination),
            destination_port: record.destination_port,
            interface: record.interface,
            outgoing: record.flags & flag::OUTGOING != 0,
            fragmented: true,
            source_port: record.source_port,
            ..Self::default()
        }
    }

    /// Returns a record with the fields of the whole datagram.
    fn record(&self) -> Record {
        const IPV4_MAPPED: [u8; 12] = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff];
        let mut flags = 0;
        if self.fragmented {
            flags |= flag::FRAGMENTED;
        }
        if self.outgoing {
            flags |= flag::OUTGOING;
        }
        if !self.destination.starts_with(&IPV4_MAPPED) {
            flags |= flag::IPV6;
        }
        if self.host {
            flags |= flag::HOST;
        }
        if self.logical_port != 0 {
            flags |= flag::TCP;
        }
        Record {
            time: self.time,
            destination: zerocopy::transmute!(self.destination),
            destination_port: self.destination_port,
            interface: self.interface,
            source_port: self.source_port,
            socket: self.socket,
            flags,
            ..Record::default()
        }
    }
}

/// One endpoint submessage of a datagram in user space.
#[derive(Clone, Copy, Debug)]
pub struct Found<'a> {
    /// The record that the kernel filter would report.
    pub record: Record,
    /// The whole submessage after its header: fixed fields, inline QoS and payload.
    pub body: &'a [u8],
    /// Serialized payload of a DATA, or fragment bytes of a DATA_FRAG; empty for other kinds.
    pub payload: &'a [u8],
}

impl<'a> Found<'a> {
    /// Returns whether the submessage is a DATA_BATCH, whose samples are counted and not read.
    #[must_use]
    pub const fn is_batch(&self) -> bool {
        self.record.kind == kind::DATA_BATCH
    }

    /// Returns the flags octet of the submessage's header.
    #[must_use]
    pub const fn flags(&self) -> SubmessageFlags {
        SubmessageFlags(self.record.submessage_flags)
    }

    /// Returns the payload of a DATA, interpreted by its flags D and K (RTPS 2.5, 9.4.5.4).
    #[must_use]
    pub const fn payload(&self) -> Payload<'a> {
        let flags = self.flags();
        if flags.contains(SubmessageFlags::DATA) {
            Payload::Data(self.payload)
        } else if flags.contains(SubmessageFlags::KEY) {
            Payload::Key(self.payload)
        } else {
            Payload::None
        }
    }

    /// Returns the inline QoS of a DATA or DATA_FRAG, empty if flag Q is not set; `vendor` decides
    /// the meaning of the vendor-specific parameters.
    ///
    /// # Errors
    /// Fails if the parameter list is malformed, even after the parameters that the walk read.
    pub fn inline_qos(&self, vendor: VendorId) -> Result<InlineQos, WireError> {
        let flags = self.flags();
        if !flags.contains(SubmessageFlags::INLINE_QOS) {
            return Ok(InlineQos::default());
        }
        let mut cursor = Cursor::new(self.body, flags.endianness());
        let error = cursor.error("octetsToInlineQos", Reason::Truncated);
        let [extra] = self.body.words::<1>(0).ok_or(error)?;
        let octets = octets_to_inline_qos(Order::of(flags.0.into()), extra);
        let offset = usize::try_from(EXTRA_LEN + octets).map_err(|_| error)?;
        cursor.take("octetsToInlineQos", offset)?;
        InlineQos::parse(ParameterList::inline(cursor), vendor)
    }
}

/// Result of a walk in user space.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outcome {
    /// The walk reached the datagram's end.
    Complete,
    /// The datagram does not begin with the RTPS magic.
    NotRtps,
    /// A submessage contradicts the datagram's length; everything before it was reported.
    Malformed,
}

/// Walks a whole datagram and passes every endpoint submessage to `show`. With `handover` the walk
/// continues where the kernel filter stopped, and does not read the bytes before that offset. A GAP
/// that is too long for one record is passed as two.
pub fn datagram<'a>(
    payload: &'a [u8],
    envelope: &Envelope,
    handover: Option<&Handover>,
    show: impl FnMut(Found<'a>),
) -> Outcome {
    let length = u32::try_from(payload.len()).unwrap_or(u32::MAX);
    walk(payload, length, envelope, handover, show)
}

/// Walks a message of `length` bytes, of which only the beginning is present, as [`datagram`]
/// does. The payload of the last submessage may be incomplete.
pub fn beginning<'a>(
    present: &'a [u8],
    length: u32,
    envelope: &Envelope,
    show: impl FnMut(Found<'a>),
) -> Outcome {
    walk(present, length, envelope, None, show)
}

fn walk<'a>(
    payload: &'a [u8],
    datagram_len: u32,
    envelope: &Envelope,
    handover: Option<&Handover>,
    mut show: impl FnMut(Found<'a>),
) -> Outcome {
    if datagram_len > MAX_MESSAGE {
        return Outcome::Malformed;
    }
    let present = u32::try_from(payload.len()).unwrap_or(u32::MAX);
    let present = present.min(datagram_len);
    let mut walk = Walk {
        record: envelope.record(),
        ..Walk::default()
    };
    if let Some(handover) = handover {
        walk.begin(prefix_words(handover.source), datagram_len);
        walk.destination = prefix_words(handover.destination);
        walk.offset = handover.offset;
        walk.timestamp = handover.timestamp;
    } else {
        let Some([magic, _version, source @ ..]) = payload.words::<5>(0) else {
            return Outcome::NotRtps;
        };
        if magic != MAGIC {
            return Outcome::NotRtps;
        }
        walk.begin(source, datagram_len);
        walk.destination = prefix_words(envelope.receiver);
    }
    // TCP has no fragments of IP, for which the length matters.
    walk.record.datagram_len = match envelope.logical_port {
        0 => u16::try_from(datagram_len).unwrap_or(u16::MAX),
        _ => 0,
    };
    loop {
        let start = walk.offset;
        let step = step(&mut walk, &payload, present);
        match step {
            Step::End | Step::Later => return Outcome::Complete,
            Step::Split if present < datagram_len => return Outcome::Complete,
            Step::Split | Step::Malformed => return Outcome::Malformed,
            Step::Passed => {}
            Step::Endpoint | Step::LongGap => {
                let end = walk.offset.min(present);
                let body = slice(payload, start + 4, end);
                let payload_len = if walk.record.is_sample() {
                    walk.record.payload_len
                } else {
                    0
                };
                let data = slice(payload, walk.offset - payload_len, end);
                show(Found {
                    record: walk.record,
                    body,
                    payload: data,
                });
                if step == Step::LongGap {
                    let record = long_gap_tail(&walk.record, body);
                    show(Found {
                        record,
                        body,
                        payload: &[],
                    });
                }
            }
        }
    }
}

/// Returns the second record of a GAP whose set has more than [`Record::BITMAP_BITS`] bits: the
/// rest of the set, with an empty range before it.
fn long_gap_tail(record: &Record, body: &[u8]) -> Record {
    let order = Order::of(record.submessage_flags.into());
    let gap_list_base = u64::from(record.payload_len) << 32 | u64::from(record.encapsulation);
    let base = gap_list_base.wrapping_add(Record::BITMAP_BITS.into());
    // The set follows reader, writer, gapStart, base and numBits (28 bytes). The first record holds
    // its first five words (20 bytes).
    let map = |index: u32| {
        body.words::<1>(28 + 20 + 4 * index)
            .map_or(0, |[word]| order.word(word))
    };
    Record {
        sequence_number: base,
        payload_len: (base >> 32) as u32,
        encapsulation: base as u32,
        stamp_seconds: record.stamp_seconds - Record::BITMAP_BITS,
        stamp_nanoseconds: map(0),
        fragment_start: map(1),
        fragments: map(2),
        sample_size: 0,
        status_info: 0,
        ..*record
    }
}

fn slice(bytes: &[u8], start: u32, end: u32) -> &[u8] {
    bytes.get(start as usize..end as usize).unwrap_or(&[])
}

fn prefix_words(prefix: GuidPrefix) -> [u32; 3] {
    zerocopy::transmute!(prefix)
}
