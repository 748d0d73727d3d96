//! Transforms: the trees of frames, their broadcasters, and what is wrong with them.
//!
//! A tree belongs to one domain and one namespace, because a robot may publish on `/robot1/tf` and
//! `/robot1/tf_static`. An edge is identified by its child frame, because a frame has one parent.

mod edge;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::transforms::{Transform, Transforms as Message};
use ros2probe_wire::{DomainId, Guid, WireError};

use super::Origin;
use super::text::truncated_text;
use crate::facts::bounded::{Bounded, Counted, Sum, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::event::{EventKind, Events};
use crate::facts::model_time::ModelTime;
use crate::facts::robot::{TransformFault, TransformFaultKind};
use crate::facts::tables::{StaticBroadcasters, TransformEdges, TransformTrees};
use edge::Edge;
pub use edge::{Broadcaster, EdgeFacts, Jumps};

/// Maximum length of a frame's name, in bytes.
pub(super) const NAME: usize = 128;
/// Time for which trees stay apart before that is a fault.
const APART: Duration = Duration::from_secs(10);
/// Maximum number of roots that a fault names.
pub(super) const MAX_NAMED: usize = 4;

/// The transforms of all robots.
#[derive(Debug, Default)]
pub struct Transforms {
    trees: Bounded<Counted<TransformTrees>, Vec<Tree>>,
    /// Edges of all trees.
    edges: Sum<Counted<TransformEdges>>,
    /// Writers of `/tf_static`, and whether a message of each was read.
    broadcasters: Bounded<Counted<StaticBroadcasters>, HashMap<Guid, StaticBroadcaster>>,
    revision: u64,
}

/// A writer of `/tf_static`.
#[derive(Debug)]
struct StaticBroadcaster {
    domain_id: DomainId,
    namespace: Arc<str>,
    is_received: bool,
}

/// The frames of one domain and namespace.
#[derive(Debug)]
struct Tree {
    domain_id: DomainId,
    namespace: Arc<str>,
    /// Edges by the name of the child frame. The sum over all trees has the cap.
    edges: BTreeMap<Arc<str>, Edge>,
    /// Time since which the tree has several roots.
    apart: Option<ModelTime>,
    /// Frames without a parent at the end of the last second, sorted.
    roots: Vec<Arc<str>>,
    faults: Vec<TransformFault>,
}

/// Facts about one tree.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// Namespace of the topics; empty for `/tf`.
    pub namespace: Arc<str>,
    /// Edges, sorted by child frame.
    pub edges: Vec<EdgeFacts>,
    /// Publishers of `/tf_static` of which no message was read: the agent came later.
    pub unread_static: usize,
}

/// Facts about all transforms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TransformFacts {
    /// Whether transforms are read.
    pub are_read: bool,
    /// Trees, sorted by domain and namespace.
    pub trees: Vec<TreeFacts>,
}

impl Transforms {
    /// Begins to follow a writer.
    pub(super) fn follow(&mut self, writer: Guid, domain_id: DomainId, topic: &str) {
        let (namespace, is_static) = namespace(topic);
        if is_static {
            let new = || StaticBroadcaster {
                domain_id,
                namespace: namespace.into(),
                is_received: false,
            };
            self.broadcasters.get_or_insert_with(writer, new);
        }
    }

    /// Adds the transforms of a message.
    ///
    /// # Errors
    /// Fails if the message is malformed. The transforms before the error are added.
    pub fn add(
        &mut self,
        origin: &Origin<'_>,
        message: Message<'_>,
        events: &mut Events,
    ) -> Result<(), WireError> {
        let (namespace, is_static) = namespace(origin.topic);
        if let Some(broadcaster) = self.broadcasters.get_mut(&origin.writer) {
            broadcaster.is_received = true;
        }
        let is_this =
            |tree: &Tree| (tree.domain_id, &*tree.namespace) == (origin.domain_id, namespace);
        let place = match self.trees.iter().position(is_this) {
            Some(place) => place,
            None if self.trees.is_full() => {
                self.trees.refuse();
                return Ok(());
            }
            None => {
                self.trees.push(Tree {
                    domain_id: origin.domain_id,
                    namespace: namespace.into(),
                    edges: BTreeMap::new(),
                    apart: None,
                    roots: Vec::new(),
                    faults: Vec::new(),
                });
                self.trees.len() - 1
            }
        };
        if let Some(tree) = self.trees.get_mut(place) {
            for transform in message {
                tree.add(origin, &transform?, is_static, &mut self.edges, events);
            }
        }
        Ok(())
    }

    /// Removes a departed writer of which no message was read.
    pub(super) fn forget_unread(&mut self, writer: Guid) {
        let known = self.broadcasters.get(&writer);
        if known.is_some_and(|known| !known.is_received) {
            self.broadcasters.remove(&writer);
        }
    }

    /// Removes what a departed writer broadcast.
    pub(super) fn forget(&mut self, writer: Guid) {
        self.broadcasters.remove(&writer);
        for tree in self.trees.iter_mut() {
            let before = tree.edges.len();
            tree.edges.retain(|_, edge| !edge.forget(writer));
            self.edges.sub(before - tree.edges.len());
        }
        self.trees.retain(|tree| !tree.edges.is_empty());
        self.revision += 1;
    }

    /// Ends a second: rates, and the faults that last. `is_unseen` returns whether messages of a
    /// writer may pass unseen.
    pub(super) fn end_second(&mut self, now: ModelTime, is_unseen: impl Fn(Guid) -> bool) {
        for tree in self.trees.iter_mut() {
            let of_tree = |each: &StaticBroadcaster| {
                (each.domain_id, &each.namespace) == (tree.domain_id, &tree.namespace)
            };
            let mut static_broadcasters = self.broadcasters.values();
            // Without all static transforms, a tree only seems to be in parts.
            let is_whole = static_broadcasters.all(|each| each.is_received || !of_tree(each));
            if tree.end_second(now, is_whole, &is_unseen) {
                self.revision += 1;
            }
        }
    }

    /// Returns whether the domain has transforms, and none of them has this frame. Returns `false`
    /// while messages of a static broadcaster are unread, because one of them may have the frame.
    pub(super) fn is_unknown_frame(&self, domain_id: DomainId, frame: &str) -> bool {
        let of_domain = || self.trees.iter().filter(|tree| tree.domain_id == domain_id);
        let mut unread = self.broadcasters.values();
        of_domain().next().is_some()
            && !of_domain().any(|tree| tree.has(frame))
            && unread.all(|each| each.is_received || each.domain_id != domain_id)
    }

    /// Returns the number of changes of [`Self::findings`].
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the faults.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        self.trees.iter().flat_map(|tree| {
            tree.faults.iter().map(|fault| Diagnosis::TransformFault {
                domain_id: tree.domain_id,
                namespace: Arc::clone(&tree.namespace),
                fault: fault.clone(),
            })
        })
    }

    /// Returns the facts.
    #[must_use]
    pub fn facts(&self, are_read: bool, now: ModelTime) -> TransformFacts {
        let mut trees: Vec<_> = (self.trees.iter())
            .map(|tree| TreeFacts {
                domain_id: tree.domain_id,
                namespace: Arc::clone(&tree.namespace),
                edges: tree
                    .edges
                    .iter()
                    .map(|(child, edge)| edge.facts(child, now))
                    .collect(),
                unread_static: 0,
            })
            .collect();
        for unread in self.broadcasters.values().filter(|each| !each.is_received) {
            let key = (unread.domain_id, &unread.namespace);
            match trees
                .iter_mut()
                .find(|tree| (tree.domain_id, &tree.namespace) == key)
            {
                Some(tree) => tree.unread_static += 1,
                None => trees.push(TreeFacts {
                    domain_id: unread.domain_id,
                    namespace: Arc::clone(&unread.namespace),
                    edges: Vec::new(),
                    unread_static: 1,
                }),
            }
        }
        trees.sort_by(|one, other| {
            (one.domain_id, &one.namespace).cmp(&(other.domain_id, &other.namespace))
        });
        TransformFacts { are_read, trees }
    }

    pub(super) fn tables(&self) -> [TableFacts; 3] {
        [
            self.trees.facts(),
            self.edges.facts(),
            self.broadcasters.facts(),
        ]
    }
}

impl Tree {
    fn add(
        &mut self,
        origin: &Origin<'_>,
        transform: &Transform<'_>,
        is_static: bool,
        edges: &mut Sum<Counted<TransformEdges>>,
        events: &mut Events,
    ) {
        // The usual case: the name is UTF-8, short and known.
        let child = std::str::from_utf8(transform.child).ok();
        let known = child.and_then(|child| self.edges.get_mut(without_slash(child)));
        let edge = match known {
            Some(edge) => edge,
            None => {
                if edges.is_full() {
                    edges.refuse();
                    return;
                }
                let child: Arc<str> = without_slash(&truncated_text(transform.child, NAME)).into();
                let edge = self.edges.entry(child).or_default();
                edges.add(usize::from(edge.is_new()));
                edge
            }
        };
        let Some(jump) = edge.add(origin, transform, is_static) else {
            return;
        };
        let child = truncated_text(transform.child, NAME);
        events.push(
            origin.at,
            EventKind::TransformJump {
                domain_id: self.domain_id,
                namespace: Arc::clone(&self.namespace),
                parent: edge.parent(),
                child: without_slash(&child).into(),
                node: origin.node.cloned(),
                jump,
            },
        );
    }

    /// Updates rates and faults. Returns whether the faults change.
    fn end_second(
        &mut self,
        now: ModelTime,
        is_whole: bool,
        is_unseen: &impl Fn(Guid) -> bool,
    ) -> bool {
        let mut faults: Vec<TransformFault> = Vec::new();
        for (child, edge) in &mut self.edges {
            edge.end_second();
            if let Some(kind) = edge.fault(now, is_unseen) {
                let names = edge.names();
                // One broadcaster may have many edges.
                let same = faults.iter_mut();
                let mut same = same.filter(|each| each.kind == kind && each.names == names);
                if let Some(same) = same.next() {
                    same.edges += 1;
                    continue;
                }
                faults.push(TransformFault {
                    child: Arc::clone(child),
                    parent: edge.parent(),
                    kind,
                    edges: 1,
                    names,
                });
            }
        }
        self.roots = self.roots();
        match self.roots.len() {
            2.. if is_whole => {
                let since = *self.apart.get_or_insert(now);
                if now - since >= APART {
                    faults.push(TransformFault {
                        child: Arc::default(),
                        parent: Arc::default(),
                        kind: TransformFaultKind::Apart,
                        edges: 0,
                        names: self.roots.iter().take(MAX_NAMED).cloned().collect(),
                    });
                }
            }
            _ => self.apart = None,
        }
        let changes = faults != self.faults;
        self.faults = faults;
        changes
    }

    /// Returns whether a transform has the frame. One that came within this second may be missing.
    fn has(&self, frame: &str) -> bool {
        let is_root = |root: &Arc<str>| (**root).cmp(frame);
        self.edges.contains_key(frame) || self.roots.binary_search_by(is_root).is_ok()
    }

    /// Returns the frames without a parent, sorted.
    fn roots(&self) -> Vec<Arc<str>> {
        let parents = self.edges.values().map(Edge::parent);
        let mut roots: Vec<_> = parents
            .filter(|parent| !self.edges.contains_key(parent))
            .collect();
        roots.sort();
        roots.dedup();
        roots
    }
}

/// Returns whether transforms on a topic belong to the robot: its last token is `tf` or `tf_static`.
pub(super) fn is_topic(topic: &str) -> bool {
    let name = topic.rsplit('/').next();
    matches!(name, Some("tf" | "tf_static"))
}

/// Returns the namespace of a topic of transforms, and whether it has static ones.
fn namespace(topic: &str) -> (&str, bool) {
    let (namespace, name) = topic.rsplit_once('/').unwrap_or(("", topic));
    (namespace, name == "tf_static")
}

/// Returns a frame without the leading slash of older names, which tf2 ignores.
pub(super) fn without_slash(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}
