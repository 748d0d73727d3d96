//! The matrix of `docs/coverage.md` is generated from the tests that prove it. A comment of a test
//! has one line for each row: `Coverage: TRANSPORT | IMPLEMENTATION | DISTRIBUTION | VERDICT`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

const COVERAGE_MARK: &str = "// Coverage: ";
const VERDICTS: [&str; 4] = ["exact", "counted", "named", "unseen"];
const BEGIN: &str = "<!-- coverage: generated from the tests -->\n";
const END: &str = "<!-- coverage: end";

/// Returns the Rust files below the directories of the workspace's packages.
fn sources(root: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut directories = vec![root.join("agent"), root.join("wire")];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            match path.is_dir() {
                true if name != "target" && name != "node_modules" => directories.push(path),
                false if name.ends_with(".rs") => found.push(path),
                _ => {}
            }
        }
    }
    found.sort();
    found
}

/// Returns the tests that prove each row.
fn rows(root: &Path) -> BTreeMap<[String; 4], Vec<String>> {
    let mut rows: BTreeMap<_, Vec<String>> = BTreeMap::new();
    for path in sources(root) {
        let text = fs::read_to_string(&path).unwrap();
        let mut marked = Vec::new();
        let mut is_test = false;
        for line in text.lines().map(str::trim_start) {
            if let Some(row) = line.strip_prefix(COVERAGE_MARK) {
                let cells: Vec<String> = row.split(" | ").map(str::to_owned).collect();
                let cells = <[String; 4]>::try_from(cells).unwrap();
                assert!(VERDICTS.contains(&&*cells[3]), "{}: {row}", path.display());
                marked.push(cells);
            } else if line == "#[test]" {
                is_test = true;
            } else if let Some(name) = line.strip_prefix("fn ") {
                let name = name.split_once('(').unwrap().0;
                assert!(marked.is_empty() || is_test, "{name} is not a test");
                for row in marked.drain(..) {
                    rows.entry(row).or_default().push(name.to_owned());
                }
                is_test = false;
            }
        }
        assert!(
            marked.is_empty(),
            "{}: a row without a test",
            path.display()
        );
    }
    rows
}

fn table(rows: &BTreeMap<[String; 4], Vec<String>>) -> String {
    let mut table = "| transport | implementation | distribution | verdict | test |\n".to_owned();
    table.push_str("| --- | --- | --- | --- | --- |\n");
    for ([transport, implementation, distribution, verdict], tests) in rows {
        let tests: Vec<_> = tests.iter().map(|test| format!("`{test}`")).collect();
        let tests = tests.join(", ");
        writeln!(
            table,
            "| {transport} | {implementation} | {distribution} | {verdict} | {tests} |"
        )
        .unwrap();
    }
    table
}

#[test]
fn the_matrix_lists_what_the_tests_prove() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let rows = rows(&root);
    assert!(rows.len() >= 20, "{rows:?}");
    let wanted = table(&rows);
    let path = root.join("docs/coverage.md");
    let text = fs::read_to_string(&path).unwrap();
    let (before, rest) = text.split_once(BEGIN).unwrap();
    let (shown, after) = rest.split_once(END).unwrap();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, format!("{before}{BEGIN}{wanted}{END}{after}")).unwrap();
    } else {
        let hint = "run `UPDATE_DOCS=1 cargo test -p ros2probe --test surface coverage::`";
        assert_eq!(shown, wanted, "{hint} and commit");
    }
}
