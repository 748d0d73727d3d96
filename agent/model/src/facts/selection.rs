//! Topics whose samples a subscription requests, and how much of each sample it receives.
//!
//! A selection is matched against topics as they appear. It affects measurement only in that
//! requested topics are measured; the watchlist has its own patterns.

use std::collections::BTreeSet;
use std::sync::Arc;

use regex::bytes::{Regex, RegexBuilder};
use ros2probe_wire::DomainId;

use crate::facts::glob;
use crate::facts::names::DdsName;
use crate::facts::naming::Naming;
use crate::facts::topic_kind::TopicKind;
use crate::facts::watch::{PatternError, check_pattern};

/// Maximum compiled size of a regular expression in bytes. Matching may use the same amount again.
const REGEX_BYTES: usize = 256 << 10;

/// Domain and DDS name, which identify a topic.
pub type TopicKey = (DomainId, DdsName);

/// How much of each sample a subscription receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Depth {
    /// Arrival and metadata.
    Arrivals,
    /// Arrival, metadata and payload.
    Payloads,
}

/// A criterion that selects topics.
#[derive(Clone, Debug)]
pub enum Choice {
    /// Every topic that `ros2 topic list` shows.
    All,
    /// One topic by its ROS name, even if hidden, or by its DDS name.
    Name(String),
    /// Topics by their domains and DDS names, possibly thousands.
    Topics(BTreeSet<TopicKey>),
    /// `*` within a token, `**` across tokens; covers hidden topics if it names a hidden token.
    Glob(String),
    /// Every topic with a match in its name.
    Regex(Regex),
}

/// Why a choice is invalid.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceError {
    /// The text is neither a name nor a glob.
    #[error("`{pattern}` {reason}")]
    Pattern {
        /// The text.
        pattern: String,
        /// The broken rule.
        reason: PatternError,
    },
    /// The text is not a regular expression, or its compiled form is too large.
    #[error("`{pattern}` is not a supported regular expression")]
    Regex {
        /// The text.
        pattern: String,
        /// The error of the compiler.
        source: Box<regex::Error>,
    },
}

/// A set of topics, as included and excluded choices.
#[derive(Clone, Debug, Default)]
pub struct Selection {
    /// Choices of which at least one must match.
    pub include: Vec<Choice>,
    /// Choices of which none may match.
    pub exclude: Vec<Choice>,
    /// Whether [`Choice::All`], globs and regular expressions include hidden topics.
    pub hidden: bool,
}

/// Facts about a topic on which a selection depends.
#[derive(Clone, Copy, Debug)]
pub struct Candidate<'a> {
    /// Domain.
    pub domain_id: DomainId,
    /// Role of the topic in ROS.
    pub kind: TopicKind,
    /// ROS name, or the DDS name if it follows no ROS convention.
    pub name: &'a str,
    /// DDS name.
    pub dds_name: &'a DdsName,
    /// Whether the topic is hidden by ROS convention.
    pub hidden: bool,
}

/// A subscription of samples.
#[derive(Clone, Debug)]
pub struct SampleRequest {
    /// Id of the subscription.
    pub id: u64,
    /// The selected topics.
    pub selection: Arc<Selection>,
    /// The selected domain; `None` for every domain.
    pub domain_id: Option<DomainId>,
    /// How much of each sample it receives.
    pub depth: Depth,
}

/// The requests for one topic's samples.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RequestIds {
    /// Ids of all requests.
    pub ids: Arc<[u64]>,
    /// Ids of the requests that include payloads.
    pub payloads: Arc<[u64]>,
}

impl Choice {
    /// Parses a name, or a glob if the text contains a star.
    ///
    /// # Errors
    /// Fails if the text is neither.
    pub fn parse(pattern: &str) -> Result<Self, ChoiceError> {
        let is_dds = !pattern.is_empty() && !pattern.starts_with('/') && pattern.len() <= 255;
        if is_dds && !pattern.contains('*') {
            return Ok(Self::Name(pattern.to_owned()));
        }
        check_pattern(pattern).map_err(|reason| ChoiceError::Pattern {
            pattern: pattern.to_owned(),
            reason,
        })?;
        if !pattern.contains('*') {
            return Ok(Self::Name(pattern.to_owned()));
        }
        Ok(Self::Glob(pattern.to_owned()))
    }

    /// Parses a regular expression, which may match any part of a name.
    ///
    /// # Errors
    /// Fails if the text is not a regular expression, or is too large.
    pub fn regex(pattern: &str) -> Result<Self, ChoiceError> {
        let regex = expression(pattern).map_err(|source| ChoiceError::Regex {
            pattern: pattern.to_owned(),
            source: Box::new(source),
        })?;
        Ok(Self::Regex(regex))
    }

    fn covers(&self, topic: &Candidate<'_>, hidden: bool) -> bool {
        let (is_ros, dds_name) = (topic.kind.is_ros_topic(), topic.dds_name);
        // A request topic has the ROS name of its service, which an ordinary topic may have as
        // well.
        let name = if is_ros {
            topic.name
        } else {
            dds_name.as_str()
        };
        match self {
            Self::Name(wanted) => wanted == name || *wanted == **dds_name,
            Self::Topics(wanted) => wanted.contains(&(topic.domain_id, dds_name.clone())),
            _ if !is_ros => false,
            Self::All => hidden,
            Self::Glob(glob) => (hidden || glob.contains("/_")) && glob::covers(glob, name),
            Self::Regex(regex) => hidden && regex.is_match(name.as_bytes()),
        }
    }
}

/// Compiles a regular expression over topic names. Names are ASCII, and so are the classes `\w`,
/// `\d` and `\s`.
///
/// # Errors
/// Fails if the text is not a regular expression, or is too large.
pub fn expression(pattern: &str) -> Result<Regex, regex::Error> {
    RegexBuilder::new(pattern)
        .unicode(false)
        .size_limit(REGEX_BYTES)
        .dfa_size_limit(REGEX_BYTES)
        .build()
}

impl Selection {
    /// Parses names and globs.
    ///
    /// # Errors
    /// Returns the error of the first text that is neither.
    pub fn named<'a>(patterns: impl IntoIterator<Item = &'a str>) -> Result<Self, ChoiceError> {
        let include: Result<_, _> = patterns.into_iter().map(Choice::parse).collect();
        Ok(Self {
            include: include?,
            ..Self::default()
        })
    }

    /// Selects every topic that `ros2 topic list` shows.
    #[must_use]
    pub fn all() -> Self {
        Self {
            include: vec![Choice::All],
            ..Self::default()
        }
    }

    /// Returns whether the selection has patterns, which may cover further topics.
    #[must_use]
    pub fn is_open(&self) -> bool {
        let by_name = |choice: &Choice| matches!(choice, Choice::Name(_) | Choice::Topics(_));
        !self.include.iter().all(by_name)
    }

    /// Selects topics by their domains and DDS names.
    #[must_use]
    pub fn of_topics(topics: impl IntoIterator<Item = TopicKey>) -> Self {
        Self {
            include: vec![Choice::Topics(topics.into_iter().collect())],
            ..Self::default()
        }
    }

    /// Returns the globs.
    pub fn globs(&self) -> impl Iterator<Item = &str> {
        let choices = self.include.iter().chain(&self.exclude);
        choices.filter_map(|choice| match choice {
            Choice::Glob(glob) => Some(glob.as_str()),
            _ => None,
        })
    }

    /// Returns the number of regular expressions.
    #[must_use]
    pub fn regexes(&self) -> usize {
        let choices = self.include.iter().chain(&self.exclude);
        choices
            .filter(|choice| matches!(choice, Choice::Regex(_)))
            .count()
    }

    /// Returns whether the topic is selected. Service requests and replies, and topics without a
    /// ROS name, are selected only by their exact names.
    #[must_use]
    pub fn covers(&self, topic: &Candidate<'_>) -> bool {
        let shown = self.hidden || !topic.hidden;
        let covers = |choice: &Choice| choice.covers(topic, shown);
        let named = |choice: &Choice| choice.covers(topic, true);
        self.include.iter().any(covers) && !self.exclude.iter().any(named)
    }
}

impl SampleRequest {
    /// Returns whether the request covers this topic.
    #[must_use]
    pub fn covers(&self, domain_id: DomainId, naming: &Naming) -> bool {
        let topic = Candidate {
            domain_id,
            kind: naming.kind,
            name: &naming.name,
            dds_name: &naming.dds_name,
            hidden: naming.hidden,
        };
        self.domain_id.is_none_or(|wanted| wanted == domain_id) && self.selection.covers(&topic)
    }
}

impl RequestIds {
    /// Returns the requests that cover this topic, or `None` if no request does.
    pub(crate) fn of(
        domain_id: DomainId,
        naming: &Naming,
        sample_requests: &[SampleRequest],
    ) -> Option<Self> {
        let covering = sample_requests
            .iter()
            .filter(|request| request.covers(domain_id, naming));
        let covering: Vec<_> = covering.collect();
        let of_depth = |depth| {
            let deep = covering
                .iter()
                .filter(move |request| request.depth >= depth);
            deep.map(|request| request.id).collect()
        };
        (!covering.is_empty()).then(|| Self {
            ids: of_depth(Depth::Arrivals),
            payloads: of_depth(Depth::Payloads),
        })
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::names::DdsTopic;

    use super::*;

    fn covers(selection: &Selection, dds_name: &str) -> bool {
        let naming = Naming::of(&DdsTopic::parse(dds_name).unwrap());
        let request = SampleRequest {
            id: 1,
            selection: Arc::new(selection.clone()),
            domain_id: Some(DomainId(3)),
            depth: Depth::Arrivals,
        };
        assert!(!request.covers(DomainId(4), &naming));
        request.covers(DomainId(3), &naming)
    }

    #[test]
    fn names_select_hidden_topics_and_patterns_only_on_request() {
        let exact = Selection::named(["/add/_service_event", "/points"]).unwrap();
        assert!(covers(&exact, "rt/add/_service_event") && covers(&exact, "rt/points"));
        assert!(!covers(&exact, "rt/points2"));
        let hidden = Selection {
            hidden: true,
            ..Selection::all()
        };
        assert!(covers(&hidden, "rt/fib/_action/feedback"));
        assert!(!covers(&Selection::all(), "rt/fib/_action/feedback"));
        assert!(covers(&Selection::all(), "rt/robot1/points"));
        let glob = Selection::named(["/robot1/**", "/**/_action/feedback"]).unwrap();
        assert!(covers(&glob, "rt/robot1/lidar/points") && !covers(&glob, "rt/robot2/points"));
        assert!(covers(&glob, "rt/fib/_action/feedback"));
        assert!(!covers(&glob, "rt/robot1/_hidden"));
        let regex = Selection {
            include: vec![Choice::regex("camera|lidar").unwrap()],
            exclude: vec![Choice::parse("/**/info").unwrap()],
            hidden: false,
        };
        assert!(covers(&regex, "rt/front_camera/image"));
        assert!(!covers(&regex, "rt/front_camera/info") && !covers(&regex, "rt/front/_lidar"));
    }

    #[test]
    fn services_and_non_ros_topics_are_selected_only_by_exact_name() {
        for dds_name in [
            "rq/addRequest",
            "rr/addReply",
            "ros_discovery_info",
            "Square",
        ] {
            let everything = Selection {
                include: vec![Choice::All, Choice::regex(".").unwrap()],
                hidden: true,
                ..Selection::default()
            };
            assert!(!covers(&everything, dds_name), "{dds_name}");
            assert!(covers(&Selection::named([dds_name]).unwrap(), dds_name));
            let of_domain = |domain_id| {
                let names = ["rt/points", dds_name].map(DdsName::from);
                Selection::of_topics(names.map(|name| (DomainId(domain_id), name)))
            };
            assert!(covers(&of_domain(3), dds_name));
            assert!(!covers(&of_domain(3), "rt/add"));
            assert!(!covers(&of_domain(4), dds_name));
        }
        assert!(!covers(
            &Selection::named(["/add"]).unwrap(),
            "rq/addRequest"
        ));
    }

    #[test]
    fn invalid_patterns_are_refused() {
        for pattern in ["", "/", "/a//b", "/**x", "a*"] {
            assert!(Choice::parse(pattern).is_err(), "{pattern}");
        }
        assert!(Choice::regex("(").is_err());
        assert!(Choice::regex("((a{100}){100}){100}").is_err());
    }

    #[test]
    fn a_regular_expression_that_takes_too_many_bytes_is_refused() {
        assert!(expression("/camera_[0-9]{1,8}/.*").is_ok());
        assert!(matches!(
            expression("(/[a-z]{1,100}){1,100}"),
            Err(regex::Error::CompiledTooBig(REGEX_BYTES))
        ));
    }
}
