//! Every table of the model is listed in a `sizes` function. A struct with a collection, or with a
//! field that has one, must be destructured there field by field.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

const COLLECTIONS: [&str; 9] = [
    "Vec",
    "VecDeque",
    "HashMap",
    "HashSet",
    "BTreeMap",
    "BTreeSet",
    "BinaryHeap",
    "LinkedList",
    "String",
];

/// Files whose structs are created for one answer, and the watchlist, which `limits.watches`
/// bounds.
const ANSWERS: [&str; 13] = [
    "chain/recorded/hops.rs",
    "input.rs",
    "inside/attribution.rs",
    "inside/facts.rs",
    "inside/report.rs",
    "snapshot.rs",
    "snapshot/delivery.rs",
    "discovery/memory.rs",
    "diagnosis.rs",
    "examiner/endpoints.rs",
    "observer/report/deliveries.rs",
    "selection.rs",
    "watch.rs",
];
/// Further structs that are returned, live during one examination, or only contain lengths.
const ANSWER: [&str; 16] = [
    "Arrivals",
    "ChainFacts",
    "ChainsFacts",
    "Findings",
    "Inputs",
    "Past",
    "Path",
    "RememberedConnection",
    "RememberedPassage",
    "SameStamp",
    "SpanStage",
    "Taken",
    "Takes",
    "Through",
    "UnknownWriters",
    "ZenohMemory",
];
/// Types that the model shares with an owner elsewhere.
const SHARED: [&str; 2] = ["Arc<", "&'"];

#[derive(Debug)]
struct Struct {
    file: String,
    name: String,
    is_public: bool,
    /// Name and type.
    fields: Vec<(String, String)>,
}

fn sources(directory: &Path, into: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.file_name().unwrap() != "tests.rs" {
            into.push(path);
        }
    }
}

/// Returns the source without tests and comments.
fn text(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let text = text.split("#[cfg(test)]").next().unwrap();
    let is_code = |line: &&str| !line.trim_start().starts_with("//");
    let lines: Vec<_> = text.lines().filter(is_code).collect();
    lines.join("\n")
}

fn structs(file: &str, text: &str) -> Vec<Struct> {
    let mut found = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let Some((visibility, rest)) = line.split_once("struct ") else {
            continue;
        };
        let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_');
        let name = rest[..end.unwrap_or(rest.len())].to_owned();
        let mut fields = Vec::new();
        if let Some((_, inside)) = rest.split_once('(') {
            fields.push(("0".to_owned(), inside.to_owned()));
        } else if rest.ends_with('{') {
            for field in lines.by_ref().take_while(|line| !line.starts_with('}')) {
                if let Some((name, kind)) = field.trim().split_once(": ") {
                    let name = name.rsplit(' ').next().unwrap();
                    fields.push((name.to_owned(), kind.to_owned()));
                }
            }
        }
        found.push(Struct {
            file: file.to_owned(),
            name,
            is_public: visibility.contains("pub"),
            fields,
        });
    }
    found
}

fn words(kind: &str) -> impl Iterator<Item = &str> {
    kind.split(|c: char| !c.is_alphanumeric() && c != '_')
}

/// Returns whether this type is, or contains, a collection that grows.
fn grows(kind: &str, file: &str, growing: &BTreeSet<(String, String)>, all: &[Struct]) -> bool {
    if SHARED.iter().any(|shared| kind.contains(shared)) {
        return false;
    }
    words(kind).any(|word| {
        let own = |each: &&Struct| each.name == word && each.file == file;
        let candidates: Vec<_> = match all.iter().find(own) {
            Some(own) => vec![own],
            None => {
                let is_meant = |each: &&Struct| each.is_public && each.name == word;
                all.iter().filter(is_meant).collect()
            }
        };
        let is_growing = |each: &Struct| growing.contains(&(each.file.clone(), each.name.clone()));
        COLLECTIONS.contains(&word) || candidates.into_iter().any(is_growing)
    })
}

/// Returns the fields of the pattern that destructures this struct in a function about sizes.
fn taken_apart(each: &Struct, texts: &BTreeMap<String, String>) -> Option<String> {
    let own = texts[&each.file].split("\nimpl").skip(1);
    // The name follows the generic parameters.
    let own = own.map(|part| match part.starts_with('<') {
        true => part.split_once("> ").map_or(part, |(_, rest)| rest),
        false => part.trim_start(),
    });
    let own = own.filter(|part| words(part).next() == Some(&each.name));
    let selves = own.flat_map(|part| after(part, "let Self {"));
    let mut all: Vec<_> = selves.collect();
    for text in texts.values() {
        all.extend(after(text, &format!("let {} {{", each.name)));
        all.extend(after(text, &format!("|{} {{", each.name)));
        all.extend(after(text, &format!("|{}(", each.name)));
    }
    let names = |inside: &&str| {
        let is_named =
            |(name, _): &(String, String)| name == "0" || words(inside).any(|word| word == name);
        each.fields.iter().all(is_named) && !inside.contains("..")
    };
    all.into_iter().find(names).map(str::to_owned)
}

fn after<'a>(text: &'a str, pattern: &str) -> Vec<&'a str> {
    let parts = text.split(pattern).skip(1);
    parts
        .filter_map(|part| part.split(['}', ')']).next())
        .collect()
}

#[test]
fn every_collection_that_the_model_keeps_is_listed_among_its_tables() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut paths = Vec::new();
    sources(&root, &mut paths);
    let name = |path: &PathBuf| path.strip_prefix(&root).unwrap().display().to_string();
    let texts: BTreeMap<_, _> = paths.iter().map(|path| (name(path), text(path))).collect();
    let all: Vec<_> = texts
        .iter()
        .filter(|(file, _)| !ANSWERS.contains(&file.as_str()))
        .flat_map(|(file, text)| structs(file, text))
        .filter(|each| !ANSWER.contains(&each.name.as_str()))
        .collect();
    let mut growing = BTreeSet::new();
    loop {
        let before = growing.len();
        for each in &all {
            let mut kinds = each.fields.iter().map(|(_, kind)| kind);
            if kinds.any(|kind| grows(kind, &each.file, &growing, &all)) {
                growing.insert((each.file.clone(), each.name.clone()));
            }
        }
        if growing.len() == before {
            break;
        }
    }
    println!("{growing:#?}");
    assert!(growing.len() > 40, "{}", growing.len());
    let mut wrong = Vec::new();
    for each in &all {
        if !growing.contains(&(each.file.clone(), each.name.clone())) {
            continue;
        }
        let Some(inside) = taken_apart(each, &texts) else {
            wrong.push(format!(
                "{}: {} is taken apart nowhere",
                each.file, each.name
            ));
            continue;
        };
        for (field, kind) in &each.fields {
            let is_left_out = inside.contains(&format!("{field}: _"));
            if is_left_out && grows(kind, &each.file, &growing, &all) {
                wrong.push(format!("{}: {}.{field} is left out", each.file, each.name));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
