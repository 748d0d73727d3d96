//! `rp tf` beside `tf2_echo`, with static and moving transforms of a real node. Both print the same
//! text, to the last digit.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::fs;
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::{Host, Middleware};
use crate::installed;

const PATIENCE: Duration = Duration::from_secs(60);
/// Pairs of frames with static transforms between them: down, up, across, and at both poles.
const STATIC: [(&str, &str); 10] = [
    ("base_link", "lidar"),
    ("base_link", "camera"),
    ("base_link", "hand"),
    ("hand", "base_link"),
    ("camera", "hand"),
    ("base_link", "wheel"),
    ("wheel", "base_link"),
    ("arm", "up"),
    ("arm", "down"),
    ("marker", "map"),
];
/// Pairs of frames with moving transforms between them.
const MOVING: [(&str, &str); 4] = [
    ("odom", "base_link"),
    ("map", "base_link"),
    ("base_link", "map"),
    ("marker", "camera"),
];
/// Pairs of frames with moving transforms that have different stamps.
const APART: [(&str, &str); 3] = [
    ("map", "base_link"),
    ("base_link", "map"),
    ("marker", "camera"),
];
/// Number of poses of each pair of [`MOVING`] and [`APART`].
const STEPS: usize = 4;
/// The last row of a pose.
const END: &str = "  0.000  0.000  0.000  1.000\n";

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, tf2_ros: make test-ros2"]
fn with_fast_dds_transforms_print_as_in_tf2_echo() -> Result<()> {
    prints_as_tf2_echo(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp, tf2_ros: make test-ros2"]
fn with_cyclone_dds_transforms_print_as_in_tf2_echo() -> Result<()> {
    prints_as_tf2_echo(Middleware::Cyclone)
}

fn prints_as_tf2_echo(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let _agent = host.agent("")?;
    let mut broadcaster = host.python("frames.py", &[])?;
    broadcaster.wait_for("ready", PATIENCE)?;
    for (source, target) in STATIC {
        let _tf2_echo = tf2_echo(&host, source, target)?;
        both_print(&host, source, target, "At time 0.0")?;
    }
    let moving = MOVING.map(|pair| (pair, "next"));
    let apart = APART.map(|pair| (pair, "apart"));
    for ((source, target), stamps) in moving.into_iter().chain(apart) {
        let _tf2_echo = tf2_echo(&host, source, target)?;
        for _ in 0..STEPS {
            broadcaster.write_line(stamps)?;
            let stamp = broadcaster.line_with_end("", PATIENCE)?;
            both_print(&host, source, target, &stamp)?;
        }
    }
    Ok(())
}

/// Starts `tf2_echo`, which prints ten poses per second into a file.
fn tf2_echo(host: &Host<'_>, source: &str, target: &str) -> Result<Process> {
    let log = host.path("tf2_echo.log");
    fs::write(&log, "")?;
    let program = installed::prefix().join("lib/tf2_ros/tf2_echo");
    // Since 2025 the rate is an option.
    let line = format!(
        "rate=10; if {0} -h | grep -q -e '-r <rate>'; then rate='-r 10'; fi; exec {0} $2 $3 $rate > $1",
        program.display()
    );
    host.run(&line, &[&log, source, target], Stdio::null())
}

/// Compares the poses with this first line.
fn both_print(host: &Host<'_>, source: &str, target: &str, first: &str) -> Result<()> {
    let pair = format!("{source} {target}, {first}");
    let mut expected = String::new();
    wait_until("tf2_echo prints the pose", || {
        let text = fs::read_to_string(host.file("tf2_echo.log"))?;
        let end = text.rfind(END).map_or(0, |at| at + END.len());
        let last = text[..end].rfind("At time");
        // Since 2025 the order of the quaternion's numbers is named.
        expected = last.map_or("", |at| &text[at..end]).replace(" (xyzw)", "");
        Ok(expected.lines().next() == Some(first))
    })
    .with_context(|| format!("{pair}: {expected}"))?;
    let mut printed = String::new();
    wait_until("rp prints the pose", || {
        let pose = host.rp(&["tf", source, target, "--once"]);
        printed = pose.unwrap_or_else(|error| error.to_string());
        Ok(printed.lines().next() == Some(first))
    })
    .with_context(|| format!("{pair}: {printed}"))?;
    ensure!(
        printed == expected,
        "{pair}: tf2_echo printed\n{expected}rp printed\n{printed}"
    );
    Ok(())
}
