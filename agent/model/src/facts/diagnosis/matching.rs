//! Whether a writer and a reader of one topic match: the request/offered rules of DDS (DDS 1.4,
//! 2.2.3; XTypes 1.3, 7.6.3.1.1), applied to their announcements.
//!
//! The result is the participants' own decision. Values that the specification does not define
//! never prevent a match, and neither do policies that an implementation does not check.

use std::fmt;
use std::str::Chars;
use std::time::Duration;

use ros2probe_wire::RtpsDuration;
use ros2probe_wire::qos::{DataRepresentation, Presentation, Qos};
use ros2probe_wire::rtps::VendorId;

/// A policy that a writer offers and a reader requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Policy {
    /// The reader requests reliable delivery; the writer is best effort.
    Reliability,
    /// The reader requests earlier samples; the writer keeps them for a shorter time.
    Durability,
    /// The reader requests a shorter period than the writer offers.
    Deadline,
    /// The writer's latency budget exceeds the reader's.
    LatencyBudget,
    /// The writer's liveliness kind is weaker, or its lease longer, than the reader requests.
    Liveliness,
    /// One endpoint uses exclusive ownership, the other shared.
    Ownership,
    /// The reader requests order by source timestamp; the writer does not offer it.
    DestinationOrder,
    /// The reader requests coherent or ordered access that the writer does not offer.
    Presentation,
    /// The reader does not accept the writer's data representation.
    DataRepresentation,
}

/// A set of policies.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Policies(u16);

/// The result for a writer and a reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// They match.
    Match,
    /// They do not match because they share no partition, which is intentional.
    Partition,
    /// They do not match because of these policies.
    Incompatible(Policies),
}

/// The properties of an endpoint that matching uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Offer<'a> {
    /// Quality of service.
    pub qos: &'a Qos,
    /// Implementation; some do not check all policies.
    pub vendor: VendorId,
}

impl Offer<'_> {
    /// Returns whether both implementations use the same protocol, RTPS or Zenoh. Otherwise the
    /// endpoints cannot discover each other.
    #[must_use]
    pub fn shares_protocol(self, other: Self) -> bool {
        (self.vendor == VendorId::ZENOH) == (other.vendor == VendorId::ZENOH)
    }
}

impl Policy {
    /// All policies.
    pub const ALL: [Self; 9] = [
        Self::Reliability,
        Self::Durability,
        Self::Deadline,
        Self::LatencyBudget,
        Self::Liveliness,
        Self::Ownership,
        Self::DestinationOrder,
        Self::Presentation,
        Self::DataRepresentation,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Reliability => "reliability",
            Self::Durability => "durability",
            Self::Deadline => "deadline",
            Self::LatencyBudget => "latency_budget",
            Self::Liveliness => "liveliness",
            Self::Ownership => "ownership",
            Self::DestinationOrder => "destination_order",
            Self::Presentation => "presentation",
            Self::DataRepresentation => "data_representation",
        }
    }

    /// Returns whether Fast DDS checks the policy. It announces three policies but ignores them.
    const fn is_checked_by_fast_dds(self) -> bool {
        !matches!(
            self,
            Self::LatencyBudget | Self::DestinationOrder | Self::Presentation
        )
    }

    fn is_satisfied(self, offered: &Qos, requested: &Qos) -> bool {
        /// Returns whether the offer is at least the request. Undefined values always suffice.
        fn at_least(offered: (u32, Option<&str>), requested: (u32, Option<&str>)) -> bool {
            offered.1.is_none() || requested.1.is_none() || offered.0 >= requested.0
        }
        macro_rules! at_least {
            ($policy:ident) => {{
                let (offered, requested) = (offered.$policy, requested.$policy);
                at_least((offered.0, offered.name()), (requested.0, requested.name()))
            }};
        }
        match self {
            Self::Reliability => at_least!(reliability),
            Self::Durability => at_least!(durability),
            Self::Deadline => within(offered.deadline, requested.deadline),
            Self::LatencyBudget => within(offered.latency_budget, requested.latency_budget),
            Self::Liveliness => {
                at_least!(liveliness)
                    && within(offered.liveliness_lease, requested.liveliness_lease)
            }
            Self::Ownership => {
                let kinds = [offered.ownership, requested.ownership];
                kinds.iter().any(|kind| kind.name().is_none())
                    || offered.ownership == requested.ownership
            }
            Self::DestinationOrder => at_least!(destination_order),
            Self::Presentation => presents(offered.presentation, requested.presentation),
            Self::DataRepresentation => {
                let first = offered.representations.first().copied();
                let used = first.unwrap_or(DataRepresentation::XCDR1);
                let read = &requested.representations;
                read.contains(&used) || read.is_empty() && used == DataRepresentation::XCDR1
            }
        }
    }
}

impl Policies {
    /// Adds a policy.
    pub const fn insert(&mut self, policy: Policy) {
        self.0 |= 1 << policy as u16;
    }

    /// Returns whether the set contains the policy.
    #[must_use]
    pub const fn contains(self, policy: Policy) -> bool {
        self.0 & (1 << policy as u16) != 0
    }

    /// Returns whether the set is empty.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Returns the policies in the order of [`Policy::ALL`].
    pub fn iter(self) -> impl Iterator<Item = Policy> {
        let all = Policy::ALL.into_iter();
        all.filter(move |policy| self.contains(*policy))
    }
}

impl fmt::Debug for Policies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_set().entries(self.iter()).finish()
    }
}

/// Decides whether this writer matches this reader of its topic and type.
#[must_use]
pub fn verdict(offered: Offer<'_>, requested: Offer<'_>) -> Verdict {
    let both = [offered.vendor, requested.vendor];
    if both.iter().all(|vendor| *vendor == VendorId::ZENOH) {
        // Zenoh has no request/offered rules: rmw_zenoh delivers whatever the QoS are.
        return Verdict::Match;
    }
    let all_fast = both.iter().all(|vendor| *vendor == VendorId::EPROSIMA);
    let mut policies = Policies::default();
    for policy in Policy::ALL {
        let is_checked = !all_fast || policy.is_checked_by_fast_dds();
        if is_checked && !policy.is_satisfied(offered.qos, requested.qos) {
            policies.insert(policy);
        }
    }
    if !have_common_partition(offered.qos, requested.qos) {
        // Different partitions are intentional, so other policies do not matter.
        Verdict::Partition
    } else if policies.is_empty() {
        Verdict::Match
    } else {
        Verdict::Incompatible(policies)
    }
}

/// Returns an upper bound of the steps that [`verdict`] takes for these two endpoints.
#[must_use]
pub fn effort(offered: &Qos, requested: &Qos) -> usize {
    let length = |qos: &Qos| -> usize { qos.partitions.iter().map(|name| name.len() + 1).sum() };
    1 + length(offered) * length(requested)
}

/// Returns whether the offer is at most the request. Implementations round differently between
/// nanoseconds and 2^-32 s, so a difference of one nanosecond is ignored.
fn within(offered: RtpsDuration, requested: RtpsDuration) -> bool {
    match (offered, requested) {
        (_, RtpsDuration::Infinite) => true,
        (RtpsDuration::Infinite, RtpsDuration::Finite(_)) => false,
        (RtpsDuration::Finite(offered), RtpsDuration::Finite(requested)) => {
            offered <= requested.saturating_add(Duration::from_nanos(1))
        }
    }
}

fn presents(offered: Presentation, requested: Presentation) -> bool {
    let scopes = [offered.access_scope, requested.access_scope];
    let is_wide_enough = scopes.iter().any(|scope| scope.name().is_none())
        || offered.access_scope >= requested.access_scope;
    is_wide_enough
        && (offered.is_coherent || !requested.is_coherent)
        && (offered.is_ordered || !requested.is_ordered)
}

/// Returns whether two endpoints share a partition (DDS 1.4, 2.2.3.13). Names match if they are
/// equal, or if one matches the other's pattern. Two patterns never match. An empty list is the
/// partition with the empty name.
fn have_common_partition(one: &Qos, other: &Qos) -> bool {
    fn names(qos: &Qos) -> impl Iterator<Item = &str> {
        let default = qos.partitions.is_empty().then_some("");
        qos.partitions.iter().map(AsRef::as_ref).chain(default)
    }
    names(one).any(|one| {
        names(other).any(|other| matches_pattern(one, other) || matches_pattern(other, one))
    })
}

/// Returns whether `name`, which is not a pattern, matches a name or a pattern of `*` and `?`.
fn matches_pattern(pattern: &str, name: &str) -> bool {
    let is_pattern = |text: &str| text.contains(['*', '?']);
    if is_pattern(name) || !is_pattern(pattern) {
        return pattern == name && !is_pattern(name);
    }
    let (mut pattern, mut name) = (pattern.chars(), name.chars());
    // Positions in pattern and name at which matching resumes after the last star.
    let mut retry: Option<(Chars<'_>, Chars<'_>)> = None;
    loop {
        let mut next = pattern.clone();
        match (next.next(), name.clone().next()) {
            (Some('*'), _) => {
                pattern = next;
                retry = Some((pattern.clone(), name.clone()));
                continue;
            }
            (Some(wanted), Some(found)) if wanted == '?' || wanted == found => {
                pattern = next;
                name.next();
                continue;
            }
            (None, None) => return true,
            _ => {}
        }
        let Some((behind, from)) = &mut retry else {
            return false;
        };
        if from.next().is_none() {
            return false;
        }
        (pattern, name) = (behind.clone(), from.clone());
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use ros2probe_wire::qos::{
        AccessScope, DestinationOrder, Durability, Liveliness, Ownership, Reliability, Role,
    };

    use super::*;

    /// Increases what a reader requests or a writer offers.
    type Demand = fn(&mut Qos);

    const CYCLONE: VendorId = VendorId::CYCLONE;
    const FAST: VendorId = VendorId::EPROSIMA;

    fn qos(role: Role) -> Qos {
        Qos::defaults(role, CYCLONE)
    }

    fn judge(offered: &Qos, requested: &Qos, vendors: [VendorId; 2]) -> Verdict {
        let [writer, reader] = vendors;
        let offered = Offer {
            qos: offered,
            vendor: writer,
        };
        let requested = Offer {
            qos: requested,
            vendor: reader,
        };
        verdict(offered, requested)
    }

    fn policies(offered: &Qos, requested: &Qos) -> Vec<Policy> {
        match judge(offered, requested, [CYCLONE; 2]) {
            Verdict::Match => Vec::new(),
            Verdict::Incompatible(policies) => policies.iter().collect(),
            Verdict::Partition => panic!("{offered:?} and {requested:?} are apart"),
        }
    }

    #[test]
    fn endpoints_with_default_qos_match() {
        assert_eq!(policies(&qos(Role::Writer), &qos(Role::Reader)), []);
    }

    /// Breaks each policy alone, then swaps both endpoints. The swapped pair matches, except for
    /// ownership and data representation, which must be equal.
    #[test]
    fn each_violated_policy_is_reported() {
        let weak = qos(Role::Writer);
        let breaking: [(Policy, Demand); 10] = [
            (Policy::Durability, |qos| {
                qos.durability = Durability::TRANSIENT_LOCAL;
            }),
            (Policy::Deadline, |qos| {
                qos.deadline = RtpsDuration::Finite(Duration::from_millis(5));
            }),
            (Policy::Liveliness, |qos| {
                qos.liveliness = Liveliness::MANUAL_BY_TOPIC;
            }),
            (Policy::Liveliness, |qos| {
                qos.liveliness_lease = RtpsDuration::Finite(Duration::from_nanos(1));
            }),
            (Policy::DestinationOrder, |qos| {
                qos.destination_order = DestinationOrder::BY_SOURCE_TIMESTAMP;
            }),
            (Policy::Presentation, |qos| {
                qos.presentation.access_scope = AccessScope::GROUP;
            }),
            (Policy::Presentation, |qos| {
                qos.presentation.is_coherent = true;
            }),
            (Policy::Presentation, |qos| {
                qos.presentation.is_ordered = true;
            }),
            (Policy::Ownership, |qos| {
                qos.ownership = Ownership::EXCLUSIVE;
            }),
            (Policy::DataRepresentation, |qos| {
                qos.representations = vec![DataRepresentation::XCDR2];
            }),
        ];
        for (policy, demand) in breaking {
            let mut strong = weak.clone();
            demand(&mut strong);
            assert_eq!(policies(&weak, &strong), [policy]);
            let is_symmetric = matches!(policy, Policy::Ownership | Policy::DataRepresentation);
            let reversed = policies(&strong, &weak);
            assert_eq!(reversed.is_empty(), !is_symmetric, "{policy:?}");
        }
        let mut late = weak.clone();
        late.latency_budget = RtpsDuration::Finite(Duration::from_nanos(1_000));
        assert_eq!(policies(&late, &weak), [Policy::LatencyBudget]);
        let mut best_effort = weak.clone();
        best_effort.reliability = Reliability::BEST_EFFORT;
        assert_eq!(policies(&best_effort, &weak), [Policy::Reliability]);
        assert_eq!(policies(&weak, &best_effort), []);
    }

    #[test]
    fn all_of_several_violated_policies_are_reported() {
        let (mut writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        writer.reliability = Reliability::BEST_EFFORT;
        reader.reliability = Reliability::RELIABLE;
        reader.durability = Durability::TRANSIENT_LOCAL;
        let expected = [Policy::Reliability, Policy::Durability];
        assert_eq!(policies(&writer, &reader), expected);
    }

    #[test]
    fn two_fast_dds_endpoints_ignore_three_policies() {
        let (writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        reader.presentation.is_ordered = true;
        reader.destination_order = DestinationOrder::BY_SOURCE_TIMESTAMP;
        assert_eq!(judge(&writer, &reader, [FAST; 2]), Verdict::Match);
        let mixed = judge(&writer, &reader, [FAST, CYCLONE]);
        assert!(matches!(mixed, Verdict::Incompatible(_)));
        reader.reliability = Reliability::RELIABLE;
        let mut writer = writer;
        writer.reliability = Reliability::BEST_EFFORT;
        let fast = judge(&writer, &reader, [FAST; 2]);
        let Verdict::Incompatible(policies) = fast else {
            panic!("{fast:?}");
        };
        assert_eq!(policies.iter().collect::<Vec<_>>(), [Policy::Reliability]);
    }

    #[test]
    fn two_zenoh_endpoints_match_with_any_qos() {
        let (mut writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        writer.reliability = Reliability::BEST_EFFORT;
        reader.reliability = Reliability::RELIABLE;
        let zenoh = [VendorId::ZENOH; 2];
        assert_eq!(judge(&writer, &reader, zenoh), Verdict::Match);
    }

    #[test]
    fn unknown_values_do_not_prevent_a_match() {
        let (writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        reader.durability = Durability(9);
        reader.ownership = Ownership(7);
        reader.presentation.access_scope = AccessScope(3);
        assert_eq!(policies(&writer, &reader), []);
    }

    #[test]
    fn a_reader_matches_if_it_lists_the_first_representation_of_the_writer() {
        let (mut writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        writer.representations = vec![DataRepresentation::XCDR2, DataRepresentation::XCDR1];
        assert_eq!(policies(&writer, &reader), [Policy::DataRepresentation]);
        reader.representations = vec![DataRepresentation::XCDR1, DataRepresentation::XCDR2];
        assert_eq!(policies(&writer, &reader), []);
        writer.representations.clear();
        assert_eq!(policies(&writer, &reader), []);
    }

    #[test]
    fn a_difference_of_one_nanosecond_does_not_prevent_a_match() {
        let (mut writer, mut reader) = (qos(Role::Writer), qos(Role::Reader));
        writer.deadline = RtpsDuration::Finite(Duration::from_nanos(100_000_001));
        reader.deadline = RtpsDuration::Finite(Duration::from_nanos(100_000_000));
        assert_eq!(policies(&writer, &reader), []);
        writer.deadline = RtpsDuration::Finite(Duration::from_nanos(100_000_002));
        assert_eq!(policies(&writer, &reader), [Policy::Deadline]);
    }

    #[test]
    fn partitions_match_by_name_or_by_the_pattern_of_one_side() {
        let within = |names: &[&str]| {
            let mut qos = qos(Role::Writer);
            qos.partitions = names.iter().map(|name| (*name).into()).collect();
            qos
        };
        for (one, other, expected) in [
            (&["a"][..], &["a"][..], true),
            (&["a"], &["b"], false),
            (&["a", "b"], &["c", "b"], true),
            (&[], &[""], true),
            (&[], &["*"], true),
            (&[], &["a"], false),
            (&["robot*"], &["robot1"], true),
            (&["robot*"], &["robot?"], false),
            (&["robot*"], &["robot*"], false),
            (&["r?b*t"], &["robot"], true),
            (&["r?b*t"], &["robots"], false),
            (&["*a*b"], &["aXaXb"], true),
        ] {
            let (one, other) = (within(one), within(other));
            assert_eq!(have_common_partition(&one, &other), expected, "{one:?}");
            assert_eq!(have_common_partition(&other, &one), expected, "{one:?}");
        }
        let apart = judge(&within(&["a"]), &within(&["b"]), [FAST; 2]);
        assert_eq!(apart, Verdict::Partition);
    }

    prop_compose! {
        fn any_qos()(
            kinds in [0_u32..4, 0..4, 0..3, 0..2, 0..2, 0..3],
            durations in proptest::array::uniform3(proptest::option::of(0_u64..4)),
            flags: [bool; 2],
            representations in proptest::collection::vec(0_i16..3, 0..3),
        ) -> Qos {
            let [reliability, durability, liveliness, ownership, order, scope] = kinds;
            // Durations differ by whole microseconds, far more than rounding does.
            let [deadline, budget, lease] = durations
                .map(|it| it.map_or(RtpsDuration::Infinite, |it| RtpsDuration::Finite(Duration::from_micros(it))));
            let mut qos = Qos::defaults(Role::Writer, CYCLONE);
            qos.reliability = Reliability(1 + reliability % 2);
            qos.durability = Durability(durability);
            qos.liveliness = Liveliness(liveliness);
            qos.ownership = Ownership(ownership);
            qos.destination_order = DestinationOrder(order);
            qos.presentation.access_scope = AccessScope(scope);
            [qos.presentation.is_coherent, qos.presentation.is_ordered] = flags;
            (qos.deadline, qos.latency_budget, qos.liveliness_lease) = (deadline, budget, lease);
            qos.representations = representations.into_iter().map(DataRepresentation).collect();
            qos
        }
    }

    proptest! {
        /// Compares with a second implementation, written after the specification's table.
        #[test]
        fn verdicts_agree_with_the_specification(offered in any_qos(), requested in any_qos()) {
            let used = *offered.representations.first().unwrap_or(&DataRepresentation::XCDR1);
            let mut read = requested.representations.clone();
            if read.is_empty() {
                read.push(DataRepresentation::XCDR1);
            }
            let expected = [
                offered.reliability.0 < requested.reliability.0,
                offered.durability.0 < requested.durability.0,
                offered.deadline > requested.deadline,
                offered.latency_budget > requested.latency_budget,
                offered.liveliness.0 < requested.liveliness.0
                    || offered.liveliness_lease > requested.liveliness_lease,
                offered.ownership.0 != requested.ownership.0,
                offered.destination_order.0 < requested.destination_order.0,
                offered.presentation.access_scope.0 < requested.presentation.access_scope.0
                    || !offered.presentation.is_coherent && requested.presentation.is_coherent
                    || !offered.presentation.is_ordered && requested.presentation.is_ordered,
                !read.contains(&used),
            ];
            let broken = policies(&offered, &requested);
            for (policy, expected) in Policy::ALL.into_iter().zip(expected) {
                prop_assert_eq!(broken.contains(&policy), expected, "{:?}", policy);
            }
        }

        /// Checks that "at least" is transitive. Representations and ownership have no order.
        #[test]
        fn matching_is_transitive(mut three in proptest::array::uniform3(any_qos())) {
            for qos in &mut three {
                qos.representations.clear();
            }
            let [one, two, three] = three;
            prop_assert_eq!(policies(&one, &one), []);
            if policies(&one, &two).is_empty() && policies(&two, &three).is_empty() {
                prop_assert_eq!(policies(&one, &three), []);
            }
        }

        /// Compares with a simple recursive matcher.
        #[test]
        fn patterns_match_as_in_a_naive_matcher(pattern in "[ab*?]{0,7}", name in "[ab]{0,7}") {
            fn naive(pattern: &[u8], name: &[u8]) -> bool {
                match (pattern.split_first(), name.split_first()) {
                    (None, None) => true,
                    (Some((b'*', rest)), _) if naive(rest, name) => true,
                    (Some((b'*', _)), Some((_, shorter))) => naive(pattern, shorter),
                    (Some((wanted, rest)), Some((found, shorter))) => {
                        (*wanted == b'?' || wanted == found) && naive(rest, shorter)
                    }
                    _ => false,
                }
            }
            let expected = naive(pattern.as_bytes(), name.as_bytes());
            prop_assert_eq!(matches_pattern(&pattern, &name), expected);
        }
    }
}
