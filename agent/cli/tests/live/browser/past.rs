//! The page at a moment in the past: the robot before a restart, and what it said then.

use std::time::Duration;

use anyhow::{Result, ensure};
use serde_json::json;

use super::player::play;
use super::robot::{Place, Robot};
use super::{PAGE, while_repeating};
use crate::robot_parts::{self, Node};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_log::{self, log};
use ros2probe_testing::robot_parameters::{self, event};

/// Time for which the robot of the past runs: three readings of its processes.
const PAST: Duration = Duration::from_secs(35);

#[test]
fn the_page_shows_the_robot_as_it_was_before_a_restart() -> Result<()> {
    let place = Place::new()?;
    let state = place.directory.path().join("state");
    std::fs::create_dir(&state)?;
    let configuration = format!("watch: [/**]\nstate_directory: {}\n", state.display());
    let mut agent = place.agent(&configuration)?;
    let begin = unix_time();
    let robot = Robot::start(&place.host)?;
    std::thread::sleep(PAST);
    agent.process.terminate()?;
    let end = unix_time();
    drop((agent, robot));
    std::fs::remove_file(state.join("discovery.json"))?;
    let mut running = None;
    let mut answers = |question: &str| {
        ensure!(question == "another robot after a restart", "{question}");
        let agent = place.agent(&configuration)?;
        running = Some((agent, place.publisher("/after_restart", "/other")?));
        Ok(json!({"begin": begin, "end": end}))
    };
    play(&place.inside(), "past", &[PAGE], &mut answers)
}

pub(super) fn unix_time() -> u64 {
    let since = std::time::SystemTime::UNIX_EPOCH.elapsed();
    since.unwrap_or_default().as_secs()
}

/// What the robot said: the agent before its restart, and the one after it.
#[test]
fn the_page_shows_what_the_robot_said_before_it_said_something_else() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let state = directory.path().join("state");
    std::fs::create_dir(&state)?;
    let more = format!("state_directory: {}\n", state.display());
    let mut agent = robot_parts::agent(&link, &directory, &more)?;
    let mut nodes = Vec::new();
    for (number, name, topic) in [
        (1, "lidar", ("rt/rosout", robot_log::DDS_TYPE)),
        (
            2,
            "monitor",
            ("rt/diagnostics", robot_diagnostics::DDS_TYPE),
        ),
        (
            3,
            "planner",
            ("rt/parameter_events", robot_parameters::EVENT),
        ),
    ] {
        nodes.push(Node::start(&link, number, name, topic)?);
    }
    agent.scrape_until("all nodes", |page| page.sum("ros2_nodes", &[]) == 3.0)?;
    say(&mut nodes, "motor too hot", (2, "nearly empty"), 5)?;
    agent.scrape_until("the log", |page| {
        page.sum("ros2_log_messages_total", &[]) == 1.0
    })?;
    agent.scrape_until("the battery", |page| {
        page.sum("ros2_diagnostics_level", &[]) == 2.0
    })?;
    agent.process.terminate()?;
    let end = unix_time();
    drop(agent);
    let mut running = None;
    let nodes = std::sync::Mutex::new(nodes);
    let every = || {
        let mut nodes = nodes
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        nodes.iter_mut().try_for_each(Node::renew)
    };
    let mut answers = |question: &str| {
        ensure!(question == "another agent and other words", "{question}");
        running = Some(robot_parts::agent(&link, &directory, &more)?);
        let mut nodes = nodes
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        say(&mut nodes, "motor is cool", (0, "full"), 7)?;
        Ok(json!({"end": end}))
    };
    while_repeating(every, || {
        play(&link.monitor.inside(), "past-views", &[PAGE], &mut answers)
    })
}

/// Sends a log message, the state of a battery, and the value of a parameter.
fn say(nodes: &mut [Node], text: &str, battery: (u8, &str), speed: i64) -> Result<()> {
    let [lidar, monitor, planner] = nodes else {
        anyhow::bail!("not three nodes")
    };
    let (level, message) = battery;
    lidar.send(&log(40, "lidar", text.as_bytes()))?;
    monitor.send(&diagnostics(&[Status {
        level,
        name: "battery",
        message,
        values: &[("Voltage (V)", "11.9")],
    }]))?;
    planner.send(&event("/planner", &[("speed", speed)], &[], &[]))
}
