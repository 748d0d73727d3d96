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

impl Pace {
    /// Returns whether the replay stands still.
    #[must_use]
    pub const fn is_paused(&self) -> bool {
        self.is_paused && self.jump.is_none()
    }

    /// Returns the speed as a multiple of that of the capture; 0 = without waiting. `started` is
    /// the speed of the start.
    #[must_use]
    pub fn times(&self, started: Option<Speed>) -> f64 {
        match self.speed.or(started) {
            Some(Speed::Times(times)) => times,
            Some(Speed::Max) | None => 0.0,
        }
    }
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
