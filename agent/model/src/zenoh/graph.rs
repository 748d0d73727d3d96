//! The ROS graph in liveliness tokens: sessions, nodes and endpoints.
//!
//! Several connections may declare a token: those of its session, and those of routers. It lives
//! until the last of them undeclares it, until its own session undeclares it, or until the session
//! ends. The end that closes a connection first undeclares its tokens with it.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::discovery::{EndpointAnnouncement, ParticipantAnnouncement, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::{DdsTopic, Demangled};
use ros2probe_wire::zenoh::{EndpointKind, EndpointToken, Gid, NodeToken, Token, ZenohId};
use ros2probe_wire::{DomainId, EntityId, Guid, Timestamp};

use super::endpoints::announcements;
use super::session_state::{NodeState, SessionState};
use super::stream::StreamId;
use crate::discovery::Endpoint;
use crate::size::Size;

/// Most tokens.
pub(super) const MAX_TOKENS: usize = 32_768;
/// Most connections that declare one token.
pub(super) const MAX_DECLARERS: usize = 64;
/// Most routers that are remembered to pass on the tokens of sessions.
pub(super) const MAX_PASSING_ROUTERS: usize = 256;
/// Least time between two announcements of a session that discovery has forgotten.
const REPEAT: Duration = Duration::from_secs(1);

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

/// What a token stands for.
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
    session: ZenohId,
    meaning: Meaning,
    declarers: BTreeSet<StreamId>,
}

/// A writer, by the gid of its publications, requests or replies.
#[derive(Clone, Copy, Debug)]
struct WriterState {
    guid: Guid,
    /// Its session; `None` if the writer is known from saved state only.
    session: Option<ZenohId>,
}

/// All tokens and what they stand for.
#[derive(Debug, Default)]
pub struct Graph {
    tokens: HashMap<Arc<str>, TokenState>,
    sessions: BTreeMap<ZenohId, SessionState>,
    writers: HashMap<Gid, WriterState>,
    /// Sessions from saved state with their domains, until they end.
    restored: BTreeMap<ZenohId, DomainId>,
    /// Sessions behind other routers, by the router that passes on their tokens.
    passages: BTreeMap<ZenohId, BTreeSet<ZenohId>>,
    servers: BTreeMap<Arc<str>, BTreeMap<ZenohId, Guid>>,
    changed: BTreeSet<ZenohId>,
    changes: Vec<GraphChange>,
    /// Tokens refused because there are too many.
    pub refused: u64,
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

    /// Learns an endpoint that discovery knows from saved state.
    pub fn restore(&mut self, guid: Guid, endpoint: &Endpoint, session: Option<ZenohId>) {
        if let Some(session) = session {
            self.restored.insert(session, endpoint.domain_id);
        }
        if !guid.entity.is_writer() || self.writers.len() >= MAX_TOKENS {
            return;
        }
        let restored = WriterState { guid, session };
        self.writers.entry(Gid(endpoint.gid)).or_insert(restored);
        let Some(session) = session else {
            return;
        };
        let topic = DdsTopic::parse(endpoint.topic.as_str());
        if let Ok(Demangled::ServiceReply(service)) = topic.map(|topic| topic.demangle()) {
            let key = service_key(endpoint.domain_id, service.as_str());
            let servers = self.servers.entry(key.into()).or_default();
            servers.insert(session, guid);
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

    /// Announces a session again, which discovery has forgotten, at most once a second.
    pub fn repeat(&mut self, session: ZenohId, now: Timestamp) {
        let Some(state) = self.sessions.get_mut(&session) else {
            return;
        };
        if now < state.repeated + REPEAT {
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

    /// Records that `declarer` declares a token. Returns the token if it is of ROS.
    pub fn declare(
        &mut self,
        text: &str,
        declarer: StreamId,
        lease: impl FnOnce(ZenohId) -> Option<Duration>,
    ) -> Option<Arc<str>> {
        if let Some((known, state)) = self.tokens.get_key_value(text) {
            let known = Arc::clone(known);
            if state.declarers.len() < MAX_DECLARERS
                && let Some(state) = self.tokens.get_mut(text)
            {
                state.declarers.insert(declarer);
            }
            return Some(known);
        }
        let token = Token::parse(text).ok()?;
        let node = match &token {
            Token::Node(node) => node,
            Token::Endpoint(endpoint) => &endpoint.node,
            Token::Bridge(_) | Token::Other => return None,
        };
        if self.tokens.len() >= MAX_TOKENS {
            self.refused += 1;
            return None;
        }
        let session = node.session;
        let text: Arc<str> = text.into();
        self.enter(node, Arc::clone(&text), lease);
        let meaning = match &token {
            Token::Endpoint(endpoint) => self.endpoint(endpoint),
            _ => self.node(node),
        };
        self.changed.insert(session);
        let state = TokenState {
            session,
            meaning,
            declarers: BTreeSet::from([declarer]),
        };
        self.tokens.insert(Arc::clone(&text), state);
        Some(text)
    }

    /// Records that `declarer`, which is this session if known, no longer declares a token.
    pub fn undeclare(&mut self, text: &str, declarer: &StreamId, by: Option<ZenohId>) {
        let Some(state) = self.tokens.get_mut(text) else {
            return;
        };
        state.declarers.remove(declarer);
        if state.declarers.is_empty() || by == Some(state.session) {
            self.remove(text);
        }
    }

    /// Records that a connection no longer declares a token, which may live on.
    pub fn disconnect(&mut self, text: &str, declarer: &StreamId) {
        if let Some(state) = self.tokens.get_mut(text) {
            state.declarers.remove(declarer);
        }
    }

    /// Removes a session with everything that it has.
    pub fn end(&mut self, session: ZenohId) {
        let state = self.sessions.remove(&session);
        let was_restored = self.restored.remove(&session).is_some();
        for sessions in self.passages.values_mut() {
            sessions.remove(&session);
        }
        self.passages.retain(|_, sessions| !sessions.is_empty());
        if state.is_none() && !was_restored {
            return;
        }
        for text in state.into_iter().flat_map(|state| state.tokens) {
            if let Some(token) = self.tokens.remove(&text) {
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

    /// Records that a router passes on this token of a session behind another router. Returns
    /// whether that is new.
    pub fn pass_on(&mut self, token: &str, router: ZenohId) -> bool {
        let Some(session) = self.tokens.get(token).map(|token| token.session) else {
            return false;
        };
        let has_room = self.passages.len() < MAX_PASSING_ROUTERS;
        if !has_room && !self.passages.contains_key(&router) {
            return false;
        }
        self.passages.entry(router).or_default().insert(session)
    }

    /// Returns whether a router passes on tokens of sessions behind other routers.
    pub fn passes_on(&self, router: ZenohId) -> bool {
        self.passages.contains_key(&router)
    }

    /// Returns the sessions of which a router passes on tokens.
    pub fn passed_on_by(&self, router: ZenohId) -> BTreeSet<ZenohId> {
        self.passages.get(&router).cloned().unwrap_or_default()
    }

    /// Removes a router that passes on tokens, and returns the sessions that no other one passes on.
    pub fn pass_no_longer(&mut self, router: ZenohId) -> BTreeSet<ZenohId> {
        let mut sessions = self.passages.remove(&router).unwrap_or_default();
        for others in self.passages.values() {
            sessions.retain(|session| !others.contains(session));
        }
        sessions
    }

    /// Returns the routers that pass on tokens, with the sessions.
    pub const fn passages(&self) -> &BTreeMap<ZenohId, BTreeSet<ZenohId>> {
        &self.passages
    }

    /// Restores saved routers with the restored sessions of which they pass on tokens.
    pub fn restore_passages(&mut self, passages: BTreeMap<ZenohId, BTreeSet<ZenohId>>) {
        for (router, mut sessions) in passages.into_iter().take(MAX_PASSING_ROUTERS) {
            sessions.retain(|session| self.restored.contains_key(session));
            if !sessions.is_empty() {
                self.passages.insert(router, sessions);
            }
        }
    }

    /// Returns the connections that declare tokens of a session.
    pub fn declarers(&self, session: ZenohId) -> impl Iterator<Item = &StreamId> {
        let session = self.sessions.get(&session);
        let tokens = session.into_iter().flat_map(|session| &session.tokens);
        let tokens = tokens.filter_map(|text| self.tokens.get(text));
        tokens.flat_map(|token| &token.declarers)
    }

    /// Removes what no connection declares of a session of this domain.
    pub fn keep_declared(&mut self, session: ZenohId, domain: DomainId) {
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
            let token = self.tokens.get(*text);
            token.is_some_and(|token| !token.declarers.is_empty())
        };
        let texts = state.tokens.iter();
        let gone: Vec<_> = texts.filter(|text| !is_declared(text)).cloned().collect();
        for text in gone {
            self.remove(&text);
        }
    }

    /// Returns the size and cap of each table.
    pub fn sizes(&self) -> Vec<Size> {
        // The destructuring makes a new table fail to compile until it is listed here.
        let Self {
            tokens,
            sessions,
            writers,
            restored,
            passages,
            servers,
            changed,
            changes,
            refused: _,
        } = self;
        let passed_on = passages.values().map(BTreeSet::len).max();
        let declarers = tokens.values().map(TokenState::declarers).max();
        let of_sessions = || sessions.values().map(SessionState::lists);
        let (mut nodes, mut ends, mut texts) = (0, 0, 0);
        for (of_session, endpoints, tokens) in of_sessions() {
            (nodes, ends, texts) = (nodes + of_session, ends + endpoints, texts + tokens);
        }
        let serving = servers.values().map(BTreeMap::len).sum();
        vec![
            Size::new("zenoh.tokens", tokens.len(), MAX_TOKENS),
            Size::new(
                "zenoh.tokens.declarers",
                declarers.unwrap_or(0),
                MAX_DECLARERS,
            ),
            Size::new("zenoh.sessions", sessions.len(), MAX_TOKENS),
            Size::new("zenoh.sessions.nodes", nodes, MAX_TOKENS),
            Size::new("zenoh.sessions.endpoints", ends, 2 * MAX_TOKENS),
            Size::new("zenoh.sessions.tokens", texts, MAX_TOKENS),
            Size::new("zenoh.writers", writers.len(), 2 * MAX_TOKENS),
            Size::new("zenoh.restored", restored.len(), MAX_TOKENS),
            Size::new("zenoh.passages", passages.len(), MAX_PASSING_ROUTERS),
            Size::new(
                "zenoh.passages.sessions",
                passed_on.unwrap_or(0),
                2 * MAX_TOKENS,
            ),
            Size::new("zenoh.servers", servers.len(), MAX_TOKENS),
            Size::new("zenoh.servers.sessions", serving, MAX_TOKENS),
            Size::new("zenoh.changed", changed.len(), MAX_TOKENS),
            // The changes are taken after each batch.
            Size::new("zenoh.changes", changes.len(), 3 * MAX_TOKENS),
        ]
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
        let state = self
            .sessions
            .entry(session)
            .or_insert_with(|| SessionState {
                domain: node.domain,
                enclave: node.enclave.clone(),
                lease: lease(session),
                nodes: BTreeMap::new(),
                tokens: BTreeSet::new(),
                repeated: Timestamp(0),
            });
        state.tokens.insert(text);
        if is_new {
            let announcement = state.announcement(session);
            self.changes
                .push(GraphChange::Participant(Box::new(announcement)));
        }
    }

    fn node(&mut self, token: &NodeToken) -> Meaning {
        if let Some(node) = self.node_state(token) {
            node.has_token = true;
        }
        Meaning::Node(token.node)
    }

    fn endpoint(&mut self, token: &EndpointToken) -> Meaning {
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
        let serves = (token.kind == EndpointKind::Server)
            .then(|| service_key(token.node.domain, token.name.as_str()).into());
        if let Some(key) = &serves {
            let writer = guids.iter().find(|guid| guid.entity.is_writer());
            if let Some(writer) = writer {
                let servers = self.servers.entry(Arc::clone(key)).or_default();
                servers.insert(token.node.session, *writer);
            }
        }
        Meaning::Endpoint {
            node: token.node.node,
            guids,
            gid: token.gid,
            serves,
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
        let Some(token) = self.tokens.remove(text) else {
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
            // The endpoints of a node end with it, also without an undeclaration.
            let tokens = &self.tokens;
            let is_of_node = |text: &&Arc<str>| {
                let other = tokens.get(*text);
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

impl TokenState {
    /// Returns the number of connections that declare it.
    fn declarers(&self) -> usize {
        // The destructuring makes a new list fail to compile until it is listed here.
        let Self {
            session: _,
            meaning: _,
            declarers,
        } = self;
        declarers.len()
    }
}

impl Meaning {
    /// Returns the number of the node.
    const fn node(&self) -> u64 {
        match self {
            Self::Node(node) | Self::Endpoint { node, .. } => *node,
        }
    }
}

/// Returns the key of [`Graph::server`].
pub fn service_key(domain: DomainId, name: &str) -> String {
    format!("{}{name}", domain.0)
}
