//! `rp learn` with a live agent. It measures topics that no watch covers, and leaves nothing
//! behind. Its file detects the faults of the same robot.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, datagrams_alone_of};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::{wait_until, wait_within};

/// Time to learn: more than the 20 s with a publisher that the numbers of endpoints need.
const LEARNS: Duration = Duration::from_secs(30);
/// Time for which the agent does not judge a new watch.
const GRACE: Duration = Duration::from_secs(10);
/// Time without a violation that shows a healthy robot.
const HEALTHY_TIME: Duration = Duration::from_secs(5);
/// Maximum time until then: the robot itself is late on a busy machine.
const HEALTHY_WITHIN: Duration = Duration::from_secs(150);
const VIOLATED: &str = "ros2_watch_expectation_violated";

/// An agent that watches nothing by itself, and its files.
struct Place<'a> {
    agent: Agent<'a>,
    configuration: PathBuf,
    settings: String,
    socket: PathBuf,
    watchlist: PathBuf,
}

impl<'a> Place<'a> {
    fn new(host: &'a Namespace, directory: &Path) -> Result<Self> {
        let configuration = directory.join("ros2probe.yaml");
        let socket = directory.join("api.sock");
        let settings = format!(
            "{}api: {{socket: {}}}\n",
            datagrams_alone_of(host),
            socket.display()
        );
        std::fs::write(&configuration, &settings)?;
        Ok(Self {
            agent: Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)?,
            configuration,
            settings,
            socket,
            watchlist: directory.join("watchlist.yaml"),
        })
    }

    fn learn(&self) -> Result<Child> {
        let child = Command::new(env!("CARGO_BIN_EXE_rp"))
            .env_remove("ROS_DOMAIN_ID")
            .args(["learn", "/imu", "/sca*", "--socket"])
            .arg(&self.socket)
            .arg("-o")
            .arg(&self.watchlist)
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()?;
        Ok(child)
    }

    /// Adds the learnt watchlist to the configuration, and applies it.
    fn apply(&self) -> Result<()> {
        let learnt = std::fs::read_to_string(&self.watchlist)?;
        std::fs::write(&self.configuration, format!("{}{learnt}", self.settings))?;
        self.agent.process.signal("HUP")
    }

    /// Returns whether the topic violates this expectation now; `None` without the expectation.
    fn violates(&self, topic: &str, expectation: &str) -> Result<Option<bool>> {
        let labels = [("topic", topic), ("expectation", expectation)];
        let value = self.agent.scrape()?.value(VIOLATED, &labels);
        Ok(value.map(|value| value > 0.0))
    }
}

#[test]
fn expectations_of_a_live_robot_are_learnt_without_a_watch_and_detect_its_faults() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let place = Place::new(&host, directory.path())?;
    let imu = Stream::small(1_000_000);
    let scan = Stream {
        topic: "/scan".to_owned(),
        rate: 20.0,
        ..imu.clone()
    };
    let start =
        |role, stream: &Stream, node: &str| Peer::start(&host, Stack::Rust, role, stream, &[node]);
    let _ekf = start(Role::Subscriber, &imu, "/ekf")?;
    let mut slam = start(Role::Subscriber, &scan, "/slam")?;
    let mut driver = start(Role::Publisher, &imu, "/driver")?;
    let mut lidar = start(Role::Publisher, &scan, "/lidar")?;
    for publisher in [&mut driver, &mut lidar] {
        publisher.wait_matched()?;
        publisher.start_sending()?;
    }

    let begin = Instant::now();
    let mut learning = place.learn()?;
    wait_until("the topics are measured", || {
        let page = place.agent.scrape()?;
        let counted = |topic| page.sum("ros2_topic_messages_total", &[("topic", topic)]);
        Ok(counted("/imu") > 0.0 && counted("/scan") > 0.0)
    })?;
    std::thread::sleep(LEARNS.saturating_sub(begin.elapsed()));
    ensure!(learning.try_wait()?.is_none(), "it ended by itself");
    harness::run(&format!("kill -INT {}", learning.id()))?;
    let output = learning.wait_with_output()?;
    let printed = String::from_utf8(output.stderr)?;
    ensure!(output.status.success(), "{printed}");
    ensure!(
        printed.lines().count() == 1 && printed.contains("for 2 of 2 topics"),
        "{printed}"
    );
    is_complete(&place.watchlist)?;

    // No topic stays watched or measured.
    wait_until("the stream is closed", || {
        let page = place.agent.scrape()?;
        Ok(page.value("ros2probe_subscriptions", &[]) == Some(0.0))
    })?;
    let watches = place.agent.scrape()?.sum("ros2_watch_state", &[]);
    ensure!(watches == 0.0, "{watches} watched topics");

    place.apply()?;
    wait_until("the watchlist applies", || {
        Ok(place.violates("/scan", "subscribers")?.is_some())
    })?;
    let mut since = Instant::now() + GRACE;
    wait_within(HEALTHY_WITHIN, "a healthy robot violates nothing", || {
        if place.agent.scrape()?.sum(VIOLATED, &[]) > 0.0 {
            since = Instant::now();
        }
        Ok(since.elapsed() >= HEALTHY_TIME)
    })?;

    drop(driver);
    let half = Stream {
        rate: imu.rate / 2.0,
        ..imu
    };
    let mut driver = start(Role::Publisher, &half, "/driver")?;
    driver.wait_matched()?;
    driver.start_sending()?;
    slam.process.terminate()?;
    for (topic, expectation) in [("/imu", "min_rate_hz"), ("/scan", "subscribers")] {
        let what = format!("{topic} violates {expectation}");
        wait_until(&what, || {
            Ok(place.violates(topic, expectation)? == Some(true))
        })?;
    }
    wait_until("/scan is not silent", || {
        Ok(place.violates("/scan", "max_silence_s")? == Some(false))
    })
}

/// Checks that the file is valid and that each topic has a rate, a loss, a silence and endpoints.
fn is_complete(watchlist: &Path) -> Result<()> {
    let text = std::fs::read_to_string(watchlist)?;
    let checked = Command::new(env!("CARGO_BIN_EXE_rp"))
        .arg("check-config")
        .arg(watchlist)
        .output()?;
    ensure!(checked.status.success(), "{text}");
    for key in [
        "min_rate_hz: ",
        "max_rate_hz: ",
        "max_loss_ratio: ",
        "max_silence_s: ",
        "publishers: 1",
        "subscribers: 1",
    ] {
        let lines = text
            .lines()
            .filter(|line| line.trim_start().starts_with(key));
        let count = lines.count();
        ensure!(count == 2, "{count} times `{key}` in {text}");
    }
    Ok(())
}

#[test]
fn rp_learn_writes_no_watchlist_if_the_agent_ends() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let mut place = Place::new(&host, directory.path())?;
    let learning = place.learn()?;
    let agent = &place.agent;
    agent.scrape_until("a stream open", |page| {
        page.value("ros2probe_subscriptions", &[]) == Some(1.0)
    })?;
    place.agent.process.terminate()?;
    let output = learning.wait_with_output()?;
    let printed = String::from_utf8(output.stderr)?;
    let last = printed.lines().last().context("no error")?;
    ensure!(output.status.code() == Some(1), "{printed}");
    ensure!(last.contains("the agent has ended"), "{printed}");
    ensure!(!place.watchlist.exists());
    Ok(())
}
