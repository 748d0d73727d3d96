//! Evidence for the offsets between hosts' clocks.

use std::net::IpAddr;

use ros2probe_wire::{Guid, GuidPrefix};

use super::Observer;
use crate::derive::robot::Part;
use crate::facts::diagnosis::TopicKey;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{AckNack, Heartbeat, Observation, Sample};

impl Observer {
    /// Passes the times in an observation on to the clocks.
    pub(super) fn compare_clocks(&mut self, observation: &Observation) {
        if !self.settings.robot.has(Part::Clocks) || observation.head().is_in_shared_memory() {
            return;
        }
        match observation {
            Observation::Sample(sample) => self.clock_of_sample(sample),
            Observation::AckNack(acknack) => self.clock_of_acknack(acknack),
            Observation::Heartbeat(heartbeat) if heartbeat.head.is_outgoing() => {
                let Heartbeat { head, last, .. } = heartbeat;
                self.derive.clocks.announced(head.writer, *last, head.at);
            }
            Observation::Heartbeat(_) | Observation::Gap(_) | Observation::Presence(_) => {}
        }
    }

    /// Ends a second of the clocks.
    pub(super) fn end_second_of_clocks(&mut self, now: ModelTime) {
        let (clocks, graph) = (&mut self.derive.clocks, &self.graph);
        if clocks.is_used() {
            let participants = graph.discovery.participants().values();
            let mut own = participants.filter(|participant| participant.local);
            clocks.name(own.find_map(|participant| participant.proxy.host.as_ref()));
        }
        clocks.end_second(now, graph.wall_clock);
        self.correct_latencies(now);
        let graph = &self.graph;
        let clocks = graph.topics.iter().map(|(_, topic)| topic);
        let clocks = clocks
            .filter(|topic| *topic.naming.name == *"/clock" && !topic.writers.is_empty())
            .map(|topic| topic.domain_id);
        self.derive.stamps.end_second(now, clocks);
    }

    /// Compares the stamp of a measured message with the time of its publication.
    pub(super) fn check_stamp(&mut self, observation: &Observation) {
        let Observation::Sample(sample) = observation else {
            return;
        };
        let (writer, at) = (sample.head.writer, sample.head.at);
        if let Some(stamp) = sample.header_stamp
            && sample.is_message()
            && self.settings.robot.has(Part::Clocks)
            && let Some(published) = sample.source_timestamp.timestamp()
            && let Some(measured) = self.measure.profiler.get(writer)
            && measured.writer.traits().has_header
        {
            let message = (writer, sample.sequence_number);
            let topics = &self.graph.topics;
            let topic = || {
                let topic = topics.get(measured.topic?)?;
                Some(TopicKey::of(topic.domain_id, &topic.naming))
            };
            self.derive
                .stamps
                .add(message, (stamp, published), at, topic);
        }
    }

    /// Corrects latencies of all measured writers on other hosts by the offset of their clocks.
    pub(super) fn correct_latencies(&mut self, now: ModelTime) {
        let clocks = &mut self.derive.clocks;
        if !clocks.correct(now, self.graph.wall_clock) {
            return;
        }
        let participants = self.graph.discovery.participants();
        self.measure.profiler.set_clocks(|guid| {
            let participant = participants.get(&guid.prefix);
            let other = participant.filter(|participant| !participant.local);
            let address = other.and_then(|participant| participant.addresses.reachable());
            address.map_or(0, |address| clocks.correction(address))
        });
    }

    fn clock_of_sample(&mut self, sample: &Sample) {
        let head = &sample.head;
        if head.is_outgoing() {
            let number = sample.sequence_number;
            self.derive.clocks.note_sent(head.writer, number, head.at);
            return;
        }
        // Announcements are repeated with old stamps, and only the first fragment follows its stamp
        // at once.
        if head.writer.entity.is_builtin() || !sample.is_start() {
            return;
        }
        let Some(participant) = self.graph.discovery.participants().get(&head.writer.prefix) else {
            return;
        };
        let name = participant.proxy.host.as_ref();
        if !participant.local
            && let Some(stamp) = sample.source_timestamp.timestamp()
            && let Some(address) = participant.addresses.reachable()
        {
            // The first of several datagrams already follows the stamp.
            self.derive
                .clocks
                .arrived((address, name), stamp, head.began());
        }
    }

    fn clock_of_acknack(&mut self, acknack: &AckNack) {
        let head = &acknack.head;
        let participants = self.graph.discovery.participants();
        let writer = participants.get(&head.writer.prefix);
        if !head.is_outgoing()
            && writer.is_some_and(|writer| writer.local)
            && let Some(address) = self.remote_address(&head.reader.prefix)
        {
            let number = acknack.base().previous();
            self.derive
                .clocks
                .acknowledged(address, head.writer, number, head.at);
        }
    }

    /// Records a reply to a request that `client` sent at `sent`.
    pub(super) fn clock_of_reply(&mut self, sample: &Sample, sent: ModelTime, client: Guid) {
        let participants = self.graph.discovery.participants();
        let client = participants.get(&client.prefix);
        if self.settings.robot.has(Part::Clocks)
            && client.is_some_and(|client| client.local)
            && let Some(stamp) = sample.source_timestamp.timestamp()
            && let Some(address) = self.remote_address(&sample.head.writer.prefix)
        {
            let now = sample.head.at;
            self.derive.clocks.note_reply(address, stamp, sent, now);
        }
    }

    fn remote_address(&self, prefix: &GuidPrefix) -> Option<IpAddr> {
        let participant = self.graph.discovery.participants().get(prefix)?;
        let address = participant.addresses.reachable();
        address.filter(|_| !participant.local)
    }
}
