//! Holds the kernel filter's records of a fragmented datagram until the datagram is complete.
//!
//! A datagram with a missing IP fragment is not delivered, so nothing in it may count. The filter
//! cannot return to earlier fragments: it sends their records ahead, marked, and reports later that
//! the datagram is complete. Until then the records wait here, bounded in number and time.

use std::collections::{HashMap, VecDeque};
use std::time::Duration;

use ros2probe_model::facts::bounded::{Bounded, Sum};
use ros2probe_wire::Timestamp;
use ros2probe_wire::record::{Body, Record, flag};

use super::reassembly::Reassembled;
use crate::tables::{AheadBytes, AheadDatagrams, AheadRecords};

/// Time after which an incomplete datagram is discarded. By default, Linux waits as long for
/// fragments of IPv4 (`ipfrag_time`), and twice as long for those of IPv6 (`ip6frag_time`).
const LIFETIME: Duration = Duration::from_secs(30);

/// A complete item for the model.
#[derive(Debug)]
pub enum ReadyItem {
    /// A record of a complete datagram.
    Record(Record),
    /// The rest of a complete datagram that the kernel filter handed over.
    Remainder(Reassembled),
}

/// Datagrams that are not complete yet.
#[derive(Debug, Default)]
pub struct Ahead {
    waiting: HashMap<Token, Waiting>,
    oldest: Bounded<AheadDatagrams, VecDeque<(Timestamp, Token)>>,
    bytes: Sum<AheadBytes>,
    discarded: u64,
}

/// A datagram's source and token.
type Token = (u32, u32);

#[derive(Debug, Default)]
struct Waiting {
    records: Bounded<AheadRecords, Vec<Record>>,
    handed_over: bool,
    remainder: Option<Reassembled>,
    /// Time of the frame that completed the datagram.
    complete: Option<u64>,
}

impl Ahead {
    /// Accepts a record of source `namespace`. The caller passes handovers to the reassembly; here
    /// a handover only announces that the rest of the datagram follows.
    pub fn record(&mut self, namespace: u32, record: Record, ready: impl FnMut(ReadyItem)) {
        let mut ready = ready;
        if record.datagram == 0 {
            return ready(ReadyItem::Record(record));
        }
        let token = (namespace, record.datagram);
        if record.flags & flag::AHEAD == 0 && !self.waiting.contains_key(&token) {
            // The usual case: a single record of a complete datagram.
            if !matches!(record.body(), Body::Complete) {
                ready(ReadyItem::Record(record));
            }
            return;
        }
        self.change(token, Timestamp(record.time), |waiting| {
            match record.body() {
                Body::Handover => waiting.handed_over = true,
                Body::Complete => {}
                _ => {
                    waiting.records.push(record);
                }
            }
            if record.flags & flag::AHEAD == 0 {
                waiting.complete = Some(record.time);
            }
        });
        self.complete_datagram(token, ready);
    }

    /// Accepts the rest of a handed-over datagram.
    pub fn add_remainder(
        &mut self,
        namespace: u32,
        rest: Reassembled,
        ready: impl FnMut(ReadyItem),
    ) {
        let Some(handover) = rest.handover else {
            return;
        };
        let token = (namespace, handover.datagram);
        self.change(token, rest.last_seen, |waiting| {
            waiting.handed_over = true;
            waiting.remainder = Some(rest);
        });
        self.complete_datagram(token, ready);
    }

    /// Discards datagrams that can no longer become complete. The clock may have been set back.
    pub fn advance(&mut self, now: Timestamp) {
        let is_late = |(born, _): &mut (Timestamp, _)| now.distance(*born) > LIFETIME;
        while let Some(oldest) = self.oldest.pop_front_if(is_late) {
            self.discard(Some(oldest));
        }
    }

    /// Returns the number of datagrams that never became complete or did not fit.
    #[must_use]
    pub const fn discarded(&self) -> u64 {
        self.discarded
    }

    /// Changes the waiting datagram, and gives up the oldest datagrams if a bound is exceeded.
    fn change(&mut self, token: Token, at: Timestamp, change: impl FnOnce(&mut Waiting)) {
        if !self.waiting.contains_key(&token) {
            let oldest = self.oldest.push_back((at, token));
            self.discard(oldest);
        }
        let waiting = self.waiting.entry(token).or_default();
        let before = waiting.bytes();
        change(waiting);
        self.bytes.sub(before);
        self.bytes.add(waiting.bytes());
        while self.bytes.is_exceeded() && !self.oldest.is_empty() {
            let oldest = self.oldest.pop_front();
            self.discard(oldest);
        }
    }

    fn discard(&mut self, oldest: Option<(Timestamp, Token)>) {
        if let Some((_, oldest)) = oldest {
            self.discarded += u64::from(self.remove(oldest).is_some());
        }
    }

    fn remove(&mut self, token: Token) -> Option<Waiting> {
        let waiting = self.waiting.remove(&token)?;
        self.bytes.sub(waiting.bytes());
        Some(waiting)
    }

    fn complete_datagram(&mut self, token: Token, mut ready: impl FnMut(ReadyItem)) {
        let Some(waiting) = self.waiting.get(&token) else {
            return;
        };
        let Some(time) = waiting.complete else { return };
        if waiting.handed_over && waiting.remainder.is_none() {
            return;
        }
        let Some(waiting) = self.remove(token) else {
            return;
        };
        for record in waiting.records {
            ready(ReadyItem::Record(Record {
                time,
                flags: record.flags & !flag::AHEAD,
                ..record
            }));
        }
        if let Some(rest) = waiting.remainder {
            ready(ReadyItem::Remainder(rest));
        }
    }
}

impl Waiting {
    /// Returns the bytes held.
    fn bytes(&self) -> usize {
        // A new field does not compile until this pattern names it.
        let Self {
            records,
            handed_over: _,
            remainder: rest,
            complete: _,
        } = self;
        let rest = rest.as_ref().map_or(0, Reassembled::held_bytes);
        records.capacity() * size_of::<Record>() + rest
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::record::kind;

    use super::*;
    use crate::tables::tests::assert_driven;

    fn record(datagram: u32, kind: u8, flags: u16, time: u64) -> Record {
        Record {
            datagram,
            kind,
            flags,
            time,
            ..Record::default()
        }
    }

    fn taken(ahead: &mut Ahead, record: Record) -> Vec<Record> {
        let mut all = Vec::new();
        ahead.record(0, record, |ready| match ready {
            ReadyItem::Record(record) => all.push(record),
            ReadyItem::Remainder(_) => unreachable!("nothing was handed over"),
        });
        all
    }

    #[test]
    fn an_incomplete_datagram_never_counts() {
        let mut ahead = Ahead::default();
        assert!(taken(&mut ahead, record(9, kind::DATA, flag::AHEAD, 1)).is_empty());
        ahead.advance(Timestamp(31_000_000_000));
        assert_eq!(ahead.discarded(), 1);
        assert!(taken(&mut ahead, record(9, kind::COMPLETE, 0, 2)).is_empty());
    }

    #[test]
    fn incomplete_datagrams_are_discarded_after_the_clock_was_set_back() {
        let hour = 3_600_000_000_000;
        let mut ahead = Ahead::default();
        assert!(taken(&mut ahead, record(9, kind::DATA, flag::AHEAD, 2 * hour)).is_empty());
        ahead.advance(Timestamp(hour));
        assert_eq!((ahead.discarded(), ahead.waiting.len()), (1, 0));
    }

    #[test]
    fn records_sent_ahead_count_when_the_last_one_arrives_and_get_its_time() {
        let mut ahead = Ahead::default();
        taken(
            &mut ahead,
            record(9, kind::DATA, flag::AHEAD | flag::FRAGMENTED, 1),
        );
        let all = taken(&mut ahead, record(9, kind::HEARTBEAT, flag::FRAGMENTED, 5));
        let kinds: Vec<_> = all
            .iter()
            .map(|record| (record.kind, record.time))
            .collect();
        assert_eq!(kinds, [(kind::DATA, 5), (kind::HEARTBEAT, 5)]);
        assert!(all.iter().all(|record| record.flags == flag::FRAGMENTED));
    }

    #[test]
    fn the_same_token_in_two_namespaces_identifies_two_datagrams() {
        let mut ahead = Ahead::default();
        taken(&mut ahead, record(9, kind::DATA, flag::AHEAD, 1));
        let mut seen = 0;
        ahead.record(1, record(9, kind::DATA, 0, 2), |_| seen += 1);
        assert_eq!(seen, 1);
    }

    #[test]
    fn a_storm_of_incomplete_datagrams_stays_within_the_cap() {
        let mut ahead = Ahead::default();
        for token in 1..10_000 {
            taken(&mut ahead, record(token, kind::DATA, flag::AHEAD, 1));
        }
        assert_eq!(ahead.waiting.len(), AheadDatagrams::CAP);
        assert_driven::<AheadDatagrams>();
    }

    #[test]
    fn a_storm_of_long_incomplete_datagrams_stays_within_the_byte_limit() {
        let mut ahead = Ahead::default();
        for token in 1..1000 {
            for time in 1..2000 {
                taken(&mut ahead, record(token, kind::DATA, flag::AHEAD, time));
            }
        }
        let held: usize = ahead.waiting.values().map(Waiting::bytes).sum();
        assert_eq!(ahead.bytes.used(), held);
        assert_driven::<AheadBytes>();
        assert_eq!(ahead.discarded(), 999 - ahead.waiting.len() as u64);
    }

    #[test]
    fn a_datagram_with_too_many_records_keeps_the_first_ones() {
        let mut ahead = Ahead::default();
        for time in 0..3000 {
            taken(&mut ahead, record(1, kind::DATA, flag::AHEAD, time));
        }
        assert_driven::<AheadRecords>();
        let all = taken(&mut ahead, record(1, kind::COMPLETE, 0, 9));
        assert_eq!(all.len(), AheadRecords::CAP);
    }
}
