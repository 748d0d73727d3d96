//! An installed ROS 2 Humble, which the tests `humble_*` hold `rp` against (`make test-ros2`).
#![allow(dead_code, reason = "each test file uses its own part")]

use std::path::PathBuf;
use std::process::Command;

/// Returns the directory of ROS 2 Humble: `ROS2PROBE_ROS2`, or the default. Panics if it is
/// missing: a test that needs it must not pass without it.
pub fn prefix() -> PathBuf {
    let named = std::env::var_os("ROS2PROBE_ROS2").filter(|named| !named.is_empty());
    let prefix = named.map_or_else(|| PathBuf::from("/opt/ros/humble"), PathBuf::from);
    assert!(
        prefix.join("setup.bash").exists(),
        "no ROS 2 Humble in {}: install it, or name its directory in ROS2PROBE_ROS2",
        prefix.display()
    );
    prefix
}

/// A shell that runs `script` with ROS's environment; `$0` and following are the arguments.
pub fn shell(script: &str) -> Command {
    let prefix = prefix();
    let sourced = ["env.sh", "setup.bash"].map(|name| prefix.join(name));
    let sourced = sourced.iter().find(|file| file.exists()).unwrap();
    let mut command = Command::new("bash");
    command
        .arg("-c")
        .arg(format!("source {} && {script}", sourced.display()));
    command
}
