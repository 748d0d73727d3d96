//! `rp log`: prints what nodes log.

use std::borrow::Cow;
use std::collections::HashSet;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use regex::bytes::Regex;
use ros2probe::client::{Agent, Target};
use ros2probe_api::logs::{LogMessage, Logs};
use ros2probe_daemon::escape::visible;
use ros2probe_model::facts::selection::expression;
use ros2probe_wire::log::{Log as Message, LogLevel, TYPE};

use super::follow::{StreamItem, StreamStatus, follow};
use super::notes::{NOT_ALL_PRINTED, Notes};
use super::{Output, UserError};

const ROSOUT_TOPIC: &str = "/rosout";

/// `rp log`.
#[derive(Args, Debug)]
pub(crate) struct Log {
    /// Only this node, and loggers below it, e.g. /robot1/lidar
    node: Option<String>,
    /// Only messages of this level and more severe ones
    #[arg(long, short = 'l', value_name = "LEVEL", default_value = LogLevel::Debug.label(),
        value_parser = LogLevel::ALL.map(LogLevel::label))]
    level: String,
    /// Only messages with a match of this regular expression in their text
    #[arg(long, short = 'g', value_name = "PATTERN")]
    grep: Option<String>,
    /// Number of earlier messages, of at most 1000 that the agent keeps
    #[arg(long, short = 'n', value_name = "N", default_value_t = 10,
        value_parser = clap::value_parser!(u16).range(0..=1000))]
    lines: u16,
    /// End after the earlier messages
    #[arg(long)]
    no_follow: bool,
    /// Print function, file and line as well
    #[arg(long, short = 'v')]
    verbose: bool,
    #[command(flatten)]
    target: Target,
}

/// A message to print.
struct Line<'a> {
    stamp: (i32, u32),
    level: Cow<'a, str>,
    logger: Cow<'a, str>,
    text: Cow<'a, str>,
    file: Cow<'a, str>,
    function: Cow<'a, str>,
    line: u32,
}

impl<'a> From<&'a LogMessage<'a>> for Line<'a> {
    fn from(message: &'a LogMessage<'a>) -> Self {
        Self {
            stamp: (message.stamp_sec, message.stamp_nanosec),
            level: Cow::Borrowed(&message.level),
            logger: Cow::Borrowed(&message.logger),
            text: Cow::Borrowed(&message.text),
            file: Cow::Borrowed(&message.file),
            function: Cow::Borrowed(&message.function),
            line: message.line,
        }
    }
}

impl<'a> From<&Message<'a>> for Line<'a> {
    fn from(message: &Message<'a>) -> Self {
        Self {
            stamp: message.stamp,
            level: message.level.label().into(),
            logger: String::from_utf8_lossy(message.logger),
            text: String::from_utf8_lossy(message.text),
            file: String::from_utf8_lossy(message.file),
            function: String::from_utf8_lossy(message.function),
            line: message.line,
        }
    }
}

/// Prints the messages that the command line selects.
struct Printer<'a> {
    command: &'a Log,
    pattern: Option<Regex>,
    output: Output,
    /// Writer and number of the messages that were printed as earlier ones.
    printed: HashSet<(String, u64)>,
}

impl Log {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let compile = |pattern| {
            let refused = format!("--grep: `{pattern}` is not a supported regular expression");
            expression(pattern).map_err(|_| UserError(refused))
        };
        let pattern = self.grep.as_deref().map(compile).transpose()?;
        let domain_id = self.target.domain()?;
        let agent = Agent::reach_stream(&self.target)?;
        let mut printer = Printer {
            command: &self,
            pattern,
            output: Output::new(),
            printed: HashSet::new(),
        };
        // A capture is read from its begin.
        let is_replay = self.target.replay.is_some();
        if self.no_follow && !is_replay {
            printer.print_kept(&agent, domain_id)?;
            return Ok(ExitCode::SUCCESS);
        }
        let names = [ROSOUT_TOPIC.to_owned()];
        let mut notes = Notes::begin(&agent, domain_id, is_replay, &names, NOT_ALL_PRINTED);
        let mut has_begun = is_replay;
        let status = follow(&agent, domain_id, &names, &mut notes, |item, _| {
            // The stream is open now, so no message is missing between both.
            if !std::mem::replace(&mut has_begun, true) {
                printer.print_kept(&agent, domain_id)?;
            }
            if let StreamItem::Message(sample, payload) = item
                && sample.message_type == TYPE
            {
                let known = (sample.writer.clone(), sample.sequence_number);
                if !printer.printed.remove(&known)
                    && let Ok(message) = Message::parse(&payload)
                {
                    printer.print(&Line::from(&message))?;
                }
            }
            Ok(StreamStatus::Open)
        })?;
        Ok(ExitCode::from(u8::from(
            status == StreamStatus::CaptureTruncated,
        )))
    }
}

impl Printer<'_> {
    /// Prints the latest messages that the agent keeps.
    fn print_kept(&mut self, agent: &Agent, domain_id: u32) -> Result<()> {
        let logs: Logs<'_> = agent.get(&format!("/logs?domain_id={domain_id}&limit=1000"))?;
        if !logs.is_on {
            eprintln!("rp: the agent keeps no logs: `robot.logs` is `off`");
        }
        let messages = logs.messages.iter().map(Line::from);
        let selected: Vec<_> = messages.filter(|line| self.selects(line)).collect();
        let count = usize::from(self.command.lines);
        for line in selected.iter().skip(selected.len().saturating_sub(count)) {
            self.write(line)?;
        }
        let printed = logs.messages.iter();
        self.printed = printed
            .map(|message| (message.writer.clone(), message.sequence_number))
            .collect();
        Ok(())
    }

    fn print(&mut self, line: &Line<'_>) -> Result<()> {
        match self.selects(line) {
            true => self.write(line),
            false => Ok(()),
        }
    }

    fn selects(&self, line: &Line<'_>) -> bool {
        let is_of_node = self.command.node.as_deref().is_none_or(|node| {
            let logger = node.trim_matches('/').replace('/', ".");
            let below = line.logger.strip_prefix(&logger);
            below.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        });
        let pattern = self.pattern.as_ref();
        // A level that only a newer agent knows passes.
        let level = LogLevel::named(&line.level).unwrap_or(LogLevel::Fatal);
        Some(level) >= LogLevel::named(&self.command.level)
            && is_of_node
            && pattern.is_none_or(|pattern| pattern.is_match(line.text.as_bytes()))
    }

    /// Prints a message as the console of ROS does.
    fn write(&mut self, line: &Line<'_>) -> Result<()> {
        let mut text = format!(
            "[{}] [{}.{:09}] [{}]: {}",
            visible(&line.level).to_uppercase(),
            line.stamp.0,
            line.stamp.1,
            visible(&line.logger),
            visible(&line.text)
        );
        if self.command.verbose {
            let place = format!(" ({}() at {}:{})", line.function, line.file, line.line);
            text.push_str(&visible(&place));
        }
        text.push('\n');
        Ok(self.output.write(&text)?)
    }
}
