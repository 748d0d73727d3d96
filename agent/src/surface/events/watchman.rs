//! Looks at what the agent knows of itself and says when that becomes an event: it lost something,
//! it does not see any more, it sees again. Each says a thing once.

use std::time::{Duration, Instant};

use super::AgentEvent;
use crate::surface::AgentFacts;

/// Losses are told at most this often.
const PAUSE: Duration = Duration::from_secs(1);

/// What was lost on the way to the model.
#[derive(Debug, Default)]
pub struct Drops {
    told: Losses,
    at: Option<Instant>,
}

type Losses = [(&'static str, u64); 4];

/// Whether the agent sees.
#[derive(Debug, Default)]
pub struct Sight {
    /// It saw before: an agent that is starting is not blind.
    has_seen: bool,
    blind_since: Option<Instant>,
}

impl Drops {
    /// What was lost since it was last told.
    pub fn look(&mut self, facts: &AgentFacts, now: Instant) -> Vec<AgentEvent> {
        let early = |at: Instant| now.saturating_duration_since(at) < PAUSE;
        if self.at.is_some_and(early) {
            return Vec::new();
        }
        let lost = losses(facts);
        let before = self.told.iter().map(|(_, count)| *count);
        let new = lost
            .iter()
            .zip(before)
            .filter_map(|((what, count), before)| {
                let count = count.saturating_sub(before);
                (count > 0).then_some(AgentEvent::Dropped { what, count })
            });
        let new: Vec<_> = new.collect();
        if !new.is_empty() {
            (self.told, self.at) = (lost, Some(now));
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

impl Sight {
    /// Whether it sees at `now`, or why not; the event if that is news.
    pub fn look(&mut self, ready: &Result<(), String>, now: Instant) -> Option<AgentEvent> {
        match ready {
            Ok(()) => {
                self.has_seen = true;
                let since = self.blind_since.take()?;
                let blind_seconds = now.saturating_duration_since(since).as_secs_f64();
                Some(AgentEvent::Seeing { blind_seconds })
            }
            Err(reason) if self.has_seen && self.blind_since.is_none() => {
                self.blind_since = Some(now);
                let reason = reason.clone();
                Some(AgentEvent::Blind { reason })
            }
            Err(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{InterfaceFacts, SourceKind};

    #[test]
    fn losses_are_told_as_what_came_since_and_at_most_once_a_second() {
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
        let mut drops = Drops::default();
        let second = |number| start + Duration::from_secs(number);
        let nothing = AgentFacts::new(SourceKind::Wire, start);
        assert_eq!(drops.look(&nothing, start), []);
        let new = drops.look(&facts(4, 2), start);
        assert_eq!(new, [drop("packets", 5), drop("records", 2)]);
        assert_eq!(drops.look(&facts(5, 2), start), []);
        assert_eq!(drops.look(&facts(9, 2), second(1)), [drop("packets", 5)]);
        assert_eq!(drops.look(&facts(9, 2), second(3)), []);
    }

    #[test]
    fn blindness_is_told_once_and_not_of_an_agent_that_starts() {
        let start = Instant::now();
        let mut sight = Sight::default();
        let blind = Err("stuck".to_owned());
        assert_eq!(sight.look(&blind, start), None);
        assert_eq!(sight.look(&Ok(()), start), None);
        let reason = "stuck".to_owned();
        assert_eq!(
            sight.look(&blind, start),
            Some(AgentEvent::Blind { reason })
        );
        assert_eq!(sight.look(&blind, start), None);
        let later = start + Duration::from_secs(3);
        let seeing = AgentEvent::Seeing { blind_seconds: 3.0 };
        assert_eq!(sight.look(&Ok(()), later), Some(seeing));
        assert_eq!(sight.look(&Ok(()), later), None);
    }
}
