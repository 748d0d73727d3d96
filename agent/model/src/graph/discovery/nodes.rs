//! Nodes, from `ros_discovery_info`.

use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, SequenceNumber};

use super::Discovery;
use super::PendingNodes;
use super::endpoints_of;
use super::entity::DiscoveredEntity;
use super::eviction::{Newcomer, Table};
use super::facts::{Node, Origin, named};
use super::priority::Priority;
use crate::facts::bounded;
use crate::facts::churn::Event;
use crate::facts::journal::Journal;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::tables::{ParticipantEndpoints, PendingNodeBytes};

/// Returns the names in `one` that `other` lacks, repeated as often as they are missing.
pub(super) fn difference(one: &[NodeName], other: &[NodeName]) -> Vec<NodeName> {
    let mut rest: Vec<_> = other.to_vec();
    let mut missing = Vec::new();
    for name in one {
        match rest.iter().position(|each| each == name) {
            Some(index) => drop(rest.swap_remove(index)),
            None => missing.push(name.clone()),
        }
    }
    missing
}

impl Discovery {
    /// Replaces the nodes of a participant with those of a `ros_discovery_info` sample. `evidence`
    /// is the priority known for the participant.
    pub fn entities(
        &mut self,
        entities: &ParticipantEntities,
        writer: Guid,
        origin: &Origin,
        evidence: Priority,
        journal: &mut Journal,
    ) {
        // A participant announces only its own nodes.
        let prefix = entities.participant.prefix;
        if prefix != writer.prefix {
            return;
        }
        let priority = self.participants.get(&prefix).map(|known| known.priority());
        let guid = entities.participant;
        let newcomer = priority.map(|priority| Newcomer { guid, priority });
        let wanted = entities.nodes.iter();
        let wanted = wanted.map(|node| node.writers.len() + node.readers.len());
        let wanted = wanted.sum::<usize>().min(ParticipantEndpoints::CAP);
        let (eviction, mut names) = loop {
            let (eviction, names) = self.node_quota(prefix);
            let fits = entities.nodes.len() <= eviction && wanted <= names;
            let newcomer = newcomer.filter(|_| !fits);
            let is_more =
                newcomer.is_some_and(|newcomer| self.evict_for(Table::Nodes, newcomer, origin.at));
            if !is_more {
                break (eviction, names.min(ParticipantEndpoints::CAP));
            }
        };
        let mut nodes: Vec<Node> = entities.nodes.iter().take(eviction).map(Node::of).collect();
        let cut = entities.nodes.len() - nodes.len();
        self.node_count.refuse_all(cut as u64);
        for node in &mut nodes {
            self.node_count.refuse_all(node.cut(&mut names).into());
        }
        if self.participants.contains_key(&prefix) {
            self.set_nodes(
                prefix,
                writer,
                origin.sequence_number,
                nodes,
                origin.at,
                journal,
            );
            return;
        }
        let older = |pending: &PendingNodes| {
            pending.writer == writer && pending.sequence_number >= origin.sequence_number
        };
        if self.pending_nodes.get(&prefix).is_some_and(older) {
            return;
        }
        self.pending_nodes.remove(&prefix);
        let bytes = nodes.iter().map(Node::bytes).sum();
        let waiting = self.pending_endpoints.range(endpoints_of(prefix));
        let priority = waiting.fold(evidence, |priority, (_, other)| priority.or(other));
        while self.pending_nodes.is_full()
            || self.pending_node_bytes() + bytes > PendingNodeBytes::CAP
        {
            self.pending_nodes.refuse();
            self.node_count.refuse();
            let pending = self.pending_nodes.iter();
            let oldest = pending.min_by_key(|(_, pending)| (pending.priority, pending.at));
            match oldest.map(|(prefix, pending)| (*prefix, pending.priority)) {
                Some((oldest, least)) if least <= priority => self.pending_nodes.remove(&oldest),
                _ => return,
            };
        }
        let sequence_number = origin.sequence_number;
        let pending = PendingNodes {
            at: origin.at,
            priority,
            writer,
            sequence_number,
            nodes,
            bytes,
        };
        self.pending_nodes.insert(prefix, pending);
        bounded::note::<PendingNodeBytes>(self.pending_node_bytes());
    }

    /// Returns how many nodes this participant may have, and how many endpoints they may list.
    fn node_quota(&self, prefix: GuidPrefix) -> (usize, usize) {
        let known: &[Node] = match self.participants.get(&prefix) {
            Some(known) => &known.nodes,
            None => &[],
        };
        let eviction = self.node_count.remaining();
        let names = self.caps.endpoints.saturating_sub(self.named);
        (eviction + known.len(), names + named(known))
    }

    fn pending_node_bytes(&self) -> usize {
        self.pending_nodes
            .values()
            .map(|pending| pending.bytes)
            .sum()
    }

    pub(super) fn set_nodes(
        &mut self,
        prefix: GuidPrefix,
        writer: Guid,
        sequence_number: SequenceNumber,
        nodes: Vec<Node>,
        at: ModelTime,
        journal: &mut Journal,
    ) {
        let Some(participant) = self.participants.get_mut(&prefix) else {
            return;
        };
        let older =
            |(from, number): (Guid, SequenceNumber)| from == writer && number >= sequence_number;
        if participant.nodes_from.is_some_and(older) {
            return;
        }
        participant.nodes_from = Some((writer, sequence_number));
        let domain_id = participant.domain_id;
        let before = std::mem::replace(&mut participant.nodes, nodes);
        self.named = self.named.saturating_sub(named(&before)) + named(&participant.nodes);
        let after: Vec<_> = participant
            .nodes
            .iter()
            .map(|node| node.name.clone())
            .collect();
        self.node_count.sub(before.len());
        self.node_count.add(after.len());
        let before: Vec<_> = before.into_iter().map(|node| node.name).collect();
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        for name in difference(&before, &after) {
            let entity = DiscoveredEntity::node(domain_id, guid, &name);
            self.note(&entity, Event::Disposed, at, journal);
        }
        for name in difference(&after, &before) {
            let entity = DiscoveredEntity::node(domain_id, guid, &name);
            self.note(&entity, Event::Appeared, at, journal);
        }
    }
}
