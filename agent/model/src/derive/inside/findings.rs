//! Problems that only calls inside processes show: callbacks that run longer than a timer's
//! period, callbacks that wait, messages overwritten in their queue.
//!
//! A rule is evaluated at each report, on the window of the last 5 to 10 s. A finding appears after
//! [`EVALUATIONS_TO_RAISE`] bad evaluations in a row and ends after [`EVALUATIONS_TO_CLEAR`] good
//! ones. Handles are not evaluated in their first [`STARTUP_GRACE`], because nodes load and connect
//! when they start. A finding keeps its value until the value grows by half, so that it does not
//! cause an event per second.

use std::time::Duration;

use ros2probe_wire::inside::distribution::{DELAY, INTERVAL};

use super::tracked::{Kind, Tracked};
use crate::facts::calls::report::{Durations, Trigger};
use crate::facts::model_time::ModelTime;

/// Number of bad evaluations in a row after which a finding appears.
const EVALUATIONS_TO_RAISE: u8 = 3;
/// Number of good evaluations in a row after which a finding ends.
const EVALUATIONS_TO_CLEAR: u8 = 10;
/// Time after the first report of a handle in which it is not evaluated.
pub(super) const STARTUP_GRACE: Duration = Duration::from_secs(10);
/// Minimum number of bad calls or messages in a window.
const MIN_VIOLATIONS: u64 = 3;
/// Minimum share of bad calls or messages in a window, as a divisor: 1 %.
const MIN_VIOLATION_DIVISOR: u64 = 100;
/// Minimum wait of a finding.
const MIN_REPORTED_WAIT: Duration = Duration::from_millis(100);
/// Time for which two callbacks must have run in one thread before one counts as a delay of the
/// other.
const SAME_THREAD: Duration = Duration::from_secs(10);

/// The state of one rule for one handle.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Alarm {
    bad: u8,
    good: u8,
    /// The finding's value, and the value with which it is compared.
    raised: Option<(u64, u64)>,
}

/// The state of all rules for one handle.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Alarms {
    /// Duration of a callback, and the period that it exceeds.
    pub(super) slow: Alarm,
    /// Wait of a callback.
    pub(super) wait: Alarm,
    /// Permille of messages overwritten, and number of messages put into the queue.
    pub(super) overwritten: Alarm,
}

/// A timer, and the thread that calls it.
#[derive(Clone, Copy, Debug)]
pub(super) struct TimerThread {
    pub(super) handle: u64,
    pub(super) thread: u32,
    pub(super) since: ModelTime,
    pub(super) period: Duration,
}

/// The longest callback of a thread, and the share of the window that its callbacks took.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ThreadLoad {
    pub(super) longest: Duration,
    pub(super) busy: f64,
}

impl Alarm {
    /// Evaluates the rule once; `found` is the value if it is bad. Returns whether the finding
    /// appeared, ended or changed.
    pub(super) fn judge(&mut self, found: Option<(u64, u64)>) -> bool {
        match found {
            Some(value) => {
                (self.bad, self.good) = (self.bad.saturating_add(1), 0);
                let grown = |(known, _): (u64, u64)| value.0 > known.saturating_add(known / 2);
                let is_new = self.bad >= EVALUATIONS_TO_RAISE && self.raised.is_none_or(grown);
                if is_new {
                    self.raised = Some(value);
                }
                is_new
            }
            None => {
                (self.bad, self.good) = (0, self.good.saturating_add(1));
                self.good >= EVALUATIONS_TO_CLEAR && self.raised.take().is_some()
            }
        }
    }

    /// Replaces the value of a finding, and returns whether there is one.
    pub(super) const fn restate(&mut self, value: (u64, u64)) -> bool {
        let is_raised = self.raised.is_some();
        if is_raised {
            self.raised = Some(value);
        }
        is_raised
    }

    /// Returns the finding's value, and the value with which it is compared.
    pub(super) const fn raised(&self) -> Option<(u64, u64)> {
        self.raised
    }
}

impl TimerThread {
    /// Returns the timer that this callback serves; `None` if it serves none or the period is
    /// unknown.
    pub(super) fn of(tracked: &Tracked) -> Option<Self> {
        let Some(Trigger::Timer(Some(period))) = tracked.figures.trigger() else {
            return None;
        };
        let is_called = tracked.recent.counts.count > 0;
        (is_called && !period.is_zero()).then_some(Self {
            handle: tracked.figures.handle,
            thread: tracked.figures.thread()?,
            since: tracked.thread_since,
            period: *period,
        })
    }
}

/// Evaluates all rules for a handle. Returns whether a finding appeared, ended or changed.
pub(super) fn judge(
    tracked: &mut Tracked,
    timers: &[TimerThread],
    load: ThreadLoad,
    at: ModelTime,
) -> bool {
    let is_young = at - tracked.since < STARTUP_GRACE;
    let unless_young = |found: Option<(u64, u64)>| found.filter(|_| !is_young);
    match tracked.figures.kind {
        Kind::Callback => {
            let slow = unless_young(slow(tracked, timers, at));
            let wait = unless_young(wait(tracked, load));
            let alarms = &mut tracked.alarms;
            let changed = alarms.slow.judge(slow);
            alarms.wait.judge(wait) || changed
        }
        Kind::Buffer => {
            let counts = tracked.recent.counts;
            let found = is_many(counts.failed, counts.count)
                .then_some((counts.failed * 1000 / counts.count.max(1), counts.count));
            tracked.alarms.overwritten.judge(unless_young(found))
        }
        Kind::Publisher | Kind::Subscription => false,
    }
}

/// Returns the 99th percentile of the callback's duration, and the shortest period that it exceeds:
/// its own timer's, or that of a timer which the same thread calls.
fn slow(tracked: &Tracked, timers: &[TimerThread], at: ModelTime) -> Option<(u64, u64)> {
    let thread = tracked.figures.thread()?;
    let is_delayed = |timer: &&TimerThread| {
        let since = timer.since.max(tracked.thread_since);
        timer.handle == tracked.figures.handle
            || timer.thread == thread && at - since >= SAME_THREAD
    };
    let periods = timers.iter().filter(is_delayed).map(|timer| timer.period);
    let period = periods.min()?;
    if tracked.recent.quantiles[INTERVAL].p99 <= period {
        return None;
    }
    let durations = tracked.window(INTERVAL)?;
    let p99 = exceeds(&durations, period)?;
    Some((nanoseconds(p99), nanoseconds(period)))
}

/// Returns the 99th percentile of the callback's wait, if that is longer than its interval and the
/// limit.
fn wait(tracked: &Tracked, load: ThreadLoad) -> Option<(u64, u64)> {
    let limit = interval(tracked)?.max(MIN_REPORTED_WAIT);
    if tracked.recent.quantiles[DELAY].p99 <= limit {
        return None;
    }
    let durations = tracked.window(DELAY)?;
    let p99 = exceeds(&durations, limit)?;
    // The wait of a message from the middleware includes its transport. The executor is the cause
    // only if the thread was busy for that long.
    let is_way = matches!(tracked.figures.trigger(), Some(Trigger::Subscription(_)));
    let is_busy = load.longest * 2 >= p99 || load.busy >= 0.8;
    (!is_way || is_busy).then_some((nanoseconds(p99), nanoseconds(limit)))
}

/// Returns the mean time between calls of the window, or the timer's period.
fn interval(tracked: &Tracked) -> Option<Duration> {
    if let Some(Trigger::Timer(Some(period))) = tracked.figures.trigger() {
        return Some(*period);
    }
    let calls = u32::try_from(tracked.recent.counts.count).ok()?;
    (calls > 0).then(|| tracked.recent.span / calls)
}

/// Returns the 99th percentile if enough durations are certainly longer than the limit: durations
/// in the bucket of the limit do not count.
fn exceeds(durations: &Durations, limit: Duration) -> Option<Duration> {
    let long = durations.above(limit);
    let p99 = durations.quantile(0.99)?;
    (is_many(long, durations.count()) && p99 > limit).then_some(p99)
}

pub(super) const fn is_many(bad: u64, all: u64) -> bool {
    bad >= MIN_VIOLATIONS && bad.saturating_mul(MIN_VIOLATION_DIVISOR) > all
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
