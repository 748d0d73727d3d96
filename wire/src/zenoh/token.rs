//! Liveliness tokens: the ROS graph in Zenoh (rmw_zenoh, `liveliness_utils.cpp`).
//!
//! A token lives as long as the node or endpoint that declares it. `%` stands for a slash within a
//! chunk, and for an empty chunk.

use alloc::boxed::Box;
use alloc::format;
use alloc::string::String;

use crate::backends::Backends;
use crate::cursor::{Reason, WireError};
use crate::discovery::TypeHash;
use crate::domain::DomainId;
use crate::names::{DdsType, RosName, RosType};
use crate::qos::Qos;

use super::attachment::Gid;
use super::identity::ZenohId;
use super::{key, token_qos};

/// Maximum length of a token, in bytes.
const MAX_LEN: usize = 4096;
/// Number of chunks of a node's token.
const NODE_CHUNKS: usize = 9;

/// The role of an endpoint.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum EndpointKind {
    /// `MP`.
    Publisher,
    /// `MS`.
    Subscription,
    /// `SS`: server of a service.
    Server,
    /// `SC`: client of a service.
    Client,
}

impl EndpointKind {
    fn parse(chunk: &str) -> Option<Self> {
        Some(match chunk {
            "MP" => Self::Publisher,
            "MS" => Self::Subscription,
            "SS" => Self::Server,
            "SC" => Self::Client,
            _ => return None,
        })
    }
}

/// A node, as its own token and those of its endpoints describe it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct NodeToken {
    /// Domain.
    pub domain: DomainId,
    /// Id of the session, which is a process.
    pub session: ZenohId,
    /// Number of the node in the session.
    pub node: u64,
    /// Enclave, `/` if empty.
    pub enclave: Box<str>,
    /// Namespace, `/` if empty.
    pub namespace: Box<str>,
    /// Name without its namespace.
    pub name: Box<str>,
}

impl NodeToken {
    /// Returns the name with its namespace, such as `/robot1/lidar`.
    #[must_use]
    pub fn full_name(&self) -> String {
        match &*self.namespace {
            "/" => format!("/{}", self.name),
            namespace => format!("{namespace}/{}", self.name),
        }
    }
}

/// An endpoint of a node.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct EndpointToken {
    /// The node.
    pub node: NodeToken,
    /// Number of the endpoint in the session.
    pub entity: u64,
    /// Role.
    pub kind: EndpointKind,
    /// Topic or service.
    pub name: RosName,
    /// Type as in the token, such as `std_msgs::msg::dds_::String_`.
    pub type_name: DdsType,
    /// Hash of the type; `None` in Humble.
    pub type_hash: Option<TypeHash>,
    /// QoS; `None` if it has an unknown form.
    pub qos: Option<Qos>,
    /// Backends of buffers (rmw_zenoh of Lyrical and later).
    pub backends: Option<Backends>,
    /// Identity of the endpoint in the attachments of its samples and requests.
    pub gid: Gid,
}

impl EndpointToken {
    /// Returns the type in ROS's form, such as `std_msgs/msg/String`.
    #[must_use]
    pub fn ros_type(&self) -> RosType {
        self.type_name.message()
    }
}

/// A token of the bridge `zenoh-plugin-ros2dds`: a route between DDS and Zenoh.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct BridgeToken {
    /// The bridge.
    pub bridge: ZenohId,
    /// `MP`, `MS`, `SS`, `SC`, and for actions `AS` and `AC`.
    pub kind: [u8; 2],
    /// Key of the route in Zenoh.
    pub key: Box<str>,
    /// Type in ROS's form.
    pub type_name: Box<str>,
    /// QoS in the bridge's form, absent for services and actions.
    pub qos: Option<Box<str>>,
}

/// The meaning of a liveliness token.
#[derive(Clone, PartialEq, Eq, Debug)]
#[expect(clippy::large_enum_variant, reason = "nearly all are endpoints")]
pub enum Token {
    /// A node.
    Node(NodeToken),
    /// A publisher, subscription, server or client.
    Endpoint(EndpointToken),
    /// A route of the bridge.
    Bridge(BridgeToken),
    /// Not part of the ROS graph: a token of an AdvancedPublisher, of the bridge itself, or of
    /// another application.
    Other,
}

impl Token {
    /// Parses a token.
    ///
    /// # Errors
    /// Fails if a token of rmw_zenoh has another form, or a name that is too long or not plain
    /// text.
    pub fn parse(token: &str) -> Result<Self, WireError> {
        if token.len() > MAX_LEN {
            return Err(error(Reason::OverLimit));
        }
        if let Some(rest) = token.strip_prefix("@ros2_lv/") {
            return ros(token, rest);
        }
        Ok(bridge(token).map_or(Self::Other, Self::Bridge))
    }
}

fn error(reason: Reason) -> WireError {
    WireError {
        what: "liveliness token",
        offset: 0,
        reason,
    }
}

fn ros(token: &str, rest: &str) -> Result<Token, WireError> {
    let count = token.split('/').count();
    let mut chunks = rest.split('/');
    let mut next = || chunks.next().ok_or(error(Reason::BadLength));
    let domain = next()?;
    let session = next()?;
    let node_number = next()?;
    let entity_number = next()?;
    let kind = next()?;
    let bad = error(Reason::BadValue);
    let node = NodeToken {
        domain: key::domain(domain).ok_or(bad)?,
        session: ZenohId::parse(session).ok_or(bad)?,
        node: node_number.parse().map_err(|_| bad)?,
        enclave: path(next()?)?,
        namespace: path(next()?)?,
        // A name that ROS accepts is never empty and never needs mangling.
        name: plain(next()?)?.into(),
    };
    let entity = entity_number.parse().map_err(|_| bad)?;
    if kind == "NN" {
        return if count == NODE_CHUNKS {
            Ok(Token::Node(node))
        } else {
            Err(error(Reason::BadLength))
        };
    }
    let kind = EndpointKind::parse(kind).ok_or(error(Reason::BadMarker))?;
    let endpoint = EndpointToken {
        node,
        entity,
        kind,
        name: RosName::parse(&demangle(next()?))?,
        type_name: DdsType::parse(&demangle(next()?))?,
        type_hash: key::type_hash(next()?).ok_or(bad)?,
        qos: token_qos::parse(next()?),
        backends: match chunks.next() {
            Some(chunk) => Backends::of_token(plain(chunk)?),
            None => None,
        },
        gid: Gid::of_token(token),
    };
    if chunks.next().is_some() {
        return Err(error(Reason::BadLength));
    }
    Ok(Token::Endpoint(endpoint))
}

fn demangle(chunk: &str) -> String {
    chunk.replace('%', "/")
}

/// Returns the path in a chunk. The path begins with a slash; an empty path is `/`.
fn path(chunk: &str) -> Result<Box<str>, WireError> {
    if !plain(chunk)?.starts_with('%') {
        return Err(error(Reason::BadValue));
    }
    Ok(demangle(chunk).into())
}

/// Returns text that must be plain and not empty.
fn plain(chunk: &str) -> Result<&str, WireError> {
    if chunk.is_empty() {
        return Err(error(Reason::BadValue));
    }
    if !crate::text::is_plain(chunk) {
        return Err(error(Reason::BadText));
    }
    Ok(chunk)
}

/// Parses `@/<zid>/@ros2_lv/<kind>/<key>/<type>[/<qos>]`, in which slashes are `§`.
fn bridge(token: &str) -> Option<BridgeToken> {
    let (bridge, rest) = token.strip_prefix("@/")?.split_once("/@ros2_lv/")?;
    let mut chunks = rest.split('/');
    let mut next = || chunks.next().filter(|chunk| plain(chunk).is_ok());
    let kind: [u8; 2] = next()?.as_bytes().try_into().ok()?;
    if !matches!(&kind, b"MP" | b"MS" | b"SS" | b"SC" | b"AS" | b"AC") {
        return None;
    }
    let slashes = |chunk: &str| chunk.replace('§', "/").into();
    Some(BridgeToken {
        bridge: ZenohId::parse(bridge)?,
        kind,
        key: slashes(next()?),
        type_name: slashes(next()?),
        qos: next().map(slashes),
    })
}

#[cfg(test)]
mod tests {
    use std::format;
    use std::string::ToString;
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    const TALKER: &str = "@ros2_lv/0/d10ca1632cc62c55cbbda90ef78373e8/0/10/MP/%/%/talker/%chatter/\
         std_msgs::msg::dds_::String_/\
         RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,";

    fn endpoint(token: &str) -> EndpointToken {
        match Token::parse(token) {
            Ok(Token::Endpoint(endpoint)) => endpoint,
            other => panic!("{token}: {other:?}"),
        }
    }

    #[test]
    fn the_token_of_a_publisher_yields_node_topic_and_qos() {
        let talker = endpoint(TALKER);
        assert_eq!(talker.kind, EndpointKind::Publisher);
        assert_eq!((talker.node.domain, talker.entity), (DomainId(0), 10));
        assert_eq!(
            talker.node.session.to_string(),
            "d10ca1632cc62c55cbbda90ef78373e8"
        );
        assert_eq!(talker.node.full_name(), "/talker");
        assert_eq!(talker.name.as_str(), "/chatter");
        assert_eq!(talker.ros_type().as_str(), "std_msgs/msg/String");
        assert!(talker.type_hash.is_some() && talker.backends.is_none());
        assert_eq!(talker.qos.unwrap().history.unwrap().depth, 7);
        assert_eq!(talker.gid.to_string(), "0859edc6de1dc09e0e8ac6bec5bf6e19");
    }

    #[test]
    fn the_token_of_a_node_yields_namespace_and_name() {
        let token = "@ros2_lv/0/9fb9a8907b5b85c9467c19b7ec7b347a/3/3/NN/%/%robot2/dense_sink";
        let Ok(Token::Node(node)) = Token::parse(token) else {
            panic!("no node");
        };
        assert_eq!(node.full_name(), "/robot2/dense_sink");
        assert_eq!((&*node.enclave, &*node.namespace), ("/", "/robot2"));
        assert_eq!(node.node, 3);
    }

    #[test]
    fn endpoints_without_a_hash_and_with_backends_are_parsed() {
        let token = "@ros2_lv/5/e2/0/17/SC/%/%robot2/listener/%robot1%add_two_ints/\
                     example_interfaces::srv::dds_::AddTwoInts_/TypeHashNotSupported/::,10:,:,:,,";
        let client = endpoint(token);
        assert_eq!(
            (client.kind, client.type_hash),
            (EndpointKind::Client, None)
        );
        assert_eq!(client.name.as_str(), "/robot1/add_two_ints");
        let token_of_image = token.replace("/SC/", "/MS/");
        let subscription = endpoint(&format!("{token_of_image}/backends:cuda:;cpu:"));
        assert_eq!(subscription.kind, EndpointKind::Subscription);
        let backends = subscription.backends.unwrap();
        assert_eq!(backends.names().collect::<Vec<_>>(), ["cpu", "cuda"]);
        // An unknown QoS does not hide the endpoint.
        assert_eq!(endpoint(&token.replace("::,10:,", "x")).qos, None);
    }

    #[test]
    fn a_route_of_the_bridge_is_recognized() {
        let token = "@/a1b2/@ros2_lv/MP/robot§scan/sensor_msgs§msg§LaserScan/K:1:2,5:";
        let Ok(Token::Bridge(route)) = Token::parse(token) else {
            panic!("no route");
        };
        assert_eq!(route.bridge.to_string(), "a1b2");
        assert_eq!((&route.kind, &*route.key), (b"MP", "robot/scan"));
        assert_eq!(&*route.type_name, "sensor_msgs/msg/LaserScan");
        assert_eq!(route.qos.as_deref(), Some("K:1:2,5:"));
        assert_eq!(Token::parse("@/a1b2/@ros2_lv/XX/k/t"), Ok(Token::Other));
    }

    #[test]
    fn malformed_tokens_are_refused() {
        for (token, reason) in [
            ("@ros2_lv/0/a/0/0/NN/%/%", Reason::BadLength),
            ("@ros2_lv/0/a/0/0/NN/%/%/n/more", Reason::BadLength),
            ("@ros2_lv/0/a/0/0/XX/%/%/n/t", Reason::BadMarker),
            ("@ros2_lv/x/a/0/0/NN/%/%/n", Reason::BadValue),
            ("@ros2_lv/0/0/0/0/NN/%/%/n", Reason::BadValue),
            ("@ros2_lv/0/a/0/0/NN/%/%/", Reason::BadValue),
            ("@ros2_lv/0/a/0/0/NN/%/robot/n", Reason::BadValue),
            ("@ros2_lv/0/a/0/0/NN/%/%/\"", Reason::BadText),
        ] {
            assert_eq!(Token::parse(token).unwrap_err().reason, reason, "{token}");
        }
        let long = format!("@ros2_lv/{}", "a".repeat(MAX_LEN));
        assert_eq!(Token::parse(&long).unwrap_err().reason, Reason::OverLimit);
        for length in 0..TALKER.len() {
            let is_whole = matches!(Token::parse(&TALKER[..length]), Ok(Token::Endpoint(e)) if e.qos.is_some());
            assert!(!is_whole || length >= TALKER.len() - 8, "{length}");
        }
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_of_tokens_panic(text in "[@/%a-zA-Z0-9§:,_]{0,60}") {
            let _ = Token::parse(&text);
            let _ = Token::parse(&format!("@ros2_lv/0/a/0/0/MP/{text}"));
            let _ = Token::parse(&format!("@/a/@ros2_lv/MP/{text}"));
        }
    }
}
