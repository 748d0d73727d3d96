//! Senders on connections that are older than the agent, by the process that holds the socket.
//!
//! A session has one connection to a router. A process with one such connection therefore has one
//! session, and all of its connections belong to this session.

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::GuidPrefix;
use ros2probe_wire::zenoh::{PORT, ZenohId};

use super::Zenoh;
use super::stream::StreamId;

/// The process that holds a socket.
#[derive(Clone, Copy, Debug)]
pub struct Holder {
    /// Process id.
    pub process_id: u32,
    /// The only session that is known to run in it.
    pub session: Option<GuidPrefix>,
}

/// A socket whose owner has changed.
#[derive(Debug)]
pub struct OwnerChange {
    /// `SO_COOKIE`.
    pub socket: u64,
    /// The session that was considered its owner.
    pub before: Option<ZenohId>,
    /// The session that owns it.
    pub after: Option<ZenohId>,
}

impl Zenoh {
    /// Determines the senders on connections that are older than the agent. `holder` returns the
    /// process that holds a socket.
    pub fn link(&mut self, holder: impl Fn(u64) -> Option<Holder>) -> Vec<OwnerChange> {
        let mut changes = Vec::new();
        if self.directions.values().all(|each| each.sender.is_some()) {
            return changes;
        }
        changes.extend(self.find_routers(&holder));
        let holder = |stream: &StreamId| stream.outgoing.then(|| holder(stream.socket)).flatten();
        let mut to_routers: HashMap<u32, usize> = HashMap::new();
        for (stream, direction) in &self.directions {
            if stream.flow.destination.port == PORT
                && !direction.has_left
                && let Some(holder) = holder(stream)
            {
                *to_routers.entry(holder.process_id).or_default() += 1;
            }
        }
        let sessions = self.graph.sessions();
        let sessions: HashMap<_, _> = sessions.map(|zid| (zid.guid_prefix(), zid)).collect();
        for (stream, direction) in &mut self.directions {
            if direction.sender.is_some() || direction.is_router {
                continue;
            }
            let linked = holder(stream).and_then(|holder| {
                let session = sessions.get(&holder.session?).copied()?;
                let is_certain = match to_routers.get(&holder.process_id) {
                    Some(count) => *count == 1,
                    // The router is being restarted.
                    None => direction.linked == Some(session),
                };
                (is_certain && direction.sends_only_for(session)).then_some(session)
            });
            if linked == direction.linked {
                continue;
            }
            let before = direction.owner(stream);
            direction.linked = linked;
            self.revision += 1;
            let after = direction.owner(stream);
            if before != after {
                changes.push(OwnerChange {
                    socket: stream.socket,
                    before,
                    after,
                });
            }
        }
        changes
    }
}
