//! The walk over one datagram's submessages, which decides what happens to the datagram.
//!
//! The kernel filter compiles [`step`] and [`fate`] for the BPF target and reads from a socket
//! buffer. User space compiles the same source and reads from a slice. So the unit tests, the
//! fuzzer and the replays exercise the code that runs in the kernel. The BPF target dictates the
//! style: reads of fixed size, state in one plain struct, masks instead of branches for the byte
//! order, no formatting.
//!
//! The walk follows the receiver state of RTPS 2.5, 8.3.4 (INFO_SRC, INFO_DST, INFO_TS) and skips
//! unknown submessages by their length. It reads at most twelve bytes of a payload. DATA_BATCH of
//! RTI Connext is in no specification; its fields are those that Wireshark's dissector names.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::guid::EntityId;
use crate::parameters::ParameterId;
use crate::record::{Record, flag, kind};
use crate::rtps::{SubmessageFlags, SubmessageId};

/// Source of a walk's bytes: a slice, or a socket buffer in the kernel.
pub trait Bytes {
    /// Returns `N` words of wire bytes at `offset` of the UDP payload, in memory order; `None` if
    /// some of them are not present. In a well-formed message, every read of the walk is 4-aligned
    /// relative to the payload's start, as submessages are (RTPS 2.5, 9.4.5.1).
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]>;
}

impl Bytes for &[u8] {
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]> {
        let tail = self.get(usize::try_from(offset).ok()?..)?;
        <[u32; N]>::read_from_prefix(tail)
            .ok()
            .map(|(words, _)| words)
    }
}

/// Size of the RTPS message header, after which the first submessage begins.
pub const HEADER_LEN: u32 = 20;
/// Maximum length of a message that is walked, in bytes. A datagram has at most 65,507 bytes; a
/// shared-memory transport may be configured for longer messages.
pub const MAX_MESSAGE: u32 = 32 << 20;
/// `RTPS` in memory order.
pub const MAGIC: u32 = u32::from_ne_bytes(*b"RTPS");

/// Maximum number of parameters of one inline QoS that the walk reads in search of its end.
const INLINE_QOS_PARAMETERS: u32 = 12;
const PID_SENTINEL: u32 = ParameterId::SENTINEL.0 as u32;
const PID_STATUS_INFO: u32 = ParameterId::STATUS_INFO.0 as u32;

const INFO_TS: u32 = SubmessageId::INFO_TS.0 as u32;
const INFO_SRC: u32 = SubmessageId::INFO_SRC.0 as u32;
const INFO_DST: u32 = SubmessageId::INFO_DST.0 as u32;
const PAD: u32 = SubmessageId::PAD.0 as u32;

/// [`SubmessageFlags`] as the `u32` words that the walk uses.
const ENDIANNESS: u32 = SubmessageFlags::ENDIANNESS.0 as u32;
const INVALIDATE: u32 = SubmessageFlags::INVALIDATE.0 as u32;
const INLINE_QOS: u32 = SubmessageFlags::INLINE_QOS.0 as u32;
const DATA_OR_KEY: u32 = SubmessageFlags::DATA.with(SubmessageFlags::KEY).0 as u32;

/// State of the walk over one datagram, advanced by [`step`].
#[derive(Clone, Copy, Default, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Walk {
    /// The current submessage; the fields of the whole datagram are set once.
    pub record: Record,
    /// Source GUID prefix in force.
    pub source: [u32; 3],
    /// INFO_DST's prefix in force; zero = any.
    pub destination: [u32; 3],
    /// Offset of the next submessage header.
    pub offset: u32,
    /// Length of the whole UDP payload.
    pub datagram_len: u32,
    /// `seconds << 32 | fraction` of INFO_TS in force, in two words; zero = none.
    pub timestamp: [u32; 2],
}

/// Result of one step.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Step {
    /// The datagram ends here.
    End = 0,
    /// The next submessage header begins beyond the available bytes.
    Later = 1,
    /// The next submessage begins among the available bytes, but not all bytes that the walk needs
    /// are available.
    Split = 2,
    /// A submessage is invalid, or contradicts the datagram's length; the rest is unreadable.
    Malformed = 3,
    /// A submessage that yields no record.
    Passed = 4,
    /// [`Walk::record`] holds a submessage of an endpoint.
    Endpoint = 5,
    /// As [`Step::Endpoint`], but a GAP's set is too long for one record.
    LongGap = 6,
}

/// A byte order that is selected without branching. Words read from the wire are in memory order.
#[derive(Clone, Copy)]
struct Order(u32);

impl Order {
    /// Returns the order of a submessage's flags: E set means little-endian.
    #[inline(always)]
    const fn of(flags: u32) -> Self {
        Self((flags & ENDIANNESS).wrapping_neg())
    }

    #[inline(always)]
    const fn word(self, wire: u32) -> u32 {
        let big = u32::from_be(wire);
        (big & !self.0) | (big.swap_bytes() & self.0)
    }

    /// Returns the `u16` pair in one word: `(first, second)`.
    #[inline(always)]
    const fn halves(self, wire: u32) -> (u32, u32) {
        let big = u32::from_be(wire);
        let (first, second) = (big >> 16, big & 0xffff);
        (self.half(first), self.half(second))
    }

    #[inline(always)]
    const fn half(self, big: u32) -> u32 {
        let swapped = (big >> 8) | ((big & 0xff) << 8);
        (big & !self.0) | (swapped & self.0)
    }

    #[inline(always)]
    const fn long(self, high: u32, low: u32) -> u64 {
        (self.word(high) as u64) << 32 | self.word(low) as u64
    }
}

impl Walk {
    /// Starts at the first submessage of a message whose header's GUID prefix is `source`. The
    /// caller has checked the magic.
    #[inline(always)]
    pub fn begin(&mut self, source: [u32; 3], datagram_len: u32) {
        let zero = zero();
        self.source = source;
        self.destination = [zero; 3];
        self.offset = HEADER_LEN;
        self.datagram_len = datagram_len;
        self.timestamp = [zero; 2];
        self.record.datagram_len = datagram_len as u16;
    }

    /// Returns where `len` bytes at `offset` lie: among the first `present` bytes, later in the
    /// datagram, or outside of it.
    #[inline(always)]
    const fn reach(&self, offset: u32, len: u32, present: u32) -> Reach {
        // Offsets stay below 2^27: a 16-bit length is added to a position below `MAX_MESSAGE`.
        let end = offset + len;
        if end > self.datagram_len {
            Reach::Outside
        } else if end > present {
            Reach::Elsewhere
        } else {
            Reach::Here
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Reach {
    Here,
    Elsewhere,
    Outside,
}

/// Reads `N` words at `offset`, or returns from [`step`] with the failure.
macro_rules! read {
    ($walk:expr, $bytes:expr, $present:expr, $offset:expr, $count:literal) => {{
        let offset: u32 = $offset;
        match $walk.reach(offset, 4 * $count, $present) {
            Reach::Here => match $bytes.words::<$count>(offset) {
                Some(words) => words,
                None => return Step::Malformed,
            },
            Reach::Elsewhere => return Step::Split,
            Reach::Outside => return Step::Malformed,
        }
    }};
}

/// Reads the submessage at `walk.offset`, given that the first `present` bytes of the payload are
/// available. [`Step::Later`], [`Step::Split`] and [`Step::End`] leave the offset unchanged. After
/// [`Step::Malformed`] the walk cannot continue, and the offset is the datagram's end or unchanged.
/// Otherwise the offset is that of the next submessage.
#[inline(always)]
pub fn step<B: Bytes>(walk: &mut Walk, bytes: &B, present: u32) -> Step {
    let start = walk.offset;
    // A tail shorter than a submessage header is padding.
    if start + 4 > walk.datagram_len {
        return Step::End;
    }
    if start >= present {
        return Step::Later;
    }
    let [header] = read!(walk, bytes, present, start, 1);
    // The header has id, flags and octetsToNextHeader. The first two are octets.
    let id = u32::from_be(header) >> 24;
    let flags = u32::from_be(header) >> 16 & 0xff;
    let order = Order::of(flags);
    let (_, octets) = order.halves(header);
    let body = start + 4;
    // RTPS 2.5, 9.4.5.1.3: zero means "to the end", except for PAD and INFO_TS.
    let end = if octets == 0 && id != PAD && id != INFO_TS {
        walk.datagram_len
    } else {
        body + octets
    };
    if end > walk.datagram_len {
        return Step::Malformed;
    }
    let found = if id == kind::DATA as u32 || id == kind::DATA_FRAG as u32 {
        data(walk, bytes, present, order, id, flags, body, end)
    } else if id == kind::DATA_BATCH as u32 {
        batch(walk, bytes, present, order, flags, body, end)
    } else if id == kind::HEARTBEAT as u32 {
        heartbeat(walk, bytes, present, order, flags, body, end)
    } else if id == kind::GAP as u32 || id == kind::ACKNACK as u32 {
        sequence_set(walk, bytes, present, order, id, flags, body, end)
    } else {
        receiver_state(walk, bytes, present, order, id, flags, body, end)
    };
    if found as u32 != Step::Split as u32 {
        walk.offset = if found as u32 == Step::Malformed as u32 {
            walk.datagram_len
        } else {
            end
        };
    }
    found
}

/// Returns whether [`continue_fragments`] may extend `record`, the last one of a walk: a DATA_FRAG
/// without inline QoS, after which the receiver state has not changed.
#[inline(always)]
#[must_use]
pub fn may_continue(walk: &Walk, record: &Record) -> bool {
    let timestamp = (walk.timestamp[0] as u64) << 32 | walk.timestamp[1] as u64;
    record.kind == kind::DATA_FRAG
        && u32::from(record.submessage_flags) & INLINE_QOS == 0
        && record.source_timestamp == timestamp
        && record.writer[0] == walk.source[0]
        && record.writer[1] == walk.source[1]
        && record.writer[2] == walk.source[2]
        && record.reader[0] == walk.destination[0]
        && record.reader[1] == walk.destination[1]
        && record.reader[2] == walk.destination[2]
}

/// Extends a record, for which [`may_continue`] holds, by the submessage at `offset`. That one must be
/// a DATA_FRAG with the next fragments of the same sample. `present` and `len` are the available bytes
/// and all bytes of the datagram. Returns the offset of the submessage after it. Returns 0 and leaves
/// the record unchanged in all other cases, which [`step`] distinguishes.
///
/// The result is that of [`step`] and [`Record::extend`], with fewer instructions.
#[inline(always)]
pub fn continue_fragments<B: Bytes>(
    record: &mut Record,
    bytes: &B,
    offset: u32,
    (present, len): (u32, u32),
) -> u32 {
    const FIXED: u32 = 32;
    let body = offset + 4;
    if body + FIXED > present {
        return 0;
    }
    let Some(
        [
            header,
            extra,
            reader,
            writer,
            high,
            low,
            start,
            counts,
            size,
        ],
    ) = bytes.words::<9>(offset)
    else {
        return 0;
    };
    let wire = u32::from_be(header);
    let flags = u32::from(record.submessage_flags);
    let order = Order::of(flags);
    let (_, octets) = order.halves(header);
    let end = body + octets;
    let (more, fragment_size) = order.halves(counts);
    let count = record.fragments_in_submessage();
    let at = body + EXTRA_LEN + octets_to_inline_qos(order, extra);
    // A length of zero means "to the end".
    let continues = wire >> 16 == (kind::DATA_FRAG as u32) << 8 | flags
        && octets != 0
        && end <= len
        && reader == record.reader[3]
        && writer == record.writer[3]
        && order.long(high, low) == record.sequence_number
        && order.word(start) == record.fragment_start.wrapping_add(count)
        && order.word(start) != 1
        && fragment_size == record.fragment_size()
        && order.word(size) == record.sample_size
        && count + more <= 0xffff
        && at >= body + FIXED
        && at <= end;
    if !continues {
        return 0;
    }
    record.fragments = (count + more) << 16 | fragment_size;
    record.payload_len = record.payload_len.wrapping_add(end - at);
    end
}

/// Handles INFO_TS, INFO_SRC and INFO_DST; skips any other kind by its length.
#[inline(always)]
#[expect(
    clippy::too_many_arguments,
    reason = "a struct would go over the BPF stack"
)]
fn receiver_state<B: Bytes>(
    walk: &mut Walk,
    bytes: &B,
    present: u32,
    order: Order,
    id: u32,
    flags: u32,
    body: u32,
    end: u32,
) -> Step {
    if id == INFO_TS {
        if flags & INVALIDATE != 0 {
            walk.timestamp = [zero(); 2];
            return Step::Passed;
        }
        if body + 8 > end {
            return Step::Malformed;
        }
        let [seconds, fraction] = read!(walk, bytes, present, body, 2);
        walk.timestamp = [order.word(seconds), order.word(fraction)];
    } else if id == INFO_DST {
        if body + 12 > end {
            return Step::Malformed;
        }
        walk.destination = read!(walk, bytes, present, body, 3);
    } else if id == INFO_SRC {
        // The body has an unused word, version and vendor, and the prefix. INFO_SRC resets the
        // timestamp (RTPS 2.5, 8.3.8.9.4).
        if body + 20 > end {
            return Step::Malformed;
        }
        walk.source = read!(walk, bytes, present, body + 8, 3);
        walk.timestamp = [zero(); 2];
    }
    Step::Passed
}

/// Sets the fields shared by all endpoint submessages. `reader` and `writer` are entity ids in
/// memory order.
#[inline(always)]
fn endpoint(walk: &mut Walk, id: u32, flags: u32, writer: u32, reader: u32) {
    let (source, destination) = (walk.source, walk.destination);
    let record = &mut walk.record;
    record.writer = [source[0], source[1], source[2], writer];
    record.reader = [destination[0], destination[1], destination[2], reader];
    record.kind = id as u8;
    record.submessage_flags = flags as u8;
    record.flags &= flag::FRAGMENTED | flag::OUTGOING | flag::IPV6 | flag::HOST | flag::TCP;
    let zero = zero();
    record.source_timestamp = u64::from(zero);
    record.payload_len = zero;
    record.encapsulation = zero;
    record.stamp_seconds = zero;
    record.stamp_nanoseconds = zero;
    record.fragment_start = zero;
    record.fragments = zero;
    record.sample_size = zero;
    record.status_info = zero;
}

/// Returns a zero that is hidden from the compiler. It would turn several plain zeros into a call
/// of `memset`, which is a loop over bytes on the BPF target.
#[inline(always)]
fn zero() -> u32 {
    core::hint::black_box(0)
}

/// Length of extraFlags and octetsToInlineQos at the start of a DATA or DATA_FRAG, in bytes.
const EXTRA_LEN: u32 = 4;

/// Returns octetsToInlineQos of a DATA or DATA_FRAG whose first word is `extra`. The field counts
/// the octets from its end to the inline QoS, or to the payload (RTPS 2.5, 9.4.5.4). Later versions
/// may insert fields, so the walk uses the offset.
#[inline(always)]
const fn octets_to_inline_qos(order: Order, extra: u32) -> u32 {
    let (_extra_flags, octets) = order.halves(extra);
    octets
}

/// Reads DATA and DATA_FRAG (RTPS 2.5, 9.4.5.4 and 9.4.5.5).
#[inline(always)]
#[expect(
    clippy::too_many_arguments,
    reason = "a struct would go over the BPF stack"
)]
fn data<B: Bytes>(
    walk: &mut Walk,
    bytes: &B,
    present: u32,
    order: Order,
    id: u32,
    flags: u32,
    body: u32,
    end: u32,
) -> Step {
    let fragment = id == kind::DATA_FRAG as u32;
    let fixed = if fragment { 32 } else { 20 };
    if body + fixed > end {
        return Step::Malformed;
    }
    let [extra, reader, writer, high, low] = read!(walk, bytes, present, body, 5);
    endpoint(walk, id, flags, writer, reader);
    walk.record.sequence_number = order.long(high, low);
    walk.record.source_timestamp = (walk.timestamp[0] as u64) << 32 | walk.timestamp[1] as u64;
    if fragment {
        let [start, counts, size] = read!(walk, bytes, present, body + 20, 3);
        let (in_submessage, fragment_size) = order.halves(counts);
        walk.record.fragment_start = order.word(start);
        walk.record.fragments = in_submessage << 16 | fragment_size;
        walk.record.sample_size = order.word(size);
    }
    let mut at = body + EXTRA_LEN + octets_to_inline_qos(order, extra);
    if at < body + fixed || at > end {
        return Step::Malformed;
    }
    if flags & INLINE_QOS != 0 {
        let mut seen = 0;
        loop {
            if seen == INLINE_QOS_PARAMETERS {
                walk.record.flags |= flag::INLINE_QOS_UNREAD;
                walk.record.payload_len = end - at;
                return Step::Endpoint;
            }
            if at + 4 > end {
                return Step::Malformed;
            }
            let [parameter] = read!(walk, bytes, present, at, 1);
            let (pid, len) = order.halves(parameter);
            if pid == PID_STATUS_INFO && len >= 4 {
                if at + 8 > end {
                    return Step::Malformed;
                }
                let [status] = read!(walk, bytes, present, at + 4, 1);
                // Big-endian regardless of E (RTPS 2.5, 9.6.4.9).
                walk.record.status_info = u32::from_be(status);
            }
            at += 4;
            if pid == PID_SENTINEL {
                break;
            }
            at += (len + 3) & !3;
            if at > end {
                return Step::Malformed;
            }
            seen += 1;
        }
    }
    // Neither D nor K is set: the inline QoS alone describes a disposal (Fast DDS).
    if !fragment && flags & DATA_OR_KEY == 0 {
        return Step::Endpoint;
    }
    walk.record.payload_len = end - at;
    // Every DATA has the payload's first bytes. Of the DATA_FRAGs, only the one with fragment 1 has
    // them.
    if (!fragment || walk.record.fragment_start == 1) && at + 12 <= end {
        let [encapsulation, seconds, nanoseconds] = read!(walk, bytes, present, at, 3);
        let encapsulation = u32::from_be(encapsulation);
        // Identifiers are big-endian; the lowest bit means little-endian contents (RTPS 2.5, 10.5).
        let contents = Order::of(encapsulation >> 16);
        walk.record.encapsulation = encapsulation;
        walk.record.stamp_seconds = contents.word(seconds);
        walk.record.stamp_nanoseconds = contents.word(nanoseconds);
        walk.record.flags |= flag::STAMP;
    }
    Step::Endpoint
}

/// Length of DATA_BATCH's fields before its inline QoS.
const BATCH_FIXED: u32 = 36;
/// Minimum length of a sample's entry in the list of DATA_BATCH: flags, octetsToInlineQos and the
/// serialized length.
const BATCH_ENTRY: u32 = 8;

/// Reads DATA_BATCH. Its body begins as that of DATA: extraFlags, octetsToInlineQos, readerId and
/// writerId. The numbers of the batch and of its first sample follow, the distance of the last
/// sample's number, and the number of samples. With flag Q there is an inline QoS. The rest is the
/// length of the list of samples, that list, and the samples.
#[inline(always)]
fn batch<B: Bytes>(
    walk: &mut Walk,
    bytes: &B,
    present: u32,
    order: Order,
    flags: u32,
    body: u32,
    end: u32,
) -> Step {
    if body + BATCH_FIXED > end {
        return Step::Malformed;
    }
    let [reader, writer] = read!(walk, bytes, present, body + EXTRA_LEN, 2);
    let [high, low, last, count] = read!(walk, bytes, present, body + 20, 4);
    let (last, count) = (order.word(last), order.word(count));
    let mut at = body + BATCH_FIXED;
    if count > (end - at) / BATCH_ENTRY || count > 0 && last < count - 1 {
        return Step::Malformed;
    }
    endpoint(walk, kind::DATA_BATCH as u32, flags, writer, reader);
    walk.record.sequence_number = order.long(high, low);
    walk.record.fragment_start = count;
    walk.record.sample_size = last;
    if flags & INLINE_QOS != 0 {
        walk.record.flags |= flag::INLINE_QOS_UNREAD;
    } else {
        if at + 4 > end {
            return Step::Malformed;
        }
        let [list] = read!(walk, bytes, present, at, 1);
        at += 4;
        if order.word(list) > end - at {
            return Step::Malformed;
        }
        at += order.word(list);
    }
    walk.record.payload_len = end - at;
    Step::Endpoint
}

/// Reads HEARTBEAT (RTPS 2.5, 9.4.5.7).
#[inline(always)]
fn heartbeat<B: Bytes>(
    walk: &mut Walk,
    bytes: &B,
    present: u32,
    order: Order,
    flags: u32,
    body: u32,
    end: u32,
) -> Step {
    if body + 28 > end {
        return Step::Malformed;
    }
    let [
        reader,
        writer,
        first_high,
        first_low,
        last_high,
        last_low,
        count,
    ] = read!(walk, bytes, present, body, 7);
    endpoint(walk, kind::HEARTBEAT as u32, flags, writer, reader);
    walk.record.sequence_number = order.long(first_high, first_low);
    walk.record.payload_len = order.word(last_high);
    walk.record.encapsulation = order.word(last_low);
    walk.record.stamp_seconds = order.word(count);
    Step::Endpoint
}

/// Reads GAP and ACKNACK (RTPS 2.5, 9.4.5.6 and 9.4.5.3): both contain a SequenceNumberSet
/// (9.4.2.6).
#[inline(always)]
#[expect(
    clippy::too_many_arguments,
    reason = "a struct would go over the BPF stack"
)]
fn sequence_set<B: Bytes>(
    walk: &mut Walk,
    bytes: &B,
    present: u32,
    order: Order,
    id: u32,
    flags: u32,
    body: u32,
    end: u32,
) -> Step {
    let gap = id == kind::GAP as u32;
    let set = if gap { body + 16 } else { body + 8 };
    if set + 12 > end {
        return Step::Malformed;
    }
    let [reader, writer] = read!(walk, bytes, present, body, 2);
    let [base_high, base_low, bits] = read!(walk, bytes, present, set, 3);
    let bits = order.word(bits);
    if bits > 256 || set + 12 + ((bits + 31) >> 5) * 4 > end {
        return Step::Malformed;
    }
    if gap {
        let [start_high, start_low] = read!(walk, bytes, present, body + 8, 2);
        endpoint(walk, id, flags, writer, reader);
        walk.record.sequence_number = order.long(start_high, start_low);
        walk.record.payload_len = order.word(base_high);
        walk.record.encapsulation = order.word(base_low);
    } else {
        // A reader sends an ACKNACK. The writer belongs to the participant of INFO_DST.
        endpoint(walk, id, flags, writer, reader);
        walk.record.reader = [walk.source[0], walk.source[1], walk.source[2], reader];
        walk.record.writer = [
            walk.destination[0],
            walk.destination[1],
            walk.destination[2],
            writer,
        ];
        walk.record.sequence_number = order.long(base_high, base_low);
    }
    walk.record.stamp_seconds = bits;
    let map = set + 12;
    if bits > 0 {
        walk.record.stamp_nanoseconds = order.word(read!(walk, bytes, present, map, 1)[0]);
    }
    if bits > 32 {
        walk.record.fragment_start = order.word(read!(walk, bytes, present, map + 4, 1)[0]);
    }
    if bits > 64 {
        walk.record.fragments = order.word(read!(walk, bytes, present, map + 8, 1)[0]);
    }
    if bits > 96 {
        walk.record.sample_size = order.word(read!(walk, bytes, present, map + 12, 1)[0]);
    }
    if bits > 128 {
        walk.record.status_info = order.word(read!(walk, bytes, present, map + 16, 1)[0]);
    }
    if gap && bits > Record::BITMAP_BITS {
        Step::LongGap
    } else {
        Step::Endpoint
    }
}

/// Verdict on a submessage before the interest map is consulted.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Fate {
    /// Never of interest.
    Ignore = 0,
    /// Discovery: the whole datagram is copied to user space.
    Capture = 1,
    /// The interest map decides by the record's writer. An unknown writer is captured at first.
    Writer = 2,
    /// The interest map decides by the record's reader. An unknown reader is ignored.
    Reader = 3,
}

/// Returns the part of the verdict that needs no state. Discovery is SPDP, SEDP, the readable parts
/// of their secure variants, and replies of TypeLookup. Other builtin traffic (liveliness,
/// authentication) is ignored.
#[inline(always)]
#[must_use]
pub const fn fate(record: &Record) -> Fate {
    if record.kind == kind::ACKNACK {
        let [_, _, _, last] = record.reader[3].to_ne_bytes();
        return if last & 0xc0 == 0 {
            Fate::Reader
        } else {
            Fate::Ignore
        };
    }
    let writer = record.writer[3];
    let [_, _, _, last] = writer.to_ne_bytes();
    if last & 0xc0 == 0 {
        return Fate::Writer;
    }
    let is_data = record.kind == kind::DATA || record.kind == kind::DATA_FRAG;
    if is_data && is_discovery_writer(writer) {
        Fate::Capture
    } else {
        Fate::Ignore
    }
}

#[inline(always)]
const fn is_discovery_writer(entity: u32) -> bool {
    const SPDP: u32 = word(EntityId::SPDP_WRITER);
    const PUBLICATIONS: u32 = word(EntityId::SEDP_PUBLICATIONS_WRITER);
    const SUBSCRIPTIONS: u32 = word(EntityId::SEDP_SUBSCRIPTIONS_WRITER);
    const TYPE_LOOKUP_REPLIES: u32 = word(EntityId::TYPE_LOOKUP_REPLY_WRITER);
    const SPDP_SECURE: u32 = word(EntityId::SPDP_SECURE_WRITER);
    const PUBLICATIONS_SECURE: u32 = word(EntityId::SEDP_PUBLICATIONS_SECURE_WRITER);
    const SUBSCRIPTIONS_SECURE: u32 = word(EntityId::SEDP_SUBSCRIPTIONS_SECURE_WRITER);
    entity == SPDP
        || entity == PUBLICATIONS
        || entity == SUBSCRIPTIONS
        || entity == TYPE_LOOKUP_REPLIES
        || entity == SPDP_SECURE
        || entity == PUBLICATIONS_SECURE
        || entity == SUBSCRIPTIONS_SECURE
}

const fn word(entity: EntityId) -> u32 {
    u32::from_ne_bytes(entity.0)
}

mod datagram;
#[cfg(test)]
mod tests;

pub use datagram::{Envelope, Found, Outcome, beginning, datagram};
