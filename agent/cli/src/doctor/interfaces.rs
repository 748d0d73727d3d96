//! Checks of network interfaces: their use for DDS, and which ones the agent captures.

use super::host_state::HostState;
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::Health;

const AREA: Area = Area::Interfaces;
const SYS_CLASS_NET: &str = "/sys/class/net";
/// Interfaces of this process's network namespace, independent of the mounted `/sys`.
const PROC_NET_DEV: &str = "/proc/self/net/dev";
/// Interface flags of `man 7 netdevice`.
const IFF_UP: u32 = 0x1;
const IFF_LOOPBACK: u32 = 0x8;
const IFF_MULTICAST: u32 = 0x1000;
/// Maximum number of interfaces listed by name; a container host has hundreds.
const MAX_LISTED: usize = 6;
/// MTU below which every Cyclone DDS fragment is fragmented again by IP, in bytes.
const SMALL_MTU: u32 = 1400;

/// One network interface.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Interface {
    name: String,
    flags: u32,
    mtu: u32,
    carrier: bool,
}

/// Returns the findings of all interface checks. `localhost` is whether any ROS process is limited
/// to its own host.
#[must_use]
pub fn check(host: &HostState, agent: Option<&Health>, localhost: bool) -> Vec<Finding> {
    let names = match host.files.names(SYS_CLASS_NET) {
        Ok(names) => names,
        Err(error) => {
            let sentence = "the network interfaces are unknown";
            let finding = Finding::new(AREA, "interfaces", Severity::Unknown, sentence);
            return vec![
                finding
                    .seen(error.to_string(), SYS_CLASS_NET)
                    .remedy("ip link"),
            ];
        }
    };
    if let Some(finding) = elsewhere(host, &names) {
        return vec![finding];
    }
    let all: Vec<_> = names.iter().filter_map(|name| read(host, name)).collect();
    let mut findings = vec![overview(&all)];
    findings.extend(loopback(&all, localhost));
    let used = || all.iter().filter(|each| each.is_used());
    let mute: Vec<_> = used()
        .filter(|each| each.flags & IFF_MULTICAST == 0)
        .collect();
    if !mute.is_empty() {
        let names = list(&mute);
        let sentence = format!(
            "no multicast on {names}: participants there are found only if configured \
             (ROS_STATIC_PEERS, a discovery server)"
        );
        let mut finding = Finding::new(AREA, "multicast", Severity::Warning, sentence);
        for each in mute.iter().take(MAX_LISTED) {
            finding = finding
                .seen(
                    format!("{:#x}", each.flags),
                    format!("{SYS_CLASS_NET}/{}/flags", each.name),
                )
                .remedy(format!("sudo ip link set {} multicast on", each.name));
        }
        findings.push(finding);
    }
    let small: Vec<_> = used().filter(|each| each.mtu < SMALL_MTU).collect();
    if !small.is_empty() {
        let sentence = format!(
            "the MTU of {} is small: large messages are cut into IP fragments, and one lost \
             fragment loses the message",
            list(&small)
        );
        let mut finding = Finding::new(AREA, "mtu", Severity::Note, sentence);
        for each in small.iter().take(MAX_LISTED) {
            let from = format!("{SYS_CLASS_NET}/{}/mtu", each.name);
            finding = finding.seen(each.mtu.to_string(), from);
        }
        let remedy = "<General><FragmentSize>1200B</FragmentSize></General>    # in CYCLONEDDS_URI; in \
                      Fast DDS's profile maxMessageSize";
        findings.push(finding.elsewhere(remedy));
    }
    findings.extend(agent.map(looked_at));
    findings
}

/// Returns the finding for a `/sys` that was mounted in another network namespace and shows that
/// one.
fn elsewhere(host: &HostState, names: &[String]) -> Option<Finding> {
    let table = host.files.text(PROC_NET_DEV).ok()?;
    let own = table
        .lines()
        .filter_map(|line| Some(line.split_once(':')?.0.trim()));
    let foreign = own
        .clone()
        .find(|name| !names.iter().any(|known| known == name));
    let foreign = foreign.or_else(|| {
        let others = names
            .iter()
            .find(|name| !own.clone().any(|known| known == name.as_str()));
        // A bonding master also has a file in `/sys/class/net`.
        others
            .map(String::as_str)
            .filter(|name| *name != "bonding_masters")
    })?;
    let sentence = "/sys shows the interfaces of another network namespace";
    let finding = Finding::new(AREA, "interfaces", Severity::Unknown, sentence);
    let finding = finding.seen(
        format!("{foreign} in one of them"),
        format!("{PROC_NET_DEV}, {SYS_CLASS_NET}"),
    );
    Some(finding.remedy("ip -details link    # or: sudo ip netns exec NAME rp doctor"))
}

fn read(host: &HostState, name: &str) -> Option<Interface> {
    let flags = host
        .files
        .text(&format!("{SYS_CLASS_NET}/{name}/flags"))
        .ok()?;
    let flags = u32::from_str_radix(flags.strip_prefix("0x")?, 16).ok()?;
    let state = host
        .files
        .text(&format!("{SYS_CLASS_NET}/{name}/operstate"));
    Some(Interface {
        name: name.to_owned(),
        flags,
        mtu: host
            .files
            .number(&format!("{SYS_CLASS_NET}/{name}/mtu"))
            .unwrap_or(0),
        carrier: state.is_ok_and(|state| state != "down" && state != "lowerlayerdown"),
    })
}

impl Interface {
    fn is_up(&self) -> bool {
        self.flags & IFF_UP != 0 && self.carrier
    }

    /// Returns whether the interface can reach other hosts.
    fn is_used(&self) -> bool {
        self.is_up() && self.flags & IFF_LOOPBACK == 0
    }
}

fn overview(all: &[Interface]) -> Finding {
    let report = |severity, sentence: String| {
        Finding::new(AREA, "interfaces", severity, sentence)
            .seen(all.len().to_string(), SYS_CLASS_NET)
    };
    let used: Vec<_> = all.iter().filter(|each| each.is_used()).collect();
    if used.is_empty() {
        let sentence = "only loopback is up: only this host's own nodes are visible";
        return report(Severity::Note, sentence.to_owned()).remedy("ip link");
    }
    let named: Vec<_> = used
        .iter()
        .take(MAX_LISTED)
        .map(|each| format!("{} (MTU {})", each.name, each.mtu))
        .collect();
    let more = used.len().saturating_sub(MAX_LISTED);
    let more = if more > 0 {
        format!(" and {more} more")
    } else {
        String::new()
    };
    let mut finding = report(Severity::Ok, format!("up: {}{more}", named.join(", ")));
    let down: Vec<_> = all.iter().filter(|each| !each.is_up()).collect();
    if !down.is_empty() {
        finding.sentence = format!("{}; down: {}", finding.sentence, list(&down));
    }
    finding
}

fn loopback(all: &[Interface], localhost: bool) -> Option<Finding> {
    let loopback = all.iter().find(|each| each.flags & IFF_LOOPBACK != 0)?;
    let report = |severity, sentence: String| {
        let from = format!("{SYS_CLASS_NET}/{}/flags", loopback.name);
        Finding::new(AREA, "loopback", severity, sentence)
            .seen(format!("{:#x}", loopback.flags), from)
    };
    let name = &loopback.name;
    Some(if loopback.flags & IFF_UP == 0 {
        let sentence = format!("{name} is down: nodes of this host cannot use it");
        report(Severity::Problem, sentence).remedy(format!("sudo ip link set {name} up"))
    } else if loopback.flags & IFF_MULTICAST != 0 {
        report(Severity::Ok, format!("{name} is up, with multicast"))
    } else if localhost {
        let sentence = format!(
            "{name} has no multicast, and nodes here are limited to it: some implementations \
             (Cyclone DDS) then discover each other only by probing unicast addresses"
        );
        report(Severity::Note, sentence).remedy(format!("sudo ip link set {name} multicast on"))
    } else {
        report(
            Severity::Ok,
            format!("{name} is up, without multicast (the default)"),
        )
    })
}

fn looked_at(agent: &Health) -> Finding {
    let names: Vec<_> = agent
        .interfaces
        .iter()
        .map(|each| each.interface.as_str())
        .collect();
    let sentence = match agent.source.as_ref() {
        "host"
            if names
                .iter()
                .all(|name| matches!(*name, "sockets" | "processes")) =>
        {
            "the agent observes the sockets, on every interface".to_owned()
        }
        "host" => format!("the agent observes the sockets and {}", join(&names)),
        _ if names.iter().all(|name| *name == "any") => {
            "the agent captures on every interface, but has seen no RTPS packets yet".to_owned()
        }
        _ => format!("the agent sees RTPS packets on {}", join(&names)),
    };
    let mut finding = Finding::new(AREA, "looked_at", Severity::Ok, sentence);
    for each in agent.interfaces.iter().take(MAX_LISTED) {
        if let Some(packets) = each.packets {
            let value = format!("{}: {packets} packets", each.interface);
            finding = finding.seen(value, "GET /health interfaces");
        }
    }
    finding
}

fn join(names: &[&str]) -> String {
    let named = names
        .iter()
        .filter(|name| !matches!(**name, "sockets" | "any" | "processes"));
    let named: Vec<_> = named.take(MAX_LISTED).copied().collect();
    named.join(", ")
}

fn list(interfaces: &[&Interface]) -> String {
    let mut names: Vec<_> = interfaces.iter().map(|each| each.name.as_str()).collect();
    let more = names.len().saturating_sub(MAX_LISTED);
    names.truncate(MAX_LISTED);
    match more {
        0 => names.join(", "),
        more => format!("{} and {more} more", names.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    /// Returns the findings for interfaces with these names, flags, MTUs and states.
    fn found(interfaces: &[(&str, &str, &str, &str)], localhost: bool) -> Vec<Finding> {
        let mut files = Vec::new();
        for (name, flags, mtu, state) in interfaces {
            for (file, text) in [("flags", flags), ("mtu", mtu), ("operstate", state)] {
                files.push((
                    format!("{SYS_CLASS_NET}/{name}/{file}"),
                    format!("{text}\n"),
                ));
            }
        }
        let files: Vec<_> = files
            .iter()
            .map(|(path, text)| (path.as_str(), text.as_str()))
            .collect();
        let (_directory, host) = host(&files);
        check(&host, None, localhost)
    }

    fn severity(findings: &[Finding], check: &str) -> Option<Severity> {
        let found = findings.iter().find(|finding| finding.check == check);
        found.map(|finding| finding.severity)
    }

    const LO: (&str, &str, &str, &str) = ("lo", "0x9", "65536", "unknown");
    const ETH: (&str, &str, &str, &str) = ("eth0", "0x1003", "1500", "up");

    #[test]
    fn an_ordinary_host_passes_every_interface_check() {
        let findings = found(&[LO, ETH, ("docker0", "0x1003", "1500", "down")], false);
        assert!(
            findings.iter().all(|each| each.severity == Severity::Ok),
            "{findings:?}"
        );
        assert_eq!(findings[0].sentence, "up: eth0 (MTU 1500); down: docker0");
    }

    #[test]
    fn interfaces_without_multicast_are_named_with_the_command() {
        let findings = found(&[LO, ETH, ("tun0", "0x11", "1500", "unknown")], false);
        let finding = findings
            .iter()
            .find(|each| each.check == "multicast")
            .unwrap();
        assert_eq!(finding.severity, Severity::Warning);
        assert_eq!(
            finding.remedies[0].line,
            "sudo ip link set tun0 multicast on"
        );
        assert_eq!(severity(&found(&[LO, ETH], false), "multicast"), None);
    }

    #[test]
    fn loopback_is_reported_for_participants_limited_to_it() {
        assert_eq!(
            severity(&found(&[LO, ETH], false), "loopback"),
            Some(Severity::Ok)
        );
        assert_eq!(
            severity(&found(&[LO, ETH], true), "loopback"),
            Some(Severity::Note)
        );
        let with = ("lo", "0x1009", "65536", "unknown");
        assert_eq!(
            severity(&found(&[with, ETH], true), "loopback"),
            Some(Severity::Ok)
        );
        let down = ("lo", "0x8", "65536", "down");
        assert_eq!(
            severity(&found(&[down, ETH], false), "loopback"),
            Some(Severity::Problem)
        );
    }

    #[test]
    fn interfaces_of_another_network_namespace_are_recognized() {
        let table = "Inter-| Receive\n face |bytes\n    lo: 0 0\n  eth9: 1 2\n";
        let of = |interfaces: &[(&str, &str)]| {
            let mut files = vec![(PROC_NET_DEV, table)];
            files.extend(interfaces);
            let (_directory, host) = host(&files);
            severity(&check(&host, None, false), "interfaces")
        };
        let lo = ("/sys/class/net/lo/flags", "0x9");
        let eth = ("/sys/class/net/eth9/flags", "0x1003");
        let up = ("/sys/class/net/eth9/operstate", "up");
        let bonding = ("/sys/class/net/bonding_masters", "");
        assert_eq!(of(&[lo, eth, up]), Some(Severity::Ok));
        assert_eq!(of(&[lo, eth, up, bonding]), Some(Severity::Ok));
        assert_eq!(of(&[lo]), Some(Severity::Unknown));
        let other = ("/sys/class/net/eth0/flags", "0x1003");
        assert_eq!(of(&[lo, eth, up, other]), Some(Severity::Unknown));
    }

    #[test]
    fn missing_networks_and_small_tunnel_mtus_are_reported_as_notes() {
        assert_eq!(
            severity(&found(&[LO], false), "interfaces"),
            Some(Severity::Note)
        );
        let tunnel = ("wg0", "0x10d1", "1280", "unknown");
        assert_eq!(
            severity(&found(&[LO, tunnel], false), "mtu"),
            Some(Severity::Note)
        );
        let (_directory, host) = host(&[]);
        assert_eq!(
            severity(&check(&host, None, false), "interfaces"),
            Some(Severity::Unknown)
        );
    }

    #[test]
    fn the_source_of_the_agent_is_reported() {
        let agent: Health = serde_json::from_str(
            r#"{"source":"host","interfaces":[{"interface":"sockets","packets":7}]}"#,
        )
        .unwrap();
        assert!(
            looked_at(&agent)
                .sentence
                .contains("the sockets, on every interface")
        );
        let agent: Health = serde_json::from_str(
            r#"{"source":"wire","interfaces":[{"interface":"any"},{"interface":"eth0","packets":7}]}"#,
        )
        .unwrap();
        assert_eq!(
            looked_at(&agent).sentence,
            "the agent sees RTPS packets on eth0"
        );
    }

    #[test]
    fn a_host_with_many_interfaces_leads_to_a_short_line() {
        let names: Vec<String> = (0..300).map(|number| format!("veth{number:03}")).collect();
        let all: Vec<_> = names
            .iter()
            .map(|name| (name.as_str(), "0x1003", "1500", "up"))
            .collect();
        let findings = found(&all, false);
        assert!(
            findings[0].sentence.ends_with("and 294 more"),
            "{}",
            findings[0].sentence
        );
        assert!(findings[0].sentence.len() < 200);
    }
}
