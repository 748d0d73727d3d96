//! Documents and comments read like the standard library's: no inversions, no missing subjects,
//! short sentences.
//!
//! The patterns are habits of translated text that hide the subject. Tables generated from the
//! sources, and code, are not checked.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use regex::{Regex, RegexSet};
use ros2probe_testing::repository;

/// Maximum number of words of a sentence.
const MAX_WORDS: usize = 25;

/// Patterns to avoid, each with its replacement.
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

/// Further patterns to avoid in comments.
const COMMENT_PATTERNS: [(&str, &str); 6] = [
    (
        r"(?i)\b(someone|whomever|whatever is)\b",
        "name the program, packet or person",
    ),
    (r"(?i)\btell\b", "report, show, distinguish"),
    (r"(?i)\basked for\b|\basks\b", "requests, requested"),
    (
        r"(?i)\bin what way\b|\bcomes to\b|\bby heart\b|\bthe same as if\b",
        "say it plainly",
    ),
    (
        r"(?i)\b(looks?|looked|looking) (at|after|into)\b",
        "reads, observes, inspects",
    ),
    (
        r"(?i)^(which|who|whose|where|why|why not|all of them|what|how|how many|likewise|here|nowhere|nothing|none)\.$",
        "say what the item is or returns, or nothing",
    ),
];

/// Documents and sources with sentences that stay as they are, and a part of each sentence.
const EXCEPTIONS: [(&str, &str); 0] = [];

/// Folders that hold files of other projects, or no sources.
const FOREIGN: [&str; 9] = [
    ".git",
    "target",
    "vendor",
    "data",
    "seeds",
    "corpus",
    "artifacts",
    "node_modules",
    "embedded",
];

/// Mark that starts a comment, by the end of a file's name.
const MARKS: [(&str, &str); 16] = [
    (".rs", "//"),
    (".js", "//"),
    (".mjs", "//"),
    (".cpp", "//"),
    (".hpp", "//"),
    (".sh", "#"),
    (".py", "#"),
    (".yaml", "#"),
    (".yml", "#"),
    (".toml", "#"),
    (".conf", "#"),
    (".service", "#"),
    ("Makefile", "#"),
    ("Dockerfile", "#"),
    ("check", "#"),
    ("inst", "#"),
];

/// Folders with Markdown files that this project has written.
const FOLDERS: [&str; 5] = [".", "docs", "deploy", "dashboards", "config"];

/// Sentences, each with the line on which its paragraph begins.
type Sentences = Vec<(usize, String)>;

/// Returns the sentences of a document: of its paragraphs, and of its tables.
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
    let split = |(number, paragraph): (usize, String)| {
        let text = plain(&paragraph);
        let parts = parts(&text).into_iter();
        let parts: Vec<_> = parts.map(|part| (number, part.to_owned())).collect();
        parts
    };
    let paragraphs = paragraphs.into_iter().flat_map(split).collect();
    (paragraphs, cells.into_iter().flat_map(split).collect())
}

/// Splits a text after each mark with whitespace behind it.
fn parts(text: &str) -> Vec<&str> {
    let (mut parts, mut begin) = (Vec::new(), 0);
    for (at, mark) in text.match_indices(['.', '?', '!', ':', ';']) {
        let end = at + mark.len();
        let after = text.get(end..).unwrap_or_default();
        let spaces = after.len() - after.trim_start().len();
        if spaces > 0 {
            parts.extend(text.get(begin..end));
            begin = end + spaces;
        }
    }
    parts.extend(text.get(begin..).filter(|part| !part.is_empty()));
    parts
}

/// Returns the replacements of the patterns that a sentence contains.
fn advice<'a>(all: &RegexSet, patterns: &[(&str, &'a str)], sentence: &str) -> Vec<&'a str> {
    // Most sentences contain none, which one search shows.
    if !all.is_match(sentence) {
        return Vec::new();
    }
    let found = all.matches(sentence);
    let numbered = patterns.iter().enumerate();
    let found = numbered.filter(|(index, _)| found.matched(*index));
    found.map(|(_, (_, advice))| *advice).collect()
}

/// Returns one expression for all patterns.
fn expression(patterns: &[(&str, &str)]) -> RegexSet {
    RegexSet::new(patterns.iter().map(|(pattern, _)| pattern)).unwrap()
}

/// Returns a text without its code, targets of links and emphasis.
fn plain(text: &str) -> String {
    static CODE: LazyLock<Regex> = LazyLock::new(|| Regex::new("`[^`]*`").unwrap());
    static LINK: LazyLock<Regex> = LazyLock::new(|| Regex::new(r"\[([^\]]*)\]\([^)]*\)").unwrap());
    let text = CODE.replace_all(text, "code");
    LINK.replace_all(&text, "$1").replace("**", "")
}

#[test]
fn sentences_are_short_and_have_a_subject() {
    let all = expression(&PATTERNS);
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
                for advice in advice(&all, &PATTERNS, sentence) {
                    if !EXCEPTIONS.iter().any(excepted) {
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

/// Returns the comments of a source, each with the line on which it begins.
fn comments(text: &str, mark: &str) -> Sentences {
    let mut found: Sentences = Vec::new();
    let mut is_open = false;
    let mut is_code = false;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim_start();
        // Usage, examples and directives of tools are not sentences.
        let is_preformatted =
            line.starts_with("#!") || line.starts_with("#[") || line.starts_with("#   ");
        let words = line
            .strip_prefix(mark)
            .filter(|_| mark != "#" || !is_preformatted)
            .map(|words| words.trim_start_matches(['/', '!', '#']).trim());
        let Some(words) = words else {
            (is_open, is_code) = (false, false);
            continue;
        };
        if words.starts_with("```") {
            (is_open, is_code) = (false, !is_code);
            continue;
        }
        if is_code || words.is_empty() {
            is_open = false;
            continue;
        }
        let item = words
            .strip_prefix("- ")
            .or_else(|| words.strip_prefix("* "));
        match found.last_mut() {
            Some((_, comment)) if is_open && item.is_none() => {
                comment.push(' ');
                comment.push_str(words);
            }
            _ => found.push((number + 1, item.unwrap_or(words).to_owned())),
        }
        is_open = true;
    }
    found
}

/// Collects the files below a folder whose comments are checked, by their path in the repository.
fn sources(folder: &Path, path: &str, into: &mut Vec<(String, &'static str)>) {
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let path = format!("{path}{name}");
        if entry.file_type().unwrap().is_dir() {
            if !FOREIGN.contains(&name.as_str()) {
                sources(&entry.path(), &format!("{path}/"), into);
            }
        } else if let Some((_, mark)) = MARKS.iter().find(|(end, _)| name.ends_with(end)) {
            into.push((path, mark));
        }
    }
}

#[test]
fn comments_are_short_and_have_a_subject() {
    let patterns = [PATTERNS.as_slice(), &COMMENT_PATTERNS].concat();
    let all = expression(&patterns);
    let mut files = Vec::new();
    sources(&repository("."), "", &mut files);
    let (mut found, mut read) = (Vec::new(), 0);
    for (path, mark) in &files {
        for (number, comment) in comments(&fs::read_to_string(repository(path)).unwrap(), mark) {
            for sentence in parts(&plain(&comment)) {
                read += 1;
                let excepted =
                    |(file, part): &(&str, &str)| path.ends_with(file) && sentence.contains(part);
                if EXCEPTIONS.iter().any(excepted) {
                    continue;
                }
                let words = sentence
                    .split(' ')
                    .filter(|word| word.contains(char::is_alphanumeric));
                let words = words.count();
                if words > MAX_WORDS {
                    found.push(format!("{path}:{number}: {words} words: {sentence}"));
                }
                for advice in advice(&all, &patterns, sentence) {
                    found.push(format!("{path}:{number}: {advice}: {sentence}"));
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
    assert!(read > 5000, "{read} sentences");
}

#[test]
fn comments_of_a_source_are_found() {
    let source =
        "//! A module\n//! of two lines.\n//!\n//! ```\n//! told\n//! ```\nlet x = 1;\n// One.\n";
    let expected = [
        (1, "A module of two lines.".to_owned()),
        (8, "One.".to_owned()),
    ];
    assert_eq!(comments(source, "//"), expected);
}

#[test]
fn a_text_is_split_after_marks_before_whitespace() {
    let text = "One: 2.5 of it?!  Three; four. ";
    assert_eq!(parts(text), ["One:", "2.5 of it?!", "Three;", "four."]);
    assert_eq!(parts(""), [""; 0]);
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
