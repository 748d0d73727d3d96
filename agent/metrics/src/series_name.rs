//! The name of a topic in metrics and events.

use std::borrow::Cow;

use ros2probe_model::facts::topic_kind::TopicKind;

/// Returns the ROS name of a topic. Topics of services, including those of actions, keep their DDS
/// names, because a request, its reply and a topic may share their ROS name. A DDS name that looks
/// like a ROS name is marked.
#[must_use]
pub fn series_name<'a>(kind: TopicKind, name: &'a str, dds_name: &'a str) -> Cow<'a, str> {
    match kind {
        TopicKind::Topic | TopicKind::ActionFeedback | TopicKind::ActionStatus => {
            Cow::Borrowed(name)
        }
        _ if dds_name.starts_with('/') => Cow::Owned(format!("dds:{dds_name}")),
        _ => Cow::Borrowed(dds_name),
    }
}
