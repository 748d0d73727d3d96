//! References to buffers that publishers of Lyrical send in place of messages, one to each
//! subscription. Of the copies for one message, one counts.

use std::collections::HashMap;
use std::time::Duration;

use ros2probe_wire::Guid;

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{ReferenceLeads, ReferenceWriters};
use crate::measure::topic::Accelerated;

/// Time after which another subscription's references count. It is longer than the time between the
/// copies for one message.
const COPY_GRACE: Duration = Duration::from_millis(100);

/// The writers of references, and whose references count.
#[derive(Debug, Default)]
pub(super) struct References {
    writers: Bounded<ReferenceWriters, HashMap<Guid, Reference>>,
    /// By publisher, the subscription whose references count.
    leads: Bounded<ReferenceLeads, HashMap<Guid, Lead>>,
}

/// A writer that sends references, among other samples with Zenoh.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reference {
    pub(super) publisher: Guid,
    pub(super) accelerated: Accelerated,
}

#[derive(Debug)]
struct Lead {
    /// Writer or gid of the subscription.
    channel: [u8; 16],
    at: ModelTime,
}

/// The part of a reference in the count of messages.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum CountedAs {
    /// The message.
    Message,
    /// The message; the references before it were those of another subscription.
    FirstMessage,
    /// A copy.
    Copy,
}

impl References {
    /// Returns what is known of a writer that sends references.
    pub(super) fn get(&self, writer: Guid) -> Option<Reference> {
        self.writers.get(&writer).copied()
    }

    /// Records a writer that sends references.
    pub(super) fn set(&mut self, writer: Guid, reference: Reference) {
        self.writers.insert(writer, reference);
    }

    /// Forgets a writer.
    pub(super) fn remove(&mut self, writer: Guid) {
        if !self.writers.is_empty() {
            self.writers.remove(&writer);
            self.leads.remove(&writer);
        }
    }

    /// Returns whether a publisher's references in this channel counted last.
    pub(super) fn leads(&self, publisher: Guid, channel: [u8; 16]) -> bool {
        let lead = self.leads.get(&publisher);
        lead.is_some_and(|lead| lead.channel == channel)
    }

    /// Decides about a reference. `channel` is its writer, or the gid of its subscription.
    pub(super) fn count(&mut self, publisher: Guid, channel: [u8; 16], at: ModelTime) -> CountedAs {
        let first = || Lead { channel, at };
        let Some(lead) = self.leads.get_or_insert_with(publisher, first) else {
            return CountedAs::Copy;
        };
        if lead.channel == channel {
            lead.at = at;
            return CountedAs::Message;
        }
        if at <= lead.at + COPY_GRACE {
            return CountedAs::Copy;
        }
        *lead = Lead { channel, at };
        CountedAs::FirstMessage
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::{EntityId, GuidPrefix};

    use super::*;

    #[test]
    fn one_copy_counts_at_any_rate_and_another_one_after_a_pause() {
        let publisher = Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3]));
        for period in [1_u64, 50, 400, 40_000] {
            let mut references = References::default();
            let mut counted = 0;
            for number in 0..100 {
                // The order of the copies changes, and the first subscription leaves.
                let channels: &[u8] = match number {
                    0..50 => &[1, 2, 3],
                    50..70 => &[3, 2, 1],
                    _ => &[2, 3],
                };
                for (place, channel) in channels.iter().enumerate() {
                    let nanoseconds = 1_000_000 * period * (number + 1) + 1000 * place as u64;
                    let at = ModelTime::from_nanoseconds(nanoseconds);
                    let counts = references.count(publisher, [*channel; 16], at);
                    counted += u64::from(counts != CountedAs::Copy);
                }
            }
            // At a high rate, the messages of the pause are missing.
            let missing = if period == 1 { 100 } else { 100 / period + 1 };
            assert!(
                counted <= 100 && counted + missing >= 100,
                "{period}: {counted}"
            );
        }
    }

    #[test]
    fn writers_and_publishers_are_bounded() {
        let mut references = References::default();
        for number in 0..=u16::MAX {
            let [high, low] = number.to_be_bytes();
            let guid = Guid::new(GuidPrefix([2; 12]), EntityId([0, high, low, 3]));
            let reference = Reference {
                publisher: guid,
                accelerated: Accelerated::All,
            };
            references.set(guid, reference);
            references.count(guid, [1; 16], ModelTime::ZERO);
        }
        assert_eq!(references.writers.len(), ReferenceWriters::CAP);
        assert_eq!(references.leads.len(), ReferenceLeads::CAP);
    }
}
