//! A listener that cannot be used up: a limited number of connections, each closed when nothing was
//! answered on it for a while. Who is one too many is told so at once instead of waiting unanswered.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};
use tokio::task::JoinSet;
use tokio::time::{Sleep, sleep, timeout};

use super::board::Board;
use super::limit_facts::{Place, Places};
use crate::config::Limit;

/// A connection to which nothing was answered for so long is closed.
const IDLE: Duration = Duration::from_secs(75);

/// How long somebody who is turned away may take to read why, and how many may do so at once.
const FAREWELL: Duration = Duration::from_secs(1);
const FAREWELLS: usize = 64;
/// Bytes of a request that are read so that its sender sees the answer to it.
const REQUEST: u64 = 64 << 10;

/// A listener with a limited number of connections; a further one is told so and closed.
#[derive(Debug)]
pub(super) struct Bounded<L> {
    listener: L,
    places: Arc<Places>,
    board: Arc<Board>,
    limit: Limit,
    refusal: Option<Refusal>,
    leaving: JoinSet<()>,
}

/// What is answered to who is one too many, whatever was asked.
#[derive(Clone, Debug)]
pub(super) struct Refusal(Arc<str>);

/// A connection that ends when nothing was answered on it for [`IDLE`]: requests that trickle in
/// and readers that do not read cannot hold it.
#[derive(Debug)]
pub(super) struct Connection<S> {
    stream: S,
    deadline: Pin<Box<Sleep>>,
    _place: Place,
}

impl<L> Bounded<L> {
    /// At most as many connections at a time as `limit` says, which is counted on `board`. Without
    /// a refusal a further one is closed without a word.
    pub(super) fn new(
        listener: L,
        board: Arc<Board>,
        limit: Limit,
        refusal: Option<Refusal>,
    ) -> Self {
        Self {
            listener,
            places: board.limits().places(limit),
            board,
            limit,
            refusal,
            leaving: JoinSet::new(),
        }
    }

    /// No place for this one. It is not waited for, nor are many kept that take their time.
    fn turn_away(&mut self, stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static) {
        self.board.limits().reached(self.limit, 1);
        while self.leaving.try_join_next().is_some() {}
        if let Some(refusal) = self.refusal.clone()
            && self.leaving.len() < FAREWELLS
        {
            self.leaving.spawn(async move {
                let _ = timeout(FAREWELL, refusal.tell(stream)).await;
            });
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

    async fn tell(self, mut stream: impl AsyncRead + AsyncWrite + Unpin) -> io::Result<()> {
        stream.write_all(self.0.as_bytes()).await?;
        stream.shutdown().await?;
        // Closed with something unread, the connection would be reset and the answer perhaps lost.
        tokio::io::copy(&mut stream.take(REQUEST), &mut tokio::io::sink()).await?;
        Ok(())
    }
}

impl<L: Listener> Listener for Bounded<L> {
    type Io = Connection<L::Io>;
    type Addr = L::Addr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let (stream, address) = self.listener.accept().await;
            let Some(place) = self.places.take() else {
                self.turn_away(stream);
                continue;
            };
            let connection = Connection {
                stream,
                deadline: Box::pin(sleep(IDLE)),
                _place: place,
            };
            return (connection, address);
        }
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        self.listener.local_addr()
    }
}

impl<S> Connection<S> {
    /// `pending`, unless the time is over.
    fn overdue<T>(&mut self, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        self.deadline
            .as_mut()
            .poll(context)
            .map(|()| Err(io::Error::new(io::ErrorKind::TimedOut, "idle for too long")))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        match Pin::new(&mut self.stream).poll_read(context, buffer) {
            Poll::Pending => self.overdue(context),
            ready => ready,
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        match Pin::new(&mut self.stream).poll_write(context, bytes) {
            Poll::Pending => self.overdue(context),
            ready => {
                let next = tokio::time::Instant::now() + IDLE;
                self.deadline.as_mut().reset(next);
                ready
            }
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
