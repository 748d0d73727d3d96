//! Watches and their expectations as validated data, and the matcher that finds the entries for a
//! topic.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::time::nanoseconds;
use serde::{Deserialize, Serialize};

use crate::facts::glob;

/// One watchlist entry.
#[derive(Clone, Debug, PartialEq)]
pub struct Watch {
    /// Exact ROS name (`/points`) or glob: `*` within a token, `**` across tokens.
    pub pattern: String,
    /// Domain; `None` for every domain.
    pub domain_id: Option<DomainId>,
    /// Expectations of each topic.
    pub expectations: Expectations,
    /// Whether metrics have series per delivery.
    pub per_subscriber: bool,
    /// Share of messages for which spans are exported, from 0 to 1.
    pub trace: f64,
    /// Messages that are kept for later recordings.
    pub retain: Retain,
}

/// Messages that the agent keeps for recordings that begin later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Retain {
    /// No messages.
    #[default]
    None,
    /// The last message of each writer that keeps messages for late joiners (transient local).
    Last,
}

/// Expectations of a topic; a field that is `None` expects nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expectations {
    /// Minimum rate, in messages per second.
    pub min_rate_hz: Option<f64>,
    /// Maximum rate, in messages per second.
    pub max_rate_hz: Option<f64>,
    /// Window of both rates in seconds; `None` for one of at least three messages (1 to 10 s).
    pub window_s: Option<u32>,
    /// Maximum share of messages that the worst subscriber may lose, from 0 to 1; see
    /// [`LossShare`](crate::facts::loss_share::LossShare).
    pub max_loss_ratio: Option<f64>,
    /// Maximum time from INFO_TS to the capture.
    pub max_latency: Option<Duration>,
    /// Maximum time without a message.
    pub max_silence: Option<Duration>,
    /// Minimum number of publishers.
    pub publishers: Option<u32>,
    /// Minimum number of subscribers.
    pub subscribers: Option<u32>,
}

/// Expectations in the units of the configuration and of the API.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExpectationValues {
    /// Minimum rate, in messages per second.
    pub min_rate_hz: Option<f64>,
    /// Maximum rate, in messages per second.
    pub max_rate_hz: Option<f64>,
    /// Window of both rates in seconds; `None` for one of at least three messages (1 to 10 s).
    pub window_s: Option<u32>,
    /// Maximum share of messages that the worst subscriber may lose, from 0 to 1.
    pub max_loss_ratio: Option<f64>,
    /// Maximum time from INFO_TS to the capture, in milliseconds.
    pub max_latency_ms: Option<f64>,
    /// Maximum time without a message, in seconds.
    pub max_silence_s: Option<f64>,
    /// Minimum number of publishers.
    pub publishers: Option<u32>,
    /// Minimum number of subscribers.
    pub subscribers: Option<u32>,
}

/// Why a topic name or glob cannot match any topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PatternError {
    /// The text is empty.
    #[error("is empty")]
    Empty,
    /// The name is relative or private, which is only meaningful within a node.
    #[error("must begin with a slash, as in `/points`")]
    NoSlash,
    /// The name contains `//` or ends with a slash.
    #[error("has a name token without letters")]
    EmptyToken,
    /// A token begins with a digit, which ROS forbids.
    #[error("has a name token that begins with a digit, which ROS does not allow")]
    Digit,
    /// `**` is not a whole token.
    #[error("`**` must stand alone between slashes")]
    Stars,
    /// The name contains a character other than ASCII letters, digits and `_`.
    #[error("has the character `{0}`: ROS names have letters, digits and `_`, globs also `*`")]
    Character(char),
    /// The name is longer than DDS allows.
    #[error("is longer than 255 characters")]
    Long,
    /// The glob has more than [`MAX_STARS`] stars.
    #[error("has more than {MAX_STARS} stars")]
    ManyStars,
}

/// Why values are invalid as expectations of a watch.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ExpectationError {
    /// A value is out of its range.
    #[error("{key} is {value}, must be between {low} and {high}")]
    OutOfRange {
        /// Key of the configuration, in whose unit the numbers are.
        key: &'static str,
        /// The value.
        value: f64,
        /// The smallest valid value.
        low: f64,
        /// The largest valid value.
        high: f64,
    },
    /// The maximum rate is below the minimum rate, both in Hz.
    #[error("max_rate_hz is {high}, below min_rate_hz, which is {low}")]
    CrossedRates {
        /// `min_rate_hz`.
        low: f64,
        /// `max_rate_hz`.
        high: f64,
    },
    /// A window has a length, but no rate is measured over it.
    #[error("window_s needs min_rate_hz or max_rate_hz")]
    WindowWithoutRate,
}

/// Too many globs: matching all of them against a topic would take too long.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{count} globs of {bytes} bytes; at most {MAX_GLOBS} of {MAX_GLOB_BYTES} bytes are matched: \
     use names, or fewer and shorter globs"
)]
pub struct ManyGlobs {
    /// Number of globs.
    pub count: usize,
    /// Total length of all globs in bytes.
    pub bytes: usize,
}

impl Watch {
    /// Returns a watch of this name or glob in every domain, without expectations.
    ///
    /// # Errors
    /// Fails if `pattern` is neither a ROS name nor a glob.
    pub fn named(pattern: &str) -> Result<Self, PatternError> {
        check_pattern(pattern)?;
        Ok(Self {
            pattern: pattern.to_owned(),
            ..Self::everything()
        })
    }

    /// Returns a watch of every topic in every domain.
    #[must_use]
    pub fn everything() -> Self {
        Self {
            pattern: "/**".to_owned(),
            domain_id: None,
            expectations: Expectations::default(),
            per_subscriber: false,
            trace: 0.0,
            retain: Retain::None,
        }
    }

    /// Returns whether the pattern is an exact name rather than a glob.
    #[must_use]
    pub fn is_literal(&self) -> bool {
        !self.pattern.contains('*')
    }
}

impl Expectations {
    /// Returns each key and whether it is set.
    #[must_use]
    pub const fn keys(&self) -> [(&'static str, bool); 7] {
        // `window_s` belongs to the rates and expects nothing.
        [
            ("min_rate_hz", self.min_rate_hz.is_some()),
            ("max_rate_hz", self.max_rate_hz.is_some()),
            ("max_loss_ratio", self.max_loss_ratio.is_some()),
            ("max_latency_ms", self.max_latency.is_some()),
            ("max_silence_s", self.max_silence.is_some()),
            ("publishers", self.publishers.is_some()),
            ("subscribers", self.subscribers.is_some()),
        ]
    }

    /// Returns the values in the units of the configuration, exact to a nanosecond.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "nanoseconds of a threshold stay exact to 104 days"
    )]
    pub fn values(&self) -> ExpectationValues {
        let nanoseconds = |duration| nanoseconds(duration) as f64;
        ExpectationValues {
            min_rate_hz: self.min_rate_hz,
            max_rate_hz: self.max_rate_hz,
            window_s: self.window_s,
            max_loss_ratio: self.max_loss_ratio,
            max_latency_ms: self.max_latency.map(|latency| nanoseconds(latency) / 1e6),
            max_silence_s: self.max_silence.map(|silence| nanoseconds(silence) / 1e9),
            publishers: self.publishers,
            subscribers: self.subscribers,
        }
    }
}

impl TryFrom<ExpectationValues> for Expectations {
    type Error = ExpectationError;

    /// Validates the values.
    ///
    /// # Errors
    /// Returns the first value out of its range, or values that contradict each other.
    fn try_from(values: ExpectationValues) -> Result<Self, ExpectationError> {
        let ExpectationValues {
            min_rate_hz,
            max_rate_hz,
            window_s,
            max_loss_ratio,
            max_latency_ms,
            max_silence_s,
            publishers,
            subscribers,
        } = values;
        let values = [
            min_rate_hz,
            max_rate_hz,
            window_s.map(f64::from),
            max_loss_ratio,
            max_latency_ms,
            max_silence_s,
            publishers.map(f64::from),
            subscribers.map(f64::from),
        ];
        for ((key, low, high), value) in EXPECTATION_RANGES.into_iter().zip(values) {
            if let Some(value) = value.filter(|value| !(low..=high).contains(value)) {
                return Err(ExpectationError::OutOfRange {
                    key,
                    value,
                    low,
                    high,
                });
            }
        }
        if let (Some(low), Some(high)) = (min_rate_hz, max_rate_hz)
            && low > high
        {
            return Err(ExpectationError::CrossedRates { low, high });
        }
        if window_s.is_some() && min_rate_hz.or(max_rate_hz).is_none() {
            return Err(ExpectationError::WindowWithoutRate);
        }
        Ok(Self {
            min_rate_hz,
            max_rate_hz,
            window_s,
            max_loss_ratio,
            max_latency: max_latency_ms.map(|value| Duration::from_secs_f64(value / 1e3)),
            max_silence: max_silence_s.map(Duration::from_secs_f64),
            publishers,
            subscribers,
        })
    }
}

/// Maximum number of stars in a glob; `**` counts as two.
pub const MAX_STARS: usize = 16;
/// Maximum number of globs in a watchlist; each new topic is matched against all of them.
pub const MAX_GLOBS: usize = 256;
/// Maximum total length of the globs in a watchlist, in bytes.
pub const MAX_GLOB_BYTES: usize = 16 << 10;

/// Valid ranges of expectations, as in the configuration's schema.
const EXPECTATION_RANGES: [(&str, f64, f64); 8] = [
    ("min_rate_hz", 0.0, 1_000_000.0),
    ("max_rate_hz", 0.0, 1_000_000.0),
    // The longest window is `rate::SECONDS`.
    ("window_s", 1.0, 10.0),
    ("max_loss_ratio", 0.0, 1.0),
    ("max_latency_ms", 0.0, 3_600_000.0),
    ("max_silence_s", 0.001, 604_800.0),
    ("publishers", 1.0, 10_000.0),
    ("subscribers", 1.0, 10_000.0),
];

/// Validates a share of messages for tracing.
///
/// # Errors
/// Returns the valid range.
pub fn check_trace(ratio: f64) -> Result<(), ExpectationError> {
    if (0.0..=1.0).contains(&ratio) {
        return Ok(());
    }
    Err(ExpectationError::OutOfRange {
        key: "trace",
        value: ratio,
        low: 0.0,
        high: 1.0,
    })
}

/// Validates a ROS topic name or a glob over such names.
///
/// # Errors
/// Returns the first broken rule.
pub fn check_pattern(pattern: &str) -> Result<(), PatternError> {
    if pattern.is_empty() {
        return Err(PatternError::Empty);
    }
    let Some(tokens) = pattern.strip_prefix('/') else {
        return Err(PatternError::NoSlash);
    };
    if pattern.len() > 255 {
        return Err(PatternError::Long);
    }
    if pattern.matches('*').count() > MAX_STARS {
        return Err(PatternError::ManyStars);
    }
    for token in tokens.split('/') {
        if token.is_empty() {
            return Err(PatternError::EmptyToken);
        }
        if token.starts_with(|c: char| c.is_ascii_digit()) {
            return Err(PatternError::Digit);
        }
        if token.contains("**") && token != "**" {
            return Err(PatternError::Stars);
        }
        let strange = |c: char| !(c.is_ascii_alphanumeric() || matches!(c, '_' | '*'));
        if let Some(character) = token.chars().find(|c| strange(*c)) {
            return Err(PatternError::Character(character));
        }
    }
    Ok(())
}

/// Validates the number and length of the globs in `patterns`.
///
/// # Errors
/// Fails if matching them against every topic would take too long.
pub fn check_globs<'a>(patterns: impl IntoIterator<Item = &'a str>) -> Result<(), ManyGlobs> {
    let globs = patterns.into_iter().filter(|pattern| pattern.contains('*'));
    let (count, bytes) = globs.fold((0, 0), |(count, bytes), glob| {
        (count + 1, bytes + glob.len())
    });
    if count > MAX_GLOBS || bytes > MAX_GLOB_BYTES {
        return Err(ManyGlobs { count, bytes });
    }
    Ok(())
}

/// A watchlist, prepared for matching.
#[derive(Clone, Debug, Default)]
pub struct Watchlist {
    watches: Vec<Arc<Watch>>,
    /// Indices in `watches` of the entries with this pattern, one per domain.
    patterns: HashMap<String, Vec<usize>>,
    /// Indices in `watches` of the globs.
    globs: Vec<usize>,
}

impl Watchlist {
    /// Prepares `watches`, keeping their order.
    ///
    /// # Errors
    /// Fails if there are too many globs.
    pub fn new(watches: Vec<Watch>) -> Result<Self, ManyGlobs> {
        Self::of(watches.into_iter().map(Arc::new).collect())
    }

    /// Prepares entries that other watchlists share, as [`Self::new`] does.
    ///
    /// # Errors
    /// Fails as [`Self::new`] does.
    pub fn of(watches: Vec<Arc<Watch>>) -> Result<Self, ManyGlobs> {
        check_globs(watches.iter().map(|watch| watch.pattern.as_str()))?;
        let mut patterns: HashMap<String, Vec<usize>> = HashMap::with_capacity(watches.len());
        let mut globs = Vec::new();
        for (place, watch) in watches.iter().enumerate() {
            patterns
                .entry(watch.pattern.clone())
                .or_default()
                .push(place);
            if !watch.is_literal() {
                globs.push(place);
            }
        }
        Ok(Self {
            watches,
            patterns,
            globs,
        })
    }

    /// Returns the entries, in configuration order.
    #[must_use]
    pub fn watches(&self) -> &[Arc<Watch>] {
        &self.watches
    }

    /// Returns the number of globs that each topic's name is matched against.
    #[must_use]
    pub const fn globs(&self) -> usize {
        self.globs.len()
    }

    /// Returns the entries that cover this topic, as indices into [`Self::watches`].
    #[must_use]
    pub fn matching(&self, domain_id: DomainId, topic: &str) -> Vec<usize> {
        let covers = |place: &usize| {
            let watch = self.watches.get(*place);
            watch.is_some_and(|watch| glob::covers(&watch.pattern, topic))
        };
        let globs = self.globs.iter().copied().filter(covers);
        // A hostile topic's name may equal a glob, which was matched above.
        let named = self.patterns.get(topic).into_iter().flatten().copied();
        let named =
            named.filter(|place| self.watches.get(*place).is_some_and(|it| it.is_literal()));
        let mut matching: Vec<usize> = globs.chain(named).collect();
        matching.retain(|place| {
            let wanted = self.watches.get(*place).and_then(|watch| watch.domain_id);
            wanted.is_none_or(|wanted| wanted == domain_id)
        });
        matching.sort_unstable();
        matching
    }

    /// Returns whether any entry is an exact name.
    #[must_use]
    pub fn has_names(&self) -> bool {
        self.watches.len() > self.globs.len()
    }

    /// Returns whether an entry has this exact name, for this domain or, with `None`, for any.
    #[must_use]
    pub fn names(&self, domain_id: Option<DomainId>, topic: &str) -> bool {
        let mut places = self.patterns.get(topic).into_iter().flatten();
        places.any(|place| {
            let watch = self.watches.get(*place);
            watch.is_some_and(|watch| {
                let domains = domain_id.zip(watch.domain_id);
                watch.is_literal() && domains.is_none_or(|(one, other)| one == other)
            })
        })
    }

    /// Returns the index of the entry with this pattern and domain.
    #[must_use]
    pub fn position(&self, pattern: &str, domain_id: Option<DomainId>) -> Option<usize> {
        let mut places = self.patterns.get(pattern)?.iter().copied();
        places.find(|place| {
            let watch = self.watches.get(*place);
            watch.is_some_and(|watch| watch.domain_id == domain_id)
        })
    }
}

/// State of one watchlist entry's expectations on one topic.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum WatchState {
    /// All expectations hold, or the entry has none, and messages arrive.
    Ok,
    /// At least one expectation is violated, after hysteresis.
    Violated,
    /// A publisher exists, but no message arrived for longer than `max_silence_s`.
    Silent,
    /// No publisher is known.
    NotPublished,
    /// A publisher exists, but no subscriber; most writers then send nothing. Neither `publishers`
    /// nor `subscribers` is violated.
    NoSubscriber,
}
impl WatchState {
    /// All states, for exporting one series each.
    pub const ALL: [Self; 5] = [
        Self::Ok,
        Self::Violated,
        Self::Silent,
        Self::NotPublished,
        Self::NoSubscriber,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Violated => "violated",
            Self::Silent => "silent",
            Self::NotPublished => "not_published",
            Self::NoSubscriber => "no_subscriber",
        }
    }
}
#[cfg(test)]
mod tests {
    use super::*;

    fn watchlist(patterns: &[&str]) -> Watchlist {
        Watchlist::new(
            patterns
                .iter()
                .map(|name| Watch::named(name).unwrap())
                .collect(),
        )
        .unwrap()
    }

    #[test]
    fn one_star_stays_within_a_token_and_two_stars_cross_tokens() {
        let list = watchlist(&["/camera/*/image_raw", "/**", "/points", "/camera/**"]);
        assert_eq!(
            list.matching(DomainId(0), "/camera/left/image_raw"),
            [0, 1, 3]
        );
        assert_eq!(
            list.matching(DomainId(0), "/camera/left/up/image_raw"),
            [1, 3]
        );
        assert_eq!(list.matching(DomainId(0), "/points"), [1, 2]);
        assert_eq!(list.matching(DomainId(0), "/points2"), [1]);
    }

    #[test]
    fn names_and_globs_are_found_in_the_order_of_the_list() {
        let next = watchlist(&["/b", "/c/d", "/**", "/e", "/c/*"]);
        for (topic, places) in [
            ("/a", &[2][..]),
            ("/b", &[0, 2]),
            ("/c/d", &[1, 2, 4]),
            ("/**", &[2]),
        ] {
            assert_eq!(next.matching(DomainId(0), topic), places, "{topic}");
        }
        assert_eq!(next.position("/e", None), Some(3));
        assert_eq!(next.position("/e", Some(DomainId(0))), None);
        assert_eq!(next.position("/a", None), None);
    }

    #[test]
    fn too_many_or_too_long_globs_are_refused() {
        let full_of_stars = format!("/{}", "*a".repeat(120));
        assert_eq!(check_pattern(&full_of_stars), Err(PatternError::ManyStars));
        let names = (0..5000).map(|number| format!("/topic_{number}"));
        let names: Vec<_> = names.map(|name| Watch::named(&name).unwrap()).collect();
        assert!(Watchlist::new(names).is_ok());
        let globs = |count: usize, length: usize| {
            let glob = |number| format!("/{}_{number}/*", "a".repeat(length));
            let globs = (0..count).map(|number| Watch::named(&glob(number)).unwrap());
            Watchlist::new(globs.collect())
        };
        assert!(globs(MAX_GLOBS, 10).is_ok());
        assert_eq!(globs(MAX_GLOBS + 1, 10).unwrap_err().count, MAX_GLOBS + 1);
        assert!(globs(100, 240).unwrap_err().bytes > MAX_GLOB_BYTES);
    }

    #[test]
    fn an_entry_with_a_domain_covers_only_that_domain() {
        let watch = Watch {
            domain_id: Some(DomainId(5)),
            ..Watch::named("/points").unwrap()
        };
        let list = Watchlist::new(vec![watch]).unwrap();
        assert_eq!(list.matching(DomainId(5), "/points"), [0]);
        assert!(list.matching(DomainId(0), "/points").is_empty());
    }

    #[test]
    fn hostile_topic_names_do_not_panic() {
        let list = watchlist(&["/**", "/a/*/b"]);
        for name in [
            "",
            "/",
            "/a//b",
            "/a/\n/b",
            "[",
            "/\u{1F916}",
            &"/x".repeat(5000),
        ] {
            let _ = list.matching(DomainId(0), name);
        }
    }

    #[test]
    fn names_that_no_ros_topic_can_have_are_refused() {
        for (pattern, error) in [
            ("", PatternError::Empty),
            ("points", PatternError::NoSlash),
            ("~/points", PatternError::NoSlash),
            ("/", PatternError::EmptyToken),
            ("/a//b", PatternError::EmptyToken),
            ("/a/", PatternError::EmptyToken),
            ("/2d", PatternError::Digit),
            ("/a**", PatternError::Stars),
            ("/a b", PatternError::Character(' ')),
            ("/{a,b}", PatternError::Character('{')),
        ] {
            assert_eq!(check_pattern(pattern), Err(error), "{pattern}");
        }
        for pattern in ["/points", "/**", "/*", "/_hidden", "/a/**/b", "/cam*/raw"] {
            assert_eq!(check_pattern(pattern), Ok(()), "{pattern}");
        }
    }

    #[test]
    fn thresholds_keep_their_values_in_every_unit() {
        for (max_latency_ms, max_silence_s) in
            [(50.0, 1.0), (0.1, 2.3), (7.7, 604_800.0), (0.0, 0.001)]
        {
            let values = ExpectationValues {
                max_latency_ms: Some(max_latency_ms),
                max_silence_s: Some(max_silence_s),
                ..ExpectationValues::default()
            };
            assert_eq!(Expectations::try_from(values).unwrap().values(), values);
        }
        for wrong in [-0.1, f64::NAN, f64::INFINITY, 3_600_000.1] {
            let values = ExpectationValues {
                max_latency_ms: Some(wrong),
                ..ExpectationValues::default()
            };
            assert!(Expectations::try_from(values).is_err(), "{wrong}");
        }
    }
}
