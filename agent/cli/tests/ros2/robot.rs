//! A robot of seven topics made of real ROS 2 nodes, 8 B to 2.7 MB and 0.02 to 250 Hz. The bag,
//! `echo` and `hz` have the messages of its publisher's log, and name each missing message.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::bag_messages::for_each_message;
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use serde::Deserialize;
use serde_json::Value;

use crate::host::{Host, Middleware, RP};
use crate::installed;

const PATIENCE: Duration = Duration::from_secs(60);
/// Topics of `ros2/robot.py`, and the number of messages that it publishes on each.
const TOPICS: [(&str, u64); 7] = [
    ("/beat", 10),
    ("/cam", 100),
    ("/imu", 2500),
    ("/mode", 1),
    ("/odom", 500),
    ("/points", 50),
    ("/tf", 1000),
];
/// `echo` prints the messages of this topic by their numbers, which are in the header's frame.
const ECHOED: [&str; 3] = ["/imu", "/cam", "/odom"];
/// Minimum share of small messages that polling of shared memory captures, also on a busy machine.
/// Large messages are seldom captured, because their pieces reuse the same memory. All others are
/// counted.
const CAPTURED: f64 = 0.7;
const LARGE: [&str; 2] = ["/cam", "/points"];

// Coverage: shared memory, sampled | rmw_fastrtps | installed | counted
#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn fast_dds_with_shared_memory_is_recorded_or_counted_to_the_message() -> Result<()> {
    check_bag(Middleware::FastSampled)
}

// Coverage: shared memory, with a uprobe | rmw_fastrtps | installed | exact
#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn every_message_of_fast_dds_with_shared_memory_and_the_uprobe_is_recorded() -> Result<()> {
    check_bag(Middleware::FastExact("auto"))
}

// Coverage: UDP | rmw_fastrtps | installed | exact
#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn every_message_of_fast_dds_over_udp_is_recorded() -> Result<()> {
    check_bag(Middleware::FastUdp)
}

// Coverage: UDP | rmw_cyclonedds | installed | exact
#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn every_message_of_cyclone_dds_is_recorded() -> Result<()> {
    check_bag(Middleware::Cyclone)
}

// Coverage: Zenoh over TCP | rmw_zenoh | installed | exact
#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn every_message_of_zenoh_is_recorded() -> Result<()> {
    check_bag(Middleware::Zenoh)
}

fn check_bag(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let robot = Robot {
        host: Host::new(&network, middleware)?,
    };
    let agent = robot.host.agent("watch: ['/**']\n")?;
    let _router = robot.host.router_if_any()?;
    let mut subscriber = robot.node("subscribe")?;
    subscriber.wait_for("ready", PATIENCE)?;
    let mut publisher = robot.node("publish")?;
    publisher.wait_for("matched", PATIENCE)?;
    agent.scrape_until("all topics are known with both ends", |page| {
        let sum = |name, topic| page.sum(name, &[("topic", topic)]);
        TOPICS.iter().all(|(topic, _)| {
            sum("ros2_topic_publishers", topic) > 0.0
                && sum("ros2_topic_subscriptions", topic) > 0.0
        })
    })?;

    let bag = robot.host.file("bag");
    let Commands {
        mut recorder,
        mut echoes,
        mut hz,
    } = robot.commands(&bag)?;
    robot.wait_for_subscriptions(&agent, 2 + ECHOED.len())?;
    if middleware == Middleware::FastExact("auto") {
        let ability = [("ability", "shared_memory_exact")];
        agent.scrape_until("the uprobe is attached", |page| {
            page.sum("ros2probe_capture_ability", &ability) == 1.0
        })?;
    }

    publisher.write_line("go")?;
    publisher.wait_for("done", PATIENCE)?;
    let published = robot.log("publish")?;
    wait_until("the subscriber has all", || {
        Ok(robot.log("subscribe")? == published)
    })
    .with_context(|| robot.unreceived(&published))?;
    // The last HEARTBEAT is sent up to 3 s later, and the agent waits for missing messages.
    std::thread::sleep(Duration::from_secs(4));
    let page = agent.scrape()?;
    hz.interrupt()?;
    for (_, echo) in &mut echoes {
        echo.interrupt()?;
    }
    ensure!(
        recorder.interrupt()?.code() == Some(0),
        "{}",
        recorder.errors()
    );
    println!("{}", recorder.errors());

    let has_network = !matches!(
        middleware,
        Middleware::FastSampled | Middleware::FastExact(_)
    );
    if has_network {
        check_deliveries(&agent, &published)?;
    }

    let is_looked_at = middleware == Middleware::FastSampled;
    let unknown_of = bag_holds_or_names_each_message(&bag, &published, &page, is_looked_at)?;
    for (topic, echo) in &echoes {
        let sent = published.get(*topic).context("not published")?;
        let unseen = unknown_of.get(topic).copied().unwrap_or_default();
        echo.prints_or_names_each_message(topic, sent, unseen)?;
    }
    let rates = hz.rates()?;
    println!("hz /imu: {rates:?}");
    let last = rates.last().context("hz printed nothing")?;
    // Repaired messages arrive late, and the subscriber's own rate is then lower.
    let received = robot.rate("subscribe", "/imu")?;
    let expected = received.min(250.0) - 5.0..255.0;
    ensure!(expected.contains(last), "{rates:?}, received {received}");
    Ok(())
}

/// Compares the deliveries at sockets with the log of the only subscriber, which has all messages.
/// The last messages count once the agent has read their records.
fn check_deliveries(agent: &Agent<'_>, received: &Numbers) -> Result<()> {
    let agrees = |page: &Scrape| {
        received.iter().all(|(topic, numbers)| {
            let sum = |name| page.sum(name, &[("topic", topic)]);
            sum("ros2_topic_delivered_messages_total") == numbers.len() as f64
                && sum("ros2_topic_delivery_lost_messages_total") == 0.0
                && sum("ros2_topic_delivery_pending_messages") == 0.0
        })
    };
    agent.scrape_until("deliveries as the subscriber logs", agrees)?;
    Ok(())
}

/// Compares a bag, its report and the page with the publisher's log. Returns by topic the number of
/// messages whose absence could not be detected.
fn bag_holds_or_names_each_message(
    bag: &Path,
    published: &Numbers,
    page: &Scrape,
    is_looked_at: bool,
) -> Result<BTreeMap<&'static str, u64>> {
    let (recorded, report) = (numbers(bag)?, report_of(bag)?);
    let mut unknown_of = BTreeMap::new();
    for (topic, count) in TOPICS {
        let sent = published.get(topic).cloned().unwrap_or_default();
        ensure!(sent == (0..count).collect(), "{topic}: {sent:?}");
        let in_bag = recorded.get(topic).cloned().unwrap_or_default();
        ensure!(in_bag.is_subset(&sent), "{topic}: {in_bag:?}");
        let missing = missing(&report, topic);
        println!(
            "{topic}: {} of {count} recorded, {missing} named as missing",
            in_bag.len()
        );
        // Messages before the first one seen of a writer cannot be counted, nor the last ones
        // without an observed HEARTBEAT or ACKNACK for them.
        let (before, after) = match is_looked_at {
            true => unknown(&in_bag, &report, topic, count)?,
            false => (0, 0),
        };
        // If the report counts further runs without naming them, the last numbers may be among
        // them.
        let counted_only = count.saturating_sub(in_bag.len() as u64 + missing + before);
        let after = match report.get("missing_runs_unnamed").and_then(Value::as_u64) {
            Some(0) => after,
            _ => after.min(counted_only),
        };
        ensure!(
            before * 2 <= count && after * 20 <= count.max(20),
            "{topic}: {before} unseen at first, {after} at last: {report:#}"
        );
        let unseen = before + after;
        unknown_of.insert(topic, unseen);
        ensure!(
            in_bag.len() as u64 + missing + unseen == count,
            "{topic}: {} recorded, {missing} missing and {unseen} unknown of {count}, not named: {:?}: {report:#}\n{}",
            in_bag.len(),
            unnamed(&in_bag, &report, topic, count),
            page.suspicious_counters()
        );
        let least = match is_looked_at {
            true if LARGE.contains(&topic) => 0.0,
            true => CAPTURED * count as f64,
            false => count as f64,
        };
        ensure!(
            in_bag.len() as f64 >= least,
            "{topic}: {report:#}\n{}",
            page.suspicious_counters()
        );
        let counted = page.sum("ros2_topic_messages_total", &[("topic", topic)]);
        ensure!(
            counted == (count - unseen) as f64,
            "{topic}: {counted} counted of {count}: {}",
            page.suspicious_counters()
        );
        let lost = page.sum("ros2_topic_lost_messages_total", &[("topic", topic)]);
        ensure!(
            lost == 0.0,
            "{topic}: {lost} lost: {}",
            page.suspicious_counters()
        );
    }
    Ok(unknown_of)
}

/// Numbers of messages by topic.
type Numbers = BTreeMap<String, BTreeSet<u64>>;

/// The commands that run while the robot publishes.
struct Commands {
    recorder: Rp,
    echoes: Vec<(&'static str, Rp)>,
    hz: Rp,
}

struct Robot<'n> {
    host: Host<'n>,
}

/// An `rp` command and its output.
struct Rp {
    process: Process,
    output: PathBuf,
    errors: PathBuf,
}

#[derive(Deserialize)]
struct Event {
    topic: String,
    seq: u64,
    /// Time in nanoseconds.
    t: u64,
}

impl Robot<'_> {
    /// Starts a node of `ros2/robot.py` in a separate process.
    fn node(&self, role: &str) -> Result<Process> {
        self.host.python("robot.py", &[role, &self.log_of(role)])
    }

    /// Starts all commands, and waits until the recorder has subscribed to each topic.
    fn commands(&self, bag: &Path) -> Result<Commands> {
        let output = bag.display().to_string();
        let recorder = self.rp("record", &["bag", "record", "-a", "-o", &output])?;
        wait_until("it records all topics", || {
            let output_text = recorder.errors();
            let is_subscribed =
                |(topic, _): &(&str, u64)| output_text.contains(&format!("'{topic}'"));
            Ok(output_text.contains("Recording...") && TOPICS.iter().all(is_subscribed))
        })
        .with_context(|| recorder.errors())?;
        let mut echoes = Vec::new();
        for topic in ECHOED {
            let arguments = ["topic", "echo", topic, "--field", "header.frame_id"];
            echoes.push((topic, self.rp(&format!("echo{topic}"), &arguments)?));
        }
        let hz = self.rp("hz", &["topic", "hz", "/imu"])?;
        Ok(Commands {
            recorder,
            echoes,
            hz,
        })
    }

    fn log_of(&self, role: &str) -> String {
        self.host.path(&format!("{role}.jsonl"))
    }

    fn events(&self, role: &str) -> Result<Vec<Event>> {
        let mut events = Vec::new();
        for line in BufReader::new(File::open(self.log_of(role))?).lines() {
            // The last line may be incomplete.
            events.extend(serde_json::from_str::<Event>(&line?));
        }
        Ok(events)
    }

    /// Returns the numbers by topic.
    fn log(&self, role: &str) -> Result<Numbers> {
        let mut numbers: Numbers = BTreeMap::new();
        for event in self.events(role)? {
            numbers.entry(event.topic).or_default().insert(event.seq);
        }
        Ok(numbers)
    }

    /// Returns the messages of a topic per second, over the whole log.
    fn rate(&self, role: &str, topic: &str) -> Result<f64> {
        let events = self.events(role)?;
        let times = events.iter().filter(|event| event.topic == topic);
        let times: Vec<u64> = times.map(|event| event.t).collect();
        let (first, last) = (times.iter().min(), times.iter().max());
        let span = last.context("none")? - first.context("none")?;
        Ok((times.len() - 1) as f64 * 1e9 / span as f64)
    }

    /// Returns the messages that the subscriber lacks, for a failed test.
    fn unreceived(&self, published: &Numbers) -> String {
        let received = self.log("subscribe").unwrap_or_default();
        let lacking = published.iter().map(|(topic, sent)| {
            let received = received.get(topic).cloned().unwrap_or_default();
            format!("{topic}: {:?}", sent - &received)
        });
        lacking.collect::<Vec<_>>().join(", ")
    }

    fn rp(&self, name: &str, arguments: &[&str]) -> Result<Rp> {
        let file = |kind| {
            let name = format!("{}.{kind}", name.replace('/', "-"));
            self.host.file(&name)
        };
        let (output, errors) = (file("out"), file("err"));
        let mut enter = self.host.network.on_network();
        enter.extend(["env", "-u", "ROS_DOMAIN_ID"].map(str::to_owned));
        enter.push(format!("ROS_DISTRO={}", installed::distro()));
        let shell = r#"out=$1; shift; exec "$0" "$@" >"$out""#;
        let socket = self.host.socket();
        let path = output.display().to_string();
        let mut words = vec!["-c", shell, RP, &path];
        words.extend(arguments);
        words.extend(["--socket", &socket]);
        let process = Process::start_with(&enter, "bash", words, File::create(&errors)?.into())?;
        Ok(Rp {
            process,
            output,
            errors,
        })
    }

    /// Waits until the agent serves this many streams of samples.
    fn wait_for_subscriptions(&self, agent: &Agent<'_>, count: usize) -> Result<()> {
        let open = |page: &Scrape| page.sum("ros2probe_subscriptions", &[]);
        agent.scrape_until("subscriptions", |page| open(page) >= count as f64)?;
        Ok(())
    }
}

impl Rp {
    fn prints_or_names_each_message(
        &self,
        topic: &str,
        sent: &BTreeSet<u64>,
        unseen: u64,
    ) -> Result<()> {
        let (echoed, missed) = (self.numbers()?, self.missed());
        println!(
            "echo {topic}: {} printed, {missed} named as missing",
            echoed.len()
        );
        ensure!(
            echoed.is_sorted_by(|one, next| one < next),
            "{topic}: out of order"
        );
        let distinct: BTreeSet<u64> = echoed.iter().copied().collect();
        ensure!(distinct.is_subset(sent), "{topic}: {echoed:?}");
        ensure!(
            distinct.len() as u64 + missed + unseen == sent.len() as u64,
            "{topic}: {} printed and {missed} missing of {}:\n{}",
            distinct.len(),
            sent.len(),
            self.errors()
        );
        Ok(())
    }

    fn errors(&self) -> String {
        fs::read_to_string(&self.errors).unwrap_or_default()
    }

    fn interrupt(&mut self) -> Result<std::process::ExitStatus> {
        self.process.signal("INT")?;
        self.process.wait(PATIENCE)
    }

    /// Returns the numbers of the messages that `echo` printed, in the printed order.
    fn numbers(&self) -> Result<Vec<u64>> {
        let text = fs::read_to_string(&self.output)?;
        let lines = text.lines().map(|line| line.trim_matches('\''));
        let numbers = lines.filter(|line| !matches!(*line, "---" | ""));
        numbers
            .map(|line| line.parse().with_context(|| line.to_owned()))
            .collect()
    }

    /// Returns how many messages `echo` reports as missing.
    fn missed(&self) -> u64 {
        let errors = self.errors();
        let counts = errors
            .lines()
            .filter(|line| line.contains("could not be captured"));
        let counts = counts.filter_map(|line| {
            line.split_whitespace()
                .find_map(|word| word.parse::<u64>().ok())
        });
        counts.sum()
    }

    fn rates(&self) -> Result<Vec<f64>> {
        let text = fs::read_to_string(&self.output)?;
        let rates = text
            .lines()
            .filter_map(|line| line.strip_prefix("average rate: "));
        rates.map(|rate| Ok(rate.trim().parse()?)).collect()
    }
}

/// Returns the application's numbers in a bag by topic: one below the writer's sequence number.
fn numbers(bag: &Path) -> Result<Numbers> {
    let mut numbers: Numbers = BTreeMap::new();
    let mut last = BTreeMap::new();
    for_each_message(bag, |message| {
        let topic = message.channel.topic.clone();
        let number = u64::from(message.sequence) - 1;
        let delay = message.log_time.saturating_sub(message.publish_time);
        if TOPICS.iter().any(|(name, _)| *name == topic) {
            let before = last.insert(topic.clone(), (number, message.log_time, delay));
            let is_next =
                before.is_none_or(|(at, time, _)| at < number && time <= message.log_time);
            ensure!(
                is_next,
                "{topic}: {number} at {}, {delay} ns after it was sent, comes behind {before:?}",
                message.log_time
            );
        }
        numbers.entry(topic).or_default().insert(number);
        Ok(())
    })?;
    Ok(numbers)
}

/// Returns the report in a bag's metadata.
fn report_of(bag: &Path) -> Result<Value> {
    let text = fs::read_to_string(bag.join("metadata.yaml"))?;
    let metadata = ros2probe_bag::metadata::Metadata::read(&text)?;
    let report = metadata.custom_data.get("ros2probe");
    Ok(serde_json::from_str(report.context("no report")?)?)
}

/// Returns how many numbers are below the lowest one that is in the bag or reported as missing, and
/// how many are above the highest.
fn unknown(in_bag: &BTreeSet<u64>, report: &Value, topic: &str, count: u64) -> Result<(u64, u64)> {
    let runs = report["missing_runs"].as_array().context("no runs")?;
    let runs = runs.iter().filter(|run| run["topic"] == topic);
    let ends = runs.flat_map(|run| [&run["first_sequence_number"], &run["last_sequence_number"]]);
    let named = ends.filter_map(Value::as_u64).map(|number| number - 1);
    let known: BTreeSet<u64> = in_bag.iter().copied().chain(named).collect();
    let first = known.first().context("nothing is known")?;
    let last = known.last().context("nothing is known")?;
    Ok((*first, count - 1 - last))
}

/// Returns the numbers that are neither in the bag nor reported as missing.
fn unnamed(in_bag: &BTreeSet<u64>, report: &Value, topic: &str, count: u64) -> Vec<u64> {
    let runs = report["missing_runs"]
        .as_array()
        .cloned()
        .unwrap_or_default();
    let runs = runs.iter().filter(|run| run["topic"] == topic);
    let bound = |run: &Value, end: &str| run[end].as_u64().unwrap_or_default();
    let runs: Vec<_> = runs
        .map(|run| bound(run, "first_sequence_number")..=bound(run, "last_sequence_number"))
        .collect();
    let is_named = |number: &u64| runs.iter().any(|run| run.contains(&(number + 1)));
    let lacking = (0..count).filter(|number| !in_bag.contains(number));
    lacking.filter(|number| !is_named(number)).collect()
}

/// Returns the number of messages of a topic that the report counts as missing, for whatever
/// reason.
fn missing(report: &Value, topic: &str) -> u64 {
    let reasons = ["incomplete", "not_captured", "dropped", "unwritten"];
    let topic = report.pointer("/topics").and_then(|all| all.get(topic));
    let counts = reasons.iter().map(|reason| topic?.get(reason)?.as_u64());
    counts.map(Option::unwrap_or_default).sum()
}
