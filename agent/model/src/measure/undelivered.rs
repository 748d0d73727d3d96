//! Datagrams that arrived but never reached the reader, because the socket's buffer was full.
//!
//! The host hook reports a datagram when it reaches a socket, and shortly afterwards the kernel may
//! report that the socket's buffer was full. The second report is processed first and is subtracted
//! once from the arrival that it names: a retransmission of the same fragments is another arrival.
//! An arrival may cover several datagrams; only drops between its first and last are subtracted.

use std::collections::VecDeque;
use std::time::Duration;

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, DataFrag, Head, Sample};
use crate::facts::tables::UndeliveredParts;
use ros2probe_wire::SequenceNumber;

/// Maximum difference between the clock conversions of the two reports.
const MAX_CLOCK_DIFFERENCE: Duration = Duration::from_micros(100);
/// An arrival follows its drop within this time, or the record of the arrival was lost.
const DROP_LIFETIME: Duration = Duration::from_secs(60);

/// Drops at one receiver that wait for the report of their arrival.
#[derive(Debug, Default)]
pub struct Undelivered {
    waiting: Bounded<UndeliveredParts, VecDeque<UndeliveredPart>>,
}

#[derive(Clone, Copy, Debug)]
struct UndeliveredPart {
    socket: u64,
    number: SequenceNumber,
    /// Fragments `start..end`; `0..1` for an unfragmented sample.
    start: u32,
    end: u32,
    first: ModelTime,
    last: ModelTime,
}

impl Undelivered {
    /// Returns whether no drop waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Records that this DATA or DATA_FRAG was dropped. Returns whether an older entry was evicted.
    pub fn note(&mut self, sample: &Sample) -> bool {
        let socket = sample.head.socket;
        let (start, end) = range(sample);
        let (first, last) = span(&sample.head);
        if let Some(back) = self.waiting.back_mut()
            && back.socket == socket
            && back.number == sample.sequence_number
            && back.end == start
            && matches!(sample.content, Content::DataFrag(_))
        {
            (back.end, back.last) = (end, last);
            return false;
        }
        let evicted = self.waiting.push_back(UndeliveredPart {
            socket,
            number: sample.sequence_number,
            start,
            end,
            first,
            last,
        });
        evicted.is_some()
    }

    /// Returns the delivered parts of an arrival, in order. Adds the number of evicted entries to
    /// `evictions`.
    pub fn delivered(&mut self, sample: &Sample, evictions: &mut u64) -> Vec<Sample> {
        let mut parts = vec![range(sample)];
        let (begin, end) = span(&sample.head);
        let mut left = Vec::new();
        self.waiting.retain_mut(|each| {
            let is_meant = each.socket == sample.head.socket
                && each.number == sample.sequence_number
                && each.last + MAX_CLOCK_DIFFERENCE >= begin
                && each.first <= end + MAX_CLOCK_DIFFERENCE;
            if !is_meant {
                return true;
            }
            let (start, end) = range(sample);
            let (from, to) = (each.start.max(start), each.end.min(end));
            if from >= to {
                return true;
            }
            parts = take_out(&parts, from, to);
            if each.start < from && to < each.end {
                left.push(UndeliveredPart { start: to, ..*each });
                each.end = from;
                return true;
            }
            if each.start < from {
                each.end = from;
            } else {
                each.start = to;
            }
            each.start < each.end
        });
        for part in left {
            *evictions += u64::from(self.waiting.push_back(part).is_some());
        }
        let part = |(start, end): (u32, u32)| Sample {
            content: match sample.content {
                Content::DataFrag(fragments) => Content::DataFrag(DataFrag {
                    starting: start,
                    count: end - start,
                    ..fragments
                }),
                data @ Content::Data { .. } => data,
            },
            ..*sample
        };
        parts.into_iter().map(part).collect()
    }

    /// Returns the time at which [`Self::expire`] removes the next entry; [`ModelTime::MAX`]
    /// without one.
    #[must_use]
    pub fn next_expiry(&self) -> ModelTime {
        let oldest = self.waiting.front();
        oldest.map_or(ModelTime::MAX, |oldest| oldest.last + DROP_LIFETIME)
    }

    /// Removes entries whose arrival did not follow.
    pub fn expire(&mut self, now: ModelTime) {
        while let Some(oldest) = self.waiting.front()
            && oldest.last + DROP_LIFETIME <= now
        {
            self.waiting.pop_front();
        }
        if self.waiting.is_empty() && self.waiting.capacity() > 0 {
            self.waiting.take();
        }
    }
}

/// Returns the fragments, as a half-open range.
const fn range(sample: &Sample) -> (u32, u32) {
    match sample.content {
        Content::Data { .. } => (0, 1),
        Content::DataFrag(fragments) => {
            let start = fragments.starting;
            (start, start.saturating_add(fragments.count))
        }
    }
}

/// Returns the times of its first and last datagram.
fn span(head: &Head) -> (ModelTime, ModelTime) {
    let begin = match head.elapsed {
        u32::MAX => ModelTime::ZERO,
        _ => head.began(),
    };
    (begin, head.at)
}

fn take_out(parts: &[(u32, u32)], from: u32, to: u32) -> Vec<(u32, u32)> {
    let mut rest = Vec::with_capacity(parts.len() + 1);
    for (start, end) in parts {
        rest.extend([(*start, (*end).min(from)), ((*start).max(to), *end)]);
    }
    rest.retain(|(start, end)| start < end);
    rest
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Record;
    use ros2probe_wire::record::kind;

    use super::*;
    use crate::facts::observation::tests::sample;
    use ros2probe_wire::time::MILLISECOND;

    fn fragments(start: u32, count: u32, time: u64, elapsed: u32) -> Record {
        Record {
            kind: kind::DATA_FRAG,
            sequence_number: 7,
            socket: 1,
            fragment_start: start,
            fragments: count << 16 | 1344,
            time,
            elapsed,
            ..Record::default()
        }
    }

    fn note(undelivered: &mut Undelivered, record: &Record) -> bool {
        undelivered.note(&sample(record))
    }

    fn delivered(
        undelivered: &mut Undelivered,
        record: &Record,
        evictions: &mut u64,
    ) -> Vec<Sample> {
        undelivered.delivered(&sample(record), evictions)
    }

    fn ranges(parts: &[Sample]) -> Vec<(u32, u32)> {
        parts.iter().map(range).collect()
    }

    #[test]
    fn dropped_fragments_are_subtracted_once_from_their_arrival() {
        let mut undelivered = Undelivered::default();
        note(&mut undelivered, &fragments(3, 1, 12 * MILLISECOND, 0));
        note(&mut undelivered, &fragments(4, 1, 13 * MILLISECOND, 0));
        note(&mut undelivered, &fragments(8, 2, 17 * MILLISECOND, 0));
        let run = fragments(1, 10, 20 * MILLISECOND, 10_000_000);
        assert_eq!(
            ranges(&delivered(&mut undelivered, &run, &mut 0)),
            [(1, 3), (5, 8), (10, 11)]
        );
        assert!(undelivered.is_empty());
        let again = fragments(3, 2, 40 * MILLISECOND, 0);
        assert_eq!(
            ranges(&delivered(&mut undelivered, &again, &mut 0)),
            [(3, 5)]
        );
    }

    #[test]
    fn a_retransmission_is_not_mistaken_for_an_arrival_whose_record_was_lost() {
        let mut undelivered = Undelivered::default();
        note(&mut undelivered, &fragments(3, 1, 12 * MILLISECOND, 0));
        let later = fragments(3, 1, 40 * MILLISECOND, 0);
        assert_eq!(
            ranges(&delivered(&mut undelivered, &later, &mut 0)),
            [(3, 4)]
        );
        undelivered.expire(ModelTime::from_nanoseconds(13 * MILLISECOND) + DROP_LIFETIME);
        assert!(undelivered.is_empty());
    }

    #[test]
    fn an_arrival_may_end_within_a_run_of_dropped_fragments() {
        let mut undelivered = Undelivered::default();
        for fragment in 4..8 {
            let time = u64::from(10 + fragment) * MILLISECOND;
            note(&mut undelivered, &fragments(fragment, 1, time, 0));
        }
        let first = fragments(1, 5, 15 * MILLISECOND, 4_000_000);
        assert_eq!(
            ranges(&delivered(&mut undelivered, &first, &mut 0)),
            [(1, 4)]
        );
        let second = fragments(6, 5, 20 * MILLISECOND, 4_000_000);
        assert_eq!(
            ranges(&delivered(&mut undelivered, &second, &mut 0)),
            [(8, 11)]
        );
        assert!(undelivered.is_empty());
    }

    #[test]
    fn an_unfragmented_sample_dropped_at_a_full_buffer_does_not_arrive() {
        let mut undelivered = Undelivered::default();
        let data = Record {
            kind: kind::DATA,
            ..fragments(0, 0, MILLISECOND, 0)
        };
        note(&mut undelivered, &data);
        let elsewhere = Record { socket: 2, ..data };
        assert_eq!(delivered(&mut undelivered, &elsewhere, &mut 0).len(), 1);
        assert!(delivered(&mut undelivered, &data, &mut 0).is_empty());
        assert_eq!(delivered(&mut undelivered, &data, &mut 0).len(), 1);
    }

    #[test]
    fn a_storm_of_drops_stays_bounded() {
        let mut undelivered = Undelivered::default();
        for number in 0..10_000 {
            let data = Record {
                kind: kind::DATA,
                sequence_number: number,
                ..Record::default()
            };
            note(&mut undelivered, &data);
        }
        assert!(undelivered.waiting.len() <= UndeliveredParts::CAP);
    }

    #[test]
    fn arrivals_that_split_a_run_of_dropped_fragments_stay_bounded() {
        let mut undelivered = Undelivered::default();
        let mut evictions = 0;
        let time = 20 * MILLISECOND;
        note(&mut undelivered, &fragments(1, 60_000, time, 0));
        for fragment in 1..20_000 {
            delivered(
                &mut undelivered,
                &fragments(3 * fragment, 1, time, 0),
                &mut evictions,
            );
        }
        assert!(undelivered.waiting.is_full());
        assert_eq!(evictions, 20_000 - UndeliveredParts::CAP as u64);
    }
}
