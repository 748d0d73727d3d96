//! Checks of kernel features: version, BTF, BPF JIT and control groups. The `visibility` module
//! tests whether the hooks work.

use std::path::Path;

use super::cgroup::CgroupHierarchy;
use super::host_state::{HostState, ReadFailure};
use ros2probe_api::doctor::{Area, Finding, Severity};

const AREA: Area = Area::Kernel;
const RELEASE_PATH: &str = "/proc/sys/kernel/osrelease";
const BTF_PATH: &str = "/sys/kernel/btf/vmlinux";
const JIT_PATH: &str = "/proc/sys/net/core/bpf_jit_enable";
const UNPRIVILEGED_BPF_PATH: &str = "/proc/sys/kernel/unprivileged_bpf_disabled";
const LOCKDOWN_PATH: &str = "/sys/kernel/security/lockdown";
const MOUNTS_PATH: &str = "/proc/self/mountinfo";
const LIMITS_PATH: &str = "/proc/self/limits";
/// Oldest release on which the filter passes the verifier.
const OLDEST_RELEASE: (u32, u32) = (5, 10);
/// Oldest release that shows which threads ran instead of late calls.
const LATE_CAUSES: (u32, u32) = (5, 15);
/// First release that does not charge BPF maps to locked memory.
const NO_MEMLOCK: (u32, u32) = (5, 11);
/// Size of the rings and tables of one source with a margin, in bytes.
const LOCKED_BYTES: u64 = 64 << 20;

/// Returns the findings of all kernel checks. `is_agent_running`: an agent of this host answers.
#[must_use]
pub fn check(host: &HostState, is_agent_running: bool) -> Vec<Finding> {
    let release = host.files.text(RELEASE_PATH);
    let mut findings = vec![
        version(&release),
        types(host),
        compiler(host),
        unprivileged(host),
        control_groups(host),
        pages(host),
    ];
    findings.extend(lockdown(host));
    let is_old = |release: &String| parse(release).is_some_and(|own| own < NO_MEMLOCK);
    if release.as_ref().is_ok_and(is_old) {
        findings.push(locked_memory(host, is_agent_running));
    }
    findings
}

fn version(release: &Result<String, ReadFailure>) -> Finding {
    let report = |severity, sentence: String| Finding::new(AREA, "version", severity, sentence);
    match release {
        Err(error) => report(Severity::Unknown, "the kernel version is unknown".into())
            .seen(error.to_string(), RELEASE_PATH)
            .remedy("uname -r"),
        Ok(text) => match parse(text) {
            Some(own) if own >= LATE_CAUSES => report(Severity::Ok, format!("Linux {text}")),
            Some(own) if own >= OLDEST_RELEASE => report(
                Severity::Note,
                format!("Linux {text} does not show what ran instead of late calls: 5.15 does"),
            ),
            Some(_) => report(
                Severity::Problem,
                format!("Linux {text} is too old: live capture needs 5.10 or newer"),
            )
            .remedy("rp run --replay FILE    # a capture from tcpdump works on any kernel"),
            None => report(
                Severity::Unknown,
                format!("Linux `{text}`: version not recognised"),
            ),
        }
        .seen(text, RELEASE_PATH),
    }
}

fn types(host: &HostState) -> Finding {
    if host.files.exists(BTF_PATH) {
        return Finding::new(
            AREA,
            "types",
            Severity::Ok,
            "kernel type information (BTF) is available",
        )
        .seen("there", BTF_PATH);
    }
    let sentence = "the kernel has no type information (BTF): socket owners, messages lost in \
        reassembly and what ran instead of late calls are unknown";
    Finding::new(AREA, "types", Severity::Warning, sentence)
        .seen("not there", BTF_PATH)
        .elsewhere("CONFIG_DEBUG_INFO_BTF=y    # in the kernel's configuration")
}

fn compiler(host: &HostState) -> Finding {
    let report = |severity, sentence| Finding::new(AREA, "jit", severity, sentence);
    match host.files.number::<u32>(JIT_PATH) {
        Ok(0) => report(
            Severity::Warning,
            "BPF programs are interpreted: each packet costs several times as much",
        )
        .seen("0", JIT_PATH)
        .remedy("sudo sysctl -w net.core.bpf_jit_enable=1"),
        Ok(value) => report(Severity::Ok, "BPF programs are compiled (JIT)")
            .seen(value.to_string(), JIT_PATH),
        // Visible only in the initial network namespace.
        Err(ReadFailure::Missing) => report(
            Severity::Ok,
            "BPF JIT status is not visible inside a container",
        )
        .seen("not there", JIT_PATH),
        Err(error) => report(Severity::Unknown, "the BPF JIT status is not readable")
            .seen(error.to_string(), JIT_PATH)
            .remedy("sudo sysctl net.core.bpf_jit_enable"),
    }
}

fn unprivileged(host: &HostState) -> Finding {
    let report = |severity, sentence| Finding::new(AREA, "unprivileged_bpf", severity, sentence);
    match host.files.number::<u32>(UNPRIVILEGED_BPF_PATH) {
        Ok(0) => report(
            Severity::Note,
            "any user can load BPF programs; the agent does not need this",
        )
        .seen("0", UNPRIVILEGED_BPF_PATH)
        .remedy("sudo sysctl -w kernel.unprivileged_bpf_disabled=1"),
        Ok(value) => report(
            Severity::Ok,
            "unprivileged BPF is disabled; loading needs CAP_BPF",
        )
        .seen(value.to_string(), UNPRIVILEGED_BPF_PATH),
        Err(error) => report(Severity::Ok, "loading BPF programs needs CAP_BPF")
            .seen(error.to_string(), UNPRIVILEGED_BPF_PATH),
    }
}

fn lockdown(host: &HostState) -> Option<Finding> {
    let text = host.files.text(LOCKDOWN_PATH).ok()?;
    let mode = text.split_once('[')?.1.split_once(']')?.0.to_owned();
    let (severity, sentence) = match mode.as_str() {
        "confidentiality" => (
            Severity::Warning,
            "the kernel is locked down for confidentiality: BPF programs cannot read its \
             memory, so socket owners and causes of loss are unknown",
        ),
        "none" => (Severity::Ok, "the kernel is not locked down"),
        _ => (
            Severity::Ok,
            "the kernel is locked down for integrity, which does not restrict the agent",
        ),
    };
    let finding = Finding::new(AREA, "lockdown", severity, sentence).seen(text, LOCKDOWN_PATH);
    Some(match severity {
        Severity::Warning => {
            finding.elsewhere("lockdown=integrity    # on the kernel's command line")
        }
        _ => finding,
    })
}

fn control_groups(host: &HostState) -> Finding {
    let report = |severity, sentence: String| Finding::new(AREA, "cgroup", severity, sentence);
    let mounts = host.files.bytes(MOUNTS_PATH, 1 << 20).unwrap_or_default();
    let path = |point: &Path| host.files.path(&point.to_string_lossy());
    let (finding, point) = match CgroupHierarchy::find(&mounts, path) {
        hierarchy @ (CgroupHierarchy::NotMounted | CgroupHierarchy::Version1) => {
            let sentence = "no cgroup v2 hierarchy is mounted: the agent can observe interfaces \
                only, not sockets";
            let finding =
                report(Severity::Warning, sentence.to_owned()).seen("no cgroup2", MOUNTS_PATH);
            if hierarchy == CgroupHierarchy::NotMounted {
                return finding.remedy("sudo mount -t cgroup2 none /sys/fs/cgroup");
            }
            // A mount at the usual path would hide the controllers of version 1.
            return finding
                .remedy(
                    "sudo mkdir -p /run/cgroup2 && sudo mount -t cgroup2 none /run/cgroup2    \
                     # beside version 1; then sudo systemctl restart ros2probe",
                )
                .elsewhere(
                    "systemd.unified_cgroup_hierarchy=1    # on the kernel's command line, for \
                     good",
                );
        }
        CgroupHierarchy::WholeHost(point) => {
            let at = point.display();
            let sentence = format!("cgroup v2 hierarchy of the whole host at {at}");
            (report(Severity::Ok, sentence), point)
        }
        CgroupHierarchy::Part(point) => {
            let at = point.display();
            let sentence = format!(
                "{at} shows only part of the cgroup hierarchy: sockets of other containers are \
                 not visible"
            );
            let note = report(Severity::Note, sentence);
            (note.elsewhere("--cgroupns=host -v /sys/fs/cgroup:/sys/fs/cgroup:ro    # docker run; hostPath in Kubernetes"), point)
        }
        CgroupHierarchy::Unopened(point, reason) => {
            let at = point.display();
            let sentence = format!("the cgroup hierarchy at {at} cannot be opened: {reason}");
            (report(Severity::Unknown, sentence), point)
        }
        CgroupHierarchy::Invalid(point, reason) => (report(Severity::Warning, reason), point),
    };
    finding.seen(point.display().to_string(), MOUNTS_PATH)
}

fn pages(host: &HostState) -> Finding {
    let kibibytes = host.page_bytes / 1024;
    let finding = match kibibytes {
        4 | 16 | 64 => Finding::new(
            AREA,
            "pages",
            Severity::Ok,
            format!("pages of {kibibytes} KiB"),
        ),
        _ => Finding::new(
            AREA,
            "pages",
            Severity::Unknown,
            format!("pages of {kibibytes} KiB: untested"),
        ),
    };
    finding.seen(host.page_bytes.to_string(), "sysconf(_SC_PAGESIZE)")
}

/// Returns the finding for the limit on locked memory, on kernels that charge BPF maps to it. A
/// running agent has a limit of its own.
fn locked_memory(host: &HostState, is_agent_running: bool) -> Finding {
    let severity = match is_agent_running {
        true => Severity::Note,
        false => Severity::Problem,
    };
    let report = |severity, sentence: String| Finding::new(AREA, "memlock", severity, sentence);
    let limits = host.files.text(LIMITS_PATH).unwrap_or_default();
    let line = limits
        .lines()
        .find_map(|line| line.strip_prefix("Max locked memory"));
    let soft = line.and_then(|line| line.split_whitespace().next());
    let finding = match soft {
        Some("unlimited") => report(Severity::Ok, "locked memory is not limited".to_owned()),
        Some(soft) if soft.parse().is_ok_and(|soft: u64| soft >= LOCKED_BYTES) => report(
            Severity::Ok,
            format!("{soft} bytes may be locked, enough for the agent"),
        ),
        Some(soft) => report(
            severity,
            format!(
                "this kernel counts BPF maps as locked memory, but only {soft} bytes may be \
                 locked in this shell"
            ),
        )
        .remedy("ulimit -l unlimited    # the unit has LimitMEMLOCK=infinity"),
        None => report(
            Severity::Unknown,
            "the limit of locked memory is unknown".to_owned(),
        ),
    };
    finding.seen(soft.unwrap_or("not there"), LIMITS_PATH)
}

/// Parses the major and minor version of a release.
fn parse(release: &str) -> Option<(u32, u32)> {
    let mut parts = release.split(['.', '-', '+']);
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    const GOOD: [(&str, &str); 6] = [
        (RELEASE_PATH, "6.8.0-31-generic\n"),
        (BTF_PATH, "btf"),
        (JIT_PATH, "1\n"),
        (UNPRIVILEGED_BPF_PATH, "2\n"),
        (LOCKDOWN_PATH, "[none] integrity confidentiality\n"),
        (
            MOUNTS_PATH,
            "24 18 0:22 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n",
        ),
    ];

    fn severities(changes: &[(&str, &str)]) -> Vec<(String, Severity)> {
        let mut files: Vec<_> = GOOD.into();
        files.push(("/sys/fs/cgroup/cgroup.controllers", ""));
        files.retain(|(path, _)| changes.iter().all(|(changed, _)| changed != path));
        files.extend(changes.iter().filter(|(_, text)| *text != "gone"));
        let (_directory, host) = host(&files);
        let findings = check(&host, false);
        for finding in &findings {
            assert!(!finding.evidence.is_empty(), "{finding:?}");
            let is_bad = finding.severity > Severity::Unknown;
            assert!(!is_bad || !finding.remedies.is_empty(), "{finding:?}");
        }
        findings
            .iter()
            .map(|each| (each.check.to_string(), each.severity))
            .collect()
    }

    #[track_caller]
    fn gives(change: (&str, &str), check: &str, severity: Severity) {
        let found = severities(&[change]);
        assert!(found.contains(&(check.to_owned(), severity)), "{found:?}");
    }

    #[test]
    fn a_new_kernel_with_all_features_passes_every_check() {
        let found = severities(&[]);
        assert!(
            found.iter().all(|(check, severity)| match check.as_str() {
                // A test's directory is not the root control group.
                "cgroup" => *severity == Severity::Note,
                _ => *severity == Severity::Ok,
            }),
            "{found:?}"
        );
        assert_eq!(found.len(), 7);
    }

    #[test]
    fn missing_kernel_features_are_reported() {
        gives((RELEASE_PATH, "5.4.0-42"), "version", Severity::Problem);
        gives((RELEASE_PATH, "5.10.120-tegra"), "version", Severity::Note);
        gives((RELEASE_PATH, "5.15.0-91"), "version", Severity::Ok);
        gives((RELEASE_PATH, "new"), "version", Severity::Unknown);
        gives((RELEASE_PATH, "gone"), "version", Severity::Unknown);
        gives((BTF_PATH, "gone"), "types", Severity::Warning);
        gives((JIT_PATH, "0"), "jit", Severity::Warning);
        gives((JIT_PATH, "gone"), "jit", Severity::Ok);
        gives(
            (UNPRIVILEGED_BPF_PATH, "0"),
            "unprivileged_bpf",
            Severity::Note,
        );
        let locked = "none integrity [confidentiality]";
        gives((LOCKDOWN_PATH, locked), "lockdown", Severity::Warning);
        gives(
            (LOCKDOWN_PATH, "none [integrity] confidentiality"),
            "lockdown",
            Severity::Ok,
        );
        gives(
            (
                MOUNTS_PATH,
                "24 18 0:22 / /sys/fs/cgroup rw - cgroup cgroup rw",
            ),
            "cgroup",
            Severity::Warning,
        );
    }

    #[test]
    fn the_limit_on_locked_memory_is_checked_on_kernels_that_charge_it() {
        let limit =
            |value: &str| format!("Max locked memory         {value}    {value}    bytes\n");
        for (release, limit, severity) in [
            ("5.10.0", limit("65536"), Some(Severity::Problem)),
            ("5.10.0", limit("unlimited"), Some(Severity::Ok)),
            ("5.10.0", limit("134217728"), Some(Severity::Ok)),
            ("5.10.0", String::new(), Some(Severity::Unknown)),
            ("5.11.0", limit("65536"), None),
        ] {
            let found = severities(&[(RELEASE_PATH, release), (LIMITS_PATH, &limit)]);
            let found = found.iter().find(|(check, _)| *check == "memlock");
            assert_eq!(
                found.map(|(_, severity)| *severity),
                severity,
                "{release} {limit}"
            );
        }
    }

    #[test]
    fn a_low_limit_on_locked_memory_is_not_a_problem_if_an_agent_runs() {
        let (_directory, host) = host(&[
            (RELEASE_PATH, "5.10.0"),
            (
                LIMITS_PATH,
                "Max locked memory         65536    65536    bytes\n",
            ),
        ]);
        assert_eq!(locked_memory(&host, true).severity, Severity::Note);
    }

    #[test]
    fn a_version_2_mount_hides_no_controller_of_version_1() {
        for (mounts, place) in [
            (
                "24 18 0:22 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu",
                "/run/cgroup2",
            ),
            ("24 18 0:22 / / rw - ext4 /dev/vda rw", "/sys/fs/cgroup"),
        ] {
            let (_directory, host) = host(&[(MOUNTS_PATH, mounts)]);
            let remedies = control_groups(&host).remedies;
            let mount = format!("mount -t cgroup2 none {place}");
            assert!(remedies[0].line.ends_with(&mount), "{}", remedies[0].line);
        }
    }

    #[test]
    fn an_unsupported_page_size_leads_to_unknown() {
        let (_directory, mut host) = host(&[]);
        for (bytes, severity) in [
            (4096, Severity::Ok),
            (16384, Severity::Ok),
            (65536, Severity::Ok),
            (8192, Severity::Unknown),
        ] {
            host.page_bytes = bytes;
            assert_eq!(pages(&host).severity, severity);
        }
    }
}
