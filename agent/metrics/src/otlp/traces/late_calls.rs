//! Spans of late calls of callbacks: one trace for each call, with its stages as children.

use std::sync::Arc;
use std::time::Duration;

use opentelemetry::KeyValue;
use opentelemetry::trace::SpanKind;
use opentelemetry_sdk::trace::SpanLinks;
use ros2probe_wire::{DomainId, Timestamp};

use super::{Parts, attribute, id, int};
use ros2probe_model::facts::calls::facts::LateExample;
use ros2probe_model::facts::calls::late::{Part, Stage};
use ros2probe_model::facts::calls::other_thread::OtherThread;
use ros2probe_model::facts::calls::report::Trigger;
use ros2probe_model::facts::identity::Identity;

/// A span of a late call.
#[derive(Clone, Debug)]
pub(super) struct LateSpan {
    domain_id: DomainId,
    example: Arc<LateExample>,
    /// The stage; `None` for the whole call, the parent of the stages.
    stage: Option<Stage>,
    /// Time from the begin of the span to the start of the call.
    before: Duration,
    duration: Duration,
}

impl LateSpan {
    /// Returns the spans of a call: the whole, then each stage that took time.
    pub(super) fn of(domain_id: DomainId, example: &Arc<LateExample>) -> Vec<LateSpan> {
        let (call, total) = (&example.call, example.call.total());
        let span = |stage, before, duration| LateSpan {
            domain_id,
            example: Arc::clone(example),
            stage,
            before,
            duration,
        };
        let mut before = total.saturating_sub(call.duration);
        let mut spans = vec![span(None, before, total)];
        for stage in Stage::ALL {
            let parts = call.parts().into_iter();
            let of_stage = parts.filter(|part| part.stage == stage);
            let duration: Duration = of_stage.map(|part| part.duration).sum();
            if stage == Stage::Callback {
                before = Duration::ZERO;
            }
            if !duration.is_zero() {
                spans.push(span(Some(stage), before, duration));
            }
            before = before.saturating_sub(duration);
        }
        spans
    }

    /// Returns the span as it is exported by the agent of this host.
    pub(super) fn parts(&self, host: u128) -> Parts {
        let call = &self.example.call;
        let trace_id = self.trace_id(host);
        let label = self.stage.map_or("late", Stage::label);
        let begin = call.started.0.saturating_sub(nanoseconds(self.before));
        Parts {
            trace_id,
            id: id(label.as_bytes(), trace_id, &[]),
            parent: self.stage.map(|_| id(b"late", trace_id, &[])),
            kind: match (&call.trigger, self.stage) {
                (Trigger::Subscription(_) | Trigger::IntraProcess(_), None) => SpanKind::Consumer,
                (Trigger::Service(_), None) => SpanKind::Server,
                _ => SpanKind::Internal,
            },
            name: format!("{label} {}", call.trigger),
            times: [
                Timestamp(begin),
                Timestamp(begin.saturating_add(nanoseconds(self.duration))),
            ],
            attributes: match self.stage {
                Some(stage) => self.of_stage(stage),
                None => self.of_call(),
            },
            links: SpanLinks::default(),
        }
    }

    fn trace_id(&self, host: u128) -> u128 {
        let call = &self.example.call;
        let mut identity = Identity::of(b"late call");
        identity.add(&host.to_be_bytes());
        identity.add(&call.process.to_be_bytes());
        identity.add(&call.handle.to_be_bytes());
        identity.add(&call.started.0.to_be_bytes());
        identity.bits()
    }

    /// Returns the attributes of the whole call: whose it is, what made it late, and the thread
    /// that did.
    fn of_call(&self) -> Vec<KeyValue> {
        let LateExample { call, main, .. } = &*self.example;
        let mut attributes = vec![
            int("domain_id", self.domain_id.into()),
            attribute("trigger", call.trigger.label()),
            int("process.pid", call.process.into()),
            int("thread.id", call.thread.into()),
            int("cpu.logical_number", call.cpu.into()),
        ];
        match &call.trigger {
            Trigger::Subscription(topic) | Trigger::IntraProcess(Some(topic)) => {
                attributes.extend([
                    attribute("messaging.system", "ros2"),
                    attribute("messaging.operation.name", "process"),
                    attribute("messaging.operation.type", "process"),
                    attribute("messaging.destination.name", topic.to_string()),
                ]);
            }
            Trigger::Service(Some(service)) => {
                attributes.push(attribute("service", service.to_string()));
            }
            Trigger::IntraProcess(None) | Trigger::Timer(_) | Trigger::Service(None) => {}
        }
        if let Some(node) = &call.node {
            attributes.push(attribute("ros_node", node.to_string()));
        }
        if let Some(source) = call.source {
            attributes.push(int("source_timestamp_unix_nano", source.0));
        }
        if let Some(main) = main {
            attributes.push(attribute("stage", main.stage.label()));
            attributes.extend(self.cause(*main));
        }
        attributes
    }

    /// Returns the attributes of a stage: its parts, and the cause of the longest one.
    fn of_stage(&self, stage: Stage) -> Vec<KeyValue> {
        let parts = self.example.call.parts().into_iter();
        let parts = parts.filter(|part| part.stage == stage && !part.duration.is_zero());
        let parts: Vec<_> = parts.collect();
        let longest = parts.iter().max_by_key(|part| part.duration);
        let mut attributes: Vec<_> = longest.map_or(Vec::new(), |part| self.cause(*part));
        attributes.extend(parts.iter().map(|part| {
            let key = format!("{}_seconds", part.cause.label());
            KeyValue::new(key, part.duration.as_secs_f64())
        }));
        attributes
    }

    /// Returns the cause of a part, and the thread that it names.
    fn cause(&self, part: Part) -> Vec<KeyValue> {
        let by = self.example.call.named_by(part);
        let words = part.cause.in_words(by.map(|by| by as _));
        let mut attributes = vec![
            attribute("cause", part.cause.label()),
            attribute("cause_description", words),
        ];
        attributes.extend(by.into_iter().flat_map(named));
        attributes
    }
}

fn named(by: &OtherThread) -> Vec<KeyValue> {
    let mut attributes = vec![
        attribute("by", by.name.to_string()),
        int("by_process_id", by.process.into()),
    ];
    let texts = [
        ("by_unit", by.unit.as_ref().map(ToString::to_string)),
        ("by_priority", by.priority.map(|it| it.to_string())),
    ];
    for (key, text) in texts {
        attributes.extend(text.map(|text| attribute(key, text)));
    }
    attributes
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::facts::calls::late::{
        Activity, Blocked, Cause, LateBound, LateCall, MessageDelivery, Repairs,
    };
    use ros2probe_model::facts::calls::other_thread::Priority;
    use ros2probe_model::facts::calls::report::ThreadStates;
    use ros2probe_model::facts::model_time::ModelTime;
    use ros2probe_wire::inside::late::wait;

    const STARTED: u64 = 1_700_000_000_000_000_000;

    /// A call of 100 ms, most of which it waited for a lock, 60 ms after its message was sent.
    fn example() -> Arc<LateExample> {
        let milliseconds = Duration::from_millis;
        let holder = OtherThread {
            duration: Duration::ZERO,
            thread: 8,
            process: 7,
            name: "holder".into(),
            unit: Some("map.service".into()),
            priority: Some(Priority::RealTime(9)),
        };
        let call = LateCall {
            process: 42,
            handle: 0x40,
            node: Some("/filter".into()),
            trigger: Trigger::Subscription("/points".into()),
            thread: 43,
            cpu: 1,
            source: Some(Timestamp(STARTED - 60_000_000)),
            started: Timestamp(STARTED),
            duration: milliseconds(100),
            wait: Some(milliseconds(60)),
            bound: LateBound {
                duration: milliseconds(30),
                wait: milliseconds(100),
            },
            delivery: Some(MessageDelivery {
                sent_before: Some(milliseconds(50)),
                arrived_before: milliseconds(40),
                received_before: milliseconds(15),
                receiver_thread: 44,
                receiver: None,
            }),
            handoff: None,
            repairs: Repairs::default(),
            cpu_limits: Arc::new([]),
            stop: None,
            released_by: None,
            busy: None,
            previous: None,
            states: Some(ThreadStates {
                calls: 1,
                cpu: 10_000_000,
                blocked: 90_000_000,
                ..ThreadStates::default()
            }),
            states_before: None,
            activity: Some(Activity {
                blocked: {
                    let mut blocked = [Duration::ZERO; wait::COUNT];
                    blocked[wait::LOCK] = milliseconds(90);
                    blocked
                },
                longest: Some(Blocked {
                    duration: milliseconds(90),
                    kind: wait::LOCK,
                    call: Some("futex".into()),
                    argument: 0x7f00,
                    waker: Some(holder),
                }),
                ..Activity::default()
            }),
            activity_before: None,
        };
        let main = call.main_part(ThreadStates::default());
        assert_eq!(main.map(|part| part.cause), Some(Cause::Lock));
        Arc::new(LateExample {
            at: ModelTime::ZERO,
            main,
            call,
        })
    }

    fn value(parts: &Parts, key: &str) -> Option<String> {
        let attribute = parts.attributes.iter().find(|it| it.key.as_str() == key);
        attribute.map(|attribute| attribute.value.to_string())
    }

    #[test]
    fn the_kind_of_a_span_is_that_of_its_trigger() {
        for (trigger, kind, service) in [
            (Trigger::Timer(None), SpanKind::Internal, None),
            (
                Trigger::Service(Some("/plan".into())),
                SpanKind::Server,
                Some("/plan"),
            ),
            (Trigger::IntraProcess(None), SpanKind::Consumer, None),
        ] {
            let mut example = Arc::unwrap_or_clone(example());
            example.call.trigger = trigger;
            // The call was ready when it started.
            (example.call.wait, example.call.delivery) = (None, None);
            let spans = LateSpan::of(DomainId(0), &Arc::new(example));
            let all: Vec<_> = spans.iter().map(|span| span.parts(5)).collect();
            assert_eq!(all.len(), 2, "the call and its callback");
            assert_eq!((&all[0].kind, &all[1].kind), (&kind, &SpanKind::Internal));
            assert_eq!(value(&all[0], "service").as_deref(), service);
            assert_eq!(value(&all[0], "messaging.destination.name"), None);
            assert_eq!(all[0].times, all[1].times);
        }
    }

    #[test]
    fn the_stages_of_a_late_call_are_adjacent_children_with_the_culprit_as_attribute() {
        let spans = LateSpan::of(DomainId(3), &example());
        let all: Vec<_> = spans.iter().map(|span| span.parts(5)).collect();
        let names: Vec<_> = all.iter().map(|parts| parts.name.as_str()).collect();
        let expected = ["late", "publish", "network", "socket", "wait", "callback"];
        assert_eq!(names, expected.map(|stage| format!("{stage} /points")));
        let call = &all[0];
        let time = |milliseconds: u64| Timestamp(STARTED - 60_000_000 + milliseconds * 1_000_000);
        assert_eq!(call.times, [time(0), time(160)]);
        let mut at = time(0);
        for (stage, until) in all[1..].iter().zip([10, 20, 45, 60, 160]) {
            assert_eq!(
                (stage.trace_id, stage.parent),
                (call.trace_id, Some(call.id))
            );
            assert_ne!(stage.id, call.id);
            assert_eq!(stage.times, [at, time(until)], "{}", stage.name);
            at = time(until);
        }
        assert_eq!((call.parent, &call.kind), (None, &SpanKind::Consumer));
        for (key, expected) in [
            ("cause", "lock"),
            ("stage", "callback"),
            ("by", "holder"),
            ("by_process_id", "7"),
            ("by_unit", "map.service"),
            ("by_priority", "real-time 9"),
            ("messaging.destination.name", "/points"),
            ("ros_node", "/filter"),
            ("domain_id", "3"),
        ] {
            assert_eq!(value(call, key).as_deref(), Some(expected), "{key}");
        }
        let callback = &all[5];
        assert_eq!(value(callback, "lock_seconds").as_deref(), Some("0.09"));
        assert_eq!(value(callback, "cpu_seconds").as_deref(), Some("0.01"));
        assert_eq!(value(callback, "by").as_deref(), Some("holder"));
        assert_eq!(value(&all[3], "cause").as_deref(), Some("queue"));
        // Another host has another trace.
        assert_ne!(spans[0].parts(6).trace_id, call.trace_id);
    }
}
