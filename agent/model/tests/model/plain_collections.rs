//! Fields that can grow: each is a `Bounded`, or `plain_collections.txt` states why it need not be.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Reasons, each after a `#`, followed by the files or fields to which it applies.
const EXCEPTIONS: &str = include_str!("plain_collections.txt");
/// Sources to check. Of the command line, only modules that read foreign bytes or this host.
const PLACES: [&str; 10] = [
    "wire/src",
    "agent/model/src",
    "agent/capture/src",
    "agent/metrics/src",
    "agent/daemon/src",
    "agent/cli/src/chain/bag.rs",
    "agent/cli/src/client/line_reader.rs",
    "agent/cli/src/client/replay_agent.rs",
    "agent/cli/src/discover",
    "agent/cli/src/doctor/cgroup.rs",
];
const GROWING: [&str; 9] = [
    "BTreeMap<",
    "BTreeSet<",
    "BinaryHeap<",
    "BytesMut",
    "HashMap<",
    "HashSet<",
    "String",
    "Vec<",
    "VecDeque<",
];

/// Returns whether this type can grow without the bound of a declaration.
fn is_plain(of: &str) -> bool {
    let words = of.split(|character: char| !character.is_alphanumeric() && character != '<');
    // `Foo<Vec<u8>>` becomes `Foo<Vec<u8`.
    let mut names = words.flat_map(|word| word.split_inclusive('<'));
    let is_bounded = ["Bounded<", "ByOwner<", "MapData"];
    names.any(|name| GROWING.contains(&name)) && !is_bounded.iter().any(|name| of.contains(name))
}

/// Returns the plain fields of the structs, enums and aliases in a source, as `Type.field`.
fn plain_fields(source: &str) -> BTreeSet<String> {
    let source = source.split("#[cfg(test)]").next().unwrap();
    let lines = source.lines().map(str::trim_end);
    let lines = lines.filter(|line| !line.trim_start().starts_with("//"));
    let mut found = BTreeSet::new();
    let (mut owner, mut field) = (String::new(), String::new());
    for line in lines {
        let words: Vec<_> = line.split([' ', '<', '(', '{', ';']).collect();
        let place = words
            .iter()
            .position(|word| ["struct", "enum", "type"].contains(word));
        let place = place.filter(|_| !line.starts_with("    "));
        if let Some(name) = place.and_then(|place| words.get(place + 1)) {
            (owner, field) = ((*name).to_owned(), String::new());
            if line.ends_with(';') && is_plain(line) {
                found.insert(owner.clone());
            }
        } else if line.starts_with('}') || line.starts_with("impl") || line.contains("fn ") {
            owner.clear();
        } else if !owner.is_empty() && !line.trim_start().starts_with('#') {
            field = format!("{field} {}", line.trim_start());
            if line.ends_with(',') {
                let (name, of) = field.split_once(": ").unwrap_or(("0", &field));
                let name = name.rsplit(' ').next().unwrap();
                if is_plain(of) {
                    found.insert(format!("{owner}.{name}"));
                }
                field.clear();
            } else if line.ends_with('{') {
                field.clear();
            }
        }
    }
    found
}

fn sources(path: &Path, each: &mut dyn FnMut(&Path)) {
    if path.is_dir() {
        for entry in fs::read_dir(path).unwrap() {
            sources(&entry.unwrap().path(), each);
        }
    } else if path.extension().is_some_and(|extension| extension == "rs") {
        each(path);
    }
}

#[test]
fn every_field_that_can_grow_is_bounded_or_has_a_reason() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut found = BTreeMap::new();
    for place in PLACES {
        let place = root.join(place);
        assert!(place.exists(), "{}", place.display());
        sources(&place, &mut |path| {
            let name = path.strip_prefix(&root).unwrap().to_str().unwrap();
            let is_test = name.ends_with("tests.rs") || name.contains("/tests/");
            let fields = plain_fields(&fs::read_to_string(path).unwrap());
            if !is_test && !fields.is_empty() {
                found.insert(name.to_owned(), fields);
            }
        });
    }
    assert!(found.len() > 50, "{found:#?}");
    for line in EXCEPTIONS.lines().filter(|line| !line.starts_with('#')) {
        let mut words = line.split_whitespace();
        let Some(path) = words.next() else { continue };
        let fields = found.get_mut(path);
        let fields = fields.unwrap_or_else(|| panic!("{path} has no plain field: remove its line"));
        let mut is_whole = true;
        for field in words {
            is_whole = false;
            assert!(
                fields.remove(field),
                "{path} has no plain {field}: remove it"
            );
        }
        if is_whole {
            fields.clear();
        }
    }
    found.retain(|_, fields| !fields.is_empty());
    assert!(
        found.is_empty(),
        "declare these in a `tables.rs`, or state a reason in plain_collections.txt: {found:#?}"
    );
}

#[test]
fn plain_fields_are_found_in_structs_enums_and_aliases() {
    let source = "\
pub struct Known {
    /// Vec<u8>
    pub(super) bytes: Vec<u8>,
    bounded: Bounded<Table, HashMap<u32, Vec<u8>>>,
    wrapped:
        Option<Arc<BTreeMap<u32, u8>>>,
    number: u64,
}
struct Tuple(Vec<u8>);
type Alias = HashMap<u32, u8>;
enum Event {
    Named {
        text: String,
    },
    Tuple(VecDeque<u8>),
    Nothing,
}
impl Known {
    const TEXT: &str = \"texts: Vec<u8>,\";
}
";
    let found: Vec<_> = plain_fields(source).into_iter().collect();
    let expected = [
        "Alias",
        "Event.0",
        "Event.text",
        "Known.bytes",
        "Known.wrapped",
        "Tuple",
    ];
    assert_eq!(found, expected);
}
