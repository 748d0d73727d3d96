//! Capabilities that each source and each thread need, and dropping the rest.

use std::fmt;

use rustix::io::Errno;
use rustix::thread::{
    CapabilitySet, CapabilitySets, capabilities, capability_is_in_ambient_set,
    capability_is_in_bounding_set, clear_ambient_capability_set,
    remove_capability_from_bounding_set, set_capabilities,
};

use crate::config::{CaptureSettings, SourceChoice, WireChoice};
use ros2probe_capture::container::{FAMILIES_LINE, is_container, is_service};
use ros2probe_capture::tcx;

/// Capabilities for attaching programs to a cgroup (`CAP_NET_ADMIN`), for loading them (`CAP_BPF`),
/// and for tracepoints and iterators (`CAP_PERFMON`). `CAP_PERFMON` also skips Spectre barriers in
/// the verifier, with which Linux 5.15 to 6.8 refuses the filter.
const HOST_CAPABILITIES: [CapabilitySet; 3] = [
    CapabilitySet::NET_ADMIN,
    CapabilitySet::BPF,
    CapabilitySet::PERFMON,
];

/// Capabilities for packet sockets (`CAP_NET_RAW`); the others are as for the host's sockets. Programs
/// at tcx need those of [`HOST_CAPABILITIES`].
const WIRE_CAPABILITIES: [CapabilitySet; 3] = [
    CapabilitySet::NET_RAW,
    CapabilitySet::BPF,
    CapabilitySet::PERFMON,
];

/// Capabilities that a live capture lacks.
#[derive(Debug, PartialEq, Eq)]
pub struct Missing {
    /// Each possible source with its missing capabilities.
    sources: Vec<(SourceChoice, Vec<CapabilitySet>)>,
    /// Capabilities that cover the whole configuration.
    grant: Vec<CapabilitySet>,
}

/// Privileges could not be dropped.
#[derive(Debug, thiserror::Error)]
#[error("cannot drop privileges")]
pub struct DropError(#[from] Errno);

/// Proof that the calling thread has no capability and can gain none. Serving HTTP requires it.
#[derive(Debug)]
pub struct Unprivileged(());

/// The calling thread still has privileges.
#[derive(Debug, thiserror::Error)]
pub enum CapabilitiesRemain {
    /// Capabilities are left in a set.
    #[error("refusing to serve: {left} left in the {set} set after dropping all capabilities")]
    Capabilities {
        /// Names of the capabilities.
        left: String,
        /// Name of the set.
        set: &'static str,
    },
    /// An executed program could gain capabilities.
    #[error("refusing to serve: no_new_privs is not set")]
    MayGain,
    /// A set cannot be read.
    #[error("refusing to serve: cannot read the remaining capabilities")]
    Unreadable(#[source] Errno),
    /// `no_new_privs` cannot be read.
    #[error("refusing to serve: cannot read no_new_privs")]
    Unknown(#[source] Errno),
}

/// Makes the permitted capabilities of the calling thread effective, and returns them. The file of
/// the container's image permits capabilities that are not effective when it starts.
///
/// # Errors
///
/// Fails if the kernel does not report the capabilities.
pub fn raise() -> Result<CapabilitySet, Errno> {
    let mut sets = capabilities(None)?;
    if sets.effective != sets.permitted {
        sets.effective = sets.permitted;
        set_capabilities(None, sets)?;
    }
    Ok(sets.effective)
}

/// Raises and checks the capabilities that `settings` require. If the agent selects the source, the
/// capabilities of one possible source suffice.
///
/// # Errors
///
/// Returns the missing capabilities. If they cannot be read, opening the sockets reports
/// the error.
pub fn check(settings: &CaptureSettings) -> Result<(), Missing> {
    let Ok(effective) = raise() else {
        return Ok(());
    };
    missing(effective, settings).map_or(Ok(()), Err)
}

/// Returns the capabilities that a process with the `effective` ones lacks; `None` if it has all.
/// If the agent selects how to observe interfaces, those for packet sockets suffice. The result
/// names those for tcx where the kernel has it.
#[must_use]
pub fn missing(effective: CapabilitySet, settings: &CaptureSettings) -> Option<Missing> {
    missing_on(effective, settings, tcx::is_supported())
}

fn missing_on(
    effective: CapabilitySet,
    settings: &CaptureSettings,
    has_tcx: bool,
) -> Option<Missing> {
    let missing = missing_for(effective, settings)?;
    if settings.wire != WireChoice::Auto || !has_tcx {
        return Some(missing);
    }
    let at_tcx = CaptureSettings {
        wire: WireChoice::Tcx,
        ..settings.clone()
    };
    missing_for(effective, &at_tcx)
}

/// Returns the missing capabilities, with packet sockets at interfaces unless `settings` require
/// tcx.
fn missing_for(effective: CapabilitySet, settings: &CaptureSettings) -> Option<Missing> {
    // `CAP_SYS_ADMIN`, which is older and wider, includes its successors.
    let inherited = match effective.contains(CapabilitySet::SYS_ADMIN) {
        true => CapabilitySet::BPF | CapabilitySet::PERFMON,
        false => CapabilitySet::empty(),
    };
    let has = |capability: &CapabilitySet| (effective | inherited).contains(*capability);
    let mut sources = Vec::new();
    let mut grant = Vec::new();
    for (source, needed) in candidates(settings) {
        let lacking = needed.iter().copied().filter(|one| !has(one)).collect();
        sources.push((source, lacking));
        let new = needed.into_iter().filter(|one| !grant.contains(one));
        grant.extend(new.collect::<Vec<_>>());
    }
    let able = |(_, lacking): &(_, Vec<_>)| lacking.is_empty();
    (!sources.iter().any(able)).then_some(Missing { sources, grant })
}

/// Returns the sources that `settings` allow, each with the capabilities that it needs.
fn candidates(settings: &CaptureSettings) -> Vec<(SourceChoice, Vec<CapabilitySet>)> {
    let named = !settings.include_interfaces.is_empty() || !settings.exclude_interfaces.is_empty();
    let mirrors = !settings.mirror_interfaces.is_empty();
    let entering = (!settings.network_namespaces.is_empty()).then_some(CapabilitySet::SYS_ADMIN);
    let at_tcx = settings.wire == WireChoice::Tcx;
    let of_wire = if at_tcx {
        HOST_CAPABILITIES
    } else {
        WIRE_CAPABILITIES
    };
    let wire = || of_wire.into_iter().chain(entering).collect();
    let host = || {
        let packets = [(!at_tcx).then_some(CapabilitySet::NET_RAW), entering];
        let packets = packets.into_iter().flatten().filter(|_| mirrors);
        HOST_CAPABILITIES.into_iter().chain(packets).collect()
    };
    match settings.source {
        SourceChoice::Host => vec![(SourceChoice::Host, host())],
        SourceChoice::Auto if !named => {
            vec![(SourceChoice::Host, host()), (SourceChoice::Wire, wire())]
        }
        SourceChoice::Auto | SourceChoice::Wire => vec![(SourceChoice::Wire, wire())],
    }
}

/// Drops all capabilities of the calling thread except `kept`, and clears its bounding set if
/// permitted. Without that permission, the thread can gain nothing from the bounding set.
pub(super) fn keep(kept: CapabilitySet) -> Result<(), DropError> {
    let sets = capabilities(None)?;
    if sets.effective.contains(CapabilitySet::SETPCAP) {
        for (_, capability) in CapabilitySet::all().iter_names() {
            if capability_is_in_bounding_set(capability)? {
                remove_capability_from_bounding_set(capability)?;
            }
        }
    }
    clear_ambient_capability_set()?;
    let kept = sets.permitted & kept;
    set_capabilities(
        None,
        CapabilitySets {
            effective: kept,
            permitted: kept,
            inheritable: CapabilitySet::empty(),
        },
    )?;
    Ok(())
}

/// Returns the names of the capabilities in a set, sorted.
#[must_use]
pub fn capability_names(set: CapabilitySet) -> Vec<String> {
    let named = set.iter_names().map(|(name, _)| format!("CAP_{name}"));
    let mut names: Vec<_> = named.collect();
    names.sort();
    names
}

/// Returns the capabilities in the calling thread's ambient set.
fn ambient() -> Result<CapabilitySet, Errno> {
    let mut ambient = CapabilitySet::empty();
    for (_, capability) in CapabilitySet::all().iter_names() {
        ambient.set(capability, capability_is_in_ambient_set(capability)?);
    }
    Ok(ambient)
}

impl Unprivileged {
    /// Verifies that the calling thread has no privileges.
    ///
    /// # Errors
    ///
    /// Fails if a privilege is left or cannot be read.
    pub fn verify() -> Result<Self, CapabilitiesRemain> {
        let sets = capabilities(None).map_err(CapabilitiesRemain::Unreadable)?;
        let ambient = ambient().map_err(CapabilitiesRemain::Unreadable)?;
        for (set, left) in [
            ("Effective", sets.effective),
            ("Permitted", sets.permitted),
            ("Inheritable", sets.inheritable),
            ("Ambient", ambient),
        ] {
            if !left.is_empty() {
                let left = capability_names(left).join(", ");
                return Err(CapabilitiesRemain::Capabilities { left, set });
            }
        }
        match rustix::thread::no_new_privs() {
            Ok(true) => Ok(Self(())),
            Ok(false) => Err(CapabilitiesRemain::MayGain),
            Err(error) => Err(CapabilitiesRemain::Unknown(error)),
        }
    }
}

impl Missing {
    /// Returns a text about the capabilities that each source lacks.
    #[must_use]
    pub fn missing_text(&self) -> String {
        let text = |lacking: &[CapabilitySet]| {
            let names = lacking.iter().copied().flat_map(capability_names);
            names.collect::<Vec<_>>().join(", ")
        };
        if let [(one, lacking), (other, same)] = self.sources.as_slice()
            && lacking == same
        {
            let (lacking, one, other) = (text(lacking), one.label(), other.label());
            return format!("{lacking} for the source `{one}` or `{other}`");
        }
        let needs = self.sources.iter();
        let needs = needs.map(|(source, lacking)| {
            format!("{} for the source `{}`", text(lacking), source.label())
        });
        needs.collect::<Vec<_>>().join(", or ")
    }

    /// Returns the command that grants the capabilities to this program.
    #[must_use]
    pub fn command(&self) -> String {
        let grant = self.grant.iter().copied().flat_map(capability_names);
        let grant: Vec<_> = grant.map(|name| name.to_lowercase()).collect();
        let program = std::env::current_exe();
        let program = program.map_or_else(|_| "rp".to_owned(), |path| path.display().to_string());
        format!("sudo setcap {}+ep {program}", grant.join(","))
    }

    /// Returns what grants the capabilities of the first possible source to a container, or why
    /// this process does not have those of its container.
    #[must_use]
    pub fn in_container(&self) -> String {
        let withheld = |one| capability_is_in_bounding_set(one).unwrap_or(false);
        let no_new_privs = rustix::thread::no_new_privs().unwrap_or(false);
        self.container_text(withheld, no_new_privs)
    }

    fn container_text(
        &self,
        is_granted: impl Fn(CapabilitySet) -> bool,
        no_new_privs: bool,
    ) -> String {
        let lacking = self.sources.first().map_or(&[][..], |(_, lacking)| lacking);
        let names: Vec<_> = lacking.iter().copied().flat_map(capability_names).collect();
        let options = names
            .iter()
            .map(|name| format!("--cap-add {}", name.trim_start_matches("CAP_")));
        let options: Vec<_> = options.collect();
        let remedy = match lacking.iter().copied().all(is_granted) {
            true if no_new_privs => "remove --security-opt no-new-privileges".to_owned(),
            true => "add --user 0:65532".to_owned(),
            false => format!("add {}", options.join(" ")),
        };
        let verb = if names.len() == 1 { "is" } else { "are" };
        format!("{} {verb} missing: {remedy}", names.join(", "))
    }

    /// Returns the ways in which a user gets the capabilities.
    fn in_shell(&self) -> String {
        format!(
            "live capture needs {}: run `{}`, use sudo, or start the service ros2probe",
            self.missing_text(),
            self.command(),
        )
    }

    /// Returns the lines that grant the capabilities to a unit of systemd.
    fn in_unit(&self) -> String {
        let names: Vec<_> = self
            .grant
            .iter()
            .copied()
            .flat_map(capability_names)
            .collect();
        let names = names.join(" ");
        let bounds = format!("`CapabilityBoundingSet={names}`");
        let more = match self.grant.contains(&CapabilitySet::NET_RAW) {
            true => format!(", {bounds} and `{FAMILIES_LINE}`"),
            false => format!(" and {bounds}"),
        };
        format!(
            "live capture needs {}: the unit needs `AmbientCapabilities={names}`{more} \
             (`systemctl edit`)",
            self.missing_text()
        )
    }
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if is_container() {
            return f.write_str(&self.in_container());
        }
        if is_service() {
            return f.write_str(&self.in_unit());
        }
        f.write_str(&self.in_shell())
    }
}

impl std::error::Error for Missing {}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::config::Config;

    fn set(capabilities: &[CapabilitySet]) -> CapabilitySet {
        capabilities.iter().copied().collect()
    }

    fn settings(source: SourceChoice) -> CaptureSettings {
        CaptureSettings {
            source,
            ..Config::default().capture
        }
    }

    /// Returns what is missing on a kernel without tcx.
    fn missing(effective: CapabilitySet, settings: &CaptureSettings) -> Option<Missing> {
        missing_on(effective, settings, false)
    }

    fn lacks(has: &[CapabilitySet], settings: &CaptureSettings) -> Vec<Vec<CapabilitySet>> {
        let missing = missing(set(has), settings);
        let sources = missing.map_or_else(Vec::new, |missing| missing.sources);
        sources.into_iter().map(|(_, lacking)| lacking).collect()
    }

    #[test]
    fn three_capabilities_are_enough_for_either_source() {
        let nothing: [Vec<CapabilitySet>; 0] = [];
        let auto = settings(SourceChoice::Auto);
        assert_eq!(
            lacks(&HOST_CAPABILITIES, &settings(SourceChoice::Host)),
            nothing
        );
        assert_eq!(
            lacks(&WIRE_CAPABILITIES, &settings(SourceChoice::Wire)),
            nothing
        );
        assert_eq!(lacks(&HOST_CAPABILITIES, &auto), nothing);
        assert_eq!(lacks(&WIRE_CAPABILITIES, &auto), nothing);
        assert_eq!(lacks(&[], &auto), [HOST_CAPABILITIES, WIRE_CAPABILITIES]);
        assert_eq!(
            lacks(&WIRE_CAPABILITIES, &settings(SourceChoice::Host)),
            [[CapabilitySet::NET_ADMIN]]
        );
        assert_eq!(
            lacks(&HOST_CAPABILITIES, &settings(SourceChoice::Wire)),
            [[CapabilitySet::NET_RAW]]
        );
    }

    #[test]
    fn the_daemon_set_grants_exactly_the_capabilities_of_the_host_source() {
        let manifest = include_str!("../../../../deploy/kubernetes/ros2probe.yaml");
        let mut lines = manifest.lines().map(str::trim);
        let added = lines.find_map(|line| line.strip_prefix("add: [")?.strip_suffix(']'));
        let added = added.unwrap().split(", ");
        let added: CapabilitySet = added
            .map(|name| CapabilitySet::from_name(name).unwrap())
            .collect();
        assert_eq!(added, set(&HOST_CAPABILITIES));
    }

    #[test]
    fn settings_for_more_interfaces_or_namespaces_require_more_capabilities() {
        let named = CaptureSettings {
            include_interfaces: vec!["eth0".to_owned()],
            ..settings(SourceChoice::Auto)
        };
        assert_eq!(
            lacks(&HOST_CAPABILITIES, &named),
            [[CapabilitySet::NET_RAW]]
        );
        let mirroring = CaptureSettings {
            mirror_interfaces: vec!["mirror0".to_owned()],
            ..settings(SourceChoice::Host)
        };
        assert_eq!(
            lacks(&HOST_CAPABILITIES, &mirroring),
            [[CapabilitySet::NET_RAW]]
        );
        let entering = CaptureSettings {
            network_namespaces: vec![PathBuf::from("/run/netns/a")],
            ..settings(SourceChoice::Wire)
        };
        assert_eq!(
            lacks(&WIRE_CAPABILITIES, &entering),
            [[CapabilitySet::SYS_ADMIN]]
        );
        let at_tcx = |settings: &CaptureSettings| CaptureSettings {
            wire: WireChoice::Tcx,
            ..settings.clone()
        };
        for settings in [&named, &mirroring] {
            assert!(lacks(&HOST_CAPABILITIES, &at_tcx(settings)).is_empty());
        }
        assert_eq!(
            lacks(&WIRE_CAPABILITIES, &at_tcx(&named)),
            [[CapabilitySet::NET_ADMIN]]
        );
        let old = [CapabilitySet::NET_RAW, CapabilitySet::SYS_ADMIN];
        assert!(lacks(&old, &entering).is_empty());
    }

    #[test]
    fn where_the_kernel_has_tcx_no_error_names_the_capability_of_packet_sockets() {
        let lacks = |has: &[CapabilitySet], settings: &CaptureSettings| {
            missing_on(set(has), settings, true)
        };
        let auto = settings(SourceChoice::Auto);
        let wire = settings(SourceChoice::Wire);
        let missing = lacks(&HOST_CAPABILITIES[1..], &auto).unwrap();
        assert_eq!(
            missing.missing_text(),
            "CAP_NET_ADMIN for the source `host` or `wire`"
        );
        assert!(
            missing
                .command()
                .contains("cap_net_admin,cap_bpf,cap_perfmon+ep "),
            "{}",
            missing.command()
        );
        let missing = lacks(&[CapabilitySet::BPF], &wire).unwrap();
        assert_eq!(
            missing.missing_text(),
            "CAP_NET_ADMIN, CAP_PERFMON for the source `wire`"
        );
        // Either of the two ways suffices.
        for has in [HOST_CAPABILITIES, WIRE_CAPABILITIES] {
            assert_eq!(lacks(&has, &wire), None);
        }
        let packets = CaptureSettings {
            wire: WireChoice::Packet,
            ..wire
        };
        let missing = lacks(&HOST_CAPABILITIES, &packets).unwrap();
        assert_eq!(missing.missing_text(), "CAP_NET_RAW for the source `wire`");
    }

    #[test]
    fn in_a_container_the_error_is_one_option_of_its_engine() {
        let has = |capabilities| missing(set(capabilities), &settings(SourceChoice::Auto)).unwrap();
        let bpf = has(&[CapabilitySet::NET_ADMIN, CapabilitySet::PERFMON]);
        let text = |missing: &Missing, granted: bool, no_new_privs: bool| {
            missing.container_text(|_| granted, no_new_privs)
        };
        assert_eq!(
            text(&bpf, false, false),
            "CAP_BPF is missing: add --cap-add BPF"
        );
        assert_eq!(
            text(&bpf, true, true),
            "CAP_BPF is missing: remove --security-opt no-new-privileges"
        );
        assert_eq!(
            text(&bpf, true, false),
            "CAP_BPF is missing: add --user 0:65532"
        );
        assert_eq!(
            text(&has(&[CapabilitySet::NET_ADMIN]), false, true),
            "CAP_BPF, CAP_PERFMON are missing: add --cap-add BPF --cap-add PERFMON"
        );
    }

    #[test]
    fn a_unit_gets_the_lines_that_grant_the_capabilities() {
        let missing = missing(set(&HOST_CAPABILITIES[1..]), &settings(SourceChoice::Host)).unwrap();
        assert_eq!(
            missing.in_unit(),
            "live capture needs CAP_NET_ADMIN for the source `host`: the unit needs \
             `AmbientCapabilities=CAP_NET_ADMIN CAP_BPF CAP_PERFMON` and \
             `CapabilityBoundingSet=CAP_NET_ADMIN CAP_BPF CAP_PERFMON` (`systemctl edit`)"
        );
        let missing =
            self::missing(set(&WIRE_CAPABILITIES[1..]), &settings(SourceChoice::Wire)).unwrap();
        assert_eq!(
            missing.in_unit(),
            "live capture needs CAP_NET_RAW for the source `wire`: the unit needs \
             `AmbientCapabilities=CAP_NET_RAW CAP_BPF CAP_PERFMON`, \
             `CapabilityBoundingSet=CAP_NET_RAW CAP_BPF CAP_PERFMON` and \
             `RestrictAddressFamilies=AF_PACKET AF_NETLINK` (`systemctl edit`)"
        );
        let unit = include_str!("../../../../systemd/ros2probe.service");
        assert!(unit.contains(&format!("#     {FAMILIES_LINE}\n")));
    }

    #[test]
    fn permitted_capabilities_become_effective() {
        let raised = std::thread::spawn(|| {
            let sets = capabilities(None).unwrap();
            let lowered = CapabilitySets {
                effective: CapabilitySet::empty(),
                ..sets
            };
            set_capabilities(None, lowered).unwrap();
            (raise().unwrap(), sets.permitted)
        });
        let (raised, permitted) = raised.join().unwrap();
        assert!(!permitted.is_empty(), "this takes root: run `make test`");
        assert_eq!(raised, permitted);
    }

    #[test]
    fn the_error_names_the_missing_capabilities_and_the_command_that_grants_them() {
        let has = set(&[CapabilitySet::BPF, CapabilitySet::PERFMON]);
        let missing = missing(has, &settings(SourceChoice::Auto)).unwrap();
        let message = missing.in_shell();
        assert!(
            message.starts_with(
                "live capture needs CAP_NET_ADMIN for the source `host`, or CAP_NET_RAW for the \
                 source `wire`: "
            ),
            "{message}"
        );
        assert!(
            message.contains("sudo setcap cap_net_admin,cap_bpf,cap_perfmon,cap_net_raw+ep /"),
            "{message}"
        );
    }
}
