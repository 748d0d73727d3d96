//! Responses of `~/get_type_description`, whole. Types without an installed package are decoded by
//! them. The model does not read them.

use std::collections::VecDeque;
use std::sync::Arc;

use ros2probe_wire::rtps::{RequestHeader, VendorId};
use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::tables::WaitingDescriptions;

/// Maximum size of a response, in bytes.
const MAX_RESPONSE: usize = 256 << 10;
/// Bytes of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION: usize = 4;

/// Responses that wait to be taken.
#[derive(Debug, Default)]
pub struct TypeDescriptions {
    waiting: Bounded<WaitingDescriptions, VecDeque<Arc<[u8]>>>,
    /// The last response, of which further copies follow.
    latest: Option<(Guid, SequenceNumber)>,
}

impl TypeDescriptions {
    /// Returns whether this response was the last one that was added.
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
            _ => ENCAPSULATION,
        };
        let parts = (payload.get(..ENCAPSULATION), payload.get(body..));
        if let (Some(encapsulation), Some(body)) = parts
            && payload.len() <= MAX_RESPONSE
        {
            self.waiting
                .push_back([encapsulation, body].concat().into());
        }
    }

    /// Returns whether so many responses wait that they should be taken.
    #[must_use]
    pub fn are_many(&self) -> bool {
        self.waiting.len() * 2 >= WaitingDescriptions::CAP
    }

    /// Removes and returns the responses.
    pub fn take(&mut self) -> Vec<Arc<[u8]>> {
        self.waiting.take().into()
    }
}
