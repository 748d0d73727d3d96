//! Delivery of one signal's requests, and its end.
//!
//! Callers bound the pending requests: one batch is in progress, and no other is collected before
//! it is delivered or dropped.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::{Instant, timeout, timeout_at};
use tokio_util::sync::CancellationToken;

use super::client::{Client, Request};
use super::exports::Reason;

/// Time for the last batch, out of the two seconds for stopping.
const LAST: Duration = Duration::from_millis(1_400);

/// A client that stops with the agent.
pub(super) struct SignalSender {
    client: Client,
    stop: CancellationToken,
    /// Requests that were pending when the agent began to stop.
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

    /// Completes when the agent stops.
    pub(super) async fn stopped(&self) {
        self.stop.cancelled().await;
    }

    /// Returns whether the agent is stopping.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop.is_cancelled()
    }

    /// Counts items that never became part of a request.
    pub(super) fn overflowed(&self, items: u64) {
        self.client.drop(Reason::Overflow, items);
    }

    /// Delivers a batch until it is delivered or refused, until `newer`, or until the agent stops.
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

    /// Sends the last batch, once per request. It replaces pending requests if `instead`, otherwise
    /// it follows them.
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
