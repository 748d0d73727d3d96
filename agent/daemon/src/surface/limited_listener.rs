//! A listener that cannot be used up: a limited number of connections. Where all slots are taken,
//! the connection that waits longest for its client makes room; where none waits, a further client
//! is answered 503 at once.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::connection::{Connection, Connections};
use super::limit_facts::{LimitFigures, Slot, Slots};
use crate::config::Limit;

/// How long a client that is turned away may take to read why, and how many may do so at once.
const FAREWELL: Duration = Duration::from_secs(1);
const FAREWELLS: usize = 64;
/// Bytes of a request that are read so that its sender sees the answer to it.
const REQUEST: u64 = 64 << 10;
/// How long the connection that makes room may take to go.
const ROOM: Duration = Duration::from_millis(100);

/// A listener with a limited number of connections; a further one is refused and closed.
#[derive(Debug)]
pub(super) struct LimitedListener<L> {
    listener: L,
    slots: Arc<Slots>,
    connections: Arc<Connections>,
    limits: Arc<LimitFigures>,
    limit: Limit,
    refusal: Option<Refusal>,
    leaving: JoinSet<()>,
}

/// The answer to each connection beyond the limit.
#[derive(Clone, Debug)]
pub(super) struct Refusal(Arc<str>);

impl<L> LimitedListener<L> {
    /// At most as many connections at a time as `limit` says, which `limits` counts. Without
    /// a refusal a further one is closed without a word.
    pub(super) fn new(
        listener: L,
        limits: Arc<LimitFigures>,
        limit: Limit,
        refusal: Option<Refusal>,
    ) -> Self {
        Self {
            listener,
            slots: limits.slots(limit),
            connections: Arc::default(),
            limits,
            limit,
            refusal,
            leaving: JoinSet::new(),
        }
    }

    /// A slot, if need be that of a connection on which nothing is being answered.
    async fn slot(&self) -> Option<Slot> {
        if let Some(slot) = self.slots.take() {
            return Some(slot);
        }
        self.limits.reached(self.limit, 1);
        if !self.connections.make_room() {
            return None;
        }
        let freed = async {
            loop {
                self.connections.left().await;
                if let Some(slot) = self.slots.take() {
                    return slot;
                }
            }
        };
        timeout(ROOM, freed).await.ok()
    }

    /// No slot for this one. It is not waited for, nor are many kept that take their time.
    fn reject(&mut self, stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static) {
        while self.leaving.try_join_next().is_some() {}
        if let Some(refusal) = self.refusal.clone()
            && self.leaving.len() < FAREWELLS
        {
            self.leaving.spawn(async move {
                let _ = timeout(FAREWELL, refusal.send(stream)).await;
            });
        }
    }
}

impl<L: Listener> LimitedListener<L> {
    /// The next connection that has a slot.
    pub(super) async fn accept(&mut self) -> Connection<L::Io> {
        loop {
            let (stream, _) = self.listener.accept().await;
            match self.slot().await {
                Some(slot) => return self.connections.join(stream, slot),
                None => self.reject(stream),
            }
        }
    }
}

impl Refusal {
    /// 503 with this body.
    pub(super) fn new(media_type: &str, body: &str) -> Self {
        let length = body.len();
        Self(
            format!(
                "HTTP/1.1 503 Service Unavailable\r\ncontent-type: {media_type}\r\n\
                 content-length: {length}\r\nretry-after: 1\r\nconnection: close\r\n\r\n{body}"
            )
            .into(),
        )
    }

    async fn send(self, mut stream: impl AsyncRead + AsyncWrite + Unpin) -> io::Result<()> {
        stream.write_all(self.0.as_bytes()).await?;
        stream.shutdown().await?;
        // Closed with something unread, the connection would be reset and the answer perhaps lost.
        tokio::io::copy(&mut stream.take(REQUEST), &mut tokio::io::sink()).await?;
        Ok(())
    }
}
