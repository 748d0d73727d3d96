//! Events for consumers that follow changes instead of polling state: discovery churn, bursts of
//! lost samples, changes of expectations.
//!
//! Events are facts; the surface adds names, severities and attributes. Each class has its own
//! bound per second, so a storm of one class does not displace the others. Events beyond the bound
//! are counted. Seconds follow the source's clock, so a capture yields the same events at any
//! replay speed.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use crate::facts::bounded::Bounded;
use crate::facts::churn;
use crate::facts::diagnosis::Diagnosis;
use crate::facts::loss::Loss;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, NodeName, TopicName, TypeName};
use crate::facts::robot::{DiagnosticStatus, ParameterChange, TransformJump};
use crate::facts::route::Receiver;
use crate::facts::tables::{LosingReceivers, LossBursts, WaitingEvents};
use crate::facts::wall_clock::WallClock;
use crate::facts::watch::WatchState;

/// Maximum number of events per class and second of the source's clock.
const MAX_EVENTS_PER_SECOND: u16 = 512;
/// Number of waiting events above which they should be taken before further input.
const MANY_WAITING: usize = 1024;
/// Maximum length of a text in an event, such as a topic's name, in bytes.
pub(crate) const MAX_TEXT: usize = 256;
/// Maximum length of a list in an event, such as the participants of a duplicate node.
const MAX_LIST: usize = 8;

/// An event.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Time, by the source's clock.
    pub at: Timestamp,
    /// Kind and details.
    pub kind: EventKind,
}

/// The kind of an event, with its details.
#[derive(Clone, Debug, PartialEq)]
pub enum EventKind {
    /// A participant appeared, changed or vanished.
    Participant {
        /// Kind of the change.
        change: churn::Event,
        /// Its domain.
        domain_id: DomainId,
        /// GUID of the participant.
        guid: Guid,
        /// Its implementation.
        vendor: VendorId,
        /// Host name, as announced.
        host: Option<Box<str>>,
        /// Process name, as announced.
        process: Option<Box<str>>,
    },
    /// A writer or reader appeared, changed or vanished.
    Endpoint {
        /// Kind of the change.
        change: churn::Event,
        /// Its domain.
        domain_id: DomainId,
        /// GUID of the endpoint.
        guid: Guid,
        /// Writer or reader.
        role: Role,
        /// DDS topic.
        topic: DdsName,
        /// ROS type.
        message_type: TypeName,
    },
    /// A node appeared or vanished.
    Node {
        /// Kind of the change.
        change: churn::Event,
        /// Its domain.
        domain_id: DomainId,
        /// Participant of the node.
        participant: Guid,
        /// Fully qualified name.
        name: NodeName,
    },
    /// A managed node changed its lifecycle state.
    Lifecycle {
        /// Its domain.
        domain_id: DomainId,
        /// The node, if known.
        node: Option<NodeName>,
        /// Its process, if calls inside it showed the change.
        process: Option<u32>,
        /// Label of the previous state.
        from: Arc<str>,
        /// Label of the new state.
        to: Arc<str>,
    },
    /// Samples of a writer within about one second were settled as lost.
    Loss(LossBurst),
    /// A watched topic changed its state under a watchlist entry.
    Expectation {
        /// Its domain.
        domain_id: DomainId,
        /// ROS name.
        topic: TopicName,
        /// Pattern of the entry.
        watch: Box<str>,
        /// Previous state; `None` at the first evaluation.
        from: Option<WatchState>,
        /// New state.
        to: WatchState,
        /// Violated expectations.
        violations: Vec<&'static str>,
    },
    /// A watched topic has a publisher, but no message arrived for longer than its entry allows.
    Silence {
        /// Its domain.
        domain_id: DomainId,
        /// ROS name.
        topic: TopicName,
        /// Pattern of the entry.
        watch: Box<str>,
        /// Time of the last message; `None` before the first.
        last_message: Option<Timestamp>,
    },
    /// A part of the robot changed the level of its diagnostics.
    Diagnostic {
        /// Previous level; `None` at its first status.
        before: Option<DiagnosticLevel>,
        /// Its status.
        status: Arc<DiagnosticStatus>,
    },
    /// A transform differs suddenly from the last one of its edge.
    TransformJump {
        /// Domain.
        domain_id: DomainId,
        /// Namespace of the topic; empty for `/tf`.
        namespace: Arc<str>,
        /// Parent frame.
        parent: Arc<str>,
        /// Child frame.
        child: Arc<str>,
        /// Node of the broadcaster, if known.
        node: Option<NodeName>,
        /// What jumped.
        jump: TransformJump,
    },
    /// A parameter of a node changed.
    Parameter(Arc<ParameterChange>),
    /// A problem of the graph appeared, changed or was resolved.
    Diagnosis {
        /// Whether the problem is resolved.
        resolved: bool,
        /// The problem, in its last form.
        finding: Diagnosis,
    },
}

/// Samples of one writer that its worst receiver lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LossBurst {
    /// GUID of the writer.
    pub writer: Guid,
    /// Domain and DDS topic, if the writer was announced.
    pub topic: Option<(DomainId, DdsName)>,
    /// Node of the writer, if known.
    pub node: Option<NodeName>,
    /// Number of lost samples.
    pub count: u64,
    /// First lost sequence number.
    pub first: SequenceNumber,
    /// Last lost sequence number; samples in between may have arrived.
    pub last: SequenceNumber,
}

/// Events that share a bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Participants.
    Participant,
    /// Endpoints.
    Endpoint,
    /// Nodes and their lifecycle.
    Node,
    /// Losses.
    Loss,
    /// Expectations and silence.
    Expectation,
    /// Findings about the graph.
    Diagnosis,
    /// What the robot itself says.
    Robot,
}

/// Events removed from the queue.
#[derive(Debug, Default)]
pub struct Taken {
    /// Events in the order in which they were detected.
    pub events: Vec<Event>,
    /// Number of events beyond the bound, by class.
    pub overflow: Vec<(Class, u64)>,
}

/// Events that wait to be taken, and losses that are being combined.
#[derive(Debug, Default)]
pub struct Events {
    waiting: Bounded<WaitingEvents, Vec<(ModelTime, EventKind)>>,
    classes: BTreeMap<Class, ClassQuota>,
    bursts: Bounded<LossBursts, BTreeMap<Guid, Burst>>,
}

/// State of one class.
#[derive(Clone, Copy, Debug, Default)]
struct ClassQuota {
    second: u64,
    in_second: u16,
    overflow: u64,
}

/// A burst of losses that is still growing.
#[derive(Debug)]
struct Burst {
    at: ModelTime,
    losses: LossBurst,
    /// Number of samples that each receiver lost.
    losers: Bounded<LosingReceivers, Vec<(Receiver, u64)>>,
}

impl Class {
    /// All classes.
    pub const ALL: [Self; 7] = [
        Self::Participant,
        Self::Endpoint,
        Self::Node,
        Self::Loss,
        Self::Expectation,
        Self::Diagnosis,
        Self::Robot,
    ];
}

impl EventKind {
    /// Returns the class of this event.
    #[must_use]
    pub const fn class(&self) -> Class {
        match self {
            Self::Participant { .. } => Class::Participant,
            Self::Endpoint { .. } => Class::Endpoint,
            Self::Node { .. } | Self::Lifecycle { .. } => Class::Node,
            Self::Loss(_) => Class::Loss,
            Self::Expectation { .. } | Self::Silence { .. } => Class::Expectation,
            Self::Diagnosis { .. } => Class::Diagnosis,
            Self::Diagnostic { .. } | Self::TransformJump { .. } | Self::Parameter(_) => {
                Class::Robot
            }
        }
    }
}

impl Events {
    /// Adds an event if its class has quota left.
    pub fn push(&mut self, at: ModelTime, kind: EventKind) {
        let quota = self.classes.entry(kind.class()).or_default();
        let second = at.whole_seconds();
        // A late decision may belong to the previous second. A second before that means that the
        // clock was set.
        if second != quota.second && second.checked_add(1) != Some(quota.second) {
            (quota.second, quota.in_second) = (second, 0);
        }
        if quota.in_second >= MAX_EVENTS_PER_SECOND {
            quota.overflow += 1;
            return;
        }
        quota.in_second += 1;
        let is_full = self.waiting.push((at, kind)).is_some();
        quota.overflow += u64::from(is_full);
    }

    /// Returns whether so many events wait that they should be taken before further input.
    #[must_use]
    pub fn are_many(&self) -> bool {
        self.waiting.len() >= MANY_WAITING
    }

    /// Adds samples that reached no receiver to the burst of their writer.
    pub fn add_loss(&mut self, loss: &Loss) {
        let count = loss.last.steps_since(loss.first).saturating_add(1);
        if let Some(burst) = self.burst(loss.writer, loss.at, (loss.first, loss.last)) {
            burst.losses.count = burst.losses.count.saturating_add(count);
        }
    }

    /// Adds samples that one receiver lost to the burst of their writer. A burst has the count of
    /// the receiver that lost most.
    pub fn add_delivery_loss(
        &mut self,
        writer: Guid,
        receiver: Receiver,
        at: ModelTime,
        (first, last): (SequenceNumber, SequenceNumber),
    ) {
        let count = last.steps_since(first).saturating_add(1);
        let Some(burst) = self.burst(writer, at, (first, last)) else {
            return;
        };
        let mut losers = burst.losers.iter_mut();
        let lost = match losers.find(|(loser, _)| *loser == receiver) {
            Some((_, lost)) => {
                *lost = lost.saturating_add(count);
                *lost
            }
            None => {
                burst.losers.push((receiver, count));
                count
            }
        };
        burst.losses.count = burst.losses.count.max(lost);
    }

    fn burst(
        &mut self,
        writer: Guid,
        at: ModelTime,
        (first, last): (SequenceNumber, SequenceNumber),
    ) -> Option<&mut Burst> {
        let new = || Burst {
            at,
            losses: LossBurst {
                writer,
                topic: None,
                node: None,
                count: 0,
                first,
                last,
            },
            losers: Bounded::default(),
        };
        let Some(burst) = self.bursts.get_or_insert_with(writer, new) else {
            self.classes.entry(Class::Loss).or_default().overflow += 1;
            return None;
        };
        burst.at = burst.at.max(at);
        burst.losses.first = burst.losses.first.min(first);
        burst.losses.last = burst.losses.last.max(last);
        Some(burst)
    }

    /// Sets the topic of the burst of a writer that was removed.
    pub fn name(&mut self, writer: Guid, domain_id: DomainId, topic: &DdsName) {
        if let Some(burst) = self.bursts.get_mut(&writer) {
            burst.losses.topic = Some((domain_id, topic.clone()));
        }
    }

    /// Ends all bursts. `complete` fills in what is known about the writers.
    pub fn end_bursts(&mut self, mut complete: impl FnMut(&mut LossBurst)) {
        for (_, Burst { at, mut losses, .. }) in self.bursts.take() {
            complete(&mut losses);
            self.push(at, EventKind::Loss(losses));
        }
    }

    /// Removes and returns all events since the last call, with wall times.
    pub fn take(&mut self, clock: WallClock) -> Taken {
        let classes = self.classes.iter_mut();
        let overflow = classes.map(|(class, quota)| (*class, std::mem::take(&mut quota.overflow)));
        let events = self.waiting.take().into_iter().map(|(at, kind)| Event {
            at: clock.wall_time(at),
            kind,
        });
        Taken {
            overflow: overflow.filter(|(_, count)| *count > 0).collect(),
            events: events.collect(),
        }
    }
}

/// Returns the text, truncated to the maximum length in an event.
#[must_use]
pub fn truncated(text: &str) -> &str {
    text.get(..text.floor_char_boundary(MAX_TEXT))
        .unwrap_or_default()
}

/// Returns the finding, with its lists truncated to the maximum length in an event.
#[must_use]
pub fn bounded_finding(finding: &Diagnosis) -> Diagnosis {
    let mut finding = finding.clone();
    match &mut finding {
        Diagnosis::TypeConflict { types, .. } => types.truncate(MAX_LIST),
        Diagnosis::TypeHashConflict { hashes, .. } => hashes.truncate(MAX_LIST),
        Diagnosis::DuplicateNode { participants, .. } => participants.truncate(MAX_LIST),
        Diagnosis::NodeInSeveralDomains { domains, .. } => domains.truncate(MAX_LIST),
        Diagnosis::LogErrors { text, .. } => *text = truncated(text).into(),
        Diagnosis::ClocksApart { peer, .. } => *peer = truncated(peer).into(),
        Diagnosis::QosIncompatible { .. }
        | Diagnosis::UnmatchedPublisher { .. }
        | Diagnosis::UnmatchedSubscription { .. }
        | Diagnosis::HangingCall { .. }
        | Diagnosis::SlowCallback { .. }
        | Diagnosis::ExecutorWait { .. }
        | Diagnosis::LateCallback { .. }
        | Diagnosis::IntraProcessOverflow { .. }
        | Diagnosis::ReaderQueueOverflow { .. }
        | Diagnosis::ObservationSuspended { .. }
        | Diagnosis::RestampingNode { .. }
        | Diagnosis::BuffersByCpu { .. }
        | Diagnosis::LossyLink { .. }
        | Diagnosis::DiagnosticError { .. }
        | Diagnosis::TransformFault { .. }
        | Diagnosis::NearMiss { .. }
        | Diagnosis::NodeInactive { .. }
        | Diagnosis::ParameterDrift { .. }
        | Diagnosis::MixedTime { .. }
        | Diagnosis::WrongStamps { .. }
        | Diagnosis::SharedMemoryFault { .. }
        | Diagnosis::SlowChain { .. } => {}
    }
    finding
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::time::SECOND;
    use ros2probe_wire::{EntityId, GuidPrefix};

    use super::*;

    fn guid(number: u8) -> Guid {
        Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, number, 3]))
    }

    fn loss(writer: Guid, at: u64, first: u64, last: u64) -> Loss {
        Loss {
            at: ModelTime::from_nanoseconds(at),
            writer,
            first: SequenceNumber(first),
            last: SequenceNumber(last),
        }
    }

    fn node(name: &str) -> EventKind {
        EventKind::Node {
            change: churn::Event::Appeared,
            domain_id: DomainId(0),
            participant: guid(1),
            name: name.into(),
        }
    }

    #[test]
    fn losses_of_one_writer_become_one_event_when_the_burst_ends() {
        let mut events = Events::default();
        events.add_loss(&loss(guid(1), 10, 5, 7));
        events.add_loss(&loss(guid(2), 11, 1, 1));
        events.add_loss(&loss(guid(1), 12, 9, 9));
        assert!(events.take(WallClock::default()).events.is_empty());
        events.name(guid(2), DomainId(3), &"rt/points".into());
        events.end_bursts(|burst| {
            if burst.topic.is_none() {
                burst.topic = Some((DomainId(0), "rt/imu".into()));
            }
        });
        let losses: Vec<_> = events
            .take(WallClock::default())
            .events
            .into_iter()
            .map(|event| event.kind)
            .collect();
        let burst = |writer, (domain_id, name): (u32, &str), count, first, last| {
            let (first, last) = (SequenceNumber(first), SequenceNumber(last));
            EventKind::Loss(LossBurst {
                writer,
                topic: Some((DomainId(domain_id), name.into())),
                node: None,
                count,
                first,
                last,
            })
        };
        assert_eq!(
            losses,
            [
                burst(guid(1), (0, "rt/imu"), 4, 5, 9),
                burst(guid(2), (3, "rt/points"), 1, 1, 1)
            ]
        );
        events.end_bursts(|_| {});
        assert!(events.take(WallClock::default()).events.is_empty());
    }

    #[test]
    fn a_storm_of_one_class_is_counted_and_does_not_displace_the_others() {
        let mut events = Events::default();
        for number in 0..MAX_EVENTS_PER_SECOND + 7 {
            events.push(ModelTime::from_nanoseconds(number.into()), node("/a"));
        }
        events.add_loss(&loss(guid(1), 10, 5, 7));
        events.end_bursts(|_| {});
        let taken = events.take(WallClock::default());
        assert_eq!(taken.events.len(), usize::from(MAX_EVENTS_PER_SECOND) + 1);
        assert_eq!(taken.overflow, [(Class::Node, 7)]);
        // Taking events does not renew the quota of a second; the next second has its own.
        events.push(ModelTime::from_nanoseconds(SECOND - 1), node("/b"));
        assert_eq!(
            events.take(WallClock::default()).overflow,
            [(Class::Node, 1)]
        );
        events.push(ModelTime::from_nanoseconds(SECOND), node("/b"));
        let taken = events.take(WallClock::default());
        assert_eq!((taken.events.len(), taken.overflow.len()), (1, 0));
    }

    #[test]
    fn a_burst_has_the_count_of_the_receiver_that_lost_most() {
        let mut events = Events::default();
        let receiver = |number| Receiver::Participant(GuidPrefix([number; 12]));
        let run = |first, last| (SequenceNumber(first), SequenceNumber(last));
        events.add_delivery_loss(
            guid(1),
            receiver(1),
            ModelTime::from_nanoseconds(10),
            run(5, 7),
        );
        events.add_delivery_loss(
            guid(1),
            receiver(2),
            ModelTime::from_nanoseconds(10),
            run(6, 7),
        );
        events.add_delivery_loss(
            guid(1),
            receiver(2),
            ModelTime::from_nanoseconds(11),
            run(9, 10),
        );
        events.end_bursts(|_| {});
        let EventKind::Loss(burst) = &events.take(WallClock::default()).events[0].kind else {
            panic!("a loss")
        };
        assert_eq!((burst.count, burst.first.0, burst.last.0), (4, 5, 10));
    }

    #[test]
    fn losing_receivers_beyond_the_cap_are_not_compared() {
        let mut events = Events::default();
        for number in 0..100 {
            let receiver = Receiver::Participant(GuidPrefix([number; 12]));
            let run = (SequenceNumber(1), SequenceNumber(2));
            events.add_delivery_loss(guid(1), receiver, ModelTime::from_nanoseconds(10), run);
        }
        assert!(events.bursts[&guid(1)].losers.is_full());
    }

    #[test]
    fn long_texts_are_truncated_between_characters() {
        let long: TopicName = "\u{e9}".repeat(5_000).into();
        assert_eq!(truncated(&long).len(), MAX_TEXT);
        assert_eq!(long.bounded(MAX_TEXT).len(), MAX_TEXT);
        let short: TopicName = "/points".into();
        assert!(std::sync::Arc::ptr_eq(
            &short.shared(),
            &short.bounded(MAX_TEXT).shared()
        ));
    }
}
