//! The sources of the packages for ROS name the wheels of the release.

use std::fs;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};

use super::{VERSION, packaging, published, succeed};

#[test]
#[ignore = "looks at a release: make release"]
fn the_archive_for_ros_has_the_checksums_of_both_wheels() -> Result<()> {
    let name = format!("ros2probe-{VERSION}-ros.tar.gz");
    let archive = published()?.join(&name);
    let directory = tempfile::tempdir()?;
    let mut tar = Command::new("tar");
    tar.arg("--extract").arg("--file").arg(&archive);
    succeed(tar.arg("--directory").arg(directory.path()))?;
    let packages = directory.path().join(format!("ros2probe-{VERSION}"));
    let sums = packages.join("ros2probe/wheels.sha256");
    let mut check = Command::new("sha256sum");
    check.args(["--check", "--strict"]).arg(&sums);
    let checked = succeed(check.current_dir(published()?))?;
    ensure!(checked.matches(".whl: OK").count() == 2, "{checked}");
    for machine in ["x86_64", "aarch64"] {
        ensure!(
            checked.contains(&format!("_{machine}.whl: OK")),
            "{checked}"
        );
    }
    // The archive stands alone: links to files of the repository have become files.
    let mut find = Command::new("find");
    let links = succeed(find.arg(&packages).args(["-type", "l"]))?;
    ensure!(links.is_empty(), "{links}");

    let again = directory.path().join("again");
    fs::create_dir(&again)?;
    for entry in fs::read_dir(published()?)? {
        let path = entry?.path();
        if path.extension().is_some_and(|ending| ending == "whl") {
            fs::copy(&path, again.join(path.file_name().context("no name")?))?;
        }
    }
    succeed(packaging("ros.sh")?.arg(&again))?;
    ensure!(
        fs::read(archive)? == fs::read(again.join(name))?,
        "the archives differ"
    );
    Ok(())
}
