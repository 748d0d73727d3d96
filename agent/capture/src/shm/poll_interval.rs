//! How long the tap sleeps between two polls.
//!
//! Waking up dominates the cost of a poll. Therefore the tap polls again soon after finding many
//! messages, and ever more slowly after finding none. Every sleep is extended until the tap stays
//! within its share of a CPU. This module reads no clock.

use std::time::Duration;

/// Sleep during bursts of messages, and maximum sleep while a topic is measured, in seconds.
const BURST_SLEEP: f64 = 100e-6;
const WATCHING_SLEEP: f64 = 1e-3;
/// Maximum sleep if only discovery is needed, and after a quiet period.
const DISCOVERY_SLEEP: f64 = 5e-3;
const QUIET_SLEEP: f64 = 10e-3;
/// Sleep if nothing is needed: an occasional poll, since the latest messages stay readable.
const UNNEEDED_SLEEP: f64 = 100e-3;
/// Length of a quiet period.
const QUIET_AFTER: f64 = 3.0;
/// Factor by which the sleep grows after an empty poll.
const SLEEP_GROWTH: f64 = 1.5;
/// Interval at which the CPU share is computed.
const ACCOUNT_INTERVAL: f64 = 0.1;
/// Sleep during discovery while the credit is full: each participant announces its names once, and
/// reuses the buffer some 50 us later. Short sleeps see more than busy polling: the scheduler
/// prefers threads that wake up.
const CLOSE_POLL_SLEEP: f64 = 10e-6;
/// Maximum sleep during discovery, at the end of the credit.
const DISCOVERY_LIMIT_SLEEP: f64 = 500e-6;
/// Time of busy polling after each announcement, and of the shortest sleeps after each message that
/// is needed: messages arrive in bursts.
const BUSY_POLL_TIME: f64 = 200e-6;
/// Duration of close polling after a participant creates its files, and after each announcement.
const PARTICIPANT_WATCH: f64 = 0.3;
const ANNOUNCEMENT_WATCH: f64 = 0.1;
/// CPU credit for close polling: its maximum, and its growth per second. With the share of a CPU
/// while topics are measured, a minute in which a robot starts costs less than 2.5 % of a CPU.
const MAX_CREDIT: f64 = 0.4;
const CREDIT_PER_SECOND: f64 = 0.002;
/// Maximum sleep while every message is needed and CPU time is saved for it. In a burst, a sender
/// reuses its buffers after some 100 us, and its readers are faster than that.
const EVERY_MESSAGE_SLEEP: f64 = 50e-6;
const EARLY_WAKE: f64 = 20e-6;
/// Maximum CPU time that is saved for polls while every message is needed, so that a short
/// recording is complete, and maximum overdraft.
const MAX_SAVINGS: f64 = 5.0;
const MAX_OVERDRAFT: f64 = 0.25;
/// Maximum sleep while anything is needed, whatever a poll costs.
const MAX_SLEEP: f64 = 50e-3;

/// Purpose of the tap at a given time.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Need {
    /// No topic that may use shared memory is measured, and no name is missing. New participants
    /// are noticed.
    Unneeded,
    /// No topic is measured; node names and endpoints may be announced.
    Names,
    /// A topic is measured.
    Watching,
    /// Every message is needed, not only their number.
    Every,
}

impl Need {
    /// Every need, in ascending order.
    pub const ALL: [Self; 4] = [Self::Unneeded, Self::Names, Self::Watching, Self::Every];
}

/// Shares of a CPU, 0.015 for 1.5 %.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Budget {
    /// Share while messages are counted and names are read.
    pub watching: f64,
    /// Share while every message is needed.
    pub every: f64,
}

/// Computes the sleeps.
#[derive(Debug)]
pub struct PollInterval {
    budget: Budget,
    need: Need,
    sleep: f64,
    stretch: f64,
    quiet_since: f64,
    accounted: (f64, f64),
    close_until: f64,
    busy_until: f64,
    /// Whether the machine has another CPU for other processes during busy polling.
    has_spare_cpu: bool,
    was_polling_closely: bool,
    /// CPU time left for close polling.
    credit: f64,
    /// Remaining budget while every message is needed, with the time and the CPU time at which it
    /// was computed.
    savings: f64,
    spent: (f64, f64),
}

impl PollInterval {
    /// Creates the schedule within these shares of a CPU.
    #[must_use]
    pub const fn new(budget: Budget) -> Self {
        Self {
            budget,
            need: Need::Unneeded,
            sleep: WATCHING_SLEEP,
            stretch: 1.0,
            quiet_since: 0.0,
            accounted: (0.0, 0.0),
            close_until: 0.0,
            busy_until: 0.0,
            has_spare_cpu: false,
            was_polling_closely: false,
            credit: MAX_CREDIT,
            savings: MAX_SAVINGS,
            spent: (0.0, 0.0),
        }
    }

    /// Sets whether busy polling is allowed, which needs more than one CPU.
    #[must_use]
    pub const fn with_cpus(self, cpus: usize) -> Self {
        Self {
            has_spare_cpu: cpus > 1,
            ..self
        }
    }

    /// Starts close polling for a moment, within the credit, because a participant is starting.
    pub fn participant_starting(&mut self, now: f64) {
        self.poll_closely_until(now + PARTICIPANT_WATCH);
    }

    /// Extends close polling, because an announcement was read and more may follow.
    pub fn announcement_read(&mut self, now: f64) {
        self.poll_closely_until(now + ANNOUNCEMENT_WATCH);
        if self.has_spare_cpu && self.credit > MAX_CREDIT / 2.0 {
            self.busy_until = now + BUSY_POLL_TIME;
        }
    }

    /// Returns whether the tap polls closely because a participant is starting.
    #[must_use]
    pub fn is_polling_closely(&self, now: f64) -> bool {
        now < self.close_until
    }

    /// Returns how long to sleep after a poll at `now` that found this many messages; `cpu` is the
    /// thread's CPU time so far. Both are in seconds.
    pub fn sleep(&mut self, now: f64, cpu: f64, found: usize, need: Need) -> Duration {
        if found > 0 {
            self.quiet_since = now;
        }
        if self.was_polling_closely {
            let (_, used) = std::mem::replace(&mut self.accounted, (now, cpu));
            self.credit -= cpu - used;
        }
        self.was_polling_closely = self.is_polling_closely(now) && self.credit > 0.0;
        if self.was_polling_closely {
            if now < self.busy_until {
                return Duration::ZERO;
            }
            // The start of a whole robot uses up the credit slowly. A robot repeats its names: each
            // participant sends them to every later one.
            let rest = self.credit / MAX_CREDIT;
            self.sleep = (CLOSE_POLL_SLEEP / rest.powi(4)).min(DISCOVERY_LIMIT_SLEEP);
            return Duration::from_secs_f64(self.sleep);
        }
        self.close_until = now;
        if (need == Need::Every) != (self.need == Need::Every) {
            // The budget changes, so the measured cost is forgotten.
            (self.stretch, self.accounted) = (1.0, (now, cpu));
            let saved = (now - self.spent.0) * self.budget.every;
            self.savings = (self.savings + saved).min(MAX_SAVINGS);
            self.spent = (now, cpu);
        }
        self.need = need;
        self.account_cpu(now, cpu);
        if need == Need::Every {
            return self.short_sleep(now, cpu, found);
        }
        let longest = match need {
            Need::Unneeded => UNNEEDED_SLEEP,
            _ if now - self.quiet_since > QUIET_AFTER => QUIET_SLEEP,
            Need::Names => DISCOVERY_SLEEP,
            Need::Watching | Need::Every => WATCHING_SLEEP,
        };
        self.sleep = match found {
            0 => (self.sleep * SLEEP_GROWTH).min(longest),
            1 => (longest / 2.0).max(BURST_SLEEP),
            _ => BURST_SLEEP,
        };
        let stretched = (self.sleep * self.stretch).min(MAX_SLEEP.max(longest));
        Duration::from_secs_f64(stretched)
    }

    /// Returns the factor by which the budget extends sleeps.
    #[must_use]
    pub const fn stretch(&self) -> f64 {
        self.stretch
    }

    /// Returns the sleep while every message is needed: shorter for a moment after each message,
    /// which may start a burst. The sleep is never 0, because the thread preempts the processes
    /// whose messages it reads.
    fn short_sleep(&mut self, now: f64, cpu: f64, found: usize) -> Duration {
        let (then, used) = std::mem::replace(&mut self.spent, (now, cpu));
        let saved = (now - then) * self.budget.every - (cpu - used);
        self.savings = (self.savings + saved).clamp(-MAX_OVERDRAFT, MAX_SAVINGS);
        self.sleep = EVERY_MESSAGE_SLEEP;
        if found > 0 {
            self.busy_until = now + BUSY_POLL_TIME;
        }
        if self.savings <= 0.0 {
            let slower = EVERY_MESSAGE_SLEEP * self.stretch.max(SLEEP_GROWTH);
            return Duration::from_secs_f64(slower.min(MAX_SLEEP));
        }
        Duration::from_secs_f64(if now < self.busy_until {
            EARLY_WAKE
        } else {
            EVERY_MESSAGE_SLEEP
        })
    }

    fn poll_closely_until(&mut self, until: f64) {
        if self.credit > 0.0 {
            self.close_until = self.close_until.max(until);
        }
    }

    fn account_cpu(&mut self, now: f64, cpu: f64) {
        let (then, used) = self.accounted;
        let elapsed = now - then;
        if elapsed < ACCOUNT_INTERVAL {
            return;
        }
        self.accounted = (now, cpu);
        self.credit = (self.credit + elapsed * CREDIT_PER_SECOND).min(MAX_CREDIT);
        let share = (cpu - used) / elapsed;
        let budget = match self.need {
            Need::Every => self.budget.every,
            Need::Unneeded | Need::Names | Need::Watching => self.budget.watching,
        };
        // The tap wakes up less often by the factor of the excess, but gradually.
        let wanted = share / budget;
        let correction = wanted.clamp(0.8, 1.5);
        self.stretch = (self.stretch * correction).clamp(1.0, MAX_SLEEP / BURST_SLEEP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUDGET: Budget = Budget {
        watching: 0.015,
        every: 0.25,
    };

    /// Simulates `seconds` with polls that take `cost`; returns the CPU share and the number of
    /// polls in the second half.
    fn run(
        interval: &mut PollInterval,
        seconds: f64,
        cost: f64,
        need: Need,
        mut found: impl FnMut(f64) -> usize,
    ) -> (f64, f64) {
        let (mut now, mut cpu, mut looks, mut half) = (0.0, 0.0, 0_u32, (0.0, 0.0));
        while now < seconds {
            let slept = interval.sleep(now, cpu, found(now), need);
            now += slept.as_secs_f64() + cost;
            cpu += cost;
            if now >= seconds / 2.0 {
                if half.0 == 0.0 {
                    half = (now, cpu);
                }
                looks += 1;
            }
        }
        let elapsed = now - half.0;
        ((cpu - half.1) / elapsed, f64::from(looks) / elapsed)
    }

    #[test]
    fn polling_stays_within_the_budget_at_any_cost_of_a_poll() {
        for budget in [0.005, 0.015, 0.1] {
            for cost in [5e-6, 25e-6, 200e-6] {
                for burst in [0, 1, 40] {
                    let mut interval = PollInterval::new(Budget {
                        watching: budget,
                        every: 1.0,
                    });
                    let (share, _) = run(&mut interval, 20.0, cost, Need::Watching, |_| burst);
                    // A poll of 200 us every 50 ms takes 0.4 %, the minimum share.
                    assert!(share <= budget * 1.1, "{budget} {cost} {burst}: {share}");
                }
            }
        }
    }

    #[test]
    fn polling_exceeds_900_hz_within_the_budget() {
        let mut interval = PollInterval::new(BUDGET);
        let busy = |now: f64| usize::from(now % 1.0 < 0.01);
        let (_, looks) = run(&mut interval, 10.0, 5e-6, Need::Watching, busy);
        assert!(looks > 900.0, "{looks}");
    }

    #[test]
    fn the_tap_polls_rarely_while_it_finds_no_message() {
        let polls = |need| {
            let mut interval = PollInterval::new(BUDGET);
            run(&mut interval, 20.0, 5e-6, need, |_| 0).1
        };
        assert!((9.0..11.0).contains(&polls(Need::Unneeded)));
        assert!((90.0..110.0).contains(&polls(Need::Watching)));
        assert!((90.0..110.0).contains(&polls(Need::Names)));
    }

    #[test]
    fn a_new_participant_causes_close_polling_for_a_limited_time() {
        let mut interval = PollInterval::new(BUDGET);
        interval.participant_starting(100.0);
        let microseconds = |interval: &mut PollInterval, now, cpu| {
            interval.sleep(now, cpu, 0, Need::Unneeded).as_micros()
        };
        assert_eq!(microseconds(&mut interval, 100.01, 0.0), 10);
        assert_eq!(microseconds(&mut interval, 100.2, 0.0), 10);
        assert!(microseconds(&mut interval, 100.6, 0.0) > 10);
        // Participants start constantly, and close polls take a third of a CPU.
        let (mut now, mut cpu) = (101.0, 0.0);
        while now < 201.0 {
            interval.participant_starting(now);
            microseconds(&mut interval, now, cpu);
            let close = interval.was_polling_closely;
            now += 0.01;
            cpu += if close { 0.003 } else { 0.0 };
        }
        // The bound is the credit plus its growth in a hundred seconds.
        assert!(cpu <= 0.61, "{cpu}");
    }

    #[test]
    fn the_start_of_a_robot_is_polled_closely_within_the_credit() {
        for cost in [8e-6, 25e-6] {
            let mut interval = PollInterval::new(BUDGET).with_cpus(2);
            let (mut now, mut cpu, mut polls, mut longest) = (100.0, 0.0, 0_u32, Duration::ZERO);
            // The nodes of the robot start within 6 s, and user data flows.
            while now < 160.0 {
                if now < 106.0 {
                    interval.participant_starting(now);
                }
                let is_starting = now < 106.0;
                let slept = interval.sleep(now, cpu, usize::from(polls % 4 == 0), Need::Watching);
                if is_starting {
                    polls += 1;
                    longest = longest.max(slept);
                }
                now += slept.as_secs_f64() + cost;
                cpu += cost;
            }
            // Without credit, the tap polls as while a topic is measured, within the same share.
            assert!(longest.as_micros() <= 5000, "{cost} {longest:?}");
            assert!(polls > 10_000, "{cost} {polls}");
            // The whole agent may take 3 % of a CPU, of which other threads need a part.
            assert!(cpu <= 0.025 * 60.0, "{cost} {cpu}");
        }
    }

    #[test]
    fn an_announcement_causes_busy_polling_if_other_processes_have_a_cpu() {
        for cpus in [1, 2] {
            let mut interval = PollInterval::new(BUDGET).with_cpus(cpus);
            interval.participant_starting(100.0);
            let mut microseconds = |now, is_announced, cpu| {
                if is_announced {
                    interval.announcement_read(now);
                }
                interval.sleep(now, cpu, 1, Need::Names).as_micros()
            };
            let awake = if cpus > 1 { 0 } else { 10 };
            // Other messages cause no busy polling.
            assert_eq!(microseconds(100.0, false, 0.0), 10);
            assert_eq!(microseconds(100.001, true, 0.0), awake);
            assert_eq!(microseconds(100.001_1, false, 0.0), awake);
            assert_eq!(microseconds(100.001_3, false, 0.0), 10);
            // Announcements cause none once half of the credit is spent.
            assert_eq!(microseconds(100.002, false, 0.2), 160);
            assert_eq!(microseconds(100.003, true, 0.2), 160);
        }
    }

    #[test]
    fn polling_for_every_message_runs_every_50_us_within_its_own_budget() {
        let idle = |_: f64| 0;
        let mut interval = PollInterval::new(BUDGET).with_cpus(2);
        let (share, looks) = run(&mut interval, 10.0, 8e-6, Need::Every, idle);
        assert!(looks > 15_000.0 && share < 0.16, "{looks} {share}");
        // The load is a hundred thousand messages per second, with cheap and with expensive polls.
        for cost in [8e-6, 60e-6] {
            let mut interval = PollInterval::new(BUDGET).with_cpus(2);
            (interval.need, interval.savings) = (Need::Every, 0.0);
            let (share, looks) = run(&mut interval, 20.0, cost, Need::Every, |_| 10);
            assert!(share <= 0.27 && looks > 2000.0, "{cost} {share} {looks}");
            // Every message is no longer needed: the measured cost is forgotten.
            let first = interval.sleep(30.0, 9.0, 1, Need::Watching);
            assert!(first <= Duration::from_micros(500), "{first:?}");
        }
    }

    #[test]
    fn a_needed_message_causes_an_early_poll_within_the_budget() {
        let mut interval = PollInterval::new(BUDGET).with_cpus(2);
        let mut microseconds =
            |now, cpu, found| interval.sleep(now, cpu, found, Need::Every).as_micros();
        assert_eq!(microseconds(1.0, 0.0, 0), 50);
        assert_eq!(microseconds(1.001, 0.0, 1), 20);
        assert_eq!(microseconds(1.001_1, 0.0, 0), 20);
        assert_eq!(microseconds(1.001_3, 0.0, 0), 50);
        // The savings are spent, then saved again.
        assert_eq!(microseconds(1.5, 7.0, 1), 75);
        assert_eq!(microseconds(4.5, 7.0, 1), 20);
    }

    #[test]
    fn sleeps_are_short_after_a_burst_and_then_grow() {
        let mut interval = PollInterval::new(BUDGET);
        assert_eq!(
            interval.sleep(0.01, 0.0, 5, Need::Watching).as_micros(),
            100
        );
        let mut last = Duration::ZERO;
        for step in 0..10 {
            let now = 0.01 + f64::from(step) * 1e-3;
            let slept = interval.sleep(now, 0.0, 0, Need::Watching);
            assert!(slept >= last);
            last = slept;
        }
        assert_eq!(last.as_micros(), 1000);
    }
}
