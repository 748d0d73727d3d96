//! `ros_discovery_info`: the nodes of a participant and their endpoints.
//!
//! The payload is `rmw_dds_common/msg/ParticipantEntitiesInfo` in CDR. A sample is the
//! participant's whole state and replaces the previous one. Iron and later write 16-byte gids,
//! Humble 24-byte ones, under the same topic and type name. One domain may have both layouts, so
//! the bytes decide which one applies.

use alloc::string::String;
use alloc::vec::Vec;

use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::{EntityId, Guid};
use crate::text;

/// Maximum number of nodes per participant.
pub const MAX_NODES: usize = 1024;
/// Maximum length of a node name or namespace, in bytes (ROS allows 255 characters for both
/// together).
const MAX_NAME_LEN: usize = 256;

/// One participant's nodes.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ParticipantEntities {
    /// GUID of the participant, taken from the payload.
    pub participant: Guid,
    /// Its nodes, in the order they were created.
    pub nodes: Vec<NodeEntities>,
}

/// One node and its endpoints.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct NodeEntities {
    /// Namespace, such as `/` or `/robot1`.
    pub namespace: String,
    /// Name without its namespace.
    pub name: String,
    /// GUIDs of its readers.
    pub readers: Vec<Guid>,
    /// GUIDs of its writers.
    pub writers: Vec<Guid>,
}

impl NodeEntities {
    /// Returns namespace and name, joined by exactly one slash.
    #[must_use]
    pub fn fully_qualified_name(&self) -> String {
        let slash = if self.namespace.ends_with('/') {
            ""
        } else {
            "/"
        };
        alloc::format!("{}{slash}{}", self.namespace, self.name)
    }
}

impl ParticipantEntities {
    /// Parses a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not plain CDR, and the error of the likelier
    /// layout if neither layout fits.
    pub fn parse(payload: &[u8]) -> Result<Self, WireError> {
        let cursor = text::plain_cdr(payload)?;
        // The last eight bytes of a long gid are zero. In the layout with short gids, these bytes
        // are the number of nodes and the first namespace's length, which are zero only if nothing
        // follows.
        let padded = cursor
            .rest()
            .get(16..24)
            .is_some_and(|bytes| bytes == [0; 8]);
        let (likely, other) = if padded { (24, 16) } else { (16, 24) };
        entities(cursor, likely).or_else(|error| entities(cursor, other).map_err(|_| error))
    }
}

/// Parses the whole payload with gids of `gid_len` bytes.
fn entities(mut cursor: Cursor<'_>, gid_len: usize) -> Result<ParticipantEntities, WireError> {
    let error = cursor.error("participant gid", Reason::BadValue);
    let participant = gid(&mut cursor, gid_len)?;
    if participant.entity != EntityId::PARTICIPANT {
        return Err(error);
    }
    cursor.align(4);
    let count = cursor.u32("node count")?;
    let mut nodes = Vec::new();
    for _ in 0..count {
        if nodes.len() == MAX_NODES {
            return Err(cursor.error("node count", Reason::OverLimit));
        }
        nodes.push(NodeEntities {
            namespace: text::name(&mut cursor, "node namespace", MAX_NAME_LEN)?.into(),
            name: text::name(&mut cursor, "node name", MAX_NAME_LEN)?.into(),
            readers: gids(&mut cursor, gid_len)?,
            writers: gids(&mut cursor, gid_len)?,
        });
    }
    // Submessages are padded to four bytes, and the padding is part of the payload.
    if cursor.remaining() >= 4 {
        return Err(cursor.error("end of ros_discovery_info", Reason::BadLength));
    }
    Ok(ParticipantEntities { participant, nodes })
}

fn gids(cursor: &mut Cursor<'_>, gid_len: usize) -> Result<Vec<Guid>, WireError> {
    cursor.align(4);
    let error = cursor.error("gid count", Reason::BadLength);
    let count = usize::try_from(cursor.u32("gid count")?).map_err(|_| error)?;
    // The bytes must exist before memory is allocated for them.
    let length = count.checked_mul(gid_len).ok_or(error)?;
    let mut bytes = cursor.sub("gids", length)?;
    let mut gids = Vec::with_capacity(count);
    for _ in 0..count {
        gids.push(gid(&mut bytes, gid_len)?);
    }
    Ok(gids)
}

fn gid(cursor: &mut Cursor<'_>, gid_len: usize) -> Result<Guid, WireError> {
    let guid = Guid::from_bytes(cursor.array("gid")?);
    let error = cursor.error("gid padding", Reason::BadValue);
    let padding = cursor.take("gid padding", gid_len - 16)?;
    if padding.iter().any(|byte| *byte != 0) {
        Err(error)
    } else {
        Ok(guid)
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use proptest::prelude::*;

    use super::*;
    use crate::cursor::Endianness;
    use crate::guid::GuidPrefix;
    use crate::testing::{self, Encoder, hurt};

    fn captured(datagram: &[u8]) -> ParticipantEntities {
        ParticipantEntities::parse(testing::data(datagram)[0].2.payload.bytes()).unwrap()
    }

    fn encoded(entities: &ParticipantEntities, gid_len: usize, endianness: Endianness) -> Vec<u8> {
        let gid = |encoder: &mut Encoder, guid: Guid| {
            encoder.raw(&guid.to_bytes()).raw(&[0; 8][..gid_len - 16]);
        };
        let mut encoder = Encoder::new(endianness);
        encoder.raw(&[0, u8::from(endianness == Endianness::Little), 0, 0]);
        gid(&mut encoder, entities.participant);
        encoder.u32(u32::try_from(entities.nodes.len()).unwrap());
        for node in &entities.nodes {
            encoder.string(&node.namespace).string(&node.name);
            for guids in [&node.readers, &node.writers] {
                encoder.u32(u32::try_from(guids.len()).unwrap());
                guids.iter().for_each(|guid| gid(&mut encoder, *guid));
            }
        }
        encoder.bytes
    }

    #[test]
    fn nodes_with_the_long_gids_of_humble_are_parsed() {
        let entities = captured(testing::FAST_ENTITIES);
        assert_eq!(
            entities.participant.to_string(),
            "010f2b7d6a474f3300000000.000001c1"
        );
        let [node] = &entities.nodes[..] else {
            panic!("{entities:?}")
        };
        assert_eq!(node.fully_qualified_name(), "/robot2/listener_node");
        assert!(node.readers.is_empty());
        let [writer] = &node.writers[..] else {
            panic!("{node:?}")
        };
        assert_eq!(writer.entity, EntityId([0, 0, 3, 3]));
        let node = &captured(testing::CYCLONE_ENTITIES).nodes[0];
        assert_eq!((node.readers.len(), node.writers.len()), (7, 8));
    }

    #[test]
    fn nodes_with_the_short_gids_of_jazzy_are_parsed() {
        let entities = captured(testing::JAZZY_ENTITIES);
        assert_eq!(
            entities.participant.to_string(),
            "0110e8d0b98da210b7994456.000001c1"
        );
        let [node] = &entities.nodes[..] else {
            panic!("{entities:?}")
        };
        assert_eq!(
            (node.namespace.as_str(), node.name.as_str()),
            ("/robot2", "listener_node")
        );
        assert_eq!(node.writers[0].entity, EntityId([0, 0, 6, 3]));
        let node = &captured(testing::RUSTDDS_ENTITIES).nodes[0];
        assert_eq!(node.fully_qualified_name(), "/ns/pubber");
        assert_eq!(node.writers.len(), 2);
    }

    #[test]
    fn a_participant_without_nodes_is_parsed_in_both_layouts() {
        let participant = Guid::new(GuidPrefix([1; 12]), EntityId::PARTICIPANT);
        let entities = ParticipantEntities {
            participant,
            nodes: Vec::new(),
        };
        for gid_len in [16, 24] {
            let payload = encoded(&entities, gid_len, Endianness::Little);
            assert_eq!(ParticipantEntities::parse(&payload), Ok(entities.clone()));
        }
    }

    #[test]
    fn namespace_and_name_are_joined_by_exactly_one_slash() {
        let node = |namespace: &str| NodeEntities {
            namespace: namespace.into(),
            name: "talker".into(),
            readers: Vec::new(),
            writers: Vec::new(),
        };
        assert_eq!(node("/").fully_qualified_name(), "/talker");
        assert_eq!(node("/a/b").fully_qualified_name(), "/a/b/talker");
        assert_eq!(node("").fully_qualified_name(), "/talker");
    }

    #[test]
    fn counts_beyond_the_payload_or_the_limit_are_refused() {
        let payload = testing::data(testing::JAZZY_ENTITIES)[0].2.payload.bytes();
        // The number of nodes, of readers, of writers.
        for offset in [20, 56, 60] {
            let mut hostile = payload.to_vec();
            hostile[offset..offset + 4].copy_from_slice(&[0xff; 4]);
            let error = ParticipantEntities::parse(&hostile).unwrap_err();
            assert!(
                matches!(error.reason, Reason::Truncated | Reason::BadLength),
                "{error}"
            );
        }
        let participant = Guid::new(GuidPrefix([1; 12]), EntityId::PARTICIPANT);
        let node = NodeEntities {
            namespace: "/".into(),
            name: "n".into(),
            readers: Vec::new(),
            writers: Vec::new(),
        };
        let many = ParticipantEntities {
            participant,
            nodes: std::vec![node; MAX_NODES + 1],
        };
        let payload = encoded(&many, 16, Endianness::Little);
        assert_eq!(
            ParticipantEntities::parse(&payload).unwrap_err().reason,
            Reason::OverLimit
        );
    }

    #[test]
    fn hostile_node_names_are_refused() {
        let participant = Guid::new(GuidPrefix([1; 12]), EntityId::PARTICIPANT);
        let reason = |namespace: &str, name: &str| {
            let (namespace, name) = (namespace.into(), name.into());
            let node = NodeEntities {
                namespace,
                name,
                readers: Vec::new(),
                writers: Vec::new(),
            };
            let entities = ParticipantEntities {
                participant,
                nodes: [node].into(),
            };
            let payload = encoded(&entities, 24, Endianness::Little);
            ParticipantEntities::parse(&payload).unwrap_err().reason
        };
        assert_eq!(reason("/", "a\"b"), Reason::BadText);
        assert_eq!(reason("/\n", "a"), Reason::BadText);
        assert_eq!(reason("/", &"a".repeat(10_000)), Reason::OverLimit);
    }

    #[test]
    fn other_encapsulations_and_gids_of_other_entities_are_refused() {
        let mut payload = testing::data(testing::JAZZY_ENTITIES)[0]
            .2
            .payload
            .bytes()
            .to_vec();
        payload[1] = 3;
        assert_eq!(
            ParticipantEntities::parse(&payload).unwrap_err().reason,
            Reason::BadMarker
        );
        payload[1] = 1;
        payload[19] = 3;
        assert_eq!(
            ParticipantEntities::parse(&payload).unwrap_err().reason,
            Reason::BadValue
        );
    }

    #[test]
    fn damaged_payloads_never_make_the_parser_panic() {
        for datagram in [
            testing::FAST_ENTITIES,
            testing::JAZZY_ENTITIES,
            testing::CYCLONE_ENTITIES,
        ] {
            hurt(testing::data(datagram)[0].2.payload.bytes(), |bytes| {
                let _ = ParticipantEntities::parse(bytes);
            });
        }
    }

    fn guids() -> impl Strategy<Value = Vec<Guid>> {
        // Entity ids of the first endpoints are small numbers that look like counts.
        let guid = (any::<[u8; 12]>(), 0..40_u8).prop_map(|(prefix, entity)| {
            Guid::new(GuidPrefix(prefix), EntityId([0, 0, entity, 3]))
        });
        prop::collection::vec(guid, 0..5)
    }

    fn node() -> impl Strategy<Value = NodeEntities> {
        ("/[a-z/]{0,12}", "[a-z_]{1,12}", guids(), guids()).prop_map(
            |(namespace, name, readers, writers)| NodeEntities {
                namespace,
                name,
                readers,
                writers,
            },
        )
    }

    proptest! {
        #[test]
        fn both_layouts_survive_a_round_trip_and_are_distinguished(
            prefix in any::<[u8; 12]>(),
            nodes in prop::collection::vec(node(), 0..5),
            long in any::<bool>(),
            little in any::<bool>(),
        ) {
            let participant = Guid::new(GuidPrefix(prefix), EntityId::PARTICIPANT);
            let entities = ParticipantEntities { participant, nodes };
            let endianness = if little { Endianness::Little } else { Endianness::Big };
            let payload = encoded(&entities, if long { 24 } else { 16 }, endianness);
            prop_assert_eq!(ParticipantEntities::parse(&payload), Ok(entities));
        }
    }
}
