//! `rp ship`.

use std::io::{IsTerminal as _, Write as _, stderr};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::fleet::size;
use ros2probe_daemon::agent::DEFAULT_CONFIG;
use ros2probe_daemon::config::{Config, SocketChoice};
use ros2probe_daemon::escape::visible_lines;
use ros2probe_daemon::logging::Log;
use ros2probe_daemon::ship;
use ros2probe_ship::{Findings, Observer, ShipError, Shipper, Status, Uploading};
use serde_json::Value;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

use super::Output;

/// Maximum number of findings in a manifest, the first ones.
const MAX_FINDINGS: usize = 1_000;
const NANOSECONDS_PER_SECOND: u64 = 1_000_000_000;

/// `rp ship`.
#[derive(Args, Debug)]
#[command(after_help = "\
It reads the section `ship` of the agent's configuration. A bag is delivered once its recording has
ended: files first, `manifest.json` with their checksums last. Snapshots come first, then the oldest
bags. A delivered bag is deleted only if space is needed. ros2probe-ship.service runs it.
Credentials are in the file `ship.credentials_file`, or in the environment variables of the
provider. docs/ship.md has examples.
Exit codes: 0 everything is delivered or ended on request, 78 the configuration is invalid or names
no destination, 2 wrong usage, 1 otherwise.

Examples:
  rp ship --once
  sudo rp ship --status --json | jq .waiting_bags")]
pub(crate) struct Ship {
    /// Configuration file of the agent
    #[arg(long, value_name = "FILE", default_value = DEFAULT_CONFIG)]
    config: PathBuf,
    /// Deliver the finished bags at any time of the day, and exit
    #[arg(long, conflicts_with = "status")]
    once: bool,
    /// Print what waits, what was delivered and the last failure
    #[arg(long)]
    status: bool,
    /// Print JSON: one object
    #[arg(long, requires = "status")]
    json: bool,
}

/// The configuration names no destination or directory.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub(crate) struct NoDestination {
    path: PathBuf,
    reason: ship::NoShip,
}

impl Ship {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let config = Config::load(&self.config)?;
        let settings = ship::settings(&config).map_err(|reason| NoDestination {
            path: self.config.clone(),
            reason,
        })?;
        if self.status {
            return print_status(&settings.state, self.json);
        }
        let _log = Log::start(config.log, None);
        let findings = findings(&config.api.socket);
        let observer = self.once.then(progress).flatten();
        let mut shipper = Shipper::new(settings, Some(findings), observer)?;
        let runtime = Builder::new_current_thread()
            .max_blocking_threads(2)
            .enable_all()
            .build()?;
        let done = runtime.block_on(async {
            let mut terminate = signal(SignalKind::terminate())?;
            let mut interrupt = signal(SignalKind::interrupt())?;
            tokio::select! {
                done = deliver(&mut shipper, self.once) => done.map_err(anyhow::Error::from),
                _ = terminate.recv() => Ok(None),
                _ = interrupt.recv() => Ok(None),
            }
        });
        // A pending name resolution must not delay the end.
        runtime.shutdown_background();
        if let Some(status) = done? {
            Output::new().write(&text(&status))?;
        }
        Ok(ExitCode::SUCCESS)
    }
}

/// Delivers bags once, or until the process ends.
async fn deliver(shipper: &mut Shipper, once: bool) -> Result<Option<Status>, ShipError> {
    match once {
        true => shipper.run_once().await.map(Some),
        false => shipper.run().await.map(|()| None),
    }
}

fn print_status(directory: &Path, is_json: bool) -> Result<ExitCode> {
    let status = Status::read(directory)?;
    let text = match is_json {
        true => serde_json::to_string_pretty(&status).context("the status")? + "\n",
        false => text(&status),
    };
    Output::new().write(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the status as lines.
fn text(status: &Status) -> String {
    let mut lines = vec![format!(
        "{} bags wait ({}), {} are recorded, {} were delivered ({}), {} of them deleted here",
        status.waiting_bags,
        size(status.waiting_bytes),
        status.unfinished_bags,
        status.delivered_bags,
        size(status.delivered_bytes),
        status.deleted_bags,
    )];
    lines.extend(status.uploading.as_ref().map(line));
    lines.extend((status.opens_in_seconds > 0).then(|| {
        format!(
            "the next window opens in {} min",
            status.opens_in_seconds.div_ceil(60)
        )
    }));
    let next = status.waiting.first();
    lines.extend(next.map(|bag| format!("next: {bag}")));
    let last = status.last_delivered.as_ref();
    lines.extend(last.map(|last| format!("last delivered: {} at {}", last.path, last.at)));
    let failure = status.last_failure.as_ref();
    lines.extend(
        failure.map(|last| format!("last failure: {}: {} at {}", last.bag, last.reason, last.at)),
    );
    lines.push(format!("as of {}", status.at));
    visible_lines(&(lines.join("\n") + "\n")).into_owned()
}

/// Returns an observer that shows the progress in one line of a terminal.
fn progress() -> Option<Observer> {
    let show = |uploading: &Uploading| {
        let end = match uploading.done_bytes == uploading.bytes {
            true => "\n",
            false => "",
        };
        let line = line(uploading);
        let _ = write!(stderr(), "\r\x1b[K{}{end}", visible_lines(&line));
    };
    stderr().is_terminal().then(|| Box::new(show) as Observer)
}

fn line(uploading: &Uploading) -> String {
    let Uploading {
        bag,
        bytes,
        done_bytes,
    } = uploading;
    format!("{bag}: {} of {}", size(*done_bytes), size(*bytes))
}

/// Returns a query for the agent's warnings and errors of a time.
fn findings(socket: &SocketChoice) -> Findings {
    let target = Target {
        socket: match socket {
            SocketChoice::At(path) => Some(path.clone()),
            SocketChoice::Auto | SocketChoice::Off => None,
        },
        ..Target::default()
    };
    Arc::new(move |start, end| {
        let agent = Agent::reach(&target).ok()?;
        // A second more on both sides has the events that were reported with a delay.
        let (from, to) = (
            start / NANOSECONDS_PER_SECOND,
            end.div_ceil(NANOSECONDS_PER_SECOND) + 1,
        );
        let path = format!("/history/events?from={}&to={to}", from.saturating_sub(1));
        let mut lines = agent.stream(&path).ok()?;
        let mut found = Vec::new();
        while let Some(line) = lines.line().ok()? {
            add(&mut found, &line);
        }
        Some(found)
    })
}

/// Adds an event to the findings if it is a warning or an error, up to the maximum number.
fn add(found: &mut Vec<Value>, line: &[u8]) {
    let Ok(event) = serde_json::from_slice::<Value>(line) else {
        return;
    };
    let severity = event.get("severity").and_then(Value::as_str);
    if matches!(severity, Some("WARN" | "ERROR")) && found.len() < MAX_FINDINGS {
        found.push(event);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn findings_are_warnings_and_errors_up_to_the_cap() {
        let mut found = Vec::new();
        for line in ["{\"severity\":\"INFO\"}", "{}", "no JSON", ""] {
            add(&mut found, line.as_bytes());
        }
        assert!(found.is_empty());
        for _ in 0..=MAX_FINDINGS {
            add(&mut found, b"{\"severity\":\"WARN\"}");
        }
        assert_eq!(found.len(), MAX_FINDINGS);
    }
}
