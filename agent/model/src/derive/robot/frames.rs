//! Frames that messages name in their header. One message of each writer is read.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::{DomainId, Guid, header};

use super::text::truncated_text;
use super::transforms::{MAX_NAMED, NAME, Transforms, without_slash};
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::model_time::ModelTime;
use crate::facts::names::TopicName;
use crate::facts::robot::{TransformFault, TransformFaultKind};
use crate::facts::tables::FrameWriters;

/// Time for which no transform may have a frame.
const UNKNOWN_FRAME_TIMEOUT: Duration = Duration::from_secs(8);

/// Writers of messages with a header.
#[derive(Debug, Default)]
pub(super) struct Frames {
    writers: Bounded<Counted<FrameWriters>, HashMap<Guid, FrameWriter>>,
    faults: Vec<Diagnosis>,
    revision: u64,
}

/// A writer of messages with a header.
#[derive(Debug)]
struct FrameWriter {
    domain_id: DomainId,
    topic: TopicName,
    /// The frame of the message that was read; `None` before.
    frame: Option<Arc<str>>,
    /// Time since which no transform has had the frame.
    unknown: Option<ModelTime>,
}

impl Frames {
    /// Begins to wait for a message of this writer. Returns whether the table has room for it.
    pub(super) fn follow(&mut self, writer: Guid, domain_id: DomainId, topic: &TopicName) -> bool {
        let new = || FrameWriter {
            domain_id,
            topic: topic.clone(),
            frame: None,
            unknown: None,
        };
        self.writers.get_or_insert_with(writer, new).is_some()
    }

    /// Returns whether the writer is followed.
    pub(super) fn knows(&self, writer: Guid) -> bool {
        self.writers.contains_key(&writer)
    }

    /// Returns whether the table is full.
    pub(super) fn is_full(&self) -> bool {
        self.writers.is_full()
    }

    /// Removes a departed writer.
    pub(super) fn forget(&mut self, writer: Guid) {
        self.writers.remove(&writer);
    }

    /// Returns whether a message of this writer is still to be read.
    pub(super) fn waits(&self, writer: Guid) -> bool {
        let known = self.writers.get(&writer);
        known.is_some_and(|known| known.frame.is_none())
    }

    /// Reads the header of a message, whose beginning is enough. Bytes without a header count as an
    /// empty frame, so that only one message is read.
    pub(super) fn read(&mut self, writer: Guid, payload: &[u8]) {
        if let Some(known) = self.writers.get_mut(&writer) {
            let frame = header::frame_id(payload).unwrap_or_default();
            known.frame = Some(without_slash(&truncated_text(frame, NAME)).into());
        }
    }

    /// Updates the frames that no transform has.
    pub(super) fn end_second(&mut self, now: ModelTime, transforms: &Transforms) {
        let mut unknown: BTreeMap<(DomainId, &Arc<str>), Vec<&TopicName>> = BTreeMap::new();
        for writer in self.writers.values_mut() {
            let frame = writer.frame.as_ref().filter(|frame| !frame.is_empty());
            let Some(frame) =
                frame.filter(|frame| transforms.is_unknown_frame(writer.domain_id, frame))
            else {
                writer.unknown = None;
                continue;
            };
            let since = *writer.unknown.get_or_insert(now);
            if now - since >= UNKNOWN_FRAME_TIMEOUT {
                let topics = unknown.entry((writer.domain_id, frame)).or_default();
                topics.push(&writer.topic);
            }
        }
        let faults = unknown.into_iter().map(|((domain_id, frame), mut topics)| {
            topics.sort_unstable();
            topics.dedup();
            let names = topics.iter().take(MAX_NAMED);
            Diagnosis::TransformFault {
                domain_id,
                namespace: Arc::default(),
                fault: TransformFault {
                    child: Arc::clone(frame),
                    parent: Arc::default(),
                    kind: TransformFaultKind::UnknownFrame,
                    edges: topics.len(),
                    names: names.map(|name| name.as_str().into()).collect(),
                },
            }
        });
        let faults: Vec<_> = faults.collect();
        if faults != self.faults {
            self.faults = faults;
            self.revision += 1;
        }
    }

    /// Returns the faults.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        self.faults.iter().cloned()
    }

    /// Returns the number of changes of the faults.
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

    pub(super) fn table(&self) -> TableFacts {
        self.writers.facts()
    }
}
