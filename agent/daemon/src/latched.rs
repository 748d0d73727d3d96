//! The last messages of transient-local writers, as the API and reports describe them.

use ros2probe_api::latched::{Latched, LatchedState};
use ros2probe_model::report::snapshot::LatchedFacts;

/// Returns the state of the last message of a transient-local writer.
pub(crate) fn latched(facts: LatchedFacts) -> Latched {
    let (state, bytes) = match facts {
        LatchedFacts::Unseen => (LatchedState::Unseen, None),
        LatchedFacts::Kept(bytes) => (LatchedState::Kept, Some(bytes)),
        LatchedFacts::TooLarge(bytes) => (LatchedState::TooLarge, Some(bytes)),
        LatchedFacts::Paused => (LatchedState::Paused, None),
        LatchedFacts::NoRoom(bytes) => (LatchedState::NoRoom, Some(bytes)),
    };
    Latched {
        state: state.into(),
        bytes,
    }
}
