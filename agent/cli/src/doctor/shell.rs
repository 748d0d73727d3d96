//! Checks of this shell's ROS variables: their effect on nodes and tools started from it, and which
//! of their traffic the agent cannot see.

use super::host_state::{HostState, ReadFailure};
use super::variables::{Range, Variables};
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_wire::DomainId;

const AREA: Area = Area::Shell;
const SHELL_SOURCE: &str = "this shell";
/// The RMW implementation without UDP ports of a domain and without DDS discovery.
const RMW_ZENOH: &str = "rmw_zenoh_cpp";
const LOCAL_PORT_RANGE_PATH: &str = "/proc/sys/net/ipv4/ip_local_port_range";
/// Maximum offset from the first port, for fifty participants on one host: 11, plus two for each
/// other.
const PORTS_OF_50_PARTICIPANTS: u32 = 11 + 2 * 49;
/// Turns iceoryx off in `CYCLONEDDS_URI`: of Cyclone DDS 0.10, and since 11.0, which has plugins for
/// it (PSMX).
pub(super) const WITHOUT_ICEORYX: &str =
    "<SharedMemory><Enable>false</Enable></SharedMemory>    # in CYCLONEDDS_URI, Cyclone DDS 0.10";
pub(super) const WITHOUT_PSMX: &str = "<PubSubMessageExchange/>    # remove it from \
     <General><Interfaces> in CYCLONEDDS_URI, Cyclone DDS 11";
/// Maximum number of bytes read of an XML profile.
const MAX_PROFILE: u64 = 256 << 10;

/// Returns the findings of all shell checks.
#[must_use]
pub fn check(host: &HostState) -> Vec<Finding> {
    let variables = Variables::of(&host.environment);
    if !variables.is_ros() {
        return vec![none(host)];
    }
    let mut findings = vec![domain(host, &variables), implementation(&variables)];
    if !is_zenoh(&variables) {
        findings.push(range(&variables));
        findings.extend(server(&variables));
        findings.extend(easy_mode(&variables));
    }
    findings.extend(transports(&variables));
    findings.extend(profiles(host, &variables));
    findings.extend(cyclone(host, &variables));
    findings.extend(security(&variables));
    findings
}

fn is_zenoh(variables: &Variables) -> bool {
    variables.shown("RMW_IMPLEMENTATION").as_deref() == Some(RMW_ZENOH)
}

fn none(host: &HostState) -> Finding {
    let is_sudo = host.environment.contains_key("SUDO_USER");
    let finding = Finding::new(
        AREA,
        "environment",
        Severity::Note,
        if is_sudo {
            "no ROS variables: sudo does not pass them on"
        } else {
            "ROS is not set up in this shell; the agent does not need it"
        },
    );
    let finding = finding.seen("none", SHELL_SOURCE);
    if is_sudo {
        finding.remedy("sudo -E rp doctor")
    } else {
        finding.remedy(
            "source /opt/ros/$ROS_DISTRO/setup.bash    # to compare this shell with the nodes",
        )
    }
}

fn domain(host: &HostState, variables: &Variables) -> Finding {
    let report = |severity, sentence: String| Finding::new(AREA, "domain", severity, sentence);
    let shown = variables
        .shown("ROS_DOMAIN_ID")
        .unwrap_or_else(|| "not set".to_owned());
    let finding = match variables.domain() {
        Err(error) => report(
            Severity::Problem,
            format!("{error}: nodes of this shell do not start"),
        )
        .remedy("export ROS_DOMAIN_ID=0    # 0 to 101, and 215 to 232"),
        Ok(domain) => match ephemeral(host) {
            Some((first, last)) if !is_zenoh(variables) && overlaps(domain, first, last) => report(
                Severity::Warning,
                format!(
                    "the ports of domain {domain} are in the ephemeral range ({first} to \
                     {last}): a node may find its port in use"
                ),
            )
            .remedy("export ROS_DOMAIN_ID=0    # 0 to 101, and 215 to 232"),
            _ => report(Severity::Ok, format!("domain {domain}")),
        },
    };
    finding.seen(shown, format!("ROS_DOMAIN_ID, {SHELL_SOURCE}"))
}

/// Returns the range of ephemeral ports, if it is readable.
fn ephemeral(host: &HostState) -> Option<(u32, u32)> {
    let text = host.files.text(LOCAL_PORT_RANGE_PATH).ok()?;
    let mut numbers = text.split_whitespace().map(str::parse);
    Some((numbers.next()?.ok()?, numbers.next()?.ok()?))
}

fn overlaps(domain: u32, first: u32, last: u32) -> bool {
    let begin = u32::from(DomainId::PORT_BASE) + u32::from(DomainId::PORT_GAIN) * domain;
    let end = begin + PORTS_OF_50_PARTICIPANTS;
    begin <= last && end >= first
}

fn implementation(variables: &Variables) -> Finding {
    let report = |severity, sentence: String| Finding::new(AREA, "rmw", severity, sentence);
    let name = variables.shown("RMW_IMPLEMENTATION");
    let finding = match name.as_deref() {
        None => report(
            Severity::Ok,
            "the default implementation of ROS (Fast DDS)".to_owned(),
        ),
        Some(
            name @ ("rmw_fastrtps_cpp"
            | "rmw_fastrtps_dynamic_cpp"
            | "rmw_cyclonedds_cpp"
            | RMW_ZENOH),
        ) => report(Severity::Ok, name.to_owned()),
        Some(name @ ("rmw_connextdds" | "rmw_connextddsmicro")) => report(
            Severity::Note,
            format!("{name}: messages in its own shared memory are not visible"),
        ),
        Some(name) => report(
            Severity::Note,
            format!("{name}: visible where it uses RTPS over UDP"),
        ),
    };
    let shown = name.unwrap_or_else(|| "not set".to_owned());
    finding.seen(shown, format!("RMW_IMPLEMENTATION, {SHELL_SOURCE}"))
}

fn range(variables: &Variables) -> Finding {
    let report = |severity, sentence: &str| Finding::new(AREA, "range", severity, sentence);
    let peers = variables.shown("ROS_STATIC_PEERS");
    let mut finding = match variables.range() {
        Range::Subnet => report(Severity::Ok, "discovery range: subnet"),
        Range::System => report(
            Severity::Ok,
            "discovery range: as configured in the RMW implementation",
        ),
        Range::Localhost => report(
            Severity::Note,
            "discovery range: this host only; other robots do not see these nodes",
        )
        .remedy("unset ROS_LOCALHOST_ONLY; export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"),
        Range::Off => report(
            Severity::Warning,
            "discovery is off: nodes of this shell find no others",
        )
        .remedy("export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"),
        Range::Wrong(_) => report(
            Severity::Warning,
            "ROS_AUTOMATIC_DISCOVERY_RANGE is invalid: ROS uses LOCALHOST",
        )
        .remedy(
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET    # or LOCALHOST, OFF, SYSTEM_DEFAULT",
        ),
    };
    if variables.is_localhost_only()
        && (peers.is_some() || variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE").is_some())
    {
        finding.sentence.push_str(
            "; ROS_LOCALHOST_ONLY makes ROS ignore ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS",
        );
        finding.severity = finding.severity.max(Severity::Warning);
    } else if let Some(peers) = &peers {
        finding.sentence = format!("{}; static peers: {peers}", finding.sentence);
    }
    for name in [
        "ROS_LOCALHOST_ONLY",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_STATIC_PEERS",
    ] {
        let value = variables
            .shown(name)
            .unwrap_or_else(|| "not set".to_owned());
        finding = finding.seen(value, format!("{name}, {SHELL_SOURCE}"));
    }
    finding
}

fn server(variables: &Variables) -> Option<Finding> {
    let server = variables.shown("ROS_DISCOVERY_SERVER")?;
    let sentence = format!(
        "discovery server at {server}: the agent sees only the discovery traffic on this host"
    );
    let finding = Finding::new(AREA, "discovery_server", Severity::Note, sentence);
    let finding = finding.seen(server, format!("ROS_DISCOVERY_SERVER, {SHELL_SOURCE}"));
    Some(finding.remedy("export ROS_SUPER_CLIENT=TRUE    # ros2 tools need it"))
}

/// Returns the finding for the easy mode of Kilted and later: nodes of a host use its discovery
/// server, and send user data by shared memory and TCP.
fn easy_mode(variables: &Variables) -> Option<Finding> {
    let name = "ROS2_EASY_MODE";
    let server = variables.shown(name)?;
    let sentence = format!(
        "easy mode with the server {server}: nodes without it do not see those of this shell; the \
         agent reads their TCP, and announcements only on this host"
    );
    let finding = Finding::new(AREA, "easy_mode", Severity::Note, sentence);
    Some(finding.seen(server, format!("{name}, {SHELL_SOURCE}")))
}

/// Returns the finding for transports selected by Fast DDS variables.
fn transports(variables: &Variables) -> Option<Finding> {
    let name = "FASTDDS_BUILTIN_TRANSPORTS";
    let value = variables.shown(name)?;
    let report = |severity, sentence: String| Finding::new(AREA, "transports", severity, sentence);
    let kind = value.split(['?', '&']).next().unwrap_or_default();
    let finding = match kind {
        "LARGE_DATA" | "LARGE_DATAv6" | "P2P" => report(
            Severity::Ok,
            format!("with {kind}, Fast DDS uses TCP, which the agent reads except with TLS"),
        ),
        "SHM" => report(
            Severity::Note,
            "nodes of this shell use only shared memory, which is sampled; other hosts do not \
             see them"
                .to_owned(),
        ),
        _ => report(Severity::Ok, format!("Fast DDS uses the transports {kind}")),
    };
    Some(finding.seen(value, format!("{name}, {SHELL_SOURCE}")))
}

fn profiles(host: &HostState, variables: &Variables) -> Vec<Finding> {
    let names = [
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
    ];
    let set = names
        .into_iter()
        .filter_map(|name| Some((name, variables.get(name)?)));
    set.map(|(name, path)| {
        let report = |severity, sentence: String| {
            let shown = variables.shown(name).unwrap_or_default();
            Finding::new(AREA, "profiles", severity, sentence)
                .seen(shown, format!("{name}, {SHELL_SOURCE}"))
        };
        match read(host, path) {
            Err(error) => report(
                Severity::Warning,
                format!("Fast DDS's profiles cannot be read: {error}; nodes run with the defaults"),
            )
            .remedy(format!("unset {name}    # or fix it")),
            Ok(bytes) => {
                let text = String::from_utf8_lossy(&bytes);
                if text.contains("<tls>") {
                    report(
                        Severity::Warning,
                        "Fast DDS's profiles use TCP with TLS, which the agent does not read"
                            .to_owned(),
                    )
                    .elsewhere("<tls>    # remove it from the transport descriptors of that file")
                } else {
                    report(Severity::Ok, "Fast DDS profiles found".to_owned())
                }
            }
        }
    })
    .collect()
}

/// Reads a file named by a variable, relative to this shell's directory.
fn read(host: &HostState, path: &str) -> Result<Vec<u8>, ReadFailure> {
    let path = std::path::absolute(path)?;
    host.files.bytes(&path.to_string_lossy(), MAX_PROFILE)
}

fn cyclone(host: &HostState, variables: &Variables) -> Option<Finding> {
    let name = "CYCLONEDDS_URI";
    let value = variables.get(name)?;
    let shown = variables.shown(name)?;
    let report = |severity, sentence: String| {
        Finding::new(AREA, "cyclonedds", severity, sentence)
            .seen(shown.clone(), format!("{name}, {SHELL_SOURCE}"))
    };
    let mut text = String::new();
    // The value is a comma-separated list of files and inline XML.
    for part in value.split(',').map(str::trim) {
        let named = part.strip_prefix("file://");
        let Some(path) = named.or(part.starts_with('/').then_some(part)) else {
            text.push_str(part);
            continue;
        };
        match read(host, path) {
            Ok(bytes) => text.push_str(&String::from_utf8_lossy(&bytes)),
            Err(error) => {
                let sentence = format!(
                    "Cyclone DDS's configuration cannot be read: {error}; its nodes do not start"
                );
                let severity = Severity::Problem;
                return Some(
                    report(severity, sentence).remedy("unset CYCLONEDDS_URI    # or fix it"),
                );
            }
        }
    }
    let text: String = text.split_whitespace().collect();
    let shared = text.split("<SharedMemory>").nth(1).unwrap_or_default();
    let is_on = |text: &str| {
        text.split_once("<Enable>")
            .is_some_and(|(_, rest)| rest.starts_with("true"))
    };
    let remedy = if text.contains("<PubSubMessageExchange") {
        WITHOUT_PSMX
    } else if is_on(shared) {
        WITHOUT_ICEORYX
    } else {
        let sentence = "Cyclone DDS has its own configuration".to_owned();
        return Some(report(Severity::Ok, sentence));
    };
    let sentence = "Cyclone DDS uses iceoryx within this host, which the agent cannot see";
    Some(report(Severity::Warning, sentence.to_owned()).elsewhere(remedy))
}

fn security(variables: &Variables) -> Option<Finding> {
    let names = [
        "ROS_SECURITY_ENABLE",
        "ROS_SECURITY_STRATEGY",
        "ROS_SECURITY_KEYSTORE",
        "ROS_SECURITY_ENCLAVE_OVERRIDE",
    ];
    names.iter().find(|name| variables.get(name).is_some())?;
    let (severity, sentence) = if variables.is_secured() {
        (
            Severity::Note,
            "DDS security is on: participants are visible; encrypted names, rates and messages \
             are not",
        )
    } else {
        (
            Severity::Ok,
            "DDS security is configured but off (ROS_SECURITY_ENABLE is not `true`)",
        )
    };
    let mut finding = Finding::new(AREA, "security", severity, sentence);
    for name in names {
        if let Some(value) = variables.shown(name) {
            finding = finding.seen(value, format!("{name}, {SHELL_SOURCE}"));
        }
    }
    Some(finding)
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    const FILES: [(&str, &str); 4] = [
        (LOCAL_PORT_RANGE_PATH, "32768\t60999\n"),
        (
            "/home/cyclone.xml",
            "<CycloneDDS><Domain><SharedMemory>\n <Enable>true</Enable>",
        ),
        ("/home/fast.xml", "<profiles/>"),
        (
            "/home/tls.xml",
            "<type>TCPv4</type><tls><password>x</password></tls>",
        ),
    ];

    const PSMX: &str = "<General><Interfaces><NetworkInterface autodetermine=\"true\"/>\
        <PubSubMessageExchange name=\"iox2\" library=\"psmx_iox2\"/></Interfaces></General>";

    fn found(variables: &[(&str, &str)]) -> Vec<Finding> {
        let (_directory, mut host) = host(&FILES);
        host.environment = variables
            .iter()
            .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
            .collect();
        check(&host)
    }

    #[track_caller]
    fn gives(name: &str, value: &str, check: &str, severity: Severity) {
        let findings = found(&[("ROS_DISTRO", "jazzy"), (name, value)]);
        let finding = findings.iter().find(|finding| finding.check == check);
        let finding = finding.unwrap_or_else(|| panic!("{findings:?}"));
        assert_eq!(finding.severity, severity, "{finding:?}");
        assert!(
            finding
                .evidence
                .iter()
                .any(|each| each.from.starts_with(name)),
            "{finding:?}"
        );
    }

    #[test]
    fn a_shell_without_ros_leads_to_a_note_and_sudo_to_a_remedy() {
        assert_eq!(found(&[])[0].severity, Severity::Note);
        assert_eq!(
            found(&[("SUDO_USER", "me")])[0].remedies[0].line,
            "sudo -E rp doctor"
        );
    }

    #[test]
    fn the_remedy_for_iceoryx_is_that_of_the_generation_of_cyclone_dds() {
        for (value, remedy) in [
            ("file:///home/cyclone.xml", WITHOUT_ICEORYX),
            (PSMX, WITHOUT_PSMX),
        ] {
            let findings = found(&[("ROS_DISTRO", "jazzy"), ("CYCLONEDDS_URI", value)]);
            let finding = findings.iter().find(|each| each.check == "cyclonedds");
            let found = &finding.unwrap().remedies[0];
            let comment = found.comment.as_deref().unwrap();
            assert_eq!(format!("{}    # {comment}", found.line), remedy);
        }
    }

    #[test]
    fn an_ordinary_shell_passes_every_check() {
        let findings = found(&[
            ("ROS_DISTRO", "jazzy"),
            ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp"),
        ]);
        assert!(
            findings.iter().all(|each| each.severity == Severity::Ok),
            "{findings:?}"
        );
        assert_eq!(findings.len(), 3);
    }

    #[test]
    fn a_shell_of_zenoh_has_neither_ports_of_a_domain_nor_a_discovery_range() {
        let findings = found(&[
            ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp"),
            ("ROS_DOMAIN_ID", "102"),
        ]);
        let shown: Vec<_> = findings.iter().map(|each| &*each.sentence).collect();
        assert_eq!(shown, ["domain 102", "rmw_zenoh_cpp"]);
        assert!(findings.iter().all(|each| each.severity == Severity::Ok));
    }

    #[test]
    fn domains_without_ports_are_distinguished_from_valid_ones() {
        for (domain, severity) in [
            ("0", Severity::Ok),
            ("101", Severity::Ok),
            ("102", Severity::Warning),
            ("214", Severity::Warning),
            ("215", Severity::Ok),
            ("232", Severity::Ok),
            ("233", Severity::Problem),
            ("x", Severity::Problem),
        ] {
            gives("ROS_DOMAIN_ID", domain, "domain", severity);
        }
    }

    #[test]
    fn each_variable_leads_to_its_severity() {
        let (note, warning) = (Severity::Note, Severity::Warning);
        gives("RMW_IMPLEMENTATION", "rmw_zenoh_cpp", "rmw", Severity::Ok);
        gives("RMW_IMPLEMENTATION", "rmw_connextdds", "rmw", note);
        gives("RMW_IMPLEMENTATION", "rmw_of_mine", "rmw", note);
        gives("ROS_LOCALHOST_ONLY", "1", "range", note);
        gives("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF", "range", warning);
        gives("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCAL", "range", warning);
        gives("ROS_STATIC_PEERS", "10.0.0.9", "range", Severity::Ok);
        gives(
            "ROS_DISCOVERY_SERVER",
            "10.0.0.1:11811",
            "discovery_server",
            note,
        );
        gives(
            "FASTDDS_BUILTIN_TRANSPORTS",
            "LARGE_DATA?max_msg_size=1MB",
            "transports",
            Severity::Ok,
        );
        gives("ROS2_EASY_MODE", "10.0.0.1", "easy_mode", note);
        gives(
            "FASTDDS_BUILTIN_TRANSPORTS",
            "UDPv4",
            "transports",
            Severity::Ok,
        );
        gives(
            "FASTRTPS_DEFAULT_PROFILES_FILE",
            "/home/none.xml",
            "profiles",
            warning,
        );
        gives(
            "FASTRTPS_DEFAULT_PROFILES_FILE",
            "/home/fast.xml",
            "profiles",
            Severity::Ok,
        );
        gives(
            "FASTDDS_DEFAULT_PROFILES_FILE",
            "/home/tls.xml",
            "profiles",
            warning,
        );
        gives(
            "CYCLONEDDS_URI",
            "file:///home/cyclone.xml",
            "cyclonedds",
            warning,
        );
        gives(
            "CYCLONEDDS_URI",
            "file:///home/none.xml",
            "cyclonedds",
            Severity::Problem,
        );
        gives("CYCLONEDDS_URI", "<General/>", "cyclonedds", Severity::Ok);
        gives("CYCLONEDDS_URI", PSMX, "cyclonedds", warning);
        gives("ROS_SECURITY_ENABLE", "true", "security", note);
        gives(
            "ROS_SECURITY_KEYSTORE",
            "/home/keys",
            "security",
            Severity::Ok,
        );
    }

    #[test]
    fn variables_that_ros_ignores_because_of_ros_localhost_only_are_reported() {
        let findings = found(&[
            ("ROS_LOCALHOST_ONLY", "1"),
            ("ROS_STATIC_PEERS", "10.0.0.9"),
        ]);
        let finding = findings.iter().find(|each| each.check == "range").unwrap();
        assert_eq!(finding.severity, Severity::Warning);
        assert!(finding.sentence.contains("ignore"), "{}", finding.sentence);
    }
}
