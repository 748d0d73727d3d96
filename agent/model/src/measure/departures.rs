//! Times at which one writer's samples left this host, for the send delay and, if one clock covers
//! both ends, the transit time.

use std::collections::VecDeque;

use ros2probe_wire::SequenceNumber;

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::route::Destination;
use crate::facts::tables::LatestDepartures;

/// The latest departures of one writer.
#[derive(Debug, Default)]
pub struct Departures {
    latest: Bounded<LatestDepartures, VecDeque<Departure>>,
    /// Source time of the newest sample that began to leave. As model time, it stays comparable
    /// after a step of the wall clock.
    newest: ModelTime,
}

#[derive(Clone, Copy, Debug)]
struct Departure {
    number: SequenceNumber,
    destination: Destination,
    at: ModelTime,
}

impl Departures {
    /// Returns whether no datagram of the sample with this source time has left before, to any
    /// destination or as a retransmission.
    pub fn is_first(&mut self, source: ModelTime) -> bool {
        let is_first = source > self.newest;
        self.newest = self.newest.max(source);
        is_first
    }

    /// Records that the sample left completely for this destination.
    pub fn note(&mut self, number: SequenceNumber, destination: Destination, at: ModelTime) {
        self.latest.push_back(Departure {
            number,
            destination,
            at,
        });
    }

    /// Returns the time at which the sample left for this destination, if it is remembered.
    #[must_use]
    pub fn find(&self, number: SequenceNumber, destination: Destination) -> Option<ModelTime> {
        let mut latest = self.latest.iter().rev();
        let found = latest.find(|each| each.number == number && each.destination == destination);
        found.map(|departure| departure.at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn departures_for_several_destinations_are_separate_and_bounded() {
        let mut departures = Departures::default();
        let destination = |port| Destination {
            port,
            ..Destination::default()
        };
        for number in 1..=1000 {
            let source = ModelTime::from_nanoseconds(number);
            assert!(departures.is_first(source) && !departures.is_first(source));
            departures.note(
                SequenceNumber(number),
                destination(1),
                ModelTime::from_nanoseconds(number),
            );
            departures.note(
                SequenceNumber(number),
                destination(2),
                ModelTime::from_nanoseconds(number + 5),
            );
        }
        assert_eq!(
            departures.find(SequenceNumber(1000), destination(2)),
            Some(ModelTime::from_nanoseconds(1005))
        );
        assert_eq!(departures.find(SequenceNumber(1), destination(1)), None);
        assert!(departures.latest.len() <= LatestDepartures::CAP);
    }
}
