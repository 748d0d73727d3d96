//! Current size and cap of the capture's tables.

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
