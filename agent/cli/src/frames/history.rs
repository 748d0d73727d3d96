//! Moving transforms of the last ten seconds, and their poses at one time.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_api::transforms::TransformTree;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::transforms::Transforms;

use super::{Pose, dot};
use crate::tables::{FrameEdges, FramePoses};

/// Time for which a transform is kept after its stamp, as `tf2_ros::Buffer` keeps it by default.
const TRANSFORM_LIFETIME: Duration = Duration::from_secs(10);

/// A time of the broadcasters' clock in nanoseconds.
pub(super) type Stamp = i64;

/// Returns a stamp of seconds and nanoseconds.
pub(super) fn stamp_of((seconds, nanoseconds): (i32, u32)) -> Stamp {
    Stamp::from(seconds) * 1_000_000_000 + Stamp::from(nanoseconds)
}

/// The transforms of each edge, by child frame.
#[derive(Debug, Default)]
pub struct History {
    edges: Bounded<FrameEdges, HashMap<Box<str>, Poses>>,
}

/// The transforms of an edge in the order of their stamps.
type Poses = Bounded<FramePoses, VecDeque<Stamped>>;

#[derive(Debug)]
struct Stamped {
    stamp: Stamp,
    parent: Arc<str>,
    pose: Pose,
}

impl History {
    /// Adds the transforms of a `tf2_msgs/msg/TFMessage`, encapsulation header included. Ignores
    /// what is malformed, which the agent reports.
    pub fn read(&mut self, payload: &[u8]) {
        let transforms = Transforms::parse(payload).into_iter().flatten();
        for transform in transforms.map_while(Result::ok) {
            let [parent, child] = [transform.parent, transform.child].map(String::from_utf8_lossy);
            let pose = Pose {
                translation: transform.pose.translation,
                rotation: transform.pose.rotation,
            };
            self.add([&parent, &child], transform.stamp, pose);
        }
    }

    /// Adds the last transform of each moving edge.
    pub fn add_last(&mut self, tree: &TransformTree<'_>) {
        for edge in tree.edges.iter().filter(|edge| !edge.is_static) {
            let stamp = (edge.stamp_sec, edge.stamp_nanosec);
            self.add([&edge.parent, &edge.child], stamp, Pose::of(edge));
        }
    }

    fn add(&mut self, frames: [&str; 2], stamp: (i32, u32), pose: Pose) {
        let [parent, child] = frames.map(|frame| frame.trim_start_matches('/'));
        if !self.edges.contains_key(child) {
            if self.edges.is_full() {
                self.edges.refuse();
                return;
            }
            self.edges.insert(child.into(), Poses::default());
        }
        let Some(poses) = self.edges.get_mut(child) else {
            return;
        };
        let (stamp, kept) = (stamp_of(stamp), TRANSFORM_LIFETIME.as_nanos() as Stamp);
        if poses.back().is_some_and(|last| stamp < last.stamp - kept) {
            // The broadcasters' clock went back, as at the start of another simulation.
            poses.clear();
        }
        let newest = poses.back().map_or(stamp, |last| last.stamp);
        let place = poses.partition_point(|other| other.stamp < stamp);
        // The first transform of a stamp counts.
        if poses.get(place).is_some_and(|other| other.stamp == stamp) {
            return;
        }
        let mut place = place;
        if poses.is_full() && poses.pop_front().is_some() {
            place = place.saturating_sub(1);
        }
        let parent = match poses.back() {
            Some(last) if &*last.parent == parent => Arc::clone(&last.parent),
            _ => parent.into(),
        };
        poses.insert(
            place,
            Stamped {
                stamp,
                parent,
                pose,
            },
        );
        let newest = newest.max(stamp);
        while poses
            .front()
            .is_some_and(|first| first.stamp < newest - kept)
        {
            poses.pop_front();
        }
    }

    /// Returns the pose of a frame in its parent at this time: one that was broadcast, or one
    /// between two of them. `None` if the time is before the first one or after the last one.
    pub(super) fn pose_at(&self, child: &str, time: Stamp) -> Option<Pose> {
        let poses = self.edges.get(child)?;
        let place = poses.partition_point(|other| other.stamp < time);
        let after = poses.get(place)?;
        if after.stamp == time {
            return Some(after.pose);
        }
        let before = poses.get(place.checked_sub(1)?)?;
        if before.parent != after.parent {
            return Some(before.pose);
        }
        let ratio = (time - before.stamp) as f64 / (after.stamp - before.stamp) as f64;
        Some(interpolated(&before.pose, &after.pose, ratio))
    }
}

/// Returns the pose at this ratio of the way from one to the other: its position on a line, and its
/// orientation on the shortest arc (slerp).
fn interpolated(before: &Pose, after: &Pose, ratio: f64) -> Pose {
    let mut translation = before.translation;
    for (from, to) in translation.iter_mut().zip(after.translation) {
        *from = (1.0 - ratio) * *from + ratio * to;
    }
    let product = dot(before.rotation, after.rotation);
    let lengths = dot(before.rotation, before.rotation) * dot(after.rotation, after.rotation);
    let angle = (product.abs() / lengths.sqrt()).min(1.0).acos();
    let mut rotation = before.rotation;
    if angle.sin() > 0.0 {
        let sign = if product < 0.0 { -1.0 } else { 1.0 };
        let (one, other) = ((1.0 - ratio) * angle, ratio * angle);
        for (from, to) in rotation.iter_mut().zip(after.rotation) {
            *from = (*from * one.sin() + sign * to * other.sin()) / angle.sin();
        }
    }
    Pose {
        translation,
        rotation,
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    fn pose(x: f64, turn: f64) -> Pose {
        Pose {
            translation: [x, 0.0, 0.0],
            rotation: [0.0, 0.0, (turn / 2.0).sin(), (turn / 2.0).cos()],
        }
    }

    fn assert_close(pose: Option<Pose>, expected: Pose) {
        let pose = pose.unwrap();
        let numbers = |pose: Pose| [&pose.translation[..], &pose.rotation[..]].concat();
        for (number, expected) in numbers(pose).iter().zip(numbers(expected)) {
            assert!((number - expected).abs() < 1e-12, "{pose:?}");
        }
    }

    #[test]
    fn a_pose_between_two_is_on_the_line_and_on_the_shortest_arc() {
        let mut history = History::default();
        let edge = ["odom", "/base"];
        history.add(edge, (10, 0), pose(1.0, 0.0));
        // The opposite quaternion is the same rotation.
        let opposite = Pose {
            rotation: pose(3.0, FRAC_PI_2).rotation.map(|number| -number),
            ..pose(3.0, 0.0)
        };
        history.add(edge, (12, 0), opposite);
        let at = |nanoseconds| history.pose_at("base", nanoseconds);
        assert_close(at(10_500_000_000), pose(1.5, FRAC_PI_2 / 4.0));
        assert_eq!(at(10_000_000_000), Some(pose(1.0, 0.0)));
        assert_eq!(at(12_000_000_000), Some(opposite));
        assert_eq!(at(9_999_999_999), None, "before the first one");
        assert_eq!(at(12_000_000_001), None, "after the last one");
        assert_eq!(history.pose_at("odom", 10_000_000_000), None);
    }

    #[test]
    fn a_late_transform_is_put_in_order_and_a_repeated_one_ignored() {
        let mut history = History::default();
        let edge = ["odom", "base"];
        for (seconds, x) in [(10, 0.0), (12, 2.0), (11, 5.0), (11, 9.0)] {
            history.add(edge, (seconds, 0), pose(x, 0.0));
        }
        assert_close(history.pose_at("base", 10_500_000_000), pose(2.5, 0.0));
        assert_close(history.pose_at("base", 11_500_000_000), pose(3.5, 0.0));
    }

    #[test]
    fn a_frame_keeps_its_former_parent_until_the_next_transform() {
        let mut history = History::default();
        history.add(["odom", "base"], (10, 0), pose(1.0, 0.0));
        history.add(["map", "base"], (12, 0), pose(7.0, 0.0));
        assert_eq!(
            history.pose_at("base", 11_000_000_000),
            Some(pose(1.0, 0.0))
        );
    }

    #[test]
    fn transforms_are_dropped_after_ten_seconds_or_when_their_clock_steps_back() {
        let mut history = History::default();
        let edge = ["odom", "base"];
        history.add(edge, (10, 0), pose(1.0, 0.0));
        history.add(edge, (20, 0), pose(2.0, 0.0));
        assert!(history.pose_at("base", 10_000_000_000).is_some());
        history.add(edge, (20, 1), pose(2.0, 0.0));
        assert_eq!(history.pose_at("base", 10_000_000_000), None);
        history.add(edge, (3, 0), pose(3.0, 0.0));
        assert_eq!(history.pose_at("base", 20_000_000_000), None);
        assert_eq!(history.pose_at("base", 3_000_000_000), Some(pose(3.0, 0.0)));
    }

    #[test]
    fn edges_and_transforms_stay_within_their_caps() {
        let mut history = History::default();
        for number in 0..=FrameEdges::CAP {
            let child = format!("frame{number}");
            history.add(["map", &child], (1, 0), pose(0.0, 0.0));
        }
        assert_eq!(history.edges.len(), FrameEdges::CAP);
        for number in 0..=FramePoses::CAP as u32 {
            history.add(["map", "frame0"], (2, number), pose(0.0, 0.0));
        }
        assert_eq!(history.edges["frame0"].len(), FramePoses::CAP);
        let newest = stamp_of((2, FramePoses::CAP as u32));
        assert!(history.pose_at("frame0", newest).is_some());
    }
}
