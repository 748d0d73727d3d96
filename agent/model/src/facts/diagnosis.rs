//! Problems of the graph that discovery shows: incompatible endpoints, duplicate names, endpoints
//! without a counterpart.
//!
//! Findings are computed when discovery changes, topic by topic. Endpoints with equal properties
//! are grouped. Both the computing steps and the list of findings are bounded, and omitted findings
//! are counted. A finding is a value, so comparing two lists yields the changes ([`changes`]). A
//! finding has no severity; the surfaces assign it.

mod matching;
mod similar;

use std::cmp::Ordering;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::lifecycle::LifecycleState;
use ros2probe_wire::{DomainId, Guid};

use crate::facts::calls::facts::Owner;
use crate::facts::calls::late::{Cause, Stage};
use crate::facts::calls::other_thread::ThreadLabel;
use crate::facts::calls::report::Trigger;
use crate::facts::link::LinkKey;
use crate::facts::names::{DdsName, NodeName, TopicName, TypeName};
use crate::facts::naming::Naming;
use crate::facts::robot::TransformFault;
use crate::facts::shared_memory::MemoryFault;
use crate::facts::topic_kind::TopicKind;
pub(crate) use matching::effort;
pub use matching::{Offer, Policies, Policy, Verdict, verdict};
pub use similar::Difference;

/// The topic of a finding.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicKey {
    /// Domain of the topic.
    pub domain_id: DomainId,
    /// DDS name; together with the domain it identifies the topic.
    pub dds_name: DdsName,
    /// ROS name, or the DDS name if the topic has none.
    pub name: TopicName,
    /// Role of the topic in ROS.
    pub kind: TopicKind,
}

impl TopicKey {
    /// Returns the identity of a topic with these names.
    #[must_use]
    pub fn of(domain_id: DomainId, naming: &Naming) -> Self {
        Self {
            domain_id,
            dds_name: naming.dds_name.clone(),
            name: naming.name.clone(),
            kind: naming.kind,
        }
    }
}

/// A finding. [`Diagnosis::cmp_identity`] compares the fields that identify it; the others may change.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Diagnosis {
    /// A writer and a reader of one topic and type do not match because of their QoS.
    QosIncompatible {
        /// Topic.
        topic: TopicKey,
        /// GUID of the writer, which offers less.
        writer: Guid,
        /// GUID of the reader, which requests more.
        reader: Guid,
        /// Incompatible policies.
        policies: Policies,
    },
    /// A topic has several types; endpoints of different types do not match.
    TypeConflict {
        /// Topic.
        topic: TopicKey,
        /// ROS types, sorted.
        types: Vec<TypeName>,
    },
    /// A type has several definitions; endpoints match but misread each other's messages.
    TypeHashConflict {
        /// Topic.
        topic: TopicKey,
        /// ROS type.
        message_type: TypeName,
        /// RIHS01 hashes, sorted.
        hashes: Vec<TypeHash>,
    },
    /// Several nodes in one domain have the same name.
    DuplicateNode {
        /// Domain.
        domain_id: DomainId,
        /// Fully qualified name.
        node: NodeName,
        /// The participant of each node, sorted; a participant with several such nodes is repeated.
        participants: Vec<Guid>,
    },
    /// A writer without a matching reader.
    UnmatchedPublisher {
        /// Topic.
        topic: TopicKey,
        /// GUID of the writer.
        writer: Guid,
        /// The nearest mismatch.
        reason: Unmatched,
    },
    /// A reader without a matching writer.
    UnmatchedSubscription {
        /// Topic.
        topic: TopicKey,
        /// GUID of the reader.
        reader: Guid,
        /// The nearest mismatch.
        reason: Unmatched,
    },
    /// A client has called a service and received no reply within the timeout.
    HangingCall {
        /// Topic of the requests.
        topic: TopicKey,
        /// GUID of the client's writer.
        writer: Guid,
    },
    /// A node whose endpoints or names are in several domains. Nodes of one domain cannot reach all
    /// of its endpoints.
    NodeInSeveralDomains {
        /// Fully qualified name.
        node: NodeName,
        /// The lowest GUID among its participants.
        participant: Guid,
        /// Domains, sorted.
        domains: Vec<DomainId>,
    },
    /// A callback runs longer than the period of its timer, or of a timer in the same thread.
    SlowCallback {
        /// Its topic, if messages trigger it.
        topic: Option<TopicKey>,
        /// The callback.
        callback: Owner,
        /// Trigger of the callback.
        trigger: Trigger,
        /// 99th percentile of its duration.
        duration: Duration,
        /// The period.
        period: Duration,
        /// Whether the period is that of its own timer.
        is_own_period: bool,
    },
    /// A callback waits longer than its interval until the executor calls it.
    ExecutorWait {
        /// Its topic, if messages trigger it.
        topic: Option<TopicKey>,
        /// The callback.
        callback: Owner,
        /// Trigger of the callback.
        trigger: Trigger,
        /// 99th percentile of its wait.
        wait: Duration,
    },
    /// Calls of a callback are late, at least three in a minute for the same cause.
    LateCallback {
        /// Its topic, if messages trigger it.
        topic: Option<TopicKey>,
        /// The callback.
        callback: Owner,
        /// Trigger of the callback.
        trigger: Trigger,
        /// Late calls in a minute for this cause.
        calls: u64,
        /// Stage in which they became late.
        stage: Stage,
        /// What made them late.
        cause: Cause,
        /// Thread that ran instead or held the lock, in the longest of these calls.
        by: Option<ThreadLabel>,
        /// Time from ready to the end of that call.
        longest: Duration,
    },
    /// Messages within a process are overwritten before the subscription takes them.
    IntraProcessOverflow {
        /// Topic.
        topic: TopicKey,
        /// The subscription's queue.
        queue: Owner,
        /// Overwritten messages per 1000 that entered the queue.
        overwritten_permille: u64,
    },
    /// A process takes its messages so slowly that the middleware drops some from the queue of its
    /// subscription.
    ReaderQueueOverflow {
        /// Topic.
        topic: TopicKey,
        /// The subscription.
        queue: Owner,
        /// Lost messages per 1000 that arrived.
        lost_permille: u64,
        /// Maximum number of messages in the queue, if announced.
        depth: Option<u64>,
    },
    /// A process makes more calls than its budget allows, and they are no longer counted.
    ObservationSuspended {
        /// Domain of the process.
        domain_id: DomainId,
        /// Process id.
        process: u32,
        /// Its name.
        name: Option<Arc<str>>,
    },
    /// A node that publishes at the rate of an input, but with new stamps: chains end there.
    RestampingNode {
        /// Topic that it publishes.
        topic: TopicKey,
        /// Fully qualified name.
        node: NodeName,
        /// Input with the same rate, whose stamps are older.
        input: TopicName,
    },
    /// Publisher and subscription accept buffers of one backend, but messages travel as a whole.
    BuffersByCpu {
        /// Topic.
        topic: TopicKey,
        /// GUID of the writer.
        writer: Guid,
        /// GUID of the reader without buffers, for which the publisher sends messages as a whole to
        /// all; `None` if it does so because it is transient local.
        reader: Option<Guid>,
        /// Backends that the publisher shares with a subscription, sorted.
        backends: Vec<Box<str>>,
    },
    /// TCP retransmits many segments on the way to another host.
    LossyLink {
        /// The link.
        link: LinkKey,
        /// Retransmitted segments per 1000.
        retransmitted_permille: u64,
        /// Bytes that wait to be sent; `None` if the kernel does not show them.
        unsent: Option<u64>,
    },
    /// A node logs errors in a burst: at least ten in a minute, or a fatal one.
    LogErrors {
        /// Domain.
        domain_id: DomainId,
        /// Fully qualified name.
        node: NodeName,
        /// Errors of the last minute when the burst began.
        errors: u64,
        /// Text of the last one of these.
        text: Arc<str>,
    },
    /// A part of the robot has been in error, or without a new status, for at least 5 s.
    DiagnosticError {
        /// Domain.
        domain_id: DomainId,
        /// Topic of its diagnostics.
        topic: TopicName,
        /// Node that publishes them, if known.
        node: Option<NodeName>,
        /// Name of the part.
        name: Arc<str>,
        /// Id of its hardware; often empty.
        hardware_id: Arc<str>,
        /// Level when it was reported.
        level: DiagnosticLevel,
        /// Message when it was reported.
        message: Arc<str>,
    },
    /// Transforms between frames are missing, contradict each other, or are in several trees.
    TransformFault {
        /// Domain.
        domain_id: DomainId,
        /// Namespace of the topics; empty for `/tf`.
        namespace: Arc<str>,
        /// The fault.
        fault: TransformFault,
    },
    /// The clock of another host differs much from this host's.
    ClocksApart {
        /// The other host: its name or address.
        peer: Arc<str>,
        /// Nanoseconds by which its clock was ahead when the finding began; negative if behind.
        offset: i64,
        /// The offset was wrong by at most this number of nanoseconds.
        uncertainty: i64,
    },
    /// A publisher and a subscription of one type have no counterpart. Their topics differ so
    /// little that one of them is probably a mistake.
    NearMiss {
        /// Topic of the publisher.
        topic: TopicKey,
        /// Topic of the subscription.
        subscription: TopicKey,
        /// How the topics differ.
        difference: Difference,
    },
    /// A managed node has not been active for at least 5 s, although the configuration expects it
    /// or its last transition failed.
    NodeInactive {
        /// Domain.
        domain_id: DomainId,
        /// Fully qualified name.
        node: NodeName,
        /// Its state.
        state: LifecycleState,
        /// Whether a transition failed since it was last active.
        has_failed: bool,
    },
    /// A parameter has another value than the configuration expects.
    ParameterDrift {
        /// Domain.
        domain_id: DomainId,
        /// Fully qualified name of the node.
        node: NodeName,
        /// Name of the parameter.
        name: Arc<str>,
        /// Value that the configuration expects, as YAML.
        expected: Arc<str>,
        /// Last known value.
        value: Arc<str>,
    },
    /// Some nodes of a domain use simulated time (`use_sim_time`), and others do not.
    MixedTime {
        /// Domain.
        domain_id: DomainId,
        /// Nodes with simulated time, at most four.
        simulated: Vec<NodeName>,
        /// Nodes without it, at most four.
        system: Vec<NodeName>,
    },
    /// Stamps in the headers of a publisher's messages cannot be right.
    WrongStamps {
        /// Topic.
        topic: TopicKey,
        /// GUID of the writer.
        writer: Guid,
        /// What is wrong.
        fault: StampFault,
        /// Nanoseconds by which they were wrong when the fault began.
        nanoseconds: i64,
    },
    /// Shared memory cannot serve the robot as Fast DDS expects.
    SharedMemoryFault {
        /// What is wrong.
        fault: MemoryFault,
        /// [`MemoryFault::figure`] when the fault began.
        figure: u64,
    },
    /// A configured chain exceeds its maximum latency.
    SlowChain {
        /// Last topic of the chain.
        topic: TopicKey,
        /// First topic of the chain.
        from: TopicName,
        /// Maximum latency of the chain.
        max_latency: Duration,
    },
}

/// What is wrong with the stamps of a publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum StampFault {
    /// They are later than the publication of their messages.
    Future,
    /// One was earlier than that of the message before, within the last minute.
    WentBack,
    /// Their age grows or shrinks steadily.
    Drifting,
    /// They differ by more than an hour from the publisher's clock.
    OtherClock,
}

impl StampFault {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Future => "future",
            Self::WentBack => "went_back",
            Self::Drifting => "drifting",
            Self::OtherClock => "other_clock",
        }
    }
}

/// Why an endpoint has no counterpart: the mismatch that is nearest to a match.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Unmatched {
    /// A counterpart matches on another host, but one of the two announces loopback addresses only.
    Unreachable,
    /// A counterpart exists, but its quality of service does not match.
    Qos,
    /// A counterpart exists, but with another type.
    Type,
    /// A counterpart exists, but in another partition.
    Partition,
    /// No counterpart exists.
    NoEndpoint,
}

/// The pairs of a topic that one policy makes incompatible.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QosPairs {
    /// Topic.
    pub topic: TopicKey,
    /// The incompatible policy.
    pub policy: Policy,
    /// Number of pairs, including those that the list omits.
    pub pairs: u64,
}

/// All findings.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Diagnoses {
    /// Findings, sorted by [`Diagnosis::cmp_identity`] and without duplicates.
    pub list: Vec<Diagnosis>,
    /// Complete counts of incompatible pairs, sorted by topic and policy.
    pub qos_pairs: Vec<QosPairs>,
    /// Findings omitted because the list is full.
    pub left_out: u64,
    /// Pairs of endpoint groups that were not compared because there are too many.
    pub unexamined: u64,
}

/// A difference between two lists of findings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change<'a> {
    /// The finding is new.
    Appeared(&'a Diagnosis),
    /// The finding has the same identity but other details.
    Changed(&'a Diagnosis),
    /// The finding is gone; this is its last value.
    Resolved(&'a Diagnosis),
}

impl Diagnosis {
    /// All kinds, as label values.
    pub const KINDS: [&'static str; 28] = [
        "qos_incompatible",
        "type_conflict",
        "type_hash_conflict",
        "duplicate_node",
        "unmatched_publisher",
        "unmatched_subscription",
        "hanging_call",
        "node_in_several_domains",
        "slow_callback",
        "executor_wait",
        "late_callback",
        "intra_process_overflow",
        "reader_queue_overflow",
        "observation_suspended",
        "restamping_node",
        "buffers_by_cpu",
        "lossy_link",
        "log_errors",
        "diagnostic_error",
        "transform_fault",
        "clocks_apart",
        "near_miss",
        "node_inactive",
        "parameter_drift",
        "mixed_time",
        "wrong_stamps",
        "shared_memory_fault",
        "slow_chain",
    ];

    /// Returns the kind as a label value.
    #[must_use]
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::QosIncompatible { .. } => "qos_incompatible",
            Self::TypeConflict { .. } => "type_conflict",
            Self::TypeHashConflict { .. } => "type_hash_conflict",
            Self::DuplicateNode { .. } => "duplicate_node",
            Self::UnmatchedPublisher { .. } => "unmatched_publisher",
            Self::UnmatchedSubscription { .. } => "unmatched_subscription",
            Self::HangingCall { .. } => "hanging_call",
            Self::NodeInSeveralDomains { .. } => "node_in_several_domains",
            Self::SlowCallback { .. } => "slow_callback",
            Self::ExecutorWait { .. } => "executor_wait",
            Self::LateCallback { .. } => "late_callback",
            Self::IntraProcessOverflow { .. } => "intra_process_overflow",
            Self::ReaderQueueOverflow { .. } => "reader_queue_overflow",
            Self::ObservationSuspended { .. } => "observation_suspended",
            Self::RestampingNode { .. } => "restamping_node",
            Self::BuffersByCpu { .. } => "buffers_by_cpu",
            Self::LossyLink { .. } => "lossy_link",
            Self::LogErrors { .. } => "log_errors",
            Self::DiagnosticError { .. } => "diagnostic_error",
            Self::TransformFault { .. } => "transform_fault",
            Self::ClocksApart { .. } => "clocks_apart",
            Self::NearMiss { .. } => "near_miss",
            Self::NodeInactive { .. } => "node_inactive",
            Self::ParameterDrift { .. } => "parameter_drift",
            Self::MixedTime { .. } => "mixed_time",
            Self::WrongStamps { .. } => "wrong_stamps",
            Self::SharedMemoryFault { .. } => "shared_memory_fault",
            Self::SlowChain { .. } => "slow_chain",
        }
    }

    /// Returns the topic of the finding, if it concerns a topic.
    #[must_use]
    pub const fn topic(&self) -> Option<&TopicKey> {
        match self {
            Self::QosIncompatible { topic, .. }
            | Self::TypeConflict { topic, .. }
            | Self::TypeHashConflict { topic, .. }
            | Self::UnmatchedPublisher { topic, .. }
            | Self::UnmatchedSubscription { topic, .. }
            | Self::HangingCall { topic, .. }
            | Self::IntraProcessOverflow { topic, .. }
            | Self::ReaderQueueOverflow { topic, .. }
            | Self::RestampingNode { topic, .. }
            | Self::BuffersByCpu { topic, .. }
            | Self::NearMiss { topic, .. }
            | Self::WrongStamps { topic, .. }
            | Self::SlowChain { topic, .. } => Some(topic),
            Self::SlowCallback { topic, .. }
            | Self::ExecutorWait { topic, .. }
            | Self::LateCallback { topic, .. } => topic.as_ref(),
            Self::DuplicateNode { .. }
            | Self::NodeInSeveralDomains { .. }
            | Self::LossyLink { .. }
            | Self::LogErrors { .. }
            | Self::DiagnosticError { .. }
            | Self::TransformFault { .. }
            | Self::ClocksApart { .. }
            | Self::NodeInactive { .. }
            | Self::ParameterDrift { .. }
            | Self::MixedTime { .. }
            | Self::SharedMemoryFault { .. }
            | Self::ObservationSuspended { .. } => None,
        }
    }

    /// Compares identities only, without details. This is the order of the list: in another order,
    /// [`changes`] would report a finding that still exists as resolved.
    #[must_use]
    pub fn cmp_identity(&self, other: &Self) -> Ordering {
        let place = |diagnosis: &Self| {
            let mut kinds = Self::KINDS.iter();
            kinds.position(|kind| *kind == diagnosis.kind())
        };
        let topics = || self.topic().cmp(&other.topic());
        place(self)
            .cmp(&place(other))
            .then_with(topics)
            .then_with(|| self.within_topic().cmp(&other.within_topic()))
            .then_with(|| self.handle().cmp(&other.handle()))
            .then_with(|| self.link().cmp(&other.link()))
            .then_with(|| self.part().cmp(&other.part()))
            .then_with(|| self.frame().cmp(&other.frame()))
            .then_with(|| self.parameter().cmp(&other.parameter()))
    }

    /// Returns the child frame and the kind of a fault of transforms.
    fn frame(&self) -> Option<(&str, &'static str)> {
        match self {
            Self::TransformFault { fault, .. } => Some((&fault.child, fault.kind.label())),
            _ => None,
        }
    }

    /// Returns topic, name and hardware id of the part of the robot that is in error.
    fn part(&self) -> Option<(&TopicName, &str, &str)> {
        match self {
            Self::DiagnosticError {
                topic,
                name,
                hardware_id,
                ..
            } => Some((topic, name, hardware_id)),
            _ => None,
        }
    }

    /// Returns the name of the parameter.
    fn parameter(&self) -> Option<&str> {
        match self {
            Self::ParameterDrift { name, .. } => Some(name),
            _ => None,
        }
    }

    /// Returns the link of the finding, if it concerns one.
    const fn link(&self) -> Option<&LinkKey> {
        match self {
            Self::LossyLink { link, .. } => Some(link),
            _ => None,
        }
    }

    /// Returns the publisher, subscription or callback that the finding concerns, if any.
    #[must_use]
    pub const fn owner(&self) -> Option<&Owner> {
        match self {
            Self::SlowCallback { callback, .. }
            | Self::ExecutorWait { callback, .. }
            | Self::LateCallback { callback, .. } => Some(callback),
            Self::IntraProcessOverflow { queue, .. } | Self::ReaderQueueOverflow { queue, .. } => {
                Some(queue)
            }
            _ => None,
        }
    }

    /// Returns the process and handle of a finding from inside processes.
    fn handle(&self) -> Option<(u32, u64)> {
        match self {
            Self::ObservationSuspended { process, .. } => Some((*process, 0)),
            _ => self.owner().map(|owner| (owner.process, owner.handle)),
        }
    }

    /// Returns the key that distinguishes findings of one kind and topic.
    fn within_topic(&self) -> (DomainId, &str, Option<Guid>, Option<Guid>) {
        match self {
            Self::QosIncompatible { writer, reader, .. } => {
                (DomainId(0), "", Some(*writer), Some(*reader))
            }
            Self::TypeConflict { .. } => (DomainId(0), "", None, None),
            Self::TypeHashConflict { message_type, .. } => (DomainId(0), message_type, None, None),
            Self::DuplicateNode {
                domain_id, node, ..
            }
            | Self::LogErrors {
                domain_id, node, ..
            }
            | Self::NodeInactive {
                domain_id, node, ..
            }
            | Self::ParameterDrift {
                domain_id, node, ..
            } => (*domain_id, node, None, None),
            Self::UnmatchedPublisher { writer, .. }
            | Self::WrongStamps { writer, .. }
            | Self::HangingCall { writer, .. }
            | Self::BuffersByCpu { writer, .. } => (DomainId(0), "", Some(*writer), None),
            Self::UnmatchedSubscription { reader, .. } => (DomainId(0), "", Some(*reader), None),
            Self::NodeInSeveralDomains {
                node, participant, ..
            } => (DomainId(0), node, Some(*participant), None),
            Self::ObservationSuspended { domain_id, .. }
            | Self::MixedTime { domain_id, .. }
            | Self::DiagnosticError { domain_id, .. } => (*domain_id, "", None, None),
            Self::TransformFault {
                domain_id,
                namespace,
                ..
            } => (*domain_id, namespace, None, None),
            Self::SlowCallback { .. }
            | Self::ExecutorWait { .. }
            | Self::LateCallback { .. }
            | Self::IntraProcessOverflow { .. }
            | Self::ReaderQueueOverflow { .. } => (DomainId(0), "", None, None),
            Self::LossyLink { .. } => (DomainId(0), "", None, None),
            Self::ClocksApart { peer, .. } => (DomainId(0), peer, None, None),
            Self::RestampingNode { node, .. } => (DomainId(0), node, None, None),
            Self::NearMiss { subscription, .. } => {
                (subscription.domain_id, &subscription.dds_name, None, None)
            }
            Self::SharedMemoryFault { fault, .. } => (DomainId(0), fault.label(), None, None),
            Self::SlowChain { from, .. } => (DomainId(0), from, None, None),
        }
    }
}

impl Unmatched {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::Qos => "qos",
            Self::Type => "type",
            Self::Partition => "partition",
            Self::NoEndpoint => "no_endpoint",
        }
    }
}

/// Returns the differences between two lists that are sorted by [`Diagnosis::cmp_identity`], in the
/// order of the lists.
pub fn changes<'a>(
    before: &'a [Diagnosis],
    after: &'a [Diagnosis],
) -> impl Iterator<Item = Change<'a>> {
    let (mut before, mut after) = (before.iter().peekable(), after.iter().peekable());
    std::iter::from_fn(move || {
        loop {
            let order = match (before.peek(), after.peek()) {
                (None, None) => return None,
                (Some(_), None) => Ordering::Less,
                (None, Some(_)) => Ordering::Greater,
                (Some(old), Some(new)) => old.cmp_identity(new),
            };
            match order {
                Ordering::Less => return before.next().map(Change::Resolved),
                Ordering::Greater => return after.next().map(Change::Appeared),
                Ordering::Equal => {
                    let (old, new) = (before.next(), after.next());
                    if let Some(new) = new.filter(|new| old != Some(*new)) {
                        return Some(Change::Changed(new));
                    }
                }
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::{EntityId, GuidPrefix};

    use super::*;

    fn guid(number: u8) -> Guid {
        Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, number, 3]))
    }

    fn unmatched(name: &str, writer: u8, reason: Unmatched) -> Diagnosis {
        Diagnosis::UnmatchedPublisher {
            topic: TopicKey {
                domain_id: DomainId(0),
                dds_name: format!("rt{name}").into(),
                name: name.into(),
                kind: TopicKind::Topic,
            },
            writer: guid(writer),
            reason,
        }
    }

    fn duplicate(node: &str) -> Diagnosis {
        Diagnosis::DuplicateNode {
            domain_id: DomainId(3),
            node: node.into(),
            participants: vec![guid(1), guid(2)],
        }
    }

    #[test]
    fn comparing_two_lists_yields_added_changed_and_removed_findings() {
        let before = [
            duplicate("/b"),
            unmatched("/a", 1, Unmatched::NoEndpoint),
            unmatched("/a", 2, Unmatched::NoEndpoint),
        ];
        let after = [
            duplicate("/a"),
            duplicate("/b"),
            unmatched("/a", 2, Unmatched::Qos),
            unmatched("/c", 1, Unmatched::NoEndpoint),
        ];
        assert!(before.is_sorted() && after.is_sorted());
        let seen: Vec<_> = changes(&before, &after).collect();
        let expected = [
            Change::Appeared(&after[0]),
            Change::Resolved(&before[1]),
            Change::Changed(&after[2]),
            Change::Appeared(&after[3]),
        ];
        assert_eq!(seen, expected);
        assert_eq!(changes(&after, &after).count(), 0);
    }

    #[test]
    fn comparing_identities_yields_the_order_of_the_list() {
        let mut all = [
            unmatched("/b", 1, Unmatched::NoEndpoint),
            unmatched("/a", 2, Unmatched::Qos),
            unmatched("/a", 1, Unmatched::Type),
            duplicate("/x"),
            Diagnosis::NodeInSeveralDomains {
                node: "/a".into(),
                participant: guid(1),
                domains: vec![DomainId(0), DomainId(5)],
            },
        ];
        all.sort_by(Diagnosis::cmp_identity);
        let ordered = all.is_sorted_by(|one, other| one.cmp_identity(other) == Ordering::Less);
        assert!(ordered);
        for kind in all.iter().map(Diagnosis::kind) {
            assert!(Diagnosis::KINDS.contains(&kind));
        }
    }
}
