//! The RTPS messages as which a bag is replayed.
//!
//! A bag says what was published, but not by whom. Its topics belong to one participant with the
//! node `/rosbag2_player`, as when `ros2 bag play` publishes them. The model thus reads a bag as it
//! reads a capture.

use std::collections::HashMap;

use ros2probe_bag::messages::Topic;
use ros2probe_bag::qos;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::encode::{
    self, CDR_LE, Message, PL_CDR_LE, Parameters, VENDOR, duration, octets, text,
};
use ros2probe_wire::names::{DdsTopic, DdsType, RosName, RosType};
use ros2probe_wire::parameters::ParameterId;
use ros2probe_wire::qos::{Durability, Qos};
use ros2probe_wire::{
    DomainId, EntityId, Guid, GuidPrefix, RtpsDuration, SequenceNumber, Timestamp,
};

/// Maximum number of topics; messages of further ones are skipped.
pub(super) const MAX_TOPICS: usize = 16_384;
/// Domain of the player: the default one.
const DOMAIN_ID: u16 = 0;
/// The participant. Its prefix begins with the vendor id (RTPS 2.5, 9.3.1.5).
const PREFIX: GuidPrefix = {
    let [high, low] = VENDOR.0;
    GuidPrefix([high, low, b'r', b'o', b's', b'b', b'a', b'g', b'2', 0, 0, 0])
};
/// Writer of `ros_discovery_info`: user-defined, without key.
const NODES_WRITER: EntityId = EntityId([0, 0, 1, WRITER_KIND]);
/// Kind of a user-defined writer without key (RTPS 2.5, 9.3.1.2).
const WRITER_KIND: u8 = 0x03;
/// SPDP and SEDP publications writers.
const BUILTIN_ENDPOINTS: u32 = 0x05;

/// The participant that publishes a bag.
#[derive(Debug, Default)]
pub(super) struct Player {
    /// Writers by topic; `None` for a topic that cannot be published.
    writers: HashMap<Box<str>, Option<Writer>>,
    /// Number of writers that were announced.
    announced: u32,
    /// Number of samples of `ros_discovery_info`.
    node_samples: u64,
}

#[derive(Debug)]
struct Writer {
    entity: EntityId,
    /// Number of its last sample.
    number: SequenceNumber,
}

/// A message of the player.
#[derive(Debug)]
pub(super) struct Datagram {
    /// Port to which it is sent (RTPS 2.5, 9.6.2.3).
    pub(super) port: u16,
    /// The message.
    pub(super) bytes: Vec<u8>,
}

impl Player {
    /// Returns the announcements of the participant, of its node and of these topics.
    pub(super) fn announce(&mut self, topics: &[(Topic, Option<String>)]) -> Vec<Datagram> {
        let own = Guid::new(PREFIX, EntityId::PARTICIPANT);
        let [high, low] = VENDOR.0;
        let payload = Parameters::default()
            .add(ParameterId::PROTOCOL_VERSION, &[2, 3, 0, 0])
            .add(ParameterId::VENDORID, &[high, low, 0, 0])
            .add(ParameterId::PARTICIPANT_GUID, &own.to_bytes())
            .add(
                ParameterId::PARTICIPANT_LEASE_DURATION,
                &duration(RtpsDuration::Infinite),
            )
            .add(ParameterId::DOMAIN_ID, &u32::from(DOMAIN_ID).to_le_bytes())
            .add(
                ParameterId::BUILTIN_ENDPOINT_SET,
                &BUILTIN_ENDPOINTS.to_le_bytes(),
            )
            .add(ParameterId::USER_DATA, &octets(b"enclave=/;"))
            .end();
        let participant = Message::new(PREFIX).data(
            (EntityId::UNKNOWN, EntityId::SPDP_WRITER),
            SequenceNumber::FIRST,
            &[&PL_CDR_LE, &payload],
        );
        let nodes = Endpoint {
            entity: NODES_WRITER,
            topic: "ros_discovery_info",
            type_name: "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
            qos: Qos {
                durability: Durability::TRANSIENT_LOCAL,
                ..Qos::defaults(Role::Writer, VENDOR)
            },
            type_hash: None,
        };
        let mut datagrams = vec![metatraffic(participant), self.endpoint(&nodes)];
        let writers = topics
            .iter()
            .filter_map(|(topic, hash)| self.writer(topic, hash.as_deref()));
        let writers: Vec<_> = writers.collect();
        datagrams.extend(writers);
        datagrams.push(self.nodes());
        datagrams
    }

    /// Returns the announcements of one more topic.
    pub(super) fn add(&mut self, topic: &Topic, type_hash: Option<&str>) -> Vec<Datagram> {
        match self.writer(topic, type_hash) {
            Some(announcement) => vec![announcement, self.nodes()],
            None => Vec::new(),
        }
    }

    /// Returns whether the topic was announced, or cannot be.
    pub(super) fn knows(&self, topic: &str) -> bool {
        self.writers.contains_key(topic)
    }

    /// Returns a sample, in the memory of `bytes`. `None` if its topic cannot be published.
    pub(super) fn sample(
        &mut self,
        topic: &str,
        written: Option<Timestamp>,
        payload: &[u8],
        bytes: Vec<u8>,
    ) -> Option<Datagram> {
        let writer = self.writers.get_mut(topic)?.as_mut()?;
        writer.number = writer.number.next();
        let ends = (EntityId::UNKNOWN, writer.entity);
        let mut message = Message::in_memory(bytes, PREFIX);
        if let Some(written) = written {
            message = message.timestamp(written);
        }
        let message = message.data(ends, writer.number, &[payload]);
        Some(user_traffic(message))
    }

    /// Adds the writer of a topic, and returns its announcement. `None` if its names are invalid or
    /// there are too many topics.
    fn writer(&mut self, topic: &Topic, type_hash: Option<&str>) -> Option<Datagram> {
        if self.writers.len() >= MAX_TOPICS {
            return None;
        }
        let names = RosName::parse(&topic.name)
            .ok()
            .filter(|name| name.as_str().starts_with('/'))
            .zip(RosType::parse(&topic.type_name).ok());
        let Some((name, type_name)) = names else {
            self.writers.insert(topic.name.as_str().into(), None);
            return None;
        };
        // The first key belongs to the writer of `ros_discovery_info`.
        let key = u32::try_from(self.writers.len()).unwrap_or(0) + 2;
        let [_, high, middle, low] = key.to_be_bytes();
        let entity = EntityId([high, middle, low, WRITER_KIND]);
        let offered = qos::first(&topic.offered_qos_profiles);
        let announcement = self.endpoint(&Endpoint {
            entity,
            topic: DdsTopic::of_topic(&name).as_str(),
            type_name: DdsType::of_message(&type_name).as_str(),
            qos: offered.unwrap_or_else(|| Qos::defaults(Role::Writer, VENDOR)),
            type_hash,
        });
        let writer = Writer {
            entity,
            number: SequenceNumber::ZERO,
        };
        self.writers
            .insert(topic.name.as_str().into(), Some(writer));
        Some(announcement)
    }

    /// Returns the SEDP announcement of a writer.
    fn endpoint(&mut self, endpoint: &Endpoint<'_>) -> Datagram {
        let Endpoint {
            entity,
            topic,
            type_name,
            qos,
            type_hash,
        } = endpoint;
        let own = Guid::new(PREFIX, EntityId::PARTICIPANT);
        let guid = Guid::new(PREFIX, *entity);
        let mut parameters = Parameters::default()
            .add(ParameterId::ENDPOINT_GUID, &guid.to_bytes())
            .add(ParameterId::PARTICIPANT_GUID, &own.to_bytes())
            .add(ParameterId::TOPIC_NAME, &text(topic.as_bytes()))
            .add(ParameterId::TYPE_NAME, &text(type_name.as_bytes()))
            .add(
                ParameterId::RELIABILITY,
                &[qos.reliability.0.to_le_bytes(), [0; 4], [0; 4]].concat(),
            )
            .add(ParameterId::DURABILITY, &qos.durability.0.to_le_bytes())
            .add(ParameterId::DEADLINE, &duration(qos.deadline))
            .add(ParameterId::LIFESPAN, &duration(qos.lifespan))
            .add(
                ParameterId::LIVELINESS,
                &[
                    &qos.liveliness.0.to_le_bytes()[..],
                    &duration(qos.liveliness_lease),
                ]
                .concat(),
            );
        if let Some(history) = qos.history {
            let value = [history.kind.0.to_le_bytes(), history.depth.to_le_bytes()].concat();
            parameters = parameters.add(ParameterId::HISTORY, &value);
        }
        if let Some(hash) = type_hash {
            let user_data = format!("typehash={hash};");
            parameters = parameters.add(ParameterId::USER_DATA, &octets(user_data.as_bytes()));
        }
        self.announced += 1;
        let message = Message::new(PREFIX).data(
            (EntityId::UNKNOWN, EntityId::SEDP_PUBLICATIONS_WRITER),
            SequenceNumber(self.announced.into()),
            &[&PL_CDR_LE, &parameters.end()],
        );
        metatraffic(message)
    }

    /// Returns the next sample of `ros_discovery_info`: one node with all writers, with gids of 16
    /// bytes (Iron and later).
    fn nodes(&mut self) -> Datagram {
        let own = Guid::new(PREFIX, EntityId::PARTICIPANT);
        let mut body = own.to_bytes().to_vec();
        body.extend_from_slice(&1_u32.to_le_bytes());
        for name in [&b"/"[..], b"rosbag2_player"] {
            body.extend_from_slice(&text(name));
            body.resize(body.len().next_multiple_of(4), 0);
        }
        let writers = self.writers.values().flatten();
        let mut writers: Vec<_> = writers.map(|writer| writer.entity).collect();
        writers.sort();
        body.extend_from_slice(&0_u32.to_le_bytes());
        let count = u32::try_from(writers.len()).unwrap_or(u32::MAX);
        body.extend_from_slice(&count.to_le_bytes());
        for writer in writers {
            body.extend_from_slice(&Guid::new(PREFIX, writer).to_bytes());
        }
        self.node_samples += 1;
        let ends = (EntityId::UNKNOWN, NODES_WRITER);
        let number = SequenceNumber(self.node_samples);
        user_traffic(Message::new(PREFIX).data(ends, number, &[&CDR_LE, &body]))
    }
}

/// A writer to announce.
struct Endpoint<'a> {
    entity: EntityId,
    topic: &'a str,
    type_name: &'a str,
    qos: Qos,
    type_hash: Option<&'a str>,
}

/// Returns the message at the multicast port of discovery.
fn metatraffic(message: encode::Message) -> Datagram {
    datagram(message, 0)
}

/// Returns the message at the multicast port of topics.
fn user_traffic(message: encode::Message) -> Datagram {
    datagram(message, 1)
}

fn datagram(message: encode::Message, offset: u16) -> Datagram {
    Datagram {
        port: DomainId::PORT_BASE + DomainId::PORT_GAIN * DOMAIN_ID + offset,
        bytes: message.bytes(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str, type_name: &str) -> Topic {
        Topic {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
            ..Topic::default()
        }
    }

    #[test]
    fn topics_beyond_the_cap_or_with_invalid_names_are_not_published() {
        let mut player = Player::default();
        for (name, type_name) in [("scan", "a/msg/B"), ("/a\n", "a/msg/B"), ("/scan", "")] {
            assert!(
                player.add(&topic(name, type_name), None).is_empty(),
                "{name}"
            );
            assert!(player.knows(name));
            assert!(player.sample(name, None, &CDR_LE, Vec::new()).is_none());
        }
        let invalid = 3;
        for number in invalid..MAX_TOPICS {
            let topic = topic(&format!("/{number}"), "a/msg/B");
            assert!(player.writer(&topic, None).is_some());
        }
        assert!(player.writer(&topic("/more", "a/msg/B"), None).is_none());
        assert!(!player.knows("/more"));
    }
}
