//! How large a table of the model is and may become.

use std::collections::BTreeMap;

/// One table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    /// Its name: component and field.
    pub table: &'static str,
    /// Entries, or bytes where its cap is one of bytes.
    pub entries: usize,
    /// How many there may be.
    pub cap: usize,
}

/// The largest size of each table that many have one of.
#[must_use]
pub fn largest(sizes: impl IntoIterator<Item = Size>) -> Vec<Size> {
    let mut largest: BTreeMap<&'static str, Size> = BTreeMap::new();
    for size in sizes {
        let known = largest.entry(size.table).or_insert(size);
        known.entries = known.entries.max(size.entries);
    }
    largest.into_values().collect()
}

impl Size {
    /// So large and no larger than this.
    #[must_use]
    pub const fn new(table: &'static str, entries: usize, cap: usize) -> Self {
        Self {
            table,
            entries,
            cap,
        }
    }
}
