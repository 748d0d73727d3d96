//! Checks of the daemon of the `ros2` command line: whether the agent answers in its place, and
//! which commands then create no participant.

use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::Ros2DaemonPort;

const AREA: Area = Area::Processes;
const CHECK_NAME: &str = "ros2_daemon";
const HEALTH_SOURCE: &str = "GET /health ros2_daemon";
/// Commands that only query the daemon.
const DAEMON_COMMANDS: &str = "topic list/info/type/find, node list/info, service list/type/find/info, \
    action list/info/type, completion";
/// Commands that create a participant with any daemon.
const DIRECT_COMMANDS: &str = "topic echo/hz/bw/delay/pub, param, lifecycle get/set/list, service call, \
    action send_goal, doctor, --no-daemon";

/// Returns the findings about the agent's ports and about real daemons, by process id and domain.
#[must_use]
pub fn check(ports: &[Ros2DaemonPort], daemons: &[(u32, Option<u32>)]) -> Vec<Finding> {
    if ports.is_empty() {
        return unused(daemons).into_iter().collect();
    }
    let mut findings: Vec<_> = answering(ports).into_iter().collect();
    for port in ports.iter().filter(|port| port.state != "listening") {
        findings.push(elsewhere(port, daemons));
    }
    findings
}

/// Returns the finding for the domains that the agent answers for.
fn answering(ports: &[Ros2DaemonPort]) -> Option<Finding> {
    let listening = ports.iter().filter(|port| port.state == "listening");
    let domains: Vec<_> = listening.map(|port| port.domain_id.to_string()).collect();
    if domains.is_empty() {
        return None;
    }
    let plural = if domains.len() == 1 { "" } else { "s" };
    let domains = domains.join(", ");
    let sentence = format!(
        "the agent answers as the ros2 daemon of domain{plural} {domains}; no participant for: {DAEMON_COMMANDS}"
    );
    let finding = Finding::new(AREA, CHECK_NAME, Severity::Ok, sentence);
    Some(finding.seen(
        format!("still a participant for: {DIRECT_COMMANDS}"),
        HEALTH_SOURCE,
    ))
}

/// Returns the finding for a port that the agent does not have.
fn elsewhere(port: &Ros2DaemonPort, daemons: &[(u32, Option<u32>)]) -> Finding {
    let Ros2DaemonPort {
        domain_id,
        port,
        state,
        reason,
    } = port;
    let report = |severity, sentence: String| {
        let reason = reason.as_deref().unwrap_or(state);
        Finding::new(AREA, CHECK_NAME, severity, sentence)
            .seen(reason, format!("{HEALTH_SOURCE}, port {port}"))
    };
    match state.as_ref() {
        "occupied" => {
            let own = daemons
                .iter()
                .find(|(_, domain)| *domain == Some(*domain_id));
            let (holder, remedy) = match own {
                Some((id, _)) => (
                    format!("ros2 daemon (process {id})"),
                    daemon_stop(*domain_id),
                ),
                None => (
                    "another process".to_owned(),
                    format!("sudo ss -ltnp 'sport = {port}'"),
                ),
            };
            let sentence = format!(
                "{holder} has port {port} of domain {domain_id}: a participant that answers ros2 \
                 instead of the agent"
            );
            report(Severity::Warning, sentence).remedy(remedy)
        }
        "released" => {
            let sentence = format!(
                "`ros2 daemon stop` released port {port} of domain {domain_id} for a minute"
            );
            report(Severity::Note, sentence)
        }
        "limit" => {
            let sentence =
                format!("more domains than ports: ros2 in domain {domain_id} is not answered");
            report(Severity::Note, sentence)
        }
        _ => {
            let sentence =
                format!("the agent cannot answer ros2 in domain {domain_id}: no port {port}");
            report(Severity::Warning, sentence)
        }
    }
}

/// Returns the finding for real daemons while the agent does not answer in their place.
fn unused(daemons: &[(u32, Option<u32>)]) -> Option<Finding> {
    let (first, domain) = daemons.first()?;
    let which = match (daemons.len(), domain) {
        (1, Some(domain)) => format!("a ros2 daemon runs in domain {domain} (process {first})"),
        (1, None) => format!("a ros2 daemon runs (process {first})"),
        (count, _) => format!("{count} ros2 daemons run"),
    };
    let sentence =
        format!("{which}: a participant whose answers can be stale; the agent can answer instead");
    let mut finding = Finding::new(AREA, CHECK_NAME, Severity::Note, sentence);
    for (id, domain) in daemons {
        let domain = domain.map_or_else(|| "unknown".to_owned(), |domain| domain.to_string());
        finding = finding.seen(format!("domain {domain}"), format!("/proc/{id}/cmdline"));
    }
    Some(finding.configure("ros2_daemon: on    # then: ros2 daemon stop"))
}

fn daemon_stop(domain_id: u32) -> String {
    match domain_id {
        0 => "ros2 daemon stop    # the agent takes over after 3 s".to_owned(),
        domain_id => format!(
            "ROS_DOMAIN_ID={domain_id} ros2 daemon stop    # the agent takes over after 3 s"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn port(domain_id: u32, state: &'static str) -> Ros2DaemonPort {
        Ros2DaemonPort {
            domain_id,
            port: 11_511,
            state: state.into(),
            reason: None,
        }
    }

    #[test]
    fn commands_without_a_participant_are_named_while_the_agent_answers() {
        let found = check(&[port(0, "listening"), port(3, "listening")], &[]);
        let [only] = found.as_slice() else {
            panic!("{found:?}");
        };
        assert_eq!(only.severity, Severity::Ok);
        assert!(only.sentence.contains("domains 0, 3") && only.sentence.contains("node list"));
        assert!(only.evidence[0].value.contains("topic echo/hz"));
    }

    #[test]
    fn a_real_daemon_is_reported_with_the_command_or_key_that_ends_its_use() {
        let daemons = [(77, Some(3))];
        let found = check(&[port(3, "occupied")], &daemons);
        assert_eq!(found[0].severity, Severity::Warning);
        assert!(
            found[0]
                .sentence
                .starts_with("ros2 daemon (process 77) has port 11511 of domain 3")
        );
        assert_eq!(
            found[0].remedies[0].line,
            "ROS_DOMAIN_ID=3 ros2 daemon stop"
        );
        let found = check(&[port(0, "occupied")], &daemons);
        assert!(
            found[0].sentence.starts_with("another process"),
            "{found:?}"
        );
        let found = check(&[], &daemons);
        assert_eq!(found[0].severity, Severity::Note);
        assert_eq!(found[0].remedies[0].line, "ros2_daemon: on");
        assert!(check(&[], &[]).is_empty());
    }

    #[test]
    fn each_state_of_a_port_has_its_severity() {
        let severity = |state| check(&[port(0, state)], &[])[0].severity;
        assert_eq!(severity("released"), Severity::Note);
        assert_eq!(severity("limit"), Severity::Note);
        assert_eq!(severity("failed"), Severity::Warning);
    }
}
