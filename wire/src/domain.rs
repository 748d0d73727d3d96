//! DDS domains.

use core::fmt;

/// Id of a DDS domain. A participant may announce any number; UDP ports exist up to [`Self::MAX`].
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct DomainId(pub u32);

impl DomainId {
    /// The highest domain for which UDP has ports (RTPS 2.5, 9.6.1.4).
    pub const MAX: Self = Self(232);
}

impl fmt::Display for DomainId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl From<DomainId> for u64 {
    fn from(id: DomainId) -> Self {
        id.0.into()
    }
}
