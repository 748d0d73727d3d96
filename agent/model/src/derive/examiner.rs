//! Finds problems of the graph: examines discovery and topics after changes, and keeps findings
//! within caps.

mod endpoints;
mod near;
mod nodes;

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::{DomainId, Guid};

use crate::derive::chain::Chains;
use crate::derive::clocks::Clocks;
use crate::derive::inside::Inside;
use crate::derive::robot::Robot;
use crate::derive::services::Services;
use crate::derive::stamps::Stamps;
use crate::facts::diagnosis::{Diagnoses, Diagnosis, QosPairs};
use crate::facts::model_time::ModelTime;
use crate::graph::discovery::Discovery;
use crate::measure::links::Links;
use crate::measure::topic::Topics;
use endpoints::{EndpointExaminer, UnmatchedEndpoint};
use near::LonelyTopics;

/// Time for which an endpoint may have no counterpart, because nodes start one after another.
const MATCH_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of findings kept of each kind.
const MAX_FINDINGS_PER_KIND: usize = 256;
/// Maximum number of series for incompatible pairs.
const MAX_QOS_PAIRS: usize = 1024;
/// Maximum number of steps per examination, and per topic. A step takes about ten nanoseconds.
const MAX_STEPS: usize = 500_000;
const MAX_STEPS_PER_TOPIC: usize = 50_000;

/// Examines the graph after each change.
#[derive(Debug, Default)]
pub struct Examiner {
    /// Revisions of discovery, hanging calls, findings from inside processes, chains, links,
    /// robot, clocks and stamps at the last examination.
    revision: Option<[u64; 8]>,
    /// Time at which the first unmatched endpoint becomes a finding.
    due: Option<ModelTime>,
    /// Time at which each unmatched endpoint was first found to be unmatched.
    unmatched_since: HashMap<Guid, ModelTime>,
    current: Arc<Diagnoses>,
    /// Time at which each finding appeared.
    since: Arc<Vec<ModelTime>>,
    left_out: u64,
}

/// Collects findings within the caps.
#[derive(Debug)]
struct Findings {
    list: Vec<Diagnosis>,
    counts: [usize; Diagnosis::KINDS.len()],
    qos_pairs: Vec<QosPairs>,
    left_out: u64,
    unexamined: u64,
    /// Remaining steps, in total and for this topic.
    steps: usize,
    steps_of_topic: usize,
}

impl Examiner {
    /// Returns the findings of the last examination.
    #[must_use]
    pub const fn current(&self) -> &Arc<Diagnoses> {
        &self.current
    }

    /// Returns the time at which each finding appeared, in the order of the findings.
    #[must_use]
    pub const fn since(&self) -> &Arc<Vec<ModelTime>> {
        &self.since
    }

    /// Returns the number of findings, their cap, and how many were omitted so far.
    #[must_use]
    pub fn size(&self) -> (usize, usize, u64) {
        let limit = MAX_FINDINGS_PER_KIND * Diagnosis::KINDS.len();
        (self.current.list.len(), limit, self.left_out)
    }

    /// Forces the next examination, even if discovery has not changed.
    pub fn forget(&mut self) {
        self.revision = None;
    }

    /// Examines the graph if it has changed since the last examination, or a deadline has passed.
    pub fn examine(
        &mut self,
        discovery: &Discovery,
        topics: &Topics,
        services: &Services,
        (inside, chains, links): (&Inside, &Chains, &Links),
        (robot, clocks, stamps): (&Robot, &Clocks, &Stamps),
        now: ModelTime,
    ) {
        let revision = Some([
            discovery.revision(),
            services.revision(),
            inside.revision(),
            chains.revision(),
            links.revision(),
            robot.revision(),
            clocks.revision(),
            stamps.revision(),
        ]);
        let is_due = self.due.is_some_and(|due| due <= now);
        if self.revision == revision && !is_due {
            return;
        }
        self.revision = revision;
        let mut findings = Findings::new();
        let endpoints = EndpointExaminer::new(discovery);
        let mut alone = HashMap::new();
        let mut due = None;
        let mut lonely = LonelyTopics::default();
        for (_, topic) in topics.iter() {
            for unmatched in endpoints.examine(topic, &mut findings) {
                let UnmatchedEndpoint { guid, diagnosis } = unmatched;
                let since = self.unmatched_since.get(&guid).copied().unwrap_or(now);
                alone.insert(guid, since);
                let end = since + MATCH_TIMEOUT;
                if end <= now {
                    lonely.add(&diagnosis, discovery, &mut findings);
                    findings.add(diagnosis);
                } else {
                    due = Some(due.map_or(end, |due: ModelTime| due.min(end)));
                }
            }
        }
        lonely.examine(discovery, &mut findings);
        nodes::examine(discovery, &mut findings);
        for (topic, writer) in services.hanging() {
            findings.add(Diagnosis::HangingCall { topic, writer });
        }
        for finding in inside.findings() {
            findings.add(finding);
        }
        for finding in links.findings() {
            findings.add(finding);
        }
        for finding in clocks.findings().chain(stamps.findings()) {
            findings.add(finding);
        }
        for finding in robot.findings() {
            findings.add(finding);
        }
        for finding in chains.findings() {
            findings.add(finding.clone());
        }
        (self.unmatched_since, self.due) = (alone, due);
        let found = findings.finish();
        let more = found.left_out.saturating_sub(self.current.left_out);
        self.left_out += more;
        if *self.current != found {
            self.since = Arc::new(since(&self.current.list, &self.since, &found.list, now));
            self.current = Arc::new(found);
        }
    }
}

/// Returns the time at which each finding in `after` appeared; known findings keep their time.
fn since(
    before: &[Diagnosis],
    times: &[ModelTime],
    after: &[Diagnosis],
    now: ModelTime,
) -> Vec<ModelTime> {
    let mut before = before.iter().zip(times).peekable();
    let mut found = Vec::with_capacity(after.len());
    for finding in after {
        while before
            .next_if(|(old, _)| old.cmp_identity(finding) == Ordering::Less)
            .is_some()
        {}
        let same = before.next_if(|(old, _)| old.cmp_identity(finding) == Ordering::Equal);
        found.push(same.map_or(now, |(_, time)| *time));
    }
    found
}

impl Findings {
    fn new() -> Self {
        Self {
            list: Vec::new(),
            counts: [0; Diagnosis::KINDS.len()],
            qos_pairs: Vec::new(),
            left_out: 0,
            unexamined: 0,
            steps: MAX_STEPS,
            steps_of_topic: 0,
        }
    }

    /// Adds a finding, unless its kind has reached the cap.
    fn add(&mut self, diagnosis: Diagnosis) {
        let kinds = Diagnosis::KINDS.iter().zip(&mut self.counts);
        let mut own = kinds.filter(|(kind, _)| **kind == diagnosis.kind());
        match own.next() {
            Some((_, count)) if *count < MAX_FINDINGS_PER_KIND => {
                *count += 1;
                self.list.push(diagnosis);
            }
            _ => self.left_out += 1,
        }
    }

    /// Counts findings that are omitted.
    const fn note_omitted(&mut self, count: u64) {
        self.left_out += count;
    }

    /// Starts the step budget of the next topic.
    const fn start_topic(&mut self) {
        self.steps_of_topic = MAX_STEPS_PER_TOPIC;
    }

    /// Spends steps; returns false if the budget is exhausted.
    const fn spend_steps(&mut self, steps: usize) -> bool {
        let may = steps <= self.steps && steps <= self.steps_of_topic;
        if may {
            self.steps -= steps;
            self.steps_of_topic -= steps;
        }
        may
    }

    fn finish(mut self) -> Diagnoses {
        // The second sort is stable, so findings with one identity keep a fixed order.
        self.list.sort_unstable();
        self.list.dedup();
        self.list.sort_by(Diagnosis::cmp_identity);
        let more = self.qos_pairs.len().saturating_sub(MAX_QOS_PAIRS);
        self.qos_pairs.truncate(MAX_QOS_PAIRS);
        Diagnoses {
            list: self.list,
            qos_pairs: self.qos_pairs,
            left_out: self.left_out + more as u64,
            unexamined: self.unexamined,
        }
    }
}

/// Returns the domains that are known only in part: some ROS participant has no announced endpoint
/// there, although every ROS participant has endpoints.
fn partly_known_domains(discovery: &Discovery) -> BTreeSet<DomainId> {
    let participants = discovery.participants().values();
    let silent = participants.filter(|participant| {
        participant.proxy.enclave.is_some() && participant.endpoints.is_empty()
    });
    silent.map(|participant| participant.domain_id).collect()
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::diagnostics::DiagnosticLevel;

    use super::*;
    use crate::facts::diagnosis::{Change, changes};
    use crate::facts::robot::{TransformFault, TransformFaultKind};
    use crate::facts::shared_memory::MemoryFault;

    /// Returns findings whose details are in another order than their identities.
    fn findings() -> Vec<Diagnosis> {
        let error = |node: &str, name: &str| Diagnosis::DiagnosticError {
            domain_id: DomainId(0),
            topic: "/diagnostics".into(),
            node: Some(node.into()),
            name: name.into(),
            hardware_id: "".into(),
            level: DiagnosticLevel::Error,
            message: "".into(),
        };
        let memory = |fault| Diagnosis::SharedMemoryFault { fault, figure: 1 };
        let transform = |parent: &str, kind| Diagnosis::TransformFault {
            domain_id: DomainId(0),
            namespace: "".into(),
            fault: TransformFault {
                child: "base_link".into(),
                parent: parent.into(),
                kind,
                edges: 1,
                names: Vec::new(),
            },
        };
        vec![
            error("/base", "motor"),
            error("/camera", "cam"),
            error("/camera", "lens"),
            transform("map", TransformFaultKind::Jumps),
            transform("odom", TransformFaultKind::Silent),
            transform("", TransformFaultKind::UnknownFrame),
            memory(MemoryFault::Full),
            memory(MemoryFault::Stale),
            memory(MemoryFault::Split),
        ]
    }

    fn finished(list: impl Iterator<Item = Diagnosis>) -> Vec<Diagnosis> {
        let mut findings = Findings::new();
        list.for_each(|finding| findings.add(finding));
        findings.finish().list
    }

    #[test]
    fn a_finding_that_ends_changes_no_other() {
        let all = finished(findings().into_iter());
        assert!(all.is_sorted_by(|one, next| one.cmp_identity(next) == Ordering::Less));
        for ended in findings() {
            let rest = finished(findings().into_iter().filter(|each| *each != ended));
            let seen: Vec<_> = changes(&all, &rest).collect();
            assert_eq!(seen, [Change::Resolved(&ended)]);
            let seen: Vec<_> = changes(&rest, &all).collect();
            assert_eq!(seen, [Change::Appeared(&ended)]);
        }
    }

    #[test]
    fn a_finding_keeps_its_time_when_its_text_changes() {
        let duplicate = |node: &str, participants: Vec<Guid>| Diagnosis::DuplicateNode {
            domain_id: DomainId(0),
            node: node.into(),
            participants,
        };
        let [a, b, c] = ["/a", "/b", "/c"].map(|node| duplicate(node, Vec::new()));
        let (one, two) = (
            ModelTime::from_nanoseconds(1),
            ModelTime::from_nanoseconds(2),
        );
        let first = since(&[], &[], std::slice::from_ref(&b), one);
        assert_eq!(first, [one]);
        let changed = duplicate("/b", vec![Guid::default()]);
        let second = since(
            std::slice::from_ref(&b),
            &first,
            &[a, changed, c.clone()],
            two,
        );
        assert_eq!(second, [two, one, two]);
        assert_eq!(
            since(
                &[b, c.clone()],
                &[one, two],
                &[c],
                ModelTime::from_nanoseconds(3)
            ),
            [two]
        );
    }
}
