//! Checks of permissions: those of this process, of the running agent and of the service, with the
//! command that grants missing ones. `ros2probe_daemon::privilege` defines the required
//! capabilities.

use super::answers::Answers;
use super::host_state::HostState;
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::Health;
use ros2probe_capture::container::is_container;
use ros2probe_capture::uprobe;
use ros2probe_daemon::config::{CaptureSettings, InsideChoice};
use ros2probe_daemon::container::Restriction;
use ros2probe_daemon::privilege;

const AREA: Area = Area::Privileges;
const UNIT_NAME: &str = "ros2probe.service";
/// Directories of unit files, in systemd's order of precedence.
const UNIT_DIRECTORIES: [&str; 3] = [
    "/etc/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
];
const ENABLED_LINK: &str = "/etc/systemd/system/multi-user.target.wants/ros2probe.service";
const SYSTEMD_DIRECTORY: &str = "/run/systemd/system";
/// Process lists of the service, in control groups v2 and v1.
const SERVICE_PROCESS_LISTS: [&str; 3] = [
    "/sys/fs/cgroup/system.slice/ros2probe.service/cgroup.procs",
    "/sys/fs/cgroup/unified/system.slice/ros2probe.service/cgroup.procs",
    "/sys/fs/cgroup/systemd/system.slice/ros2probe.service/cgroup.procs",
];
/// Words in paths of control groups that belong to containers.
const CONTAINER_CGROUP_WORDS: [&str; 4] = ["docker", "containerd", "kubepods", "libpod"];

/// Returns the findings of all permission checks.
#[must_use]
pub fn check(
    host: &HostState,
    settings: &CaptureSettings,
    answers: Option<&Answers>,
) -> Vec<Finding> {
    let mut findings = vec![own_privileges(host, settings, answers.is_some())];
    findings.extend(answers.map(|answers| of_agent(&answers.health)));
    findings.extend(answers.and_then(containers));
    findings.extend(probes(host, settings));
    findings.extend(unit(host, answers.is_some()));
    findings
}

fn own_privileges(host: &HostState, settings: &CaptureSettings, is_running: bool) -> Finding {
    let held = privilege::capability_names(host.capabilities);
    let held = match held.len() {
        0 => "none".to_owned(),
        1..=8 => held.join(", "),
        count => format!("{count} capabilities"),
    };
    let report = |severity, sentence: String| {
        Finding::new(AREA, "capabilities", severity, sentence).seen(&held, "CapEff, this process")
    };
    match privilege::missing(host.capabilities, settings) {
        None => report(Severity::Ok, "this shell can capture".to_owned()),
        Some(_) if is_running => report(
            Severity::Ok,
            "this shell lacks the capabilities to capture; the running agent has them".to_owned(),
        ),
        Some(missing) if is_container() => report(
            Severity::Note,
            format!("this container cannot capture: {missing}"),
        ),
        Some(missing) => report(
            Severity::Note,
            format!(
                "this shell cannot capture: it lacks {}",
                missing.missing_text()
            ),
        )
        .remedy("sudo rp run    # or the service ros2probe")
        .remedy(missing.command()),
    }
}

/// Returns the findings about the container of this process, each with the option that grants what
/// is missing.
pub fn of_container(restrictions: Vec<Restriction>) -> impl Iterator<Item = Finding> {
    restrictions.into_iter().map(|restriction| {
        let Restriction {
            check,
            sentence,
            option,
        } = restriction;
        let finding = Finding::new(AREA, check, Severity::Warning, sentence);
        let finding = finding.seen("withheld", "this container");
        finding.elsewhere(format!("{option}    # docker run"))
    })
}

fn of_agent(health: &Health) -> Finding {
    let held = match health.capabilities.as_slice() {
        [] => "no capabilities".to_owned(),
        held => held.join(", "),
    };
    let report = |severity, sentence: String| {
        let finding = Finding::new(AREA, "agent_capabilities", severity, sentence);
        finding.seen(&held, "GET /health capabilities")
    };
    if let Some(reason) = &health.unfiltered_reason {
        let sentence =
            format!("the agent kept {held}, but its system calls are not filtered: {reason}");
        return report(Severity::Note, sentence);
    }
    report(
        Severity::Ok,
        format!("the agent kept {held} and dropped the rest"),
    )
}

/// Returns the finding for shared memory of containers, which is reached through
/// `/proc/<pid>/root`.
fn containers(answers: &Answers) -> Option<Finding> {
    let has = |name: &str| answers.health.capabilities.iter().any(|held| held == name);
    let looks = answers
        .health
        .abilities
        .iter()
        .any(|each| each.able && each.ability == "shared_memory");
    let is_container = |group: &str| {
        CONTAINER_CGROUP_WORDS
            .iter()
            .any(|word| group.contains(word))
    };
    let mut participants = answers.participants.participants.iter();
    let contained =
        participants.any(|each| each.process.cgroup.as_deref().is_some_and(is_container));
    if !looks || !contained || has("CAP_SYS_PTRACE") {
        return None;
    }
    let sentence = "ROS runs in containers here, but the agent cannot read their shared memory";
    let finding = Finding::new(AREA, "containers", Severity::Warning, sentence);
    let finding = finding.seen("no CAP_SYS_PTRACE", "GET /health capabilities");
    let finding = finding.elsewhere(
        "AmbientCapabilities=CAP_SYS_PTRACE CAP_CHECKPOINT_RESTORE    # and CapabilityBoundingSet, with systemctl edit ros2probe",
    );
    Some(
        finding
            .elsewhere("--cap-add SYS_PTRACE --user 0:65532    # docker run of the agent's image"),
    )
}

/// Command that makes systemd listen for the broker.
const ENABLE_BROKER: &str = "sudo systemctl unmask ros2probe-attach.socket; sudo systemctl start ros2probe-attach.socket    # or sudo rp run, with its own broker";

/// Returns the finding for uprobes, if they are configured.
fn probes(host: &HostState, settings: &CaptureSettings) -> Option<Finding> {
    let is_exact = settings.shm.reads_in_senders();
    let is_inside = settings.inside != InsideChoice::Off;
    let keys = match (is_exact, is_inside) {
        (false, false) => return None,
        (true, false) => "capture.shm.exact needs",
        (false, true) => "capture.inside needs",
        (true, true) => "capture.shm.exact and capture.inside need",
    };
    let missing = uprobe::missing_capabilities(host.capabilities);
    let socket = settings.broker.display().to_string();
    if missing.is_empty() || host.files.exists(&socket) {
        return None;
    }
    let missing = missing.join(" and ");
    let sentence =
        format!("{keys} the broker, which does not listen, or {missing}, which this shell lacks");
    let finding = Finding::new(AREA, "probes", Severity::Note, sentence);
    let finding = finding.seen("not there", socket);
    Some(finding.remedy(ENABLE_BROKER))
}

/// Returns whether the service's unit is installed.
#[must_use]
pub fn is_installed(host: &HostState) -> bool {
    host.files.exists(SYSTEMD_DIRECTORY) && installed(host).is_some()
}

/// Returns the directory of the service's unit; `None` if it is not installed.
fn installed(host: &HostState) -> Option<&'static str> {
    let mut places = UNIT_DIRECTORIES.into_iter();
    places.find(|place| host.files.exists(&format!("{place}/{UNIT_NAME}")))
}

/// Returns the finding about the service, on hosts with systemd.
fn unit(host: &HostState, is_answering: bool) -> Option<Finding> {
    if !host.files.exists(SYSTEMD_DIRECTORY) {
        return None;
    }
    let report = |severity, sentence| Finding::new(AREA, "unit", severity, sentence);
    let installed = UNIT_DIRECTORIES
        .iter()
        .find(|place| host.files.exists(&format!("{place}/{UNIT_NAME}")));
    let Some(place) = installed else {
        return Some(
            match is_answering {
                true => report(
                    Severity::Note,
                    "the agent was started by hand: no service is installed to restart it",
                ),
                false => report(Severity::Note, "the service ros2probe is not installed"),
            }
            .seen(
                "not there",
                format!("/etc/systemd/system/{UNIT_NAME} and others"),
            )
            .remedy("sudo apt install ./ros2probe_*.deb    # docs/install.md"),
        );
    };
    let is_running = SERVICE_PROCESS_LISTS.iter().any(|path| {
        host.files
            .text(path)
            .is_ok_and(|processes| !processes.is_empty())
    });
    let is_enabled = std::fs::symlink_metadata(host.files.path(ENABLED_LINK)).is_ok();
    let finding = match (is_running, is_enabled) {
        (true, true) => report(Severity::Ok, "the service ros2probe is running and enabled"),
        (true, false) => report(
            Severity::Note,
            "the service ros2probe is running but not enabled at boot",
        )
        .remedy("sudo systemctl enable ros2probe"),
        (false, true) => report(
            Severity::Problem,
            "the service ros2probe is enabled but not running",
        )
        .remedy("systemctl status ros2probe; journalctl -u ros2probe -b"),
        (false, false) => report(
            Severity::Note,
            "the service ros2probe is installed but not running",
        )
        .remedy("sudo systemctl enable --now ros2probe"),
    };
    let state = |is: bool, yes: &'static str, no: &'static str| if is { yes } else { no };
    let (running, enabled) = (
        state(is_running, "running", "not running"),
        state(is_enabled, "enabled", "not enabled"),
    );
    Some(finding.seen(
        format!("{running}, {enabled}"),
        format!("{place}/{UNIT_NAME}, /sys/fs/cgroup"),
    ))
}

#[cfg(test)]
mod tests {
    use rustix::thread::CapabilitySet;

    use super::super::host_state::tests::host;
    use super::*;
    use ros2probe_daemon::config::{Config, ExactChoice};

    const INSTALLED: (&str, &str) = ("/usr/lib/systemd/system/ros2probe.service", "[Unit]");
    const BOOTED: (&str, &str) = ("/run/systemd/system/x", "");
    const ON: (&str, &str) = (ENABLED_LINK, "");
    const RUNNING: (&str, &str) = (SERVICE_PROCESS_LISTS[0], "811\n");

    #[test]
    fn the_service_is_reported_in_each_of_its_states() {
        let of = |files: &[(&str, &str)]| {
            let (_directory, host) = host(files);
            unit(&host, false).map(|finding| finding.severity)
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[BOOTED]), Some(Severity::Note));
        assert_eq!(of(&[BOOTED, INSTALLED]), Some(Severity::Note));
        assert_eq!(of(&[BOOTED, INSTALLED, ON]), Some(Severity::Problem));
        assert_eq!(of(&[BOOTED, INSTALLED, ON, RUNNING]), Some(Severity::Ok));
        assert_eq!(of(&[BOOTED, INSTALLED, RUNNING]), Some(Severity::Note));
    }

    #[test]
    fn a_shell_without_capabilities_gets_their_names_and_the_command() {
        let (_directory, mut host) = host(&[]);
        let settings = Config::default().capture;
        let finding = own_privileges(&host, &settings, false);
        assert_eq!(finding.severity, Severity::Note);
        assert!(
            finding.sentence.contains("CAP_NET_ADMIN"),
            "{}",
            finding.sentence
        );
        assert!(
            finding
                .remedies
                .iter()
                .any(|remedy| remedy.line.starts_with("sudo setcap "))
        );
        assert_eq!(
            own_privileges(&host, &settings, true).severity,
            Severity::Ok
        );
        host.capabilities = CapabilitySet::SYS_ADMIN | CapabilitySet::NET_ADMIN;
        assert_eq!(
            own_privileges(&host, &settings, false).severity,
            Severity::Ok
        );
    }

    #[test]
    fn kept_capabilities_are_reported_and_a_missing_sandbox_with_its_reason() {
        let health = |held: &[&str], reason: Option<&str>| Health {
            capabilities: held.iter().map(|held| (*held).to_owned()).collect(),
            unfiltered_reason: reason.map(|reason| reason.to_owned().into()),
            ..Health::default()
        };
        let kept = of_agent(&health(&["CAP_SYS_PTRACE"], None));
        assert_eq!(kept.severity, Severity::Ok);
        assert!(kept.sentence.contains("kept CAP_SYS_PTRACE"));
        assert_eq!(of_agent(&health(&[], None)).severity, Severity::Ok);
        let open = of_agent(&health(&[], Some("no filters here")));
        assert_eq!(open.severity, Severity::Note);
        assert!(open.sentence.ends_with(": no filters here"));
    }

    #[test]
    fn shared_memory_of_containers_needs_a_capability() {
        let answers = |held: &str, group: &str| {
            let health = format!(
                r#"{{"abilities":[{{"ability":"shared_memory","able":true}}],"capabilities":["{held}"]}}"#
            );
            let participants = format!(r#"{{"participants":[{{"cgroup":"{group}"}}]}}"#);
            Answers {
                health: serde_json::from_str(&health).unwrap(),
                participants: serde_json::from_str(&participants).unwrap(),
                ..Answers::default()
            }
        };
        assert!(containers(&answers("CAP_BPF", "/system.slice/docker-0123.scope")).is_some());
        assert!(
            containers(&answers(
                "CAP_SYS_PTRACE",
                "/system.slice/docker-0123.scope"
            ))
            .is_none()
        );
        assert!(containers(&answers("CAP_BPF", "/user.slice")).is_none());
    }

    #[test]
    fn uprobes_are_checked_if_a_setting_needs_them() {
        let (_directory, host) = host(&[]);
        let mut settings = Config::default().capture;
        let both = probes(&host, &settings).unwrap();
        assert_eq!(both.severity, Severity::Note);
        assert!(both.sentence.contains("capture.inside need "), "{both:?}");
        settings.shm.exact = ExactChoice::Off;
        let inside = probes(&host, &settings).unwrap();
        assert!(inside.sentence.starts_with("capture.inside "), "{inside:?}");
        settings.inside = InsideChoice::Off;
        assert_eq!(probes(&host, &settings), None);
        settings.shm.exact = ExactChoice::Uprobe;
        let exact = probes(&host, &settings).unwrap();
        assert!(
            exact.sentence.starts_with("capture.shm.exact "),
            "{exact:?}"
        );
    }
}
