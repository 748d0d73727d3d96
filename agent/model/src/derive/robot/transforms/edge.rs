//! One edge of a tree of frames: its last transform, its rate, and its broadcasters.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::transforms::{Pose, Transform};
use ros2probe_wire::{Guid, SequenceNumber};

use super::{NAME, Origin, without_slash};
use crate::derive::robot::text::truncated_text;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::robot::{TransformFaultKind, TransformJump};
use crate::facts::tables::EdgeBroadcasters;

/// Seconds over which a rate is measured.
const RATE_SECONDS: usize = 10;
/// An edge is silent after this time, and after five of its longest intervals.
const SILENCE: Duration = Duration::from_secs(3);
const SILENT_INTERVALS: u32 = 5;
/// Two broadcasters are a fault if both have broadcast for at least this time, and the last
/// transform of each is not older than this.
const DUPLICATE_BROADCASTER_WINDOW: Duration = Duration::from_secs(5);
/// Static broadcasters repeat nothing: both are a fault after this time, in which the lease of one
/// that crashed ends.
const STATIC_DUPLICATE_DELAY: Duration = Duration::from_secs(45);
/// Time for which a stamp that went back is a fault.
const BACKWARD_STAMP_LIFETIME: Duration = Duration::from_secs(60);
/// Transforms before a jump is recognised.
const MIN_HISTORY: u32 = 10;
/// A jump is at least this many times as long as the longest of the latest steps.
const JUMP_FACTOR: f64 = 10.0;
/// Number of jumps that are a fault, and the time within which they are. A localisation corrects
/// itself less often.
const MIN_REPEATED_JUMPS: usize = 3;
const REPEATED_JUMP_WINDOW: Duration = Duration::from_secs(60);
/// Minimum of a jump in metres and in radians.
const MIN_JUMP_METRES: f64 = 0.3;
const MIN_JUMP_RADIANS: f64 = 0.5;

/// One edge.
#[derive(Debug, Default)]
pub(super) struct Edge {
    last: Option<LastTransform>,
    broadcasters: Bounded<EdgeBroadcasters, Vec<Source>>,
    /// Transforms so far.
    count: u64,
    /// Transforms by second, the current one last.
    seconds: [u32; RATE_SECONDS],
    /// Seconds that have ended, at most [`RATE_SECONDS`].
    ended: u8,
    /// Longest of the latest intervals; `None` after the first transform.
    interval: Option<Duration>,
    steps: Steps,
    jumps: Jumps,
    /// Times of the latest jumps of the pose, the last one last.
    jumped: [Option<ModelTime>; MIN_REPEATED_JUMPS],
    went_back: Option<ModelTime>,
}

/// The last transform.
#[derive(Clone, Debug)]
struct LastTransform {
    parent: Arc<str>,
    stamp: (i32, u32),
    pose: Pose,
    at: ModelTime,
    is_static: bool,
}

/// A broadcaster of the edge.
#[derive(Debug)]
struct Source {
    writer: Guid,
    node: Option<NodeName>,
    stamp: (i32, u32),
    since: ModelTime,
    at: ModelTime,
    /// Sequence number of its last message.
    number: SequenceNumber,
}

/// The longest of the latest steps between two transforms.
#[derive(Debug, Default)]
struct Steps {
    count: u32,
    metres: f64,
    radians: f64,
}

/// Number of jumps by kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Jumps {
    /// Jumps of the position.
    pub translation: u64,
    /// Jumps of the orientation.
    pub rotation: u64,
    /// Stamps before that of the same broadcaster's last transform.
    pub time: u64,
}

/// A node that broadcasts an edge.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broadcaster {
    /// Its writer.
    pub writer: Guid,
    /// The node, if known.
    pub node: Option<NodeName>,
}

/// Facts about one edge.
#[derive(Clone, Debug, PartialEq)]
pub struct EdgeFacts {
    /// Parent frame.
    pub parent: Arc<str>,
    /// Child frame.
    pub child: Arc<str>,
    /// Whether it is broadcast once, on `/tf_static`.
    pub is_static: bool,
    /// Its broadcasters, the last one first.
    pub broadcasters: Vec<Broadcaster>,
    /// Transforms that were seen.
    pub count: u64,
    /// Transforms per second over the last ten; `None` in the first second, and for a static edge.
    pub rate: Option<f64>,
    /// Longest of the latest times between two transforms; each transform shortens it by an eighth,
    /// until a longer one follows. `None` before the second transform, and for a static edge.
    pub longest_interval: Option<Duration>,
    /// Time of the last transform.
    pub at: ModelTime,
    /// Seconds and nanoseconds of its stamp.
    pub stamp: (i32, u32),
    /// The last transform.
    pub pose: Pose,
    /// Jumps.
    pub jumps: Jumps,
}

impl Edge {
    /// Returns whether it has no transform yet.
    pub(super) const fn is_new(&self) -> bool {
        self.last.is_none()
    }

    /// Returns the parent frame.
    pub(super) fn parent(&self) -> Arc<str> {
        self.last
            .as_ref()
            .map(|last| Arc::clone(&last.parent))
            .unwrap_or_default()
    }

    /// Adds a transform. Returns the kind of jump, or `None` if it is not a jump.
    pub(super) fn add(
        &mut self,
        origin: &Origin<'_>,
        transform: &Transform<'_>,
        is_static: bool,
    ) -> Option<TransformJump> {
        let parent = match &self.last {
            Some(last) if last.parent.as_bytes() == transform.parent => Arc::clone(&last.parent),
            _ => without_slash(&truncated_text(transform.parent, NAME)).into(),
        };
        self.count += 1;
        if let Some(current) = self.seconds.last_mut() {
            *current = current.saturating_add(1);
        }
        let mut sources = self.broadcasters.iter();
        if sources.any(|each| origin.precedes(each.writer, each.number)) {
            // A reader of a reliable topic has received it before the later ones.
            return None;
        }
        let went_back = self.note_broadcaster(origin, transform.stamp);
        let mut jump = None;
        if let Some(last) = self
            .last
            .as_ref()
            .filter(|last| last.parent == parent && !is_static)
        {
            let longest = self.interval.unwrap_or_default();
            self.interval = Some((origin.at - last.at).max(longest - longest / 8));
            jump = self.steps.add(&last.pose, &transform.pose);
            if jump.is_some() {
                self.jumped.rotate_left(1);
                if let Some(latest) = self.jumped.last_mut() {
                    *latest = Some(origin.at);
                }
            }
        }
        if went_back && !is_static {
            self.went_back = Some(origin.at);
            jump = Some(TransformJump::Time);
        }
        match jump {
            Some(TransformJump::Translation) => self.jumps.translation += 1,
            Some(TransformJump::Rotation) => self.jumps.rotation += 1,
            Some(TransformJump::Time) => self.jumps.time += 1,
            None => {}
        }
        self.last = Some(LastTransform {
            parent,
            stamp: transform.stamp,
            pose: transform.pose,
            at: origin.at,
            is_static,
        });
        jump
    }

    /// Notes the broadcaster. Returns whether its stamp went back.
    fn note_broadcaster(&mut self, origin: &Origin<'_>, stamp: (i32, u32)) -> bool {
        let place = self
            .broadcasters
            .iter()
            .position(|each| each.writer == origin.writer);
        if let Some(source) = place.and_then(|place| self.broadcasters.get_mut(place)) {
            let went_back = stamp < source.stamp;
            source.stamp = stamp;
            source.at = origin.at;
            source.number = origin.number;
            if source.node.is_none() {
                source.node = origin.node.cloned();
            }
            return went_back;
        }
        let new = Source {
            writer: origin.writer,
            node: origin.node.cloned(),
            stamp,
            since: origin.at,
            at: origin.at,
            number: origin.number,
        };
        if self.broadcasters.is_full() {
            let oldest = self.broadcasters.iter_mut().min_by_key(|each| each.at);
            if let Some(oldest) = oldest {
                *oldest = new;
            }
        } else {
            self.broadcasters.push(new);
        }
        false
    }

    /// Removes a broadcaster. Returns whether none is left.
    pub(super) fn forget(&mut self, writer: Guid) -> bool {
        self.broadcasters.retain(|each| each.writer != writer);
        self.broadcasters.is_empty()
    }

    /// Ends a second of the rate.
    pub(super) fn end_second(&mut self) {
        self.ended = self.ended.saturating_add(1).min(RATE_SECONDS as u8);
        self.seconds.rotate_left(1);
        if let Some(current) = self.seconds.last_mut() {
            *current = 0;
        }
    }

    /// Returns what is wrong with it.
    pub(super) fn fault(
        &self,
        now: ModelTime,
        is_unseen: &impl Fn(Guid) -> bool,
    ) -> Option<TransformFaultKind> {
        let last = self.last.as_ref()?;
        if self.has_several(last, now) {
            return Some(TransformFaultKind::SeveralBroadcasters);
        }
        if self
            .went_back
            .is_some_and(|at| now - at < BACKWARD_STAMP_LIFETIME)
        {
            return Some(TransformFaultKind::TimeWentBack);
        }
        let [earliest, ..] = self.jumped;
        if earliest.is_some_and(|at| now - at < REPEATED_JUMP_WINDOW) {
            return Some(TransformFaultKind::Jumps);
        }
        let limit = SILENCE.max(self.interval? * SILENT_INTERVALS);
        let mut writers = self.broadcasters.iter();
        let is_silent =
            !last.is_static && now - last.at > limit && !writers.any(|each| is_unseen(each.writer));
        is_silent.then_some(TransformFaultKind::Silent)
    }

    /// Returns the nodes that broadcast it, or their writers.
    pub(super) fn names(&self) -> Vec<Arc<str>> {
        let names = self.broadcasters.iter().map(|each| match &each.node {
            Some(node) => node.shared(),
            None => each.writer.to_string().into(),
        });
        names.collect()
    }

    /// Returns whether two broadcasters are at work.
    fn has_several(&self, last: &LastTransform, now: ModelTime) -> bool {
        let at_work = self
            .broadcasters
            .iter()
            .filter(|each| match last.is_static {
                true => now - each.since >= STATIC_DUPLICATE_DELAY,
                false => {
                    now - each.at < DUPLICATE_BROADCASTER_WINDOW
                        && each.at - each.since >= DUPLICATE_BROADCASTER_WINDOW
                }
            });
        at_work.count() > 1
    }

    pub(super) fn facts(&self, child: &Arc<str>, now: ModelTime) -> EdgeFacts {
        let last = self.last.clone().unwrap_or(LastTransform {
            parent: Arc::default(),
            stamp: (0, 0),
            pose: Pose {
                translation: [0.0; 3],
                rotation: [0.0, 0.0, 0.0, 1.0],
            },
            at: now,
            is_static: false,
        });
        let mut sources: Vec<_> = self.broadcasters.iter().collect();
        sources.sort_by_key(|each| std::cmp::Reverse(each.at));
        let ended = self.seconds.iter().rev().skip(1).take(self.ended.into());
        let sum: u32 = ended.sum();
        let rate = (self.ended > 0 && !last.is_static)
            .then(|| f64::from(sum) / f64::from(self.ended.min(RATE_SECONDS as u8 - 1)));
        EdgeFacts {
            parent: last.parent,
            child: Arc::clone(child),
            is_static: last.is_static,
            broadcasters: sources
                .into_iter()
                .map(|each| Broadcaster {
                    writer: each.writer,
                    node: each.node.clone(),
                })
                .collect(),
            count: self.count,
            rate,
            longest_interval: self.interval.filter(|_| !last.is_static),
            at: last.at,
            stamp: last.stamp,
            pose: last.pose,
            jumps: self.jumps,
        }
    }
}

impl Steps {
    /// Adds the step between two poses. Returns whether it is a jump.
    fn add(&mut self, before: &Pose, after: &Pose) -> Option<TransformJump> {
        let (metres, radians) = (distance(before, after), angle(before, after));
        if !metres.is_finite() || !radians.is_finite() {
            return None;
        }
        let is_known = self.count >= MIN_HISTORY;
        let jump = if is_known && metres > MIN_JUMP_METRES && metres > JUMP_FACTOR * self.metres {
            Some(TransformJump::Translation)
        } else if is_known && radians > MIN_JUMP_RADIANS && radians > JUMP_FACTOR * self.radians {
            Some(TransformJump::Rotation)
        } else {
            None
        };
        self.count = self.count.saturating_add(1);
        let decayed = |longest: f64| longest - longest / 64.0;
        self.metres = decayed(self.metres).max(metres);
        self.radians = decayed(self.radians).max(radians);
        jump
    }
}

/// Returns the distance between two positions, in metres.
fn distance(before: &Pose, after: &Pose) -> f64 {
    let pairs = before.translation.iter().zip(&after.translation);
    pairs
        .map(|(one, other)| (one - other).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// Returns the angle between two orientations, in radians.
fn angle(before: &Pose, after: &Pose) -> f64 {
    let pairs = before.rotation.iter().zip(&after.rotation);
    let product: f64 = pairs.map(|(one, other)| one * other).sum();
    2.0 * product.abs().min(1.0).acos()
}
