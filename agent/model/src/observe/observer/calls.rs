//! Calls of services: captured requests and replies, and their further copies.

use ros2probe_wire::record::Verdict;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::walk::Found;
use ros2probe_wire::{EntityId, Guid};

use super::Observer;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, Sample};

impl Observer {
    /// Reads the identity of a captured request or reply.
    pub(super) fn identify_call(&mut self, found: &Found<'_>, sample: &Sample, vendor: VendorId) {
        let writer = sample.head.writer;
        match self.derive.services.identify(found, sample, vendor) {
            Ok(is_over_budget) => self.follow_call(writer, is_over_budget),
            Err(error) => self.decode_error("request", error.reason),
        }
    }

    /// Keeps a captured response of `get_type_description`, or a reply of the TypeLookup service,
    /// once it is whole.
    pub(super) fn keep_type_source(
        &mut self,
        found: &Found<'_>,
        sample: &Sample,
        vendor: VendorId,
    ) {
        let (writer, number) = (sample.head.writer, sample.sequence_number);
        let has_objects = writer.entity == EntityId::TYPE_LOOKUP_REPLY_WRITER;
        if !has_objects && !self.derive.services.describes_types(writer)
            || !sample.is_message()
            || self.derive.type_descriptions.has(writer, number)
        {
            return;
        }
        let whole;
        let payload = match sample.content {
            Content::Data { .. } => found.payload,
            Content::DataFrag(fragments) => {
                let fragmented = &mut self.measure.discovery_fragments;
                let Some(bytes) = fragmented.put(sample, fragments, found.payload) else {
                    return;
                };
                whole = bytes;
                &whole
            }
        };
        let descriptions = &mut self.derive.type_descriptions;
        match has_objects {
            true => descriptions.add_objects(writer, number, payload),
            false => descriptions.add(writer, number, Some(vendor), payload),
        }
    }

    /// Stops capturing a writer of requests or replies that has exceeded its budget.
    pub(super) fn follow_call(&mut self, writer: Guid, is_over_budget: bool) {
        if is_over_budget && !self.measure.payloads.needs_payload(writer) {
            let is_measured = self.measure.profiler.get(writer).is_some();
            let verdict = match is_measured {
                true => Verdict::Meter,
                false => Verdict::Ignore,
            };
            self.requested.interest.set(writer, verdict);
        }
    }

    /// Counts a copy of a request or reply.
    pub(super) fn count_call(&mut self, sample: &Sample) {
        if self.derive.services.follows(sample.head.writer) {
            let (receivers, discovery) = (&self.graph.receivers, &self.graph.discovery);
            let services = &mut self.derive.services;
            let request =
                services.seen(sample, || receivers.owner(&sample.head.route(), discovery));
            if let Some((sent, client)) = request {
                self.clock_of_reply(sample, sent, client);
            }
        }
    }

    /// Marks hanging calls, and captures writers again that had exceeded their budget.
    pub(super) fn advance_calls(&mut self, now: ModelTime) {
        let topics = &self.graph.topics;
        let timeout = self.settings.service_timeout;
        let resumed = self
            .derive
            .services
            .advance(timeout, now, |domain_id, name| {
                let halves = [format!("rq{name}Request"), format!("rr{name}Reply")];
                halves
                    .iter()
                    .any(|dds_name| topics.knows(domain_id, dds_name))
            });
        for guid in resumed {
            let endpoint = self.graph.discovery.endpoints().get(&guid);
            let id = endpoint.and_then(|endpoint| {
                self.graph
                    .topics
                    .find(endpoint.domain_id, &endpoint.naming()?)
            });
            if let Some(id) = id {
                self.apply(id, guid, now, false);
            }
        }
    }
}
