//! Sources of definitions, in order: named directories, an installed ROS, embedded definitions,
//! descriptions from nodes.
//!
//! Two machines may have different definitions of one name. If discovery announces a type's hash,
//! the definition must match it, whichever source has it; a mismatching one is never used.

pub(crate) mod definition_source;
mod described;
mod kept;
mod objects;
pub(crate) mod search;

use std::collections::HashMap;
use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use ros2probe_wire::discovery::EquivalenceHash;

use crate::definition::parse::ParseError;
use crate::definition::{MessageType, NotClosed, TypeName};
use crate::dialect::Dialect;
use crate::library::definition_source::DefinitionSource;
pub use crate::library::described::DescribedFigures;
use crate::library::described::{Described, NotSent, TypeSource};
use crate::library::search::Search;
use crate::type_object::NotUsable;

/// Directory of ROS installations, one subdirectory per distribution.
const ROS_PREFIX: &str = "/opt/ros";
/// Maximum number of sources searched: a workspace installed package by package has hundreds.
pub(super) const MAX_SOURCES: usize = 1024;
/// Maximum number of cached types, and maximum size of their text in bytes.
const MAX_KEPT: usize = 1024;
const MAX_KEPT_TEXT: usize = 32 << 20;
/// Prefix of type hashes of the only known version.
const HASH_PREFIX: &str = "RIHS01_";

/// Sources to search, in this order.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// Directories named by the user: `DIR/package/msg/Type.msg`, also below `DIR/share`.
    pub directories: Vec<PathBuf>,
    /// Prefixes of an installed ROS: `PREFIX/share/package/msg/Type.msg`.
    pub prefixes: Vec<PathBuf>,
    /// Distribution to prefer if definitions differ and no hash is announced.
    pub dialect: Dialect,
}

impl Sources {
    /// Returns the named directories, those of `AMENT_PREFIX_PATH`, then the installations in
    /// `/opt/ros`, the dialect's distribution first.
    pub fn new(
        directories: Vec<PathBuf>,
        ament_prefix_path: Option<&OsStr>,
        dialect: Dialect,
    ) -> Self {
        let mut prefixes: Vec<PathBuf> = ament_prefix_path
            .map(|paths| {
                std::env::split_paths(paths)
                    .filter(|path| path.is_absolute())
                    .collect()
            })
            .unwrap_or_default();
        for prefix in installed(Path::new(ROS_PREFIX), dialect) {
            if !prefixes.contains(&prefix) {
                prefixes.push(prefix);
            }
        }
        Self {
            directories,
            prefixes,
            dialect,
        }
    }
}

/// Returns the distributions in a directory: the dialect's first, then the others, newest first.
fn installed(directory: &Path, dialect: Dialect) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(directory) else {
        return Vec::new();
    };
    let of = |path: &PathBuf| path.file_name()?.to_str().and_then(Dialect::of_distro);
    let mut found: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .take(MAX_SOURCES)
        .collect();
    found.sort_by(|a, b| b.cmp(a));
    found.sort_by_key(|path| of(path) != Some(dialect));
    found
}

/// Finds definitions and caches the types found.
#[derive(Debug)]
pub struct Library {
    definition_sources: Vec<DefinitionSource>,
    kept: Mutex<CachedDefinition>,
    described: Described,
    /// Number of descriptions so far.
    revision: AtomicU64,
}

#[derive(Debug, Default)]
struct CachedDefinition {
    types: HashMap<(TypeName, Option<String>), Arc<MessageType>>,
    text: usize,
}

/// Why no usable definition was found.
#[derive(Debug, Clone, thiserror::Error)]
pub enum NotFound {
    /// The name is not a type's name.
    #[error("`{0}` is not a type name such as std_msgs/msg/String")]
    NotATypeName(String),
    /// No source has the type, or a nested type is missing.
    #[error(
        "no definition of {missing}{} here: install the package {}, or name a directory that has \
         {}/{}/{}.{} with --definitions",
        of(missing, root),
        missing.package(), missing.package(), missing.kind().as_str(), file_name(missing),
        missing.kind().as_str()
    )]
    Nowhere {
        /// The missing type.
        missing: TypeName,
        /// The requested type.
        root: TypeName,
    },
    /// Definitions exist, but none matches the announced hash.
    #[error(
        "the definition of {name} {location} differs from the nodes': its hash is {found}, \
         theirs {announced}; install their version of {}, or name a directory that has it with \
         --definitions",
        name.package()
    )]
    OtherDefinition {
        /// Name of the type.
        name: TypeName,
        /// Source of the first definition found.
        location: String,
        /// Hash of that definition.
        found: String,
        /// Hash announced by discovery.
        announced: String,
    },
    /// A file contains an invalid definition.
    #[error("{}: {mistake}", path.display())]
    Mistake {
        /// Path of the file.
        path: PathBuf,
        /// The mistake in the file.
        mistake: ParseError,
    },
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: Arc<io::Error>,
    },
    /// The type is recursive or too large.
    #[error("{root} cannot be used: {reason}")]
    Refused {
        /// The requested type.
        root: TypeName,
        /// Why it is rejected.
        reason: NotClosed,
    },
    /// The type has no definition here, and the one that nodes sent cannot be used.
    #[error(
        "no definition of {root} here, and the one that the nodes sent cannot be used: {reason}"
    )]
    NotUsable {
        /// The requested type.
        root: TypeName,
        /// Why it cannot be used.
        reason: NotUsable,
    },
}

/// Returns ` (part of X)` unless the missing type is the requested one.
fn of(missing: &TypeName, root: &TypeName) -> String {
    if missing == root {
        String::new()
    } else {
        format!(" (part of {root})")
    }
}

/// Returns the name of the file that defines a type.
fn file_name(name: &TypeName) -> String {
    name.files().last().unwrap_or(name).name().to_owned()
}

impl Library {
    /// Creates a library over these sources.
    pub fn new(sources: Sources) -> Self {
        let Sources {
            directories,
            prefixes,
            dialect,
        } = sources;
        let mut definition_sources: Vec<_> = directories
            .into_iter()
            .map(DefinitionSource::Directory)
            .chain(prefixes.into_iter().map(DefinitionSource::Prefix))
            .take(MAX_SOURCES)
            .collect();
        definition_sources.push(DefinitionSource::Embedded(dialect));
        let others = [
            Dialect::Rolling,
            Dialect::Kilted,
            Dialect::Jazzy,
            Dialect::Humble,
        ];
        let others = others.into_iter().filter(|other| *other != dialect);
        definition_sources.extend(others.map(DefinitionSource::Embedded));
        Self {
            definition_sources,
            kept: Mutex::default(),
            described: Described::default(),
            revision: AtomicU64::new(0),
        }
    }

    /// Returns the type of a name: with an announced RIHS01 hash, the first definition that matches
    /// it; otherwise the first definition. With a hash of XTypes, only a type that nodes sent can
    /// be compared: it is used if no file defines the type. Other hashes are ignored.
    pub fn find(
        &self,
        name: &str,
        announced_hash: Option<&str>,
    ) -> Result<Arc<MessageType>, NotFound> {
        let root: TypeName = name
            .parse()
            .map_err(|_| NotFound::NotATypeName(name.to_owned()))?;
        let announced = announced_hash
            .filter(|hash| hash.starts_with(HASH_PREFIX))
            .map(str::to_owned);
        let equivalence = announced_hash.filter(|hash| EquivalenceHash::parse(hash).is_some());
        let key = (root, announced);
        let kept = self
            .kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .types
            .get(&key)
            .cloned();
        if let Some(found) = kept {
            return Ok(found);
        }
        match Search::new(&self.definition_sources, &key.0).run(key.1.as_deref()) {
            Ok(found) => {
                let found = Arc::new(found);
                self.keep(key, found.clone());
                Ok(found)
            }
            Err(reason) => {
                let announced = key.1.as_deref().or(equivalence);
                self.find_described(&key.0, announced, reason)
            }
        }
    }

    /// Returns the type as a node described it. Fails with `reason` if no source has the type.
    fn find_described(
        &self,
        name: &TypeName,
        announced: Option<&str>,
        reason: NotFound,
    ) -> Result<Arc<MessageType>, NotFound> {
        let failure = match self.described.find(name, announced) {
            Ok(found) => return Ok(found),
            Err(failure) => failure,
        };
        Err(match (failure, reason) {
            (NotSent::Another(found), NotFound::Nowhere { .. }) => NotFound::OtherDefinition {
                name: name.clone(),
                location: "that a node described".to_owned(),
                found,
                announced: announced.unwrap_or_default().to_owned(),
            },
            (NotSent::NotUsable(reason), NotFound::Nowhere { .. }) => NotFound::NotUsable {
                root: name.clone(),
                reason,
            },
            (_, reason) => reason,
        })
    }

    /// Offers the response of a node's service `get_type_description`, a payload that begins with
    /// its encapsulation header. It is read when a lookup finds no definition elsewhere.
    pub fn offer(&self, response: Arc<[u8]>) {
        self.described.offer(TypeSource::Description(response));
        self.revision.fetch_add(1, Ordering::Release);
    }

    /// Offers a reply of the TypeLookup service of XTypes, in the same form.
    pub fn offer_objects(&self, reply: Arc<[u8]>) {
        self.described.offer(TypeSource::TypeObjects(reply));
        self.revision.fetch_add(1, Ordering::Release);
    }

    /// Adds a type from another library, under its hash of XTypes if the writer announces no RIHS01
    /// hash.
    pub fn add(&self, message_type: MessageType, hash: Option<EquivalenceHash>) {
        self.described.add(message_type, hash);
        self.revision.fetch_add(1, Ordering::Release);
    }

    /// Returns a number that increases when a lookup that failed may succeed.
    pub fn revision(&self) -> u64 {
        self.revision.load(Ordering::Acquire)
    }

    /// Returns the counts of descriptions.
    pub fn described_figures(&self) -> DescribedFigures {
        self.described.figures()
    }

    fn keep(&self, key: (TypeName, Option<String>), found: Arc<MessageType>) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let text = found
            .definitions
            .values()
            .map(|definition| definition.text.len())
            .sum::<usize>();
        if kept.types.len() >= MAX_KEPT || kept.text + text > MAX_KEPT_TEXT {
            *kept = CachedDefinition::default();
        }
        kept.text += text;
        kept.types.insert(key, found);
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use tempfile::TempDir;

    use super::*;
    use crate::definition::parse::MAX_TEXT;

    /// Creates an installed ROS with these files, each a path such as `a/msg/B.msg` and its text.
    fn prefix(files: &[(&str, &str)]) -> TempDir {
        let directory = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = directory.path().join("share").join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        directory
    }

    fn library(prefixes: &[&TempDir]) -> Library {
        let prefixes = prefixes
            .iter()
            .map(|prefix| prefix.path().to_owned())
            .collect();
        Library::new(Sources {
            prefixes,
            ..Sources::default()
        })
    }

    fn hash(name: &str, prefixes: &[&TempDir]) -> String {
        library(prefixes).find(name, None).unwrap().type_hash()
    }

    #[test]
    fn the_first_source_wins_unless_another_has_the_announced_hash() {
        let old = prefix(&[("a/msg/B.msg", "int8 x")]);
        let new = prefix(&[("a/msg/B.msg", "int8 x\nint8 y")]);
        let (old_hash, new_hash) = (hash("a/msg/B", &[&old]), hash("a/msg/B", &[&new]));
        assert_ne!(old_hash, new_hash);
        let library = library(&[&old, &new]);
        assert_eq!(library.find("a/msg/B", None).unwrap().type_hash(), old_hash);
        for hash in [&new_hash, &old_hash, &new_hash] {
            assert_eq!(
                library.find("a/msg/B", Some(hash)).unwrap().type_hash(),
                *hash
            );
        }
        // A hash of an unknown version is ignored.
        let found = library.find("a/msg/B", Some("RIHS02_00")).unwrap();
        assert_eq!(found.type_hash(), old_hash);
    }

    #[test]
    fn a_named_directory_precedes_an_installation_and_needs_no_share() {
        let installed = prefix(&[("a/msg/B.msg", "int8 x")]);
        for share in ["", "share"] {
            let named = tempfile::tempdir().unwrap();
            let package = named.path().join(share).join("a/msg");
            fs::create_dir_all(&package).unwrap();
            fs::write(package.join("B.msg"), "int16 y").unwrap();
            let library = Library::new(Sources {
                directories: vec![named.path().to_owned()],
                prefixes: vec![installed.path().to_owned()],
                dialect: Dialect::Humble,
            });
            let found = library.find("a/msg/B", None).unwrap();
            assert_eq!(
                found
                    .structure(&found.root)
                    .unwrap()
                    .fields
                    .first()
                    .unwrap()
                    .name,
                "y"
            );
        }
    }

    #[test]
    fn nested_types_are_read_from_another_source_if_the_hash_matches() {
        let workspace = prefix(&[("w/msg/W.msg", "a/B b\nstd_msgs/Header header")]);
        let below = prefix(&[("a/msg/B.msg", "int8 x")]);
        let nodes = prefix(&[("a/msg/B.msg", "int16 x")]);
        let announced = hash("w/msg/W", &[&workspace, &nodes]);
        assert_ne!(announced, hash("w/msg/W", &[&workspace, &below]));
        let library = library(&[&workspace, &below, &nodes]);
        let found = library.find("w/msg/W", Some(&announced)).unwrap();
        assert_eq!(found.type_hash(), announced);
        // The other types are embedded.
        assert!(
            found
                .structures()
                .any(|one| one.name.package() == "builtin_interfaces")
        );
    }

    #[test]
    fn services_events_and_actions_are_found_by_their_announced_names() {
        let here = prefix(&[
            ("a/srv/S.srv", "# S\nint8 x\n---\nstd_msgs/String y # why\n"),
            (
                "a/action/A.action",
                "int8 x\n---\nint8 y\n---\ngeometry_msgs/Point z\n",
            ),
        ]);
        let library = library(&[&here]);
        for name in [
            "a/srv/S",
            "a/srv/S_Request",
            "a/srv/S_Response",
            "a/srv/S_Event",
        ] {
            assert_eq!(library.find(name, None).unwrap().root.to_string(), name);
        }
        for suffix in [
            "",
            "_Goal",
            "_Result",
            "_Feedback",
            "_FeedbackMessage",
            "_SendGoal",
            "_SendGoal_Request",
            "_SendGoal_Response",
            "_SendGoal_Event",
            "_GetResult",
            "_GetResult_Request",
            "_GetResult_Response",
            "_GetResult_Event",
        ] {
            library.find(&format!("a/action/A{suffix}"), None).unwrap();
        }
        let line = "=".repeat(80);
        let event = library.find("a/srv/S_Event", None).unwrap();
        assert_eq!(
            event.schema_text().1,
            format!(
                "{line}\nSRV: a/srv/S\n# S\nint8 x\n---\nstd_msgs/String y # why\n\
                 \n{line}\nMSG: std_msgs/String\nstring data\n"
            )
        );
        // A type without a file is printed so that it can be parsed again.
        let feedback = library.find("a/action/A_FeedbackMessage", None).unwrap();
        let text = feedback.schema_text().1;
        assert!(text.starts_with("unique_identifier_msgs/UUID goal_id\na/A_Feedback feedback\n"));
        let again = MessageType::parse(&"a/msg/A_FeedbackMessage".parse().unwrap(), &text);
        assert_eq!(
            again.unwrap().structures().count(),
            feedback.structures().count()
        );
    }

    #[test]
    fn missing_messages_are_reported_with_a_remedy() {
        let here = prefix(&[("a/msg/B.msg", "c/D d")]);
        let message = |name| library(&[&here]).find(name, None).unwrap_err().to_string();
        assert_eq!(
            message("x_msgs/msg/Y"),
            "no definition of x_msgs/msg/Y here: install the package x_msgs, or name a directory \
             that has x_msgs/msg/Y.msg with --definitions"
        );
        assert_eq!(
            message("a/msg/B"),
            "no definition of c/msg/D (part of a/msg/B) here: install the package c, or name a \
             directory that has c/msg/D.msg with --definitions"
        );
        assert!(message("x/action/Y_SendGoal_Request").contains("x/action/Y.action"));
        assert!(message("x/srv/Y_Event").contains("x/srv/Y.srv"));
        assert!(message("../etc/passwd").contains("not a type name"));
    }

    #[test]
    fn a_mistake_is_reported_with_its_file_and_line() {
        let here = prefix(&[("a/msg/B.msg", "int8 x\nint9 y\n")]);
        let path = here.path().join("share/a/msg/B.msg");
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert_eq!(
            failure.to_string(),
            format!("{}: line 2: `int9` is not a type", path.display())
        );
        // With a hash, any source that matches is used.
        let good = prefix(&[("a/msg/B.msg", "int8 x")]);
        let announced = hash("a/msg/B", &[&good]);
        library(&[&here, &good])
            .find("a/msg/B", Some(&announced))
            .unwrap();
        fs::write(&path, b"int8 x\n\xff").unwrap();
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert_eq!(
            failure.to_string(),
            format!("{}: line 2: not UTF-8", path.display())
        );
        fs::write(&path, vec![b'#'; MAX_TEXT + 1]).unwrap();
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert!(failure.to_string().contains("longer than"), "{failure}");
    }

    #[test]
    fn an_idl_file_is_used_only_if_the_type_has_no_other_file() {
        let idl =
            "module a { module msg { struct B { long long x; std_msgs::msg::Header y; }; }; };";
        let here = prefix(&[
            ("a/msg/B.idl", idl),
            ("a/msg/C.msg", "B b"),
            ("a/msg/C.idl", "none"),
        ]);
        let found = library(&[&here]).find("a/msg/C", None).unwrap();
        let text = found.schema_text().1;
        assert!(
            text.contains("MSG: a/B\nint64 x\nstd_msgs/Header y\n"),
            "{text}"
        );
        assert_eq!(
            MessageType::parse(&found.root, &text).unwrap().type_hash(),
            found.type_hash()
        );
        let broken = prefix(&[("a/msg/B.idl", "module a {\nunion U;")]);
        let failure = library(&[&broken])
            .find("a/msg/B", None)
            .unwrap_err()
            .to_string();
        assert!(
            failure.ends_with("B.idl: line 2: `union` is not supported"),
            "{failure}"
        );
    }

    #[test]
    fn a_file_that_is_not_regular_is_refused_without_waiting() {
        let here = prefix(&[("a/msg/B.msg", "")]);
        let path = here.path().join("share/a/msg/B.msg");
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert!(matches!(failure, NotFound::Unreadable { .. }), "{failure}");
        fs::remove_dir(&path).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert!(matches!(failure, NotFound::Unreadable { .. }), "{failure}");
        fs::remove_file(&path).unwrap();
        let status = std::process::Command::new("mkfifo")
            .arg(&path)
            .status()
            .unwrap();
        assert!(status.success());
        let failure = library(&[&here]).find("a/msg/B", None).unwrap_err();
        assert!(matches!(failure, NotFound::Unreadable { .. }), "{failure}");
    }

    #[test]
    fn a_search_of_hostile_definition_trees_ends_with_a_reason() {
        // Each type has two fields of the next type: a tree of 2^40 paths. The two sources have
        // different variants of all types.
        let make = |extra: &str| {
            let file = |index| {
                let text = format!("T{0} a\nT{0} b\n{extra}", index + 1);
                (format!("a/msg/T{index}.msg"), text)
            };
            let files: Vec<_> = (0..40).map(file).collect();
            let files: Vec<_> = files
                .iter()
                .map(|(name, text)| (&**name, &**text))
                .collect();
            prefix(&files)
        };
        let (one, two) = (make("int8 x"), make("int16 x"));
        let announced = format!("RIHS01_{}", "0".repeat(64));
        let library = library(&[&one, &two]);
        let failure = library.find("a/msg/T0", Some(&announced)).unwrap_err();
        assert!(matches!(failure, NotFound::Nowhere { .. }), "{failure}");
        let last = |prefix: &TempDir| {
            fs::write(prefix.path().join("share/a/msg/T40.msg"), "int8 x").unwrap();
        };
        last(&one);
        last(&two);
        let failure = library.find("a/msg/T0", Some(&announced)).unwrap_err();
        let deep = NotClosed::TooDeep;
        assert!(matches!(failure, NotFound::Refused { reason, .. } if reason == deep));
        let failure = library.find("a/msg/T20", Some(&announced)).unwrap_err();
        assert!(
            matches!(failure, NotFound::OtherDefinition { .. }),
            "{failure}"
        );
        assert_eq!(
            library
                .find("a/msg/T20", None)
                .unwrap()
                .structures()
                .count(),
            21
        );
    }

    #[test]
    fn the_number_of_cached_definitions_is_bounded() {
        let here = prefix(&[("a/msg/B.msg", "int8 x")]);
        let library = library(&[&here]);
        for index in 0..=MAX_KEPT {
            let hash = format!("RIHS02_{index}");
            library.find("a/msg/B", Some(&hash)).unwrap();
            let key = ("a/msg/B".parse().unwrap(), Some(format!("RIHS01_{index}")));
            library.keep(key, library.find("a/msg/B", None).unwrap());
        }
        assert!(library.kept.lock().unwrap().types.len() <= MAX_KEPT);
    }

    #[test]
    fn the_distribution_of_the_dialect_precedes_the_others_newest_first() {
        let here = tempfile::tempdir().unwrap();
        for name in ["humble", "iron", "jazzy", "rolling"] {
            fs::create_dir(here.path().join(name)).unwrap();
        }
        let names = |dialect| {
            let found = installed(here.path(), dialect);
            found
                .iter()
                .map(|path| path.file_name().unwrap().to_owned())
                .collect::<Vec<_>>()
        };
        assert_eq!(
            names(Dialect::Humble),
            ["humble", "rolling", "jazzy", "iron"]
        );
        assert_eq!(
            names(Dialect::Jazzy),
            ["jazzy", "iron", "rolling", "humble"]
        );
        let environment = std::env::join_paths([Path::new("/x"), Path::new("relative")]).unwrap();
        let sources = Sources::new(vec!["/d".into()], Some(&environment), Dialect::Jazzy);
        assert_eq!(sources.prefixes.first().unwrap(), Path::new("/x"));
        assert!(!sources.prefixes.contains(&PathBuf::from("relative")));
        assert_eq!(sources.directories, [PathBuf::from("/d")]);
    }
}
