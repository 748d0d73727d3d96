//! Records of scrapes in the queue on disk: what changed since the previous record of the file.
//!
//! A record has its number in the file, the time, the series that no earlier record has, and one
//! number for each series so far. All numbers are variable-length integers of Protocol Buffers.

use std::collections::HashMap;
use std::sync::Arc;

use prost::bytes::Buf;
use prost::encoding::{decode_varint, encode_varint};

use super::samples::{Key, MAX_SERIES, Scrape};

/// Numbers of a series. A greater number is the change of a whole value, with its sign in the
/// lowest bit.
const TAG_SAME: u64 = 0;
const TAG_VALUE: u64 = 1;
const TAG_ABSENT: u64 = 2;
const TAG_CHANGE: u64 = 3;
/// Whole values up to this one are exact.
const MAX_EXACT_INTEGER: f64 = 9_007_199_254_740_992.0;

/// Writes the records of a file.
#[derive(Debug, Default)]
pub(super) struct Writer {
    ids: HashMap<Key, usize>,
    /// Values of the last record; `None` for a series that it does not have.
    values: Vec<Option<f64>>,
    records: u64,
}

/// Reads the records of a file.
#[derive(Debug, Default)]
pub(super) struct Reader {
    keys: Vec<Key>,
    values: Vec<Option<f64>>,
    records: u64,
}

impl Writer {
    /// Returns whether the file has as many series as one may have. Series that end stay in it.
    pub(super) fn is_full(&self) -> bool {
        self.values.len() >= MAX_SERIES
    }

    /// Returns the record of a scrape.
    pub(super) fn record(&mut self, scrape: &Scrape) -> Vec<u8> {
        let mut record = Vec::with_capacity(self.values.len() + 64);
        encode_varint(self.records, &mut record);
        self.records += 1;
        encode_varint(scrape.at.cast_unsigned(), &mut record);
        let mut values = vec![None; self.values.len()];
        let mut new = Vec::new();
        for (key, value) in &scrape.samples {
            let known = self.ids.get(key).and_then(|id| values.get_mut(*id));
            match known {
                Some(known) => *known = Some(*value),
                None => {
                    self.ids.insert(Arc::clone(key), values.len());
                    values.push(Some(*value));
                    new.push(key);
                }
            }
        }
        encode_varint(new.len() as u64, &mut record);
        for key in new {
            encode_varint(key.len() as u64, &mut record);
            record.extend_from_slice(key);
        }
        self.values.resize(values.len(), None);
        for (last, value) in self.values.iter().zip(&values) {
            encode_value(*last, *value, &mut record);
        }
        self.values = values;
        record
    }
}

impl Reader {
    /// Returns the scrape of a record. Returns `None` if the record is damaged, or if it follows a
    /// missing one: later records of the file are unreadable then.
    pub(super) fn scrape(&mut self, mut record: &[u8]) -> Option<Scrape> {
        let record = &mut record;
        if decode_varint(record).ok()? != self.records {
            return None;
        }
        let at = decode_varint(record).ok()?.cast_signed();
        for _ in 0..decode_varint(record).ok()? {
            let length = usize::try_from(decode_varint(record).ok()?).ok()?;
            let key = record.get(..length)?;
            self.keys.push(Arc::from(key));
            record.advance(length);
        }
        self.values.resize(self.keys.len(), None);
        let mut samples = Vec::with_capacity(self.keys.len());
        for (key, value) in self.keys.iter().zip(&mut self.values) {
            *value = decode_value(*value, record)?;
            samples.extend(value.map(|value| (Arc::clone(key), value)));
        }
        self.records += 1;
        Some(Scrape { at, samples })
    }
}

fn encode_value(last: Option<f64>, value: Option<f64>, record: &mut Vec<u8>) {
    let bits = |value: Option<f64>| value.map(f64::to_bits);
    match (last, value) {
        _ if bits(last) == bits(value) => encode_varint(TAG_SAME, record),
        (_, None) => encode_varint(TAG_ABSENT, record),
        (last, Some(value)) => {
            let change = exact_integer(value).zip(exact_integer(last.unwrap_or(0.0)));
            match change.map(|(value, last)| value - last) {
                Some(change) => {
                    let signed = (change << 1 ^ change >> 63).cast_unsigned();
                    encode_varint(signed + TAG_CHANGE, record);
                }
                None => {
                    encode_varint(TAG_VALUE, record);
                    record.extend_from_slice(&value.to_le_bytes());
                }
            }
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "whole values are exact")]
fn decode_value(last: Option<f64>, record: &mut &[u8]) -> Option<Option<f64>> {
    Some(match decode_varint(record).ok()? {
        TAG_SAME => last,
        TAG_ABSENT => None,
        TAG_VALUE => {
            let (bytes, rest) = record.split_first_chunk()?;
            *record = rest;
            Some(f64::from_le_bytes(*bytes))
        }
        signed => {
            let signed = signed - TAG_CHANGE;
            let change = (signed >> 1).cast_signed() ^ -(signed & 1).cast_signed();
            Some(exact_integer(last.unwrap_or(0.0))?.checked_add(change)? as f64)
        }
    })
}

/// Returns a value as an integer, if that is exact.
#[expect(clippy::cast_possible_truncation, reason = "the range is checked")]
fn exact_integer(value: f64) -> Option<i64> {
    let is_whole = value.abs() < MAX_EXACT_INTEGER && value.fract() == 0.0;
    // The sign of a zero would be lost.
    (is_whole && value.to_bits() != (-0.0_f64).to_bits()).then_some(value as i64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::samples::STALE_NAN;
    use super::*;

    fn value() -> impl Strategy<Value = f64> {
        prop_oneof![
            4 => (-1_000_i32..1_000_000).prop_map(f64::from),
            2 => any::<f64>(),
            1 => Just(STALE_NAN),
            1 => prop::sample::select(vec![0.0, -0.0, f64::INFINITY, MAX_EXACT_INTEGER, -MAX_EXACT_INTEGER, MAX_EXACT_INTEGER - 1.0]),
        ]
    }

    fn scrapes() -> impl Strategy<Value = Vec<Scrape>> {
        let samples = prop::collection::btree_map(0_u8..12, value(), 0..12);
        prop::collection::vec((any::<i64>(), samples), 1..20).prop_map(|scrapes| {
            let key = |id: u8| -> Key { vec![b'g', id, 0xff].into() };
            let scrape = |(at, samples): (i64, std::collections::BTreeMap<u8, f64>)| Scrape {
                at,
                samples: samples
                    .into_iter()
                    .map(|(id, value)| (key(id), value))
                    .collect(),
            };
            scrapes.into_iter().map(scrape).collect()
        })
    }

    /// Returns a scrape in a form that compares the bits of values.
    fn bits(scrape: &Scrape) -> (i64, Vec<(Key, u64)>) {
        let samples = scrape.samples.iter();
        let mut samples: Vec<_> = samples
            .map(|(key, value)| (key.clone(), value.to_bits()))
            .collect();
        samples.sort_unstable();
        (scrape.at, samples)
    }

    proptest! {
        #[test]
        fn scrapes_are_read_as_they_were_written(scrapes in scrapes()) {
            let (mut writer, mut reader) = (Writer::default(), Reader::default());
            for scrape in &scrapes {
                let record = writer.record(scrape);
                let read = reader.scrape(&record).unwrap();
                prop_assert_eq!(bits(&read), bits(scrape));
            }
        }

        #[test]
        fn no_record_makes_the_reader_panic(record in prop::collection::vec(any::<u8>(), 0..200)) {
            let mut reader = Reader::default();
            let _ = reader.scrape(&record);
            let _ = reader.scrape(&record);
        }
    }

    #[test]
    fn records_after_a_missing_one_are_not_read() {
        let scrape = |at| Scrape {
            at,
            samples: vec![(vec![b'g', 0xff].into(), 1.0)],
        };
        let mut writer = Writer::default();
        let records: Vec<_> = (0..3).map(|at| writer.record(&scrape(at))).collect();
        let mut reader = Reader::default();
        assert_eq!(reader.scrape(&records[0]), Some(scrape(0)));
        assert_eq!(reader.scrape(&records[2]), None);
        // Only the unchanged series is left of the third record: its number, its time, and a zero.
        assert_eq!(records[2], [2, 2, 0, 0]);
    }
}
