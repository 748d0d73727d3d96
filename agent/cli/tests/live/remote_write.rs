//! Remote write to real engines. The agent is killed and started again while they are out of reach.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::Permissions;
use std::io::{BufRead as _, BufReader};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;
use ros2probe_testing::harness::agent::{
    Agent, Scrape, at_the_sockets_of, datagrams_alone_of, get,
};
use ros2probe_testing::harness::alertmanager::{ALERTING, Alertmanager};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::prometheus::{Kind, Prometheus};
use ros2probe_testing::harness::{run, wait_within};
use ros2probe_testing::remote_write::{Receiver, Reply, Write};
use serde_json::json;

use crate::browser::player::play;

/// Maximum time until an engine has samples, or a process ends, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(90);
/// Maximum gap between samples of each second, in seconds, on a busy machine.
const GAP: f64 = 6.0;
/// Robots in the summary of `make fleet`, and what it prints about the second one.
const FLEET: [&str; 3] = ["robot-1 ", "robot-2  violated", "robot-3 "];
const LOSES: &str = "  /points: max_loss_ratio is violated\n";
/// Age of the oldest samples that the receiver does not have, in seconds.
const BEHIND: &str = "ros2probe_remote_write_behind_seconds";
/// Seconds by which the clock is set forward, and later back from the right time.
const CLOCK_STEP: f64 = 1800.0;
/// Alerts about the faults among ten robots, with the robots.
const FAULTS: [(&str, &str); 2] = [
    ("Ros2probeGone", "robot-3"),
    ("Ros2probeConfigurationRefused", "robot-5"),
];
/// A series that the agent always has.
const UP: &str = "up{job=\"ros2probe\",instance=\"robot7\",site=\"hall 2\"}";

#[test]
fn prometheus_gets_the_samples_of_an_outage_in_which_the_agent_was_killed() -> Result<()> {
    let text = std::fs::read_to_string(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/prometheus/prometheus.yaml"),
    )?;
    let rules = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dashboards/rules");
    let text = text.replace("/etc/ros2probe/rules", &rules.display().to_string());
    samples_survive(Kind::Server, &text)
}

#[test]
fn victoria_metrics_gets_the_samples_of_an_outage_in_which_the_agent_was_killed() -> Result<()> {
    samples_survive(Kind::VictoriaMetrics, "")
}

#[test]
fn rp_fleet_finds_the_differing_robots_among_ten_and_each_fault_has_one_alert() -> Result<()> {
    let centre = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let alertmanager = Alertmanager::start(&centre)?;
    let alerts = quick_alerts(directory.path())?;
    let text = format!(
        "global: {{scrape_interval: 1s, evaluation_interval: 1s}}\n\
         rule_files: ['{}']\n{ALERTING}",
        alerts.display()
    );
    let prometheus = Prometheus::run(&centre, Kind::Server, &text)?;
    let start = |name: &str| {
        // The seventh robot has another program.
        let capture = match name {
            "robot-7" => "wire/tests/data/fastdds-samehost-any.pcap.gz",
            _ => "wire/tests/data/cyclonedds-samehost-any.pcap.gz",
        };
        let arguments = ["run", "--foxglove", "off", "--api", "off"]
            .into_iter()
            .chain(["--metrics", "127.0.0.1:0", "--config"])
            .map(OsString::from)
            .chain([directory.path().join(name).into(), "--replay".into()])
            .chain([ros2probe_testing::repository(capture).into()]);
        Process::start(&centre.outside(), env!("CARGO_BIN_EXE_rp"), arguments)
    };
    let mut robots = BTreeMap::new();
    for number in 1..=10 {
        let name = format!("robot-{number}");
        let text = format!(
            "remote_write: {{url: 'http://127.0.0.1:9090/api/v1/write', interval_s: 1, \
             instance: {name}}}\n"
        );
        std::fs::write(directory.path().join(&name), text)?;
        let agent = start(&name)?;
        robots.insert(name, agent);
    }
    prometheus.wait_for("count(ros2probe_ready{job=\"ros2probe\"} == 1)", 10.0)?;
    let seen = "count_over_time(ros2probe_ready{instance=\"robot-3\"}[1m]) > bool 8";
    prometheus.wait_for(seen, 1.0)?;
    if let Some(mut third) = robots.remove("robot-3") {
        third.terminate()?;
    }
    let configuration = directory.path().join("robot-5");
    let accepted = std::fs::read_to_string(&configuration)?;
    std::fs::write(&configuration, "no_such_key: true\n")?;
    robots["robot-5"].signal("HUP")?;
    let fleet = |more: &[&str]| -> Result<(Option<i32>, String)> {
        let outside = centre.outside();
        let mut command = std::process::Command::new(&outside[0]);
        command.args(&outside[1..]).arg(env!("CARGO_BIN_EXE_rp"));
        command.args([
            "fleet",
            "--engine",
            "http://127.0.0.1:9090",
            "--reach",
            "15",
        ]);
        let output = command.args(more).output()?;
        let text = String::from_utf8(output.stdout)? + &String::from_utf8(output.stderr)?;
        Ok((output.status.code(), text))
    };
    let mut text = String::new();
    wait_within(PATIENCE, "robot-3 is out of reach", || {
        let code;
        (code, text) = fleet(&[])?;
        Ok(code == Some(3) && text.contains("out of reach"))
    })?;
    let lines: Vec<&str> = text.lines().collect();
    ensure!(lines[1].starts_with("robot-3   out of reach  "), "{text}");
    let details = text
        .split_once("\nrobot-7\n")
        .map_or("", |(_, details)| details);
    ensure!(details.contains(" is missing (8 of 9)"), "{text}");
    ensure!(details.contains(": 0, usually 2 (8 of 9)"), "{text}");
    let (_, json) = fleet(&["--json"])?;
    let json: serde_json::Value = serde_json::from_str(&json)?;
    let all = json["robots"].as_array().context("no robots")?;
    ensure!(all.len() == 10, "{json}");
    for robot in all {
        let odd = robot["differences"]
            .as_array()
            .is_some_and(|all| !all.is_empty());
        ensure!(odd == (robot["name"] == "robot-7"), "{robot}");
    }
    let (code, text) = fleet(&["robot-7"])?;
    ensure!(code == Some(0), "{text}");
    let (nodes, rest) = text.split_once("\nnodes\n").context("no nodes")?;
    ensure!(
        nodes.contains("robot-7  ") && !nodes.contains("robot-1 "),
        "{text}"
    );
    ensure!(rest.contains(" is missing (8 of 9)"), "{text}");
    ensure!(rest.contains("\npublishers and subscriptions\n"), "{text}");
    let (code, text) = fleet(&["robot-11"])?;
    ensure!(
        code == Some(1) && text.contains("has no robot `robot-11`"),
        "{text}"
    );
    the_page_has_the_robots(&centre)?;
    an_agent_answers_with_the_robots(&centre, directory.path())?;
    let (code, text) = fleet(&["--job", "other"])?;
    ensure!(
        code == Some(1) && text.contains("has no robots of the job `other`"),
        "{text}"
    );
    // Both faults end. Each caused one notification of its begin, and one of its end.
    for (alert, robot) in FAULTS {
        alertmanager.wait_for(alert, robot, &["firing"])?;
    }
    std::fs::write(&configuration, accepted)?;
    robots["robot-5"].signal("HUP")?;
    robots.insert("robot-3".to_owned(), start("robot-3")?);
    for (alert, robot) in FAULTS {
        alertmanager.wait_for(alert, robot, &["firing", "resolved"])?;
        let named = alertmanager.robots_with(alert);
        ensure!(named == [robot], "{alert}: {named:?}");
    }
    Ok(())
}

/// Writes the shipped alerts with a short `for`, and returns their file.
fn quick_alerts(directory: &Path) -> Result<PathBuf> {
    let shipped = ros2probe_testing::repository("dashboards/rules/ros2probe.alerts.yaml");
    let shipped = std::fs::read_to_string(shipped)?;
    let text: String = shipped
        .lines()
        .map(|line| match line.starts_with("        for: ") {
            true => "        for: 2s\n".to_owned(),
            false => format!("{line}\n"),
        })
        .collect();
    ensure!(text != shipped, "no alert waits");
    let file = directory.join("alerts.yaml");
    std::fs::write(&file, text)?;
    Ok(file)
}

/// Checks that the page of `rp fleet` has the same robots as its text.
fn the_page_has_the_robots(centre: &Namespace) -> Result<()> {
    let arguments = [
        "fleet",
        "--engine",
        "http://127.0.0.1:9090",
        "--reach",
        "15",
    ];
    let listen = ["--listen", "127.0.0.1:17410"];
    let link = ["--link", "http://{robot}.example:17401/"];
    let arguments = arguments.into_iter().chain(listen).chain(link);
    let program = env!("CARGO_BIN_EXE_rp");
    let mut server = Process::start(&centre.outside(), program, arguments)?;
    let mut page = String::new();
    // The samples of a busy machine's robot may be late for a moment.
    wait_within(PATIENCE, "ten robots on the page", || {
        page = get(centre, "http://127.0.0.1:17410/").unwrap_or_default();
        let unreachable = "<span class=\"bad\">1 out of reach</span>";
        Ok(page.contains("<h1>10 robots</h1>") && page.contains(unreachable))
    })?;
    for part in [
        "<a href=\"http://robot-7.example:17401/\">robot-7</a>",
        " is missing (8 of 9)</li>",
    ] {
        ensure!(page.contains(part), "{part}: {page}");
    }
    server.terminate()?;
    Ok(())
}

/// Puts a bag of a robot into a folder, as `rp ship` delivers it.
fn deliver_an_incident(store: &Path) -> Result<()> {
    let manifest = json!({
        "version": 1, "robot": "robot-7", "bag": "incident_1", "is_complete": true,
        "trigger": {
            "snapshot": "incident", "trigger": "message_lost", "event": "ros2.message.lost",
            "time": "2026-11-20T02:34:07Z", "attributes": {"topic": "/scan"},
        },
        "findings": [{"name": "ros2.message.lost"}, {"name": "ros2.message.lost"}],
        "start": "2026-11-20T02:34:00Z", "end": "2026-11-20T02:34:07.5Z",
        "messages": 75, "topics": [],
        "files": [{"name": "incident_1_0.mcap", "bytes": 3 << 20, "sha256": ""}],
        "program": "ros2probe",
    });
    let bag = store.join("robot-7/incident_1");
    std::fs::create_dir_all(&bag)?;
    std::fs::write(bag.join("manifest.json"), manifest.to_string())?;
    Ok(())
}

/// Checks that an agent whose configuration has the engine answers with the same robots.
fn an_agent_answers_with_the_robots(centre: &Namespace, directory: &Path) -> Result<()> {
    let (configuration, store) = (directory.join("centre.yaml"), directory.join("store"));
    deliver_an_incident(&store)?;
    let text = format!(
        "fleet: {{engine: 'http://127.0.0.1:9090', reach_s: 15, \
         link: 'http://{{robot}}.example:17401/', store: {{url: 'file://{}'}}}}\n",
        store.display()
    );
    std::fs::write(&configuration, text)?;
    let capture = "wire/tests/data/cyclonedds-samehost-any.pcap.gz";
    let arguments = ["run", "--foxglove", "off", "--api", "127.0.0.1:17402"]
        .into_iter()
        .chain(["--metrics", "off", "--config"])
        .map(OsString::from)
        .chain([configuration.into(), "--replay".into()])
        .chain([ros2probe_testing::repository(capture).into()]);
    let mut agent = Process::start(&centre.outside(), env!("CARGO_BIN_EXE_rp"), arguments)?;
    let mut answer = serde_json::Value::Null;
    wait_within(PATIENCE, "ten robots of the API", || {
        let text = get(centre, "http://127.0.0.1:17402/fleet").unwrap_or_default();
        answer = serde_json::from_str(&text).unwrap_or_default();
        Ok(answer["robots"]
            .as_array()
            .is_some_and(|all| all.len() == 10))
    })?;
    let robots = answer["robots"].as_array().context("no robots")?;
    ensure!(
        robots[0]["name"] == "robot-3" && robots[0]["state"] == "out_of_reach",
        "{answer}"
    );
    let odd = robots.iter().find(|robot| robot["name"] == "robot-7");
    let odd = odd.context("no robot-7")?;
    ensure!(odd["page"] == "http://robot-7.example:17401/", "{odd}");
    let differences = odd["differences"].as_array().context("no differences")?;
    let missing = differences.iter().find(|each| each["part"] == "nodes");
    let missing = missing.context("no node")?["text"]
        .as_str()
        .unwrap_or_default();
    ensure!(missing.contains(" (8 of 9)"), "{odd}");
    ensure!(
        answer["at"].is_number() && answer["problem"].is_null(),
        "{answer}"
    );
    let mut nothing = |question: &str| anyhow::bail!("no answer to {question}");
    let page = "http://127.0.0.1:17402/";
    play(&centre.outside(), "fleet", &[page], &mut nothing)?;
    agent.terminate()?;
    Ok(())
}

/// `make fleet`: a robot that loses messages between its computers is the one in trouble. The fleet
/// ends once its summary shows that.
#[test]
fn the_fleet_of_make_fleet_shows_the_robot_that_loses_messages() -> Result<()> {
    let program = Path::new(env!("CARGO_BIN_EXE_rp")).with_file_name("examples/fleet");
    let mut fleet = std::process::Command::new(program)
        .args(["--seconds", "150"])
        .stdout(Stdio::piped())
        .spawn()?;
    let output = fleet.stdout.take().context("no output")?;
    let (mut text, mut is_ending) = (String::new(), false);
    for line in BufReader::new(output).lines().map_while(Result::ok) {
        text.push_str(&line);
        text.push('\n');
        let last = text.rsplit("\nROBOT ").next().unwrap_or_default();
        let shows = |robot: &str| last.contains(&format!("\n{robot}"));
        if !is_ending && last.contains(LOSES) && FLEET.iter().all(|robot| shows(robot)) {
            is_ending = true;
            run(&format!("kill -TERM {}", fleet.id()))?;
        }
    }
    let status = fleet.wait()?;
    ensure!(status.success(), "{status}\n{text}");
    let last = text.rsplit("\nROBOT ").next().unwrap_or_default();
    for robot in FLEET {
        ensure!(last.contains(&format!("\n{robot}")), "{robot} in\n{last}");
    }
    ensure!(last.contains(LOSES), "{last}");
    for engine in [
        "Prometheus",
        "Alertmanager",
        "VictoriaMetrics",
        "robot-1's page",
    ] {
        ensure!(
            text.contains(&format!("  {engine} ")),
            "{engine} in\n{text}"
        );
    }
    Ok(())
}

fn samples_survive(engine: Kind, text: &str) -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    let state = directory.path().join("state");
    std::fs::create_dir(&state)?;
    std::fs::write(
        &configuration,
        format!(
            "{}state_directory: {}\n\
             remote_write: {{url: 'http://{}:9090/api/v1/write', interval_s: 1, timeout_s: 2, \
             instance: robot7, labels: {{site: hall 2}}}}\n",
            datagrams_alone_of(&link.robot),
            state.display(),
            link.monitor.address()
        ),
    )?;
    let start = || Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &configuration);
    // The agent comes first, and the engine later.
    let mut agent = start()?;
    let began = Instant::now();
    agent.scrape_until("samples that wait", behind(2.0))?;
    let engine = Prometheus::run(&link.monitor, engine, text)?;
    engine.query(UP)?;

    let to_engine = format!("ip daddr {}", link.monitor.address());
    let outage = Loss::of(&link.robot, &to_engine, 1000)?;
    agent.scrape_until("samples that wait", behind(4.0))?;
    let queue = agent.scrape_until("a queue on disk", |page| queue_bytes(page) > 0.0)?;
    agent.process.signal("KILL")?;
    agent.process.wait(PATIENCE)?;
    let killed = now()?;
    let agent = start()?;
    let started = now()?;
    agent.scrape_until("samples that wait", behind(4.0))?;
    drop(outage);

    let back = now()?;
    wait_within(PATIENCE, "a sample of the link that is back", || {
        Ok(engine.query(&format!("timestamp({UP})"))? >= back)
    })?;
    let window = began.elapsed().as_secs() + 5;
    let times = engine.times(&format!("{UP}[{window}s]"))?;
    let first = times.first().copied().unwrap_or_default();
    // Two seconds before the engine, three without a link, and two starts.
    ensure!(times.len() >= 8, "{times:?}");
    ensure!(first < killed - 4.0, "samples before the outage: {times:?}");
    ensure!(times.is_sorted_by(|one, two| one < two), "{times:?}");
    for pair in times.windows(2) {
        let around_the_start = pair[0] < started + 2.0 && pair[1] > killed;
        let longest = match around_the_start {
            // Only the time without an agent is missing, and the interval before its end.
            true => GAP + started - killed,
            false => GAP,
        };
        ensure!(pair[1] - pair[0] < longest, "{pair:?} in {times:?}");
    }
    let last_before = times.iter().rev().find(|time| **time <= killed);
    ensure!(
        last_before.is_some_and(|last| killed - last < GAP),
        "the last sample before the end at {killed} is {last_before:?}: {}",
        queue.0
    );
    let page = agent.scrape()?;
    for lost in ["refused", "overflow", "shutdown"] {
        let samples = page.value("ros2probe_remote_write_samples_total", &[("outcome", lost)]);
        ensure!(samples == Some(0.0), "{lost}: {samples:?}");
    }
    Ok(())
}

/// Returns whether a page shows samples of this age, in seconds, that the receiver does not have.
fn behind(age: f64) -> impl Fn(&Scrape) -> bool {
    move |page| page.value(BEHIND, &[]).is_some_and(|behind| behind > age)
}

fn queue_bytes(page: &Scrape) -> f64 {
    let bytes = page.value("ros2probe_remote_write_queue_bytes", &[]);
    bytes.unwrap_or_default()
}

fn samples(page: &Scrape, outcome: &str) -> f64 {
    let labels = [("outcome", outcome)];
    let samples = page.value("ros2probe_remote_write_samples_total", &labels);
    samples.unwrap_or(f64::NAN)
}

/// Waits until the agent has written further collections to disk.
fn collect_on_disk(agent: &Agent<'_>) -> Result<()> {
    for _ in 0..3 {
        let bytes = queue_bytes(&agent.scrape()?);
        agent.scrape_until("a further collection", |page| queue_bytes(page) > bytes)?;
    }
    Ok(())
}

/// Writes a script that runs `rp` with the clock of a file, in the notation of libfaketime.
fn write_program_with_clock(script: &Path, clock: &Path) -> Result<()> {
    let text = format!(
        "#!/bin/sh\nexport LD_PRELOAD={} FAKETIME_TIMESTAMP_FILE={} FAKETIME_NO_CACHE=1 \
         FAKETIME_DONT_FAKE_MONOTONIC=1 FAKETIME_DONT_RESET=1\nexec {} \"$@\"\n",
        crate::clocks::library()?.display(),
        clock.display(),
        env!("CARGO_BIN_EXE_rp")
    );
    std::fs::write(script, text)?;
    std::fs::set_permissions(script, Permissions::from_mode(0o755))?;
    Ok(())
}

/// A full disk in place of a directory, until the value is dropped.
struct FullDisk(PathBuf);

impl FullDisk {
    fn over(directory: PathBuf) -> Result<Self> {
        run(&format!(
            "mount -t tmpfs -o size=4k full {}",
            directory.display()
        ))?;
        Ok(Self(directory))
    }
}

impl Drop for FullDisk {
    fn drop(&mut self) {
        let _ = run(&format!("umount -l {}", self.0.display()));
    }
}

/// The receiver fails and refuses, the disk is full, the agent is killed, and the clock is
/// set forward and back. The receiver is one of the tests, because it keeps each request.
#[test]
fn a_receiver_has_each_sample_once_and_in_order_after_all_faults_together() -> Result<()> {
    let host = Namespace::isolated()?;
    let listener = netns::within(&host.network(), || TcpListener::bind("127.0.0.1:9090"))??;
    let receiver = Receiver::start_on(listener, Reply::stored);
    let directory = tempfile::tempdir()?;
    let path = |name: &str| directory.path().join(name);
    std::fs::create_dir(path("state"))?;
    let configuration = path("ros2probe.yaml");
    let text = format!(
        "{}state_directory: {}\n\
         remote_write: {{url: 'http://127.0.0.1:9090/api/v1/write', interval_s: 1, \
         instance: robot7}}\n",
        at_the_sockets_of(&host),
        path("state").display()
    );
    std::fs::write(&configuration, text)?;
    // A replaced file is never empty.
    let set_clock = |offset: &str| {
        std::fs::write(path("clock.new"), offset)?;
        std::fs::rename(path("clock.new"), path("clock"))
    };
    set_clock("+0")?;
    write_program_with_clock(&path("rp"), &path("clock"))?;
    let start = || Agent::start(&host, path("rp"), &configuration);
    let begun = now()?;
    let mut agent = start()?;
    receiver.wait_for("samples", |stored| stored.len() > 2);

    let mut failures = [500, 429, 401, 503].into_iter().cycle();
    receiver.answer(move |_| Reply {
        headers: vec![("Retry-After", "1".to_owned())],
        ..Reply::status(failures.next().unwrap_or(500))
    });
    agent.scrape_until("samples that wait", behind(4.0))?;
    set_clock(&format!("+{CLOCK_STEP}"))?;
    collect_on_disk(&agent)?;
    let full = FullDisk::over(path("state").join("remote_write"))?;
    let page = agent.scrape()?;
    let age = page.value(BEHIND, &[]).context("no age")?;
    let page = agent.scrape_until("samples in memory", behind(age + 2.0))?;
    let later = agent.scrape_until("further ones", behind(age + 5.0))?;
    ensure!(
        queue_bytes(&later) == queue_bytes(&page),
        "the disk is not full"
    );
    drop(full);
    collect_on_disk(&agent)?;
    agent.process.signal("KILL")?;
    agent.process.wait(PATIENCE)?;
    let before = receiver.stored().len();
    let agent = start()?;
    collect_on_disk(&agent)?;
    set_clock(&format!("-{CLOCK_STEP}"))?;
    collect_on_disk(&agent)?;

    // The receiver is back, but refuses one collection: "too old".
    receiver.refuse_one_sample();
    let mut last = (0.0, 0);
    let same = wait_within(
        PATIENCE,
        "the count of the robot and of the receiver",
        || {
            let page = agent.scrape()?;
            let stored = receiver.stored().split_off(before);
            last = (
                samples(&page, "delivered"),
                stored.iter().map(Write::samples).sum::<usize>(),
            );
            Ok(queue_bytes(&page) == 0.0 && last.1 > 0 && last.0 == last.1 as f64)
        },
    );
    same.with_context(|| format!("{last:?}"))?;
    let page = agent.scrape()?;
    let width = receiver
        .stored()
        .iter()
        .map(|write| write.series.len())
        .max();
    let width = width.context("nothing stored")? as f64;
    let lost = samples(&page, "refused");
    ensure!(0.0 < lost && lost < width * 1.2, "{lost} of {width}");
    for outcome in ["overflow", "shutdown"] {
        ensure!(samples(&page, outcome) == 0.0, "{}", page.0);
    }
    each_collection_came_once(&receiver, begun)
}

/// Checks the order and the gaps of the collections, and a figure that each of them has.
fn each_collection_came_once(receiver: &Receiver, begun: f64) -> Result<()> {
    let up = receiver.of("up");
    // Number of the steps by which the clock was wrong.
    let steps = |at: i64| ((at as f64 / 1e3 - begun) / CLOCK_STEP).round() as i64;
    let mut clocks: Vec<_> = up.iter().map(|(at, _)| steps(*at)).collect();
    clocks.dedup();
    ensure!(clocks == [0, 1, -1], "{clocks:?}: {up:?}");
    let mut wide = 0;
    for pair in up.windows(2) {
        let gap = (pair[1].0 - pair[0].0) as f64 / 1e3;
        if steps(pair[0].0) == steps(pair[1].0) {
            ensure!(gap > 0.0, "{pair:?} in {up:?}");
            wide += usize::from(gap > GAP);
        }
    }
    // One while no agent ran, and one of the refused collection.
    ensure!(wide <= 2, "{wide} gaps in {up:?}");
    let ages = receiver.of(BEHIND);
    let times = |samples: &[(i64, f64)]| samples.iter().map(|(at, _)| *at).collect::<Vec<_>>();
    ensure!(times(&ages) == times(&up), "{ages:?}");
    // While the clock was ahead, the age grew from one collection on, also after the restart.
    let ahead = ages.iter().filter(|(at, _)| steps(*at) == 1);
    let oldest: Vec<f64> = ahead.map(|(at, age)| *at as f64 / 1e3 - age).collect();
    let first = up.iter().filter(|(at, _)| steps(*at) == 0);
    let first: Vec<f64> = first.map(|(at, _)| *at as f64 / 1e3).collect();
    let is_first = |time: &&f64| first.iter().any(|first| (first - **time).abs() < GAP);
    let right = oldest.iter().filter(is_first).count();
    // The clock may be set within a collection, and the first one may precede the first request.
    ensure!(
        right >= 5 && right + 2 >= oldest.len(),
        "{right} of {oldest:?}"
    );
    Ok(())
}

fn now() -> Result<f64> {
    Ok(SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64())
}
