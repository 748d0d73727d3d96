//! DDS domains.

use core::fmt;

/// Id of a DDS domain. A participant may announce any number; UDP ports exist up to [`Self::MAX`].
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct DomainId(pub u32);

impl DomainId {
    /// The highest domain id that has UDP ports (RTPS 2.5, 9.6.2.3).
    pub const MAX: Self = Self(232);
    /// The first UDP port of domain 0 (RTPS 2.5, 9.6.2.3).
    pub const PORT_BASE: u16 = 7400;
    /// Number of UDP ports of a domain.
    pub const PORT_GAIN: u16 = 250;
}

/// A number that is not a domain id.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct InvalidDomainId(pub u32);

impl fmt::Display for InvalidDomainId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(number) = self;
        let most = DomainId::MAX;
        write!(f, "domain_id is {number}, must be between 0 and {most}")
    }
}

impl core::error::Error for InvalidDomainId {}

impl TryFrom<u32> for DomainId {
    type Error = InvalidDomainId;

    /// # Errors
    /// Returns [`InvalidDomainId`] if the number is larger than [`DomainId::MAX`].
    fn try_from(number: u32) -> Result<Self, InvalidDomainId> {
        let id = Self(number);
        (id <= Self::MAX)
            .then_some(id)
            .ok_or(InvalidDomainId(number))
    }
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
