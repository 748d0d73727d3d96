//! Selection of topics for a recording, with the options of `ros2 bag record`.
//!
//! The selection is evaluated again after each change of the graph, so that later topics are
//! included. Topics of service events belong to services, and options for topics do not apply to
//! them.

use std::collections::HashSet;

use regex::bytes::Regex;
use ros2probe_api::path::encoded;
use ros2probe_api::recordings::FilterOptions;

use crate::subscriptions::{Choice, ChoiceError, Selection};

/// Suffix of the name of a service's event topic.
const SERVICE_EVENT: &str = "/_service_event";
const EVERY_SERVICE_EVENT: &str = "/_service_event$";
/// Maximum length of each list of names, types or services in a selection.
const MAX_NAMES: usize = 1024;
/// Maximum length of a regular expression, in bytes.
const MAX_EXPRESSION: usize = 1024;

/// Facts about a topic that the selection uses.
#[derive(Clone, Copy, Debug)]
pub struct Candidate<'a> {
    /// ROS name.
    pub name: &'a str,
    /// Types announced on the topic.
    pub types: &'a [String],
    /// Whether it has a publisher.
    pub published: bool,
    /// Whether it has a subscriber.
    pub subscribed: bool,
}

/// Selection of topics, ready for use.
#[derive(Clone, Debug)]
pub struct Filter {
    options: FilterOptions,
    regex: Option<Regex>,
    exclude_regex: Option<Regex>,
    names_in_selection: Option<HashSet<String>>,
}

/// Why options are invalid.
#[derive(Debug, thiserror::Error)]
pub enum FilterError {
    /// No topic can ever match.
    #[error("no topics selected: name topics, pass a regular expression, or select all")]
    Nothing,
    /// A list is too long.
    #[error("more than {MAX_NAMES} names")]
    TooMany,
    /// A name lacks its leading slash or is invalid.
    #[error("`{0}` is not a topic or service name: it must begin with `/`")]
    Name(String),
    /// A regular expression is invalid.
    #[error("the regular expression `{expression}` cannot be used: {reason}")]
    Expression {
        /// The expression as given.
        expression: String,
        /// Error of the expression.
        reason: String,
    },
}

impl Filter {
    /// Checks the options.
    ///
    /// # Errors
    ///
    /// Fails if nothing could match, a list is too long, or an expression or a name is invalid.
    pub fn new(options: FilterOptions) -> Result<Self, FilterError> {
        let names = [
            &options.topics,
            &options.services,
            &options.exclude_topics,
            &options.exclude_services,
        ];
        let types = [&options.topic_types, &options.exclude_topic_types];
        if names
            .iter()
            .chain(&types)
            .any(|list| list.len() > MAX_NAMES)
        {
            return Err(FilterError::TooMany);
        }
        if let Some(wrong) = names.into_iter().flatten().find(|name| !is_absolute(name)) {
            return Err(FilterError::Name(wrong.clone()));
        }
        let something = options.all_topics
            || options.all_services
            || options.regex.is_some()
            || !options.topics.is_empty()
            || !options.topic_types.is_empty()
            || !options.services.is_empty();
        if !something {
            return Err(FilterError::Nothing);
        }
        let regex = options.regex.as_deref().map(expression).transpose()?;
        let exclude_regex = options
            .exclude_regex
            .as_deref()
            .map(expression)
            .transpose()?;
        Ok(Self {
            options,
            regex,
            exclude_regex,
            names_in_selection: None,
        })
    }

    /// Returns the options of the selection.
    #[must_use]
    pub const fn options(&self) -> &FilterOptions {
        &self.options
    }

    /// Returns the topics to subscribe to: all that [`Self::is_selected`] may accept, and a few
    /// others.
    ///
    /// # Errors
    ///
    /// Fails if a name is not valid for a topic.
    pub fn selection(&self) -> Result<Selection, ChoiceError> {
        let options = &self.options;
        let event = |service: &String| Choice::Name(format!("{service}{SERVICE_EVENT}"));
        let mut include = Vec::new();
        if options.all_topics || !options.topic_types.is_empty() {
            include.push(Choice::All);
        }
        if options.all_services || options.regex.is_some() {
            include.push(Choice::regex(EVERY_SERVICE_EVENT)?);
        }
        include.extend(options.services.iter().map(event));
        if let Some(regex) = &options.regex {
            include.push(Choice::regex(regex)?);
        }
        include.extend(options.topics.iter().cloned().map(Choice::Name));
        let mut exclude = Vec::new();
        if let Some(regex) = &options.exclude_regex {
            exclude.push(Choice::regex(regex)?);
        }
        exclude.extend(options.exclude_topics.iter().cloned().map(Choice::Name));
        exclude.extend(options.exclude_services.iter().map(event));
        Ok(Selection {
            include,
            exclude,
            // Event topics of services are hidden; `is_selected` excludes other hidden topics.
            hidden: options.include_hidden_topics
                || options.all_services
                || options.regex.is_some(),
        })
    }

    /// Returns [`Self::selection`] as a query of the API's `/samples`, with a queue of
    /// `queue_bytes`.
    #[must_use]
    pub fn query(&self, domain_id: u32, queue_bytes: u64) -> String {
        let options = &self.options;
        let event = |service: &String| format!("{service}{SERVICE_EVENT}");
        let list = |names: &[String], services: &[String]| {
            let names = names.iter().cloned().chain(services.iter().map(event));
            names.collect::<Vec<_>>().join(",")
        };
        let every_event = options.all_services || options.regex.is_some();
        let events = every_event.then(|| EVERY_SERVICE_EVENT.to_owned());
        let regex = options.regex.as_ref().map(|regex| format!("(?:{regex})"));
        let regex: Vec<String> = regex.into_iter().chain(events).collect();
        let all = options.all_topics || !options.topic_types.is_empty();
        let hidden = options.include_hidden_topics || every_event;
        let mut query = format!("domain_id={domain_id}&queue_bytes={queue_bytes}");
        query.push_str(&format!("&all={all}&hidden={hidden}"));
        let texts = [
            ("topic", list(&options.topics, &options.services)),
            ("regex", regex.join("|")),
            (
                "exclude",
                list(&options.exclude_topics, &options.exclude_services),
            ),
            (
                "exclude_regex",
                options.exclude_regex.clone().unwrap_or_default(),
            ),
        ];
        for (key, text) in texts.into_iter().filter(|(_, text)| !text.is_empty()) {
            query.push_str(&format!("&{key}={}", encoded(&text)));
        }
        query
    }

    /// Restricts the selection to these topics.
    #[must_use]
    pub fn restricted_to(self, names: &[String]) -> Self {
        Self {
            names_in_selection: Some(names.iter().cloned().collect()),
            ..self
        }
    }

    /// Returns whether `topic` is to be recorded.
    #[must_use]
    pub fn is_selected(&self, topic: &Candidate<'_>) -> bool {
        let options = &self.options;
        let found = |expression: &Option<Regex>, name: &str| {
            let expression = expression.as_ref();
            expression.is_some_and(|expression| expression.is_match(name.as_bytes()))
        };
        let only = self.names_in_selection.as_ref();
        if found(&self.exclude_regex, topic.name)
            || only.is_some_and(|only| !only.contains(topic.name))
        {
            return false;
        }
        if let Some(service) = topic.name.strip_suffix(SERVICE_EVENT) {
            let named = |list: &[String]| list.iter().any(|name| name == service);
            return !named(&options.exclude_services)
                && (options.all_services
                    || named(&options.services)
                    || found(&self.regex, service));
        }
        let named = |list: &[String]| list.iter().any(|name| name == topic.name);
        let typed = |list: &[String]| topic.types.iter().any(|each| list.contains(each));
        if named(&options.exclude_topics)
            || typed(&options.exclude_topic_types)
            || (options.ignore_leaf_topics && !topic.subscribed)
            || (!options.include_unpublished_topics && !topic.published)
        {
            return false;
        }
        // A hidden topic is selected by its exact name.
        named(&options.topics)
            || ((options.include_hidden_topics || !is_hidden(topic.name))
                && (options.all_topics
                    || typed(&options.topic_types)
                    || found(&self.regex, topic.name)))
    }
}

fn expression(text: &str) -> Result<Regex, FilterError> {
    let refuse = |reason: String| FilterError::Expression {
        expression: text.chars().take(80).collect(),
        reason,
    };
    if text.len() > MAX_EXPRESSION {
        return Err(refuse(format!("longer than {MAX_EXPRESSION} bytes")));
    }
    ros2probe_model::facts::selection::expression(text).map_err(|error| {
        let text = error.to_string();
        let last = text.lines().last().unwrap_or_default();
        refuse(last.trim_start_matches("error: ").to_owned())
    })
}

fn is_absolute(name: &str) -> bool {
    name.len() > 1 && name.starts_with('/') && !name.ends_with('/')
}

fn is_hidden(name: &str) -> bool {
    name.split('/').any(|token| token.starts_with('_'))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn takes(options: FilterOptions, name: &str) -> bool {
        let types = ["std_msgs/msg/String".to_owned()];
        Filter::new(options).unwrap().is_selected(&Candidate {
            name,
            types: &types,
            published: true,
            subscribed: true,
        })
    }

    fn strings(list: &[&str]) -> Vec<String> {
        list.iter().map(|&each| each.to_owned()).collect()
    }

    #[test]
    fn all_topics_excludes_hidden_topics_and_service_events() {
        let all = FilterOptions::everything();
        assert!(takes(all.clone(), "/chatter"));
        assert!(!takes(all.clone(), "/fibonacci/_action/feedback"));
        assert!(!takes(all.clone(), "/add/_service_event"));
        let hidden = FilterOptions {
            include_hidden_topics: true,
            ..all
        };
        assert!(takes(hidden.clone(), "/fibonacci/_action/feedback"));
        assert!(!takes(hidden, "/add/_service_event"));
    }

    #[test]
    fn a_hidden_topic_is_recorded_if_it_is_named() {
        let options = FilterOptions {
            topics: strings(&["/a/_hidden"]),
            ..FilterOptions::default()
        };
        assert!(takes(options.clone(), "/a/_hidden"));
        assert!(!takes(options, "/a"));
    }

    #[test]
    fn one_regular_expression_adds_topics_and_another_excludes_some() {
        let options = FilterOptions {
            topics: strings(&["/chatter"]),
            regex: Some("camera/.*".to_owned()),
            exclude_regex: Some("raw$|chat".to_owned()),
            ..FilterOptions::default()
        };
        assert!(takes(options.clone(), "/camera/info"));
        assert!(!takes(options.clone(), "/camera/raw"));
        assert!(!takes(options.clone(), "/chatter"));
        assert!(!takes(options, "/odom"));
    }

    #[test]
    fn services_are_selected_by_the_name_of_the_service() {
        let options = FilterOptions {
            services: strings(&["/add"]),
            ..FilterOptions::default()
        };
        assert!(takes(options.clone(), "/add/_service_event"));
        assert!(!takes(options, "/add"));
        let options = FilterOptions {
            all_services: true,
            exclude_services: strings(&["/add"]),
            ..FilterOptions::default()
        };
        assert!(takes(options.clone(), "/sub/_service_event"));
        assert!(!takes(options, "/add/_service_event"));
    }

    #[test]
    fn types_publishers_and_subscribers_decide_whether_a_topic_is_recorded() {
        let typed = FilterOptions {
            topic_types: strings(&["std_msgs/msg/String"]),
            ..FilterOptions::default()
        };
        assert!(takes(typed, "/chatter"));
        let excluded = FilterOptions {
            exclude_topic_types: strings(&["std_msgs/msg/String"]),
            ..FilterOptions::everything()
        };
        assert!(!takes(excluded, "/chatter"));
        let lonely = |options| {
            let topic = Candidate {
                name: "/chatter",
                types: &[],
                published: false,
                subscribed: false,
            };
            Filter::new(options).unwrap().is_selected(&topic)
        };
        assert!(!lonely(FilterOptions::everything()));
        let unpublished = FilterOptions {
            include_unpublished_topics: true,
            ..FilterOptions::everything()
        };
        assert!(lonely(unpublished.clone()));
        assert!(!lonely(FilterOptions {
            ignore_leaf_topics: true,
            ..unpublished
        }));
    }

    #[test]
    fn invalid_selections_are_refused_with_the_reason() {
        let error = |options| Filter::new(options).unwrap_err().to_string();
        assert!(error(FilterOptions::default()).starts_with("no topics selected"));
        let relative = FilterOptions {
            topics: strings(&["chatter"]),
            ..FilterOptions::default()
        };
        assert!(error(relative).contains("`chatter` is not a topic"));
        for wrong in ["(", r"(a)\1", "a{1000000}"] {
            let regex = Some(wrong.to_owned());
            let options = FilterOptions {
                regex,
                ..FilterOptions::default()
            };
            assert!(error(options).contains("cannot be used: "), "{wrong}");
        }
        let long = FilterOptions {
            regex: Some("a".repeat(MAX_EXPRESSION + 1)),
            ..FilterOptions::default()
        };
        assert!(error(long).ends_with("longer than 1024 bytes"));
    }

    #[test]
    fn the_query_of_the_api_covers_every_recorded_topic() {
        let options = FilterOptions {
            topics: strings(&["/a", "/b"]),
            services: strings(&["/add"]),
            regex: Some("^/c&d".to_owned()),
            exclude_topics: strings(&["/x"]),
            ..FilterOptions::default()
        };
        assert_eq!(
            Filter::new(options).unwrap().query(3, 100),
            "domain_id=3&queue_bytes=100&all=false&hidden=true\
             &topic=/a%2C/b%2C/add/_service_event\
             &regex=%28%3F%3A%5E/c%26d%29%7C/_service_event%24&exclude=/x"
        );
        let all = Filter::new(FilterOptions::everything()).unwrap();
        assert_eq!(
            all.query(0, 1),
            "domain_id=0&queue_bytes=1&all=true&hidden=false"
        );
        let only = all.restricted_to(&strings(&["/a"]));
        let takes = |name| {
            only.is_selected(&Candidate {
                name,
                types: &[],
                published: true,
                subscribed: true,
            })
        };
        assert!(takes("/a") && !takes("/b"));
    }
}
