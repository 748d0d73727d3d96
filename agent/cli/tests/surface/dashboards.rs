//! The shipped Grafana dashboards: Grafana's own types accept the files, and every panel has a unit
//! and a description. No data source is fixed, and each query uses existing metrics according to
//! their type.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_metrics::catalogue::{CATALOGUE, Kind};
use ros2probe_testing::dashboard::{self, DATA_SOURCE, Dashboard, Panel, list, resolved, text};
use serde_json::{Value, json};

/// Windows of panels whose description names the window.
const OTHER_WINDOWS: [(&str, &str); 1] = [("Matched but without messages", "[5m]")];

#[test]
fn every_panel_has_a_title_a_unit_and_a_description_in_sentences() -> Result<()> {
    let mut titles = BTreeSet::new();
    for_each_panel(|panel| {
        let description = panel.text("/description");
        ensure!(
            description.len() > 20 && description.ends_with('.'),
            "description: {description:?}"
        );
        ensure!(
            !panel.text("/fieldConfig/defaults/unit").is_empty(),
            "no unit"
        );
        ensure!(!panel.targets().is_empty(), "no query");
        ensure!(
            titles.insert((panel.dashboard.to_owned(), panel.title.to_owned()))
                && !panel.title.is_empty(),
            "title"
        );
        Ok(())
    })?;
    ensure!(titles.len() > 50, "{} panels", titles.len());
    Ok(())
}

#[test]
fn every_data_source_is_a_variable() -> Result<()> {
    let wanted = json!({"type": "prometheus", "uid": DATA_SOURCE});
    for dashboard in dashboard::all()? {
        let first = dashboard.json.pointer("/templating/list/0");
        let first = first.context("no variables")?;
        ensure!(text(first, "/name") == "datasource" && text(first, "/type") == "datasource");
        let mut seen = 0;
        each_value(&dashboard.json, "datasource", &mut |value| {
            seen += 1;
            ensure!(*value == wanted, "{}: {value}", dashboard.file);
            Ok(())
        })?;
        let targets: usize = dashboard
            .panels()
            .iter()
            .map(|panel| panel.targets().len())
            .sum();
        ensure!(seen > targets, "{}: {seen} data sources", dashboard.file);
    }
    Ok(())
}

#[test]
fn dashboards_are_not_editable_in_grafana_and_their_panels_do_not_overlap() -> Result<()> {
    for dashboard in dashboard::all()? {
        let Dashboard { file, json, .. } = &dashboard;
        ensure!(json["editable"] == false, "{file} is editable");
        ensure!(text(json, "/uid").starts_with("ros2probe-") && !text(json, "/title").is_empty());
        let (mut ids, mut taken) = (BTreeSet::new(), BTreeSet::new());
        for panel in list(json, "/panels") {
            let title = text(panel, "/title");
            ensure!(
                ids.insert(panel["id"].as_u64().context("no id")?),
                "{file}: id of {title}"
            );
            let place = |side: &str| panel["gridPos"][side].as_u64().context("no place");
            let (left, top) = (place("x")?, place("y")?);
            let (right, bottom) = (left + place("w")?, top + place("h")?);
            ensure!(right <= 24, "{file}: {title} is too wide");
            for cell in (left..right).flat_map(|x| (top..bottom).map(move |y| (x, y))) {
                ensure!(taken.insert(cell), "{file}: {title} lies on another panel");
            }
        }
    }
    Ok(())
}

#[test]
fn panels_query_counters_as_rates_and_gauges_directly() -> Result<()> {
    let kinds = kinds();
    let mut counters = 0;
    for_each_panel(|panel| {
        let other = OTHER_WINDOWS
            .iter()
            .find(|(title, _)| *title == panel.title);
        let window = other.map_or("[$__rate_interval]", |(_, window)| window);
        for target in panel.targets() {
            for (before, name, after) in words(target.expression) {
                let Some(kind) = kinds.get(name) else {
                    continue;
                };
                let within = before.ends_with("rate(") || before.ends_with("increase(");
                ensure!(
                    within == (*kind == Kind::Counter),
                    "{}: {name}",
                    target.name
                );
                if within {
                    counters += 1;
                    let selector = after.split_once('}').map(|(_, rest)| rest);
                    ensure!(
                        selector.is_some_and(|rest| rest.starts_with(window)),
                        "{}: {name} over another time than {window}",
                        target.name
                    );
                }
            }
        }
        Ok(())
    })?;
    ensure!(counters > 50, "{counters} counters found");
    Ok(())
}

#[test]
fn every_metric_and_recorded_series_in_a_panel_exists() -> Result<()> {
    let kinds = kinds();
    let rules = std::fs::read_to_string(dashboard::directory().join("rules/ros2probe.rules.yaml"))?;
    let recorded: BTreeSet<&str> = rules
        .lines()
        .filter_map(|line| line.trim().strip_prefix("- record: "))
        .collect();
    for dashboard in dashboard::all()? {
        let variables = dashboard.variables()?;
        let of_variables = variables.iter().map(|(_, series, _)| series.as_str());
        let panels = dashboard.panels();
        let of_panels = panels.iter().flat_map(Panel::targets);
        for expression in of_panels
            .map(|target| target.expression)
            .chain(of_variables)
        {
            for (_, name, _) in words(expression) {
                let ours = name.starts_with("ros2") || name.starts_with("process_");
                ensure!(!ours || kinds.contains_key(name), "{name} in {expression}");
                ensure!(
                    !name.contains(':') || recorded.contains(name),
                    "{name} is not recorded"
                );
            }
        }
    }
    Ok(())
}

#[test]
fn every_variable_in_an_expression_belongs_to_the_dashboard_or_to_grafana() -> Result<()> {
    for dashboard in dashboard::all()? {
        let own = list(&dashboard.json, "/templating/list").iter();
        let names = own.map(|variable| text(variable, "/name"));
        let names = names.chain(["__rate_interval", "__range"]);
        let values: BTreeMap<&str, String> = names.map(|name| (name, "1m".to_owned())).collect();
        for panel in dashboard.panels() {
            for target in panel.targets() {
                ensure!(
                    !resolved(target.expression, &values)?.contains('$'),
                    "{}",
                    target.name
                );
            }
        }
        for (name, series, _) in dashboard.variables()? {
            resolved(&series, &values).with_context(|| name)?;
        }
    }
    Ok(())
}

#[test]
fn grafana_s_types_accept_the_dashboards_and_reject_mistakes() -> Result<()> {
    let dashboards = dashboard::all()?;
    let mut files: Vec<(String, String)> = Vec::new();
    for Dashboard { file, text, .. } in &dashboards {
        files.push((file.clone(), text.clone()));
    }
    // The types reject an unknown key, an unknown enumeration value, an option of another panel
    // type, and a target without an expression.
    let text = &dashboards.first().context("no dashboards")?.text;
    let mistakes = [
        ("\"editable\"", "\"editible\""),
        ("\"drawStyle\": \"bars\"", "\"drawStyle\": \"beams\""),
        ("\"sort\": \"desc\"", "\"sorted\": \"desc\""),
        ("\"expr\"", "\"expression\""),
    ];
    for (number, (right, wrong)) in mistakes.into_iter().enumerate() {
        ensure!(text.contains(right), "{right} is nowhere");
        files.push((format!("wrong{number}"), text.replacen(right, wrong, 1)));
    }
    let printed = type_check(&files)?;
    for (name, _) in &files {
        let complaint = printed
            .lines()
            .find(|line| line.starts_with(&format!("{name}.ts(")));
        let wrong = name.starts_with("wrong");
        ensure!(
            complaint.is_some() == wrong,
            "{name}: {complaint:?}\n{printed}"
        );
    }
    Ok(())
}

#[test]
fn the_readme_s_table_lists_the_panels() -> Result<()> {
    const BEGIN: &str = "<!-- panels: begin, from the dashboards -->\n";
    const END: &str = "<!-- panels: end -->";
    let path = dashboard::directory().join("README.md");
    let readme = std::fs::read_to_string(&path)?;
    let (before, rest) = readme.split_once(BEGIN).context("no table")?;
    let (table, after) = rest.split_once(END).context("no end of the table")?;
    let wanted = table_of_panels()?;
    if std::env::var_os("UPDATE_README").is_some() {
        std::fs::write(path, format!("{before}{BEGIN}{wanted}{END}{after}"))?;
        return Ok(());
    }
    ensure!(
        table == wanted,
        "run `UPDATE_README=1 cargo test -p ros2probe --test surface dashboards::` and commit"
    );
    Ok(())
}

fn table_of_panels() -> Result<String> {
    let mut table = String::new();
    for dashboard in dashboard::all()? {
        let title = text(&dashboard.json, "/title");
        let about = text(&dashboard.json, "/description");
        table.push_str(&format!(
            "\n### {title} (`{}.json`)\n\n{about}\n\n",
            dashboard.file
        ));
        table.push_str("| panel | shows |\n| --- | --- |\n");
        for panel in list(&dashboard.json, "/panels") {
            let (title, about) = (text(panel, "/title"), text(panel, "/description"));
            match text(panel, "/type") {
                "row" => table.push_str(&format!("| **{title}** | |\n")),
                _ => table.push_str(&format!("| {title} | {about} |\n")),
            }
        }
    }
    Ok(table + "\n")
}

/// Returns the output of the TypeScript compiler for dashboards beside
/// `agent/cli/tests/dashboard/types/dashboard.ts`.
fn type_check(files: &[(String, String)]) -> Result<String> {
    const MISSING: &str = "the TypeScript compiler is missing: run `.ci/prerequisites.sh types`, \
                           which needs npm (`apt-get install npm`)";
    let tools = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/tools/grafana");
    let compiler = tools.join("node_modules/typescript/bin/tsc");
    ensure!(compiler.exists(), MISSING);
    let compiler = compiler.canonicalize()?;
    // The directory is below npm's directory, so that the compiler finds Grafana's types.
    let directory = tempfile::tempdir_in(&tools)?;
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/dashboard/types");
    for file in ["dashboard.ts", "tsconfig.json"] {
        std::fs::copy(sources.join(file), directory.path().join(file))?;
    }
    for (name, text) in files {
        let source = format!(
            "import type {{ Checked }} from './dashboard.js';\nexport default {} satisfies Checked;\n",
            text.trim_end()
        );
        std::fs::write(directory.path().join(format!("{name}.ts")), source)?;
    }
    let output = Command::new("node")
        .arg(&compiler)
        .args(["--project", ".", "--pretty", "false"])
        .current_dir(directory.path())
        .output()
        .context(MISSING)?;
    let errors = String::from_utf8_lossy(&output.stderr);
    ensure!(errors.is_empty(), "tsc: {errors}");
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns every series name of the catalogue with its kind. Series of histograms are counters.
fn kinds() -> BTreeMap<String, Kind> {
    let mut kinds = BTreeMap::new();
    for metric in CATALOGUE {
        if metric.kind == Kind::Histogram {
            for part in ["_bucket", "_sum", "_count"] {
                kinds.insert(format!("{}{part}", metric.name), Kind::Counter);
            }
        } else {
            kinds.insert(metric.name.to_owned(), metric.kind);
        }
    }
    kinds
}

/// Returns the names in an expression, each with the text before and after it.
fn words(expression: &str) -> Vec<(&str, &str, &str)> {
    let named = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | ':');
    let mut words = Vec::new();
    let mut start = 0;
    while let Some(offset) = expression[start..].find(named) {
        let begin = start + offset;
        let length = expression[begin..].find(|c| !named(c));
        let end = length.map_or(expression.len(), |length| begin + length);
        words.push((
            &expression[..begin],
            &expression[begin..end],
            &expression[end..],
        ));
        start = end;
    }
    words
}

fn for_each_panel(mut check: impl FnMut(&Panel<'_>) -> Result<()>) -> Result<()> {
    for dashboard in dashboard::all()? {
        for panel in dashboard.panels() {
            check(&panel).with_context(|| format!("{}: {}", panel.dashboard, panel.title))?;
        }
    }
    Ok(())
}

/// Visits each value of this key, at any depth.
fn each_value(json: &Value, key: &str, visit: &mut impl FnMut(&Value) -> Result<()>) -> Result<()> {
    match json {
        Value::Object(members) => members.iter().try_for_each(|(name, value)| match name {
            name if name == key => visit(value),
            _ => each_value(value, key, visit),
        }),
        Value::Array(values) => values
            .iter()
            .try_for_each(|value| each_value(value, key, visit)),
        _ => Ok(()),
    }
}
