//! The last message of a transient-local writer, which the agent keeps for later clients.

use serde::{Deserialize, Serialize};

use crate::Open;

/// Maximum size of a message that is kept without a watch that requests it, in bytes.
pub const MESSAGE_BYTES: u32 = 1 << 20;
/// Maximum total size of all kept messages, in bytes.
pub const ALL_BYTES: u32 = 16 << 20;
/// Remedy for a last message that is not kept.
const REMEDY: &str = "set `retain: last` in a watch of it";

/// The last message of a transient-local writer.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Latched {
    /// Whether the message is kept, or why it is not.
    #[cfg_attr(feature = "openapi", schema(value_type = LatchedState))]
    pub state: Open<LatchedState>,
    /// Size of the message in bytes; null if it was not seen.
    pub bytes: Option<u32>,
}

/// State of the last message of a transient-local writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LatchedState {
    /// The message is kept: recordings, viewers and commands that start now receive it.
    Kept,
    /// The message was not seen. It was sent before the agent started, without a subscriber, or on
    /// a transport that the agent does not observe.
    Unseen,
    /// The message exceeds the size limit.
    TooLarge,
    /// The message was not captured, because its writer sends too much.
    Paused,
    /// The message was dropped or refused because of the limit on the total size.
    NoRoom,
}

impl Latched {
    /// Returns whether the message is kept.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.state == LatchedState::Kept
    }

    /// Returns why clients that start now miss the last message of a transient-local writer on this
    /// topic, with the remedy. Returns `None` if they receive it. `latched` is `None` if the agent
    /// keeps no last messages.
    #[must_use]
    pub fn missing(latched: Option<&Self>, topic: &str) -> Option<String> {
        let size = latched.and_then(|latched| latched.bytes).map(size);
        let size = size.map_or_else(String::new, |size| format!(" ({size})"));
        let message = format!("the latched message of {topic}{size}");
        let state = latched.map(|latched| &latched.state);
        Some(match state {
            Some(Open::Known(LatchedState::Kept)) => return None,
            Some(Open::Known(LatchedState::Unseen)) => format!(
                "{message} was not seen, and the agent cannot request it, because it does not \
                 subscribe"
            ),
            Some(Open::Known(LatchedState::TooLarge)) => {
                let most = self::size(MESSAGE_BYTES);
                format!("{message} is larger than {most}: {REMEDY}")
            }
            Some(Open::Known(LatchedState::Paused)) => {
                format!("{message} was not captured, because its publisher sends much: {REMEDY}")
            }
            Some(Open::Known(LatchedState::NoRoom)) => {
                let all = self::size(ALL_BYTES);
                format!("{message} has no room among the {all} of others: {REMEDY}")
            }
            Some(Open::Unknown(_)) | None => format!("{message} is not kept: {REMEDY}"),
        })
    }
}

/// Formats a size with its unit.
fn size(bytes: u32) -> String {
    let (amount, unit) = match bytes {
        0..1024 => return format!("{bytes} bytes"),
        1024..MESSAGE_BYTES => (f64::from(bytes) / 1024.0, "KiB"),
        MESSAGE_BYTES.. => (f64::from(bytes) / f64::from(MESSAGE_BYTES), "MiB"),
    };
    match bytes.is_multiple_of(1024) && amount.fract() == 0.0 {
        true => format!("{amount} {unit}"),
        false => format!("{amount:.1} {unit}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_last_message_is_reported_with_its_size_and_remedy() {
        let missing = |state: LatchedState, bytes| {
            let latched = Latched {
                state: state.into(),
                bytes,
            };
            Latched::missing(Some(&latched), "/map")
        };
        assert_eq!(missing(LatchedState::Kept, Some(9)), None);
        assert_eq!(
            missing(LatchedState::TooLarge, Some(3_250_000)).unwrap(),
            "the latched message of /map (3.1 MiB) is larger than 1 MiB: set `retain: last` in a \
             watch of it"
        );
        assert_eq!(
            missing(LatchedState::NoRoom, Some(921_600)).unwrap(),
            "the latched message of /map (900 KiB) has no room among the 16 MiB of others: set \
             `retain: last` in a watch of it"
        );
        assert_eq!(
            missing(LatchedState::Unseen, None).unwrap(),
            "the latched message of /map was not seen, and the agent cannot request it, because it \
             does not subscribe"
        );
        let paused = missing(LatchedState::Paused, Some(900)).unwrap();
        assert!(paused.contains("(900 bytes) was not captured"), "{paused}");
        let unknown = Latched::missing(None, "/map").unwrap();
        assert!(unknown.starts_with("the latched message of /map is not kept: "));
    }
}
