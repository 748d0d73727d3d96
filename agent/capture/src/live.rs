//! This host's traffic, read from its taps and passed to the model in capture order.
//!
//! The source observes sockets if the kernel and the configuration allow it, otherwise interfaces
//! with one tap per namespace. It observes both if configured interfaces have traffic that no
//! socket receives. It sends nothing.

mod facts;
mod open;

use std::fmt;
use std::os::fd::BorrowedFd;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use ros2probe_wire::filter::Budget;
use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Guid, GuidPrefix, Timestamp};
use rustix::thread::CapabilitySet;

use super::clock_step::ClockStep;
use super::container::{FAMILIES_LINE, is_container, is_service};
use super::error_chain::in_words;
use super::filter::{
    Filter, FilterError, UNKNOWN_BYTES_PER_SECOND, UNKNOWN_PORTIONS, UNKNOWN_RECORDS_PER_TENTH,
    holds,
};
use super::filter_reader::{self, FilterReader};
use super::host_tap::{HostTap, HostTapError};
use super::interfaces::{InterfacesError, Selection};
use super::netns::NetnsError;
use super::shm::SharedMemory;
use super::shm::directories::{Scope, ShmDirectories};
use super::shm::poll_interval::Budget as Shares;
use super::system::{Clocks, give_back_memory, wait};
use super::tcx;
use super::threads::Spawn;
use super::uprobe::Uprobe;
use super::wire_tap::{self, WireTap, WireTapError};
use crate::inside::Inside;
use crate::inside::late::LateDemand;
use crate::reassembly::Limits;
use crate::settings::{CaptureSettings, ShmMode, WireChoice};
use open::{open_exact, open_host, open_inside, open_wires, scope};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Wanted};

/// Time for which captures of the host hook accumulate: a starting node announces its endpoints one
/// by one, and each round costs CPU time.
const READ_INTERVAL: Duration = Duration::from_millis(10);
/// Shorter time while whole samples are captured: a point cloud fills the ring in a few
/// milliseconds.
const PAYLOAD_READ_INTERVAL: Duration = Duration::from_millis(2);
const REFILL_INTERVAL: u64 = SECOND / 10;
/// Time between two rounds that indicates a delay of this process; longer than any wait for
/// packets.
const MAX_ROUND_GAP: u64 = 2 * SECOND;

/// Why capturing cannot start or continue.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// The host hook is required but unavailable.
    #[error("the host hook is unavailable")]
    Host(#[from] HostTapError),
    /// An interface cannot be observed.
    #[error(transparent)]
    Tap(#[from] WireTapError),
    /// Another network namespace cannot be entered.
    #[error(transparent)]
    Namespace(#[from] NetnsError),
    /// The host hook is unavailable for this reason, and packet sockets are not permitted either.
    #[error("{without_host}{}", instead())]
    Neither {
        /// Why the host hook is unavailable.
        without_host: String,
    },
    /// An interface glob is invalid.
    #[error("capture.interfaces has an invalid glob")]
    Selection(#[from] globset::Error),
    /// The kernel programs failed.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// Waiting for packets failed.
    #[error("failed to wait for packets")]
    Wait(#[source] std::io::Error),
}

impl CaptureError {
    /// Returns whether interfaces cannot be observed because a right is missing. A restart does not
    /// help then.
    #[must_use]
    pub const fn is_permission_error(&self) -> bool {
        matches!(
            self,
            Self::Neither { .. } | Self::Tap(WireTapError::Interfaces(InterfacesError::Family(_)))
        )
    }
}

/// All taps of this host.
pub struct LiveSource {
    host: Option<HostTap>,
    wires: Vec<WireTap>,
    /// Why the host hook is not used although it would show more.
    without_host: Option<String>,
    shared_memory: Shm,
    exact: Option<Uprobe>,
    /// Why shared-memory messages are not read in their senders although that is configured.
    without_exact: Option<String>,
    inside: Option<Inside>,
    /// Why processes are not observed from inside although that is configured.
    without_inside: Option<String>,
    /// Time of the last refill of the byte budget of unknown writers.
    bytes_refilled: u64,
    records_refilled: u64,
    /// Time when the model's requests for shared memory were last passed on.
    last_requests_passed: u64,
    /// Whether the last round did not pass the requests on, so that a change may wait.
    has_pending_requests: bool,
    /// Time when the participants' last messages were last read from the programs, for a lease.
    last_liveliness_read: u64,
    /// Number of attachments to a recreated control group at the last report.
    reported_reattachments: u64,
    refused_updates: u64,
    clock: Timestamp,
    clocks: Clocks,
    clock_step: ClockStep,
}

/// The observer of shared memory. Its thread begins when the source is started.
enum Shm {
    Off,
    Later(Scope, Shares),
    Running(SharedMemory),
}

/// A part of the source with a thread of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Follows the control group of `capture.cgroup`.
    ControlGroup,
    /// Polls shared memory.
    SharedMemory,
    /// Attaches breakpoints for `capture.shm.exact`.
    Exact,
    /// Observes processes for `capture.inside`.
    Inside,
}

impl Part {
    /// Returns the configuration key of the part.
    #[must_use]
    pub const fn key(self) -> &'static str {
        match self {
            Self::ControlGroup => "capture.cgroup",
            Self::SharedMemory => "capture.shm",
            Self::Exact => "capture.shm.exact",
            Self::Inside => "capture.inside",
        }
    }
}

/// A part whose thread makes no progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stalled {
    /// The part.
    pub part: Part,
    /// Time since its last progress.
    pub time: Duration,
}

impl fmt::Display for Stalled {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{}: its thread has made no progress for {} s: a file or a call of the kernel does not \
            answer",
            self.part.key(),
            self.time.as_secs()
        )
    }
}

/// Frames of one interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Interface name; its index if the interface disappeared before the name was known.
    pub name: String,
    /// Frames that passed the filter.
    pub packets: u64,
}

/// Frames dropped by the kernel in one namespace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DropCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Frames lost because the packet ring was full.
    pub dropped: u64,
}

/// Returns what a unit of systemd needs to observe interfaces instead; an empty text elsewhere.
fn instead() -> String {
    if !is_service() || is_container() {
        return String::new();
    }
    let rights = match tcx::check() {
        Ok(()) => "",
        Err(_) => "`CapabilityBoundingSet=CAP_NET_RAW`, `AmbientCapabilities=CAP_NET_RAW` and ",
    };
    format!(
        "; to observe interfaces instead, the unit needs {rights}`{FAMILIES_LINE}` \
         (`systemctl edit`)"
    )
}

/// Adds why the host hook is unavailable, if packet sockets are not permitted either.
fn with_reason(error: CaptureError, without_host: Option<&String>) -> CaptureError {
    match without_host {
        Some(reason) if !holds(CapabilitySet::NET_RAW) => CaptureError::Neither {
            without_host: reason.clone(),
        },
        _ => error,
    }
}

impl LiveSource {
    /// Opens the configured taps, or the best ones available. Every tap captures when this returns.
    ///
    /// # Errors
    /// Fails if a capability is missing, a namespace does not exist, or the kernel refuses a tap.
    pub fn open(settings: &CaptureSettings, limits: Limits) -> Result<Self, CaptureError> {
        let (mut host, without_host) = open_host(settings)?;
        let wires = match &host {
            None => {
                let (include, exclude) =
                    (&settings.include_interfaces, &settings.exclude_interfaces);
                open_wires(settings, limits, Selection::new(include, exclude)?)
                    .map_err(|error| with_reason(error, without_host.as_ref()))?
            }
            Some(_) if settings.mirror_interfaces.is_empty() => Vec::new(),
            Some(_) => {
                let mirrors = Selection::new(&settings.mirror_interfaces, &[])?;
                open_wires(settings, limits, mirrors)?
            }
        };
        let (exact, without_exact) = open_exact(settings, host.is_some());
        let (inside, without_inside) = open_inside(settings, host.as_mut());
        give_back_memory();
        let shared_memory = match settings.shm.mode {
            ShmMode::Off => Shm::Off,
            ShmMode::Auto => {
                let budget = Shares {
                    watching: settings.shm.cpu_percent / 100.0,
                    every: settings.shm.reading_cpu_percent / 100.0,
                };
                Shm::Later(scope(settings, host.is_some()), budget)
            }
        };
        let clocks = Clocks::read();
        let mut source = Self {
            host,
            wires,
            without_host,
            shared_memory,
            exact,
            without_exact,
            inside,
            without_inside,
            bytes_refilled: 0,
            records_refilled: 0,
            last_requests_passed: 0,
            has_pending_requests: false,
            last_liveliness_read: 0,
            reported_reattachments: 0,
            refused_updates: 0,
            clock: clocks.now,
            clocks,
            clock_step: ClockStep::new(&clocks),
        };
        source.refill(clocks.monotonic);
        Ok(source)
    }

    /// Starts the threads that need their own privileges with `spawn`, before the caller drops its
    /// privileges.
    pub fn start(&mut self, spawn: Spawn) {
        if let Some(exact) = &mut self.exact
            && let Err(error) = exact.start(spawn)
        {
            let reason = in_words(&error);
            tracing::warn!(reason, "uprobes are not attached to libraries loaded later");
        }
        if let Some(host) = &mut self.host
            && let Err(error) = host.start(spawn)
        {
            let reason = in_words(&error);
            tracing::warn!(reason, "a recreated cgroup is not observed");
        }
        for wire in &mut self.wires {
            if let Err(error) = wire.start(spawn) {
                let reason = in_words(&error);
                tracing::warn!(reason, "interfaces that appear later are not observed");
            }
        }
        if let Some(inside) = &mut self.inside
            && let Err(error) = inside.start(spawn)
        {
            let reason = in_words(&error);
            tracing::warn!(reason, "processes are not observed from inside");
            (self.inside, self.without_inside) = (None, Some(reason));
        }
        self.start_shared_memory(spawn);
    }

    /// Sets whether a client needs calls inside processes, if they are observed on demand.
    pub fn request_inside(&self, wanted: bool) {
        self.inside
            .iter()
            .for_each(|inside| inside.set_calls_requested(wanted));
    }

    /// Sets which calls clients regard as late, and whether one requests their causes.
    pub fn request_late_calls(&self, demand: &LateDemand) {
        self.inside
            .iter()
            .for_each(|inside| inside.set_late_demand(demand));
    }

    /// Waits for packets until `timeout` expires or `bell` is readable, and passes everything
    /// available to the model.
    ///
    /// # Errors
    /// Fails if the kernel refuses to continue.
    pub fn poll(
        &mut self,
        timeout: Duration,
        bell: Option<BorrowedFd<'_>>,
        observer: &mut Observer,
    ) -> Result<(), CaptureError> {
        if let Shm::Running(shared_memory) = &self.shared_memory {
            let covers_all = self.exact.as_ref().is_some_and(Uprobe::covers_all);
            shared_memory.pause(covers_all);
        }
        let sockets = self.host.iter().flat_map(HostTap::descriptors);
        let interfaces = self.wires.iter().flat_map(WireTap::descriptors);
        let processes = self.exact.iter().flat_map(Uprobe::descriptors);
        let rings = bell.is_some().into();
        let looks = match &self.shared_memory {
            Shm::Running(shared_memory) => shared_memory.descriptor(),
            Shm::Off | Shm::Later(..) => None,
        };
        let taps = sockets.chain(processes).chain(interfaces).chain(looks);
        let descriptors: Vec<_> = bell.into_iter().chain(taps).collect();
        let began = Instant::now();
        let timeout = match self.has_pending_requests {
            true => timeout.min(Duration::from_nanos(REFILL_INTERVAL)),
            false => timeout,
        };
        let ready = wait(&descriptors, timeout).map_err(CaptureError::Wait)?;
        let woken = ready.is_some_and(|first| first >= rings) && began.elapsed() < timeout;
        // A packet socket collects frames by itself.
        let wakes_soon = self.host.is_some()
            || self.exact.is_some()
            || self.wire_hook() == Some(WireChoice::Tcx);
        if wakes_soon && woken {
            // Packets arrive in bursts. After a timeout, packets have already had time to
            // accumulate.
            std::thread::sleep(if observer.needs_payloads() {
                PAYLOAD_READ_INTERVAL
            } else {
                READ_INTERVAL
            });
        }
        let mut clocks = Clocks::read();
        let step = self.clock_step.update(&mut clocks);
        if step != 0 {
            let milliseconds = step / 1_000_000;
            tracing::info!(
                milliseconds,
                "the system's clock was set, or the system slept"
            );
            // Times of earlier rounds are those of the clock before.
            self.take_rounds(Timestamp(u64::MAX), observer);
            observer.input(Input::ClockSet(step));
        }
        let held_up = clocks.monotonic.saturating_sub(self.clocks.monotonic) >= MAX_ROUND_GAP;
        self.clocks = clocks;
        self.refill(clocks.monotonic);
        let mut settle = 0;
        self.leave_exact_mode(&clocks, observer);
        self.take_polled(&clocks, observer);
        if let Some(host) = &mut self.host {
            host.poll(&clocks, observer);
            settle = filter_reader::SETTLE_NANOSECONDS;
        }
        if let Some(exact) = &mut self.exact {
            exact.poll(&clocks, observer);
            settle = filter_reader::SETTLE_NANOSECONDS;
        }
        for wire in &mut self.wires {
            let at_sockets = self.host.as_ref().map(|host| host.reader().streams());
            wire.poll(&clocks, at_sockets, observer)?;
            settle = settle.max(wire_tap::SETTLE_NANOSECONDS);
        }
        self.clock = Timestamp(clocks.now.0.saturating_sub(settle));
        self.take_rounds(self.clock, observer);
        self.apply_wanted(clocks.monotonic, observer);
        self.report_view(held_up, observer);
        // Any message renews a lease. If this process did not read its rings for a long time, the
        // announcements may not have fit.
        let clock = self.clock;
        let ends = observer.next_expiry().is_some_and(|end| end <= clock);
        let is_due = clocks.monotonic.wrapping_sub(self.last_liveliness_read) >= REFILL_INTERVAL;
        if held_up || ends && is_due {
            self.last_liveliness_read = clocks.monotonic;
            for (prefix, at) in self.last_seen() {
                observer.input(Input::ParticipantAlive(prefix, at));
            }
        }
        Ok(())
    }

    /// Reports that observation begins again after a gap: this process or the machine was stopped,
    /// or the control group was removed.
    fn report_view(&mut self, held_up: bool, observer: &mut Observer) {
        let attached_anew = self.reattachments();
        let is_new =
            std::mem::replace(&mut self.reported_reattachments, attached_anew) != attached_anew;
        let sees_nothing = self.wires.is_empty()
            && self
                .host
                .as_ref()
                .is_some_and(|host| host.detached().is_some());
        if held_up || is_new || sees_nothing {
            observer.input(Input::ViewBegan(self.clock));
        }
    }

    /// Passes the model's requests for shared memory to its readers, ten times a second.
    fn apply_wanted(&mut self, now: u64, observer: &Observer) {
        self.has_pending_requests = now.wrapping_sub(self.last_requests_passed) < REFILL_INTERVAL;
        if self.has_pending_requests {
            return;
        }
        self.last_requests_passed = now;
        self.apply_requests(observer);
    }

    fn apply_requests(&self, observer: &Observer) {
        let wanted = observer.wanted_of_shared_memory();
        if let Shm::Running(shared_memory) = &self.shared_memory {
            shared_memory.set_need(wanted);
        }
        if let Some(exact) = &self.exact {
            exact.set_demand(wanted == Wanted::EverySample);
        }
    }

    /// Passes the model's requests for shared memory to its readers immediately. Returns whether
    /// the programs that read every sample are still being attached.
    pub fn is_attaching(&self, observer: &Observer) -> bool {
        self.apply_requests(observer);
        self.exact.as_ref().is_some_and(Uprobe::is_attaching)
    }

    /// Passes all buffered data to the model at the end.
    pub fn drain(&mut self, observer: &mut Observer) {
        let clocks = Clocks::read();
        self.take_polled(&clocks, observer);
        if let Some(host) = &mut self.host {
            host.drain(&clocks, observer);
        }
        if let Some(exact) = &mut self.exact {
            exact.drain(&clocks, observer);
        }
        for wire in &mut self.wires {
            wire.drain(&clocks, observer);
        }
        self.take_rounds(Timestamp(u64::MAX), observer);
    }

    /// Passes rounds of calls to the model, up to the time until which it has the records: a call
    /// follows its message.
    fn take_rounds(&self, until: Timestamp, observer: &mut Observer) {
        for round in self.inside.iter().flat_map(|inside| inside.take(until)) {
            observer.input(Input::Inside(round.report));
            for publication in &round.publications {
                observer.input(Input::CausalPublication(publication));
            }
            if round.is_last {
                observer.input(Input::InsideDetached);
            }
        }
    }

    /// Passes samples polled in shared memory to the model, or to a buffer. Polling may miss a
    /// sample that uprobes or sockets see, and a later polled sample must not overtake it.
    fn take_polled(&mut self, clocks: &Clocks, observer: &mut Observer) {
        if let Shm::Running(shared_memory) = &self.shared_memory {
            let exact = self.exact.as_mut().and_then(Uprobe::order_mut);
            let host = self.host.as_mut().map(HostTap::order_mut);
            shared_memory.poll(clocks, exact.or(host), observer);
        }
    }

    /// Updates the kernel programs' interest maps. Endpoints that do not fit stay unknown and are
    /// counted.
    pub fn apply(&mut self, changes: &[(Guid, Option<Verdict>)]) {
        for (endpoint, verdict) in changes {
            self.each_filter(|filter| filter.set_interest(*endpoint, *verdict));
        }
        if let Shm::Running(shared_memory) = &self.shared_memory {
            shared_memory.apply(changes);
        }
    }

    /// Starts or stops recording the time of a participant's last message.
    pub fn follow(&mut self, participant: GuidPrefix, follow: bool) {
        self.each_filter(|filter| filter.follow_participant(participant, follow));
    }

    /// Switches to sampling of shared memory: the programs identify their control group by a
    /// number, and a recreated group has another one.
    fn leave_exact_mode(&mut self, clocks: &Clocks, observer: &mut Observer) {
        if self.reattachments() > 0
            && let Some(mut exact) = self.exact.take()
        {
            exact.drain(clocks, observer);
            observer.input(Input::ProbesDetached);
            let reason =
                "the cgroup was recreated: restart the agent to capture each of its messages";
            tracing::warn!(reason, "shared memory is sampled");
            self.without_exact = Some(reason.to_owned());
        }
    }

    fn readers(&self) -> impl Iterator<Item = &FilterReader> {
        let host = self.host.iter().map(HostTap::reader);
        host.chain(self.exact.iter().map(Uprobe::reader))
    }

    fn start_shared_memory(&mut self, spawn: Spawn) {
        let Shm::Later(scope, budget) = &self.shared_memory else {
            return;
        };
        let directories = ShmDirectories::new(scope.clone());
        let has_breakpoints = self.exact.is_some();
        let started = SharedMemory::start(directories, *budget, has_breakpoints, spawn);
        self.shared_memory = match started {
            Ok(running) => Shm::Running(running),
            Err(error) => {
                let reason = in_words(&error);
                tracing::warn!(reason, "shared memory is not read");
                Shm::Off
            }
        };
    }

    fn filters(&self) -> impl Iterator<Item = &Filter> {
        let readers = self.readers().map(FilterReader::filter);
        readers.chain(self.wires.iter().map(WireTap::filter))
    }

    fn each_filter(&mut self, mut what: impl FnMut(&mut Filter) -> Result<(), FilterError>) {
        let host = self.host.iter_mut().map(HostTap::filter_mut);
        let exact = self.exact.iter_mut().map(Uprobe::filter_mut);
        for filter in host
            .chain(exact)
            .chain(self.wires.iter_mut().map(WireTap::filter_mut))
        {
            self.refused_updates += u64::from(what(filter).is_err());
        }
    }

    fn refill(&mut self, monotonic: u64) {
        if monotonic.wrapping_sub(self.bytes_refilled) >= SECOND - REFILL_INTERVAL {
            self.bytes_refilled = monotonic;
            let (budget, amount) = (Budget::CaptureBytes, UNKNOWN_BYTES_PER_SECOND);
            self.each_filter(|filter| filter.set_unknown_budget(budget, amount));
        }
        let tenths = monotonic.wrapping_sub(self.records_refilled) / REFILL_INTERVAL;
        if tenths > 0 {
            self.records_refilled = monotonic;
            let tenths = u32::try_from(tenths).unwrap_or(UNKNOWN_PORTIONS);
            let portions = tenths.min(UNKNOWN_PORTIONS);
            let (budget, amount) = (Budget::Records, UNKNOWN_RECORDS_PER_TENTH * portions);
            self.each_filter(|filter| filter.set_unknown_budget(budget, amount));
        }
    }
}
