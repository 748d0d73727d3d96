//! Each published crate contains all files that its compilation reads.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Component, Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository as sources;
use serde_json::Value;

use super::package::installation::succeed;

/// Returns what cargo knows of each crate of the workspace that is published.
fn members() -> Result<Vec<Value>> {
    let mut metadata = cargo("metadata");
    let text = succeed(metadata.args(["--no-deps", "--format-version=1"]))?;
    let metadata: Value = serde_json::from_str(&text)?;
    let packages = metadata["packages"].as_array().context("no packages")?;
    let is_published = |package: &&Value| package["publish"] != Value::Array(Vec::new());
    Ok(packages.iter().filter(is_published).cloned().collect())
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}

/// Returns name and directory of each crate of the workspace that is published.
pub(crate) fn published() -> Result<Vec<(String, PathBuf)>> {
    members()?
        .iter()
        .map(|package| {
            let manifest = PathBuf::from(text(&package["manifest_path"]));
            let directory = manifest.parent().context("no directory")?;
            Ok((text(&package["name"]), directory.to_owned()))
        })
        .collect()
}

fn cargo(verb: &str) -> Command {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.arg(verb).args(["--locked", "--offline"]);
    cargo.current_dir(sources(""));
    cargo
}

/// Returns the path without `.` and `..`. Links stay, because cargo packs a link as its file.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(plain.pop()),
            Component::CurDir => {}
            part => plain.push(part),
        }
    }
    plain
}

/// Returns the files that the compiler read for a crate's newest library, or for `rp`.
fn compiled(crate_name: &str) -> Result<Vec<PathBuf>> {
    let program = Path::new(env!("CARGO_BIN_EXE_rp"));
    let directory = program.parent().context("no directory")?.join("deps");
    let prefix = format!("{}-", crate_name.replace('-', "_"));
    let mut newest = None;
    for entry in fs::read_dir(&directory)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if !name.starts_with(&prefix) || !name.ends_with(".d") {
            continue;
        }
        let built = match crate_name {
            "rp" => path.with_extension(""),
            _ => directory.join(format!("lib{name}")).with_extension("rlib"),
        };
        let Ok(built) = built.metadata() else {
            continue;
        };
        // The unit tests of `rp` have the same name. Cargo links the program itself.
        let is_it = crate_name != "rp" || built.ino() == program.metadata()?.ino();
        let made = built.modified()?;
        if is_it && newest.as_ref().is_none_or(|(other, _)| made > *other) {
            newest = Some((made, path));
        }
    }
    let (_, list) = newest.with_context(|| format!("no list of sources of {crate_name}"))?;
    let text = fs::read_to_string(list)?;
    let first = text.lines().next().unwrap_or_default();
    let (_, files) = first.split_once(": ").context("no files")?;
    let files = files.replace("\\ ", "\0");
    let path = |file: &str| plain(&sources(&file.replace('\0', " ")));
    Ok(files.split(' ').map(path).collect())
}

#[test]
fn every_source_file_of_rp_is_in_a_published_crate() -> Result<()> {
    let mut packed = BTreeSet::new();
    let mut read = compiled("rp")?;
    for (name, directory) in published()? {
        read.extend(compiled(&name)?);
        let mut list = cargo("package");
        list.args(["--list", "--allow-dirty", "--package", &name]);
        let directory = plain(&directory);
        packed.extend(succeed(&mut list)?.lines().map(|file| directory.join(file)));
    }
    ensure!(read.len() > 800, "{} files", read.len());
    let absent: Vec<_> = read.iter().filter(|file| !packed.contains(*file)).collect();
    ensure!(
        absent.is_empty(),
        "no packed crate contains {absent:?}: move it into the crate, or link it there"
    );
    Ok(())
}

/// Earlier, the page lacked a crate.
#[test]
fn the_page_lists_each_published_crate_behind_those_that_it_needs() -> Result<()> {
    let page = fs::read_to_string(sources("docs/release.md"))?;
    let (_, list) = page
        .split_once("in the order of their dependencies:")
        .context("no list")?;
    let (list, _) = list.split_once("\n\n").context("no end")?;
    let listed: Vec<String> = list
        .split('`')
        .skip(1)
        .step_by(2)
        .filter(|name| !name.contains(' ') && !name.starts_with("--"))
        .map(|name| match name.strip_prefix('-') {
            Some(part) => format!("ros2probe-{part}"),
            None => name.to_owned(),
        })
        .collect();
    let place = |name: &str| listed.iter().position(|listed| listed == name);
    let members = members()?;
    for member in &members {
        let name = text(&member["name"]);
        let own = place(&name).with_context(|| format!("{name} is not listed"))?;
        let needed = member["dependencies"].as_array().context("no list")?;
        for dependency in needed.iter().filter(|each| each["kind"] != "dev") {
            let needed = text(&dependency["name"]);
            ensure!(
                place(&needed).is_none_or(|before| before < own),
                "{needed} is behind {name}"
            );
        }
    }
    ensure!(listed.len() == members.len(), "{listed:?}");
    Ok(())
}
