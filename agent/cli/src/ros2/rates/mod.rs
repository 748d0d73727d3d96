//! What `ros2 topic hz`, `bw` and `delay` say, by dialect: text from samples and a clock.
//!
//! A state machine without clock or I/O: time comes in with the samples and with the stream's clock,
//! so a live stream and a capture print the same. Every sample on the wire counts, at the time it
//! was captured.

pub mod bandwidth;
pub mod delay;
pub mod hz;
pub mod table;
pub mod window;

use std::collections::{HashMap, HashSet};
use std::fmt::Write as _;
use std::mem;

use self::bandwidth::{Bandwidth, Sizes};
use self::delay::{Age, Ages};
use self::hz::{Intervals, Rate};
use self::table::table;
use super::{Dialect, Refused};
use ros2probe_daemon::subscriptions::begins_with_header;

const SECOND: i64 = 1_000_000_000;
/// Of a nanosecond, in seconds.
const NANOSECOND: f64 = 1e-9;
/// Clears a terminal, as `--all` does before each table.
const CLEAR: &str = "\x1b[H\x1b[2J\n";
/// A clock that jumped further has been set: the seconds between are not made up for.
const LONGEST_JUMP: i64 = 3600 * SECOND;
/// So many messages wait for the clock at most; it comes ten times a second.
const WAITING: usize = 65_536;
/// A larger step in the numbers is another beginning.
const MAX_UNSEEN: u64 = 10_000;

/// What is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// `hz`
    Rate,
    /// `bw`
    Bandwidth,
    /// `delay`
    Delay,
}

/// One command: what it measures, of which topics, in whose words.
#[derive(Debug)]
pub struct Rates {
    quantity: Quantity,
    dialect: Dialect,
    window: usize,
    all: bool,
    topics: Vec<Watched>,
    places: HashMap<String, usize>,
    /// Messages that the clock has not passed, with the places of their topics.
    waiting: Vec<(Arrival, usize)>,
    /// Number and time of the newest message of each writer of which not every one is seen.
    last_sampled: HashMap<String, (u64, i64)>,
    /// Topics of which it was said that they are sampled.
    sampled_reported: HashSet<String>,
    /// When the next report of every second is due.
    next: Option<i64>,
    output: Output,
}

/// Text for the two outputs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Output {
    /// For standard output.
    pub out: String,
    /// For standard error.
    pub err: String,
}

/// Why a command is over.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// There is nothing to do.
    Idle,
    /// It cannot be done; the text says why.
    Refused(Refused),
}

/// A topic by the name that was typed and the one that it has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Named {
    /// As typed: what is printed.
    pub typed: String,
    /// With its namespace.
    pub name: String,
}

/// One message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// When it was captured, in nanoseconds since the epoch.
    pub time: i64,
    /// Bytes of its serialized payload with encapsulation.
    pub size: u32,
    /// The stamp in its header, in nanoseconds since the epoch.
    pub header_stamp: Option<i64>,
}

/// Who wrote a message, and its number among those of this writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin<'a> {
    /// GUID.
    pub writer: &'a str,
    /// From 1.
    pub number: u64,
}

#[derive(Debug)]
struct Watched {
    topic: Named,
    /// Nothing as long as the topic is not there.
    message_type: Option<String>,
    /// Not every message is seen.
    sampled: bool,
    series: Series,
}

#[derive(Debug)]
enum Series {
    Rate(Intervals),
    Bandwidth(Sizes),
    Delay(Ages),
}

impl Rates {
    /// Of these topics.
    #[must_use]
    pub fn of(quantity: Quantity, dialect: Dialect, window: usize, topics: Vec<Named>) -> Self {
        let mut rates = Self::empty(quantity, dialect, window, false);
        for topic in topics {
            rates.add(topic);
        }
        rates
    }

    /// Of all topics, also of those that appear later.
    #[must_use]
    pub fn of_all(quantity: Quantity, dialect: Dialect, window: usize) -> Self {
        Self::empty(quantity, dialect, window, true)
    }

    fn empty(quantity: Quantity, dialect: Dialect, window: usize, all: bool) -> Self {
        Self {
            quantity,
            dialect,
            window,
            all,
            topics: Vec::new(),
            places: HashMap::new(),
            waiting: Vec::new(),
            last_sampled: HashMap::new(),
            sampled_reported: HashSet::new(),
            next: None,
            output: Output::default(),
        }
    }

    /// The topics that are there at the beginning, in order, with their types.
    ///
    /// # Errors
    /// When the command is over with that.
    pub fn opened(&mut self, present: &[(String, Vec<String>)]) -> Result<(), End> {
        if self.all {
            let present = present.iter();
            let present: Vec<_> = present
                .filter(|(_, types)| self.measurable(types))
                .collect();
            if present.is_empty() {
                self.output.out.push_str("No topics available\n");
                return Err(End::Idle);
            }
            let count = present.len();
            let _ = writeln!(
                self.output.out,
                "Subscribing to all {count} available topics..."
            );
            for (name, _) in &present {
                self.add(Named::absolute(name));
            }
            for (name, types) in present {
                self.appeared(name, types)?;
            }
            return Ok(());
        }
        let types: HashMap<&str, &Vec<String>> = present
            .iter()
            .map(|(name, types)| (name.as_str(), types))
            .collect();
        let names = self.topics.iter().map(|watched| watched.topic.clone());
        for Named { typed, name } in names.collect::<Vec<_>>() {
            match types.get(name.as_str()) {
                Some(types) => self.appeared(&name, types)?,
                None => {
                    let _ = writeln!(
                        self.output.out,
                        "WARNING: topic [{typed}] does not appear to be published yet"
                    );
                }
            }
        }
        Ok(())
    }

    /// A topic is there, with these types. What is not asked for is left alone.
    ///
    /// # Errors
    /// When the topic has several types.
    pub fn appeared(&mut self, name: &str, types: &[String]) -> Result<(), End> {
        if self.all && !self.places.contains_key(name) && self.measurable(types) {
            self.add(Named::absolute(name));
        }
        let many = self.many();
        let Some(watched) = self
            .places
            .get(name)
            .and_then(|at| self.topics.get_mut(*at))
        else {
            return Ok(());
        };
        let typed = &watched.topic.typed;
        let message_type = match types {
            [] => return Ok(()),
            [one] => one,
            [first, ..] if self.all => first,
            several => {
                return Err(End::Refused(Refused(format!(
                    "Cannot echo topic '{typed}', as it contains more than one type: [{}]",
                    several.join(", ")
                ))));
            }
        };
        if watched.message_type.is_some() {
            return Ok(());
        }
        watched.message_type = Some(message_type.clone());
        if many || self.quantity == Quantity::Bandwidth {
            let _ = writeln!(self.output.out, "Subscribed to [{typed}]");
        }
        Ok(())
    }

    /// A message of a topic. It counts once the clock has passed it: messages by different ways,
    /// as by network and by shared memory, come in no order.
    ///
    /// # Errors
    /// When its delay is asked for and it has no header.
    pub fn arrived(&mut self, name: &str, arrival: Arrival) -> Result<(), End> {
        let Some(place) = self.places.get(name).copied() else {
            return Ok(());
        };
        let Some(message_type) = self
            .topics
            .get(place)
            .and_then(|one| one.message_type.as_ref())
        else {
            return Ok(());
        };
        let has_header = || self.all || begins_with_header(message_type);
        if self.quantity == Quantity::Delay && arrival.header_stamp.is_none() && !has_header() {
            return Err(End::Refused(Refused("msg does not have header".to_owned())));
        }
        if self.waiting.len() >= WAITING {
            self.settle(arrival.time);
        }
        self.waiting.push((arrival, place));
        Ok(())
    }

    /// Everything before this time was given.
    pub fn clock(&mut self, now: i64) {
        self.settle(now);
        self.tick(now);
    }

    /// As [`Self::arrived`], where not every message is seen: those with the numbers between this
    /// one and the last of its writer count as well, at times between theirs.
    ///
    /// # Errors
    /// As [`Self::arrived`].
    pub fn sampled(&mut self, name: &str, arrival: Arrival, origin: Origin<'_>) -> Result<(), End> {
        let Some(place) = self.places.get(name).copied() else {
            return Ok(());
        };
        let newest = (origin.number, arrival.time);
        let last = self.last_sampled.insert(origin.writer.to_owned(), newest);
        let (number, mut time) = last.unwrap_or(newest);
        let between = origin.number.saturating_sub(number).saturating_sub(1);
        let topic = self.topics.get_mut(place);
        if let Some(watched) = topic.filter(|_| (1..=MAX_UNSEEN).contains(&between)) {
            let is_new = !mem::replace(&mut watched.sampled, true);
            if is_new && !self.sampled_reported.contains(name) {
                let _ = writeln!(
                    self.output.err,
                    "rp: {name} is sampled in shared memory; unseen messages are counted from \
                     sequence numbers and their times estimated"
                );
            }
            let steps = i64::try_from(between + 1).unwrap_or(i64::MAX);
            let step = arrival.time.saturating_sub(time) / steps;
            for _ in 0..between {
                time = time.saturating_add(step);
                let unseen = Arrival {
                    time,
                    header_stamp: None,
                    ..arrival
                };
                self.waiting.push((unseen, place));
            }
        }
        self.arrived(name, arrival)
    }

    /// That these topics are sampled was said before.
    pub fn sampled_reported<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        for name in names {
            self.sampled_reported.insert(name.to_owned());
        }
    }

    /// Nothing more is given.
    pub fn finish(&mut self) {
        self.settle(i64::MAX);
    }

    /// Counts the messages up to this time in their order.
    fn settle(&mut self, until: i64) {
        self.waiting.sort_by_key(|(arrival, _)| arrival.time);
        let passed = self
            .waiting
            .partition_point(|(arrival, _)| arrival.time <= until);
        let later = self.waiting.split_off(passed);
        for (arrival, place) in mem::replace(&mut self.waiting, later) {
            self.tick(arrival.time);
            self.count(&arrival, place);
        }
    }

    fn count(&mut self, arrival: &Arrival, place: usize) {
        let reported_at_message = self.reported_at_message();
        match self
            .topics
            .get_mut(place)
            .map(|watched| &mut watched.series)
        {
            Some(Series::Rate(intervals)) => {
                intervals.arrived(arrival.time);
                if reported_at_message && let Some(rate) = intervals.report_at_message() {
                    self.output.out.push_str(&rate.lines());
                }
            }
            Some(Series::Bandwidth(sizes)) => sizes.arrived(arrival.time, arrival.size),
            Some(Series::Delay(ages)) => match arrival.header_stamp {
                Some(stamp) => ages.arrived(arrival.time, stamp),
                None => ages.passed(arrival.time),
            },
            None => {}
        }
    }

    /// Reports every second up to this one that is due.
    fn tick(&mut self, now: i64) {
        if self.reported_at_message() || self.topics.iter().all(|one| one.message_type.is_none()) {
            return;
        }
        let next = match self.next {
            None => {
                self.clear();
                now.saturating_add(SECOND)
            }
            // Set back, or far ahead: the seconds are counted from here.
            Some(next) if next.saturating_sub(now) > 2 * SECOND => now.saturating_add(SECOND),
            Some(next) if now.saturating_sub(next) > LONGEST_JUMP => now,
            Some(next) => next,
        };
        let mut due = next;
        while due <= now {
            self.report(due);
            due = due.saturating_add(SECOND);
        }
        self.next = Some(due);
    }

    /// What was said since the last time.
    pub fn take(&mut self) -> Output {
        mem::take(&mut self.output)
    }

    fn add(&mut self, topic: Named) {
        if self.places.contains_key(&topic.name) {
            return;
        }
        let series = match self.quantity {
            Quantity::Rate => Series::Rate(Intervals::new(self.window)),
            Quantity::Bandwidth => Series::Bandwidth(Sizes::new(self.window)),
            Quantity::Delay => Series::Delay(Ages::new(self.window)),
        };
        self.places.insert(topic.name.clone(), self.topics.len());
        self.topics.push(Watched {
            topic,
            message_type: None,
            sampled: false,
            series,
        });
    }

    /// With `--all`, delays are those of the types that have a header.
    fn measurable(&self, types: &[String]) -> bool {
        let mut types = types.iter();
        self.quantity != Quantity::Delay || types.any(|one| begins_with_header(one))
    }

    fn many(&self) -> bool {
        self.topics.len() > 1
    }

    fn reported_at_message(&self) -> bool {
        let at_message = self.quantity == Quantity::Rate && self.dialect < Dialect::Kilted;
        at_message && !self.all && !self.many()
    }

    fn clear(&mut self) {
        if self.all {
            self.output.out.push_str(CLEAR);
        }
    }

    fn report(&mut self, now: i64) {
        self.clear();
        let text = match self.quantity {
            Quantity::Rate => self.rates(),
            Quantity::Bandwidth => self.bandwidths(now),
            Quantity::Delay => self.delays(),
        };
        self.output.out.push_str(&text);
    }

    fn rates(&mut self) -> String {
        let many = self.many();
        let mut rows = Vec::new();
        for watched in &mut self.topics {
            let Series::Rate(intervals) = &mut watched.series else {
                continue;
            };
            let Some(rate) = intervals.report_at_second() else {
                continue;
            };
            if !many {
                return rate.lines();
            }
            let Rate {
                rate,
                min,
                max,
                standard_deviation,
                window,
            } = rate;
            rows.push([
                watched.topic.typed.clone(),
                rate,
                min,
                max,
                standard_deviation,
                window,
            ]);
        }
        let headings = [
            "topic",
            "rate",
            "min_delta",
            "max_delta",
            "std_dev",
            "window",
        ];
        table(headings, &rows)
    }

    fn bandwidths(&mut self, now: i64) -> String {
        let many = self.many();
        let new_only = many || self.all || self.dialect >= Dialect::Rolling;
        let mut rows = Vec::new();
        for watched in &mut self.topics {
            let Series::Bandwidth(sizes) = &mut watched.series else {
                continue;
            };
            let report = if new_only {
                sizes.report_of_new(now)
            } else {
                sizes.report(now)
            };
            let report = report.unwrap_or_else(|_| {
                self.output.err.push_str("WARNING: time is reset!\n");
                None
            });
            let Some(report) = report else {
                continue;
            };
            if !many {
                return report.lines();
            }
            let Bandwidth {
                bandwidth,
                window,
                mean,
                min,
                max,
            } = report;
            rows.push([
                watched.topic.typed.clone(),
                bandwidth,
                window,
                mean,
                min,
                max,
            ]);
        }
        table(
            ["topic", "bandwidth", "window", "mean", "min", "max"],
            &rows,
        )
    }

    fn delays(&mut self) -> String {
        let many = self.many();
        let mut rows = Vec::new();
        for watched in &mut self.topics {
            let Series::Delay(ages) = &mut watched.series else {
                continue;
            };
            if !many {
                return ages.lines().unwrap_or_default();
            }
            let Some(Age {
                delay,
                min,
                max,
                standard_deviation,
                window,
            }) = ages.report()
            else {
                continue;
            };
            rows.push([
                watched.topic.typed.clone(),
                delay,
                min,
                max,
                standard_deviation,
                window,
            ]);
        }
        table(["topic", "delay", "min", "max", "std_dev", "window"], &rows)
    }
}

impl Named {
    /// A name that was typed in full, or was not typed at all.
    #[must_use]
    pub fn absolute(name: &str) -> Self {
        let name = name.to_owned();
        Self {
            typed: name.clone(),
            name,
        }
    }
}

#[cfg(test)]
mod tests;
