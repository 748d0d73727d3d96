//! How clients want a replay to go on.

use std::sync::{Mutex, MutexGuard, PoisonError};

use ros2probe_capture::pcap::Speed;
use ros2probe_wire::Timestamp;

/// The latest requests of clients.
#[derive(Debug, Default)]
pub struct ReplayPace(Mutex<Pace>);

/// How a replay goes on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pace {
    /// Whether it stands still, unless it jumps.
    pub is_paused: bool,
    /// Its speed; `None` = that of its start.
    pub speed: Option<Speed>,
    /// Where it goes without waiting.
    pub jump: Option<Jump>,
}

/// Where a replay goes without waiting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Jump {
    /// To this time of the capture.
    To(Timestamp),
    /// To the next event other than those of participants and endpoints. It pauses there.
    NextEvent,
}

impl ReplayPace {
    /// Returns the latest requests.
    #[must_use]
    pub fn get(&self) -> Pace {
        *self.lock()
    }

    /// Changes the requests, and returns the new ones.
    pub fn change(&self, change: impl FnOnce(&mut Pace)) -> Pace {
        let mut pace = self.lock();
        change(&mut pace);
        *pace
    }

    fn lock(&self) -> MutexGuard<'_, Pace> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
