//! States of managed nodes: `lifecycle_msgs/msg/TransitionEvent`, as published on the topic
//! `transition_event` of each of them, and replies of `lifecycle_msgs/srv/GetState`.
//!
//! The layouts are the same in all distributions since Foxy.

use crate::cursor::WireError;
use crate::plain::PlainCursor;

/// Name of the type of events, as ROS writes it.
pub const EVENT: &str = "lifecycle_msgs/msg/TransitionEvent";
/// Name of the type of replies, as ROS writes it.
pub const STATE_REPLY: &str = "lifecycle_msgs/srv/GetState_Response";

/// State of a managed node (`lifecycle_msgs/msg/State`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LifecycleState {
    /// 0, or a number without a meaning.
    Unknown,
    /// 1.
    Unconfigured,
    /// 2.
    Inactive,
    /// 3.
    Active,
    /// 4.
    Finalized,
    /// 10.
    Configuring,
    /// 11.
    CleaningUp,
    /// 12.
    ShuttingDown,
    /// 13.
    Activating,
    /// 14.
    Deactivating,
    /// 15.
    ErrorProcessing,
}

/// A change from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// State before.
    pub from: LifecycleState,
    /// State after.
    pub to: LifecycleState,
}

impl LifecycleState {
    /// Returns the state of a number.
    #[must_use]
    pub const fn of(number: u8) -> Self {
        match number {
            1 => Self::Unconfigured,
            2 => Self::Inactive,
            3 => Self::Active,
            4 => Self::Finalized,
            10 => Self::Configuring,
            11 => Self::CleaningUp,
            12 => Self::ShuttingDown,
            13 => Self::Activating,
            14 => Self::Deactivating,
            15 => Self::ErrorProcessing,
            _ => Self::Unknown,
        }
    }

    /// Returns the label that nodes give it.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
            Self::Configuring => "configuring",
            Self::CleaningUp => "cleaningup",
            Self::ShuttingDown => "shuttingdown",
            Self::Activating => "activating",
            Self::Deactivating => "deactivating",
            Self::ErrorProcessing => "errorprocessing",
        }
    }

    /// Parses a reply that begins with a header of this length after its encapsulation header. Only
    /// Cyclone DDS sends one.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`](crate::cursor::Reason::BadMarker) if the payload is not plain CDR.
    pub fn of_reply(payload: &[u8], header: usize) -> Result<Self, WireError> {
        let mut cursor = PlainCursor::of(payload)?;
        cursor.cursor.take("reply header", header)?;
        Ok(Self::of(cursor.cursor.u8("current_state.id")?))
    }
}

impl Transition {
    /// Parses an event, encapsulation header included.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`](crate::cursor::Reason::BadMarker) if the payload is not plain CDR.
    pub fn parse(payload: &[u8]) -> Result<Self, WireError> {
        let mut cursor = PlainCursor::of(payload)?;
        cursor.wide("timestamp")?;
        cursor.cursor.u8("transition.id")?;
        cursor.text("transition.label")?;
        let from = cursor.cursor.u8("start_state.id")?;
        cursor.text("start_state.label")?;
        let to = cursor.cursor.u8("goal_state.id")?;
        Ok(Self {
            from: LifecycleState::of(from),
            to: LifecycleState::of(to),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::{Encoder, hurt};

    fn event(endianness: Endianness) -> Vec<u8> {
        let mut encoder = Encoder::new(endianness);
        encoder.u32(0).u32(0);
        for (id, label) in [(60, "error"), (13, "activating"), (15, "errorprocessing")] {
            encoder.raw(&[id]).align().unpadded(label);
        }
        let little = u8::from(endianness == Endianness::Little);
        [&[0, little, 0, 0], &encoder.bytes[..]].concat()
    }

    #[test]
    fn an_event_reads_the_same_in_either_byte_order() {
        for endianness in [Endianness::Big, Endianness::Little] {
            let transition = Transition::parse(&event(endianness)).unwrap();
            assert_eq!(transition.from, LifecycleState::Activating);
            assert_eq!(transition.to, LifecycleState::ErrorProcessing);
        }
        let mut bytes = event(Endianness::Little);
        bytes[1] = 3;
        assert_eq!(
            Transition::parse(&bytes).unwrap_err().reason,
            Reason::BadMarker
        );
    }

    #[test]
    fn a_reply_is_read_with_and_without_the_header_of_cyclone() {
        let reply = [0, 1, 0, 0, 2, 0, 0, 0, 9, 0, 0, 0];
        let state = LifecycleState::of_reply(&reply, 0);
        assert_eq!(state, Ok(LifecycleState::Inactive));
        let with_header = [&reply[..4], &[7; 16], &reply[4..]].concat();
        let state = LifecycleState::of_reply(&with_header, 16);
        assert_eq!(state, Ok(LifecycleState::Inactive));
    }

    #[test]
    fn each_number_has_the_label_of_the_message() {
        let labels: Vec<_> = (0..=16)
            .map(|number| LifecycleState::of(number).label())
            .collect();
        assert_eq!(
            labels[..5],
            ["unknown", "unconfigured", "inactive", "active", "finalized"]
        );
        assert_eq!(
            labels[10..13],
            ["configuring", "cleaningup", "shuttingdown"]
        );
        assert_eq!(
            labels[13..16],
            ["activating", "deactivating", "errorprocessing"]
        );
        assert!([5, 9, 16].iter().all(|number| labels[*number] == "unknown"));
    }

    #[test]
    fn no_truncation_or_corruption_of_one_byte_makes_the_parser_panic() {
        hurt(&event(Endianness::Little), |bytes| {
            let _ = Transition::parse(bytes);
            let _ = LifecycleState::of_reply(bytes, 16);
        });
    }
}
