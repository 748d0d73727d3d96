//! Versions of documents: what a view of the robot contains, as JSON.
//!
//! The first block of a file has every document as a whole. A later block has only the documents
//! that changed since the block before it, and of each what differs. A file thus needs no other
//! file, and a document that never changes is stored once in it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use flate2::Crc;

use crate::bytes::{Get, Put};
use crate::delta;

/// A document: what a view of the robot contains.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Document {
    /// Name, the same for all versions.
    pub name: String,
    /// Content, usually JSON. Changes are found between commas.
    pub content: Vec<u8>,
}

/// A document as it was.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DocumentVersion {
    /// Unix time at which the document was like this.
    pub at: u32,
    /// Content.
    pub content: Vec<u8>,
}

/// The latest versions in the file that is written.
#[derive(Debug, Default)]
pub(crate) struct Versions {
    /// The file; `None` if the next block must have every document as a whole.
    pub(crate) path: Option<PathBuf>,
    /// Number of the file's next block.
    number: u64,
    known: BTreeMap<String, Vec<u8>>,
}

/// One document while the blocks of a file are read in their order.
#[derive(Debug)]
pub(crate) struct VersionReader<'a> {
    name: &'a str,
    /// Number of the next block. After a missing block, a change has no base.
    number: u64,
    content: Option<Vec<u8>>,
}

/// How an entry of a block changes a document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    /// The document as a whole.
    Whole,
    /// What differs from the version before.
    Difference,
    /// The document is no longer kept.
    Gone,
}

impl Change {
    const ALL: [Self; 3] = [Self::Whole, Self::Difference, Self::Gone];
}

impl Versions {
    /// Forgets the file, so that the next block has every document as a whole.
    pub(crate) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Replaces the known documents by new ones of at most this length together, in bytes. Returns the
    /// content of the block that stores this.
    pub(crate) fn block(
        &mut self,
        new: impl Iterator<Item = Document>,
        mut most: usize,
    ) -> Vec<u8> {
        let mut block = Vec::new();
        block.put(self.number);
        self.number += 1;
        let mut gone = std::mem::take(&mut self.known);
        for Document { name, content } in new {
            let Some(left) = most.checked_sub(content.len()) else {
                continue;
            };
            most = left;
            let before = gone.remove(&name);
            if before.as_ref() != Some(&content) {
                write_change(&mut block, &name, before.as_deref(), &content);
            }
            drop(before);
            self.known.insert(name, content);
        }
        for name in gone.keys() {
            write_entry(&mut block, name, Change::Gone, &[]);
        }
        block
    }
}

impl<'a> VersionReader<'a> {
    pub(crate) const fn new(name: &'a str) -> Self {
        Self {
            name,
            number: 0,
            content: None,
        }
    }

    /// Applies the next block.
    pub(crate) fn read(&mut self, block: &[u8]) {
        let before = self.content.take();
        self.content = self.changed(before, &mut Get(block));
    }

    /// Returns the content after the last block; `None` if the document is not kept or damaged.
    pub(crate) fn content(self) -> Option<Vec<u8>> {
        self.content
    }

    fn changed(&mut self, before: Option<Vec<u8>>, block: &mut Get<'_>) -> Option<Vec<u8>> {
        let number = block.number()?;
        let before = before.filter(|_| number == self.number);
        self.number = number.saturating_add(1);
        while !block.is_empty() {
            let name = block.bytes()?;
            let change = *Change::ALL.get(block.small()? as usize)?;
            let stored = block.bytes()?;
            let checksum_of_content = match change {
                Change::Difference => block.small()?,
                Change::Whole | Change::Gone => 0,
            };
            if name != self.name.as_bytes() {
                continue;
            }
            return match change {
                Change::Whole => Some(stored.to_vec()),
                Change::Difference => delta::apply(&before?, stored)
                    .filter(|content| checksum(content) == checksum_of_content),
                Change::Gone => None,
            };
        }
        before
    }
}

/// Writes the difference, or the whole document if that is shorter.
fn write_change(block: &mut Vec<u8>, name: &str, before: Option<&[u8]>, content: &[u8]) {
    let before = before.filter(|before| delta::is_comparable(before));
    let difference = before.map(|before| delta::difference(before, content));
    match difference.filter(|difference| difference.len() < content.len()) {
        Some(difference) => {
            write_entry(block, name, Change::Difference, &difference);
            block.put(u64::from(checksum(content)));
        }
        None => write_entry(block, name, Change::Whole, content),
    }
}

fn write_entry(block: &mut Vec<u8>, name: &str, change: Change, stored: &[u8]) {
    block.put_bytes(name.as_bytes());
    block.put(change as u64);
    block.put_bytes(stored);
}

fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes);
    crc.sum()
}
