//! Learns a watchlist from a healthy robot: the figures of its topics become expectations.
//!
//! [`Learner`] takes the agent's view of all topics about once a second, and counts each topic in
//! whole seconds. [`thresholds`] chooses expectations from these counts, and drops expectations
//! that the same seconds would violate. [`watchlist`] writes the file. Nothing here performs I/O or
//! reads a clock.

mod observation;
pub mod statistics;
pub mod thresholds;
pub mod watchlist;

use std::collections::BTreeMap;

use ros2probe_api::topics::{Topic, TopicList};
use ros2probe_daemon::config::{Limit, PatternError, check_pattern, glob};

use crate::ros2::name::is_hidden;
use observation::Observation;
use thresholds::TopicThresholds;

/// Maximum time to learn from, in seconds. It bounds the memory of a topic.
pub const MAX_SECONDS: u32 = 2 * 3600;
/// Maximum age of the state of an answer when the agent sends it, in seconds.
const MAX_STATE_AGE: f64 = 0.25;
/// Minimum time between two views, in seconds. An earlier view is skipped.
const MIN_STEP: f64 = 0.5;
/// Maximum time between two views, in seconds, that is split into seconds.
const MAX_STEP: f64 = 60.0;

/// Kinds of topics that a watch covers by their ROS name.
const WATCHABLE_KINDS: [&str; 4] = ["topic", "action_feedback", "action_status", "service_event"];

/// Names and globs of the topics to learn. If empty, all topics that `ros2 topic list` shows.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Selection(Vec<String>);

/// Counts of all selected topics.
#[derive(Debug)]
pub struct Learner {
    selection: Selection,
    topics: BTreeMap<String, Observation>,
    /// Time of the first and the last view, in Unix seconds.
    period: Option<(f64, f64)>,
    /// Request for the last view; `None` before the first one, and in a replay.
    latest_request: Option<Request>,
    /// Whole seconds that were counted.
    seconds: u32,
    /// Topics that a watch cannot name, or that are beyond the limit of watches.
    unwatchable: BTreeMap<String, &'static str>,
}

/// Result of learning.
#[derive(Clone, Debug, PartialEq)]
pub struct Learnt {
    /// The thresholds of each topic, by name.
    pub topics: Vec<TopicThresholds>,
    /// Time of the first and the last view, in Unix seconds.
    pub period: (f64, f64),
    /// Number of topics that no watch can name.
    pub unnamed: usize,
    /// Number of topics beyond the default limit of watches.
    pub beyond_limit: usize,
}

impl Selection {
    /// Validates names and globs. A relative name is in the root namespace.
    ///
    /// # Errors
    ///
    /// Returns the first text that is neither a ROS name nor a glob, with the reason.
    pub fn new(typed: &[String]) -> Result<Self, (String, PatternError)> {
        let absolute = |text: &String| {
            let name = match text.starts_with('/') || text.is_empty() {
                true => text.clone(),
                false => format!("/{text}"),
            };
            match check_pattern(&name) {
                Ok(()) => Ok(name),
                Err(error) => Err((text.clone(), error)),
            }
        };
        typed
            .iter()
            .map(absolute)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Returns the names and globs.
    #[must_use]
    pub fn patterns(&self) -> &[String] {
        &self.0
    }

    fn covers(&self, topic: &Topic<'_>) -> bool {
        if !WATCHABLE_KINDS.contains(&topic.kind.as_ref()) {
            return false;
        }
        if self.0.iter().any(|pattern| *pattern == topic.name) {
            return true;
        }
        let is_plain = topic.kind == "topic" && !topic.hidden && !is_hidden(&topic.name);
        let covers = |pattern: &String| glob::covers(pattern, &topic.name);
        is_plain && (self.0.is_empty() || self.0.iter().any(covers))
    }
}

/// When a view was requested, and when its answer was complete, in seconds by a clock without steps.
#[derive(Clone, Copy, Debug)]
pub struct Request {
    /// Begin of the request.
    pub sent: f64,
    /// End of the answer.
    pub answered: f64,
}

impl Learner {
    /// Creates a learner that has seen nothing.
    #[must_use]
    pub const fn new(selection: Selection) -> Self {
        Self {
            selection,
            topics: BTreeMap::new(),
            period: None,
            latest_request: None,
            seconds: 0,
            unwatchable: BTreeMap::new(),
        }
    }

    /// Returns the number of topics that were seen.
    #[must_use]
    pub fn topics(&self) -> usize {
        self.topics.len()
    }

    /// Returns the number of whole seconds that were counted.
    #[must_use]
    pub const fn seconds(&self) -> u32 {
        self.seconds
    }

    /// Returns the time of the last view, in Unix seconds.
    #[must_use]
    pub fn latest(&self) -> Option<f64> {
        self.period.map(|(_, last)| last)
    }

    /// Returns the names and globs that cover no topic so far.
    pub fn unseen(&self) -> impl Iterator<Item = &str> {
        let names = || self.topics.keys();
        let is_unseen = move |pattern: &&String| !names().any(|name| glob::covers(pattern, name));
        self.selection
            .0
            .iter()
            .filter(is_unseen)
            .map(String::as_str)
    }

    /// Counts what happened since the last view. A view that follows too early is skipped.
    /// `request` is when this client sent the request for the view, and had the answer, by a clock
    /// without steps; `None` if the robot's clock has none, as in a replay.
    pub fn observe(&mut self, list: &TopicList<'_>, request: Option<Request>) {
        let now = list.timestamp_seconds;
        // A busy agent repeats its last state.
        if self.latest() == Some(now) {
            return;
        }
        let Some(elapsed) = self.elapsed(now, request) else {
            // What was counted since the last view took an unknown time.
            self.latest_request = request;
            self.period = self.period.map(|(first, _)| (first, now));
            self.count(list, now, 0.0, 0);
            return;
        };
        if self.period.is_some() && elapsed < MIN_STEP {
            return;
        }
        let steps = whole_seconds(elapsed.min(MAX_STEP)).min(MAX_SECONDS - self.seconds);
        self.count(list, now, elapsed, steps);
        self.seconds += steps;
        for observation in self.topics.values_mut() {
            observation.complete(self.seconds);
        }
        let first = self.period.map_or(now, |(first, _)| first);
        self.period = Some((first, now));
        self.latest_request = request;
    }

    /// Returns the seconds since the last view by the robot's clock, which a late answer does not
    /// change; `None` if they are impossible, because the clock was set.
    fn elapsed(&self, now: f64, request: Option<Request>) -> Option<f64> {
        let by_robot = self.latest().map_or(0.0, |last| now - last);
        let Some((before, request)) = self.latest_request.zip(request) else {
            return Some(by_robot);
        };
        let shortest = request.sent - before.answered - MAX_STATE_AGE;
        let longest = request.answered - before.sent + MAX_STATE_AGE;
        (shortest..=longest).contains(&by_robot).then_some(by_robot)
    }

    /// Counts what happened since the last view in `steps` seconds; none: only from this view on.
    fn count(&mut self, list: &TopicList<'_>, now: f64, elapsed: f64, steps: u32) {
        for topic in &list.topics {
            if self.selection.covers(topic)
                && let Some(observation) = self.observation(&topic.name)
            {
                observation.observe(topic, now, elapsed, steps);
            }
        }
    }

    /// Returns the thresholds of each topic. `None` if less than one second was seen.
    #[must_use]
    pub fn finish(&self) -> Option<Learnt> {
        let period = self.period.filter(|_| self.seconds > 0)?;
        let count = |wanted: &str| {
            self.unwatchable
                .values()
                .filter(|why| **why == wanted)
                .count()
        };
        let topics = self.topics.iter();
        Some(Learnt {
            topics: topics
                .map(|(name, observation)| thresholds::choose_thresholds(name, observation))
                .collect(),
            period,
            unnamed: count(UNWATCHABLE_REASON),
            beyond_limit: count(LIMIT_REASON),
        })
    }

    /// Returns the counts of a topic; `None` if no watch can name it, or if too many topics are
    /// known.
    fn observation(&mut self, name: &str) -> Option<&mut Observation> {
        let limit = Limit::Watches.row().default;
        if !self.topics.contains_key(name) {
            let why = match (check_pattern(name).is_err(), self.topics.len() >= limit) {
                (true, _) => Some(UNWATCHABLE_REASON),
                (_, true) => Some(LIMIT_REASON),
                _ => None,
            };
            if let Some(why) = why {
                if self.unwatchable.len() < limit {
                    self.unwatchable.insert(name.to_owned(), why);
                }
                return None;
            }
            let observation = Observation::new(self.seconds);
            self.topics.insert(name.to_owned(), observation);
        }
        self.topics.get_mut(name)
    }
}

const UNWATCHABLE_REASON: &str = "no watch can name it";
const LIMIT_REASON: &str = "limits.watches";

/// Rounds a time of 0 to 60 s to whole seconds.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "from 0 to 60"
)]
fn whole_seconds(seconds: f64) -> u32 {
    seconds.max(0.0).round() as u32
}

#[cfg(test)]
mod tests;
