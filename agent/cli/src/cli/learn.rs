//! `rp learn`: watches a healthy robot, or replays a capture of one, and writes a watchlist.
//!
//! A live agent measures the topics as long as the stream of their messages is open. A capture is
//! replayed second by second.

mod file;

use std::io::{IsTerminal as _, stderr};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use clap::Args;
use jiff::{Timestamp, Unit};
use ros2probe::client::{Agent, Lines, Next, Target};
use ros2probe::learn::watchlist::{Source, is_expected, parameters, text};
use ros2probe::learn::{Learner, Learnt, MAX_SECONDS, Request, Selection};
use ros2probe_api::health::Health;
use ros2probe_api::parameters::Parameters;
use ros2probe_api::path::encoded;
use ros2probe_api::topics::TopicList;
use ros2probe_daemon::run::CaptureTime;

use super::follow::AGENT_ENDED;
use super::shared::names_of;
use super::{Output, UserError};
use file::Destination;

/// Interval between two views of the topics.
const VIEW_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum wait for a line before the flag of Ctrl-C is checked.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Size of the stream's queue, in bytes. The stream's lines are discarded.
const QUEUE_BYTES: usize = 64 << 10;
const MAX_MINUTES: u16 = (MAX_SECONDS / 60) as u16;

/// `rp learn`.
#[derive(Args, Debug)]
#[command(after_help = "\
The file is a configuration with one watch for each topic. A comment at each value names the
statistic that it comes from, or why an expectation is left out. Check it with `rp check-config`,
and move its entries to the agent's configuration.")]
pub(crate) struct Learn {
    /// Topics to learn, e.g. /imu, or globs, e.g. /camera/** [default: all topics]
    #[arg(value_name = "TOPIC|GLOB")]
    topics: Vec<String>,
    /// Minutes to watch [default: 10; of a capture, all up to 120]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=i64::from(MAX_MINUTES)))]
    minutes: Option<u16>,
    /// File to write; `-` is standard output
    #[arg(long, short = 'o', value_name = "FILE", default_value = "-")]
    output: Destination,
    /// Write the last known values of parameters, too; other values are findings later
    #[arg(long)]
    parameters: bool,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    target: Target,
}

impl Learn {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let selection = Selection::new(&self.topics)
            .map_err(|(typed, error)| UserError(format!("rp: the topic `{typed}` {error}")))?;
        let domain_id = self.target.domain()?;
        self.output.check(self.force)?;
        let is_replay = self.target.replay.is_some();
        let default = if is_replay { MAX_MINUTES } else { 10 };
        let is_whole = is_replay && self.minutes.is_none();
        let mut session = Session {
            domain_id,
            seconds: 60 * u32::from(self.minutes.unwrap_or(default)),
            is_hidden: !selection.patterns().is_empty(),
            query: query(&selection),
            learner: Learner::new(selection),
            begin: None,
            stop: super::interrupt::flag().context("cannot handle signals")?,
            progress: Progress::new(is_whole),
        };
        let agent = if is_replay {
            Agent::reach_steps(&self.target)
        } else {
            Agent::reach(&self.target)
        }?;
        let learnt = if is_replay {
            session.replay(&agent)
        } else {
            session.live(&agent)
        };
        session.progress.clear();
        learnt?;
        let (mut text, learnt) = session.finish(&agent)?;
        // Minutes of learning are not lost if the parameters fail.
        let known = self
            .parameters
            .then(|| agent.get::<Parameters<'_>>("/parameters"));
        if let Some(Ok(known)) = &known {
            text.push_str(&parameters(known, domain_id));
        }
        self.output.write(&text, self.force)?;
        session.report(&learnt, &self.output);
        if let Some(Err(error)) = known {
            return Err(anyhow::Error::from(error).context("the file lacks the parameters"));
        }
        let is_truncated = agent
            .outcome()
            .is_some_and(|outcome| outcome.fault.is_some());
        Ok(if is_truncated {
            // The rest of the capture cannot be read; the error is on stderr.
            ExitCode::FAILURE
        } else {
            ExitCode::SUCCESS
        })
    }
}

/// One run of the command.
struct Session {
    domain_id: u32,
    /// Time to learn, in seconds.
    seconds: u32,
    /// Whether hidden topics can be selected.
    is_hidden: bool,
    /// Selection of topics in the syntax of `/samples`.
    query: String,
    learner: Learner,
    /// Begin of a live session; `None` if views have the times of a capture.
    begin: Option<Instant>,
    stop: Arc<AtomicBool>,
    progress: Progress,
}

impl Session {
    /// Views the topics of a live agent. The stream keeps them measured; its lines are discarded.
    fn live(&mut self, agent: &Agent) -> Result<()> {
        let (query, domain_id) = (&self.query, self.domain_id);
        let path = format!("/samples?{query}&domain_id={domain_id}&queue_bytes={QUEUE_BYTES}");
        let mut lines = agent.stream(&path)?;
        // A replay has the times of its capture, at any speed.
        let health = agent.get::<Health>("/health");
        let is_replay = health.is_ok_and(|health| health.source == "replay");
        self.begin = (!is_replay).then(Instant::now);
        self.view_until_end(&mut lines, agent)?;
        let begin = Instant::now();
        let end = begin + Duration::from_secs(self.seconds.into());
        let mut due = begin + VIEW_INTERVAL;
        let mut is_explained = false;
        while !self.is_finished(Instant::now() >= end) {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                self.view_until_end(&mut lines, agent)?;
                due += VIEW_INTERVAL;
                if !std::mem::replace(&mut is_explained, true) {
                    self.print_unseen_reason();
                }
                continue;
            }
            match lines.line_within(left.min(POLL_INTERVAL))? {
                Next::Line(line) if !is_end(&line) => {}
                Next::Nothing => {}
                Next::Line(_) | Next::End => return Err(agent_ended().into()),
            }
        }
        Ok(())
    }

    /// Polls the topics. An error shortly before the event stream ends counts as the end of the
    /// agent.
    fn view_until_end(&mut self, lines: &mut Lines<'_>, agent: &Agent) -> Result<()> {
        let viewed = self.view(agent);
        match viewed {
            Err(_) if ends_within_a_second(lines) => Err(agent_ended().into()),
            viewed => viewed,
        }
    }

    /// Views the topics at each whole second of a capture.
    fn replay(&mut self, agent: &Agent) -> Result<()> {
        self.view(agent)?;
        let Some(begin) = self.learner.latest() else {
            return Ok(());
        };
        let mut next = begin.floor() + 1.0;
        while !self.is_finished(self.learner.seconds() >= self.seconds) {
            let time: Result<CaptureTime, _> = format!("{next:.0}").parse();
            let Ok(time) = time else { break };
            if !agent.advance(time) {
                break;
            }
            self.view(agent)?;
            next += 1.0;
        }
        Ok(())
    }

    fn is_finished(&self, is_complete: bool) -> bool {
        is_complete || self.stop.load(Ordering::Relaxed)
    }

    fn view(&mut self, agent: &Agent) -> Result<()> {
        let (domain_id, hidden) = (self.domain_id, self.is_hidden);
        let path = format!("/topics?domain_id={domain_id}&hidden={hidden}");
        let begin = self.begin;
        let seconds = || begin.map(|begin| begin.elapsed().as_secs_f64());
        let sent = seconds();
        let list: TopicList<'_> = agent.get(&path)?;
        let request = sent
            .zip(seconds())
            .map(|(sent, answered)| Request { sent, answered });
        self.learner.observe(&list, request);
        self.progress.show(&self.learner, self.seconds);
        Ok(())
    }

    fn print_unseen_reason(&mut self) {
        let unseen: Vec<_> = self.learner.unseen().collect();
        if !unseen.is_empty() {
            let unseen = unseen.join(", ");
            self.progress.clear();
            eprintln!("rp: no topic matches {unseen} yet");
        }
    }

    /// Returns the text of the watchlist.
    fn finish(&self, agent: &Agent) -> Result<(String, Learnt)> {
        let names = names_of(agent, self.domain_id)?;
        let nothing = |why: String| UserError(format!("rp: {why}; nothing is written"));
        let unseen: Vec<_> = self.learner.unseen().collect();
        if !unseen.is_empty() {
            eprintln!("rp: no topic matches {}", unseen.join(", "));
        }
        let learnt = self
            .learner
            .finish()
            .filter(|learnt| !learnt.topics.is_empty());
        let learnt = learnt.ok_or_else(|| nothing("no topic was seen".to_owned()))?;
        if !learnt.topics.iter().any(is_expected) {
            let seconds = self.learner.seconds();
            let why = format!("{seconds} s were too few to learn any expectation");
            return Err(nothing(why).into());
        }
        let (from, to) = learnt.period;
        let place = agent.place();
        let text = text(
            &learnt,
            &Source {
                place: &place,
                domain_id: self.domain_id,
                names_domain: names.domains.len() > 1,
                period: (&time(from), &time(to)),
                seconds: self.learner.seconds(),
            },
        );
        Ok((text, learnt))
    }

    fn report(&self, learnt: &Learnt, output: &Destination) {
        let expected = learnt.topics.iter().filter(|it| is_expected(it)).count();
        let all = learnt.topics.len();
        let seconds = self.learner.seconds();
        eprintln!(
            "rp: expectations for {expected} of {all} topics, learnt in {seconds} s{}",
            output.result_text()
        );
    }
}

fn agent_ended() -> UserError {
    UserError(format!("rp: {AGENT_ENDED}; nothing is written"))
}

fn is_end(line: &[u8]) -> bool {
    line.starts_with(br#"{"end""#)
}

/// Returns whether the stream ends within a second.
fn ends_within_a_second(lines: &mut Lines<'_>) -> bool {
    let deadline = Instant::now() + Duration::from_secs(1);
    while let Some(left) = deadline.checked_duration_since(Instant::now()) {
        match lines.line_within(left) {
            Ok(Next::Line(line)) if !is_end(&line) => {}
            Ok(Next::Nothing) => return false,
            Ok(Next::Line(_) | Next::End) | Err(_) => return true,
        }
    }
    false
}

/// Returns the selection in the syntax of `/samples`.
fn query(selection: &Selection) -> String {
    if selection.patterns().is_empty() {
        return "all=true".to_owned();
    }
    let names: Vec<_> = selection.patterns().iter().map(|it| encoded(it)).collect();
    format!("topic={}", names.join(","))
}

/// Returns a time in UTC, to the second.
fn time(seconds: f64) -> String {
    let duration = Duration::try_from_secs_f64(seconds).unwrap_or_default();
    let time = jiff::SignedDuration::try_from(duration).ok();
    let time = time.and_then(|time| Timestamp::from_duration(time).ok());
    let time = time.and_then(|time| time.round(Unit::Second).ok());
    time.map_or_else(String::new, |time| time.to_string())
}

/// A line on stderr that is updated in place; nothing if stderr is not a terminal.
struct Progress {
    is_visible: bool,
    /// Whether the command ends with a capture, at an unknown time.
    is_of_capture: bool,
}

impl Progress {
    fn new(is_whole: bool) -> Self {
        Self {
            is_visible: stderr().is_terminal(),
            is_of_capture: is_whole,
        }
    }

    fn show(&self, learner: &Learner, seconds: u32) {
        if self.is_visible {
            let (topics, now) = (learner.topics(), learner.seconds());
            let all = match self.is_of_capture {
                true => "the capture".to_owned(),
                false => format!("{}:{:02}", seconds / 60, seconds % 60),
            };
            let (minutes, now) = (now / 60, now % 60);
            eprint!(
                "\rlearning {topics} topics: {minutes}:{now:02} of {all}; Ctrl-C ends early\x1b[K"
            );
        }
    }

    fn clear(&self) {
        if self.is_visible {
            eprint!("\r\x1b[K");
        }
    }
}
