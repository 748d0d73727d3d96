//! How far a compressed file may expand.

use core::error::Error;
use core::fmt;

/// Whether a compressed file is read only as far as its size explains. A small file can expand to
/// gigabytes, which take memory or minutes.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Expansion {
    /// Reading fails at a limit.
    #[default]
    Limited,
    /// A person trusts the file.
    Unlimited,
}

impl Expansion {
    /// Bytes to which any file may expand.
    pub const FREE: u64 = 64 << 20;

    /// Returns the number of bytes to which this many compressed bytes may expand: [`Self::FREE`]
    /// and `factor` times their number.
    #[must_use]
    pub const fn limit(self, compressed: u64, factor: u64) -> u64 {
        match self {
            Self::Limited => Self::FREE.saturating_add(compressed.saturating_mul(factor)),
            Self::Unlimited => u64::MAX,
        }
    }
}

/// A file expands beyond [`Expansion::limit`] of this factor.
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
