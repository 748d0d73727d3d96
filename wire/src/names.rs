//! ROS names and their DDS forms.
//!
//! The mapping follows the ROS 2 design article 140, as `rmw_fastrtps` and `rmw_cyclonedds`
//! implement it. ROS names and DDS names are different types, so neither can replace the other by
//! mistake. All names are plain text of at most [`MAX_LEN`] bytes. This module does not check
//! whether a name is a *valid* ROS name: it keeps the names as they are on the wire.

use alloc::borrow::ToOwned;
use alloc::boxed::Box;
use alloc::format;
use alloc::string::String;
use core::borrow::Borrow;
use core::fmt;

use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::Guid;
use crate::text;

/// Maximum length of a name, in bytes. The mapping allows 256 characters; a name of more than four
/// times that length is not from ROS.
pub const MAX_LEN: usize = 1024;

/// Defines a type for one kind of names, so that kinds cannot be mixed up.
macro_rules! name {
    ($(#[$doc:meta])* $name:ident, $what:literal) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(Box<str>);

        impl $name {
            /// Parses text that is not empty, at most [`MAX_LEN`] bytes long and plain: no control
            /// characters, quotation marks or backslashes.
            ///
            /// # Errors
            /// Returns [`Reason::BadValue`], [`Reason::OverLimit`] or [`Reason::BadText`], in this
            /// order.
            pub fn parse(text: &str) -> Result<Self, WireError> {
                let reason = if text.is_empty() {
                    Reason::BadValue
                } else if text.len() > MAX_LEN {
                    Reason::OverLimit
                } else if !text::is_plain(text) {
                    Reason::BadText
                } else {
                    return Ok(Self(text.into()));
                };
                Err(WireError { what: $what, offset: 0, reason })
            }

            /// Returns the name as text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Debug::fmt(&*self.0, f)
            }
        }
    };
}

name!(
    /// Name of a topic in DDS, such as `rt/points`.
    DdsTopic, "PID_TOPIC_NAME"
);
name!(
    /// Name of a type in DDS, such as `sensor_msgs::msg::dds_::PointCloud2_`.
    DdsType, "PID_TYPE_NAME"
);
name!(
    /// Name of a topic, service or action in ROS, such as `/points`.
    RosName, "ROS name"
);
name!(
    /// Name of a type in ROS, such as `sensor_msgs/msg/PointCloud2`.
    RosType, "ROS type"
);

/// The role of a DDS topic in ROS.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Demangled {
    /// A topic, including the topics of actions and of service introspection.
    Topic(RosName),
    /// `<topic>/_buf_cpu` (`rmw_fastrtps` 9.4.6 and later): the topic's messages for subscribers
    /// that support buffers. Holds the topic's name.
    CpuBuffer(RosName),
    /// `<topic>/_buf/<subscriber>`: references to buffers, not CDR. Holds the topic's name.
    Buffer(RosName),
    /// Requests of a service.
    ServiceRequest(RosName),
    /// Replies of a service.
    ServiceReply(RosName),
    /// `ros_discovery_info`.
    RosDiscovery,
    /// Not created by ROS, or created with `avoid_ros_namespace_conventions`.
    NotRos,
}

impl Demangled {
    /// Returns the ROS topic of the samples; `None` for services and topics outside of ROS.
    #[must_use]
    pub const fn topic(&self) -> Option<&RosName> {
        match self {
            Self::Topic(name) | Self::CpuBuffer(name) | Self::Buffer(name) => Some(name),
            _ => None,
        }
    }

    /// Returns the service of the samples; `None` for topics.
    #[must_use]
    pub const fn service(&self) -> Option<&RosName> {
        match self {
            Self::ServiceRequest(name) | Self::ServiceReply(name) => Some(name),
            _ => None,
        }
    }
}

const DISCOVERY: &str = "ros_discovery_info";
const REQUEST: &str = "Request";
const REPLY: &str = "Reply";

impl DdsTopic {
    /// Reads `PID_TOPIC_NAME`.
    pub(crate) fn read(value: &mut Cursor<'_>) -> Result<Self, WireError> {
        let offset = value.offset();
        let text = text::string(value, "PID_TOPIC_NAME", MAX_LEN)?;
        Self::parse(text).map_err(|error| WireError { offset, ..error })
    }

    /// Returns the topic's role in ROS.
    #[must_use]
    pub fn demangle(&self) -> Demangled {
        let ros = |text: &str| RosName(text.into());
        let named = |name: &str| name.len() > 1 && name.starts_with('/');
        if self.as_str() == DISCOVERY {
            return Demangled::RosDiscovery;
        }
        let Some((prefix, name)) = self.as_str().split_at_checked(2) else {
            return Demangled::NotRos;
        };
        match prefix {
            "rt" if named(name) => match buffer_base(name) {
                Some((base, true)) => Demangled::CpuBuffer(ros(base)),
                Some((base, false)) => Demangled::Buffer(ros(base)),
                None => Demangled::Topic(ros(name)),
            },
            "rq" => match name.strip_suffix(REQUEST).filter(|name| named(name)) {
                Some(service) => Demangled::ServiceRequest(ros(service)),
                None => Demangled::NotRos,
            },
            "rr" => match name.strip_suffix(REPLY).filter(|name| named(name)) {
                Some(service) => Demangled::ServiceReply(ros(service)),
                None => Demangled::NotRos,
            },
            _ => Demangled::NotRos,
        }
    }

    /// Returns the subscription for which a topic `<topic>/_buf/<subscription>` carries buffers.
    #[must_use]
    pub fn buffer_subscriber(&self) -> Option<Guid> {
        let (_, digits) = self.as_str().rsplit_once("/_buf/")?;
        Guid::of_digits(digits)
    }

    /// Returns the DDS topic of a ROS topic.
    #[must_use]
    pub fn of_topic(topic: &RosName) -> Self {
        Self(format!("rt{topic}").into())
    }

    /// Returns the DDS topic of a service's requests.
    #[must_use]
    pub fn of_requests(service: &RosName) -> Self {
        Self(format!("rq{service}{REQUEST}").into())
    }

    /// Returns the DDS topic of a service's replies.
    #[must_use]
    pub fn of_replies(service: &RosName) -> Self {
        Self(format!("rr{service}{REPLY}").into())
    }
}

/// Returns the topic to which a buffer topic belongs, and whether the buffer topic is the one for
/// CPU buffers.
fn buffer_base(name: &str) -> Option<(&str, bool)> {
    if let Some(base) = name
        .strip_suffix("/_buf_cpu")
        .filter(|base| !base.is_empty())
    {
        return Some((base, true));
    }
    let (base, subscriber) = name.rsplit_once("/_buf/")?;
    let is_gid = !subscriber.is_empty() && subscriber.bytes().all(|c| c.is_ascii_hexdigit());
    (is_gid && !base.is_empty()).then_some((base, false))
}

/// The part of an action that a topic or service implements.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum ActionPart {
    /// Service `send_goal`.
    SendGoal,
    /// Service `cancel_goal`.
    CancelGoal,
    /// Service `get_result`.
    GetResult,
    /// Topic `feedback`.
    Feedback,
    /// Topic `status`.
    Status,
}

impl RosName {
    /// Returns whether any token begins with an underscore: `ros2` lists such names only on
    /// request.
    #[must_use]
    pub fn is_hidden(&self) -> bool {
        self.as_str().split('/').any(|token| token.starts_with('_'))
    }

    /// Returns the action that this topic or service belongs to.
    #[must_use]
    pub fn action(&self) -> Option<(Self, ActionPart)> {
        let (action, part) = self.as_str().rsplit_once("/_action/")?;
        let part = match part {
            "send_goal" => ActionPart::SendGoal,
            "cancel_goal" => ActionPart::CancelGoal,
            "get_result" => ActionPart::GetResult,
            "feedback" => ActionPart::Feedback,
            "status" => ActionPart::Status,
            _ => return None,
        };
        (!action.is_empty()).then(|| (Self(action.into()), part))
    }

    /// Returns the service whose introspection events this topic carries.
    #[must_use]
    pub fn service_of_events(&self) -> Option<Self> {
        let service = self.as_str().strip_suffix("/_service_event")?;
        (!service.is_empty()).then(|| Self(service.into()))
    }
}

impl DdsType {
    /// Returns the DDS type of a ROS message: `std_msgs::msg::dds_::String_` for
    /// `std_msgs/msg/String`.
    #[must_use]
    pub fn of_message(message: &RosType) -> Self {
        let text = message.as_str();
        Self(match text.rsplit_once('/') {
            Some((package, name)) => {
                format!("{}::dds_::{name}_", package.replace('/', "::")).into()
            }
            None => text.into(),
        })
    }

    /// Reads `PID_TYPE_NAME`.
    pub(crate) fn read(value: &mut Cursor<'_>) -> Result<Self, WireError> {
        let offset = value.offset();
        let text = text::string(value, "PID_TYPE_NAME", MAX_LEN)?;
        Self::parse(text).map_err(|error| WireError { offset, ..error })
    }

    /// Returns the ROS type; a type from outside of ROS is unchanged.
    #[must_use]
    pub fn message(&self) -> RosType {
        let text = self.demangled().unwrap_or_else(|| self.as_str().to_owned());
        RosType(text.into())
    }

    /// Returns the service's type, given that of its requests or replies.
    #[must_use]
    pub fn service(&self) -> RosType {
        let message = self.message();
        let service = ["_Request", "_Response"]
            .iter()
            .find_map(|suffix| message.as_str().strip_suffix(suffix))
            .filter(|_| self.demangled().is_some());
        service.map_or_else(|| message.clone(), |service| RosType(service.into()))
    }

    /// Returns the action's type, given that of one of its parts; `None` for the parts with a
    /// generic type (`cancel_goal`, `status`).
    #[must_use]
    pub fn action(&self) -> Option<RosType> {
        const SUFFIXES: [&str; 5] = [
            "_SendGoal_Request",
            "_SendGoal_Response",
            "_GetResult_Request",
            "_GetResult_Response",
            "_FeedbackMessage",
        ];
        let text = self.demangled()?;
        let action = SUFFIXES
            .iter()
            .find_map(|suffix| text.strip_suffix(suffix))?;
        Some(RosType(action.into()))
    }

    fn demangled(&self) -> Option<String> {
        let (namespace, name) = self.as_str().split_once("dds_::")?;
        let name = name.strip_suffix('_')?;
        Some(format!("{}{name}", namespace.replace("::", "/")))
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use proptest::prelude::*;

    use super::*;

    fn ros(text: &str) -> RosName {
        RosName::parse(text).unwrap()
    }

    fn demangle(text: &str) -> Demangled {
        DdsTopic::parse(text).unwrap().demangle()
    }

    #[test]
    fn topics_and_services_are_demangled_without_prefix_and_suffix() {
        assert_eq!(demangle("rt/a/b"), Demangled::Topic(ros("/a/b")));
        assert_eq!(
            demangle("rq/sRequest"),
            Demangled::ServiceRequest(ros("/s"))
        );
        assert_eq!(
            demangle("rr/n/sReply"),
            Demangled::ServiceReply(ros("/n/s"))
        );
        assert_eq!(demangle("ros_discovery_info"), Demangled::RosDiscovery);
    }

    #[test]
    fn names_that_ros_did_not_mangle_are_not_demangled() {
        for name in [
            "Square",
            "rt",
            "rt/",
            "rtx/a",
            "rq/s",
            "rq/Reply",
            "rr/sRequest",
            "r",
            "rqRequest",
        ] {
            assert_eq!(demangle(name), Demangled::NotRos, "{name}");
        }
        // The second byte is not a character boundary.
        assert_eq!(demangle("€t/a"), Demangled::NotRos);
    }

    #[test]
    fn buffer_topics_belong_to_their_base_topic() {
        assert_eq!(
            demangle("rt/camera/image/_buf_cpu"),
            Demangled::CpuBuffer(ros("/camera/image"))
        );
        assert_eq!(
            demangle("rt/image/_buf/010f0a"),
            Demangled::Buffer(ros("/image"))
        );
        assert_eq!(
            demangle("rt/image/_buf/other"),
            Demangled::Topic(ros("/image/_buf/other"))
        );
        assert_eq!(demangle("rt/_buf_cpu"), Demangled::Topic(ros("/_buf_cpu")));
    }

    #[test]
    fn actions_are_recognized_by_their_parts() {
        let Demangled::ServiceRequest(service) = demangle("rq/arm/_action/send_goalRequest") else {
            panic!("not a service");
        };
        assert_eq!(service.action(), Some((ros("/arm"), ActionPart::SendGoal)));
        assert!(service.is_hidden());
        assert_eq!(
            ros("/arm/_action/status").action(),
            Some((ros("/arm"), ActionPart::Status))
        );
        assert_eq!(ros("/_action/status").action(), None);
        assert_eq!(ros("/arm/_action/other").action(), None);
        assert_eq!(
            ros("/add/_service_event").service_of_events(),
            Some(ros("/add"))
        );
        assert!(!ros("/arm/a_b").is_hidden());
    }

    #[test]
    fn type_names_are_demangled() {
        let dds = |text: &str| DdsType::parse(text).unwrap();
        assert_eq!(
            dds("sensor_msgs::msg::dds_::Imu_").message().as_str(),
            "sensor_msgs/msg/Imu"
        );
        assert_eq!(dds("HelloWorld").message().as_str(), "HelloWorld");
        assert_eq!(dds("a::dds_::B").message().as_str(), "a::dds_::B");
        let request = dds("example_interfaces::srv::dds_::AddTwoInts_Request_");
        assert_eq!(
            request.service().as_str(),
            "example_interfaces/srv/AddTwoInts"
        );
        assert_eq!(
            request.message().as_str(),
            "example_interfaces/srv/AddTwoInts_Request"
        );
        assert_eq!(dds("My_Request").service().as_str(), "My_Request");
        let goal = dds("example_interfaces::action::dds_::Fibonacci_SendGoal_Request_");
        assert_eq!(
            goal.action().unwrap().as_str(),
            "example_interfaces/action/Fibonacci"
        );
        assert_eq!(
            goal.service().as_str(),
            "example_interfaces/action/Fibonacci_SendGoal"
        );
        assert_eq!(
            dds("action_msgs::srv::dds_::CancelGoal_Request_").action(),
            None
        );
    }

    #[test]
    fn hostile_names_are_refused() {
        let reason = |text: &str| DdsTopic::parse(text).map_err(|error| error.reason);
        assert_eq!(reason(""), Err(Reason::BadValue));
        assert_eq!(reason("rt/a\"b"), Err(Reason::BadText));
        assert_eq!(reason("rt/a\nb"), Err(Reason::BadText));
        assert_eq!(reason(&"a".repeat(10_000)), Err(Reason::OverLimit));
        assert!(reason(&"a".repeat(MAX_LEN)).is_ok());
    }

    proptest! {
        #[test]
        fn mangled_types_survive_a_round_trip(name in "[a-z][a-z0-9_]{0,8}/(msg|srv|action)/[A-Z][a-zA-Z0-9]{0,8}") {
            let name = RosType::parse(&name).unwrap();
            prop_assert_eq!(DdsType::of_message(&name).message(), name);
        }

        #[test]
        fn mangled_names_survive_a_round_trip(name in "(/[a-z][a-zA-Z0-9_]{0,8}){1,4}") {
            let name = ros(&name);
            prop_assert_eq!(DdsTopic::of_topic(&name).demangle(), Demangled::Topic(name.clone()));
            let requests = DdsTopic::of_requests(&name).demangle();
            prop_assert_eq!(requests, Demangled::ServiceRequest(name.clone()));
            let replies = DdsTopic::of_replies(&name).demangle();
            prop_assert_eq!(replies, Demangled::ServiceReply(name));
        }

        #[test]
        fn no_text_makes_demangling_panic(text in ".{1,40}") {
            if let Ok(topic) = DdsTopic::parse(&text) {
                let _ = topic.demangle();
            }
            if let Ok(name) = RosName::parse(&text) {
                let _ = (name.action(), name.service_of_events(), name.is_hidden());
            }
            if let Ok(name) = DdsType::parse(&text) {
                let _ = (name.message().to_string(), name.service(), name.action());
            }
        }
    }
}
