//! The Debian package: its content, and the state of a host after it was installed, upgraded,
//! removed and purged, with systemd and without.
//!
//! The tested package is made of the tests' own binary. If `ROS2PROBE_PACKAGES` names a directory,
//! its packages are tested instead. Hosts are containers of a fresh Debian, which
//! `.ci/prerequisites.sh test` creates. Their writes go to memory.

pub(crate) mod installation;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use installation::archive::Archive;
use installation::debian::{Debian, Start};
use installation::{all, built, changed, given, installable};
use ros2probe_testing::harness::wait_until;

const CONFIG: &str = "/etc/ros2probe/ros2probe.yaml";
const RUNS: &str = "systemctl is-active ros2probe.service";
const EXIT: &str = "systemctl show --property ExecMainStatus --value ros2probe";
/// All lines that were written before.
const JOURNAL: &str = "journalctl --sync && journalctl --unit ros2probe --no-pager --output cat";
const STARTS_AT_BOOT: &str = "systemctl is-enabled ros2probe.service";

#[test]
fn the_package_contains_what_an_operator_expects() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut packages = given()?;
    if packages.is_empty() {
        packages.push(built(directory.path(), &["--fast"])?);
    }
    for package in packages {
        let archive = Archive::open(&package)?;
        complete(&archive).with_context(|| format!("{}", package.display()))?;
    }
    Ok(())
}

#[test]
fn the_same_binary_yields_the_same_package() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut made = Vec::new();
    for place in ["once", "again/elsewhere"] {
        let place = directory.path().join(place);
        made.push(std::fs::read(built(&place, &["--fast"])?)?);
    }
    ensure!(made[0] == made[1], "the packages differ");
    Ok(())
}

#[test]
fn a_host_with_systemd_runs_the_agent_until_the_package_is_purged() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let old = installable(directory.path())?;
    let new = changed(&old, directory.path())?;
    let host = Debian::start(Start::Systemd, directory.path())?;
    let (old, new) = (inside(&old)?, inside(&new)?);
    let upgrade = format!("dpkg --force-confold --install {new}");

    host.run(&format!("dpkg --install {old}"))?;
    the_service_runs_as_its_user(&host)?;
    an_older_systemd_gives_the_privileges_of_both_sources(&host)?;
    only_the_drop_in_for_interfaces_permits_the_wire_source(&host, &old)?;
    a_service_without_any_source_ends_with_the_missing_lines(&host)?;
    the_socket_admits_the_group_only(&host)?;
    doctor_applies_only_the_remedy_that_the_user_accepts(&host)?;
    an_upgrade_keeps_the_operators_configuration(&host, &upgrade)?;
    check_disabled_service(&host, &old, &upgrade)?;
    a_wrong_configuration_fails_the_service_only(&host, &upgrade)?;

    host.run("dpkg --remove ros2probe")?;
    prints(&host, RUNS, "inactive")?;
    host.run(&format!(
        "test -e {CONFIG} && test -d /var/lib/ros2probe && ! test -e /usr/bin/rp"
    ))?;
    host.run(&upgrade)?;
    prints(&host, RUNS, "active")?;
    prints(&host, STARTS_AT_BOOT, "enabled")?;
    host.run("dpkg --purge ros2probe")?;
    check_no_files(&host)
}

/// Fails unless the command prints this, whatever its exit code.
fn prints(host: &Debian, command: &str, expected: &str) -> Result<()> {
    let printed = host.text(command)?;
    ensure!(
        printed.trim() == expected,
        "{command}: {printed}, not {expected}"
    );
    Ok(())
}

/// Returns the service's process id as `systemctl` prints it, with the line break.
fn main_process(host: &Debian) -> Result<String> {
    host.run("systemctl show --property MainPID --value ros2probe")
}

fn the_service_runs_as_its_user(host: &Debian) -> Result<()> {
    prints(host, RUNS, "active")?;
    prints(host, STARTS_AT_BOOT, "enabled")?;
    ensure!(host.run("dpkg --verify ros2probe")?.is_empty());
    let page = host.get(17400, "/metrics")?;
    ensure!(page.contains("ros2probe_capture_source_info{"), "{page}");
    let others = "find /var/lib/ros2probe /run/ros2probe ! -user ros2probe";
    ensure!(host.run(others)?.is_empty(), "{}", host.run(others)?);
    let owner = format!("stat -c %U /proc/{}", main_process(host)?.trim());
    prints(host, &owner, "ros2probe")
}

/// Checks the drop-in for systemd before 247.
fn an_older_systemd_gives_the_privileges_of_both_sources(host: &Debian) -> Result<()> {
    host.run(
        "mkdir /run/systemd/system/ros2probe.service.d && \
         cp /usr/share/ros2probe/systemd-before-247.conf /run/systemd/system/ros2probe.service.d/ && \
         systemctl daemon-reload && systemctl restart ros2probe",
    )?;
    prints(host, RUNS, "active")?;
    let process = main_process(host)?;
    let process = process.trim();
    prints(host, &format!("stat -c %U /proc/{process}"), "ros2probe")?;
    let bounds = host.run(&format!("grep CapBnd /proc/{process}/status"))?;
    ensure!(bounds.trim().ends_with("\t000000c000003000"), "{bounds}");
    host.run("rm -r /run/systemd/system/ros2probe.service.d && systemctl daemon-reload")
        .map(drop)
}

/// Returns whether this kernel observes interfaces without `CAP_NET_RAW` (Linux 6.6).
fn has_tcx() -> Result<bool> {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease")?;
    let mut numbers = release.split('.').map_while(|number| number.parse().ok());
    let version: Option<(u32, u32)> = numbers.next().zip(numbers.next());
    Ok(version.context(release.clone())? >= (6, 6))
}

/// Checks that the error has the missing lines. An installation links the drop-in on a host without
/// control groups of version 2, and removes it elsewhere.
fn only_the_drop_in_for_interfaces_permits_the_wire_source(
    host: &Debian,
    package: &str,
) -> Result<()> {
    const DROP_IN: &str = "/usr/lib/systemd/system/ros2probe.service.d/interfaces.conf";
    let install = format!("dpkg --install {package}");
    host.run(&format!(
        "cp --preserve {CONFIG} /srv/before.yaml; sed -i 's/^  # source: auto .*/  source: wire/' {CONFIG}"
    ))?;
    host.text("systemctl restart ros2probe")?;
    prints(host, EXIT, "77")?;
    let log = host.run(JOURNAL)?;
    let families = "RestrictAddressFamilies=AF_PACKET AF_NETLINK";
    ensure!(log.contains(families), "no {families} in {log}");
    let asks = log.contains("CapabilityBoundingSet=CAP_NET_RAW");
    ensure!(asks != has_tcx()?, "{log}");
    host.run(&format!(
        "unshare --mount sh -c 'umount --all --types cgroup2 && {install}' && test -L {DROP_IN}"
    ))?;
    prints(host, RUNS, "active")?;
    let page = host.get(17400, "/metrics")?;
    let source = "ros2probe_capture_source_info{source=\"wire\",reason=\"\"} 1";
    ensure!(page.contains(source), "{page}");
    host.run(&format!(
        "cp --preserve /srv/before.yaml {CONFIG}; rm /srv/before.yaml; {install} && ! test -e {DROP_IN}"
    ))?;
    prints(host, RUNS, "active")
}

/// Checks a service that reaches neither sockets nor interfaces: its path is no control group.
fn a_service_without_any_source_ends_with_the_missing_lines(host: &Debian) -> Result<()> {
    host.run(&format!(
        "cp --preserve {CONFIG} /srv/before.yaml; \
         sed -i 's/^  # source: auto .*/  cgroup: \\/usr/' {CONFIG}"
    ))?;
    host.text("systemctl restart ros2probe")?;
    prints(host, EXIT, "77")?;
    let log = host.run(JOURNAL)?;
    let line = match has_tcx()? {
        true => "RestrictAddressFamilies=",
        false => "CapabilityBoundingSet=CAP_NET_RAW",
    };
    let lines = format!("; to observe interfaces instead, the unit needs `{line}");
    ensure!(log.contains(&lines), "{log}");
    host.run(&format!(
        "cp --preserve /srv/before.yaml {CONFIG}; rm /srv/before.yaml; \
         systemctl restart ros2probe"
    ))?;
    prints(host, RUNS, "active")
}

/// Checks access to the socket while `api.listen` is off.
fn the_socket_admits_the_group_only(host: &Debian) -> Result<()> {
    host.run(&format!(
        "sed -i 's/^  # listen: 127.0.0.1:17401/  listen: off/' {CONFIG}; systemctl restart ros2probe"
    ))?;
    host.run("useradd --groups ros2probe member; useradd stranger")?;
    let list = |user: &str| {
        let ids = format!("--reuid {user} --regid {user} --init-groups");
        host.run_script(&format!("setpriv {ids} rp topic list"))
    };
    ensure!(
        list("member")?.status.success(),
        "{}",
        all(&list("member")?)
    );
    ensure!(
        all(&list("stranger")?).contains("usermod -aG ros2probe"),
        "{}",
        all(&list("stranger")?)
    );
    Ok(())
}

/// Runs `rp doctor --fix` on a terminal as sudo does for the user `stranger`. Accepts the membership
/// of the group alone, and prints the terminal.
const ACCEPT_MEMBERSHIP: &str = r#"
import os, pty, sys
child, terminal = pty.fork()
if child == 0:
    os.environ["SUDO_USER"] = "stranger"
    os.execvp("rp", ["rp", "doctor", "--fix"])
text = ""
while True:
    try:
        part = os.read(terminal, 4096)
    except OSError:
        break
    if not part:
        break
    text += part.decode(errors="replace")
    if text.endswith("Apply it? [y/N] "):
        offer = text.rsplit("\r\n\r\n", 1)[-1]
        is_membership = "usermod -aG ros2probe stranger" in offer
        os.write(terminal, b"y\n" if is_membership else b"n\n")
print(text.replace("\r", ""))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"#;

/// Checks that each remedy is shown before the question, and that the accepted one works at once.
fn doctor_applies_only_the_remedy_that_the_user_accepts(host: &Debian) -> Result<()> {
    let printed = host.run(&format!("python3 - <<'END'{ACCEPT_MEMBERSHIP}END"))?;
    let accepted = "  usermod -aG ros2probe stranger\n  stranger has to log in again\n\
                    Apply it? [y/N] y\n  done\n";
    ensure!(printed.contains(accepted), "{printed}");
    let questions = printed.matches("Apply it?").count();
    let skipped = printed.matches("n\n  skipped\n").count();
    ensure!(questions == skipped + 1, "{printed}");
    host.run(
        "! test -e /etc/sysctl.d/90-ros2probe.conf && \
         ! test -e /etc/systemd/system/ros2probe.service.d && \
         setpriv --reuid stranger --regid stranger --init-groups rp topic list",
    )?;
    // The membership is offered once.
    let offered = host.run(&format!("python3 - <<'END'{ACCEPT_MEMBERSHIP}END"))?;
    ensure!(!offered.contains("usermod"), "{offered}");
    Ok(())
}

/// Upgrades while both the default and the operator's file have changed.
fn an_upgrade_keeps_the_operators_configuration(host: &Debian, upgrade: &str) -> Result<()> {
    let before = main_process(host)?;
    host.run(upgrade)?;
    prints(host, RUNS, "active")?;
    let after = main_process(host)?;
    ensure!(before != after, "the service was not restarted");
    host.run(&format!(
        "grep -q 'listen: off' {CONFIG} && grep -q changed {CONFIG}.dpkg-dist"
    ))
    .map(drop)
}

/// Checks that a downgrade and an upgrade keep the operator's choice.
fn check_disabled_service(host: &Debian, old: &str, upgrade: &str) -> Result<()> {
    host.run("systemctl stop ros2probe")?;
    host.run(&format!("dpkg --force-confold --install {old}"))?;
    prints(host, RUNS, "inactive")?;
    prints(host, STARTS_AT_BOOT, "enabled")?;
    host.run("systemctl disable --now ros2probe")?;
    host.run(upgrade)?;
    prints(host, RUNS, "inactive")?;
    prints(host, STARTS_AT_BOOT, "disabled")
}

/// Checks that the upgrade succeeds and prints the mistake. After a correction, the service starts.
fn a_wrong_configuration_fails_the_service_only(host: &Debian, upgrade: &str) -> Result<()> {
    host.run(&format!(
        "systemctl enable --now ros2probe; cp {CONFIG} /srv/; echo wach: [] >>{CONFIG}"
    ))?;
    let output = host.run_script(upgrade)?;
    ensure!(
        output.status.success() && all(&output).contains("wach: unknown key"),
        "{}",
        all(&output)
    );
    prints(
        host,
        "dpkg-query -W -f '${db:Status-Status}' ros2probe",
        "installed",
    )?;
    prints(host, RUNS, "failed")?;
    host.run(&format!(
        "cp /srv/ros2probe.yaml {CONFIG}; rm /srv/ros2probe.yaml"
    ))?;
    host.run(upgrade)?;
    prints(host, RUNS, "active")
}

#[test]
fn a_host_without_systemd_accepts_the_package() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let old = installable(directory.path())?;
    let new = changed(&old, directory.path())?;
    let host = Debian::start(Start::Nothing, directory.path())?;
    let (old, new) = (inside(&old)?, inside(&new)?);

    host.run(&format!("dpkg --install {old}"))?;
    host.run("test -L /etc/systemd/system/multi-user.target.wants/ros2probe.service")?;
    ensure!(host.run("stat -c '%U:%G %a' /var/lib/ros2probe")?.trim() == "ros2probe:ros2probe 750");
    let user = host.run("getent passwd ros2probe")?;
    ensure!(
        user.trim()
            .ends_with("/var/lib/ros2probe:/usr/sbin/nologin"),
        "{user}"
    );
    host.run(&format!("rp check-config {CONFIG}"))?;
    host.run("bash -uc '. /usr/share/bash-completion/completions/rp && complete -p rp'")?;
    serves_with_the_rights_of_the_unit(&host)?;
    a_package_of_another_architecture_may_run_in_each_unit(&host)?;

    host.run(&format!("echo '# mine' >>{CONFIG}"))?;
    host.run(&format!("dpkg --force-confold --install {new}"))?;
    host.run(&format!(
        "grep -q mine {CONFIG} && test -e {CONFIG}.dpkg-dist"
    ))?;
    // A package of the host's own architecture removes the drop-ins, as a removal does.
    host.run("! ls /usr/lib/systemd/system | grep 'ros2probe.*\\.d$'")?;
    a_package_of_another_architecture_may_run_in_each_unit(&host)?;
    host.run("dpkg --remove ros2probe")?;
    host.run(&format!("test -e {CONFIG} && test -d /var/lib/ros2probe"))?;
    host.run("dpkg --purge ros2probe")?;
    check_no_files(&host)
}

/// Configures the package as if it were of another architecture. Earlier, a 32-bit systemd ended the
/// arm64 binary at its start, as its `native` is another architecture.
fn a_package_of_another_architecture_may_run_in_each_unit(host: &Debian) -> Result<()> {
    host.run(
        "DPKG_MAINTSCRIPT_PACKAGE=ros2probe DPKG_MAINTSCRIPT_ARCH=another \
         /var/lib/dpkg/info/ros2probe.postinst configure",
    )?;
    for unit in ["ros2probe", "ros2probe-attach", "ros2probe-ship"] {
        host.run(&format!(
            "grep -qx SystemCallArchitectures=arm64 \
             /usr/lib/systemd/system/{unit}.service.d/foreign-architecture.conf"
        ))?;
    }
    Ok(())
}

/// Checks that a purge leaves only the user and dpkg's own records.
fn check_no_files(host: &Debian) -> Result<()> {
    let left = host.run(
        "find / -xdev \\( -path /proc -o -path /sys -o -path /packages -o -path /var/log \\) -prune \
         -o \\( -name '*ros2probe*' -o -path '/usr/share/man/*/rp*' \\) -print",
    )?;
    ensure!(left.is_empty(), "left behind:\n{left}");
    host.run("getent passwd ros2probe && getent group ros2probe")
        .map(drop)
}

/// Runs the agent with the unit's user and capabilities on a host without systemd. Root owns none
/// of the files that the agent writes.
fn serves_with_the_rights_of_the_unit(host: &Debian) -> Result<()> {
    let unit = host.run("cat /usr/lib/systemd/system/ros2probe.service")?;
    let setting = |key: &str| {
        let line = unit.lines().find_map(|line| line.strip_prefix(key));
        line.with_context(|| format!("no {key} in the unit"))
    };
    let (user, group) = (setting("User=")?, setting("Group=")?);
    let capabilities: Vec<String> = setting("AmbientCapabilities=")?
        .split_whitespace()
        .map(|name| name.replace("CAP_", "+").to_lowercase())
        .collect();
    let only = format!("-all,{}", capabilities.join(","));
    let command = setting("ExecStart=")?;
    host.run("install -d -o ros2probe -g ros2probe /run/ros2probe; touch /srv/before")?;
    host.run(&format!(
        "(STATE_DIRECTORY=/var/lib/ros2probe RUNTIME_DIRECTORY=/run/ros2probe setpriv --reuid {user} \
         --regid {group} --clear-groups --inh-caps {only} --ambient-caps {only} --bounding-set {only} \
         {command} & echo $! >/tmp/pid; wait $!; echo $? >/tmp/ended) >/tmp/log 2>&1 &"
    ))?;
    wait_until("ready", || {
        Ok(host
            .get(17400, "/readyz")
            .is_ok_and(|output_text| output_text.contains("200 OK")))
    })
    .with_context(|| host.text("cat /tmp/log").unwrap_or_default())?;
    host.run("kill $(cat /tmp/pid)")?;
    wait_until("ended", || Ok(host.text("cat /tmp/ended")?.trim() == "0"))
        .with_context(|| host.text("cat /tmp/log").unwrap_or_default())?;
    host.run("test -e /var/lib/ros2probe/discovery.json")?;
    let written = host.run(
        "find / -xdev \\( -path /proc -o -path /sys -o -path /dev -o -path /packages \\) -prune \
         -o -newer /srv/before ! -type d ! -path '/tmp/*' -user root -print",
    )?;
    ensure!(written.is_empty(), "root owns what was written:\n{written}");
    Ok(())
}

/// Returns a package's path in a container.
fn inside(package: &Path) -> Result<String> {
    let name = package.file_name().context("no name")?;
    Ok(format!("/packages/{}", name.to_string_lossy()))
}

fn complete(archive: &Archive) -> Result<()> {
    fields_and_scripts_are_complete(archive)?;
    check_files(archive)?;
    let manual = "usr/share/man/man1/rp-topic-hz.1.gz";
    archive.manual_is_readable(manual)?;
    archive.compressed_without_dates()
}

fn fields_and_scripts_are_complete(archive: &Archive) -> Result<()> {
    let control = &archive.control;
    let field = |name: &str| control.get(name).map(String::as_str);
    ensure!(field("Package") == Some("ros2probe"), "{control:?}");
    ensure!(
        field("Version") == Some(env!("CARGO_PKG_VERSION")),
        "{control:?}"
    );
    ensure!(
        matches!(field("Architecture"), Some("amd64" | "arm64")),
        "{control:?}"
    );
    ensure!(field("Depends") == Some("adduser"), "{control:?}");
    for name in [
        "Maintainer",
        "Description",
        "Section",
        "Homepage",
        "Installed-Size",
    ] {
        ensure!(field(name).is_some(), "no {name} in {control:?}");
    }
    ensure!(
        archive.conffiles == format!("{CONFIG}\n"),
        "{}",
        archive.conffiles
    );
    // The dpkg of Ubuntu 20.04 cannot read members compressed with zstd.
    for member in &archive.members {
        ensure!(
            member == "debian-binary" || !member.ends_with(".zst"),
            "{member}"
        );
    }
    for script in ["preinst", "postinst", "prerm", "postrm"] {
        let mode = archive.scripts.get(script).copied();
        ensure!(mode == Some(0o755), "{script}: {mode:?}");
    }
    Ok(())
}

/// Checks that each file has its mode and that root owns all of them.
fn check_files(archive: &Archive) -> Result<()> {
    let manual = "usr/share/man/man1/";
    let (pages, others): (BTreeMap<_, _>, BTreeMap<_, _>) = archive
        .files
        .iter()
        .partition(|(path, _)| path.starts_with(manual));
    for (path, mode) in FILES {
        let entry = others
            .get(&path.to_owned())
            .with_context(|| format!("no {path}"))?;
        ensure!(entry.mode == mode, "{path}: {:o}", entry.mode);
    }
    let book = book()?;
    for path in &book {
        let entry = others.get(path).with_context(|| format!("no {path}"))?;
        ensure!(entry.mode == 0o644, "{path}: {:o}", entry.mode);
    }
    let unexpected: Vec<_> = others
        .keys()
        .filter(|path| FILES.iter().all(|(known, _)| path.as_str() != *known))
        .filter(|path| !book.contains(path))
        .filter(|path| !path.ends_with("/SECURITY.md"))
        .collect();
    ensure!(unexpected.is_empty(), "not expected: {unexpected:?}");
    for (path, entry) in &archive.files {
        ensure!(entry.owner == "0/0", "{path} is {}", entry.owner);
    }
    for page in [
        "rp.1.gz",
        "rp-run.1.gz",
        "rp-topic-hz.1.gz",
        "rp-bag-record.1.gz",
    ] {
        ensure!(pages.contains_key(&format!("{manual}{page}")), "no {page}");
    }
    for (path, entry) in &pages {
        ensure!(
            entry.mode == 0o644 && path.ends_with(".1.gz"),
            "{path}: {:o}",
            entry.mode
        );
    }
    Ok(())
}

/// Returns the path in the package of each page of `docs/`. The README links to these pages.
fn book() -> Result<Vec<String>> {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    let mut pages = Vec::new();
    for entry in std::fs::read_dir(docs)? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if name.ends_with(".md") {
            pages.push(format!("usr/share/doc/ros2probe/docs/{name}"));
        }
    }
    ensure!(pages.len() > 30, "{} pages", pages.len());
    Ok(pages)
}

const FILES: [(&str, u32); 23] = [
    ("etc/ros2probe/ros2probe.yaml", 0o644),
    ("usr/bin/rp", 0o755),
    ("usr/lib/systemd/system/ros2probe-attach.service", 0o644),
    ("usr/lib/systemd/system/ros2probe-attach.socket", 0o644),
    ("usr/lib/systemd/system/ros2probe-ship.service", 0o644),
    ("usr/lib/systemd/system/ros2probe.service", 0o644),
    ("usr/share/bash-completion/completions/rp", 0o644),
    ("usr/share/doc/ros2probe/CHANGELOG.md.gz", 0o644),
    ("usr/share/doc/ros2probe/README.md", 0o644),
    ("usr/share/doc/ros2probe/changelog.gz", 0o644),
    ("usr/share/doc/ros2probe/copyright", 0o644),
    ("usr/share/doc/ros2probe/libraries.gz", 0o644),
    ("usr/share/fish/vendor_completions.d/rp.fish", 0o644),
    ("usr/share/lintian/overrides/ros2probe", 0o644),
    ("usr/share/ros2probe/dashboards/fleet.json", 0o644),
    ("usr/share/ros2probe/dashboards/robot.json", 0o644),
    ("usr/share/ros2probe/foreign-architecture.conf", 0o644),
    ("usr/share/ros2probe/interfaces.conf", 0o644),
    ("usr/share/ros2probe/ros2probe.schema.json", 0o644),
    ("usr/share/ros2probe/rules/ros2probe.alerts.yaml", 0o644),
    ("usr/share/ros2probe/rules/ros2probe.rules.yaml", 0o644),
    ("usr/share/ros2probe/systemd-before-247.conf", 0o644),
    ("usr/share/zsh/vendor-completions/_rp", 0o644),
];
