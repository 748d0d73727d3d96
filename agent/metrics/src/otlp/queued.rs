//! Delivery of events, logs and spans, which wait on disk while the receiver is out of reach, also
//! across restarts.
//!
//! While the receiver answers, nothing is written. A batch that it does not answer is written to
//! disk, and so are the later ones, until all that wait there are delivered: the order stays. A
//! request stays on disk until it is delivered or refused. So a sudden end loses only what arrived
//! since the last write, and may deliver requests twice. Requests that do not fit are divided
//! (`parts.rs`).

use std::cell::{Cell, RefCell};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::sleep;

use super::delivery::{Attempt, Delivery, LAST_BATCH_TIMEOUT, Pauses, Persist, Queue};
use super::exports::Reason;
use super::kept::{Kept, KeptRequest, REQUEST_BYTES};
use super::parts::{Fit, Parts, Step};

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
    fit: Fit,
}

/// Items that are in neither queue.
enum Pending<B> {
    /// They were not offered.
    Batch(B),
    /// What is left of them.
    Parts(Parts),
}

impl<E: Persist> QueuedDelivery<E> {
    pub(super) fn new(delivery: Delivery<E>, kept: Option<Kept>) -> Self {
        Self {
            delivery,
            kept: RefCell::new(kept),
            written: Notify::new(),
            emptied: Notify::new(),
            is_offered: Cell::new(false),
            fit: Fit::default(),
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
        let left = current.into_iter().chain(left.map(Pending::Batch));
        let requests = left.filter_map(|pending| self.rest(&pending));
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
        current: &mut Option<Pending<E::Batch>>,
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
                if !self.settle(current.insert(Pending::Batch(batch))).await {
                    return;
                }
                *current = None;
            }
        }
    }

    /// Delivers items, or writes them to disk. Returns whether they are settled: not, if the agent
    /// stops before.
    async fn settle(&self, pending: &mut Pending<E::Batch>) -> bool {
        let (mut pauses, mut is_stopping) = (Pauses::default(), false);
        loop {
            // Requests on disk are older.
            if !self.is_waiting() && self.offer(pending).await {
                return true;
            }
            let is_first = !self.is_waiting();
            let Some(request) = self.rest(pending) else {
                return true;
            };
            if self.write(&request) {
                if let (true, Pending::Parts(parts)) = (is_first, &*pending) {
                    self.is_offered.set(parts.is_offered);
                }
                return true;
            }
            if is_stopping {
                return false;
            }
            let pause = match pending {
                Pending::Batch(_) => pauses.next(),
                Pending::Parts(parts) => parts.pauses.next(),
            };
            tokio::select! {
                () = sleep(pause) => {}
                () = self.emptied.notified() => {}
                () = self.delivery.wait_stopped() => is_stopping = true,
            }
        }
    }

    /// Offers a batch, or what is left of it, until an offer fails. Returns whether all is settled.
    async fn offer(&self, pending: &mut Pending<E::Batch>) -> bool {
        let parts = match pending {
            Pending::Batch(batch) => {
                // A whole batch would only delay the others if it does not fit.
                let is_offered = !self.fit.is_limited();
                if is_offered && self.delivery.offer_first(batch).await == Attempt::Settled {
                    return true;
                }
                let mut parts = Parts::of::<E>(self.delivery.kept(batch));
                parts.is_offered = is_offered;
                *pending = Pending::Parts(parts);
                if is_offered {
                    return false;
                }
                let Pending::Parts(parts) = pending else {
                    return false;
                };
                parts
            }
            Pending::Parts(parts) => parts,
        };
        while !parts.is_empty() {
            match parts.step(&self.delivery, &self.fit).await {
                Step::Settled => {}
                Step::Failed => return false,
                Step::TooLarge => parts.divide_or_drop(&self.delivery, &self.fit),
            }
        }
        true
    }

    /// Returns the items that are left as a request.
    fn rest(&self, pending: &Pending<E::Batch>) -> Option<KeptRequest> {
        match pending {
            Pending::Batch(batch) => Some(self.delivery.kept(batch)),
            Pending::Parts(parts) => parts.rest(),
        }
    }

    /// Delivers the requests on disk until the agent stops.
    async fn send_kept(&self) {
        while let Some(request) = self.next_kept().await {
            let mut parts = Parts::of::<E>(request);
            parts.is_offered = self.is_offered.take();
            let mut is_failed = parts.is_offered;
            while !parts.is_empty() {
                if is_failed {
                    tokio::select! {
                        () = sleep(parts.pauses.next()) => {}
                        () = self.delivery.wait_stopped() => return,
                    }
                }
                let step = parts.step(&self.delivery, &self.fit).await;
                is_failed = step == Step::Failed;
                if step != Step::Settled && !self.has_read() {
                    self.delivery.drop(Reason::Overflow, parts.items());
                    break;
                }
                if step == Step::TooLarge && !self.is_single() {
                    // Parts of a single record can be noted as settled.
                    self.fit.shrink(parts.size());
                    self.is_offered.set(true);
                    self.rewind();
                    break;
                }
                if step == Step::TooLarge {
                    parts.divide_or_drop(&self.delivery, &self.fit);
                }
                if step != Step::Failed {
                    self.settle_but(parts.items());
                }
            }
        }
    }

    /// Returns the oldest requests on disk as one; `None` if the agent stops.
    async fn next_kept(&self) -> Option<KeptRequest> {
        let mut pauses = Pauses::default();
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
        tokio::select! {
            request = next => Some(request),
            () = self.delivery.wait_stopped() => None,
        }
    }

    /// Returns whether requests wait on disk.
    fn is_waiting(&self) -> bool {
        let kept = self.kept.borrow();
        kept.as_ref().is_some_and(|kept| !kept.is_empty())
    }

    /// Reads requests that fit together. One that does not fit is read alone.
    fn read(&self) -> Option<KeptRequest> {
        let (mut kept, fit) = (self.kept.borrow_mut(), self.fit.size());
        let kept = kept.as_mut()?;
        // The last record that is read may exceed the length.
        let length = match self.fit.is_limited() {
            true => (fit / 2).min(REQUEST_BYTES),
            false => REQUEST_BYTES,
        };
        let request = kept.read(length)?;
        if kept.is_single() || request.encoded.len() <= fit {
            return Some(request);
        }
        kept.rewind();
        kept.read(0)
    }

    /// Returns whether the request that was read is one record.
    fn is_single(&self) -> bool {
        self.kept.borrow().as_ref().is_some_and(Kept::is_single)
    }

    fn rewind(&self) {
        if let Some(kept) = self.kept.borrow_mut().as_mut() {
            kept.rewind();
        }
    }

    /// Returns whether the request that was read is still on disk.
    fn has_read(&self) -> bool {
        self.kept.borrow().as_ref().is_some_and(Kept::has_read)
    }

    /// Removes the request that was read, or notes that only its last items are left.
    fn settle_but(&self, left: u64) {
        let mut kept = self.kept.borrow_mut();
        let Some(kept) = kept.as_mut() else {
            return;
        };
        if left > 0 {
            if kept.has_read() {
                kept.settle_but(left);
            }
            return;
        }
        kept.remove();
        if kept.is_empty() {
            self.emptied.notify_one();
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
