//! Files that `make dist` creates, in the directory that `ROS2PROBE_DIST` names.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use super::program::{self, Binary};
use super::{crates, text};

/// Returns the directory. Panics for an unoptimized build, which lacks the tested properties.
fn released() -> PathBuf {
    program::directory().expect("ROS2PROBE_DIST names no release: run `make dist`")
}

#[test]
#[ignore = "looks at a release: make dist"]
fn every_file_has_its_checksum() {
    let directory = released();
    let sums = std::fs::read_to_string(directory.join("SHA256SUMS")).unwrap();
    let mut summed: BTreeSet<&str> = sums.lines().filter_map(|line| line.get(66..)).collect();
    let checked = Command::new("sha256sum")
        .args(["--check", "--strict", "--quiet", "SHA256SUMS"])
        .current_dir(&directory)
        .output()
        .unwrap();
    assert!(checked.status.success(), "{}", text(&checked.stdout));
    let version = env!("CARGO_PKG_VERSION");
    for architecture in ["x86_64", "aarch64"] {
        for end in ["", ".cdx.json"] {
            let name = format!("rp-{version}-{architecture}{end}");
            assert!(summed.remove(name.as_str()), "no {name}: {sums}");
        }
    }
    for architecture in ["amd64", "arm64"] {
        let name = format!("ros2probe_{version}_{architecture}.deb");
        assert!(summed.remove(name.as_str()), "no {name}: {sums}");
    }
    let generated = |name: &&str| name.starts_with("man/") || name.starts_with("completions/");
    assert!(
        summed.iter().all(generated) && summed.len() > 10,
        "{summed:?}"
    );
}

#[test]
#[ignore = "looks at a release: make dist"]
fn a_binary_contains_no_path_of_the_machine_that_built_it() {
    released();
    let home = std::env::var("HOME").unwrap();
    let here = ros2probe_testing::repository("").canonicalize().unwrap();
    let here = format!("{}/", here.display());
    for Binary { path, .. } in program::shipped() {
        let bytes = std::fs::read(&path).unwrap();
        for place in [
            here.as_str(),
            &format!("{home}/.cargo"),
            &format!("{home}/.rustup"),
            "registry/src",
        ] {
            let found = bytes
                .windows(place.len())
                .any(|window| window == place.as_bytes());
            assert!(!found, "{place} is in {}", path.display());
        }
    }
}

/// Returns the errors that another project's reader finds in a bill of materials; empty if it
/// follows the schema.
fn flaw(bill: &Path) -> String {
    let tools = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/tools");
    let python = tools.join("bills/bin/python");
    let script = "import sys\n\
        from cyclonedx.schema import SchemaVersion\n\
        from cyclonedx.validation.json import JsonStrictValidator\n\
        validator = JsonStrictValidator(SchemaVersion.V1_5)\n\
        print(validator.validate_str(open(sys.argv[1]).read()) or '')";
    let output = Command::new(&python)
        .args(["-c", script])
        .arg(bill)
        .output()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make dist`", python.display()));
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout).trim().to_owned()
}

#[test]
#[ignore = "looks at a release: make dist"]
fn the_bill_of_materials_lists_linked_crates_and_their_origin() {
    let directory = released();
    for Binary { architecture, .. } in program::shipped() {
        let name = format!("rp-{}-{architecture}.cdx.json", env!("CARGO_PKG_VERSION"));
        assert_eq!(flaw(&directory.join(&name)), "", "{name}");
        let bill = std::fs::read_to_string(directory.join(&name)).unwrap();
        let bill: Value = serde_json::from_str(&bill).unwrap();
        assert_eq!(bill["bomFormat"], "CycloneDX");
        let sums = std::fs::read_to_string(directory.join("SHA256SUMS")).unwrap();
        let sum = bill["metadata"]["component"]["hashes"][0]["content"]
            .as_str()
            .unwrap();
        let binary = format!("rp-{}-{architecture}", env!("CARGO_PKG_VERSION"));
        assert!(
            sums.contains(&format!("{sum}  {binary}\n")),
            "{sum} is not {binary}'s"
        );
        let components = bill["components"].as_array().unwrap();
        let text = |component: &Value, key: &str| component[key].as_str().map(str::to_owned);
        let listed: BTreeSet<String> = components
            .iter()
            .filter_map(|one| text(one, "name"))
            .collect();
        let mut linked = crates(architecture, "normal,no-proc-macro");
        linked.remove("ros2probe");
        let missing: Vec<_> = linked.difference(&listed).collect();
        assert!(missing.is_empty(), "{name}: {missing:?}");
        for component in components {
            let part = component["name"].as_str().unwrap();
            // Components of this project come from no registry.
            let own = part.starts_with("ros2probe-") || part.starts_with("agent-ebpf/");
            let from = text(component, "purl").unwrap_or_default();
            assert!(own || from.starts_with("pkg:"), "{component}");
            let sum = component["hashes"][0]["alg"].as_str();
            let summed = sum.is_some_and(|sum| ["SHA-256", "SHA-512"].contains(&sum));
            assert!(
                summed || own || component["name"] == "rust-std",
                "{component}"
            );
        }
    }
}
