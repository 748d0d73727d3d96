//! Two robots with an agent each, and a real Prometheus with the shipped rules. Every query of
//! every panel and every rule returns data, except queries about events that do not happen here.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::dashboard::{self, Dashboard, legend_labels, resolved};
use ros2probe_testing::harness::agent::{Agent, at_the_sockets_of};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, robot};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::prometheus::Prometheus;
use serde_yaml::Value;

/// Queries of panels that rightly return no data on these robots, with the reason.
const EXPECTED_EMPTY_QUERIES: [(&str, &str); 20] = [
    (
        "robot: Where latency arises B",
        "nothing is sent and received by sockets of one host",
    ),
    (
        "robot: Where latency arises D",
        "nothing is lost, so nothing is sent again",
    ),
    (
        "robot: Dropped by the agent E",
        "packet rings are of the source `wire`",
    ),
    (
        "robot: Endpoints that cannot communicate B",
        "a topic has one type",
    ),
    (
        "robot: Endpoints that cannot communicate C",
        "a type has one definition",
    ),
    ("robot: Hops of chains A", "no node copies a stamp"),
    ("robot: Hops of chains B", "no node copies a stamp"),
    ("robot: Names in conflict A", "names are taken once"),
    ("robot: Names in conflict B", "all nodes are in one domain"),
    (
        "robot: Sampled in shared memory A",
        "RustDDS has no shared memory",
    ),
    ("robot: Messages of logs A", "no node logs"),
    ("robot: Diagnostics A", "no node publishes /diagnostics"),
    ("robot: Age of transforms A", "no node publishes /tf"),
    ("robot: Jumps of transforms A", "no node publishes /tf"),
    ("robot: Jumps of transforms B", "no node publishes /tf"),
    ("robot: Batteries A", "no robot has a battery"),
    ("robot: Pushed over OTLP A", "nothing is pushed"),
    ("robot: Not delivered over OTLP A", "nothing is pushed"),
    ("robot: Unreadable packets A", "everything can be read"),
    ("robot: Drops of unknown content A", "no socket overflows"),
];

/// Alerts whose condition holds here. The other alerts are about failing agents and links.
const EXPECTED_ALERTS: [&str; 8] = [
    "Ros2TopicSilent",
    "Ros2TopicNotPublished",
    "Ros2TopicRateBelowContract",
    "Ros2TopicRateAboveContract",
    "Ros2TopicPublishersBelowContract",
    "Ros2TopicSubscribersBelowContract",
    "Ros2TopicLatencyAboveContract",
    "Ros2QosIncompatible",
];

/// Labels that may be empty, which to Prometheus is the same as absent.
const OPTIONAL_QUERIES: [&str; 2] = ["host", "reason"];

/// A query that must return data.
struct Question {
    name: String,
    expression: String,
    /// Labels that the answer must have.
    labels: Vec<String>,
}

#[test]
fn every_panel_and_every_rule_has_data_of_two_robots() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let robot_agent = start(&link.robot, directory.path())?;
    let monitor_agent = start(&link.monitor, directory.path())?;
    let targets = [&link.robot, &link.monitor].map(|host| format!("{}:17400", host.address()));
    let rules = rule_files();
    let prometheus = Prometheus::start(&link.monitor, &targets, &rules)?;
    let mut roles = Vec::new();
    for (host, role) in [
        (&link.robot, "base"),
        (&link.robot, "lidar"),
        (&link.monitor, "monitor"),
    ] {
        roles.push(Process::start(&host.inside(), robot()?, ["--role", role])?);
    }
    // This publisher never starts, and the subscriber requests more than the publisher offers.
    let quiet = Stream {
        topic: "/quiet".to_owned(),
        ..Stream::small(1)
    };
    let demanding = Stream {
        reliable: true,
        ..quiet.clone()
    };
    let listener = &["/listener"];
    let subscriber = Peer::start(
        &link.monitor,
        Stack::Rust,
        Role::Subscriber,
        &demanding,
        listener,
    )?;
    let publisher = Peer::start(
        &link.robot,
        Stack::Rust,
        Role::Publisher,
        &quiet,
        &["/sensor"],
    )?;

    let dashboards = dashboard::all()?;
    let mut questions = Vec::new();
    for dashboard in &dashboards {
        questions.extend(of_dashboard(dashboard, &targets)?);
    }
    for file in &rules {
        questions.extend(of_rules(file)?);
    }
    ensure!(questions.len() > 120, "{} questions", questions.len());
    let names: BTreeSet<&str> = questions.iter().map(|each| each.name.as_str()).collect();
    for name in EXPECTED_EMPTY_QUERIES
        .iter()
        .map(|(name, _)| *name)
        .chain(EXPECTED_ALERTS)
    {
        ensure!(names.contains(name), "{name} does not exist");
    }
    ask(&prometheus, questions)?;
    drop((robot_agent, monitor_agent, roles, subscriber, publisher));
    Ok(())
}

/// Runs all queries, and repeats those without an answer.
fn ask(prometheus: &Prometheus<'_>, mut questions: Vec<Question>) -> Result<()> {
    let deadline = Instant::now() + Duration::from_secs(90);
    let all = questions.len();
    while !questions.is_empty() {
        let mut unanswered = Vec::new();
        for question in questions {
            let answer = prometheus.label_sets(&question.expression)?;
            let has = |label: &String| answer.iter().any(|series| series.contains_key(label));
            if answer.is_empty() || !question.labels.iter().all(has) {
                unanswered.push((question, answer));
            }
        }
        // A query whose answer may be empty has run once, so it is valid.
        unanswered.retain(|(question, _)| question.needs_an_answer());
        let late = unanswered.iter().map(|(question, answer)| {
            let Question {
                name,
                expression,
                labels,
            } = question;
            format!("{name}: {expression} has not {labels:?}: {answer:?}\n")
        });
        ensure!(
            Instant::now() < deadline,
            "{} of {all} without an answer:\n{}",
            unanswered.len(),
            late.collect::<String>()
        );
        questions = unanswered
            .into_iter()
            .map(|(question, _)| question)
            .collect();
        std::thread::sleep(Duration::from_millis(500));
    }
    Ok(())
}

fn of_dashboard(dashboard: &Dashboard, targets: &[String; 2]) -> Result<Vec<Question>> {
    let values = BTreeMap::from([
        ("job", "ros2probe".to_owned()),
        // The dashboard of one robot names the robot that also receives. The dashboard of the fleet
        // shows all robots.
        (
            "instance",
            match dashboard.file.as_str() {
                "robot" => targets[1].clone(),
                _ => ".*".to_owned(),
            },
        ),
        ("domain_id", ".*".to_owned()),
        ("topic", ".*".to_owned()),
        ("writer", ".*".to_owned()),
        ("__rate_interval", "10s".to_owned()),
        ("__range", "1m".to_owned()),
    ]);
    let mut questions = Vec::new();
    for (name, series, label) in dashboard.variables()? {
        questions.push(Question {
            name: format!("{}: variable {name}", dashboard.file),
            expression: resolved(&series, &values)?,
            labels: vec![label],
        });
    }
    for panel in dashboard.panels() {
        let columns = panel.columns();
        for (index, target) in panel.targets().into_iter().enumerate() {
            let labels = legend_labels(target.legend).into_iter();
            // The columns of a table cover all its queries together, and only the first query has
            // the key.
            let labels = labels.chain(
                columns
                    .iter()
                    .copied()
                    .filter(|_| panel.targets().len() == 1),
            );
            let labels = labels.filter(|label| !OPTIONAL_QUERIES.contains(label));
            questions.push(Question {
                expression: resolved(target.expression, &values)
                    .with_context(|| format!("query {index}"))?,
                labels: labels.map(str::to_owned).collect(),
                name: target.name,
            });
        }
    }
    Ok(questions)
}

fn of_rules(file: &Path) -> Result<Vec<Question>> {
    let rules: Value = serde_yaml::from_str(&std::fs::read_to_string(file)?)?;
    let groups = rules["groups"].as_sequence().context("no groups")?;
    let rules = groups
        .iter()
        .filter_map(|group| group["rules"].as_sequence());
    let questions = rules.flatten().map(|rule| {
        let text = |key: &str| rule[key].as_str().map(str::to_owned);
        // A recording rule must have recorded its series; an alert is tested by its condition.
        let recorded = text("record").map(|name| (format!("rule: {name}"), name));
        let alert = text("alert").zip(text("expr"));
        let (name, expression) = recorded.or(alert).context("neither recorded nor alert")?;
        let labels = Vec::new();
        Ok(Question {
            name,
            expression,
            labels,
        })
    });
    questions.collect()
}

impl Question {
    fn needs_an_answer(&self) -> bool {
        let name = self.name.as_str();
        let alert = name.starts_with("Ros2");
        let empty = EXPECTED_EMPTY_QUERIES
            .iter()
            .any(|(panel, _)| *panel == name);
        !empty && (!alert || EXPECTED_ALERTS.contains(&name))
    }
}

fn rule_files() -> [PathBuf; 2] {
    ["rules", "alerts"]
        .map(|kind| dashboard::directory().join(format!("rules/ros2probe.{kind}.yaml")))
}

fn start<'a>(host: &'a Namespace, directory: &Path) -> Result<Agent<'a>> {
    let configuration = directory.join(format!("{}.yaml", host.name()));
    // These expectations exceed what the topics do, so that they are violated.
    let text = format!(
        "watch:\n\
         - {{topic: /**, per_subscriber: true}}\n\
         - {{topic: /imu, min_rate_hz: 1000, publishers: 9, subscribers: 9}}\n\
         - {{topic: /cmd_vel, max_rate_hz: 1, max_latency_ms: 0.001}}\n\
         - {{topic: /quiet, max_silence_s: 1}}\n\
         - {{topic: /camera, max_silence_s: 1}}\n\
         chains: [{{from: /scan, to: /cmd_vel, max_latency_ms: 100, domain: 0}}]\n\
         {}\
         metrics: {{listen: '0.0.0.0:17400'}}\n",
        at_the_sockets_of(host)
    );
    std::fs::write(&configuration, text)?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}
