//! Messages that a receiver missed at first, and that arrived by a retransmission.
//!
//! A reliable reader passes messages on in the order of their sequence numbers. So the later messages of
//! the same writer wait until the missed one has arrived (RTPS 2.5, 8.4.10.4). A message that a later
//! one overtook counts as a retransmission.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::{Guid, GuidPrefix, RtpsTime, Timestamp};

use crate::facts::bounded::Bounded;
use crate::facts::calls::late::Repairs;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::Retransmissions;

/// Maximum difference of two source timestamps of one message, in nanoseconds: middlewares round the
/// wire's fraction of a second in different ways.
const ROUNDING: u64 = 1;

/// Time for which a retransmission is remembered. Late calls are reported once a second.
const LIFETIME: Duration = Duration::from_secs(5);

/// The latest retransmissions that reached receivers on this host.
#[derive(Debug, Default)]
pub struct RepairLog(Bounded<Retransmissions, VecDeque<Repaired>>);

/// A message that arrived by a retransmission.
#[derive(Clone, Copy, Debug)]
struct Repaired {
    writer: Guid,
    receiver: GuidPrefix,
    source: Timestamp,
    arrived: ModelTime,
}

/// The message of a call, and when the call began and became ready.
#[derive(Clone, Copy, Debug)]
pub struct Awaited {
    /// Source timestamp of the message.
    pub source: Timestamp,
    /// Start of the call.
    pub started: ModelTime,
    /// Time from ready to start.
    pub wait: Duration,
}

impl RepairLog {
    /// Notes a retransmission of `writer` that arrived at the participant `receiver`.
    pub fn push(
        &mut self,
        (writer, receiver): (Guid, GuidPrefix),
        source: RtpsTime,
        arrived: ModelTime,
    ) {
        let is_old = |first: &Repaired| arrived - first.arrived > LIFETIME;
        while self.0.front().is_some_and(is_old) {
            self.0.pop_front();
        }
        if let Some(source) = source.timestamp() {
            self.0.push_back(Repaired {
                writer,
                receiver,
                source,
                arrived,
            });
        }
    }

    /// Returns the retransmissions for which a call waited: of its message, and of an earlier one.
    /// `concerns` selects them by writer and receiver.
    pub fn of(&self, awaited: Awaited, concerns: impl Fn(Guid, GuidPrefix) -> bool) -> Repairs {
        let mut found = Repairs::default();
        let during = self.0.iter().filter(|repaired| {
            repaired.arrived <= awaited.started
                && awaited.started - repaired.arrived < awaited.wait
                && concerns(repaired.writer, repaired.receiver)
        });
        for repaired in during {
            let before = awaited.started - repaired.arrived;
            if repaired.source.0.abs_diff(awaited.source.0) <= ROUNDING {
                found.of_message = Some(before);
            } else if repaired.source < awaited.source {
                let latest = found.of_earlier.map_or(before, |known| known.min(before));
                found.of_earlier = Some(latest);
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::EntityId;

    use super::*;

    const PAIR: (Guid, GuidPrefix) = (
        Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
        GuidPrefix([2; 12]),
    );
    const SECOND: u64 = 1_000_000_000;
    const MS: u64 = 1_000_000;

    fn at(milliseconds: u64) -> ModelTime {
        ModelTime::ZERO + Duration::from_millis(milliseconds)
    }

    fn source(milliseconds: u64) -> Timestamp {
        Timestamp(1000 * SECOND + milliseconds * MS)
    }

    /// A message that was published at 100 ms was lost, and arrived at 180 ms.
    fn log() -> RepairLog {
        let mut log = RepairLog::default();
        log.push(PAIR, RtpsTime::of(source(100)), at(180));
        log
    }

    fn waited(message: u64, started: u64, wait: u64) -> Repairs {
        log().of(
            Awaited {
                source: source(message),
                started: at(started),
                wait: Duration::from_millis(wait),
            },
            |writer, receiver| (writer, receiver) == PAIR,
        )
    }

    #[test]
    fn a_retransmitted_message_is_found_by_its_source_timestamp() {
        let found = waited(100, 181, 81);
        assert_eq!(found.of_message, Some(Duration::from_millis(1)));
        assert_eq!(found.of_earlier, None);
    }

    #[test]
    fn the_log_keeps_the_latest_retransmissions() {
        let mut log = RepairLog::default();
        for number in 0..5000 {
            log.push(PAIR, RtpsTime::of(source(number)), at(1000 + number / 2));
        }
        assert_eq!(log.0.len(), Retransmissions::CAP);
        let newest = log.0.back().unwrap();
        assert_eq!(newest.source, source(4999));
        log.push(PAIR, RtpsTime::of(source(9_000)), at(10_000));
        assert_eq!(log.0.len(), 1);
    }

    #[test]
    fn a_later_message_waited_for_the_retransmission() {
        let found = waited(110, 182, 72);
        assert_eq!(found.of_message, None);
        assert_eq!(found.of_earlier, Some(Duration::from_millis(2)));
    }

    #[test]
    fn an_earlier_message_did_not_wait_for_it() {
        assert_eq!(waited(90, 190, 100), Repairs::default());
    }

    #[test]
    fn a_message_published_after_the_retransmission_did_not_wait_for_it() {
        assert_eq!(waited(200, 230, 30), Repairs::default());
    }
}
