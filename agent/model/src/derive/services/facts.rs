//! Calls of services, and goals of actions.

use ros2probe_wire::DomainId;

use super::action::GoalCounts;
use super::latency::LatencyFacts;
use crate::facts::names::TopicName;

/// The calls of one service.
#[derive(Clone, Debug, PartialEq)]
pub struct ServiceFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub name: TopicName,
    /// Requests, each counted once regardless of copies and servers.
    pub requests: u64,
    /// Requests with a reply that reached the client, as far as that is visible.
    pub answered: u64,
    /// Requests without a reply within the timeout; some of them may have been answered later.
    pub unanswered: u64,
    /// Requests without a reply at present.
    pub open: usize,
    /// Requests without a reply for longer than the timeout, at present.
    pub hanging: usize,
    /// Times from request to reply.
    pub latency: LatencyFacts,
    /// Whether its messages exceed the budget, so that its calls are not measured at present.
    pub suspended: bool,
    /// Whether requests in shared memory were read in their senders' memory, so none was missed.
    pub exact: bool,
}

/// The goals of one action.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub name: TopicName,
    /// Goals by outcome.
    pub goals: GoalCounts,
    /// Accepted goals whose result was not seen so far.
    pub open: usize,
    /// Times from the request of a goal to its result.
    pub duration: LatencyFacts,
}
