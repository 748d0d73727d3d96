//! A disk whose reads, writes, syncs and changes of names fail with EIO, as on a failing disk.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use super::disk::{readable, writes};
use super::{Counted, FaultBench};
use ros2probe_testing::harness::agent::PACKETS_ALONE;
use ros2probe_testing::harness::failing_disk::{Failing, FailingDisk};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::soak::outcome;
use ros2probe_testing::harness::wait_until;

/// Maximum time of an answer, and until a recording ends, on a busy machine.
const MAX_RESPONSE_TIME: Duration = Duration::from_secs(30);
const EIO: &str = "Input/output error";

struct Robot<'a, 'b> {
    scene: &'a FaultBench<'b>,
    disk: &'a FailingDisk,
    place: &'a Path,
}

impl Robot<'_, '_> {
    fn writes(&self, outcome: &'static str) -> Result<f64> {
        Ok(writes(&self.scene.agent.scrape()?, outcome))
    }

    /// Starts a recording.
    fn record(&self, name: &str) -> Result<()> {
        let body = format!(r#"{{"name": "{name}"}}"#);
        let (status, begun) = self.scene.ask("POST", "/recordings", &body)?;
        ensure!(status == 201, "{status} {begun}");
        Ok(())
    }

    /// Checks that a new recording is refused with the reason, soon and without a trace.
    fn refuses(&self, name: &str) -> Result<()> {
        let began = Instant::now();
        let body = format!(r#"{{"name": "{name}"}}"#);
        let (status, problem) = self.scene.ask("POST", "/recordings", &body)?;
        let detail = problem["detail"].as_str().unwrap_or_default();
        ensure!(
            (500..600).contains(&status)
                && detail.contains(EIO)
                && began.elapsed() < MAX_RESPONSE_TIME,
            "{status} {problem} after {:?}",
            began.elapsed()
        );
        Ok(())
    }

    /// Waits until a part of a recording is on the disk.
    fn is_on_the_disk(&self, name: &str) -> Result<()> {
        wait_until("some of it is on the disk", || {
            let (_, now) = self.scene.ask("GET", &format!("/recordings/{name}"), "")?;
            Ok(now["file_bytes"]
                .as_u64()
                .is_some_and(|bytes| bytes > 100_000))
        })
    }

    /// Waits until a recording has ended, and returns the reason and the messages in its bag.
    fn ended(&self, name: &str) -> Result<(String, u64)> {
        let path = format!("/recordings/{name}");
        wait_until(&format!("{name} ends"), || {
            Ok(self.scene.ask("GET", &path, "")?.1["state"] == "ended")
        })?;
        let (_, ended) = self.scene.ask("GET", &path, "")?;
        let error = ended["error"].as_str().unwrap_or_default();
        ensure!(error.contains(EIO) && ended["files"] == 1, "{ended}");
        let kept = ended["report"]["messages"].as_u64();
        Ok((error.to_owned(), kept.context("no count")?))
    }

    /// Checks that the bag of a failed recording has the counted messages, both as it is and after
    /// it was completed.
    fn check_failed_bag(&self, name: &str, messages: u64) -> Result<()> {
        ensure!(messages >= 100, "{name}: {messages} messages");
        let bag = self.place.join("bags").join(name);
        let bytes = fs::read(bag.join(format!("{name}_0.mcap")))?;
        let options = mcap::read::Options::IgnoreEndMagic;
        let found = mcap::MessageStream::new_with_options(&bytes, options.into())?;
        let found = found.take_while(Result::is_ok).count() as u64;
        ensure!(found == messages, "{name}: {found} of {messages} messages");
        ros2probe_bag::reindex::reindex(&bag, ros2probe_wire::Expansion::Limited)?;
        readable(&bag, messages)
    }

    /// Checks that everything is written again: the state with this node, and a recording.
    fn recovers(&self, counted: &mut Counted, node: &str, name: &str) -> Result<()> {
        let written = self.writes("written")?;
        self.disk.fail(Failing::NO_OPERATION);
        wait_until("a state write", || Ok(self.writes("written")? > written))?;
        let text = fs::read_to_string(self.place.join("state/discovery.json"))?;
        serde_json::from_str::<Value>(&text).context("half a state")?;
        ensure!(text.contains(node), "{text}");
        self.record(name)?;
        counted.send_samples(320, 40)?;
        let (status, ended) = self
            .scene
            .ask("DELETE", &format!("/recordings/{name}"), "")?;
        ensure!(
            status == 200 && ended["error"].is_null() && ended["report"]["messages"] == 40,
            "{status} {ended}"
        );
        readable(&self.place.join("bags").join(name), 40)
    }
}

#[test]
fn an_eio_disk_loses_only_its_files_and_no_message() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let place = directory.path().join("disk");
    fs::create_dir(&place)?;
    let disk = FailingDisk::mount(&place)?;
    ["state", "bags"]
        .iter()
        .try_for_each(|name| fs::create_dir(place.join(name)))?;
    let configuration = format!(
        "watch: [/**]\nstate_directory: {0}/state\nrecordings:\n  directory: {0}/bags\n  reserve_percent: 0\n  \
         reserve_bytes: 0\n{PACKETS_ALONE}",
        place.display()
    );
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &[])?;
    let robot = Robot {
        scene: &scene,
        disk: &disk,
        place: &place,
    };
    let mut counted = Counted::start(&link, 1, "first")?;
    scene.node_is_known("/first")?;
    wait_until("a state", || Ok(robot.writes("written")? > 0.0))?;
    let mut others = Vec::new();
    for (number, failing, name) in [
        (2, Failing::WRITES, "writes"),
        (3, Failing::SYNCS, "syncs"),
        (4, Failing::NAMES, "names"),
        (5, Failing::ALL, "all"),
    ] {
        let failed = robot.writes("failed")?;
        robot.record(name)?;
        counted.send_samples(1400, 200)?;
        robot.is_on_the_disk(name)?;
        disk.fail(failing);
        counted.send_samples(1400, 400)?;
        let node = format!("node_of_{name}");
        others.push(Counted::start(&link, number, &node)?);
        let began = Instant::now();
        let (error, kept) = robot.ended(name)?;
        let took = began.elapsed();
        ensure!(took < MAX_RESPONSE_TIME, "{name}: ended after {took:?}");
        // A failed sync is noticed only when the file is synced.
        if failing != Failing::SYNCS {
            robot.refuses(&format!("{name}_refused"))?;
        }
        wait_until("a state write that fails", || {
            Ok(robot.writes("failed")? > failed)
        })?;
        scene.node_is_known(&format!("/{node}"))?;
        counted.check(&scene.agent)?;
        robot.recovers(&mut counted, &node, &format!("{name}_recovered"))?;
        robot.check_failed_bag(name, kept)?;
        outcome(
            &format!("EIO for {name}"),
            &format!(
                "the recording ends after {took:?} (\"{error}\") and its bag has the {kept} messages it counts; \
                 state is written again; every message counted"
            ),
        )?;
    }
    // A recording reads nothing from the disk.
    robot.record("reads")?;
    disk.fail(Failing::READS);
    counted.send_samples(1400, 100)?;
    let (status, ended) = scene.ask("DELETE", "/recordings/reads", "")?;
    ensure!(
        status == 200 && ended["report"]["messages"] == 100,
        "{status} {ended}"
    );
    disk.fail(Failing::NO_OPERATION);
    readable(&place.join("bags/reads"), 100)?;
    counted.check(&scene.agent)?;
    robot.record("last")?;
    counted.send_samples(1400, 200)?;
    robot.is_on_the_disk("last")?;
    disk.fail(Failing::ALL);
    let log = scene.log();
    ensure!(!log.contains("panicked"), "{log}");
    let took = scene.end()?;
    ensure!(disk.failures() > 0);
    outcome(
        "EIO for all at the end of the agent",
        &format!("ended in {took:?}"),
    )
}
