//! `ros2 topic`: list.

use std::fmt::Write as _;

use super::facts::TopicName;

/// Options of `topic list`.
#[derive(Clone, Copy, Debug, Default)]
pub struct List {
    /// With types.
    pub show_types: bool,
    /// Only how many.
    pub count: bool,
    /// By publishers and subscribers.
    pub verbose: bool,
}

/// `topic list`, of those topics that are to be shown.
#[must_use]
pub fn list<'a>(topics: impl Iterator<Item = &'a TopicName>, options: List) -> String {
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

fn section<'a>(
    text: &mut String,
    title: &str,
    end: &str,
    topics: impl Iterator<Item = (&'a TopicName, usize)>,
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

    fn topics() -> Vec<TopicName> {
        let topic = |name: &str, publishers, subscriptions| TopicName {
            name: name.to_owned(),
            types: vec!["std_msgs/msg/String".to_owned()],
            publishers,
            subscriptions,
            ..TopicName::default()
        };
        vec![topic("/chatter", 1, 1), topic("/rosout", 2, 0)]
    }

    #[test]
    fn a_list_is_names_and_counting_wins() {
        let said = |show_types, count, verbose| {
            let options = List {
                show_types,
                count,
                verbose,
            };
            list(topics().iter(), options)
        };
        assert_eq!(said(false, false, false), "/chatter\n/rosout\n");
        assert_eq!(
            said(true, false, false),
            "/chatter [std_msgs/msg/String]\n/rosout [std_msgs/msg/String]\n"
        );
        assert_eq!(said(true, true, true), "2\n");
        let verbose = "Published topics:\n * /chatter [std_msgs/msg/String] 1 publisher\n \
            * /rosout [std_msgs/msg/String] 2 publishers\n\nSubscribed topics:\n \
            * /chatter [std_msgs/msg/String] 1 subscriber\n\n";
        assert_eq!(said(false, false, true), verbose);
        assert_eq!(list([].iter(), List::default()), "");
    }
}
