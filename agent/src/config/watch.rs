//! What to watch and what to expect of it: plain data, already checked, and the matcher that tells
//! which entries cover a topic.

use globset::{GlobBuilder, GlobSet, GlobSetBuilder};

/// One watchlist entry.
#[derive(Clone, Debug, PartialEq)]
pub struct Watch {
    /// Exact ROS name (`/points`) or glob: `*` within one token, `**` across tokens.
    pub pattern: String,
    /// Only this domain; `None` = every domain.
    pub domain_id: Option<u32>,
    /// What should hold.
    pub expectations: Expectations,
    /// Series per delivery.
    pub per_subscriber: bool,
}

/// Limits on a topic; `None` = no opinion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expectations {
    /// At least this many messages a second.
    pub min_rate_hz: Option<f64>,
    /// At most this many messages a second.
    pub max_rate_hz: Option<f64>,
    /// Lost / (received + lost), 0 to 1.
    pub max_loss_ratio: Option<f64>,
    /// INFO_TS to capture, milliseconds.
    pub max_latency_ms: Option<f64>,
    /// Longest time without a message, seconds.
    pub max_silence_s: Option<f64>,
}

/// Why a topic name or glob cannot match anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PatternError {
    /// Nothing there.
    #[error("is empty")]
    Empty,
    /// Relative or private names mean nothing outside a node.
    #[error("must begin with a slash, as in `/points`")]
    NoSlash,
    /// `//` or a slash at the end.
    #[error("has a name token without letters")]
    EmptyToken,
    /// ROS forbids it.
    #[error("has a name token that begins with a digit, which ROS does not allow")]
    Digit,
    /// `**` stands for whole tokens.
    #[error("`**` must stand alone between slashes")]
    Stars,
    /// ROS names are made of ASCII letters, digits and `_`.
    #[error("has the character `{0}`: ROS names have letters, digits and `_`, globs also `*`")]
    Character(char),
    /// Longer than DDS allows.
    #[error("is longer than 255 characters")]
    Long,
}

impl Watch {
    /// Everything of this name in every domain, without expectations.
    ///
    /// # Errors
    /// When `pattern` is no ROS name or glob.
    pub fn named(pattern: &str) -> Result<Self, PatternError> {
        check_pattern(pattern)?;
        let pattern = pattern.to_owned();
        Ok(Self {
            pattern,
            domain_id: None,
            expectations: Expectations::default(),
            per_subscriber: false,
        })
    }

    /// Names one topic rather than a family.
    #[must_use]
    pub fn is_literal(&self) -> bool {
        !self.pattern.contains('*')
    }
}

impl Expectations {
    /// `(key, is it set)` for each.
    #[must_use]
    pub const fn keys(&self) -> [(&'static str, bool); 5] {
        [
            ("min_rate_hz", self.min_rate_hz.is_some()),
            ("max_rate_hz", self.max_rate_hz.is_some()),
            ("max_loss_ratio", self.max_loss_ratio.is_some()),
            ("max_latency_ms", self.max_latency_ms.is_some()),
            ("max_silence_s", self.max_silence_s.is_some()),
        ]
    }
}

/// Says whether `pattern` can be a ROS topic name or a glob over such names.
///
/// # Errors
/// The first rule it breaks.
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

/// A watchlist, ready to be asked.
#[derive(Clone, Debug, Default)]
pub struct Watchlist {
    watches: Vec<Watch>,
    globs: GlobSet,
}

impl Watchlist {
    /// Prepares `watches`, keeping their order.
    ///
    /// # Errors
    /// When a pattern is no glob; patterns that passed [`check_pattern`] always are.
    pub fn new(watches: Vec<Watch>) -> Result<Self, globset::Error> {
        let mut globs = GlobSetBuilder::new();
        for watch in &watches {
            globs.add(
                GlobBuilder::new(&watch.pattern)
                    .literal_separator(true)
                    .build()?,
            );
        }
        let globs = globs.build()?;
        Ok(Self { watches, globs })
    }

    /// The entries, in configuration order.
    #[must_use]
    pub fn watches(&self) -> &[Watch] {
        &self.watches
    }

    /// The entries that cover this topic, as indices into [`Self::watches`].
    #[must_use]
    pub fn matching(&self, domain_id: u32, topic: &str) -> Vec<usize> {
        let mut matching = self.globs.matches(topic);
        matching.retain(|index| {
            let wanted = self.watches.get(*index).and_then(|watch| watch.domain_id);
            wanted.is_none_or(|wanted| wanted == domain_id)
        });
        matching
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
    fn one_star_stays_within_its_token_and_two_cross_them() {
        let list = watchlist(&["/camera/*/image_raw", "/**", "/points", "/camera/**"]);
        assert_eq!(list.matching(0, "/camera/left/image_raw"), [0, 1, 3]);
        assert_eq!(list.matching(0, "/camera/left/up/image_raw"), [1, 3]);
        assert_eq!(list.matching(0, "/points"), [1, 2]);
        assert_eq!(list.matching(0, "/points2"), [1]);
    }

    #[test]
    fn a_domain_narrows_an_entry() {
        let watch = Watch {
            domain_id: Some(5),
            ..Watch::named("/points").unwrap()
        };
        let list = Watchlist::new(vec![watch]).unwrap();
        assert_eq!(list.matching(5, "/points"), [0]);
        assert!(list.matching(0, "/points").is_empty());
    }

    #[test]
    fn hostile_topic_names_match_or_not_but_never_fail() {
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
            let _ = list.matching(0, name);
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
}
