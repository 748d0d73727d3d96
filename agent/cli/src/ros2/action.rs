//! `ros2 action`: `list` and `info`; `type` and `find` are those of topics. As in ros2cli, an
//! action exists if its feedback topic exists.

use std::borrow::Cow;
use std::fmt::Write as _;

use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::names::TopicName;
use ros2probe_api::nodes::Named;
use ros2probe_api::topics::Topic;

/// Suffix of the feedback topic's name.
const FEEDBACK_TOPIC_SUFFIX: &str = "/_action/feedback";
/// Suffix of the feedback topic's type.
const FEEDBACK_TYPE_SUFFIX: &str = "_FeedbackMessage";

/// Returns the name of an action's feedback topic.
#[must_use]
pub fn feedback_of(name: &str) -> String {
    format!("{name}{FEEDBACK_TOPIC_SUFFIX}")
}

/// Returns the actions among topics, including hidden ones.
pub fn of_topics(topics: &[TopicName<'_>]) -> impl Iterator<Item = Named<'static>> {
    let actions = topics.iter();
    actions.filter_map(|topic| of_name(&topic.name, &topic.types))
}

/// Returns the actions whose feedback topics are among a node's topics.
pub(super) fn of_feedback(topics: &[Named<'_>]) -> Vec<Named<'static>> {
    let actions = topics.iter();
    actions
        .filter_map(|topic| of_name(&topic.name, &topic.types))
        .collect()
}

fn of_name(name: &str, types: &[Cow<'_, str>]) -> Option<Named<'static>> {
    let name = name.strip_suffix(FEEDBACK_TOPIC_SUFFIX)?.to_owned();
    let types = types
        .iter()
        .filter_map(|each| each.strip_suffix(FEEDBACK_TYPE_SUFFIX));
    let types: Vec<_> = types.map(|each| Cow::Owned(each.to_owned())).collect();
    (!types.is_empty()).then_some(Named { name, types })
}

/// Returns the text of `action list`.
#[must_use]
pub fn list<'a>(actions: impl Iterator<Item = Named<'a>>, show_types: bool, count: bool) -> String {
    if count {
        return format!("{}\n", actions.count());
    }
    let mut text = String::new();
    for action in actions {
        let _ = if show_types {
            writeln!(text, "{} [{}]", action.name, action.types.join(", "))
        } else {
            writeln!(text, "{}", action.name)
        };
    }
    text
}

/// Returns the text of `action info`, from the feedback topic if it exists.
#[must_use]
pub fn info(name: &str, feedback: Option<&Topic<'_>>, show_types: bool, count: bool) -> String {
    let mut text = format!("Action: {name}\n");
    let ends: [(&str, &[Endpoint<'_>]); 2] = match feedback {
        Some(topic) => [
            ("clients", &topic.subscriptions),
            ("servers", &topic.publishers),
        ],
        None => [("clients", &[]), ("servers", &[])],
    };
    for (title, endpoints) in ends {
        let nodes = nodes(endpoints);
        let _ = writeln!(text, "Action {title}: {}", nodes.len());
        if count {
            continue;
        }
        for (node, types) in nodes {
            let _ = if show_types {
                writeln!(text, "    {node} [{}]", types.join(", "))
            } else {
                writeln!(text, "    {node}")
            };
        }
    }
    text
}

/// Returns each node once with its types, in the order of GIDs. As in ros2cli, endpoints without a
/// node are left out.
fn nodes<'a>(endpoints: &'a [Endpoint<'_>]) -> Vec<(&'a str, Vec<&'a str>)> {
    let mut endpoints: Vec<_> = endpoints.iter().collect();
    endpoints.sort_unstable_by_key(|endpoint| &endpoint.guid);
    let mut nodes: Vec<(&str, Vec<&str>)> = Vec::new();
    for endpoint in endpoints {
        let (Some(node), Some(kind)) = (
            endpoint.node.as_deref(),
            endpoint.message_type.strip_suffix(FEEDBACK_TYPE_SUFFIX),
        ) else {
            continue;
        };
        match nodes.iter_mut().find(|(name, _)| *name == node) {
            Some((_, types)) if types.contains(&kind) => {}
            Some((_, types)) => types.push(kind),
            None => nodes.push((node, vec![kind])),
        }
    }
    nodes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &'static str, kind: &'static str) -> TopicName<'static> {
        TopicName {
            name: name.into(),
            types: vec![kind.into()],
            ..TopicName::default()
        }
    }

    fn actions() -> impl Iterator<Item = Named<'static>> {
        of_topics(&[
            topic("/chatter", "std_msgs/msg/String"),
            topic("/fib/_action/feedback", "a/action/Fib_FeedbackMessage"),
            topic("/fib/_action/status", "action_msgs/msg/GoalStatusArray"),
            topic("/not/_action/feedback", "a/msg/Other"),
        ])
        .collect::<Vec<_>>()
        .into_iter()
    }

    #[test]
    fn a_feedback_topic_is_listed_as_an_action() {
        assert_eq!(list(actions(), false, false), "/fib\n");
        assert_eq!(list(actions(), true, false), "/fib [a/action/Fib]\n");
        assert_eq!(list(actions(), true, true), "1\n");
    }

    #[test]
    fn info_lists_each_node_once_with_its_namespace() {
        let end = |guid: &str, node: Option<&'static str>| Endpoint {
            guid: guid.to_owned(),
            node: node.map(Cow::Borrowed),
            message_type: "a/action/Fib_FeedbackMessage".into(),
            ..Endpoint::default()
        };
        let feedback = Topic {
            name: feedback_of("/fib").into(),
            publishers: vec![end("02", Some("/robot1/server"))],
            subscriptions: vec![
                end("04", None),
                end("03", Some("/b")),
                end("01", Some("/a/a")),
                end("05", Some("/b")),
            ],
            ..Topic::default()
        };
        let printed = |types, count| info("/fib", Some(&feedback), types, count);
        assert_eq!(
            printed(false, false),
            "Action: /fib\nAction clients: 2\n    /a/a\n    /b\nAction servers: 1\n    \
             /robot1/server\n"
        );
        assert!(printed(true, false).ends_with("    /robot1/server [a/action/Fib]\n"));
        let counts = "Action: /fib\nAction clients: 2\nAction servers: 1\n";
        assert_eq!(printed(true, true), counts);
        let none = "Action: /nope\nAction clients: 0\nAction servers: 0\n";
        assert_eq!(info("/nope", None, false, false), none);
    }
}
