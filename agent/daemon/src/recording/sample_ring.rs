//! Ring of the last samples, bounded in bytes and in time, for the moments before an incident.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::Timestamp;

use ros2probe_model::facts::dispatch::Sample;

/// Memory of a sample besides its payload, in bytes.
const SAMPLE_OVERHEAD: usize = 256;

/// The last samples, oldest first.
#[derive(Debug)]
pub struct SampleRing {
    samples: VecDeque<Arc<Sample>>,
    bytes: usize,
    limit: usize,
    span: Option<Duration>,
    /// Samples evicted before the end of the span, for lack of memory.
    evicted: u64,
}

impl SampleRing {
    /// Creates a ring with at most `limit` bytes, and no sample older than `span`.
    #[must_use]
    pub const fn new(limit: usize, span: Option<Duration>) -> Self {
        Self {
            samples: VecDeque::new(),
            bytes: 0,
            limit,
            span,
            evicted: 0,
        }
    }

    /// Returns the size of the ring in bytes.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Returns the number of samples in the ring.
    #[must_use]
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Returns whether the ring is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Returns the number of samples evicted before the end of the span, for lack of memory.
    #[must_use]
    pub const fn evicted(&self) -> u64 {
        self.evicted
    }

    /// Adds a sample, and evicts the oldest ones if necessary.
    pub fn push(&mut self, sample: Arc<Sample>) {
        let now = sample.time;
        self.bytes += cost(&sample);
        self.samples.push_back(sample);
        self.evict(|sample, span| now - sample.time > span);
        while self.bytes > self.limit && self.pop().is_some() {
            self.evicted += 1;
        }
    }

    /// Evicts samples that are too old at `now`, and those of a clock that was ahead and set back.
    pub fn advance(&mut self, now: Timestamp) {
        self.evict(|sample, span| now.distance(sample.time) > span);
    }

    fn evict(&mut self, is_old: impl Fn(&Sample, Duration) -> bool) {
        let Some(span) = self.span else { return };
        while (self.samples.front()).is_some_and(|sample| is_old(sample, span)) {
            self.pop();
        }
    }

    /// Iterates over all samples, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<Sample>> {
        self.samples.iter()
    }

    /// Removes all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.bytes = 0;
    }

    /// Removes and returns all samples, oldest first.
    pub fn drain(&mut self) -> impl Iterator<Item = Arc<Sample>> + use<> {
        self.bytes = 0;
        std::mem::take(&mut self.samples).into_iter()
    }

    fn pop(&mut self) -> Option<Arc<Sample>> {
        let sample = self.samples.pop_front()?;
        self.bytes -= cost(&sample);
        Some(sample)
    }
}

fn cost(sample: &Sample) -> usize {
    SAMPLE_OVERHEAD + sample.payload.as_ref().map_or(0, bytes::Bytes::len)
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::DomainId;
    use ros2probe_wire::Guid;

    use ros2probe_wire::SequenceNumber;

    use super::*;
    use crate::subscriptions::Topic;

    fn sample(seconds: u64, bytes: usize) -> Arc<Sample> {
        Arc::new(Sample {
            topic: Arc::new(Topic {
                domain_id: DomainId(0),
                name: "/a".into(),
                dds_name: "rt/a".into(),
                message_type: "std_msgs/msg/String".into(),
                offered: None,
            }),
            time: Timestamp(seconds * 1_000_000_000),
            writer: Guid::default(),
            sequence_number: SequenceNumber(seconds),
            source_timestamp: None,
            header_stamp: None,
            size: 0,
            sampled: false,
            payload: Some(vec![0; bytes].into()),
        })
    }

    fn numbers(ring: &mut SampleRing) -> Vec<u64> {
        ring.drain()
            .map(|sample| sample.sequence_number.0)
            .collect()
    }

    #[test]
    fn samples_older_than_the_span_are_dropped() {
        let mut ring = SampleRing::new(1 << 20, Some(Duration::from_secs(3)));
        for second in 0..6 {
            ring.push(sample(second, 10));
        }
        assert_eq!((ring.len(), ring.evicted()), (4, 0));
        ring.advance(Timestamp(7_000_000_000));
        assert_eq!(numbers(&mut ring), [4, 5]);
        assert!(ring.is_empty() && ring.bytes() == 0);
    }

    #[test]
    fn bytes_stay_below_the_limit_and_evicted_samples_are_counted() {
        let mut ring = SampleRing::new(3000, None);
        for second in 0..5 {
            ring.push(sample(second, 1000));
            assert!(ring.bytes() <= 3000);
        }
        assert_eq!(ring.evicted(), 3);
        assert_eq!(numbers(&mut ring), [3, 4]);
        // A sample larger than the limit is not kept, and does not affect later ones.
        ring.push(sample(6, 5000));
        assert!(ring.is_empty());
        ring.push(sample(7, 10));
        assert_eq!(ring.len(), 1);
    }
}
