//! The shipped units are hardened, and systemd accepts them without complaint.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The units of the agent and of deliveries.
const UNITS: [&str; 2] = ["ros2probe.service", "ros2probe-ship.service"];

fn unit() -> PathBuf {
    named("ros2probe.service")
}

fn named(unit: &str) -> PathBuf {
    let units = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../systemd");
    units.join(unit)
}

fn systemd_analyze(arguments: &[&str], unit: &Path) -> Output {
    Command::new("systemd-analyze")
        .args(arguments)
        .arg(unit)
        .output()
        .unwrap_or_else(|error| panic!("systemd-analyze: {error}; `apt-get install systemd`"))
}

/// `make test` omits this test with an older systemd (`.ci/prerequisites.sh --left-out`).
#[test]
fn the_exposure_level_is_at_most_1_5() {
    for name in UNITS {
        let level = exposure(&named(name));
        assert!(level <= 1.5, "{name}: {level}");
    }
}

/// `make test` omits this test likewise.
#[test]
fn the_exposure_level_of_the_broker_is_the_documented_one() {
    let level = exposure(&named("ros2probe-attach.service"));
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/shared-memory.md");
    let page = std::fs::read_to_string(page).unwrap();
    let stated = format!("an exposure level of {level:.1}.");
    assert!(page.contains(&stated), "{stated}");
}

fn exposure(unit: &Path) -> f64 {
    let output = systemd_analyze(&["security", "--offline=true", "--no-pager"], unit);
    let refused = String::from_utf8_lossy(&output.stderr);
    assert!(
        !refused.contains("unrecognized option"),
        "scoring a unit that is not installed needs systemd 250: {refused}"
    );
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    let level = printed.lines().find_map(|line| {
        let (_, level) = line.split_once("Overall exposure level for ")?;
        level.split_whitespace().nth(1)?.parse::<f64>().ok()
    });
    level.unwrap_or_else(|| panic!("no level in\n{printed}"))
}

#[test]
fn systemd_accepts_every_line_of_the_units() {
    let directory = tempfile::tempdir().unwrap();
    for name in UNITS {
        let copy = directory.path().join(name);
        let text = std::fs::read_to_string(named(name)).unwrap();
        std::fs::write(&copy, text.replace("/usr/bin/rp", env!("CARGO_BIN_EXE_rp"))).unwrap();
        accepts(&copy);
    }
}

#[test]
fn systemd_accepts_the_lines_that_the_unit_and_the_package_offer() {
    let directory = tempfile::tempdir().unwrap();
    let copy = directory.path().join("ros2probe.service");
    let text = std::fs::read_to_string(unit()).unwrap();
    let offered = text.lines().filter_map(|line| line.strip_prefix("#     "));
    let offered: Vec<_> = offered.collect();
    assert!(offered.len() > 12, "{offered:?}");
    let run = text.replace("/usr/bin/rp", env!("CARGO_BIN_EXE_rp"));
    std::fs::write(&copy, format!("{run}\n{}\n", offered.join("\n"))).unwrap();
    accepts(&copy);
    // The package's drop-in for interfaces has the same lines as the comment.
    let package = unit().with_file_name("../packaging/interfaces.conf");
    let package = std::fs::read_to_string(package).unwrap();
    let lines = package.lines().filter(|line| !line.starts_with('#'));
    let lines: Vec<_> = lines.collect();
    let start = offered.iter().position(|line| *line == lines[1]).unwrap();
    assert_eq!(offered[start - 1..][..lines.len()], lines);
}

fn accepts(unit: &Path) {
    let output = systemd_analyze(&["verify", "--man=no"], unit);
    let printed = String::from_utf8_lossy(&output.stderr);
    // Messages about other units on the machine are ignored.
    let ours: Vec<&str> = printed
        .lines()
        .filter(|line| line.contains("ros2probe"))
        .collect();
    assert!(ours.is_empty(), "{printed}");
}

#[test]
fn each_claim_of_the_threat_model_names_tests_that_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let places = [
        "agent/cli/tests",
        "agent/cli/src",
        "agent/daemon/src",
        "agent/model/tests",
        "wire/src",
        "wire/tests",
    ];
    // A module and its integration tests may have one name.
    let sources = |file: &str| -> Vec<String> {
        let mut paths: Vec<_> = places
            .iter()
            .map(|place| root.join(place).join(format!("{file}.rs")))
            .collect();
        // `message/library` is a file of the crate in `agent/message`.
        if let Some((krate, file)) = file.split_once('/') {
            let folders =
                ["src", "tests"].map(|folder| root.join("agent").join(krate).join(folder));
            paths.extend(folders.map(|folder| folder.join(format!("{file}.rs"))));
        }
        let sources = paths.iter().map(std::fs::read_to_string);
        sources.filter_map(Result::ok).collect()
    };
    let is_test = |source: &str, function: &str| {
        let at = source.find(&format!("fn {function}("));
        let before = at.and_then(|at| source.get(..at)).unwrap_or_default();
        // Attributes stand between the last item and the function.
        let lines = before.lines().rev().take(4).map(str::trim);
        let mut attributes = lines.take_while(|line| !line.starts_with('}'));
        attributes.any(|line| line.starts_with("#[test]") || line.starts_with("#[tokio::test"))
    };
    let model = std::fs::read_to_string(root.join("SECURITY.md")).unwrap();
    let (mut claims, mut named, mut is_claim) = (0, 0, false);
    for line in model.lines() {
        is_claim = line == "| claim | shown by |" || is_claim && line.starts_with('|');
        let row = line
            .strip_prefix("| ")
            .and_then(|row| row.strip_suffix(" |"));
        let Some((claim, tests)) = row.and_then(|row| row.rsplit_once(" | ")) else {
            continue;
        };
        if !is_claim || tests == "shown by" || claim.starts_with("---") {
            continue;
        }
        claims += 1;
        let tests: Vec<_> = tests.split('`').skip(1).step_by(2).collect();
        assert!(!tests.is_empty(), "no test shows: {claim}");
        for test in tests {
            let (file, function) = test.split_once("::").unwrap_or_default();
            let exists = sources(file).iter().any(|source| is_test(source, function));
            assert!(exists, "SECURITY.md names {test}, which is no test");
            named += 1;
        }
    }
    assert!(
        claims > 40 && named > 60,
        "{named} tests of {claims} claims"
    );
}

#[test]
fn the_unit_grants_exactly_the_privileges_that_the_agent_needs() {
    let text = std::fs::read_to_string(unit()).unwrap();
    for set in ["CapabilityBoundingSet", "AmbientCapabilities"] {
        let line = format!("\n{set}=CAP_NET_ADMIN CAP_BPF CAP_PERFMON\n");
        assert!(text.contains(&line), "{set}");
    }
    for line in [
        "Type=notify",
        "LimitMEMLOCK=infinity",
        "Before=network.target",
        "Restart=always",
        "StartLimitIntervalSec=0",
        "User=ros2probe",
        "Group=ros2probe",
        "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6",
        "RestrictRealtime=yes",
        "SystemCallFilter=bpf capset seccomp",
        "UMask=0077",
        "StateDirectoryMode=0750",
        "NoNewPrivileges=yes",
        "IPAddressDeny=any",
        "IPAddressAllow=localhost link-local 10.0.0.0/8 172.16.0.0/12 192.168.0.0/16 100.64.0.0/10 fc00::/7",
    ] {
        assert!(text.lines().any(|other| other == line), "{line}");
    }
}

/// A 32-bit systemd takes `native` for its own architecture.
#[test]
fn the_package_can_permit_a_foreign_architecture_in_every_service() {
    let packaging = unit().with_file_name("../packaging");
    let read = |name: &str| std::fs::read_to_string(packaging.join(name)).unwrap();
    let lines = read("foreign-architecture.conf");
    assert!(lines.ends_with("\n[Service]\nSystemCallArchitectures=arm64\n"));
    let (install, remove) = (read("scripts/postinst"), read("scripts/postrm"));
    let directory = tempfile::tempdir().unwrap();
    let mut services = 0;
    for entry in unit().parent().unwrap().read_dir().unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        let Some(stem) = name.strip_suffix(".service") else {
            continue;
        };
        let text = std::fs::read_to_string(named(&name)).unwrap();
        assert!(
            text.contains("\nSystemCallArchitectures=native\n"),
            "{name}"
        );
        assert!(install.contains(&format!(" {name}")), "{name}");
        assert!(remove.contains(&format!(" {stem}")), "{name}");
        services += 1;
        if UNITS.contains(&name.as_str()) {
            let copy = directory.path().join(&name);
            let run = text.replace("/usr/bin/rp", env!("CARGO_BIN_EXE_rp"));
            std::fs::write(&copy, format!("{run}\n{lines}")).unwrap();
            accepts(&copy);
        }
    }
    assert_eq!(services, 3);
}

/// systemd before 247 ignores `LoadCredential=`: without its file, the agent does not start.
#[test]
fn each_document_with_a_credential_names_the_file_for_an_older_systemd() {
    let root = unit().with_file_name("..");
    for document in ["systemd/ros2probe.service", "docs/security.md"] {
        let text = std::fs::read_to_string(root.join(document)).unwrap();
        let (_, after) = text.split_once("LoadCredential=").expect(document);
        assert!(after.contains("systemd before 247"), "{document}");
    }
    for document in ["docs/foxglove.md", "docs/security.md"] {
        let text = std::fs::read_to_string(root.join(document)).unwrap();
        let (_, after) = text.split_once("/run/credentials/").expect(document);
        assert!(after.contains("(install-jetson.md"), "{document}");
    }
    let page = std::fs::read_to_string(root.join("docs/install-jetson.md")).unwrap();
    for part in [
        "token_file: /etc/ros2probe/token",
        "install -m 0640 -o root -g ros2probe",
    ] {
        assert!(page.contains(part), "{part}");
    }
}
