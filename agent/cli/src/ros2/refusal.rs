//! Errors that ros2cli prints on stderr.

/// Text printed on stderr without a prefix; the exit code is 1.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
#[error("{0}")]
pub struct Refused(pub String);
