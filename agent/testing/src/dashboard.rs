//! The shipped Grafana dashboards, read from their JSON: panels, their queries, the variables in
//! them. This module does not use Grafana; another test checks the files against Grafana's own
//! types.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::repository;
use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

/// The template variable with every panel's data source.
pub const DATA_SOURCE: &str = "${datasource}";

pub struct Dashboard {
    pub file: String,
    pub text: String,
    pub json: Value,
}

pub struct Panel<'a> {
    pub dashboard: &'a str,
    pub title: &'a str,
    pub json: &'a Value,
}

/// One query of a panel.
pub struct Target<'a> {
    /// The panel's dashboard and title and the query's letter, as in `robot: Loss A`.
    pub name: String,
    pub expression: &'a str,
    pub legend: &'a str,
}

/// Returns the directory of the dashboards.
pub fn directory() -> PathBuf {
    repository("dashboards")
}

/// Returns every shipped dashboard.
pub fn all() -> Result<Vec<Dashboard>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory())? {
        let path = entry?.path();
        if path
            .extension()
            .is_some_and(|extension| extension == "json")
        {
            let text = std::fs::read_to_string(&path)?;
            let json = serde_json::from_str(&text)
                .with_context(|| format!("{} is not JSON", path.display()))?;
            let file = path.file_stem().unwrap_or_default().to_string_lossy();
            let file = file.into_owned();
            found.push(Dashboard { file, text, json });
        }
    }
    found.sort_by(|a, b| b.file.cmp(&a.file));
    ensure!(found.len() >= 2, "{} dashboards", found.len());
    Ok(found)
}

impl Dashboard {
    /// Returns all panels except the headings of rows.
    pub fn panels(&self) -> Vec<Panel<'_>> {
        let panels = list(&self.json, "/panels");
        let panels = panels.iter().filter(|panel| text(panel, "/type") != "row");
        let panel = |json| Panel {
            dashboard: &self.file,
            title: text(json, "/title"),
            json,
        };
        panels.map(panel).collect()
    }

    /// Returns the queries that fill template variables: variable, metric with its selector, label.
    pub fn variables(&self) -> Result<Vec<(String, String, String)>> {
        let variables = list(&self.json, "/templating/list").iter();
        let queries = variables.filter(|variable| text(variable, "/type") == "query");
        let parsed = queries.map(|variable| {
            let query = text(variable, "/query");
            let inside = query.strip_prefix("label_values(");
            let inside = inside.and_then(|rest| rest.strip_suffix(')'));
            let (series, label) = inside
                .and_then(|inside| inside.rsplit_once(", "))
                .with_context(|| format!("{query} is not label_values(series, label)"))?;
            Ok((
                text(variable, "/name").to_owned(),
                series.to_owned(),
                label.to_owned(),
            ))
        });
        parsed.collect()
    }
}

impl<'a> Panel<'a> {
    pub fn text(&self, pointer: &str) -> &'a str {
        text(self.json, pointer)
    }

    pub fn targets(&self) -> Vec<Target<'a>> {
        let targets = list(self.json, "/targets").iter();
        let target = |json| Target {
            name: format!(
                "{}: {} {}",
                self.dashboard,
                self.title,
                text(json, "/refId")
            ),
            expression: text(json, "/expr"),
            legend: text(json, "/legendFormat"),
        };
        targets.map(target).collect()
    }

    /// Returns the labels with a heading in a table, which its queries must therefore have.
    pub fn columns(&self) -> Vec<&'a str> {
        let transformations = list(self.json, "/transformations").iter();
        let renamed =
            transformations.filter_map(|each| each.pointer("/options/renameByName")?.as_object());
        renamed
            .flat_map(|names| names.keys())
            .map(String::as_str)
            .filter(|name| !name.starts_with("Value"))
            .collect()
    }
}

/// Returns the names between `{{` and `}}` in a legend.
pub fn legend_labels(legend: &str) -> Vec<&str> {
    let after = legend.split("{{").skip(1);
    after
        .filter_map(|rest| Some(rest.split_once("}}")?.0.trim()))
        .collect()
}

/// Returns an expression as Grafana would send it.
///
/// # Errors
/// Fails if a variable in it has no value here.
pub fn resolved(expression: &str, values: &BTreeMap<&str, String>) -> Result<String> {
    let mut rest = expression;
    let mut resolved = String::new();
    while let Some((before, after)) = rest.split_once('$') {
        resolved.push_str(before);
        let end = after
            .find(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
            .unwrap_or(after.len());
        let (name, after) = after.split_at(end);
        let value = values.get(name);
        resolved.push_str(value.with_context(|| format!("${name} in {expression} is unknown"))?);
        rest = after;
    }
    resolved.push_str(rest);
    Ok(resolved)
}

pub fn list<'a>(json: &'a Value, pointer: &str) -> &'a [Value] {
    let found = json.pointer(pointer).and_then(Value::as_array);
    found.map_or(&[], Vec::as_slice)
}

pub fn text<'a>(json: &'a Value, pointer: &str) -> &'a str {
    json.pointer(pointer)
        .and_then(Value::as_str)
        .unwrap_or_default()
}
