//! Documents refer to existing files, pages and headings, and stay readable.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ros2probe_testing::repository;

/// Maximum number of bytes of a page, so that it can be read in one sitting.
const MAX_PAGE: usize = 12 * 1024;

/// Maximum number of columns of a line outside of tables, code and links.
const MAX_COLUMNS: usize = 100;

/// Pages that may be longer: SECURITY.md names the tests of each claim, and a changelog only grows.
const LONG: [&str; 2] = ["SECURITY.md", "CHANGELOG.md"];

/// Documents with a list of panels generated from the dashboards.
const GENERATED: [&str; 1] = ["dashboards/README.md"];

/// Collects paths of the Rust sources below a folder, with `/` before each name.
fn sources(folder: &Path, into: &mut Vec<String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let is_output = path.file_name().is_some_and(|name| name == "target");
        if path.is_dir() && !is_output {
            sources(&path, into);
        } else if path.extension().is_some_and(|end| end == "rs") {
            into.push(path.to_str().unwrap().to_owned());
        }
    }
}

/// Returns the Markdown files of these folders, by their path in the repository.
fn markdown(folders: &[&str]) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    for folder in folders {
        for entry in fs::read_dir(repository(folder)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|end| end == "md") {
                let name = path.file_name().unwrap().to_str().unwrap();
                let name = Path::new(folder).join(name);
                let name = name.to_str().unwrap().trim_start_matches("./");
                found.insert(name.to_owned(), fs::read_to_string(&path).unwrap());
            }
        }
    }
    found
}

/// Returns the documents for users and contributors.
fn documents() -> BTreeMap<String, String> {
    let found = markdown(&[".", "docs", "deploy", "dashboards", "config"]);
    assert!(found.len() > 40, "{} documents", found.len());
    found
}

/// Returns the lines outside of code blocks, numbered from 1.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut is_code = false;
    let numbered = text.lines().enumerate();
    numbered.filter_map(move |(number, line)| {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        (!is_code && !is_fence).then_some((number + 1, line))
    })
}

/// Returns the targets of the links in a line, except links in code.
fn links(line: &str) -> Vec<String> {
    let plain: String = line.split('`').step_by(2).collect::<Vec<_>>().join("");
    let targets = plain.split("](").skip(1);
    let targets = targets.filter_map(|rest| rest.split_once(')'));
    targets.map(|(target, _)| target.to_owned()).collect()
}

/// Returns the anchor that a Git host and mdBook generate for a heading.
fn anchor(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
    let name = heading.to_lowercase();
    name.chars()
        .filter(kept)
        .collect::<String>()
        .replace(' ', "-")
}

fn anchors(text: &str) -> Vec<String> {
    let headings = prose(text).filter_map(|(_, line)| line.split_once("# "));
    let headings = headings.filter(|(marks, _)| marks.chars().all(|c| c == '#'));
    headings
        .map(|(_, heading)| anchor(heading.trim()))
        .collect()
}

#[test]
fn every_source_that_a_document_names_exists() {
    let mut paths = Vec::new();
    for folder in ["agent", "agent-ebpf", "wire"] {
        sources(&repository(folder), &mut paths);
    }
    let mut named = 0;
    for (document, text) in documents() {
        for file in text.split('`').skip(1).step_by(2) {
            if !file.ends_with(".rs") || file.contains([' ', '*', '\n']) {
                continue;
            }
            let end = format!("/{file}");
            let exists = paths.iter().any(|path| path.ends_with(&end));
            assert!(exists, "{document} names {file}, which does not exist");
            named += 1;
        }
    }
    assert!(named > 100, "{named} names");
}

#[test]
fn every_link_leads_to_a_file_and_a_heading() {
    let mut followed = 0;
    for (document, text) in documents() {
        let folder = Path::new(&document).parent().unwrap().to_owned();
        for (number, line) in prose(&text) {
            for link in links(line) {
                if link.starts_with("http") || link.starts_with("mailto:") {
                    continue;
                }
                let (path, heading) = link.split_once('#').unwrap_or((&link, ""));
                let target: PathBuf = if path.is_empty() {
                    repository(&document)
                } else {
                    repository(folder.join(path).to_str().unwrap())
                };
                assert!(target.exists(), "{document}:{number}: no file for {link}");
                if !heading.is_empty() {
                    let text = fs::read_to_string(&target).unwrap();
                    let exists = anchors(&text).iter().any(|name| name == heading);
                    assert!(exists, "{document}:{number}: no heading for {link}");
                }
                followed += 1;
            }
        }
    }
    assert!(followed > 200, "{followed} links");
}

#[test]
fn every_test_that_the_page_of_compatibility_names_exists() {
    let mut paths = Vec::new();
    for folder in ["agent", "wire"] {
        sources(&repository(folder), &mut paths);
    }
    let sources: Vec<String> = paths
        .iter()
        .map(|path| fs::read_to_string(path).unwrap())
        .collect();
    let page = fs::read_to_string(repository("docs/compatibility.md")).unwrap();
    let is_test = |name: &&str| name.matches('_').count() > 2 && !name.contains([' ', '/', '.']);
    let mut named = 0;
    for name in page.split('`').skip(1).step_by(2).filter(is_test) {
        let function = format!("#[test]\nfn {name}(");
        let nested = format!("#[test]\n    fn {name}(");
        let has = |source: &String| source.contains(&function) || source.contains(&nested);
        assert!(sources.iter().any(has), "{name} is no test");
        named += 1;
    }
    assert!(named > 12, "{named} names");
}

#[test]
fn the_summary_lists_every_page_of_the_book() {
    let pages = markdown(&["docs"]);
    let summary = &pages["docs/SUMMARY.md"];
    for page in pages.keys().filter(|page| *page != "docs/SUMMARY.md") {
        let name = page.trim_start_matches("docs/");
        let times = summary.matches(&format!("]({name})")).count();
        assert_eq!(times, 1, "{page} in docs/SUMMARY.md");
    }
}

#[test]
fn pages_and_lines_stay_below_their_maximum_length() {
    for (document, text) in documents() {
        let is_generated = GENERATED.contains(&document.as_str());
        let may_be_long = LONG.contains(&document.as_str()) || is_generated;
        assert!(
            may_be_long || text.len() <= MAX_PAGE,
            "{document} has {} bytes, more than {MAX_PAGE}",
            text.len()
        );
        let mut is_generated = false;
        for (number, line) in prose(&text) {
            if line.starts_with("<!--") {
                is_generated = line.contains(": begin");
            }
            let columns = line.chars().count();
            let is_table = line.starts_with('|');
            let is_link = line.trim_start().starts_with(['[', '!']);
            assert!(
                columns <= MAX_COLUMNS || is_table || is_link || is_generated,
                "{document}:{number} has {columns} columns, more than {MAX_COLUMNS}"
            );
        }
    }
    let readme = fs::read_to_string(repository("README.md")).unwrap().len();
    assert!(
        (6_000..=8_192).contains(&readme),
        "README.md has {readme} bytes"
    );
}
