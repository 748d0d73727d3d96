//! Responses of `~/get_type_description`, and replies of the TypeLookup service of XTypes, whole.
//! Types without an installed package are decoded by them. The model does not read them.

use std::collections::VecDeque;
use std::sync::Arc;

use ros2probe_wire::rtps::{RequestHeader, VendorId};
use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::tables::WaitingDescriptions;

/// Maximum size of a response or reply, in bytes.
const MAX_RESPONSE: usize = 256 << 10;
/// Bytes of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION_BYTES: usize = 4;

/// What a node sent about its types.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TypeSource {
    /// A response of `get_type_description`, with its encapsulation header.
    Description(Arc<[u8]>),
    /// A reply of the TypeLookup service (DDS-XTypes 1.3, 7.6.3.3), with its encapsulation header.
    TypeObjects(Arc<[u8]>),
}

/// Responses and replies that wait to be taken.
#[derive(Debug, Default)]
pub struct TypeDescriptions {
    waiting: Bounded<WaitingDescriptions, VecDeque<TypeSource>>,
    /// The last one, of which further copies follow.
    latest: Option<(Guid, SequenceNumber)>,
}

impl TypeDescriptions {
    /// Returns whether this response or reply was the last one that was added.
    #[must_use]
    pub fn has(&self, writer: Guid, number: SequenceNumber) -> bool {
        self.latest == Some((writer, number))
    }

    /// Adds the payload of a response as its middleware sends it; `vendor` is `None` with Zenoh.
    pub fn add(
        &mut self,
        writer: Guid,
        number: SequenceNumber,
        vendor: Option<VendorId>,
        payload: &[u8],
    ) {
        self.latest = Some((writer, number));
        // rmw_cyclonedds writes the identity of the request before the response.
        let body = match vendor {
            Some(VendorId::CYCLONE) => RequestHeader::END,
            _ => ENCAPSULATION_BYTES,
        };
        let parts = (payload.get(..ENCAPSULATION_BYTES), payload.get(body..));
        if let (Some(encapsulation), Some(body)) = parts
            && payload.len() <= MAX_RESPONSE
        {
            let response = [encapsulation, body].concat().into();
            self.waiting.push_back(TypeSource::Description(response));
        }
    }

    /// Adds the payload of a reply of the TypeLookup service.
    pub fn add_objects(&mut self, writer: Guid, number: SequenceNumber, payload: &[u8]) {
        self.latest = Some((writer, number));
        if payload.len() <= MAX_RESPONSE {
            self.waiting
                .push_back(TypeSource::TypeObjects(payload.into()));
        }
    }

    /// Returns whether so many responses wait that they should be taken.
    #[must_use]
    pub fn are_many(&self) -> bool {
        self.waiting.len() * 2 >= WaitingDescriptions::CAP
    }

    /// Removes and returns the responses and replies.
    pub fn take(&mut self) -> Vec<TypeSource> {
        self.waiting.take().into()
    }
}
