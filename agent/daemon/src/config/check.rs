//! Compares a document with the schema, and reports every difference with its position.
//!
//! serde stops at its first error, but an operator needs all of them. The schema is the generated
//! one (see `shape`), so names, types and ranges are declared once. Only the JSON Schema keywords
//! that schemars emits for these shapes are supported.

use serde_json::Value;

use super::document::{Content, Key, Node, Scalar, item_path, key_path};
use super::mistake::Mistakes;
use super::text::check_text;

/// Common wrong keys and their correct names: former names first, then likely guesses.
const COMMON_MISTAKES: &[(&str, &str)] = &[
    ("watchlist", "watch"),
    ("watches", "watch"),
    ("topic_grace", "topic_grace_s"),
    ("log_level", "log"),
    ("name", "topic"),
    ("domain_id", "domain"),
    ("min_hz", "min_rate_hz"),
    ("max_hz", "max_rate_hz"),
    ("max_loss", "max_loss_ratio"),
    ("max_delay_ms", "max_latency_ms"),
    ("timeout_s", "max_silence_s"),
    ("min_publishers", "publishers"),
    ("min_subscribers", "subscribers"),
    ("subscriptions", "subscribers"),
    ("address", "listen"),
    ("port", "listen"),
];

/// Adds the mistakes of `node` at `path` under `schema`; `root` holds the definitions.
pub(super) fn check(node: &Node, path: &str, schema: &Value, root: &Value, found: &mut Mistakes) {
    let schema = resolve(schema, root);
    if any_of(schema).is_some() {
        let choices = choices(schema, root);
        match choices.iter().find(|choice| allows(choice, node)) {
            Some(choice) => check(node, path, choice, root, found),
            None => {
                let expected: Vec<_> = choices.into_iter().flat_map(expected).collect();
                wrong_kind(node, path, &expected, found);
            }
        }
        return;
    }
    if !allows(schema, node) {
        wrong_kind(node, path, &expected(schema), found);
        return;
    }
    match &node.content {
        Content::Scalar { text, .. } => check_scalar(node, text, path, schema, found),
        Content::List(items) => {
            if let Some(schema) = schema.get("items") {
                for (index, item) in items.iter().enumerate() {
                    check(item, &item_path(path, index), schema, root, found);
                }
            }
        }
        Content::Map(entries) => check_map(node, entries, path, schema, root, found),
    }
}

fn check_map(
    node: &Node,
    entries: &[(Key, Node)],
    path: &str,
    schema: &Value,
    root: &Value,
    found: &mut Mistakes,
) {
    let properties = schema.get("properties").and_then(Value::as_object);
    let known = || {
        properties
            .into_iter()
            .flat_map(|all| all.keys().map(String::as_str))
    };
    for (key, value) in entries {
        let path = key_path(path, &key.name);
        let own = properties.and_then(|all| all.get(&key.name));
        // The operator chooses the keys of this map.
        let any = schema
            .get("additionalProperties")
            .filter(|any| any.is_object());
        match own.or(any) {
            Some(schema) => check(value, &path, schema, root, found),
            None => found.add(key.position, &path, unknown_key(&key.name, known())),
        }
    }
    for required in schema
        .get("required")
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
    {
        let Some(name) = required.as_str() else {
            continue;
        };
        if !entries.iter().any(|(key, _)| key.name == name) {
            found.add(node.position, path, format!("the key `{name}` is missing"));
        }
    }
}

fn check_scalar(node: &Node, text: &str, path: &str, schema: &Value, found: &mut Mistakes) {
    let number = match node.scalar() {
        #[expect(clippy::cast_precision_loss, reason = "ranges are far below 2^53")]
        Some(Scalar::Integer(value)) => value as f64,
        Some(Scalar::Number(value)) => value,
        Some(Scalar::Text) => {
            let words: Vec<&str> = words(schema).collect();
            if !words.is_empty() && !words.contains(&text) {
                let message = format!(
                    "is {}, must be one of {}",
                    node.describe(),
                    words.join(", ")
                );
                found.add(node.position, path, message);
            } else if let Err(error) = check_text(path, text) {
                found.add(node.position, path, error.to_string());
            }
            return;
        }
        _ => return,
    };
    let limit = |name| schema.get(name).and_then(Value::as_f64);
    let (minimum, maximum) = (limit("minimum"), limit("maximum"));
    let fits = minimum.is_none_or(|low| number >= low) && maximum.is_none_or(|high| number <= high);
    if !fits || number.is_nan() {
        let range = match (minimum, maximum) {
            (Some(low), Some(high)) => format!("between {low} and {high}"),
            (Some(low), None) => format!("at least {low}"),
            (None, Some(high)) => format!("at most {high}"),
            (None, None) => "a finite number".to_owned(),
        };
        found.add(node.position, path, format!("is {text}, must be {range}"));
    }
}

fn wrong_kind(node: &Node, path: &str, expected: &[String], found: &mut Mistakes) {
    let message = format!("is {}, must be {}", node.describe(), expected.join(" or "));
    found.add(node.position, path, message);
}

fn unknown_key<'a>(name: &str, known: impl Iterator<Item = &'a str> + Clone) -> String {
    let has = |key: &&str| known.clone().any(|other| other == *key);
    let renamed = COMMON_MISTAKES
        .iter()
        .filter(|(old, _)| *old == name)
        .map(|(_, new)| *new)
        .find(has);
    if let Some(new) = renamed {
        return format!("unknown key; use `{new}`");
    }
    let near = known
        .clone()
        .map(|key| (distance(name, key), key))
        .filter(|(distance, key)| *distance <= 1 + key.len() / 4)
        .min();
    match near {
        Some((_, key)) => format!("unknown key; did you mean `{key}`?"),
        None => format!(
            "unknown key; known keys: {}",
            known.collect::<Vec<_>>().join(", ")
        ),
    }
}

fn resolve<'a>(schema: &'a Value, root: &'a Value) -> &'a Value {
    let name = schema
        .get("$ref")
        .and_then(Value::as_str)
        .and_then(|path| path.rsplit('/').next());
    name.and_then(|name| root.get("$defs")?.get(name))
        .unwrap_or(schema)
}

fn any_of(schema: &Value) -> Option<&Vec<Value>> {
    schema.get("anyOf").and_then(Value::as_array)
}

/// Returns the alternatives of a schema; an optional value with alternatives nests them.
fn choices<'a>(schema: &'a Value, root: &'a Value) -> Vec<&'a Value> {
    let schema = resolve(schema, root);
    match any_of(schema) {
        Some(all) => all
            .iter()
            .flat_map(|choice| choices(choice, root))
            .collect(),
        None => vec![schema],
    }
}

/// Returns the JSON types that a schema allows.
fn kinds(schema: &Value) -> Vec<&str> {
    match schema.get("type") {
        Some(Value::String(kind)) => vec![kind.as_str()],
        Some(Value::Array(kinds)) => kinds.iter().filter_map(Value::as_str).collect(),
        _ if words(schema).next().is_some() => vec!["string"],
        _ => Vec::new(),
    }
}

fn allows(schema: &Value, node: &Node) -> bool {
    let kinds = kinds(schema);
    let any = |names: &[&str]| names.iter().any(|name| kinds.contains(name));
    match (&node.content, node.scalar()) {
        (Content::List(_), _) => any(&["array"]),
        (Content::Map(_), _) => any(&["object"]),
        (_, Some(Scalar::Null)) => any(&["null"]),
        (_, Some(Scalar::Boolean)) => any(&["boolean"]),
        (_, Some(Scalar::Integer(_))) => any(&["integer", "number"]),
        (_, Some(Scalar::Number(_))) => any(&["number"]),
        (_, Some(Scalar::Text) | None) => any(&["string"]),
    }
}

/// Returns the names of the allowed kinds, with the words of an enumeration. Empty sections are
/// always allowed and not listed.
fn expected(schema: &Value) -> Vec<String> {
    let listed: Vec<_> = words(schema).collect();
    let words = |kind: &&str| match *kind {
        "array" => Some("a list".to_owned()),
        "object" => Some("a map of keys".to_owned()),
        "boolean" => Some("true or false".to_owned()),
        "integer" => Some("a whole number".to_owned()),
        "number" => Some("a number".to_owned()),
        "string" if listed.is_empty() => Some("text".to_owned()),
        "string" => Some(format!("one of {}", listed.join(", "))),
        _ => None,
    };
    kinds(schema).iter().filter_map(words).collect()
}

/// Returns the values of an enumeration.
fn words(schema: &Value) -> impl Iterator<Item = &str> {
    let listed = schema
        .get("enum")
        .and_then(Value::as_array)
        .into_iter()
        .flatten();
    let described = schema
        .get("oneOf")
        .and_then(Value::as_array)
        .into_iter()
        .flatten();
    listed
        .chain(described.filter_map(|choice| choice.get("const")))
        .filter_map(Value::as_str)
}

/// Returns the edit distance of two words; words with the same letters in another order have
/// distance one.
fn distance(one: &str, other: &str) -> usize {
    if one != other && sorted(one) == sorted(other) {
        return 1;
    }
    let other: Vec<char> = other.chars().collect();
    let mut row: Vec<usize> = (0..=other.len()).collect();
    for (i, a) in one.chars().take(64).enumerate() {
        let mut next = vec![i + 1];
        for (j, b) in other.iter().enumerate() {
            let at =
                |row: &[usize], index: usize| row.get(index).copied().unwrap_or(usize::MAX / 2);
            let change = at(&row, j) + usize::from(a != *b);
            next.push(change.min(at(&row, j + 1) + 1).min(at(&next, j) + 1));
        }
        row = next;
    }
    row.last().copied().unwrap_or(usize::MAX)
}

fn sorted(word: &str) -> Vec<char> {
    let mut letters: Vec<char> = word.chars().collect();
    letters.sort_unstable();
    letters
}
