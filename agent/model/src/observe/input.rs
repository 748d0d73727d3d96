//! Inputs and outputs of the model.

use std::sync::Arc;

use ros2probe_wire::record::{Handover, Verdict};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::walk::{Envelope, Found, Outcome};
use ros2probe_wire::{Guid, GuidPrefix, Reason, Timestamp};

use crate::derive::chain::causality::CausalPublication;
use crate::derive::chain::expected::ExpectedChain;
use crate::derive::chain::spans::ChainSpans;
use crate::derive::robot::RobotExpectations;
use crate::derive::robot::logs::LogMessage;
use crate::derive::trace::Spans;
use crate::derive::type_descriptions::TypeSource;
use crate::facts::calls::facts::NewLateCalls;
use crate::facts::calls::report::Report;
use crate::facts::dispatch::Dispatch;
use crate::facts::event::Taken;
use crate::facts::observation::Observation;
use crate::facts::route::Destination;
use crate::facts::selection::SampleRequest;
use crate::facts::shared_memory::MemoryUse;
use crate::facts::watch::Watchlist;
use crate::graph::discovery::Memory;
use crate::graph::sockets::SocketFacts;
use crate::graph::zenoh::Flow;
use crate::graph::zenoh::StreamReport;
use crate::measure::links::LinkReport;

/// An input of the model. Times are in nanoseconds since the Unix epoch, except those of
/// observations.
#[derive(Debug)]
pub enum Input<'a> {
    /// The time has reached this value: leases expire, gaps settle, expectations are evaluated.
    Time(Timestamp),
    /// The wall clock was set forward by this many nanoseconds (backward if negative), without
    /// elapsed time.
    ClockSet(i64),
    /// The source sees the traffic since this time. Before, it saw none of it or only a part.
    ViewBegan(Timestamp),
    /// A datagram that was captured in full and whose user data has no other source: one of a capture
    /// file, or the rest that the kernel filter did not walk. Taps use [`Self::Submessage`].
    Datagram {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The RTPS message.
        payload: &'a [u8],
        /// The state in which the kernel filter stopped. It has reported all earlier submessages.
        handover: Option<&'a Handover>,
    },
    /// A datagram that the capture file truncated. Its payloads are not read.
    CutDatagram {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The captured part of the RTPS message.
        payload: &'a [u8],
        /// Length of the whole RTPS message in bytes.
        length: u32,
    },
    /// The beginning of an RTPS message on a TCP connection, whose rest the source left out. Its
    /// payloads are not read.
    MessageBeginning {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The beginning of the RTPS message.
        payload: &'a [u8],
        /// Length of the whole RTPS message in bytes.
        length: u32,
    },
    /// Bytes of an RTPS connection over TCP were not captured: samples for this destination that are
    /// missing before this time may have arrived.
    StreamGap(Destination, Timestamp),
    /// A submessage of a captured datagram, which is read for discovery and payloads. The caller
    /// passes observations of user data separately, in their order. [`Self::DatagramEnd`] follows
    /// the last one.
    Submessage {
        /// The datagram.
        captured: Captured<'a>,
        /// The submessage.
        found: &'a Found<'a>,
    },
    /// The end of a captured datagram whose submessages were passed one by one.
    DatagramEnd(Outcome),
    /// A message that was sampled from shared memory, where others may have been missed.
    SharedMemory {
        /// Its source and time.
        envelope: &'a Envelope,
        /// The RTPS message.
        payload: &'a [u8],
    },
    /// The polling gap exceeds the shared-memory ring; loss before this time is unknown.
    SharedMemoryGap(Timestamp),
    /// The use of the directories of shared memory.
    SharedMemoryUsed(MemoryUse),
    /// Uprobes no longer observe writes to shared memory, so sampled messages count again.
    ProbesDetached,
    /// The sender's state of a TCP connection to another host.
    Link(&'a LinkReport),
    /// A client begins a handshake of TLS in this direction.
    ClientHello(Flow),
    /// A report about one direction of a Zenoh connection.
    Zenoh(&'a StreamReport<'a>),
    /// A submessage that a source saw, with model time from [`Observer::wall_clock`].
    ///
    /// [`Observer::wall_clock`]: crate::observe::observer::Observer::wall_clock
    Observation(&'a Observation),
    /// The time at which a participant last sent a packet, from the kernel filter.
    ParticipantAlive(GuidPrefix, Timestamp),
    /// Facts about a socket; repeated when they change.
    Socket(SocketFacts),
    /// The socket with this cookie was closed.
    SocketClosed(u64),
    /// All sockets were read whose facts have changed. Sessions of Zenoh are attributed to the
    /// processes that hold their sockets.
    SocketsRead,
    /// The kernel's table dropped the socket with this cookie, which may still be open.
    SocketForgotten(u64),
    /// Figures from inside processes, with times of this host's clock.
    Inside(Report),
    /// Calls inside processes are no longer observed; later figures begin at zero.
    InsideDetached,
    /// A source failed to parse captured bytes.
    DecodeError {
        /// The stage of parsing.
        stage: &'static str,
        /// The reason.
        reason: Reason,
    },
    /// The topics to measure from now on.
    Watchlist(Arc<Watchlist>),
    /// Apply the lists to further topics, until [`Observer::has_applied_lists`].
    ///
    /// [`Observer::has_applied_lists`]: crate::observe::observer::Observer::has_applied_lists
    MoreLists,
    /// The samples to dispatch from now on. Their topics are measured as long as they are
    /// requested.
    SampleRequests(Arc<Vec<SampleRequest>>),
    /// The chains with a limit for their latency. The topics between their ends are measured.
    ExpectedChains(Arc<Vec<ExpectedChain>>),
    /// What the configuration expects of the robot.
    RobotExpectations(RobotExpectations),
    /// A publication within the callback that processes an input, from inside a process.
    CausalPublication(&'a CausalPublication),
    /// State from before a restart, valid for at most one lease from `now` on.
    Restored {
        /// The saved state.
        memory: &'a Memory,
        /// Time at which the model starts.
        now: Timestamp,
    },
    /// The input has ended: open decisions are made without elapsed time.
    End,
    /// The agent ends: samples that wait for others are dispatched, and those in shared memory that
    /// are still awaited are reported as missing. Open losses stay undecided.
    Stopping,
}

/// A captured datagram, without its submessages.
#[derive(Clone, Copy, Debug)]
pub struct Captured<'a> {
    /// Its addresses and time.
    pub envelope: &'a Envelope,
    /// vendorId of the message header (RTPS 2.5, 8.3.3); `None` if it is VENDORID_UNKNOWN.
    pub vendor: Option<VendorId>,
    /// Whether it was polled in shared memory, where others may have been missed.
    pub is_polled: bool,
}

impl<'a> Captured<'a> {
    /// Describes a datagram whose UDP payload is `payload`.
    #[must_use]
    pub fn new(envelope: &'a Envelope, payload: &[u8], is_polled: bool) -> Self {
        let vendor = payload
            .get(6..8)
            .and_then(|bytes| <[u8; 2]>::try_from(bytes).ok());
        Self {
            envelope,
            vendor: vendor.filter(|vendor| *vendor != [0, 0]).map(VendorId),
            is_polled,
        }
    }
}

/// A new message of a log.
#[derive(Clone, Debug)]
pub struct NewLog {
    /// Time of its arrival.
    pub arrival: Timestamp,
    /// Trace id; `None` if the message is not traced.
    pub trace_id: Option<u128>,
    /// The message.
    pub message: Arc<LogMessage>,
}

/// Outputs of the model since they were last drained.
#[derive(Debug, Default)]
pub struct Output {
    /// Changed verdicts for the kernel filter; `None` removes the entry.
    pub interest: Vec<(Guid, Option<Verdict>)>,
    /// Events, and how many were dropped.
    pub events: Taken,
    /// Requested samples, and reports of missing ones.
    pub samples: Vec<Dispatch>,
    /// Completed spans of traced samples.
    pub spans: Spans,
    /// Completed spans of traced chains.
    pub chain_spans: ChainSpans,
    /// Late calls of callbacks.
    pub late_calls: NewLateCalls,
    /// New messages of logs.
    pub logs: Vec<NewLog>,
    /// Number of messages of logs that were dropped because there were too many.
    pub lost_logs: u64,
    /// What nodes sent about their types.
    pub type_sources: Vec<TypeSource>,
}
