//! Late calls of callbacks: their causes, and examples.
//!
//! Each callback keeps sums over all late calls, and a short entry for each of the last ones. It
//! keeps the longest and the last ones with all their parts. These facts remain after the process
//! has ended, so that a client can request a cause later.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;

use super::findings::Alarm;
use crate::facts::bounded::Bounded;
use crate::facts::calls::facts::{LateCallback, LateEntry, LateExample, NewLateCalls, Owner};
use crate::facts::calls::late::{Cause, LateCall, Part, Stage};
use crate::facts::calls::other_thread::OtherThread;
use crate::facts::calls::report::{ThreadStates, Trigger};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{LastLateCalls, LateCallbacks, LateHistory, LongestLateCalls};
use crate::facts::wall_clock::WallClock;

/// Time after which a longer example may be replaced by a shorter one.
const LONGEST_CALL_LIFETIME: Duration = Duration::from_secs(3600);
/// Time over which late calls are counted for a finding.
const WINDOW: Duration = Duration::from_secs(60);
/// Minimum number of late calls with one cause in that time.
const MIN_LATE_CALLS: usize = 3;

/// Late calls by process and callback.
#[derive(Debug, Default)]
pub(super) struct LateCalls {
    callbacks: Bounded<LateCallbacks, BTreeMap<(u32, u64), Lateness>>,
    new: NewLateCalls,
}

/// Late calls of one callback.
#[derive(Debug)]
struct Lateness {
    owner: Owner,
    trigger: Trigger,
    calls: u64,
    last: ModelTime,
    /// Time of all late calls by stage and cause.
    sums: BTreeMap<(Stage, Cause), Duration>,
    /// Late calls by the cause that made them late.
    causes: BTreeMap<(Stage, Cause), u64>,
    history: Arc<Bounded<LateHistory, VecDeque<LateEntry>>>,
    longest: Bounded<LongestLateCalls, Vec<Arc<LateExample>>>,
    latest: Bounded<LastLateCalls, VecDeque<Arc<LateExample>>>,
    alarm: Alarm,
    /// The stage and cause of the alarm.
    alarm_cause: Option<(Stage, Cause)>,
}

/// What a finding says about a callback.
#[derive(Debug)]
pub(super) struct Late<'a> {
    pub(super) owner: &'a Owner,
    pub(super) trigger: &'a Trigger,
    /// Late calls in the window with this cause.
    pub(super) calls: u64,
    pub(super) stage: Stage,
    pub(super) cause: Cause,
    /// The longest of them.
    pub(super) longest: &'a LateEntry,
}

impl LateCalls {
    /// Adds a late call. `usual` is what the time of all calls consisted of.
    pub(super) fn add(
        &mut self,
        call: LateCall,
        domain_id: DomainId,
        usual: ThreadStates,
        clock: WallClock,
    ) {
        let key = (call.process, call.handle);
        self.callbacks.make_room(&key, |lateness| lateness.last);
        let started = clock.model_time(call.started);
        let new = || Lateness::new(&call, domain_id, started);
        let Some(lateness) = self.callbacks.get_or_insert_with(key, new) else {
            return;
        };
        let example = lateness.add(call, usual, started);
        let left_out = self.new.calls.push((domain_id, example));
        self.new.lost += u64::from(left_out.is_some());
    }

    /// Removes and returns the late calls since the last call.
    pub(super) fn take_new(&mut self) -> NewLateCalls {
        std::mem::take(&mut self.new)
    }

    /// Evaluates the rule at `at`. Returns whether a finding appeared, ended or changed.
    pub(super) fn judge(&mut self, at: ModelTime) -> bool {
        let mut has_changed = false;
        for lateness in self.callbacks.values_mut() {
            has_changed |= lateness.judge(at);
        }
        has_changed
    }

    /// Ends all findings: there will be no reports for a while.
    pub(super) fn end_findings(&mut self) {
        for lateness in self.callbacks.values_mut() {
            (lateness.alarm, lateness.alarm_cause) = (Alarm::default(), None);
        }
    }

    /// Returns the present findings.
    pub(super) fn findings(&self, at: ModelTime) -> impl Iterator<Item = Late<'_>> {
        let raised = self.callbacks.values().filter_map(|lateness| {
            let (calls, _) = lateness.alarm.raised()?;
            Some((lateness, calls))
        });
        raised.filter_map(move |(lateness, calls)| {
            let (stage, cause) = lateness.alarm_cause?;
            let entries = lateness.history.iter();
            let of_cause = entries.filter(|entry| (entry.stage, entry.cause) == (stage, cause));
            Some(Late {
                owner: &lateness.owner,
                trigger: &lateness.trigger,
                calls,
                stage,
                cause,
                // The finding remains for some seconds after the window.
                longest: of_cause.max_by_key(|entry| (at - entry.at < WINDOW, entry.total))?,
            })
        })
    }

    /// Returns the facts for a snapshot.
    pub(super) fn facts(&self) -> Vec<LateCallback> {
        self.callbacks.values().map(Lateness::facts).collect()
    }
}

impl Lateness {
    fn new(call: &LateCall, domain_id: DomainId, started: ModelTime) -> Self {
        Self {
            owner: Owner {
                process: call.process,
                handle: call.handle,
                domain_id,
                node: None,
            },
            trigger: call.trigger.clone(),
            calls: 0,
            last: started,
            sums: BTreeMap::new(),
            causes: BTreeMap::new(),
            history: Arc::default(),
            longest: Bounded::default(),
            latest: Bounded::default(),
            alarm: Alarm::default(),
            alarm_cause: None,
        }
    }

    fn add(&mut self, call: LateCall, usual: ThreadStates, started: ModelTime) -> Arc<LateExample> {
        self.calls += 1;
        self.last = started;
        if call.node.is_some() {
            self.owner.node.clone_from(&call.node);
        }
        self.trigger.clone_from(&call.trigger);
        for part in call.parts() {
            *self.sums.entry((part.stage, part.cause)).or_default() += part.duration;
        }
        let main = call.main_part(usual);
        if let Some(part) = main {
            let Part { stage, cause, .. } = part;
            *self.causes.entry((stage, cause)).or_default() += 1;
            let thread_of_part = call.named_by(part);
            Arc::make_mut(&mut self.history).push_back(LateEntry {
                at: started,
                stage,
                cause,
                total: call.total(),
                other_thread: thread_of_part.map(OtherThread::label),
            });
        }
        let example = Arc::new(LateExample {
            at: started,
            main,
            call,
        });
        self.latest.push_back(Arc::clone(&example));
        self.keep_longest(Arc::clone(&example));
        example
    }

    fn keep_longest(&mut self, example: Arc<LateExample>) {
        if self.longest.is_full() {
            let rank = |kept: &LateExample| {
                let is_recent = example.at - kept.at < LONGEST_CALL_LIFETIME;
                (is_recent, kept.call.total())
            };
            let kept = self.longest.iter().enumerate();
            let Some((least, kept)) = kept.min_by_key(|(_, kept)| rank(kept)) else {
                return;
            };
            if rank(kept) >= (true, example.call.total()) {
                return;
            }
            self.longest.swap_remove(least);
        }
        self.longest.push(example);
    }

    /// Evaluates the rule at `at`. A finding keeps its cause while that cause alone violates the
    /// rule. Returns whether the finding appeared, ended or changed.
    fn judge(&mut self, at: ModelTime) -> bool {
        let is_raised = self.alarm.raised().is_some();
        let kept = self.alarm_cause.filter(|_| is_raised);
        let found = self.most_frequent_cause(at, kept);
        let mut has_changed = false;
        if let Some((cause, calls)) = found
            && self.alarm_cause != Some(cause)
        {
            self.alarm_cause = Some(cause);
            has_changed = self.alarm.restate((calls, 0));
        }
        self.alarm.judge(found.map(|(_, calls)| (calls, 0))) || has_changed
    }

    /// Returns a cause and its late calls in the window that ends at `at`; `None` if they are few. It
    /// is the most frequent cause, or `kept` if its late calls suffice.
    fn most_frequent_cause(
        &self,
        at: ModelTime,
        kept: Option<(Stage, Cause)>,
    ) -> Option<((Stage, Cause), u64)> {
        let recent = self.history.iter().rev();
        let recent = recent.take_while(|entry| at - entry.at < WINDOW);
        let mut counts: BTreeMap<(Stage, Cause), usize> = BTreeMap::new();
        for entry in recent {
            *counts.entry((entry.stage, entry.cause)).or_default() += 1;
        }
        counts.retain(|_, calls| *calls >= MIN_LATE_CALLS);
        let rank = |(cause, calls): &(_, usize)| (kept == Some(*cause), *calls);
        let (cause, calls) = counts.into_iter().max_by_key(rank)?;
        Some((cause, calls as u64))
    }

    fn facts(&self) -> LateCallback {
        LateCallback {
            owner: self.owner.clone(),
            trigger: self.trigger.clone(),
            calls: self.calls,
            sums: self.sums.iter().map(|(key, sum)| (*key, *sum)).collect(),
            causes: self.causes.iter().map(|(key, sum)| (*key, *sum)).collect(),
            history: Arc::clone(&self.history),
            longest: self.longest.to_vec(),
            latest: self.latest.iter().cloned().collect(),
        }
    }
}
