//! Errors of the product are types: a caller can distinguish them, and each text exists once.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::fs;
use std::path::Path;

use ros2probe_testing::repository;

/// Returns the `Result` types with a string as their error, in the order of the source.
fn string_errors(source: &str) -> Vec<&str> {
    let starts = source.match_indices("Result<").map(|(start, _)| start);
    let types = starts.filter_map(|start| {
        let rest = source.get(start..)?;
        let (mut depth, mut error) = (0, None);
        for (index, letter) in rest.char_indices() {
            match letter {
                '<' | '(' | '[' => depth += 1,
                // This is the arrow of a function's type.
                '>' if rest.get(..index)?.ends_with('-') => {}
                '>' | ')' | ']' => depth -= 1,
                ',' if depth == 1 && error.is_none() => error = rest.get(index + 1..),
                _ => {}
            }
            if depth == 0 && letter == '>' {
                let error = error?.trim_start().strip_prefix("String")?;
                let is_string = error.trim_start().starts_with([',', '>']);
                return is_string.then(|| rest.get(..=index))?;
            }
        }
        None
    });
    types.collect()
}

fn check(folder: &Path, found: &mut Vec<String>, read: &mut usize) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            check(&path, found, read);
        } else if path.extension().is_some_and(|end| end == "rs") {
            *read += 1;
            let source = fs::read_to_string(&path).unwrap();
            let wrong = string_errors(&source).into_iter();
            found.extend(wrong.map(|result| format!("{}: {result}", path.display())));
        }
    }
}

#[test]
fn no_result_has_a_string_as_its_error() {
    let (mut found, mut read) = (Vec::new(), 0);
    check(&repository("wire/src"), &mut found, &mut read);
    for crates in fs::read_dir(repository("agent")).unwrap() {
        let sources = crates.unwrap().path().join("src");
        if sources.is_dir() {
            check(&sources, &mut found, &mut read);
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
    assert!(read > 500, "{read} sources");
}

#[test]
fn string_errors_of_a_source_are_found() {
    let source = "fn a() -> Result<(), String>; Result<Vec<Map<u8, u8>>, String,>;
        Result<Vec<Map<String, String>>>; Result<(u8, String), Error>; Result<fn() -> u8, String>;
        Result<(), StringError>; Result<String, Error>";
    let found = string_errors(source);
    let expected = [
        "Result<(), String>",
        "Result<Vec<Map<u8, u8>>, String,>",
        "Result<fn() -> u8, String>",
    ];
    assert_eq!(found, expected);
}
