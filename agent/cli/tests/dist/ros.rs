//! The packages for ROS: colcon builds them from the archive of a release, and the extension of
//! `ros2` executes `rp`. `ros2::packages` runs them with an installed ROS 2.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::symlink;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::repository;
use serde_yaml::Value;

use crate::package::installation::{all, succeed};

const RP: &str = env!("CARGO_BIN_EXE_rp");
const VERSION: &str = env!("CARGO_PKG_VERSION");
const CAPTURE: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/tests/fixtures/rates/capture.pcap.gz"
);
/// The signal in masks of `/proc/PID/status`.
const SIGXFSZ: u64 = 1 << 24;
/// Directories of Python and of bash, without `rp`.
const SYSTEM: &str = "/usr/bin:/bin";
/// What `ros2 probe` does with its arguments.
const EXECUTE: &str =
    "import sys; from ros2probe_cli.program import execute; sys.exit(execute(sys.argv[1:]))";
/// Prints the candidates for the last argument.
const COMPLETE: &str = "\
import sys
from ros2probe_cli.completion import candidates
for candidate in candidates(sys.argv[1:-1], sys.argv[-1]): print(candidate)";

/// Returns a command that runs this code with the extension's modules and these arguments. It finds
/// the tests' `rp` where the package `ros2probe` of the prefix has it.
fn python(prefix: &Path, code: &str, arguments: &[&str]) -> Command {
    let mut python = Command::new("/usr/bin/python3");
    python.args(["-B", "-c", code]).args(arguments);
    python.env("PYTHONPATH", repository("deploy/ros/ros2probe_cli"));
    python
        .env("PATH", SYSTEM)
        .env("AMENT_PREFIX_PATH", prefix)
        .env("ROS_DISTRO", "jazzy");
    python
}

/// Makes a prefix of ROS whose package `ros2probe` has the tests' `rp`.
fn prefix() -> Result<tempfile::TempDir> {
    let prefix = tempfile::tempdir()?;
    let programs = prefix.path().join("lib/ros2probe");
    fs::create_dir_all(&programs)?;
    symlink(RP, programs.join("rp"))?;
    Ok(prefix)
}

#[test]
fn colcon_builds_and_installs_both_packages() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let place = directory.path();
    let script = repository("agent/cli/tests/dist/ros/workspace.sh");
    succeed(Command::new(&script).arg(RP).arg(place))
        .context("`.ci/prerequisites.sh test` installs colcon and ament_cmake")?;

    // In the environment of the workspace, from the installed files only.
    let in_workspace = |line: &str| -> Result<String> {
        let line = format!(". {}/install/setup.bash && {line}", place.display());
        let mut bash = Command::new("bash");
        bash.args(["-c", &line]).env("PATH", SYSTEM);
        bash.env_remove("PYTHONPATH")
            .env_remove("AMENT_PREFIX_PATH");
        succeed(bash.current_dir("/"))
    };
    let installed = place.join("install/ros2probe");
    let version = succeed(Command::new(installed.join("lib/ros2probe/rp")).arg("--version"))?;
    ensure!(version == format!("rp {VERSION}\n"), "{version}");
    for file in ["config/ros2probe.yaml", "licenses/libraries.txt"] {
        let path = installed.join("share/ros2probe").join(file);
        ensure!(fs::metadata(&path)?.len() > 1000, "{}", path.display());
    }
    let mut check = Command::new(RP);
    succeed(
        check
            .arg("check-config")
            .arg(installed.join("share/ros2probe/config/ros2probe.yaml")),
    )?;
    let python = repository("target/tools/ros/bin/python")
        .display()
        .to_string();
    let through = in_workspace(&format!("{python} -B -c '{EXECUTE}' --version"))?;
    ensure!(through == version, "{through}");
    let points = in_workspace(&format!(
        "{python} -B -c 'from importlib.metadata import distribution as d; \
         print(*d(\"ros2probe_cli\").entry_points, d(\"ros2probe_cli\").version)'"
    ))?;
    ensure!(
        points.contains("value='ros2probe_cli.command:ProbeCommand', group='ros2cli.command'")
            && points.contains("name='probe'")
            && points.trim().ends_with(VERSION),
        "{points}"
    );
    for package in ["ros2probe", "ros2probe_cli"] {
        let marker = format!("{package}/share/ament_index/resource_index/packages/{package}");
        ensure!(place.join("install").join(marker).exists(), "{package}");
    }

    refuses_another_wheel(place)
}

/// A wheel that the archive does not name by its checksum is not installed.
fn refuses_another_wheel(place: &Path) -> Result<()> {
    let wheel = fs::read_dir(place)?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .find(|path| path.extension().is_some_and(|ending| ending == "whl"))
        .context("no wheel")?;
    let mut bytes = fs::read(&wheel)?;
    *bytes.last_mut().context("empty")? ^= 1;
    fs::write(&wheel, bytes)?;
    let mut cmake = Command::new("cmake");
    cmake
        .arg("-S")
        .arg(place.join(format!("ros2probe-{VERSION}/ros2probe")));
    cmake.arg("-B").arg(place.join("again"));
    cmake.arg(format!("-DROS2PROBE_DOWNLOADS=file://{}", place.display()));
    cmake.arg("-DPython3_EXECUTABLE=/usr/bin/python3");
    let output = cmake.output()?;
    let text = all(&output);
    ensure!(
        !output.status.success() && text.contains("HASH mismatch"),
        "{text}"
    );
    Ok(())
}

#[test]
fn the_packages_are_valid_and_have_the_version_of_the_agent() -> Result<()> {
    const CHECK: &str = "\
import sys
from catkin_pkg.package import parse_package
for path in sys.argv[1:]:
    warnings = []
    package = parse_package(path, warnings=warnings)
    package.validate(warnings=warnings)
    addresses = [url.url for url in package.urls]
    print(package.name, package.version, package.get_build_type(), *addresses, *warnings)";
    let mut check = Command::new(repository("target/tools/ros/bin/python"));
    check.args(["-c", CHECK]);
    for name in ["ros2probe", "ros2probe_cli"] {
        check.arg(repository("deploy/ros").join(name));
    }
    let found = succeed(&mut check)?;
    let address = env!("CARGO_PKG_REPOSITORY");
    let expected = format!(
        "ros2probe {VERSION} ament_cmake {address}\nros2probe_cli {VERSION} ament_python {address}\n"
    );
    ensure!(found == expected, "{found}");
    let recipe = fs::read_to_string(repository("deploy/ros/ros2probe/CMakeLists.txt"))?;
    ensure!(recipe.contains(&format!("\"{address}/releases/download/")));
    Ok(())
}

#[test]
fn python_files_that_import_ros_compile() -> Result<()> {
    const COMPILE: &str = "import sys; [compile(open(f).read(), f, 'exec') for f in sys.argv[1:]]";
    let files = [
        "ros2probe/launch/agent.launch.py",
        "ros2probe_cli/ros2probe_cli/command.py",
        "ros2probe_cli/setup.py",
    ]
    .map(|file| repository("deploy/ros").join(file));
    succeed(
        Command::new("/usr/bin/python3")
            .args(["-c", COMPILE])
            .args(&files),
    )?;
    // The entry point names a class of the file.
    let command = fs::read_to_string(&files[1])?;
    ensure!(command.contains("class ProbeCommand(CommandExtension):"));
    Ok(())
}

#[test]
fn keys_of_rosdep_name_packages_for_known_systems() -> Result<()> {
    let keys: Value =
        serde_yaml::from_str(&fs::read_to_string(repository("deploy/ros/rosdep.yaml"))?)?;
    let keys = keys.as_mapping().context("no keys")?;
    ensure!(keys.len() == 2, "{keys:?}");
    for (key, systems) in keys {
        for (system, rule) in systems.as_mapping().context("no systems")? {
            let known = ["debian", "fedora", "ubuntu"].contains(&system.as_str().unwrap_or(""));
            let is_pip = key.as_str().is_some_and(|key| key.ends_with("-pip"));
            let packages = match is_pip {
                true => &rule["pip"]["packages"],
                false => rule,
            };
            ensure!(known && packages[0] == "ros2probe", "{key:?}: {system:?}");
        }
    }
    Ok(())
}

#[test]
fn rp_gets_exactly_the_arguments_and_its_exit_code_is_kept() -> Result<()> {
    let prefix = prefix()?;
    for arguments in [
        &["topic", "list", "--replay", CAPTURE][..],
        &["--help"],
        &["-h"],
        &["topic", "hz", "--help"],
        &["--nonsense", "--", "-x"],
        &["topic", "list", ""],
        &["ci", "--api", "off"],
        &["bag"],
    ] {
        let direct = Command::new(RP).args(arguments).output()?;
        let through = python(prefix.path(), EXECUTE, arguments).output()?;
        ensure!(
            (direct.status, direct.stdout, direct.stderr)
                == (
                    through.status,
                    through.stdout.clone(),
                    through.stderr.clone()
                ),
            "{arguments:?}: {}",
            all(&through)
        );
    }
    Ok(())
}

#[test]
fn rp_replaces_python_and_receives_signals() -> Result<()> {
    let prefix = prefix()?;
    let run = [
        "run",
        "--replay",
        CAPTURE,
        "--metrics",
        "off",
        "--api",
        "off",
        "--foxglove",
        "off",
    ];
    for (signal, expected) in [("-INT", None), ("-KILL", Some(9))] {
        let mut command = python(prefix.path(), EXECUTE, &run);
        let mut process = command.stderr(Stdio::piped()).spawn()?;
        let id = process.id().to_string();
        let log = BufReader::new(process.stderr.take().context("no log")?);
        let ready = log
            .lines()
            .find(|line| !line.as_ref().is_ok_and(|line| !line.contains("ready")));
        ready.context("it ended early")??;
        let status = fs::read_to_string(format!("/proc/{id}/status"))?;
        ensure!(status.starts_with("Name:\trp\n"), "{status}");
        let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
        let ignored = u64::from_str_radix(ignored.context("no mask")?.trim(), 16)?;
        ensure!(ignored & SIGXFSZ == 0, "Python's setting remains");
        succeed(Command::new("kill").args([signal, &id]))?;
        let ended = process.wait()?;
        ensure!(
            ended.signal() == expected && (expected.is_some() || ended.success()),
            "{signal}: {ended}"
        );
    }
    Ok(())
}

#[test]
fn path_takes_precedence_over_the_packaged_rp() -> Result<()> {
    const FIND: &str = "from ros2probe_cli.program import find; print(find())";
    let prefix = prefix()?;
    let found = succeed(&mut python(prefix.path(), FIND, &[]))?;
    let packaged = prefix.path().join("lib/ros2probe/rp");
    ensure!(Path::new(found.trim()) == packaged, "{found}");
    let first = PathBuf::from(RP);
    let directory = first.parent().context("no directory")?;
    let mut python_with_path = python(prefix.path(), FIND, &[]);
    let path = format!("{SYSTEM}:{}", directory.display());
    let found = succeed(python_with_path.env("PATH", path))?;
    ensure!(Path::new(found.trim()) == first, "{found}");
    Ok(())
}

#[test]
fn a_missing_rp_is_reported_in_one_line() -> Result<()> {
    let missing = python(Path::new("/nowhere"), EXECUTE, &["top"]).output()?;
    let text = String::from_utf8(missing.stderr)?;
    ensure!(missing.status.code() == Some(1) && text.lines().count() == 1);
    ensure!(
        text.trim_end()
            .ends_with("sudo apt install ros-jazzy-ros2probe"),
        "{text}"
    );
    let completed = succeed(&mut python(Path::new("/nowhere"), COMPLETE, &["t"]))?;
    ensure!(completed.trim().is_empty(), "{completed}");
    Ok(())
}

#[test]
fn commands_options_and_names_complete() -> Result<()> {
    let prefix = prefix()?;
    let candidates = |words: &[&str]| -> Result<Vec<String>> {
        let text = succeed(&mut python(prefix.path(), COMPLETE, words))?;
        Ok(text.lines().map(str::to_owned).collect())
    };
    ensure!(candidates(&["do"])? == ["doctor"]);
    ensure!(candidates(&["topic", "h"])? == ["hz", "help"]);
    ensure!(candidates(&["topic", "hz", "--wi"])? == ["--window"]);
    ensure!(candidates(&["completions", "z"])? == ["zsh"]);
    ensure!(candidates(&["topic", "hz", "/nothing/of/it"])?.is_empty());

    // Names of topics come from the agent of this host.
    let network = Namespace::isolated()?;
    let _agent = Process::start_with(
        &network.inside(),
        RP,
        ["run", "--replay", CAPTURE, "--speed", "max"],
        Stdio::null(),
    )?;
    let mut names = Vec::new();
    wait_until("the names of topics", || {
        let command = python(prefix.path(), COMPLETE, &["topic", "hz", "/ro"]);
        let inside = network.inside();
        let (enter, rest) = inside.split_first().context("no namespace")?;
        let mut entered = Command::new(enter);
        entered.args(rest).arg(command.get_program());
        entered.args(command.get_args());
        for (name, value) in command.get_envs() {
            if let Some(value) = value {
                entered.env(name, value);
            }
        }
        names = succeed(&mut entered)?.lines().map(str::to_owned).collect();
        Ok(!names.is_empty())
    })?;
    ensure!(
        names.iter().any(|name| name == "/rosout")
            && names.iter().all(|name| name.starts_with("/ro")),
        "{names:?}"
    );
    Ok(())
}
