//! How large a table of the model is and may become.

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
