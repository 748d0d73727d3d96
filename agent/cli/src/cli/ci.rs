//! `rp ci`: runs a command, observes the robot until the command ends, and judges it.
//!
//! The agent is a child process, because it gives up rights that this program needs. So is the
//! guard, which runs the command and ends it if this program is killed.

mod agent_process;
mod artefacts;
mod guard;

use std::ffi::OsString;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, ExitCode};
use std::str::FromStr;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result};
use clap::{Args, ValueEnum};
use ros2probe::ci::{self, Condition, FailOn, Observation, Rules, Run, Verdict, judge};
use ros2probe::client::{Agent, Lines, Next, Target};
use ros2probe_api::MAX_DOMAIN_ID;
use ros2probe_api::health::Health;
use ros2probe_api::live::Line;
use ros2probe_api::watches::WatchList;
use ros2probe_daemon::config::Config;
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::privilege;
use rustix::process::Signal;

use agent_process::AgentProcess;
use artefacts::Artefacts;

use super::{UserError, interrupt};

pub(crate) use guard::CannotStart;

/// Exit code if the command succeeded and a condition failed.
pub(crate) const CONDITION_FAILED: u8 = 79;
/// Maximum wait for a line before signals and the command are checked.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Maximum wait for the state after the end of the command.
const LAST_STATE_TIMEOUT: Duration = Duration::from_millis(1500);
/// Interval between two lines of progress.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(30);

/// `rp ci`.
#[derive(Args, Debug)]
#[command(after_help = "\
The first seconds (--settle) and the shutdown are not judged. The shutdown begins when a participant
leaves within the last seconds of the run (--shutdown), or with SIGINT or SIGTERM to rp ci, which
the command receives, too. A run fails that saw no participant, or that was too short to judge. If
the agent missed a part of the run, because a buffer or a limit was full, that is a warning, or a
failure with --strict.

Files in the output directory: junit.xml, report.html, bag/ and agent.log.

Exit codes: the command's own if it is not 0 (128 and the signal that ended it), 79 if a condition
failed, 126 or 127 if the command cannot be started, 77 a capability is missing, 78 the watchlist is
invalid, 1 otherwise.

Examples:
  sudo -E rp ci -- ros2 launch my_robot test.launch.py
  rp ci --expect watchlist.yaml --fail-on warning -- ./drive_test.sh
  rp ci --max-lost 10 --settle 15 -o results -- timeout -s INT 60 ros2 launch my_robot robot.launch.py")]
pub(crate) struct Ci {
    /// Watchlist whose expectations must hold; `rp learn` writes one
    #[arg(long, value_name = "FILE")]
    expect: Option<PathBuf>,
    /// Least severity of a finding that fails
    #[arg(long, value_name = "SEVERITY", value_enum, default_value = "error")]
    fail_on: Severity,
    /// Messages that the worst subscriber of each topic may lose, or `any`. `max_loss_ratio` of the
    /// watchlist replaces it for its topics
    #[arg(long, value_name = "N|any", default_value = "0")]
    max_lost: MaxLost,
    /// Fail if the agent missed a part of the run, instead of a warning
    #[arg(long)]
    strict: bool,
    /// Seconds after the start of the command that are not judged
    #[arg(long, value_name = "SECONDS", default_value_t = 5, value_parser = clap::value_parser!(u32).range(..=3600))]
    settle: u32,
    /// Maximum length of the robot's shutdown in seconds; 0 judges up to the end
    #[arg(long, value_name = "SECONDS", default_value_t = 10, value_parser = clap::value_parser!(u32).range(..=600))]
    shutdown: u32,
    /// Directory of the files; those of an earlier run are replaced
    #[arg(long, short = 'o', value_name = "DIR", default_value = "ros2probe-ci")]
    output: PathBuf,
    /// Record no bag. A bag has at most 256 MiB, or `recordings.max_bytes` of the watchlist
    #[arg(long)]
    no_bag: bool,
    /// Serve the page at this address of this host during the run, e.g. 127.0.0.1:17411; port 0
    /// chooses a free one
    #[arg(long, value_name = "ADDR", value_parser = loopback)]
    page: Option<SocketAddr>,
    /// The robot's domain [default: $ROS_DOMAIN_ID, else 0]
    #[arg(long = "domain", value_name = "N",
        value_parser = clap::value_parser!(u32).range(..=i64::from(MAX_DOMAIN_ID)))]
    domain_id: Option<u32>,
    /// Run the command for the process with this id
    #[arg(long, hide = true, value_name = "PID")]
    guard: Option<i32>,
    /// Command with its arguments
    #[arg(last = true, required = true, value_name = "COMMAND")]
    command: Vec<OsString>,
}

/// Values of `--fail-on`.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Severity {
    /// Errors fail.
    Error,
    /// Errors and warnings fail.
    Warning,
    /// No finding fails.
    None,
}

/// Value of `--max-lost`.
#[derive(Clone, Copy, Debug)]
struct MaxLost(Option<u64>);

impl FromStr for MaxLost {
    type Err = std::num::ParseIntError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(Self(match text {
            "any" => None,
            number => Some(number.parse()?),
        }))
    }
}

impl Ci {
    pub(crate) fn run(self) -> Result<ExitCode> {
        if let Some(parent) = self.guard {
            return guard::run(parent, &self.command);
        }
        guard::find(&self.command)?;
        let target = Target {
            domain_id: self.domain_id,
            ..Target::default()
        };
        let domain_id = target.domain()?;
        let config = self.expect.as_deref().map(Config::load).transpose()?;
        privilege::check(&config.unwrap_or_default().capture)?;
        if let Some(address) = self.page {
            // The agent binds it later, but its error names other options.
            TcpListener::bind(address)
                .with_context(|| format!("cannot serve the page at {address}"))?;
        }
        let artefacts = Artefacts::create(&self.output)?;
        let signals = interrupt::signals().context("cannot handle signals")?;
        let expect = self.expect.as_deref();
        let mut process = AgentProcess::start(expect, domain_id, self.page, &artefacts)?;
        let Some(agent) = process.wait_ready(&signals)? else {
            return Ok(ExitCode::from(guard::of_signal(Signal::INT)));
        };
        if !self.no_bag {
            process.record(&agent, domain_id)?;
        }
        if let Some(address) = process.page(&agent)? {
            print(&format!("the page is at {address} during the run"));
        }
        let rules = Rules {
            settle: self.settle.into(),
            shutdown: self.shutdown.into(),
            fail_on: match self.fail_on {
                Severity::Error => FailOn::Error,
                Severity::Warning => FailOn::Warning,
                Severity::None => FailOn::None,
            },
            max_lost: self.max_lost.0,
            is_strict: self.strict,
        };
        let mut session = Session::start(rules, domain_id, &self.command)?;
        session.observe(&agent, &mut process, &signals)?;
        let bag = process.bag(&agent, self.no_bag);
        process.end()?;
        let bag = artefacts.keep_bag(&process.recording(), bag);
        // Without its bag, a run still has a verdict.
        let bag = bag.unwrap_or_else(|error| {
            let error = format!("{error:#}");
            print(&error);
            format!("not kept: {error}")
        });
        let Session { seen, run, .. } = session;
        let conditions = judge(&run, &seen);
        artefacts.write(
            &ci::junit::text(&run, &conditions)?,
            &ci::report::html(&run, &conditions, &seen, &bag),
        )?;
        Ok(report(&run, &conditions, &self.output))
    }
}

/// Reads the value of `--page`. Another host would need a token.
fn loopback(text: &str) -> Result<SocketAddr, UserError> {
    let address = text.parse::<SocketAddr>().ok();
    let address = address.filter(|address| address.ip().is_loopback());
    address.ok_or_else(|| {
        UserError("must be a loopback address with a port, as 127.0.0.1:17411".to_owned())
    })
}

/// Prints a line for each condition, and returns the exit code.
fn report(run: &Run, conditions: &[Condition], output: &Path) -> ExitCode {
    for each in conditions {
        let first = each.detail.lines().next().unwrap_or_default();
        let (verdict, group) = (each.verdict.name(), each.group.name());
        print(&format!("{verdict:<10} {group:<12} {}: {first}", each.name));
    }
    let failed = conditions.iter().filter(|it| it.verdict == Verdict::Failed);
    let warned = conditions.iter().filter(|it| it.verdict == Verdict::Warned);
    let (failed, all) = (failed.count(), conditions.len());
    let warnings = match warned.count() {
        0 => "",
        _ => ", with a warning: the agent missed a part of the run",
    };
    let place = output.join("report.html");
    print(&format!(
        "{failed} of {all} conditions failed{warnings}; the report is {}",
        place.display()
    ));
    match (run.code, failed) {
        (0, 0) => ExitCode::SUCCESS,
        (0, _) => ExitCode::from(CONDITION_FAILED),
        (code, _) => ExitCode::from(code),
    }
}

/// Prints a line on stderr, because stdout belongs to the command.
fn print(line: &str) {
    eprintln!("rp ci: {}", visible(line));
}

/// A run of the command.
struct Session {
    seen: Observation,
    run: Run,
    began: Instant,
    guard: Child,
    /// Whether the command has ended.
    is_over: bool,
    next_progress: Duration,
}

/// How a stream of the agent ended.
enum Ended {
    /// The command has ended.
    Command,
    /// The stream broke.
    Stream(String),
}

impl Session {
    fn start(rules: Rules, domain_id: u32, command: &[OsString]) -> Result<Self> {
        let words = command
            .iter()
            .map(|word| visible(&word.to_string_lossy()).into_owned());
        let words: Vec<_> = words.collect();
        let began = SystemTime::now().duration_since(UNIX_EPOCH);
        Ok(Self {
            seen: Observation::new(rules, domain_id),
            run: Run {
                command: words.join(" "),
                began: began.unwrap_or_default().as_secs_f64(),
                domain_id,
                ..Run::default()
            },
            guard: guard::start(command)?,
            began: Instant::now(),
            is_over: false,
            next_progress: PROGRESS_INTERVAL,
        })
    }

    fn now(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    /// Observes the robot until the command ends, also without an agent.
    fn observe(
        &mut self,
        agent: &Agent,
        process: &mut AgentProcess,
        signals: &Receiver<Signal>,
    ) -> Result<()> {
        loop {
            let ended = match agent.stream("/live") {
                Ok(mut lines) => self.follow(agent, &mut lines, signals)?,
                Err(error) => Ended::Stream(error.to_string()),
            };
            let (reason, is_broken) = match ended {
                Ended::Command => ("the agent ended".to_owned(), false),
                Ended::Stream(reason) => (reason, true),
            };
            let is_over = self.has_ended(signals)?;
            let deadline = Instant::now() + LAST_STATE_TIMEOUT;
            // The kernel closes the sockets of a killed agent before its end can be seen.
            while is_over && is_broken && !process.has_ended() && Instant::now() < deadline {
                std::thread::sleep(POLL_INTERVAL);
            }
            if process.has_ended() {
                let reason = process.reason().unwrap_or(reason);
                print(&format!("the agent has ended: {reason}"));
                self.run.agent_ended = Some((self.now(), reason));
                break;
            }
            if is_over {
                return Ok(());
            }
            // The agent of a busy machine may answer late.
            self.seen.restart();
            std::thread::sleep(POLL_INTERVAL);
        }
        while !self.has_ended(signals)? {
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(())
    }

    fn follow(
        &mut self,
        agent: &Agent,
        lines: &mut Lines<'_>,
        signals: &Receiver<Signal>,
    ) -> Result<Ended> {
        let mut deadline = None;
        loop {
            if deadline.is_none() && self.has_ended(signals)? {
                deadline = Some(Instant::now() + LAST_STATE_TIMEOUT);
            }
            if deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                return Ok(Ended::Command);
            }
            let line = match lines.line_within(POLL_INTERVAL) {
                Ok(Next::Line(line)) => line,
                Ok(Next::Nothing) => continue,
                Ok(Next::End) => return Ok(Ended::Stream("the agent ended".to_owned())),
                Err(error) => return Ok(Ended::Stream(error.to_string())),
            };
            let Ok(line) = serde_json::from_slice::<Line<'static>>(&line) else {
                continue;
            };
            let now = match deadline {
                Some(_) => self.run.seconds,
                None => self.now(),
            };
            if !self.seen.line(line, now) {
                continue;
            }
            if let Ok(list) = agent.get::<WatchList>("/watch") {
                self.seen.watches(&list, now);
            }
            if let Ok(health) = agent.get::<Health>("/health") {
                self.seen.health(&health);
            }
            self.report_progress(now);
            if deadline.is_some() {
                return Ok(Ended::Command);
            }
        }
    }

    fn report_progress(&mut self, now: f64) {
        for found in self.seen.new_findings(now) {
            print(&format!("{now:.0} s: {}", found.text));
        }
        if self.began.elapsed() >= self.next_progress {
            self.next_progress += PROGRESS_INTERVAL;
            let (nodes, topics) = (self.seen.nodes.len(), self.seen.topics.len());
            let lost: u64 = self.seen.topics.values().map(|it| it.lost.total()).sum();
            print(&format!(
                "{now:.0} s: {nodes} nodes, {topics} topics, {lost} messages lost"
            ));
        }
    }

    /// Forwards signals to the command, and returns whether it has ended.
    fn has_ended(&mut self, signals: &Receiver<Signal>) -> Result<bool> {
        while let Ok(signal) = signals.try_recv() {
            let now = self.now();
            self.run.signalled.get_or_insert(now);
            guard::forward(&self.guard, signal);
        }
        let Some(status) = self
            .guard
            .try_wait()
            .context("cannot wait for the command")?
        else {
            return Ok(false);
        };
        self.run.code = guard::code(status);
        if !self.is_over {
            self.run.seconds = self.now();
        }
        self.is_over = true;
        Ok(true)
    }
}
