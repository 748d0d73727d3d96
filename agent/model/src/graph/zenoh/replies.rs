//! Sequence numbers of replies. A reply carries only the number of its request, which other clients
//! use too. Therefore this module numbers the replies of each writer.

use std::collections::VecDeque;

use crate::facts::bounded::Bounded;
use crate::facts::tables::{ZenohReplies, ZenohReplyWriters};
use foldhash::HashMap;
use ros2probe_wire::zenoh::Gid;
use ros2probe_wire::{Guid, SequenceNumber};

type Reply = (Guid, Gid, SequenceNumber);

/// The latest replies.
#[derive(Debug, Default)]
pub(super) struct Replies {
    numbers: Bounded<ZenohReplies, HashMap<Reply, SequenceNumber>>,
    order: Bounded<ZenohReplies, VecDeque<Reply>>,
    /// Number of the next reply of each writer.
    next: Bounded<ZenohReplyWriters, HashMap<Guid, SequenceNumber>>,
}

impl Replies {
    /// Returns the number of a writer's reply to a call, the same one for each copy.
    pub(super) fn number(
        &mut self,
        writer: Guid,
        (client, request): (Gid, SequenceNumber),
    ) -> SequenceNumber {
        let reply = (writer, client, request);
        if let Some(number) = self.numbers.get(&reply) {
            return *number;
        }
        if self.next.is_full() && !self.next.contains_key(&writer) {
            self.next.refuse();
            self.next.clear();
        }
        let first = || SequenceNumber::FIRST;
        let Some(next) = self.next.get_or_insert_with(writer, first) else {
            return first();
        };
        let number = *next;
        *next = number.next();
        if let Some(oldest) = self.order.push_back(reply) {
            self.numbers.remove(&oldest);
        }
        self.numbers.insert(reply, number);
        number
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_of_a_reply_share_a_number_and_the_oldest_replies_are_dropped() {
        let mut replies = Replies::default();
        let writer = |number: u8| Guid::from_bytes([number; 16]);
        let call = |number: u64| (Gid([7; 16]), SequenceNumber(number));
        assert_eq!(replies.number(writer(1), call(5)), SequenceNumber(1));
        assert_eq!(replies.number(writer(1), call(9)), SequenceNumber(2));
        assert_eq!(replies.number(writer(2), call(9)), SequenceNumber(1));
        assert_eq!(replies.number(writer(1), call(5)), SequenceNumber(1));
        for number in 0..2 * ZenohReplies::CAP as u64 {
            replies.number(writer(3), call(number));
        }
        assert!(replies.order.is_full() && replies.numbers.is_full());
    }
}
