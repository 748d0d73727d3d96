//! `ros2 node`: `list` and `info`.

use std::fmt::Write as _;

use super::Refused;
use super::action;
use super::name::{is_hidden, is_hidden_node};
use ros2probe_api::names::NodeName;
use ros2probe_api::nodes::{Named, Node};

/// Output of a verb on nodes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeText {
    /// Text for stdout.
    pub text: String,
    /// Warning for stderr.
    pub warning: Option<String>,
}

/// Returns the text of `node list`.
#[must_use]
pub fn list(nodes: &[NodeName<'_>], all: bool, count: bool) -> NodeText {
    let shown = || {
        let shown = nodes
            .iter()
            .filter(|node| all || !is_hidden_node(&node.name));
        shown.flat_map(|node| std::iter::repeat_n(node.name.as_ref(), node.instances))
    };
    if count {
        // The number has no warning, as in ros2cli.
        return NodeText {
            text: format!("{}\n", shown().count()),
            warning: None,
        };
    }
    let text = shown().map(|name| format!("{name}\n")).collect();
    let is_doubled = nodes
        .iter()
        .any(|node| node.instances > 1 && (all || !is_hidden_node(&node.name)));
    let warning = is_doubled.then(|| {
        "WARNING: Be aware that there are nodes in the graph that share an exact name, which can \
         have unintended side effects."
            .to_owned()
    });
    NodeText { text, warning }
}

/// Returns the text of `node info`. Pass `None` as `node` if it does not exist.
///
/// # Errors
///
/// Fails if the node does not exist, or if it is hidden and `hidden` is `false`.
pub fn info(name: &str, node: Option<&Node<'_>>, hidden: bool) -> Result<NodeText, Refused> {
    let node = node.filter(|node| node.name == name && (hidden || !is_hidden_node(name)));
    let node = node.ok_or_else(|| Refused(format!("Unable to find node '{name}'")))?;
    let mut text = format!("{name}\n");
    let sections: [(&str, &[Named<'_>]); 6] = [
        ("Subscribers", &node.subscriptions),
        ("Publishers", &node.publishers),
        ("Service Servers", &node.services),
        ("Service Clients", &node.clients),
        ("Action Servers", &action::of_feedback(&node.publishers)),
        ("Action Clients", &action::of_feedback(&node.subscriptions)),
    ];
    for (title, entries) in sections {
        let _ = writeln!(text, "  {title}:");
        let shown = entries
            .iter()
            .filter(|entry| hidden || !is_hidden(&entry.name));
        let lines: Vec<_> = shown
            .map(|entry| format!("    {}: {}\n", entry.name, entry.types.join(", ")))
            .collect();
        if lines.is_empty() {
            text.push('\n');
        }
        text.extend(lines);
    }
    let count = node.instances.len();
    let warning = (count > 1).then(|| {
        format!(
            "There are {count} nodes in the graph with the exact name \"{name}\". You are seeing \
             information about all of them."
        )
    });
    Ok(NodeText { text, warning })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::nodes::NodeInstance;

    fn names(nodes: &[(&'static str, usize)]) -> Vec<NodeName<'static>> {
        let node = |(name, instances): &(&'static str, usize)| NodeName {
            name: (*name).into(),
            instances: *instances,
            ..NodeName::default()
        };
        nodes.iter().map(node).collect()
    }

    #[test]
    fn a_list_repeats_nodes_of_one_name_and_warns_of_them() {
        let nodes = names(&[("/_ros2cli_1", 1), ("/_robot/lidar", 1), ("/talker", 2)]);
        let printed = list(&nodes, false, false);
        assert_eq!(printed.text, "/_robot/lidar\n/talker\n/talker\n");
        assert!(
            printed
                .warning
                .unwrap()
                .starts_with("WARNING: Be aware that there are nodes")
        );
        let counted = list(&nodes, true, true);
        assert_eq!((counted.text.as_str(), counted.warning), ("4\n", None));
        let single = list(&names(&[("/talker", 1)]), false, false);
        assert_eq!((single.text.as_str(), single.warning), ("/talker\n", None));
        assert_eq!(list(&[], false, false).text, "");
    }

    fn named(names: &[(&str, &'static str)]) -> Vec<Named<'static>> {
        let entry = |(name, types): &(&str, &'static str)| Named {
            name: (*name).to_owned(),
            types: vec![(*types).into()],
        };
        names.iter().map(entry).collect()
    }

    fn node(name: &'static str, instances: usize) -> Node<'static> {
        Node {
            name: name.into(),
            instances: vec![NodeInstance::default(); instances],
            publishers: named(&[
                ("/fib/_action/feedback", "a/action/Fib_FeedbackMessage"),
                ("/rosout", "rcl_interfaces/msg/Log"),
            ]),
            services: named(&[("/fib/_action/send_goal", "a/action/Fib_SendGoal")]),
            ..Node::default()
        }
    }

    #[test]
    fn an_empty_section_is_one_empty_line_and_hidden_names_are_left_out() {
        let talker = node("/talker", 1);
        let printed = info("/talker", Some(&talker), false).unwrap();
        assert_eq!(
            printed.text,
            "/talker\n  Subscribers:\n\n  Publishers:\n    /rosout: rcl_interfaces/msg/Log\n  \
             Service Servers:\n\n  Service Clients:\n\n  Action Servers:\n    /fib: a/action/Fib\n  \
             Action Clients:\n\n"
        );
        assert_eq!(printed.warning, None);
        let printed = info("/talker", Some(&talker), true).unwrap();
        assert!(
            printed
                .text
                .contains("    /fib/_action/send_goal: a/action/Fib_SendGoal\n")
        );
    }

    #[test]
    fn a_missing_or_hidden_node_is_not_found() {
        let hidden = node("/_ros2cli_1", 1);
        let printed = |name, node, all| info(name, node, all);
        let refused = printed("/_ros2cli_1", Some(&hidden), false).unwrap_err();
        assert_eq!(refused.0, "Unable to find node '/_ros2cli_1'");
        assert!(printed("/_ros2cli_1", Some(&hidden), true).is_ok());
        assert!(printed("_ros2cli_1", Some(&hidden), true).is_err());
        assert!(printed("/nope", None, true).is_err());
        let warning = printed("/talker", Some(&node("/talker", 2)), false)
            .unwrap()
            .warning;
        assert!(
            warning
                .unwrap()
                .starts_with("There are 2 nodes in the graph with the exact name")
        );
    }
}
