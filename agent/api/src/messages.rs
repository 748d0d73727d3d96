//! `/topics/{topic}/messages`: the lines of the stream of decoded messages, and
//! `/topics/{topic}/definition`.
//!
//! Fields of a message have the generic type `V`: the agent writes JSON text, and a client
//! deserializes the type that it needs. A [`Line`] contains a [`Message`] of this type.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// A line of the stream: an object with one member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesLine))]
#[serde(rename_all = "snake_case")]
pub enum Line<M> {
    /// The type of the messages that follow.
    Type(Definition),
    /// A message.
    Message(M),
    /// Messages that cannot be shown because their bytes were not captured.
    Missed(Missed),
    /// A keep-alive, sent while no message arrives.
    Beat(Beat),
    /// The last line of the stream.
    End(End),
}

/// A message type.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesType))]
pub struct Definition {
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "sensor_msgs/msg/Imu"))]
    pub name: String,
    /// Whether the definition is known, so that messages can be decoded.
    pub known: bool,
    /// Why the definition is unknown; null if it is known.
    pub reason: Option<String>,
    /// The definition, followed by the definitions of its nested types, in the format of ROS bags.
    pub definition: Option<String>,
    /// Hash of the complete type in XTypes by which the definition was found; null if it was found by
    /// another hash or by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub equivalence_hash: Option<String>,
}

/// A message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesMessage))]
pub struct Message<V> {
    /// Unix time of the message's arrival.
    pub time: f64,
    /// Unix time at which the message was written, by the writer's clock.
    pub source_time: Option<f64>,
    /// GUID of the message's writer.
    pub writer: String,
    /// The writer's node.
    pub node: Option<String>,
    /// Sequence number of the message, counted by the writer.
    pub sequence_number: u64,
    /// Bytes of the serialized message.
    pub bytes: u32,
    /// Number of messages that arrived after the previously shown message and are not shown.
    pub skipped: u64,
    /// Fields in the order of the definition. 64-bit numbers beyond 2^53, NaN and infinities are
    /// strings. A long array or string becomes an object with its `$length` and its beginning,
    /// `$items` or `$text`.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Object>))]
    pub value: Option<V>,
    /// Why the message cannot be decoded; null if it can be decoded.
    pub error: Option<String>,
    /// A small picture of the message, if the request has `preview=true` and the type has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub preview: Option<Preview>,
    /// Why the message has no preview.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub preview_error: Option<String>,
}

/// A preview of a message: a JSON object with one member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesPreview))]
#[serde(rename_all = "snake_case")]
pub enum Preview {
    /// Pixels of an image or a map, at most 320 on each side.
    Picture {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Width and height in the message.
        source: [u32; 2],
        /// Red, green and blue of each pixel, row by row from the top, in Base64.
        rgb: String,
    },
    /// An image as its node compressed it, at most 512 KiB.
    Encoded {
        /// Format as the message names it.
        format: String,
        /// The compressed image in Base64.
        data: String,
    },
    /// Points of a scan or a cloud, at most 4000.
    Points {
        /// Number of points in the message.
        total: u64,
        /// x, y and z of each point in metres, as little-endian floats in Base64.
        xyz: String,
    },
    /// Poses seen from above, at most 4000: x and y in metres, yaw in radians.
    Poses(Vec<[f64; 3]>),
}

/// Messages that cannot be shown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesMissed))]
pub struct Missed {
    /// Number of messages.
    pub messages: u64,
    /// Why the messages cannot be shown.
    pub reason: Cow<'static, str>,
}

/// A keep-alive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesBeat))]
pub struct Beat {
    /// Unix time up to which the stream is complete.
    pub t: Option<f64>,
}

/// Why the stream ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesEnd))]
pub struct End {
    /// The reason, in words.
    pub reason: Cow<'static, str>,
}
