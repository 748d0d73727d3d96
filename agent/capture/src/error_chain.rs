//! Errors with their causes, for a log line.

use std::error::Error;

/// Why something is not available, as text: an error is rendered when it happens.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Reason(pub String);

impl Reason {
    /// Renders an error and its causes as [`in_words`] does.
    #[must_use]
    pub fn of(error: &dyn Error) -> Self {
        Self(in_words(error))
    }

    /// Returns the text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Returns an error and its causes in one line. Of a verifier's log, only the first line is
/// included.
#[must_use]
pub fn in_words(error: &dyn Error) -> String {
    let mut words = String::new();
    let mut cause = Some(error);
    while let Some(error) = cause {
        let message = error.to_string();
        let first = message.lines().next().unwrap_or_default();
        // A transparent error repeats its cause.
        if !words.ends_with(first) {
            if !words.is_empty() {
                words.push_str(": ");
            }
            words.push_str(first);
        }
        cause = error.source();
    }
    words
}
