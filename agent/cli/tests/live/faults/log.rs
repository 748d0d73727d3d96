//! A log without a reader.

use std::fs::File;
use std::io::{self, Read as _};
use std::process::Command;

use anyhow::{Result, ensure};

use super::{Counted, FaultBench};
use ros2probe_testing::harness::agent::ON_THE_WIRE;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::soak::outcome;

#[test]
fn a_log_without_a_reader_delays_no_thread() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let right = format!("watch: [/**]\n{ON_THE_WIRE}");
    let (mut reader, writer) = io::pipe()?;
    let scene =
        FaultBench::start_until_output(&link.robot, &directory, &right, &[], writer.into())?;
    let mut counted = Counted::start(&link, 1, "talker")?;
    counted.send_samples(320, 100)?;

    // A loop that reloads a wrong configuration: each reload logs many lines.
    let mistakes: String = (0..200).map(|key| format!("mistake_{key}: 1\n")).collect();
    let file = directory.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("{right}{mistakes}"))?;
    let lost = "ros2probe_log_lines_lost_total";
    for _ in 0..20 {
        scene.agent.process.signal("HUP")?;
        counted.send_samples(320, 20)?;
    }
    let page = scene
        .agent
        .scrape_until("lines lost", |page| page.sum(lost, &[]) > 0.0)?;
    let missed = page.sum(lost, &[]);
    let state = "ros2probe_config_last_reload_successful";
    ensure!(page.sum(state, &[]) == 0.0, "the mistakes were not seen");
    counted.send_samples(320, 100)?;
    counted.check(&scene.agent)?;

    std::fs::write(&file, &right)?;
    let mut piece = vec![0; 1 << 16];
    let mut text = String::new();
    // The pipe is read again: the log reports lost lines where they are missing.
    while !text.contains(" lines of the log were lost here\n") {
        scene.agent.process.signal("HUP")?;
        scene
            .agent
            .scrape_until("reloaded", |page| page.sum(state, &[]) == 1.0)?;
        let count = reader.read(&mut piece)?;
        text.push_str(&String::from_utf8_lossy(&piece[..count]));
    }
    let took = scene.end()?;
    outcome(
        "log without a reader (stderr is a full pipe), 20 reloads of 200 mistakes",
        &format!(
            "every message counted, {missed} lines lost and counted, reported in the log once it was read again; \
             ended in {took:?}"
        ),
    )
}

#[test]
fn a_log_that_cannot_be_written_changes_no_answer_and_no_exit_code() -> Result<()> {
    let capture = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../wire/tests/data/cyclonedds-samehost-any.pcap.gz"
    );
    let run = |arguments: &[&str], errors: Result<File>| -> Result<(Option<i32>, usize)> {
        let output = Command::new(env!("CARGO_BIN_EXE_rp"))
            .arg("run")
            .args(arguments)
            .stderr(errors?)
            .output()?;
        Ok((output.status.code(), output.stdout.len()))
    };
    let full = || Ok(File::options().write(true).open("/dev/full")?);
    let closed = || {
        let (reader, writer) = io::pipe()?;
        drop(reader);
        Ok(File::from(std::os::fd::OwnedFd::from(writer)))
    };
    let report = ["--replay", capture, "--report"];
    for errors in [full(), closed()] {
        let (code, length) = run(&report, errors)?;
        ensure!(code == Some(0) && length > 1000, "{code:?} {length}");
    }
    for errors in [full(), closed()] {
        let (code, _) = run(&["--config", "/nonexistent"], errors)?;
        ensure!(code == Some(78), "{code:?}");
    }
    outcome(
        "stderr on a full disk (ENOSPC) or closed (EPIPE)",
        "same answers and exit codes",
    )
}
