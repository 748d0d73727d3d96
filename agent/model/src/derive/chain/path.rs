//! Chains with the times of their latest messages.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::Timestamp;

use super::exemplar::Exemplars;
use super::expected::{ExpectedChains, ExpectedFacts};
use super::trace::{HopTimes, Path, Point, Trace};
use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted};
use crate::facts::histogram::Histogram;
use crate::facts::tables::{ChainPaths, ChainTraces};

/// Maximum number of topics in a chain.
pub const MAX_TOPICS: usize = 32;
/// Minimum number of messages of a chain that is shown.
const MIN_MESSAGES: u64 = 5;
/// Time without a message after which a new chain may replace a chain.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);

/// All chains with messages.
#[derive(Debug, Default)]
pub(super) struct Paths {
    paths: Bounded<Counted<ChainPaths>, BTreeMap<Arc<Path>, Progress>>,
}

/// The messages of one chain.
#[derive(Debug)]
struct Progress {
    traces: Arc<Bounded<ChainTraces, VecDeque<Vec<Point>>>>,
    count: u64,
    whole: Histogram,
    exemplars: Exemplars,
    hops: Vec<HopHistograms>,
    last: Timestamp,
}

/// Durations of a hop since the start.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HopHistograms {
    /// From the publication of the input to that of the output.
    pub whole: Histogram,
    /// Exemplars of `whole`.
    pub exemplars: Exemplars,
    /// From the publication of the input to its arrival at the node.
    pub transit: Histogram,
    /// From the arrival to the publication of the output.
    pub node: Histogram,
}

/// All chains as a snapshot shows them.
#[derive(Clone, Debug, Default)]
pub struct ChainsFacts {
    /// Chains from the first message to the last, without those that are part of another one;
    /// sorted by domain, method and topics.
    pub chains: Vec<ChainFacts>,
    /// Configured chains, in their order.
    pub expected: Vec<ExpectedFacts>,
}

/// One chain.
#[derive(Clone, Debug, PartialEq)]
pub struct ChainFacts {
    /// Its identity.
    pub path: Arc<Path>,
    /// Number of messages that passed the whole path.
    pub count: u64,
    /// The times of the latest 256 messages, one point for each topic.
    pub traces: Arc<Bounded<ChainTraces, VecDeque<Vec<Point>>>>,
    /// Durations from the first publication to the last.
    pub whole: Histogram,
    /// Exemplars of `whole`.
    pub exemplars: Exemplars,
    /// Durations of each hop.
    pub hops: Vec<HopHistograms>,
    /// Time of the latest publication on the last topic.
    pub last: Timestamp,
}

/// Quantiles of durations, in seconds, by nearest rank.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Quantiles {
    /// Number of durations.
    pub count: usize,
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// Quantiles of one hop; the parts are `None` if they were never observed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HopFigures {
    /// From the publication of the input to that of the output.
    pub whole: Quantiles,
    /// From the publication of the input to its arrival at the node.
    pub transit: Option<Quantiles>,
    /// From the arrival to the start of the callback.
    pub wait: Option<Quantiles>,
    /// From the start of the callback to the publication of the output.
    pub callback: Option<Quantiles>,
    /// From the arrival to the publication of the output.
    pub node: Option<Quantiles>,
}

impl Paths {
    /// Adds a message's path along accepted hops.
    pub(super) fn add(&mut self, trace: Trace, expected: &mut ExpectedChains) {
        expected.observe(&trace);
        self.add_found(trace);
    }

    /// Adds a message's path without regard to configured chains.
    pub(super) fn add_found(&mut self, trace: Trace) {
        let Trace {
            path,
            points,
            trace_id,
        } = trace;
        if path.topics.len() > MAX_TOPICS {
            self.paths.refuse();
            return;
        }
        let last = points.last().map_or(Timestamp(0), |point| point.published);
        if !self.paths.contains_key(&path) {
            if self.paths.keys().any(|known| known.contains(&path)) {
                return;
            }
            self.paths.retain(|known, _| !path.contains(known));
            let unnamed = self.paths.keys().find(|known| known.is_named_by(&path));
            if let Some(unnamed) = unnamed.map(Arc::clone)
                && let Some(progress) = self.paths.remove(&unnamed)
            {
                self.paths.insert(Arc::clone(&path), progress);
            }
            if self.paths.is_full() {
                self.paths
                    .retain(|_, known| known.last + IDLE_TIMEOUT > last);
            }
            if self.paths.is_full() && !self.paths.contains_key(&path) {
                self.paths.refuse();
                return;
            }
        }
        let hops = points.len().saturating_sub(1);
        let new = || Progress {
            traces: Arc::default(),
            count: 0,
            whole: Histogram::default(),
            exemplars: Exemplars::default(),
            hops: vec![HopHistograms::default(); hops],
            last,
        };
        if let Some(known) = self.paths.get_or_insert_with(path, new) {
            known.add(points, trace_id, last);
        }
    }

    pub(super) fn facts(&self, expected: &ExpectedChains, now: Timestamp) -> ChainsFacts {
        ChainsFacts {
            chains: self.shown(),
            expected: expected.facts(now),
        }
    }

    /// Returns the chains with enough messages.
    pub(super) fn shown(&self) -> Vec<ChainFacts> {
        let shown = self
            .paths
            .iter()
            .filter(|(_, each)| each.count >= MIN_MESSAGES);
        let chains = shown.map(|(path, progress)| ChainFacts {
            path: Arc::clone(path),
            count: progress.count,
            traces: Arc::clone(&progress.traces),
            whole: progress.whole,
            exemplars: progress.exemplars.clone(),
            hops: progress.hops.clone(),
            last: progress.last,
        });
        chains.collect()
    }

    pub(super) fn table(&self) -> TableFacts {
        self.paths.facts()
    }
}

impl Progress {
    fn add(&mut self, points: Vec<Point>, trace_id: Option<u128>, last: Timestamp) {
        if let (Some(first), Some(end)) = (points.first(), points.last()) {
            let whole = HopTimes::between(first, end).whole.as_secs_f64();
            let at = end.published;
            self.exemplars.observe(&mut self.whole, whole, trace_id, at);
        }
        for (ends, histograms) in points.windows(2).zip(&mut self.hops) {
            let [input, output] = ends else { continue };
            let times = HopTimes::between(input, output);
            let observe = |histogram: &mut Histogram, duration: Option<Duration>| {
                if let Some(duration) = duration {
                    histogram.observe(duration.as_secs_f64());
                }
            };
            let (whole, at) = (times.whole.as_secs_f64(), output.published);
            let exemplars = &mut histograms.exemplars;
            exemplars.observe(&mut histograms.whole, whole, trace_id, at);
            observe(&mut histograms.transit, times.transit);
            observe(&mut histograms.node, times.node);
        }
        let traces = Arc::make_mut(&mut self.traces);
        traces.push_back(points);
        self.count += 1;
        self.last = self.last.max(last);
    }
}

impl ChainFacts {
    /// Returns the quantiles of the time between the publications on two topics, given by their
    /// positions.
    #[must_use]
    pub fn between(&self, from: usize, to: usize) -> Quantiles {
        let duration = |points: &Vec<Point>| {
            let times = HopTimes::between(points.get(from)?, points.get(to)?);
            Some(times.whole)
        };
        Quantiles::of(self.traces.iter().filter_map(duration)).unwrap_or_default()
    }

    /// Returns the quantiles of the hop that begins with the topic at this position.
    #[must_use]
    pub fn hop(&self, position: usize) -> HopFigures {
        let times = self.traces.iter().filter_map(|points| {
            let (input, output) = (points.get(position)?, points.get(position + 1)?);
            Some(HopTimes::between(input, output))
        });
        let times: Vec<_> = times.collect();
        let part =
            |part: fn(&HopTimes) -> Option<Duration>| Quantiles::of(times.iter().filter_map(part));
        HopFigures {
            whole: part(|each| Some(each.whole)).unwrap_or_default(),
            transit: part(|each| each.transit),
            wait: part(|each| each.wait),
            callback: part(|each| each.callback),
            node: part(|each| each.node),
        }
    }
}

impl Quantiles {
    /// Returns the quantiles of these durations, or `None` without any duration.
    #[must_use]
    pub fn of(durations: impl Iterator<Item = Duration>) -> Option<Self> {
        let mut sorted: Vec<_> = durations.collect();
        sorted.sort_unstable();
        let rank = |percent: usize| {
            let rank = (sorted.len() * percent).div_ceil(100).max(1) - 1;
            sorted.get(rank).map(Duration::as_secs_f64)
        };
        Some(Self {
            count: sorted.len(),
            p50: rank(50)?,
            p99: rank(99)?,
            max: rank(100)?,
        })
    }
}
