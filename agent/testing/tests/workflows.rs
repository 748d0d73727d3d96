//! The public workflows follow their schema, run targets of the Makefile, and need no secret.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::fs;
use std::process::Command;

use ros2probe_testing::repository;

fn read(path: &str) -> String {
    fs::read_to_string(repository(path)).unwrap()
}

/// Asserts that a workflow or an action follows the schema of its kind.
fn validate(schema: &str, path: &str) {
    let program = repository("target/tools/workflows/bin/check-jsonschema");
    let checked = Command::new(&program)
        .args(["--builtin-schema", schema])
        .arg(repository(path))
        .output()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make test`", program.display()));
    let found = String::from_utf8_lossy(&checked.stdout);
    assert!(checked.status.success(), "{path}: {found}");
}

/// Returns the jobs of a workflow, each with its lines.
fn jobs(workflow: &str) -> Vec<(&str, Vec<&str>)> {
    let mut jobs: Vec<(&str, Vec<&str>)> = Vec::new();
    let (_, text) = workflow.split_once("\njobs:\n").unwrap();
    for line in text.lines() {
        let name = line
            .strip_prefix("  ")
            .and_then(|line| line.strip_suffix(':'));
        if let Some(name) = name.filter(|name| !name.starts_with([' ', '#'])) {
            jobs.push((name, Vec::new()));
        }
        if let Some((_, lines)) = jobs.last_mut() {
            lines.push(line);
        }
    }
    jobs
}

#[test]
fn workflows_and_the_action_follow_their_schemas() {
    for name in ["ci", "release"] {
        let path = format!(".github/workflows/{name}.yml");
        validate("vendor.github-workflows", &path);
    }
    validate("vendor.github-actions", "deploy/ci/action.yml");
}

#[test]
fn every_target_that_a_workflow_makes_is_in_the_makefile() {
    let makefile = read("Makefile");
    let mut made = 0;
    for name in ["ci", "release"] {
        let text = read(&format!(".github/workflows/{name}.yml"));
        for command in text
            .lines()
            .filter_map(|line| line.split_once("run: make "))
        {
            let target = command.1.split(' ').next().unwrap();
            let rule = format!("\n{target}: ##");
            assert!(makefile.contains(&rule), "no target {target}");
            made += 1;
        }
    }
    assert!(made >= 9, "{made} targets");
}

#[test]
fn a_fork_can_run_every_job_of_the_first_workflow() {
    let text = read(".github/workflows/ci.yml");
    assert!(!text.contains("secrets."), "a fork has no secrets");
    assert!(text.contains("\npermissions:\n  contents: read\n"));
    assert_eq!(text.matches("permissions:").count(), 1);
    let jobs = jobs(&text);
    assert!(jobs.len() >= 8, "{jobs:?}");
    for (name, lines) in jobs {
        let has = |part: &str| lines.iter().any(|line| line.contains(part));
        assert!(has("    timeout-minutes: "), "{name} has no limit");
        assert!(
            has("    runs-on: ubuntu-24.04"),
            "{name} needs another runner"
        );
    }
}
