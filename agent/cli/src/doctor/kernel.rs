//! What the kernel has of what the agent can use: its version, its types, its compiler, control
//! groups. What of the hooks really works is tried or asked for in `visibility`.

use super::finding::{Area, Finding, Verdict};
use super::host_state::{HostState, Unread};
use ros2probe_capture::cgroup::{Cgroup, CgroupError, topmost};

const AREA: Area = Area::Kernel;
const RELEASE: &str = "/proc/sys/kernel/osrelease";
const TYPES: &str = "/sys/kernel/btf/vmlinux";
const COMPILER: &str = "/proc/sys/net/core/bpf_jit_enable";
const UNPRIVILEGED: &str = "/proc/sys/kernel/unprivileged_bpf_disabled";
const LOCKDOWN: &str = "/sys/kernel/security/lockdown";
const MOUNTS: &str = "/proc/self/mountinfo";
const LIMITS: &str = "/proc/self/limits";
/// The oldest release that the filter is verified by.
const OLDEST: (u32, u32) = (5, 10);
/// From this release on BPF maps are no locked memory.
const NO_MEMLOCK: (u32, u32) = (5, 11);
/// Rings and tables of one source, with room.
const LOCKED_BYTES: u64 = 64 << 20;

/// All of them.
#[must_use]
pub fn check(host: &HostState) -> Vec<Finding> {
    let release = host.files.text(RELEASE);
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
        findings.push(locked_memory(host));
    }
    findings
}

fn version(release: &Result<String, Unread>) -> Finding {
    let report = |verdict, sentence: String| Finding::new(AREA, "version", verdict, sentence);
    match release {
        Err(error) => report(Verdict::Unknown, "the kernel version is unknown".into())
            .seen(error.to_string(), RELEASE)
            .remedy("uname -r"),
        Ok(text) => match parse(text) {
            Some(own) if own >= OLDEST => report(Verdict::Ok, format!("Linux {text}")),
            Some(_) => report(
                Verdict::Problem,
                format!("Linux {text} is too old: live capture needs 5.10 or newer"),
            )
            .remedy("rp run --replay FILE    # a capture from tcpdump works on any kernel"),
            None => report(
                Verdict::Unknown,
                format!("Linux `{text}`: version not recognised"),
            ),
        }
        .seen(text, RELEASE),
    }
}

fn types(host: &HostState) -> Finding {
    if host.files.exists(TYPES) {
        return Finding::new(
            AREA,
            "types",
            Verdict::Ok,
            "kernel type information (BTF) is available",
        )
        .seen("there", TYPES);
    }
    let sentence = "the kernel has no type information (BTF): socket owners and messages lost in \
        reassembly are unknown";
    Finding::new(AREA, "types", Verdict::Warning, sentence)
        .seen("not there", TYPES)
        .elsewhere("CONFIG_DEBUG_INFO_BTF=y    # in the kernel's configuration")
}

fn compiler(host: &HostState) -> Finding {
    let report = |verdict, sentence| Finding::new(AREA, "jit", verdict, sentence);
    match host.files.number::<u32>(COMPILER) {
        Ok(0) => report(
            Verdict::Warning,
            "BPF programs are interpreted: each packet costs several times as much",
        )
        .seen("0", COMPILER)
        .remedy("sudo sysctl -w net.core.bpf_jit_enable=1"),
        Ok(value) => {
            report(Verdict::Ok, "BPF programs are compiled (JIT)").seen(value.to_string(), COMPILER)
        }
        // Shown in the first network namespace only.
        Err(Unread::Missing) => report(
            Verdict::Ok,
            "BPF JIT status is not visible inside a container",
        )
        .seen("not there", COMPILER),
        Err(error) => report(Verdict::Unknown, "the BPF JIT status is not readable")
            .seen(error.to_string(), COMPILER)
            .remedy("sudo sysctl net.core.bpf_jit_enable"),
    }
}

fn unprivileged(host: &HostState) -> Finding {
    let report = |verdict, sentence| Finding::new(AREA, "unprivileged_bpf", verdict, sentence);
    match host.files.number::<u32>(UNPRIVILEGED) {
        Ok(0) => report(
            Verdict::Note,
            "any user may load BPF programs; the agent does not need this",
        )
        .seen("0", UNPRIVILEGED)
        .remedy("sudo sysctl -w kernel.unprivileged_bpf_disabled=1"),
        Ok(value) => report(
            Verdict::Ok,
            "unprivileged BPF is disabled; loading needs CAP_BPF",
        )
        .seen(value.to_string(), UNPRIVILEGED),
        Err(error) => report(Verdict::Ok, "loading BPF programs needs CAP_BPF")
            .seen(error.to_string(), UNPRIVILEGED),
    }
}

fn lockdown(host: &HostState) -> Option<Finding> {
    let text = host.files.text(LOCKDOWN).ok()?;
    let mode = text.split_once('[')?.1.split_once(']')?.0.to_owned();
    let (verdict, sentence) = match mode.as_str() {
        "confidentiality" => (
            Verdict::Warning,
            "the kernel is locked down for confidentiality: BPF programs may not read its \
             memory, so socket owners and causes of loss are unknown",
        ),
        "none" => (Verdict::Ok, "the kernel is not locked down"),
        _ => (
            Verdict::Ok,
            "the kernel is locked down for integrity, which does not restrict the agent",
        ),
    };
    let finding = Finding::new(AREA, "lockdown", verdict, sentence).seen(text, LOCKDOWN);
    Some(match verdict {
        Verdict::Warning => {
            finding.elsewhere("lockdown=integrity    # on the kernel's command line")
        }
        _ => finding,
    })
}

fn control_groups(host: &HostState) -> Finding {
    let report = |verdict, sentence: String| Finding::new(AREA, "cgroup", verdict, sentence);
    let mounts = host.files.bytes(MOUNTS, 1 << 20).unwrap_or_default();
    let Some(point) = topmost(&mounts) else {
        let sentence = "no cgroup v2 hierarchy is mounted: the agent can observe interfaces \
            only, not sockets";
        return report(Verdict::Warning, sentence.to_owned())
            .seen("no cgroup2", MOUNTS)
            .remedy("sudo mount -t cgroup2 none /sys/fs/cgroup");
    };
    let point = point.display().to_string();
    match Cgroup::open(&host.files.path(&point)) {
        Ok(group) if group.is_whole_host() => {
            report(Verdict::Ok, format!("cgroup v2 hierarchy of the whole host at {point}"))
        }
        Ok(_) => report(
            Verdict::Note,
            format!("{point} shows only part of the cgroup hierarchy: sockets of other \
                containers are not visible"),
        )
        .elsewhere("--cgroupns=host -v /sys/fs/cgroup:/sys/fs/cgroup:ro    # docker run; hostPath in Kubernetes"),
        Err(CgroupError::Open { source, .. }) => report(
            Verdict::Unknown,
            format!("the cgroup hierarchy at {point} cannot be opened: {source}"),
        ),
        Err(error) => report(Verdict::Warning, error.to_string()),
    }
    .seen(point, MOUNTS)
}

fn pages(host: &HostState) -> Finding {
    let kibibytes = host.page_bytes / 1024;
    let finding = match kibibytes {
        4 | 16 | 64 => Finding::new(
            AREA,
            "pages",
            Verdict::Ok,
            format!("pages of {kibibytes} KiB"),
        ),
        _ => Finding::new(
            AREA,
            "pages",
            Verdict::Unknown,
            format!("pages of {kibibytes} KiB: untested"),
        ),
    };
    finding.seen(host.page_bytes.to_string(), "sysconf(_SC_PAGESIZE)")
}

/// Of kernels that charge BPF maps to it.
fn locked_memory(host: &HostState) -> Finding {
    let report = |verdict, sentence: String| Finding::new(AREA, "memlock", verdict, sentence);
    let limits = host.files.text(LIMITS).unwrap_or_default();
    let line = limits
        .lines()
        .find_map(|line| line.strip_prefix("Max locked memory"));
    let soft = line.and_then(|line| line.split_whitespace().next());
    let finding = match soft {
        Some("unlimited") => report(Verdict::Ok, "locked memory is not limited".to_owned()),
        Some(soft) if soft.parse().is_ok_and(|soft: u64| soft >= LOCKED_BYTES) => report(
            Verdict::Ok,
            format!("{soft} bytes may be locked, enough for the agent"),
        ),
        Some(soft) => report(
            Verdict::Problem,
            format!(
                "this kernel counts BPF maps as locked memory, but only {soft} bytes may be \
                 locked here"
            ),
        )
        .remedy("ulimit -l unlimited    # the unit has LimitMEMLOCK=infinity"),
        None => report(
            Verdict::Unknown,
            "the limit of locked memory is unknown".to_owned(),
        ),
    };
    finding.seen(soft.unwrap_or("not there"), LIMITS)
}

/// Major and minor version.
fn parse(release: &str) -> Option<(u32, u32)> {
    let mut parts = release.split(['.', '-', '+']);
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    const GOOD: [(&str, &str); 6] = [
        (RELEASE, "6.8.0-31-generic\n"),
        (TYPES, "btf"),
        (COMPILER, "1\n"),
        (UNPRIVILEGED, "2\n"),
        (LOCKDOWN, "[none] integrity confidentiality\n"),
        (
            MOUNTS,
            "24 18 0:22 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n",
        ),
    ];

    fn verdicts(changes: &[(&str, &str)]) -> Vec<(&'static str, Verdict)> {
        let mut files: Vec<_> = GOOD.into();
        files.push(("/sys/fs/cgroup/cgroup.controllers", ""));
        files.retain(|(path, _)| changes.iter().all(|(changed, _)| changed != path));
        files.extend(changes.iter().filter(|(_, text)| *text != "gone"));
        let (_directory, host) = host(&files);
        let findings = check(&host);
        for finding in &findings {
            assert!(!finding.evidence.is_empty(), "{finding:?}");
            let is_bad = finding.verdict > Verdict::Unknown;
            assert!(!is_bad || !finding.remedies.is_empty(), "{finding:?}");
        }
        findings
            .iter()
            .map(|each| (each.check, each.verdict))
            .collect()
    }

    #[track_caller]
    fn gives(change: (&str, &str), check: &'static str, verdict: Verdict) {
        let found = verdicts(&[change]);
        assert!(found.contains(&(check, verdict)), "{found:?}");
    }

    #[test]
    fn a_new_kernel_with_everything_is_fine() {
        let found = verdicts(&[]);
        assert!(
            found.iter().all(|(check, verdict)| match *check {
                // A directory of a test is not the topmost group.
                "cgroup" => *verdict == Verdict::Note,
                _ => *verdict == Verdict::Ok,
            }),
            "{found:?}"
        );
        assert_eq!(found.len(), 7);
    }

    #[test]
    fn what_a_kernel_lacks_is_said() {
        gives((RELEASE, "5.4.0-42"), "version", Verdict::Problem);
        gives((RELEASE, "5.10.120-tegra"), "version", Verdict::Ok);
        gives((RELEASE, "new"), "version", Verdict::Unknown);
        gives((RELEASE, "gone"), "version", Verdict::Unknown);
        gives((TYPES, "gone"), "types", Verdict::Warning);
        gives((COMPILER, "0"), "jit", Verdict::Warning);
        gives((COMPILER, "gone"), "jit", Verdict::Ok);
        gives((UNPRIVILEGED, "0"), "unprivileged_bpf", Verdict::Note);
        let locked = "none integrity [confidentiality]";
        gives((LOCKDOWN, locked), "lockdown", Verdict::Warning);
        gives(
            (LOCKDOWN, "none [integrity] confidentiality"),
            "lockdown",
            Verdict::Ok,
        );
        gives(
            (MOUNTS, "24 18 0:22 / /sys/fs/cgroup rw - cgroup cgroup rw"),
            "cgroup",
            Verdict::Warning,
        );
    }

    #[test]
    fn locked_memory_matters_to_kernels_that_charge_it() {
        let limit =
            |value: &str| format!("Max locked memory         {value}    {value}    bytes\n");
        for (release, limit, verdict) in [
            ("5.10.0", limit("65536"), Some(Verdict::Problem)),
            ("5.10.0", limit("unlimited"), Some(Verdict::Ok)),
            ("5.10.0", limit("134217728"), Some(Verdict::Ok)),
            ("5.10.0", String::new(), Some(Verdict::Unknown)),
            ("5.11.0", limit("65536"), None),
        ] {
            let found = verdicts(&[(RELEASE, release), (LIMITS, &limit)]);
            let found = found.iter().find(|(check, _)| *check == "memlock");
            assert_eq!(
                found.map(|(_, verdict)| *verdict),
                verdict,
                "{release} {limit}"
            );
        }
    }

    #[test]
    fn pages_of_another_size_are_not_known() {
        let (_directory, mut host) = host(&[]);
        for (bytes, verdict) in [
            (4096, Verdict::Ok),
            (16384, Verdict::Ok),
            (65536, Verdict::Ok),
            (8192, Verdict::Unknown),
        ] {
            host.page_bytes = bytes;
            assert_eq!(pages(&host).verdict, verdict);
        }
    }
}
