//! The Helm chart: Helm's own library renders it, and the result is the DaemonSet of
//! `deploy/kubernetes/`.

use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository;
use serde::Deserialize as _;
use serde_json::json;
use serde_yaml::Value;

use crate::package::installation::{all, succeed};

/// Returns the command that renders the chart with these values.
fn renderer(values: &serde_json::Value) -> Command {
    let mut python = Command::new(repository("target/tools/helm/bin/python"));
    python.arg(repository("agent/cli/tests/dist/chart/render.py"));
    python.arg(repository("deploy/helm/ros2probe"));
    python.arg(values.to_string());
    python
}

/// Returns the rendered documents. Each one is valid for the oldest and the newest Kubernetes.
fn rendered(values: &serde_json::Value) -> Result<Vec<Value>> {
    let text = succeed(&mut renderer(values)).context("`.ci/prerequisites.sh test` installs it")?;
    let documents = serde_yaml::Deserializer::from_str(&text).map(Value::deserialize);
    Ok(documents.collect::<Result<_, _>>()?)
}

/// Returns the only document of a kind.
fn only<'d>(documents: &'d [Value], kind: &str) -> Result<&'d Value> {
    let mut found = documents.iter().filter(|one| one["kind"] == kind);
    let first = found.next().with_context(|| format!("no {kind}"))?;
    ensure!(found.next().is_none(), "several of {kind}");
    Ok(first)
}

/// Returns the manifests that are applied without Helm.
fn plain() -> Result<Vec<Value>> {
    let text = std::fs::read_to_string(repository("deploy/kubernetes/ros2probe.yaml"))?;
    let documents = serde_yaml::Deserializer::from_str(&text).map(Value::deserialize);
    Ok(documents.collect::<Result<_, _>>()?)
}

/// Returns the configuration in a ConfigMap.
fn configuration(documents: &[Value]) -> Result<Value> {
    let text = only(documents, "ConfigMap")?["data"]["ros2probe.yaml"].as_str();
    Ok(serde_yaml::from_str(text.context("no configuration")?)?)
}

#[test]
fn the_default_values_render_the_plain_manifests() -> Result<()> {
    let (chart, plain) = (rendered(&json!({}))?, plain()?);
    let pod = |documents: &[Value]| -> Result<Value> {
        Ok(only(documents, "DaemonSet")?["spec"]["template"]["spec"].clone())
    };
    ensure!(pod(&chart)? == pod(&plain)?, "{:#?}", pod(&chart)?);
    let strategy = |documents: &[Value]| -> Result<Value> {
        Ok(only(documents, "DaemonSet")?["spec"]["updateStrategy"].clone())
    };
    ensure!(strategy(&chart)? == strategy(&plain)?);
    ensure!(configuration(&chart)? == configuration(&plain)?);
    ensure!(chart.len() == 2, "{chart:#?}");
    Ok(())
}

#[test]
fn kubernetes_accepts_the_plain_manifests() -> Result<()> {
    for version in ["1.25.0", "1.37.0"] {
        let mut validate = Command::new(repository("target/tools/helm/bin/python"));
        validate.args(["-m", "kubernetes_validate", "--strict", "-k", version]);
        let validated = succeed(validate.arg(repository("deploy/kubernetes/ros2probe.yaml")))?;
        let passed = validated.lines().filter(|line| line.contains("passed"));
        ensure!(passed.count() == plain()?.len(), "{validated}");
    }
    Ok(())
}

/// Adds the rows that the values need in the table: the defaults of one value, or of those in it.
fn rows(name: &str, value: &Value, found: &mut Vec<String>) -> Result<()> {
    // Others are free: their content is not the chart's.
    let parts = ["image", "metrics", "serviceMonitor"];
    match value.as_mapping().filter(|_| parts.contains(&name)) {
        Some(parts) => {
            for (part, value) in parts {
                let part = part.as_str().context("not text")?;
                rows(&format!("{name}.{part}"), value, found)?;
            }
        }
        None => {
            let default = match value.as_str().filter(|text| !text.is_empty()) {
                Some(text) => text.to_owned(),
                None => serde_json::to_value(value)?.to_string(),
            };
            found.push(format!("| `{name}` | `{default}` | "));
        }
    }
    Ok(())
}

#[test]
fn the_readme_of_the_chart_has_every_value_with_its_default() -> Result<()> {
    let values = std::fs::read_to_string(repository("deploy/helm/ros2probe/values.yaml"))?;
    let values: Value = serde_yaml::from_str(&values)?;
    let mut expected = Vec::new();
    for (name, value) in values.as_mapping().context("no values")? {
        rows(name.as_str().context("not text")?, value, &mut expected)?;
    }
    let readme = std::fs::read_to_string(repository("deploy/helm/ros2probe/README.md"))?;
    let documented: Vec<&str> = readme
        .lines()
        .filter(|line| line.starts_with("| `"))
        .collect();
    ensure!(documented.len() == expected.len(), "{documented:?}");
    for (row, start) in documented.iter().zip(&expected) {
        ensure!(row.starts_with(start), "{row}: {start}");
    }
    Ok(())
}

#[test]
fn the_chart_has_the_version_of_the_agent() -> Result<()> {
    let text = std::fs::read_to_string(repository("deploy/helm/ros2probe/Chart.yaml"))?;
    let chart: Value = serde_yaml::from_str(&text)?;
    for key in ["version", "appVersion"] {
        ensure!(chart[key] == env!("CARGO_PKG_VERSION"), "{key}");
    }
    Ok(())
}

#[test]
fn values_reach_the_agent_the_pods_and_the_prometheus_operator() -> Result<()> {
    let documents = rendered(&json!({
        "image": {"repository": "registry.example/robots/rp", "digest": format!("sha256:{}", "a".repeat(64))},
        "imagePullSecrets": [{"name": "pull"}],
        "configuration": {"watch": ["/scan"], "metrics": {"per_writer": true, "listen": "off"}},
        "metrics": {"port": 19400},
        "extraCapabilities": ["SYS_PTRACE"],
        "nodeSelector": {"robot": "yes"},
        "priorityClassName": "high",
        "podLabels": {"team": "a"},
        "podAnnotations": {"note": "b"},
        "serviceMonitor": {"enabled": true, "labels": {"release": "prometheus"}},
    }))?;
    let configuration = configuration(&documents)?;
    ensure!(configuration["watch"][0] == "/scan");
    ensure!(configuration["metrics"]["per_writer"] == true);
    ensure!(
        configuration["metrics"]["listen"] == "0.0.0.0:19400",
        "{configuration:?}"
    );
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, serde_yaml::to_string(&configuration)?)?;
    let mut check = Command::new(env!("CARGO_BIN_EXE_rp"));
    succeed(check.arg("check-config").arg(&file))?;

    let template = &only(&documents, "DaemonSet")?["spec"]["template"];
    let (pod, container) = (&template["spec"], &template["spec"]["containers"][0]);
    let image = container["image"].as_str().unwrap_or_default();
    ensure!(
        image.starts_with("registry.example/robots/rp@sha256:aaaa"),
        "{image}"
    );
    ensure!(container["ports"][0]["hostPort"] == 19400);
    let added = &container["securityContext"]["capabilities"]["add"];
    ensure!(
        added
            .as_sequence()
            .is_some_and(|all| all.contains(&"SYS_PTRACE".into())),
        "{added:?}"
    );
    ensure!(pod["nodeSelector"]["robot"] == "yes");
    ensure!(pod["nodeSelector"]["kubernetes.io/os"] == "linux");
    ensure!(pod["imagePullSecrets"][0]["name"] == "pull" && pod["priorityClassName"] == "high");
    ensure!(template["metadata"]["labels"]["team"] == "a");
    ensure!(template["metadata"]["annotations"]["note"] == "b");

    let (service, monitor) = (
        only(&documents, "Service")?,
        only(&documents, "ServiceMonitor")?,
    );
    ensure!(monitor["metadata"]["labels"]["release"] == "prometheus");
    // The monitor selects the service, the service selects the pods, and the port has one name.
    let label = |of: &Value, key: &str| of["metadata"]["labels"][key].clone();
    for (key, value) in monitor["spec"]["selector"]["matchLabels"]
        .as_mapping()
        .context("selects all")?
    {
        ensure!(
            label(service, key.as_str().unwrap_or_default()) == *value,
            "{key:?}"
        );
    }
    for (key, value) in service["spec"]["selector"]
        .as_mapping()
        .context("selects no pod")?
    {
        ensure!(template["metadata"]["labels"][key] == *value, "{key:?}");
    }
    let endpoint = &monitor["spec"]["endpoints"][0];
    ensure!(endpoint["port"] == service["spec"]["ports"][0]["name"]);
    ensure!(service["spec"]["ports"][0]["port"] == 19400);
    // The job that the alert rules expect.
    let job = monitor["spec"]["jobLabel"].as_str().context("no job")?;
    ensure!(label(service, job) == "ros2probe");
    ensure!(endpoint["relabelings"][0]["targetLabel"] == "instance");
    Ok(())
}

#[test]
fn another_configuration_replaces_the_pods() -> Result<()> {
    let checksum = |values| -> Result<String> {
        let documents = rendered(&values)?;
        let template = &only(&documents, "DaemonSet")?["spec"]["template"];
        let checksum = template["metadata"]["annotations"]["checksum/configuration"].as_str();
        Ok(checksum.context("no checksum")?.to_owned())
    };
    let default = checksum(json!({}))?;
    ensure!(default == checksum(json!({"podLabels": {"a": "b"}}))?);
    ensure!(default != checksum(json!({"configuration": {"watch": ["/scan"]}}))?);
    Ok(())
}

#[test]
fn misspelled_and_wrong_values_are_refused() -> Result<()> {
    for (values, expected) in [
        (json!({"metrics": {"prot": 1}}), "prot"),
        (json!({"image": {"repository": ""}}), "/image/repository"),
        (json!({"stateDirectory": "relative"}), "/stateDirectory"),
        (
            json!({"extraCapabilities": ["CAP sys"]}),
            "/extraCapabilities/0",
        ),
    ] {
        let output = renderer(&values).output()?;
        ensure!(
            !output.status.success() && all(&output).contains(expected),
            "{values}: {}",
            all(&output)
        );
    }
    Ok(())
}
