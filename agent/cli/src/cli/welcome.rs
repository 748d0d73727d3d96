//! `rp` without a command: what to do next on this host, then the list of commands.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;
use ros2probe::client::{Agent, ClientError, Target};
use ros2probe_api::health::Health;
use ros2probe_daemon::escape::visible;

use super::{Output, help};

/// Places of the unit of the service.
const UNIT_PATHS: [&str; 3] = [
    "/etc/systemd/system/ros2probe.service",
    "/usr/lib/systemd/system/ros2probe.service",
    "/lib/systemd/system/ros2probe.service",
];

/// State of the agent on this host.
#[derive(Debug)]
enum State {
    /// It observes from a source, with this number of watches.
    Ready { source: String, watches: usize },
    /// It runs, and does not observe for this reason.
    NotReady(String),
    /// None runs, but its service is installed.
    Stopped,
    /// None runs, and no service is installed.
    Absent,
    /// It cannot be asked. The error contains the remedy.
    Unknown(String),
}

/// Prints the next steps and the commands.
pub(crate) fn print() -> Result<ExitCode> {
    Output::new().write(&format!("{}\n", next_steps(&State::read())))?;
    help(&[])
}

impl State {
    fn read() -> Self {
        let asked =
            Agent::reach(&Target::default()).and_then(|agent| agent.get::<Health>("/health"));
        match asked {
            Ok(Health {
                ready: false,
                reason,
                ..
            }) => Self::NotReady(reason.unwrap_or_default()),
            Ok(health) => Self::Ready {
                source: health.source.into_owned(),
                watches: health.watches,
            },
            Err(ClientError::NoAgent) if UNIT_PATHS.iter().any(|unit| Path::new(unit).exists()) => {
                Self::Stopped
            }
            Err(ClientError::NoAgent) => Self::Absent,
            Err(error) => Self::Unknown(error.to_string()),
        }
    }
}

/// Returns what to do next, in a few lines.
fn next_steps(state: &State) -> String {
    let (sentence, steps): (String, &[[&str; 2]]) = match state {
        State::Ready { source, watches } => {
            let watches = match watches {
                1 => "1 watch".to_owned(),
                many => format!("{many} watches"),
            };
            (
                format!("An agent observes this host (source {source}, {watches})."),
                &[
                    ["rp page --open", "the robot in a browser"],
                    ["rp top", "its topics in this terminal"],
                    ["rp doctor", "what is wrong or not visible, with remedies"],
                ],
            )
        }
        State::NotReady(reason) => (
            format!("An agent runs on this host, but does not see the robot: {reason}."),
            &[["rp doctor", "the causes, with remedies"]],
        ),
        State::Stopped => (
            "The service ros2probe is installed, but no agent is running.".to_owned(),
            &[
                ["sudo systemctl start ros2probe", "start it"],
                ["sudo journalctl -u ros2probe", "why it ended"],
            ],
        ),
        State::Absent => (
            "No agent is running on this host, and the service ros2probe is not installed."
                .to_owned(),
            &[
                ["sudo rp run", "observe this host until Ctrl-C"],
                [
                    "rp run --replay FILE",
                    "show a capture instead of this host",
                ],
                ["rp doctor", "what an agent would see here"],
            ],
        ),
        State::Unknown(reason) => {
            let sentence = format!("The agent on this host cannot be asked: {reason}.");
            (sentence, &[["sudo rp doctor", "the causes, with remedies"]])
        }
    };
    let mut text = format!("{}\n", visible(&sentence));
    let width = steps.iter().map(|[command, _]| command.len()).max();
    let width = width.unwrap_or_default();
    for [command, effect] in steps {
        text.push_str(&format!("  {command:width$}  {effect}\n"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_state_has_a_sentence_and_commands_to_paste() {
        let ready = State::Ready {
            source: "host".to_owned(),
            watches: 1,
        };
        assert_eq!(
            next_steps(&ready),
            "An agent observes this host (source host, 1 watch).\n  \
             rp page --open  the robot in a browser\n  \
             rp top          its topics in this terminal\n  \
             rp doctor       what is wrong or not visible, with remedies\n"
        );
        for (state, command) in [
            (State::NotReady("no packet".to_owned()), "  rp doctor  "),
            (State::Stopped, "  sudo systemctl start ros2probe  "),
            (State::Absent, "  sudo rp run  "),
            (State::Unknown("\u{1b}[2J".to_owned()), "\\u{1b}[2J"),
        ] {
            let text = next_steps(&state);
            assert!(text.contains(command), "{text}");
        }
    }
}
