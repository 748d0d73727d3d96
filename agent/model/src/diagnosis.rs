//! What is wrong with the graph, as far as discovery alone tells it: who cannot understand whom,
//! which names are taken twice, who talks to nobody.
//!
//! Found anew only when discovery changed, topic by topic, endpoints that are alike taken together,
//! within a budget of steps and a cap on what is kept: what did not fit is counted. A finding is a
//! value: two lists tell by comparison what came and what went ([`changes`]). Whether a finding is
//! worth waking somebody for is not decided here.

mod matching;

use std::cmp::Ordering;

use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::{DomainId, Guid};

use super::names::{DdsName, NodeName, TopicName, TypeName};
use super::topic_kind::TopicKind;
pub(crate) use matching::effort;
pub use matching::{Offer, Policies, Policy, Verdict, verdict};

/// Which topic a finding is about.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicKey {
    /// Its domain.
    pub domain_id: DomainId,
    /// Its DDS name: with the domain its identity.
    pub dds_name: DdsName,
    /// Its ROS name, or the DDS name.
    pub name: TopicName,
    /// What it is.
    pub kind: TopicKind,
}

/// One finding. What comes first in a variant identifies it, what comes last may change.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Diagnosis {
    /// Writer and reader of one topic and type do not talk because of what they ask of each other.
    QosIncompatible {
        /// Topic.
        topic: TopicKey,
        /// Who offers.
        writer: Guid,
        /// Who requests more.
        reader: Guid,
        /// In which policies.
        policies: Policies,
    },
    /// One topic with several types: those of different types do not talk.
    TypeConflict {
        /// Topic.
        topic: TopicKey,
        /// ROS types, sorted.
        types: Vec<TypeName>,
    },
    /// One type with several definitions: they do talk, and misread each other.
    TypeHashConflict {
        /// Topic.
        topic: TopicKey,
        /// ROS type.
        message_type: TypeName,
        /// RIHS01 hashes, sorted.
        hashes: Vec<TypeHash>,
    },
    /// Several nodes of one name in one domain.
    DuplicateNode {
        /// Domain.
        domain_id: DomainId,
        /// Fully qualified name.
        node: NodeName,
        /// The participant of each, sorted; one that has several of them is there as often.
        participants: Vec<Guid>,
    },
    /// A writer whose samples go to no reader.
    UnheardPublisher {
        /// Topic.
        topic: TopicKey,
        /// Who.
        writer: Guid,
        /// Why.
        reason: Unmatched,
    },
    /// A reader that gets samples of no writer.
    UnfedSubscriber {
        /// Topic.
        topic: TopicKey,
        /// Who.
        reader: Guid,
        /// Why.
        reason: Unmatched,
    },
    /// One node that is in several domains: half of its topics are where nobody looks for them.
    NodeInSeveralDomains {
        /// Fully qualified name.
        node: NodeName,
        /// One of its participants, the lowest.
        participant: Guid,
        /// Domains, sorted.
        domains: Vec<DomainId>,
    },
}

/// Why an endpoint has no counterpart: the reason that is nearest to a match.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Unmatched {
    /// Somebody is there whose quality of service does not fit.
    Qos,
    /// Somebody is there with another type.
    Type,
    /// Somebody is there in another partition.
    Partition,
    /// Nobody is there.
    Nobody,
}

/// Writers and readers of a topic that a policy keeps apart.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QosPairs {
    /// Topic.
    pub topic: TopicKey,
    /// In the way.
    pub policy: Policy,
    /// How many pairs, also of those that the list has no room for.
    pub pairs: u64,
}

/// All findings.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Diagnoses {
    /// Sorted, each once.
    pub list: Vec<Diagnosis>,
    /// Complete counts of incompatible pairs, sorted by topic and policy.
    pub qos_pairs: Vec<QosPairs>,
    /// Findings that the list has no room for.
    pub left_out: u64,
    /// Pairs of kinds of endpoints that were not looked at because there are too many.
    pub unexamined: u64,
}

/// How one finding differs between two lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change<'a> {
    /// It was not there before.
    Appeared(&'a Diagnosis),
    /// It is about the same, and says something else now.
    Changed(&'a Diagnosis),
    /// It is there no more; this is what it said last.
    Resolved(&'a Diagnosis),
}

impl Diagnosis {
    /// All kinds, as labels.
    pub const KINDS: [&'static str; 7] = [
        "qos_incompatible",
        "type_conflict",
        "type_hash_conflict",
        "duplicate_node",
        "unheard_publisher",
        "unfed_subscriber",
        "node_in_several_domains",
    ];

    /// Label value.
    #[must_use]
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::QosIncompatible { .. } => "qos_incompatible",
            Self::TypeConflict { .. } => "type_conflict",
            Self::TypeHashConflict { .. } => "type_hash_conflict",
            Self::DuplicateNode { .. } => "duplicate_node",
            Self::UnheardPublisher { .. } => "unheard_publisher",
            Self::UnfedSubscriber { .. } => "unfed_subscriber",
            Self::NodeInSeveralDomains { .. } => "node_in_several_domains",
        }
    }

    /// The topic it is about, if it is about one.
    #[must_use]
    pub const fn topic(&self) -> Option<&TopicKey> {
        match self {
            Self::QosIncompatible { topic, .. }
            | Self::TypeConflict { topic, .. }
            | Self::TypeHashConflict { topic, .. }
            | Self::UnheardPublisher { topic, .. }
            | Self::UnfedSubscriber { topic, .. } => Some(topic),
            Self::DuplicateNode { .. } | Self::NodeInSeveralDomains { .. } => None,
        }
    }

    /// By what they are about, whatever they say. In agreement with the order of the list.
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
    }

    /// What tells findings of one kind and topic apart.
    fn within_topic(&self) -> (DomainId, &str, Option<Guid>, Option<Guid>) {
        match self {
            Self::QosIncompatible { writer, reader, .. } => {
                (DomainId(0), "", Some(*writer), Some(*reader))
            }
            Self::TypeConflict { .. } => (DomainId(0), "", None, None),
            Self::TypeHashConflict { message_type, .. } => (DomainId(0), message_type, None, None),
            Self::DuplicateNode {
                domain_id, node, ..
            } => (*domain_id, node, None, None),
            Self::UnheardPublisher { writer, .. } => (DomainId(0), "", Some(*writer), None),
            Self::UnfedSubscriber { reader, .. } => (DomainId(0), "", Some(*reader), None),
            Self::NodeInSeveralDomains {
                node, participant, ..
            } => (DomainId(0), node, Some(*participant), None),
        }
    }
}

impl Unmatched {
    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Qos => "qos",
            Self::Type => "type",
            Self::Partition => "partition",
            Self::Nobody => "nobody",
        }
    }
}

/// What happened between two lists, in their order.
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

    fn unheard(name: &str, writer: u8, reason: Unmatched) -> Diagnosis {
        Diagnosis::UnheardPublisher {
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
    fn two_lists_tell_what_came_changed_and_went() {
        let before = [
            duplicate("/b"),
            unheard("/a", 1, Unmatched::Nobody),
            unheard("/a", 2, Unmatched::Nobody),
        ];
        let after = [
            duplicate("/a"),
            duplicate("/b"),
            unheard("/a", 2, Unmatched::Qos),
            unheard("/c", 1, Unmatched::Nobody),
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
    fn identity_agrees_with_the_order_of_the_list() {
        let mut all = [
            unheard("/b", 1, Unmatched::Nobody),
            unheard("/a", 2, Unmatched::Qos),
            unheard("/a", 1, Unmatched::Type),
            duplicate("/x"),
            Diagnosis::NodeInSeveralDomains {
                node: "/a".into(),
                participant: guid(1),
                domains: vec![DomainId(0), DomainId(5)],
            },
        ];
        all.sort();
        let ordered = all.is_sorted_by(|one, other| one.cmp_identity(other) == Ordering::Less);
        assert!(ordered);
        for kind in all.iter().map(Diagnosis::kind) {
            assert!(Diagnosis::KINDS.contains(&kind));
        }
    }
}
