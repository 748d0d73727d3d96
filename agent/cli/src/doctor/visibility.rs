//! Checks of visibility on this host, as reported by the running agent, or else from a trial.
//! `capture` provides the reasons; this module adds their consequences.

use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::Health;
use ros2probe_daemon::agent_facts::{Ability, AgentFacts};
use ros2probe_daemon::config::{CaptureSettings, InsideChoice};

const AREA: Area = Area::Sight;
/// Source of facts about a running agent.
pub(super) const HEALTH_SOURCE: &str = "GET /health";
/// Source of facts from a trial.
pub(super) const TRIAL_SOURCE: &str = "test load of the BPF programs";

/// Abilities of a capture source.
#[derive(Clone, Debug, Default)]
pub struct Visibility {
    /// `host` or `wire`.
    pub source: String,
    /// Reason why the source with more visibility is not used.
    pub source_reason: Option<String>,
    /// How interfaces are observed, and why tcx is not used; `None` if none are observed.
    pub wire: Option<(String, Option<String>)>,
    /// Available abilities.
    pub able: Vec<Ability>,
    /// Unavailable abilities, each with the reason.
    pub reasons: Vec<(Ability, String)>,
    /// Configured abilities that a trial does not test.
    pub untried: Vec<Ability>,
    /// Origin of these facts.
    pub from: &'static str,
}

impl Visibility {
    /// Returns the visibility that a running agent reports.
    #[must_use]
    pub fn of_agent(health: &Health) -> Self {
        let known = |label: &str| Ability::ALL.into_iter().find(|each| each.label() == label);
        let able = health.abilities.iter().filter(|each| each.able);
        let reasons = health.abilities.iter().filter_map(|each| {
            let reason = each.reason.clone()?;
            Some((known(&each.ability)?, reason))
        });
        Self {
            source: health.source.to_string(),
            source_reason: health.source_reason.clone(),
            wire: health
                .wire
                .as_ref()
                .map(|wire| (wire.hook.to_string(), wire.reason.clone())),
            able: able.filter_map(|each| known(&each.ability)).collect(),
            reasons: reasons.collect(),
            untried: Vec::new(),
            from: HEALTH_SOURCE,
        }
    }

    /// Returns the visibility found by a trial, which never attaches uprobes.
    #[must_use]
    pub fn of_trial(facts: AgentFacts, settings: &CaptureSettings) -> Self {
        let is_inside = matches!(settings.inside, InsideChoice::Topics | InsideChoice::Full);
        let untried = [
            settings
                .shm
                .reads_in_senders()
                .then_some(Ability::SharedMemoryExact),
            is_inside.then_some(Ability::Inside),
        ];
        Self {
            source: facts.source.label().to_owned(),
            source_reason: facts.source_reason,
            wire: facts.wire.map(|wire| (wire.hook.to_owned(), wire.reason)),
            able: facts.abilities,
            reasons: facts.missing_abilities,
            untried: untried.into_iter().flatten().collect(),
            from: TRIAL_SOURCE,
        }
    }
}

/// Returns the findings for a host without an agent and without permission for a trial.
#[must_use]
pub fn untried_findings(reason: &str) -> Vec<Finding> {
    let sentence = "kernel support was not tested";
    let finding = Finding::new(AREA, "source", Severity::Unknown, sentence);
    vec![
        finding
            .seen(reason, "this process")
            .remedy("sudo rp doctor"),
    ]
}

/// Returns the findings for a trial that failed.
#[must_use]
pub fn failed_trial_findings(error: &str) -> Vec<Finding> {
    let sentence = format!("the agent cannot observe this host: {error}");
    let finding = Finding::new(AREA, "source", Severity::Problem, sentence);
    vec![
        finding
            .seen(error, TRIAL_SOURCE)
            .remedy("sudo rp run    # prints the full cause"),
    ]
}

/// Returns one finding for the source, and one for each unavailable ability.
#[must_use]
pub fn check(visibility: &Visibility) -> Vec<Finding> {
    let mut findings = vec![source(visibility)];
    findings.extend(wire(visibility));
    let able = |ability: &Ability| visibility.able.contains(ability);
    let (seen, blind): (Vec<_>, Vec<_>) = Ability::ALL.into_iter().partition(able);
    let seen: Vec<_> = seen.into_iter().map(words).collect();
    if !seen.is_empty() {
        let sentence = format!("it sees {}", seen.join("; "));
        let finding = Finding::new(AREA, "abilities", Severity::Ok, sentence);
        findings.push(finding.seen("1", format!("{} abilities", visibility.from)));
    }
    findings.extend(
        blind
            .into_iter()
            .filter(|ability| !visibility.untried.contains(ability))
            .filter_map(|ability| missing_ability_finding(visibility, ability)),
    );
    findings
}

/// Returns the finding on how interfaces are observed; `None` if none are.
fn wire(visibility: &Visibility) -> Option<Finding> {
    let (hook, reason) = visibility.wire.as_ref()?;
    let sentence = match reason {
        Some(reason) => format!(
            "interfaces are observed by packet sockets, which cost senders of large messages \
             more: {reason}"
        ),
        None => format!("interfaces are observed by {}", hook_words(hook)),
    };
    let severity = match reason {
        Some(_) => Severity::Note,
        None => Severity::Ok,
    };
    let finding = Finding::new(AREA, "wire", severity, sentence);
    Some(finding.seen(hook, visibility.from))
}

fn hook_words(hook: &str) -> &str {
    match hook {
        "tcx" => "programs at tcx",
        "packet" => "packet sockets, as configured",
        other => other,
    }
}

fn source(visibility: &Visibility) -> Finding {
    let say = |severity, sentence: String| Finding::new(AREA, "source", severity, sentence);
    let finding = match (visibility.source.as_str(), &visibility.source_reason) {
        ("host", _) => say(
            Severity::Ok,
            "the agent observes the sockets of this host: whole messages, per subscriber"
                .to_owned(),
        ),
        ("wire", Some(reason)) => say(
            Severity::Warning,
            format!(
                "the agent observes interfaces only: no figures per subscriber, no causes of \
                 loss: {reason}"
            ),
        )
        .configure("capture: {source: host}    # fails with the reason instead of falling back"),
        ("wire", None) => say(
            Severity::Note,
            "the agent observes interfaces, as configured: no figures per subscriber, no causes \
             of loss"
                .to_owned(),
        )
        .configure("capture: {source: auto}"),
        (source, _) => say(Severity::Note, format!("packets come from a {source}")),
    };
    finding.seen(&visibility.source, visibility.from)
}

/// Returns the text for an available ability.
const fn words(ability: Ability) -> &'static str {
    match ability {
        Ability::Subscribers => "what each subscriber received",
        Ability::Sent => "messages that leave this host",
        Ability::SocketLosses => "messages lost in a full socket buffer",
        Ability::ReassemblyLosses => "messages lost in IP reassembly",
        Ability::Owners => "which process a socket belongs to",
        Ability::Containers => "all containers",
        Ability::Forwarded => "traffic merely forwarded by this host",
        Ability::SharedMemory => "Fast DDS's shared memory, in samples",
        Ability::SharedMemoryExact => "each message in Fast DDS's shared memory",
        Ability::Inside => "counts from inside processes, whatever the transport",
        Ability::LateCauses => "all causes of late calls",
    }
}

/// Returns the finding for an unavailable ability; `None` if the source's own line covers it.
fn missing_ability_finding(visibility: &Visibility, ability: Ability) -> Option<Finding> {
    let reason = visibility
        .reasons
        .iter()
        .find(|(blind, _)| *blind == ability);
    let reason = reason.map(|(_, reason)| reason.as_str());
    let is_host = visibility.source == "host";
    let (severity, mut sentence, remedy) = match ability {
        Ability::Subscribers if is_host => {
            (Severity::Warning, format!("not {}", words(ability)), None)
        }
        // The wire source has none of these abilities, and its own line covers them.
        Ability::Subscribers
        | Ability::SocketLosses
        | Ability::ReassemblyLosses
        | Ability::Owners
            if !is_host =>
        {
            return None;
        }
        Ability::Containers if !is_host => (
            Severity::Note,
            "containers with their own network namespace are not seen".to_owned(),
            Some("capture: {network_namespaces: [/run/netns/NAME]}"),
        ),
        Ability::Containers => (
            Severity::Note,
            "limited to one cgroup; other containers are not visible".to_owned(),
            Some("capture: {cgroup: null}    # and in a container the host's /sys/fs/cgroup"),
        ),
        Ability::Forwarded => (
            Severity::Note,
            "traffic merely forwarded between other hosts is not seen".to_owned(),
            Some(
                "capture: {mirror_interfaces: [eth1]}    # a mirror port or a gateway's interface",
            ),
        ),
        Ability::SharedMemory => (
            Severity::Warning,
            "Fast DDS shared memory, which most nodes of one host use, is not seen".to_owned(),
            Some("capture: {shm: {mode: auto}}"),
        ),
        Ability::SharedMemoryExact => (
            Severity::Note,
            "Fast DDS shared memory is sampled; not every message is seen".to_owned(),
            Some(
                "capture: {shm: {exact: auto}}    # with ros2probe-attach.socket, while clients read",
            ),
        ),
        Ability::Inside => (
            Severity::Note,
            "messages within one process, with data sharing, iceoryx or security are not counted"
                .to_owned(),
            Some("capture: {inside: topics}    # always; with auto while `rp inside` runs"),
        ),
        // Otherwise causes are observed while a client requests them, or late calls are off.
        Ability::LateCauses if reason.is_none() => return None,
        Ability::LateCauses => (Severity::Note, format!("not {}", words(ability)), None),
        _ => (Severity::Warning, format!("not {}", words(ability)), None),
    };
    // An agent has a reason only if its configuration is already that of the remedy.
    let is_configured = ability == Ability::SharedMemoryExact && reason.is_some();
    let remedy = remedy.filter(|_| !is_configured);
    if let Some(reason) = reason {
        sentence = format!("{sentence}: {reason}");
    }
    let finding = Finding::new(AREA, ability.label(), severity, sentence);
    let finding = finding.seen(reason.unwrap_or("0"), visibility.from);
    Some(match remedy {
        Some(remedy) => finding.configure(remedy),
        None => finding,
    })
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use ros2probe_api::doctor::RemedyTarget;
    use ros2probe_daemon::agent_facts::SourceKind;
    use ros2probe_daemon::config::{Config, ExactChoice, ShmMode};

    fn host(able: &[Ability]) -> Visibility {
        Visibility {
            source: "host".to_owned(),
            able: able.to_vec(),
            ..Visibility::default()
        }
    }

    fn find<'a>(findings: &'a [Finding], check: &str) -> Option<&'a Finding> {
        findings.iter().find(|finding| finding.check == check)
    }

    #[test]
    fn exact_shared_memory_has_no_remedy_if_it_is_configured() {
        let mut visibility = host(&[]);
        let remedies = |visibility: &Visibility| {
            let findings = check(visibility);
            let found = find(&findings, Ability::SharedMemoryExact.label()).unwrap();
            found.remedies.len()
        };
        assert_eq!(remedies(&visibility), 1);
        for reason in [
            "capture.shm.exact is auto, and no client reads samples",
            "cannot connect to the broker at /run/ros2probe-attach.sock",
        ] {
            visibility.reasons = vec![(Ability::SharedMemoryExact, reason.to_owned())];
            assert_eq!(remedies(&visibility), 0, "{reason}");
        }
    }

    #[test]
    fn a_trial_does_not_report_abilities_that_are_configured_and_that_it_does_not_test() {
        let missing = |settings: &CaptureSettings| {
            let facts = AgentFacts::new(SourceKind::Host, Instant::now());
            let findings = check(&Visibility::of_trial(facts, settings));
            ["shared_memory_exact", "inside"].map(|check| find(&findings, check).is_some())
        };
        let mut settings = Config::default().capture;
        assert_eq!(settings.shm.exact, ExactChoice::Auto);
        assert_eq!(missing(&settings), [false, true]);
        settings.shm.mode = ShmMode::Off;
        assert_eq!(missing(&settings), [true, true]);
        settings.shm.mode = ShmMode::Auto;
        settings.shm.exact = ExactChoice::Off;
        settings.inside = InsideChoice::Full;
        assert_eq!(missing(&settings), [true, false]);
    }

    #[test]
    fn with_all_abilities_doctor_prints_two_lines() {
        let findings = check(&host(&Ability::ALL));
        assert_eq!(findings.len(), 2);
        assert!(findings.iter().all(|each| each.severity == Severity::Ok));
    }

    #[test]
    fn missing_counts_from_inside_processes_are_reported_with_their_key() {
        let findings = check(&host(&Ability::ALL));
        let seen = &find(&findings, "abilities").unwrap().sentence;
        assert!(seen.contains("counts from inside processes"), "{seen}");
        let mut able = Ability::ALL.to_vec();
        able.retain(|each| *each != Ability::Inside);
        let mut visibility = host(&able);
        let findings = check(&visibility);
        let off = find(&findings, "inside").unwrap();
        assert_eq!(off.severity, Severity::Note);
        assert!(off.sentence.ends_with("or security are not counted"));
        visibility.reasons = vec![(Ability::Inside, "it lacks CAP_SYS_ADMIN".to_owned())];
        let findings = check(&visibility);
        let unavailable = &find(&findings, "inside").unwrap().sentence;
        let reason = "are not counted: it lacks CAP_SYS_ADMIN";
        assert!(unavailable.ends_with(reason), "{unavailable}");
    }

    #[test]
    fn missing_causes_of_late_calls_are_reported_only_with_their_reason() {
        let mut able = Ability::ALL.to_vec();
        able.retain(|each| *each != Ability::LateCauses);
        let mut visibility = host(&able);
        assert!(find(&check(&visibility), "late_causes").is_none());
        let reason = "the kernel has no types".to_owned();
        visibility.reasons = vec![(Ability::LateCauses, reason)];
        let findings = check(&visibility);
        let found = find(&findings, "late_causes").unwrap();
        assert_eq!(found.severity, Severity::Note);
        assert_eq!(
            found.sentence,
            "not all causes of late calls: the kernel has no types"
        );
    }

    #[test]
    fn a_missing_ability_is_reported_with_its_reason() {
        let mut able = Ability::ALL.to_vec();
        able.retain(|each| *each != Ability::ReassemblyLosses);
        let mut visibility = host(&able);
        let reason = "the kernel has no tracepoint".to_owned();
        visibility.reasons = vec![(Ability::ReassemblyLosses, reason)];
        let findings = check(&visibility);
        let found = find(&findings, "reassembly_losses").unwrap();
        assert_eq!(found.severity, Severity::Warning);
        assert_eq!(
            found.sentence,
            "not messages lost in IP reassembly: the kernel has no tracepoint"
        );
    }

    #[test]
    fn a_configured_wire_source_is_a_note_and_a_fallback_to_it_a_warning() {
        let mut visibility = Visibility {
            source: "wire".to_owned(),
            able: vec![Ability::Sent, Ability::Forwarded],
            ..Visibility::default()
        };
        let chosen = check(&visibility);
        assert_eq!(find(&chosen, "source").unwrap().severity, Severity::Note);
        visibility.source_reason = Some("no cgroup v2 hierarchy is mounted".to_owned());
        let forced = check(&visibility);
        let source = find(&forced, "source").unwrap();
        assert_eq!(source.severity, Severity::Warning);
        assert!(
            source
                .sentence
                .ends_with("no cgroup v2 hierarchy is mounted")
        );
        assert!(find(&forced, "owners").is_none());
        assert_eq!(
            find(&forced, "shared_memory").unwrap().severity,
            Severity::Warning
        );
    }

    #[test]
    fn recommended_settings_are_valid() {
        let mut configured = 0;
        for source in ["host", "wire"] {
            let visibility = Visibility {
                source: source.to_owned(),
                ..Visibility::default()
            };
            for finding in check(&visibility) {
                for remedy in finding.remedies {
                    assert_eq!(remedy.kind, RemedyTarget::Configuration, "{remedy:?}");
                    let parsed = Config::parse(remedy.line.as_bytes());
                    assert!(parsed.is_ok(), "{}: {parsed:?}", remedy.line);
                    configured += 1;
                }
            }
        }
        assert!(configured > 5, "{configured}");
    }

    #[test]
    fn unknown_abilities_of_an_agent_of_another_version_are_ignored() {
        let health: Health = serde_json::from_str(
            r#"{"source":"host","abilities":[{"ability":"x","able":true},
            {"ability":"owners","able":true},{"ability":"socket_losses","able":false,"reason":"no"}]}"#,
        )
        .unwrap();
        let visibility = Visibility::of_agent(&health);
        assert_eq!(visibility.able, [Ability::Owners]);
        assert_eq!(
            visibility.reasons,
            [(Ability::SocketLosses, "no".to_owned())]
        );
    }

    #[test]
    fn without_a_trial_the_command_for_one_is_reported() {
        let findings = untried_findings("CAP_BPF is missing");
        assert_eq!(findings[0].severity, Severity::Unknown);
        assert_eq!(findings[0].remedies[0].line, "sudo rp doctor");
        assert_eq!(failed_trial_findings("x")[0].severity, Severity::Problem);
    }
}
