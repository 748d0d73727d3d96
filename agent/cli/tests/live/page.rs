//! The page beside a running robot: its stream, processes and messages, and the addresses that the
//! demo relays to this machine.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, at_the_sockets_of, get};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer;
use ros2probe_testing::harness::process::Process;
use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(60);
const API: &str = "http://127.0.0.1:17401";

/// Reads a stream on the host for this many seconds, and returns its whole lines.
fn lines(host: &Namespace, path: &str, seconds: u32) -> Result<Vec<Value>> {
    let [enter, words @ ..] = &host.on_network()[..] else {
        anyhow::bail!("no host");
    };
    let output = Command::new(enter)
        .args(words)
        .args(["curl", "-sN", "--max-time", &seconds.to_string()])
        .arg(format!("{API}{path}"))
        .output()?;
    let text = String::from_utf8(output.stdout)?;
    // The last line may be cut off.
    let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
    whole
        .lines()
        .map(|line| serde_json::from_str(line).with_context(|| line.to_owned()))
        .collect()
}

#[test]
fn the_stream_shows_a_running_robot() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    let text = format!("{}watch: [/**]\n", at_the_sockets_of(&host));
    std::fs::write(&configuration, text)?;
    let agent = Agent::start(&host, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let robots = ["lidar", "base", "monitor"].map(|role| {
        let mut robot = Process::start(&host.inside(), peer::robot()?, ["--role", role])?;
        robot.wait_for("ready", PATIENCE)?;
        Ok::<_, anyhow::Error>(robot)
    });
    let robots = robots.into_iter().collect::<Result<Vec<_>>>()?;
    agent.scrape_until("measuring", |page| {
        page.sum("ros2_topic_messages_total", &[("topic", "/imu/data")]) > 20.0
            || page.sum("ros2_topic_messages_total", &[("topic", "/points")]) > 20.0
    })?;
    std::thread::sleep(Duration::from_secs(2));

    // On a busy machine, a stream of five seconds may have fewer batches.
    let mut stream = Vec::new();
    harness::wait_until("three batches of a stream without new nodes", || {
        stream = lines(&host, "/live", 5)?;
        let graphs = stream.iter().filter(|line| line.get("graph").is_some());
        let count = batches(&stream).len();
        Ok(count >= 3 && graphs.count() < count)
    })?;
    let name = the_stream_separates_structure_and_figures(&stream)?;
    processes_are_listed(&host, &robots)?;
    messages_are_decoded(&host, &name)
}

/// Returns the batches of figures.
fn batches(reported: &[Value]) -> Vec<&Value> {
    let batches = reported.iter().filter(|line| line.get("values").is_some());
    batches.map(|line| &line["values"]).collect()
}

/// Checks the stream, and returns the name of the topic with messages of type Imu.
fn the_stream_separates_structure_and_figures(reported: &[Value]) -> Result<String> {
    let first = reported.first().context("no line")?;
    ensure!(first["open"]["source"] == "host", "{first}");
    let batches = batches(reported);
    ensure!(
        (2..=7).contains(&batches.len()),
        "{} batches in 5 s",
        batches.len()
    );
    let graphs: Vec<_> = reported
        .iter()
        .filter(|line| line.get("graph").is_some())
        .collect();
    let graph = &graphs.last().context("no graph")?["graph"];
    // The structure is sent when it changes, not with each batch of figures.
    ensure!(
        graphs.len() < batches.len(),
        "{} graphs in {} batches",
        graphs.len(),
        batches.len()
    );
    let local = graph["participants"].as_array().context("no list")?;
    ensure!(
        local
            .iter()
            .any(|row| row[5].is_u64() && row[7].is_string()),
        "{local:?}"
    );
    // On a busy machine the robot itself may send nothing for seconds.
    let sent = batches.iter().skip(1);
    let sent: u64 = sent.filter_map(|values| values["totals"][0].as_u64()).sum();
    ensure!(sent > 10, "{batches:?}");
    let topic = graph["topics"].as_array().context("no list")?.iter();
    let mut topic = topic.filter(|row| row[4] == "topic" && row[8] == 1);
    let topic = topic
        .find(|row| row[5][0] == "sensor_msgs/msg/Imu")
        .context("no imu")?;
    a_count_grows(&batches)?;
    Ok(topic[2].as_str().context("no name")?.to_owned())
}

fn a_count_grows(batches: &[&Value]) -> Result<()> {
    let mut counts = BTreeMap::<_, BTreeSet<_>>::new();
    for values in batches {
        for row in values["topics"].as_array().context("no rows")? {
            if let (Some(id), Some(count)) = (row[0].as_u64(), row[3].as_u64()) {
                counts.entry(id).or_default().insert(count);
            }
        }
    }
    ensure!(
        counts.values().any(|counts| counts.len() >= 2),
        "no count grows: {batches:?}"
    );
    Ok(())
}

fn processes_are_listed(host: &Namespace, robots: &[Process]) -> Result<()> {
    let processes: Value = serde_json::from_str(&get(host, &format!("{API}/processes"))?)?;
    let ids: BTreeSet<_> = processes["processes"]
        .as_array()
        .context("no list")?
        .iter()
        .filter_map(|row| row["process_id"].as_u64())
        .collect();
    for robot in robots {
        ensure!(
            ids.contains(&u64::from(robot.pid())),
            "{} is not in {processes}",
            robot.pid()
        );
    }
    Ok(())
}

/// Checks that a topic's stream begins with its type, and that each message has its header's stamp.
fn messages_are_decoded(host: &Namespace, topic: &str) -> Result<()> {
    let path = format!("/topics/{}/messages", topic.replace('/', "%2F"));
    // On a busy machine the robot itself may send nothing for seconds.
    let mut reported = Vec::new();
    harness::wait_until("a stream with a message", || {
        reported = lines(host, &path, 3)?;
        Ok(reported.iter().any(|line| line.get("message").is_some()))
    })?;
    let known = reported.iter().find(|line| line.get("type").is_some());
    let known = known.with_context(|| format!("{reported:?}"))?;
    ensure!(known["type"]["known"] == true, "{known}");
    let messages: Vec<_> = reported
        .iter()
        .filter_map(|line| line.get("message"))
        .collect();
    ensure!(
        (1..=16).contains(&messages.len()),
        "{} messages in 3 s",
        messages.len()
    );
    for message in &messages {
        let seconds = &message["value"]["header"]["stamp"]["sec"];
        ensure!(
            seconds
                .as_u64()
                .is_some_and(|seconds| seconds > 1_000_000_000),
            "{message}"
        );
    }
    Ok(())
}

/// A running `make demo`, which ends when this value is dropped.
struct Demo {
    child: std::process::Child,
    lines: std::sync::mpsc::Receiver<String>,
}

impl Demo {
    fn start() -> Result<Self> {
        let rp = PathBuf::from(env!("CARGO_BIN_EXE_rp"));
        let program = rp.with_file_name("examples").join("demo");
        ensure!(program.exists(), "build it: cargo build --examples");
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/ros2probe.yaml");
        let mut child = Command::new(program)
            .arg("--agent")
            .arg(rp)
            .arg("--config")
            .arg(config)
            .args(["--seconds", "120"])
            .stdout(Stdio::piped())
            .spawn()?;
        let output = BufReader::new(child.stdout.take().context("no output")?);
        let (reported, lines) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            output
                .lines()
                .map_while(Result::ok)
                .all(|line| reported.send(line).is_ok())
        });
        Ok(Self { child, lines })
    }

    /// Waits for a line with this beginning, and returns the rest of it.
    fn line(&self, beginning: &str) -> Result<String> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self
                .lines
                .recv_timeout(left)
                .context(beginning.to_owned())?;
            if let Some(rest) = line.strip_prefix(beginning) {
                return Ok(rest.to_owned());
            }
        }
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        // The demo removes its namespaces on SIGTERM.
        let id = self.child.id().to_string();
        let _ = Command::new("kill").args(["-TERM", &id]).status();
        let _ = self.child.wait();
    }
}

fn ask(address: &str, method: &str, path: &str) -> Result<String> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    write!(
        stream,
        "{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer)
}

#[test]
fn every_command_of_the_readme_works_against_the_demo() -> Result<()> {
    harness::require()?;
    let demo = Demo::start()?;
    // The program is printed with its path, so that the commands work as they are.
    let rp = env!("CARGO_BIN_EXE_rp");
    let list = demo.line(&format!("{rp} topic list"))?;
    let top = demo.line(&format!("{rp} top"))?;
    let metrics = demo.line("curl http://")?;
    let (metrics, _) = metrics.split_once('/').context("no address")?;
    let watch = demo.line("curl -X POST http://")?;
    let (api, path) = watch.split_once('/').context("no address")?;
    let page = demo.line("the page: http://")?;
    let page = page.trim_end_matches('/');
    let viewers = demo.line("Foxglove: ws://")?;
    drop(TcpStream::connect(&*viewers).context("no listener for viewers")?);

    // The robot of a busy machine may be known later than the addresses are printed.
    harness::wait_until("rates of topics", || {
        Ok(ask(metrics, "GET", "/metrics")?.contains("ros2_topic_rate_hertz{"))
    })?;
    ensure!(ask(page, "GET", "/")?.starts_with("HTTP/1.1 200"));
    let watched = ask(api, "POST", &format!("/{path}"))?;
    ensure!(watched.starts_with("HTTP/1.1 20"), "{watched}");
    for (words, options, expected) in [
        (vec!["topic", "list"], &list, "/points"),
        (vec!["top", "--once"], &top, "/points"),
        (
            vec!["topic", "echo", "/points", "--once", "--no-arr"],
            &list,
            "header:",
        ),
    ] {
        let mut text = String::new();
        harness::wait_until(&format!("`rp {words:?}` prints {expected}"), || {
            let output = Command::new(rp)
                .args(&words)
                .args(options.split_whitespace())
                .output()?;
            text = String::from_utf8_lossy(&output.stdout).into_owned();
            let output_text = String::from_utf8_lossy(&output.stderr);
            ensure!(output.status.success(), "rp {words:?}: {output_text}");
            Ok(text.contains(expected))
        })
        .with_context(|| text.clone())?;
    }
    Ok(())
}
