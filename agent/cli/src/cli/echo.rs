//! `rp topic echo`: prints the messages of a topic.

use std::collections::BTreeSet;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Result;
use bytes::Bytes;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::ros2::Refused;
use ros2probe::ros2::echo::{self, FieldPath, Lost, mixed_offers};
use ros2probe::ros2::name::{full_name, full_type};
use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::latched::Latched;
use ros2probe_api::samples::Sample;
use ros2probe_api::topics::Topic;
use ros2probe_daemon::escape::visible_lines;
use ros2probe_message::filter::Filter;
use ros2probe_message::{Kind, TypeName};

use super::follow::{Printing, StreamItem, StreamStatus, Types, follow, for_stdout, topic};
use super::notes::{NOT_ALL_PRINTED, Notes};
use super::shared::{Matching, Spinning, names_of};
use super::{Output, UserError};

/// Moves the cursor home and clears the terminal.
const CLEAR_SCREEN: &str = "\x1b[H\x1b[2J\n";

/// `rp topic echo`.
#[derive(Args, Debug)]
#[command(after_help = "\
--filter takes an expression over `m`, the message (or the field that --field selects): m.pose.x > 1.5,
'error' in m.msg, len(m.ranges) == 0, 0 <= m.level < 3 and not m.done. It knows fields, [index],
numbers, strings, comparisons, in, and, or, not, + - * / // % **, lists, abs, all, any, bool, float,
int, len, max, min, str, sum, and for strings startswith, endswith, lower, upper.

rp does not subscribe, so it cannot request messages that were sent before. Of transient-local
publishers, it prints the last message first, which the agent keeps.

Examples:
  rp topic echo /chatter --once
  rp topic echo /odom --field pose.pose.position --filter 'm.x > 10'
  rp topic echo /points --replay robot.pcap --no-arr")]
pub(crate) struct Echo {
    /// Name of the topic, e.g. /chatter
    topic_name: String,
    /// Type of its messages, e.g. std_msgs/msg/String [default: the announced one]
    message_type: Option<String>,
    #[command(flatten)]
    printing: Printing,
    #[arg(
        long,
        value_name = "FIELD",
        help = "Print only this field of messages, as pose.pose.position or ranges.[0]; may be repeated"
    )]
    field: Vec<String>,
    /// Print the serialized message
    #[arg(long)]
    raw: bool,
    /// Print only messages for which this expression is true
    #[arg(long, value_name = "EXPR")]
    filter: Option<String>,
    /// Print one message, then end
    #[arg(long)]
    once: bool,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = parse_positive)]
    timeout: Option<f64>,
    /// Print times and sequence number before each message
    #[arg(long, short = 'i')]
    include_message_info: bool,
    /// Do not report lost messages
    #[arg(long)]
    no_lost_messages: bool,
    /// Accepted without effect: lost messages are reported anyway
    #[arg(long, hide = true)]
    lost_messages: bool,
    /// Clear the screen before each message
    #[arg(long, short = 'c')]
    clear: bool,
    /// Accepted without effect: there is no node
    #[arg(long, short = 'n', value_name = "NAME")]
    node_name: Option<String>,
    #[command(flatten)]
    matching: Matching,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

impl Echo {
    pub(crate) fn run(mut self) -> Result<ExitCode> {
        let options = self.options()?;
        let name = full_name(&self.topic_name).map_err(user_error)?;
        if self.lost_messages {
            eprintln!(
                "WARNING: '--lost-messages' is deprecated; lost messages are reported by default"
            );
        }
        if let Some(typed) = self.message_type.take() {
            let message_type = full_type(&typed, Kind::Message);
            let known: Result<TypeName, _> = message_type.parse();
            known.map_err(|_| UserError("The passed message type is invalid".to_owned()))?;
            self.message_type = Some(message_type);
        }
        let domain_id = self.target.domain()?;
        let agent = Agent::reach_stream(&self.target)?;
        let types = Types::new(self.printing.library(&self.target), &agent, domain_id);
        let mut output = Output::new();

        // A capture's topics are complete only after its end.
        let is_waiting = self.target.replay.is_some();
        let known = topic(&agent, domain_id, &name)?;
        let expected = match &known {
            Some(known) => {
                if !self.matching.any() {
                    output.write(&mixed_offers(&known.publishers))?;
                }
                self.expected_type(known)?
            }
            None if self.message_type.is_none() && !is_waiting => {
                return self.unknown_type(&agent, domain_id, &mut output);
            }
            None => self.message_type.clone(),
        };
        if let Some(expected) = expected.as_deref().filter(|_| !options.raw) {
            let publishers = known.as_ref().map(|known| known.publishers.as_slice());
            let publisher = publishers.and_then(|publishers| publishers.first());
            let hash = publisher.and_then(|publisher| publisher.definition_hash());
            types.find_for(&name, expected, hash)?;
        }
        if let Some(known) = &known {
            print_silence_reason(&name, known, expected.as_deref());
        }
        let names = std::slice::from_ref(&name);
        let mut notes = Notes::begin(&agent, domain_id, is_waiting, names, NOT_ALL_PRINTED);
        let mut printer = Printer {
            command: &self,
            agent: &agent,
            domain_id,
            name: &name,
            is_raw: options.raw,
            types,
            echo: echo::Echo::new(options),
            lost: Lost::default(),
            output,
            expected,
            is_known: known.is_some(),
            timer: Timer {
                is_replay: is_waiting,
                start: None,
            },
            is_seen: false,
        };
        let status = follow(&agent, domain_id, names, &mut notes, |item, now| {
            printer.print(item, now)
        })?;
        printer.finish(status)
    }

    fn options(&self) -> Result<echo::Options> {
        let filter = self.filter.as_deref().map(Filter::parse).transpose();
        let fields = self.field.iter().map(|field| field.parse());
        Ok(echo::Options {
            dialect: self.target.dialect(),
            csv: self.printing.csv,
            style: self.printing.style(),
            shown: self.printing.truncation(),
            raw: self.raw,
            fields: fields
                .collect::<Result<Vec<FieldPath>, _>>()
                .map_err(user_error)?,
            filter: filter.map_err(|error| UserError(error.to_string()))?,
            include_info: self.include_message_info,
        })
    }

    /// Returns the name of the expected type. Fails if the topic has several types and the command
    /// line names none.
    fn expected_type(&self, known: &Topic<'_>) -> Result<Option<String>> {
        if self.message_type.is_some() {
            return Ok(self.message_type.clone());
        }
        match known.message_types.as_slice() {
            [] => Ok(None),
            [one] => Ok(Some(one.to_string())),
            several => {
                let text = format!(
                    "Cannot echo topic '{}', as it contains more than one type: [{}]",
                    self.topic_name,
                    several.join(", ")
                );
                Err(UserError(text).into())
            }
        }
    }

    fn unknown_type(&self, agent: &Agent, domain_id: u32, output: &mut Output) -> Result<ExitCode> {
        output.write(&format!(
            "WARNING: topic [{}] does not appear to be published yet\n",
            self.topic_name
        ))?;
        names_of(agent, domain_id)?;
        let text = "Could not determine the type for the passed topic";
        Err(UserError(text.to_owned()).into())
    }
}

/// Prints the items of a stream.
struct Printer<'a> {
    command: &'a Echo,
    agent: &'a Agent,
    domain_id: u32,
    name: &'a str,
    is_raw: bool,
    types: Types<'a>,
    echo: echo::Echo,
    lost: Lost,
    output: Output,
    /// Expected type of the messages.
    expected: Option<String>,
    /// Whether the topic was known before its first message.
    is_known: bool,
    timer: Timer,
    is_seen: bool,
}

/// Time since the first item of a stream.
struct Timer {
    is_replay: bool,
    /// Time of the first item, here and by its stream in nanoseconds.
    start: Option<(Instant, i64)>,
}

impl Timer {
    /// Returns the seconds until an item of this time. A capture has its own time. The clock of a
    /// live agent may be set, so it does not count.
    fn seconds(&mut self, now: i64) -> f64 {
        let start = || (Instant::now(), now);
        let (begun, first) = *self.start.get_or_insert_with(start);
        match self.is_replay {
            true => elapsed(first, now),
            false => begun.elapsed().as_secs_f64(),
        }
    }
}

impl Printer<'_> {
    fn print(&mut self, item: StreamItem<'_>, now: i64) -> Result<StreamStatus> {
        let seconds = self.timer.seconds(now);
        let mut is_enough = false;
        match item {
            StreamItem::Clock => {}
            StreamItem::Missed(missed) => {
                let text = self.lost.missed(missed);
                if !text.is_empty() && !self.command.no_lost_messages {
                    self.output.write(&text)?;
                }
            }
            StreamItem::Message(sample, payload) => {
                is_enough = self.message(sample, &payload)? && self.command.once;
            }
        }
        let timeout = self.command.timeout;
        is_enough |= timeout.is_some_and(|timeout| seconds >= timeout);
        Ok(if is_enough {
            StreamStatus::Stopped
        } else {
            StreamStatus::Open
        })
    }

    /// Prints a message of the expected type. Returns whether it was printed.
    fn message(&mut self, sample: &Sample, payload: &Bytes) -> Result<bool> {
        if self.is_unknown()
            && let Some(known) = topic(self.agent, self.domain_id, self.name)?
        {
            self.expected = self.command.expected_type(&known)?;
        }
        self.is_seen = true;
        let wanted = self
            .command
            .message_type
            .as_ref()
            .or(self.expected.as_ref());
        if wanted.is_some_and(|wanted| *wanted != sample.message_type) {
            return Ok(false);
        }
        let message_type = if self.is_raw {
            None
        } else {
            self.types.of(sample)
        };
        let text = self.echo.message(sample, message_type.as_deref(), payload);
        let text = text.map_err(user_error)?;
        eprint!("{}", visible_lines(&text.err));
        let Some(message) = text.out else {
            return Ok(false);
        };
        if self.command.clear {
            self.output.write(CLEAR_SCREEN)?;
        }
        self.output.write(&for_stdout(message))?;
        Ok(true)
    }

    /// Returns whether the topic's type is still unknown.
    const fn is_unknown(&self) -> bool {
        !self.is_seen && !self.is_known && self.command.message_type.is_none()
    }

    fn finish(mut self, status: StreamStatus) -> Result<ExitCode> {
        let is_truncated = status == StreamStatus::CaptureTruncated;
        let is_over = is_truncated || status == StreamStatus::CaptureEnded;
        if is_over && self.is_unknown() {
            let command = self.command;
            match topic(self.agent, self.domain_id, self.name)? {
                Some(known) => drop(command.expected_type(&known)?),
                None => return command.unknown_type(self.agent, self.domain_id, &mut self.output),
            }
        }
        if self.echo.unreadable() > 1 {
            eprintln!("rp: {} messages could not be read", self.echo.unreadable());
        }
        Ok(ExitCode::from(u8::from(is_truncated)))
    }
}

/// Prints the likely reason for silence.
fn print_silence_reason(name: &str, known: &Topic<'_>, expected: Option<&str>) {
    let types = &known.message_types;
    if let Some(expected) = expected
        && !types.is_empty()
        && types.iter().all(|other| other != expected)
    {
        eprintln!("rp: {name} carries {}, not {expected}", types.join(", "));
    }
    for missing in missing_latched_reasons(name, &known.publishers) {
        eprintln!("rp: {}", visible_lines(&missing));
    }
}

/// Returns why earlier messages of latched publishers are not printed.
fn missing_latched_reasons(name: &str, publishers: &[Endpoint<'_>]) -> BTreeSet<String> {
    let latched = publishers
        .iter()
        .filter(|one| one.qos.durability == "TRANSIENT_LOCAL");
    let missing = latched.filter_map(|one| Latched::missing(one.latched.as_ref(), name));
    missing.collect()
}

#[expect(clippy::cast_precision_loss, reason = "microseconds survive")]
fn elapsed(start: i64, now: i64) -> f64 {
    now.saturating_sub(start) as f64 / 1e9
}

fn parse_positive(text: &str) -> Result<f64, UserError> {
    let value = text
        .parse()
        .ok()
        .filter(|value: &f64| *value > 0.0 && value.is_finite());
    value.ok_or_else(|| UserError("value must be a positive number".to_owned()))
}

fn user_error(refused: Refused) -> anyhow::Error {
    UserError(refused.0).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_of_a_live_agents_clock_ends_no_timeout() {
        const HOUR: i64 = 3_600_000_000_000;
        for step in [HOUR, -HOUR] {
            let timer = |is_replay| Timer {
                is_replay,
                start: None,
            };
            let mut live = timer(false);
            assert!(live.seconds(0) < 1800.0);
            assert!((0.0..1800.0).contains(&live.seconds(step)), "{step}");
            let mut replayed = timer(true);
            assert_eq!(replayed.seconds(step), 0.0);
            assert_eq!(replayed.seconds(step + HOUR), 3600.0);
        }
        // Time passes also while the clock does not.
        let mut live = Timer {
            is_replay: false,
            start: Instant::now()
                .checked_sub(std::time::Duration::from_secs(2))
                .map(|begun| (begun, HOUR)),
        };
        assert!(live.seconds(0) >= 2.0);
    }
}
