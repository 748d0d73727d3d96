//! A stream of lines, with raw bytes between them where a line says so.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::body::{Frame, Incoming};
use tokio::time::timeout;

use super::{Agent, ClientError};

/// How long what has come is looked for when the silence is over.
const GRACE: Duration = Duration::from_millis(500);
/// Longer than any line.
const MAX_LINE: usize = 1 << 20;

/// More raw bytes than any message has.
const MAX_BYTES: usize = 1 << 30;

/// What an agent goes on saying.
#[derive(Debug)]
pub struct Lines<'a> {
    agent: &'a Agent,
    body: Incoming,
    buffer: BytesMut,
    /// So much of the buffer has no end of a line in it.
    searched: usize,
    ended: bool,
    /// How long the agent may be silent, and how long it was waited for since it was heard.
    silence: Option<Duration>,
    waited: Duration,
}

/// What came within a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Next {
    /// A line, without its end.
    Line(Bytes),
    /// Nothing yet.
    Nothing,
    /// The agent hung up.
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

    /// Who says it.
    pub(super) const fn agent(&self) -> &'a Agent {
        self.agent
    }

    /// Waits for a line; `None` when the agent hung up.
    ///
    /// # Errors
    /// The connection broke, the agent is silent, or what comes has no lines.
    pub fn line(&mut self) -> Result<Option<Bytes>, ClientError> {
        let agent = self.agent;
        agent.runtime.block_on(self.next_line())
    }

    /// Waits for a line, but no longer than `longest`.
    ///
    /// # Errors
    /// As [`Self::line`].
    pub fn line_within(&mut self, longest: Duration) -> Result<Next, ClientError> {
        let agent = self.agent;
        agent.runtime.block_on(async {
            match timeout(longest, self.next_line()).await {
                Ok(line) => Ok(line?.map_or(Next::End, Next::Line)),
                Err(_) => {
                    // What is left of the silence is shorter by that.
                    self.waited += longest;
                    Ok(Next::Nothing)
                }
            }
        })
    }

    /// Exactly this many bytes that follow the line which was read last.
    ///
    /// # Errors
    /// The stream ends before, or no message is so long.
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
                        .broke("the stream ended within a message"));
                }
            }
            self.searched = 0;
            Ok(self.buffer.split_to(count).freeze())
        })
    }

    /// Nothing is lost when this is given up while it waits: what came is in the buffer.
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

    /// Whether anything more came.
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
                Some(Err(error)) => return Err(self.agent.transport.broke(error)),
            }
        }
        Ok(false)
    }

    /// The next frame, unless the agent is silent for too long.
    async fn frame(&mut self) -> Result<Option<Result<Frame<Bytes>, hyper::Error>>, ClientError> {
        let Some(silence) = self.silence else {
            return Ok(self.body.frame().await);
        };
        let left = silence.saturating_sub(self.waited);
        let mut frame = timeout(left, self.body.frame()).await;
        if frame.is_err() {
            // This process may have been stopped meanwhile: what has come is read first.
            frame = timeout(GRACE, self.body.frame()).await;
        }
        self.waited = Duration::ZERO;
        frame.map_err(|_| self.agent.transport.slow())
    }
}
