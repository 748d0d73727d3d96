//! The shipped Prometheus rules: promtool accepts them, their tests pass, and every metric in them
//! exists. Every alert names the remedy, and has tests in which it fires and in which it does not.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_metrics::catalogue::{CATALOGUE, Kind};
use serde_yaml::Value;

const INSTALL: &str =
    "promtool is missing: run `make prerequisites` or `apt-get install prometheus`";

/// Names of rule groups, which look like names of metrics.
const GROUPS: [&str; 6] = [
    "ros2probe_agent",
    "ros2probe_topics",
    "ros2probe_graph",
    "ros2probe_between_hosts",
    "ros2probe_by_cause",
    "ros2probe_by_topic",
];

fn rules() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dashboards/rules")
}

fn promtool(arguments: &[&str]) -> Result<()> {
    let output = Command::new("promtool")
        .args(arguments)
        .current_dir(rules())
        .output()
        .context(INSTALL)?;
    let printed = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{printed}{failed}");
    Ok(())
}

#[test]
fn promtool_accepts_every_rule() -> Result<()> {
    promtool(&[
        "check",
        "rules",
        "--lint=all",
        "--lint-fatal",
        "ros2probe.rules.yaml",
        "ros2probe.alerts.yaml",
    ])
}

#[test]
fn the_rules_compute_the_losses_of_simulated_robots() -> Result<()> {
    promtool(&["test", "rules", "ros2probe.test.yaml"])
}

#[test]
fn alerts_fire_only_on_their_symptoms() -> Result<()> {
    promtool(&["test", "rules", "ros2probe.alerts.test.yaml"])
}

#[test]
fn every_alert_has_a_severity_a_summary_and_a_remedy() -> Result<()> {
    for alert in alerts()? {
        let name = alert["alert"].as_str().context("no name")?;
        let severity = alert["labels"]["severity"].as_str().unwrap_or_default();
        ensure!(
            ["critical", "warning", "info"].contains(&severity),
            "{name}: severity {severity:?}"
        );
        let annotation = |key: &str| alert["annotations"][key].as_str().unwrap_or_default();
        let (summary, description) = (annotation("summary"), annotation("description"));
        ensure!(
            summary.contains("{{ $labels.instance }}") && !summary.ends_with('.'),
            "{name}: {summary:?} does not name the robot"
        );
        ensure!(
            description.len() > 80 && description.ends_with('.'),
            "{name}: {description:?}"
        );
    }
    Ok(())
}

#[test]
fn every_alert_has_tests_in_which_it_fires_and_does_not_fire() -> Result<()> {
    let tests = yaml("ros2probe.alerts.test.yaml")?;
    let tests = tests["tests"].as_sequence().context("no tests")?;
    for alert in alerts()? {
        let name = alert["alert"].as_str().context("no name")?;
        let own = tests.iter().find(|test| test["name"] == name);
        let asked = own.and_then(|test| test["promql_expr_test"].as_sequence());
        let asked = asked.with_context(|| format!("{name} has no test"))?;
        let answers: Vec<usize> = asked
            .iter()
            .filter(|one| one["expr"].as_str().is_some_and(|expr| expr.contains(name)))
            .filter_map(|one| Some(one["exp_samples"].as_sequence()?.len()))
            .collect();
        ensure!(
            answers.contains(&0) && answers.contains(&1),
            "{name}: {answers:?}"
        );
    }
    Ok(())
}

#[test]
fn the_readme_lists_every_alert() -> Result<()> {
    let readme = std::fs::read_to_string(rules().join("../README.md"))?;
    for alert in alerts()? {
        let name = alert["alert"].as_str().context("no name")?;
        ensure!(
            readme.contains(&format!("`{name}`")),
            "{name} is not in the README"
        );
    }
    Ok(())
}

fn alerts() -> Result<Vec<Value>> {
    let file = yaml("ros2probe.alerts.yaml")?;
    let groups = file["groups"].as_sequence().context("no groups")?;
    let rules = groups
        .iter()
        .filter_map(|group| group["rules"].as_sequence());
    let alerts: Vec<Value> = rules.flatten().cloned().collect();
    ensure!(alerts.len() > 15, "{} alerts", alerts.len());
    Ok(alerts)
}

fn yaml(file: &str) -> Result<Value> {
    Ok(serde_yaml::from_str(&std::fs::read_to_string(
        rules().join(file),
    )?)?)
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
    for file in [
        "ros2probe.rules.yaml",
        "ros2probe.test.yaml",
        "ros2probe.alerts.yaml",
        "ros2probe.alerts.test.yaml",
    ] {
        let text = std::fs::read_to_string(rules().join(file))?;
        let text: String = text
            .lines()
            .filter(|line| !line.trim_start().starts_with('#'))
            .flat_map(|line| [line, "\n"])
            .collect();
        // A name with a colon belongs to a recording rule, which the tests of promtool cover.
        let word = |c: char| !(c.is_ascii_alphanumeric() || matches!(c, '_' | ':'));
        for name in text.split(word) {
            let of_ours = ["ros2_", "ros2probe_"]
                .iter()
                .any(|start| name.starts_with(start));
            if of_ours && !name.contains(':') && !GROUPS.contains(&name) {
                ensure!(names.contains(name), "{file} reads {name}");
                read += 1;
            }
        }
    }
    ensure!(read > 20, "{read} metrics found");
    Ok(())
}
