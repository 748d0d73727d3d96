//! The files of `deploy/` fit together. Mounted and named files exist, Prometheus accepts its
//! configurations, and the DaemonSet's container has exactly the privileges that the agent needs.
//! `publish::containers` starts the image of a release.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use serde::Deserialize as _;
use serde_yaml::Value;

use crate::package::installation::succeed;
use crate::publish::podman::Options;

/// Features that Debian's `promtool` lacks.
const NOT_BUILT_IN: &str = "kubernetes_sd_configs";

#[test]
fn compose_follows_its_schema() -> Result<()> {
    let mut check = Command::new(deploy().join("../target/tools/workflows/bin/check-jsonschema"));
    check.args(["--builtin-schema", "vendor.compose-spec"]);
    succeed(check.arg(deploy().join("compose.yaml")))
        .context("`.ci/prerequisites.sh test` installs it")?;
    Ok(())
}

/// Returns the options of the agent's container in compose, in the words of `podman run`.
fn options_of_compose() -> Result<BTreeSet<String>> {
    let agent = &yaml("compose.yaml")?["services"]["ros2probe"];
    let mut options = BTreeSet::new();
    let mut option = |name: &str, value: &Value| -> Result<()> {
        let value = value.as_str().with_context(|| name.to_owned())?;
        options.insert(format!("{name} {value}"));
        Ok(())
    };
    option("--network", &agent["network_mode"])?;
    option("--pid", &agent["pid"])?;
    option("--cgroupns", &agent["cgroup"])?;
    for (name, list) in [
        ("--cap-drop", "cap_drop"),
        ("--cap-add", "cap_add"),
        ("--volume", "volumes"),
    ] {
        for value in agent[list].as_sequence().context("no list")? {
            // compose puts the name of the project before that of a volume.
            match value.as_str().filter(|value| !value.starts_with('/')) {
                Some(volume) if name == "--volume" => {
                    option(name, &format!("ros2probe-{volume}").into())?;
                }
                _ => option(name, value)?,
            }
        }
    }
    ensure!(agent["read_only"] == true && agent["ulimits"]["memlock"] == -1);
    Ok(options)
}

#[test]
fn compose_starts_the_agent_with_the_documented_options() -> Result<()> {
    let words = Options::documented("--network host")?.0;
    let mut documented = BTreeSet::new();
    let mut words = words.iter().filter(|word| *word != "--read-only");
    while let (Some(option), Some(value)) = (words.next(), words.next()) {
        documented.insert(format!("{option} {value}"));
    }
    let compose = options_of_compose()?;
    ensure!(compose == documented, "{compose:?}, {documented:?}");
    Ok(())
}

#[test]
fn mounts_of_compose_exist_and_images_are_pinned() -> Result<()> {
    let compose = yaml("compose.yaml")?;
    for (name, service) in compose["services"].as_mapping().context("no services")? {
        let image = service["image"].as_str().context("no image")?;
        let (_, tag) = image.rsplit_once(':').context("no tag")?;
        ensure!(
            tag.contains('.') && tag.contains(|c: char| c.is_ascii_digit()),
            "{image}"
        );
        for mount in service["volumes"].as_sequence().context("no volumes")? {
            let mount = mount.as_str().context("not text")?;
            let (source, _) = mount.split_once(':').context("no target")?;
            let there = match source.starts_with('.') {
                true => deploy().join(source).exists(),
                false => {
                    Path::new(source).is_absolute() || compose["volumes"].get(source).is_some()
                }
            };
            ensure!(there, "{name:?} mounts {source}, which is not there");
        }
    }
    Ok(())
}

#[test]
fn only_the_port_of_the_collector_is_published_beyond_this_machine() -> Result<()> {
    let compose = yaml("compose.yaml")?;
    for service in ["prometheus", "grafana", "collector"] {
        for port in compose["services"][service]["ports"]
            .as_sequence()
            .context("no ports")?
        {
            let port = port.as_str().context("not text")?;
            let local = port.starts_with("127.0.0.1:");
            ensure!(
                local || port.starts_with("${OTLP_ADDRESS:-127.0.0.1}:"),
                "{service}: {port}"
            );
        }
    }
    Ok(())
}

#[test]
fn grafana_finds_the_data_source_and_the_dashboards() -> Result<()> {
    let compose = yaml("compose.yaml")?;
    let mounts = mounts(&compose["services"]["grafana"])?;
    let provisioned: Vec<&str> = mounts.iter().map(|(_, inside)| inside.as_str()).collect();
    for kind in ["datasources", "dashboards"] {
        let directory = format!("/etc/grafana/provisioning/{kind}/");
        ensure!(
            provisioned.iter().any(|path| path.starts_with(&directory)),
            "{kind}"
        );
    }
    let source = &yaml("grafana/datasources.yaml")?["datasources"][0];
    ensure!(source["type"] == "prometheus" && source["isDefault"] == true);
    let address = source["url"].as_str().context("no url")?;
    ensure!(reaches(&compose, address), "{address} is no service's");

    let provider = &yaml("grafana/dashboards.yaml")?["providers"][0];
    let path = provider["options"]["path"].as_str().context("no path")?;
    let mounted = mounts.iter().find(|(_, inside)| inside == path);
    let (outside, _) = mounted.with_context(|| format!("{path} is not mounted"))?;
    // Grafana treats every JSON file below this directory as a dashboard.
    let mut found = BTreeSet::new();
    for file in json_files(outside)? {
        let dashboard: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&file)?)?;
        let uid = dashboard["uid"].as_str().unwrap_or_default().to_owned();
        ensure!(
            !uid.is_empty() && dashboard["title"].is_string(),
            "{}",
            file.display()
        );
        found.insert(uid);
    }
    ensure!(found.len() == 2, "{found:?}");
    // Each link between dashboards must lead to an existing one.
    for file in json_files(outside)? {
        for link in std::fs::read_to_string(file)?.split("\"/d/").skip(1) {
            let end = link.find(|c: char| !(c.is_ascii_alphanumeric() || c == '-'));
            ensure!(
                found.contains(&link[..end.unwrap_or(link.len())]),
                "{link:.40}"
            );
        }
    }
    Ok(())
}

#[test]
fn prometheus_accepts_its_configurations() -> Result<()> {
    // As in the container, named files are where compose mounts them.
    let compose = yaml("compose.yaml")?;
    let mut text = std::fs::read_to_string(deploy().join("prometheus/prometheus.yaml"))?;
    for (outside, inside) in mounts(&compose["services"]["prometheus"])? {
        text = text.replace(&format!("{inside}/"), &format!("{}/", outside.display()));
    }
    ensure!(text.matches("/dashboards/rules/").count() == 2, "{text}");
    let directory = tempfile::tempdir()?;
    let copy = directory.path().join("prometheus.yaml");
    std::fs::write(&copy, text)?;
    std::fs::copy(
        deploy().join("prometheus/robots.yaml"),
        directory.path().join("robots.yaml"),
    )?;
    let printed = promtool(&["check", "config"], &copy)?;
    ensure!(printed.matches("rules found").count() == 2, "{printed}");

    let printed = promtool(
        &["check", "config"],
        &deploy().join("fleet/prometheus-scrape.yaml"),
    )?;
    ensure!(printed.matches("rules found").count() == 2, "{printed}");
    promtool(
        &["check", "config", "--agent"],
        &deploy().join("fleet/prometheus-agent.yaml"),
    )?;

    let mut cluster = yaml("kubernetes/prometheus.yaml")?;
    let job = cluster["scrape_configs"][0]
        .as_mapping_mut()
        .context("no job")?;
    ensure!(job.remove(NOT_BUILT_IN).is_some(), "no {NOT_BUILT_IN}");
    std::fs::write(&copy, serde_yaml::to_string(&cluster)?)?;
    promtool(&["check", "config"], &copy)?;
    Ok(())
}

#[test]
fn every_scrape_configuration_has_the_job_of_the_alert_rules() -> Result<()> {
    for file in [
        "prometheus/prometheus.yaml",
        "fleet/prometheus-agent.yaml",
        "fleet/prometheus-scrape.yaml",
        "kubernetes/prometheus.yaml",
    ] {
        let configuration = yaml(file)?;
        ensure!(
            configuration["scrape_configs"][0]["job_name"] == "ros2probe",
            "{file}"
        );
    }
    Ok(())
}

#[test]
fn collectors_use_all_defined_components_and_reach_prometheus() -> Result<()> {
    let compose = yaml("compose.yaml")?;
    for file in ["collector/collector.yaml", "fleet/collector-robot.yaml"] {
        let collector = yaml(file)?;
        let mut used = BTreeSet::new();
        for (_, pipeline) in collector["service"]["pipelines"]
            .as_mapping()
            .context("no pipelines")?
        {
            for kind in ["receivers", "processors", "exporters"] {
                for name in pipeline[kind]
                    .as_sequence()
                    .with_context(|| kind.to_owned())?
                {
                    used.insert((kind, name.as_str().context("not text")?.to_owned()));
                }
            }
        }
        for name in collector["service"]["extensions"]
            .as_sequence()
            .into_iter()
            .flatten()
        {
            used.insert(("extensions", name.as_str().context("not text")?.to_owned()));
        }
        let storage = &collector["exporters"]["otlp"]["sending_queue"]["storage"];
        if let Some(storage) = storage.as_str() {
            ensure!(
                used.contains(&("extensions", storage.to_owned())),
                "{file}: {storage}"
            );
        }
        let mut defined = BTreeSet::new();
        for kind in ["receivers", "processors", "exporters", "extensions"] {
            let Some(components) = collector[kind].as_mapping() else {
                continue;
            };
            for (name, _) in components {
                defined.insert((kind, name.as_str().context("not text")?.to_owned()));
            }
        }
        ensure!(
            used == defined,
            "{file}: used {used:?}, defined {defined:?}"
        );
    }
    let central = yaml("collector/collector.yaml")?;
    let address = central["exporters"]["prometheusremotewrite"]["endpoint"].as_str();
    ensure!(reaches(&compose, address.context("no endpoint")?));
    let receives = compose["services"]["prometheus"]["command"].as_sequence();
    let receives = receives.context("no command")?;
    ensure!(
        receives
            .iter()
            .any(|word| word == "--web.enable-remote-write-receiver")
    );
    Ok(())
}

#[test]
fn the_daemon_set_has_exactly_the_privileges_of_the_unit() -> Result<()> {
    let pod = pod()?;
    let container = &pod["containers"][0];
    ensure!(pod["hostNetwork"] == true && pod["hostPID"] == true);
    ensure!(pod["automountServiceAccountToken"] == false);
    let security = &container["securityContext"];
    ensure!(security["privileged"] == false && security["allowPrivilegeEscalation"] == false);
    ensure!(security["readOnlyRootFilesystem"] == true);
    ensure!(security["seccompProfile"]["type"] == "RuntimeDefault");
    ensure!(security["capabilities"]["drop"] == Value::Sequence(vec!["ALL".into()]));
    let added = security["capabilities"]["add"]
        .as_sequence()
        .context("adds none")?;
    let added: BTreeSet<String> = added
        .iter()
        .map(|name| format!("CAP_{}", name.as_str().unwrap_or_default()))
        .collect();
    let bounding = bounding_set()?;
    ensure!(added == bounding, "DaemonSet {added:?}, unit {bounding:?}");
    Ok(())
}

#[test]
fn the_daemon_set_has_the_memory_of_the_unit() -> Result<()> {
    let unit = std::fs::read_to_string(deploy().join("../systemd/ros2probe.service"))?;
    let memory = unit
        .lines()
        .find_map(|line| line.strip_prefix("MemoryMax="));
    // `M` of systemd is `Mi` of Kubernetes.
    let memory = format!("{}i", memory.context("the unit has no MemoryMax")?);
    let (pod, values) = (pod()?, yaml("helm/ros2probe/values.yaml")?);
    for resources in [&pod["containers"][0]["resources"], &values["resources"]] {
        ensure!(resources["limits"]["memory"] == memory, "{resources:?}");
    }
    Ok(())
}

#[test]
fn kubernetes_restarts_only_an_agent_that_no_longer_captures() -> Result<()> {
    let pod = pod()?;
    let container = &pod["containers"][0];
    let path = |probe: &str| container[probe]["httpGet"]["path"].clone();
    ensure!(path("readinessProbe") == "/readyz");
    // An agent whose interface is gone is not ready, and systemd does not restart it either.
    ensure!(path("livenessProbe") == "/livez");
    let startup = &container["startupProbe"];
    ensure!(path("startupProbe") == "/livez");
    let seconds = startup["periodSeconds"]
        .as_u64()
        .zip(startup["failureThreshold"].as_u64())
        .map(|(period, failures)| period * failures);
    ensure!(seconds == Some(300), "{startup:?}");
    Ok(())
}

#[test]
fn the_configuration_of_the_daemon_set_is_valid_and_its_paths_are_mounted() -> Result<()> {
    let documents = documents("kubernetes/ros2probe.yaml")?;
    let map = documents.iter().find(|one| one["kind"] == "ConfigMap");
    let text = map.context("no ConfigMap")?["data"]["ros2probe.yaml"].as_str();
    let text = text.context("no configuration")?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, text)?;
    let checked = Command::new(env!("CARGO_BIN_EXE_rp"))
        .arg("check-config")
        .arg(&file)
        .output()?;
    ensure!(
        checked.status.success(),
        "{}",
        String::from_utf8_lossy(&checked.stdout)
    );

    let configuration: Value = serde_yaml::from_str(text)?;
    let pod = pod()?;
    let container = &pod["containers"][0];
    let mounted: BTreeMap<&str, bool> = container["volumeMounts"]
        .as_sequence()
        .context("no mounts")?
        .iter()
        .map(|mount| {
            (
                mount["mountPath"].as_str().unwrap(),
                mount["readOnly"] == true,
            )
        })
        .collect();
    let cgroup = configuration["capture"]["cgroup"]
        .as_str()
        .context("no cgroup")?;
    ensure!(
        mounted.get(cgroup) == Some(&true),
        "{cgroup} in {mounted:?}"
    );
    ensure!(
        mounted.get("/var/lib/ros2probe") == Some(&false),
        "{mounted:?}"
    );
    let arguments = container["args"].as_sequence().context("no arguments")?;
    let file = arguments.last().and_then(Value::as_str).unwrap_or_default();
    let (directory, _) = file.rsplit_once('/').context("no path")?;
    ensure!(mounted.contains_key(directory), "{file} in {mounted:?}");

    let volumes = pod["volumes"].as_sequence().context("no volumes")?;
    let names: BTreeSet<&str> = volumes
        .iter()
        .filter_map(|volume| volume["name"].as_str())
        .collect();
    for mount in container["volumeMounts"]
        .as_sequence()
        .into_iter()
        .flatten()
    {
        ensure!(
            names.contains(mount["name"].as_str().unwrap_or_default()),
            "{mount:?}"
        );
    }
    let listen = configuration["metrics"]["listen"]
        .as_str()
        .unwrap_or_default();
    let port = &container["ports"][0]["containerPort"];
    ensure!(
        listen.ends_with(&format!(":{}", port.as_u64().context("no port")?)),
        "{listen}"
    );
    let image = container["image"].as_str().unwrap_or_default();
    ensure!(
        image.ends_with(concat!(":", env!("CARGO_PKG_VERSION"))),
        "{image}"
    );
    Ok(())
}

#[test]
fn the_image_has_the_binary_of_make_dist_the_capabilities_of_the_unit_and_no_root() -> Result<()> {
    let text = std::fs::read_to_string(deploy().join("Dockerfile"))?.replace("\\\n", " ");
    image_is_built_for_this_version_without_root(&text)?;
    image_copies_the_binary_and_the_configuration(&text)?;
    ensure!(instructions(&text, "ENTRYPOINT") == [r#"["/usr/bin/rp"]"#]);
    ensure!(instructions(&text, "ENV") == ["container=oci"]);
    ensure!(
        instructions(&text, "CMD") == [r#"["run", "--config", "/etc/ros2probe/ros2probe.yaml"]"#]
    );
    capabilities_are_those_of_both_sources(&text)
}

/// Returns the arguments of each instruction of this name in a Dockerfile.
fn instructions<'t>(text: &'t str, instruction: &str) -> Vec<&'t str> {
    let lines = text.lines();
    lines
        .filter_map(|line| line.strip_prefix(instruction)?.strip_prefix(' '))
        .collect()
}

fn image_is_built_for_this_version_without_root(text: &str) -> Result<()> {
    let of = |instruction| instructions(text, instruction);
    let arguments = of("ARG");
    ensure!(
        arguments.contains(&concat!("VERSION=", env!("CARGO_PKG_VERSION"))),
        "{arguments:?}"
    );
    ensure!(arguments.contains(&"ARCHITECTURE=x86_64"), "{arguments:?}");
    ensure!(
        of("FROM").last() == Some(&"scratch"),
        "something else is in the image"
    );
    let [user] = of("USER")[..] else {
        anyhow::bail!("no user")
    };
    let ids: Vec<u32> = user.split(':').map(str::parse).collect::<Result<_, _>>()?;
    ensure!(ids.len() == 2 && !ids.contains(&0), "{user}");
    Ok(())
}

/// Checks that the build context contains only what the image copies.
fn image_copies_the_binary_and_the_configuration(text: &str) -> Result<()> {
    let ignored = std::fs::read_to_string(deploy().join("Dockerfile.dockerignore"))?;
    let taken: Vec<&str> = ignored
        .lines()
        .filter_map(|line| line.strip_prefix('!'))
        .collect();
    let copied: Vec<(&str, &str)> = instructions(text, "COPY")
        .iter()
        .filter_map(|line| line.split_once(' '))
        .collect();
    let binary = (
        "target/dist/rp-${VERSION}-${ARCHITECTURE}",
        "/image/usr/bin/rp",
    );
    let settings = (
        "config/ros2probe.yaml",
        "/image/etc/ros2probe/ros2probe.yaml",
    );
    ensure!(
        copied == [binary, settings, ("--from=image", "/image /")],
        "{copied:?}"
    );
    ensure!(taken == ["target/dist/rp-*", settings.0], "{taken:?}");
    ensure!(deploy().join("..").join(settings.0).exists());
    Ok(())
}

/// Checks that the file's capabilities are the unit's and that for packet sockets, and that each of
/// the documented containers has those of its source.
fn capabilities_are_those_of_both_sources(text: &str) -> Result<()> {
    let set = text
        .split("setcap ")
        .nth(1)
        .and_then(|rest| rest.split("+p ").next());
    let set: BTreeSet<String> = set
        .context("no setcap")?
        .split(',')
        .map(str::to_uppercase)
        .collect();
    let mut both = bounding_set()?;
    both.insert("CAP_NET_RAW".to_owned());
    ensure!(
        set == both,
        "file {set:?}, unit and packet sockets {both:?}"
    );
    for (with, other) in [
        ("--network host", "CAP_NET_RAW"),
        ("--network container:robot", "CAP_NET_ADMIN"),
    ] {
        let words = Options::documented(with)?.0;
        let added = words.windows(2).filter(|pair| pair[0] == "--cap-add");
        let added = added.map(|pair| format!("CAP_{}", pair[1]));
        let added: BTreeSet<String> = added.chain([other.to_owned()]).collect();
        ensure!(added == both, "{with} {added:?}, both sources {both:?}");
    }
    Ok(())
}

#[test]
fn every_file_that_the_documents_link_to_exists() -> Result<()> {
    let root = deploy().join("..");
    for document in [
        "docs/containers.md",
        "docs/fleet.md",
        "deploy/README.md",
        "dashboards/README.md",
    ] {
        let text = std::fs::read_to_string(root.join(document))?;
        let directory = root.join(document).parent().unwrap().to_owned();
        let links = text
            .split("](")
            .skip(1)
            .filter_map(|rest| Some(rest.split_once(')')?.0));
        let mut found = 0;
        for link in links.filter(|link| !link.starts_with("http") && !link.starts_with('#')) {
            let path = link.split_once('#').map_or(link, |(path, _)| path);
            ensure!(directory.join(path).exists(), "{document} links to {link}");
            found += 1;
        }
        ensure!(found > 0, "{document} links to nothing");
    }
    Ok(())
}

/// Earlier, the table lacked the socket and the service of the broker.
#[test]
fn the_installation_by_hand_copies_every_unit_that_the_service_wants() -> Result<()> {
    let unit = std::fs::read_to_string(deploy().join("../systemd/ros2probe.service"))?;
    let page = std::fs::read_to_string(deploy().join("README.md"))?;
    let wanted = unit.lines().find_map(|line| line.strip_prefix("Wants="));
    let mut units = vec!["ros2probe.service".to_owned()];
    for name in wanted.context("wants nothing")?.split(' ') {
        units.push(name.to_owned());
        // A socket starts the service of its name.
        let activated = name.strip_suffix(".socket");
        units.extend(activated.map(|stem| format!("{stem}.service")));
    }
    ensure!(units.len() > 2, "{units:?}");
    for name in units {
        let row = format!("| `systemd/{name}` | `/etc/systemd/system/{name}` |");
        ensure!(page.contains(&row), "no row {row}");
    }
    let reload = page.find("systemctl daemon-reload");
    let enable = page.find("systemctl enable --now ros2probe");
    ensure!(reload.is_some() && reload < enable, "reloads too late");
    Ok(())
}

fn deploy() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy")
}

fn yaml(file: &str) -> Result<Value> {
    let text = std::fs::read_to_string(deploy().join(file)).with_context(|| file.to_owned())?;
    serde_yaml::from_str(&text).with_context(|| file.to_owned())
}

fn documents(file: &str) -> Result<Vec<Value>> {
    let text = std::fs::read_to_string(deploy().join(file))?;
    let documents = serde_yaml::Deserializer::from_str(&text).map(Value::deserialize);
    Ok(documents.collect::<Result<_, _>>()?)
}

/// Returns the capabilities that the unit's process may have.
fn bounding_set() -> Result<BTreeSet<String>> {
    let unit = std::fs::read_to_string(deploy().join("../systemd/ros2probe.service"))?;
    let set = unit
        .lines()
        .find_map(|line| line.strip_prefix("CapabilityBoundingSet="));
    let set = set.context("the unit bounds nothing")?;
    Ok(set.split(' ').map(str::to_owned).collect())
}

/// Returns the pod of the DaemonSet.
fn pod() -> Result<Value> {
    let documents = documents("kubernetes/ros2probe.yaml")?;
    let set = documents.into_iter().find(|one| one["kind"] == "DaemonSet");
    let set = set.context("no DaemonSet")?;
    let selector = &set["spec"]["selector"]["matchLabels"];
    ensure!(
        *selector == set["spec"]["template"]["metadata"]["labels"],
        "selects no pod"
    );
    Ok(set["spec"]["template"]["spec"].clone())
}

/// Returns the files of this directory that a service mounts: path here, and path in the service.
fn mounts(service: &Value) -> Result<Vec<(PathBuf, String)>> {
    let mounts = service["volumes"].as_sequence().context("no volumes")?;
    let mut bound = Vec::new();
    for mount in mounts.iter().filter_map(Value::as_str) {
        let mut parts = mount.split(':');
        let (outside, inside) = parts.next().zip(parts.next()).context("no target")?;
        if outside.starts_with('.') {
            bound.push((deploy().join(outside).canonicalize()?, inside.to_owned()));
        }
    }
    Ok(bound)
}

/// Returns whether a URL names a service and the port that it publishes.
fn reaches(compose: &Value, url: &str) -> bool {
    let address = url
        .strip_prefix("http://")
        .and_then(|rest| rest.split('/').next());
    let Some((host, port)) = address.and_then(|address| address.split_once(':')) else {
        return false;
    };
    let published = compose["services"][host]["ports"].as_sequence();
    let mut published = published.into_iter().flatten().filter_map(Value::as_str);
    published.any(|each| each.ends_with(&format!(":{port}")))
}

fn json_files(directory: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if path.is_dir() {
            found.extend(json_files(&path)?);
        } else if path
            .extension()
            .is_some_and(|extension| extension == "json")
        {
            found.push(path);
        }
    }
    Ok(found)
}

fn promtool(arguments: &[&str], file: &Path) -> Result<String> {
    let output = Command::new("promtool").args(arguments).arg(file).output();
    let output = output.context("run `make prerequisites` or `apt-get install prometheus`")?;
    let printed = [output.stdout, output.stderr].concat();
    let printed = String::from_utf8_lossy(&printed).into_owned();
    ensure!(output.status.success(), "{}: {printed}", file.display());
    Ok(printed)
}
