//! Measurements of the last seconds, so that charts opened after an incident show it.
//!
//! A finished second is immutable: readers share it with the ring and never block the capture. The
//! number of rows is bounded, so many topics shorten the history.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use foldhash::{HashMap, HashSet};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, Timestamp};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::histogram::Histogram;
use crate::facts::measurement::{EarlierCounts, Measurement};
use crate::facts::model_time::ModelTime;
use crate::facts::names::DdsName;
use crate::facts::rate::SECONDS as WINDOW;
use crate::facts::tables::{HistoryRows, HistorySeconds, HistoryTotals};

/// Maximum number of names, as a multiple of the measured topics. Topics that are no longer
/// measured keep their names within it.
const MAX_NAMES_PER_TOPIC: usize = 2;

/// A ring of the last seconds.
#[derive(Debug)]
pub struct History {
    /// Maximum number of topic names.
    most: usize,
    seconds: Bounded<Counted<HistorySeconds>, VecDeque<Arc<Second>>>,
    rows: Sum<HistoryRows>,
    names: Arc<Names>,
    before: Bounded<Counted<HistoryTotals>, HashMap<u32, PreviousTotals>>,
    /// The id assigned last.
    last: u32,
    /// Number of topics whose history was dropped or refused because the table of names was full.
    evictions: u64,
}

/// The state of the ring at one moment, for readers.
#[derive(Clone, Debug, Default)]
pub struct Past {
    names: Arc<Names>,
    seconds: Vec<Arc<Second>>,
}

/// The domain, DDS name and total counts of each topic at one time.
#[derive(Debug)]
pub struct TopicCounts<I> {
    /// The time.
    pub at: ModelTime,
    /// The topics.
    pub topics: I,
}

/// Measurements of one second.
#[derive(Debug, Default)]
pub struct Second {
    /// End of the second, by the source's clock.
    pub at: Timestamp,
    /// End of the second as model time, which steps of the source's clock do not change.
    pub end: ModelTime,
    /// Rows, sorted by topic. Seconds that differ only in `at` share them.
    rows: Arc<[Row]>,
}

/// Measurements of one topic in one second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    topic: u32,
    /// Messages received whole.
    pub messages: u32,
    /// Messages that the worst subscriber lost.
    pub lost: u32,
    /// Payload bytes.
    pub bytes: f32,
    latency: [Bfloat16; 2],
    interarrival: [Bfloat16; 2],
}

/// A row with the rates that depend on the rows before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The row.
    pub row: Row,
    /// Messages per second over the last 10 s; `None` in the first measured second.
    pub rate_hz: Option<f64>,
    /// Payload bytes per second over the last 10 s.
    pub bandwidth: Option<f64>,
}

/// The upper half of an `f32`: 8 bits of precision, which exceeds that of a histogram's percentile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Bfloat16(u16);

/// Ids of topics by domain and DDS name.
#[derive(Clone, Debug, Default)]
struct Names {
    by_domain: BTreeMap<DomainId, BTreeMap<DdsName, u32>>,
}

/// Counts of a topic at the end of the previous second.
#[derive(Debug)]
struct PreviousTotals {
    messages: u64,
    bytes: u64,
    lost: u64,
    /// Parts of these counts that belong to earlier seconds.
    earlier: EarlierCounts,
    latency: Histogram,
    interarrival: Histogram,
}

impl History {
    /// Creates a ring of the last whole seconds of `span`, for at most `topics` topics that are
    /// measured simultaneously.
    #[must_use]
    pub fn new(span: Duration, topics: usize) -> Self {
        let most = topics.saturating_mul(MAX_NAMES_PER_TOPIC);
        Self {
            most,
            seconds: Bounded::capped(usize::try_from(span.as_secs()).unwrap_or(usize::MAX)),
            rows: Sum::default(),
            names: Arc::default(),
            before: Bounded::capped(most),
            last: 0,
            evictions: 0,
        }
    }

    /// Returns the time at which the next second ends.
    #[must_use]
    pub fn due(&self) -> Timestamp {
        let last = self.seconds.back();
        last.map_or(Timestamp(0), |last| {
            Timestamp((last.at.whole_seconds() + 1).saturating_mul(SECOND))
        })
    }

    /// Returns whether a second has ended by `now`, or the clock was set back.
    #[must_use]
    pub fn is_due(&self, now: Timestamp) -> bool {
        let is_back = self.seconds.back().is_some_and(|last| now < last.at);
        now.0 > 0 && (now >= self.due() || is_back)
    }

    /// Adds a second that ends at `now`, from the counts at that time.
    pub fn take<'a>(
        &mut self,
        now: Timestamp,
        counts: TopicCounts<impl Iterator<Item = (DomainId, &'a DdsName, Measurement)>>,
    ) {
        let TopicCounts { at: end, topics } = counts;
        self.follow_clock(now, end);
        let mut rows: Vec<Row> = Vec::new();
        let mut is_forgetful = true;
        for (domain_id, dds_name, counted) in topics {
            let is_full = self.names.len() >= self.most;
            let known = self.names.find(domain_id, dds_name);
            if known.is_none() && is_full && std::mem::take(&mut is_forgetful) {
                self.forget(&rows);
            }
            if let Some(topic) = known.or_else(|| self.name(domain_id, dds_name)) {
                rows.push(self.row(topic, &counted));
            }
        }
        rows.sort_unstable_by_key(|row| row.topic);
        self.rows.add(rows.len());
        let second = Second {
            at: now,
            end,
            rows: rows.into(),
        };
        let mut left = self.seconds.push_back(Arc::new(second));
        loop {
            self.rows.sub(left.map_or(0, |oldest| oldest.rows.len()));
            if !self.rows.is_exceeded() {
                break;
            }
            left = self.seconds.pop_front();
        }
    }

    /// Returns the current state for readers.
    #[must_use]
    pub fn past(&self) -> Past {
        Past {
            names: Arc::clone(&self.names),
            seconds: self.seconds.iter().cloned().collect(),
        }
    }

    /// Returns the number of topics with a history, and their cap.
    #[must_use]
    pub fn table(&self) -> TableFacts {
        TableFacts {
            table: "history",
            size: self.names.len() as u64,
            limit: self.most as u64,
            bytes: None,
            evictions: self.evictions,
        }
    }

    /// Sets the times of earlier seconds back with the clock, because times within a chart must
    /// increase. Drops these seconds if a source without a continuous time went back.
    fn follow_clock(&mut self, now: Timestamp, end: ModelTime) {
        let last = self.seconds.back().map(|last| (last.at, last.end));
        let Some((last_at, last_end)) = last.filter(|(at, _)| now < *at) else {
            return;
        };
        let Ok(passed) = u64::try_from(end.nanoseconds_since(last_end)) else {
            self.seconds.clear();
            self.rows.clear();
            return;
        };
        let back = (last_at.0 - now.0).saturating_add(passed);
        for second in &mut self.seconds {
            *second = Arc::new(Second {
                at: Timestamp(second.at.0.saturating_sub(back)),
                end: second.end,
                rows: Arc::clone(&second.rows),
            });
        }
    }

    /// Assigns an id to a new topic, or returns `None` if the table of names is full.
    fn name(&mut self, domain_id: DomainId, dds_name: &DdsName) -> Option<u32> {
        if self.names.len() >= self.most {
            self.evictions += 1;
            return None;
        }
        self.last = self.last.checked_add(1)?;
        let names = &mut Arc::make_mut(&mut self.names).by_domain;
        let names = names.entry(domain_id).or_default();
        names.insert(dds_name.clone(), self.last);
        Some(self.last)
    }

    /// Drops the history of topics that were measured neither in the last second nor in this one.
    fn forget(&mut self, rows: &[Row]) {
        let last = self.seconds.back().cloned().unwrap_or_default();
        let now: HashSet<_> = rows.iter().map(|row| row.topic).collect();
        let stays = |id: u32| now.contains(&id) || last.row(id).is_some();
        let before = self.names.len();
        let names = &mut Arc::make_mut(&mut self.names).by_domain;
        for names in names.values_mut() {
            names.retain(|_, id| stays(*id));
        }
        names.retain(|_, names| !names.is_empty());
        self.evictions += (before - self.names.len()) as u64;
        self.before.retain(|id, _| stays(*id));
    }

    fn row(&mut self, topic: u32, counted: &Measurement) -> Row {
        let after = PreviousTotals {
            messages: counted.messages,
            bytes: counted.bytes,
            lost: counted.loss.lost,
            earlier: counted.earlier,
            latency: counted.source_latency,
            interarrival: counted.interarrival,
        };
        let nothing = || PreviousTotals {
            messages: 0,
            bytes: 0,
            lost: 0,
            earlier: EarlierCounts::default(),
            latency: Histogram::default(),
            interarrival: Histogram::default(),
        };
        let before = self.before.get(&topic);
        let row = after.since(topic, before.unwrap_or(&nothing()));
        self.before.insert(topic, after);
        row
    }
}

impl Past {
    /// Returns each second of one topic, oldest first, with `None` for seconds without a
    /// measurement. Returns `None` for a topic without a history.
    pub fn topic(
        &self,
        domain_id: DomainId,
        dds_name: &str,
    ) -> Option<impl Iterator<Item = (Timestamp, Option<Reading>)> + '_> {
        let id = self.names.find(domain_id, dds_name)?;
        let readings = (0..self.seconds.len()).filter_map(move |place| {
            let second = self.seconds.get(place)?;
            Some((second.at, self.reading(place, id)))
        });
        Some(readings)
    }

    /// Returns the id of the topic for [`Second::row`]; `None` for a topic without a history.
    #[must_use]
    pub fn id(&self, domain_id: DomainId, dds_name: &str) -> Option<u32> {
        self.names.find(domain_id, dds_name)
    }

    /// Returns the topics with a history: the domain, the DDS name, and the id in [`Row::topic`].
    pub fn topics(&self) -> impl Iterator<Item = (DomainId, &DdsName, u32)> {
        let domains = self.names.by_domain.iter();
        domains.flat_map(|(domain_id, names)| {
            names.iter().map(move |(name, id)| (*domain_id, name, *id))
        })
    }

    /// Returns the seconds, oldest first.
    #[must_use]
    pub fn seconds(&self) -> &[Arc<Second>] {
        &self.seconds
    }

    /// Returns the seconds that ended after this time, oldest first.
    #[must_use]
    pub fn since(&self, end: ModelTime) -> &[Arc<Second>] {
        let first = self.seconds.partition_point(|second| second.end <= end);
        self.seconds.get(first..).unwrap_or_default()
    }

    /// Returns one second of a topic, with its rates over the window that ends there; `None` if it
    /// was not measured.
    fn reading(&self, place: usize, id: u32) -> Option<Reading> {
        let row = self.seconds.get(place)?.row(id)?;
        let window = usize::try_from(WINDOW).unwrap_or(usize::MAX);
        let first = place.saturating_sub(window);
        let (mut messages, mut bytes) = (0.0, 0.0);
        let mut began = None;
        for second in self.seconds.get(first..=place).unwrap_or_default() {
            let Some(row) = second.row(id) else {
                // The topic was not measured in this second, so the sums begin again.
                (messages, bytes, began) = (0.0, 0.0, Some(second.end));
                continue;
            };
            // The first second only marks the beginning of the next one.
            if began.is_some() {
                messages += f64::from(row.messages);
                bytes += f64::from(row.bytes);
            } else {
                began = Some(second.end);
            }
        }
        let end = self.seconds.get(place)?.end;
        let seconds = (end - began.unwrap_or(end)).as_secs_f64();
        let per_second = |sum: f64| (seconds > 0.0).then(|| sum / seconds);
        Some(Reading {
            row,
            rate_hz: per_second(messages),
            bandwidth: per_second(bytes),
        })
    }
}

impl Second {
    /// Returns the row of a topic; `None` if it was not measured in this second.
    #[must_use]
    pub fn row(&self, topic: u32) -> Option<Row> {
        let place = self.rows.binary_search_by_key(&topic, |row| row.topic);
        self.rows.get(place.ok()?).copied()
    }

    /// Returns the rows of all topics.
    #[must_use]
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }
}

impl Row {
    /// Returns the id of its topic.
    #[must_use]
    pub const fn topic(&self) -> u32 {
        self.topic
    }

    /// Returns the median and 99th percentile of the time from the writer's timestamp to the
    /// capture, in seconds; `None` without a message.
    #[must_use]
    pub fn latency(&self) -> Option<[f32; 2]> {
        pair(self.latency)
    }

    /// Returns the median and 99th percentile of the time between messages of one writer, in
    /// seconds; `None` without two messages.
    #[must_use]
    pub fn interarrival(&self) -> Option<[f32; 2]> {
        pair(self.interarrival)
    }
}

fn pair([median, high]: [Bfloat16; 2]) -> Option<[f32; 2]> {
    Some([median.value()?, high.value()?])
}

impl Bfloat16 {
    const NONE: Self = Self(0xffff);

    fn new(value: f64) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "rounding is the purpose")]
        let bits = (value as f32).to_bits();
        // Rounds to nearest; the bits of a finite number stay below those of NaN.
        Self(u16::try_from(bits.saturating_add(0x8000) >> 16).unwrap_or(0xffff))
    }

    fn value(self) -> Option<f32> {
        (self != Self::NONE).then(|| f32::from_bits(u32::from(self.0) << 16))
    }
}

impl Names {
    fn find(&self, domain_id: DomainId, dds_name: &str) -> Option<u32> {
        self.by_domain.get(&domain_id)?.get(dds_name).copied()
    }

    fn len(&self) -> usize {
        let Self { by_domain } = self;
        by_domain.values().map(BTreeMap::len).sum()
    }
}

impl PreviousTotals {
    /// Returns the counts between `before` and this state. A count that decreased belongs to a
    /// topic that was removed in between, so all of it is new. Counts of earlier
    /// seconds are left out.
    fn since(&self, topic: u32, before: &Self) -> Row {
        let more = |now: u64, before: u64| now.checked_sub(before).unwrap_or(now);
        let fresh = |all: (u64, u64), earlier: (u64, u64)| {
            more(all.0, all.1).saturating_sub(more(earlier.0, earlier.1))
        };
        let count = |all, earlier| u32::try_from(fresh(all, earlier)).unwrap_or(u32::MAX);
        let percentiles = |now: &Histogram, before: &Histogram| {
            let difference = now.since(before);
            let quantile = |part| {
                difference
                    .quantile(part)
                    .map_or(Bfloat16::NONE, Bfloat16::new)
            };
            [0.5, 0.99].map(quantile)
        };
        #[expect(
            clippy::cast_precision_loss,
            reason = "bytes of one second, for a chart"
        )]
        let bytes = fresh(
            (self.bytes, before.bytes),
            (self.earlier.bytes, before.earlier.bytes),
        ) as f32;
        Row {
            topic,
            messages: count(
                (self.messages, before.messages),
                (self.earlier.messages, before.earlier.messages),
            ),
            lost: count(
                (self.lost, before.lost),
                (self.earlier.lost, before.earlier.lost),
            ),
            bytes,
            latency: percentiles(&self.latency, &before.latency),
            interarrival: percentiles(&self.interarrival, &before.interarrival),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::facts::loss_share::LossShare;

    fn counted(messages: u64, lost: u64, latencies: &[f64]) -> Measurement {
        let mut counted = Measurement {
            messages,
            loss: LossShare {
                lost,
                expected: messages + lost,
            },
            bytes: messages * 100,
            ..Measurement::default()
        };
        for latency in latencies {
            counted.source_latency.observe(*latency);
        }
        counted
    }

    fn name(text: &str) -> DdsName {
        text.into()
    }

    fn take(history: &mut History, second: u64, topics: &[(&DdsName, Measurement)]) {
        let topics = topics
            .iter()
            .map(|(name, counted)| (DomainId(0), *name, counted.clone()));
        let at = ModelTime::of_second(second);
        history.take(Timestamp(second * SECOND), TopicCounts { at, topics });
        assert!(!history.rows.is_exceeded());
    }

    #[test]
    fn a_row_is_24_bytes() {
        assert_eq!(size_of::<Row>(), 24);
    }

    #[test]
    fn a_second_contains_only_the_counts_of_that_second() {
        let (mut history, points) = (
            History::new(Duration::from_secs(600), 10),
            name("rt/points"),
        );
        take(&mut history, 100, &[(&points, counted(10, 0, &[0.001]))]);
        take(
            &mut history,
            101,
            &[(&points, counted(20, 3, &[0.001, 0.04]))],
        );
        take(
            &mut history,
            102,
            &[(&points, counted(20, 3, &[0.001, 0.04]))],
        );
        let past = history.past();
        let seen: Vec<_> = past.topic(DomainId(0), "rt/points").unwrap().collect();
        let rows: Vec<_> = seen
            .iter()
            .map(|(_, reading)| reading.unwrap().row)
            .collect();
        let counts: Vec<_> = rows.iter().map(|row| (row.messages, row.lost)).collect();
        assert_eq!(counts, [(10, 0), (10, 3), (0, 0)]);
        // The percentiles cover this second only, without the latency of 1 ms in the second before.
        let [median, high] = rows[1].latency().unwrap();
        assert!(median > 0.02 && high < 0.0402, "{median} {high}");
        assert_eq!((rows[2].latency(), rows[1].interarrival()), (None, None));
        assert_eq!(seen[1].1.unwrap().rate_hz, Some(10.0));
        assert_eq!(seen[2].1.unwrap().rate_hz, Some(5.0));
        assert_eq!(seen[2].1.unwrap().bandwidth, Some(500.0));
        assert!(past.topic(DomainId(1), "rt/points").is_none());
    }

    #[test]
    fn messages_from_before_a_late_announcement_do_not_appear_in_a_chart() {
        let (mut history, points) = (
            History::new(Duration::from_secs(600), 10),
            name("rt/points"),
        );
        take(&mut history, 100, &[(&points, counted(0, 0, &[]))]);
        // A writer that has sent 702 messages is announced.
        let promoted = |messages: u64| Measurement {
            earlier: EarlierCounts {
                messages: 702,
                bytes: 70_200,
                lost: 4,
            },
            ..counted(702 + messages, 4, &[])
        };
        take(&mut history, 101, &[(&points, promoted(25))]);
        take(&mut history, 102, &[(&points, promoted(75))]);
        let past = history.past();
        let seen = past.topic(DomainId(0), "rt/points").unwrap();
        let seen: Vec<_> = seen.map(|(_, reading)| reading.unwrap()).collect();
        let rows = seen.iter().map(|it| (it.row.messages, it.row.lost));
        assert_eq!(rows.collect::<Vec<_>>(), [(0, 0), (25, 0), (50, 0)]);
        assert_eq!(seen[2].row.bytes, 5000.0);
        assert_eq!(seen[2].rate_hz, Some(37.5));
    }

    #[test]
    fn a_topic_that_was_not_measured_for_a_while_has_a_gap() {
        let mut history = History::new(Duration::from_secs(600), 10);
        let (one, other) = (name("rt/a"), name("rt/b"));
        take(
            &mut history,
            1,
            &[(&one, counted(5, 0, &[])), (&other, counted(1, 0, &[]))],
        );
        take(&mut history, 2, &[(&other, counted(2, 0, &[]))]);
        take(
            &mut history,
            3,
            &[(&one, counted(7, 0, &[])), (&other, counted(3, 0, &[]))],
        );
        let past = history.past();
        let seen: Vec<_> = past.topic(DomainId(0), "rt/a").unwrap().collect();
        let messages: Vec<_> = seen
            .iter()
            .map(|(_, reading)| reading.map(|reading| reading.row.messages))
            .collect();
        assert_eq!(messages, [Some(5), None, Some(2)]);
        assert_eq!(seen[2].1.unwrap().rate_hz, Some(2.0));
    }

    #[test]
    fn old_seconds_are_dropped_and_many_rows_shorten_the_history() {
        let (mut history, points) = (History::new(Duration::from_secs(3), 10), name("rt/points"));
        for second in 1..=5 {
            take(&mut history, second, &[(&points, counted(second, 0, &[]))]);
        }
        let past = history.past();
        let times: Vec<_> = past
            .seconds()
            .iter()
            .map(|second| second.at.whole_seconds())
            .collect();
        assert_eq!(times, [3, 4, 5]);

        let mut history = History::new(Duration::from_secs(600), 20_000);
        let names: Vec<_> = (0..20_000)
            .map(|number| name(&number.to_string()))
            .collect();
        for second in 1..=20 {
            let topics = names
                .iter()
                .map(|name| (DomainId(0), name, Measurement::default()));
            let at = ModelTime::of_second(second);
            history.take(Timestamp(second * SECOND), TopicCounts { at, topics });
        }
        assert_eq!(history.past().seconds().len(), 13);
        assert_eq!(history.rows.used(), 13 * 20_000);
    }

    #[test]
    fn a_full_table_drops_the_names_of_topics_that_are_no_longer_measured() {
        let mut history = History::new(Duration::from_secs(600), 2);
        let names: Vec<_> = (0..9).map(|number| name(&number.to_string())).collect();
        for (second, name) in (1..).zip(&names) {
            take(&mut history, second, &[(name, counted(1, 0, &[]))]);
        }
        let past = history.past();
        let table = history.table();
        assert!(table.size <= 4 && table.limit == 4, "{table:?}");
        assert_eq!(table.size + table.evictions, 9);
        assert!(past.topic(DomainId(0), "8").is_some() && past.topic(DomainId(0), "0").is_none());
        assert!(history.before.len() <= 4);
        // One second has more topics than the table of names holds.
        let all: Vec<_> = names
            .iter()
            .map(|name| (name, counted(1, 0, &[])))
            .collect();
        take(&mut history, 20, &all);
        assert_eq!(history.table().size, 4);
    }

    #[test]
    fn steps_of_the_clock_change_no_rate_and_drop_no_second() {
        let hour = 3600 * SECOND.cast_signed();
        for step in [-hour, -SECOND.cast_signed() * 3 / 2, -5_000_000, hour] {
            let points = name("rt/points");
            let mut history = History::new(Duration::from_secs(600), 2);
            for second in 0..20 {
                let at = ModelTime::of_second(100_000 + second);
                let step = if second < 10 { 0 } else { step };
                let now = Timestamp(at.nanoseconds().saturating_add_signed(step));
                let topics = [(DomainId(0), &points, counted(10 * second, 0, &[]))].into_iter();
                history.take(now, TopicCounts { at, topics });
            }
            let past = history.past();
            let seen: Vec<_> = past.topic(DomainId(0), "rt/points").unwrap().collect();
            assert_eq!(seen.len(), 20, "{step}");
            assert!(seen.is_sorted_by(|one, next| one.0 < next.0), "{step}");
            let mut rates = seen.iter().map(|(_, reading)| reading.unwrap().rate_hz);
            assert_eq!(rates.next(), Some(None));
            assert!(rates.all(|rate| rate == Some(10.0)), "{step}");
            assert_eq!(past.since(ModelTime::of_second(100_015)).len(), 4);
        }
    }

    #[test]
    fn a_source_that_goes_back_clears_the_history() {
        let (mut history, points) = (History::new(Duration::from_secs(600), 2), name("rt/points"));
        take(&mut history, 100, &[(&points, counted(1, 0, &[]))]);
        assert!(!history.is_due(Timestamp(100 * SECOND + 5)));
        assert!(history.is_due(Timestamp(101 * SECOND)));
        assert!(history.is_due(Timestamp(50 * SECOND)));
        take(&mut history, 50, &[(&points, counted(2, 0, &[]))]);
        assert_eq!(history.past().seconds().len(), 1);
        assert_eq!(history.due(), Timestamp(51 * SECOND));
        assert!(!History::new(Duration::from_secs(1), 1).is_due(Timestamp(0)));
    }

    #[test]
    fn bfloat16_keeps_two_significant_digits() {
        for value in [1e-6, 0.00123, 0.5, 9.99, 86_400.0] {
            let rounded = f64::from(Bfloat16::new(value).value().unwrap());
            assert!((rounded / value - 1.0).abs() < 0.004, "{value} {rounded}");
        }
        assert_eq!(Bfloat16::NONE.value(), None);
        assert!(Bfloat16::new(f64::MAX).value().is_some());
    }
}
