//! Reads the agent's stream ahead of the storage.
//!
//! A disk that stalls for seconds would otherwise fill the agent's queue, which is small and shared
//! by all clients. The messages wait in this process instead, up to `--max-cache-size`.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe::client::{ClientError, Samples};
use ros2probe_daemon::subscriptions::{Item, NextItem};

/// Memory of a waiting item besides its payload, in bytes.
const ITEM_OVERHEAD: usize = 256;
/// Maximum time until the reader notices that the recording has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Items between the reader and the storage, bounded in bytes.
#[derive(Debug)]
pub(super) struct ReadAhead {
    most_bytes: usize,
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Queue {
    items: VecDeque<Item>,
    bytes: usize,
    /// How the stream ended.
    end: Option<Result<(), ClientError>>,
    /// Whether the consumer has ended.
    is_closed: bool,
}

impl ReadAhead {
    /// Returns an empty queue for this many bytes. It also holds a single larger item.
    pub(super) fn new(most_bytes: usize) -> Self {
        Self {
            most_bytes,
            queue: Mutex::default(),
            changed: Condvar::new(),
        }
    }

    /// Reads until the stream ends or [`Self::close`] is called. While the queue is full, the
    /// stream waits in the agent.
    pub(super) fn read(&self, samples: &mut Samples<'_>) {
        loop {
            let end = match samples.next_within(POLL_INTERVAL) {
                Ok(NextItem::Item(item)) => {
                    self.push(item);
                    None
                }
                Ok(NextItem::Pending) => None,
                Ok(NextItem::Closed) => Some(Ok(())),
                Err(error) => Some(Err(error)),
            };
            let mut queue = self.lock();
            if end.is_some() {
                queue.end = end;
                self.changed.notify_all();
                return;
            }
            if queue.is_closed {
                return;
            }
        }
    }

    /// Waits for the next item for at most `timeout`.
    ///
    /// # Errors
    ///
    /// Fails if the stream broke, after every earlier item was returned.
    pub(super) fn next(&self, timeout: Duration) -> Result<NextItem, ClientError> {
        let deadline = Instant::now() + timeout;
        let mut queue = self.lock();
        loop {
            if let Some(item) = queue.items.pop_front() {
                queue.bytes -= size(&item);
                self.changed.notify_all();
                return Ok(NextItem::Item(item));
            }
            if let Some(end) = queue.end.take() {
                queue.end = Some(Ok(()));
                return end.map(|()| NextItem::Closed);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(NextItem::Pending);
            }
            let waited = self.changed.wait_timeout(queue, left);
            (queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Returns whether no item waits.
    pub(super) fn is_empty(&self) -> bool {
        self.lock().items.is_empty()
    }

    /// Ends the reader.
    pub(super) fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Adds an item as soon as the queue has space.
    fn push(&self, item: Item) {
        let bytes = size(&item);
        let mut queue = self.lock();
        while queue.bytes > 0 && queue.bytes + bytes > self.most_bytes && !queue.is_closed {
            let waited = self.changed.wait(queue);
            queue = waited.unwrap_or_else(PoisonError::into_inner);
        }
        queue.items.push_back(item);
        queue.bytes += bytes;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn size(item: &Item) -> usize {
    let payload = match item {
        Item::Sample(sample) => sample.payload.as_ref(),
        Item::Missed(_) | Item::Clock(_) | Item::End(_) => None,
    };
    ITEM_OVERHEAD + payload.map_or(0, bytes::Bytes::len)
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Timestamp;

    use super::*;

    fn taken(ahead: &ReadAhead) -> Option<u64> {
        match ahead.next(Duration::ZERO) {
            Ok(NextItem::Item(Item::Clock(at))) => Some(at.0),
            _ => None,
        }
    }

    #[test]
    fn a_full_queue_makes_the_reader_wait_until_an_item_is_taken() {
        let ahead = ReadAhead::new(2 * ITEM_OVERHEAD);
        std::thread::scope(|scope| {
            let reader = scope.spawn(|| {
                for number in 0..4 {
                    ahead.push(Item::Clock(Timestamp(number)));
                    assert!(ahead.lock().bytes <= 2 * ITEM_OVERHEAD);
                }
            });
            let mut next = 0;
            while next < 4 {
                if let Some(number) = taken(&ahead) {
                    assert_eq!(number, next);
                    next += 1;
                }
            }
            reader.join().unwrap();
        });
        assert_eq!(ahead.lock().bytes, 0);
    }

    #[test]
    fn closing_the_queue_releases_a_reader_that_waits_for_space() {
        let ahead = ReadAhead::new(1);
        ahead.push(Item::Clock(Timestamp(1)));
        std::thread::scope(|scope| {
            let reader = scope.spawn(|| ahead.push(Item::Clock(Timestamp(2))));
            ahead.close();
            reader.join().unwrap();
        });
    }

    #[test]
    fn the_end_of_the_stream_is_returned_after_its_last_item() {
        let ahead = ReadAhead::new(ITEM_OVERHEAD);
        ahead.push(Item::Clock(Timestamp(7)));
        ahead.lock().end = Some(Ok(()));
        assert_eq!(taken(&ahead), Some(7));
        for _ in 0..2 {
            assert!(matches!(ahead.next(Duration::ZERO), Ok(NextItem::Closed)));
        }
    }
}
