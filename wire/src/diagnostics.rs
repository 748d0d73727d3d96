//! `diagnostic_msgs/msg/DiagnosticArray`: the states of a robot's parts, as published on
//! `/diagnostics` and `/diagnostics_agg`.
//!
//! The layout is the same in all distributions since Foxy: a header, then statuses of level, name,
//! message, hardware id, and pairs of key and value.

use crate::cursor::{Cursor, WireError};
use crate::text;

/// Name of the type, as ROS writes it.
pub const TYPE: &str = "diagnostic_msgs/msg/DiagnosticArray";

/// Level of a status (`diagnostic_msgs/msg/DiagnosticStatus`), by severity.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(u8)]
pub enum DiagnosticLevel {
    /// 0.
    Ok,
    /// 1.
    Warn,
    /// 2.
    Error,
    /// 3, and all higher numbers.
    Stale,
}

impl DiagnosticLevel {
    /// All levels, in the order of their numbers.
    pub const ALL: [Self; 4] = [Self::Ok, Self::Warn, Self::Error, Self::Stale];

    /// Returns the level of a number.
    #[must_use]
    pub const fn of(number: u8) -> Self {
        match number {
            0 => Self::Ok,
            1 => Self::Warn,
            2 => Self::Error,
            3.. => Self::Stale,
        }
    }

    /// Returns the level with this label.
    #[must_use]
    pub fn named(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|level| level.label() == label)
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Error => "error",
            Self::Stale => "stale",
        }
    }
}

/// One status of a message. Texts are unverified bytes, without their terminators.
#[derive(Clone, Debug)]
pub struct DiagnosticStatus<'a> {
    /// Its level.
    pub level: DiagnosticLevel,
    /// Name of the part, perhaps with its node: `lidar: connection`.
    pub name: &'a [u8],
    /// What is the matter.
    pub message: &'a [u8],
    /// Id of the hardware; often empty.
    pub hardware_id: &'a [u8],
    /// Values, each with its key.
    pub values: DiagnosticValues<'a>,
}

/// The statuses of a message, one after the other.
#[derive(Clone, Debug)]
pub struct DiagnosticStatuses<'a> {
    cursor: Cursor<'a>,
    left: u32,
}

/// The pairs of key and value of a status. The iterator ends at the first malformed pair, which
/// [`DiagnosticStatuses`] has refused before.
#[derive(Clone, Debug)]
pub struct DiagnosticValues<'a> {
    cursor: Cursor<'a>,
    left: u32,
}

impl<'a> DiagnosticStatuses<'a> {
    /// Reads the header of a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`](crate::cursor::Reason::BadMarker) if the payload is not plain
    /// CDR.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let mut cursor = text::plain_cdr(payload)?;
        cursor.u32("header.stamp.sec")?;
        cursor.u32("header.stamp.nanosec")?;
        text::unterminated(&mut cursor, "header.frame_id")?;
        cursor.align(4);
        let left = cursor.u32("status")?;
        Ok(Self { cursor, left })
    }

    fn status(&mut self) -> Result<DiagnosticStatus<'a>, WireError> {
        let cursor = &mut self.cursor;
        let level = DiagnosticLevel::of(cursor.u8("status.level")?);
        let name = text::unterminated(cursor, "status.name")?;
        let message = text::unterminated(cursor, "status.message")?;
        let hardware_id = text::unterminated(cursor, "status.hardware_id")?;
        cursor.align(4);
        let count = cursor.u32("status.values")?;
        let values = DiagnosticValues {
            cursor: *cursor,
            left: count,
        };
        for _ in 0..count {
            text::unterminated(cursor, "status.values.key")?;
            text::unterminated(cursor, "status.values.value")?;
        }
        Ok(DiagnosticStatus {
            level,
            name,
            message,
            hardware_id,
            values,
        })
    }
}

impl<'a> Iterator for DiagnosticStatuses<'a> {
    type Item = Result<DiagnosticStatus<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1)?;
        let status = self.status();
        if status.is_err() {
            self.left = 0;
        }
        Some(status)
    }
}

impl<'a> Iterator for DiagnosticValues<'a> {
    /// Key and value.
    type Item = (&'a [u8], &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1)?;
        let key = text::unterminated(&mut self.cursor, "key").ok()?;
        let value = text::unterminated(&mut self.cursor, "value").ok()?;
        Some((key, value))
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::{Encoder, hurt};

    fn encoded(endianness: Endianness) -> Vec<u8> {
        let mut encoder = Encoder::new(endianness);
        encoder.u32(1_700_000_000).u32(5).string("").u32(2);
        for (level, name, values) in [(2, "lidar: connection", 2), (0, "battery", 0)] {
            encoder
                .raw(&[level])
                .string(name)
                .string("no data")
                .string("vlp16")
                .u32(values);
            for key in 0..values {
                encoder.string(&std::format!("key {key}")).unpadded("no 1");
            }
        }
        let little = u8::from(endianness == Endianness::Little);
        [&[0, little, 0, 0], &encoder.bytes[..]].concat()
    }

    #[test]
    fn statuses_and_values_read_the_same_in_either_byte_order() {
        for endianness in [Endianness::Big, Endianness::Little] {
            let bytes = encoded(endianness);
            let statuses: Result<Vec<_>, _> = DiagnosticStatuses::parse(&bytes).unwrap().collect();
            let [lidar, battery] = &statuses.unwrap()[..] else {
                panic!("two statuses");
            };
            assert_eq!(
                (lidar.level, battery.level),
                (DiagnosticLevel::Error, DiagnosticLevel::Ok)
            );
            assert_eq!(lidar.name, b"lidar: connection");
            assert_eq!(
                (lidar.message, lidar.hardware_id),
                (&b"no data"[..], &b"vlp16"[..])
            );
            let values: Vec<_> = lidar.values.clone().collect();
            assert_eq!(values, [(&b"key 0"[..], &b"no 1"[..]), (b"key 1", b"no 1")]);
            assert_eq!(battery.values.clone().count(), 0);
        }
    }

    #[test]
    fn a_truncated_message_yields_its_whole_statuses_and_one_error() {
        let bytes = encoded(Endianness::Little);
        let cut = &bytes[..bytes.len() - 1];
        let mut statuses = DiagnosticStatuses::parse(cut).unwrap();
        assert!(statuses.next().unwrap().is_ok());
        assert_eq!(
            statuses.next().unwrap().unwrap_err().reason,
            Reason::Truncated
        );
        assert!(statuses.next().is_none());
    }

    #[test]
    fn counts_beyond_the_bytes_end_at_once() {
        let mut bytes = encoded(Endianness::Little);
        bytes[20..24].fill(0xff);
        let statuses = DiagnosticStatuses::parse(&bytes).unwrap();
        assert!(statuses.filter(Result::is_ok).count() < 4);
    }

    #[test]
    fn no_truncation_or_corruption_of_one_byte_makes_the_parser_panic() {
        hurt(&encoded(Endianness::Little), |bytes| {
            for status in DiagnosticStatuses::parse(bytes)
                .into_iter()
                .flatten()
                .flatten()
            {
                let _ = status.values.count();
            }
        });
    }
}
