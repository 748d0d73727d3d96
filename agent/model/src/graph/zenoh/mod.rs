//! Zenoh: sessions, liveliness tokens and messages of rmw_zenoh, as participants, endpoints and
//! records.
//!
//! This module converts Zenoh to the terms of DDS, so that the rest of the model needs no knowledge
//! of it. A session becomes a participant, with a GUID prefix of the vendor
//! [`VendorId::ZENOH`](ros2probe_wire::rtps::VendorId::ZENOH). A liveliness token becomes an
//! endpoint, or two for a service. A message with an attachment becomes a sample of the writer
//! whose token has the attachment's gid.
//!
//! Routers forward messages. A message to a router counts for its writer, but not as a delivery.

mod batch;
mod connections;
mod declarations;
mod declared;
mod endpoints;
mod facts;
mod graph;
mod messages;
mod processes;
mod remembered;
mod replies;
mod routers;
mod session_state;
mod stream;
mod stream_state;

use std::collections::{BTreeMap, BTreeSet};

use foldhash::HashMap;
use ros2probe_wire::zenoh::{Batch, Bytes, Gid, Side, WhatAmI, ZenohId};
use ros2probe_wire::{Guid, GuidPrefix, Reason, SequenceNumber, Timestamp};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::model_time::ModelTime;
use crate::facts::route::Destination;
use crate::facts::tables::{ZenohChainBytes, ZenohCut, ZenohDirections, ZenohUnseen};
pub use endpoints::unknown_guid;
pub use facts::{Counters, ZenohFacts};
use graph::Graph;
pub use graph::{GraphChange, RestoredEndpoint};
pub use processes::Holder;
use remembered::Remembered;
pub use remembered::ZenohMemory;
use replies::Replies;
pub use stream::{Flow, StreamEvent, StreamId, StreamReport, Unseen};
use stream_state::{Aliases, DirectionNumber, StreamState};

/// A message that rmw_zenoh sent: a sample of a topic, a request, or a reply.
#[derive(Clone, Copy, Debug)]
pub struct ZenohSample<'a> {
    /// Its writer.
    pub writer: Guid,
    /// Its sequence number, assigned by the writer.
    pub number: SequenceNumber,
    /// Time of publication, by the writer's clock.
    pub source_timestamp: Option<Timestamp>,
    /// The payload; the capture may contain only its beginning.
    pub payload: Bytes<'a>,
    /// The session that receives it, if known.
    pub receiver: Option<GuidPrefix>,
    /// Whether the receiver is a router.
    pub is_relayed: bool,
    /// Cookie of the receiver's socket, if it is another socket of this host and `receiver` is
    /// known; else 0.
    pub receiving_socket: u64,
    /// Time of its first FRAGMENT.
    pub began: ModelTime,
    /// For a request or reply: gid of the client, and the number of the request.
    pub call: Option<(Gid, SequenceNumber)>,
    /// The gid of the subscription, if the sample contains references to buffers and no message.
    pub referring: Option<Gid>,
}

/// A fact that a report shows.
#[derive(Debug)]
pub enum ReportFact<'a> {
    /// A message.
    Sample(&'a ZenohSample<'a>),
    /// A session owns a socket of this host.
    Owner(u64, GuidPrefix),
    /// The session may not own the socket, contrary to [`Self::Owner`].
    Disowned(u64, GuidPrefix),
    /// A session sent something.
    Alive(ZenohId),
    /// A router sent something, and this restored session is known only through a router.
    Relayed(ZenohId),
    /// Bytes for this destination were not captured.
    Missed(Destination),
    /// Bytes could not be read.
    Malformed(Reason),
}

/// All connections of Zenoh.
#[derive(Debug, Default)]
pub struct Zenoh {
    directions: Bounded<Counted<ZenohDirections>, HashMap<StreamId, Box<StreamState>>>,
    /// Number of the newest direction.
    numbered: DirectionNumber,
    aliases: Aliases,
    /// The stream in which each flow was last seen.
    flows: Bounded<ZenohDirections, HashMap<Flow, StreamId>>,
    /// The graph from the tokens.
    pub graph: Graph,
    replies: Replies,
    remembered: Remembered,
    /// Routers that lost a connection that may have led to another router, with the time.
    cut_routers: Bounded<ZenohCut, BTreeMap<ZenohId, ModelTime>>,
    /// Time of the first report.
    began: ModelTime,
    unseen: Bounded<ZenohUnseen, BTreeSet<(Unseen, Flow)>>,
    chain_bytes: Sum<ZenohChainBytes>,
    /// Time of the last search for stale messages in FRAGMENTs.
    last_stale_search: ModelTime,
    counters: Counters,
    /// Whether a session of this host has sent an INIT since the last [`Self::link`].
    pub has_begun: bool,
    /// Number that increases when the senders in [`Self::memory`] change.
    revision: u64,
}

/// Stream and times of a message.
#[derive(Clone, Copy)]
struct Place<'a> {
    stream: &'a StreamId,
    /// Time of its last byte.
    time: ModelTime,
    /// Time of its first FRAGMENT, or that of the batch.
    began: ModelTime,
}

impl Zenoh {
    /// Processes a report at `time`. `wants_bytes` is whether payloads are requested.
    pub fn report(
        &mut self,
        report: &StreamReport<'_>,
        time: ModelTime,
        wants_bytes: bool,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        let stream = report.stream;
        self.remembered.expire(time);
        if self.began == ModelTime::ZERO {
            self.began = time;
        }
        match report.event {
            StreamEvent::Begin => self.begin(stream),
            StreamEvent::End => self.end(stream, time),
            StreamEvent::Gap => {
                self.counters.gaps += 1;
                show(ReportFact::Missed(stream.flow.destination));
                if let Some(direction) = self.directions.get_mut(stream) {
                    self.chain_bytes.sub(direction.held());
                    direction.interrupt();
                }
            }
            StreamEvent::Unseen(reason) => self.note_unseen(reason, stream.flow),
            StreamEvent::Batch { bytes, length } => {
                self.counters.batches += 1;
                let place = Place {
                    stream,
                    time,
                    began: time,
                };
                self.batch(place, Batch::new(bytes, length.into()), wants_bytes, show);
            }
        }
    }

    /// Returns the figures.
    #[must_use]
    pub fn facts(&self) -> ZenohFacts {
        let live = || {
            self.directions
                .iter()
                .filter(|(_, direction)| !direction.has_left)
        };
        let connections: BTreeSet<_> = live().map(|(stream, _)| stream.flow.connection()).collect();
        let sides = live().filter_map(|(_, direction)| direction.sender);
        let routers = sides.filter(|side| side.whatami == WhatAmI::Router);
        let routers: BTreeSet<_> = routers.map(|side| side.zid).collect();
        let unseen = Unseen::ALL.map(|reason| {
            let of_reason = self.unseen.iter().filter(|(other, _)| *other == reason);
            of_reason.count() as u64
        });
        ZenohFacts {
            connections: connections.len() as u64,
            routers: routers.len() as u64,
            unseen,
            counters: self.counters,
        }
    }

    /// Returns whether anything of Zenoh was seen.
    #[must_use]
    pub fn is_used(&self) -> bool {
        self.counters.batches > 0 || !self.unseen.is_empty()
    }

    /// Returns the state of the connections that a restart of the agent needs.
    #[must_use]
    pub fn memory(&self) -> ZenohMemory {
        let (senders, relayed) = self.remembered.parts();
        let mut senders = senders.clone();
        let mut relayed: BTreeSet<_> = relayed.clone();
        for (stream, direction) in &self.directions {
            let linked = direction.linked.map(|zid| Side {
                zid,
                whatami: WhatAmI::Peer,
            });
            if let Some(side) = direction.sender.or(linked).filter(|_| !direction.has_left) {
                senders.insert(stream.flow, side);
            }
        }
        let connected: BTreeSet<_> = self
            .directions
            .values()
            .filter_map(|direction| direction.session())
            .chain(senders.values().map(|side| side.zid))
            .collect();
        relayed.extend(self.graph.sessions());
        ZenohMemory::new(&senders, &(&relayed - &connected), &self.graph.passages())
    }

    /// Returns a number that increases when the connections in [`Self::memory`] change.
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Restores saved connections, and the endpoints of their sessions, which discovery knows.
    pub fn restore<'a>(
        &mut self,
        memory: &ZenohMemory,
        endpoints: impl Iterator<Item = RestoredEndpoint<'a>>,
        now: ModelTime,
    ) {
        self.remembered.restore(memory, now);
        let sessions = self.remembered.sessions().into_iter();
        let sessions: BTreeMap<_, _> = sessions.map(|zid| (zid.guid_prefix(), zid)).collect();
        for endpoint in endpoints {
            let prefix = endpoint.guid.prefix;
            if prefix.is_zenoh() {
                let session = sessions.get(&prefix).copied();
                self.graph.restore(endpoint, session);
            }
        }
        self.graph.restore_passages(memory.passages());
    }

    /// Returns the tables for the snapshot.
    #[must_use]
    pub fn tables(&self) -> Vec<TableFacts> {
        let mut tables = vec![self.directions.facts(), self.aliases.facts()];
        tables.extend(self.graph.tables());
        tables
    }
}
