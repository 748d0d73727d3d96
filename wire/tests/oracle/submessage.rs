//! The submessages' bodies (RTPS 2.5, 9.4.5), with GUIDs completed from the receiver state.

use ros2probe_wire::parameters::{ParameterId, ParameterList};
use ros2probe_wire::rtps::{
    Locator, LocatorKind, Payload, ProtocolVersion, SequenceNumber, SubmessageFlags, SubmessageId,
    VendorId,
};
use ros2probe_wire::{Cursor, EntityId, Guid, GuidPrefix, Reason, RtpsTime, WireError};

use super::Receiver;
use super::sets::{FragmentNumberSet, SequenceNumberSet, sequence_number};

/// Content of a submessage.
#[derive(Clone, Copy, Debug)]
pub enum Body<'a> {
    /// Padding.
    Pad,
    /// ACKNACK.
    AckNack(AckNack<'a>),
    /// HEARTBEAT.
    Heartbeat(Heartbeat),
    /// HEARTBEAT_FRAG.
    HeartbeatFrag(HeartbeatFrag),
    /// GAP.
    Gap(Gap<'a>),
    /// NACK_FRAG.
    NackFrag(NackFrag<'a>),
    /// INFO_TS; the time is in [`Receiver::timestamp`].
    InfoTimestamp,
    /// INFO_SRC; the source is in [`Receiver`].
    InfoSource,
    /// INFO_DST; the destination is in [`Receiver`].
    InfoDestination,
    /// INFO_REPLY and INFO_REPLY_IP4.
    InfoReply(InfoReply<'a>),
    /// DATA.
    Data(Data<'a>),
    /// DATA_FRAG.
    DataFrag(DataFrag<'a>),
    /// SEC_* and SRTPS_*: a transformation's header, footer or cipher text.
    Secure(&'a [u8]),
    /// An unknown kind, skipped by its length.
    Unknown(&'a [u8]),
}

/// Reader to writer: the acknowledged and the missing samples.
#[derive(Clone, Copy, Debug)]
pub struct AckNack<'a> {
    /// The sender's reader.
    pub reader: Guid,
    /// The destination's writer.
    pub writer: Guid,
    /// The missing samples. All samples before the base are acknowledged.
    pub missing: SequenceNumberSet<'a>,
    /// Number that grows with every new ACKNACK of this reader.
    pub count: u32,
    /// Whether no answer is required if no sample is missing.
    pub is_final: bool,
}

/// Writer to readers: the samples that it has.
#[derive(Clone, Copy, Debug)]
pub struct Heartbeat {
    /// Receiving reader; an unknown entity is every matched reader.
    pub reader: Guid,
    /// Sending writer.
    pub writer: Guid,
    /// The oldest change still held; one more than `last` if the writer holds none.
    pub first: SequenceNumber,
    /// The newest change.
    pub last: SequenceNumber,
    /// Number that grows with every new HEARTBEAT of this writer.
    pub count: u32,
    /// Whether no answer is required from a reader that has all samples.
    pub is_final: bool,
    /// Whether the HEARTBEAT only asserts the writer's liveliness.
    pub is_liveliness: bool,
}

/// Writer to readers: the fragments of one change that it has.
#[derive(Clone, Copy, Debug)]
pub struct HeartbeatFrag {
    /// Receiving reader.
    pub reader: Guid,
    /// Sending writer.
    pub writer: Guid,
    /// The change.
    pub sequence_number: SequenceNumber,
    /// Number of the last fragment that the writer has; it has all fragments from 1.
    pub last_fragment: u32,
    /// Number that grows with every new HEARTBEAT_FRAG of this writer.
    pub count: u32,
}

/// Writer to readers: changes that it will not send.
#[derive(Clone, Copy, Debug)]
pub struct Gap<'a> {
    /// Receiving reader.
    pub reader: Guid,
    /// Sending writer.
    pub writer: Guid,
    /// First irrelevant change; the range ends before the list's base. It may have any length, so
    /// an iteration over it must be bounded.
    pub start: SequenceNumber,
    /// Further irrelevant changes.
    pub list: SequenceNumberSet<'a>,
}

/// Reader to writer: missing fragments.
#[derive(Clone, Copy, Debug)]
pub struct NackFrag<'a> {
    /// The sender's reader.
    pub reader: Guid,
    /// The destination's writer.
    pub writer: Guid,
    /// The change.
    pub sequence_number: SequenceNumber,
    /// Its missing fragments.
    pub missing: FragmentNumberSet<'a>,
    /// Number that grows with every new NACK_FRAG of this reader.
    pub count: u32,
}

/// Reply locators for the submessages that follow.
#[derive(Clone, Copy, Debug)]
pub enum InfoReply<'a> {
    /// INFO_REPLY: unicast locators, and multicast ones if present.
    Lists(LocatorList<'a>, Option<LocatorList<'a>>),
    /// INFO_REPLY_IP4: one unicast UDPv4 locator, and a multicast one if present.
    Ip4(Locator, Option<Locator>),
}

/// One change of one writer.
#[derive(Clone, Copy, Debug)]
pub struct Data<'a> {
    /// Receiving reader; an unknown entity is every matched reader.
    pub reader: Guid,
    /// Sending writer.
    pub writer: Guid,
    /// Sequence number of the change.
    pub sequence_number: SequenceNumber,
    /// Parameters of the change.
    pub inline_qos: Option<ParameterList<'a>>,
    /// The change itself.
    pub payload: Payload<'a>,
}

/// Consecutive fragments of one change.
#[derive(Clone, Copy, Debug)]
pub struct DataFrag<'a> {
    /// Receiving reader; an unknown entity is every matched reader.
    pub reader: Guid,
    /// Sending writer.
    pub writer: Guid,
    /// Sequence number of the change.
    pub sequence_number: SequenceNumber,
    /// Number of the first fragment, counted from 1.
    pub starting: u32,
    /// Number of fragments, at least 1.
    pub count: u16,
    /// Size of every fragment but the last, at least 1.
    pub fragment_size: u16,
    /// Size of the whole payload, which is unverified: no memory may be allocated for it.
    pub sample_size: u32,
    /// Parameters of the change.
    pub inline_qos: Option<ParameterList<'a>>,
    /// Whether the assembled payload is a key only.
    pub is_key: bool,
    /// The fragments' bytes without padding, exactly as many as the fragment numbers require.
    pub bytes: &'a [u8],
}

impl<'a> DataFrag<'a> {
    /// Returns the number of fragments of the whole change.
    #[must_use]
    pub const fn total(&self) -> u32 {
        self.sample_size.div_ceil(self.fragment_size as u32)
    }

    /// Returns the offset of the first fragment in the change's payload.
    #[must_use]
    pub const fn offset(&self) -> u64 {
        (self.starting as u64).saturating_sub(1) * self.fragment_size as u64
    }

    /// Iterates over the fragments with their numbers.
    pub fn fragments(&self) -> impl Iterator<Item = (u32, &'a [u8])> + use<'a> {
        (self.starting..).zip(self.bytes.chunks(usize::from(self.fragment_size).max(1)))
    }
}

/// Reads one body and applies it to the receiver state.
pub(super) fn read<'a>(
    id: SubmessageId,
    flags: SubmessageFlags,
    mut body: Cursor<'a>,
    receiver: &mut Receiver,
) -> Result<Body<'a>, WireError> {
    Ok(match id {
        SubmessageId::PAD => Body::Pad,
        SubmessageId::INFO_TS
        | SubmessageId::INFO_SRC
        | SubmessageId::INFO_DST
        | SubmessageId::INFO_REPLY
        | SubmessageId::INFO_REPLY_IP4 => info(id, flags, body, receiver)?,
        SubmessageId::ACKNACK => {
            let (reader, writer) = from_reader(&mut body, receiver)?;
            Body::AckNack(AckNack {
                reader,
                writer,
                missing: SequenceNumberSet::read(&mut body)?,
                count: body.u32("ACKNACK count")?,
                is_final: flags.contains(SubmessageFlags::FINAL),
            })
        }
        SubmessageId::NACK_FRAG => {
            let (reader, writer) = from_reader(&mut body, receiver)?;
            Body::NackFrag(NackFrag {
                reader,
                writer,
                sequence_number: sequence_number(&mut body, "NACK_FRAG writerSN", 1)?,
                missing: FragmentNumberSet::read(&mut body)?,
                count: body.u32("NACK_FRAG count")?,
            })
        }
        SubmessageId::HEARTBEAT => {
            let (reader, writer) = from_writer(&mut body, receiver)?;
            let first = sequence_number(&mut body, "HEARTBEAT firstSN", 1)?;
            let last = sequence_number(&mut body, "HEARTBEAT lastSN", first.0.cast_signed() - 1)?;
            Body::Heartbeat(Heartbeat {
                reader,
                writer,
                first,
                last,
                count: body.u32("HEARTBEAT count")?,
                is_final: flags.contains(SubmessageFlags::FINAL),
                is_liveliness: flags.contains(SubmessageFlags::LIVELINESS),
            })
        }
        SubmessageId::HEARTBEAT_FRAG => {
            let (reader, writer) = from_writer(&mut body, receiver)?;
            Body::HeartbeatFrag(HeartbeatFrag {
                reader,
                writer,
                sequence_number: sequence_number(&mut body, "HEARTBEAT_FRAG writerSN", 1)?,
                last_fragment: body.u32("HEARTBEAT_FRAG lastFragmentNum")?,
                count: body.u32("HEARTBEAT_FRAG count")?,
            })
        }
        SubmessageId::GAP => {
            let (reader, writer) = from_writer(&mut body, receiver)?;
            Body::Gap(Gap {
                reader,
                writer,
                start: sequence_number(&mut body, "GAP gapStart", 1)?,
                list: SequenceNumberSet::read(&mut body)?,
            })
        }
        SubmessageId::DATA => Body::Data(data(flags, body, receiver)?),
        SubmessageId::DATA_FRAG => Body::DataFrag(data_frag(flags, body, receiver)?),
        SubmessageId::SEC_BODY
        | SubmessageId::SEC_PREFIX
        | SubmessageId::SEC_POSTFIX
        | SubmessageId::SRTPS_PREFIX
        | SubmessageId::SRTPS_POSTFIX => Body::Secure(body.rest()),
        _ => Body::Unknown(body.rest()),
    })
}

/// Reads one of the INFO submessages, which change the receiver state (RTPS 2.5, 8.3.4).
fn info<'a>(
    id: SubmessageId,
    flags: SubmessageFlags,
    mut body: Cursor<'a>,
    receiver: &mut Receiver,
) -> Result<Body<'a>, WireError> {
    Ok(match id {
        SubmessageId::INFO_TS => {
            receiver.timestamp = if flags.contains(SubmessageFlags::INVALIDATE) {
                RtpsTime::default()
            } else {
                let seconds = body.u32("INFO_TS seconds")?;
                let fraction = body.u32("INFO_TS fraction")?;
                RtpsTime(u64::from(seconds) << 32 | u64::from(fraction))
            };
            Body::InfoTimestamp
        }
        SubmessageId::INFO_SRC => {
            body.take("INFO_SRC unused", 4)?;
            let [major, minor] = body.array("INFO_SRC version")?;
            // RTPS 2.5, 8.3.8.9.4: a timestamp applies until the source changes.
            *receiver = Receiver {
                version: ProtocolVersion { major, minor },
                vendor: VendorId(body.array("INFO_SRC vendor")?),
                source: GuidPrefix(body.array("INFO_SRC prefix")?),
                destination: receiver.destination,
                timestamp: RtpsTime::default(),
            };
            Body::InfoSource
        }
        SubmessageId::INFO_DST => {
            receiver.destination = GuidPrefix(body.array("INFO_DST prefix")?);
            Body::InfoDestination
        }
        SubmessageId::INFO_REPLY => {
            let unicast = LocatorList::read(&mut body)?;
            let multicast = flags
                .contains(SubmessageFlags::MULTICAST)
                .then(|| LocatorList::read(&mut body))
                .transpose()?;
            Body::InfoReply(InfoReply::Lists(unicast, multicast))
        }
        SubmessageId::INFO_REPLY_IP4 => {
            let unicast = locator_ip4(&mut body)?;
            let multicast = flags
                .contains(SubmessageFlags::MULTICAST)
                .then(|| locator_ip4(&mut body))
                .transpose()?;
            Body::InfoReply(InfoReply::Ip4(unicast, multicast))
        }
        _ => Body::Unknown(body.rest()),
    })
}

/// Reads `readerId` and `writerId` of a message whose source is the writer.
fn from_writer(body: &mut Cursor<'_>, receiver: &Receiver) -> Result<(Guid, Guid), WireError> {
    let reader = EntityId(body.array("readerId")?);
    let writer = EntityId(body.array("writerId")?);
    Ok((
        Guid::new(receiver.destination, reader),
        Guid::new(receiver.source, writer),
    ))
}

/// Reads `readerId` and `writerId` of a message whose source is the reader.
fn from_reader(body: &mut Cursor<'_>, receiver: &Receiver) -> Result<(Guid, Guid), WireError> {
    let reader = EntityId(body.array("readerId")?);
    let writer = EntityId(body.array("writerId")?);
    Ok((
        Guid::new(receiver.source, reader),
        Guid::new(receiver.destination, writer),
    ))
}

fn data<'a>(
    flags: SubmessageFlags,
    mut body: Cursor<'a>,
    receiver: &Receiver,
) -> Result<Data<'a>, WireError> {
    let (has_data, has_key) = (
        flags.contains(SubmessageFlags::DATA),
        flags.contains(SubmessageFlags::KEY),
    );
    if has_data && has_key {
        return Err(body.error("DATA flags", Reason::BadValue));
    }
    let mut rest = after_octets_to_inline_qos(&mut body, 16)?;
    let (reader, writer) = from_writer(&mut body, receiver)?;
    let sequence_number = sequence_number(&mut body, "DATA writerSN", 1)?;
    let inline_qos = flags
        .contains(SubmessageFlags::INLINE_QOS)
        .then(|| parameter_list(&mut rest))
        .transpose()?;
    let payload = match (has_data, has_key) {
        (true, _) => Payload::Data(rest.rest()),
        (_, true) => Payload::Key(rest.rest()),
        _ => Payload::None,
    };
    Ok(Data {
        reader,
        writer,
        sequence_number,
        inline_qos,
        payload,
    })
}

fn data_frag<'a>(
    flags: SubmessageFlags,
    mut body: Cursor<'a>,
    receiver: &Receiver,
) -> Result<DataFrag<'a>, WireError> {
    let mut rest = after_octets_to_inline_qos(&mut body, 28)?;
    let (reader, writer) = from_writer(&mut body, receiver)?;
    let sequence_number = sequence_number(&mut body, "DATA_FRAG writerSN", 1)?;
    let numbers = body.error("DATA_FRAG fragment numbers", Reason::BadValue);
    let starting = body.u32("DATA_FRAG fragmentStartingNum")?;
    let count = body.u16("DATA_FRAG fragmentsInSubmessage")?;
    let fragment_size = body.u16("DATA_FRAG fragmentSize")?;
    let sample_size = body.u32("DATA_FRAG sampleSize")?;
    let inline_qos = flags
        .contains(SubmessageFlags::INLINE_QOS)
        .then(|| parameter_list(&mut rest))
        .transpose()?;

    // The fragments span [begin, end) of the payload. The last fragment may be shorter.
    let first = u64::from(starting).checked_sub(1).ok_or(numbers)?;
    let begin = first * u64::from(fragment_size);
    let end = ((first + u64::from(count)) * u64::from(fragment_size)).min(sample_size.into());
    let begin_of_last = (first + u64::from(count)).saturating_sub(1) * u64::from(fragment_size);
    if count == 0 || fragment_size == 0 || begin_of_last >= u64::from(sample_size) {
        return Err(numbers);
    }
    let length = usize::try_from(end - begin).map_err(|_| numbers)?;
    Ok(DataFrag {
        reader,
        writer,
        sequence_number,
        starting,
        count,
        fragment_size,
        sample_size,
        inline_qos,
        is_key: flags.contains(SubmessageFlags::FRAGMENT_KEY),
        bytes: rest.take("DATA_FRAG fragments", length)?,
    })
}

/// Reads `extraFlags` and `octetsToInlineQos`; returns the position of the inline QoS (or the
/// payload). Later versions may insert fields after the `least` octets of this version, so the
/// offset is used.
fn after_octets_to_inline_qos<'a>(
    body: &mut Cursor<'a>,
    least: u16,
) -> Result<Cursor<'a>, WireError> {
    body.u16("extraFlags")?;
    let error = body.error("octetsToInlineQos", Reason::BadValue);
    let octets = body.u16("octetsToInlineQos")?;
    if octets < least {
        return Err(error);
    }
    let mut rest = *body;
    rest.take("octetsToInlineQos", octets.into())?;
    Ok(rest)
}

/// Reads the list at the cursor and moves the cursor past the sentinel, which alone marks the start
/// of the payload.
fn parameter_list<'a>(cursor: &mut Cursor<'a>) -> Result<ParameterList<'a>, WireError> {
    let list = ParameterList::inline(*cursor);
    loop {
        let id = ParameterId(cursor.u16("parameter id")?);
        let length = usize::from(cursor.u16("parameter length")?);
        if id == ParameterId::SENTINEL {
            return Ok(list);
        }
        cursor.take("parameter", length.next_multiple_of(4))?;
    }
}

/// `LocatorUDPv4_t` (RTPS 2.5, 9.4.2.10): address and port as numbers.
fn locator_ip4(body: &mut Cursor<'_>) -> Result<Locator, WireError> {
    let [a, b, c, d] = body.u32("INFO_REPLY_IP4 address")?.to_be_bytes();
    let port = body.u32("INFO_REPLY_IP4 port")?;
    let address = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, a, b, c, d];
    Ok(Locator {
        kind: LocatorKind::UDP_V4,
        port,
        address,
    })
}

/// A counted list of locators, whose bytes are checked but not copied.
#[derive(Clone, Copy, Debug)]
pub struct LocatorList<'a> {
    rest: Cursor<'a>,
}

impl<'a> LocatorList<'a> {
    /// Reads a `u32` count, then that many locators.
    fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        let error = cursor.error("locator list", Reason::BadLength);
        let count = usize::try_from(cursor.u32("locator count")?).map_err(|_| error)?;
        let length = count.checked_mul(Locator::LEN).ok_or(error)?;
        Ok(Self {
            rest: cursor.sub("locator list", length)?,
        })
    }
}

impl Iterator for LocatorList<'_> {
    type Item = Locator;

    fn next(&mut self) -> Option<Locator> {
        Locator::read(&mut self.rest).ok()
    }
}
