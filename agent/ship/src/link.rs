//! The link to the store: its bandwidth limit, and the last answer of the store.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use hyper::StatusCode;
use tokio::time::Instant;

/// Bytes between two pauses for the bandwidth limit.
pub(crate) const PIECE_BYTES: usize = 16 << 10;
/// Maximum pause that a store may demand.
const LONGEST_PAUSE: Duration = Duration::from_mins(5);

/// State of the link.
#[derive(Debug)]
pub(crate) struct Link {
    bytes_per_second: Option<u64>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// Time at which the next bytes may be sent.
    next: Instant,
    /// Time of the last bytes that were sent.
    progress: Instant,
    refusal: Option<Refusal>,
}

/// A response whose status is not a success.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Refusal {
    pub(crate) status: StatusCode,
    /// Pause that the store demands.
    pub(crate) pause: Option<Duration>,
}

impl Link {
    pub(crate) fn new(bytes_per_second: Option<u64>) -> Self {
        let now = Instant::now();
        Self {
            bytes_per_second,
            state: Mutex::new(State {
                next: now,
                progress: now,
                refusal: None,
            }),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves bandwidth for bytes, and returns the time from which they may be sent.
    pub(crate) fn reserve(&self, bytes: usize) -> Instant {
        let mut state = self.state();
        let now = Instant::now();
        let turn = state.next.max(now);
        let rate = self.bytes_per_second.unwrap_or(u64::MAX).max(1);
        state.next = turn + Duration::from_secs_f64(bytes as f64 / rate as f64);
        state.progress = turn;
        turn
    }

    /// Returns the time of the last bytes that were sent.
    pub(crate) fn progress(&self) -> Instant {
        self.state().progress
    }

    /// Begins a request.
    pub(crate) fn begin(&self) {
        let mut state = self.state();
        state.progress = Instant::now();
        state.refusal = None;
    }

    /// Records a response whose status is not a success.
    pub(crate) fn refused(&self, status: StatusCode, pause: Option<Duration>) {
        let pause = pause.map(|pause| pause.min(LONGEST_PAUSE));
        self.state().refusal = Some(Refusal { status, pause });
    }

    /// Returns the response to the last request if its status is not a success.
    pub(crate) fn refusal(&self) -> Option<Refusal> {
        self.state().refusal
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn sending_is_limited_to_the_configured_rate() {
        let link = Link::new(Some(100_000));
        let begun = Instant::now();
        let turns: Vec<_> = (0..11).map(|_| link.reserve(10_000)).collect();
        // A busy machine may take some time for the reservations themselves.
        let took = begun.elapsed();
        assert!(turns[0] < begun + took + Duration::from_millis(50));
        let whole = turns[10] - turns[0];
        assert!(whole >= Duration::from_millis(950), "{whole:?}");
        assert!(whole <= Duration::from_millis(1_050) + took, "{whole:?}");
        let unlimited = Link::new(None);
        unlimited.reserve(1 << 30);
        assert!(unlimited.reserve(1) < Instant::now() + Duration::from_millis(50));
    }

    #[tokio::test]
    async fn a_store_cannot_demand_an_endless_pause() {
        let link = Link::new(None);
        let status = StatusCode::TOO_MANY_REQUESTS;
        link.refused(status, Some(Duration::from_secs(1 << 40)));
        let refusal = link.refusal().unwrap();
        assert_eq!(refusal.pause, Some(LONGEST_PAUSE));
        link.begin();
        assert_eq!(link.refusal(), None);
    }
}
