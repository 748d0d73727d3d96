//! Derives events from the agent's facts about itself: losses, and the loss and return of
//! visibility. Each change is reported once.

use std::time::{Duration, Instant};

use super::AgentEvent;
use crate::agent_facts::AgentFacts;
use crate::snapshot_cell::Unready;

/// Minimum time between two reports of losses.
const MIN_REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// Detects losses of packets and records before they reach the model.
#[derive(Debug, Default)]
pub struct DropMonitor {
    reported: Losses,
    at: Option<Instant>,
}

type Losses = [(&'static str, u64); 4];

/// Detects when the agent stops observing, and when it observes again.
#[derive(Debug, Default)]
pub struct SourceMonitor {
    blind_since: Option<Instant>,
    /// Time of the last successful check. Before the first one, the agent is starting, not blind.
    saw: Option<Instant>,
    reattachments: u64,
}

impl DropMonitor {
    /// Returns events about losses since the last report.
    pub fn check(&mut self, facts: &AgentFacts, now: Instant) -> Vec<AgentEvent> {
        let early = |at: Instant| now.saturating_duration_since(at) < MIN_REPORT_INTERVAL;
        if self.at.is_some_and(early) {
            return Vec::new();
        }
        let lost = losses(facts);
        let before = self.reported.iter().map(|(_, count)| *count);
        let new = lost
            .iter()
            .zip(before)
            .filter_map(|((what, count), before)| {
                let count = count.saturating_sub(before);
                (count > 0).then_some(AgentEvent::Dropped { what, count })
            });
        let new: Vec<_> = new.collect();
        if !new.is_empty() {
            (self.reported, self.at) = (lost, Some(now));
        }
        new
    }
}

fn losses(facts: &AgentFacts) -> Losses {
    let interfaces = facts.interfaces.iter();
    let packets = interfaces.filter_map(|interface| interface.dropped).sum();
    [
        ("packets", packets),
        ("records", facts.records_dropped),
        ("datagrams", facts.pieces_dropped),
        ("contended", facts.contended),
    ]
}

impl SourceMonitor {
    /// Returns events about changes of visibility at `now`. `ready` has the reason of a failure,
    /// and `reattachments` the number of times the hook was attached again. If a control group was
    /// recreated between two checks, both events are returned, with the time between the checks.
    pub fn check(
        &mut self,
        ready: &Result<(), Unready>,
        attached_anew: u64,
        now: Instant,
    ) -> Vec<AgentEvent> {
        let is_anew = attached_anew > std::mem::replace(&mut self.reattachments, attached_anew);
        let mut events = Vec::new();
        match ready {
            Ok(()) => {
                let saw = self.saw.replace(now).filter(|_| is_anew);
                if self.blind_since.is_none() && saw.is_some() {
                    let reason = "the cgroup was removed and recreated".to_owned();
                    events.push(AgentEvent::Blind { reason });
                }
                if let Some(since) = self.blind_since.take().or(saw) {
                    let blind_seconds = now.saturating_duration_since(since).as_secs_f64();
                    events.push(AgentEvent::Seeing { blind_seconds });
                }
            }
            Err(reason) if self.saw.is_some() && self.blind_since.is_none() => {
                self.blind_since = Some(now);
                let reason = reason.to_string();
                events.push(AgentEvent::Blind { reason });
            }
            Err(_) => {}
        }
        events
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent_facts::{InterfaceFacts, SourceKind};

    #[test]
    fn losses_are_reported_as_differences_at_most_once_a_second() {
        let start = Instant::now();
        let interface = |dropped| InterfaceFacts {
            name: "any".to_owned(),
            packets: None,
            dropped: Some(dropped),
        };
        let facts = |dropped, records| AgentFacts {
            interfaces: vec![interface(dropped), interface(1)],
            records_dropped: records,
            ..AgentFacts::new(SourceKind::Wire, start)
        };
        let drop = |what, count| AgentEvent::Dropped { what, count };
        let mut drops = DropMonitor::default();
        let second = |number| start + Duration::from_secs(number);
        let nothing = AgentFacts::new(SourceKind::Wire, start);
        assert_eq!(drops.check(&nothing, start), []);
        let new = drops.check(&facts(4, 2), start);
        assert_eq!(new, [drop("packets", 5), drop("records", 2)]);
        assert_eq!(drops.check(&facts(5, 2), start), []);
        assert_eq!(drops.check(&facts(9, 2), second(1)), [drop("packets", 5)]);
        assert_eq!(drops.check(&facts(9, 2), second(3)), []);
    }

    #[test]
    fn a_loss_of_visibility_is_reported_once_and_not_during_the_start() {
        let start = Instant::now();
        let mut sight = SourceMonitor::default();
        let blind = Err(Unready::Unseen("stuck".to_owned()));
        assert_eq!(sight.check(&blind, 0, start), []);
        assert_eq!(sight.check(&Ok(()), 0, start), []);
        let reason = "stuck".to_owned();
        assert_eq!(
            sight.check(&blind, 0, start),
            [AgentEvent::Blind { reason }]
        );
        assert_eq!(sight.check(&blind, 0, start), []);
        let later = start + Duration::from_secs(3);
        let seeing = AgentEvent::Seeing { blind_seconds: 3.0 };
        assert_eq!(sight.check(&Ok(()), 0, later), [seeing]);
        assert_eq!(sight.check(&Ok(()), 0, later), []);
    }

    #[test]
    fn a_cgroup_recreated_between_two_checks_is_reported_once() {
        let start = Instant::now();
        let second = |number| start + Duration::from_secs(number);
        let mut sight = SourceMonitor::default();
        assert_eq!(sight.check(&Ok(()), 0, start), []);
        let events = sight.check(&Ok(()), 1, second(2));
        let reason = "the cgroup was removed and recreated".to_owned();
        let seeing = |blind_seconds| AgentEvent::Seeing { blind_seconds };
        assert_eq!(events, [AgentEvent::Blind { reason }, seeing(2.0)]);
        assert_eq!(sight.check(&Ok(()), 1, second(4)), []);

        // A check while the cgroup was missing has reported the removal.
        let gone = "the cgroup /robot was removed".to_owned();
        let gone = Err(Unready::Unseen(gone));
        assert_eq!(sight.check(&gone, 1, second(6)).len(), 1);
        assert_eq!(sight.check(&Ok(()), 2, second(9)), [seeing(3.0)]);
        assert_eq!(sight.check(&Ok(()), 2, second(10)), []);
    }
}
