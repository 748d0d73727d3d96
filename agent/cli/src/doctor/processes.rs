//! Checks of ROS processes on this host, as far as this user can inspect them. Different settings
//! for discovery are a common fault.
//!
//! A process belongs to ROS if it maps a DDS or RMW library, or if the agent knows a participant of
//! the process. Values that a process controls are untrusted: their size is limited here, and they
//! are escaped in the output.

use std::collections::{BTreeMap, BTreeSet};

use super::host_state::{HostState, ReadFailure, base_name};
use super::variables::{Range, Variables};
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::participants::ParticipantList;
use ros2probe_attach::functions::Library;

const AREA: Area = Area::Processes;
/// Maximum number of bytes read of a process's memory map.
const MAX_MAP: u64 = 4 << 20;
/// Maximum number of bytes read of a process's command line and of its variables.
const MAX_LINE: u64 = 64 << 10;
/// Maximum number of characters shown of a command.
const MAX_COMMAND: usize = 40;
/// Maximum number of processes named in one sentence, per group.
const MAX_NAMED_PROCESSES: usize = 4;
/// Name of the daemon of the `ros2` command line.
const ROS2_DAEMON: &str = "ros2 daemon";
/// Implementations whose messages pass only through shared memory that the agent does not read.
const UNREAD_IMPLEMENTATIONS: [&str; 2] = ["iceoryx", "iceoryx2"];
/// Maximum number of ROS processes inspected.
const MAX_PROCESSES: usize = 2000;

/// One ROS process.
#[derive(Clone, Debug)]
struct Process {
    id: u32,
    command: String,
    variables: Variables,
    implementation: Option<&'static str>,
    /// Whether it can exchange messages by Agnocast, beside its RMW.
    has_agnocast: bool,
    /// Domain of its participant.
    domain_id: Option<u32>,
    /// Its network namespace; `None` if that is the one of this process, or unknown.
    other_network: Option<String>,
}

/// ROS processes of one network namespace.
struct Neighbours<'a> {
    found: Vec<&'a Process>,
    /// The namespace, unless it is the one of this process.
    other_network: Option<&'a str>,
}

/// ROS processes of this host.
#[derive(Clone, Debug, Default)]
pub struct Processes {
    found: Vec<Process>,
    /// Processes that this user cannot inspect.
    closed: Vec<u32>,
}

impl Processes {
    /// Finds ROS processes. `known` is the agent's list of participants.
    #[must_use]
    pub fn find(host: &HostState, known: Option<&ParticipantList<'_>>) -> Self {
        let mut domains = BTreeMap::new();
        for participant in known.into_iter().flat_map(|known| &known.participants) {
            // If the participant has a socket on this host, the number is a process id of this
            // host.
            if let (Some(id), Some(_)) =
                (participant.process.process_id, &participant.process.cgroup)
            {
                let node = participant.nodes.first().cloned();
                domains.insert(id, (participant.domain_id, node));
            }
        }
        let own_network = host.files.link("/proc/self/ns/net").ok();
        let mut processes = Self::default();
        for id in host.files.processes() {
            let command = command(host, id);
            if command.is_empty() || id == std::process::id() {
                // A kernel thread, or a process that has ended.
                continue;
            }
            let (domain_id, node) = match domains.remove(&id) {
                Some((domain_id, node)) => (Some(domain_id), node),
                None => (None, None),
            };
            let command = match node {
                Some(node) => format!("{command} {node}")
                    .chars()
                    .take(MAX_COMMAND)
                    .collect(),
                None => command,
            };
            match read_process(host, id, command, domain_id) {
                Ok(Some(_)) if processes.found.len() >= MAX_PROCESSES => break,
                Ok(Some(process)) => processes.found.push(Process {
                    other_network: own_network
                        .as_ref()
                        .and_then(|own| process.other_network.filter(|network| network != own)),
                    ..process
                }),
                Ok(None) | Err(ReadFailure::Missing | ReadFailure::Other(_)) => {}
                Err(ReadFailure::NotPermitted) => processes.closed.push(id),
            }
        }
        processes
    }

    /// Returns the number of ROS processes.
    #[must_use]
    pub fn count(&self) -> usize {
        self.found.len()
    }

    /// Returns process id and domain of the daemons of the `ros2` command line.
    pub fn ros2_daemons(&self) -> impl Iterator<Item = (u32, Option<u32>)> {
        let daemons = self
            .of_own_network()
            .filter(|process| process.command.starts_with(ROS2_DAEMON));
        daemons.map(|process| (process.id, process.domain_id()))
    }

    /// Returns whether any process is limited to its own host.
    #[must_use]
    pub fn is_any_local(&self) -> bool {
        let mut found = self.of_own_network();
        found.any(|process| process.variables.range() == Range::Localhost)
    }

    fn of_own_network(&self) -> impl Iterator<Item = &Process> {
        let found = self.found.iter();
        found.filter(|process| process.other_network.is_none())
    }

    /// Returns the findings for differences among the processes and from this shell.
    #[must_use]
    pub fn check(&self, host: &HostState) -> Vec<Finding> {
        let mut findings = vec![self.overview()];
        findings.extend(self.unseen(host.is_root()));
        findings.extend(self.unread_implementations());
        findings.extend(self.agnocast());
        findings.extend(self.by_network().iter().flat_map(Neighbours::differences));
        findings.extend(self.different_domain(&Variables::of(&host.environment)));
        findings
    }

    /// Returns the finding for processes that cannot be inspected; `None` if all can be inspected.
    fn unseen(&self, is_root: bool) -> Option<Finding> {
        let first = self.closed.first()?;
        let which = match self.closed.len() {
            1 => format!("process {first}"),
            count => format!("{count} processes"),
        };
        let sentence = format!("{which} cannot be inspected; skipped");
        let severity = if is_root {
            Severity::Note
        } else {
            Severity::Unknown
        };
        let finding = Finding::new(AREA, "closed", severity, sentence);
        let finding = finding.seen("not permitted", "/proc/<pid>/maps, /proc/<pid>/environ");
        Some(match is_root {
            true => finding,
            false => finding.remedy("sudo rp doctor"),
        })
    }

    /// Warns if the messages of a process are never visible.
    fn unread_implementations(&self) -> Option<Finding> {
        let unread = |process: &&Process| {
            let own = process.implementation;
            own.is_some_and(|implementation| UNREAD_IMPLEMENTATIONS.contains(&implementation))
        };
        let unread: Vec<_> = self.found.iter().filter(unread).collect();
        let implementations = unread.iter().filter_map(|process| process.implementation);
        let implementations: BTreeSet<_> = implementations.collect();
        let implementations: Vec<_> = implementations.into_iter().collect();
        let implementations = implementations.join(" and ");
        let sentence = format!(
            "messages of {implementations} stay in shared memory that the agent does not read: {}",
            names(&unread)
        );
        let finding = Finding::new(AREA, "unread_rmw", Severity::Warning, sentence);
        let finding = finding.seen(
            implementations,
            format!("/proc/{}/maps", unread.first()?.id),
        );
        Some(finding.remedy("rp inside    # counts their callbacks, with capture.inside"))
    }

    /// Notes the processes that may exchange messages by Agnocast.
    fn agnocast(&self) -> Option<Finding> {
        let found = self.found.iter().filter(|process| process.has_agnocast);
        let found: Vec<_> = found.collect();
        let first = found.first()?;
        let sentence = format!(
            "of messages by Agnocast, only those that its bridge passes on are visible: {}",
            names(&found)
        );
        let finding = Finding::new(AREA, "agnocast", Severity::Note, sentence);
        Some(finding.seen("libagnocast", format!("/proc/{}/maps", first.id)))
    }

    fn overview(&self) -> Finding {
        let report =
            |severity, sentence: String| Finding::new(AREA, "processes", severity, sentence);
        let Some(first) = self.found.first() else {
            let sentence = "no ROS process was found on this host";
            return report(Severity::Note, sentence.to_owned()).seen("0", "/proc/<pid>/maps");
        };
        let apart = self.found.len() - self.of_own_network().count();
        let apart = match apart {
            0 => String::new(),
            1 => ", 1 in another network namespace".to_owned(),
            count => format!(", {count} in other network namespaces"),
        };
        let mut finding = report(
            Severity::Ok,
            match self.found.len() {
                1 => format!("1 ROS process: {}{apart}", first.name()),
                count => format!("{count} ROS processes{apart}"),
            },
        );
        for process in &self.found {
            let (implementation, range) = (process.implementation, process.variables.range());
            let apart = match process.other_network {
                Some(_) => ", another network namespace",
                None => "",
            };
            let value = format!(
                "{}: {}, {}, {}{apart}",
                process.name(),
                process.domain(),
                implementation.unwrap_or("unknown implementation"),
                range.words()
            );
            finding = finding.seen(value, format!("/proc/{}/environ, maps", process.id));
        }
        finding
    }

    /// Returns the processes by network namespace, beginning with that of this process.
    fn by_network(&self) -> Vec<Neighbours<'_>> {
        let mut networks: BTreeMap<_, Vec<&Process>> = BTreeMap::new();
        for process in &self.found {
            let other_network = process.other_network.as_deref();
            networks.entry(other_network).or_default().push(process);
        }
        let networks = networks.into_iter();
        let networks = networks.map(|(other_network, found)| Neighbours {
            found,
            other_network,
        });
        networks.collect()
    }

    /// Warns if no process is in the domain of this shell.
    fn different_domain(&self, shell: &Variables) -> Option<Finding> {
        let own = shell.domain().ok().filter(|_| shell.is_ros())?;
        let mut domains: Vec<_> = self.of_own_network().map(Process::domain_id).collect();
        domains.sort_unstable();
        domains.dedup();
        let first = (*domains.first()?)?;
        if domains.contains(&Some(own)) {
            return None;
        }
        let listed: Vec<_> = domains.iter().flatten().map(u32::to_string).collect();
        let sentence = format!(
            "this shell uses domain {own}, all ROS processes use {}: its tools will not find them",
            listed.join(", ")
        );
        let finding = Finding::new(AREA, "shell_domain", Severity::Warning, sentence);
        let finding = finding.seen(own.to_string(), "ROS_DOMAIN_ID, this shell");
        Some(finding.remedy(format!("export ROS_DOMAIN_ID={first}")))
    }
}

impl Neighbours<'_> {
    /// Returns the findings for settings that differ. Processes of several namespaces are not
    /// compared: whether they reach one another is unknown.
    fn differences(&self) -> Vec<Finding> {
        let domains = self.different_values(
            "domain",
            "nodes in different domains do not see each other",
            "export ROS_DOMAIN_ID=N    # the same for all nodes",
            |process| Some(process.domain()),
        );
        let implementations = self.different_values(
            "rmw",
            "mixed RMWs: topics may work only partly, services are unreliable",
            "export RMW_IMPLEMENTATION=rmw_cyclonedds_cpp    # the same for all nodes",
            |process| process.implementation.map(str::to_owned),
        );
        let ranges = self.different_values(
            "range",
            "nodes limited to localhost are not discovered from other hosts",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET    # the same for all; unset ROS_LOCALHOST_ONLY",
            |process| Some(process.variables.range().words()),
        );
        let servers = self.different_values(
            "discovery_server",
            "nodes with different discovery servers do not discover each other",
            "export ROS_DISCOVERY_SERVER=ADDRESS:11811    # the same for all, or unset for all",
            |process| {
                let server = process.variables.shown("ROS_DISCOVERY_SERVER");
                Some(server.map_or_else(
                    || "no server".to_owned(),
                    |server| format!("server {server}"),
                ))
            },
        );
        let easy_modes = self.different_values(
            "easy_mode",
            "nodes in easy mode see only nodes with the same server",
            "export ROS2_EASY_MODE=ADDRESS    # the same for all, or unset for all",
            |process| {
                let server = process.variables.shown("ROS2_EASY_MODE");
                Some(server.map_or_else(
                    || "no easy mode".to_owned(),
                    |server| format!("easy mode {server}"),
                ))
            },
        );
        let security = self.different_values(
            "security",
            "secured and unsecured nodes do not communicate",
            "export ROS_SECURITY_ENABLE=true    # for all, or for none",
            |process| {
                let is_secured = process.variables.is_secured();
                Some(if is_secured { "secured" } else { "not secured" }.to_owned())
            },
        );
        let all = [
            domains,
            implementations,
            ranges,
            servers,
            easy_modes,
            security,
        ];
        all.into_iter().flatten().collect()
    }

    /// Warns if processes have different values of `key`.
    fn different_values(
        &self,
        check: &'static str,
        consequence: &str,
        remedy: &str,
        key: impl Fn(&Process) -> Option<String>,
    ) -> Option<Finding> {
        let mut groups: BTreeMap<String, Vec<&Process>> = BTreeMap::new();
        for &process in &self.found {
            if let Some(key) = key(process) {
                groups.entry(key).or_default().push(process);
            }
        }
        if groups.len() < 2 {
            return None;
        }
        // Small groups come first: they are the likely mistakes.
        let mut groups: Vec<_> = groups.into_iter().collect();
        groups.sort_by_key(|(_, group)| group.len());
        let named: Vec<_> = groups
            .iter()
            .take(MAX_NAMED_PROCESSES)
            .map(|(key, group)| format!("{key}: {}", names(group)))
            .collect();
        let place = match self.other_network {
            Some(_) => " (in another network namespace)",
            None => "",
        };
        let sentence = format!("{consequence}{place}; {}", named.join("; "));
        let mut finding = Finding::new(AREA, check, Severity::Warning, sentence);
        for (key, group) in &groups {
            let from = group.iter().map(|process| process.id.to_string());
            let from: Vec<_> = from.collect();
            finding = finding.seen(key, format!("processes {}", from.join(", ")));
        }
        Some(finding.remedy(remedy))
    }
}

impl Process {
    fn domain_id(&self) -> Option<u32> {
        self.domain_id.or_else(|| self.variables.domain().ok())
    }

    fn domain(&self) -> String {
        match (self.domain_id(), self.variables.domain()) {
            (Some(domain), _) => format!("domain {domain}"),
            (None, Err(text)) => format!("ROS_DOMAIN_ID `{text}`"),
            (None, Ok(domain)) => format!("domain {domain}"),
        }
    }

    fn name(&self) -> String {
        format!("{} ({})", self.command, self.id)
    }
}

/// Reads one process. Returns `None` if it does not belong to ROS.
fn read_process(
    host: &HostState,
    id: u32,
    command: String,
    domain_id: Option<u32>,
) -> Result<Option<Process>, ReadFailure> {
    let map = host.files.bytes(&format!("/proc/{id}/maps"), MAX_MAP)?;
    let map = String::from_utf8_lossy(&map);
    let implementation = implementation(&map);
    if implementation.is_none() && domain_id.is_none() {
        return Ok(None);
    }
    let variables = host.files.bytes(&format!("/proc/{id}/environ"), MAX_LINE)?;
    Ok(Some(Process {
        id,
        command,
        variables: Variables::parse(&variables),
        implementation,
        has_agnocast: names_of_files(&map).any(|name| name.starts_with("libagnocast")),
        domain_id,
        other_network: host.files.link(&format!("/proc/{id}/ns/net")).ok(),
    }))
}

/// Returns the names of the files in a memory map.
fn names_of_files(map: &str) -> impl Iterator<Item = &str> {
    map.lines().filter_map(|line| {
        let path = line.find('/').and_then(|at| line.get(at..))?;
        path.rsplit('/').next()
    })
}

/// Returns the RMW implementation of the mapped libraries; `None` if no library belongs to one.
fn implementation(map: &str) -> Option<&'static str> {
    const RMW_LIBRARIES: [(&str, &str); 9] = [
        ("librmw_zenoh_cpp.so", "Zenoh"),
        ("libddsc.so", "Cyclone DDS"),
        ("librmw_cyclonedds_cpp.so", "Cyclone DDS"),
        ("librmw_fastrtps_cpp.so", "Fast DDS"),
        ("libnddsc.so", "Connext"),
        ("librmw_connextdds.so", "Connext"),
        ("librmw_gurumdds_cpp.so", "GurumDDS"),
        ("librmw_iceoryx_cpp.so", "iceoryx"),
        ("librmw_iceoryx2_cxx.so", "iceoryx2"),
    ];
    let mut found: Vec<_> = names_of_files(map)
        .filter_map(|name| {
            let by_name = RMW_LIBRARIES.iter().find(|(library, _)| {
                let rest = name.strip_prefix(library);
                rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', ' ']))
            });
            let fast = Library::FastDds.has_name(name).then_some("Fast DDS");
            by_name.map(|(_, implementation)| *implementation).or(fast)
        })
        .collect();
    found.sort_unstable();
    found.dedup();
    match found.as_slice() {
        [] => None,
        [one] => Some(one),
        _ => Some("several implementations"),
    }
}

/// Returns the name of the program or script; empty for kernel threads.
fn command(host: &HostState, id: u32) -> String {
    let line = host.files.bytes(&format!("/proc/{id}/cmdline"), MAX_LINE);
    let line = line.unwrap_or_default();
    let words: Vec<_> = line
        .split(|byte| *byte == 0)
        .map(|word| String::from_utf8_lossy(word).into_owned())
        .collect();
    let first = words
        .first()
        .map(|word| base_name(word))
        .unwrap_or_default();
    let script = words.iter().skip(1).find(|word| !word.starts_with('-'));
    let is_interpreter = first.starts_with("python") || matches!(first, "bash" | "sh" | "node");
    let has_no_file = words.get(1).is_some_and(|word| word == "-c");
    let name = match script {
        Some(code) if is_interpreter && code.contains("ros2cli.daemon") => ROS2_DAEMON,
        Some(_) if is_interpreter && has_no_file => first,
        Some(script) if is_interpreter && !script.is_empty() => base_name(script),
        _ => first,
    };
    let node = words.iter().find_map(|word| word.strip_prefix("__node:="));
    let name = match node {
        Some(node) => format!("{name} {node}"),
        None => name.to_owned(),
    };
    name.chars().take(MAX_COMMAND).collect()
}

fn names(processes: &[&Process]) -> String {
    let names: Vec<_> = processes
        .iter()
        .take(MAX_NAMED_PROCESSES)
        .map(|each| each.name())
        .collect();
    let names = names.join(", ");
    match processes.len().saturating_sub(MAX_NAMED_PROCESSES) {
        0 => names,
        more => format!("{names} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::super::host_state::tests::host;
    use super::*;

    const FAST: &str = "7f00-7f01 r-xp 0 fe:00 12 /opt/ros/lib/libfastrtps.so.2.14\n";
    const CYCLONE: &str = "7f00-7f01 r-xp 0 fe:00 12 /opt/ros/lib/libddsc.so.0.10.5\n";

    /// Returns the findings for processes with these ids, command lines, variables and memory maps.
    fn found(processes: &[(u32, &str, &str, &str)], shell: &[(&str, &str)]) -> Vec<Finding> {
        let mut files = Vec::new();
        for (id, command, variables, map) in processes {
            files.push((format!("/proc/{id}/cmdline"), command.replace(' ', "\0")));
            files.push((format!("/proc/{id}/environ"), variables.replace(' ', "\0")));
            files.push((format!("/proc/{id}/maps"), (*map).to_owned()));
        }
        let files: Vec<_> = files
            .iter()
            .map(|(path, text)| (path.as_str(), text.as_str()))
            .collect();
        let (_directory, mut host) = host(&files);
        host.environment = shell
            .iter()
            .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
            .collect();
        Processes::find(&host, None).check(&host)
    }

    fn sentence<'a>(findings: &'a [Finding], check: &str) -> Option<&'a str> {
        let found = findings.iter().find(|finding| finding.check == check);
        found.map(|finding| finding.sentence.as_str())
    }

    #[test]
    fn processes_with_equal_settings_lead_to_one_line() {
        let findings = found(
            &[
                (11, "/opt/talker", "ROS_DOMAIN_ID=3", FAST),
                (12, "python3 /opt/listener.py --x", "ROS_DOMAIN_ID=3", FAST),
                (13, "/bin/bash", "ROS_DOMAIN_ID=9", ""),
                (2, "", "", ""),
            ],
            &[],
        );
        assert_eq!(findings.len(), 1, "{findings:?}");
        assert_eq!(findings[0].sentence, "2 ROS processes");
        let second = &findings[0].evidence[1];
        assert_eq!(
            second.value,
            "listener.py (12): domain 3, Fast DDS, the subnet"
        );
    }

    #[test]
    fn processes_with_different_settings_are_named_smallest_group_first() {
        let findings = found(
            &[
                (11, "talker", "ROS_DOMAIN_ID=3", FAST),
                (12, "listener", "ROS_DOMAIN_ID=3", FAST),
                (
                    13,
                    "rviz2 --ros-args -r __node:=eyes",
                    "ROS_LOCALHOST_ONLY=1",
                    CYCLONE,
                ),
            ],
            &[],
        );
        assert_eq!(
            sentence(&findings, "domain").unwrap(),
            "nodes in different domains do not see each other; domain 0: rviz2 eyes (13); \
             domain 3: talker (11), listener (12)"
        );
        assert!(
            sentence(&findings, "rmw")
                .unwrap()
                .contains("Cyclone DDS: rviz2 eyes (13)")
        );
        assert!(
            sentence(&findings, "range")
                .unwrap()
                .contains("localhost only: rviz2")
        );
        assert_eq!(sentence(&findings, "security"), None);
        assert_eq!(sentence(&findings, "discovery_server"), None);
    }

    #[test]
    fn processes_are_compared_within_their_network_namespace_only() {
        let mut files = Vec::new();
        for (id, domain) in [(11, 3), (12, 3), (13, 9), (14, 8)] {
            files.push((format!("/proc/{id}/cmdline"), format!("node{id}")));
            let variables = format!("ROS_DOMAIN_ID={domain}");
            files.push((format!("/proc/{id}/environ"), variables));
            files.push((format!("/proc/{id}/maps"), FAST.to_owned()));
        }
        let files: Vec<_> = files
            .iter()
            .map(|(path, text)| (path.as_str(), text.as_str()))
            .collect();
        let (_directory, mut host) = host(&files);
        let own = ["self", "11", "12"].map(|id| (id, "net:[1]"));
        let other = ["13", "14"].map(|id| (id, "net:[2]"));
        for (id, network) in own.into_iter().chain(other) {
            let directory = host.files.path(&format!("/proc/{id}/ns"));
            fs::create_dir_all(&directory).unwrap();
            symlink(network, directory.join("net")).unwrap();
        }
        let shell = [("ROS_DISTRO", "jazzy"), ("ROS_DOMAIN_ID", "9")];
        let shell = shell.map(|(name, value)| (name.to_owned(), value.to_owned()));
        host.environment = shell.into();
        let findings = Processes::find(&host, None).check(&host);
        let domains = findings.iter().filter(|finding| finding.check == "domain");
        let domains: Vec<_> = domains.map(|finding| &*finding.sentence).collect();
        assert_eq!(
            domains,
            [
                "nodes in different domains do not see each other (in another network namespace); \
                 domain 8: node14 (14); domain 9: node13 (13)"
            ]
        );
        let overview = &findings[0];
        assert_eq!(
            overview.sentence,
            "4 ROS processes, 2 in other network namespaces"
        );
        let last = &overview.evidence[3].value;
        assert!(last.ends_with(", another network namespace"), "{last}");
        // Tools in this shell find no process, because that of its domain has another network.
        assert!(sentence(&findings, "shell_domain").is_some());
    }

    #[test]
    fn python_code_on_the_command_line_is_not_used_as_a_name() {
        let daemon = "python3\0-c\0from ros2cli.daemon.daemonize import main; main()\0--name";
        for (line, expected) in [
            (daemon, "ros2 daemon"),
            ("python3\0-c\0import rclpy; rclpy.spin()", "python3"),
            ("python3\0-u\0/opt/talker.py", "talker.py"),
        ] {
            let (_directory, host) = host(&[("/proc/7/cmdline", line)]);
            assert_eq!(command(&host, 7), expected);
        }
    }

    #[test]
    fn discovery_servers_and_security_settings_are_compared() {
        let findings = found(
            &[
                (11, "talker", "ROS_DISCOVERY_SERVER=10.0.0.1:11811", FAST),
                (12, "listener", "ROS_SECURITY_ENABLE=true", FAST),
            ],
            &[],
        );
        assert!(sentence(&findings, "discovery_server").is_some());
        assert!(sentence(&findings, "security").is_some());
    }

    #[test]
    fn a_shell_in_another_domain_than_all_processes_gets_the_command() {
        let one = [(11, "talker", "ROS_DOMAIN_ID=3", FAST)];
        let findings = found(&one, &[("ROS_DISTRO", "jazzy")]);
        let finding = findings
            .iter()
            .find(|each| each.check == "shell_domain")
            .unwrap();
        assert_eq!(finding.remedies[0].line, "export ROS_DOMAIN_ID=3");
        let same = found(&one, &[("ROS_DOMAIN_ID", "3")]);
        assert_eq!(sentence(&same, "shell_domain"), None);
        // A shell without ROS variables is not compared.
        assert_eq!(sentence(&found(&one, &[]), "shell_domain"), None);
    }

    #[test]
    fn a_process_with_a_participant_known_to_the_agent_belongs_to_ros() {
        let (_directory, host) = host(&[
            ("/proc/21/cmdline", "robot"),
            ("/proc/21/environ", "ROS_DOMAIN_ID=nonsense"),
            ("/proc/21/maps", ""),
        ]);
        assert_eq!(Processes::find(&host, None).count(), 0);
        let known: ParticipantList<'_> = serde_json::from_str(
            r#"{"participants":[{"domain_id":4,"process_id":21,"cgroup":"/robot","nodes":["/arm","/hand"]},
            {"domain_id":5,"process_id":22}]}"#,
        )
        .unwrap();
        let processes = Processes::find(&host, Some(&known));
        assert_eq!(processes.count(), 1);
        assert_eq!(processes.found[0].domain(), "domain 4");
        assert_eq!(processes.found[0].name(), "robot /arm (21)");
    }

    #[test]
    fn unreadable_processes_are_unknown_and_only_a_note_for_root() {
        let closed = |closed: &[u32]| Processes {
            closed: closed.to_vec(),
            ..Processes::default()
        };
        assert_eq!(closed(&[]).unseen(false), None);
        let finding = closed(&[3, 4]).unseen(false).unwrap();
        assert_eq!(
            (finding.severity, finding.remedies.len()),
            (Severity::Unknown, 1)
        );
        assert!(finding.sentence.starts_with("2 processes "));
        let finding = closed(&[3]).unseen(true).unwrap();
        assert_eq!(
            (finding.severity, finding.remedies.len()),
            (Severity::Note, 0)
        );
    }

    // Coverage: iceoryx2 | rmw_iceoryx2 | - | named
    #[test]
    fn processes_whose_messages_stay_in_unread_shared_memory_are_named() {
        const ICEORYX2: &str = "7f00-7f01 r-xp 0 fe:00 12 /ws/lib/librmw_iceoryx2_cxx.so\n";
        let findings = found(
            &[
                (11, "talker", "ROS_DOMAIN_ID=3", ICEORYX2),
                (12, "listener", "ROS_DOMAIN_ID=3", ICEORYX2),
            ],
            &[],
        );
        assert_eq!(
            sentence(&findings, "unread_rmw"),
            Some(
                "messages of iceoryx2 stay in shared memory that the agent does not read: \
                 talker (11), listener (12)"
            )
        );
        let both = found(
            &[
                (11, "talker", "ROS_DOMAIN_ID=3", ICEORYX2),
                (
                    12,
                    "camera",
                    "ROS_DOMAIN_ID=3",
                    &ICEORYX2.replace("iceoryx2_cxx", "iceoryx_cpp"),
                ),
            ],
            &[],
        );
        let both = sentence(&both, "unread_rmw").unwrap();
        assert!(
            both.starts_with("messages of iceoryx and iceoryx2 stay"),
            "{both}"
        );
        let dds = found(&[(11, "talker", "ROS_DOMAIN_ID=3", FAST)], &[]);
        assert_eq!(sentence(&dds, "unread_rmw"), None);
        assert_eq!(sentence(&dds, "agnocast"), None);
    }

    // Coverage: Agnocast | Agnocast 2 | - | named
    #[test]
    fn processes_with_agnocast_are_named() {
        let map = format!("{FAST}7f02-7f03 r-xp 0 fe:00 13 /ws/lib/libagnocast_heaphook.so\n");
        let findings = found(
            &[
                (11, "camera", "ROS_DOMAIN_ID=3", &map),
                (12, "listener", "ROS_DOMAIN_ID=3", FAST),
            ],
            &[],
        );
        let named = sentence(&findings, "agnocast").unwrap();
        assert!(named.ends_with("are visible: camera (11)"), "{named}");
        assert_eq!(sentence(&findings, "unread_rmw"), None);
    }

    #[test]
    fn a_long_hostile_command_is_truncated() {
        let long = format!("{}\x1b[2J", "a".repeat(1000));
        let findings = found(&[(11, &long, "ROS_DOMAIN_ID=\x1b[2J", FAST)], &[]);
        assert!(findings[0].sentence.len() < 80, "{}", findings[0].sentence);
    }
}
