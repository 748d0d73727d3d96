//! Start and end of connections, with the tokens and sessions that end with them.

use std::collections::BTreeSet;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::GuidPrefix;
use ros2probe_wire::zenoh::ZenohId;

use super::Zenoh;
use super::stream::{Flow, StreamId, Unseen};
use super::stream_state::StreamState;
use crate::facts::model_time::ModelTime;

/// Lease that rmw_zenoh configures.
const DEFAULT_LEASE: Duration = Duration::from_secs(60);
/// Part of its lease after which a sender is silent. A live sender sends several times in each
/// lease, and the other end closes the connection after the whole lease.
const SILENT_LEASE_RATIO: f64 = 0.9;

impl Zenoh {
    /// Returns the opposite direction, seen at the same socket or interface or, on the loopback
    /// interface, at the other socket.
    pub(super) fn opposite(&self, stream: &StreamId) -> Option<&StreamState> {
        self.opposite_entry(stream).map(|(_, direction)| direction)
    }

    /// Returns the stream and the state of [`Self::opposite`].
    fn opposite_entry(&self, stream: &StreamId) -> Option<(&StreamId, &StreamState)> {
        match self.directions.get_key_value(&stream.reversed()) {
            Some((place, direction)) => Some((place, &**direction)),
            None => self.opposite_of_flow(stream),
        }
    }

    /// Returns the opposite direction, and the stream in which it was last seen.
    fn opposite_of_flow(&self, stream: &StreamId) -> Option<(&StreamId, &StreamState)> {
        let place = self.flows.get(&stream.flow.reversed())?;
        Some((place, self.directions.get(place)?))
    }

    /// Returns the receiving socket of a direction on the loopback interface, if its session is
    /// known; else 0.
    pub(super) fn receiving_socket(&self, stream: &StreamId) -> u64 {
        let other = self
            .opposite_of_flow(stream)
            .filter(|_| stream.is_loopback());
        let owned = other.filter(|(place, direction)| direction.owner(place).is_some());
        owned.map_or(0, |(place, _)| place.socket)
    }

    /// Returns the sockets of this host that a session owns, as far as is known.
    pub fn sockets(&self, session: GuidPrefix) -> impl Iterator<Item = u64> + '_ {
        let owned = self.directions.iter().filter(move |(stream, direction)| {
            let owner = direction.owner(stream);
            owner.is_some_and(|owner| owner.guid_prefix() == session)
        });
        owned.map(|(stream, _)| stream.socket)
    }

    pub(super) fn direction(&mut self, stream: &StreamId) -> Option<&mut StreamState> {
        if !self.directions.contains_key(stream) {
            if self.directions.is_full() {
                self.directions.refuse();
                let oldest = self.directions.iter();
                let oldest = oldest.min_by_key(|(id, direction)| (direction.last_seen, **id));
                let oldest = oldest.map(|(id, _)| *id)?;
                self.begin(&oldest);
            }
            let sender = self.remembered.take(stream.flow);
            self.numbered += 1;
            let direction = Box::new(StreamState::new(self.numbered, stream, sender));
            self.directions.insert(*stream, direction);
            self.flows.insert(stream.flow, *stream);
        }
        self.directions
            .get_mut(stream)
            .map(|direction| &mut **direction)
    }

    pub(super) fn begin(&mut self, stream: &StreamId) {
        for flow in [stream.flow, stream.flow.reversed()] {
            self.remembered.take(flow);
        }
        self.remove(stream);
        let connection = stream.flow.connection();
        self.unseen.retain(|(_, other)| *other != connection);
    }

    /// Records that the sender leaves the connection. If it is the first end to leave and has no
    /// other connection, its session has ended. Its declarations end with the connection. If the
    /// other end has been silent for its lease, that end has left first.
    pub(super) fn leave(&mut self, stream: &StreamId, now: ModelTime) {
        if let Some(silent) = self.silent_end(stream, now)
            && let Some(direction) = self.directions.get_mut(&silent)
        {
            // No end of the silent direction will be captured.
            direction.has_ended = true;
            self.end_connection(&silent, now);
        }
        self.end_connection(stream, now);
    }

    /// Does the same as [`Self::leave`], without a check whether the other end has been silent.
    fn end_connection(&mut self, stream: &StreamId, now: ModelTime) {
        if self.remembered.sender(stream.flow).is_some() {
            self.direction(stream);
        }
        self.note_cut(stream, now);
        let Some(direction) = self.directions.get_mut(stream) else {
            return;
        };
        self.revision += 1;
        if std::mem::replace(&mut direction.has_left, true) {
            return;
        }
        let session = direction.session();
        if self.opposite(stream).is_some_and(|other| other.has_left) {
            return;
        }
        if let Some(session) = session.filter(|session| !self.has_connection(*session)) {
            self.graph.end(session);
        }
        if let Some(direction) = self.directions.get(stream)
            && !self.is_shared(direction, |other| !other.has_left)
        {
            self.graph.leave(direction.number);
        }
    }

    /// Ends the sessions that discovery does not know, if they have no open connection and none
    /// declares their tokens. If others closed all connections of a session first, only its lease
    /// ends it.
    pub fn end_expired(&mut self, is_known: impl Fn(ZenohId) -> bool) {
        let sessions = self.graph.sessions();
        let unknown: Vec<_> = sessions.filter(|session| !is_known(*session)).collect();
        if unknown.is_empty() {
            return;
        }
        let directions = self.directions.iter();
        let open = directions.filter(|(stream, direction)| self.is_open(stream, direction));
        let (numbers, connected): (BTreeSet<_>, BTreeSet<_>) = open
            .map(|(_, direction)| (direction.number, direction.session()))
            .unzip();
        let (senders, _) = self.remembered.parts();
        let remembered: BTreeSet<_> = senders.values().map(|side| side.zid).collect();
        for session in unknown {
            let declarers = self.graph.declarers(session);
            let is_open = connected.contains(&Some(session)) || remembered.contains(&session);
            if !is_open && declarers.is_disjoint(&numbers) {
                self.graph.end(session);
                self.revision += 1;
            }
        }
    }

    /// Returns whether a session has an open connection, or may have one that has not been seen
    /// since a restart.
    fn has_connection(&self, session: ZenohId) -> bool {
        let mut directions = self.directions.iter();
        let is_open = directions.any(|(stream, direction)| {
            direction.session() == Some(session) && self.is_open(stream, direction)
        });
        is_open || self.remembered.has(session)
    }

    /// Returns whether a direction shares its declarations with such another one.
    fn is_shared(&self, direction: &StreamState, is_meant: impl Fn(&StreamState) -> bool) -> bool {
        let mut others = self.directions.values();
        direction.is_shared
            && others.any(|other| other.number == direction.number && is_meant(other))
    }

    /// Gives the declarations of a connection to the transport that its two sessions have already,
    /// once both are known.
    pub(super) fn join_transport(&mut self, stream: &StreamId) {
        let Some((opposite, _)) = self.opposite_entry(stream) else {
            return;
        };
        for (stream, opposite) in [(*stream, *opposite), (*opposite, *stream)] {
            let sender = |id| self.directions.get(id)?.sender;
            let Some(ends) = sender(&stream).zip(sender(&opposite)) else {
                return;
            };
            let Some(direction) = self.directions.get_mut(&stream) else {
                return;
            };
            // The search passes all connections, so each connection has one.
            if std::mem::replace(&mut direction.is_begun, true) {
                continue;
            }
            let mut others = self.directions.iter().filter(|(id, other)| {
                id.flow != stream.flow && other.sender == Some(ends.0) && !other.has_left
            });
            let twin = others.find(|(id, _)| {
                let back = self.opposite(id).filter(|back| !back.has_left);
                back.is_some_and(|back| back.sender == Some(ends.1))
            });
            if let Some(twin) = twin.map(|(id, _)| *id) {
                self.share(&twin, &stream);
            }
        }
    }

    /// Gives the declarations of `twin` to a direction that has none yet.
    fn share(&mut self, twin: &StreamId, stream: &StreamId) {
        let Some(twin) = self.directions.get_mut(twin) else {
            return;
        };
        twin.is_shared = true;
        let number = twin.number;
        if let Some(direction) = self.directions.get_mut(stream) {
            direction.is_shared = true;
            let own = std::mem::replace(&mut direction.number, number);
            drop(self.aliases.remove_owner(own));
        }
    }

    /// Forgets the aliases of a direction whose sender has changed.
    pub(super) fn forget_aliases(&mut self, stream: &StreamId) {
        let Some(direction) = self.directions.get_mut(stream) else {
            return;
        };
        if std::mem::take(&mut direction.is_shared) {
            self.numbered += 1;
            direction.number = self.numbered;
        } else {
            drop(self.aliases.remove_owner(direction.number));
        }
    }

    /// Returns the opposite direction if its sender has been silent for its lease.
    fn silent_end(&self, stream: &StreamId, now: ModelTime) -> Option<StreamId> {
        if self.directions.get(stream)?.has_left {
            return None;
        }
        let (place, other) = self.opposite_entry(stream)?;
        let lease = other.lease.unwrap_or(DEFAULT_LEASE);
        let is_silent = other.last_seen + lease.mul_f64(SILENT_LEASE_RATIO) <= now;
        (is_silent && !other.has_left).then_some(*place)
    }

    /// Records that the sender has closed the connection.
    pub(super) fn end(&mut self, stream: &StreamId, now: ModelTime) {
        let connection = stream.flow.connection();
        self.unseen.retain(|(_, other)| *other != connection);
        self.leave(stream, now);
        let Some(direction) = self.directions.get_mut(stream) else {
            return;
        };
        self.chain_bytes.sub(direction.held());
        direction.interrupt();
        direction.has_ended = true;
        if self.opposite(stream).is_none_or(|other| other.has_ended) {
            let elsewhere = self.flows.get(&stream.flow.reversed()).copied();
            let ids = [Some(*stream), Some(stream.reversed()), elsewhere];
            for id in ids.into_iter().flatten() {
                self.remove(&id);
            }
        }
    }

    pub(super) fn note_unseen(&mut self, reason: Unseen, flow: Flow) {
        self.unseen.insert((reason, flow.connection()));
    }

    /// Removes a direction with its declarations. A token stays until it is undeclared or its
    /// session ends.
    fn remove(&mut self, stream: &StreamId) {
        let Some(known) = self.directions.remove(stream) else {
            return;
        };
        self.chain_bytes.sub(known.held());
        if self.flows.get(&stream.flow) == Some(stream) {
            self.flows.remove(&stream.flow);
        }
        if !self.is_shared(&known, |_| true) {
            drop(self.aliases.remove_owner(known.number));
            self.graph.disconnect(known.number);
        }
    }
}

/// Returns the longest lease that a session announced on its connections.
pub(super) fn lease(
    directions: &HashMap<StreamId, Box<StreamState>>,
    session: ZenohId,
) -> Option<Duration> {
    let own = directions
        .values()
        .filter(|direction| direction.sender.is_some_and(|side| side.zid == session));
    own.filter_map(|direction| direction.lease).max()
}
