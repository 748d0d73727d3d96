//! Text of `ros2 topic hz`, `bw` and `delay`, by dialect, from samples and a clock.
//!
//! A state machine without clock or I/O: times come with the samples and with the stream's clock. A
//! live stream and a capture therefore print the same. Every sample on the wire counts at the time
//! of its capture.

pub mod bandwidth;
pub mod delay;
pub mod hz;
mod numbers;
pub mod table;
pub mod window;

use std::collections::{HashMap, HashSet};
use std::fmt::Write as _;
use std::mem;

use self::bandwidth::{Bandwidth, Sizes};
use self::delay::{Age, Ages};
use self::hz::{Intervals, Rate};
use self::numbers::{Message, Numbers, Place};
use self::table::table;
use super::{Dialect, Refused};
use ros2probe_daemon::subscriptions::begins_with_header;

const SECOND: i64 = 1_000_000_000;
/// One nanosecond in seconds.
const NANOSECOND: f64 = 1e-9;
/// Clears a terminal, as `--all` does before each table.
const CLEAR_SCREEN: &str = "\x1b[H\x1b[2J\n";
/// Maximum step of the clock of a capture, which may have gaps. A larger step means that the clock
/// was set, and skipped seconds are not reported.
const LONGEST_JUMP: i64 = 3600 * SECOND;
/// Maximum step of the clock of a live agent, which ticks ten times a second.
const LONGEST_LIVE_JUMP: i64 = 2 * SECOND;
/// Maximum number of messages that wait for the clock, which ticks ten times a second.
const MAX_WAITING: usize = 65_536;

/// Measured quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Rate of messages, `hz`.
    Rate,
    /// Bytes per second, `bw`.
    Bandwidth,
    /// Age of messages, `delay`.
    Delay,
}

/// One command: its quantity, topics and dialect.
#[derive(Debug)]
pub struct Rates {
    quantity: Quantity,
    dialect: Dialect,
    window: usize,
    all: bool,
    topics: Vec<Watched>,
    places: HashMap<String, usize>,
    /// Messages after the last tick of the clock, with the indices of their topics.
    waiting: Vec<(Arrival, usize)>,
    /// Time up to which messages have been counted.
    settled: i64,
    /// Sequence numbers of each writer.
    numbers: HashMap<String, Numbers>,
    /// Topics that were reported as sampled.
    sampled_reported: HashSet<String>,
    /// Time of the next periodic report.
    next: Option<i64>,
    /// Maximum step of the clock.
    longest_jump: i64,
    output: Output,
}

/// Text for the two outputs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Output {
    /// Text for standard output.
    pub out: String,
    /// Text for standard error.
    pub err: String,
}

/// Reason for the end of a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// There is no topic to measure.
    Idle,
    /// The command failed, with this text.
    Refused(Refused),
}

/// A topic by its typed and its full name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Named {
    /// Name as typed, which is printed.
    pub typed: String,
    /// Name with its namespace.
    pub name: String,
}

/// One message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// Time of the message's capture, in nanoseconds since the epoch.
    pub time: i64,
    /// Size of the serialized payload with encapsulation, in bytes.
    pub size: u32,
    /// Stamp in the header, in nanoseconds since the epoch.
    pub header_stamp: Option<i64>,
}

/// Writer and sequence number of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin<'a> {
    /// GUID of the writer.
    pub writer: &'a str,
    /// Sequence number, from 1.
    pub number: u64,
    /// The writer's timestamp, in nanoseconds since the epoch.
    pub source_timestamp: Option<i64>,
    /// Whether the message was sampled in shared memory, so that others may have been missed.
    pub is_sampled: bool,
}

#[derive(Debug)]
struct Watched {
    topic: Named,
    /// Type of the messages; `None` until the topic exists.
    message_type: Option<String>,
    /// Whether only samples of the messages are seen.
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
    /// Measures these topics.
    #[must_use]
    pub fn of(quantity: Quantity, dialect: Dialect, window: usize, topics: Vec<Named>) -> Self {
        let mut rates = Self::empty(quantity, dialect, window, false);
        for topic in topics {
            rates.add(topic);
        }
        rates
    }

    /// Measures all topics, including those that appear later.
    #[must_use]
    pub fn of_all(quantity: Quantity, dialect: Dialect, window: usize) -> Self {
        Self::empty(quantity, dialect, window, true)
    }

    /// Measures a live agent instead of a capture.
    #[must_use]
    pub fn live(self) -> Self {
        Self {
            longest_jump: LONGEST_LIVE_JUMP,
            ..self
        }
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
            settled: i64::MIN,
            numbers: HashMap::new(),
            sampled_reported: HashSet::new(),
            next: None,
            longest_jump: LONGEST_JUMP,
            output: Output::default(),
        }
    }

    /// Adds the topics that exist at the start, in order, with their types.
    ///
    /// # Errors
    ///
    /// Returns the reason if the command ends here.
    pub fn opened(&mut self, present: &[(String, Vec<String>)]) -> Result<(), End> {
        if self.all {
            let present = present.iter();
            let present: Vec<_> = present
                .filter(|(_, types)| self.is_measurable(types))
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

    /// Adds a topic that appeared, with its types. Topics that are not measured are ignored.
    ///
    /// # Errors
    ///
    /// Fails if the topic has several types.
    pub fn appeared(&mut self, name: &str, types: &[String]) -> Result<(), End> {
        if self.all && !self.places.contains_key(name) && self.is_measurable(types) {
            self.add(Named::absolute(name));
        }
        let many = self.is_multi_topic();
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

    /// Adds a message. The message counts once the clock has passed it, because messages from
    /// network and shared memory arrive out of order.
    ///
    /// # Errors
    ///
    /// Fails if the delay is measured and the message has no header.
    pub fn add_message(&mut self, name: &str, arrival: Arrival) -> Result<(), End> {
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
        if self.waiting.len() >= MAX_WAITING {
            self.settle(arrival.time.max(self.settled));
        }
        self.waiting.push((arrival, place));
        Ok(())
    }

    /// Advances the clock: all messages before `now` have been added.
    pub fn clock(&mut self, now: i64) {
        self.settle(now);
        self.tick(now);
    }

    /// Adds a message as [`Self::add_message`] does, with its number. A sampled message counts at
    /// the time of the writer's timestamp, except for a delay. Messages between it and the writer's
    /// last one also count, at interpolated times.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::add_message`] does.
    pub fn arrived_from(
        &mut self,
        name: &str,
        mut arrival: Arrival,
        origin: Origin<'_>,
    ) -> Result<(), End> {
        let Some(place) = self.places.get(name).copied() else {
            return Ok(());
        };
        let message = Message {
            number: origin.number,
            captured: arrival.time,
            sent: origin.source_timestamp,
            is_sampled: origin.is_sampled,
        };
        let found = match self.numbers.get_mut(origin.writer) {
            Some(numbers) => numbers.place(message),
            None => {
                let (numbers, found) = Numbers::new(message);
                self.numbers.insert(origin.writer.to_owned(), numbers);
                found
            }
        };
        if self.quantity != Quantity::Delay {
            arrival.time = message.time();
        }
        match found {
            Place::Counts => {}
            Place::Counted => return Ok(()),
            Place::After { unseen, since } => self.unseen(name, place, arrival, unseen, since),
        }
        self.add_message(name, arrival)
    }

    /// Counts messages that were sent between `since` and `arrival`.
    fn unseen(&mut self, name: &str, place: usize, arrival: Arrival, count: u64, since: i64) {
        let Some(watched) = self.topics.get_mut(place) else {
            return;
        };
        let is_new = !mem::replace(&mut watched.sampled, true);
        if is_new && !self.sampled_reported.contains(name) {
            let _ = writeln!(
                self.output.err,
                "rp: {name} is sampled in shared memory; unseen messages are counted from sequence \
                 numbers and their times estimated"
            );
        }
        let steps = i64::try_from(count + 1).unwrap_or(i64::MAX);
        let elapsed = arrival.time.saturating_sub(since);
        for step in 1..steps {
            let part = i128::from(elapsed) * i128::from(step) / i128::from(steps);
            let unseen = Arrival {
                time: since.saturating_add(i64::try_from(part).unwrap_or(0)),
                header_stamp: None,
                ..arrival
            };
            self.waiting.push((unseen, place));
        }
    }

    /// Marks these topics as already reported to be sampled.
    pub fn sampled_reported<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        for name in names {
            self.sampled_reported.insert(name.to_owned());
        }
    }

    /// Counts all remaining messages at the end of the stream.
    pub fn finish(&mut self) {
        self.settle(i64::MAX);
    }

    /// Counts the messages up to this time in the order of their times. An earlier time than that
    /// of the last call means that the clock was set back.
    fn settle(&mut self, until: i64) {
        self.settled = self.settled.min(until);
        self.waiting.sort_by_key(|(arrival, _)| arrival.time);
        let passed = self
            .waiting
            .partition_point(|(arrival, _)| arrival.time <= until);
        let later = self.waiting.split_off(passed);
        for (arrival, place) in mem::replace(&mut self.waiting, later) {
            self.tick(arrival.time.max(self.settled));
            self.count(&arrival, place);
        }
        self.settled = until;
    }

    fn count(&mut self, arrival: &Arrival, place: usize) {
        let reported_at_message = self.is_reported_at_message();
        match self
            .topics
            .get_mut(place)
            .map(|watched| &mut watched.series)
        {
            Some(Series::Rate(intervals)) => {
                intervals.add_message(intervals.time_in_order(arrival.time, self.settled));
                if reported_at_message && let Some(rate) = intervals.report_at_message() {
                    self.output.out.push_str(&rate.lines());
                }
            }
            Some(Series::Bandwidth(sizes)) => sizes.add_message(arrival.time, arrival.size),
            Some(Series::Delay(ages)) => match arrival.header_stamp {
                Some(stamp) => ages.add_message(arrival.time, stamp),
                None => ages.add_unstamped(arrival.time),
            },
            None => {}
        }
    }

    /// Emits all periodic reports due up to this time.
    fn tick(&mut self, now: i64) {
        if self.is_reported_at_message() || self.topics.iter().all(|one| one.message_type.is_none())
        {
            return;
        }
        let next = match self.next {
            None => {
                self.clear();
                now.saturating_add(SECOND)
            }
            // The clock was set back or far ahead, so the seconds are counted from `now`.
            Some(next) if next.saturating_sub(now) > 2 * SECOND => now.saturating_add(SECOND),
            Some(next) if now.saturating_sub(next) > self.longest_jump => now,
            Some(next) => next,
        };
        let mut due = next;
        while due <= now {
            self.report(due);
            due = due.saturating_add(SECOND);
        }
        self.next = Some(due);
    }

    /// Returns and clears the text since the last call.
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

    /// Returns whether a topic can be measured. With `--all`, delays need a type with a header.
    fn is_measurable(&self, types: &[String]) -> bool {
        let mut types = types.iter();
        self.quantity != Quantity::Delay || types.any(|one| begins_with_header(one))
    }

    fn is_multi_topic(&self) -> bool {
        self.topics.len() > 1
    }

    fn is_reported_at_message(&self) -> bool {
        let at_message = self.quantity == Quantity::Rate && self.dialect < Dialect::Kilted;
        at_message && !self.all && !self.is_multi_topic()
    }

    fn clear(&mut self) {
        if self.all {
            self.output.out.push_str(CLEAR_SCREEN);
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
        let many = self.is_multi_topic();
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
        let many = self.is_multi_topic();
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
        let many = self.is_multi_topic();
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
    /// Creates a topic from its full name alone.
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
