//! Blocking client of an agent's API.
//!
//! An agent on this host is reached by its unix socket or loopback, an agent on another robot by
//! `--host` and a token. A capture is replayed into an agent within this process, which answers the
//! same requests.
//!
//! The client sends requests and decodes answers; other modules interpret them. It reads no clock
//! for its output and keeps nothing between requests.

mod compressed;
mod error;
mod line_reader;
mod lines;
mod replay_agent;
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
use ros2probe_daemon::run::CaptureTime;

use replay_agent::Pace;

pub use compressed::Compressed;
pub use error::{ClientError, Refusal};
pub use lines::{Lines, Next};
pub use replay_agent::Outcome;
pub use samples::Samples;
pub use target::{InvalidEnvironment, Target};
use transport::Transport;

/// Maximum wait for a whole answer. Graphs of thousands of topics take less than a second.
const TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum silence of an agent: before its answer, within it, and in a stream of messages, which
/// contains the clock.
const STREAM_SILENCE: Duration = Duration::from_secs(5);
/// Maximum silence in a stream of events, which has a heartbeat every 15 s.
const HEARTBEAT_TIMEOUT: Duration = Duration::from_secs(40);
/// Maximum size of an answer, in bytes. Streams have no such limit.
const MAX_ANSWER: usize = 256 << 20;

/// Connection to one agent.
pub struct Agent {
    runtime: Runtime,
    transport: Transport,
    token: Option<String>,
}

impl Agent {
    /// Finds the agent that `target` names. A capture is replayed to its end or to `--until`;
    /// requests then see that state.
    ///
    /// # Errors
    ///
    /// Fails if the agent is not running, or if its token or the capture cannot be read.
    pub fn reach(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::ToEnd, false)
    }

    /// Finds an agent like [`Self::reach`], but replays a capture only to `--from`, or not at all.
    /// The replay continues with the first [`Self::stream`].
    ///
    /// # Errors
    ///
    /// Fails as [`Self::reach`] does.
    pub fn reach_stream(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::Pause, false)
    }

    /// Finds an agent like [`Self::reach`], but measures all topics of a capture. With `speed`, the
    /// replay continues at that speed during requests.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::reach`] does.
    pub fn reach_measured(target: &Target, speed: Option<Speed>) -> Result<Self, ClientError> {
        Self::find(target, speed.map_or(Pace::ToEnd, Pace::Live), true)
    }

    /// Finds an agent like [`Self::reach_stream`], but measures all topics of a capture.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::reach`] does.
    pub fn reach_stream_measured(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::Pause, true)
    }

    /// Finds an agent like [`Self::reach_stream_measured`]. The replay continues with
    /// [`Self::advance`].
    ///
    /// # Errors
    ///
    /// Fails as [`Self::reach`] does.
    pub fn reach_steps(target: &Target) -> Result<Self, ClientError> {
        Self::find(target, Pace::Steps, true)
    }

    /// Replays a capture of [`Self::reach_steps`] to this time. Returns `false` if the replay has
    /// ended, and for a live agent.
    #[must_use]
    pub fn advance(&self, to: CaptureTime) -> bool {
        self.runtime.block_on(self.transport.advance(to))
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

    /// Requests `path`, which may have a query. Encode names in it with
    /// [`ros2probe_api::path::encoded`].
    ///
    /// # Errors
    ///
    /// Fails if the agent is unreachable, refuses, or sends an unexpected answer.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.exchange(Method::GET, path, None, TIMEOUT)
    }

    /// Requests `path` like [`Self::get`], and escapes control characters in all texts. Names come
    /// from the network and are printed on a terminal.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn get_visible<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        let answer = self.get(path)?;
        serde_json::from_value(visible_text(answer))
            .map_err(|source| self.transport.unreadable_answer(path, source))
    }

    /// Requests `path` like [`Self::get`], and waits for the answer for at most `longest`.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn get_within<T: DeserializeOwned>(
        &self,
        path: &str,
        longest: Duration,
    ) -> Result<T, ClientError> {
        self.exchange(Method::GET, path, None, longest)
    }

    /// Sends `body` with POST.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn post<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.exchange(Method::POST, path, Some(json(body)), TIMEOUT)
    }

    /// Sends `body` with PUT.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn put<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.exchange(Method::PUT, path, Some(json(body)), TIMEOUT)
    }

    /// Deletes the resource at `path`.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn delete(&self, path: &str) -> Result<(), ClientError> {
        self.runtime.block_on(async {
            let answer = self.send(Method::DELETE, path, None).await?;
            self.read_body(path, answer).await.map(drop)
        })
    }

    /// Opens a stream of lines, some with raw bytes after them. It lasts until the client or the
    /// agent closes it.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::get`] does.
    pub fn stream(&self, path: &str) -> Result<Lines<'_>, ClientError> {
        self.runtime.block_on(async {
            let answer = self.send(Method::GET, path, None).await?;
            if answer.status().is_success() {
                self.transport.resume();
                let silence = if path.starts_with("/events") {
                    HEARTBEAT_TIMEOUT
                } else {
                    STREAM_SILENCE
                };
                // A replay within this process runs at the pace of its capture.
                let silence = (!self.transport.is_replayed()).then_some(silence);
                Ok(Lines::new(self, answer.into_body(), silence))
            } else {
                let refused = self.read_body(path, answer).await;
                Err(refused
                    .err()
                    .unwrap_or_else(|| self.transport.not_an_agent()))
            }
        })
    }

    /// Decodes the JSON of a line or an answer.
    fn decoded<T: DeserializeOwned>(&self, path: &str, text: &[u8]) -> Result<T, ClientError> {
        serde_json::from_slice(text)
            .map_err(|source| self.transport.unreadable_answer(path, source))
    }

    /// Returns the error of a connection that closed before the answer.
    fn connection_closed(&self, path: &str) -> ClientError {
        self.transport
            .broken_connection(format!("{path} ended before its first byte"))
    }

    /// Returns whether the agent replays a capture within this process.
    #[must_use]
    pub const fn is_replay(&self) -> bool {
        matches!(self.transport, Transport::ReplayAgent(_))
    }

    /// Returns how the replay of a capture ended; `None` for a live agent and during the replay.
    #[must_use]
    pub fn outcome(&self) -> Option<Outcome> {
        self.transport.outcome()
    }

    /// Returns the address of the agent as text for people.
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
                self.read_body(path, answer).await
            };
            let answer = timeout(longest, exchange).await;
            answer.unwrap_or_else(|_| Err(self.transport.timed_out()))
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
        let answer = timeout(STREAM_SILENCE, self.transport.send(request)).await;
        answer.unwrap_or_else(|_| Err(self.transport.timed_out()))
    }

    /// Reads the whole body of a successful answer; problem details become an error.
    async fn read_body(
        &self,
        path: &str,
        answer: Response<Incoming>,
    ) -> Result<Bytes, ClientError> {
        let status = answer.status();
        let mut body = Limited::new(answer.into_body(), MAX_ANSWER);
        let mut whole = BytesMut::new();
        loop {
            let frame = timeout(STREAM_SILENCE, body.frame()).await;
            let Some(frame) = frame.map_err(|_| self.transport.timed_out())? else {
                break;
            };
            let frame = frame.map_err(|source| self.transport.broken_connection(source))?;
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
            (_, code) if code == Code::NotFound.as_str() => self.transport.older_agent(path),
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

/// Encodes `body`. A body without a JSON form becomes empty, which the agent refuses.
fn json<B: Serialize>(body: &B) -> Bytes {
    serde_json::to_vec(body).unwrap_or_default().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::names::{NodeName, TopicName};

    #[test]
    fn control_characters_in_names_are_escaped() {
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
