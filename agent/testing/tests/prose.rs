//! Documents read like the standard library's: no inversions, no missing subjects, short sentences.
//!
//! The patterns are habits of translated text that hide who does what. Tables generated from the
//! sources, and code, are left out here.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::fs;
use std::sync::LazyLock;

use regex::Regex;
use ros2probe_testing::repository;

/// Words that a sentence may have.
const MAX_WORDS: usize = 25;

/// What not to write, and what to write in its place.
const PATTERNS: [(&str, &str); 12] = [
    (
        r"(?i)\b(nobody|somebody|anybody|everybody|whoever)\b",
        "name the program, packet or person",
    ),
    (r"(?i)\b(told|tells)\b", "prints, reports, shows"),
    (r"(?i)\bthere (is|are) none\b", "say what is missing"),
    (r"(?i)\b(is|are|was|were) said\b", "prints, announces"),
    (r"(?i)\bsaid by\b", "announced by"),
    (r"(?i)\b(to|can|cannot|not) be had\b", "is unavailable"),
    (r"(?i)\bonly who\b", "only a process that"),
    (r"(^|[.;] )Who [a-z][^?]*\.", "name the subject"),
    (
        r"(^|[.;] )What [a-z][^?]*\b(is|are|has|counts)\b[^?]*\.$",
        "begin with the subject",
    ),
    (r"(?i)\bmay not be (looked|asked|seen)\b", "cannot be read"),
    (r"(?i)\b(looked|looks) (at|after) by\b", "reads"),
    (r"(?i)\bmeanwhile\b", "name the time"),
];

/// Documents with sentences that stay as they are, and a part of each sentence.
const EXCEPTIONS: [(&str, &str); 0] = [];

/// Documents of this project's own prose, as folders of Markdown files.
const FOLDERS: [&str; 5] = [".", "docs", "deploy", "dashboards", "config"];

/// Sentences, each with the line on which its paragraph begins.
type Sentences = Vec<(usize, String)>;

/// The sentences of a document: of its paragraphs, and of its tables.
fn sentences(text: &str) -> (Sentences, Sentences) {
    let (mut paragraphs, mut cells) = (Vec::new(), Vec::new());
    let (mut is_code, mut is_generated, mut is_open) = (false, false, false);
    for (number, line) in text.lines().enumerate() {
        let (number, trimmed) = (number + 1, line.trim());
        if trimmed.starts_with("```") {
            (is_code, is_open) = (!is_code, false);
            continue;
        }
        if trimmed.starts_with("<!--") {
            is_generated = trimmed.contains(": begin");
        }
        if is_code || is_generated || trimmed.starts_with("<!--") {
            continue;
        }
        if trimmed.starts_with('|') {
            let row = trimmed.trim_matches('|').split(" | ");
            cells.extend(row.map(|cell| (number, cell.trim().to_owned())));
            is_open = false;
            continue;
        }
        let item = trimmed.trim_start_matches(|c: char| c.is_ascii_digit());
        let item = ["- ", "* ", ". "]
            .iter()
            .find_map(|mark| item.strip_prefix(mark));
        if trimmed.is_empty() || trimmed.starts_with('#') {
            is_open = false;
            continue;
        }
        match paragraphs.last_mut() {
            Some((_, paragraph)) if is_open && item.is_none() => {
                let paragraph: &mut String = paragraph;
                paragraph.push(' ');
                paragraph.push_str(trimmed);
            }
            _ => paragraphs.push((number, item.unwrap_or(trimmed).to_owned())),
        }
        is_open = true;
    }
    let end = Regex::new(r#"([.?!:;])\s+"#).unwrap();
    let split = |(number, paragraph): (usize, String)| {
        let marked = end.replace_all(&plain(&paragraph), "$1\n").into_owned();
        let parts: Vec<_> = marked
            .lines()
            .map(|part| (number, part.to_owned()))
            .collect();
        parts
    };
    let paragraphs = paragraphs.into_iter().flat_map(split).collect();
    (paragraphs, cells.into_iter().flat_map(split).collect())
}

/// A text without its code, targets of links and emphasis.
fn plain(text: &str) -> String {
    static CODE: LazyLock<Regex> = LazyLock::new(|| Regex::new("`[^`]*`").unwrap());
    static LINK: LazyLock<Regex> = LazyLock::new(|| Regex::new(r"\[([^\]]*)\]\([^)]*\)").unwrap());
    let text = CODE.replace_all(text, "code");
    LINK.replace_all(&text, "$1").replace("**", "")
}

#[test]
fn sentences_are_short_and_have_a_subject() {
    let patterns = PATTERNS.map(|(pattern, advice)| (Regex::new(pattern).unwrap(), advice));
    let mut found = Vec::new();
    let mut read = 0;
    for folder in FOLDERS {
        for entry in fs::read_dir(repository(folder)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_none_or(|end| end != "md") {
                continue;
            }
            let document = format!("{folder}/{}", path.file_name().unwrap().display());
            let (prose, cells) = sentences(&fs::read_to_string(&path).unwrap());
            read += prose.len();
            for (number, sentence) in &prose {
                let words = sentence
                    .split(' ')
                    .filter(|word| word.contains(char::is_alphanumeric));
                let words = words.count();
                if words > MAX_WORDS {
                    found.push(format!("{document}:{number}: {words} words: {sentence}"));
                }
            }
            for (number, sentence) in prose.iter().chain(&cells) {
                let excepted = |(page, part): &(&str, &str)| {
                    document.ends_with(page) && sentence.contains(part)
                };
                for (pattern, advice) in &patterns {
                    if pattern.is_match(sentence) && !EXCEPTIONS.iter().any(excepted) {
                        found.push(format!("{document}:{number}: {advice}: {sentence}"));
                    }
                }
            }
        }
    }
    assert!(
        found.is_empty(),
        "{}\n{} findings",
        found.join("\n"),
        found.len()
    );
    assert!(read > 1000, "{read} sentences");
}

#[test]
fn habits_of_translated_text_are_found() {
    let patterns = PATTERNS.map(|(pattern, _)| Regex::new(pattern).unwrap());
    for sentence in [
        "That is seen by nobody.",
        "The client is told so.",
        "Where there is none, it waits.",
        "What it is, is said above.",
        "Losses are not to be had.",
        "Who raises it raises both.",
        "What is directed is least.",
    ] {
        let is_found = patterns.iter().any(|pattern| pattern.is_match(sentence));
        assert!(is_found, "{sentence}");
    }
    for sentence in [
        "The agent reports it.",
        "Who may do what?",
        "What it cannot see",
    ] {
        let is_found = patterns.iter().any(|pattern| pattern.is_match(sentence));
        assert!(!is_found, "{sentence}");
    }
}
