//! A listener with a limited number of connections. If all slots are in use, the connection that
//! has waited longest for its client is closed. If no connection waits, a further client receives
//! 503 immediately.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::connection::{Connection, Connections};
use crate::config::Limit;
use crate::limit_facts::{LimitFigures, Slot, Slots};

/// Maximum time for a refused client to read the answer, and maximum number of such clients at a
/// time.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(1);
const FAREWELLS: usize = 64;
/// Maximum number of bytes read of a refused request, so that its sender receives the answer.
const REQUEST: u64 = 64 << 10;
/// Maximum time that an evicted connection may take to close.
const EVICTION_TIMEOUT: Duration = Duration::from_millis(100);

/// A listener with a limited number of connections.
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

/// The answer to connections beyond the limit.
#[derive(Clone, Debug)]
pub(super) struct Refusal(Arc<str>);

impl<L> LimitedListener<L> {
    /// Creates a listener with the number of connections that `limit` allows, counted in `limits`.
    /// Without a refusal, further connections are closed without an answer.
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

    /// Returns a free slot, or else the slot of an evicted connection.
    async fn slot(&self) -> Option<Slot> {
        if let Some(slot) = self.slots.take() {
            return Some(slot);
        }
        self.limits.reached(self.limit, 1);
        if !self.connections.make_room() {
            // Connections that were just accepted have not been read yet.
            tokio::task::yield_now().await;
            if !self.connections.make_room() {
                return None;
            }
        }
        let freed = async {
            loop {
                self.connections.left().await;
                if let Some(slot) = self.slots.take() {
                    return slot;
                }
            }
        };
        timeout(EVICTION_TIMEOUT, freed).await.ok()
    }

    /// Refuses a connection without a slot, in the background. The number of such answers in
    /// progress is limited.
    fn reject(&mut self, stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static) {
        while self.leaving.try_join_next().is_some() {}
        if let Some(refusal) = self.refusal.clone()
            && self.leaving.len() < FAREWELLS
        {
            self.leaving.spawn(async move {
                let _ = timeout(REFUSAL_TIMEOUT, refusal.send(stream)).await;
            });
        }
    }
}

impl<L: Listener> LimitedListener<L> {
    /// Returns the next connection that gets a slot.
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
    /// Creates an answer with status 503 and this body.
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
        // Closing with unread data would reset the connection and might lose the answer.
        tokio::io::copy(&mut stream.take(REQUEST), &mut tokio::io::sink()).await?;
        Ok(())
    }
}
