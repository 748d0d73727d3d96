//! This host's traffic: what its taps find, given to the model in the order in which it was captured.
//!
//! Each namespace has a tap of its own. Nothing is ever sent.

use std::collections::BTreeMap;
use std::os::fd::BorrowedFd;
use std::path::PathBuf;
use std::time::Duration;

use ros2probe_wire::filter::{Budget, Counter};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{Guid, GuidPrefix, Timestamp};

use super::interfaces::Selection;
use super::netns::{self, NetnsError};
use super::system::{Clocks, wait};
use super::wire::{self, TapError, WireSettings, WireTap};
use crate::config::CaptureSettings;
use crate::model::observer::Observer;
use crate::model::reassembly::Limits;

/// What unclassified writers may cost each second, all together: a dozen nodes that start at once
/// stay far below, a storm of forged ones stays bounded.
const UNKNOWN_BYTES_PER_SECOND: u32 = 4 << 20;
/// Handed out in small portions, so that a storm that comes while we are held up leaves most of the
/// record ring to the writers we know.
const UNKNOWN_RECORDS_PER_TENTH: u32 = 410;
const SECOND: u64 = 1_000_000_000;
const TENTH: u64 = SECOND / 10;

/// Why capturing could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// An interface cannot be looked at.
    #[error(transparent)]
    Tap(#[from] TapError),
    /// Another network namespace.
    #[error(transparent)]
    Namespace(#[from] NetnsError),
    /// An interface glob.
    #[error("capture.interfaces")]
    Selection(#[from] globset::Error),
    /// Waiting for packets.
    #[error("waiting for packets")]
    Wait(#[source] std::io::Error),
}

/// All taps.
pub struct LiveSource {
    taps: Vec<WireTap>,
    /// When unclassified writers last got bytes and records to spend.
    bytes_refilled: u64,
    records_refilled: u64,
    refused_updates: u64,
    clock: Timestamp,
}

/// What one interface delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Interface name, or its index if it went away before it was known.
    pub name: String,
    /// Frames that the filter let through.
    pub packets: u64,
}

/// What the kernel dropped for one namespace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DropCount {
    /// Network namespace as configured; `None` = the agent's own.
    pub namespace: Option<PathBuf>,
    /// Frames lost because the packet ring was full.
    pub dropped: u64,
}

impl LiveSource {
    /// Opens a tap in this network namespace and in each configured one. When this returns, every
    /// tap is capturing.
    ///
    /// # Errors
    /// A capability is missing, a namespace does not exist, the kernel refuses.
    pub fn open(settings: &CaptureSettings, limits: Limits) -> Result<Self, CaptureError> {
        let wire = WireSettings {
            selection: Selection::new(&settings.include_interfaces, &settings.exclude_interfaces)?,
            ring_bytes: settings.ring_bytes,
            record_ring_bytes: settings.record_ring_bytes,
            reassembly: limits,
        };
        let mut taps = vec![WireTap::open(&wire, 0, None)?];
        for (number, path) in (1..).zip(&settings.network_namespaces) {
            let open = || WireTap::open(&wire, number, Some(path.clone()));
            taps.push(netns::within(path, open)??);
        }
        let clocks = Clocks::read();
        let mut source = Self {
            taps,
            bytes_refilled: 0,
            records_refilled: 0,
            refused_updates: 0,
            clock: clocks.now,
        };
        source.refill(clocks.monotonic);
        Ok(source)
    }

    /// Waits for packets, up to `timeout` or until `bell` is readable, and gives the model all there
    /// is.
    ///
    /// # Errors
    /// The kernel refuses to go on.
    pub fn poll(
        &mut self,
        timeout: Duration,
        bell: Option<BorrowedFd<'_>>,
        observer: &mut Observer,
    ) -> Result<(), CaptureError> {
        let descriptors = self.taps.iter().flat_map(WireTap::descriptors);
        let descriptors: Vec<_> = descriptors.chain(bell).collect();
        wait(&descriptors, timeout).map_err(CaptureError::Wait)?;
        let clocks = Clocks::read();
        self.refill(clocks.monotonic);
        for tap in &mut self.taps {
            tap.take_in(&clocks, observer)?;
        }
        self.clock = Timestamp(clocks.now.0.saturating_sub(wire::SETTLE_NANOSECONDS));
        Ok(())
    }

    /// Gives the model what still waits, at the end.
    pub fn drain(&mut self, observer: &mut Observer) {
        let clocks = Clocks::read();
        for tap in &mut self.taps {
            tap.drain(&clocks, observer);
        }
    }

    /// Tells the kernel filters what has become of interest. What they have no room for stays
    /// unknown to them, and is counted.
    pub fn apply(&mut self, changes: &[(Guid, Option<Verdict>)]) {
        for tap in &mut self.taps {
            for (endpoint, verdict) in changes {
                let told = tap.filter_mut().set_interest(*endpoint, *verdict);
                self.refused_updates += u64::from(told.is_err());
            }
        }
    }

    /// Notes from now on, or no longer, when a participant last sent anything.
    pub fn follow(&mut self, participant: GuidPrefix, follow: bool) {
        for tap in &mut self.taps {
            let told = tap.filter_mut().follow_participant(participant, follow);
            self.refused_updates += u64::from(told.is_err());
        }
    }

    /// Updates that a kernel map had no room for, or that the kernel refused.
    #[must_use]
    pub fn refused_updates(&self) -> u64 {
        let interfaces: u64 = self.taps.iter().map(WireTap::refused_interfaces).sum();
        self.refused_updates + interfaces
    }

    /// Time up to which everything captured has been given to the model.
    #[must_use]
    pub const fn clock(&self) -> Timestamp {
        self.clock
    }

    /// When each followed participant last sent anything.
    #[must_use]
    pub fn last_seen(&self) -> BTreeMap<GuidPrefix, Timestamp> {
        let clocks = Clocks::read();
        let mut seen = BTreeMap::new();
        for (participant, at) in self.taps.iter().flat_map(|tap| tap.filter().participants()) {
            let at = clocks.calendar(at);
            let latest = seen.entry(participant).or_insert(at);
            *latest = at.max(*latest);
        }
        seen
    }

    /// Captured frames by interface.
    pub fn packets(&self) -> impl Iterator<Item = InterfaceCount> + '_ {
        self.taps.iter().flat_map(|tap| {
            tap.packets().map(|(name, packets)| InterfaceCount {
                namespace: tap.namespace().map(Into::into),
                name,
                packets,
            })
        })
    }

    /// Frames that the kernel dropped, by namespace.
    ///
    /// # Errors
    /// The kernel does not tell.
    pub fn drops(&mut self) -> Result<Vec<DropCount>, CaptureError> {
        self.taps
            .iter_mut()
            .map(|tap| {
                Ok(DropCount {
                    namespace: tap.namespace().map(Into::into),
                    dropped: tap.drops()?,
                })
            })
            .collect()
    }

    /// The kernel filters' counters, summed.
    ///
    /// # Errors
    /// The kernel does not tell.
    pub fn counters(&self) -> Result<Vec<(Counter, u64)>, CaptureError> {
        let mut sums: Vec<_> = Counter::ALL.map(|counter| (counter, 0)).into();
        for tap in &self.taps {
            for ((_, sum), (_, value)) in sums
                .iter_mut()
                .zip(tap.filter().counters().map_err(TapError::from)?)
            {
                *sum += value;
            }
        }
        Ok(sums)
    }

    /// Bytes that came from the kernel: frames and records.
    #[must_use]
    pub fn copied_bytes(&self) -> u64 {
        self.taps.iter().map(|tap| tap.copied_bytes()).sum()
    }

    /// Fragmented datagrams that were begun and never became complete: the kernel filter's and
    /// those reassembled here.
    #[must_use]
    pub fn incomplete_datagrams(&self) -> u64 {
        self.taps.iter().map(WireTap::incomplete_datagrams).sum()
    }

    /// Bytes held for reassembly.
    #[must_use]
    pub fn reassembly_bytes(&self) -> usize {
        self.taps.iter().map(WireTap::reassembly_bytes).sum()
    }

    fn refill(&mut self, monotonic: u64) {
        let mut set = |budget, amount| {
            for tap in &mut self.taps {
                let refilled = tap.filter_mut().set_unknown_budget(budget, amount);
                self.refused_updates += u64::from(refilled.is_err());
            }
        };
        if monotonic.wrapping_sub(self.bytes_refilled) >= SECOND {
            self.bytes_refilled = monotonic;
            set(Budget::CaptureBytes, UNKNOWN_BYTES_PER_SECOND);
        }
        if monotonic.wrapping_sub(self.records_refilled) >= TENTH {
            self.records_refilled = monotonic;
            set(Budget::Records, UNKNOWN_RECORDS_PER_TENTH);
        }
    }
}
