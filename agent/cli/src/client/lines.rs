//! Stream of lines from an agent, with raw bytes after lines that announce them.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::body::{Frame, Incoming};
use tokio::time::timeout;

use super::{Agent, ClientError};

/// Time to read data that has already arrived, after the limit on silence has passed.
const DRAIN_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum length of a line, in bytes. A graph of 8192 endpoints has 2 MB.
const MAX_LINE: usize = 8 << 20;

/// Maximum number of raw bytes after a line.
const MAX_BYTES: usize = 1 << 30;

/// Lines of one open response.
#[derive(Debug)]
pub struct Lines<'a> {
    agent: &'a Agent,
    body: Incoming,
    buffer: BytesMut,
    /// Number of leading bytes of the buffer that contain no line end.
    searched: usize,
    ended: bool,
    /// Maximum silence, and the time waited since the agent last sent data.
    silence: Option<Duration>,
    waited: Duration,
}

/// Result of a wait with a timeout.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Next {
    /// A line, without its end.
    Line(Bytes),
    /// No line within the timeout.
    Nothing,
    /// The agent closed the stream.
    End,
}

impl<'a> Lines<'a> {
    pub(super) fn new(agent: &'a Agent, body: Incoming, silence: Option<Duration>) -> Self {
        Self {
            agent,
            body,
            buffer: BytesMut::new(),
            searched: 0,
            ended: false,
            silence,
            waited: Duration::ZERO,
        }
    }

    /// Returns the agent that sends the stream.
    pub(super) const fn agent(&self) -> &'a Agent {
        self.agent
    }

    /// Waits for a line. Returns `None` when the agent closes the stream.
    ///
    /// # Errors
    ///
    /// Fails if the connection broke, the agent is silent for too long, or a line is too long.
    pub fn line(&mut self) -> Result<Option<Bytes>, ClientError> {
        let agent = self.agent;
        agent.runtime.block_on(self.next_line())
    }

    /// Waits for a line for at most `longest`.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::line`] does.
    pub fn line_within(&mut self, longest: Duration) -> Result<Next, ClientError> {
        let (agent, received) = (self.agent, self.buffer.len());
        agent.runtime.block_on(async {
            match timeout(longest, self.next_line()).await {
                Ok(line) => Ok(line?.map_or(Next::End, Next::Line)),
                // A part of a line ended the silence.
                Err(_) if self.buffer.len() > received => Ok(Next::Nothing),
                Err(_) => {
                    // The wait counts towards the silence. A short one ends before `frame` does.
                    self.waited += longest;
                    let limit = self.silence.map(|silence| silence + DRAIN_TIMEOUT);
                    match limit.is_some_and(|limit| self.waited >= limit) {
                        true => Err(agent.transport.timed_out()),
                        false => Ok(Next::Nothing),
                    }
                }
            }
        })
    }

    /// Reads the `count` raw bytes that follow the last line.
    ///
    /// # Errors
    ///
    /// Fails if the stream ends early, or if `count` exceeds the limit.
    pub fn bytes(&mut self, count: usize) -> Result<Bytes, ClientError> {
        let agent = self.agent;
        if count > MAX_BYTES {
            return Err(agent.transport.not_an_agent());
        }
        agent.runtime.block_on(async {
            while self.buffer.len() < count {
                if !self.fill().await? {
                    return Err(self
                        .agent
                        .transport
                        .broken_connection("the stream ended within a message"));
                }
            }
            self.searched = 0;
            Ok(self.buffer.split_to(count).freeze())
        })
    }

    /// Reads up to the next line end. Cancel-safe: received bytes stay in the buffer.
    async fn next_line(&mut self) -> Result<Option<Bytes>, ClientError> {
        loop {
            let fresh = self.buffer.get(self.searched..).unwrap_or_default();
            if let Some(end) = fresh.iter().position(|byte| *byte == b'\n') {
                let end = self.searched + end;
                self.searched = 0;
                let mut line = self.buffer.split_to(end + 1);
                line.truncate(end);
                return Ok(Some(line.freeze()));
            }
            self.searched = self.buffer.len();
            if self.searched > MAX_LINE {
                return Err(self.agent.transport.not_an_agent());
            }
            if !self.fill().await? {
                return Ok(None);
            }
        }
    }

    /// Appends the next data to the buffer. Returns `false` at the end of the stream.
    async fn fill(&mut self) -> Result<bool, ClientError> {
        while !self.ended {
            match self.frame().await? {
                None => self.ended = true,
                Some(Ok(frame)) => {
                    if let Ok(data) = frame.into_data()
                        && !data.is_empty()
                    {
                        self.buffer.extend_from_slice(&data);
                        return Ok(true);
                    }
                }
                Some(Err(error)) => return Err(self.agent.transport.broken_connection(error)),
            }
        }
        Ok(false)
    }

    /// Receives the next frame; `None` at the end of the stream. Fails after too long a silence.
    async fn frame(&mut self) -> Result<Option<Result<Frame<Bytes>, hyper::Error>>, ClientError> {
        let Some(silence) = self.silence else {
            return Ok(self.body.frame().await);
        };
        let left = silence.saturating_sub(self.waited);
        let mut frame = timeout(left, self.body.frame()).await;
        if frame.is_err() {
            // This process may have been stopped for a while, so data that has arrived is read
            // first.
            frame = timeout(DRAIN_TIMEOUT, self.body.frame()).await;
        }
        self.waited = Duration::ZERO;
        frame.map_err(|_| self.agent.transport.timed_out())
    }
}
