//! Reassembles the payloads of samples that subscriptions request: from one DATA, or from
//! DATA_FRAGs in any order and with duplicates.
//!
//! Announced sizes are not trusted: memory grows with the bytes that arrived, to at most twice as
//! many, within one budget for all samples. When the budget is exhausted, the oldest sample is
//! dropped. Counting of samples happens elsewhere.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, Sample};
use crate::facts::tables::AssembledSamples;
use bytes::Bytes;
use foldhash::HashMap;
use ros2probe_wire::{Guid, SequenceNumber};

/// Memory per sample, and per fragment that arrived early, in addition to its bytes.
const ENTRY_OVERHEAD: usize = 128;
/// An unfinished sample is dropped after this long without a fragment.
const FRAGMENT_TIMEOUT: Duration = Duration::from_secs(30);
/// Minimum allocation for a sample, in bytes.
const MIN_ALLOCATION: usize = 4096;
/// Minimum size of a buffer that is reused: the kernel would have to clear each page of a new one.
const MIN_REUSED_BUFFER: usize = 128 << 10;
/// Maximum number of buffers kept for reuse, and the time from the last fragment of a payload until
/// its buffer is freed.
const MAX_SPARE_BUFFERS: usize = 4;
const SPARE_BUFFER_LIFETIME: Duration = Duration::from_secs(10);

/// All unfinished samples.
#[derive(Debug)]
pub struct Assembly {
    parts: Bounded<AssembledSamples, HashMap<(Guid, SequenceNumber), Part>>,
    /// The same samples in the order in which they began.
    by_age: Bounded<AssembledSamples, BTreeMap<u64, (Guid, SequenceNumber)>>,
    /// Payloads that were passed on, oldest first. A buffer is free once its readers have dropped
    /// it.
    handed_out: VecDeque<(ModelTime, Bytes)>,
    begun: u64,
    bytes: usize,
    limit: usize,
    evictions: u64,
}

#[derive(Debug)]
struct Part {
    age: u64,
    size: usize,
    fragment_size: usize,
    /// The bytes before the first missing fragment.
    head: Vec<u8>,
    /// Number of the first missing fragment, from 1.
    next: u32,
    /// Fragments after the missing one, by the number of the first in each consecutive group.
    ahead: BTreeMap<u32, Box<[u8]>>,
    /// Bytes of `ahead`, including the overhead of each entry.
    ahead_bytes: usize,
    last_changed: ModelTime,
}

impl Assembly {
    /// Creates an empty assembly that holds at most `limit` bytes.
    #[must_use]
    pub fn new(limit: usize) -> Self {
        Self {
            parts: Bounded::default(),
            by_age: Bounded::default(),
            handed_out: VecDeque::new(),
            begun: 0,
            bytes: 0,
            limit,
            evictions: 0,
        }
    }

    /// Returns the bytes held, their cap, and the number of samples dropped because of it.
    #[must_use]
    pub const fn size(&self) -> (usize, usize, u64) {
        (self.bytes, self.limit, self.evictions)
    }

    /// Adds the bytes of a DATA or DATA_FRAG. `other_bytes` bytes of the budget are used elsewhere.
    pub fn put(&mut self, sample: &Sample, payload: &[u8], other_bytes: usize) {
        let Some((size, fragment_size)) = sizes(sample, payload) else {
            return;
        };
        let (now, key) = (sample.head.at, (sample.head.writer, sample.sequence_number));
        if !self.parts.contains_key(&key) {
            if self.parts.is_full() {
                self.parts.refuse();
                self.evict();
            }
            self.begun += 1;
            self.by_age.insert(self.begun, key);
            let part = Part {
                head: self.buffer(size),
                ..Part::new(self.begun, size, fragment_size, now)
            };
            self.bytes += part.bytes() + ENTRY_OVERHEAD;
            self.parts.insert(key, part);
        }
        let Some(part) = self.parts.get_mut(&key) else {
            return;
        };
        // Fragments that contradict earlier ones of the same sample cannot be used.
        if part.size != size || part.fragment_size != fragment_size {
            return;
        }
        let before = part.bytes();
        part.last_changed = now;
        let start = match sample.content {
            Content::Data { .. } => 1,
            Content::DataFrag(fragments) => fragments.starting,
        };
        part.put(start, payload);
        self.bytes = self.bytes + part.bytes() - before;
        while self.bytes + self.handed_out_bytes() + other_bytes > self.limit {
            if self.handed_out.pop_front().is_none() && !self.evict() {
                break;
            }
        }
    }

    /// Drops the oldest sample. Returns whether there was one.
    fn evict(&mut self) -> bool {
        let oldest = self.by_age.first_key_value().map(|(_, key)| *key);
        if let Some((writer, number)) = oldest {
            self.forget(writer, number);
            self.evictions += 1;
        }
        oldest.is_some()
    }

    /// Returns whether all bytes of this sample have arrived.
    #[must_use]
    pub fn is_whole(&self, writer: Guid, number: SequenceNumber) -> bool {
        let part = self.parts.get(&(writer, number));
        part.is_some_and(|part| part.head.len() == part.size)
    }

    /// Removes a sample that was counted and returns its bytes, or `None` if some are missing.
    pub fn take(&mut self, writer: Guid, number: SequenceNumber) -> Option<Bytes> {
        let part = self.remove((writer, number))?;
        if part.head.len() != part.size {
            return None;
        }
        let payload = Bytes::from(part.head);
        if (MIN_REUSED_BUFFER..=self.limit / 2).contains(&payload.len()) {
            let others = self.limit / 2 - payload.len();
            while self.handed_out.len() >= MAX_SPARE_BUFFERS || self.handed_out_bytes() > others {
                self.handed_out.pop_front();
            }
            self.handed_out
                .push_back((part.last_changed, payload.clone()));
        }
        Some(payload)
    }

    fn handed_out_bytes(&self) -> usize {
        self.handed_out
            .iter()
            .map(|(_, payload)| payload.len())
            .sum()
    }

    /// Returns an empty buffer. A large one may be that of an earlier payload that has no reader
    /// any longer.
    fn buffer(&mut self, size: usize) -> Vec<u8> {
        let is_free = |(_, payload): &(ModelTime, Bytes)| {
            (size..=2 * size).contains(&payload.len()) && payload.is_unique()
        };
        let index = (size >= MIN_REUSED_BUFFER).then(|| self.handed_out.iter().position(is_free));
        let free = index
            .flatten()
            .and_then(|index| self.handed_out.remove(index));
        let mut buffer = free.map_or_else(Vec::new, |(_, payload)| Vec::from(payload));
        buffer.clear();
        buffer
    }

    /// Drops this sample.
    pub fn forget(&mut self, writer: Guid, number: SequenceNumber) {
        self.remove((writer, number));
    }

    /// Drops all samples of a writer that no subscription requests any longer.
    pub fn release(&mut self, writer: Guid) {
        self.retain(|key, _| key.0 != writer);
    }

    /// Drops samples that have received no fragment for a long time.
    pub fn expire(&mut self, now: ModelTime) {
        self.retain(|_, part| part.last_changed + FRAGMENT_TIMEOUT > now);
        self.handed_out
            .retain(|(at, _)| *at + SPARE_BUFFER_LIFETIME > now);
    }

    fn retain(&mut self, mut keep: impl FnMut(&(Guid, SequenceNumber), &Part) -> bool) {
        let (ages, bytes) = (&mut self.by_age, &mut self.bytes);
        self.parts.retain(|key, part| {
            let keeps = keep(key, part);
            if !keeps {
                ages.remove(&part.age);
                *bytes -= part.bytes() + ENTRY_OVERHEAD;
            }
            keeps
        });
    }

    fn remove(&mut self, key: (Guid, SequenceNumber)) -> Option<Part> {
        let part = self.parts.remove(&key)?;
        self.by_age.remove(&part.age);
        self.bytes -= part.bytes() + ENTRY_OVERHEAD;
        Some(part)
    }
}

impl Part {
    const fn new(age: u64, size: usize, fragment_size: usize, now: ModelTime) -> Self {
        Self {
            age,
            size,
            fragment_size,
            head: Vec::new(),
            next: 1,
            ahead: BTreeMap::new(),
            ahead_bytes: 0,
            last_changed: now,
        }
    }

    fn bytes(&self) -> usize {
        self.head.capacity() + self.ahead_bytes
    }

    /// Adds consecutive fragments, the first of which has the number `start`.
    fn put(&mut self, start: u32, bytes: &[u8]) {
        if start > self.next {
            let known = self.ahead.get(&start).map_or(0, |known| known.len());
            if bytes.len() > known {
                let entry = self.ahead.insert(start, bytes.into());
                let before = entry.map_or(0, |entry| entry.len() + ENTRY_OVERHEAD);
                self.ahead_bytes = self.ahead_bytes + bytes.len() + ENTRY_OVERHEAD - before;
            }
            return;
        }
        self.append(start, bytes);
        while let Some(entry) = self.ahead.first_entry()
            && *entry.key() <= self.next
        {
            let (start, bytes) = entry.remove_entry();
            self.ahead_bytes -= bytes.len() + ENTRY_OVERHEAD;
            self.append(start, &bytes);
        }
    }

    /// Appends the new fragments among those that begin at `start`, which is at most `next`.
    fn append(&mut self, start: u32, bytes: &[u8]) {
        let skipped = usize::try_from(self.next - start).unwrap_or(usize::MAX);
        let Some(known) = skipped.checked_mul(self.fragment_size) else {
            return;
        };
        let left = self.size - self.head.len();
        let bytes = bytes.get(known..).unwrap_or_default();
        // Only the last fragment may be short, and it may have padding after it.
        let len = if bytes.len() >= left {
            left
        } else {
            bytes.len() - bytes.len() % self.fragment_size
        };
        let bytes = bytes.get(..len).unwrap_or_default();
        let needed = self.head.len() + len;
        if needed > self.head.capacity() {
            let roomy = needed.max(2 * self.head.capacity()).max(MIN_ALLOCATION);
            let more = roomy.min(self.size) - self.head.len();
            self.head.reserve_exact(more);
        }
        self.head.extend_from_slice(bytes);
        let fragments = u32::try_from(len.div_ceil(self.fragment_size));
        self.next = self.next.saturating_add(fragments.unwrap_or(u32::MAX));
    }
}

/// Returns the sizes of the sample and of its fragments, or `None` if the bytes cannot be used.
fn sizes(sample: &Sample, payload: &[u8]) -> Option<(usize, usize)> {
    if !sample.has_known_begin || !sample.is_message() {
        return None;
    }
    match sample.content {
        Content::Data { .. } => (!payload.is_empty()).then_some((payload.len(), payload.len())),
        Content::DataFrag(fragments) => {
            let size = usize::try_from(fragments.sample_size).ok()?;
            let fragment_size = usize::try_from(fragments.fragment_size).ok()?;
            let is_possible = size > 0 && fragment_size > 0 && fragments.starting > 0;
            is_possible.then_some((size, fragment_size))
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use ros2probe_wire::record::{flag, kind};
    use ros2probe_wire::rtps::SubmessageFlags;
    use ros2probe_wire::{EntityId, GuidPrefix, Record};

    use super::*;
    use crate::facts::observation::tests::sample;

    fn writer(number: u8) -> Guid {
        Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, 1, 3]))
    }

    /// Passes the sample of a record to [`Assembly::put`].
    fn put(assembly: &mut Assembly, record: &Record, payload: &[u8], other_bytes: usize) {
        assembly.put(&sample(record), payload, other_bytes);
    }

    fn fragment(of: Guid, number: u64, start: u32, count: u32, size: u32, of_size: u32) -> Record {
        Record {
            kind: kind::DATA_FRAG,
            writer: zerocopy::transmute!(of),
            sequence_number: number,
            fragment_start: start,
            fragments: count << 16 | of_size,
            sample_size: size,
            time: number,
            ..Record::default()
        }
    }

    /// Returns a payload in which every offset has a recognisable value.
    fn payload(size: usize) -> Vec<u8> {
        (0..size).map(|place| (place * 7 % 251) as u8).collect()
    }

    proptest! {
        #[test]
        fn fragments_in_any_order_and_repetition_yield_the_same_bytes(
            size in 1_usize..4000,
            fragment_size in 1_usize..700,
            cuts in prop::collection::vec((0_usize..400, 1_usize..9), 0..60),
            padding in 0_usize..4,
        ) {
            let whole = payload(size);
            let total = size.div_ceil(fragment_size);
            let mut assembly = Assembly::new(1 << 20);
            let all = (0..total).rev().map(|start| (start, 1));
            for (start, count) in cuts.into_iter().chain(all) {
                let start = start % total;
                let count = count.min(total - start);
                let end = size.min((start + count) * fragment_size);
                let mut bytes = whole[start * fragment_size..end].to_vec();
                if end == size {
                    bytes.resize(bytes.len() + padding, 0xee);
                }
                let first = u32::try_from(start + 1).unwrap();
                let (count, sample) = (count as u32, size as u32);
                let record = fragment(writer(1), 5, first, count, sample, fragment_size as u32);
                put(&mut assembly, &record, &bytes, 0);
            }
            prop_assert_eq!(assembly.take(writer(1), SequenceNumber(5)).map(|bytes| bytes.to_vec()), Some(whole));
            prop_assert_eq!((assembly.bytes, assembly.by_age.len()), (0, 0));
        }
    }

    #[test]
    fn interleaved_samples_of_several_writers_are_assembled_separately() {
        let (one, two) = (payload(2500), payload(2000));
        let mut assembly = Assembly::new(1 << 20);
        for start in [2_u32, 1, 3] {
            let from = (start as usize - 1) * 1000;
            let to = |len: usize| len.min(from + 1000);
            let record = fragment(writer(1), 9, start, 1, 2500, 1000);
            put(&mut assembly, &record, &one[from..to(2500)], 0);
            if from < 2000 {
                let record = fragment(writer(2), 9, start, 1, 2000, 1000);
                put(&mut assembly, &record, &two[from..to(2000)], 0);
            }
        }
        assert_eq!(assembly.take(writer(1), SequenceNumber(9)).unwrap(), one);
        assert_eq!(assembly.take(writer(2), SequenceNumber(9)).unwrap(), two);
        assert_eq!(assembly.take(writer(2), SequenceNumber(9)), None);
    }

    #[test]
    fn an_incomplete_sample_is_never_returned_and_keeps_no_bytes() {
        let mut assembly = Assembly::new(1 << 20);
        put(
            &mut assembly,
            &fragment(writer(1), 1, 1, 1, 2500, 1000),
            &[0; 1000],
            0,
        );
        put(
            &mut assembly,
            &fragment(writer(1), 1, 3, 1, 2500, 1000),
            &[0; 500],
            0,
        );
        // This datagram claims more fragments than its bytes can hold.
        put(
            &mut assembly,
            &fragment(writer(1), 1, 2, 2, 2500, 1000),
            &[0; 999],
            0,
        );
        assert_eq!(assembly.take(writer(1), SequenceNumber(1)), None);
        assert_eq!(assembly.bytes, 0);
        put(
            &mut assembly,
            &fragment(writer(1), 2, 1, 1, 2500, 1000),
            &[0; 1000],
            0,
        );
        assembly.expire(ModelTime::from_nanoseconds(2) + FRAGMENT_TIMEOUT);
        assert_eq!((assembly.bytes, assembly.parts.len()), (0, 0));
    }

    #[test]
    fn disposals_keys_and_contradictory_sizes_yield_no_payload() {
        let mut assembly = Assembly::new(1 << 20);
        let whole = fragment(writer(1), 1, 1, 1, 100, 1000);
        let strange = [
            Record {
                status_info: 1,
                ..whole
            },
            Record {
                submessage_flags: SubmessageFlags::FRAGMENT_KEY.0,
                ..whole
            },
            Record {
                kind: kind::DATA,
                submessage_flags: 0x08,
                ..whole
            },
            Record {
                flags: flag::INLINE_QOS_UNREAD,
                ..whole
            },
            fragment(writer(1), 1, 0, 1, 100, 1000),
            fragment(writer(1), 1, 1, 1, 0, 1000),
            fragment(writer(1), 1, 1, 1, 100, 0),
        ];
        for record in strange {
            put(&mut assembly, &record, &[1; 100], 0);
            assert_eq!(assembly.bytes, 0, "{record:?}");
        }
        put(
            &mut assembly,
            &fragment(writer(1), 1, 1, 1, 3000, 1000),
            &[1; 1000],
            0,
        );
        put(
            &mut assembly,
            &fragment(writer(1), 1, 1, 3, 2999, 1000),
            &[1; 2999],
            0,
        );
        assert_eq!(assembly.take(writer(1), SequenceNumber(1)), None);
    }

    #[test]
    fn a_claimed_size_allocates_in_proportion_to_the_bytes_that_arrived() {
        let mut assembly = Assembly::new(1 << 20);
        let hostile = fragment(writer(1), 1, 1, 1, u32::MAX, 65_535);
        put(&mut assembly, &hostile, &[0; 100], 0);
        let far = fragment(writer(1), 1, 60_000, 1, u32::MAX, 65_535);
        put(&mut assembly, &far, &[0; 100], 0);
        assert!(assembly.bytes < MIN_ALLOCATION + 1000, "{}", assembly.bytes);
    }

    #[test]
    fn a_storm_of_samples_stays_within_the_budget_and_drops_the_oldest() {
        let mut assembly = Assembly::new(1 << 20);
        for number in 0..50_000 {
            let record = fragment(writer(1), number, 1, 1, 2_000_000, 1000);
            put(&mut assembly, &record, &[0; 1000], 1 << 19);
            assert!(assembly.bytes <= 1 << 19);
        }
        assert!(assembly.evictions > 49_000);
        let newest = assembly.parts.keys().map(|(_, number)| *number).max();
        assert_eq!(newest, Some(SequenceNumber(49_999)));
        // A sample that is larger than the budget is dropped as it grows.
        for start in 1..3000 {
            let record = fragment(writer(2), 1, start, 1, 3_000_000, 1000);
            put(&mut assembly, &record, &[0; 1000], 0);
            assert!(assembly.bytes <= 1 << 20);
        }
        assert_eq!(assembly.take(writer(2), SequenceNumber(1)), None);
    }

    #[test]
    fn the_buffer_of_a_payload_without_readers_is_reused() {
        let mut assembly = Assembly::new(64 << 20);
        let size = 300_000;
        let mut next = |number: u64, size: u32| {
            let payload = vec![number as u8; size as usize];
            let whole = fragment(writer(1), number, 1, 1, size, size);
            put(&mut assembly, &whole, &payload, 0);
            let taken = assembly.take(writer(1), SequenceNumber(number)).unwrap();
            assert_eq!(taken, payload);
            (taken.as_ptr(), taken, assembly.size().0)
        };
        let (first, held, _) = next(1, size);
        let (second, released, _) = next(2, size);
        assert_ne!(first, second, "a reader still has the first one");
        drop(released);
        assert_eq!(next(3, size - 100).0, second);
        assert_ne!(next(4, size / 4).0, second, "it is much larger");
        assert_eq!(next(5, size).2, 0);
        assert_eq!(held, vec![1; 300_000]);
        assembly.expire(ModelTime::ZERO + 2 * SPARE_BUFFER_LIFETIME + FRAGMENT_TIMEOUT);
        assert_eq!(assembly.handed_out_bytes(), 0);
    }

    #[test]
    fn unfinished_samples_beyond_the_cap_displace_the_oldest() {
        let mut assembly = Assembly::new(1 << 30);
        for number in 0..AssembledSamples::CAP as u64 + 100 {
            let record = fragment(writer(1), number, 1, 1, 2_000, 1000);
            put(&mut assembly, &record, &[0; 1000], 0);
        }
        assert_eq!(
            (assembly.parts.len(), assembly.evictions),
            (AssembledSamples::CAP, 100)
        );
    }
}
