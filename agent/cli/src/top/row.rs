//! One line of the table: the shown values of a topic, its problems, and the sort order. The values
//! are derived from the agent's current facts and the facts of the last seconds.

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::text::escaped;
use ros2probe_api::Open;
use ros2probe_api::topics::{ReasonCode, Topic};

/// Time span of losses in the table, so that an old loss does not hide a new one.
const LOSS_WINDOW: Duration = Duration::from_secs(30);
/// Minimum time between two samples of the counters.
const SAMPLE_INTERVAL: Duration = Duration::from_millis(900);

/// Identity of a topic within all domains.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// Domain of the topic.
    pub domain_id: u32,
    /// DDS name as reported by the agent.
    pub dds_name: String,
}

/// State of a topic, from worst to best.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RowState {
    /// An expectation is violated.
    Violated,
    /// The topic is published, but has no messages.
    Silent,
    /// The topic is watched by its name and has no publisher.
    NotPublished,
    /// Messages are invisible, for a known reason.
    Unseen,
    /// The topic is published and has no subscriber.
    NoSubscriber,
    /// The topic is measured without expectations and has no recent messages.
    Quiet,
    /// Messages arrive as expected.
    Ok,
    /// No watch or subscription measures the topic.
    Unwatched,
    /// The last endpoint of the topic has left.
    Gone,
}

impl RowState {
    /// Returns the label in the table.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Violated => "violated",
            Self::Silent => "silent",
            Self::NotPublished => "no pub",
            Self::Unseen => "unseen",
            Self::NoSubscriber => "no sub",
            Self::Quiet => "quiet",
            Self::Ok => "ok",
            Self::Unwatched => "unwatched",
            Self::Gone => "gone",
        }
    }
}

/// One topic in the table. Names are escaped.
#[derive(Clone, Debug)]
pub struct Row {
    /// Identity of the topic.
    pub key: Key,
    /// ROS name.
    pub name: String,
    /// ROS types.
    pub message_type: String,
    /// Whether messages are counted.
    pub is_measured: bool,
    /// Messages per second.
    pub rate: Option<f64>,
    /// Minimum and maximum expected rate, in messages per second.
    pub expected_rate: (Option<f64>, Option<f64>),
    /// Payload bytes per second.
    pub bandwidth: Option<f64>,
    /// Ratio of messages that the worst subscriber lost.
    pub loss: Option<f64>,
    /// Median latency in seconds.
    pub median: Option<f64>,
    /// 99th percentile of the latency in seconds.
    pub p99: Option<f64>,
    /// Late calls of its callbacks in the last minute, if there were any.
    pub late: Option<u64>,
    /// Number of writers.
    pub publishers: usize,
    /// Number of readers.
    pub subscriptions: usize,
    /// State of the topic.
    pub state: RowState,
    /// Problems, in one word each.
    pub problems: Vec<&'static str>,
}

/// Messages that the worst subscriber expected and lost.
#[derive(Clone, Copy, Debug, Default)]
struct Counters {
    expected: u64,
    lost: u64,
}

/// Counters of the last [`LOSS_WINDOW`].
#[derive(Clone, Debug, Default)]
pub struct Past {
    notes: VecDeque<(Instant, Counters)>,
}

impl Past {
    /// Returns the loss ratio of the last [`LOSS_WINDOW`], or the total one if nothing was sent in
    /// it. The flag is whether messages were lost in the window.
    fn loss(&mut self, topic: &Topic<'_>, now: Instant) -> (Option<f64>, bool) {
        let latest = Counters::of(topic);
        let first = self.notes.front().map(|(_, counters)| *counters);
        let lately = first.and_then(|first| latest.since(first));
        let is_lost = lately.is_some_and(|(_, lost)| lost);
        let is_due = self
            .notes
            .back()
            .is_none_or(|(at, _)| now - *at >= SAMPLE_INTERVAL);
        if is_due {
            self.notes.push_back((now, latest));
            while self
                .notes
                .front()
                .is_some_and(|(at, _)| now - *at > LOSS_WINDOW)
            {
                self.notes.pop_front();
            }
        }
        let ever = || latest.since(Counters::default());
        let (ratio, _) = match lately.or_else(ever) {
            Some((ratio, lost)) => (Some(ratio), lost),
            None => (None, false),
        };
        (ratio, is_lost)
    }
}

impl Counters {
    fn of(topic: &Topic<'_>) -> Self {
        let measured = topic.measurement.as_ref();
        measured.map_or_else(Self::default, |it| Self {
            expected: it.subscriber_expected_messages,
            lost: it.subscriber_lost_messages,
        })
    }

    /// Returns the ratio, and whether messages were lost. Returns `None` if no messages were
    /// expected, or if the counters restarted.
    #[expect(
        clippy::cast_precision_loss,
        reason = "a ratio of counts far below 2^52"
    )]
    fn since(self, first: Self) -> Option<(f64, bool)> {
        let expected = self.expected.checked_sub(first.expected)?;
        let lost = self.lost.checked_sub(first.lost)?;
        (expected > 0).then(|| (lost as f64 / expected as f64, lost > 0))
    }
}

impl Row {
    /// Creates the row of `topic`.
    #[must_use]
    pub fn new(topic: &Topic<'_>, past: &mut Past, now: Instant) -> Self {
        let is_measured = is_measured(topic);
        let measured = topic.measurement.as_ref().filter(|_| is_measured);
        let (loss, is_losing) = match measured {
            Some(_) => past.loss(topic, now),
            None => (None, false),
        };
        let latency = measured.and_then(|it| it.latency.or(it.header_latency));
        let standing = row_state(topic, is_measured);
        let types: Vec<_> = topic.message_types.iter().map(|it| escaped(it)).collect();
        Self {
            key: Key {
                domain_id: topic.domain_id,
                dds_name: topic.dds_name.to_string(),
            },
            name: shown_name(topic),
            message_type: types.join(", "),
            is_measured,
            rate: measured.and_then(|it| it.rate_hertz),
            expected_rate: expected_rate(topic),
            bandwidth: measured.and_then(|it| it.bandwidth_bytes_per_second),
            loss,
            median: latency.map(|it| it.p50_seconds),
            p99: latency.map(|it| it.p99_seconds),
            late: topic
                .inside
                .as_ref()
                .and_then(|inside| Some(inside.late.as_ref()?.calls)),
            publishers: topic.publishers.len(),
            subscriptions: topic.subscriptions.len(),
            state: standing,
            problems: problems(topic, standing, is_losing),
        }
    }

    /// Returns the state as text: the problems, or the label of the state.
    #[must_use]
    pub fn state(&self) -> String {
        if self.problems.is_empty() {
            return self.state.label().to_owned();
        }
        let says_more = matches!(self.state, RowState::Unwatched | RowState::NoSubscriber);
        let standing = says_more.then(|| self.state.label());
        let words = self.problems.iter().copied().chain(standing);
        format!("!{}", words.collect::<Vec<_>>().join(","))
    }
}

/// Returns the displayed name: the ROS name, or the DDS name for topics of a service.
#[must_use]
pub fn shown_name(topic: &Topic<'_>) -> String {
    match topic.kind.as_ref() {
        "service_request" | "service_reply" => escaped(&topic.dds_name),
        _ => escaped(&topic.name),
    }
}

/// Returns whether messages are counted now. Values remain after the end of the measurement.
#[must_use]
pub fn is_measured(topic: &Topic<'_>) -> bool {
    let mut publishers = topic.publishers.iter();
    topic.measurement.is_some()
        && (!topic.watches.is_empty() || publishers.any(|it| it.measurement.is_some()))
}

/// Returns the tightest of all expectations about the topic's rate.
fn expected_rate(topic: &Topic<'_>) -> (Option<f64>, Option<f64>) {
    let watches = || topic.watches.iter();
    (
        watches()
            .filter_map(|it| it.expectations.min_rate_hz)
            .reduce(f64::max),
        watches()
            .filter_map(|it| it.expectations.max_rate_hz)
            .reduce(f64::min),
    )
}

fn row_state(topic: &Topic<'_>, is_measured: bool) -> RowState {
    if topic.vanished {
        return RowState::Gone;
    }
    let has = |state: &str| topic.watches.iter().any(|watch| watch.state == state);
    let is_blind = topic.reasons.iter().any(|reason| {
        matches!(
            reason.code,
            Open::Known(
                ReasonCode::Encrypted
                    | ReasonCode::SharedMemory
                    | ReasonCode::DataSharing
                    | ReasonCode::SameProcess
                    | ReasonCode::Iceoryx
                    | ReasonCode::OutsideView
                    | ReasonCode::WatchRejected
            )
        )
    });
    let flows = topic
        .measurement
        .as_ref()
        .and_then(|it| it.rate_hertz)
        .is_some_and(|rate| rate > 0.0);
    match () {
        () if has("violated") => RowState::Violated,
        () if is_blind && !flows => RowState::Unseen,
        () if !is_measured => RowState::Unwatched,
        () if has("silent") => RowState::Silent,
        () if has("not_published") || topic.publishers.is_empty() => RowState::NotPublished,
        () if topic.subscriptions.is_empty() && !flows => RowState::NoSubscriber,
        () if !flows => RowState::Quiet,
        () => RowState::Ok,
    }
}

fn problems(topic: &Topic<'_>, standing: RowState, is_losing: bool) -> Vec<&'static str> {
    let mut problems = Vec::new();
    let mut say = |word| {
        if !problems.contains(&word) {
            problems.push(word);
        }
    };
    for violation in topic.watches.iter().flat_map(|watch| &watch.violations) {
        say(match violation.as_ref() {
            "min_rate_hz" => "slow",
            "max_rate_hz" => "fast",
            "max_loss_ratio" => "loss",
            "max_latency_ms" => "late",
            "max_silence_s" => "silent",
            "publishers" => "few pub",
            "subscribers" => "few sub",
            _ => "violated",
        });
    }
    match standing {
        RowState::Violated if topic.watches.iter().all(|it| it.violations.is_empty()) => {
            say("violated");
        }
        RowState::Silent => say("silent"),
        RowState::Unseen => say("unseen"),
        // Subscribers without a publisher are common, but a watch on the exact name expects one.
        RowState::NotPublished if topic.watches.iter().any(|it| !it.watch.contains('*')) => {
            say("no pub");
        }
        _ => {}
    }
    if is_losing {
        say("loss");
    }
    for finding in &topic.diagnoses {
        match finding.kind() {
            "qos_incompatible" => say("qos"),
            "late_callback" => say("late"),
            "type_conflict" => say("type"),
            "type_hash_conflict" => say("hash"),
            // Tools that publish without a subscriber are common.
            "unmatched_publisher" | "unmatched_subscription" | "" => {}
            _ => say("graph"),
        }
    }
    problems
}

/// Column by which the table is sorted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Column {
    /// Name, then domain.
    #[default]
    Name,
    /// Rate, the highest first.
    Rate,
    /// Bandwidth, the highest first.
    Bandwidth,
    /// Loss, the worst first.
    Loss,
    /// 99th percentile of latency, the worst first.
    Latency,
    /// Late calls of callbacks in the last minute, the most first.
    Late,
    /// Number of publishers, the highest first.
    Publishers,
    /// Number of subscribers, the highest first.
    Subscribers,
    /// Problems first.
    State,
}

impl Column {
    /// All columns, in the order of their keys.
    pub const ALL: [Self; 9] = [
        Self::Name,
        Self::Rate,
        Self::Bandwidth,
        Self::Loss,
        Self::Latency,
        Self::Publishers,
        Self::Subscribers,
        Self::State,
        Self::Late,
    ];

    /// Returns the name of the column in the header.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Name => "name",
            Self::Rate => "rate",
            Self::Bandwidth => "bandwidth",
            Self::Loss => "loss",
            Self::Latency => "latency",
            Self::Late => "late calls",
            Self::Publishers => "publishers",
            Self::Subscribers => "subscribers",
            Self::State => "state",
        }
    }

    /// Compares two topics. Unknown values come last, also in reverse order.
    #[must_use]
    pub fn order(self, reverse: bool, one: &Row, other: &Row) -> Ordering {
        let turn = |order: Ordering| if reverse { order.reverse() } else { order };
        let names = || (&one.name, &one.key).cmp(&(&other.name, &other.key));
        let known = |one: Option<f64>, other: Option<f64>| match (one, other) {
            (Some(one), Some(other)) => turn(other.total_cmp(&one)),
            (one, other) => other.is_some().cmp(&one.is_some()),
        };
        let order = match self {
            Self::Name => turn(names()),
            Self::Rate => known(one.rate, other.rate),
            Self::Bandwidth => known(one.bandwidth, other.bandwidth),
            Self::Loss => known(one.loss, other.loss),
            Self::Latency => known(one.p99, other.p99),
            Self::Late => turn(other.late.cmp(&one.late)),
            Self::Publishers => turn(other.publishers.cmp(&one.publishers)),
            Self::Subscribers => turn(other.subscriptions.cmp(&one.subscriptions)),
            Self::State => turn(
                (one.problems.is_empty(), one.state).cmp(&(other.problems.is_empty(), other.state)),
            ),
        };
        order.then_with(names)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn topic(json: serde_json::Value) -> Topic<'static> {
        serde_json::from_value(json).unwrap()
    }

    fn row(json: serde_json::Value) -> Row {
        Row::new(&topic(json), &mut Past::default(), Instant::now())
    }

    #[test]
    fn a_topic_that_is_not_measured_has_no_numbers() {
        let both = json!([{"measurement": null}]);
        let unwatched = row(json!({"publishers": both, "subscriptions": both}));
        assert_eq!(
            (unwatched.rate, unwatched.loss, unwatched.state()),
            (None, None, "unwatched".to_owned())
        );
        // Counters persist after the measurement; the rate is unknown, not 0.
        let before = row(json!({
            "publishers": both, "measurement": {"messages": 9, "rate_hertz": 0.0}
        }));
        assert_eq!((before.rate, before.is_measured), (None, false));
    }

    #[test]
    fn the_state_names_the_fault() {
        let measured = json!({"messages": 9, "rate_hertz": 9.0});
        let one = json!([{"measurement": measured}]);
        let state = |watches: serde_json::Value, diagnoses: serde_json::Value| {
            let row = row(json!({
                "publishers": one, "subscriptions": one, "measurement": measured,
                "watches": watches, "diagnoses": diagnoses,
            }));
            row.state()
        };
        assert_eq!(state(json!([]), json!([])), "ok");
        let slow = json!([{"state": "violated", "violations": ["min_rate_hz", "max_latency_ms"]}]);
        assert_eq!(state(slow, json!([])), "!slow,late");
        let few = json!([{"state": "violated", "violations": ["publishers", "subscribers"]}]);
        assert_eq!(state(few, json!([])), "!few pub,few sub");
        let qos = json!([{"kind": "qos_incompatible"}, {"kind": "unmatched_publisher"}]);
        assert_eq!(state(json!([{"state": "ok"}]), qos), "!qos");
        assert_eq!(state(json!([{"state": "silent"}]), json!([])), "!silent");
        let late = json!([{"kind": "late_callback"}]);
        assert_eq!(state(json!([]), late), "!late");
    }

    #[test]
    fn an_invisible_topic_is_not_shown_as_quiet() {
        let quiet = json!({"messages": 0, "rate_hertz": 0.0});
        let one = json!([{"measurement": quiet}]);
        let state = |code: &str| {
            let reasons = json!([{"code": code, "detail": ""}]);
            let row = row(json!({
                "publishers": one, "subscriptions": one, "measurement": quiet,
                "reasons": reasons,
            }));
            row.state()
        };
        assert_eq!(state("quiet"), "quiet");
        for code in ["data_sharing", "encrypted", "outside_view", "same_process"] {
            assert_eq!(state(code), "!unseen", "{code}");
        }
    }

    #[test]
    fn only_recent_losses_of_the_worst_subscriber_are_a_problem() {
        let start = Instant::now();
        let at = |seconds: u64| start + Duration::from_secs(seconds);
        let facts = |expected: u64, lost: u64| {
            topic(json!({
                "publishers": [{"measurement": {}}],
                "measurement": {"subscriber_expected_messages": expected,
                    "subscriber_lost_messages": lost, "rate_hertz": 1.0},
            }))
        };
        let mut past = Past::default();
        let mut seen = |seconds: u64, facts: &Topic<'_>| {
            let row = Row::new(facts, &mut past, at(seconds));
            (row.loss, row.problems)
        };
        // Earlier losses are shown, but not as a recent problem.
        assert_eq!(seen(0, &facts(200, 100)), (Some(0.5), vec![]));
        assert_eq!(seen(1, &facts(300, 100)), (Some(0.0), vec![]));
        let (loss, problems) = seen(2, &facts(380, 150));
        assert_eq!(problems, ["loss"]);
        assert!((loss.unwrap() - 50.0 / 180.0).abs() < 1e-9, "{loss:?}");
        for second in 3..40 {
            seen(second, &facts(380 + second, 150));
        }
        assert_eq!(seen(40, &facts(500, 150)), (Some(0.0), vec![]));
        // The agent has restarted.
        assert_eq!(seen(41, &facts(10, 0)), (Some(0.0), vec![]));
    }

    #[test]
    fn unknown_values_are_sorted_last_in_both_directions() {
        let rows = [Some(1.0), None, Some(3.0)].map(|rate| {
            let mut row = row(json!({"name": format!("/{rate:?}")}));
            row.rate = rate;
            row
        });
        let sorted = |reverse: bool| {
            let mut rows: Vec<_> = rows.iter().collect();
            rows.sort_by(|one, other| Column::Rate.order(reverse, one, other));
            rows.iter().map(|row| row.rate).collect::<Vec<_>>()
        };
        assert_eq!(sorted(false), [Some(3.0), Some(1.0), None]);
        assert_eq!(sorted(true), [Some(1.0), Some(3.0), None]);
    }
}
