//! Errors of requests to an agent. Each is one line with the remedy.

use std::io;
use std::path::PathBuf;

use ros2probe_api::problem::{Code, Problem, URN};

/// A request to an agent failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No agent listens on this host.
    #[error(
        "no agent is running here: start one with `sudo systemctl start ros2probe`, or in a \
         terminal with `sudo rp run`; to read a capture, use `--replay FILE`"
    )]
    NoAgent,
    /// An agent listens, but this user has no permission for its socket.
    #[error(
        "the agent's socket {} is accessible only to root and the group ros2probe: `sudo usermod \
         -aG ros2probe $USER`, then log in again", path.display()
    )]
    Denied {
        /// Path of the socket.
        path: PathBuf,
    },
    /// No agent listens at the given address.
    #[error("no agent answers at {place}: {}", io_error_text(source))]
    Unreachable {
        /// Socket path, or host and port.
        place: String,
        /// Error of the connection attempt.
        source: io::Error,
    },
    /// The agent accepted the connection and sent no answer in time.
    #[error("the agent at {place} does not answer")]
    TimedOut {
        /// Socket path, or host and port.
        place: String,
    },
    /// The connection broke within an answer.
    #[error("the connection to the agent at {place} was lost")]
    Broken {
        /// Socket path, or host and port.
        place: String,
        /// Error of the connection.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The agent requires a token, and the request had none or a wrong one.
    #[error("the agent at {place} {}", if *.offered { "does not accept this token" } else {
        "requires a token: pass `--token-file FILE` or set ROS2PROBE_TOKEN_FILE" })]
    Unauthorized {
        /// Socket path, or host and port.
        place: String,
        /// Whether the request had a token.
        offered: bool,
    },
    /// Another program listens at the address.
    #[error("{place} is not a ros2probe agent")]
    NotAnAgent {
        /// Socket path, or host and port.
        place: String,
    },
    /// The agent does not have the requested path.
    #[error("the agent at {place} is older than this rp and has no {path}")]
    OlderAgent {
        /// Socket path, or host and port.
        place: String,
        /// Path without its query.
        path: String,
    },
    /// The agent's answer does not have the form that this version expects.
    #[error(
        "the agent at {place} has another version than this rp: its answer for {path} cannot \
        be read"
    )]
    Unreadable {
        /// Socket path, or host and port.
        place: String,
        /// Path without its query.
        path: String,
        /// Error of the JSON decoder.
        source: serde_json::Error,
    },
    /// The agent refused the request.
    #[error("{0}")]
    Refused(Refusal),
    /// The path has characters that are invalid in a URL.
    #[error("`{path}` is not a valid URL path")]
    Path {
        /// The path.
        path: String,
    },
    /// The token file cannot be read.
    #[error("cannot read the token in {}: {}", path.display(), io_error_text(source))]
    Token {
        /// Path of the token file.
        path: PathBuf,
        /// Error of the read.
        source: io::Error,
    },
    /// The capture cannot be opened, or is not a capture.
    #[error("cannot replay {}", path.display())]
    Capture {
        /// Path of the capture.
        path: PathBuf,
        /// Error of the open.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The asynchronous runtime of the connection cannot be started.
    #[error("cannot start the runtime of the connection")]
    Runtime {
        /// Error of the operating system.
        source: io::Error,
    },
}

/// Problem details of a request that the agent refused.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
#[error("{detail}")]
pub struct Refusal {
    /// HTTP status.
    pub status: u16,
    /// Stable code, such as `no-such-topic`.
    pub code: String,
    /// Explanation in plain text.
    pub detail: String,
}

impl Refusal {
    /// Decodes problem details. Returns `None` if the body has another form.
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
    /// Returns whether the refusal has this code.
    #[must_use]
    pub fn is(&self, code: Code) -> bool {
        matches!(self, Self::Refused(refusal) if refusal.code == code.as_str())
    }
}

/// Returns the text of an I/O error without the error number of the operating system.
fn io_error_text(error: &io::Error) -> String {
    let text = error.to_string();
    let end = text.find(" (os error").unwrap_or(text.len());
    let text = text.get(..end).unwrap_or(&text);
    text.to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_distinguished_from_an_answer_of_another_server() {
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
    fn without_an_agent_one_line_names_both_remedies() {
        let printed = ClientError::NoAgent.to_string();
        assert!(!printed.contains('\n'), "{printed}");
        for transport in ["systemctl start ros2probe", "sudo rp run", "--replay FILE"] {
            assert!(printed.contains(transport), "{printed}");
        }
    }

    #[test]
    fn a_reason_omits_the_error_number_of_the_system() {
        let refused = io::Error::from_raw_os_error(111);
        assert_eq!(io_error_text(&refused), "connection refused");
        assert_eq!(
            io_error_text(&io::Error::other("Name unknown")),
            "name unknown"
        );
    }
}
