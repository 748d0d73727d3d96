//! Chains by causality: publications within the callback that processes an input.
//!
//! A publication continues the latest hop that published on the topic of its input at most 10 ms
//! before the source timestamp of the input.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::{DomainId, Timestamp};

use super::expected::ExpectedChains;
use super::path::Paths;
use super::spans::ChainTracer;
use super::spans::causal::{Step, Traced};
use super::trace::{Method, Path, Point, Trace};
use crate::derive::trace::share::Share;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::tables::CausalPublications;

/// Time after which a publication that no other continues ends its chain.
const CHAIN_END_SILENCE: Duration = Duration::from_secs(2);
/// Time for which a publication is remembered, so that others can continue it.
const PUBLICATION_LIFETIME: Duration = Duration::from_secs(5);
/// Maximum time from the start of a publication to the source timestamp of its message.
const MAX_WRITE_DELAY: Duration = Duration::from_millis(10);
/// Number of latest publications that are searched for the hop before a publication.
const MAX_SEARCHED: usize = 2048;
/// Maximum number of hops of a chain.
const MAX_HOPS: usize = 31;

/// A publication within the callback that processes an input. Times are wall time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CausalPublication {
    /// Domain.
    pub domain_id: DomainId,
    /// Process id.
    pub process: u32,
    /// The node; `None` if it is not known.
    pub node: Option<NodeName>,
    /// Topic of the input.
    pub input: TopicName,
    /// Source timestamp of the input; 0 if it is not known.
    pub input_source: Timestamp,
    /// Time at which the process took the input from the middleware.
    pub taken: Timestamp,
    /// Begin of the callback.
    pub started: Timestamp,
    /// Topic of the output.
    pub output: TopicName,
    /// Time of the output's publication.
    pub published: Timestamp,
}

/// Publications that others may continue.
#[derive(Debug, Default)]
pub(super) struct Causality {
    /// Publications in the order of their arrival.
    publications: Bounded<CausalPublications, VecDeque<Hop>>,
}

/// A publication with the path to it.
#[derive(Debug)]
struct Hop {
    /// Time at which it was added.
    at: ModelTime,
    domain_id: DomainId,
    topics: Vec<(TopicName, Option<NodeName>)>,
    points: Vec<Point>,
    /// Spans that others continue, if its trace is exported.
    traced: Option<Traced>,
    /// Whether another publication continues it, or it has ended its chain.
    is_over: bool,
}

/// Facts about the input of a publication that begins a chain.
#[derive(Debug, Default)]
pub struct Origin {
    /// The node that publishes the input; `None` if it is unknown or one of several.
    pub node: Option<NodeName>,
    /// Share of the input's traces that is exported.
    pub share: Option<Share>,
}

/// The decision whether the trace of a publication is exported.
enum Decision {
    /// The publication begins a chain: the share of its input's traces decides.
    Share(Share),
    /// The publication continues this one, whose trace is exported.
    Hop(Traced),
}

impl Causality {
    /// Adds a publication. `origin` returns the facts about its input if it begins a chain.
    pub(super) fn add(
        &mut self,
        publication: &CausalPublication,
        now: ModelTime,
        origin: impl FnOnce() -> Origin,
        tracer: &mut ChainTracer,
    ) {
        let CausalPublication {
            domain_id,
            process: _,
            node,
            input,
            input_source,
            taken,
            started,
            output,
            published,
        } = publication;
        // The writer of the input may use another clock.
        let is_known = input_source.0 != 0;
        let input_published = if is_known {
            (*input_source).min(*taken)
        } else {
            *taken
        };
        let is_origin = |hop: &&mut Hop| {
            let end = hop.points.last().map(|point| point.published);
            hop.domain_id == *domain_id
                && hop.topics.last().is_some_and(|(topic, _)| topic == input)
                && end.is_some_and(|end| {
                    end <= *input_source && *input_source - end <= MAX_WRITE_DELAY
                })
        };
        let mut latest = self.publications.iter_mut().rev().take(MAX_SEARCHED);
        let before = latest.find(is_origin);
        let (mut topics, mut points, decision) = match before {
            Some(hop) if hop.points.len() <= MAX_HOPS => {
                hop.is_over = true;
                let decision = hop.traced.map(Decision::Hop);
                (hop.topics.clone(), hop.points.clone(), decision)
            }
            _ => {
                let point = Point {
                    published: input_published,
                    arrived: None,
                    started: None,
                };
                let Origin { node, share } = origin();
                let share = share.filter(|_| is_known).map(Decision::Share);
                (vec![(input.clone(), node)], vec![point], share)
            }
        };
        if let Some(point) = points.last_mut() {
            point.arrived = is_known.then(|| (*taken).max(point.published));
            point.started = Some((*started).max(*taken));
        }
        topics.push((output.clone(), node.clone()));
        points.push(Point {
            published: (*published).max(*started),
            arrived: None,
            started: None,
        });
        let source = topics.first().and_then(|(_, node)| node.as_ref());
        let traced = decision
            .zip(points.last_chunk())
            .and_then(|(decision, ends)| {
                let [input, output] = *ends;
                let step = Step {
                    publication,
                    source,
                    input,
                    output,
                };
                let latest = self.publications.iter().rev().take(MAX_SEARCHED);
                let known = latest.filter_map(|hop| hop.traced);
                match decision {
                    Decision::Share(share) => step.begin(share, known, tracer),
                    Decision::Hop(before) => Some(step.continue_spans(before, known, tracer)),
                }
            });
        self.publications.push_back(Hop {
            at: now,
            domain_id: *domain_id,
            topics,
            points,
            traced,
            is_over: false,
        });
    }

    /// Ends the chains of publications that no other has continued.
    pub(super) fn advance(
        &mut self,
        now: ModelTime,
        paths: &mut Paths,
        expected: &mut ExpectedChains,
    ) {
        let quiet = |hop: &&mut Hop| now - hop.at >= CHAIN_END_SILENCE;
        for hop in self.publications.iter_mut().filter(quiet) {
            hop.end(paths, expected);
        }
        while let Some(hop) = self.publications.front()
            && now - hop.at >= PUBLICATION_LIFETIME
        {
            self.publications.pop_front();
        }
    }

    /// Ends all chains at the end of the input.
    pub(super) fn settle(&mut self, paths: &mut Paths, expected: &mut ExpectedChains) {
        for mut hop in self.publications.take() {
            hop.end(paths, expected);
        }
    }
}

impl Hop {
    fn end(&mut self, paths: &mut Paths, expected: &mut ExpectedChains) {
        if std::mem::replace(&mut self.is_over, true) {
            return;
        }
        let path = Path {
            domain_id: self.domain_id,
            method: Method::Causality,
            topics: std::mem::take(&mut self.topics),
        };
        let trace = Trace {
            path: Arc::new(path),
            points: std::mem::take(&mut self.points),
            trace_id: self.traced.map(|traced| traced.trace_id()),
        };
        paths.add(trace, expected);
    }
}
