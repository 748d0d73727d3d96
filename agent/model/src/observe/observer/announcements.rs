//! Parses SPDP, SEDP and `ros_discovery_info` samples for discovery.

use ros2probe_wire::discovery::{self, EndpointAnnouncement, ParticipantAnnouncement, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::rtps::{InlineQos, Payload, StatusInfo, VendorId};
use ros2probe_wire::walk::Found;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, WireError};

use super::Observer;
use crate::derive::services;
use crate::facts::observation::{Content, Observation, Sample};
use crate::facts::route::Destination;
use crate::graph::discovery::{Origin, Priority, endpoints_of};
use crate::observe::input::Captured;

impl Observer {
    pub(super) fn announced(
        &mut self,
        captured: Captured<'_>,
        found: &Found<'_>,
        observation: &Observation,
    ) {
        let Captured {
            envelope, vendor, ..
        } = captured;
        if let Observation::Sample(sample) = observation {
            let prefix = sample.head.writer.prefix;
            let [first, second, ..] = prefix.0;
            let vendor = vendor.unwrap_or(VendorId([first, second]));
            let origin = Origin {
                at: sample.head.at,
                sender: prefix,
                sequence_number: sample.sequence_number,
                destination: envelope.destination,
                port: match envelope.logical_port {
                    0 => envelope.destination_port,
                    logical => logical,
                },
            };
            self.read(found, sample, vendor, &origin);
            self.apply_discovery_changes(origin.at);
            self.identify_call(found, sample, vendor);
            self.keep_type_source(found, sample, vendor);
            self.keep_payload(sample, found.payload);
            let call = |half| services::call(half, found, sample, vendor);
            self.read_robot_sample(sample, found.payload, vendor, call);
        }
    }

    /// Parses a sample if it is relevant to discovery.
    fn read(&mut self, found: &Found<'_>, sample: &Sample, vendor: VendorId, origin: &Origin) {
        let writer = sample.head.writer;
        let stage = match writer.entity {
            EntityId::SPDP_WRITER | EntityId::SPDP_SECURE_WRITER => "spdp",
            EntityId::SEDP_PUBLICATIONS_WRITER
            | EntityId::SEDP_SUBSCRIPTIONS_WRITER
            | EntityId::SEDP_PUBLICATIONS_SECURE_WRITER
            | EntityId::SEDP_SUBSCRIPTIONS_SECURE_WRITER => "sedp",
            entity if !entity.is_builtin() && self.may_be_entities(found, sample) => "entities",
            _ => return,
        };
        let whole;
        let (payload, inline_qos) = if let Content::DataFrag(fragments) = sample.content {
            let fragmented = &mut self.measure.discovery_fragments;
            let Some(bytes) = fragmented.put(sample, fragments, found.payload) else {
                return;
            };
            whole = bytes;
            let status_info = sample.status_info;
            (
                Payload::Data(&whole),
                Ok(InlineQos {
                    status_info,
                    ..InlineQos::default()
                }),
            )
        } else {
            (found.payload(), found.inline_qos(vendor))
        };
        let processed = inline_qos.and_then(|inline_qos| match stage {
            "spdp" => self.participant(vendor, payload, &inline_qos, origin),
            "sedp" => self.endpoint(writer.entity, vendor, payload, &inline_qos, origin),
            _ => self.entities(writer, payload, origin),
        });
        if let Err(error) = processed {
            self.decode_error(stage, error.reason);
        }
    }

    /// Returns whether a sample is on `ros_discovery_info`, or has the same form on an unannounced
    /// topic. Such a sample is sent once, perhaps before its writer's announcement is processed.
    fn may_be_entities(&self, found: &Found<'_>, sample: &Sample) -> bool {
        let writer = sample.head.writer;
        if sample.status_info != StatusInfo::ALIVE {
            return false;
        }
        if let Some(endpoint) = self.graph.discovery.endpoints().get(&writer) {
            return &*endpoint.topic == "ros_discovery_info";
        }
        let own = Guid::new(writer.prefix, EntityId::PARTICIPANT).to_bytes();
        let begins = found.payload.get(4..20).is_some_and(|gid| *gid == own);
        match sample.content {
            Content::Data { .. } => begins,
            Content::DataFrag(_) => {
                sample.is_start() && begins || self.measure.discovery_fragments.holds(sample)
            }
        }
    }

    pub(super) fn participant(
        &mut self,
        vendor: VendorId,
        payload: Payload<'_>,
        inline_qos: &InlineQos,
        origin: &Origin,
    ) -> Result<(), WireError> {
        match discovery::participant(vendor, payload, inline_qos)? {
            discovery::Discovery::Alive(announcement) => {
                self.learn_participant(&announcement, origin);
                self.announce(announcement.guid.prefix);
            }
            discovery::Discovery::Gone { guid, .. } => {
                self.graph
                    .discovery
                    .participant_gone(guid, origin, &mut self.journal);
            }
        }
        Ok(())
    }

    pub(super) fn endpoint(
        &mut self,
        entity: EntityId,
        vendor: VendorId,
        payload: Payload<'_>,
        inline_qos: &InlineQos,
        origin: &Origin,
    ) -> Result<(), WireError> {
        let role = match entity {
            EntityId::SEDP_PUBLICATIONS_WRITER | EntityId::SEDP_PUBLICATIONS_SECURE_WRITER => {
                Role::Writer
            }
            _ => Role::Reader,
        };
        match discovery::endpoint(role, vendor, payload, inline_qos)? {
            discovery::Discovery::Alive(announcement) => {
                if let Some(error) = announcement.type_information_error {
                    self.decode_error("type_information", error.reason);
                }
                let prefix = announcement.guid.prefix;
                if self.learn_endpoint(announcement, origin) {
                    self.announce(prefix);
                }
            }
            discovery::Discovery::Gone { guid, .. } => {
                self.graph
                    .discovery
                    .endpoint_gone(guid, origin, &mut self.journal);
            }
        }
        Ok(())
    }

    pub(super) fn entities(
        &mut self,
        writer: Guid,
        payload: Payload<'_>,
        origin: &Origin,
    ) -> Result<(), WireError> {
        let entities = ParticipantEntities::parse(payload.bytes())?;
        self.learn_entities(&entities, writer, origin);
        Ok(())
    }

    /// Records a participant that is announced.
    pub(super) fn learn_participant(
        &mut self,
        announcement: &ParticipantAnnouncement,
        origin: &Origin,
    ) {
        let evidence = self.evidence(announcement.guid.prefix);
        let journal = &mut self.journal;
        self.graph
            .discovery
            .participant(announcement, origin, evidence, journal);
    }

    /// Records an endpoint that is announced. Returns whether its participant is thereby admitted.
    pub(super) fn learn_endpoint(
        &mut self,
        announcement: EndpointAnnouncement,
        origin: &Origin,
    ) -> bool {
        let evidence = self.evidence(announcement.guid.prefix);
        let journal = &mut self.journal;
        self.graph
            .discovery
            .endpoint(announcement, origin, evidence, journal)
    }

    /// Records the nodes of a participant.
    pub(super) fn learn_entities(
        &mut self,
        entities: &ParticipantEntities,
        writer: Guid,
        origin: &Origin,
    ) {
        let evidence = self.evidence(writer.prefix);
        let journal = &mut self.journal;
        self.graph
            .discovery
            .entities(entities, writer, origin, evidence, journal);
    }

    /// Returns the known priority of a participant that is announced.
    fn evidence(&self, prefix: GuidPrefix) -> Priority {
        Priority {
            watched: false,
            local: self.graph.receivers.is_local(&prefix),
            sends: self
                .measure
                .profiler
                .has_unknown_writer(endpoints_of(prefix)),
        }
    }

    /// Records the announced addresses of a known participant.
    pub(super) fn announce(&mut self, prefix: GuidPrefix) {
        if let Some(participant) = self.graph.discovery.participants().get(&prefix) {
            let addresses = &participant.addresses;
            let addresses = addresses.default.iter().chain(&addresses.metatraffic);
            self.graph
                .receivers
                .announce(prefix, addresses.copied().map(Destination::from));
        }
    }
}
