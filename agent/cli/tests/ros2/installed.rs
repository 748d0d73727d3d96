//! An installed ROS 2 distribution, the oracle of these tests (`make test-ros2`).

use std::path::PathBuf;
use std::process::Command;
use std::sync::LazyLock;

use ros2probe::ros2::Dialect;

/// Returns the directory of the distribution: `ROS2PROBE_ROS2`, or the last one below `/opt/ros`.
/// Panics if it is missing, because a test that needs it must not pass without it.
pub fn prefix() -> PathBuf {
    let named = std::env::var_os("ROS2PROBE_ROS2").filter(|named| !named.is_empty());
    let prefix = named.map(PathBuf::from).or_else(last_installed);
    let prefix = prefix.expect("no ROS 2 below /opt/ros: install it, or set ROS2PROBE_ROS2");
    assert!(
        prefix.join("setup.bash").exists(),
        "no ROS 2 in {}: it has no setup.bash",
        prefix.display()
    );
    prefix
}

fn last_installed() -> Option<PathBuf> {
    let entries = std::fs::read_dir("/opt/ros").ok()?;
    let prefixes = entries.filter_map(|entry| Some(entry.ok()?.path()));
    prefixes
        .filter(|prefix: &PathBuf| prefix.join("setup.bash").exists())
        .max()
}

/// Returns the name of the distribution, for example `humble`.
pub fn distro() -> &'static str {
    static DISTRO: LazyLock<String> = LazyLock::new(|| {
        let output = shell("printf %s \"$ROS_DISTRO\"").output().unwrap();
        let name = String::from_utf8(output.stdout).unwrap();
        assert!(!name.is_empty(), "setup.bash does not set ROS_DISTRO");
        name
    });
    &DISTRO
}

/// Returns the dialect in which this distribution's commands print.
pub fn dialect() -> Dialect {
    Dialect::of_distro(distro()).unwrap_or_else(|| panic!("{} is no known distro", distro()))
}

/// Returns the Python that runs this distribution's command line, since others may lack its
/// modules.
pub fn python() -> String {
    let program = prefix().join("bin/ros2");
    let script = std::fs::read_to_string(&program).unwrap();
    let first = script.lines().next().unwrap_or_default();
    let interpreter = first.strip_prefix("#!").map(str::trim);
    interpreter
        .expect("bin/ros2 names its interpreter")
        .to_owned()
}

/// Returns a shell line after the one that sets ROS's environment.
pub fn in_environment(line: &str) -> String {
    format!(". {}/setup.bash && {line}", prefix().display())
}

/// Returns a shell that runs `script` with ROS's environment; `$0` and following are the arguments.
pub fn shell(script: &str) -> Command {
    let mut command = Command::new("bash");
    command.arg("-c").arg(in_environment(script));
    command
}
