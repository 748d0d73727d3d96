//! The tables of `docs/` in Markdown, generated from the declarations of the sources.

use std::fmt::Write as _;

use ros2probe_daemon::events::{Definition, EVENTS};
use ros2probe_metrics::catalogue::{CATALOGUE, Metric};
use ros2probe_metrics::stability::Stability;
use ros2probe_model::facts::bounded::{CONFIGURED, Table};
use ros2probe_model::facts::limits::{Limit, Row};

/// Returns the catalogue as a Markdown table, for `docs/metrics-*.md`.
pub fn metrics() -> String {
    let mut table = "| metric | type | labels | meaning |\n| --- | --- | --- | --- |\n".to_owned();
    for Metric {
        name,
        kind,
        labels,
        help,
        stability,
        ..
    } in CATALOGUE
    {
        let labels: Vec<String> = labels.iter().map(|label| format!("`{label}`")).collect();
        let kind = kind.label();
        let mark = match stability {
            Stability::Stable => "",
            Stability::Experimental => " (experimental)",
        };
        let labels = labels.join(", ");
        table.push_str(&format!(
            "| `{name}`{mark} | {kind} | {labels} | {help} |\n"
        ));
    }
    table
}

/// Returns the events as a Markdown table, for `docs/events.md`.
pub fn events() -> String {
    let mut table =
        "| event | severity | attributes | meaning |\n| --- | --- | --- | --- |\n".to_owned();
    for Definition {
        name,
        severity,
        resolved_severity: relief,
        attributes,
        help,
        ..
    } in EVENTS
    {
        let attributes: Vec<String> = attributes.iter().map(|name| format!("`{name}`")).collect();
        let attributes = attributes.join(", ");
        let mut severities = severity.text().to_owned();
        if relief != severity {
            severities = format!("{severities} or {}", relief.text());
        }
        table.push_str(&format!(
            "| `{name}` | {severities} | {attributes} | {help} |\n"
        ));
    }
    table
}

/// Returns the caps of the configuration as a Markdown table, for `docs/limits.md`.
pub fn limits() -> String {
    let mut table = "| `limits.` | default | counts | at the cap | metric |\n\
                     | --- | --- | --- | --- | --- |\n"
        .to_owned();
    for limit in Limit::ALL {
        let Row {
            key,
            default,
            what,
            reached,
            metric,
            ..
        } = limit.row();
        let metric = match metric {
            "" => String::new(),
            metric => format!("`{metric}`"),
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            table,
            "| `{key}` | {default} | {what} | {reached} | {metric} |"
        );
    }
    table
}

/// Returns the bounded tables as a Markdown table, for `docs/limits-tables.md`.
pub fn tables(tables: &[Table]) -> String {
    let mut text = "| table | counts | entries | bytes | at a cap | reported by |\n\
                    | --- | --- | --- | --- | --- | --- |\n"
        .to_owned();
    for table in tables {
        let entries = match table.entries {
            CONFIGURED => "configured".to_owned(),
            entries => entries.to_string(),
        };
        let bytes = table
            .bytes
            .map_or_else(String::new, |bytes| bytes.to_string());
        let Table {
            name,
            what,
            reported,
            ..
        } = table;
        let (what, effect) = (what.trim(), table.in_words());
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| `{name}` | {what} | {entries} | {bytes} | {effect} | {reported} |"
        );
    }
    text
}
