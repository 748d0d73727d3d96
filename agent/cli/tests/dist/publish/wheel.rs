//! The Python wheels install `rp` and leave nothing when they are removed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository as sources;
use serde_json::Value;

use super::feed::upgrade;
use super::{VERSION, measures_on_arm, on_arm, package, packaging, published, succeed, tool};
use crate::package::installation::{all, changed, installable};

/// Returns the name of the wheel for a machine.
pub(super) fn name(machine: &str) -> String {
    let platforms = ["manylinux_2_17", "manylinux2014", "musllinux_1_2"];
    let platforms = platforms.map(|platform| format!("{platform}_{machine}"));
    format!("ros2probe-{VERSION}-py3-none-{}.whl", platforms.join("."))
}

/// Makes the wheel of a package.
fn build_wheel(package: &Path, directory: &Path) -> Result<PathBuf> {
    let mut script = packaging("wheel.py")?;
    let path = succeed(script.arg(package).arg(directory))?;
    Ok(PathBuf::from(path.trim()))
}

/// Returns a fresh Python environment.
fn environment(directory: &Path) -> Result<PathBuf> {
    let place = directory.join("environment");
    succeed(Command::new("python3").args(["-m", "venv"]).arg(&place))?;
    Ok(place)
}

fn pip(environment: &Path) -> Command {
    let mut pip = Command::new(environment.join("bin/pip"));
    pip.env("PIP_DISABLE_PIP_VERSION_CHECK", "1");
    pip
}

/// Returns `pip install` with the wheels of this directory as its only source.
fn install(environment: &Path, wheels: &Path) -> Command {
    let mut pip = pip(environment);
    pip.args(["install", "--no-index", "--find-links"])
        .arg(wheels);
    pip
}

/// Returns the paths below a directory, except compiled Python code.
fn paths(directory: &Path) -> Result<Vec<String>> {
    let mut find = Command::new("find");
    find.arg(directory).args(["-name", "__pycache__", "-prune"]);
    let mut paths: Vec<String> = succeed(find.args(["-o", "-print"]))?
        .lines()
        .map(str::to_owned)
        .collect();
    paths.sort();
    Ok(paths)
}

#[test]
fn a_wheel_of_a_package_installs_rp_and_leaves_nothing() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let package = installable(directory.path())?;
    let wheel = build_wheel(&package, directory.path())?;
    let again = directory.path().join("again");
    fs::create_dir(&again)?;
    ensure!(
        fs::read(&wheel)? == fs::read(build_wheel(&package, &again)?)?,
        "the wheels differ"
    );
    installs_and_leaves_nothing(directory.path())
}

/// Installs the wheel in this directory as users do.
fn installs_and_leaves_nothing(wheels: &Path) -> Result<()> {
    let directory = tempfile::tempdir()?;
    let environment = environment(directory.path())?;
    let before = paths(&environment)?;
    succeed(install(&environment, wheels).arg("ros2probe"))?;
    let version = succeed(Command::new(environment.join("bin/rp")).arg("--version"))?;
    ensure!(version == format!("rp {VERSION}\n"), "{version}");
    let files = succeed(pip(&environment).args(["show", "--files", "ros2probe"]))?;
    ensure!(files.contains("../../../bin/rp"), "{files}");
    let python = files.lines().filter(|file| file.ends_with(".py")).count();
    ensure!(python == 0, "{files}");
    let printed = upgrade(&environment.join("bin/rp"), wheels)?;
    ensure!(
        printed.contains("installed by a Python wheel in "),
        "{printed}"
    );
    ensure!(
        printed.contains("bin/python3 -m pip install /"),
        "{printed}"
    );
    succeed(pip(&environment).args(["uninstall", "--yes", "ros2probe"]))?;
    ensure!(paths(&environment)? == before, "pip left files behind");
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn pip_installs_the_published_wheel_of_this_machine() -> Result<()> {
    installs_and_leaves_nothing(&published()?)
}

#[test]
#[ignore = "looks at a release: make release"]
fn published_wheels_are_those_of_the_packages_and_follow_the_specification() -> Result<()> {
    let directory = tempfile::tempdir()?;
    for (machine, architecture) in [("x86_64", "amd64"), ("aarch64", "arm64")] {
        let wheel = published()?.join(name(machine));
        let again = build_wheel(&package(architecture)?, directory.path())?;
        ensure!(fs::read(&wheel)? == fs::read(again)?, "{machine}");
        let mut twine = Command::new(tool("wheels/bin/twine"));
        let checked = succeed(twine.args(["check", "--strict"]).arg(&wheel))?;
        ensure!(checked.contains("PASSED"), "{checked}");
        // W007 and W008 report that no Python module is in the wheel.
        let mut check = Command::new(tool("wheels/bin/check-wheel-contents"));
        succeed(check.args(["--ignore", "W007,W008"]).arg(&wheel))?;
    }
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn pip_of_an_arm_host_chooses_the_other_wheel() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let environment = environment(directory.path())?;
    for platform in ["manylinux2014_aarch64", "musllinux_1_2_aarch64"] {
        let place = directory.path().join(platform);
        let mut install = install(&environment, &published()?);
        install.args(["--platform", platform, "--only-binary=:all:", "--target"]);
        succeed(install.arg(&place).arg("ros2probe"))?;
        let binary = place.join("bin/rp");
        let released = published()?.join(format!("rp-{VERSION}-aarch64"));
        let bytes = fs::read(&binary).context(platform)?;
        ensure!(bytes == fs::read(released)?, "{platform}");
        let version = on_arm(&binary, &["--version"])?;
        ensure!(
            version.stdout == format!("rp {VERSION}\n").as_bytes(),
            "{version:?}"
        );
        measures_on_arm(&binary)?;
    }
    Ok(())
}

/// A program that manages the environments of tools, and commands of a shell.
struct Manager {
    name: &'static str,
    /// Installs the wheel `$WHEEL`.
    install: &'static str,
    rp: &'static str,
    /// Prints the version of ros2probe.
    list: &'static str,
    /// Version that it prints after the upgrade.
    upgraded: &'static str,
    uninstall: &'static str,
}

const MANAGERS: [Manager; 4] = [
    Manager {
        name: "uv tool",
        install: "uv tool install $WHEEL",
        rp: "$HOME/.local/bin/rp",
        list: "uv tool list",
        upgraded: "ros2probe v99.0.0",
        uninstall: "uv tool uninstall ros2probe",
    },
    Manager {
        name: "pipx",
        install: "pipx install $WHEEL",
        rp: "$HOME/.local/bin/rp",
        list: "pipx list --short",
        upgraded: "ros2probe 99.0.0",
        uninstall: "pipx uninstall ros2probe",
    },
    Manager {
        name: "uv",
        install: "uv venv $HOME/own && uv pip install --python $HOME/own/bin/python3 $WHEEL",
        rp: "$HOME/own/bin/rp",
        list: "uv pip list --python $HOME/own/bin/python3 --format freeze",
        upgraded: "ros2probe==99.0.0",
        uninstall: "rm -r $HOME/own",
    },
    Manager {
        name: "uvx",
        install: "uvx --from $WHEEL rp --version",
        rp: "uvx --from $WHEEL rp",
        list: "true",
        upgraded: "",
        uninstall: "true",
    },
];

#[test]
#[ignore = "looks at a release: make release"]
fn the_printed_command_upgrades_what_uv_and_pipx_have_installed() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let debian = match std::env::consts::ARCH {
        "aarch64" => "arm64",
        _ => "amd64",
    };
    let newer = changed(&package(debian)?, directory.path())?;
    let files = directory.path().join("files");
    fs::create_dir(&files)?;
    build_wheel(&newer, &files)?;
    let mut script = packaging("feed.py")?;
    let feed = succeed(script.args(["99.0.0", "0123456789abcdef"]).arg(&files))?;
    fs::write(files.join("release.json"), feed)?;
    for manager in MANAGERS {
        let home = directory.path().join(manager.name.replace(' ', "-"));
        fs::create_dir(&home)?;
        let run = |line: &str| -> Result<Output> {
            let path = std::env::var("PATH")?;
            let tools = tool("wheels/bin").display().to_string();
            let wheel = published()?.join(name(std::env::consts::ARCH));
            let mut shell = Command::new("sh");
            shell.args(["-c", line]).env("HOME", &home);
            shell.env("PATH", format!("{tools}:{path}"));
            shell.env("WHEEL", wheel).env("UV_OFFLINE", "1");
            for variable in [
                "XDG_DATA_HOME",
                "XDG_CACHE_HOME",
                "XDG_BIN_HOME",
                "PIPX_HOME",
            ] {
                shell.env_remove(variable);
            }
            shell.output().with_context(|| line.to_owned())
        };
        let passes = |line: &str| -> Result<String> {
            let output = run(line)?;
            ensure!(output.status.success(), "{line}: {}", all(&output));
            Ok(String::from_utf8(output.stdout)?)
        };
        passes(manager.install)?;
        let check = format!(
            "{} upgrade --check --json --feed {}/release.json",
            manager.rp,
            files.display()
        );
        let output = run(&check)?;
        ensure!(output.status.code() == Some(100), "{}", all(&output));
        let found: Value = serde_json::from_slice(&output.stdout)?;
        let installer = &found["installation"]["installer"];
        ensure!(*installer == manager.name.replace(' ', "_"), "{found}");
        passes(found["commands"][0].as_str().context("no command")?)?;
        let listed = passes(manager.list)?;
        ensure!(
            listed.contains(manager.upgraded),
            "{}: {listed}",
            manager.name
        );
        passes(manager.uninstall)?;
        // Caches and empty files of locks are of the managers.
        let left = passes(
            "find $HOME -name .cache -prune -o -size +0 -name '*ros2probe*' -print -o -name rp -print",
        )?;
        ensure!(left.is_empty(), "{left}");
    }
    Ok(())
}

#[test]
fn links_of_the_readme_are_absolute_in_a_wheel() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let wheel = build_wheel(&installable(directory.path())?, directory.path())?;
    let path = format!("ros2probe-{VERSION}.dist-info/METADATA");
    let metadata = succeed(Command::new("unzip").arg("-p").arg(&wheel).arg(path))?;
    let (_, readme) = metadata.split_once("\n\n").context("no description")?;
    let links: Vec<&str> = readme.split("](").skip(1).collect();
    ensure!(links.len() > 10, "{} links", links.len());
    for link in links {
        ensure!(link.starts_with("http"), "{link:.60}");
    }
    let original = fs::read_to_string(sources("README.md"))?;
    ensure!(readme.lines().count() == original.lines().count());
    Ok(())
}
