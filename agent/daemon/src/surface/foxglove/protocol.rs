//! Messages of the Foxglove WebSocket protocol, version 1: JSON objects with an `op`, and binary
//! messages with an opcode.
//!
//! The subprotocol has two names with the same messages. The server supports a part of it:
//! channels, statuses and the connection graph, but no operation that changes the robot.

use std::borrow::Cow;

use ros2probe_wire::Timestamp;
use serde::{Deserialize, Serialize};

/// Names of the subprotocol in the handshake.
pub(super) const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Opcodes of binary messages to the client.
const MESSAGE_DATA: u8 = 1;
const TIME_OPCODE: u8 = 2;
/// Size of the part of a data message before the payload, in bytes.
pub(super) const DATA_HEAD: usize = 13;
/// Maximum number of characters of an unknown `op` that a status repeats.
const MAX_SHOWN_OP: usize = 32;

/// A message of a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request {
    /// `subscribe`: the messages of these channels.
    Subscribe(Vec<Subscribe>),
    /// `unsubscribe`: ids of subscriptions.
    Unsubscribe(Vec<u32>),
    /// `subscribeConnectionGraph`.
    SubscribeGraph,
    /// `unsubscribeConnectionGraph`.
    UnsubscribeGraph,
    /// An operation that the server does not offer, with the start of its name.
    Unsupported(String),
}

/// One subscription of a `subscribe` message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub struct Subscribe {
    /// Id that the client chose.
    pub id: u32,
    /// Id of the channel.
    #[serde(rename = "channelId")]
    pub channel: u32,
}

/// The text is not a JSON object with an `op`, or has wrong fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;

/// A JSON message to the client.
#[derive(Debug, Serialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(super) enum Message<'a> {
    ServerInfo {
        name: &'a str,
        capabilities: &'a [&'static str],
        supported_encodings: [&'static str; 0],
        metadata: Metadata,
        session_id: &'a str,
    },
    Advertise {
        channels: &'a [Advertised<'a>],
    },
    Unadvertise {
        channel_ids: &'a [u32],
    },
    Status {
        level: Level,
        message: &'a str,
        id: &'a str,
    },
    RemoveStatus {
        status_ids: [&'a str; 1],
    },
    ConnectionGraphUpdate {
        published_topics: Vec<Publishers<'a>>,
        subscribed_topics: Vec<Subscribers<'a>>,
        advertised_services: Vec<Providers<'a>>,
        removed_topics: Vec<&'a str>,
        removed_services: Vec<&'a str>,
    },
}

/// Facts about the server for its users.
#[derive(Debug, Serialize)]
pub(super) struct Metadata {
    pub(super) ros2probe: &'static str,
    pub(super) mode: &'static str,
}

/// Severity of a status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "u8")]
pub(super) enum Level {
    Info,
    Warning,
    Error,
}

impl From<Level> for u8 {
    fn from(level: Level) -> Self {
        match level {
            Level::Info => 0,
            Level::Warning => 1,
            Level::Error => 2,
        }
    }
}

/// A channel in an `advertise` message.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Advertised<'a> {
    pub(super) id: u32,
    pub(super) topic: &'a str,
    pub(super) encoding: &'static str,
    pub(super) schema_name: &'a str,
    /// Empty if the definition is unknown.
    pub(super) schema: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) schema_encoding: Option<&'static str>,
}

/// The publishers of a topic in a `connectionGraphUpdate` message.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Publishers<'a> {
    pub(super) name: &'a str,
    pub(super) publisher_ids: Vec<&'a str>,
}

/// The subscribers of a topic in a `connectionGraphUpdate` message.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Subscribers<'a> {
    pub(super) name: &'a str,
    pub(super) subscriber_ids: Vec<&'a str>,
}

/// The servers of a service in a `connectionGraphUpdate` message.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Providers<'a> {
    pub(super) name: &'a str,
    pub(super) provider_ids: Vec<&'a str>,
}

/// Parses a text message of a client.
///
/// # Errors
/// Returns [`Malformed`] unless the text is a JSON object with a string `op` and the fields that
/// this `op` needs.
pub fn parse(text: &str) -> Result<Request, Malformed> {
    #[derive(Deserialize)]
    struct Head<'a> {
        #[serde(borrow)]
        op: Cow<'a, str>,
    }
    #[derive(Deserialize)]
    struct Subscriptions {
        subscriptions: Vec<Subscribe>,
    }
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Ids {
        subscription_ids: Vec<u32>,
    }
    let head: Head<'_> = serde_json::from_str(text).map_err(|_| Malformed)?;
    match head.op.as_ref() {
        "subscribe" => serde_json::from_str(text)
            .map(|Subscriptions { subscriptions }| Request::Subscribe(subscriptions))
            .map_err(|_| Malformed),
        "unsubscribe" => serde_json::from_str(text)
            .map(|Ids { subscription_ids }| Request::Unsubscribe(subscription_ids))
            .map_err(|_| Malformed),
        "subscribeConnectionGraph" => Ok(Request::SubscribeGraph),
        "unsubscribeConnectionGraph" => Ok(Request::UnsubscribeGraph),
        other => Ok(Request::Unsupported(
            other.chars().take(MAX_SHOWN_OP).collect(),
        )),
    }
}

/// Returns the part of a data message before the payload.
pub(super) fn data_head(subscription: u32, time: Timestamp) -> [u8; DATA_HEAD] {
    let mut head = [0; DATA_HEAD];
    let [opcode, rest @ ..] = &mut head;
    *opcode = MESSAGE_DATA;
    let numbers = subscription.to_le_bytes().into_iter();
    let numbers = numbers.chain(time.0.to_le_bytes());
    for (place, byte) in rest.iter_mut().zip(numbers) {
        *place = byte;
    }
    head
}

/// Returns a message with the time of the server.
pub(super) fn time(now: Timestamp) -> Vec<u8> {
    let mut message = vec![TIME_OPCODE];
    message.extend(now.0.to_le_bytes());
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_parsed_as_the_specification_defines_them() {
        let subscribe =
            r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":5}]}"#;
        let expected = [(0, 3), (1, 5)].map(|(id, channel)| Subscribe { id, channel });
        assert_eq!(parse(subscribe), Ok(Request::Subscribe(expected.into())));
        let unsubscribe = r#"{"op":"unsubscribe","subscriptionIds":[0,1]}"#;
        assert_eq!(parse(unsubscribe), Ok(Request::Unsubscribe(vec![0, 1])));
        for (op, expected) in [
            ("subscribeConnectionGraph", Request::SubscribeGraph),
            ("unsubscribeConnectionGraph", Request::UnsubscribeGraph),
            (
                "getParameters",
                Request::Unsupported("getParameters".into()),
            ),
        ] {
            assert_eq!(parse(&format!(r#"{{"op":"{op}","id":"x"}}"#)), Ok(expected));
        }
        let long = format!(r#"{{"op":"{}"}}"#, "é".repeat(1_000));
        assert_eq!(
            parse(&long),
            Ok(Request::Unsupported("é".repeat(MAX_SHOWN_OP)))
        );
    }

    #[test]
    fn a_text_that_is_not_an_operation_is_malformed() {
        let deep = "[".repeat(10_000);
        for text in [
            "",
            "x",
            "1",
            "[]",
            "{}",
            r#"{"op":1}"#,
            r#"{"op":"subscribe"}"#,
            r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":0}]}"#,
            r#"{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":0}]}"#,
            r#"{"op":"subscribe","subscriptions":[{"id":0.5,"channelId":0}]}"#,
            r#"{"op":"subscribe","subscriptions":{}}"#,
            r#"{"op":"unsubscribe","subscriptionIds":["0"]}"#,
            r#"{"op":"subscribeConnectionGraph"} {}"#,
            &deep,
        ] {
            assert_eq!(parse(text), Err(Malformed), "{text:.40}");
        }
    }

    #[test]
    fn binary_messages_are_written_as_the_specification_defines_them() {
        let head = data_head(0x0403_0201, Timestamp(0x1716_1514_1312_1110));
        assert_eq!(
            head,
            [
                1, 1, 2, 3, 4, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x17
            ]
        );
        assert_eq!(time(Timestamp(5)), [2, 5, 0, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn json_messages_are_written_as_the_specification_defines_them() {
        let json = |message: &Message<'_>| serde_json::to_string(message).unwrap();
        let info = Message::ServerInfo {
            name: "rp",
            capabilities: &["connectionGraph"],
            supported_encodings: [],
            metadata: Metadata {
                ros2probe: "1",
                mode: "read-only",
            },
            session_id: "7",
        };
        assert_eq!(
            json(&info),
            r#"{"op":"serverInfo","name":"rp","capabilities":["connectionGraph"],"supportedEncodings":[],"metadata":{"ros2probe":"1","mode":"read-only"},"sessionId":"7"}"#
        );
        let channel = |schema, schema_encoding| Advertised {
            id: 1,
            topic: "/a",
            encoding: "cdr",
            schema_name: "a/msg/B",
            schema,
            schema_encoding,
        };
        let channels = [channel("int8 x\n", Some("ros2msg")), channel("", None)];
        assert_eq!(
            json(&Message::Advertise {
                channels: &channels
            }),
            r#"{"op":"advertise","channels":[{"id":1,"topic":"/a","encoding":"cdr","schemaName":"a/msg/B","schema":"int8 x\n","schemaEncoding":"ros2msg"},{"id":1,"topic":"/a","encoding":"cdr","schemaName":"a/msg/B","schema":""}]}"#
        );
        assert_eq!(
            json(&Message::Unadvertise { channel_ids: &[1] }),
            r#"{"op":"unadvertise","channelIds":[1]}"#
        );
        let status = Message::Status {
            level: Level::Error,
            message: "m",
            id: "i",
        };
        assert_eq!(
            json(&status),
            r#"{"op":"status","level":2,"message":"m","id":"i"}"#
        );
        assert_eq!(
            json(&Message::RemoveStatus { status_ids: ["i"] }),
            r#"{"op":"removeStatus","statusIds":["i"]}"#
        );
    }
}
