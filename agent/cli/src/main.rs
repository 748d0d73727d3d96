//! `rp`: the agent and its tools.

#![forbid(unsafe_code)]

mod ask;
mod broker;
mod cli;

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;
use clap::Parser as _;
use ros2probe_attach::client::declare_command;
use ros2probe_capture::live::CaptureError;
use ros2probe_daemon::agent;
use ros2probe_daemon::config::{Config, ConfigError};
use ros2probe_daemon::escape::visible_lines;
use ros2probe_daemon::privilege::{CapabilitiesRemain, ConfineError, Missing};
use ros2probe_metrics::otlp::SettingsError;

use cli::{Arguments, CannotStart, Command, NoDestination, UserError};

/// `EX_NOPERM` and `EX_CONFIG` of sysexits.h.
const NO_PERMISSION: u8 = 77;
const BAD_CONFIG: u8 = 78;
/// Exit code that a shell reports for a process ended by `SIGPIPE`.
const BROKEN_PIPE: u8 = 141;

fn main() -> ExitCode {
    declare_command();
    let done = |done: Result<()>| done.map(|()| ExitCode::SUCCESS);
    let ended = match Arguments::parse().command {
        None => cli::welcome(),
        Some(Command::Run(options)) => done(agent::run(options.into())),
        Some(Command::CheckConfig { file }) => done(check_config(&file)),
        Some(Command::Ci(options)) => options.run(),
        Some(Command::Attach(options)) => done(options.run()),
        Some(Command::Discover(options)) => done(ask::discover(&options)),
        Some(Command::Fleet(fleet)) => fleet.print(),
        Some(Command::Ship(ship)) => ship.run(),
        Some(Command::Upgrade(upgrade)) => upgrade.print(),
        Some(Command::Completions(completions)) => completions.print(),
        Some(Command::Man(manual)) => manual.print(),
        Some(Command::Ask(question)) => question.ask(),
    };
    ended.unwrap_or_else(|error| {
        if cli::is_broken_pipe(&error) {
            return ExitCode::from(BROKEN_PIPE);
        }
        // If stderr is closed, the exit code still reports the failure. Errors quote files, names
        // and answers, so control characters are escaped.
        let _ = writeln!(std::io::stderr(), "{}", visible_lines(&message(&error)));
        exit_code(&error)
    })
}

fn check_config(file: &Path) -> Result<()> {
    let config = Config::load(file)?;
    println!(
        "{} is valid: {} watched",
        file.display(),
        config.watches.len()
    );
    Ok(())
}

/// Returns the text of an error with its causes. Mistakes of a configuration are printed as they
/// are, one per line.
fn message(error: &anyhow::Error) -> String {
    match error.downcast_ref::<ConfigError>() {
        Some(mistakes @ ConfigError::Invalid { .. }) => mistakes.to_string(),
        _ if error.is::<UserError>() => error.to_string(),
        _ => format!("rp: {error:#}"),
    }
}

fn exit_code(error: &anyhow::Error) -> ExitCode {
    if let Some(error) = error.downcast_ref::<CannotStart>() {
        ExitCode::from(error.code)
    } else if error.is::<Missing>()
        || error.is::<CapabilitiesRemain>()
        || error.is::<ConfineError>()
        || error
            .downcast_ref()
            .is_some_and(CaptureError::is_permission_error)
    {
        ExitCode::from(NO_PERMISSION)
    } else if error.is::<ConfigError>()
        || error.is::<SettingsError>()
        || error.is::<NoDestination>()
    {
        ExitCode::from(BAD_CONFIG)
    } else {
        ExitCode::FAILURE
    }
}
