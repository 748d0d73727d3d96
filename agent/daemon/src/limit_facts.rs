//! Usage of the configured caps, and the number of entries refused or evicted per cap.
//!
//! The model counts most of these entries in its tables. Resources of surfaces and recordings
//! (connection slots, bags, watches) are counted here.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use super::snapshot_cell::State;
use crate::config::{Limit, Limits};

const LIMIT_COUNT: usize = Limit::ALL.len();
/// Time for which a limit counts as reached after a refusal or eviction.
const REACHED_FOR: Duration = Duration::from_secs(60);

/// State of one cap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LimitFacts {
    /// Identity of the cap.
    pub limit: Limit,
    /// Maximum number of entries, connections or bytes.
    pub cap: u64,
    /// Current number of entries, connections or bytes.
    pub used: u64,
    /// Number refused or evicted since the start.
    pub reached: u64,
    /// Whether the cap is reached now, or was within the last minute.
    pub at_limit: bool,
}

/// Caps in force, and counters for resources outside of the model.
#[derive(Debug)]
pub struct LimitFigures {
    caps: Limits,
    /// Usage of resources that have no slots.
    used: [AtomicU64; LIMIT_COUNT],
    reached: [AtomicU64; LIMIT_COUNT],
    rises: Mutex<[Rise; LIMIT_COUNT]>,
    slots: Mutex<Vec<(Limit, Weak<Slots>)>>,
}

/// Time of the last increase of a counter.
#[derive(Clone, Copy, Debug, Default)]
struct Rise {
    count: u64,
    at: Option<Instant>,
}

/// A limited number of slots.
#[derive(Debug)]
pub struct Slots {
    cap: usize,
    taken: AtomicUsize,
}

/// One slot, which is released when it is dropped.
#[derive(Debug)]
pub struct Slot {
    of: Arc<Slots>,
}

impl LimitFigures {
    /// Creates the figures with zero usage.
    #[must_use]
    pub fn new(caps: Limits) -> Self {
        Self {
            caps,
            used: std::array::from_fn(|_| AtomicU64::new(0)),
            reached: std::array::from_fn(|_| AtomicU64::new(0)),
            rises: Mutex::default(),
            slots: Mutex::default(),
        }
    }

    /// Returns the caps.
    #[must_use]
    pub const fn caps(&self) -> &Limits {
        &self.caps
    }

    /// Creates slots for `limit`. Each listener has its own slots, so that a full listener does not
    /// block the others.
    #[must_use]
    pub fn slots(&self, limit: Limit) -> Arc<Slots> {
        let slots = Arc::new(Slots {
            cap: self.caps.get(limit),
            taken: AtomicUsize::new(0),
        });
        let mut all = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        all.push((limit, Arc::downgrade(&slots)));
        slots
    }

    /// Sets the current usage.
    pub fn set_used(&self, limit: Limit, used: usize) {
        if let Some(slot) = self.used.get(limit as usize) {
            slot.store(used as u64, Ordering::Relaxed);
        }
    }

    /// Counts refused or evicted entries.
    pub fn reached(&self, limit: Limit, count: usize) {
        if let Some(reached) = self.reached.get(limit as usize) {
            reached.fetch_add(count as u64, Ordering::Relaxed);
        }
    }

    /// Updates the times of refusals and evictions from `state`.
    pub fn note(&self, state: &State) {
        let mut rises = self.rises.lock().unwrap_or_else(PoisonError::into_inner);
        for (rise, limit) in rises.iter_mut().zip(Limit::ALL) {
            let (_, count) = self.usage(limit, state);
            if count > rise.count {
                rise.at = Some(state.agent.collected_at);
            }
            rise.count = count;
        }
    }

    /// Returns the state of all caps, with the model's counters from `state`.
    #[must_use]
    pub fn facts(&self, state: &State) -> [LimitFacts; LIMIT_COUNT] {
        let rises = *self.rises.lock().unwrap_or_else(PoisonError::into_inner);
        let is_recent =
            |at: Instant| state.agent.collected_at.saturating_duration_since(at) < REACHED_FOR;
        Limit::ALL.map(|limit| {
            let (used, reached) = self.usage(limit, state);
            let cap = self.caps.get(limit) as u64;
            let rise = rises.get(limit as usize).and_then(|rise| rise.at);
            LimitFacts {
                limit,
                cap,
                used,
                reached,
                at_limit: used >= cap || rise.is_some_and(is_recent),
            }
        })
    }

    /// Returns the reached limits that hide part of the robot, as text; `None` if no limit does.
    #[must_use]
    pub fn degraded(&self, state: &State) -> Option<String> {
        let all = self.facts(state).into_iter();
        let reached = all.filter(|facts| facts.at_limit && facts.limit.hides_data());
        let reached = reached.map(|facts| {
            let LimitFacts {
                limit, cap, used, ..
            } = facts;
            let refused = match facts.reached {
                0 => String::new(),
                count => format!(", {count} refused or evicted"),
            };
            format!("{} ({used} of {cap}{refused})", limit.key())
        });
        let reached: Vec<_> = reached.collect();
        (!reached.is_empty()).then(|| format!("at a limit: {}", reached.join(", ")))
    }

    fn usage(&self, limit: Limit, state: &State) -> (u64, u64) {
        let (agent, known) = (&state.agent, state.known());
        let table = |name: &str| {
            let table = known.tables.iter().find(|table| table.table == name);
            table.map_or((0, 0), |table| (table.size, table.evictions))
        };
        match limit {
            Limit::Participants => table("participants"),
            Limit::Endpoints => table("endpoints"),
            Limit::Topics => (known.topics_measured, known.topics_rejected),
            Limit::UnknownWriters => table("unknown_writers"),
            Limit::Flows => table("deliveries"),
            Limit::ReassemblyBytes => (agent.reassembly_bytes, agent.reassembly_evicted),
            Limit::Subscriptions => {
                let facts = &agent.subscriptions;
                (facts.open as u64, facts.refused)
            }
            Limit::PayloadBytes => {
                let facts = &agent.subscriptions;
                let (bytes, given_up) = table("payloads");
                (
                    bytes + facts.queued_bytes as u64,
                    given_up + facts.crowded_out,
                )
            }
            Limit::Watches
            | Limit::Recordings
            | Limit::ApiClients
            | Limit::MetricsClients
            | Limit::FoxgloveClients => self.own(limit),
        }
    }

    fn own(&self, limit: Limit) -> (u64, u64) {
        let read = |counts: &[AtomicU64; LIMIT_COUNT]| {
            let count = counts.get(limit as usize);
            count.map_or(0, |count| count.load(Ordering::Relaxed))
        };
        let all = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let slots = all.iter().filter(|(of, _)| *of == limit);
        let taken = slots.filter_map(|(_, slots)| Some(slots.upgrade()?.taken() as u64));
        // The listener with the highest usage is the first to refuse a connection.
        let taken = taken.max().unwrap_or(0);
        (taken.max(read(&self.used)), read(&self.reached))
    }
}

impl Slots {
    /// Takes a slot; returns `None` if all are in use.
    pub fn take(self: &Arc<Self>) -> Option<Slot> {
        let more = |taken| (taken < self.cap).then_some(taken + 1);
        let taken = self
            .taken
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
        taken.ok().map(|_| Slot {
            of: Arc::clone(self),
        })
    }

    /// Returns the number of slots.
    #[must_use]
    pub const fn cap(&self) -> usize {
        self.cap
    }

    fn taken(&self) -> usize {
        self.taken.load(Ordering::Relaxed)
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.of.taken.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent_facts::{AgentFacts, SourceKind};
    use ros2probe_model::report::snapshot::{Snapshot, TableFacts};

    #[test]
    fn slots_are_limited_by_the_cap_and_can_be_reused() {
        let figures = LimitFigures::new(Limits {
            recordings: 2,
            ..Limits::default()
        });
        let slots = figures.slots(Limit::Recordings);
        let taken = [slots.take().unwrap(), slots.take().unwrap()];
        assert!(slots.take().is_none());
        figures.reached(Limit::Recordings, 1);
        assert_eq!(figures.own(Limit::Recordings), (2, 1));
        drop(taken);
        assert_eq!(figures.own(Limit::Recordings), (0, 1));
        assert!(slots.take().is_some());
    }

    #[test]
    fn a_limit_counts_as_reached_while_full_and_for_a_minute_after_a_refusal() {
        let figures = LimitFigures::new(Limits {
            participants: 10,
            ..Limits::default()
        });
        let start = Instant::now();
        let at = |seconds: u64, size: u64, evictions: u64| {
            let at = start + Duration::from_secs(seconds);
            let table = TableFacts {
                table: "participants",
                size,
                limit: 10,
                bytes: None,
                evictions,
            };
            let snapshot = Snapshot {
                tables: vec![table],
                ..Snapshot::default()
            };
            let state = State {
                snapshot: Some(Arc::new(snapshot)),
                agent: AgentFacts::new(SourceKind::Wire, at),
            };
            figures.note(&state);
            figures.degraded(&state)
        };
        let full = Some("at a limit: participants (10 of 10)".to_owned());
        assert_eq!(at(0, 9, 0), None);
        assert_eq!(at(1, 10, 0), full);
        assert_eq!(at(2, 9, 0), None);
        assert!(at(3, 10, 5).is_some());
        let lately = "at a limit: participants (9 of 10, 5 refused or evicted)";
        assert_eq!(at(62, 9, 5).as_deref(), Some(lately));
        assert_eq!(at(63, 9, 5), None);
        // Limits of clients do not hide any part of the robot.
        figures.set_used(Limit::Watches, 1_000);
        assert_eq!(at(64, 9, 5), None);
    }

    #[test]
    fn usage_is_that_of_the_fullest_listener_and_ignores_closed_ones() {
        let figures = LimitFigures::new(Limits::default());
        let (one, other) = (
            figures.slots(Limit::ApiClients),
            figures.slots(Limit::ApiClients),
        );
        let _one = one.take().unwrap();
        let two = [other.take().unwrap(), other.take().unwrap()];
        assert_eq!(figures.own(Limit::ApiClients).0, 2);
        drop((two, other));
        assert_eq!(figures.own(Limit::ApiClients).0, 1);
        assert_eq!(figures.own(Limit::MetricsClients), (0, 0));
    }
}
