//! `rp doctor`.

use std::io::{IsTerminal as _, stdin};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, ClientError, Target};
use ros2probe::doctor::answers::Answers;
use ros2probe::doctor::fix::{Fix, fixes, missing_member};
use ros2probe::doctor::host_state::HostState;
use ros2probe::doctor::text::{Style, text};
use ros2probe::doctor::{Configured, Reach, examine, examine_capture, examine_remote};
use ros2probe_api::doctor::Report;
use ros2probe_daemon::config::{Config, ConfigError};

use super::{Output, UserError};
use ros2probe_daemon::agent::DEFAULT_CONFIG;
use ros2probe_daemon::escape::visible;
use rustix::process::geteuid;

/// `rp doctor`.
#[derive(Args, Debug)]
#[command(after_help = "\
It checks the kernel, privileges, interfaces, ROS variables and processes, buffers and the clock of
this host, and asks the agent, if one is running, what it sees. It changes nothing without --fix,
which shows each change and asks before it. If no agent is
running and privileges allow, it briefly loads the agent's kernel programs to test the kernel.
Checks without the required permission are `unknown`, with the command to run: often `sudo rp doctor`.
With --host it reports only on that agent and its graph, with --replay on the capture's graph.
Without --domain it reports on every domain, whatever ROS_DOMAIN_ID is.
Verdicts: ok, note (by choice, or good to know), unknown, warning (something will be missing or
wrong), problem (broken). A line with `>` is the remedy: a command, or a line of the configuration.
Exit codes: 0 no problem (warnings allowed), 1 a problem, or no answer with --host, 2 wrong usage.
With --fix, 0 unless a change failed.

Examples:
  sudo rp doctor                        all of it
  sudo rp doctor --fix                  and safe remedies, one by one
  rp doctor --json | jq -r '.findings[] | select(.severity == \"problem\").sentence'
  rp doctor --host robot2 --token-file ~/robot2.token
  rp doctor --replay robot.pcap.gz")]
pub(crate) struct Doctor {
    /// Print JSON: one object, for fleets
    #[arg(long)]
    json: bool,
    /// Also show the evidence of lines without a problem
    #[arg(short, long, conflicts_with = "json")]
    verbose: bool,
    /// Configuration file of the agent [default: /etc/ros2probe/ros2probe.yaml, if it exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Offer safe remedies one by one: kernel parameters of buffers, the group ros2probe,
    /// capabilities of the service
    #[arg(long, conflicts_with_all = ["json", "host", "replay"])]
    fix: bool,
    /// Apply them without questions
    #[arg(long, requires = "fix")]
    yes: bool,
    #[command(flatten)]
    target: Target,
}

impl Doctor {
    pub(crate) fn run(self) -> Result<ExitCode> {
        if self.fix && !geteuid().is_root() {
            let text = "rp: --fix changes this host: run `sudo rp doctor --fix`".to_owned();
            return Err(UserError(text).into());
        }
        if self.fix && !self.yes && !stdin().is_terminal() {
            let text = "rp: --fix asks before each change, and standard input is not a terminal: pass --yes";
            return Err(UserError(text.to_owned()).into());
        }
        let report = if self.target.host.is_some() || self.target.replay.is_some() {
            let agent = Agent::reach(&self.target)?;
            let answers = Answers::request(&agent, self.target.domain_id)?;
            match self.target.replay {
                Some(_) => examine_capture(&answers, &agent.place()),
                None => examine_remote(&answers, &agent.place()),
            }
        } else {
            let configured = configured(self.config.as_deref())?;
            examine(&HostState::read(), &configured, &reach_agent(&self.target))
        };
        self.print(&report)?;
        if self.fix {
            return fix(&report, self.yes);
        }
        Ok(match report.has_problems() {
            false => ExitCode::SUCCESS,
            true => ExitCode::FAILURE,
        })
    }

    fn print(&self, report: &Report) -> Result<()> {
        let text = if self.json {
            serde_json::to_string_pretty(report)? + "\n"
        } else {
            let style = Style {
                verbose: self.verbose,
                colours: colours(),
            };
            text(report, style)
        };
        Ok(Output::new().write(&text)?)
    }
}

/// Shows each remedy that can be applied, and applies it if the user agrees. Fails at the first one
/// that cannot be applied.
fn fix(report: &Report, is_agreed: bool) -> Result<ExitCode> {
    let mut output = Output::new();
    let groups = std::fs::read_to_string("/etc/group").unwrap_or_default();
    let user = std::env::var("SUDO_USER").ok();
    let fixes = fixes(report, missing_member(&groups, user.as_deref()));
    if fixes.is_empty() {
        output.write("\nNothing can be fixed safely. Remedies behind `>` need a decision.\n")?;
    }
    for Fix { sentence, change } in fixes {
        output.write(&format!("\n{}\n", visible(&sentence)))?;
        for step in change.steps() {
            output.write(&format!("  {}\n", visible(&step)))?;
        }
        if !is_agreed && !is_confirmed(&mut output)? {
            output.write("  skipped\n")?;
            continue;
        }
        change.apply(Path::new("/"))?;
        output.write("  done\n")?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads an answer from the terminal. Everything but `y` and `yes` is a no.
fn is_confirmed(output: &mut Output) -> Result<bool> {
    output.write("Apply it? [y/N] ")?;
    let mut answer = String::new();
    stdin().read_line(&mut answer)?;
    Ok(matches!(answer.trim(), "y" | "Y" | "yes"))
}

/// Tries to reach the agent on this host.
fn reach_agent(target: &Target) -> Reach {
    let asked = Agent::reach(target).and_then(|agent| {
        let answers = Answers::request(&agent, target.domain_id)?;
        Ok((answers, agent.place()))
    });
    match asked {
        Ok((answers, place)) => Reach::Answered(Box::new(answers), place),
        Err(error @ ClientError::Denied { .. }) => Reach::Denied(error.to_string()),
        Err(error) => Reach::NoAnswer(error.to_string()),
    }
}

/// Reads the configuration of an agent on this host. A file named on the command line must exist.
fn configured(file: Option<&Path>) -> Result<Configured> {
    let path = file.unwrap_or(Path::new(DEFAULT_CONFIG));
    if file.is_none() && !path.exists() {
        return Ok(Configured {
            config: Config::default(),
            mistakes: None,
        });
    }
    match Config::load(path) {
        Ok(config) => Ok(Configured {
            config,
            mistakes: None,
        }),
        Err(error @ ConfigError::Read { .. }) if file.is_some() => Err(error.into()),
        Err(error) => Ok(Configured {
            config: Config::default(),
            mistakes: Some((path.to_path_buf(), error.to_string())),
        }),
    }
}

/// Returns whether to print colours. See <https://no-color.org>.
fn colours() -> bool {
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let is_dumb = std::env::var_os("TERM").is_some_and(|terminal| terminal == "dumb");
    std::io::stdout().is_terminal() && !is_set("NO_COLOR") && !is_dumb
}
