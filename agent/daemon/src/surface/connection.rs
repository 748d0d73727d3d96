//! Limits of time and memory per connection. A client keeps its slot while it makes progress: it
//! completes a request within a time limit, and reads an answer at a minimum rate. An idle
//! connection is closed for the next client.

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::Notify;
use tokio::time::{Instant, Sleep, sleep_until};
use tokio_util::sync::CancellationToken;

use crate::limit_facts::Slot;

/// A connection is closed after this time without a request, and a stream after this time without a
/// successful write.
const IDLE_TIMEOUT: Duration = Duration::from_secs(75);
/// Maximum time from the first to the last byte of a request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// A client must read [`MIN_PROGRESS_BYTES`] bytes of a complete answer within this time.
const PROGRESS_TIMEOUT: Duration = Duration::from_secs(10);
const MIN_PROGRESS_BYTES: usize = 64 << 10;
/// An agent that acts this late after a deadline had no CPU time.
const MAX_TIMER_DELAY: Duration = Duration::from_secs(1);
/// Maximum number of bytes of unfinished requests per listener, in addition to [`UNCHARGED_BYTES`]
/// per connection.
const MAX_UNFINISHED_BYTES: usize = 256 << 10;
/// Number of bytes of an unfinished request that every connection may use.
const UNCHARGED_BYTES: usize = 4 << 10;

/// The connections of one listener.
#[derive(Debug, Default)]
pub(super) struct Connections {
    connections: Mutex<Vec<Arc<ConnectionState>>>,
    unfinished: AtomicUsize,
    closed: Notify,
}

/// Progress of one connection; shared by its stream and its request handler.
#[derive(Debug)]
pub(super) struct ConnectionState {
    progress: Mutex<Progress>,
    /// Closes the connection.
    end: CancellationToken,
}

#[derive(Debug)]
struct Progress {
    phase: Phase,
    since: Instant,
    /// Bytes of the request that were read.
    read: usize,
    /// Bytes that are counted in [`Connections::unfinished`].
    counted: usize,
    /// Whether the last read of the connection found no data. An agent without CPU time has not
    /// read every connection yet. Unread connections do not wait for their clients.
    was_empty: bool,
    /// When the client began to read too slowly, and the number of bytes that it has read since
    /// then.
    stalled: Option<(Instant, usize)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No request has arrived, or only a part of its head.
    Waiting,
    /// The head of a request has arrived, but not its whole body.
    Receiving,
    /// The request is being handled.
    Working,
    /// A complete answer is being sent.
    Answering,
    /// A stream is being sent.
    Streaming,
}

/// A stream that fails if it exceeds its limits of time or memory.
#[derive(Debug)]
pub(super) struct Connection<S> {
    stream: S,
    state: Arc<ConnectionState>,
    connections: Arc<Connections>,
    deadline: Pin<Box<Sleep>>,
    /// `None` only while the value is dropped.
    slot: Option<Slot>,
}

impl Connections {
    /// Registers a connection until it is dropped.
    pub(super) fn join<S>(self: &Arc<Self>, stream: S, slot: Slot) -> Connection<S> {
        let state = Arc::new(ConnectionState::new());
        self.lock().push(Arc::clone(&state));
        Connection {
            stream,
            state,
            connections: Arc::clone(self),
            deadline: Box::pin(sleep_until(Instant::now() + IDLE_TIMEOUT)),
            slot: Some(slot),
        }
    }

    /// Closes the connection that has waited longest for a complete request from its client.
    /// Returns `false` if no connection waits.
    pub(super) fn make_room(&self) -> bool {
        let connections = self.lock();
        let waiting = connections.iter().filter_map(|state| {
            let progress = state.lock();
            let is_waiting = matches!(progress.phase, Phase::Waiting | Phase::Receiving)
                && progress.was_empty
                // The end of an answer is still being sent.
                && progress.stalled.is_none();
            (is_waiting && !state.end.is_cancelled()).then_some((progress.since, state))
        });
        let longest = waiting.min_by_key(|(since, _)| *since);
        longest.map(|(_, state)| state.end.cancel()).is_some()
    }

    /// Returns whether a connection without a request may have unread data: its last read found
    /// some, or it was never read.
    pub(super) fn has_unread(&self) -> bool {
        self.lock().iter().any(|state| {
            let progress = state.lock();
            progress.phase == Phase::Waiting && !progress.was_empty && !state.end.is_cancelled()
        })
    }

    /// Waits until a connection has been closed.
    pub(super) async fn wait_closed(&self) {
        self.closed.notified().await;
    }

    /// Counts bytes of an unfinished request; returns false if they exceed the limit.
    fn charge(&self, bytes: usize) -> bool {
        let more = |held: usize| Some(held + bytes).filter(|held| *held <= MAX_UNFINISHED_BYTES);
        let unfinished = &self.unfinished;
        let held = unfinished.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
        held.is_ok()
    }

    fn discharge(&self, bytes: usize) {
        self.unfinished.fetch_sub(bytes, Ordering::Relaxed);
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Arc<ConnectionState>>> {
        self.connections
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

impl ConnectionState {
    fn new() -> Self {
        Self {
            progress: Mutex::new(Progress {
                phase: Phase::Waiting,
                since: Instant::now(),
                read: 0,
                counted: 0,
                was_empty: false,
                stalled: None,
            }),
            end: CancellationToken::new(),
        }
    }

    /// Records that the head of a request has arrived, and its body if `is_whole`.
    pub(super) fn requested(&self, is_whole: bool) {
        let mut progress = self.lock();
        if is_whole {
            progress.set_phase(Phase::Working);
        } else {
            // Head and body share one time limit.
            progress.phase = Phase::Receiving;
        }
    }

    /// Records that the body of the request has arrived.
    pub(super) fn received(&self) {
        let mut progress = self.lock();
        if progress.phase == Phase::Receiving {
            progress.set_phase(Phase::Working);
        }
    }

    /// Records that the answer begins. It is a stream unless `is_whole`.
    pub(super) fn begin_answer(&self, is_whole: bool) {
        let phase = if is_whole {
            Phase::Answering
        } else {
            Phase::Streaming
        };
        self.lock().set_phase(phase);
    }

    /// Records that the HTTP server has finished with the answer.
    pub(super) fn answered(&self) {
        self.lock().set_phase(Phase::Waiting);
    }

    /// Returns whether no request is in progress.
    pub(super) fn is_idle(&self) -> bool {
        let progress = self.lock();
        progress.phase == Phase::Waiting && progress.stalled.is_none()
    }

    /// Waits until the connection must be closed.
    pub(super) async fn ended(&self) {
        self.end.cancelled().await;
    }

    fn lock(&self) -> MutexGuard<'_, Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Progress {
    fn set_phase(&mut self, phase: Phase) {
        self.phase = phase;
        self.since = Instant::now();
        if phase == Phase::Waiting {
            self.read = 0;
        }
    }

    /// Returns the time by which progress is required.
    fn deadline(&self) -> Instant {
        if let Some((since, _)) = self.stalled
            && self.phase != Phase::Streaming
        {
            return since + PROGRESS_TIMEOUT;
        }
        match self.phase {
            Phase::Waiting if self.read == 0 => self.since + IDLE_TIMEOUT,
            Phase::Waiting | Phase::Receiving => self.since + REQUEST_TIMEOUT,
            Phase::Working | Phase::Answering | Phase::Streaming => self.since + IDLE_TIMEOUT,
        }
    }
}

impl<S> Connection<S> {
    pub(super) const fn state(&self) -> &Arc<ConnectionState> {
        &self.state
    }

    pub(super) const fn stream(&self) -> &S {
        &self.stream
    }

    /// Returns an error after the deadline, otherwise `Pending`.
    fn poll_deadline<T>(&mut self, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        let deadline = self.state.lock().deadline();
        if self.deadline.deadline() != deadline {
            self.deadline.as_mut().reset(deadline);
        }
        self.deadline
            .as_mut()
            .poll(context)
            .map(|()| Err(io::ErrorKind::TimedOut.into()))
    }

    /// Counts bytes that were read of a request.
    fn has_read(&self, bytes: usize) -> io::Result<()> {
        let mut progress = self.state.lock();
        if !matches!(progress.phase, Phase::Waiting | Phase::Receiving) {
            return Ok(());
        }
        if progress.read == 0 {
            // These are the first bytes of a request after a pause.
            progress.since = Instant::now();
        }
        progress.read += bytes;
        progress.was_empty = false;
        let beyond = progress.read.saturating_sub(UNCHARGED_BYTES);
        let fresh = beyond.saturating_sub(progress.counted);
        if !self.connections.charge(fresh) {
            return Err(io::Error::other("too many bytes of unfinished requests"));
        }
        progress.counted += fresh;
        Ok(())
    }

    /// Counts written bytes. An agent without CPU time may miss the deadline of a client that has
    /// read in time. The time limit of that client begins again.
    fn has_written(&self, bytes: usize) {
        let now = Instant::now();
        let mut progress = self.state.lock();
        // The request has been processed.
        self.connections
            .discharge(std::mem::take(&mut progress.counted));
        if matches!(progress.phase, Phase::Answering | Phase::Streaming) {
            progress.since = now;
        }
        if let Some((since, taken)) = &mut progress.stalled {
            *taken += bytes;
            if *taken >= MIN_PROGRESS_BYTES {
                progress.stalled = None;
            } else if *since + PROGRESS_TIMEOUT + MAX_TIMER_DELAY <= now {
                // An agent with CPU time would have closed the connection at the deadline.
                progress.stalled = Some((now, 0));
            }
        }
    }

    fn note_stall(&self) {
        let mut progress = self.state.lock();
        if progress.stalled.is_none() {
            progress.stalled = Some((Instant::now(), 0));
        }
    }
}

impl<S> Drop for Connection<S> {
    fn drop(&mut self) {
        self.connections.discharge(self.state.lock().counted);
        let mut connections = self.connections.lock();
        connections.retain(|state| !Arc::ptr_eq(state, &self.state));
        drop(connections);
        // A waiting client finds the slot free.
        self.slot = None;
        self.connections.closed.notify_one();
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        match Pin::new(&mut self.stream).poll_read(context, buffer) {
            Poll::Pending => {
                self.state.lock().was_empty = true;
                self.poll_deadline(context)
            }
            Poll::Ready(Ok(())) => {
                let bytes = buffer.filled().len().saturating_sub(before);
                Poll::Ready(self.has_read(bytes))
            }
            failed => failed,
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
            Poll::Pending => {
                self.note_stall();
                self.poll_deadline(context)
            }
            Poll::Ready(Ok(written)) => {
                self.has_written(written);
                Poll::Ready(Ok(written))
            }
            failed => failed,
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        // The client has read everything so far.
        self.state.lock().stalled = None;
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, DuplexStream, duplex};

    use super::*;
    use crate::config::{Limit, Limits};
    use crate::limit_facts::LimitFigures;

    /// Creates a set of connections, and a function that adds one.
    fn connections() -> (
        Arc<Connections>,
        impl Fn() -> (Connection<DuplexStream>, DuplexStream),
    ) {
        let connections = Arc::new(Connections::default());
        let places = LimitFigures::new(Limits::default()).slots(Limit::ApiClients);
        let joined = Arc::clone(&connections);
        let join = move || {
            let (ours, theirs) = duplex(1 << 10);
            (joined.join(ours, places.take().unwrap()), theirs)
        };
        (connections, join)
    }

    /// Reads until the connection fails or ends. Returns the duration and the reason.
    async fn read(connection: &mut Connection<DuplexStream>) -> (Duration, io::ErrorKind) {
        let start = Instant::now();
        let mut bytes = vec![0; 1 << 16];
        loop {
            match connection.read(&mut bytes).await {
                Ok(0) => return (start.elapsed(), io::ErrorKind::UnexpectedEof),
                Ok(_) => {}
                Err(error) => return (start.elapsed(), error.kind()),
            }
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_slow_request_ends_after_ten_seconds_and_an_idle_connection_after_75() {
        let (_crowd, join) = connections();
        let (mut idle, _client) = join();
        let (lasted, why) = read(&mut idle).await;
        assert_eq!((lasted.as_secs(), why), (75, io::ErrorKind::TimedOut));

        let (mut slow, mut client) = join();
        let trickle = async {
            loop {
                if client.write_all(b"x").await.is_err() {
                    return;
                }
                tokio::time::sleep(Duration::from_secs(1)).await;
            }
        };
        let (lasted, why) = tokio::select! {
            ended = read(&mut slow) => ended,
            () = trickle => panic!("the client ended first"),
        };
        assert_eq!((lasted.as_secs(), why), (10, io::ErrorKind::TimedOut));
    }

    #[tokio::test(start_paused = true)]
    async fn slow_readers_are_disconnected_before_stalled_streams() {
        for (is_whole, seconds) in [(true, 10..=20), (false, 75..=75)] {
            let (_crowd, join) = connections();
            let (mut connection, mut client) = join();
            connection.state().requested(true);
            connection.state().begin_answer(is_whole);
            let start = Instant::now();
            let sent = connection.write_all(&[7; 1 << 20]);
            // The client reads 5 KB per second of a complete answer, and nothing of a stream.
            let reading = async {
                let mut bytes = [0; 512];
                loop {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    if is_whole {
                        client.read_exact(&mut bytes).await.unwrap();
                    }
                }
            };
            let failed = tokio::select! {
                sent = sent => sent.unwrap_err(),
                () = reading => unreachable!(),
            };
            assert_eq!(failed.kind(), io::ErrorKind::TimedOut);
            let lasted = start.elapsed().as_secs();
            assert!(seconds.contains(&lasted), "{lasted} s, whole: {is_whole}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn an_answer_that_is_read_fast_enough_is_sent_whole() {
        let (_crowd, join) = connections();
        let (mut connection, mut client) = join();
        connection.state().requested(true);
        connection.state().begin_answer(true);
        let reading = tokio::spawn(async move {
            let mut bytes = [0; 2 << 10];
            let mut read = 0;
            while let Ok(length @ 1..) = client.read(&mut bytes).await {
                read += length;
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            read
        });
        connection.write_all(&[7; 1 << 20]).await.unwrap();
        drop(connection);
        assert_eq!(reading.await.unwrap(), 1 << 20);
    }

    #[tokio::test(start_paused = true)]
    async fn a_client_that_read_in_time_stays_connected_if_the_agent_is_late() {
        let (_crowd, join) = connections();
        let (mut connection, mut client) = join();
        connection.state().requested(true);
        connection.state().begin_answer(true);
        for _ in 0..3 {
            let stopped = connection.write_all(&[7; 2 << 10]).now_or_never();
            assert!(stopped.is_none(), "the buffer is full");
            client.read_exact(&mut [0; 1 << 10]).await.unwrap();
            // The agent gets no CPU time.
            tokio::time::advance(2 * PROGRESS_TIMEOUT).await;
        }
        assert_eq!(connection.write(&[7; 1 << 10]).await.unwrap(), 1 << 10);
    }

    #[tokio::test]
    async fn large_unfinished_requests_share_a_budget_and_small_ones_are_exempt() {
        let (connections, join) = connections();
        let mut large = Vec::new();
        let mut refused = 0;
        for _ in 0..20 {
            let (mut connection, mut client) = join();
            let sending = tokio::spawn(async move {
                let sent = client.write_all(&[b'x'; 40 << 10]).await;
                (client, sent)
            });
            let mut bytes = vec![0; 40 << 10];
            refused += u32::from(connection.read_exact(&mut bytes).await.is_err());
            large.push((connection, sending));
        }
        assert!(connections.unfinished.load(Ordering::Relaxed) <= MAX_UNFINISHED_BYTES);
        assert_eq!(refused, 13, "36 KiB each of 256");
        let (mut small, mut client) = join();
        client.write_all(b"GET /metrics").await.unwrap();
        assert!(small.read(&mut [0; 64]).await.is_ok());
        drop((large, small));
        assert_eq!(connections.unfinished.load(Ordering::Relaxed), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn the_connection_that_has_waited_longest_for_its_client_is_closed_first() {
        let (connections, join) = connections();
        let (answered, _one) = join();
        answered.state().requested(true);
        let (mut oldest, _two) = join();
        tokio::time::advance(Duration::from_secs(1)).await;
        let (mut newest, _three) = join();
        let is_closed = |connection: &Connection<DuplexStream>| connection.state.end.is_cancelled();
        // The agent has not read the connections yet.
        assert!(!connections.make_room());
        let read = [&mut oldest, &mut newest].map(|each| each.read_u8().now_or_never());
        assert!(read.iter().all(Option::is_none));
        let (unread, _four) = join();
        assert!(connections.make_room() && is_closed(&oldest) && !is_closed(&newest));
        assert!(connections.make_room() && is_closed(&newest) && !is_closed(&answered));
        assert!(!connections.make_room() && !is_closed(&unread));
    }
}
