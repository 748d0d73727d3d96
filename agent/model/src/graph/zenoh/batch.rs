//! Transport messages of a batch: INIT identifies the sender, OPEN has its lease, a FRAME contains
//! network messages, and FRAGMENTs are parts of one network message.

use std::time::Duration;

use ros2probe_wire::Reason;
use ros2probe_wire::zenoh::{
    Batch, Fragment, Init, Message, NetworkMessage, Sample, Side, VERSION, WhatAmI,
};

use super::Place;
use super::ReportFact;
use super::Zenoh;
use super::messages::attachment;
use super::stream::{StreamId, Unseen};
use crate::facts::model_time::ModelTime;

/// Free memory for messages in FRAGMENTs below which stale ones are given up: one large message.
const MIN_FREE_BYTES: usize = 4 << 20;
/// Time without a FRAGMENT after which a message is given up if memory is needed.
const STALE_AFTER: Duration = Duration::from_secs(10);
/// Minimum time between two searches for stale messages.
const STALE_SEARCH_INTERVAL: Duration = Duration::from_secs(1);

impl Zenoh {
    pub(super) fn batch(
        &mut self,
        place: Place<'_>,
        batch: Batch<'_>,
        wants_bytes: bool,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        let stream = place.stream;
        let is_known = self.directions.contains_key(stream);
        let Some(direction) = self.direction(stream) else {
            return;
        };
        direction.last_seen = place.time;
        if let Some(owner) = direction.owner(stream).filter(|_| !is_known) {
            // The connection is known from saved state.
            show(ReportFact::Owner(stream.socket, owner.guid_prefix()));
        }
        if let Some(session) = direction.session() {
            show(ReportFact::Alive(session));
        }
        if direction
            .sender
            .is_some_and(|side| side.whatami == WhatAmI::Router)
        {
            for session in self.remembered.take_relayed() {
                show(ReportFact::Relayed(session));
            }
        }
        for message in batch {
            match message {
                Ok(Message::Init(init)) => self.init(stream, &init, show),
                Ok(Message::Open(open)) => {
                    if let Some(direction) = self.directions.get_mut(stream) {
                        direction.lease = Some(open.lease);
                    }
                }
                Ok(Message::Network(message)) => self.network(place, &message, show),
                Ok(Message::Fragment(fragment)) => {
                    self.fragment(place, &fragment, wants_bytes, show);
                }
                Ok(Message::Close(_)) => self.leave(stream, place.time),
                Ok(Message::Oam(_) | Message::KeepAlive | Message::Frame(_) | Message::Join(_)) => {
                }
                // The capture omitted the end of the batch on purpose.
                Err(error) if error.reason == Reason::Truncated => {}
                Err(error) => show(ReportFact::Malformed(error.reason)),
            }
        }
    }

    fn init(&mut self, stream: &StreamId, init: &Init<'_>, show: &mut impl FnMut(ReportFact<'_>)) {
        let side = Side {
            zid: init.zid,
            whatami: init.whatami,
        };
        let features = init.features;
        for (is_agreed, reason) in [
            (init.version != VERSION, Unseen::Version),
            (features.low_latency, Unseen::LowLatency),
            (features.compression, Unseen::Compression),
            (features.shared_memory, Unseen::SharedMemory),
        ] {
            if is_agreed && (init.is_ack || reason == Unseen::Version) {
                self.note_unseen(reason, stream.flow);
            }
        }
        let Some(direction) = self.direction(stream) else {
            return;
        };
        let before = direction.sender.replace(side);
        let owner = direction.owner(stream);
        if before.is_some_and(|before| before != side) {
            self.forget_aliases(stream);
        }
        self.join_transport(stream);
        if let Some(owner) = owner {
            show(ReportFact::Owner(stream.socket, owner.guid_prefix()));
            self.has_begun = true;
        }
        self.revision += 1;
    }

    /// Gives up messages whose FRAGMENTs have stopped arriving, at most once a second.
    fn drop_stale_chains(&mut self, now: ModelTime) {
        if now < self.last_stale_search + STALE_SEARCH_INTERVAL {
            return;
        }
        self.last_stale_search = now;
        let before = now - STALE_AFTER;
        for direction in self.directions.values_mut() {
            let held = direction.held();
            self.counters.incomplete += direction.drop_message(before) as u64;
            self.chain_bytes.sub(held - direction.held());
        }
    }

    fn fragment(
        &mut self,
        place: Place<'_>,
        fragment: &Fragment<'_>,
        wants_bytes: bool,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        if self.chain_bytes.remaining() < MIN_FREE_BYTES {
            self.drop_stale_chains(place.time);
        }
        let is_wanted = |beginning: &[u8]| match NetworkMessage::beginning(beginning) {
            Ok(NetworkMessage::Push(push)) => match push.sample {
                Sample::Put(put) => attachment(&put).map(|_| wants_bytes),
                Sample::Del(_) => Some(false),
            },
            // Requests and replies have their attachment after the payload.
            Ok(_) => Some(true),
            Err(_) => fragment.is_first.then_some(true),
        };
        let Some(direction) = self.directions.get_mut(place.stream) else {
            return;
        };
        let before = direction.held();
        let room = self.chain_bytes.remaining();
        let waited = direction.chains.len();
        let chain = direction.fragment(fragment, place.time, is_wanted, room);
        let was_broken = chain.is_none() && direction.chains.len() < waited;
        self.counters.incomplete += u64::from(was_broken || fragment.is_dropped);
        self.chain_bytes.sub(before);
        self.chain_bytes.add(direction.held());
        let Some(chain) = chain else {
            return;
        };
        let message = match chain.bytes.len() == chain.length {
            true => NetworkMessage::whole(&chain.bytes),
            false => NetworkMessage::beginning(&chain.bytes),
        };
        let place = Place {
            began: chain.began,
            ..place
        };
        match message {
            Ok(message) => self.network(place, &message, show),
            Err(error) if error.reason == Reason::Truncated => self.counters.incomplete += 1,
            Err(error) => show(ReportFact::Malformed(error.reason)),
        }
    }
}
