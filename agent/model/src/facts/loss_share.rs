//! The loss of a topic: the share of samples that its worst subscriber lost.
//!
//! [`LossShare::worst`] is the only definition. Expectations, events, history, API and clients use
//! its result. A subscriber's loss includes every cause: before this host, in reassembly, and in
//! the buffer of its socket. Where no delivery is observed, as for shared memory, the loss is the
//! sent samples that did not reach this host.

/// Number of seconds over which the worst subscriber is chosen and expectations about loss are
/// evaluated.
pub const SECONDS: usize = crate::facts::rate::SECONDS as usize;

/// Numbers of samples that a subscriber expected and lost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LossShare {
    /// Lost samples.
    pub lost: u64,
    /// Samples that arrived or were lost.
    pub expected: u64,
}

/// The loss share of each of the last seconds, from counters that are read once a second.
#[derive(Clone, Copy, Debug, Default)]
pub struct RecentLoss {
    /// The counters at the end of the last second.
    before: LossShare,
    /// Lost and expected samples of each second.
    seconds: [(u32, u32); SECONDS],
    /// Index of the last second.
    last: usize,
}

/// The loss of a topic.
#[derive(Clone, Copy, Debug, Default)]
pub struct TopicLoss {
    /// The worst subscriber's share of each second, summed since the start.
    pub total: LossShare,
    /// The worst subscriber's share of the last [`SECONDS`] seconds.
    pub window: LossShare,
    /// Samples that did not reach this host.
    pub(crate) unreached: RecentLoss,
    /// Largest loss of a writer that left in this second.
    pub(crate) departed: LossShare,
}

impl LossShare {
    /// Returns lost divided by expected samples, or `None` if none was expected.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "a ratio of counts far below 2^52"
    )]
    pub fn ratio(self) -> Option<f64> {
        (self.expected > 0).then(|| self.lost as f64 / self.expected as f64)
    }

    /// Returns whether more than this share was lost.
    #[must_use]
    pub fn exceeds(self, maximum: f64) -> bool {
        self.ratio().is_some_and(|ratio| ratio > maximum)
    }

    /// Adds other counts of the same subscriber.
    pub const fn add(&mut self, other: Self) {
        self.lost += other.lost;
        self.expected += other.expected;
    }

    /// Returns the subscriber with the highest ratio, and the first of several equal ones.
    /// Subscribers that expected nothing are ignored.
    pub fn worst<T>(subscribers: impl Iterator<Item = (Self, T)>) -> Option<(Self, T)> {
        let losers = subscribers.filter(|(share, _)| share.expected > 0);
        losers.reduce(|worst, each| {
            if each.0.is_worse(worst.0) {
                each
            } else {
                worst
            }
        })
    }

    /// Returns whether the ratio is higher than that of `than`. Both shares must expect samples.
    fn is_worse(self, than: Self) -> bool {
        let product = |lost: u64, expected: u64| u128::from(lost) * u128::from(expected);
        product(self.lost, than.expected) > product(than.lost, self.expected)
    }
}

impl RecentLoss {
    /// Ends a second with the counters at `now`. A sample that arrives after it was counted as lost
    /// is subtracted from earlier seconds.
    pub fn end_second(&mut self, now: LossShare) {
        self.last = (self.last + 1) % SECONDS;
        let lost = now.lost.saturating_sub(self.before.lost);
        let expected = now.expected.saturating_sub(self.before.expected);
        let mut repaired = narrow(self.before.lost.saturating_sub(now.lost));
        if let Some(second) = self.seconds.get_mut(self.last) {
            *second = (narrow(lost), narrow(expected));
        }
        self.before = now;
        for back in 1..SECONDS {
            let place = (self.last + SECONDS - back) % SECONDS;
            if let Some((lost, _)) = self.seconds.get_mut(place).filter(|_| repaired > 0) {
                let taken = repaired.min(*lost);
                (*lost, repaired) = (*lost - taken, repaired - taken);
            }
        }
    }

    /// Starts counting at `now`.
    pub const fn begin(&mut self, now: LossShare) {
        self.before = now;
    }

    /// Returns the share between the end of the last second and `now`.
    #[must_use]
    pub const fn since(&self, now: LossShare) -> LossShare {
        LossShare {
            lost: now.lost.saturating_sub(self.before.lost),
            expected: now.expected.saturating_sub(self.before.expected),
        }
    }

    /// Returns whether all seconds are empty and stay so while the counters are as `now`.
    #[must_use]
    pub fn is_quiet(&self, now: LossShare) -> bool {
        self.before == now && self.seconds.iter().all(|second| *second == (0, 0))
    }

    /// Adds the seconds and counters of `other`.
    pub fn absorb(&mut self, other: &Self) {
        self.before.add(other.before);
        for back in 0..SECONDS {
            let of = |last: usize| (last + SECONDS - back) % SECONDS;
            let (lost, expected) = other
                .seconds
                .get(of(other.last))
                .copied()
                .unwrap_or_default();
            if let Some(second) = self.seconds.get_mut(of(self.last)) {
                second.0 = second.0.saturating_add(lost);
                second.1 = second.1.saturating_add(expected);
            }
        }
    }

    /// Returns the share of the last second.
    #[must_use]
    pub fn last(&self) -> LossShare {
        self.seconds
            .get(self.last)
            .map_or_else(Default::default, share)
    }

    /// Returns the share of all seconds.
    #[must_use]
    pub fn window(&self) -> LossShare {
        let mut sum = LossShare::default();
        self.seconds
            .iter()
            .for_each(|second| sum.add(share(second)));
        sum
    }
}

impl TopicLoss {
    /// Ends a second. `subscribers` has the window and the last second of each subscriber.
    /// `unreached` counts samples that did not reach this host.
    pub fn end_second(
        &mut self,
        subscribers: impl Iterator<Item = (LossShare, LossShare)>,
        unreached: LossShare,
    ) {
        self.unreached.end_second(unreached);
        let worst = LossShare::worst(subscribers);
        let (window, last) = worst.unwrap_or((self.unreached.window(), self.unreached.last()));
        let departed = std::mem::take(&mut self.departed);
        if departed.lost > last.lost {
            self.total.add(departed);
            let both = [(window, ()), (departed, ())].into_iter();
            self.window = LossShare::worst(both).map_or(window, |(worst, ())| worst);
        } else {
            self.total.add(last);
            self.window = window;
        }
    }

    /// Records the last share of a writer that left, if it lost more than the others that left in
    /// this second.
    pub(crate) const fn note_departed(&mut self, share: LossShare) {
        if share.lost > self.departed.lost {
            self.departed = share;
        }
    }
}

fn share((lost, expected): &(u32, u32)) -> LossShare {
    LossShare {
        lost: (*lost).into(),
        expected: (*expected).into(),
    }
}

fn narrow(count: u64) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share_of(lost: u64, expected: u64) -> LossShare {
        LossShare { lost, expected }
    }

    #[test]
    fn the_worst_subscriber_has_the_highest_ratio_not_the_most_losses() {
        let shares = [
            share_of(5, 1000),
            share_of(2, 10),
            share_of(0, 0),
            share_of(20, 100),
        ];
        let worst = LossShare::worst((0..).zip(shares).map(|(place, share)| (share, place)));
        assert_eq!(worst, Some((share_of(2, 10), 1)));
        assert_eq!(LossShare::worst([(share_of(0, 0), ())].into_iter()), None);
        assert!(share_of(2, 10).exceeds(0.19) && !share_of(2, 10).exceeds(0.2));
        assert!(!share_of(0, 0).exceeds(0.0));
    }

    #[test]
    fn a_late_sample_is_subtracted_from_the_second_that_counted_its_loss() {
        let mut recent = RecentLoss::default();
        recent.end_second(share_of(3, 10));
        recent.end_second(share_of(3, 20));
        recent.end_second(share_of(1, 30));
        assert_eq!(
            (recent.last(), recent.window()),
            (share_of(0, 10), share_of(1, 30))
        );
        (0..SECONDS).for_each(|_| recent.end_second(share_of(1, 30)));
        assert_eq!(recent.window(), share_of(0, 0));
    }

    #[test]
    fn merged_counters_are_added_second_by_second() {
        let (mut one, mut other) = (RecentLoss::default(), RecentLoss::default());
        one.end_second(share_of(1, 10));
        other.end_second(share_of(2, 20));
        other.end_second(share_of(3, 30));
        one.absorb(&other);
        assert_eq!(
            (one.last(), one.window()),
            (share_of(2, 20), share_of(4, 40))
        );
        one.end_second(share_of(5, 50));
        assert_eq!(one.last(), share_of(1, 10));
    }

    #[test]
    fn the_losses_of_a_writer_that_left_count_in_its_last_second() {
        let mut loss = TopicLoss::default();
        loss.note_departed(share_of(4, 8));
        loss.note_departed(share_of(1, 2));
        loss.end_second(std::iter::empty(), share_of(0, 10));
        assert_eq!((loss.total, loss.window), (share_of(4, 8), share_of(4, 8)));
        loss.end_second(std::iter::empty(), share_of(0, 20));
        assert_eq!(loss.total, share_of(4, 18));
    }
}
