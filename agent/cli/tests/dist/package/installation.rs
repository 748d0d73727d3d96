//! Packages to test: the given ones, or one made of the tests' own binary.

pub(crate) mod archive;
pub(crate) mod debian;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context as _, Result, ensure};

/// Returns the packages of the directory that `ROS2PROBE_PACKAGES` names.
pub(crate) fn given() -> Result<Vec<PathBuf>> {
    let Some(directory) = std::env::var_os("ROS2PROBE_PACKAGES") else {
        return Ok(Vec::new());
    };
    let mut packages = Vec::new();
    for entry in Path::new(&directory)
        .read_dir()
        .context("ROS2PROBE_PACKAGES")?
    {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "deb") {
            packages.push(path);
        }
    }
    ensure!(
        !packages.is_empty(),
        "no package in {}",
        Path::new(&directory).display()
    );
    packages.sort();
    Ok(packages)
}

/// Returns the given package that this machine can install, or one made here, in `directory`.
pub(crate) fn installable(directory: &Path) -> Result<PathBuf> {
    let ending = format!("_{}.deb", architecture());
    let is_own = |path: &PathBuf| path.to_string_lossy().ends_with(&ending);
    let Some(package) = given()?.into_iter().find(is_own) else {
        return built(directory, &["--compress-type=gz", "--fast"]);
    };
    let copy = directory.join(package.file_name().context("no name")?);
    std::fs::copy(&package, &copy)?;
    Ok(copy)
}

/// Makes a package of the tests' own binary without its symbols, with `packaging/build.sh`.
pub(crate) fn built(directory: &Path, options: &[&str]) -> Result<PathBuf> {
    std::fs::create_dir_all(directory)?;
    let binary = directory.join("rp");
    let mut strip = Command::new("strip");
    succeed(strip.arg("-o").arg(&binary).arg(env!("CARGO_BIN_EXE_rp")))?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../packaging/build.sh");
    let mut build = Command::new(script);
    build
        .arg(architecture())
        .arg(&binary)
        .arg(directory)
        .args(options);
    let printed = succeed(&mut build)?;
    std::fs::remove_file(&binary)?;
    Ok(PathBuf::from(printed.trim()))
}

/// Returns the same package with a higher version and another default configuration.
pub(crate) fn changed(package: &Path, directory: &Path) -> Result<PathBuf> {
    let (parts, package_of_them) = (directory.join("parts"), directory.join("changed.deb"));
    succeed(
        Command::new("dpkg-deb")
            .arg("--raw-extract")
            .arg(package)
            .arg(&parts),
    )?;
    let control = parts.join("DEBIAN/control");
    let text = std::fs::read_to_string(&control)?;
    let version = format!("Version: {}\n", env!("CARGO_PKG_VERSION"));
    ensure!(text.contains(&version), "{text}");
    std::fs::write(&control, text.replace(&version, "Version: 99.0.0\n"))?;
    let configuration = parts.join("etc/ros2probe/ros2probe.yaml");
    let text = std::fs::read_to_string(&configuration)?;
    std::fs::write(&configuration, format!("# changed\n{text}"))?;
    let mut pack = Command::new("dpkg-deb");
    pack.args(["--root-owner-group", "-Zgzip", "-z1", "--build"]);
    succeed(pack.arg(&parts).arg(&package_of_them))?;
    std::fs::remove_dir_all(&parts)?;
    Ok(package_of_them)
}

/// Returns Debian's name of this machine's architecture.
fn architecture() -> &'static str {
    match std::env::consts::ARCH {
        "aarch64" => "arm64",
        _ => "amd64",
    }
}

/// Runs a command that must succeed, and returns its output.
pub(crate) fn succeed(command: &mut Command) -> Result<String> {
    let output = command
        .output()
        .with_context(|| format!("cannot run {command:?}"))?;
    ensure!(
        output.status.success(),
        "{command:?}: {}\n{}",
        output.status,
        all(&output)
    );
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns stdout and stderr.
pub(crate) fn all(output: &Output) -> String {
    let stdout = String::from_utf8_lossy(&output.stdout);
    format!("{stdout}{}", String::from_utf8_lossy(&output.stderr))
}
