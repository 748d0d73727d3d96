//! Limit on the expansion of a compressed file.

use core::error::Error;
use core::fmt;

/// Whether the expansion of a compressed file is limited relative to its size. A small file can
/// expand to gigabytes, which would exhaust memory or take minutes to read.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Expansion {
    /// Reading fails beyond [`Expansion::limit`].
    #[default]
    Limited,
    /// No limit, for a file that the user trusts.
    Unlimited,
}

impl Expansion {
    /// Expanded size that any file may have, in bytes.
    pub const FREE_BYTES: u64 = 64 << 20;

    /// Returns the maximum expanded size of `compressed` bytes, in bytes: [`Self::FREE_BYTES`] plus
    /// `factor` times `compressed`, or [`u64::MAX`] without a limit.
    #[must_use]
    pub const fn limit(self, compressed: u64, factor: u64) -> u64 {
        match self {
            Self::Limited => Self::FREE_BYTES.saturating_add(compressed.saturating_mul(factor)),
            Self::Unlimited => u64::MAX,
        }
    }
}

/// A file expands beyond [`Expansion::limit`] for this factor.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct ExpandsTooFar(pub u64);

impl fmt::Display for ExpandsTooFar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "it expands to more than {} times its size; if you trust it, pass --no-expansion-limit",
            self.0
        )
    }
}

impl Error for ExpandsTooFar {}
