//! One signal's way out: what is delivered, what is given up, and the end of it all.
//!
//! What waits is bounded by who calls: one batch is under way, and nothing is collected before it is
//! settled.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::{Instant, timeout, timeout_at};
use tokio_util::sync::CancellationToken;

use super::client::{Client, Request};
use super::exports::Reason;

/// For what goes out last, of the two seconds that ending may take.
const LAST: Duration = Duration::from_millis(1_400);

/// A client that knows when to stop.
pub(super) struct SignalSender {
    client: Client,
    stop: CancellationToken,
    /// What was under way when the end was asked for.
    left: VecDeque<Request>,
}

impl SignalSender {
    pub(super) const fn new(client: Client, stop: CancellationToken) -> Self {
        Self {
            client,
            stop,
            left: VecDeque::new(),
        }
    }

    /// Completes when the agent ends.
    pub(super) async fn stopped(&self) {
        self.stop.cancelled().await;
    }

    /// Whether the agent ends.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop.is_cancelled()
    }

    /// Counts what never became a request.
    pub(super) fn overflowed(&self, items: u64) {
        self.client.drop(Reason::Overflow, items);
    }

    /// Delivers a batch until it is settled, until `newer` has come to take its place, or until
    /// the agent ends.
    pub(super) async fn deliver(&mut self, batch: Vec<Request>, newer: Option<Instant>) {
        self.left = batch.into();
        let delivery = self.client.deliver(&mut self.left);
        let delivered = async {
            match newer {
                Some(newer) => timeout_at(newer, delivery).await.is_ok(),
                None => {
                    delivery.await;
                    true
                }
            }
        };
        let settled = tokio::select! {
            settled = delivered => settled,
            () = self.stop.cancelled() => return,
        };
        if !settled {
            self.client.overtaken();
            self.give_up(Reason::Superseded);
        }
    }

    /// The last batch: with what was under way, or instead of it where it says the same anew. Each
    /// request is tried once.
    pub(super) async fn finish(mut self, batch: Vec<Request>, instead: bool) {
        if instead {
            self.give_up(Reason::Superseded);
        }
        self.left.extend(batch);
        let last = self.client.deliver_once(&mut self.left);
        let _ = timeout(LAST, last).await;
        self.give_up(Reason::Shutdown);
    }

    fn give_up(&mut self, reason: Reason) {
        let items = self.left.drain(..).map(|request| request.items).sum();
        self.client.drop(reason, items);
    }
}
