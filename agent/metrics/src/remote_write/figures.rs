//! Counters of remote write, shown with the agent's own metrics.

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::time::SystemTime;

/// What became of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// The receiver wrote its samples.
    Delivered,
    /// It failed and is sent again.
    Retried,
    /// The receiver refused its samples.
    Refused,
}

/// Outcome of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleFate {
    /// The receiver wrote it.
    Delivered,
    /// The receiver refused it.
    Refused,
    /// The queue was full.
    Overflow,
    /// Too many series began in an hour.
    SeriesLimit,
    /// The agent stopped, and no queue on disk kept it.
    Shutdown,
}

/// Counters of one receiver.
#[derive(Debug, Default)]
pub struct Figures {
    is_enabled: AtomicBool,
    requests: [AtomicU64; Request::ALL.len()],
    samples: [AtomicU64; SampleFate::ALL.len()],
    sent_bytes: AtomicU64,
    queue_bytes: AtomicU64,
    /// Time of the oldest waiting samples in milliseconds since 1970; zero = none.
    oldest: AtomicI64,
}

impl Request {
    /// All results.
    pub const ALL: [Self; 3] = [Self::Delivered, Self::Retried, Self::Refused];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Delivered => "delivered",
            Self::Retried => "retried",
            Self::Refused => "refused",
        }
    }
}

impl SampleFate {
    /// All fates.
    pub const ALL: [Self; 5] = [
        Self::Delivered,
        Self::Refused,
        Self::Overflow,
        Self::SeriesLimit,
        Self::Shutdown,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Delivered => "delivered",
            Self::Refused => "refused",
            Self::Overflow => "overflow",
            Self::SeriesLimit => "series_limit",
            Self::Shutdown => "shutdown",
        }
    }
}

impl Figures {
    /// Returns whether samples are sent at all.
    #[must_use]
    pub fn is_enabled(&self) -> bool {
        self.is_enabled.load(Ordering::Relaxed)
    }

    /// Returns the number of requests with this result.
    #[must_use]
    pub fn requests(&self, result: Request) -> u64 {
        count(self.requests.get(result as usize))
    }

    /// Returns the number of samples with this fate.
    #[must_use]
    pub fn samples(&self, fate: SampleFate) -> u64 {
        count(self.samples.get(fate as usize))
    }

    /// Returns the number of bytes of all requests, without their headers.
    #[must_use]
    pub fn sent_bytes(&self) -> u64 {
        self.sent_bytes.load(Ordering::Relaxed)
    }

    /// Returns the size of the queue on disk, in bytes.
    #[must_use]
    pub fn queue_bytes(&self) -> u64 {
        self.queue_bytes.load(Ordering::Relaxed)
    }

    /// Returns the age of the oldest samples that the receiver does not have, in seconds.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "far below 2^52 milliseconds")]
    pub fn lag_seconds(&self) -> f64 {
        match self.oldest.load(Ordering::Relaxed) {
            0 => 0.0,
            oldest => now().saturating_sub(oldest).max(0) as f64 / 1_000.0,
        }
    }

    /// Marks samples as being sent, so that the counters are shown.
    pub fn enable(&self) {
        self.is_enabled.store(true, Ordering::Relaxed);
    }

    pub(super) fn count_request(&self, result: Request, bytes: usize) {
        if let Some(count) = self.requests.get(result as usize) {
            count.fetch_add(1, Ordering::Relaxed);
        }
        self.sent_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    pub(super) fn count_samples(&self, fate: SampleFate, samples: u64) {
        if let Some(count) = self.samples.get(fate as usize) {
            count.fetch_add(samples, Ordering::Relaxed);
        }
    }

    /// Publishes the state of the queue: its size on disk, and the time of the oldest samples.
    pub(super) fn waiting(&self, bytes: u64, oldest: Option<i64>) {
        self.queue_bytes.store(bytes, Ordering::Relaxed);
        self.oldest.store(oldest.unwrap_or(0), Ordering::Relaxed);
    }
}

fn count(counter: Option<&AtomicU64>) -> u64 {
    counter.map_or(0, |counter| counter.load(Ordering::Relaxed))
}

/// Returns milliseconds since 1970.
pub(super) fn now() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    i64::try_from(since.unwrap_or_default().as_millis()).unwrap_or(i64::MAX)
}
