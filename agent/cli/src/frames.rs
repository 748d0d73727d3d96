//! Frames: the tree of their transforms as text, and the transform between two of them.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fmt::Write as _;

use history::stamp_of;
use ros2probe_api::transforms::{TransformEdge, TransformTree};
use ros2probe_daemon::escape::visible;

pub use history::History;

mod history;

/// Position and orientation of a frame in another one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// x, y and z in metres.
    pub translation: [f64; 3],
    /// Quaternion: x, y, z and w.
    pub rotation: [f64; 4],
}

/// The transform between two frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Between {
    /// Stamp of the oldest moving transform on the way; zero if all are static.
    pub stamp: (i32, u32),
    /// Pose of the target frame in the source frame.
    pub pose: Pose,
}

/// Why two frames have no transform.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoTransform {
    /// No transform names the frame.
    #[error("no transform has the frame `{0}`")]
    Unknown(String),
    /// The frames have no common ancestor.
    #[error("`{0}` and `{1}` are in separate trees")]
    Apart(String, String),
    /// The parents of a frame lead back to it.
    #[error("the parents of `{0}` lead back to it")]
    Circle(String),
}

const IDENTITY: Pose = Pose {
    translation: [0.0; 3],
    rotation: [0.0, 0.0, 0.0, 1.0],
};

impl Pose {
    fn of(edge: &TransformEdge<'_>) -> Self {
        Self {
            translation: edge.translation,
            rotation: edge.rotation,
        }
    }

    /// Returns the pose in the outer frame of a pose in this one.
    fn compose(self, inner: Self) -> Self {
        let [x, y, z] = rotate(self.rotation, inner.translation);
        let [a, b, c] = self.translation;
        Self {
            translation: [a + x, b + y, c + z],
            rotation: multiply(self.rotation, inner.rotation),
        }
    }

    fn inverse(self) -> Self {
        let rotation = conjugate(self.rotation);
        let translation = rotate(rotation, self.translation.map(|number| -number));
        Self {
            translation,
            rotation,
        }
    }

    /// Returns the rows of the rotation matrix, for a quaternion of any length.
    fn matrix(&self) -> [[f64; 3]; 3] {
        let [x, y, z, w] = self.rotation;
        let square = dot(self.rotation, self.rotation);
        let scale = if square > 0.0 { 2.0 / square } else { 0.0 };
        let [p, q, r] = [x, y, z].map(|number| number * scale);
        [
            [1.0 - (y * q + z * r), x * q - w * r, x * r + w * q],
            [x * q + w * r, 1.0 - (x * p + z * r), y * r - w * p],
            [x * r - w * q, y * r + w * p, 1.0 - (x * p + y * q)],
        ]
    }

    /// Returns the same pose with the unit quaternion that follows from the matrix. Two opposite
    /// quaternions are one rotation: tf2 converts each edge and each result to a matrix and back.
    fn through_matrix(&self) -> Self {
        let [[a, b, c], [d, e, f], [g, h, i]] = self.matrix();
        // The divisor is computed from the root that is far from zero. That part becomes positive.
        let rotation = if a + e + i > 0.0 {
            let root = (a + e + i + 1.0).sqrt();
            let scale = 0.5 / root;
            [
                (h - f) * scale,
                (c - g) * scale,
                (d - b) * scale,
                0.5 * root,
            ]
        } else if a >= e && a >= i {
            let root = (a - e - i + 1.0).sqrt();
            let scale = 0.5 / root;
            [
                0.5 * root,
                (d + b) * scale,
                (g + c) * scale,
                (h - f) * scale,
            ]
        } else if e >= i {
            let root = (e - i - a + 1.0).sqrt();
            let scale = 0.5 / root;
            [
                (b + d) * scale,
                0.5 * root,
                (h + f) * scale,
                (c - g) * scale,
            ]
        } else {
            let root = (i - a - e + 1.0).sqrt();
            let scale = 0.5 / root;
            [
                (c + g) * scale,
                (f + h) * scale,
                0.5 * root,
                (d - b) * scale,
            ]
        };
        Self {
            translation: self.translation,
            rotation,
        }
    }

    /// Returns roll, pitch and yaw in radians.
    fn roll_pitch_yaw(&self) -> [f64; 3] {
        let [[m00, _, _], [m10, _, _], [m20, m21, m22]] = self.matrix();
        if m20.abs() >= 1.0 {
            // At the poles, roll and yaw are one rotation, which counts as roll.
            let pitch = if m20 < 0.0 { 1.0 } else { -1.0 } * std::f64::consts::FRAC_PI_2;
            return [m21.atan2(m22), pitch, 0.0];
        }
        let pitch = -m20.asin();
        let cosine = pitch.cos();
        [
            (m21 / cosine).atan2(m22 / cosine),
            pitch,
            (m10 / cosine).atan2(m00 / cosine),
        ]
    }
}

fn dot(one: [f64; 4], other: [f64; 4]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

/// Returns the vector, rotated by a quaternion of any length.
fn rotate(rotation: [f64; 4], [a, b, c]: [f64; 3]) -> [f64; 3] {
    let square = dot(rotation, rotation);
    if square == 0.0 {
        return [a, b, c];
    }
    let turned = multiply(rotation, [a, b, c, 0.0]);
    let [x, y, z, _] = multiply(turned, conjugate(rotation));
    [x, y, z].map(|number| number / square)
}

fn conjugate([x, y, z, w]: [f64; 4]) -> [f64; 4] {
    [-x, -y, -z, w]
}

fn multiply([a, b, c, d]: [f64; 4], [x, y, z, w]: [f64; 4]) -> [f64; 4] {
    [
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    ]
}

/// The frames of a tree, by child.
#[derive(Debug)]
pub struct Frames<'a> {
    edges: BTreeMap<&'a str, &'a TransformEdge<'a>>,
}

impl<'a> Frames<'a> {
    /// Reads a tree.
    #[must_use]
    pub fn new(tree: &'a TransformTree<'a>) -> Self {
        let edges = tree.edges.iter().map(|edge| (&*edge.child, edge));
        Self {
            edges: edges.collect(),
        }
    }

    /// Returns the transform between two frames, as `tf2_echo SOURCE TARGET` prints it: at the
    /// latest time for which each edge has a transform. An edge of which `history` has no pose at
    /// that time counts with its last one.
    ///
    /// # Errors
    /// Fails if a frame is unknown, or if both are in separate trees.
    pub fn between(
        &self,
        source: &str,
        target: &str,
        history: &History,
    ) -> Result<Between, NoTransform> {
        let [up, down] = self.paths_to_ancestor(source, target)?;
        let stamp = common_stamp(&[&up, &down]);
        let pose_of = |path: &[&TransformEdge<'_>]| {
            path.iter().fold(IDENTITY, |pose, edge| {
                let at_stamp = || history.pose_at(&edge.child, stamp_of(stamp));
                let moving = (!edge.is_static).then(at_stamp).flatten();
                let of_edge = moving.unwrap_or_else(|| Pose::of(edge));
                of_edge.through_matrix().compose(pose)
            })
        };
        Ok(Between {
            stamp,
            pose: pose_of(&up).inverse().compose(pose_of(&down)),
        })
    }

    /// Returns whether `history` has the pose of each moving edge between two frames at the latest
    /// time for which all of them have a transform.
    ///
    /// # Errors
    /// Fails if a frame is unknown, or if both are in separate trees.
    pub fn has_poses(
        &self,
        source: &str,
        target: &str,
        history: &History,
    ) -> Result<bool, NoTransform> {
        let paths = self.paths_to_ancestor(source, target)?;
        let stamp = stamp_of(common_stamp(&[&paths[0], &paths[1]]));
        let mut moving = paths.iter().flatten().filter(|edge| !edge.is_static);
        Ok(moving.all(|edge| history.pose_at(&edge.child, stamp).is_some()))
    }

    /// Returns the edges from each of two frames up to their nearest common ancestor.
    fn paths_to_ancestor(
        &self,
        source: &str,
        target: &str,
    ) -> Result<[Vec<&'a TransformEdge<'a>>; 2], NoTransform> {
        let [source, target] = [source, target].map(|frame| frame.trim_start_matches('/'));
        let (from, to) = (self.ancestors(source)?, self.ancestors(target)?);
        let common = from
            .iter()
            .find(|(frame, _)| to.iter().any(|(other, _)| other == frame));
        let Some((common, _)) = common else {
            return Err(NoTransform::Apart(source.to_owned(), target.to_owned()));
        };
        Ok([&from, &to].map(|path| {
            let below = path.iter().take_while(|(frame, _)| frame != common);
            below.filter_map(|(_, edge)| *edge).collect()
        }))
    }

    /// Returns the frame and its ancestors, each with the edge to its parent.
    fn ancestors<'b>(
        &self,
        frame: &'b str,
    ) -> Result<Vec<(&'b str, Option<&'a TransformEdge<'a>>)>, NoTransform>
    where
        'a: 'b,
    {
        let is_parent = || self.edges.values().any(|edge| edge.parent == frame);
        if !self.edges.contains_key(frame) && !is_parent() {
            return Err(NoTransform::Unknown(frame.to_owned()));
        }
        let mut found = Vec::new();
        let mut at = frame;
        loop {
            if found.len() > self.edges.len() {
                return Err(NoTransform::Circle(frame.to_owned()));
            }
            let edge = self.edges.get(at).copied();
            found.push((at, edge));
            match edge {
                Some(edge) => at = &edge.parent,
                None => return Ok(found),
            }
        }
    }

    /// Returns the tree as indented text. `now` is the Unix time of the view.
    #[must_use]
    pub fn tree(&self, now: f64) -> String {
        let mut text = String::new();
        for root in self.roots() {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{}", visible(root));
            self.branches(root, "", now, &mut HashSet::new(), &mut text);
        }
        text
    }

    fn branches(
        &self,
        parent: &str,
        indent: &str,
        now: f64,
        seen: &mut HashSet<&'a str>,
        text: &mut String,
    ) {
        let children: Vec<_> = (self.edges.values())
            .filter(|edge| edge.parent == parent)
            .collect();
        for (index, edge) in children.iter().enumerate() {
            if !seen.insert(&edge.child) {
                continue;
            }
            let (branch, below) = match index + 1 == children.len() {
                true => ("└─ ", "   "),
                false => ("├─ ", "│  "),
            };
            let _ = writeln!(
                text,
                "{indent}{branch}{}  {}",
                visible(&edge.child),
                edge_text(edge, now)
            );
            self.branches(&edge.child, &format!("{indent}{below}"), now, seen, text);
        }
    }

    /// Returns the frames without a parent. A circle of frames has none.
    fn roots(&self) -> BTreeSet<&'a str> {
        let parents = self.edges.values().map(|edge| &*edge.parent);
        parents
            .filter(|parent| !self.edges.contains_key(parent))
            .collect()
    }

    /// Returns the tree in the language of Graphviz.
    #[must_use]
    pub fn dot(&self, now: f64) -> String {
        let mut text = "digraph frames {\n".to_owned();
        for edge in self.edges.values() {
            let _ = writeln!(
                text,
                "  {:?} -> {:?} [label={:?}];",
                visible(&edge.parent),
                visible(&edge.child),
                edge_text(edge, now)
            );
        }
        text + "}\n"
    }
}

/// Returns the oldest of the last stamps of moving edges; zero without any.
fn common_stamp(paths: &[&[&TransformEdge<'_>]]) -> (i32, u32) {
    let moving = paths
        .iter()
        .copied()
        .flatten()
        .filter(|edge| !edge.is_static);
    let stamps = moving.map(|edge| (edge.stamp_sec, edge.stamp_nanosec));
    stamps.min().unwrap_or_default()
}

/// Returns rate, age and broadcasters of an edge.
fn edge_text(edge: &TransformEdge<'_>, now: f64) -> String {
    let nodes = edge.broadcasters.iter().map(|each| match &each.ros_node {
        Some(node) => visible(node).into_owned(),
        None => each.writer.clone(),
    });
    let nodes = nodes.collect::<Vec<_>>().join(", ");
    if edge.is_static {
        return format!("static  {nodes}");
    }
    let age = (now - edge.timestamp_seconds).max(0.0);
    let rate = edge
        .rate_hz
        .map_or_else(String::new, |rate| format!("{rate:.1} Hz, "));
    format!("{rate}{age:.2} s ago  {nodes}")
}

impl Between {
    /// Returns the text of `tf2_echo`.
    #[must_use]
    pub fn text(&self) -> String {
        let pose = self.pose.through_matrix();
        let [x, y, z] = pose.translation;
        let [a, b, c, d] = pose.rotation;
        let angles = pose.roll_pitch_yaw();
        let [roll, pitch, yaw] = angles;
        let [r, p, w] = angles.map(f64::to_degrees);
        // tf2_echo pads the nanoseconds with nothing.
        let mut text = format!(
            "At time {}.{}\n\
             - Translation: [{x:.3}, {y:.3}, {z:.3}]\n\
             - Rotation: in Quaternion [{a:.3}, {b:.3}, {c:.3}, {d:.3}]\n\
             - Rotation: in RPY (radian) [{roll:.3}, {pitch:.3}, {yaw:.3}]\n\
             - Rotation: in RPY (degree) [{r:.3}, {p:.3}, {w:.3}]\n\
             - Matrix:\n",
            self.stamp.0, self.stamp.1
        );
        for (row, offset) in pose.matrix().into_iter().zip(pose.translation) {
            for number in row.into_iter().chain([offset]) {
                let _ = write!(text, " {number:6.3}");
            }
            text.push('\n');
        }
        text + "  0.000  0.000  0.000  1.000\n"
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_1_SQRT_2;

    use super::*;

    fn edge(
        parent: &'static str,
        child: &'static str,
        x: f64,
        turn: bool,
    ) -> TransformEdge<'static> {
        TransformEdge {
            parent: parent.into(),
            child: child.into(),
            is_static: child == "lidar",
            rate_hz: Some(50.0),
            timestamp_seconds: 99.5,
            stamp_sec: 99,
            stamp_nanosec: if child == "odom" { 5 } else { 400_000_000 },
            translation: [x, 0.0, 0.0],
            rotation: match turn {
                // A quarter turn about z.
                true => [0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2],
                false => [0.0, 0.0, 0.0, 1.0],
            },
            ..TransformEdge::default()
        }
    }

    fn tree() -> TransformTree<'static> {
        TransformTree {
            edges: vec![
                edge("odom", "base_link", 2.0, true),
                edge("base_link", "camera", 0.5, false),
                edge("base_link", "lidar", 1.0, false),
                edge("map", "odom", 10.0, false),
                edge("other", "alone", 1.0, false),
            ],
            ..TransformTree::default()
        }
    }

    #[test]
    fn the_text_is_that_of_tf2_echo() {
        let tree = tree();
        let between = Frames::new(&tree)
            .between("map", "/lidar", &History::default())
            .unwrap();
        assert_eq!(
            between.text(),
            "At time 99.5\n\
             - Translation: [12.000, 1.000, 0.000]\n\
             - Rotation: in Quaternion [0.000, 0.000, 0.707, 0.707]\n\
             - Rotation: in RPY (radian) [0.000, -0.000, 1.571]\n\
             - Rotation: in RPY (degree) [0.000, -0.000, 90.000]\n\
             - Matrix:\n\
             \x20 0.000 -1.000  0.000 12.000\n\
             \x20 1.000  0.000  0.000  1.000\n\
             \x20 0.000  0.000  1.000  0.000\n\
             \x20 0.000  0.000  0.000  1.000\n"
        );
    }

    #[test]
    fn edges_with_newer_stamps_count_at_the_oldest_one() {
        let tree = tree();
        let frames = Frames::new(&tree);
        let mut history = History::default();
        history.add_last(&tree);
        assert_eq!(frames.has_poses("map", "base_link", &history), Ok(false));
        let earlier = TransformTree {
            edges: vec![TransformEdge {
                stamp_sec: 98,
                stamp_nanosec: 600_000_010,
                translation: [4.0, 0.0, 0.0],
                ..edge("odom", "base_link", 0.0, true)
            }],
            ..TransformTree::default()
        };
        history.add_last(&earlier);
        assert_eq!(frames.has_poses("map", "base_link", &history), Ok(true));
        let between = frames.between("map", "base_link", &history).unwrap();
        assert_eq!(between.stamp, (99, 5));
        // Half of the time has passed between 98.6 and 99.4.
        let [x, ..] = between.pose.translation;
        assert!((x - 13.0).abs() < 1e-6, "{x}");
        assert_eq!(frames.has_poses("camera", "lidar", &history), Ok(true));
        let nothing = History::default();
        assert_eq!(frames.has_poses("camera", "lidar", &nothing), Ok(false));
        assert_eq!(frames.has_poses("lidar", "base_link", &nothing), Ok(true));
    }

    #[test]
    fn the_transform_in_the_opposite_direction_is_the_inverse() {
        let tree = tree();
        let frames = Frames::new(&tree);
        let there = frames
            .between("camera", "map", &History::default())
            .unwrap()
            .pose;
        let back = frames
            .between("map", "camera", &History::default())
            .unwrap()
            .pose;
        let same = there.compose(back);
        assert!(
            same.translation.iter().all(|number| number.abs() < 1e-9),
            "{same:?}"
        );
        assert!((same.rotation[3].abs() - 1.0).abs() < 1e-9, "{same:?}");
        let siblings = frames
            .between("camera", "lidar", &History::default())
            .unwrap()
            .pose;
        assert!((siblings.translation[0] - 0.5).abs() < 1e-9, "{siblings:?}");
        assert_eq!(
            frames
                .between("lidar", "base_link", &History::default())
                .unwrap()
                .stamp,
            (0, 0),
            "static"
        );
    }

    #[test]
    fn frames_without_a_transform_have_a_reason() {
        let tree = tree();
        let frames = Frames::new(&tree);
        let reason = |source, target| {
            frames
                .between(source, target, &History::default())
                .unwrap_err()
        };
        assert_eq!(
            reason("map", "nose"),
            NoTransform::Unknown("nose".to_owned())
        );
        let apart = NoTransform::Apart("map".to_owned(), "alone".to_owned());
        assert_eq!(reason("map", "alone"), apart);
        let circle = TransformTree {
            edges: vec![edge("a", "b", 1.0, false), edge("b", "a", 1.0, false)],
            ..TransformTree::default()
        };
        let frames = Frames::new(&circle);
        assert_eq!(
            frames.between("a", "b", &History::default()).unwrap_err(),
            NoTransform::Circle("a".to_owned())
        );
        assert_eq!(frames.tree(0.0), "");
    }

    #[test]
    fn the_tree_is_indented_by_depth() {
        let tree = tree();
        assert_eq!(
            Frames::new(&tree).tree(100.0),
            "map\n\
             └─ odom  50.0 Hz, 0.50 s ago  \n\
             \x20  └─ base_link  50.0 Hz, 0.50 s ago  \n\
             \x20     ├─ camera  50.0 Hz, 0.50 s ago  \n\
             \x20     └─ lidar  static  \n\
             other\n\
             └─ alone  50.0 Hz, 0.50 s ago  \n"
        );
        let dot = Frames::new(&tree).dot(100.0);
        assert!(
            dot.contains("  \"map\" -> \"odom\" [label=\"50.0 Hz, 0.50 s ago  \"];\n"),
            "{dot}"
        );
    }

    #[test]
    fn opposite_quaternions_are_printed_as_tf2_echo_prints_them() {
        // The rotation of an optical frame, and half turns about each axis.
        for (rotation, printed) in [
            ([-0.5, 0.5, -0.5, 0.5], "[0.500, -0.500, 0.500, -0.500]"),
            ([0.5, -0.5, 0.5, -0.5], "[0.500, -0.500, 0.500, -0.500]"),
            ([0.0, 0.0, -0.6, -0.8], "[0.000, 0.000, 0.600, 0.800]"),
            ([-1.0, 0.0, 0.0, 0.0], "[1.000, 0.000, 0.000, 0.000]"),
            ([0.0, -1.0, 0.0, 0.0], "[0.000, 1.000, 0.000, 0.000]"),
            ([0.0, 0.0, -2.0, 0.0], "[0.000, 0.000, 1.000, 0.000]"),
        ] {
            let edge = TransformEdge {
                rotation,
                ..edge("map", "camera", 0.0, false)
            };
            let tree = TransformTree {
                edges: vec![edge],
                ..TransformTree::default()
            };
            let text = Frames::new(&tree)
                .between("map", "camera", &History::default())
                .unwrap()
                .text();
            let line = format!("- Rotation: in Quaternion {printed}\n");
            assert!(text.contains(&line), "{rotation:?}: {text}");
        }
    }

    #[test]
    fn angles_at_the_poles_are_defined() {
        let up = Pose {
            rotation: [0.0, FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2],
            ..IDENTITY
        };
        let [_, pitch, _] = up.roll_pitch_yaw();
        assert!((pitch.to_degrees() - 90.0).abs() < 1e-3, "{pitch}");
        let zero = Pose {
            rotation: [0.0; 4],
            ..IDENTITY
        };
        assert_eq!(zero.matrix()[0], [1.0, 0.0, 0.0]);
    }
}
