//! Watches that are added and removed beside a running robot: how soon they count, what remains
//! after them, and that they outlive the agent.

use std::collections::BTreeSet;
use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of, get};
use ros2probe_testing::harness::bpf::interest_of;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum time from the request for a watch to the first sample that counts.
const SOON: f64 = 0.1;
const MANY: usize = 1000;

#[test]
fn watches_are_added_and_removed_while_a_robot_runs() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    let (state, socket) = (
        directory.path().join("state"),
        directory.path().join("api.sock"),
    );
    std::fs::create_dir(&state)?;
    let text = format!(
        "{}watch: []\nstate_directory: {}\napi: {{socket: {}}}\n",
        at_the_sockets_of(&host),
        state.display(),
        socket.display()
    );
    std::fs::write(&configuration, text)?;
    let start = || Agent::start(&host, env!("CARGO_BIN_EXE_rp"), &configuration);
    let agent = start()?;
    let api = Api { socket: &socket };
    let stream = Stream::small(100_000);
    let _subscriber = Peer::start(&host, Stack::Cyclone, Role::Subscriber, &stream, &["/ekf"])?;
    let mut publisher = Peer::start(&host, Stack::Cyclone, Role::Publisher, &stream, &["/imu"])?;
    publisher.wait_matched()?;
    let published =
        |scrape: &Scrape| scrape.sum("ros2_topic_publishers", &[("topic", "/imu")]) > 0.0;
    wait_for(&agent, published).context("the publisher is not seen")?;

    check_watches_removed(&agent, &api)?;

    publisher.start_sending()?;
    wait_soon(&agent, &api, &publisher)?;

    watches_survive_a_kill(agent, &start, &api, &state)?;
    a_corrupt_file_is_set_aside(&start, &api, &state)?;
    state_of_a_newer_rp_stays(&start, &api, &state)
}

/// A function that starts an agent with the test's configuration.
type Start<'a> = &'a dyn Fn() -> Result<Agent<'a>>;

/// Checks that the watches are in the state directory before a kill, and in the next agent after
/// it.
fn watches_survive_a_kill(
    mut agent: Agent<'_>,
    start: Start<'_>,
    api: &Api<'_>,
    state: &Path,
) -> Result<()> {
    for topic in ["imu?domain_id=0", "camera/**"] {
        ensure!(api.ask("POST", topic)?.0 == 201);
    }
    let file = state.join("watches.json");
    let deadline = Instant::now() + PATIENCE;
    while !std::fs::read_to_string(&file)
        .unwrap_or_default()
        .contains("/camera/**")
    {
        ensure!(Instant::now() < deadline, "the watches are not written");
        std::thread::sleep(Duration::from_millis(10));
    }
    agent.process.signal("KILL")?;
    agent.process.wait(PATIENCE)?;
    let mut agent = start()?;
    let watches = api.ask("GET", "")?.1;
    ensure!(topics(&watches) == ["/imu", "/camera/**"], "{watches}");
    ensure!(watches["watches"][0]["domain_id"] == 0 && watches["watches"][0]["origin"] == "api");
    let health = get(agent.host, "http://127.0.0.1:17401/health")?;
    ensure!(health.contains("\"watches_kept\":true"), "{health}");
    agent.process.terminate()?;
    ensure!(!api.socket.exists(), "the socket's file stays");
    Ok(())
}

fn a_corrupt_file_is_set_aside(start: Start<'_>, api: &Api<'_>, state: &Path) -> Result<()> {
    let corrupt = "{\"version\": 1, \"watches\": [{}]}";
    std::fs::write(state.join("watches.json"), corrupt)?;
    let mut agent = start()?;
    let watches = api.ask("GET", "")?.1;
    ensure!(topics(&watches).is_empty(), "{watches}");
    ensure!(state.join("watches.json.corrupt").exists());
    agent.process.terminate()?;
    Ok(())
}

/// Checks that an older rp runs without the state of a newer one, and leaves its files unchanged.
fn state_of_a_newer_rp_stays(start: Start<'_>, api: &Api<'_>, state: &Path) -> Result<()> {
    let newer = |name: &str| (state.join(name), format!("{{\"version\":7,\"{name}\":0}}"));
    let newer = [newer("watches.json"), newer("discovery.json")];
    for (file, text) in &newer {
        std::fs::write(file, text)?;
    }
    let mut agent = start()?;
    ensure!(api.ask("POST", "imu")?.0 == 201);
    let health = get(agent.host, "http://127.0.0.1:17401/health")?;
    ensure!(health.contains("\"watches_kept\":false"), "{health}");
    let seen = |scrape: &Scrape| scrape.sum("ros2_participants", &[]) > 0.0;
    wait_for(&agent, seen).context("an agent without state sees nothing")?;
    agent.process.terminate()?;
    for (file, text) in &newer {
        ensure!(
            std::fs::read_to_string(file)? == *text,
            "{file:?} was touched"
        );
        ensure!(!file.with_extension("json.new").exists(), "{file:?}");
    }
    Ok(())
}

/// Checks that a thousand watches, and one that the kernel needs, leave nothing in the kernel's
/// map, in the agent's tables or on the page.
fn check_watches_removed(agent: &Agent<'_>, api: &Api<'_>) -> Result<()> {
    // A topic that was watched before keeps its counts.
    for method in ["POST", "DELETE"] {
        api.ask(method, "imu")?;
        let wanted = f64::from(u8::from(method == "POST"));
        let watched = |scrape: &Scrape| {
            (scrape
                .samples("ros2_watch_state", &[("topic", "/imu")])
                .count()
                > 0)
                == (wanted > 0.0)
        };
        wait_for(agent, watched)?;
    }
    // The agent removes the rest of a watch shortly after it.
    let mut before = Default::default();
    harness::wait_until("the tables stand still", || {
        let last = std::mem::replace(
            &mut before,
            (series(&agent.scrape()?), interest_of(agent.process.pid())?),
        );
        std::thread::sleep(Duration::from_millis(200));
        Ok(last == before)
    })?;
    ensure!(!before.1.is_empty(), "the kernel's map is empty");

    let begun = Instant::now();
    for number in 0..MANY {
        let (status, answer) = api.ask("POST", &format!("r{number}/points"))?;
        ensure!(status == 201, "{number}: {status} {answer}");
        // A watch that the kernel needs is added and removed among them.
        match number % 100 {
            0 => ensure!(api.ask("POST", "imu")?.0 == 201),
            50 => ensure!(api.ask("DELETE", "imu")?.0 == 204),
            _ => {}
        }
    }
    let added = begun.elapsed();
    let all = |scrape: &Scrape| {
        let labels = [("state", "not_published")];
        scrape.samples("ros2_watch_state", &labels).count() >= MANY
    };
    wait_for(agent, all).context("not all are watched")?;
    let begun = Instant::now();
    let (_, watches) = api.ask("GET", "")?;
    for topic in topics(&watches) {
        let (status, answer) = api.ask("DELETE", topic.trim_start_matches('/'))?;
        ensure!(status == 204, "{topic}: {status} {answer}");
    }
    eprintln!(
        "{MANY} watches: added in {added:?}, removed in {:?}",
        begun.elapsed()
    );

    let mut after = (series(&agent.scrape()?), interest_of(agent.process.pid())?);
    let deadline = Instant::now() + PATIENCE;
    while after != before {
        let more: Vec<_> = after.0.symmetric_difference(&before.0).take(5).collect();
        ensure!(
            Instant::now() < deadline,
            "{more:?} stay; the kernel's map had {:?} and has {:?}",
            before.1,
            after.1
        );
        std::thread::sleep(Duration::from_millis(100));
        after = (series(&agent.scrape()?), interest_of(agent.process.pid())?);
    }
    Ok(())
}

/// Checks that a sample counts less than 100 ms after the request for a watch. A busy machine needs
/// several requests.
fn wait_soon(agent: &Agent<'_>, api: &Api<'_>, publisher: &Peer) -> Result<()> {
    let labels = [("domain_id", "0"), ("topic", "/imu")];
    let of = |scrape: &Scrape, name| scrape.value(name, &labels).unwrap_or_default();
    let messages = |scrape: &Scrape| of(scrape, "ros2_topic_messages_total");
    let last = |scrape: &Scrape| of(scrape, "ros2_topic_last_message_timestamp_seconds");
    let deadline = Instant::now() + PATIENCE;
    loop {
        let counted = messages(&agent.scrape()?);
        let asked = SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64();
        let begun = Instant::now();
        ensure!(api.ask("POST", "imu")?.0 == 201);
        let answered = begun.elapsed();
        let scrape = wait_for(agent, |scrape| messages(scrape) > counted)?;
        let (count, last) = (messages(&scrape) - counted, last(&scrape));
        ensure!(api.ask("DELETE", "imu")?.0 == 204);
        // Messages in flight still count.
        let mut settled = messages(&scrape);
        loop {
            std::thread::sleep(Duration::from_millis(300));
            let now = messages(&agent.scrape()?);
            if now.to_bits() == settled.to_bits() {
                break;
            }
            settled = now;
        }
        let log = publisher.log()?;
        let sent = log.0.iter().filter(|event| event.ev == "pub");
        let sent: Vec<f64> = sent.map(|event| event.t as f64 / 1e9).collect();
        // A publisher logs the time of a sample before the agent sees the sample.
        let upto = sent.partition_point(|time| *time <= last);
        let first = upto
            .checked_sub(count as usize)
            .and_then(|first| sent.get(first));
        let first = first.context("more samples were counted than sent")?;
        let took = first - asked;
        eprintln!(
            "asked, answered after {answered:?}, first counted sample sent after {took:.4} s"
        );
        if took < SOON {
            return Ok(());
        }
        ensure!(Instant::now() < deadline, "{took} s");
    }
}

/// The control API through its socket.
struct Api<'a> {
    socket: &'a Path,
}

impl Api<'_> {
    /// Sends a request for one watch or for all, and repeats it after 429.
    fn ask(&self, method: &str, topic: &str) -> Result<(u16, Value)> {
        loop {
            let mut stream = UnixStream::connect(self.socket)?;
            stream.set_read_timeout(Some(PATIENCE))?;
            let path = if topic.is_empty() {
                "/watch".to_owned()
            } else {
                format!("/watch/{topic}")
            };
            write!(
                stream,
                "{method} {path} HTTP/1.1\r\nHost: rp\r\nConnection: close\r\n\r\n"
            )?;
            let mut answer = String::new();
            stream.read_to_string(&mut answer)?;
            let (head, body) = answer.split_once("\r\n\r\n").context("no answer")?;
            let status = head.split(' ').nth(1).context("no status")?.parse()?;
            if status == 429 {
                std::thread::sleep(Duration::from_millis(200));
                continue;
            }
            return Ok((status, serde_json::from_str(body).unwrap_or_default()));
        }
    }
}

fn topics(watches: &Value) -> Vec<&str> {
    let watches = watches["watches"].as_array().into_iter().flatten();
    watches
        .filter_map(|watch| watch["topic"].as_str())
        .collect()
}

fn wait_for(agent: &Agent<'_>, wanted: impl Fn(&Scrape) -> bool) -> Result<Scrape> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let scrape = agent.scrape()?;
        if wanted(&scrape) {
            return Ok(scrape);
        }
        ensure!(Instant::now() < deadline, "not on the page:\n{}", scrape.0);
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Returns the page's series of topics and watches, and of the fill of their tables.
fn series(scrape: &Scrape) -> BTreeSet<String> {
    let lines = scrape.0.lines();
    let named = lines.clone().filter_map(|line| line.rsplit_once(' '));
    let named = named.map(|(name, _)| name);
    let named =
        named.filter(|name| name.starts_with("ros2_topic") || name.starts_with("ros2_watch"));
    let tables = ["interest", "topics", "writers"];
    let tables = tables.map(|table| format!("ros2probe_table_entries{{table=\"{table}\"}}"));
    let tables = lines.filter(|line| tables.iter().any(|table| line.starts_with(table)));
    named.chain(tables).map(str::to_owned).collect()
}
