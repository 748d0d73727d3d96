//! Delivery of events, logs and spans, which wait on disk while the receiver is out of reach, also
//! across restarts.
//!
//! While the receiver answers, nothing is written. A batch that it does not answer is written to
//! disk, and so are the later ones, until all that wait there are delivered: the order stays. A
//! request stays on disk until it is delivered or refused. So a sudden end loses only what arrived
//! since the last write, and may deliver requests twice.

use std::cell::{Cell, RefCell};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::sleep;

use super::delivery::{Attempt, Delivery, LAST_BATCH_TIMEOUT, Pauses, Persist, Queue};
use super::exports::Reason;
use super::kept::{Kept, KeptRequest};

/// Time for which items are collected before a write, because each write waits for the storage. If
/// many arrive, it is shorter.
const WRITE_INTERVAL: Duration = Duration::from_secs(5);
const LEAST_WRITE_INTERVAL: Duration = Duration::from_millis(500);

/// A delivery with a queue on disk.
pub(super) struct QueuedDelivery<E: Persist> {
    delivery: Delivery<E>,
    /// `None` without a directory: items wait in memory.
    kept: RefCell<Option<Kept>>,
    /// Completes when a request was written, and when none is left.
    written: Notify,
    emptied: Notify,
    /// Whether the oldest items on disk were offered before they were written.
    is_offered: Cell<bool>,
}

impl<E: Persist> QueuedDelivery<E> {
    pub(super) fn new(delivery: Delivery<E>, kept: Option<Kept>) -> Self {
        Self {
            delivery,
            kept: RefCell::new(kept),
            written: Notify::new(),
            emptied: Notify::new(),
            is_offered: Cell::new(false),
        }
    }

    /// Delivers the items of a queue until the agent stops. Items that arrive within `gather` after
    /// the first one are collected into the same request.
    pub(super) async fn run(self, mut queue: impl Queue<Batch = E::Batch>, gather: Duration) {
        // The batch that is in neither queue.
        let mut current = None;
        let end = async {
            self.delivery.wait_stopped().await;
            sleep(LAST_BATCH_TIMEOUT).await;
        };
        let work = async {
            tokio::join!(
                self.collect(&mut queue, gather, &mut current),
                self.send_kept()
            )
        };
        tokio::select! {
            _ = work => {}
            () = end => {}
        }
        let left = std::iter::from_fn(|| self.delivery.take(&mut queue));
        let left = current.into_iter().chain(left);
        let requests = left.map(|batch| self.delivery.kept(&batch));
        let all = requests.reduce(|mut all, request| {
            all.append(request);
            all
        });
        if let Some(request) = all
            && !self.write(&request)
        {
            self.delivery.drop(Reason::Shutdown, request.items);
        }
    }

    /// Delivers the items of the queue in memory, or writes them to disk. Returns when the agent
    /// stops and the queue is empty, or when its items can be neither delivered nor written.
    async fn collect(
        &self,
        queue: &mut impl Queue<Batch = E::Batch>,
        gather: Duration,
        current: &mut Option<E::Batch>,
    ) {
        let mut is_stopping = false;
        while !is_stopping {
            let gathered = async {
                queue.wait_filled().await;
                if !self.is_waiting() {
                    return sleep(gather).await;
                }
                let mut waited = Duration::ZERO;
                while waited < WRITE_INTERVAL && !queue.is_half_full() {
                    sleep(LEAST_WRITE_INTERVAL).await;
                    waited += LEAST_WRITE_INTERVAL;
                }
            };
            is_stopping = tokio::select! {
                () = gathered => false,
                () = self.delivery.wait_stopped() => true,
            };
            while let Some(batch) = self.delivery.take(queue) {
                if !self.settle(current.insert(batch)).await {
                    return;
                }
                *current = None;
            }
        }
    }

    /// Delivers a batch, or writes it to disk. Returns whether it is settled: not, if the agent
    /// stops before.
    async fn settle(&self, batch: &E::Batch) -> bool {
        let (mut pauses, mut is_again, mut is_stopping) = (Pauses::default(), false, false);
        loop {
            // Requests on disk are older.
            if !self.is_waiting() {
                if self.delivery.offer(batch, is_again).await == Attempt::Settled {
                    return true;
                }
                is_again = true;
            }
            let is_first = !self.is_waiting();
            if self.write(&self.delivery.kept(batch)) {
                if is_first {
                    self.is_offered.set(is_again);
                }
                return true;
            }
            if is_stopping {
                return false;
            }
            tokio::select! {
                () = sleep(pauses.next()) => {}
                () = self.emptied.notified() => {}
                () = self.delivery.wait_stopped() => is_stopping = true,
            }
        }
    }

    /// Delivers the requests on disk until the agent stops.
    async fn send_kept(&self) {
        let mut pauses = Pauses::default();
        loop {
            let next = async {
                loop {
                    if let Some(request) = self.read() {
                        return request;
                    }
                    if self.is_waiting() {
                        // The storage does not answer.
                        sleep(pauses.next()).await;
                    } else {
                        self.written.notified().await;
                    }
                }
            };
            let request = tokio::select! {
                request = next => request,
                () = self.delivery.wait_stopped() => return,
            };
            pauses = Pauses::default();
            let mut is_again = self.is_offered.take();
            loop {
                if is_again {
                    tokio::select! {
                        () = sleep(pauses.next()) => {}
                        () = self.delivery.wait_stopped() => return,
                    }
                }
                let attempt = self.delivery.offer_kept(&request, is_again).await;
                if attempt == Attempt::Settled {
                    self.remove();
                    break;
                }
                is_again = true;
                if !self.has_read() {
                    self.delivery.drop(Reason::Overflow, request.items);
                    break;
                }
            }
            pauses = Pauses::default();
        }
    }

    /// Returns whether requests wait on disk.
    fn is_waiting(&self) -> bool {
        let kept = self.kept.borrow();
        kept.as_ref().is_some_and(|kept| !kept.is_empty())
    }

    fn read(&self) -> Option<KeptRequest> {
        self.kept.borrow_mut().as_mut()?.read()
    }

    /// Returns whether the request that was read is still on disk.
    fn has_read(&self) -> bool {
        self.kept.borrow().as_ref().is_some_and(Kept::has_read)
    }

    fn remove(&self) {
        if let Some(kept) = self.kept.borrow_mut().as_mut() {
            kept.remove();
            if kept.is_empty() {
                self.emptied.notify_one();
            }
        }
    }

    /// Writes a request to disk. Returns whether it is there.
    fn write(&self, request: &KeptRequest) -> bool {
        let mut kept = self.kept.borrow_mut();
        let is_written = kept.as_mut().is_some_and(|kept| kept.append(request));
        if is_written {
            self.written.notify_one();
        }
        is_written
    }
}
