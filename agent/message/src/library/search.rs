//! One search for one type: finds the sources of its parts, and the combination that matches.
//!
//! File system queries, bytes read and attempts are bounded, whatever the sources contain.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use crate::definition::{Definition, MessageType, NotClosed, TypeName};
use crate::library::definition_source::DefinitionSource;
use crate::library::{MAX_SOURCES, NotFound};

/// Maximum number of attempts to assemble a type with the announced hash.
const MAX_TRIES: usize = 256;
/// Maximum number of file system queries of one search.
const MAX_ASKED: usize = 1 << 18;
/// Maximum size of the text that a search keeps, in bytes.
const MAX_HELD: usize = 16 << 20;

/// Content of a file, if it still exists.
type Read = Result<Option<Arc<Definition>>, NotFound>;

/// One search for one type.
pub(crate) struct Search<'a> {
    sources: &'a [DefinitionSource],
    root: &'a TypeName,
    /// The sources of each file, and the number of queries.
    having: HashMap<TypeName, Vec<usize>>,
    asked: usize,
    /// Files read, by source and name, and their total length.
    read: HashMap<(usize, TypeName), Read>,
    held: usize,
}

impl<'a> Search<'a> {
    pub(crate) fn new(sources: &'a [DefinitionSource], root: &'a TypeName) -> Self {
        let (having, read) = Default::default();
        Self {
            sources,
            root,
            having,
            asked: 0,
            read,
            held: 0,
        }
    }

    /// Returns the first type that can be assembled, or that matches the hash. Usually all parts
    /// are from one source and the sources after it. A workspace may be built over another ROS than
    /// the nodes'. The type is then from one source and its parts from another.
    pub(crate) fn run(&mut self, announced: Option<&str>) -> Result<MessageType, NotFound> {
        let mut firsts = BTreeSet::new();
        for file in self.root.files() {
            firsts.extend(self.sources_of(&file)?);
        }
        let Some(announced) = announced else {
            let Some(first) = firsts.first() else {
                return Err(self.nowhere(self.root.clone()));
            };
            // Without a hash, nothing shows that a later source is better.
            return self.assemble(*first, *first);
        };
        let mut tries: Vec<_> = firsts.iter().map(|first| (*first, *first)).collect();
        let (mut next, mut failure, mut another) = (0, None, None);
        while let Some((first, second)) = tries.get(next).copied().filter(|_| next < MAX_TRIES) {
            next += 1;
            match self
                .assemble(first, second)
                .map(|found| (found.type_hash(), found))
            {
                Ok((hash, found)) if hash == announced => return Ok(found),
                Ok((hash, _)) => _ = another.get_or_insert((first, hash)),
                Err(reason) => _ = failure.get_or_insert(reason),
            }
            if next == firsts.len() {
                let seconds: BTreeSet<_> = self.having.values().flatten().copied().collect();
                let mixed = firsts
                    .iter()
                    .flat_map(|first| seconds.iter().map(move |second| (*first, *second)));
                tries.extend(
                    mixed
                        .filter(|(first, second)| first != second)
                        .take(MAX_TRIES),
                );
            }
        }
        if let Some((source, found)) = another {
            let location = self
                .sources
                .get(source)
                .map(DefinitionSource::describe)
                .unwrap_or_default();
            let (name, announced) = (self.root.clone(), announced.to_owned());
            return Err(NotFound::OtherDefinition {
                name,
                location,
                found,
                announced,
            });
        }
        Err(failure.unwrap_or_else(|| self.nowhere(self.root.clone())))
    }

    fn nowhere(&self, missing: TypeName) -> NotFound {
        NotFound::Nowhere {
            missing,
            root: self.root.clone(),
        }
    }

    /// Assembles the type, taking each part from `first`, else from `second` and the sources after
    /// it, else from those before it.
    fn assemble(&mut self, first: usize, second: usize) -> Result<MessageType, NotFound> {
        let root = self.root.clone();
        let rank = |source: usize| match source {
            _ if source == first => 0,
            _ if source >= second => 1 + source - second,
            _ => 1 + MAX_SOURCES + source,
        };
        let found = MessageType::assemble(&root, |file| {
            let mut sources = self.sources_of(file).map_err(Failure::Known)?;
            sources.sort_by_key(|source| rank(*source));
            for source in sources {
                if let Some(found) = self.definition(source, file).map_err(Failure::Known)? {
                    return Ok(Some(found));
                }
            }
            Ok(None)
        });
        found.map_err(|failure| match failure {
            Failure::Known(failure) => failure,
            Failure::NotClosed(NotClosed::Missing(missing)) => self.nowhere(missing),
            Failure::NotClosed(reason) => NotFound::Refused { root, reason },
        })
    }

    /// Returns the sources that have a file, readable or not.
    fn sources_of(&mut self, file: &TypeName) -> Result<Vec<usize>, NotFound> {
        if let Some(known) = self.having.get(file) {
            return Ok(known.clone());
        }
        self.asked += self.sources.len();
        if self.asked > MAX_ASKED {
            let (root, reason) = (self.root.clone(), NotClosed::TooMany);
            return Err(NotFound::Refused { root, reason });
        }
        let sources = self.sources.iter().enumerate();
        let having: Vec<_> = sources
            .filter(|(_, source)| source.has(file))
            .map(|(index, _)| index)
            .collect();
        self.having.insert(file.clone(), having.clone());
        Ok(having)
    }

    fn definition(&mut self, source: usize, file: &TypeName) -> Read {
        let key = (source, file.clone());
        if let Some(known) = self.read.get(&key) {
            return known.clone();
        }
        let found = match self.sources.get(source) {
            Some(source) => source.read(file).map(|found| found.map(Arc::new)),
            None => Ok(None),
        };
        if self.held > MAX_HELD {
            self.read.clear();
            self.held = 0;
        }
        self.held += found
            .iter()
            .flatten()
            .map(|found| found.text.len())
            .sum::<usize>();
        self.read.insert(key, found.clone());
        found
    }
}

/// Why parts could not be assembled.
enum Failure {
    /// The error of one part.
    Known(NotFound),
    NotClosed(NotClosed),
}

impl From<NotClosed> for Failure {
    fn from(reason: NotClosed) -> Self {
        Self::NotClosed(reason)
    }
}
