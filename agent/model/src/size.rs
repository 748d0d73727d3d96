//! Current size and cap of the model's tables.

use std::collections::BTreeMap;

/// Size and cap of one table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    /// Name: component and field.
    pub table: &'static str,
    /// Number of entries, or bytes if the cap is in bytes.
    pub entries: usize,
    /// Largest number of entries or bytes.
    pub cap: usize,
}

/// Returns the largest size of each table, among many instances.
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
    /// Creates the size of a table.
    #[must_use]
    pub const fn new(table: &'static str, entries: usize, cap: usize) -> Self {
        Self {
            table,
            entries,
            cap,
        }
    }
}
