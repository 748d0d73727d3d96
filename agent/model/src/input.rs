//! What goes into the model and what comes out of it.

use std::sync::Arc;

use ros2probe_wire::record::{Handover, Verdict};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Guid, GuidPrefix, Reason, Record, Timestamp};

use crate::discovery::Memory;
use crate::dispatch::Dispatch;
use crate::event::Taken;
use crate::selection::SampleRequest;
use crate::sockets::SocketFacts;
use crate::trace::Spans;
use crate::watch::Watchlist;

/// One input of the model. Times are nanoseconds since the Unix epoch.
#[derive(Debug)]
pub enum Input<'a> {
    /// Time has come this far: leases end, gaps settle, expectations are judged.
    Time(Timestamp),
    /// The wall clock was set forward by so many nanoseconds, or back. No time passed by that.
    ClockSet(i64),
    /// A datagram that was captured whole.
    Datagram {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The RTPS message.
        payload: &'a [u8],
        /// Where the kernel filter stopped walking; it has reported the part before.
        handover: Option<&'a Handover>,
    },
    /// A datagram of which a capture file kept the beginning only. Its payloads are not read.
    CutDatagram {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// What is left of the RTPS message.
        payload: &'a [u8],
        /// Bytes of the whole RTPS message.
        length: u32,
    },
    /// A captured datagram of which discovery alone counts now.
    Announcements {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The RTPS message.
        payload: &'a [u8],
        /// Takes the records of user data, for the caller to put in order with others.
        records: &'a mut Vec<Record>,
    },
    /// A message that was read in shared memory, where others may have been missed.
    SharedMemory {
        /// Its source and time.
        envelope: &'a Envelope,
        /// The RTPS message.
        payload: &'a [u8],
    },
    /// Shared memory was not polled for longer than its rings hold: loss before now is unknown.
    SharedMemoryGap(Timestamp),
    /// Uprobes no longer see what processes send into shared memory: what is read there counts.
    ProbesDetached,
    /// A record of a complete datagram, made by the kernel filter.
    Record(&'a Record),
    /// A participant was last seen then, as the kernel filter knows without a record.
    ParticipantAlive(GuidPrefix, Timestamp),
    /// Facts about a socket, again whenever they change.
    Socket(SocketFacts),
    /// The socket with this cookie was closed.
    SocketClosed(u64),
    /// The socket with this cookie may be open, but the kernel's table forgot it.
    SocketForgotten(u64),
    /// A source could not read what it captured.
    DecodeError {
        /// What was being read.
        stage: &'static str,
        /// Why not.
        reason: Reason,
    },
    /// What to measure from now on.
    Watchlist(Arc<Watchlist>),
    /// Samples to give from now on. Their topics are measured meanwhile.
    SampleRequests(Arc<Vec<SampleRequest>>),
    /// What was known before a restart, valid for at most one lease from `now` on.
    Restored {
        /// What was known.
        memory: &'a Memory,
        /// When the model starts.
        now: Timestamp,
    },
    /// Nothing more will come: decides what is open, without letting time pass.
    End,
}

/// What the model has for others since it was drained last.
#[derive(Debug, Default)]
pub struct Output {
    /// Changed verdicts for the kernel filter; `None` = remove the entry.
    pub interest: Vec<(Guid, Option<Verdict>)>,
    /// Events, and how many were left out.
    pub events: Taken,
    /// Samples that were asked for, and those that are missing.
    pub samples: Vec<Dispatch>,
    /// Spans of traced samples that ended.
    pub spans: Spans,
}
