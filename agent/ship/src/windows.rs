//! Times of the day in which bags are delivered.

use std::str::FromStr;
use std::time::Duration;

use jiff::civil::Time;

const MINUTES_PER_DAY: u32 = 24 * 60;

/// One time of the day, as in `22:00-06:00`. It may pass midnight.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Minutes from midnight.
    begin: u32,
    end: u32,
}

/// All windows. Without one, bags are delivered at any time.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Windows(pub Vec<Window>);

/// The text is not a valid window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("two different times of the day, as in `22:00-06:00`")]
pub struct InvalidWindow;

impl FromStr for Window {
    type Err = InvalidWindow;

    fn from_str(text: &str) -> Result<Self, InvalidWindow> {
        let (begin, end) = text.split_once('-').ok_or(InvalidWindow)?;
        let window = Self {
            begin: minutes(begin).ok_or(InvalidWindow)?,
            end: minutes(end).ok_or(InvalidWindow)?,
        };
        match window.begin == window.end {
            true => Err(InvalidWindow),
            false => Ok(window),
        }
    }
}

impl Window {
    fn contains(self, minute: u32) -> bool {
        match self.begin < self.end {
            true => (self.begin..self.end).contains(&minute),
            false => minute >= self.begin || minute < self.end,
        }
    }
}

impl Windows {
    /// Returns the time until a window opens; zero if one is open.
    #[must_use]
    pub fn time_to_opening(&self, now: Time) -> Duration {
        let second = u64::from(now.second().unsigned_abs());
        let minute =
            u32::from(now.hour().unsigned_abs()) * 60 + u32::from(now.minute().unsigned_abs());
        let is_open = |window: &Window| window.contains(minute);
        if self.0.is_empty() || self.0.iter().any(is_open) {
            return Duration::ZERO;
        }
        let waits = self
            .0
            .iter()
            .map(|window| (window.begin + MINUTES_PER_DAY - minute) % MINUTES_PER_DAY);
        let wait = u64::from(waits.min().unwrap_or(0)) * 60;
        Duration::from_secs(wait.saturating_sub(second))
    }
}

/// Returns the minutes from midnight; 24:00 is midnight.
fn minutes(text: &str) -> Option<u32> {
    let (hour, minute) = text.split_once(':')?;
    let number = |digits: &str| {
        let is_number = digits.len() == 2 && digits.bytes().all(|digit| digit.is_ascii_digit());
        digits.parse::<u32>().ok().filter(|_| is_number)
    };
    let (hour, minute) = (number(hour)?, number(minute)?);
    let is_time = hour < 24 && minute < 60 || (hour, minute) == (24, 0);
    is_time.then_some((hour * 60 + minute) % MINUTES_PER_DAY)
}

#[cfg(test)]
mod tests {
    use jiff::civil::time;
    use proptest::prelude::*;

    use super::*;

    fn windows(texts: &[&str]) -> Windows {
        Windows(texts.iter().map(|text| text.parse().unwrap()).collect())
    }

    #[test]
    fn a_window_may_pass_midnight() {
        let night = windows(&["22:00-06:00"]);
        for (hour, minute, wait) in [
            (22, 0, 0),
            (0, 0, 0),
            (5, 59, 0),
            (6, 0, 16 * 3_600),
            (21, 59, 60),
        ] {
            let opens = night.time_to_opening(time(hour, minute, 0, 0));
            assert_eq!(opens, Duration::from_secs(wait), "{hour}:{minute}");
        }
        let both = windows(&["22:00-06:00", "12:00-13:00"]);
        assert_eq!(both.time_to_opening(time(12, 30, 0, 0)), Duration::ZERO);
        assert_eq!(
            both.time_to_opening(time(11, 59, 30, 0)),
            Duration::from_secs(30)
        );
        assert_eq!(
            Windows::default().time_to_opening(time(3, 0, 0, 0)),
            Duration::ZERO
        );
        assert_eq!(
            windows(&["20:00-24:00"]).time_to_opening(time(0, 0, 0, 0)),
            Duration::from_secs(20 * 3_600)
        );
    }

    #[test]
    fn invalid_windows_are_refused() {
        for text in [
            "",
            "22:00",
            "22-06",
            "22:00-22:00",
            "25:00-06:00",
            "22:60-06:00",
            "+2:00-06:00",
            "22:00-6:00",
            "00:00-24:00",
            "22:00 - 06:00",
        ] {
            assert_eq!(text.parse::<Window>(), Err(InvalidWindow), "{text}");
        }
    }

    proptest! {
        #[test]
        fn a_window_is_open_at_the_time_at_which_it_opens(
            begin in 0_u32..MINUTES_PER_DAY,
            length in 1_u32..MINUTES_PER_DAY,
            hour in 0_i8..24,
            minute in 0_i8..60,
            second in 0_i8..60,
        ) {
            let end = (begin + length) % MINUTES_PER_DAY;
            let windows = Windows(vec![Window { begin, end }]);
            let now = time(hour, minute, second, 0);
            let wait = windows.time_to_opening(now);
            let then = now.wrapping_add(jiff::SignedDuration::try_from(wait).unwrap());
            prop_assert_eq!(windows.time_to_opening(then), Duration::ZERO);
            let minute = hour as u32 * 60 + minute as u32;
            let is_inside = (minute + MINUTES_PER_DAY - begin) % MINUTES_PER_DAY < length;
            prop_assert_eq!(wait == Duration::ZERO, is_inside);
        }
    }
}
