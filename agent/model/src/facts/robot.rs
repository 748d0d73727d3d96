//! What the robot itself says: the latest status of a part, and changes of parameters.

use std::sync::Arc;

use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::{DomainId, Guid};

use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};

/// End of the names of topics on which an aggregator repeats the statuses of others.
const AGGREGATED_SUFFIX: &str = "diagnostics_agg";

/// The last status of a part of the robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiagnosticStatus {
    /// Domain.
    pub domain_id: DomainId,
    /// Topic.
    pub topic: TopicName,
    /// Name of the part.
    pub name: Arc<str>,
    /// Id of its hardware; often empty.
    pub hardware_id: Arc<str>,
    /// Node of the writer, if known.
    pub node: Option<NodeName>,
    /// Writer of the last message.
    pub writer: Guid,
    /// Level; stale also if messages ceased.
    pub level: DiagnosticLevel,
    /// Message, at most 256 bytes.
    pub message: Arc<str>,
    /// Values with their keys, at most 64.
    pub values: Vec<(Box<str>, Box<str>)>,
    /// Time of the last message.
    pub at: ModelTime,
    /// Time since which it has this level.
    pub since: ModelTime,
}

impl DiagnosticStatus {
    /// Returns the bytes of its values.
    #[must_use]
    pub fn value_bytes(&self) -> usize {
        let values = self.values.iter();
        values.map(|(key, value)| key.len() + value.len()).sum()
    }

    /// Returns it without its values, whose bytes have a cap.
    #[must_use]
    pub fn without_values(&self) -> Self {
        Self {
            values: Vec::new(),
            ..self.clone()
        }
    }

    /// Returns whether an aggregator repeats what other topics say.
    #[must_use]
    pub fn is_aggregated(&self) -> bool {
        self.topic.ends_with(AGGREGATED_SUFFIX)
    }
}

/// The client that requested a change.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Requester {
    /// Node of the client, if known.
    pub node: Option<NodeName>,
    /// Writer of the request.
    pub writer: Guid,
}

/// One change of a parameter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterChange {
    /// Time of the event.
    pub at: ModelTime,
    /// Domain.
    pub domain_id: DomainId,
    /// The node.
    pub node: NodeName,
    /// Name.
    pub name: Arc<str>,
    /// Last known value before; `None` if it was unknown or there was none.
    pub before: Option<Arc<str>>,
    /// New value; `None` if the parameter was removed.
    pub value: Option<Arc<str>>,
    /// Who requested it; `None` if no request was seen.
    pub requested_by: Option<Requester>,
}

/// A sudden change between two transforms of one edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TransformJump {
    /// The position is far from the last one.
    Translation,
    /// The orientation is far from the last one.
    Rotation,
    /// The stamp is before that of the same broadcaster's last transform.
    Time,
}

impl TransformJump {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Translation => "translation",
            Self::Rotation => "rotation",
            Self::Time => "time",
        }
    }
}

/// What is wrong with the transforms of a robot.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TransformFault {
    /// Child frame of the edge, or the unknown frame; empty if the fault concerns the whole tree.
    pub child: Arc<str>,
    /// Parent frame of the edge.
    pub parent: Arc<str>,
    /// Kind of the fault.
    pub kind: TransformFaultKind,
    /// Edges with this fault and these names, of which the fault has the first one; or topics that
    /// name the frame.
    pub edges: usize,
    /// Nodes that broadcast the edge, the roots of the trees, or topics that name the frame; at
    /// most four.
    pub names: Vec<Arc<str>>,
}

/// Kind of a fault of transforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TransformFaultKind {
    /// The broadcaster of the edge lives and is silent.
    Silent,
    /// Several nodes broadcast the edge.
    SeveralBroadcasters,
    /// Stamps of its broadcaster went back within the last minute.
    TimeWentBack,
    /// Its position or orientation jumped several times within a minute.
    Jumps,
    /// The frames belong to several trees.
    Apart,
    /// Messages name a frame that no transform has.
    UnknownFrame,
}

impl TransformFaultKind {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Silent => "silent",
            Self::SeveralBroadcasters => "several_broadcasters",
            Self::TimeWentBack => "time_went_back",
            Self::Jumps => "jumps",
            Self::Apart => "apart",
            Self::UnknownFrame => "unknown_frame",
        }
    }
}
