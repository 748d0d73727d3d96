//! The routes of one writer's samples, and the receiver of each.
//!
//! A resolved receiver is kept until the facts that it depends on change. The number of routes is
//! bounded: the one with the longest silence is dropped for a new one.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::{GuidPrefix, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::route::Direction;
use crate::facts::route::{Destination, Route};
use crate::facts::tables::{DepartureTimes, WriterRoutes};
use crate::measure::receivers::{Matched, MatchedReaders};

/// Minimum interval of the departure times that are remembered.
const DEPARTURE_INTERVAL: Duration = Duration::from_secs(1);

/// All routes of one writer, sorted.
#[derive(Debug, Default)]
pub struct Routes {
    routes: Bounded<WriterRoutes, Vec<KnownRoute>>,
    /// Index of the last route that was used.
    last: usize,
    /// Routes dropped because of the cap.
    evictions: u64,
}

/// A route and its receiver.
#[derive(Debug)]
pub struct KnownRoute {
    /// The route.
    pub route: Route,
    /// The participant that receives on it.
    pub owner: Option<GuidPrefix>,
    /// The participant at which messages on it are directed, if that is the only evidence of a
    /// receiver.
    directed_to: Option<GuidPrefix>,
    /// Whether the owner has a reader that matches the writer; for an outgoing multicast, whether
    /// the topic has any reader.
    pub matched: Matched,
    /// Whether one of several participants receives on it, and each has a matching reader.
    pub is_shared: bool,
    /// Index of its delivery, if resolved.
    pub delivery: Option<usize>,
    /// Time of the last observation.
    pub last_seen: ModelTime,
    /// Number of new samples that arrived on it.
    pub new_samples: u64,
    /// Whether it is observed at a socket rather than on a wire.
    pub at_socket: bool,
    /// Whether samples, rather than only control messages, have used it.
    pub has_data: bool,
    /// Highest number that had left, at each remembered time.
    left: Bounded<DepartureTimes, VecDeque<(ModelTime, SequenceNumber)>>,
}

impl Routes {
    /// Returns all routes.
    pub fn iter(&self) -> impl Iterator<Item = &KnownRoute> {
        self.routes.iter()
    }

    /// Returns all routes.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut KnownRoute> {
        self.routes.iter_mut()
    }

    /// Returns the route at this index.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<&KnownRoute> {
        self.routes.get(index)
    }

    /// Returns the route at this index.
    pub fn get_mut(&mut self, index: usize) -> Option<&mut KnownRoute> {
        self.routes.get_mut(index)
    }

    /// Returns the number of routes dropped because of the cap.
    #[must_use]
    pub const fn evictions(&self) -> u64 {
        self.evictions
    }

    /// Returns the index of this route.
    #[must_use]
    pub fn find(&self, route: &Route) -> Option<usize> {
        if self
            .routes
            .get(self.last)
            .is_some_and(|known| known.route == *route)
        {
            return Some(self.last);
        }
        self.routes
            .binary_search_by_key(route, |known| known.route)
            .ok()
    }

    /// Returns the index of this route, adding it if it is new.
    pub fn find_or_insert(
        &mut self,
        route: Route,
        now: ModelTime,
        readers: MatchedReaders<'_>,
    ) -> usize {
        if let Some(index) = self.find(&route) {
            self.last = index;
            return index;
        }
        if self.routes.is_full() {
            let silent = self.routes.iter().enumerate();
            let oldest = silent.min_by_key(|(_, known)| known.last_seen);
            if let Some(index) = oldest.map(|(index, _)| index) {
                self.routes.remove(index);
                self.routes.refuse();
                self.evictions += 1;
            }
        }
        let mut known = KnownRoute {
            route,
            owner: None,
            directed_to: None,
            matched: Matched::Unknown,
            is_shared: false,
            delivery: None,
            last_seen: now,
            new_samples: 0,
            at_socket: false,
            has_data: false,
            left: Bounded::default(),
        };
        known.resolve(readers);
        let index = self.routes.partition_point(|known| known.route < route);
        self.routes.insert(index, known);
        self.last = index;
        index
    }

    /// Replaces the route that was observed at an unknown socket with the same destination by this
    /// one. Returns the replaced route, if any.
    pub fn learn_socket(&mut self, route: Route, readers: MatchedReaders<'_>) -> Option<Route> {
        let unknown = Route { socket: 0, ..route };
        let index = self.find(&unknown)?;
        if !self.routes.get(index)?.at_socket {
            return None;
        }
        let mut known = self.routes.remove(index);
        known.route = route;
        known.resolve(readers);
        let index = self.routes.partition_point(|known| known.route < route);
        self.routes.insert(index, known);
        Some(unknown)
    }

    /// Returns whether datagrams for this destination are observed at sockets.
    #[must_use]
    pub fn is_at_socket(&self, destination: Destination) -> bool {
        let mut routes = self.routes.iter();
        routes.any(|known| known.at_socket && known.route.destination == destination)
    }

    /// Keeps the routes for which `keep` returns true.
    pub fn retain(&mut self, keep: impl FnMut(&KnownRoute) -> bool) {
        self.routes.retain(keep);
    }

    /// Returns the outgoing route to this destination.
    #[must_use]
    pub fn outgoing(&self, destination: Destination) -> Option<&KnownRoute> {
        self.find(&Route {
            direction: Direction::Sent,
            socket: 0,
            destination,
        })
        .and_then(|index| self.routes.get(index))
    }
}

impl KnownRoute {
    /// Resolves the receiver of the route.
    pub fn resolve(&mut self, readers: MatchedReaders<'_>) {
        let (graph, topic) = (readers.graph(), readers.topic());
        let is_there = |prefix: &GuidPrefix| graph.discovery.participants().contains_key(prefix);
        let domain_id = topic.map(|topic| topic.domain_id);
        let owners = graph
            .receivers
            .owners(&self.route, &graph.discovery, domain_id);
        let has_reader = |owner: &GuidPrefix| readers.matched(*owner) == Matched::Yes;
        self.is_shared = owners.len() > 1 && owners.iter().all(has_reader);
        self.owner = match owners[..] {
            [owner] => Some(owner),
            _ => self.directed_to.filter(is_there),
        };
        self.delivery = None;
        let leaves_for_all =
            self.route.direction == Direction::Sent && self.route.destination.is_multicast();
        self.matched = match self.owner {
            _ if leaves_for_all => match topic {
                Some(topic) if !topic.readers.is_empty() => Matched::Yes,
                _ => Matched::Unknown,
            },
            Some(owner) => readers.matched(owner),
            None => Matched::Unknown,
        };
    }

    /// Records a message directed to this participant on a route.
    pub fn note_directed(&mut self, prefix: GuidPrefix, readers: MatchedReaders<'_>) {
        if self.owner.is_none() && self.directed_to != Some(prefix) {
            self.directed_to = Some(prefix);
            self.owner = self.directed_to;
            self.matched = readers.matched(prefix);
        }
    }

    /// Records that all samples up to this number have left by `now`.
    pub fn note_departure(&mut self, number: SequenceNumber, now: ModelTime) {
        let is_due = self
            .left
            .back()
            .is_none_or(|(at, last)| *last != number && *at + DEPARTURE_INTERVAL <= now);
        if is_due {
            self.left.push_back((now, number));
        }
    }

    /// Returns the time from which [`Self::note_departure`] remembers this number;
    /// [`ModelTime::MAX`] if it is already remembered.
    #[must_use]
    pub fn next_mark(&self, number: SequenceNumber) -> ModelTime {
        let last = self.left.back().filter(|(_, last)| *last != number);
        last.map_or(ModelTime::MAX, |(at, _)| *at + DEPARTURE_INTERVAL)
    }

    /// Returns the highest number that had left by this time.
    #[must_use]
    pub fn departed_by(&self, at: ModelTime) -> Option<SequenceNumber> {
        let mut left = self.left.iter().rev();
        left.find(|(moment, _)| *moment <= at)
            .map(|(_, number)| *number)
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::time::SECOND;

    use super::*;

    #[test]
    fn the_newest_sample_that_left_by_a_recent_time_is_known() {
        let mut known = KnownRoute {
            route: Route {
                direction: Direction::Sent,
                socket: 0,
                destination: Destination::default(),
            },
            owner: None,
            directed_to: None,
            matched: Matched::Unknown,
            is_shared: false,
            delivery: None,
            last_seen: ModelTime::ZERO,
            new_samples: 0,
            at_socket: true,
            has_data: true,
            left: Bounded::default(),
        };
        let at = |tenths: u64| ModelTime::from_nanoseconds((1000 + tenths) * SECOND / 10);
        (0..1000).for_each(|tenths| known.note_departure(SequenceNumber(tenths * 3), at(tenths)));
        assert_eq!(known.departed_by(at(500)), None);
        assert_eq!(known.departed_by(at(905)), Some(SequenceNumber(2700)));
        assert_eq!(known.departed_by(at(2000)), Some(SequenceNumber(2970)));
        assert!(known.left.len() <= DepartureTimes::CAP);
    }
}
