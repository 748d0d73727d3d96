//! Recordings of a running robot, by the agent and by `rp bag record`. Every sent message is in the
//! bag or counted as missing, however the recording, its reader or its storage ends. Needs root.

mod robot;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::{PoisonError, RwLock};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use robot::{Recorder, Robot, is_exact, numbers, sent, settled};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_until;
use serde_json::{Value, json};
use tempfile::TempDir;

const RP: &str = env!("CARGO_BIN_EXE_rp");
const PATIENCE: Duration = Duration::from_secs(60);
/// Size and number of the messages of two lidars with 13 MB/s each.
const CLOUD: usize = 644_000;
const CLOUDS: u64 = 40;
/// Size of a message of the stream that fills a small disk, in bytes.
const SCAN: usize = 64_000;
const SMALL: u64 = 600;
/// Maximum time from a message to its write into the file: a second, and a margin for a busy
/// machine.
const UNFLUSHED: Duration = Duration::from_secs(5);

/// Point clouds run alone on the machine.
static MACHINE: RwLock<()> = RwLock::new(());

#[test]
fn every_message_is_in_the_bags_or_counted_as_missing() -> Result<()> {
    let _alone = MACHINE.write().unwrap_or_else(PoisonError::into_inner);
    let host = Namespace::isolated()?;
    let robot = Robot::start(&host, "watch: ['/**']\n", &host.on_network())?;
    let streams = [
        (Stack::Cyclone, "/front", CLOUD, CLOUDS),
        (Stack::Fast, "/rear", CLOUD, CLOUDS),
        (Stack::Cyclone, "/imu", 320, SMALL),
        (Stack::Fast, "/odom", 320, SMALL),
    ];
    let mut pairs = start_pairs(&host, &streams)?;
    robot.agent.scrape_until("published", |page| {
        let is_known = |topic| page.sum("ros2_topic_publishers", &[("topic", topic)]) > 0.0;
        streams.iter().all(|(_, topic, ..)| is_known(topic))
    })?;

    // The agent and a client record simultaneously, and the watches count in addition.
    let (status, _) = robot.ask("POST", "/recordings", &json!({"name": "all"}))?;
    ensure!(status == 201, "{status}");
    let mut client = Recorder::start(&robot, "client", &["-a"])?;
    for (_, _, publisher, _) in &mut pairs {
        publisher.start_sending()?;
    }
    let page = settled(&robot, &pairs, 1)?;
    let (status, ended) = robot.ask("DELETE", "/recordings/all", &Value::Null)?;
    ensure!(
        (status, &ended["state"]) == (200, &json!("ended")),
        "{ended}"
    );
    ensure!(client.interrupt()?.code() == Some(0), "{}", client.stderr());
    let by_client = robot.directory.path().join("client");
    for (bag, report) in [
        (robot.bags().join("all"), ended["report"].clone()),
        (by_client.clone(), report_of(&by_client)?),
    ] {
        check_all_or_counted(&bag, &report, &pairs, &page)?;
    }
    if is_exact(&page) {
        for (topic, count, ..) in &pairs {
            let counted = |name| page.sum(name, &[("topic", *topic)]);
            let (messages, lost) = (
                counted("ros2_topic_messages_total"),
                counted("ros2_topic_lost_messages_total"),
            );
            ensure!(
                (messages, lost) == (*count as f64, 0.0),
                "{topic}: {messages} counted, {lost} lost: {}",
                page.suspicious_counters()
            );
        }
    }

    a_slow_reader_loses_the_largest(&robot, &mut pairs)
}

/// Topic, number of messages of each stretch, publisher and subscriber.
type Pair = (&'static str, u64, Peer, Peer);

fn start_pairs(
    host: &Namespace,
    streams: &[(Stack, &'static str, usize, u64)],
) -> Result<Vec<Pair>> {
    let mut pairs = Vec::new();
    for (stack, topic, size, count) in streams.iter().copied() {
        let small = Stream::small(2 * count);
        let stream = Stream {
            topic: topic.to_owned(),
            size,
            rate: if size == CLOUD { 20.0 } else { small.rate },
            reliable: true,
            depth: if size == CLOUD { 20 } else { 1000 },
            stretch: count,
            linger: 60.0,
            ..small
        };
        let subscriber = Peer::launch(host, stack, Role::Subscriber, &stream, &["/map"])?;
        let publisher = Peer::launch(host, stack, Role::Publisher, &stream, &["/driver"])?;
        pairs.push((topic, count, publisher, subscriber));
    }
    for (_, _, publisher, subscriber) in &mut pairs {
        subscriber.wait_ready()?;
        publisher.wait_ready()?;
        publisher.wait_matched()?;
    }
    Ok(pairs)
}

/// Checks that each message of the first stretch is in the bag, or counted as missing in the
/// report.
fn check_all_or_counted(bag: &Path, report: &Value, pairs: &[Pair], page: &Scrape) -> Result<()> {
    let numbers = numbers(bag)?;
    let mut messages = 0;
    for (topic, count, publisher, _) in pairs {
        let sent = sent(publisher)?;
        let recorded = numbers.get(*topic).cloned().unwrap_or_default();
        messages += recorded.len();
        let missing = missing(report, topic);
        eprintln!(
            "{}: {topic}: {} of {} recorded, {missing} missing",
            bag.display(),
            recorded.len(),
            sent.len()
        );
        ensure!(sent.len() as u64 == *count, "{topic}: {} sent", sent.len());
        ensure!(recorded.is_subset(&sent), "{topic}");
        if is_exact(page) {
            let all = recorded.len() as u64 + missing;
            ensure!(
                all == *count,
                "{topic}: {report:#}\n{}",
                page.suspicious_counters()
            );
        }
        ensure!(recorded.len() as u64 * 2 > *count, "{topic}: {report:#}");
    }
    ensure!(report["messages"] == messages, "{messages} of {report:#}");
    let (code, info) = rp(&["bag", "info", &bag.display().to_string()])?;
    ensure!(
        code == Some(0) && info.contains(&format!("Messages:          {messages}\n")),
        "{info}"
    );
    Ok(())
}

/// Checks a reader that does nothing for a while, with memory for four clouds.
fn a_slow_reader_loses_the_largest(robot: &Robot<'_>, pairs: &mut [Pair]) -> Result<()> {
    let arguments = ["/front", "/imu", "--max-cache-size", "3000000"];
    let mut slow = Recorder::start(robot, "slow", &arguments)?;
    slow.process.signal("STOP")?;
    for (_, _, publisher, _) in pairs.iter_mut() {
        publisher.start_sending()?;
    }
    let page = settled(robot, pairs, 2)?;
    let memory = Usage::of(robot.agent.process.pid())?.memory.unreclaimable;
    let queued = page.sum("ros2probe_queued_bytes", &[]);
    eprintln!("agent {} MB with {queued} bytes queued", memory >> 20);
    ensure!(memory < 160 << 20, "{memory} bytes");
    ensure!(queued <= 3_000_000.0, "{queued} bytes wait");
    slow.process.signal("CONT")?;
    robot.agent.scrape_until("read", |page| {
        page.sum("ros2probe_queued_bytes", &[]) == 0.0
    })?;
    ensure!(slow.interrupt()?.code() == Some(0), "{}", slow.stderr());
    let bag = robot.directory.path().join("slow");
    let (numbers, report) = (numbers(&bag)?, report_of(&bag)?);
    for (topic, count, publisher, _) in &*pairs {
        let Some(recorded) = numbers.get(*topic) else {
            ensure!(!matches!(*topic, "/front" | "/imu"), "{topic}: {report:#}");
            continue;
        };
        let sent: BTreeSet<u64> = sent(publisher)?.split_off(&(count + 1));
        let missing = missing(&report, topic);
        let dropped = report["topics"][*topic]["dropped"].as_u64();
        let dropped = dropped.context("no count")?;
        eprintln!(
            "{topic}: {} recorded, {missing} missing, {dropped} dropped of {}",
            recorded.len(),
            sent.len()
        );
        ensure!(recorded.is_subset(&sent), "{topic}");
        if is_exact(&page) {
            let all = recorded.len() as u64 + missing;
            ensure!(
                all == *count,
                "{topic}: {report:#}\n{}",
                page.suspicious_counters()
            );
        }
        // The largest messages are dropped first, so small messages stay complete.
        let is_large = *topic == "/front";
        ensure!((dropped > 10) == is_large, "{topic}: {report:#}");
        ensure!(is_large || dropped == 0, "{topic}: {report:#}");
    }
    ensure!(
        slow.stderr().contains("/front: ")
            && slow.stderr().contains("dropped, the storage was too slow"),
        "{}",
        slow.stderr()
    );
    Ok(())
}

#[test]
fn a_recording_is_controlled_by_its_client_and_outlives_it() -> Result<()> {
    let _shared = MACHINE.read().unwrap_or_else(PoisonError::into_inner);
    let host = Namespace::isolated()?;
    let settings = "watch: [{topic: /imu, max_silence_s: 4}]\n\
                    recordings: {snapshots: [{name: incident, topics: [/imu], seconds: 10}]}\n";
    let mut robot = Robot::start(&host, settings, &host.on_network())?;
    let (mut imu, _subscriber) = robot.pair(&Stream::small(1_000_000))?;
    imu.start_sending()?;

    names_that_lead_elsewhere_are_refused(&robot)?;
    a_client_pauses_resumes_splits_and_ends_a_recording(&robot)?;

    // The recording process is killed.
    let mut client = Recorder::start(&robot, "killed", &["/imu"])?;
    let killed = robot.directory.path().join("killed");
    wait_until("it is in the file", || Ok(bytes(&killed) > 200_000))?;
    let end = now();
    client.process.signal("KILL")?;
    client.process.wait(PATIENCE)?;
    repaired(&killed, &imu, end)?;

    snapshots_are_taken_of_silence_and_on_request(&robot, &mut imu)?;

    // The agent is killed.
    let wanted = json!({"name": "last", "topics": {"topics": ["/imu"]}});
    robot.ask("POST", "/recordings", &wanted)?;
    let last = robot.bags().join("last");
    wait_until("it is in the file", || Ok(bytes(&last) > 200_000))?;
    let end = now();
    robot.agent.process.signal("KILL")?;
    robot.agent.process.wait(PATIENCE)?;
    repaired(&last, &imu, end)
}

/// Checks that each message of that time is in the bag, counted as paused, or counted as missing.
fn a_client_pauses_resumes_splits_and_ends_a_recording(robot: &Robot<'_>) -> Result<()> {
    let wanted = json!({"name": "led", "topics": {"topics": ["/imu"]}});
    let (status, begun) = robot.ask("POST", "/recordings", &wanted)?;
    ensure!(status == 201 && begun["state"] == "recording", "{begun}");
    let (status, again) = robot.ask("POST", "/recordings", &wanted)?;
    ensure!(status == 409, "{status} {again}");
    let shows = |what: &str, holds: &dyn Fn(&Value) -> bool| {
        wait_until(what, || {
            let (_, now) = robot.ask("GET", "/recordings/led", &Value::Null)?;
            Ok(holds(&now))
        })
    };
    let count = |view: &Value, name: &str| {
        let count = view["report"]["topics"]["/imu"][name].as_u64();
        count.unwrap_or_default()
    };
    shows("it records", &|now| count(now, "messages") >= 100)?;
    robot.ask("POST", "/recordings/led/pause", &Value::Null)?;
    shows("it is paused", &|now| {
        now["state"] == "paused" && count(now, "paused") >= 50
    })?;
    let (_, paused) = robot.ask("GET", "/recordings/led", &Value::Null)?;
    robot.ask("POST", "/recordings/led/resume", &Value::Null)?;
    let more = count(&paused, "messages") + 100;
    shows("it goes on", &|now| count(now, "messages") >= more)?;
    robot.ask("POST", "/recordings/led/split", &Value::Null)?;
    shows("it has two files", &|now| now["files"] == 2)?;
    shows("it goes on", &|now| count(now, "messages") >= more + 100)?;
    let (status, led) = robot.ask("DELETE", "/recordings/led", &Value::Null)?;
    ensure!((status, &led["state"]) == (200, &json!("ended")), "{led}");
    ensure!(led["error"].is_null(), "{led}");
    let bag = robot.bags().join("led");
    let recorded = numbers_of_imu(&bag)?;
    ensure!(recorded.len() as u64 == count(&led, "messages"), "{led:#}");
    let accounted = recorded.len() as u64 + count(&led, "paused") + missing(&led["report"], "/imu");
    ensure!(span(&recorded)? == accounted, "{recorded:?} {led:#}");
    let (code, info) = rp(&["bag", "info", &bag.display().to_string()])?;
    ensure!(
        code == Some(0)
            && info.contains("led_1.mcap")
            && info.contains(&format!("Messages:          {}\n", recorded.len())),
        "{info}"
    );
    let events = robot.events_after("ros2probe.recording.*", 2)?;
    let names: Vec<_> = events.iter().map(|event| &event["name"]).collect();
    ensure!(
        names == ["ros2probe.recording.started", "ros2probe.recording.ended"],
        "{events:?}"
    );
    Ok(())
}

fn names_that_lead_elsewhere_are_refused(robot: &Robot<'_>) -> Result<()> {
    let long = "x".repeat(10_000);
    for name in ["../x", "", ".x", "a/b", "a\nb", &long] {
        let (status, problem) = robot.ask("POST", "/recordings", &json!({"name": name}))?;
        ensure!(status == 422, "{name:.40}: {status} {problem}");
    }
    let endless = json!({"name": "x".repeat(1 << 20)});
    let (status, problem) = robot.ask("POST", "/recordings", &endless)?;
    ensure!(status == 413, "{status} {problem}");
    ensure!(fs::read_dir(robot.bags())?.count() == 0);
    Ok(())
}

/// Checks that a silence writes a bag of the messages before it, and that a request and a signal
/// write one each.
fn snapshots_are_taken_of_silence_and_on_request(robot: &Robot<'_>, imu: &mut Peer) -> Result<()> {
    imu.process.signal("STOP")?;
    let written = |page: &Scrape| page.sum("ros2probe_snapshots_written_total", &[]);
    robot
        .agent
        .scrape_until("a snapshot", |page| written(page) == 1.0)?;
    let events = robot.events_after("ros2probe.snapshot.taken", 1)?;
    let [taken] = &events[..] else {
        anyhow::bail!("{events:?}");
    };
    let name = taken["attributes"]["recording"].as_str();
    let before = numbers_of_imu(&robot.bags().join(name.context("no name")?))?;
    // The publisher may have been stopped between sending and logging a message.
    let last = sent(imu)?.last().copied().context("nothing sent")?;
    let is_last = before.last().is_some_and(|it| it.abs_diff(last) <= 1);
    ensure!(is_last, "{last} of {before:?}");
    ensure!((100..=2200).contains(&before.len()), "{before:?}");
    imu.process.signal("CONT")?;
    robot.agent.scrape_until("messages", |page| {
        page.sum("ros2probe_snapshot_messages", &[("snapshot", "incident")]) > 10.0
    })?;
    let (status, asked) = robot.ask("POST", "/snapshots/incident", &Value::Null)?;
    ensure!(
        status == 201 && asked["messages"].as_u64() > Some(10),
        "{asked}"
    );
    robot.agent.process.signal("USR1")?;
    robot
        .agent
        .scrape_until("three snapshots", |page| written(page) == 3.0)?;
    Ok(())
}

fn numbers_of_imu(bag: &Path) -> Result<BTreeSet<u64>> {
    numbers(bag)?.remove("/imu").context("no /imu")
}

#[test]
fn a_full_storage_ends_a_recording_in_order() -> Result<()> {
    let _shared = MACHINE.read().unwrap_or_else(PoisonError::into_inner);
    let host = Namespace::isolated()?;
    // Only the agent has this disk of 4 MB.
    let mut enter = host.on_network();
    let script = r#"mount -t tmpfs -o size=4m none "$0" && exec "$@""#;
    enter.extend(["unshare", "--mount", "sh", "-c", script].map(str::to_owned));
    let robot = Robot::start_on_disk(&host, "watch: []\n", enter)?;
    let stream = Stream::point_cloud(SCAN, 1_000_000);
    let (mut lidar, _subscriber) = robot.pair(&stream)?;
    lidar.start_sending()?;

    let (status, begun) = robot.ask("POST", "/recordings", &json!({"name": "full"}))?;
    ensure!(status == 201, "{begun}");
    wait_until("the disk is full", || {
        let (_, now) = robot.ask("GET", "/recordings/full", &Value::Null)?;
        Ok(now["state"] == "ended")
    })?;
    let (_, ended) = robot.ask("DELETE", "/recordings/full", &Value::Null)?;
    let reported = ended["error"].as_str().unwrap_or_default();
    ensure!(reported.starts_with("no space left to write "), "{ended:#}");
    let events = robot.events_after("ros2probe.recording.ended", 1)?;
    let reasons: Vec<_> = events
        .iter()
        .map(|event| &event["attributes"]["reason"])
        .collect();
    ensure!(reasons == [reported], "{events:?}");
    // Files of its disk are reached through the process.
    let root = format!("/proc/{}/root", robot.agent.process.pid());
    let bag = robot.bags().join("full");
    let bag = Path::new(&root).join(bag.strip_prefix("/")?);
    whole(&bag, &ended["report"])?;

    let small = robot.directory.path().join("small");
    let kept = robot.directory.path().join("kept");
    fs::create_dir(&small)?;
    let record = |options: &str, output: &Path| -> Result<(Option<i32>, String)> {
        let script = format!(
            r#"mount -t tmpfs -o {options} none "$1" || exit 99
timeout 120 "$2" bag record -a --socket "$3" -o "$4" </dev/null; code=$?
if test -e "$1/bag"; then cp -r "$1/bag" "$5"; fi; exit $code"#
        );
        let output = Command::new("unshare")
            .args(["--mount", "sh", "-c", &script, "sh"])
            .arg(&small)
            .arg(RP)
            .arg(&robot.socket)
            .arg(output)
            .arg(&kept)
            .env_remove("ROS_DISTRO")
            .env_remove("ROS_DOMAIN_ID")
            .output()?;
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        Ok((output.status.code(), stderr))
    };
    let (code, stderr) = record("size=4m", &small.join("bag"))?;
    let mut errors = stderr.lines().filter(|line| line.contains("[ERROR]"));
    let error = errors.next().unwrap_or_default();
    ensure!(
        code == Some(1) && error.contains("no space left to write ") && errors.next().is_none(),
        "{code:?} {stderr}"
    );
    whole(&kept, &report_of(&kept)?)?;

    for (options, output, message) in [
        ("ro", small.join("bag"), "cannot create "),
        ("size=4m", kept.clone(), "already exists."),
    ] {
        let (code, stderr) = record(options, &output)?;
        ensure!(
            code == Some(1) && stderr.lines().count() == 1 && stderr.contains(message),
            "{code:?} {stderr}"
        );
    }
    Ok(())
}

/// Returns the distance from the first number to the last, including both.
fn span(numbers: &BTreeSet<u64>) -> Result<u64> {
    let (first, last) = (numbers.first(), numbers.last());
    Ok(last.context("nothing")? - first.context("nothing")? + 1)
}

/// Returns the report in a bag's metadata.
fn report_of(bag: &Path) -> Result<Value> {
    let text = fs::read_to_string(bag.join("metadata.yaml"))?;
    let metadata = ros2probe_bag::metadata::Metadata::read(&text)?;
    let report = metadata.custom_data.get("ros2probe");
    Ok(serde_json::from_str(report.context("no report")?)?)
}

/// Returns the number of messages of a topic that were sent and are not in the bag.
fn missing(report: &Value, topic: &str) -> u64 {
    let reasons = ["incomplete", "not_captured", "dropped", "unwritten"];
    let topic = report.pointer("/topics").and_then(|all| all.get(topic));
    let counts = reasons.iter().map(|reason| topic?.get(reason)?.as_u64());
    counts.map(Option::unwrap_or_default).sum()
}

/// Checks that a bag whose disk became full can be read to its end, and that its report is correct.
fn whole(bag: &Path, report: &Value) -> Result<()> {
    let recorded = numbers(bag)?.remove("/points").context("no /points")?;
    ensure!(recorded.len() > 10, "{recorded:?}");
    ensure!(
        report["messages"] == recorded.len(),
        "{} in the bag: {report:#}",
        recorded.len()
    );
    ensure!(report["bytes"] == recorded.len() * SCAN, "{report:#}");
    // The numbers have no gap, except for messages reported as missing.
    ensure!(
        span(&recorded)? <= recorded.len() as u64 + missing(report, "/points"),
        "{recorded:?} {report:#}"
    );
    let (code, info) = rp(&["bag", "info", &bag.display().to_string()])?;
    ensure!(code == Some(0), "{info}");
    Ok(())
}

/// Checks that the bag of a killed recorder has, once indexed, all messages until shortly before.
fn repaired(bag: &Path, publisher: &Peer, killed: Duration) -> Result<()> {
    let (code, stderr) = rp(&["bag", "reindex", &bag.display().to_string()])?;
    ensure!(code == Some(0), "{stderr}");
    let recorded = numbers(bag)?.remove("/imu").context("no /imu")?;
    ensure!(span(&recorded)? == recorded.len() as u64, "{recorded:?}");
    let last = recorded.last().context("nothing")?;
    let log = publisher.log()?.0;
    let last = log.iter().find(|event| event.seq == Some(last - 1));
    let last = Duration::from_nanos(last.context("never sent")?.t);
    let unflushed = killed.saturating_sub(last);
    eprintln!(
        "{}: {} messages, {unflushed:?} are missing",
        bag.display(),
        recorded.len()
    );
    ensure!(unflushed <= UNFLUSHED, "{unflushed:?} are missing");
    let (code, info) = rp(&["bag", "info", &bag.display().to_string()])?;
    ensure!(
        code == Some(0) && info.contains(&format!("Messages:          {}\n", recorded.len())),
        "{info}"
    );
    Ok(())
}

/// Returns the size of a bag's files, in bytes.
fn bytes(bag: &Path) -> u64 {
    let files = fs::read_dir(bag).into_iter().flatten().flatten();
    let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
    sizes.sum()
}

fn rp(arguments: &[&str]) -> Result<(Option<i32>, String)> {
    let output = Command::new(RP)
        .args(arguments)
        .env_remove("ROS_DISTRO")
        .output()?;
    let stderr = [output.stdout, output.stderr].concat();
    Ok((
        output.status.code(),
        String::from_utf8_lossy(&stderr).into_owned(),
    ))
}

fn now() -> Duration {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.unwrap_or_default()
}
