//! Signatures, checksums, provenance and notes of a release.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository as sources;
use serde_json::Value;

use super::{VERSION, packaging, published, refuse, succeed};

/// Returns the checksum of each published file, by name.
pub(super) fn sums(directory: &Path) -> Result<BTreeMap<String, String>> {
    let text = fs::read_to_string(directory.join("SHA256SUMS"))?;
    let line = |line: &str| Some((line.get(66..)?.to_owned(), line.get(..64)?.to_owned()));
    text.lines()
        .map(|text| line(text).context("not a checksum"))
        .collect()
}

/// Returns the names of the files below a directory.
fn files(directory: &Path) -> Result<BTreeSet<String>> {
    let mut find = Command::new("find");
    find.arg(directory).args(["-type", "f", "-printf", "%P\\n"]);
    Ok(succeed(&mut find)?.lines().map(str::to_owned).collect())
}

#[test]
fn a_release_without_keys_is_refused_with_the_variable_to_set() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let key = directory.path().join("key");
    fs::write(&key, "")?;
    let release = || -> Result<Command> {
        let mut release = packaging("release.sh")?;
        release.arg("--keys").env_remove("MINISIGN_SECRET_KEY");
        release.env_remove("APT_SIGNING_KEY");
        Ok(release)
    };
    let printed = refuse(&mut release()?)?;
    ensure!(
        printed.starts_with("release: MINISIGN_SECRET_KEY must name the file"),
        "{printed}"
    );
    let printed = refuse(release()?.env("MINISIGN_SECRET_KEY", &key))?;
    ensure!(
        printed.starts_with("release: APT_SIGNING_KEY must name the file"),
        "{printed}"
    );
    succeed(
        release()?
            .env("MINISIGN_SECRET_KEY", &key)
            .env("APT_SIGNING_KEY", &key),
    )
    .map(drop)
}

#[test]
#[ignore = "looks at a release: make release"]
fn a_release_of_a_copy_in_another_directory_has_the_same_checksums() -> Result<()> {
    succeed(packaging("release.sh")?.arg("--again")).map(drop)
}

#[test]
#[ignore = "looks at a release: make release"]
fn minisign_verifies_the_checksums_of_all_files_and_no_others() -> Result<()> {
    let directory = published()?;
    let verify = |sums: &Path| {
        let mut minisign = Command::new("minisign");
        minisign
            .args(["-V", "-p"])
            .arg(directory.join("minisign.pub"));
        minisign.arg("-x").arg(directory.join("SHA256SUMS.minisig"));
        minisign.arg("-m").arg(sums);
        minisign
    };
    let signed = directory.join("SHA256SUMS");
    let printed = succeed(&mut verify(&signed))?;
    ensure!(
        printed.contains(&format!("ros2probe {VERSION}, commit ")),
        "{printed}"
    );

    let copy = tempfile::tempdir()?;
    let changed = copy.path().join("SHA256SUMS");
    let text = fs::read_to_string(&signed)?;
    let first = if text.starts_with('0') { "1" } else { "0" };
    fs::write(&changed, format!("{first}{}", text.get(1..).unwrap_or("")))?;
    let printed = refuse(&mut verify(&changed))?;
    ensure!(
        printed.contains("Signature verification failed"),
        "{printed}"
    );

    let mut check = Command::new("sha256sum");
    check.args(["--check", "--strict", "--quiet", "SHA256SUMS"]);
    succeed(check.current_dir(&directory))?;
    let of_signing = [
        "SHA256SUMS",
        "SHA256SUMS.minisig",
        "minisign.pub",
        "DO-NOT-PUBLISH",
    ];
    let expected: BTreeSet<String> = files(&directory)?
        .into_iter()
        .filter(|name| !name.starts_with("apt/") && !of_signing.contains(&name.as_str()))
        .collect();
    let listed: BTreeSet<String> = sums(&directory)?.into_keys().collect();
    ensure!(listed == expected, "{listed:?}, not {expected:?}");
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_provenance_names_the_commit_the_compiler_and_every_file() -> Result<()> {
    let directory = published()?;
    let name = format!("ros2probe-{VERSION}.provenance.json");
    let text = fs::read_to_string(directory.join(&name))?;
    let statement: Value = serde_json::from_str(&text)?;
    ensure!(statement["_type"] == "https://in-toto.io/Statement/v1");
    ensure!(statement["predicateType"] == "https://slsa.dev/provenance/v1");
    let mut expected = sums(&directory)?;
    ensure!(expected.remove(&name).is_some(), "no checksum of {name}");
    let subjects = statement["subject"].as_array().context("no subject")?;
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let found: BTreeMap<String, String> = subjects
        .iter()
        .map(|subject| (text(&subject["name"]), text(&subject["digest"]["sha256"])))
        .collect();
    ensure!(found == expected, "{found:?}, not {expected:?}");

    let predicate = &statement["predicate"];
    let commit = succeed(
        Command::new("git")
            .args(["rev-parse", "HEAD"])
            .current_dir(sources("")),
    )?;
    let dependencies = &predicate["buildDefinition"]["resolvedDependencies"];
    ensure!(
        dependencies[0]["digest"]["gitCommit"] == commit.trim(),
        "{dependencies}"
    );
    let rustc = succeed(Command::new("rustc").arg("-vV"))?;
    let hash = text(&dependencies[2]["digest"]["gitCommit"]);
    ensure!(
        rustc.contains(&format!("commit-hash: {hash}\n")),
        "{hash} in {rustc}"
    );
    let builder = text(&predicate["runDetails"]["builder"]["id"]);
    ensure!(builder.starts_with("https://"), "{builder}");
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_notes_are_a_section_of_the_changelog() -> Result<()> {
    let notes = fs::read_to_string(published()?.join("RELEASE-NOTES.md"))?;
    let (title, body) = notes.split_once('\n').context("no title")?;
    ensure!(title == format!("# ros2probe {VERSION}"), "{title}");
    ensure!(body.len() > 200 && !body.contains("\n## "), "{body}");
    let changelog = fs::read_to_string(sources("CHANGELOG.md"))?;
    let (before, _) = changelog.split_once(body).context("not in the changelog")?;
    let heading = before.trim_end().lines().last().unwrap_or_default();
    ensure!(
        heading == "## Unreleased" || heading.starts_with(&format!("## {VERSION} - ")),
        "{heading}"
    );
    Ok(())
}
