//! Embedded definitions: the common interface packages, without their comments.
//!
//! Plain text, one file per package; `embedded/README.md` names their origin, licences and format.
//! A definition is parsed only on request.

use crate::definition::{Kind, TypeName};
use crate::dialect::Dialect;

/// Prefix of a definition's heading.
const HEADING: &str = "== ";

const PACKAGES: [(&str, &str); 26] = [
    ("action_msgs", include_str!("embedded/action_msgs.txt")),
    (
        "action_tutorials_interfaces",
        include_str!("embedded/action_tutorials_interfaces.txt"),
    ),
    (
        "actionlib_msgs",
        include_str!("embedded/actionlib_msgs.txt"),
    ),
    (
        "builtin_interfaces",
        include_str!("embedded/builtin_interfaces.txt"),
    ),
    (
        "composition_interfaces",
        include_str!("embedded/composition_interfaces.txt"),
    ),
    (
        "diagnostic_msgs",
        include_str!("embedded/diagnostic_msgs.txt"),
    ),
    (
        "example_interfaces",
        include_str!("embedded/example_interfaces.txt"),
    ),
    ("geometry_msgs", include_str!("embedded/geometry_msgs.txt")),
    (
        "lifecycle_msgs",
        include_str!("embedded/lifecycle_msgs.txt"),
    ),
    ("nav_msgs", include_str!("embedded/nav_msgs.txt")),
    (
        "rcl_interfaces",
        include_str!("embedded/rcl_interfaces.txt"),
    ),
    (
        "rmw_dds_common",
        include_str!("embedded/rmw_dds_common.txt"),
    ),
    (
        "rosbag2_interfaces",
        include_str!("embedded/rosbag2_interfaces.txt"),
    ),
    ("rosgraph_msgs", include_str!("embedded/rosgraph_msgs.txt")),
    ("sensor_msgs", include_str!("embedded/sensor_msgs.txt")),
    ("service_msgs", include_str!("embedded/service_msgs.txt")),
    ("shape_msgs", include_str!("embedded/shape_msgs.txt")),
    (
        "statistics_msgs",
        include_str!("embedded/statistics_msgs.txt"),
    ),
    ("std_msgs", include_str!("embedded/std_msgs.txt")),
    ("std_srvs", include_str!("embedded/std_srvs.txt")),
    ("stereo_msgs", include_str!("embedded/stereo_msgs.txt")),
    ("tf2_msgs", include_str!("embedded/tf2_msgs.txt")),
    (
        "trajectory_msgs",
        include_str!("embedded/trajectory_msgs.txt"),
    ),
    (
        "type_description_interfaces",
        include_str!("embedded/type_description_interfaces.txt"),
    ),
    (
        "unique_identifier_msgs",
        include_str!("embedded/unique_identifier_msgs.txt"),
    ),
    (
        "visualization_msgs",
        include_str!("embedded/visualization_msgs.txt"),
    ),
];

/// One definition.
#[derive(Debug, Clone, Copy)]
struct Embedded {
    kind: Kind,
    name: &'static str,
    /// The distributions with this definition, separated by spaces; empty if all have it.
    distributions: &'static str,
    text: &'static str,
}

/// Returns the text of a file in a distribution, if it is embedded.
pub(super) fn find(file: &TypeName, dialect: Dialect) -> Option<&'static str> {
    let (_, text) = PACKAGES
        .iter()
        .find(|(package, _)| *package == file.package())?;
    let wanted =
        |one: &Embedded| one.kind == file.kind() && one.name == file.name() && one.is_of(dialect);
    definitions(text).find(wanted).map(|one| one.text)
}

impl Embedded {
    fn is_of(&self, dialect: Dialect) -> bool {
        let mut distributions = self.distributions.split(' ');
        self.distributions.is_empty() || distributions.any(|one| one == dialect.name())
    }
}

/// Iterates over the definitions of a package.
fn definitions(text: &'static str) -> impl Iterator<Item = Embedded> {
    let mut rest = text;
    std::iter::from_fn(move || {
        let (heading, behind) = rest.strip_prefix(HEADING)?.split_once('\n')?;
        // An empty line separates two definitions.
        let (text, next) = match behind.find("\n== ") {
            Some(end) => (behind.get(..end)?, behind.get(end + 1..)?),
            None => (behind, ""),
        };
        rest = next;
        let (name, distributions) = heading.split_once(' ').unwrap_or((heading, ""));
        let (kind, name) = name.split_once('/')?;
        let kind = [Kind::Action, Kind::Message, Kind::Service]
            .into_iter()
            .find(|one| one.as_str() == kind)?;
        Some(Embedded {
            kind,
            name,
            distributions,
            text,
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use super::*;
    use crate::definition::Definition;
    use crate::{Library, NotFound, Sources};

    const HASHES: &str = include_str!("../../testing/data/message/type_hashes.txt");
    const ANNOUNCED: &str = include_str!("../../testing/data/message/announced.txt");
    const SCHEMAS: &str = include_str!("../../testing/data/message/schemas.txt");
    const DIALECTS: [(&str, Dialect); 4] = [
        ("humble", Dialect::Humble),
        ("jazzy", Dialect::Jazzy),
        ("kilted", Dialect::Kilted),
        ("rolling", Dialect::Rolling),
    ];

    /// Returns a library with the embedded definitions only.
    fn library(dialect: Dialect) -> Library {
        Library::new(Sources {
            dialect,
            ..Sources::default()
        })
    }

    fn all() -> impl Iterator<Item = (TypeName, Embedded)> {
        PACKAGES.iter().flat_map(|(package, text)| {
            definitions(text).map(|one| (TypeName::new(package, one.kind, one.name).unwrap(), one))
        })
    }

    #[test]
    fn every_heading_is_read_and_no_definition_has_comments() {
        let headings: usize = PACKAGES
            .iter()
            .map(|(_, text)| text.lines().filter(|line| line.starts_with('=')).count())
            .sum();
        assert_eq!(all().count(), headings);
        assert!(PACKAGES.is_sorted_by(|(before, _), (after, _)| before < after));
        for (name, one) in all() {
            assert!(!one.text.contains('#'), "{name}");
            assert!(one.text.is_empty() || one.text.ends_with('\n'), "{name}");
            assert!(!one.text.contains("\n\n"), "{name}");
        }
    }

    #[test]
    fn a_distribution_has_each_type_once() {
        for (_, dialect) in DIALECTS {
            let mut seen = BTreeSet::new();
            for (name, one) in all().filter(|(_, one)| one.is_of(dialect)) {
                assert!(seen.insert(name.clone()), "{name} twice in {dialect:?}");
                assert_eq!(find(&name, dialect), Some(one.text));
            }
            assert_eq!(
                seen.len(),
                all().map(|(name, _)| name).collect::<BTreeSet<_>>().len()
            );
        }
    }

    #[test]
    fn every_type_is_found_by_its_hash_in_any_dialect() {
        for line in HASHES.lines().chain(ANNOUNCED.lines()) {
            let mut words = line.split(' ');
            let (name, hash) = (words.next().unwrap(), words.next().unwrap());
            for (_, dialect) in DIALECTS {
                let found = library(dialect).find(name, Some(hash)).unwrap();
                assert_eq!(
                    (found.root.to_string().as_str(), found.type_hash().as_str()),
                    (name, hash)
                );
            }
        }
    }

    #[test]
    fn without_a_hash_the_dialects_own_definition_is_used() {
        let libraries = DIALECTS.map(|(distribution, dialect)| (distribution, library(dialect)));
        let mut hashes: BTreeMap<&str, usize> = BTreeMap::new();
        for line in HASHES.lines() {
            let words: Vec<_> = line.split(' ').collect();
            let [name, hash, of @ ..] = words.as_slice() else {
                panic!("{line}")
            };
            for (distribution, library) in &libraries {
                if of.is_empty() || of.contains(distribution) {
                    assert_eq!(
                        library.find(name, None).unwrap().type_hash(),
                        *hash,
                        "{line}"
                    );
                    *hashes.entry(name).or_default() += 1;
                }
            }
        }
        assert!(hashes.values().all(|count| *count == DIALECTS.len()));
        // Definitions without a reference hash must be complete, too.
        for (name, one) in all() {
            let definition = Definition::parse(name.clone(), one.text).unwrap();
            for structure in &definition.structures {
                let name = structure.name.to_string();
                assert!(
                    hashes.contains_key(name.as_str()) || name == "example_interfaces/msg/WString",
                    "{name}"
                );
            }
        }
        libraries.iter().for_each(|(_, library)| {
            library
                .find("example_interfaces/msg/WString", None)
                .unwrap();
        });
    }

    #[test]
    fn schemas_have_the_parts_of_a_real_bags_schemas_in_the_same_order() {
        let library = library(Dialect::Humble);
        let mut count = 0;
        for schema in SCHEMAS.split("@ ").skip(1) {
            let (name, expected) = schema.split_once('\n').unwrap();
            let (encoding, text) = library.find(name, None).unwrap().schema_text();
            assert_eq!(encoding, "ros2msg");
            let constant = |line: &str| line.contains('=') && !line.starts_with('=');
            let lines = text
                .lines()
                .filter(|line| !line.is_empty() && !constant(line));
            assert_eq!(
                lines.collect::<Vec<_>>(),
                expected.lines().collect::<Vec<_>>(),
                "{name}"
            );
            count += 1;
        }
        assert_eq!(count, 7);
    }

    #[test]
    fn a_hash_that_no_variant_has_is_refused_with_the_hash_of_an_embedded_one() {
        let announced = format!("RIHS01_{}", "0".repeat(64));
        let failure = library(Dialect::Jazzy).find("std_msgs/msg/String", Some(&announced));
        let failure = failure.unwrap_err();
        assert!(matches!(failure, NotFound::OtherDefinition { .. }));
        assert_eq!(
            failure.to_string(),
            format!(
                "the definition of std_msgs/msg/String built into ros2probe differs from the \
                 nodes': its hash is \
                 RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18, theirs \
                 {announced}; install their version of std_msgs, or name a directory that has it \
                 with --definitions"
            )
        );
    }
}
