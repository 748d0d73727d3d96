//! Events as streams and exports carry them, and the log from which exports read them.

use std::fmt::{self, Write as _};
use std::pin::Pin;

use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;

use crate::stability::Stability;

const SECONDS_OF_A_DAY: u64 = 86_400;

/// One kind of event.
#[derive(Debug, PartialEq, Eq)]
pub struct Definition {
    /// Name of the event; stable.
    pub name: &'static str,
    /// Severity of the event.
    pub severity: Severity,
    /// Severity if the event reports the end of a condition or an intended change.
    pub resolved_severity: Severity,
    /// Attributes in order; unknown ones are left out.
    pub attributes: &'static [&'static str],
    /// One sentence of help.
    pub help: &'static str,
    /// Stability of name and attributes.
    pub stability: Stability,
}

/// Severities of OpenTelemetry's logs that events use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Normal on a healthy robot.
    Info,
    /// Needs attention.
    Warn,
    /// Visibility is incomplete.
    Error,
}

/// One event as streams and exports carry it.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Number of the event in this run of the agent.
    pub number: u64,
    /// Time of the event, by the source's clock.
    pub at: Timestamp,
    /// Time at which it was recorded, by this host's clock.
    pub observed: Timestamp,
    /// Definition of the event.
    pub definition: &'static Definition,
    /// Severity of the event.
    pub severity: Severity,
    /// Attributes with their values, in the order of the definition.
    pub attributes: Vec<(&'static str, Value)>,
}

/// Value of an attribute.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(untagged)]
pub enum Value {
    /// Text of bounded length.
    Text(String),
    /// A count or another whole number.
    Number(u64),
    /// A real number.
    Real(f64),
    /// Several texts.
    List(Vec<String>),
}

/// Events for a reader.
#[derive(Debug, Default)]
pub struct Batch {
    /// Number of events overwritten before they were read.
    pub lagged: u64,
    /// Events after the overwritten ones.
    pub records: Vec<Record>,
    /// Number of the last event, after which to continue.
    pub last: u64,
}

/// A log of numbered events that an exporter reads at its own pace.
pub trait EventSource: fmt::Debug + Send + Sync {
    /// Completes once the log has an event after the number `after`.
    fn wait_after(&self, after: u64) -> Pin<Box<dyn Future<Output = ()> + '_>>;

    /// Returns at most `most` events after the number `after`, oldest first. Events that were
    /// overwritten are counted as lost to the exporter.
    fn read_after(&self, after: u64, most: usize) -> Batch;
}

impl Severity {
    /// Returns the `SeverityText`.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Info => "INFO",
            Self::Warn => "WARN",
            Self::Error => "ERROR",
        }
    }

    /// Returns the `SeverityNumber`.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Info => 9,
            Self::Warn => 13,
            Self::Error => 17,
        }
    }
}

impl Definition {
    /// Creates the definition of an event whose name is stable.
    #[must_use]
    pub const fn new(
        name: &'static str,
        severity: Severity,
        attributes: &'static [&'static str],
        help: &'static str,
    ) -> Self {
        Self {
            name,
            severity,
            resolved_severity: severity,
            attributes,
            help,
            stability: Stability::Stable,
        }
    }

    /// Sets the severity of events that report the end of a condition or an intended change.
    #[must_use]
    pub const fn resolved_severity(self, relief: Severity) -> Self {
        Self {
            resolved_severity: relief,
            ..self
        }
    }
}

impl Record {
    /// Returns the value of an attribute; `None` if it is absent.
    #[must_use]
    pub fn attribute(&self, name: &str) -> Option<&Value> {
        let mut attributes = self.attributes.iter();
        attributes.find_map(|(key, value)| (*key == name).then_some(value))
    }

    /// Returns the time of the event in RFC 3339 format.
    #[must_use]
    pub fn time(&self) -> String {
        rfc3339(self.at)
    }
}

/// Formats UTC with nanoseconds (RFC 3339, 5.6). Days are counted from 1 March of the year 0, so
/// that the leap day is the last day of a year.
fn rfc3339(at: Timestamp) -> String {
    let (days, rest) = (
        at.whole_seconds() / SECONDS_OF_A_DAY,
        at.whole_seconds() % SECONDS_OF_A_DAY,
    );
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (month, next) = if month < 10 {
        (month + 3, 0)
    } else {
        (month - 9, 1)
    };
    let year = era * 400 + year + next;
    let (hour, minute, second) = (rest / 3600, rest / 60 % 60, rest % 60);
    let mut time = String::with_capacity(30);
    let _ = write!(
        time,
        "{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{:09}Z",
        at.0 % SECOND
    );
    time
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_formatted_as_utc_with_leap_years() {
        for (seconds, expected) in [
            (0, "1970-01-01T00:00:00.000000000Z"),
            (951_782_399, "2000-02-28T23:59:59.000000000Z"),
            (951_868_800, "2000-03-01T00:00:00.000000000Z"),
            (1_709_164_800, "2024-02-29T00:00:00.000000000Z"),
            (1_795_219_199, "2026-11-20T23:59:59.000000000Z"),
            (4_107_542_400, "2100-03-01T00:00:00.000000000Z"),
        ] {
            assert_eq!(rfc3339(Timestamp(seconds * SECOND)), expected);
        }
        assert!(rfc3339(Timestamp(7)).ends_with("00.000000007Z"));
    }
}
