//! Messages that a receiver missed at first, until they arrived by a retransmission or their writer
//! gave them up.
//!
//! A reliable reader passes messages on in the order of their sequence numbers. So the later
//! messages of the same writer wait until the missed one has arrived (RTPS 2.5, 8.4.10.4). A GAP
//! ends that wait, too (8.3.8.4), and so does a HEARTBEAT with a higher firstSN (8.3.8.6). A message
//! that a later one overtook counts as a retransmission.

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

/// The latest retransmissions, and GAPs or HEARTBEATs in their place, that reached receivers on this
/// host.
#[derive(Debug, Default)]
pub struct RepairLog(Bounded<Retransmissions, VecDeque<Repaired>>);

/// A message that arrived by a retransmission, or that its writer gave up.
#[derive(Clone, Copy, Debug)]
struct Repaired {
    writer: Guid,
    receiver: GuidPrefix,
    /// Source timestamp of the message, or a time between those of its neighbours.
    source: Timestamp,
    arrived: ModelTime,
    is_message: bool,
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
        if let Some(source) = source.timestamp() {
            self.add(Repaired {
                writer,
                receiver,
                source,
                arrived,
                is_message: true,
            });
        }
    }

    /// Notes that `writer` gave up a message that the participant `receiver` missed. `source` is a
    /// time between those of the messages before and after it.
    pub fn push_given_up(
        &mut self,
        (writer, receiver): (Guid, GuidPrefix),
        source: Timestamp,
        arrived: ModelTime,
    ) {
        self.add(Repaired {
            writer,
            receiver,
            source,
            arrived,
            is_message: false,
        });
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
            let is_near = repaired.source.0.abs_diff(awaited.source.0) <= ROUNDING;
            if is_near && repaired.is_message {
                found.of_message = Some(before);
            } else if !is_near && repaired.source < awaited.source {
                let latest = found.of_earlier.map_or(before, |known| known.min(before));
                found.of_earlier = Some(latest);
            }
        }
        found
    }

    fn add(&mut self, repaired: Repaired) {
        let is_old = |first: &Repaired| repaired.arrived - first.arrived > LIFETIME;
        while self.0.front().is_some_and(is_old) {
            self.0.pop_front();
        }
        self.0.push_back(repaired);
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
    fn a_message_given_up_releases_those_after_it_and_none_before() {
        let mut log = RepairLog::default();
        log.push_given_up(PAIR, source(105), at(180));
        let waited = |message: u64| {
            log.of(
                Awaited {
                    source: source(message),
                    started: at(182),
                    wait: Duration::from_millis(82),
                },
                |_, _| true,
            )
        };
        assert_eq!(waited(110).of_earlier, Some(Duration::from_millis(2)));
        for message in [100, 105] {
            assert_eq!(waited(message), Repairs::default(), "{message}");
        }
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
