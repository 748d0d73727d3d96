//! Enumerations that a newer agent may extend.

use serde::{Deserialize, Serialize};

/// A value that this version knows, or the raw value that a newer agent sends.
///
/// ```
/// use ros2probe_api::Open;
/// use ros2probe_api::watches::WatchState;
///
/// let state: Open<WatchState> = serde_json::from_str("\"waiting\"")?;
/// assert_eq!(state, WatchState::Waiting);
/// let state: Open<WatchState> = serde_json::from_str("\"asleep\"")?;
/// assert_eq!(state, Open::Unknown("asleep".to_owned()));
/// # Ok::<_, serde_json::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Open<T, U = String> {
    /// A value that this version declares.
    Known(T),
    /// Any other value.
    Unknown(U),
}

impl<T, U: Default> Default for Open<T, U> {
    fn default() -> Self {
        Self::Unknown(U::default())
    }
}

impl<T, U> From<T> for Open<T, U> {
    fn from(known: T) -> Self {
        Self::Known(known)
    }
}

impl<T: PartialEq, U> PartialEq<T> for Open<T, U> {
    fn eq(&self, other: &T) -> bool {
        matches!(self, Self::Known(known) if known == other)
    }
}
