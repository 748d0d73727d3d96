//! Serves connections: HTTP/1.1 with bounded heads, the [`ConnectionState`] of each connection, and
//! a graceful shutdown.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::extract::Request;
use axum::http::header::CONTENT_LENGTH;
use axum::serve::Listener;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1::Builder;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::connection::{Connection, ConnectionState};
use super::limited_listener::LimitedListener;

/// Maximum size of a request's head in bytes, and maximum number of its fields.
pub(super) const MAX_HEAD: usize = 48 << 10;
const MAX_FIELDS: usize = 64;

/// Turns the connections of a listener into HTTP streams.
pub(super) trait WrapStream<S>: Send + 'static {
    /// The HTTP stream.
    type Io: AsyncRead + AsyncWrite + Unpin + Send + 'static;

    /// Wraps a connection.
    fn wrap(&self, connection: Connection<S>) -> Self::Io;
}

/// Plain connections, without TLS.
pub(super) struct Plain;

impl<S: AsyncRead + AsyncWrite + Unpin + Send + 'static> WrapStream<S> for Plain {
    type Io = Connection<S>;

    fn wrap(&self, connection: Connection<S>) -> Connection<S> {
        connection
    }
}

/// Serves every connection until `stop`, then completes the answers in progress. `mark` adds facts
/// about the connection to each of its requests.
pub(super) async fn serve<L, W, M>(
    mut listener: LimitedListener<L>,
    wrap: W,
    router: Router,
    mark: impl Fn(&Connection<L::Io>) -> M,
    stop: CancellationToken,
) where
    L: Listener,
    L::Io: Unpin,
    W: WrapStream<L::Io>,
    M: Clone + Send + Sync + 'static,
{
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let connection = tokio::select! {
            () = stop.cancelled() => break,
            connection = listener.accept() => connection,
        };
        let state = Arc::clone(connection.state());
        let mark = mark(&connection);
        let io = wrap.wrap(connection);
        connections.spawn(answer(io, state, router.clone(), mark, stop.clone()));
    }
    while connections.join_next().await.is_some() {}
}

/// Serves the requests of one connection.
async fn answer<M: Clone + Send + Sync + 'static>(
    io: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    state: Arc<ConnectionState>,
    router: Router,
    mark: M,
    stop: CancellationToken,
) {
    let router = TowerToHyperService::new(router);
    let paced = Arc::clone(&state);
    let service = service_fn(move |request: Request<Incoming>| {
        let state = Arc::clone(&paced);
        state.requested(request.body().is_end_stream());
        let mut request = request.map(|body| {
            let state = Arc::clone(&state);
            Body::new(Received { body, state })
        });
        request.extensions_mut().insert(mark.clone());
        let answer = router.call(request);
        async move {
            let answer = answer.await?;
            let length = answer.body().size_hint().exact();
            state.begin_answer(length.is_some() || answer.headers().contains_key(CONTENT_LENGTH));
            Ok::<_, Infallible>(answer.map(|body| Answered { body, state }))
        }
    });
    let connection = Builder::new()
        .max_buf_size(MAX_HEAD)
        .max_headers(MAX_FIELDS)
        // [`ConnectionState`] has its own timeouts.
        .header_read_timeout(None::<Duration>)
        .serve_connection(TokioIo::new(io), service)
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    tokio::select! {
        // Disconnects of clients are not logged.
        _ = connection.as_mut() => return,
        () = state.ended() => return,
        () = stop.cancelled() => {}
    }
    if state.is_idle() {
        return;
    }
    connection.as_mut().graceful_shutdown();
    tokio::select! {
        _ = connection => {}
        () = state.ended() => {}
    }
}

/// The body of a request; reports its end to the connection's state.
struct Received {
    body: Incoming,
    state: Arc<ConnectionState>,
}

/// The body of an answer; reports its end to the connection's state.
struct Answered {
    body: Body,
    state: Arc<ConnectionState>,
}

impl HttpBody for Received {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        let frame = Pin::new(&mut self.body).poll_frame(context);
        if matches!(frame, Poll::Ready(None)) || self.body.is_end_stream() {
            self.state.received();
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl HttpBody for Answered {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl Drop for Answered {
    fn drop(&mut self) {
        self.state.answered();
    }
}
