//! Detection of routers whose INIT was missed, and of sessions that are known only through a
//! router.
//!
//! To a peer and to another router, a router declares only the tokens of sessions behind further
//! routers. Those sessions end with the last connection of the router to another router.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::zenoh::{PORT, Side, WhatAmI, ZenohId};

use super::Zenoh;
use super::processes::{Holder, OwnerChange};
use super::stream::StreamId;
use super::stream_state::StreamState;
use crate::facts::model_time::ModelTime;

/// Time after which all connections older than the agent have been seen. It is longer than the
/// interval of KEEP_ALIVE that rmw_zenoh configures, 30 s.
const ALL_SEEN: Duration = Duration::from_secs(35);
/// Time in which another connection of a router may replace one that ended.
const REPLACEMENT_TIMEOUT: Duration = Duration::from_secs(1);

impl Zenoh {
    /// Determines which ends of connections are routers, from the processes that hold the sockets.
    /// A process with a router has no second router and no ROS session.
    pub(super) fn find_routers(
        &mut self,
        holder: impl Fn(u64) -> Option<Holder>,
    ) -> Vec<OwnerChange> {
        let mut changes = Vec::new();
        let known = self.graph.sessions().map(ZenohId::guid_prefix);
        let known: BTreeSet<_> = known.collect();
        let mut routers: BTreeMap<u32, Option<Side>> = BTreeMap::new();
        let mut sessions = BTreeSet::new();
        let mut forwards: BTreeMap<u32, [BTreeSet<ZenohId>; 2]> = BTreeMap::new();
        for (stream, direction) in &self.directions {
            let Some(holder) = holder(stream.socket).filter(|_| !direction.has_left) else {
                continue;
            };
            let process = holder.process_id;
            if holder
                .session
                .is_some_and(|session| known.contains(&session))
            {
                sessions.insert(process);
            }
            if stream.outgoing && direction.is_of_router(stream) {
                let known = routers.entry(process).or_default();
                *known = known.or(direction.sender);
            }
            if let Some(source) = direction.source() {
                let [sent, received] = forwards.entry(process).or_default();
                let side = if stream.outgoing { sent } else { received };
                side.insert(source);
            }
        }
        for (process, [sent, received]) in forwards {
            // A session does not receive what it publishes.
            if !sent.is_disjoint(&received) {
                sessions.remove(&process);
                routers.entry(process).or_default();
            }
        }
        for (stream, direction) in &mut self.directions {
            let process = holder(stream.socket).map(|holder| holder.process_id);
            let process = process.filter(|process| !sessions.contains(process));
            let router = process.and_then(|process| routers.get(&process));
            let Some(router) = router else {
                continue;
            };
            if !stream.outgoing {
                direction.is_for_router = true;
                direction.receiver = *router;
            } else if direction.sender.is_none() {
                let before = direction.owner(stream);
                direction.is_router = true;
                direction.linked = None;
                direction.sender = *router;
                self.revision += u64::from(router.is_some());
                let after = direction.owner(stream);
                if before != after {
                    changes.push(OwnerChange {
                        socket: stream.socket,
                        before,
                        after,
                    });
                }
            }
        }
        changes
    }

    /// Returns whether the receiver of a direction is a router, as far as is known. A message to a
    /// router is not a delivery.
    pub(super) fn is_for_router(&self, stream: &StreamId) -> bool {
        let own = self.directions.get(stream);
        let opposite = self.opposite(stream);
        if let Some(side) = self.receiver(stream) {
            return side.whatami == WhatAmI::Router;
        }
        if own.is_some_and(|own| own.is_for_router)
            || opposite.is_some_and(|opposite| opposite.is_router)
        {
            return true;
        }
        if opposite.is_some_and(|opposite| opposite.session().is_some()) {
            return false;
        }
        // Sessions listen on other ports, and connect to the router of their own host.
        stream.flow.destination.port == PORT
            || stream.flow.source.port == PORT && !stream.is_loopback()
    }

    /// Returns the receiver of a direction, if an INIT, saved state or its process shows it.
    pub(super) fn receiver(&self, stream: &StreamId) -> Option<Side> {
        let opposite = self.opposite(stream).and_then(|opposite| opposite.sender);
        let own = || self.directions.get(stream)?.receiver;
        opposite
            .or_else(own)
            .or_else(|| self.remembered.sender(stream.flow.reversed()))
    }

    /// Returns the router that forwards the tokens of other routers' sessions in this direction.
    pub(super) fn passing_router(&self, stream: &StreamId) -> Option<ZenohId> {
        let sender = self.directions.get(stream)?.sender?;
        let receiver = self.receiver(stream)?;
        match (sender.whatami, receiver.whatami) {
            (WhatAmI::Router, WhatAmI::Peer) => Some(sender.zid),
            (WhatAmI::Router, WhatAmI::Router) => Some(receiver.zid),
            _ => None,
        }
    }

    /// Records the end of a connection that may connect two routers.
    pub(super) fn note_cut(&mut self, stream: &StreamId, now: ModelTime) {
        for router in self.ends_of_link(stream) {
            if self.graph.has_passages(router) {
                self.cut_routers.insert(router, now);
            }
        }
    }

    /// Ends the sessions that a router no longer reaches.
    pub fn end_unreachable(&mut self, now: ModelTime) {
        let is_due = |at: ModelTime| at + REPLACEMENT_TIMEOUT <= now;
        if now < self.began + ALL_SEEN || !self.cut_routers.values().any(|at| is_due(*at)) {
            return;
        }
        let due = self.cut_routers.iter().filter(|(_, at)| is_due(**at));
        let due: Vec<_> = due.map(|(router, _)| *router).collect();
        self.cut_routers.retain(|_, at| !is_due(*at));
        for router in due {
            let mut streams = self.directions.keys();
            if streams.any(|stream| self.is_link_of(router, stream)) {
                // It is unknown which sessions are behind the remaining connection.
                continue;
            }
            for session in self.graph.remove_passages(router) {
                if !self.is_reachable_without(session, router) {
                    self.graph.end(session);
                    self.revision += 1;
                }
            }
        }
    }

    /// Removes tokens that a router forwarded before but omits from its complete answer to a new
    /// session.
    pub(super) fn remove_omitted_tokens(&mut self, stream: &StreamId, interest: u32) {
        let asked = self
            .opposite(stream)
            .and_then(|opposite| opposite.requested_interest);
        let Some((_, domain)) = asked.filter(|(id, _)| *id == interest) else {
            return;
        };
        let is_peer = |side: Side| side.whatami == WhatAmI::Peer;
        let to_peer = self.receiver(stream).is_some_and(is_peer);
        let Some(router) = self.passing_router(stream).filter(|_| to_peer) else {
            return;
        };
        for session in self.graph.passages_of(router) {
            if !self.is_reachable_without(session, router) {
                self.graph.drop_undeclared_tokens(session, domain);
            }
        }
    }

    /// Returns whether a session is reachable without this router.
    fn is_reachable_without(&self, session: ZenohId, router: ZenohId) -> bool {
        let mut directions = self.directions.iter();
        let has_own = directions.any(|(stream, direction)| {
            direction.session() == Some(session) && self.is_open(stream, direction)
        });
        let declarers = self.graph.declarers(session);
        let mut others = self.directions.values();
        self.remembered.has(session)
            || has_own
            || others.any(|each| {
                declarers.contains(&each.number)
                    && each.sender.is_none_or(|side| side.zid != router)
            })
    }

    /// Returns whether neither end has left the connection.
    pub(super) fn is_open(&self, stream: &StreamId, direction: &StreamState) -> bool {
        !direction.has_left && self.opposite(stream).is_none_or(|other| !other.has_left)
    }

    fn is_link_of(&self, router: ZenohId, stream: &StreamId) -> bool {
        let direction = self.directions.get(stream);
        direction.is_some_and(|direction| self.is_open(stream, direction))
            && self.ends_of_link(stream).any(|end| end == router)
    }

    /// Returns the known routers at the ends of a connection, if it may connect two routers.
    fn ends_of_link(&self, stream: &StreamId) -> impl Iterator<Item = ZenohId> + use<> {
        let sender = self.directions.get(stream).and_then(|each| each.sender);
        let sender = sender.or_else(|| self.remembered.sender(stream.flow));
        let receiver = self.receiver(stream);
        let is_session = |side: Option<Side>, session: Option<ZenohId>, is_router: bool| match side
        {
            Some(side) => side.whatami != WhatAmI::Router,
            None => session.is_some() || stream.is_loopback() && !is_router,
        };
        let own = self.directions.get(stream);
        let opposite = self.opposite(stream);
        let sends = is_session(
            sender,
            own.and_then(|each| each.session()),
            own.is_some_and(|each| each.is_of_router(stream)),
        );
        let receives = is_session(
            receiver,
            opposite.and_then(|each| each.session()),
            self.is_for_router(stream),
        );
        let ends = [sender, receiver].into_iter().flatten();
        let routers = ends.filter(|side| side.whatami == WhatAmI::Router);
        let routers: Vec<_> = routers.map(|side| side.zid).collect();
        routers.into_iter().filter(move |_| !sends && !receives)
    }
}

/// Returns the domain of a key with which rmw_zenoh subscribes to the graph.
pub(super) fn domain_of_graph(key: &str) -> Option<DomainId> {
    let domain = key.strip_prefix("@ros2_lv/")?.strip_suffix("/**")?;
    domain.parse().ok().map(DomainId)
}
