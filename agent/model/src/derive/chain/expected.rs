//! Configured chains: the topics between their ends, and their latency compared with its limit.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::{DomainId, Timestamp};

use super::exemplar::Exemplars;
use super::graph::{INFRASTRUCTURE, is_stamped, key, owners};
use super::path::Quantiles;
use super::trace::{HopTimes, Method, Trace};
use crate::facts::bounded::Bounded;
use crate::facts::diagnosis::{Diagnosis, TopicKey};
use crate::facts::histogram::Histogram;
use crate::facts::names::{DdsName, TopicName};
use crate::facts::tables::{ExpectedProgress, ExpectedTimes};
use crate::facts::topic_kind::TopicKind;
use crate::graph::discovery::Discovery;
use crate::measure::topic::{TopicId, Topics};

/// Maximum number of configured chains.
pub const MAX_CHAINS: usize = 64;
/// Time over which a chain is compared with its limit, and the minimum number of messages for it.
const EVALUATION_WINDOW: Duration = Duration::from_secs(10);
const MIN_MESSAGES: usize = 5;

/// A configured chain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExpectedChain {
    /// Domain; `None` for every domain.
    pub domain_id: Option<DomainId>,
    /// ROS name of its first topic.
    pub from: TopicName,
    /// ROS name of its last topic.
    pub to: TopicName,
    /// Maximum time from the publication of the first message to that of the last.
    pub max_latency: Option<Duration>,
}

/// State of a configured chain in one domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChainState {
    /// No message took its path within the last 10 s.
    Idle,
    /// Its latency is within the limit, or it has no limit.
    Ok,
    /// The 99th percentile of its latency exceeds the limit.
    Slow,
}

/// A configured chain and its figures, by one method.
#[derive(Clone, Debug, PartialEq)]
pub struct ExpectedFacts {
    /// The chain as configured.
    pub chain: ExpectedChain,
    /// Domain in which messages took its path; `None` before the first.
    pub domain_id: Option<DomainId>,
    /// How its messages were recognised; `None` before the first.
    pub method: Option<Method>,
    /// Its state.
    pub state: ChainState,
    /// Durations since the start.
    pub histogram: Histogram,
    /// Exemplars of `histogram`.
    pub exemplars: Exemplars,
    /// Quantiles of the latest 256 durations.
    pub latency: Option<Quantiles>,
}

/// All configured chains.
#[derive(Debug, Default)]
pub(super) struct ExpectedChains {
    chains: Arc<Vec<ExpectedChain>>,
    /// Topics with a header that lie between the ends.
    topics: BTreeSet<(DomainId, DdsName)>,
    progress: Bounded<ExpectedProgress, BTreeMap<(usize, DomainId, Method), Progress>>,
}

/// Messages of a configured chain.
#[derive(Debug, Default)]
struct Progress {
    histogram: Histogram,
    exemplars: Exemplars,
    /// Times of the publications on the last and on the first topic.
    recent: Bounded<ExpectedTimes, VecDeque<(Timestamp, Timestamp)>>,
}

/// A node's topics in one domain.
#[derive(Default)]
struct Through {
    inputs: Vec<TopicId>,
    outputs: Vec<TopicId>,
}

impl ChainState {
    /// All states.
    pub const ALL: [Self; 3] = [Self::Idle, Self::Ok, Self::Slow];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Ok => "ok",
            Self::Slow => "slow",
        }
    }
}

impl ExpectedChains {
    pub(super) fn set(&mut self, chains: Arc<Vec<ExpectedChain>>) {
        let before = std::mem::replace(&mut self.chains, chains);
        let place = |index: &usize| {
            let chain = before.get(*index)?;
            self.chains
                .iter()
                .take(MAX_CHAINS)
                .position(|each| each == chain)
        };
        for ((index, domain_id, method), progress) in self.progress.take() {
            if let Some(index) = place(&index) {
                self.progress.insert((index, domain_id, method), progress);
            }
        }
    }

    pub(super) fn needs(&self, domain_id: DomainId, dds_name: &DdsName) -> bool {
        !self.topics.is_empty() && self.topics.contains(&(domain_id, dds_name.clone()))
    }

    /// Finds the topics between the ends of the chains. Returns the topics that were added or
    /// removed.
    pub(super) fn route(
        &mut self,
        discovery: &Discovery,
        topics: &Topics,
    ) -> BTreeSet<(DomainId, DdsName)> {
        let before = std::mem::take(&mut self.topics);
        if !self.chains.is_empty() {
            self.topics = between(&self.chains, discovery, topics);
        }
        before.symmetric_difference(&self.topics).cloned().collect()
    }

    /// Adds a message's path, if it has the ends of a configured chain.
    pub(super) fn observe(&mut self, trace: &Trace) {
        let path = &trace.path;
        for (index, chain) in self.chains.iter().take(MAX_CHAINS).enumerate() {
            if chain
                .domain_id
                .is_some_and(|domain_id| domain_id != path.domain_id)
            {
                continue;
            }
            let Some((from, to)) = path.section(&chain.from, &chain.to) else {
                continue;
            };
            let (Some(first), Some(last)) = (trace.points.get(from), trace.points.get(to)) else {
                continue;
            };
            let key = (index, path.domain_id, path.method);
            let Some(progress) = self.progress.get_or_insert_with(key, Progress::default) else {
                continue;
            };
            let pair = (last.published, first.published);
            // The paths to several ends may share this part.
            if progress
                .recent
                .iter()
                .rev()
                .take(16)
                .any(|known| *known == pair)
            {
                continue;
            }
            let whole = HopTimes::between(first, last).whole;
            let (histogram, exemplars) = (&mut progress.histogram, &mut progress.exemplars);
            let whole = whole.as_secs_f64();
            exemplars.observe(histogram, whole, trace.trace_id, last.published);
            progress.recent.push_back(pair);
        }
    }

    /// Returns a finding for each chain that exceeds its maximum latency at wall time `now`.
    pub(super) fn slow(&self, now: Timestamp) -> impl Iterator<Item = Diagnosis> {
        self.progress
            .iter()
            .filter_map(move |((index, domain_id, _), progress)| {
                let chain = self.chains.get(*index)?;
                let max_latency = chain.max_latency?;
                let is_slow = progress.state(chain, now) == ChainState::Slow;
                is_slow.then(|| Diagnosis::SlowChain {
                    topic: TopicKey {
                        domain_id: *domain_id,
                        dds_name: format!("rt{}", chain.to).into(),
                        name: chain.to.clone(),
                        kind: TopicKind::Topic,
                    },
                    from: chain.from.clone(),
                    max_latency,
                })
            })
    }

    pub(super) fn facts(&self, now: Timestamp) -> Vec<ExpectedFacts> {
        let mut facts = Vec::new();
        for (index, chain) in self.chains.iter().take(MAX_CHAINS).enumerate() {
            let own = self.progress.iter().filter(|((of, _, _), _)| *of == index);
            let before = facts.len();
            for ((_, domain_id, method), progress) in own {
                facts.push(ExpectedFacts {
                    chain: chain.clone(),
                    domain_id: Some(*domain_id),
                    method: Some(*method),
                    state: progress.state(chain, now),
                    histogram: progress.histogram,
                    exemplars: progress.exemplars.clone(),
                    latency: Quantiles::of(progress.durations()),
                });
            }
            if facts.len() == before {
                facts.push(ExpectedFacts {
                    chain: chain.clone(),
                    domain_id: chain.domain_id,
                    method: None,
                    state: ChainState::Idle,
                    histogram: Histogram::default(),
                    exemplars: Exemplars::default(),
                    latency: None,
                });
            }
        }
        facts
    }
}

impl Progress {
    fn durations(&self) -> impl Iterator<Item = Duration> {
        self.recent.iter().map(|(last, first)| *last - *first)
    }

    fn state(&self, chain: &ExpectedChain, now: Timestamp) -> ChainState {
        let recent = self
            .recent
            .iter()
            .filter(|(last, _)| *last + EVALUATION_WINDOW > now);
        let latency = Quantiles::of(recent.map(|(last, first)| *last - *first));
        let Some(latency) = latency else {
            return ChainState::Idle;
        };
        let is_slow = chain
            .max_latency
            .is_some_and(|max| latency.p99 > max.as_secs_f64());
        match is_slow && latency.count >= MIN_MESSAGES {
            true => ChainState::Slow,
            false => ChainState::Ok,
        }
    }
}

/// Returns the topics with a header on the paths through nodes from one end of a chain to the
/// other.
fn between(
    chains: &[ExpectedChain],
    discovery: &Discovery,
    topics: &Topics,
) -> BTreeSet<(DomainId, DdsName)> {
    let owners = owners(discovery);
    let mut nodes: HashMap<_, Through> = HashMap::new();
    for (id, topic) in topics.iter() {
        let name: &str = &topic.naming.name;
        if topic.naming.kind != TopicKind::Topic || INFRASTRUCTURE.contains(&name) {
            continue;
        }
        let owner = |guid: &ros2probe_wire::Guid| Some((guid.prefix, *owners.get(guid)?));
        for owner in topic.readers.iter().filter_map(owner) {
            nodes.entry(owner).or_default().inputs.push(id);
        }
        for owner in topic.writers.iter().filter_map(owner) {
            nodes.entry(owner).or_default().outputs.push(id);
        }
    }
    let nodes: Vec<_> = nodes.into_values().collect();
    let mut found = BTreeSet::new();
    for chain in chains.iter().take(MAX_CHAINS) {
        let named = |name: &TopicName| {
            let is_named = |(id, topic): (TopicId, &crate::measure::topic::Topic)| {
                let is_meant = topic.naming.name == *name
                    && topic.naming.kind == TopicKind::Topic
                    && chain
                        .domain_id
                        .is_none_or(|domain_id| domain_id == topic.domain_id);
                is_meant.then_some(id)
            };
            topics.iter().filter_map(is_named).collect::<BTreeSet<_>>()
        };
        let forward = reached(named(&chain.from), &nodes, |node| {
            (&node.inputs, &node.outputs)
        });
        let backward = reached(named(&chain.to), &nodes, |node| {
            (&node.outputs, &node.inputs)
        });
        for id in forward.intersection(&backward) {
            if let Some(topic) = topics.get(*id)
                && is_stamped(topic, discovery)
            {
                let key = key(topic);
                found.insert((key.domain_id, key.dds_name));
            }
        }
    }
    found
}

/// Returns the topics that can be reached from `begin` through nodes in one direction.
fn reached(
    begin: BTreeSet<TopicId>,
    nodes: &[Through],
    direction: impl Fn(&Through) -> (&Vec<TopicId>, &Vec<TopicId>),
) -> BTreeSet<TopicId> {
    let mut open: Vec<_> = begin.iter().copied().collect();
    let mut reached = begin;
    let mut next: HashMap<TopicId, Vec<&Vec<TopicId>>> = HashMap::new();
    for node in nodes {
        let (near, far) = direction(node);
        for topic in near {
            next.entry(*topic).or_default().push(far);
        }
    }
    while let Some(topic) = open.pop() {
        for far in next.get(&topic).into_iter().flatten() {
            open.extend(far.iter().filter(|id| reached.insert(**id)));
        }
    }
    reached
}
