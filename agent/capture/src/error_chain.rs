//! Errors with their causes, for a log line.

use std::error::Error;

/// An error and its causes in one line; of a verifier's log, the first line.
#[must_use]
pub fn in_words(error: &dyn Error) -> String {
    let mut words = String::new();
    let mut cause = Some(error);
    while let Some(error) = cause {
        let message = error.to_string();
        let first = message.lines().next().unwrap_or_default();
        // A transparent error says what its cause says.
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
