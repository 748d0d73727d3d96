//! A listener with a limited number of connections. If all slots are in use, the connection that
//! has waited longest for its client is closed. If no connection waits, a further client receives
//! 503. While some connections are not read yet, it first waits for up to 100 ms. Clients behind it
//! wait as well.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::connection::{Connection, Connections};
use crate::config::Limit;
use crate::limit_facts::{LimitFigures, Slot, Slots};

/// Maximum time for a refused client to read the answer, and maximum number of such clients at a
/// time.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(1);
const MAX_REFUSALS: usize = 64;
/// Maximum number of bytes read of a refused request, so that its sender receives the answer.
const MAX_REFUSED_REQUEST: u64 = 64 << 10;
/// Maximum time until a connection is found that waits for its client, if some were not read yet.
const SEARCH_TIMEOUT: Duration = Duration::from_millis(100);
/// Maximum time that an evicted connection may take to close.
const EVICTION_TIMEOUT: Duration = Duration::from_millis(100);
/// Time between two searches for a connection that waits for its client.
const SEARCH_INTERVAL: Duration = Duration::from_millis(2);

/// A listener with a limited number of connections.
#[derive(Debug)]
pub(super) struct LimitedListener<L> {
    listener: L,
    slots: Arc<Slots>,
    connections: Arc<Connections>,
    limits: Arc<LimitFigures>,
    limit: Limit,
    refusal: Option<Refusal>,
    refusals: JoinSet<()>,
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
            refusals: JoinSet::new(),
        }
    }

    /// Returns a free slot, or else the slot of an evicted connection.
    async fn slot(&self) -> Option<Slot> {
        if let Some(slot) = self.slots.take() {
            return Some(slot);
        }
        self.limits.reached(self.limit, 1);
        // Threads without CPU time have not read some connections yet.
        let evicted = async {
            loop {
                match self.connections.make_room() {
                    true => return true,
                    false if !self.connections.has_unread() => return false,
                    false => sleep(SEARCH_INTERVAL).await,
                }
            }
        };
        let freed = async {
            loop {
                if let Some(slot) = self.slots.take() {
                    return slot;
                }
                self.connections.wait_closed().await;
            }
        };
        match timeout(SEARCH_TIMEOUT, evicted).await {
            Ok(true) => timeout(EVICTION_TIMEOUT, freed).await.ok(),
            // A client may have left in the meantime.
            Ok(false) | Err(_) => self.slots.take(),
        }
    }

    /// Refuses a connection without a slot, in the background. The number of such answers in
    /// progress is limited.
    fn reject(&mut self, stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static) {
        while self.refusals.try_join_next().is_some() {}
        if let Some(refusal) = self.refusal.clone()
            && self.refusals.len() < MAX_REFUSALS
        {
            self.refusals.spawn(async move {
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
        tokio::io::copy(
            &mut stream.take(MAX_REFUSED_REQUEST),
            &mut tokio::io::sink(),
        )
        .await?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{DuplexStream, duplex};

    use super::*;
    use crate::config::Limits;

    /// Accepts a connection of a client that sends nothing, whenever one is wanted.
    struct Silent(Vec<DuplexStream>);

    impl Listener for Silent {
        type Io = DuplexStream;
        type Addr = ();

        async fn accept(&mut self) -> (DuplexStream, ()) {
            let (ours, theirs) = duplex(64);
            self.0.push(theirs);
            (ours, ())
        }

        fn local_addr(&self) -> io::Result<()> {
            Ok(())
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_new_client_waits_until_one_of_the_unread_connections_is_read_and_closed() {
        let limits = Arc::new(LimitFigures::new(Limits::default()));
        let limit = Limit::ApiClients;
        let mut listener = LimitedListener::new(Silent(Vec::new()), limits.clone(), limit, None);
        let mut unread = Vec::new();
        for _ in 0..limits.caps().get(limit) {
            unread.push(listener.accept().await);
        }
        let mut first = unread.remove(0);
        tokio::spawn(async move {
            sleep(Duration::from_millis(50)).await;
            let ended = Arc::clone(first.state());
            tokio::select! {
                _ = first.read_u8() => {}
                () = ended.ended() => {}
            }
        });
        let began = tokio::time::Instant::now();
        let _new = listener.accept().await;
        let waited = began.elapsed().as_millis();
        assert!((50..60).contains(&waited), "{waited} ms");
        // Each of the other connections stays unread.
        assert!(listener.slot().await.is_none());
    }
}
