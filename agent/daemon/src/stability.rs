//! How long the names of metrics and events stay.

/// Promise to users.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stability {
    /// Changes only with a major version.
    Stable,
    /// May change with a minor version; noted in the change log.
    Experimental,
}
