//! The feed of a release, and what `rp upgrade --check` of each installation finds in it.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use super::provenance::sums;
use super::{VERSION, packaging, published, succeed};

/// Version of a release that is newer than each other one.
const NEWER: &str = "99.0.0";

/// Checks that a program finds the file of its own form in the feed of a newer release of these
/// files. Returns the output.
pub(super) fn upgrade(program: &Path, files: &Path) -> Result<String> {
    let mut script = packaging("feed.py")?;
    let feed = succeed(script.args([VERSION, "0123456789abcdef"]).arg(files))?;
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("release.json");
    fs::write(&path, feed.replace(VERSION, NEWER))?;
    let mut check = Command::new(program);
    let check = check.args(["upgrade", "--check", "--feed"]).arg(&path);
    let output = check.output()?;
    ensure!(output.status.code() == Some(100), "{output:?}");
    let text = String::from_utf8(output.stdout)?;
    let file = format!("  file    {}/", directory.path().display());
    ensure!(text.contains(&file) && text.contains(NEWER), "{text}");
    Ok(text)
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_feed_names_the_version_and_the_checksums_of_all_files_beside_it() -> Result<()> {
    let directory = published()?;
    let path = directory.join("release.json");
    let feed: Value = serde_json::from_str(&fs::read_to_string(&path)?)?;
    ensure!(feed["version"] == VERSION, "{feed}");
    let files = feed["files"].as_object().context("no files")?;
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let found: BTreeMap<String, String> = files
        .iter()
        .map(|(name, sum)| (name.clone(), text(sum)))
        .collect();
    let mut expected = sums(&directory)?;
    // These two files are made after the feed.
    for later in [
        "release.json",
        &format!("ros2probe-{VERSION}.provenance.json"),
    ] {
        ensure!(expected.remove(later).is_some(), "no checksum of {later}");
    }
    expected.retain(|name, _| !name.contains('/'));
    ensure!(found == expected, "{found:?}, not {expected:?}");

    let binary = directory.join(format!("rp-{VERSION}-{}", std::env::consts::ARCH));
    let mut check = Command::new(&binary);
    let printed = succeed(check.args(["upgrade", "--check", "--feed"]).arg(&path))?;
    ensure!(printed.contains("is the newest version"), "{printed}");
    let printed = upgrade(&binary, &directory)?;
    ensure!(printed.contains("installed as the file"), "{printed}");
    ensure!(printed.contains("sudo install -m 755 "), "{printed}");
    Ok(())
}
