//! Evidence for the offset of one peer's clock, and the bounds that follow from it.

use std::time::Duration;

use ros2probe_wire::time::nanoseconds;

use crate::facts::model_time::ModelTime;
use crate::facts::wall_clock::WallClock;

/// A bound widens by one nanosecond in this many: 100 ppm, for two clocks that drift by 50 ppm
/// each.
const DRIFT_DIVISOR: i64 = 10_000;
/// Time in which the fastest message and the fastest round trip are found.
const WINDOW: Duration = Duration::from_secs(10);
/// Evidence expires after this time: it has widened by 12 ms then.
const EVIDENCE_TIMEOUT: Duration = Duration::from_secs(120);
/// Time after which a round trip is no evidence: the network may be another one.
const ROUND_TRIP_TIMEOUT: Duration = Duration::from_secs(600);
/// Nanoseconds for which the fastest message may wait between its stamp and its sending.
const MAX_STAMPING_DELAY: i64 = 500_000;
/// Messages among which one is expected to be as fast as a round trip.
const MIN_MESSAGES: u32 = 20;
/// Several messages of each second, all later than the fastest one by `MIN_STEP` nanoseconds, show
/// a step back of the clock or another path.
const MIN_LATE_MESSAGES: u32 = 5;
const MIN_STEP: i64 = 100_000_000;
/// Number of such seconds. Old messages for a late joiner arrive within one.
const LATE_SECONDS: u32 = 2;

/// Evidence for the upper bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// A reply to a request.
    Reply,
    /// Round trips of acknowledged messages.
    RoundTrip,
}

/// Nanoseconds by which a clock is ahead at least and at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    pub(super) least: i64,
    pub(super) most: i64,
}

/// A bound at the time of its evidence.
#[derive(Clone, Copy, Debug)]
struct Aged {
    value: i64,
    at: ModelTime,
}

/// Evidence of one window.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    least: Option<Aged>,
    /// Messages that were not much later than the fastest one.
    messages: u32,
    round_trip: Option<i64>,
}

/// Evidence of one peer.
#[derive(Debug, Default)]
pub(super) struct Evidence {
    current: Window,
    previous: Window,
    /// Upper bound from a reply.
    reply: Option<Aged>,
    /// Upper bound from round trips of earlier windows.
    trips: Option<Aged>,
    /// The fastest round trip of the last window that had one, and its time. Many writers request
    /// acknowledgements only when a reader appears.
    known_trip: Option<(i64, ModelTime)>,
    began: ModelTime,
    last: ModelTime,
    /// Greatest lower bound of this second, and the number of messages.
    second: Option<(i64, u32)>,
    /// Consecutive seconds with several messages, all of them late.
    late_seconds: u32,
    steps: u64,
}

impl Source {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Reply => "reply",
            Self::RoundTrip => "round_trip",
        }
    }
}

impl Range {
    /// Returns the middle.
    pub(super) const fn middle(self) -> i64 {
        self.least.midpoint(self.most)
    }

    /// Returns the distance from the middle to the bounds.
    pub(super) const fn uncertainty(self) -> i64 {
        self.most.saturating_sub(self.middle())
    }

    /// Returns the smallest absolute value in the range.
    pub(super) const fn least_distance(self) -> i64 {
        if self.least > 0 {
            self.least
        } else if self.most < 0 {
            self.most.saturating_neg()
        } else {
            0
        }
    }

    /// Returns the offset by which latencies are corrected, and the greatest error of that. Clocks
    /// that may agree need no correction: their offset is usually far below the uncertainty.
    pub(super) fn correction(self) -> (i64, i64) {
        if self.least_distance() == 0 {
            (0, self.most.max(self.least.saturating_neg()))
        } else {
            (self.middle(), self.uncertainty())
        }
    }

    /// Returns the range of differences to another range.
    pub(super) const fn since(self, other: Self) -> Self {
        Self {
            least: self.least.saturating_sub(other.most),
            most: self.most.saturating_sub(other.least),
        }
    }
}

impl Aged {
    fn drift(self, now: ModelTime) -> i64 {
        now.nanoseconds_since(self.at).max(0) / DRIFT_DIVISOR
    }

    fn least(self, now: ModelTime) -> i64 {
        self.value.saturating_sub(self.drift(now))
    }

    fn most(self, now: ModelTime) -> i64 {
        self.value.saturating_add(self.drift(now))
    }

    fn is_valid(self, now: ModelTime) -> bool {
        now - self.at < EVIDENCE_TIMEOUT
    }
}

impl Window {
    fn least(&self, now: ModelTime) -> Option<i64> {
        let least = self.least.filter(|least| least.is_valid(now))?;
        Some(least.least(now))
    }

    /// Returns the upper bound from round trips: those of the window, else the known one.
    fn most(&self, now: ModelTime, known_trip: Option<i64>) -> Option<i64> {
        let least = self.least.filter(|least| least.is_valid(now))?;
        let round_trip = self.round_trip.or(known_trip);
        let round_trip = round_trip.filter(|_| self.messages >= MIN_MESSAGES)?;
        let later = round_trip.saturating_add(MAX_STAMPING_DELAY);
        Some(least.most(now).saturating_add(later))
    }
}

impl Evidence {
    /// Records by how much the stamp of an arriving message is ahead of its arrival.
    pub(super) fn arrived(&mut self, ahead: i64, at: ModelTime) {
        self.last = at;
        let (best, messages) = self.second.unwrap_or((ahead, 0));
        self.second = Some((best.max(ahead), messages.saturating_add(1)));
        let window = &mut self.current;
        let known = window.least(at);
        if known.is_none_or(|known| ahead >= known) {
            window.least = Some(Aged { value: ahead, at });
        }
        // Old messages for a late joiner are no evidence of speed.
        let is_late = known.is_some_and(|known| ahead < known.saturating_sub(MIN_STEP));
        window.messages = window.messages.saturating_add(u32::from(!is_late));
    }

    /// Records by how much the stamp of a reply is ahead of its request.
    pub(super) fn replied(&mut self, ahead: i64, at: ModelTime) {
        lower(&mut self.reply, ahead, at);
    }

    /// Records the time from a message to its acknowledgement.
    pub(super) fn round_trip(&mut self, time: Duration, at: ModelTime) {
        self.last = at;
        let time = i64::try_from(nanoseconds(time)).unwrap_or(i64::MAX);
        let known = self.current.round_trip.unwrap_or(i64::MAX);
        let fastest = known.min(time);
        self.current.round_trip = Some(fastest);
        self.known_trip = Some((fastest, at));
    }

    /// Ends a second. Returns false once all evidence has expired.
    pub(super) fn end_second(&mut self, now: ModelTime) -> bool {
        let (least, most, _) = self.relative(now);
        if let Some((best, messages)) = self.second.take() {
            let is_late = least.is_some_and(|least| best < least.saturating_sub(MIN_STEP));
            self.late_seconds = match is_late {
                true => self.late_seconds + u32::from(messages >= MIN_LATE_MESSAGES),
                false => 0,
            };
        }
        if self.late_seconds >= LATE_SECONDS
            || least.zip(most).is_some_and(|(least, most)| least > most)
        {
            self.steps += 1;
            *self = Self {
                began: now,
                last: self.last,
                steps: self.steps,
                known_trip: self.known_trip,
                ..Self::default()
            };
            return true;
        }
        if let Some(most) = self.current.most(now, self.known_trip(now)) {
            lower(&mut self.trips, most, now);
        }
        if self.current.messages >= MIN_MESSAGES && now - self.began >= WINDOW {
            self.previous = std::mem::take(&mut self.current);
            self.began = now;
        }
        now - self.last < EVIDENCE_TIMEOUT
    }

    /// Returns the bounds at `now`, relative to the wall clock.
    pub(super) fn bounds(&self, now: ModelTime, clock: WallClock) -> (Option<i64>, Option<i64>) {
        let (least, most, _) = self.relative(now);
        let wall_time = clock.wall_time(now).0;
        let step = wall_time.wrapping_sub(now.nanoseconds()).cast_signed();
        let absolute = |bound: i64| bound.saturating_sub(step);
        (least.map(absolute), most.map(absolute))
    }

    /// Returns the range at `now`; `None` if a bound is missing, or after a step.
    pub(super) fn range(&self, now: ModelTime, clock: WallClock) -> Option<Range> {
        let (least, most) = self.bounds(now, clock);
        let (least, most) = least.zip(most)?;
        (least <= most).then_some(Range { least, most })
    }

    /// Returns the evidence for the upper bound.
    pub(super) fn source(&self, now: ModelTime) -> Option<Source> {
        self.relative(now).2
    }

    /// Returns the fastest round trip of the last window that had one.
    fn known_trip(&self, now: ModelTime) -> Option<i64> {
        let known = self
            .known_trip
            .filter(|(_, at)| now - *at < ROUND_TRIP_TIMEOUT);
        known.map(|(time, _)| time)
    }

    /// Returns the number of noticed steps.
    pub(super) const fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the bounds relative to model time, and the evidence for the upper one.
    fn relative(&self, now: ModelTime) -> (Option<i64>, Option<i64>, Option<Source>) {
        let windows = [&self.current, &self.previous];
        let least = windows.iter().filter_map(|window| window.least(now)).max();
        let of = |bound: Option<Aged>, source| {
            let bound = bound.filter(|bound| bound.is_valid(now))?;
            Some((bound.most(now), source))
        };
        let current = self.current.most(now, self.known_trip(now));
        let most = [
            of(self.reply, Source::Reply),
            of(self.trips, Source::RoundTrip),
            current.map(|most| (most, Source::RoundTrip)),
        ];
        let most = most.into_iter().flatten();
        let most = most.min_by_key(|(most, _)| *most);
        (least, most.map(|most| most.0), most.map(|most| most.1))
    }
}

/// Replaces an upper bound that is higher by now, or has expired.
fn lower(bound: &mut Option<Aged>, value: i64, at: ModelTime) {
    let known = bound.filter(|bound| bound.is_valid(at));
    if known.is_none_or(|known| value <= known.most(at)) {
        *bound = Some(Aged { value, at });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Passes seconds with some messages each, whose stamps are ahead by this many nanoseconds.
    fn seconds(evidence: &mut Evidence, range: std::ops::Range<u64>, messages: u32, ahead: i64) {
        for second in range {
            let at = ModelTime::from_nanoseconds(second * 1_000_000_000);
            for _ in 0..messages {
                evidence.arrived(ahead, at);
            }
            evidence.end_second(at);
        }
    }

    fn least(evidence: &Evidence, second: u64) -> Option<i64> {
        let now = ModelTime::from_nanoseconds(second * 1_000_000_000);
        evidence.relative(now).0
    }

    #[test]
    fn the_bound_of_a_slow_peer_returns_after_a_step_back_of_its_clock() {
        let mut evidence = Evidence::default();
        seconds(&mut evidence, 1..100, 1, 0);
        assert!(least(&evidence, 100).is_some_and(|bound| bound > -MIN_STEP));
        seconds(&mut evidence, 100..400, 1, -1_000_000_000);
        let bound = least(&evidence, 400).unwrap();
        assert!(
            (-1_100_000_000..=-1_000_000_000).contains(&bound),
            "{bound}"
        );
    }

    #[test]
    fn a_second_with_old_messages_for_a_late_joiner_is_not_a_step() {
        let mut evidence = Evidence::default();
        seconds(&mut evidence, 1..100, 1, 0);
        seconds(
            &mut evidence,
            100..101,
            2 * MIN_LATE_MESSAGES,
            -3_600_000_000_000,
        );
        seconds(&mut evidence, 101..110, 1, 0);
        assert_eq!(evidence.steps(), 0);
        seconds(
            &mut evidence,
            110..110 + u64::from(LATE_SECONDS),
            MIN_LATE_MESSAGES,
            -1_000_000_000,
        );
        assert_eq!(evidence.steps(), 1, "a clock that was set back");
    }
}
