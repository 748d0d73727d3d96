//! Restores the capture order of records.
//!
//! Records come from the kernel program's ring or, for a datagram captured whole, from the walk
//! over its bytes; either path may be faster. A retransmission must not overtake the gap that it
//! fills, since it would count as a sample that was never missing. Therefore every record waits
//! until records of both paths must have arrived. The buffer decides nothing and knows no writer.
//!
//! The kernel reports a full socket buffer after the datagram, but the model must count it before.
//! Records of full socket buffers therefore precede all records of the same or a later time. For a
//! captured datagram the kernel reports only the token. The model then receives each sample record
//! of the datagram twice: first with SOCKET_FULL, then without.
//!
//! Records from polling shared memory also wait here: a uprobe or a socket may see samples that
//! polling misses. A message is polled after it was sent, so a record from its sender comes first.
//!
//! Segments of Zenoh wait with the records, because the model's clock follows the records. Their
//! content is read when they leave the buffer.

use std::collections::{HashSet, VecDeque};

use ros2probe_model::facts::bounded::{self, Bounded, Sum};
use ros2probe_model::observe::input::{Captured, Input};
use ros2probe_model::observe::observer::Observer;
use ros2probe_wire::Record;
use ros2probe_wire::record::{Body, flag};
use ros2probe_wire::walk::{self, Envelope};

use super::border::observe;
use super::filter::Filter;
use super::streams::Chunk;
use super::system::Clocks;
use crate::tables::{
    PolledRecords, SegmentBytes, UndeliveredDatagrams, WaitingRecords, WalkedRecords,
};

/// Maximum capacity that an empty queue keeps. A larger queue is freed after a burst.
const MAX_KEPT_CAPACITY: usize = 512;
/// Maximum number of records read per round: several rings of the default size.
const RECORDS_PER_ROUND: usize = 32_768;
/// Maximum delay of a captured datagram after the report of its drop.
const LATE_NANOSECONDS: u64 = 1_000_000_000;

/// The records of one tap.
#[derive(Debug, Default)]
pub struct ReorderBuffer {
    /// Records of the kernel, in the kernel's clock.
    kernel: VecDeque<Record>,
    /// Records with [`flag::SOCKET_FULL`], sorted by time in the kernel's clock.
    socket_full: VecDeque<Record>,
    walked: Bounded<WalkedRecords, VecDeque<Walked>>,
    /// Records of polled messages, with the time in the kernel's clock.
    polled: Bounded<PolledRecords, VecDeque<(u64, Record)>>,
    segments: VecDeque<Segment>,
    segment_bytes: Sum<SegmentBytes>,
    /// Tokens of captured datagrams that were not delivered, with the time in the kernel's clock.
    undelivered: Bounded<UndeliveredDatagrams, VecDeque<(u64, u32)>>,
    undelivered_tokens: HashSet<u32>,
    /// Time of the latest record of the kernel's ring, in the kernel's clock.
    latest_record: u64,
}

/// A record of a captured datagram.
#[derive(Clone, Copy, Debug)]
struct Walked {
    /// Its time in the kernel's clock.
    at: u64,
    /// The record, with its time in the wall clock.
    record: Record,
    /// Whether the record was already passed as not delivered.
    no_room_reported: bool,
}

/// A segment of a connection of Zenoh, or a part of one.
#[derive(Debug)]
pub struct Segment {
    /// Its time in the kernel's clock.
    at: u64,
    chunk: Chunk<'static>,
    bytes: Box<[u8]>,
}

/// The next record or segment in order, with its time in the wall clock.
#[derive(Debug)]
pub enum Next {
    /// A record written by the kernel program.
    Kernel(Record),
    /// A record found in a captured datagram.
    Walked(Record),
    /// A record polled in shared memory.
    Polled(Record),
    /// A segment of a connection of Zenoh.
    Segment(Segment),
}

impl Segment {
    /// Returns the segment with its bytes.
    #[must_use]
    pub fn chunk(&self) -> Chunk<'_> {
        Chunk {
            bytes: &self.bytes,
            ..self.chunk
        }
    }

    const fn size(&self) -> usize {
        size_of::<Self>() + self.bytes.len()
    }
}

impl ReorderBuffer {
    /// Takes records from the kernel's ring, at most one round: a flood may refill the ring as fast
    /// as it is emptied. Records stay in the ring while the buffer is full. Returns the time of the
    /// latest record if the ring may have more, else `u64::MAX`. Adds the bytes read to
    /// `copied_bytes`.
    pub fn take_records(&mut self, filter: &mut Filter, copied_bytes: &mut u64) -> u64 {
        for _ in 0..RECORDS_PER_ROUND {
            if self.is_full() {
                return self.latest_record;
            }
            let Some(record) = filter.next_record() else {
                return u64::MAX;
            };
            *copied_bytes += size_of::<Record>() as u64;
            self.latest_record = record.time;
            self.kernel(record);
        }
        self.latest_record
    }

    /// Accepts a record of the kernel's ring, with its time in the kernel's clock.
    pub fn kernel(&mut self, record: Record) {
        if matches!(record.body(), Body::Undelivered) {
            self.undelivered_tokens.insert(record.datagram);
            let report = (record.time, record.datagram);
            if let Some((_, oldest)) = self.undelivered.push_back(report) {
                self.undelivered_tokens.remove(&oldest);
            }
            return;
        }
        if record.flags & flag::SOCKET_FULL != 0 {
            // Records of several CPUs may be out of order by microseconds.
            let place = self
                .socket_full
                .partition_point(|other| other.time <= record.time);
            self.socket_full.insert(place, record);
        } else {
            self.kernel.push_back(record);
        }
        bounded::note::<WaitingRecords>(self.waiting());
    }

    /// Accepts a record of a captured datagram, with its time in the wall clock. `at` is the same
    /// time in the kernel's clock. Returns the record if too many wait.
    #[must_use]
    pub fn add_captured(&mut self, at: u64, record: Record) -> Option<Record> {
        let left = self.walked.push_back(Walked {
            at,
            record,
            no_room_reported: false,
        });
        left.map(|walked| walked.record)
    }

    /// Accepts a record of a polled message, with its time in the wall clock. `at` is the same time
    /// in the kernel's clock. Returns the record if too many wait.
    #[must_use]
    pub fn add_polled(&mut self, at: u64, record: Record) -> Option<Record> {
        let left = self.polled.push_back((at, record));
        left.map(|(_, record)| record)
    }

    /// Accepts a segment of Zenoh, with its time in the wall clock. `at` is the same time in the
    /// kernel's clock. The caller then reads the segments of [`Self::take_excess_segment`].
    pub fn segment(&mut self, at: u64, chunk: &Chunk<'_>) {
        let segment = Segment {
            at,
            chunk: chunk.without_bytes(),
            bytes: chunk.bytes.into(),
        };
        self.segment_bytes.add(segment.size());
        self.segments.push_back(segment);
    }

    /// Removes and returns the oldest segment if too many bytes wait.
    pub fn take_excess_segment(&mut self) -> Option<Segment> {
        let is_exceeded = self.segment_bytes.is_exceeded();
        is_exceeded.then(|| self.take_segment()).flatten()
    }

    fn take_segment(&mut self) -> Option<Segment> {
        let segment = self.segments.pop_front()?;
        self.segment_bytes.sub(segment.size());
        Some(segment)
    }

    /// Passes the announcements in a captured datagram to the model. Its records of user data wait
    /// in this buffer; `at` is the time of the datagram in the kernel's clock. `complete` adds
    /// facts to each record that the bytes do not contain.
    pub fn datagram(
        &mut self,
        at: u64,
        envelope: &Envelope,
        payload: &[u8],
        complete: impl Fn(&mut Record),
        observer: &mut Observer,
    ) {
        let captured = Captured::new(envelope, payload, false);
        read(captured, payload, observer, |mut record, observer| {
            complete(&mut record);
            if let Some(record) = self.add_captured(at, record) {
                observe(observer, &record);
            }
        });
    }

    /// Does the same as [`Self::datagram`] for a message that was polled in shared memory.
    pub fn polled_message(
        &mut self,
        at: u64,
        envelope: &Envelope,
        payload: &[u8],
        observer: &mut Observer,
    ) {
        let captured = Captured::new(envelope, payload, true);
        read(captured, payload, observer, |mut record, observer| {
            record.flags |= flag::SHM;
            if let Some(record) = self.add_polled(at, record) {
                observe(observer, &record);
            }
        });
    }

    /// Returns the number of waiting records of the kernel's ring.
    fn waiting(&self) -> usize {
        self.kernel.len() + self.socket_full.len()
    }

    /// Returns whether the buffer accepts no further records of the kernel's ring.
    fn is_full(&self) -> bool {
        self.waiting() >= WaitingRecords::CAP
    }

    /// Removes and returns the oldest record or segment, unless it is younger than `until` in the
    /// kernel's clock.
    pub fn next(&mut self, clocks: &Clocks, until: u64) -> Option<Next> {
        let kernel = self.kernel.front().map(|record| record.time);
        let walked = self.walked.front().map(|walked| walked.at);
        let polled = self.polled.front().map(|(at, _)| *at);
        let socket_full = self.socket_full.front().map(|record| record.time);
        let segment = self.segments.front().map(|segment| segment.at);
        let queues = [kernel, walked, polled, socket_full, segment];
        let oldest = queues.into_iter().flatten().min();
        if oldest.is_none_or(|oldest| oldest > until) {
            self.forget_undelivered(until);
            self.release_memory();
            return None;
        }
        let of_kernel = |mut record: Record| {
            record.time = clocks.wall_time_of(record.time).0;
            Next::Kernel(record)
        };
        if socket_full == oldest {
            return self.socket_full.pop_front().map(of_kernel);
        }
        if kernel == oldest {
            return self.kernel.pop_front().map(of_kernel);
        }
        if segment == oldest {
            let mut segment = self.take_segment()?;
            if clocks.step != 0 {
                segment.chunk.time = clocks.wall_time_of(segment.at);
            }
            return Some(Next::Segment(segment));
        }
        if walked != oldest {
            let (at, mut record) = self.polled.pop_front()?;
            if clocks.step != 0 {
                record.time = clocks.wall_time_of(at).0;
            }
            return Some(Next::Polled(record));
        }
        let walked = self.walked.front_mut()?;
        let record = walked.record;
        if !walked.no_room_reported && self.undelivered_tokens.contains(&record.datagram) {
            walked.no_room_reported = true;
            if record.has_samples() {
                let flags = record.flags | flag::SOCKET_FULL;
                return Some(Next::Walked(Record { flags, ..record }));
            }
        }
        let mut record = record;
        if clocks.step != 0 {
            record.time = clocks.wall_time_of(walked.at).0;
        }
        self.walked.pop_front();
        Some(Next::Walked(record))
    }

    fn release_memory(&mut self) {
        for records in [&mut self.kernel, &mut self.socket_full] {
            if records.is_empty() && records.capacity() > MAX_KEPT_CAPACITY {
                *records = VecDeque::new();
            }
        }
        if self.walked.is_empty() && self.walked.capacity() > MAX_KEPT_CAPACITY {
            self.walked.take();
        }
        if self.polled.is_empty() && self.polled.capacity() > MAX_KEPT_CAPACITY {
            self.polled.take();
        }
        if self.segments.is_empty() && self.segments.capacity() > MAX_KEPT_CAPACITY {
            self.segments = VecDeque::new();
        }
    }

    /// Forgets reports from more than a second before `until`: their records have arrived.
    fn forget_undelivered(&mut self, until: u64) {
        let before = until.saturating_sub(LATE_NANOSECONDS);
        while let Some((_, token)) = self.undelivered.pop_front_if(|(at, _)| *at < before) {
            self.undelivered_tokens.remove(&token);
        }
    }
}

/// Passes a captured datagram to the model, and each record of its user data to `user_data`.
fn read(
    captured: Captured<'_>,
    payload: &[u8],
    observer: &mut Observer,
    mut user_data: impl FnMut(Record, &mut Observer),
) {
    let outcome = walk::datagram(payload, captured.envelope, None, |found| {
        let found = &found;
        observer.input(Input::Submessage { captured, found });
        if !found.record.writer().entity.is_builtin() {
            user_data(found.record, observer);
        }
    });
    observer.input(Input::DatagramEnd(outcome));
}

#[cfg(test)]
mod tests {
    use ros2probe_model::graph::zenoh::StreamId;
    use ros2probe_wire::Timestamp;
    use ros2probe_wire::record::kind;

    use super::*;
    use crate::streams::MissingBefore;
    use crate::tables::tests::assert_driven;
    use ros2probe_wire::time::MILLISECOND;

    const SETTLE: u64 = 80 * MILLISECOND;

    fn clocks(milliseconds: u64) -> Clocks {
        Clocks {
            now: Timestamp((1_000_000 + milliseconds) * MILLISECOND),
            monotonic: milliseconds * MILLISECOND,
            step: 0,
        }
    }

    fn of_the_kernel(number: u64, milliseconds: u64) -> Record {
        Record {
            kind: kind::DATA,
            sequence_number: number,
            time: clocks(milliseconds).monotonic,
            ..Record::default()
        }
    }

    fn socket_full(number: u64, milliseconds: u64) -> Record {
        Record {
            flags: flag::SOCKET_FULL,
            ..of_the_kernel(number, milliseconds)
        }
    }

    fn undelivered(datagram: u32, milliseconds: u64) -> Record {
        Record {
            kind: kind::UNDELIVERED,
            datagram,
            ..of_the_kernel(0, milliseconds)
        }
    }

    /// Returns a captured record with its time in the kernel's clock.
    fn captured(number: u64, milliseconds: u64) -> (u64, Record) {
        let clocks = clocks(milliseconds);
        let record = Record {
            time: clocks.now.0,
            ..of_the_kernel(number, milliseconds)
        };
        (clocks.monotonic, record)
    }

    fn walked(order: &mut ReorderBuffer, (at, record): (u64, Record)) {
        assert!(order.add_captured(at, record).is_none());
    }

    /// Returns the sequence numbers of due records, negative for records of a full socket buffer.
    fn numbers(order: &mut ReorderBuffer, clocks: &Clocks) -> Vec<i64> {
        std::iter::from_fn(|| order.next(clocks, clocks.monotonic.saturating_sub(SETTLE)))
            .map(|next| {
                let (Next::Kernel(record) | Next::Walked(record) | Next::Polled(record)) = next
                else {
                    panic!("{next:?}")
                };
                let age = clocks.now.nanoseconds_since(Timestamp(record.time));
                assert!(age >= SETTLE.cast_signed(), "{age}");
                let number = record.sequence_number.cast_signed();
                let delivered = record.flags & flag::SOCKET_FULL == 0;
                if delivered { number } else { -number }
            })
            .collect()
    }

    #[test]
    fn a_retransmission_in_a_captured_frame_does_not_overtake_the_gap_it_fills() {
        let mut order = ReorderBuffer::default();
        // Sample 10 was lost. It is retransmitted in a frame that user space reads before the
        // record of sample 11.
        walked(&mut order, captured(10, 30));
        order.kernel(of_the_kernel(9, 1));
        order.kernel(of_the_kernel(11, 20));
        order.kernel(of_the_kernel(12, 35));
        assert!(numbers(&mut order, &clocks(80)).is_empty());
        assert_eq!(numbers(&mut order, &clocks(105)), [9, 11]);
        assert_eq!(numbers(&mut order, &clocks(200)), [10, 12]);
    }

    #[test]
    fn a_full_socket_buffer_is_reported_before_records_of_the_same_or_a_later_time() {
        let mut order = ReorderBuffer::default();
        order.kernel(of_the_kernel(1, 5));
        order.kernel(of_the_kernel(2, 10));
        // A record of another CPU, and two that are out of order.
        order.kernel(of_the_kernel(3, 12));
        order.kernel(socket_full(3, 12));
        order.kernel(socket_full(2, 10));
        walked(&mut order, captured(4, 12));
        assert_eq!(numbers(&mut order, &clocks(200)), [1, -2, 2, -3, 3, 4]);
        // The record of the arrival waits in a run and has the time of the last fragment.
        order.kernel(socket_full(7, 300));
        order.kernel(of_the_kernel(6, 299));
        order.kernel(of_the_kernel(7, 320));
        assert_eq!(numbers(&mut order, &clocks(390)), [6, -7]);
        assert_eq!(numbers(&mut order, &clocks(400)), [7]);
    }

    #[test]
    fn samples_of_an_undelivered_datagram_are_first_reported_as_not_delivered() {
        for pieces_first in [true, false] {
            let mut order = ReorderBuffer::default();
            let of_kind = |kind, (at, record)| (at, Record { kind, ..record });
            let of = |token, (at, record)| {
                let record = Record {
                    datagram: token,
                    ..record
                };
                (at, record)
            };
            if !pieces_first {
                order.kernel(undelivered(8, 10));
            }
            walked(&mut order, of(7, captured(1, 9)));
            walked(&mut order, of(8, captured(2, 10)));
            walked(
                &mut order,
                of(8, of_kind(kind::DATA_BATCH, captured(3, 10))),
            );
            walked(&mut order, of(8, of_kind(kind::HEARTBEAT, captured(4, 10))));
            walked(&mut order, of(9, captured(5, 11)));
            if pieces_first {
                order.kernel(undelivered(8, 10));
            }
            assert_eq!(
                numbers(&mut order, &clocks(200)),
                [1, -2, 2, -3, 3, 4, 5],
                "{pieces_first}"
            );
            // Tokens are reused.
            assert!(numbers(&mut order, &clocks(4000)).is_empty());
            walked(&mut order, of(8, captured(6, 5000)));
            assert_eq!(numbers(&mut order, &clocks(6000)), [6]);
        }
    }

    #[test]
    fn a_polled_message_does_not_overtake_earlier_messages_of_its_sender() {
        let mut order = ReorderBuffer::default();
        // Samples 199 and 200 are polled in one round; 171 and 198 arrive through the ring.
        for (number, at) in [(170, 1), (199, 40), (200, 44)] {
            let (at, record) = captured(number, at);
            assert!(order.add_polled(at, record).is_none());
        }
        for (number, at) in [(171, 5), (198, 38), (199, 39)] {
            walked(&mut order, captured(number, at));
        }
        let all = [170, 171, 198, 199, 199, 200];
        assert_eq!(numbers(&mut order, &clocks(200)), all);
    }

    #[test]
    fn a_step_of_the_wall_clock_delays_no_record() {
        let mut order = ReorderBuffer::default();
        let (_, back) = captured(1, 3_600_000);
        let at = clocks(10).monotonic_of(Timestamp(back.time));
        assert!(order.add_captured(at, back).is_none());
        let next = order.next(&clocks(90), 10 * MILLISECOND);
        assert!(matches!(next, Some(Next::Walked(_))), "{next:?}");
    }

    #[test]
    fn memory_of_a_burst_is_released_after_it() {
        let mut order = ReorderBuffer::default();
        for number in 0..20_000 {
            order.kernel(of_the_kernel(number, 1));
            let (at, record) = captured(number, 1);
            let _ = order.add_captured(at, record);
        }
        assert!(order.kernel.capacity() >= 20_000);
        while order.next(&clocks(900), 900 * MILLISECOND).is_some() {}
        assert!(order.kernel.capacity() <= MAX_KEPT_CAPACITY);
        assert!(order.walked.capacity() <= MAX_KEPT_CAPACITY);
    }

    fn segment(number: u32, milliseconds: u64, bytes: &[u8]) -> (u64, Chunk<'_>) {
        let clocks = clocks(milliseconds);
        let chunk = Chunk {
            time: clocks.now,
            stream: StreamId::default(),
            sequence_number: number,
            syn: false,
            end: false,
            boundary: Some(crate::streams::Protocol::Zenoh),
            before: MissingBefore::Unknown,
            bytes,
            length: 4,
        };
        (clocks.monotonic, chunk)
    }

    #[test]
    fn zenoh_segments_and_records_leave_the_buffer_in_order_of_time() {
        let mut order = ReorderBuffer::default();
        for (number, milliseconds) in [(1, 10), (2, 30), (3, 110)] {
            let (at, chunk) = segment(number, milliseconds, b"four");
            order.segment(at, &chunk);
            assert!(order.take_excess_segment().is_none());
        }
        order.kernel(of_the_kernel(9, 20));
        walked(&mut order, captured(10, 40));
        let clocks = clocks(150);
        let mut numbers = Vec::new();
        while let Some(next) = order.next(&clocks, clocks.monotonic - SETTLE) {
            numbers.push(match next {
                Next::Kernel(record) | Next::Walked(record) | Next::Polled(record) => {
                    record.sequence_number
                }
                Next::Segment(segment) => {
                    let chunk = segment.chunk();
                    let age = clocks.now.nanoseconds_since(chunk.time);
                    assert!(age >= SETTLE.cast_signed() && chunk.bytes == b"four");
                    chunk.sequence_number.into()
                }
            });
        }
        assert_eq!(numbers, [1, 9, 2, 10]);
        assert_eq!(order.segments.len(), 1);
    }

    #[test]
    fn segments_beyond_the_byte_cap_are_passed_on_early_and_in_order() {
        let mut order = ReorderBuffer::default();
        let bytes = vec![0; 10_000];
        let mut early = Vec::new();
        for number in 0..1000 {
            let (at, chunk) = segment(number, 1, &bytes);
            order.segment(at, &chunk);
            while let Some(passed) = order.take_excess_segment() {
                early.push(passed.chunk().sequence_number);
            }
            assert!(order.segment_bytes.used() <= SegmentBytes::CAP);
        }
        assert_driven::<SegmentBytes>();
        let count = u32::try_from(early.len()).unwrap();
        assert!(
            count > 100 && early == Vec::from_iter(0..count),
            "{early:?}"
        );
        let clocks = clocks(900);
        while order.next(&clocks, clocks.monotonic).is_some() {}
        assert_eq!(
            (order.segment_bytes.used(), order.segments.capacity()),
            (0, 0)
        );
    }

    #[test]
    fn large_segments_after_small_ones_stay_within_the_byte_cap() {
        let mut order = ReorderBuffer::default();
        let large = vec![0; 60_000];
        for number in 0..100_000 {
            let bytes = if number < 50_000 { b"four" } else { &large[..] };
            let (at, chunk) = segment(number, 1, bytes);
            order.segment(at, &chunk);
            while order.take_excess_segment().is_some() {}
            assert!(order.segment_bytes.used() <= SegmentBytes::CAP);
        }
    }

    #[test]
    fn records_beyond_the_caps_are_refused() {
        let mut order = ReorderBuffer::default();
        let refused = (0..20_000).filter(|number| {
            let (at, record) = captured(*number, 1);
            order.add_captured(at, record).is_some()
        });
        assert_eq!(refused.count(), 20_000 - WalkedRecords::CAP);
        assert_driven::<WalkedRecords>();
        let refused = (0..20_000).filter(|number| {
            let (at, record) = captured(*number, 1);
            order.add_polled(at, record).is_some()
        });
        assert_eq!(refused.count(), 20_000 - PolledRecords::CAP);
        assert_driven::<PolledRecords>();
    }

    #[test]
    fn reports_of_full_socket_buffers_beyond_the_cap_evict_the_oldest() {
        let mut order = ReorderBuffer::default();
        for datagram in 0..100_000 {
            order.kernel(undelivered(datagram, 1));
        }
        assert_driven::<UndeliveredDatagrams>();
        assert_eq!(order.undelivered_tokens.len(), UndeliveredDatagrams::CAP);
        assert!(order.undelivered_tokens.contains(&99_999));
    }

    #[test]
    fn the_buffer_is_full_at_the_cap_of_kernel_records() {
        let mut order = ReorderBuffer::default();
        let mut number = 0;
        while !order.is_full() {
            let record = match number % 2 {
                0 => of_the_kernel(number, number),
                _ => socket_full(number, number),
            };
            order.kernel(record);
            number += 1;
        }
        assert_driven::<WaitingRecords>();
    }
}
