//! `/why`: late calls of callbacks, and what made them late.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::inside::{Owner, Trigger};

/// Late calls of callbacks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Why<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// What is observed: `off`, `sums` (the scheduler's accounting), or `events` (also who ran
    /// instead, and for what a callback waited).
    pub observed: Cow<'a, str>,
    /// Why less is observed than this request needs; null if everything is.
    pub reason: Option<Cow<'a, str>>,
    /// Causes of the late calls in the period of the request, the most frequent first.
    pub causes: Vec<Cause<'a>>,
    /// Callbacks with late calls in that period, that with the most late calls first.
    pub callbacks: Vec<LateCallback<'a>>,
}

/// A cause of late calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Cause<'a> {
    /// Stage in which the calls became late: `publish`, `network`, `socket`, `receive`, `wait` or
    /// `callback`. The first three end when the message is sent, arrives at the subscriber's
    /// socket, and is received there. `receive` ends when a thread of the middleware wakes the
    /// executor. The others end when the call starts, and when it ends. Only messages through UDP
    /// sockets have `network` and `socket`. Others have `receive`. A message that waited for the
    /// retransmission of an earlier one has both, and its `receive` ends when that one arrives.
    pub stage: Cow<'a, str>,
    /// `cpu`, `stolen`, `throttled`, `runnable`, `lock`, `sleep`, `disk`, `page_fault`, `stopped`,
    /// `system_call`, `blocked`, `other_callback`, `arrival`, `send`, `transit`,
    /// `repaired`, `queue`, `middleware` or `unexplained`.
    pub cause: Cow<'a, str>,
    /// Name of the thread that ran instead, released the lock, continued the process, or sent the
    /// message; null for other causes.
    pub by: Option<Cow<'a, str>>,
    /// Systemd unit, container or control group of that thread, as in [`OtherThread`].
    pub by_unit: Option<Cow<'a, str>>,
    /// Late calls.
    pub late_calls: u64,
    /// The longest of these calls, from ready to the end.
    pub longest_seconds: f64,
    /// The cause in words.
    pub words: Cow<'a, str>,
    /// What helps.
    pub remedy: Cow<'a, str>,
}

/// Late calls of one callback.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LateCallback<'a> {
    /// Process and node of the callback. The process may have ended.
    #[serde(flatten)]
    pub owner: Owner<'a>,
    /// Trigger of the callback.
    pub trigger: Trigger<'a>,
    /// All calls of the callback since its observation began, which is later than that of the late
    /// calls after a rest; null if the process has ended, or if the late calls are more.
    pub calls: Option<u64>,
    /// Late calls since the agent started.
    pub late_calls: u64,
    /// What the time of all late calls consisted of.
    pub parts: Vec<Part<'a>>,
    /// Examples: the longest and the last late calls, the longest first.
    pub examples: Vec<LateCall<'a>>,
    /// The last late calls, at most 128, the oldest first; empty unless the request has
    /// `history=true`.
    pub history: Vec<LateCallSummary<'a>>,
}

/// A late call in a list of many.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LateCallSummary<'a> {
    /// Unix time of the start of the call.
    pub timestamp_seconds: f64,
    /// Time from ready to the end of the call.
    pub total_seconds: f64,
    /// Stage in which it became late, as in [`Cause`].
    pub stage: Cow<'a, str>,
    /// What made it late, as in [`Cause`].
    pub cause: Cow<'a, str>,
    /// The cause in words.
    pub words: Cow<'a, str>,
}

/// A part of the time of late calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Part<'a> {
    /// Stage, as in [`Cause`].
    pub stage: Cow<'a, str>,
    /// Cause, as in [`Cause`].
    pub cause: Cow<'a, str>,
    /// Length of the part.
    pub seconds: f64,
}

/// One late call. Its parts add up to its wait and its duration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LateCall<'a> {
    /// Unix time of the start of the call.
    pub timestamp_seconds: f64,
    /// Source timestamp of the message in Unix time; null without a message.
    pub source_timestamp_seconds: Option<f64>,
    /// Duration of the call.
    pub duration_seconds: f64,
    /// Time from ready to start; null if it is unknown.
    pub wait_seconds: Option<f64>,
    /// Duration from which on a call of this callback is late.
    pub late_duration_seconds: f64,
    /// Wait from which on a call of this callback is late; null without one.
    pub late_wait_seconds: Option<f64>,
    /// Thread of the call.
    pub thread_id: u32,
    /// Thread of the middleware that received the message, or woke the thread of the call; null if
    /// that was not observed.
    pub receiver_thread_id: Option<u32>,
    /// CPU on which the call ended.
    pub cpu: u32,
    /// Stage in which it became late; null if it is unknown.
    pub stage: Option<Cow<'a, str>>,
    /// What made it late; null if it is unknown.
    pub cause: Option<Cow<'a, str>>,
    /// The cause in words.
    pub words: Cow<'a, str>,
    /// Parts of its time, in the order of the stages.
    pub parts: Vec<Part<'a>>,
    /// Threads that ran while the callback, or the thread that received its message, could run.
    pub others: Vec<OtherThread<'a>>,
    /// The longest time for which the callback was blocked.
    pub blocked: Option<Blocked<'a>>,
    /// Limits on the speed of CPUs, at most a second after the call, in words: a lower maximum
    /// frequency, heat, or a weak power supply.
    pub cpu_limits: Vec<Cow<'a, str>>,
    /// The call for which it waited, otherwise the call before in the same thread.
    pub previous: Option<PreviousCall<'a>>,
}

/// A thread that ran instead.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct OtherThread<'a> {
    /// Name of the thread.
    pub name: Cow<'a, str>,
    /// Thread id; 0 = the CPU was idle.
    pub thread_id: u32,
    /// Id of its process.
    pub process_id: u32,
    /// First digits of its container's id, else its systemd unit, else the last part of its control
    /// group's path; null for the root group, or if the path is not found.
    #[cfg_attr(feature = "openapi", schema(example = "kiosk.service"))]
    pub unit: Option<Cow<'a, str>>,
    /// Its priority when it last left the CPU: `real-time N`, `nice N` or `deadline`; null if it is
    /// unknown, as for a thread that ended a wait.
    #[cfg_attr(feature = "openapi", schema(example = "nice -5"))]
    pub priority: Option<Cow<'a, str>>,
    /// Time for which it ran instead.
    pub seconds: f64,
}

/// A time in which a callback was blocked.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Blocked<'a> {
    /// Its length.
    pub seconds: f64,
    /// Cause, as in [`Cause`].
    pub cause: Cow<'a, str>,
    /// System call; null outside of one.
    pub system_call: Option<Cow<'a, str>>,
    /// First argument of the system call: the address of a lock, or a file descriptor.
    #[cfg_attr(feature = "openapi", schema(example = "0x7f2c00"))]
    pub argument: Cow<'a, str>,
    /// Thread that released the lock, or continued the process; null for other waits.
    pub ended_by: Option<OtherThread<'a>>,
}

/// An earlier call.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct PreviousCall<'a> {
    /// Trigger of its callback.
    pub trigger: Trigger<'a>,
    /// Its duration.
    pub duration_seconds: f64,
    /// Time from its end to the start of the late call.
    pub ended_before_seconds: f64,
}
