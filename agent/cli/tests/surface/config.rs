//! The shipped configuration and its schema agree with the code.

use std::path::Path;

use ros2probe_daemon::config::{Config, Limits};
use serde_json::Value;

fn shipped(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../config")
        .join(name);
    std::fs::read_to_string(path).unwrap()
}

/// Returns the shipped file with every commented default active. A default is a comment that begins
/// with a key, at the indentation of its section.
fn uncommented(yaml: &str) -> String {
    let line = |line: &str| match line.split_once("# ") {
        Some((indentation, rest))
            if indentation.trim().is_empty()
                && rest.trim_start().split_once(':').is_some_and(|(key, _)| {
                    !key.is_empty() && key.chars().all(|c| c.is_ascii_lowercase() || c == '_')
                }) =>
        {
            format!("{indentation}{rest}\n")
        }
        _ => format!("{line}\n"),
    };
    let rest = yaml.split_once("\nlimits:").unwrap().1;
    format!("watch: [/**]\nlimits:{rest}")
        .lines()
        .map(line)
        .collect()
}

#[test]
fn the_schema_in_the_repository_equals_the_generated_one() {
    let generated = serde_json::to_string_pretty(&Config::schema()).unwrap() + "\n";
    if std::env::var_os("UPDATE_SCHEMA").is_some() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/ros2probe.schema.json");
        std::fs::write(path, &generated).unwrap();
    }
    assert_eq!(
        shipped("ros2probe.schema.json"),
        generated,
        "run `UPDATE_SCHEMA=1 cargo test -p ros2probe --test surface config::` and commit the result"
    );
}

#[test]
fn the_shipped_file_only_adds_a_watch_of_all_topics() {
    let shipped = Config::parse(shipped("ros2probe.yaml").as_bytes()).unwrap();
    let patterns: Vec<&str> = shipped
        .watches
        .iter()
        .map(|watch| watch.pattern.as_str())
        .collect();
    assert_eq!(patterns, ["/**"]);
    assert_eq!(
        Config {
            watches: Vec::new(),
            ..shipped
        },
        Config::default()
    );
}

#[test]
fn the_defaults_in_the_comments_equal_those_of_the_code() {
    let yaml = uncommented(&shipped("ros2probe.yaml"));
    for key in [
        "source",
        "mirror_interfaces",
        "reassembly_bytes",
        "record_ring_bytes",
        "exclude",
        "per_writer",
        "compression",
        "topic_grace_s",
    ] {
        let active = |line: &str| line.trim_start().starts_with(&format!("{key}:"));
        assert!(yaml.lines().any(active), "{key} is not in\n{yaml}");
    }
    let config = Config::parse(yaml.as_bytes()).unwrap_or_else(|error| {
        panic!("{}\n{yaml}", error.report("ros2probe.yaml"));
    });
    assert_eq!(
        Config {
            watches: Vec::new(),
            ..config
        },
        Config::default()
    );
}

#[test]
fn the_schema_accepts_what_the_agent_accepts_and_refuses_what_it_refuses() {
    let schema: serde_json::Value =
        serde_json::from_str(&shipped("ros2probe.schema.json")).unwrap();
    let validator = jsonschema::validator_for(&schema).unwrap();
    let good = [
        shipped("ros2probe.yaml"),
        uncommented(&shipped("ros2probe.yaml")),
        "watch:\nlimits: {topics: 5}\n".to_owned(),
        "watch: [/a, {topic: /b, domain: 3, max_silence_s: 1.5}]\nlog: warn\n".to_owned(),
        "otlp: {endpoint: 'http://collector', headers: {a: b}, compression: gzip}\n".to_owned(),
    ];
    for yaml in good {
        assert!(
            validator.is_valid(&serde_yaml::from_str(&yaml).unwrap()),
            "{yaml}"
        );
        assert!(Config::parse(yaml.as_bytes()).is_ok(), "{yaml}");
    }
    for yaml in [
        "watches: []",
        "watch: /a",
        "watch: [{domain: 3}]",
        "watch: [{topic: /a, domain: 233}]",
        "watch: [{topic: /a, max_loss_ratio: 1.5}]",
        "limits: {topics: 0}",
        "limits: {topics: 1.5}",
        "metrics: {listen: 17400}",
        "log: loud",
        "capture: {source: socket}",
        "watch: [{topic: /a, per_subscriber: 1}]",
        "topic_grace_s: -1",
        "otlp: {headers: {a: 1}}",
        "otlp: {compression: zstd}",
        "otlp: {interval_s: 0}",
        "watch: [{topic: /a, trace: 1.5}]",
        "chains: [{from: /a}]",
        "chains: [{from: /a, to: /b, max_latency_ms: 0}]",
        "recordings: {snapshots: [{name: a b, topics: [/a]}]}",
        "recordings: {snapshots: [{name: ../a, topics: [/a]}]}",
        "recordings: {snapshots: [{name: a, topics: [/a], trigger: expectation}]}",
        "recordings: {snapshots: [{name: a, topics: [/a], max_count: 0}]}",
    ] {
        assert!(
            !validator.is_valid(&serde_yaml::from_str(yaml).unwrap()),
            "{yaml}"
        );
        assert!(Config::parse(yaml.as_bytes()).is_err(), "{yaml}");
    }
}

/// Finds each number of the schema with a bound. An entry has its path, the bound, and the step
/// beyond the bound.
fn bounds(schema: &Value, root: &Value, path: &str, found: &mut Vec<(String, f64, f64)>) {
    if let Some(name) = schema["$ref"].as_str() {
        let name = name.trim_start_matches("#/$defs/");
        return bounds(&root["$defs"][name], root, path, found);
    }
    for variant in ["anyOf", "allOf", "oneOf"] {
        for schema in schema[variant].as_array().into_iter().flatten() {
            bounds(schema, root, path, found);
        }
    }
    for (key, schema) in schema["properties"].as_object().into_iter().flatten() {
        bounds(schema, root, &format!("{path}.{key}"), found);
    }
    if schema["items"].is_object() {
        bounds(&schema["items"], root, &format!("{path}[]"), found);
    }
    for (bound, step) in [("minimum", -1.0), ("maximum", 1.0)] {
        if let Some(value) = schema[bound].as_f64() {
            found.push((path.trim_start_matches('.').to_owned(), value, step));
        }
    }
}

/// Returns a file that sets only this key, with the keys that the enclosing objects require.
fn with_key(path: &str, value: f64) -> String {
    let mut text = value.to_string();
    for part in path.rsplit('.') {
        let (key, is_list) = match part.strip_suffix("[]") {
            Some(key) => (key, true),
            None => (part, false),
        };
        text = match (key, is_list) {
            ("watch", true) => {
                let rest = text.trim_start_matches('{');
                let needed = match rest.starts_with("window_s") {
                    true => "min_rate_hz: 1, ",
                    false => "",
                };
                format!("{{watch: [{{topic: /a, {needed}{rest}]}}")
            }
            ("chains", true) => {
                let rest = text.trim_start_matches('{');
                format!("{{chains: [{{from: /a, to: /b, {rest}]}}")
            }
            ("snapshots", true) => {
                let rest = text.trim_start_matches('{');
                format!("{{snapshots: [{{name: a, topics: [/a], {rest}]}}")
            }
            // A list of numbers.
            (key, true) => format!("{{{key}: [{text}]}}"),
            _ => format!("{{{key}: {text}}}"),
        };
    }
    text
}

#[test]
fn the_agent_accepts_every_bound_of_the_schema_and_refuses_the_next_value() {
    let schema: Value = serde_json::from_str(&shipped("ros2probe.schema.json")).unwrap();
    let mut found = Vec::new();
    bounds(&schema, &schema, "", &mut found);
    assert!(found.len() > 50, "{} bounds", found.len());
    for (path, bound, step) in found {
        let read = |value: f64| Config::parse(with_key(&path, value).as_bytes());
        if let Err(error) = read(bound) {
            // Several keys may not be valid together at their bounds.
            panic!("{}: {}", with_key(&path, bound), error.report("file"));
        }
        let beyond = bound + step;
        assert!(read(beyond).is_err(), "{}", with_key(&path, beyond));
    }
}

#[test]
fn default_limits_suffice_for_a_large_robot() {
    let Limits {
        participants,
        endpoints,
        topics,
        ..
    } = Config::default().limits;
    assert!(participants >= 200 && endpoints >= 8_000 && topics >= 1_000);
}
