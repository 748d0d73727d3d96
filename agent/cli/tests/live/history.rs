//! The history on disk: after the agent's end, after SIGKILL, and for topics that no longer exist.

use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use crate::browser::robot::{Place, Robot};
use ros2probe_testing::harness;

/// Time until the first minute is written, on a busy machine.
const MINUTE: Duration = Duration::from_secs(150);

#[test]
fn the_history_has_every_message_before_the_end_of_the_agent() -> Result<()> {
    let scene = Scene::new()?;
    let mut agent = scene.agent()?;
    let robot = Robot::start(&scene.place.host)?;
    harness::wait_until("messages are measured", || {
        let imu = scene.place.ask("/topics/imu").unwrap_or_default();
        Ok(imu["measurement"]["messages"].as_u64() > Some(300))
    })?;
    drop(robot);
    // The last messages are in a finished second.
    agent.settled_scrape("/imu", 0)?;
    std::thread::sleep(Duration::from_millis(1500));
    let counted = &scene.place.ask("/topics/imu")?["measurement"]["messages"];
    let counted = counted.as_u64().context("no count")?;
    harness::wait_until("the seconds of all messages", || {
        Ok(scene.messages("/topics/imu/history")? >= counted)
    })?;
    ensure!(counted > 100, "{counted}");
    agent.process.terminate()?;
    drop(agent);
    std::fs::remove_file(scene.state().join("discovery.json"))?;
    let _agent = scene.agent()?;
    let history = scene.place.ask("/history")?;
    ensure!(
        history["is_kept"] == true && history["bytes"].as_u64() > Some(100),
        "{history}"
    );
    ensure!(scene.messages("/topics/imu/history?step=1")? == counted);
    ensure!(scene.messages("/topics/imu/history?step=60")? == counted);
    let now = std::time::SystemTime::UNIX_EPOCH.elapsed()?.as_secs();
    let moment = harness::agent::get(
        &scene.place.host,
        &format!("http://127.0.0.1:17401/history/moment?at={now}"),
    )?;
    ensure!(
        moment.contains("\"/imu\"") && moment.contains("{\"values\""),
        "{moment}"
    );
    // The endpoints and deliveries of a topic that no longer exists.
    let topics = scene
        .place
        .ask(&format!("/history/moment/topics?at={now}"))?;
    let all = topics["topics"].as_array().context("no topics")?;
    let imu = all.iter().find(|topic| topic["name"] == "/imu");
    let imu = imu.with_context(|| topics.to_string())?;
    ensure!(
        imu["publishers"][0]["qos"]["reliability"] == "BEST_EFFORT"
            && imu["measurement"].is_null()
            && imu["publishers"][0]["past_figures"]["rate_hertz"].is_number()
            && imu["deliveries"][0]["delivered"]["messages"].as_u64() > Some(100),
        "{imu}"
    );
    Ok(())
}

#[test]
fn a_killed_agent_loses_at_most_the_last_minute() -> Result<()> {
    let scene = Scene::new()?;
    let agent = scene.agent()?;
    // A small stream suffices for a minute.
    let _subscriber = scene.place.subscriber("/imu")?;
    let _publisher = scene.place.publisher("/imu", "/imu_driver")?;
    harness::wait_until("messages are measured", || {
        Ok(scene.messages("/topics/imu/history").unwrap_or(0) > 100)
    })?;
    let writes = || anyhow::Ok(scene.place.ask("/history")?["writes"].as_u64());
    let before = writes()?;
    harness::wait_within(MINUTE, "the minute of these messages", || {
        Ok(writes()? > before)
    })?;
    let end = std::time::SystemTime::UNIX_EPOCH.elapsed()?.as_secs();
    let path = format!("/topics/imu/history?step=1&to={end}");
    let written = scene.messages(&path)?;
    agent.process.signal("KILL")?;
    drop(agent);
    let _agent = scene.agent()?;
    let kept = scene.messages(&path)?;
    ensure!(
        kept * 2 > written && kept <= written,
        "{kept} of {written}: {}",
        scene.place.ask(&path)?
    );
    Ok(())
}

/// A host with a state directory.
struct Scene {
    place: Place,
}

impl Scene {
    fn new() -> Result<Self> {
        let place = Place::new()?;
        let scene = Self { place };
        std::fs::create_dir(scene.state())?;
        Ok(scene)
    }

    fn state(&self) -> std::path::PathBuf {
        self.place.directory.path().join("state")
    }

    fn agent(&self) -> Result<harness::agent::Agent<'_>> {
        let state = self.state();
        let more = format!("watch: [/**]\nstate_directory: {}\n", state.display());
        self.place.agent(&more)
    }

    /// Returns the number of messages in a history.
    fn messages(&self, path: &str) -> Result<u64> {
        let history = self.place.ask(path)?;
        let messages = history["messages"].as_array();
        let messages = messages.with_context(|| history.to_string())?.iter();
        Ok(messages.filter_map(Value::as_u64).sum())
    }
}
