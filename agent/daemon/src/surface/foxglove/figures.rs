//! The listener for viewers and its clients, as metrics, `/health` and `rp doctor` show them.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::config::Access;

/// Figures of all viewers.
#[derive(Debug, Default)]
pub struct Viewers {
    inner: Mutex<Inner>,
    sent_messages: AtomicU64,
    sent_bytes: AtomicU64,
    dropped_messages: AtomicU64,
    refused: AtomicU64,
}

#[derive(Debug, Default)]
struct Inner {
    listener: ViewerListener,
    /// Number of viewers so far, which is the last id.
    count: u64,
    viewers: BTreeMap<u64, Arc<Facts>>,
}

/// State of the listener.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum ViewerListener {
    /// Not configured.
    #[default]
    Off,
    /// Listening, with the rights of clients without a token; `None` if every client needs one.
    At(SocketAddr, Option<Access>),
    /// Listening failed, for the reason in the text.
    Failed(SocketAddr, String),
}

/// Facts about one viewer.
#[derive(Debug)]
struct Facts {
    address: Option<SocketAddr>,
    access: Access,
    subscriptions: AtomicUsize,
    sent_messages: AtomicU64,
    dropped_messages: AtomicU64,
}

/// Facts about one viewer at one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewerFacts {
    /// Address of the client.
    pub address: Option<SocketAddr>,
    /// Rights of the client.
    pub access: Access,
    /// Open subscriptions.
    pub subscriptions: usize,
    /// Messages sent to the client.
    pub sent_messages: u64,
    /// Messages dropped because the client read too slowly.
    pub dropped_messages: u64,
}

/// Current numbers of clients and subscriptions, and totals since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewerTotals {
    /// Connected viewers.
    pub clients: usize,
    /// Open subscriptions of all viewers.
    pub subscriptions: usize,
    /// Messages sent to viewers.
    pub sent_messages: u64,
    /// Payload bytes of the sent messages.
    pub sent_bytes: u64,
    /// Messages dropped because a viewer read too slowly.
    pub dropped_messages: u64,
    /// Handshakes that were refused.
    pub refused: u64,
}

/// A connected viewer, until it is dropped.
#[derive(Debug)]
pub(super) struct Viewer {
    id: u64,
    facts: Arc<Facts>,
    all: Arc<Viewers>,
}

impl Viewers {
    /// Returns the state of the listener.
    #[must_use]
    pub fn listener(&self) -> ViewerListener {
        self.lock().listener.clone()
    }

    /// Returns the connected viewers, in the order in which they connected.
    #[must_use]
    pub fn connected(&self) -> Vec<ViewerFacts> {
        let inner = self.lock();
        let viewers = inner.viewers.values();
        let facts = viewers.map(|facts| ViewerFacts {
            address: facts.address,
            access: facts.access,
            subscriptions: facts.subscriptions.load(Ordering::Relaxed),
            sent_messages: facts.sent_messages.load(Ordering::Relaxed),
            dropped_messages: facts.dropped_messages.load(Ordering::Relaxed),
        });
        facts.collect()
    }

    /// Returns the totals.
    #[must_use]
    pub fn totals(&self) -> ViewerTotals {
        let connected = self.connected();
        ViewerTotals {
            clients: connected.len(),
            subscriptions: connected.iter().map(|viewer| viewer.subscriptions).sum(),
            sent_messages: self.sent_messages.load(Ordering::Relaxed),
            sent_bytes: self.sent_bytes.load(Ordering::Relaxed),
            dropped_messages: self.dropped_messages.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
        }
    }

    /// Returns whether a viewer is connected.
    pub(super) fn is_any(&self) -> bool {
        !self.lock().viewers.is_empty()
    }

    /// Records the state of the listener.
    pub(super) fn set_listener(&self, listener: ViewerListener) {
        self.lock().listener = listener;
    }

    /// Counts a refused handshake.
    pub(super) fn count_refusal(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// Adds a viewer.
    pub(super) fn join(self: &Arc<Self>, address: Option<SocketAddr>, access: Access) -> Viewer {
        let facts = Arc::new(Facts {
            address,
            access,
            subscriptions: AtomicUsize::new(0),
            sent_messages: AtomicU64::new(0),
            dropped_messages: AtomicU64::new(0),
        });
        let mut inner = self.lock();
        inner.count += 1;
        let id = inner.count;
        inner.viewers.insert(id, Arc::clone(&facts));
        drop(inner);
        Viewer {
            id,
            facts,
            all: Arc::clone(self),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Viewer {
    /// Counts a message that was sent.
    pub(super) fn sent(&self, bytes: usize) {
        self.facts.sent_messages.fetch_add(1, Ordering::Relaxed);
        self.all.sent_messages.fetch_add(1, Ordering::Relaxed);
        self.all
            .sent_bytes
            .fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Counts messages that were dropped.
    pub(super) fn dropped(&self, messages: u64) {
        let counts = [&self.facts.dropped_messages, &self.all.dropped_messages];
        for count in counts {
            count.fetch_add(messages, Ordering::Relaxed);
        }
    }

    /// Records the number of subscriptions.
    pub(super) fn set_subscriptions(&self, count: usize) {
        self.facts.subscriptions.store(count, Ordering::Relaxed);
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.all.lock().viewers.remove(&self.id);
    }
}
