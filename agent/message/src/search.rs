//! One search for one type: which places have its parts, and which of them belong together.
//!
//! Bounded in what it asks the file system, reads and tries, whatever the places hold.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use super::definition::{Definition, MessageType, NotClosed, TypeName};
use super::definition_source::DefinitionSource;
use super::library::{MAX_SOURCES, NotFound};

/// How often a type is put together at most until it has the announced hash.
const MAX_TRIES: usize = 256;
/// How many times one search asks the file system whether a file is there.
const MAX_ASKED: usize = 1 << 18;
/// How much text a search holds.
const MAX_HELD: usize = 16 << 20;

/// What a file holds, if it is still there.
type Read = Result<Option<Arc<Definition>>, NotFound>;

/// One search for one type.
pub(super) struct Search<'a> {
    sources: &'a [DefinitionSource],
    root: &'a TypeName,
    /// Which places have a file, and how often they were asked.
    having: HashMap<TypeName, Vec<usize>>,
    asked: usize,
    /// What was read, by place and file, and how much text that is.
    read: HashMap<(usize, TypeName), Read>,
    held: usize,
}

impl<'a> Search<'a> {
    pub(super) fn new(sources: &'a [DefinitionSource], root: &'a TypeName) -> Self {
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

    /// The first type that can be put together, or that agrees with the hash. Usually all parts are
    /// of one place and those behind it; a workspace that lies over another ROS than the nodes'
    /// needs the type from the one and the rest from the other.
    pub(super) fn run(&mut self, announced: Option<&str>) -> Result<MessageType, NotFound> {
        let mut firsts = BTreeSet::new();
        for file in self.root.files() {
            firsts.extend(self.sources_of(&file)?);
        }
        let Some(announced) = announced else {
            let Some(first) = firsts.first() else {
                return Err(self.nowhere(self.root.clone()));
            };
            // Nothing says that what comes later is right: it is not guessed.
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
            return Err(NotFound::Another {
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

    /// The type with each part from `first` if it is there, then `second` and what is behind it, at
    /// last from what is before it.
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

    /// The places that have a file, readable or not.
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

/// Why parts could not be put together.
enum Failure {
    /// What was found of one.
    Known(NotFound),
    NotClosed(NotClosed),
}

impl From<NotClosed> for Failure {
    fn from(reason: NotClosed) -> Self {
        Self::NotClosed(reason)
    }
}
