//! Rows as columns. Values of one column lie side by side and as differences, so that equal
//! figures become equal bytes, which the compression of a block removes.

use crate::bytes::{Get, Put, unzigzag, zigzag};
use crate::rows::{ProcessName, ProcessRow, Series, TopicName, TopicRow};

/// Maximum number of rows of a series in one block.
const MAX_ROWS: usize = 4096;

/// Selects a pair of percentiles of a row.
type PairOf = fn(&mut TopicRow) -> &mut Option<[f32; 2]>;

/// A name of a series.
pub(crate) trait Name: Sized {
    fn write(&self, into: &mut Vec<u8>);
    fn read(from: &mut Get<'_>) -> Option<Self>;
}

/// A row that is stored as columns.
pub(crate) trait Row: Copy {
    fn write(rows: &[Self], into: &mut Vec<u8>);
    fn read(from: &mut Get<'_>, count: usize) -> Option<Vec<Self>>;
}

/// Appends all series.
pub(crate) fn write<N: Name, R: Row>(all: &[Series<N, R>], into: &mut Vec<u8>) {
    let mut columns = Vec::new();
    for series in all {
        for rows in series.rows.chunks(MAX_ROWS) {
            series.of.write(into);
            columns.clear();
            columns.put(rows.len() as u64);
            R::write(rows, &mut columns);
            into.put_bytes(&columns);
        }
    }
}

/// Visits the rows of the wanted series, up to the first damage.
pub(crate) fn read<N: Name, R: Row>(
    bytes: &[u8],
    wanted: &dyn Fn(&N) -> bool,
    each: &mut dyn FnMut(&N, R),
) -> Option<()> {
    let mut from = Get(bytes);
    while !from.is_empty() {
        let name = N::read(&mut from)?;
        let mut columns = Get(from.bytes()?);
        if !wanted(&name) {
            continue;
        }
        let count = usize::try_from(columns.number()?).ok()?;
        if count > MAX_ROWS {
            return None;
        }
        for row in R::read(&mut columns, count)? {
            each(&name, row);
        }
    }
    Some(())
}

impl Name for TopicName {
    fn write(&self, into: &mut Vec<u8>) {
        into.put(self.domain_id.into());
        into.put_bytes(self.dds_name.as_bytes());
    }

    fn read(from: &mut Get<'_>) -> Option<Self> {
        Some(Self {
            domain_id: from.small()?,
            dds_name: String::from_utf8(from.bytes()?.to_vec()).ok()?,
        })
    }
}

impl Name for ProcessName {
    fn write(&self, into: &mut Vec<u8>) {
        into.put(self.id.into());
        into.put_bytes(self.name.as_bytes());
    }

    fn read(from: &mut Get<'_>) -> Option<Self> {
        Some(Self {
            id: from.small()?,
            name: String::from_utf8(from.bytes()?.to_vec()).ok()?,
        })
    }
}

impl Row for TopicRow {
    fn write(rows: &[Self], into: &mut Vec<u8>) {
        differences(rows, into, |row| row.at.into());
        differences(rows, into, |row| row.seconds.into());
        differences(rows, into, |row| row.messages.into());
        differences(rows, into, |row| row.lost.into());
        // Messages of one size leave only zeros.
        let size = size_of_message(rows);
        into.put(size);
        differences(rows, into, |row| remainder(row, size));
        for pair in [|row: &Self| row.latency, |row: &Self| row.interarrival] {
            for place in 0..2 {
                differences(rows, into, |row| {
                    let value = pair(row).and_then(|pair| pair.get(place).copied());
                    short_float(value).into()
                });
            }
        }
    }

    fn read(from: &mut Get<'_>, count: usize) -> Option<Vec<Self>> {
        let mut rows = vec![Self::default(); count];
        field(from, &mut rows, |row| &mut row.at)?;
        field(from, &mut rows, |row| &mut row.seconds)?;
        field(from, &mut rows, |row| &mut row.messages)?;
        field(from, &mut rows, |row| &mut row.lost)?;
        let size = from.number()?;
        sums(from, &mut rows, |row, value| {
            row.bytes = u64::from(row.messages)
                .wrapping_mul(size)
                .wrapping_add_signed(value);
            Some(())
        })?;
        let pairs: [PairOf; 2] = [|row| &mut row.latency, |row| &mut row.interarrival];
        for pair in pairs {
            for place in 0..2 {
                sums(from, &mut rows, |row, value| {
                    let value = long_float(value)?;
                    let pair = pair(row);
                    if let Some(value) = value {
                        *pair.get_or_insert_default().get_mut(place)? = value;
                    }
                    Some(())
                })?;
            }
        }
        Some(rows)
    }
}

impl Row for ProcessRow {
    fn write(rows: &[Self], into: &mut Vec<u8>) {
        differences(rows, into, |row| row.at.into());
        differences(rows, into, |row| row.seconds.into());
        differences(rows, into, |row| row.cpu_ms.into());
        differences(rows, into, |row| row.memory_kib as i64);
    }

    fn read(from: &mut Get<'_>, count: usize) -> Option<Vec<Self>> {
        let mut rows = vec![Self::default(); count];
        field(from, &mut rows, |row| &mut row.at)?;
        field(from, &mut rows, |row| &mut row.seconds)?;
        field(from, &mut rows, |row| &mut row.cpu_ms)?;
        sums(from, &mut rows, |row, value| {
            row.memory_kib = value as u64;
            Some(())
        })?;
        Some(rows)
    }
}

/// Appends a column: the first value, then the difference from each value to the next.
fn differences<R>(rows: &[R], into: &mut Vec<u8>, value: impl Fn(&R) -> i64) {
    let mut before = 0_i64;
    for row in rows {
        let value = value(row);
        into.put(zigzag(value.wrapping_sub(before)));
        before = value;
    }
}

/// Reads a column. `set` returns `None` for an impossible value.
fn sums<R>(
    from: &mut Get<'_>,
    rows: &mut [R],
    mut set: impl FnMut(&mut R, i64) -> Option<()>,
) -> Option<()> {
    let mut value = 0_i64;
    for row in rows {
        value = value.wrapping_add(unzigzag(from.number()?));
        set(row, value)?;
    }
    Some(())
}

/// Reads a column of one field.
fn field<R>(from: &mut Get<'_>, rows: &mut [R], of: impl Fn(&mut R) -> &mut u32) -> Option<()> {
    sums(from, rows, |row, value| {
        *of(row) = value.try_into().ok()?;
        Some(())
    })
}

/// Returns the mean size of a message, in bytes.
fn size_of_message(rows: &[TopicRow]) -> u64 {
    let bytes = rows.iter().map(|row| row.bytes).fold(0, u64::wrapping_add);
    let messages: u64 = rows.iter().map(|row| u64::from(row.messages)).sum();
    bytes.checked_div(messages).unwrap_or(0)
}

/// Returns the bytes that the mean size does not explain.
fn remainder(row: &TopicRow, size: u64) -> i64 {
    let explained = u64::from(row.messages).wrapping_mul(size);
    row.bytes.wrapping_sub(explained) as i64
}

/// Returns the upper half of a float plus one; 0 for `None`.
fn short_float(value: Option<f32>) -> u16 {
    let upper = |value: f32| (value.to_bits().saturating_add(0x8000) >> 16) as u16;
    value.map_or(0, |value| upper(value).saturating_add(1))
}

/// Reverses [`short_float`]; the outer `None` means that the value is impossible.
fn long_float(value: i64) -> Option<Option<f32>> {
    let value = u16::try_from(value).ok()?;
    let upper = value.checked_sub(1);
    Some(upper.map(|upper| f32::from_bits(u32::from(upper) << 16)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn float() -> impl Strategy<Value = f32> {
        // Values that the upper half of a float represents exactly.
        (0_u16..0x7f80).prop_map(|upper| f32::from_bits(u32::from(upper) << 16))
    }

    prop_compose! {
        fn topic_row()(
            at: u32, seconds: u32, messages: u32, lost: u32, bytes: u64,
            latency in proptest::option::of([float(), float()]),
            interarrival in proptest::option::of([float(), float()]),
        ) -> TopicRow {
            TopicRow { at, seconds, messages, lost, bytes, latency, interarrival }
        }
    }

    proptest! {
        #[test]
        fn topics_are_read_as_they_were_written(
            all in proptest::collection::vec(
                (any::<u32>(), ".{0,20}", proptest::collection::vec(topic_row(), 1..80)), 0..6),
        ) {
            let all: Vec<_> = all.into_iter().map(|(domain_id, dds_name, rows)| Series {
                of: TopicName { domain_id, dds_name },
                rows,
            }).collect();
            let mut bytes = Vec::new();
            write(&all, &mut bytes);
            let mut seen = Vec::new();
            let read = read::<TopicName, TopicRow>(&bytes, &|_| true, &mut |name, row| {
                seen.push((name.clone(), row));
            });
            prop_assert_eq!(read, Some(()));
            let expected: Vec<_> = all.iter()
                .flat_map(|series| series.rows.iter().map(|row| (series.of.clone(), *row)))
                .collect();
            prop_assert_eq!(seen, expected);
        }

        #[test]
        fn damaged_columns_end_the_reading(bytes: Vec<u8>) {
            let mut rows = 0_usize;
            let _ = read::<TopicName, TopicRow>(&bytes, &|_| true, &mut |_, _| rows += 1);
            let _ = read::<ProcessName, ProcessRow>(&bytes, &|_| true, &mut |_, _| rows += 1);
            // A row takes at least four bytes.
            prop_assert!(rows <= bytes.len());
        }

        #[test]
        fn processes_are_read_as_they_were_written(
            rows in proptest::collection::vec(
                (any::<u32>(), any::<u32>(), any::<u32>(), any::<u64>()), 1..80),
        ) {
            let rows: Vec<_> = rows.into_iter().map(|(at, seconds, cpu_ms, memory_kib)| {
                ProcessRow { at, seconds, cpu_ms, memory_kib }
            }).collect();
            let of = ProcessName { id: 7, name: "robot.py".into() };
            let all = [Series { of, rows: rows.clone() }];
            let mut bytes = Vec::new();
            write(&all, &mut bytes);
            let mut seen = Vec::new();
            let read = read::<ProcessName, ProcessRow>(&bytes, &|_| true, &mut |_, row| seen.push(row));
            prop_assert_eq!((read, seen), (Some(()), rows));
        }
    }

    #[test]
    fn a_series_longer_than_a_part_is_written_in_parts() {
        let rows = (0..MAX_ROWS as u32 + 9).map(|at| TopicRow {
            at,
            ..TopicRow::default()
        });
        let all = [Series {
            of: TopicName::default(),
            rows: rows.collect(),
        }];
        let mut bytes = Vec::new();
        write(&all, &mut bytes);
        let mut times = Vec::new();
        read::<TopicName, TopicRow>(&bytes, &|_| true, &mut |_, row| times.push(row.at)).unwrap();
        assert!(times.into_iter().eq(0..MAX_ROWS as u32 + 9));
    }
}
