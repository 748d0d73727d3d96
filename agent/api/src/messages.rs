//! `/topics/{topic}/messages`: the lines of the stream of decoded messages, and
//! `/topics/{topic}/definition`.
//!
//! The fields of a message are of any type `V`: the agent writes JSON text, and a client reads what
//! it needs. The line of a message is a [`Message`] of them.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// One line: an object with one member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesLine))]
#[serde(rename_all = "snake_case")]
pub enum Line<M> {
    /// The type of the messages that follow.
    Type(Definition),
    /// A message.
    Message(M),
    /// Messages that will not be shown because their bytes are not known.
    Missed(Missed),
    /// The stream lives.
    Beat(Beat),
    /// Nothing will follow.
    End(End),
}

/// A type.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesType))]
pub struct Definition {
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "sensor_msgs/msg/Imu"))]
    pub name: String,
    /// Whether its definition is known, so that messages can be decoded.
    pub known: bool,
    /// Why not.
    pub reason: Option<String>,
    /// The definition with those of its parts, as ROS bags have it.
    pub definition: Option<String>,
}

/// A message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesMessage))]
pub struct Message<V> {
    /// Unix time of its arrival.
    pub time: f64,
    /// Unix time at which it was written, by the writer's clock.
    pub source_time: Option<f64>,
    /// GUID of its writer.
    pub writer: String,
    /// The writer's node.
    pub node: Option<String>,
    /// Its number among those of this writer.
    pub sequence_number: u64,
    /// Bytes of the serialized message.
    pub bytes: u32,
    /// Messages that came between the one shown before and this one.
    pub skipped: u64,
    /// Its fields, in the order of the definition. 64-bit numbers beyond 2^53, NaN and infinities are
    /// text; of long arrays and texts there is `$length` and the beginning, `$items` or `$text`.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Object>))]
    pub value: Option<V>,
    /// Why it cannot be decoded.
    pub error: Option<String>,
}

/// Messages that are not known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesMissed))]
pub struct Missed {
    /// How many.
    pub messages: u64,
    /// Why.
    pub reason: Cow<'static, str>,
}

/// The stream lives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesBeat))]
pub struct Beat {
    /// Unix time up to which all messages have come.
    pub t: Option<f64>,
}

/// Why nothing follows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MessagesEnd))]
pub struct End {
    /// In words.
    pub reason: Cow<'static, str>,
}
