//! A healthy robot of seven topics raises no alarm, also when the agent is killed and restarted
//! twice.
//!
//! Needs root and ROS 2: `make test-ros2`. `QUIET_SECONDS=600` makes it as long as a soak.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;

use crate::host::{Host, Middleware};

const PATIENCE: Duration = Duration::from_secs(60);
/// Duration of the test: longer than two intervals of the slowest topic.
const SECONDS: u64 = 120;
/// Interval at which the agent saves its state, with a margin for a busy machine.
const SAVED: Duration = Duration::from_secs(8);
/// Topics of `ros2/robot.py` with minimum rate and maximum silence: 0.8 of the rate, and two
/// seconds or one and a half intervals.
const EXPECTED: [(&str, Option<u32>, u32); 7] = [
    ("/beat", None, 2),
    ("/cam", Some(8), 2),
    ("/imu", Some(200), 2),
    ("/mode", None, 75),
    ("/odom", Some(40), 2),
    ("/points", Some(4), 2),
    ("/tf", Some(80), 2),
];
const ALARMS: [&str; 2] = ["ros2.message.lost", "ros2.topic.silent"];

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn fast_dds_with_shared_memory_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::FastSampled)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn fast_dds_with_a_uprobe_on_demand_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn fast_dds_with_a_uprobe_for_every_message_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::FastExact("uprobe"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn fast_dds_over_udp_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::FastUdp)
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn cyclone_dds_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn zenoh_raises_no_alarm() -> Result<()> {
    raises_no_alarm(Middleware::Zenoh)
}

fn raises_no_alarm(middleware: Middleware) -> Result<()> {
    let seconds = std::env::var("QUIET_SECONDS").map_or(Ok(SECONDS), |text| text.parse())?;
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let watchlist = watchlist()?;
    let mut agent = host.agent(&watchlist)?;
    let _router = host.router_if_any()?;
    let log = |role: &str| host.path(&format!("{role}.jsonl"));
    let mut subscriber = host.python("robot.py", &["subscribe", &log("subscribe")])?;
    subscriber.wait_for("ready", PATIENCE)?;
    let length = seconds.to_string();
    let mut publisher = host.python("robot.py", &["publish", &log("publish"), &length])?;
    publisher.wait_for("matched", PATIENCE)?;
    publisher.write_line("go")?;
    // Polling may miss the only message of a slow topic; its next one comes after 50 s.
    let is_polled = matches!(
        middleware,
        Middleware::FastSampled | Middleware::FastExact("auto")
    );
    let all_measured = |page: &Scrape| {
        let mut expected = EXPECTED.iter();
        expected.all(|(topic, ..)| {
            let messages = page.sum("ros2_topic_messages_total", &[("topic", topic)]);
            messages > 0.0 || (is_polled && *topic == "/mode")
        })
    };
    let start = Instant::now();
    agent.scrape_until("all topics are measured", all_measured)?;
    // The publishers exist before their first message, and this time is a silence.
    let page = agent.scrape_until("no expectation is violated", |page| {
        page.sum("ros2_watch_expectation_violated", &[]) == 0.0
    })?;
    let mut before = alarms(&page);
    // The last second is omitted, because topics end one after the other.
    let third = Duration::from_secs(seconds.saturating_sub(1)) / 3;
    for restarts in 0..3 {
        if restarts > 0 {
            std::thread::sleep(SAVED);
            agent.process.signal("KILL")?;
            drop(agent);
            agent = host.agent(&watchlist)?;
            before = 0.0;
        }
        while start.elapsed() < third * (restarts + 1) {
            is_quiet(&agent, restarts, before)?;
            std::thread::sleep(Duration::from_millis(500));
        }
    }
    publisher.wait_for("done", PATIENCE)
}

fn watchlist() -> Result<String> {
    let mut text = "watch:\n".to_owned();
    for (topic, rate, silence) in EXPECTED {
        let rate = rate.map_or(String::new(), |rate| format!("min_rate_hz: {rate}, "));
        writeln!(
            text,
            "  - {{topic: {topic}, {rate}max_silence_s: {silence}, max_loss_ratio: 0.01}}"
        )?;
    }
    Ok(text)
}

/// Returns the number of alarms since the agent started.
fn alarms(page: &Scrape) -> f64 {
    let count = |name: &&str| page.sum("ros2probe_events_total", &[("name", name)]);
    ALARMS.iter().map(count).sum()
}

fn is_quiet(agent: &Agent<'_>, restarts: u32, before: f64) -> Result<()> {
    let page = agent.scrape()?;
    let violated = page.sum("ros2_watch_expectation_violated", &[]);
    let alarms = alarms(&page) - before;
    let shown = || {
        let of_watches = |line: &&str| {
            line.starts_with("ros2_watch_")
                || line.starts_with("ros2_topic_rate_hertz")
                || line.starts_with("ros2_topic_lost")
                || line.starts_with("ros2_topic_delivery_lost")
        };
        let lines: Vec<_> = page.0.lines().filter(of_watches).collect();
        lines.join("\n")
    };
    ensure!(
        violated == 0.0 && alarms == 0.0,
        "{violated} violated, {alarms} alarms after {restarts} restarts:\n{}",
        shown()
    );
    Ok(())
}
