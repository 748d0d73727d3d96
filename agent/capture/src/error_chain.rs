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

/// What precedes the verifier's log in errors of aya.
const VERIFIER_PREFIX: &str = "Verifier output: ";

/// Returns an error and its causes in one line. Of a verifier's log, only the reason is included.
#[must_use]
pub fn in_words(error: &dyn Error) -> String {
    let mut words = String::new();
    let mut cause = Some(error);
    while let Some(error) = cause {
        let line = line(&error.to_string());
        // A transparent error repeats its cause.
        if !words.ends_with(&line) {
            if !words.is_empty() {
                words.push_str(": ");
            }
            words.push_str(&line);
        }
        cause = error.source();
    }
    words
}

/// Returns the first line of a message. The last line of a verifier's log before its statistics is
/// the reason, and the first ones are remarks.
fn line(message: &str) -> String {
    let Some((cause, log)) = message.split_once(VERIFIER_PREFIX) else {
        return message.lines().next().unwrap_or_default().to_owned();
    };
    let statistics = ["processed ", "verification time ", "stack depth "];
    let is_reason = |line: &&str| {
        let line = line.trim();
        !line.is_empty() && !statistics.iter().any(|start| line.starts_with(start))
    };
    let reason = log.lines().rev().find(is_reason).unwrap_or_default();
    format!("{cause}{VERIFIER_PREFIX}{}", reason.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reason_of_a_verifier_is_the_last_line_before_its_statistics() {
        let message = "the syscall returned EACCES. Verifier output: arg#0 type is not a struct\n\
            0: (79) r6 = *(u64 *)(r1 +0)\n\
            invalid read from stack R10 off=-104 size=8\n\
            verification time 70557 usec\nstack depth 88+0+0\nprocessed 900 insns\n\n";
        let expected = "the syscall returned EACCES. Verifier output: invalid read from stack \
            R10 off=-104 size=8";
        assert_eq!(line(message), expected);
        assert_eq!(line("Verifier output: "), "Verifier output: ");
        assert_eq!(line("two\nlines"), "two");
    }
}
