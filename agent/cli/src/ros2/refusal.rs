//! What the original answers on stderr instead of on stdout.

/// A line for stderr as it is; the exit code is 1.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
#[error("{0}")]
pub struct Refused(pub String);
