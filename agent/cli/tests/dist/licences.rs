//! The licences that each form of the program states are those of its sources.

use std::fs;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository;

fn read(path: &str) -> Result<String> {
    fs::read_to_string(repository(path)).context(path.to_owned())
}

/// Returns the licence that the manifest of a crate states for itself.
fn of_crate(path: &str) -> Result<String> {
    let manifest = read(path)?;
    let mut lines = manifest.lines();
    let licence = lines.find_map(|line| line.strip_prefix("license = "));
    let licence = licence.with_context(|| format!("{path}: no licence"))?;
    Ok(licence.trim_matches('"').to_owned())
}

/// Returns the parts of an expression, in order.
fn parts(expression: &str) -> Vec<String> {
    let mut parts: Vec<String> = expression.split(" AND ").map(str::to_owned).collect();
    parts.sort();
    parts.dedup();
    parts
}

#[test]
fn the_program_has_the_licences_of_its_sources_kernel_objects_and_page() -> Result<()> {
    let own = env!("CARGO_PKG_LICENSE");
    let kernel = of_crate("agent-ebpf/Cargo.toml")?;
    ensure!(
        of_crate("agent/capture/Cargo.toml")? == format!("({own}) AND ({kernel})"),
        "capture"
    );
    let page = of_crate("agent/page/Cargo.toml")?;
    let packaging = read("packaging/sources.py")?;
    let stated = packaging
        .lines()
        .find_map(|line| line.strip_prefix("LICENCE = "));
    let stated = stated.context("no LICENCE")?.trim_matches('"');
    let expected = parts(&format!("({own}) AND ({kernel}) AND {page}"));
    ensure!(parts(stated) == expected, "{stated}, not {expected:?}");
    // The wheel and the image state this expression.
    for script in ["packaging/wheel.py", "packaging/image.py"] {
        let uses = |line: &str| line.starts_with("from sources import LICENCE,");
        ensure!(read(script)?.lines().any(uses), "{script}");
    }
    let readme = read("README.md")?;
    ensure!(
        readme.contains(&format!(
            "{own}; the kernel programs in `agent-ebpf/` {kernel}."
        )),
        "README"
    );
    Ok(())
}

#[test]
fn the_copyright_of_the_package_covers_each_part() -> Result<()> {
    let copyright = read("packaging/copyright")?;
    // Debian's names of MIT and of GPL-2.0-only.
    let debian = |expression: &str| {
        let names = [
            ("GPL-2.0-only", "GPL-2"),
            ("MIT", "Expat"),
            (" OR ", " or "),
        ];
        let renamed = names.iter();
        renamed.fold(expression.to_owned(), |text, (from, to)| {
            text.replace(from, to)
        })
    };
    for (files, licence) in [
        ("*", env!("CARGO_PKG_LICENSE").to_owned()),
        ("agent-ebpf/*", of_crate("agent-ebpf/Cargo.toml")?),
    ] {
        let (_, paragraph) = copyright
            .split_once(&format!("Files: {files}\n"))
            .with_context(|| format!("no {files}"))?;
        let licence = format!("License: {}\n\n", debian(&licence));
        let (paragraph, _) = paragraph.split_once("Files: ").unwrap_or((paragraph, ""));
        ensure!(paragraph.ends_with(&licence), "{paragraph}");
    }
    for name in ["Apache-2.0", "GPL-2", "Expat"] {
        ensure!(
            copyright.contains(&format!("\nLicense: {name}\n ")),
            "{name}"
        );
    }
    Ok(())
}

#[test]
fn sources_for_ros_and_ansible_have_the_licence_of_the_workspace() -> Result<()> {
    let own = env!("CARGO_PKG_LICENSE");
    for (path, line) in [
        (
            "deploy/ros/ros2probe_cli/setup.py",
            format!("license='{own}',"),
        ),
        (
            "deploy/ansible/roles/ros2probe/meta/main.yaml",
            format!("license: {own}\n"),
        ),
    ] {
        ensure!(read(path)?.contains(&line), "{path}: no {line}");
    }
    // REP 149 wants an element for each licence.
    for package in ["ros2probe", "ros2probe_cli"] {
        let manifest = read(&format!("deploy/ros/{package}/package.xml"))?;
        let found: Vec<&str> = manifest
            .split("</license>")
            .filter_map(|part| Some(part.split_once("<license file=\"LICENSE-")?.1))
            .collect();
        ensure!(found == ["APACHE\">Apache-2.0", "MIT\">MIT"], "{found:?}");
    }
    Ok(())
}
