//! Why an agent could not be asked, each in one line that says what to do.

use std::io;
use std::path::PathBuf;

use ros2probe_api::problem::{Code, Problem, URN};

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No agent listens on this host.
    #[error(
        "no agent is running here: start one with `sudo systemctl start ros2probe`, or in a \
         terminal with `sudo rp run`; to read a capture, use `--replay FILE`"
    )]
    NoAgent,
    /// An agent listens, but not for this user.
    #[error(
        "the agent's socket {} is accessible only to root and the group ros2probe: `sudo usermod \
         -aG ros2probe $USER`, then log in again", path.display()
    )]
    Denied {
        /// The socket.
        path: PathBuf,
    },
    /// No agent answers where one was expected.
    #[error("no agent answers at {place}: {}", because(source))]
    Unreachable {
        /// Where.
        place: String,
        /// Why not.
        source: io::Error,
    },
    /// The agent accepts and then says nothing.
    #[error("the agent at {place} does not answer")]
    Slow {
        /// Where.
        place: String,
    },
    /// The connection ended within an answer.
    #[error("the connection to the agent at {place} was lost")]
    Broke {
        /// Where.
        place: String,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The agent wants a token and got none, or a wrong one.
    #[error("the agent at {place} {}", if *.offered { "does not accept this token" } else {
        "wants its token: pass `--token-file FILE` or set ROS2PROBE_TOKEN_FILE" })]
    Unauthorized {
        /// Where.
        place: String,
        /// A token was sent.
        offered: bool,
    },
    /// Something else listens there.
    #[error("{place} is not a ros2probe agent")]
    NotAnAgent {
        /// Where.
        place: String,
    },
    /// The agent does not know what was asked for.
    #[error("the agent at {place} is older than this rp and has no {path}")]
    Older {
        /// Where.
        place: String,
        /// The path without its query.
        path: String,
    },
    /// The agent's answer is not what this version expects.
    #[error(
        "the agent at {place} has another version than this rp: its answer for {path} cannot \
        be read"
    )]
    Unreadable {
        /// Where.
        place: String,
        /// The path without its query.
        path: String,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// The agent says no.
    #[error("{0}")]
    Refused(Refusal),
    /// The path has characters that a path has not.
    #[error("{path} cannot be requested")]
    Path {
        /// The path.
        path: String,
    },
    /// The token cannot be had.
    #[error("cannot read the token in {}: {}", path.display(), because(source))]
    Token {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The capture is none, or cannot be opened.
    #[error("cannot replay {}", path.display())]
    Capture {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Not even a connection could be begun.
    #[error("cannot start the runtime of the connection")]
    Runtime {
        /// Why not.
        source: io::Error,
    },
}

/// A request that the agent refused: problem details.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
#[error("{detail}")]
pub struct Refusal {
    /// Status of the answer.
    pub status: u16,
    /// Stable code, as `no-such-topic`.
    pub code: String,
    /// What is wrong, in words.
    pub detail: String,
}

impl Refusal {
    /// `None` where the body is not an agent's.
    pub(super) fn read(status: u16, body: &[u8]) -> Option<Self> {
        let Problem {
            kind,
            mut detail,
            mistakes,
            ..
        } = serde_json::from_slice(body).ok()?;
        let code = kind.strip_prefix(URN)?.to_owned();
        for mistake in mistakes {
            detail = format!("{detail}\n{mistake}");
        }
        Some(Self {
            status,
            code,
            detail,
        })
    }
}

impl ClientError {
    /// The agent refused for this reason.
    #[must_use]
    pub fn is(&self, code: Code) -> bool {
        matches!(self, Self::Refused(refusal) if refusal.code == code.as_str())
    }
}

/// The reason without the operating system's number.
fn because(error: &io::Error) -> String {
    let text = error.to_string();
    let end = text.find(" (os error").unwrap_or(text.len());
    let text = text.get(..end).unwrap_or(&text);
    text.to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_told_from_an_answer_of_somebody_else() {
        let body = br#"{"type":"urn:ros2probe:problem:no-such-topic","title":"","status":404,
            "detail":"nobody has /x"}"#;
        let refusal = Refusal::read(404, body).unwrap();
        assert_eq!(
            (refusal.code.as_str(), refusal.status),
            ("no-such-topic", 404)
        );
        assert!(ClientError::Refused(refusal).is(Code::NoSuchTopic));
        for foreign in [
            &b"404 page not found\n"[..],
            b"{}",
            br#"{"type":"about:blank","detail":""}"#,
        ] {
            assert_eq!(Refusal::read(404, foreign), None);
        }
    }

    #[test]
    fn without_an_agent_one_line_says_how_to_start_one_and_how_to_do_without() {
        let said = ClientError::NoAgent.to_string();
        assert!(!said.contains('\n'), "{said}");
        for transport in ["systemctl start ros2probe", "sudo rp run", "--replay FILE"] {
            assert!(said.contains(transport), "{said}");
        }
    }

    #[test]
    fn a_reason_is_without_the_number_of_the_system() {
        let refused = io::Error::from_raw_os_error(111);
        assert_eq!(because(&refused), "connection refused");
        assert_eq!(because(&io::Error::other("Name unknown")), "name unknown");
    }
}
