//! The shipped Prometheus rules: promtool understands them, they say what they should, and every
//! metric they read exists.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe::surface::catalogue::{CATALOGUE, Kind};

const INSTALL: &str =
    "promtool is missing: run `make prerequisites` or `apt-get install prometheus`";

fn rules() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../dashboards/rules")
}

fn promtool(arguments: &[&str]) -> Result<()> {
    let output = Command::new("promtool")
        .args(arguments)
        .current_dir(rules())
        .output()
        .context(INSTALL)?;
    let said = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{said}{failed}");
    Ok(())
}

#[test]
fn promtool_understands_every_rule() -> Result<()> {
    promtool(&[
        "check",
        "rules",
        "--lint=all",
        "--lint-fatal",
        "ros2probe.rules.yaml",
    ])
}

#[test]
fn the_rules_find_the_losses_of_invented_robots() -> Result<()> {
    promtool(&["test", "rules", "ros2probe.test.yaml"])
}

#[test]
fn every_metric_in_the_rules_and_their_tests_is_in_the_catalogue() -> Result<()> {
    let mut names = BTreeSet::new();
    for metric in CATALOGUE {
        names.insert(metric.name.to_owned());
        if metric.kind == Kind::Histogram {
            names
                .extend(["_bucket", "_sum", "_count"].map(|part| format!("{}{part}", metric.name)));
        }
    }
    let mut read = 0;
    for file in ["ros2probe.rules.yaml", "ros2probe.test.yaml"] {
        let text = std::fs::read_to_string(rules().join(file))?;
        let text: String = text
            .lines()
            .filter(|line| !line.trim_start().starts_with('#'))
            .flat_map(|line| [line, "\n"])
            .collect();
        // What holds a colon is recorded by a rule, and promtool's tests ask for it.
        let word = |c: char| !(c.is_ascii_alphanumeric() || matches!(c, '_' | ':'));
        for name in text.split(word) {
            if name.starts_with("ros2_") && !name.contains(':') {
                ensure!(names.contains(name), "{file} reads {name}");
                read += 1;
            }
        }
    }
    ensure!(read > 20, "{read} metrics found");
    Ok(())
}
