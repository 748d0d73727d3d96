//! The ROS graph from liveliness tokens: sessions, nodes and endpoints.
//!
//! Several connections may declare a token: connections of its session, and of routers. A token
//! exists until the last connection undeclares it, its own session undeclares it, or the session
//! ends. If an end closes a connection first, it thereby undeclares its tokens.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::discovery::{EndpointAnnouncement, ParticipantAnnouncement, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::{DdsTopic, Demangled};
use ros2probe_wire::zenoh::{EndpointKind, EndpointToken, Gid, NodeToken, Token, ZenohId};
use ros2probe_wire::{DomainId, EntityId, Guid};

use super::declared::{Declared, TokenNumber};
use super::endpoints::announcements;
use super::session_state::{NodeState, SessionState};
use super::stream_state::DirectionNumber;
use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, ByOwner, HeapBytes};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{ZenohPassages, ZenohRestored, ZenohServers, ZenohTokens, ZenohWriters};

/// Bytes of a session besides its tokens: its state, and the first nodes of two trees.
const SESSION_OVERHEAD: usize = 2048;
/// Bytes that a token's parts take in its node, among the writers and among the servers, without
/// names.
const TOKEN_OVERHEAD: usize = 640;
/// Maximum number of routers that are remembered as forwarding tokens of sessions.
pub(super) const MAX_PASSING_ROUTERS: usize = 256;
/// An endpoint that discovery knows from saved state.
#[derive(Clone, Copy, Debug)]
pub struct RestoredEndpoint<'a> {
    /// Its GUID.
    pub guid: Guid,
    /// Its domain.
    pub domain_id: DomainId,
    /// Its identifier in Zenoh.
    pub gid: [u8; 16],
    /// DDS name of its topic.
    pub topic: &'a str,
}

/// Minimum time between two announcements of a session that discovery has forgotten.
const REPEAT_INTERVAL: Duration = Duration::from_secs(1);

/// A change of the graph, in the terms of DDS.
#[derive(Debug)]
pub enum GraphChange {
    /// A session has its first node or endpoint.
    Participant(Box<ParticipantAnnouncement>),
    /// A session is gone.
    ParticipantGone(Guid),
    /// An endpoint appeared.
    Endpoint(Box<EndpointAnnouncement>),
    /// An endpoint is gone.
    EndpointGone(Guid),
    /// Nodes of a session changed.
    Nodes(ParticipantEntities),
}

/// Entity that a token represents.
#[derive(Debug)]
enum Meaning {
    Node(u64),
    Endpoint {
        node: u64,
        guids: Vec<Guid>,
        gid: Gid,
        /// Key of the service that it serves.
        serves: Option<Arc<str>>,
    },
}

#[derive(Debug)]
struct TokenState {
    number: TokenNumber,
    session: ZenohId,
    meaning: Meaning,
}

impl HeapBytes for TokenState {
    /// Returns 0, because the memory of a token is estimated before its insertion.
    fn heap_bytes(&self) -> usize {
        0
    }
}

/// A writer, by the gid of its publications, requests or replies.
#[derive(Clone, Copy, Debug)]
struct WriterState {
    guid: Guid,
    /// Its session; `None` if the writer is known from saved state only.
    session: Option<ZenohId>,
}

/// All tokens and the entities that they represent.
#[derive(Debug, Default)]
pub struct Graph {
    tokens: ByOwner<ZenohTokens, (), Arc<str>, TokenState>,
    /// The texts of the tokens.
    texts: Bounded<ZenohTokens, HashMap<TokenNumber, Arc<str>>>,
    /// Number of the newest token.
    numbered: TokenNumber,
    declared: Declared,
    sessions: Bounded<ZenohTokens, BTreeMap<ZenohId, SessionState>>,
    writers: Bounded<ZenohWriters, HashMap<Gid, WriterState>>,
    /// Sessions from saved state with their domains, until they end.
    restored: Bounded<ZenohRestored, BTreeMap<ZenohId, DomainId>>,
    /// Sessions behind other routers, by the router that forwards their tokens.
    passages: ByOwner<ZenohPassages, ZenohId, ZenohId, ()>,
    servers: Bounded<ZenohServers, BTreeMap<Arc<str>, BTreeMap<ZenohId, Guid>>>,
    changed: BTreeSet<ZenohId>,
    changes: Vec<GraphChange>,
}

impl Graph {
    /// Returns the writer whose publications, requests or replies have this gid.
    pub fn writer(&self, gid: Gid) -> Option<Guid> {
        Some(self.writers.get(&gid)?.guid)
    }

    /// Returns the session of the writer with this gid.
    pub fn session(&self, gid: Gid) -> Option<ZenohId> {
        self.writers.get(&gid)?.session
    }

    /// Returns the writer of the replies of a service, in this session if it is known.
    pub fn server(&self, key: &str, session: Option<ZenohId>) -> Option<Guid> {
        let servers = self.servers.get(key)?;
        match session.and_then(|session| servers.get(&session)) {
            Some(guid) => Some(*guid),
            None if servers.len() == 1 => servers.values().next().copied(),
            None => None,
        }
    }

    /// Returns whether this session has nodes or endpoints.
    pub fn has(&self, session: ZenohId) -> bool {
        self.sessions.contains_key(&session) || self.restored.contains_key(&session)
    }

    /// Returns the sessions with tokens, or from saved state.
    pub fn sessions(&self) -> impl Iterator<Item = ZenohId> {
        self.sessions
            .keys()
            .copied()
            .chain(self.restored.keys().copied())
    }

    /// Adds an endpoint that discovery knows from saved state.
    pub fn restore(&mut self, endpoint: RestoredEndpoint<'_>, session: Option<ZenohId>) {
        let guid = endpoint.guid;
        if let Some(session) = session {
            self.restored.insert(session, endpoint.domain_id);
        }
        if !guid.entity.is_writer() {
            return;
        }
        let restored = || WriterState { guid, session };
        let known = self.writers.get_or_insert_with(Gid(endpoint.gid), restored);
        let (Some(_), Some(session)) = (known, session) else {
            return;
        };
        let topic = DdsTopic::parse(endpoint.topic);
        if let Ok(Demangled::ServiceReply(service)) = topic.map(|topic| topic.demangle()) {
            let key = service_key(endpoint.domain_id, service.as_str());
            let servers = self
                .servers
                .get_or_insert_with(key.into(), BTreeMap::default);
            servers.map(|servers| servers.insert(session, guid));
        }
    }

    /// Removes and returns the changes.
    pub fn take(&mut self) -> Vec<GraphChange> {
        for session in std::mem::take(&mut self.changed) {
            let Some(state) = self.sessions.get(&session) else {
                continue;
            };
            self.changes
                .push(GraphChange::Nodes(state.entities(session)));
        }
        std::mem::take(&mut self.changes)
    }

    /// Announces again a session that discovery has forgotten, at most once a second.
    pub fn announce_again(&mut self, session: ZenohId, now: ModelTime) {
        let Some(state) = self.sessions.get_mut(&session) else {
            return;
        };
        if now < state.repeated + REPEAT_INTERVAL {
            return;
        }
        state.repeated = now;
        self.changes.push(GraphChange::Participant(Box::new(
            state.announcement(session),
        )));
        for token in state.tokens.clone() {
            if let Ok(Token::Endpoint(endpoint)) = Token::parse(&token) {
                for announcement in announcements(&endpoint) {
                    self.changes
                        .push(GraphChange::Endpoint(Box::new(announcement)));
                }
            }
        }
        self.changed.insert(session);
    }

    /// Records that a direction declares a token with a number. Returns whether the token belongs
    /// to ROS and is stored.
    pub fn declare(
        &mut self,
        text: &str,
        (direction, id): (DirectionNumber, u32),
        lease: impl FnOnce(ZenohId) -> Option<Duration>,
    ) -> bool {
        if let Some(known) = self.tokens.get((), text) {
            self.declared.insert(direction, id, known.number);
            return true;
        }
        let Ok(token) = Token::parse(text) else {
            return false;
        };
        let node = match &token {
            Token::Node(node) => node,
            Token::Endpoint(endpoint) => &endpoint.node,
            Token::Bridge(_) | Token::Other => return false,
        };
        let session = node.session;
        let text: Arc<str> = text.into();
        // The names in the text are stored again, in the node or in the key of a service.
        let mut beside = TOKEN_OVERHEAD + text.len();
        if !self.sessions.contains_key(&session) {
            beside += SESSION_OVERHEAD;
        }
        self.numbered += 1;
        let state = TokenState {
            number: self.numbered,
            session,
            meaning: match &token {
                Token::Endpoint(endpoint) => Meaning::of(endpoint),
                _ => Meaning::Node(node.node),
            },
        };
        let number = state.number;
        if !self.tokens.insert((), Arc::clone(&text), state, beside) {
            return false;
        }
        self.texts.insert(number, Arc::clone(&text));
        self.enter(node, text, lease);
        match &token {
            Token::Endpoint(endpoint) => self.endpoint(endpoint),
            _ => self.node(node),
        }
        self.changed.insert(session);
        self.declared.insert(direction, id, number);
        true
    }

    /// Records that a direction no longer declares the token with this number or, if the number is
    /// unknown, with this text. `by` is the session of the sender, if known.
    pub fn undeclare(
        &mut self,
        (direction, id): (DirectionNumber, u32),
        text: Option<&str>,
        by: Option<ZenohId>,
    ) {
        let numbered = self.declared.take_id(direction, id);
        let named = || Some(self.tokens.get((), text?)?.number);
        if let Some(token) = numbered.or_else(named) {
            self.declared.remove(direction, token);
            self.remove_undeclared(token, by);
        }
    }

    /// Records that the sender of a direction has left, so that the direction declares nothing.
    pub fn leave(&mut self, direction: DirectionNumber) {
        for token in self.declared.remove_direction(direction) {
            self.remove_undeclared(token, None);
        }
    }

    /// Removes a direction but not its tokens.
    pub fn disconnect(&mut self, direction: DirectionNumber) {
        self.declared.remove_direction(direction);
    }

    /// Removes a token that no direction declares, or that `by`, its own session, has undeclared.
    fn remove_undeclared(&mut self, token: TokenNumber, by: Option<ZenohId>) {
        let Some(text) = self.texts.get(&token).cloned() else {
            return;
        };
        let state = self.tokens.get((), &*text);
        let is_own = state.is_some_and(|state| by == Some(state.session));
        if is_own || !self.declared.is_declared(token) {
            self.remove(&text);
        }
    }

    /// Removes a session with all its tokens.
    pub fn end(&mut self, session: ZenohId) {
        let state = self.sessions.remove(&session);
        let was_restored = self.restored.remove(&session).is_some();
        let routers: Vec<_> = self.passages.owners().collect();
        for router in routers {
            self.passages.remove(router, &session);
        }
        if state.is_none() && !was_restored {
            return;
        }
        for text in state.into_iter().flat_map(|state| state.tokens) {
            if let Some(token) = self.tokens.remove((), &*text) {
                self.forget(&token);
            }
        }
        if was_restored {
            self.forget_restored(session);
        }
        self.changed.remove(&session);
        let guid = Guid::new(session.guid_prefix(), EntityId::PARTICIPANT);
        self.changes.push(GraphChange::ParticipantGone(guid));
    }

    /// Records that a router forwards this token of a session behind another router. Returns
    /// whether this was unknown.
    pub fn add_passage(&mut self, token: &str, router: ZenohId) -> bool {
        let Some(session) = self.tokens.get((), token).map(|token| token.session) else {
            return false;
        };
        if self.passages.get(router, &session).is_some() {
            return false;
        }
        let has_room = self.has_passages(router) || self.routers() < MAX_PASSING_ROUTERS;
        has_room && self.passages.insert(router, session, (), 0)
    }

    /// Returns whether a router forwards tokens of sessions behind other routers.
    pub fn has_passages(&self, router: ZenohId) -> bool {
        self.passages.of(router).next().is_some()
    }

    /// Returns the sessions whose tokens a router forwards.
    pub fn passages_of(&self, router: ZenohId) -> BTreeSet<ZenohId> {
        let sessions = self.passages.of(router);
        sessions.map(|(session, ())| *session).collect()
    }

    /// Removes a router that forwards tokens. Returns the sessions that no other router forwards.
    pub fn remove_passages(&mut self, router: ZenohId) -> BTreeSet<ZenohId> {
        let mut sessions: BTreeSet<_> = self.passages.remove_owner(router).collect();
        for other in self.passages.owners() {
            sessions.retain(|session| self.passages.get(other, session).is_none());
        }
        sessions
    }

    /// Returns the routers that forward tokens, with the sessions.
    pub fn passages(&self) -> BTreeMap<ZenohId, BTreeSet<ZenohId>> {
        let routers = self.passages.owners();
        routers
            .map(|router| (router, self.passages_of(router)))
            .collect()
    }

    /// Restores saved routers with the restored sessions whose tokens they forward.
    pub fn restore_passages(&mut self, passages: BTreeMap<ZenohId, BTreeSet<ZenohId>>) {
        for (router, sessions) in passages.into_iter().take(MAX_PASSING_ROUTERS) {
            for session in sessions {
                if self.restored.contains_key(&session) {
                    self.passages.insert(router, session, (), 0);
                }
            }
        }
    }

    /// Returns the directions that declare tokens of a session.
    pub fn declarers(&self, session: ZenohId) -> BTreeSet<DirectionNumber> {
        let session = self.sessions.get(&session);
        let tokens = session.into_iter().flat_map(|session| &session.tokens);
        let tokens = tokens.filter_map(|text| self.tokens.get((), &**text));
        tokens
            .flat_map(|token| self.declared.of(token.number))
            .collect()
    }

    /// Removes the tokens of a session of this domain that no connection declares.
    pub fn drop_undeclared_tokens(&mut self, session: ZenohId, domain: DomainId) {
        let Some(state) = self.sessions.get(&session) else {
            if self.restored.get(&session) == Some(&domain) {
                self.end(session);
            }
            return;
        };
        if state.domain != domain {
            return;
        }
        let is_declared = |text: &&Arc<str>| {
            let token = self.tokens.get((), &***text);
            token.is_some_and(|token| self.declared.is_declared(token.number))
        };
        let texts = state.tokens.iter();
        let gone: Vec<_> = texts.filter(|text| !is_declared(text)).cloned().collect();
        for text in gone {
            self.remove(&text);
        }
    }

    /// Returns the tables for the snapshot.
    pub fn tables(&self) -> Vec<TableFacts> {
        let mut tables = vec![self.tokens.facts(), self.passages.facts()];
        tables.extend(self.declared.facts());
        tables
    }

    /// Returns the number of routers that forward tokens.
    fn routers(&self) -> usize {
        self.passages.owners().count()
    }

    /// Adds a token to its session, which may be new.
    fn enter(
        &mut self,
        node: &NodeToken,
        text: Arc<str>,
        lease: impl FnOnce(ZenohId) -> Option<Duration>,
    ) {
        let session = node.session;
        let is_new = !self.sessions.contains_key(&session);
        let new = || SessionState {
            domain: node.domain,
            enclave: node.enclave.clone(),
            lease: lease(session),
            nodes: BTreeMap::new(),
            tokens: BTreeSet::new(),
            repeated: ModelTime::ZERO,
        };
        let Some(state) = self.sessions.get_or_insert_with(session, new) else {
            return;
        };
        state.tokens.insert(text);
        if is_new {
            let announcement = state.announcement(session);
            self.changes
                .push(GraphChange::Participant(Box::new(announcement)));
        }
    }

    fn node(&mut self, token: &NodeToken) {
        if let Some(node) = self.node_state(token) {
            node.has_token = true;
        }
    }

    fn endpoint(&mut self, token: &EndpointToken) {
        let announcements = announcements(token);
        let guids: Vec<Guid> = announcements.iter().map(|each| each.guid).collect();
        for announcement in announcements {
            let guid = announcement.guid;
            if let Some(node) = self.node_state(&token.node) {
                match announcement.role {
                    Role::Writer => node.writers.push(guid),
                    Role::Reader => node.readers.push(guid),
                }
            }
            if announcement.role == Role::Writer {
                let writer = WriterState {
                    guid,
                    session: Some(token.node.session),
                };
                self.writers.insert(token.gid, writer);
            }
            self.changes
                .push(GraphChange::Endpoint(Box::new(announcement)));
        }
        let writer = guids.iter().find(|guid| guid.entity.is_writer());
        if let (Some(key), Some(writer)) = (served(token), writer) {
            let servers = self.servers.get_or_insert_with(key, BTreeMap::default);
            servers.map(|servers| servers.insert(token.node.session, *writer));
        }
    }

    fn node_state(&mut self, token: &NodeToken) -> Option<&mut NodeState> {
        let session = self.sessions.get_mut(&token.session)?;
        Some(
            session
                .nodes
                .entry(token.node)
                .or_insert_with(|| NodeState {
                    namespace: token.namespace.clone(),
                    name: token.name.clone(),
                    ..NodeState::default()
                }),
        )
    }

    fn remove(&mut self, text: &str) {
        let Some(token) = self.tokens.remove((), text) else {
            return;
        };
        self.forget(&token);
        let Some(session) = self.sessions.get_mut(&token.session) else {
            return;
        };
        session.tokens.remove(text);
        let number = token.meaning.node();
        if let Some(node) = session.nodes.get_mut(&number) {
            match &token.meaning {
                Meaning::Node(_) => node.has_token = false,
                Meaning::Endpoint { guids, .. } => {
                    node.writers.retain(|guid| !guids.contains(guid));
                    node.readers.retain(|guid| !guids.contains(guid));
                    let gone = guids.iter().copied().map(GraphChange::EndpointGone);
                    self.changes.extend(gone);
                }
            }
            if !node.has_token && node.writers.is_empty() && node.readers.is_empty() {
                session.nodes.remove(&number);
            }
        }
        self.changed.insert(token.session);
        if let Meaning::Node(node) = token.meaning {
            // The endpoints of a node end with it, even if they are not undeclared.
            let tokens = &self.tokens;
            let is_of_node = |text: &&Arc<str>| {
                let other = tokens.get((), &***text);
                other.is_some_and(|other| other.meaning.node() == node)
            };
            let orphans: Vec<_> = session.tokens.iter().filter(is_of_node).cloned().collect();
            for orphan in orphans {
                self.remove(&orphan);
            }
        }
        let is_empty = |session: &SessionState| session.tokens.is_empty();
        if self.sessions.get(&token.session).is_some_and(is_empty) {
            self.end(token.session);
        }
    }

    fn forget_restored(&mut self, session: ZenohId) {
        let prefix = session.guid_prefix();
        self.writers
            .retain(|_, writer| writer.guid.prefix != prefix);
        self.servers.retain(|_, servers| {
            servers.remove(&session);
            !servers.is_empty()
        });
    }

    fn forget(&mut self, token: &TokenState) {
        self.texts.remove(&token.number);
        self.declared.forget(token.number);
        let Meaning::Endpoint { gid, serves, .. } = &token.meaning else {
            return;
        };
        self.writers.remove(gid);
        if let Some(key) = serves
            && let Some(servers) = self.servers.get_mut(key)
        {
            servers.remove(&token.session);
            if servers.is_empty() {
                self.servers.remove(key);
            }
        }
    }
}

impl Meaning {
    fn of(token: &EndpointToken) -> Self {
        let announcements = announcements(token).into_iter();
        Self::Endpoint {
            node: token.node.node,
            guids: announcements.map(|each| each.guid).collect(),
            gid: token.gid,
            serves: served(token),
        }
    }

    /// Returns the number of the node.
    const fn node(&self) -> u64 {
        match self {
            Self::Node(node) | Self::Endpoint { node, .. } => *node,
        }
    }
}

/// Returns the key of the service that an endpoint serves.
fn served(token: &EndpointToken) -> Option<Arc<str>> {
    (token.kind == EndpointKind::Server)
        .then(|| service_key(token.node.domain, token.name.as_str()).into())
}

/// Returns the key by which [`Graph::server`] finds a service.
pub fn service_key(domain: DomainId, name: &str) -> String {
    format!("{}{name}", domain.0)
}
