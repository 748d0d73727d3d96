//! Transport to an agent.
//!
//! Each request has its own connection: connections within a host are cheap, and no connection has
//! to be kept alive.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::{Request, Response};
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio::time::timeout;

use super::replay_agent::{Outcome, Pace, ReplayAgent, ReplayError, ReplayOptions};
use super::{ClientError, Target};
use ros2probe_daemon::run::CaptureTime;

/// The agent's socket, as created by the package and the service manager.
const SOCKET: &str = "/run/ros2probe/api.sock";
/// Default address of the agent's API.
const LOOPBACK_ADDRESS: &str = "127.0.0.1:17401";
/// Default port of an agent on another host.
const PORT: &str = "17401";
/// Maximum wait for a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A transport to an agent.
#[derive(Debug)]
pub(super) enum Transport {
    /// Path of a unix socket.
    Socket(PathBuf),
    /// Host name or address, with port.
    Address(String),
    /// A replay within this process.
    ReplayAgent(Box<ReplayAgent>),
}

impl Transport {
    /// Selects the transport from `target`, else from the agents on this host.
    pub(super) async fn find(
        target: &Target,
        pace: Pace,
        measured: bool,
    ) -> Result<Self, ClientError> {
        if let Some(capture) = &target.replay {
            let options = ReplayOptions {
                from: target.from,
                until: target.until,
                measured,
                pace,
                expansion: target.compressed.into(),
            };
            let report = |line: &str| eprintln!("rp: {line}");
            let replayed = ReplayAgent::start(capture, options, report).await;
            let replayed = replayed.map_err(|error| match error {
                ReplayError::Capture(source) => ClientError::Capture {
                    path: capture.clone(),
                    source: source.into(),
                },
                ReplayError::Start(source) => ClientError::Runtime { source },
            })?;
            return Ok(Self::ReplayAgent(Box::new(replayed)));
        }
        if let Some(host) = &target.host {
            return Ok(Self::Address(with_port(host)));
        }
        if let Some(path) = &target.socket {
            return Ok(Self::Socket(path.clone()));
        }
        let path = Path::new(SOCKET);
        let socket = match with_connect_timeout(UnixStream::connect(path)).await {
            Ok(_) => return Ok(Self::Socket(path.to_path_buf())),
            Err(error) => error,
        };
        match with_connect_timeout(TcpStream::connect(LOOPBACK_ADDRESS)).await {
            Ok(_) => Ok(Self::Address(LOOPBACK_ADDRESS.to_owned())),
            Err(_) if socket.kind() == io::ErrorKind::PermissionDenied => {
                let path = path.to_path_buf();
                Err(ClientError::Denied { path })
            }
            Err(_) => Err(ClientError::NoAgent),
        }
    }

    /// Returns the value of the `Host` header.
    pub(super) fn host(&self) -> &str {
        match self {
            Self::Socket(_) | Self::ReplayAgent(_) => "localhost",
            Self::Address(address) => address,
        }
    }

    /// Sends a request and returns the head of the answer. The body is received while it is read.
    pub(super) async fn send(
        &self,
        request: Request<Full<Bytes>>,
    ) -> Result<Response<Incoming>, ClientError> {
        match self {
            Self::Socket(path) => {
                let stream = self.with_timeout(UnixStream::connect(path)).await?;
                self.exchange(stream, request).await
            }
            Self::Address(address) => {
                let stream = self.with_timeout(TcpStream::connect(address)).await?;
                let _ = stream.set_nodelay(true);
                self.exchange(stream, request).await
            }
            Self::ReplayAgent(replayed) => self.exchange(replayed.connect(), request).await,
        }
    }

    /// Returns whether the agent runs within this process.
    pub(super) const fn is_replayed(&self) -> bool {
        matches!(self, Self::ReplayAgent(_))
    }

    /// Continues a paused replay.
    pub(super) fn resume(&self) {
        if let Self::ReplayAgent(replayed) = self {
            replayed.resume();
        }
    }

    /// Replays to this time and pauses again. Returns `false` if the replay has ended, and for
    /// other transports.
    pub(super) async fn advance(&self, to: CaptureTime) -> bool {
        match self {
            Self::ReplayAgent(replayed) => replayed.advance(to).await,
            Self::Socket(_) | Self::Address(_) => false,
        }
    }

    /// Returns how a replay ended; `None` for other transports and during the replay.
    pub(super) fn outcome(&self) -> Option<Outcome> {
        match self {
            Self::ReplayAgent(replayed) => replayed.outcome(),
            Self::Socket(_) | Self::Address(_) => None,
        }
    }

    async fn with_timeout<S>(
        &self,
        connect: impl Future<Output = io::Result<S>>,
    ) -> Result<S, ClientError> {
        with_connect_timeout(connect)
            .await
            .map_err(|source| match self {
                Self::Socket(path) if source.kind() == io::ErrorKind::PermissionDenied => {
                    ClientError::Denied { path: path.clone() }
                }
                _ => ClientError::Unreachable {
                    place: self.to_string(),
                    source,
                },
            })
    }

    async fn exchange<S>(
        &self,
        stream: S,
        request: Request<Full<Bytes>>,
    ) -> Result<Response<Incoming>, ClientError>
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let shaken = http1::handshake(TokioIo::new(stream)).await;
        let (mut sender, connection) = shaken.map_err(|error| self.broken_connection(error))?;
        tokio::spawn(connection);
        let answer = sender.send_request(request).await;
        answer.map_err(|error| {
            if error.is_parse() {
                self.not_an_agent()
            } else {
                self.broken_connection(error)
            }
        })
    }

    pub(super) fn broken_connection(
        &self,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> ClientError {
        ClientError::Broken {
            place: self.to_string(),
            source: source.into(),
        }
    }

    pub(super) fn timed_out(&self) -> ClientError {
        ClientError::TimedOut {
            place: self.to_string(),
        }
    }

    pub(super) fn not_an_agent(&self) -> ClientError {
        ClientError::NotAnAgent {
            place: self.to_string(),
        }
    }

    pub(super) fn unauthorized(&self, offered: bool) -> ClientError {
        ClientError::Unauthorized {
            place: self.to_string(),
            offered,
        }
    }

    pub(super) fn older_agent(&self, path: &str) -> ClientError {
        ClientError::OlderAgent {
            place: self.to_string(),
            path: without_query(path),
        }
    }

    pub(super) fn unreadable_answer(&self, path: &str, source: serde_json::Error) -> ClientError {
        ClientError::Unreadable {
            place: self.to_string(),
            path: without_query(path),
            source,
        }
    }
}

impl fmt::Display for Transport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Socket(path) => write!(f, "{}", path.display()),
            Self::Address(address) => f.write_str(address),
            Self::ReplayAgent(replayed) => write!(f, "{}", replayed.capture().display()),
        }
    }
}

async fn with_connect_timeout<S>(connect: impl Future<Output = io::Result<S>>) -> io::Result<S> {
    let connected = timeout(CONNECT_TIMEOUT, connect).await;
    connected.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
}

fn without_query(path: &str) -> String {
    path.split('?').next().unwrap_or_default().to_owned()
}

/// Appends the default port if `host` has none: `robot1`, `robot1:80`, `::1`, `[::1]`, `[::1]:80`.
fn with_port(host: &str) -> String {
    let is_bare_v6 = host.matches(':').count() > 1 && !host.starts_with('[');
    if is_bare_v6 {
        return format!("[{host}]:{PORT}");
    }
    let behind = host.rsplit(']').next().unwrap_or_default();
    if behind.contains(':') {
        host.to_owned()
    } else {
        format!("{host}:{PORT}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_without_a_port_gets_the_default_port() {
        for (host, address) in [
            ("robot1", "robot1:17401"),
            ("robot1:80", "robot1:80"),
            ("10.0.0.2", "10.0.0.2:17401"),
            ("::1", "[::1]:17401"),
            ("[::1]", "[::1]:17401"),
            ("[::1]:80", "[::1]:80"),
        ] {
            assert_eq!(with_port(host), address);
        }
    }
}
