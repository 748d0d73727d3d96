//! Token bucket for the bytes of messages that are captured before any client requests them.

use ros2probe_wire::Guid;
use ros2probe_wire::time::SECOND;

use crate::facts::model_time::ModelTime;

/// Bytes charged per datagram in addition to its payload, so that small datagrams are not free.
const DATAGRAM_OVERHEAD: usize = 64;

/// Bytes that may be captured: a burst of at most `most`, and `rate` per second on average.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Allowance {
    most: u64,
    rate: u64,
    left: u64,
    /// Time of the last refill of `left`.
    at: ModelTime,
}

impl Allowance {
    /// Creates a full allowance.
    pub(crate) const fn new(most: u64, rate: u64) -> Self {
        Self {
            most,
            rate,
            left: most,
            at: ModelTime::ZERO,
        }
    }

    /// Returns the bytes that are left at `now`.
    pub(crate) fn left(&mut self, now: ModelTime) -> u64 {
        let elapsed = now - self.at;
        // An amount below one byte waits for the next call.
        let elapsed = u64::try_from(elapsed.as_nanos()).unwrap_or(u64::MAX);
        let more = u128::from(elapsed) * u128::from(self.rate) / u128::from(SECOND);
        if more > 0 {
            let more = u64::try_from(more).unwrap_or(u64::MAX);
            self.left = self.left.saturating_add(more).min(self.most);
            self.at = self.at.max(now);
        }
        self.left
    }

    /// Charges a datagram with this many bytes of payload. Returns whether the allowance covers it.
    pub(crate) fn spend(&mut self, payload: usize, now: ModelTime) -> bool {
        let cost = u64::try_from(payload.saturating_add(DATAGRAM_OVERHEAD)).unwrap_or(u64::MAX);
        let left = self.left(now).checked_sub(cost);
        self.left = left.unwrap_or(0);
        left.is_some()
    }

    /// Takes all bytes that are left.
    pub(crate) const fn exhaust(&mut self) {
        self.left = 0;
    }
}

/// The allowance of all writers together, and the number of paused ones.
#[derive(Debug)]
pub(crate) struct CommonAllowance {
    allowance: Allowance,
    /// A paused writer is captured again once it is allowed this many bytes.
    resume_bytes: u64,
    paused: usize,
}

/// The allowance of one writer. A paused writer is not captured.
#[derive(Debug)]
pub(crate) struct WriterAllowance {
    pub(crate) allowance: Allowance,
    is_paused: bool,
}

impl CommonAllowance {
    pub(crate) const fn new(allowance: Allowance, resume_bytes: u64) -> Self {
        Self {
            allowance,
            resume_bytes,
            paused: 0,
        }
    }

    /// Returns whether any writer is paused.
    pub(crate) const fn has_paused(&self) -> bool {
        self.paused > 0
    }

    /// Charges a datagram of a writer to both allowances. Returns whether they cover it.
    pub(crate) fn spend(
        &mut self,
        own: &mut WriterAllowance,
        payload: usize,
        now: ModelTime,
    ) -> bool {
        let is_own = own.allowance.spend(payload, now);
        self.allowance.spend(payload, now) && is_own
    }

    /// Pauses a writer.
    pub(crate) const fn pause(&mut self, own: &mut WriterAllowance) {
        own.is_paused = true;
        self.paused += 1;
    }

    /// Forgets a writer.
    pub(crate) fn forget(&mut self, own: &WriterAllowance) {
        self.paused -= usize::from(own.is_paused);
    }

    /// Ends the pause of writers that are allowed enough bytes again. Returns these writers.
    pub(crate) fn resume<'a>(
        &mut self,
        writers: impl Iterator<Item = (&'a Guid, &'a mut WriterAllowance)>,
        now: ModelTime,
    ) -> Vec<Guid> {
        if self.paused == 0 || self.allowance.left(now) < self.resume_bytes {
            return Vec::new();
        }
        let mut resumed = Vec::new();
        for (writer, own) in writers {
            if own.is_paused && own.allowance.left(now) >= self.resume_bytes {
                own.is_paused = false;
                resumed.push(*writer);
            }
        }
        self.paused -= resumed.len();
        resumed
    }
}

impl WriterAllowance {
    pub(crate) const fn new(allowance: Allowance) -> Self {
        Self {
            allowance,
            is_paused: false,
        }
    }

    pub(crate) const fn is_paused(&self) -> bool {
        self.is_paused
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_allowance_covers_a_burst_and_then_its_rate() {
        let mut allowance = Allowance::new(1_000, 100);
        let seconds = |seconds: u64| ModelTime::from_nanoseconds((1_000 + seconds) * SECOND);
        assert!((0..5).all(|_| allowance.spend(136, seconds(0))));
        assert!(!allowance.spend(136, seconds(0)));
        assert_eq!(allowance.left(seconds(3)), 300);
        // An earlier time changes nothing.
        assert_eq!(allowance.left(seconds(1)), 300);
        assert_eq!(allowance.left(seconds(3)), 300);
        assert_eq!(allowance.left(seconds(900)), 1_000);
    }
}
