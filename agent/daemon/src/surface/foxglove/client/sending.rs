//! Data sent to a viewer: messages in fragments, statuses, and the reason for the end.

use bytes::{Bytes, BytesMut};
use futures_util::SinkExt as _;
use ros2probe_wire::Timestamp;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{CloseCode, Data, OpCode};
use tokio_tungstenite::tungstenite::{Error, Message as Incoming};

use super::super::protocol::{Level, Message, data_head};
use super::{Client, End, FRAGMENT_BYTES};

/// Maximum number of bytes that a client may send until it reads why its connection is closed.
const CLOSE_READ_BYTES: u64 = 1 << 20;

impl<S: AsyncRead + AsyncWrite + Unpin> Client<S> {
    pub(super) async fn status(
        &mut self,
        level: Level,
        id: &str,
        message: &str,
    ) -> Result<(), End> {
        self.send(&Message::Status { level, message, id }).await
    }

    pub(super) async fn send(&mut self, message: &Message<'_>) -> Result<(), End> {
        // Serializing plain numbers and strings into memory cannot fail.
        let text = serde_json::to_vec(message).unwrap_or_default();
        self.fragments(text.into(), Data::Text).await
    }

    pub(super) async fn send_data(
        &mut self,
        id: u32,
        time: Timestamp,
        payload: &Bytes,
    ) -> Result<(), End> {
        let head = data_head(id, time);
        let first = payload.len().min(FRAGMENT_BYTES - head.len());
        let mut message = BytesMut::with_capacity(head.len() + first);
        message.extend_from_slice(&head);
        message.extend_from_slice(payload.get(..first).unwrap_or_default());
        let rest = payload.slice(first..);
        self.frame(message.freeze(), Data::Binary, rest.is_empty())
            .await?;
        if !rest.is_empty() {
            self.fragments(rest, Data::Continue).await?;
        }
        self.viewer.sent(payload.len());
        Ok(())
    }

    /// Sends data as one or more frames. The first frame has the opcode `first`.
    async fn fragments(&mut self, mut rest: Bytes, first: Data) -> Result<(), End> {
        let mut data = first;
        loop {
            let part = rest.split_to(rest.len().min(FRAGMENT_BYTES));
            self.frame(part, data, rest.is_empty()).await?;
            if rest.is_empty() {
                return Ok(());
            }
            data = Data::Continue;
        }
    }

    pub(super) async fn frame(
        &mut self,
        part: Bytes,
        data: Data,
        is_last: bool,
    ) -> Result<(), End> {
        let frame = Frame::message(part, OpCode::Data(data), is_last);
        self.socket.feed(Incoming::Frame(frame)).await?;
        Ok(())
    }

    /// Sends the reason for the end, and reads until the client closes the connection. Closing with
    /// unread data would reset the connection and might lose the reason.
    pub(super) async fn close_with_reason(
        &mut self,
        code: CloseCode,
        reason: &'static str,
    ) -> Result<(), Error> {
        let reason = reason.into();
        self.socket.close(Some(CloseFrame { code, reason })).await?;
        let stream = self.socket.get_mut();
        stream.shutdown().await?;
        tokio::io::copy(&mut stream.take(CLOSE_READ_BYTES), &mut tokio::io::sink()).await?;
        Ok(())
    }
}
