//! A connection of a client: its time limit, and a close that leaves the port free.
//!
//! The side that closes a TCP connection first keeps its address for a minute (TIME_WAIT). A real
//! daemon could not bind the port during that minute, so the agent resets connections that it ends.

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use rustix::net::sockopt;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, sleep_until};
use tokio_util::sync::CancellationToken;

use crate::tables::Ros2DaemonClients;
use ros2probe_model::facts::bounded::Bounded;

/// Maximum time from an answer to the end of the next request and its answer.
pub(super) const IDLE_TIMEOUT: Duration = Duration::from_secs(10);

/// The stream of a connection.
#[derive(Debug)]
pub(super) struct Stream {
    inner: TcpStream,
    /// Whether the connection was shut down without a reset.
    is_shut: bool,
    resets: Arc<AtomicBool>,
}

/// State of a connection that its requests and the listener share.
#[derive(Debug)]
pub(super) struct ConnectionState {
    /// Time of the last answer.
    since: Mutex<Instant>,
    is_working: AtomicBool,
    end: CancellationToken,
    resets: Arc<AtomicBool>,
}

/// The connections to all ports.
#[derive(Debug, Default)]
pub(super) struct Connections(Bounded<Ros2DaemonClients, Vec<Arc<ConnectionState>>>);

impl Stream {
    /// Creates the stream of a connection.
    pub(super) fn new(inner: TcpStream, state: &ConnectionState) -> Self {
        Self {
            inner,
            is_shut: false,
            resets: Arc::clone(&state.resets),
        }
    }
}

impl ConnectionState {
    /// Creates the state of a connection that ends with `end`.
    pub(super) fn new(end: CancellationToken) -> Self {
        Self {
            since: Mutex::new(Instant::now()),
            is_working: AtomicBool::new(false),
            end,
            resets: Arc::default(),
        }
    }

    /// Records that a whole request arrived.
    pub(super) fn requested(&self) {
        self.is_working.store(true, Ordering::Relaxed);
    }

    /// Records that the answer is ready.
    pub(super) fn answered(&self) {
        self.is_working.store(false, Ordering::Relaxed);
        *self.since.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }

    /// Makes the connection end with a reset, after the answer in progress.
    pub(super) fn reset(&self) {
        self.resets.store(true, Ordering::Relaxed);
    }

    /// Waits until the connection must end: on request, or after [`IDLE_TIMEOUT`] without an
    /// answer.
    pub(super) async fn ended(&self) {
        loop {
            let deadline = self.since() + IDLE_TIMEOUT;
            tokio::select! {
                () = self.end.cancelled() => return,
                () = sleep_until(deadline) => {}
            }
            if self.since() + IDLE_TIMEOUT <= Instant::now() {
                return;
            }
        }
    }

    fn since(&self) -> Instant {
        *self.since.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Connections {
    /// Adds a connection. If all slots are in use, the connection that has been idle longest is
    /// closed. Returns `false` if every connection has a request in progress.
    pub(super) fn join(&mut self, state: &Arc<ConnectionState>) -> bool {
        if self.0.is_full() {
            let idle = self.0.iter().enumerate();
            let idle = idle.filter(|(_, each)| !each.is_working.load(Ordering::Relaxed));
            let Some((at, _)) = idle.min_by_key(|(_, each)| each.since()) else {
                return false;
            };
            self.0.swap_remove(at).end.cancel();
        }
        self.0.push(Arc::clone(state));
        true
    }

    /// Removes a connection.
    pub(super) fn leave(&mut self, state: &Arc<ConnectionState>) {
        self.0.retain(|each| !Arc::ptr_eq(each, state));
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        if !self.is_shut {
            // If the call fails, the kernel's default applies, which is an orderly close.
            let _ = sockopt::set_socket_linger(&self.inner, Some(Duration::ZERO));
        }
    }
}

impl AsyncRead for Stream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_read(context, buffer)
    }
}

impl AsyncWrite for Stream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.inner).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.resets.load(Ordering::Relaxed) {
            return Poll::Ready(Ok(()));
        }
        self.is_shut = true;
        Pin::new(&mut self.inner).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.inner).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.inner.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> Arc<ConnectionState> {
        Arc::new(ConnectionState::new(CancellationToken::new()))
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_beyond_the_cap_replaces_the_longest_idle_but_never_a_busy_one() {
        let mut connections = Connections::default();
        let all: Vec<_> = std::iter::repeat_with(state)
            .take(Ros2DaemonClients::CAP)
            .collect();
        for each in &all {
            assert!(connections.join(each));
            tokio::time::advance(Duration::from_millis(1)).await;
        }
        all[0].requested();
        let next = state();
        assert!(connections.join(&next));
        assert!(all[1].end.is_cancelled() && !all[0].end.is_cancelled());
        all[2..].iter().for_each(|each| each.requested());
        next.requested();
        assert!(!connections.join(&state()));
        crate::tables::tests::assert_driven::<Ros2DaemonClients>();
        connections.leave(&next);
        assert!(connections.join(&state()));
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_ends_ten_seconds_after_its_last_answer() {
        let state = state();
        let start = Instant::now();
        tokio::time::advance(IDLE_TIMEOUT / 2).await;
        state.requested();
        state.answered();
        state.ended().await;
        assert_eq!(start.elapsed().as_secs(), 15);
    }
}
