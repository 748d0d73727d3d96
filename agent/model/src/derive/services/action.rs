//! The goals of one action, from the calls of its services `send_goal` and `get_result`.

use std::collections::BTreeMap;

use super::latency::Latencies;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::ActionGoals;

/// `GoalStatus` of action_msgs: final states that a result reports.
const SUCCEEDED: u8 = 4;
const CANCELED: u8 = 5;
const ABORTED: u8 = 6;

/// An action.
#[derive(Debug, Default)]
pub struct Action {
    /// Accepted goals by id (`unique_identifier_msgs/UUID`), with the time of their request.
    goals: Bounded<ActionGoals, BTreeMap<[u8; 16], ModelTime>>,
    /// Number of goals in each state.
    pub counts: GoalCounts,
    /// Times from the request of a goal to its result.
    pub durations: Latencies,
    /// Number of goals dropped because of the cap.
    pub evictions: u64,
}

/// Number of goals by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GoalCounts {
    /// The server accepted the goal.
    pub accepted: u64,
    /// The server rejected the goal.
    pub rejected: u64,
    /// The result was sent to a client, and the goal had succeeded.
    pub succeeded: u64,
    /// The result was sent to a client, and the goal had been cancelled.
    pub canceled: u64,
    /// The result was sent to a client, and the server had aborted the goal.
    pub aborted: u64,
}

impl Action {
    /// Records the reply to a goal request that was sent at `sent`.
    pub fn replied(&mut self, goal: [u8; 16], sent: ModelTime, accepted: bool) {
        if !accepted {
            self.counts.rejected += 1;
            return;
        }
        self.counts.accepted += 1;
        let oldest = self.goals.make_room(&goal, |sent| *sent);
        self.evictions += u64::from(oldest.is_some());
        self.goals.insert(goal, sent);
    }

    /// Records a result that reached a client at `at`. Only the first one of a goal counts.
    pub fn result(&mut self, goal: [u8; 16], status: u8, at: ModelTime) {
        let count = match status {
            SUCCEEDED => &mut self.counts.succeeded,
            CANCELED => &mut self.counts.canceled,
            ABORTED => &mut self.counts.aborted,
            // The server does not know the goal.
            _ => return,
        };
        if let Some(sent) = self.goals.remove(&goal) {
            *count += 1;
            self.durations.observe(at - sent);
        }
    }

    /// Returns the number of goals that wait for their result.
    #[must_use]
    pub fn open(&self) -> usize {
        self.goals.len()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_first_result_of_an_accepted_goal_counts() {
        let mut action = Action::default();
        let at = |seconds| ModelTime::ZERO + Duration::from_secs(seconds);
        action.replied([1; 16], at(1), true);
        action.replied([2; 16], at(2), false);
        action.result([2; 16], ABORTED, at(3));
        action.result([1; 16], 0, at(3));
        assert_eq!(action.open(), 1);
        action.result([1; 16], SUCCEEDED, at(4));
        action.result([1; 16], SUCCEEDED, at(5));
        let expected = GoalCounts {
            accepted: 1,
            rejected: 1,
            succeeded: 1,
            ..GoalCounts::default()
        };
        assert_eq!(action.counts, expected);
        assert_eq!(action.durations.facts().p50, Some(3.0));
    }

    #[test]
    fn the_oldest_goal_is_dropped_at_the_cap() {
        let mut action = Action::default();
        for number in 0..=u8::try_from(ActionGoals::CAP).unwrap() {
            action.replied(
                [number; 16],
                ModelTime::from_nanoseconds(number.into()),
                true,
            );
        }
        assert_eq!((action.open(), action.evictions), (ActionGoals::CAP, 1));
        action.result([0; 16], SUCCEEDED, ModelTime::from_nanoseconds(1000));
        assert_eq!(action.counts.succeeded, 0);
    }
}
