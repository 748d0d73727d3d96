//! Evidence that a node's output continues one of its inputs, by equal stamps.
//!
//! Equal stamps alone prove little: timers round them, simulated time gives the same stamp to all
//! nodes, and inputs share stamps when one derives from the other. A message is therefore evidence
//! for at most one input of its node:
//!
//! - The input must have reached the node before the output was published.
//! - An input from which another candidate derives is not the cause; the other candidate is.
//! - Several remaining candidates are ambiguous, and none of them counts.
//! - A stamp that originates at several nodes is shared, and is not evidence.
//!
//! A hop is accepted after [`MIN_MATCHES`] matches, if the node's output mostly has the stamp of
//! some input and the input is hardly ever late.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::graph::{NodeView, Output};
use super::rates::Rates;
use super::spans::ChainTracer;
use super::spans::stamped::Stamped;
use super::stamps::{Group, Published, Stamp};
use super::trace::{Method, Path, Point, Trace, paths};
use crate::facts::bounded::Bounded;
use crate::facts::diagnosis::{Diagnosis, TopicKey};
use crate::facts::header::stamp_time;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::tables::{EvidenceInputs, EvidenceOutputs, LatestStamps};
use crate::measure::topic::TopicId;

/// Minimum number of matches of an accepted hop, for ordinary and for rounded stamps.
const MIN_MATCHES: u32 = 5;
const MIN_ROUNDED_MATCHES: u32 = 20;
/// Number of outputs after which all counts are halved, so that recent outputs prevail.
const HALVING_INTERVAL: u32 = 256;
/// A stamp that is a multiple of this many nanoseconds is rounded.
const ROUNDED_STAMP_UNIT: u32 = 100_000;
/// Minimum number of outputs of a node that is reported as re-stamping.
const MIN_RESTAMPED_OUTPUTS: u32 = 20;
/// A message whose age is below this many nanoseconds was stamped at publication.
const FRESH_AGE: i64 = 1_000_000;

/// Evidence about all outputs.
#[derive(Debug, Default)]
pub(super) struct Evidence {
    outputs: Bounded<EvidenceOutputs, BTreeMap<OutputKey, Counts>>,
    /// Capture time and stamp of the latest messages of each topic.
    latest: Bounded<EvidenceOutputs, BTreeMap<TopicId, LatestOfTopic>>,
}

/// Capture time and stamp of the latest messages of one topic.
type LatestOfTopic = Bounded<LatestStamps, VecDeque<(u64, u64)>>;

/// A node and a topic that it publishes.
type OutputKey = (TopicKey, NodeName);

/// Counts of one output.
#[derive(Debug)]
struct Counts {
    topic: TopicId,
    /// Messages with a stamp that was new on this topic.
    outputs: u32,
    /// Messages with the stamp of exactly one input.
    matched: u32,
    /// Messages with a rounded stamp.
    rounded: u32,
    /// Messages whose stamp was not seen on any input before.
    own: u32,
    /// Messages whose age was compared with that of the inputs, and messages with almost no age.
    aged: u32,
    fresh: u32,
    inputs: Bounded<EvidenceInputs, BTreeMap<TopicId, InputCounts>>,
}

/// Counts of one output and one input.
#[derive(Debug)]
struct InputCounts {
    name: TopicName,
    matched: u32,
    /// Messages with the same stamp that reached the node only after its output.
    late: u32,
    /// Fresh outputs that would be at least ten times as old with the stamp of this input.
    older: u32,
}

/// Messages with one stamp, in the order of their publication.
struct SameStamp<'a> {
    list: Vec<&'a Published>,
    /// The possible causes of each message, as a bit set.
    candidates: Vec<u64>,
    /// The cause of each message, if it is unambiguous.
    cause: Vec<Option<usize>>,
}

impl Evidence {
    /// Notes the age of a message in comparison with the latest inputs of its node.
    pub(super) fn stamped(&mut self, message: &Published, stamp: Stamp) {
        let Some(stamp) = stamp_time(stamp, message.published) else {
            return;
        };
        let (output, published) = (&message.output, message.published);
        if output.is_read {
            let latest = self
                .latest
                .get_or_insert_with(output.topic, Bounded::default);
            latest.map(|latest| latest.push_back((message.at.0, stamp.0)));
        }
        if output.node.inputs.is_empty() {
            return;
        }
        let age = published.nanoseconds_since(stamp);
        let Some(counts) = counts(&mut self.outputs, output) else {
            return;
        };
        counts.aged += 1;
        if !(0..FRESH_AGE).contains(&age) {
            return;
        }
        counts.fresh += 1;
        for (topic, name) in &output.node.inputs {
            let latest = self.latest.get(topic);
            let mut before = latest.into_iter().flatten().rev();
            let Some((_, stamp)) = before.find(|(at, _)| *at <= published.0) else {
                continue;
            };
            let kept = published.0.saturating_sub(*stamp);
            if kept >= u64::try_from(age).unwrap_or(0).saturating_mul(10)
                && let Some(input) = counts.input(*topic, name)
            {
                input.older += 1;
            }
        }
    }

    /// Drops the evidence about topics that no longer exist.
    pub(super) fn retain(&mut self, exists: impl Fn(TopicId) -> bool) {
        self.outputs.retain(|_, counts| exists(counts.topic));
        self.latest.retain(|topic, _| exists(*topic));
        for counts in self.outputs.values_mut() {
            counts.inputs.retain(|topic, _| exists(*topic));
        }
    }

    /// Evaluates the messages with one stamp. Returns the paths along accepted hops.
    pub(super) fn conclude(&mut self, mut group: Group, tracer: &mut ChainTracer) -> Vec<Trace> {
        group
            .messages
            .as_mut_slice()
            .sort_by_key(|message| message.published);
        let messages = SameStamp::of(&group.messages);
        let is_rounded = group.stamp.1.is_multiple_of(ROUNDED_STAMP_UNIT);
        let is_shared = group.is_crowded || messages.has_several_origins(is_rounded);
        for (index, message) in messages.list.iter().enumerate() {
            let Some(counts) = counts(&mut self.outputs, &message.output) else {
                continue;
            };
            counts.outputs += 1;
            counts.rounded += u32::from(is_rounded);
            counts.own += u32::from(messages.candidates.get(index) == Some(&0));
            let cause = messages.cause.get(index).copied().flatten();
            let cause = cause.filter(|_| !is_shared);
            if let Some(cause) = cause.and_then(|cause| messages.list.get(cause)) {
                counts.matched += 1;
                let Output { topic, key, .. } = &*cause.output;
                if let Some(input) = counts.input(*topic, &key.name) {
                    input.matched += 1;
                }
            }
            for late in messages.late(message) {
                let Output { topic, key, .. } = &*late.output;
                if let Some(input) = counts.input(*topic, &key.name) {
                    input.late += 1;
                }
            }
            if counts.outputs >= HALVING_INTERVAL {
                counts.halve();
            }
        }
        if is_shared {
            return Vec::new();
        }
        let causes = self.accepted(&messages);
        let stamped = Stamped {
            stamp: group.stamp,
            messages: &messages.list,
            causes: &causes,
        };
        let exported = stamped.trace(tracer);
        traces(&messages.list, &causes, &exported)
    }

    /// Returns the findings about nodes whose outputs have new stamps although their rate equals
    /// that of an input.
    pub(super) fn restamping(&self, rates: &Rates<'_>) -> Vec<Diagnosis> {
        let restamped = self.outputs.iter().filter_map(|((topic, node), counts)| {
            let enough =
                counts.outputs >= MIN_RESTAMPED_OUTPUTS && counts.aged >= MIN_RESTAMPED_OUTPUTS;
            let most = |count: u32, of: u32| u64::from(count) * 10 >= u64::from(of) * 9;
            let is_new = most(counts.own, counts.outputs) && most(counts.fresh, counts.aged);
            if !enough || !is_new || counts.matched > 0 {
                return None;
            }
            let mut inputs = counts.inputs.iter();
            let (_, input) = inputs.find(|(input, each)| {
                most(each.older, counts.aged) && rates.are_equal(**input, counts.topic)
            })?;
            Some(Diagnosis::RestampingNode {
                topic: topic.clone(),
                node: node.clone(),
                input: input.name.clone(),
            })
        });
        restamped.collect()
    }

    fn is_accepted(&self, cause: &Published, message: &Published) -> bool {
        let counts = key(&message.output).and_then(|key| self.outputs.get(&key));
        counts.is_some_and(|counts| counts.accepts(cause.output.topic))
    }

    /// Returns, for each message, the index of the message that it continues by an accepted hop.
    fn accepted(&self, messages: &SameStamp<'_>) -> Vec<Option<usize>> {
        let message = |index: usize| messages.list.get(index).copied();
        let accepted = |index: usize| {
            let cause = messages.cause.get(index).copied().flatten()?;
            let is_accepted = self.is_accepted(message(cause)?, message(index)?);
            is_accepted.then_some(cause)
        };
        (0..messages.list.len()).map(accepted).collect()
    }
}

impl Counts {
    fn new(topic: TopicId) -> Self {
        Self {
            topic,
            outputs: 0,
            matched: 0,
            rounded: 0,
            own: 0,
            aged: 0,
            fresh: 0,
            inputs: Bounded::default(),
        }
    }

    fn input(&mut self, topic: TopicId, name: &TopicName) -> Option<&mut InputCounts> {
        self.inputs.get_or_insert_with(topic, || InputCounts {
            name: name.clone(),
            matched: 0,
            late: 0,
            older: 0,
        })
    }

    /// Returns whether the output continues this input.
    fn accepts(&self, input: TopicId) -> bool {
        let Some(input) = self.inputs.get(&input) else {
            return false;
        };
        let share =
            |count: u32, percent: u64| u64::from(count) * 100 >= u64::from(self.outputs) * percent;
        let is_rounded = self.rounded * 2 > self.outputs;
        let (enough, late) = match is_rounded {
            true => (MIN_ROUNDED_MATCHES, 0),
            false => (MIN_MATCHES, input.matched / 50),
        };
        input.matched >= enough
            && input.late <= late
            && share(self.matched, 80)
            && share(input.matched, 10)
    }

    fn halve(&mut self) {
        let counts = [
            &mut self.outputs,
            &mut self.matched,
            &mut self.rounded,
            &mut self.own,
            &mut self.aged,
            &mut self.fresh,
        ];
        counts.into_iter().for_each(|count| *count /= 2);
        for input in self.inputs.values_mut() {
            let counts = [&mut input.matched, &mut input.late, &mut input.older];
            counts.into_iter().for_each(|count| *count /= 2);
        }
    }
}

impl<'a> SameStamp<'a> {
    /// Finds the candidates and the cause of each message. A topic's first message of each node
    /// counts; later ones with the same stamp repeat it.
    fn of(messages: &'a [Published]) -> Self {
        let mut list: Vec<&Published> = Vec::new();
        for message in messages {
            let is_same = |known: &Published| {
                known.output.topic == message.output.topic
                    && known.output.node.is_same(&message.output.node)
            };
            if !list.iter().any(|known| is_same(known)) {
                list.push(message);
            }
        }
        let mut found = Self {
            candidates: Vec::with_capacity(list.len()),
            cause: Vec::with_capacity(list.len()),
            list,
        };
        // All messages from which each message derives, as a bit set.
        let mut origins: Vec<u64> = Vec::with_capacity(found.list.len());
        for message in &found.list {
            let is_candidate =
                |other: &Published| reads(message, other) && precedes(other, message);
            let earlier = found.list.iter().take(origins.len()).enumerate();
            let candidates = earlier.filter(|(_, other)| is_candidate(other));
            let candidates = candidates.fold(0, |bits, (index, _)| bits | 1 << index);
            let inherited = |bits: u64| {
                let each = origins.iter().enumerate();
                let derived = each.filter(|(index, _)| bits & 1 << index != 0);
                derived.fold(0, |all, (_, origins)| all | origins)
            };
            let nearest = candidates & !inherited(candidates);
            let cause = (nearest.count_ones() == 1).then_some(nearest.trailing_zeros() as usize);
            origins.push(candidates | inherited(candidates));
            found.candidates.push(candidates);
            found.cause.push(cause);
        }
        found
    }

    /// Returns whether several nodes published the stamp without an input that had it. A node that
    /// reads unmeasured topics may have copied the stamp from them, unless the stamp is rounded.
    fn has_several_origins(&self, is_rounded: bool) -> bool {
        let mut origins: Vec<&Arc<NodeView>> = Vec::new();
        for (message, candidates) in self.list.iter().zip(&self.candidates) {
            let node = &message.output.node;
            if *candidates == 0
                && (node.is_complete || is_rounded)
                && !origins.iter().any(|known| known.is_same(node))
            {
                origins.push(node);
            }
        }
        origins.len() > 1
    }

    /// Returns the inputs with the same stamp that reached the node of the message after its
    /// publication.
    fn late(&self, message: &Published) -> impl Iterator<Item = &&'a Published> {
        self.list
            .iter()
            .filter(move |other| reads(message, other) && !precedes(other, message))
    }
}

/// Returns whether the message's node reads the other message's topic.
fn reads(message: &Published, other: &Published) -> bool {
    let (node, topic) = (&message.output.node, other.output.topic);
    topic != message.output.topic
        && node.inputs.contains_key(&topic)
        && !node.is_same(&other.output.node)
}

/// Returns whether the input reached the node of the output before the output was published.
fn precedes(input: &Published, output: &Published) -> bool {
    match input.arrival(output.output.node.prefix) {
        Some(arrival) => arrival <= output.published,
        None if input.sampled => input.published < output.published,
        None => {
            input.published < output.published
                && (input.at <= output.published || input.at <= output.began)
        }
    }
}

fn key(output: &Output) -> Option<OutputKey> {
    Some((output.key.clone(), output.node.name.clone()?))
}

fn counts<'a>(
    outputs: &'a mut Bounded<EvidenceOutputs, BTreeMap<OutputKey, Counts>>,
    output: &Output,
) -> Option<&'a mut Counts> {
    let key = key(output)?;
    if output.node.inputs.is_empty() {
        return None;
    }
    let counts = outputs.get_or_insert_with(key, || Counts::new(output.topic))?;
    if counts.topic != output.topic {
        // The topic vanished and came back, as when a robot is switched off for a while.
        *counts = Counts::new(output.topic);
    }
    Some(counts)
}

/// Returns the paths of messages that no accepted hop continues. `exported` has the trace of each
/// message with a span.
fn traces(
    messages: &[&Published],
    causes: &[Option<usize>],
    exported: &[Option<u128>],
) -> Vec<Trace> {
    let trace_of = |path: Vec<usize>| {
        // All messages of a path are in one trace.
        let trace_id = path.iter().find_map(|index| *exported.get(*index)?);
        let message = |index| messages.get(index).copied();
        let path: Vec<_> = path.into_iter().filter_map(message).collect();
        trace(&path, trace_id)
    };
    paths(causes).filter_map(trace_of).collect()
}

/// Returns the times of these messages, each of which caused the next.
fn trace(messages: &[&Published], trace_id: Option<u128>) -> Option<Trace> {
    let domain_id = messages.first()?.output.node.domain_id;
    let topic = |message: &&Published| {
        let Output { key, node, .. } = &*message.output;
        (key.name.clone(), node.name.clone())
    };
    let point = |(index, message): (usize, &&Published)| {
        let next = messages.get(index + 1);
        Point {
            published: message.published,
            arrived: next.and_then(|next| message.reached(next)),
            started: None,
        }
    };
    Some(Trace {
        path: Arc::new(Path {
            domain_id,
            method: Method::Stamps,
            topics: messages.iter().map(topic).collect(),
        }),
        points: messages.iter().enumerate().map(point).collect(),
        trace_id,
    })
}
