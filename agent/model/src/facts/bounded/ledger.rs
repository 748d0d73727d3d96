//! Use of each table in debug builds: the largest length of a container, and the refused entries.
//!
//! Tests read the ledger to check that every declared table reached its cap. Each thread has its
//! own ledger. Release builds keep no ledger.

use std::cell::RefCell;
use std::collections::BTreeMap;

use super::Table;

/// Use of one table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Use {
    /// Largest number of entries of one container.
    pub largest: usize,
    /// Cap of that container.
    pub cap: usize,
    /// Number of entries that a cap refused or removed.
    pub refused: u64,
}

impl Use {
    /// Returns whether the table reached its cap and never exceeded it. Caps from 2^18 count bytes:
    /// nine tenths of them suffice.
    #[must_use]
    pub const fn is_driven(&self) -> bool {
        const IN_BYTES: usize = 1 << 18;
        let least = if self.cap < IN_BYTES {
            self.cap
        } else {
            self.cap / 10 * 9
        };
        self.largest >= least && self.largest <= self.cap
    }
}

thread_local! {
    static LEDGER: RefCell<BTreeMap<&'static str, Use>> = const { RefCell::new(BTreeMap::new()) };
}

/// Returns the use of each table by this thread so far, by the table's name.
#[must_use]
pub fn ledger() -> BTreeMap<&'static str, Use> {
    LEDGER.with_borrow(Clone::clone)
}

/// Records the length of a container after it grew.
#[inline]
pub(super) fn filled(table: &Table, entries: usize, cap: usize) {
    if cfg!(debug_assertions) {
        LEDGER.with_borrow_mut(|ledger| {
            let used = ledger.entry(table.name).or_default();
            if entries >= used.largest {
                (used.largest, used.cap) = (entries, cap);
            }
        });
    }
}

/// Records refused or removed entries.
#[inline]
pub(super) fn refused(table: &Table, entries: u64) {
    if cfg!(debug_assertions) {
        LEDGER.with_borrow_mut(|ledger| ledger.entry(table.name).or_default().refused += entries);
    }
}
