//! `rp doctor`: reports what is visible on this host, what is not, and the remedies.
//!
//! Each area has a module that returns findings; this one selects the areas and their order. The
//! checks change nothing. Without a running agent, they load the agent's kernel programs briefly if
//! permitted, because only a trial shows whether the hooks work.

pub mod agent;
pub mod answers;
pub mod buffers;
pub mod cgroup;
pub mod clock;
pub mod fix;
pub mod graph;
pub mod host_state;
pub mod interfaces;
pub mod kernel;
pub mod privileges;
pub mod processes;
pub mod ros2_daemon;
pub mod shell;
pub mod text;
pub mod variables;
pub mod visibility;

use std::path::PathBuf;

use answers::Answers;
use host_state::HostState;
use processes::Processes;
use ros2probe_api::doctor::{Area, Finding, Report, Severity};
use ros2probe_capture::container::is_container;
use ros2probe_capture::error_chain::in_words;
use ros2probe_daemon::config::{CaptureSettings, Config, ExactChoice, InsideChoice};
use ros2probe_daemon::container;
use ros2probe_daemon::privilege;
use ros2probe_daemon::run;
use ros2probe_daemon::surface::api::Doctor;
use variables::{Range, Variables};
use visibility::Visibility;

/// Result of the attempt to reach an agent on this host.
#[derive(Debug)]
pub enum Reach {
    /// The agent answered: its answers and its address.
    Answered(Box<Answers>, String),
    /// No agent answered, for this reason.
    NoAnswer(String),
    /// This user has no permission to reach the agent.
    Denied(String),
}

/// Configuration on this host.
#[derive(Debug)]
pub struct Configured {
    /// Configuration of an agent started here; the default if the file is invalid.
    pub config: Config,
    /// The file and its mistakes, if it is invalid.
    pub mistakes: Option<(PathBuf, String)>,
}

/// Checks this host, with or without an agent.
#[must_use]
pub fn examine(host: &HostState, configured: &Configured, reach: &Reach) -> Report {
    let config = &configured.config;
    let answers = match reach {
        Reach::Answered(answers, _) => Some(answers.as_ref()),
        Reach::NoAnswer(_) | Reach::Denied(_) => None,
    };
    let health = answers.map(|answers| &answers.health);
    let processes = Processes::find(host, answers.map(|answers| &answers.participants));
    let shell = Variables::of(&host.environment);
    let is_local = processes.is_any_local() || shell.is_ros() && shell.range() == Range::Localhost;
    let mut findings = Vec::new();
    if let Some((path, mistakes)) = &configured.mistakes {
        findings.push(agent::misconfigured(path, mistakes));
    }
    findings.extend(match reach {
        Reach::Answered(answers, place) => agent::check(answers, place, env!("CARGO_PKG_VERSION")),
        Reach::NoAnswer(reason) => agent::absent(host, config, reason, false),
        Reach::Denied(reason) => agent::absent(host, config, reason, true),
    });
    findings.extend(agent::absent_addresses(host, config));
    findings.extend(agent::readable_tokens(config));
    findings.extend(match health {
        Some(health) => visibility::check(&Visibility::of_agent(health)),
        None => trial_findings(host, &config.capture),
    });
    findings.extend(kernel::check(host, answers.is_some()));
    findings.extend(privileges::check(host, &config.capture, answers));
    findings.extend(privileges::of_container(container::namespace_restrictions(
        config,
    )));
    findings.extend(interfaces::check(host, health, is_local));
    findings.extend(shell::check(host));
    findings.extend(processes.check(host));
    let ports = health.map_or(&[][..], |health| &health.ros2_daemon);
    let daemons: Vec<_> = processes.ros2_daemons().collect();
    findings.extend(ros2_daemon::check(ports, &daemons));
    findings.extend(
        answers
            .map(|answers| graph::check(answers, Some(processes.count())))
            .into_iter()
            .flatten(),
    );
    findings.extend(buffers::check(host, answers));
    findings.extend(clock::check(host));
    findings.extend(answers.and_then(|answers| clock::compared(&answers.clocks)));
    report(name_of(host), findings)
}

/// Returns a doctor that checks this host for the clients of its agent. Checks of a user's shell
/// and rights belong to the command alone.
#[must_use]
pub fn of_agent() -> Doctor {
    Doctor::new(|own| match Answers::of(own) {
        Ok(answers) if answers.health.source == "replay" => {
            examine_capture(&answers, "this capture")
        }
        Ok(answers) => examine_within(&HostState::read(), &answers),
        Err(error) => {
            let sentence = format!("the agent does not understand its own answers: {error}");
            let finding = Finding::new(Area::Agent, "answers", Severity::Problem, sentence);
            report("this host", vec![finding])
        }
    })
}

/// Checks this host within its agent.
fn examine_within(host: &HostState, answers: &Answers) -> Report {
    let health = &answers.health;
    let processes = Processes::find(host, Some(&answers.participants));
    let mut findings = agent::check(answers, "this page", env!("CARGO_PKG_VERSION"));
    findings.extend(visibility::check(&Visibility::of_agent(health)));
    findings.extend(kernel::check(host, true));
    findings.extend(interfaces::check(
        host,
        Some(health),
        processes.is_any_local(),
    ));
    findings.extend(processes.check(host));
    let daemons: Vec<_> = processes.ros2_daemons().collect();
    findings.extend(ros2_daemon::check(&health.ros2_daemon, &daemons));
    findings.extend(graph::check(answers, Some(processes.count())));
    findings.extend(buffers::check(host, Some(answers)));
    findings.extend(clock::check(host));
    findings.extend(clock::compared(&answers.clocks));
    report(name_of(host), findings)
}

fn report(subject: impl Into<String>, findings: Vec<Finding>) -> Report {
    Report::new(env!("CARGO_PKG_VERSION"), subject, findings)
}

fn name_of(host: &HostState) -> String {
    let name = host.files.text("/proc/sys/kernel/hostname");
    name.unwrap_or_else(|_| "this host".to_owned())
}

/// Checks an agent on another host. Only the agent's own answers are available.
#[must_use]
pub fn examine_remote(answers: &Answers, place: &str) -> Report {
    let mut findings = agent::check(answers, place, env!("CARGO_PKG_VERSION"));
    findings.extend(visibility::check(&Visibility::of_agent(&answers.health)));
    findings.extend(ros2_daemon::check(&answers.health.ros2_daemon, &[]));
    findings.extend(graph::check(answers, None));
    findings.extend(clock::compared(&answers.clocks));
    report(place, findings)
}

/// Checks the graph of a capture.
#[must_use]
pub fn examine_capture(answers: &Answers, name: &str) -> Report {
    report(name, graph::check(answers, None))
}

/// Returns the findings of a trial load of the kernel programs, if permitted. Does not attach
/// uprobes.
fn trial_findings(host: &HostState, settings: &CaptureSettings) -> Vec<Finding> {
    if let Some(missing) = privilege::missing(host.capabilities, settings) {
        return match is_container() {
            true => visibility::failed_trial_findings(&missing.to_string()),
            false => visibility::untried_findings(&format!("lacks {}", missing.missing_text())),
        };
    }
    let mut trial = settings.clone();
    trial.shm.exact = ExactChoice::Off;
    trial.inside = InsideChoice::Off;
    match run::probe(&trial) {
        Ok(facts) => visibility::check(&Visibility::of_trial(facts, settings)),
        Err(error) => visibility::failed_trial_findings(&in_words(&error)),
    }
}

#[cfg(test)]
mod tests {
    use super::host_state::tests::host;
    use super::*;

    fn areas(report: &Report) -> Vec<Area> {
        let mut areas: Vec<_> = report.findings.iter().map(|finding| finding.area).collect();
        areas.dedup();
        areas
    }

    fn configured() -> Configured {
        Configured {
            config: Config::default(),
            mistakes: None,
        }
    }

    #[test]
    fn without_files_and_privileges_each_area_is_reported_once_in_order() {
        let (_directory, host) = host(&[]);
        let report = examine(
            &host,
            &configured(),
            &Reach::NoAnswer("no agent".to_owned()),
        );
        let listed = areas(&report);
        let mut once = listed.clone();
        once.sort();
        once.dedup();
        assert_eq!(listed, once);
        assert!(!listed.contains(&Area::Graph));
        assert!(
            report
                .findings
                .iter()
                .any(|each| each.severity == Severity::Unknown)
        );
        for finding in &report.findings {
            assert!(!finding.evidence.is_empty(), "{finding:?}");
            assert!(!finding.sentence.ends_with('.'), "{finding:?}");
        }
    }

    #[test]
    fn an_agent_that_answers_replaces_the_trial_of_the_source() {
        let (_directory, host) = host(&[]);
        let answers = Box::<Answers>::default();
        let report = examine(
            &host,
            &configured(),
            &Reach::Answered(answers, "here".to_owned()),
        );
        assert!(areas(&report).contains(&Area::Graph));
        let tried = report
            .findings
            .iter()
            .any(|each| each.check == "source" && each.severity == Severity::Unknown);
        assert!(!tried, "{report:?}");
    }

    #[test]
    fn a_remote_agent_and_a_capture_are_checked_without_this_host() {
        let answers = Answers::default();
        assert_eq!(
            areas(&examine_remote(&answers, "robot2")),
            [Area::Agent, Area::Sight, Area::Graph]
        );
        assert_eq!(areas(&examine_capture(&answers, "x.pcap")), [Area::Graph]);
    }

    #[test]
    fn an_invalid_configuration_is_the_first_finding() {
        let (_directory, host) = host(&[]);
        let mut configured = configured();
        configured.mistakes = Some((PathBuf::from("/etc/x.yaml"), "bad".to_owned()));
        let report = examine(&host, &configured, &Reach::NoAnswer("no agent".to_owned()));
        assert_eq!(report.findings[0].check, "configuration");
        assert!(report.has_problems());
    }
}
