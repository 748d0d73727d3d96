//! `ros_discovery_info`: which nodes a participant holds and which endpoints are theirs.
//!
//! `rmw_dds_common/msg/ParticipantEntitiesInfo` as CDR. A sample is the participant's whole state
//! and replaces the one before. Iron and later write 16-byte gids, Humble 24-byte ones, under the
//! same topic and type name, and both may be in one domain: the layout is told from the bytes.

use alloc::string::String;
use alloc::vec::Vec;

use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::guid::{EntityId, Guid};
use crate::text;

/// Most nodes kept of one participant.
pub const MAX_NODES: usize = 1024;
/// Longest node name or namespace (ROS allows 255 characters for both together).
const MAX_NAME_LEN: usize = 256;

/// One participant's nodes.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ParticipantEntities {
    /// Whose nodes; taken from the payload.
    pub participant: Guid,
    /// Its nodes, in the order they were created.
    pub nodes: Vec<NodeEntities>,
}

/// One node's endpoints.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct NodeEntities {
    /// Namespace, such as `/` or `/robot1`.
    pub namespace: String,
    /// Name without its namespace.
    pub name: String,
    /// Its readers.
    pub readers: Vec<Guid>,
    /// Its writers.
    pub writers: Vec<Guid>,
}

impl NodeEntities {
    /// Namespace and name with exactly one slash between them.
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
    /// From a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// [`Reason::BadMarker`] when it is not plain CDR; the error of the likelier layout when it
    /// reads in neither.
    pub fn parse(payload: &[u8]) -> Result<Self, WireError> {
        let mut cursor = Cursor::new(payload, Endianness::Big);
        let error = cursor.error("encapsulation", Reason::BadMarker);
        let endianness = match cursor.u16("encapsulation")? {
            // CDR and plain CDR2 differ in the alignment of 64-bit values, of which there are none.
            0x0000 | 0x0006 => Endianness::Big,
            0x0001 | 0x0007 => Endianness::Little,
            _ => return Err(error),
        };
        cursor.u16("encapsulation options")?;
        let cursor = cursor.with_endianness(endianness);
        // The longer gid's last eight bytes are zero. In the shorter layout this is where the
        // number of nodes and the first namespace's length stand; both are zero only when nothing
        // follows.
        let padded = cursor
            .rest()
            .get(16..24)
            .is_some_and(|bytes| bytes == [0; 8]);
        let (likely, other) = if padded { (24, 16) } else { (16, 24) };
        entities(cursor, likely).or_else(|error| entities(cursor, other).map_err(|_| error))
    }
}

/// The whole payload with gids of `gid_len` bytes.
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
    // The bytes are shown to be there before anything is allocated for them.
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
