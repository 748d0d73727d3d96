//! Reassembly of discovery samples from DATA_FRAGs. Cyclone DDS fragments samples of 1344 bytes and
//! more, and `ros_discovery_info` of a participant with a few nodes exceeds that size.
//!
//! Only samples that the model reads are reassembled here, not measured ones. Memory grows only
//! with bytes that arrived, up to a budget. Above it, the oldest sample is dropped.

use std::collections::{BTreeMap, VecDeque};

use crate::facts::bounded::{Bounded, Sum};
use crate::facts::observation::{self, DataFrag};
use crate::facts::tables::{DiscoveryBytes, DiscoverySamples};
use ros2probe_wire::{Guid, SequenceNumber};

/// Maximum size of a sample in bytes, far above any discovery data.
const MAX_SAMPLE: u32 = 256 * 1024;
/// Memory per fragment in addition to its bytes.
const FRAGMENT_OVERHEAD: usize = 64;

/// The unfinished samples, oldest first.
#[derive(Debug, Default)]
pub struct DiscoveryFragments {
    samples: Bounded<DiscoverySamples, VecDeque<Sample>>,
    bytes: Sum<DiscoveryBytes>,
    evictions: u64,
}

#[derive(Debug)]
struct Sample {
    writer: Guid,
    number: SequenceNumber,
    size: u32,
    fragment_size: u32,
    fragments: BTreeMap<u32, Box<[u8]>>,
    bytes: usize,
}

impl DiscoveryFragments {
    /// Returns whether fragments of this sample are kept.
    #[must_use]
    pub fn holds(&self, sample: &observation::Sample) -> bool {
        self.place(sample).is_some()
    }

    /// Returns the numbers of the missing fragments of an unfinished sample, counted from 1.
    pub fn missing(&self, writer: Guid, number: SequenceNumber) -> impl Iterator<Item = u32> + '_ {
        let mut samples = self.samples.iter();
        let sample = samples.find(|each| (each.writer, each.number) == (writer, number));
        sample.into_iter().flat_map(|sample| {
            let total = sample.size.div_ceil(sample.fragment_size);
            (1..=total).filter(|fragment| !sample.fragments.contains_key(fragment))
        })
    }

    /// Returns the number of samples dropped.
    #[must_use]
    pub const fn evictions(&self) -> u64 {
        self.evictions
    }

    /// Adds the fragments of a DATA_FRAG. Returns the payload once it is complete.
    pub fn put(
        &mut self,
        sample: &observation::Sample,
        fragments: DataFrag,
        bytes: &[u8],
    ) -> Option<Vec<u8>> {
        let (size, fragment_size) = (fragments.sample_size, fragments.fragment_size);
        if size > MAX_SAMPLE || size == 0 || fragment_size == 0 || fragments.starting == 0 {
            return None;
        }
        let index = match self.place(sample) {
            Some(index) => index,
            None => self.begin(sample, fragments),
        };
        let sample = self.samples.get_mut(index)?;
        let total = fragments.total();
        if sample.size == size && sample.fragment_size == fragment_size {
            let chunks = bytes.chunks(usize::try_from(fragment_size).ok()?);
            for (number, chunk) in (fragments.starting..=total).zip(chunks) {
                let last = if number == total {
                    size - (total - 1) * fragment_size
                } else {
                    fragment_size
                };
                // The last fragment may have padding after it.
                let Some(chunk) = chunk.get(..usize::try_from(last).ok()?) else {
                    break;
                };
                if sample.fragments.insert(number, chunk.into()).is_none() {
                    sample.bytes += chunk.len() + FRAGMENT_OVERHEAD;
                    self.bytes.add(chunk.len() + FRAGMENT_OVERHEAD);
                }
            }
        }
        if sample.fragments.len() == usize::try_from(total).ok()? {
            let sample = self.samples.remove(index)?;
            self.bytes.sub(sample.bytes);
            let parts: Vec<_> = sample.fragments.into_values().collect();
            return Some(parts.concat());
        }
        while self.bytes.is_exceeded() {
            let oldest = self.samples.pop_front()?;
            self.evict(&oldest);
        }
        None
    }

    /// Adds a sample without fragments and returns its index.
    fn begin(&mut self, sample: &observation::Sample, fragments: DataFrag) -> usize {
        let evicted = self.samples.push_back(Sample {
            writer: sample.head.writer,
            number: sample.sequence_number,
            size: fragments.sample_size,
            fragment_size: fragments.fragment_size,
            fragments: BTreeMap::new(),
            bytes: FRAGMENT_OVERHEAD,
        });
        if let Some(oldest) = evicted {
            self.evict(&oldest);
        }
        self.bytes.add(FRAGMENT_OVERHEAD);
        self.samples.len() - 1
    }

    fn evict(&mut self, sample: &Sample) {
        self.bytes.sub(sample.bytes);
        self.evictions += 1;
    }

    fn place(&self, sample: &observation::Sample) -> Option<usize> {
        let (writer, number) = (sample.head.writer, sample.sequence_number);
        self.samples
            .iter()
            .position(|each| each.writer == writer && each.number == number)
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Record;
    use ros2probe_wire::record::kind;

    use super::*;
    use crate::facts::observation::tests::{fragments, sample};

    fn put(
        discovery_fragments: &mut DiscoveryFragments,
        record: &Record,
        bytes: &[u8],
    ) -> Option<Vec<u8>> {
        let sample = sample(record);
        discovery_fragments.put(&sample, fragments(&sample), bytes)
    }

    fn fragment(number: u64, start: u32, count: u32, size: u32) -> Record {
        Record {
            kind: kind::DATA_FRAG,
            sequence_number: number,
            fragment_start: start,
            fragments: count << 16 | 100,
            sample_size: size,
            ..Record::default()
        }
    }

    #[test]
    fn fragments_in_any_order_and_in_groups_form_the_payload() {
        let payload: Vec<u8> = (0..=249).collect();
        let mut discovery_fragments = DiscoveryFragments::default();
        assert_eq!(
            put(
                &mut discovery_fragments,
                &fragment(1, 3, 1, 250),
                &payload[200..]
            ),
            None
        );
        assert!(discovery_fragments.holds(&sample(&fragment(1, 1, 1, 250))));
        assert_eq!(
            put(
                &mut discovery_fragments,
                &fragment(1, 1, 2, 250),
                &payload[..200]
            ),
            Some(payload)
        );
        assert_eq!(
            (
                discovery_fragments.bytes.used(),
                discovery_fragments.samples.len()
            ),
            (0, 0)
        );
    }

    #[test]
    fn a_storm_of_claimed_sizes_stays_within_the_budget() {
        let mut discovery_fragments = DiscoveryFragments::default();
        assert_eq!(
            put(
                &mut discovery_fragments,
                &fragment(1, 1, 1, u32::MAX),
                &[0; 100]
            ),
            None
        );
        for number in 0..100_000 {
            put(
                &mut discovery_fragments,
                &fragment(number, 1, 1, 200_000),
                &[0; 100],
            );
        }
        assert!(!discovery_fragments.bytes.is_exceeded() && discovery_fragments.evictions > 0);
    }

    #[test]
    fn large_unfinished_samples_stay_within_the_budget() {
        let mut discovery_fragments = DiscoveryFragments::default();
        for number in 0..1000 {
            put(
                &mut discovery_fragments,
                &fragment(number, 1, 500, 200_000),
                &[0; 50_000],
            );
        }
        let used = discovery_fragments.bytes.used();
        let cap = DiscoveryBytes::CAP;
        assert!((cap * 8 / 10..=cap).contains(&used), "{used} bytes");
        assert!(discovery_fragments.evictions > 900);
    }
}
