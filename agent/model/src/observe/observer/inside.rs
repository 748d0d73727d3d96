//! Figures from inside processes: their topics, and whether they or the network determine the
//! counts.

use ros2probe_wire::lifecycle::LifecycleState;

use super::Observer;
use super::arrivals::repairs;
use crate::derive::inside::source::Seen;
use crate::derive::robot::lifecycle::ManagedNode;
use crate::facts::calls::report::Report;
use crate::facts::event::EventKind;
use crate::facts::model_time::ModelTime;
use crate::facts::topic_kind::TopicKind;
use crate::measure::topic::{TopicId, Watched};

impl Observer {
    /// Processes a report about calls inside processes.
    pub(super) fn report_inside(&mut self, report: Report) {
        let clock = self.graph.wall_clock;
        let at = clock.model_time(report.at);
        let (graph, profiler) = (&self.graph, &self.measure.profiler);
        let log = &self.journal.repairs;
        let (discovery, receivers) = (&graph.discovery, &graph.receivers);
        let inside = &mut self.derive.inside;
        let transitions = inside.report(
            report,
            clock,
            discovery,
            receivers,
            &|participants, topic, awaited| {
                repairs((graph, profiler, log), participants, topic, awaited)
            },
        );
        for state in transitions {
            let events = &mut self.journal.events;
            events.push(
                state.at,
                EventKind::Lifecycle {
                    domain_id: state.domain_id,
                    node: state.node,
                    process: Some(state.process),
                    from: state.before,
                    to: state.state,
                },
            );
        }
        self.compare_queues(at);
    }

    /// Records a transition that a managed node published, unless calls inside its process show it.
    pub(super) fn note_transition(&mut self, from: LifecycleState, node: ManagedNode) {
        if self.derive.inside.knows_state(node.domain_id, &node.node) {
            return;
        }
        self.journal.events.push(
            node.at,
            EventKind::Lifecycle {
                domain_id: node.domain_id,
                node: Some(node.node),
                process: None,
                from: from.label().into(),
                to: node.state.label().into(),
            },
        );
    }

    /// Lists the topics of observed processes, and chooses the source of their counts.
    pub(super) fn settle_inside(&mut self, now: ModelTime) {
        let mut changed = Vec::new();
        let (topics, limit) = (&mut self.graph.topics, self.settings.endpoints);
        for (domain_id, naming, is_live, id) in self.derive.inside.topics() {
            if naming.kind.is_service() || naming.kind == TopicKind::Discovery {
                continue;
            }
            if is_live {
                let (place, is_new) = match topics.keep_process_topic(domain_id, naming, limit, now)
                {
                    Some(held) => held,
                    None => continue,
                };
                *id = Some(place);
                changed.extend(is_new.then_some(place));
            } else {
                *id = topics.find(domain_id, naming);
                if let Some(id) = *id {
                    topics.release(id, now);
                }
            }
        }
        self.derive.inside.advance(now, self.settings.topic_grace);
        for id in changed {
            self.apply_lists(id, now);
        }
        let (topics, profiler) = (&self.graph.topics, &self.measure.profiler);
        self.derive.inside.choose(|id: Option<TopicId>| {
            let topic = topics.get(id?)?;
            if topic.watched != Watched::Yes {
                return None;
            }
            let retired = topic.retired.as_deref();
            let mut seen = Seen {
                messages: retired.map_or(0, |retired| retired.messages),
                last: retired.and_then(|retired| retired.last_message),
            };
            for guid in topic.writers.iter().chain(&topic.buffer_endpoints) {
                let Some(measured) = profiler.get(*guid) else {
                    continue;
                };
                seen.messages += measured.writer.messages();
                seen.last = seen.last.max(measured.writer.last_message());
            }
            Some(seen)
        });
    }
}
