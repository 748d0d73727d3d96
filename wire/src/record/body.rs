//! Typed views of a record's body: the meaning of a [`Record`]'s words for each kind.
//!
//! All kinds share the words, so that a record stays small in the kernel's maps and ring buffer.
//! User space reads them only through these views. A view borrows its record and copies nothing; it
//! trusts the kind and does not validate numbers.

use super::{Record, flag, kind};
use crate::rtps::{SequenceNumber, StatusInfo, SubmessageFlags};
use crate::time::RtpsTime;

/// The body of a record, by kind.
#[derive(Clone, Copy, Debug)]
pub enum Body<'a> {
    /// DATA or DATA_FRAG.
    Sample(Sample<'a>),
    /// DATA_BATCH.
    Batch(Batch<'a>),
    /// HEARTBEAT.
    Heartbeat(Heartbeat<'a>),
    /// GAP.
    Gap(Gap<'a>),
    /// ACKNACK.
    AckNack(AckNack<'a>),
    /// [`kind::COMPLETE`].
    Complete,
    /// [`kind::HANDOVER`], with the context in [`Record::handover`].
    Handover,
    /// [`kind::UNDELIVERED`].
    Undelivered,
    /// A kind that this version does not know.
    Unknown,
}

impl Record {
    /// Returns the body as a typed view.
    #[inline]
    #[must_use]
    pub const fn body(&self) -> Body<'_> {
        match self.kind {
            kind::DATA => Body::Sample(Sample::Data(Data(self))),
            kind::DATA_FRAG => Body::Sample(Sample::DataFrag(DataFrag(self))),
            kind::DATA_BATCH => Body::Batch(Batch(self)),
            kind::HEARTBEAT => Body::Heartbeat(Heartbeat(self)),
            kind::GAP => Body::Gap(Gap(self)),
            kind::ACKNACK => Body::AckNack(AckNack(self)),
            kind::COMPLETE => Body::Complete,
            kind::HANDOVER => Body::Handover,
            kind::UNDELIVERED => Body::Undelivered,
            _ => Body::Unknown,
        }
    }

    /// Returns the DATA or DATA_FRAG, if the record reports one.
    #[inline]
    #[must_use]
    pub const fn sample(&self) -> Option<Sample<'_>> {
        match self.body() {
            Body::Sample(sample) => Some(sample),
            _ => None,
        }
    }

    /// Returns whether the record reports a DATA or DATA_FRAG.
    #[inline]
    #[must_use]
    pub const fn is_sample(&self) -> bool {
        matches!(self.kind, kind::DATA | kind::DATA_FRAG)
    }

    /// Returns whether the record reports a sample, a part of one, or several in a batch.
    #[inline]
    #[must_use]
    pub const fn has_samples(&self) -> bool {
        self.is_sample() || self.kind == kind::DATA_BATCH
    }

    /// Returns whether the record reports an ACKNACK, which a reader sends to a writer.
    #[inline]
    #[must_use]
    pub const fn is_acknack(&self) -> bool {
        self.kind == kind::ACKNACK
    }
}

/// A sample, or some fragments of one.
#[derive(Clone, Copy, Debug)]
pub enum Sample<'a> {
    /// The whole sample.
    Data(Data<'a>),
    /// Consecutive fragments of the sample.
    DataFrag(DataFrag<'a>),
}

impl<'a> Sample<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        match self {
            Self::Data(Data(record)) | Self::DataFrag(DataFrag(record)) => record,
        }
    }

    /// Returns writerSN.
    #[inline]
    #[must_use]
    pub const fn sequence_number(self) -> SequenceNumber {
        SequenceNumber(self.record().sequence_number)
    }

    /// Returns the INFO_TS in force.
    #[inline]
    #[must_use]
    pub const fn source_timestamp(self) -> RtpsTime {
        self.record().source_timestamp()
    }

    /// Returns PID_STATUS_INFO of the inline QoS, [`StatusInfo::ALIVE`] if absent (RTPS 2.5,
    /// 9.6.4.9).
    #[inline]
    #[must_use]
    pub const fn status_info(self) -> StatusInfo {
        StatusInfo(self.record().status_info)
    }

    /// Returns the size of the whole sample's serialized payload in bytes, encapsulation included.
    #[inline]
    #[must_use]
    pub const fn size(self) -> u32 {
        match self {
            Self::Data(data) => data.payload_len(),
            Self::DataFrag(fragments) => fragments.sample_size(),
        }
    }

    /// Returns whether the sample is a value of a living instance, not a disposal.
    #[inline]
    #[must_use]
    pub const fn is_message(self) -> bool {
        let is_value = match self {
            Self::Data(data) => data.flags().contains(SubmessageFlags::DATA),
            Self::DataFrag(fragments) => !fragments.is_key(),
        };
        is_value && self.status_info().0 == StatusInfo::ALIVE.0
    }

    /// Returns whether the record holds the sample's first byte.
    #[inline]
    #[must_use]
    pub const fn is_start(self) -> bool {
        match self {
            Self::Data(_) => true,
            Self::DataFrag(fragments) => fragments.starting() == 1,
        }
    }

    /// Returns whether the record holds the sample's last byte.
    #[inline]
    #[must_use]
    pub const fn is_end(self) -> bool {
        match self {
            Self::Data(_) => true,
            Self::DataFrag(DataFrag(record)) => record.ends_sample(),
        }
    }

    /// Returns `std_msgs/Header.stamp` as seconds and nanoseconds, if the payload begins with one.
    /// `None` if the payload's first bytes were not seen or cannot be a stamp.
    #[inline]
    #[must_use]
    pub const fn header_stamp(self) -> Option<(i32, u32)> {
        let record = self.record();
        if record.flags & flag::STAMP == 0 || record.stamp_nanoseconds >= 1_000_000_000 {
            return None;
        }
        Some((record.stamp_seconds.cast_signed(), record.stamp_nanoseconds))
    }
}

/// DATA (RTPS 2.5, 9.4.5.4).
#[derive(Clone, Copy, Debug)]
pub struct Data<'a>(&'a Record);

impl Data<'_> {
    /// Returns the flags of the submessage.
    #[inline]
    #[must_use]
    pub const fn flags(self) -> SubmessageFlags {
        SubmessageFlags(self.0.submessage_flags)
    }

    /// Returns the size of the serialized payload in bytes, encapsulation included.
    #[inline]
    #[must_use]
    pub const fn payload_len(self) -> u32 {
        self.0.payload_len
    }
}

/// DATA_BATCH of RTI Connext: several samples in one submessage. [`crate::walk`] describes it.
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a>(&'a Record);

impl<'a> Batch<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        self.0
    }

    /// Returns the number of the first sample.
    #[inline]
    #[must_use]
    pub const fn first(self) -> SequenceNumber {
        SequenceNumber(self.0.sequence_number)
    }

    /// Returns the number of the last sample. Numbers between the first and the last may be absent.
    #[inline]
    #[must_use]
    pub const fn last(self) -> SequenceNumber {
        self.first().saturating_add(self.0.sample_size as u64)
    }

    /// Returns the number of samples, at most 8,192.
    #[inline]
    #[must_use]
    pub const fn count(self) -> u32 {
        self.0.fragment_start
    }

    /// Returns the size of all samples in bytes, encapsulation included. It is an upper bound if
    /// the record has [`flag::INLINE_QOS_UNREAD`].
    #[inline]
    #[must_use]
    pub const fn size(self) -> u32 {
        self.0.payload_len
    }
}

/// DATA_FRAG (RTPS 2.5, 9.4.5.5), or several consecutive ones.
#[derive(Clone, Copy, Debug)]
pub struct DataFrag<'a>(&'a Record);

impl<'a> DataFrag<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        self.0
    }

    /// Returns writerSN.
    #[inline]
    #[must_use]
    pub const fn sequence_number(self) -> SequenceNumber {
        SequenceNumber(self.0.sequence_number)
    }

    /// Returns fragmentStartingNum: the number of the first fragment, counted from 1.
    #[inline]
    #[must_use]
    pub const fn starting(self) -> u32 {
        self.0.fragment_start
    }

    /// Returns fragmentsInSubmessage, summed over all submessages of the record.
    #[inline]
    #[must_use]
    pub const fn count(self) -> u32 {
        self.0.fragments_in_submessage()
    }

    /// Returns fragmentSize: the size in bytes of every fragment but the sample's last.
    #[inline]
    #[must_use]
    pub const fn fragment_size(self) -> u32 {
        self.0.fragment_size()
    }

    /// Returns sampleSize, which is unverified: no memory may be allocated for it.
    #[inline]
    #[must_use]
    pub const fn sample_size(self) -> u32 {
        self.0.sample_size
    }

    /// Returns the number of fragments of the whole sample; 0 for an invalid fragment size.
    #[inline]
    #[must_use]
    pub const fn total(self) -> u32 {
        match self.fragment_size() {
            0 => 0,
            size => self.sample_size().div_ceil(size),
        }
    }

    /// Returns whether the assembled payload is a key only.
    #[inline]
    #[must_use]
    pub const fn is_key(self) -> bool {
        let flags = SubmessageFlags(self.0.submessage_flags);
        flags.contains(SubmessageFlags::FRAGMENT_KEY)
    }

    /// Returns the INFO_TS in force.
    #[inline]
    #[must_use]
    pub const fn source_timestamp(self) -> RtpsTime {
        self.0.source_timestamp()
    }

    /// Returns the stamp as [`Sample::header_stamp`] does.
    #[inline]
    #[must_use]
    pub const fn header_stamp(self) -> Option<(i32, u32)> {
        Sample::DataFrag(self).header_stamp()
    }

    /// Returns the same submessage limited to the fragments in `starting..end`.
    #[must_use]
    pub const fn part(self, starting: u32, end: u32) -> Record {
        let mut record = *self.0;
        record.fragment_start = starting;
        record.fragments = end.saturating_sub(starting) << 16 | self.fragment_size();
        record
    }
}

/// HEARTBEAT (RTPS 2.5, 9.4.5.7).
#[derive(Clone, Copy, Debug)]
pub struct Heartbeat<'a>(&'a Record);

impl<'a> Heartbeat<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        self.0
    }

    /// Returns firstSN: the oldest sample that the writer has; one more than `last` if it has none.
    #[inline]
    #[must_use]
    pub const fn first(self) -> SequenceNumber {
        SequenceNumber(self.0.sequence_number)
    }

    /// Returns lastSN: the newest sample.
    #[inline]
    #[must_use]
    pub const fn last(self) -> SequenceNumber {
        SequenceNumber(self.0.long())
    }

    /// Returns the count, which grows with every new HEARTBEAT of the writer.
    #[inline]
    #[must_use]
    pub const fn count(self) -> u32 {
        self.0.stamp_seconds
    }
}

/// GAP (RTPS 2.5, 9.4.5.6): the writer will not send the samples from `start` up to the base of
/// `list`, nor the members of `list`. The range may have any length.
#[derive(Clone, Copy, Debug)]
pub struct Gap<'a>(&'a Record);

impl<'a> Gap<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        self.0
    }

    /// Returns gapStart.
    #[inline]
    #[must_use]
    pub const fn start(self) -> SequenceNumber {
        SequenceNumber(self.0.sequence_number)
    }

    /// Returns gapList.
    #[inline]
    #[must_use]
    pub const fn list(self) -> SequenceNumberSet {
        SequenceNumberSet::of(SequenceNumber(self.0.long()), self.0)
    }
}

/// ACKNACK (RTPS 2.5, 9.4.5.3). Its count is not in the record.
#[derive(Clone, Copy, Debug)]
pub struct AckNack<'a>(&'a Record);

impl<'a> AckNack<'a> {
    /// Returns the record of the view.
    #[inline]
    #[must_use]
    pub const fn record(self) -> &'a Record {
        self.0
    }

    /// Returns the number below which the reader acknowledges all samples.
    #[inline]
    #[must_use]
    pub const fn base(self) -> SequenceNumber {
        SequenceNumber(self.0.sequence_number)
    }

    /// Returns readerSNState, whose members are the missing samples.
    #[inline]
    #[must_use]
    pub const fn missing(self) -> SequenceNumberSet {
        SequenceNumberSet::of(self.base(), self.0)
    }
}

/// SequenceNumberSet (RTPS 2.5, 9.4.2.6): a base, and a bitmap whose bit 0 is the base.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct SequenceNumberSet {
    /// The number of bit 0.
    pub base: SequenceNumber,
    /// Length of the bitmap in bits, up to 256. The record holds the first [`Record::BITMAP_BITS`].
    pub num_bits: u32,
    bitmap: [u32; 5],
}

impl SequenceNumberSet {
    #[inline]
    const fn of(base: SequenceNumber, record: &Record) -> Self {
        Self {
            base,
            num_bits: record.stamp_seconds,
            bitmap: [
                record.stamp_nanoseconds,
                record.fragment_start,
                record.fragments,
                record.sample_size,
                record.status_info,
            ],
        }
    }

    /// Returns a set without members.
    #[inline]
    #[must_use]
    pub const fn empty(base: SequenceNumber) -> Self {
        Self {
            base,
            num_bits: 0,
            bitmap: [0; 5],
        }
    }

    /// Iterates over the members in the record, ascending. Numbers saturate at the largest.
    pub fn iter(&self) -> impl Iterator<Item = SequenceNumber> + use<> {
        let Self {
            base,
            num_bits,
            bitmap,
        } = *self;
        let bits = (0..num_bits.min(Record::BITMAP_BITS)).filter(move |bit| {
            let word = bitmap.get((bit / 32) as usize).copied().unwrap_or(0);
            word >> (31 - bit % 32) & 1 == 1
        });
        bits.map(move |bit| base.saturating_add(bit.into()))
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;

    fn of_kind(kind: u8) -> Record {
        Record {
            kind,
            sequence_number: 7,
            payload_len: 2,
            encapsulation: 9,
            stamp_seconds: 34,
            stamp_nanoseconds: 1 << 31 | 1,
            fragment_start: 1 << 30 | 1 << 29,
            ..Record::default()
        }
    }

    #[test]
    fn a_body_is_read_according_to_its_kind() {
        let record = of_kind(kind::HEARTBEAT);
        let Body::Heartbeat(heartbeat) = record.body() else {
            panic!("{record:?}")
        };
        assert_eq!(
            (heartbeat.first(), heartbeat.last(), heartbeat.count()),
            (SequenceNumber(7), SequenceNumber(2 << 32 | 9), 34)
        );
        let record = of_kind(kind::GAP);
        let Body::Gap(gap) = record.body() else {
            panic!("{record:?}")
        };
        let base = SequenceNumber(2 << 32 | 9);
        assert_eq!((gap.start(), gap.list().base), (SequenceNumber(7), base));
        // One bit of the second word lies after numBits.
        assert_eq!(
            gap.list().iter().collect::<Vec<_>>(),
            [base, base + 31, base + 33]
        );
        let record = of_kind(kind::ACKNACK);
        let Body::AckNack(acknack) = record.body() else {
            panic!("{record:?}")
        };
        assert_eq!(acknack.base(), SequenceNumber(7));
        assert_eq!(
            acknack.missing().iter().collect::<Vec<_>>(),
            [7, 7 + 31, 7 + 33].map(SequenceNumber)
        );
        assert!(record.is_acknack() && record.sample().is_none());
        for (kind, is_expected) in [
            (
                kind::COMPLETE,
                matches!(of_kind(kind::COMPLETE).body(), Body::Complete),
            ),
            (
                kind::HANDOVER,
                matches!(of_kind(kind::HANDOVER).body(), Body::Handover),
            ),
            (
                kind::UNDELIVERED,
                matches!(of_kind(kind::UNDELIVERED).body(), Body::Undelivered),
            ),
            (0x7f, matches!(of_kind(0x7f).body(), Body::Unknown)),
        ] {
            assert!(is_expected, "{kind:#04x}");
        }
    }

    #[test]
    fn a_set_is_cut_to_its_record_and_saturates_at_the_largest_number() {
        let all = Record {
            kind: kind::ACKNACK,
            sequence_number: u64::MAX - 1,
            stamp_seconds: 256,
            stamp_nanoseconds: u32::MAX,
            fragment_start: u32::MAX,
            fragments: u32::MAX,
            sample_size: u32::MAX,
            status_info: u32::MAX,
            ..Record::default()
        };
        let Body::AckNack(acknack) = all.body() else {
            panic!("{all:?}")
        };
        let members: Vec<_> = acknack.missing().iter().collect();
        assert_eq!(members.len(), Record::BITMAP_BITS as usize);
        assert_eq!(
            members[..3],
            [u64::MAX - 1, u64::MAX, u64::MAX].map(SequenceNumber)
        );
    }

    #[test]
    fn flags_and_status_distinguish_a_message_from_a_disposal() {
        let message = |kind, submessage_flags, status_info| {
            let record = Record {
                kind,
                submessage_flags,
                status_info,
                ..Record::default()
            };
            record.sample().map(Sample::is_message)
        };
        assert_eq!(message(kind::DATA, 0x05, 0), Some(true));
        assert_eq!(message(kind::DATA, 0x05, 1), Some(false));
        assert_eq!(message(kind::DATA, 0x09, 0), Some(false));
        assert_eq!(message(kind::DATA, 0x03, 3), Some(false));
        // In DATA_FRAG the same bit is K.
        assert_eq!(message(kind::DATA_FRAG, 0x01, 0), Some(true));
        assert_eq!(message(kind::DATA_FRAG, 0x05, 0), Some(false));
        assert_eq!(message(kind::DATA_FRAG, 0x01, 2), Some(false));
        assert_eq!(message(kind::GAP, 0x05, 0), None);
    }

    #[test]
    fn fragments_report_their_position_in_the_sample() {
        let fragments = |start: u32, count: u32| Record {
            kind: kind::DATA_FRAG,
            fragment_start: start,
            fragments: count << 16 | 1344,
            sample_size: 1344 * 10 + 1,
            payload_len: count * 1344,
            ..Record::default()
        };
        let ends = |record: &Record| {
            let sample = record.sample().unwrap();
            (sample.is_start(), sample.is_end(), sample.size())
        };
        assert_eq!(ends(&fragments(1, 10)), (true, false, 13_441));
        assert_eq!(ends(&fragments(2, 10)), (false, true, 13_441));
        let record = fragments(3, 5);
        let Some(Sample::DataFrag(seen)) = record.sample() else {
            panic!("{record:?}")
        };
        assert_eq!((seen.starting(), seen.count(), seen.total()), (3, 5, 11));
        assert_eq!(
            seen.part(4, 6),
            Record {
                payload_len: record.payload_len,
                ..fragments(4, 2)
            }
        );
        let impossible = Record {
            fragments: 1 << 16,
            ..record
        };
        let Some(Sample::DataFrag(impossible)) = impossible.sample() else {
            panic!("{impossible:?}")
        };
        assert_eq!(impossible.total(), 0);
    }
}
