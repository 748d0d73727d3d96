//! Connections as plain data that outlives the agent.
//!
//! A connection names its sessions once, when it opens. After a restart, the agent reads from the
//! saved state which session sends on each connection. Saved data is validated like any other
//! external input.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

use ros2probe_wire::zenoh::{Side, WhatAmI, ZenohId};
use serde::{Deserialize, Serialize};

use super::stream::Flow;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{RememberedDirections, RememberedSessions};

/// Silence after which a connection is gone. It is longer than the interval of KEEP_ALIVE that
/// rmw_zenoh configures, 30 s.
const SILENCE: Duration = Duration::from_secs(90);

/// State of Zenoh that the agent saves.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ZenohMemory {
    /// Directions of connections, sorted by address.
    #[serde(default)]
    connections: Vec<RememberedConnection>,
    /// Sessions without a connection of their own, which only routers declare.
    #[serde(default)]
    relayed: Vec<String>,
    /// Routers that forward the tokens of sessions behind other routers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    passages: Vec<RememberedPassage>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RememberedPassage {
    router: String,
    sessions: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RememberedConnection {
    source: SocketAddr,
    destination: SocketAddr,
    /// Id of the session of the source.
    session: String,
    role: RememberedRole,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum RememberedRole {
    Router,
    Peer,
    Client,
}

/// Restored connections that have not been seen since the restart.
#[derive(Debug, Default)]
pub(super) struct Remembered {
    senders: Bounded<RememberedDirections, BTreeMap<Flow, Side>>,
    relayed: Bounded<RememberedSessions, BTreeSet<ZenohId>>,
    /// Time at which entries without a batch are removed.
    end: ModelTime,
}

impl ZenohMemory {
    pub(super) fn new(
        senders: &BTreeMap<Flow, Side>,
        relayed: &BTreeSet<ZenohId>,
        passages: &BTreeMap<ZenohId, BTreeSet<ZenohId>>,
    ) -> Self {
        let texts = |sessions: &BTreeSet<ZenohId>| {
            let sessions = sessions.iter().take(RememberedDirections::CAP);
            sessions.map(ZenohId::to_string).collect()
        };
        let connections = senders
            .iter()
            .take(RememberedDirections::CAP)
            .map(|(flow, side)| RememberedConnection {
                source: flow.source.socket_address(),
                destination: flow.destination.socket_address(),
                session: side.zid.to_string(),
                role: side.whatami.into(),
            });
        Self {
            connections: connections.collect(),
            relayed: texts(relayed),
            passages: passages
                .iter()
                .map(|(router, sessions)| RememberedPassage {
                    router: router.to_string(),
                    sessions: texts(sessions),
                })
                .collect(),
        }
    }

    /// Returns the routers that forward tokens. Invalid entries are skipped.
    pub(super) fn passages(&self) -> BTreeMap<ZenohId, BTreeSet<ZenohId>> {
        let read = |passage: &RememberedPassage| {
            let sessions = passage.sessions.iter().take(RememberedDirections::CAP);
            let sessions = sessions.filter_map(|session| ZenohId::parse(session));
            Some((ZenohId::parse(&passage.router)?, sessions.collect()))
        };
        self.passages.iter().filter_map(read).collect()
    }
}

impl Remembered {
    /// Restores saved connections. Invalid entries are skipped.
    pub(super) fn restore(&mut self, memory: &ZenohMemory, now: ModelTime) {
        for saved in &memory.connections {
            let flow = Flow {
                source: saved.source.into(),
                destination: saved.destination.into(),
            };
            if let Some(zid) = ZenohId::parse(&saved.session) {
                let whatami = saved.role.into();
                self.senders.insert(flow, Side { zid, whatami });
            }
        }
        for session in &memory.relayed {
            ZenohId::parse(session).map(|session| self.relayed.insert(session));
        }
        self.end = now + SILENCE;
    }

    /// Returns all restored sessions.
    pub(super) fn sessions(&self) -> BTreeSet<ZenohId> {
        let senders = self.senders.values().map(|side| side.zid);
        senders.chain(self.relayed.iter().copied()).collect()
    }

    /// Returns the connections and the relayed sessions.
    pub(super) fn parts(&self) -> (&BTreeMap<Flow, Side>, &BTreeSet<ZenohId>) {
        (&self.senders, &self.relayed)
    }

    /// Returns whether this session may have a connection that has not been seen since the restart.
    pub(super) fn has(&self, session: ZenohId) -> bool {
        self.senders.values().any(|side| side.zid == session)
    }

    /// Returns the sender of a connection that has not been seen since the restart.
    pub(super) fn sender(&self, flow: Flow) -> Option<Side> {
        self.senders.get(&flow).copied()
    }

    /// Removes and returns the sender of a connection that is seen.
    pub(super) fn take(&mut self, flow: Flow) -> Option<Side> {
        self.senders.remove(&flow)
    }

    /// Removes and returns the relayed sessions, because a router was seen.
    pub(super) fn take_relayed(&mut self) -> BTreeSet<ZenohId> {
        self.relayed.take()
    }

    /// Removes the entries that were not seen in time.
    pub(super) fn expire(&mut self, now: ModelTime) {
        if now > self.end && !(self.senders.is_empty() && self.relayed.is_empty()) {
            self.senders.clear();
            self.relayed.clear();
        }
    }
}

impl From<WhatAmI> for RememberedRole {
    fn from(role: WhatAmI) -> Self {
        match role {
            WhatAmI::Router => Self::Router,
            WhatAmI::Peer => Self::Peer,
            WhatAmI::Client => Self::Client,
        }
    }
}

impl From<RememberedRole> for WhatAmI {
    fn from(role: RememberedRole) -> Self {
        match role {
            RememberedRole::Router => Self::Router,
            RememberedRole::Peer => Self::Peer,
            RememberedRole::Client => Self::Client,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::facts::route::Destination;

    #[test]
    fn connections_and_sessions_beyond_the_cap_are_neither_saved_nor_restored() {
        let zid = |number: u32| {
            let mut id = [1; 16];
            id[..4].copy_from_slice(&number.to_le_bytes());
            ZenohId::from_le_bytes(&id).unwrap()
        };
        let sender = |number: u32| {
            let mut source = Destination::default();
            source.address[..4].copy_from_slice(&number.to_le_bytes());
            let flow = Flow {
                source,
                ..Flow::default()
            };
            let side = Side {
                zid: zid(number),
                whatami: WhatAmI::Peer,
            };
            (flow, side)
        };
        let senders: BTreeMap<_, _> = (0..5000).map(sender).collect();
        let relayed: BTreeSet<_> = (5000..10_000).map(zid).collect();
        let mut memory = ZenohMemory::new(&senders, &relayed, &BTreeMap::new());
        assert_eq!(memory.connections.len(), RememberedDirections::CAP);
        assert_eq!(memory.relayed.len(), RememberedDirections::CAP);
        memory.relayed.push(zid(1).to_string());
        memory.connections.extend(memory.connections.clone());
        let mut remembered = Remembered::default();
        remembered.restore(&memory, ModelTime::ZERO);
        assert!(remembered.senders.is_full() && remembered.relayed.is_full());
    }
}
