//! `rp topic hz`, `bw` and `delay`: subscribe to topics at the agent while the verb runs, and print
//! the measurements. The stream's own clock times the reports.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use bytes::Bytes;
use clap::Args;
use clap::error::ErrorKind;
use ros2probe::client::{Agent, Target};
use ros2probe::ros2::name::full_name;
use ros2probe::ros2::rates::{Arrival, End, Named, Origin, Quantity, Rates};
use ros2probe::ros2::{Dialect, Refused};
use ros2probe_api::path::encoded;
use ros2probe_api::samples::{Line, MissedReason, Sample};
use ros2probe_message::Library;
use ros2probe_message::filter::Filter;

use super::follow::{AGENT_ENDED, END_OF_CAPTURE, MessageFilter, Types, library};
use super::interrupt::EXIT_INTERRUPTED;
use super::notes::Notes;
use super::shared::{Matching, Spinning, names_of};
use super::{Output, UserError};

/// Default window of `hz` and `delay`, in messages.
const RATE_WINDOW: usize = 10_000;
/// Default window of `bw`, in messages.
const BANDWIDTH_WINDOW: usize = 100;
/// `rp topic hz`.
#[derive(Args, Debug)]
pub(crate) struct Hz {
    #[command(flatten)]
    topics: Topics,
    /// Number of newest intervals to calculate from
    #[arg(long, short = 'w', value_name = "WINDOW", default_value_t = RATE_WINDOW, value_parser = positive)]
    window: usize,
    /// Count only messages that match this expression over `m`, the message, as in `rp topic echo`
    #[arg(long, value_name = "EXPR")]
    filter: Option<String>,
    /// Directory with definitions (package/msg/Type.msg), for --filter; may be repeated
    #[arg(long, value_name = "DIR")]
    definitions: Vec<PathBuf>,
    /// Accepted without effect: messages are always timed by the clock of the capture
    #[arg(long)]
    wall_time: bool,
    #[command(flatten)]
    options: Options,
}

/// `rp topic bw`.
#[derive(Args, Debug)]
pub(crate) struct Bandwidth {
    #[command(flatten)]
    topics: Topics,
    /// Number of newest messages to calculate from
    #[arg(long, short = 'w', value_name = "WINDOW", default_value_t = BANDWIDTH_WINDOW, value_parser = positive)]
    window: usize,
    #[command(flatten)]
    options: Options,
}

/// `rp topic delay`.
#[derive(Args, Debug)]
pub(crate) struct Delay {
    #[command(flatten)]
    topics: Topics,
    /// Number of newest messages to calculate from
    #[arg(long, short = 'w', value_name = "WINDOW", default_value_t = RATE_WINDOW, value_parser = positive)]
    window: usize,
    #[command(flatten)]
    options: Options,
}

#[derive(Args, Debug)]
struct Topics {
    /// Topics to measure, e.g. /chatter
    #[arg(value_name = "TOPIC")]
    names: Vec<String>,
    /// Measure all topics, also those that appear later
    #[arg(long, short = 'a')]
    all: bool,
}

#[derive(Args, Debug)]
struct Options {
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    matching: Matching,
    #[command(flatten)]
    target: Target,
}

impl Hz {
    pub(crate) fn run(self, hidden: bool) -> Result<ExitCode> {
        let target = &self.options.target;
        let filter = self.filter.as_deref().map(Filter::parse).transpose();
        let filter = filter.map_err(|error| UserError(error.to_string()))?;
        let filter = filter.map(|filter| (filter, library(target, self.definitions)));
        measure(
            Quantity::Rate,
            self.window,
            self.topics,
            target,
            hidden,
            filter,
        )
    }

    /// Returns the exit code after Ctrl-C.
    pub(crate) fn interrupted(&self) -> u8 {
        since(Dialect::Kilted, &self.options.target)
    }
}

impl Bandwidth {
    pub(crate) fn run(self, hidden: bool) -> Result<ExitCode> {
        measure(
            Quantity::Bandwidth,
            self.window,
            self.topics,
            &self.options.target,
            hidden,
            None,
        )
    }

    /// Returns the exit code after Ctrl-C.
    pub(crate) fn interrupted(&self) -> u8 {
        since(Dialect::Rolling, &self.options.target)
    }
}

impl Delay {
    pub(crate) fn run(self, hidden: bool) -> Result<ExitCode> {
        measure(
            Quantity::Delay,
            self.window,
            self.topics,
            &self.options.target,
            hidden,
            None,
        )
    }
}

/// Returns the exit code after Ctrl-C: 0 in `first` and later distributions.
fn since(first: Dialect, target: &Target) -> u8 {
    if target.dialect() < first {
        EXIT_INTERRUPTED
    } else {
        0
    }
}

fn measure(
    quantity: Quantity,
    window: usize,
    topics: Topics,
    target: &Target,
    hidden: bool,
    filter: Option<(Filter, Library)>,
) -> Result<ExitCode> {
    let dialect = target.dialect();
    let domain_id = target.domain()?;
    let names = topics.names(quantity, dialect)?;
    let (mut rates, query) = match &names {
        None => {
            let query = format!("all=true&hidden={hidden}");
            (Rates::of_all(quantity, dialect, window), query)
        }
        Some(named) => {
            let query: Vec<String> = named.iter().map(|named| encoded(&named.name)).collect();
            let query = format!("topic={}", query.join(","));
            (Rates::of(quantity, dialect, window, named.clone()), query)
        }
    };
    let names: Vec<String> = names
        .into_iter()
        .flatten()
        .map(|named| named.name)
        .collect();
    let agent = Agent::reach_stream(target)?;
    let is_replay = target.replay.is_some();
    if !is_replay {
        rates = rates.live();
    }
    let sieve = filter.map(|(filter, library)| {
        let types = Types::new(library, &agent, domain_id);
        MessageFilter::new(filter, types)
    });
    let consequence = sampled(quantity, sieve.is_some());
    let notes = Notes::begin(&agent, domain_id, is_replay, &names, consequence);
    rates.sampled_reported(notes.sampled());
    // As in ros2cli, the subscription is volatile: a message that was sent before does not count.
    let payload = match sieve {
        Some(_) => "&payload=true&latched=false",
        None => "",
    };
    let path = format!("/samples?{query}&domain_id={domain_id}{payload}");
    let mut lines = agent.stream(&path)?;
    let mut output = Output::new();
    let mut measurement = Measurement {
        agent: &agent,
        domain_id,
        rates,
        notes,
        sieve,
        code: ExitCode::SUCCESS,
    };
    while let Some(line) = lines.line()? {
        let line: Line = serde_json::from_slice(&line)?;
        let length = match &line {
            Line::Sample(sample) => sample.payload_bytes,
            _ => None,
        };
        let payload = match length {
            Some(length) => lines.bytes(usize::try_from(length)?)?,
            None => Bytes::new(),
        };
        let over = measurement.line(line, &payload)?;
        let text = measurement.rates.take();
        if !text.out.is_empty() {
            output.write(&text.out)?;
        }
        eprint!("{}", text.err);
        match over {
            Ok(()) => {}
            Err(End::Idle) => break,
            Err(End::Refused(refused)) => return Err(user_error(refused)),
        }
    }
    Ok(measurement.code)
}

/// Measures from the lines of a stream.
struct Measurement<'a> {
    agent: &'a Agent,
    domain_id: u32,
    rates: Rates,
    notes: Notes<'a>,
    sieve: Option<MessageFilter<'a>>,
    code: ExitCode,
}

impl Measurement<'_> {
    /// Processes a line and the payload of a sample. Returns the reason if the measurement ends.
    fn line(&mut self, line: Line, payload: &Bytes) -> Result<Result<(), End>> {
        Ok(match line {
            Line::Open(open) => {
                let topics = open.topics.into_iter();
                let present: Vec<_> = topics.map(|topic| (topic.topic, topic.types)).collect();
                if present.is_empty() {
                    // A failed hint ends no measurement.
                    let _ = names_of(self.agent, self.domain_id);
                }
                self.rates.opened(&present)
            }
            Line::Sample(sample) => self.sample(&sample, payload)?,
            Line::Clock(clock) => {
                self.rates.clock(clock.time_ns);
                self.notes.now();
                Ok(())
            }
            Line::Missed(missed) => {
                if is_uncounted(missed.known_reason(), self.sieve.is_some()) {
                    self.notes.missed(&missed);
                }
                Ok(())
            }
            Line::End(end) => {
                self.rates.finish();
                let is_truncated = end.reason != END_OF_CAPTURE;
                if is_truncated && self.agent.outcome().is_none() {
                    return Ok(Err(End::Refused(Refused(format!("rp: {AGENT_ENDED}")))));
                }
                self.notes.end();
                if is_truncated {
                    // The rest of the capture cannot be read; the error is on stderr.
                    self.code = ExitCode::FAILURE;
                }
                Err(End::Idle)
            }
        })
    }

    fn sample(&mut self, sample: &Sample, payload: &Bytes) -> Result<Result<(), End>> {
        // Without a filter, `Rates` reports sampled topics.
        let is_reported = sample.sampled && self.sieve.is_some();
        self.notes.received(&sample.topic, is_reported);
        let arrival = Arrival {
            time: sample.time_ns,
            size: sample.size,
            header_stamp: sample.header_stamp_ns,
        };
        let passes = match &mut self.sieve {
            Some(sieve) => sieve.is_passed(sample, payload)?,
            None => true,
        };
        let types = std::slice::from_ref(&sample.message_type);
        let appeared = self.rates.appeared(&sample.topic, types);
        Ok(appeared.and_then(|()| match passes {
            false => Ok(()),
            // Whether unseen messages would pass the filter is unknown.
            true if self.sieve.is_none() => {
                let origin = Origin {
                    writer: &sample.writer,
                    number: sample.sequence_number,
                    source_timestamp: sample.source_timestamp_ns,
                    is_sampled: sample.sampled,
                };
                self.rates.arrived_from(&sample.topic, arrival, origin)
            }
            true => self.rates.add_message(&sample.topic, arrival),
        }))
    }
}

impl Topics {
    /// Returns the topics to measure; `None` for all topics.
    fn names(self, quantity: Quantity, dialect: Dialect) -> Result<Option<Vec<Named>>> {
        if self.all {
            if !self.names.is_empty() {
                let text = "Cannot specify both --all/-a and topic names";
                return Err(UserError(text.to_owned()).into());
            }
            return Ok(None);
        }
        if self.names.is_empty() {
            return Err(unnamed(quantity, dialect));
        }
        let named = self.names.into_iter().map(|typed| {
            let name = full_name(&typed)?;
            Ok(Named { typed, name })
        });
        let named: Result<_, Refused> = named.collect();
        named.map(Some).map_err(user_error)
    }
}

/// Returns whether messages that are missing for this reason are not counted. Without a filter,
/// messages count without their payloads.
const fn is_uncounted(reason: MissedReason, is_filtered: bool) -> bool {
    match reason {
        MissedReason::QueueFull | MissedReason::Unannounced => true,
        MissedReason::NotCaptured => is_filtered,
        // No subscriber received them.
        MissedReason::Incomplete | MissedReason::Lost => false,
    }
}

/// Returns the consequence of sampling for this quantity.
const fn sampled(quantity: Quantity, is_filtered: bool) -> &'static str {
    match quantity {
        _ if is_filtered => "unseen messages are not counted",
        Quantity::Rate | Quantity::Bandwidth => {
            "unseen messages are counted from sequence numbers and their times estimated"
        }
        Quantity::Delay => "unseen messages have no delay",
    }
}

fn user_error(refused: Refused) -> anyhow::Error {
    UserError(refused.0).into()
}

/// Returns ros2cli's message for a command without topics. It is a usage error in distributions
/// that accept only one topic.
fn unnamed(quantity: Quantity, dialect: Dialect) -> anyhow::Error {
    let several = match quantity {
        Quantity::Rate => dialect >= Dialect::Kilted,
        Quantity::Bandwidth => dialect >= Dialect::Rolling,
        Quantity::Delay => false,
    };
    let text = "Either specify topic names or use --all/-a option";
    if several {
        return UserError(text.to_owned()).into();
    }
    clap::Error::raw(ErrorKind::MissingRequiredArgument, format!("{text}\n")).exit()
}

fn positive(text: &str) -> Result<usize, UserError> {
    let value = text.parse().ok().filter(|value| *value > 0);
    value.ok_or_else(|| UserError("value must be a positive integer".to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_without_its_payload_counts_only_without_a_filter() {
        assert!(is_uncounted(MissedReason::NotCaptured, true));
        assert!(!is_uncounted(MissedReason::NotCaptured, false));
        for is_filtered in [true, false] {
            assert!(is_uncounted(MissedReason::QueueFull, is_filtered));
            assert!(!is_uncounted(MissedReason::Lost, is_filtered));
        }
        let counted = "unseen messages are counted from sequence numbers";
        assert!(sampled(Quantity::Rate, false).starts_with(counted));
        let filtered = sampled(Quantity::Rate, true);
        assert_eq!(filtered, "unseen messages are not counted");
    }
}
