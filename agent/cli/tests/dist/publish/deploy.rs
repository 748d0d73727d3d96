//! The archive of the manifests, the Ansible role and the compose file.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository as sources;
use serde_yaml::Value;

use super::{VERSION, packaging, published, succeed};

fn name() -> String {
    format!("ros2probe-{VERSION}-deploy.tar.gz")
}

/// Unpacks an archive into a directory, and returns the directory of its files.
fn unpacked(archive: &Path, directory: &Path) -> Result<PathBuf> {
    let mut tar = Command::new("tar");
    tar.arg("--extract").arg("--file").arg(archive);
    succeed(tar.arg("--directory").arg(directory))?;
    Ok(directory.join(format!("ros2probe-{VERSION}")))
}

/// Unpacks the archive of the release into a directory, and returns the directory of its files.
pub(super) fn released(directory: &Path) -> Result<PathBuf> {
    unpacked(&published()?.join(name()), directory)
}

/// Returns the names of the files of the repository below `deploy/` that the archive has.
fn expected() -> Result<Vec<String>> {
    let mut list = Command::new("git");
    list.args(["ls-files", "--cached", "--others", "--exclude-standard"]);
    let listed = succeed(list.arg("deploy").current_dir(sources("")))?;
    let is_elsewhere = |name: &&str| {
        name.starts_with("deploy/ros/")
            || name.starts_with("deploy/Dockerfile")
            || !sources(name).exists()
    };
    let mut names: Vec<String> = listed
        .lines()
        .filter(|name| !is_elsewhere(name))
        .map(str::to_owned)
        .collect();
    names.sort();
    Ok(names)
}

#[test]
fn the_archive_has_the_manifests_the_role_and_what_compose_mounts() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let place = |name: &str| -> Result<PathBuf> {
        let place = directory.path().join(name);
        fs::create_dir(&place)?;
        Ok(place)
    };
    let mut made = Vec::new();
    for each in [place("once")?, place("again")?] {
        succeed(packaging("deploy.sh")?.arg(&each))?;
        made.push(each.join(name()));
    }
    ensure!(
        fs::read(&made[0])? == fs::read(&made[1])?,
        "the archives differ"
    );

    let files = unpacked(&made[0], directory.path())?;
    let mut find = Command::new("find");
    find.args(["deploy", "-type", "f"]).current_dir(&files);
    let found = succeed(&mut find)?;
    let mut found: Vec<String> = found.lines().map(str::to_owned).collect();
    found.sort();
    let expected = expected()?;
    ensure!(found == expected, "{found:?}, not {expected:?}");
    for name in [
        "deploy/kubernetes/ros2probe.yaml",
        "deploy/ansible/roles/ros2probe/tasks/remove.yaml",
        "deploy/ci/action.yml",
    ] {
        let same = fs::read(files.join(name))? == fs::read(sources(name))?;
        ensure!(same, "{name}");
    }

    let compose = fs::read_to_string(files.join("deploy/compose.yaml"))?;
    let compose: Value = serde_yaml::from_str(&compose)?;
    let services = compose["services"].as_mapping().context("no services")?;
    let mut mounted = 0;
    for volume in services
        .values()
        .filter_map(|service| service["volumes"].as_sequence())
        .flatten()
        .filter_map(Value::as_str)
        .filter(|volume| volume.starts_with('.'))
    {
        let (outside, _) = volume.split_once(':').context("no target")?;
        ensure!(files.join("deploy").join(outside).exists(), "{outside}");
        mounted += 1;
    }
    ensure!(mounted >= 5, "{mounted} mounts");
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_published_archive_is_that_of_the_sources() -> Result<()> {
    let directory = tempfile::tempdir()?;
    succeed(packaging("deploy.sh")?.arg(directory.path()))?;
    let again = fs::read(directory.path().join(name()))?;
    ensure!(
        fs::read(published()?.join(name()))? == again,
        "the archives differ"
    );
    Ok(())
}
