//! The table of limits: the metrics page, /health and docs/limits-*.md agree about each cap.

use super::*;
use ros2probe::tables as commands;
use ros2probe_capture::tables as capture;
use ros2probe_daemon::tables as daemon;
use ros2probe_metrics::tables as metrics;
use ros2probe_model::facts::bounded::Table;
use ros2probe_model::facts::tables as model;

#[test]
fn every_limit_of_the_configuration_is_on_the_metrics_page_and_in_health() {
    let directory = tempfile::tempdir().unwrap();
    let mut caps = String::new();
    for limit in Limit::ALL {
        let (least, _) = limit.row().range;
        write!(caps, "{}: {}, ", limit.key(), least + 3).unwrap();
    }
    let agent = agent(directory.path(), &caps);
    let page = agent.get("/metrics").body;
    let (status, health) = call_api(agent.api, "GET", "/health", "");
    assert_eq!(status, 200);
    let shown = health["limits"].as_array().unwrap();
    for (limit, shown) in Limit::ALL.into_iter().zip(shown) {
        let (key, cap) = (limit.key(), limit.row().range.0 + 3);
        let value = metric(&page, &format!("ros2probe_limit{{limit=\"{key}\"}}"));
        assert_eq!(value, Some(cap as f64), "{key}");
        assert_eq!((&shown["limit"], &shown["cap"]), (&key.into(), &cap.into()));
    }
    assert_eq!(shown.len(), Limit::ALL.len());
}

/// Returns the text of the pages of the book that list constants.
fn pages_of_fixed_caps(root: &Path) -> String {
    let pages =
        ["capture", "model", "agent", "exports"].map(|page| format!("docs/limits-{page}.md"));
    let text = |page: &String| std::fs::read_to_string(root.join(page)).unwrap();
    pages.iter().map(text).collect()
}

#[test]
fn the_table_of_fixed_caps_equals_the_sources() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let page = pages_of_fixed_caps(&root);
    let rows: Vec<Vec<&str>> = page
        .lines()
        .filter(|line| line.starts_with("| ") && line.contains("` in `"))
        .map(|line| line.split(" | ").collect())
        .collect();
    assert!(rows.len() > 40, "{} rows", rows.len());
    for row in rows {
        let value = row[1].trim_matches('`');
        let (name, path) = row[2].trim_matches('`').split_once("` in `").unwrap();
        let source = std::fs::read_to_string(root.join(path)).unwrap();
        let is_said = source.lines().any(|line| {
            let (left, right) = match line.split_once(" = ") {
                Some((left, right)) => (left.split(':').next().unwrap_or_default(), right),
                None => line.split_once(": ").unwrap_or_default(),
            };
            left.split(' ').next_back() == Some(name) && right.trim_end_matches([';', ',']) == value
        });
        assert!(is_said, "{path}: {name} is not {value}");
    }
}

/// Asserts that this file has a test of this name.
fn assert_test(path: &str, name: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let source = std::fs::read_to_string(root.join(path)).unwrap();
    let mut lines = source.lines().map(str::trim);
    let is_begun = |line: &str| line.contains(&format!("fn {name}("));
    let mut before = Vec::new();
    let found = lines.by_ref().find(|line| {
        before.push(*line);
        is_begun(line)
    });
    assert!(found.is_some(), "{path} has no test {name}");
    let attributes = before.iter().rev().skip(1).take(3);
    let mut attributes = attributes.filter(|line| line.starts_with("#["));
    assert!(
        attributes.any(|line| line.contains("test")),
        "{path}: {name} is no test"
    );
}

#[test]
fn every_cap_has_a_test_that_exceeds_it() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let page = pages_of_fixed_caps(&root);
    let rows = page.lines().filter(|line| line.starts_with("| "));
    let rows = rows.filter_map(|line| {
        let (name, path) = line.split(" | ").nth(2)?.split_once("` in `")?;
        Some((name.trim_matches('`'), path.trim_matches('`')))
    });
    let declared =
        |all: &'static [Table], path: &'static str| all.iter().map(move |table| (table.name, path));
    let rows = rows
        .chain(declared(model::ALL, "agent/model/src/facts/tables.rs"))
        .chain(declared(capture::ALL, "agent/capture/src/tables.rs"))
        .chain(declared(metrics::ALL, "agent/metrics/src/tables.rs"))
        .chain(declared(daemon::ALL, "agent/daemon/src/tables.rs"))
        .chain(declared(commands::ALL, "agent/cli/src/tables.rs"));
    let rows: BTreeSet<_> = rows.collect();
    let fixed = driven::fixed();
    let named: Vec<_> = fixed
        .iter()
        .map(|[name, path, ..]| (*name, *path))
        .collect();
    let once: BTreeSet<_> = named.iter().copied().collect();
    assert_eq!(named.len(), once.len(), "a cap is named twice");
    assert_eq!(rows, once);
    for [_, _, path, test] in fixed {
        assert_test(path, test);
    }
    let keys: Vec<_> = driven::KEYS.iter().map(|[key, _]| *key).collect();
    assert_eq!(keys.len(), Limit::ALL.len());
    assert!(Limit::ALL.iter().all(|limit| keys.contains(&limit.key())));
    for [_, test] in driven::KEYS {
        assert_test("agent/cli/tests/surface/limits.rs", test);
    }
}
