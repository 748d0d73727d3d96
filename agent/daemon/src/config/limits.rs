//! The section `limits`: its keys, its schema and its table, generated from the list of caps.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::Write as _;

use ros2probe_model::facts::bounded::{CONFIGURED, Table};
use ros2probe_model::facts::limits::{Limit, Limits, Row};
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Deserialize;
use serde_json::{Map, Value, json};

/// The section in the file: keys and numbers, validated by the schema.
#[derive(Debug, Default, Deserialize)]
#[serde(transparent)]
pub(super) struct LimitsShape(BTreeMap<String, usize>);

impl From<LimitsShape> for Limits {
    fn from(LimitsShape(written): LimitsShape) -> Self {
        Self::of(|limit| {
            let row = limit.row();
            written.get(row.key).copied().unwrap_or(row.default)
        })
    }
}

impl JsonSchema for LimitsShape {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Limits".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let properties = Limit::ALL.into_iter().map(|limit| {
            let Row {
                key,
                default,
                range: (minimum, maximum),
                what,
                reached,
                ..
            } = limit.row();
            let schema = json!({
                "description": format!("{what}. At the cap, {reached}."),
                "type": "integer",
                "format": "uint",
                "minimum": minimum,
                "maximum": maximum,
                "default": default,
            });
            (key.to_owned(), schema)
        });
        let mut schema = Map::new();
        schema.insert(
            "description".to_owned(),
            "Caps of the agent's tables.".into(),
        );
        schema.insert("type".to_owned(), "object".into());
        schema.insert("additionalProperties".to_owned(), false.into());
        schema.insert("properties".to_owned(), Value::Object(properties.collect()));
        schema.into()
    }
}

/// Returns the caps of the configuration as a Markdown table, for `docs/limits.md`.
#[must_use]
pub fn markdown() -> String {
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
#[must_use]
pub fn tables_markdown(tables: &[Table]) -> String {
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
