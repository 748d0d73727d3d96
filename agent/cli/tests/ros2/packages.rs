//! The packages of `deploy/ros`, built on the distribution: `ros2 probe` and the launch file.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::repository;

use crate::host::RP;
use crate::installed::{self, in_environment};

const CAPTURE: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/tests/fixtures/rates/capture.pcap.gz"
);

/// Returns a line of the shell that runs in the workspace.
fn in_workspace(place: &Path, line: &str) -> String {
    in_environment(&format!(
        ". {}/install/setup.bash && {line}",
        place.display()
    ))
}

#[test]
#[ignore = "needs ROS 2 with ros2launch, ros2pkg: make test-ros2"]
fn ros2_probe_and_ros2_launch_run_rp() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let place = directory.path();
    let script = repository("agent/cli/tests/dist/ros/workspace.sh");
    let mut build = installed::shell("exec \"$0\" \"$@\"");
    let built = build.arg(script).arg(RP).arg(place).output()?;
    ensure!(built.status.success(), "{built:?}");

    let ros2 = |line: &str| -> Result<Output> {
        let mut bash = Command::new("bash");
        bash.arg("-c").arg(in_workspace(place, line));
        Ok(bash.output()?)
    };
    let direct = |arguments: &[&str]| -> Result<Output> {
        let mut rp = Command::new(RP);
        rp.args(arguments).env("ROS_DISTRO", installed::distro());
        Ok(rp.output()?)
    };
    for arguments in [
        &["topic", "hz", "/chatter", "--replay", CAPTURE][..],
        &["topic", "list", "--replay", CAPTURE],
        &["topic", "hz", "--help"],
        &["-h"],
        &["--nonsense"],
        &["ci", "--nonsense", "--", "-x"],
    ] {
        let line = format!("ros2 probe {}", arguments.join(" "));
        let (through, direct) = (ros2(&line)?, direct(arguments)?);
        ensure!(
            (through.status, &through.stdout) == (direct.status, &direct.stdout),
            "{line}: {}, not {}: {}",
            through.status,
            direct.status,
            String::from_utf8_lossy(&through.stderr)
        );
    }
    let completed = ros2(
        "COMP_LINE='ros2 probe do' COMP_POINT=13 _ARGCOMPLETE=1 _ARGCOMPLETE_SHELL=bash \
         ros2 8>&1 9>/dev/null >/dev/null",
    )?;
    let candidates = String::from_utf8(completed.stdout)?;
    ensure!(candidates.trim() == "doctor", "{candidates}");

    let network = Namespace::isolated()?;
    let line = format!(
        "exec ros2 launch --noninteractive ros2probe agent.launch.py replay:={CAPTURE} api:=127.0.0.1:17401"
    );
    let mut enter = network.inside();
    enter.extend([
        "env".to_owned(),
        format!("ROS_LOG_DIR={}", place.join("log").display()),
    ]);
    let line = in_workspace(place, &line);
    let mut launched = Process::start_with(&enter, "bash", ["-c", &line], Stdio::inherit())?;
    let inside = network.inside();
    let (program, words) = inside.split_first().context("no namespace")?;
    wait_until("the launched agent answers", || {
        let mut rp = Command::new(program);
        rp.args(words).args([RP, "topic", "list"]);
        let output = rp.args(["--host", "127.0.0.1:17401"]).output()?;
        Ok(String::from_utf8_lossy(&output.stdout).contains("/chatter\n"))
    })?;
    let mut sockets = Command::new(program);
    let sockets = sockets.args(words).args(["ss", "-Hua"]).output()?;
    ensure!(
        sockets.stdout.is_empty(),
        "a participant: {}",
        String::from_utf8_lossy(&sockets.stdout)
    );
    launched.signal("INT")?;
    let ended = launched.wait(Duration::from_secs(30))?;
    ensure!(ended.success(), "{ended}");
    Ok(())
}
