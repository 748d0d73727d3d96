//! When the causes of late calls are observed without a client: for a minute after a topic violates
//! an expectation, or a chain or callback becomes slow.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ros2probe_capture::inside::late::{BoundScope, LateDemand, RequestedBound};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::{Event, EventKind};
use ros2probe_model::facts::watch::{Watch, WatchState};

/// Time for which causes are observed after an event.
const OBSERVATION_TIME: Duration = Duration::from_secs(60);

/// What watches and events require about late calls.
#[derive(Default)]
pub(super) struct CauseDemand {
    /// Maximum latencies of the watches.
    expected: Vec<RequestedBound>,
    /// Time of the last event that requires causes.
    last: Option<Instant>,
}

impl CauseDemand {
    /// Takes the maximum latencies of watches. The smallest one that applies to a topic counts.
    pub(super) fn take_watches(&mut self, watches: &[Arc<Watch>]) {
        let expected = watches.iter().filter_map(|watch| {
            Some(RequestedBound {
                of: BoundScope::Topics {
                    pattern: Arc::from(watch.pattern.as_str()),
                    domain_id: watch.domain_id,
                },
                above: watch.expectations.max_latency?,
            })
        });
        self.expected = expected.collect();
        self.expected.sort_by_key(|bound| bound.above);
    }

    /// Notes the events that require causes.
    pub(super) fn note(&mut self, events: &[Event], now: Instant) {
        if events.iter().any(|event| requires_causes(&event.kind)) {
            self.last = Some(now);
        }
    }

    /// Adds the demand to that of clients.
    pub(super) fn add_to(&self, demand: &mut LateDemand, now: Instant) {
        demand.bounds.extend_from_slice(&self.expected);
        let is_held = |last| now.saturating_duration_since(last) < OBSERVATION_TIME;
        demand.has_question |= self.last.is_some_and(is_held);
    }
}

fn requires_causes(kind: &EventKind) -> bool {
    match kind {
        EventKind::Expectation { to, .. } => *to == WatchState::Violated,
        EventKind::Diagnosis { resolved, finding } => {
            !resolved
                && matches!(
                    finding,
                    Diagnosis::SlowChain { .. }
                        | Diagnosis::SlowCallback { .. }
                        | Diagnosis::LateCallback { .. }
                )
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::facts::diagnosis::TopicKey;
    use ros2probe_model::facts::topic_kind::TopicKind;
    use ros2probe_wire::DomainId;
    use ros2probe_wire::Timestamp;

    fn event(from: WatchState, to: WatchState) -> Event {
        Event {
            at: Timestamp(0),
            kind: EventKind::Expectation {
                domain_id: DomainId(0),
                topic: "/scan".into(),
                watch: "/scan".into(),
                from: Some(from),
                to,
                violations: vec!["max_latency_ms"],
            },
        }
    }

    #[test]
    fn a_violated_expectation_requires_causes_for_a_minute() {
        let mut causes = CauseDemand::default();
        let now = Instant::now();
        let is_required = |causes: &CauseDemand, after| {
            let mut demand = LateDemand::default();
            causes.add_to(&mut demand, now + Duration::from_secs(after));
            demand.has_question
        };
        assert!(!is_required(&causes, 0));
        causes.note(&[event(WatchState::Violated, WatchState::Ok)], now);
        assert!(!is_required(&causes, 0), "a resolved violation");
        causes.note(&[event(WatchState::Ok, WatchState::Violated)], now);
        assert!(is_required(&causes, 0) && is_required(&causes, 59));
        assert!(!is_required(&causes, 60));
    }

    #[test]
    fn a_slow_chain_requires_causes_until_it_is_resolved_and_other_findings_do_not() {
        let topic = TopicKey {
            domain_id: DomainId(0),
            dds_name: "rt/cmd_vel".into(),
            name: "/cmd_vel".into(),
            kind: TopicKind::Topic,
        };
        let other = Diagnosis::RestampingNode {
            topic: topic.clone(),
            node: "/driver".into(),
            input: "/scan".into(),
        };
        let slow = Diagnosis::SlowChain {
            topic,
            from: "/scan".into(),
            max_latency: Duration::from_millis(20),
        };
        let is_required = |resolved, finding: &Diagnosis| {
            let (mut causes, now) = (CauseDemand::default(), Instant::now());
            let finding = finding.clone();
            let kind = EventKind::Diagnosis { resolved, finding };
            let at = Timestamp(0);
            causes.note(&[Event { at, kind }], now);
            let mut demand = LateDemand::default();
            causes.add_to(&mut demand, now);
            demand.has_question
        };
        assert!(is_required(false, &slow));
        assert!(!is_required(true, &slow) && !is_required(false, &other));
    }
}
