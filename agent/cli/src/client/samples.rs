//! Messages of an agent's stream with their bytes, in the form of a subscription within the agent.

use std::time::Duration;

use bytes::Bytes;

use super::line_reader::LineReader;
use super::{Agent, ClientError, Lines, Next};
use ros2probe_api::samples::{Line, Open};
use ros2probe_daemon::subscriptions::NextItem;

/// Open stream of messages. Dropping it closes the stream.
#[derive(Debug)]
pub struct Samples<'a> {
    lines: Lines<'a>,
    reader: LineReader,
}

impl<'a> Samples<'a> {
    /// Opens the stream of `query`, in the syntax of `/samples`, with payloads. The agent has
    /// registered the subscription when this returns.
    ///
    /// # Errors
    ///
    /// Fails if the agent is unreachable, refuses, or sends an unexpected answer.
    pub fn open(agent: &'a Agent, query: &str) -> Result<Self, ClientError> {
        let path = format!("/samples?payload=true&{query}");
        let mut lines = agent.stream(&path)?;
        let open = loop {
            match lines.line()? {
                None => return Err(agent.connection_closed(&path)),
                Some(line) => {
                    if let Line::Open(open) = agent.decoded(&path, &line)? {
                        break open;
                    }
                }
            }
        };
        Ok(Self {
            lines,
            reader: LineReader::new(open),
        })
    }

    /// Returns the topics at the start of the stream.
    #[must_use]
    pub const fn opened(&self) -> &Open {
        self.reader.opened()
    }

    /// Waits at most `timeout` for the next item.
    ///
    /// # Errors
    ///
    /// Fails if the connection broke, or if an item cannot be decoded.
    pub fn next_within(&mut self, timeout: Duration) -> Result<NextItem, ClientError> {
        let agent = self.lines.agent();
        let line = match self.lines.line_within(timeout)? {
            Next::Line(line) => agent.decoded("/samples", &line)?,
            Next::Nothing => return Ok(NextItem::Pending),
            Next::End => return Ok(NextItem::Closed),
        };
        let payload = match &line {
            Line::Sample(sample) => {
                let count = sample.payload_bytes.unwrap_or(0);
                self.lines
                    .bytes(usize::try_from(count).unwrap_or(usize::MAX))?
            }
            _ => Bytes::new(),
        };
        let item = self.reader.item(&line, payload);
        Ok(item.map_or(NextItem::Pending, NextItem::Item))
    }
}
