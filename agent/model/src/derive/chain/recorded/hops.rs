//! Hops between recorded topics, and the paths of messages along them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::{DomainId, Timestamp};

use super::RecordedChains;
use super::Times;
use super::relation::{Relation, relation};
use crate::derive::chain::trace::{Method, Path, Point, Trace, paths};
use crate::facts::names::TopicName;

/// Minimum number of matches of an accepted hop.
const MIN_MATCHES: u64 = 5;
/// Messages of one stamp that are less than this many nanoseconds apart are published together.
const SIMULTANEOUS_NANOSECONDS: i64 = 1_000_000;
/// Maximum number of stamps from which the delays of three topics are computed.
const MAX_STAMPS: usize = 4096;

/// Results of the search for hops in a recording.
#[derive(Default)]
pub(super) struct Found {
    pub(super) traces: Vec<Trace>,
    pub(super) together: Vec<(TopicName, TopicName)>,
    pub(super) unclear: Vec<(TopicName, Vec<TopicName>)>,
}

/// The messages of each stamp with their times, in the order of these times.
type Stamps = Vec<Vec<(u16, Timestamp)>>;

/// How often two topics had the same stamp, and how often the first topic came before the second.
#[derive(Clone, Copy, Default)]
struct Pair {
    both: u64,
    before: u64,
}

type Pairs = HashMap<(u16, u16), Pair>;

/// Messages of a topic by their cause.
#[derive(Default)]
struct Causes {
    matched: BTreeMap<u16, u64>,
    /// Number of messages of which several topics may be the cause, and these topics.
    unclear: u64,
    candidates: BTreeSet<u16>,
}

/// Finds the hops, and the paths of messages along them.
pub(super) fn find(recorded: &RecordedChains, times: Times, preferred: &[&str]) -> Found {
    let mut stamps: Stamps = recorded.stamps(times).collect();
    let together = together(recorded, &stamps, preferred);
    for stamp in &mut stamps {
        join(stamp, &together);
    }
    let pairs = pairs(&stamps);
    let relations = relations(recorded, &stamps, &pairs);
    // The cause of each message of each stamp, by position.
    let mut chosen: Vec<Vec<Option<usize>>> = Vec::with_capacity(stamps.len());
    let mut causes: BTreeMap<u16, Causes> = BTreeMap::new();
    for stamp in &stamps {
        let mut of_stamp = Vec::with_capacity(stamp.len());
        for (place, (topic, at)) in stamp.iter().enumerate() {
            let earlier = stamp.iter().take(place).enumerate();
            let candidates: Vec<(usize, u16)> = earlier
                .filter(|(_, (input, before))| {
                    before < at && follows(recorded, &pairs, *input, *topic)
                })
                .map(|(place, (input, _))| (place, *input))
                .collect();
            let nearest = nearest(&candidates, *topic, &relations);
            let causes = causes.entry(*topic).or_default();
            let mut cause = None;
            match nearest.as_slice() {
                [] => {}
                [(place, input)] => {
                    *causes.matched.entry(*input).or_default() += 1;
                    cause = Some(*place);
                }
                several => {
                    causes.unclear += 1;
                    causes
                        .candidates
                        .extend(several.iter().map(|(_, input)| input));
                }
            }
            of_stamp.push(cause);
        }
        chosen.push(of_stamp);
    }
    let accepts = |input: u16, output: u16| {
        let causes = causes.get(&output);
        causes.is_some_and(|causes| causes.accepts(input, recorded.stamps_of(output)))
    };
    let mut found = Found::default();
    for (stamp, causes) in stamps.iter().zip(&chosen) {
        traces(recorded, stamp, causes, &accepts, &mut found.traces);
    }
    for (topic, causes) in &causes {
        let is_hop = causes.matched.keys().any(|input| accepts(*input, *topic));
        if causes.unclear >= MIN_MATCHES && !is_hop {
            let names = causes.candidates.iter().map(|input| recorded.name(*input));
            let unclear = (recorded.name(*topic), names.collect());
            found.unclear.push(unclear);
        }
    }
    let joined = together.into_iter();
    let joined = joined.map(|(topic, lead)| (recorded.name(topic), recorded.name(lead)));
    found.together = joined.collect();
    found.together.sort();
    found.unclear.sort();
    found
}

impl Causes {
    /// Returns whether the topic, which has `stamps` stamps, continues this input.
    fn accepts(&self, input: u16, stamps: u64) -> bool {
        let matched = self.matched.get(&input).copied().unwrap_or(0);
        let all: u64 = self.matched.values().sum();
        matched >= MIN_MATCHES && matched * 10 >= stamps && all * 5 >= stamps * 4
    }
}

/// Returns whether the output regularly follows the input with the same stamp, and hardly ever
/// precedes it.
fn follows(recorded: &RecordedChains, pairs: &Pairs, input: u16, output: u16) -> bool {
    pairs.get(&(input, output)).is_some_and(|pair| {
        let late = pair.both - pair.before;
        pair.before >= MIN_MATCHES
            && late * 50 <= pair.before
            && pair.before * 10 >= recorded.stamps_of(output)
    })
}

/// Removes the candidates that are not the direct cause.
fn nearest(
    candidates: &[(usize, u16)],
    output: u16,
    relations: &HashMap<[u16; 3], Relation>,
) -> Vec<(usize, u16)> {
    let relation = |one: u16, other: u16| relations.get(&[one, other, output]).copied();
    let is_direct = |(_, input): &&(usize, u16)| {
        candidates.iter().all(|(_, other)| {
            relation(*input, *other) != Some(Relation::Through)
                && relation(*other, *input) != Some(Relation::Beside)
        })
    };
    candidates.iter().filter(is_direct).copied().collect()
}

fn pairs(stamps: &Stamps) -> Pairs {
    let mut pairs = Pairs::new();
    for stamp in stamps {
        for (input, before) in stamp {
            for (output, at) in stamp.iter().filter(|(output, _)| output != input) {
                let pair = pairs.entry((*input, *output)).or_default();
                pair.both += 1;
                pair.before += u64::from(before < at);
            }
        }
    }
    pairs
}

/// Returns the relation of all triples whose topics follow each other.
fn relations(
    recorded: &RecordedChains,
    stamps: &Stamps,
    pairs: &Pairs,
) -> HashMap<[u16; 3], Relation> {
    let follows = |input: u16, output: u16| follows(recorded, pairs, input, output);
    let mut delays: HashMap<[u16; 3], Vec<(f64, f64)>> = HashMap::new();
    for stamp in stamps {
        for (place, (first, start)) in stamp.iter().enumerate() {
            let later = stamp.get(place + 1..).unwrap_or_default();
            for (place, (second, middle)) in later.iter().enumerate() {
                if !follows(*first, *second) {
                    continue;
                }
                for (third, end) in later.get(place + 1..).unwrap_or_default() {
                    if !follows(*first, *third) || !follows(*second, *third) {
                        continue;
                    }
                    let known = delays.entry([*first, *second, *third]).or_default();
                    if known.len() < MAX_STAMPS {
                        let delay = |at: &Timestamp| (*at - *start).as_secs_f64();
                        known.push((delay(middle), delay(end)));
                    }
                }
            }
        }
    }
    let relations = delays.into_iter();
    let relations = relations.map(|(topics, delays)| (topics, relation(&delays)));
    relations.collect()
}

/// Returns the topics that are published together with another one, each with the topic that
/// represents all of them.
fn together(recorded: &RecordedChains, stamps: &Stamps, preferred: &[&str]) -> BTreeMap<u16, u16> {
    // How often both topics had a stamp, how often less than 1 ms apart, and how often each came
    // first.
    let mut pairs: BTreeMap<(u16, u16), (u64, u64)> = BTreeMap::new();
    let mut led: BTreeMap<u16, u64> = BTreeMap::new();
    for stamp in stamps {
        for (place, (one, start)) in stamp.iter().enumerate() {
            for (other, end) in stamp.get(place + 1..).unwrap_or_default() {
                let pair = pairs.entry((*one.min(other), *one.max(other))).or_default();
                pair.0 += 1;
                let is_near = end.nanoseconds_since(*start).abs() < SIMULTANEOUS_NANOSECONDS;
                pair.1 += u64::from(is_near);
                *led.entry(*one).or_default() += u64::from(is_near);
            }
        }
    }
    let mut leads: BTreeMap<u16, u16> = BTreeMap::new();
    let lead_of =
        |leads: &BTreeMap<u16, u16>, topic: u16| leads.get(&topic).copied().unwrap_or(topic);
    for ((one, other), (both, near)) in &pairs {
        let fewest = recorded.stamps_of(*one).min(recorded.stamps_of(*other));
        if *both < MIN_MATCHES || both * 5 < fewest * 4 || near * 2 < *both {
            continue;
        }
        let (one, other) = (lead_of(&leads, *one), lead_of(&leads, *other));
        let rank = |topic: u16| {
            let name = recorded.name(topic);
            let is_preferred = preferred.contains(&name.as_str());
            let led = led.get(&topic).copied().unwrap_or(0);
            (is_preferred, led, std::cmp::Reverse(name))
        };
        let (lead, joined) = match rank(one) >= rank(other) {
            true => (one, other),
            false => (other, one),
        };
        if lead != joined {
            leads.insert(joined, lead);
            let mut all = leads.values_mut();
            while let Some(known) = all.find(|known| **known == joined) {
                *known = lead;
            }
        }
    }
    leads
}

/// Replaces the messages of topics that are published together by the first of these messages.
fn join(stamp: &mut Vec<(u16, Timestamp)>, together: &BTreeMap<u16, u16>) {
    let mut seen = BTreeSet::new();
    stamp.retain_mut(|(topic, _)| {
        *topic = together.get(topic).copied().unwrap_or(*topic);
        seen.insert(*topic)
    });
}

/// Adds the paths along accepted hops that no other hop continues.
fn traces(
    recorded: &RecordedChains,
    stamp: &[(u16, Timestamp)],
    causes: &[Option<usize>],
    accepts: &dyn Fn(u16, u16) -> bool,
    traces: &mut Vec<Trace>,
) {
    let topic = |place: usize| stamp.get(place).map(|(topic, _)| *topic);
    let accepted = |place: usize| {
        let cause = causes.get(place).copied().flatten()?;
        accepts(topic(cause)?, topic(place)?).then_some(cause)
    };
    let causes: Vec<_> = (0..stamp.len()).map(accepted).collect();
    for messages in paths(&causes) {
        let messages: Vec<_> = messages
            .into_iter()
            .filter_map(|place| stamp.get(place))
            .collect();
        let topics = messages
            .iter()
            .map(|(topic, _)| (recorded.name(*topic), None));
        let path = Path {
            domain_id: DomainId(0),
            method: Method::Stamps,
            topics: topics.collect(),
        };
        let point = |(_, at): &&(u16, Timestamp)| Point {
            published: *at,
            arrived: None,
            started: None,
        };
        traces.push(Trace {
            path: Arc::new(path),
            points: messages.iter().map(point).collect(),
            trace_id: None,
        });
    }
}
