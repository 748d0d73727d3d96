//! The connection to an agent, with a blocking face: on this host by its unix socket or loopback
//! address, on another robot by `--host` and a token. A capture is replayed into an agent within
//! this process, which is asked the same way.
//!
//! It asks and decodes; other modules know what answers mean. It never reads a clock for what it
//! shows, and keeps nothing between requests.

mod error;
mod lines;
mod samples;
mod target;
mod transport;

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::body::Incoming;
use hyper::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HOST};
use hyper::{Method, Request, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio::runtime::Runtime;
use tokio::time::timeout;

use ros2probe_api::problem::Code;
use ros2probe_daemon::agent::Speed;
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::replay_agent::Pace;

pub use error::{ClientError, Refusal};
pub use lines::{Lines, Next};
pub use ros2probe_daemon::replay_agent::Outcome;
pub use samples::Samples;
pub use target::{InvalidEnvironment, Target};
use transport::Transport;

/// The longest wait for a whole answer: graphs of thousands of topics come within a second.
const TIMEOUT: Duration = Duration::from_secs(30);
/// The longest silence of an agent: before its answer, within it, and in a stream of messages, which
/// has a clock.
const SILENCE: Duration = Duration::from_secs(5);
/// The longest silence in a stream of events, which has a beat every 15 s.
const BEATS: Duration = Duration::from_secs(40);
/// More than any answer has; a stream is not bounded by it.
const MAX_ANSWER: usize = 256 << 20;

/// An agent that can be asked.
pub struct Agent {
    runtime: Runtime,
    transport: Transport,
    token: Option<String>,
}

impl Agent {
    /// Finds the agent that `target` means. A capture is replayed to its end, or to `--until`:
    /// what it is asked for is how things stand then.
    ///
    /// # Errors
    /// There is none, its token cannot be read, or the capture cannot.
    pub fn reach(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::ToEnd, false)
    }

    /// As [`Self::reach`], but a capture is replayed only to `--from`, else not at all, and goes on
    /// with the first [`Self::stream`].
    ///
    /// # Errors
    /// As [`Self::reach`].
    pub fn reach_stream(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::Pause, false)
    }

    /// As [`Self::reach`], but all topics of a capture are measured, and it goes on at `speed`, where
    /// one is given, while it is asked.
    ///
    /// # Errors
    /// As [`Self::reach`].
    pub fn reach_measured(target: &Target, speed: Option<Speed>) -> Result<Self, ClientError> {
        Self::find(target, speed.map_or(Pace::ToEnd, Pace::Live), true)
    }

    /// As [`Self::reach_stream`], but all topics of a capture are measured.
    ///
    /// # Errors
    /// As [`Self::reach`].
    pub fn reach_stream_measured(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::Pause, true)
    }

    fn find(target: &Target, pace: Pace, measured: bool) -> Result<Self, ClientError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| ClientError::Runtime { source })?;
        let token = target.token()?;
        let transport = runtime.block_on(Transport::find(target, pace, measured))?;
        Ok(Self {
            runtime,
            transport,
            token,
        })
    }

    /// What is at `path`, which may have a query; names in it go through [`ros2probe_api::path::encoded`].
    ///
    /// # Errors
    /// The agent is gone, refuses, or answers something else.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.exchange(Method::GET, path, None, TIMEOUT)
    }

    /// As [`Self::get`], with control characters of all text escaped: names come from the network, and
    /// go to a terminal.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn get_visible<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        let answer = self.get(path)?;
        serde_json::from_value(visible_text(answer))
            .map_err(|source| self.transport.unreadable(path, source))
    }

    /// As [`Self::get`], with an answer within `longest`.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn get_within<T: DeserializeOwned>(
        &self,
        path: &str,
        longest: Duration,
    ) -> Result<T, ClientError> {
        self.exchange(Method::GET, path, None, longest)
    }

    /// Sends `body`.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn post<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.exchange(Method::POST, path, Some(json(body)), TIMEOUT)
    }

    /// Puts `body` there.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn put<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.exchange(Method::PUT, path, Some(json(body)), TIMEOUT)
    }

    /// Removes what is there.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn delete(&self, path: &str) -> Result<(), ClientError> {
        self.runtime.block_on(async {
            let answer = self.send(Method::DELETE, path, None).await?;
            self.whole(path, answer).await.map(drop)
        })
    }

    /// Lines that go on coming, perhaps with raw bytes between them, until this end or the other
    /// one hangs up.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn stream(&self, path: &str) -> Result<Lines<'_>, ClientError> {
        self.runtime.block_on(async {
            let answer = self.send(Method::GET, path, None).await?;
            if answer.status().is_success() {
                self.transport.resume();
                let silence = if path.starts_with("/events") {
                    BEATS
                } else {
                    SILENCE
                };
                // A replay within this process has the pace of its capture.
                let silence = (!self.transport.is_replayed()).then_some(silence);
                Ok(Lines::new(self, answer.into_body(), silence))
            } else {
                let refused = self.whole(path, answer).await;
                Err(refused
                    .err()
                    .unwrap_or_else(|| self.transport.not_an_agent()))
            }
        })
    }

    /// A line or an answer, read.
    fn decoded<T: DeserializeOwned>(&self, path: &str, text: &[u8]) -> Result<T, ClientError> {
        serde_json::from_slice(text).map_err(|source| self.transport.unreadable(path, source))
    }

    /// It ended before it said anything.
    fn hung_up(&self, path: &str) -> ClientError {
        self.transport
            .broke(format!("{path} ended before its first byte"))
    }

    /// It is a capture that is asked.
    #[must_use]
    pub const fn is_replay(&self) -> bool {
        matches!(self.transport, Transport::ReplayAgent(_))
    }

    /// How the replay of a capture ended; `None` for a live agent, and while it goes on.
    #[must_use]
    pub fn outcome(&self) -> Option<Outcome> {
        self.transport.outcome()
    }

    /// Where it is, for people.
    #[must_use]
    pub fn place(&self) -> String {
        self.transport.to_string()
    }

    fn exchange<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Option<Bytes>,
        longest: Duration,
    ) -> Result<T, ClientError> {
        let answer = self.runtime.block_on(async {
            let exchange = async {
                let answer = self.send(method, path, body).await?;
                self.whole(path, answer).await
            };
            let answer = timeout(longest, exchange).await;
            answer.unwrap_or_else(|_| Err(self.transport.slow()))
        })?;
        self.decoded(path, &answer)
    }

    async fn send(
        &self,
        method: Method,
        path: &str,
        body: Option<Bytes>,
    ) -> Result<Response<Incoming>, ClientError> {
        let mut request = Request::builder()
            .method(method)
            .uri(path)
            .header(HOST, self.transport.host())
            .header(ACCEPT, "*/*");
        if let Some(token) = &self.token {
            request = request.header(AUTHORIZATION, format!("Bearer {token}"));
        }
        if body.is_some() {
            request = request.header(CONTENT_TYPE, "application/json");
        }
        let request = request.body(Full::new(body.unwrap_or_default()));
        let request = request.map_err(|_| ClientError::Path {
            path: path.to_owned(),
        })?;
        if self.transport.is_replayed() {
            return self.transport.send(request).await;
        }
        let answer = timeout(SILENCE, self.transport.send(request)).await;
        answer.unwrap_or_else(|_| Err(self.transport.slow()))
    }

    /// The whole body of an answer that is no refusal.
    async fn whole(&self, path: &str, answer: Response<Incoming>) -> Result<Bytes, ClientError> {
        let status = answer.status();
        let mut body = Limited::new(answer.into_body(), MAX_ANSWER);
        let mut whole = BytesMut::new();
        loop {
            let frame = timeout(SILENCE, body.frame()).await;
            let Some(frame) = frame.map_err(|_| self.transport.slow())? else {
                break;
            };
            let frame = frame.map_err(|source| self.transport.broke(source))?;
            whole.extend_from_slice(&frame.into_data().unwrap_or_default());
        }
        let body = whole.freeze();
        if status.is_success() {
            return Ok(body);
        }
        let Some(refusal) = Refusal::read(status.as_u16(), &body) else {
            return Err(self.transport.not_an_agent());
        };
        Err(match (status, refusal.code.as_str()) {
            (StatusCode::UNAUTHORIZED, _) => self.transport.unauthorized(self.token.is_some()),
            (_, code) if code == Code::NotFound.as_str() => self.transport.older(path),
            _ => ClientError::Refused(refusal),
        })
    }
}

impl std::fmt::Debug for Agent {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Agent({})", self.transport)
    }
}

fn visible_text(value: Value) -> Value {
    match value {
        Value::String(text) => Value::String(visible(&text).into_owned()),
        Value::Array(values) => Value::Array(values.into_iter().map(visible_text).collect()),
        Value::Object(members) => {
            let members = members.into_iter();
            let members = members.map(|(name, value)| (name, visible_text(value)));
            Value::Object(members.collect())
        }
        plain => plain,
    }
}

/// What has no JSON form would be refused by the agent as an empty body.
fn json<B: Serialize>(body: &B) -> Bytes {
    serde_json::to_vec(body).unwrap_or_default().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::names::{NodeName, TopicName};

    #[test]
    fn no_name_reaches_a_terminal_with_control_characters() {
        let node = r#"{"name": "/\u001b[2J\n/é", "instances": 1}"#;
        let node = visible_text(serde_json::from_str(node).unwrap());
        let node: NodeName<'_> = serde_json::from_value(node).unwrap();
        assert_eq!(node.name, "/\\u{1b}[2J\\n/é");
        let topic = r#"{"name": "/a", "hidden": false, "types": ["a/msg/\u009b1mB"],
            "publishers": 1, "subscriptions": 0}"#;
        let topic = visible_text(serde_json::from_str(topic).unwrap());
        let topic: TopicName<'_> = serde_json::from_value(topic).unwrap();
        assert_eq!(topic.types, ["a/msg/\\u{9b}1mB"]);
    }
}
