//! The folders of the model are layers: a module imports its own layer and those below it. No
//! modules import each other in a cycle. Only one module reads the kernel's record.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// The layers, lowest first.
const LAYERS: [&str; 6] = ["facts", "graph", "measure", "derive", "report", "observe"];

/// A module of a layer, such as `measure::writer`.
type Module = (String, String);

/// The only file that reads the kernel's record.
const CONVERSION: &str = "facts/observation/record.rs";

/// Returns the lines of a source outside of comments and tests.
fn code(source: &str) -> impl Iterator<Item = &str> {
    let source = source.split("#[cfg(test)]").next().unwrap();
    let lines = source.lines();
    lines.filter(|line| !line.trim_start().starts_with("//"))
}

/// Returns whether a source names the kernel's record, its flags or kinds, or a view of it.
fn names_record(source: &str) -> bool {
    let is_word = |letter: char| letter.is_alphanumeric() || letter == '_';
    code(source).any(|line| {
        let is_import = line.contains("record::") && line.contains("ros2probe_wire");
        let mut words = line.split(|letter| !is_word(letter));
        words.any(|word| word == "Record" || is_import && matches!(word, "flag" | "kind" | "Body"))
    })
}

/// Returns the modules that a source names by `crate::layer::module`, without comments and tests.
fn imports(source: &str) -> BTreeSet<Module> {
    let mut found = BTreeSet::new();
    for part in code(source).flat_map(|line| line.split("crate::").skip(1)) {
        let mut names = part.split("::").map(|name| {
            let end = name.find(|letter: char| !letter.is_alphanumeric() && letter != '_');
            name[..end.unwrap_or(name.len())].to_owned()
        });
        if let (Some(layer), Some(module)) = (names.next(), names.next())
            && LAYERS.contains(&layer.as_str())
        {
            found.insert((layer, module));
        }
    }
    found
}

/// Returns the forbidden imports and the cycles among these modules.
fn mistakes(modules: &BTreeMap<Module, BTreeSet<Module>>) -> Vec<String> {
    let height = |layer: &str| LAYERS.iter().position(|each| *each == layer).unwrap();
    let mut found = Vec::new();
    for ((layer, module), imported) in modules {
        for (other, name) in imported {
            if height(other) > height(layer) {
                found.push(format!(
                    "{layer}::{module} imports {other}::{name}, which is above it"
                ));
            }
        }
    }
    // Modules without imports or importers are removed until only modules in cycles are left.
    let mut left = modules.clone();
    loop {
        let names: BTreeSet<_> = left.keys().cloned().collect();
        let used = left.iter().flat_map(|(own, imported)| {
            let others = imported.iter().filter(move |each| *each != own);
            others.cloned()
        });
        let used: BTreeSet<_> = used.collect();
        let before = left.len();
        left.retain(|own, imported| {
            let mut others = imported.iter().filter(|each| *each != own);
            used.contains(own) && others.any(|each| names.contains(each))
        });
        if left.len() == before {
            break;
        }
    }
    if !left.is_empty() {
        let names = left
            .keys()
            .map(|(layer, module)| format!("{layer}::{module}"));
        found.push(format!(
            "in a cycle: {}",
            names.collect::<Vec<_>>().join(", ")
        ));
    }
    found
}

fn add(directory: &Path, module: &Module, into: &mut BTreeMap<Module, BTreeSet<Module>>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let is_test = path.file_stem().is_some_and(|stem| stem == "tests");
        match path.is_dir() {
            _ if is_test => {}
            true => add(&path, module, into),
            false => {
                let imported = imports(&fs::read_to_string(path).unwrap());
                into.entry(module.clone()).or_default().extend(imported);
            }
        }
    }
}

#[test]
fn each_layer_imports_only_layers_below_it() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut modules = BTreeMap::new();
    let mut beside = BTreeSet::new();
    for entry in fs::read_dir(&root).unwrap() {
        let path = entry.unwrap().path();
        let layer = path.file_name().unwrap().to_str().unwrap().to_owned();
        if !path.is_dir() {
            beside.insert(layer);
            continue;
        }
        assert!(LAYERS.contains(&layer.as_str()), "{layer} is no layer");
        for entry in fs::read_dir(path).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let module = (layer.clone(), name);
            if path.is_dir() {
                add(&path, &module, &mut modules);
            } else if module.1 != "mod" {
                let imported = imports(&fs::read_to_string(path).unwrap());
                modules.entry(module).or_default().extend(imported);
            }
        }
    }
    assert_eq!(beside, BTreeSet::from(["lib.rs".to_owned()]));
    assert!(modules.len() > 50, "{modules:#?}");
    assert_eq!(mistakes(&modules), Vec::<String>::new());
}

#[test]
fn only_one_module_reads_the_record_of_the_kernel() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut folders = vec![root.clone()];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.file_stem().is_none_or(|stem| stem != "tests")
                && names_record(&fs::read_to_string(&path).unwrap())
            {
                found.push(path.strip_prefix(&root).unwrap().to_owned());
            }
        }
    }
    assert_eq!(found, [Path::new(CONVERSION)]);
    for line in [
        "fn seen(record: &Record) {",
        "use ros2probe_wire::record::{Verdict, flag};",
    ] {
        assert!(names_record(line), "{line}");
    }
    for line in ["// Record", "use ros2probe_wire::record::Verdict;"] {
        assert!(!names_record(line), "{line}");
    }
}

#[test]
fn an_import_upwards_and_a_cycle_are_reported() {
    let module = |path: &str| {
        let (layer, name) = path.split_once("::").unwrap();
        (layer.to_owned(), name.to_owned())
    };
    let source = "\
// crate::observe::observer
use crate::observe::observer::Observer;
pub(crate) fn new(writer: crate::measure::writer::Writer) {}
macro_rules! none { () => { crate::tables! {} } }
";
    let imported = imports(source);
    let expected = [module("measure::writer"), module("observe::observer")];
    assert_eq!(imported, BTreeSet::from(expected));
    let modules = BTreeMap::from([
        (module("facts::names"), BTreeSet::new()),
        (module("measure::topic"), imported),
        (
            module("measure::writer"),
            BTreeSet::from([module("measure::topic")]),
        ),
        (
            module("observe::observer"),
            BTreeSet::from([module("facts::names")]),
        ),
    ]);
    assert_eq!(
        mistakes(&modules),
        [
            "measure::topic imports observe::observer, which is above it",
            "in a cycle: measure::topic, measure::writer",
        ]
    );
}
