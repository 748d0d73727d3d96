//! Chooses the expectations of a topic from its measured seconds.
//!
//! Each threshold begins at a robust statistic (median, 95th percentile, MAD) with a margin. If the
//! topic's own seconds violate it, by the agent's evaluation, the threshold widens to the observed
//! extreme. If it is then too wide to find a fault, the expectation is left out, with the reason.

use std::ops::RangeInclusive;

use ros2probe_daemon::config::rehearsal::{self, STARTUP_GRACE_SECONDS, Second};
use ros2probe_daemon::config::watch::ExpectationValues;
use ros2probe_daemon::config::{Expectations, LossShare};

use super::observation::Observation;
use super::statistics::{Summary, rounded_down, rounded_up};

/// Margin of a rate around its median.
pub const RATE_MARGIN: f64 = 0.2;
/// Margin of a rate, in deviations.
pub const RATE_DEVIATIONS: f64 = 4.0;
/// Limits of the band of a rate, as parts of its median. A topic at half its rate stays outside.
const RATE_LIMITS: (f64, f64) = (0.6, 1.6);
/// Minimum distance of the minimum rate from half the median, in messages of a window. Half the
/// rate then violates the minimum, in spite of the agent's tolerance of one message.
const MESSAGE_TOLERANCE: f64 = 1.0;
/// Windows in seconds for rates that vary too much in the agent's default window.
const WINDOW_SECONDS: [u64; 4] = [2, 3, 5, rehearsal::SECONDS];
/// Minimum rate with a band: three messages are due in the agent's longest window of 10 s.
const MIN_RATE_HZ: f64 = 0.3;
/// Minimum number of seconds and of messages to learn from.
const MIN_OBSERVATIONS: usize = 10;
/// Margin of a silence, as a factor of the longest observed one.
pub const SILENCE_MARGIN: f64 = 3.0;
/// Minimum learnt silence in seconds, since the agent evaluates once a second.
const SHORTEST_SILENCE: f64 = 2.0;
/// Maximum share of the time that the longest silence may take, for topics without a rate.
const SILENCE_PART: f64 = 0.2;
/// Minimum learnt loss ratio.
pub const LEAST_LOSS: f64 = 0.01;
/// Maximum learnt loss ratio.
const MOST_LOSS: f64 = 0.5;
/// Seconds over which the agent evaluates a loss.
const LOSS_WINDOW: usize = 10;
/// Margin of a latency in deviations, and its minimum in seconds.
pub const LATENCY_DEVIATIONS: f64 = 6.0;
const LATENCY_MARGIN: f64 = 0.005;

/// Expectations of one topic.
#[derive(Clone, Debug, PartialEq)]
pub struct TopicThresholds {
    /// ROS name.
    pub topic: String,
    /// Values of the expectations.
    pub values: ExpectationValues,
    /// Explanations of the values, in the order of the configuration's keys.
    pub remarks: Vec<Remark>,
}

/// Explanation of one or two keys.
#[derive(Clone, Debug, PartialEq)]
pub enum Remark {
    /// The key has this value, for this reason.
    Set(&'static str, f64, String),
    /// The keys are left out, for this reason.
    LeftOut(&'static str, String),
}

/// Chooses the expectations of a topic.
#[must_use]
pub fn choose_thresholds(topic: &str, observation: &Observation) -> TopicThresholds {
    let mut draft = Draft::new(observation);
    if draft.messages < MIN_OBSERVATIONS as u64 {
        draft.too_few();
    } else {
        draft.rate();
        draft.loss();
        draft.latency();
        draft.silence();
    }
    draft.endpoints();
    draft.drop_conflicting();
    TopicThresholds {
        topic: topic.to_owned(),
        values: draft.values,
        remarks: draft.remarks,
    }
}

/// Rates of all windows of one length.
struct Windows {
    /// Length in seconds.
    seconds: u64,
    /// Whether the agent uses this length by default.
    is_default: bool,
    rates: Summary,
}

/// Expectations under construction.
struct Draft<'a> {
    observation: &'a Observation,
    seconds: &'a [Second],
    /// Seconds after the second of the first message, which is incomplete.
    complete: &'a [Second],
    messages: u64,
    values: ExpectationValues,
    remarks: Vec<Remark>,
}

impl<'a> Draft<'a> {
    fn new(observation: &'a Observation) -> Self {
        let seconds = observation.seconds();
        let first = seconds.iter().position(|second| second.messages > 0);
        let complete = first.and_then(|first| seconds.get(first + 1..));
        Self {
            observation,
            seconds,
            complete: complete.unwrap_or_default(),
            messages: seconds.iter().map(|it| u64::from(it.messages)).sum(),
            values: ExpectationValues::default(),
            remarks: Vec::new(),
        }
    }

    /// Returns whether the topic's own seconds violate these values, or the values are invalid.
    fn violates(&self, values: ExpectationValues) -> bool {
        match Expectations::try_from(values) {
            Ok(expectations) => !rehearsal::violations(&expectations, self.seconds).is_empty(),
            Err(_) => true,
        }
    }

    /// Returns the first candidate within its limits that the topic's own seconds do not violate.
    fn first(
        &self,
        candidates: [f64; 2],
        limits: RangeInclusive<f64>,
        expecting: impl Fn(f64) -> ExpectationValues,
    ) -> Option<f64> {
        let mut candidates = candidates.into_iter();
        candidates.find(|it| limits.contains(it) && !self.violates(expecting(*it)))
    }

    fn omit(&mut self, keys: &'static str, why: impl Into<String>) {
        self.remarks.push(Remark::LeftOut(keys, why.into()));
    }

    fn too_few(&mut self) {
        let why = match (&self.observation.reason, self.messages) {
            (Some(reason), 0) => format!("no message was seen: {reason}"),
            (None, 0) => "no message was seen".to_owned(),
            (_, messages) => format!("{messages} messages are too few"),
        };
        self.omit("rate, loss, latency and silence", why);
    }

    fn rate(&mut self) {
        const KEYS: &str = "min_rate_hz and max_rate_hz";
        let seconds = self.complete.len();
        if seconds < MIN_OBSERVATIONS {
            return self.omit(KEYS, format!("{seconds} s are too short"));
        }
        let messages: u64 = self.complete.iter().map(|it| u64::from(it.messages)).sum();
        let mean = number(messages) / number(seconds as u64);
        let lowest = mean * (1.0 - RATE_MARGIN);
        if lowest < MIN_RATE_HZ {
            let why = format!("{messages} messages in {seconds} s are too seldom for a rate");
            return self.omit(KEYS, why);
        }
        let default = rehearsal::window(lowest);
        let wider = WINDOW_SECONDS
            .into_iter()
            .filter(|seconds| *seconds > default);
        let lengths = std::iter::once(default).chain(wider);
        let windows: Vec<Windows> = lengths
            .filter_map(|seconds| self.windows(seconds, default))
            .collect();
        let Some(shortest) = windows.first() else {
            return self.omit(KEYS, "no message arrived for most of the time");
        };
        // The shortest window is best that detects half the rate and that the topic never violates.
        let usual = |it: &&Windows| {
            it.is_above(it.min_rates()[0]) && self.accepts_low(it, it.min_rates()[0])
        };
        let widest = |it: &&Windows| self.accepts_low(it, it.min_rates()[1]);
        let chosen = windows.iter().find(usual);
        let chosen = chosen.or_else(|| windows.iter().find(widest));
        self.choose_rate_band(chosen.unwrap_or(shortest));
    }

    /// Chooses the minimum and the maximum rate.
    fn choose_rate_band(&mut self, windows: &Windows) {
        let Windows { seconds, rates, .. } = windows;
        let [usual, widest] = windows.min_rates();
        let lows = match windows.is_above(usual) {
            true => [usual, widest],
            false => [widest, usual],
        };
        let low = lows.into_iter().find(|low| self.accepts_low(windows, *low));
        let [usual, widest] = windows.max_rates();
        let highs = match windows.is_below(usual) {
            true => [usual, widest],
            false => [widest, usual],
        };
        let high = self.first(highs, 0.0..=RATE_LIMITS.1 * rates.median, |rate| {
            windows.expecting(None, Some(rate))
        });
        let seen = format!(
            "{} to {} Hz in windows of {seconds} s",
            three_digits(rates.minimum),
            three_digits(rates.maximum)
        );
        let varies = format!("the rate varies: {seen}");
        let seen = format!("median {} Hz, {seen}", three_digits(rates.median));
        self.set("min_rate_hz", low, seen, &varies);
        self.set("max_rate_hz", high, String::new(), &varies);
        self.values = windows.expecting(low, high);
        if let Some(window) = self.values.window_s {
            let why = "the rate varies in shorter windows".to_owned();
            self.set("window_s", Some(f64::from(window)), why, "");
        }
    }

    /// Returns whether this minimum rate detects half the rate, and the topic does not violate it.
    fn accepts_low(&self, windows: &Windows, rate: f64) -> bool {
        let limits = windows.least()..=f64::INFINITY;
        limits.contains(&rate) && !self.violates(windows.expecting(Some(rate), None))
    }

    /// Returns the rates in windows of this many seconds; `None` if most windows have no message.
    fn windows(&self, seconds: u64, default: u64) -> Option<Windows> {
        let rates = Summary::of(self.rates(seconds)).filter(|rates| rates.median > 0.0)?;
        Some(Windows {
            seconds,
            is_default: seconds == default,
            rates,
        })
    }

    /// Returns the rates of all windows of this many seconds with a publisher.
    fn rates(&self, window: u64) -> Vec<f64> {
        let length = usize::try_from(window).unwrap_or(1).max(1);
        let windows = self.complete.windows(length);
        let published = windows.filter(|it| it.iter().all(|second| second.publishers > 0));
        published
            .map(|it| {
                let messages: u64 = it.iter().map(|second| u64::from(second.messages)).sum();
                number(messages) / number(window)
            })
            .collect()
    }

    fn loss(&mut self) {
        const KEY: &str = "max_loss_ratio";
        let lost: u64 = self.seconds.iter().map(|it| u64::from(it.lost)).sum();
        let expected: u64 = self.seconds.iter().map(|it| u64::from(it.expected)).sum();
        let windows = self.seconds.windows(LOSS_WINDOW);
        let windows = windows.map(|it| {
            let sum = |count: fn(&Second) -> u32| it.iter().map(|s| u64::from(count(s))).sum();
            LossShare {
                lost: sum(|second| second.lost),
                expected: sum(|second| second.expected),
            }
        });
        let windows: Vec<LossShare> = windows.filter(|share| share.expected > 0).collect();
        let ratios = windows.iter().filter_map(|share| share.ratio());
        let sent = windows.iter().map(|share| number(share.expected));
        let (Some(ratios), Some(sent)) = (Summary::of(ratios), Summary::of(sent)) else {
            return self.omit(KEY, "the topic was seen for less than 10 s");
        };
        // One lost message in a window is not a fault.
        let base = LEAST_LOSS.max(1.5 / sent.median);
        let candidates = [3.0 * ratios.p95, 1.5 * ratios.maximum];
        let candidates = candidates.map(|ratio| rounded_up(ratio.max(base)));
        let ratio = self.first(candidates, 0.0..=MOST_LOSS, |ratio| ExpectationValues {
            max_loss_ratio: Some(ratio),
            ..ExpectationValues::default()
        });
        let seen = format!(
            "{lost} of {} messages lost, at most {} % in 10 s",
            expected,
            three_digits(ratios.maximum * 100.0)
        );
        let why = if base > MOST_LOSS {
            format!("{} messages in 10 s are too few", three_digits(sent.median))
        } else {
            format!("the loss varies: {seen}")
        };
        self.set(KEY, ratio, seen, &why);
        self.values.max_loss_ratio = ratio;
    }

    fn latency(&mut self) {
        const KEY: &str = "max_latency_ms";
        if self.observation.is_sampled {
            return self.omit(KEY, "the topic is sampled in shared memory");
        }
        let odd = self.observation.implausible_timestamps;
        if odd > 0 {
            let why = format!(
                "{odd} messages are stamped later than their capture, or an hour away: the clocks \
                 differ"
            );
            return self.omit(KEY, why);
        }
        let stamped = self.seconds.iter().filter(|second| second.delayed > 0);
        let means: Vec<f64> = stamped
            .map(|second| f64::from(second.delay) / f64::from(second.delayed))
            .collect();
        let count = means.len();
        let Some(means) = Summary::of(means).filter(|_| count >= MIN_OBSERVATIONS) else {
            return self.omit(
                KEY,
                format!("{count} s with writer's timestamps are too few"),
            );
        };
        let margin = LATENCY_MARGIN.max(LATENCY_DEVIATIONS * means.deviation);
        let candidates = [
            (means.median + margin).max(2.0 * means.p95),
            1.5 * means.maximum,
        ];
        let candidates = candidates.map(|latency| rounded_up(latency * 1e3));
        let most = 1e3 * (10.0 * means.median + 10.0 * LATENCY_MARGIN);
        let latency = self.first(candidates, 0.0..=most, |latency| ExpectationValues {
            max_latency_ms: Some(latency),
            ..ExpectationValues::default()
        });
        let seen = format!(
            "one-second means: median {} ms, 95 % below {}, at most {}",
            three_digits(means.median * 1e3),
            three_digits(means.p95 * 1e3),
            three_digits(means.maximum * 1e3)
        );
        self.set(
            KEY,
            latency,
            seen.clone(),
            &format!("the latency varies: {seen}"),
        );
        self.values.max_latency_ms = latency;
    }

    fn silence(&mut self) {
        const KEY: &str = "max_silence_s";
        let published = self.seconds.iter().filter(|second| second.publishers > 0);
        let time = number(self.seconds.len() as u64);
        let silences = published.filter_map(|second| second.silence).map(f64::from);
        let Some(Summary { maximum, .. }) = Summary::of(silences) else {
            return self.omit(KEY, "no message was seen");
        };
        let seen = format!("longest silence {} s", three_digits(maximum));
        let is_regular = self.values.min_rate_hz.is_some();
        if !is_regular && maximum > SILENCE_PART * time {
            let why = format!("{} messages, {seen}: too irregular", self.messages);
            return self.omit(KEY, why);
        }
        let due = self.values.min_rate_hz.map_or(0.0, |rate| 5.0 / rate);
        let silence = rounded_up(SHORTEST_SILENCE.max(SILENCE_MARGIN * maximum).max(due));
        let values = ExpectationValues {
            max_silence_s: Some(silence),
            ..ExpectationValues::default()
        };
        let silence = (!self.violates(values)).then_some(silence);
        self.set(KEY, silence, seen.clone(), &seen);
        self.values.max_silence_s = silence;
    }

    fn endpoints(&mut self) {
        let settled = self.evaluated_seconds();
        let publishers = self.choose_min_endpoints(
            "publishers",
            &settled,
            |it| it.publishers,
            |least| ExpectationValues {
                publishers: least,
                ..ExpectationValues::default()
            },
        );
        let subscribers = self.choose_min_endpoints(
            "subscribers",
            &settled,
            |it| it.subscriptions,
            |least| ExpectationValues {
                subscribers: least,
                ..ExpectationValues::default()
            },
        );
        (self.values.publishers, self.values.subscribers) = (publishers, subscribers);
    }

    /// Returns the seconds in which the agent evaluates the numbers of endpoints.
    fn evaluated_seconds(&self) -> Vec<Second> {
        let mut published = 0;
        let mut settled = Vec::new();
        for second in self.seconds {
            published = if second.publishers > 0 {
                published + 1
            } else {
                0
            };
            if published > STARTUP_GRACE_SECONDS {
                settled.push(*second);
            }
        }
        settled
    }

    /// Chooses a minimum number of endpoints: the median, or the smallest observed number.
    fn choose_min_endpoints(
        &mut self,
        key: &'static str,
        settled: &[Second],
        count: fn(&Second) -> u16,
        expecting: fn(Option<u32>) -> ExpectationValues,
    ) -> Option<u32> {
        if settled.len() < MIN_OBSERVATIONS {
            let published = self.seconds.iter().filter(|it| it.publishers > 0).count();
            self.omit(key, format!("{published} s with a publisher are too few"));
            return None;
        }
        let mut counts: Vec<u16> = settled.iter().map(count).collect();
        counts.sort_unstable();
        let at = |place: usize| counts.get(place).copied().map_or(0, u32::from);
        let (fewest, median, most) = (at(0), at(counts.len() / 2), at(counts.len() - 1));
        let candidates = [median, fewest];
        let least = candidates
            .into_iter()
            .find(|least| *least > 0 && !self.violates(expecting(Some(*least))));
        let seen = match fewest == most {
            true => format!("always {most}"),
            false => format!("{fewest} to {most}"),
        };
        let why = match most {
            0 => format!("the topic had no {key}"),
            _ => format!("the number varies: {seen}"),
        };
        self.set(key, least.map(f64::from), seen, &why);
        least
    }

    /// Leaves out expectations that the topic's own seconds violate together: bad seconds of
    /// different expectations in a row count as one violation.
    fn drop_conflicting(&mut self) {
        let Ok(expectations) = Expectations::try_from(self.values) else {
            return;
        };
        let violations = rehearsal::violations(&expectations, self.seconds);
        for violated in violations {
            let values = &mut self.values;
            match violated {
                "min_rate_hz" => values.min_rate_hz = None,
                "max_rate_hz" => values.max_rate_hz = None,
                "max_loss_ratio" => values.max_loss_ratio = None,
                "max_latency_ms" => values.max_latency_ms = None,
                "max_silence_s" => values.max_silence_s = None,
                "publishers" => values.publishers = None,
                _ => values.subscribers = None,
            }
            for remark in &mut self.remarks {
                if matches!(remark, Remark::Set(key, ..) if *key == violated) {
                    let why = "several figures of the topic vary at once".to_owned();
                    *remark = Remark::LeftOut(violated, why);
                }
            }
        }
        let values = &mut self.values;
        if values.min_rate_hz.or(values.max_rate_hz).is_none() {
            values.window_s = None;
            let is_window = |remark: &Remark| matches!(remark, Remark::Set("window_s", ..));
            self.remarks.retain(|remark| !is_window(remark));
        }
    }

    fn set(&mut self, key: &'static str, value: Option<f64>, seen: String, why: &str) {
        match value {
            Some(value) => self.remarks.push(Remark::Set(key, value, seen)),
            None => self.omit(key, why),
        }
    }
}

impl Windows {
    /// Returns the usual minimum rate, and the widest one, just below the lowest observed rate.
    fn min_rates(&self) -> [f64; 2] {
        let lows = [
            self.rates.median - self.half_band_width(),
            self.rates.minimum * 0.95,
        ];
        lows.map(rounded_down)
    }

    /// Returns the usual maximum rate, and the widest one, just above the highest observed rate.
    fn max_rates(&self) -> [f64; 2] {
        let highs = [
            self.rates.median + self.half_band_width(),
            self.rates.maximum * 1.05,
        ];
        highs.map(rounded_up)
    }

    /// Returns half the width of the usual band.
    fn half_band_width(&self) -> f64 {
        let rates = &self.rates;
        (RATE_MARGIN * rates.median).max(RATE_DEVIATIONS * rates.deviation)
    }

    /// Returns the smallest minimum rate that half the rate violates.
    fn least(&self) -> f64 {
        let median = self.rates.median;
        let half = 0.5 * median + MESSAGE_TOLERANCE / number(self.seconds);
        half.max(RATE_LIMITS.0 * median)
    }

    /// Returns whether no window violates this minimum rate.
    fn is_above(&self, rate: f64) -> bool {
        let seconds = number(self.seconds);
        rate * seconds < self.rates.minimum * seconds + MESSAGE_TOLERANCE
    }

    /// Returns whether no window violates this maximum rate.
    fn is_below(&self, rate: f64) -> bool {
        let seconds = number(self.seconds);
        rate * seconds + MESSAGE_TOLERANCE > self.rates.maximum * seconds
    }

    /// Returns the expectation of the rate in windows of this length.
    fn expecting(&self, low: Option<f64>, high: Option<f64>) -> ExpectationValues {
        let window = u32::try_from(self.seconds).ok();
        ExpectationValues {
            min_rate_hz: low,
            max_rate_hz: high,
            window_s: window.filter(|_| !self.is_default && low.or(high).is_some()),
            ..ExpectationValues::default()
        }
    }
}

/// Returns a statistic as text with three digits.
fn three_digits(value: f64) -> String {
    if value <= 0.0 {
        return "0".to_owned();
    }
    let (down, up) = (rounded_down(value), rounded_up(value));
    let nearest = if value - down <= up - value { down } else { up };
    nearest.to_string()
}

#[expect(
    clippy::cast_precision_loss,
    reason = "a count of messages or seconds is far below 2^52"
)]
const fn number(count: u64) -> f64 {
    count as f64
}
