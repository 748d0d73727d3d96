//! Reports of the robot about itself, on topics of standard types. The agent reads them as they
//! pass, without a watch and without a subscription.
//!
//! A writer of such a type is captured within an allowance of its own and one for all writers. A
//! writer that exceeds its allowance is paused for some seconds. Each message is decoded once,
//! whichever copies of it were captured.

pub mod diagnostics;
pub mod fields;
mod frames;
pub mod lifecycle;
pub mod logs;
pub mod parameters;
mod read_numbers;
mod standard;
mod text;
pub mod transforms;

use std::sync::Arc;

use foldhash::HashMap;
use ros2probe_wire::diagnostics::DiagnosticStatuses;
use ros2probe_wire::lifecycle::{LifecycleState, Transition};
use ros2probe_wire::ros_parameters::{self, ParameterEvent, RepliedValues, RequestedNames};
use ros2probe_wire::rtps::{RequestHeader, VendorId};
use ros2probe_wire::transforms as wire_transforms;
use ros2probe_wire::{DomainId, Guid, SequenceNumber, WireError, log};

use crate::derive::services::Half;
use crate::derive::services::service::CallId;
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::event::Events;
use crate::facts::header::names_a_frame;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName, TypeName};
use crate::facts::observation::{Path, Sample};
use crate::facts::shared_memory::{MemoryFault, MemoryUse};
use crate::facts::tables::RobotWriters;
use crate::graph::discovery::Discovery;
use crate::measure::allowance::{Allowance, CommonAllowance, WriterAllowance};
use crate::measure::assembly::Assembly;
use diagnostics::Diagnostics;
use fields::{FieldMessage, Fields};
use frames::Frames;
use lifecycle::{Lifecycle, ManagedNode};
use logs::Logs;
use parameters::{ExpectedParameter, Parameters};
use read_numbers::ReadNumbers;
use transforms::Transforms;

pub use standard::{Part, Parts, Standard};

/// Maximum size of a message that is decoded, in bytes.
const MESSAGE_BYTES: usize = 64 << 10;
/// Maximum size of all unfinished messages, in bytes.
const ASSEMBLY_BYTES: usize = 1 << 20;
/// Bytes of one writer that may be captured in a burst, and per second.
const WRITER_ALLOWANCE: Allowance = Allowance::new(1 << 20, 64 << 10);
/// Bytes of all writers that may be captured in a burst, and per second.
const COMMON_ALLOWANCE: Allowance = Allowance::new(8 << 20, 512 << 10);
/// Allowances for transforms: thirty joints with one message each at 100 Hz send 300 KB/s.
const BROADCASTER_ALLOWANCE: Allowance = Allowance::new(2 << 20, 512 << 10);
const COMMON_BROADCASTER_ALLOWANCE: Allowance = Allowance::new(8 << 20, 2 << 20);
/// A paused writer is captured again once it is allowed this many bytes.
const RESUME_BYTES: u64 = 256 << 10;

/// What is read of a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// Its messages, which are of this type.
    Messages(Standard),
    /// The frame in the header of one message.
    Frame,
}

/// What the configuration expects of a robot, and wants to know about it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RobotExpectations {
    /// Patterns of the names of managed nodes that should be active; `*` matches any characters.
    pub active: Arc<Vec<Box<str>>>,
    /// Parameters that should have these values.
    pub parameters: Arc<Vec<ExpectedParameter>>,
    /// Topics whose fields have metrics.
    pub fields: Arc<Vec<TopicName>>,
}

/// Writers of standard types, and the content of their messages.
#[derive(Debug)]
pub struct Robot {
    writers: Bounded<Counted<RobotWriters>, HashMap<Guid, RobotWriter>>,
    /// Whether the full table refused a writer since [`Robot::retry`].
    has_refused: bool,
    /// Like `has_refused`, for the table of writers with frames.
    has_refused_frame: bool,
    assembly: Assembly,
    allowances: Allowances,
    logs: Logs,
    diagnostics: Diagnostics,
    parameters: Parameters,
    transforms: Transforms,
    frames: Frames,
    lifecycle: Lifecycle,
    fields: Fields,
    /// The figure of each fault of shared memory when it began.
    memory_faults: [Option<u64>; MemoryFault::ALL.len()],
    memory_changes: u64,
}

/// Allowances of all writers together. Transforms have one of their own: thirty of them at 100 Hz
/// take 300 KB/s.
#[derive(Debug)]
struct Allowances {
    transforms: CommonAllowance,
    others: CommonAllowance,
}

#[derive(Debug)]
struct RobotWriter {
    domain_id: DomainId,
    topic: TopicName,
    standard: Standard,
    allowance: WriterAllowance,
    read: ReadNumbers,
    view: View,
}

/// How the last message of a writer was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum View {
    /// On an interface or at a socket.
    Network,
    /// In shared memory, by a probe that sees every message.
    Exact,
    /// In shared memory, by polling, or by a probe that was detached since. Further messages may
    /// pass unseen.
    Sampled,
}

/// What a sample of a followed writer changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReadOutcome {
    /// Nothing, or some of its bytes are still missing.
    Nothing,
    /// The writer is paused, or needs no further messages: its verdict has changed.
    Paused,
    /// It was decoded.
    Decoded,
    /// It was decoded, and a managed node has left the first state for its present one.
    Transition(LifecycleState, ManagedNode),
    /// It is malformed.
    Malformed(Standard, WireError),
}

/// Where and when a message was seen.
#[derive(Clone, Copy, Debug)]
pub struct Origin<'a> {
    /// Time of its arrival.
    pub at: ModelTime,
    /// Domain of its writer.
    pub domain_id: DomainId,
    /// Topic.
    pub topic: &'a TopicName,
    /// Its writer.
    pub writer: Guid,
    /// Its sequence number.
    pub number: SequenceNumber,
    /// Whether a message of a higher number was read before: this one was retransmitted.
    pub is_late: bool,
    /// The node that has the writer.
    pub node: Option<&'a NodeName>,
}

impl Allowances {
    const fn of(&mut self, standard: Standard) -> &mut CommonAllowance {
        match standard {
            Standard::Transforms => &mut self.transforms,
            _ => &mut self.others,
        }
    }
}

impl Default for Robot {
    fn default() -> Self {
        Self {
            writers: Bounded::default(),
            has_refused: false,
            has_refused_frame: false,
            assembly: Assembly::new(ASSEMBLY_BYTES),
            allowances: Allowances {
                transforms: CommonAllowance::new(COMMON_BROADCASTER_ALLOWANCE, RESUME_BYTES),
                others: CommonAllowance::new(COMMON_ALLOWANCE, RESUME_BYTES),
            },
            logs: Logs::default(),
            diagnostics: Diagnostics::default(),
            parameters: Parameters::default(),
            transforms: Transforms::default(),
            frames: Frames::default(),
            lifecycle: Lifecycle::default(),
            fields: Fields::default(),
            memory_faults: [None; MemoryFault::ALL.len()],
            memory_changes: 0,
        }
    }
}

impl Robot {
    /// Sets what the configuration expects.
    pub fn expect(&mut self, expectations: RobotExpectations) {
        let RobotExpectations {
            active,
            parameters,
            fields,
        } = expectations;
        self.lifecycle.expect(active);
        self.parameters.expect(&parameters);
        self.fields.expect(fields);
    }

    /// Records the use of the directories of shared memory.
    pub fn use_shared_memory(&mut self, memory: &MemoryUse) {
        for (fault, begun) in MemoryFault::ALL.into_iter().zip(&mut self.memory_faults) {
            let exists = fault.exists(memory, begun.is_some());
            if exists != begun.is_some() {
                *begun = exists.then(|| fault.figure(memory));
                self.memory_changes += 1;
            }
        }
    }

    /// Returns what is read of writers of this type on this topic; `None` if nothing is.
    #[must_use]
    pub fn reading(
        &self,
        topic: &TopicName,
        message_type: &TypeName,
        parts: Parts,
    ) -> Option<Reading> {
        let is_wanted = || self.fields.cover(topic, message_type);
        // A recording may be replayed to another topic, such as `/tf_old`.
        let is_read = |standard: &Standard| match standard {
            Standard::Transforms => transforms::is_topic(topic),
            _ => true,
        };
        let standard = Standard::of(message_type).filter(is_read);
        match standard.or_else(|| is_wanted().then_some(Standard::Fields)) {
            Some(standard) => parts
                .has(standard.part())
                .then_some(Reading::Messages(standard)),
            None => {
                let has_frame = parts.has(Part::Transforms) && names_a_frame(message_type);
                has_frame.then_some(Reading::Frame)
            }
        }
    }

    /// Begins to read this writer, unless the table of such writers is full.
    pub fn follow(
        &mut self,
        writer: Guid,
        (domain_id, topic): (DomainId, &TopicName),
        reading: Reading,
    ) {
        let standard = match reading {
            Reading::Messages(standard) => standard,
            Reading::Frame => {
                self.has_refused_frame |= !self.frames.follow(writer, domain_id, topic);
                return;
            }
        };
        let new = || RobotWriter {
            domain_id,
            topic: topic.clone(),
            standard,
            allowance: WriterAllowance::new(match standard {
                Standard::Transforms => BROADCASTER_ALLOWANCE,
                _ => WRITER_ALLOWANCE,
            }),
            read: ReadNumbers::default(),
            view: View::Network,
        };
        self.has_refused |= self.writers.get_or_insert_with(writer, new).is_none();
        if standard == Standard::Transforms {
            // A static broadcaster that is refused counts as unread.
            self.transforms.follow(writer, domain_id, topic);
        }
    }

    /// Returns whether a table refused a writer and has room again. The caller should then call
    /// [`Self::follow`] for each writer that [`Self::has_place_for`] admits.
    #[must_use]
    pub fn may_retry(&self) -> bool {
        self.has_refused && !self.writers.is_full()
            || self.has_refused_frame && !self.frames.is_full()
    }

    /// Begins a retry. Writers that are refused from now on cause another one.
    pub const fn retry(&mut self) {
        (self.has_refused, self.has_refused_frame) = (false, false);
    }

    /// Returns whether the writer is not followed and its table has room. A table without room
    /// counts as one that refused the writer.
    pub fn has_place_for(&mut self, writer: Guid, reading: Reading) -> bool {
        let (is_known, is_full, has_refused) = match reading {
            Reading::Messages(_) => (
                self.writers.contains_key(&writer),
                self.writers.is_full(),
                &mut self.has_refused,
            ),
            Reading::Frame => (
                self.frames.knows(writer),
                self.frames.is_full(),
                &mut self.has_refused_frame,
            ),
        };
        *has_refused |= !is_known && is_full;
        !is_known && !is_full
    }

    /// Stops reading this writer.
    pub fn forget(&mut self, writer: Guid) {
        self.frames.forget(writer);
        self.transforms.forget_unread(writer);
        if let Some(known) = self.writers.remove(&writer) {
            self.allowances.of(known.standard).forget(&known.allowance);
            self.assembly.release(writer);
            match known.standard.part() {
                Part::Logs | Part::Clocks => {}
                Part::Diagnostics => self.diagnostics.forget(writer),
                Part::Parameters => self.parameters.forget(writer),
                Part::Transforms => self.transforms.forget(writer),
                Part::Lifecycle => self.lifecycle.forget(writer),
                Part::Fields => self.fields.forget(writer),
            }
        }
    }

    /// Returns whether the kernel should capture this writer.
    #[must_use]
    pub fn is_captured(&self, writer: Guid) -> bool {
        self.writers
            .get(&writer)
            .is_some_and(|known| !known.allowance.is_paused())
            || self.frames.waits(writer)
    }

    /// Returns whether a writer of a standard type is known.
    #[must_use]
    pub fn is_used(&self) -> bool {
        !self.writers.is_empty()
    }

    /// Reads a DATA or DATA_FRAG of a followed writer. `node` is the node that has the writer.
    /// `vendor` is its implementation. `call` identifies the call of a request or reply.
    pub fn read_sample(
        &mut self,
        sample: &Sample,
        payload: &[u8],
        (node, vendor): (Option<&NodeName>, VendorId),
        call: impl FnOnce(Half) -> Option<CallId>,
        events: &mut Events,
    ) -> ReadOutcome {
        let (writer, now) = (sample.head.writer, sample.head.at);
        if sample.is_message() && sample.is_start() && self.frames.waits(writer) {
            self.frames.read(writer, payload);
            return ReadOutcome::Paused;
        }
        let Some(known) = self.writers.get_mut(&writer) else {
            return ReadOutcome::Nothing;
        };
        // Until the kernel knows of a pause, it captures more.
        let allowance = self.allowances.of(known.standard);
        let is_allowed = allowance.spend(&mut known.allowance, payload.len(), now);
        if known.allowance.is_paused() || !sample.is_message() {
            return ReadOutcome::Nothing;
        }
        let bytes = usize::try_from(sample.size()).unwrap_or(usize::MAX);
        if !is_allowed || bytes > MESSAGE_BYTES {
            allowance.pause(&mut known.allowance);
            self.assembly.release(writer);
            return ReadOutcome::Paused;
        }
        let number = sample.sequence_number;
        let source = sample.source_timestamp.timestamp();
        let is_copy = known.read.has(number, source);
        match sample.head.path {
            Path::SharedMemory { exact: false } if is_copy => {}
            Path::SharedMemory { exact: false } => known.view = View::Sampled,
            Path::SharedMemory { exact: true } => known.view = View::Exact,
            Path::Wire | Path::Socket | Path::Stream { .. } => known.view = View::Network,
        }
        if is_copy {
            return ReadOutcome::Nothing;
        }
        let standard = known.standard;
        let assembled;
        let payload = match sample.is_start() && sample.is_end() {
            true => payload,
            false => {
                self.assembly.put(sample, payload, 0);
                if !self.assembly.is_whole(writer, number) {
                    return ReadOutcome::Nothing;
                }
                let Some(bytes) = self.assembly.take(writer, number) else {
                    return ReadOutcome::Nothing;
                };
                assembled = bytes;
                &assembled
            }
        };
        let is_late = known.read.add(number, source);
        let origin = Origin {
            at: now,
            domain_id: known.domain_id,
            topic: &known.topic,
            writer,
            number,
            is_late,
            node,
        };
        let decoded = match standard {
            Standard::Log => log::Log::parse(payload).map(|log| self.logs.add(&origin, &log)),
            Standard::Diagnostics => DiagnosticStatuses::parse(payload)
                .and_then(|statuses| self.diagnostics.add(&origin, statuses, events)),
            Standard::ParameterEvent => ParameterEvent::parse(payload)
                .and_then(|event| self.parameters.add(&origin, event, events)),
            Standard::Transforms => wire_transforms::Transforms::parse(payload)
                .and_then(|transforms| self.transforms.add(&origin, transforms, events)),
            // These have one state for each writer.
            Standard::TransitionEvent | Standard::LifecycleState | Standard::Fields if is_late => {
                Ok(())
            }
            Standard::TransitionEvent => match Transition::parse(payload) {
                Ok(transition) => match self.lifecycle.transit(&origin, transition) {
                    Some(node) => return ReadOutcome::Transition(transition.from, node),
                    None => Ok(()),
                },
                Err(error) => Err(error),
            },
            Standard::LifecycleState => LifecycleState::of_reply(payload, header(vendor))
                .map(|state| self.lifecycle.replied(&origin, state)),
            Standard::Fields => {
                self.fields.add(&origin, payload);
                Ok(())
            }
            Standard::SetParameters => {
                ros_parameters::Parameters::of_request(payload, header(vendor))
                    .and_then(|parameters| self.parameters.request(&origin, parameters))
            }
            Standard::GetParameters => RequestedNames::of_request(payload, header(vendor))
                .and_then(|names| self.parameters.add_get_request(call(Half::Requests), names)),
            Standard::ParameterValues => {
                RepliedValues::of_reply(payload, header(vendor)).and_then(|values| {
                    self.parameters
                        .replied(&origin, call(Half::Replies), values)
                })
            }
        };
        match decoded {
            Ok(()) => ReadOutcome::Decoded,
            Err(error) => ReadOutcome::Malformed(standard, error),
        }
    }

    /// Records that probes no longer see the messages in shared memory.
    pub fn end_exact_view(&mut self) {
        for known in self.writers.values_mut() {
            if known.view == View::Exact {
                known.view = View::Sampled;
            }
        }
    }

    /// Ends a second: unfinished messages and old errors expire. `is_hidden` returns whether all
    /// messages of a writer pass through shared memory. Returns the writers that are captured again.
    pub fn end_second(
        &mut self,
        now: ModelTime,
        is_hidden: impl Fn(Guid) -> bool,
        events: &mut Events,
    ) -> Vec<Guid> {
        self.assembly.expire(now);
        self.logs.end_second();
        // A writer that seems silent may be sending.
        let is_unseen = |writer| {
            let known = self.writers.get(&writer);
            known.is_some_and(|known: &RobotWriter| {
                known.allowance.is_paused()
                    || match known.view {
                        View::Network => is_hidden(writer),
                        View::Exact => false,
                        View::Sampled => true,
                    }
            })
        };
        self.diagnostics.end_second(now, is_unseen, events);
        self.transforms.end_second(now, is_unseen);
        self.frames.end_second(now, &self.transforms);
        self.lifecycle.end_second(now);
        self.parameters.end_second(now);
        let mut resumed = Vec::new();
        let Allowances { transforms, others } = &mut self.allowances;
        for (allowance, is_of_transforms) in [(others, false), (transforms, true)] {
            let writers = self.writers.iter_mut();
            let writers = writers
                .filter(|(_, known)| (known.standard == Standard::Transforms) == is_of_transforms)
                .map(|(writer, known)| (writer, &mut known.allowance));
            resumed.extend(allowance.resume(writers, now));
        }
        resumed
    }

    /// Removes and returns the messages of logs since the last call.
    pub fn take_logs(&mut self) -> logs::NewLogs {
        self.logs.take()
    }

    /// Returns the logs of all nodes.
    #[must_use]
    pub const fn logs(&self) -> &Logs {
        &self.logs
    }

    /// Returns the diagnostics of all robots.
    #[must_use]
    pub const fn diagnostics(&self) -> &Diagnostics {
        &self.diagnostics
    }

    /// Returns the parameters of all nodes.
    #[must_use]
    pub const fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Returns the transforms of all robots.
    #[must_use]
    pub const fn transforms(&self) -> &Transforms {
        &self.transforms
    }

    /// Returns the managed nodes of all robots.
    #[must_use]
    pub const fn lifecycle(&self) -> &Lifecycle {
        &self.lifecycle
    }

    /// Returns the last message of each writer whose fields have metrics.
    #[must_use]
    pub fn field_messages(&self, discovery: &Discovery) -> Vec<FieldMessage> {
        self.fields.facts(discovery)
    }

    /// Returns the number of changes of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.logs.revision()
            + self.diagnostics.revision()
            + self.transforms.revision()
            + self.frames.revision()
            + self.lifecycle.revision()
            + self.parameters.revision()
            + self.memory_changes
    }

    /// Returns the problems that the robot reports about itself.
    pub fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let logged = self.logs.findings();
        let memory = MemoryFault::ALL.into_iter().zip(self.memory_faults);
        let memory = memory.filter_map(|(fault, figure)| {
            figure.map(|figure| Diagnosis::SharedMemoryFault { fault, figure })
        });
        logged
            .chain(self.diagnostics.findings())
            .chain(self.transforms.findings())
            .chain(self.frames.findings())
            .chain(self.lifecycle.findings())
            .chain(self.parameters.findings())
            .chain(memory)
    }

    /// Returns the sizes and limits of the tables.
    #[must_use]
    pub fn tables(&self) -> Vec<TableFacts> {
        let mut tables = vec![self.writers.facts()];
        tables.extend(self.logs.tables());
        tables.extend(self.diagnostics.tables());
        tables.extend(self.parameters.tables());
        tables.extend(self.transforms.tables());
        tables.push(self.frames.table());
        tables.push(self.lifecycle.table());
        tables.extend(self.fields.tables());
        tables
    }
}

impl Origin<'_> {
    /// Returns whether a value is of a later message of the same writer than this one.
    #[must_use]
    pub fn precedes(&self, writer: Guid, number: SequenceNumber) -> bool {
        // After a restart of the writer, its lower numbers are later.
        self.is_late && self.writer == writer && self.number < number
    }
}

/// Returns the length of the header that this implementation sends before requests and replies.
const fn header(vendor: VendorId) -> usize {
    match vendor {
        VendorId::CYCLONE => RequestHeader::LENGTH,
        _ => 0,
    }
}
