//! The routes of one writer's samples, and to whom each leads.
//!
//! What was found out of a route is kept until something changes that it depends on. Bounded: the
//! route that has been silent longest makes room.

use std::collections::VecDeque;

use ros2probe_wire::time::SECOND;
use ros2probe_wire::{GuidPrefix, SequenceNumber, Timestamp};

use super::receivers::{GraphView, Matched};
use super::route::Direction;
use super::route::{Destination, Route};
use super::size::Size;
use super::topic::Topic;

/// Routes of one writer.
const LIMIT: usize = 512;
/// Moments at which it is known what had left, one a second.
const MOMENTS: usize = 24;

/// All routes of one writer, sorted.
#[derive(Debug, Default)]
pub struct Routes {
    routes: Vec<KnownRoute>,
    /// The one that was used last.
    last: usize,
    /// Routes given up because of the cap.
    evictions: u64,
}

/// One route.
#[derive(Debug)]
pub struct KnownRoute {
    /// Which.
    pub route: Route,
    /// The participant at its end.
    pub owner: Option<GuidPrefix>,
    /// What was directed to it there, where nothing else tells.
    directed_to: Option<GuidPrefix>,
    /// Whether that participant reads the topic; of a multicast that leaves, whether anybody does.
    pub matched: Matched,
    /// Where its delivery stands, if that was looked up.
    pub delivery: Option<usize>,
    /// Last record.
    pub last_seen: Timestamp,
    /// New samples that came by this route.
    pub brought: u64,
    /// It is seen at a socket, not on a wire.
    pub at_socket: bool,
    /// Samples have come by this route.
    pub has_data: bool,
    /// What had left by when.
    left: VecDeque<(Timestamp, SequenceNumber)>,
}

impl Routes {
    /// Entries and cap of every list.
    #[must_use]
    pub fn sizes(&self) -> [Size; 2] {
        // A new list does not compile before it has a place here.
        let Self {
            routes,
            last: _,
            evictions: _,
        } = self;
        let left = |known: &KnownRoute| {
            let KnownRoute {
                route: _,
                owner: _,
                directed_to: _,
                matched: _,
                delivery: _,
                last_seen: _,
                brought: _,
                at_socket: _,
                has_data: _,
                left,
            } = known;
            left.len()
        };
        let left = routes.iter().map(left).max().unwrap_or(0);
        [
            Size::new("routes.routes", routes.len(), LIMIT),
            Size::new("routes.left", left, MOMENTS),
        ]
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = &KnownRoute> {
        self.routes.iter()
    }

    /// All of them.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut KnownRoute> {
        self.routes.iter_mut()
    }

    /// One of them.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<&KnownRoute> {
        self.routes.get(index)
    }

    /// One of them.
    pub fn get_mut(&mut self, index: usize) -> Option<&mut KnownRoute> {
        self.routes.get_mut(index)
    }

    /// Routes given up because of the cap.
    #[must_use]
    pub const fn evictions(&self) -> u64 {
        self.evictions
    }

    /// Where this route stands.
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

    /// Where this route stands, known from now on.
    pub fn find_or_insert(
        &mut self,
        route: Route,
        now: Timestamp,
        graph: &GraphView<'_>,
        topic: Option<&Topic>,
    ) -> usize {
        if let Some(index) = self.find(&route) {
            self.last = index;
            return index;
        }
        if self.routes.len() >= LIMIT {
            let silent = self.routes.iter().enumerate();
            let oldest = silent.min_by_key(|(_, known)| known.last_seen);
            if let Some(index) = oldest.map(|(index, _)| index) {
                self.routes.remove(index);
                self.evictions += 1;
            }
        }
        let mut known = KnownRoute {
            route,
            owner: None,
            directed_to: None,
            matched: Matched::Unknown,
            delivery: None,
            last_seen: now,
            brought: 0,
            at_socket: false,
            has_data: false,
            left: VecDeque::new(),
        };
        known.resolve(graph, topic);
        let index = self.routes.partition_point(|known| known.route < route);
        self.routes.insert(index, known);
        self.last = index;
        index
    }

    /// Whether what is sent to this place is seen at sockets.
    #[must_use]
    pub fn is_at_socket(&self, destination: Destination) -> bool {
        let mut routes = self.routes.iter();
        routes.any(|known| known.at_socket && known.route.destination == destination)
    }

    /// Forgets routes.
    pub fn retain(&mut self, keep: impl FnMut(&KnownRoute) -> bool) {
        self.routes.retain(keep);
    }

    /// The highest number that has left for this place, and what had left by a moment.
    #[must_use]
    pub fn leaving(&self, destination: Destination) -> Option<&KnownRoute> {
        self.find(&Route {
            direction: Direction::Sent,
            socket: 0,
            destination,
        })
        .and_then(|index| self.routes.get(index))
    }
}

impl KnownRoute {
    /// Finds out who is at its end.
    pub fn resolve(&mut self, graph: &GraphView<'_>, topic: Option<&Topic>) {
        let is_there = |prefix: &GuidPrefix| graph.discovery.participants().contains_key(prefix);
        self.owner = graph
            .receivers
            .owner(&self.route, graph.discovery)
            .or(self.directed_to.filter(is_there));
        self.delivery = None;
        let leaves_for_all =
            self.route.direction == Direction::Sent && self.route.destination.is_multicast();
        self.matched = match self.owner {
            _ if leaves_for_all => match topic {
                Some(topic) if !topic.readers.is_empty() => Matched::Yes,
                _ => Matched::Unknown,
            },
            Some(owner) => graph.matched(topic, owner),
            None => Matched::Unknown,
        };
    }

    /// Something was directed to this participant here.
    pub fn note_directed(
        &mut self,
        prefix: GuidPrefix,
        graph: &GraphView<'_>,
        topic: Option<&Topic>,
    ) {
        if self.owner.is_none() && self.directed_to != Some(prefix) {
            self.directed_to = Some(prefix);
            self.owner = self.directed_to;
            self.matched = graph.matched(topic, prefix);
        }
    }

    /// Up to this number everything has left by now.
    pub fn mark(&mut self, number: SequenceNumber, now: Timestamp) {
        let is_due = self
            .left
            .back()
            .is_none_or(|(at, last)| *last != number && at.0.saturating_add(SECOND) <= now.0);
        if is_due {
            if self.left.len() >= MOMENTS {
                self.left.pop_front();
            }
            self.left.push_back((now, number));
        }
    }

    /// Up to which number everything had left then.
    #[must_use]
    pub fn left_by(&self, at: Timestamp) -> Option<SequenceNumber> {
        let mut left = self.left.iter().rev();
        left.find(|(moment, _)| *moment <= at)
            .map(|(_, number)| *number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_had_left_by_a_moment_is_remembered_for_a_while() {
        let mut known = KnownRoute {
            route: Route {
                direction: Direction::Sent,
                socket: 0,
                destination: Destination::default(),
            },
            owner: None,
            directed_to: None,
            matched: Matched::Unknown,
            delivery: None,
            last_seen: Timestamp(0),
            brought: 0,
            at_socket: true,
            has_data: true,
            left: VecDeque::new(),
        };
        let at = |tenths: u64| Timestamp((1000 + tenths) * SECOND / 10);
        (0..1000).for_each(|tenths| known.mark(SequenceNumber(tenths * 3), at(tenths)));
        assert_eq!(known.left_by(at(500)), None);
        assert_eq!(known.left_by(at(905)), Some(SequenceNumber(2700)));
        assert_eq!(known.left_by(at(2000)), Some(SequenceNumber(2970)));
        assert!(known.left.len() <= MOMENTS);
    }
}
