//! The section `limits`: its keys and its schema, generated from the list of caps.

use std::borrow::Cow;
use std::collections::BTreeMap;

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
