//! Keys of ROS topics and services: `<domain>/<name>/<type>/<type hash>` (rmw_zenoh,
//! `docs/design.md`).
//!
//! The name may contain slashes, so a key is read from its end.

use crate::cursor::WireError;
use crate::discovery::TypeHash;
use crate::domain::DomainId;
use crate::guid::Guid;
use crate::names::{DdsType, RosName, RosType};

use super::attachment::Gid;

/// Placeholder for the hash of a type in Humble, which has no hashes.
const NO_HASH: &str = "TypeHashNotSupported";

/// Parses a type hash chunk: `Some(None)` for a version or placeholder without a known hash,
/// `None` for text that is not a hash.
pub(super) fn type_hash(text: &str) -> Option<Option<TypeHash>> {
    (text == NO_HASH || text.starts_with("RIHS")).then(|| TypeHash::parse(text))
}

/// Parses a domain: a decimal number.
pub(super) fn domain(text: &str) -> Option<DomainId> {
    let is_number = text.bytes().all(|c| c.is_ascii_digit());
    is_number.then_some(DomainId(text.parse().ok()?))
}

/// The meaning of a Zenoh key in ROS.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Key {
    /// Samples of a topic, or requests of a service.
    Topic(TopicKey),
    /// History, heartbeats and discovery of an AdvancedPublisher or AdvancedSubscriber (`@adv`): a
    /// sample with such a key does not belong to the topic.
    Advanced,
    /// A liveliness token, see [`super::Token`].
    Token,
    /// Not created by ROS.
    NotRos,
}

/// An additional channel of a topic for "buffer aware" endpoints (rmw_zenoh of Lyrical and later).
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Buffer {
    /// `_buf_cpu`: the topic's messages for all subscribers without other backends.
    Cpu,
    /// `_buf/<gid>`: references to buffers for one subscriber, not CDR.
    Subscriber(Gid),
}

/// Key of a ROS topic or service.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TopicKey {
    /// Domain of the session.
    pub domain: DomainId,
    /// Name of the topic or service.
    pub name: RosName,
    /// Type as in the key, such as `std_msgs::msg::dds_::String_`.
    pub type_name: DdsType,
    /// Hash of the type; `None` in Humble.
    pub type_hash: Option<TypeHash>,
    /// The buffer channel, if the key is that of one.
    pub buffer: Option<Buffer>,
}

impl TopicKey {
    /// Returns the type in ROS's form, such as `std_msgs/msg/String`.
    #[must_use]
    pub fn ros_type(&self) -> RosType {
        self.type_name.message()
    }

    /// Returns whether the key is that of a service, including those of an action.
    #[must_use]
    pub fn is_service(&self) -> bool {
        is_service(self.type_name.as_str())
    }

    fn parse(key: &str) -> Option<Result<Self, WireError>> {
        let (key, buffer) = buffer(key);
        let (rest, hash) = key.rsplit_once('/')?;
        let type_hash = type_hash(hash)?;
        let (rest, type_name) = rest.rsplit_once('/')?;
        let (domain_text, name) = rest.split_once('/')?;
        let domain = domain(domain_text)?;
        let parts = || {
            Ok(Self {
                domain,
                name: RosName::parse(&alloc::format!("/{name}"))?,
                type_name: DdsType::parse(type_name)?,
                type_hash,
                buffer,
            })
        };
        Some(parts())
    }
}

/// Returns whether a type is that of a service, including the services of an action.
pub(super) fn is_service(type_name: &str) -> bool {
    let is_action_service = ["_SendGoal_", "_GetResult_"]
        .iter()
        .any(|suffix| type_name.ends_with(suffix));
    type_name.contains("::srv::") || type_name.contains("::action::") && is_action_service
}

/// Splits off the suffix of a buffer channel.
fn buffer(key: &str) -> (&str, Option<Buffer>) {
    if let Some(base) = key.strip_suffix("/_buf_cpu") {
        return (base, Some(Buffer::Cpu));
    }
    let subscriber = key.rsplit_once("/_buf/").and_then(|(base, digits)| {
        let gid = Guid::of_digits(digits)?.to_bytes();
        Some((base, Buffer::Subscriber(Gid(gid))))
    });
    match subscriber {
        Some((base, buffer)) => (base, Some(buffer)),
        None => (key, None),
    }
}

impl Key {
    /// Parses a key, which may be the pattern of a subscriber.
    ///
    /// # Errors
    /// Fails if a name or type is too long or not plain text, see [`RosName::parse`].
    pub fn parse(key: &str) -> Result<Self, WireError> {
        if key.starts_with("@ros2_lv/") || key.starts_with("@/") {
            return Ok(Self::Token);
        }
        if key.contains("/@adv/") {
            return Ok(Self::Advanced);
        }
        match TopicKey::parse(key) {
            Some(topic) => Ok(Self::Topic(topic?)),
            None => Ok(Self::NotRos),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::format;

    use proptest::prelude::*;

    use super::*;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    fn topic(key: &str) -> TopicKey {
        match Key::parse(key) {
            Ok(Key::Topic(topic)) => topic,
            other => panic!("{key}: {other:?}"),
        }
    }

    #[test]
    fn a_key_is_read_from_its_end() {
        let key = topic(&format!(
            "7/robot1/scan/sensor_msgs::msg::dds_::LaserScan_/{HASH}"
        ));
        assert_eq!(key.domain, DomainId(7));
        assert_eq!(key.name.as_str(), "/robot1/scan");
        assert_eq!(key.ros_type().as_str(), "sensor_msgs/msg/LaserScan");
        assert_eq!(key.type_hash, TypeHash::parse(HASH));
        assert!(!key.is_service() && key.buffer.is_none());
    }

    #[test]
    fn keys_of_services_and_actions_are_parsed() {
        let key = topic(
            "0/robot1/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/TypeHashNotSupported",
        );
        assert!(key.is_service());
        assert_eq!(key.type_hash, None);
        assert_eq!(key.ros_type().as_str(), "example_interfaces/srv/AddTwoInts");
        let goal = topic(
            "0/fibonacci/_action/send_goal/example_interfaces::action::dds_::Fibonacci_SendGoal_/\
             TypeHashNotSupported",
        );
        assert!(goal.is_service());
        assert_eq!(goal.name.action().unwrap().0.as_str(), "/fibonacci");
        let feedback = topic(
            "0/fibonacci/_action/feedback/example_interfaces::action::dds_::\
             Fibonacci_FeedbackMessage_/TypeHashNotSupported",
        );
        assert!(!feedback.is_service());
    }

    #[test]
    fn buffer_channels_belong_to_their_topic() {
        let base = format!("0/image/sensor_msgs::msg::dds_::Image_/{HASH}");
        let cpu = topic(&format!("{base}/_buf_cpu"));
        assert_eq!(
            (cpu.name.as_str(), cpu.buffer),
            ("/image", Some(Buffer::Cpu))
        );
        let subscriber = topic(&format!("{base}/_buf/000102030405060708090a0b0c0d0e0f"));
        let gid = Gid(core::array::from_fn(|index| u8::try_from(index).unwrap()));
        assert_eq!(subscriber.buffer, Some(Buffer::Subscriber(gid)));
    }

    #[test]
    fn keys_of_advanced_publishers_tokens_and_others_are_distinguished() {
        let advanced =
            "0/rosout/rcl_interfaces::msg::dds_::Log_/TypeHashNotSupported/@adv/pub/9fb9/12/_";
        assert_eq!(Key::parse(advanced), Ok(Key::Advanced));
        assert_eq!(Key::parse("@ros2_lv/0/1/0/0/NN/%/%/n"), Ok(Key::Token));
        for key in [
            "",
            "demo/example",
            "x/chatter/t/TypeHashNotSupported",
            "0/a/b/c",
        ] {
            assert_eq!(Key::parse(key), Ok(Key::NotRos), "{key}");
        }
        assert!(Key::parse("0/a\"b/t/TypeHashNotSupported").is_err());
        assert!(Key::parse("0/a//TypeHashNotSupported").is_err());
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_of_keys_panic(key in ".{0,60}") {
            let _ = Key::parse(&key);
            let _ = Key::parse(&format!("0/{key}/{key}/TypeHashNotSupported"));
        }
    }
}
