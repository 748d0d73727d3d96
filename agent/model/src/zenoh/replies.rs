//! Numbers of replies. A reply has the number of its request, which other clients use too, so that
//! its writer has no numbers of its own.

use std::collections::{HashMap, VecDeque};

use ros2probe_wire::zenoh::Gid;
use ros2probe_wire::{Guid, SequenceNumber};

use crate::size::Size;

/// Most replies whose further copies get the same number.
const MAX_REPLIES: usize = 4096;

type Reply = (Guid, Gid, SequenceNumber);

/// The latest replies.
#[derive(Debug, Default)]
pub(super) struct Replies {
    numbers: HashMap<Reply, SequenceNumber>,
    order: VecDeque<Reply>,
    /// Number of the next reply of each writer.
    next: HashMap<Guid, SequenceNumber>,
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
        if self.order.len() >= MAX_REPLIES
            && let Some(oldest) = self.order.pop_front()
        {
            self.numbers.remove(&oldest);
        }
        if self.next.len() >= MAX_REPLIES && !self.next.contains_key(&writer) {
            self.next.clear();
        }
        let next = self.next.entry(writer).or_insert(SequenceNumber::FIRST);
        let number = *next;
        *next = number.next();
        self.numbers.insert(reply, number);
        self.order.push_back(reply);
        number
    }

    pub(super) fn size(&self) -> Size {
        // The destructuring makes a new table fail to compile until it is listed here.
        let Self {
            numbers,
            order,
            next,
        } = self;
        let longest = numbers.len().max(order.len()).max(next.len());
        Size::new("zenoh.replies", longest, MAX_REPLIES)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_have_one_number_and_the_oldest_of_many_replies_are_forgotten() {
        let mut replies = Replies::default();
        let writer = |number: u8| Guid::from_bytes([number; 16]);
        let call = |number: u64| (Gid([7; 16]), SequenceNumber(number));
        assert_eq!(replies.number(writer(1), call(5)), SequenceNumber(1));
        assert_eq!(replies.number(writer(1), call(9)), SequenceNumber(2));
        assert_eq!(replies.number(writer(2), call(9)), SequenceNumber(1));
        assert_eq!(replies.number(writer(1), call(5)), SequenceNumber(1));
        for number in 0..2 * MAX_REPLIES as u64 {
            replies.number(writer(3), call(number));
        }
        let size = replies.size();
        assert_eq!((size.entries, size.cap), (MAX_REPLIES, MAX_REPLIES));
    }
}
