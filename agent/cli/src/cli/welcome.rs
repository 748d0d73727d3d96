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

/// Source of apt that the page "Install" describes.
const REPOSITORY: &str = "/etc/apt/sources.list.d/ros2probe.list";
/// Installer of packages, without which a host has no use for one.
const DPKG: &str = "/usr/bin/dpkg";

/// State of the agent on this host.
#[derive(Debug)]
enum State {
    /// It observes from a source, with this number of watches. The page is at this address.
    Ready {
        source: String,
        watches: usize,
        page: Option<String>,
    },
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
    let installation = installation(Path::new("/"));
    let steps = next_steps(&State::read(), installation.as_deref());
    Output::new().write(&format!("{steps}\n"))?;
    help(&[])
}

/// Returns the command that installs the service on the host below `root`. Returns `None` if the
/// service is installed, or if the host has no packages of Debian.
fn installation(root: &Path) -> Option<String> {
    let has = |path: &str| root.join(path.trim_start_matches('/')).exists();
    if UNIT_PATHS.iter().any(|unit| has(unit)) || !has(DPKG) {
        return None;
    }
    if has(REPOSITORY) {
        return Some("sudo apt install ros2probe".to_owned());
    }
    let architecture = match std::env::consts::ARCH {
        "x86_64" => "amd64",
        "aarch64" => "arm64",
        other => other,
    };
    let version = env!("CARGO_PKG_VERSION");
    Some(format!(
        "sudo apt install ./ros2probe_{version}_{architecture}.deb"
    ))
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
                page: health.page,
            },
            Err(ClientError::NoAgent) if UNIT_PATHS.iter().any(|unit| Path::new(unit).exists()) => {
                Self::Stopped
            }
            Err(ClientError::NoAgent) => Self::Absent,
            Err(error) => Self::Unknown(error.to_string()),
        }
    }
}

/// Returns what to do next, in a few lines. `installation` is the command that installs the service.
fn next_steps(state: &State, installation: Option<&str>) -> String {
    let (sentence, mut steps): (String, Vec<[&str; 2]>) = match state {
        State::Ready {
            source,
            watches,
            page,
        } => {
            let watches = match watches {
                1 => "1 watch".to_owned(),
                many => format!("{many} watches"),
            };
            let page = page.as_deref();
            let steps = [
                page.map(|address| [address, "the robot in a browser of this host"]),
                page.map(|_| ["rp page --open", "the same, with all rights"]),
                Some(["rp top", "its topics in this terminal"]),
                Some(["rp doctor", "what is wrong or not visible, with remedies"]),
            ];
            (
                format!("An agent observes this host (source {source}, {watches})."),
                steps.into_iter().flatten().collect(),
            )
        }
        State::NotReady(reason) => (
            format!("An agent runs on this host, but does not see the robot: {reason}."),
            vec![["rp doctor", "the causes, with remedies"]],
        ),
        State::Stopped => (
            "The service ros2probe is installed, but no agent is running.".to_owned(),
            vec![
                ["sudo systemctl start ros2probe", "start it"],
                ["sudo journalctl -u ros2probe", "why it ended"],
            ],
        ),
        State::Absent => (
            "No agent is running on this host, and the service ros2probe is not installed."
                .to_owned(),
            vec![
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
            (
                sentence,
                vec![["sudo rp doctor", "the causes, with remedies"]],
            )
        }
    };
    if matches!(state, State::Ready { .. } | State::Absent) {
        let effect = "observe this host from each boot on, as a service";
        steps.extend(installation.map(|command| [command, effect]));
    }
    let mut text = format!("{}\n", visible(&sentence));
    let width = steps.iter().map(|[command, _]| command.len()).max();
    let width = width.unwrap_or_default();
    for [command, effect] in steps {
        let command = visible(command);
        text.push_str(&format!("  {command:width$}  {effect}\n"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_state_has_a_sentence_and_commands_to_paste() {
        let ready = |page: Option<&str>| State::Ready {
            source: "host".to_owned(),
            watches: 1,
            page: page.map(str::to_owned),
        };
        let address = "http://localhost:17401/";
        assert_eq!(
            next_steps(&ready(Some(address)), None),
            "An agent observes this host (source host, 1 watch).\n  \
             http://localhost:17401/  the robot in a browser of this host\n  \
             rp page --open           the same, with all rights\n  \
             rp top                   its topics in this terminal\n  \
             rp doctor                what is wrong or not visible, with remedies\n"
        );
        let off = next_steps(&ready(None), Some("install it"));
        assert!(!off.contains("browser"), "{off}");
        assert!(off.contains("\n  install it  observe this host"), "{off}");
        for (state, command) in [
            (State::NotReady("no packet".to_owned()), "  rp doctor  "),
            (State::Stopped, "  sudo systemctl start ros2probe  "),
            (State::Absent, "  sudo rp run  "),
            (State::Unknown("\u{1b}[2J".to_owned()), "\\u{1b}[2J"),
        ] {
            let text = next_steps(&state, None);
            assert!(text.contains(command), "{text}");
        }
    }

    #[test]
    fn the_command_that_installs_the_service_is_for_hosts_without_it() {
        let root = tempfile::tempdir().unwrap();
        let put = |path: &str| {
            let path = root.path().join(path.trim_start_matches('/'));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        };
        assert_eq!(installation(root.path()), None);
        put(DPKG);
        let file = installation(root.path()).unwrap();
        assert!(
            file.starts_with("sudo apt install ./ros2probe_") && file.ends_with(".deb"),
            "{file}"
        );
        put(REPOSITORY);
        let found = installation(root.path());
        assert_eq!(found.as_deref(), Some("sudo apt install ros2probe"));
        put(UNIT_PATHS[1]);
        assert_eq!(installation(root.path()), None);
    }
}
