//! Remedies that `rp doctor --fix` can apply. Each is a file of its own or a membership, so that it
//! can be undone, and each is described before it is applied.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use ros2probe_api::doctor::{Finding, Remedy, RemedyTarget, Report, Severity};

/// File of kernel parameters, relative to the root.
const SYSCTL_FILE: &str = "etc/sysctl.d/90-ros2probe.conf";
/// File that extends the unit, relative to the root.
const DROP_IN: &str = "etc/systemd/system/ros2probe.service.d/90-doctor.conf";
/// Kernel parameters that may be changed: sizes of buffers, and the compiler of BPF programs.
const SAFE_SYSCTL_PREFIXES: [&str; 2] = ["net.core.", "net.ipv4.ipfrag_"];
/// Group that may use the agent's socket.
const AGENT_GROUP: &str = "ros2probe";
const AMBIENT_CAPABILITIES: &str = "AmbientCapabilities=";

/// A remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fix {
    /// The finding in plain text.
    pub sentence: String,
    /// What is done.
    pub change: Change,
}

/// A change of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// A kernel parameter, now and at each start.
    Sysctl {
        /// Name with dots.
        key: String,
        /// New value.
        value: u64,
    },
    /// Membership of the group of the agent's socket.
    Group {
        /// Name of the user.
        user: String,
    },
    /// Capabilities of the service.
    DropIn {
        /// Names, separated by spaces.
        capabilities: String,
    },
}

/// The change failed.
#[derive(Debug, thiserror::Error)]
pub enum FixError {
    /// A file cannot be written.
    #[error("cannot write {}", path.display())]
    Write {
        /// Path of the file.
        path: PathBuf,
        /// Error of the write.
        source: io::Error,
    },
    /// A program is missing.
    #[error("cannot run `{command}`")]
    Run {
        /// The command.
        command: String,
        /// Why the command could not be started.
        source: io::Error,
    },
    /// A program failed.
    #[error("`{0}` failed")]
    Failed(String),
}

/// Returns the changes that remedy warnings and problems of a report. The largest value of a kernel
/// parameter satisfies every finding about it. `user` may become a member of the group.
#[must_use]
pub fn fixes(report: &Report, user: Option<&str>) -> Vec<Fix> {
    let mut sysctls = BTreeMap::<&str, Fix>::new();
    let mut others = Vec::new();
    let bad =
        |finding: &&Finding| matches!(finding.severity, Severity::Warning | Severity::Problem);
    for finding in report.findings.iter().filter(bad) {
        for remedy in &finding.remedies {
            let sentence = finding.sentence.clone();
            if let Some((key, value)) = sysctl(remedy) {
                let known = sysctls.get(key).map(|fix| &fix.change);
                if matches!(known, Some(Change::Sysctl { value: known, .. }) if *known >= value) {
                    continue;
                }
                let change = Change::Sysctl {
                    key: key.to_owned(),
                    value,
                };
                sysctls.insert(key, Fix { sentence, change });
            } else if let Some(capabilities) = capabilities(remedy) {
                let capabilities = capabilities.to_owned();
                let change = Change::DropIn { capabilities };
                others.push(Fix { sentence, change });
            }
        }
    }
    others.extend(user.map(|user| Fix {
        sentence: format!("{user} cannot use the agent's socket without sudo"),
        change: Change::Group {
            user: user.to_owned(),
        },
    }));
    sysctls.into_values().chain(others).collect()
}

/// Returns the user who called sudo, if the group exists without this user. `groups` is the text of
/// /etc/group.
#[must_use]
pub fn missing_member<'a>(groups: &str, user: Option<&'a str>) -> Option<&'a str> {
    let user = user.filter(|user| !user.is_empty() && *user != "root")?;
    let mut lines = groups.lines().map(|line| line.split(':'));
    let mut group = lines.find(|fields| fields.clone().next() == Some(AGENT_GROUP))?;
    let mut members = group.next_back()?.split(',');
    (!members.any(|member| member == user)).then_some(user)
}

/// Returns the parameter and the value of a remedy that changes a safe one.
fn sysctl(remedy: &Remedy) -> Option<(&str, u64)> {
    let line = remedy.line.strip_prefix("sudo sysctl -w ")?;
    let (key, value) = line.split_once('=')?;
    let is_name =
        |each: char| each.is_ascii_lowercase() || each.is_ascii_digit() || "._".contains(each);
    let is_safe = SAFE_SYSCTL_PREFIXES
        .iter()
        .any(|prefix| key.starts_with(prefix));
    let is_safe = is_safe && key.chars().all(is_name) && !key.contains("..");
    let value = value.parse().ok().filter(|_| is_safe)?;
    (remedy.kind == RemedyTarget::Command).then_some((key, value))
}

/// Returns the capabilities of a remedy that extends the unit.
fn capabilities(remedy: &Remedy) -> Option<&str> {
    let names = remedy.line.strip_prefix(AMBIENT_CAPABILITIES)?;
    let mut words = names.split(' ');
    let is_name = words.all(|word| word.starts_with("CAP_"));
    (is_name && remedy.kind == RemedyTarget::Elsewhere).then_some(names)
}

impl Change {
    /// Returns a description of each step, one per line.
    #[must_use]
    pub fn steps(&self) -> Vec<String> {
        match self {
            Self::Sysctl { key, value } => vec![
                format!("sysctl -w {key}={value}"),
                format!("write `{key} = {value}` to /{SYSCTL_FILE}"),
            ],
            Self::Group { user } => vec![
                Self::group_command(user).join(" "),
                format!("{user} has to log in again"),
            ],
            Self::DropIn { capabilities } => vec![
                format!("write {capabilities} to /{DROP_IN}"),
                "systemctl daemon-reload".to_owned(),
                "systemctl restart ros2probe".to_owned(),
            ],
        }
    }

    /// Applies the change below `root`, which is `/` except in tests.
    ///
    /// # Errors
    ///
    /// Returns [`FixError`] if a file cannot be written or a program fails.
    pub fn apply(&self, root: &Path) -> Result<(), FixError> {
        match self {
            Self::Sysctl { key, value } => {
                let path = root.join("proc/sys").join(key.replace('.', "/"));
                write(&path, &format!("{value}\n"))?;
                let path = root.join(SYSCTL_FILE);
                let known = fs::read_to_string(&path).unwrap_or_default();
                write(&path, &with_parameter(&known, key, *value))
            }
            Self::Group { user } => run(&Self::group_command(user)),
            Self::DropIn { capabilities } => {
                let text = format!(
                    "# Written by rp doctor --fix.\n[Service]\n\
                     CapabilityBoundingSet={capabilities}\n{AMBIENT_CAPABILITIES}{capabilities}\n"
                );
                write(&root.join(DROP_IN), &text)?;
                run(&["systemctl", "daemon-reload"])?;
                run(&["systemctl", "restart", "ros2probe"])
            }
        }
    }

    const fn group_command(user: &str) -> [&str; 4] {
        ["usermod", "-aG", AGENT_GROUP, user]
    }
}

/// Returns the text of a file of kernel parameters with this value of a parameter.
fn with_parameter(text: &str, key: &str, value: u64) -> String {
    let is_other = |line: &&str| line.split('=').next().map(str::trim) != Some(key);
    let mut lines: Vec<&str> = text.lines().filter(is_other).collect();
    if lines.is_empty() {
        lines.push("# Written by rp doctor --fix.");
    }
    let line = format!("{key} = {value}");
    lines.push(&line);
    lines.join("\n") + "\n"
}

fn write(path: &Path, text: &str) -> Result<(), FixError> {
    let write = || {
        if let Some(directory) = path.parent() {
            fs::create_dir_all(directory)?;
        }
        fs::write(path, text)
    };
    write().map_err(|source| FixError::Write {
        path: path.to_path_buf(),
        source,
    })
}

fn run(command: &[&str]) -> Result<(), FixError> {
    let text = command.join(" ");
    let [program, arguments @ ..] = command else {
        return Ok(());
    };
    match Command::new(program).args(arguments).status() {
        Ok(status) if status.success() => Ok(()),
        Ok(_) => Err(FixError::Failed(text)),
        Err(source) => Err(FixError::Run {
            command: text,
            source,
        }),
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_api::doctor::Area;

    use super::*;

    fn report(findings: Vec<Finding>) -> Report {
        Report::new("1", "here", findings)
    }

    fn finding(severity: Severity, line: &str) -> Finding {
        Finding::new(Area::Buffers, "x", severity, "too small").remedy(line)
    }

    #[test]
    fn only_safe_parameters_of_warnings_are_fixed_with_the_largest_value() {
        let warning = |line| finding(Severity::Warning, line);
        let report = report(vec![
            warning(
                "sudo sysctl -w net.core.rmem_max=100    # permanent: /etc/sysctl.d/60-ros.conf",
            ),
            warning("sudo sysctl -w net.core.rmem_max=300"),
            warning("sudo sysctl -w net.core.rmem_max=200"),
            warning("sudo sysctl -w kernel.sysrq=1"),
            warning("sudo sysctl -w net.core./../../etc/passwd=1"),
            warning("sudo sysctl -w net.core..x=1"),
            warning("sudo sysctl -w net.core.rmem_max=$(reboot)"),
            finding(Severity::Note, "sudo sysctl -w net.core.wmem_max=5"),
            Finding::new(Area::Privileges, "x", Severity::Warning, "containers").elsewhere(
                "AmbientCapabilities=CAP_SYS_PTRACE CAP_CHECKPOINT_RESTORE    # and so on",
            ),
        ]);
        let changes: Vec<_> = fixes(&report, Some("ada"))
            .into_iter()
            .map(|fix| fix.change)
            .collect();
        assert_eq!(
            changes,
            [
                Change::Sysctl {
                    key: "net.core.rmem_max".to_owned(),
                    value: 300
                },
                Change::DropIn {
                    capabilities: "CAP_SYS_PTRACE CAP_CHECKPOINT_RESTORE".to_owned()
                },
                Change::Group {
                    user: "ada".to_owned()
                },
            ]
        );
    }

    #[test]
    fn a_parameter_is_set_now_and_in_a_file_of_its_own() {
        let root = tempfile::tempdir().unwrap();
        let set = |key: &str, value| {
            let key = key.to_owned();
            Change::Sysctl { key, value }.apply(root.path()).unwrap();
        };
        set("net.core.rmem_max", 100);
        set("net.ipv4.ipfrag_high_thresh", 7);
        set("net.core.rmem_max", 300);
        let read = |path: &str| fs::read_to_string(root.path().join(path)).unwrap();
        assert_eq!(read("proc/sys/net/core/rmem_max"), "300\n");
        assert_eq!(
            read(SYSCTL_FILE),
            "# Written by rp doctor --fix.\nnet.ipv4.ipfrag_high_thresh = 7\nnet.core.rmem_max = 300\n"
        );
    }

    #[test]
    fn only_a_user_of_sudo_outside_the_group_becomes_a_member() {
        let groups = "root:x:0:\nros2probe:x:996:ada,bob\n";
        assert_eq!(missing_member(groups, Some("eve")), Some("eve"));
        for user in [Some("ada"), Some("root"), Some(""), None] {
            assert_eq!(missing_member(groups, user), None, "{user:?}");
        }
        assert_eq!(missing_member("root:x:0:\n", Some("eve")), None);
    }
}
