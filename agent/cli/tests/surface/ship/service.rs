//! The configuration and the status of the service.

use std::fs;
use std::process::Output;
use std::time::Duration;

use super::{Robot, SECRET};

#[test]
fn a_status_that_cannot_be_read_has_the_reason_and_the_remedy() {
    use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    let status = || robot.command(&["--status"]).output().unwrap();
    let fails = |output: &Output, text: &str| {
        let printed = String::from_utf8(output.stderr.clone()).unwrap();
        assert_eq!(output.status.code(), Some(1), "{printed}");
        assert_eq!(printed.lines().count(), 1, "{printed}");
        assert!(printed.contains(text), "{printed}");
    };
    fails(&status(), "no delivery has begun: ");
    robot.record("drive", 1000, 100);
    robot.delivers();

    // The build directory may not be readable for other users.
    let program = robot.path("rp");
    fs::copy(env!("CARGO_BIN_EXE_rp"), &program).unwrap();
    let directory = robot.path("state/ship");
    for (path, mode) in [
        (robot.directory.path(), 0o755),
        (&program, 0o755),
        (&directory, 0o000),
    ] {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    }
    let mut other = std::process::Command::new("setpriv");
    if fs::metadata("/proc/self").unwrap().uid() == 0 {
        other.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
    }
    other.arg("--inh-caps=-all").arg(&program);
    other.args(["ship", "--status", "--config"]);
    let denied = other.arg(robot.path("ros2probe.yaml")).output().unwrap();
    let remedy = "state/ship/status.json: use sudo, or join the group ros2probe";
    fails(&denied, remedy);

    fs::set_permissions(&directory, fs::Permissions::from_mode(0o750)).unwrap();
    fs::write(directory.join("status.json"), "").unwrap();
    fails(&status(), "status.json is damaged");
}

#[test]
fn an_idle_service_does_not_write_its_status_again() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    let running = robot.start();
    robot.wait_for("status", |status| status["waiting_bags"] == 0);
    let changed = || {
        let about = fs::metadata(robot.path("state/ship/status.json"));
        about.unwrap().modified().unwrap()
    };
    let before = changed();
    // The service scans its directory every 2 s.
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(changed(), before);
    robot.record("drive", 1000, 100);
    robot.wait_for("delivery", |status| status["delivered_bags"] == 1);
    running.end();
}

#[test]
fn mistakes_of_the_configuration_are_reported_at_the_start() {
    let robot = Robot::to("s3://bags", "");
    let fails = |code: i32, text: &str| {
        let output = robot.once();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(error.contains(text), "{error}");
    };
    robot.configure("  windows: ['22-6']\n", "");
    fails(78, "ship.windows[0]");
    fs::write(robot.path("ros2probe.yaml"), "ship: {url: 'ftp://a'}\n").unwrap();
    fails(78, "ship.url");
    fs::write(robot.path("ros2probe.yaml"), "watch: []\n").unwrap();
    fails(78, "no destination is configured");
    robot.configure("", "");
    robot.record("drive", 1000, 100);
    fs::write(robot.path("ship.env"), format!("AWS_SECRET={SECRET}\n")).unwrap();
    fails(1, "line 1 of");
    let first = robot.start();
    let process = first.0.as_ref().unwrap().id();
    robot.wait_for("start", |status| status["process_id"] == process);
    fails(1, "another rp ship works with");
    first.kill();
}
