//! Stability of the names of metrics and events.

/// Promise to users about a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stability {
    /// Changes only with a major version.
    Stable,
    /// May change with a minor version; noted in the change log.
    Experimental,
}
