//! Disks that are full, read-only, or removed.

use std::fs;
use std::io::Write as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use super::{Counted, FaultBench};
use ros2probe_testing::harness::agent::{PACKETS_ALONE, Scrape};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::soak::outcome;
use ros2probe_testing::harness::{run, wait_until};

/// The agent's disk, which only the agent has.
struct Disk<'a, 'b> {
    scene: &'a FaultBench<'b>,
    /// Path of the disk for the agent.
    place: PathBuf,
    /// Path of the disk for this process.
    root: PathBuf,
}

impl Disk<'_, '_> {
    /// Fills the disk completely.
    fn fill(&self) -> Result<()> {
        let mut filler = fs::File::create(self.root.join("filler"))?;
        while filler.write_all(&[7; 4096]).is_ok() {}
        Ok(())
    }

    fn make_room(&self) -> Result<()> {
        Ok(fs::remove_file(self.root.join("filler"))?)
    }

    fn remount(&self, options: &str) -> Result<()> {
        run(&format!(
            "nsenter --mount=/proc/{}/ns/mnt mount -o remount,{options} {}",
            self.scene.pid(),
            self.place.display()
        ))?;
        Ok(())
    }

    /// Returns the files of a directory, `state` or `bags`.
    fn names(&self, directory: &str) -> Vec<String> {
        let entries = fs::read_dir(self.root.join(directory));
        let entries = entries.into_iter().flatten().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    /// Checks that the saved state is whole and has these nodes.
    fn state(&self, nodes: &[&str]) -> Result<()> {
        let text = fs::read_to_string(self.root.join("state/discovery.json"))?;
        serde_json::from_str::<Value>(&text).context("half a state")?;
        ensure!(nodes.iter().all(|node| text.contains(node)), "{text}");
        ensure!(self.names("state") == ["discovery.json"]);
        Ok(())
    }

    fn writes(&self, outcome: &'static str) -> Result<f64> {
        Ok(writes(&self.scene.agent.scrape()?, outcome))
    }

    fn wait_for_write(&self, outcome: &'static str, before: f64) -> Result<()> {
        wait_until(&format!("a state write that is {outcome}"), || {
            Ok(self.writes(outcome)? > before)
        })
    }

    /// Checks that a recording and a snapshot are refused, and that they leave nothing behind.
    fn refuses(&self, reason: &str) -> Result<()> {
        let before = self.names("bags");
        for _ in 0..3 {
            for (path, body) in [
                ("/recordings", r#"{"name": "refused"}"#),
                ("/snapshots/incident", ""),
            ] {
                let (status, problem) = self.scene.ask("POST", path, body)?;
                let detail = problem["detail"].as_str().unwrap_or_default();
                ensure!(
                    status == 507 && detail.contains(reason),
                    "{path}: {status} {problem}"
                );
            }
        }
        let after = self.names("bags");
        ensure!(after == before, "{before:?} became {after:?}");
        Ok(())
    }

    /// Checks that a recording and a snapshot work, and that their bags can be read.
    fn accepts(&self, counted: &mut Counted, name: &str) -> Result<()> {
        let body = format!(r#"{{"name": "{name}"}}"#);
        let (status, begun) = self.scene.ask("POST", "/recordings", &body)?;
        ensure!(status == 201, "{status} {begun}");
        counted.send_samples(320, 40)?;
        let path = format!("/recordings/{name}");
        let (status, ended) = self.scene.ask("DELETE", &path, "")?;
        ensure!(
            status == 200 && ended["error"].is_null() && ended["report"]["messages"] == 40,
            "{status} {ended}"
        );
        let (status, written) = self.scene.ask("POST", "/snapshots/incident", "")?;
        ensure!(status == 201, "{status} {written}");
        readable(&self.root.join("bags").join(name), 40)
    }
}

#[test]
fn a_full_read_only_or_removed_disk_loses_only_its_files_and_no_message() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let place = directory.path().join("disk");
    fs::create_dir(&place)?;
    let configuration = format!(
        "watch: [/**]\nstate_directory: {0}/state\nrecordings:\n  directory: {0}/bags\n  reserve_percent: 0\n  reserve_bytes: 0\n  \
         snapshots: [{{name: incident, topics: [/counted_1], seconds: 60}}]\n{PACKETS_ALONE}",
        place.display()
    );
    let script =
        r#"mount -t tmpfs -o size=24m none "$0" && mkdir "$0/state" "$0/bags" && exec "$@""#;
    let place_name = place.display().to_string();
    let words = ["unshare", "--mount", "sh", "-c", script, &place_name];
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &words)?;
    let root = format!("/proc/{}/root", scene.pid());
    let disk = Disk {
        scene: &scene,
        root: Path::new(&root).join(place.strip_prefix("/")?),
        place,
    };
    let mut counted = Counted::start(&link, 1, "first")?;
    scene.node_is_known("/first")?;
    wait_until("a state", || Ok(disk.state(&["/first"]).is_ok()))?;

    let (status, begun) = scene.ask("POST", "/recordings", r#"{"name": "cut"}"#)?;
    ensure!(status == 201, "{status} {begun}");
    counted.send_samples(1400, 100)?;
    wait_until("some of it is on the disk", || {
        let (_, now) = scene.ask("GET", "/recordings/cut", "")?;
        Ok(now["file_bytes"]
            .as_u64()
            .is_some_and(|bytes| bytes > 100_000))
    })?;
    disk.fill()?;
    counted.send_samples(1400, 900)?;
    wait_until("the recording ends", || {
        Ok(scene.ask("GET", "/recordings/cut", "")?.1["state"] == "ended")
    })?;
    let (_, cut) = scene.ask("GET", "/recordings/cut", "")?;
    let error = cut["error"].as_str().unwrap_or_default().to_owned();
    ensure!(error.starts_with("no space left to write "), "{cut}");
    let kept = cut["report"]["messages"].as_u64().context("no count")?;
    ensure!(kept >= 100, "{cut}");
    readable(&disk.root.join("bags/cut"), kept)?;
    // The freed space is used again.
    disk.fill()?;
    disk.refuses("no space left")?;
    let failed = disk.writes("failed")?;
    let _second = Counted::start(&link, 2, "second")?;
    disk.wait_for_write("failed", failed)?;
    disk.state(&["/first"])?;
    for warning in ["cannot save state", "a recording ended early"] {
        let logged = || scene.log().matches(warning).count();
        // A thread of its own writes the log.
        wait_until(warning, || Ok(logged() > 0))?;
        ensure!(logged() == 1, "{warning}");
    }
    counted.check(&scene.agent)?;
    let written = disk.writes("written")?;
    disk.make_room()?;
    // The state is written although nothing changes.
    disk.wait_for_write("written", written)?;
    disk.state(&["/first", "/second"])?;
    disk.accepts(&mut counted, "roomy")?;
    outcome(
        "full disk during a recording, state writes, snapshots",
        &format!(
            "the recording ends (\"{error}\") and its bag has the {kept} messages it counts; further ones and \
             snapshots are refused and leave nothing; the state stays the old one, whole; all of it works again \
             with room; every message counted"
        ),
    )?;

    a_disk_that_is_read_only(&disk, &link, &mut counted)?;
    directories_that_are_gone(&disk, &link, &mut counted)?;
    directories_of_another_user(&disk, &link, &mut counted)?;
    counted.check(&scene.agent)?;
    let took = scene.end()?;
    outcome(
        "state and recordings that belong to another user",
        &format!("refused and counted until they belong to the agent; ended in {took:?}"),
    )
}

/// Remounts the disk read-only, and later writable again.
fn a_disk_that_is_read_only(disk: &Disk<'_, '_>, link: &Link, counted: &mut Counted) -> Result<()> {
    disk.remount("ro")?;
    disk.refuses("Read-only file system")?;
    let failed = disk.writes("failed")?;
    let _third = Counted::start(link, 3, "third")?;
    disk.wait_for_write("failed", failed)?;
    disk.remount("rw")?;
    let written = disk.writes("written")?;
    disk.wait_for_write("written", written)?;
    disk.state(&["/third"])?;
    disk.accepts(counted, "writable")?;
    outcome(
        "disk remounted read-only, and back",
        "refused and counted, then all works again",
    )
}

/// Removes the directories while the agent runs.
fn directories_that_are_gone(
    disk: &Disk<'_, '_>,
    link: &Link,
    counted: &mut Counted,
) -> Result<()> {
    fs::remove_dir_all(disk.root.join("state"))?;
    fs::remove_dir_all(disk.root.join("bags"))?;
    let failed = disk.writes("failed")?;
    let _fourth = Counted::start(link, 4, "fourth")?;
    disk.wait_for_write("failed", failed)?;
    // The directory for bags is created again.
    disk.accepts(counted, "again")?;
    fs::create_dir(disk.root.join("state"))?;
    let written = disk.writes("written")?;
    disk.wait_for_write("written", written)?;
    disk.state(&["/fourth"])?;
    outcome(
        "state and recordings removed while the agent runs",
        "state writes fail and are counted until the directory is there again; the directory for bags is created again",
    )
}

/// Gives the directories to another user for a while.
fn directories_of_another_user(
    disk: &Disk<'_, '_>,
    link: &Link,
    counted: &mut Counted,
) -> Result<()> {
    let belong_to = |user: u32| -> Result<()> {
        for directory in ["state", "bags"] {
            let directory = disk.root.join(directory);
            std::os::unix::fs::chown(&directory, Some(user), None)?;
            fs::set_permissions(&directory, fs::Permissions::from_mode(0o700))?;
        }
        Ok(())
    };
    belong_to(65534)?;
    disk.refuses("Permission denied")?;
    let failed = disk.writes("failed")?;
    let _fifth = Counted::start(link, 5, "fifth")?;
    disk.wait_for_write("failed", failed)?;
    belong_to(0)?;
    let written = disk.writes("written")?;
    disk.wait_for_write("written", written)?;
    disk.state(&["/fifth"])?;
    disk.accepts(counted, "own")
}

pub(super) fn writes(page: &Scrape, outcome: &'static str) -> f64 {
    page.sum("ros2probe_state_writes_total", &[("outcome", outcome)])
}

/// Checks that another reader reads this many messages in the bag, to its end.
pub(super) fn readable(bag: &Path, messages: u64) -> Result<()> {
    let mut found = 0;
    for entry in fs::read_dir(bag)? {
        let path = entry?.path();
        if path.extension().is_some_and(|it| it == "mcap") {
            let bytes = fs::read(&path)?;
            found += mcap::MessageStream::new(&bytes)?
                .collect::<Result<Vec<_>, _>>()?
                .len() as u64;
        }
    }
    ensure!(
        found == messages,
        "{}: {found} of {messages} messages",
        bag.display()
    );
    let text = fs::read_to_string(bag.join("metadata.yaml"))?;
    ros2probe_bag::metadata::Metadata::read(&text)?;
    Ok(())
}
