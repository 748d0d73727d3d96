//! Steps of the machine's clock.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Result, ensure};

/// A wrong clock of the machine, until the value is dropped.
pub(super) struct ClockStep {
    right: Duration,
    since: Instant,
}

impl ClockStep {
    pub(super) fn by(seconds: i64) -> Result<ClockStep> {
        let right = SystemTime::now().duration_since(UNIX_EPOCH)?;
        let set = ClockStep {
            right,
            since: Instant::now(),
        };
        let wrong = right.as_secs().saturating_add_signed(seconds);
        set_clock(Duration::new(wrong, right.subsec_nanos()))?;
        Ok(set)
    }
}

impl Drop for ClockStep {
    fn drop(&mut self) {
        if let Err(error) = set_clock(self.right + self.since.elapsed()) {
            eprintln!("the clock is still wrong: {error:#}");
        }
    }
}

fn set_clock(time: Duration) -> Result<()> {
    let time = libc::timespec {
        tv_sec: time.as_secs().try_into()?,
        tv_nsec: time.subsec_nanos().into(),
    };
    // SAFETY: the kernel reads a timespec that outlives the call.
    let result = unsafe { libc::clock_settime(libc::CLOCK_REALTIME, &raw const time) };
    ensure!(result == 0, "{}", std::io::Error::last_os_error());
    Ok(())
}
