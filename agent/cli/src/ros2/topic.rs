//! `ros2 topic`: `list`, `info`, `type` and `find`.

use std::borrow::Cow;
use std::fmt::Write as _;

use ros2probe_api::names::TopicName;
use ros2probe_api::topics::Topic;

use super::{Dialect, Refused, endpoint};

/// Options of `topic list`.
#[derive(Clone, Copy, Debug, Default)]
pub struct List {
    /// Whether types are printed.
    pub show_types: bool,
    /// Whether only the number of topics is printed.
    pub count: bool,
    /// Whether topics are grouped by publishers and subscribers.
    pub verbose: bool,
}

/// Returns the text of `topic list` for these topics.
#[must_use]
pub fn list<'a>(topics: impl Iterator<Item = &'a TopicName<'a>>, options: List) -> String {
    let mut text = String::new();
    if options.count {
        let _ = writeln!(text, "{}", topics.count());
        return text;
    }
    if options.verbose {
        let topics: Vec<_> = topics.collect();
        let published = topics.iter().map(|topic| (*topic, topic.publishers));
        section(&mut text, "Published topics:", "publisher", published);
        let subscribed = topics.iter().map(|topic| (*topic, topic.subscriptions));
        section(&mut text, "Subscribed topics:", "subscriber", subscribed);
        return text;
    }
    for topic in topics {
        if options.show_types {
            let _ = writeln!(text, "{} [{}]", topic.name, topic.types.join(", "));
        } else {
            let _ = writeln!(text, "{}", topic.name);
        }
    }
    text
}

/// Returns the text of `topic info`. Pass `None` as `topic` if it does not exist.
///
/// # Errors
///
/// Fails if the topic does not exist.
pub fn info(
    name: &str,
    topic: Option<&Topic<'_>>,
    verbose: bool,
    dialect: Dialect,
) -> Result<String, Refused> {
    let there = topic.filter(|topic| {
        topic.name == name && !(topic.publishers.is_empty() && topic.subscriptions.is_empty())
    });
    let topic = there.ok_or_else(|| Refused(format!("Unknown topic '{name}'")))?;
    let end = if verbose { "\n\n" } else { "\n" };
    let mut text = format!("Type: {}{end}", types(&topic.message_types));
    for (count, kind, endpoints) in [
        ("Publisher count", "PUBLISHER", &topic.publishers),
        ("Subscription count", "SUBSCRIPTION", &topic.subscriptions),
    ] {
        let _ = write!(text, "{count}: {}{end}", endpoints.len());
        if verbose {
            let mut endpoints: Vec<_> = endpoints.iter().collect();
            endpoints.sort_unstable_by_key(|endpoint| &endpoint.guid);
            for endpoint in endpoints {
                text.push_str(&endpoint::block(endpoint, kind, dialect));
                text.push('\n');
            }
        }
    }
    Ok(text)
}

/// Returns one type as it is, and several as a Python list.
fn types(types: &[Cow<'_, str>]) -> String {
    match types {
        [only] => only.to_string(),
        several => format!("['{}']", several.join("', '")),
    }
}

/// Returns the text of `topic type`, `service type` and `action type`, one type per line. Returns
/// `None` if the name is unknown, which only the exit code reports.
#[must_use]
pub fn type_of<'a>(
    name: &str,
    mut all: impl Iterator<Item = (&'a str, &'a [Cow<'a, str>])>,
) -> Option<String> {
    let (_, types) = all.find(|(each, _)| *each == name)?;
    Some(types.iter().map(|each| format!("{each}\n")).collect())
}

/// Returns the text of `topic find`, `service find` and `action find`: one name per line, or their
/// number.
#[must_use]
pub fn find<'a>(
    wanted: &str,
    all: impl Iterator<Item = (&'a str, &'a [Cow<'a, str>])>,
    count: bool,
) -> String {
    let found = all.filter(|(_, types)| types.iter().any(|each| each == wanted));
    if count {
        return format!("{}\n", found.count());
    }
    found.map(|(name, _)| format!("{name}\n")).collect()
}

fn section<'a>(
    text: &mut String,
    title: &str,
    end: &str,
    topics: impl Iterator<Item = (&'a TopicName<'a>, usize)>,
) {
    let _ = writeln!(text, "{title}");
    for (topic, count) in topics.filter(|(_, count)| *count > 0) {
        let (name, types) = (&topic.name, topic.types.join(", "));
        let plural = if count > 1 { "s" } else { "" };
        let _ = writeln!(text, " * {name} [{types}] {count} {end}{plural}");
    }
    text.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::endpoints::Endpoint;

    fn topics() -> Vec<TopicName<'static>> {
        let topic = |name: &'static str, publishers, subscriptions| TopicName {
            name: name.into(),
            types: vec!["std_msgs/msg/String".into()],
            publishers,
            subscriptions,
            ..TopicName::default()
        };
        vec![topic("/chatter", 1, 1), topic("/rosout", 2, 0)]
    }

    #[test]
    fn a_list_prints_names_and_a_count_overrides_other_options() {
        let printed = |show_types, count, verbose| {
            let options = List {
                show_types,
                count,
                verbose,
            };
            list(topics().iter(), options)
        };
        assert_eq!(printed(false, false, false), "/chatter\n/rosout\n");
        assert_eq!(
            printed(true, false, false),
            "/chatter [std_msgs/msg/String]\n/rosout [std_msgs/msg/String]\n"
        );
        assert_eq!(printed(true, true, true), "2\n");
        let verbose = "Published topics:\n * /chatter [std_msgs/msg/String] 1 publisher\n \
            * /rosout [std_msgs/msg/String] 2 publishers\n\nSubscribed topics:\n \
            * /chatter [std_msgs/msg/String] 1 subscriber\n\n";
        assert_eq!(printed(false, false, true), verbose);
        assert_eq!(list([].iter(), List::default()), "");
    }

    fn topic(types: &[&'static str]) -> Topic<'static> {
        Topic {
            name: "/chatter".into(),
            message_types: types.iter().map(|each| Cow::Borrowed(*each)).collect(),
            publishers: ["02.03", "01.03"].map(endpoint_of).into(),
            ..Topic::default()
        }
    }

    fn endpoint_of(guid: &str) -> Endpoint<'static> {
        Endpoint {
            guid: guid.to_owned(),
            ..Default::default()
        }
    }

    #[test]
    fn info_prints_counts_and_verbose_info_prints_endpoints_by_gid() {
        let topic = topic(&["std_msgs/msg/String"]);
        let printed = |verbose| info("/chatter", Some(&topic), verbose, Dialect::Jazzy).unwrap();
        assert_eq!(
            printed(false),
            "Type: std_msgs/msg/String\nPublisher count: 2\nSubscription count: 0\n"
        );
        let verbose = printed(true);
        let head = "Type: std_msgs/msg/String\n\nPublisher count: 2\n\nNode name: _CREATED_BY_";
        assert!(verbose.starts_with(head), "{verbose}");
        assert!(
            verbose.ends_with("Infinite\n\nSubscription count: 0\n\n"),
            "{verbose}"
        );
        assert!(
            verbose.find("GID: 01.03\n") < verbose.find("GID: 02.03\n"),
            "{verbose}"
        );
    }

    #[test]
    fn several_types_are_printed_as_a_python_list() {
        let topic = topic(&["a/msg/X", "b/msg/Y"]);
        let printed = info("/chatter", Some(&topic), false, Dialect::Humble).unwrap();
        assert!(
            printed.starts_with("Type: ['a/msg/X', 'b/msg/Y']\n"),
            "{printed}"
        );
    }

    #[test]
    fn a_topic_without_endpoints_or_without_its_full_name_is_unknown() {
        let gone = Topic {
            publishers: Vec::new(),
            ..topic(&["a/msg/X"])
        };
        for (name, found) in [
            ("/x", None),
            ("chatter", Some(&topic(&[]))),
            ("/chatter", Some(&gone)),
        ] {
            let refused = info(name, found, true, Dialect::Jazzy).unwrap_err();
            assert_eq!(refused.0, format!("Unknown topic '{name}'"));
        }
    }

    #[test]
    fn types_are_found_by_name_and_names_by_type() {
        let topics = topics();
        let all = || {
            topics
                .iter()
                .map(|topic| (topic.name.as_ref(), topic.types.as_slice()))
        };
        assert_eq!(type_of("/rosout", all()).unwrap(), "std_msgs/msg/String\n");
        assert_eq!(type_of("rosout", all()), None);
        assert_eq!(
            find("std_msgs/msg/String", all(), false),
            "/chatter\n/rosout\n"
        );
        assert_eq!(find("std_msgs/msg/String", all(), true), "2\n");
        assert_eq!(find("std_msgs/String", all(), false), "");
        assert_eq!(find("std_msgs/String", all(), true), "0\n");
    }
}
